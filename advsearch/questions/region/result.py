"""The settings and the result of `region`, and its view."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, ClassVar

from pydantic import Field

from advsearch.extend import (
    AttackConfig,
    SceneConfig,
    results,
    setting,
    setting_as_in,
    views,
    wording,
)

MIN_SAMPLES = 8
"""With fewer samples, not even a box without exceptions has one verdict in more than
half of it, at the confidence of `questions.region.boxes.GrownBox.interval`.
"""


class RegionConfig(SceneConfig):
    """The settings of `region`: a box in which the verdict does not change."""

    command: ClassVar[str] = "region"
    excluded_settings: ClassVar[tuple[str, ...]] = ("spp",)

    around: str | None = setting(
        None,
        "region",
        "a run whose adversarial configuration is the centre; its scene, model and "
        "controls are used",
        "the name or the folder of a run",
        otherwise="the clean scene",
    )
    vary: str | None = setting(
        None,
        "region",
        "the parameters in which the box grows, separated by commas",
        "names such as pose.yaw,camera.elevation",
        otherwise="all parameters that the controls search, up to eight",
    )
    samples: int = setting(
        200,
        "region",
        "fresh samples that check the box",
        unit="renders",
        ge=MIN_SAMPLES,
        le=1_000_000,
    )
    map: int = setting(
        0,
        "region",
        "side of the map of the margin, for two parameters; 0 for no map",
        unit="points",
        ge=0,
        le=512,
    )
    specialise: bool = setting_as_in(
        AttackConfig,
        "specialise",
        group="region",
        description="predict pictures from new viewpoints while the box grows, and "
        "those of the map",
        switched="render every picture",
    )
    verify_spp: int | None = setting_as_in(
        AttackConfig, "verify_spp", group="region", description="samples per pixel"
    )


class AxisRange(results.Fields):
    """A parameter and its range on an axis."""

    name: str
    unit: str
    low: float
    high: float


class BoxSide(AxisRange):
    """A parameter and its range in which the verdict does not change."""

    centre: float = Field(description="the value that the box grew around")


class MarginMap(results.Fields):
    """The margin on a grid over two parameters."""

    axes: tuple[AxisRange, AxisRange]
    margins: list[list[results.JsonFloat]] = Field(
        description="margins in logits; a row for each value of the second parameter, "
        "from its lowest value"
    )


class GrownRegion(results.Fields):
    """A region in which the verdict does not change; all null after an interrupt."""

    verdict: str | None = Field(
        default=None, description="verdict at the centre, `right` or `wrong`"
    )
    box: list[BoxSide] | None = Field(
        default=None, description="the range of each parameter"
    )
    n_same: int | None = Field(
        default=None, description="fresh samples of the box with the same verdict"
    )
    samples: int | None = Field(
        default=None, description="number of fresh samples of the box"
    )
    rate: float | None = Field(default=None, description="`n_same` / `samples`")
    interval: results.Interval | None = Field(
        default=None, description="95 % interval of the rate"
    )
    volume: float | None = Field(
        default=None,
        description="volume of the box, as a fraction of that of the full ranges",
    )
    spp: int | None = Field(default=None, description="samples per pixel")
    map: MarginMap | None = Field(
        default=None,
        description="the margin over two parameters; null without the setting `map`",
    )


class RegionResult(views.InNotebook, GrownRegion, results.SceneResult):
    """The box around a configuration in which the verdict does not change."""

    command: ClassVar[str] = "region"

    image_formation: results.Formation
    clean: results.CleanScene
    warnings: list[str] = Field(description="sentences that a reader has to know")
    transport: results.LinearTransport | None = Field(
        default=None,
        description="how pictures from new viewpoints were predicted, or why they were "
        "not; null if no camera moves",
    )
    renders: Annotated[dict[str, int], results.key_validator("verification")] = Field(
        description="number of all rendered pictures (`verification`) and of all "
        "predicted ones (`products`)"
    )

    @property
    def outcome_summary(self) -> str:
        """The result in a few words."""
        return (
            f"{self.verdict} in {self.n_same} of {self.samples} samples of the box"
            if self.samples
            else ""
        )


BOX_COLUMNS: Mapping[str, views.Column] = {
    "parameter": "{0.name}",
    "from": "{0.low:.4g}",
    "to": "{0.high:.4g}",
    "centre": "{0.centre:.4g}",
    "unit": "{0.unit}",
}


def make_region_view(result: RegionResult) -> views.ShownResult:
    """Return the view of a region."""
    if result.box is None or result.interval is None:
        return views.ShownResult("Stopped before the box was known.")
    return views.ShownResult(
        f"The model is {result.verdict} in {result.n_same} of {result.samples} fresh "
        "samples of this box: with 95 % "
        f"confidence in at least {wording.percent(result.interval[0])} of it.",
        [views.ResultPart.make_table(result.box, BOX_COLUMNS, title="The box")],
        {
            "share of the space": wording.percent(result.volume),
            "samples a pixel": str(result.spp or ""),
        },
    )


def make_region_claims(result: RegionResult) -> Iterator[views.Claim]:
    """Yield the claim about the box, if the box is known."""
    # An interrupted run has no box.
    if (
        not result.samples
        or result.n_same is None
        or result.interval is None
        or result.verdict is None
    ):
        return
    extent = results.Extent.from_count(
        f"samples that are {result.verdict}",
        result.n_same,
        result.samples,
        result.interval,
        counts_right=result.verdict == "right",
    )
    yield views.Claim(
        kind="measured", statement=_make_statement(result, extent), extent=extent
    )


def _make_statement(result: RegionResult, extent: results.Extent) -> str:
    """State in how much of which box the verdict stays."""
    sides = [
        f"{side.name} {side.low:.4g} to {side.high:.4g} {side.unit}".strip()
        for side in result.box or ()
    ]
    box = ", ".join(sides) or "the box"
    inside = f"{wording.format_extent(extent)} samples drawn evenly from it"
    return (
        f"Inside {box} the model is {result.verdict} in {inside}. Certified by "
        "sampling: single points of it may "
        "differ."
    )
