"""The numbers behind a work-precision diagram: errors of settings against a reference that has an error of its own.

A *setting* is one way to compute a quantity: a series (a sampler, an estimator, a policy) at a sample count. A *point*
is what repeated measurements of a setting say: its error and its time. Nothing here knows how to render.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

Array = npt.NDArray[np.float64]

KNOWN = 2.0
"""Times the reference's own error that a measured one must have to be known."""
LEVEL = 0.95
"""Of every interval."""
WARM_UP = 3
"""Calls of a setting whose times don't count where there are more: the first compiles and records kernels, the second
may record them again, and so may the first one after other scenes were rendered."""


@dataclass(frozen=True)
class MeasuredSetting:
    """One way to compute a quantity.

    Attributes:
        quantity: "image", "gradient" or "objective".
        series: the line it belongs to in the diagram: a sampler, an estimator, a policy.
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


@dataclass(frozen=True)
class Sample:
    """One measurement of a setting.

    Attributes:
        numbers: error by measure ("error", "margin_error"), and other numbers ("cosine").
        seconds: what it took.
    """

    numbers: Mapping[str, float]
    seconds: float


@dataclass(frozen=True)
class Point:
    """What the measurements of one setting say.

    Attributes:
        setting: which.
        measure: "error", or another error that the samples have.
        error: root mean square of the relative error, the reference's own taken off; where it is not known, an upper
            limit: the root mean square as it was measured.
        interval: of the error, 95 %, from the scatter of the samples; (NaN, NaN) for a single one.
        known: whether the error is well above the reference's own.
        floor: the reference's own relative error.
        seconds: median time.
        repeats: samples behind it.
        more: means of the other numbers.
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

    def cosine(self, value: Array) -> float:
        """Return the cosine of the angle between a value and the reference; NaN where one of them is zero."""
        size = float(np.linalg.norm(value)) * self.size
        return float(value @ self.value) / size if size > 0.0 else math.nan


def reference_of(parts: Sequence[Array], bias: float = 0.0) -> ReferenceValue:
    """Return the mean of independent parts with the standard error that their scatter implies.

        error^2 = sum_k |part_k - mean|^2 / (K (K - 1)),      for two halves: |half_1 - half_2| / 2

    Args:
        parts: at least two (n,) arrays from independent noise.
        bias: a further error in the same unit, known to be there; added in squares.
    """
    if len(parts) < 2:
        raise ValueError(f"reference: expected at least two independent parts, got {len(parts)}")
    mean = np.mean(parts, axis=0)
    scatter = sum(float(np.sum((part - mean) ** 2)) for part in parts)
    error = math.hypot(math.sqrt(scatter / (len(parts) * (len(parts) - 1))), bias)
    size = float(np.linalg.norm(mean))
    return ReferenceValue(mean, _ratio(error, size), size, len(parts))


def reference_through(function: Callable[[Array], Array], parts: Sequence[Array]) -> ReferenceValue:
    """Return a function of the mean of independent parts, with its error by the jackknife (Efron 1982, chapter 3).

    For what is no mean itself, such as a picture after its tone curve or a model's margin on it. The error holds the
    jackknife's estimate of bias (noise through a bend) as well as of scatter.

    Args:
        function: from (n,) to (m,) float64.
        parts: at least two (n,) arrays from independent noise.
    """
    if len(parts) < 2:
        raise ValueError(f"reference: expected at least two independent parts, got {len(parts)}")
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
    squares = [sample.numbers[measure] ** 2 for sample in samples]
    raw = statistics.fmean(squares)
    known = raw > (KNOWN * floor) ** 2 and math.isfinite(raw) and raw > 0.0
    error = math.sqrt(raw - floor**2) if known else math.sqrt(raw)
    others = {name for sample in samples for name in sample.numbers if name not in (measure, "error", "margin_error")}
    more = {name: statistics.fmean(sample.numbers[name] for sample in samples) for name in sorted(others)}
    interval = _interval(squares, error, raw) if known else (0.0, math.sqrt(raw))
    return Point(setting, measure, error, interval, known, floor, typical_seconds(samples), len(samples), more)


def typical_seconds(samples: Sequence[Sample]) -> float:
    """Return the median time without the calls that warm up; of the last call where there are no others."""
    seconds = [sample.seconds for sample in samples]
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
