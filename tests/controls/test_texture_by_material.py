"""Textures by material: which texels belong to which material of a file, and a search that keeps to some of them."""

from collections.abc import Callable, Sequence
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
from advsearch.controls import make_control, make_space
from advsearch.engine.judging import mean_variation, printable_distance
from advsearch.errors import InputError
from advsearch.scene.assets import Mesh, ObjectAsset
from advsearch.scene.importing.objects import import_object
from advsearch.scene.raster import find_exclusive_texels, find_read_texels, look_up_texture

Box = tuple[Sequence[float], Sequence[float]]
CAR: dict[str, list[Box]] = {
    "Body Paint": [((-1, -0.4, 0.2), (1, 0.4, 0.5))],
    "roof": [((-0.45, -0.32, 0.83), (0.35, 0.32, 0.88))],
    "glass": [((-0.5, -0.36, 0.51), (0.4, 0.36, 0.82))],
    "tyres": [((x, y, 0), (x + 0.36, y + 0.14, 0.36)) for x in (-0.8, 0.44) for y in (-0.55, 0.41)],
    "plate": [((1.001, -0.15, 0.28), (1.02, 0.15, 0.38))],
}
"""Boxes from corner to corner by material, z up."""
COLOURS = {
    "Body Paint": (0.7, 0.1, 0.1),
    "roof": (0.6, 0.6, 0.65),
    "glass": (0.1, 0.2, 0.25),
    "tyres": (0.05, 0.05, 0.05),
    "plate": (0.9, 0.9, 0.7),
}
SIDES = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))


def corners(box: Box) -> np.ndarray:
    low, high = (np.array(one, dtype=np.float64) for one in box)
    steps = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
    return np.asarray(low + steps * (high - low))


def car(folder: Path, colours: dict[str, tuple[float, float, float]] = COLOURS, opacity: float = 0.4) -> Path:
    """A car of boxes with five materials, one of them see-through, and an .mtl file beside it."""
    lines, count = ["mtllib car.mtl"], 0
    for name, boxes in CAR.items():
        lines.append(f"usemtl {name}")
        for box in boxes:
            lines += [f"v {x:g} {y:g} {z:g}" for x, y, z in corners(box)]
            lines += ["f " + " ".join(str(count + 1 + corner) for corner in side) for side in SIDES]
            count += 8
    (folder / "car.obj").write_text("\n".join(lines) + "\n")
    said = {name: f"newmtl {name}\nKd {' '.join(map(str, colour))}\n" for name, colour in colours.items()}
    said["glass"] += f"d {opacity}\n"
    (folder / "car.mtl").write_text("".join(said.values()))
    return folder / "car.obj"


def car_as_gltf(folder: Path) -> Path:
    """The same in binary glTF, a node a box."""
    scene = trimesh.Scene()
    turn = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    for name, boxes in CAR.items():
        material = PBRMaterial(
            name=name, baseColorFactor=[*COLOURS[name], 1.0], roughnessFactor=0.5, metallicFactor=0.0
        )
        for box in boxes:
            low, high = corners(box)[[0, -1]]
            mesh = trimesh.creation.box(bounds=[low, high])
            mesh.apply_transform(turn)
            mesh.visual = TextureVisuals(uv=np.zeros((len(mesh.vertices), 2)), material=material)
            scene.add_geometry(mesh)
    scene.export(folder / "car.glb")
    return folder / "car.glb"


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return car(tmp_path_factory.mktemp("car"))


@pytest.fixture(scope="module")
def scene(file: Path) -> advsearch.Scene:
    return advsearch.load_scene(file, settings={"ground.size": 0.0})


def seen(mesh: Mesh, faces: np.ndarray, texture: np.ndarray, count: int = 40) -> np.ndarray:
    """What bilinear lookups at random places on some faces find."""
    weights = np.random.default_rng(0).dirichlet([0.3] * 3, size=(len(faces), count))
    uvs = np.einsum("fnk,fkc->fnc", weights, mesh.uvs[mesh.faces[faces]].astype(np.float64)).reshape(-1, 2)
    height, width = texture.shape[:2]
    return look_up_texture(texture, uvs[:, 0] * width - 0.5, (1.0 - uvs[:, 1]) * height - 0.5)


@pytest.mark.parametrize("write", [car, car_as_gltf])
def test_the_materials_of_a_file_keep_their_faces_and_their_texels(
    write: Callable[[Path], Path], tmp_path: Path
) -> None:
    asset = import_object(write(tmp_path))
    mesh, side = asset.mesh, len(asset.base_color)
    assert {name: len(faces) for name, faces in mesh.materials.items()} == {
        name: 12 * len(boxes) for name, boxes in CAR.items()
    }
    assert sorted(np.concatenate(list(mesh.materials.values()))) == list(range(len(mesh.faces)))
    for name, faces in mesh.materials.items():
        found = seen(mesh, faces, asset.base_color)
        wanted = COLOURS[name] if write is car else linear_to_display(COLOURS[name])
        np.testing.assert_allclose(found, np.broadcast_to(wanted, found.shape), atol=0.01)
        assert find_exclusive_texels(mesh, faces, (side, side))[1] == 1.0, "no texel is read by two materials"
    told = " ".join(asset.warnings)
    assert "the colours of its 5 materials were baked into one texture (512 x 512 texels)" in told


def linear_to_display(color: Sequence[float]) -> np.ndarray:
    linear = np.array(color)
    return np.asarray(np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))


@pytest.mark.parametrize("seed", range(8))
def test_the_texels_that_lookups_read_are_all_there(seed: int) -> None:
    """Against lookups at many random places in a triangle; some have corners on texel centres."""
    random, shape = np.random.default_rng(seed), (13, 17)
    triangle = random.random((1, 3, 2)) * [17, 13] * random.choice([0.1, 0.5, 1.0])
    triangle = (np.round(triangle) if seed % 2 else triangle) - 0.5
    read = find_read_texels(triangle, shape)
    places = random.dirichlet([0.5] * 3, 20_000) @ triangle[0]
    left, top = np.floor(places[:, 0]).astype(int), np.floor(places[:, 1]).astype(int)
    wanted = np.zeros(shape, bool)
    for row in (0, 1):
        for column in (0, 1):
            across, down = np.abs(places[:, 0] - left - 1 + column), np.abs(places[:, 1] - top - 1 + row)
            counts = across * down > 1e-9
            wanted[(top[counts] + row) % 13, (left[counts] + column) % 17] = True
    assert read[wanted].all() and read.sum() <= wanted.sum() + 12


FORMS: list[dict[str, object]] = [{}, {"form": "palette"}, {"form": "waves", "epsilon": 0.3}]


@pytest.mark.medium
@pytest.mark.parametrize("form", FORMS)
def test_only_the_texels_of_the_materials_are_painted(scene: advsearch.Scene, form: dict[str, object]) -> None:
    control = make_control("texture", {"materials": ["Body Paint", "roof"], **form})
    space, asset = make_space([control], scene.description), scene.description.object
    u = torch.rand(space.start.shape, generator=torch.Generator().manual_seed(0))
    made = space.get_artifact_images(u)
    before, after = made["texture-original"].numpy(), made["texture"].numpy()
    assert np.array_equal(before, asset.base_color)
    for name, faces in asset.mesh.materials.items():
        same = (seen(asset.mesh, faces, before) == seen(asset.mesh, faces, after)).all(axis=1)
        assert same.mean() < 0.05 if name in ("Body Paint", "roof") else same.all(), name
    assert np.array_equal(space.get_artifact_images(space.start)["texture"].numpy(), before)


def test_the_ball_is_over_what_is_painted(scene: advsearch.Scene) -> None:
    """Its default radius in L2, and the root mean square that is told, count the painted texels alone."""
    space = make_space([make_control("texture", {"materials": "plate", "norm": "l2"})], scene.description)
    (group,) = space.groups
    assert len(space.start) == group.size < 0.05 * 3 * 512 * 512
    assert group.budget.epsilon == pytest.approx(0.1 * group.size**0.5)
    u = (space.start - 0.1).clamp(0.0, 1.0)
    told = space.describe(u)
    assert told["texture.rms"]["value"] == pytest.approx(0.1) and told["texture.materials"]["value"] == "plate"


def quads(folder: Path, second: Sequence[Sequence[float]]) -> ObjectAsset:
    """Two quads of two materials with one picture, not square; the first has its left half, the second these UVs."""
    texels = np.random.default_rng(3).integers(0, 256, (256, 320, 3)).astype(np.uint8)
    Image.fromarray(texels).save(folder / "p.png")
    uvs = [(0, 0), (0.5, 0), (0.5, 1), (0, 1), *second]
    lines = ["mtllib q.mtl", *(f"vt {u} {v}" for u, v in uvs)]
    lines += [f"v {x} {y} {z}" for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
    lines += ["usemtl one", "f 1/1 2/2 3/3 4/4", "usemtl other", "f 5/5 6/6 7/7 8/8"]
    (folder / "q.obj").write_text("\n".join(lines) + "\n")
    (folder / "q.mtl").write_text("newmtl one\nmap_Kd p.png\nnewmtl other\nmap_Kd p.png\n")
    return import_object(folder / "q.obj", up="z")


def test_materials_beside_each_other_on_one_picture_share_no_texel(tmp_path: Path) -> None:
    """The file's own picture is kept; the texels on both sides of the seam stay as they are. Lookups of the first reach
    around the picture's border."""
    quads(tmp_path, [(0.5, 0), (1, 0), (1, 1), (0.5, 1)])
    described = advsearch.load_scene(tmp_path / "q.obj", up="z").description
    mesh, own = described.object.mesh, described.object.base_color
    space = make_space([make_control("texture", {"materials": "one"})], described)
    after = space.get_artifact_images(torch.rand(space.start.shape))["texture"].numpy()
    assert own.shape == after.shape == (256, 320, 3)
    other = mesh.materials["other"]
    assert np.array_equal(seen(mesh, other, own, 4000), seen(mesh, other, after, 4000))
    changed = (own != after).any(axis=2)
    assert changed[:, 1:159].all() and not changed[:, 159:].any() and not changed[:, 0].any()


@pytest.mark.parametrize(
    ("controls", "message"),
    [
        ({"texture": {"materials": ["Bodypaint"]}}, "'Bodypaint'"),
        ({"texture": {"materials": []}}, "texture.materials"),
        ({"texture:roof": {}, "texture:plate": {}}, "two controls set object.base_color.*takes several materials"),
        ({"texture": {"materials": "plate", "resolution": 4}}, "% of the texels of plate too.*a higher resolution"),
    ],
)
def test_what_cannot_be_painted_is_refused(scene: advsearch.Scene, controls: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        scene.renderer(controls, resolution=16)


def test_print_terms_count_what_is_painted() -> None:
    """A fourth channel leaves pixels out, and the steps to and from them."""
    colors = torch.full((4, 5, 3), 0.5)
    colors[:2, 2] = 0.9
    colors[3] = torch.rand(5, 3)
    where = torch.zeros(4, 5, 1)
    where[:2, :3] = 1.0
    masked = torch.cat([colors, where], dim=-1)
    assert float(printable_distance(masked)) == pytest.approx(float(printable_distance(colors[:2, :3]))) == 0.0
    assert float(mean_variation(masked)) == pytest.approx(2 * 0.4 / 6)
    assert float(mean_variation(torch.cat([colors, torch.ones(4, 5, 1)], dim=-1))) == float(mean_variation(colors))
