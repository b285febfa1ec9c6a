"""The independent check of the result of a search (docs/design.md, "Verification").

The configuration is rendered again in *trials*: with new seeds, enough samples, and 8
bits per channel. The task evaluates the predictions. The clean configuration is
rendered with the same seeds, as a control group. `VerificationRule` decides on the
verdict.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
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
        n_needed = self.count_needed_successes(adversarial.n_trials)
        is_verified = adversarial.n_successes >= n_needed
        if is_verified and self._is_control_right(clean):
            return Ending.FOUND
        was_claimed = search_ending is Ending.FOUND
        return Ending.NOT_VERIFIED if was_claimed else search_ending

    def _is_control_right(self, clean: TrialCounts) -> bool:
        """Return whether enough clean trials are right.

        Without a control group nothing is needed; nor if conditions vary, as trials
        with a wrong clean prediction are left out already.
        """
        return (
            not self.has_control
            or self.has_varying_conditions
            or clean.n_successes >= self.count_needed_successes(clean.n_trials)
        )


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
    return _judge_queries(evaluate, queries, is_decided)


def _judge_queries(
    evaluate: Evaluate,
    queries: Sequence[Query],
    is_decided: Callable[[Sequence[Judgement]], bool] | None,
) -> tuple[Judgement, ...]:
    """Return the judgements of queries, until no more are needed.

    Args:
        evaluate: renders the queries and yields their evaluations, one by one.
        queries: queries of the trials.
        is_decided: whether no more trials follow, by those so far; None for never.
    """
    done: list[Judgement] = []
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
    u = domain.project(u)
    groups = _Groups(rule, looks, spp, curtailed, list(clean))
    run = partial(run_trials, evaluate, spp=spp, seed=seed, first_index=first_index)
    groups.run_until_verdict(
        run_clean=partial(run, domain.start, kind=control_kind),
        run_adversarial=partial(run, u, kind=kind, n_images=n_images),
    )
    verification = _summarize_trials(groups, claim, u)
    # without those of `clean`
    renders = len(groups.trials) + len(groups.clean_trials) - len(clean)
    return replace(verification, renders=renders, first_index=first_index)


@dataclass(eq=False)
class _Groups:
    """The trials of the adversarial and of the clean configuration, while they are run.

    Attributes:
        rule: decides what counts as a success.
        looks: numbers of trials after which there may be a verdict, ascending.
        spp: samples per pixel of the trials.
        curtailed: whether trials end early once too many have failed.
        clean_trials: trials of the clean configuration so far.
        trials: trials of the adversarial configuration so far, of the same seeds.
        min_trials: as many adversarial trials are made at least, even if too many have
            failed sooner.
        is_found_early: whether the claim was found at a look before the last one.
    """

    rule: VerificationRule
    looks: tuple[int, ...]
    spp: int
    curtailed: bool
    clean_trials: list[Judgement]
    trials: list[Judgement] = field(default_factory=list)
    min_trials: int = 0
    is_found_early: bool = False

    def __post_init__(self) -> None:
        """Compute the smallest number of trials."""
        if self.has_several_looks and not self.curtailed:
            self.min_trials = self.rule.min_trials

    @property
    def has_several_looks(self) -> bool:
        return len(self.looks) > 1

    @property
    def is_complete(self) -> bool:
        """Whether there are as many trials as were requested, and no look before."""
        return not self.has_several_looks and len(self.trials) == self.looks[0]

    def run_until_verdict(
        self,
        run_clean: Callable[..., Iterable[Judgement]],
        run_adversarial: Callable[..., Iterable[Judgement]],
    ) -> None:
        """Run trials of both groups until there is a verdict.

        Args:
            run_clean: runs trials of the clean configuration (`run_trials`).
            run_adversarial: runs trials of the adversarial configuration.
        """
        for look in self.looks:
            # Clean trials come first: they say which adversarial trials will count.
            # `count` is the number of trials of each group at this look.
            count = self._extend_clean_trials(run_clean, look)
            self._extend_adversarial_trials(run_adversarial, count)
            if self._has_verdict(count):
                break

    def _extend_adversarial_trials(
        self, run_adversarial: Callable[..., Iterable[Judgement]], count: int
    ) -> None:
        """Run the missing ones of `count` adversarial trials.

        If trials may end early, there are fewer if too many of them fail.

        Args:
            run_adversarial: runs trials of the adversarial configuration.
            count: number of trials in all.
        """
        ends_early = self.curtailed or self.has_several_looks
        is_decided = self.has_failed if ends_early else None
        n_done = len(self.trials)
        self.trials += run_adversarial(
            trials=count, n_done=n_done, is_decided=is_decided
        )

    def _has_verdict(self, count: int) -> bool:
        """Return whether no more trials follow a look; set `is_found_early`.

        Args:
            count: number of trials of each group at this look. There are fewer
                adversarial trials if too many of them have failed.
        """
        is_early = count < self.looks[-1]  # whether trials may follow
        is_success = self._is_found(count, is_early=is_early)
        self.is_found_early = is_success and is_early
        was_curtailed = len(self.trials) < count
        is_lost = was_curtailed or self.has_failed(())
        return is_lost or is_success or not is_early

    def has_failed(self, new_trials: Sequence[Judgement]) -> bool:
        """Return whether too many trials fail for the claim to hold at any look.

        Args:
            new_trials: trials of the adversarial configuration that are not in `trials`
                yet.
        """
        all_trials = [*self.trials, *new_trials]
        # largest number of trials that may count in the end
        n_total = self.looks[-1]
        if not self.has_several_looks:
            n_total = self.rule.count_valid(self.clean_trials)
        outcomes = _list_outcomes(self.rule, all_trials, self.clean_trials)
        n_allowed = self.rule.count_allowed_failures(n_total)
        has_too_many = outcomes.count(False) > n_allowed
        return len(all_trials) >= self.min_trials and has_too_many

    def _extend_clean_trials(
        self, run_clean: Callable[..., Iterable[Judgement]], look: int
    ) -> int:
        """Run clean trials until `look` of them count, or there are as many as the last
        look allows.

        If conditions vary (weather, viewpoints, ...), a clean trial that is wrong does
        not count, so another one is run instead.

        Args:
            run_clean: runs trials of the clean configuration. Like `run_trials` it
                takes `trials`, the total number, and `n_done`, how many of these are
                done.
            look: number of trials that have to count.

        Returns:
            The number of trials that this look needs, including those that do not
            count. `clean_trials` may have more than these, from another verification.
        """
        # number of trials, of which `look` have to count
        count = look
        max_trials = self.looks[-1]
        while True:
            # This runs those that are missing, so none if there are enough already.
            n_done = len(self.clean_trials)
            self.clean_trials += run_clean(trials=count, n_done=n_done)
            n_missing = look - self.rule.count_valid(self.clean_trials[:count])
            if n_missing <= 0 or count >= max_trials:
                return count
            count = min(count + n_missing, max_trials)

    def _is_found(self, count: int, *, is_early: bool) -> bool:
        """Return whether a claim holds at a look.

        Enough trials have to succeed, and the model must not be wrong about the clean
        configuration already.

        Args:
            count: number of trials at this look; further clean trials are ignored.
            is_early: whether more trials could follow.
        """
        clean_trials = self.clean_trials[:count]
        n_valid = self.rule.count_valid(clean_trials)
        n_needed = self.rule.count_needed_successes(n_valid, early=is_early)
        outcomes = _list_outcomes(self.rule, self.trials, clean_trials)
        # wrong in more than half of these trials
        clean_counts = count_right(clean_trials, self.spp)
        is_clean_wrong = self.rule.is_already_wrong(clean_counts)
        return outcomes.count(True) >= n_needed and not is_clean_wrong


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


def _summarize_trials(groups: _Groups, claim: Ending, u: Tensor) -> Verification:
    """Return the verification of a configuration by the trials of both groups.

    It has their counts, the ending, and a sentence with the reason for it. It counts
    the renders of all trials.

    Args:
        groups: trials of both groups.
        claim: how the search ended.
        u: (d,) the configuration that was verified.
    """
    rule = groups.rule
    outcomes = _list_outcomes(rule, groups.trials, groups.clean_trials)
    counts = _count_adversarial(groups, outcomes)
    clean_counts = count_right(groups.clean_trials, groups.spp)
    # At an early look, the sentence states the larger number that this look needs.
    n_needed = rule.count_needed_successes(counts.n_trials, early=groups.is_found_early)
    ending = rule.decide_ending(claim, clean_counts, counts)
    return Verification(
        ending,
        _explain_ending(ending, counts, clean_counts, n_needed),
        u,
        clean_counts,
        adversarial_counts=counts,
        clean_trials=tuple(groups.clean_trials),
        adversarial_trials=tuple(groups.trials),
        renders=len(groups.trials) + len(groups.clean_trials),
        stop_reason="asked for" if groups.is_complete else "decided",
        trial_successes=outcomes,
    )


def _count_adversarial(groups: _Groups, outcomes: Sequence[bool | None]) -> TrialCounts:
    """Return the counts of adversarial successes among the trials that count.

    Args:
        groups: trials of both groups.
        outcomes: for each adversarial trial, whether it is a success; None if it does
            not count.
    """
    # `TrialCounts` needs at least 1, as the rate of no trials would be 0 / 0.
    n_counted = max(1, len(outcomes) - outcomes.count(None))
    confidence = _choose_confidence(
        groups.rule, has_several_looks=groups.has_several_looks
    )
    return TrialCounts(outcomes.count(True), n_counted, groups.spp, confidence)


def _explain_ending(
    ending: Ending, counts: TrialCounts, clean_counts: TrialCounts, n_needed: int
) -> str:
    """Return a sentence with the ending and the counts behind it."""
    return (
        f"{ending.explanation} A success in {counts.n_successes} of "
        f"{counts.n_trials} trials, {n_needed} are needed; clean right in "
        f"{clean_counts.n_successes} of {clean_counts.n_trials}."
    )
