"""Rigs: several cameras that take their pictures of one configuration at the same time.

The first camera is the scene's own, which controls and paths move; the others are mounted on it, or stand around the
object at the same height and distance. Files are a plain list of ours, or Kalibr's camchain with its extrinsics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import FileFormatError
from advsearch.files import read_text
from advsearch.scene.assets import Doubles
from advsearch.scene.camera_files import read_camera
from advsearch.scene.camera_model import CameraModel
from advsearch.yaml_text import LARGEST, parse_yaml

MOST_CAMERAS = 16
FARTHEST = 1e4
"""Metres, or object sizes, that a camera may be from the first."""
KEYS = ("name", "place", "turn", "around", "fov")
AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
"""From x to the right, y down, z ahead to Mitsuba's: x to the left, y up, z ahead."""
STEP = "T_cn_cnm1"
"""Kalibr's: from points of the camera before to points of this one."""


@dataclass(frozen=True, eq=False)
class Mount:
    """One camera of a rig.

    Attributes:
        name: of the camera.
        pose: (4, 4) from its coordinates to those of the first: x to the right, y down, z ahead; in metres where the
            object's size is known, else in object sizes.
        around: degrees that it stands further around the object than the first, counter-clockwise from above.
        fov: degrees along the larger side; None for the first's.
        model: intrinsics and distortion; None for the first's.
    """

    name: str
    pose: Doubles
    around: float = 0.0
    fov: float | None = None
    model: CameraModel | None = None

    def seen(self, inputs: Mapping[str, Tensor], first: Tensor, middle: Tensor, metres: float) -> dict[str, Tensor]:
        """Return scene inputs as this camera sees them.

        Args:
            inputs: as the first camera does.
            first: (4, 4) pose of the first camera where the inputs have none.
            middle: (3,) of the object, as the scene was described.
            metres: that a unit of the scene is long; 1 where that is not known.
        """
        own = torch.from_numpy(AXES @ self.pose @ AXES).float()
        own[:3, 3] /= metres
        angle = math.radians(self.around)
        turn = torch.eye(4)
        turn[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        turn[:3, 3] = middle - turn[:3, :3] @ middle
        found = {**inputs, "camera.to_world": turn @ inputs.get("camera.to_world", first) @ own}
        if self.fov is not None:
            found["camera.fov"] = torch.tensor([self.fov])
        if self.model is not None:
            found["camera.lens"] = torch.tensor(self.model.numbers, dtype=torch.float32)
        return found


def read_rig(spec: str) -> tuple[Mount, ...]:
    """Read the cameras of a rig; empty where a file has one camera, or one of its cameras is named (``#cam1``).

    Raises:
        FileFormatError: more than `MOST_CAMERAS`, numbers that no camera has, or models of different kinds.
    """
    if "#" in spec or Path(spec).suffix.lower() not in (".yaml", ".yml"):
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
            raise FileFormatError(f"{spec}: expected `cameras` alone, got {', '.join(map(str, data))[:80]}")
        mounts = tuple(_of_entry(spec, number, one) for number, one in enumerate(listed))
    else:
        mounts = _of_camchain(spec, data)
    if mounts and not 2 <= len(mounts) <= MOST_CAMERAS:
        raise FileFormatError(f"{spec}: expected 2 to {MOST_CAMERAS} cameras, got {len(mounts)}")
    if len({one.name for one in mounts}) < len(mounts):
        raise FileFormatError(f"{spec}: expected a name of its own for each camera")
    if mounts and (not np.allclose(mounts[0].pose, np.eye(4)) or mounts[0].around):
        raise FileFormatError(f"{spec}: the first camera is the scene's own; it takes no place, turn or around")
    return mounts


def _of_entry(spec: str, number: int, given: Any) -> Mount:
    where = f"{spec}: camera {number + 1}"
    if not isinstance(given, dict) or not set(given) <= set(KEYS):
        raise FileFormatError(f"{where}: expected entries among {', '.join(KEYS)}, got {str(given)[:80]!r}")
    name = given.get("name", f"camera {number + 1}")
    if not isinstance(name, str) or not 0 < len(name) <= 40:
        raise FileFormatError(f"{where}: name: expected a short text, got {str(name)[:80]!r}")
    yaw, pitch, roll = (math.radians(one) for one in _numbers(where, given, "turn", 3, 3600.0))
    pose = np.eye(4)
    pose[:3, :3] = _about(1, yaw) @ _about(0, pitch) @ _about(2, roll)
    pose[:3, 3] = _numbers(where, given, "place", 3, FARTHEST)
    (around,) = _numbers(where, {"around": [given.get("around", 0.0)]}, "around", 1, 3600.0)
    fov = None
    if "fov" in given:
        (fov,) = _numbers(where, {"fov": [given["fov"]]}, "fov", 1, 170.0)
        if fov < 1.0:
            raise FileFormatError(f"{where}: fov: expected 1 to 170 degrees, got {fov:g}")
    return Mount(name, pose, around, fov)


def _numbers(where: str, given: Mapping[str, Any], key: str, count: int, most: float) -> list[float]:
    found = given.get(key, [0.0] * count)
    fits = isinstance(found, list) and len(found) == count
    if not fits or not all(type(one) in (int, float) and math.isfinite(one) and abs(one) <= most for one in found):
        raise FileFormatError(f"{where}: {key}: expected {count} numbers up to {most:g}, got {str(found)[:80]!r}")
    return [float(one) for one in found]


def _about(axis: int, angle: float) -> Doubles:
    """A rotation about one of the axes, (3, 3)."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[[first, second], [first, second]] = math.cos(angle)
    turn[first, second], turn[second, first] = -math.sin(angle), math.sin(angle)
    return turn


def _of_camchain(spec: str, data: Mapping[str, Any]) -> tuple[Mount, ...]:
    """Kalibr's cameras, each with a step from the one before; empty where it is no such file."""
    cameras = {name: one for name, one in data.items() if isinstance(one, dict) and "intrinsics" in one}
    names = sorted(cameras, key=lambda name: (len(str(name)), str(name)))
    if len(names) < 2 or len(names) > MOST_CAMERAS or not all(STEP in cameras[name] for name in names[1:]):
        return ()
    mounts, pose, kinds = list[Mount](), np.eye(4), set[str]()
    for number, name in enumerate(names):
        model = read_camera(f"{spec}#{name}")
        kinds.add(model.kind)
        if len(kinds) > 1:
            raise FileFormatError(f"{spec}: expected cameras of one model, got {' and '.join(sorted(kinds))}")
        if number:
            rows = [one for row in cameras[name][STEP] for one in row] if _rows(cameras[name][STEP]) else []
            step = np.array(_numbers(f"{spec}: {name}", {STEP: rows}, STEP, 16, FARTHEST)).reshape(4, 4)
            turn = step[:3, :3]
            if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0.0:
                raise FileFormatError(f"{spec}: {name}: {STEP}: expected a rotation and a shift, got another map")
            pose = pose @ np.linalg.inv(step)
        mounts.append(Mount(str(name), pose, model=model))
    return tuple(mounts)


def _rows(given: Any) -> bool:
    return isinstance(given, list) and all(isinstance(row, list) for row in given)
