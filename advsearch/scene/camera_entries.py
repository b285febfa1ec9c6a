"""The entries of a camera file by name, and the model that their numbers make.

What nobody asked for is named, or refused where it makes another picture.
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
    NUMBERS,
    CameraModel,
)
from advsearch.scene.importing.files import shown
from advsearch.scene.importing.unread import TrackedKeys, join_names

MOST_PIXELS = 1 << 16  # largest side of a picture
# of coefficients, and of focal lengths in sides of the picture
LARGEST_COEFFICIENT = 1e4
LARGEST_FOCAL = 1e3
BENDS = re.compile(
    r"xi|mu|mv|[dkps]\d?|t(au)?[xy]|alpha|beta|gamma\d*|omega|.*dist(?!ance).*|.*skew.*|.*shear.*|.*mirror.*|.*tilt.*|"
    r".*coeff.*|.*flip.*|.*rotate.*|image(rotation|scale)|scale(factor)?|resize.*|(is|image)?rectified|"
    r".*roi.*|.*crop.*|.*binning.*|.*decimat.*|.*fisheye.*|.*lens.*model|.*poly.*|.*affine.*|.*projectionparam.*"
)
"""Entries, by their plain names, that make another picture: in none of the models that
are read, they are refused.
"""
# pictures made of its own ones
OF_RECTIFIED = re.compile(r"r|p|rectificationmatrix|projectionmatrix")
QUIET = re.compile(
    # who made it, when, and how well
    r"camera(name|id|info|label|serial.*|index)?|camname|name|label|sensor(type|name|id)?|serial(number)?|comment|version"
    r"|header|stamp|frameid|seq|rostopic|topic|ratehz|fps|framerate|calibration(time|date|flags)|date|time|flags(value)?"
    r"|(nr?|numberof)?(of)?frames(count)?|nrof(frames|images)|nimages|(avg|mean)?reprojectionerrors?|rms(error)?|error"
    r"|avgreprojectionerror|perviewreprojectionerrors?|imagepoints|gridpoints|objectpoints|imagelist"
    r"|board.*|square(size)?|pattern.*|marker.*|aspectratio|fixaspectratio|fixprincipalpoint.*|zerotangent.*"
    # where the camera is
    r"|t(bs|cam.*|imu.*|cn.*|bc.*|ic.*|bodycam.*)|extrinsic.*|[rt]vecs?|camoverlaps|timeshift.*"
)
"""Entries, by their plain names, that make no other picture and need no word."""
MATRIX_KEYS = frozenset(("rows", "cols", "dt", "data", "sizes", "type_id"))


def plain(name: str) -> str:
    """A name in small letters, without what formats put between its words."""
    return re.sub(r"[-_\s.]", "", name).lower()


class Entries:
    """The entries of a camera in the file of a path, by plain names.

        entries.get("cameramatrix", "k")   # the first that is there; None where none is
        entries.told()                     # what is said of those that nobody got

    Raises FileFormatError: two of them have one name but for case and underscores.
    """

    def __init__(self, path: str, given: Mapping[str, Any]) -> None:
        self.path = path
        self._keys: TrackedKeys[Any] = TrackedKeys(given, fold=plain)
        for first in self._keys.repeated:
            other = self._keys.spelled(plain(first))
            raise FileFormatError(
                f"{path}: has {shown(first)} and {shown(other)}; leave one of them out"
            )
        self._odd: list[str] = []

    def get(self, *names: str) -> Any:
        """Return the first of these entries that has a value."""
        return self._keys.get(*names)

    def there(self, name: str, names: Sequence[str] = ()) -> Any:
        """Return an entry, or the first of several names for it. Raises
        FileFormatError: there is none.
        """
        value = self.get(*(names or (plain(name),)))
        if value is None:
            spelled = [self._keys.spelled(key) for key, _ in self._keys.items()]
            has = join_names(spelled, 8) or "nothing"
            raise FileFormatError(f"{self.path}: expected {name}, got {has}; add it")
        return value

    def number(
        self, name: str, otherwise: float | None = None, names: Sequence[str] = ()
    ) -> float:
        """Return a finite number, or what holds otherwise. Raises FileFormatError: it
        is none, or has to be there.
        """
        if otherwise is not None and self.get(*(names or (plain(name),))) is None:
            return otherwise
        return number(self.path, name, self.there(name, names))

    def numbers(
        self, shown_as: str, given: object, counts: Sequence[int]
    ) -> list[float]:
        """Return a list of numbers, flat, in rows or in the `data` of a matrix, of a
        length among some counts.
        """
        if isinstance(given, Mapping):
            self._odd += [
                f"{shown_as}.{key}" for key in given if key not in MATRIX_KEYS
            ]
            given = given.get("data")
        flat = _flat(given)
        if len(flat) not in counts:
            wanted = " or ".join(map(str, counts))
            raise FileFormatError(
                f"{self.path}: {shown_as}: expected a list of "
                f"{wanted} numbers, got {len(flat)}"
            )
        return [number(self.path, shown_as, value) for value in flat]

    def told(self, within: str = "") -> list[str]:
        """Return the entries that nobody asked for, as they are spelled, with a dot
        after the entry that they are within. Raises FileFormatError: one of them
        changes the picture.
        """
        unread = [within + key for key in self._odd]
        for spelled in self._keys.unread(
            lambda name, _: QUIET.fullmatch(name) is not None
        ):
            name = plain(spelled)
            value = self._keys.peek(name)
            is_coefficient = name in COEFFICIENTS and not isinstance(
                value, (list, Mapping)
            )
            # of a stereo pair
            of_another = (
                name.endswith("2")
                and f"{name[:-1]}1" in self._keys
                and not is_coefficient
            )
            if not BENDS.fullmatch(name) or OF_RECTIFIED.fullmatch(name) or of_another:
                unread.append(within + spelled)
            elif not nothing(value):
                raise FileFormatError(
                    f"{self.path}: expected no {shown(within + spelled)}, got "
                    f"{shown(str(value))}: it makes another"
                    " picture and is not read; calibrate with one of the models in "
                    "docs/cameras.md"
                )
        return unread


def select_camera(path: str, which: str, cameras: Mapping[str, Any]) -> Any:
    """Return the camera of a name out of those of a file, or the only one.

    Raises FileFormatError: there is none of that name, or there are several and none is
    named.
    """
    names = list(map(str, cameras))
    listed = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    first = f"{path}#{names[0]}"
    if which and which not in names:
        raise FileFormatError(
            f"{path}: expected one of its cameras {listed}, got "
            f"{which[:40]!r}; write {first}"
        )
    if not which and len(names) > 1:
        what = f"has {len(names)} cameras, {listed}"
        raise FileFormatError(
            f"{path}: {what}: say which one takes the picture, as in {first}"
        )
    return cameras[which or names[0]]


def nothing(value: object) -> bool:
    """Whether a value changes nothing: zeros, no words, or nothing at all."""
    if isinstance(value, Mapping):
        value = value.get("data", list(value.values()))
    return all(
        cell in (None, False, "", "none") or _float(str(cell)) == 0.0
        for cell in _flat(value)
    )


def _float(given: object) -> float:
    try:
        return (
            float(given)
            if isinstance(given, (int, float, str)) and not isinstance(given, bool)
            else math.nan
        )
    except (ValueError, OverflowError):
        return math.nan


def _flat(given: object) -> list[Any]:
    rows = given if isinstance(given, list) else [given]
    return [
        value for row in rows for value in (row if isinstance(row, list) else [row])
    ]


def number(path: str, name: str, given: object) -> float:
    """Return a finite number. Raises FileFormatError: it is none."""
    value = _float(given)
    if not math.isfinite(value):
        raise FileFormatError(
            f"{path}: {name}: expected a finite number, got "
            f"{str(given)[:40]!r}; correct it"
        )
    return value


def with_told(
    model: CameraModel, left: Sequence[str], rectified: Sequence[str] = ()
) -> CameraModel:
    """The model with notes that name what was not read: of the camera, and about
    rectified pictures.
    """
    unread = [f"{join_names(left)}."] if left else []
    if rectified:
        whose = "which are made of the camera's own ones; these are its own."
        unread.append(f"{' and '.join(rectified)}, about rectified pictures, {whose}")
    return replace(
        model, told=tuple(f"{model.name}: not read: {what}" for what in unread)
    )


def made(
    spec: str,
    kind: str,
    size: tuple[float, float],
    found: Mapping[str, float],
    first: float = 0.0,
) -> CameraModel:
    """The model of numbers in pixels, whose origin lies at `first` to the right of and
    below the picture's corner. Raises FileFormatError: numbers that no camera has.
    """
    path = spec.partition("#")[0]
    height, width = size
    if not all(side == int(side) and 1 <= side <= MOST_PIXELS for side in size):
        wanted = f"a width and a height from 1 to {MOST_PIXELS} pixels"
        raise FileFormatError(f"{path}: expected {wanted}, got {width:g} x {height:g}")
    if kind == EQUIRECTANGULAR:
        found = {"fx": width, "fy": height, "cx": width / 2.0, "cy": height / 2.0}
        first = 0.0
    value = {name: found.get(name, 0.0) for name in NUMBERS}
    value["cx"], value["cy"] = value["cx"] + first, value["cy"] + first

    def check(name: str, fits: bool, wanted: str, hint: str = "") -> None:
        if not fits:
            raise FileFormatError(
                f"{path}: {name}: expected {wanted}, got {value[name]:g}{hint}"
            )

    for name, side in (("fx", width), ("fy", height)):
        low = side / LARGEST_FOCAL
        high = side * LARGEST_FOCAL
        wanted = (
            f"a focal length from {low:g} to {high:g} pixels for a side of {side:g}"
        )
        check(name, low <= value[name] <= high, wanted)
    for name, side in (("cx", width), ("cy", height)):
        check(
            name,
            0.0 < value[name] < side,
            f"a principal point inside the picture, up to {side:g}",
        )
    check("skew", abs(value["skew"]) <= value["fx"], f"less than fx, {value['fx']:g}")
    wanted = f"a coefficient from -{LARGEST_COEFFICIENT:g} to {LARGEST_COEFFICIENT:g}"
    for name in COEFFICIENTS:
        check(
            name,
            abs(value[name]) <= LARGEST_COEFFICIENT,
            wanted,
            "; is it in the order of OpenCV?",
        )
    sides = {"fx": width, "fy": height, "cx": width, "cy": height, "skew": width}
    numbers = tuple(number / sides.get(name, 1.0) for name, number in value.items())
    return CameraModel(kind, numbers, spec, (int(height), int(width)))


# ---------------------------------------------------------------------------------------------------------------------
# Cameras that are mounted: ``--camera dashcam``, ``--camera robot``. They keep their
# height and do not roll.


@dataclass(frozen=True)
class CameraPreset:
    """How a mounted camera stands, and what the control `camera` searches of it."""

    height: float  # of the lens above the floor or the road, metres
    fov: float  # field of view along the larger side of the picture, degrees
    # from the object's middle, metres; further where the object would not fit
    distance: float
    # azimuth 0 is in the object's lane, looking along it: behind what drives there
    in_lane: bool
    aside: float  # how far to either side a search goes, degrees; 180 for all around
    # the other ranges that are searched by default; what has none stays
    search: Mapping[str, tuple[float, float]]


PRESETS: Mapping[str, CameraPreset] = MappingProxyType(
    {
        # Behind the windscreen of a car, in the lane of the object. What glass and
        # dashboard do to a picture is not in it.
        "dashcam": CameraPreset(
            height=1.3, fov=75.0, distance=10.0, in_lane=True, aside=10.0,
            search={"distance": (6.0, 60.0), "fov": (60.0, 90.0)},
        ),
        # The head of a humanoid: the Unitree G1 is 1.32 m tall (its product page), with
        # a RealSense D435i in its face, about a tenth of a metre below the top. The
        # colour picture of that has 69 x 42 degrees, and its depth reaches to 3 m
        # (Clearpath Robotics, documentation of the RealSense D435).
        "robot": CameraPreset(
            height=1.2, fov=69.0, distance=1.0, in_lane=False, aside=180.0, search={"distance": (0.5, 3.0)},
        ),
    }
)  # fmt: skip
"""The mounted cameras by name."""
TABLE = 0.75
TABLE_SIDE = 1.2
"""Height and side in metres of a table, on which the objects of a bundled room stand
that are no larger than `ON_TABLES`.
"""
ON_TABLES = 0.5  # metres of the longest side
