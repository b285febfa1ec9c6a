"""Axes of a grid: which parameter they move, and over which values.

An axis makes its parameter a discrete choice among its values, so a point of the grid is a point of an ordinary space.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from advsearch.controls import (
    CONTROLS,
    Control,
    NumberControl,
    Parameter,
    check_instance,
    instance_of,
    unknown_control,
)
from advsearch.controls.values import Number, OneOf, read
from advsearch.errors import InputError, UnknownNameError
from advsearch.options import BY_KEY
from advsearch.scene.description import SceneDescription

MOST_VALUES = 100_000  # values of one axis, at most; more are for draws
TURN = 360.0  # degrees after which a periodic parameter is the same again

_OUTER = {"object": "`object` mug,bowl", "environment": "`environment` studio,noon", "model": "`model` a.pt2,b.pt2"}


@dataclass(frozen=True)
class Axis:
    """One parameter and its values. The instance has the name of its kind unless said otherwise."""

    control: str
    instance: str
    parameter: Parameter
    values: tuple[Number, ...]

    @property
    def name(self) -> str:
        """How it is stored: ``pose.yaw``, or ``key.power`` of a light called key."""
        return f"{self.instance}.{self.parameter.name}"

    @property
    def is_time(self) -> bool:
        return (self.control, self.parameter.name) == ("path", "time")

    @property
    def unit(self) -> str:
        return "name" if self.parameter.options else self.parameter.unit


# ---- reading --------------------------------------------------------------------------------------------------------


def read_axes(grid: Mapping[str, object], controls: Sequence[Control]) -> tuple[Axis, ...]:
    """Return the axes of a grid beside the controls that are drawn by chance: name to values, ``"FIRST:LAST:COUNT"`` or
    a list. A name is KIND.PARAMETER, INSTANCE.PARAMETER of one of `controls`, KIND:INSTANCE.PARAMETER, or mitsuba:KEY.
    """
    instances = {control.name: control for control in controls}
    axes: dict[str, Axis] = {}
    for name, given in grid.items():
        axis = _read_axis(name, given, instances)
        if axis.name in axes:
            raise InputError(f"`grid` {name}: {axis.name} is given twice; leave one of the two out")
        drawn = instances.get(axis.instance)
        if isinstance(drawn, NumberControl) and axis.parameter.name in drawn.specs:
            raise InputError(
                f"`grid` {name}: `controls` {axis.instance} sets {axis.parameter.name} too; leave it out of one "
                "of the two"
            )
        axes[axis.name] = axis
    return tuple(axes.values())


def _read_axis(name: str, given: Any, instances: Mapping[str, Control]) -> Axis:
    head, dot, rest = name.partition(".")
    parameter_name, colon, late = rest.partition(":")
    kind, early_colon, early = head.partition(":")
    instance = head if head in instances else instance_of(kind, late or early)
    if head in _OUTER and not dot:
        raise InputError(f"`grid` {name}: several of them are given as a list: {_OUTER[head]}")
    control: Any = type(instances[instance]) if instance in instances else CONTROLS.get(kind)
    if control is None:
        hint = f"It stands in `grid` {name}; write `grid` CONTROL.PARAMETER=VALUES, such as pose.yaw=0:360:24."
        raise unknown_control(kind, hint, instances)
    if kind == BY_KEY:  # the scene names the parameter, and says later whether there is such a one
        key = name.partition(":")[2]
        if not key:
            raise InputError(f"`grid` {name}: expected Mitsuba's name and values, as in {BY_KEY}:KEY=FIRST:LAST:COUNT")
        (parameter,) = control.declared([key])
        return Axis(BY_KEY, BY_KEY, parameter, axis_values(f"`grid` {name}", parameter, given))
    there = instances[instance].own if instance in instances else ()
    own = {parameter.name: parameter for parameter in (*control.declared({parameter_name: given}), *there)}
    if not parameter_name:
        raise InputError(f"`grid` {name}: expected CONTROL.PARAMETER, got no parameter; choose one of {', '.join(own)}")
    check_instance(f"`grid` {name}", late or early, colon or early_colon)
    if parameter_name not in own:
        raise UnknownNameError(f"parameter of control {control.kind}", parameter_name, list(own), f"In `grid` {name}.")
    parameter = own[parameter_name]
    pictures = any(len(declared.shape) > 1 for declared in control.parameters)
    if pictures or not issubclass(control, NumberControl) or parameter.shape != ():
        raise InputError(
            f"`grid` {name}: expected a parameter that is one number or name, got one that is many numbers; draw it "
            f"by chance with `controls` {instance} `samples=100`"
        )
    return Axis(control.kind, instance, parameter, axis_values(f"`grid` {name}", parameter, given))


def axis_values(where: str, parameter: Parameter, given: Any) -> tuple[Number, ...]:
    """Return the values of an axis, checked, from a text, a value, or a list; errors name `where`.
    ``"FIRST:LAST:COUNT"`` is COUNT values evenly spaced from FIRST to LAST, both included; of a periodic parameter over
    a whole turn, LAST would repeat FIRST and is left out."""
    values: Sequence[Any] = given if isinstance(given, (list, tuple)) else [given]
    if isinstance(given, str) and ":" in given and not parameter.options:
        values = _spaced(where, parameter, given)
    if not values:
        raise InputError(f"{where}: expected at least one value, got none; write FIRST:LAST:COUNT or a list")
    if len(values) > MOST_VALUES:
        raise InputError(_too_many(where, len(values)))
    plain = [one.item() if hasattr(one, "item") else one for one in values]
    spec = read(where, parameter, {"choices": plain})
    assert isinstance(spec, OneOf)
    _check_different(where, parameter, spec.values)
    return spec.values


def _spaced(where: str, parameter: Parameter, text: str) -> list[float]:
    expected = f"{where}: expected FIRST:LAST:COUNT such as 0:360:24, or values separated by commas, got {text!r}"
    parts = text.split(":")
    if len(parts) != 3:
        raise InputError(expected)
    try:
        first, last, count = float(parts[0]), float(parts[1]), int(parts[2])
    except ValueError:
        raise InputError(f"{expected}; FIRST and LAST are numbers and COUNT is a whole number") from None
    if not (math.isfinite(first) and math.isfinite(last)):
        raise InputError(f"{expected}; FIRST and LAST have to be finite")
    if count < 1:
        raise InputError(f"{where}: expected a COUNT of at least 1, got {count} in {text!r}")
    if count > MOST_VALUES:
        raise InputError(_too_many(where, count))
    if last < first:
        raise InputError(f"{where}: the range {text!r} is reversed; write {last:g}:{first:g}:{count}")
    if first == last and count > 1:
        raise InputError(f"{where}: FIRST and LAST are the same in {text!r}; write {first:g} for the one value")
    turns = parameter.periodic and parameter.unit == "degrees"
    if turns and last - first > TURN:
        raise InputError(
            f"{where}: {text!r} is more than a whole turn, so that values would repeat; write "
            f"{first:g}:{first + TURN:g}:{count}"
        )
    whole = turns and last - first == TURN
    return [float(value) for value in np.linspace(first, last, count, endpoint=not whole)]


def _too_many(where: str, count: int) -> str:
    return (
        f"{where}: expected at most {MOST_VALUES} values on an axis, got {count}; draw the parameter by chance "
        "instead, with `controls` and `samples`"
    )


def _check_different(where: str, parameter: Parameter, values: Sequence[Number]) -> None:
    seen: dict[Number, Number] = {}
    for value in values:
        same = value
        if parameter.periodic and parameter.unit == "degrees" and not isinstance(value, str):
            same = round(value % TURN, 9) % TURN
        if same in seen:
            first, again = seen[same], value
            what = f"{_said(again)} twice" if first == again else f"{_said(first)} and {_said(again)}, the same angle"
            raise InputError(f"{where}: expected different values, got {what}; leave one of them out")
        seen[same] = value
    if parameter.options or any(isinstance(value, str) for value in values):
        return
    singles = sorted(np.float32(value) for value in values)
    if any(low == high for low, high in pairwise(singles)):
        raise InputError(
            f"{where}: expected values that differ in single precision, which scenes have; space them wider"
        )


def _said(value: Number) -> str:
    return value if isinstance(value, str) else f"{value:g}"


# ---- putting them into controls -------------------------------------------------------------------------------------


def on_grid(controls: Sequence[Control], axes: Sequence[Axis], scene: SceneDescription) -> tuple[Control, ...]:
    """Return the controls with the axes among their parameters as discrete choices.

    The other parameters of a control that is drawn keep being drawn; those of one that is only in the grid stay as the
    scene has them.
    """
    on = {control.name: control for control in controls}
    for instance in dict.fromkeys(axis.instance for axis in axes):
        own = [axis for axis in axes if axis.instance == instance]
        drawn = on.get(instance)
        kind: Any = CONTROLS[own[0].control] if drawn is None else type(drawn)
        given = _ranges(drawn, scene) if isinstance(drawn, NumberControl) else {}
        given |= {axis.parameter.name: {"choices": list(axis.values)} for axis in own}
        on[instance] = kind(name=instance, **given)
    return tuple(on.values())


def _ranges(control: NumberControl, scene: SceneDescription) -> dict[str, object]:
    """Settings of a control with the ranges spelled out that it has by default."""
    given = {name: value for name, value in control.settings().items() if name not in ("kind", "name")}
    if control.asked:
        return given
    there = control.within(scene)
    for parameter in control.parameters:
        reach = there.search_range(parameter)
        if parameter.name not in control.specs and reach is not None:
            given[parameter.name] = {"choices": list(parameter.options)} if parameter.options else list(reach)
    return given
