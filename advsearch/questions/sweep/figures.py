"""Figures of a sweep: a map over two axes or the only one, and the object's surface in colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.questions.sweep.summary import AxisRow, SweepMap, SweepSummary
from advsearch.report.figures import ACCURACY, BLUE, MARGIN, MOST_POINTS, Figures, axis_title, drawn, figure_of, heat
from advsearch.report.wording import short_name
from advsearch.settings import split_names

MOST_TICKS = 16  # values of an axis that are written


def figure_size(summary: SweepSummary) -> tuple[float, float] | None:
    """Return width and height of a sweep's figure in inches; None where there is neither a map nor one axis."""
    return _map_size(summary.cells) if summary.cells else (5.6, 3.6) if _only_axis(summary) else None


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
    if max(map(max, seen)) > 1:
        pairs = [zip(*rows, strict=True) for rows in zip(correct, seen, strict=True)]
        values = [[right / count if count else math.nan for right, count in row] for row in pairs]
    else:
        values = [[math.nan if mean is None else mean for mean in row] for row in margin]
    heat(axes, values, extent, ACCURACY if max(map(max, seen)) > 1 else MARGIN, *labels)
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
    """Places and names of the values of an axis; of many, of some."""

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


def _map_size(cells: SweepMap) -> tuple[float, float]:
    """Width and height in inches, with room for the names of the values, those below aslant where they are long."""
    (wide, below), (high, beside) = (
        (min(len(axis.values), MOST_TICKS), max(map(len, _ticks(axis.values)[1]))) for axis in cells.axes
    )
    aslant = below if _long(cells.axes[0].values) else 0
    return 3.2 + 0.34 * wide + 0.09 * max(beside - 8, aslant - 8, 0), 1.8 + 0.3 * high + 0.065 * max(aslant - 8, 0)


Doubles = npt.NDArray[np.float64]

MOST_PANELS = 12  # objects times models that are drawn; the file of the counts has all
LIGHT = (0.36, 0.48, 0.80)  # the direction that the object is shaded from, world space; of length 1

COLOURS = "PuOr_r"
"""ColorBrewer's purple to orange, which people see apart who see no red or no green: orange is wrong more often."""

UNTOLD, UNCOMPARED, NOTHING = (0.78, 0.78, 0.78), (0.45, 0.45, 0.45), (1.0, 1.0, 1.0)
"""Grey where a part is not told from chance, darker where too few pictures show it or do not; white beside charts."""

ROWS = 2  # rows of the views of an object


@dataclass(frozen=True, eq=False)
class MapView:
    """What a camera sees of an object: the number of the cell in each pixel (H, W), row by row of the map, -1 beside
    the object, and unit normals (H, W, 3) in world space. The title says where it stands."""

    title: str
    cells: npt.NDArray[np.int64]
    normal: npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SurfacePanel:
    """What is drawn of one object and one model, by their names; maps are (n, n) with row 0 at v = 1: where there is a
    surface, where enough pictures show it and do not, and by how much predictions are wrong more often where a cell is
    seen, in [-1, 1], NaN where that is not told from chance."""

    object: str
    model: str
    surface: npt.NDArray[np.bool_]
    compared: npt.NDArray[np.bool_]
    difference: Doubles
    views: tuple[MapView, ...]


def surface_figure(panels: Sequence[SurfacePanel]) -> Figures:
    """Draw a row for each of the first `MOST_PANELS` panels, at one scale: the map, and the object in its colours from
    some sides."""
    panels = panels[:MOST_PANELS]
    largest = max((float(np.nanmax(np.abs(one.difference), initial=0.0)) for one in panels), default=0.0)
    end = max(ceil(10.0 * largest - 1e-9) / 10.0, 0.1)

    def draw(figure: Any) -> None:
        # late: matplotlib takes long to import
        import matplotlib as mpl

        scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(-end, end), mpl.colormaps[COLOURS])
        axes = figure.subplots(len(panels), 2, squeeze=False, width_ratios=(1.0, 1.55))
        for (flat, solid), panel in zip(axes, panels, strict=True):
            colours = _coloured(panel, scale)
            flat.imshow(colours, extent=(0, 1, 0, 1), interpolation="nearest")
            flat.set(xlabel="u", ylabel="v")
            flat.set_title(f"{short_name(panel.object)}, {short_name(panel.model)}")
            solid.axis("off")
            across = ceil(len(panel.views) / ROWS)
            solid.imshow(_mosaic(panel.views, colours, across))
            for number, view in enumerate(panel.views):
                height, width = view.cells.shape
                row, column = divmod(number, across)
                solid.text((column + 0.5) * width, row * height + 4, view.title, ha="center", va="top", fontsize=7)

        def percent(value: float, _: object) -> str:
            return f"{100.0 * value:+.3g} %" if value else "0 %"

        bar = figure.colorbar(scale, ax=axes, shrink=0.8 if len(panels) == 1 else 0.4, format=percent)
        bar.set_label("share of wrong predictions where it is seen,\nless that where it is not")
        marks = [
            mpl.patches.Patch(facecolor=colour, label=text)
            for colour, text in ((UNTOLD, "not told from chance"), (UNCOMPARED, "too few pictures with or without it"))
        ]
        figure.legend(handles=marks, loc="outside lower center", ncols=2)

    return drawn(draw, (10.0, 0.5 + 3.6 * len(panels)), kinds=("png",))


def _coloured(panel: SurfacePanel, scale: Any) -> Doubles:
    colours = np.where(panel.compared[..., None], UNTOLD, UNCOMPARED)
    told = np.isfinite(panel.difference)
    colours[told] = scale.to_rgba(panel.difference[told])[:, :3]
    return np.where(panel.surface[..., None], colours, NOTHING)


def _mosaic(views: Sequence[MapView], colours: Doubles, across: int) -> Doubles:
    """The object in the colours (n, n, 3) of its cells, shaded a little, side after side; white beside it."""
    tiles = []
    for view in views:
        shade = 0.7 + 0.3 * np.clip(view.normal @ np.array(LIGHT), 0.0, 1.0)
        worn = colours.reshape(-1, 3)[np.maximum(view.cells, 0)] * shade[..., None]
        tiles.append(np.where(view.cells[..., None] >= 0, worn, 1.0))
    tiles += [np.ones_like(tiles[0])] * (-len(tiles) % across)
    rows = [np.concatenate(tiles[begin : begin + across], axis=1) for begin in range(0, len(tiles), across)]
    return np.concatenate(rows)
