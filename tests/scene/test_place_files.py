"""Places of one's own: a glTF file and a YAML file beside it, as the environment of any scene."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from advsearch.cli.main import main
from advsearch.errors import FileFormatError, InputError
from advsearch.runs.summary import compute_file_digests
from advsearch.scene.assets import Material, Mesh, Shape
from advsearch.scene.description import load_description
from advsearch.scene.geometry import compute_base_vertices
from advsearch.scene.glb import encode_glb
from advsearch.scene.grounds import LUMINANCE, has_lanes, is_enclosed, is_paved
from advsearch.scene.library import import_environment, load_environment
from advsearch.scene.photographed_ground import compute_open_sky_irradiance
from advsearch.scene.places import place_meshes
from advsearch.scene.places.place_file import load_bundled_place, read_place_file
from glb_files import change_header
from scenes.files import exr
from scenes.places import PLACES
from scenes.places.models import Look, Node, PlaceModel, Primitive
from scenes.places.models import glb as write_glb

pytestmark = pytest.mark.usefixtures("two_threads")

BUNDLED = Path(__file__).resolve().parents[2] / "advsearch/bundled/data/places"
FILE = {
    "mesh": "street.glb",
    "ground": ["road"],
    "lane_width": 3.0,
    "lamps": {"lamp": [1000.0, 800.0, 500.0]},
    "lights": {"day": {"map": "sky.exr", "lux": 20000.0}, "night": {"map": "sky.exr", "lux": 0.5}},
    "solids": [
        {"name": "a house", "outline": [[-10, 5], [10, 5], [10, 9], [-10, 9]], "heights": [0, 6]},
        {"name": "a post", "at": [[4, -4]], "radius": 0.2, "heights": [0, 3]},
    ],
    "valid": {"x": [-30, 30]},
}


def box(name: str, low: tuple[float, float, float], high: tuple[float, float, float], color: float) -> Shape:
    """Return a box whose faces look outwards, each with vertices of its own."""
    corners, faces, normals = list[list[float]](), list[list[int]](), list[list[float]]()
    bounds = np.array([low, high])
    for axis in range(3):
        for side in (0, 1):
            across = [(axis + 1) % 3, (axis + 2) % 3]
            square = [(0, 0), (1, 0), (1, 1), (0, 1)]
            for a, b in square if side else square[::-1]:
                corner = [0.0, 0.0, 0.0]
                corner[axis], corner[across[0]], corner[across[1]] = (
                    bounds[side, axis],
                    bounds[a, across[0]],
                    bounds[b, across[1]],
                )
                corners.append(corner)
                normals.append((np.eye(3)[axis] * (2 * side - 1)).tolist())
            first = len(corners) - 4
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    uvs = np.tile(np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32), (6, 1))
    mesh = Mesh(
        np.array(corners, np.float32), np.array(faces, np.uint32), np.array(normals, np.float32), uvs.astype(np.float32)
    )
    return Shape(name, mesh, np.full((2, 2, 3), color, np.float32), Material(roughness=0.9, specular=0.25))


@pytest.fixture
def street(tmp_path: Path) -> Path:
    """A road with a house on its left and a lamp over it, under a grey sky."""
    folder = tmp_path / "my-street"
    folder.mkdir()
    shapes = [
        box("road", (-40, -8, -0.5), (40, 8, 0), 0.3),
        box("house", (-10, 5, 0), (10, 9, 6), 0.6),
        box("lamp", (3.8, -4.2, 3), (4.2, -3.8, 3.1), 0.8),
    ]
    (folder / "street.glb").write_bytes(encode_glb(shapes))
    sky = np.full((16, 32, 3), 0.8, np.float32)
    sky[8:] = 0.2
    (folder / "sky.exr").write_bytes(exr(sky))
    write(folder / "place.yaml")
    return folder / "place.yaml"


def write(path: Path, **changes: object) -> Path:
    content = {name: value for name, value in {**FILE, **changes}.items() if value is not None}
    path.write_text(yaml.safe_dump(content), "utf-8")
    return path


def test_a_street_of_ones_own_stands_around_the_object_to_scale(street: Path) -> None:
    scene = load_description("car", street)
    assert {"road", "house", "lamp"} == {name for name, part in scene.surrounding_meshes.items() if part.is_laid_ground}
    assert is_paved(scene) and is_enclosed(scene) and has_lanes(scene)
    house = compute_base_vertices(scene.surrounding_meshes["house"]) * scene.size_in_metres
    np.testing.assert_allclose([house.min(axis=0), house.max(axis=0)], [[-10, 5, 0], [10, 9, 6]], atol=1e-4)
    assert scene.surrounding_meshes["road"].material.specular == pytest.approx(0.25)
    assert scene.environment is not None and scene.environment.name == "my-street"
    assert scene.notes == (), scene.notes
    assert not is_paved(load_description("car", street, setting_values={"ground.kind": "table"}))
    assert not load_description("car", street, setting_values={"ground.size": 0.0}).surrounding_meshes
    assert not has_lanes(load_description("car", write(street, lane_width=None)))


def test_the_light_of_a_place_has_a_unit_and_its_lamps_shine_by_night(street: Path) -> None:
    day, night = load_description("car", street), load_description("car", f"{street}#night")
    lit = import_environment(street.parent / "sky.exr")
    level = float(compute_open_sky_irradiance(torch.from_numpy(lit.radiance.copy())) @ torch.tensor(LUMINANCE))
    assert day.environment is not None and night.environment is not None
    assert day.environment.candelas == pytest.approx(20000.0 / level)
    assert day.surrounding_meshes["lamp"].emission is None
    shown = night.surrounding_meshes["lamp"].emission
    assert shown is not None and night.environment.candelas is not None
    np.testing.assert_allclose(shown[0, 0] * night.environment.candelas, [1000.0, 800.0, 500.0], rtol=1e-5)
    assert night.environment.name == "my-street-night"
    without = write(street, lights={"day": {"map": "noon"}})
    plain = load_description("car", without).environment
    assert plain is not None and plain.candelas is None
    assert np.array_equal(plain.radiance, load_environment("noon").radiance)


def test_a_command_renders_in_it_and_its_files_belong_to_the_run(
    street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    command = "render --object car --environment my-street/place.yaml#night --out street.png --resolution 24 --spp 2"
    assert main([*command.split(), "--quiet"]) == 0
    assert (tmp_path / "street.png").is_file()
    digests = compute_file_digests({"environment": "my-street/place.yaml#night"})
    assert {Path(path).name for path in digests} == {"place.yaml", "street.glb", "sky.exr"}


WRONG: list[dict[str, object]] = [
    {"mesh": None},
    {"colour": "red"},
    {"ground": ["raod"]},
    {"lamps": {"lamp": [1.0, -1.0, 0.0]}},
    {"lights": {"day": {"map": "day.exr"}}},
    {"lights": {"day": {"map": "../sky.exr"}}},
    {"lights": {"day": {"map": "sky.exr", "variant": "wet"}}},
    {"mesh": "../street.glb"},
    {"mesh": "/etc/passwd"},
    {"mesh": "link.glb"},
    {"mesh": "pipe.glb"},
    {"mesh": "street.obj"},
    {"valid": {"x": [30, -30]}},
    {"picture": {"height": 1.5, "x": [2, 9], "y": [-9, 9]}},
    {"lane_width": float("inf")},
    {"solids": [{"name": "a wall", "heights": [0, 1]}]},
    {"solids": [{"name": "a wall", "at": [[0, 0]], "radius": 1, "heights": [2, 1]}]},
    {"lane_width": True},
    {"solids": [{"name": "a\nwall", "outline": [[0, 0], [1, 0], [1, 1]], "heights": [0, 1]}]},
    {"solids": [{"name": "a wall", "outline": [[0, 0], [4, 0], [4, 4], [2, 1], [0, 4]], "heights": [0, 1]}]},
]  # fmt: skip


@pytest.mark.parametrize("changes", WRONG)
def test_a_file_that_says_something_else_is_refused(street: Path, changes: dict[str, object]) -> None:
    outside = street.parent.parent / "other.glb"
    outside.write_bytes((street.parent / "street.glb").read_bytes())
    (street.parent / "link.glb").symlink_to(outside)
    os.mkfifo(street.parent / "pipe.glb")
    write(street, **changes)
    with pytest.raises(InputError):
        load_description("car", street)


@pytest.mark.parametrize("text", ["", "mesh: [", "mesh: !!python/object/apply:os.system [ls]", "a: " + "b" * (1 << 17)])
def test_text_that_is_no_place_is_refused(street: Path, text: str) -> None:
    street.write_text(text, "utf-8")
    with pytest.raises(FileFormatError, match=r"place\.yaml"):
        load_description("car", street)


@pytest.mark.parametrize("name", sorted(PLACES))
def test_a_bundled_place_opens_as_one_of_ones_own(name: str) -> None:
    path = BUNDLED / name / "place.yaml"
    own = load_bundled_place(name)
    assert own.notes == () and read_place_file(path) == own.file
    scene = load_description("car" if name != "room" else "mug", path)
    assert [part.name for part in own.parts] == list(scene.surrounding_meshes)
    environment = scene.environment
    assert environment is not None
    if name == "road":  # whose maps have no unit
        assert environment.candelas is None
        return
    bundled = load_environment(name)
    few_rows = name == "room"  # whose map has four: each quadrature has its own light
    assert environment.candelas == pytest.approx(bundled.candelas, rel=0.15 if few_rows else 0.02)


def test_a_variant_keeps_the_name_of_what_it_changes_as_a_whole(street: Path) -> None:
    """A wet road is still the road; snow on a part of a house is a mesh of its own."""
    road, house = box("road", (-40, -8, -0.5), (40, 8, 0), 0.3).mesh, box("house", (-10, 5, 0), (10, 9, 6), 0.6).mesh
    walls, roof = (replace(house, faces=house.faces[part]) for part in (slice(0, 10), slice(10, 12)))
    grey, white = np.full(3, 0.4, np.float32), np.full(3, 0.9, np.float32)
    dull = Material(roughness=0.9)
    looks = {
        "road": Look(grey, dull),
        "wet-road": Look(grey, Material(roughness=0.1, specular=0.6, clearcoat=0.5)),
        "house": Look(grey, dull),
        "snow": Look(white, dull),
    }
    nodes = [
        Node([Primitive(road, "road", {"wet": "wet-road"})]),
        Node([Primitive(walls, "house"), Primitive(roof, "house", {"snow": "snow"})]),
    ]
    (street.parent / "street.glb").write_bytes(write_glb(PlaceModel(looks, nodes, {})))
    lights = {name: {"map": "sky.exr", "variant": name} for name in ("wet", "snow")}
    write(street, lamps={}, lights={"dry": {"map": "sky.exr"}, **lights})
    dry, wet, snow = (
        load_description("car", f"{street}#{light}").surrounding_meshes for light in ("dry", "wet", "snow")
    )
    assert set(dry) == set(wet) == {"road", "house"} and set(snow) == {"road", "house", "snow"}
    assert wet["road"].material == Material(roughness=0.1, specular=0.6, clearcoat=0.5)
    assert dry["road"].material == dull
    assert len(dry["house"].mesh.faces) == 12 == len(snow["house"].mesh.faces) + len(snow["snow"].mesh.faces)
    assert (snow["snow"].mesh.normals[:, 2] == 1.0).all() and snow["snow"].base_color.max() > 0.89


def paint_road(street: Path, materials: int, factor: float, nearest: bool = False) -> None:
    """Give the road as many materials that share one picture of 8 x 8, each with a piece of its own."""
    road = box("road", (-40, -8, -0.5), (40, 8, 0), 0.3).mesh
    looks = {f"look {number}": Look(np.full((8, 8, 3), 0.5, np.float32), Material()) for number in range(materials)}
    looks = {"road": looks["look 0"], **looks}
    file = PlaceModel(looks, [Node([Primitive(road, name)]) for name in looks], {})
    mesh = street.parent / "street.glb"
    mesh.write_bytes(write_glb(file))

    def share(header: dict[str, Any]) -> None:
        for material in header["materials"]:
            surface = material["pbrMetallicRoughness"]
            surface["baseColorTexture"]["index"] = 0
            surface["baseColorFactor"] = [factor, factor, factor, 1.0]
        header["samplers"][0]["magFilter"] = 9728 if nearest else 9729

    mesh.write_bytes(change_header(mesh.read_bytes(), share))
    write(street, lamps={})


def test_a_picture_that_many_materials_share_is_counted_for_each(street: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture of few bytes must not become gigabytes of textures, each with a color of its own."""
    monkeypatch.setattr(place_meshes, "MAX_TEXELS", 1000)
    paint_road(street, 10, 0.5)
    assert len(load_description("car", street).surrounding_meshes) == 11
    paint_road(street, 20, 0.5)
    with pytest.raises(FileFormatError, match=r"street\.glb"):
        load_description("car", street)
    paint_road(street, place_meshes.MAX_MESHES, 0.5)
    with pytest.raises(InputError, match="200 materials"):
        load_description("car", street)
