"""A product of axes that is never built: from the number of a point to its place on every axis, and back.

The last axis runs fastest, as the digits of a number do:

    index = (...(digit_0 * size_1 + digit_1) * size_2 + ...) * size_k + digit_k
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from advsearch.errors import InputError


@dataclass(frozen=True)
class Product:
    """The product of axes with so many values each. No axis at all has one point.

    Attributes:
        sizes: number of values of each axis, at least 1; the last runs fastest.
        count: number of points; may be larger than any list could hold.

    Raises:
        InputError: an axis has no values.
    """

    sizes: tuple[int, ...]
    count: int = field(init=False)

    def __post_init__(self) -> None:
        if any(size < 1 for size in self.sizes):
            raise InputError(f"axes: expected at least one value on each, got sizes {self.sizes}")
        object.__setattr__(self, "count", math.prod(self.sizes))

    def digits(self, index: int) -> tuple[int, ...]:
        """Return the place of a point on every axis.

        Raises:
            IndexError: the number is under 0 or not under `count`.
        """
        if not 0 <= index < self.count:
            raise IndexError(f"expected a point from 0 to {self.count - 1}, got {index}")
        found = [0] * len(self.sizes)
        for place in range(len(self.sizes) - 1, -1, -1):
            index, found[place] = divmod(index, self.sizes[place])
        return tuple(found)

    def index(self, digits: Sequence[int]) -> int:
        """Return the number of the point at these places; the inverse of `digits`."""
        number = 0
        for size, digit in zip(self.sizes, digits, strict=True):
            number = number * size + digit
        return number


def batches(first: int, count: int, size: int) -> Iterator[range]:
    """Yield the numbers from `first` to `count` in batches that begin at multiples of `size`.

    Whoever starts in the middle of a batch gets the rest of it first; after that the batches are those of somebody who
    started at 0.
    """
    while first < count:
        last = min(count, (first // size + 1) * size)
        yield range(first, last)
        first = last
