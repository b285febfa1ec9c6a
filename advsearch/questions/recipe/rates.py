"""How often the model is right, or wrong, by one or two columns: bars, lines along a parameter, or a map of pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from pandas.api.types import is_numeric_dtype
from pydantic import Field

from advsearch.errors import InputError
from advsearch.questions.recipe.table import (
    COLOURS,
    COUNT,
    MARKS,
    MODEL,
    PART,
    MadeFigure,
    Options,
    Rows,
    Table,
    Tally,
    bare,
    draw_bars,
    extremes,
    plural,
)
from advsearch.report.wording import figure_value

BINS = 12
"""Parts of a range where lines are drawn along it."""
SHORT = 4
"""Letters that stand level under a column."""


class RatesOptions(Options):
    """What the shares are by, and how they are drawn; docs/recipes.md has each."""

    by: str
    series: str | None = None
    form: Literal["bars", "lines", "map"] = "bars"
    bins: int | None = Field(default=None, ge=1, le=100)
    range: tuple[float, float] | None = None
    names: dict[str, str] = Field(default_factory=dict)
    wrong: bool = False
    beside: str | None = None
    away_from: float | None = None
    turn: float | None = Field(default=None, gt=0.0)

    @property
    def parts(self) -> tuple[str, ...]:
        """With the part beside them, where parts are named."""
        return (*self.of, *([self.beside] if self.beside and self.of else []))


def rates(table: Table, options: RatesOptions) -> MadeFigure:
    """Count the answers and say what the counts show."""
    verb = "wrong" if options.wrong else "right"
    beside = table.where(table.rows[PART] == options.beside)
    table = table.where(table.rows[PART] != options.beside)
    if table.rows.empty:
        raise InputError(f"figures: rates: expected rows of a part beside {options.beside!r}, got none")
    lines = list(table.by(options.series)) if options.series else [""]
    groups, middles = _groups(table, options)

    def counts(name: str, rows: Rows) -> list[Tally]:
        split = replace(table, rows=rows).by(options.series) if options.series and len(rows) else {"": rows}
        each = [split.get(line, rows[:0]) for line in lines]
        return [Tally.over(name, some, some["correct"] != options.wrong) for some in each]

    cells = {options.names.get(name, name): counts(name, rows) for name, rows in groups.items()}
    if options.form == "bars" and middles is None and not is_numeric_dtype(table.column(options.by)):
        cells = dict(sorted(cells.items(), key=lambda item: -(item[1][0].share or 0.0)))
    series = [options.names.get(name, name) for name in lines]
    totals = counts("all", table.rows)
    where = f" where {_of_what(options)}" if middles else ""
    of_series = plural(options.series or "")
    thing = plural(options.by) + (f" and {of_series}" if options.series else "")
    apart = {}
    if options.beside and len(beside.rows):
        apart[options.names.get(options.beside, options.beside)] = counts("", beside.rows)
    text = list[str]()
    if options.form == "map":
        pairs = [
            one.called(f"{row} with {_named(name, options.series or '')}")
            for row, each in cells.items()
            for name, one in zip(series, each, strict=True)
        ]
        text += extremes(pairs, "The lowest pair", "the highest", f"pairs of {thing}", verb)
    else:
        for number, name in enumerate(series):
            worst = f"For {name}, lowest" if len(series) > 1 else "Lowest"
            along = [one[number].called(row) for row, one in cells.items()]
            if len(series) < 2 or sum(one.total > 0 for one in along) > 1:  # of one row all is said below
                text += extremes(along, f"{worst}{where}", f"highest{where}", plural(options.by), verb)
    if len(series) > 1:  # in one text, so that figures by other columns do not repeat it
        overall = [
            one.called(f"that of {_named(name, options.series or '')}")
            for name, one in zip(series, totals, strict=True)
        ]
        text.append(" ".join(extremes(overall, "Over all, the lowest share", "the highest", of_series, verb)))
    if options.wrong and options.series == MODEL:
        text += _relative(cells, series)
    for name, alone in apart.items():
        for line, count, total in zip(series, alone, totals, strict=True):
            more = "is shown" if count.below(total) or total.below(count) else "is not shown"
            whose = f"{line}, " if len(series) > 1 else ""
            text.append(f"{whose}{name}: {count.told(verb)}; the others: {total.told(verb)}. A difference {more}.")
    every = {**apart, **cells, **({"all": totals} if options.series else {})}
    rows = [
        [name, *([line] if options.series else []), *count.cells]
        for name, row in every.items()
        for line, count in zip(series, row, strict=True)
    ]
    columns = [options.by, *([options.series] if options.series else []), verb, *COUNT]
    title = options.title or f"{'Error' if options.wrong else 'Accuracy'} by {thing}"

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        label = f"{verb}, share"
        if options.form == "map":
            _draw_map(figure, axes, cells, series, (options.by, options.series or "", label))
        elif options.form == "lines":
            _draw_lines(axes, cells, series, middles or range(len(cells)))
            unit = f" [{table.unit(options.by)[1:]}]" if table.unit(options.by) else ""
            axes.set(xlabel=f"{_of_what(options)}{unit}", ylabel=f"{label} with 95 % interval")
        else:
            draw_bars(axes, {**apart, **cells}, series)
            axes.set(xlabel=f"{label} with 95 % interval")
        if len(series) > 1 and options.form != "map":
            figure.legend(loc="outside lower center", ncols=min(len(series), 3))

    size = {
        "map": (max(2.8 + 0.42 * len(series), 5.4), 1.9 + 0.28 * len(cells)),
        "lines": (6.0, 3.4),
        "bars": (6.0, 1.4 + (0.2 + 0.09 * len(series)) * len({**apart, **cells})),
    }[options.form]
    return MadeFigure(title, text, columns, rows, draw, size)


def _of_what(options: RatesOptions) -> str:
    """What numbers are of."""
    away, by = options.away_from, options.by
    return by if away is None else f"the distance of {by} from {figure_value(away)}"


def _groups(table: Table, options: RatesOptions) -> tuple[Mapping[str, Rows], list[float] | None]:
    """The rows by their values, or by the parts of a range with the middle of each."""
    if options.bins is None and options.form != "lines":
        return table.by(options.by), None
    values, bins = table.numbers(options.by), options.bins or BINS
    if options.away_from is not None:
        values = (values - options.away_from).abs()
        if options.turn is not None:  # the shorter way round
            values = np.minimum(values % options.turn, options.turn - values % options.turn)
    low, high = options.range or (values.min(), values.max())
    if not high > low:
        raise InputError(f"figures: rates: expected values of {options.by} that differ, got {low:g} to {high:g}")
    places = ((values - low) / (high - low) * bins).clip(upper=bins - 1).where(values.between(low, high)) // 1
    edges, unit = [low + (high - low) * number / bins for number in range(bins + 1)], table.unit(options.by)
    ends = list(pairwise(edges))
    parts = {f"{figure_value(begin)} to {figure_value(end)}{unit}": place for place, (begin, end) in enumerate(ends)}
    return {name: table.rows[places == place] for name, place in parts.items()}, [(a + b) / 2 for a, b in ends]


def _named(value: str, column: str) -> str:
    """A number says what it is of: ``severity 3``."""
    return f"{bare(column)} {value}" if value[:1].isdigit() or value[:1] == "-" else value


def _relative(cells: Mapping[str, Sequence[Tally]], series: Sequence[str]) -> list[str]:
    """The mean over rows of each model's errors over those of the first; rows without any of that are left out."""
    text = []
    for number, name in enumerate(series[1:], start=1):
        ratios = [(row[number].share or 0.0) / row[0].share for row in cells.values() if row[0].share]
        if ratios:
            mean = 100.0 * sum(ratios) / len(ratios)
            text.append(f"Relative to {series[0]}, in AlexNet's place, the mCE of {name} is {mean:.0f} %.")
    return text


def _draw_map(
    figure: Any, axes: Any, cells: Mapping[str, Sequence[Tally]], series: Sequence[str], labels: tuple[str, str, str]
) -> None:
    shares = [[math.nan if one.share is None else one.share for one in row] for row in cells.values()]
    image = axes.imshow(shares, cmap="RdBu", vmin=0.0, vmax=1.0, aspect="auto")
    for up, row in enumerate(shares):
        for across, share in enumerate(row):
            if not math.isnan(share):
                colour = "white" if abs(share - 0.5) > 0.3 else "black"
                axes.text(across, up, f"{100 * share:.0f}", ha="center", va="center", color=colour, fontsize=7.5)
    turned = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"} if max(map(len, series)) > SHORT else {}
    axes.set_xticks(range(len(series)), series, **turned)
    axes.set_yticks(range(len(cells)), list(cells))
    axes.set(ylabel=labels[0], xlabel=labels[1])
    figure.colorbar(image, ax=axes, label=f"{labels[2]} [%]", format=lambda share, _: f"{100 * share:.0f}")


def _draw_lines(
    axes: Any, cells: Mapping[str, Sequence[Tally]], series: Sequence[str], middles: Sequence[float]
) -> None:
    for number, name in enumerate(series):
        known = [(at, row[number]) for at, row in zip(middles, cells.values(), strict=True) if row[number].total]
        at, colour = [place for place, _ in known], COLOURS[number % len(COLOURS)]
        low, high = ([(one.interval() or (0.0, 1.0))[end] for _, one in known] for end in (0, 1))
        axes.fill_between(at, low, high, color=colour, alpha=0.15, linewidth=0)
        mark = MARKS[number % len(MARKS)]
        axes.plot(at, [one.share for _, one in known], color=colour, marker=mark, ms=4, label=name)
    axes.set(ylim=(-0.03, 1.03))
    axes.grid(True, axis="y")
