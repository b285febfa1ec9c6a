"""The named, bounded numbers of a scene that `--set` fixes, and their defaults.

A setting has the name that the matching control parameter has (`camera.azimuth`), so that what is fixed today can be
searched tomorrow under the same name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from advsearch.errors import InputError, UnknownNameError


@dataclass(frozen=True)
class Setting:
    """One fixed number of a scene.

    Attributes:
        name: `family.parameter`.
        default: the value when nothing is said; None means that the scene works it out (see `description`).
        low: smallest allowed value, in `unit`.
        high: largest allowed value, in `unit`.
        unit: unit of the value, or "1" for a plain number.
        description: one sentence for the help text.
    """

    name: str
    default: float | None
    low: float
    high: float
    unit: str
    description: str


_TABLE = (
    Setting("camera.azimuth", 40.0, -3600.0, 3600.0, "degrees", "Direction of the camera around the object."),
    Setting("camera.elevation", 25.0, -89.0, 89.0, "degrees", "Height of the camera above the ground plane."),
    Setting("camera.roll", 0.0, -360.0, 360.0, "degrees", "Rotation of the picture, counter-clockwise."),
    Setting(
        "camera.distance", None, 0.05, 1000.0, "object sizes", "Distance to the object's middle; fits it if unset."
    ),
    Setting("camera.fov", 35.0, 1.0, 170.0, "degrees", "Field of view along the larger side of the picture."),
    Setting("camera.exposure", 0.0, -10.0, 10.0, "stops", "Brightness relative to the metered exposure."),
    Setting("pose.yaw", 0.0, -3600.0, 3600.0, "degrees", "Rotation of the object about the vertical."),
    Setting("pose.pitch", 0.0, -360.0, 360.0, "degrees", "Rotation of the object about its y axis."),
    Setting("pose.roll", 0.0, -360.0, 360.0, "degrees", "Rotation of the object about its x axis."),
    Setting("pose.x", 0.0, -1e4, 1e4, "object sizes", "Shift of the object along x."),
    Setting("pose.y", 0.0, -1e4, 1e4, "object sizes", "Shift of the object along y."),
    Setting("pose.z", 0.0, -1e4, 1e4, "object sizes", "Height of the object above the ground plane."),
    Setting("pose.scale", 1.0, 0.01, 100.0, "1", "Size of the object relative to its default."),
    Setting("environment.rotation", 0.0, -3600.0, 3600.0, "degrees", "Rotation of the environment about the vertical."),
    Setting("environment.exposure", 0.0, -10.0, 10.0, "stops", "Brightness of the environment, after metering."),
    Setting("ground.size", 3.0, 0.0, 1000.0, "object sizes", "Side of the square ground plane; 0 leaves it out."),
    Setting("ground.red", 0.55, 0.0, 1.0, "sRGB", "Red of the ground plane."),
    Setting("ground.green", 0.45, 0.0, 1.0, "sRGB", "Green of the ground plane."),
    Setting("ground.blue", 0.37, 0.0, 1.0, "sRGB", "Blue of the ground plane."),
    Setting("material.roughness", None, 0.0, 1.0, "1", "Roughness of the surface; the object's own if unset."),
    Setting("material.metallic", None, 0.0, 1.0, "1", "How metallic the surface is; the object's own if unset."),
    Setting("material.specular", None, 0.0, 1.0, "1", "Specular reflectance; the object's own if unset."),
    Setting("material.clearcoat", None, 0.0, 1.0, "1", "Strength of a clear coat; the object's own if unset."),
)

SETTINGS: Mapping[str, Setting] = {setting.name: setting for setting in _TABLE}


def resolve(given: Mapping[str, float]) -> dict[str, float | None]:
    """Return every setting's value: what was given, checked, over the defaults.

    Raises:
        UnknownNameError: a name is not a setting.
        InputError: a value is not a finite number inside its range.
    """
    values: dict[str, float | None] = {name: setting.default for name, setting in SETTINGS.items()}
    for name, value in given.items():
        values[name] = _checked(name, value)
    return values


def _checked(name: str, value: object) -> float:
    if name not in SETTINGS:
        raise UnknownNameError("scene parameter", name, SETTINGS, "Write it as `set` NAME=VALUE.")
    setting = SETTINGS[name]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"`set` {name}: expected a number in {setting.unit}, got {value!r}")
    number = float(value)
    if not math.isfinite(number) or not setting.low <= number <= setting.high:
        raise InputError(
            f"`set` {name}: expected a number from {setting.low:g} to {setting.high:g} ({setting.unit}), got {number:g}"
        )
    return number
