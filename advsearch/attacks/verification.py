"""The independent check of what a search found (docs/design.md, "Verification"): fresh
seeds, enough samples, 8 bits, a task that judges, and a control group of the clean
configuration. The rule of a verdict stands here only.
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
from advsearch.attacks.trials import Trials, derive_trial_seed
from advsearch.errors import InputError
from advsearch.statistics.intervals import CONFIDENCE, clopper_pearson
from advsearch.tasks import Judgement


class Ending(Enum):
    """Why a search or a run stopped. The value is what JSON holds; `explanation` is one
    sentence for a person. What a search ends with is a claim; only `verify` makes it a
    finding (docs/design.md, "Verification").
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
"""Trials after which a verdict may stand, if the user set no number: `found` takes 14
of 14, or 22 of 23.

What holds in 75 % or less is found in 2.4 % of all cases at most, as by 19 of 20, and
the interval of what is found begins at 77 %, by 19 of 20 at 75 %.
`benchmarks/verdicts.py` has both exactly.
"""

OVER_EARLY = {30: 30, 60: 59, 100: 95, 150: 141}
OVER_LOOKS = *OVER_EARLY, 200
"""Trials over many conditions after which a verdict may stand, if the user set no
number. All but the last are numbers of trials that count (the clean configuration is
right), with the successes that `OVER_EARLY` has for them; the last is one of all
trials.

What holds in 85 % or less is found in 3.3 % of all cases at most, and in 2.6 % by 180
of 200 alone.
"""
OVER_CONFIDENCE = 0.97
"""Confidence of a Clopper-Pearson interval after `OVER_LOOKS`, so that it covers the
rate in 95 % of all cases (`benchmarks/verdicts.py`): somebody who looks five times is
lucky more often than somebody who looks once.
"""

MIN_RATE = 0.5
"""Where the 95 % interval of a claim's rate may begin: what is called found holds more
often than not. So 6 trials are the fewest that can verify anything (54 to 100 %); 5 of
5 begin at 48 %.
"""


@dataclass(frozen=True)
class Rule:
    """When a claim counts as verified."""

    percent: int = PASS_PERCENT  # percent of the trials in which it must hold
    has_control: bool = True
    """A success counts only where the clean configuration is right, which it has to be
    in as many per cent.
    """
    is_conditional: bool = False
    """The percentage is one of the trials in which the clean configuration is right,
    and it has to be right in half of all: for conditions that vary, and may be hard
    ones by themselves.
    """

    def count_needed(self, trials: int, *, early: bool = False) -> int:
        """Return how many of `trials` must succeed.

        It is the rule's percentage of them, rounded up, and at least `min_trials`.

        Args:
            trials: number of trials that count.
            early: whether more trials could follow. A rule over conditions then needs
                the larger number in `OVER_EARLY`, because several looks raise the
                chance of a lucky one.
        """
        n_required = self.count_percent(trials)
        if early and self.is_conditional:
            n_required = OVER_EARLY[trials]
        return max(n_required, self.min_trials)

    def count_allowed_failures(self, trials: int) -> int:
        return trials - self.count_needed(trials)

    @property
    def min_trials(self) -> int:
        """Smallest number of trials that can verify anything: if as many succeed as the
        percentage needs, the interval of the rate begins at `MIN_RATE` at least.
        """
        return next(
            n
            for n in itertools.count(1)
            if clopper_pearson(self.count_percent(n), n)[0] >= MIN_RATE
        )

    def count_percent(self, trials: int) -> int:
        """Return the percentage of a number of trials, rounded up."""
        return -(-self.percent * trials // 100)  # `//` rounds down

    def is_success(self, trial: Judgement, clean: Judgement) -> bool:
        """Return whether a trial is a success, given the clean trial of the same seed.

        With a control group, the clean trial has to be right, so that failures by noise
        alone do not count. Without one, the trial needs a larger score than the clean.
        """
        if not trial.success:
            return False
        return clean.right if self.has_control else trial.score > clean.score

    def count_valid(self, clean: Sequence[Judgement]) -> int:
        """Return how many trials count, given the clean trials of the same seeds.

        Over conditions, only those count in which the clean configuration is right.
        """
        if not self.is_conditional:
            return len(clean)
        return sum(trial.right for trial in clean)

    def is_already_wrong(self, clean: Trials) -> bool:
        """Return whether the clean configuration is right in less than half of its
        trials, so that there is nothing to attack; False without a control group.
        """
        return self.has_control and 2 * clean.successes < clean.trials

    def decide(self, successes: int, trials: int) -> bool | None:
        """Return whether a configuration is a success by its trials.

        None if that depends on the noise: it succeeds too often to be called a failure
        and fails too often to be called a success. Trials agree if the rarer outcome,
        whichever it is, occurs at most as often as the rule allows failures.
        """
        failures = trials - successes
        n_exceptions = min(successes, failures)
        if n_exceptions > self.count_allowed_failures(trials):
            return None
        return successes >= self.count_needed(trials)

    def decide_ending(
        self, search: Ending, clean: Trials, adversarial: Trials
    ) -> Ending:
        """Return the ending of a run, by its search and by the trials of both groups.

        It is FOUND if both groups have as many successes as the rule needs, even if the
        search claimed nothing. Over conditions, or without a control group, only the
        adversarial trials need as many.

        Args:
            search: how the search ended. INTERRUPTED is never changed.
            clean: counts of the clean configuration, whose successes are right
                predictions.
            adversarial: counts of the configuration that the search found.
        """
        if search is Ending.INTERRUPTED:
            return search
        if self.is_already_wrong(clean):
            return Ending.ALREADY_WRONG
        is_verified = adversarial.successes >= self.count_needed(adversarial.trials)
        is_control_right = (
            not self.has_control
            or self.is_conditional
            or clean.successes >= self.count_needed(clean.trials)
        )
        if is_control_right and is_verified:
            return Ending.FOUND
        return Ending.NOT_VERIFIED if search is Ending.FOUND else search


WORST_CASE = Rule()
OVER_CONDITIONS = Rule(PASS_PERCENT_OVER, is_conditional=True)
EASIER = Rule(has_control=False)
"""For `--minimise`: the clean configuration may be wrong, so there is no control group
to pass; but a success has to be recognised better than the clean one with the same
seed.
"""


@dataclass(frozen=True, eq=False)
class Verification:
    """What the trials say."""

    ending: Ending  # the run's; see `Rule.decide_ending`
    reason: str  # one sentence with the numbers behind it
    u: Tensor  # (d,) the configuration verified, projected into its budget again
    clean_counts: Trials  # right predictions of the control group
    adversarial_counts: Trials  # successes, by `Rule.is_success`
    # every single trial, in the order of their seeds
    clean_trials: tuple[Judgement, ...]
    # likewise; of curtailed ones this group is the shorter
    adversarial_trials: tuple[Judgement, ...]
    renders: int  # spent here
    # why there are no more trials: "asked for" (as many as were), "decided" (the
    # verdict stands)
    stopped: str
    outcomes: tuple[bool | None, ...]
    """Of each trial of the second group, whether it is a success; None where it does
    not count, as under its conditions the clean configuration is wrong.
    """
    first_index: int = 0  # the number of the first trial

    @property
    def valid_trials(self) -> tuple[Judgement, ...]:
        """The adversarial trials that count; all of them if none does."""
        valid_trials = tuple(
            trial
            for trial, outcome in zip(
                self.adversarial_trials, self.outcomes, strict=True
            )
            if outcome is not None
        )
        return valid_trials or self.adversarial_trials

    @property
    def successful_trials(self) -> tuple[Judgement, ...]:
        return tuple(itertools.compress(self.adversarial_trials, self.outcomes))


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

    Trial k has the seed k of the stream "verification" of the root seed. So two groups
    with the same root seed are rendered with the same noise, which makes one of them
    the control group of the other.

    Args:
        evaluate: renders the queries and yields their evaluations, one by one.
        u: (d,) the configuration.
        spp: samples per pixel.
        seed: root seed.
        trials: number of trials, those that are done included.
        n_done: number of trials that are done already; they are not repeated.
        first_index: index k of the first trial.
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
            with_image=number < first_index + n_images,
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


def count_right(trials: Sequence[Judgement], spp: int) -> Trials:
    """Count the right predictions of a control group."""
    return Trials(sum(trial.right for trial in trials), len(trials), spp)


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
    rule: Rule = WORST_CASE,
    kind: str = "verification",
    control_kind: str = "control",
    n_images: int = 0,
    curtailed: bool = False,
    first_index: int = 0,
) -> Verification:
    """Check a search's configuration in new trials, with the clean one as control.

    `trials` may be several ascending numbers, such as `TRIAL_LOOKS`. They are looks:
    after that many trials the successes are counted, and if they suffice, no more
    trials follow. Over conditions only trials with a right clean prediction count: a
    look is then at so many of these (`OVER_LOOKS`), but the last number is the limit of
    all trials.

    Curtailed trials end as soon as more have failed than the rule allows: the remaining
    trials could not change the verdict. Their Clopper-Pearson interval still covers the
    rate in 95 % of all cases, because it contains the exact interval of this stopping
    rule (Jennison and Turnbull 1983).

    Trials with several looks are always curtailed, but at least `Rule.min_trials` are
    made, as fewer say nothing of the rate. `benchmarks/verdicts.py` computes from the
    probability of every outcome that their intervals cover the rate.

    Args:
        evaluate: renders the queries and yields their evaluations.
        domain: the budget; the clean configuration is its start.
        u: (d,) the adversarial configuration; projected into the domain again.
        claim: how the search ended; FOUND if it claims a failure.
        spp: samples per pixel.
        seed: root seed. Must not be one that the search rendered with through the same
            stream.
        trials: number of trials of each group; or ascending numbers, the looks.
        clean: the first trials of the clean configuration, where `run_trials` has run
            them with the same spp and seed (one control group serves the attack and its
            baseline); what is missing is run here.
        rule: what counts as a success, and which ending it is.
        kind: kind of the queries of the adversarial configuration.
        control_kind: kind of the queries of the clean configuration.
        n_images: number of adversarial trials, the first ones, with an image.
        curtailed: whether trials end early once too many have failed; for a claim of
            which only the verdict matters, not the rate.
        first_index: index of the first trial, which decides its seed. If trials chose
            the configuration, the new ones must begin after these.
    """
    looks = (trials,) if isinstance(trials, int) else tuple(trials)
    has_several_looks = len(looks) > 1
    # so many adversarial trials are made even if the verdict stands sooner
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
        if len(done) < count or has_failed(()) or is_success or not is_early:
            break
    # as many as were asked for, and no look before
    is_complete = not has_several_looks and len(done) == looks[0]
    return _summarize_trials(
        rule,
        claim,
        u,
        clean_trials,
        done,
        spp=spp,
        confidence=_choose_confidence(rule, has_several_looks=has_several_looks),
        renders=len(done) + len(clean_trials) - len(clean),  # those that were made here
        stopped="asked for" if is_complete else "decided",
        is_early=is_success and is_early,
        begin=first_index,
    )


def _fails_too_often(
    rule: Rule,
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


def _choose_confidence(rule: Rule, *, has_several_looks: bool) -> float:
    """Return the confidence of the Clopper-Pearson interval of the success rate.

    It is larger where trials over conditions may have ended at several looks, so that
    the interval covers the rate in 95 % of all cases nevertheless.
    """
    return OVER_CONFIDENCE if rule.is_conditional and has_several_looks else CONFIDENCE


def _extend_clean_trials(
    clean_trials: list[Judgement],
    run_clean: Callable[..., Iterable[Judgement]],
    rule: Rule,
    look: int,
    max_trials: int,
) -> int:
    """Run clean trials until `look` of them count, or there are `max_trials`.

    Over conditions (weather, viewpoints, ...) a clean trial that is wrong does not
    count, so another is run for it.

    Returns:
        How many trials are needed for this look, those that do not count included.

    Args:
        clean_trials: clean trials so far; new ones are appended.
        run_clean: runs trials of the clean configuration (`run_trials`).
        rule: says which trials count.
        look: number of trials that have to count.
        max_trials: maximum number of trials.
    """
    count = look
    # There may be more than `count` already, from an earlier call: then none is run.
    clean_trials += run_clean(trials=count, n_done=len(clean_trials))
    n_missing = look - rule.count_valid(clean_trials[:count])
    while n_missing > 0 and count < max_trials:
        count = min(count + n_missing, max_trials)
        clean_trials += run_clean(trials=count, n_done=len(clean_trials))
        n_missing = look - rule.count_valid(clean_trials[:count])
    return count


def _is_found(
    rule: Rule,
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
        rule: says how many have to succeed.
        trials: trials of the adversarial configuration.
        clean_trials: clean trials of the same seeds, or more.
        count: number of clean trials that count here, the first ones.
        spp: samples per pixel.
        is_early: whether more trials could follow.
    """
    counted_clean_trials = clean_trials[:count]
    n_valid = rule.count_valid(counted_clean_trials)
    n_needed = rule.count_needed(n_valid, early=is_early)
    n_successes = _list_outcomes(rule, trials, clean_trials).count(True)
    is_clean_wrong = rule.is_already_wrong(count_right(counted_clean_trials, spp))
    return n_successes >= n_needed and not is_clean_wrong


def _list_outcomes(
    rule: Rule, trials: Sequence[Judgement], clean_trials: Sequence[Judgement]
) -> tuple[bool | None, ...]:
    """Return whether each trial is a success; None where it does not count.

    Where conditions vary (`Rule.is_conditional`), a trial does not count if the model
    is wrong about the clean configuration under the same conditions.
    """
    outcomes: list[bool | None] = []
    # there may be more clean trials than others
    for trial, clean in zip(trials, clean_trials, strict=False):
        if rule.is_conditional and not clean.right:
            outcomes.append(None)
        else:
            outcomes.append(rule.is_success(trial, clean))
    return tuple(outcomes)


def _summarize_trials(
    rule: Rule,
    claim: Ending,
    u: Tensor,
    clean_trials: Sequence[Judgement],
    trials: Sequence[Judgement],
    *,
    spp: int,
    confidence: float,
    renders: int,
    stopped: str,
    is_early: bool,
    begin: int,
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
        stopped: why there are no more trials: "asked for" or "decided".
        is_early: whether the needed successes are those of an early look.
        begin: index of the first trial.
    """
    outcomes = _list_outcomes(rule, trials, clean_trials)
    # None marks a trial that does not count; a rate of no trials would be 0 / 0.
    n_counted = max(1, len(outcomes) - outcomes.count(None))
    clean_counts = count_right(clean_trials, spp)
    counts = Trials(outcomes.count(True), n_counted, spp, confidence)
    ending = rule.decide_ending(claim, clean_counts, counts)
    reason = (
        f"{ending.explanation} A success in {counts.successes} of {n_counted} trials, "
        f"{rule.count_needed(n_counted, early=is_early)} are needed; clean right in "
        f"{clean_counts.successes} of {clean_counts.trials}."
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
        stopped=stopped,
        outcomes=outcomes,
        first_index=begin,
    )
