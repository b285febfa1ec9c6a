"""Figures of studies: robust accuracy against epsilon, worst case and average, maps of the margin and of a sweep."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, cycle
from typing import Any

from advsearch.report.drawing import BLUE, GREY, RED, Figures, drawn
from advsearch.report.wording import short_name
from advsearch.runs.results.sweep import AxisRow, SweepMap, SweepSummary
from advsearch.settings import split_names


def figure_size(answer: SweepSummary) -> tuple[float, float] | None:
    """Return width and height of a sweep's figure in inches; None where there is neither a map nor one axis."""
    return _map_size(answer.cells) if answer.cells else (5.6, 3.6) if _only_axis(answer) else None


def sweep_figure(answer: SweepSummary) -> Figures:
    """Draw a sweep: a map over two axes, or the accuracy over the only one; nothing where there is none.

    A cell shows the accuracy there; where no cell has more than one configuration, the margin.
    """
    size = figure_size(answer)
    return {} if size is None else figure_of(lambda axes: sweep_axes(answer, axes), size)


def sweep_axes(answer: SweepSummary, axes: Any) -> None:
    """Draw a sweep on matplotlib axes, as `sweep_figure` does; nothing where there is neither a map nor one axis."""
    if answer.cells:
        _cells(axes, answer, answer.cells)
    elif _only_axis(answer):
        _along(axes, answer, _only_axis(answer))


def search_axes(objectives: Mapping[str, Sequence[float | None]], meaning: str, axes: Any) -> None:
    """Draw searches on matplotlib axes: the best objective so far over the evaluations, and each single one.

    Args:
        objectives: name of a search to its objectives in order; None where one was not a number.
        meaning: label of the vertical axis.
        axes: of matplotlib.
    """
    for (name, values), colour in zip(objectives.items(), cycle((BLUE, RED, GREY))):
        single = [math.nan if one is None else one for one in values]
        best = list(accumulate((-math.inf if math.isnan(one) else one for one in single), max))
        at = range(1, len(single) + 1)
        axes.plot(at, single, ".", color=colour, alpha=0.35)
        axes.plot(at, [math.nan if math.isinf(one) else one for one in best], color=colour, label=name)
    axes.set(xlabel="evaluations", ylabel=meaning)
    axes.grid(True, axis="y")
    axes.legend()


def _only_axis(answer: SweepSummary) -> Sequence[AxisRow]:
    """The values of the only axis of a sweep; none where there are more, or too many values."""
    rows = [row for row in answer.axes if not isinstance(row.value, (list, tuple))] or answer.axes
    return rows if len({row.axis for row in rows}) == 1 and len(rows) <= MOST_POINTS else ()


def _cells(axes: Any, answer: SweepSummary, cells: SweepMap) -> None:
    """The map of a sweep."""
    first, second = cells.axes
    seen, correct, margin = cells.configurations, cells.correct, cells.margin
    extent = (-0.5, len(first.values) - 0.5, -0.5, len(second.values) - 0.5)
    labels = axis_title(first.axis, first.unit), axis_title(second.axis, second.unit)
    if max(map(max, seen)) > 1:
        pairs = [zip(*rows, strict=True) for rows in zip(correct, seen, strict=True)]
        values = [[right / count if count else math.nan for right, count in row] for row in pairs]
        heat(axes, values, extent, ACCURACY, *labels)
    else:
        values = [[math.nan if one is None else one for one in row] for row in margin]
        heat(axes, values, extent, MARGIN, *labels)
    axes.set_xticks(*_ticks(first.values), rotation=45 if _long(first.values) else 0)
    axes.set_yticks(*_ticks(second.values))
    more = len(cells.over)
    over = f", over {more} more {'axes' if more > 1 else 'axis'}" if more else ""
    axes.set_title(f"{_who(answer)}{over}")


def _along(axes: Any, answer: SweepSummary, rows: Sequence[AxisRow]) -> None:
    """The accuracy with its interval over one axis."""
    at, accuracy = range(len(rows)), [row.accuracy for row in rows]
    low, high = ([row.interval[end] for row in rows if row.interval] for end in (0, 1))
    axes.vlines(at, low, high, color=BLUE, alpha=0.35, linewidth=5, label="95 % interval")
    axes.plot(at, accuracy, "o", color=BLUE, label="accuracy")
    axes.set_xticks(*_ticks([row.value for row in rows]), rotation=45 if _long([r.value for r in rows]) else 0)
    axes.set(xlabel=axis_title(rows[0].axis, rows[0].unit), ylabel="accuracy", ylim=(-0.03, 1.03))
    axes.margins(x=0.08)
    axes.set_title(_who(answer))
    axes.grid(True, axis="y")
    axes.figure.legend(loc="outside lower center", ncols=2)


# ---- parts ----------------------------------------------------------------------------------------------------------

MARGIN, ACCURACY = "margin [logits]; above 0: wrong", "accuracy"
"""What the colours of a map may mean: red is wrong in both."""

MOST_POINTS, MOST_TICKS = 400, 16
"""Values of an axis that are drawn, and that are written."""


def heat(
    axes: Any, values: Sequence[Sequence[float]], extent: tuple[float, ...], meaning: str, across: str, up: str
) -> None:
    """Draw values as colours, rows from the lowest, with what they mean and the names of both axes."""
    finite = [abs(value) for row in values for value in row if math.isfinite(value)]
    if meaning == ACCURACY:
        colours: dict[str, str | float] = {"cmap": "RdBu", "vmin": 0.0, "vmax": 1.0}
    else:
        largest = max([*finite, 1e-6])
        colours = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}
    shown = axes.imshow(values, origin="lower", extent=extent, aspect="auto", **colours)
    axes.set(xlabel=across, ylabel=up)
    axes.figure.colorbar(shown, ax=axes, label=meaning)


def axis_title(name: str, unit: str) -> str:
    """Return what an axis is called: ``pose.yaw [degrees]``."""
    return f"{name} [{unit}]" if unit not in ("", "name") else name


def _ticks(values: Sequence[Any]) -> tuple[list[int], list[str]]:
    """Places and names of the values of an axis; of many, of some."""
    every = -(-len(values) // MOST_TICKS)
    places = list(range(0, len(values), every))
    return places, [_written(values[place]) for place in places]


def _written(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return " to ".join(f"{end:.3g}" for end in value)
    return short_name(value) if isinstance(value, str) else f"{value:.4g}"


def _who(answer: SweepSummary) -> str:
    """Objects and models of a sweep, files without their folders."""
    return ", ".join(short_name(name) for name in (*split_names(answer.object), *split_names(answer.model)))


def _long(values: Sequence[Any]) -> bool:
    return sum(len(text) + 1 for text in _ticks(values)[1]) > 50


def _map_size(cells: SweepMap) -> tuple[float, float]:
    """Width and height in inches, with room for the names of the values, those below aslant where they are long."""
    (wide, below), (high, beside) = (
        (min(len(axis.values), MOST_TICKS), max(map(len, _ticks(axis.values)[1]))) for axis in cells.axes
    )
    aslant = below if _long(cells.axes[0].values) else 0
    return 3.2 + 0.34 * wide + 0.09 * max(beside - 8, aslant - 8, 0), 1.8 + 0.3 * high + 0.065 * max(aslant - 8, 0)


def figure_of(draw: Callable[[Any], object], size: tuple[float, float]) -> Figures:
    """Return what is drawn on the axes of a new figure of a size in inches."""
    return drawn(lambda figure: draw(figure.subplots()), size)
