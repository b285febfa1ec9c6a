"""Read Mitsuba's own data: keys of a scene's numbers and colors, tables of its sky."""

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
from advsearch.scene.mitsuba_backend.parts import to_color, to_flat_array
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import mi
from advsearch.scene.mitsuba_backend.writing import EXTRA_DEPTH as EXTRA_DEPTH
from advsearch.scene.mitsuba_backend.writing import SCENE_FILE_NAME as SCENE_FILE_NAME
from advsearch.scene.mitsuba_backend.writing import write_scene as write_scene
from advsearch.scene.parts import PluginNumber
from advsearch.scene.settings import CHANNELS

SMALL_RESOLUTION = (8, 8)  # height and width of a scene of which only the keys are read
DIFFERENCES_ONLY = ("differences",)  # valid estimators where Mitsuba has no derivative
ADJOINT_FIRST = (
    "adjoint",
    *DIFFERENCES_ONLY,
)  # where Mitsuba has one, and no outline moves
# where Mitsuba has one, but for what changes at an outline or all at once
DIFFERENCES_FIRST = (*DIFFERENCES_ONLY, "adjoint")


def find_plugin_numbers(
    description: SceneDescription, name: str, keys: tuple[str, ...]
) -> tuple[PluginNumber, ...]:
    """Return the numbers and colors of a scene by Mitsuba's keys, each once.

    For `KEY.red`, a channel of the color KEY, the full color is returned.

    Args:
        description: the scene.
        name: name of the part that will hold them: an input is called `name.KEY`,
            unless the scene has an input for this number already.
        keys: Mitsuba's keys.

    Raises:
        UnknownNameError: the scene has no such key; the message has near ones.
        InputError: there is something else than a number or a color.
    """
    numbers, other_types = _find_numbers(description)
    color_of_channel = _map_channels(numbers)
    # in the requested order, a color of which several channels are requested once
    full_keys = tuple(dict.fromkeys(color_of_channel.get(key, key) for key in keys))
    for key in full_keys:
        _check_is_number(key, numbers, other_types)
    # The scene may have an input for the number already; else it gets a new one.
    return tuple(
        replace(numbers[key], input=numbers[key].input or f"{name}.{key}")
        for key in full_keys
    )


def _map_channels(numbers: dict[str, PluginNumber]) -> dict[str, str]:
    """Return the key of each color by the keys of its channels.

    A channel's key is such as "mug.bsdf.reflectance.red".
    """
    color_of_channel: dict[str, str] = {}
    for key, plugin_number in numbers.items():
        if len(plugin_number.values) > 1:
            color_of_channel |= {f"{key}.{channel}": key for channel in CHANNELS}
    return color_of_channel


def _check_is_number(
    key: str, numbers: dict[str, PluginNumber], other_types: dict[str, str]
) -> None:
    """Raise an error if a scene has no number or color at one of Mitsuba's keys.

    `numbers` and `other_types` are those of `_find_numbers`.
    """
    if key in other_types:
        raise InputError(
            f"`controls` mitsuba:{key}: expected a number or a colour, and Mitsuba "
            f"has {other_types[key]} there; other controls may move it, such as "
            "pose and texture"
        )
    if key not in numbers:
        raise UnknownNameError("number or colour in Mitsuba", key, numbers)


@lru_cache(maxsize=1)
def _find_numbers(
    description: SceneDescription,
) -> tuple[dict[str, PluginNumber], dict[str, str]]:
    """Find all numbers and colors of a scene; the result for the last scene is cached.

    The scene is loaded at a small size, only to list its parameters.

    Returns:
        The numbers and colors by Mitsuba's key, with the name of the scene's own input
        if there is one; and the type of everything else by its key, for messages.
    """
    scene = MitsubaScene(description, SMALL_RESOLUTION)
    input_of_key = _find_input_names(scene)
    numbers: dict[str, PluginNumber] = {}
    other_types: dict[str, str] = {}
    for key in scene.parameters.keys():
        value = scene.parameters[key]
        values = _read_values(value)
        if values is None:
            other_types[key] = f"a {type(value).__name__}"
        else:
            name = input_of_key.get(key, "")
            numbers[key] = _make_plugin_number(scene, key, values, name)
    return numbers, other_types


def _make_plugin_number(
    scene: MitsubaScene, key: str, values: tuple[float, ...], input_name: str
) -> PluginNumber:
    """Return a number or a color of a scene by Mitsuba's key.

    `input_name` is the scene's own input for it, or empty.
    """
    return PluginNumber(
        key,
        values,
        input=input_name,
        valid=_find_valid_estimators(scene.parameters.flags(key)),
        # A Python float is a constant that Mitsuba compiles into its kernels.
        plain=isinstance(scene.parameters[key], float),
    )


def _find_input_names(scene: MitsubaScene) -> dict[str, str]:
    """Return names of a scene's inputs that are numbers or colors, by Mitsuba's key.

    These are written with the functions `to_flat_array` and `to_color`; textures and
    poses are not.
    """
    return {
        key: name
        for name, (key, scene_input) in scene.declared_inputs.items()
        if scene_input.convert_to_mitsuba in (to_flat_array, to_color)
    }


def _read_values(value: object) -> tuple[float, ...] | None:
    """Return the number or the three of a color of Mitsuba; None for anything else."""
    if isinstance(value, float):
        return (value,)
    is_single_number = isinstance(value, mi.Float) and len(value) == 1
    if is_single_number or isinstance(value, mi.Color3f):
        return tuple(map(float, np.array(value).reshape(-1)))
    return None


def _find_valid_estimators(flags: int) -> tuple[str, ...]:
    """Return the estimators that are valid for a parameter, the best one first.

    Args:
        flags: Mitsuba's `ParamFlags`.
    """
    if flags & mi.ParamFlags.NonDifferentiable.value:
        return DIFFERENCES_ONLY
    if flags == mi.ParamFlags.Differentiable.value:
        return ADJOINT_FIRST
    # `Differentiable` and `Discontinuous`: the adjoint misses what changes at outlines.
    return DIFFERENCES_FIRST


def read_sunsky_tables() -> tuple[Tensor, Tensor, Tensor]:
    """Read the coefficients of Hosek and Wilkie's sky and sun that Mitsuba brings.

    They are the RGB ones of its `sunsky` plugin.

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
