"""Scenes from glTF files: one node is the object, the rest stays in its place; lamps, cameras, names."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from advsearch.cli.main import main
from advsearch.errors import InputError
from advsearch.scene.description import load_description
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.importing.scenes import LUMENS
from advsearch.scene.mitsuba_backend.parts import translate_part
from advsearch.scene.mitsuba_backend.variant import import_mitsuba
from advsearch.scene.parts import PointLamp, SpotLamp
from glb_files import change_header

ROUND = {"roughnessFactor": 0.8, "metallicFactor": 0.0}


def box(extents: list[float], color: list[int]) -> Any:
    made = trimesh.creation.box(extents=extents)
    made.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[*color, 255], **ROUND))
    return made


def add(header: dict[str, Any], node: dict[str, Any]) -> None:
    header["nodes"].append(node)
    header["scenes"][header.get("scene", 0)]["nodes"].append(len(header["nodes"]) - 1)


def five_nodes(header: dict[str, Any]) -> None:
    """Add a lamp and a camera to the floor, the wall and the crate."""
    lights = [{"type": "point", "intensity": 683.0, "color": [1.0, 0.5, 0.0], "name": "bulb"}]
    header["extensions"] = {"KHR_lights_punctual": {"lights": lights}}
    header["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.8, "aspectRatio": 2.0}, "name": "front"}]
    add(header, {"translation": [0.0, 5.0, 0.0], "extensions": {"KHR_lights_punctual": {"light": 0}}})
    add(header, {"translation": [1.0, 1.0, 8.0], "camera": 0})


@pytest.fixture(scope="module")
def data() -> bytes:
    scene = trimesh.Scene()
    place = trimesh.transformations.translation_matrix
    scene.add_geometry(box([10.0, 0.2, 10.0], [180, 180, 180]), "floor", "floor", transform=place([0.0, -0.1, 0.0]))
    scene.add_geometry(box([10.0, 6.0, 0.2], [150, 80, 50]), "the wall", "wall", transform=place([0.0, 3.0, -5.0]))
    scene.add_geometry(box([2.0, 2.0, 2.0], [200, 180, 30]), "crate", "crate", transform=place([1.0, 1.0, 0.0]))
    exported: bytes = scene.export(file_type="glb")
    return change_header(exported, five_nodes)


@pytest.fixture
def file(data: bytes, tmp_path: Path) -> Path:
    (tmp_path / "room.glb").write_bytes(data)
    return tmp_path / "room.glb"


def test_a_node_is_the_object_and_the_rest_stays_in_its_place_around_it(file: Path) -> None:
    scene = load_description(f"{file}#crate")
    assert set(scene.meshes) == {"object", "floor", "the-wall"}
    assert np.ptp(scene.base_vertices, axis=0) == pytest.approx([1.0, 1.0, 1.0])
    wall = scene.meshes["the-wall"]
    corners = wall.mesh.vertices @ wall.to_world[:3, :3].T + wall.to_world[:3, 3]
    # in the file x -5 to 5, height 0 to 6, z -5.1 to -4.9, which is our x; the crate of side 2 stands at (1, 0, 0)
    assert corners.min(axis=0) == pytest.approx([-2.55, -3.0, 0.0], abs=1e-5)
    assert corners.max(axis=0) == pytest.approx([-2.45, 2.0, 3.0], abs=1e-5)
    assert scene.get_number("ground.size") == 0.0


def test_a_lamp_lights_as_in_the_file_and_takes_the_place_of_a_map(file: Path) -> None:
    scene = load_description(f"{file}#crate")
    assert scene.environment is None
    lamp = scene.lamps["bulb"]
    assert isinstance(lamp, PointLamp)
    assert lamp.position == pytest.approx((0.0, -0.5, 2.5))
    _, here = lamp.compute_lighting(np.array([0.0, -0.5, 0.0]))
    candela = np.array([1.0, 0.5, 0.0]) * 683.0
    assert here == pytest.approx(candela / LUMENS / 5.0**2)  # five metres below it
    assert load_description(f"{file}#crate", "kitchen").environment_name == "kitchen"


def test_a_camera_of_the_file_sees_the_object_where_it_is(file: Path) -> None:
    scene = load_description(f"{file}#crate")
    camera = scene.cameras["front"]
    assert camera.fov == pytest.approx(math.degrees(2 * math.atan(2 * math.tan(0.4))))
    pose = camera_to_world(scene.with_camera("front"))
    seen = np.linalg.inv(pose) @ np.array([0.0, 0.0, 0.5, 1.0])
    assert seen[:3] == pytest.approx([0.0, 0.0, 4.0], abs=1e-6)  # eight metres ahead, in the middle
    right = np.linalg.inv(pose) @ np.array([0.0, 0.5, 0.5, 1.0])
    assert right[0] < 0.0  # x of a camera is to the left


def test_an_object_brings_what_hangs_on_it(data: bytes, tmp_path: Path) -> None:
    def under(header: dict[str, Any]) -> None:
        nodes = header["nodes"]
        number = {node.get("name"): index for index, node in enumerate(nodes)}
        nodes[number["crate"]]["children"] = [number["the wall"]]
        for one in (header["scenes"][0]["nodes"], *(node.get("children", []) for node in nodes)):
            if number["the wall"] in one and one is not nodes[number["crate"]]["children"]:
                one.remove(number["the wall"])

    file = tmp_path / "room.glb"
    file.write_bytes(change_header(data, under))
    scene = load_description(f"{file}#crate")
    assert set(scene.meshes) == {"object", "floor"}
    assert float(np.ptp(scene.base_vertices, axis=0).max()) == pytest.approx(1.0)


def shone(header: dict[str, Any], cone: dict[str, float], rotation: list[float]) -> None:
    """Make a spot of the lamp."""
    header["extensions"]["KHR_lights_punctual"]["lights"][0] |= {"type": "spot", "spot": cone}
    header["nodes"][-2]["rotation"] = rotation


DOWN = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""Turns -z, along which lights shine, to -y."""


def test_a_spot_shines_in_its_cone(file: Path, data: bytes) -> None:
    cone = {"innerConeAngle": math.radians(10.0), "outerConeAngle": math.radians(30.0)}
    file.write_bytes(change_header(data, lambda header: shone(header, cone, DOWN)))
    scene = load_description(f"{file}#crate")
    assert scene.environment is None and not any("spot" in note for note in scene.notes)
    lamp = scene.lamps["bulb"]
    assert isinstance(lamp, SpotLamp)
    assert lamp.direction == pytest.approx((0.0, 0.0, -1.0), abs=1e-9)
    assert lamp.position == pytest.approx((0.0, -0.5, 2.5))
    candela = np.array([1.0, 0.5, 0.0]) * 683.0
    for angle, share in ((0.0, 1.0), (9.0, 1.0), (20.0, 0.5), (31.0, 0.0)):
        out = 2.5 * math.tan(math.radians(angle))
        _, here = lamp.compute_lighting(np.array([0.0, out - 0.5, 0.0]))
        metres = 5.0 / math.cos(math.radians(angle))
        assert here == pytest.approx(share * candela / LUMENS / metres**2 * 4.0 / 2.0**2, abs=1e-9)


def test_a_spot_lights_in_mitsuba_as_it_is_metered() -> None:
    lamp = SpotLamp("lamp", position=(0.0, 0.0, 2.0), direction=(0.6, 0.0, -0.8), intensity=(3.0, 2.0, 1.0), beam=10.0)
    mi = import_mitsuba()
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(10)}
    scene = mi.load_dict({"type": "scene", "floor": floor, **translate_part(lamp).plugins})
    for x in (-1.0, 0.0, 0.5, 1.5, 3.0, 5.0):
        seen = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0.3, 1.0), mi.Vector3f(0.0, 0.0, -1.0)))
        _, weight = scene.sample_emitter_direction(seen, mi.Point2f(0.5, 0.5))
        assert np.array(weight).ravel() == pytest.approx(lamp.compute_lighting(np.array([x, 0.3, 0.0]))[1], rel=1e-4)


@pytest.mark.medium
def test_an_attack_on_a_node_is_verified_and_goes_on_from_its_file(file: Path, tmp_path: Path) -> None:
    small = ["--resolution", "16", "--spp", "1", "--steps", "2", "--trials", "6", "--label", "ball", "--json"]
    run, fixed = tmp_path / "run", ["--set", "pose:the-wall.z=0.5", "--set", "material:the-wall.roughness=0.3"]
    assert main(["attack", "--object", f"{file}#crate", "--control", "pose,pose:the-wall,texture:floor", *small, *fixed,
                 "--run", str(run)]) == 0  # fmt: skip
    summary = json.loads((run / "summary.json").read_text())
    assert summary["object"] == f"{file}#crate" and summary["environment"] == "none"  # lit by its own lamp
    assert {"pose.yaw", "pose:the-wall.yaw", "texture:floor.linf"} <= set(summary["configuration"])
    assert (run / "artifacts" / "texture@floor.png").is_file()
    assert "artifacts/texture@floor.png" in (run / "report.html").read_text()
    assert (
        main(["sweep", "--object", f"{file}#crate", "--grid", "pose:floor.yaw=0,90", *small[:4], "--label", "ball"])
        == 0
    )


@pytest.mark.parametrize(
    ("node", "change", "words"),
    [
        (-2, {"translation": [0.0, 1e300, 0.0]}, "the light bulb"),
        (-1, {"translation": [1e300, 0.0, 0.0]}, "the camera front"),
        (-1, {"scale": [0.0, 0.0, 0.0]}, "the camera front"),
    ],
)
def test_a_light_or_camera_out_of_reach_is_refused(
    node: int, change: dict[str, Any], words: str, file: Path, data: bytes
) -> None:
    file.write_bytes(change_header(data, lambda header: header["nodes"][node].update(change)))
    with pytest.raises(InputError, match=words):
        load_description(f"{file}#crate")


def test_a_scene_without_an_object_is_answered_with_what_is_in_it(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    box = tmp_path / "box.xml"
    box.write_text('<scene version="3.0.0"><shape type="cube" id="large-box"/><shape type="sphere" id="ball"/></scene>')
    for command in (["attack", "--label", "ball"], ["render", "--out", str(tmp_path / "a.png")]):
        for scene, names in ((file, "floor, the wall, crate"), (box, "large-box, ball")):
            assert main([*command, "--scene", str(scene)]) == 2
            said = capsys.readouterr().err
            assert "--object" in said and names in said
