"""The charts of the report, inline in the page; colours come from its style sheet, so that they follow its scheme."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from advsearch.report.drawing import drawn
from advsearch.report.markup import Html, element

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEIGHT = 300
WIDE, NARROW = 720, 350
"""Height and widths of a chart in CSS pixels: for a screen, and for a phone, which would shrink the letters of the wide
one until nobody can read them. The style sheet shows one of them.
"""

MOST_POINTS = 400
"""Points of a curve that are drawn; of more, evenly spread ones."""

COLORS = {"search": "#010101", "baseline": "#020202", "soft": "#030303", "line": "#040404"}
"""Variables of the style sheet, and what stands for them while matplotlib draws."""
STYLE: dict[Any, Any] = {
    "font.size": 13.0,
    "legend.fontsize": 13.0,
    "legend.labelcolor": "linecolor",
    "legend.borderpad": 0.0,
    "legend.handlelength": 1.6,
    "axes.edgecolor": COLORS["line"],
    "axes.labelcolor": COLORS["soft"],
    "axes.spines.left": False,
    "axes.axisbelow": True,
    "axes.grid.axis": "y",
    "axes.grid": True,
    "grid.color": COLORS["line"],
    "text.color": COLORS["soft"],
    "xtick.color": COLORS["line"],
    "ytick.color": COLORS["line"],
    "xtick.labelcolor": COLORS["soft"],
    "ytick.labelcolor": COLORS["soft"],
    "xtick.major.size": 0.0,
    "ytick.major.size": 0.0,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "path.simplify": False,
}


@dataclass(frozen=True)
class Curve:
    """The objective of one policy, evaluation by evaluation.

    Attributes:
        name: what the legend calls it.
        kind: `search` or `baseline`; also the variable of the style sheet that has its colour.
        values: objective of each evaluation in order; None where it was not a number.
    """

    name: str
    kind: str
    values: Sequence[float | None]


def objective_chart(curves: Sequence[Curve], objective: str, zero_means: str = "", width: int = WIDE) -> Html:
    """Return the best objective so far (lines) and each single one (dots) over the number of evaluations.

    Args:
        curves: each with a finite value.
        objective: label of the vertical axis.
        zero_means: what stands at the zero line; no line when it is empty.
        width: in CSS pixels.
    """
    values = [np.array(curve.values, dtype=float) for curve in curves]
    best = [np.fmax.accumulate(one) for one in values]
    ends = [(one[np.isfinite(one)][0], one[-1]) for one in best]
    told = "; ".join(f"{curve.name}: from {a:.3g} to {b:.3g}" for curve, (a, b) in zip(curves, ends, strict=True))

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for curve, each, so_far in zip(curves, values, best, strict=True):
            shown = np.unique(np.linspace(0, len(each) - 1, min(len(each), MOST_POINTS)).round().astype(int))
            color = COLORS[curve.kind]
            # a dot is a line without a length: all of them are one path, and the page stays small
            at, dots = (np.stack([one, one, one * np.nan], 1).ravel() for one in (shown + 1.0, each[shown]))
            axes.plot(at, dots, solid_capstyle="round", linewidth=4, alpha=0.35, color=color)
            dashes = {"search": "-", "baseline": (0.0, (4.0, 1.5))}[curve.kind]
            axes.plot(shown + 1, so_far[shown], linestyle=dashes, linewidth=2, label=curve.name, color=color)
        if zero_means:
            axes.axhline(0.0, color=COLORS["soft"], linewidth=1, linestyle=(0.0, (5.0, 4.0)))
            axes.annotate(zero_means, (1.0, 0.0), (-4, 4), axes.get_yaxis_transform(), "offset points", ha="right")
        axes.set(xlabel="evaluations", ylabel=objective, xlim=(1, max(2, *map(len, values))))
        axes.locator_params("x", integer=True)
        figure.legend(loc="outside upper left", ncols=2)

    (file,) = drawn(draw, (width / 72, HEIGHT / 72), ("svg",), STYLE).values()
    return element(
        "svg",
        element("title", f"{objective} over evaluations. {told}"),
        _inline(file.decode("utf-8")),
        viewBox=f"0 0 {width} {HEIGHT}",
        class_="chart wide" if width == WIDE else "chart narrow",
        role="img",
        aria_label=f"{objective} over evaluations. {told}",
    )


def _inline(file: str) -> Html:
    """Return what a file in SVG draws: without its head, hundredths of a pixel, names and frames to cut at.

    Names would be there twice in a page of two charts. All that is drawn lies in the frame.
    """
    shapes = file[file.index("<g ") : file.rindex("</svg>")]
    needless = r'<defs>.*?</defs>|<!--.*?-->| (?:id|clip-path)="[^"]*"|(?<=\d\.\d)\d+(?=[^<>]*>)'
    shapes = re.sub(needless, "", shapes, flags=re.DOTALL)
    for name, color in COLORS.items():
        shapes = shapes.replace(color, f"var(--{name})")
    return Html(shapes)
