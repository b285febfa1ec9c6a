"""The geometry control: smooth, bounded, and never breaking the mesh."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import advsearch
from advsearch.controls.geometry import (
    MAX_WALL_STRAIN,
    DisplacementLimits,
    GeometryControl,
    compute_shape_modes,
    get_welded_mesh,
)
from advsearch.scene.description import SceneDescription, load_description

OFFSETS = "object.offsets"

FORMS = ("modes", "large-steps")


def bound(scene: SceneDescription, **settings: Any) -> GeometryControl:
    return GeometryControl(**settings).bind(scene)


def wild(size: int) -> list[Tensor]:
    """Configurations that push hard: corners of the box, noise, and all one way."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(size, generator=generator)
    smooth = (torch.sin(torch.arange(size) / 40.0) > 0.0).float()
    return [noise, noise.round(), smooth, torch.ones(size), torch.zeros(size)]


def face_normals(places: Tensor, faces: np.ndarray) -> Tensor:
    corners = places[torch.from_numpy(faces)]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    found: Tensor = normals / normals.norm(dim=1, keepdim=True).clamp_min(1e-300)
    return found


@pytest.mark.medium
@pytest.mark.parametrize("form", FORMS)
def test_it_starts_with_the_shape_as_it_is(scene: SceneDescription, form: str) -> None:
    control = bound(scene, form=form)
    offsets = control.inputs(control.start)[OFFSETS]
    assert offsets.shape == scene.object.mesh.vertices.shape and offsets.dtype == torch.float32
    assert not bool(offsets.any())
    assert control.describe(control.start)["geometry.thinnest"]["value"] == pytest.approx(1.0)


@pytest.mark.medium
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("epsilon", [0.03, 0.3])
@pytest.mark.parametrize("name", ["mug", "wine-glass", "book"])
def test_no_configuration_breaks_the_mesh(name: str, epsilon: float, form: str) -> None:
    scene = load_description(name)
    control, solid = bound(scene, form=form, epsilon=epsilon), get_welded_mesh(scene.object.mesh)
    places = torch.from_numpy(solid.positions)
    before = face_normals(places, solid.faces)
    for u in wild(len(control.start)):
        offsets = control.compute_offsets(u)
        assert float(offsets.norm(dim=1).max()) < epsilon
        assert float((before * face_normals(places + offsets, solid.faces)).sum(dim=1).min()) > 0.0
        said = control.describe(u)
        assert said["geometry.thinnest"]["value"] > 1.0 - MAX_WALL_STRAIN  # type: ignore[operator]


def test_both_sides_of_a_wall_move_together(scene: SceneDescription) -> None:
    """The mug's wall is 0.03 thick; 24 modes at a largest displacement of 0.03 leave it so within a tenth."""
    control, solid = bound(scene, epsilon=0.03), get_welded_mesh(scene.object.mesh)
    gaps = np.linalg.norm(solid.positions[solid.walls[:, 0]] - solid.positions[solid.walls[:, 1]], axis=1)
    thin = torch.from_numpy(solid.walls[gaps < 0.05])
    assert len(thin) > 500
    for u in wild(len(control.start)):
        offsets = control.compute_offsets(u)
        apart = (offsets[thin[:, 0]] - offsets[thin[:, 1]]).norm(dim=1).max()
        assert float(apart) < 0.1 * float(offsets.norm(dim=1).max()) + 1e-9 or float(apart) < 0.004


@pytest.mark.parametrize("form", FORMS)
def test_no_rigid_motion_is_left(scene: SceneDescription, form: str) -> None:
    control, solid = bound(scene, form=form), get_welded_mesh(scene.object.mesh)
    centred = solid.positions - solid.positions.mean(axis=0)
    for u in wild(len(control.start))[:3]:
        field = control._field(2.0 * u.double() - 1.0).numpy()
        size = float(np.linalg.norm(field))
        for axis in np.eye(3):
            for rigid in (np.broadcast_to(axis, field.shape), np.cross(axis, centred)):
                assert abs(float((field * rigid).sum())) < 0.2 * size * float(np.linalg.norm(rigid))


def test_the_derivative_of_the_limits_is_exact(scene: SceneDescription) -> None:
    solid = get_welded_mesh(scene.object.mesh)
    limits = DisplacementLimits(solid, 0.2)
    generator = torch.Generator().manual_seed(5)
    modes = torch.from_numpy(compute_shape_modes(scene.object.mesh, 4))
    weights = torch.randn(modes.shape[:2], generator=generator, dtype=torch.float64)

    def total(amplitudes: Tensor) -> Tensor:
        return (limits.limit(modes @ amplitudes) * weights).sum()

    for scale in (0.01, 1.0, 30.0):
        at = scale * torch.randn(4, generator=generator, dtype=torch.float64)
        assert torch.autograd.gradcheck(total, (at.requires_grad_(),), eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.medium
def test_a_render_shows_the_shape_and_starts_with_the_old_one() -> None:
    scene = advsearch.load_scene("mug")
    render = scene.renderer([GeometryControl(epsilon=0.1)], resolution=32, denoise="none")
    clean = render(render.start, seed=0, spp=8)
    plain = scene.renderer({"texture": {}}, resolution=32, denoise="none")
    assert float((clean - plain(plain.start, seed=0, spp=8)).abs().mean()) < 1e-3
    bent = render(wild(len(render.start))[1], seed=0, spp=8)
    assert float((bent - clean).abs().mean()) > 0.005
    assert torch.equal(render(render.start, seed=0, spp=8), clean)
