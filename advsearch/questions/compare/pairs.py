"""Two sides counted pair by pair: in all, by each parameter, and where one is worse."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from advsearch import seeds
from advsearch.attacks import clopper_pearson
from advsearch.attacks.trials import mcnemar, paired_difference
from advsearch.explanations.observations import Factor
from advsearch.explanations.rules import FEWEST_ROWS, CountedRule, condition_rows, find_rules
from advsearch.questions.compare.answer import ComparedPair, CountOf, PairPart, PairRule
from advsearch.questions.compare.sides import Mask, Side, observations, shared_columns
from advsearch.runs.results.sweep import AxisValue
from advsearch.viewer.columns import Column

MOST_VALUES = 64
"""Different numbers of a parameter, beyond which it has no table unless the sweep says how it is cut."""


def compared(first: Side, second: Side, seed: int, *, rules: bool = True) -> ComparedPair:
    """Return what the pairs of two sides say, without pictures.

    Args:
        first: of them.
        second: of them.
        seed: of which half of the pairs chooses rules, and which counts them.
        rules: whether they are sought.

    Raises:
        InputError: rules are sought, and scikit-learn is missing.
    """
    columns = shared_columns(first, second)
    lost, won = first.right & ~second.right, ~first.right & second.right
    return ComparedPair(
        first=first.name,
        second=second.name,
        **_counts(first.right, second.right),
        p=mcnemar(int(lost.sum()), int(won.sum())),
        worse=_rules(columns, lost, seed) if rules else None,
        better=_rules(columns, won, seed) if rules else None,
        parts=[part for one in columns for part in _parts(one, first.right, second.right)],
        shown=[],
    )


def far_apart(first: Side, second: Side, most: int) -> list[int]:
    """Return numbers of pairs that one side alone gets right: first those of the first side, then those of the second.

    Of each side the ones where the margins are farthest apart come first.

    Args:
        first: of the sides.
        second: of them.
        most: of each side.
    """
    apart = np.nan_to_num(second.margin.astype(np.float64) - first.margin, nan=0.0)
    found: list[int] = []
    for alone, sign in ((first.right & ~second.right, -1.0), (~first.right & second.right, 1.0)):
        numbers = np.flatnonzero(alone)
        found += numbers[np.argsort(sign * apart[numbers], kind="stable")][:most].tolist()
    return found


def _counts(first: Mask, second: Mask) -> dict[str, Any]:
    cells = [int(one.sum()) for one in (first & second, first & ~second, ~first & second, ~first & ~second)]
    difference, interval = paired_difference(*cells)
    return {
        **dict(zip(("both", "first_only", "second_only", "neither"), cells, strict=True)),
        "difference": difference,
        "interval": interval,
    }


def _parts(column: Column, first: Mask, second: Mask) -> Iterator[PairPart]:
    """The pairs by the values of a parameter, or by the parts of its range that the sweep's tables have."""
    for value, mask in _masks(column):
        if mask.any():
            counts = _counts(first[mask], second[mask])
            yield PairPart(parameter=column.name, unit=column.unit, value=value, **counts)


def _masks(column: Column) -> Iterator[tuple[AxisValue, Mask]]:
    if column.levels is not None:
        yield from ((name, column.data == number) for number, name in enumerate(column.levels))
    elif column.edges is not None:
        part = np.clip(np.searchsorted(column.edges, column.data, side="right") - 1, 0, len(column.edges) - 2)
        for number, ends in enumerate(zip(column.edges[:-1], column.edges[1:], strict=True)):
            yield ends, part == number
    else:
        values = np.unique(column.data)
        if len(values) <= MOST_VALUES:
            yield from ((float(f"{value:.6g}"), column.data == value) for value in values)


# ---- rules ----------------------------------------------------------------------------------------------------------


def _rules(columns: Sequence[Column], alone: Mask, seed: int) -> list[PairRule] | None:
    """Where one side alone is right more often than elsewhere; None of too few pairs, or where nothing varies.

    These are the rules of `explain`, whose wrong answers are the pairs that one side alone gets right.
    """
    found = observations(columns, ~alone)
    if len(alone) < FEWEST_ROWS or found is None:
        return None
    choosing, counting = found.halves(seed)
    told = find_rules(choosing, counting, seeds.stream(seed, "compare")).told
    return [_rule(one, found.factors) for one in told]


def _rule(rule: CountedRule, factors: Sequence[Factor]) -> PairRule:
    inside = _count_of(rule.of - rule.right, rule.of)
    elsewhere = _count_of(rule.of_elsewhere - rule.right_elsewhere, rule.of_elsewhere)
    return PairRule(conditions=condition_rows(rule.conditions, factors), elsewhere=elsewhere, **vars(inside))


def _count_of(count: int, total: int) -> CountOf:
    interval = clopper_pearson(count, total) if total else (0.0, 1.0)
    return CountOf(count=count, total=total, interval=interval)
