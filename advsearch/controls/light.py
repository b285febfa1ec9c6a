"""The `light` control: a lamp with a position, a color, a power and, as a ball, a size.

The unit of the power is the irradiance `E` with which a white surface (reflectance 0.8)
has the display value `LIT_WHITE`. A lamp of power p and linear color c has the irradiance
`p c E / d^2` on a surface that faces it at distance d:

    point              intensity I = p c E
    ball of radius r   radiance L = p c E / (pi r^2)

The irradiance of a uniform ball is `pi L r^2 / d^2` (Cohen and Wallace 1993, Radiosity
and Realistic Image Synthesis, section 2.4). So the size changes how soft the shadows
are, but not the irradiance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from advsearch.controls.base import Choice, Control, Values
from advsearch.controls.ranges import Fixed, ParameterValue
from advsearch.errors import InputError
from advsearch.scene import color
from advsearch.scene.description import SceneDescription
from advsearch.scene.formation import CARD_REFLECTANCE, compute_metered_gain
from advsearch.scene.geometry import make_affine
from advsearch.scene.parts import BallLamp, PointLamp
from advsearch.scene.settings import Parameter

# linear display value of a white surface that faces a lamp of power 1 at distance 1
LIT_WHITE = 0.9
DEFAULT_POWER = 6.0
"""Power of a lamp if only other parameters are searched. At its default position the lamp
is then about as bright as the environment.
"""


def compute_metered_irradiance(scene: SceneDescription) -> float:
    """Return the irradiance, in scene units, at which white has the value `LIT_WHITE`.

    The display value is that with the scene's metered gain.
    """
    return LIT_WHITE * math.pi / (CARD_REFLECTANCE * compute_metered_gain(scene))


def _make_coordinate(
    name: str, low: float, high: float, default: float, description: str
) -> Parameter:
    """Return a parameter for a coordinate of the lamp, searched from `low` to `high`.

    Its gradient is estimated by finite differences. It moves outlines in the image, those
    of shadows and of the visible ball, for which an adjoint would be wrong.
    """
    limit = 1000.0
    return Parameter.moving(
        estimators=("differences",),
        name=name,
        unit="object sizes",
        low=-limit,
        high=limit,
        default=default,
        text=description,
        search=(low, high),
    )


class LightControl(Control):
    """A lamp: its position, colour and power, and the size of an area light."""

    kind = "light"
    strength_parameter = "power"
    parameters = (
        _make_coordinate("x", -2.0, 2.0, 1.5, "Position of the lamp's centre along x."),
        _make_coordinate(
            "y", -2.0, 2.0, -1.0, "Position of the lamp's centre along y."
        ),
        _make_coordinate(
            "z", 2.0, 3.5, 2.0, "Height of the lamp's centre above the ground plane."
        ),
        *Parameter.colors("of the lamp's colour.", (0.6, 1.0)),
        Parameter.number(
            Parameter.LIT,
            "power",
            "1",
            0.0,
            1000.0,
            0.0,
            "Irradiance at a distance of one object size, as a multiple of the "
            "irradiance at which a white surface is displayed just below white.",
            (0.0, 12.0),
        ),
        Parameter.moving(
            ("differences",),
            "size",
            "object sizes",
            0.001,
            10.0,
            0.2,
            "Diameter of an area light; a point light has no size.",
            (0.05, 0.6),
            log=True,
        ),
    )
    choices = (
        Choice(
            "type",
            "area",
            "area (a luminous ball: soft shadows, visible) or point (sharp "
            "shadows, invisible).",
            options=("area", "point"),
        ),
    )

    def check_choices(self) -> None:
        if self.choice_values["type"] == "point" and "size" in self._settings:
            raise InputError(
                f"{self.name}.size: expected none for a point light, got "
                f"{self._settings['size']!r}; leave it out, or set "
                f"{self.name}.type to area"
            )

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter for this lamp.

        If only other parameters are searched, the default power is not 0, because a
        dark lamp has no effect. The size of a point is not searched.
        """
        needs_power = self.has_requested_range and not self.is_searched("power")
        if parameter.name == "power" and needs_power:
            return replace(parameter, default=DEFAULT_POWER)
        if parameter.name == "size" and self.choice_values["type"] == "point":
            return replace(parameter, search=None)
        return parameter

    def get_value_without_control(self, parameter: Parameter) -> ParameterValue:
        return 0.0  # only that of the power is used (`strength_parameter`)

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        lamp = PointLamp if self.choice_values["type"] == "point" else BallLamp
        power = self.specs.get("power")
        return scene.with_part(
            lamp(self.name, dark=isinstance(power, Fixed) and power.value == 0.0)
        )

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the lamp's position and its brightness."""
        position = torch.stack([values[axis] for axis in ("x", "y", "z")])
        intensity = self._compute_intensity(values)
        if self.choice_values["type"] == "point":
            return {
                f"{self.name}.position": position,
                f"{self.name}.intensity": intensity,
            }
        radius = values["size"] / 2.0
        # A ball looks like a disk of area pi r^2 from far away, so that its intensity
        # is its radiance times that area.
        return {
            f"{self.name}.ball": make_ball_pose(position, radius),
            f"{self.name}.radiance": intensity / (math.pi * radius**2),
        }

    def _compute_intensity(self, values: Values) -> Tensor:
        """Return the radiant intensity (3,) of the lamp.

        At a distance of 1 the irradiance is the intensity.
        """
        irradiance = compute_metered_irradiance(self.scene)
        return color.combine_channels(values) * values["power"] * irradiance


def make_ball_pose(center: Tensor, radius: Tensor) -> Tensor:
    """Return the pose (4, 4) of the unit ball for a center (3,) and a radius ()."""
    return make_affine(torch.eye(3).to(center) * radius, center)
