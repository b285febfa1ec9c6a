"""Intervals that hold however often one looks: confidence sequences by bets."""

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


def edge_of(beyond: Callable[[float], bool]) -> float:
    """Return where in (0, 1) a condition begins to hold, 0 or 1 where it holds
    everywhere or nowhere.
    """
    low = 1e-9
    high = 1.0 - 1e-9
    if beyond(low):
        return 0.0
    if not beyond(high):
        return 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if beyond(middle) else (middle, high)
    return high


STAKES = np.array([1.0, 0.9, 0.75, 0.5, 0.25, 0.125, 0.0625, 0.03125])
"""Among which the capital is shared equally. Large ones decide soon where nearly all
draws agree.
"""


@dataclass
class ConfidenceSequence:
    """Draws in [0, 1], and an interval of their mean that holds after each of them: one
    may stop as soon as it decides.

    Of draws x_1, x_2, ... whose mean is m, whatever was drawn before, a gambler who
    stakes a share c of what he has, on "more than m" or on "less than m", plays a fair
    game:

        K_t(m, c) = prod_s (1 - c + c x_s / m)       and       prod_s (1 - c + c (1 - x_s) / (1 - m))

    His capital, a mean over stakes c, exceeds 2 / a at some time with a probability of
    a / 2 at most (Ville 1939). So the m at which neither does are an interval that
    holds m at all times with a probability of 1 - a at least: the hedged capital of
    Waudby-Smith and Ramdas 2024, "Estimating means of bounded random variables by
    betting", with stakes that are fixed (`benchmarks/sequential.py`).

    Attributes:
        confidence: of the interval, at all times together; over 0 and under 1.
        sides: 2 of the whole interval; 1 of each end by itself, for a claim "at least
            so much": if it is true only `is_under` can be wrong, and else only
            `is_over`, so that each may be as often as the other says.
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
        if not 0.0 <= value <= 1.0:
            raise InputError(f"draw: expected a number from 0 to 1, got {value}")
        self._counts[value] += 1

    @property
    def count(self) -> int:
        return self._counts.total()

    @property
    def mean(self) -> float:
        return (
            sum(value * count for value, count in self._counts.items()) / self.count
            if self.count
            else math.nan
        )

    def is_over(self, mean: float) -> bool:
        """Whether the true mean is shown to be over a number in (0, 1)."""
        return self._won(mean, self._counts)

    def is_under(self, mean: float) -> bool:
        """Whether the true mean is shown to be under a number in (0, 1)."""
        return self._won(
            1.0 - mean, {1.0 - value: count for value, count in self._counts.items()}
        )

    @property
    def interval(self) -> tuple[float, float]:
        """Both ends of the means that are not excluded; `is_over` and `is_under` are
        monotone in the mean.
        """
        return edge_of(lambda mean: not self.is_over(mean)), edge_of(self.is_under)

    def _won(self, mean: float, counts: Mapping[float, int]) -> bool:
        return bool(
            capital(mean, counts) >= np.log(self.sides / (1.0 - self.confidence))
        )


def draws_needed(mean: float, *, confidence: float, value: float = 1.0) -> int:
    """Return how many draws, all of one value over a mean in (0, 1), show that the true
    one is over it, by one side of a `ConfidenceSequence`: no others show it sooner
    where the value is 1.
    """

    def shown(count: int) -> bool:
        return capital(mean, {value: count}) >= math.log(1.0 / (1.0 - confidence))

    high = 1
    while not shown(high):
        high *= 2
    return bisect_left(range(1, high + 1), True, key=shown) + 1


def capital(mean: float, counts: Mapping[float, int]) -> float:
    """Return the logarithm of what the bets on "more than `mean`" have made of 1, -inf
    where all is lost.
    """
    return log_capital(
        mean, np.array(list(counts), dtype=np.float64), np.array(list(counts.values()))
    )


def log_capital(
    mean: float, values: npt.NDArray[Any], times: npt.NDArray[Any]
) -> float:
    """Return the same of draws (n,) in [0, 1], so many `times` each."""
    with np.errstate(divide="ignore"):
        won = np.log(np.maximum(1.0 - STAKES + STAKES * (values / mean)[:, None], 0.0))
        total = (times[:, None] * won).sum(axis=0)
    return float(np.logaddexp.reduce(total) - np.log(len(STAKES)))
