"""Work-precision diagrams: error against processor time, both logarithmic."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from advsearch.questions.precision.answer import WARM_UP, PrecisionPoint, PrecisionResult
from advsearch.report.figures import BLUE, GREY, RED, Figures, drawn

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

PrecisionPoints = Sequence[PrecisionPoint]

COLORS = (BLUE, "#b4540a", "#1f7a45", "#7a3fa8", RED, "#4a7d8c", "#8a6d00", GREY, "#c2488f", "#3f5fd0", "#a06a50")
MARKERS = "osD^vP*X<>d"
PANEL = (5.6, 3.9)
"""Width and height of one diagram in inches."""
PERCENT = 100.0


def precision_figures(report: PrecisionResult) -> Figures:
    """Return work-precision diagrams as files: error against seconds, both logarithmic; none where nothing is known.

    Filled markers are known errors; open ones with an arrow are limits: the reference is no better than that. The
    dashed line falls as independent samples do.
    """
    panels = _panels(report)
    if not panels:
        return {}
    wide = min(2, len(panels))
    tall = math.ceil(len(panels) / wide)

    def draw(figure: Figure) -> None:
        for number, (title, kind, points) in enumerate(panels):
            axes = figure.add_subplot(tall, wide, number + 1)
            axes.set_title(title)
            (_draw_gains if kind == "objective" else _draw_errors)(axes, points, kind, report)
        _explain(figure, report)

    return drawn(draw, (PANEL[0] * wide, PANEL[1] * tall + 0.8))


def _panels(report: PrecisionResult) -> list[tuple[str, str, PrecisionPoints]]:
    """Title, what the vertical axis shows, and points of each diagram."""
    image = [one for one in report.points if one.quantity == "image"]
    found: list[tuple[str, str, PrecisionPoints]] = []
    for family, title in (("raw", "picture: samplers, denoiser, predictions"), ("depth", "picture: path depth")):
        shown = [one for one in image if (one.family == "depth") == (family == "depth")]
        found += [(title, "error", shown)] if shown else []
    margin = [one for one in image if one.family != "depth"]
    found += [("margin of the model", "margin_error", margin)] if margin else []
    gradient = [one for one in report.points if one.quantity == "gradient"]
    for control in dict.fromkeys(one.control for one in gradient):
        found.append((f"gradient: {control}", "error", [one for one in gradient if one.control == control]))
    objective = [one for one in report.points if one.quantity == "objective"]
    return found + ([("best verified objective", "objective", objective)] if objective else [])


def _draw_errors(axes: Axes, points: PrecisionPoints, measure: str, report: PrecisionResult) -> None:
    usable = [one for one in points if 0.0 < one.error_by(measure).value < math.inf]
    for number, name in enumerate(dict.fromkeys(one.estimator for one in usable)):
        line = sorted((one for one in usable if one.estimator == name), key=lambda one: one.spp)
        _draw_line(axes, line, measure, number, _named(name, points, measure, report))
    axes.set_xscale("log")
    axes.set_yscale("log")
    if usable:
        _draw_theory(axes, usable, measure)
        _plain_axis(axes.xaxis)
        _plain_axis(axes.yaxis)
    goal = report.goal * PERCENT
    low, high = axes.get_ylim()
    if low < goal < high:
        axes.axhline(goal, color="#1c1d20", linewidth=0.8, linestyle=":")
        axes.annotate(
            f"{goal:g} %", (1.0, goal), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8
        )
    axes.set_xlabel("seconds of processor time")
    axes.set_ylabel("relative error, %")
    axes.grid(True, which="major")
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.2,
        handlelength=1.6,
        title="slope against samples",
        title_fontsize=8,
        alignment="left",
    )


def _draw_line(axes: Axes, line: PrecisionPoints, measure: str, number: int, label: str) -> None:
    found = [one.error_by(measure) for one in line]
    color, marker = COLORS[number % len(COLORS)], MARKERS[number % len(MARKERS)]
    seconds = [one.seconds for one in line]
    errors = [PERCENT * error.value for error in found]
    axes.plot(seconds, errors, color=color, linewidth=1.0, alpha=0.55)
    for error, x, y in zip(found, seconds, errors, strict=True):
        if error.known:
            low, high = (PERCENT * value for value in error.interval)
            if low == low and high < 4.0 * y:
                axes.plot([x, x], [low, high], color=color, linewidth=0.8, alpha=0.6)
            axes.plot([x], [y], marker=marker, markersize=5, color=color)
        else:
            axes.plot([x], [y], marker=marker, markersize=6, markerfacecolor="white", color=color)
            axes.annotate(
                "",
                (x, y * 0.72),
                (x, y),
                arrowprops={"arrowstyle": "-|>", "color": color, "linewidth": 0.8, "shrinkA": 3},
            )
    for one, x, y in zip(line, seconds, errors, strict=True):
        if one.later_seconds:
            axes.plot([one.later_seconds, x], [y, y], color=color, linewidth=1.0, linestyle=":")
            axes.plot([one.later_seconds], [y], marker=marker, markersize=5, markerfacecolor="white", color=color)
    axes.plot([], [], marker=marker, markersize=5, color=color, linewidth=1.0, label=label)


def _named(name: str, points: PrecisionPoints, measure: str, report: PrecisionResult) -> str:
    """An estimator with the slope of its line against samples, and theory where it disagrees with that."""
    control = points[0].control
    for one in report.slopes:
        same = one.estimator == name and one.control == control and one.quantity == points[0].quantity
        if same and one.measure == measure and one.against == "samples":
            doubt = f" (not {_minus(one.theory)})" if one.agrees is False else ""
            return f"{name}  {_minus(one.slope)}{doubt}"
    return name


def _minus(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}".replace("-", "\N{MINUS SIGN}")


def _draw_theory(axes: Axes, points: PrecisionPoints, measure: str) -> None:
    """A dashed line of slope -1/2 under the points of samples; what is predicted knows no such line."""
    points = [one for one in points if not one.later_seconds] or points
    low, high = min(one.seconds for one in points), max(one.seconds for one in points)
    if high < 1.5 * low:
        return
    at = PERCENT * min(one.error_by(measure).value * math.sqrt(one.seconds) for one in points) * 0.8
    axes.plot([low, high], [at / math.sqrt(low), at / math.sqrt(high)], color=GREY, linewidth=1.0, linestyle="--")
    middle = math.sqrt(low * high)
    axes.annotate("\N{MINUS SIGN}1/2", (middle, at / math.sqrt(middle)), fontsize=8, color=GREY, ha="right", va="top")


def _plain_axis(axis: Axis) -> None:
    """Ticks at 1, 2 and 5 times powers of ten (only at powers over a wide range), as plain numbers."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter  # takes long to import

    low, high = sorted(axis.get_view_interval())
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    choices = (
        (1.0,),
        (1.0, 2.0, 5.0),
        (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0),
        (1.0, 1.2, 1.5, 1.7, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0),
    )
    for factors in choices:
        ticks = [factor * 10.0**power for power in powers for factor in factors if low <= factor * 10.0**power <= high]
        if len(ticks) >= 3:
            break
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axis.set_minor_formatter(NullFormatter())


def _draw_gains(axes: Axes, points: PrecisionPoints, kind: str, report: PrecisionResult) -> None:
    for number, name in enumerate(dict.fromkeys(one.estimator for one in points)):
        line = sorted((one for one in points if one.estimator == name), key=lambda one: one.renders or 0)
        color = COLORS[number % len(COLORS)]
        seconds = [one.seconds for one in line]
        low, high = ([one.quartiles[side] for one in line if one.quartiles] for side in (0, 1))
        axes.fill_between(seconds, low, high, color=color, alpha=0.15, linewidth=0)
        marker = MARKERS[number % len(MARKERS)]
        label = f"{name}, {line[-1].repeats} searches"
        gains = [math.nan if one.objective is None else one.objective for one in line]
        axes.plot(seconds, gains, marker=marker, markersize=4.5, color=color, label=label)
        axes.annotate(
            f"{line[-1].renders} renders",
            (seconds[-1], gains[-1]),
            fontsize=7.5,
            color=color,
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
        )
    axes.set_xscale("log")
    _plain_axis(axes.xaxis)
    axes.set_xlabel("seconds of search (processor time)")
    axes.set_ylabel(f"{report.objective}, verified")
    axes.grid(True, which="major")
    axes.legend(loc="upper left")


def _explain(figure: Figure, report: PrecisionResult) -> None:
    machine, formation = report.machine, report.image_formation
    height, width = formation.resolution
    threads = ", ".join(f"{count} {name} thread" + "s" * (count != 1) for name, count in machine.threads.items())
    what = f"{report.object} in {report.environment}, {report.model}, {width} x {height} pixels"
    figure.suptitle(what, fontsize=11, fontweight="bold", x=0.01, ha="left")
    place = f"{machine.cpu}, {machine.cores} cores, {threads}{_repeated(report.points)}"
    errors = [one for one in report.points if one.quantity != "objective"]
    drawn_intervals = any(one.known and one.interval is not None for one in errors)
    key = "Filled: known" + (", with its 95 % interval." if drawn_intervals else ".")
    if not all(one.known for one in errors):
        key += " Open, with an arrow: at most this, the reference is no better."
    if any(one.later_seconds for one in report.points):
        key += "\nDotted: from the first one by a matrix or light on surfaces, its making included, to every other one."
    figure.supxlabel(f"{place}\n{key}", fontsize=8, color=GREY, x=0.01, ha="left")


def _repeated(points: PrecisionPoints) -> str:
    """What the seconds are: medians where every setting was measured several times."""
    most = max((one.repeats for one in points), default=0)
    if most <= WARM_UP + 1:
        return f"; seconds are of the last of {most} repeats at most."
    return f"; seconds are medians of at most {most - WARM_UP} interleaved repeats."
