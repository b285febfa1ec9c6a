"""The patch control, and the map of a mesh's surface that it lies on."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

import advsearch
from advsearch.controls import make_control, make_space
from advsearch.controls.patch import BASE_COLOR, PatchControl, find_side_towards_camera
from advsearch.controls.texture import TextureControl
from advsearch.errors import FileFormatError, InputError, UnknownNameError
from advsearch.scene.assets import Float32Array, Mesh
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.library import list_objects, load_object
from advsearch.scene.raster import MeshSurface, rasterize_charts
from covering import only

SIDE = 512


@pytest.fixture(scope="module")
def scene() -> SceneDescription:
    return load_description("mug")


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


# ---- the map of the surface ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", only(["mug", "book", "hammer"], list_objects()))
def test_texels_know_their_place_on_every_object(name: str) -> None:
    mesh = load_object(name).mesh
    charts = rasterize_charts(mesh, side := 512)
    uvs = np.einsum("hwk,hwkc->hwc", charts.weights, mesh.uvs[mesh.faces[charts.face]])
    rows, columns = np.mgrid[:side, :side]
    wanted = np.stack([(columns + 0.5) / side, 1.0 - (rows + 0.5) / side], axis=-1)
    np.testing.assert_allclose(side * uvs[charts.is_covered], side * wanted[charts.is_covered], atol=0.01)
    corners = mesh.vertices[mesh.faces].astype(float)
    total = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert float(charts.compute_areas().sum()) == pytest.approx(total, rel=0.02)


def test_texels_beside_a_chart_continue_it(scene: SceneDescription) -> None:
    charts = rasterize_charts(scene.object.mesh, 256)
    positions, normals, mask = charts.compute_positions(), charts.compute_normals(), charts.is_readable
    assert positions.shape == normals.shape == (256, 256, 3) and mask.shape == (256, 256)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-4)
    charts = rasterize_charts(scene.object.mesh, 256)
    assert mask[charts.is_covered].all() and 0 < (mask & ~charts.is_covered).sum() < charts.is_covered.sum()
    low, high = scene.object.mesh.vertices.min(axis=0), scene.object.mesh.vertices.max(axis=0)
    assert (positions >= low - 1e-5).all() and (positions <= high + 1e-5).all()


def test_texture_coordinates_without_area_are_refused(scene: SceneDescription) -> None:
    from dataclasses import replace

    empty = replace(scene.object.mesh, uvs=np.full_like(scene.object.mesh.uvs, 2.0))
    with pytest.raises(InputError, match="none of the 64 x 64 texels lies in a triangle; unwrap the mesh again"):
        rasterize_charts(empty, 64)


def test_a_ray_meets_the_near_wall_and_a_ray_that_misses_the_nearest_corner(scene: SceneDescription) -> None:
    surface = MeshSurface(scene.object.mesh)
    face, point = surface.find_hit(np.array([-3.0, 0.0, 0.4]), np.array([1.0, 0.0, 0.0]))
    assert point[0] < -0.3 and point[1:] == pytest.approx([0.0, 0.4]) and surface.normals[face, 0] < -0.9
    face, point = surface.find_hit(np.array([-3.0, 0.0, 9.0]), np.array([1.0, 0.0, 0.0]))
    assert point[2] == pytest.approx(float(scene.object.mesh.vertices[:, 2].max()))


# ---- where it lies ---------------------------------------------------------------------------------------------------


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
def test_a_quarter_turn_is_a_turned_picture(scene: SceneDescription) -> None:
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(8, 8, 3, generator=generator)
    upright = bound(scene, azimuth=90.0, resolution=8, rotation=0.0)
    turned = bound(scene, azimuth=90.0, resolution=8, rotation=90.0)
    torch.testing.assert_close(painted(turned, pixels), painted(upright, pixels.rot90()), atol=1e-4, rtol=0)


def test_it_faces_the_camera_by_default(scene: SceneDescription) -> None:
    azimuth, height = find_side_towards_camera(scene)
    assert azimuth == pytest.approx(scene.number("camera.azimuth")) and 0.5 < height < 0.75
    turned = scene.with_values(pose__yaw=30.0)
    assert find_side_towards_camera(turned)[0] == pytest.approx(azimuth - 30.0, abs=1e-3)


@pytest.mark.medium
@pytest.mark.parametrize("name", only(["mug", "book", "hammer"], list_objects()))
def test_every_object_takes_a_patch_anywhere(name: str) -> None:
    scene = load_description(name)
    control = bound(scene, azimuth=[0, 360], height=[0.0, 1.0], resolution=4)
    for share in (0.0, 0.3, 0.7, 1.0):
        u = control.start.clone()
        u[-2], u[-1] = 1.0 - share, share
        found = []
        for value in (0.0, 1.0):
            u[:48] = value
            found.append(control.inputs(u)[BASE_COLOR])
        assert bool(torch.isfinite(found[1]).all()) and float((found[1] - found[0]).max()) > 0.5


# ---- how it is painted -----------------------------------------------------------------------------------------------


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


def test_it_is_painted_over_what_came_before(scene: SceneDescription) -> None:
    red = torch.tensor([1.0, 0.0, 0.0]).expand(16, 16, 3)
    control = bound(scene)
    found = painted(control, torch.ones(32, 32, 3), red)
    share = torch.from_numpy(covered(control))
    assert found.shape == (SIDE, SIDE, 3)
    torch.testing.assert_close(found[share > 0.99], torch.ones(int((share > 0.99).sum()), 3), atol=0.02, rtol=0)
    torch.testing.assert_close(found[share == 0.0], red[0, 0].expand(int((share == 0.0).sum()), 3))


@pytest.mark.medium
@pytest.mark.parametrize("turn", [1, -1])
def test_a_patch_lies_on_any_material(scene: SceneDescription, turn: int) -> None:
    """In whatever order the two are asked for."""
    controls = [make_control("material", {"which": "wood"}), make_control("patch", {"pixels": 1.0, "size": [0.2, 0.3]})]
    space = make_space(controls[::turn], scene)
    color = space.inputs(space.start)[BASE_COLOR]
    wood = make_control("material", {"which": "wood"}).bind(scene)
    alone = wood.inputs(wood.start)[BASE_COLOR]
    changed = (color - alone).abs().amax(dim=-1) > 1e-3
    assert 0.005 < float(changed.float().mean()) < 0.5
    assert float(color.amin(dim=-1).max()) > 0.99 > float(alone.amin(dim=-1).max())


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

    at = u.clone().requires_grad_()
    (slope,) = torch.autograd.grad(total(at), at)
    pixels = torch.cat([torch.randn(48, generator=generator), torch.zeros(2)])
    for direction, step in ((pixels, 1e-2), (torch.eye(50)[48], 2e-3), (torch.eye(50)[49], 5e-4)):
        rise = float(total(u + step * direction) - total(u - step * direction)) / (2.0 * step)
        assert float(slope @ direction) == pytest.approx(rise, rel=0.03)


def test_corners_of_the_box_are_finite(scene: SceneDescription) -> None:
    control = bound(scene, size=[0.05, 0.6], rotation=[-180, 180], azimuth=[0, 360], height=[0, 1], resolution=4)
    for value in (0.0, 1.0):
        u = torch.full_like(control.start, value, requires_grad=True)
        found = control.inputs(u)[BASE_COLOR]
        found.sum().backward()
        assert bool(torch.isfinite(found).all()) and u.grad is not None and bool(torch.isfinite(u.grad).all())


# ---- what may be asked for -------------------------------------------------------------------------------------------


@pytest.mark.medium
def test_groups_say_what_is_searched(scene: SceneDescription) -> None:
    pixels = bound(scene)
    assert [group.parameter for group in pixels.groups] == ["pixels"] and len(pixels.start) == 32 * 32 * 3
    assert pixels.groups[0].valid == ("adjoint",) and pixels.groups[0].budget.norm == "box"
    all_of_it = bound(scene, azimuth=[0, 360], size=[0.1, 0.4], norm="linf", epsilon=0.2)
    assert [group.parameter for group in all_of_it.groups] == ["pixels", "azimuth", "size"]
    assert all_of_it.groups[0].budget.epsilon == pytest.approx(0.2)
    assert all_of_it.groups[1].periodic and all_of_it.groups[1].valid == ("differences",)
    said = all_of_it.describe(all_of_it.start)
    assert set(said) == {"patch.linf", "patch.rms", "patch.azimuth", "patch.size"}
    assert said["patch.azimuth"]["value"] == pytest.approx(find_side_towards_camera(scene)[0], abs=1e-3)


def test_a_printers_gamut_narrows_the_pixels(scene: SceneDescription) -> None:
    control = bound(scene, pixels=[0.2, 0.8], norm="l2", resolution=4)
    for value in (0.0, 1.0):
        (name, kept) = list(control.get_artifact_images(torch.full_like(control.start, value)).items())[1]
        assert name == "patch-pixels"
        torch.testing.assert_close(kept, torch.full((4, 4, 3), 0.2 + 0.6 * value))
    assert control.groups[0].budget.epsilon == pytest.approx(0.1 * math.sqrt(48) / 0.6)


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


def test_settings_make_the_same_control_again(scene: SceneDescription) -> None:
    control = PatchControl("second", size=[0.1, 0.4], resolution=8, norm="linf")
    assert control.to_settings() == {"kind": "patch", "size": [0.1, 0.4], "resolution": 8, "norm": "linf"}
    again = make_control("second", control.to_settings())
    assert again.to_settings() == control.to_settings() and again.name == "second"
    assert make_control("patch.azimuth").to_settings() == {"azimuth": [0.0, 360.0]}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"resolution": 1}, r"patch.resolution: expected a whole number from 2 to 512, got 1"),
        ({"norm": "l1"}, r"patch.norm: expected one of box, linf, l2, got 'l1'"),
        (
            {"norm": "box", "epsilon": 0.1},
            r"patch.epsilon: expected none with norm box, got 0.1; set norm to linf or l2",
        ),
        ({"epsilon": -1.0, "norm": "l2"}, r"patch.epsilon: expected a number over 0 and up to 1e\+06, got -1.0"),
        ({"size": 2.0}, r"patch.size: expected a number from 0.05 to 0.6 \(object sizes\), got 2"),
        ({"pixels": [0.1, 0.2, 0.3]}, r"patch.pixels: expected \[low, high\] or one number, got a list of 3"),
        ({"pixels": 0.5, "picture": "a.png"}, r"patch.pixels: expected none beside patch.picture"),
        (
            {"picture": "a.png", "epsilon": 0.1},
            r"patch.epsilon: is of the ball that searched pixels stay in, and these are fixed; leave it out, or leave "
            r"out patch.picture",
        ),
        ({"pixels": 0.5, "epsilon": 0.1}, r"patch.epsilon: is of the ball .* leave out patch.pixels"),
        ({"pixels": 0.5, "norm": "l2"}, r"patch.norm: is of the ball that searched pixels stay in"),
        ({"pixels": 0.5}, r"`controls` patch: the pixels are fixed, so there is nothing to search"),
    ],
)
def test_what_cannot_be_is_refused(scene: SceneDescription, given: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        bound(scene, **given)


def test_names_and_files_that_do_not_exist_are_explained(scene: SceneDescription, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown setting of control patch 'sizee'. Did you mean 'size'"):
        PatchControl(sizee=1)
    with pytest.raises(
        FileFormatError, match=r"patch.picture: .*none.png: expected a picture file such as PNG, got No such file"
    ):
        bound(scene, picture=str(tmp_path / "none.png"), azimuth=[0, 360])


@pytest.mark.medium
def test_a_render_shows_the_patch_and_changes_by_the_step_times_the_adjoint() -> None:
    render = advsearch.load_scene("mug").renderer([PatchControl(size=0.5, resolution=8)], resolution=32, denoise="none")
    u = torch.full_like(render.start, 0.5, requires_grad=True)
    image = render(u, seed=0, spp=64)
    (slope,) = torch.autograd.grad(image.mean(), u)
    with torch.no_grad():
        high, low = (render(u + step, seed=0, spp=64) for step in (0.05, -0.05))
    changed = (high - low).amax(dim=-1) > 0.03
    assert 0.03 < float(changed.float().mean()) < 0.3
    assert 0.05 * float(slope.sum()) == pytest.approx(float((high - low).mean()) / 2.0, rel=0.1)
