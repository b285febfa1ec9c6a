"""Figures: how they are drawn, those of studies, and of a surface. matplotlib with one style, into the bytes of files.

Of studies: robust accuracy against epsilon, worst case and average, maps of the margin and of a sweep. Of
`sweep --surface`: which parts of an object go with wrong predictions, on its map and from some sides.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Figures = dict[str, bytes]  # A suffix, png or svg, to the content of a file

BLUE, RED, GREY = "#1d5fd0", "#b3261e", "#5c606a"
STYLE: dict[Any, Any] = {
    "font.family": ["DejaVu Sans"], "font.size": 9.0, "legend.frameon": False, "legend.fontsize": 8.0,
    "axes.axisbelow": True, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": GREY,
    "axes.labelcolor": "#1c1d20", "axes.titlelocation": "left", "axes.titlesize": 10.0, "axes.titleweight": "bold",
    "grid.color": "#dfe0e3", "grid.linewidth": 0.7, "svg.hashsalt": "advsearch", "svg.fonttype": "none",
    "text.parse_math": False,  # names come from users: a dollar sign in one is no formula
}  # fmt: skip


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
MARKS = "os^DvP"  # What tells series apart


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


def search_axes(
    objectives: Mapping[str, Sequence[float | None]], meaning: str, axes: Any, zero_means: str = ""
) -> None:
    """Draw searches on matplotlib axes, by their names: the best objective so far over the evaluations, and each single
    one, None where it was not a number. The meaning is the label of the vertical axis, and `zero_means` stands at the
    zero line, which is not drawn where that is empty."""
    styles = cycle(((BLUE, "-"), (RED, (0.0, (4.0, 1.5))), (GREY, "-")))
    for (name, values), (colour, dashes) in zip(objectives.items(), styles, strict=False):
        each = np.array(values, dtype=float)  # None is NaN
        best = np.fmax.accumulate(each) if len(each) else each
        shown = np.unique(np.linspace(0, len(each) - 1, min(len(each), MOST_POINTS)).round().astype(int))
        # a dot is a line without a length: all of them are one path, and a page stays small
        at, dots = (np.stack([ends, ends, ends * np.nan], 1).ravel() for ends in (shown + 1.0, each[shown]))
        axes.plot(at, dots, solid_capstyle="round", linewidth=4, alpha=0.35, color=colour)
        axes.plot(shown + 1, best[shown], linestyle=dashes, linewidth=2, color=colour, label=name)
    if zero_means:
        axes.axhline(0.0, color=GREY, linewidth=1, linestyle=(0.0, (5.0, 4.0)))
        axes.annotate(zero_means, (1.0, 0.0), (-4, 4), axes.get_yaxis_transform(), "offset points", ha="right")
    axes.set(xlabel="evaluations", ylabel=meaning, xlim=(1, max(2, *map(len, objectives.values()))))
    axes.locator_params("x", integer=True)
    axes.grid(True, axis="y")
    axes.legend()


# ---- parts ----------------------------------------------------------------------------------------------------------

MARGIN, ACCURACY = "margin [logits]; below 0: wrong", "accuracy"
"""What the colours of a map may mean: red is wrong in both."""
MOST_POINTS = 400  # Values of an axis that are drawn


def heat(
    axes: Any, values: Sequence[Sequence[float]], extent: tuple[float, ...], meaning: str, across: str, up: str
) -> None:
    """Draw values as colours, rows from the lowest, with what they mean and the names of both axes."""
    finite = [abs(value) for row in values for value in row if math.isfinite(value)]
    if meaning == ACCURACY:
        colours: dict[str, str | float] = {"cmap": "RdBu", "vmin": 0.0, "vmax": 1.0}
    else:
        largest = max([*finite, 1e-6])
        colours = {"cmap": "RdBu", "vmin": -largest, "vmax": largest}
    shown = axes.imshow(values, origin="lower", extent=extent, aspect="auto", **colours)
    axes.set(xlabel=across, ylabel=up)
    axes.figure.colorbar(shown, ax=axes, label=meaning)


def axis_title(name: str, unit: str) -> str:
    """Return what an axis is called: ``pose.yaw [degrees]``."""
    return f"{name} [{unit}]" if unit not in ("", "name") else name


def figure_of(draw: Callable[[Any], object], size: tuple[float, float]) -> Figures:
    """Return what is drawn on the axes of a new figure of a size in inches."""
    return drawn(lambda figure: draw(figure.subplots()), size)
