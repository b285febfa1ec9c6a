"""Few cases of a product: each value once beside ever new others; the other cases are slow and come by turns."""

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations, product
from typing import Any

import pytest


def once_each(names: str, *axes: Iterable[Any], ids: Callable[[Any], str | None] | None = None) -> pytest.MarkDecorator:
    """Parametrise a test by a product of values, of which `covering` is not slow."""
    values = [list(axis) for axis in axes]
    few = covering([len(axis) for axis in values])
    cases = [
        pytest.param(
            *(axis[one] for axis, one in zip(values, case, strict=True)), marks=() if case in few else pytest.mark.slow
        )
        for case in product(*(range(len(axis)) for axis in values))
    ]
    return pytest.mark.parametrize(names, cases, ids=ids)


def only(quick: Iterable[Any], cases: Iterable[Any]) -> list[Any]:
    """Return cases as parameters of a test, those marked as slow that are not among the quick ones."""
    quick, cases = list(quick), list(cases)
    assert all(one in cases for one in quick), f"no such case: {quick}"
    return [pytest.param(case, marks=() if case in quick else pytest.mark.slow) for case in cases]


def covering(sizes: Sequence[int]) -> set[tuple[int, ...]]:
    """Return few cases, as an index into each axis, in which each value of each axis is; greedily with new pairs."""
    left = {(axis, one) for axis, size in enumerate(sizes) for one in range(size)}
    met = set[tuple[tuple[int, int], ...]]()
    found = set[tuple[int, ...]]()
    while left:
        case = max(
            product(*map(range, sizes)),
            key=lambda case: (len(left & {*enumerate(case)}), len({*combinations(enumerate(case), 2)} - met)),
        )
        found.add(case)
        left -= {*enumerate(case)}
        met |= {*combinations(enumerate(case), 2)}
    return found
