"""The largest box of the configurations that were looked at inside which a model can be relied on.

The box is peeled (PRIM: Friedman and Fisher 1999, section 6): a thin slice of one factor, or one of its names, is taken
off again and again where that raises the accuracy of what is left the most. One half of the rows chooses the box, and
the other half, which has seen no choice, is asked once whether it keeps what is promised.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from advsearch.attacks import clopper_pearson
from advsearch.explanations.observations import Observations
from advsearch.explanations.rules import RuleCondition, RuleConditions, covered

SLICE = 0.05
"""Share of the rows left that is peeled off a side at a time."""
LEAST_ROWS = 60
"""Fewer rows than this cannot show an accuracy of 95 %."""
RESERVE = 0.01
"""By how much more the choosing rows have to show, since they were chosen by."""


@dataclass(frozen=True)
class Envelope:
    """A box, and what rows that did not choose it say.

    Attributes:
        conditions: of the box; at most one for each factor.
        right, of: rows inside.
        at_least: lower end of the interval of the accuracy.
        held: whether that is as much as was asked for.
    """

    conditions: RuleConditions
    right: int
    of: int
    at_least: float
    held: bool


def find_envelope(choosing: Observations, counting: Observations, accuracy: float) -> Envelope | None:
    """Return the largest box that promises an accuracy; None where no box of enough rows does.

    Args:
        choosing: rows that choose the box.
        counting: other rows that it is tried on, once.
        accuracy: in (0, 1), which the lower end of a 95 % interval has to reach.
    """
    conditions: RuleConditions = ()
    inside = np.ones(len(choosing), dtype=bool)
    while _at_least(choosing.right[inside]) < min(accuracy + RESERVE, (1.0 + accuracy) / 2.0):
        best, kept = max(
            ((one, covered(one, choosing)) for one in _peeled(conditions, choosing, inside)),
            key=lambda pair: _mean(choosing.right[pair[1]]),
            default=((), inside),
        )
        if not best or int(kept.sum()) < LEAST_ROWS:
            return None
        conditions, inside = best, kept
    right = counting.right[covered(conditions, counting)]
    low = _at_least(right)
    return Envelope(conditions, int(right.sum()), len(right), low, low >= accuracy)


def _at_least(right: np.ndarray) -> float:
    return clopper_pearson(int(right.sum()), len(right))[0] if len(right) else 0.0


def _mean(right: np.ndarray) -> float:
    return float(right.mean()) if len(right) >= LEAST_ROWS else -1.0


def _peeled(conditions: RuleConditions, found: Observations, inside: np.ndarray) -> Iterator[RuleConditions]:
    """Boxes that are a little smaller, in one factor each."""
    own = {one.place: one for one in conditions}
    for place, factor in enumerate(found.factors):
        column = found.values[inside, place]
        if factor.options:
            whole = RuleCondition(place, options=frozenset(range(len(factor.options))))
            before = own.get(place, whole)
            assert before.options is not None
            smaller = [replace(before, options=before.options - {one}) for one in before.options]
            smaller = [one for one in smaller if one.options]
        else:
            before = own.get(place, RuleCondition(place))
            low, high = (float(f"{np.quantile(column, at):.3g}") for at in (SLICE, 1.0 - SLICE))
            smaller = [replace(before, low=low), replace(before, high=high)]
            if low < column.min() or low >= column.max():  # few different values: the least one goes
                smaller[0] = replace(before, low=float(column.min()))
            if high >= column.max():
                rest = column[column < column.max()]
                smaller[1] = replace(before, high=float(rest.max())) if len(rest) else before
        for one in smaller:
            if one != before and (one.low < one.high):
                yield tuple({**own, place: one}[key] for key in sorted({**own, place: one}))
