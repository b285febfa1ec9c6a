"""Statistics of repeated measurements: errors, slopes, and the fastest setting.

An error is relative to a reference that has an error of its own. Nothing here renders.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit
from scipy.stats import linregress

from advsearch.questions.precision.result import (
    WARM_UP_CALLS,
    PrecisionPoint,
    PrecisionSlope,
    Recommended,
)

Float64Array = npt.NDArray[np.float64]
Numbers = Mapping[str, float]
"""One measurement: `error`, `cosine`, `seconds` of processor time and others; `fourth`
is the sum of the fourth powers of all relative errors in a picture, whose squares
`error` adds up.
"""
RoundUp = Callable[[PrecisionPoint, float], int]
"""From a point and a number of samples to the next number that its setting takes."""

# multiple of the reference's own error above which a measured error is known
MIN_ERROR_RATIO = 2.0
# confidence of every interval
CONFIDENCE = 0.95
MIN_TAIL_SIZE = 1000
MIN_ERROR_PIXELS = 100
"""Limits of heavy tails.

For values of at least `MIN_TAIL_SIZE` numbers it is checked how many of them hold the
error. If these are fewer than `MIN_ERROR_PIXELS`, in all measurements together, a few
noisy pixels decide it, and an interval would cover the truth too rarely
(`benchmarks/precision.py
--intervals`).
"""
# difference from theory that a slope may have, whatever its interval
SLOPE_TOLERANCE = 0.1
# slope of the error of a mean of independent samples against their number
MONTE_CARLO_SLOPE = -0.5
# multiple of the largest measured sample count up to which an error is extrapolated
MAX_EXTRAPOLATION = 16.0
# minimum number of points of a fit
MIN_FIT_POINTS = 3


@dataclass(frozen=True)
class SampleSetting:
    """A way to compute a quantity: an estimator with a sample count.

    `cost` is the expected time in any unit; settings are recommended within a `family`.
    """

    quantity: str
    estimator: str
    spp: int
    cost: float
    control: str = ""
    family: str = ""

    @property
    def line(self) -> tuple[str, str, str]:
        return self.quantity, self.control, self.estimator


@dataclass(frozen=True, eq=False)
class ReferenceValue:
    """A value (n,) that stands for the truth, with its relative error.

    `norm` is its norm, `parts` the number of independent parts that it is the mean of.
    """

    value: Float64Array
    error: float
    norm: float
    parts: int

    def compare(self, value: Float64Array) -> dict[str, float]:
        """Compare a value (n,) with the reference.

        Returns:
            `error`, the norm of the difference divided by that of the reference;
            `cosine` of the angle between them; `fourth`, the sum of fourth powers of
            the relative errors of the single numbers. NaN if a norm is zero, and
            `fourth` also if there are too few numbers to tell tails.
        """
        difference = value - self.value
        norm = float(np.linalg.norm(value)) * self.norm
        has_tails = len(value) >= MIN_TAIL_SIZE and self.norm > 0.0
        fourth = math.nan
        if has_tails:
            fourth = float(np.sum((difference / self.norm) ** 4))
        return {
            "error": relative_error(float(np.linalg.norm(difference)), self.norm),
            "cosine": float(value @ self.value) / norm if norm > 0.0 else math.nan,
            "fourth": fourth,
        }


def estimate_reference(
    parts: Sequence[Float64Array],
    function: Callable[[Float64Array], Float64Array] = lambda mean: mean,
    bias: float = 0.0,
) -> ReferenceValue:
    """Return a function of the mean of independent parts, with its jackknife error.

    The jackknife (Efron 1982, chapter 3) of the mean itself is its standard error. A
    function, (n,) to (m,), is for what is no mean, such as a picture after its tone
    curve or a model's margin on it. The error combines, as squares, the jackknife's
    estimates of scatter and of bias (noise through a nonlinear function), and a known
    `bias`.

    Raises:
        ValueError: if there are fewer than two parts.
    """
    count = len(parts)
    if count < 2:
        raise ValueError(
            f"reference: expected at least two independent parts, got {count}"
        )
    total = np.sum(parts, axis=0)
    value = function(total / count)
    jackknife_values = [function((total - part) / (count - 1)) for part in parts]
    center = np.mean(jackknife_values, axis=0)
    scatter = math.sqrt(
        (count - 1)
        / count
        * sum(float(np.sum((each - center) ** 2)) for each in jackknife_values)
    )
    bias_estimate = (
        (count - 1) * float(np.linalg.norm(center - value)) if count > 2 else 0.0
    )
    # the estimate of the bias scatters as much as the value does
    bias_estimate = max(0.0, bias_estimate - scatter)
    size = float(np.linalg.norm(value))
    return ReferenceValue(
        value,
        relative_error(math.hypot(scatter, bias_estimate, bias), size),
        size,
        count,
    )


def summarize_samples(
    setting: SampleSetting, samples: Sequence[Numbers], reference_error: float = 0.0
) -> PrecisionPoint:
    """Estimate the error of a setting from its measurements.

    The noise of the samples and that of the reference (`reference_error`) are
    independent, so that their squares add: error^2 = mean of squares - floor^2. A root
    mean square below `MIN_ERROR_RATIO` times the floor is not known; the result is then
    a limit. The interval comes from the scatter of the squares on a logarithmic scale;
    a single measurement and heavy tails have none.
    """
    squares = [numbers["error"] ** 2 for numbers in samples]
    mean_square = statistics.fmean(squares)
    is_heavy = is_heavy_tailed(samples)
    exceeds_floor = mean_square > (MIN_ERROR_RATIO * reference_error) ** 2
    is_known = exceeds_floor and math.isfinite(mean_square) and mean_square > 0.0
    error = (
        math.sqrt(mean_square - reference_error**2)
        if is_known
        else math.sqrt(mean_square)
    )
    interval = None
    if is_known and not is_heavy and len(squares) > 1:
        deviation = statistics.stdev(squares) / math.sqrt(len(squares))
        factor = _interval_factor(deviation, mean_square, len(squares))
        interval = (error / factor, error * factor)
    cosines = [numbers["cosine"] for numbers in samples if "cosine" in numbers]
    cosine = None
    if cosines and setting.quantity == "gradient":
        cosine = statistics.fmean(cosines)
    fields: dict[str, object] = {
        "repeats": len(samples),
        "status": "ok" if is_known else "reference unusable",
        "error": error,
        "interval": interval,
        "reference_error": reference_error,
        "heavy_tailed": is_heavy,
        "cosine": cosine,
    }
    for name in ("seconds", "wall_seconds"):
        if name in samples[0]:
            fields[name] = median_time([numbers[name] for numbers in samples])
    return PrecisionPoint.of({**vars(setting), **fields})


def _interval_factor(deviation: float, mean_square: float, count: int) -> float:
    """Return the factor of a root mean square's interval, on a logarithmic scale.

    The deviation is the standard error of the mean square of `count` values.
    """
    quantile = float(stdtrit(count - 1, (1.0 + CONFIDENCE) / 2.0))
    return math.exp(min(50.0, quantile * (0.5 * deviation / mean_square)))


def is_heavy_tailed(samples: Sequence[Numbers]) -> bool:
    """Return whether fewer than `MIN_ERROR_PIXELS` pixels hold the error of some
    pictures.

    (sum of squares)^2 / (sum of fourth powers) is their number if all of them were
    equal. False if the pictures are too small to tell. What happens in none of the
    pictures, such as a firefly in every hundredth one, cannot be seen.
    """
    squares = sum(numbers["error"] ** 2 for numbers in samples)
    fourth = sum(numbers.get("fourth", math.nan) for numbers in samples)
    return fourth > 0.0 and squares**2 < MIN_ERROR_PIXELS * fourth


def median_time(seconds: Sequence[float]) -> float:
    """Return the median of times without warm-up calls, or the last one if all are."""
    return statistics.median(seconds[WARM_UP_CALLS:] or seconds[-1:])


def relative_error(error: float, size: float) -> float:
    """Divide an error by a norm; an error of nothing is infinite unless it is 0."""
    if size > 0.0:
        return error / size
    return 0.0 if error == 0.0 else math.inf


def fit_line(
    points: Sequence[PrecisionPoint], or_steeper: bool | None = None
) -> PrecisionSlope | None:
    """Fit the line of log error against log samples by least squares.

    Only points with a known error count: one below the reference's own error says
    nothing. None if fewer than `MIN_FIT_POINTS` are left. Theory says
    `MONTE_CARLO_SLOPE`, `or_steeper`, or nothing (None). A slope disagrees if its
    interval excludes theory
    *and* it differs by more than `SLOPE_TOLERANCE`.
    """
    known = [point for point in points if point.is_known]
    if len({point.spp for point in known}) < MIN_FIT_POINTS:
        return None
    line = linregress(
        np.log([float(point.spp) for point in known]),
        np.log([point.rms for point in known]),
    )
    slope = float(line.slope)
    half_width = float(stdtrit(len(known) - 2, (1.0 + CONFIDENCE) / 2.0)) * float(
        line.stderr
    )
    difference = (
        slope - MONTE_CARLO_SLOPE if or_steeper else abs(slope - MONTE_CARLO_SLOPE)
    )
    agrees: bool | None = False
    if difference <= SLOPE_TOLERANCE:
        agrees = True
    elif difference <= half_width:
        agrees = None
    if or_steeper is None:
        agrees = None
    return PrecisionSlope(
        quantity=known[0].quantity,
        control=known[0].control,
        estimator=known[0].estimator,
        slope=slope,
        interval=(slope - half_width, slope + half_width),
        offset=float(line.intercept),
        points=len(known),
        theory=None if or_steeper is None else MONTE_CARLO_SLOPE,
        or_steeper=bool(or_steeper),
        agrees=agrees,
    )


def describe_disagreement(
    slope: PrecisionSlope, points: Sequence[PrecisionPoint]
) -> str | None:
    """Describe how a slope disagrees with theory and the likeliest reason; None if it
    agrees.
    """
    if slope.agrees is not False or slope.theory is None:
        return None
    if slope.slope <= slope.theory:
        reason = "the fewest samples are not in the asymptotic range yet"
    elif has_leveled_off(points):
        reason = "it levels off: a bias is left that no samples remove"
    else:
        reason = "heavy-tailed noise, clipping at few samples or a bias"
    return (
        f"{slope.control or slope.quantity} by {slope.estimator}: the error falls with "
        f"slope {slope.slope:.2f} against "
        f"samples (95 %: {slope.interval[0]:.2f} to {slope.interval[1]:.2f}), theory "
        f"says {slope.theory:g}"
        f"{' or steeper' if slope.or_steeper else ''}: {reason}"
    )


def has_leveled_off(points: Sequence[PrecisionPoint]) -> bool:
    """Return whether the last step between known points is much flatter than the first
    ones.

    That is less than half as steep.
    """
    known = sorted(
        (point for point in points if point.is_known), key=lambda point: point.spp
    )
    steps = [
        math.log(b.rms / a.rms) / math.log(b.spp / a.spp)
        for a, b in pairwise(known)
        if b.spp > a.spp
    ]
    return len(steps) >= 2 and steps[-1] > 0.5 * min(*steps[:-1], 0.0)


def round_up_exactly(point: PrecisionPoint, samples: float) -> int:
    """Return the next whole number of samples."""
    return math.ceil(samples - 1e-9)


def recommend_count(
    points: Sequence[PrecisionPoint],
    goal: float,
    round_up: RoundUp = round_up_exactly,
    or_steeper: bool | None = None,
) -> Recommended | None:
    """Return the smallest sample count at which one line reaches a relative error.

    If the fitted line passes through the interval of every known point, of at least
    four, it stands for them. Otherwise the error is interpolated between points on
    logarithmic axes. Beyond the last one it follows the fitted slope, or that of theory
    (see `fit_line`) if points are too few for a fit, at most `MAX_EXTRAPOLATION` times
    as far, and not at all if the line levels off. A limit counts as an error of that
    size. Time is interpolated, and beyond the last point grows with the samples.
    """
    if not points or not goal > 0.0:
        return None
    ordered = sorted(points, key=lambda point: point.spp)
    line = fit_line(ordered)
    explaining_line = line if line and _explains_points(line, ordered) else None
    if explaining_line:
        count, basis = _solve_line(explaining_line, ordered, goal)
    else:
        count, basis = _interpolate_count(ordered, goal, line, or_steeper)
    if count is None:
        return None
    spp = round_up(ordered[0], count)
    if explaining_line:
        error = _error_on_line(explaining_line, spp)
    else:
        slope = max(line.slope, -1.0) if line else MONTE_CARLO_SLOPE
        error = _interpolate_value(
            ordered, spp, [point.rms for point in ordered], slope
        )
    seconds = [point.seconds for point in ordered]
    return Recommended(
        quantity=ordered[0].quantity,
        control=ordered[0].control,
        goal=goal,
        estimator=ordered[0].estimator,
        spp=spp,
        seconds=_interpolate_value(ordered, spp, seconds, 1.0),
        error=error,
        basis=basis,
    )


def _error_on_line(line: PrecisionSlope, spp: float) -> float:
    return math.exp(line.offset + line.slope * math.log(spp))


def _explains_points(line: PrecisionSlope, ordered: Sequence[PrecisionPoint]) -> bool:
    """Return whether a falling line passes through the interval of every known
    point.
    """
    if line.points <= MIN_FIT_POINTS or not line.slope <= -0.1:
        return False
    for point in ordered:
        if not point.is_known:
            continue
        if not point.interval:
            return False
        lower, upper = point.interval
        if not lower <= _error_on_line(line, point.spp) <= upper:
            return False
    return True


def _solve_line(
    line: PrecisionSlope, ordered: Sequence[PrecisionPoint], goal: float
) -> tuple[float | None, str]:
    """Return the samples at which a line reaches a goal, and the basis."""
    samples = math.exp((math.log(goal) - line.offset) / line.slope)
    smallest = float(ordered[0].spp)
    largest = float(ordered[-1].spp)
    if samples <= smallest:
        return smallest, "measured"
    if samples <= largest:
        return samples, "fitted"
    return (None if samples > MAX_EXTRAPOLATION * largest else samples), "extrapolated"


def confirm_recommendation(
    recommendation: Recommended,
    point: PrecisionPoint,
    round_up: RoundUp = round_up_exactly,
) -> Recommended:
    """Return a recommendation that rests on a point measured after it was selected.

    What looks cheapest among noisy points is mostly a lucky one, and its error looks
    smaller than it is. New measurements, with seeds of their own, don't have that bias.
    If their error is above the goal, the sample count grows as independent samples need
    it, by (error / goal)^2, at most `MAX_EXTRAPOLATION` times, and the error shrinks by
    the root.
    """
    assert recommendation.goal is not None and recommendation.spp is not None
    spp = round_up(
        point,
        recommendation.spp
        * min(MAX_EXTRAPOLATION, max(1.0, (point.rms / recommendation.goal) ** 2)),
    )
    times = spp / recommendation.spp
    new = {
        "spp": spp,
        "seconds": point.seconds * times,
        "error": point.rms / math.sqrt(times),
    }
    return recommendation.model_copy(
        update={**new, "basis": "confirmed", "repeats": point.repeats}
    )


def _interpolate_count(
    ordered: Sequence[PrecisionPoint],
    goal: float,
    line: PrecisionSlope | None,
    or_steeper: bool | None,
) -> tuple[float | None, str]:
    """Return the samples from which on ordered points stay at or below a goal, and the
    basis.
    """
    last = ordered[-1]
    if last.rms > goal:
        slope = None
        if line:
            slope = line.slope
        elif or_steeper is not None:
            slope = MONTE_CARLO_SLOPE
        if (
            slope is None
            or not last.is_known
            or slope > -0.1
            or has_leveled_off(ordered)
        ):
            return None, ""
        factor = (goal / last.rms) ** (1.0 / max(slope, -1.0))
        return (
            last.spp * factor if factor <= MAX_EXTRAPOLATION else None
        ), "extrapolated"
    first = (
        max((at for at, point in enumerate(ordered) if point.rms > goal), default=-1)
        + 1
    )
    good = ordered[first]
    if not first:
        return float(good.spp), "measured"
    before = ordered[first - 1]
    fraction = math.log(before.rms / goal) / math.log(before.rms / good.rms)
    return before.spp * (good.spp / before.spp) ** fraction, "interpolated"


def _interpolate_value(
    ordered: Sequence[PrecisionPoint], spp: int, values: Sequence[float], slope: float
) -> float:
    """Interpolate a value at a sample count, on logarithmic axes; beyond, follow a
    slope.
    """
    counts = np.log([float(point.spp) for point in ordered])
    logs = np.log([max(1e-300, value) for value in values])
    beyond = max(0.0, math.log(spp) - counts[-1])
    return math.exp(float(np.interp(math.log(spp), counts, logs)) + slope * beyond)
