"""The accuracy for each value of something, with 95 % intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from advsearch.questions.recipe.answer import BarsFigure
from advsearch.questions.recipe.figures.base import FigureKind, Options, counted_by, extremes, plural
from advsearch.questions.recipe.table import Table
from advsearch.report.figures import BLUE


class BarsOptions(Options):
    """Options of bars.

    Attributes:
        by: what the bars differ in: object, environment, model, group, answer or a parameter.
    """

    by: str


def _compute(table: Table, options: BarsOptions) -> BarsFigure:
    counts = counted_by(table, options.by)
    ordered = sorted(counts, key=lambda one: -(one.accuracy or 0.0))
    return BarsFigure(
        figure="bars",
        title=options.title or f"Accuracy by {options.by}",
        text=extremes(counts, "Hardest", "easiest", plural(options.by)),
        by=options.by,
        bars=ordered,
    )


def _draw(made: BarsFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    rows = made.bars[::-1]
    places = range(len(rows))
    axes.barh(places, [one.accuracy or 0.0 for one in rows], color=BLUE, alpha=0.55, height=0.62)
    for place, one in enumerate(rows):
        if one.interval:
            axes.plot(one.interval, [place, place], color="#1c1d20", linewidth=1.2)
    axes.set_yticks(places, [one.name for one in rows])
    axes.set(xlabel="accuracy, with 95 % interval", xlim=(0.0, 1.0), ylim=(-0.6, len(rows) - 0.4))
    axes.set_title(made.title)
    axes.grid(True, axis="x")


BARS = FigureKind(
    BarsOptions,
    BarsFigure,
    _compute,
    _draw,
    lambda made: (6.0, 1.2 + 0.27 * len(made.bars)),
)
