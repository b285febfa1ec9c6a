"""The patch control, and the map of a mesh's surface that it lies on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from advsearch.controls import make_space
from advsearch.controls.patch import BASE_COLOR, PatchControl
from advsearch.controls.texture import TextureControl
from advsearch.scene.assets import Float32Array, Mesh
from advsearch.scene.description import SceneDescription
from advsearch.scene.library import list_objects, load_object
from advsearch.scene.raster import MeshSurface, rasterize_charts
from covering import only
from small_models import assert_slope

pytestmark = pytest.mark.island("advsearch.controls.patch")

SIDE = 512


@pytest.fixture(scope="module")
def surface(scene: SceneDescription) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Positions, normals and areas of the texels of the mug."""
    charts = rasterize_charts(scene.object.mesh, SIDE)
    return charts.compute_positions(), charts.compute_normals(), charts.compute_areas()


def bound(scene: SceneDescription, **settings: Any) -> PatchControl:
    return PatchControl(**settings).bind(scene)


def painted(control: PatchControl, pixels: Tensor, so_far: Tensor | None = None) -> Tensor:
    """The base colour with pixels (n, n, 3) on it."""
    u = control.start.clone()
    u[: pixels.numel()] = pixels.reshape(-1)
    return control.inputs(u, {} if so_far is None else {BASE_COLOR: so_far})[BASE_COLOR]


def covered(control: PatchControl, side: int = 32) -> np.ndarray:
    """Share (h, w) to which each texel is painted."""
    white, black = (painted(control, torch.full((side, side, 3), value)) for value in (1.0, 0.0))
    return (white - black).mean(dim=-1).numpy()


@pytest.mark.parametrize("name", only(["mug", "book", "hammer"], list_objects()))
def test_texels_know_their_place_on_every_object(name: str) -> None:
    mesh = load_object(name).mesh
    charts = rasterize_charts(mesh, side := 512)
    uvs = np.einsum("hwk,hwkc->hwc", charts.weights, mesh.uvs[mesh.faces[charts.face_index]])
    rows, columns = np.mgrid[:side, :side]
    wanted = np.stack([(columns + 0.5) / side, 1.0 - (rows + 0.5) / side], axis=-1)
    np.testing.assert_allclose(side * uvs[charts.is_covered], side * wanted[charts.is_covered], atol=0.01)
    corners = mesh.vertices[mesh.faces].astype(float)
    total = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert float(charts.compute_areas().sum()) == pytest.approx(total, rel=0.02)


@pytest.mark.medium
def test_the_patch_has_its_size_on_the_surface(scene: SceneDescription) -> None:
    for size in (0.1, 0.3, 0.5):
        control = bound(scene, azimuth=180.0, height=0.5, size=size)
        share = covered(control)
        area = float((share * rasterize_charts(scene.object.mesh, len(share)).compute_areas()).sum())
        assert area == pytest.approx(size**2, rel=0.04)


@pytest.mark.medium
def test_it_bleeds_through_no_wall(
    scene: SceneDescription, surface: tuple[Float32Array, Float32Array, Float32Array]
) -> None:
    positions, normals, _ = surface
    inside = covered(bound(scene, azimuth=180.0, height=0.5, size=0.5)) > 0.01
    outwards = positions[inside] * np.array([1.0, 1.0, 0.0])
    assert ((outwards * normals[inside]).sum(axis=-1) > 0.0).all()  # not the inside of the cup
    assert (positions[inside][:, 0] < 0.0).all()  # not the other side


def test_it_stays_on_the_part_that_it_is_stuck_to() -> None:
    """Two plates side by side in one plane, not connected."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float32)
    vertices = np.concatenate([corners, corners + np.array([1.1, 0, 0], np.float32)])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], dtype=np.uint32)
    up = np.tile(np.array([0, 0, 1], np.float32), (8, 1))
    surface = MeshSurface(Mesh(vertices, faces, up, vertices[:, :2]))
    region = surface.find_region(0, np.array([0.9, 0.1, 0.0]), np.array([0.0, 0.0, 1.0]), 5.0)
    assert region.tolist() == [True, True, False, False]
    assert not surface.find_region(0, np.array([0.9, 0.1, 0.0]), np.array([0.0, 0.0, 1.0]), 0.05)[2:].any()


def test_its_top_is_up_and_its_left_is_left(
    scene: SceneDescription, surface: tuple[Float32Array, Float32Array, Float32Array]
) -> None:
    positions = surface[0]
    control = bound(scene, azimuth=0.0, height=0.55, size=0.3)
    ramp = torch.linspace(0.0, 1.0, 32)
    grey = torch.full((32, 32, 3), 0.5)
    for axis, sign, pixels in ((2, -1.0, ramp[:, None]), (1, 1.0, ramp[None, :])):
        lit = painted(control, pixels.expand(32, 32)[..., None].expand(32, 32, 3)) - painted(control, grey)
        inside = covered(control) > 0.9
        trend = np.corrcoef(lit.mean(dim=-1).numpy()[inside], positions[inside][:, axis])[0, 1]
        assert sign * trend > 0.9  # rows run downwards; seen from +x, y runs to the right


@pytest.mark.medium
def test_it_starts_as_what_is_underneath(scene: SceneDescription) -> None:
    control = bound(scene, resolution=64)
    start = control.inputs(control.start)[BASE_COLOR]
    share = covered(control, 64)
    other = bound(scene, azimuth=220.0)  # on the other side
    bare, outside = painted(other, torch.zeros(32, 32, 3)), (share == 0.0) & (covered(other) == 0.0)
    assert start.shape == bare.shape and outside.mean() > 0.8
    assert torch.equal(start[outside], bare[outside])
    difference = (start - bare)[share > 0.0]
    assert float(difference.abs().mean()) < 0.01


@pytest.mark.medium
def test_two_patches_and_a_texture_compose(scene: SceneDescription) -> None:
    controls = [
        PatchControl("left", azimuth=20, size=0.2),
        TextureControl(),
        PatchControl("right", azimuth=70, size=0.2),
    ]
    space = make_space(controls, scene)
    u = space.start
    before = space.inputs(u)[BASE_COLOR]
    u[: 32 * 32 * 3] = 1.0
    u[-32 * 32 * 3 :] = 0.0
    after = space.inputs(u)[BASE_COLOR]
    left, right = (covered(bound(scene, azimuth=azimuth, size=0.2)) > 0.99 for azimuth in (20, 70))
    assert not (left & right).any()
    assert float(after[left].min()) > 0.99 and float(after[right].max()) < 0.01
    assert float((after - before).abs().amax(dim=-1).gt(1e-6).float().mean()) < 0.2


@pytest.mark.medium
def test_derivatives_are_those_of_differences(scene: SceneDescription) -> None:
    control = bound(scene, size=[0.1, 0.5], rotation=[-180, 180], resolution=4)
    generator = torch.Generator().manual_seed(1)
    weights = torch.nn.functional.interpolate(torch.randn(1, 3, 12, 12, generator=generator), SIDE, mode="bicubic")
    weights = weights[0].permute(1, 2, 0)
    u = torch.rand(control.start.shape, generator=generator)
    u[-2:] = torch.tensor([0.6, 0.55])

    def total(at: Tensor) -> Tensor:
        return (control.inputs(at)[BASE_COLOR].double() * weights).sum()

    pixels = torch.cat([torch.randn(48, generator=generator), torch.zeros(2)])
    for direction, step in ((pixels, 1e-2), (torch.eye(50)[48], 2e-3), (torch.eye(50)[49], 5e-4)):
        assert_slope(total, u, direction, step, 0.03)


@pytest.mark.medium
def test_what_is_kept_can_be_printed_and_stuck_on_again(scene: SceneDescription, tmp_path: Path) -> None:
    control = bound(scene, resolution=16)
    u = torch.rand(control.start.shape, generator=torch.Generator().manual_seed(2))
    kept = control.get_artifact_images(u)
    assert kept["patch"].shape == (512, 512, 3)
    pixels = kept["patch-pixels"]
    path = tmp_path / "patch.png"
    Image.fromarray((pixels.numpy() * 255.0).round().astype(np.uint8)).save(path)
    again = bound(scene, resolution=16, picture=str(path), size=[0.1, 0.3])
    assert len(again.start) == 1
    torch.testing.assert_close(
        again.inputs(torch.ones(1))[BASE_COLOR], control.inputs(u)[BASE_COLOR], atol=0.02, rtol=0
    )
