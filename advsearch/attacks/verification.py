"""The independent re-check of a search's answer (DESIGN 4.1 and 5.2). The rule for a verdict is stated here only.

Every trial renders a configuration with a seed nobody has used, at a sample count shown to be high enough, with the
pixels rounded to 8 bits, and classifies it. The clean configuration goes through exactly the same trials as a control
group.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from advsearch.attacks.domain import Domain
from advsearch.attacks.ending import Ending
from advsearch.attacks.trials import Trials
from advsearch.errors import InputError
from advsearch.seeds import stream

PASS_PERCENT = 95
"""What a claim must hold in, in per cent of the trials, and what the clean control must pass: 19 of 20."""


class Trial(NamedTuple):
    """One render and its verdict.

    Attributes:
        margin: largest logit outside the label set minus largest inside; over 0 means that the model is wrong.
        predicted: index of the class the model answers.
        probability: the probability it gives that class.
    """

    margin: float
    predicted: int
    probability: float

    @property
    def wrong(self) -> bool:
        """Whether the model answers outside the label set. A margin of 0 or NaN is not wrong."""
        return self.margin > 0.0

    @property
    def right(self) -> bool:
        """Whether the model answers inside the label set. NaN is not right either."""
        return self.margin <= 0.0


RenderMargin = Callable[[Tensor, int, int], Trial]
"""(u, seed, spp) -> Trial: renders, rounds to 8 bits, classifies."""

OnTrial = Callable[[str, int, Trial], None]
"""Called after every trial with "clean" or "adversarial", its number from 0, and the trial."""


@dataclass(frozen=True, eq=False)
class Verification:
    """What the trials say.

    Attributes:
        ending: the run's ending; FOUND only if the rule of `verdict` holds.
        reason: one sentence with the numbers behind it.
        u: (d,) the configuration verified, projected into its budget again.
        clean: right answers of the control group.
        adversarial: successes: wrong on the configuration and right on the clean one with the same seed.
        clean_trials, adversarial_trials: every single trial, in the order of their seeds.
        renders: renders spent here.
    """

    ending: Ending
    reason: str
    u: Tensor
    clean: Trials
    adversarial: Trials
    clean_trials: tuple[Trial, ...]
    adversarial_trials: tuple[Trial, ...]
    renders: int


def needed(trials: int) -> int:
    """Return how many of `trials` must succeed: ceil of 95 %, so 19 of 20."""
    return -(-PASS_PERCENT * trials // 100)


def verdict(search: Ending, clean: Trials, adversarial: Trials) -> Ending:
    """Return the run's ending from the search's ending and the trials of both groups.

    In this order:

    1. INTERRUPTED stays interrupted.
    2. The control group is right in less than half of its trials: ALREADY_WRONG. There was nothing to attack.
    3. Control group and successes both reach `needed`: FOUND, whatever the search itself believed.
    4. The search claimed FOUND: NOT_VERIFIED.
    5. Else what the search ended with.
    """
    if search is Ending.INTERRUPTED:
        return search
    if already_wrong(clean):
        return Ending.ALREADY_WRONG
    if clean.successes >= needed(clean.trials) and adversarial.successes >= needed(adversarial.trials):
        return Ending.FOUND
    return Ending.NOT_VERIFIED if search is Ending.FOUND else search


def already_wrong(clean: Trials) -> bool:
    """Return whether a clean configuration is no start at all: right in less than half of its trials."""
    return 2 * clean.successes < clean.trials


def run_trials(
    render_margin: RenderMargin,
    u: Tensor,
    *,
    spp: int,
    seed: int,
    trials: int = 20,
    group: str = "adversarial",
    on_trial: OnTrial | None = None,
) -> tuple[Trial, ...]:
    """Render and classify one configuration `trials` times, trial k with seed k of the stream "verification".

    Two groups run with the same root seed get the same seeds, trial by trial, which is what a control group needs.

    Raises:
        InputError: trials or spp under 1.
    """
    if trials < 1:
        raise InputError(f"--trials: expected at least 1, got {trials}")
    if spp < 1:
        raise InputError(f"--verify-spp: expected at least 1, got {spp}")
    done = []
    for number in range(trials):
        trial = Trial(*render_margin(u, stream(seed, "verification", number), spp))
        done.append(trial)
        if on_trial is not None:
            on_trial(group, number, trial)
    return tuple(done)


def count_right(trials: Sequence[Trial], spp: int) -> Trials:
    """Count the right answers of a control group."""
    return Trials(sum(trial.right for trial in trials), len(trials), spp)


def verify(
    render_margin: RenderMargin,
    domain: Domain,
    u: Tensor,
    *,
    claim: Ending,
    spp: int,
    seed: int,
    trials: int = 20,
    clean: Sequence[Trial] | None = None,
    on_trial: OnTrial | None = None,
) -> Verification:
    """Check a search's answer in fresh trials against the clean configuration as control group.

    A success is a trial that is wrong on the projected answer while the clean configuration, rendered with the same
    seed, is right: what the noise does by itself does not count. See `verdict` for the rule. KeyboardInterrupt passes
    through.

    Args:
        render_margin: renders one configuration with one seed, rounds to 8 bits, classifies.
        domain: the budget; the clean configuration is its start.
        u: (d,) the answer; projected into the domain again.
        claim: the search's ending.
        spp: samples per pixel, from `choose_spp`.
        seed: root seed. Must not be one that the search rendered with through the same stream.
        trials: per group.
        clean: trials of the clean configuration, where `run_trials` has run them with the same spp, seed and count
            (one control group serves the attack and its baseline).
        on_trial: called after every trial.

    Raises:
        InputError: trials or spp under 1, or `clean` has another length.
    """
    renders = trials if clean is not None else 2 * trials
    if clean is None:
        clean = run_trials(
            render_margin,
            domain.start,
            spp=spp,
            seed=seed,
            trials=trials,
            group="clean",
            on_trial=on_trial,
        )
    if len(clean) != trials:
        raise InputError(f"clean trials: expected {trials}, as many as --trials, got {len(clean)}")
    u = domain.project(u)
    adversarial = run_trials(render_margin, u, spp=spp, seed=seed, trials=trials, on_trial=on_trial)
    control = count_right(clean, spp)
    successes = sum(bad.wrong and good.right for bad, good in zip(adversarial, clean, strict=True))
    verified = Trials(successes, trials, spp)
    ending = verdict(claim, control, verified)
    reason = (
        f"{ending.explanation} Wrong in {successes} of {trials} trials, clean right in {control.successes} of "
        f"{trials}; {needed(trials)} of each are needed."
    )
    return Verification(ending, reason, u, control, verified, tuple(clean), adversarial, renders)


def typical(trials: Sequence[Trial]) -> Trial:
    """Return what the model usually answers: the most frequent class (the lowest index of equals) over all trials,
    with the mean margin and mean probability of the trials that gave it."""
    counts: dict[int, int] = {}
    for trial in trials:
        counts[trial.predicted] = counts.get(trial.predicted, 0) + 1
    predicted = min(counts, key=lambda i: (-counts[i], i))
    chosen = [trial for trial in trials if trial.predicted == predicted]
    mean = [math.fsum(values) / len(chosen) for values in zip(*chosen, strict=True)]
    return Trial(mean[0], predicted, mean[2])
