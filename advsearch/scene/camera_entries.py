"""The entries of a camera file by name, and the camera model that they describe.

An entry that is not read is noted, or rejected if it changes the image.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

from advsearch.errors import FileFormatError
from advsearch.scene.camera_model import (
    COEFFICIENTS,
    EQUIRECTANGULAR,
    NUMBER_NAMES,
    CameraModel,
)
from advsearch.scene.importing.files import format_name
from advsearch.scene.importing.unread import TrackedKeys, join_names

MAX_SIDE = 1 << 16  # largest width or height of an image, pixels
MAX_COEFFICIENT = 1e4  # largest absolute value of a distortion coefficient
# A focal length is at most this many sides of the image, and at least 1 / this many.
MAX_FOCAL_RATIO = 1e3
IMAGE_CHANGING_KEYS = re.compile(
    r"xi|mu|mv|[dkps]\d?|t(au)?[xy]|alpha|beta|gamma\d*|omega|.*dist(?!ance).*|.*skew.*|.*shear.*|.*mirror.*|.*tilt.*|"
    r".*coeff.*|.*flip.*|.*rotate.*|image(rotation|scale)|scale(factor)?|resize.*|(is|image)?rectified|"
    r".*roi.*|.*crop.*|.*binning.*|.*decimat.*|.*fisheye.*|.*lens.*model|.*poly.*|.*affine.*|.*projectionparam.*"
)
"""Plain names of entries that change the image. An entry with such a name is rejected
unless it is read.
"""
# Plain names of entries about rectified images.
RECTIFICATION_KEYS = re.compile(r"r|p|rectificationmatrix|projectionmatrix")
IGNORED_KEYS = re.compile(
    # By whom, when and how accurately the camera was calibrated.
    r"camera(name|id|info|label|serial.*|index)?|camname|name|label|sensor(type|name|id)?|serial(number)?|comment|version"
    r"|header|stamp|frameid|seq|rostopic|topic|ratehz|fps|framerate|calibration(time|date|flags)|date|time|flags(value)?"
    r"|(nr?|numberof)?(of)?frames(count)?|nrof(frames|images)|nimages|(avg|mean)?reprojectionerrors?|rms(error)?|error"
    r"|avgreprojectionerror|perviewreprojectionerrors?|imagepoints|gridpoints|objectpoints|imagelist"
    r"|board.*|square(size)?|pattern.*|marker.*|aspectratio|fixaspectratio|fixprincipalpoint.*|zerotangent.*"
    # The pose of the camera.
    r"|t(bs|cam.*|imu.*|cn.*|bc.*|ic.*|bodycam.*)|extrinsic.*|[rt]vecs?|camoverlaps|timeshift.*"
)
"""Plain names of entries that do not change the image and need no note."""
MATRIX_KEYS = frozenset(("rows", "cols", "dt", "data", "sizes", "type_id"))


def normalize_key(name: str) -> str:
    """Return a name in lower case, without separators between its words."""
    return re.sub(r"[-_\s.]", "", name).lower()


class CameraEntries:
    """The entries of a camera file, with a record of which have been read.

        entries.get("cameramatrix", "k")   # the first that has a value, or None
        entries.find_unread()              # the entries that were not read

    Entries are found by their plain names, which `normalize_key` makes.
    """

    def __init__(self, path: str, values: Mapping[str, Any]) -> None:
        """Store the entries by their keys as `normalize_key` writes them.

        Raises FileFormatError if two entries have the same normalized key.
        """
        self.path = path
        self._keys: TrackedKeys[Any] = TrackedKeys(values, fold=normalize_key)
        if self._keys.repeated:
            key = self._keys.repeated[0]
            # the spelling of the last entry with the same normalized key
            later_key = self._keys.get_spelling(normalize_key(key))
            raise FileFormatError(
                f"{path}: has {format_name(key)} and {format_name(later_key)}; leave "
                "one of them out"
            )
        # Keys inside matrices that `parse_numbers` did not read, as "matrix.key".
        self._unread_matrix_keys: list[str] = []

    def get(self, *names: str) -> Any:
        """Return the value of the first of these names that has one, or None."""
        return self._keys.get(*names)

    def require(self, name: str, aliases: Sequence[str] = ()) -> Any:
        """Return the value of an entry that is required.

        Args:
            name: name of the entry.
            aliases: the normalized names that the entry may have, of which the first
                with a value is used; by default only that of `name`.

        Raises:
            FileFormatError: there is none.
        """
        value = self.get(*(aliases or (normalize_key(name),)))
        if value is None:
            spelled = [self._keys.get_spelling(key) for key, _ in self._keys.items()]
            got = join_names(spelled, 8) or "nothing"
            raise FileFormatError(f"{self.path}: expected {name}, got {got}; add it")
        return value

    def get_number(
        self, name: str, default: float | None = None, aliases: Sequence[str] = ()
    ) -> float:
        """Return a finite number, or a default if there is no such entry.

        Args:
            name: name of the entry.
            default: value if there is no such entry; None if the entry is required.
            aliases: the normalized names that the entry may have, of which the first
                with a value is used; by default only that of `name`.

        Raises:
            FileFormatError: it is no number, or is required and missing.
        """
        is_missing = self.get(*(aliases or (normalize_key(name),))) is None
        if is_missing and default is not None:
            return default
        return parse_number(self.path, name, self.require(name, aliases))

    def parse_numbers(
        self, name: str, entry: object, counts: Sequence[int]
    ) -> list[float]:
        """Return a list of numbers: flat, in rows, or in the `data` of a matrix.

        Args:
            name: name of the entry, for messages.
            entry: its value.
            counts: the lengths that it may have.

        Raises:
            FileFormatError: the list has another length, or a value is no finite number.
        """
        if isinstance(entry, Mapping):
            entry = self._read_matrix_data(name, entry)
        values = _flatten(entry)
        if len(values) not in counts:
            expected = " or ".join(map(str, counts))
            raise FileFormatError(
                f"{self.path}: {name}: expected a list of {expected} numbers, got "
                f"{len(values)}"
            )
        return [parse_number(self.path, name, value) for value in values]

    def _read_matrix_data(self, name: str, matrix: Mapping[Any, Any]) -> object:
        """Return the `data` of a matrix, which OpenCV writes as a mapping.

        Its keys are noted if they are not of OpenCV's format. `name` is that of the
        entry.
        """
        self._unread_matrix_keys += [
            f"{name}.{key}" for key in matrix if key not in MATRIX_KEYS
        ]
        return matrix.get("data")

    def find_unread(self, prefix: str = "") -> list[str]:
        """Return the names of entries that were not read and need a note.

        They are spelled as in the file. An entry that could change the image, but has
        a neutral value such as 0, needs no note.

        Args:
            prefix: for entries inside another one, its name with a dot, such as "roi.".

        Raises:
            FileFormatError: one of them changes the image.
        """
        unread = [prefix + key for key in self._unread_matrix_keys]
        for spelling in self._keys.find_unread(
            lambda name, _: IGNORED_KEYS.fullmatch(name) is not None
        ):
            name = normalize_key(spelling)
            value = self._keys.peek(name)
            if self._is_image_changing_entry(name, value):
                self._check_is_neutral(prefix + spelling, value)
            else:
                unread.append(prefix + spelling)
        return unread

    def _check_is_neutral(self, spelling: str, value: object) -> None:
        """Raise FileFormatError for an entry that changes the image and is not read."""
        if not has_no_effect(value):
            raise FileFormatError(
                f"{self.path}: expected no {format_name(spelling)}, got "
                f"{format_name(str(value))}: it changes the picture and is not "
                "read; calibrate with one of the models in docs/cameras.md"
            )

    def _is_image_changing_entry(self, name: str, value: object) -> bool:
        """Return whether an entry describes the image of this camera.

        Entries about rectified images do not. Nor do entries of the second camera of a
        stereo pair, such as the matrix M2 if there is an M1. (But k2 with a single
        number is the second distortion coefficient of the first camera.)

        Args:
            name: normalized key of the entry.
            value: its value.
        """
        if not IMAGE_CHANGING_KEYS.fullmatch(name):
            return False
        if RECTIFICATION_KEYS.fullmatch(name):
            return False
        is_single_value = not isinstance(value, (list, Mapping))
        if is_single_value and name in COEFFICIENTS:
            return True
        is_of_second_camera = name.endswith("2") and f"{name[:-1]}1" in self._keys
        return not is_of_second_camera


def select_camera(path: str, camera_name: str, cameras: Mapping[str, Any]) -> Any:
    """Return the camera that is named, or the only one of a file.

    Args:
        path: the file, for messages.
        camera_name: "" if the user has not named one.
        cameras: at least one, by name.

    Raises:
        FileFormatError: there is none of that name, or there are several and the user
            has not named one.
    """
    names = list(map(str, cameras))
    listing = _list_first_names(names)
    example = f"{path}#{names[0]}"
    if camera_name and camera_name not in names:
        raise FileFormatError(
            f"{path}: expected one of its cameras {listing}, got "
            f"{camera_name[:40]!r}; write {example}"
        )
    if not camera_name and len(names) > 1:
        raise FileFormatError(
            f"{path}: has {len(names)} cameras, {listing}: name the one that takes the "
            f"picture, as in {example}"
        )
    return cameras[camera_name or names[0]]


def _list_first_names(names: Sequence[str]) -> str:
    """Return the first eight names of a list, for messages."""
    max_names = 8
    listing = ", ".join(names[:max_names])
    return f"{listing}, ..." if len(names) > max_names else listing


def has_no_effect(value: object) -> bool:
    """Return whether an entry changes nothing: it is missing, 0, "", false or "none".

    A number may also be a string, such as "0.0". A matrix, a list or a mapping changes
    nothing if all of its values change nothing.
    """
    if isinstance(value, Mapping):
        all_values = list(value.values())
        # OpenCV's matrix is a mapping with its numbers as `data`.
        value = value.get("data", all_values)
    return all(
        cell in (None, False, "", "none") or _to_float(str(cell)) == 0.0
        for cell in _flatten(value)
    )


def _to_float(value: object) -> float:
    """Return a value as a number, NaN if it is none."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return math.nan
    try:
        return float(value)
    except (ValueError, OverflowError):
        return math.nan


def _flatten(value: object) -> list[Any]:
    """Return the values of a list of lists, of a list, or of a single value."""
    values: list[Any] = []
    for row in value if isinstance(value, list) else [value]:
        values += row if isinstance(row, list) else [row]
    return values


def parse_number(path: str, name: str, entry: object) -> float:
    """Return an entry as a finite number.

    Raises:
        FileFormatError: it is none.
    """
    value = _to_float(entry)
    if not math.isfinite(value):
        raise FileFormatError(
            f"{path}: {name}: expected a finite number, got {str(entry)[:40]!r}; "
            "correct it"
        )
    return value


def add_notes(
    model: CameraModel, unread_keys: Sequence[str], rectified_keys: Sequence[str] = ()
) -> CameraModel:
    """Return a model with notes on the entries that were not read.

    Args:
        model: the model.
        unread_keys: names of entries that were not read.
        rectified_keys: names of entries about rectified images, which were not read.
    """
    unread = [f"{join_names(unread_keys)}."] if unread_keys else []
    if rectified_keys:
        names = " and ".join(rectified_keys)
        unread.append(
            f"{names}, about rectified pictures; the model is for the camera's "
            "pictures before rectification."
        )
    return replace(
        model,
        reading_notes=tuple(f"{model.name}: not read: {text}" for text in unread),
    )


def make_camera_model(
    spec: str,
    kind: str,
    size: tuple[float, float],
    pixel_values: Mapping[str, float],
    pixel_offset: float = 0.0,
) -> CameraModel:
    """Make a camera model from numbers in pixels.

    The model stores lengths along x in widths of the image, and those along y in
    heights. The numbers of a panorama follow from its size; those of the file are
    ignored.

    Args:
        spec: the file, and perhaps the camera in it, such as ``calib.yaml#cam1``.
        kind: the kind of model.
        size: height and width of the image.
        pixel_values: numbers by their names in `NUMBER_NAMES`; 0 by default.
        pixel_offset: number that is added to the principal point, so that it counts
            from the image's corner: 0.5 if the file counts from the center of the first
            pixel, 0.0 if it counts from the corner.

    Raises:
        FileFormatError: a size or a number is out of its range.
    """
    path = spec.partition("#")[0]
    height, width = size
    _check_side_lengths(path, size)
    value_by_name = _complete_numbers(kind, size, pixel_values, pixel_offset)
    _check_numbers(path, value_by_name, width, height)
    numbers = tuple(
        number / _get_unit(name, size) for name, number in value_by_name.items()
    )
    return CameraModel(
        kind=kind,
        intrinsics=numbers,
        name=spec,
        calibrated_shape=(int(height), int(width)),
    )


def _complete_numbers(
    kind: str,
    size: tuple[float, float],
    pixel_values: Mapping[str, float],
    pixel_offset: float,
) -> dict[str, float]:
    """Return the numbers of a camera in pixels, by all `NUMBER_NAMES`.

    The arguments are those of `make_camera_model`.
    """
    if kind == EQUIRECTANGULAR:
        pixel_values = _make_panorama_numbers(size)
        pixel_offset = 0.0
    value_by_name = {name: pixel_values.get(name, 0.0) for name in NUMBER_NAMES}
    value_by_name["cx"] += pixel_offset
    value_by_name["cy"] += pixel_offset
    return value_by_name


def _check_side_lengths(path: str, size: tuple[float, float]) -> None:
    """Raise FileFormatError if a height and a width are no numbers of pixels."""
    height, width = size
    if not all(side == int(side) and 1 <= side <= MAX_SIDE for side in size):
        raise FileFormatError(
            f"{path}: expected a width and a height from 1 to {MAX_SIDE} pixels, got "
            f"{width:g} x {height:g}"
        )


def _make_panorama_numbers(size: tuple[float, float]) -> dict[str, float]:
    """Return the numbers of a panorama of a size (height, width), by name."""
    height, width = size
    return {"fx": width, "fy": height, "cx": width / 2.0, "cy": height / 2.0}


def _get_unit(name: str, size: tuple[float, float]) -> float:
    """Return the length in pixels that is 1 for a number of a model.

    Lengths are divided by a side (height, width) of the image; coefficients have no
    unit.
    """
    height, width = size
    unit_by_name = {"fx": width, "fy": height, "cx": width, "cy": height, "skew": width}
    return unit_by_name.get(name, 1.0)


def _check_numbers(
    path: str, value_by_name: Mapping[str, float], width: float, height: float
) -> None:
    """Raise FileFormatError if a number of a camera, in pixels, is out of its range.

    Focal lengths have to be within a factor of `MAX_FOCAL_RATIO` of the image's sides,
    and the principal point inside the image. The absolute value of the skew is at most
    fx, and that of a coefficient at most `MAX_COEFFICIENT`.

    Args:
        path: the file, for messages.
        value_by_name: numbers by their names in `NUMBER_NAMES`.
        width: width of the image in pixels.
        height: height of the image in pixels.
    """

    check = _NumberCheck(path, value_by_name)
    for name, side in (("fx", width), ("fy", height)):
        check.check_focal_length(name, side)
    for name, side in (("cx", width), ("cy", height)):
        check.check_center(name, side)
    check.check_skew()
    for name in COEFFICIENTS:
        check.check_coefficient(name)


@dataclass(frozen=True)
class _NumberCheck:
    """Checks of the numbers of a camera in pixels."""

    path: str  # the file, for messages
    value_by_name: Mapping[str, float]

    def check_focal_length(self, name: str, side: float) -> None:
        """Check a focal length along a side of the image."""
        min_focal = side / MAX_FOCAL_RATIO
        max_focal = side * MAX_FOCAL_RATIO
        self._require(
            name,
            min_focal <= self.value_by_name[name] <= max_focal,
            f"a focal length from {min_focal:g} to {max_focal:g} pixels for a side of "
            f"{side:g}",
        )

    def check_center(self, name: str, side: float) -> None:
        """Check a coordinate of the principal point along a side of the image."""
        self._require(
            name,
            0.0 < self.value_by_name[name] < side,
            f"a principal point inside the picture, up to {side:g}",
        )

    def check_skew(self) -> None:
        """Check the skew."""
        self._require(
            "skew",
            abs(self.value_by_name["skew"]) <= self.value_by_name["fx"],
            f"less than fx, {self.value_by_name['fx']:g}",
        )

    def check_coefficient(self, name: str) -> None:
        """Check a coefficient of the distortion."""
        self._require(
            name,
            abs(self.value_by_name[name]) <= MAX_COEFFICIENT,
            f"a coefficient from -{MAX_COEFFICIENT:g} to {MAX_COEFFICIENT:g}",
            "; is it in the order of OpenCV?",
        )

    def _require(
        self, name: str, is_valid: bool, expected: str, hint: str = ""
    ) -> None:
        """Raise FileFormatError if a number is not valid."""
        if not is_valid:
            raise FileFormatError(
                f"{self.path}: {name}: expected {expected}, got "
                f"{self.value_by_name[name]:g}{hint}"
            )


# ---- Mounted cameras: ``--camera dashcam``, ``--camera robot`` ----
#
# They keep their height and do not roll.


@dataclass(frozen=True)
class CameraPreset:
    """The pose of a mounted camera, and the ranges that a search of it covers."""

    height: float  # height of the lens above the floor or the road, meters
    fov: float  # field of view along the larger side of the picture, degrees
    # Distance from the object's center, meters. It is larger if the object would not
    # fit into the image.
    distance: float
    # Whether azimuth 0 is in the object's lane, behind an object that drives there.
    in_lane: bool
    search_azimuth: float  # largest azimuth to either side, degrees; 180: all around
    # Ranges of other parameters that are searched by default. A parameter without a
    # range stays fixed.
    search_ranges: Mapping[str, tuple[float, float]]


PRESETS: Mapping[str, CameraPreset] = MappingProxyType(
    {
        # Behind the windscreen of a car, in the lane of the object. Effects of the
        # glass and the dashboard on the picture are not modeled.
        "dashcam": CameraPreset(
            height=1.3,
            fov=75.0,
            distance=10.0,
            in_lane=True,
            search_azimuth=10.0,
            search_ranges={"distance": (6.0, 60.0), "fov": (60.0, 90.0)},
        ),
        # The head of a humanoid: the Unitree G1 is 1.32 m tall (its product page), with
        # a RealSense D435i in its face, about a tenth of a meter below the top. Its
        # color picture has a field of view of 69 x 42 degrees, and its depth reaches to
        # 3 m (Clearpath Robotics, documentation of the RealSense D435).
        "robot": CameraPreset(
            height=1.2,
            fov=69.0,
            distance=1.0,
            in_lane=False,
            search_azimuth=180.0,
            search_ranges={"distance": (0.5, 3.0)},
        ),
    }
)
"""The mounted cameras by name."""
TABLE_HEIGHT = 0.75
TABLE_SIDE = 1.2
"""Height and side, in meters, of the table of a bundled room. Objects stand on it if
they are no larger than `MAX_TABLETOP_SIZE`.
"""
MAX_TABLETOP_SIZE = 0.5  # longest side of an object on a table, meters
