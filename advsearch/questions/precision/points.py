"""The numbers behind a work-precision diagram: errors of settings against a reference that has an error of its own.

A *setting* is one way to compute a quantity: a series (a sampler, an estimator, a policy) at a sample count. A *point*
is what repeated measurements of a setting say: its error and its time. Nothing here knows how to render.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit
from scipy.stats import linregress

from advsearch.questions.precision.answer import WARM_UP, PrecisionSlope, Recommended

Array = npt.NDArray[np.float64]

KNOWN = 2.0
"""Times the reference's own error that a measured one must have to be known."""
LEVEL = 0.95
"""Of every interval."""
WIDE, LEAST_VALUES = 1000, 100
"""From so many numbers on in a picture or gradient it is looked at how many of them hold its error. Below so many, in
all measurements together, a few noisy pixels decide it, and an interval would cover the truth too seldom
(`benchmarks/precision.py --intervals`)."""


@dataclass(frozen=True)
class MeasuredSetting:
    """One way to compute a quantity: a series (a sampler, an estimator, a policy), the line of a diagram, at a sample
    count.

    Attributes:
        quantity: "image", "gradient" or "objective".
        series: the line it belongs to in the diagram.
        spp: samples a pixel, as they are really taken.
        cost: what it should take, in any one unit; settings are measured cheapest first.
        control: whose gradient; empty otherwise.
    """

    quantity: str
    series: str
    spp: int
    cost: float
    control: str = ""

    @property
    def line(self) -> tuple[str, str, str]:
        """What all settings of one line of a diagram share."""
        return self.quantity, self.control, self.series


Sample = tuple[Mapping[str, float], float]
"""One measurement: error by measure ("error", "margin_error") and other numbers ("cosine"), and the processor time in
seconds. "fourth" is the sum of the fourth powers of all relative errors in a picture, whose squares "error" adds up."""


@dataclass(frozen=True)
class Point:
    """What the measurements of one setting say.

    Attributes:
        error: root mean square of the relative error, the reference's own taken off; where it is not known, an upper
            limit: the root mean square as it was measured.
        interval: of the error, 95 %, from the scatter of the samples; (NaN, NaN) for a single one and for heavy tails.
        known: whether the error is well above the reference's own.
        floor: the reference's own relative error.
        seconds: median processor time.
        repeats: samples behind it.
        more: means of the other numbers, medians of those in seconds.
        heavy: whether so few pixels hold the error that no interval from its scatter would cover it.
    """

    setting: MeasuredSetting
    measure: str
    error: float
    interval: tuple[float, float]
    known: bool
    floor: float
    seconds: float
    repeats: int
    more: Mapping[str, float] = field(default_factory=dict)
    heavy: bool = False


@dataclass(frozen=True, eq=False)
class ReferenceValue:
    """A value that stands for the truth, and how far off it may be.

    Attributes:
        value: (n,) float64.
        error: its own error relative to `size`, from the scatter of independent parts.
        size: what errors are relative to: the norm of the value.
        parts: how many independent parts it is the mean of.
    """

    value: Array
    error: float
    size: float
    parts: int

    def relative_error(self, value: Array) -> float:
        """Return |value - reference| / |reference|, in the Euclidean norm."""
        return _ratio(float(np.linalg.norm(value - self.value)), self.size)

    def relative_errors(self, value: Array) -> tuple[float, float]:
        """Return that, and the sum of the fourth powers of the relative errors of the single numbers; the latter is NaN
        where they are too few to say anything about tails."""
        fourth = float(np.sum(((value - self.value) / self.size) ** 4)) if self.size > 0.0 else math.nan
        return self.relative_error(value), fourth if len(value) >= WIDE else math.nan

    def cosine(self, value: Array) -> float:
        """Return the cosine of the angle between a value and the reference; NaN where one of them is zero."""
        size = float(np.linalg.norm(value)) * self.size
        return float(value @ self.value) / size if size > 0.0 else math.nan


def reference_of(parts: Sequence[Array], bias: float = 0.0) -> ReferenceValue:
    """Return the mean of at least two independent parts (n,) with the standard error that their scatter implies.

    error^2 = sum_k |part_k - mean|^2 / (K (K - 1)). A `bias` that is known to be there is added in squares.
    """
    _check_several(parts)
    mean = np.mean(parts, axis=0)
    scatter = sum(float(np.sum((part - mean) ** 2)) for part in parts)
    error = math.hypot(math.sqrt(scatter / (len(parts) * (len(parts) - 1))), bias)
    size = float(np.linalg.norm(mean))
    return ReferenceValue(mean, _ratio(error, size), size, len(parts))


def _check_several(parts: Sequence[Array]) -> None:
    if len(parts) < 2:
        raise ValueError(f"reference: expected at least two independent parts, got {len(parts)}")


def reference_through(function: Callable[[Array], Array], parts: Sequence[Array]) -> ReferenceValue:
    """Return a function, (n,) to (m,), of the mean of independent parts, with its error by the jackknife (Efron 1982,
    chapter 3).

    For what is no mean itself, such as a picture after its tone curve or a model's margin on it. The error holds the
    jackknife's estimate of bias (noise through a bend) as well as of scatter.
    """
    _check_several(parts)
    count, total = len(parts), np.sum(parts, axis=0)
    value = function(total / count)
    without = [function((total - part) / (count - 1)) for part in parts]
    middle = np.mean(without, axis=0)
    scatter = (count - 1) / count * sum(float(np.sum((one - middle) ** 2)) for one in without)
    bias = (count - 1) * float(np.linalg.norm(middle - value)) if count > 2 else 0.0
    bias = max(0.0, bias - math.sqrt(scatter))  # the estimate of the bias scatters as much as the value does
    size = float(np.linalg.norm(value))
    return ReferenceValue(value, _ratio(math.hypot(math.sqrt(scatter), bias), size), size, count)


def point_of(setting: MeasuredSetting, samples: Sequence[Sample], measure: str = "error", floor: float = 0.0) -> Point:
    """Return what samples of a setting say about one error, given the reference's own.

    The samples' noise and the reference's are independent, so their squares add: error^2 = mean of squares - floor^2.
    A root mean square below `KNOWN` times the floor is not known; what is given then is a limit.
    """
    squares = [numbers[measure] ** 2 for numbers, _ in samples]
    raw = statistics.fmean(squares)
    known = raw > (KNOWN * floor) ** 2 and math.isfinite(raw) and raw > 0.0
    error = math.sqrt(raw - floor**2) if known else math.sqrt(raw)
    others = {name for numbers, _ in samples for name in numbers} - {measure, "error", "margin_error", "fourth"}
    more = {}
    for name in sorted(others):
        values = [numbers[name] for numbers, _ in samples]
        more[name] = typical(values) if name.endswith("seconds") else statistics.fmean(values)
    heavy = measure == "error" and heavy_tailed([numbers for numbers, _ in samples])
    interval = _interval(squares, error, raw) if known else (0.0, math.sqrt(raw))
    interval = (math.nan, math.nan) if heavy else interval
    seconds = typical([taken for _, taken in samples])
    return Point(setting, measure, error, interval, known, floor, seconds, len(samples), more, heavy)


def heavy_tailed(numbers: Sequence[Mapping[str, float]]) -> bool:
    """Whether fewer than `LEAST_VALUES` pixels hold the error of some pictures: (sum of squares)^2 / (sum of fourth
    powers) counts how many, if all of them were equal. False where the pictures are too small to tell.

    What happens in none of the pictures, such as a firefly in every hundredth one, can't be seen.
    """
    squares = sum(one["error"] ** 2 for one in numbers)
    fourth = sum(one.get("fourth", math.nan) for one in numbers)
    return fourth > 0.0 and squares**2 < LEAST_VALUES * fourth


def typical(seconds: Sequence[float]) -> float:
    """Return the median of times without those of calls that warm up; the last one where there are no others."""
    return statistics.median(seconds[WARM_UP:] or seconds[-1:])


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return lower quartile, median and upper quartile (linear interpolation)."""
    low, middle, high = np.quantile(np.asarray(values, dtype=np.float64), [0.25, 0.5, 0.75])
    return float(low), float(middle), float(high)


def _interval(squares: Sequence[float], error: float, raw: float) -> tuple[float, float]:
    """The interval of a root mean square, by the scatter of the squares on a logarithmic scale."""
    count = len(squares)
    if count < 2:
        return math.nan, math.nan
    relative = 0.5 * statistics.stdev(squares) / math.sqrt(count) / raw
    factor = math.exp(min(50.0, float(stdtrit(count - 1, (1.0 + LEVEL) / 2.0)) * relative))
    return error / factor, error * factor


def _ratio(error: float, size: float) -> float:
    return error / size if size > 0.0 else (0.0 if error == 0.0 else math.inf)


AGREES = 0.1
"""How far a slope may be from theory, whatever its interval."""
MONTE_CARLO = -0.5
"""Slope of the error of a mean of independent samples against their number."""
FURTHEST = 16.0
"""Times the largest measured sample count beyond which nothing is said."""
MOSTLY_SAMPLING = 0.25
"""Share of a call's time that may be fixed for theory to hold against seconds."""
LEAST_POINTS = 3
"""Of a fit."""

Against = Literal["samples", "seconds"]
RoundUp = Callable[[str, float], int]
"""From a series and a number of samples to the next number that it takes."""


@dataclass(frozen=True)
class Theory:
    """What a slope should be; None where theory has none. With `at_most` steeper is right too."""

    slope: float | None = None
    at_most: bool = False


INDEPENDENT = Theory(MONTE_CARLO)
STRATIFIED = Theory(MONTE_CARLO, at_most=True)
"""Stratification never makes the slope shallower than that of independent samples (Owen 1997), and often steeper."""
UNKNOWN = Theory()


def fit_line(points: Sequence[Point], against: Against = "samples", theory: Theory = UNKNOWN) -> PrecisionSlope | None:
    """Return the least-squares line of log error against log samples or seconds.

    Only points whose error is known count: one below the reference's own error says nothing. None where fewer than
    `LEAST_POINTS` are left. An independent slope disagrees with theory where its interval leaves theory out *and* it is
    further than `AGREES` from it.

    Against seconds, theory holds where time is spent on samples: if there are enough points at which the fixed part of
    a call is at most `MOSTLY_SAMPLING` of it, the line goes through these, else nothing is said about theory.
    """
    known = [point for point in points if point.known]
    if _counts(known) < LEAST_POINTS:
        return None
    fixed, holds = math.nan, True
    if against == "seconds":
        fixed = fixed_seconds(points)
        sampling = [point for point in known if fixed <= MOSTLY_SAMPLING * point.seconds]
        holds = _counts(sampling) >= LEAST_POINTS
        known = sampling if holds else known
    x = np.log([float(one.setting.spp) if against == "samples" else one.seconds for one in known])
    y = np.log([point.error for point in known])
    slope, offset, half = straight_line(x, y)
    setting = known[0].setting
    return PrecisionSlope(
        quantity=setting.quantity,
        control=setting.control or None,
        estimator=setting.series,
        measure=known[0].measure,
        against=against,
        slope=slope,
        interval=(slope - half, slope + half),
        offset=offset,
        points=len(known),
        fixed_seconds=fixed,
        theory=theory.slope,
        or_steeper=theory.at_most,
        agrees=_agrees(slope, half, theory) if holds else None,
    )


def straight_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Return slope and offset of the least-squares line through (n,) and (n,), n at least 3, and half the slope's 95 %
    interval."""
    line = linregress(x, y)
    half = float(stdtrit(len(x) - 2, (1.0 + LEVEL) / 2.0)) * float(line.stderr)
    return float(line.slope), float(line.intercept), half


def fixed_seconds(points: Sequence[Point]) -> float:
    """Return the time of a call that does not grow with the samples: seconds = fixed + rate x samples.

    By least squares with relative weights, not below 0; NaN for fewer than two sample counts.
    """
    if len({point.setting.spp for point in points}) < 2:
        return math.nan
    seconds = np.array([point.seconds for point in points])
    columns = np.stack([np.ones(len(points)), np.array([float(point.setting.spp) for point in points])], axis=1)
    fixed, _ = np.linalg.lstsq(columns / seconds[:, None], np.ones(len(points)), rcond=None)[0]
    return max(0.0, float(fixed))


def warning_of(slope: PrecisionSlope, points: Sequence[Point]) -> str | None:
    """Return a sentence where a slope disagrees with theory, with the likeliest reason; None where it agrees."""
    if slope.agrees is not False or slope.theory is None:
        return None
    what = f"{slope.control or slope.quantity} by {slope.estimator}" + ("" if slope.measure == "error" else ", margin")
    said = f"{what}: the error falls with slope {slope.slope:.2f} against {slope.against}"
    said += f" (95 %: {slope.interval[0]:.2f} to {slope.interval[1]:.2f}), theory says {slope.theory:g}"
    return f"{said}{' or steeper' if slope.or_steeper else ''}: {_reason(slope, points)}"


def _reason(slope: PrecisionSlope, points: Sequence[Point]) -> str:
    if slope.slope > (slope.theory or 0.0):
        if levels_off(points):
            return "it levels off: a bias is left that no samples remove"
        return "heavy-tailed noise, clipping at few samples or a bias"
    return "the fewest samples are not in the asymptotic range yet"


def levels_off(points: Sequence[Point]) -> bool:
    """Whether the last step between known points is less than half as steep as the first ones were."""
    known = sorted((point for point in points if point.known), key=lambda point: point.setting.spp)
    steps = [
        math.log(b.error / a.error) / math.log(b.setting.spp / a.setting.spp)
        for a, b in pairwise(known)
        if b.setting.spp > a.setting.spp
    ]
    return len(steps) >= 2 and steps[-1] > 0.5 * min(*steps[:-1], 0.0)


def recommend(
    lines: Mapping[tuple[str, str, str], Sequence[Point]],
    goal: float,
    round_up: RoundUp | None = None,
    theories: Mapping[tuple[str, str, str], Theory] | None = None,
) -> Recommended | None:
    """Return the setting with the least time that reaches a relative error, over 0, by the points of each line; None
    where none is known to. `round_up` says what sample counts a series takes, `theories` what slope a line has where
    its points are too few to tell."""
    found = [
        one
        for line, points in lines.items()
        if (one := reaching(points, goal, round_up, (theories or {}).get(line, UNKNOWN))) is not None
    ]
    return min(found, key=lambda one: one.seconds or 0.0, default=None)


def reaching(
    points: Sequence[Point], goal: float, round_up: RoundUp | None = None, theory: Theory = UNKNOWN
) -> Recommended | None:
    """Return the least sample count at which one line reaches a goal, and what it takes there.

    Where the fitted line goes through the interval of every known point, of at least four, it stands for them: it
    knows more than any one of them. Elsewhere the error is interpolated between points on logarithmic axes; beyond the
    last one it follows the fitted slope, or that of theory where points are too few for a fit, at most `FURTHEST` times
    as far, and not at all where the line levels off. A limit counts as an error of that size. Time is interpolated, and
    beyond the last point grows with the samples.
    """
    if not points or not goal > 0.0:
        return None
    ordered = sorted(points, key=lambda point: point.setting.spp)
    setting = ordered[0].setting
    fitted = _explaining(ordered)
    count, basis = _samples_for(ordered, goal, theory) if fitted is None else _on_line(fitted, ordered, goal)
    if count is None:
        return None
    spp = (round_up or (lambda _, samples: math.ceil(samples - 1e-9)))(setting.series, count)
    return Recommended(
        quantity=setting.quantity,
        control=setting.control or None,
        measure=ordered[0].measure,
        among=None,
        goal=goal,
        estimator=setting.series,
        spp=spp,
        seconds=_number_at(ordered, spp, "seconds"),
        error=_number_at(ordered, spp, "error") if fitted is None else _line_at(fitted, spp),
        basis=basis,
    )


def confirm_recommendation(one: Recommended, point: Point, round_up: RoundUp) -> Recommended:
    """Return a recommendation that rests on a point measured after it was chosen, with seeds of its own.

    What looks cheapest among noisy points is mostly a lucky one, and its error looks smaller than it is. New
    measurements don't have that bias: what they say is promised. Where it is more than the goal, the sample count grows
    as independent samples need it, by (error / goal)^2, at most `FURTHEST` times, and the error shrinks by the root.
    """
    assert one.goal is not None and one.spp is not None and one.estimator is not None
    more = min(FURTHEST, max(1.0, (point.error / one.goal) ** 2))
    spp = round_up(one.estimator, one.spp * more)
    times = spp / one.spp
    return one.model_copy(
        update={
            "spp": spp,
            "seconds": point.seconds * times,
            "error": point.error / math.sqrt(times),
            "basis": "confirmed",
            "repeats": point.repeats,
        }
    )


def _explaining(ordered: Sequence[Point]) -> PrecisionSlope | None:
    """The fitted line, if it falls and goes through the intervals of all known points, of at least four."""
    line = fit_line(ordered)
    if line is None or line.points < LEAST_POINTS + 1 or line.slope > -0.1:
        return None
    known = [point for point in ordered if point.known]
    through = all(point.interval[0] <= _line_at(line, point.setting.spp) <= point.interval[1] for point in known)
    return line if through else None


def _on_line(line: PrecisionSlope, ordered: Sequence[Point], goal: float) -> tuple[float | None, str]:
    """The samples at which a fitted line reaches a goal."""
    least, largest = ordered[0].setting.spp, ordered[-1].setting.spp
    count = math.exp((math.log(goal) - line.offset) / line.slope)
    if count > FURTHEST * largest:
        return None, ""
    return max(count, float(least)), "measured" if count <= least else "fitted" if count <= largest else "extrapolated"


def _line_at(line: PrecisionSlope, spp: int) -> float:
    return math.exp(line.offset + line.slope * math.log(spp))


def _samples_for(ordered: Sequence[Point], goal: float, theory: Theory) -> tuple[float | None, str]:
    """The samples at which ordered points stay at or below a goal from there on."""
    good = None
    for point in reversed(ordered):
        if point.error > goal:
            break
        good = point
    if good is None:
        return _extrapolated(ordered, goal, theory), "extrapolated"
    if good is ordered[0]:
        return float(good.setting.spp), "measured"
    before = ordered[ordered.index(good) - 1]
    share = math.log(before.error / goal) / math.log(before.error / good.error)
    ratio = good.setting.spp / before.setting.spp
    return before.setting.spp * ratio**share, "interpolated"


def _extrapolated(ordered: Sequence[Point], goal: float, theory: Theory) -> float | None:
    line, last = fit_line(ordered), ordered[-1]
    slope = theory.slope if line is None else line.slope
    if slope is None or not last.known or slope > -0.1 or levels_off(ordered):
        return None
    factor = (goal / last.error) ** (1.0 / max(slope, -1.0))
    return last.setting.spp * factor if factor <= FURTHEST else None


def _number_at(ordered: Sequence[Point], spp: int, what: Literal["seconds", "error"]) -> float:
    """A number at a sample count, interpolated, or continued along the last slope (time: in proportion)."""
    if len(ordered) == 1:
        return float(getattr(ordered[0], what)) * (spp / ordered[0].setting.spp if what == "seconds" else 1.0)
    counts = [float(point.setting.spp) for point in ordered]
    values = [math.log(max(1e-300, getattr(point, what))) for point in ordered]
    if spp <= counts[-1]:
        return math.exp(float(np.interp(math.log(spp), np.log(counts), values)))
    line = fit_line(ordered)
    slope = 1.0 if what == "seconds" else (MONTE_CARLO if line is None else max(line.slope, -1.0))
    return math.exp(values[-1] + slope * math.log(spp / counts[-1]))


def _counts(points: Sequence[Point]) -> int:
    return len({point.setting.spp for point in points})


def _agrees(slope: float, half: float, theory: Theory) -> bool | None:
    if theory.slope is None:
        return None
    off = slope - theory.slope if theory.at_most else abs(slope - theory.slope)
    return True if off <= AGREES else None if off <= half else False
