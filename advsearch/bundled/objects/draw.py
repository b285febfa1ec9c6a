"""One way to write a family: every proportion is stated once, with its canonical value and its range."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

T = TypeVar("T")


@dataclass(frozen=True)
class Draw:
    """Draws an instance's proportions; without a generator, gives the canonical ones.

    Attributes:
        rng: the source of randomness, or None for the canonical instance.
    """

    rng: np.random.Generator | None

    def __call__(self, canonical: float, low: float, high: float) -> float:
        """Return a number uniform in [low, high], or the canonical one."""
        return canonical if self.rng is None else float(self.rng.uniform(low, high))

    def pick(self, canonical: T, *others: T) -> T:
        """Return one of the choices, all equally likely, or the canonical one."""
        choices = (canonical, *others)
        return canonical if self.rng is None else choices[int(self.rng.integers(len(choices)))]

    def chance(self, probability: float, canonical: bool = False) -> bool:
        """Return True with a probability, or the canonical one."""
        return canonical if self.rng is None else bool(self.rng.random() < probability)

    def offset(self) -> npt.NDArray[np.float64]:
        """Return a (3,) shift into the noise, so that no two instances show the same clouds."""
        return np.array([1.7, 9.2, 5.5]) if self.rng is None else self.rng.uniform(0.0, 16.0, 3)
