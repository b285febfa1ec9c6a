"""Figures of studies: robust accuracy against epsilon, the worst case beside the average, a map of the margin."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

from advsearch.report.diagrams import STYLE

BLUE, RED, GREY = "#1d5fd0", "#b3261e", "#5c606a"

Figures = dict[str, bytes]
"""A suffix, png or svg, to the content of a file."""


def curve_figure(answer: Mapping[str, Any]) -> Figures:
    """Draw the robust accuracy with its interval over epsilon; nothing where there is one epsilon only."""
    points = [one for one in answer["curve"] if one["epsilon"] is not None and one["accuracy"] is not None]
    if len(points) < 2:
        return {}

    def draw(axes: Any) -> None:
        at, accuracy = [one["epsilon"] for one in points], [one["accuracy"] for one in points]
        low, high = ([one["interval"][end] for one in points] for end in (0, 1))
        axes.fill_between(at, low, high, color=BLUE, alpha=0.15, linewidth=0, label="95 % interval")
        axes.plot(at, accuracy, color=BLUE, marker="o", label="robust accuracy")
        axes.set(xlabel="epsilon", ylabel="robust accuracy", ylim=(-0.02, 1.02))
        axes.set_title(f"{', '.join(answer['controls'])}: {points[0]['objects']} objects, {answer['model']}")
        axes.grid(True)
        axes.legend()

    return _figure(draw, (5.6, 3.6))


def gap_figure(answer: Mapping[str, Any]) -> Figures:
    """Draw, for each object and control, the accuracy on average and of the worst configuration, joined by a line."""
    rows = answer["table"]
    if not rows:
        return {}

    def draw(axes: Any) -> None:
        for place, row in enumerate(reversed(rows)):
            mean, worst = row["average"]["accuracy"], _worst(row)
            axes.plot(row["average"]["interval"], [place, place], color=BLUE, alpha=0.35, linewidth=5)
            axes.plot([worst, mean], [place, place], color=GREY, linewidth=1)
            first = place == 0
            axes.plot(
                mean, place, "o", color=BLUE, ms=4, zorder=4, label="average, with 95 % interval" if first else None
            )
            worst_label = (
                "worst found, verified" if first else None
            )  # an outline: where the two are equal, both are seen
            axes.plot(worst, place, "D", color=RED, mfc="none", mew=1.5, ms=9, zorder=3, label=worst_label)
        axes.set_yticks(range(len(rows)), [f"{row['object']}, {row['control']}" for row in reversed(rows)])
        axes.set(xlabel="accuracy", xlim=(-0.03, 1.03))
        axes.set_title(f"Average and worst case: {answer['model']}")
        axes.grid(True, axis="x")
        axes.figure.legend(loc="outside lower center", ncols=2)

    return _figure(draw, (6.4, 1.6 + 0.36 * len(rows)))


def map_figure(
    margins: Sequence[Sequence[float]], axes_of: Sequence[Mapping[str, Any]], box: Sequence[Mapping[str, Any]]
) -> Figures:
    """Draw a map of the margin over two parameters, with the line at which the verdict changes, and the box.

    Args:
        margins: rows of the second parameter, from its lowest value.
        axes_of: name, unit, low and high of the first and the second parameter.
        box: low, high and centre of both.
    """

    def draw(axes: Any) -> None:
        first, second = axes_of
        largest = max(max(abs(value) for row in margins for value in row), 1e-6)
        extent = (first["low"], first["high"], second["low"], second["high"])
        shown = axes.imshow(
            margins, origin="lower", extent=extent, aspect="auto", cmap="RdBu_r", vmin=-largest, vmax=largest
        )
        if min(map(min, margins)) < 0.0 < max(map(max, margins)):
            axes.contour(margins, levels=[0.0], extent=extent, colors="black", linewidths=1.0)
        across, up = box
        corners_x = [across["low"], across["high"], across["high"], across["low"], across["low"]]
        corners_y = [up["low"], up["low"], up["high"], up["high"], up["low"]]
        axes.plot(corners_x, corners_y, color="black", linestyle="--", label="region")
        axes.plot(across["centre"], up["centre"], "k+", label="centre")
        for set_label, one in ((axes.set_xlabel, first), (axes.set_ylabel, second)):
            set_label(f"{one['name']} [{one['unit']}]" if one["unit"] else one["name"])
        axes.figure.colorbar(shown, ax=axes, label="margin [logits]; above 0: wrong")
        axes.legend(loc="upper right", frameon=True)

    return _figure(draw, (6.0, 4.6))


def _worst(row: Mapping[str, Any]) -> float:
    """Accuracy of the worst configuration: what is left of its trials."""
    worst = row["worst"]
    return 0.0 if row["ending"] == "already wrong" else 1.0 - float(worst["rate"]) if worst else 1.0


def _figure(draw: Any, size: tuple[float, float]) -> Figures:
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        draw(figure.subplots())
        files = {}
        for suffix in ("png", "svg"):
            stream = io.BytesIO()
            figure.savefig(stream, format=suffix, dpi=150, metadata={"Date": None} if suffix == "svg" else None)
            files[suffix] = stream.getvalue()
    return files
