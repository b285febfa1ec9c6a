"""The result of `stability`."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.report.shown import AnswerPart, Column, ShownAnswer
from advsearch.runs.results.base import Fields, JsonFloat, Result, having


class DecidingNumber(Fields):
    """One number that decides, and the range that it has to be in."""

    what: str
    value: JsonFloat
    least: JsonFloat
    most: JsonFloat
    ok: bool


class CaseRow(Fields):
    """One case of the suite and what it showed."""

    case: str = Field(description="its name")
    group: str = Field(description="its group")
    control: str = Field(description="the controls that it moves")
    finite: bool = Field(description="every picture and gradient was finite, and none had to be made so")
    relative_error: JsonFloat | None = Field(
        description="of a gradient against its reference; null where there is none"
    )
    ending: str = Field(description="of the case's search; `refused` where its input was")
    rule: str = Field(description="what handles the case")
    status: str = Field(description="`ok` or `fell short`")
    decides: str = Field(description="the number that decides")
    holds: str = Field(description="what must hold")
    checks: list[DecidingNumber]
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
        return f"{sum(row.status == 'ok' for row in self.rows)} of {len(self.rows)} hold"


RESULT = StabilityResult


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
