"""Confidence sequences: intervals that may be checked after every sample, by bets."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.errors import InputError
from advsearch.statistics.intervals import CONFIDENCE


def find_threshold(is_beyond: Callable[[float], bool]) -> float:
    """Find by bisection the number in (0, 1) above which a condition holds.

    The result is 0 if the condition holds everywhere, and 1 if it holds nowhere.

    Args:
        is_beyond: the condition. It is false below some number, and true above it.
    """
    # not 0 and 1 themselves, by which a caller may have to divide
    low = 1e-9
    high = 1.0 - 1e-9
    if is_beyond(low):
        return 0.0
    if not is_beyond(high):
        return 1.0
    for _ in range(40):  # to 1e-12, which is 2^-40
        center = 0.5 * (low + high)
        if is_beyond(center):
            high = center
        else:
            low = center
    return high


STAKES = np.array([1.0, 0.9, 0.75, 0.5, 0.25, 0.125, 0.0625, 0.03125])
"""Stakes, as fractions of the capital. The capital is divided equally among gamblers,
each with one of these stakes. Large stakes decide soon if nearly all samples agree.
"""


@dataclass
class ConfidenceSequence:
    """Samples in [0, 1], and an interval of their mean that is valid after each one.

    So sampling may stop as soon as the interval decides a question.

    Let x_1, x_2, ... be samples whose mean is m, given the samples before. A gambler
    bets a fraction c of the capital on each sample, on "more than m" (K) or on "less
    than m" (L). The game is fair, and the capital becomes

        K_t(m, c) = prod_s (1 - c + c x_s / m)
        L_t(m, c) = prod_s (1 - c + c (1 - x_s) / (1 - m))

    The mean capital over several c exceeds 2 / a at some time with a probability of at
    most a / 2 (Ville 1939). So the values of m at which neither K nor L exceeds it are
    an interval. It contains the true mean at all times with a probability of at least 1
    - a. This is the hedged capital of Waudby-Smith and Ramdas 2024, "Estimating means
    of bounded random variables by betting", with fixed stakes
    (`benchmarks/sequential.py`).

    Attributes:
        confidence: confidence that the interval is right at all times; over 0 and under
            1.
        sides: 2 for the interval. 1 if only a claim "the mean is at least m" is to be
            decided. If the claim is true only `is_under` can be wrong, and if it is
            false only `is_over`. So each may be wrong as often as the confidence
            allows.
    """

    confidence: float = CONFIDENCE
    sides: int = 2
    _counts: Counter[float] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        if not 0.0 < self.confidence < 1.0:
            raise InputError(
                f"confidence: expected a number between 0 and 1, got {self.confidence}"
            )

    def add(self, value: float) -> None:
        """Add a sample. Raises InputError: it is not in [0, 1]."""
        if not 0.0 <= value <= 1.0:
            raise InputError(f"draw: expected a number from 0 to 1, got {value}")
        self._counts[value] += 1

    @property
    def count(self) -> int:
        return self._counts.total()

    @property
    def mean(self) -> float:
        """Mean of the samples; NaN if there are none."""
        if not self.count:
            return math.nan
        return sum(value * count for value, count in self._counts.items()) / self.count

    def is_over(self, mean: float) -> bool:
        """Return whether samples show that the true mean exceeds `mean`, in (0, 1)."""
        return self._has_won(mean, self._counts)

    def is_under(self, mean: float) -> bool:
        """Return whether samples show that the true mean is below `mean`, in (0, 1)."""
        mirrored = {1.0 - value: count for value, count in self._counts.items()}
        return self._has_won(1.0 - mean, mirrored)

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper bound of the true mean.

        The samples show that the true mean is over every number below the lower bound,
        and under every number above the upper bound.
        """
        # `find_threshold` needs conditions that are false below a number and true above
        # it. `is_over` holds below the lower bound, so it is negated.
        lower = find_threshold(lambda mean: not self.is_over(mean))
        upper = find_threshold(self.is_under)
        return lower, upper

    def _has_won(self, mean: float, counts: Mapping[float, int]) -> bool:
        """Return whether bets on "more than `mean`" gained more than chance allows.

        If `mean` is the true mean, the capital reaches the threshold with a probability
        of at most 1 - confidence, divided by the number of sides (Ville's inequality).
        Further samples may bring it below the threshold again.

        Args:
            mean: mean that the bets are on, in (0, 1).
            counts: counts of the samples, by their value.
        """
        threshold = np.log(self.sides / (1.0 - self.confidence))
        return bool(log_capital_of_counts(mean, counts) >= threshold)


def count_needed_samples(mean: float, *, confidence: float, value: float = 1.0) -> int:
    """Return how many equal samples show that the true mean exceeds a number.

    A one-sided `ConfidenceSequence` has to show it. With the value 1 the result is the
    minimum for any samples, since 1 is the largest sample.

    Args:
        mean: number that the true mean has to exceed, in (0, 1).
        confidence: confidence of the sequence.
        value: value of all samples, over `mean`.
    """
    threshold = math.log(1.0 / (1.0 - confidence))

    def is_enough(count: int) -> bool:
        return log_capital_of_counts(mean, {value: count}) >= threshold

    upper = 1
    while not is_enough(upper):
        upper *= 2
    # Bisection for the first count that is enough. The range begins with 1, so that a
    # count is one more than its index.
    index = bisect_left(range(1, upper + 1), True, key=is_enough)
    return index + 1


def log_capital_of_counts(mean: float, counts: Mapping[float, int]) -> float:
    """Return the logarithm of the capital that bets on "more than `mean`" have made
    (`log_capital`).

    Args:
        mean: mean that the bets are on, in (0, 1).
        counts: counts of the samples in [0, 1], by their value.
    """
    values = np.array(list(counts), dtype=np.float64)
    return log_capital(mean, values, np.array(list(counts.values())))


def log_capital(
    mean: float, values: npt.NDArray[Any], counts: npt.NDArray[Any]
) -> float:
    """Return the logarithm of the capital that bets on "more than `mean`" have made.

    The capital starts with 1 and is divided equally among strategies, one for each s of
    `STAKES`. A strategy bets the fraction s of its capital on every sample x, which
    multiplies its capital by 1 - s + s x / mean. If `mean` is the true mean, this
    factor is 1 on average. The result is -inf if all capital is lost.

    Args:
        mean: mean that the bets are on, in (0, 1).
        values: (n,) distinct samples in [0, 1].
        counts: (n,) how often each occurs.
    """
    with np.errstate(divide="ignore"):
        factors = 1.0 - STAKES + STAKES * (values / mean)[:, None]  # (n, stakes)
        log_factors = np.log(np.maximum(factors, 0.0))  # not below 0 by rounding
        log_capital_of_stake = (counts[:, None] * log_factors).sum(axis=0)
    # the capital is the mean over stakes
    return float(np.logaddexp.reduce(log_capital_of_stake) - np.log(len(STAKES)))
