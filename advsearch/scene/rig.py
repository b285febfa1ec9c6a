"""Rigs: several cameras that take pictures of one configuration, at the same time or
one after the other (a clip).

The first camera is the scene's own, which controls and paths move; the others are
mounted on it, or stand around the object at the same height and distance. Files are a
plain list of ours, Kalibr's camchain with its extrinsics, frames of nerfstudio's
transforms.json, or COLMAP's images.txt with the cameras.txt beside it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import FileFormatError
from advsearch.scene.assets import Doubles, pose_of
from advsearch.scene.camera_files import LARGEST_JSON, OF_A_FRAME, read_camera
from advsearch.scene.camera_model import CameraModel
from advsearch.scene.geometry import rotation
from advsearch.scene.skeleton import entries_of_turn
from advsearch.trust.stored_files import parse_json, parsed, present_text, read_text
from advsearch.trust.yaml_text import LARGEST, parse_yaml

MOST_CAMERAS = 32
FARTHEST = 1e4  # metres, or object sizes, that a camera may be from the first
KEYS = ("name", "place", "turn", "around", "fov", "later")
LATEST = 60.0  # seconds after the first picture
# from x to the right, y down, z ahead to Mitsuba's: left, up, ahead
AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From nerfstudio's axes of a camera, x to the right, y up, z back, to x to the right,
y down, z ahead.
"""
# by which the positions of a file may have been scaled, and one over it
SMALLEST_SCALE = 1e-6
COLMAPS = "images.txt"
MOST_BYTES = 1 << 26  # of COLMAP's images, whose lines of points are skipped
STEP = "T_cn_cnm1"  # Kalibr's: from points of the camera before to points of this one


@dataclass(frozen=True, eq=False)
class Mount:
    """One camera of a rig."""

    name: str
    # (4, 4) from its axes, x to the right, y down, z ahead, to the first's; metres, or
    # object sizes
    pose: Doubles
    # degrees that it stands further around the object, counter-clockwise from above
    around: float = 0.0
    fov: float | None = None  # degrees along the larger side; None for the first's
    model: CameraModel | None = None  # intrinsics and distortion; None for the first's
    # seconds after the first that it takes its picture, along the path of a control
    later: float = 0.0

    def seen(
        self, inputs: Mapping[str, Tensor], first: Tensor, middle: Tensor, metres: float
    ) -> dict[str, Tensor]:
        """Return scene inputs as this camera sees them, of those that the `first`
        camera sees, whose pose is (4, 4) where they have none, around the middle (3,)
        of the object; a unit of the scene is so many metres long.
        """
        pose = torch.from_numpy(AXES @ self.pose @ AXES).float()
        pose[:3, 3] /= metres
        turn = torch.eye(4)
        turn[:3, :3] = torch.from_numpy(rotation(self.around, 0.0, 0.0))
        turn[:3, 3] = middle - turn[:3, :3] @ middle
        seen = {
            **inputs,
            "camera.to_world": turn @ inputs.get("camera.to_world", first) @ pose,
        }
        if self.fov is not None:
            seen["camera.fov"] = torch.tensor([self.fov])
        if self.model is not None:
            seen["camera.lens"] = torch.tensor(self.model.numbers, dtype=torch.float32)
        return seen


def read_rig(spec: str) -> tuple[Mount, ...]:
    """Read the cameras of a rig; empty where a file has one camera, or one of its
    cameras is named (``#cam1``). Of a transforms.json, frames are named by their
    number, the first one first: ``transforms.json#0,4,8``. Of an images.txt all images
    are cameras, or those named by their IMAGE_ID: ``images.txt#3,7``. Raises
    FileFormatError: more than `MOST_CAMERAS`, numbers that no camera has, or models of
    different kinds.
    """
    path, _, which = spec.partition("#")
    if Path(path).name == COLMAPS:
        return _of_colmap(path, which)
    if Path(path).suffix.lower() == ".json" and "," in which:
        return _of_transforms(path, which)
    if which or Path(spec).suffix.lower() not in (".yaml", ".yml"):
        return ()
    try:
        data = parse_yaml(read_text(Path(spec), "a camera file", LARGEST))
    except (OSError, ValueError):
        return ()  # `read_camera` says what is wrong with it
    if not isinstance(data, dict):
        return ()
    listed = data.get("cameras")
    if isinstance(listed, list):
        if set(data) != {"cameras"}:
            raise FileFormatError(
                f"{spec}: expected `cameras` alone, got "
                f"{', '.join(map(str, data))[:80]}"
            )
        mounts = tuple(
            _of_entry(spec, number, camera) for number, camera in enumerate(listed)
        )
    else:
        mounts = _of_camchain(spec, data)
    if mounts and not 2 <= len(mounts) <= MOST_CAMERAS:
        raise FileFormatError(
            f"{spec}: expected 2 to {MOST_CAMERAS} cameras, got {len(mounts)}"
        )
    if len({mount.name for mount in mounts}) < len(mounts):
        raise FileFormatError(f"{spec}: expected a name of its own for each camera")
    if mounts and (
        not np.allclose(mounts[0].pose, np.eye(4))
        or mounts[0].around
        or mounts[0].later
    ):
        raise FileFormatError(
            f"{spec}: the first camera is the scene's own; it takes "
            "no place, turn, around or later"
        )
    return mounts


def _of_entry(spec: str, number: int, given: Any) -> Mount:
    where = f"{spec}: camera {number + 1}"
    if not isinstance(given, dict) or not set(given) <= set(KEYS):
        raise FileFormatError(
            f"{where}: expected entries among {', '.join(KEYS)}, got "
            f"{str(given)[:80]!r}"
        )
    name = given.get("name", f"camera {number + 1}")
    if not isinstance(name, str) or not 0 < len(name) <= 40:
        raise FileFormatError(
            f"{where}: name: expected a short text, got {str(name)[:80]!r}"
        )
    yaw, pitch, roll = _numbers(where, "turn", given.get("turn", [0.0] * 3), 3, 3600.0)
    # about y, x and z
    turn = (
        rotation(0.0, yaw, 0.0) @ rotation(0.0, 0.0, pitch) @ rotation(roll, 0.0, 0.0)
    )
    pose = pose_of(
        turn, _numbers(where, "place", given.get("place", [0.0] * 3), 3, FARTHEST)
    )
    (around,) = _numbers(where, "around", [given.get("around", 0.0)], 1, 3600.0)
    fov = (
        _numbers(where, "fov", [given["fov"]], 1, 170.0)[0] if "fov" in given else None
    )
    if fov is not None and fov < 1.0:
        raise FileFormatError(f"{where}: fov: expected 1 to 170 degrees, got {fov:g}")
    (later,) = _numbers(where, "later", [given.get("later", 0.0)], 1, LATEST)
    if later < 0.0:
        raise FileFormatError(
            f"{where}: later: expected 0 to {LATEST:g} seconds, got {later:g}"
        )
    return Mount(name, pose, around, fov, later=later)


def _numbers(where: str, key: str, given: Any, count: int, most: float) -> list[float]:
    fits = isinstance(given, list) and len(given) == count
    if not fits or not all(
        type(x) in (int, float) and math.isfinite(x) and abs(x) <= most for x in given
    ):
        raise FileFormatError(
            f"{where}: {key}: expected {count} numbers up to "
            f"{most:g}, got {str(given)[:80]!r}"
        )
    return list(map(float, given))


def _of_camchain(spec: str, data: Mapping[str, Any]) -> tuple[Mount, ...]:
    cameras = {
        name: camera
        for name, camera in data.items()
        if isinstance(camera, dict) and "intrinsics" in camera
    }
    names = sorted(cameras, key=lambda name: (len(str(name)), str(name)))
    if (
        len(names) < 2
        or len(names) > MOST_CAMERAS
        or not all(STEP in cameras[name] for name in names[1:])
    ):
        return ()
    poses = [np.eye(4)]
    for name in names[1:]:
        poses.append(
            poses[-1]
            @ np.linalg.inv(_rigid(f"{spec}: {name}", STEP, cameras[name][STEP]))
        )
    return _mounted(
        spec, names, poses, [read_camera(f"{spec}#{name}") for name in names]
    )


def _of_transforms(path: str, which: str) -> tuple[Mount, ...]:
    data = parsed(
        path, present_text(path, "a camera file", LARGEST_JSON), "JSON", parse_json
    )
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not all(
        isinstance(frame, dict) for frame in frames
    ):
        raise FileFormatError(
            f"{path}: expected `frames`, a list with a camera each, "
            "as nerfstudio writes it"
        )
    names = _named(path, which, [str(number) for number in range(len(frames))])
    chosen = {name: frames[int(name)] for name in names}
    scale = _read_applied_scale(path, data)
    poses = list[Doubles]()
    for name, frame in chosen.items():
        pose = (
            _rigid(
                f"{path}: frame {name}",
                "transform_matrix",
                frame.get("transform_matrix"),
            )
            @ FROM_OPENGL
        )
        pose[:3, 3] /= scale
        poses.append(pose)
    lenses = [
        {key: frame[key] for key in frame if key in OF_A_FRAME}
        for frame in chosen.values()
    ]
    first = read_camera(f"{path}#{names[0]}")
    each = zip(names, lenses, strict=True)
    models = [
        first if lens == lenses[0] else read_camera(f"{path}#{name}")
        for name, lens in each
    ]
    return _mounted(path, names, poses, models)


def _read_applied_scale(path: str, data: Mapping[str, Any]) -> float:
    """Return by what the positions of a transforms.json were multiplied before it was
    written.

    nerfstudio's `applied_scale`, times the scale within its `applied_transform`. A
    rotation and a shift of the world change nothing between two cameras. Instant NGP's
    `scale` and `offset` are applied by who reads the file, so that its positions are
    without them.
    """
    scale = 1.0
    if data.get("applied_scale") is not None:
        (scale,) = _numbers(
            path, "applied_scale", [data["applied_scale"]], 1, 1.0 / SMALLEST_SCALE
        )
    if data.get("applied_transform") is not None:
        given = data["applied_transform"]
        rows = (
            given
            if isinstance(given, list) and all(isinstance(row, list) for row in given)
            else []
        )
        count = 12 if len(rows) == 3 else 16
        numbers = _numbers(
            path,
            "applied_transform",
            [number for row in rows for number in row],
            count,
            FARTHEST,
        )
        turn = np.reshape(numbers, (-1, 4))[:3, :3]
        turn_scale = abs(float(np.linalg.det(turn))) ** (1.0 / 3.0)
        if not np.allclose(
            turn @ turn.T, turn_scale**2 * np.eye(3), atol=1e-3 * turn_scale**2
        ):
            raise FileFormatError(
                f"{path}: applied_transform: expected a rotation, a shift and a scale, "
                "got another map"
            )
        scale *= turn_scale
    if not SMALLEST_SCALE <= scale <= 1.0 / SMALLEST_SCALE:
        wanted = f"from {SMALLEST_SCALE:g} to {1.0 / SMALLEST_SCALE:g}"
        raise FileFormatError(
            f"{path}: applied_scale: expected a scale {wanted}, got "
            f"{scale:g}; correct it"
        )
    return scale


def _of_colmap(path: str, which: str) -> tuple[Mount, ...]:
    """COLMAP's images.txt: in every second line a rotation (quaternion, real part
    first) and a shift from the world to the camera, whose model is in the cameras.txt
    beside it.
    """
    text = present_text(path, "COLMAP's images", MOST_BYTES)
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    rows = {words[0]: words for line in lines[::2] if (words := line.split(maxsplit=9))}
    if not rows:
        raise FileFormatError(
            f"{path}: expected 2 to {MOST_CAMERAS} different cameras, got none"
        )
    if len(rows) < sum(bool(line.strip()) for line in lines[::2]):
        raise FileFormatError(
            f"{path}: expected each image once, got one with the "
            "same number twice; correct the file"
        )
    names = _named(path, which or ",".join(rows), list(rows))
    poses = list[Doubles]()
    models = list[CameraModel]()
    for name in names:
        where = f"{path}: image {name[:40]}"
        words = rows[name]
        if len(words) != 10:
            raise FileFormatError(
                f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got "
                f"{len(words)} words; a line of "
                "points, perhaps an empty one, stands between two images"
            )
        try:
            numbers = list(map(float, words[1:8]))
        except ValueError:
            numbers = []
        w, x, y, z, *shift = _numbers(where, "pose", numbers, 7, FARTHEST)
        if not 0.99 < (length := math.sqrt(w * w + x * x + y * y + z * z)) < 1.01:
            raise FileFormatError(
                f"{where}: expected a quaternion of length 1, got one of {length:.3g}"
            )
        turn = np.reshape(
            entries_of_turn(x / length, y / length, z / length, w / length), (3, 3)
        )
        poses.append(np.asarray(np.linalg.inv(pose_of(turn, shift)), np.float64))
        models.append(read_camera(f"{Path(path).with_name('cameras.txt')}#{words[8]}"))
    return _mounted(path, names, poses, models)


def _named(path: str, which: str, known: Sequence[str]) -> list[str]:
    names = list(map(str.strip, which.split(",")))
    if not 2 <= len(names) <= MOST_CAMERAS or len(set(names)) < len(names):
        raise FileFormatError(
            f"{path}: expected 2 to {MOST_CAMERAS} different cameras, got {len(names)}"
        )
    if unknown := [name for name in names if name not in known]:
        listed = ", ".join(known[:8]) + (", ..." if len(known) > 8 else "")
        raise FileFormatError(
            f"{path}: expected some of its cameras {listed}, got {unknown[0][:40]!r}"
        )
    return names


def _mounted(
    spec: str,
    names: Sequence[object],
    poses: Sequence[Doubles],
    models: Sequence[CameraModel],
) -> tuple[Mount, ...]:
    """Cameras whose poses go from their coordinates (x to the right, y down, z ahead)
    to common ones.
    """
    if len(kinds := sorted({model.kind for model in models})) > 1:
        raise FileFormatError(
            f"{spec}: expected cameras of one model, got {' and '.join(kinds)}"
        )
    each = zip(names, poses, models, strict=True)
    return tuple(
        Mount(str(name), np.linalg.inv(poses[0]) @ pose, model=model)
        for name, pose, model in each
    )


def _rigid(where: str, key: str, given: Any) -> Doubles:
    rows = (
        given
        if isinstance(given, list) and all(isinstance(row, list) for row in given)
        else []
    )
    step = np.array(
        _numbers(where, key, [number for row in rows for number in row], 16, FARTHEST)
    ).reshape(4, 4)
    turn = step[:3, :3]
    last = step[3]
    turns = (
        np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) and np.linalg.det(turn) > 0.0
    )
    if not turns or not np.allclose(last, [0.0, 0.0, 0.0, 1.0]):
        raise FileFormatError(
            f"{where}: {key}: expected a rotation and a shift, got another map"
        )
    return step
