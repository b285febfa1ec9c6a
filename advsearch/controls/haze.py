"""The `haze` control: a uniform haze around camera and object, by how dense it is and of which colour.

A share `1 - exp(-density * l)` of the light is taken out of a line of length l (Beer and Lambert), and scattered light
comes in: `advsearch.scene.mitsuba_backend.own_plugins` has the equation. Colour is the share that is scattered and not
absorbed, per channel: white haze takes nothing away, dark haze is smoke. Haze fills a ball; the environment is outside.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from advsearch.controls.base import Number, Parameter, number
from advsearch.controls.numbers import NumberControl, Values
from advsearch.controls.ranges import Range
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.parts import HazePart
from advsearch.scene.settings import CHANNELS, LIT, colors

LEAST_RADIUS = 4.0  # the haze reaches at least this far from the scene's middle, object sizes
BEHIND_CAMERA = 1.5  # it reaches at least so many times as far as the camera is away
THIN_HAZE = 0.1  # density where it is not searched and was not given


class HazeControl(NumberControl):
    """A uniform haze around camera and object."""

    kind = "haze"
    amount = "density"
    summary = "A uniform haze around camera and object: how dense it is, and its colour."
    parameters = (
        number(
            LIT, "density", "per object size", 0.0, 2.0, 0.0,
            "Extinction: over 1 / density the haze takes 63 % of the light out of a ray.", (0.0, 0.3),
        ),
        *colors("of the haze: what it scatters and does not absorb.", (0.6, 1.0), low=0.02),
    )  # fmt: skip

    def default(self, parameter: Parameter) -> Number:
        if (own := _haze_of(self.scene)) is not None:
            color = dict(zip(CHANNELS, linear_to_srgb(np.asarray(own.albedo, np.float32)).tolist(), strict=True))
            return own.density if parameter.name == "density" else color[parameter.name]
        if parameter.name == "density" and self.asked and not self.searches("density"):
            return THIN_HAZE
        return parameter.default

    def unchanged(self, parameter: Parameter) -> Number:
        return parameter.default if _haze_of(self.scene) is None else self.default(parameter)

    def estimators(self, parameter: Parameter) -> tuple[str, ...]:
        if parameter.name != "density":
            return parameter.estimators
        spec = self.specs.get("density")
        return parameter.estimators if isinstance(spec, Range) and spec.low > 0.0 else ("differences",)

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        if (own := _haze_of(scene)) is not None:
            named = replace(own, name=self.name)
            return replace(scene, parts=tuple(named if part is own else part for part in scene.parts))
        away = float(np.linalg.norm(camera_to_world(scene)[:3, 3]))
        return scene.with_part(HazePart(self.name, max(LEAST_RADIUS, BEHIND_CAMERA * away)))

    def scene_inputs(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Tensor]:
        albedo = srgb_to_linear(torch.stack([values[channel] for channel in CHANNELS]))
        return {f"{self.name}.density": values["density"].reshape(1), f"{self.name}.albedo": albedo}


def _haze_of(scene: SceneDescription) -> HazePart | None:
    """The haze that a scene comes with."""
    return next((part for part in scene.parts if isinstance(part, HazePart) and part.density), None)
