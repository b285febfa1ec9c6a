"""The ground that shows the environment's photograph: it looks as photographed, darker where light is kept from it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.engine.loading import Scene, load_scene
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.description import load_description
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.photographed_ground import PhotographedGround, compute_open_sky_irradiance

SIZE = 32
AWAY = {"pose.x": 900.0, "pose.scale": 0.01}
"""An object that nobody sees."""
NOISE = 0.05
"""Mean relative error of 256 samples of this light on a matt floor."""
GRADIENT_TOLERANCE = 0.05
"""An adjoint against a difference with common random numbers, both with 256 samples."""


def room() -> EnvironmentAsset:
    """A smooth map with a floor of many colours, brighter above."""
    polar = (np.arange(32)[:, None] / 31.0) * math.pi
    turn = (np.arange(64)[None] + 0.5) / 64.0 * 2.0 * math.pi
    above = 1.0 + 2.0 * np.clip(np.cos(polar), 0.0, 1.0) * (1.0 + 0.5 * np.cos(turn))
    below = 0.3 + 0.2 * np.sin(3.0 * turn) * np.sin(polar) + 0.0 * polar
    one = np.where(polar < math.pi / 2.0, above, below)
    radiance = np.stack([one, 0.7 * one, 0.5 * one**1.5], axis=2).astype(np.float32)
    return EnvironmentAsset("room", radiance, photographed=True)


def from_the_tripod(height: float) -> Tensor:
    """(4, 4) a camera where the photograph was taken, looking 30 degrees below the horizon."""
    down = math.radians(30.0)
    ahead = np.array([math.cos(down), 0.0, -math.sin(down)])
    left = np.array([0.0, 1.0, 0.0])
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] = np.stack([left, np.cross(ahead, left), ahead], axis=1)
    matrix[2, 3] = height
    return torch.from_numpy(matrix)


def test_a_floor_as_bright_as_the_light_is_white() -> None:
    flat = torch.full((16, 32, 3), 2.0)
    assert torch.allclose(compute_open_sky_irradiance(flat), torch.full((3,), 2.0 * math.pi), rtol=1e-3)
    photograph = PhotographedGround(flat.numpy(), 3.0, 0.0)
    assert torch.allclose(photograph.base_color, torch.ones_like(photograph.base_color), rtol=1e-3)
    finer = photograph.compute_reflectance(torch.full((64, 128, 3), 5.0))
    assert finer.shape == (photograph.base_color.shape[0], 128, 3)
    assert torch.allclose(finer, torch.ones_like(finer), rtol=1e-3)
    assert not photograph.compute_reflectance(torch.zeros(16, 32, 3)).any()


@pytest.mark.parametrize("rotation", [0.0, 70.0])
def test_from_where_it_was_taken_the_floor_is_the_photograph(rotation: float) -> None:
    given = {**AWAY, "environment.rotation": rotation}
    scene = load_description("ball", room(), size=1.0, setting_values={**given, "ground.height": 2.0})
    with_floor, without = scene, replace(scene, values={**scene.values, "ground.size": 0.0})
    assert scene.photograph is not None and without.photograph is None
    camera = {"camera.to_world": from_the_tripod(2.0)}
    floor, photograph = (
        MitsubaScene(one, (SIZE, SIZE)).render_radiance(camera, 0, 256) for one in (with_floor, without)
    )
    assert float(((floor - photograph).abs() / photograph).mean()) < NOISE
    assert float((floor.mean() / photograph.mean() - 1.0).abs()) < 0.01
    assert float(photograph.std() / photograph.mean()) > 0.2, "there is nothing to tell apart"


def test_the_object_keeps_light_from_the_floor() -> None:
    scene = load_description(
        "ball", room(), size=1.0, setting_values={"camera.elevation": 60.0, "camera.distance": 4.0}
    )
    away = replace(scene, values={**scene.values, **AWAY})
    mitsuba = MitsubaScene(scene, (SIZE, SIZE))
    seen = mitsuba.find_surfaces({}).visible_mask("object")
    ratio = (mitsuba.render_radiance({}, 0, 64) / MitsubaScene(away, (SIZE, SIZE)).render_radiance({}, 0, 64)).mean(
        dim=2
    )
    near, outline = (
        torch.nn.functional.max_pool2d(seen[None].float(), width, stride=1, padding=width // 2)[0] > 0.0
        for width in (7, 3)
    )
    beside = near & ~outline
    corner = ratio[:4, :4].mean()
    assert float(ratio[beside].min()) < 0.85 < 0.95 < float(corner) < 1.05


def loss(scene: Scene, controls: dict[str, dict[str, object]]) -> tuple[float, float]:
    """Return the adjoint's derivative at the middle of one coordinate, and a difference over 1 % of it."""
    render = scene.renderer(controls, resolution=SIZE, denoise="none")
    weights = torch.linspace(0.0, 1.0, SIZE)[:, None, None] * torch.linspace(1.0, 0.2, SIZE)[None, :, None]
    u = torch.full_like(render.start, 0.4)

    def value(image: Tensor) -> Tensor:
        return (image * weights).mean()

    adjoint = render.gradient(value, u, 1, 256)[1]
    with torch.no_grad():
        difference = (value(render(u + 0.01, 1, 256)) - value(render(u - 0.01, 1, 256))) / 0.02
    return float(adjoint.sum()), float(difference)


@pytest.mark.medium
@pytest.mark.parametrize(
    "controls",
    [
        {"environment": {"rotation": [0.0, 90.0]}},
        {"environment": {"tint_red": [0.5, 1.5]}},
        {"light": {"power": [0.2, 2.0]}},
    ],
    ids=["rotation", "tint", "light"],
)
def test_derivatives_reach_the_floor(controls: dict[str, dict[str, object]]) -> None:
    adjoint, difference = loss(load_scene("mug", room()), controls)
    assert adjoint == pytest.approx(difference, rel=GRADIENT_TOLERANCE)
