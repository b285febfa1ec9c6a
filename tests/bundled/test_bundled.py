"""The bundled objects and environments: sound meshes of every family; what is shipped is what the scripts make."""

import functools

import numpy as np
import pytest

from advsearch.questions.harden.objects import OBJECTS
from advsearch.scene import library
from advsearch.scene.assets import Mesh, ObjectAsset, normalise_mesh
from scenes import build
from scenes.environments import ENVIRONMENTS
from scenes.environments.panorama import HEIGHT, LEVEL, brightness, directions, irradiance
from scenes.places import PLACES, place_files

pytestmark = pytest.mark.island("advsearch.questions.harden")

SEEDS = (None, 1, 2, 3)  # None is the canonical instance
INSTANCES = [pytest.param(name, seed, id=f"{name}-{seed}") for name in sorted(OBJECTS) for seed in SEEDS]


@functools.cache
def instance(name: str, seed: int | None) -> ObjectAsset:
    return OBJECTS[name].generate(None if seed is None else np.random.default_rng(seed))


def corners(mesh: Mesh) -> np.ndarray:
    return mesh.vertices.astype(np.float64)[mesh.faces]


def face_normals(mesh: Mesh) -> np.ndarray:
    a, b, c = np.moveaxis(corners(mesh), 1, 0)
    return np.cross(b - a, c - a)


def charts(mesh: Mesh) -> np.ndarray:
    """Number the connected pieces of a mesh; (F,) the piece of every face."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    i, j = mesh.faces[:, [0, 1]].astype(np.int64).reshape(-1), mesh.faces[:, [1, 2]].astype(np.int64).reshape(-1)
    size = len(mesh.vertices)
    _, piece = connected_components(coo_matrix((np.ones(len(i)), (i, j)), shape=(size, size)), directed=False)
    found: np.ndarray = piece[mesh.faces[:, 0]]
    return found


@pytest.mark.medium
@pytest.mark.parametrize(("name", "seed"), INSTANCES)
def test_a_mesh_is_sound(name: str, seed: int | None) -> None:
    asset = instance(name, seed)
    mesh = asset.mesh
    assert asset.label == name.replace("-", " ")
    assert 500 < len(mesh.faces) < (22000 if name in ("car", "person") else 12000)
    assert all(np.isfinite(a).all() for a in (mesh.vertices, mesh.normals, mesh.uvs, asset.base_color))
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
    assert len(np.unique(mesh.faces)) == len(mesh.vertices), "vertices that no triangle uses"

    normals = face_normals(mesh)
    area = np.linalg.norm(normals, axis=1) / 2
    assert area.min() > 1e-8, "a degenerate triangle"
    agree = (normals * mesh.normals.astype(np.float64)[mesh.faces].mean(axis=1)).sum(axis=1)
    assert (agree > 0.0).mean() > 0.998, "shading normals against the winding"

    again = normalise_mesh(mesh)
    assert again.vertices[:, 2].min() == 0.0
    np.testing.assert_allclose(again.vertices, mesh.vertices, atol=2e-6)
    volume = np.einsum("ij,ij->i", corners(mesh)[:, 0], normals).sum() / 6
    assert volume > 0.0, "the surface is inside out"


@pytest.mark.medium
@pytest.mark.parametrize(("name", "seed"), INSTANCES)
def test_charts_lie_apart_in_the_atlas(name: str, seed: int | None) -> None:
    mesh = instance(name, seed).mesh
    assert mesh.uvs.min() >= 0.0
    assert mesh.uvs.max() <= 1.0
    uv = mesh.uvs.astype(np.float64)[mesh.faces]
    e, f = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]) / 2
    assert (area > 0.0).all(), "a chart is mirrored or folded"
    assert 0.3 < area.sum() < 1.0, "much of the atlas is empty, or charts overlap"

    texels = OBJECTS[name].atlas_size // 2  # half of the canonical size: charts must stay apart there too
    count = np.ceil(4 * area * texels**2).astype(np.int64) + 3
    face = np.repeat(np.arange(len(uv)), count)
    rng = np.random.default_rng(0)
    s, t = rng.random(len(face)), rng.random(len(face))
    s, t = np.where(s + t > 1, 1 - s, s)[:, None], np.where(s + t > 1, 1 - t, t)[:, None]
    cell = np.floor((uv[face, 0] + s * e[face] + t * f[face]) * texels).astype(np.int64)
    owner = np.unique(np.stack([cell[:, 0], cell[:, 1], charts(mesh)[face]], axis=1), axis=0)
    assert len(owner) == len(np.unique(owner[:, :2], axis=0)), "two charts share a texel"


@pytest.mark.parametrize("name", sorted(ENVIRONMENTS))
def test_a_shipped_environment_is_light_of_the_common_brightness(name: str) -> None:
    radiance = library.load_environment(name).radiance
    rows = {"room": 4, "room-evening": 4, "avenue": 320, "crossing": 320, "car-park": 320}.get(name, HEIGHT)
    rows = 320 if name.startswith("street") else rows
    assert radiance.shape == (rows, 2 * rows, 3)
    assert radiance.dtype == np.float32
    assert np.isfinite(radiance).all()
    assert radiance.min() >= 0.0
    assert brightness(radiance.astype(np.float64)) == pytest.approx(LEVEL, rel=0.01)
    up = irradiance(radiance.astype(np.float64), np.array([0.0, 0.0, 1.0]))
    down = irradiance(radiance.astype(np.float64), np.array([0.0, 0.0, -1.0]))
    assert up.sum() > down.sum(), "row 0 should look at the ceiling or the sky"


def test_directions_and_irradiance_have_the_documented_conventions() -> None:
    towards = directions(64, 128)
    np.testing.assert_allclose(np.linalg.norm(towards, axis=-1), 1.0)
    assert towards[0, 0, 2] > 0.99
    assert towards[32, 0] @ np.array([0, 1, 0]) > 0.99
    assert towards[32, 32] @ np.array([1, 0, 0]) > 0.99
    np.testing.assert_allclose(irradiance(np.ones((64, 128, 3)), np.array([0.0, 0.0, 1.0])), np.pi, rtol=1e-3)


@pytest.mark.medium
@pytest.mark.parametrize("name", ["road", "room"])
def test_the_scripts_make_the_places_that_are_shipped(name: str) -> None:
    for path, made in place_files(name, PLACES[name]()).items():
        stored = (build.DATA / path).read_bytes()
        assert build.is_close(path, stored, made), path
        moved = stored.replace(b'roughnessFactor": 0', b'roughnessFactor": 1').replace(b"day:", b"sun:")
        assert moved != stored and not build.is_close(path, moved, made), path
        assert not build.is_close(path, stored[:-100], made), path


def vertex_table(mesh: Mesh) -> np.ndarray:
    return np.concatenate([mesh.vertices, mesh.normals, mesh.uvs], axis=1)


@pytest.mark.parametrize("name", sorted(OBJECTS))
def test_the_library_loads_the_canonical_instance(name: str) -> None:
    asset, made = library.load_object(name), instance(name, None)
    for part in ("vertices", "faces", "normals", "uvs"):
        loaded, expected = getattr(asset.mesh, part), getattr(made.mesh, part)
        assert loaded.dtype == expected.dtype
        assert loaded.shape == expected.shape
    np.testing.assert_array_equal(asset.mesh.faces, made.mesh.faces)
    assert build.is_close_vertices(vertex_table(asset.mesh), vertex_table(made.mesh))
    np.testing.assert_allclose(asset.base_color, made.base_color, rtol=0, atol=build.LEVELS / 255.0 + 1e-6)
    assert (asset.name, asset.label, asset.material) == (name, made.label, made.material)
    assert (asset.finishes, asset.size_in_metres) == (made.finishes, made.size_in_metres)
    assert asset.mesh.materials.keys() == made.mesh.materials.keys()
    assert all((faces == made.mesh.materials[one]).all() for one, faces in asset.mesh.materials.items())
    assert asset.base_color.dtype == np.float32
