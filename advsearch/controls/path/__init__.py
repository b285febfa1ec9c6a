"""The `path` control: the camera, the object or both travel along a path.

The parameter `time` is the time on the path, so that each time is a frame of a drive. With
`--over path` one configuration is found for a full drive, and a grid over `path.time`
has its frames in order. If there are several paths (`approach,orbit,own.csv`), the
parameter `way` selects one of them in each configuration. The clean scene is the frame in
which camera and object are as the scene describes them: the end of `approach`, the center
of `pass`, the beginning of `orbit`.
"""

from __future__ import annotations

import copy
import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from advsearch.controls.path.pose_files import (
    AXES_DESCRIPTIONS,
    KITTI_RATE,
    NO_AXES,
    OPTICAL,
    WORLD_TO_Z_UP,
    PoseFormat,
    Trajectory,
    read_trajectory,
)
from advsearch.extend import (
    Choice,
    Control,
    Fixed,
    InputError,
    OneOf,
    Parameter,
    Range,
    SceneDescription,
    Value,
    Values,
    assets,
    errors,
    geometry,
    stored_files,
)

APPROACH = "approach"
PASS = "pass"
ORBIT = "orbit"
PATHS = (APPROACH, PASS, ORBIT)
CAMERA, OBJECT = MOVERS = "camera", "object"
# suffixes of files with a path, in lower case
PATH_ENDINGS = (".csv", ".txt", ".tum", ".kitti")
MOVER_SEPARATOR = "+"  # between the camera's path and the object's
PATH_SEPARATOR = ","  # between several paths, of which a configuration has one
MAX_PATHS = 64
# time of the clean scene, as a fraction of the duration
CLEAN_TIME_FRACTION = {APPROACH: 1.0, PASS: 0.5, ORBIT: 0.0}

DEFAULT_REACH = 4.0
DEFAULT_SECONDS = 10.0
MIN_SECONDS = 1e-3  # smallest time between waypoints
MAX_SECONDS = 3600.0  # largest duration of a path
# tolerance of `MIN_SECONDS`, as a fraction, for times that were rounded to decimals
ROUNDING_FRACTION = 1e-3
# smallest distance of the camera from the point that it looks at, object sizes; nearer,
# it would have no direction
MIN_TARGET_DISTANCE = 1e-3
# number of times at which paths are checked, in addition to the waypoints of files
N_CHECKED_TIMES = 2048
TIME_COLUMN = "time"
POSITION_COLUMNS = ("x", "y", "z")
TARGET_COLUMNS = ("look_x", "look_y", "look_z")
HEADING_COLUMN = "heading"
OBJECT_SHIFT_COLUMNS = ("object_x", "object_y", "object_z")
OBJECT_HEADING_COLUMN = "object_heading"
"""Columns for the object in a file with the camera's and the object's path."""
MAX_WAYPOINTS = 100_000
MAX_FILE_BYTES = 16 * 2**20
TRAJECTORY_CHOICES = ("axes", "up", "object_at")
# A mean angle, in degrees, between the camera's upward direction and the vertical. If it
# is larger, the axes of a file are probably other ones.
MAX_TILT = 60.0
MAX_DISTANCE = 1e5  # largest coordinate of a waypoint, metres or object sizes


@dataclass(frozen=True, eq=False)
class Waypoints:
    """A path from a file.

    Lengths are in metres if the object's size is known, otherwise in object sizes.

    Attributes:
        times: (n,) seconds from the first waypoint, ascending.
        positions: (n, 3) for a camera, positions relative to the object's center in the
            scene; for an object, shifts from there.
        targets: (n, 3) points that the camera looks at, relative to the same center.
            None if it looks at the object.
        headings: (n,) angles by which the object is turned, degrees. None if it is not
            turned.
        rotations: (n, 4) quaternions x, y, z, w from the camera's axes (x right, y
            down, z ahead). None if the camera looks at targets.
        has_times: whether the file states times.
        is_trajectory: whether the file is a trajectory of TUM, EuRoC or KITTI.
        notes: sentences for the user about how the file is read.
    """

    times: Tensor
    positions: Tensor
    targets: Tensor | None
    headings: Tensor | None
    rotations: Tensor | None = None
    has_times: bool = True
    is_trajectory: bool = False
    notes: tuple[str, ...] = ()

    def interpolate(self, time: Tensor, column: Tensor) -> Tensor:
        """Interpolate a column, or several, linearly between waypoints.

        Args:
            time: (...,) seconds; the result is differentiable in it.
            column: (n,) or (n, k) at the waypoints.

        Returns:
            (...,) or (..., k).
        """
        # index of the first waypoint after the time, or of the last waypoint
        index = torch.searchsorted(self.times, time.detach(), right=True)
        index = index.clamp(1, len(self.times) - 1)
        begin = self.times[index - 1]
        end = self.times[index]
        # constant before the first and after the last waypoint
        fraction = ((time - begin) / (end - begin)).clamp(0.0, 1.0)
        if column.ndim > 1:
            fraction = fraction[..., None]
        return torch.lerp(column[index - 1], column[index], fraction)

    def interpolate_rotation(self, time: Tensor) -> Tensor:
        """Return the camera's rotation (..., 3, 3) at times (...,).

        Its columns are the directions right, down and ahead of the camera. Between
        waypoints, quaternions are interpolated linearly and normalized. The path must
        have `rotations`.
        """
        assert self.rotations is not None
        quaternion = self.interpolate(time, self.rotations)
        quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        entries = torch.stack(
            geometry.compute_rotation_entries(*quaternion.unbind(dim=-1)), dim=-1
        )
        return entries.reshape(*entries.shape[:-1], 3, 3)


class StartPoses(NamedTuple):
    """Poses in the scene as it was described, float32.

    Attributes:
        camera: (4, 4) pose of the camera.
        center: (3,) center of the object.
        object: (4, 4) pose of the object.
    """

    camera: Tensor
    center: Tensor
    object: Tensor


Movement = str | Waypoints  # one of `PATHS`, or waypoints from a file

# the movement of the camera, the object or both, by one of `MOVERS`
MovementByMover = Mapping[str, Movement]


class PathControl(Control):
    """The camera, the object or both travel along a path; a frame is a time.

    Attributes:
        seconds: duration of the path, or of the longest one.
        _paths: movements of camera and object on each path.
        _movers: what moves on any of the paths: "camera", "object" or both.
        _files: movements that were read from files, on all paths.
    """

    kind = "path"
    travels = True
    parameters = (
        Parameter.moving(
            Parameter.ORBIT,
            "time",
            "s",
            0.0,
            MAX_SECONDS,
            "the time of the clean scene",
            "Time since the beginning of the path.",
        ),
    )
    choices = (
        Choice(
            "path",
            APPROACH,
            "approach (straight to its position in the scene), pass (straight past "
            "it), orbit (once around), a .csv file "
            "with columns time, x, y, z, or a trajectory of TUM, EuRoC or KITTI. "
            "Two of them with a + between are the camera's and the object's path. "
            "Several with commas between: each configuration has one of them, `way`.",
            "path",
        ),
        Choice(
            "moves",
            CAMERA,
            "What travels along a single path: camera or object.",
            options=MOVERS,
        ),
        Choice(
            "seconds",
            DEFAULT_SECONDS,
            "Duration of the path; a file states it, except for KITTI's poses.",
            max_value=MAX_SECONDS,
        ),
        Choice(
            "reach",
            DEFAULT_REACH,
            "Length, as a multiple of the camera's distance from the object in the "
            "scene: the distance at which approach begins, or half the length of pass.",
            max_value=1000.0,
        ),
        Choice(
            "shutter",
            None,
            "Seconds for which each row is exposed, which causes motion blur.",
            "shutter",
            max_value=60.0,
        ),
        Choice(
            "rolling",
            None,
            "Seconds in which all rows are read, one after the "
            "other; negative if the lowest row is read first.",
            "rolling",
            max_value=60.0,
            signed=True,
        ),
        Choice(
            "axes",
            None,
            "The axes of a trajectory's poses: optical (x right, y down, z ahead), "
            "opengl (x right, y up, z back), "
            "flu (x ahead, y left, z up), frd (x ahead, y right, z down), euroc (x "
            "up, y right, z ahead), or none: "
            "the camera looks at the object. By default optical.",
            options=tuple(AXES_DESCRIPTIONS),
        ),
        Choice(
            "up",
            None,
            "Upward axis of a trajectory's world; by default z, for KITTI -y.",
            options=tuple(WORLD_TO_Z_UP),
        ),
        Choice(
            "object_at",
            None,
            "Position of the object's centre in a trajectory's "
            "world, as [x, y, z]; by default its origin.",
        ),
    )

    @classmethod
    def declare_parameters(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        """Return the time, and the choice of the path if there are several."""
        if not isinstance(settings, Mapping):
            return cls.parameters
        names = _split_paths(settings.get("path", APPROACH))
        if len(names) < 2:
            return cls.parameters
        choice = Parameter.named(
            Control.PATH_PARAMETER, names, names[0], "Which of the paths."
        )
        return (*cls.parameters, choice)

    def check_choices(self) -> None:
        """Read the paths, and check the other choices against them.

        The choice `path` has one name or several, e.g. "orbit" or "drive.csv". A file
        with times states its duration, so that `seconds` must not be set as well. If
        all paths are files, `reach` must not be set. If any path is a file, all paths
        get the duration of the longest file.

        Raises:
            InputError: choices contradict each other or the files.
        """
        names = _split_paths(self.choice_values["path"])
        self._check_path_names(names)
        self._check_object_at()
        self._paths: tuple[MovementByMover, ...] = tuple(map(self._read_path, names))
        self._movers = {mover for movements in self._paths for mover in movements}
        all_movements = [
            movement for movements in self._paths for movement in movements.values()
        ]
        self._files = [
            movement for movement in all_movements if isinstance(movement, Waypoints)
        ]
        are_all_files = len(self._files) == len(all_movements)
        self._check_choices_fit_paths(names, are_all_files=are_all_files)
        self._set_duration()

    def _set_duration(self) -> None:
        """Set `seconds`: the duration of the longest file, or the choice without files."""
        if self._files:
            durations = [float(movement.times[-1]) for movement in self._files]
            self.choice_values["seconds"] = max(durations)
        self.seconds = float(self.choice_values["seconds"])

    def _check_path_names(self, names: Sequence[str]) -> None:
        """Raise InputError if there are too many paths, or one is there twice."""
        if len(set(names)) < len(names) or len(names) > MAX_PATHS:
            raise InputError(
                f"{self.name}.path: expected at most {MAX_PATHS} "
                f"different paths, got {', '.join(names)}"
            )

    def _check_choices_fit_paths(
        self, names: Sequence[str], *, are_all_files: bool
    ) -> None:
        """Raise InputError if a choice is set that the paths state themselves.

        Args:
            names: names of the paths, e.g. "orbit" or "drive.csv".
            are_all_files: whether every movement is from a file, and none is a named
                one such as "orbit".
        """
        self._check_moves_is_used(names)
        # Without `path` in the settings of this control, another setting of the run may
        # still add one. `prepare` checks that.
        if "path" in self._settings:
            self._check_trajectory_choices()
        if any(movement.has_times for movement in self._files):
            self._check_not_set("seconds")
        if are_all_files:
            self._check_not_set("reach")

    def _check_moves_is_used(self, names: Sequence[str]) -> None:
        """Raise InputError if `moves` is set, but each path states what it moves.

        Args:
            names: names of the paths, e.g. "orbit" or "drive.csv".
        """
        # "approach+orbit" moves both the camera and the object, "orbit" what `moves` states
        has_single_mover = any(MOVER_SEPARATOR not in name for name in names)
        if "moves" in self._settings and not has_single_mover:
            raise InputError(
                f"{self.name}: {names[0]} states the movements of both the camera and "
                "the object; leave moves out"
            )

    def _check_not_set(self, setting: str) -> None:
        """Raise InputError if a choice is set that the files of the paths state."""
        if setting in self._settings:
            raise InputError(
                f"{self.name}: {setting}: the file in {self.choice_values['path']} states it; "
                "leave it out"
            )

    def _read_path(self, name: str) -> MovementByMover:
        """Return the movement of the camera, the object or both on a path.

        Args:
            name: a single movement, e.g. "orbit" or "drive.csv", by the camera or the
                object, as the choice `moves` states; or the camera's and the object's
                movement with a "+" between them, e.g. "approach+orbit".
        """
        names = self._split_movers(name)
        is_single = len(names) == 1
        # `MOVERS` has the order of the names: the camera, then the object
        movers = [str(self.choice_values["moves"])] if is_single else MOVERS
        movements: dict[str, Movement] = {}
        for mover, path_name in zip(movers, names, strict=True):
            if path_name in PATHS:
                movements[mover] = path_name
            else:
                # A file for the camera may have the object's movement too.
                movements |= self._read_file(Path(path_name), mover, is_single)
        return movements

    def _split_movers(self, name: str) -> list[str]:
        """Return the name of a single movement, or the camera's and the object's.

        Raises:
            InputError: the name is no path.
        """
        halves = name.split(MOVER_SEPARATOR)
        # The name of a single file may have a "+", too: then the halves are no paths.
        if len(halves) == 2 and all(map(_is_path, halves)):
            return halves
        if not _is_path(name):
            raise InputError(
                f"{self.name}.path: expected {', '.join(PATHS)}, a "
                f"{' or '.join(PATH_ENDINGS)} file, or two of them as "
                f"in {APPROACH}{MOVER_SEPARATOR}{ORBIT}, the camera's and the "
                "object's, got "
                f"{name!r}"
            )
        return [name]

    def _check_trajectory_choices(self) -> None:
        """Check that choices such as `axes` and `up` are set only with a trajectory.

        A trajectory is a file of camera poses (TUM, EuRoC or KITTI).

        Raises:
            InputError: such a choice is set without a trajectory.
        """
        chosen_names = [
            name for name in TRAJECTORY_CHOICES if self.choice_values[name] is not None
        ]
        has_trajectory = any(waypoints.is_trajectory for waypoints in self._files)
        if chosen_names and not has_trajectory:
            raise InputError(
                f"{self.name}: {chosen_names[0]}: needs a trajectory of TUM, EuRoC or "
                "KITTI, and there is none; leave it out"
            )

    def _check_object_at(self) -> None:
        """Check the choice `object_at`, the object's position in a file's world.

        Raises:
            InputError: it is set, and is not three finite numbers.
        """
        position = self.choice_values["object_at"]
        if position is None:
            return
        is_triple = isinstance(position, list | tuple) and len(position) == 3
        if not is_triple or not all(
            Parameter.is_number(value) and math.isfinite(value) for value in position
        ):
            raise InputError(
                f"{self.name}.object_at: expected three numbers as in "
                f"[20, 0, 0], got {position!r}"
            )

    def _read_file(self, path: Path, mover: str, is_single: bool) -> MovementByMover:
        """Read the file of a path: a trajectory, or a table of waypoints.

        Args:
            path: the file.
            mover: "camera" or "object", which moves along it.
            is_single: whether it is the only movement of its path. Then a table for the
                camera may have columns with the object's movement as well.

        Raises:
            FileFormatError: it is in no such format, or a trajectory for the object.
        """
        text = _read_text(path)
        trajectory = read_trajectory(path, text)
        if trajectory is None:  # in none of the formats of trajectories
            return read_waypoints(path, mover, text=text, is_single_path=is_single)
        if mover != CAMERA:
            raise errors.FileFormatError(
                f"{path}: {trajectory.format.value} is a path of the camera, and here "
                "the object moves; write its path as columns time,x,y,z,heading"
            )
        return {mover: self._read_camera_path(path, trajectory)}

    def _read_camera_path(self, path: Path, trajectory: Trajectory) -> Waypoints:
        """Return the path of the camera on a trajectory.

        Its notes list what the file does not state and was assumed, and warn if the
        camera seems to be tilted.

        Args:
            path: the file, for messages.
            trajectory: what was read from it.
        """
        # defaults of choices that the user left out, by the name of the choice
        assumed = dict[str, str]()
        times = self._find_times(trajectory, assumed)
        check_times(path, times)
        positions, rotations = self._orient(path, trajectory, assumed)
        notes = _list_trajectory_notes(path, trajectory, assumed, rotations)
        return Waypoints(
            torch.from_numpy(times.astype(np.float32)),
            torch.from_numpy(positions.astype(np.float32)),
            targets=None,
            headings=None,
            rotations=None if rotations is None else _to_quaternions(rotations),
            has_times=trajectory.format is not PoseFormat.KITTI,
            is_trajectory=True,
            notes=tuple(notes),
        )

    def _find_times(
        self, trajectory: Trajectory, assumed: dict[str, str]
    ) -> assets.Float64Array:
        """Return the times (n,) of a trajectory, in seconds.

        A KITTI file has no times. Its poses are spread evenly over the choice
        `seconds`, or else follow each other at the rate of KITTI's camera.

        Args:
            trajectory: the trajectory.
            assumed: defaults of choices that the user left out, by name. If the rate is
                used, the duration is added.
        """
        if trajectory.times is not None:
            return trajectory.times
        count = len(trajectory.positions)
        if "seconds" in self._settings:
            seconds = float(self.choice_values["seconds"])
        else:
            seconds = (count - 1) / KITTI_RATE
            assumed["seconds"] = (
                f"{KITTI_RATE:g} poses a second, {_format_rounded(seconds)} in all"
            )
        return np.linspace(0.0, seconds, count)

    def _orient(
        self, path: Path, trajectory: Trajectory, assumed: dict[str, str]
    ) -> tuple[assets.Float64Array, Rotation | None]:
        """Return a trajectory's positions and rotations in a world whose z is up.

        Args:
            path: the file, for messages.
            trajectory: what was read from it.
            assumed: is changed in place: the defaults of `axes`, `up` and `object_at`
                are added by name, as texts for a note, if they are used.

        Returns:
            Positions (n, 3) relative to the object, in the file's unit. And rotations,
            which are None if the file has none, or if the axes are "none": then the
            camera looks at the object.

        Raises:
            InputError: the file has no rotations, and `axes` is "none".
            FileFormatError: a position is too far from the object.
        """
        # A choice is None if the user left it out.
        axes = str(self.choice_values["axes"] or OPTICAL)
        up = str(self.choice_values["up"] or trajectory.default_up)
        origin = self.choice_values["object_at"] or (0.0, 0.0, 0.0)
        has_rotations = trajectory.rotations is not None
        if not has_rotations and axes == NO_AXES:
            raise InputError(
                f"{self.name}: axes: {path} has no rotations; leave it out"
            )
        assumed |= self._list_assumptions(axes, up, has_rotations=has_rotations)
        positions, rotations = trajectory.orient(axes, up, origin)
        _check_positions(path, positions)
        return positions, rotations

    def _list_assumptions(
        self, axes: str, up: str, *, has_rotations: bool
    ) -> dict[str, str]:
        """Return the defaults that are used of `axes`, `up` and `object_at`, as texts.

        Args:
            axes: the axes of the poses.
            up: the upward axis of the world.
            has_rotations: whether the axes have an effect.
        """
        assumed = {}
        if self.choice_values["axes"] is None and has_rotations:
            assumed["axes"] = f"{axes} ({AXES_DESCRIPTIONS[axes]})"
        if self.choice_values["up"] is None:
            assumed["up"] = up
        if self.choice_values["object_at"] is None:
            assumed["object_at"] = "[0, 0, 0]"
        return assumed

    def get_parameter_spec(self, parameter: Parameter) -> Fixed | Range | OneOf:
        """Return the spec of a parameter.

        The selection of a path is searched unless the user fixed it. (Other parameters
        have a fixed default as soon as the user sets a range of one of them.)
        """
        is_path_choice = parameter.name == Control.PATH_PARAMETER
        if is_path_choice and parameter.name not in self.specs:
            return OneOf(parameter.options)
        return super().get_parameter_spec(parameter)

    _time_shift = 0.0  # seconds by which `advance_time` has moved the time

    @property
    def exposure(self) -> tuple[float, float]:  # type: ignore[override]
        """Seconds during which the shutter is open, and seconds to read out all rows.

        The latter are negative if rows are read from the bottom.
        """
        return float(self.choice_values["shutter"] or 0.0), float(
            self.choice_values["rolling"] or 0.0
        )

    def advance_time(self, seconds: float) -> PathControl:
        shifted = copy.copy(self)
        shifted._time_shift = self._time_shift + seconds
        return shifted

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with notes on the files as remarks, after checking the paths.

        Raises:
            InputError: something else fixes the camera, or the camera would be at the
                point that it looks at.
        """
        if CAMERA in self._movers:
            self._check_camera_is_free(scene)
        self._check_trajectory_choices()
        self._check_cameras_off_target(scene)
        notes = self._list_notes()
        if not notes:
            return scene
        remarks = tuple(dict.fromkeys((*scene.remarks, *notes)))
        return replace(scene, remarks=remarks)

    def _check_cameras_off_target(self, scene: SceneDescription) -> None:
        """Check on each path that the camera is never at the point it looks at."""
        control_in_scene = self.with_scene(scene)
        names = _split_paths(self.choice_values["path"])
        for name, movements in zip(names, self._paths, strict=True):
            if CAMERA in movements:
                control_in_scene._check_camera_off_target(name, movements)

    def _check_camera_is_free(self, scene: SceneDescription) -> None:
        """Raise InputError if the scene's camera or photograph fixes the camera's pose.

        Only the camera "orbit", which is described by azimuth, elevation and distance,
        can move.
        """
        if not scene.uses_orbit_camera:
            raise InputError(
                f"`controls` {self.name}: moves the camera, and the scene uses its own "
                f"camera {scene.camera!r}; set moves=object, or set the camera to "
                "'orbit'"
            )
        self._check_has_no_photograph(scene)

    def _check_has_no_photograph(self, scene: SceneDescription) -> None:
        """Raise InputError if the scene is rendered into a photograph."""
        photograph = scene.backdrop_photograph
        if photograph is not None:
            raise InputError(
                f"`controls` {self.name} and `backdrop={photograph.spec}` contradict "
                "each other: the photograph was taken from one position; set "
                "moves=object, or leave one of the two out"
            )

    def _list_notes(self) -> list[str]:
        """Return notes on the files, and one if they have different durations.

        The times of frames are drawn from the duration of the longest file. Frames after
        the end of a shorter file show its last position, and are counted in results
        like all other frames.
        """
        notes = [note for waypoints in self._files for note in waypoints.notes]
        durations = [float(waypoints.times[-1]) for waypoints in self._files]
        shortest = min(durations, default=self.seconds)
        if len(self._paths) > 1 and shortest < self.seconds:
            notes.append(
                f"path: the shortest of the files takes {_format_rounded(shortest)} s "
                "of "
                f"{_format_rounded(self.seconds)}; frames after its end show its last "
                "position, and count"
            )
        return notes

    def _check_camera_off_target(self, name: str, movements: MovementByMover) -> None:
        """Check that the camera is never at the point that it looks at.

        There it would have no direction. The vector from the camera to that point is
        computed at many times, including those of waypoints. In between it is assumed
        to change linearly.

        Args:
            name: name of the path, for messages.
            movements: movements of camera and object on it.

        Raises:
            InputError: the camera is at that point at some time.
        """
        times = self._list_checked_times(movements)
        start = get_start_poses(self.scene, times.device)
        shift, _ = self._shift_object(movements, start, times)
        position, target = self._position_camera(movements, start, times, shift)
        to_target = (target - position).expand(len(times), 3).double()
        # For each step from one time to the next: the fraction of the step at which the
        # distance is smallest, and that distance; (n - 1,) each.
        fraction, distance = _find_closest_to_origin(to_target)
        if float(distance.min()) < MIN_TARGET_DISTANCE:
            index = int(distance.argmin())
            fraction_of_step = fraction[index].float()
            time = torch.lerp(times[index], times[index + 1], fraction_of_step)
            raise self._make_collision_error(name, float(time))

    def _list_checked_times(self, movements: MovementByMover) -> Tensor:
        """Return times (n,) on a path, ascending, those of waypoints included."""
        waypoint_times = [
            movement.times
            for movement in movements.values()
            if isinstance(movement, Waypoints)
        ]
        even_times = torch.linspace(0.0, self.seconds, N_CHECKED_TIMES)
        times: Tensor = torch.cat([even_times, *waypoint_times]).unique()
        return times

    def _make_collision_error(self, name: str, collision_time: float) -> InputError:
        """Return the error of a camera that has no direction at a time in seconds."""
        return InputError(
            f"`controls` {self.name}: {name}: {collision_time:.4g} s after its "
            "start the camera is at the point that it looks at, so that it has no "
            "direction; move the path away from that point, or state another point "
            "to look at (look_x, look_y, look_z)"
        )

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return the parameter for a scene: its range, and the time of the clean scene.

        The clean time is the one at which camera and object are as the scene describes
        them, e.g. the end of an approach. It is the default. The range is the duration.

        Args:
            parameter: the time; or the selection of a path, which is returned
                unchanged.
        """
        if parameter.name == Control.PATH_PARAMETER:
            return parameter
        # `Parameter.ORBIT` are the estimators for a moving camera, not the movement.
        estimators = Parameter.ORBIT if CAMERA in self._movers else Parameter.GEOMETRIC
        return replace(
            parameter,
            default=self._clean_time,
            search=(0.0, self.seconds),
            estimators=estimators,
        )

    @property
    def _clean_time(self) -> float:
        """The time, in seconds, at which the first path is as the scene describes it."""
        # The first movement of the first path decides. An orbit is an exception: it is
        # closed, so that both its start and its end are as in the scene. Then the second
        # movement decides, if there is one. (A movement is a name, or waypoints.)
        movement, *other_movements = self._paths[0].values()
        if other_movements and movement == ORBIT:
            movement = other_movements[0]
        if isinstance(movement, str):
            return CLEAN_TIME_FRACTION.get(movement, 0.0) * self.seconds
        return 0.0  # for waypoints from a file

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the poses (4, 4) of the camera, the object or both at a time.

        Args:
            values: values of the control, "time" in seconds and the index of the path.
            earlier_inputs: inputs of earlier controls, which are not used.
        """
        # A camera exposes its rows at later times (`advance_time`).
        time = values["time"] + self._time_shift
        movements = self._select_movements(values)
        start = get_start_poses(self.scene, time.device)
        shift, heading = self._shift_object(movements, start, time)
        inputs = {}
        if CAMERA in self._movers:
            pose = self._compute_camera_pose(movements, start, time, shift)
            inputs["camera.to_world"] = pose
        if OBJECT in self._movers:
            inputs["object.to_world"] = make_object_pose(start, shift, heading)
        return inputs

    def _compute_camera_pose(
        self,
        movements: MovementByMover,
        start: StartPoses,
        time: Tensor,
        shift: Tensor,
    ) -> Tensor:
        """Return the pose (4, 4) of the camera at a time () in seconds.

        The arguments are those of `_position_camera`.
        """
        position, target = self._position_camera(movements, start, time, shift)
        roll = self.scene.get_number("camera.roll")
        # None on a path on which only the object moves
        movement = movements.get(CAMERA)
        if isinstance(movement, Waypoints) and movement.rotations is not None:
            rotation = movement.interpolate_rotation(time)
            return make_camera_pose(position, rotation, roll)
        return make_look_at_pose(position, target, roll)

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Return the distance of the camera from the object."""
        unit = "object sizes" if self.scene.object.size_in_metres is None else "metres"
        distance = self._camera_distance(self._select_movements(values), values["time"])
        return {"distance": Value(value=float(distance), unit=unit)}

    def compute_distances(self, times: Tensor) -> Tensor:
        """Return the distances of the camera from the object on each of the paths.

        Args:
            times: (n,) seconds.

        Returns:
            (paths, n) in metres if the object's size is known, else in object sizes.
        """
        return torch.stack(
            [
                self._camera_distance(movements, times).expand(times.shape)
                for movements in self._paths
            ]
        )

    def _camera_distance(self, movements: MovementByMover, time: Tensor) -> Tensor:
        """Return the distance of the camera from the object at times (...,).

        It is in metres if the object's size is known, else in object sizes.
        """
        start = get_start_poses(self.scene, time.device)
        shift, _ = self._shift_object(movements, start, time)
        position, _ = self._position_camera(movements, start, time, shift)
        offset = position - start.center - shift
        distance: Tensor = offset.norm(dim=-1).double() * self.scene.size_in_metres
        return distance

    def _select_movements(self, values: Values) -> MovementByMover:
        """Return the movements of camera and object on the path of a configuration."""
        if Control.PATH_PARAMETER in values:
            return self._paths[int(values[Control.PATH_PARAMETER])]
        return self._paths[0]

    def _position_camera(
        self,
        movements: MovementByMover,
        scene_start: StartPoses,
        time: Tensor,
        shift: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return the position of the camera, and the point that it looks at.

        A camera that moves looks at the moved object, unless a file states something
        else. On "approach" it moves straight ahead to its position in the scene, on
        "pass" it moves past that position from left to right, and on "orbit" once
        around the object.

        Args:
            movements: movements of camera and object; without one of the camera, it
                stays as in the scene.
            scene_start: poses in the scene as it was described.
            time: (...,) seconds.
            shift: (..., 3) how far the object has moved, in object sizes.

        Returns:
            The camera's position and the point that it looks at, (..., 3) each, in
            object sizes.
        """
        center = scene_start.center
        movement = movements.get(CAMERA)
        if movement is None:  # it keeps its direction, even if the object moves
            # the columns of the pose: three axes, and the position
            scene_position = scene_start.camera[:3].unbind(dim=1)[3]
            return scene_position, center
        if isinstance(movement, Waypoints):
            return self._camera_on_waypoints(movement, center, time, shift)
        progress = (time / self.seconds).clamp(0.0, 1.0)
        position = self._camera_on_named_path(movement, scene_start, progress)
        return position, center + shift

    def _camera_on_named_path(
        self, movement: str, scene_start: StartPoses, progress: Tensor
    ) -> Tensor:
        """Return the position (..., 3) of the camera on a named path, object sizes.

        Args:
            movement: one of `PATHS`.
            scene_start: poses in the scene as it was described.
            progress: (...,) fraction of the path, 0 to 1.
        """
        # columns of the pose: the camera's x axis points to the left, y up, z ahead
        left, _, forward, scene_position = scene_start.camera[:3].unbind(dim=1)
        from_center = scene_position - scene_start.center
        if movement == ORBIT:
            return scene_start.center + _turn_about_vertical(from_center, progress)
        distance: Tensor = from_center.norm()
        reach = float(self.choice_values["reach"])
        if movement == APPROACH:
            # It begins at `reach` times the distance at which it ends.
            to_go: Tensor = (1.0 - progress)[..., None]  # (..., 1), from 1 to 0
            distance_to_go = (
                _level_direction(forward) * distance * (reach - 1.0) * to_go
            )
            approach_position: Tensor = scene_position - distance_to_go
            return approach_position
        # On "pass", (..., 1): 1 at the beginning, 0 at the position in the scene, -1 at
        # the end.
        to_the_left: Tensor = (1.0 - 2.0 * progress)[..., None]
        position: Tensor = scene_position + left * distance * reach * to_the_left
        return position

    def _camera_on_waypoints(
        self, waypoints: Waypoints, center: Tensor, time: Tensor, shift: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the position of the camera on waypoints, and the point it looks at.

        It looks along its rotation if the waypoints have rotations, otherwise at their
        targets, otherwise at the object.

        Args:
            waypoints: waypoints of the camera, in metres from the object's center.
            center: (3,) the object's center in the scene.
            time: (...,) seconds.
            shift: (..., 3) how far the object has moved.

        Returns:
            The camera's position and the point that it looks at, (..., 3) each, in
            object sizes.
        """
        # Waypoints of the camera, and targets, are relative to the object's position in
        # the scene, wherever the object has moved.
        offset = waypoints.interpolate(time, waypoints.positions)
        position = center + offset / self.scene.size_in_metres
        if waypoints.rotations is not None:
            rotation = waypoints.interpolate_rotation(time)  # (..., 3, 3)
            forward = rotation[..., :, 2]  # the third column
            return position, position + forward
        if waypoints.targets is None:
            return position, center + shift
        target = waypoints.interpolate(time, waypoints.targets)
        return position, center + target / self.scene.size_in_metres

    def _shift_object(
        self, movements: MovementByMover, scene_start: StartPoses, time: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return how far the object is shifted and turned from its pose in the scene.

        On "approach" it moves on a level line towards the camera, up to its position in
        the scene. On "pass" it moves past that position from right to left. On "orbit"
        it turns once about its own vertical axis.

        Args:
            movements: movements of camera and object; without one of the object, it is
                neither shifted nor turned.
            scene_start: poses in the scene as it was described.
            time: (...,) seconds.

        Returns:
            The shift (..., 3) in object sizes, and the turn (...,) in degrees.
        """
        camera = scene_start.camera
        movement = movements.get(OBJECT)
        no_turn = camera.new_zeros(())
        if movement is None:
            return camera.new_zeros(3), no_turn
        if isinstance(movement, Waypoints):
            return self._shift_on_waypoints(movement, time, no_turn)
        progress = (time / self.seconds).clamp(0.0, 1.0)
        if movement == ORBIT:
            return camera.new_zeros(3), 360.0 * progress
        return self._object_on_line(movement, scene_start, progress), no_turn

    def _shift_on_waypoints(
        self, waypoints: Waypoints, time: Tensor, no_turn: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return how far waypoints shift and turn the object.

        Args:
            waypoints: waypoints of the object, in metres.
            time: (...,) seconds.
            no_turn: () 0 degrees, for waypoints without headings.

        Returns:
            The shift (..., 3) in object sizes, and the turn (...,) in degrees.
        """
        # The positions of an object's waypoints are relative to its position in the
        # scene.
        shift = waypoints.interpolate(time, waypoints.positions)
        shift = shift / self.scene.size_in_metres
        if waypoints.headings is None:
            return shift, no_turn
        return shift, waypoints.interpolate(time, waypoints.headings)

    def _object_on_line(
        self, movement: str, scene_start: StartPoses, progress: Tensor
    ) -> Tensor:
        """Return the shift (..., 3) of the object on a straight line, object sizes.

        Args:
            movement: "approach" or "pass".
            scene_start: poses in the scene as it was described.
            progress: (...,) fraction of the path, 0 to 1.
        """
        # columns of the pose: the camera's x axis points to the left, y up, z ahead
        left, _, forward, position = scene_start.camera[:3].unbind(dim=1)
        reach = float(self.choice_values["reach"])
        distance: Tensor = (position - scene_start.center).norm()
        if movement == APPROACH:
            # It begins at `reach` times the distance from the camera at which it ends.
            to_go: Tensor = distance * (reach - 1.0) * (1.0 - progress)
            approach_shift: Tensor = _level_direction(forward) * to_go[..., None]
            return approach_shift
        # On "pass" it is to the right of its position in the scene at first (over 0),
        # then to the left (under 0).
        to_right: Tensor = distance * reach * (1.0 - 2.0 * progress)
        pass_shift: Tensor = _level_direction(-left) * to_right[..., None]
        return pass_shift


@geometry.cache_per_scene
def get_start_poses(scene: SceneDescription, device: torch.device) -> StartPoses:
    """Return the poses of a scene; cached, as all vertices are read for the center."""
    return StartPoses(
        camera=torch.from_numpy(geometry.camera_to_world(scene)).float().to(device),
        center=torch.from_numpy(geometry.compute_center(scene)).float().to(device),
        object=torch.from_numpy(geometry.compute_object_to_world(scene))
        .float()
        .to(device),
    )


def _level_direction(direction: Tensor) -> Tensor:
    """Return the unit vector (3,) of the horizontal part of a direction.

    It is zero for a vertical direction.
    """
    level = torch.stack([direction[0], direction[1], direction.new_zeros(())])
    return torch.as_tensor(level / level.norm().clamp_min(1e-6))


def _find_closest_to_origin(points: Tensor) -> tuple[Tensor, Tensor]:
    """Find where the segments of a polyline are closest to the origin.

    Args:
        points: (n, 3) corners of the polyline.

    Returns:
        For each segment, the position of its closest point along it, from 0 to 1, and
        the distance of that point; (n - 1,) each.
    """
    delta = points[1:] - points[:-1]
    # A segment may have the length 0, by which nothing must be divided.
    squared_length = delta.square().sum(dim=1).clamp_min(1e-300)
    fraction = (-(points[:-1] * delta).sum(dim=1) / squared_length).clamp(0.0, 1.0)
    return fraction, (points[:-1] + fraction[:, None] * delta).norm(dim=1)


def _turn_about_vertical(offset: Tensor, turns: Tensor) -> Tensor:
    """Turn an offset (3,) about the vertical by a number of turns (...,)."""
    angle = 2.0 * math.pi * turns
    x, y, z = offset
    cos = angle.cos()
    sin = angle.sin()
    return torch.stack(
        [cos * x - sin * y, sin * x + cos * y, z.expand(angle.shape)], dim=-1
    )


def make_look_at_pose(position: Tensor, target: Tensor, roll: float) -> Tensor:
    """Return the pose (4, 4) of a camera that looks at a target, with z up.

    Args:
        position: (3,) position of the camera.
        target: (3,) point that it looks at.
        roll: degrees by which it is turned about its viewing direction.
    """
    forward = (target - position) / (target - position).norm().clamp_min(1e-9)
    # horizontal, and at right angles to `forward`
    level_left = torch.stack([-forward[1], forward[0], torch.zeros_like(forward[0])])
    length = level_left.norm()
    # It is zero if the camera looks straight up or down: then y is the left axis.
    default_left = torch.tensor([0.0, 1.0, 0.0]).to(forward)
    left = torch.where(length > 1e-6, level_left / length.clamp_min(1e-6), default_left)
    up = torch.linalg.cross(forward, left)
    return _roll_camera(position, left=left, up=up, ahead=forward, roll=roll)


def make_camera_pose(position: Tensor, rotation: Tensor, roll: float) -> Tensor:
    """Return the pose (4, 4) of a camera with a rotation.

    Args:
        position: (3,) position of the camera.
        rotation: (3, 3) its rotation, with columns right, down and ahead.
        roll: degrees by which it is turned about its viewing direction.
    """
    right, down, ahead = rotation.unbind(dim=-1)
    return _roll_camera(position, -right, -down, ahead, roll)


def _roll_camera(
    position: Tensor, left: Tensor, up: Tensor, ahead: Tensor, roll: float
) -> Tensor:
    """Return the pose (4, 4) of a camera that is turned about its viewing direction.

    Args:
        position: (3,) position of the camera.
        left, up, ahead: (3,) its unit axes without roll, at right angles.
        roll: degrees by which it is turned, clockwise as seen from behind it.
    """
    cos = math.cos(math.radians(roll))
    sin = math.sin(math.radians(roll))
    rolled_left = cos * left + sin * up
    rolled_up = cos * up - sin * left
    axes = torch.stack([rolled_left, rolled_up, ahead], dim=1)
    return geometry.make_affine(axes, position)


def _list_trajectory_notes(
    path: Path,
    trajectory: Trajectory,
    assumed: Mapping[str, str],
    rotations: Rotation | None,
) -> list[str]:
    """List the notes on a trajectory: how it was read, what was assumed, and its tilt.

    Args:
        path: the file.
        trajectory: what was read from it.
        assumed: defaults of choices that the user left out, by name.
        rotations: rotations of the camera; None if it looks at the object.
    """
    notes = list(trajectory.notes)
    if assumed:
        notes.append(_describe_assumptions(path, trajectory.format, assumed))
    if rotations is not None:
        notes += _warn_of_tilt(path, rotations)
    return notes


def _warn_of_tilt(path: Path, rotations: Rotation) -> list[str]:
    """Return a warning if a camera seems to be tilted, or none."""
    tilt = measure_tilt(rotations)
    if tilt > MAX_TILT:
        return [
            f"{path}: the upward direction of its pictures is {tilt:.0f} "
            "degrees from the vertical, on average; another `axes` or "
            "`up` may be right."
        ]
    return []


def _to_quaternions(rotations: Rotation) -> Tensor:
    """Return rotations as quaternions (n, 4) x, y, z, w, neighbors with similar signs."""
    quaternions = align_quaternions(rotations.as_quat())
    return torch.from_numpy(quaternions.astype(np.float32))


def _check_positions(path: Path, positions: assets.Float64Array) -> None:
    """Raise FileFormatError if a position (n, 3) is too far from the object."""
    if np.abs(positions).max() > MAX_DISTANCE:
        raise errors.FileFormatError(
            f"{path}: expected positions within {MAX_DISTANCE:g} of the object, "
            "got larger ones; set object_at to the object's position in the file's "
            "world"
        )


def measure_tilt(rotations: Rotation) -> float:
    """Return the angle between a camera's upward direction and the vertical, degrees.

    It is the angle of the mean cosine over all rotations (x right, y down, z ahead) into
    a world whose z is up.
    """
    # the z component of minus the y axis
    cosines = -rotations.as_matrix()[:, 2, 1]
    return math.degrees(math.acos(float(np.clip(cosines.mean(), -1.0, 1.0))))


def align_quaternions(quaternions: assets.Float64Array) -> assets.Float64Array:
    """Return quaternions (n, 4) with signs that make neighbors similar.

    A quaternion and its negative are the same rotation. But between two of opposite
    signs, interpolation would take the longer direction.
    """
    is_opposite = (quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0.0
    # the sign changes at each opposite pair, and stays changed
    n_changes = np.cumsum(np.concatenate([[False], is_opposite]))
    signs = np.where(n_changes % 2, -1.0, 1.0)
    return np.asarray(quaternions * signs[:, None])


def check_times(path: Path, times: assets.Float64Array) -> None:
    """Check the times of waypoints.

    Args:
        path: the file, for messages.
        times: (n,) seconds, the first of which is 0.

    Raises:
        FileFormatError: they are too few or too many, do not ascend, follow each other
            within less than `MIN_SECONDS`, or exceed `MAX_SECONDS`.
    """
    if not 2 <= len(times) <= MAX_WAYPOINTS:
        raise errors.FileFormatError(
            f"{path}: expected 2 to {MAX_WAYPOINTS} waypoints, got {len(times)}"
        )
    if not (
        np.isfinite(times).all()
        and (np.diff(times) >= MIN_SECONDS * (1.0 - ROUNDING_FRACTION)).all()
        and times[-1] <= MAX_SECONDS
    ):
        raise errors.FileFormatError(
            f"{path}: expected times that ascend, by {MIN_SECONDS:g} s at least and "
            f"{MAX_SECONDS:g} s in all, got others"
        )


def make_object_pose(start: StartPoses, shift: Tensor, heading: Tensor) -> Tensor:
    """Return the pose (4, 4) of an object that is turned and shifted.

    Args:
        start: poses in the scene as it was described.
        shift: (3,) shift in object sizes.
        heading: () degrees by which it turns about the vertical through its center.
    """
    pitch, roll = heading.new_zeros(2)
    turn = geometry.make_euler_rotation(heading, pitch, roll)
    center = start.center
    # It turns about the center, and not about the origin.
    movement = geometry.make_affine(turn, center - turn @ center + shift)
    pose: Tensor = movement @ start.object
    return pose


def unwrap_headings(
    degrees: assets.Float64Array,
) -> tuple[assets.Float64Array, str | None]:
    """Unwrap headings, so that each turns to the next in the shorter direction.

    From 350 to 10 degrees the object then turns by 20 degrees, not back by 340. Only
    headings within one turn are changed: all in [0, 360] or all in [-180, 180], less
    than 360 apart. Other headings are already unwrapped: e.g. 370 is a full turn and 10
    degrees.

    Args:
        degrees: (n,) headings at the waypoints, in order.

    Returns:
        The headings (n,), and a note for the user; None if nothing was changed.
    """
    # steps for which the other direction is shorter
    jumps = np.nonzero(np.abs(np.diff(degrees)) > 180.0)[0]
    if not len(jumps) or not _is_within_turn(degrees):
        return degrees, None
    # headings before and after the first such step, for the note
    first = f"{degrees[jumps[0]]:g}"
    last = f"{degrees[jumps[0] + 1]:g}"
    note = (
        f"it turns in the shorter direction from {first} to {last} degrees; for the "
        "longer one, add a waypoint between them"
    )
    return np.asarray(np.unwrap(degrees, period=360.0)), note


def _is_within_turn(degrees: assets.Float64Array) -> bool:
    """Return whether headings (n,) are in usual bounds, and less than a turn apart."""
    low = float(degrees.min())
    high = float(degrees.max())
    has_usual_bounds = (0.0 <= low and high <= 360.0) or (
        -180.0 <= low and high <= 180.0
    )
    # Both 0 and 360 in one file are a full turn that is meant.
    has_full_turn = high - low >= 360.0
    return has_usual_bounds and not has_full_turn


def _describe_assumptions(
    path: Path, pose_format: PoseFormat, assumed: Mapping[str, str]
) -> str:
    """Return a note on the defaults of choices that the user left out.

    A trajectory does not state its axes, for example. With wrong axes the camera looks in
    a wrong direction; with "none" it looks at the object.

    Args:
        path: the file.
        pose_format: format of the trajectory.
        assumed: the defaults in words, by the name of the choice.
    """
    assumptions = ", ".join(f"{name} {value}" for name, value in assumed.items())
    return (
        f"{path}: not everything is stated by {pose_format.value}. "
        f"Assumed: {assumptions}. If that is wrong, "
        f"set {', '.join(assumed)} of the control path; with axes none the "
        "camera looks at the object."
    )


def _format_rounded(number: float) -> str:
    """Return a number with three significant digits, for a sentence."""
    return f"{float(f'{number:.3g}'):g}"


def _split_paths(path: object) -> tuple[str, ...]:
    """Return the paths in a list, or in a string with commas between them."""
    names = path if isinstance(path, list | tuple) else str(path).split(PATH_SEPARATOR)
    return tuple(str(name).strip() for name in names)


def _is_path(name: str) -> bool:
    return name in PATHS or name.lower().endswith(PATH_ENDINGS)


def _read_text(path: Path) -> str:
    """Read a file of waypoints, without a byte order mark.

    Raises:
        FileFormatError: the file can't be read.
    """
    try:
        return stored_files.read_text(
            path, "a table of waypoints", MAX_FILE_BYTES
        ).removeprefix("\ufeff")
    except OSError as error:
        raise errors.FileFormatError(
            f"{path}: expected a table of waypoints, got {error.strerror}"
        ) from error


def _list_optional_columns(mover: str, is_single_path: bool) -> tuple[str, ...]:
    """Return the columns that a table of waypoints may have in addition to time and
    position.
    """
    if mover == OBJECT:
        return (HEADING_COLUMN,)
    if is_single_path:
        return (*TARGET_COLUMNS, *OBJECT_SHIFT_COLUMNS, OBJECT_HEADING_COLUMN)
    return TARGET_COLUMNS


def read_waypoints(
    path: Path, mover: str, *, text: str, is_single_path: bool = True
) -> dict[str, Waypoints]:
    """Read the paths of the camera and the object from a table of waypoints.

    Args:
        path: path of the file, for messages.
        mover: "camera" or "object", which moves along the columns x, y and z.
        text: text of a .csv file with the columns time, x, y, z, and perhaps look_x,
            look_y, look_z (camera) or heading (object).
        is_single_path: whether this file is the full path. Then a file for the camera may
            have further columns with the object's movement.

    Returns:
        The waypoints by mover; times begin at 0.

    Raises:
        FileFormatError: it is no table of numbers with the columns that a path needs,
            or its times do not ascend.
    """
    header, rows = _read_csv(path, text)
    _check_header(path, header, _list_optional_columns(mover, is_single_path))
    table = _parse_numbers(path, header, rows)
    column = {name: table[:, index] for index, name in enumerate(header)}
    times = column.pop(TIME_COLUMN)
    times = times - times[0]
    check_times(path, times)
    _check_number_sizes(path, column)
    notes = _unwrap_heading_columns(path, column)
    seconds = torch.from_numpy(times.astype(np.float32))
    heading_notes = notes.get(HEADING_COLUMN, ())
    waypoints = {mover: _make_waypoints(column, seconds, heading_notes)}
    object_notes = notes.get(OBJECT_HEADING_COLUMN, ())
    object_waypoints = _make_object_waypoints(column, seconds, object_notes)
    if object_waypoints is not None:
        waypoints[OBJECT] = object_waypoints
    return waypoints


def _check_number_sizes(path: Path, column: Mapping[str, assets.Float64Array]) -> None:
    """Raise FileFormatError for a number that is too large, or NaN."""
    # A comparison with NaN is false, so that NaN is rejected as well.
    if not all(np.abs(values).max() <= MAX_DISTANCE for values in column.values()):
        raise errors.FileFormatError(
            f"{path}: expected numbers within {MAX_DISTANCE:g}, got larger ones or NaN"
        )


def _make_waypoints(
    column: Mapping[str, assets.Float64Array], seconds: Tensor, notes: tuple[str, ...]
) -> Waypoints:
    """Return the movement along the columns x, y and z of a table.

    "heading" is only in a file for the object; in one for the camera, the object's is
    "object_heading".

    Args:
        column: columns (n,) by name.
        seconds: (n,) times.
        notes: notes on the headings.
    """
    positions = _stack_columns(column, POSITION_COLUMNS)
    assert positions is not None  # `_check_header` requires them
    return Waypoints(
        seconds,
        positions,
        targets=_stack_columns(column, TARGET_COLUMNS),
        headings=_stack_columns(column, (HEADING_COLUMN,)),
        notes=notes,
    )


def _make_object_waypoints(
    column: Mapping[str, assets.Float64Array], seconds: Tensor, notes: tuple[str, ...]
) -> Waypoints | None:
    """Return the object's movement in a file for the camera; None if it does not move.

    Args:
        column: columns (n,) of the file by name.
        seconds: (n,) times of the waypoints.
        notes: notes on the object's headings.
    """
    shift = _stack_columns(column, OBJECT_SHIFT_COLUMNS)
    turn = _stack_columns(column, (OBJECT_HEADING_COLUMN,))
    if shift is None and turn is None:
        return None
    if shift is None:
        shift = torch.zeros(len(seconds), 3)  # it only turns
    return Waypoints(seconds, shift, targets=None, headings=turn, notes=notes)


def _read_csv(path: Path, text: str) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of a .csv file, without empty rows."""
    rows = []
    try:
        for row in csv.reader(text.splitlines()):
            if any(row):
                rows.append([cell.strip() for cell in row])
    except csv.Error as error:
        raise errors.FileFormatError(
            f"{path}: expected a table of waypoints, got an invalid one ({error})"
        ) from error
    if not rows:
        return [], []
    return rows[0], rows[1:]


def _check_header(path: Path, header: list[str], optional: tuple[str, ...]) -> None:
    """Check the names of the columns of a table of waypoints.

    Args:
        path: the file, for messages.
        header: names of its columns.
        optional: names of columns that it may have in addition to time, x, y and z.

    Raises:
        FileFormatError: a column is missing, unknown or there twice.
    """
    required = (TIME_COLUMN, *POSITION_COLUMNS)
    if not _has_valid_columns(header, required, optional):
        raise errors.FileFormatError(
            f"{path}: expected columns {', '.join(required)}, and perhaps "
            f"{', '.join(optional)}, got "
            f"{', '.join(header)[:200] or 'nothing'}; or a trajectory of TUM, EuRoC or "
            "KITTI"
        )


def _has_valid_columns(
    header: Sequence[str], required: Sequence[str], optional: Sequence[str]
) -> bool:
    """Return whether no column is missing, unknown or there twice."""
    names = set(header)
    is_missing = not set(required) <= names
    has_duplicates = len(names) < len(header)
    is_unknown = not names <= {*required, *optional}
    # some columns of a group, but not all of them
    is_incomplete = any(
        0 < len(names.intersection(group)) < len(group)
        for group in (TARGET_COLUMNS, OBJECT_SHIFT_COLUMNS)
    )
    return not (is_missing or has_duplicates or is_unknown or is_incomplete)


def _parse_numbers(
    path: Path, header: list[str], rows: list[list[str]]
) -> assets.Float64Array:
    """Return the numbers (rows, columns) of a table of waypoints.

    Args:
        path: the file, for messages.
        header: names of its columns.
        rows: cells of each row, as text.

    Raises:
        FileFormatError: it has too few or too many rows, or a cell is no number.
    """
    if not 2 <= len(rows) <= MAX_WAYPOINTS:
        raise errors.FileFormatError(
            f"{path}: expected 2 to {MAX_WAYPOINTS} waypoints, got {len(rows)}"
        )
    try:
        numbers = [[float(cell) for cell in row] for row in rows]
        return np.array(numbers, np.float64).reshape(len(rows), len(header))
    except ValueError as error:
        raise errors.FileFormatError(
            f"{path}: expected {len(header)} numbers in each row, got something else"
        ) from error


def _unwrap_heading_columns(
    path: Path, column: dict[str, assets.Float64Array]
) -> dict[str, tuple[str, ...]]:
    """Unwrap the columns of headings in a table (`unwrap_headings`).

    Args:
        path: the file, for the notes.
        column: columns (n,) of the file by name; those of headings are replaced.

    Returns:
        Notes for the user on each column of headings, by its name.
    """
    notes = dict[str, tuple[str, ...]]()
    for name in (HEADING_COLUMN, OBJECT_HEADING_COLUMN):
        if name in column:
            column[name], note = unwrap_headings(column[name])
            notes[name] = (f"{path}: {name}: {note}",) if note else ()
    return notes


def _stack_columns(
    column: Mapping[str, assets.Float64Array], names: Sequence[str]
) -> Tensor | None:
    """Return some columns of a table as a tensor (n, k), or (n,) for a single one.

    None if the table does not have them.
    """
    if names[0] not in column:
        return None
    values = np.stack([column[name] for name in names], axis=1).astype(np.float32)
    return torch.from_numpy(values if len(names) > 1 else values[:, 0])
