"""One way to write a family: each proportion and each colour is stated once, with what else it may be."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from advsearch.bundled.objects.shapes import Array

T = TypeVar("T")
Color = Array  # (3,) display-referred sRGB


def hexed(code: str) -> Color:
    """Return the colour written as six hexadecimal digits."""
    return np.array([int(code[i : i + 2], 16) / 255.0 for i in (0, 2, 4)])


@dataclass(frozen=True)
class Draw:
    """Draws an instance's proportions; without a generator, gives the canonical ones."""

    rng: np.random.Generator | None  # the source of randomness, or None for the canonical instance

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

    def offset(self) -> Array:
        """Return a (3,) shift into the noise, so that no two instances show the same clouds."""
        return np.array([1.7, 9.2, 5.5]) if self.rng is None else self.rng.uniform(0.0, 16.0, 3)

    def colour(self, canonical: str, *others: str, wild: float = 0.4) -> Color:
        """Return the canonical colour; when drawing, one of those given, jittered, or with chance `wild` any colour."""
        rng = self.rng
        if rng is None:
            return hexed(canonical)
        if rng.random() < wild:
            return np.array(colorsys.hsv_to_rgb(rng.random(), rng.random() ** 0.7, rng.uniform(0.15, 0.97)))
        base = hexed(self.pick(canonical, *others))
        return np.clip(base * rng.uniform(0.85, 1.12) + rng.uniform(-0.05, 0.05, 3), 0.02, 0.98)
