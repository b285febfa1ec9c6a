"""The sky control: the published model, the right way round, metered, and with derivatives of the map."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.controls.sky import (
    MAP_COLUMNS,
    MAP_ROWS,
    REAL_SUN_RADIUS,
    Sky,
    SkyControl,
    compute_direction,
    compute_sun_irradiance,
)
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import import_mitsuba

pytestmark = pytest.mark.island("advsearch.controls.sky")

PLUGIN_UNIT = 106.750
"""Mitsuba divides by the integral of the CIE luminosity function; maps here do not."""
SKIES = ((20.0, 45.0, 3.0, 1e-3), (200.0, 80.0, 10.0, 1e-3), (120.0, 12.0, 7.0, 1e-3), (120.0, 12.0, 6.7, 0.03))
"""Azimuth, elevation, turbidity, tolerance: between whole turbidities Mitsuba interpolates linearly, we smoothly."""


def numbers(*given: float) -> list[Tensor]:
    return [torch.tensor(one) for one in given]


def looked_up(emitter: Any, directions: np.ndarray) -> np.ndarray:
    """Radiance (N, 3) that a Mitsuba emitter sends from directions (N, 3)."""
    mi = import_mitsuba()
    import drjit as dr

    interaction = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    interaction.wi = mi.Vector3f(*(mi.Float(-directions[:, axis].astype(np.float32)) for axis in range(3)))
    found: np.ndarray = np.array(emitter.eval(interaction)).T
    return found


def plugin(azimuth: float, elevation: float, turbidity: float, **scales: float) -> Any:
    sun = compute_direction(*numbers(azimuth, elevation)).tolist()
    return import_mitsuba().load_dict(
        {"type": "sunsky", "sun_direction": sun, "turbidity": turbidity, "albedo": 0.3, **scales}
    )


@pytest.mark.parametrize(("azimuth", "elevation", "turbidity", "within"), SKIES)
def test_the_dome_is_mitsubas(azimuth: float, elevation: float, turbidity: float, within: float) -> None:
    sky = Sky(torch.full((3,), 0.3))
    own = sky.compute_dome(compute_direction(*numbers(azimuth, elevation)), *numbers(elevation, turbidity))
    reference = looked_up(plugin(azimuth, elevation, turbidity, sun_scale=0.0), sky.directions.reshape(-1, 3).numpy())
    assert np.allclose(own.reshape(-1, 3).numpy(), reference * PLUGIN_UNIT, rtol=within)


@pytest.mark.parametrize(("azimuth", "elevation", "turbidity", "within"), SKIES)
def test_the_suns_light_is_mitsubas(azimuth: float, elevation: float, turbidity: float, within: float) -> None:
    count = 2000
    sun = compute_direction(*numbers(azimuth, elevation)).double().numpy()
    across = np.cross(sun, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    radius = np.tan(REAL_SUN_RADIUS * 0.9999) * np.sqrt((np.arange(count) + 0.5) / count)
    angle = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    sideways = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(sun, across)
    directions = sun + radius[:, None] * sideways
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    disk = looked_up(plugin(azimuth, elevation, turbidity, sky_scale=0.0), directions)
    reference = disk.mean(axis=0) * math.pi * REAL_SUN_RADIUS**2 * PLUGIN_UNIT
    assert np.allclose(
        compute_sun_irradiance(*numbers(elevation, turbidity)).numpy(), reference, rtol=max(0.01, within)
    )


@pytest.mark.parametrize("turbidity", [3.0, 4.0, 7.5])
def test_the_derivative_of_turbidity_is_the_same_from_both_sides(turbidity: float) -> None:
    sky, (first, second) = Sky(torch.full((3,), 0.3)), numbers(10.0, 40.0)
    at = torch.tensor(turbidity, requires_grad=True)
    radiance, metered = sky(first, second, at)
    (slope,) = torch.autograd.grad((radiance / metered).double().mean(), at)
    step = 0.01
    values = [sky(first, second, torch.tensor(turbidity + k * step)) for k in (-1, 0, 1)]
    means = [float((one / each).double().mean()) for one, each in values]
    assert (means[2] - means[1]) / step == pytest.approx(float(slope), rel=0.05)
    assert (means[1] - means[0]) / step == pytest.approx(float(slope), rel=0.05)


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 215.0])
def test_the_sun_stands_where_it_is_asked_to(azimuth: float) -> None:
    scene = load_description("mug")
    control = SkyControl(azimuth=azimuth, elevation=[30, 31])
    emitter = MitsubaScene(control.prepare(scene), (8, 8))._scene.environment()
    sun = compute_direction(*numbers(azimuth, 30.0)).double().numpy()
    aside = compute_direction(*numbers(azimuth + 8.0, 30.0)).double().numpy()
    at_sun, beside = looked_up(emitter, np.stack([sun, aside])).mean(axis=1)
    assert at_sun > 100.0 * beside > 0.0


def test_the_map_keeps_the_suns_light_and_the_ground_reflects_it() -> None:
    ground = torch.tensor([0.4, 0.3, 0.1])
    sky = Sky(ground)
    sun = compute_direction(*numbers(40.0, 35.0))
    total = (sky.compute_disk(sun) * sky.solid_angles).sum()
    assert float(total) == pytest.approx(1.0, rel=1e-5)
    radiance, _ = sky(*numbers(40.0, 35.0, 3.0))
    assert radiance.shape == (MAP_ROWS, MAP_COLUMNS, 3) and float(radiance.min()) >= 0.0
    arriving = (radiance[: MAP_ROWS // 2] * sky.solid_angles * sky.cosines).sum((0, 1))
    assert torch.allclose(radiance[-1, 0], ground * arriving / math.pi, rtol=1e-4)


def test_the_maps_derivatives_are_right(scene: SceneDescription) -> None:
    """A smooth weight over the map: autograd against differences of the map itself, in which there is no noise."""
    bound = SkyControl().bind(scene)
    around = torch.linspace(0.0, 2.0 * math.pi, MAP_COLUMNS + 1)[None, :-1, None]
    down = torch.linspace(0.0, math.pi, MAP_ROWS)[:, None, None]
    weights = torch.sin(down) * torch.sin(down + around)

    def weighed(u: Tensor) -> Tensor:
        return (bound.inputs(u)["environment.data"].double() * weights).sum() / MAP_COLUMNS

    u = torch.tensor([0.3, 0.4, 0.45], requires_grad=True)
    weighed(u).backward()
    assert u.grad is not None
    for coordinate in range(3):
        step = 0.0002 * torch.eye(3)[coordinate]  # the texels bend the slope over longer steps
        with torch.no_grad():
            slope = float(weighed(u + step) - weighed(u - step)) / 0.0004
        assert float(u.grad[coordinate]) == pytest.approx(slope, rel=0.015)


@pytest.mark.medium
def test_the_adjoint_of_turbidity_agrees_with_differences(scene: SceneDescription) -> None:
    control = SkyControl(turbidity=[2, 8], exposure="fixed")
    prepared = control.prepare(scene)
    bound = control.bind(prepared)
    mitsuba_scene = MitsubaScene(prepared, (32, 32))
    weights = torch.linspace(0.0, 1.0, 32)[:, None, None].expand(32, 32, 3).contiguous()
    u = torch.tensor([0.55], requires_grad=True)
    inputs = mitsuba_scene.input_assembler(bound.inputs(u))
    found = mitsuba_scene.render_adjoint({name: one.detach() for name, one in inputs.items()}, weights, 1, 128)
    sum((inputs[name] * one).sum() for name, one in found.items()).backward()  # type: ignore[union-attr]
    above, below = (
        float(
            (
                mitsuba_scene.render_radiance(mitsuba_scene.input_assembler(bound.inputs(torch.tensor([at]))), 2, 256)
                * weights
            ).sum()
        )
        for at in (0.65, 0.45)
    )
    assert u.grad is not None
    assert float(u.grad) == pytest.approx((above - below) / 0.2, rel=0.1)
