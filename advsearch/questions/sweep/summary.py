"""The result of `sweep`: what `summary.json` holds of it."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from advsearch.runs import results
from advsearch.runs.results import (
    AxisValue,
    CountedPredictions,
    Fields,
    Interval,
    JsonFloat,
    Payload,
    RunResult,
    VerifiedRate,
    as_fact,
    key_validator,
    optional_field,
)


class AxisRow(CountedPredictions):
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
    margin: list[list[JsonFloat | None]] = Field(
        description="the mean, in logits; null where there is none"
    )


class WorstClaim(Fields):
    """What the model says of one picture of the worst configuration."""

    label: str
    index: int | None
    probability: JsonFloat | None
    margin: JsonFloat
    payload: Payload = optional_field("what else the task keeps of it; absent without")


class WorstVerified(VerifiedRate):
    """The rate of wrong predictions in fresh renders of the worst configuration.

    A success is a wrong prediction.
    """

    converged: bool = Field(
        description="whether the margin stood still with the samples"
    )
    renders: int


class WorstConfiguration(Fields):
    """The configuration with the smallest margin."""

    configuration: int = Field(description="its number")
    values: Annotated[
        dict[str, results.DescribedValue], key_validator("object", "model")
    ]
    seed: int
    label_set: list[str] = Field(description="the names that count as right there")
    claimed: WorstClaim = Field(description="of the sweep's own picture")
    verified: WorstVerified | None = Field(
        description="null where it was not rendered again"
    )
    pictured: WorstClaim | None = optional_field(
        "of the picture that is kept; absent without"
    )


class SurfacePart(Fields):
    """A part of an object's surface, and the predictions by whether it was seen."""

    face: int = Field(description="number of the triangle in its middle")
    u: float = Field(description="its middle, across the map")
    v: float = Field(description="its middle, up the map, whose bottom row is 0")
    center: tuple[float, float, float] = Field(
        description="its middle, in the mesh's coordinates, z up"
    )
    visible: CountedPredictions = Field(description="pictures that see it")
    hidden: CountedPredictions = Field(description="the other ones")
    difference: float = Field(
        description="share of wrong predictions where it is "
        "seen, less that where it is not"
    )
    interval: Interval = Field(
        description="of that difference, 95 %, for the part by itself; null where "
        "pictures share a draw, as frames of "
        "a drive do"
    )
    p: float = Field(
        description="how likely it is that by chance any part stands out as far"
    )


class SurfaceTable(Fields):
    """What goes with wrong predictions on the surface of one object, for one model."""

    object: str
    model: str
    part: str = Field(description="what is counted: a `cell` of the map, or a `face`")
    unwrapped: bool = Field(
        description="whether the map is a new one, and not that of the object's texture"
    )
    visible: int = Field(description="how many were seen at all")
    compared: int = Field(
        description="how many were seen often enough, and hidden often enough"
    )
    worse: int = Field(
        description="how many of these go with wrong predictions, told from chance"
    )
    better: int = Field(description="likewise, with right predictions")
    strongest: list[SurfacePart] = Field(
        description="those told most clearly, none close to another; `worse` ones first"
    )


class SurfaceMap(Fields):
    """Which parts of the surface, when seen, go with wrong predictions."""

    file: str = Field(description="the counts, in the folder")
    cells: int = Field(description="along each side of the map")
    min_pictures: int = Field(
        description="pictures with and without a part that a comparison takes"
    )
    tables: list[SurfaceTable] = Field(
        description="for every object, model and kind of part"
    )


class PairedRates(Fields):
    """The predictions of a model without and with an adversarial scene.

    Configurations and noise are the same in both.
    """

    model: str
    clean: CountedPredictions = Field(description="without the adversarial scene")
    adversarial: CountedPredictions = Field(description="with it")
    both: int = Field(description="pairs that are right in both")
    clean_only: int = Field(description="pairs that are right without it alone")
    adversarial_only: int = Field(description="pairs that are right with it alone")
    neither: int = Field(description="pairs that are right in none")
    difference: float = Field(
        description="accuracy with the adversarial scene less that without"
    )
    interval: Interval = Field(
        description="of that difference, 95 %, of pairs, over "
        "draws where some share one"
    )


class ArmComparison(Fields):
    """The clean scene and the adversarial one of a run under the same draws."""

    adversarial_run: str = Field(description="the run")
    pairs: list[PairedRates] = Field(description="for each model")


class OverDrives(Fields):
    """A value of each drive, over all drives."""

    mean: float = Field(description="over drives")
    interval: Interval | None = Field(
        description="of the mean, 95 %, over drives; null of one, or where the range "
        "is not known beforehand"
    )
    worst: float = Field(description="of the worst drive")


class DriveRecord(Fields):
    """What a model says along one drive."""

    row: int = Field(description="number of its first frame among the rows")
    path: str | None = Field(
        description="its path; null where all drives have the same"
    )
    right: float = Field(description="share of frames in which the model is right")
    first_right: float | None = Field(
        description="distance at the first of these; null without one"
    )
    longest_gap: float = Field(
        description="seconds of the longest run of frames in which it is not"
    )
    flicker: float = Field(description="changes between right and wrong a second")


class TrackRates(Fields):
    """What a tracker makes of a detector's boxes along whole drives."""

    tracker: str = Field(description="its name")
    lost: OverDrives = Field(
        description="share of the frames that see the object in which no track is on it"
    )
    loose: OverDrives = Field(
        description="likewise, in which none fits it, but a loose one is on it"
    )
    switches: OverDrives = Field(
        description="how often the track on it has another number than before"
    )
    longest_gap: OverDrives = Field(
        description="seconds of the longest run of frames without its track"
    )


class DriveRates(Fields):
    """The predictions of a model along full drives.

    Intervals are over drives, not over frames.
    """

    model: str
    adversarial_run: str | None = Field(
        description="the adversarial scene of a run; null without"
    )
    drives: int = Field(description="how many there are with all their frames")
    repeats: int = Field(
        default=1,
        description="how often each was looked at, with other noise; its "
        "numbers are the mean of these",
    )
    frames: int = Field(description="of each drive")
    seconds: float = Field(description="from the first frame to the last")
    right: OverDrives = Field(description="share of frames in which the model is right")
    longest_gap: OverDrives = Field(
        description="seconds of the longest run of frames in which it is not"
    )
    first_right: OverDrives | None = Field(
        description="distance at the first frame in which it is right, of drives that "
        "have one; `interval` is null "
        "where the plan does not say between which distances drives are"
    )
    unit: str = Field(default="object sizes", description="of that distance")
    never_right: int = Field(description="drives without a frame in which it is right")
    flicker: OverDrives = Field(description="changes between right and wrong a second")
    tracks: TrackRates | None = optional_field(
        "what a [tracker](drives.md#tracks) makes of the boxes; absent without a "
        "detector"
    )
    per_drive: list[DriveRecord] = Field(
        default=[], description="the numbers of each drive, the first 1,000"
    )


class ChangeRates(CountedPredictions):
    """The predictions of a model on changed images.

    `correct` are those that are as claimed.
    """

    model: str
    claim: str = Field(
        description="`must_change`, or `must_not_change`: what the model says"
    )
    when: str = Field(description="what was changed")
    row: int | None = Field(
        description="number of the first picture in which it is "
        "not as claimed; null without one"
    )


class SweepSummary(CountedPredictions, RunResult):
    """How often the model is right over configurations that were not searched for."""

    command: ClassVar[str] = "sweep"

    object: str
    model: str
    task: str = Field(description="what judges the predictions")
    image_formation: results.Formation | None
    planned: int = Field(description="how many configurations there are")
    out_of_view: int = Field(
        default=0,
        description="configurations with nothing of the object in the picture; "
        "`configurations` is without them",
    )
    phantoms_out_of_view: int = Field(
        default=0,
        description="of these, in how many a detector finds the object all "
        "the same; absent without",
    )
    not_finite: int = Field(
        description="outputs that were not numbers; they count as not right"
    )
    answers: dict[str, int] = Field(
        description="how often each wrong prediction was given, the 20 most frequent"
    )
    axes: list[AxisRow] = Field(description="a row for every value of every axis")
    cells: SweepMap | None = Field(
        description="over the first two axes with several values; null where there are "
        "fewer, or more than 4096 pairs"
    )
    arms: ArmComparison | None = optional_field(
        "the clean scene beside [an adversarial "
        "one](sweeps.md#an-adversarial-scene-beside-the-clean-one); absent without"
    )
    worst: WorstConfiguration | None
    drives: list[DriveRates] | None = optional_field(
        "of [whole drives](drives.md); absent where no frames of a path are swept"
    )
    changes: list[ChangeRates] | None = optional_field(
        "of [pictures that are also shown changed](sweeps.md#is-it-looking); absent "
        "unless asked"
    )
    units: int | None = optional_field(
        "draws that the configurations are of, such as [drives](drives.md), and "
        "intervals over; absent "
        "where none share one"
    )
    grid: dict[str, int] = Field(
        description="how many values each axis of the grid has"
    )
    gains: dict[str, float] | None = optional_field(
        "the gain of each scene, by object and environment; absent of one scene"
    )
    drawn: dict[str, results.VariedValue] = Field(
        default={},
        description="what each value was drawn from, of parameters of few numbers",
    )
    samples: int = Field(description="draws at each point of the grid")
    sampler: str | None = Field(description="of the draws; null without any")
    spp: int = Field(description="samples a pixel")
    renders: Annotated[dict[str, int], key_validator("sweep")] = Field(
        description="of the sweep and of the verification; `products`: predicted "
        "instead"
    )
    transport: results.LinearTransport | None = optional_field(
        "whether [basis pictures](transport.md#light) or [light on "
        "surfaces](surface-light.md#sweeps) "
        "predicted pictures; absent where neither light nor camera moves"
    )
    surface: SurfaceMap | None = optional_field(
        "which parts of the [surface](sweeps.md#the-surface), when seen, go with wrong "
        "predictions; absent unless asked"
    )
    shared: results.SharedWork | None = optional_field(
        "how [workers](cluster.md) did that shared the work; absent without"
    )
    renders_per_second: float | None = Field(
        description="pictures of the sweep; null where nothing was rendered now",
        json_schema_extra=as_fact("{:.3g}"),
    )
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def looked_at(self) -> int:
        """Configurations with a prediction, also those out of view."""
        return self.configurations + self.out_of_view

    @property
    def brief(self) -> str:
        """The result in a few words."""
        if self.arms and self.arms.pairs:
            rates = self.arms.pairs[0]
            return (
                f"accuracy {rates.clean.accuracy:.1%}, {rates.adversarial.accuracy:.1%} "
                f"with {self.arms.adversarial_run}"
            )
        return (
            f"right in {self.correct} of {self.configurations}"
            if self.configurations
            else ""
        )
