"""Objects from mesh files: geometry, normals, texture coordinates, colours, and every error that a file can cause."""

import io
import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

import conftest
from advsearch.errors import FileFormatError, InputError
from advsearch.scene import library, surface_parts
from advsearch.scene.assets import Material, Mesh, ObjectAsset, compute_lengths, multiply_rows
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.geometry import find_unique_rows, find_used
from advsearch.scene.importing.objects import guess_up, import_object
from advsearch.scene.importing.pictures import load_display_image
from advsearch.scene.importing.texture import sample_colors, sample_texture
from fuzz.pictures import plain_png
from glb_files import join_glb, split_glb

DATA = conftest.DATA / "objects"
real_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"the shared test data is not at {DATA}")

CUBE_V = "".join(f"v {x} {y} {z}\n" for z in (0, 1) for y in (0, 1) for x in (0, 1))
CUBE_F = ("1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6")
CUBE = CUBE_V + "".join(f"f {face}\n" for face in CUBE_F)
QUAD_V = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
QUAD_UV = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
QUAD = QUAD_V + QUAD_UV + "f 1/1 2/2 3/3 4/4\n"
MTL = "newmtl paint\nKd 0.2 0.3 0.7\n"


def written(folder: Path, name: str, content: str | bytes) -> Path:
    """Write a file and return its path."""
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def picture(folder: Path, name: str = "wood.png", size: int = 16) -> np.ndarray:
    """Write a smooth RGB picture that repeats without a seam; return its values, (size, size, 3) in [0, 1]."""
    x, y = np.meshgrid(*(2 * np.pi * (np.arange(size) + 0.5) / size,) * 2)
    waves = np.stack([np.sin(x + 1.0), np.sin(y), np.sin(x + y + 2.0) * np.cos(y)], axis=2)
    codes = np.round(127.5 + 120.0 * waves).astype(np.uint8)
    Image.fromarray(codes).save(folder / name)
    found: np.ndarray = codes.astype(np.float32) / np.float32(255.0)
    return found


def exported(folder: Path, name: str, mesh: trimesh.Trimesh | trimesh.Scene, **options: Any) -> Path:
    """Write a mesh with trimesh and return its path."""
    return written(folder, name, mesh.export(file_type=Path(name).suffix[1:], **options))


def face_normals(mesh: Mesh) -> np.ndarray:
    """Return unit normals of the faces (F, 3), from their winding."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    vectors = np.cross(b - a, c - a)
    found: np.ndarray = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return found


def volume(mesh: Mesh) -> float:
    """Return the signed volume inside a closed mesh."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


def overlap(mesh: Mesh, size: int = 256) -> int:
    """Count the texels of a size x size grid whose centres lie well inside two faces or more."""
    hits = np.zeros((size, size), dtype=int)
    grid = (np.arange(size) + 0.5) / size
    for corners in mesh.uvs[mesh.faces].astype(np.float64):
        inside = np.ones((size, size), dtype=bool)
        turn = np.sign(np.cross(np.append(corners[1] - corners[0], 0), np.append(corners[2] - corners[0], 0))[2])
        for k in range(3):
            edge, start = corners[(k + 1) % 3] - corners[k], corners[k]
            side = edge[0] * (grid[:, None] - start[1]) - edge[1] * (grid[None, :] - start[0])
            inside &= turn * side > 1e-3 * np.linalg.norm(edge)
        hits += inside
    return int((hits > 1).sum())


def color_at(asset: ObjectAsset, points: np.ndarray) -> np.ndarray:
    """Return the base colour at the face whose centre is nearest to each of the points (N, 3)."""
    centres = asset.mesh.vertices[asset.mesh.faces].mean(axis=1)
    nearest = ((centres[None] - points[:, None]) ** 2).sum(axis=2).argmin(axis=1)
    return sample_texture(asset.base_color, asset.mesh.uvs[asset.mesh.faces[nearest]].mean(axis=1).astype(np.float64))


def check_sound(asset: ObjectAsset) -> None:
    """Check what holds for every imported object."""
    mesh = asset.mesh
    extent = mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)
    assert extent.max() == pytest.approx(1.0, abs=1e-6)
    assert mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert mesh.vertices.max(axis=0)[:2] == pytest.approx(-mesh.vertices.min(axis=0)[:2], abs=1e-6)
    for array, kind in ((mesh.vertices, "f4"), (mesh.normals, "f4"), (mesh.uvs, "f4"), (mesh.faces, "u4")):
        assert array.dtype == np.dtype(kind)
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert mesh.uvs.min() >= 0.0 and mesh.uvs.max() <= 1.0
    assert ((mesh.normals[mesh.faces] * face_normals(mesh)[:, None]).sum(axis=2) > 0.0).all()
    assert asset.base_color.dtype == np.float32 and asset.base_color.shape[2] == 3
    assert max(asset.base_color.shape) <= 1024
    assert asset.base_color.min() >= 0.0 and asset.base_color.max() <= 1.0


def test_cube_without_anything(tmp_path: Path) -> None:
    asset = import_object(written(tmp_path, "my cube.obj", CUBE))
    check_sound(asset)
    assert asset.name == "my-cube" and asset.source.endswith("my cube.obj") and asset.label is None
    assert asset.warnings == () and asset.material == Material()
    assert (asset.base_color == 0.5).all()
    assert len(asset.mesh.faces) == 12
    assert volume(asset.mesh) == pytest.approx(1.0, abs=1e-5)
    corners = asset.mesh.normals[asset.mesh.faces]
    assert corners == pytest.approx(np.repeat(face_normals(asset.mesh)[:, None], 3, axis=1), abs=1e-5)
    assert overlap(asset.mesh) == 0


@pytest.mark.parametrize(
    ("suffix", "up", "turned"),
    [
        ("obj", None, False), ("stl", None, False), ("glb", None, True), ("gltf", None, True), ("obj", "y", True),
        ("glb", "z", False),
    ],
)  # fmt: skip
def test_up_axis(tmp_path: Path, suffix: str, up: Any, turned: bool) -> None:
    points = np.array([[0.0, 0, 0], [4, 0, 0], [0, 2, 0], [0, 0, 1]])
    mesh = trimesh.Trimesh(points, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], process=False)
    if suffix == "gltf":
        files = mesh.export(file_type="gltf")
        for name, content in files.items():
            written(tmp_path, "thing.gltf" if name.endswith(".gltf") else name, content)
        path = tmp_path / "thing.gltf"
    else:
        path = exported(tmp_path, f"thing.{suffix}", mesh)
    got = import_object(path, up=up).mesh
    expected = points / 4.0
    if turned:
        in_gltf = suffix in ("glb", "gltf")  # whose front is +z, where that of others is +x
        expected = expected[:, [2, 0, 1]] if in_gltf else expected[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    middle = (expected.max(axis=0) + expected.min(axis=0)) / 2
    expected -= [middle[0], middle[1], expected[:, 2].min()]
    assert np.unique(got.vertices.round(5), axis=0) == pytest.approx(np.unique(expected.round(5), axis=0), abs=1e-5)
    assert volume(got) > 0.0


AS_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From points with y up to points with z up, as rows times this matrix transposed."""


@pytest.mark.parametrize("name", library.list_objects())
def test_every_bundled_object_is_recovered_from_a_file_with_either_axis_up(name: str) -> None:
    points = library.load_object(name).mesh.vertices.astype(np.float64)
    for axis, stored in (("z", points), ("y", points @ AS_Y_UP)):
        moved = 3.0 * stored + [5.0, -2.0, 7.0]  # neither the size nor the origin takes part
        assert guess_up(moved, "thing.obj").axis == axis


def test_scene_graph_is_applied_and_parts_are_joined(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    box = trimesh.creation.box()
    scene.add_geometry(box, transform=trimesh.transformations.scale_and_translate([2.0, 1.0, 1.0], [0.0, 0.0, 0.0]))
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirror[:3, 3] = [0.0, 3.0, 0.0]
    scene.add_geometry(trimesh.creation.cone(0.5, 1.0), transform=mirror)
    asset = import_object(exported(tmp_path, "two.glb", scene), up="z")
    check_sound(asset)
    extent = asset.mesh.vertices.max(axis=0) - asset.mesh.vertices.min(axis=0)
    assert extent[:2] == pytest.approx(np.array([2.0, 4.0]) / 4.0, abs=1e-4)
    assert volume(asset.mesh) * 4.0**3 == pytest.approx(2.0 + np.pi / 12, abs=0.01)


def test_a_mirrored_part_keeps_the_normals_of_its_file(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    sphere.vertex_normals = sphere.vertices
    scene = trimesh.Scene()
    scene.add_geometry(sphere, transform=np.diag([-1.0, 2.0, 1.0, 1.0]))
    asset = import_object(exported(tmp_path, "egg.glb", scene, include_normals=True), up="z")
    check_sound(asset)
    points = (asset.mesh.vertices - [0.0, 0.0, 0.25]) * 4.0
    gradient = points / np.array([1.0, 4.0, 1.0])
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    assert asset.mesh.normals == pytest.approx(gradient, abs=1e-4)


@pytest.mark.parametrize("suffix", ["stl", "ply"])
def test_a_cylinder_is_smooth_with_sharp_rims(tmp_path: Path, suffix: str) -> None:
    cylinder = trimesh.creation.cylinder(radius=0.5, height=1.0, sections=32)
    asset = import_object(exported(tmp_path, f"tin.{suffix}", cylinder), up="z")
    check_sound(asset)
    mesh = asset.mesh
    corners, faces = mesh.normals[mesh.faces], face_normals(mesh)
    cap = np.abs(faces[:, 2]) > 0.5
    assert corners[cap] == pytest.approx(np.repeat(faces[cap][:, None], 3, axis=1), abs=1e-5)
    radial = mesh.vertices[mesh.faces[~cap]] * [1.0, 1.0, 0.0]
    assert corners[~cap] == pytest.approx(radial / np.linalg.norm(radial, axis=2, keepdims=True), abs=1e-4)


def test_almost_equal_points_are_welded(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    corners = sphere.vertices[sphere.faces.reshape(-1)]
    corners += np.random.default_rng(0).uniform(-2e-7, 2e-7, corners.shape)
    soup = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    asset = import_object(exported(tmp_path, "ball.ply", soup))
    check_sound(asset)
    outward = asset.mesh.vertices - [0.0, 0.0, 0.5]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert asset.mesh.normals == pytest.approx(outward, abs=0.02)


@pytest.mark.parametrize("inside_out", [False, True])
def test_the_wall_of_a_hollow_faces_the_hollow(tmp_path: Path, inside_out: bool) -> None:
    inner = trimesh.creation.box(extents=[0.5, 0.5, 0.5])
    inner.invert()
    hollow = trimesh.util.concatenate([trimesh.creation.box(), inner])
    if inside_out:
        hollow.invert()
    asset = import_object(exported(tmp_path, "hollow.stl", hollow))
    check_sound(asset)
    assert volume(asset.mesh) == pytest.approx(1.0 - 0.125, abs=1e-5)
    assert bool(asset.warnings) == inside_out


def test_open_sheet_with_mixed_winding_becomes_consistent(tmp_path: Path) -> None:
    lines = [f"v {x} {y} 0\n" for y in range(6) for x in range(6)]
    number = 0
    for y in range(5):
        for x in range(5):
            corners = [6 * y + x + 1, 6 * y + x + 2, 6 * y + x + 8, 6 * y + x + 7]
            number += 1
            lines.append("f " + " ".join(map(str, corners if number % 4 else corners[::-1])) + "\n")
    asset = import_object(written(tmp_path, "sheet.obj", "".join(lines)))
    check_sound(asset)
    assert face_normals(asset.mesh) == pytest.approx(np.tile([0.0, 0.0, 1.0], (50, 1)), abs=1e-6)
    assert len(asset.warnings) == 1 and "12 faces" in asset.warnings[0]


def test_file_normals_are_kept(tmp_path: Path) -> None:
    tilted = np.array([0.6, 0.0, 0.8])
    text = QUAD_V + f"vn {3 * tilted[0]} 0 {3 * tilted[2]}\nf 1//1 2//1 3//1 4//1\n"
    asset = import_object(written(tmp_path, "tile.obj", text))
    assert asset.mesh.normals == pytest.approx(np.tile(tilted, (4, 1)), abs=1e-6)
    assert asset.warnings == ()


@pytest.mark.parametrize(("scale", "offset"), [(1e300, 0.0), (1e-30, 0.0), (1.0, 1e9)])
def test_scale_and_offset_do_not_matter(tmp_path: Path, scale: float, offset: float) -> None:
    lines = [f"v {x * scale + offset!r} {y * scale!r} {z * scale!r}\n" for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    text = "".join(lines) + "".join(f"f {face}\n" for face in CUBE_F)
    asset = import_object(written(tmp_path, "cube.obj", text))
    check_sound(asset)
    assert asset.mesh.vertices == pytest.approx(import_object(written(tmp_path, "b.obj", CUBE)).mesh.vertices)


def textured_quad(folder: Path, uvs: str, *, size: int = 16) -> tuple[ObjectAsset, np.ndarray]:
    """Import a square with a texture and the given four ``vt`` lines; return it and the texture's values."""
    pixels = picture(folder, size=size)
    written(folder, "quad.mtl", "newmtl paint\nKd 0.5 0.5 0.5\nmap_Kd wood.png\n")
    text = "mtllib quad.mtl\nusemtl paint\n" + QUAD_V + uvs + "f 1/1 2/2 3/3 4/4\n"
    return import_object(written(folder, "quad.obj", text)), pixels


def test_file_uvs_and_texture_are_kept(tmp_path: Path) -> None:
    asset, pixels = textured_quad(tmp_path, QUAD_UV)
    check_sound(asset)
    assert asset.warnings == ()
    assert np.array_equal(asset.base_color, pixels)
    assert asset.mesh.uvs == pytest.approx(asset.mesh.vertices[:, :2] + 0.5)  # v = 0 at y = 0: the bottom row


RESAMPLED = 0.02
"""Error of interpolating a 64-texel wave twice."""


def texture_error(asset: ObjectAsset, pixels: np.ndarray, low: tuple[float, float], high: tuple[float, float]) -> float:
    """Return the largest difference of colour, over the square, from a repeated texture spanning low to high."""
    mesh, errors = asset.mesh, []
    for face in mesh.faces:
        for weights in np.random.default_rng(0).dirichlet([2.0, 2.0, 2.0], 200):
            at, uv = weights @ (mesh.vertices[face][:, :2] + 0.5), weights @ mesh.uvs[face]
            there = np.array(low) + at * (np.array(high) - low)
            errors.append(
                np.abs(sample_texture(asset.base_color, uv[None]) - sample_texture(pixels, there[None])).max()
            )
    found: float = max(errors)
    return found


def test_repeating_texture_is_unwrapped_and_resampled(tmp_path: Path) -> None:
    asset, pixels = textured_quad(tmp_path, "vt 0 0\nvt 3 0\nvt 3 2\nvt 0 2\n", size=64)
    check_sound(asset)
    assert overlap(asset.mesh) == 0
    assert len(asset.warnings) == 1 and "unwrapped" in asset.warnings[0]
    assert texture_error(asset, pixels, (0.0, 0.0), (3.0, 2.0)) < RESAMPLED


def test_many_rows_are_multiplied_exactly() -> None:
    rng = np.random.default_rng(0)
    rows = rng.integers(-99, 99, (9001, 3))
    matrix = rng.integers(-99, 99, (3, 3))
    # whole numbers, which numpy multiplies in another way
    assert (multiply_rows(rows.astype(np.float64), matrix.astype(np.float64)) == rows @ matrix).all()
    assert compute_lengths(np.array([[3.0, 4.0, 12.0], [0.0, 0.0, 0.0]])).tolist() == [[13.0], [0.0]]


def test_distinct_rows_and_used_vertices_are_found() -> None:
    rows = [(2, 1), (1, 3), (2, 1), (1, 2), (1, 3)]
    first, unique_of_row = find_unique_rows(np.array(rows))
    distinct = sorted(set(rows))
    assert [rows[index] for index in first] == distinct
    assert first.tolist() == [rows.index(row) for row in distinct]
    assert unique_of_row.tolist() == [distinct.index(row) for row in rows]
    assert find_used(np.array([[4, 0, 2], [2, 0, 4]]), 6).tolist() == [0, 2, 4]


@pytest.mark.parametrize("piece", [1500, 30])
def test_unwrap_of_a_curved_object_does_not_overlap(
    piece: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if piece < 1500:  # it is taken for a large mesh, which is unwrapped in pieces
        for name, value in {"_CELL_FACES": ((1, piece),), "_FACES_PER_ATLAS": 1}.items():
            monkeypatch.setattr(surface_parts, name, value)
    torus = trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12)
    asset = import_object(exported(tmp_path, "ring.stl", torus))
    check_sound(asset)
    assert overlap(asset.mesh, 128) == 0
    a, b, c = (asset.mesh.uvs[asset.mesh.faces[:, k]] for k in range(3))
    area = np.abs(np.cross(np.pad(b - a, ((0, 0), (0, 1))), np.pad(c - a, ((0, 0), (0, 1))))[:, 2]) / 2
    assert (area > 0.0).all() and 0.3 < area.sum() < 1.0


@pytest.mark.parametrize(("width", "height", "expected"), [(2048, 1024, (512, 1024)), (1500, 3000, (1024, 512))])
def test_large_textures_are_averaged_down(tmp_path: Path, width: int, height: int, expected: tuple[int, int]) -> None:
    stripes = np.zeros((height, width, 3), np.uint8)
    stripes[::2] = 255
    Image.fromarray(stripes).save(tmp_path / "wood.png", compress_level=1)
    got = load_display_image(Image.open(tmp_path / "wood.png"))
    assert got.shape == (*expected, 3)
    # black and white lines average to half of white's light, not to half of its code
    assert srgb_to_linear(got).mean() == pytest.approx(0.5, abs=1e-3)


def painted_quad(folder: Path, material: str, *, head: str = "mtllib quad.mtl\nusemtl paint\n") -> ObjectAsset:
    """Import a square whose .mtl file has the given text."""
    written(folder, "quad.mtl", material)
    return import_object(written(folder, "quad.obj", head + QUAD))


@pytest.mark.parametrize("content", [b"not a picture", b"", None])
def test_unreadable_texture_leaves_the_color(tmp_path: Path, content: bytes | None) -> None:
    picture(tmp_path, size=64)
    whole = (tmp_path / "wood.png").read_bytes()
    written(tmp_path, "wood.png", whole[: len(whole) // 2] if content is None else content)
    asset = painted_quad(tmp_path, MTL + "map_Kd wood.png\n")
    assert asset.base_color == pytest.approx(np.broadcast_to([0.2, 0.3, 0.7], (8, 8, 3)))
    assert len(asset.warnings) == 1 and "'wood.png'" in asset.warnings[0]


def test_several_materials_are_baked_into_one_texture(tmp_path: Path) -> None:
    pixels = picture(tmp_path, size=8)
    written(tmp_path, "cube.mtl", "newmtl red\nKd 0.9 0.1 0.1\nnewmtl wood\nmap_Kd wood.png\nnewmtl blue\nKd 0 0 1\n")
    text = "mtllib cube.mtl\n" + CUBE_V + QUAD_UV
    for name, faces in (("red", CUBE_F[2:]), ("blue", CUBE_F[:1]), ("wood", CUBE_F[1:2])):
        text += f"usemtl {name}\n"
        for face in faces:
            text += "f " + " ".join(f"{v}/{k + 1}" if name == "wood" else v for k, v in enumerate(face.split())) + "\n"
    asset = import_object(written(tmp_path, "cube.obj", text))
    check_sound(asset)
    assert len(asset.warnings) == 1 and "3 materials" in asset.warnings[0]
    assert overlap(asset.mesh) == 0
    got = color_at(asset, np.array([[0.0, -0.5, 0.5], [0.0, 0.0, 0.0]]))
    assert got == pytest.approx(np.array([[0.9, 0.1, 0.1], [0.0, 0.0, 1.0]]), abs=1e-5)
    top = asset.mesh.vertices[asset.mesh.faces][:, :, 2].min(axis=1) > 0.99
    for face in asset.mesh.faces[top]:  # the top's texture runs along x and y
        at, uv = asset.mesh.vertices[face].mean(axis=0)[:2] + 0.5, asset.mesh.uvs[face].mean(axis=0)
        expected = sample_colors(pixels, at[None].astype(np.float64))
        assert sample_texture(asset.base_color, uv[None].astype(np.float64)) == pytest.approx(expected, abs=0.03)


def glb(folder: Path, material: PBRMaterial | None, **attributes: np.ndarray) -> Path:
    """Write a square with UVs as .glb."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    mesh = trimesh.Trimesh(points, [[0, 1, 2], [0, 2, 3]], process=False)
    if material is not None:
        mesh.visual = trimesh.visual.TextureVisuals(uv=points[:, :2], material=material)
        for name, values in attributes.items():
            mesh.visual.vertex_attributes[name] = values
    return exported(folder, "quad.glb", mesh)


def split_gltf(folder: Path) -> Path:
    """Write a textured square as .gltf with files beside it: buffers, and wood.png."""
    picture(folder)
    files = trimesh.load_scene(glb(folder, PBRMaterial(baseColorTexture=Image.open(folder / "wood.png")))).export(
        file_type="gltf"
    )
    for name, content in files.items():
        if name.endswith(".gltf"):
            header = json.loads(content)
            del header["images"][0]["bufferView"], header["images"][0]["mimeType"]
            header["images"][0]["uri"] = "wood.png"
            written(folder, "split.gltf", json.dumps(header))
        else:
            written(folder, name, content)
    return folder / "split.gltf"


def test_gltf_with_separate_files(tmp_path: Path) -> None:
    path = split_gltf(tmp_path)
    asset = import_object(path)
    assert asset.warnings == () and asset.base_color.shape == (16, 16, 3)
    (tmp_path / "wood.png").unlink()
    asset = import_object(path)
    assert len(asset.warnings) == 1 and "'wood.png'" in asset.warnings[0]
    (buffer, *_) = tmp_path.glob("*.bin")
    for other in tmp_path.glob("*.bin"):
        other.unlink()
    with pytest.raises(FileFormatError, match=rf"split\.gltf: needs '{buffer.stem[:6]}"):
        import_object(path)


def obj(text: str) -> Callable[[Path], Path]:
    """Return a function that writes an OBJ file."""
    return lambda folder: written(folder, "thing.obj", text)


def raw(name: str, content: bytes) -> Callable[[Path], Path]:
    """Return a function that writes any file."""
    return lambda folder: written(folder, name, content)


def cut(name: str, keep: float, **options: Any) -> Callable[[Path], Path]:
    """Return a function that writes the first share of an exported box."""

    def write(folder: Path) -> Path:
        path = exported(folder, name, trimesh.creation.box(), **options)
        data = path.read_bytes()
        return written(folder, name, data[: int(keep * len(data))])

    return write


def png() -> bytes:
    """Return a small PNG file."""
    buffer = io.BytesIO()
    Image.new("RGB", (4, 4)).save(buffer, "PNG")
    return buffer.getvalue()


NOISE = np.random.default_rng(0).bytes(3000)
BAD: dict[str, Callable[[Path], Path]] = {
    "directory": lambda folder: folder,
    "missing": lambda folder: folder / "no.obj",
    "splats": raw("my thing.splat", b"anything"),
    "fbx": raw("my thing.fbx", b"anything"),
    "collada": raw("my thing.DAE", b"anything"),
    "empty": raw("thing.ply", b""),
    "ending": raw("thing.thing", b"x"),
    "png as obj": raw("thing.obj", png()),
    "png as gltf": raw("thing.gltf", png()),
    "noise as ply": raw("thing.ply", NOISE),
    "noise as glb": raw("thing.glb", NOISE),
    "noise as stl": raw("thing.stl", NOISE),
    "other json": raw("thing.gltf", b"{}"),
    "points only": obj(CUBE_V),
    "nan": obj(CUBE.replace("v 1 1 1", "v 1 nan 1")),
    "coincident": obj("v 1 2 3\n" * 3 + "f 1 2 3\n"),
    "too large": obj("v -1e308 0 0\nv 1.7e308 1 0\nv 0 0 1\nf 1 2 3\n"),
    "no area": obj("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"),
    "cut obj face": obj(CUBE + "f 1 2"),
    "index past end": obj(CUBE + "f 1 2 99\n"),
    "index zero": obj(CUBE + "f 0 1 2\n"),
    "word in a vertex": obj("v 0 0 x\n" + CUBE),
    "cut ply header": cut("t.ply", 0.1),
    "cut ply": cut("t.ply", 0.8),
    "cut glb": cut("t.glb", 0.8),
    "cut stl": cut("t.stl", 0.8),
    "cut ascii stl": raw("t.stl", b"solid x\nfacet normal 0 0 1\n"),
    "compressed": raw(
        "t.glb", join_glb({"asset": {"version": "2.0"}, "extensionsRequired": ["KHR_draco_mesh_compression"]})
    ),
    "old gltf": raw("t.gltf", b'{"asset": {"version": "1.0"}}'),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files(tmp_path: Path, case: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = BAD[case](tmp_path)
    with pytest.raises(InputError) as caught:
        import_object(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


REFERENCES = {
    "above": "../secret.png",
    "absolute": "{outside}/secret.png",
    "through a link": "link.png",
    "through a linked folder": "folder/secret.png",
    "a device": "/dev/zero",
    "a pipe": "pipe.png",
    "a directory": "inside",
    "a long name": "n" * 5000 + ".png",
    "an escape sequence": "\x1b[31m.png",
}


@pytest.mark.parametrize("case", REFERENCES)
def test_references_are_read_from_the_own_folder_only(tmp_path: Path, case: str) -> None:
    home = tmp_path / "home"
    (home / "inside").mkdir(parents=True)
    picture(tmp_path, "secret.png")
    (home / "link.png").symlink_to("../secret.png")
    (home / "folder").symlink_to("..")
    os.mkfifo(home / "pipe.png")
    name = REFERENCES[case].format(outside=tmp_path)
    written(home, "thing.mtl", f"newmtl paint\nKd 0.2 0.3 0.7\nmap_Kd {name}\n")
    asset = import_object(written(home, "thing.obj", "mtllib thing.mtl\nusemtl paint\n" + QUAD))
    (warning,) = asset.warnings
    assert "thing.mtl" in warning and len(warning) < 400 and warning.isprintable()
    assert asset.base_color[0, 0] == pytest.approx([0.2, 0.3, 0.7])


def test_a_reference_below_the_folder_is_read(tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    pixels = picture(tmp_path / "maps")
    (tmp_path / "link.png").symlink_to("maps/wood.png")
    for name in ("maps/wood.png", "link.png"):
        written(tmp_path, "thing.mtl", f"newmtl paint\nmap_Kd {name}\n")
        asset = import_object(written(tmp_path, "thing.obj", "mtllib thing.mtl\nusemtl paint\n" + QUAD))
        assert asset.warnings == () and np.array_equal(asset.base_color, pixels)


def test_material_files_and_buffers_elsewhere_are_not_read(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    written(tmp_path, "secret.mtl", MTL)
    asset = import_object(written(home, "thing.obj", "mtllib ../secret.mtl\nusemtl paint\n" + QUAD))
    assert len(asset.warnings) == 1 and "'../secret.mtl'" in asset.warnings[0]
    path = split_gltf(home)
    (buffer, *_) = home.glob("*.bin")
    buffer.rename(tmp_path / "secret.bin")
    path.write_text(path.read_text().replace(buffer.name, "../secret.bin"))
    with pytest.raises(FileFormatError, match=r"split\.gltf: needs '\.\./secret\.bin'"):
        import_object(path)


def test_pictures_that_run_programs_or_take_gigabytes_are_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = []
    monkeypatch.setattr(subprocess, "Popen", lambda *arguments, **_: started.append(arguments))
    written(tmp_path, "thing.mtl", "newmtl paint\nKd 0.2 0.3 0.7\nmap_Kd wood.png\n")
    path = written(tmp_path, "thing.obj", "mtllib thing.mtl\nusemtl paint\n" + QUAD)
    eps = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 90 90\n%%EndComments\nshowpage\n%%EOF\n"
    for content in (eps, plain_png(20_000, 20_000, 1, 0)):
        written(tmp_path, "wood.png", content)
        (warning,) = import_object(path).warnings
        assert "'wood.png'" in warning
    assert started == []


def test_textures_have_a_limit_in_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(3):
        picture(tmp_path, f"wood{k}.png")
    monkeypatch.setattr("advsearch.scene.importing.pictures.LARGEST_SUM", 512)  # two of the three
    materials = "".join(f"newmtl m{k}\nKd 0.2 0.3 0.7\nmap_Kd wood{k}.png\n" for k in range(3))
    written(tmp_path, "thing.mtl", materials)
    faces = "".join(f"usemtl m{k}\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n" for k in range(3))
    warnings = import_object(written(tmp_path, "thing.obj", "mtllib thing.mtl\n" + QUAD_V + QUAD_UV + faces)).warnings
    assert sum("got 768 in all" in line for line in warnings) == 1


@pytest.mark.parametrize(
    ("face", "limit"), [("f " + "1 2 3 " * 300_000, "10,000 corners"), ("f 1 2 3 4\n" * 30, "20 triangles")]
)
def test_faces_have_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, face: str, limit: str) -> None:
    monkeypatch.setattr("advsearch.scene.importing.files.LARGEST_FACES", 20)
    with pytest.raises(FileFormatError, match=limit):
        import_object(written(tmp_path, "thing.obj", QUAD_V + face))


def test_instances_count_as_triangles(tmp_path: Path) -> None:
    header, rest = split_glb(exported(tmp_path, "ball.glb", trimesh.creation.icosphere(subdivisions=3)).read_bytes())
    header["nodes"] = [{"mesh": 0, "translation": [k, 0, 0]} for k in range(1600)]
    header["scenes"] = [{"nodes": list(range(1600))}]
    with pytest.raises(FileFormatError, match="2,048,000"):
        import_object(written(tmp_path, "thing.glb", join_glb(header, rest)))


def test_jpeg_with_too_many_scans_is_not_decoded(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (16, 16)).save(buffer, "JPEG", progressive=True)
    data = buffer.getvalue()
    last = data.rindex(b"\xff\xda")
    written(tmp_path, "wood.png", data[:-2] + data[last:-2] * 100 + data[-2:])
    written(tmp_path, "thing.mtl", "newmtl paint\nKd 0.2 0.3 0.7\nmap_Kd wood.png\n")
    asset = import_object(written(tmp_path, "thing.obj", "mtllib thing.mtl\nusemtl paint\n" + QUAD))
    assert "110" in asset.warnings[0]


GLTF_CHANGES: dict[str, tuple[list[Any], Any]] = {
    "null meshes": (["meshes"], None),
    "text as integer": (["accessors", 0, "count"], "8"),
    "extensions as text": (["nodes", 0, "extensions"], "all"),
    "light of no number": (["nodes", 0, "extensions"], {"KHR_lights_punctual": {}}),
    "negative index": (["meshes", 0, "primitives", 0, "indices"], -1),
    "index past the end": (["meshes", 0, "primitives", 0, "indices"], 99),
    "huge count": (["accessors", 0, "count"], 10**9),
    "sparse": (["accessors", 0, "sparse"], {"count": 1}),
    "short view": (["bufferViews", 0, "byteLength"], 4),
    "short buffer": (["bufferViews", 0, "byteOffset"], 10**6),
    "fewer normals": (["accessors", 1, "count"], 3),
    "nan": (["nodes", 0, "matrix"], [float("nan")] * 16),
    "cycle": (["nodes"], [{"children": [1], "mesh": 0}, {"children": [0]}]),
    "two parents": (["nodes"], [{"children": [2]}, {"children": [2]}, {"mesh": 0}]),
    "deep": (["nodes"], [{"children": [k + 1]} for k in range(999)] + [{"mesh": 0}]),
    "many pieces": (["nodes"], [{"mesh": 0}] * 20_001),
}


@pytest.mark.parametrize("case", GLTF_CHANGES)
def test_gltf_that_is_not_gltf(tmp_path: Path, case: str) -> None:
    (*path, key), value = GLTF_CHANGES[case]
    header, rest = split_glb(exported(tmp_path, "box.glb", trimesh.creation.box()).read_bytes())
    place: Any = header
    for step in path:
        place = place[step]
    place[key] = value
    with pytest.raises(FileFormatError, match=r"thing\.glb"):
        import_object(written(tmp_path, "thing.glb", join_glb(header, rest)))


@pytest.mark.medium
@real_data
@pytest.mark.parametrize(
    ("name", "up", "faces"),
    [("mug.obj", None, 864), ("teapot.obj", "y", 2464), ("bowl.obj", None, 14030), ("cow.glb", None, 5856)],
)
def test_real_objects(name: str, up: Any, faces: int) -> None:
    asset = import_object(DATA / name, up=up)
    check_sound(asset)
    assert len(asset.mesh.faces) == faces
    assert len(asset.warnings) == (name == "bowl.obj"), "its texture is missing"
    if name in ("mug.obj", "teapot.obj"):
        assert overlap(asset.mesh, 64) == 0
    if name != "cow.glb":
        assert (asset.base_color == 0.5).all()


@pytest.mark.medium
@real_data
def test_real_banana_is_yellow_all_over() -> None:
    asset = import_object(DATA / "banana.obj")
    check_sound(asset)
    assert asset.base_color.shape == (1024, 1024, 3)
    uvs = asset.mesh.uvs[asset.mesh.faces].mean(axis=1).astype(np.float64)
    red, green, blue = sample_texture(asset.base_color, uvs).T  # an upside-down texture would show its black background
    assert (np.minimum(red, green) > blue + 0.15).mean() > 0.95


def test_inside_out_box_is_turned_over(tmp_path: Path) -> None:
    text = CUBE_V + "".join(f"f {' '.join(reversed(face.split()))}\n" for face in CUBE_F)
    asset = import_object(written(tmp_path, "box.obj", text))
    check_sound(asset)
    assert volume(asset.mesh) == pytest.approx(1.0, abs=1e-5)
    assert len(asset.warnings) == 1 and "12 faces" in asset.warnings[0]


@pytest.mark.parametrize(("target", "got"), [("/dev/zero", "a device"), (None, "a pipe"), (".", "a directory")])
def test_only_ordinary_files_are_read(tmp_path: Path, target: str | None, got: str) -> None:
    path = tmp_path / "thing.obj"
    if target is None:
        os.mkfifo(path)
    else:
        path.symlink_to(target)
    with pytest.raises(FileFormatError, match=rf"thing\.obj.*{got}"):
        import_object(path)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"asset": {"version": "2.0"}, "scene": ' + "9" * 6000 + "}"])
def test_gltf_json_has_limits(tmp_path: Path, text: str) -> None:
    with pytest.raises(FileFormatError, match=r"thing\.gltf"):
        import_object(written(tmp_path, "thing.gltf", text))
