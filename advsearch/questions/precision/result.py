"""Settings and result of `precision`, with its tables and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field, field_validator

from advsearch.extend import (
    DerivativeConfig,
    RunResult,
    SceneConfig,
    figures,
    results,
    setting,
    setting_as_in,
    settings,
    views,
)

QUANTITIES = ("image", "gradient")
"""What `precision` can measure."""
SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
"""Samplers that `precision` can compare."""


class PrecisionConfig(DerivativeConfig):
    """Settings of `precision`, which measures error against run time.

    The errors are those of images of a scene, of a model's margin, and of the gradients
    of controls.
    """

    command: ClassVar[str] = "precision"
    clashes: ClassVar[tuple[settings.Clash, ...]] = (
        *DerivativeConfig.clashes,
        settings.Clash(
            "samplers",
            lambda config: "image" not in config.measured_quantities,
            "applies to the image, which `quantities` leaves out; leave it out too",
        ),
        settings.Clash(
            "loss",
            lambda config: "gradient" not in config.measured_quantities,
            "applies to the gradient, which `quantities` leaves out; leave it out too",
        ),
    )

    quantities: str = setting(
        "image,gradient",
        "search",
        "quantities to measure, separated by commas",
        ", ".join(QUANTITIES),
    )
    seconds: float = setting(
        120.0,
        "search",
        "time of all measurements",
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
        8, "search", "maximum number of measurements of a setting", ge=3, le=1000
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
        "loss whose gradient is measured: a smooth linear loss of the raw image, or "
        "the loss of the model with its image formation",
    )
    run: str | None = setting_as_in(
        SceneConfig, "run", otherwise="runs/OBJECT-precision-NNN"
    )

    @field_validator("quantities", "samplers", mode="before")
    @classmethod
    def _names_from_list(cls, value: Any) -> Any:
        """Convert a list of names to a string with commas between them."""
        if isinstance(value, (list, tuple)):
            return ",".join(str(part) for part in value)
        return value

    @field_validator("quantities", "samplers")
    @classmethod
    def _check_names(cls, value: str, info: Any) -> str:
        """Reject an empty list, duplicates, and unknown names.

        Raises:
            ValueError: a clause of what was got. pydantic catches it, and the user gets
                a message with the known names.
        """
        names = settings.split_names(value)
        known = QUANTITIES if info.field_name == "quantities" else SAMPLERS
        is_empty = not "".join(names).strip()
        if is_empty or not set(names) <= set(known):
            raise ValueError("nothing, or unknown names")
        settings.check_no_duplicates(names, info.field_name)
        return value

    @property
    def run_name_words(self) -> tuple[str, ...]:
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
        description="denoiser of an image, `none` or `oidn`: only settings of the same "
        "family are compared for a recommendation; empty for gradients",
    )
    heavy_tailed: bool = Field(
        default=False,
        description="whether a few pixels have most of the error; then there is no "
        "interval",
    )
    wall_seconds: results.JsonFloat | None = results.optional_field(
        "time by the clock; `seconds` is processor time"
    )

    @property
    def has_known_error(self) -> bool:
        """Whether the error is known: clearly larger than that of the reference.

        Otherwise it is an upper limit.
        """
        return self.status == "ok"

    @property
    def rms_error(self) -> float:
        """The root mean square error; NaN if there is none."""
        return math.nan if self.error is None else self.error


class PrecisionSlope(results.Fields):
    """A line through the points of an estimator.

    It relates the logarithm of the error to the logarithm of the samples.
    """

    quantity: str
    control: str
    estimator: str
    slope: float
    interval: results.Interval
    offset: float = Field(description="natural logarithm of the error with one sample")
    points: int = Field(description="number of points of the fit")
    theory: float | None = Field(
        description="slope that theory predicts; null if it predicts none"
    )
    or_steeper: bool = Field(description="whether theory allows a steeper slope, too")
    agrees: bool | None = Field(
        description="whether the slope agrees with theory; null if that is not known"
    )


class PrecisionReference(results.Fields):
    """A reference, which is used as the truth, and its error."""

    quantity: str
    control: str = ""
    reference: str
    error: results.JsonFloat
    parts: int = Field(description="number of independent parts")
    spp: int = Field(description="samples per pixel, summed over all parts")


class Recommended(results.Fields):
    """The fastest setting that reaches the goal."""

    quantity: str
    control: str
    family: str = ""
    goal: float | None = None
    estimator: str | None = results.optional_field(
        "null if no setting that was measured reaches the goal"
    )
    spp: int | None = None
    seconds: results.JsonFloat | None = None
    error: results.JsonFloat | None = None
    basis: str | None = results.optional_field(
        "how the samples were found: `measured`, `fitted`, `interpolated`, "
        "`extrapolated` or `confirmed`"
    )
    repeats: int | None = results.optional_field(
        "number of new measurements that confirm it"
    )


class Sitting(results.Fields):
    """The measurements of one quantity, which were made without a break.

    They are those of the image and the margin, or of the gradient of a control.
    """

    points: list[PrecisionPoint] = Field(default=[])
    references: list[PrecisionReference] = Field(default=[])
    confirmations: list[PrecisionPoint] = Field(
        default=[], description="new measurements of recommended settings"
    )
    warnings: list[str] = Field(default=[])
    left_out: list[str] = Field(default=[])
    seconds: float = Field(default=0.0, description="seconds by the clock")


class Machine(results.Fields):
    """The machine on which times were measured."""

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
    goal: float = Field(description="relative error that is to be reached")
    points: list[PrecisionPoint]
    slopes: list[PrecisionSlope]
    references: list[PrecisionReference]
    recommendations: list[Recommended]
    warnings: list[str] = Field(description="sentences that a reader has to know")
    left_out: list[str] = Field(description="settings for which there was no time")
    figures: list[str]


WARM_UP_CALLS = 3
"""Number of first calls of a setting whose times are not used if there are more calls.

The first one compiles and records kernels. The second may record them again, and so may
the first one after other scenes were rendered.
"""
FAMILY_SUFFIXES = {"none": " without denoiser", "oidn": " with denoiser"}
READING_NOTE = (
    "Each row is a setting: its error relative to a reference with far more samples, "
    "the 95 % interval of that error, and the processor time in seconds for one image "
    "or gradient. A margin is the logit of the right class minus that of the wrong "
    "one. A cosine of 1 means that a gradient has the right direction."
)


def describe_quantity(quantity: str, control: str = "") -> str:
    """Return the name of a quantity for a sentence."""
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
        None: "" if slope.theory is None else "not known",
    }[slope.agrees],
}
REFERENCE_COLUMNS: Mapping[str, views.Column] = {
    "what": lambda reference: reference.control or reference.quantity,
    "reference": "{0.reference}",
    "samples": "{0.spp}",
    "parts": "{0.parts}",
    "error": lambda reference: f"{100 * reference.error:.2g} %",
}


def make_view(result: PrecisionResult) -> views.ShownResult:
    """Lay out a result: recommendations, errors, slopes and references."""
    headline = make_headline(result)
    if result.is_unfinished:
        headline = f"Stopped early: not everything was measured. {headline}"
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
    return views.ShownResult(headline, _make_parts(result), context)


def _make_parts(result: PrecisionResult) -> list[views.ResultPart]:
    """Return the lists and tables of a result in their order."""
    recommendations = [
        describe_recommendation(recommendation, result.goal)
        for recommendation in result.recommendations
    ]
    error_tables = [
        _make_error_table(quantity, result.points)
        for quantity in ("picture", "margin", "gradient")
    ]
    return [
        views.ResultPart("Recommended", recommendations),
        # On a page this note is at the table of references instead.
        views.ResultPart(text=[READING_NOTE], only_medium="text"),
        *error_tables,
        _make_slope_table(result),
        _make_reference_table(result),
        views.ResultPart("Not measured for lack of time", result.left_out),
    ]


def _make_slope_table(result: PrecisionResult) -> views.ResultPart:
    """Make the table of how fast the error of each estimator falls with its samples."""
    return views.ResultPart.make_table(
        result.slopes,
        SLOPE_COLUMNS,
        title="Slopes: logarithm of the error against that of samples",
    )


def _make_reference_table(result: PrecisionResult) -> views.ResultPart:
    """Make the table of the references that errors are measured against."""
    return views.ResultPart.make_table(
        result.references,
        REFERENCE_COLUMNS,
        title="References, with their own errors",
        note=READING_NOTE,
    )


def make_headline(result: PrecisionResult) -> str:
    """Summarize a result in a sentence: the first setting that reaches the goal."""
    # In a recommendation without an estimator, no setting reaches the goal.
    first = next((row for row in result.recommendations if row.estimator), None)
    if first is None:
        return (
            "No setting that was measured is known to reach the error: set more "
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
            f"{goal_text}: not reached by any setting that was measured; set more "
            "`seconds` or a larger `error`"
        )
    # Only an unusual basis is stated, such as "extrapolated".
    is_usual = recommendation.basis in ("interpolated", "fitted")
    basis = "" if is_usual else f" ({recommendation.basis})"
    return (
        f"{goal_text}: {recommendation.estimator}, {recommendation.spp} samples, "
        f"{recommendation.seconds:.2g} s{basis}"
    )


def list_cautions(points: Sequence[PrecisionPoint]) -> list[str]:
    """Return warnings about errors of few pixels, and about a busy machine.

    The machine counts as busy if most measurements took more than twice their processor
    time by the clock: they waited for other programs.
    """
    # Heavy tails: a few pixels have most of the error.
    heavy = sorted({point.estimator for point in points if point.heavy_tailed})
    warnings = []
    if heavy:
        warnings.append(
            f"{', '.join(heavy)}: a few pixels have most of the error (fireflies), so "
            "that a few repeats do not show its size and there is no interval; a "
            "denoiser or more `rounds` help"
        )
    if _is_machine_busy(points):
        warnings.append(
            "the machine was busy with other programs: by the clock, most images and "
            "gradients took over twice their processor time; measure again when it is "
            "idle"
        )
    return warnings


def _is_machine_busy(points: Sequence[PrecisionPoint]) -> bool:
    """Return whether most measurements waited for other programs."""
    # For each point with a time by the clock (`wall_seconds`): whether that is over
    # twice the processor time (`seconds`).
    waited = [
        point.wall_seconds > 2.0 * point.seconds
        for point in points
        if point.wall_seconds is not None
    ]
    return sum(waited) > len(waited) / 2


ERROR_COLUMNS: Mapping[str, views.Column] = {
    "control": "{0.control}",
    "estimator": "{0.estimator}",
    "samples": "{0.spp}",
    "error": lambda point: (
        f"{'' if point.has_known_error else '< '}{100 * point.rms_error:.3g} %"
    ),
    "95 %": lambda point: (
        "heavy tails" if point.heavy_tailed else _format_interval(point.interval)
    ),
    "cosine": lambda point: f"{math.nan if point.cosine is None else point.cosine:.3f}",
    "seconds": "{0.seconds:.3g}",
    "repeats": "{0.repeats}",
}
"""Columns of a table of errors: format strings, or functions, of a point."""
GRADIENT_COLUMNS = ("control", "cosine")
"""Those that only gradients have."""


def _make_error_table(
    quantity: str, points: Sequence[PrecisionPoint]
) -> views.ResultPart:
    """Make the table of errors of a quantity.

    If the error of a point is not known (`has_known_error`), its root mean square is an
    upper limit, which is printed with "<".

    Args:
        quantity: "picture", "margin" or "gradient".
        points: points of all quantities.
    """
    rows = [point for point in points if point.quantity == quantity]
    columns = {
        name: column
        for name, column in ERROR_COLUMNS.items()
        if quantity == "gradient" or name not in GRADIENT_COLUMNS
    }
    return views.ResultPart.make_table(rows, columns, title=quantity.capitalize())


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

    Filled markers are known errors. Open markers with an arrow are upper limits, since
    the reference has a similar error. The dashed line has the slope of the error of
    independent samples. The result is empty if no error is known.
    """
    panels = _group_by_panel(result.points)
    if not panels:
        return {}
    n_columns = min(2, len(panels))
    n_rows = math.ceil(len(panels) / n_columns)

    def draw(figure: Any) -> None:
        """Draw a panel for each quantity, in rows of two, under the headline."""
        for number, (title, panel_points) in enumerate(panels.items(), start=1):
            axes = figure.add_subplot(n_rows, n_columns, number)
            axes.set_title(title)
            _draw_errors(axes, panel_points, result)
        _draw_titles(figure, result)

    return figures.render_figure(
        draw, (PANEL_SIZE[0] * n_columns, PANEL_SIZE[1] * n_rows + 0.8)
    )


def _group_by_panel(
    points: Sequence[PrecisionPoint],
) -> dict[str, list[PrecisionPoint]]:
    """Return the points that can be drawn, by the title of their panel."""
    panels: dict[str, list[PrecisionPoint]] = {}
    for point in points:
        title = f"gradient: {point.control}" if point.control else point.quantity
        if 0.0 < point.rms_error < math.inf:
            panels.setdefault(title, []).append(point)
    return panels


def _draw_titles(figure: Any, result: PrecisionResult) -> None:
    """Write the headline over the diagrams, and their caption below."""
    (height, width) = result.image_formation.resolution
    headline = (
        f"{result.object} in {result.environment}, {result.model}, {width} x "
        f"{height} pixels"
    )
    figure.suptitle(headline, fontsize=11, fontweight="bold", x=0.01, ha="left")
    caption = _make_caption(result)
    figure.supxlabel(caption, fontsize=8, color=GREY, x=0.01, ha="left")


def _make_caption(result: PrecisionResult) -> str:
    """Describe machine, repeats and markers for the caption of the diagrams."""
    machine = result.machine
    # for example "16 torch threads"
    thread_counts = []
    for name, count in machine.threads.items():
        thread = "thread" if count == 1 else "threads"
        thread_counts.append(f"{count} {name} {thread}")
    threads = ", ".join(thread_counts)
    return (
        f"{machine.cpu}, {machine.cores} cores, {threads}; seconds are "
        f"{_describe_timing(result.points)}.\n{_describe_markers(result.points)}"
    )


def _describe_timing(points: Sequence[PrecisionPoint]) -> str:
    """Describe of which repeats the seconds in the diagrams are."""
    # `median_time` leaves out the times of warm-up calls. With few repeats it uses only
    # the last one.
    max_repeats = max(point.repeats for point in points)
    max_timed_repeats = max_repeats - WARM_UP_CALLS
    if max_timed_repeats > 1:
        return f"medians of at most {max_timed_repeats} interleaved repeats"
    return f"of the last of {max_repeats} repeats at most"


def _describe_markers(points: Sequence[PrecisionPoint]) -> str:
    """Describe what the markers in the diagrams stand for."""
    legend = "Filled: known"
    if any(point.interval for point in points):
        legend += ", with its 95 % interval"
    legend += "."
    if not all(point.has_known_error for point in points):
        legend += " Open, with an arrow: an upper limit, the reference is no better."
    return legend


def _draw_errors(
    axes: Any, points: Sequence[PrecisionPoint], result: PrecisionResult
) -> None:
    """Draw the error of each estimator against seconds, with theory and the goal.

    Args:
        axes: axes of matplotlib.
        points: points of one quantity, and of one control if it is a gradient.
        result: result with these points, and with the slopes and the goal.
    """
    _draw_estimators(axes, points, result.slopes)
    axes.set(xscale="log", yscale="log")
    axes.set(xlabel="seconds of processor time", ylabel="relative error, %")
    _draw_theory(axes, points)
    _plain_axis(axes.xaxis)
    _plain_axis(axes.yaxis)
    _draw_goal(axes, result.goal * PERCENT)
    axes.grid(True, which="major")
    _add_slope_legend(axes)


def _add_slope_legend(axes: Any) -> None:
    """Add the legend of the estimators, with their slopes, to the right of the axes."""
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.2,
        handlelength=1.6,
        title="slope against samples",
        title_fontsize=8,
        alignment="left",
    )


def _draw_estimators(
    axes: Any, points: Sequence[PrecisionPoint], slopes: Sequence[PrecisionSlope]
) -> None:
    """Draw the points of each estimator, with its slope in the legend.

    Args:
        axes: axes of matplotlib.
        points: points of one quantity, and of one control if it is a gradient.
        slopes: slopes of all quantities.
    """
    quantity = points[0].quantity
    control = points[0].control
    slope_of_estimator = {
        slope.estimator: slope
        for slope in slopes
        if (slope.quantity, slope.control) == (quantity, control)
    }
    estimators = dict.fromkeys(point.estimator for point in points)
    for number, estimator in enumerate(estimators):
        line = sorted(
            (point for point in points if point.estimator == estimator),
            key=lambda point: point.spp,
        )
        label = _make_label(estimator, slope_of_estimator.get(estimator))
        _draw_line(axes, line, number, label)


def _make_label(name: str, slope: PrecisionSlope | None) -> str:
    """Label an estimator with its slope, and with that of theory if they disagree."""
    if slope is None:
        return name
    theory = f" (not {slope.theory:.2f})" if slope.agrees is False else ""
    label = f"{name}  {slope.slope:.2f}{theory}"
    return label.replace(" -", f" {MINUS}")  # figures have a typographic minus sign


def _draw_goal(axes: Any, goal: float) -> None:
    """Draw a dotted line at the goal, an error in percent, if it is in view."""
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
    spans_enough_time = end >= 1.5 * start  # False if a time is NaN
    if not spans_enough_time:
        return
    # the scale for which the line passes through the lowest point, relative to its
    # slope
    smallest_scale = min(point.rms_error * math.sqrt(point.seconds) for point in points)
    scale = PERCENT * smallest_scale * 0.8  # a little under that point
    _draw_half_slope(axes, start, end, scale)


def _draw_half_slope(axes: Any, start: float, end: float, scale: float) -> None:
    """Draw the dashed line error = scale / sqrt(seconds), with its slope.

    Args:
        axes: axes of matplotlib, logarithmic.
        start, end: the seconds that it spans.
        scale: error in percent at one second.
    """
    axes.plot(
        [start, end],
        [scale / math.sqrt(start), scale / math.sqrt(end)],
        color=GREY,
        linewidth=1.0,
        linestyle="--",
    )
    # the middle of the range on a logarithmic axis
    center = math.sqrt(start * end)
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
        number: index of the estimator, which decides color and marker.
        label: label in the legend.
    """
    color = COLORS[number % len(COLORS)]
    marker = MARKERS[number % len(MARKERS)]
    seconds = [point.seconds for point in line]
    errors = [PERCENT * point.rms_error for point in line]
    axes.plot(seconds, errors, color=color, linewidth=1.0, alpha=0.55)
    for point in line:
        _draw_point(axes, point, color, marker)
    style = {"color": color, "marker": marker, "markersize": 5, "linewidth": 1.0}
    # an empty line, which adds an entry with marker and line to the legend
    axes.plot([], [], label=label, **style)


def _draw_point(axes: Any, point: PrecisionPoint, color: str, marker: str) -> None:
    """Draw the relative error of one setting with its interval, in percent.

    A known error is a filled marker. An open one with an arrow down is an upper limit.

    Args:
        axes: axes of matplotlib, logarithmic.
        point: the setting.
        color, marker: style of its estimator.
    """
    x = point.seconds
    y = PERCENT * point.rms_error
    lower, upper = (PERCENT * bound for bound in point.interval or (math.nan, math.nan))
    # A very wide interval would dominate the diagram. A missing one is NaN.
    is_narrow = upper < 4.0 * y
    if is_narrow:
        axes.plot([x, x], [lower, upper], color=color, linewidth=0.8, alpha=0.6)
    axes.plot(
        [x],
        [y],
        marker=marker,
        markersize=5,
        color=color,
        markerfacecolor=color if point.has_known_error else "white",
    )
    if not point.has_known_error:
        _draw_arrow_down(axes, x, y, color)


def _draw_arrow_down(axes: Any, x: float, y: float, color: str) -> None:
    """Draw an arrow down from a point of a logarithmic diagram."""
    arrow = {
        "arrowstyle": "-|>",
        "color": color,
        "linewidth": 0.8,
        "shrinkA": 3,
    }
    # On a logarithmic axis, a factor gives all arrows the same length.
    arrow_tip = y * 0.72
    axes.annotate("", (x, arrow_tip), (x, y), arrowprops=arrow)


def _plain_axis(axis: Any) -> None:
    """Set ticks at round numbers, with labels as plain numbers."""
    # Importing it takes long.
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

    low, high = sorted(axis.get_view_interval())
    axis.set_major_locator(FixedLocator(_choose_ticks(low, high)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axis.set_minor_formatter(NullFormatter())


def _choose_ticks(low: float, high: float) -> list[float]:
    """Return round numbers between two bounds of a logarithmic axis.

    The usual ticks of a logarithmic axis are powers of ten, but a narrow range may have
    only one of these. So ticks are factors times powers of ten. The first list of
    factors that gives three ticks is used: a wide range has powers of ten only, and a
    narrow one has denser ticks.
    """
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
            break
    return ticks
