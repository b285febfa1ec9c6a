"""Specs of parameters: a fixed value, a range to search, or a list of values.

They are parsed from the settings of a control (docs/controls/README.md):

    pose: {yaw: [0, 360], pitch: 10, scale: {choices: [0.8, 1.0, 1.2]}}

Two numbers in a list are a range; three or more, or names, are a list of values. `{range:
[low, high]}` and `{choices: [...]}` state which of both is meant. A list of values may
have weights, and a parameter may have a distribution. A coordinate u is then a cumulative
probability: if u is uniform, the values follow the distribution.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advsearch.distributions import (
    CHOICES,
    DISTRIBUTION,
    FROM_PYTHON,
    WEIGHTS,
    PythonQuantiles,
    distribution_to_setting,
)
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.settings import Parameter

ParameterValue = float | str

Quantiles = Callable[[NDArray[np.float64]], NDArray[np.float64]]

COMMON_DISTRIBUTIONS = (
    "norm",
    "truncnorm",
    "uniform",
    "triang",
    "beta",
    "lognorm",
    "expon",
    "gamma",
    "vonmises",
)
"""Distributions that the message for an unknown one suggests."""

TAIL_PROBABILITY = 1e-6  # probability that is cut off an infinite tail

# largest probability outside of a parameter's bounds, where a distribution is cut off
MAX_OUTSIDE_PROBABILITY = 0.01

N_CHECKED_QUANTILES = 257  # probabilities at which a function from Python is checked

SLOPE_STEP = 1e-4  # half of the step of a finite difference of quantiles


@dataclass(frozen=True)
class Fixed:
    """One value, not searched."""

    value: ParameterValue

    def __str__(self) -> str:
        return format_value(self.value)


@dataclass(frozen=True)
class OneOf:
    """One of a few values: numbers or names."""

    values: tuple[ParameterValue, ...]

    def __str__(self) -> str:
        return f"one of {', '.join(map(format_value, dict.fromkeys(self.values)))}"

    def select_value(self, u: Tensor) -> ParameterValue:
        """Return the value at a coordinate (): each has an equal part of [0, 1]."""
        index = int(float(u.detach()) * len(self.values))
        return self.values[min(len(self.values) - 1, max(0, index))]


@dataclass(frozen=True)
class Range:
    """Every value from `low` to `high`.

    A coordinate in [0, 1] runs over the values, or with `log` over their logarithms.
    """

    low: float
    high: float

    def __str__(self) -> str:
        return f"from {self.low:g} to {self.high:g}"

    def interpolate(self, u: Tensor, *, log: bool = False) -> Tensor:
        """Return the values at coordinates in [0, 1]; differentiable."""
        if not log:
            return self.low + (self.high - self.low) * u
        low = torch.full_like(u, math.log(self.low))
        high = torch.full_like(u, math.log(self.high))
        return torch.exp(torch.lerp(low, high, u))

    def find_coordinate(self, value: float, *, log: bool = False) -> float:
        """Return the coordinate of a value, clipped to [0, 1]."""
        low = self.low
        high = self.high
        if log:
            value = math.log(max(value, 1e-30))
            low = math.log(low)
            high = math.log(high)
        return min(1.0, max(0.0, (value - low) / (high - low)))


@dataclass(frozen=True)
class DistributionRange(Range):
    """Values from `low` to `high` that follow a distribution.

    Attributes:
        quantiles: inverse distribution function.
        lower_probability: cumulative probability at the coordinate 0; above 0 if the
            distribution is cut off.
        upper_probability: cumulative probability at the coordinate 1.
        distribution_text: the distribution as messages write it, e.g. "norm(loc=20, scale=5)".
    """

    quantiles: Quantiles
    lower_probability: float
    upper_probability: float
    distribution_text: str

    def interpolate(self, u: Tensor, *, log: bool = False) -> Tensor:
        """Return the values at coordinates in [0, 1], quantiles of the distribution.

        Args:
            u: coordinates of any shape. The result is differentiable in them; its
                derivative is the slope of the quantiles, by finite differences.
            log: has no effect; only for compatibility with `Range`.
        """
        values = self._compute_values(u.detach())
        if u.requires_grad:
            upper = (u.detach() + SLOPE_STEP).clamp(max=1.0)
            lower = (u.detach() - SLOPE_STEP).clamp(min=0.0)
            difference = self._compute_values(upper) - self._compute_values(lower)
            slope = difference / (upper - lower)
            # adds 0 to the values, and the slope to their derivative
            values = values + slope * (u - u.detach())
        return values

    def _compute_values(self, u: Tensor) -> Tensor:
        """Return the values at coordinates in [0, 1], without derivatives."""
        width = self.upper_probability - self.lower_probability
        probabilities = self.lower_probability + width * u.double().cpu().numpy()
        values = self.quantiles(np.asarray(probabilities))
        return torch.from_numpy(np.clip(values, self.low, self.high)).to(u)

    def find_coordinate(self, value: float, *, log: bool = False) -> float:
        """Return the coordinate of a value, by bisection on the quantiles.

        Values outside of the range get the nearest coordinate.

        Args:
            value: value of the parameter.
            log: has no effect; only for compatibility with `Range`.
        """
        lower = 0.0
        upper = 1.0
        probability_span = self.upper_probability - self.lower_probability
        # 60 halvings go beyond the precision of a float
        for _ in range(60):
            middle = 0.5 * (lower + upper)
            probability = self.lower_probability + probability_span * middle
            if float(self.quantiles(np.asarray(probability))) < value:
                lower = middle
            else:
                upper = middle
        # For a value beyond the last quantile `upper` is still 1, and coordinates are
        # below 1.
        return upper if upper < 1.0 else lower


Spec = Fixed | Range | OneOf


def to_plain_value(value: object) -> object:
    """Return numbers and arrays of numpy and torch, also in a list, as Python's.

    Distributions are returned as settings.
    """
    value = distribution_to_setting(value)
    if isinstance(value, (list, tuple)):
        return type(value)(map(to_plain_value, value))
    if hasattr(value, "tolist") and hasattr(value, "dtype"):
        return value.tolist()
    return value


def parse_spec(label: str, parameter: Parameter, setting: object) -> Spec:
    """Parse the setting of a parameter.

    Two numbers in a list are a range; names, or three numbers or more, are a choice.

    Args:
        label: name of the parameter in messages, e.g. "pose.yaw".
        parameter: states the allowed values.
        setting: a number or a name, [low, high], a list of values, {"range": [low,
            high]}, {"choices": [...]}, perhaps with "weights", or a distribution.

    Raises:
        InputError: the setting has another form, or a value is outside of the
            parameter's range.
    """
    if isinstance(setting, Mapping):
        if DISTRIBUTION in setting and not parameter.options:
            return parse_distribution(label, parameter, setting)
        is_range = set(setting) == {"range"} and _is_list(setting["range"])
        if not is_range or len(setting["range"]) != 2:
            # choices, or an invalid mapping, for which this raises the error
            return _read_choices(label, parameter, setting)
        setting = setting["range"]
    if not _is_list(setting):
        return Fixed(_check_value(label, parameter, setting))
    return _parse_list(label, parameter, setting)


def _parse_list(
    label: str, parameter: Parameter, setting: Sequence[object]
) -> Range | OneOf:
    """Parse a list: two numbers are a range, and other values a choice."""
    values = [_check_value(label, parameter, value) for value in setting]
    if values and (parameter.options or len(values) > 2):
        return _make_choice(label, values)
    if len(values) != 2:
        raise InputError(
            f"{label}: expected a value, [low, high] or a list of values, got "
            f"{setting!r}"
        )
    low, high = (float(value) for value in values)
    _check_bounds(label, parameter, low, high)
    return Range(low, high)


def _read_choices(
    label: str, parameter: Parameter, setting: Mapping[str, object]
) -> OneOf:
    """Parse {"choices": [...]}, perhaps with "weights"."""
    values = setting.get(CHOICES)
    if not set(setting) <= {CHOICES, WEIGHTS} or not _is_list(values) or not values:
        raise _make_choices_error(label, parameter, setting)
    choice = _make_choice(
        label, [_check_value(label, parameter, value) for value in values]
    )
    if WEIGHTS in setting:
        return _make_weighted_choice(label, choice.values, setting[WEIGHTS])
    return choice


def _make_choices_error(
    label: str, parameter: Parameter, setting: Mapping[str, object]
) -> InputError:
    """Return the error for a mapping that is no spec of a parameter."""
    distribution = "" if parameter.options else " or {distribution: NAME, ...}"
    return InputError(
        f"{label}: expected {{range: [low, high]}}, {{choices: [value, ...]}}, "
        f"{{choices: [value, ...], "
        f"weights: [number, ...]}}{distribution}, got {dict(setting)!r}"
    )


def _check_bounds(where: str, parameter: Parameter, low: float, high: float) -> None:
    """Check the bounds of a range.

    Args:
        where: name of the parameter, for messages.
        parameter: states whether it is an angle, and whether it has a logarithmic
            scale.
        low, high: bounds of the range.

    Raises:
        InputError: the bounds are equal or reversed, or not positive on a logarithmic
            scale.
    """
    if low == high:
        raise InputError(
            f"{where}: the range [{low:g}, {high:g}] has no size; write "
            f"{low:g} to fix the value"
        )
    if low > high:
        remedy = _explain_reversed_bounds(parameter, low, high)
        raise InputError(
            f"{where}: the range [{low:g}, {high:g}] is reversed; {remedy}"
        )
    if parameter.log and low <= 0.0:
        raise InputError(
            f"{where}: expected a range over 0 (it is searched on a "
            f"logarithmic scale), got {low:g}"
        )


def _explain_reversed_bounds(parameter: Parameter, low: float, high: float) -> str:
    """Return the end of a message on reversed bounds, of which `low` is the larger."""
    # [350, 10] may be meant as the 20 degrees through 0. With a full turn or more
    # between the bounds, as in [400, 10], there is no such interval.
    may_be_through_zero = low - high < FULL_TURN
    if parameter.periodic and may_be_through_zero:
        return _explain_reversed_angles(parameter, low, high)
    return f"write [{high:g}, {low:g}]"


def _explain_reversed_angles(parameter: Parameter, low: float, high: float) -> str:
    """Return the end of a message on a reversed range of angles, such as [350, 10].

    The user may have meant the 20 degrees through 0, or the 340 degrees between 10 and
    350. The message explains how to write each as an ascending range: "write [-10, 10]
    for the 20 degrees from 350 through 0 to 10, or [10, 350] for the other 340".

    Args:
        parameter: parameter that is an angle, in degrees.
        low: first bound as the user wrote it, which is the larger one.
        high: second bound.
    """
    begin, end = _find_interval_through_zero(parameter, low, high)
    # the angle that lies between both, which is 0 or 360
    inner_turn = 0 if begin <= 0 else FULL_TURN
    inner_width = FULL_TURN - low + high
    return (
        f"write [{begin:g}, {end:g}] for the {inner_width:g} "
        f"degrees from {low:g} through "
        f"{inner_turn:g} to {high:g}, or [{high:g}, {low:g}] "
        f"for the other {low - high:g}"
    )


def _find_interval_through_zero(
    parameter: Parameter, low: float, high: float
) -> tuple[float, float]:
    """Return an interval of angles that passes 0 or 360 degrees in ascending order.

    [350, 10] becomes [-10, 10]; or [350, 370] if the parameter has no values below 0.
    The arguments are those of `_explain_reversed_angles`.
    """
    if low - FULL_TURN >= parameter.low:
        return low - FULL_TURN, high
    return low, high + FULL_TURN


def _make_choice(where: str, values: Sequence[ParameterValue]) -> OneOf:
    """Return a choice among values.

    Raises:
        InputError: a value is there twice, so that it would be selected twice as often.
    """
    repeated = [value for value, count in Counter(values).items() if count > 1]
    if repeated:
        raise InputError(
            f"{where}: expected different choices, got {format_value(repeated[0])} "
            "twice; leave one of them out"
        )
    return OneOf(tuple(values))


MAX_REPEATS = 1000  # largest number of values that a weighted choice is repeated to


def _make_weighted_choice(
    where: str, values: Sequence[ParameterValue], weights: object
) -> OneOf:
    """Return a choice among values with weights.

    Each value is repeated in proportion to its weight, so that a uniform coordinate
    selects it with that probability.

    Args:
        where: name of the parameter, for messages.
        values: the values.
        weights: value of the setting, which should be a number of at least 0 for each
            of the values.

    Raises:
        InputError: weights are missing or invalid, or one is so small that its value
            is not among `MAX_REPEATS` repeats.
    """
    probabilities = _normalize_weights(where, weights, len(values))
    repeats = _count_repeats(probabilities)
    repeated = list[ParameterValue]()
    for value, probability, count in zip(values, probabilities, repeats, strict=True):
        if probability and not count:
            raise InputError(
                f"{where}: {format_value(value)} has less than a {MAX_REPEATS}th "
                "of the weight; leave it out"
            )
        repeated += [value] * count
    return OneOf(tuple(repeated))


def _normalize_weights(where: str, weights: object, count: int) -> list[float]:
    """Return weights divided by their sum.

    Args:
        where: name of the parameter, for messages.
        weights: value of the setting.
        count: number of values.

    Raises:
        InputError: there is another number of weights, or one is no number of at least
            0, or all are 0.
    """
    weight_list = list(weights) if isinstance(weights, (list, tuple)) else []
    valid_weights = [
        weight
        for weight in weight_list
        if Parameter.is_number(weight) and weight >= 0.0
    ]
    is_complete = len(valid_weights) == len(weight_list) == count
    if not is_complete or not sum(valid_weights):
        raise InputError(
            f"{where}: expected a weight of at least 0 for each of {count} "
            "values, and one over 0, got "
            f"{weights!r:.80}"
        )
    total = sum(valid_weights)
    return [weight / total for weight in valid_weights]


def _count_repeats(probabilities: Sequence[float]) -> list[int]:
    """Return how often each value is repeated, in proportion to its probability.

    With probabilities 0.25 and 0.75 the counts are 1 and 3. The total is the smallest
    one with which all counts are whole numbers, or `MAX_REPEATS` if there is none.
    Cumulative counts are rounded, not the counts, so that their sum is the total.
    """
    total = _find_smallest_total(probabilities)
    cumulated_counts = [
        round(total * sum(probabilities[:k])) for k in range(len(probabilities) + 1)
    ]
    return [end - begin for begin, end in pairwise(cumulated_counts)]


def _find_smallest_total(probabilities: Sequence[float]) -> int:
    """Return the smallest total with whole counts, or `MAX_REPEATS` without one."""
    for candidate in range(1, MAX_REPEATS):
        errors = [
            abs(candidate * probability - round(candidate * probability))
            for probability in probabilities
        ]
        if max(errors) < 1e-9:  # whole but for rounding
            return candidate
    return MAX_REPEATS


def has_distribution(spec: Spec) -> bool:
    """Return whether a spec states probabilities: a distribution, or weights."""
    return isinstance(spec, DistributionRange) or (
        isinstance(spec, OneOf) and len({*spec.values}) < len(spec.values)
    )


def _is_list(value: object) -> TypeGuard[Sequence[Any]]:
    return isinstance(value, Sequence) and not isinstance(value, (str, bytes))


def _check_value(label: str, parameter: Parameter, value: object) -> ParameterValue:
    """Check one value of a parameter; return it as a name or a float.

    Args:
        label: how messages name the parameter, e.g. "pose.yaw".
        parameter: states the options, or the bounds and the unit.
        value: the value that the user set.

    Raises:
        UnknownNameError: the value is a name, but none of the options.
        InputError: the value is neither a name nor a number within the bounds.
    """
    if parameter.options:
        return _check_option(label, parameter, value)
    # a name without a list of options, such as a file
    if parameter.unit == "name" and isinstance(value, str) and value.strip():
        return value
    return _check_bounded_number(label, parameter, value)


def _check_bounded_number(label: str, parameter: Parameter, value: object) -> float:
    """Return a value as a float; raise InputError if it is no number within the bounds.

    The arguments are those of `_check_value`.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(
            f"{label}: expected a number in {parameter.unit}, got {value!r}"
        )
    if not (Parameter.is_number(value) and parameter.low <= value <= parameter.high):
        raise InputError(
            f"{label}: expected a number from {parameter.low:g} to {parameter.high:g} "
            f"({parameter.unit}), "
            f"got {format_value(value)}"
        )
    return float(value)


def _check_option(label: str, parameter: Parameter, value: object) -> str:
    """Return a value if it is one of the parameter's options; raise otherwise."""
    if not isinstance(value, str):
        raise InputError(
            f"{label}: expected one of {', '.join(parameter.options)}, got {value!r}"
        )
    if value not in parameter.options:
        raise UnknownNameError(label, value, parameter.options)
    return value


FULL_TURN = 360.0
RELATIVE_TOLERANCE = 1e-6  # relative difference up to which two values are the same


def is_same_value(
    first: ParameterValue, second: ParameterValue, *, is_angle: bool = False
) -> bool:
    """Return whether two values are the same, up to a rounding error.

    Angles that differ by full turns are the same.
    """
    if isinstance(first, str) or isinstance(second, str):
        return first == second
    tolerance = RELATIVE_TOLERANCE * max(1.0, abs(first), abs(second))
    return compute_difference(first, second, is_angle=is_angle) <= tolerance


def compute_difference(first: float, second: float, *, is_angle: bool = False) -> float:
    """Return the distance of two numbers; of angles, that in the shorter direction."""
    difference = first - second
    if is_angle:
        difference = math.remainder(difference, FULL_TURN)
    return abs(difference)


def clip_to_range(
    value: float, low: float, high: float, *, is_angle: bool = False
) -> float:
    """Return the value in a range that is nearest to another value.

    Args:
        value: any value.
        low, high: bounds of the range.
        is_angle: whether values are degrees, of which 0 and 360 are the same.
    """
    if is_angle:
        value = low + (value - low) % FULL_TURN  # in [low, low + 360)
        # An angle above `high` is also below `low` + 360, which is the same as `low`.
        to_high = value - high
        to_low = low + FULL_TURN - value
        if value > high and to_high > to_low:
            value = low
    return min(max(value, low), high)


def format_value(value: ParameterValue) -> str:
    """Return a value as it is written."""
    if isinstance(value, int) and not Parameter.is_number(value):
        return f"a whole number of {value.bit_length()} bits"
    return value if isinstance(value, str) else f"{value:g}"


@dataclass(frozen=True)
class Slot:
    """One parameter of a bound control, and the position of its coordinates.

    Attributes:
        parameter: the parameter, with its default in the scene.
        parameter_spec: its fixed value, range or list of values.
        coordinate_offset: index of its first coordinate in the control's slice of u.
    """

    parameter: Parameter
    parameter_spec: Spec
    coordinate_offset: int = 0

    @property
    def n_values(self) -> int:
        """Number of elements of the parameter's value."""
        return math.prod(side or 1 for side in self.parameter.shape)

    @property
    def n_coordinates(self) -> int:
        """Number of coordinates of u."""
        if isinstance(self.parameter_spec, Fixed):
            return 0
        if isinstance(self.parameter_spec, OneOf):
            return 1
        return self.n_values

    @property
    def is_angle(self) -> bool:
        """Whether the values are degrees, of which 0 and 360 are the same."""
        return self.parameter.periodic and self.parameter.unit == "degrees"

    @property
    def is_full_turn(self) -> bool:
        """Whether the range is a full turn, so that both its bounds are the same."""
        spec = self.parameter_spec
        # A distribution (a subclass of Range) has other densities at both bounds.
        return (
            self.parameter.periodic
            and type(spec) is Range
            and abs(spec.high - spec.low - FULL_TURN) < 1e-9
        )

    def get_start_value(self) -> ParameterValue:
        """Return the parameter's default, or the allowed value that is nearest to it.

        Names have no nearest value: the first allowed one is returned. A fixed parameter
        allows one value only, which is returned.
        """
        spec = self.parameter_spec
        default = self.parameter.default
        if isinstance(spec, Fixed):
            return spec.value
        if isinstance(spec, Range):
            return clip_to_range(
                float(default), spec.low, spec.high, is_angle=self.is_angle
            )
        return self._find_nearest_listed(spec.values)

    def _find_nearest_listed(self, values: Sequence[ParameterValue]) -> ParameterValue:
        """Return the value that is the default or nearest to it, or the first name."""
        default = self.parameter.default
        if default in values:
            return default
        has_names = any(isinstance(value, str) for value in (default, *values))
        if has_names:
            return values[0]
        return min(
            values,
            key=lambda value: compute_difference(
                float(value), float(default), is_angle=self.is_angle
            ),
        )

    def get_start_coordinates(self) -> list[float]:
        """Return the coordinates of the value that `get_start_value` returns.

        There is one for each element of a parameter with a range, one for a list of
        values, and none if the parameter is fixed.
        """
        spec = self.parameter_spec
        value = self.get_start_value()
        if isinstance(spec, Range):
            coordinate = spec.find_coordinate(float(value), log=self.parameter.log)
            return [coordinate] * self.n_values
        if isinstance(spec, OneOf):
            # [0, 1] is divided into an interval for each value: the middle of this one
            return [(spec.values.index(value) + 0.5) / len(spec.values)]
        return []


def parse_distribution(
    label: str, parameter: Parameter, setting: Mapping[str, object]
) -> DistributionRange:
    """Parse the distribution of a parameter, {distribution: NAME, PARAMETER: NUMBER}.

    For example {"distribution": "norm", "loc": 20, "scale": 5}, with the names of
    scipy.stats. It is cut off at the parameter's bounds. An infinite tail is cut off at
    `TAIL_PROBABILITY`, as the range needs finite bounds.

    Args:
        label: name of the parameter in messages.
        parameter: states the bounds and the unit.
        setting: the setting. It is a `PythonQuantiles` if the user passed a function in
            Python.

    Raises:
        InputError: the distribution has other parameters; the user passed a function,
            but in another Python session (a stored setting has only its name); or a
            larger probability than `MAX_OUTSIDE_PROBABILITY` lies outside of the
            bounds.
        UnknownNameError: scipy has no distribution of that name.
    """
    if isinstance(setting, PythonQuantiles):
        return _read_python_quantiles(label, parameter, setting)
    name = setting[DISTRIBUTION]
    if name == FROM_PYTHON:
        raise _make_lost_function_error(label, setting)
    arguments = {key: value for key, value in setting.items() if key != DISTRIBUTION}
    frozen, text = _freeze_distribution(label, name, arguments)
    lower_probability, upper_probability = _find_range_probabilities(
        label, parameter, frozen, text
    )
    return _make_range(label, frozen.ppf, lower_probability, upper_probability, text)


def _find_range_probabilities(
    label: str, parameter: Parameter, frozen: Any, text: str
) -> tuple[float, float]:
    """Return the cumulative probabilities between which a distribution is searched.

    Args:
        label: name of the parameter in messages.
        parameter: states the bounds, at which the distribution is cut off.
        frozen: the distribution of scipy with its arguments.
        text: the distribution as messages write it, e.g. "norm(loc=20, scale=5)".

    Raises:
        InputError: a larger probability than `MAX_OUTSIDE_PROBABILITY` lies outside of
            the bounds.
    """
    with np.errstate(all="ignore"):  # far out in the tails, some formulas overflow
        # Probabilities below each bound. The bounds themselves have the probability 0, as
        # the distribution is continuous.
        lower_probability = float(frozen.cdf(parameter.low))
        upper_probability = float(frozen.cdf(parameter.high))
        outside = lower_probability + float(frozen.sf(parameter.high))
        # an infinite tail is cut off
        min_probability, max_probability = _find_cut_offs(frozen.ppf)
    if outside > MAX_OUTSIDE_PROBABILITY:
        raise _make_outside_error(label, parameter, text, outside)
    return (
        max(lower_probability, min_probability),
        min(upper_probability, max_probability),
    )


def _make_lost_function_error(label: str, setting: Mapping[str, object]) -> InputError:
    """Return the error for a function of another Python session."""
    return InputError(
        f"{label}: its values were drawn by {setting.get('name', 'a function')}, "
        "which only the Python session that "
        "started the run has; pass it again in the same call, with `resume=True` "
        "to continue"
    )


def _find_cut_offs(quantiles: Quantiles) -> tuple[float, float]:
    """Return the cumulative probabilities between which a distribution is finite.

    They are 0 and 1, but an infinite tail is cut off at `TAIL_PROBABILITY`.
    """
    # whether there is a smallest and a largest value
    has_end = np.isfinite(quantiles(np.array([0.0, 1.0])))
    lower = 0.0 if has_end[0] else TAIL_PROBABILITY
    upper = 1.0 if has_end[1] else 1.0 - TAIL_PROBABILITY
    return lower, upper


def _make_outside_error(
    label: str, parameter: Parameter, text: str, outside: float
) -> InputError:
    """Return the error for a distribution that exceeds its parameter's bounds too much.

    Args:
        label: name of the parameter in messages.
        parameter: states the bounds and the unit.
        text: the distribution as messages write it, e.g. "norm(loc=20, scale=5)".
        outside: probability of values out of the bounds.
    """
    return InputError(
        f"{label}: {100.0 * outside:.3g} % of {text} lies outside of "
        f"{parameter.low:g} to {parameter.high:g} "
        f"({parameter.unit}), and at most {100.0 * MAX_OUTSIDE_PROBABILITY:g} % are "
        "cut off; "
        "choose a narrower distribution, or cut it off "
        "yourself (truncnorm)"
    )


def _freeze_distribution(
    where: str, name: object, arguments: Mapping[str, Any]
) -> tuple[Any, str]:
    """Return a distribution of scipy with its arguments, and how messages write it.

    Args:
        where: name of the parameter, for messages.
        name: name of the distribution in scipy.stats, such as "norm".
        arguments: its arguments by name, such as loc and scale.

    Raises:
        UnknownNameError: scipy has no continuous distribution of that name.
        InputError: it does not take the arguments.
    """
    family = _find_distribution_family(where, name)
    text = f"{name}({_format_arguments(arguments)})"
    frozen = _apply_arguments(family, arguments)
    if frozen is None:
        # `family.shapes` are the names of its arguments besides loc and scale, e.g. "a, b"
        shapes = f"{family.shapes}, " if family.shapes else ""
        raise InputError(
            f"{where}: expected {{distribution: {name}}} with numbers for "
            f"{shapes}loc, scale, got {text}"
        )
    return frozen, text


def _apply_arguments(family: Any, arguments: Mapping[str, Any]) -> Any:
    """Return a distribution of scipy with its arguments; None if it can't have them.

    Args:
        family: the distribution without arguments, such as scipy.stats.norm.
        arguments: its arguments by name, such as loc and scale.
    """
    if not all(map(Parameter.is_number, arguments.values())):
        return None
    with suppress(TypeError):  # it has no such arguments, or lacks one
        frozen = family(**arguments)
        # scipy returns NaN for quantiles if an argument is out of its range
        median = frozen.ppf(0.5)
        if bool(np.isfinite(median)):
            return frozen
    return None


def _find_distribution_family(where: str, name: object) -> Any:
    """Return a family of continuous distributions of scipy by its name.

    Raises:
        UnknownNameError: scipy has none of that name. `where` is the name of the
            parameter, for the message.
    """
    # Imported here, since the import takes a quarter of a second and most runs have no
    # distribution.
    from scipy import stats

    family = getattr(stats, name, None) if isinstance(name, str) else None
    if not isinstance(family, stats.rv_continuous):
        raise UnknownNameError(
            f"distribution of {where}",
            str(name),
            COMMON_DISTRIBUTIONS,
            "It is one of scipy.stats, of real numbers.",
        )
    return family


def _format_arguments(arguments: Mapping[str, Any]) -> str:
    """Return arguments as "loc=0, scale=2"; values that are no numbers are shortened."""
    formatted = []
    for key, value in arguments.items():
        is_number = Parameter.is_number(value)
        formatted.append(f"{key}={value:g}" if is_number else f"{key}={value!r:.20}")
    return ", ".join(formatted)


def _read_python_quantiles(
    label: str, parameter: Parameter, setting: PythonQuantiles
) -> DistributionRange:
    """Return the range of a parameter whose distribution is a Python function.

    The function is an inverse CDF, from a probability to a value. It is checked at
    `N_CHECKED_QUANTILES` probabilities.

    Args:
        label: name of the parameter in messages.
        parameter: states the bounds and the unit.
        setting: has the function and its name.

    Raises:
        InputError: values are outside of the parameter's bounds, or not ascending.
    """
    name = str(setting["name"])
    quantiles = partial(_compute_python_quantiles, setting)
    with np.errstate(all="ignore"):
        lower_probability, upper_probability = _find_cut_offs(quantiles)
    probabilities = np.linspace(
        lower_probability, upper_probability, N_CHECKED_QUANTILES
    )
    _check_quantiles(label, parameter, name, quantiles(probabilities))
    return _make_range(
        label, quantiles, float(probabilities[0]), float(probabilities[-1]), name
    )


def _compute_python_quantiles(
    setting: PythonQuantiles, probabilities: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the values of a user's inverse CDF at probabilities of any shape."""
    values = [float(setting.function(float(p))) for p in probabilities.flat]
    return np.array(values).reshape(probabilities.shape)


def _check_quantiles(
    label: str, parameter: Parameter, name: str, values: NDArray[np.float64]
) -> None:
    """Check the values (n,) of an inverse CDF at ascending probabilities.

    Args:
        label: name of the parameter in messages.
        parameter: states the bounds and the unit.
        name: name of the function.
        values: (n,) its values.

    Raises:
        InputError: values are outside of the parameter's bounds, or not ascending.
    """
    is_inside = (values >= parameter.low) & (values <= parameter.high)
    if not is_inside.all():
        raise InputError(
            f"{label}: expected values from {parameter.low:g} to {parameter.high:g} "
            f"({parameter.unit}) of {name}, got "
            f"{values[~is_inside][0]:g}"
        )
    _check_rises(label, name, values)


def _check_rises(label: str, name: str, values: NDArray[np.float64]) -> None:
    """Raise InputError if a value of an inverse CDF is below the one before it.

    The arguments are those of `_check_quantiles`.
    """
    falls = np.diff(values) < 0.0
    if falls.any():
        index = int(falls.argmax())
        raise InputError(
            f"{label}: expected an inverse CDF, whose values rise with the "
            f"probability, got {values[index]:g} and then "
            f"{values[index + 1]:g} of {name}"
        )


def _make_range(
    label: str,
    quantiles: Quantiles,
    lower_probability: float,
    upper_probability: float,
    distribution: str,
) -> DistributionRange:
    """Return the range of a distribution between two cumulative probabilities.

    Args:
        label: name of the parameter in messages.
        quantiles: inverse CDF of the distribution.
        lower_probability: cumulative probability at the lower bound of the range.
        upper_probability: cumulative probability at the upper bound of the range.
        distribution: the distribution as messages write it.

    Raises:
        InputError: the range has a single value.
    """
    low, high = (
        float(value)
        for value in quantiles(np.array([lower_probability, upper_probability]))
    )
    if not low < high:
        raise InputError(
            f"{label}: {distribution} has only the value {low:g}; write {low:g} to "
            "fix it"
        )
    return DistributionRange(
        low, high, quantiles, lower_probability, upper_probability, distribution
    )
