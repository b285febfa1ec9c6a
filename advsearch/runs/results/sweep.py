"""The result of `sweep`: what `summary.json` holds of it."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from advsearch.runs.results.attack import DescribedValue, LinearTransport, VerifiedRate
from advsearch.runs.results.base import Fields, Formation, Interval, Number, Payload, RunResult, having

AxisValue = int | float | str | tuple[float, float]
"""A number, a name, or both ends of a part of a range."""


class CountedAnswers(Fields):
    """Configurations, and in how many of them the model is right."""

    configurations: int = Field(description="how many were looked at")
    correct: int = Field(description="right answers")
    accuracy: float | None = Field(description="their share; null where there is no configuration")
    interval: Interval | None = Field(description="of that share")


class AxisRow(CountedAnswers):
    """Every configuration with one value of an axis."""

    axis: str
    unit: str
    value: AxisValue


class MapAxis(Fields):
    """An axis of the map, with all its values."""

    axis: str
    unit: str
    values: list[AxisValue]


class SweepMap(Fields):
    """Counts and margins over two axes, in rows of the second one."""

    axes: tuple[MapAxis, MapAxis]
    over: list[str] = Field(description="the axes beyond")
    configurations: list[list[int]]
    correct: list[list[int]]
    margin: list[list[Number | None]] = Field(description="the mean, in logits; null where there is none")


class WorstClaim(Fields):
    """What the sweep saw at its worst."""

    label: str
    index: int | None
    probability: Number | None
    margin: Number
    payload: Payload = Field(default=None, description="what else the task keeps of it; absent without")


class WorstVerified(VerifiedRate):
    """What fresh renders of the worst configuration say; a success is a wrong answer."""

    converged: bool = Field(description="whether the margin stood still with the samples")
    renders: int


class WorstConfiguration(Fields):
    """The configuration with the largest margin."""

    configuration: int = Field(description="its number")
    values: Annotated[dict[str, DescribedValue], having("object", "model")]
    seed: int
    label_set: list[str] = Field(description="the names that count as right there")
    claimed: WorstClaim
    verified: WorstVerified | None = Field(description="null where it was not rendered again")


class SweepSummary(CountedAnswers, RunResult):
    """How often the model is right over configurations that were not searched for."""

    command: ClassVar[str] = "sweep"

    object: str
    model: str
    task: str = Field(description="what judges the answers")
    image_formation: Formation | None
    planned: int = Field(description="how many configurations there are")
    not_finite: int = Field(description="answers that were not numbers; they count as not right")
    answers: dict[str, int] = Field(description="how often each wrong answer was given, the 20 most frequent")
    axes: list[AxisRow] = Field(description="a row for every value of every axis")
    cells: SweepMap | None = Field(
        description="over the first two axes with several values; null where there are fewer, or more than 4096 pairs"
    )
    worst: WorstConfiguration | None
    grid: dict[str, int] = Field(description="how many values each axis of the grid has")
    samples: int = Field(description="draws at each point of the grid")
    sampler: str | None = Field(description="of the draws; null without any")
    spp: int = Field(description="samples a pixel")
    renders: Annotated[dict[str, int], having("sweep")] = Field(
        description="of the sweep and of the verification; `products`: predicted instead"
    )
    transport: LinearTransport | None = Field(
        default=None,
        description="whether [basis pictures](transport.md#light) predicted pictures; absent where no light moves",
    )
    renders_per_second: float | None = Field(description="pictures of the sweep; null where nothing was rendered now")
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        """The accuracy."""
        return "" if self.accuracy is None else f"accuracy {self.accuracy:.1%}"
