"""The clean scene: the one that the object, the environment and the settings describe, and nothing else.

A control's fixed value is another way of describing the scene. Where a control leaves out a value that was asked for,
fixed, in a range or in a list, the two contradict each other, and that is refused. Where it leaves out only a default,
the clean scene has the nearest value that the control does allow, and that is said: a `Moved`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from advsearch.errors import InputError
from advsearch.scene.description import ENVIRONMENT, SceneDescription, check_one_environment
from advsearch.scene.settings import SETTINGS

Number = float | str

TURN = 360.0
CLOSE = 1e-6
"""Relative difference up to which two values are the same."""


@dataclass(frozen=True)
class Moved:
    """A value of the clean scene that a control leaves out, although nobody asked for it.

    Attributes:
        control: the instance's name.
        parameter: how it is addressed: ``pose.yaw``, ``ground.size``, ``environment``.
        unit: of the values; "name" for names.
        scene: the value of the scene as it was described.
        used: the value that the clean scene has instead.
    """

    control: str
    parameter: str
    unit: str
    scene: Number
    used: Number


def sentences(moved: Sequence[Moved]) -> list[str]:
    """Return what is said of the values that had to move: one sentence a control."""
    found = []
    for control, several in groupby(moved, key=lambda one: one.control):
        values = " and ".join(map(_instead, several))
        found.append(f"The clean scene has {values}, which the control {control} leaves out.")
    return found


def check_prepared(control: str, before: SceneDescription, after: SceneDescription) -> Iterator[Moved]:
    """Yield what a control has replaced in a scene by what it needs there, and nobody has described.

    Raises:
        InputError: it was asked for.
    """
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
                f"{shown(value)}; change one of the two, or leave one out"
            )
        yield Moved(control, name, SETTINGS[name].unit, scene, value)


def check_start(
    control: str, parameter: str, allowed: str, setting: str, scene: SceneDescription, wanted: Number
) -> None:
    """Check that a value which the clean scene cannot have was not asked for.

    Args:
        control: the instance's name.
        parameter: its parameter.
        allowed: what the parameter is set to, in words.
        setting: the setting of the scene that says the same.
        scene: as it was described.
        wanted: the parameter's value in it.

    Raises:
        InputError: it was.
    """
    if setting not in scene.given:
        return
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
    return value if isinstance(value, str) else f"{value:g}"


def _instead(one: Moved) -> str:
    unit = "" if one.unit in ("1", "name") or isinstance(one.used, str) else f" {one.unit}"
    return f"{one.parameter} {shown(one.used)}{unit} instead of {shown(one.scene)}"
