"""The accuracy for each pair of values of two things, as colours with numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from advsearch.questions.recipe.answer import HeatMapFigure, NamedCount
from advsearch.questions.recipe.figures.base import FigureKind, Options, extremes, plural, rate_with_interval
from advsearch.questions.recipe.table import Table, count_of
from advsearch.questions.recipe.words import bare

ENOUGH = 20
"""Configurations of a pair of which it is said that none is right: the interval of 0 of 20 ends at 17 %."""

SHORT = 4
"""Letters that stand level under a column."""


class HeatMapOptions(Options):
    """Options of a heat map.

    Attributes:
        rows: what rows differ in: object, environment, model, group, answer or a parameter.
        columns: what columns differ in.
    """

    rows: str
    columns: str


def _compute(table: Table, options: HeatMapOptions) -> HeatMapFigure:
    by_row = {name: Table(rows, table.groups).by(options.columns) for name, rows in table.by(options.rows).items()}
    rows, columns = list(by_row), list(table.by(options.columns))
    seen = [[len(by_row[row].get(column, ())) for column in columns] for row in rows]
    correct = [[sum(one.correct for one in by_row[row].get(column, ())) for column in columns] for row in rows]
    cells = [
        count_of(f"{row} with {_named(column, options.columns)}", correct[up][across], seen[up][across])
        for up, row in enumerate(rows)
        for across, column in enumerate(columns)
    ]
    return HeatMapFigure(
        figure="heat map",
        title=options.title or f"Accuracy by {options.rows} and {options.columns}",
        text=_said(cells, plural(options.rows), plural(options.columns)),
        row=options.rows,
        column=options.columns,
        rows=rows,
        columns=columns,
        configurations=seen,
        correct=correct,
    )


def _named(value: str, column: str) -> str:
    """A number says what it is of: ``severity 3``."""
    return f"{bare(column)} {value}" if value[:1].isdigit() or value[:1] == "-" else value


def _said(cells: list[NamedCount], rows: str, columns: str) -> list[str]:
    known = [one for one in cells if one.configurations]
    none = [one for one in known if one.correct == 0]
    enough = [one for one in none if one.configurations >= ENOUGH]
    some = "; ".join(f"{one.name} ({rate_with_interval(one)})" for one in enough[:4]) + (
        "; and others" if len(enough) > 4 else ""
    )
    said = [f"No answer is right in {len(enough)} of {len(known)} pairs: {some}."] if enough else []
    if few := len(none) - len(enough):
        have = "have" if few > 1 else "has"
        said.append(f"{few} of the pairs without a right answer {have} under {ENOUGH} configurations: too few to say.")
    return [*extremes(cells, "The lowest pair", "the highest", f"pairs of {rows} and {columns}"), *said]


def _draw(made: HeatMapFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    shares = [
        [right / seen if seen else float("nan") for right, seen in zip(*pair, strict=True)]
        for pair in zip(made.correct, made.configurations, strict=True)
    ]
    shown = axes.imshow(shares, cmap="RdBu", vmin=0.0, vmax=1.0, aspect="auto")
    for up, row in enumerate(shares):
        for across, share in enumerate(row):
            if share == share:
                colour = "white" if abs(share - 0.5) > 0.3 else "black"
                axes.text(across, up, f"{100 * share:.0f}", ha="center", va="center", color=colour, fontsize=7.5)
    turned = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"} if max(map(len, made.columns)) > SHORT else {}
    axes.set_xticks(range(len(made.columns)), made.columns, **turned)
    axes.set_yticks(range(len(made.rows)), made.rows)
    axes.set(xlabel=made.column, ylabel=made.row)
    axes.set_title(made.title)
    figure.colorbar(shown, ax=axes, label="accuracy [%]", format=lambda share, _: f"{100 * share:.0f}")


HEAT_MAP = FigureKind(
    HeatMapOptions,
    HeatMapFigure,
    _compute,
    _draw,
    lambda made: (max(2.8 + 0.42 * len(made.columns), 5.4), 1.9 + 0.28 * len(made.rows)),
)
