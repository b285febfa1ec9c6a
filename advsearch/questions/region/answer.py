"""The result of `region`."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.runs.results.attack import LinearTransport
from advsearch.runs.results.base import CleanScene, Fields, Formation, Interval, JsonFloat, SceneResult, having


class AxisRange(Fields):
    """One parameter and the range of it that is shown."""

    name: str
    unit: str
    low: float
    high: float


class BoxSide(AxisRange):
    """One parameter and the range of it in which the verdict stays."""

    centre: float = Field(description="the value that the box grew around")


class MarginMap(Fields):
    """The margin on a grid over two parameters."""

    axes: tuple[AxisRange, AxisRange]
    margins: list[list[JsonFloat]] = Field(description="logits, in rows of the second parameter from its lowest value")


class GrownRegion(Fields):
    """What is known of a region; nothing yet if it was interrupted."""

    verdict: str | None = Field(default=None, description="`right` or `wrong`, at the centre")
    box: list[BoxSide] | None = Field(default=None, description="for each parameter, the range of its values")
    same: int | None = Field(default=None, description="fresh samples of the box that had that verdict")
    samples: int | None = Field(default=None, description="all fresh samples of it")
    rate: float | None = Field(default=None, description="the share of those that had it")
    interval: Interval | None = Field(default=None, description="of that share")
    volume: float | None = Field(default=None, description="share of the ranges that the box takes up")
    spp: int | None = Field(default=None, description="samples a pixel")
    map: MarginMap | None = Field(
        default=None, description="the margin over two parameters; only where `map` asks for it"
    )


class RegionResult(InNotebook, GrownRegion, SceneResult):
    """The box around a configuration in which the verdict stays."""

    command: ClassVar[str] = "region"

    image_formation: Formation
    clean: CleanScene
    warnings: list[str] = Field(description="sentences that a reader has to know")
    transport: LinearTransport | None = Field(
        default=None, description="what predicted pictures from new viewpoints; absent where no camera moves"
    )
    renders: Annotated[dict[str, int], having("verification")] = Field(
        description="of the `verification`: all that were rendered; of the `products`: all that were predicted"
    )

    @property
    def brief(self) -> str:
        """How sure the verdict is."""
        return f"{self.verdict} in {self.same} of {self.samples} samples of the box" if self.samples else ""


RESULT = RegionResult
