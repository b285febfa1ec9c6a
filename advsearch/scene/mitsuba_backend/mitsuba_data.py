"""What added parts need of Mitsuba: its names of a scene's numbers and colors, the
tables of its sky, its files.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.description import SceneDescription
from advsearch.scene.mitsuba_backend.parts import color, number
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import mi
from advsearch.scene.mitsuba_backend.writing import NAME as NAME
from advsearch.scene.mitsuba_backend.writing import SCATTERINGS as SCATTERINGS
from advsearch.scene.mitsuba_backend.writing import write_scene as write_scene
from advsearch.scene.parts import PluginNumber
from advsearch.scene.settings import CHANNELS

# height and width of the picture of a scene that is only asked for its names
SMALL = (8, 8)
BEHIND = ("differences",)  # valid estimators of what Mitsuba has no derivative of
STILL = ("adjoint", *BEHIND)  # of what Mitsuba can differentiate and moves no outline
# of what Mitsuba can differentiate, but for what changes at an outline or all at once
UNSURE = (*BEHIND, "adjoint")


def plugin_numbers(
    description: SceneDescription, name: str, keys: tuple[str, ...]
) -> tuple[PluginNumber, ...]:
    """Return some numbers and colours of a scene by Mitsuba's names, each once;
    `KEY.red` is a channel of the colour KEY. Their inputs begin with the name of the
    part that they will be in, but for those that the scene has as other inputs.

    Raises:
        UnknownNameError: the scene has no such key; the message has near ones.
        InputError: it is something else than a number or a colour.
    """
    numbers, others = _all(description)
    channels = {
        f"{key}.{channel}": key
        for key in numbers
        for channel in CHANNELS
        if len(numbers[key].values) > 1
    }
    keys = tuple(dict.fromkeys(channels.get(key, key) for key in keys))
    for key in keys:
        if key in others:
            raise InputError(
                f"`controls` mitsuba:{key}: expected a number or a colour, and Mitsuba "
                f"has {others[key]} there; other "
                "controls may move it, such as pose and texture"
            )
        if key not in numbers:
            raise UnknownNameError("number or colour in Mitsuba", key, numbers)
    return tuple(
        replace(numbers[key], input=numbers[key].input or f"{name}.{key}")
        for key in keys
    )


@lru_cache(maxsize=1)
def _all(
    description: SceneDescription,
) -> tuple[dict[str, PluginNumber], dict[str, str]]:
    """Every number and colour of a scene by its key, with an input if it has one; and
    the type of the rest.
    """
    scene = MitsubaScene(description, SMALL)
    inputs = {
        key: name
        for name, (key, takes) in scene.declared.items()
        if takes.write in (number, color)
    }
    numbers: dict[str, PluginNumber] = {}
    others: dict[str, str] = {}
    for key in scene.parameters.keys():
        value = scene.parameters[key]
        flags = scene.parameters.flags(key)
        plain = isinstance(value, float)
        if not (
            plain
            or (isinstance(value, mi.Float) and len(value) == 1)
            or isinstance(value, mi.Color3f)
        ):
            others[key] = f"a {type(value).__name__}"
            continue
        still = flags == mi.ParamFlags.Differentiable.value
        valid = (
            BEHIND
            if flags & mi.ParamFlags.NonDifferentiable.value
            else STILL
            if still
            else UNSURE
        )
        values = (value,) if plain else tuple(map(float, np.array(value).reshape(-1)))
        numbers[key] = PluginNumber(key, values, inputs.get(key, ""), valid, plain)
    return numbers, others


def sunsky_tables() -> tuple[Tensor, Tensor, Tensor]:
    """Read the RGB coefficients of Hosek and Wilkie's sky and sun that Mitsuba ships
    for its `sunsky` plugin.

    Returns:
        (10 turbidities, 2 ground albedos, 6 control points, 3 channels, 9) shape of the
        dome; (10, 2, 6, 3) its mean radiance; and (10, 45 pieces, 3 channels, 4 powers
        of the elevation, 6 powers of the cosine at the limb) radiance of the sun. All
        float32.
    """
    path = Path(str(mi.__file__)).parent / "data" / "sunsky" / "sunsky_datasets.bin"
    with contextlib.redirect_stdout(io.StringIO()):  # the reader prints what it loads
        tables = mi.tensor_io.read(str(path))
    names = ("sky_params_rgb", "sky_rad_rgb", "sun_rad_rgb")
    shape, level, sun = (torch.from_numpy(tables[name]).float() for name in names)
    return shape, level, sun
