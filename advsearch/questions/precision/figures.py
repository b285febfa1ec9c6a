"""Work-precision diagrams: error against processor time, both logarithmic."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from advsearch.questions.precision.answer import WARM_UP, PrecisionPoint, PrecisionResult
from advsearch.report.figures import BLUE, GREY, RED, Figures, drawn

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

COLORS = (BLUE, "#b4540a", "#1f7a45", "#7a3fa8", RED, "#4a7d8c", "#8a6d00", GREY, "#c2488f", "#3f5fd0", "#a06a50")
MARKERS = "osD^vP*X<>d"
PANEL = (5.6, 3.9)
"""Width and height of one diagram in inches."""
PERCENT = 100.0
MINUS = "\N{MINUS SIGN}"


def precision_figures(result: PrecisionResult) -> Figures:
    """Return work-precision diagrams as files: error against seconds, both logarithmic; none where nothing is known.

    Filled markers are known errors; open ones with an arrow are limits: the reference is no better than that. The
    dashed line falls as independent samples do.
    """
    panels: dict[str, list[PrecisionPoint]] = {}
    for point in result.points:
        title = f"gradient: {point.control}" if point.control else point.quantity
        if 0.0 < point.rms < math.inf:
            panels.setdefault(title, []).append(point)
    if not panels:
        return {}
    wide = min(2, len(panels))
    tall = math.ceil(len(panels) / wide)

    def draw(figure: Figure) -> None:
        for number, (title, points) in enumerate(panels.items(), start=1):
            axes = figure.add_subplot(tall, wide, number)
            axes.set_title(title)
            _draw_errors(axes, points, result)
        _explain(figure, result)

    return drawn(draw, (PANEL[0] * wide, PANEL[1] * tall + 0.8))


def _draw_errors(axes: Axes, points: Sequence[PrecisionPoint], result: PrecisionResult) -> None:
    for number, name in enumerate(dict.fromkeys(point.estimator for point in points)):
        line = sorted((point for point in points if point.estimator == name), key=lambda point: point.spp)
        _draw_line(axes, line, number, _labelled(line[0], result))
    axes.set_xscale("log")
    axes.set_yscale("log")
    _draw_theory(axes, points)
    _plain_axis(axes.xaxis)
    _plain_axis(axes.yaxis)
    goal, (low, high) = result.goal * PERCENT, axes.get_ylim()
    if low < goal < high:
        axes.axhline(goal, color="#1c1d20", linewidth=0.8, linestyle=":")
        where = ("axes fraction", "data")
        axes.annotate(f"{goal:g} %", (1.0, goal), xycoords=where, ha="right", va="bottom", fontsize=8)
    axes.set_xlabel("seconds of processor time")
    axes.set_ylabel("relative error, %")
    axes.grid(True, which="major")
    place: dict[str, Any] = {"bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2, "handlelength": 1.6}
    place |= {"title": "slope against samples", "title_fontsize": 8, "alignment": "left"}
    axes.legend(loc="upper left", **place)


def _draw_line(axes: Axes, line: Sequence[PrecisionPoint], number: int, label: str) -> None:
    color, marker = COLORS[number % len(COLORS)], MARKERS[number % len(MARKERS)]
    axes.plot([p.seconds for p in line], [PERCENT * p.rms for p in line], color=color, linewidth=1.0, alpha=0.55)
    for point in line:
        x, y = point.seconds, PERCENT * point.rms
        low, high = (PERCENT * end for end in point.interval or (math.nan, math.nan))
        if high < 4.0 * y:
            axes.plot([x, x], [low, high], color=color, linewidth=0.8, alpha=0.6)
        axes.plot([x], [y], marker=marker, markersize=5, color=color, markerfacecolor=color if point.known else "white")
        if not point.known:
            arrow = {"arrowstyle": "-|>", "color": color, "linewidth": 0.8, "shrinkA": 3}
            axes.annotate("", (x, y * 0.72), (x, y), arrowprops=arrow)
    axes.plot([], [], marker=marker, markersize=5, color=color, linewidth=1.0, label=label)


def _labelled(point: PrecisionPoint, result: PrecisionResult) -> str:
    """An estimator with the slope of its line against samples, and theory where it disagrees with that."""
    place = point.quantity, point.control, point.estimator
    for slope in result.slopes:
        if (slope.quantity, slope.control, slope.estimator) == place:
            doubt = f" (not {slope.theory:.2f})" if slope.agrees is False else ""
            return f"{point.estimator}  {slope.slope:.2f}{doubt}".replace(" -", f" {MINUS}")
    return point.estimator


def _draw_theory(axes: Axes, points: Sequence[PrecisionPoint]) -> None:
    """A dashed line of slope -1/2 under the points."""
    low, high = min(point.seconds for point in points), max(point.seconds for point in points)
    if high < 1.5 * low:
        return
    at = PERCENT * min(point.rms * math.sqrt(point.seconds) for point in points) * 0.8
    axes.plot([low, high], [at / math.sqrt(low), at / math.sqrt(high)], color=GREY, linewidth=1.0, linestyle="--")
    middle = math.sqrt(low * high)
    axes.annotate(f"{MINUS}1/2", (middle, at / math.sqrt(middle)), fontsize=8, color=GREY, ha="right", va="top")


def _plain_axis(axis: Axis) -> None:
    """Ticks at 1, 2 and 5 times powers of ten (only at powers over a wide range), as plain numbers."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter  # takes long to import

    low, high = sorted(axis.get_view_interval())
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in (
        (1.0,),
        (1.0, 2.0, 5.0),
        (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0),
        tuple(1.0 + 0.2 * k for k in range(45)),
    ):
        ticks = [factor * 10.0**power for power in powers for factor in factors if low <= factor * 10.0**power <= high]
        if len(ticks) >= 3:
            break
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axis.set_minor_formatter(NullFormatter())


def _explain(figure: Figure, result: PrecisionResult) -> None:
    machine, points = result.machine, result.points
    height, width = result.image_formation.resolution
    threads = ", ".join(f"{count} {name} thread" + "s" * (count != 1) for name, count in machine.threads.items())
    what = f"{result.object} in {result.environment}, {result.model}, {width} x {height} pixels"
    figure.suptitle(what, fontsize=11, fontweight="bold", x=0.01, ha="left")
    most = max(point.repeats for point in points)
    seconds = f"of the last of {most} repeats at most"
    if most > WARM_UP + 1:
        seconds = f"medians of at most {most - WARM_UP} interleaved repeats"
    key = "Filled: known" + (", with its 95 % interval." if any(point.interval for point in points) else ".")
    if not all(point.known for point in points):
        key += " Open, with an arrow: at most this, the reference is no better."
    place = f"{machine.cpu}, {machine.cores} cores, {threads}; seconds are {seconds}."
    figure.supxlabel(f"{place}\n{key}", fontsize=8, color=GREY, x=0.01, ha="left")
