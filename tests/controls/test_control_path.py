"""The path control: the scene as it is where it is promised, distances that are right, and files, good and hostile."""

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
from advsearch.controls.path import CLEAN_TIME_FRACTION, PATHS, PathControl
from advsearch.controls.path.pose_files import SENSOR_AXES, WORLD_TO_Z_UP
from advsearch.engine.rendering import make_sight
from advsearch.errors import FileFormatError, InputError
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.geometry import camera_to_world, compute_center, compute_object_to_world
from advsearch.tasks import Facts

pytestmark = pytest.mark.island("advsearch.controls.path")

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
    own = torch.from_numpy((camera_to_world if moves == "camera" else compute_object_to_world)(scene)).float()
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
    base = torch.from_numpy(compute_object_to_world(scene)).float()
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
    scene = one.scene.description_and_filter[0]
    vertices = torch.from_numpy(scene.object.mesh.vertices).double()
    places = torch.cat([vertices, torch.ones(len(vertices), 1, dtype=torch.float64)], dim=1)
    for share in (0.0, 0.8):
        poses = {name: pose.double() for name, pose in one.space.inputs(torch.tensor([share])).items()}
        seen = torch.linalg.inv(poses["camera.to_world"]) @ poses["object.to_world"] @ places.T
        focal = 32.0 / math.tan(math.radians(scene.get_number("camera.fov") / 2.0))
        flat = 32.0 - focal * (seen[:2] / seen[2]).T
        box = Facts("mug", compute_sight=partial(make_sight, one.find_surfaces(torch.tensor([share])))).box
        assert box == pytest.approx((*flat.amin(dim=0).tolist(), *flat.amax(dim=0).tolist()), abs=1.2)


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
    with pytest.raises(InputError, match=rf"way\.csv: {when}"):
        bound(scene, path=str(file))


@pytest.mark.parametrize(
    ("headings", "middles", "told"),
    [
        ([350, 10], [0.0], True), ([-170, 170], [180.0], True), ([0, 360], [180.0], False),
        ([350, 10, 40], [0.0, 25.0], True), ([700, 20], [0.0], False),
    ],
)  # fmt: skip
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
    assert any("the shorter direction" in note for note in notes) == told


def _turned(scene: SceneDescription, control: Control, share: float) -> tuple[Tensor, Tensor]:
    """Sine and cosine of how far the object is turned."""
    turn = placed(control, share)[:3, :3] @ torch.linalg.inv(
        torch.from_numpy(compute_object_to_world(scene)).float()[:3, :3]
    )
    return turn[1, 0], turn[0, 0]


def test_of_several_paths_each_configuration_has_one_as_it_is_alone(scene: SceneDescription, tmp_path: Path) -> None:
    (tmp_path / "way.csv").write_text(WAY)
    names = ["approach", "orbit+pass", str(tmp_path / "way.csv")]
    several = bound(scene, path=",".join(names))
    assert [slot.parameter.name for slot in several.parameter_slots] == ["time", "way"] and several.start.shape == (2,)
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
        ("tum", "optical", "z", (0.0, 0.0, 0.0)), ("tum, real part first", "optical", "z", (0.0, 0.0, 0.0)),
        ("tum in nanoseconds", "opengl", "y", (0.0, 0.0, 0.0)), ("tum", "optical", "-y", (1.0, 2.0, 3.0)),
        ("euroc", "euroc", "z", (4e5, 5e6, 100.0)), ("euroc, all columns", "flu", "z", (0.0, 0.0, 0.0)),
        ("euroc", "frd", "-z", (0.0, 0.0, 0.0)), ("kitti", "optical", "-y", (20.0, 0.0, 0.0)),
    ],
)  # fmt: skip
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


TUM_ROW = "1 6 0 1 -0.5 -0.5 0.5 0.5\n"
NO_WAYS = [
    "",
    "time,x,y,z,look_x\n0,1,1,1,0\n1,1,1,1,0\n",
    "time,x,y,z\n0,1,1," + 200_000 * "1" + "\n",
    "time,x,y,z\n0,1,1,1\n",
    "time,x,y,z\n0,1,1,1\n1,a,1,1\n",
    "time,x,y,z\n0,1,1,1\n0,1,1,1\n",
    "time,x,y,z\nnan,1,1,1\n1,1,1,1\n",
    "time,x,y,z\n0,1,1,1\n1e300,1,1,1\n",
    "time,x,y,z\n0,1,1,1\n1e-30,1,1,1\n",
    "time,x,y,z\n0,1,1,1\n1,1e300,1,1\n",
]
NO_TRAJECTORIES = [
    "0 6 0 1 -0.5 -0.5 0.5 0.7\n" + TUM_ROW,
    "0 6 0 1 nan 0 0 1\n" + TUM_ROW,
    TUM_ROW + TUM_ROW,
    "0 6 0 1 0 0 0 1\n5000000000 6 0 1 0 0 0 1\n",
    "0 6e6 0 1 0 0 0 1\n" + TUM_ROW,
    TUM_ROW + "2 6 0 1\n",
    "1 2 3\n4 5 6\n",
    "1,6,0,1,-0.5,-0.5,0.5,0.5\n2,5,0,1,-0.5,-0.5,0.5,0.5\n",
    HEADER.replace("[ns]", "[h]") + "\n1,6,0,1,0.5,-0.5,-0.5,0.5\n" * 2,
    "1 0 0 0 0 1 0 0 0 0 2 0\n" * 2,
    1_100 * "1 " + "\n",
]


@pytest.mark.parametrize("text", NO_WAYS + NO_TRAJECTORIES)
def test_a_file_that_is_no_way_and_no_trajectory_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text(text)
    with pytest.raises(FileFormatError, match=file.name):
        PathControl(path=str(file))
