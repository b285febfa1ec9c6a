"""Scenes from glTF files: one node is the object, the rest stays in its place; lamps, cameras, names."""

from __future__ import annotations

import json
import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

import advsearch
from advsearch.cli.main import main
from advsearch.errors import FileFormatError, InputError, UnknownNameError
from advsearch.scene.description import load_description
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.importing.scenes import LUMENS, split_node
from advsearch.scene.mitsuba_backend.parts import translate_part
from advsearch.scene.mitsuba_backend.variant import import_mitsuba
from advsearch.scene.mitsuba_backend.writing import write_scene
from advsearch.scene.mitsuba_backend.xml_files import read_scene
from advsearch.scene.parts import PointLamp, SpotLamp

ROUND = {"roughnessFactor": 0.8, "metallicFactor": 0.0}


def box(extents: list[float], color: list[int]) -> Any:
    made = trimesh.creation.box(extents=extents)
    made.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[*color, 255], **ROUND))
    return made


def with_header(data: bytes, change: Any) -> bytes:
    """Return a .glb file with another header."""
    length = struct.unpack_from("<I", data, 12)[0]
    header, rest = json.loads(data[20 : 20 + length]), data[20 + length :]
    change(header)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


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
    return with_header(exported, five_nodes)


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
    assert scene.number("ground.size") == 0.0


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
    file.write_bytes(with_header(data, under))
    scene = load_description(f"{file}#crate")
    assert set(scene.meshes) == {"object", "floor"}
    assert float(np.ptp(scene.base_vertices, axis=0).max()) == pytest.approx(1.0)


def test_names_say_which_node(file: Path, data: bytes) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown node of room.glb 'crates'. Did you mean 'crate'"):
        load_description(f"{file}#crates")

    def twins(header: dict[str, Any]) -> None:
        for node in header["nodes"]:
            if node.get("name") == "floor":
                node["name"] = "crate"

    file.write_bytes(with_header(data, twins))
    with pytest.raises(
        InputError, match=r"2 nodes are called .*crate.*; say which: room.glb#node \d, room.glb#node \d"
    ):
        load_description(f"{file}#crate")
    number = next(int(word) for word in "0 1 2 3 4".split() if _is_crate(f"{file}#node {word}"))
    assert load_description(f"{file}#node {number}").object_name == f"{file}#node {number}"


def _is_crate(spec: str) -> bool:
    try:
        return "crate-2" in load_description(spec).meshes or "crate" in load_description(spec).meshes
    except UnknownNameError:
        return False


def test_what_is_not_carried_over_is_named(file: Path, data: bytes) -> None:
    def more(header: dict[str, Any]) -> None:
        glow = {"emissiveFactor": [1, 1, 1], "emissiveTexture": {"index": 0, "texCoord": 1}}
        header["materials"][0] |= {"normalTexture": {"index": 0}, **glow}
        header["textures"] = header.get("textures") or [{"source": 0}]
        header["images"] = header.get("images") or [{"uri": "none.png"}]
        header["extensions"]["KHR_lights_punctual"]["lights"][0] |= {"type": "directional", "range": 3.0}
        header["cameras"].append({"type": "orthographic"})

    file.write_bytes(with_header(data, more))
    notes = " ".join(load_description(f"{file}#crate").notes)
    for words in (
        "1 emission texture with other coordinates than the base colour: left out, with the emission",
        "room.glb: 1 directional light, here as lamps 1000 object sizes away",
        "room.glb: 1 light with a range, which is left out: light reaches beyond it",
        "room.glb: 1 camera without perspective: left out",
    ):
        assert words in notes


def shone(header: dict[str, Any], cone: dict[str, float], rotation: list[float]) -> None:
    """Make a spot of the lamp."""
    header["extensions"]["KHR_lights_punctual"]["lights"][0] |= {"type": "spot", "spot": cone}
    header["nodes"][-2]["rotation"] = rotation


DOWN = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""Turns -z, along which lights shine, to -y."""


def test_a_spot_shines_in_its_cone(file: Path, data: bytes) -> None:
    cone = {"innerConeAngle": math.radians(10.0), "outerConeAngle": math.radians(30.0)}
    file.write_bytes(with_header(data, lambda header: shone(header, cone, DOWN)))
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


@pytest.mark.parametrize(
    "cone",
    [
        {},
        {"outerConeAngle": math.pi / 2},
        {"innerConeAngle": 1.0, "outerConeAngle": 1.0},
        {"innerConeAngle": 1e30, "outerConeAngle": 1e-30},
    ],
)
def test_a_spot_of_any_cone_is_rendered(cone: dict[str, float], file: Path, data: bytes) -> None:
    file.write_bytes(with_header(data, lambda header: shone(header, cone, DOWN)))
    seen = advsearch.render(advsearch.load_scene(f"{file}#crate"), resolution=16, spp=4, denoise="none")
    assert np.isfinite(np.asarray(seen.views[0].picture)).all()


@pytest.mark.parametrize("cone", [{"outerConeAngle": 0.0}, {"outerConeAngle": 2.0}, {"innerConeAngle": -0.1}])
def test_a_spot_whose_cone_is_none_is_refused(cone: dict[str, float], file: Path, data: bytes) -> None:
    file.write_bytes(with_header(data, lambda header: shone(header, cone, DOWN)))
    with pytest.raises(FileFormatError, match=r"expected glTF whose .*ConeAngle is (greater|less) than"):
        load_description(f"{file}#crate")


@pytest.mark.parametrize("spec", ["room.obj#crate", "crate#a.png", "room.glb"])
def test_only_gltf_files_have_nodes(spec: str) -> None:
    assert split_node(spec) == (spec, None)
    assert split_node("a/room.GLB#the wall") == ("a/room.GLB", "the wall")


def test_wrong_numbers_of_lights_and_cameras_are_damage(file: Path, data: bytes) -> None:
    for entry in ({"camera": 7}, {"extensions": {"KHR_lights_punctual": {"light": 3}}}):
        file.write_bytes(with_header(data, lambda header, entry=entry: add(header, entry)))
        with pytest.raises(FileFormatError, match=r"expected glTF with \d (cameras|lights), as it refers to"):
            load_description(f"{file}#crate")


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


@pytest.mark.medium
def test_a_camera_of_the_file_is_chosen_by_name(file: Path, tmp_path: Path) -> None:
    seen: list[bytes] = []
    for more in ([], ["--camera", "orbit"], ["--camera", "front"]):
        out = tmp_path / f"{len(seen)}.png"
        small = ["--resolution", "16", "--spp", "1", "--denoise", "none", "--out", str(out)]
        assert main(["render", "--object", f"{file}#crate", *small, *more]) == 0
        seen.append(out.read_bytes())
    assert seen[0] == seen[1] != seen[2]


@pytest.mark.medium
def test_a_scene_seen_by_a_camera_of_its_file_is_kept_by_its_name(file: Path, tmp_path: Path) -> None:
    scene = advsearch.load_scene(f"{file}#crate", camera="front")
    small: Any = {"resolution": 16, "spp": 1, "trials": 6, "label": "ball"}
    assert advsearch.sweep(scene, grid={"pose.yaw": [0, 90]}, run=tmp_path / "run", **small)
    assert "camera: front" in (tmp_path / "run" / "run.yaml").read_text()


@pytest.mark.medium
def test_a_camera_that_is_none_or_says_otherwise_is_refused(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["sweep", "--object", f"{file}#crate", "--grid", "pose.yaw=0,90", "--label", "ball", "--camera"]
    for more, words in {
        ("fronts",): "unknown camera 'fronts'. Did you mean 'front'? Known: dashcam, equirectangular, fisheye, front, "
        "orbit, robot.",
        ("front", "--set", "camera.azimuth=9"): "--camera front and --set camera.azimuth contradict each other",
        ("front", "--control", "camera", "--samples", "2"): "--control camera: moves along an orbit",
    }.items():
        assert main([*asked, *more]) == 2
        assert words in capsys.readouterr().err


def test_import_says_what_was_understood(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", str(file), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in told["nodes"]] == ["floor", "the wall", "crate"]
    assert [one["mesh"] for one in told["nodes"]] == ["floor", "the-wall", "crate"]
    assert [one["triangles"] for one in told["nodes"]] == [12, 12, 12]
    assert (told["lights"], told["cameras"]) == (["bulb"], ["front"])
    assert main(["import", str(file)]) == 0
    said = capsys.readouterr().out
    assert f"{file}#crate" in said and "pose:floor" in said and "--camera NAME): front" in said


@pytest.mark.parametrize(
    ("node", "change", "words"),
    [
        (-2, {"translation": [0.0, 1e300, 0.0]}, "expected the light bulb within 1e+12 object sizes"),
        (-1, {"translation": [1e300, 0.0, 0.0]}, "expected the camera front within 1e+12 object sizes"),
        (-1, {"scale": [0.0, 0.0, 0.0]}, "expected the camera front to look somewhere, got axes without length"),
    ],
)
def test_a_light_or_camera_out_of_reach_is_refused(
    node: int, change: dict[str, Any], words: str, file: Path, data: bytes
) -> None:
    file.write_bytes(with_header(data, lambda header: header["nodes"][node].update(change)))
    with pytest.raises(InputError, match=re.escape(words)):
        load_description(f"{file}#crate")


def test_a_light_that_is_too_bright_or_takes_light_away_is_refused(file: Path, data: bytes) -> None:
    def lit(header: dict[str, Any], **change: Any) -> None:
        header["extensions"]["KHR_lights_punctual"]["lights"][0] |= change

    for kind in ("point", "directional"):
        file.write_bytes(with_header(data, lambda header, kind=kind: lit(header, type=kind, intensity=1e306)))
        with pytest.raises(InputError, match=r"expected the light bulb within .* and no brighter than that, got more"):
            load_description(f"{file}#crate")
    file.write_bytes(with_header(data, lambda header: lit(header, color=[1.0, -1.0, 0.0])))
    with pytest.raises(FileFormatError, match=r"color\[1\] is greater than or equal to 0"):
        load_description(f"{file}#crate")


@pytest.mark.parametrize("angle", [3.1, 3.1415])
def test_a_camera_that_sees_all_is_refused(angle: float, file: Path, data: bytes) -> None:
    file.write_bytes(with_header(data, lambda header: header["cameras"][0]["perspective"].update(yfov=angle)))
    with pytest.raises(InputError, match="expected the camera front with a field of view up to 170 degrees, got 1"):
        load_description(f"{file}#crate")


def test_a_scene_without_an_object_is_answered_with_what_is_in_it(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    box = tmp_path / "box.xml"
    box.write_text('<scene version="3.0.0"><shape type="cube" id="large-box"/><shape type="sphere" id="ball"/></scene>')
    for command in (["attack", "--label", "ball"], ["render", "--out", str(tmp_path / "a.png")]):
        for scene, names in ((file, "floor, the wall, crate"), (box, "large-box, ball")):
            assert main([*command, "--scene", str(scene)]) == 2
            expected = f"--object: expected something in {scene}, got nothing; name one of {names}"
            assert expected in capsys.readouterr().err


def test_a_scene_with_nothing_for_an_object_and_none_at_all_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty.xml"
    empty.write_text('<scene version="3.0.0"><emitter type="point"/></scene>')
    assert main(["attack", "--scene", str(empty)]) == 2
    assert f"--scene: {empty} has nothing that can be the object" in capsys.readouterr().err
    assert main(["attack", "--scene", str(tmp_path / "none.glb")]) == 2
    assert "none.glb: no such scene file" in capsys.readouterr().err


def test_import_names_every_ending(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "room.json").write_text("{}")
    assert main(["import", str(tmp_path / "room.json")]) == 2
    endings = ".obj, .ply, .stl, .gltf, .glb, .vrm, .blend, .usd, .usda, .usdc, .usdz or .xml"
    assert f"expected an object file ending in {endings}, got '.json'; convert it" in capsys.readouterr().err
    assert main(["render", "--object", "bottl", "--out", str(tmp_path / "a.png")]) == 2
    assert "A path to a file that ends in .obj, .ply, .stl, .gltf, .glb, " in capsys.readouterr().err


def test_a_spot_goes_out_as_mitsubas(file: Path, data: bytes, tmp_path: Path) -> None:
    file.write_bytes(with_header(data, lambda header: shone(header, {"outerConeAngle": 0.5}, DOWN)))
    renderer = advsearch.load_scene(f"{file}#crate").renderer("pose", resolution=16)
    write_scene(renderer.scene, {}, tmp_path / "scene.xml", "")
    lamp = read_scene(tmp_path / "scene.xml")["bulb"]
    assert isinstance(lamp, dict)
    assert lamp["type"] == "spot" and lamp["cutoff_angle"] == pytest.approx(math.degrees(0.5))
    assert lamp["intensity"]["value"] == pytest.approx([0.25, 0.125, 0.0])
