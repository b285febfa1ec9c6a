"""The result of `sweep`, as `summary.json` stores it."""

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
    key_validator,
    make_fact_schema,
    optional_field,
)


class AxisRow(CountedPredictions):
    """Counts of the predictions with one value of an axis."""

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
    over: list[str] = Field(description="the other axes, over which the counts sum")
    configurations: list[list[int]]
    correct: list[list[int]]
    margin: list[list[JsonFloat | None]] = Field(
        description="mean margin in logits; null where no margin is known"
    )


class WorstClaim(Fields):
    """The prediction of the model in one picture of the worst configuration."""

    label: str
    index: int | None
    probability: JsonFloat | None
    margin: JsonFloat
    payload: Payload = optional_field("further output of the task; absent without any")


class WorstVerified(VerifiedRate):
    """The rate of wrong predictions in fresh renders of the worst configuration.

    A success is a wrong prediction.
    """

    converged: bool = Field(
        description="whether more samples no longer changed the sign of the margin"
    )
    renders: int


class WorstConfiguration(Fields):
    """The configuration with the smallest margin."""

    configuration: int = Field(description="number of the configuration")
    values: Annotated[
        dict[str, results.DescribedValue], key_validator("object", "model")
    ]
    seed: int
    label_set: list[str] = Field(description="the names that count as right")
    claimed: WorstClaim = Field(description="prediction in the picture of the sweep")
    verified: WorstVerified | None = Field(
        description="rate of wrong predictions in fresh renders; null if there are none"
    )
    pictured: WorstClaim | None = optional_field(
        "prediction in the picture that is stored; absent if none is stored"
    )


class SurfacePart(Fields):
    """A part of an object's surface, and predictions by whether it was visible."""

    face: int = Field(description="number of the triangle at the center of the part")
    u: float = Field(description="u of the center, across the map")
    v: float = Field(description="v of the center, up the map; 0 at the bottom")
    center: tuple[float, float, float] = Field(
        description="center in the coordinates of the mesh, z up"
    )
    visible: CountedPredictions = Field(description="pictures that show the part")
    hidden: CountedPredictions = Field(description="pictures that do not show it")
    difference: float = Field(
        description="fraction of wrong predictions where the part is visible, minus "
        "that where it is not"
    )
    interval: Interval = Field(
        description="95 % interval of the difference, for this part alone; null if "
        "pictures share a draw, such as frames of a drive"
    )
    p: float = Field(
        description="probability that by chance any part would differ at least as "
        "clearly"
    )


class SurfaceTable(Fields):
    """How predictions of one model depend on the visible surface of one object."""

    object: str
    model: str
    part: str = Field(description="kind of part: a `cell` of the map, or a `face`")
    unwrapped: bool = Field(
        description="whether the map was made for the sweep, and is not that of the "
        "object's texture"
    )
    visible: int = Field(description="number of parts that were visible in any picture")
    compared: int = Field(
        description="number of parts that were visible often enough and hidden often "
        "enough to be compared"
    )
    worse: int = Field(
        description="number of compared parts that go significantly with wrong "
        "predictions"
    )
    better: int = Field(
        description="number of compared parts that go significantly with right "
        "predictions"
    )
    strongest: list[SurfacePart] = Field(
        description="the parts with the clearest difference, none close to another; "
        "`worse` ones first"
    )


class SurfaceMap(Fields):
    """Which parts of the surface, when visible, go with wrong predictions."""

    file: str = Field(description="file with the counts, in the run directory")
    cells: int = Field(description="number of cells along each side of the map")
    min_pictures: int = Field(
        description="number of pictures with a part, and of pictures without it, that "
        "a comparison needs"
    )
    tables: list[SurfaceTable] = Field(
        description="a table for every object, model and kind of part"
    )


class PairedRates(Fields):
    """The predictions of a model without and with an adversarial scene.

    Configurations and noise are the same in both.
    """

    model: str
    clean: CountedPredictions = Field(
        description="predictions without the adversarial scene"
    )
    adversarial: CountedPredictions = Field(
        description="predictions with the adversarial scene"
    )
    both: int = Field(description="pairs that are right in both scenes")
    clean_only: int = Field(description="pairs that are right only in the clean scene")
    adversarial_only: int = Field(
        description="pairs that are right only in the adversarial scene"
    )
    neither: int = Field(description="pairs that are right in neither scene")
    difference: float = Field(
        description="accuracy with the adversarial scene minus that without"
    )
    interval: Interval = Field(
        description="95 % interval of the difference, of pairs; over draws if some "
        "pairs share one"
    )


class ArmComparison(Fields):
    """The clean scene and the adversarial scene of a run, with the same draws."""

    adversarial_run: str = Field(description="the run of the adversarial scene")
    pairs: list[PairedRates] = Field(description="the comparison for each model")


class OverDrives(Fields):
    """Statistics of a value over all drives."""

    mean: float = Field(description="mean over drives")
    interval: Interval | None = Field(
        description="95 % interval of the mean over drives; null for a single drive, "
        "or if the range of the value is unknown"
    )
    worst: float = Field(description="value of the worst drive")


class DriveRecord(Fields):
    """The predictions of a model along one drive."""

    row: int = Field(description="number of the row of the first frame")
    path: str | None = Field(
        description="name of the path; null if all drives have the same"
    )
    right: float = Field(description="fraction of frames in which the model is right")
    first_right: float | None = Field(
        description="distance at the first right frame; null without one"
    )
    longest_gap: float = Field(
        description="seconds of the longest run of frames in which the model is wrong"
    )
    flicker: float = Field(description="changes between right and wrong per second")


class TrackRates(Fields):
    """How a tracker follows the object by a detector's boxes along full drives."""

    tracker: str = Field(description="name of the tracker")
    lost: OverDrives = Field(
        description="fraction of the frames with the object in which no track is on it"
    )
    loose: OverDrives = Field(
        description="fraction of the frames with the object in which no track is on "
        "it, but one overlaps it loosely"
    )
    switches: OverDrives = Field(
        description="number of frames in which the track on the object has another "
        "number than before"
    )
    longest_gap: OverDrives = Field(
        description="seconds of the longest run of frames without a track on the object"
    )


class DriveRates(Fields):
    """The predictions of a model along full drives.

    Intervals are over drives, not over frames.
    """

    model: str
    adversarial_run: str | None = Field(
        description="the run whose adversarial scene is used; null for the clean scene"
    )
    drives: int = Field(description="number of drives with all their frames")
    repeats: int = Field(
        default=1,
        description="how often each drive was evaluated, with different noise; its "
        "values are means over the repeats",
    )
    frames: int = Field(description="number of frames of each drive")
    seconds: float = Field(description="seconds from the first frame to the last")
    right: OverDrives = Field(
        description="fraction of frames in which the model is right"
    )
    longest_gap: OverDrives = Field(
        description="seconds of the longest run of frames in which the model is wrong"
    )
    first_right: OverDrives | None = Field(
        description="distance at the first right frame, of drives that have one; "
        "`interval` is null if the range of distances does not follow from the settings"
    )
    unit: str = Field(default="object sizes", description="unit of that distance")
    never_right: int = Field(description="number of drives without a right frame")
    flicker: OverDrives = Field(
        description="changes between right and wrong per second"
    )
    tracks: TrackRates | None = optional_field(
        "results of a [tracker](drives.md#tracks) on the boxes; absent without a "
        "detector"
    )
    per_drive: list[DriveRecord] = Field(
        default=[], description="values of each of the first 1,000 drives"
    )


class ChangeRates(CountedPredictions):
    """The predictions of a model on changed images.

    `correct` counts the predictions that meet the claim.
    """

    model: str
    claim: str = Field(
        description="what the prediction has to do: `must_change` or `must_not_change`"
    )
    when: str = Field(description="how the picture was changed")
    row: int | None = Field(
        description="number of the first picture whose prediction does not meet the "
        "claim; null if all do"
    )


class SweepSummary(CountedPredictions, RunResult):
    """How often the model is right over configurations that were not searched for."""

    command: ClassVar[str] = "sweep"

    object: str
    model: str
    task: str = Field(description="the task that evaluates the predictions")
    image_formation: results.Formation | None
    planned: int = Field(description="number of configurations in the full sweep")
    out_of_view: int = Field(
        default=0,
        description="number of configurations with nothing of the object in the "
        "picture; `configurations` does not count them",
    )
    phantoms_out_of_view: int = Field(
        default=0,
        description="number of these in which a detector still finds the object; "
        "absent if there are none",
    )
    not_finite: int = Field(
        description="number of outputs that were not numbers; they do not count as "
        "right"
    )
    answers: dict[str, int] = Field(
        description="counts of the 20 most frequent wrong predictions"
    )
    axes: list[AxisRow] = Field(description="a row for every value of every axis")
    cells: SweepMap | None = Field(
        description="map over the first two axes with several values; null if there "
        "are fewer axes, or more than 4096 pairs of values"
    )
    arms: ArmComparison | None = optional_field(
        "the clean scene compared with [an adversarial "
        "one](sweeps.md#an-adversarial-scene-beside-the-clean-one); absent without one"
    )
    worst: WorstConfiguration | None
    drives: list[DriveRates] | None = optional_field(
        "rates over [full drives](drives.md); absent if no frames of a path are swept"
    )
    changes: list[ChangeRates] | None = optional_field(
        "predictions on [changed pictures](sweeps.md#is-it-looking); absent if not "
        "requested"
    )
    units: int | None = optional_field(
        "number of independent draws of the configurations, such as "
        "[drives](drives.md), over which the intervals are; absent if no "
        "configurations share a draw"
    )
    grid: dict[str, int] = Field(
        description="number of values of each axis of the grid"
    )
    gains: dict[str, float] | None = optional_field(
        "the gain of each scene, by object and environment; absent for a single scene"
    )
    drawn: dict[str, results.VariedValue] = Field(
        default={},
        description="what each value was sampled from, for parameters of few numbers",
    )
    samples: int = Field(description="number of draws at each point of the grid")
    sampler: str | None = Field(
        description="sampler of the draws; null if nothing is sampled"
    )
    spp: int = Field(description="samples per pixel")
    renders: Annotated[dict[str, int], key_validator("sweep")] = Field(
        description="number of pictures that were rendered for the sweep and for its "
        "verification; `products` are pictures that were predicted instead"
    )
    transport: results.LinearTransport | None = optional_field(
        "whether [basis pictures](transport.md#light) or [light on "
        "surfaces](surface-light.md#sweeps) predicted pictures; absent if neither "
        "light nor camera moves"
    )
    surface: SurfaceMap | None = optional_field(
        "which parts of the [surface](sweeps.md#the-surface), when visible, go with "
        "wrong predictions; absent if not requested"
    )
    shared: results.SharedWork | None = optional_field(
        "the [workers](cluster.md) that shared the work; absent without workers"
    )
    renders_per_second: float | None = Field(
        description="rendered pictures of the sweep per second; null if nothing was "
        "rendered now",
        json_schema_extra=make_fact_schema("{:.3g}"),
    )
    warnings: list[str] = Field(description="remarks that limit what the result shows")

    @property
    def looked_at(self) -> int:
        """Number of configurations with a prediction, also those out of view."""
        return self.configurations + self.out_of_view

    @property
    def outcome_summary(self) -> str:
        """The result in a few words."""
        if self.arms and self.arms.pairs:
            rates = self.arms.pairs[0]  # of the first model
            return (
                f"accuracy {rates.clean.accuracy:.1%}, {rates.adversarial.accuracy:.1%} "
                f"with {self.arms.adversarial_run}"
            )
        return (
            f"right in {self.correct} of {self.configurations}"
            if self.configurations
            else ""
        )
