"""The results of `attack`, as `summary.json` holds them.

There is a class for one attack, for a curve (several objects or epsilons), and for a
matrix (several models).
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from pydantic import Field

from advsearch.report.views import InNotebook
from advsearch.runs.results import (
    AverageCase,
    CleanScene,
    ControlGroup,
    DescribedValue,
    Fields,
    Formation,
    Interval,
    JsonFloat,
    LinearTransport,
    Payload,
    PlannedGradient,
    PrintTerms,
    Result,
    SceneResult,
    SharedWork,
    StudyResult,
    VariedValue,
    VerifiedRate,
    optional_field,
)
from advsearch.runs.summary import NAME, make_summary_error, read_result


class FoundValue(DescribedValue):
    """A value of the adversarial configuration, with its clean value and its range."""

    clean: int | float | str | None = optional_field(
        "value of the clean scene; absent if it is not a single value"
    )
    low: float | None = optional_field(
        "smallest value that the control allows; absent without a range"
    )
    high: float | None = optional_field(
        "largest value that the control allows; absent without a range"
    )


class PicturedPrediction(Fields):
    """The prediction of the stored image.

    It is the image of a trial with the most frequent prediction.
    """

    label: str
    index: int | None = Field(description="index of the class")
    probability: JsonFloat | None = Field(
        description="probability of the prediction; for a detector, score of the box"
    )
    payload: Payload = optional_field(
        "what else the task stores about the prediction; absent if there is nothing"
    )
    trial: int | None = optional_field(
        "number of the trial, the same for both pictures; absent without trials"
    )


class CleanPrediction(CleanScene, PicturedPrediction):
    """The prediction of the stored image of the clean scene."""

    correct: bool = Field(description="whether the prediction is right")
    control: ControlGroup | None = Field(
        description="trials of the clean scene, and in how many the model is right; "
        "null without trials"
    )


class ObjectiveValues(Fields):
    """The objective over some trials, in its own unit."""

    mean: JsonFloat
    deviation: JsonFloat = Field(description="standard deviation over the trials")
    low: JsonFloat = Field(description="minimum over the trials")
    high: JsonFloat = Field(description="maximum over the trials")


class TriedObjective(Fields):
    """The objective of the search, evaluated in the trials of the verification.

    Trials have other seeds than the search, and images of 8 bits.
    """

    clean: ObjectiveValues | None = Field(
        description="values for the clean scene; null if it was not tried"
    )
    adversarial: ObjectiveValues | None = Field(
        description="values for the adversarial scene; null if nothing was verified"
    )


class AlongDrive(Fields):
    """Both scenes at evenly spaced times of the path that varied by chance."""

    frames: int
    seconds: float = Field(description="from the first frame of a path to the last")
    paths: list[str] = Field(
        default=[],
        description="names of the paths if there are several; the frames are those of "
        "all paths",
    )
    clean: int = Field(
        description="frames of the clean scene in which the model is right"
    )
    adversarial: int | None = Field(
        description="frames of the adversarial scene in which the model is right; null "
        "if nothing was searched"
    )
    spp: int = Field(description="samples per pixel")


class BaselineSearch(Fields):
    """The random search that the search is compared with."""

    policy: str
    renders: int
    verified: VerifiedRate | None


class SmallestEpsilon(Fields):
    """Bounds of the smallest epsilon at which the model is wrong, by control."""

    epsilon: dict[str, float] | None = Field(
        description="smallest epsilon that passed its trials; null if none did"
    )
    not_found_at: dict[str, float] | None = Field(
        description="largest epsilon at which a search found nothing; null if there "
        "was none"
    )
    closed: bool = Field(description="whether the two are within 5 %")
    confirmed: bool = Field(
        description="whether the upper bound passed trials with new seeds, too"
    )
    searches: int = Field(description="number of searches")
    checks: int = Field(
        description="number of checks, each of which has several trials"
    )


class SearchDistribution(Fields):
    """The distribution that the policy ended with, if it has few numbers."""

    mean: dict[str, DescribedValue]
    deviation: list[float] = Field(
        description="standard deviation of each coordinate in [0, 1]"
    )


class DifferentFailure(Fields):
    """One of several failures, and the ranges of the configurations it stands for."""

    ranges: dict[str, tuple[float, float] | str] = Field(
        description="lower and upper bound by parameter; the option, for a discrete "
        "choice"
    )
    configuration: dict[str, DescribedValue]
    objective: JsonFloat = Field(
        description="objective in the render by which it was selected; biased upwards"
    )
    holds: bool | None = Field(
        description="whether it is verified; null if it was not tried"
    )
    verified: VerifiedRate | None = Field(
        description="trials, which ended as soon as the verdict was certain; null if it "
        "was not tried"
    )
    picture: str | None = Field(
        description="path of the picture of the first trial; null if it was not tried"
    )
    pictured: PicturedPrediction | None = optional_field(
        "prediction in that picture; absent if it was not tried"
    )


class FailingShare(Fields):
    """The fraction of all configurations that fail in one render of the search."""

    estimate: float | None = Field(
        description="the fraction; null if too few samples failed to estimate it"
    )
    interval: Interval = Field(
        description="95 % interval, valid however the policy chose the samples"
    )
    effective: float = Field(
        description="effective number of failures: as many of equal weight would be as "
        "informative"
    )
    draws: int = Field(description="number of samples")


class DifferentFailures(Fields):
    """The failures that a policy found which looks for many different ones.

    A policy counts in cells, into which it divides the space of some parameters, or in
    sampled configurations.
    """

    over: list[str] = Field(
        description="the parameters that span the cells; empty if there are no cells"
    )
    found: int = Field(
        description="cells or samples in which the search had a success: its own claim"
    )
    examined: int = Field(description="cells or samples that it evaluated")
    cells: int | None = Field(
        description="number of all cells; null if there are no cells"
    )
    share: FailingShare | None = optional_field("absent if it cannot be estimated")
    tried: int = Field(description="failures that were tried with fresh seeds")
    verified: int = Field(description="tried failures that were verified")
    listed: list[DifferentFailure] = Field(
        description="first the worst failure, then always the one that is farthest from "
        "all before it"
    )


class VerificationSamples(Fields):
    """The sample count of the verification."""

    spp: int
    converged: bool = Field(
        description="whether more samples were shown not to change the signs of the "
        "margins; if conditions vary, not to change the rate by more than 5 points"
    )


class SearchClaim(Fields):
    """What the search itself claims, without trials."""

    objective: JsonFloat = Field(
        description="objective in the render by which the configuration was selected"
    )
    re_evaluated: JsonFloat = Field(
        description="mean objective of the configuration when it was rendered again"
    )
    success_rate: JsonFloat = Field(
        description="fraction of successes in these renders"
    )


class SearchGradients(Fields):
    """Statistics of the gradients of the search."""

    count: int
    cosine_with_the_one_before: JsonFloat | None = Field(
        description="median cosine of a gradient with the previous one; lower with more "
        "noise and longer steps"
    )
    zero: int = Field(description="gradients that were zero")
    cut: int = Field(description="gradients in which outlying elements were clipped")
    shortened: int = Field(
        description="gradients that were scaled down, because their norm was an outlier"
    )
    rejected: int = Field(description="steps that were undone")


class PathSegments(Fields):
    """Segments of the longest light paths that were rendered."""

    search: int
    verification: int


class NotFinite(Fields):
    """Numbers that were NaN or infinite."""

    objectives: int
    gradient_elements: int


class PrintCost(Fields):
    """The margin that the print terms of `printable` cost.

    It is measured by another search without the terms, with as many steps.

    Margins are means over trials with the same seeds: the smaller, the worse for the
    model. A cost below 0 means that the search without terms happened to find a less
    adversarial scene.
    """

    steps: int = Field(description="evaluations of the search without the terms")
    margin_with: JsonFloat = Field(
        description="margin of the run's adversarial scene, in logits"
    )
    margin_without: JsonFloat = Field(
        description="margin of the scene from the search without the terms, in logits"
    )
    cost: JsonFloat = Field(
        description="`margin_with` minus `margin_without`, in logits"
    )
    verified: VerifiedRate = Field(
        description="trials of the scene from the search without the terms"
    )
    terms: PrintTerms = Field(
        description="print terms of the scene from the search without the terms"
    )


class Printability(Fields):
    """How printable the colors of both scenes are, and the margin that this costs."""

    clean: PrintTerms = Field(description="print terms of the clean scene")
    adversarial: PrintTerms | None = Field(
        description="print terms of the adversarial scene; null if nothing was searched"
    )
    cost: PrintCost | None = optional_field(
        "margin that the terms cost; null if nothing was verified"
    )


class AmbientPoint(Fields):
    """The adversarial scene in one ambient light."""

    lux: float
    holds: bool = Field(description="whether it is verified there")
    verified: VerifiedRate


class AmbientLight(Fields):
    """The ambient light in which a projected image still makes the model wrong."""

    lux: float = Field(
        description="ambient light of the scene on the object, without the projector"
    )
    holds_to: float = Field(
        description="brightest ambient light in lux up to which the scene was verified "
        "in every light that was tried"
    )
    limit_lux: float | None = Field(
        description="darkest ambient light in lux in which it was not verified; null if "
        "it holds in direct sun"
    )
    points: list[AmbientPoint] = Field(
        description="the lights that were tried, ascending; the first is that of the "
        "verification"
    )


class AttackSummary(SceneResult):
    """The worst configuration that was found, its verification, and what that cost."""

    command: ClassVar[str] = "attack"

    policy: str
    objective: str
    epsilon: float | dict[str, float | None] | None = Field(
        description="the budget; by control if there are several"
    )
    norm: str | dict[str, str] = Field(
        description="norm of the budget; by control if there are several"
    )
    label_set: list[str] = Field(description="the labels that count as right")
    judge: str = Field(
        default="object",
        description="the thing whose predictions count: `object`, the name of another "
        "thing, or `all`",
    )
    goal: str = Field(
        description="what counts as success: `a wrong answer`, `a target answer` or `a "
        "right answer`"
    )
    target: list[str] | None = Field(
        description="names of the targets; null if any wrong prediction counts"
    )
    over: list[str] = Field(description="the controls that varied by chance")
    conditions: dict[str, VariedValue] = Field(
        default={},
        description="ranges or options of the parameters that varied by chance; a "
        "parameter with many numbers is absent",
    )
    image_formation: Formation
    gradient_plan: PlannedGradient
    light_path_segments: PathSegments
    clean: CleanPrediction
    adversarial: PicturedPrediction | None = Field(
        description="prediction of the adversarial scene; null if nothing was searched"
    )
    verified: VerifiedRate | None = Field(
        description="trials of the adversarial scene; null if nothing was verified"
    )
    tried_objective: TriedObjective | None = optional_field(
        "the objective in the trials"
    )
    baseline: BaselineSearch | None = optional_field(
        "the random search; absent without `baseline`"
    )
    adversarial_from: str | None = optional_field(
        "`random` if the random search found the run's adversarial scene; else absent"
    )
    policy_verified: VerifiedRate | None = optional_field(
        "trials of the scene that the policy found, if `adversarial_from` is `random`"
    )
    drive: AlongDrive | None = optional_field(
        "the scenes [along a drive](drives.md); absent if no path varies (`over`)"
    )
    ambient: AmbientLight | None = optional_field(
        "ambient light in which the scene still holds, if the light of [a "
        "projector](controls/projector.md) was searched"
    )
    average: AverageCase | None = optional_field(
        "random configurations; only with `average`"
    )
    smallest: SmallestEpsilon | None = optional_field(
        "the smallest epsilon; only with `smallest`"
    )
    printability: Printability | None = optional_field(
        "how printable the colours are; only with `printable`"
    )
    distribution: SearchDistribution | None = optional_field(
        "distribution that the policy ended with; absent if it has none"
    )
    failures: DifferentFailures | None = optional_field(
        "different failures; absent if the policy does not look for them"
    )
    sample_count: VerificationSamples | None = optional_field(
        "samples per pixel of the verification"
    )
    transport: LinearTransport | None = optional_field(
        "whether [a matrix of light transport](transport.md) predicted the pictures of "
        "the searches"
    )
    claimed: SearchClaim | None = optional_field("what the search itself claims")
    gradients: SearchGradients | None = optional_field(
        "statistics of the gradients of the search"
    )
    configuration: dict[str, FoundValue] | None = optional_field(
        "the adversarial configuration, summarized in a few values"
    )
    shared: SharedWork | None = optional_field("only with `workers` or `cluster`")
    renders: dict[str, int] = Field(
        description="number of rendered pictures of the `search`, its gradients "
        "(`gradient`), the `baseline`, the `verification`, and the search without print "
        "terms with its gradients (`unprinted`); `products` is the number of predicted "
        "pictures"
    )
    steps: int = Field(
        description="evaluations of the search, without the final ranking"
    )
    non_finite: NotFinite
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def minimises(self) -> bool:
        """Whether the object was to be easier to recognise."""
        return self.goal == "a right answer"

    @property
    def outcome_summary(self) -> str:
        """The verified rate, or the prediction that is not verified yet."""
        if self.verified is None:
            if self.is_unfinished and self.adversarial:
                return f"{self.adversarial.label}, unverified"
            return ""
        return f"{self.verified.successes}/{self.verified.trials}"


EpsilonBudget = float | None | dict[str, float | None]


class ObjectRow(Fields):
    """What the attacks on one object found, at the largest epsilon that was tried."""

    object: str
    clean: ControlGroup | None
    ending: str | None = None
    epsilon: EpsilonBudget = optional_field("epsilon of the last attack")
    flips_at: EpsilonBudget = Field(
        description="smallest epsilon at which an adversarial scene was found; null if "
        "none was found"
    )
    verified: VerifiedRate | None = None
    margin: JsonFloat | None = optional_field("mean margin of the trials, in logits")
    run: str | None = None
    tried: float | None = optional_field("the largest epsilon that was tried")
    average: AverageCase | None = optional_field(
        "random configurations; only with `average`"
    )
    renders: dict[str, int] | None = optional_field(
        "number of pictures by kind, over the attacks at all epsilons"
    )


class CurvePoint(Fields):
    """How many objects are still recognised at an epsilon."""

    epsilon: float | None
    objects: int = Field(
        description="number of objects of which it is known whether they are robust"
    )
    robust: int
    found: int = Field(description="objects with an adversarial scene")
    already_wrong: int = Field(description="objects whose clean scene is wrong")
    accuracy: float | None = Field(
        description="`robust` / `objects`; null if there are no objects"
    )
    interval: Interval


class CurveResult(InNotebook, StudyResult):
    """Robust accuracy against epsilon, over objects."""

    command: ClassVar[str] = "attack"
    tabular: ClassVar[str] = "curve"

    epsilons: list[float | None] = Field(
        description="the epsilons that were tried; null if each control has its own"
    )
    table: list[ObjectRow]
    curve: list[CurvePoint]


class MatrixModel(Fields):
    """One of the models, and its predictions of the clean scene."""

    model: str
    labels: list[str] = Field(description="the labels that count as right")
    input_size: tuple[int, int] = Field(
        description="[height, width] of its input in pixels"
    )
    spp: int = Field(description="samples per pixel")
    clean: ControlGroup


class MatrixCell(Fields):
    """One adversarial scene, tried on one model."""

    model: str = Field(description="the model that the scene is tried on")
    ending: str = Field(
        description="ending as for an attack; `found` if the scene is verified on this "
        "model"
    )
    verified: VerifiedRate


class MatrixRow(Fields):
    """One adversarial scene, and its trials on each model."""

    attacked: str = Field(
        description="the model that was attacked; `all` for an ensemble"
    )
    ending: str = Field(description="ending of the attack")
    run: str | None
    renders: dict[str, int] = Field(
        description="number of pictures of the attack, by kind"
    )
    tested: list[MatrixCell] = Field(
        description="trials on each model; empty if nothing was searched"
    )


class MatrixResult(InNotebook, StudyResult):
    """Adversarial scenes, each tried on several models.

    Each model was attacked, or all of them as one ensemble.
    """

    command: ClassVar[str] = "attack"

    models: list[str] = Field(description="names of the models, as requested")
    ensemble: str | None = Field(
        description="how the objectives of the models were combined; null if each was "
        "attacked by itself"
    )
    tested: list[MatrixModel] = Field(
        description="the models that adversarial scenes were tried on; empty if none "
        "was tried"
    )
    table: list[MatrixRow]

    @property
    def outcome_summary(self) -> str:
        """How many adversarial scenes hold on models that they were not searched on."""
        endings = list[str]()
        for row in self.table:
            endings += [
                cell.ending for cell in row.tested if cell.model != row.attacked
            ]
        if not endings:
            return ""
        return f"{endings.count('found')} of {len(endings)} transfer"


BY_FIELD: dict[str, type[Result]] = {"models": MatrixResult, "curve": CurveResult}
"""Other results of the command, each by a field that only this result has."""


def load_attack_summary(folder: Path) -> AttackSummary:
    """Load the result of the attack in a run directory; errors as for `read_result`."""
    result = read_result(folder)
    if not isinstance(result, AttackSummary):
        raise make_summary_error(folder / NAME, f"that of {result.command}")
    return result
