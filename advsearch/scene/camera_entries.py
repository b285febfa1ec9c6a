"""The entries of a camera file by name, and the model that their numbers make.

What nobody asked for is named, or refused where it makes another picture.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from advsearch.errors import FileFormatError
from advsearch.scene.camera_model import COEFFICIENTS, EQUIRECTANGULAR, CameraModel
from advsearch.scene.importing.files import shown

MOST_PIXELS = 1 << 16
"""Largest side of a picture."""
LARGEST_COEFFICIENT, LARGEST_FOCAL = 1e4, 1e3
"""Coefficients are at most so large, and focal lengths so many sides of the picture."""

BENDS = re.compile(
    r"xi|mu|mv|[dkps]\d?|t(au)?[xy]|alpha|beta|gamma\d*|omega|.*dist(?!ance).*|.*skew.*|.*shear.*|.*mirror.*|.*tilt.*|"
    r".*coeff.*|.*flip.*|.*rotate.*|image(rotation|scale)|scale(factor)?|resize.*|(is|image)?rectified|"
    r".*roi.*|.*crop.*|.*binning.*|.*decimat.*|.*fisheye.*|.*lens.*model|.*poly.*|.*affine.*|.*projectionparam.*"
)
"""Entries, by their plain names, that make another picture: in none of the models that are read, they are refused."""
OF_RECTIFIED = re.compile(r"r|p|rectificationmatrix|projectionmatrix")
"""Entries about pictures that are made of the camera's own ones."""
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
    """The entries of a camera, by plain names.

        entries.get("cameramatrix", "k")   # the first that is there; None where none is
        entries.told()                     # what is said of those that nobody got

    Args:
        path: of the file, for messages.
        given: the entries as they are spelled.

    Raises:
        FileFormatError: two of them have one name but for case and underscores.
    """

    def __init__(self, path: str, given: Mapping[str, Any]) -> None:
        self.path = path
        self._spelled: dict[str, str] = {}
        for name in given:
            if (first := self._spelled.setdefault(plain(name), name)) != name:
                raise FileFormatError(f"{path}: has {shown(first)} and {shown(name)}; leave one of them out")
        self._given = {plain(name): one for name, one in given.items()}
        self._used: set[str] = set()
        self._odd: list[str] = []

    def get(self, *names: str) -> Any:
        """Return the first of these entries that has a value."""
        self._used |= {name for name in names if self._given.get(name) is None}
        found = next((name for name in names if self._given.get(name) is not None), None)
        if found is None:
            return None
        self._used.add(found)
        return self._given[found]

    def there(self, names: Sequence[str], shown_as: str) -> Any:
        """Return the first of these entries. Raises FileFormatError: there is none."""
        found = self.get(*names)
        if found is None:
            has = ", ".join(list(self._spelled.values())[:8]) or "nothing"
            raise FileFormatError(f"{self.path}: expected {shown_as}, got {has}; add it")
        return found

    def number(self, names: Sequence[str], shown_as: str, otherwise: float | None = None) -> float:
        """Return a finite number, or what holds otherwise. Raises FileFormatError: it is none, or has to be there."""
        found = self.there(names, shown_as) if otherwise is None else self.get(*names)
        return number(self.path, shown_as, otherwise if found is None else found)

    def numbers(self, shown_as: str, given: object, counts: Sequence[int]) -> list[float]:
        """Return a list of numbers that is flat, in rows, or in the `data` of a matrix.

        Raises:
            FileFormatError: it is none, or of another length.
        """
        if isinstance(given, Mapping):
            self._odd += [f"{shown_as}.{key}" for key in given if key not in MATRIX_KEYS]
            given = given.get("data")
        flat = _flat(given)
        if len(flat) not in counts:
            wanted = " or ".join(map(str, counts))
            raise FileFormatError(f"{self.path}: {shown_as}: expected a list of {wanted} numbers, got {len(flat)}")
        return [number(self.path, shown_as, one) for one in flat]

    def part(self, *names: str) -> Entries:
        """Return the entries of an entry; none where it is not there."""
        found = self.get(*names)
        return Entries(self.path, {str(key): one for key, one in found.items()} if isinstance(found, Mapping) else {})

    def told(self, within: str = "") -> list[str]:
        """Return the entries that nobody asked for, as they are spelled.

        Args:
            within: the entry that they are in, with a dot.

        Raises:
            FileFormatError: one of them changes the picture.
        """
        unread = [within + one for one in self._odd]
        for name, spelled in self._spelled.items():
            value = self._given[name]
            if name in self._used or QUIET.fullmatch(name):
                continue
            of_another = name.endswith("2") and f"{name[:-1]}1" in self._spelled  # of a stereo pair
            if BENDS.fullmatch(name) and not OF_RECTIFIED.fullmatch(name) and not of_another:
                if not nothing(value):
                    raise FileFormatError(
                        f"{self.path}: expected no {shown(within + spelled)}, got {shown(str(value))}: it makes another"
                        " picture and is not read; calibrate with one of the models in docs/cameras.md"
                    )
                continue
            unread.append(within + spelled)
        return unread


def nothing(value: object) -> bool:
    """Whether a value changes nothing: zeros, no words, or nothing at all."""
    if isinstance(value, Mapping):
        value = value.get("data", [one for one in value.values()])
    return all(one in (None, 0, False, "", "0", "none", "0.") or _zero(one) for one in _flat(value))


def _zero(one: object) -> bool:
    try:
        return float(str(one)) == 0.0
    except ValueError:
        return False


def _flat(given: object) -> list[Any]:
    rows = given if isinstance(given, list) else [given]
    return [one for row in rows for one in (row if isinstance(row, list) else [row])]


def number(path: str, name: str, given: object) -> float:
    """Return a finite number. Raises FileFormatError: it is none."""
    try:
        found = float(given) if isinstance(given, (int, float, str)) and not isinstance(given, bool) else math.nan
    except (ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found):
        raise FileFormatError(f"{path}: {name}: expected a finite number, got {str(given)[:40]!r}; correct it")
    return found


def with_told(model: CameraModel, left: Sequence[str], rectified: Sequence[str] = ()) -> CameraModel:
    """The model with notes that name what was not read: of the camera, and about rectified pictures."""
    names = ", ".join(shown(one) for one in left[:12]) + (", ..." if len(left) > 12 else "")
    told = [f"{model.name}: not read: {names}."] if left else []
    if rectified:
        whose = "which are made of the camera's own ones; these are its own."
        told.append(f"{model.name}: not read: {' and '.join(rectified)}, about rectified pictures, {whose}")
    return replace(model, told=tuple(told))


def made(spec: str, kind: str, size: tuple[float, float], found: Mapping[str, float]) -> CameraModel:
    """The model of numbers in pixels, from the corner of the picture.

    Raises:
        FileFormatError: numbers that no camera has.
    """
    path = spec.partition("#")[0]
    height, width = size
    if not all(side == int(side) and 1 <= side <= MOST_PIXELS for side in size):
        raise FileFormatError(
            f"{path}: expected a width and a height from 1 to {MOST_PIXELS} pixels, got {width:g} x {height:g}"
        )
    if kind == EQUIRECTANGULAR:
        found = {"fx": width, "fy": height, "cx": width / 2.0, "cy": height / 2.0}
    for name, side in (("fx", width), ("fy", height)):
        if not side / LARGEST_FOCAL <= found[name] <= side * LARGEST_FOCAL:
            raise FileFormatError(
                f"{path}: {name}: expected a focal length from {side / LARGEST_FOCAL:g} to {side * LARGEST_FOCAL:g} "
                f"pixels for a side of {side:g}, got {found[name]:g}"
            )
    for name, side in (("cx", width), ("cy", height)):
        if not 0.0 < found[name] < side:
            raise FileFormatError(
                f"{path}: {name}: expected a principal point inside the picture, up to {side:g}, got {found[name]:g}"
            )
    if abs(found.get("skew", 0.0)) > found["fx"]:
        raise FileFormatError(f"{path}: skew: expected less than fx, {found['fx']:g}, got {found['skew']:g}")
    for name in COEFFICIENTS:
        if abs(found.get(name, 0.0)) > LARGEST_COEFFICIENT:
            raise FileFormatError(
                f"{path}: {name}: expected a coefficient from -{LARGEST_COEFFICIENT:g} to {LARGEST_COEFFICIENT:g}, got "
                f"{found[name]:g}; is it in the order of OpenCV?"
            )
    linear = (
        found["fx"] / width,
        found["fy"] / height,
        found["cx"] / width,
        found["cy"] / height,
        found.get("skew", 0.0) / width,
    )
    numbers = (*linear, *(found.get(name, 0.0) for name in COEFFICIENTS))
    return CameraModel(kind, numbers, spec, (int(height), int(width)))
