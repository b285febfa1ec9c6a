"""The result of `attack`: what `summary.json` holds of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import Field

from advsearch.runs.results.base import (
    CleanScene,
    Fields,
    Formation,
    Interval,
    JsonFloat,
    Payload,
    PlannedGradient,
    SceneResult,
    VariedValue,
)


class DescribedValue(Fields):
    """One value of a configuration, with its unit."""

    value: int | float | str | list[float]
    unit: str


class FoundValue(DescribedValue):
    """One value of the answer, and where it lies."""

    clean: int | float | str | None = Field(default=None, description="the clean scene's; absent of several numbers")
    low: float | None = Field(default=None, description="the least that the control allows; absent without a range")
    high: float | None = Field(default=None, description="the most")


class PicturedAnswer(Fields):
    """What the model says of the picture that is kept, which is that of a trial with the usual answer."""

    label: str
    index: int | None = Field(description="of the class")
    probability: JsonFloat | None = Field(description="of this answer; of a detector the score of the box")
    payload: Payload = Field(default=None, description="what else the task keeps of it; absent without")
    trial: int | None = Field(
        default=None, description="number of the trial, the same for both pictures; absent where nothing was tried"
    )


class ControlGroup(Fields):
    """Trials of the clean scene: how many are right."""

    correct: int
    trials: int
    rate: float
    interval: Interval
    not_a_number: int = Field(default=0, description="trials whose answer is NaN or infinity; absent without")


class CleanAnswer(CleanScene, PicturedAnswer):
    """What the model says of the picture of the clean scene that is kept."""

    correct: bool = Field(description="whether that is right")
    control: ControlGroup | None = Field(description="trials of the clean scene, and in how many it is right")


class VerifiedRate(Fields):
    """Trials with fresh seeds, and how many of them are a success."""

    successes: int
    trials: int = Field(description="that count: over conditions that vary, those whose clean scene is right")
    rate: float
    interval: Interval
    spp: int = Field(description="samples a pixel")
    labels: dict[str, int] = Field(description="answers of the successes, and how often each was given")
    margin: JsonFloat = Field(description="mean over these trials, in logits; of a detector in log-odds")
    not_a_number: int = Field(default=0, description="trials whose answer is NaN or infinity; absent without")
    stopped: str | None = Field(
        default=None,
        description="why there are no more: `asked for` (as many as were) or `decided` (the verdict stands); absent of "
        "trials that are no verdict",
    )


class ObjectiveValues(Fields):
    """The objective over some trials, in its own unit."""

    mean: JsonFloat
    deviation: JsonFloat = Field(description="standard deviation of one trial")
    low: JsonFloat = Field(description="the least")
    high: JsonFloat = Field(description="the most")


class TriedObjective(Fields):
    """What the search maximised, over the trials of the verification, which have other seeds and 8 bits."""

    clean: ObjectiveValues | None = Field(description="of the clean scene; null where it was not tried")
    answer: ObjectiveValues | None = Field(description="of the answer; null where nothing was verified")


class AnswerAlongDrive(Fields):
    """The clean scene and the answer at evenly spaced times of the path that varied by chance."""

    frames: int
    seconds: float = Field(description="from the first frame to the last")
    clean: int = Field(description="frames of the clean scene in which the model is right")
    answer: int | None = Field(description="likewise, with the answer; null if nothing was searched")
    spp: int = Field(description="samples a pixel")


class BaselineSearch(Fields):
    """The random search beside it."""

    policy: str
    renders: int
    verified: VerifiedRate | None


class AverageCase(Fields):
    """Configurations drawn from the whole space and budget."""

    configurations: int
    correct: int = Field(description="how many the model got right")
    accuracy: float
    interval: Interval
    margin: JsonFloat = Field(description="the mean, in logits")
    worst_margin: JsonFloat = Field(description="the largest, in logits")


class SmallestEpsilon(Fields):
    """The bracket of the least epsilon at which the answer flips, by control."""

    epsilon: dict[str, float] | None = Field(description="the least that passed its trials; null: none did")
    not_found_at: dict[str, float] | None = Field(description="the largest at which a search found none; null: none")
    closed: bool = Field(description="the two are within 5 %")
    confirmed: bool = Field(description="the upper end passed again with new seeds")
    searches: int
    checks: int


class AnswerDistribution(Fields):
    """The distribution that the policy answers with, where it is over few numbers."""

    mean: dict[str, DescribedValue]
    deviation: list[float] = Field(description="in u")


class DifferentFailure(Fields):
    """One of them: a configuration, and where those lie that it stands for."""

    ranges: dict[str, tuple[float, float] | str] = Field(description="from, to; of a discrete choice its option")
    configuration: dict[str, DescribedValue]
    objective: JsonFloat = Field(description="of the one render that won; biased upwards")
    holds: bool | None = Field(description="whether it is verified; null if it was not tried")
    verified: VerifiedRate | None = Field(description="trials that ended as soon as that was clear; null: not tried")
    picture: str | None = Field(description="the first of these trials; null if there is none")
    pictured: PicturedAnswer | None = Field(default=None, description="of that picture; absent if there is none")


class FailingShare(Fields):
    """How large a part of all configurations, drawn evenly, fails in one render of the search."""

    estimate: float | None = Field(description="null where too few draws failed to say")
    interval: Interval = Field(description="95 %, however the draws were chosen")
    effective: float = Field(description="failures of equal weight that would say as much")
    draws: int


class DifferentFailures(Fields):
    """Many different failures, of a policy that looks for them."""

    over: list[str] = Field(description="the parameters that tell cells apart; empty where there are no cells")
    found: int = Field(description="cells in which the search saw a success, or such draws: its own claim")
    seen: int = Field(description="cells, or draws, that it looked at")
    places: int | None = Field(description="cells that there are; null where there are none")
    share: FailingShare | None = Field(default=None, description="null where it can't be told")
    tried: int = Field(description="failures that were tried with fresh seeds")
    held: int = Field(description="of these, verified")
    listed: list[DifferentFailure] = Field(description="the worst, then whichever is farthest from all before it")


class VerificationSamples(Fields):
    """The sample count of the verification."""

    spp: int
    converged: bool = Field(
        description="whether it is shown that more would leave the margins on their sides; over conditions that vary, "
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
    cosine_with_the_one_before: JsonFloat | None = Field(description="the median: noise, and the way between")
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


class PredictionError(Fields):
    """How far predicted pictures were from traced ones, at the last comparison."""

    levels: JsonFloat = Field(description="of 255, over the object's pixels, root mean square")
    logits: JsonFloat = Field(description="of the margin, the mean over the pictures that were compared")


class BankOfConditions(Fields):
    """The conditions that matrices were made for."""

    made: int = Field(description="how many")
    dropped: int = Field(description="of them made room for newer ones")
    grown: int = Field(description="comparisons with unseen conditions after which there had to be more")
    gap: float | None = Field(description="objective under them over that under unseen ones, at the last comparison")


class LinearTransport(Fields):
    """What predicted the pictures of the searches."""

    used: bool
    way: str | None = Field(
        default=None, description="by what: `matrix`, `basis pictures` (of a sweep), or `surface light`"
    )
    reason: str | None = Field(
        default=None,
        description="why pictures were rendered, all or from some evaluation on, or not predicted by surface light",
    )
    conditions: BankOfConditions | None = Field(default=None, description="with `over`")
    entries: int | None = Field(default=None, description="of the matrix")
    bytes: int | None = Field(default=None, description="of its memory")
    seconds: float | None = Field(default=None, description="that it and the comparisons took")
    renewed: int | None = Field(default=None, description="how often it was made again")
    error: PredictionError | None = Field(default=None, description="of the last comparison")


class PrintTerms(Fields):
    """How far colours are from what can be printed, without weights, summed over textures and patches."""

    variation: float = Field(description="mean length of the step from a pixel to its neighbours, in sRGB")
    off_print: float = Field(description="mean distance in sRGB from the nearest printable colour")


class PrintCost(Fields):
    """What the terms of `printable` cost in margin: beside a search without them, of as many steps.

    Margins are means over trials with the same seeds, of what is sought: the larger, the worse for the model. Each is
    of one search, so that a cost below 0 says that the search without terms ended in a worse place.
    """

    steps: int = Field(description="evaluations of the search without the terms")
    margin_with: JsonFloat = Field(description="of the run's answer, in logits")
    margin_without: JsonFloat = Field(description="of the answer of the search without the terms, in logits")
    cost: JsonFloat = Field(description="the second less the first, in logits")
    verified: VerifiedRate = Field(description="trials of the answer of the search without the terms")
    terms: PrintTerms = Field(description="of that answer")


class Printability(Fields):
    """What `printable` was about, and what it cost."""

    clean: PrintTerms = Field(description="of the clean scene")
    answer: PrintTerms | None = Field(description="of the answer; null if nothing was searched")
    cost: PrintCost | None = Field(
        default=None, description="what the terms cost in margin; null if nothing was verified, and in older runs"
    )


class SharedWork(Fields):
    """How the workers did that shared the work, in this sitting."""

    most: int = Field(description="workers that were ready at once, at most")
    lost: int = Field(description="that went away")
    refused: int = Field(description="that could not do it")
    retried: int = Field(description="batches that were given out again")
    batches: int = Field(description="batches that came back")
    busy: JsonFloat = Field(description="seconds that workers were at batches")
    loading: JsonFloat = Field(description="seconds that they loaded scenes and models")
    alive: JsonFloat = Field(description="seconds that they were there and ready")
    utilisation: JsonFloat | None = Field(description="`busy` over `alive`")
    machines: dict[str, dict[str, str]] = Field(description="what rows call by a name, where machines are not alike")

    @classmethod
    def of_facts(cls, facts: Any, machines: Mapping[str, Mapping[str, str]]) -> SharedWork | None:
        """Return the fields from what an executor says; None where it says nothing."""
        if facts is None:
            return None
        share = min(1.0, facts.busy / facts.alive) if facts.alive else None
        return cls.model_validate({**vars(facts), "utilisation": share, "machines": machines})


class AttackSummary(SceneResult):
    """The worst configuration of a scene that was found, how sure that is, and what it cost."""

    command: ClassVar[str] = "attack"

    policy: str
    objective: str
    epsilon: float | dict[str, float | None] | None = Field(description="the budget; by control where there are more")
    norm: str | dict[str, str] = Field(description="in which the budget is measured; by control as above")
    label_set: list[str] = Field(description="the names that count as right")
    goal: str = Field(description="`a wrong answer`, `a target answer` or `a right answer`: what counts as success")
    target: list[str] | None = Field(description="the targets' names")
    over: list[str] = Field(description="the controls that varied by chance")
    conditions: dict[str, VariedValue] = Field(
        default={}, description="what they were drawn from; absent without, and of parameters of many numbers"
    )
    image_formation: Formation
    gradient_plan: PlannedGradient
    light_path_segments: PathSegments
    clean: CleanAnswer
    adversarial: PicturedAnswer | None = Field(description="of the search's answer; null if nothing was searched")
    verified: VerifiedRate | None = Field(description="trials of the answer; null if nothing was verified")
    tried_objective: TriedObjective | None = Field(default=None, description="the objective over these trials")
    baseline: BaselineSearch | None = Field(default=None, description="the random search; absent without `baseline`")
    answer_from: str | None = Field(default=None, description="`random` where the random search's answer is the run's")
    policy_verified: VerifiedRate | None = Field(default=None, description="of the policy's own answer then")
    drive: AnswerAlongDrive | None = Field(
        default=None, description="[along a drive](drives.md), with `over` a path; absent without"
    )
    average: AverageCase | None = Field(default=None, description="only with `average`")
    smallest: SmallestEpsilon | None = Field(default=None, description="only with `smallest`")
    printability: Printability | None = Field(default=None, description="only with `printable`")
    distribution: AnswerDistribution | None = Field(default=None, description="of a policy that answers with one")
    failures: DifferentFailures | None = Field(default=None, description="of a policy that looks for different ones")
    sample_count: VerificationSamples | None = Field(default=None, description="of the verification")
    transport: LinearTransport | None = Field(
        default=None, description="whether [a matrix of light transport](transport.md) predicted the searches' pictures"
    )
    claimed: SearchClaim | None = Field(default=None, description="what the search itself believes")
    gradients: SearchGradients | None = Field(default=None, description="of the search")
    configuration: dict[str, FoundValue] | None = Field(default=None, description="the answer in a few values")
    shared: SharedWork | None = Field(default=None, description="only with `workers` or `cluster`")
    renders: dict[str, int] = Field(
        description="of the search, its gradients, the baseline and the verification; `unprinted`: of the search "
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
        """The verified rate; of a run that was interrupted before, the answer so far."""
        if self.verified is None:
            return f"{self.adversarial.label}, unverified" if self.goes_on and self.adversarial else ""
        return f"{self.verified.successes}/{self.verified.trials}"
