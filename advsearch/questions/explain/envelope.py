"""Find a box of parameter values inside which the model can be relied on.

The box is peeled (PRIM: Friedman and Fisher 1999, section 6): in each step it loses a
thin slice of the values of one factor, or one of its names; the slice is the one whose
removal raises the accuracy inside the most. One half of the rows chooses the box. The
other half tests once whether it has the required accuracy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd

from advsearch.extend import rules
from advsearch.questions.explain.findings import count_right
from advsearch.questions.explain.result import EnvelopeRow

PEELED_FRACTION = 0.05
"""Fraction of the rows in the box that one peel removes at one bound."""
MIN_BOX_UNITS = 60
"""Minimum number of independent rows, or drives, in a box: fewer cannot show an
accuracy of 95 %.
"""
ACCURACY_RESERVE = 0.01
"""Additional accuracy that is required of the rows that choose the box, because their
estimate is biased.
"""


def find_envelope(
    selection_rows: pd.DataFrame, test_rows: pd.DataFrame, accuracy: float
) -> EnvelopeRow | None:
    """Find the largest box of values inside which a model has an accuracy.

    A box is peeled (made smaller, see `list_peels`) until the lower bound of its
    accuracy among the selection rows is large enough. It is confirmed if the lower
    bound among the test rows is large enough, too.

    Args:
        selection_rows: half of the rows, by which the box is chosen.
        test_rows: the other half, which tests the box once.
        accuracy: accuracy in (0, 1), the lower bound of a 95 % interval.

    Returns:
        The box with its counts; None if no box of enough rows has the accuracy.
    """
    if selection_rows.empty:
        return None
    box = _peel_until(_add_reserve(accuracy), selection_rows)
    if box is None:
        return None
    counts = count_right(test_rows[rules.find_covered(box, test_rows)])
    conditions = [condition.row for condition in box]  # as a result stores them
    lower_bound = counts.interval[0]
    return EnvelopeRow(
        conditions=conditions,
        **vars(counts),
        accuracy=accuracy,
        confirmed=lower_bound >= accuracy,
    )


def _add_reserve(accuracy: float) -> float:
    """Return the accuracy that a box has to have among the selection rows.

    The box is chosen for its accuracy among these rows, which therefore is too large on
    average: a reserve is added to the required accuracy. Near 1 it is half of the
    distance to 1.
    """
    return min(accuracy + ACCURACY_RESERVE, (1.0 + accuracy) / 2.0)


def _peel_until(
    required: float, selection_rows: pd.DataFrame
) -> rules.RuleConditions | None:
    """Peel a box until the lower bound of its accuracy is large enough; None if it never is.

    Args:
        required: required lower bound.
        selection_rows: rows by which the box is chosen.
    """
    box: rules.RuleConditions = ()  # without conditions: everything
    inside = selection_rows
    while rules.estimate_interval(inside)[0] < required:  # the lower bound
        smaller_box = find_best_peel(box, inside, selection_rows)
        if smaller_box is None:
            return None
        box = smaller_box
        inside = selection_rows[rules.find_covered(box, selection_rows)]
    return box


def find_best_peel(
    box: rules.RuleConditions, inside: pd.DataFrame, selection_rows: pd.DataFrame
) -> rules.RuleConditions | None:
    """Return the slightly smaller box with the highest accuracy.

    If several have it, the first one is returned. Boxes with fewer than `MIN_BOX_UNITS`
    independent units are left out: a unit is a row, or a draw if several rows share it.
    None if no box remains.

    Args:
        box: the conditions of the box.
        inside: the selection rows inside it, which decide where it is peeled.
        selection_rows: all selection rows.
    """
    is_independent = selection_rows["unit"].is_unique
    best_box = None
    best_accuracy = -1.0
    for smaller_box in list_peels(box, inside):
        remaining = selection_rows[rules.find_covered(smaller_box, selection_rows)]
        n_draws = len(remaining) if is_independent else remaining["unit"].nunique()
        if n_draws >= MIN_BOX_UNITS and remaining["correct"].mean() > best_accuracy:
            best_box = smaller_box
            best_accuracy = remaining["correct"].mean()
    return best_box


def list_peels(
    box: rules.RuleConditions, inside: pd.DataFrame
) -> Iterator[rules.RuleConditions]:
    """Yield boxes that are slightly smaller than `box`, by one narrower condition each.

    A factor (a parameter) that the box does not restrict yet gets its first condition.

    Args:
        box: the conditions of the box.
        inside: the rows inside it.
    """
    condition_of_factor = {condition.factor: condition for condition in box}
    for factor, unit in inside.attrs["units"].items():
        condition = condition_of_factor.get(factor, rules.RuleCondition(factor, unit))
        for smaller in list_factor_peels(condition, inside[factor]):
            # never so for a condition on names, which has infinite bounds
            is_empty = smaller.low >= smaller.high
            if smaller != condition and not is_empty:
                conditions = {**condition_of_factor, factor: smaller}
                # in the order of the factors, and not in that of the peels
                factors = [name for name in inside.attrs["units"] if name in conditions]
                yield tuple(conditions[name] for name in factors)


def list_factor_peels(
    condition: rules.RuleCondition, column: pd.Series
) -> Iterator[rules.RuleCondition]:
    """Yield slightly narrower conditions on a factor.

    A condition on names loses one of them. A range of numbers loses its lowest or its
    highest numbers.

    Args:
        condition: condition on the factor, of the box.
        column: values of the factor in the rows inside the box.
    """
    if column.dtype == "category":
        # A new condition has no `options`: it allows all names.
        names = condition.options or frozenset(column.cat.categories)
        if len(names) > 1:
            for name in sorted(names):
                yield replace(condition, options=names - {name})
        return
    values = column.to_numpy()
    yield replace(condition, low=_find_higher_low(values))
    high = _find_lower_high(values)
    if high is not None:
        yield replace(condition, high=high)


def _find_higher_low(values: rules.FloatArray) -> float:
    """Return a lower bound that leaves out the lowest values (n,).

    Values above the bound stay. The bound leaves out about `PEELED_FRACTION` of the
    values, and is rounded to three digits. If rounding would leave out none or all of
    them, only the lowest value is left out. If all values are the same, this leaves out
    all of them; `find_best_peel` ignores a box without rows.
    """
    lowest = values.min()
    low = _round_to_3_digits(np.quantile(values, PEELED_FRACTION))
    leaves_out_some = lowest <= low < values.max()
    return low if leaves_out_some else float(lowest)


def _find_lower_high(values: rules.FloatArray) -> float | None:
    """Return an upper bound that leaves out the highest values (n,).

    Values up to the bound stay. The bound leaves out about `PEELED_FRACTION` of the
    values, and is rounded to three digits. If rounding would leave out none or all of
    them, only the highest value is left out. None if all values are the same.
    """
    highest = values.max()
    high = _round_to_3_digits(np.quantile(values, 1.0 - PEELED_FRACTION))
    leaves_out_some = values.min() <= high < highest
    if leaves_out_some:
        return high
    lower_values = values[values < highest]
    return float(lower_values.max()) if len(lower_values) else None


def _round_to_3_digits(value: float) -> float:
    """Round to three significant digits."""
    return float(f"{value:.3g}")
