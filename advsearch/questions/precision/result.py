"""Settings and result of `precision`, with its tables and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field, field_validator

from advsearch.extend import (
    DerivativeConfig,
    ResultPart,
    RunResult,
    SceneConfig,
    ShownResult,
    figures,
    results,
    setting,
    setting_as_in,
    settings,
    views,
)

QUANTITIES = ("image", "gradient")
SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
"""What `precision` measures, and the samplers that it knows."""


class PrecisionConfig(DerivativeConfig):
    """Settings of `precision`: error against run time, of a scene, its controls and a
    model.
    """

    command: ClassVar[str] = "precision"
    clashes: ClassVar[tuple[settings.Clash, ...]] = (
        *DerivativeConfig.clashes,
        settings.Clash(
            "samplers",
            lambda config: "image" not in config.measured_quantities,
            "is of the image, which `quantities` leaves out; leave it out too",
        ),
        settings.Clash(
            "loss",
            lambda config: "gradient" not in config.measured_quantities,
            "is of the gradient, which `quantities` leaves out; leave it out too",
        ),
    )

    quantities: str = setting(
        "image,gradient",
        "search",
        "what is measured, separated by commas",
        ", ".join(QUANTITIES),
    )
    seconds: float = setting(
        120.0,
        "search",
        "time that all measurements may take",
        unit="seconds",
        gt=0.0,
        le=1e9,
    )
    error: float = setting(
        0.05,
        "search",
        "relative error that the recommended settings should have",
        gt=0.0,
        le=1.0,
    )
    rounds: int = setting(
        8, "search", "measurements of every setting, at most", ge=3, le=1000
    )
    samplers: str = setting(
        ",".join(SAMPLERS),
        "search",
        "samplers that are compared, separated by commas",
        ", ".join(SAMPLERS),
    )
    loss: Literal["linear", "model"] = setting(
        "linear",
        "search",
        "whose gradient is measured: a smooth linear loss of the raw picture, or the "
        "model's in its image formation",
    )
    run: str | None = setting_as_in(
        SceneConfig, "run", otherwise="runs/OBJECT-precision-NNN"
    )

    @field_validator("quantities", "samplers", mode="before")
    @classmethod
    def _names_from_list(cls, value: Any) -> Any:
        """Join a list of names by commas, which is how a string states them."""
        if isinstance(value, (list, tuple)):
            return ",".join(str(part) for part in value)
        return value

    @field_validator("quantities", "samplers")
    @classmethod
    def _check_names(cls, value: str, info: Any) -> str:
        """Refuse an empty list, duplicates, and names that are not known.

        Raises:
            ValueError: for each of these.
        """
        names = settings.split_names(value)
        known = QUANTITIES if info.field_name == "quantities" else SAMPLERS
        is_empty = not "".join(names).strip()
        if is_empty or not set(names) <= set(known):
            raise ValueError("nothing, or unknown names")
        settings.check_no_duplicates(names, info.field_name)
        return value

    @property
    def title_words(self) -> tuple[str, ...]:
        return self.object, self.command

    @property
    def measured_quantities(self) -> tuple[str, ...]:
        return settings.split_names(self.quantities)

    @property
    def compared_samplers(self) -> tuple[str, ...]:
        return settings.split_names(self.samplers)


class PrecisionPoint(results.Measured):
    """Estimates from repeated measurements of one setting."""

    family: str = Field(
        default="",
        description="what it is recommended among: `raw`, `oidn`, `depth` or "
        "`predicted`; absent of gradients",
    )
    heavy_tailed: bool = Field(
        default=False,
        description="a few pixels hold the error, so that it has no interval",
    )
    wall_seconds: results.JsonFloat | None = results.optional_field(
        "by the clock; `seconds` are processor time"
    )

    @property
    def is_known(self) -> bool:
        """Whether the error is well above the reference's own; else it is an upper
        limit.
        """
        return self.status == "ok"

    @property
    def rms(self) -> float:
        """The error as a number; NaN where there is none."""
        return math.nan if self.error is None else self.error


class PrecisionSlope(results.Fields):
    """A line through the points of an estimator: log of the error against log of the
    samples.
    """

    quantity: str
    control: str
    estimator: str
    slope: float
    interval: results.Interval
    offset: float = Field(description="logarithm of the error at one sample")
    points: int
    theory: float | None = Field(description="what the slope should be")
    or_steeper: bool
    agrees: bool | None = Field(description="null where that can't be told")


class PrecisionReference(results.Fields):
    """A reference that stands for the truth, and its error."""

    quantity: str
    control: str = ""
    reference: str
    error: results.JsonFloat
    parts: int
    spp: int = Field(description="samples a pixel of all parts together")


class Recommended(results.Fields):
    """The setting that reaches the goal soonest."""

    quantity: str
    control: str
    family: str = ""
    goal: float | None = None
    estimator: str | None = results.optional_field(
        "null where nothing that was measured reaches it"
    )
    spp: int | None = None
    seconds: results.JsonFloat | None = None
    error: results.JsonFloat | None = None
    basis: str | None = results.optional_field(
        "measured, fitted, interpolated, extrapolated or confirmed"
    )
    repeats: int | None = results.optional_field("measurements that confirm it")


class Sitting(results.Fields):
    """What was measured without a break: the picture and the margin, or a control's
    gradient.
    """

    points: list[PrecisionPoint] = Field(default=[])
    references: list[PrecisionReference] = Field(default=[])
    confirmations: list[PrecisionPoint] = Field(
        default=[], description="recommended settings, measured anew"
    )
    warnings: list[str] = Field(default=[])
    left_out: list[str] = Field(default=[])
    seconds: float = Field(default=0.0, description="seconds by the clock")


class Machine(results.Fields):
    """The machine that times were measured on."""

    cpu: str
    cores: int
    threads: dict[str, int]


class PrecisionResult(RunResult):
    """Error against run time, and recommended settings."""

    command: ClassVar[str] = "precision"

    object: str
    model: str
    image_formation: results.Formation
    depth: int = Field(description="longest light path in segments")
    loss: str
    spp: int
    machine: Machine
    goal: float = Field(description="relative error that is wanted")
    points: list[PrecisionPoint]
    slopes: list[PrecisionSlope]
    references: list[PrecisionReference]
    recommendations: list[Recommended]
    warnings: list[str] = Field(description="sentences that a reader has to know")
    left_out: list[str] = Field(description="settings for which there was no time")
    figures: list[str]


WARM_UP_CALLS = 3
"""Calls of a setting whose times don't count where there are more: the first compiles
and records kernels, the second may record them again, and so may the first one after
other scenes were rendered.
"""
FAMILY_SUFFIXES = {"none": " without denoiser", "oidn": " with denoiser"}
READING_NOTE = (
    "Each row is a setting: its error beside a reference of far more samples, with the "
    "95 % interval of that "
    "error, and the processor time, in seconds, that one picture or gradient takes. A "
    "margin is how far the right "
    "prediction leads the wrong one, in logits; a cosine of 1 means that a gradient "
    "points the right way."
)


def describe_quantity(quantity: str, control: str = "") -> str:
    """Name a quantity in a sentence."""
    return f"the gradient of {control}" if quantity == "gradient" else f"the {quantity}"


SLOPE_COLUMNS: Mapping[str, views.Column] = {
    "what": lambda slope: slope.control or slope.quantity,
    "estimator": "{0.estimator}",
    "slope": "{0.slope:.2f}",
    "95 %": "{0.interval[0]:.2f} to {0.interval[1]:.2f}",
    "theory": lambda slope: (
        ""
        if slope.theory is None
        else f"{slope.theory:.3g}" + " or steeper" * slope.or_steeper
    ),
    "points": "{0.points}",
    "": lambda slope: {
        True: "agrees",
        False: "DISAGREES",
        None: "" if slope.theory is None else "can't be told",
    }[slope.agrees],
}
REFERENCE_COLUMNS: Mapping[str, views.Column] = {
    "what": lambda reference: reference.control or reference.quantity,
    "reference": "{0.reference}",
    "samples": "{0.spp}",
    "parts": "{0.parts}",
    "error": lambda reference: f"{100 * reference.error:.2g} %",
}


def make_view(result: PrecisionResult) -> ShownResult:
    """Lay out a result: recommendations, errors, slopes and references."""
    headline = make_headline(result)
    if result.is_unfinished:
        headline = f"It was stopped: only a part was measured. {headline}"
    machine = result.machine
    threads = " and ".join(
        f"{count} of {name}" for name, count in machine.threads.items()
    )
    context = {
        "model": result.model,
        "machine": f"{machine.cpu}, {machine.cores} cores, threads: {threads}",
        "loss": result.loss,
        "figures": ", ".join(result.figures),
    }
    return ShownResult(headline, _make_parts(result), context)


def _make_parts(result: PrecisionResult) -> list[ResultPart]:
    """Return the lists and tables of a result, in the order in which they are shown."""
    recommendations = [
        describe_recommendation(recommendation, result.goal)
        for recommendation in result.recommendations
    ]
    error_tables = [
        _make_error_table(quantity, result.points)
        for quantity in ("picture", "margin", "gradient")
    ]
    return [
        ResultPart("Recommended", recommendations),
        # A page has this note at the table of references instead.
        ResultPart(text=[READING_NOTE], only="text"),
        *error_tables,
        ResultPart.make_table(
            result.slopes,
            SLOPE_COLUMNS,
            title="Slopes: logarithm of the error against that of samples",
        ),
        ResultPart.make_table(
            result.references,
            REFERENCE_COLUMNS,
            title="References, with their own errors",
            note=READING_NOTE,
        ),
        ResultPart("Not measured, the time was up", result.left_out),
    ]


def make_headline(result: PrecisionResult) -> str:
    """Summarize a result in a sentence: the first setting that reaches the goal."""
    # a recommendation without an estimator states that none reaches the goal
    first = next((row for row in result.recommendations if row.estimator), None)
    if first is None:
        return (
            "Nothing that was measured is known to reach the error: give it more "
            "`seconds` or a larger `error`."
        )
    quantity = describe_quantity(first.quantity, first.control)
    return (
        f"For {100 * result.goal:.3g} % error of {quantity}: {first.spp} samples "
        f"({first.estimator}), {first.seconds:.2g} s of processor time, here."
    )


def describe_recommendation(recommendation: Recommended, goal: float) -> str:
    """Describe a recommended setting, or that none reaches the goal."""
    quantity = describe_quantity(recommendation.quantity, recommendation.control)
    suffix = FAMILY_SUFFIXES.get(recommendation.family, "")
    goal_text = f"{100 * goal:.3g} % error of {quantity}{suffix}"
    if recommendation.estimator is None:
        return (
            f"{goal_text}: not reached by anything that was measured; give it more "
            "`seconds` or a larger `error`"
        )
    # Only the exceptions are named, such as "extrapolated".
    is_usual = recommendation.basis in ("interpolated", "fitted")
    basis = "" if is_usual else f" ({recommendation.basis})"
    return (
        f"{goal_text}: {recommendation.estimator}, {recommendation.spp} samples, "
        f"{recommendation.seconds:.2g} s{basis}"
    )


def list_cautions(points: Sequence[PrecisionPoint]) -> list[str]:
    """Return warnings about points: errors of few pixels, and a busy machine.

    The machine counts as busy if most measurements took more than twice their processor
    time by the clock: they waited for other programs.
    """
    # Heavy tails: a few pixels have most of the error.
    heavy = sorted({point.estimator for point in points if point.heavy_tailed})
    # of each point with a time by the clock: whether it took twice the processor time
    waited = [
        point.wall_seconds > 2.0 * point.seconds
        for point in points
        if point.wall_seconds is not None
    ]
    is_busy = 2 * sum(waited) > len(waited)  # more than half of them
    warnings = []
    if heavy:
        warnings.append(
            f"{', '.join(heavy)}: a few pixels hold most of the error (fireflies), so "
            "that repeats say too little and "
            "it has no interval; a denoiser or more `rounds` help"
        )
    if is_busy:
        warnings.append(
            "the machine was busy with something else: by the clock, most pictures and "
            "gradients took over twice their "
            "processor time; measure again when it is quiet"
        )
    return warnings


def _make_error_table(quantity: str, points: Sequence[PrecisionPoint]) -> ResultPart:
    """Make the table of errors of a quantity: "picture", "margin" or "gradient".

    Only gradients have a control and a cosine. An unknown error is printed as an upper
    limit with "<".
    """
    rows = [point for point in points if point.quantity == quantity]
    columns: dict[str, views.Column] = (
        {"control": "{0.control}"} if quantity == "gradient" else {}
    )
    columns |= {
        "estimator": "{0.estimator}",
        "samples": "{0.spp}",
        "error": lambda point: (
            f"{'' if point.is_known else '< '}{100 * point.rms:.3g} %"
        ),
        "95 %": lambda point: (
            "heavy tails" if point.heavy_tailed else _format_interval(point.interval)
        ),
    }
    if quantity == "gradient":
        columns["cosine"] = lambda point: (
            f"{math.nan if point.cosine is None else point.cosine:.3f}"
        )
    columns["seconds"] = "{0.seconds:.3g}"
    return ResultPart.make_table(
        rows, {**columns, "repeats": "{0.repeats}"}, title=quantity.capitalize()
    )


def _format_interval(interval: results.Interval | None) -> str:
    """Format an interval in percent: "1.2 to 3.4"; empty without one."""
    if interval is None:
        return ""
    lower, upper = interval
    return f"{100 * lower:.2g} to {100 * upper:.2g}"


GREY = figures.GREY
COLORS = (
    figures.BLUE,
    "#b4540a",
    "#1f7a45",
    "#7a3fa8",
    figures.RED,
    "#4a7d8c",
    "#8a6d00",
    GREY,
    "#c2488f",
    "#3f5fd0",
    "#a06a50",
)
MARKERS = "osD^vP*X<>d"
PANEL_SIZE = (5.6, 3.9)  # width and height of one diagram in inches
PERCENT = 100.0
MINUS = "\N{MINUS SIGN}"


def draw_figures(result: PrecisionResult) -> figures.Figures:
    """Return work-precision diagrams as files: error against seconds, both logarithmic.

    Filled markers are known errors. Open markers with an arrow are upper limits, as the
    reference has a similar error. The dashed line falls as the error of independent
    samples does. The result is empty if no error is known.
    """
    panels: dict[str, list[PrecisionPoint]] = {}
    for point in result.points:
        title = f"gradient: {point.control}" if point.control else point.quantity
        if 0.0 < point.rms < math.inf:
            panels.setdefault(title, []).append(point)
    if not panels:
        return {}
    n_columns = min(2, len(panels))
    n_rows = math.ceil(len(panels) / n_columns)
    (height, width) = result.image_formation.resolution
    headline = (
        f"{result.object} in {result.environment}, {result.model}, {width} x "
        f"{height} pixels"
    )

    def draw(figure: Any) -> None:
        """Draw a panel for each quantity, in rows of two, under the headline."""
        for number, (title, panel_points) in enumerate(panels.items(), start=1):
            axes = figure.add_subplot(n_rows, n_columns, number)
            axes.set_title(title)
            _draw_errors(axes, panel_points, result)
        figure.suptitle(headline, fontsize=11, fontweight="bold", x=0.01, ha="left")
        caption = _make_caption(result)
        figure.supxlabel(caption, fontsize=8, color=GREY, x=0.01, ha="left")

    return figures.render_figure(
        draw, (PANEL_SIZE[0] * n_columns, PANEL_SIZE[1] * n_rows + 0.8)
    )


def _make_caption(result: PrecisionResult) -> str:
    """Describe machine, repeats and markers for the caption of the diagrams."""
    machine = result.machine
    # for example "16 torch threads"
    thread_counts = []
    for name, count in machine.threads.items():
        thread = "thread" if count == 1 else "threads"
        thread_counts.append(f"{count} {name} {thread}")
    threads = ", ".join(thread_counts)
    # Times of warm-up calls don't count: of few repeats, the last one is left.
    max_repeats = max(point.repeats for point in result.points)
    seconds = f"of the last of {max_repeats} repeats at most"
    if max_repeats > WARM_UP_CALLS + 1:
        seconds = (
            f"medians of at most {max_repeats - WARM_UP_CALLS} interleaved repeats"
        )
    legend = "Filled: known"
    if any(point.interval for point in result.points):
        legend += ", with its 95 % interval"
    legend += "."
    if not all(point.is_known for point in result.points):
        legend += " Open, with an arrow: at most this, the reference is no better."
    return (
        f"{machine.cpu}, {machine.cores} cores, {threads}; seconds are "
        f"{seconds}.\n{legend}"
    )


def _draw_errors(
    axes: Any, points: Sequence[PrecisionPoint], result: PrecisionResult
) -> None:
    """Draw the error of each estimator against seconds, with theory and the goal.

    Args:
        axes: axes of matplotlib.
        points: points of one quantity, and of one control if it is a gradient.
        result: result that they are part of, with the slopes and the goal.
    """
    quantity = points[0].quantity
    control = points[0].control
    slopes = {
        slope.estimator: slope
        for slope in result.slopes
        if (slope.quantity, slope.control) == (quantity, control)
    }
    estimators = dict.fromkeys(point.estimator for point in points)
    for number, estimator in enumerate(estimators):
        line = sorted(
            (point for point in points if point.estimator == estimator),
            key=lambda point: point.spp,
        )
        label = _make_label(estimator, slopes.get(estimator))
        _draw_line(axes, line, number, label)
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="seconds of processor time",
        ylabel="relative error, %",
    )
    _draw_theory(axes, points)
    _plain_axis(axes.xaxis)
    _plain_axis(axes.yaxis)
    _draw_goal(axes, result.goal * PERCENT)
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


def _make_label(name: str, slope: PrecisionSlope | None) -> str:
    """Label an estimator with its slope, and with that of theory if they disagree."""
    if slope is None:
        return name
    theory = f" (not {slope.theory:.2f})" if slope.agrees is False else ""
    label = f"{name}  {slope.slope:.2f}{theory}"
    return label.replace(" -", f" {MINUS}")  # the sign that figures have


def _draw_goal(axes: Any, goal: float) -> None:
    """Draw a dotted line at the error that is the goal, in percent, if it is in view."""
    lower, upper = axes.get_ylim()
    if lower < goal < upper:
        axes.axhline(goal, color="#1c1d20", linewidth=0.8, linestyle=":")
        axes.annotate(
            f"{goal:g} %",
            (1.0, goal),
            xycoords=("axes fraction", "data"),
            ha="right",
            va="bottom",
            fontsize=8,
        )


def _draw_theory(axes: Any, points: Sequence[PrecisionPoint]) -> None:
    """Draw a dashed line of slope -1/2 under the points, if they span enough time.

    The error of a mean of n independent samples falls as 1 / sqrt(n), and the time
    grows as n. So error = scale / sqrt(seconds).
    """
    start = min(point.seconds for point in points)
    end = max(point.seconds for point in points)
    # The lowest point relative to that law.
    # A line over a shorter range would say nothing.
    if not end >= 1.5 * start:
        return
    smallest = min(point.rms * math.sqrt(point.seconds) for point in points)
    scale = PERCENT * smallest * 0.8  # a little under the lowest point
    # the middle of the range on a logarithmic axis
    center = math.sqrt(start * end)
    axes.plot(
        [start, end],
        [scale / math.sqrt(start), scale / math.sqrt(end)],
        color=GREY,
        linewidth=1.0,
        linestyle="--",
    )
    axes.annotate(
        f"{MINUS}1/2",
        (center, scale / math.sqrt(center)),
        fontsize=8,
        color=GREY,
        ha="right",
        va="top",
    )


def _draw_line(
    axes: Any, line: Sequence[PrecisionPoint], number: int, label: str
) -> None:
    """Draw relative errors of an estimator over seconds, with their intervals.

    A known error is a filled marker. An open one with an arrow down is an upper limit.

    Args:
        axes: axes of matplotlib, logarithmic.
        line: the points, by ascending samples.
        number: number of the estimator, which chooses color and marker.
        label: label in the legend.
    """
    color = COLORS[number % len(COLORS)]
    marker = MARKERS[number % len(MARKERS)]
    axes.plot(
        [point.seconds for point in line],
        [PERCENT * point.rms for point in line],
        color=color,
        linewidth=1.0,
        alpha=0.55,
    )
    for point in line:
        _draw_point(axes, point, color, marker)
    axes.plot(
        # an empty line, whose entry in the legend has marker and line
        [],
        [],
        marker=marker,
        markersize=5,
        color=color,
        linewidth=1.0,
        label=label,
    )


def _draw_point(axes: Any, point: PrecisionPoint, color: str, marker: str) -> None:
    """Draw the relative error of one setting with its interval, in percent.

    A known error is a filled marker. An open one with an arrow down is an upper limit.

    Args:
        axes: axes of matplotlib, logarithmic.
        point: the setting.
        color, marker: style of its estimator.
    """
    x = point.seconds
    y = PERCENT * point.rms
    lower, upper = (PERCENT * bound for bound in point.interval or (math.nan, math.nan))
    # Neither a missing interval (NaN) nor one of over four times the error is drawn.
    if upper < 4.0 * y:
        axes.plot([x, x], [lower, upper], color=color, linewidth=0.8, alpha=0.6)
    axes.plot(
        [x],
        [y],
        marker=marker,
        markersize=5,
        color=color,
        markerfacecolor=color if point.is_known else "white",
    )
    if not point.is_known:
        arrow = {
            "arrowstyle": "-|>",
            "color": color,
            "linewidth": 0.8,
            "shrinkA": 3,
        }
        arrow_tip = y * 0.72  # the axis is logarithmic: as long for every point
        axes.annotate("", (x, arrow_tip), (x, y), arrowprops=arrow)


def _plain_axis(axis: Any) -> None:
    """Set ticks at 1, 2 and 5 times powers of ten, labelled as plain numbers.

    The usual ticks of a logarithmic axis are powers of ten, of which a narrow range has
    only one. The first list of factors that gives three ticks is used, so a wide range
    has powers only, and a narrow one has denser ticks.
    """
    # takes long to import
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

    low, high = sorted(axis.get_view_interval())
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    finest = [1.0 + 0.2 * k for k in range(45)]  # 1.0 to 9.8
    for factors in (
        [1.0],
        [1.0, 2.0, 5.0],
        [1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0],
        finest,
    ):
        ticks = [
            factor * 10.0**power
            for power in powers
            for factor in factors
            if low <= factor * 10.0**power <= high
        ]
        if len(ticks) >= 3:
            break  # else the next factors give more ticks
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axis.set_minor_formatter(NullFormatter())
