"""Base classes of results, and parts of results that several experiments share.

A result has named fields, which are validated, written as JSON and read back. Shared
parts are about studies, derivatives, the length of light paths and images, for example.
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
# Statuses (`ending`) of a run that can be resumed.
INTERRUPTED = "interrupted"
OUT_OF_TIME = "out of time"
# Status of a result that is read while a process works on its run. It is never stored.
RUNNING = "running"
# Fields that are written after all others, in this order.
LAST_FIELDS = ("warnings", "seconds", "seed", "command_line")

JsonFloat = Annotated[
    float, BeforeValidator(lambda value: math.nan if value is None else value)
]
"""A number that may be NaN or infinite. In JSON it is null then, which is read as NaN.
"""

Interval = tuple[JsonFloat, JsonFloat]  # lower and upper bound of a 95 % interval


def key_validator(*names: str) -> AfterValidator:
    """Return a pydantic validator for mappings that must have all of these keys."""

    def check(values: Mapping[str, object]) -> Mapping[str, object]:
        missing = [name for name in names if name not in values]
        if missing:
            raise ValueError(f"expected {', '.join(missing)} among its names")
        return values

    return AfterValidator(check)


def make_fact_schema(form: str = "{}") -> dict[str, JsonValue]:
    """Return the `json_schema_extra` of a field that terminal, page and notebook
    display with its name.

    An example is

        speed: float | None = optional_field("pictures a second",
            json_schema_extra=make_fact_schema("{:.3g}"))

    Args:
        form: format of its value as text, for `str.format`.
    """
    return {"fact": form}


def optional_field(description: str, **more: Any) -> Any:
    """Return a field whose default is None, and which is left out of JSON if it is
    None.

    Args:
        description: description of the field.
        **more: other arguments of `pydantic.Field`.
    """
    return Field(default=None, description=description, **more)


class Fields(BaseModel):
    """The base class of results and their parts, which have named fields.

    In JSON, a field without a default is always present, perhaps as null. A field with
    a default is left out if it has that value: then it belongs to something that was
    not requested. Unknown fields in a file are ignored.
    """

    model_config = ConfigDict(frozen=True, from_attributes=True, populate_by_name=True)

    @classmethod
    def from_values(cls, source: object) -> Self:
        """Return an instance with the values of an object's attributes, or of a
        mapping.
        """
        return cls.model_validate(source)

    @classmethod
    def get_described_fields(cls) -> dict[str, FieldInfo | ComputedFieldInfo]:
        """Return the fields by name, and after them those that are computed from others
        (`computed_field`).
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
        """Return the fields that are declared with `make_fact_schema`, as texts by name.

        Terminal, report and notebook display them. Fields that are None or NaN are left
        out.
        """
        facts = {}
        for name, field in self.get_described_fields().items():
            extra = field.json_schema_extra
            if not isinstance(extra, dict) or "fact" not in extra:
                continue
            # `make_fact_schema` has stored a format, such as "{:.2f} s"
            value_format = str(extra["fact"])
            value = getattr(self, name)
            is_nan = value != value
            if value is not None and not is_nan:
                facts[name.replace("_", " ")] = value_format.format(value)
        return facts

    @property
    def is_unfinished(self) -> bool:
        """Whether the run has not come to its end: it is running, or was stopped and
        can be resumed.
        """
        return getattr(self, "ending", None) in (INTERRUPTED, OUT_OF_TIME, RUNNING)

    @property
    def outcome_summary(self) -> str:
        """The result in a few words; empty if the class has no such text."""
        return ""


class Estimate(Fields):
    """An estimate with its confidence interval."""

    value: JsonFloat
    interval: Interval | None = Field(
        description="95 % confidence interval; null if there is none"
    )


IN_PHOTOGRAPH = "twin in the photograph"
"""Surroundings of twins (renders) that are composed over their photographs."""
WITHOUT_OBJECT = "photograph without the object"
"""Surroundings of the comparison with photographs without the object, as a control."""


class TwinAgreement(Fields):
    """How well predictions for renders agree with those for photographs.

    A twin is a render of an object in the pose in which a photograph shows it.
    """

    model: str
    task: str
    surroundings: str = Field(
        description="surroundings of the object in the twins: "
        "`twin in the photograph`, the name of an environment, or, as a control, "
        "`photograph without the object`"
    )
    object: str = Field(description="name of the object; empty for all objects")
    condition: str = Field(
        description="condition of the photographs; empty for all photographs"
    )
    pairs: int = Field(description="number of photographs with a twin")
    frames: int = Field(
        description="number of independent frames or scenes that the photographs show"
    )
    wrong_photos: int
    wrong_twins: int
    both_wrong: int
    photo_right: Estimate
    twin_right: Estimate
    agreement: Estimate = Field(
        description="rate of pairs in which both are right, or both are wrong"
    )
    kappa: Estimate | None = Field(
        description="Cohen's kappa of right and wrong; null if too few are wrong"
    )
    margins: Estimate | None = Field(
        description="Spearman's correlation of the margins; null if it is undefined"
    )
    boxes: Estimate | None = optional_field(
        "rate of pairs whose boxes of the right class overlap by half, of all pairs "
        "with such a box in both; absent if there are none"
    )
    photo_wrong: Estimate = Field(description="rate of wrong photographs")
    wrong_where_twin_wrong: Estimate | None = Field(
        description="rate of wrong photographs if the twin is wrong; null if too few "
        "twins are wrong"
    )


class TwinMatch(enum.Enum):
    """Whether a run of twins has a measurement for the model and task of a run."""

    MEASURED = "measured"
    OTHER_MODEL = "other model"
    OTHER_TASK = "other task"
    NOTHING = "nothing compared"


class TwinEvidence(Fields):
    """The measurement of a run of twins for conditions most similar to those of a run."""

    run: str = Field(description="the run of twins")
    match: TwinMatch
    same_object: bool = Field(
        description="whether the measurement is about the object of this run"
    )
    same_surroundings: bool = Field(
        description="whether the twins had the surroundings of this run"
    )
    row: TwinAgreement | None = Field(
        description="the measurement; null if there is none"
    )


class RunResult(Result):
    """The result of a command that stores a run."""

    run: str | None = Field(description="folder of the run; null if it was not stored")
    environment: str
    controls: list[str]
    ending: str = Field(description="status with which the run ended")
    seconds: Annotated[dict[str, JsonFloat], key_validator("total")] = Field(
        description="seconds by part of the work, and in `total`"
    )
    seed: int = Field(description="root seed")
    command_line: str | None = Field(
        description="command that repeats the run; null if no command does"
    )
    python_only: list[str] = Field(
        default=[],
        description="objects that existed only in Python, so that no command repeats "
        "the run; absent if there are none",
    )
    twins: TwinEvidence | None = optional_field(
        "how well results on renders hold for photographs, by the run of twins in the "
        "settings; absent without such a run"
    )

    def to_dict(self) -> JsonObject:
        """Return the fields as JSON values, the most important ones first."""
        values = super().to_dict()
        for name in LAST_FIELDS:
            if name in values:
                values[name] = values.pop(name)
        return values


Payload = Annotated[JsonValue, BeforeValidator(lambda value: to_json_value(value))]
"""Data of a prediction that a task stores in addition to its label, such as boxes."""

Outcomes = dict[str, int] | None
"""Counts of each `options.Outcome`, by its value."""

OUTCOME_TEXT = (
    "counts of [what becomes of the object](tasks.md#what-becomes-of-the-object)"
)
ONLY_OF_BOXES = "absent for tasks other than detection and segmentation"


class SceneResult(RunResult):
    """The result of a command about one object, one model and one task."""

    object: str
    model: str
    task: str = Field(description="task by which predictions are evaluated")


class MovedValue(Fields):
    """A value of the scene outside of the range of its control, so that the clean scene
    has another value.
    """

    parameter: str
    unit: str
    scene: float | str = Field(description="value in the description of the scene")
    used: float | str = Field(description="value in the clean scene")


class VariedValue(Fields):
    """The range or the names from which a value was sampled at random."""

    unit: str
    low: float | None = optional_field("lower bound; absent for names")
    high: float | None = optional_field("upper bound; absent for names")
    names: list[str] | None = optional_field(
        "names of which one was sampled; absent for numbers"
    )


class CleanScene(Fields):
    """The scene from which a search starts."""

    moved: list[MovedValue] = Field(
        description="values that differ from those of the described scene"
    )


class Formation(Fields):
    """How images are computed from rendered radiance."""

    denoiser: str
    filter: str = Field(description="reconstruction filter of pixels")
    sampler: str = Field(description="sampler of pixels")
    exposure: float = Field(description="stops above the metered exposure")
    resolution: tuple[int, int] = Field(description="[height, width] in pixels")
    gain: float | None = Field(
        description="factor from radiance to display-linear values; null if each scene "
        "has its own"
    )


def to_json_value(value: Any) -> Any:
    """Convert a value, with everything inside of it, to types that JSON has.

    Numbers and arrays of numpy and torch become numbers and lists of Python,
    dataclasses become mappings, and NaN and infinity become None.

    Raises:
        TypeError: a value inside of it cannot be converted.
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


# A number, a name, or the bounds of an interval.
AxisValue = int | float | str | tuple[float, float]


class CountedPredictions(Fields):
    """The number of configurations, and in how many of them the model is right."""

    configurations: int = Field(description="number of configurations")
    correct: int = Field(description="number of right predictions")
    accuracy: float | None = Field(
        description="fraction of right predictions; if several configurations have the "
        "same [draw](drives.md), the mean over draws of the fraction in each; null if "
        "there are no configurations"
    )
    interval: Interval | None = Field(
        description="95 % confidence interval of the accuracy; null if all "
        "configurations have the same draw"
    )
    outcomes: Outcomes = optional_field(
        f"{OUTCOME_TEXT} in the wrong predictions; {ONLY_OF_BOXES}"
    )


class ConditionRow(Fields):
    """A condition on one parameter: an interval of its values, or a set of names."""

    parameter: str
    unit: str
    over: float | None = Field(
        description="lower bound, which values exceed; null without such a bound, and "
        "for names"
    )
    at_most: float | None = Field(
        description="upper bound, which values do not exceed; null without such a "
        "bound, and for names"
    )
    options: list[str] = Field(description="names in the set; empty for numbers")
    turn: float | None = optional_field(
        "period of an angle in degrees, 180 or 360; then `over` may exceed `at_most`, "
        "if the interval contains 0. Absent for other parameters"
    )
    text: str


class Extent(Fields):
    """A count with the confidence interval of its fraction."""

    what: str = Field(description="what was counted")
    count: int
    total: int = Field(alias="of")
    interval: Interval = Field(description="95 % confidence interval of the fraction")
    share: float | None = Field(
        default=None,
        description="the mean over draws of the fraction in each, if several "
        "configurations have the same draw; absent otherwise",
    )
    # Whether right predictions were counted, to compare them with a criterion; not
    # stored.
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
        """Return a count with the confidence interval of its fraction.

        Args:
            what: name of what is counted.
            count: number of cases in which it happened.
            total: number of all cases.
            interval: interval of the fraction; None for [0, 1].
            share: an estimate of the fraction; left out if it is count / total.
            counts_right: whether right predictions are counted.
        """
        # `share` is only stored if it does not follow from the counts.
        is_redundant = not total or share == count / total
        stated_share = None if is_redundant else share
        return cls(
            what=what,
            count=count,
            total=total,
            interval=interval or (0.0, 1.0),
            share=stated_share,
            counts_right=counts_right,
        )


class StudyResult(RunResult):
    """The result of several attacks, each of which is a run in the folder `parts`."""

    objects: list[str]
    model: str
    task: str = Field(description="task by which predictions are evaluated")
    policy: str
    parts: list[str] = Field(
        description="names of the runs of the attacks in the folder `parts`"
    )
    warnings: list[str] = Field(description="warnings as sentences")


GradientStatus = Literal["ok", "biased", "noisy", "reference unusable"]


class GroupDerivative(Fields):
    """How the derivative with respect to one parameter is computed."""

    control: str
    parameter: str
    size: int = Field(description="number of coordinates of the parameter")
    estimator: str
    valid: list[str] = Field(description="names of the valid estimators")
    step: float = Field(description="half-width of a finite difference in u")
    step_reason: str = Field(
        description="reason for the width; empty without finite differences"
    )
    reason: str = Field(description="reason for the choice of the estimator")
    variance_x_seconds: dict[str, JsonFloat] = Field(
        description="squared error times seconds of each estimator that was measured"
    )
    step_in_unit: float | None = Field(
        description="the step in `unit`; null if it is not a single number"
    )
    unit: str

    @property
    def name(self) -> str:
        return f"{self.control}.{self.parameter}"


class PlannedGradient(Fields):
    """How all derivatives are computed."""

    renders_per_gradient: int = Field(
        description="number of renders in addition to the picture itself; adjoints are "
        "not counted"
    )
    spp: int | None = Field(
        description="samples per pixel of finite differences; null for those of the "
        "search"
    )
    groups: list[GroupDerivative]


class PathCut(Fields):
    """The error of light paths with a maximum length, as the worst case over the
    measured configurations.
    """

    depth: int = Field(description="maximum length of a path in segments")
    light: float = Field(description="fraction of the radiance that is missing")
    levels: float = Field(
        description="root-mean-square bias of the displayed picture in 8-bit levels"
    )


class PathLength(Fields):
    """The maximum length of light paths in the search, and the reason for it."""

    depth: int = Field(description="maximum length in the search, in segments")
    full: int = Field(description="maximum length in the verification, in segments")
    cuts: list[PathCut] = Field(
        description="measured errors by maximum length, the longest first"
    )
    configurations: int = Field(description="number of measured configurations")
    reason: str


class Measured(Fields):
    """The error of a picture, a margin, a gradient or a derivative.

    It is measured against a reference with far more renders. Errors and noise are
    relative to the norm of the reference. Fields that were not measured are absent.
    """

    quantity: str = Field(
        description="`picture`, `margin` of the model, `gradient` of a control, or "
        "`derivative` with respect to a parameter"
    )
    control: str = Field(default="", description="control of the gradient")
    parameter: str = Field(default="", description="parameter of the derivative")
    estimator: str = Field(
        description="sampler of the picture, or estimator of the derivatives"
    )
    factor: float = Field(
        default=1.0, description="step as a multiple of the planned step"
    )
    spp: int = Field(description="samples per pixel")
    repeats: int = Field(description="number of computations, each with other noise")
    seconds: float = Field(description="median time of one computation")
    status: GradientStatus = Field(description="whether it agrees with its reference")
    error: JsonFloat | None = optional_field(
        "root-mean-square error of one computation; an upper bound if the reference is "
        "unusable"
    )
    interval: Interval | None = optional_field("confidence interval of `error`")
    bias: JsonFloat | None = optional_field("error of the mean over computations")
    doubt: JsonFloat | None = optional_field(
        "the part of `bias` that noise can explain"
    )
    noise: JsonFloat | None = optional_field("standard deviation of one computation")
    cosine: JsonFloat | None = optional_field(
        "mean cosine between a gradient and its reference"
    )
    value: JsonFloat | None = optional_field("mean of a derivative")
    reference: JsonFloat | None = optional_field("reference of `value`")
    reference_error: JsonFloat | None = optional_field("error of the reference")
    reference_cosine: JsonFloat | None = optional_field(
        "smallest cosine between two converged gradients, whose mean is the reference"
    )

    @property
    def name(self) -> str:
        """``control.parameter``, or one of them if the other is empty, or else the
        quantity.
        """
        return ".".join(filter(None, (self.control, self.parameter))) or self.quantity

    @property
    def excess(self) -> float:
        """The part of the bias that noise cannot explain."""
        return max(0.0, (self.bias or 0.0) - (self.doubt or 0.0))


class ClassPrediction(Fields):
    """A prediction for a picture."""

    label: str = Field(description="predicted label as text")
    index: int | None = Field(
        description="index of the class; null if the model has no classes"
    )
    probability: float | None = Field(
        description="probability; null if the model outputs none"
    )


class VisibleThing(Fields):
    """The visible part of the object, or of another object, in a picture."""

    label: str | None = Field(description="right label")
    box: tuple[int, int, int, int] | None = Field(
        description="bounding box of the visible part, [x0, y0, x1, y1] in pixels; "
        "null if it is not visible"
    )
    pixels: int = Field(description="number of pixels in which it is visible")
    share: float | None = Field(
        description="visible fraction, from 0 to 1, of all its pixels without occluders "
        "and without the edge of the picture; null if unknown"
    )
    truncated: bool | None = Field(
        description="whether it extends beyond the edge of the picture; null if unknown"
    )
    distance: float | None = Field(
        description="distance of the nearest visible point from the camera in metres"
    )


class ViewPredictions(Fields):
    """The predictions of a model for one view."""

    azimuth: float = Field(description="azimuth of the camera in degrees")
    answers: list[ClassPrediction] = Field(
        validation_alias=AliasChoices("answers", "predictions"),
        description="predictions, the most probable first",
    )
    things: dict[str, VisibleThing] | None = optional_field(
        "visible parts of `object` and of each other object; absent without others"
    )


class MeshUp(Fields):
    """The axis of a mesh file that points up in the scene, and the reason."""

    axis: str
    reason: str


class RenderResult(Result):
    """A picture of a scene, with the predictions of the model."""

    command: ClassVar[str] = "render"

    out: str = Field(description="file of the picture")
    answered: str | None = optional_field(
        "file of the picture with boxes and masks; absent if the task has none"
    )
    size: tuple[int, int] = Field(
        description="size of the picture, [height, width] in pixels"
    )
    object: str
    environment: str
    model: str
    task: str = Field(description="task by which predictions are evaluated")
    spp: int = Field(description="samples per pixel")
    image_formation: Formation
    up: MeshUp | None = Field(
        description="axis of the mesh file that points up; null without a mesh file"
    )
    views: list[ViewPredictions]
    warnings: list[str] = Field(description="warnings as sentences")


class DescribedValue(Fields):
    """The value of a parameter in a configuration, with its unit."""

    value: int | float | str | list[float]
    unit: str


class ControlGroup(Fields):
    """Trials (verification renders) of the clean scene, and how many are right."""

    correct: int
    trials: int
    rate: float
    interval: Interval
    not_a_number: int = Field(
        default=0,
        description="number of trials with an output of NaN or infinity; absent if 0",
    )
    outcomes: Outcomes = optional_field(
        f"{OUTCOME_TEXT} in the wrong trials; {ONLY_OF_BOXES}"
    )


class VerifiedRate(Fields):
    """Trials (verification renders) with new seeds, and how many are a success."""

    successes: int
    trials: int = Field(
        description="number of trials; if conditions vary, of those in which the model "
        "is right about the clean scene"
    )
    rate: float
    interval: Interval
    spp: int = Field(description="samples per pixel")
    labels: dict[str, int] = Field(
        description="counts of the predicted labels in the successes"
    )
    outcomes: Outcomes = optional_field(
        f"{OUTCOME_TEXT} in the successes; {ONLY_OF_BOXES}"
    )
    margin: JsonFloat = Field(
        description="mean margin over these trials, in logits, or for a detector in "
        "log-odds; a success has a margin below 0"
    )
    not_a_number: int = Field(
        default=0,
        description="number of trials with an output of NaN or infinity; absent if 0",
    )
    stopped: str | None = optional_field(
        "why the trials ended: `asked for` (the requested number was done) or `decided` "
        "(more could not change the result); absent for trials without a verdict"
    )


class AverageCase(Fields):
    """The accuracy in configurations that are sampled from the full space and budget."""

    configurations: int
    correct: int = Field(description="number of right predictions")
    accuracy: float
    interval: Interval
    margin: JsonFloat = Field(description="mean margin in logits")
    worst_margin: JsonFloat = Field(description="smallest margin in logits")


class PredictionError(Fields):
    """The error of predicted pictures against traced ones, at the last comparison."""

    levels: JsonFloat = Field(
        description="root-mean-square error in levels of 255, over the object's pixels "
        "(for a crop, over the pixels outside of it)"
    )
    margin_bias: JsonFloat = Field(
        description="mean error of the margin over the compared pictures"
    )


class BankOfConditions(Fields):
    """The sampled conditions for which transport matrices were computed."""

    created: int = Field(description="number of conditions")
    dropped: int = Field(description="number of those that were replaced by newer ones")
    grown: int = Field(
        description="number of comparisons with new conditions after which more "
        "conditions were added"
    )
    gap: float | None = Field(
        description="objective under these conditions minus that under new conditions, "
        "at the last comparison"
    )


class LinearTransport(Fields):
    """How the pictures of the searches were predicted instead of rendered."""

    used: bool
    method: str | None = optional_field(
        "method of prediction: `matrix`, `basis pictures` (for a sweep), `surface "
        "light`, `crop`, which renders a part of each picture, or that of an added "
        "predictor"
    )
    reason: str | None = optional_field(
        "why pictures were rendered, all or after some evaluation, or were not "
        "predicted by surface light"
    )
    crop: str | None = optional_field("why full pictures were rendered")
    window: tuple[int, int, int, int] | None = optional_field(
        "the part of the picture that was traced: top, left, height and width"
    )
    conditions: BankOfConditions | None = optional_field(
        "conditions of the matrices; only with `over`"
    )
    entries: int | None = optional_field("number of entries of the matrix")
    bytes: int | None = optional_field("memory of the matrix in bytes")
    seconds: float | None = optional_field("time for the matrix and the comparisons")
    renewed: int | None = optional_field("how often the matrix was computed again")
    error: PredictionError | None = optional_field("error at the last comparison")


class PrintTerms(Fields):
    """How far colors are from printable ones, summed over textures and patches, without
    weights.
    """

    variation: float = Field(
        description="mean distance between neighboring pixels in sRGB"
    )
    off_print: float = Field(
        description="mean distance in sRGB from the nearest printable color"
    )


class SharedWork(Fields):
    """Counts and times of the workers of a run, since it was started or resumed."""

    max_running: int = Field(
        description="maximum number of workers that computed at the same time"
    )
    lost: int = Field(description="number of workers that died or disconnected")
    refused: int = Field(description="number of workers that could not do the task")
    retried: int = Field(description="number of batches that were submitted again")
    batches: int = Field(description="number of finished batches")
    busy: JsonFloat = Field(
        description="seconds of computing batches, summed over workers"
    )
    loading: JsonFloat = Field(
        description="seconds of loading scenes and models, summed over workers"
    )
    alive: JsonFloat = Field(
        description="seconds of being connected, without loading, summed over workers"
    )
    utilisation: JsonFloat | None = Field(description="`busy` divided by `alive`")
    machines: dict[str, dict[str, str]] = Field(
        description="descriptions of machines that differ, by their names in rows"
    )

    @classmethod
    def from_worker_stats(
        cls, facts: Any, machines: Mapping[str, Mapping[str, str]]
    ) -> SharedWork | None:
        """Return how workers shared a run; None if it had no workers.

        Args:
            facts: the `cluster.WorkerStats` of the run, or None.
            machines: machines that differ from this one, by name.
        """
        if facts is None:
            return None
        # `busy` and `alive` are seconds, summed over workers. They are measured by
        # different clocks, so their ratio may slightly exceed 1.
        utilisation = min(1.0, facts.busy / facts.alive) if facts.alive else None
        # `machines` of the statistics are replaced by those of the argument.
        return cls.model_validate(
            {**vars(facts), "utilisation": utilisation, "machines": machines}
        )


def find_result_type(values: JsonObject) -> type[Result] | None:
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
