"""Meshes as people have them: each stands upright, is in the frame and is not black; what can't be kept is said."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

import advsearch
from advsearch.controls import make_control, make_space
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.importing.objects import import_object
from advsearch.scene.importing.texture import sample_texture

TALL = (0.4, 0.6, 1.0)
"""Extents of the test body, z up."""


def block() -> trimesh.Trimesh:
    return trimesh.creation.box(extents=TALL)


def obj(vertices: np.ndarray, faces: np.ndarray, more: str = "") -> bytes:
    lines = [more, *(f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist())]
    return "\n".join([*lines, *("f " + " ".join(map(str, face)) for face in (faces + 1).tolist())]).encode()


def moved(scale: float, shift: float) -> bytes:
    return obj(block().vertices * scale + shift, block().faces)


def unwelded() -> bytes:
    corners = block().triangles.reshape(-1, 3)
    return obj(corners, np.arange(len(corners)).reshape(-1, 3))


def non_manifold() -> bytes:
    vertices = np.concatenate([block().vertices, [[0.0, 0.0, 0.0]]])
    return obj(vertices, np.concatenate([block().faces, [[0, 7, 8], [0, 7, 8], [1, 1, 2]]]))


def inverted() -> bytes:
    body = block()
    normals = "".join(f"vn {-x} {-y} {-z}\n" for x, y, z in body.vertex_normals.tolist())
    faces = "\n".join("f " + " ".join(f"{i}//{i}" for i in face) for face in (body.faces[:, ::-1] + 1).tolist())
    places = "\n".join(f"v {x} {y} {z}" for x, y, z in body.vertices.tolist())
    return f"{places}\n{normals}{faces}\n".encode()


def painted(picture: Image.Image, mode: str | None = None) -> bytes:
    """The block as .glb (y up) with a texture."""
    body = block()
    body.vertices = body.vertices[:, [1, 2, 0]]
    uv = np.random.default_rng(0).random((len(body.vertices), 2))
    material = PBRMaterial(baseColorTexture=picture, alphaMode=mode, roughnessFactor=0.9, metallicFactor=0.0)
    body.visual = TextureVisuals(uv=uv, material=material)
    exported: bytes = body.export(file_type="glb")
    return exported


def deep() -> Image.Image:
    return Image.fromarray(np.full((8, 8), 40_000, dtype=np.uint16))


def palette() -> Image.Image:
    return Image.fromarray(np.full((8, 8, 3), (200, 120, 40), dtype=np.uint8)).quantize(4)


def holes() -> Image.Image:
    pixels = np.full((8, 8, 4), 200, dtype=np.uint8)
    pixels[::2, :, 3] = 0
    return Image.fromarray(pixels)


CASES: dict[str, tuple[str, Callable[[], bytes], str]] = {
    "unwelded": (".obj", unwelded, ""),
    "non-manifold": (".obj", non_manifold, ""),
    "tiny": (".obj", lambda: moved(1e-6, 0.0), ""),
    "huge": (".obj", lambda: moved(1e6, 0.0), ""),
    "far from the origin": (".obj", lambda: moved(1.0, 1e6), ""),
    "inverted": (".obj", inverted, ""),
    "without normals": (".obj", lambda: moved(1.0, 0.0), ""),
    "16 bits": (".glb", lambda: painted(deep()), ""),
    "palette": (".glb", lambda: painted(palette()), ""),
    "cut-outs": (".glb", lambda: painted(holes(), "MASK"), ""),
    "blended": (".glb", lambda: painted(holes(), "BLEND"), ""),
}
"""Ending, content, and words of the warning about what is not kept."""


@pytest.mark.medium
@pytest.mark.parametrize("name", CASES)
def test_a_mesh_stands_upright_in_the_frame_and_is_lit(name: str, tmp_path: Path) -> None:
    suffix, content, words = CASES[name]
    file = tmp_path / f"body{suffix}"
    file.write_bytes(content())
    scene = advsearch.load_scene(file, settings={"ground.size": 0.0})
    described = scene.description
    extents = np.ptp(described.base_vertices, axis=0)
    assert sorted(extents) == pytest.approx(TALL, rel=0.1) and extents[2] == pytest.approx(1.0)  # upright
    assert described.base_vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    camera = camera_to_world(described)
    seen = (described.base_vertices - camera[:3, 3]) @ camera[:3, :3]
    edge = np.tan(np.radians(described.number("camera.fov") / 2.0))
    assert (np.abs(seen[:, :2]) <= edge * seen[:, 2:]).all()
    renderer = scene.renderer("pose", resolution=24, denoise="none")
    body = renderer.mask(renderer.start)
    picture = renderer(renderer.start, seed=0, spp=4)
    assert 0.05 < float(body.float().mean()) < 0.9 and 0.1 < float(picture[body].mean()) < 0.95
    assert words in " ".join(described.notes)
    for control in ("texture", "material", "geometry", "patch", "light", "camera"):
        assert len(make_space([make_control(control)], described).start), control


def test_the_texture_of_a_16_bit_or_palette_picture_is_its_colour(tmp_path: Path) -> None:
    for name, wanted in {"16 bits": (0.61, 0.61, 0.61), "palette": (200 / 255, 120 / 255, 40 / 255)}.items():
        (tmp_path / "body.glb").write_bytes(CASES[name][1]())
        asset = advsearch.load_scene(tmp_path / "body.glb").description.object
        assert asset.base_color.reshape(-1, 3).mean(axis=0) == pytest.approx(wanted, abs=0.03), name


def two_maps(used: int) -> str:
    """A square as .gltf whose left half is dark: by the second of its two sets of texture coordinates."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    values = [corners, np.full((4, 2), 0.5, np.float32), corners[:, :2] * [1, -1] + np.array([0, 1], np.float32)]
    faces = np.array([0, 1, 2, 0, 2, 3], np.uint32)
    arrays = [np.asarray(one, np.float32) for one in values] + [faces]
    shades = io.BytesIO()
    Image.fromarray(np.repeat([[20, 20, 220, 220]], 4, axis=0).astype(np.uint8)).save(shades, "PNG")
    pieces = [*(one.tobytes() for one in arrays), shades.getvalue()]
    starts = np.cumsum([0, *map(len, pieces)]).tolist()
    kinds = [(5126, 4, "VEC3"), (5126, 4, "VEC2"), (5126, 4, "VEC2"), (5125, 6, "SCALAR")]
    surface = {"baseColorTexture": {"index": 0, "texCoord": used}, "metallicFactor": 0.0}
    attributes = {"POSITION": 0, "TEXCOORD_0": 1, "TEXCOORD_1": 2}
    return json.dumps({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": surface}],
        "textures": [{"source": 0}], "images": [{"bufferView": 4, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": at, "componentType": part, "count": count, "type": kind}
            for at, (part, count, kind) in enumerate(kinds)
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(piece)}
            for start, piece in zip(starts, pieces, strict=False)
        ],
        "buffers": [
            {"byteLength": starts[-1],
             "uri": "data:application/octet-stream;base64," + base64.b64encode(b"".join(pieces)).decode()}
        ],
    })  # fmt: skip


@pytest.mark.medium
def test_a_texture_is_looked_up_by_the_coordinates_that_its_material_names(tmp_path: Path) -> None:
    file = tmp_path / "square.gltf"
    file.write_text(two_maps(1))
    asset = import_object(file, facing="+x")
    left = asset.mesh.vertices[:, 0] < 0.0
    inside = (asset.mesh.uvs * 0.8 + 0.1).astype(np.float64)
    assert sample_texture(asset.base_color, inside[left]).mean() < 0.2
    assert sample_texture(asset.base_color, inside[~left]).mean() > 0.7
    file.write_text(two_maps(0))
    assert np.ptp(import_object(file).mesh.uvs[:, 0]) > 0.5 and "unwrapped anew" in " ".join(
        import_object(file).warnings
    )
    file.write_text(two_maps(7))
    assert "lacks texture coordinates" in " ".join(import_object(file).warnings)


@pytest.mark.parametrize(
    ("line", "left_out"),
    [
        ("map_Bump -bm 1 leaf.png", "the normal map 'leaf.png' is missing; it is left out"),
        ("map_Ke leaf.png", "the texture 'leaf.png' of the emission is missing; it is left out"),
        ("Ke 0.2 0 0", ""),
        ("d 1.0", ""),
        ("d 0.25", ""),
        ("Ke 0 0 0", ""),
    ],
)
def test_what_is_not_read_of_a_material_file_is_said(line: str, left_out: str, tmp_path: Path) -> None:
    (tmp_path / "body.mtl").write_text(f"newmtl leaf\nKd 0.5 0.6 0.4\n{line}\n")
    (tmp_path / "body.obj").write_bytes(obj(block().vertices, block().faces, "mtllib body.mtl\nusemtl leaf"))
    warnings = import_object(tmp_path / "body.obj").warnings
    assert [one for one in warnings if "left out" in one] == ([f"body.obj: {left_out}"] if left_out else [])
