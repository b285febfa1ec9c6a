"""Rigged glTF and VRM: vertices are where the format's formulas put them, which are written out here once more."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_gltf import FACES, SQUARE, File

import advsearch
from advsearch.controls import make_control, make_space
from advsearch.errors import FileFormatError
from advsearch.scene.description import load_description
from advsearch.scene.importing.objects import import_object
from advsearch.scene.outlines import find_visible_meshes
from advsearch.scene.rigged import SkeletonRig

ROUND, RINGS, RADIUS, HEIGHT = 12, 9, 0.2, 2.0
LOWER, UPPER = 1, 2
"""Nodes of the two bones; node 0 draws the tube, node 3 a plate without skin, node 4 is above all of them."""
TIMES = np.array([0.0, 0.5, 2.0])
TURNS = np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.6, 0.8], [0.5, 0.0, 0.5, -math.sqrt(0.5)]])
SHIFTS = np.array([[0.0, 0.0, 0.0], [0.3, 0.1, 0.0], [0.0, 0.4, 0.2]])  # of the plate, a cubic spline
TANGENTS = np.array([[[0.1, 0.0, 0.0], [0.0, 0.9, 0.3]], [[0.4, 0.0, 0.2], [-0.5, 0.1, 0.0]], [[0.0] * 3, [0.2] * 3]])
SCALES = np.array([[1.0, 1.0, 1.0], [1.2, 1.0, 0.8], [0.7, 1.5, 1.0]])  # of the upper bone, by steps
SHARES = np.array([0.0, 1.0, 0.25])  # of the morph target
PLATE = SQUARE + np.array([1.0, 0.0, 0.0])
ABOVE = {"translation": [0.5, -0.2, 0.1], "rotation": [0.0, 0.6, 0.0, 0.8], "scale": [1.5, 1.5, 1.5]}


def tube() -> tuple[np.ndarray, np.ndarray]:
    """Vertices of a tube that goes up, and its faces."""
    angle, up = np.meshgrid(np.arange(ROUND) / ROUND * 2 * np.pi, np.linspace(0.0, HEIGHT, RINGS))
    points = np.stack([RADIUS * np.sin(angle), up, RADIUS * np.cos(angle)], axis=-1).reshape(-1, 3)
    number = np.arange(ROUND * RINGS).reshape(RINGS, ROUND)
    low, high, following = number[:-1], number[1:], np.roll(number, -1, axis=1)
    sides = np.stack([low, following[:-1], high, following[:-1], following[1:], high], axis=-1)
    return points, sides.reshape(-1)


def shares_of(points: np.ndarray) -> np.ndarray:
    """How much of each vertex the upper bone has."""
    return np.clip((points[:, 1] - 0.6) / 0.8, 0.0, 1.0)


def bulge(points: np.ndarray) -> np.ndarray:
    return points * [1.0, 0.0, 1.0] * (points[:, 1:2] > 1.5)


def figure(weights: str = "f4", **header: Any) -> File:
    """A tube on two bones, with a morph target and a clip, and a plate beside it that the clip moves as a whole."""
    file, (points, faces) = File(), tube()
    upper = shares_of(points)
    shares = np.stack([1.0 - upper, upper, 0 * upper, 0 * upper], axis=1)
    joints = np.tile([0, 1, 0, 0], (len(points), 1))
    file.primitive(
        points,
        faces,
        attributes={
            "JOINTS_0": file.values(joints, "u2" if weights == "u2" else "u1"),
            "WEIGHTS_0": file.values(shares, weights, normalized=weights != "f4"),
        },
        targets=[{"POSITION": file.values(bulge(points))}],
    )
    plate = {"attributes": {"POSITION": file.values(PLATE)}, "indices": file.values(FACES, "u2")}
    file.header["meshes"][0] |= {"extras": {"targetNames": ["fat top"]}}
    file.header["meshes"].append({"primitives": [{**plate, "material": 0}]})
    file.header["nodes"] = [
        {"mesh": 0, "skin": 0, "translation": [7.0, 7.0, 7.0], "scale": [3.0, 1.0, 1.0]},  # does not count
        {"name": "lower", "children": [2], "rotation": [0.0, 0.0, 0.0998334, 0.9950042]},
        {"name": "upper.L", "translation": [0.0, 1.0, 0.0]},
        {"mesh": 1, "name": "plate"},
        {"children": [1, 3, 0], **ABOVE},
    ]
    file.header["scenes"] = [{"nodes": [4]}]
    inverse = [np.eye(4), matrix([0.0, -1.0, 0.0], [0, 0, 0, 1], [1, 1, 1])]
    file.header["skins"] = [
        {"joints": [1, 2], "inverseBindMatrices": file.values(np.stack([one.T.reshape(16) for one in inverse]))}
    ]
    spline = np.stack([TANGENTS[:, 0], SHIFTS, TANGENTS[:, 1]], axis=1).reshape(-1, 3)
    held = [
        (UPPER, "rotation", TURNS, "LINEAR"),
        (UPPER, "scale", SCALES, "STEP"),
        (3, "translation", spline, "CUBICSPLINE"),
    ]
    held.append((0, "weights", SHARES[:, None], "LINEAR"))
    at = file.values(TIMES[:, None])
    file.header["animations"] = [{
        "name": "Bend",
        "samplers": [
            {"input": at, "output": file.values(values), "interpolation": kind} for _, _, values, kind in held
        ],
        "channels": [
            {"sampler": k, "target": {"node": node, "path": path}} for k, (node, path, _, _) in enumerate(held)
        ],
    }]  # fmt: skip
    file.header |= header
    return file


def matrix(shift: Any, turn: Any, scale: Any) -> np.ndarray:
    x, y, z, w = turn
    found = np.eye(4)
    found[:3, :3] = np.array([
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]) @ np.diag(scale)  # fmt: skip
    found[:3, 3] = shift
    return found


def spherical(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    second = second if first @ second >= 0.0 else -second
    angle = math.acos(min(1.0, float(first @ second)))
    if angle < 1e-9:
        return first
    return (math.sin((1 - share) * angle) * first + math.sin(share * angle) * second) / math.sin(angle)


def expected(seconds: float | None, fat: float | None = None, turn: np.ndarray | None = None) -> np.ndarray:
    """All vertices in the file's axes; `turn` (3, 3) is put before the upper bone's own rotation."""
    rotation, scale, shift, share = np.eye(4)[3], np.ones(3), np.zeros(3), 0.0
    if seconds is not None:
        k = 0 if seconds < TIMES[1] else 1
        span = TIMES[k + 1] - TIMES[k]
        t = min(1.0, (seconds - TIMES[k]) / span)
        rotation = spherical(TURNS[k], TURNS[k + 1], t)
        scale = SCALES[2] if seconds >= TIMES[2] else SCALES[k]
        share = SHARES[k] + t * (SHARES[k + 1] - SHARES[k])
        shift = (
            (2 * t**3 - 3 * t**2 + 1) * SHIFTS[k]
            + span * (t**3 - 2 * t**2 + t) * TANGENTS[k, 1]
            + (-2 * t**3 + 3 * t**2) * SHIFTS[k + 1]
            + span * (t**3 - t**2) * TANGENTS[k + 1, 0]
        )
    above = matrix(ABOVE["translation"], ABOVE["rotation"], ABOVE["scale"])
    lower = above @ matrix([0, 0, 0], [0.0, 0.0, 0.0998334, 0.9950042], [1, 1, 1])
    own = matrix([0, 1, 0], rotation, scale)
    if turn is not None:
        own[:3, :3] = turn @ own[:3, :3]
    upper = lower @ own @ matrix([0, -1, 0], [0, 0, 0, 1], [1, 1, 1])
    points, _ = tube()
    points = points + (share if fat is None else fat) * bulge(points)
    found = []
    for point, weight in zip(points, shares_of(points), strict=True):
        joined = (1.0 - weight) * lower + weight * upper
        found.append((joined @ [*point, 1.0])[:3])
    plate = above @ matrix(shift, [0, 0, 0, 1], [1, 1, 1])
    found += [(plate @ [*point, 1.0])[:3] for point in PLATE]
    return np.array(found)


def in_mesh(points: np.ndarray) -> np.ndarray:
    """File to mesh: z up, +z of the file ahead, the rest pose 1 large, on the ground."""
    rest = expected(None) @ UP.T
    low, high = rest.min(axis=0), rest.max(axis=0)
    return np.asarray((points @ UP.T - [*(low + high)[:2] / 2, low[2]]) / (high - low).max())


UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def moved(path: Path, clip: str | None = None, /, **values: float) -> np.ndarray:
    """Where the mesh's vertices are, in the file's order."""
    mesh = import_object(path).mesh
    assert isinstance(mesh.rig, SkeletonRig)
    offsets = mesh.rig.offsets({name.replace("__", "."): torch.tensor(v) for name, v in values.items()}, clip)
    apart = np.linalg.norm(mesh.vertices[None] - in_mesh(expected(None))[:, None], axis=2)
    assert apart.min(axis=1).max() < 1e-5 and apart.min(axis=0).max() < 1e-5, "the rest pose is not the format's"
    return np.asarray((mesh.vertices + offsets.numpy())[apart.argmin(axis=1)])


@pytest.mark.parametrize("kind", ["f4", "u1", "u2"])
@pytest.mark.parametrize("seconds", [0.0, 0.2, 0.5, 1.1, 1.9, 2.0])
def test_a_clip_moves_vertices_as_the_format_says(kind: str, seconds: float, tmp_path: Path) -> None:
    found = moved(figure(kind).write(tmp_path), "Bend", time=seconds / 2.0)
    assert np.abs(found - in_mesh(expected(seconds))).max() < {"f4": 2e-6, "u1": 3e-3, "u2": 2e-5}[kind]


def test_a_weight_of_ones_own_takes_the_place_of_the_clips(tmp_path: Path) -> None:
    path = figure().write(tmp_path)
    found = moved(path, "Bend", time=0.5, **{"fat-top__weight": 0.75})
    assert np.abs(found - in_mesh(expected(1.0, fat=0.75))).max() < 2e-6
    alone = moved(path, None, **{"fat-top__weight": 1.0})
    assert np.abs(alone - in_mesh(expected(None, fat=1.0))).max() < 2e-6


def about(axis: int, degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    found = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    found[[a, a, b, b], [a, b, a, b]] = c, -s, s, c
    return found


def test_joints_turn_about_the_axes_that_the_object_has_at_rest(tmp_path: Path) -> None:
    """Whatever turns and scales are above a joint: at rest, what hangs on it turns rigidly about the joint's place."""
    path = figure().write(tmp_path)
    rest = in_mesh(expected(None))
    joint = in_mesh(
        (matrix(**_above()) @ matrix([0, 0, 0], [0, 0, 0.0998334, 0.9950042], [1, 1, 1]) @ [0, 1, 0, 1])[None, :3]
    )
    ends = np.append(shares_of(tube()[0]) == 1.0, np.zeros(len(SQUARE), bool))
    for axis, name in enumerate("xyz"):
        found = moved(path, **{f"upper-L__{name}": 40.0})
        wanted = joint + (rest - joint) @ about(axis, 40.0).T
        assert np.abs(found - wanted)[ends].max() < 3e-6, name
        assert np.abs(found - rest)[shares_of(tube()[0]).tolist().index(0.0)].max() < 1e-6
    both = moved(path, **{"upper-L__x": 30.0, "upper-L__z": -50.0})
    wanted = joint + (rest - joint) @ (about(2, -50.0) @ about(0, 30.0)).T
    assert np.abs(both - wanted)[ends].max() < 3e-6


def _above() -> dict[str, Any]:
    return {"shift": ABOVE["translation"], "turn": ABOVE["rotation"], "scale": ABOVE["scale"]}


@pytest.mark.parametrize(
    ("clip", "values"), [("Bend", {"time": 0.4}), (None, {"upper-L.y": 20.0}), ("Bend", {"fat-top.weight": 0.3})]
)
def test_derivatives_are_those_of_differences(clip: str | None, values: dict[str, float], tmp_path: Path) -> None:
    rig = import_object(figure().write(tmp_path)).mesh.rig
    assert isinstance(rig, SkeletonRig)
    ((name, at),) = values.items()
    number, side = torch.tensor(at, dtype=torch.float64, requires_grad=True), torch.Generator().manual_seed(1)
    random = torch.randn(len(rig.pose({})), 3, generator=side, dtype=torch.float64)
    (slope,) = torch.autograd.grad((rig.pose({name: number}, clip) * random).sum(), number)
    up, down = (float((rig.pose({name: number.detach() + h}, clip) * random).sum()) for h in (1e-6, -1e-6))
    assert float(slope) == pytest.approx((up - down) / 2e-6, rel=1e-5)


def space_of(path: Path, **settings: object) -> Any:
    return make_space([make_control("body", settings)], load_description(str(path)))


@pytest.mark.island("advsearch.controls.body")
def test_by_itself_the_control_plays_the_first_clip(tmp_path: Path) -> None:
    path = figure().write(tmp_path)
    space = space_of(path)
    assert space.describe(torch.tensor([0.25])) == {
        "body.time": {"value": 0.25, "unit": "1"},
        "body.seconds": {"value": pytest.approx(0.5), "unit": "s"},
    }
    still = space_of(path, **{"upper-L.x": [-30, 30]})
    assert still.start.tolist() == [0.5] and float(still.inputs(still.start)["object.offsets"].abs().max()) < 1e-9
    played = space_of(path, clip="Bend", **{"upper-L.x": [-30, 30]})
    assert float(played.inputs(played.start)["object.offsets"].abs().max()) < 1e-9  # time 0 is the rest pose here


@pytest.mark.parametrize("old", [True, False])
def test_bones_of_vrm_have_their_names(old: bool, tmp_path: Path) -> None:
    bones = {"hips": {"node": LOWER}, "leftUpperArm": {"node": UPPER}}
    held = {"VRMC_vrm": {"humanoid": {"humanBones": bones}}}
    if old:
        held = {"VRM": {"humanoid": {"humanBones": [{"bone": name, **one} for name, one in bones.items()]}}}  # type: ignore[dict-item]
    path = figure(extensions=held, extensionsUsed=list(held)).write(tmp_path).rename(tmp_path / "someone.vrm")
    asset = import_object(path)
    assert isinstance(asset.mesh.rig, SkeletonRig)
    assert {"hips", "leftUpperArm"} <= set(asset.mesh.rig.node_of_joint)
    assert len(asset.warnings) == 1 and "Bend" in asset.warnings[0]


@pytest.mark.medium
@pytest.mark.usefixtures("two_threads")
def test_true_boxes_follow(tmp_path: Path) -> None:
    """What is seen lies where a pinhole, worked out here in metres, sees the format's vertices."""
    path, side = figure().write(tmp_path), 160
    view = {"camera.distance": 9.0, "camera.azimuth": 20.0, "camera.elevation": 10.0, "camera.fov": 50.0}
    scene = advsearch.load_scene(str(path), settings=view)
    renderer = scene.renderer([make_control("body", {"clip": "Bend", "time": [0, 1]})], resolution=side, denoise="none")
    metres = np.ptp(expected(None), axis=0).max()
    azimuth, elevation = math.radians(20.0), math.radians(10.0)
    level = math.cos(elevation)
    back = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    target = np.array([0.0, 0.0, np.ptp(expected(None)[:, 1]) / 2.0])
    for time in (0.0, 0.8):
        relative = in_mesh(expected(2.0 * time)) * metres - (target + 9.0 * back)
        focal = side / 2.0 / math.tan(math.radians(25.0)) / -(relative @ back)
        columns = side / 2.0 + focal * (relative @ right)
        rows = side / 2.0 - focal * (relative @ np.cross(back, right))
        (found,) = find_visible_meshes(renderer, torch.tensor([time]))
        wanted = columns.min(), rows.min(), columns.max(), rows.max()
        assert np.abs(np.array(found.box) - wanted).max() <= 1.0, (found.box, wanted)


def _set(*keys: Any, value: Any) -> Callable[[File], None]:
    def change(file: File) -> None:
        entry: Any = file.header
        for key in keys[:-1]:
            entry = entry[key]
        entry[keys[-1]] = value(file) if callable(value) else value

    return change


SAMPLER = ("animations", 0, "samplers", 0)


@pytest.mark.medium
@pytest.mark.parametrize(
    "change",
    [
        _set(*SAMPLER, "input", value=lambda f: f.values(TIMES[::-1, None])),
        _set(*SAMPLER, "input", value=lambda f: f.values(np.full((3, 1), np.nan))),
        _set(*SAMPLER, "input", value=lambda f: f.values(TURNS)),
        _set(*SAMPLER, "output", value=lambda f: f.values(TURNS[:2])),
        _set(*SAMPLER, "output", value=lambda f: f.values(np.full((3, 4), np.inf))),
        _set(*SAMPLER, "output", value=999),
        _set("animations", 0, "channels", 0, "sampler", value=9),
        _set("animations", 0, "channels", 0, "target", "node", value=99),
        _set("nodes", 0, "weights", value=[0.0, 1.0]),
        _set("nodes", UPPER, "children", value=[LOWER]),
        _set("meshes", 0, "primitives", 0, "targets", value=lambda f: [{"POSITION": f.values(tube()[0] * np.nan)}]),
        _set("meshes", 0, "primitives", 0, "targets", value=[{"POSITION": 0}] * 400_000),
        _set("extensions", value={"VRMC_vrm": {"humanoid": {"humanBones": {"hips": {"node": 77}}}}}),
    ],
)
def test_what_is_no_rig_is_refused(change: Callable[[File], None], tmp_path: Path) -> None:
    file = figure()
    change(file)
    with pytest.raises(FileFormatError, match=r"made\.glb"):
        import_object(file.write(tmp_path))
