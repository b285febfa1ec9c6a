"""The entries of a camera file by name, and the camera model of their numbers.

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

MAX_SIDE = 1 << 16  # limit of the sides of an image
# Limits of coefficients, and of focal lengths in sides of the image.
MAX_COEFFICIENT = 1e4
MAX_FOCAL_RATIO = 1e3
IMAGE_CHANGING_KEYS = re.compile(
    r"xi|mu|mv|[dkps]\d?|t(au)?[xy]|alpha|beta|gamma\d*|omega|.*dist(?!ance).*|.*skew.*|.*shear.*|.*mirror.*|.*tilt.*|"
    r".*coeff.*|.*flip.*|.*rotate.*|image(rotation|scale)|scale(factor)?|resize.*|(is|image)?rectified|"
    r".*roi.*|.*crop.*|.*binning.*|.*decimat.*|.*fisheye.*|.*lens.*model|.*poly.*|.*affine.*|.*projectionparam.*"
)
"""Plain names of entries that change the image, and are rejected unless they are
read.
"""
# Plain names of entries about rectified images.
RECTIFICATION_KEYS = re.compile(r"r|p|rectificationmatrix|projectionmatrix")
IGNORED_KEYS = re.compile(
    # Who made it, when, and how accurately.
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


class Entries:
    """The entries of a camera file by plain names, with a record of which are read.

        entries.get("cameramatrix", "k")   # the first that has a value, or None
        entries.find_unread()              # the entries that were not read

    Raises:
        FileFormatError: two entries have the same plain name.
    """

    def __init__(self, path: str, values: Mapping[str, Any]) -> None:
        """Keep the entries by plain names; raises as the class says."""
        self.path = path
        self._keys: TrackedKeys[Any] = TrackedKeys(values, fold=normalize_key)
        for key in self._keys.repeated:
            later_key = self._keys.get_spelling(normalize_key(key))
            raise FileFormatError(
                f"{path}: has {format_name(key)} and {format_name(later_key)}; leave "
                "one of them out"
            )
        # Keys of matrices that are not read.
        self._unread_matrix_keys: list[str] = []

    def get(self, *names: str) -> Any:
        """Return the first of some entries that has a value, or None."""
        return self._keys.get(*names)

    def require(self, name: str, aliases: Sequence[str] = ()) -> Any:
        """Return an entry that is required, or the first of several names for it.

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
            aliases: other names for the entry, as `normalize_key` writes them; by
                default the entry has one name.

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
            FileFormatError: it has another length, or other values.
        """
        # OpenCV writes a matrix as a mapping; keys that are not of its format are noted
        if isinstance(entry, Mapping):
            self._unread_matrix_keys += [
                f"{name}.{key}" for key in entry if key not in MATRIX_KEYS
            ]
            entry = entry.get("data")
        values = _flatten(entry)
        if len(values) not in counts:
            expected = " or ".join(map(str, counts))
            raise FileFormatError(
                f"{self.path}: {name}: expected a list of {expected} numbers, got "
                f"{len(values)}"
            )
        return [parse_number(self.path, name, value) for value in values]

    def find_unread(self, prefix: str = "") -> list[str]:
        """Return the names of entries that were not read and need a note.

        They are spelled as in the file. Entries that change nothing need no note.

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
            if not self._may_change_image(name, value):
                unread.append(prefix + spelling)
            elif not is_neutral(value):
                raise FileFormatError(
                    f"{self.path}: expected no {format_name(prefix + spelling)}, got "
                    f"{format_name(str(value))}: it makes another picture and is not "
                    "read; calibrate with one of the models in docs/cameras.md"
                )
        return unread

    def _may_change_image(self, name: str, value: object) -> bool:
        """Return whether an entry of a plain name would change the image if it were
        read.

        Entries about rectified images would not; nor would those of the second camera
        of a stereo pair, which have a 2 at the end, as M2 beside M1.
        """
        if not IMAGE_CHANGING_KEYS.fullmatch(name):
            return False
        if RECTIFICATION_KEYS.fullmatch(name):
            return False
        is_matrix = isinstance(value, (list, Mapping))
        # k2 beside k1 is of the same camera
        is_coefficient = name in COEFFICIENTS and not is_matrix
        has_first_camera = name.endswith("2") and f"{name[:-1]}1" in self._keys
        return is_coefficient or not has_first_camera


def select_camera(path: str, camera_name: str, cameras: Mapping[str, Any]) -> Any:
    """Return the camera that is named, or the only one of a file.

    Args:
        path: the file, for messages.
        camera_name: "" if none is named.
        cameras: at least one, by name.

    Raises:
        FileFormatError: there is none of that name, or there are several and none is
            named.
    """
    names = list(map(str, cameras))
    listing = ", ".join(names[:8])
    if len(names) > 8:
        listing += ", ..."
    example = f"{path}#{names[0]}"
    if camera_name and camera_name not in names:
        raise FileFormatError(
            f"{path}: expected one of its cameras {listing}, got "
            f"{camera_name[:40]!r}; write {example}"
        )
    if not camera_name and len(names) > 1:
        raise FileFormatError(
            f"{path}: has {len(names)} cameras, {listing}: say which one takes the "
            f"picture, as in {example}"
        )
    return cameras[camera_name or names[0]]


def is_neutral(value: object) -> bool:
    """Return whether an entry changes nothing: it is zero, empty, false or "none".

    A matrix, a list or a mapping is neutral if all of its values are.
    """
    if isinstance(value, Mapping):
        # a matrix has its numbers as `data`
        value = value.get("data", list(value.values()))
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
        reason = "which are made of the camera's own ones; these are its own."
        unread.append(
            f"{' and '.join(rectified_keys)}, about rectified pictures, {reason}"
        )
    return replace(
        model,
        reading_notes=tuple(f"{model.name}: not read: {names}" for names in unread),
    )


def make_camera_model(
    spec: str,
    kind: str,
    size: tuple[float, float],
    pixel_values: Mapping[str, float],
    pixel_offset: float = 0.0,
) -> CameraModel:
    """Make a camera model of numbers in pixels.

    The model stores lengths along x in widths of the image, and those along y in
    heights. The numbers of a panorama follow from its size, whatever the file has.

    Args:
        spec: the file, and perhaps the camera in it.
        kind: the kind of model.
        size: height and width of the image.
        pixel_values: numbers by their names in `NUMBER_NAMES`; 0 by default.
        pixel_offset: coordinate of the image's corner in the file, with the sign
            reversed: 0.5 if the file counts from the center of the first pixel. It is
            added to the principal point.

    Raises:
        FileFormatError: no camera has such numbers.
    """
    path = spec.partition("#")[0]
    height, width = size
    if not all(side == int(side) and 1 <= side <= MAX_SIDE for side in size):
        raise FileFormatError(
            f"{path}: expected a width and a height from 1 to {MAX_SIDE} pixels, got "
            f"{width:g} x {height:g}"
        )
    if kind == EQUIRECTANGULAR:
        pixel_values = {
            "fx": width,
            "fy": height,
            "cx": width / 2.0,
            "cy": height / 2.0,
        }
        pixel_offset = 0.0
    value_by_name = {name: pixel_values.get(name, 0.0) for name in NUMBER_NAMES}
    value_by_name["cx"] = value_by_name["cx"] + pixel_offset
    value_by_name["cy"] = value_by_name["cy"] + pixel_offset
    _check_numbers(path, value_by_name, width, height)
    unit_by_name = {"fx": width, "fy": height, "cx": width, "cy": height, "skew": width}
    numbers = tuple(
        number / unit_by_name.get(name, 1.0) for name, number in value_by_name.items()
    )
    return CameraModel(kind, numbers, spec, (int(height), int(width)))


def _check_numbers(
    path: str, value_by_name: Mapping[str, float], width: float, height: float
) -> None:
    """Raise FileFormatError if numbers in pixels are those of no camera.

    Focal lengths have to be within a factor of `MAX_FOCAL_RATIO` of the image's sides,
    the principal point inside of the image, the skew at most fx, and coefficients at
    most `MAX_COEFFICIENT`, without their sign.

    Args:
        path: the file, for messages.
        value_by_name: numbers by their names in `NUMBER_NAMES`.
        width: width of the image in pixels.
        height: height of the image in pixels.
    """

    def check(name: str, is_valid: bool, expected: str, hint: str = "") -> None:
        """Raise the error of a number that is not valid."""
        if not is_valid:
            raise FileFormatError(
                f"{path}: {name}: expected {expected}, got "
                f"{value_by_name[name]:g}{hint}"
            )

    for name, side in (("fx", width), ("fy", height)):
        min_focal = side / MAX_FOCAL_RATIO
        max_focal = side * MAX_FOCAL_RATIO
        check(
            name,
            min_focal <= value_by_name[name] <= max_focal,
            f"a focal length from {min_focal:g} to {max_focal:g} pixels for a side of "
            f"{side:g}",
        )
    for name, side in (("cx", width), ("cy", height)):
        check(
            name,
            0.0 < value_by_name[name] < side,
            f"a principal point inside the picture, up to {side:g}",
        )
    check(
        "skew",
        abs(value_by_name["skew"]) <= value_by_name["fx"],
        f"less than fx, {value_by_name['fx']:g}",
    )
    for name in COEFFICIENTS:
        check(
            name,
            abs(value_by_name[name]) <= MAX_COEFFICIENT,
            f"a coefficient from -{MAX_COEFFICIENT:g} to {MAX_COEFFICIENT:g}",
            "; is it in the order of OpenCV?",
        )


# ---- Mounted cameras: ``--camera dashcam``, ``--camera robot`` ----
#
# They keep their height and do not roll.


@dataclass(frozen=True)
class CameraPreset:
    """The pose of a mounted camera, and what the control `camera` searches of it."""

    height: float  # height of the lens above the floor or the road, metres
    fov: float  # field of view along the larger side of the picture, degrees
    # From the object's center, metres; further if the object would not fit.
    distance: float
    # Whether azimuth 0 is in the object's lane, behind what drives there.
    in_lane: bool
    # how far to either side a search goes, degrees; 180 for all around
    search_azimuth: float
    # Other ranges that are searched by default; what has none stays.
    search_ranges: Mapping[str, tuple[float, float]]


PRESETS: Mapping[str, CameraPreset] = MappingProxyType(
    {
        # Behind the windscreen of a car, in the lane of the object. What glass and
        # dashboard do to a picture is not in it.
        "dashcam": CameraPreset(
            height=1.3,
            fov=75.0,
            distance=10.0,
            in_lane=True,
            search_azimuth=10.0,
            search_ranges={"distance": (6.0, 60.0), "fov": (60.0, 90.0)},
        ),
        # The head of a humanoid: the Unitree G1 is 1.32 m tall (its product page), with
        # a RealSense D435i in its face, about a tenth of a metre below the top. The
        # colour picture of that has 69 x 42 degrees, and its depth reaches to 3 m
        # (Clearpath Robotics, documentation of the RealSense D435).
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
"""Height and side in metres of a table of a bundled room, on which objects stand that
are no larger than `MAX_TABLETOP_SIZE`.
"""
MAX_TABLETOP_SIZE = 0.5  # metres of the longest side
