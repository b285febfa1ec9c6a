"""The light control: a lamp's power in the environment's units, what its places do, and which derivative is right."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.controls.light import LightControl, compute_metered_irradiance
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.mitsuba_backend.scene import MitsubaScene

DARK = EnvironmentAsset("dark", np.zeros((4, 8, 3), np.float32))
SIDE = 32
ROUNDING = 0.002
"""Relative: no sample depends on power or colour, so that at one seed adjoint and difference are of the same paths."""


def rendered(control: LightControl, scene: SceneDescription, u: list[float], spp: int = 64, seed: int = 0) -> Tensor:
    prepared = control.prepare(scene)
    bound = control.bind(prepared)
    return MitsubaScene(prepared, (SIDE, SIDE)).render_radiance(bound.inputs(torch.tensor(u)), seed, spp)


def pixel_of(point: np.ndarray, scene: SceneDescription) -> tuple[int, int]:
    """Row and column where the default camera sees a point."""
    camera = camera_to_world(scene)
    x, y, z = (point - camera[:3, 3]) @ camera[:3, :3]
    scale = SIDE / 2.0 / math.tan(math.radians(scene.get_number("camera.fov") / 2.0)) / z
    return int(SIDE / 2.0 - scale * y), int(SIDE / 2.0 - scale * x)


def test_the_unit_of_power_shows_a_white_surface_just_below_white(scene: SceneDescription) -> None:
    assert compute_metered_irradiance(scene) / math.pi * 0.8 * scene.gain == pytest.approx(0.9)


@pytest.mark.parametrize("type", ["area", "point"])
def test_a_lamp_puts_its_power_over_the_squared_distance_on_what_faces_it(type: str) -> None:
    """White ground below a lamp in the dark: radiance = albedo E / pi / d^2 for each channel."""
    scene = load_description(
        "mug", DARK, setting_values={"pose.x": 50.0, "ground.red": 1.0, "ground.green": 1.0, "ground.blue": 1.0}
    )
    settings: dict[str, Any] = {"size": 0.05} if type == "area" else {}
    control = LightControl(type=type, x=[0, 1], y=0, z=2, red=1, green=0.5, blue=0, power=3, **settings)
    seen = rendered(control, scene, [0.0], spp=256)
    row, column = pixel_of(np.zeros(3), scene)
    under = seen[row - 1 : row + 3, column - 2 : column + 2].mean(dim=(0, 1))
    expected = 3.0 / 4.0 * compute_metered_irradiance(scene) / math.pi * srgb_to_linear(torch.tensor([1.0, 0.5, 0.0]))
    assert torch.allclose(under, expected, rtol=0.05, atol=1e-6)


def test_size_changes_radiance_and_not_power(scene: SceneDescription) -> None:
    control = LightControl(size=[0.1, 0.4])
    bound = control.bind(control.prepare(scene))
    small, large = (bound.inputs(torch.tensor([u])) for u in (0.0, 1.0))
    assert torch.allclose(small["light.radiance"] * 0.1**2, large["light.radiance"] * 0.4**2)
    assert float(small["light.ball"][0, 0]) == pytest.approx(0.05)
    assert float(large["light.ball"][2, 2]) == pytest.approx(0.2)


@pytest.mark.medium
@pytest.mark.parametrize("type", ["area", "point"])
def test_the_adjoint_of_power_and_colour_agrees_with_differences(scene: SceneDescription, type: str) -> None:
    control = LightControl(type=type, x=0.8, y=-0.8, z=2, power=[0, 10], red=[0.5, 1])
    prepared = control.prepare(scene)
    bound = control.bind(prepared)
    mitsuba_scene = MitsubaScene(prepared, (SIDE, SIDE))
    weights = torch.linspace(0.5, 1.0, SIDE)[:, None, None].expand(SIDE, SIDE, 3).contiguous()
    u = torch.tensor([0.5, 0.5], requires_grad=True)
    inputs = bound.inputs(u)
    shining = {"area": "light.radiance", "point": "light.intensity"}[type]
    detached = {name: value.detach() for name, value in inputs.items()}
    found = mitsuba_scene.render_adjoint(detached, weights, 2, 64, wrt=[shining])
    (inputs[shining] * found[shining]).sum().backward()
    assert u.grad is not None
    for coordinate in range(2):
        step = 0.1 * torch.eye(2)[coordinate]
        above, below = (
            float((mitsuba_scene.render_radiance(bound.inputs(u.detach() + way * step), 2, 64) * weights).sum())
            for way in (1.0, -1.0)
        )
        assert float(u.grad[coordinate]) == pytest.approx((above - below) / 0.2, rel=ROUNDING)
