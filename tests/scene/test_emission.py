"""Surfaces of glTF and material files that emit light: seen, lighting what is around them, and in what goes out."""

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
from advsearch.scene.assets import ObjectAsset
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import OBJECT, SceneDescription, load_description
from advsearch.scene.formation import ALL_OMISSIONS, compute_irradiance
from advsearch.scene.glb import encode_glb
from advsearch.scene.importing.objects import import_object
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import import_mitsuba
from advsearch.scene.mitsuba_backend.writing import write_scene
from advsearch.scene.parts import PointLamp
from advsearch.scene.transport.lights import BasisRenderer
from advsearch.scene.transport.matrix import LinearRenderer
from glb_files import change_material

pytestmark = pytest.mark.usefixtures("two_threads")

SIZE = 24
SEEN = {"camera.azimuth": 0.0, "camera.elevation": 0.0, "camera.fov": 20.0, "ground.size": 0.0}
UNIT = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
CORNERS = np.array([[-0.5, 0, 0], [0.5, 0, 0], [0.5, 1, 0], [-0.5, 1, 0.0]])
FACES = [[0, 1, 2], [0, 2, 3]]


def stripes() -> np.ndarray:
    """A picture whose upper half is red and whose lower left quarter is half as bright."""
    picture = np.zeros((16, 16, 3), np.uint8)
    picture[:8, :, 0] = 255
    picture[8:, :8] = 128
    return picture


def card(
    vertices: np.ndarray = CORNERS, uv: np.ndarray = UNIT, picture: np.ndarray | None = None, grey: float = 0.0
) -> trimesh.Trimesh:
    """A square, y up, that looks along +z; of one colour, with the texture of its emission if it is given one."""
    material = PBRMaterial(
        baseColorFactor=[grey, grey, grey, 1.0], roughnessFactor=1.0, metallicFactor=0.0,
        emissiveFactor=[1.0, 1.0, 1.0], emissiveTexture=None if picture is None else Image.fromarray(picture),
    )  # fmt: skip
    return trimesh.Trimesh(vertices, FACES, process=False, visual=TextureVisuals(uv=uv, material=material))


def written(folder: Path, made: Any, strength: float = 1.0, **entries: Any) -> Path:
    """A file of it whose first material emits light of some strength."""
    file = folder / "lamp.glb"
    extensions = {"KHR_materials_emissive_strength": {"emissiveStrength": strength}}
    file.write_bytes(change_material(made.export(file_type="glb"), extensions=extensions, **entries))
    return file


def radiance(file: Path | str, spp: int = 64) -> torch.Tensor:
    return MitsubaScene(load_description(str(file), "none", setting_values=SEEN), (SIZE, SIZE)).render_radiance(
        {}, 0, spp
    )


def test_a_surface_is_as_bright_as_its_file_says(tmp_path: Path) -> None:
    picture = radiance(written(tmp_path, card(), 4.0, emissiveFactor=[0.5, 0.25, 0.0]), 4)
    middle = picture[SIZE // 2, SIZE // 2]
    np.testing.assert_allclose(middle, [2.0, 1.0, 0.0], atol=1e-3)
    assert not picture[0].any()


def test_a_texture_is_where_it_belongs(tmp_path: Path) -> None:
    scene = load_description(str(written(tmp_path, card(picture=stripes()), 3.0)), "none", setting_values=SEEN)
    assert scene.notes == ()
    picture = MitsubaScene(scene, (SIZE, SIZE), max_depth=1).render_radiance({}, 0, 16)
    left, right, top, bottom = (SIZE // 2 + away for away in (-4, 4, -4, 4))
    half = 3.0 * float(srgb_to_linear(np.array([128 / 255], np.float32))[0])
    for row, column, wanted in ((top, left, [3, 0, 0]), (top, right, [3, 0, 0]), (bottom, left, [half] * 3)):
        np.testing.assert_allclose(picture[row, column], wanted, rtol=1e-3)
    assert not picture[bottom, right].any()


def room(picture: np.ndarray | None, uv: np.ndarray = UNIT, parts: int = 1) -> trimesh.Scene:
    """A grey wall as the object, lit by a square in front of it that looks at it; of so many parts."""
    wall = card(vertices=CORNERS * 2.0 - [0, 0.5, 0], grey=0.8)
    wall.visual.material.emissiveFactor = None
    back = CORNERS[[1, 0, 3, 2]] * 0.5 + [0.0, 0.25, 0.8]
    lamps = [card(vertices=back, uv=uv, picture=picture)]
    if parts == 2:
        dark = card(vertices=back + np.array([0, 0.6, 0]), uv=uv, grey=0.5)
        dark.visual.material.emissiveFactor = None
        lamps.append(dark)
    scene = trimesh.Scene()
    for number, one in enumerate([*lamps, wall]):
        scene.add_geometry(one, node_name=f"lamp{number}" if one is not wall else "wall")
    return scene


def both_ways(scene: SceneDescription, lamp: str, seen: str) -> tuple[torch.Tensor, torch.Tensor]:
    """The mean radiance (3,) of what is seen, with light that is sampled, and with light that is met by chance."""
    made = MitsubaScene(scene.with_part(PointLamp("dark")), (SIZE, SIZE), max_depth=3)
    shown = made.find_surfaces({}).visible_mask(seen)
    found = torch.stack([made.render_radiance({}, seed, 256)[shown] for seed in range(4)]).mean(dim=(0, 1))
    made.parameters[f"{lamp}.emitter.sampling_weight"] = 0.0
    made.parameters.update()
    made._recorded.clear()
    chance = torch.stack([made.render_radiance({}, seed, 4096)[shown] for seed in range(4)]).mean(dim=(0, 1))
    return found, chance


WAYS = {
    "one radiance": (None, UNIT),
    "a texture": (stripes(), UNIT),
    "mirrored": (stripes(), UNIT * [-1, 1] + [1, 0]),
    "repeated": (stripes(), UNIT * 2.0),
    "shared": (stripes(), np.array([[0, 0], [1, 0], [1, 1], [1, 0.0]])),
}


@pytest.mark.medium
@pytest.mark.parametrize("way", WAYS)
def test_light_arrives_as_by_paths_that_find_it_by_chance(way: str, tmp_path: Path) -> None:
    """Next-event estimation of a texture counts on coordinates that no two faces share."""
    picture, uv = WAYS[way]
    seen = {**SEEN, "camera.azimuth": 30.0, "camera.elevation": 20.0}
    scene = load_description(f"{written(tmp_path, room(picture, uv), 5.0)}#wall", "none", setting_values=seen)
    assert scene.meshes["lamp0"].emission is not None
    found, chance = both_ways(scene, "lamp0", OBJECT)
    assert float(found.mean()) > 0.01
    np.testing.assert_allclose(found, chance, rtol=0.02, atol=1e-4)


@pytest.mark.medium
def test_several_parts_are_lit_in_one_map(tmp_path: Path) -> None:
    """The dark parts of an object stay dark, and the light of the other one is all there."""
    seen = {**SEEN, "camera.azimuth": 30.0, "camera.elevation": 20.0}
    scene = load_description(str(written(tmp_path, room(None, parts=2), 5.0)), "none", setting_values=seen)
    emission = scene.object.emission
    assert emission is not None and emission.shape == scene.object.base_color.shape
    assert set(np.unique(emission.round(3))) == {0.0, 5.0} and emission.mean() < 1.0
    found, chance = both_ways(scene, OBJECT, OBJECT)
    assert float(found.mean()) > 0.05
    np.testing.assert_allclose(found, chance, rtol=0.02)


def in_a_material_file(folder: Path, *lines: str) -> ObjectAsset:
    Image.fromarray(stripes()).save(folder / "lit.png")
    corners = "v -1 0 0\nv 1 0 0\nv 1 2 0\nv -1 2 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (folder / "card.obj").write_text(f"mtllib card.mtl\n{corners}usemtl a\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    (folder / "card.mtl").write_text("\n".join(("newmtl a", "Kd 0.7 0.7 0.7", *lines)) + "\n")
    return import_object(folder / "card.obj", up="y")


@pytest.mark.parametrize(
    ("lines", "wanted"),
    [
        (("Ke 2 1 0",), [2.0, 1.0, 0.0]), (("Ke 3",), [3.0, 3.0, 3.0]),
        (("Ke 2 4 1", "map_Ke lit.png"), [2.0, 0.0, 0.0]), (("map_Ke lit.png",), [1.0, 0.0, 0.0]),
        (("Ke 0 0 0",), None),
    ],
)  # fmt: skip
def test_a_material_file_says_emission(lines: tuple[str, ...], wanted: list[float] | None, tmp_path: Path) -> None:
    asset = in_a_material_file(tmp_path, *lines)
    assert asset.warnings == () and (asset.emission is None) == (wanted is None)
    if asset.emission is not None and wanted is not None:
        np.testing.assert_allclose(asset.emission[0, 0], wanted, atol=1e-6)
        assert asset.emission.shape == ((16, 16, 3) if "map_Ke lit.png" in lines else (1, 1, 3))


@pytest.mark.medium
def test_a_moved_surface_lights_from_where_it_is(tmp_path: Path) -> None:
    """Whatever Mitsuba kept of the place where it was."""
    scene = load_description(f"{written(tmp_path, room(stripes()), 5.0)}#wall", "none", setting_values=SEEN)
    made = MitsubaScene(scene, (SIZE, SIZE), max_depth=2)
    made.render_radiance({}, 0, 64)
    places = made.get_base_value("lamp0.vertices") + torch.tensor([0.3, 0.5, 0.0])
    moved = made.render_radiance({"lamp0.vertices": places}, 1, 512)
    part = scene.surrounding_meshes["lamp0"]
    matrix = part.to_world.copy()
    matrix[:3, 3] += [0.3, 0.5, 0.0]
    fresh = MitsubaScene(replace(scene, parts=(replace(part, to_world=matrix),)), (SIZE, SIZE), max_depth=2)
    np.testing.assert_allclose(moved, fresh.render_radiance({}, 1, 512), atol=1e-3)
    again = MitsubaScene(scene, (SIZE, SIZE), max_depth=2, leave_out=ALL_OMISSIONS - {"tracing"}).render_radiance(
        {}, 2, 64
    )
    np.testing.assert_allclose(made.render_radiance({}, 2, 64), again, atol=1e-3)


@pytest.mark.medium
@pytest.mark.parametrize("picture", [None, stripes()])
def test_a_matrix_of_transport_has_it_once(picture: np.ndarray | None, tmp_path: Path) -> None:
    """Light that nobody moves is in the base picture, under each light that moves only one time."""
    file = written(tmp_path, card(picture=picture, grey=0.5), 0.5)
    loaded = advsearch.load_scene(file, settings={**SEEN, "ground.size": 3.0, "camera.elevation": 30.0})
    made = loaded.renderer({"texture": {"resolution": 8}, "light": {"power": [0, 6]}}, resolution=SIZE)
    u = (made.start + 0.1).clamp(0.0, 1.0)
    u[-1] = 0.7 if made.space.groups[-1].name == "light.power" else u[-1]
    with torch.no_grad():
        traced = torch.stack([made(u, seed=seed, spp=512) for seed in (1, 2)])
        noise = float((traced[0] - traced[1]).abs().mean())
        basis = BasisRenderer(made, made.start, seed=3)
        assert float((basis(u) - traced.mean(dim=0)).abs().mean()) < 2.0 * noise + 0.01
        assert float((traced.mean(dim=0) - made(made.start, seed=1, spp=512)).abs().mean()) > 0.02
        still = loaded.renderer({"texture": {"resolution": 8}}, resolution=SIZE)
        linear = LinearRenderer(still, still.start, seed=4)
        v = (still.start + 0.1).clamp(0.0, 1.0)
        assert float((linear(v) - still(v, seed=1, spp=512)).abs().mean()) < 0.01


def test_the_exposure_meter_sees_surroundings_that_emit_light(tmp_path: Path) -> None:
    """A square far away is metered as the lamp of its power, and one that faces away not at all."""
    far = CORNERS[[1, 0, 3, 2]] * 0.2 + [0.0, 0.4, 6.0]
    wall = card(grey=0.8)
    wall.visual.material.emissiveFactor = None
    for picture, mean in ((None, 1.0), (stripes(), None)):
        scene = trimesh.Scene()
        scene.add_geometry(card(vertices=far, picture=picture), node_name="lamp")
        scene.add_geometry(wall, node_name="wall")
        described = load_description(f"{written(tmp_path, scene, 50.0)}#wall", "none", setting_values=SEEN)
        part = described.surrounding_meshes["lamp"]
        assert part.emission is not None
        level = part.emission.mean(axis=(0, 1)) if mean is None else np.full(3, 50.0)
        lamp = PointLamp(
            "lamp", position=(6.0, 0.0, 0.5), intensity=(0.04 * level[0], 0.04 * level[1], 0.04 * level[2])
        )
        like = replace(described, parts=(lamp,))
        normals = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
        np.testing.assert_allclose(compute_irradiance(described, normals), compute_irradiance(like, normals), rtol=0.25)
        assert described.is_lit and described.gain == pytest.approx(like.gain, rel=0.25)


@pytest.mark.parametrize("picture", [None, stripes()])
def test_gltf_out_emits_the_same(picture: np.ndarray | None, tmp_path: Path) -> None:
    part = load_description(str(written(tmp_path, card(picture=picture), 7.0))).meshes[OBJECT]
    (tmp_path / "out.glb").write_bytes(encode_glb([pose_mesh(part, {})]))
    again = import_object(tmp_path / "out.glb")
    assert part.emission is not None and again.emission is not None and again.warnings == ()
    np.testing.assert_allclose(again.emission, part.emission, atol=0.05)


@pytest.mark.parametrize("picture", [None, stripes()])
def test_stock_mitsuba_renders_the_emission_that_is_written(picture: np.ndarray | None, tmp_path: Path) -> None:
    seen = {**SEEN, "camera.azimuth": 30.0}
    loaded = advsearch.load_scene(f"{written(tmp_path, room(picture), 5.0)}#wall", "none", settings=seen)
    renderer = loaded.renderer("pose", resolution=SIZE, denoise="none")
    (tmp_path / "out").mkdir()
    write_scene(renderer.scene, {}, tmp_path / "out" / "scene.xml", "")
    mi = import_mitsuba()
    theirs = torch.from_numpy(np.array(mi.render(mi.load_file(str(tmp_path / "out" / "scene.xml")), spp=256)))[..., :3]
    ours = renderer.scene.render_radiance({}, 0, 256)
    assert float(ours.mean()) > 0.01 and (theirs - ours).abs().mean() < 0.03 * ours.mean()


@pytest.mark.medium
@pytest.mark.parametrize("picture", [None, stripes()])
def test_the_adjoint_of_a_texture_is_right_beside_emission(picture: np.ndarray | None, tmp_path: Path) -> None:
    """Central differences of all texels, and of the radiance itself; the wall and the square light each other."""
    seen = {**SEEN, "camera.azimuth": 30.0}
    scene = load_description(f"{written(tmp_path, room(picture), 5.0)}#wall", "none", setting_values=seen)
    made = MitsubaScene(scene, (SIZE, SIZE), max_depth=4)
    ones = torch.ones(SIZE, SIZE, 3)
    for name, step in (("object.base_color", 0.05), ("lamp0.radiance", 0.5)):
        base = made.get_base_value(name)
        up, down = (made.render_radiance({name: base + way * (base > 0.0)}, 3, 1024).sum() for way in (step, -step))
        gradient = made.render_adjoint({name: base}, ones, 7, 1024)[name][base > 0.0]
        assert float(gradient.sum()) == pytest.approx(float(up - down) / (2.0 * step), rel=0.03)
