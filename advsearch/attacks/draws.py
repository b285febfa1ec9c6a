"""Points that can be reached in any order by their number: draws from the unit cube, and products of axes.

Draw number n is the same point whoever asks for it when:

- "sobol": scrambled Sobol points (Owen 1998; Joe and Kuo 2008) in nets of 65,536, each scrambled by a seed of its own,
  so that no draw is far from the beginning of its net;
- "random": independent uniform points, in blocks with a seed of their own.

A product is never built. Its last axis runs fastest, as the digits of a number do:

    index = (...(digit_0 * size_1 + digit_1) * size_2 + ...) * size_k + digit_k
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from advsearch.errors import InputError
from advsearch.seeds import stream

Sampler = Literal["sobol", "random"]
SAMPLERS: tuple[str, ...] = get_args(Sampler)

NET = 1 << 16  # points of one scrambled net
MOST_DIMENSIONS = 21201  # numbers of a Sobol point, at most: for so many Joe and Kuo give directions
BLOCK_NUMBERS = 1 << 18  # numbers that are drawn at once, at most (unless one point has more)
SEEDS = 1024  # seeds that are made at once

Doubles = NDArray[np.float64]


class Draws:
    """Points of [0, 1)^dimensions by number, by a sampler of `SAMPLERS`; their streams are called `name`."""

    def __init__(self, dimensions: int, sampler: str, seed: int, name: str = "draws") -> None:
        if sampler not in SAMPLERS:
            raise InputError(f"sampler: expected one of {', '.join(SAMPLERS)}, got {sampler!r}")
        if sampler == "sobol" and dimensions > MOST_DIMENSIONS:
            raise InputError(
                f"`sampler` sobol: expected at most {MOST_DIMENSIONS} numbers to draw, got {dimensions}; use "
                "`sampler=random`"
            )
        self.dimensions = dimensions
        self._sampler, self._seed, self._name = sampler, seed, name
        rows = max(1, min(NET, BLOCK_NUMBERS // max(1, dimensions)))
        self._rows = 1 << (rows.bit_length() - 1)
        self._number, self._block = -1, np.empty((0, dimensions))
        self._engine: Any = None
        self._net, self._drawn = -1, 0

    def points(self, first: int, count: int) -> Doubles:
        """Return the draws with the numbers from `first` on: (count, dimensions) float64 in [0, 1)."""
        if not self.dimensions or count < 1:
            return np.empty((max(0, count), self.dimensions))
        parts, end = [], first + count
        while first < end:
            number, begin = divmod(first, self._rows)
            size = min(self._rows - begin, end - first)
            if number != self._number:
                rng = np.random.default_rng(stream(self._seed, self._name, number))
                shape = (self._rows, self.dimensions)
                self._block = self._sobol(number) if self._sampler == "sobol" else rng.random(shape)
                self._number = number
            parts.append(self._block[begin : begin + size])
            first += size
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _sobol(self, number: int) -> Doubles:
        from scipy.stats import qmc  # takes a quarter of a second, and few runs draw from nets

        net, within = divmod(number * self._rows, NET)
        if net != self._net or self._engine is None or within < self._drawn:
            seed = stream(self._seed, self._name, net)
            self._engine, self._net, self._drawn = qmc.Sobol(self.dimensions, scramble=True, seed=seed), net, 0
        if within > self._drawn:
            self._engine.fast_forward(within - self._drawn)
        self._drawn = within + self._rows
        return np.asarray(self._engine.random(self._rows))


class Seeds:
    """Seeds of one stream by number, many at once: much faster than `advsearch.seeds.stream` for every one."""

    def __init__(self, root: int, name: str) -> None:
        self._root, self._name = root, name
        self._number = -1
        self._block: NDArray[Any] = np.empty(0, dtype=np.uint32)

    def __call__(self, index: int) -> int:
        """Return seed number `index`, in [0, 2**32)."""
        number, place = divmod(index, SEEDS)
        if number != self._number:
            sequence = np.random.SeedSequence(stream(self._root, self._name, number))
            self._number, self._block = number, sequence.generate_state(SEEDS, dtype=np.uint32)
        return int(self._block[place])


@dataclass(frozen=True)
class Product:
    """The product of axes with so many values each, at least 1; the last runs fastest. No axis at all has one point."""

    sizes: tuple[int, ...]
    count: int = field(init=False)

    def __post_init__(self) -> None:
        if any(size < 1 for size in self.sizes):
            raise InputError(f"axes: expected at least one value on each, got sizes {self.sizes}")
        object.__setattr__(self, "count", math.prod(self.sizes))

    def digits(self, index: int) -> tuple[int, ...]:
        """Return the place of a point on every axis."""
        if not 0 <= index < self.count:
            raise IndexError(f"expected a point from 0 to {self.count - 1}, got {index}")
        digits = []
        for size in reversed(self.sizes):
            index, digit = divmod(index, size)
            digits.append(digit)
        return tuple(reversed(digits))

    def index(self, digits: Sequence[int]) -> int:
        number = 0
        for size, digit in zip(self.sizes, digits, strict=True):
            number = number * size + digit
        return number


def batches(first: int, count: int, size: int) -> Iterator[range]:
    """Yield the numbers from `first` to `count` in batches that begin at multiples of `size`, so that they are those of
    somebody who started at 0; the first may be the rest of one."""
    while first < count:
        last = min(count, (first // size + 1) * size)
        yield range(first, last)
        first = last
