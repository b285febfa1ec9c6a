"""Figures: how they are drawn, those of studies, and of a surface. matplotlib with one style, into the bytes of files.

Of studies: robust accuracy against epsilon, worst case and average, maps of the margin and of a sweep. Of
`sweep --surface`: which parts of an object go with wrong answers, on its map and from some sides.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from advsearch.report.wording import short_name
from advsearch.runs.results.sweep import AxisRow, SweepMap, SweepSummary
from advsearch.settings import split_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Figures = dict[str, bytes]
"""A suffix, png or svg, to the content of a file."""

BLUE, RED, GREY = "#1d5fd0", "#b3261e", "#5c606a"
STYLE: dict[Any, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.labelcolor": "#1c1d20",
    "axes.titlelocation": "left",
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "grid.color": "#dfe0e3",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "svg.hashsalt": "advsearch",
    "svg.fonttype": "none",
    "text.parse_math": False,
}
"""Names come from users: a dollar sign in one is no formula."""


def new_axes() -> Any:
    """Return matplotlib axes of a new figure of the calling program, which shows it as it shows others."""
    # late: matplotlib takes long to import
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def drawn(
    draw: Callable[[Figure], object],
    size: tuple[float, float],
    kinds: Sequence[str] = ("png", "svg"),
    style: dict[Any, Any] | None = None,
) -> Figures:
    """Return a figure of a size in inches (width, height) as files of some kinds; the style is what differs from
    `STYLE`."""
    # late: matplotlib takes long to import
    import matplotlib.figure

    files = {}
    with matplotlib.rc_context({**STYLE, **(style or {})}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # a browser has the letter
        figure = matplotlib.figure.Figure(figsize=size, layout="constrained")
        draw(figure)
        for kind in kinds:
            stream = io.BytesIO()
            figure.savefig(stream, format=kind, dpi=150, metadata={"Date": None} if kind == "svg" else None)
            files[kind] = stream.getvalue()
    return files


SERIES = (BLUE, RED, "#1f7a45", "#b4540a", "#6b3fa0", GREY)
MARKS = "os^DvP"
"""What tells series apart."""


def draw_shares(
    axes: Any,
    rows: Mapping[str, Sequence[tuple[float, Sequence[float]] | None]],
    series: Sequence[str],
    colours: Sequence[str] = SERIES,
) -> None:
    """Draw a row for each name, in which a dot with its interval is the share of each of the series; None is none."""
    for number, label in enumerate(series):
        colour, mark = colours[number % len(colours)], MARKS[number % len(MARKS)]
        for row, shares in enumerate(rows.values()):
            place = row + (number - (len(series) - 1) / 2) * min(0.22, 0.8 / len(series))
            if (drawn := shares[number]) is not None:
                axes.plot(drawn[1], [place] * 2, color=colour, alpha=0.45, linewidth=3)
                axes.plot(drawn[0], place, mark, color=colour, ms=5, label=label)
                label = "_"  # a series has one line in the legend
    axes.set_yticks(range(len(rows)), list(rows))
    axes.set(xlim=(-0.03, 1.03), ylim=(len(rows) - 0.4, -0.6))
    axes.grid(True, axis="x")


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


def search_axes(
    objectives: Mapping[str, Sequence[float | None]], meaning: str, axes: Any, zero_means: str = ""
) -> None:
    """Draw searches on matplotlib axes: the best objective so far over the evaluations, and each single one.

    Args:
        objectives: name of a search to its objectives in order; None where one was not a number.
        meaning: label of the vertical axis.
        axes: of matplotlib.
        zero_means: what stands at the zero line, which is not drawn where it is empty.
    """
    styles = cycle(((BLUE, "-"), (RED, (0.0, (4.0, 1.5))), (GREY, "-")))
    for (name, values), (colour, dashes) in zip(objectives.items(), styles, strict=False):
        each = np.array([math.nan if one is None else one for one in values], dtype=float)
        best = np.fmax.accumulate(each) if len(each) else each
        shown = np.unique(np.linspace(0, len(each) - 1, min(len(each), MOST_POINTS)).round().astype(int))
        # a dot is a line without a length: all of them are one path, and a page stays small
        at, dots = (np.stack([one, one, one * np.nan], 1).ravel() for one in (shown + 1.0, each[shown]))
        axes.plot(at, dots, solid_capstyle="round", linewidth=4, alpha=0.35, color=colour)
        axes.plot(shown + 1, best[shown], linestyle=dashes, linewidth=2, color=colour, label=name)
    if zero_means:
        axes.axhline(0.0, color=GREY, linewidth=1, linestyle=(0.0, (5.0, 4.0)))
        axes.annotate(zero_means, (1.0, 0.0), (-4, 4), axes.get_yaxis_transform(), "offset points", ha="right")
    axes.set(xlabel="evaluations", ylabel=meaning, xlim=(1, max(2, *map(len, objectives.values()))))
    axes.locator_params("x", integer=True)
    axes.grid(True, axis="y")
    axes.legend()


def _only_axis(answer: SweepSummary) -> Sequence[AxisRow]:
    """The values of the only axis of a sweep; none where there are more, or too many values."""
    rows = [row for row in answer.axes if not isinstance(row.value, (list, tuple))] or answer.axes
    return rows if len({row.axis for row in rows}) == 1 and len(rows) <= MOST_POINTS else ()


def _cells(axes: Any, answer: SweepSummary, cells: SweepMap) -> None:
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


Doubles = npt.NDArray[np.float64]

MOST_PANELS = 12
"""Objects times models that are drawn; the file of the counts has all."""

LIGHT = (0.36, 0.48, 0.80)
"""The direction that the object is shaded from, world space; of length 1."""

COLOURS = "PuOr_r"
"""ColorBrewer's purple to orange, which people see apart who see no red or no green: orange is wrong more often."""

UNTOLD, UNCOMPARED, NOTHING = (0.78, 0.78, 0.78), (0.45, 0.45, 0.45), (1.0, 1.0, 1.0)
"""Grey where a part is not told from chance, darker where too few pictures show it or do not; white beside charts."""

ROWS = 2
"""Rows of the views of an object."""


@dataclass(frozen=True, eq=False)
class MapView:
    """What a camera sees of an object: the number of the cell in each pixel (H, W), row by row of the map, -1 beside
    the object, and unit normals (H, W, 3) in world space. The title says where it stands."""

    title: str
    cells: npt.NDArray[np.int64]
    normal: npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SurfacePanel:
    """What is drawn of one object and one model; maps are (n, n) with row 0 at v = 1.

    Attributes:
        object: its name.
        model: likewise.
        surface: where there is a surface.
        compared: where enough pictures show it, and do not.
        difference: by how much answers are wrong more often where a cell is seen, in [-1, 1]; NaN where that is not
            told from chance.
        views: of the object.
    """

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
        bar = figure.colorbar(scale, ax=axes, shrink=0.8 if len(panels) == 1 else 0.4, format=_percent)
        bar.set_label("share of wrong answers where it is seen,\nless that where it is not")
        marks = [
            mpl.patches.Patch(facecolor=colour, label=text)
            for colour, text in ((UNTOLD, "not told from chance"), (UNCOMPARED, "too few pictures with or without it"))
        ]
        figure.legend(handles=marks, loc="outside lower center", ncols=2)

    return drawn(draw, (10.0, 0.5 + 3.6 * len(panels)), kinds=("png",))


def _percent(value: float, _: object) -> str:
    return f"{100.0 * value:+.3g} %" if value else "0 %"


def _coloured(panel: SurfacePanel, scale: Any) -> Doubles:
    """The map in colours, (n, n, 3)."""
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
