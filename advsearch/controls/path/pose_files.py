"""Trajectories of TUM, EuRoC and KITTI: text files with poses of a sensor in a world.

    TUM     timestamp tx ty tz qx qy qz qw             seconds, blanks between the numbers
    EuRoC   #timestamp [ns],p_RS_R_x [m],...,q_RS_w [],q_RS_x [],...   commas, real part first
    KITTI   12 numbers: the pose (3, 4), row by row    no times: 10 poses a second

A header names the columns, in any order. Without a header, 8 numbers are TUM's and 12
KITTI's. None of these files states the axes of the sensor, or the upward direction of the
world.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from advsearch.extend import assets, errors, reading

MAX_COLUMNS = 64
MAX_ROWS = 100_000
KITTI_RATE = 10.0  # poses a second
QUATERNION_TOLERANCE = 0.01  # how far from 1 the length of a quaternion may be
ROTATION_TOLERANCE = 1e-3
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
UNIT_BY_SIZE = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""Smallest size of a time since 1970 in each unit, for times whose unit is not stated."""

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
# columns by which a table of waypoints is recognized, which is none of these formats
WAYPOINT_COLUMNS = {"time", *POSITION}
TIME_NAME = re.compile(r"(time_?)?stamp|time|t|sec(ond)?s?")
POSITION_NAME = re.compile(
    r"(?:t|p|p_\w+_|pos(?:ition)?[._]?|translation[._]?)?([xyz])"
)
QUATERNION_NAME = re.compile(
    r"q(?:uat(?:ernion)?)?(?:_\w+)?[._]?([wxyz])|(?:rotation|orientation)[._]?([wxyz])"
)
UNIT = re.compile(r"\[([^\]]*)\]")

OPTICAL = "optical"
NO_AXES = "none"
SENSOR_AXES: Mapping[str, assets.Float64Array] = {
    OPTICAL: np.eye(3),
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "flu": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    "frd": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "euroc": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""Rotations from a camera's axes (x right, y down, z ahead) to those of the sensor, by the
name of the sensor's axes.
"""
AXES_DESCRIPTIONS: Mapping[str, str] = {
    OPTICAL: "x right, y down, z ahead",
    "opengl": "x right, y up, z back",
    "flu": "x ahead, y left, z up",
    "frd": "x ahead, y right, z down",
    "euroc": "x up, y right, z ahead",
    NO_AXES: "not read: the camera looks at the object",
}
WORLD_TO_Z_UP: Mapping[str, assets.Float64Array] = {
    "z": np.eye(3),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-y": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}
"""Rotations from the file's world to one whose z is up, by the file's upward axis."""


class PoseFormat(Enum):
    """A format of trajectories; its value names such a file in messages."""

    TUM = "TUM's trajectory"
    EUROC = "EuRoC's trajectory"
    KITTI = "KITTI's poses"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses from a file, in the axes and the world of the file.

    Attributes:
        format: format of the file.
        times: (n,) seconds from the first pose; None if the file has no times.
        positions: (n, 3) positions of the sensor.
        rotations: n rotations from the sensor's axes to the world's; None if the file
            has none.
        notes: sentences for the user about how the file was read.
    """

    format: PoseFormat
    times: assets.Float64Array | None
    positions: assets.Float64Array
    rotations: Rotation | None
    notes: tuple[str, ...]

    @property
    def default_up(self) -> str:
        return "-y" if self.format is PoseFormat.KITTI else "z"

    def orient(
        self, axes: str, up: str, origin: Sequence[float]
    ) -> tuple[assets.Float64Array, Rotation | None]:
        """Return positions and rotations in a world whose z is up.

        Args:
            axes: axes of the sensor, a key of `SENSOR_AXES`, or `NO_AXES`.
            up: upward axis of the file's world, a key of `WORLD_TO_Z_UP`.
            origin: (3,) the object's position in the file's world.

        Returns:
            Positions (n, 3) relative to the origin; and rotations from a camera's axes
            (x right, y down, z ahead), None if the axes are `NO_AXES` or the file has
            none.
        """
        world_to_z_up = Rotation.from_matrix(WORLD_TO_Z_UP[up])
        positions = world_to_z_up.apply(self.positions - np.asarray(origin, np.float64))
        if axes == NO_AXES or self.rotations is None:
            return positions, None
        # from a camera's axes to the sensor's, to the file's world, to a world with z up
        camera_to_sensor = Rotation.from_matrix(SENSOR_AXES[axes])
        return positions, world_to_z_up * self.rotations * camera_to_sensor


def read_trajectory(path: Path, text: str) -> Trajectory | None:
    """Read the poses in the text of a file; None if it is in none of the formats.

    Lines before the first row of numbers may be headers, also as comments ("#"). The
    last one that names the columns of a trajectory is used. Without a header, rows of 8
    numbers are TUM's and rows of 12 are KITTI's. For a table with another header, e.g.
    of waypoints, the result is None.

    Args:
        path: the file, for messages.
        text: its text.

    Raises:
        FileFormatError: rows have different lengths, numbers are not finite,
            quaternions do not have the length 1, matrices are no rotations, or the
            columns of the table are unknown.
    """
    lines = _list_filled_lines(text)
    first_row = next((index for index, line in enumerate(lines) if _is_row(line)), None)
    if first_row is None:
        return None
    has_commas = "," in lines[first_row]
    candidates = [_split(line.lstrip("#").strip()) for line in lines[:first_row]]
    # `_find_columns` is empty for a line that does not name a trajectory's columns
    headers = [names for names in candidates if _find_columns(names)]
    if not headers and _is_other_table(candidates, has_commas):
        return None
    # without comments between the rows
    rows = [_split(line) for line in lines[first_row:] if not line.startswith("#")]
    _check_row_count(path, rows)
    if headers:
        return _read_named_columns(path, headers[-1], rows, has_commas)
    return _read_unnamed_columns(path, rows, has_commas)


def _list_filled_lines(text: str) -> list[str]:
    """Return the lines of a text that are not blank, without space around them."""
    lines = [line.strip() for line in text.splitlines()]
    return [line for line in lines if line]


def _is_other_table(candidates: Sequence[Sequence[str]], has_commas: bool) -> bool:
    """Return whether lines before the first row are headers of another kind of table.

    Args:
        candidates: cells of each line, none of which names a trajectory's columns.
        has_commas: whether commas separate the columns.
    """
    is_waypoint_table = any(WAYPOINT_COLUMNS <= set(names) for names in candidates)
    # Between commas, a line before the numbers is a header of another kind of table.
    # Without commas it may be a comment, as files of TUM have them.
    has_unknown_header = has_commas and bool(candidates)
    return is_waypoint_table or has_unknown_header


def _check_row_count(path: Path, rows: Sequence[Sequence[str]]) -> None:
    """Raise FileFormatError if a trajectory has too many rows."""
    if len(rows) > MAX_ROWS:
        raise errors.FileFormatError(
            f"{path}: expected 2 to {MAX_ROWS} waypoints, got {len(rows)}"
        )


def _read_unnamed_columns(
    path: Path, rows: Sequence[Sequence[str]], has_commas: bool
) -> Trajectory:
    """Read a table without a header: 8 columns are TUM's, and 12 are KITTI's.

    Args:
        path: the file, for messages.
        rows: cells of each row, as text.
        has_commas: whether commas separate the columns, as in EuRoC's files.

    Raises:
        FileFormatError: it has commas, or another number of columns.
    """
    if has_commas:
        raise _make_header_error(path)
    count = len(rows[0])
    if count == 8:
        names = ["timestamp", "tx", "ty", "tz", *QUATERNION]
        return _read_named_columns(path, names, rows, False)
    if count == 12:
        return _read_kitti(path, rows)
    raise _make_column_count_error(path, count)


def _make_column_count_error(path: Path, count: int) -> errors.FileFormatError:
    """Return the error for a table of poses without a header, with `count` columns."""
    hint = ""
    # a matrix of 12 or 16 numbers after the index of an image
    if count in (13, 17):
        hint = " (KITTI-360's first column is the index of a picture; leave it out)"
    return errors.FileFormatError(
        f"{path}: expected 8 numbers a line as TUM's timestamp tx ty tz qx qy qz qw, "
        "or 12 as KITTI's poses, got "
        f"{count}{hint}"
    )


def _make_header_error(path: Path) -> errors.FileFormatError:
    """Return the error for a table with commas, but without names of columns."""
    return errors.FileFormatError(
        f"{path}: expected a first line that names the columns, got numbers; add "
        "time,x,y,z, or the line of EuRoC's "
        "files: #timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w "
        "[],q_RS_x [],q_RS_y [],q_RS_z []"
    )


def _split(line: str) -> list[str]:
    return [word.strip() for word in line.split(",")] if "," in line else line.split()


def _is_row(line: str) -> bool:
    return not line.startswith("#") and all(map(reading.is_number, _split(line)))


def _find_column(name: str) -> str | None:
    """Return the standard name of a trajectory's column, such as "qx".

    The standard names are time, x, y, z, qx, qy, qz and qw. The result is None for other
    columns.
    """
    plain = UNIT.sub("", name).strip().lower()
    if TIME_NAME.fullmatch(plain):
        return "time"
    position = POSITION_NAME.fullmatch(plain)
    if position:
        return position[1]  # the group "x", "y" or "z" of the pattern
    quaternion = QUATERNION_NAME.fullmatch(plain)
    if quaternion:
        # The pattern has two ways to write a component, with a group for each.
        component = quaternion[1] or quaternion[2]
        return f"q{component}"
    return None


def _find_columns(names: Sequence[str]) -> dict[str, int]:
    """Return the index of each column of a trajectory by its standard name.

    The standard names are time, x, y, z, and perhaps qx, qy, qz and qw. The result is
    empty if the table is no trajectory: if the time, a coordinate or a part of the
    quaternion is missing, a column is there twice, or it is a table of waypoints.
    """
    # at least time, x, y and z
    if not 4 <= len(names) <= MAX_COLUMNS:
        return {}
    columns = dict[str, int]()
    for index, name in enumerate(names):
        column = _find_column(name)
        if column is None:
            continue
        if column in columns:
            return {}
        columns[column] = index
    return columns if _are_columns_of_trajectory(columns.keys(), names) else {}


def _are_columns_of_trajectory(columns: Set[str], names: Sequence[str]) -> bool:
    """Return whether all columns of a trajectory are in a table, which has no others.

    Args:
        columns: standard names of the columns.
        names: names in the file.
    """
    has_quaternion = set(QUATERNION) <= columns
    has_any_component = not set(QUATERNION).isdisjoint(columns)
    has_part_of_quaternion = has_any_component and not has_quaternion
    if has_part_of_quaternion or not {"time", *POSITION} <= columns:
        return False
    # A table of waypoints has no quaternion, but the same names for time and position.
    is_waypoint_table = not has_quaternion and WAYPOINT_COLUMNS <= set(names)
    return not is_waypoint_table


def _read_table(
    path: Path, rows: Sequence[Sequence[str]], count: int
) -> assets.Float64Array:
    """Return a table of numbers (rows, count).

    Raises:
        FileFormatError: a row has another length, or a cell is no finite number.
    """
    for row in rows:
        _check_row(path, row, count)
    table: assets.Float64Array = np.array(rows, dtype=object).astype(np.float64)
    if not np.isfinite(table).all():
        raise errors.FileFormatError(
            f"{path}: expected finite numbers, got infinity or NaN"
        )
    return table


def _check_row(path: Path, row: Sequence[str], count: int) -> None:
    """Raise FileFormatError if a row has another length, or a cell is no number."""
    if len(row) != count or not all(map(reading.is_number, row)):
        raise errors.FileFormatError(
            f"{path}: expected {count} numbers in each row, got "
            f"{reading.format_name(' '.join(row))}"
        )


def _read_named_columns(
    path: Path, names: Sequence[str], rows: Sequence[Sequence[str]], has_commas: bool
) -> Trajectory:
    """Read a table whose columns have the names of TUM or EuRoC.

    Times are converted to seconds after the first pose. Unknown columns are left out,
    with a note.

    Args:
        path: the file, for messages.
        names: names of the columns.
        rows: cells of each row, as text.
        has_commas: whether commas separate the columns, as in EuRoC's files.
    """
    columns = _find_columns(names)
    table = _read_table(path, rows, len(names))
    notes = _list_unread_columns(path, names, columns)
    times = table[:, columns["time"]]
    time_name = names[columns["time"]]
    unit = _find_time_unit(path, time_name, times, notes)  # may add to `notes`
    # Differences are converted, since the product of a time since 1970 and the unit would
    # be rounded.
    times = (times - times[0]) * UNITS[unit]
    positions = table[:, [columns[name] for name in POSITION]]
    rotations = _read_rotations(path, table, columns) if "qw" in columns else None
    pose_format = PoseFormat.EUROC if has_commas else PoseFormat.TUM
    return Trajectory(pose_format, times, positions, rotations, tuple(notes))


def _list_unread_columns(
    path: Path, names: Sequence[str], columns: Mapping[str, int]
) -> list[str]:
    """Return a note on columns of a file that are left out, or none."""
    used_indices = set(columns.values())
    unread = [name for index, name in enumerate(names) if index not in used_indices]
    return [f"{path}: not read: {reading.join_names(unread)}."] if unread else []


def _read_rotations(
    path: Path, table: assets.Float64Array, columns: Mapping[str, int]
) -> Rotation:
    """Return the rotations in a table, whose columns have indices by name."""
    quaternions = table[:, [columns[name] for name in QUATERNION]]
    _check_quaternions(path, quaternions)
    return Rotation.from_quat(quaternions)


def _find_time_unit(
    path: Path, name: str, times: assets.Float64Array, notes: list[str]
) -> str:
    """Return the unit of a column of times, such as "ns".

    If the column's name does not state it, it is guessed from the size of the times,
    and a note is added.

    Args:
        path: the file, for messages.
        name: name of the column, e.g. "timestamp [ns]".
        times: (n,) times as in the file.
        notes: notes for the user; it may be extended.

    Raises:
        FileFormatError: the stated unit is unknown.
    """
    stated = UNIT.search(name)
    if stated:
        return _check_time_unit(path, stated[1].strip())
    # The unit of a time since 1970 follows from its size: nanoseconds are the largest
    # numbers.
    for min_time, unit in UNIT_BY_SIZE:
        if abs(times[0]) >= min_time:
            notes.append(
                f"{path}: the unit of its times is not stated; by their size they "
                f"are read as {unit}."
            )
            return unit
    return "s"


def _check_time_unit(path: Path, unit: str) -> str:
    """Return a unit that the first line of a file states; raise if it is unknown."""
    if unit not in UNITS:
        raise errors.FileFormatError(
            f"{path}: expected times in {', '.join(UNITS)}, got "
            f"{reading.format_name(unit)}; correct the first line"
        )
    return unit


def _check_quaternions(path: Path, quaternions: assets.Float64Array) -> None:
    """Raise FileFormatError if one of the quaternions (n, 4) has another length than 1."""
    lengths = np.linalg.norm(quaternions, axis=1)
    error = np.abs(lengths - 1.0)
    if error.max() > QUATERNION_TOLERANCE:
        worst = int(error.argmax())
        raise errors.FileFormatError(
            f"{path}: pose {worst + 1}: expected a quaternion of length 1, got one "
            f"of {lengths[worst]:.3g}"
        )


def _read_kitti(path: Path, rows: Sequence[Sequence[str]]) -> Trajectory:
    """Read KITTI's poses: in each row a matrix (3, 4), a rotation and a shift.

    Raises:
        FileFormatError: a matrix is no rotation.
    """
    poses = _read_table(path, rows, 12).reshape(-1, 3, 4)
    matrices = poses[:, :, :3]
    _check_matrices(path, matrices)
    rotations = Rotation.from_matrix(matrices)
    return Trajectory(
        PoseFormat.KITTI,
        times=None,
        positions=poses[:, :, 3],
        rotations=rotations,
        notes=(),
    )


def _check_matrices(path: Path, matrices: assets.Float64Array) -> None:
    """Raise FileFormatError if one of the matrices (n, 3, 3) is no rotation."""
    # A rotation times its transpose is the identity. The same is true for a reflection,
    # but that has a negative determinant.
    products = matrices @ matrices.transpose(0, 2, 1)
    error = np.abs(products - np.eye(3)).max(axis=(1, 2))
    error = np.where(np.linalg.det(matrices) > 0.0, error, np.inf)
    if error.max() > ROTATION_TOLERANCE:
        raise errors.FileFormatError(
            f"{path}: pose {int(error.argmax()) + 1}: expected a rotation and a shift "
            "(3 "
            "rows of 4), got another map"
        )
