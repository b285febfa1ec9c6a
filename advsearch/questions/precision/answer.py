"""The result of `precision`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from pydantic import Field

from advsearch.report.figures import BLUE, GREY, RED, Figures, drawn
from advsearch.report.shown import AnswerPart, Column, ShownAnswer
from advsearch.runs.results.attack import SharedWork
from advsearch.runs.results.base import Fields, Formation, Interval, JsonFloat, RunResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


class MeasuredError(NamedTuple):
    """An error, its interval, and whether it is known or only a limit."""

    value: float
    interval: tuple[float, float]
    known: bool


class SettingPlace(Fields):
    """What a setting computes, and how."""

    quantity: str = Field(description="`image`, `gradient` or `objective`")
    estimator: str = Field(description="a sampler, an estimator or a policy")
    spp: int = Field(description="samples a pixel")
    control: str | None = Field(default=None, description="whose gradient")


class PrecisionPoint(SettingPlace):
    """What repeated measurements of a setting say. Errors are relative."""

    error: JsonFloat = Field(description="root mean square; where it is not known, an upper limit")
    interval: Interval | None = None
    known: bool | None = Field(default=None, description="well above the reference's own error")
    reference_error: JsonFloat | None = None
    margin_error: JsonFloat | None = Field(default=None, description="of the model's margin, with its own company")
    margin_interval: Interval | None = None
    margin_known: bool | None = None
    margin_reference_error: JsonFloat | None = None
    seconds: float
    repeats: int
    cosine: JsonFloat | None = Field(default=None, description="of a gradient with its reference")
    later_seconds: JsonFloat | None = Field(default=None, description="of another one from the same matrix or light")
    family: str | None = Field(default=None, description="what a line of the image is recommended among")
    objective: JsonFloat | None = Field(default=None, description="median over searches")
    quartiles: Interval | None = None
    renders: int | None = None

    def error_by(self, measure: str) -> MeasuredError:
        """Return `error` or `margin_error` with its interval; NaN where it was not measured."""
        nothing = (math.nan, math.nan)
        error, interval, known = (
            (self.error, self.interval, self.known)
            if measure == "error"
            else (self.margin_error, self.margin_interval, self.margin_known)
        )
        return MeasuredError(math.nan if error is None else error, interval or nothing, bool(known))


class PrecisionSlope(Fields):
    """A line through the points of one estimator, both axes logarithmic."""

    quantity: str
    control: str | None
    estimator: str
    measure: str = Field(description="`error` or `margin_error`")
    against: str = Field(description="`samples` or `seconds`")
    slope: float
    interval: Interval
    offset: float = Field(description="logarithm of the error at one sample or second")
    points: int
    fixed_seconds: JsonFloat = Field(description="of a call, that don't grow with the samples")
    theory: float | None = Field(description="what the slope should be")
    or_steeper: bool
    agrees: bool | None = Field(description="null where that can't be told")


class PrecisionReference(Fields):
    """What stands for the truth, and how far off it may be."""

    quantity: str
    reference: str
    error: JsonFloat
    parts: int
    spp: int
    control: str | None = None
    margin: JsonFloat | None = None
    margin_error: JsonFloat | None = None


class Recommended(Fields):
    """The setting that reaches the goal soonest."""

    quantity: str
    control: str | None
    measure: str
    among: str | None
    goal: float | None = None
    estimator: str | None = Field(description="null where nothing that was measured reaches it")
    spp: int | None = None
    renders: int | None = None
    seconds: JsonFloat | None = None
    error: JsonFloat | None = None
    basis: str | None = Field(default=None, description="measured, fitted, interpolated, extrapolated or confirmed")
    repeats: int | None = Field(default=None, description="measurements that confirm it")


class NotMeasured(SettingPlace):
    """A setting that was not measured, and why."""

    reason: str


class Machine(Fields):
    """What a time has to be read with."""

    cpu: str
    cores: int
    threads: dict[str, int]
    system: str
    python: str


class PrecisionResult(RunResult):
    """Error against run time, and what follows from it, as far as that is measured."""

    command: ClassVar[str] = "precision"

    object: str
    model: str
    image_formation: Formation
    depth: int = Field(description="longest light path in segments")
    loss: str
    objective: str
    spp: int
    machine: Machine
    goal: float = Field(description="relative error that is wanted")
    points: list[PrecisionPoint]
    slopes: list[PrecisionSlope]
    references: list[PrecisionReference]
    recommendations: list[Recommended]
    warnings: list[str] = Field(description="sentences that a reader has to know")
    left_out: list[NotMeasured]
    figures: list[str]
    shared: SharedWork | None = Field(
        default=None, description="how [workers](cluster.md) did that made parts of references; absent without"
    )


RESULT = PrecisionResult


READING = (
    "Each row is a setting: its error beside a reference of far more samples, with the 95 % interval of that "
    "error, and the seconds that one picture or gradient takes. A margin is how far the wrong answer leads the "
    "right one, in logits; a cosine of 1 means that a gradient points the right way. With a matrix of light "
    "transport or light on surfaces, `again` is what another one takes once the first one is there."
)

OBJECTIVES: Mapping[str, Column] = {
    "policy": "{0.estimator}",
    "renders": "{0.renders}",
    "seconds": "{0.seconds:.3g}",
    "objective": "{0.objective:.3g}",
    "quartiles": lambda one: "" if one.quartiles is None else f"{one.quartiles[0]:.3g} to {one.quartiles[1]:.3g}",
    "searches": "{0.repeats}",
}
SLOPES: Mapping[str, Column] = {
    "what": lambda one: one.control or ("margin" if one.measure == "margin_error" else one.quantity),
    "estimator": "{0.estimator}",
    "against": "{0.against}",
    "slope": "{0.slope:.2f}",
    "95 %": "{0.interval[0]:.2f} to {0.interval[1]:.2f}",
    "theory": lambda one: _theory(one),
    "points": "{0.points}",
    "fixed s": lambda one: f"{one.fixed_seconds:.2g}" if one.against == "seconds" else "",
    "": lambda one: {True: "agrees", False: "DISAGREES", None: "can't be told" if _theory(one) else ""}[one.agrees],
}
REFERENCES: Mapping[str, Column] = {
    "what": lambda one: one.control or one.quantity,
    "reference": "{0.reference}",
    "samples": "{0.spp}",
    "parts": "{0.parts}",
    "error": lambda one: f"{100 * one.error:.2g} %",
    "margin": lambda one: (
        "" if one.margin is None or one.margin_error is None else f"{one.margin:.3g} +- {100 * one.margin_error:.2g} %"
    ),
}


def shown(result: PrecisionResult) -> ShownAnswer:
    """Return what was measured, what follows from it, and what was not measured."""
    by = {name: [one for one in result.points if one.quantity == name] for name in ("image", "gradient", "objective")}
    machine = result.machine
    threads = " and ".join(f"{count} of {name}" for name, count in machine.threads.items())
    said = [sentence(one, result.goal) for one in result.recommendations]
    stopped = ["It was stopped: only a part was measured."] if result.goes_on else []
    return ShownAnswer(
        " ".join(stopped) or "Error against run time, and the settings that reach the goal soonest.",
        [
            AnswerPart("Recommended", said),
            AnswerPart(text=[READING], only="text"),
            *(_errors(name, by[name]) for name in ("image", "gradient")),
            AnswerPart.table(by["objective"], OBJECTIVES, title="Objective"),
            AnswerPart.table(
                result.slopes, SLOPES, title="Slopes: logarithm of the error against that of samples or seconds"
            ),
            AnswerPart.table(result.references, REFERENCES, title="References, with their own errors", note=READING),
            AnswerPart("Not measured, the time was up", _left_out(result.left_out)),
        ],
        {
            "model": result.model,
            "machine": f"{machine.cpu}, {machine.cores} cores, threads: {threads}",
            "loss": result.loss,
            "figures": ", ".join(result.figures),
        },
    )


def sentence(one: Recommended, goal: float) -> str:
    """Return a recommendation as a sentence."""
    what = {"image": "the picture", "objective": "the best verified objective"}.get(one.quantity)
    what = what or f"the gradient of {one.control}"
    if one.measure == "margin_error":
        what = "the margin"
    asked = f"{100 * goal:.3g} % error of {what}" + (f" {one.among}" if one.among else "")
    if one.quantity == "objective":
        asked = f"{100 * (1 - goal):.3g} % of the largest median gain in the verified objective"
    if one.estimator is None:
        return f"{asked}: not reached by anything that was measured; give it more `seconds` or a larger `error`"
    if one.quantity == "objective":
        return f"{asked}: policy {one.estimator}, {one.renders} renders, {one.seconds:.2g} s"
    basis = "" if one.basis in ("interpolated", "fitted") else f" ({one.basis})"
    return f"{asked}: {one.estimator}, {one.spp} samples, {one.seconds:.2g} s{basis}"


def _errors(name: str, points: Sequence[PrecisionPoint]) -> AnswerPart:
    """A row for each setting: of pictures with the error of the margin, of gradients with the cosine."""
    margin = any(one.margin_error is not None for one in points)
    columns: dict[str, Column] = {} if margin else {"control": lambda one: one.control or ""}
    columns |= {
        "estimator": "{0.estimator}",
        "samples": "{0.spp}",
        "error": lambda one: _percent(one.error_by("error")),
        "95 %": lambda one: _between(one.error_by("error")),
    }
    if margin:
        columns["margin"] = lambda one: _percent(one.error_by("margin_error"))
    else:
        columns["cosine"] = lambda one: f"{math.nan if one.cosine is None else one.cosine:.3f}"
    columns["seconds"] = "{0.seconds:.3g}"
    if any(one.later_seconds is not None for one in points):
        columns["again"] = lambda one: f"{one.seconds if one.later_seconds is None else one.later_seconds:.3g}"
    return AnswerPart.table(points, {**columns, "repeats": "{0.repeats}"}, title=name.capitalize())


def _theory(one: PrecisionSlope) -> str:
    return "" if one.theory is None else f"{one.theory:.3g}" + (" or steeper" if one.or_steeper else "")


def _between(error: MeasuredError) -> str:
    low, high = error.interval
    return f"{100 * low:.2g} to {100 * high:.2g}" if low == low and error.known else ""


def _left_out(left_out: Sequence[NotMeasured]) -> list[str]:
    """One line for each estimator, with its sample counts."""
    counts: dict[str, list[str]] = {}
    for one in left_out:
        name = f"{one.control or one.quantity} by {one.estimator}"
        counts.setdefault(name, []).append(str(one.spp))
    return [f"{name}: {', '.join(samples)} samples" for name, samples in counts.items()]


def _percent(error: MeasuredError) -> str:
    return ("" if error.known else "< ") + f"{100 * error.value:.3g} %"


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
    axes.set_xlabel("seconds")
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
    axes.set_xlabel("seconds of search")
    axes.set_ylabel(f"{report.objective}, verified")
    axes.grid(True, which="major")
    axes.legend(loc="upper left")


def _explain(figure: Figure, report: PrecisionResult) -> None:
    machine, formation = report.machine, report.image_formation
    height, width = formation.resolution
    threads = ", ".join(f"{count} {name} thread" + "s" * (count != 1) for name, count in machine.threads.items())
    what = f"{report.object} in {report.environment}, {report.model}, {width} x {height} pixels"
    figure.suptitle(what, fontsize=11, fontweight="bold", x=0.01, ha="left")
    place = f"{machine.cpu}, {machine.cores} cores, {threads}; seconds are medians of interleaved repeats."
    key = "Filled: known, with its 95 % interval. Open, with an arrow: at most this, the reference is no better."
    if any(one.later_seconds for one in report.points):
        key += "\nDotted: from the first one by a matrix or light on surfaces, its making included, to every other one."
    figure.supxlabel(f"{place}\n{key}", fontsize=8, color=GREY, x=0.01, ha="left")
