"""How large objects are in metres: what is said of them, what their files say, and what is asked."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from advsearch.controls.camera import CameraControl
from advsearch.engine.loading import load_scene, scene_to_settings
from advsearch.scene import library
from advsearch.scene.assembly import pose_mesh
from advsearch.scene.assets import is_road_vehicle
from advsearch.scene.description import load_description
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.glb import encode_glb
from advsearch.scene.importing.objects import import_object
from advsearch.scene.importing.scenes import import_scene


def box(folder: Path, name: str, longest: float) -> Path:
    """A box of 1 x 0.4 x 0.3 times its longest side, as .obj."""
    x, y, z = longest, 0.4 * longest, 0.3 * longest
    corners = [(a, b, c) for a in (0, x) for b in (0, y) for c in (0, z)]
    faces = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines = [f"v {a:g} {b:g} {c:g}" for a, b, c in corners] + ["f " + " ".join(map(str, one)) for one in faces]
    path = folder / f"{name}.obj"
    path.write_text("\n".join(lines) + "\n")
    return path


def glb_of(folder: Path, name: str, longest: float) -> Path:
    part = load_description(str(box(folder, name, 1.0)), up="z").meshes["object"]
    found = pose_mesh(part, {})
    path = folder / f"{name}.glb"
    path.write_bytes(encode_glb([replace(found, mesh=replace(found.mesh, vertices=found.mesh.vertices * longest))]))
    return path


def test_gltf_is_in_metres_and_other_files_say_no_unit(tmp_path: Path) -> None:
    assert import_object(glb_of(tmp_path, "car", 4.9)).size_in_metres == pytest.approx(4.9, rel=1e-5)
    loose = import_object(box(tmp_path, "sedan", 490.0))
    assert loose.size_in_metres is None
    assert loose.extent == pytest.approx(490.0)


@pytest.mark.parametrize(
    ("longest", "said"),
    [
        (4.9, {"unit": "m"}), (490.0, {"unit": "cm"}), (4900.0, {"unit": "mm"}), (4.9 / 0.0254, {"unit": "in"}),
        (1.0, {"size": 4.9}),
    ],
)  # fmt: skip
def test_a_car_stands_in_its_lane_at_its_size(tmp_path: Path, longest: float, said: dict[str, object]) -> None:
    scene = load_scene(str(box(tmp_path, "sedan", longest)), "street", up="z", **said)  # type: ignore[arg-type]
    own = scene.description
    assert own.size_in_metres == pytest.approx(4.9, rel=1e-5)
    road = own.surrounding_meshes["road"].mesh.vertices
    assert np.ptp(road[:, 0]) * own.size_in_metres == pytest.approx(120.0)
    assert np.ptp(own.base_vertices, axis=0) / np.ptp(road, axis=0)[0] * 120.0 == pytest.approx(
        [4.9, 1.96, 1.47], rel=1e-4
    )
    assert [note.split(" to face")[0] for note in own.notes] == ["sedan.obj: its front is assumed"]
    assert {name: scene_to_settings(scene)[name] for name in said} == said


def test_a_node_has_the_size_that_it_has_in_its_scene(tmp_path: Path) -> None:
    part = pose_mesh(load_description(str(box(tmp_path, "seat", 1.0)), up="z").meshes["object"], {})
    both = [
        replace(part, name="seat"),
        replace(part, name="far", mesh=replace(part.mesh, vertices=part.mesh.vertices + 3)),
    ]
    (tmp_path / "room.glb").write_bytes(encode_glb(both))
    assert import_scene(tmp_path / "room.glb", "seat").object.size_in_metres == pytest.approx(1.0, rel=1e-5)
    assert import_object(tmp_path / "room.glb").size_in_metres == pytest.approx(4.0, rel=1e-5)


@pytest.mark.island("advsearch.controls.path")
def test_a_path_of_a_file_is_in_metres(tmp_path: Path) -> None:
    from advsearch.controls.path import PathControl

    way = tmp_path / "way.csv"
    way.write_text("time,x,y,z,look_x,look_y,look_z\n0,20,0,1,0,0,1\n2,10,0,1,0,0,1\n")
    scene = load_description(str(box(tmp_path, "sedan", 1.0)), "street", up="z", size=5.0)
    path = PathControl(path=str(way)).bind(scene)
    place = path.inputs(torch.tensor([0.0]))["camera.to_world"][:3, 3].double().numpy()
    middle = (scene.base_vertices.min(axis=0) + scene.base_vertices.max(axis=0)) / 2.0
    assert (place - middle) * 5.0 == pytest.approx([20.0, 0.0, 1.0], abs=1e-4)
    said = path.describe(torch.tensor([0.0]))["path.distance"]
    assert said["unit"] == "metres" and said["value"] == pytest.approx(401.0**0.5, abs=1e-3)


SIZES = {
    "ball": 0.22, "banana": 0.175, "book": 0.275, "bottle": 0.30, "bowl": 0.16, "car": 4.3, "chair": 0.92,
    "dumbbell": 0.23, "frying-pan": 0.40, "hammer": 0.26, "lamp": 0.48, "mug": 0.11, "person": 1.74, "stop-sign": 1.16,
    "teapot": 0.24, "vase": 0.24, "wine-glass": 0.19,
}  # fmt: skip
"""Metres of the longest side of each bundled object."""


@pytest.mark.medium
def test_bundled_objects_have_their_true_size() -> None:
    assert {name: library.load_object(name).size_in_metres for name in library.list_objects()} == pytest.approx(
        SIZES, abs=6e-3
    )
    assert not any(load_description(name).notes for name in SIZES)


@pytest.mark.medium
@pytest.mark.parametrize("name", sorted(SIZES))
def test_a_size_in_metres_changes_no_picture(name: str) -> None:
    """Neither where the camera stands by itself nor where it is searched; and a distance in sizes is that in metres."""
    sized = load_description(name)
    bare = replace(sized, object=replace(sized.object, size_in_metres=None))
    assert np.array_equal(camera_to_world(sized), camera_to_world(bare))
    around: dict[str, Any] = {"azimuth": [0, 90], "elevation": [5, 60]}
    far = {**around, "distance": [1.5, 6.0]}
    pairs: list[tuple[dict[str, Any], dict[str, Any]]] = [
        ({**around, "distance": [1.5 * sized.size_in_metres, 6.0 * sized.size_in_metres]}, far),
        ({**around, "sizes": [1.5, 6]}, far),
    ]
    if not is_road_vehicle(sized.object):  # these are looked at from some height in metres
        pairs.append(({}, {}))
    for asked, same in pairs:
        controls = CameraControl(**asked).bind(sized), CameraControl(**same).bind(bare)
        for share in (0.0, 0.3, 1.0):
            u = torch.full_like(controls[0].start, share)
            poses = [one.inputs(u)["camera.to_world"].numpy() for one in controls]
            np.testing.assert_allclose(poses[0], poses[1], rtol=0, atol=3e-6)
