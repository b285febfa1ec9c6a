"""Statistics of repeated measurements: errors, slopes, and the fastest setting.

An error is relative to a reference, which has an error itself. Nothing here renders.
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
"""Numbers of one measurement by name.

They are the relative `error`, `cosine`, `seconds` of processor time, `wall_seconds`,
and `fourth`: the sum of the fourth powers of the relative errors of all values.
(`error` is the root of the sum of their squares.)
"""
RoundUp = Callable[[PrecisionPoint, float], int]
"""Rounds a number of samples up to one that the estimator of a point accepts."""

# a measured error is known if it exceeds this multiple of the reference's error
MIN_ERROR_RATIO = 2.0
# confidence of every interval
CONFIDENCE = 0.95
MIN_TAIL_SIZE = 1000
MIN_ERROR_PIXELS = 100
"""Limits of heavy tails.

For a value of at least `MIN_TAIL_SIZE` numbers, the effective number of pixels that
have the error is estimated, over all measurements together. If it is less than
`MIN_ERROR_PIXELS`, a few noisy pixels decide the error, and an interval would cover the
truth too rarely (`benchmarks/precision.py --intervals`).
"""
# maximum difference from theory of a slope that agrees with it, whatever its interval
SLOPE_TOLERANCE = 0.1
# slope of the error of a mean of independent samples against their number
MONTE_CARLO_SLOPE = -0.5
# multiple of the largest measured sample count up to which an error is extrapolated
MAX_EXTRAPOLATION = 16.0
# minimum number of different sample counts of a fit
MIN_FIT_POINTS = 3
# Maximum slope of a line that is used for a recommendation. A flatter line reaches an
# error only with sample counts far beyond the measured ones.
MAX_FALLING_SLOPE = -0.1
# Minimum slope of an extrapolation: a line that is steeper between points is
# extrapolated with this slope.
MIN_EXTRAPOLATED_SLOPE = -1.0


@dataclass(frozen=True)
class SampleSetting:
    """A way to compute a quantity: an estimator with a sample count.

    Attributes:
        quantity: "picture", "margin" or "gradient".
        estimator: name of the sampler with the denoiser, or of the gradient estimator.
        spp: samples per pixel.
        relative_cost: expected time, in any unit.
        control: for a gradient, the name of its part, such as a control; else empty.
        family: for an image, its denoiser; only settings of the same family are
            compared for a recommendation. Empty for gradients.
    """

    quantity: str
    estimator: str
    spp: int
    relative_cost: float
    control: str = ""
    family: str = ""

    @property
    def estimator_key(self) -> tuple[str, str, str]:
        """The key of a line: settings that differ only in the number of samples."""
        return self.quantity, self.control, self.estimator


@dataclass(frozen=True, eq=False)
class ReferenceValue:
    """A value that is used as the truth, with its error.

    Attributes:
        value: (n,) the value.
        error: relative error of the value.
        norm: norm of the value.
        n_parts: number of independent parts whose mean it is.
    """

    value: Float64Array
    error: float
    norm: float
    n_parts: int

    def compare(self, value: Float64Array) -> dict[str, float]:
        """Compare a value (n,) with the reference.

        Returns:
            "error": norm of the difference, divided by the norm of the reference.
            "cosine": cosine of the angle between both; NaN if one of them is zero.
            "fourth": sum of the fourth powers of the differences of all n numbers, each
            divided by the norm of the reference. `is_heavy_tailed` needs it: it is
            large if a few numbers have most of the error. NaN if there are too few
            numbers (`MIN_TAIL_SIZE`) for that, or if the reference is zero.
        """
        difference = value - self.value
        product_of_norms = float(np.linalg.norm(value)) * self.norm
        cosine = math.nan
        if product_of_norms > 0.0:
            cosine = float(value @ self.value) / product_of_norms
        can_detect_tails = len(value) >= MIN_TAIL_SIZE and self.norm > 0.0
        fourth = math.nan
        if can_detect_tails:
            fourth = float(np.sum((difference / self.norm) ** 4))
        return {
            "error": relative_error(float(np.linalg.norm(difference)), self.norm),
            "cosine": cosine,
            "fourth": fourth,
        }


def estimate_reference(
    parts: Sequence[Float64Array],
    function: Callable[[Float64Array], Float64Array] = lambda mean: mean,
    bias: float = 0.0,
) -> ReferenceValue:
    """Return a function of the mean of independent parts, with its jackknife error.

    The jackknife (Efron 1982, chapter 3) computes the function again without each part
    in turn. Let v be the value with all K parts, v_i the value without part i, and m
    the mean of the v_i. Then the standard error is sqrt((K - 1) / K * sum |v_i - m|^2).
    Noise causes a bias in a nonlinear function; it is estimated by (K - 1) * |m - v|,
    from which the standard error is subtracted (down to 0). The error is the root of
    the sum of squares of the standard error, that bias, and the known `bias`.

    Args:
        parts: K independent estimates (n,) of the same quantity.
        function: function of the mean, from (n,) to (m,). For example, it applies a
            tone curve, or computes a model's margin.
        bias: a known bias of the value.

    Raises:
        ValueError: there are fewer than two parts.
    """
    count = len(parts)
    if count < 2:
        raise ValueError(
            f"reference: expected at least two independent parts, got {count}"
        )
    total = np.sum(parts, axis=0)
    value = function(total / count)
    # for each part, the function of the mean of all others
    jackknife_values = [function((total - part) / (count - 1)) for part in parts]
    center = np.mean(jackknife_values, axis=0)
    scatter = _compute_scatter(jackknife_values, center)
    noise_bias = _estimate_noise_bias(center - value, count, scatter)
    norm = float(np.linalg.norm(value))
    error = math.hypot(scatter, noise_bias, bias)
    return ReferenceValue(
        value, error=relative_error(error, norm), norm=norm, n_parts=count
    )


def _estimate_noise_bias(shift: Float64Array, count: int, scatter: float) -> float:
    """Estimate the bias that noise causes in a value, as far as it is no chance.

    Args:
        shift: (m,) mean of the jackknife's values minus the value with all parts.
        count: number of parts.
        scatter: standard error of the value.
    """
    # Two parts are too few to estimate a bias.
    bias_estimate = 0.0
    if count > 2:
        bias_estimate = (count - 1) * float(np.linalg.norm(shift))
    # The estimate of the bias has about the same standard error as the value. So a bias
    # up to this size may be chance, and the standard error is already counted.
    return max(0.0, bias_estimate - scatter)


def _compute_scatter(
    jackknife_values: Sequence[Float64Array], center: Float64Array
) -> float:
    """Compute the jackknife's standard error of a value.

    Args:
        jackknife_values: the value (m,) without each part in turn.
        center: (m,) their mean.
    """
    count = len(jackknife_values)
    sum_of_squares = sum(
        float(np.sum((jackknife_value - center) ** 2))
        for jackknife_value in jackknife_values
    )
    return math.sqrt((count - 1) / count * sum_of_squares)


def summarize_samples(
    setting: SampleSetting, samples: Sequence[Numbers], reference_error: float = 0.0
) -> PrecisionPoint:
    """Estimate the error of a setting from repeated measurements.

    A measured error contains the error of the reference, too. Both are independent, so
    that their squares add: the mean square of the measured errors is error^2 +
    reference_error^2. If its root is below `MIN_ERROR_RATIO` times the reference's
    error, it may be mostly that error. Then the error of the setting is not known, and
    the root is an upper limit (status "reference unusable"). The same holds if all
    measured errors are 0, or if one is infinite. The interval is computed from the
    standard error of the mean square. There is none for a single measurement, nor with
    heavy tails.

    Args:
        setting: the setting that was measured.
        samples: the measurements, each with its relative "error", and with "cosine" and
            times if they are known. All have the same names.
        reference_error: relative error of the reference.
    """
    squares = [numbers["error"] ** 2 for numbers in samples]
    mean_square = statistics.fmean(squares)
    is_known = _is_error_known(mean_square, reference_error)
    error = math.sqrt(mean_square)
    if is_known:
        error = math.sqrt(mean_square - reference_error**2)
    # whether a few pixels have most of the error
    is_heavy = is_heavy_tailed(samples)
    interval = None
    if is_known and not is_heavy and len(squares) > 1:
        interval = _estimate_error_interval(error, squares)
    fields: dict[str, object] = {
        "repeats": len(samples),
        "status": "ok" if is_known else "reference unusable",
        "error": error,
        "interval": interval,
        "reference_error": reference_error,
        "heavy_tailed": is_heavy,
        "cosine": _average_cosine(samples) if setting.quantity == "gradient" else None,
        **_find_median_times(samples),
    }
    return PrecisionPoint.from_values({**vars(setting), **fields})


def _is_error_known(mean_square: float, reference_error: float) -> bool:
    """Return whether a mean square error is clearly larger than that of the reference."""
    exceeds_reference = mean_square > (MIN_ERROR_RATIO * reference_error) ** 2
    return exceeds_reference and math.isfinite(mean_square) and mean_square > 0.0


def _find_median_times(samples: Sequence[Numbers]) -> dict[str, float]:
    """Return the median of each of the times that the measurements have."""
    return {
        name: median_time([numbers[name] for numbers in samples])
        for name in ("seconds", "wall_seconds")
        if name in samples[0]
    }


def _average_cosine(samples: Sequence[Numbers]) -> float | None:
    """Return the mean cosine of the measurements that have one; None without any."""
    cosines = [numbers["cosine"] for numbers in samples if "cosine" in numbers]
    return statistics.fmean(cosines) if cosines else None


# upper limit of the logarithm of an interval's factor, so that exp does not overflow
MAX_LOG_FACTOR = 50.0


def _estimate_error_interval(
    error: float, squares: Sequence[float]
) -> tuple[float, float]:
    """Return the interval of an error, from the squares of the measured errors.

    The error has about the same relative deviation as the root of their mean.
    """
    factor = _interval_factor(squares, statistics.fmean(squares))
    return error / factor, error * factor


def _interval_factor(squares: Sequence[float], mean_square: float) -> float:
    """Return the factor between a root mean square and either bound of its interval.

    The interval is symmetric on a logarithmic scale: its lower bound is the root mean
    square divided by the factor, and its upper bound is the product of both.

    Args:
        squares: squares of at least two measured errors.
        mean_square: their mean.
    """
    standard_error = statistics.stdev(squares) / math.sqrt(len(squares))
    quantile = float(stdtrit(len(squares) - 1, (1.0 + CONFIDENCE) / 2.0))
    # The relative error of a root is half of that of its square. It is about the
    # standard error of the root's logarithm.
    log_deviation = 0.5 * standard_error / mean_square
    return math.exp(min(MAX_LOG_FACTOR, quantile * log_deviation))


def is_heavy_tailed(samples: Sequence[Numbers]) -> bool:
    """Return whether a few pixels have most of the error of the images.

    If n pixels of all images had equal errors and all others none, (sum of squares)^2 /
    (sum of fourth powers) would be n. So this is the effective number of pixels, and it
    is small if it is less than `MIN_ERROR_PIXELS`. False if the images are too small.
    Rare events that are in none of the images, such as a firefly in every hundredth
    image, cannot be detected.

    Args:
        samples: for each image the root of the sum of squares of its pixels' errors
            ("error"), and the sum of their fourth powers ("fourth").
    """
    sum_of_squares = sum(numbers["error"] ** 2 for numbers in samples)
    # NaN without fourth powers, which makes the result false
    sum_of_fourths = sum(numbers.get("fourth", math.nan) for numbers in samples)
    return (
        sum_of_fourths > 0.0 and sum_of_squares**2 < MIN_ERROR_PIXELS * sum_of_fourths
    )


def median_time(seconds: Sequence[float]) -> float:
    """Return the median of times without warm-up calls.

    If there are only warm-up calls, it is the time of the last one.
    """
    return statistics.median(seconds[WARM_UP_CALLS:] or seconds[-1:])


def relative_error(error: float, size: float) -> float:
    """Divide an error by a norm.

    If the norm is 0, the result is infinite, or 0 if the error is 0, too.
    """
    if size > 0.0:
        return error / size
    return 0.0 if error == 0.0 else math.inf


def fit_line(
    points: Sequence[PrecisionPoint], or_steeper: bool | None = None
) -> PrecisionSlope | None:
    """Fit the line of log error against log samples by least squares.

    Only points with a known error are used, since the others have only an upper limit.
    The result is None if these have fewer than `MIN_FIT_POINTS` different sample
    counts.

    The slope agrees with theory if it differs from `MONTE_CARLO_SLOPE` by at most
    `SLOPE_TOLERANCE`. It disagrees if it differs by more, and the predicted slope is
    also outside of its interval. Otherwise `agrees` is None: not known.

    Args:
        points: points of one estimator.
        or_steeper: whether a steeper slope agrees with theory, too, as for stratified
            samples. None if theory predicts no slope; then `agrees` is None.
    """
    known = [point for point in points if point.has_known_error]
    if len({point.spp for point in known}) < MIN_FIT_POINTS:
        return None
    log_counts = np.log([float(point.spp) for point in known])
    line = linregress(log_counts, np.log([point.rms_error for point in known]))
    slope = float(line.slope)
    half_width = _find_t_quantile(len(known)) * float(line.stderr)
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
        agrees=_agrees_with_theory(slope, half_width, or_steeper),
    )


def _find_t_quantile(n_points: int) -> float:
    """Return half the width of a slope's interval in units of its standard error.

    It is a quantile of Student's t distribution. A line has two parameters, so that
    `n_points` points leave `n_points` - 2 degrees of freedom.
    """
    return float(stdtrit(n_points - 2, (1.0 + CONFIDENCE) / 2.0))


def _agrees_with_theory(
    slope: float, half_width: float, or_steeper: bool | None
) -> bool | None:
    """Return whether a slope agrees with theory; None if that is not known.

    Args:
        slope: slope of log error against log samples.
        half_width: half the width of its interval.
        or_steeper: whether a steeper slope agrees, too; None if theory predicts no
            slope.
    """
    if or_steeper is None:
        return None
    # Slopes are negative: a steeper slope has a negative deviation, which is never too
    # large.
    deviation = slope - MONTE_CARLO_SLOPE
    if not or_steeper:
        deviation = abs(deviation)
    if deviation <= SLOPE_TOLERANCE:
        return True
    is_within_noise = deviation <= half_width
    return None if is_within_noise else False


def describe_disagreement(
    slope: PrecisionSlope, points: Sequence[PrecisionPoint]
) -> str | None:
    """Describe how a slope disagrees with theory, and the most likely reason.

    None if it agrees.
    """
    disagrees = slope.agrees is False  # None if it is not known
    if not disagrees or slope.theory is None:
        return None
    # Slopes are negative: the smaller, the steeper.
    is_steeper = slope.slope <= slope.theory
    return (
        f"{slope.control or slope.quantity} by {slope.estimator}: the error falls with "
        f"slope {slope.slope:.2f} against "
        f"samples (95 %: {slope.interval[0]:.2f} to {slope.interval[1]:.2f}), theory "
        f"predicts {slope.theory:g}"
        f"{' or steeper' if slope.or_steeper else ''}: "
        f"{_explain_disagreement(is_steeper, points)}"
    )


def _explain_disagreement(is_steeper: bool, points: Sequence[PrecisionPoint]) -> str:
    """Return the most likely reason for a slope that disagrees with theory."""
    if is_steeper:
        return "the smallest sample counts are not in the asymptotic range yet"
    if has_leveled_off(points):
        return "it levels off: there is a bias, which more samples do not remove"
    return "heavy-tailed noise, clipping with few samples, or a bias"


def has_leveled_off(points: Sequence[PrecisionPoint]) -> bool:
    """Return whether the error has stopped falling, as with a bias.

    It has if the slope between the last two known points is less than half as steep as
    the steepest slope before.
    """
    known = sorted(
        (point for point in points if point.has_known_error),
        key=lambda point: point.spp,
    )
    slopes = [
        math.log(b.rms_error / a.rms_error) / math.log(b.spp / a.spp)
        for a, b in pairwise(known)
        if b.spp > a.spp
    ]
    if len(slopes) < 2:
        return False
    # Slopes are negative: the smaller, the steeper. If the error rises everywhere, 0
    # takes the place of the steepest slope.
    steepest_before = min(*slopes[:-1], 0.0)
    return slopes[-1] > 0.5 * steepest_before


def round_up_exactly(point: PrecisionPoint, samples: float) -> int:
    """Return the next whole number of samples."""
    return math.ceil(samples - 1e-9)  # rounding errors must not add a sample


def recommend_spp(
    points: Sequence[PrecisionPoint],
    goal: float,
    round_up: RoundUp = round_up_exactly,
    or_steeper: bool | None = None,
) -> Recommended | None:
    """Return the smallest sample count at which one estimator reaches a relative error.

    A line is fitted to the logarithms of error and samples. If it has more than
    `MIN_FIT_POINTS` points and passes through the intervals of all of them, the count
    is computed from the line. Otherwise the error is interpolated between the points on
    logarithmic axes. Beyond the last point the error follows the slope of the line, or
    the slope that theory predicts if there are too few points for a line. It is
    extrapolated to at most `MAX_EXTRAPOLATION` times the samples, and not at all if the
    error has leveled off. An upper limit counts as an error of that size. The time is
    interpolated as well; beyond the last point it is proportional to the samples.

    Args:
        points: points of one estimator.
        goal: relative error that has to be reached.
        round_up: rounds up to a sample count that the estimator accepts.
        or_steeper: whether the error may fall faster than that of independent samples;
            None if theory predicts no slope. Without a line, the error is extrapolated
            only if theory predicts a slope.

    Returns:
        The recommendation; None if no count is known to reach the goal.
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
        error = _interpolate_error(ordered, spp, line)
    return Recommended(
        quantity=ordered[0].quantity,
        control=ordered[0].control,
        goal=goal,
        estimator=ordered[0].estimator,
        spp=spp,
        seconds=_interpolate_seconds(ordered, spp),
        error=error,
        basis=basis,
    )


def _error_on_line(line: PrecisionSlope, spp: float) -> float:
    """Return the relative error that a fitted line has at a number of samples."""
    return math.exp(line.offset + line.slope * math.log(spp))


def _explains_points(line: PrecisionSlope, ordered: Sequence[PrecisionPoint]) -> bool:
    """Return whether a falling line passes through the interval of every known point.

    With only `MIN_FIT_POINTS` points a line nearly always does, which is no evidence:
    then the result is False. It is False, too, if a known point has no interval.
    """
    has_enough_points = line.points > MIN_FIT_POINTS
    is_falling = line.slope <= MAX_FALLING_SLOPE  # a negative number
    if not has_enough_points or not is_falling:
        return False
    for point in ordered:
        if not point.has_known_error:
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
    """Return the number of samples at which a fitted line reaches a goal.

    The line is log(error) = offset + slope * log(samples), which is solved for the
    samples.

    Args:
        line: the fitted line.
        ordered: its points, by ascending samples.
        goal: relative error that has to be reached.

    Returns:
        The samples, at least the smallest number that was measured; None if they exceed
        `MAX_EXTRAPOLATION` times the largest. And whether this is "measured", "fitted"
        (between measured numbers) or "extrapolated".
    """
    samples = math.exp((math.log(goal) - line.offset) / line.slope)
    smallest = float(ordered[0].spp)
    largest = float(ordered[-1].spp)
    if samples <= smallest:
        return smallest, "measured"
    if samples <= largest:
        return samples, "fitted"
    if samples <= MAX_EXTRAPOLATION * largest:
        return samples, "extrapolated"
    return None, "extrapolated"


def _interpolate_error(
    ordered: Sequence[PrecisionPoint], spp: int, line: PrecisionSlope | None
) -> float:
    """Return the error at a sample count, interpolated between points.

    Args:
        ordered: points by ascending samples.
        spp: the sample count.
        line: fitted line, whose slope the error follows beyond the last point. If it is
            None, the error follows the slope of theory.
    """
    slope = MONTE_CARLO_SLOPE
    if line:
        slope = max(line.slope, MIN_EXTRAPOLATED_SLOPE)
    errors = [point.rms_error for point in ordered]
    return _interpolate_value(ordered, spp, errors, slope)


def _interpolate_seconds(ordered: Sequence[PrecisionPoint], spp: int) -> float:
    """Return the seconds at a sample count, interpolated between points."""
    seconds = [point.seconds for point in ordered]
    # slope 1: beyond the last point, time is proportional to samples
    return _interpolate_value(ordered, spp, seconds, slope=1.0)


def confirm_recommendation(
    recommendation: Recommended,
    point: PrecisionPoint,
    round_up: RoundUp = round_up_exactly,
) -> Recommended:
    """Return a recommendation that is corrected by new measurements of its setting.

    A setting that was selected as the fastest of many is often one whose error was
    measured too small by chance. New measurements with other seeds do not have that
    bias. If their error is above the goal, the sample count is multiplied by (error /
    goal)^2, since the error of independent samples falls with the root of their number.
    The factor is at most `MAX_EXTRAPOLATION`, so that the expected error ("error") may
    still be above the goal. The time is proportional to the sample count.

    Args:
        recommendation: recommendation with a goal and a sample count.
        point: the new measurements of its setting.
        round_up: rounds up to a sample count that the estimator accepts.
    """
    assert recommendation.goal is not None and recommendation.spp is not None
    needed_growth = max(1.0, (point.rms_error / recommendation.goal) ** 2)
    needed_spp = recommendation.spp * min(MAX_EXTRAPOLATION, needed_growth)
    spp = round_up(point, needed_spp)
    # Since the count is rounded up, it may grow by a little more than is needed.
    growth = spp / recommendation.spp
    update = {
        "spp": spp,
        "seconds": point.seconds * growth,
        "error": point.rms_error / math.sqrt(growth),
        "basis": "confirmed",
        "repeats": point.repeats,
    }
    return recommendation.model_copy(update=update)


def _interpolate_count(
    ordered: Sequence[PrecisionPoint],
    goal: float,
    line: PrecisionSlope | None,
    or_steeper: bool | None,
) -> tuple[float | None, str]:
    """Return the number of samples from which the error stays at or below a goal.

    It is interpolated between the last point whose error is above the goal and the next
    point, on logarithmic axes. If there is no next point, it is extrapolated.

    Args:
        ordered: points by ascending samples.
        goal: the relative error.
        line: fitted line, whose slope is used beyond the last point; None if there is
            none, and the slope of theory is used.
        or_steeper: see `_extrapolate_count`.

    Returns:
        The number of samples, or None if it cannot be extrapolated; and whether it is
        "measured", "interpolated" or "extrapolated".
    """
    indices_above = [
        index for index, point in enumerate(ordered) if point.rms_error > goal
    ]
    if not indices_above:
        return float(ordered[0].spp), "measured"
    last_above = indices_above[-1]
    if last_above == len(ordered) - 1:
        return _extrapolate_count(ordered, goal, line, or_steeper), "extrapolated"
    above = ordered[last_above]
    below = ordered[last_above + 1]
    return _interpolate_count_between(above, below, goal), "interpolated"


def _interpolate_count_between(
    above: PrecisionPoint, below: PrecisionPoint, goal: float
) -> float:
    """Return the number of samples at which the error between two points is the goal.

    Samples and error are interpolated on logarithmic axes.

    Args:
        above: point whose error is above the goal.
        below: point with more samples, whose error is at most the goal.
        goal: the relative error.
    """
    # position of the goal between `above` (0) and `below` (1), on a logarithmic scale
    fraction = math.log(above.rms_error / goal) / math.log(
        above.rms_error / below.rms_error
    )
    count: float = above.spp * (below.spp / above.spp) ** fraction
    return count


def _extrapolate_count(
    ordered: Sequence[PrecisionPoint],
    goal: float,
    line: PrecisionSlope | None,
    or_steeper: bool | None,
) -> float | None:
    """Return the samples beyond the last point at which a goal is reached.

    The error follows the slope of the line, or that of theory without a line. The
    result is None if neither is known, if the slope is too flat, if the last error is
    only an upper limit, if the error has leveled off, or if more than
    `MAX_EXTRAPOLATION` times the samples would be needed.

    Args:
        ordered: points by ascending samples.
        goal: the relative error.
        line: fitted line; None if there is none.
        or_steeper: None if theory predicts no slope. Whether it is True or False does
            not matter here.
    """
    last = ordered[-1]
    slope = _choose_extrapolated_slope(line, or_steeper)
    # Slopes are negative: the larger, the flatter.
    is_too_flat = slope is not None and slope > MAX_FALLING_SLOPE
    if slope is None or is_too_flat:
        return None
    if not last.has_known_error or has_leveled_off(ordered):
        return None
    # With a slope that is steeper than this limit, the count would often be too small.
    used_slope = max(slope, MIN_EXTRAPOLATED_SLOPE)
    # error ~ samples^slope, so samples ~ error^(1 / slope)
    factor = (goal / last.rms_error) ** (1.0 / used_slope)
    return last.spp * factor if factor <= MAX_EXTRAPOLATION else None


def _choose_extrapolated_slope(
    line: PrecisionSlope | None, or_steeper: bool | None
) -> float | None:
    """Return the slope of a line, or that of theory; None if neither is known.

    Args:
        line: fitted line; None if there is none.
        or_steeper: None if theory predicts no slope.
    """
    if line:
        return line.slope
    return None if or_steeper is None else MONTE_CARLO_SLOPE


def _interpolate_value(
    ordered: Sequence[PrecisionPoint], spp: int, values: Sequence[float], slope: float
) -> float:
    """Interpolate a value at a sample count, on logarithmic axes.

    Below the first point it is constant; beyond the last point it follows a slope.

    Args:
        ordered: points by ascending samples.
        spp: the sample count.
        values: values of the points, at least 0.
        slope: slope of the logarithm of the value against that of the samples.
    """
    log_counts = np.log([float(point.spp) for point in ordered])
    log_values = np.log([max(1e-300, value) for value in values])  # no log of 0
    log_beyond = max(0.0, math.log(spp) - log_counts[-1])
    log_value = float(np.interp(math.log(spp), log_counts, log_values))
    return math.exp(log_value + slope * log_beyond)
