"""The numbers and colours of a scene by Mitsuba's own names (the keys of `mitsuba.traverse`)."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.description import SceneDescription
from advsearch.scene.mitsuba_backend.parts import color, number
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import mi
from advsearch.scene.parts import PluginNumber
from advsearch.scene.settings import CHANNELS

SMALL = (8, 8)
"""Height and width of the picture of a scene that is only asked for its names."""
BEHIND = ("differences",)
"""Valid estimators of what Mitsuba has no derivative of."""
STILL = ("adjoint", *BEHIND)
"""Of what Mitsuba can differentiate and moves no outline."""
UNSURE = (*BEHIND, "adjoint")
"""Of what Mitsuba can differentiate, but for what changes at an outline or all at once."""


def plugin_numbers(description: SceneDescription, name: str, keys: tuple[str, ...]) -> tuple[PluginNumber, ...]:
    """Return some numbers and colours of a scene by Mitsuba's names, each once; `KEY.red` is a channel of the colour
    KEY. Their inputs begin with the name of the part that they will be in, but for those that the scene has as other
    inputs.

    Raises:
        UnknownNameError: the scene has no such key; the message has near ones.
        InputError: it is something else than a number or a colour.
    """
    numbers, others = _all(description)
    channels = {f"{key}.{channel}": key for key in numbers for channel in CHANNELS if len(numbers[key].values) > 1}
    keys = tuple(dict.fromkeys(channels.get(key, key) for key in keys))
    for key in keys:
        if key in others:
            raise InputError(
                f"`controls` mitsuba:{key}: expected a number or a colour, and Mitsuba has {others[key]} there; other "
                "controls may move it, such as pose and texture"
            )
        if key not in numbers:
            raise UnknownNameError("number or colour in Mitsuba", key, numbers)
    return tuple(replace(numbers[key], input=numbers[key].input or f"{name}.{key}") for key in keys)


@lru_cache(maxsize=1)
def _all(description: SceneDescription) -> tuple[dict[str, PluginNumber], dict[str, str]]:
    """Every number and colour of a scene by its key, without inputs but for those that it has; and the type of the
    rest."""
    scene = MitsubaScene(description, SMALL)
    inputs = {key: name for name, (key, takes) in scene.declared.items() if takes.write in (number, color)}
    numbers: dict[str, PluginNumber] = {}
    others: dict[str, str] = {}
    for key in scene.parameters.keys():
        value, flags = scene.parameters[key], scene.parameters.flags(key)
        plain = isinstance(value, float)
        if not (plain or (isinstance(value, mi.Float) and len(value) == 1) or isinstance(value, mi.Color3f)):
            others[key] = f"a {type(value).__name__}"
            continue
        still = flags == mi.ParamFlags.Differentiable.value
        valid = BEHIND if flags & mi.ParamFlags.NonDifferentiable.value else STILL if still else UNSURE
        values = (value,) if plain else tuple(map(float, np.array(value).reshape(-1)))
        numbers[key] = PluginNumber(key, values, inputs.get(key, ""), valid, plain)
    return numbers, others
