"""The accuracy along a parameter, for each of several groups, with 95 % intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from advsearch.errors import InputError
from advsearch.explanations.observations import Answered, figure_value
from advsearch.questions.recipe.answer import CurveBin, CurveFigure, CurveLine, NamedCount
from advsearch.questions.recipe.figures.base import FigureKind, Options, extremes, plural
from advsearch.questions.recipe.figures.trend import fall_of, said
from advsearch.questions.recipe.table import Table, count_of
from advsearch.report.figures import BLUE, GREY, RED

COLOURS = (BLUE, RED, "#1f7a45", "#b4540a", "#6b3fa0", GREY)
MARKS = ("o", "s", "^", "D", "v", "P")


class CurveOptions(Options):
    """Options of a curve.

    Attributes:
        along: a parameter with numbers.
        by: what the lines differ in: object, group, model, trial, ...; one line where it is not given.
        bins: parts of the range.
        range: its ends; by default the least and the largest value.
        names: what the lines are called, where not by their values.
        away_from: a value; it is said whether accuracy falls with the distance from it.
        turn: after how much the parameter comes round, for that distance: 360 for a heading in degrees.
    """

    along: str
    by: str | None = None
    bins: int = Field(default=12, ge=1, le=100)
    range: tuple[float, float] | None = None
    names: dict[str, str] = Field(default_factory=dict)
    away_from: float | None = None
    turn: float | None = Field(default=None, gt=0.0)


def _compute(table: Table, options: CurveOptions) -> CurveFigure:
    values = table.numbers(options.along)
    low, high = options.range or (min(values, default=0.0), max(values, default=0.0))
    if not high > low:
        raise InputError(f"figures: curve: expected values of {options.along} that differ, got {low:g} to {high:g}")
    edges = [low + (high - low) * number / options.bins for number in range(options.bins + 1)]
    groups = table.by(options.by) if options.by else {"all": list(table.rows)}
    lines = [
        _line(options.names.get(name, name), rows, Table(rows, table.groups).numbers(options.along), edges)
        for name, rows in groups.items()
    ]
    unit = table.unit(options.along)
    return CurveFigure(
        figure="curve",
        title=options.title or f"Accuracy along {options.along}",
        text=[one for line in lines for one in _said(line, options.along, unit, len(lines))]
        + _between(lines, options.by)
        + _trend(groups, options, (low, high), unit, table),
        along=options.along,
        unit=unit,
        by=options.by,
        lines=lines,
    )


def _line(name: str, rows: Sequence[Answered], values: Sequence[float], edges: Sequence[float]) -> CurveLine:
    low, high, bins = edges[0], edges[-1], len(edges) - 1
    right, seen = [0] * bins, [0] * bins
    for row, value in zip(rows, values, strict=True):
        if low <= value <= high:
            place = min(int((value - low) / (high - low) * bins), bins - 1)
            seen[place] += 1
            right[place] += row.correct
    counts = [count_of("", *one) for one in zip(right, seen, strict=True)]
    parts = [
        CurveBin(low=edges[place], high=edges[place + 1], **one.model_dump(exclude={"name"}))
        for place, one in enumerate(counts)
    ]
    return CurveLine(**count_of(name, sum(right), sum(seen)).model_dump(), bins=parts)


def _said(line: CurveLine, along: str, unit: str, lines: int) -> list[str]:
    counts = [NamedCount(name=_span(one, unit), **one.model_dump(exclude={"low", "high"})) for one in line.bins]
    whose = f"For {line.name}, accuracy" if lines > 1 else "Accuracy"
    return extremes(counts, f"{whose} is lowest where {along}", "highest where it", "parts of the range")


def _span(one: CurveBin, unit: str) -> str:
    return f"{figure_value(one.low)} to {figure_value(one.high)}" + (
        f" {unit}" if unit not in ("", "1", "name") else ""
    )


def _between(lines: Sequence[CurveLine], by: str | None) -> list[str]:
    """Which line is lowest and which highest, as one text, so that curves along other parameters do not repeat it."""
    if not by or len(lines) < 2:
        return []
    whose = [line.model_copy(update={"name": f"that of {line.name}"}) for line in lines]
    lowest, highest = "Over the whole range, the lowest accuracy", "the highest"
    return [" ".join(extremes(whose, lowest, highest, plural(by)))]


def _trend(
    groups: Mapping[str, Sequence[Answered]], options: CurveOptions, ends: tuple[float, float], unit: str, table: Table
) -> list[str]:
    """Whether accuracy falls with the distance from a value: up to halfway against beyond, for each line."""
    middle, turn = options.away_from, options.turn
    if middle is None:
        return []
    halfway = turn / 4.0 if turn else max(abs(end - middle) for end in ends) / 2.0
    numbers = {name: Table(rows, table.groups).numbers(options.along) for name, rows in groups.items()}
    falls = [
        fall_of(options.names.get(name, name), rows, numbers[name], middle, turn, halfway)
        for name, rows in groups.items()
    ]
    named = "" if unit in ("", "1", "name") else f" {unit}"
    near = f"within {figure_value(halfway)}{named} of {figure_value(middle)}"
    return said([one for one in falls if one], options.along, near)


def _draw(made: CurveFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    for number, line in enumerate(made.lines):
        known = [one for one in line.bins if one.interval and one.accuracy is not None]
        at = [(one.low + one.high) / 2 for one in known]
        colour = COLOURS[number % len(COLOURS)]
        low, high = ([one.interval[end] for one in known if one.interval] for end in (0, 1))
        axes.fill_between(at, low, high, color=colour, alpha=0.15, linewidth=0)
        mark = MARKS[number % len(MARKS)]
        axes.plot(at, [one.accuracy for one in known], color=colour, marker=mark, ms=4, label=line.name)
    unit = f" [{made.unit}]" if made.unit not in ("", "1", "name") else ""
    axes.set(xlabel=f"{made.along}{unit}", ylabel="accuracy, with 95 % interval", ylim=(-0.03, 1.03))
    axes.set_title(made.title)
    axes.grid(True, axis="y")
    if len(made.lines) > 1:
        figure.legend(loc="outside lower center", ncols=min(len(made.lines), 4))


CURVE = FigureKind(CurveOptions, CurveFigure, _compute, _draw, lambda made: (6.0, 3.4))
