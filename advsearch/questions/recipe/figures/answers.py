"""The most frequent answers for each value of something."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from advsearch.explanations.observations import Answered
from advsearch.questions.recipe.answer import AnswersFigure, AnswersRow, GivenAnswer
from advsearch.questions.recipe.figures.base import FigureKind, Options, plural
from advsearch.questions.recipe.table import Table, count_of, counted, most_frequent
from advsearch.report.figures import BLUE, GREY, RED
from advsearch.report.phrases import percent
from advsearch.report.wording import interval_text

LETTERS = 85
"""Letters that a bar of the whole width has room for."""
FEWEST_LETTERS = 4
"""Of a name that is cut short."""


class AnswersOptions(Options):
    """Options of the most frequent answers.

    Attributes:
        by: what the rows differ in: object, material.which, ...
        most: answers of each row.
    """

    by: str
    most: int = Field(default=4, ge=1, le=10)


def _compute(table: Table, options: AnswersOptions) -> AnswersFigure:
    rows = [_row(name, inside, options.most) for name, inside in table.by(options.by).items()]
    return AnswersFigure(
        figure="answers",
        title=options.title or f"Most frequent answers by {options.by}",
        text=_said(rows, plural(options.by)),
        by=options.by,
        rows=rows,
    )


def _row(name: str, rows: list[Answered], most: int) -> AnswersRow:
    answers = [
        GivenAnswer(
            **count_of(answer, number, len(rows)).model_dump(),
            right=sum(row.correct for row in rows if row.answer == answer),
        )
        for answer, number in most_frequent(rows)[:most]
    ]
    return AnswersRow(**counted(name, rows).model_dump(), answers=answers)


def _said(rows: list[AnswersRow], thing: str) -> list[str]:
    wrong = [row for row in rows if row.answers and 2 * row.answers[0].right < row.answers[0].correct]
    said = [f"For {len(rows) - len(wrong)} of {len(rows)} {thing} the most frequent answer is mostly a right one."]
    return said + [f"For {row.name} it is {_given(row.answers[0])}." for row in wrong]


def _given(one: GivenAnswer) -> str:
    share = f"{percent(one.accuracy)}, 95 % interval {interval_text(one.interval)}"
    return f"{one.name}, given in {one.correct} of {one.configurations} ({share}) and right in {one.right} of these"


def fitting(name: str, share: float) -> str:
    """Return as much of an answer's name as a bar has room for: the first of several names, or its beginning."""
    room, first = int(share * LETTERS), name.partition(",")[0]
    fits = next((one for one in (name, first) if len(one) <= room), None)
    return fits if fits is not None else f"{first[: room - 1].rstrip()}…" if room > FEWEST_LETTERS else ""


def _draw(made: AnswersFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    for place, row in enumerate(reversed(made.rows)):
        left = 0.0
        for one in row.answers:
            share = one.accuracy or 0.0
            colour = BLUE if 2 * one.right >= one.correct else RED
            axes.barh(place, share, left=left, color=colour, alpha=0.5, height=0.72, edgecolor="white")
            axes.text(left + share / 2, place, fitting(one.name, share), ha="center", va="center", fontsize=7)
            left += share
        axes.barh(place, max(1.0 - left, 0.0), left=left, color=GREY, alpha=0.15, height=0.72)
    axes.set_yticks(range(len(made.rows)), [row.name for row in reversed(made.rows)])
    axes.set(xlabel="share of answers; blue: mostly right, red: mostly wrong, grey: others", xlim=(0.0, 1.0))
    axes.set_title(made.title)


ANSWERS = FigureKind(AnswersOptions, AnswersFigure, _compute, _draw, lambda made: (6.4, 1.2 + 0.3 * len(made.rows)))
