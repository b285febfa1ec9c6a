"""What is known of a run so far, and kept of it: findings and stages of an attack,
judgements as rows, measurements.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from torch import Tensor

from advsearch.attacks import (
    SampleCount,
    SearchResult,
    Trials,
    Verification,
    count_right,
)
from advsearch.attacks.candidates import Bracket
from advsearch.engine.transport import PredictedSearch
from advsearch.options import NOT_A_NUMBER, Value, count_outcomes
from advsearch.report.wording import count
from advsearch.runs.results import ControlGroup, LinearTransport, VerifiedRate
from advsearch.runs.store import Row
from advsearch.scene.predictor import Refusal
from advsearch.tasks import Judgement, Prediction
from advsearch.tasks.base import mean

KEPT = 4  # pictures of each group of trials that are kept


@dataclass
class Findings:
    """What is known so far; whatever is still None or empty was not reached."""

    # renders of the clean configuration at the search's sample count
    first_look: tuple[Judgement, ...] = ()
    # what the policy claims; `verification` is what trials say of it
    search: SearchResult | None = None
    baseline: SearchResult | None = None  # the same of the random search
    sample_count: SampleCount | None = None  # how that of the verification was chosen
    clean: tuple[Judgement, ...] = ()  # the control group's trials
    verification: Verification | None = None
    baseline_verification: Verification | None = None
    # of the policy without print terms, where the search has them
    unprinted: SearchResult | None = None
    unprinted_verification: Verification | None = None
    # of what the policy found, where the random search's is worse for the model and the
    # run's adversarial scene instead
    beaten: Verification | None = None
    # of the first of the different failures that the policy found
    failures: tuple[Verification, ...] = ()
    # of a projector's picture in other light, by lux
    ambient: dict[float, Verification] = field(default_factory=dict)
    # trials of configurations drawn from the whole space
    average: tuple[Judgement, ...] = ()
    smallest: Bracket | None = None
    # of the first trials, (H, W, 3) with 8-bit values in [0, 1], by kind and number; of
    # a run that goes on only its own
    pictures: dict[tuple[str, int], Tensor] = field(default_factory=dict)
    # of the search, (H, W, 3) 8-bit values in [0, 1], numpy
    frames: list[Any] = field(default_factory=list)
    interrupted: bool = False
    # what predicted the pictures of the searches, if anything did
    transport: PredictedSearch | None = None
    rendered_because: Refusal | None = None  # why nothing did
    # why matrices did and not light on surfaces, where that was tried
    surface_refused: Refusal | None = None
    # renders spent on choosing the sample count and on trials
    verification_renders: int = 0
    predicted_trials: int = 0

    @property
    def spp(self) -> int:
        if self.sample_count is None:
            raise RuntimeError(
                "the sample count of the verification has not been chosen yet"
            )
        return self.sample_count.spp

    @property
    def transport_summary(self) -> LinearTransport:
        """What predicted the images of the searches, and how far it was off; or why
        nothing did.
        """
        if self.transport is None:
            return LinearTransport(
                used=False, reason=str(self.rendered_because or "nothing was searched")
            )
        predicted = self.transport.summary()
        surface_refused = str(self.surface_refused) if self.surface_refused else None
        return predicted.model_copy(
            update={"reason": predicted.reason or surface_refused}
        )


# the label of a picture that nobody could make; what the row keeps beside it says why
LOST = "(no answer)"


def lost_remarks(lost: int) -> list[str]:
    """Return what a reader has to know of so many pictures that nobody could make."""
    if not lost:
        return []
    has, it = ("has", "it") if lost == 1 else ("have", "them")
    return [
        f"{count(lost, 'picture')} {has} no answer, which counts as not right: "
        f"every worker that took {it} died."
    ]


def trial_row(
    kind: str,
    number: int,
    seed: int | None,
    spp: int,
    trial: Judgement,
    values: Mapping[str, Value] | None = None,
    *,
    sought: bool = True,
) -> Row:
    """Return what the store keeps of a trial; the seed is None of a picture that was
    predicted. There is a success only where a search sought some prediction.
    """
    objective = _number(trial.objective)
    success = trial.success if sought else None
    row = Row(
        kind,
        number,
        seed=seed,
        spp=spp,
        objective=objective,
        success=success,
        values=values or {},
        renders=1,
    )
    return judged(row, trial)


def judged(row: Row, judgement: Judgement) -> Row:
    prediction = judgement.prediction
    return replace(
        row,
        score=_number(judgement.score),
        correct=judgement.right,
        margin=_number(judgement.margin),
        label=None if judgement.not_a_number else prediction.label,
        label_index=prediction.index,
        probability=prediction.probability,
        payload=judgement.payload,
        metrics=judgement.metrics or {},
    )


def _number(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else value


def judgement_of(row: Row) -> Judgement:
    """Return what was said of a trial from its row: nothing where it has no label, for
    the output was not a number.
    """
    score, margin = (
        math.nan if value is None else value for value in (row.score, row.margin)
    )
    prediction = Prediction(row.label or NOT_A_NUMBER, row.label_index, row.probability)
    return Judgement(
        score,
        margin,
        bool(row.correct),
        prediction,
        row.payload,
        row.objective,
        row.metrics or None,
    )


def verified_rate(checked: Verification) -> VerifiedRate:
    """Return the rate of a success, with how often each such prediction was given and
    the mean score of the trials.
    """
    rated = rate_of(checked.adversarial, checked.counting, checked.successes)
    return rated.model_copy(update={"stopped": checked.stopped})


def rate_of(
    rate: Trials, trials: Sequence[Judgement], successes: Sequence[Judgement]
) -> VerifiedRate:
    """Return a rate with the predictions of its successes and the mean score of those
    that are a number.
    """
    labels = dict(Counter(trial.prediction.label for trial in successes).most_common())
    margin = 0.0 - mean_number(trial.score for trial in trials)
    counted = _counted(rate, trials)
    outcomes = count_outcomes(trial.payload for trial in successes)
    return VerifiedRate(
        successes=rate.successes,
        spp=rate.spp,
        labels=labels,
        outcomes=outcomes,
        margin=margin,
        **counted,
    )


def control_group(trials: Sequence[Judgement], spp: int) -> ControlGroup:
    right = count_right(trials, spp)
    outcomes = count_outcomes(trial.payload for trial in trials if not trial.right)
    return ControlGroup(
        correct=right.successes, outcomes=outcomes, **_counted(right, trials)
    )


def _counted(rate: Trials, trials: Sequence[Judgement]) -> dict[str, Any]:
    nothing = sum(trial.not_a_number for trial in trials)
    return {
        "trials": rate.trials,
        "rate": rate.rate,
        "interval": rate.interval,
        "not_a_number": nothing,
    }


def mean_number(values: Iterable[float]) -> float:
    """Return the mean of those that are numbers; NaN where none is."""
    numbers = [value for value in values if not math.isnan(value)]
    return mean(numbers) if numbers else math.nan
