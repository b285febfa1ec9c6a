"""How often the model is right, or wrong, by one or two columns: bars, lines along a parameter, or a map of pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal

from pydantic import Field

from advsearch.errors import InputError
from advsearch.explanations import Answered, figure_value
from advsearch.questions.recipe.table import (
    COLOURS,
    COUNT,
    MARKS,
    Count,
    MadeFigure,
    Options,
    Table,
    bare,
    extremes,
    plural,
)
from advsearch.runs.results.base import Interval

BINS = 12
"""Parts of a range where lines are drawn along it."""
ENOUGH = 20
"""Pictures of a pair of which it is said that none counts: the interval of 0 of 20 ends at 17 %."""
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
    beside = [row for row in table.rows if row.part == options.beside]
    table = table.where(row for row in table.rows if row.part != options.beside)
    if not table.rows:
        raise InputError(f"figures: rates: expected rows of a part beside {options.beside!r}, got none")
    lines = table.by(options.series) if options.series else {"": list(table.rows)}
    groups, middles = _groups(table, options)

    def counts(name: str, rows: Sequence[Answered]) -> list[Count]:
        split = table.where(rows).by(options.series) if options.series else {"": rows}
        return [Count.over(name, split.get(line, ()), lambda row: row.correct is not options.wrong) for line in lines]

    cells = {options.names.get(name, name): counts(name, rows) for name, rows in groups.items()}
    if options.form == "bars" and isinstance(table.value(table.rows[0], options.by), str):
        cells = dict(sorted(cells.items(), key=lambda item: -(item[1][0].share or 0.0)))
    series = [options.names.get(name, name) for name in lines]
    totals = counts("all", table.rows)
    apart = {options.names.get(options.beside, options.beside): counts("", beside)} if options.beside and beside else {}
    text = _between_cells(cells, series, options, verb) if options.form == "map" else []
    if options.form != "map":
        where = f" where {options.by}" if middles else ""
        for number, name in enumerate(series):
            along = [Count(row, one[number].counted, one[number].of) for row, one in cells.items()]
            worst = (f"For {name}, the" if len(series) > 1 else "The") + f" lowest share{where}"
            text += extremes(along, worst, f"the highest{where}", plural(options.by), verb)
        text += _between_series(cells, series, totals, options, verb)
    for name, alone in apart.items():
        for line, count, total in zip(series, alone, totals, strict=True):
            more = "is shown" if count.below(total) or total.below(count) else "is not shown"
            whose = f"{line}, " if len(series) > 1 else ""
            text.append(f"{whose}{name}: {count.told(verb)}; the others: {total.told(verb)}. A difference {more}.")
    if options.away_from is not None:
        text += _falls(table, lines, options)
    thing = plural(options.by) + (f" and {plural(options.series)}" if options.series else "")
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
            axes.set(xlabel=f"{options.by}{table.unit(options.by)}", ylabel=f"{label} with 95 % interval")
        else:
            _draw_bars(axes, {**apart, **cells}, series)
            axes.set(xlabel=f"{label} with 95 % interval")
        if len(series) > 1 and options.form != "map":
            figure.legend(loc="outside lower center", ncols=min(len(series), 3))

    size = {
        "map": (max(2.8 + 0.42 * len(series), 5.4), 1.9 + 0.28 * len(cells)),
        "lines": (6.0, 3.4),
        "bars": (6.0, 1.4 + (0.2 + 0.09 * len(series)) * len({**apart, **cells})),
    }[options.form]
    return MadeFigure(title, text, columns, rows, draw, size)


def _groups(table: Table, options: RatesOptions) -> tuple[Mapping[str, Sequence[Answered]], list[float] | None]:
    """The rows by their values, or by the parts of a range with the middle of each."""
    if options.bins is None and options.form != "lines":
        return table.by(options.by), None
    values, bins = table.numbers(options.by), options.bins or BINS
    low, high = options.range or (min(values), max(values))
    if not high > low:
        raise InputError(f"figures: rates: expected values of {options.by} that differ, got {low:g} to {high:g}")
    inside: list[list[Answered]] = [[] for _ in range(bins)]
    for row, value in zip(table.rows, values, strict=True):
        if low <= value <= high:
            inside[min(int((value - low) / (high - low) * bins), bins - 1)].append(row)
    edges = [low + (high - low) * number / bins for number in range(bins + 1)]
    unit, ends = table.unit(options.by), list(pairwise(edges))
    names = [f"{figure_value(begin)} to {figure_value(end)}{unit}" for begin, end in ends]
    return dict(zip(names, inside, strict=True)), [(begin + end) / 2 for begin, end in ends]


def _between_cells(
    cells: Mapping[str, Sequence[Count]], series: Sequence[str], options: RatesOptions, verb: str
) -> list[str]:
    """Which pair has the lowest share, which the highest, and which have none."""

    def named(value: str) -> str:  # a number says what it is of: ``severity 3``
        return f"{bare(options.series or '')} {value}" if value[:1].isdigit() or value[:1] == "-" else value

    pairs = [
        Count(f"{row} with {named(name)}", one.counted, one.of)
        for row, counts in cells.items()
        for name, one in zip(series, counts, strict=True)
    ]
    thing = f"pairs of {plural(options.by)} and {plural(options.series or '')}"
    text = extremes(pairs, "The lowest pair", "the highest", thing, verb)
    known = [one for one in pairs if one.total]
    none = [one for one in known if not one.share]
    enough = [one for one in none if one.total >= ENOUGH]
    if enough:
        some = "; ".join(f"{one.name} ({one.told(verb)})" for one in enough[:4])
        others = "; and others" if len(enough) > 4 else ""
        text.append(f"No answer is {verb} in {len(enough)} of {len(known)} pairs: {some}{others}.")
    if few := len(none) - len(enough):
        have = "have" if few > 1 else "has"
        text.append(f"{few} of the pairs without a {verb} answer {have} under {ENOUGH} pictures: too few to say.")
    return text


def _between_series(
    cells: Mapping[str, Sequence[Count]], series: Sequence[str], totals: Sequence[Count], options: RatesOptions,
    verb: str,
) -> list[str]:  # fmt: skip
    """Each series against the others over all rows, as one text, and against the first in each row."""
    if len(series) < 2:
        return []
    overall = [Count(f"that of {name}", one.counted, one.of) for name, one in zip(series, totals, strict=True)]
    lowest, thing = "Over all, the lowest share", plural(options.series or "")
    text = [" ".join(extremes(overall, lowest, "the highest", thing, verb))]
    for number, name in enumerate(series[1:], start=1):
        known = {row: (one[0], one[number]) for row, one in cells.items() if one[0].total and one[number].total}
        lower = [row for row, (first, other) in known.items() if other.below(first, len(known))]
        higher = [row for row, (first, other) in known.items() if first.below(other, len(known))]
        told = [f"lower for {', '.join(lower)}"] if lower else []
        told += [f"higher for {', '.join(higher)}"] if higher else []
        rest = len(known) - len(lower) - len(higher)
        told += [f"no difference is shown for {rest} of {len(known)}"] if rest else []
        widened = f" by intervals widened for {len(known)} comparisons"
        text.append(f"{name} against {series[0]}, {plural(options.by)} one by one: {'; '.join(told)},{widened}.")
        if options.wrong and options.series == "model":
            ratios = [(other.share or 0.0) / first.share for first, other in known.values() if first.share]
            if ratios:  # corruptions without any error of the first model are left out
                mean = 100.0 * sum(ratios) / len(ratios)
                text.append(f"Relative to {series[0]}, in AlexNet's place, the mCE of {name} is {mean:.0f} %.")
    return text


def _falls(table: Table, lines: Mapping[str, Sequence[Answered]], options: RatesOptions) -> list[str]:
    """Whether accuracy falls with the distance from a value, up to halfway against beyond, for each line; and of two
    lines whether it does so more for one. Values come round after `turn`."""
    middle, turn = options.away_from or 0.0, options.turn
    ends = options.range or (min(table.numbers(options.by)), max(table.numbers(options.by)))
    halfway = turn / 4.0 if turn else max(abs(end - middle) for end in ends) / 2.0

    def is_near(row: Answered) -> bool:
        away = abs(float(table.value(row, options.by)) - middle)
        return (min(away % turn, turn - away % turn) if turn else away) <= halfway

    text, known = list[str](), list[tuple[str, float, Interval]]()
    place = f"within {figure_value(halfway)}{table.unit(options.by)} of {figure_value(middle)}"
    for line, rows in lines.items():
        name = options.names.get(line, line) or "All"
        near = Count.over(name, [row for row in rows if is_near(row)])
        far = Count.over(name, [row for row in rows if not is_near(row)])
        if near.share is None or far.share is None:
            continue
        # a unit, such as a drive, may lie on both sides: then Newcombe's interval, of independent shares, is too narrow
        shared = max(near.of.max(), far.of.max()) > 1.0
        own, others = (one.interval(2 if shared else 1) or (0.0, 1.0) for one in (near, far))
        ends = (own[0] - others[1], own[1] - others[0]) if shared else _apart(near.share, own, far.share, others)
        known.append((name, near.share - far.share, ends))
        verdict = "it falls" if ends[0] > 0.0 else "it rises" if ends[1] < 0.0 else "no fall is shown"
        text.append(
            f"{name}: {near.told()} where {options.by} is {place}, {far.told()} elsewhere; accuracy falls by "
            f"{100 * known[-1][1]:.0f} points (95 % interval {100 * ends[0]:.0f} to {100 * ends[1]:.0f}): {verdict}."
        )
    if len(known) == 2:
        (more, fall, own), (less, other, others) = sorted(known, key=lambda one: -one[1])
        low, high = _apart(fall, own, other, others)
        verdict = "the difference is shown" if low > 0.0 else "no difference is shown"
        text.append(
            f"Accuracy falls by {100 * (fall - other):.0f} points (95 % interval {100 * low:.0f} to {100 * high:.0f}) "
            f"more for {more} than for {less}: {verdict}."
        )
    return text


def _apart(one: float, own: Interval, other: float, others: Interval) -> Interval:
    """The interval of a difference of independent estimates from their own intervals (Newcombe 1998, method 10)."""
    low = math.hypot(one - own[0], others[1] - other)
    high = math.hypot(own[1] - one, other - others[0])
    return one - other - low, one - other + high


def _draw_map(
    figure: Any, axes: Any, cells: Mapping[str, Sequence[Count]], series: Sequence[str], labels: tuple[str, str, str]
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
    axes: Any, cells: Mapping[str, Sequence[Count]], series: Sequence[str], middles: Sequence[float]
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


def _draw_bars(axes: Any, cells: Mapping[str, Sequence[Count]], series: Sequence[str]) -> None:
    for number, name in enumerate(series):
        colour, label = COLOURS[number % len(COLOURS)], name
        for row, counts in enumerate(cells.values()):
            place = row + (number - (len(series) - 1) / 2) * min(0.22, 0.8 / len(series))
            if interval := counts[number].interval():
                axes.plot(interval, [place] * 2, color=colour, alpha=0.45, linewidth=3)
                axes.plot(counts[number].share, place, MARKS[number % len(MARKS)], color=colour, ms=5, label=label)
                label = "_"
    axes.set_yticks(range(len(cells)), list(cells))
    axes.set(xlim=(-0.03, 1.03), ylim=(len(cells) - 0.4, -0.6))
    axes.grid(True, axis="x")
