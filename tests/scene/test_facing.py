"""Which way a file faces: by its format, by `facing`, never by its name; and on which side of it a dashcam is."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from test_gltf import File

from advsearch.engine.loading import load_scene
from advsearch.scene import library
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.glb import encode_glb
from advsearch.scene.importing.objects import import_object
from advsearch.scene.importing.scenes import import_scene
from advsearch.scene.parts import MeshPart
from glb_files import split_glb

AXES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
LONG, WIDE, HIGH = 4.2, 1.8, 1.4  # metres of the car of boxes


def box_car(front: str, up: str = "+y") -> trimesh.Trimesh:
    """A car of two boxes whose front and top lie along two axes: a mast stands on its left, near its front."""
    ahead, above = np.array(AXES[front], float), np.array(AXES[up], float)
    axes = np.stack([ahead, np.cross(above, ahead), above], axis=1)
    body, mast = trimesh.creation.box((LONG, WIDE, HIGH)), trimesh.creation.box((0.2, 0.2, 0.4))
    mast.apply_translation([1.8, 0.7, 0.9])
    car = trimesh.util.concatenate([body, mast])
    car.vertices = car.vertices @ axes.T
    return car


def write_car(path: Path, front: str, up: str = "+y", extension: str | None = None) -> Path:
    car = box_car(front, up)
    if path.suffix not in (".glb", ".vrm"):
        car.export(path)
        return path
    file = File()
    file.primitive(np.asarray(car.vertices), np.asarray(car.faces).reshape(-1))
    if extension is not None:
        file.header["extensions"] = {extension: {}}
    path.write_bytes(file.write(path.parent).read_bytes())
    return path


def mast_of(path: Path, **settings: Any) -> tuple[int, int]:
    """On which side the mast is: ahead (1) or behind (-1); to the left (1) or the right (-1); (0, 0) if it lies."""
    vertices = import_object(path, **settings).mesh.vertices
    top = vertices[vertices[:, 2] > vertices[:, 2].max() - 1e-4].mean(axis=0)
    return int(np.sign(round(float(top[0]), 1))), int(np.sign(round(float(top[1]), 1)))


AHEAD_LEFT = (1, 1)


@pytest.mark.parametrize(
    ("name", "front", "up", "extension", "settings"),
    [
        ("car.glb", "+z", "+y", None, {}), ("car.vrm", "-z", "+y", "VRM", {}), ("car.vrm", "+z", "+y", "VRMC_vrm", {}),
        ("car.glb", "+x", "+y", None, {"facing": "+x"}), ("car.glb", "+y", "+z", None, {"facing": "+y", "up": "z"}),
        ("car.glb", "+x", "+z", None, {"up": "z"}), ("car.obj", "+x", "+y", None, {"up": "y"}),
        ("car.stl", "-y", "+z", None, {"facing": "-y"}),
    ],
)  # fmt: skip
def test_what_is_the_front_of_a_file_faces_x(
    name: str, front: str, up: str, extension: str | None, settings: dict[str, Any], tmp_path: Path
) -> None:
    path = write_car(tmp_path / name, front, up, extension)
    assert mast_of(path, **settings) == AHEAD_LEFT
    asset = import_object(path, **settings)
    assert asset.front is not None and asset.front.axis == front
    assert ("facing=" in asset.front.reason) == ("facing" not in settings)
    assert asset.front.reason not in asset.notes  # told where it matters


def place(scene: SceneDescription) -> np.ndarray:
    return np.asarray(camera_to_world(scene)[:3, 3] * scene.size_in_metres)


def dashcam(name: object, environment: str = "street", **given: Any) -> SceneDescription:
    return load_scene(str(name), environment, camera="dashcam", **given).description


def test_a_thing_faces_as_its_file_or_its_facing_says(tmp_path: Path) -> None:
    right, wrong = write_car(tmp_path / "right.glb", "+z"), write_car(tmp_path / "wrong.glb", "-z")
    things = f"{right}@10,0; {wrong}@20,0,facing=-z; {wrong}@-10,0,name=turned"
    scene = load_scene("car", "street", things=things).description
    for name, ahead in (("right", 1), ("wrong", 1), ("turned", -1)):
        part = scene.things[name]
        world = part.mesh.vertices @ part.to_world[:3, :3].T
        top = world[world[:, 2] > world[:, 2].max() - 1e-4].mean(axis=0)
        middle = (world.max(axis=0) + world.min(axis=0)) / 2.0
        assert np.sign(top[0] - middle[0]) == ahead
    assert [note.split(":")[0] for note in scene.notes if "its front is assumed" in note] == ["right.glb", "wrong.glb"]


def test_a_scene_file_is_turned_as_a_whole(tmp_path: Path) -> None:
    """What is ahead of the object along the file's +z is ahead along our +x."""
    file = File()
    file.primitive()
    file.header["meshes"].append(file.header["meshes"][0])
    file.header["nodes"] = [{"mesh": 0, "name": "one"}, {"mesh": 1, "name": "ahead", "translation": [0.0, 0.0, 5.0]}]
    file.header["scenes"] = [{"nodes": [0, 1]}]
    scene = import_scene(file.write(tmp_path), "one")
    (ahead,) = scene.surroundings
    assert isinstance(ahead, MeshPart)
    shift = ahead.to_world[:3, 3]
    assert shift[0] == pytest.approx(5.0) and abs(shift[1]) < 1e-6


def file_vertices(data: bytes) -> np.ndarray:
    """The places of the first mesh in a binary glTF file, as they are written."""
    header, rest = split_glb(data)
    buffer = rest[8:]  # after the chunk's own header
    accessor = header["accessors"][header["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    start = header["bufferViews"][accessor["bufferView"]]["byteOffset"]
    return np.frombuffer(buffer, "<f4", 3 * accessor["count"], start).reshape(-1, 3)


def test_a_bundled_car_is_written_with_its_front_at_z_and_read_again_as_it_was(tmp_path: Path) -> None:
    car = library.load_object("car")
    data = encode_glb([car])
    written = file_vertices(data)
    lamps = np.unique(car.mesh.faces[car.mesh.materials["headlight"]])
    assert written[lamps, 2].min() > 0.3  # of 1, its length
    assert (written[:, 1].min(), np.ptp(written, axis=0).argmax()) == (pytest.approx(0.0, abs=1e-6), 2)
    (tmp_path / "again.glb").write_bytes(data)
    again = import_object(tmp_path / "again.glb").mesh.vertices
    tree = trimesh.PointCloud(car.mesh.vertices).kdtree
    assert tree.query(again)[0].max() < 1e-5
    assert place(dashcam(tmp_path / "again.glb"))[0] < -9.0
