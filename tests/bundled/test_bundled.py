"""The bundled objects and environments: sound meshes of every family; what is shipped is what the scripts make."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from advsearch.errors import UnknownNameError
from advsearch.questions.harden.objects import HOUSEHOLD, OBJECTS, STREET
from advsearch.questions.harden.objects.shapes import carve_patches, grid
from advsearch.questions.harden.objects.textures import ParameterSampler
from advsearch.scene import library
from advsearch.scene.assets import Mesh, ObjectAsset, normalise_mesh
from scenes import build, files
from scenes.environments import ENVIRONMENTS
from scenes.environments.panorama import HEIGHT, LEVEL, brightness, directions, irradiance
from scenes.places import PLACES, place_files

SEEDS = (None, 1, 2, 3)  # None is the canonical instance
CLASSES = {
    "mug", "bowl", "bottle", "vase", "teapot", "wine-glass", "frying-pan",
    "hammer", "banana", "ball", "chair", "lamp", "book", "dumbbell",
}  # fmt: skip
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


# ---------------------------------------------------------------------------------------------------- objects


def test_every_class_of_the_library_is_registered() -> None:
    assert set(HOUSEHOLD) == CLASSES
    assert set(STREET) == {"car", "stop-sign", "person"}
    assert {family.label for family in HOUSEHOLD.values()} == {name.replace("-", " ") for name in CLASSES}


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

    texels = OBJECTS[name].texels // 2  # half of the canonical size: charts must stay apart there too
    count = np.ceil(4 * area * texels**2).astype(np.int64) + 3
    face = np.repeat(np.arange(len(uv)), count)
    rng = np.random.default_rng(0)
    s, t = rng.random(len(face)), rng.random(len(face))
    s, t = np.where(s + t > 1, 1 - s, s)[:, None], np.where(s + t > 1, 1 - t, t)[:, None]
    cell = np.floor((uv[face, 0] + s * e[face] + t * f[face]) * texels).astype(np.int64)
    owner = np.unique(np.stack([cell[:, 0], cell[:, 1], charts(mesh)[face]], axis=1), axis=0)
    assert len(owner) == len(np.unique(owner[:, :2], axis=0)), "two charts share a texel"


@pytest.mark.medium
@pytest.mark.parametrize("name", sorted(OBJECTS))
def test_charts_are_about_as_large_as_their_surface(name: str) -> None:
    patches = OBJECTS[name].make(ParameterSampler(None)).patches
    a, b, c = (np.concatenate([p.vertices[p.faces[:, i]] for p in patches]) for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    surface = np.add.reduceat(area, np.cumsum([0] + [len(p.faces) for p in patches[:-1]]))
    ratio = np.array([p.size[0] * p.size[1] for p in patches]) / surface
    fair = (ratio > 0.6) & (ratio < 2.2)
    assert surface[fair].sum() > 0.9 * surface.sum(), "texels are much larger on some parts than on others"


@pytest.mark.medium
@pytest.mark.parametrize("name", sorted(OBJECTS))
def test_seeds_decide_everything(name: str) -> None:
    first, again, other = (OBJECTS[name].generate(np.random.default_rng(seed)) for seed in (7, 7, 8))
    for part in ("vertices", "faces", "normals", "uvs"):
        assert getattr(first.mesh, part).tobytes() == getattr(again.mesh, part).tobytes()
    assert first.base_color.tobytes() == again.base_color.tobytes()
    assert first.material == again.material
    same_shape = first.mesh.vertices.shape == other.mesh.vertices.shape
    assert not same_shape or not np.allclose(first.mesh.vertices, other.mesh.vertices, atol=1e-3)
    assert not np.allclose(first.base_color, other.base_color, atol=0.02)


def test_proportions_of_a_family_vary() -> None:
    sizes = {name: np.array([np.ptp(instance(name, s).mesh.vertices, axis=0) for s in SEEDS]) for name in OBJECTS}
    alike = [name for name, size in sizes.items() if size.std(axis=0).max() < 0.015 and name != "ball"]
    assert not alike, f"these hardly vary: {alike}"


def test_a_grid_patch_faces_outwards_and_maps_charts_to_points() -> None:
    points = np.array([[[0.0, 0, 0], [2, 0, 0]], [[0, 1, 0], [2, 1, 0]]])
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    patch = grid("x", points, normals, (2.0, 1.0), np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    a, b, c = patch.vertices[patch.faces[0]]
    assert np.cross(b - a, c - a)[2] > 0.0
    np.testing.assert_allclose(
        patch.rest(np.array([0.5, 1.0]), np.array([0.25, 1.0])), np.array([[1.0, 0.25, 0.0], [2.0, 1.0, 0.0]])
    )


def test_carving_splits_a_surface_along_a_curve() -> None:
    at = np.linspace(0.0, 1.0, 9)
    points = np.stack([*np.meshgrid(at, at), np.zeros((9, 9))], axis=-1)
    whole = grid("x", points, np.broadcast_to([0.0, 0.0, 1.0], points.shape), (1.0, 1.0), at, at)
    rest, disc = carve_patches([whole], lambda p: 0.3 - np.hypot(p[:, 0] - 0.5, p[:, 1] - 0.5), "disc")
    areas = {}
    for part in (rest, disc):
        a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
        areas[part.tag] = float(np.cross(b - a, c - a)[:, 2].sum() / 2)
        assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()
    assert areas["disc"] == pytest.approx(np.pi * 0.09, rel=0.05)
    assert areas["disc"] + areas["x"] == pytest.approx(1.0)
    assert disc.size == pytest.approx((0.6, 0.6), abs=0.01)
    used = np.unique(disc.faces)
    found = disc.rest(disc.uvs[used, 0], disc.uvs[used, 1])
    np.testing.assert_allclose(found, disc.vertices[used], atol=1e-9)
    (left,) = carve_patches([whole], lambda p: 0.3 - p[:, 0], None)
    assert left.vertices[np.unique(left.faces)][:, 0].min() == pytest.approx(0.3)


def test_things_of_the_street_have_their_size_and_several_materials() -> None:
    car = library.load_object("car")
    assert car.metres == pytest.approx(4.3, abs=0.05)
    extent = np.ptp(car.mesh.vertices, axis=0) * car.metres
    assert 1.7 < extent[1] < 2.2  # with its mirrors
    assert 1.4 < extent[2] < 1.55
    assert set(car.finishes) == set(car.mesh.materials)
    assert sum(map(len, car.mesh.materials.values())) == len(car.mesh.faces)
    assert 1.0 < (library.load_object("stop-sign").metres or 0.0) < 1.3


# ----------------------------------------------------------------------------------------------- environments


def test_half_of_the_environments_are_held_out() -> None:
    streets = {name for name, family in ENVIRONMENTS.items() if family.split == "street"}
    avenues = {"avenue", "avenue-wet", "avenue-snow", "avenue-dusk", "avenue-night"}
    assert streets == {"street", "street-wet", "street-dusk", *avenues} == set(library.list_environments("street"))
    places = {f"{place}{light}" for place in ("crossing", "car-park") for light in ("", "-dusk", "-night")}
    assert {*places, "room", "room-evening"} == set(library.list_environments("place"))
    splits = [family.split for family in ENVIRONMENTS.values()]
    assert splits.count("train") == splits.count("heldout") >= 4
    assert ENVIRONMENTS["studio"].split == ENVIRONMENTS["noon"].split == "train"
    assert ENVIRONMENTS["low-sun"].split == "heldout"
    halves = library.list_environments("train"), library.list_environments("heldout")
    assert (
        sorted((*halves[0], *halves[1], *streets, *library.list_environments("place")))
        == sorted(ENVIRONMENTS)
        == list(library.list_environments())
    )
    assert all(ENVIRONMENTS[name].split == "train" for name in halves[0])


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


# ------------------------------------------------------------------------------------------ what is shipped


def test_the_check_command_names_a_file_that_differs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(build, "DATA", tmp_path)
    monkeypatch.setattr(build, "everything", lambda: iter([("a/b.txt", b"right"), ("c.txt", b"here")]))
    assert build.main([]) == 0
    assert build.main(["--check"]) == 0
    (tmp_path / "a/b.txt").write_bytes(b"wrong")
    (tmp_path / "c.txt").unlink()
    (tmp_path / "left-over").write_bytes(b"")
    assert build.main(["--check"]) == 3
    assert capsys.readouterr().err.split() == [
        word for name in ("a/b.txt", "c.txt", "left-over") for word in ("differs:", f"advsearch/bundled/data/{name}")
    ]


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


def test_what_another_processor_rounds_differently_is_close() -> None:
    asset = instance("ball", None)
    meshes = {
        size: files.ply(replace(asset.mesh, vertices=asset.mesh.vertices + np.float32(size)))
        for size in (0.0, 2e-6, 1e-3)
    }
    assert build.is_close("mesh.ply", meshes[2e-6], meshes[0.0])
    assert not build.is_close("mesh.ply", meshes[1e-3], meshes[0.0])
    assert not build.is_close("mesh.ply", meshes[0.0][:-12], meshes[0.0])
    assert not build.is_close("mesh.ply", b"ply", meshes[0.0])

    texture = np.full((4, 4, 3), 100 / 255, np.float32)
    textures = {level: files.png(texture + np.float32(level / 255)) for level in (0, 1, 2)}
    assert build.is_close("a.png", textures[1], textures[0])
    assert not build.is_close("a.png", textures[2], textures[0])

    light = np.full((8, 16, 3), 0.5, np.float32)
    maps = {share: files.exr(light * np.float32(1.0 + share)) for share in (0.0, 1e-3, 1e-2)}
    assert build.is_close("a.exr", maps[1e-3], maps[0.0])
    assert not build.is_close("a.exr", maps[1e-2], maps[0.0])

    facts = {share: f'{{"a": [{1.0 + share}, 3, "b"]}}'.encode() for share in (0.0, 1e-9, 1e-3)}
    assert build.is_close("a.json", facts[1e-9], facts[0.0])
    assert not build.is_close("a.json", facts[1e-3], facts[0.0])
    assert not build.is_close("a.json", facts[0.0].replace(b"3", b"4"), facts[0.0])


def test_the_data_is_small() -> None:
    """Places, whose meshes are files, are most of it."""
    sizes = {path: path.stat().st_size for path in build.DATA.rglob("*")}
    places = sum(size for path, size in sizes.items() if "places" in path.parts)
    assert places < 29 * 2**20
    assert sum(sizes.values()) - places < 12 * 2**20


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
    assert (asset.finishes, asset.metres) == (made.finishes, made.metres)
    assert asset.mesh.materials.keys() == made.mesh.materials.keys()
    assert all((faces == made.mesh.materials[one]).all() for one, faces in asset.mesh.materials.items())
    assert asset.base_color.dtype == np.float32


def test_the_library_lists_every_object() -> None:
    assert list(library.list_objects()) == sorted(OBJECTS)


def test_unknown_names_come_with_near_matches() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown object 'teapott'\. Did you mean 'teapot'\?.*Known: ball, "):
        library.load_object("teapott")
    with pytest.raises(UnknownNameError, match=r"unknown environment 'studo'\. Did you mean 'studio'\?.*\.exr"):
        library.load_environment("studo")
