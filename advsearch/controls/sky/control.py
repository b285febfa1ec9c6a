"""The `sky` control: a clear sky with a sun instead of the environment; where the sun stands and how hazy the air is.

The map is `dome`'s (Hosek and Wilkie 2012, 2013). The same sun is hundreds of times darker at the
horizon than at noon, so exposure matters. By default every configuration is metered, as an automatic camera would: the
sky is scaled so that a surface facing the sun receives the same irradiance `M` always,

    radiance = map(azimuth, elevation, turbidity) M / m(azimuth, elevation, turbidity),

with m the map's irradiance towards the sun. With `exposure: fixed` the divisor is that of the start, and a low sun is a
dark picture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from advsearch.controls.base import Choice, Parameter
from advsearch.controls.numbers import NumberControl, Values
from advsearch.controls.sky.dome import TURBIDITIES, Sky
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import SceneDescription

METERED_IRRADIANCE = 0.9 * math.pi / 0.8
"""`M`: the irradiance on what faces the sun, the same for every sky that is metered."""


class SkyControl(NumberControl):
    """A sun and a clear sky in place of the environment."""

    kind: ClassVar[str] = "sky"
    summary: ClassVar[str] = "A clear sky instead of the environment: where the sun stands, and how hazy the air is."
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "azimuth", (), "degrees", -3600.0, 3600.0, 90.0, "Direction of the sun about the vertical; 0 is +x.",
            periodic=True, search=(0.0, 360.0), estimators=("differences",),
        ),
        Parameter(
            "elevation", (), "degrees", 2.0, 90.0, 45.0, "Height of the sun above the horizon.", search=(5.0, 85.0),
            estimators=("differences",),
        ),
        Parameter(
            "turbidity", (), "1", *TURBIDITIES, 3.0,
            "How much the air scatters: 2 is very clear, 3 clear, 6 warm and moist, 10 hazy.", search=(2.0, 8.0),
            estimators=("adjoint", "differences"),
        ),
    )  # fmt: skip
    choices: ClassVar[tuple[Choice, ...]] = (
        Choice(
            "exposure", "metered", "metered (each sky anew, as an automatic camera does) or fixed (at the start).",
            options=("metered", "fixed"),
        ),
    )  # fmt: skip

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        radiance = self.radiance(scene, self.start_values(scene)).numpy().astype(np.float32)
        sky = EnvironmentAsset("sky", radiance, source="Hosek and Wilkie's sky")
        return replace(scene, environment=sky).with_values(environment__rotation=0.0, environment__exposure=0.0)

    def scene_inputs(self, scene: SceneDescription, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {"environment.data": self.radiance(scene, values)}

    def start_values(self, scene: SceneDescription) -> Values:
        """Return the values of the start, fixed ones included."""
        bound = self.bind(scene)
        return bound.values(bound.start)

    def radiance(self, scene: SceneDescription, values: Values) -> Tensor:
        """Return the map (H, W, 3) of linear radiance at some values; differentiable."""
        ground = scene.ground_color
        numbers = values["azimuth"], values["elevation"], values["turbidity"]
        radiance, metered = sky_over(ground, numbers[0].device)(*numbers)
        if self.chosen["exposure"] == "fixed":
            start = self.start_values(scene)
            metered = metered_at(ground, float(start["elevation"]), float(start["turbidity"])).to(radiance.device)
        return radiance * (METERED_IRRADIANCE / metered)


@lru_cache(maxsize=4)
def sky_over(ground: tuple[float, ...], device: torch.device) -> Sky:
    """Return the sky over a ground of an sRGB colour: far away it is made of the same as the ground plane."""
    return Sky(srgb_to_linear(torch.tensor(ground)).to(device))


@lru_cache(maxsize=16)
def metered_at(ground: tuple[float, ...], elevation: float, turbidity: float) -> Tensor:
    """Return the metered irradiance () of a sky; the sun's azimuth does not matter."""
    numbers = (torch.tensor(number) for number in (0.0, elevation, turbidity))
    return sky_over(ground, torch.device("cpu"))(*numbers)[1]
