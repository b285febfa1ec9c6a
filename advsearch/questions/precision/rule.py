"""What repeated measurements say: the error of a setting beside a reference that has
one of its own, how it falls with the samples, and which setting reaches a goal soonest.
Nothing here knows how to render.
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
    WARM_UP,
    PrecisionPoint,
    PrecisionSlope,
    Recommended,
)

Array = npt.NDArray[np.float64]
Numbers = Mapping[str, float]
"""One measurement: `error`, `cosine`, `seconds` of processor time and others; `fourth`
is the sum of the fourth powers of all relative errors in a picture, whose squares
`error` adds up.
"""
RoundUp = Callable[[PrecisionPoint, float], int]
"""From a point and a number of samples to the next number that its setting takes."""

KNOWN = 2.0  # times the reference's own error that a measured one must have to be known
LEVEL = 0.95  # of every interval
WIDE = 1000
LEAST_VALUES = 100
"""From so many numbers on in a picture or gradient it is looked at how many of them
hold its error. Below so many, in all measurements together, a few noisy pixels decide
it, and an interval would cover the truth too seldom (`benchmarks/precision.py
--intervals`).
"""
AGREES = 0.1  # how far a slope may be from theory, whatever its interval
# slope of the error of a mean of independent samples against their number
MONTE_CARLO = -0.5
FURTHEST = 16.0  # times the largest measured sample count beyond which nothing is said
LEAST_POINTS = 3  # of a fit


@dataclass(frozen=True)
class SampleSetting:
    """One way to compute a quantity: an estimator at a sample count. `cost` is what it
    should take, in any one unit, and `family` what it is recommended among.
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
    """A value (n,) that stands for the truth: its `error`, over its `size`, the norm,
    from independent `parts`.
    """

    value: Array
    error: float
    size: float
    parts: int

    def compare(self, value: Array) -> dict[str, float]:
        """Return how a value (n,) compares: the norm of the difference over that of the
        reference, the cosine of the angle between them, and the sum of the fourth
        powers of the relative errors of the single numbers; NaN where one is zero, or
        where the numbers are too few to say anything about tails.
        """
        away = value - self.value
        norm = float(np.linalg.norm(value)) * self.size
        wide = len(value) >= WIDE and self.size > 0.0
        return {
            "error": relative_error(float(np.linalg.norm(away)), self.size),
            "cosine": float(value @ self.value) / norm if norm > 0.0 else math.nan,
            "fourth": float(np.sum((away / self.size) ** 4)) if wide else math.nan,
        }


def estimate_reference(
    parts: Sequence[Array],
    function: Callable[[Array], Array] = lambda mean: mean,
    bias: float = 0.0,
) -> ReferenceValue:
    """Return a function, (n,) to (m,), of the mean of at least two independent parts,
    with its error by the jackknife (Efron 1982, chapter 3); of the mean itself that is
    its standard error.

    A function is for what is no mean itself, such as a picture after its tone curve or
    a model's margin on it. The error holds the jackknife's estimate of bias (noise
    through a bend) as well as of scatter, and a `bias` that is known to be there, in
    squares.
    """
    count = len(parts)
    if count < 2:
        raise ValueError(
            f"reference: expected at least two independent parts, got {count}"
        )
    total = np.sum(parts, axis=0)
    value = function(total / count)
    without = [function((total - part) / (count - 1)) for part in parts]
    middle = np.mean(without, axis=0)
    scatter = math.sqrt(
        (count - 1)
        / count
        * sum(float(np.sum((each - middle) ** 2)) for each in without)
    )
    bend = (count - 1) * float(np.linalg.norm(middle - value)) if count > 2 else 0.0
    # the estimate of the bias scatters as much as the value does
    bend = max(0.0, bend - scatter)
    size = float(np.linalg.norm(value))
    return ReferenceValue(
        value, relative_error(math.hypot(scatter, bend, bias), size), size, count
    )


def summarize_samples(
    setting: SampleSetting, samples: Sequence[Numbers], floor: float = 0.0
) -> PrecisionPoint:
    """Return what measurements of a setting say about its error, given the reference's
    own (`floor`).

    The samples' noise and the reference's are independent, so their squares add:
    error^2 = mean of squares - floor^2. A root mean square below `KNOWN` times the
    floor is not known; what is given then is a limit. The interval comes from the
    scatter of the squares on a logarithmic scale; there is none of a single one and of
    heavy tails.
    """
    squares = [numbers["error"] ** 2 for numbers in samples]
    raw = statistics.fmean(squares)
    heavy = is_heavy_tailed(samples)
    interval = None
    known = raw > (KNOWN * floor) ** 2 and math.isfinite(raw) and raw > 0.0
    error = math.sqrt(raw - floor**2) if known else math.sqrt(raw)
    if known and not heavy and len(squares) > 1:
        relative = 0.5 * statistics.stdev(squares) / math.sqrt(len(squares)) / raw
        factor = math.exp(
            min(50.0, float(stdtrit(len(squares) - 1, (1.0 + LEVEL) / 2.0)) * relative)
        )
        interval = (error / factor, error * factor)
    time_names = [name for name in ("seconds", "wall_seconds") if name in samples[0]]
    times = {
        name: median_time([numbers[name] for numbers in samples]) for name in time_names
    }
    cosine = [numbers["cosine"] for numbers in samples if "cosine" in numbers]
    status = "ok" if known else "reference unusable"
    more: dict[str, object] = {
        "repeats": len(samples),
        "status": status,
        "error": error,
        "interval": interval,
    }
    more |= {"reference_error": floor, "heavy_tailed": heavy}
    more["cosine"] = (
        statistics.fmean(cosine) if cosine and setting.quantity == "gradient" else None
    )
    return PrecisionPoint.of({**vars(setting), **more, **times})


def is_heavy_tailed(samples: Sequence[Numbers]) -> bool:
    """Whether fewer than `LEAST_VALUES` pixels hold the error of some pictures: (sum of
    squares)^2 / (sum of fourth powers) counts how many, if all of them were equal.
    False where the pictures are too small to tell.

    What happens in none of the pictures, such as a firefly in every hundredth one,
    can't be seen.
    """
    squares = sum(numbers["error"] ** 2 for numbers in samples)
    fourth = sum(numbers.get("fourth", math.nan) for numbers in samples)
    return fourth > 0.0 and squares**2 < LEAST_VALUES * fourth


def median_time(seconds: Sequence[float]) -> float:
    """Return the median of times without those of calls that warm up; the last one
    where there are no others.
    """
    return statistics.median(seconds[WARM_UP:] or seconds[-1:])


def relative_error(error: float, size: float) -> float:
    return error / size if size > 0.0 else (0.0 if error == 0.0 else math.inf)


def fit_line(
    points: Sequence[PrecisionPoint], or_steeper: bool | None = None
) -> PrecisionSlope | None:
    """Return the least-squares line of log error against log samples.

    Only points whose error is known count: one below the reference's own error says
    nothing. None where fewer than `LEAST_POINTS` are left. Theory says `MONTE_CARLO`,
    `or_steeper`, or nothing (None). A slope disagrees where its interval leaves theory
    out *and* it is further than `AGREES` from it.
    """
    known = [point for point in points if point.known]
    if len({point.spp for point in known}) < LEAST_POINTS:
        return None
    line = linregress(
        np.log([float(point.spp) for point in known]),
        np.log([point.rms for point in known]),
    )
    slope = float(line.slope)
    half = float(stdtrit(len(known) - 2, (1.0 + LEVEL) / 2.0)) * float(line.stderr)
    off = slope - MONTE_CARLO if or_steeper else abs(slope - MONTE_CARLO)
    agrees = True if off <= AGREES else None if off <= half else False
    return PrecisionSlope(
        quantity=known[0].quantity, control=known[0].control, estimator=known[0].estimator, slope=slope,
        interval=(slope - half, slope + half), offset=float(line.intercept), points=len(known),
        theory=None if or_steeper is None else MONTE_CARLO, or_steeper=bool(or_steeper),
        agrees=None if or_steeper is None else agrees,
    )  # fmt: skip


def describe_disagreement(
    slope: PrecisionSlope, points: Sequence[PrecisionPoint]
) -> str | None:
    """Return a sentence where a slope disagrees with theory, with the likeliest reason;
    None where it agrees.
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
    """Whether the last step between known points is less than half as steep as the
    first ones were.
    """
    known = sorted(
        (point for point in points if point.known), key=lambda point: point.spp
    )
    steps = [
        math.log(b.rms / a.rms) / math.log(b.spp / a.spp)
        for a, b in pairwise(known)
        if b.spp > a.spp
    ]
    return len(steps) >= 2 and steps[-1] > 0.5 * min(*steps[:-1], 0.0)


def round_up_exactly(point: PrecisionPoint, samples: float) -> int:
    return math.ceil(samples - 1e-9)


def recommend_count(
    points: Sequence[PrecisionPoint],
    goal: float,
    round_up: RoundUp = round_up_exactly,
    or_steeper: bool | None = None,
) -> Recommended | None:
    """Return the least sample count at which one line reaches a relative error, and
    what it takes there.

    Where the fitted line goes through the interval of every known point, of at least
    four, it stands for them: it knows more than any one of them. Elsewhere the error is
    interpolated between points on logarithmic axes; beyond the last one it follows the
    fitted slope, or that of theory (see `fit_line`) where points are too few for a fit,
    at most `FURTHEST` times as far, and not at all where the line levels off. A limit
    counts as an error of that size. Time is interpolated, and beyond the last point
    grows with the samples.
    """
    if not points or not goal > 0.0:
        return None
    ordered = sorted(points, key=lambda point: point.spp)
    known = [point for point in ordered if point.known]
    line = fit_line(ordered)
    falls = max(line.slope, -1.0) if line else MONTE_CARLO

    def fitted(spp: float) -> float:
        return math.exp(line.offset + line.slope * math.log(spp)) if line else math.nan

    explains = (
        line is not None
        and line.points > LEAST_POINTS
        and line.slope <= -0.1
        and all(
            point.interval
            and point.interval[0] <= fitted(point.spp) <= point.interval[1]
            for point in known
        )
    )
    if line is not None and explains:
        samples = math.exp((math.log(goal) - line.offset) / line.slope)
        least = float(ordered[0].spp)
        largest = float(ordered[-1].spp)
        basis = (
            "measured"
            if samples <= least
            else "fitted"
            if samples <= largest
            else "extrapolated"
        )
        count = None if samples > FURTHEST * largest else max(samples, least)
    else:
        count, basis = _interpolate_count(ordered, goal, line, or_steeper)
    if count is None:
        return None
    spp = round_up(ordered[0], count)
    error = (
        fitted(spp)
        if explains
        else _interpolate_value(ordered, spp, [point.rms for point in ordered], falls)
    )
    seconds = _interpolate_value(
        ordered, spp, [point.seconds for point in ordered], 1.0
    )
    return Recommended(
        quantity=ordered[0].quantity, control=ordered[0].control, goal=goal, estimator=ordered[0].estimator, spp=spp,
        seconds=seconds, error=error, basis=basis,
    )  # fmt: skip


def confirm_recommendation(
    found: Recommended, point: PrecisionPoint, round_up: RoundUp = round_up_exactly
) -> Recommended:
    """Return a recommendation that rests on a point measured after it was chosen, with
    seeds of its own.

    What looks cheapest among noisy points is mostly a lucky one, and its error looks
    smaller than it is. New measurements don't have that bias: what they say is
    promised. Where it is more than the goal, the sample count grows as independent
    samples need it, by (error / goal)^2, at most `FURTHEST` times, and the error
    shrinks by the root.
    """
    assert found.goal is not None and found.spp is not None
    spp = round_up(
        point, found.spp * min(FURTHEST, max(1.0, (point.rms / found.goal) ** 2))
    )
    times = spp / found.spp
    new = {
        "spp": spp,
        "seconds": point.seconds * times,
        "error": point.rms / math.sqrt(times),
    }
    return found.model_copy(
        update={**new, "basis": "confirmed", "repeats": point.repeats}
    )


def _interpolate_count(
    ordered: Sequence[PrecisionPoint],
    goal: float,
    line: PrecisionSlope | None,
    or_steeper: bool | None,
) -> tuple[float | None, str]:
    """The samples at which ordered points stay at or below a goal from there on."""
    last = ordered[-1]
    if last.rms > goal:
        slope = line.slope if line else None if or_steeper is None else MONTE_CARLO
        if slope is None or not last.known or slope > -0.1 or has_leveled_off(ordered):
            return None, ""
        factor = (goal / last.rms) ** (1.0 / max(slope, -1.0))
        return (last.spp * factor if factor <= FURTHEST else None), "extrapolated"
    first = (
        max((at for at, point in enumerate(ordered) if point.rms > goal), default=-1)
        + 1
    )
    good = ordered[first]
    if not first:
        return float(good.spp), "measured"
    before = ordered[first - 1]
    share = math.log(before.rms / goal) / math.log(before.rms / good.rms)
    return before.spp * (good.spp / before.spp) ** share, "interpolated"


def _interpolate_value(
    ordered: Sequence[PrecisionPoint], spp: int, values: Sequence[float], slope: float
) -> float:
    """A value at a sample count: interpolated, or continued along a slope, on
    logarithmic axes.
    """
    counts = np.log([float(point.spp) for point in ordered])
    logs = np.log([max(1e-300, value) for value in values])
    beyond = max(0.0, math.log(spp) - counts[-1])
    return math.exp(float(np.interp(math.log(spp), counts, logs)) + slope * beyond)
