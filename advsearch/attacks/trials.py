"""Counting successes, and saying how sure the count is."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.special import betaincinv

from advsearch.errors import InputError

CONFIDENCE = 0.95
"""Confidence of every interval that is printed."""


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the exact two-sided binomial interval of a success rate.

    low solves P(X >= successes | low) = a/2 and high solves P(X <= successes | high) = a/2, with a = 1 - confidence.
    These
    are quantiles of beta distributions: low = B(a/2; k, n - k + 1), high = B(1 - a/2; k + 1, n - k). The interval
        covers
    the true rate at least as often as it says, at every n (Clopper and Pearson 1934).

    Args:
        successes: k, from 0 to n.
        trials: n, at least 1.
        confidence: between 0 and 1.

    Returns:
        (low, high); low is exactly 0 for k = 0, high exactly 1 for k = n.

    Raises:
        InputError: an argument is out of range.
    """
    if trials < 1:
        raise InputError(f"trials: expected at least 1, got {trials}")
    if not 0 <= successes <= trials:
        raise InputError(f"successes: expected a number from 0 to {trials}, got {successes}")
    if not 0.0 < confidence < 1.0:
        raise InputError(f"confidence: expected a number between 0 and 1, got {confidence}")
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if successes == 0 else float(betaincinv(successes, trials - successes + 1, tail))
    high = 1.0 if successes == trials else float(betaincinv(successes + 1, trials - successes, 1.0 - tail))
    return low, high


@dataclass(frozen=True)
class Trials:
    """How often something happened in independent trials.

    Attributes:
        successes: from 0 to `trials`.
        trials: at least 1.
        spp: samples per pixel of every trial.
    """

    successes: int
    trials: int
    spp: int

    @property
    def rate(self) -> float:
        """Fraction of trials that succeeded."""
        return self.successes / self.trials

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Clopper-Pearson interval of the rate."""
        return clopper_pearson(self.successes, self.trials)
