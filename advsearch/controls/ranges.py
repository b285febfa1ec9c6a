"""What a parameter was set to: fixed, a range to search, or a list of values to choose
from (docs/controls/README.md).

    pose: {yaw: [0, 360], pitch: 10, scale: {choices: [0.8, 1.0, 1.2]}}

Two numbers in a list are a range; three or more, or names, are a choice. `{range: [low,
high]}` and `{choices: [...]}` say which. Values that are drawn may have weights, or a
distribution: u is the share of its probability, so that whatever draws u evenly (nets
of points, banks of light transport) draws values as the distribution has them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
    OwnQuantiles,
    as_setting,
)
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.settings import Parameter

Number = float | str

Quantiles = Callable[[NDArray[np.float64]], NDArray[np.float64]]

COMMON = (
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
"""Names that a message tells."""

TAIL = 1e-6  # probability of an endless tail that is left out

# probability outside of a parameter's bounds, where a distribution is cut off, at most
MOST_OUTSIDE = 0.01

CHECKED = 257  # shares at which a function from Python is looked at

NEAR = 1e-4  # half of the step over which the slope of a quantile is taken


@dataclass(frozen=True)
class Fixed:
    """One value, not searched."""

    value: Number

    def __str__(self) -> str:
        return shown(self.value)


@dataclass(frozen=True)
class OneOf:
    """One of a few values: numbers or names."""

    values: tuple[Number, ...]

    def __str__(self) -> str:
        return f"one of {', '.join(map(shown, dict.fromkeys(self.values)))}"

    def at(self, u: Tensor) -> Number:
        """Return the value that a coordinate () chooses: each has an equal share of [0,
        1].
        """
        return self.values[
            min(len(self.values) - 1, max(0, int(float(u.detach()) * len(self.values))))
        ]


@dataclass(frozen=True)
class Range:
    """Every value from `low` to `high`; as its methods are told, the unit interval runs
    over their logarithms.
    """

    low: float
    high: float

    def __str__(self) -> str:
        return f"from {self.low:g} to {self.high:g}"

    def at(self, u: Tensor, *, log: bool = False) -> Tensor:
        """Return the values at coordinates in [0, 1]; differentiable."""
        if not log:
            return self.low + (self.high - self.low) * u
        low = torch.full_like(u, math.log(self.low))
        high = torch.full_like(u, math.log(self.high))
        return torch.exp(torch.lerp(low, high, u))

    def coordinate(self, value: float, *, log: bool = False) -> float:
        """Return the coordinate of a value, clipped to [0, 1]."""
        low = self.low
        high = self.high
        if log:
            value = math.log(max(value, 1e-30))
            low = math.log(low)
            high = math.log(high)
        return min(1.0, max(0.0, (value - low) / (high - low)))


@dataclass(frozen=True)
class DrawnRange(Range):
    """Values from `low` to `high`, the shares `least` to `most` of a distribution: its
    quantiles, and what it is.
    """

    quantiles: Quantiles
    least: float
    most: float
    text: str

    def at(self, u: Tensor, *, log: bool = False) -> Tensor:
        """Return the values at coordinates in [0, 1]; differentiable, by the slope of
        the quantiles.
        """
        values = self._values(u.detach())
        if u.requires_grad:
            up = (u.detach() + NEAR).clamp(max=1.0)
            down = (u.detach() - NEAR).clamp(min=0.0)
            values = values + (self._values(up) - self._values(down)) / (up - down) * (
                u - u.detach()
            )
        return values

    def _values(self, u: Tensor) -> Tensor:
        shares = self.least + (self.most - self.least) * u.double().cpu().numpy()
        return torch.from_numpy(
            np.clip(self.quantiles(np.asarray(shares)), self.low, self.high)
        ).to(u)

    def coordinate(self, value: float, *, log: bool = False) -> float:
        """Return the coordinate of a value, by bisection."""
        below = 0.0
        above = 1.0
        for _ in range(60):
            middle = 0.5 * (below + above)
            share = self.least + (self.most - self.least) * middle
            below, above = (
                (middle, above)
                if float(self.quantiles(np.asarray(share))) < value
                else (below, middle)
            )
        return above if above < 1.0 else below


Spec = Fixed | Range | OneOf


def plain(given: object) -> object:
    """Return numbers and arrays of numpy and torch, also in a list, as Python's, and
    distributions as settings.
    """
    given = as_setting(given)
    if isinstance(given, (list, tuple)):
        return type(given)(map(plain, given))
    return (
        given.tolist()
        if hasattr(given, "tolist") and hasattr(given, "dtype")
        else given
    )


def read(where: str, parameter: Parameter, given: object) -> Spec:
    """Return the setting of a parameter from what was given for it.

    Args:
        where: how messages name it, e.g. "pose.yaw".
        parameter: says what is allowed.
        given: a number or a name, [low, high], a list of values, {"range": [low,
            high]}, {"choices": [...]}, perhaps with "weights", or a distribution.

    Raises:
        InputError: not such a form, or a value outside the parameter's range.
    """
    if isinstance(given, Mapping) and DISTRIBUTION in given and not parameter.options:
        return read_drawn(where, parameter, given)
    if (
        isinstance(given, Mapping)
        and set(given) == {"range"}
        and _is_list(given["range"])
        and len(given["range"]) == 2
    ):
        given = given["range"]
    if isinstance(given, Mapping):
        if (
            not {CHOICES} <= set(given) <= {CHOICES, WEIGHTS}
            or not _is_list(given[CHOICES])
            or not given[CHOICES]
        ):
            raise InputError(
                f"{where}: expected {{range: [low, high]}}, {{choices: [value, ...]}}, "
                f"{{choices: [value, ...], "
                "weights: [number, ...]}}"
                + ("" if parameter.options else " or {distribution: NAME, ...}")
                + f", got {dict(given)!r}"
            )
        choice = _choices(
            where, [_value(where, parameter, value) for value in given[CHOICES]]
        )
        return (
            _weighted(where, choice.values, given[WEIGHTS])
            if WEIGHTS in given
            else choice
        )
    if not _is_list(given):
        return Fixed(_value(where, parameter, given))
    values = [_value(where, parameter, value) for value in given]
    if values and (parameter.options or len(values) > 2):
        return _choices(where, values)
    if len(values) != 2:
        raise InputError(
            f"{where}: expected a value, [low, high] or a list of values, got {given!r}"
        )
    low, high = (float(value) for value in values)
    if low == high:
        raise InputError(
            f"{where}: the range [{low:g}, {high:g}] has no size; write "
            f"{low:g} to fix the value"
        )
    if low > high:
        mend = f"write [{high:g}, {low:g}]"
        if parameter.periodic and low - high < TURN:
            ends = (
                (low - TURN, high)
                if low - TURN >= parameter.low
                else (low, high + TURN)
            )
            mend = (
                f"write [{ends[0]:g}, {ends[1]:g}] for the {TURN - low + high:g} "
                f"degrees from {low:g} through "
                f"{0 if ends[0] <= 0 else TURN:g} to {high:g}, or [{high:g}, {low:g}] "
                f"for the other {low - high:g}"
            )
        raise InputError(f"{where}: the range [{low:g}, {high:g}] is reversed; {mend}")
    if parameter.log and low <= 0.0:
        raise InputError(
            f"{where}: expected a range over 0 (it is searched on a "
            f"logarithmic scale), got {low:g}"
        )
    return Range(low, high)


def _choices(where: str, values: Sequence[Number]) -> OneOf:
    # it would be drawn twice as often
    twice = [value for value, count in Counter(values).items() if count > 1]
    if twice:
        raise InputError(
            f"{where}: expected different choices, got {shown(twice[0])} "
            "twice; leave one of them out"
        )
    return OneOf(tuple(values))


MOST_SHARES = 1000  # equal shares of probability that weights are rounded to, at most


def _weighted(where: str, values: Sequence[Number], weights: object) -> OneOf:
    """A choice that has each value as often as its weight says, so that equal shares of
    u draw it so.
    """
    given = list(weights) if isinstance(weights, (list, tuple)) else []
    numbers = [
        weight for weight in given if Parameter.is_number(weight) and weight >= 0.0
    ]
    if not len(numbers) == len(given) == len(values) or not sum(numbers):
        raise InputError(
            f"{where}: expected a weight of at least 0 for each of {len(values)} "
            "values, and one over 0, got "
            f"{weights!r:.80}"
        )
    shares = [weight / sum(numbers) for weight in numbers]
    exact = (
        n
        for n in range(1, MOST_SHARES)
        if all(abs(n * share - round(n * share)) < 1e-9 for share in shares)
    )
    count = next(exact, MOST_SHARES)
    ends = [
        0,
        *(round(count * sum(shares[: number + 1])) for number in range(len(shares))),
    ]
    counts = [high - low for low, high in pairwise(ends)]
    lost = [
        value
        for value, number, share in zip(values, counts, shares, strict=True)
        if share and not number
    ]
    if lost:
        raise InputError(
            f"{where}: {shown(lost[0])} has less than a {MOST_SHARES}th "
            "of the weight; leave it out"
        )
    return OneOf(
        tuple(
            value
            for value, number in zip(values, counts, strict=True)
            for _ in range(number)
        )
    )


def by_distribution(spec: Spec) -> bool:
    """Return whether a spec says how likely each value is."""
    return isinstance(spec, DrawnRange) or (
        isinstance(spec, OneOf) and len({*spec.values}) < len(spec.values)
    )


def _is_list(given: object) -> TypeGuard[Sequence[Any]]:
    return isinstance(given, Sequence) and not isinstance(given, (str, bytes))


def _value(where: str, parameter: Parameter, given: object) -> Number:
    if parameter.options:
        if not isinstance(given, str):
            raise InputError(
                f"{where}: expected one of "
                f"{', '.join(parameter.options)}, got {given!r}"
            )
        if given not in parameter.options:
            raise UnknownNameError(where, given, parameter.options)
        return given
    if parameter.unit == "name" and isinstance(given, str) and given.strip():
        return given
    if isinstance(given, bool) or not isinstance(given, (int, float)):
        raise InputError(
            f"{where}: expected a number in {parameter.unit}, got {given!r}"
        )
    if not (Parameter.is_number(given) and parameter.low <= given <= parameter.high):
        raise InputError(
            f"{where}: expected a number from {parameter.low:g} to {parameter.high:g} "
            f"({parameter.unit}), "
            f"got {shown(given)}"
        )
    return float(given)


TURN = 360.0
CLOSE = 1e-6  # relative difference up to which two values are the same


def same(one: Number, other: Number, *, turns: bool = False) -> bool:
    """Whether two values are the same, up to a rounding error and, of an angle that
    turns, up to whole turns.
    """
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    return apart(one, other, turns=turns) <= CLOSE * max(1.0, abs(one), abs(other))


def apart(one: float, other: float, *, turns: bool = False) -> float:
    """How far two numbers are from each other; angles that turn, the nearer way
    around.
    """
    return abs(math.remainder(one - other, TURN) if turns else one - other)


def nearest(value: float, low: float, high: float, *, turns: bool = False) -> float:
    """Return the value in a range that is nearest to one, of an angle that turns the
    nearest way around.
    """
    if turns:
        value = low + (value - low) % TURN
        if value > high and value - high > low + TURN - value:
            value = low
    return min(max(value, low), high)


def shown(value: Number) -> str:
    """A value as it is written."""
    if isinstance(value, int) and not Parameter.is_number(value):
        return f"a whole number of {value.bit_length()} bits"
    return value if isinstance(value, str) else f"{value:g}"


@dataclass(frozen=True)
class Slot:
    """One parameter in a bound control: as the scene has it, what it is set to, and
    where its coordinates begin.
    """

    parameter: Parameter
    spec: Spec
    begin: int = 0

    @property
    def size(self) -> int:
        """How many numbers its value has."""
        return math.prod(side or 1 for side in self.parameter.shape)

    @property
    def width(self) -> int:
        """Number of coordinates of u."""
        return (
            0
            if isinstance(self.spec, Fixed)
            else 1
            if isinstance(self.spec, OneOf)
            else self.size
        )

    @property
    def turns(self) -> bool:
        """Whether a whole turn changes nothing."""
        return self.parameter.periodic and self.parameter.unit == "degrees"

    @property
    def periodic(self) -> bool:
        """Whether the range is a whole turn."""
        spec = self.spec
        return (
            self.parameter.periodic
            and type(spec) is Range
            and abs(spec.high - spec.low - TURN) < 1e-9
        )

    def start_value(self) -> Number:
        """The default, or the nearest value that is allowed; of names, the first one
        that is allowed.
        """
        spec = self.spec
        default = self.parameter.default
        if isinstance(spec, Fixed):
            return spec.value
        if isinstance(spec, Range):
            return nearest(float(default), spec.low, spec.high, turns=self.turns)
        if default in spec.values or any(
            isinstance(value, str) for value in (default, *spec.values)
        ):
            return default if default in spec.values else spec.values[0]
        return min(
            spec.values,
            key=lambda value: apart(float(value), float(default), turns=self.turns),
        )

    def start(self) -> list[float]:
        """Coordinates of that value."""
        spec = self.spec
        value = self.start_value()
        if isinstance(spec, Range):
            return [spec.coordinate(float(value), log=self.parameter.log)] * self.size
        return (
            [(spec.values.index(value) + 0.5) / len(spec.values)]
            if isinstance(spec, OneOf)
            else []
        )


def read_drawn(
    where: str, parameter: Parameter, given: Mapping[str, object]
) -> DrawnRange:
    """Return the spec of a parameter from its distribution, `{distribution: NAME,
    PARAMETER: NUMBER, ...}`. Raises InputError: there is none of that name, it has
    other parameters, it was a function from Python, or more of it than `MOST_OUTSIDE`
    lies outside of the parameter's bounds.
    """
    if isinstance(given, OwnQuantiles):
        return _own(where, parameter, given)
    name = given[DISTRIBUTION]
    if name == FROM_PYTHON:
        raise InputError(
            f"{where}: its values were drawn by {given.get('name', 'a function')}, "
            "which only the Python session that "
            "asked has; pass it again in the same call, with `resume=True` to go on"
        )
    numbers = {key: value for key, value in given.items() if key != DISTRIBUTION}
    # takes a quarter of a second, and few runs draw by a distribution
    from scipy import stats

    family = getattr(stats, name, None) if isinstance(name, str) else None
    if not isinstance(family, stats.rv_continuous):
        raise UnknownNameError(
            f"distribution of {where}",
            str(name),
            COMMON,
            "It is one of scipy.stats, of real numbers.",
        )
    shown = (
        f"{key}={value:g}" if Parameter.is_number(value) else f"{key}={value!r:.20}"
        for key, value in numbers.items()
    )
    text = f"{name}({', '.join(shown)})"
    try:
        if not all(map(Parameter.is_number, numbers.values())):
            raise TypeError("expected numbers")
        frozen = family(**numbers)
        sound = np.isfinite(frozen.ppf(0.5))
    except TypeError:
        sound = False
    if not sound:
        shapes = f"{family.shapes}, " if family.shapes else ""
        raise InputError(
            f"{where}: expected {{distribution: {name}}} with numbers for "
            f"{shapes}loc, scale, got {text}"
        )
    with np.errstate(all="ignore"):  # far from where it is, some formulas overflow
        least = float(frozen.cdf(parameter.low))
        most = float(frozen.cdf(parameter.high))
        outside = least + float(frozen.sf(parameter.high))
        ends = np.isfinite(frozen.ppf(np.array([0.0, 1.0])))
    if outside > MOST_OUTSIDE:
        raise InputError(
            f"{where}: {100.0 * outside:.3g} % of {text} lies outside of "
            f"{parameter.low:g} to {parameter.high:g} "
            f"({parameter.unit}), and at most {100.0 * MOST_OUTSIDE:g} % is cut off; "
            "choose a narrower one, or cut it "
            "yourself (truncnorm)"
        )
    least = max(least, 0.0 if ends[0] else TAIL)
    most = min(most, 1.0 if ends[1] else 1.0 - TAIL)
    return _between(where, frozen.ppf, least, most, text)


def _own(where: str, parameter: Parameter, given: OwnQuantiles) -> DrawnRange:
    """The spec of a function from Python."""
    name = str(given["name"])

    def quantiles(shares: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array(
            [float(given.function(float(one))) for one in shares.flat]
        ).reshape(shares.shape)

    with np.errstate(all="ignore"):
        ends = np.isfinite(quantiles(np.array([0.0, 1.0])))
    shares = np.linspace(
        0.0 if ends[0] else TAIL, 1.0 if ends[1] else 1.0 - TAIL, CHECKED
    )
    values = quantiles(shares)
    wrong = values[~((values >= parameter.low) & (values <= parameter.high))]
    if len(wrong):
        raise InputError(
            f"{where}: expected values from {parameter.low:g} to {parameter.high:g} "
            f"({parameter.unit}) of {name}, got "
            f"{wrong[0]:g}"
        )
    if (np.diff(values) < 0.0).any():
        place = int((np.diff(values) < 0.0).argmax())
        raise InputError(
            f"{where}: expected an inverse CDF, whose values rise with the share, got "
            f"{values[place]:g} and then "
            f"{values[place + 1]:g} of {name}"
        )
    return _between(where, quantiles, float(shares[0]), float(shares[-1]), name)


def _between(
    where: str, quantiles: Quantiles, least: float, most: float, text: str
) -> DrawnRange:
    low, high = (float(one) for one in quantiles(np.array([least, most])))
    if not low < high:
        raise InputError(
            f"{where}: {text} has only the value {low:g}; write that to fix it"
        )
    return DrawnRange(low, high, quantiles, least, most, text)
