"""Cases and whether they hold, in words and tables."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping

from advsearch.questions.stability.answer import StabilityResult
from advsearch.report.shown import AnswerPart, Column, ShownAnswer

COLUMNS: Mapping[str, Column] = {
    "group": "{0.group}",
    "case": "{0.case}",
    "status": "{0.status}",
    "finite": lambda one: "yes" if one.finite else "NO",
    "error": lambda one: "" if one.relative_error is None else f"{100.0 * one.relative_error:.2g} %",
    "ending": lambda one: textwrap.shorten(one.ending, 30, placeholder=" ..."),
    "seconds": "{0.seconds:.1f}",
}


def shown(result: StabilityResult) -> ShownAnswer:
    """Return the cases, what was measured, what decides where a case fell short, and what was not run."""
    short = [row for row in result.rows if row.status != "ok"]
    numbers = [
        [f"{row.case}: {name}", f"{value:.3g}"]
        for row in result.rows
        for name, value in row.measured.items()
        if name.startswith("condition number")
    ]
    return ShownAnswer(
        f"{len(result.rows) - len(short)} of {len(result.rows)} cases hold, in "
        f"{sum(row.seconds for row in result.rows):.0f} seconds.",
        [
            AnswerPart.table(result.rows, COLUMNS, title="Cases"),
            AnswerPart("Condition numbers", rows=numbers),
            AnswerPart("Short", [f"{row.case} fell short: {row.decides}; expected: {row.holds}" for row in short]),
            AnswerPart("Not run", [", ".join(result.not_run)]),
        ],
    )
