"""The figure of a sweep: a map over two axes, or the accuracy over the only one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from advsearch.questions.sweep.summary import AxisRow, SweepMap, SweepSummary
from advsearch.report.figures import ACCURACY, BLUE, MARGIN, MOST_POINTS, Figures, axis_title, figure_of, heat
from advsearch.report.wording import short_name
from advsearch.settings import split_names

MOST_TICKS = 16  # values of an axis that are written


def figure_size(summary: SweepSummary) -> tuple[float, float] | None:
    """Return width and height of a sweep's figure in inches, with room for the names of a map's values, those below
    aslant where they are long; None where there is neither a map nor one axis."""
    if not summary.cells:
        return (5.6, 3.6) if _only_axis(summary) else None
    (wide, below), (high, beside) = (
        (min(len(axis.values), MOST_TICKS), max(map(len, _ticks(axis.values)[1]))) for axis in summary.cells.axes
    )
    aslant = below if _long(summary.cells.axes[0].values) else 0
    return 3.2 + 0.34 * wide + 0.09 * max(beside - 8, aslant - 8, 0), 1.8 + 0.3 * high + 0.065 * max(aslant - 8, 0)


def sweep_figure(summary: SweepSummary) -> Figures:
    """Draw a sweep: a map over two axes, or the accuracy over the only one; nothing where there is none.

    A cell shows the accuracy there; where no cell has more than one configuration, the margin.
    """
    size = figure_size(summary)
    return {} if size is None else figure_of(lambda axes: sweep_axes(summary, axes), size)


def sweep_axes(summary: SweepSummary, axes: Any) -> None:
    """Draw a sweep on matplotlib axes, as `sweep_figure` does; nothing where there is neither a map nor one axis."""
    if summary.cells:
        _cells(axes, summary, summary.cells)
    elif _only_axis(summary):
        _along(axes, summary, _only_axis(summary))


def _only_axis(summary: SweepSummary) -> Sequence[AxisRow]:
    """The values of the only axis of a sweep; none where there are more, or too many values."""
    rows = [row for row in summary.axes if not isinstance(row.value, (list, tuple))] or summary.axes
    return rows if len({row.axis for row in rows}) == 1 and len(rows) <= MOST_POINTS else ()


def _cells(axes: Any, summary: SweepSummary, cells: SweepMap) -> None:
    first, second = cells.axes
    seen, correct, margin = cells.configurations, cells.correct, cells.margin
    extent = (-0.5, len(first.values) - 0.5, -0.5, len(second.values) - 0.5)
    labels = axis_title(first.axis, first.unit), axis_title(second.axis, second.unit)
    several = max(map(max, seen)) > 1
    counts, values = np.array(seen, dtype=float), np.array(margin, dtype=float)
    if several:
        values = np.divide(correct, counts, out=np.full(counts.shape, np.nan), where=counts > 0)
    heat(axes, values.tolist(), extent, ACCURACY if several else MARGIN, *labels)
    axes.set_xticks(*_ticks(first.values), rotation=45 if _long(first.values) else 0)
    axes.set_yticks(*_ticks(second.values))
    more = len(cells.over)
    over = f", over {more} more {'axes' if more > 1 else 'axis'}" if more else ""
    axes.set_title(f"{_who(summary)}{over}")


def _along(axes: Any, summary: SweepSummary, rows: Sequence[AxisRow]) -> None:
    at, accuracy = range(len(rows)), [row.accuracy for row in rows]
    low, high = ([row.interval[end] for row in rows if row.interval] for end in (0, 1))
    axes.vlines(at, low, high, color=BLUE, alpha=0.35, linewidth=5, label="95 % interval")
    axes.plot(at, accuracy, "o", color=BLUE, label="accuracy")
    axes.set_xticks(*_ticks([row.value for row in rows]), rotation=45 if _long([r.value for r in rows]) else 0)
    axes.set(xlabel=axis_title(rows[0].axis, rows[0].unit), ylabel="accuracy", ylim=(-0.03, 1.03))
    axes.margins(x=0.08)
    axes.set_title(_who(summary))
    axes.grid(True, axis="y")
    axes.figure.legend(loc="outside lower center", ncols=2)


def _ticks(values: Sequence[Any]) -> tuple[list[int], list[str]]:
    def name(value: Any) -> str:
        if isinstance(value, (list, tuple)):
            return " to ".join(f"{end:.3g}" for end in value)
        return short_name(value) if isinstance(value, str) else f"{value:.4g}"

    places = list(range(0, len(values), -(-len(values) // MOST_TICKS)))
    return places, [name(values[place]) for place in places]


def _who(summary: SweepSummary) -> str:
    return ", ".join(short_name(name) for name in (*split_names(summary.object), *split_names(summary.model)))


def _long(values: Sequence[Any]) -> bool:
    return sum(len(text) + 1 for text in _ticks(values)[1]) > 50
