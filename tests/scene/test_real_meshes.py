"""Meshes as people have them: each stands upright, is in the frame and is not black; what can't be kept is said."""

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


CASES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "unwelded": (".obj", unwelded),
    "non-manifold": (".obj", non_manifold),
    "tiny": (".obj", lambda: moved(1e-6, 0.0)),
    "huge": (".obj", lambda: moved(1e6, 0.0)),
    "far from the origin": (".obj", lambda: moved(1.0, 1e6)),
    "inverted": (".obj", inverted),
    "without normals": (".obj", lambda: moved(1.0, 0.0)),
    "16 bits": (".glb", lambda: painted(deep())),
    "palette": (".glb", lambda: painted(palette())),
    "cut-outs": (".glb", lambda: painted(holes(), "MASK")),
    "blended": (".glb", lambda: painted(holes(), "BLEND")),
}
"""Ending and content."""


@pytest.mark.medium
@pytest.mark.parametrize("name", CASES)
def test_a_mesh_stands_upright_in_the_frame_and_is_lit(name: str, tmp_path: Path) -> None:
    suffix, content = CASES[name]
    file = tmp_path / f"body{suffix}"
    file.write_bytes(content())
    scene = advsearch.load_scene(file, settings={"ground.size": 0.0})
    described = scene.description
    extents = np.ptp(described.base_vertices, axis=0)
    assert sorted(extents) == pytest.approx(TALL, rel=0.1) and extents[2] == pytest.approx(1.0)  # upright
    assert described.base_vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    camera = camera_to_world(described)
    seen = (described.base_vertices - camera[:3, 3]) @ camera[:3, :3]
    edge = np.tan(np.radians(described.get_number("camera.fov") / 2.0))
    assert (np.abs(seen[:, :2]) <= edge * seen[:, 2:]).all()
    renderer = scene.renderer("pose", resolution=24, denoise="none")
    body = renderer.compute_object_mask(renderer.start)
    picture = renderer(renderer.start, seed=0, spp=4)
    assert 0.05 < float(body.float().mean()) < 0.9 and 0.1 < float(picture[body].mean()) < 0.95
    for control in ("texture", "material", "geometry", "patch", "light", "camera"):
        assert len(make_space([make_control(control)], described).start), control
