"""The path control: the scene as it is where it is promised, distances that are right, and files, good and hostile."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

import advsearch
from advsearch.controls import Control, make_space
from advsearch.controls.path import CLEAN_TIME_FRACTION, PATHS, PathControl, get_start_poses
from advsearch.controls.path.pose_files import SENSOR_AXES, WORLD_TO_Z_UP
from advsearch.engine.rendering import make_sight
from advsearch.errors import FileFormatError, InputError
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.geometry import camera_to_world, compute_center, object_to_world
from advsearch.tasks import Facts

WAY = "time, x, y, z\n3, 2, 0, 1\n4, 2, 2, 1\n7, -2, 2, 1\n"
"""A way of four seconds; the middle one is passed after one of them."""


@pytest.fixture(scope="module")
def scene() -> SceneDescription:
    return load_description("mug", size=1.0, setting_values={"camera.roll": 20.0, "camera.azimuth": 70.0})


def bound(scene: SceneDescription, **given: Any) -> PathControl:
    (control,) = make_space([PathControl(**given)], scene).controls
    assert isinstance(control, PathControl)
    return control


def distance(control: Control, share: float) -> float:
    return float(str(control.describe(torch.tensor([share]))["path.distance"]["value"]))


def placed(control: Control, share: float) -> Tensor:
    (pose,) = control.inputs(torch.tensor([share])).values()
    return pose


@pytest.mark.parametrize("moves", ["camera", "object"])
@pytest.mark.parametrize("path", PATHS)
def test_a_frame_of_each_path_is_the_scene_as_it_is_and_others_are_not(
    scene: SceneDescription, path: str, moves: str
) -> None:
    control = bound(scene, path=path, moves=moves)
    own = torch.from_numpy((camera_to_world if moves == "camera" else object_to_world)(scene)).float()
    assert float(control.start) == CLEAN_TIME_FRACTION[path]
    torch.testing.assert_close(placed(control, float(control.start)), own, atol=1e-5, rtol=0)
    assert float((placed(control, 0.3) - own).abs().max()) > 0.1
    turning = placed(control, 0.3)[:3, :3] / float(own[:3, 0].norm())
    torch.testing.assert_close(turning @ turning.T, torch.eye(3), atol=1e-5, rtol=0)


@pytest.mark.parametrize("moves", ["camera", "object"])
def test_distances_are_those_of_the_geometry(moves: str) -> None:
    scene = load_description("mug", size=1.0, setting_values={"camera.elevation": 0.0, "camera.distance": 2.0})
    away = distance(bound(scene, path="orbit", moves=moves), 0.7)
    assert away == pytest.approx(2.0, abs=1e-4)
    near = [distance(bound(scene, path="approach", reach=5.0, moves=moves), share) for share in (0.0, 0.25, 1.0)]
    assert near == pytest.approx([10.0, 8.0, 2.0], abs=1e-3)
    past = [distance(bound(scene, path="pass", reach=3.0, moves=moves), share) for share in (0.0, 0.5, 1.0)]
    assert past == pytest.approx([math.hypot(2.0, 6.0), 2.0, math.hypot(2.0, 6.0)], abs=1e-3)


@pytest.mark.parametrize("path", ["approach+orbit", "orbit+approach", "pass+pass", "approach+approach"])
def test_both_move_as_each_does_alone_and_the_camera_looks_at_the_object(scene: SceneDescription, path: str) -> None:
    both = bound(scene, path=path)
    first, second = path.split("+")
    camera, thing = bound(scene, path=first), bound(scene, path=second, moves="object")
    center = torch.cat([torch.from_numpy(compute_center(scene)).float(), torch.ones(1)])
    base = torch.from_numpy(object_to_world(scene)).float()
    for share in (0.0, 0.3, 0.8):
        poses = both.inputs(torch.tensor([share]))
        assert set(poses) == {"camera.to_world", "object.to_world"}
        torch.testing.assert_close(poses["object.to_world"], placed(thing, share), atol=1e-5, rtol=0)
        eye = poses["camera.to_world"][:3, 3]
        torch.testing.assert_close(eye, placed(camera, share)[:3, 3], atol=1e-5, rtol=0)
        there = (poses["object.to_world"] @ torch.linalg.inv(base) @ center)[:3]
        ahead = (there - eye) / (there - eye).norm()
        torch.testing.assert_close(poses["camera.to_world"][:3, 2], ahead, atol=1e-5, rtol=0)
        assert distance(both, share) == pytest.approx(float((there - eye).norm()), abs=1e-4)
    own = {"camera.to_world": torch.from_numpy(camera_to_world(scene)).float(), "object.to_world": base}
    torch.testing.assert_close(both.inputs(both.start), own, atol=1e-4, rtol=0)


def test_a_file_says_where_both_are(scene: SceneDescription, tmp_path: Path) -> None:
    """The same way in one file, and in one file for each, of which one ends before the other."""
    file, camera, thing = (tmp_path / name for name in ("both.csv", "camera.csv", "object.csv"))
    file.write_text("time,x,y,z,object_x,object_y,object_z,object_heading\n0,9,0,1,0,0,0,0\n4,5,0,1,2,0,0,90\n")
    camera.write_text("time,x,y,z\n0,9,0,1\n4,5,0,1\n8,1,0,1\n")
    thing.write_text("time,x,y,z,heading\n0,0,0,0,0\n4,2,0,0,90\n")
    one, two = bound(scene, path=str(file)), bound(scene, path=f"{camera}+{thing}")
    assert distance(one, 0.5) == pytest.approx(math.hypot(6.0, 1.0), abs=1e-4)
    for time in (0.0, 1.0, 4.0):
        poses = one.inputs(torch.tensor([time / 4.0])), two.inputs(torch.tensor([time / 8.0]))
        torch.testing.assert_close(*poses, atol=1e-5, rtol=0)
    torch.testing.assert_close(
        one.inputs(torch.ones(1))["object.to_world"], two.inputs(torch.ones(1))["object.to_world"]
    )
    file.write_text(
        "time,x,y,z,look_x,look_y,look_z,object_heading\n0,3,0,1,0,0,1\n1,3,0,1,3,5,1\n".replace("1\n", "1,8\n")
    )
    turning = bound(scene, path=str(file)).inputs(torch.ones(1))
    torch.testing.assert_close(turning["camera.to_world"][:3, 2], torch.tensor([0.0, 1.0, 0.0]), atol=1e-5, rtol=0)
    file.write_text("time,x,y,z,heading\n0,0,0,0,0\n1,0,0,0,8\n")
    alone = placed(bound(scene, path=str(file), moves="object"), 1.0)
    torch.testing.assert_close(turning["object.to_world"], alone, atol=1e-5, rtol=0)
    with pytest.raises(FileFormatError, match="expected columns"):
        PathControl(path=f"{file}+orbit")


def test_the_box_of_each_frame_is_where_both_have_moved_to(tmp_path: Path) -> None:
    """A camera that looks ahead while the object comes from the right: the box is where its points are projected."""
    file = tmp_path / "both.csv"
    file.write_text(
        "time,x,y,z,look_x,look_y,look_z,object_x,object_y,object_z,object_heading\n"
        "0,6,0,0,0,0,0,0,1,0,0\n1,4,0,0,0,0,0,0,-0.5,0,180\n"
    )
    one = advsearch.load_scene("mug").renderer({"path": {"path": str(file)}}, resolution=64, denoise="none")
    scene = one.scene.definition[0]
    vertices = torch.from_numpy(scene.object.mesh.vertices).double()
    places = torch.cat([vertices, torch.ones(len(vertices), 1, dtype=torch.float64)], dim=1)
    for share in (0.0, 0.8):
        poses = {name: pose.double() for name, pose in one.space.inputs(torch.tensor([share])).items()}
        seen = torch.linalg.inv(poses["camera.to_world"]) @ poses["object.to_world"] @ places.T
        focal = 32.0 / math.tan(math.radians(scene.number("camera.fov") / 2.0))
        flat = 32.0 - focal * (seen[:2] / seen[2]).T
        box = Facts("mug", compute_sight=partial(make_sight, one.surfaces(torch.tensor([share])))).box
        assert box == pytest.approx((*flat.amin(dim=0).tolist(), *flat.amax(dim=0).tolist()), abs=1.2)


@pytest.mark.parametrize("path", PATHS)
def test_moving_the_camera_or_the_object_is_the_same_drive(path: str) -> None:
    """Up to the sense of the turn: what the camera sees of the object's middle is as far away."""
    scene = load_description("mug", size=1.0, setting_values={"camera.elevation": 30.0})
    camera, thing = (bound(scene, path=path, moves=moves) for moves in ("camera", "object"))
    for share in (0.0, 0.4, 0.8):
        assert distance(camera, share) == pytest.approx(distance(thing, share), rel=1e-4)


@pytest.mark.parametrize("moves", ["camera", "object"])
@pytest.mark.parametrize("path", PATHS)
def test_the_derivative_is_that_of_differences(scene: SceneDescription, path: str, moves: str) -> None:
    control, share, step = bound(scene, path=path, moves=moves), 0.37, 1e-2
    derivative = torch.autograd.functional.jacobian(
        lambda u: next(iter(control.inputs(u).values())), torch.tensor([share])
    )[..., 0]
    difference = (placed(control, share + step) - placed(control, share - step)) / (2.0 * step)
    torch.testing.assert_close(derivative, difference, atol=2e-2, rtol=2e-2)


def test_a_way_of_a_file_is_followed(scene: SceneDescription, tmp_path: Path) -> None:
    file, center = tmp_path / "way.csv", torch.from_numpy(compute_center(scene)).float()
    file.write_text("\ufeff" + WAY)
    control = bound(scene, path=str(file))
    assert float(str(control.describe(torch.ones(1))["path.time"]["value"])) == pytest.approx(4.0)
    for share, place in ((0.0, (2.0, 0.0, 1.0)), (0.125, (2.0, 1.0, 1.0)), (0.625, (0.0, 2.0, 1.0)), (1, (-2, 2, 1))):
        pose = placed(control, share)
        torch.testing.assert_close(pose[:3, 3] - center, torch.tensor(place, dtype=torch.float32), atol=1e-5, rtol=0)
        ahead = (center - pose[:3, 3]) / (center - pose[:3, 3]).norm()
        torch.testing.assert_close(pose[:3, 2], ahead, atol=1e-5, rtol=0)


def test_a_file_says_where_the_camera_looks_and_how_the_object_is_turned(
    scene: SceneDescription, tmp_path: Path
) -> None:
    looks, turns = tmp_path / "looks.csv", tmp_path / "turns.CSV"
    looks.write_text("time,x,y,z,look_x,look_y,look_z\n0,3,0,1,0,0,1\n1,3,0,1,3,5,1\n")
    turns.write_text("time,heading,z,y,x\n0,0,0,0,0\n2,90,0,0,4\n")
    ahead = placed(bound(scene, path=str(looks)), 1.0)[:3, 2]
    torch.testing.assert_close(ahead, torch.tensor([0.0, 1.0, 0.0]), atol=1e-5, rtol=0)
    own, pose = (
        torch.from_numpy(object_to_world(scene)).float(),
        placed(bound(scene, path=str(turns), moves="object"), 1),
    )
    torch.testing.assert_close(pose[:3, 0], torch.stack([-own[1, 0], own[0, 0], own[2, 0]]), atol=1e-5, rtol=0)
    there = torch.cat([torch.from_numpy(compute_center(scene)).float(), torch.ones(1)])
    shift = (pose @ torch.linalg.inv(own) @ there - there)[:3]
    torch.testing.assert_close(shift, torch.tensor([4.0, 0.0, 0.0]), atol=1e-5, rtol=0)


def test_a_camera_over_the_object_has_a_pose(tmp_path: Path) -> None:
    file = tmp_path / "over.csv"
    file.write_text("time,x,y,z\n0,0,0,3\n1,0,0,2\n")
    assert bool(torch.isfinite(placed(bound(load_description("mug", size=1.0), path=str(file)), 0.5)).all())


@pytest.mark.parametrize(
    ("text", "when"),
    [
        ("time,x,y,z\n0,4,0,1.2\n1,0,0,0\n2,-4,0,1.2\n", "1 s"),  # at a waypoint
        ("time,x,y,z\n0,4,0,2\n1,-4,0,-2\n", "0.5 s"),  # between two
        ("time,x,y,z,look_x,look_y,look_z\n0,4,0,1,0,0,1\n4,4,0,1,8,0,1\n", "2 s"),  # what it looks at comes by
        ("time,x,y,z,object_x,object_y,object_z\n0,4,0,0,0,0,0\n4,4,0,0,8,0,0\n", "2 s"),
        ("time,x,y,z\n0,4,0,1.2\n1,0,0,0.1\n2,-4,0,1.2\n", None),
        ("time,x,y,z,look_x,look_y,look_z\n0,4,0,1,9,0,1\n1,0,0,0,9,0,1\n", None),
    ],
)
def test_a_path_through_what_the_camera_looks_at_is_refused(
    scene: SceneDescription, text: str, when: str | None, tmp_path: Path
) -> None:
    file = tmp_path / "way.csv"
    file.write_text(text)
    if when is None:
        control = bound(scene, path=str(file))
        for share in torch.linspace(0.0, 1.0, 5).tolist():
            turn = placed(control, share)[:3, :3]
            torch.testing.assert_close(turn @ turn.T, torch.eye(3), atol=1e-5, rtol=0)
        return
    with pytest.raises(InputError, match=rf"way\.csv: {when} after its start the camera is where it looks"):
        bound(scene, path=str(file))


def test_a_path_through_what_it_looks_at_is_refused_where_no_file_is(tmp_path: Path) -> None:
    level = load_description("mug", size=1.0, setting_values={"camera.elevation": 0.0})
    file = tmp_path / "car.csv"
    file.write_text("time,x,y,z\n0,-9,0,0\n1,9,0,0\n")  # past the middle; the camera is at +x, and looks at the object
    east = load_description("mug", size=1.0, setting_values={"camera.elevation": 0.0, "camera.azimuth": 0.0})
    with pytest.raises(InputError, match="the camera is where it looks"):
        bound(east, path=f"approach+{file}")
    for path in (*PATHS, "approach+orbit", "pass+pass"):
        bound(level, path=path)


def test_as_many_times_at_once_are_those_one_by_one(scene: SceneDescription, tmp_path: Path) -> None:
    """By which a whole path is looked at."""
    file = tmp_path / "way.csv"
    file.write_text(WAY)
    for path in (*PATHS, f"{file}+orbit", f"approach+{file}", "pass+pass"):
        control = PathControl(path=path).with_scene(scene)
        time = torch.linspace(0.0, control.seconds, 7)
        start = get_start_poses(control.scene, time.device)

        def both(at: Tensor, control: PathControl = control, start: Any = start) -> Tensor:
            (ways,) = control._paths
            place, target = control._position_camera(ways, start, at, control._shift_object(ways, start, at)[0])
            return (target - place).expand(*at.shape, 3)

        torch.testing.assert_close(both(time), torch.stack([both(one) for one in time]))


@pytest.mark.parametrize(
    ("headings", "middles", "told"),
    [
        ([350, 10], [0.0], True),
        ([10, 350], [0.0], True),
        ([-170, 170], [180.0], True),
        ([0, 360], [180.0], False),
        ([0, 180], [90.0], False),
        ([350, 370], [0.0], False),
        ([350, 10, 40], [0.0, 25.0], True),
        ([-180, 180], [0.0], False),
        ([700, 20], [0.0], False),
    ],
)
def test_headings_go_the_shorter_way_round(
    scene: SceneDescription, headings: list[int], middles: list[float], told: bool, tmp_path: Path
) -> None:
    file = tmp_path / "car.csv"
    file.write_text("time,x,y,z,heading\n" + "".join(f"{at},0,0,0,{one}\n" for at, one in enumerate(headings)))
    control = bound(scene, path=str(file), moves="object")
    for place, middle_of in enumerate(middles):
        angle = float(torch.rad2deg(torch.atan2(*_turned(scene, control, (place + 0.5) / (len(headings) - 1)))))
        assert (angle - middle_of + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-2)
    notes = PathControl(path=str(file), moves="object").prepare(scene).notes
    assert any("the shorter way" in note for note in notes) == told


def _turned(scene: SceneDescription, control: Control, share: float) -> tuple[Tensor, Tensor]:
    """Sine and cosine of how far the object is turned."""
    turn = placed(control, share)[:3, :3] @ torch.linalg.inv(torch.from_numpy(object_to_world(scene)).float()[:3, :3])
    return turn[1, 0], turn[0, 0]


@pytest.mark.parametrize("start", [0.0, 1764201600.0])
def test_waypoints_of_a_thousand_a_second_are_read(start: float, tmp_path: Path) -> None:
    """Though a thousandth is no sum of powers of two."""
    file = tmp_path / "fast.csv"
    file.write_text("time,x,y,z\n" + "".join(f"{start + one / 1000:.3f},{4 - one / 500},0,1\n" for one in range(400)))
    assert PathControl(path=str(file)).seconds == pytest.approx(0.399)
    file.write_text("time,x,y,z\n0,1,1,1\n0.0009,1,1,1\n")
    with pytest.raises(FileFormatError, match=r"by 0\.001 s at least"):
        PathControl(path=str(file))


def test_a_file_that_changes_is_read_again(scene: SceneDescription, tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text(WAY)
    assert PathControl(path=str(file)).seconds == 4.0
    file.write_text(WAY.replace("7, -2", "9, -2") + "\n")
    assert PathControl(path=str(file)).seconds == 6.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected columns time, x, y, z, and perhaps look_x, look_y, look_z, object_x, .*, got nothing"),
        ("time,x,y\n0,1,1\n1,1,1\n", "expected columns .* got time, x, y"),
        ("time,x,y,z,look_x\n0,1,1,1,0\n1,1,1,1,0\n", "expected columns .* got time, x, y, z, look_x"),
        ("time,x,y,z,heading\n0,1,1,1,0\n1,1,1,1,0\n", "expected columns"),
        ("time,x,y,z,object_x\n0,1,1,1,0\n1,1,1,1,0\n", "expected columns"),
        ("time,x,x,y,z\n0,1,1,1,0\n1,1,1,1,0\n", "expected columns"),
        ("time,x,y,z\n0,1,1," + 200_000 * "1" + "\n", "expected a table of waypoints, got one with a field larger"),
        ("time,x,y,z\n0,1,1,1\n", "expected 2 to 100000 waypoints, got 1"),
        ("time,x,y,z\n0,1,1,1\n1,a,1,1\n", "expected 4 numbers in each row"),
        ("time,x,y,z\n0,1,1,1\n1,1,1\n", "expected 4 numbers in each row"),
        ("time,x,y,z\n0,1,1,1\n0,1,1,1\n", "expected times that ascend, by 0.001 s at least and 3600 s in all"),
        ("time,x,y,z\n1,1,1,1\n0,1,1,1\n", "expected times that ascend"),
        ("time,x,y,z\nnan,1,1,1\n1,1,1,1\n", "expected times that ascend"),
        ("time,x,y,z\n0,1,1,1\n1e300,1,1,1\n", "expected times that ascend"),
        ("time,x,y,z\n1e30,1,1,1\n2e30,1,1,1\n", "expected times that ascend"),
        ("time,x,y,z\n0,1,1,1\n1e-30,1,1,1\n", "expected times that ascend"),
        ("time,x,y,z\n0,1,1,1\n1,1e300,1,1\n", "expected numbers within 100000"),
        ("time,x,y,z\n0,nan,1,1\n1,1,1,1\n", "expected numbers within 100000"),
        ("time,x,y,z\n0,-inf,1,1\n1,1,1,1\n", "expected numbers within 100000"),
    ],
)
def test_a_file_that_is_no_way_is_refused(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        PathControl(path=str(file))


def test_a_file_that_is_missing_or_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"nowhere\.csv"):
        PathControl(path=str(tmp_path / "nowhere.csv"))
    (tmp_path / "bytes.csv").write_bytes(b"time,x,y,z\n\xff\xfe\x00\n")
    with pytest.raises(FileFormatError, match=r"bytes\.csv"):
        PathControl(path=str(tmp_path / "bytes.csv"))
    with pytest.raises(FileFormatError):
        (tmp_path / "folder.csv").mkdir()
        PathControl(path=str(tmp_path / "folder.csv"))


def test_what_does_not_go_together_is_refused(scene: SceneDescription, tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text(WAY)
    with pytest.raises(
        InputError, match=r"path\.path: expected approach, pass, orbit, a \.csv or .* file, or two of them .* got 'apr"
    ):
        PathControl(path="aproach")
    for path in (str(file), f"approach+{file}"):
        with pytest.raises(InputError, match=r"path: seconds: the file in .*way\.csv says that itself; leave it out"):
            PathControl(path=path, seconds=3.0)
    with pytest.raises(InputError, match="path: reach: the file"):
        PathControl(path=f"{file}+{file}", reach=3.0)
    assert PathControl(path=f"approach+{file}", reach=3.0).seconds == 4.0, "the camera's way is no file's"
    for path in ("approach+turn", "+orbit", "approach+orbit+pass"):
        with pytest.raises(InputError, match="expected approach"):
            PathControl(path=path)
    with pytest.raises(InputError, match=r"approach\+orbit says what .* leave moves out"):
        PathControl(path="approach+orbit", moves="object")


def test_of_several_paths_each_configuration_has_one_as_it_is_alone(scene: SceneDescription, tmp_path: Path) -> None:
    (tmp_path / "way.csv").write_text(WAY)
    names = ["approach", "orbit+pass", str(tmp_path / "way.csv")]
    several = bound(scene, path=",".join(names))
    assert [slot.parameter.name for slot in several.slots] == ["time", "way"] and several.start.shape == (2,)
    assert several.describe(several.start)["path.way"] == {"value": "approach", "unit": "name"}
    for number, name in enumerate(names):
        alone = bound(scene, path=name, **({} if number == 2 else {"seconds": 4.0}))
        u = torch.tensor([0.3, (number + 0.5) / 3])
        poses, own = several.inputs(u), alone.inputs(u[:1])
        assert several.describe(u)["path.way"]["value"] == name
        assert set(poses) == {"camera.to_world", "object.to_world"}  # one set, so that no draw is a surprise
        for one, pose in own.items():
            torch.testing.assert_close(poses[one], pose)
    assert bound(scene, path=["approach", "orbit"]).to_settings() == {"path": ["approach", "orbit"]}


@pytest.mark.parametrize("path", ["approach,approach", "approach,", "approach,nowhere", ",".join(["a.csv"] * 70)])
def test_several_paths_are_different_ones_that_there_are(path: str) -> None:
    with pytest.raises((InputError, FileFormatError), match=r"path: expected|expected a table"):
        PathControl(path=path)


def test_a_file_that_is_shorter_than_others_is_told(scene: SceneDescription, tmp_path: Path) -> None:
    (tmp_path / "way.csv").write_text(WAY)
    (tmp_path / "longer.csv").write_text(WAY + "9, 1, 2, 1\n")
    there = PathControl(path=f"{tmp_path / 'way.csv'},{tmp_path / 'longer.csv'}").prepare(scene)
    assert any("takes 4 s of 6" in one for one in there.remarks)


# ---- trajectories of other tools ------------------------------------------------------------------------------------

OPTICAL_TO_WORLD = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""A camera (x right, y down, z ahead) that looks level along -x, in a world whose z is up."""
STEP_SECONDS, SPEED = 0.5, 2.0
HEADER = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"


def trajectory(form: str, axes: str = "optical", up: str = "z", at: tuple[float, ...] = (0.0, 0.0, 0.0)) -> str:
    """The text of five poses from (6, 0, 1) to (2, 0, 1), in a world and of a sensor with some axes."""
    world = WORLD_TO_Z_UP[up].T
    rotation = Rotation.from_matrix(world @ OPTICAL_TO_WORLD @ SENSOR_AXES[axes].T)
    quaternion = rotation.as_quat()
    lines = []
    for step in range(5):
        place = world @ np.array([6.0 - step, 0.0, 1.0]) + np.array(at)
        seconds = 1403636579.5 + STEP_SECONDS * step
        nanoseconds = 1403636579500000000 + step * 500000000
        sign = -1.0 if step % 2 else 1.0  # the same rotation
        xyzw = " ".join(f"{sign * value:.9f}" for value in quaternion)
        wxyz = " ".join(f"{sign * value:.9f}" for value in np.roll(quaternion, 1))
        xyz = " ".join(f"{value:.9f}" for value in place)
        if form == "tum":
            lines.append(f"{seconds:.6f} {xyz} {xyzw}")
        elif form == "tum, real part first":
            lines.append(f"{seconds:.6f} {xyz} {wxyz}")
        elif form == "tum in nanoseconds":
            lines.append(f"{nanoseconds} {xyz} {xyzw}")
        elif form == "euroc":
            lines.append(f"{nanoseconds},{xyz.replace(' ', ',')},{wxyz.replace(' ', ',')}")
        elif form == "euroc, all columns":
            lines.append(f"{nanoseconds}, {xyz.replace(' ', ', ')}, {wxyz.replace(' ', ', ')}, 0.1, 0.2, 0.3")
        else:
            lines.append(" ".join(f"{value:.9e}" for value in np.column_stack([rotation.as_matrix(), place]).flat))
    heads = {
        "tum": "# a trajectory\n# timestamp tx ty tz qx qy qz qw\n",
        "tum, real part first": "# timestamp tx ty tz qw qx qy qz\n",
        "euroc": HEADER + "\n",
        "euroc, all columns": HEADER + ", v_RS_R_x [m s^-1], b_w_RS_S_x [rad s^-1], b_a_RS_S_x [m s^-2]\n",
    }
    return heads.get(form, "") + "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("form", "axes", "up", "at"),
    [
        ("tum", "optical", "z", (0.0, 0.0, 0.0)),
        ("tum, real part first", "optical", "z", (0.0, 0.0, 0.0)),
        ("tum in nanoseconds", "opengl", "y", (0.0, 0.0, 0.0)),
        ("tum", "optical", "-y", (1.0, 2.0, 3.0)),
        ("euroc", "optical", "z", (0.0, 0.0, 0.0)),
        ("euroc", "euroc", "z", (4e5, 5e6, 100.0)),
        ("euroc, all columns", "flu", "z", (0.0, 0.0, 0.0)),
        ("euroc", "frd", "-z", (0.0, 0.0, 0.0)),
        ("kitti", "optical", "-y", (20.0, 0.0, 0.0)),
        ("kitti", "flu", "z", (0.0, 0.0, 0.0)),
    ],
)
def test_a_trajectory_is_followed_by_a_camera_with_its_axes(
    scene: SceneDescription, tmp_path: Path, form: str, axes: str, up: str, at: tuple[float, ...]
) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(trajectory(form, axes, up, at))
    given: dict[str, Any] = {"axes": axes, "up": up, "object_at": list(at)}
    if form == "kitti":
        given["seconds"] = 2.0
    level = load_description("mug", size=1.0)
    control = bound(level, path=str(file), **given)
    assert control.seconds == pytest.approx(2.0)
    center = torch.from_numpy(compute_center(level)).float()
    ahead = torch.tensor([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # columns: left, up, ahead
    for share in (0.0, 0.3, 1.0):
        pose = placed(control, share)
        torch.testing.assert_close(pose[:3, 3] - center, torch.tensor([6.0 - 4.0 * share, 0.0, 1.0]), atol=2e-2, rtol=0)
        torch.testing.assert_close(pose[:3, :3], ahead, atol=1e-5, rtol=0)
    notes = [note for note in PathControl(path=str(file), **given).prepare(level).notes if "poses.txt" in note]
    assert [("not read: 'v_RS_R_x" in note, "read as ns" in note) for note in notes] in (
        [], [(form == "euroc, all columns", form == "tum in nanoseconds")],
    )  # fmt: skip
    assert bool(notes) == (form in ("euroc, all columns", "tum in nanoseconds"))


def test_what_a_trajectory_does_not_state_is_said_and_odd_axes_are_doubted(tmp_path: Path) -> None:
    file, level = tmp_path / "poses.tum", load_description("mug", size=1.0)
    file.write_text(trajectory("tum"))
    (note,) = [note for note in PathControl(path=str(file)).prepare(level).notes if "poses.tum" in note]
    assert "axes optical (x right, y down, z ahead), up z, object_at [0, 0, 0]" in note
    file.write_text(trajectory("tum", up="-y"))
    assert any("90 degrees from up" in note for note in PathControl(path=str(file)).prepare(level).notes)
    file.write_text(trajectory("kitti", up="-y", at=(9.0, 0.0, 0.0)))
    control = PathControl(path=str(file), object_at=[9, 0, 0])
    assert control.seconds == pytest.approx(0.4)
    assert any("seconds 10 poses a second" in note and "up -y" in note for note in control.prepare(level).notes)


def test_without_axes_the_camera_looks_at_the_object(scene: SceneDescription, tmp_path: Path) -> None:
    file, own, leica = tmp_path / "poses.txt", tmp_path / "own.csv", tmp_path / "leica.csv"
    file.write_text(trajectory("tum"))
    own.write_text("time,x,y,z\n0,6,0,1\n0.5,5,0,1\n1,4,0,1\n1.5,3,0,1\n2,2,0,1\n")
    leica.write_text("#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]\n0, 6, 0, 1\n2000000000, 2, 0, 1\n")
    for other in (bound(scene, path=str(file), axes="none"), bound(scene, path=str(leica))):
        for share in (0.0, 0.3, 1.0):
            torch.testing.assert_close(
                placed(other, share), placed(bound(scene, path=str(own)), share), atol=1e-5, rtol=0
            )


def test_a_derivative_along_a_trajectory_is_that_of_differences(scene: SceneDescription, tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    file.write_text("0 6 0 1 -0.5 -0.5 0.5 0.5\n1 4 1 1 0 -0.7071068 0 0.7071068\n")
    control, step = bound(scene, path=str(file)), 1e-2
    derivative = torch.autograd.functional.jacobian(
        lambda u: next(iter(control.inputs(u).values())), torch.tensor([0.4])
    )
    difference = (placed(control, 0.4 + step) - placed(control, 0.4 - step)) / (2.0 * step)
    torch.testing.assert_close(derivative[..., 0], difference, atol=2e-2, rtol=2e-2)


TUM_ROW = "1 6 0 1 -0.5 -0.5 0.5 0.5\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 6 0 1 -0.5 -0.5 0.5 0.7\n" + TUM_ROW, "pose 1: expected a quaternion of length 1, got one of 1.11"),
        ("0 6 0 1 0 0 0 0\n" + TUM_ROW, "expected a quaternion of length 1, got one of 0"),
        ("0 6 0 1 nan 0 0 1\n" + TUM_ROW, "expected finite numbers"),
        ("0 inf 0 1 0 0 0 1\n" + TUM_ROW, "expected finite numbers"),
        (TUM_ROW + TUM_ROW, "expected times that ascend"),
        (TUM_ROW, "expected 2 to 100000 waypoints, got 1"),
        ("0 6 0 1 0 0 0 1\n5000000000 6 0 1 0 0 0 1\n", "expected times that ascend"),
        ("0 6e6 0 1 0 0 0 1\n" + TUM_ROW, "expected positions within 100000 of the object"),
        (TUM_ROW + "2 6 0 1\n", "expected 8 numbers in each row, got '2 6 0 1'"),
        (TUM_ROW + "2 6 0 1 a b c d\n", "expected 8 numbers in each row"),
        ("1 2 3\n4 5 6\n", "expected 8 numbers a line as TUM's .* or 12 as KITTI's poses, got 3"),
        ("0 1 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "got 13 .KITTI-360"),
        ("1,6,0,1,-0.5,-0.5,0.5,0.5\n2,5,0,1,-0.5,-0.5,0.5,0.5\n", "expected a first line that names the columns"),
        (HEADER.replace("[ns]", "[h]") + "\n1,6,0,1,0.5,-0.5,-0.5,0.5\n" * 2, "expected times in s, ms, us"),
        ("1 0 0 0 0 1 0 0 0 0 2 0\n" * 2, "pose 1: expected a rotation and a shift"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n" * 2, "expected a rotation and a shift"),
        (1_100 * "1 " + "\n", "got 1100"),
        (100_001 * "1 0 0 0 0 1 0 0 0 0 1 0\n", "expected 2 to 100000 waypoints, got 100001"),
    ],
)
def test_a_file_that_is_no_trajectory_is_refused(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        PathControl(path=str(file))


def test_settings_of_trajectories_are_checked(tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(trajectory("tum"))
    with pytest.raises(InputError, match="axes: is about a trajectory"):
        PathControl(path="orbit", axes="flu")
    with pytest.raises(InputError, match="axes: is about a trajectory"):
        PathControl(axes="flu").prepare(load_description("mug", size=1.0))
    for given in ([1, 2], "here", [1, 2, math.nan], [1, 2, "3"]):
        with pytest.raises(InputError, match="object_at: expected three numbers"):
            PathControl(path=str(file), object_at=given)
    with pytest.raises(InputError, match="expected one of optical"):
        PathControl(path=str(file), axes="body")
    with pytest.raises(FileFormatError, match="is about the camera, and here the object moves"):
        PathControl(path=str(file), moves="object")
    with pytest.raises(InputError, match="seconds: the file"):
        PathControl(path=str(file), seconds=3.0)
    assert set(PathControl(path=f"{file}+orbit")._movers) == {"camera", "object"}
