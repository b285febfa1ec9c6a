"""The shadow control: it takes light away from the object, from where the camera does not see it."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.controls import make_control
from advsearch.controls.shadow import find_strongest_light
from advsearch.controls.space import Space
from advsearch.scene.description import load_description
from advsearch.scene.geometry import camera_to_world, compute_center
from advsearch.scene.parts import make_polygon
from advsearch.scene.renderer import Renderer

pytestmark = pytest.mark.island("advsearch.controls.shadow")

SIDE = 32


def renderer_of(environment: str = "noon", side: int = SIDE, **settings: object) -> Renderer:
    scene = advsearch.load_scene("mug", environment=environment)
    return scene.renderer([make_control("shadow", settings)], resolution=side)


def space_of(renderer: Renderer) -> Space:
    assert isinstance(renderer.space, Space)
    return renderer.space


@pytest.mark.medium
def test_it_takes_light_away_and_the_camera_sees_no_card() -> None:
    renderer = renderer_of(size=[0, 1])
    low, high = (renderer.radiance(torch.tensor([u]), seed=1, spp=256) for u in (0.0, 0.6))
    assert float(high.mean()) < 0.97 * float(low.mean())
    seen = renderer.find_surfaces(torch.tensor([0.6]))
    assert not bool((seen.id == seen.shape_names.index("shadow") + 1).any())


@pytest.mark.parametrize("azimuth", [0, 40, 120, 220, 300])
@pytest.mark.parametrize("size", [0.2, 0.9])
def test_it_is_out_of_sight_from_wherever_it_stands_or_put_away(azimuth: float, size: float) -> None:
    renderer = renderer_of(side=24, size=size, azimuth=azimuth, elevation=30, x=[-1, 1])
    for u in (0.0, 0.5, 1.0):
        seen = renderer.find_surfaces(torch.tensor([u]))
        assert not bool((seen.id == seen.shape_names.index("shadow") + 1).any())
    told = space_of(renderer).describe(torch.tensor([0.5]))["shadow.true_distance"]["value"]
    assert isinstance(told, float) and (told == 0.0 or told >= 2.0)


def test_the_strongest_light_is_that_of_the_map_or_a_lamp() -> None:
    low, far = find_strongest_light(load_description("mug", "low-sun"))
    assert math.isinf(far) and 0.0 < low[2] < 0.5 and np.linalg.norm(low) == pytest.approx(1.0, abs=1e-3)
    turned, _ = find_strongest_light(load_description("mug", "low-sun", setting_values={"environment.rotation": 90.0}))
    assert turned[0] == pytest.approx(-low[1], abs=1e-6) and turned[1] == pytest.approx(low[0], abs=1e-6)


def test_the_card_is_a_polygon_that_faces_the_object() -> None:
    card = make_polygon(5)
    first, second, third = (card.vertices[card.faces[:, k]] for k in range(3))
    assert bool((np.cross(second - first, third - first)[:, 2] > 0.0).all())
    renderer = renderer_of(corners=5, size=0.5)
    inputs = renderer.space.inputs(torch.full_like(renderer.start, 0.25))
    pose, offsets = inputs["shadow.to_world"], inputs["shadow.offsets"]
    scene = load_description("mug", "noon")
    towards = torch.from_numpy(compute_center(scene)).float() - pose[:3, 3]
    assert float(pose[:3, 2] @ towards) > 0.0 and float(torch.linalg.det(pose[:3, :3])) > 0.0
    rim = torch.from_numpy(card.vertices) + offsets
    assert torch.allclose(rim[1:].norm(dim=1), torch.full((5,), 0.4), atol=1e-6)  # u of 0.25 in 0.2 to 1
    assert float((torch.from_numpy(camera_to_world(scene))[:3, 3].float() - pose[:3, 3]).norm()) > 0.5


@pytest.mark.medium
def test_it_is_searched_with_a_projector_and_differentiated_by_differences() -> None:
    scene = advsearch.load_scene("mug", environment="noon")
    controls = [make_control("shadow", {"size": [0, 1]}), make_control("projector", {"resolution": 4})]
    renderer = scene.renderer(controls, resolution=16)
    plan = {group.name: group.estimator for group in renderer.plan.groups}
    assert plan == {"shadow.size": "differences", "projector.pattern": "adjoint"}
    u = renderer.start.clone() + 0.3
    u.requires_grad_()
    renderer(u, seed=0, spp=4).mean().backward()
    assert u.grad is not None and bool(torch.isfinite(u.grad).all()) and bool(u.grad.any())


class Sure(nn.Module):
    """Sees a mug in everything, and a little less of it where it is bright."""

    def forward(self, images: Tensor) -> Tensor:
        light = images.mean(dim=(1, 2, 3))
        return torch.stack([5.0 - light, light], dim=1)


@pytest.mark.medium
@pytest.mark.parametrize("control", ["projector", "shadow"])
def test_light_is_searched_over_cameras_and_environments_and_along_a_path(control: str) -> None:
    given: dict[str, Any] = {"projector": {"resolution": 4}, "shadow": {"size": [0, 1]}}
    settings = given[control]
    few: dict[str, Any] = {"resolution": 16, "steps": 2, "draws": 2, "trials": 6, "verify_spp": 1, "measure": "no"}
    over = {"camera": {"azimuth": [30, 50]}, "environment": {"rotation": [0, 90]}}
    sure = advsearch.load_model(Sure(), labels=("mug", "glare"), input_size=16, name="sure")
    for conditions in ({"over": over}, {"path": "approach", "over": "path"}):
        found = advsearch.attack("mug", sure, controls={control: settings}, baseline=False, **conditions, **few).summary
        assert found.claimed is not None and found.conditions, conditions
        assert any(name.startswith(f"{control}.") for name in found.configuration or ()), conditions
