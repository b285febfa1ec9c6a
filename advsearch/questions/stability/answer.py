"""The result of `stability`."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.report.shown import AnswerPart, Column, ShownAnswer
from advsearch.runs.results.base import Fields, JsonFloat, Result, having

OK, FELL_SHORT = "ok", "fell short"


class Check(Fields):
    """One number that decides, and the range that it has to be in, both ends included; null where there is no end."""

    what: str
    value: JsonFloat
    least: float | None
    most: float | None
    ok: bool

    def __str__(self) -> str:
        ends = [
            f"{sign} {end:.4g}" for sign, end in (("at least", self.least), ("at most", self.most)) if end is not None
        ]
        wanted = f"exactly {self.most:.4g}" if len(ends) == 2 and self.least == self.most else " and ".join(ends)
        return f"{self.what}: {self.value:.4g}" + (f" (expected {wanted})" if wanted else "")


def check(what: str, value: float, least: float | None = None, most: float | None = None) -> Check:
    """Return the check of a number; NaN is in no range."""
    ok = value == value and (least is None or least <= value) and (most is None or value <= most)
    return Check(what=what, value=value, least=least, most=most, ok=ok)


def holds(what: str, truth: bool) -> Check:
    """Return the check that something is true: 1, else 0."""
    return check(what, float(truth), 1.0, 1.0)


class CaseRow(Fields):
    """One case of the suite and what it showed."""

    case: str = Field(description="its name")
    group: str = Field(description="its group")
    holds: str = Field(description="what must hold")
    status: str = Field(description="`ok` or `fell short`")
    decides: str = Field(description="the number that decides")
    finite: bool = Field(description="every picture and gradient was finite, and none had to be made so")
    relative_error: JsonFloat | None = Field(
        description="of a gradient against its reference; null where there is none"
    )
    ending: str = Field(description="of the case's search; `refused` where its input was")
    checks: list[Check]
    measured: dict[str, JsonFloat] = Field(description="further numbers, such as condition numbers and biases")
    seconds: float = Field(description="what the case took")


class StabilityResult(InNotebook, Result):
    """Extreme cases, and whether each of them holds."""

    command: ClassVar[str] = "stability"

    run: str = Field(description="the folder")
    ending: str = Field(description="`done`, `interrupted` or `out of time`")
    rows: list[CaseRow]
    not_run: list[str] = Field(description="cases that were not begun")
    seconds: Annotated[dict[str, JsonFloat], having("total")] = Field(description="in `total`, of this sitting")
    command_line: str = Field(description="that asks the same again")

    @property
    def brief(self) -> str:
        """How many cases hold."""
        return f"{sum(row.status == OK for row in self.rows)} of {len(self.rows)} hold"


RESULT = StabilityResult

COLUMNS: Mapping[str, Column] = {
    "group": "{0.group}",
    "case": "{0.case}",
    "status": "{0.status}",
    "finite": lambda row: "yes" if row.finite else "NO",
    "error": lambda row: "" if row.relative_error is None else f"{100.0 * row.relative_error:.2g} %",
    "ending": lambda row: textwrap.shorten(row.ending, 30, placeholder=" ..."),
    "seconds": "{0.seconds:.1f}",
}


def shown(result: StabilityResult) -> ShownAnswer:
    """Return the cases, what was measured, what decides where a case fell short, and what was not run."""
    short = [row for row in result.rows if row.status != OK]
    numbers = [
        [f"{row.case}: {name}", f"{value:.3g}"]
        for row in result.rows
        for name, value in row.measured.items()
        if name.startswith("condition number")
    ]
    return ShownAnswer(
        f"{len(result.rows) - len(short)} of {len(result.rows)} cases hold, in "
        f"{math.fsum(row.seconds for row in result.rows):.0f} seconds.",
        [
            AnswerPart.table(result.rows, COLUMNS, title="Cases"),
            AnswerPart("Condition numbers", rows=numbers),
            AnswerPart("Short", [f"{row.case} fell short: {row.decides}; expected: {row.holds}" for row in short]),
            AnswerPart("Not run", [", ".join(result.not_run)]),
        ],
    )
