"""The contents control: finds the inside of vessels, keeps proportions that add up to one, and fills to the level."""

import math
from typing import Any

import numpy as np
import pytest
import torch

import advsearch
from advsearch.controls.contents import FILL_LIMIT, INGREDIENTS, ContentsControl, find_vessel
from advsearch.scene.assets import Mesh, ObjectAsset
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.library import load_object

pytestmark = pytest.mark.island("advsearch.controls.contents")

AGREEMENT = 0.1
"""Relative difference allowed between 64-sample adjoints and 128-sample differences."""


def bound(scene: SceneDescription, **settings: Any) -> ContentsControl:
    control = ContentsControl(**settings)
    return control.bind(control.prepare(scene))


def cup(outer: float = 0.5, inner: float = 0.4, floor: float = 0.1, bottom: bool = True) -> ObjectAsset:
    """A turned cup of height 1 with straight walls; without its bottom it is a pipe."""
    profile = [(0.0, 0.0), (outer, 0.0), (outer, 1.0), (inner, 1.0), (inner, floor), (0.0, floor)]
    if not bottom:
        profile = [(outer, 0.0), (outer, 1.0), (inner, 1.0), (inner, 0.0), (outer, 0.0)]
    angle = np.linspace(0.0, 2.0 * np.pi, 129)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate([np.column_stack([r * around, np.full(len(angle), z)]) for r, z in profile])
    start = (np.arange(len(profile) - 1)[:, None] * 129 + np.arange(128)[None, :]).ravel()
    faces = np.concatenate(
        [np.stack([start, start + 1, start + 130], 1), np.stack([start, start + 130, start + 129], 1)]
    )
    normals = np.tile((0.0, 0.0, 1.0), (len(vertices), 1))
    uvs = np.full((len(vertices), 2), 0.5, dtype=np.float32)
    mesh = Mesh(vertices.astype(np.float32), faces.astype(np.uint32), normals.astype(np.float32), uvs)
    return ObjectAsset("cup", mesh, np.full((4, 4, 3), 0.5, dtype=np.float32))


def test_the_inside_of_a_turned_cup_is_that_of_its_profile() -> None:
    found = find_vessel(cup())
    assert found is not None
    np.testing.assert_allclose(found.axis, 0.0, atol=0.005)
    assert float(found.heights[0]) == pytest.approx(0.1, abs=1e-6)
    assert float(found.heights[-1]) == pytest.approx(0.1 + FILL_LIMIT * 0.9, abs=1e-6)
    np.testing.assert_allclose(found.radii, 0.4, atol=0.002)


@pytest.mark.parametrize("name", ["mug", "bowl", "wine-glass"])
def test_the_liquid_stays_inside_the_vessel(name: str) -> None:
    """Level rays from the axis at the surface's height are not stopped before the surface ends, and soon after."""
    asset = load_object(name)
    found = find_vessel(asset)
    assert found is not None
    filled = bound(load_description(name), level=[0, 1])
    for level in (0.3, 0.77):
        disc = surface(filled, level)
        reach = np.linalg.norm(disc[1:, :2] - found.axis, axis=1)
        below = np.array([np.interp(level, np.linspace(0, 1, len(found.heights)), row) for row in found.radii.T])
        assert np.all(reach < below) and np.all(reach > 0.98 * below)


def surface(filled: ContentsControl, level: float) -> np.ndarray:
    """Vertices of the liquid in mesh coordinates."""
    part = next(one for one in filled.scene.parts if one.name == "contents")
    u = filled.start.clone()
    u[0] = level
    offsets = filled.inputs(u)["contents.offsets"]
    return part.mesh.vertices + offsets.numpy()  # type: ignore[attr-defined, no-any-return]


def test_the_level_runs_from_the_floor_to_the_brim(scene: SceneDescription) -> None:
    found = find_vessel(scene.object)
    assert found is not None
    filled = bound(scene, level=[0, 1])
    heights = [surface(filled, level) for level in (0.0, 0.5, 1.0)]
    assert heights[0][:, 2].max() < found.heights[0] and np.ptp(heights[0][:, 0]) < 0.005
    assert float(heights[1][:, 2].mean()) == pytest.approx(found.heights[[0, -1]].mean(), abs=1e-4)
    assert float(heights[2][:, 2].mean()) == pytest.approx(found.heights[-1], abs=1e-4)


def test_the_vertices_are_differentiable_in_the_level(scene: SceneDescription) -> None:
    filled = bound(scene, level=[0, 1])
    u = torch.tensor([0.613], requires_grad=True)
    filled.inputs(u)["contents.offsets"][:, 2].mean().backward()
    step = (surface(filled, 0.613 + 0.01) - surface(filled, 0.613 - 0.01))[:, 2].mean() / 0.02
    assert u.grad is not None and float(u.grad) == pytest.approx(float(step), rel=1e-3)


@pytest.mark.parametrize(
    "settings",
    [
        {}, {"milk": [0, 0.3]}, {"water": 0.2}, {"coffee": [0.1, 0.6], "water": [0.3, 0.5], "milk": [0.0, 0.5]},
        {"coffee": 0.25, "milk": [0.2, 0.4]},
    ],
)  # fmt: skip
def test_proportions_add_up_to_one_within_their_ranges(scene: SceneDescription, settings: dict[str, object]) -> None:
    filled = bound(scene, **settings)
    generator = torch.Generator().manual_seed(0)
    corners = torch.cartesian_prod(*([torch.tensor([0.0, 1.0])] * len(filled.start))).reshape(-1, len(filled.start))
    for u in torch.cat([corners, torch.rand(30, len(filled.start), generator=generator)]):
        said = filled.describe(u)
        shares = {name: float(said[f"contents.{name}"]["value"]) for name in INGREDIENTS}
        assert sum(shares.values()) == pytest.approx(1.0, abs=1e-6)
        for name, (low, high) in filled.proportion_bounds.items():
            assert low - 1e-6 <= shares[name] <= high + 1e-6


@pytest.mark.medium
def test_the_gradient_of_a_rendered_mixture_agrees_with_differences() -> None:
    asset = advsearch.load_scene("mug", settings={"camera.elevation": 45.0})
    render = asset.renderer([ContentsControl()], resolution=32, denoise="none")
    assert [group.estimator for group in render.plan.groups] == ["secant", "adjoint", "adjoint"]
    start = torch.tensor([0.8, 0.3, 0.3])
    samples = []
    for seed in range(3):
        u = start.clone().requires_grad_()
        samples.append(torch.autograd.grad(render(u, seed=seed, spp=32).sum(), u)[0])
    gradient = torch.stack(samples).mean(dim=0)
    for number in (1, 2):
        step = torch.zeros(3)
        step[number] = 0.03
        with torch.no_grad():
            ends = [float(render(start + sign * step, seed=1, spp=128).sum()) for sign in (1.0, -1.0)]
        assert float(gradient[number]) == pytest.approx((ends[0] - ends[1]) / 0.06, rel=AGREEMENT)
    assert math.isfinite(float(gradient[0])) and float(gradient[0]) != 0.0
