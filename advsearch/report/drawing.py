"""How figures are drawn: matplotlib with one style, into the bytes of files."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

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
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def drawn(
    draw: Callable[[Figure], object],
    size: tuple[float, float],
    kinds: Sequence[str] = ("png", "svg"),
    style: dict[Any, Any] | None = None,
) -> Figures:
    """Return a figure as files.

    Args:
        draw: draws on it.
        size: width and height in inches.
        kinds: suffixes of the files.
        style: settings of matplotlib that differ from `STYLE`.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    files = {}
    with mpl.rc_context({**STYLE, **(style or {})}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # a browser has the letter
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        for kind in kinds:
            stream = io.BytesIO()
            figure.savefig(stream, format=kind, dpi=150, metadata={"Date": None} if kind == "svg" else None)
            files[kind] = stream.getvalue()
    return files
