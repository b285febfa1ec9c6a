"""What changes along a number: the accuracy along a parameter, and pictures a second by the number of workers."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from advsearch.errors import InputError
from advsearch.explanations import WORKERS, Answered, figure_value
from advsearch.questions.recipe.answer import CurveBin, CurveFigure, CurveLine, NamedCount, ScalingFigure, ScalingPoint
from advsearch.questions.recipe.table import FigureKind, Options, Table, count_of, extremes, plural, rate_with_interval
from advsearch.report.figures import BLUE, GREY, RED
from advsearch.runs.results.base import Interval


@dataclass(frozen=True)
class Fall:
    """By how much less often the model is right far from a value than near it: answers no farther than halfway, the
    others, the difference of both shares and its 95 % interval."""

    near: NamedCount
    far: NamedCount
    fall: float
    interval: Interval


def fall_of(
    name: str, rows: Sequence[Answered], values: Sequence[float], middle: float, turn: float | None, halfway: float
) -> Fall | None:
    """Compare the answers of a line within `halfway` of a value with those beyond; None where there are none of one
    kind. `turn` is after how much values come round."""
    counts = {True: [0, 0], False: [0, 0]}
    for row, value in zip(rows, values, strict=True):
        count = counts[distance(value, middle, turn) <= halfway]
        count[0] += row.correct
        count[1] += 1
    near, far = (count_of(name, *counts[one]) for one in (True, False))
    if near.accuracy is None or far.accuracy is None or near.interval is None or far.interval is None:
        return None
    interval = _apart(near.accuracy, near.interval, far.accuracy, far.interval)
    return Fall(near, far, near.accuracy - far.accuracy, interval)


def distance(value: float, middle: float, turn: float | None) -> float:
    """Return how far a value lies from another, the shorter way round where values come round."""
    away = abs(value - middle)
    return away if turn is None else min(away % turn, turn - away % turn)


def _apart(one: float, own: Interval, other: float, others: Interval) -> Interval:
    """The interval of a difference of independent estimates from their own intervals (Newcombe 1998, method 10)."""
    low = math.hypot(one - own[0], others[1] - other)
    high = math.hypot(own[1] - one, other - others[0])
    return one - other - low, one - other + high


def said(falls: Sequence[Fall], along: str, near: str) -> list[str]:
    """Say of each line whether accuracy falls along a parameter, and of two lines whether it does so more for one.
    `near` is what near means: ``within 90 degrees of 0``."""
    told = [f"{one.near.name}: {_fall(one, along, near)}" for one in falls]
    if len(falls) == 2:
        more, less = sorted(falls, key=lambda one: -one.fall)
        low, high = _apart(more.fall, more.interval, less.fall, less.interval)
        ends = f"{100 * (more.fall - less.fall):.0f} points (95 % interval {100 * low:.0f} to {100 * high:.0f})"
        known = f"more for {more.near.name} than for {less.near.name}"
        verdict = "the difference is shown" if low > 0.0 else "no difference is shown"
        told.append(f"Accuracy falls by {ends} {known}: {verdict}.")
    return told


def _fall(one: Fall, along: str, near: str) -> str:
    low, high = one.interval
    verdict = "it falls" if low > 0.0 else "it rises" if high < 0.0 else "no fall is shown"
    return (
        f"{rate_with_interval(one.near)} where {along} is {near}, {rate_with_interval(one.far)} elsewhere; "
        f"accuracy falls by {100 * one.fall:.0f} points (95 % interval {100 * low:.0f} to {100 * high:.0f}): {verdict}."
    )


COLOURS = (BLUE, RED, "#1f7a45", "#b4540a", "#6b3fa0", GREY)
MARKS = ("o", "s", "^", "D", "v", "P")


class CurveOptions(Options):
    """Options of a curve along a parameter with numbers, a line for each value of `by`; over a range, in bins. It is
    said whether accuracy falls with the distance from `away_from`, which comes round after `turn`."""

    along: str
    by: str | None = None
    bins: int = Field(default=12, ge=1, le=100)
    range: tuple[float, float] | None = None
    names: dict[str, str] = Field(default_factory=dict)
    away_from: float | None = None
    turn: float | None = Field(default=None, gt=0.0)


def _compute_curve(table: Table, options: CurveOptions) -> CurveFigure:
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
        text=[one for line in lines for one in _said_curve(line, options.along, unit, len(lines))]
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


def _said_curve(line: CurveLine, along: str, unit: str, lines: int) -> list[str]:
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


def _draw_curve(made: CurveFigure, figure: Any, run: Path) -> None:
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


CURVE = FigureKind(CurveOptions, CurveFigure, _compute_curve, _draw_curve, lambda made: (6.0, 3.4))


def _compute_scaling(table: Table, options: Options) -> ScalingFigure:
    runs: dict[tuple[int, str, str], list[Answered]] = {}
    for row in table.rows:
        count = row.values.get(WORKERS)
        if isinstance(count, (int, float)):
            runs.setdefault((int(count), row.part, str(row.values["object"])), []).append(row)
    if not runs:
        raise InputError("figures: scaling: expected sweeps with `workers` among the parts, got none")
    rates = {key: _rate(rows) for key, rows in runs.items()}
    fewest = min(count for count, _, _ in rates)
    alone = {name: rate for (count, _, name), rate in rates.items() if count == fewest}
    points = [
        _point(count, [(rate, alone.get(name)) for (other, _, name), rate in rates.items() if other == count])
        for count in sorted({count for count, _, _ in rates})
    ]
    return ScalingFigure(
        figure="scaling",
        title=options.title or "Pictures a second by number of workers",
        text=_said_scaling(points, table.cores),
        cores=table.cores,
        points=points,
    )


def _rate(rows: Sequence[Answered]) -> float:
    """Pictures a second; rows of one batch are stored at once."""
    times = sorted(row.time for row in rows if row.time is not None)
    begun = times[len(times) // 4] if times else 0.0
    if not times or times[-1] <= begun:
        raise InputError("figures: scaling: expected runs of several batches; ask for more `samples`, or set `batch`")
    return sum(time > begun for time in times) / (times[-1] - begun)


def _point(workers: int, rates: Sequence[tuple[float, float | None]]) -> ScalingPoint:
    return ScalingPoint(
        workers=workers, rates=[rate for rate, _ in rates], gains=[rate / base for rate, base in rates if base]
    )


def _said_scaling(points: Sequence[ScalingPoint], cores: int) -> list[str]:
    first, *others = points
    said = [f"{_workers(first)}: {_spread(first.rates)} pictures a second."]
    said += [
        f"{_workers(one)}: {_spread(one.rates)} pictures a second, {_spread(one.gains)} times as many as "
        f"{_workers(first)} ({100 * statistics.median(one.gains) * first.workers / one.workers:.0f} % of linear)."
        for one in others
        if one.gains
    ]
    runs = min(len(one.rates) for one in points)
    if runs > 1:
        said.append(
            f"Medians of {runs} runs, one of each object, with the lowest and the highest, which enclose the median of "
            f"all such runs with a confidence of {100 * (1 - 0.5 ** (runs - 1)):.3g} %."
        )
    few = f"{cores} core{'s' if cores > 1 else ''}"
    return [*said, f"This machine gives {few}; what other programs took of it meanwhile is in these numbers."]


def _workers(one: ScalingPoint) -> str:
    return f"{one.workers} worker{'s' if one.workers > 1 else ''}"


def _spread(values: Sequence[float]) -> str:
    """The median, and where there are several values the ends of them: ``1.9 (1.8 to 2)``."""
    text = f"{statistics.median(values):.3g}"
    return f"{text} ({min(values):.3g} to {max(values):.3g})" if len(values) > 1 else text


def _draw_scaling(made: ScalingFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    workers = [one.workers for one in made.points]
    middle = [statistics.median(one.rates) for one in made.points]
    linear = [middle[0] * count / workers[0] for count in workers]
    axes.plot(workers, linear, color="0.7", label=f"linear, from {_workers(made.points[0])}")
    for one in made.points:
        axes.plot([one.workers] * 2, [min(one.rates), max(one.rates)], color=BLUE, alpha=0.45, linewidth=3)
    axes.plot(workers, middle, "o-", color=BLUE, ms=5, label="median; bar: lowest to highest run")
    axes.set_xticks(workers, [figure_value(float(count)) for count in workers])
    top = max([*linear, *(rate for one in made.points for rate in one.rates)])
    axes.set(xlabel="workers", ylabel="pictures a second", ylim=(0.0, 1.08 * top))
    axes.set_title(made.title)
    axes.grid(True, axis="y")
    figure.legend(loc="outside lower center", ncols=2)


SCALING = FigureKind(
    Options, ScalingFigure, _compute_scaling, _draw_scaling, lambda made: (6.0, 3.4), tells_models=True
)
