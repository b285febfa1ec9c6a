"""Normal maps of glTF and material files: a bump in a picture is lit as the same bump in the geometry."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

import advsearch
from advsearch.scene.assembly import pose_mesh
from advsearch.scene.assets import Float32Array, ObjectAsset
from advsearch.scene.description import OBJECT, SceneDescription, load_description
from advsearch.scene.glb import encode_glb
from advsearch.scene.importing.objects import import_object
from advsearch.scene.importing.parts import FLAT_TEXEL, make_normal_map
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.parts import PointLamp
from glb_files import change_material

pytestmark = pytest.mark.usefixtures("two_threads")

SIDE = 128
RADIUS = 0.3
"""Of the ball of which a cap stands out of the unit square; it is cut where it is 45 degrees steep."""
SEEN = {"camera.azimuth": 0.0, "camera.elevation": 0.0, "camera.fov": 20.0, "ground.size": 0.0}
SIZE = 32
UNIT = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
CORNERS = np.array([[-0.5, 0, 0], [0.5, 0, 0], [0.5, 1, 0], [-0.5, 1, 0.0]])
FACES = [[0, 1, 2], [0, 2, 3]]


def bump(side: int = SIDE) -> np.ndarray:
    """The normal map (side, side, 3) of the cap, 8 bits."""
    row, column = np.mgrid[0:side, 0:side]
    x, y = (column + 0.5) / side - 0.5, 0.5 - (row + 0.5) / side
    share = (x * x + y * y) / RADIUS**2
    normals = np.stack([x / RADIUS, y / RADIUS, np.sqrt(np.clip(1.0 - share, 0.0, 1.0))], axis=-1)
    normals[share > 0.5] = (0, 0, 1)
    return np.asarray(np.round((normals * 0.5 + 0.5) * 255), np.uint8)


def card(
    uv: np.ndarray = UNIT, picture: np.ndarray | None = None, vertices: np.ndarray = CORNERS, grey: float = 0.7
) -> trimesh.Trimesh:
    """A square of one colour with a normal map, y up, that looks along +z."""
    material = PBRMaterial(
        normalTexture=Image.fromarray(bump() if picture is None else picture),
        baseColorFactor=[grey, grey, grey, 1.0], roughnessFactor=1.0, metallicFactor=0.0,
    )  # fmt: skip
    return trimesh.Trimesh(vertices, FACES, process=False, visual=TextureVisuals(uv=uv, material=material))


def halves(mirrored: bool, grey: float) -> trimesh.Scene:
    """The square in two halves, the right one with the left half of the texture, or of another colour."""
    middle = np.array([[0.0, 0], [0, 0], [0, 1], [0, 1]])
    left, right = CORNERS.copy(), CORNERS.copy()
    left[[1, 2], 0] = right[[0, 3], 0] = 0.0
    across = np.array([0.0, 0.5, 0.5, 0.0])
    first = np.stack([across, UNIT[:, 1]], axis=1)
    second = np.stack([across[[1, 0, 3, 2]] if mirrored else across + 0.5, middle[:, 1]], axis=1)
    both = [card(first, vertices=left), card(second, vertices=right, grey=grey)]
    if grey == 0.7:
        both[1].visual.material = both[0].visual.material
        return trimesh.Scene(trimesh.util.concatenate(both))
    return trimesh.Scene(both)


def corner() -> trimesh.Trimesh:
    """The square with the normal map in a corner of its picture."""
    canvas = np.full((1024, 1024, 3), np.uint8(np.round(FLAT_TEXEL * 255)))
    canvas[-SIDE:, :SIDE] = bump()
    return card(UNIT / 8.0, canvas)


WAYS: dict[str, Callable[[], Any]] = {
    "as it is": card,
    "mirrored": lambda: card(UNIT * [-1, 1] + [1, 0]),
    "turned": lambda: card(np.roll(UNIT, 1, axis=0)),
    "half of it mirrored": lambda: halves(True, 0.7),
    "two materials, one mirrored": lambda: halves(True, 0.69),
    "a corner of the picture": corner,
}


def written(made: Any, folder: Path) -> Path:
    file = folder / "card.glb"
    file.write_bytes(made.export(file_type="glb"))
    return file


def lit(scene: SceneDescription, x: float, z: float) -> MitsubaScene:
    """The scene with one lamp on a side of the square, which looks along x."""
    lamp = PointLamp("lamp", position=(6.0, x, 0.5 + z), intensity=(40.0, 40.0, 40.0))
    return MitsubaScene(replace(scene, parts=(lamp,)), (SIZE, SIZE), max_depth=2)


def real() -> trimesh.Trimesh:
    """The square with the cap as geometry."""
    steps = np.linspace(-0.5, 0.5, 129)
    x, y = np.meshgrid(steps, steps)
    height = np.sqrt(np.clip(RADIUS**2 - x * x - y * y, RADIUS**2 / 2.0, None)) - RADIUS * np.sqrt(0.5)
    index = np.arange(129 * 129).reshape(129, 129)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    material = PBRMaterial(baseColorFactor=[0.7, 0.7, 0.7, 1.0], roughnessFactor=1.0, metallicFactor=0.0)
    uv = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
    return trimesh.Trimesh(
        np.stack([x.ravel(), y.ravel() + 0.5, height.ravel()], axis=1), faces, process=False,
        visual=TextureVisuals(uv=uv, material=material),
    )  # fmt: skip


def sides(scene: SceneDescription, x: float, z: float) -> tuple[float, float]:
    """How much brighter than the square the bump is on its right over its left, and on its top over its bottom."""
    picture = lit(scene, x, z).render_radiance({}, 0, 64).mean(dim=2)
    plain = picture[picture > 0.0].median()
    row, column = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    middle = (SIZE - 1) / 2.0
    on = ((row - middle) ** 2 + (column - middle) ** 2).sqrt() < 0.16 * SIZE
    means = [picture[on & there].mean() for there in (column > middle, column < middle, row < middle, row > middle)]
    right, left, top, bottom = (float(one / plain) for one in means)
    return right - left, top - bottom


LAMPS = [(4.0, 0.0), (0.0, -4.0)]


@pytest.fixture(scope="module")
def wanted(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[float, float]]:
    """The same of the real bump."""
    scene = load_description(str(written(real(), tmp_path_factory.mktemp("real"))), "none", setting_values=SEEN)
    return [sides(scene, x, z) for x, z in LAMPS]


@pytest.mark.medium
@pytest.mark.parametrize("way", WAYS)
def test_a_bump_is_lit_as_its_geometry_from_two_sides(
    way: str, wanted: list[tuple[float, float]], tmp_path: Path
) -> None:
    scene = load_description(str(written(WAYS[way](), tmp_path)), "none", setting_values=SEEN)
    assert scene.object.normal_map is not None
    found = [sides(scene, x, z) for x, z in LAMPS]
    assert wanted[0][0] > 0.2 and wanted[1][1] < -0.2
    np.testing.assert_allclose(found, wanted, atol=0.06)


def vectors(texels: Float32Array | None) -> np.ndarray:
    assert texels is not None
    return texels.astype(np.float64) * 2.0 - 1.0


def of_the_bump(scale: float = 1.0) -> np.ndarray:
    return vectors(make_normal_map(bump() / np.float32(255.0), scale))


@pytest.mark.parametrize("scale", [0.5, 2.0, -1.0, 1e30, 0.0])
def test_the_scale_of_gltf_is_a_factor_of_the_slope(scale: float, tmp_path: Path) -> None:
    file = tmp_path / "card.glb"
    file.write_bytes(change_material(card().export(file_type="glb"), normalTexture={"index": 0, "scale": scale}))
    normals, plain = vectors(import_object(file).normal_map), bump() / 127.5 - 1.0
    assert np.abs(np.linalg.norm(normals, axis=2) - 1.0).max() < 1e-5 and normals[..., 2].min() > 0.0
    at = (60, 80)
    slope, wanted = normals[at][:2] / normals[at][2], min(scale, 100.0) * plain[at][:2] / plain[at][2]
    np.testing.assert_allclose(slope, wanted, rtol=2e-3, atol=1e-6)


def in_a_material_file(folder: Path, line: str, picture: np.ndarray) -> ObjectAsset:
    Image.fromarray(picture).save(folder / "the bumps.png")
    corners = "v -1 0 0\nv 1 0 0\nv 1 2 0\nv -1 2 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (folder / "card.obj").write_text(f"mtllib card.mtl\n{corners}usemtl a\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    (folder / "card.mtl").write_text(f"newmtl a\nKd 0.7 0.7 0.7\n{line}\n")
    return import_object(folder / "card.obj", up="y")


@pytest.mark.parametrize(
    ("line", "scale"),
    [("norm the bumps.png", 1.0), ("map_Bump -bm 0.5 the bumps.png", 0.5), ("bump the bumps.png", 1.0)],
)
def test_a_material_file_names_normals(line: str, scale: float, tmp_path: Path) -> None:
    asset = in_a_material_file(tmp_path, line, bump())
    assert asset.warnings == ()
    np.testing.assert_allclose(vectors(asset.normal_map), of_the_bump(scale), atol=1e-6)


def test_gltf_out_has_the_same_normals(tmp_path: Path) -> None:
    part = load_description(str(written(halves(True, 0.7), tmp_path))).meshes[OBJECT]
    (tmp_path / "out.glb").write_bytes(encode_glb([pose_mesh(part, {})]))
    again = import_object(tmp_path / "out.glb")
    assert part.normal_map is not None and again.warnings == ()
    np.testing.assert_allclose(vectors(again.normal_map), vectors(part.normal_map), atol=0.012)
    np.testing.assert_allclose(again.mesh.uvs, part.mesh.uvs, atol=1e-5)
    np.testing.assert_allclose(again.mesh.normals, part.mesh.normals, atol=1e-5)


def test_no_adjoint_with_boundary_terms_is_valid(tmp_path: Path) -> None:
    scene = advsearch.load_scene(written(card(), tmp_path), settings=SEEN)
    groups = scene.renderer(["pose", "texture"], resolution=SIZE).plan.groups
    assert all("material" not in group.valid for group in groups)
    assert "adjoint" in next(group for group in groups if group.control == "texture").valid
