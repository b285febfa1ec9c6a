"""Objects from mesh files: geometry, normals, texture coordinates, colours, and every error that a file can cause."""

from __future__ import annotations

import io
import json
import os
import re
import struct
import subprocess
import sys
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
from advsearch.scene.assets import Material, Mesh, ObjectAsset
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing import objects
from advsearch.scene.importing.objects import guess_up, import_object
from advsearch.scene.importing.pictures import average_area, load_display_image
from advsearch.scene.importing.texture import sample_colors, sample_texture
from fuzz.pictures import plain_png

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


DEFAULT = ": 1 mesh without material: of white metal with roughness 1, the default of glTF"
"""What is said of a mesh that trimesh wrote as glTF without a material."""


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


# --- geometry ----------------------------------------


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
        ("obj", None, False),
        ("ply", None, False),
        ("stl", None, False),
        ("glb", None, True),
        ("gltf", None, True),
        ("obj", "y", True),
        ("obj", "z", False),
        ("glb", "z", False),
    ],
)
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


@pytest.mark.medium
@real_data
@pytest.mark.parametrize("name", ["mug.obj", "teapot.obj", "banana.obj", "bowl.obj", "cow.obj"])
def test_real_objects_stand_upright(name: str) -> None:
    axis = "y" if name in ("teapot.obj", "cow.obj") else "z"
    got, told = (import_object(DATA / name, up=up) for up in (None, axis))  # type: ignore[arg-type]
    assert got.up is not None and got.up.axis == axis
    np.testing.assert_array_equal(got.mesh.vertices, told.mesh.vertices)
    other = "z" if axis == "y" else "y"
    assert got.notes[0].startswith(f"{name}: {axis} is taken for up, because it then rests on ")
    assert got.notes[0].endswith(f"if it lies on its side, give `up={other}`")
    assert told.notes == told.warnings


def test_what_does_not_tell_which_way_is_up_stays_as_it_is(tmp_path: Path) -> None:
    cube = exported(tmp_path, "cube.stl", trimesh.creation.box((1.0, 1.0, 1.0)))
    (note,) = import_object(cube).notes
    assert note.startswith("cube.stl: z is taken for up, because its shape does not tell, as it rests as well either")
    upright = trimesh.Trimesh([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 1, 2]], process=False)  # no area from above
    assert import_object(exported(tmp_path, "flat.ply", upright)).up is not None
    assert import_object(exported(tmp_path, "cube.glb", trimesh.creation.box())).notes == ("cube.glb" + DEFAULT,)


def test_scene_graph_is_applied_and_parts_are_joined(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    box = trimesh.creation.box()
    scene.add_geometry(box, transform=trimesh.transformations.scale_and_translate([2.0, 1.0, 1.0], [0.0, 0.0, 0.0]))
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirror[:3, 3] = [0.0, 3.0, 0.0]
    scene.add_geometry(trimesh.creation.cone(0.5, 1.0), transform=mirror)
    asset = import_object(exported(tmp_path, "two.glb", scene), up="z")
    check_sound(asset)
    assert asset.warnings == ("two.glb" + DEFAULT.replace("mesh", "meshes").replace("1", "2", 1),)
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
    assert asset.warnings == ("egg.glb" + DEFAULT,)
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


def test_inside_out_box_is_turned_over(tmp_path: Path) -> None:
    text = CUBE_V + "".join(f"f {' '.join(reversed(face.split()))}\n" for face in CUBE_F)
    asset = import_object(written(tmp_path, "box.obj", text))
    check_sound(asset)
    assert volume(asset.mesh) == pytest.approx(1.0, abs=1e-5)
    assert asset.warnings == ("box.obj: 12 faces were inside out and have been turned over",)


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
    assert asset.warnings == ("sheet.obj: 12 faces wound against their neighbours were turned over",)


def test_one_sided_surface_is_said(tmp_path: Path) -> None:
    count, lines, faces = 24, [], []
    for k in range(count):
        angle, half = 2 * np.pi * k / count, np.pi * k / count
        for side in (-0.3, 0.3):
            radius = 1.0 + side * np.cos(half)
            lines.append(f"v {radius * np.cos(angle)} {radius * np.sin(angle)} {side * np.sin(half)}\n")
        a, b = 2 * k + 1, 2 * k + 2
        c, d = (a + 2, b + 2) if k < count - 1 else (2, 1)
        faces.append(f"f {a} {c} {d} {b}\n")
    asset = import_object(written(tmp_path, "band.obj", "".join(lines + faces)))
    assert "band.obj: has a one-sided surface (a Moebius strip), so some faces show their backs" in asset.warnings


def test_faces_without_area_are_removed(tmp_path: Path) -> None:
    text = CUBE + "v 0.5 0 0\nf 1 9 2\nf 1 1 2\n"
    asset = import_object(written(tmp_path, "box.obj", text))
    check_sound(asset)
    assert len(asset.mesh.faces) == 12
    assert asset.warnings == ("box.obj: 2 faces without area were removed",)


def test_file_normals_are_kept(tmp_path: Path) -> None:
    tilted = np.array([0.6, 0.0, 0.8])
    text = QUAD_V + f"vn {3 * tilted[0]} 0 {3 * tilted[2]}\nf 1//1 2//1 3//1 4//1\n"
    asset = import_object(written(tmp_path, "tile.obj", text))
    assert asset.mesh.normals == pytest.approx(np.tile(tilted, (4, 1)), abs=1e-6)
    assert asset.warnings == ()


@pytest.mark.parametrize("bad", ["nan 0 1", "0 0 0", "inf 0 0"])
def test_bad_file_normals_are_computed(tmp_path: Path, bad: str) -> None:
    asset = import_object(written(tmp_path, "tile.obj", QUAD_V + f"vn {bad}\nf 1//1 2//1 3//1 4//1\n"))
    assert asset.mesh.normals == pytest.approx(np.tile([0.0, 0.0, 1.0], (4, 1)), abs=1e-6)


def sphere_with(folder: Path, normals: Callable[[np.ndarray], np.ndarray]) -> ObjectAsset:
    """Import a ball whose file gives it the normals that a function makes of the right ones."""
    sphere = trimesh.creation.icosphere(subdivisions=2)
    sphere.vertex_normals = normals(sphere.vertices.copy())
    return import_object(exported(folder, "ball.glb", sphere, include_normals=True))


def test_normals_that_all_point_inwards_are_turned_around(tmp_path: Path) -> None:
    asset = sphere_with(tmp_path, lambda normals: -normals)
    check_sound(asset)
    assert asset.warnings == (
        "ball.glb" + DEFAULT,
        "ball.glb: its normals pointed inwards and were turned around",
    )


def test_contradictory_normals_are_computed_anew(tmp_path: Path) -> None:
    asset = sphere_with(tmp_path, lambda normals: normals * np.where(np.arange(len(normals)) % 2, 1.0, -1.0)[:, None])
    check_sound(asset)
    assert asset.warnings == (
        "ball.glb" + DEFAULT,
        "ball.glb: its normals contradict its faces and were computed anew",
    )


def test_normals_of_an_open_sheet_decide_its_front(tmp_path: Path) -> None:
    asset = import_object(written(tmp_path, "tile.obj", QUAD_V + "vn 0 0 -1\nf 1//1 2//1 3//1 4//1\n"))
    check_sound(asset)
    assert face_normals(asset.mesh)[:, 2] == pytest.approx(-1.0)
    assert asset.warnings == ("tile.obj: 2 faces were inside out and have been turned over",)


@pytest.mark.parametrize(("scale", "offset"), [(1e30, 0.0), (1e300, 0.0), (1e-30, 0.0), (1.0, 1e9)])
def test_scale_and_offset_do_not_matter(tmp_path: Path, scale: float, offset: float) -> None:
    lines = [f"v {x * scale + offset!r} {y * scale!r} {z * scale!r}\n" for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    text = "".join(lines) + "".join(f"f {face}\n" for face in CUBE_F)
    asset = import_object(written(tmp_path, "cube.obj", text))
    check_sound(asset)
    assert asset.mesh.vertices == pytest.approx(import_object(written(tmp_path, "b.obj", CUBE)).mesh.vertices)


def test_relative_indices_polygons_and_odd_text(tmp_path: Path) -> None:
    ring = [(np.cos(a), np.sin(a)) for a in np.arange(6) * np.pi / 3]
    text = "# caf\u00e9\n" + "".join(f"\tv\t{x} {y} 0 \\\n\n" for x, y in ring) + "f -6 -5 -4 -3 -2 -1 # a hexagon\n"
    text += "".join(f"v {x} {y} 5\r\n" for x, y in ring) + "f -6 -5 -4 -3 -2 -1\n"
    asset = import_object(written(tmp_path, "prism.obj", text.encode("latin-1")))
    check_sound(asset)
    assert len(asset.mesh.faces) == 8
    assert set(asset.mesh.vertices[:, 2].tolist()) == {0.0, 1.0}


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb", "stl"])
def test_same_file_same_bytes(tmp_path: Path, suffix: str) -> None:
    scene = trimesh.Scene([trimesh.creation.box(), trimesh.creation.icosphere(subdivisions=2)])
    mesh = scene if suffix == "glb" else scene.to_mesh()
    path = exported(tmp_path, f"thing.{suffix}", mesh)
    first, second = import_object(path), import_object(path)
    for name in ("vertices", "faces", "normals", "uvs"):
        assert getattr(first.mesh, name).tobytes() == getattr(second.mesh, name).tobytes()
    assert first.base_color.tobytes() == second.base_color.tobytes()


# --- texture coordinates and textures ----------------------------------------


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


def test_uvs_moved_by_whole_textures_are_moved_back(tmp_path: Path) -> None:
    asset, pixels = textured_quad(tmp_path, "vt 3 -2\nvt 4 -2\nvt 4 -1\nvt 3 -1\n")
    check_sound(asset)
    assert np.array_equal(asset.base_color, pixels)
    assert asset.mesh.uvs == pytest.approx(asset.mesh.vertices[:, :2] + 0.5)


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


def test_uvs_that_overstep_a_little_keep_their_layout(tmp_path: Path) -> None:
    asset, pixels = textured_quad(tmp_path, "vt -0.1 0.2\nvt 0.9 0.2\nvt 0.9 1.2\nvt -0.1 1.2\n", size=64)
    check_sound(asset)
    assert asset.warnings == () and len(asset.mesh.vertices) == 4
    assert texture_error(asset, pixels, (-0.1, 0.2), (0.9, 1.2)) < RESAMPLED


def test_repeating_texture_is_unwrapped_and_resampled(tmp_path: Path) -> None:
    asset, pixels = textured_quad(tmp_path, "vt 0 0\nvt 3 0\nvt 3 2\nvt 0 2\n", size=64)
    check_sound(asset)
    assert overlap(asset.mesh) == 0
    (warning,) = asset.warnings
    assert warning.startswith(
        "quad.obj: its texture coordinates repeat or hardly use the texture; it was unwrapped anew"
    )
    assert texture_error(asset, pixels, (0.0, 0.0), (3.0, 2.0)) < RESAMPLED


def test_uvs_squashed_to_points_become_an_atlas(tmp_path: Path) -> None:
    Image.fromarray(np.array([[[255, 0, 0], [0, 0, 255]]], np.uint8)).save(tmp_path / "palette.png")
    written(tmp_path, "cube.mtl", "newmtl palette\nmap_Kd palette.png\n")
    faces = [" ".join(f"{v}/{1 + (k == 1)}" for v in face.split()) for k, face in enumerate(CUBE_F)]
    text = "mtllib cube.mtl\nusemtl palette\n" + CUBE_V + "vt 0.25 0.5\nvt 0.75 0.5\n"
    asset = import_object(written(tmp_path, "cube.obj", text + "".join(f"f {face}\n" for face in faces)))
    check_sound(asset)
    got = color_at(asset, np.array([[0.0, 0.1, 1.0], [0.0, 0.1, 0.0], [0.5, 0.1, 0.5]]))
    assert got == pytest.approx(np.array([[0.0, 0, 1], [1, 0, 0], [1, 0, 0]]), abs=1e-6)


def test_plain_object_with_bad_uvs_is_unwrapped(tmp_path: Path) -> None:
    text = CUBE_V + "vt 0 0\nvt 5 0\nvt 5 5\nvt 0 5\n"
    text += "".join("f " + " ".join(f"{v}/{k + 1}" for k, v in enumerate(f.split())) + "\n" for f in CUBE_F)
    asset = import_object(written(tmp_path, "cube.obj", text))
    check_sound(asset)
    assert asset.warnings == () and asset.base_color.shape == (8, 8, 3)
    assert overlap(asset.mesh) == 0


@pytest.mark.parametrize("piece", [1500, 30])
def test_unwrap_of_a_curved_object_does_not_overlap(
    piece: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if piece < 1500:  # it is taken for a large mesh, which is unwrapped in pieces
        for name, value in {"_MAX_CELL_FACES": piece, "_FACES_PER_ATLAS": 1, "_LARGE_MESH_FACES": 1}.items():
            monkeypatch.setattr(surface_parts, name, value)
    torus = trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12)
    asset = import_object(exported(tmp_path, "ring.stl", torus))
    check_sound(asset)
    assert overlap(asset.mesh, 128) == 0
    a, b, c = (asset.mesh.uvs[asset.mesh.faces[:, k]] for k in range(3))
    area = np.abs(np.cross(np.pad(b - a, ((0, 0), (0, 1))), np.pad(c - a, ((0, 0), (0, 1))))[:, 2]) / 2
    assert (area > 0.0).all() and 0.3 < area.sum() < 1.0


@pytest.mark.medium
def test_unwrap_of_a_fine_smooth_object(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=6)  # so fine that xatlas by itself crashes the process
    mesh = import_object(exported(tmp_path, "ball.stl", ball)).mesh
    corners = mesh.uvs[mesh.faces].astype(np.float64)
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    area = np.abs(ax * by - ay * bx)
    spread = np.quantile(area / area.mean(), [0.01, 0.99])
    assert len(mesh.faces) == 81920 and 0.3 < area.sum() / 2 < 1.0
    assert spread[0] > 0.4 and spread[1] < 1.6  # faces are of about one size, in space and on the texture


@pytest.mark.parametrize(("width", "height", "expected"), [(2048, 1024, (512, 1024)), (1500, 3000, (1024, 512))])
def test_large_textures_are_averaged_down(tmp_path: Path, width: int, height: int, expected: tuple[int, int]) -> None:
    stripes = np.zeros((height, width, 3), np.uint8)
    stripes[::2] = 255
    Image.fromarray(stripes).save(tmp_path / "wood.png", compress_level=1)
    got = load_display_image(Image.open(tmp_path / "wood.png"))
    assert got.shape == (*expected, 3)
    # black and white lines average to half of white's light, not to half of its code
    assert srgb_to_linear(got).mean() == pytest.approx(0.5, abs=1e-3)


def test_area_average_is_exact() -> None:
    image = np.random.default_rng(0).random((7, 9, 2), dtype=np.float32)
    got = average_area(image, 3, 4)
    assert got.mean(axis=(0, 1)) == pytest.approx(image.mean(axis=(0, 1)), rel=1e-6)
    weights = np.array([1.0, 1.0, 1 / 3])
    expected = np.einsum("i,ij,j->", weights, image[:3, :3, 0], np.array([1.0, 1.0, 0.25])) / (7 / 3 * 9 / 4)
    assert got[0, 0, 0] == pytest.approx(expected, rel=1e-6)


def test_alpha_palettes_and_depths_of_pictures() -> None:
    rgba = np.full((2, 2, 4), 200, np.uint8)
    rgba[..., 3] = 0
    assert load_display_image(Image.fromarray(rgba)) == pytest.approx(200 / 255)
    assert load_display_image(Image.fromarray(rgba[..., :3]).convert("P")) == pytest.approx(200 / 255, abs=0.02)
    assert load_display_image(Image.fromarray(np.full((2, 2), 32768, np.uint16))) == pytest.approx(0.5, abs=0.003)
    assert load_display_image(Image.fromarray(np.full((2, 2), 0.25, np.float32))) == pytest.approx(0.25, abs=0.003)
    assert load_display_image(Image.new("L", (3, 2), 255)).shape == (2, 3, 3)


# --- materials ----------------------------------------


def painted_quad(folder: Path, material: str, *, head: str = "mtllib quad.mtl\nusemtl paint\n") -> ObjectAsset:
    """Import a square whose .mtl file has the given text."""
    written(folder, "quad.mtl", material)
    return import_object(written(folder, "quad.obj", head + QUAD))


def test_plain_material_color(tmp_path: Path) -> None:
    asset = painted_quad(tmp_path, MTL)
    assert asset.warnings == ()
    assert asset.base_color == pytest.approx(np.broadcast_to([0.2, 0.3, 0.7], (8, 8, 3)))


@pytest.mark.parametrize("line", ["Ns 10", "Kd # white", "Kd nan 0 0", "Kd 0,8 0,1 0,1", "Kd spectral red.rfl"])
def test_material_without_color_is_neutral_grey(tmp_path: Path, line: str) -> None:
    asset = painted_quad(tmp_path, f"newmtl paint\n{line}\n")
    words = line.removeprefix("Kd ").removesuffix("# white")
    said = f"quad.obj: the Kd {words!r} of the material 'paint' is no colour; neutral grey is used instead"
    assert asset.warnings == ((said,) if "Kd" in line else ())
    assert (asset.base_color == 0.5).all()


def test_texture_stands_alone_beside_kd(tmp_path: Path) -> None:
    pixels = picture(tmp_path)
    assert np.array_equal(painted_quad(tmp_path, MTL + "map_Kd wood.png\n").base_color, pixels)


@pytest.mark.parametrize("line", ["map_Kd -s 1 1 1 wood.png", "map_kd .\\wood.png", "MAP_KD C:\\somewhere\\wood.png"])
def test_texture_names_as_exporters_write_them(tmp_path: Path, line: str) -> None:
    pixels = picture(tmp_path)
    asset = painted_quad(tmp_path, f"newmtl paint\n{line}\n")
    assert asset.warnings == ()
    assert np.array_equal(asset.base_color, pixels)


def test_missing_texture_leaves_the_color(tmp_path: Path) -> None:
    asset = painted_quad(tmp_path, MTL + "map_Kd gone.png\n")
    assert asset.base_color == pytest.approx(np.broadcast_to([0.2, 0.3, 0.7], (8, 8, 3)))
    assert asset.warnings == (
        "quad.obj: quad.mtl names the texture 'gone.png', which is missing;"
        " its base colour (0.20, 0.30, 0.70) is used instead",
    )


def test_missing_texture_of_a_white_material_leaves_grey(tmp_path: Path) -> None:
    asset = painted_quad(tmp_path, "newmtl paint\nKd 1 1 1\nmap_Kd gone.png\n")
    assert (asset.base_color == 0.5).all()
    assert asset.warnings == (
        "quad.obj: quad.mtl names the texture 'gone.png', which is missing; neutral grey is used instead",
    )


@pytest.mark.parametrize("content", [b"not a picture", b"", None])
def test_unreadable_texture_leaves_the_color(tmp_path: Path, content: bytes | None) -> None:
    picture(tmp_path, size=64)
    whole = (tmp_path / "wood.png").read_bytes()
    written(tmp_path, "wood.png", whole[: len(whole) // 2] if content is None else content)
    asset = painted_quad(tmp_path, MTL + "map_Kd wood.png\n")
    assert asset.base_color == pytest.approx(np.broadcast_to([0.2, 0.3, 0.7], (8, 8, 3)))
    assert asset.warnings == (
        "quad.obj: quad.mtl names the texture 'wood.png', which cannot be read as a picture;"
        " its base colour (0.20, 0.30, 0.70) is used instead",
    )


def test_missing_material_file_and_missing_material(tmp_path: Path) -> None:
    asset = painted_quad(tmp_path, MTL, head="mtllib gone.mtl\nusemtl paint\n")
    assert (asset.base_color == 0.5).all()
    assert asset.warnings == (
        "quad.obj names the material file 'gone.mtl', which is missing; neutral grey is used instead",
    )
    asset = painted_quad(tmp_path, MTL, head="mtllib quad.mtl\nusemtl pant\n")
    assert (asset.base_color == 0.5).all()
    assert asset.warnings == (
        "quad.obj uses the material 'pant', which its .mtl file lacks; neutral grey is used instead",
    )


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
    assert asset.warnings == (
        "cube.obj: the colours of its 3 materials were baked into one texture (512 x 512 texels)",
    )
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


def test_gltf_color_is_linear(tmp_path: Path) -> None:
    asset = import_object(glb(tmp_path, PBRMaterial(baseColorFactor=[0.2, 0.5, 1.0, 0.3])))
    expected = linear_to_srgb(np.array([0.2, 0.5, 1.0], np.float32))
    assert asset.base_color == pytest.approx(np.broadcast_to(expected, (8, 8, 3)), abs=2e-3)  # trimesh: 8 bits
    assert asset.material == Material(roughness=1.0, metallic=1.0) and asset.warnings == ()


def test_gltf_texture_times_factor_with_roughness_and_metallic(tmp_path: Path) -> None:
    pixels = picture(tmp_path)
    image = Image.open(tmp_path / "wood.png")
    material = PBRMaterial(
        baseColorTexture=image, baseColorFactor=[1.0, 0.2, 1.0, 1.0], roughnessFactor=0.25, metallicFactor=0.75
    )
    asset = import_object(glb(tmp_path, material))
    expected = linear_to_srgb((srgb_to_linear(pixels) * np.array([1.0, 0.2, 1.0])).astype(np.float32))
    assert asset.base_color == pytest.approx(expected, abs=1e-5)
    assert asset.material == Material(roughness=0.25, metallic=0.75)
    assert asset.warnings == ()


def test_gltf_without_material_is_white_metal_as_the_format_says(tmp_path: Path) -> None:
    asset = import_object(glb(tmp_path, None))
    assert asset.base_color.min() > 0.999 and asset.material == Material(roughness=1.0, metallic=1.0)
    assert asset.warnings == ("quad.glb" + DEFAULT,)


def test_gltf_roughness_texture_is_replaced_by_its_mean(tmp_path: Path) -> None:
    packed = np.zeros((4, 4, 3), np.uint8)
    packed[:2, :, 1], packed[:, :, 2] = 255, 51
    material = PBRMaterial(metallicRoughnessTexture=Image.fromarray(packed), roughnessFactor=0.5)
    asset = import_object(glb(tmp_path, material))
    assert asset.material.roughness == pytest.approx(0.25) and asset.material.metallic == pytest.approx(0.2)
    assert asset.warnings == ("quad.glb: textures of roughness and metallic are replaced by their means",)


def test_several_roughnesses_are_replaced_by_their_mean(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    for k, (size, roughness) in enumerate(((1.0, 0.2), (2.0, 0.7))):
        box = trimesh.creation.box(extents=[size] * 3)
        material = PBRMaterial(name=f"m{k}", baseColorFactor=[1.0, 0.0, 0.0, 1.0], roughnessFactor=roughness)
        box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
        scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([3.0 * k, 0.0, 0.0]))
    asset = import_object(exported(tmp_path, "boxes.glb", scene))
    assert asset.material.roughness == pytest.approx(0.2 * 0.2 + 0.8 * 0.7)
    told = "the roughness and metallic of its materials are replaced by their means (0.6 and 1)"
    assert asset.warnings == (f"boxes.glb: {told}",)
    assert asset.base_color == pytest.approx(np.broadcast_to([1.0, 0.0, 0.0], (8, 8, 3)))


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
    assert asset.warnings == (
        "split.gltf names the texture 'wood.png', which is missing; neutral grey is used instead",
    )
    (buffer, *_) = tmp_path.glob("*.bin")
    for other in tmp_path.glob("*.bin"):
        other.unlink()
    with pytest.raises(
        FileFormatError, match=rf"split\.gltf: needs '{buffer.stem[:6]}.*', which is missing; put that file"
    ):
        import_object(path)


def test_vertex_colors_are_baked(tmp_path: Path) -> None:
    box = trimesh.creation.box(extents=[1.0, 1.0, 1.0])
    box.visual.vertex_colors = np.where(box.vertices[:, 2:] > 0.0, [[255, 0, 0, 255]], [[0, 0, 255, 255]])
    asset = import_object(exported(tmp_path, "box.ply", box))
    check_sound(asset)
    assert asset.warnings == ("box.ply: its vertex or face colours were baked into a texture (512 x 512 texels)",)
    got = color_at(asset, np.array([[0.0, 0.1, 1.0], [0.0, 0.1, 0.0]]))
    assert got == pytest.approx(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), abs=1e-5)


def test_one_vertex_color_is_a_plain_color(tmp_path: Path) -> None:
    text = QUAD_V.replace("\n", " 0.2 0.4 0.6\n") + "f 1 2 3 4\n"
    asset = import_object(written(tmp_path, "tile.obj", text))
    assert asset.warnings == ()
    assert asset.base_color == pytest.approx(np.broadcast_to([0.2, 0.4, 0.6], (8, 8, 3)), abs=2e-3)  # trimesh: 8 bits


def test_gltf_vertex_colors_multiply_the_material(tmp_path: Path) -> None:
    colors = np.tile(np.array([[255, 128, 0, 255]], np.uint8), (4, 1))
    path = glb(tmp_path, PBRMaterial(baseColorFactor=[0.5, 0.5, 0.5, 1.0]), color=colors)
    asset = import_object(path)
    expected = linear_to_srgb(np.array([255, 128, 0], np.float32) / 255 * np.float32(128 / 255))
    assert asset.base_color == pytest.approx(np.broadcast_to(expected, (8, 8, 3)), abs=1e-3)


def test_ply_keeps_normals_and_uvs_together(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\ncomment TextureFile wood.png\nelement vertex 4\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz", "s", "t"))
    header += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    corners = [(1, 1), (0, 0), (1, 0), (0, 1)]
    rows = "".join(f"{x} {y} 0 {0.6 * x} 0 {1 - 0.2 * x} {x} {y}\n" for x, y in corners)
    pixels = picture(tmp_path)
    path = written(tmp_path, "tile.ply", header + rows + "3 1 2 0\n3 1 0 3\n")
    asset = import_object(path)
    assert asset.warnings == () and np.array_equal(asset.base_color, pixels)
    x = asset.mesh.vertices[:, 0] + 0.5
    assert asset.mesh.uvs == pytest.approx(asset.mesh.vertices[:, :2] + 0.5, abs=1e-6)
    assert asset.mesh.normals[:, 0] == pytest.approx(0.6 * x, abs=1e-6)
    (tmp_path / "wood.png").unlink()
    assert import_object(path).warnings == (
        "tile.ply names the texture 'wood.png', which is missing; neutral grey is used instead",
    )


# --- bad input ----------------------------------------


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


def glb_of(header: dict[str, Any], rest: bytes = b"") -> bytes:
    """Return a .glb file with a JSON chunk, and whatever comes after it."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def glb_parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the header of a .glb file, and what comes after it."""
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[20 + length :]


NOISE = np.random.default_rng(0).bytes(3000)
BAD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "directory": (lambda folder: folder, r": expected a file with an object, got a directory; name a file inside it"),
    "missing": (lambda folder: folder / "no.obj", r"no\.obj: no such object file\. Check the path"),
    "missing folder": (lambda f: f / "no" / "no.obj", r"no such object file\. The folder .*no does not exist either\."),
    "empty": (raw("thing.ply", b""), r"thing\.ply: the object file is empty; export or download it again"),
    "ending": (
        raw("thing.thing", b"x"),
        r"ending in .*\.blend, .*\.usdc or \.usdz, got '\.thing'; convert it",
    ),
    "no ending": (raw("thing", b"x"), r"got a name without ending; convert it to one of these"),
    "png as obj": (raw("thing.obj", png()), r"expected a Wavefront OBJ file .*, got a PNG picture; export or download"),
    "png as ply": (raw("thing.ply", png()), r"expected a PLY file with a complete header, got a PNG picture"),
    "png as glb": (raw("thing.glb", png()), r"expected a binary glTF file, got a PNG picture"),
    "png as gltf": (raw("thing.gltf", png()), r"expected glTF with a JSON header, got a PNG picture"),
    "png as stl": (raw("thing.stl", png()), r"expected an STL file .*, got a PNG picture"),
    "noise as obj": (raw("thing.obj", NOISE), r"expected a Wavefront OBJ file .*, got binary data of another kind"),
    "noise as ply": (raw("thing.ply", NOISE), r"expected a PLY file .*, got binary data of another kind"),
    "noise as glb": (raw("thing.glb", NOISE), r"expected a binary glTF file, got binary data of another kind"),
    "noise as gltf": (raw("thing.gltf", NOISE), r"expected glTF with a JSON header, got something else"),
    "noise as stl": (raw("thing.stl", NOISE), r"expected an STL file .*, got 3000 bytes"),
    "text as obj": (obj("hello\nworld\n"), r"expected a Wavefront OBJ file .*, got text of another kind"),
    "other json": (raw("thing.gltf", b"{}"), r"expected glTF with an 'asset' entry, got other JSON"),
    "points only": (obj(CUBE_V), r"expected a mesh with faces, got points or lines only; export triangles"),
    "no nodes": (raw("t.glb", glb_of({"asset": {"version": "2.0"}})), r"expected a mesh with faces, got none"),
    "nan": (obj(CUBE.replace("v 1 1 1", "v 1 nan 1")), r"expected finite vertices, got 1 of 8 with NaN or infinite"),
    "infinite": (obj(CUBE.replace("v 1 1 1", "v 1 inf 1")), r"coordinates \(the first: \[1\.0, inf, 1\.0\]\); repair"),
    "coincident": (
        obj("v 1 2 3\n" * 3 + "f 1 2 3\n"),
        r"an object with a size, got a mesh in which all vertices coincide",
    ),
    "too large": (obj("v -1e308 0 0\nv 1.7e308 1 0\nv 0 0 1\nf 1 2 3\n"), r"its extent is too large to compute with"),
    "no area": (obj("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"), r"expected faces with an area, got 1 without"),
    "cut obj face": (obj(CUBE + "f 1 2"), r"3 or more corners on line 15, got 'f 1 2' \(is the file cut short\?\)"),
    "cut obj vertex": (obj("v 0 0 0\nv 1 0"), r"3 numbers after 'v' on line 2, got '1 0' \(is the file cut short\?\)"),
    "index past end": (obj(CUBE + "f 1 2 99\n"), r"at least 99 'v' lines, got 8, and a face on line 15 that refers to"),
    "index zero": (obj(CUBE + "f 0 1 2\n"), r"indices that count from 1 in the face on line 15, got '0'"),
    "index before start": (obj(CUBE + "f -9 1 2\n"), r"indices that count from 1 in the face on line 15, got '-9'"),
    "index not a number": (obj(CUBE + "f a b c\n"), r"whole numbers in the face on line 15, got 'a'"),
    "word in a vertex": (obj("v 0 0 x\n" + CUBE), r"expected numbers after 'v' on line 1, got '0 0 x'; export"),
    "cut ply header": (cut("t.ply", 0.1), r"expected a PLY file with a complete header, got half of one"),
    "cut ply": (
        cut("t.ply", 0.8),
        r"expected 12 rows of 'face', as the PLY header says, got fewer; the file is cut",
    ),
    "cut ascii ply": (
        cut("t.ply", 0.9, encoding="ascii"),
        r"expected 12 rows of 'face', as the PLY header says, got fewer; the file is cut",
    ),
    "cut glb": (cut("t.glb", 0.8), r"expected \d+ bytes, as its header says, got \d+; the file is cut short"),
    "cut glb header": (raw("t.glb", b"glTF\2\0"), r"expected a binary glTF file, got the first few bytes of one"),
    "cut stl": (cut("t.stl", 0.8), r"an STL file \(in binary, 684 bytes for its number of facets\), got 547 bytes"),
    "cut ascii stl": (
        raw("t.stl", b"solid x\nfacet normal 0 0 1\n"),
        r"ASCII STL file that ends in 'endsolid', got one",
    ),
    "compressed": (
        raw("t.glb", glb_of({"asset": {"version": "2.0"}, "extensionsRequired": ["KHR_draco_mesh_compression"]})),
        r"needs KHR_draco_mesh_compression, which is not supported; export it without that option",
    ),
    "old gltf": (
        raw("t.gltf", b'{"asset": {"version": "1.0"}}'),
        r"expected glTF of version 2, got version '1\.0'; export",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files(tmp_path: Path, case: str, capfd: pytest.CaptureFixture[str]) -> None:
    make, message = BAD[case]
    path = make(tmp_path)
    with pytest.raises(InputError, match=message) as caught:
        import_object(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.medium
@pytest.mark.parametrize("suffix", ["obj", "ply", "glb", "stl"])
def test_damage_anywhere_is_the_inputs_fault(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]) -> None:
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4) * 8
    data = exported(tmp_path, f"box.{suffix}", box).read_bytes()
    random, refused = np.random.default_rng(0), 0
    for _ in range(20):
        broken = bytearray(data)
        for position in random.integers(len(data), size=3):
            broken[position] = random.integers(256)
        try:
            import_object(written(tmp_path, f"broken.{suffix}", bytes(broken)))
        except InputError:
            refused += 1  # anything else fails the test
    assert refused > 0
    assert capfd.readouterr() == ("", "")


# --- hostile input ----------------------------------------


@pytest.mark.parametrize(("target", "got"), [("/dev/zero", "a device"), (None, "a pipe"), (".", "a directory")])
def test_only_ordinary_files_are_read(tmp_path: Path, target: str | None, got: str) -> None:
    path = tmp_path / "thing.obj"
    if target is None:
        os.mkfifo(path)
    else:
        path.symlink_to(target)
    with pytest.raises(FileFormatError, match=rf"thing\.obj: expected .*object.*, got {got}"):
        import_object(path)


REFERENCES = {
    "above": ("../secret.png", "is outside its folder and is not read"),
    "absolute": ("{outside}/secret.png", "is outside its folder and is not read"),
    "through a link": ("link.png", "is outside its folder and is not read"),
    "through a linked folder": ("folder/secret.png", "is outside its folder and is not read"),
    "a device": ("/dev/zero", "is outside its folder and is not read"),
    "a pipe": ("pipe.png", "is not read (expected an ordinary file, got a pipe; write what it yields to a file and"),
    "a directory": ("inside", "is not read (expected an ordinary file, got a directory; name a file inside it)"),
    "a long name": ("n" * 5000 + ".png", "is missing"),
    "an escape sequence": ("\x1b[31m.png", "is missing"),
}


@pytest.mark.parametrize("case", REFERENCES)
def test_references_are_read_from_the_own_folder_only(tmp_path: Path, case: str) -> None:
    home = tmp_path / "home"
    (home / "inside").mkdir(parents=True)
    picture(tmp_path, "secret.png")
    (home / "link.png").symlink_to("../secret.png")
    (home / "folder").symlink_to("..")
    os.mkfifo(home / "pipe.png")
    name, why = REFERENCES[case]
    written(home, "thing.mtl", f"newmtl paint\nKd 0.2 0.3 0.7\nmap_Kd {name.format(outside=tmp_path)}\n")
    asset = import_object(written(home, "thing.obj", "mtllib thing.mtl\nusemtl paint\n" + QUAD))
    (warning,) = asset.warnings
    assert warning.startswith("thing.obj: thing.mtl names the texture ") and why in warning
    assert warning.endswith("; its base colour (0.20, 0.30, 0.70) is used instead")
    assert len(warning) < 400 and warning.isprintable()
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
    assert asset.warnings == (
        "thing.obj names the material file '../secret.mtl', which is outside its folder and is not read; neutral grey"
        " is used instead",
    )
    path = split_gltf(home)
    (buffer, *_) = home.glob("*.bin")
    buffer.rename(tmp_path / "secret.bin")
    path.write_text(path.read_text().replace(buffer.name, "../secret.bin"))
    message = (
        r"split\.gltf: needs '\.\./secret\.bin', which is outside its folder and is not read; put that file beside it"
    )
    with pytest.raises(FileFormatError, match=message):
        import_object(path)


def test_pictures_that_run_programs_or_take_gigabytes_are_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = []
    monkeypatch.setattr(subprocess, "Popen", lambda *arguments, **_: started.append(arguments))
    written(tmp_path, "thing.mtl", "newmtl paint\nKd 0.2 0.3 0.7\nmap_Kd wood.png\n")
    path = written(tmp_path, "thing.obj", "mtllib thing.mtl\nusemtl paint\n" + QUAD)
    eps = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 90 90\n%%EndComments\nshowpage\n%%EOF\n"
    contents = {
        "which cannot be read as a picture": eps,
        "which is not read (expected a picture of at most 67,108,864 pixels, got 20000 x 20000; if": (
            plain_png(20_000, 20_000, 1, 0)
        ),
    }
    for reason, content in contents.items():
        written(tmp_path, "wood.png", content)
        (warning,) = import_object(path).warnings
        assert warning.startswith(f"thing.obj: thing.mtl names the texture 'wood.png', {reason}")
    assert started == []


def test_textures_have_a_limit_in_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(3):
        picture(tmp_path, f"wood{k}.png")
    monkeypatch.setattr("advsearch.scene.importing.pictures.LARGEST_SUM", 512)  # two of the three
    materials = "".join(f"newmtl m{k}\nKd 0.2 0.3 0.7\nmap_Kd wood{k}.png\n" for k in range(3))
    written(tmp_path, "thing.mtl", materials)
    faces = "".join(f"usemtl m{k}\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n" for k in range(3))
    warnings = import_object(written(tmp_path, "thing.obj", "mtllib thing.mtl\n" + QUAD_V + QUAD_UV + faces)).warnings
    assert sum("pictures of at most 512 pixels, got 768 in all; if you trust it" in line for line in warnings) == 1


def test_large_pictures_are_averaged_in_bands_to_the_same_values(monkeypatch: pytest.MonkeyPatch) -> None:
    image = Image.fromarray(np.random.default_rng(0).integers(0, 256, (1100, 1300, 3), np.uint8))
    whole = load_display_image(image, 100)
    monkeypatch.setattr("advsearch.scene.importing.pictures._BAND", 50_000)
    assert np.array_equal(load_display_image(image, 100), whole)


@pytest.mark.parametrize(
    ("face", "message"),
    [
        ("f " + "1 2 3 " * 300_000, r"at most 10,000 corners in the face on line 5, got 900,000; if you trust it, ADV"),
        ("f 1 2 3 4\n" * 30, r"expected a mesh of at most 20 triangles, got 60; if you trust it, ADVSEARCH_LIMITS=10"),
    ],
)
def test_faces_have_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, face: str, message: str) -> None:
    if "20 triangles" in message:
        monkeypatch.setattr("advsearch.scene.importing.files.LARGEST_FACES", 20)
    with pytest.raises(FileFormatError, match=message):
        import_object(written(tmp_path, "thing.obj", QUAD_V + face))


@pytest.mark.parametrize("index", ["8", "-1", "-2147483648"])
def test_faces_of_vertices_that_are_not_there(tmp_path: Path, index: str) -> None:
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4) * 8
    text = exported(tmp_path, "box.ply", box, encoding="ascii").read_text()
    lines = text.rstrip().split("\n")
    lines[-1] = f"3 0 1 {index}"
    with pytest.raises(FileFormatError, match="a face that refers to a vertex that is not there; export or download"):
        import_object(written(tmp_path, "thing.ply", "\n".join(lines) + "\n"))


def test_a_heap_of_faces_is_laid_out_in_a_grid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advsearch.scene.surface_parts._MAX_PATCHES", 8)
    corners = np.random.default_rng(0).random((33, 3, 3))
    heap = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(99).reshape(-1, 3), process=False)
    monkeypatch.setattr("advsearch.scene.surface_parts._FACES_PER_ATLAS", 8)
    asset = import_object(exported(tmp_path, "heap.stl", heap))
    check_sound(asset)
    assert overlap(asset.mesh) == 0 and len(asset.mesh.faces) == 33


def test_instances_count_as_triangles(tmp_path: Path) -> None:
    header, rest = glb_parts(exported(tmp_path, "ball.glb", trimesh.creation.icosphere(subdivisions=3)).read_bytes())
    header["nodes"] = [{"mesh": 0, "translation": [k, 0, 0]} for k in range(1600)]
    header["scenes"] = [{"nodes": list(range(1600))}]
    with pytest.raises(FileFormatError, match=r"a mesh of at most 2,000,000 triangles, got 2,048,000; if you trust it"):
        import_object(written(tmp_path, "thing.glb", glb_of(header, rest)))


def test_jpeg_with_too_many_scans_is_not_decoded(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (16, 16)).save(buffer, "JPEG", progressive=True)
    data = buffer.getvalue()
    last = data.rindex(b"\xff\xda")
    written(tmp_path, "wood.png", data[:-2] + data[last:-2] * 100 + data[-2:])
    written(tmp_path, "thing.mtl", "newmtl paint\nKd 0.2 0.3 0.7\nmap_Kd wood.png\n")
    asset = import_object(written(tmp_path, "thing.obj", "mtllib thing.mtl\nusemtl paint\n" + QUAD))
    assert "expected a JPEG of at most 64 scans, got 110; if you trust it" in asset.warnings[0]


@pytest.mark.parametrize("line", ["f {} 1 2", "v 1 {}", "f {}"])
def test_messages_show_what_a_file_holds_briefly_and_plainly(tmp_path: Path, line: str) -> None:
    text = QUAD_V + line.format("\x1b]0;owned\x07" + "n" * 5000) + "\nf 1 2 3\n"
    with pytest.raises(FileFormatError, match=r"thing\.obj") as caught:
        import_object(written(tmp_path, "thing.obj", text))
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400 + len(str(tmp_path))


@pytest.mark.medium
def test_warnings_have_an_end(tmp_path: Path) -> None:
    written(tmp_path, "thing.mtl", MTL)
    faces = "".join(f"usemtl none{k}\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n" for k in range(22))
    asset = import_object(written(tmp_path, "thing.obj", "mtllib thing.mtl\n" + QUAD_V + QUAD_UV + faces))
    assert len(asset.warnings) == 21
    assert asset.warnings[-1] == "thing.obj: 2 more warnings are left out"


def test_old_gltf_materials_keep_their_diffuse_color(tmp_path: Path) -> None:
    data = glb(tmp_path, PBRMaterial(baseColorFactor=[1.0, 0.0, 0.0, 1.0])).read_bytes()
    header, rest = glb_parts(data)
    old = {"diffuseFactor": [0.0, 1.0, 0.0, 1.0], "glossinessFactor": 0.25, "specularFactor": [1, 1, 1]}
    header["materials"][0] = {"extensions": {"KHR_materials_pbrSpecularGlossiness": old}}
    asset = import_object(written(tmp_path, "old.glb", glb_of(header, rest)))
    assert asset.base_color[0, 0] == pytest.approx([0, 1, 0]) and asset.material == Material(0.75, 0.0)


GLTF_CHANGES: dict[str, tuple[list[Any], Any, str]] = {
    "null meshes": (["meshes"], None, r"glTF whose meshes is a valid list, got 'null'"),
    "integer as list": (["scene"], [0], r"glTF whose scene is a valid integer, got '\[0\]'"),
    "text as integer": (["accessors", 0, "count"], "8", r"glTF whose accessors\[0\]\.count is a valid integer"),
    "extensions as text": (["nodes", 0, "extensions"], "all", r"glTF whose extensions are objects, got '\"all\"'"),
    "extensions as list": (["nodes", 0, "extensions"], [], r"glTF whose extensions are objects, got '\[\]'"),
    "light of no number": (
        ["nodes", 0, "extensions"],
        {"KHR_lights_punctual": {}},
        r"glTF with nodes\[0\]\.extensions\.KHR_lights_punctual\.light, got nothing",
    ),
    "extension as number": (
        ["extensions"],
        {"KHR_lights_punctual": 2},
        r"glTF whose extensions are objects, got",
    ),
    "negative index": (
        ["meshes", 0, "primitives", 0, "indices"],
        -1,
        r"indices is greater than or equal to 0, got '-1'",
    ),
    "index past the end": (["meshes", 0, "primitives", 0, "indices"], 99, r"glTF with 100 accessors, as it refers to"),
    "huge count": (["accessors", 0, "count"], 10**9, r"geometry and pictures of at most 268,435,456 bytes, got"),
    "sparse": (
        ["accessors", 0, "sparse"],
        {"count": 1},
        r"expected glTF with accessors\[0\]\.sparse\.indices, got nothing",
    ),
    "short view": (["bufferViews", 0, "byteLength"], 4, r"expected a view of at least \d+ bytes, got 4"),
    "short buffer": (
        ["bufferViews", 0, "byteOffset"],
        10**6,
        r"a buffer of at least 1,000,\d+ bytes, got \d+; the file is",
    ),
    "fewer normals": (["accessors", 1, "count"], 3, r"expected faces of its own vertices, got a face that refers to"),
    "nan": (["nodes", 0, "matrix"], [float("nan")] * 16, r"matrix\[0\] is a finite number, got 'NaN'"),
    "cycle": (["nodes"], [{"children": [1], "mesh": 0}, {"children": [0]}], r"nodes that form trees, got a cycle"),
    "two parents": (["nodes"], [{"children": [2]}, {"children": [2]}, {"mesh": 0}], r"one parent each, got two for"),
    "deep": (
        ["nodes"],
        [{"children": [k + 1]} for k in range(999)] + [{"mesh": 0}],
        r"of at most 500 levels, got more",
    ),
    "many pieces": (["nodes"], [{"mesh": 0}] * 20_001, r"at most 20,000 nodes and pieces, got 20,001"),
}


@pytest.mark.parametrize("case", GLTF_CHANGES)
def test_gltf_that_is_not_gltf(tmp_path: Path, case: str) -> None:
    (*path, key), value, message = GLTF_CHANGES[case]
    header, rest = glb_parts(exported(tmp_path, "box.glb", trimesh.creation.box()).read_bytes())
    place: Any = header
    for step in path:
        place = place[step]
    place[key] = value
    with pytest.raises(FileFormatError, match=message) as caught:
        import_object(written(tmp_path, "thing.glb", glb_of(header, rest)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("[" * 100_000, "lists or objects nested deeper than 100"),
        ('{"asset": {"version": "2.0"}, "scene": ' + "9" * 6000 + "}", "a whole number of 6000 digits"),
    ],
)
def test_gltf_json_has_limits(tmp_path: Path, text: str, got: str) -> None:
    with pytest.raises(FileFormatError, match=f"expected glTF with a JSON header, got {got}"):
        import_object(written(tmp_path, "thing.gltf", text))


def test_near_matches_of_a_missing_file(tmp_path: Path) -> None:
    for name in ("Teapot.obj", "teacup.glb", "teapot.png"):
        written(tmp_path, name, "x")
    with pytest.raises(
        FileFormatError, match=r"no such object file\. Did you mean 'Teapot\.obj' or 'teacup\.glb'\? Check"
    ):
        import_object(tmp_path / "teapott.obj")


def test_up_must_be_an_axis(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="up axis: expected 'y' or 'z', got 'x'"):
        import_object(written(tmp_path, "cube.obj", CUBE), up="x")  # type: ignore[arg-type]


def test_parts_without_faces_are_left_out(tmp_path: Path) -> None:
    scene = trimesh.Scene([trimesh.creation.box(), trimesh.PointCloud(np.eye(3))])
    asset = import_object(exported(tmp_path, "mixed.glb", scene))
    assert asset.warnings == ("mixed.glb: 1 parts without faces (points, lines) are left out", "mixed.glb" + DEFAULT)


def with_header(folder: Path, change: Callable[[dict[str, Any]], None], name: str = "changed.glb") -> Path:
    """Write a square as .glb with a changed header."""
    header, rest = glb_parts(glb(folder, PBRMaterial(baseColorFactor=[1.0, 0.0, 0.0, 1.0])).read_bytes())
    change(header)
    return written(folder, name, glb_of(header, rest))


def _occluded(header: dict[str, Any]) -> None:
    header["materials"][0]["occlusionTexture"] = {"index": 7}


def _held(*names: str) -> Callable[[dict[str, Any]], None]:
    """Give the material extensions that the file does not list."""
    return lambda header: header["materials"][0].update(extensions={name: {} for name in names})


def _painted(header: dict[str, Any]) -> None:
    header["materials"][0]["alphaMode"] = "BLEND"
    primitive = header["meshes"][0]["primitives"][0]
    positions = header["accessors"][primitive["attributes"]["POSITION"]]
    bytes_of = {**positions, "componentType": 5121, "type": "VEC4"}
    header["accessors"].append({key: bytes_of[key] for key in ("bufferView", "componentType", "count", "type")})
    primitive["attributes"]["COLOR_0"] = len(header["accessors"]) - 1


def _elsewhere(header: dict[str, Any]) -> None:
    first = len(header["nodes"])
    header["nodes"] += [{"mesh": 0}, {"mesh": 0}]
    header["scenes"].append({"nodes": [first]})


def _morphed(header: dict[str, Any]) -> None:
    primitive = header["meshes"][0]["primitives"][0]
    primitive["targets"] = [{"POSITION": primitive["attributes"]["POSITION"]}]


@pytest.mark.parametrize(
    ("change", "notes"),
    [
        (
            lambda header: header["meshes"][0]["primitives"][0]["attributes"].update(
                _CUSTOM=0, COLOR_1=0, TEXCOORD_1=0
            ),
            [f": attribute '{name}' is left out" for name in ("_CUSTOM", "COLOR_1", "TEXCOORD_1")],
        ),
        (
            lambda header: header["materials"][0].update(shininess=3, extras={"glow": 1}),
            [": entry of a material 'shininess' is left out", ": entry of a material 'extras' is left out"],
        ),
        (
            lambda header: header.update(
                extensionsUsed=["KHR_materials_sheen", "EXT_mesh_gpu_instancing", "KHR_lights_punctual"],
                extensionsRequired=["KHR_materials_sheen"],
            ),
            [
                " repeats meshes with EXT_mesh_gpu_instancing; each is there once",
                " uses KHR_materials_sheen, which is not understood and left out",
            ],
        ),
        (
            _held("KHR_materials_unlit", "KHR_materials_transmission", "KHR_materials_ior", "ACME_paint"),
            [
                " uses ACME_paint, which is not understood and left out",
                " uses KHR_materials_ior, which is not understood and left out",
                " lets light pass through surfaces with KHR_materials_transmission; here they are opaque",
                " has surfaces that keep their colour in any light (KHR_materials_unlit); here they are lit as others",
            ],
        ),
        (_held("KHR_materials_emissive_strength"), []),
        (
            _held("KHR_materials_pbrSpecularGlossiness"),
            [" has KHR_materials_pbrSpecularGlossiness, of which only diffuse colour and glossiness are read"],
        ),
        (lambda header: header.update(extras={"extensions": {"ACME_note": 1}}), []),
        (
            _painted,
            [
                ": 1 mesh with an opacity in vertex colours, which is left out",
                ": its vertex or face colours were baked into a texture (512 x 512 texels)",
            ],
        ),
        (_elsewhere, [": 1 further scene: left out", ": 2 nodes with a mesh outside of its scene: left out"]),
        (
            lambda header: header["materials"][0].update(alphaMode="mask"),
            [": 1 material with an alphaMode that glTF does not have: opaque"],
        ),
        (_occluded, [": 1 occlusion map: left out"]),
        (_morphed, [" is shown at rest: the control body moves it"]),
        (lambda header: header.update(skins=[{"joints": [0]}], animations=[{"channels": []}]), []),
    ],
)
def test_what_a_gltf_has_and_is_not_carried_over_is_said(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], notes: list[str]
) -> None:
    path = with_header(tmp_path, change)
    assert import_object(path).warnings == tuple(f"changed.glb{note}" for note in notes)


def test_a_mesh_that_does_not_come_out_whole_is_refused_by_the_name_of_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(soup: object) -> None:
        raise InputError("mesh uvs: found NaN or infinite values; repair the mesh")

    monkeypatch.setattr(objects, "assemble", broken)  # as with skews of 2**32, where xatlas makes no numbers
    path = glb(tmp_path, PBRMaterial(baseColorFactor=[1.0, 0.0, 0.0, 1.0]))
    with pytest.raises(InputError, match=re.escape(f"{path}: mesh uvs: found NaN or infinite values; repair")):
        import_object(path)


@pytest.mark.parametrize("name", ["FOO_geometry", "KHR_draco_mesh_compression", "EXT_mesh_gpu_instancing"])
def test_a_gltf_that_needs_what_is_not_understood_is_refused(tmp_path: Path, name: str) -> None:
    path = with_header(tmp_path, lambda header: header.update(extensionsUsed=[name], extensionsRequired=[name]))
    with pytest.raises(FileFormatError, match=f"needs {name}, which is not supported; export it without that option"):
        import_object(path)


def test_lights_and_cameras_beside_a_whole_object_are_named(tmp_path: Path) -> None:
    def lit(header: dict[str, Any]) -> None:
        header["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point"}]}}
        header["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.7}}]
        header["nodes"] += [{"extensions": {"KHR_lights_punctual": {"light": 0}}}, {"camera": 0}, {"camera": 0}]

    (note,) = import_object(with_header(tmp_path, lit)).warnings
    assert note.startswith("changed.glb: 1 light and 2 cameras are left out of the object; name one node as the object")


@pytest.mark.medium
def test_importing_does_not_pull_in_the_renderer() -> None:
    code = "import sys, advsearch.scene.importing.objects, advsearch.scene.library as e\n"
    code += "print({'mitsuba', 'torch'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


# --- objects that nobody here made ----------------------------------------


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
    missing = ("bowl.obj: model.mtl names the texture 'texture.png', which is missing; neutral grey is used instead",)
    assert asset.warnings == (missing if name == "bowl.obj" else ())
    if name in ("mug.obj", "teapot.obj"):
        assert overlap(asset.mesh, 64) == 0
    if name != "cow.glb":
        assert (asset.base_color == 0.5).all()


@pytest.mark.medium
@real_data
def test_real_banana_is_yellow_all_over() -> None:
    asset = import_object(DATA / "banana.obj")
    check_sound(asset)
    reduced = "banana.obj: the texture 'texture_map.png' of 4,096 x 4,096 texels is averaged down to 1,024 x 1,024"
    assert asset.warnings == (reduced,) and asset.base_color.shape == (1024, 1024, 3)
    uvs = asset.mesh.uvs[asset.mesh.faces].mean(axis=1).astype(np.float64)
    red, green, blue = sample_texture(asset.base_color, uvs).T  # an upside-down texture would show its black background
    assert (np.minimum(red, green) > blue + 0.15).mean() > 0.95


@pytest.mark.medium
@real_data
def test_real_cow_is_the_same_from_both_formats() -> None:
    one, other = import_object(DATA / "cow.obj", up="y", facing="+z"), import_object(DATA / "cow.glb")
    assert np.abs(one.base_color - other.base_color).max() < 0.01
    assert other.material.roughness == pytest.approx(0.99)
    points = np.random.default_rng(0).permutation(one.mesh.vertices[one.mesh.faces].mean(axis=1))[:300]
    assert color_at(one, points) == pytest.approx(color_at(other, points), abs=0.02)
    assert one.warnings == () and one.mesh.vertices.max() == pytest.approx(other.mesh.vertices.max(), abs=1e-5)


def test_a_huge_texture_coordinate_is_looked_up() -> None:
    texture = np.random.default_rng(0).random((4, 6, 3), dtype=np.float32)
    assert np.isfinite(sample_texture(texture, np.array([[1e308, -1e308], [-1e308, 1.0]]))).all()
    near = np.array([[0.3, 0.7]])
    assert np.allclose(
        sample_texture(texture, near + np.array([[2.0, -3.0]])), sample_texture(texture, near), atol=1e-5
    )
