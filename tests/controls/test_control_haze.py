"""The haze control: no haze at density 0, light kept where it should be, derivatives that agree with differences."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.controls.haze import MIN_RADIUS, HazeControl
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.parts import HazePart

pytestmark = pytest.mark.island("advsearch.controls.haze")

SIDE = 32
WHITE = [1.0, 1.0, 1.0]


@cache
def plain() -> SceneDescription:
    return load_description("mug")


@cache
def hazy() -> MitsubaScene:
    return MitsubaScene(HazeControl().prepare(plain()), (SIDE, SIDE))


def haze(density: float, albedo: list[float]) -> dict[str, Tensor]:
    return {"haze.density": torch.tensor([density]), "haze.albedo": torch.tensor(albedo)}


@pytest.mark.medium
def test_density_0_is_the_scene_without_haze() -> None:
    without = MitsubaScene(plain(), (SIDE, SIDE))
    pairs = [
        (without.render_radiance({}, seed, 256), hazy().render_radiance(haze(0.0, WHITE), seed, 256))
        for seed in range(4)
    ]
    clear, seen = (torch.stack(one).mean(0) for one in zip(*pairs, strict=True))
    assert float(seen.mean()) == pytest.approx(float(clear.mean()), rel=0.005)
    spread = float((pairs[0][0] - pairs[1][0]).square().mean().sqrt()) / 2.0  # of a mean of four
    assert float((clear - seen).square().mean().sqrt()) < 1.3 * spread


@pytest.mark.medium
def test_black_haze_takes_light_out_as_beer_and_lambert_say() -> None:
    """An environment of radiance 1 seen past the object: exp(-density * length through the ball)."""
    white = EnvironmentAsset("white", np.ones((8, 16, 3), np.float32))
    scene = replace(load_description("mug", setting_values={"ground.size": 0.0}), environment=white)
    prepared = HazeControl().prepare(scene)
    (part,) = prepared.parts
    assert isinstance(part, HazePart)
    seen = MitsubaScene(prepared, (SIDE, SIDE)).render_radiance(haze(0.2, [0.0, 0.0, 0.0]), 0, 1024)
    camera = camera_to_world(scene)
    half = math.tan(math.radians(17.5))
    towards = camera[:3, :3] @ np.array([half * (1.0 - 1.0 / SIDE), half * (1.0 - 1.0 / SIDE), 1.0])
    towards /= np.linalg.norm(towards)
    along = -float(camera[:3, 3] @ towards)
    length = along + math.sqrt(along**2 + part.radius**2 - float(camera[:3, 3] @ camera[:3, 3]))
    assert float(seen[0, 0].mean()) == pytest.approx(math.exp(-0.2 * length), rel=0.1)


def test_white_haze_under_even_light_stays_white() -> None:
    """The furnace test: an object that reflects nearly all light disappears, and nothing gets darker."""
    white = EnvironmentAsset("white", np.ones((8, 16, 3), np.float32))
    scene = replace(load_description("mug", setting_values={"ground.size": 0.0, "pose.scale": 0.01}), environment=white)
    furnace = MitsubaScene(HazeControl().prepare(scene), (SIDE, SIDE))
    assert float(furnace.render_radiance(haze(0.15, WHITE), 0, 64).mean()) == pytest.approx(1.0, abs=0.01)
    assert float(furnace.render_radiance(haze(0.3, WHITE), 0, 64).mean()) == pytest.approx(0.985, abs=0.02)


@pytest.mark.medium
@pytest.mark.parametrize(
    ("density", "steps"),
    [
        (0.05, {"haze.density": (0.02, 0.1), "haze.albedo": (0.05, 0.005), "object.base_color": (0.05, 0.03)}),
        (0.3, {"haze.albedo": (0.05, 0.005)}),
    ],
)
def test_the_adjoint_agrees_with_differences(density: float, steps: dict[str, tuple[float, float]]) -> None:
    """Density, colour, and the object's base colour seen through the haze."""
    weights = torch.linspace(0.5, 1.0, SIDE)[:, None, None].expand(SIDE, SIDE, 3).contiguous()
    inputs = {**haze(density, [0.9, 0.6, 0.3]), "object.base_color": hazy().get_base_value("object.base_color")}
    found = {name: float(one.sum()) for name, one in hazy().render_adjoint(inputs, weights, 5, 256).items()}
    for name, (step, tolerance) in steps.items():
        above, below = (
            float((hazy().render_radiance({**inputs, name: inputs[name] + way * step}, 5, 256) * weights).sum())
            for way in (1.0, -1.0)
        )
        assert found[name] == pytest.approx((above - below) / (2.0 * step), rel=tolerance), name


def test_camera_and_object_are_inside() -> None:
    (part,) = HazeControl().prepare(plain()).parts
    assert isinstance(part, HazePart)
    assert part.radius >= max(MIN_RADIUS, 1.4 * float(np.linalg.norm(camera_to_world(plain())[:3, 3])))
    (far,) = HazeControl().prepare(load_description("mug", size=1.0, setting_values={"camera.distance": 20.0})).parts
    assert isinstance(far, HazePart) and far.radius > 28.0
