"""What a parameter was set to: fixed, a range to search, or a list of values to choose from (docs/controls/README.md).

    pose: {yaw: [0, 360], pitch: 10, scale: {choices: [0.8, 1.0, 1.2]}}

Two numbers in a list are a range; three or more, or names, are a choice. `{range: [low, high]}` and `{choices: [...]}`
say which. Values that are drawn may have weights, or a distribution (`advsearch.controls.ranges`).

Where a control leaves out a value of the clean scene that was asked for, the two contradict each other, and that is
refused. Where it leaves out only a default, the clean scene has the nearest value that the control allows, and that is
said: a `Moved`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import TypeGuard

import torch
from torch import Tensor

from advsearch.controls.ranges import DrawnRange, Range, is_number, read_drawn
from advsearch.described import rounded
from advsearch.distributions import CHOICES, DISTRIBUTION, WEIGHTS, as_setting
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.description import ENVIRONMENT, SceneDescription, check_one_environment
from advsearch.scene.settings import SETTINGS, Parameter

Number = float | str

LARGEST_EPSILON = 1e6  # no distance from where a control starts is larger, in whichever norm


@dataclass(frozen=True)
class Fixed:
    """One value, not searched."""

    value: Number


@dataclass(frozen=True)
class OneOf:
    """One of a few values: numbers or names."""

    values: tuple[Number, ...]


Spec = Fixed | Range | OneOf


def plain(given: object) -> object:
    """Return numbers and arrays of numpy and torch, also in a list, as Python's, and distributions as settings."""
    given = as_setting(given)
    if isinstance(given, (list, tuple)):
        return type(given)(map(plain, given))
    return given.tolist() if hasattr(given, "tolist") and hasattr(given, "dtype") else given


def read(where: str, parameter: Parameter, given: object) -> Spec:
    """Return the setting of a parameter from what was given for it.

    Args:
        where: how messages name it, e.g. "pose.yaw".
        parameter: says what is allowed.
        given: a number or a name, [low, high], a list of values, {"range": [low, high]}, {"choices": [...]}, perhaps
            with "weights", or a distribution.

    Raises:
        InputError: not such a form, or a value outside the parameter's range.
    """
    if isinstance(given, Mapping) and DISTRIBUTION in given and not parameter.options:
        return read_drawn(where, parameter, given)
    if isinstance(given, Mapping) and set(given) == {"range"} and _is_list(given["range"]) and len(given["range"]) == 2:
        given = given["range"]
    if isinstance(given, Mapping):
        if not {CHOICES} <= set(given) <= {CHOICES, WEIGHTS} or not _is_list(given[CHOICES]) or not given[CHOICES]:
            raise InputError(
                f"{where}: expected {{range: [low, high]}}, {{choices: [value, ...]}}, {{choices: [value, ...], "
                "weights: [number, ...]}}"
                + ("" if parameter.options else " or {distribution: NAME, ...}")
                + f", got {dict(given)!r}"
            )
        choices = _choices(where, [_value(where, parameter, value) for value in given[CHOICES]])
        return _weighted(where, choices, given[WEIGHTS]) if WEIGHTS in given else choices
    if not _is_list(given):
        return Fixed(_value(where, parameter, given))
    values = [_value(where, parameter, one) for one in given]  # type: ignore[attr-defined]
    if values and (parameter.options or len(values) > 2):
        return _choices(where, values)
    if len(values) != 2:
        raise InputError(f"{where}: expected a value, [low, high] or a list of values, got {given!r}")
    low, high = (float(value) for value in values)
    if low == high:
        raise InputError(f"{where}: the range [{low:g}, {high:g}] has no size; write {low:g} to fix the value")
    if low > high:
        mend = f"write [{high:g}, {low:g}]"
        if parameter.periodic and low - high < TURN:
            ends = (low - TURN, high) if low - TURN >= parameter.low else (low, high + TURN)
            mend = (
                f"write [{ends[0]:g}, {ends[1]:g}] for the {TURN - low + high:g} degrees from {low:g} through "
                f"{0 if ends[0] <= 0 else TURN:g} to {high:g}, or [{high:g}, {low:g}] for the other {low - high:g}"
            )
        raise InputError(f"{where}: the range [{low:g}, {high:g}] is reversed; {mend}")
    if parameter.log and low <= 0.0:
        raise InputError(f"{where}: expected a range over 0 (it is searched on a logarithmic scale), got {low:g}")
    return Range(low, high)


def _choices(where: str, values: Sequence[Number]) -> OneOf:
    """The values, of which none may come twice: it would be drawn twice as often."""
    twice = [value for value, count in Counter(values).items() if count > 1]
    if twice:
        raise InputError(f"{where}: expected different choices, got {shown(twice[0])} twice; leave one of them out")
    return OneOf(tuple(values))


MOST_SHARES = 1000  # equal shares of probability that weights are rounded to, at most


def _weighted(where: str, choice: OneOf, weights: object) -> OneOf:
    """A choice that has each value as often as its weight says, so that equal shares of u draw it so."""
    values = choice.values
    given = list(weights) if isinstance(weights, (list, tuple)) else []
    numbers = [one for one in given if is_number(one) and one >= 0.0]
    if not len(numbers) == len(given) == len(values) or not sum(numbers):
        raise InputError(
            f"{where}: expected a weight of at least 0 for each of {len(values)} values, and one over 0, got "
            f"{weights!r:.80}"
        )
    shares = [one / sum(numbers) for one in numbers]
    exact = (n for n in range(1, MOST_SHARES) if all(abs(n * one - round(n * one)) < 1e-9 for one in shares))
    count = next(exact, MOST_SHARES)
    ends = [0, *(round(count * sum(shares[: number + 1])) for number in range(len(shares)))]
    counts = [high - low for low, high in pairwise(ends)]
    lost = [value for value, number, one in zip(values, counts, shares, strict=True) if one and not number]
    if lost:
        raise InputError(f"{where}: {shown(lost[0])} has less than a {MOST_SHARES}th of the weight; leave it out")
    return OneOf(tuple(value for value, number in zip(values, counts, strict=True) for _ in range(number)))


def by_distribution(spec: Spec) -> bool:
    """Return whether a spec says how likely each value is."""
    return isinstance(spec, DrawnRange) or (isinstance(spec, OneOf) and len({*spec.values}) < len(spec.values))


def _is_list(given: object) -> bool:
    return isinstance(given, Sequence) and not isinstance(given, (str, bytes))


def _value(where: str, parameter: Parameter, given: object) -> Number:
    if parameter.options:
        if not isinstance(given, str):
            raise InputError(f"{where}: expected one of {', '.join(parameter.options)}, got {given!r}")
        if given not in parameter.options:
            raise UnknownNameError(where, given, parameter.options)
        return given
    if parameter.unit == "name" and isinstance(given, str) and given.strip():
        return given
    if isinstance(given, bool) or not isinstance(given, (int, float)):
        raise InputError(f"{where}: expected a number in {parameter.unit}, got {given!r}")
    if not (is_number(given) and parameter.low <= given <= parameter.high):
        raise InputError(
            f"{where}: expected a number from {parameter.low:g} to {parameter.high:g} ({parameter.unit}), "
            f"got {shown(given)}"
        )
    return float(given)


def is_whole(given: object, low: int, high: int) -> TypeGuard[float]:
    """Return whether it is a whole number from `low` to `high`."""
    return is_number(given) and low <= given <= high and given == int(given)


def in_words(spec: Spec) -> str:
    """Say what a parameter is set to: ``10``, ``from 5 to 30``, ``one of noon, kitchen``."""
    if isinstance(spec, Range):
        return f"from {spec.low:g} to {spec.high:g}"
    values = (spec.value,) if isinstance(spec, Fixed) else dict.fromkeys(spec.values)
    written = ", ".join(map(shown, values))
    return written if isinstance(spec, Fixed) else f"one of {written}"


def to_value(spec: Range, log: bool, u: Tensor) -> Tensor:
    """Map coordinates in [0, 1] to values of a range; differentiable."""
    if isinstance(spec, DrawnRange):
        return spec.at(u)
    if log:
        return torch.exp(torch.lerp(torch.full_like(u, math.log(spec.low)), torch.full_like(u, math.log(spec.high)), u))
    return spec.low + (spec.high - spec.low) * u


def to_unit(spec: Range, log: bool, value: float) -> float:
    """Map a value to its coordinate, clipped to [0, 1]."""
    if isinstance(spec, DrawnRange):
        return spec.coordinate(value)
    if log:
        value = max(value, 1e-30)
        share = (math.log(value) - math.log(spec.low)) / (math.log(spec.high) - math.log(spec.low))
    else:
        share = (value - spec.low) / (spec.high - spec.low)
    return min(1.0, max(0.0, share))


def option_index(count: int, u: Tensor) -> int:
    """Return which of `count` options a coordinate chooses: equal shares of [0, 1]."""
    return min(count - 1, max(0, int(float(u.detach()) * count)))


TURN = 360.0
CLOSE = 1e-6  # relative difference up to which two values are the same


@dataclass(frozen=True)
class Moved:
    """A value of the clean scene that a control leaves out, although nobody asked for it: that of a parameter
    (``pose.yaw``, ``ground.size``, ``environment``), in a unit ("name" of names), as the scene described it, and the
    one that is used instead."""

    control: str
    parameter: str
    unit: str
    scene: Number
    used: Number


def sentences(moved: Sequence[Moved]) -> list[str]:
    """Return what is said of the values that had to move: one sentence a control."""
    return [
        f"The clean scene has {' and '.join(map(_instead, several))}, which the control {control} leaves out."
        for control, several in groupby(moved, key=lambda one: one.control)
    ]


def check_prepared(control: str, before: SceneDescription, after: SceneDescription) -> Iterator[Moved]:
    """Yield what a control has replaced in a scene by what it needs there, and nobody has described. Raises InputError
    where it was asked for."""
    if after.environment is not None and after.environment is not before.environment:
        check_one_environment(after.parts, f"`controls` {control}")
        if ENVIRONMENT in before.given:
            raise InputError(
                f"`environment={before.environment_spec}` and `controls` {control} contradict each other: the control "
                f"puts {after.environment.name} in its place; leave one of the two out"
            )
        if after.environment_spec == before.environment_spec:
            yield Moved(control, ENVIRONMENT, "name", before.environment_spec, after.environment.name)
    for name, value in after.values.items():
        scene = before.values[name]
        if value is None or scene is None or same(value, scene):
            continue
        if name in before.given:
            raise InputError(
                f"`set` {name}={shown(scene)} and `controls` {control} contradict each other: the control makes it "
                f"{rounded(value)}; change one of the two, or leave one out"
            )
        yield Moved(control, name, SETTINGS[name].unit, scene, value)


def check_start(
    control: str, parameter: str, allowed: str, setting: str, scene: SceneDescription, wanted: Number
) -> None:
    """Raise InputError where a value `wanted` of a control's parameter, which is outside what is `allowed` (in words)
    and so cannot be that of the clean scene, was asked for in the scene's `setting` that says the same."""
    if setting in scene.given:
        asked = f"`environment={scene.environment_spec}`"
        if setting != ENVIRONMENT:
            asked = f"`set` {setting}={shown(scene.number(setting))}"
        raise InputError(
            f"{asked} and `controls` {control} contradict each other: {control}.{parameter} is {allowed}, which leaves "
            f"{shown(wanted)} out; change one of the two, or leave one out"
        )


def same(one: Number, other: Number, *, turns: bool = False) -> bool:
    """Whether two values are the same, up to a rounding error and, of an angle that turns, up to whole turns."""
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    return apart(one, other, turns=turns) <= CLOSE * max(1.0, abs(one), abs(other))


def apart(one: float, other: float, *, turns: bool = False) -> float:
    """How far two numbers are from each other; angles that turn, the nearer way around."""
    return abs(math.remainder(one - other, TURN) if turns else one - other)


def nearest(value: float, low: float, high: float, *, turns: bool = False) -> float:
    """Return the value in a range that is nearest to one, of an angle that turns the nearest way around."""
    if turns:
        value = low + (value - low) % TURN
        if value > high and value - high > low + TURN - value:
            value = low
    return min(max(value, low), high)


def shown(value: Number) -> str:
    """A value as it is written."""
    if isinstance(value, int) and not is_number(value):
        return f"a whole number of {value.bit_length()} bits"
    return value if isinstance(value, str) else f"{value:g}"


def _instead(one: Moved) -> str:
    unit = "" if one.unit in ("1", "name") or isinstance(one.used, str) else f" {one.unit}"
    short = [value if isinstance(value, str) else rounded(value) for value in (one.used, one.scene)]
    used, scene = short if short[0] != short[1] else (shown(one.used), shown(one.scene))
    return f"{one.parameter} {used}{unit} instead of {scene}"
