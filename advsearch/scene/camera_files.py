"""Camera files: OpenCV's YAML and XML, Kalibr's camchain, `camera_info` of ROS and COLMAP's cameras.txt.

The centre of the first pixel is (0, 0) in the first three and (0.5, 0.5) in COLMAP; what comes out is measured from the
picture's corner.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from advsearch.errors import FileFormatError
from advsearch.files import read_text
from advsearch.scene.camera_model import BROWN_CONRADY, COEFFICIENTS, EQUIRECTANGULAR, FISHEYE, CameraModel
from advsearch.yaml_text import LARGEST, parse_yaml

MOST_PIXELS = 1 << 16
"""Largest side of a picture."""
MOST_BINNED = 64
"""Pixels along a side that a sensor makes into one, at most."""
LARGEST_COEFFICIENT, LARGEST_FOCAL = 1e4, 1e3
"""Coefficients are at most so large, and focal lengths so many sides of the picture."""

IN_OPENCV = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
"""OpenCV's order, which ROS has too."""
LENGTHS = (0, 4, 5, 8, 12, 14)
"""How many of them there may be."""
COLMAP: Mapping[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": (BROWN_CONRADY, "f cx cy"),
    "PINHOLE": (BROWN_CONRADY, "fx fy cx cy"),
    "SIMPLE_RADIAL": (BROWN_CONRADY, "f cx cy k1"),
    "RADIAL": (BROWN_CONRADY, "f cx cy k1 k2"),
    "OPENCV": (BROWN_CONRADY, "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": (BROWN_CONRADY, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "OPENCV_FISHEYE": (FISHEYE, "fx fy cx cy k1 k2 k3 k4"),
    "SIMPLE_FISHEYE": (FISHEYE, "f cx cy"),
    "FISHEYE": (FISHEYE, "fx fy cx cy"),
    "SIMPLE_RADIAL_FISHEYE": (FISHEYE, "f cx cy k1"),
    "RADIAL_FISHEYE": (FISHEYE, "f cx cy k1 k2"),
    "EQUIRECTANGULAR": (EQUIRECTANGULAR, "w h"),
}
"""COLMAP's models that are one of ours, with their parameters. FOV, EUCM, the division models and those with a thin
prism on a fisheye are not."""
OF_DISTORTION = {
    "plumb_bob": BROWN_CONRADY,
    "rational_polynomial": BROWN_CONRADY,
    "thin_prism": BROWN_CONRADY,
    "radtan": BROWN_CONRADY,
    "none": BROWN_CONRADY,
    "": BROWN_CONRADY,
    "equidistant": FISHEYE,
    "fisheye": FISHEYE,
    "kannala_brandt": FISHEYE,
    EQUIRECTANGULAR: EQUIRECTANGULAR,
}
"""The distortion models of ROS and Kalibr that are one of ours."""

MATRIX = ("cameramatrix", "k", "intrinsicmatrix", "mtx", "cameramatrix1")
DISTORTION = ("distortioncoefficients", "distcoeffs", "distortioncoeffs", "distcoeff", "distortion", "d", "dist")
WIDTH, HEIGHT = ("imagewidth", "width", "w"), ("imageheight", "height", "h")
SIZE = ("imagesize", "resolution")


def read_camera(spec: str) -> CameraModel:
    """Read a camera's model.

    Args:
        spec: path of the file; of several cameras in it with the one that is meant, as in ``camchain.yaml#cam1`` and
            ``cameras.txt#3``.

    Raises:
        FileFormatError: the file is missing, is none of these kinds, has a model that is not one of ours, or numbers
            that no camera has.
    """
    path, _, which = spec.partition("#")
    try:
        text = read_text(Path(path), "a camera file", LARGEST)
    except OSError as error:
        raise FileFormatError(f"{path}: expected a camera file, got {error.strerror}; check the path") from None
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if lines and re.fullmatch(r"\d+\s+[A-Za-z_]\w*\s.*", lines[0].strip()):
        return _of_colmap(spec, path, which, lines)
    data = _xml(path, text) if text.lstrip().startswith("<") else _yaml(path, text)
    cameras = {name: one for name, one in data.items() if isinstance(one, dict) and "intrinsics" in one}
    if cameras:
        return _of_kalibr(spec, _chosen(path, which, cameras))
    if which:
        raise FileFormatError(
            f"{path}: expected several cameras, as {which!r} is asked for, got one; leave #{which} out"
        )
    if "intrinsics" in data and "camera_model" in data:
        return _of_kalibr(spec, data)
    return _of_opencv(spec, {re.sub(r"[_\s]", "", name).lower(): one for name, one in data.items()})


def _yaml(path: str, text: str) -> dict[str, Any]:
    """The mapping of a YAML text, also as OpenCV writes it: with a directive and tags that are not YAML's."""
    text = re.sub(r"!!opencv-(nd-)?matrix", "", re.sub(r"\A%YAML[^\n]*\n", "", text))
    text = re.sub(r"\A\s*---[^\n]*\n", "", text).split("\n---")[0]
    try:
        data = parse_yaml(text)
    except ValueError as error:
        raise FileFormatError(
            f"{path}: expected YAML, or COLMAP's cameras.txt, got {error}; correct the file"
        ) from None
    if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
        got = "an empty file" if data is None else f"a {type(data).__name__}"
        raise FileFormatError(
            f"{path}: expected a camera of OpenCV, Kalibr, ROS or COLMAP, got {got}; docs/cameras.md shows one of each"
        )
    return data


def _xml(path: str, text: str) -> dict[str, Any]:
    """What OpenCV writes as XML, in the form of its YAML."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise FileFormatError(f"{path}: declares a document type or entities, which no camera needs; remove it")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise FileFormatError(f"{path}: expected XML, got {error}; correct the file") from None
    if root.tag != "opencv_storage":
        raise FileFormatError(
            f"{path}: expected a camera of OpenCV in <opencv_storage>, got <{root.tag[:40]}>; docs/cameras.md has the "
            "formats that are read"
        )
    matrices = {one.tag: one.findtext("data") for one in root}
    return {one.tag: (one.text or "").strip() if (data := matrices[one.tag]) is None else data.split() for one in root}


def _chosen(path: str, which: str, cameras: Mapping[str, Any]) -> Any:
    """The camera that is asked for, or the only one."""
    names = list(map(str, cameras))
    shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    if which and which not in names:
        raise FileFormatError(
            f"{path}: expected one of its cameras {shown}, got {which[:40]!r}; write {path}#{names[0]}"
        )
    if not which and len(names) > 1:
        raise FileFormatError(
            f"{path}: has {len(names)} cameras, {shown}: say which one takes the picture, as in {path}#{names[0]}"
        )
    return cameras[which or names[0]]


# ---- the formats ----------------------------------------------------------------------------------------------------


def _of_colmap(spec: str, path: str, which: str, lines: Sequence[str]) -> CameraModel:
    rows = {words[0]: words for line in lines if (words := line.split())}
    _, name, *rest = _chosen(path, which, rows)
    if name not in COLMAP:
        raise FileFormatError(
            f"{path}: expected one of COLMAP's models {', '.join(COLMAP)}, got {name[:40]}, which is another projection"
            "; fit one of these to it (colmap model_converter does not), or undistort the pictures"
        )
    kind, names = COLMAP[name]
    wanted = ["width", "height", *names.split()]
    if len(rest) != len(wanted):
        raise FileFormatError(f"{path}: {name}: expected {' '.join(wanted)}, got {len(rest)} numbers; correct the line")
    found = {one: _number(path, one, value) for one, value in zip(wanted, rest, strict=True)}
    size = (found.pop("height"), found.pop("width"))
    if "f" in found:
        found["fx"] = found["fy"] = found.pop("f")
    return _made(spec, kind, size, found)


def _of_kalibr(spec: str, camera: Mapping[str, Any]) -> CameraModel:
    path = spec.partition("#")[0]
    model = str(camera.get("camera_model", "pinhole"))
    if model != "pinhole":
        raise FileFormatError(
            f"{path}: expected the camera_model pinhole of Kalibr, got {model[:40]}, which is another projection; "
            "calibrate as pinhole-equi or pinhole-radtan"
        )
    kind = _kind(path, camera.get("distortion_model", "none"))
    focal = _numbers(path, "intrinsics", camera["intrinsics"], (4,))
    coefficients = _numbers(path, "distortion_coeffs", camera.get("distortion_coeffs", []), (0, 4))
    width, height = _numbers(path, "resolution", _there(path, camera, ("resolution",)), (2,))
    names = ("k1", "k2", "k3", "k4") if kind == FISHEYE else ("k1", "k2", "p1", "p2")
    found = dict(zip(("fx", "fy", "cx", "cy"), focal, strict=True)) | dict(zip(names, coefficients, strict=False))
    return _made(spec, kind, (height, width), _from_corner(found))


def _of_opencv(spec: str, data: Mapping[str, Any]) -> CameraModel:
    """OpenCV's files and ROS; their keys are in small letters and without underscores here."""
    path = spec.partition("#")[0]
    kind = _kind(path, data.get("distortionmodel", data.get("cameramodel", "")))
    if data.get("fisheyemodel") not in (None, 0, False, "0"):
        kind = FISHEYE
    if kind == EQUIRECTANGULAR:
        return _made(spec, kind, _size(path, data), {})
    roi = data.get("roi")
    if isinstance(roi, Mapping) and any(roi.get(side) for side in ("x_offset", "y_offset", "width", "height")):
        raise FileFormatError(f"{path}: expected a camera_info of whole pictures, got one of a part (roi); set it to 0")
    matrix = _numbers(path, "camera_matrix", _there(path, data, MATRIX, "camera_matrix"), (9,))
    if not any(matrix):
        raise FileFormatError(
            f"{path}: expected a calibrated camera, got a camera_matrix (K) of zeros, as ROS says of one that is not "
            "calibrated; calibrate it, and give the file that this writes"
        )
    if matrix[3] or matrix[6] or matrix[7] or matrix[8] != 1.0:
        raise FileFormatError(f"{path}: camera_matrix: expected fx, skew, cx, 0, fy, cy, 0, 0, 1, got other numbers")
    given: object = next((data[name] for name in DISTORTION if data.get(name) is not None), [])
    coefficients = _numbers(path, "distortion_coefficients", given, (0, 4) if kind == FISHEYE else LENGTHS)
    names = COEFFICIENTS[:4] if kind == FISHEYE else IN_OPENCV
    found = dict(zip(names, coefficients, strict=False))
    if found.pop("tauX", 0.0) or found.pop("tauY", 0.0):
        raise FileFormatError(
            f"{path}: expected no tilt of the sensor (tauX, tauY), got one; calibrate without CALIB_TILTED_MODEL"
        )
    found |= {"fx": matrix[0], "skew": matrix[1], "cx": matrix[2], "fy": matrix[4], "cy": matrix[5]}
    (height, width), (down, across) = _size(path, data), _binning(path, data)
    model = _made(spec, kind, (height - height % down, width - width % across), _from_corner(found))
    return replace(model, size=(int(height // down), int(width // across)))


def _from_corner(found: dict[str, float]) -> dict[str, float]:
    """The principal point from the corner of the picture, where it is given from the centre of the first pixel."""
    return {**found, "cx": found["cx"] + 0.5, "cy": found["cy"] + 0.5}


# ---- what they are made of ------------------------------------------------------------------------------------------


def _there(path: str, data: Mapping[str, Any], names: Sequence[str], shown: str = "") -> Any:
    """The first of these keys that is there."""
    for name in names:
        if data.get(name) is not None:
            return data[name]
    raise FileFormatError(f"{path}: expected {shown or names[0]}, got {', '.join(list(data)[:8]) or 'nothing'}; add it")


def _kind(path: str, named: object) -> str:
    name = str(named or "").strip().lower()
    if name not in OF_DISTORTION:
        raise FileFormatError(
            f"{path}: expected one of the distortion models {', '.join(filter(None, OF_DISTORTION))}, got {name[:40]!r}"
        )
    return OF_DISTORTION[name]


def _size(path: str, data: Mapping[str, Any]) -> tuple[float, float]:
    """Height and width of the pictures."""
    for name in SIZE:
        if data.get(name) is not None:
            width, height = _numbers(path, name, data[name], (2,))
            return height, width
    width, height = (
        _number(path, shown, _there(path, data, names, shown))
        for names, shown in ((WIDTH, "image_width"), (HEIGHT, "image_height"))
    )
    return height, width


def _binning(path: str, data: Mapping[str, Any]) -> tuple[float, float]:
    """Pixels, down and across, that ROS says are made into one; its calibration is for those before."""
    found = {name: _number(path, name, data.get(name.replace("_", "")) or 1) for name in ("binning_y", "binning_x")}
    for name, number in found.items():
        if number != int(number) or not 1 <= number <= MOST_BINNED:
            raise FileFormatError(f"{path}: {name}: expected a whole number up to {MOST_BINNED}, got {number:g}")
    return found["binning_y"], found["binning_x"]


def _numbers(path: str, name: str, given: object, counts: Sequence[int]) -> list[float]:
    """A list of numbers, flat, in rows, or in the `data` of a matrix."""
    if isinstance(given, Mapping):
        given = given.get("data")
    flat: list[object] = []
    for one in given if isinstance(given, list) else [given]:
        flat += one if isinstance(one, list) else [one]
    if len(flat) not in counts:
        wanted = " or ".join(map(str, counts))
        raise FileFormatError(f"{path}: {name}: expected a list of {wanted} numbers, got {len(flat)}; correct it")
    return [_number(path, name, one) for one in flat]


def _number(path: str, name: str, given: object) -> float:
    try:
        number = float(given) if isinstance(given, (int, float, str)) and not isinstance(given, bool) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise FileFormatError(f"{path}: {name}: expected a finite number, got {str(given)[:40]!r}; correct it")
    return number


def _made(spec: str, kind: str, size: tuple[float, float], found: Mapping[str, float]) -> CameraModel:
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
