"""The independent check of the result of a search (docs/design.md, "Verification").

The configuration is rendered again in *trials*: with new seeds, enough samples, and 8
bits per channel. The task evaluates the predictions. The clean configuration is
rendered with the same seeds, as a control group. `VerificationRule` decides on the
verdict.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial

from torch import Tensor

from advsearch.attacks.domain import Domain
from advsearch.attacks.evaluation import Evaluate, Query
from advsearch.attacks.trials import TrialCounts, derive_trial_seed
from advsearch.errors import InputError
from advsearch.statistics.intervals import CONFIDENCE, clopper_pearson
from advsearch.tasks import Judgement


class Ending(Enum):
    """Why a search or a run stopped. The value is stored in JSON; `explanation` is a
    sentence for the user. The ending of a search is a claim, which `verify` has to
    confirm (docs/design.md, "Verification").
    """

    explanation: str
    FOUND = "found", "A configuration inside the budget makes the model wrong."
    BUDGET_SPENT = (
        "budget spent",
        ("All renders were spent and no configuration made the model wrong."),
    )
    NOT_VERIFIED = (
        "not verified",
        "The search claimed a wrong prediction, but it did not hold in the trials with "
        "fresh seeds.",
    )
    ALREADY_WRONG = (
        "already wrong",
        "The model is wrong on the clean configuration already, so there is nothing to "
        "attack.",
    )
    STALLED = (
        "stalled",
        ("The policy had nothing more to propose before the budget was spent."),
    )
    NON_FINITE = (
        "non-finite objective",
        ("The objective was NaN or infinite several times in a row."),
    )
    INTERRUPTED = (
        "interrupted",
        ("The search was interrupted; the best configuration so far was kept."),
    )

    def __new__(cls, value: str, explanation: str) -> Ending:
        ending = object.__new__(cls)
        ending._value_ = value
        ending.explanation = explanation
        return ending


# percentage of the trials in which a claim must hold, and of those in which the clean
# configuration must be right: 14 of 14, 19 of 20
PASS_PERCENT = 95
# percentage of the conditions in which a claim must hold, among those in which the
# clean configuration is right
PASS_PERCENT_OVER = 90

TRIAL_LOOKS = 14, 23
"""Numbers of trials after which there may be a verdict (looks), if the user set no
number. `found` needs 14 of 14, or 22 of 23 successes.

A claim that holds in at most 75 % of trials is found in at most 2.4 % of all cases, as
with 19 of 20. The interval of the rate of what is found begins at 77 %, with 19 of 20
at 75 %. `benchmarks/verdicts.py` computes both exactly.
"""

OVER_EARLY = {30: 30, 60: 59, 100: 95, 150: 141}
OVER_LOOKS = *OVER_EARLY, 200
"""Numbers of trials over many conditions after which there may be a verdict (looks), if
the user set no number. All but the last are numbers of trials that count, which are
those in which the clean configuration is right; `OVER_EARLY` has the successes that
each of them needs. The last look is after 200 trials, whether they count or not.

A claim that holds in at most 85 % of trials is found in at most 3.3 % of all cases, and
in 2.6 % with a single look at 180 of 200.
"""
OVER_CONFIDENCE = 0.97
"""Confidence of a Clopper-Pearson interval after `OVER_LOOKS`. It is over 95 %, because
several looks raise the chance of a lucky one. So the interval covers the rate in 95 %
of all cases (`benchmarks/verdicts.py`).
"""

MIN_RATE = 0.5
"""Smallest lower bound of the 95 % interval of the success rate of a verified claim: it
holds in more than half of all trials. So at least 6 trials are needed to verify
anything: the interval of 6 of 6 is 54 to 100 %, that of 5 of 5 begins at 48 %.
"""


@dataclass(frozen=True)
class VerificationRule:
    """When a claim counts as verified.

    Attributes:
        required_percent: percentage of the trials that have to succeed.
        has_control: whether the clean configuration is a control group. Then a trial
            only succeeds if the clean prediction with the same seed is right, and the
            clean configuration has to be right in `required_percent` of its trials as
            well.
        has_varying_conditions: whether conditions vary from trial to trial, some of
            which may be difficult by themselves. Then only trials with a right clean
            prediction count, and the percentage is of these. The clean configuration
            has to be right in half of all trials.
    """

    required_percent: int = PASS_PERCENT
    has_control: bool = True
    has_varying_conditions: bool = False

    def count_needed_successes(self, trials: int, *, early: bool = False) -> int:
        """Return how many of `trials` must succeed.

        It is the rule's percentage of them, rounded up, and at least `min_trials`.

        Args:
            trials: number of trials that count.
            early: whether more trials could follow. A rule over conditions then needs
                the larger number in `OVER_EARLY`, because several looks raise the
                chance of a lucky one.
        """
        n_required = self.count_percent(trials)
        if early and self.has_varying_conditions:
            # Every look before the last one is after a number of trials that count
            # which is a key of `OVER_EARLY`.
            n_required = OVER_EARLY[trials]
        # with fewer trials than `min_trials`, even all successes are not enough
        return max(n_required, self.min_trials)

    def count_allowed_failures(self, trials: int) -> int:
        """Return how many of `trials` may fail; below 0 for too few trials."""
        return trials - self.count_needed_successes(trials)

    @property
    def min_trials(self) -> int:
        """Smallest number of trials that can verify a claim.

        If `required_percent` of these trials succeed, the lower bound of the interval
        of the success rate is at least `MIN_RATE`.
        """
        return next(
            n
            for n in itertools.count(1)
            if clopper_pearson(self.count_percent(n), n)[0] >= MIN_RATE
        )

    def count_percent(self, trials: int) -> int:
        """Return the percentage of a number of trials, rounded up."""
        return -(-self.required_percent * trials // 100)  # `//` rounds down

    def is_success(self, trial: Judgement, clean: Judgement) -> bool:
        """Return whether a trial is a success, given the clean trial of the same seed.

        With a control group, the clean prediction has to be right, so that failures
        that the noise alone causes do not count. Without one, the score of the trial
        has to exceed that of the clean trial. Scores are those of the task: the larger,
        the closer to what the search seeks.
        """
        if not trial.success:
            return False
        return clean.right if self.has_control else trial.score > clean.score

    def count_valid(self, clean: Sequence[Judgement]) -> int:
        """Return how many trials count, given the clean trials of the same seeds.

        Over conditions, only those count in which the clean configuration is right.
        """
        if not self.has_varying_conditions:
            return len(clean)
        return sum(trial.right for trial in clean)

    def is_already_wrong(self, clean: TrialCounts) -> bool:
        """Return whether the clean configuration is right in less than half of its
        trials, so that there is nothing to attack; False without a control group.
        """
        return self.has_control and 2 * clean.n_successes < clean.n_trials

    def decide(self, successes: int, trials: int) -> bool | None:
        """Return whether a configuration is a success by its trials.

        True if almost all trials succeed, and False if almost all fail: then the rarer
        outcome occurs at most as often as the rule allows failures. Otherwise the
        outcome depends on the noise, and the result is None.
        """
        failures = trials - successes
        n_exceptions = min(successes, failures)
        if n_exceptions > self.count_allowed_failures(trials):
            return None
        return successes >= self.count_needed_successes(trials)

    def decide_ending(
        self, search_ending: Ending, clean: TrialCounts, adversarial: TrialCounts
    ) -> Ending:
        """Return the ending of a run, by its search and by the trials of both groups.

        It is ALREADY_WRONG if the model is wrong about the clean configuration,
        whatever else holds. It is FOUND if the adversarial trials have as many
        successes as the rule needs, even if the search claimed nothing. The clean
        trials need as many right predictions, unless there is no control group, or
        conditions vary: then trials with a wrong clean prediction are left out already.

        A claim of the search that the trials do not confirm is NOT_VERIFIED. Any other
        ending of the search stays.

        Args:
            search_ending: how the search ended. INTERRUPTED is never changed.
            clean: counts of the clean configuration, whose successes are right
                predictions.
            adversarial: counts of the configuration that the search found.
        """
        if search_ending is Ending.INTERRUPTED:
            return search_ending
        if self.is_already_wrong(clean):
            return Ending.ALREADY_WRONG
        is_verified = adversarial.n_successes >= self.count_needed_successes(
            adversarial.n_trials
        )
        is_control_right = (
            not self.has_control
            or self.has_varying_conditions
            or clean.n_successes >= self.count_needed_successes(clean.n_trials)
        )
        if is_control_right and is_verified:
            return Ending.FOUND
        was_claimed = search_ending is Ending.FOUND
        return Ending.NOT_VERIFIED if was_claimed else search_ending


WORST_CASE = VerificationRule()
OVER_CONDITIONS = VerificationRule(PASS_PERCENT_OVER, has_varying_conditions=True)
EASIER = VerificationRule(has_control=False)
"""For `--minimise`: the clean configuration may be wrong, so there is no control group.
But a success has to have a larger score than the clean trial with the same seed.
"""


@dataclass(frozen=True, eq=False)
class Verification:
    """The result of the trials.

    Attributes:
        ending: ending of the run, by `VerificationRule.decide_ending`.
        counts_sentence: one sentence with the counts behind it.
        u: (d,) the configuration that was verified, projected into its budget again.
        clean_counts: counts of right predictions in the control group.
        adversarial_counts: counts of successes, by `VerificationRule.is_success`.
        clean_trials: all trials of the clean configuration, in the order of their
            seeds.
        adversarial_trials: all trials of the adversarial configuration, in the same
            order. If trials are curtailed, there are fewer of these.
        renders: number of renders of the trials.
        stop_reason: why there are no more trials: "asked for" (the number that was
            requested) or "decided" (further ones could not change the verdict).
        trial_successes: for each adversarial trial, whether it is a success. None if it
            does not count, because the clean prediction is wrong under its conditions.
        first_index: index of the first trial.
    """

    ending: Ending
    counts_sentence: str
    u: Tensor
    clean_counts: TrialCounts
    adversarial_counts: TrialCounts
    clean_trials: tuple[Judgement, ...]
    adversarial_trials: tuple[Judgement, ...]
    renders: int
    stop_reason: str
    trial_successes: tuple[bool | None, ...]
    first_index: int = 0

    @property
    def valid_trials(self) -> tuple[Judgement, ...]:
        """The adversarial trials that count; if none does, all of them."""
        valid_trials = tuple(
            trial
            for trial, outcome in zip(
                self.adversarial_trials, self.trial_successes, strict=True
            )
            if outcome is not None
        )
        return valid_trials or self.adversarial_trials

    @property
    def successful_trials(self) -> tuple[Judgement, ...]:
        """The adversarial trials that are a success."""
        return tuple(itertools.compress(self.adversarial_trials, self.trial_successes))


def run_trials(
    evaluate: Evaluate,
    u: Tensor,
    *,
    spp: int,
    seed: int,
    trials: int = 20,
    n_done: int = 0,
    first_index: int = 0,
    kind: str = "verification",
    n_images: int = 0,
    is_decided: Callable[[Sequence[Judgement]], bool] | None = None,
) -> tuple[Judgement, ...]:
    """Render and judge one configuration in several trials; return the new ones.

    The seed of trial k follows from the root seed and k, whatever the kind of the
    queries. So two groups with the same root seed are rendered with the same noise,
    which makes one of them the control group of the other.

    Args:
        evaluate: renders the queries and yields their evaluations, one by one.
        u: (d,) the configuration.
        spp: samples per pixel.
        seed: root seed.
        trials: number of trials in all, including those that are done.
        n_done: number of trials, the first ones, that are done already; they are not
            repeated.
        first_index: index k of the first of all trials, done or not.
        kind: kind of the queries, such as "verification" or "control".
        n_images: number of trials, the first ones, whose images are requested.
        is_decided: called with the new trials after each of them; if it returns True,
            no more follow.

    Raises:
        InputError: `spp` or `trials` is less than 1.
    """
    if trials < 1:
        raise InputError(f"trials: expected at least 1, got {trials}")
    if spp < 1:
        raise InputError(f"verify_spp: expected at least 1, got {spp}")
    done: list[Judgement] = []
    queries = [
        Query(
            u,
            derive_trial_seed(seed, number),
            kind,
            number,
            spp=spp,
            includes_image=number < first_index + n_images,
        )
        for number in range(first_index + n_done, first_index + trials)
    ]
    for evaluation in evaluate(queries):
        done.append(evaluation.required_judgement)
        # Leaving the loop means that the remaining queries are not evaluated.
        if is_decided is not None and is_decided(done):
            return tuple(done)
    if len(done) != len(queries):
        raise RuntimeError(f"evaluate answered {len(done)} of {len(queries)} queries")
    return tuple(done)


def count_right(trials: Sequence[Judgement], spp: int) -> TrialCounts:
    """Count the right predictions of a control group."""
    return TrialCounts(sum(trial.right for trial in trials), len(trials), spp)


def verify(
    evaluate: Evaluate,
    domain: Domain,
    u: Tensor,
    *,
    claim: Ending,
    spp: int,
    seed: int,
    trials: int | Sequence[int] = 20,
    clean: Sequence[Judgement] = (),
    rule: VerificationRule = WORST_CASE,
    kind: str = "verification",
    control_kind: str = "control",
    n_images: int = 0,
    curtailed: bool = False,
    first_index: int = 0,
) -> Verification:
    """Check a search's configuration in new trials, with the clean one as control.

    `trials` may be several ascending numbers, such as `TRIAL_LOOKS`. They are looks:
    after that many trials the successes are counted, and if they suffice, no more
    trials follow. If conditions vary, a look is after this many trials that count:
    those with a right clean prediction (`OVER_LOOKS`). The last number is the maximum
    of all trials.

    Curtailed trials end as soon as more have failed than the rule allows: the remaining
    trials could not change the verdict. Their Clopper-Pearson interval still covers the
    rate in 95 % of all cases, because it contains the exact interval of this stopping
    rule (Jennison and Turnbull 1983).

    Trials with several looks are always curtailed, but at least
    `VerificationRule.min_trials` are made, as fewer say nothing about the rate.
    `benchmarks/verdicts.py` checks that their intervals cover the rate, from the
    probability of every outcome.

    Args:
        evaluate: renders the queries and yields their evaluations.
        domain: the budget; the clean configuration is its start.
        u: (d,) the adversarial configuration; projected into the domain again.
        claim: how the search ended; FOUND if it claims a failure.
        spp: samples per pixel.
        seed: root seed. Must not be one that the search rendered with through the same
            stream.
        trials: number of trials of each group; or ascending numbers, the looks.
        clean: trials of the clean configuration that `run_trials` has run already, with
            the same spp and seed. So an attack and its baseline can share a control
            group. Missing ones are run here.
        rule: decides what counts as a success, and on the ending.
        kind: kind of the queries of the adversarial configuration.
        control_kind: kind of the queries of the clean configuration.
        n_images: number of adversarial trials, the first ones, with an image.
        curtailed: whether trials end early once too many have failed. This is for a
            claim if only the verdict matters, not the rate.
        first_index: index of the first trial, which decides its seed. If trials chose
            the configuration, the new ones must begin after these.
    """
    looks = (trials,) if isinstance(trials, int) else tuple(trials)
    has_several_looks = len(looks) > 1
    # As many adversarial trials are made at least, even if too many have failed sooner.
    min_trials = rule.min_trials if has_several_looks and not curtailed else 0
    u = domain.project(u)
    clean_trials = list(clean)
    done = list[Judgement]()

    def has_failed(new_trials: Sequence[Judgement]) -> bool:
        """Return whether too many trials fail for the claim to hold at any look."""
        all_trials = [*done, *new_trials]
        # largest number of trials that may count in the end
        n_total = looks[-1] if has_several_looks else rule.count_valid(clean_trials)
        has_too_many = _fails_too_often(rule, all_trials, clean_trials, n_total)
        return len(all_trials) >= min_trials and has_too_many

    run = partial(run_trials, evaluate, spp=spp, seed=seed, first_index=first_index)
    run_clean = partial(run, domain.start, kind=control_kind)
    is_decided = has_failed if curtailed or has_several_looks else None
    for look in looks:
        # Clean trials come first: they say which adversarial trials will count.
        # `count` is the number of trials of each group at this look.
        count = _extend_clean_trials(clean_trials, run_clean, rule, look, looks[-1])
        done += run(
            u,
            trials=count,
            n_done=len(done),
            kind=kind,
            n_images=n_images,
            is_decided=is_decided,
        )
        is_early = count < looks[-1]  # whether trials may follow
        is_success = _is_found(
            rule, done, clean_trials, count, spp=spp, is_early=is_early
        )
        # `run` stops before `count` trials if too many of them failed.
        was_curtailed = len(done) < count
        if was_curtailed or has_failed(()) or is_success or not is_early:
            break
    # as many trials as were requested, and no look before
    is_complete = not has_several_looks and len(done) == looks[0]
    return _summarize_trials(
        rule,
        claim,
        u,
        clean_trials,
        done,
        spp=spp,
        confidence=_choose_confidence(rule, has_several_looks=has_several_looks),
        renders=len(done) + len(clean_trials) - len(clean),  # without those of `clean`
        stop_reason="asked for" if is_complete else "decided",
        is_early=is_success and is_early,
        first_index=first_index,
    )


def _fails_too_often(
    rule: VerificationRule,
    trials: Sequence[Judgement],
    clean_trials: Sequence[Judgement],
    n_total: int,
) -> bool:
    """Return whether more trials have failed than the rule allows of `n_total` trials.

    Args:
        rule: says what a failure is, and how many are allowed.
        trials: trials of the adversarial configuration so far.
        clean_trials: clean trials of the same seeds, or more.
        n_total: number of trials that there may be in the end.
    """
    n_failures = _list_outcomes(rule, trials, clean_trials).count(False)
    return n_failures > rule.count_allowed_failures(n_total)


def _choose_confidence(rule: VerificationRule, *, has_several_looks: bool) -> float:
    """Return the confidence of the Clopper-Pearson interval of the success rate.

    If conditions vary and there are several looks, it is larger than 95 %, so that the
    interval still covers the rate in 95 % of all cases.
    """
    return (
        OVER_CONFIDENCE
        if rule.has_varying_conditions and has_several_looks
        else CONFIDENCE
    )


def _extend_clean_trials(
    clean_trials: list[Judgement],
    run_clean: Callable[..., Iterable[Judgement]],
    rule: VerificationRule,
    look: int,
    max_trials: int,
) -> int:
    """Run clean trials until `look` of them count, or there are `max_trials`.

    If conditions vary (weather, viewpoints, ...), a clean trial that is wrong does not
    count, so another one is run in its place.

    Args:
        clean_trials: clean trials so far; new ones are appended.
        run_clean: runs trials of the clean configuration. Like `run_trials` it takes
            `trials`, the total number, and `n_done`, how many of these are done.
        rule: decides which trials count.
        look: number of trials that have to count.
        max_trials: maximum number of trials.

    Returns:
        The number of trials that this look needs, including those that do not count.
        `clean_trials` may have more than these, from another verification.
    """
    # number of trials, of which `look` have to count
    count = look
    # `run_clean` runs those that are missing, so none if there are enough already.
    clean_trials += run_clean(trials=count, n_done=len(clean_trials))
    n_missing = look - rule.count_valid(clean_trials[:count])
    while n_missing > 0 and count < max_trials:
        count = min(count + n_missing, max_trials)
        clean_trials += run_clean(trials=count, n_done=len(clean_trials))
        n_missing = look - rule.count_valid(clean_trials[:count])
    return count


def _is_found(
    rule: VerificationRule,
    trials: Sequence[Judgement],
    clean_trials: Sequence[Judgement],
    count: int,
    *,
    spp: int,
    is_early: bool,
) -> bool:
    """Return whether a claim holds at a look.

    Enough trials have to succeed, and the model must not be wrong about the clean
    configuration already.

    Args:
        rule: decides how many have to succeed.
        trials: trials of the adversarial configuration, at most `count`.
        clean_trials: clean trials of the same seeds, or more.
        count: number of trials at this look; further clean trials are ignored.
        spp: samples per pixel of the trials.
        is_early: whether more trials could follow.
    """
    clean_trials_of_look = clean_trials[:count]
    n_valid = rule.count_valid(clean_trials_of_look)
    n_needed = rule.count_needed_successes(n_valid, early=is_early)
    outcomes = _list_outcomes(rule, trials, clean_trials_of_look)
    n_successes = outcomes.count(True)
    # wrong in more than half of these trials
    is_clean_wrong = rule.is_already_wrong(count_right(clean_trials_of_look, spp))
    return n_successes >= n_needed and not is_clean_wrong


def _list_outcomes(
    rule: VerificationRule,
    trials: Sequence[Judgement],
    clean_trials: Sequence[Judgement],
) -> tuple[bool | None, ...]:
    """Return whether each trial is a success, or None if it does not count.

    If conditions vary, a trial does not count if the clean prediction under the same
    conditions is wrong.

    Args:
        rule: decides what a success is.
        trials: trials of the adversarial configuration.
        clean_trials: clean trials of the same seeds. There may be more than `trials`;
            further ones are ignored.
    """
    outcomes: list[bool | None] = []
    for trial, clean in zip(trials, clean_trials, strict=False):
        if rule.has_varying_conditions and not clean.right:
            outcomes.append(None)
        else:
            outcomes.append(rule.is_success(trial, clean))
    return tuple(outcomes)


def _summarize_trials(
    rule: VerificationRule,
    claim: Ending,
    u: Tensor,
    clean_trials: Sequence[Judgement],
    trials: Sequence[Judgement],
    *,
    spp: int,
    confidence: float,
    renders: int,
    stop_reason: str,
    is_early: bool,
    first_index: int,
) -> Verification:
    """Return the verification of a configuration by the trials of both groups.

    It has their counts, the ending, and a sentence with the reason for it.

    Args:
        rule: says what a success is, and how many are needed.
        claim: how the search ended.
        u: (d,) the configuration that was verified.
        clean_trials, trials: clean trials and trials of both groups, in the order of
            their seeds.
        spp: samples per pixel.
        confidence: confidence of the interval of the success rate.
        renders: number of renders that the trials took.
        stop_reason: why there are no more trials: "asked for" or "decided".
        is_early: whether the claim was found at an early look. Then the reason states
            the larger number of successes that this look needs.
        first_index: index of the first trial.
    """
    outcomes = _list_outcomes(rule, trials, clean_trials)
    # None marks a trial that does not count. `TrialCounts` needs at least 1, as the
    # rate of no trials would be 0 / 0.
    n_counted = max(1, len(outcomes) - outcomes.count(None))
    clean_counts = count_right(clean_trials, spp)
    counts = TrialCounts(outcomes.count(True), n_counted, spp, confidence)
    ending = rule.decide_ending(claim, clean_counts, counts)
    n_needed = rule.count_needed_successes(n_counted, early=is_early)
    reason = (
        f"{ending.explanation} A success in {counts.n_successes} of {n_counted} "
        f"trials, {n_needed} are needed; clean right in "
        f"{clean_counts.n_successes} of {clean_counts.n_trials}."
    )
    return Verification(
        ending,
        reason,
        u,
        clean_counts,
        adversarial_counts=counts,
        clean_trials=tuple(clean_trials),
        adversarial_trials=tuple(trials),
        renders=renders,
        stop_reason=stop_reason,
        trial_successes=outcomes,
        first_index=first_index,
    )
