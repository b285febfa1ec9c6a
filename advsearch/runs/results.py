"""What every result is made of: named fields, checked when they are put in, written as
JSON and read back.

And what several questions end with: studies, how derivatives are obtained, how long
light paths are, pictures.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    AliasChoices,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    JsonValue,
)
from pydantic.fields import ComputedFieldInfo, FieldInfo

from advsearch import registry
from advsearch.files import JsonObject

if TYPE_CHECKING:
    from typing_extensions import Self


SCHEMA = 2  # version of the fields of results
INTERRUPTED = "interrupted"  # endings of a run that can go on
OUT_OF_TIME = "out of time"
# how a result stands that is read while a process works on its run; none is kept so
RUNNING = "running"
# fields that are written last, in this order
LAST_FIELDS = ("warnings", "seconds", "seed", "command_line")

JsonFloat = Annotated[
    float, BeforeValidator(lambda value: math.nan if value is None else value)
]
"""A number that may be NaN or infinite: null in JSON, which is read as NaN."""

Interval = tuple[JsonFloat, JsonFloat]  # both ends of a 95 % interval


def key_validator(*names: str) -> AfterValidator:
    """Return a pydantic validator for mappings that must have all of these keys."""

    def check(values: Mapping[str, object]) -> Mapping[str, object]:
        missing = [name for name in names if name not in values]
        if missing:
            raise ValueError(f"expected {', '.join(missing)} among its names")
        return values

    return AfterValidator(check)


def as_fact(form: str = "{}") -> dict[str, JsonValue]:
    """Return the `json_schema_extra` of a field that terminal, page and notebook show
    under its name, as in

        speed: float | None = optional("pictures a second",
            json_schema_extra=as_fact("{:.3g}"))

    Args:
        form: how its value becomes a text.
    """
    return {"fact": form}


def optional_field(description: str, **more: Any) -> Any:
    """Return a field that is None, and then left out, by what it is; `more` as for
    `pydantic.Field`.
    """
    return Field(default=None, description=description, **more)


class Fields(BaseModel):
    """Named fields of a result.

    A field without a default is always there, if need be as null. One with a default is
    left out where it has it: it belongs to what was not asked for. Fields that a file
    has and the class has not are passed over.
    """

    model_config = ConfigDict(frozen=True, from_attributes=True, populate_by_name=True)

    @classmethod
    def from_values(cls, source: object) -> Self:
        """Return the fields with the values that the attributes, or the keys, of
        something have.
        """
        return cls.model_validate(source)

    @classmethod
    def described(cls) -> dict[str, FieldInfo | ComputedFieldInfo]:
        """Return the fields by name, and behind them those that are computed from
        others (`computed_field`).
        """
        return {**cls.model_fields, **cls.model_computed_fields}

    def to_dict(self) -> JsonObject:
        """Return the fields as JSON values; NaN and infinity are None."""
        values: JsonObject = to_json_value(
            self.model_dump(exclude_defaults=True, by_alias=True)
        )
        return values


class Result(Fields):
    """The result of a command."""

    command: ClassVar[str]

    def to_dict(self) -> JsonObject:
        return {"schema": SCHEMA, "command": self.command, **super().to_dict()}

    def facts(self) -> dict[str, str]:
        """Return the fields that are declared with `as_fact`, as texts by their names.

        Terminal, report and notebook show them. Fields that are None or NaN are left
        out.
        """
        facts = {}
        for name, field in self.described().items():
            extra = field.json_schema_extra
            value = getattr(self, name)
            if (
                isinstance(extra, dict)
                and "fact" in extra
                and value is not None
                and value == value  # not NaN
            ):
                # as_fact has a format, such as "{:.2f} s"
                facts[name.replace("_", " ")] = str(extra["fact"]).format(value)
        return facts

    @property
    def is_unfinished(self) -> bool:
        """Whether it has not come to its end: it is running, or was stopped and can be
        resumed.
        """
        return getattr(self, "ending", None) in (INTERRUPTED, OUT_OF_TIME, RUNNING)

    @property
    def brief(self) -> str:
        """What came out, in a few words; empty where there are none."""
        return ""


class Estimate(Fields):
    """An estimated number with its interval."""

    value: JsonFloat
    interval: Interval | None = Field(description="95 %; null where there is none")


IN_PHOTOGRAPH = "twin in the photograph"
"""Surroundings of twins that are composed over their photographs."""
WITHOUT_OBJECT = "photograph without the object"
"""Surroundings of the control without a twin."""


class TwinAgreement(Fields):
    """How far the predictions of renders hold for photographs of the same views.

    A twin is the render of an object as a photograph shows it.
    """

    model: str
    task: str
    surroundings: str = Field(
        description="what is around the object in the twins: "
        "`twin in the photograph`, the name of an environment, or, as a control, "
        "`photograph without the object`"
    )
    object: str = Field(description="empty: all of them")
    condition: str = Field(description="of the photographs; empty: all of them")
    pairs: int = Field(description="photographs with a twin")
    frames: int = Field(description="independent frames or scenes that they are of")
    wrong_photos: int
    wrong_twins: int
    both_wrong: int
    photo_right: Estimate
    twin_right: Estimate
    agreement: Estimate = Field(description="both right, or both wrong")
    kappa: Estimate | None = Field(
        description="Cohen's, of right and wrong; null where too few are wrong"
    )
    margins: Estimate | None = Field(
        description="Spearman's correlation of the margins; null where it has none"
    )
    boxes: Estimate | None = optional_field(
        "rate of boxes of the right class that overlap by half in photograph and twin, "
        "of pairs that have one in both; absent without"
    )
    photo_wrong: Estimate = Field(description="rate of wrong photographs")
    wrong_where_twin_wrong: Estimate | None = Field(
        description="rate of wrong photographs where the twin is wrong; null where "
        "too few twins are wrong"
    )


class TwinMatch(enum.Enum):
    """Whether a run of twins measured what a verdict is about."""

    MEASURED = "measured"
    OTHER_MODEL = "other model"
    OTHER_TASK = "other task"
    NOTHING = "nothing compared"


class TwinEvidence(Fields):
    """What a run of twins measured for the conditions nearest to those of a run."""

    run: str = Field(description="the run of twins")
    match: TwinMatch
    same_object: bool = Field(description="the row is of the object of this run")
    same_surroundings: bool = Field(
        description="the twins had the surroundings of this run"
    )
    row: TwinAgreement | None = Field(description="null where nothing was measured")


class RunResult(Result):
    """The result of a command that keeps a run."""

    run: str | None = Field(description="the folder; null if nothing was kept")
    environment: str
    controls: list[str]
    ending: str = Field(description="how it ended")
    seconds: Annotated[dict[str, JsonFloat], key_validator("total")] = Field(
        description="by part of the work, and in `total`"
    )
    seed: int = Field(description="the root seed")
    command_line: str | None = Field(
        description="the command that asks the same again; null where none does"
    )
    python_only: list[str] = Field(
        default=[],
        description="parts that existed only in Python, so that no command "
        "asks the same; absent without",
    )
    twins: TwinEvidence | None = optional_field(
        "how far verdicts hold for photographs, by the run of twins that was named; "
        "absent without"
    )

    def to_dict(self) -> JsonObject:
        """Return the fields as JSON values, what a reader looks for first in front."""
        values = super().to_dict()
        for name in LAST_FIELDS:
            if name in values:
                values[name] = values.pop(name)
        return values


Payload = Annotated[JsonValue, BeforeValidator(lambda value: to_json_value(value))]
"""What a task keeps of a prediction beside its words."""

Outcomes = dict[str, int] | None
"""How often each of `options.Outcome` came about, by its value."""

OUTCOME_TEXT = "[what becomes of the object](tasks.md#what-becomes-of-the-object)"
ONLY_OF_BOXES = "absent but for detection and segmentation"


class SceneResult(RunResult):
    """The result of a command about one object, one model and one task."""

    object: str
    model: str
    task: str = Field(description="what judges the predictions")


class MovedValue(Fields):
    """A value of the scene that a control leaves out, so that the clean scene has
    another.
    """

    parameter: str
    unit: str
    scene: float | str = Field(description="the value of the scene as it was described")
    used: float | str = Field(description="the value that the clean scene has instead")


class VariedValue(Fields):
    """What a value was drawn from by chance."""

    unit: str
    low: float | None = optional_field("the least; absent of names")
    high: float | None = optional_field("the most; absent of names")
    names: list[str] | None = optional_field(
        "of which one was drawn; absent of numbers"
    )


class CleanScene(Fields):
    """The scene that a search starts from."""

    moved: list[MovedValue] = Field(description="the values that had to move")


class Formation(Fields):
    """How radiance became pictures."""

    denoiser: str
    filter: str = Field(description="reconstruction filter of pixels")
    sampler: str = Field(description="sampler of pixels")
    exposure: float = Field(description="stops over the metered one")
    resolution: tuple[int, int] = Field(description="[height, width], pixels")
    gain: float | None = Field(
        description="from radiance to display-linear values; null where scenes have "
        "gains of their own"
    )


def to_json_value(value: Any) -> Any:
    """Return `value` with everything in it turned into what JSON has.

    Numbers and arrays of numpy and torch become Python's, dataclasses become mappings,
    NaN and infinity become None.

    Raises:
        TypeError: something in it has no JSON form.
    """
    if isinstance(value, enum.Enum):
        return to_json_value(value.value)
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Fields):
        return value.to_dict()
    if isinstance(value, Mapping):
        return {str(name): to_json_value(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json_value(inner) for inner in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: to_json_value(getattr(value, field.name))
            for field in dataclasses.fields(value)
        }
    # numbers and arrays of numpy and torch
    if hasattr(value, "tolist"):
        return to_json_value(value.tolist())
    raise TypeError(
        f"expected something that JSON can hold, got {type(value).__name__}"
    )


# a number, a name, or both ends of a part of a range
AxisValue = int | float | str | tuple[float, float]


class CountedPredictions(Fields):
    """Configurations, and in how many of them the model is right."""

    configurations: int = Field(description="how many were looked at")
    correct: int = Field(description="right predictions")
    accuracy: float | None = Field(
        description="their share; where some share a [draw](drives.md), the mean over "
        "draws of the share of each; null where there is no configuration"
    )
    interval: Interval | None = Field(
        description="of that share, 95 %; null where all are of one draw"
    )
    outcomes: Outcomes = optional_field(
        f"{OUTCOME_TEXT} in the other ones; {ONLY_OF_BOXES}"
    )


class ConditionRow(Fields):
    """A part of the values of one parameter."""

    parameter: str
    unit: str
    over: float | None = Field(
        description="values are larger; null without that bound, and for names"
    )
    at_most: float | None = Field(
        description="values are no larger; null without that bound, and for names"
    )
    options: list[str] = Field(description="the names it is about; empty for numbers")
    turn: float | None = optional_field(
        "degrees after which values count as the same, 180 or 360; `over` may then be "
        "over `at_most`: the part goes through 0. Null for other parts"
    )
    text: str


class Extent(Fields):
    """A count with the interval of its share."""

    what: str = Field(description="what was counted")
    count: int
    total: int = Field(alias="of")
    interval: Interval = Field(description="95 %, of the share")
    share: float | None = Field(
        default=None,
        description="the mean over draws of the share of each, where "
        "some share one; absent elsewhere",
    )
    # whether right predictions were counted, for a criterion of them; not stored
    counts_right: bool = Field(default=False, exclude=True)

    @classmethod
    def from_count(
        cls,
        what: str,
        count: int,
        total: int,
        interval: Interval | None,
        share: float | None = None,
        *,
        counts_right: bool = False,
    ) -> Extent:
        """Return a count with the interval of its share.

        Args:
            what: name of what is counted.
            count: number of cases in which it happened.
            total: number of all cases.
            interval: interval of the share; None is the whole of [0, 1].
            share: an estimate of the share; it is left out if it is count over total.
            counts_right: whether right predictions are counted.
        """
        is_known_from_counts = not total or share == count / total
        stated_share = None if is_known_from_counts else share
        return cls(
            what=what,
            count=count,
            total=total,
            interval=interval or (0.0, 1.0),
            share=stated_share,
            counts_right=counts_right,
        )


class StudyResult(RunResult):
    """What several attacks found; each is a run of its own in the folder `parts`."""

    objects: list[str]
    model: str
    task: str = Field(description="what judges the predictions")
    policy: str
    parts: list[str] = Field(description="the attacks in the folder `parts`")
    warnings: list[str] = Field(description="sentences that a reader has to know")


GradientStatus = Literal["ok", "biased", "noisy", "reference unusable"]


class GroupDerivative(Fields):
    """How the derivative of one parameter is obtained."""

    control: str
    parameter: str
    size: int = Field(description="how many numbers it has")
    estimator: str
    valid: list[str] = Field(description="the estimators that are valid")
    step: float = Field(description="half-width of a difference in u")
    step_reason: str = Field(description="why it is as wide; empty where none is taken")
    reason: str = Field(description="why this estimator")
    variance_x_seconds: dict[str, JsonFloat] = Field(
        description="squared error x time of each estimator that was measured"
    )
    step_in_unit: float | None = Field(
        description="the step in `unit`; null where that is no single number"
    )
    unit: str

    @property
    def name(self) -> str:
        return f"{self.control}.{self.parameter}"


class PlannedGradient(Fields):
    """How every derivative is obtained."""

    renders_per_gradient: int = Field(
        description="beside the picture itself; adjoints are not counted"
    )
    spp: int | None = Field(
        description="samples a pixel of differences; null: that of the search"
    )
    groups: list[GroupDerivative]


class PathCut(Fields):
    """What paths of at most so many segments leave out, the worst over the
    configurations looked at.
    """

    depth: int = Field(description="longest path in segments")
    light: float = Field(description="share of the radiance that is missing")
    levels: float = Field(
        description="root-mean-square bias of the displayed picture in 8-bit levels"
    )


class PathLength(Fields):
    """The longest light path of the search, and why."""

    depth: int = Field(description="of the search, in segments")
    full: int = Field(description="of the verification")
    cuts: list[PathCut] = Field(description="what was measured, longest paths first")
    configurations: int = Field(description="how many the measurement looked at")
    reason: str


class Measured(Fields):
    """A picture, a margin, a gradient or a derivative beside its reference, which took
    far more renders.

    Errors and noise are relative to the size of the reference. What was not measured is
    absent.
    """

    quantity: str = Field(
        description="`picture`, `margin` of the model, `gradient` of a control, or "
        "`derivative` along a parameter"
    )
    control: str = Field(default="", description="whose gradient")
    parameter: str = Field(default="", description="along which the derivative is")
    estimator: str = Field(
        description="what computes it: a sampler, or an estimator of derivatives"
    )
    factor: float = Field(default=1.0, description="step as a multiple of the plan's")
    spp: int = Field(description="samples a pixel")
    repeats: int = Field(
        description="how often it was computed, each time with other noise"
    )
    seconds: float = Field(description="of one, median")
    status: GradientStatus = Field(description="whether it agrees with its reference")
    error: JsonFloat | None = optional_field(
        "of one, root mean square; an upper limit where the reference is unusable"
    )
    interval: Interval | None = optional_field("of `error`")
    bias: JsonFloat | None = optional_field("error of the mean")
    doubt: JsonFloat | None = optional_field("how much of `bias` the noise explains")
    noise: JsonFloat | None = optional_field("standard deviation of one")
    cosine: JsonFloat | None = optional_field("of a gradient with its reference, mean")
    value: JsonFloat | None = optional_field("of a derivative, mean")
    reference: JsonFloat | None = optional_field("what `value` should be")
    reference_error: JsonFloat | None = optional_field("the reference's own")
    reference_cosine: JsonFloat | None = optional_field(
        "smallest of two converged gradients, of which the reference is the mean"
    )

    @property
    def name(self) -> str:
        """``control.parameter``, or what there is of it; else the quantity."""
        return ".".join(filter(None, (self.control, self.parameter))) or self.quantity

    @property
    def excess(self) -> float:
        """What of the bias noise does not explain."""
        return max(0.0, (self.bias or 0.0) - (self.doubt or 0.0))


class ClassPrediction(Fields):
    """One prediction of a picture."""

    label: str = Field(description="in words")
    index: int | None = Field(
        description="its number among the model's classes; null where there are none"
    )
    probability: float | None = Field(description="null where the model gives none")


class VisibleThing(Fields):
    """What a picture shows of the object, or of a thing beside it."""

    label: str | None = Field(description="what a model should call it")
    box: tuple[int, int, int, int] | None = Field(
        description="the smallest round what is seen of it, [x0, y0, x1, y1] in "
        "pixels; null where nothing is"
    )
    pixels: int = Field(description="in which it is what is seen first")
    share: float | None = Field(
        description="of all that there would be of it if nothing stood before it and "
        "the picture went on, 0 to 1; null where it is not known"
    )
    truncated: bool | None = Field(
        description="whether it goes on beyond the picture; null where it is not known"
    )
    distance: float | None = Field(
        description="of the nearest point that is seen from the camera, metres"
    )


class ViewPredictions(Fields):
    """What the model says of one view."""

    azimuth: float = Field(description="of the camera, degrees")
    answers: list[ClassPrediction] = Field(
        validation_alias=AliasChoices("answers", "predictions"),
        description="the likeliest first",
    )
    things: dict[str, VisibleThing] | None = optional_field(
        "what is seen of `object` and of each thing beside it; absent without any"
    )


class MeshUp(Fields):
    """The axis of a mesh file that was taken for up, and why."""

    axis: str
    reason: str


class RenderResult(Result):
    """A picture of a scene, and what the model says of it."""

    command: ClassVar[str] = "render"

    out: str = Field(description="the file that was written")
    answered: str | None = optional_field(
        "that with boxes and masks drawn in; absent where the task draws none"
    )
    size: tuple[int, int] = Field(description="of the file, [height, width] in pixels")
    object: str
    environment: str
    model: str
    task: str = Field(description="what judges the predictions")
    spp: int = Field(description="samples a pixel")
    image_formation: Formation
    up: MeshUp | None = Field(description="null for an object without a mesh file")
    views: list[ViewPredictions]
    warnings: list[str] = Field(description="sentences that a reader has to know")


class DescribedValue(Fields):
    """One value of a configuration, with its unit."""

    value: int | float | str | list[float]
    unit: str


class ControlGroup(Fields):
    """Trials of the clean scene: how many are right."""

    correct: int
    trials: int
    rate: float
    interval: Interval
    not_a_number: int = Field(
        default=0, description="trials whose output is NaN or infinity; absent without"
    )
    outcomes: Outcomes = optional_field(
        f"{OUTCOME_TEXT} in those that are not right; {ONLY_OF_BOXES}"
    )


class VerifiedRate(Fields):
    """Trials with fresh seeds, and how many of them are a success."""

    successes: int
    trials: int = Field(
        description="that count: over conditions that vary, those "
        "whose clean scene is right"
    )
    rate: float
    interval: Interval
    spp: int = Field(description="samples a pixel")
    labels: dict[str, int] = Field(
        description="predictions of the successes, and how often each was given"
    )
    outcomes: Outcomes = optional_field(
        f"{OUTCOME_TEXT} in the successes; {ONLY_OF_BOXES}"
    )
    margin: JsonFloat = Field(
        description="mean over these trials, below 0 in a success, in logits; of a "
        "detector in log-odds"
    )
    not_a_number: int = Field(
        default=0, description="trials whose output is NaN or infinity; absent without"
    )
    stopped: str | None = optional_field(
        "why there are no more: `asked for` (as many as were) or `decided` (the "
        "verdict stands); absent of trials that are no verdict"
    )


class AverageCase(Fields):
    """Configurations drawn from the whole space and budget."""

    configurations: int
    correct: int = Field(description="how many the model got right")
    accuracy: float
    interval: Interval
    margin: JsonFloat = Field(description="the mean, in logits")
    worst_margin: JsonFloat = Field(description="the smallest, in logits")


class PredictionError(Fields):
    """How far predicted pictures were from traced ones, at the last comparison."""

    levels: JsonFloat = Field(
        description="of 255, over the object's pixels (of a crop, over those outside), "
        "root mean square"
    )
    margin_bias: JsonFloat = Field(
        description="of the margin, the mean over the pictures that were compared"
    )


class BankOfConditions(Fields):
    """The conditions that matrices were made for."""

    created: int = Field(description="how many")
    dropped: int = Field(description="of them made room for newer ones")
    grown: int = Field(
        description="comparisons with unseen conditions after which "
        "there had to be more"
    )
    gap: float | None = Field(
        description="objective under them over that under unseen "
        "ones, at the last comparison"
    )


class LinearTransport(Fields):
    """What predicted the pictures of the searches."""

    used: bool
    method: str | None = optional_field(
        "by what: `matrix`, `basis pictures` (of a sweep), `surface light`, or `crop`, "
        "which renders a part of each picture"
    )
    reason: str | None = optional_field(
        "why pictures were rendered, all or from some evaluation on, or not predicted "
        "by surface light"
    )
    crop: str | None = optional_field("why whole pictures were rendered")
    window: tuple[int, int, int, int] | None = optional_field(
        "the part of the picture that was traced: top, left, height and width"
    )
    conditions: BankOfConditions | None = optional_field("with `over`")
    entries: int | None = optional_field("of the matrix")
    bytes: int | None = optional_field("of its memory")
    seconds: float | None = optional_field("that it and the comparisons took")
    renewed: int | None = optional_field("how often it was made again")
    error: PredictionError | None = optional_field("of the last comparison")


class PrintTerms(Fields):
    """How far colours are from what can be printed, without weights, summed over
    textures and patches.
    """

    variation: float = Field(
        description="mean length of the step from a pixel to its neighbours, in sRGB"
    )
    off_print: float = Field(
        description="mean distance in sRGB from the nearest printable colour"
    )


class SharedWork(Fields):
    """How the workers did that shared the work, in this sitting."""

    max_running: int = Field(description="workers that had work at once, at most")
    lost: int = Field(description="that died or went away")
    refused: int = Field(description="that could not do it")
    retried: int = Field(description="batches that this process gave out again")
    batches: int = Field(description="batches that came back")
    busy: JsonFloat = Field(description="seconds that workers were at batches")
    loading: JsonFloat = Field(description="seconds that they loaded scenes and models")
    alive: JsonFloat = Field(
        description="seconds that they were there and did not load"
    )
    utilisation: JsonFloat | None = Field(description="`busy` over `alive`")
    machines: dict[str, dict[str, str]] = Field(
        description="what rows call by a name, where machines are not alike"
    )

    @classmethod
    def of_facts(
        cls, facts: Any, machines: Mapping[str, Mapping[str, str]]
    ) -> SharedWork | None:
        """Return how workers shared a run; None where there were none.

        Args:
            facts: the `cluster.WorkerStats` of the run, or None.
            machines: machines that differ from this one, by name.
        """
        if facts is None:
            return None
        # times of different clocks may give a little over 1
        share = min(1.0, facts.busy / facts.alive) if facts.alive else None
        return cls.model_validate(
            {**vars(facts), "utilisation": share, "machines": machines}
        )


def kind_of(values: JsonObject) -> type[Result] | None:
    """Return the class of the result in a `summary.json`.

    An experiment may have several kinds of results besides the main one. Each of these
    has a field that no other kind has.

    Args:
        values: content of the file; its "command" names the experiment.

    Returns:
        The class; None if there is no such experiment.
    """
    command = str(values.get("command"))
    if command not in registry.EXPERIMENTS:
        return None
    experiment = registry.get_experiment(command)
    candidates: dict[str, type[Result]] = dict(experiment.other_results)
    main_type: type[Result] = experiment.result
    return next(
        (result_type for field, result_type in candidates.items() if field in values),
        main_type,
    )
