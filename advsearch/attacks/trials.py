"""Counting successes, and saying how sure the count is."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.special import bdtr, betaincinv, ndtri

from advsearch.errors import InputError
from advsearch.seeds import stream

CONFIDENCE = 0.95
"""Confidence of every interval that is printed."""


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the exact two-sided binomial interval of a success rate.

    low solves P(X >= successes | low) = a/2 and high solves P(X <= successes | high) = a/2, with a = 1 - confidence.
    These are quantiles of beta distributions: low = B(a/2; k, n - k + 1), high = B(1 - a/2; k + 1, n - k). The interval
    covers the true rate at least as often as it says, at every n (Clopper and Pearson 1934).

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


def paired_difference(both: int, first: int, second: int, neither: int) -> tuple[float, tuple[float, float]]:
    """Return how much more often the second of two paired outcomes happens than the first, and its 95 % interval.

    The interval of the difference of two shares that were counted in the same n pairs, from the Wilson intervals of
    both and their correlation (Newcombe 1998, "Improved confidence intervals for the difference between binomial
    proportions based on paired data", method 10).

    Args:
        both: pairs in which both happen.
        first: in which the first alone happens.
        second: likewise.
        neither: in which none happens.

    Raises:
        InputError: there is no pair, or less than none.
    """
    n = both + first + second + neither
    if n < 1 or min(both, first, second, neither) < 0:
        raise InputError(f"pairs: expected at least one, got {both}, {first}, {second} and {neither}")
    shares = (both + second) / n, (both + first) / n
    (low, high), (other_low, other_high) = (_wilson(share, n) for share in shares)
    spread = (both + first) * (second + neither) * (both + second) * (first + neither)
    covariance = float(both * neither - first * second)
    if covariance > 0.0:
        covariance = max(covariance - n / 2.0, 0.0)
    phi = covariance / math.sqrt(spread) if spread else 0.0
    (p, q), down = shares, (shares[0] - low, other_high - shares[1])
    up = high - shares[0], shares[1] - other_low
    below, above = (math.sqrt(max(0.0, a * a - 2 * phi * a * b + b * b)) for a, b in (down, up))
    return p - q, (max(-1.0, p - q - below), min(1.0, p - q + above))


def mcnemar(first: int, second: int) -> float:
    """Return how likely it is that of pairs in which one outcome alone happens, chance splits so many so unevenly.

    The exact test of McNemar (1947, "Note on the sampling error of the difference between correlated proportions or
    percentages"): the pairs in which both happen, or none, say nothing about which happens more often, and the others
    are throws of a fair coin where none does. Two-sided: twice the smaller tail of the binomial distribution.

    Args:
        first: pairs in which the first alone happens.
        second: in which the second alone does.

    Returns:
        In (0, 1]; 1 without such pairs.

    Raises:
        InputError: one is less than 0.
    """
    if min(first, second) < 0:
        raise InputError(f"pairs: expected numbers from 0, got {first} and {second}")
    return min(1.0, 2.0 * float(bdtr(min(first, second), first + second, 0.5))) if first + second else 1.0


def _wilson(share: float, n: int) -> tuple[float, float]:
    """Wilson's score interval of a share of n, 95 %."""
    z = float(ndtri(0.5 + CONFIDENCE / 2.0))
    middle, half = share + z * z / (2 * n), z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return (middle - half) / (1 + z * z / n), (middle + half) / (1 + z * z / n)


@dataclass(frozen=True)
class Trials:
    """How often something happened in independent trials.

    Attributes:
        successes: from 0 to `trials`.
        trials: at least 1.
        spp: samples per pixel of every trial.
        confidence: of the Clopper-Pearson interval; larger than 95 % where trials might have ended at several looks.
    """

    successes: int
    trials: int
    spp: int
    confidence: float = CONFIDENCE

    @property
    def rate(self) -> float:
        """Fraction of trials that succeeded."""
        return self.successes / self.trials

    @property
    def interval(self) -> tuple[float, float]:
        """Interval that covers the rate in 95 % of all cases, by Clopper and Pearson."""
        return clopper_pearson(self.successes, self.trials, self.confidence)


def trial_seed(seed: int, number: int) -> int:
    """Return the seed of a trial, by its number: the same for all groups with that root."""
    return stream(seed, "verification", number)


def edge_of(beyond: Callable[[float], bool]) -> float:
    """Return where in (0, 1) a condition begins to hold, 0 or 1 where it holds everywhere or nowhere."""
    low, high = 1e-9, 1.0 - 1e-9
    if beyond(low):
        return 0.0
    if not beyond(high):
        return 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if beyond(middle) else (middle, high)
    return high


STAKES = np.array([1.0, 0.9, 0.75, 0.5, 0.25, 0.125, 0.0625, 0.03125])
"""Among which the capital is shared equally. Large ones decide soon where nearly all draws agree."""


@dataclass
class ConfidenceSequence:
    """Draws in [0, 1], and an interval of their mean that holds after each of them: one may stop as soon as it decides.

    Of draws x_1, x_2, ... whose mean is m, whatever was drawn before, a gambler who stakes a share c of what he has, on
    "more than m" or on "less than m", plays a fair game:

        K_t(m, c) = prod_s (1 - c + c x_s / m)       and       prod_s (1 - c + c (1 - x_s) / (1 - m))

    His capital, a mean over stakes c, exceeds 2 / a at some time with a probability of a / 2 at most (Ville 1939). So
    the m at which neither does are an interval that holds m at all times with a probability of 1 - a at least: the
    hedged capital of Waudby-Smith and Ramdas 2024, "Estimating means of bounded random variables by betting", with
    stakes that are fixed (`benchmarks/sequential.py`).

    Attributes:
        confidence: of the interval, at all times together; over 0 and under 1.
    """

    confidence: float = CONFIDENCE
    _counts: Counter[float] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        if not 0.0 < self.confidence < 1.0:
            raise InputError(f"confidence: expected a number between 0 and 1, got {self.confidence}")

    def add(self, value: float) -> None:
        """Take note of a draw in [0, 1]."""
        if not 0.0 <= value <= 1.0:
            raise InputError(f"draw: expected a number from 0 to 1, got {value}")
        self._counts[value] += 1

    @property
    def count(self) -> int:
        """Draws so far."""
        return sum(self._counts.values())

    @property
    def mean(self) -> float:
        """Their mean; NaN where there is none."""
        return sum(value * count for value, count in self._counts.items()) / self.count if self.count else float("nan")

    def is_over(self, mean: float) -> bool:
        """Whether the true mean is shown to be over a number in (0, 1)."""
        return self._won(mean, self._counts)

    def is_under(self, mean: float) -> bool:
        """Whether the true mean is shown to be under a number in (0, 1)."""
        return self._won(1.0 - mean, {1.0 - value: count for value, count in self._counts.items()})

    @property
    def interval(self) -> tuple[float, float]:
        """Both ends of the means that are not excluded; `is_over` and `is_under` are monotone in the mean."""
        return edge_of(lambda mean: not self.is_over(mean)), edge_of(self.is_under)

    def _won(self, mean: float, counts: Mapping[float, int]) -> bool:
        return bool(capital(mean, counts) >= np.log(2.0 / (1.0 - self.confidence)))


def capital(mean: float, counts: Mapping[float, int]) -> float:
    """Return the logarithm of what the bets on "more than `mean`" have made of 1, -inf where all is lost."""
    total: npt.NDArray[np.float64] = np.zeros(len(STAKES))
    with np.errstate(divide="ignore"):
        for value, count in counts.items():
            total += count * np.log(1.0 - STAKES + STAKES * (value / mean))
    return float(np.logaddexp.reduce(total) - np.log(len(STAKES)))
