"""Count the right predictions under rules, and find warnings about the rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pandas as pd

from advsearch.extend import rules
from advsearch.questions.explain.result import (
    ParameterWeight,
    RejectedRule,
    RightCounts,
)


def count_right(rows: pd.DataFrame) -> RightCounts:
    """Count right predictions among rows, with the fraction of right ones.

    A unit is an independent draw. If several rows belong to a unit, such as the frames
    of a drive, they are not independent. So the fraction (`share`) is the mean over
    units of the fraction of each, and every unit has the same weight. The fraction is
    None if there are no rows.
    """
    right_fraction = None if rows.empty else rules.estimate_rate(rows)
    return RightCounts(
        right=int(rows["correct"].sum()),
        total=len(rows),
        interval=rules.estimate_interval(rows),
        share=right_fraction,
        outcomes=rules.count_wrong_outcomes(rows),
    )


def describe_rule(rule: rules.CountedRule) -> dict[str, Any]:
    """Return the fields of a rule: conditions, and counts inside and elsewhere.

    The counts inside are fields of the rule itself, such as `right` and `total`.
    """
    # conditions as results store them
    conditions = [condition.row for condition in rule.conditions]
    return {
        "conditions": conditions,
        **vars(count_right(rule.inside)),
        "elsewhere": count_right(rule.elsewhere),
    }


def make_rejected_rule(
    rule: rules.CountedRule | None, n_rows: int
) -> RejectedRule | None:
    """Return the result of a rule that is not significant; None without a rule.

    Its field `rows` states how many rows would make the rule significant if the rates
    stayed the same; None if no number of rows would.

    Args:
        rule: the rule.
        n_rows: number of rows in which rules were searched.
    """
    if rule is None:
        return None
    # how many times as many rows would be needed
    needed_factor = rule.find_needed_factor()
    n_needed = None if needed_factor is None else round_up(needed_factor * n_rows)
    return RejectedRule(
        **describe_rule(rule),
        chance=rule.p_value,
        p_value_limit=rules.SIGNIFICANCE,
        rows=n_needed,
    )


def round_up(count: float) -> int:
    """Round up to two significant digits: 173.2 becomes 180."""
    n_digits = math.floor(math.log10(count)) + 1  # before the decimal point
    step: int = 10 ** max(0, n_digits - 2)
    return math.ceil(count / step) * step


def find_row_warnings(
    table: pd.DataFrame, importance: Sequence[ParameterWeight]
) -> list[str]:
    """Return warnings about the rows of a table and the importance of its factors.

    Args:
        table: the rows, with the columns `correct` and `unit` (the draw).
        importance: weights of the factors.
    """
    warnings = _find_draw_warnings(table["unit"].nunique())
    if table["correct"].nunique() < 2:
        always = "right" if table["correct"].all() else "wrong"
        warnings.append(
            f"The model is {always} in every row: there are no differences to explain."
        )
    elif all(weight.interval[0] <= 0.0 for weight in importance):
        warnings.append(
            "No parameter is shown to decide anything: the intervals of "
            "all fractions begin at 0."
        )
    return warnings


def _find_draw_warnings(n_draws: int) -> list[str]:
    """Return a warning if rows are of so few draws that they show little."""
    if n_draws == 1:
        return [
            "The rows are of one draw: a single drive, or images that differ only in "
            "noise. The fractions are those of this draw, and say nothing about others."
        ]
    if n_draws < rules.MIN_ROWS:
        return [
            f"The rows are of {n_draws} draws. Rows of the same draw are not "
            "independent, and so few draws show little."
        ]
    return []
