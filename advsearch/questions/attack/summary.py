"""The results of `attack`, as `summary.json` holds them.

They are of one attack, of several objects or epsilons, or of several models.
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
    """One value of the adversarial configuration, and where it lies."""

    clean: int | float | str | None = optional_field(
        "the clean scene's; absent of several numbers"
    )
    low: float | None = optional_field(
        "the least that the control allows; absent without a range"
    )
    high: float | None = optional_field("the most")


class PicturedPrediction(Fields):
    """The prediction of the stored image.

    It is the image of a trial with the most frequent prediction.
    """

    label: str
    index: int | None = Field(description="of the class")
    probability: JsonFloat | None = Field(
        description="of this prediction; of a detector the score of the box"
    )
    payload: Payload = optional_field("what else the task keeps of it; absent without")
    trial: int | None = optional_field(
        "number of the trial, the same for both pictures; "
        "absent where nothing was tried"
    )


class CleanPrediction(CleanScene, PicturedPrediction):
    """The prediction of the stored image of the clean scene."""

    correct: bool = Field(description="whether that is right")
    control: ControlGroup | None = Field(
        description="trials of the clean scene, and in how many it is right"
    )


class ObjectiveValues(Fields):
    """The objective over some trials, in its own unit."""

    mean: JsonFloat
    deviation: JsonFloat = Field(description="standard deviation of one trial")
    low: JsonFloat = Field(description="the least")
    high: JsonFloat = Field(description="the most")


class TriedObjective(Fields):
    """What the search maximised, over the trials of the verification.

    These have other seeds, and images of 8 bits.
    """

    clean: ObjectiveValues | None = Field(
        description="of the clean scene; null where it was not tried"
    )
    adversarial: ObjectiveValues | None = Field(
        description="of the adversarial scene; null where nothing was verified"
    )


class AlongDrive(Fields):
    """Both scenes at evenly spaced times of the path that varied by chance."""

    frames: int
    seconds: float = Field(description="from the first frame to the last")
    paths: list[str] = Field(
        default=[],
        description="the paths, where one of several was drawn; the frames are theirs",
    )
    clean: int = Field(
        description="frames of the clean scene in which the model is right"
    )
    adversarial: int | None = Field(
        description="likewise, with the adversarial one; null if nothing was searched"
    )
    spp: int = Field(description="samples a pixel")


class BaselineSearch(Fields):
    """The random search beside it."""

    policy: str
    renders: int
    verified: VerifiedRate | None


class SmallestEpsilon(Fields):
    """The bracket of the least epsilon at which the prediction flips, by control."""

    epsilon: dict[str, float] | None = Field(
        description="the least that passed its trials; null: none did"
    )
    not_found_at: dict[str, float] | None = Field(
        description="the largest at which a search found none; null: none"
    )
    closed: bool = Field(description="the two are within 5 %")
    confirmed: bool = Field(description="the upper end passed again with new seeds")
    searches: int
    checks: int


class SearchDistribution(Fields):
    """The distribution that the policy found, where it is over few numbers."""

    mean: dict[str, DescribedValue]
    deviation: list[float] = Field(description="in u")


class DifferentFailure(Fields):
    """One of them: a configuration, and where those lie that it stands for."""

    ranges: dict[str, tuple[float, float] | str] = Field(
        description="from, to; of a discrete choice its option"
    )
    configuration: dict[str, DescribedValue]
    objective: JsonFloat = Field(
        description="of the one render that won; biased upwards"
    )
    holds: bool | None = Field(
        description="whether it is verified; null if it was not tried"
    )
    verified: VerifiedRate | None = Field(
        description="trials that ended as soon as that was clear; null: not tried"
    )
    picture: str | None = Field(
        description="the first of these trials; null if there is none"
    )
    pictured: PicturedPrediction | None = optional_field(
        "of that picture; absent if there is none"
    )


class FailingShare(Fields):
    """The fraction of all configurations that fail in one render of the search."""

    estimate: float | None = Field(description="null where too few draws failed to say")
    interval: Interval = Field(description="95 %, however the draws were chosen")
    effective: float = Field(
        description="failures of equal weight that would say as much"
    )
    draws: int


class DifferentFailures(Fields):
    """Many different failures, of a policy that looks for them."""

    over: list[str] = Field(
        description="the parameters that tell cells apart; empty "
        "where there are no cells"
    )
    found: int = Field(
        description="cells in which the search saw a success, or such "
        "draws: its own claim"
    )
    examined: int = Field(description="cells, or draws, that it looked at")
    cells: int | None = Field(
        description="cells that there are; null where there are none"
    )
    share: FailingShare | None = optional_field("null where it can't be told")
    tried: int = Field(description="failures that were tried with fresh seeds")
    verified: int = Field(description="of these, verified")
    listed: list[DifferentFailure] = Field(
        description="the worst, then whichever is farthest from all before it"
    )


class VerificationSamples(Fields):
    """The sample count of the verification."""

    spp: int
    converged: bool = Field(
        description="whether it is shown that more would leave the margins on their "
        "sides; over conditions that vary, "
        "the rate within 5 points"
    )


class SearchClaim(Fields):
    """What the search itself believes."""

    objective: JsonFloat = Field(description="of the one render that won")
    re_evaluated: JsonFloat = Field(description="its mean when rendered again")
    success_rate: JsonFloat = Field(description="of these renders")


class SearchGradients(Fields):
    """What the search saw of its gradients."""

    count: int
    cosine_with_the_one_before: JsonFloat | None = Field(
        description="the median: noise, and the way between"
    )
    zero: int
    cut: int = Field(description="of which single numbers were outliers and cut")
    shortened: int = Field(description="outliers as a whole")
    rejected: int = Field(description="steps that were taken back")


class PathSegments(Fields):
    """The longest light paths that were rendered."""

    search: int
    verification: int


class NotFinite(Fields):
    """Numbers that were NaN or infinite."""

    objectives: int
    gradient_elements: int


class PrintCost(Fields):
    """What the terms of `printable` cost in margin.

    They are compared with a search without them, of as many steps.

    Margins are means over trials with the same seeds, of what is sought: the smaller,
    the worse for the model. Each is of one search, so that a cost below 0 says that the
    search without terms ended in a worse place.
    """

    steps: int = Field(description="evaluations of the search without the terms")
    margin_with: JsonFloat = Field(
        description="of the run's adversarial scene, in logits"
    )
    margin_without: JsonFloat = Field(
        description="of what was found by the search without the terms, in logits"
    )
    cost: JsonFloat = Field(description="the first less the second, in logits")
    verified: VerifiedRate = Field(
        description="trials of what was found by the search without the terms"
    )
    terms: PrintTerms = Field(description="of that scene")


class Printability(Fields):
    """What `printable` was about, and what it cost."""

    clean: PrintTerms = Field(description="of the clean scene")
    adversarial: PrintTerms | None = Field(
        description="of the adversarial scene; null if nothing was searched"
    )
    cost: PrintCost | None = optional_field(
        "what the terms cost in margin; null if nothing was verified"
    )


class AmbientPoint(Fields):
    """The adversarial scene in one ambient light."""

    lux: float
    holds: bool = Field(description="whether it is verified there")
    verified: VerifiedRate


class AmbientLight(Fields):
    """The ambient light in which a projected image still makes the model wrong."""

    lux: float = Field(description="on the object in the scene, without the projector")
    holds_to: float = Field(
        description="lux, the most in which it was verified, as in "
        "all less that was tried"
    )
    limit_lux: float | None = Field(
        description="lux, the least in which it was not; null: it holds in direct sun"
    )
    points: list[AmbientPoint] = Field(
        description="what was tried, by lux; the first is the verification itself"
    )


class AttackSummary(SceneResult):
    """The worst configuration that was found, how sure that is, and what it cost."""

    command: ClassVar[str] = "attack"

    policy: str
    objective: str
    epsilon: float | dict[str, float | None] | None = Field(
        description="the budget; by control where there are more"
    )
    norm: str | dict[str, str] = Field(
        description="in which the budget is measured; by control as above"
    )
    label_set: list[str] = Field(description="the names that count as right")
    judge: str = Field(
        default="object",
        description="the thing whose answers count: object, the name "
        "of one beside it, or all",
    )
    goal: str = Field(
        description="`a wrong answer`, `a target answer` or `a right "
        "answer`: what counts as success"
    )
    target: list[str] | None = Field(description="the targets' names")
    over: list[str] = Field(description="the controls that varied by chance")
    conditions: dict[str, VariedValue] = Field(
        default={},
        description="what they were drawn from; absent without, and of "
        "parameters of many numbers",
    )
    image_formation: Formation
    gradient_plan: PlannedGradient
    light_path_segments: PathSegments
    clean: CleanPrediction
    adversarial: PicturedPrediction | None = Field(
        description="of what the search found; null if nothing was searched"
    )
    verified: VerifiedRate | None = Field(
        description="trials of the adversarial scene; null if nothing was verified"
    )
    tried_objective: TriedObjective | None = optional_field(
        "the objective over these trials"
    )
    baseline: BaselineSearch | None = optional_field(
        "the random search; absent without `baseline`"
    )
    adversarial_from: str | None = optional_field(
        "`random` where the run's adversarial scene is the random search's"
    )
    policy_verified: VerifiedRate | None = optional_field(
        "of what the policy itself found then"
    )
    drive: AlongDrive | None = optional_field(
        "[along a drive](drives.md), with `over` a path; absent without"
    )
    ambient: AmbientLight | None = optional_field(
        "with [a projector](controls/projector.md) that is found: how much other light "
        "it bears"
    )
    average: AverageCase | None = optional_field("only with `average`")
    smallest: SmallestEpsilon | None = optional_field("only with `smallest`")
    printability: Printability | None = optional_field("only with `printable`")
    distribution: SearchDistribution | None = optional_field(
        "of a policy that finds one"
    )
    failures: DifferentFailures | None = optional_field(
        "of a policy that looks for different ones"
    )
    sample_count: VerificationSamples | None = optional_field("of the verification")
    transport: LinearTransport | None = optional_field(
        "whether [a matrix of light transport](transport.md) predicted the searches' "
        "pictures"
    )
    claimed: SearchClaim | None = optional_field("what the search itself believes")
    gradients: SearchGradients | None = optional_field("of the search")
    configuration: dict[str, FoundValue] | None = optional_field(
        "the adversarial configuration in a few values"
    )
    shared: SharedWork | None = optional_field("only with `workers` or `cluster`")
    renders: dict[str, int] = Field(
        description="of the search, its gradients, the baseline and the verification; "
        "`unprinted`: of the search "
        "without print terms, with its gradients; `products`: predicted instead"
    )
    steps: int = Field(description="evaluations of the search before the reranking")
    non_finite: NotFinite
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def minimises(self) -> bool:
        """Whether the object was to be easier to recognise."""
        return self.goal == "a right answer"

    @property
    def brief(self) -> str:
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
    epsilon: EpsilonBudget = optional_field("of the last attack")
    flips_at: EpsilonBudget = Field(
        description="the least epsilon at which an adversarial scene was found; null: "
        "at none"
    )
    verified: VerifiedRate | None = None
    margin: JsonFloat | None = optional_field("mean of the trials, in logits")
    run: str | None = None
    tried: float | None = optional_field("the largest epsilon that was tried")
    average: AverageCase | None = optional_field("only with `average`")
    renders: dict[str, int] | None = optional_field(
        "pictures by kind, of the attacks at all epsilons together"
    )


class CurvePoint(Fields):
    """How many objects are still recognised at an epsilon."""

    epsilon: float | None
    objects: int = Field(description="of which something is known there")
    robust: int
    found: int
    already_wrong: int
    accuracy: float | None
    interval: Interval


class CurveResult(InNotebook, StudyResult):
    """Robust accuracy against epsilon, over objects."""

    command: ClassVar[str] = "attack"
    tabular: ClassVar[str] = "curve"

    epsilons: list[float | None] = Field(
        description="those that were tried; null: the own of each control"
    )
    table: list[ObjectRow]
    curve: list[CurvePoint]


class MatrixModel(Fields):
    """One of the models, and its predictions of the clean scene."""

    model: str
    labels: list[str] = Field(description="the names that count as right")
    input_size: tuple[int, int] = Field(
        description="of the pictures that it is shown, [height, width] in pixels"
    )
    spp: int = Field(description="samples a pixel")
    clean: ControlGroup


class MatrixCell(Fields):
    """One adversarial scene, tried on one model."""

    model: str = Field(description="that it is tried on")
    ending: str = Field(
        description="`found` where it is verified on this model, as for an attack"
    )
    verified: VerifiedRate


class MatrixRow(Fields):
    """One adversarial scene, and what it does to each model."""

    attacked: str = Field(
        description="the model that it was searched on; `all` for an ensemble"
    )
    ending: str = Field(description="of the search and its own verification")
    run: str | None
    renders: dict[str, int] = Field(
        description="of the search and its own verification"
    )
    tested: list[MatrixCell] = Field(
        description="on each model; empty where nothing was searched"
    )


class MatrixResult(InNotebook, StudyResult):
    """Adversarial scenes of several models, tried on each of them.

    They were searched on each model, or on all of them as an ensemble.
    """

    command: ClassVar[str] = "attack"

    models: list[str] = Field(description="as they were asked for")
    ensemble: str | None = Field(
        description="how objectives were put together; null: each model by itself"
    )
    tested: list[MatrixModel] = Field(
        description="the models that adversarial scenes were tried on; empty where "
        "none was"
    )
    table: list[MatrixRow]

    @property
    def brief(self) -> str:
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
"""Other results of the command, by a field that they alone have."""


def load_attack_summary(folder: Path) -> AttackSummary:
    """Load the result of the attack in a run directory; errors as for `read_result`."""
    result = read_result(folder)
    if not isinstance(result, AttackSummary):
        raise make_summary_error(folder / NAME, f"that of {result.command}")
    return result
