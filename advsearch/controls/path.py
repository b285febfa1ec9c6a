"""The `path` control: the camera or the object travels, and `time` says where along the way it is.

A frame of a drive is one time. So `--over path` finds one answer for a whole drive, and a grid over `path.time` has its
frames in order. Where the scene as it is described is a frame, that is the clean one: the end of `approach`, the middle
of `pass`, the beginning of `orbit`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from advsearch.controls.base import Choice, Parameter, Value
from advsearch.controls.numbers import NumberControl, Values
from advsearch.errors import FileFormatError, InputError
from advsearch.files import read_text
from advsearch.scene.description import ORBIT_CAMERA, SceneDescription
from advsearch.scene.framing import middle
from advsearch.scene.geometry import affine, camera_to_world, object_to_world
from advsearch.scene.settings import GEOMETRIC, ORBIT, moving

APPROACH, PASS, TURN = "approach", "pass", "orbit"
PATHS = (APPROACH, PASS, TURN)
CLEAN_AT = {APPROACH: 1.0, PASS: 0.5, TURN: 0.0}
"""Share of the time at which the scene is as it is described."""

REACH, SECONDS = 4.0, 10.0
SHORTEST, LONGEST = 1e-3, 3600.0
"""Seconds between waypoints at least, and of a path at most."""
COLUMNS, LOOKING = ("time", "x", "y", "z"), ("look_x", "look_y", "look_z")
MOST_WAYPOINTS, MOST_BYTES = 100_000, 16 * 2**20
FARTHEST = 1e5
"""Object sizes that a waypoint may be away."""


@dataclass(frozen=True, eq=False)
class Waypoints:
    """A way from a file.

    Attributes:
        times: (n,) ascending, seconds from the first.
        places: (n, 3) object sizes from the middle of where the object stands; of an object that moves, its shift.
        targets: (n, 3) what the camera looks at, from the same middle; None for the middle itself.
        headings: (n,) degrees that the object is turned by; None for none.
    """

    times: Tensor
    places: Tensor
    targets: Tensor | None
    headings: Tensor | None

    def at(self, time: Tensor, of: Tensor) -> Tensor:
        """Return a column, or several, at a time, linear between waypoints; differentiable in the time."""
        place = int(torch.searchsorted(self.times, time.detach().clamp(self.times[0], self.times[-1]), right=True))
        place = min(max(place, 1), len(self.times) - 1)
        begin, end = self.times[place - 1], self.times[place]
        return torch.lerp(of[place - 1], of[place], ((time - begin) / (end - begin)).clamp(0.0, 1.0))


class PathControl(NumberControl):
    """The camera or the object travels along a path."""

    kind: ClassVar[str] = "path"
    summary: ClassVar[str] = "The camera or the object travels along a path; a frame is a time."
    parameters: ClassVar[tuple[Parameter, ...]] = (
        moving(ORBIT, "time", "s", 0.0, LONGEST, "where the scene is as it is", "Time since the path began."),
    )
    choices: ClassVar[tuple[Choice, ...]] = (
        Choice(
            "path",
            APPROACH,
            "approach (straight up to where it stands), pass (straight past it), orbit (once around), or a .csv file "
            "with columns time, x, y, z.",
            "path",
        ),
        Choice("moves", "camera", "What travels: camera or object.", options=("camera", "object")),
        Choice("seconds", SECONDS, "How long it takes; a file says so itself.", most=LONGEST),
        Choice(
            "reach",
            REACH,
            "How far it goes, in distances of the scene's own camera: where approach begins, half of what pass takes.",
            most=1000.0,
        ),
    )

    def check_choices(self) -> None:
        asked = self.chosen["path"]
        if asked not in PATHS and not (isinstance(asked, str) and asked.lower().endswith(".csv")):
            raise InputError(f"{self.name}.path: expected {', '.join(PATHS)} or a .csv file, got {asked!r}")
        self._waypoints = None
        if asked not in PATHS:
            self._waypoints = read_waypoints(Path(str(asked)), of_object=self.chosen["moves"] == "object")
            if "seconds" in self._given or "reach" in self._given:
                raise InputError(
                    f"{self.name}: the file {asked} says how long and how far; leave seconds and reach out"
                )
            self.chosen["seconds"] = float(self._waypoints.times[-1])

    @property
    def seconds(self) -> float:
        """How long the path takes."""
        return float(str(self.chosen["seconds"]))

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        if self.chosen["moves"] == "camera" and scene.camera != ORBIT_CAMERA:
            raise InputError(
                f"`controls` {self.name}: moves the camera, and the scene is seen by its camera {scene.camera!r}; give "
                f"moves=object, or have it seen by {ORBIT_CAMERA!r}"
            )
        return scene

    def default(self, scene: SceneDescription, parameter: Parameter) -> float | str:
        return CLEAN_AT.get(str(self.chosen["path"]), 0.0) * self.seconds

    def search_range(self, scene: SceneDescription, parameter: Parameter) -> tuple[float, float] | None:
        return 0.0, self.seconds

    def estimators(self, scene: SceneDescription, parameter: Parameter) -> tuple[str, ...]:
        return GEOMETRIC if self.chosen["moves"] == "object" else ORBIT

    def scene_inputs(self, scene: SceneDescription, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Tensor]:
        own = torch.from_numpy(camera_to_world(scene)).float().to(values["time"].device)
        if self.chosen["moves"] == "camera":
            place, target = self._camera(scene, own, values["time"])
            return {"camera.to_world": looking(place, target, scene.number("camera.roll"))}
        shift, heading = self._object(scene, own, values["time"])
        return {"object.to_world": turned(scene, shift, heading)}

    def measured(self, scene: SceneDescription, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Value]:
        time = values["time"]
        own, center = torch.from_numpy(camera_to_world(scene)).float().to(time.device), _middle(scene).to(time.device)
        if self.chosen["moves"] == "camera":
            away = self._camera(scene, own, time)[0] - center
        else:
            away = own[:3, 3] - center - self._object(scene, own, time)[0]
        unit = "object sizes" if scene.object.metres is None else "metres"
        return {"distance": {"value": float(away.norm()) * scene.metres, "unit": unit}}

    def _share(self, time: Tensor) -> Tensor:
        return (time / self.seconds).clamp(0.0, 1.0)

    def _camera(self, scene: SceneDescription, own: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """Where the camera is, and what it looks at."""
        center, start, asked = _middle(scene).to(own), own[:3, 3], str(self.chosen["path"])
        if (waypoints := self._waypoints) is not None:
            targets = waypoints.targets
            target = center if targets is None else center + waypoints.at(time, targets)
            return center + waypoints.at(time, waypoints.places), target
        along, away, reach = own[:3, 2], (start - center).norm(), float(str(self.chosen["reach"]))
        ahead = torch.stack([along[0], along[1], own.new_zeros(())])  # the camera keeps its height, as a car's does
        ahead = ahead / ahead.norm().clamp_min(1e-6)
        share = self._share(time)
        if asked == APPROACH:
            return start - ahead * away * (reach - 1.0) * (1.0 - share), center
        if asked == PASS:
            return start + own[:3, 0] * away * reach * (1.0 - 2.0 * share), center
        angle = 2.0 * math.pi * share
        x, y, z = start - center
        turned = torch.stack([angle.cos() * x - angle.sin() * y, angle.sin() * x + angle.cos() * y, z.expand(())])
        return center + turned, center

    def _object(self, scene: SceneDescription, own: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """How far the object is shifted, and how many degrees it is turned by."""
        asked, still = str(self.chosen["path"]), own.new_zeros(())
        if (waypoints := self._waypoints) is not None:
            heading = still if waypoints.headings is None else waypoints.at(time, waypoints.headings)
            return waypoints.at(time, waypoints.places), heading
        share, reach = self._share(time), float(str(self.chosen["reach"]))
        if asked == TURN:
            return own.new_zeros(3), 360.0 * share
        away = (own[:3, 3] - _middle(scene).to(own)).norm()
        along = own[:3, 2] if asked == APPROACH else -own[:3, 0]
        ahead = torch.stack([along[0], along[1], still])
        ahead = ahead / ahead.norm().clamp_min(1e-6)
        far = away * (reach - 1.0) * (1.0 - share) if asked == APPROACH else away * reach * (1.0 - 2.0 * share)
        return ahead * far, still


def _middle(scene: SceneDescription) -> Tensor:
    return torch.from_numpy(middle(scene)).float()


def looking(place: Tensor, target: Tensor, roll: float) -> Tensor:
    """Return the pose (4, 4) of a camera at a place (3,) that looks at a target (3,), rolled by degrees."""
    ahead = (target - place) / (target - place).norm().clamp_min(1e-9)
    level = torch.stack([-ahead[1], ahead[0], torch.zeros_like(ahead[0])])
    aside = torch.tensor([0.0, 1.0, 0.0]).to(ahead)  # where it looks straight up or down
    left = torch.where(level.norm() > 1e-6, level / level.norm().clamp_min(1e-6), aside)
    up, (cos, sin) = torch.linalg.cross(ahead, left), (math.cos(math.radians(roll)), math.sin(math.radians(roll)))
    return affine(torch.stack([cos * left + sin * up, cos * up - sin * left, ahead], dim=1), place)


def turned(scene: SceneDescription, shift: Tensor, heading: Tensor) -> Tensor:
    """Return what turns the object about the vertical through its middle, in degrees, and shifts it: (4, 4)."""
    angle, center = torch.deg2rad(heading), _middle(scene).to(shift)
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    about = torch.stack([angle.cos(), -angle.sin(), zero, angle.sin(), angle.cos(), zero, zero, zero, one])
    about = about.reshape(3, 3)
    own = torch.from_numpy(object_to_world(scene)).float().to(shift)
    return affine(about, center - about @ center + shift) @ own


def read_waypoints(path: Path, *, of_object: bool) -> Waypoints:
    """Read a file of waypoints.

    Args:
        path: a .csv file with the columns time, x, y, z, and look_x, look_y, look_z or heading.
        of_object: whether the object travels, rather than the camera.

    Raises:
        FileFormatError: it is no table of numbers with the columns that a path needs, or its times do not ascend.
    """
    further = ("heading",) if of_object else LOOKING
    try:
        text = read_text(path, "a table of waypoints", MOST_BYTES).removeprefix("\ufeff")
    except OSError as error:
        raise FileFormatError(f"{path}: expected a table of waypoints, got {error.strerror}") from error
    header, *rows = [[one.strip() for one in row] for row in csv.reader(text.splitlines()) if any(row)] or [[]]
    missing, twice = set(COLUMNS) - set(header), len(set(header)) < len(header)
    if missing or twice or set(header) - {*COLUMNS, *further} or 0 < len({*LOOKING} & {*header}) < len(LOOKING):
        raise FileFormatError(
            f"{path}: expected columns {', '.join(COLUMNS)}, and perhaps {', '.join(further)}, got "
            f"{', '.join(header)[:200] or 'nothing'}"
        )
    if not 2 <= len(rows) <= MOST_WAYPOINTS:
        raise FileFormatError(f"{path}: expected 2 to {MOST_WAYPOINTS} waypoints, got {len(rows)}")
    try:
        table = np.array([[float(one) for one in row] for row in rows], np.float64).reshape(len(rows), len(header))
    except ValueError as error:
        raise FileFormatError(f"{path}: expected {len(header)} numbers in each row, got something else") from error
    times = table[:, header.index("time")] - table[0, header.index("time")]
    if not (np.isfinite(times).all() and (np.diff(times) > SHORTEST).all() and times[-1] <= LONGEST):
        raise FileFormatError(
            f"{path}: expected times that ascend, by {SHORTEST:g} s at least and {LONGEST:g} s in all, got others"
        )
    column = {name: table[:, place] for place, name in enumerate(header) if name != "time"}
    if not all(np.abs(one).max() <= FARTHEST for one in column.values()):
        raise FileFormatError(f"{path}: expected numbers within {FARTHEST:g}, got larger ones, or none")

    def several(*names: str) -> Tensor:
        return torch.from_numpy(np.stack([column[one] for one in names], axis=1).astype(np.float32))

    return Waypoints(
        times=torch.from_numpy(times.astype(np.float32)),
        places=several("x", "y", "z"),
        targets=several(*LOOKING) if LOOKING[0] in column else None,
        headings=several("heading")[:, 0] if "heading" in column else None,
    )
