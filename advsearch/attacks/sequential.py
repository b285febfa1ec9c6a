"""A mean of draws that may be looked at after each of them: an interval that holds at all times together.

Of draws x_1, x_2, ... in [0, 1] whose mean is m, whatever was drawn before, a gambler who stakes a share c of what he
has, on "more than m" or on "less than m", plays a fair game:

    K_t(m, c) = prod_s (1 - c + c x_s / m)       and       prod_s (1 - c + c (1 - x_s) / (1 - m))

His capital, a mean over stakes c, exceeds 2 / a at some time with a probability of a / 2 at most (Ville 1939). So the m
at which neither does are an interval that holds m at all times with a probability of 1 - a at least: the hedged capital
of Waudby-Smith and Ramdas 2024, "Estimating means of bounded random variables by betting", with stakes that are fixed.
Whoever stops as soon as the interval decides something is right as often as that says (`benchmarks/sequential.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from advsearch.attacks.trials import CONFIDENCE, edge_of
from advsearch.errors import InputError

STAKES = np.array([1.0, 0.9, 0.75, 0.5, 0.25, 0.125, 0.0625, 0.03125])
"""Among which the capital is shared equally. Large ones decide soon where nearly all draws agree."""


@dataclass
class ConfidenceSequence:
    """The draws so far, and what they say of their mean.

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
