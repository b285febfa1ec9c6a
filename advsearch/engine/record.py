"""The state of a run, and its conversion to stored rows and results."""

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
    TrialCounts,
    Verification,
    count_right,
)
from advsearch.attacks.candidates import Bracket
from advsearch.engine.prediction import PredictedSearch
from advsearch.options import NOT_A_NUMBER, Value, count_outcomes
from advsearch.report.wording import format_count
from advsearch.runs.results import ControlGroup, LinearTransport, VerifiedRate
from advsearch.runs.store import Row
from advsearch.scene.predictor import Refusal
from advsearch.tasks import Judgement, Prediction
from advsearch.tasks.base import mean

MAX_STORED_IMAGES = 4  # number of images of each group of trials that are stored


@dataclass
class RunState:
    """The results of a run so far. A result that was not reached is None or empty.

    Attributes:
        first_look_trials: renders of the clean configuration at the search's sample
            count.
        search_result: result of the search by the policy; a claim.
        random_search_result: result of the random search.
        sample_count: how the sample count of the verification was chosen.
        clean_trials: trials of the control group.
        verification: verification of the adversarial configuration of the run.
        baseline_verification: verification of the result of the random search.
        result_without_print_terms: result of a search by the policy without print
            terms, if the search of the run has them.
        unprinted_verification: verification of that result.
        outdone_verification: verification of the policy's result, if the random search
            found a scene that is worse for the model. Then that scene is the
            adversarial one of the run.
        failure_verifications: verifications of the first different failures that the
            policy found.
        verification_by_lux: verifications of a projector's image in brighter or
            darker rooms, by lux.
        random_trials: trials of random configurations of the full space.
        smallest_change_bracket: the smallest change that makes the model fail.
        trial_images: images of the first trials, (H, W, 3) with 8-bit values in [0, 1],
            by kind and number. A resumed run only has those that it rendered itself.
        search_frames: images of the search in its order, numpy (H, W, 3) with 8-bit
            values in [0, 1].
        interrupted: whether the run was interrupted.
        predictor: predictor of the images of the searches; None if they were rendered.
        predictor_refusal: why images were not predicted, or only cropped.
        inaccuracy_refusal: why the latest predictor that was tried was too inaccurate;
            None if none was.
        crop_refusal: why full images were rendered.
        verification_renders: number of renders for trials, and for choosing their
            sample count.
        n_predicted_trials: number of trials whose image was predicted.
    """

    first_look_trials: tuple[Judgement, ...] = ()
    search_result: SearchResult | None = None
    random_search_result: SearchResult | None = None
    sample_count: SampleCount | None = None
    clean_trials: tuple[Judgement, ...] = ()
    verification: Verification | None = None
    baseline_verification: Verification | None = None
    result_without_print_terms: SearchResult | None = None
    unprinted_verification: Verification | None = None
    outdone_verification: Verification | None = None
    failure_verifications: tuple[Verification, ...] = ()
    verification_by_lux: dict[float, Verification] = field(default_factory=dict)
    random_trials: tuple[Judgement, ...] = ()
    smallest_change_bracket: Bracket | None = None
    trial_images: dict[tuple[str, int], Tensor] = field(default_factory=dict)
    search_frames: list[Any] = field(default_factory=list)
    interrupted: bool = False
    predictor: PredictedSearch | None = None
    predictor_refusal: Refusal | None = None
    inaccuracy_refusal: Refusal | None = None
    crop_refusal: Refusal | None = None
    verification_renders: int = 0
    n_predicted_trials: int = 0

    @property
    def spp(self) -> int:
        """Samples per pixel of the verification."""
        if self.sample_count is None:
            raise RuntimeError(
                "the sample count of the verification has not been chosen yet"
            )
        return self.sample_count.spp

    @property
    def transport_summary(self) -> LinearTransport:
        """How the images of the searches were predicted, or why they were not."""
        if self.predictor is None:
            reason = str(self.predictor_refusal or "nothing was searched")
            crop = str(self.crop_refusal) if self.crop_refusal else None
            return LinearTransport(used=False, reason=reason, crop=crop)
        summary = self.predictor.summarize()
        # Why a better method was not used. Any predictor is better than a crop, and one
        # that was tried before this one is cheaper.
        better_method_refusal = self.predictor_refusal or self.inaccuracy_refusal
        # If the predictor was given up, its summary has that as the reason, which
        # stays.
        # a reason is there if predictions were given up
        if summary.reason or not better_method_refusal:
            return summary
        return summary.model_copy(update={"reason": str(better_method_refusal)})


# label of a row if all workers that tried its image died; its payload has the reason
LOST_LABEL = "(no answer)"


def make_lost_remarks(n_lost: int) -> list[str]:
    """Return a sentence about the images whose workers all died, if there are any."""
    if not n_lost:
        return []
    verb, pronoun = ("has", "it") if n_lost == 1 else ("have", "them")
    return [
        f"{format_count(n_lost, 'picture')} {verb} no answer, which counts as not "
        "right: "
        f"every worker that took {pronoun} died."
    ]


def make_trial_row(
    kind: str,
    number: int,
    seed: int | None,
    spp: int,
    judgement: Judgement,
    values: Mapping[str, Value] | None = None,
    *,
    has_success: bool = True,
) -> Row:
    """Return the row of a trial in the store.

    Args:
        kind: kind of the row, such as "verification" or "control".
        number: number of the trial among those of the kind.
        seed: seed of the noise; None for a predicted image.
        spp: samples per pixel.
        judgement: judgement of its image.
        values: values of the configuration.
        has_success: whether some prediction is sought. If not, as in a sweep, the
            success of the row is None.
    """
    # A trial counts as one render. A caller may replace this.
    row = Row(
        kind,
        number,
        seed=seed,
        spp=spp,
        objective=_none_if_nan(judgement.objective),
        success=judgement.success if has_success else None,
        values=values or {},
        renders=1,
    )
    return add_judgement(row, judgement)


def add_judgement(row: Row, judgement: Judgement) -> Row:
    """Return a row with the values of a judgement; a NaN becomes None."""
    prediction = judgement.prediction
    return replace(
        row,
        score=_none_if_nan(judgement.score),
        correct=judgement.right,
        margin=_none_if_nan(judgement.margin),
        # None where the output was NaN: its index and probability are None by
        # themselves
        label=None if judgement.is_non_finite else prediction.label,
        label_index=prediction.index,
        probability=prediction.probability,
        payload=judgement.payload,
        metrics=judgement.metrics or {},
    )


def _none_if_nan(value: float | None) -> float | None:
    """Return a number, or None for NaN, which JSON does not have."""
    return None if value is None or math.isnan(value) else value


def read_judgement(row: Row) -> Judgement:
    """Return the judgement of a row, the inverse of `add_judgement`.

    A None in the row means NaN in the judgement. In a row without a label, the output
    of the model was NaN. The objective is a column of the row of its own.
    """
    prediction = Prediction(row.label or NOT_A_NUMBER, row.label_index, row.probability)
    return Judgement(
        math.nan if row.score is None else row.score,
        math.nan if row.margin is None else row.margin,
        right=bool(row.correct),
        prediction=prediction,
        payload=row.payload,
        objective=row.objective,
        metrics=row.metrics or None,
    )


def make_verified_rate(verification: Verification) -> VerifiedRate:
    """Return the rate of success of a verification as a result stores it."""
    rate = make_rate(
        counts=verification.adversarial_counts,
        trials=verification.valid_trials,
        successes=verification.successful_trials,  # for their labels and outcomes
    )
    return rate.model_copy(update={"stopped": verification.stop_reason})


def make_rate(
    counts: TrialCounts, trials: Sequence[Judgement], successes: Sequence[Judgement]
) -> VerifiedRate:
    """Return a rate of success as a result stores it.

    Args:
        counts: counts of the trials.
        trials: judgements of the trials that count. The mean margin is over those whose
            score is not NaN.
        successes: judgements of the successes, whose labels and outcomes are counted.
    """
    labels = Counter(trial.prediction.label for trial in successes)
    # The mean margin is that of minus the score, as scores and margins have opposite
    # signs. In floating point -x is -0 for a mean score of 0, but 0.0 - x is 0.
    mean_margin = 0.0 - mean_number(trial.score for trial in trials)
    return VerifiedRate(
        successes=counts.n_successes,
        spp=counts.spp,
        labels=dict(labels.most_common()),
        # outcomes such as "missed", which tasks put into the payload
        outcomes=count_outcomes(trial.payload for trial in successes),
        margin=mean_margin,
        **_rate_fields(counts, trials),
    )


def make_control_group(trials: Sequence[Judgement], spp: int) -> ControlGroup:
    """Return the trials of the clean configuration as a result stores them.

    Args:
        trials: judgements of the trials.
        spp: samples per pixel of their images.
    """
    right = count_right(trials, spp)  # counts, with the samples per pixel
    outcomes = count_outcomes(trial.payload for trial in trials if not trial.right)
    return ControlGroup(
        correct=right.n_successes, outcomes=outcomes, **_rate_fields(right, trials)
    )


def _rate_fields(counts: TrialCounts, trials: Sequence[Judgement]) -> dict[str, Any]:
    """Return the fields that all rates of a result have, from counts and trials.

    They are the number of trials, the rate with its interval, and the number of trials
    in which the model returned NaN.
    """
    n_not_a_number = sum(trial.is_non_finite for trial in trials)
    return {
        "trials": counts.n_trials,
        "rate": counts.rate,
        "interval": counts.interval,
        "not_a_number": n_not_a_number,
    }


def mean_number(values: Iterable[float]) -> float:
    """Return the mean of the values that are not NaN; NaN if there are none."""
    numbers = [value for value in values if not math.isnan(value)]
    return mean(numbers) if numbers else math.nan
