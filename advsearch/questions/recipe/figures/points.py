"""The accuracy for each value of something, side by side for several series, with 95 % intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from advsearch.questions.recipe.answer import NamedCount, PointsFigure
from advsearch.questions.recipe.figures.base import FigureKind, Options, counted_by, intervals_apart, rate_with_interval
from advsearch.questions.recipe.figures.curve import COLOURS, MARKS
from advsearch.questions.recipe.table import Table, count_of


class PointsOptions(Options):
    """Options of points.

    Attributes:
        by: what the rows differ in: object, environment, model, ...
        series: what is side by side: part, trial, ...
        names: what the series are called, where not by their values.
    """

    by: str
    series: str
    names: dict[str, str] = Field(default_factory=dict)


def _compute(table: Table, options: PointsOptions) -> PointsFigure:
    series = list(table.by(options.series))
    rows = table.by(options.by)
    named = [options.names.get(name, name) for name in series]
    counts = []
    for inside in rows.values():
        found = {one.name: one for one in counted_by(Table(inside, table.groups), options.series)}
        counts.append([_called(found.get(name), name, options.names) for name in series])
    totals = [_called(one, one.name, options.names) for one in counted_by(table, options.series)]
    return PointsFigure(
        figure="points",
        title=options.title or f"Accuracy by {options.by} and {options.series}",
        text=_said(list(rows), counts, totals),
        by=options.by,
        series=options.series,
        names=named,
        rows=list(rows),
        counts=counts,
    )


def _called(one: NamedCount | None, name: str, names: dict[str, str]) -> NamedCount:
    count = one or count_of(name, 0, 0)
    return count.model_copy(update={"name": names.get(name, name)})


def _said(rows: list[str], counts: list[list[NamedCount]], totals: list[NamedCount]) -> list[str]:
    """Each series against the first, over all rows and in each."""
    said = ["; ".join(f"{one.name}: {rate_with_interval(one)}" for one in totals if one.configurations) + "."]
    for place, other in enumerate(totals[1:], start=1):
        pairs = [(name, row[0], row[place]) for name, row in zip(rows, counts, strict=True)]
        known = [(name, a, b) for name, a, b in pairs if a.configurations and b.configurations]
        lower = [name for name, a, b in known if intervals_apart(b, a, len(known))]
        higher = [name for name, a, b in known if intervals_apart(a, b, len(known))]
        unshown = [name for name, _, _ in known if name not in (*lower, *higher)]
        told = [f"lower for {', '.join(lower)}"] if lower else []
        told += [f"higher for {', '.join(higher)}"] if higher else []
        told += [f"no difference is shown for {', '.join(unshown)}"] if unshown else []
        if told:
            widened = f", by intervals widened for {len(known)} comparisons" if len(known) > 1 else ""
            said.append(f"{other.name} against {totals[0].name}: {'; '.join(told)}{widened}.")
    return said


def _draw(made: PointsFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    for number, name in enumerate(made.names):
        shift = (number - (len(made.names) - 1) / 2) * 0.22
        colour, mark, label = COLOURS[number % len(COLOURS)], MARKS[number % len(MARKS)], name
        for place, row in enumerate(reversed(made.counts)):
            one = row[number]
            if one.interval:
                axes.plot(one.interval, [place - shift] * 2, color=colour, alpha=0.45, linewidth=3)
                axes.plot(one.accuracy, place - shift, mark, color=colour, ms=5, label=label)
                label = "_"
    axes.set_yticks(range(len(made.rows)), made.rows[::-1])
    axes.set(xlabel="accuracy, with 95 % interval", xlim=(-0.03, 1.03), ylim=(-0.6, len(made.rows) - 0.4))
    axes.set_title(made.title)
    axes.grid(True, axis="x")
    figure.legend(loc="outside lower center", ncols=min(len(made.names), 3))


POINTS = FigureKind(PointsOptions, PointsFigure, _compute, _draw, lambda made: (6.0, 1.5 + 0.34 * len(made.rows)))
