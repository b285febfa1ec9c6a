"""The result of `gap`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

from pydantic import Field

from advsearch.report import wording
from advsearch.report.figures import BLUE, GREY, RED
from advsearch.report.markup import InNotebook
from advsearch.report.phrases import margin_text, percent
from advsearch.report.shown import AnswerPart, Claim, Column, ShownAnswer, average_claim, case_claim, searches_text
from advsearch.runs.results.attack import AverageCase, VerifiedRate
from advsearch.runs.results.base import Fields, JsonFloat, StudyResult


class GapRow(Fields):
    """The worst case beside the average, of one object and one control."""

    object: str
    control: str
    average: AverageCase
    worst: VerifiedRate | None = Field(description="trials of the worst configuration")
    ending: str
    margin: JsonFloat | None = Field(description="mean of these trials, in logits")
    renders: dict[str, int]
    run: str | None


class GapResult(InNotebook, StudyResult):
    """The worst case beside the average, over the same space and budget, for each object and each control."""

    command: ClassVar[str] = "gap"

    table: list[GapRow]

    def to_pandas(self) -> Any:
        """Return a row for each object and control as a `pandas.DataFrame`; columns are called as in `summary.json`."""
        from pandas import json_normalize  # takes half a second

        return json_normalize([row.to_dict() for row in self.table])


RESULT = GapResult


NOTE = (
    "On average: configurations drawn at random from the whole space and budget. Worst: trials of the configuration "
    "that the search found, with fresh seeds. Clopper-Pearson intervals."
)

ROW_HEIGHT = 34
"""Height of a row of the chart, in CSS pixels."""


def shown(result: GapResult) -> ShownAnswer:
    """Return the average and the worst case of each object and control."""
    columns: Mapping[str, Column] = {
        "object": "{0.object}",
        "control": "{0.control}",
        "right on average": lambda row: (
            f"{row.average.correct}/{row.average.configurations} ({percent(row.average.accuracy)})"
        ),
        "95 % interval": lambda row: wording.interval_text(row.average.interval),
        "worst: wrong": lambda row: f"{row.worst.successes}/{row.worst.trials}" if row.worst else "",
        "margin": lambda row: "" if row.margin is None else f"{row.margin:.2f}",
        "ending": "{0.ending}",
    }
    rows = result.table
    table = AnswerPart.table(
        rows,
        columns,
        title="The worst case beside the average",
        draw=(lambda axes: _draw(result, axes)) if rows else None,
        height=110 + ROW_HEIGHT * len(rows),
        size=(6.4, 1.6 + 0.36 * len(rows)),
        note=NOTE,
        parts=[row.run for row in rows],
    )
    meaning = AnswerPart(text=[f"Margin: {margin_text(result.task)}, in the trials of the worst case."])
    return ShownAnswer(
        _said(result), [table, meaning] if rows else [], {"model": result.model, "policy": result.policy}
    )


def _said(result: GapResult) -> str:
    if not result.table:
        return "Nothing was compared to its end."
    found = [row for row in result.table if row.ending == "found"]
    shares = sorted(row.average.accuracy for row in result.table)
    right = percent(shares[0]) if shares[0] == shares[-1] else f"{percent(shares[0])} to {percent(shares[-1])}"
    if len(result.table) == 1:
        worst = "yet one is found that it gets wrong" if found else "and none is found that it gets wrong"
        return f"The model is right in {right} of random configurations, {worst}."
    return (
        f"The model is right in {right} of random configurations, yet in {len(found)} of {len(result.table)} cases one "
        "is found that it gets wrong."
    )


def _draw(answer: GapResult, axes: Any) -> None:
    """Draw, for each object and control, the accuracy on average and of the worst configuration, joined by a line."""
    rows = answer.table
    for place, row in enumerate(reversed(rows)):
        mean, worst, first = row.average.accuracy, _worst(row), place == 0
        axes.plot(row.average.interval, [place, place], color=BLUE, alpha=0.35, linewidth=5)
        axes.plot([worst, mean], [place, place], color=GREY, linewidth=1)
        label = "average, with 95 % interval" if first else None
        axes.plot(mean, place, "o", color=BLUE, ms=4, zorder=4, label=label)
        label = "worst found, verified" if first else None  # an outline: where the two are equal, both are seen
        axes.plot(worst, place, "D", color=RED, mfc="none", mew=1.5, ms=9, zorder=3, label=label)
    axes.set_yticks(range(len(rows)), [f"{row.object}, {row.control}" for row in reversed(rows)])
    axes.set(xlabel="accuracy", xlim=(-0.03, 1.03), ylim=(-0.6, len(rows) - 0.4))
    axes.set_title(f"Average and worst case: {answer.model}")
    axes.grid(True, axis="x")
    axes.figure.legend(loc="outside lower center", ncols=2)


def _worst(row: GapRow) -> float:
    """Accuracy of the worst configuration: what is left of its trials."""
    return 0.0 if row.ending == "already wrong" else 1.0 - row.worst.rate if row.worst else 1.0


def claims(result: GapResult) -> Iterator[Claim]:
    """Yield both cases of each object and control."""
    for row in result.table:
        name = f"{row.object}, {row.control}"
        yield average_claim(row.average, name)
        spent = searches_text(row.renders, result.policy, bool(row.renders.get("baseline")))
        yield case_claim(name, row.ending, row.worst, spent)
