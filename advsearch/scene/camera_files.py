"""Camera files of OpenCV, Kalibr (EuRoC), ROS (`camera_info`), camodocal (VINS), COLMAP
and nerfstudio.

Those of further tools are translated by `camera_dialects` before.

The centre of the first pixel is (0.5, 0.5) in the last two and (0, 0) in the others;
what comes out is measured from the picture's corner. An entry that no reader asks for
is named in a note, or refused where it makes another picture.
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
from advsearch.files import MESHES
from advsearch.scene.camera_dialects import (
    METASHAPE_FILE,
    check_text_format,
    check_xml_root,
    describe_projection,
    translate_entries,
)
from advsearch.scene.camera_entries import (
    Entries,
    made,
    nothing,
    number,
    plain,
    select_camera,
    with_told,
)
from advsearch.scene.camera_model import (
    BROWN_CONRADY,
    COEFFICIENTS,
    EQUIRECTANGULAR,
    FISHEYE,
    CameraModel,
)
from advsearch.scene.importing.files import CAMERAS, shown
from advsearch.trust.stored_files import parse_json, parsed, present_text
from advsearch.trust.yaml_text import LARGEST, parse_yaml

LARGEST_JSON = 1 << 25  # bytes of a JSON file, which may hold the pose of every picture
MOST_BINNED = 64  # pixels along a side that a sensor makes into one, at most
# as in ROS too
IN_OPENCV = (
    "k1",
    "k2",
    "p1",
    "p2",
    "k3",
    "k4",
    "k5",
    "k6",
    "s1",
    "s2",
    "s3",
    "s4",
    "tauX",
    "tauY",
)
LENGTHS = (0, 4, 5, 8, 12, 14)  # how many of them there may be
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
"""COLMAP's models that are one of ours, with their parameters. FOV, EUCM, the division
models and those with a thin prism on a fisheye are not.
"""
_OF_BROWN = (
    "plumb_bob rational_polynomial thin_prism radtan radial_tangential "
    "brown_conrady none"
).split()
OF_DISTORTION = {
    **dict.fromkeys((*_OF_BROWN, ""), BROWN_CONRADY),
    **dict.fromkeys(("equidistant", "fisheye", "kannala_brandt"), FISHEYE),
    EQUIRECTANGULAR: EQUIRECTANGULAR,
}
"""The distortion models of ROS, Kalibr and EuRoC that are one of ours."""
MATRIX = (
    *("cameramatrix", "k", "intrinsicmatrix", "mtx", "cameramatrix1", "m1"),
    *("intrinsics", "cameraintrinsics"),  # of ARKit
)
DISTORTION = (
    *(
        "distortioncoefficients",
        "distcoeffs",
        "distortioncoeffs",
        "distcoeff",
        "distortion",
        "d",
        "dist",
    ),
    *("coeffs", "coefficients", "distortioncoefficients1", "distcoeffs1", "d1"),
)
WIDTH = ("imagewidth", "width", "w")
HEIGHT = ("imageheight", "height", "h")
SIZE = ("imagesize", "resolution", "imageresolution")
# of camodocal (VINS)
GROUPS = ("projection_parameters", "distortion_parameters", "mirror_parameters")
KANNALA = {
    "mu": "fx",
    "mv": "fy",
    "u0": "cx",
    "v0": "cy",
    "k2": "k1",
    "k3": "k2",
    "k4": "k3",
    "k5": "k4",
}
"""What camodocal calls the numbers of a fisheye, and OpenCV."""
ALIKE = 0.01  # by what share a focal length may differ from what an angle says
OF_A_FRAME = frozenset(
    ("camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h", *IN_OPENCV)
)
"""What nerfstudio says of a camera, of all frames or of one."""
OF_A_SCENE = frozenset(
    "frames aabb_scale scale offset applied_transform applied_scale ply_file_path "
    "orientation_override "
    "auto_scale_poses_override train_filenames val_filenames test_filenames "
    "camera_angle_x camera_angle_y "
    "file_path transform_matrix sharpness colmap_im_id mask_path depth_file_path "
    "semantic_path time rotation".split()
)
"""Entries of a transforms.json, and of its frames, that say nothing of the lens; angles
count where lengths lack.
"""


def read_camera(spec: str) -> CameraModel:
    """Read a camera's model from a file; of several cameras in it that which is named,
    as in ``camchain.yaml#cam1`` and ``cameras.txt#3``. Raises FileFormatError: the file
    is missing, is none of these kinds, has a model that is not one of ours, numbers
    that no camera has, or an entry that makes another picture and is not read.
    """
    path, _, which = spec.partition("#")
    ending = Path(path).suffix.lower()
    if ending in CAMERAS and Path(path).is_file():
        raise FileFormatError(
            f"{path}: expected a camera as text, got {CAMERAS[ending]}"
        )
    if ending in MESHES:
        raise FileFormatError(
            f"{path}: expected a camera file, got a mesh; it is an "
            "object's, not a camera's"
        )
    text = present_text(
        path, "a camera file", LARGEST_JSON if ending == ".json" else LARGEST
    )
    lines = [
        line
        for line in text.splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if lines and re.fullmatch(r"\d+\s+[A-Za-z_]\w*\s.*", lines[0].strip()):
        return _of_colmap(spec, path, which, lines)
    check_text_format(path, text)
    data = _data(path, text)
    translated = translate_entries(path, which, data)
    if translated is not None:
        return _of_opencv(spec, Entries(path, translated))
    if "frames" in data or "fl_x" in data or "camera_angle_x" in data:
        return _of_nerfstudio(spec, which, data)
    cameras = {
        name: entry
        for name, entry in data.items()
        if isinstance(entry, dict) and "intrinsics" in entry
    }
    if cameras:
        rest = Entries(
            path, {name: entry for name, entry in data.items() if name not in cameras}
        )
        return _of_kalibr(
            spec, Entries(path, select_camera(path, which, cameras)), rest.told()
        )
    if which:
        wanted = f"expected several cameras, as {which!r} is asked for"
        raise FileFormatError(f"{path}: {wanted}, got one; leave #{which} out")
    if "intrinsics" in data and "camera_model" in data:
        return _of_kalibr(spec, Entries(path, data))
    groups = {
        name: group for name in GROUPS if isinstance(group := data.get(name), dict)
    }
    flat = {name: value for name, value in data.items() if name not in groups}
    for group in groups.values():
        names = KANNALA if "mu" in group else {}
        flat |= {names.get(str(key), str(key)): value for key, value in group.items()}
    return _of_opencv(spec, Entries(path, flat))


def _data(path: str, text: str) -> dict[str, Any]:
    if text.lstrip().startswith("<"):
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise FileFormatError(
                f"{path}: declares a document type or entities, "
                "which no camera needs; remove it"
            )
        root = parsed(path, text, "XML", ElementTree.fromstring)
        check_xml_root(path, root.tag)
        if root.tag not in ("opencv_storage", METASHAPE_FILE):
            raise FileFormatError(
                f"{path}: expected a camera of OpenCV in <opencv_storage>, got "
                f"<{root.tag[:40]}>; docs/cameras.md has "
                "the formats that are read"
            )
        entries = dict[str, Any]()
        for element in root:
            inner = {entry.tag: (entry.text or "").strip() for entry in element}
            matrix = element.findtext("data")
            entries[element.tag] = (
                (inner or (element.text or "").strip())
                if matrix is None
                else matrix.split()
            )
        return entries
    if path.lower().endswith(".json"):
        data = parsed(path, text, "JSON", parse_json)
    else:
        # OpenCV's has a directive and tags of its own
        text = re.sub(
            r"!!opencv-(nd-)?matrix", "", re.sub(r"\A%YAML[^\n]*\n", "", text)
        )
        text = re.sub(r"\A\s*---[^\n]*\n", "", text).split("\n---")[0]
        data = parsed(path, text, "YAML, or COLMAP's cameras.txt", parse_yaml)
    if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
        got = "an empty file" if data is None else f"a {type(data).__name__}"
        raise FileFormatError(
            f"{path}: expected a camera of OpenCV, Kalibr, ROS, COLMAP or nerfstudio, "
            f"got {got}; docs/cameras.md shows "
            "one of each"
        )
    return data


# ---- the formats
# ----------------------------------------------------------------------------------------------------


def _of_colmap(spec: str, path: str, which: str, lines: Sequence[str]) -> CameraModel:
    rows = {words[0]: words for line in lines if (words := line.split())}
    if len(rows) < len(lines):
        twice = "expected each camera once, got one with the same number twice"
        raise FileFormatError(f"{path}: {twice}; correct the file")
    _, name, *rest = select_camera(path, which, rows)
    if name not in COLMAP:
        raise FileFormatError(
            f"{path}: expected one of COLMAP's models {', '.join(COLMAP)}, got "
            f"{name[:40]}, which is another projection"
            "; fit one of these to it (colmap model_converter does not), or undistort "
            "the pictures"
        )
    kind, names = COLMAP[name]
    wanted = ["width", "height", *names.split()]
    if len(rest) != len(wanted):
        raise FileFormatError(
            f"{path}: {name}: expected {' '.join(wanted)}, got "
            f"{len(rest)} numbers; correct the line"
        )
    numbers = {
        key: number(path, key, value) for key, value in zip(wanted, rest, strict=True)
    }
    size = (numbers.pop("height"), numbers.pop("width"))
    if "f" in numbers:
        numbers["fx"] = numbers["fy"] = numbers.pop("f")
    return made(spec, kind, size, numbers)


def _of_nerfstudio(spec: str, which: str, data: Mapping[str, Any]) -> CameraModel:
    path = spec.partition("#")[0]
    frames = data.get("frames") or []
    frames = (
        [frame for frame in frames if isinstance(frame, dict)]
        if isinstance(frames, list)
        else []
    )
    lenses = [
        {key: frame[key] for key in frame if key in OF_A_FRAME} for frame in frames
    ] or [{}]
    lens = lenses[0]
    if which or any(other != lens for other in lenses):
        lens = select_camera(
            path, which, dict(zip(map(str, range(len(lenses))), lenses, strict=True))
        )
    others = {
        key: value
        for frame in frames
        for key, value in frame.items()
        if key not in OF_A_FRAME | OF_A_SCENE
    }
    entries = Entries(
        path,
        {key: value for key, value in data.items() if key not in OF_A_SCENE} | lens,
    )
    width, height = (entries.number(side) for side in ("w", "h"))
    name = str(entries.get("cameramodel") or "PINHOLE").upper()
    if name not in (*COLMAP, "PERSPECTIVE"):
        raise FileFormatError(
            f"{path}: expected one of the camera models {', '.join(COLMAP)}, got "
            f"{shown(name)}, which is another "
            "projection; fit one of these to it"
        )
    kind = COLMAP[name][0] if name in COLMAP else BROWN_CONRADY
    kind = FISHEYE if entries.get("isfisheye") else kind
    angles = [data.get(f"camera_angle_{axis}") for axis in "xy"]
    lengths = [
        0.0
        if angle is None
        else side / 2.0 / max(math.tan(number(path, "camera_angle", angle) / 2.0), 1e-9)
        for angle, side in zip(angles, (width, height), strict=True)
    ]
    fx = entries.number("fl_x", lengths[0] or None)
    if lengths[0] and abs(fx - lengths[0]) > ALIKE * fx:
        wanted = f"expected {lengths[0]:g}, as camera_angle_x says"
        raise FileFormatError(f"{path}: fl_x: {wanted}, got {fx:g}; leave one out")
    numbers = {"fx": fx, "fy": entries.number("fl_y", lengths[1] or fx)}
    numbers |= {
        axis: entries.number(axis, side / 2.0)
        for axis, side in (("cx", width), ("cy", height))
    }
    numbers |= _coefficients(
        entries, COEFFICIENTS[:4] if kind == FISHEYE else ("k1", "k2", "k3", "p1", "p2")
    )
    model = made(spec, kind, (height, width), numbers)
    return with_told(model, [*entries.told(), *Entries(path, others).told("frames.")])


def _of_kalibr(spec: str, entries: Entries, beside: Sequence[str] = ()) -> CameraModel:
    path = entries.path
    model = str(entries.get("cameramodel") or "pinhole")
    if model != "pinhole":
        raise FileFormatError(
            f"{path}: expected the camera_model pinhole of Kalibr, got {model[:40]}"
            f"{describe_projection(model) or ', which is not read; calibrate as pinhole-equi or pinhole-radtan'}"
        )
    kind = _kind(path, entries.get("distortionmodel"))
    focal = entries.numbers("intrinsics", entries.get("intrinsics"), (4,))
    names = ("k1", "k2", "k3", "k4") if kind == FISHEYE else ("k1", "k2", "p1", "p2")
    width, height = entries.numbers("resolution", entries.there("resolution"), (2,))
    numbers = _distortion(entries, names, (0, 4))
    numbers |= zip(("fx", "fy", "cx", "cy"), focal, strict=True)
    return with_told(
        made(spec, kind, (height, width), numbers, 0.5), [*beside, *entries.told()]
    )


def _of_opencv(spec: str, entries: Entries) -> CameraModel:
    path = entries.path
    keys = ("distortionmodel", "cameramodel", "modeltype")
    kinds = {
        _kind(path, model) for key in keys if (model := entries.get(key)) is not None
    }
    kind = (
        FISHEYE
        if not nothing(entries.get("fisheyemodel"))
        else next(iter(kinds), BROWN_CONRADY)
    )
    if len(kinds) > 1:
        raise FileFormatError(
            f"{path}: expected one model, got a camera_model beside "
            "another distortion_model"
        )
    if kind == EQUIRECTANGULAR:
        return with_told(made(spec, kind, _size(entries), {}), entries.told())
    given = entries.get(*MATRIX)
    if given is None and entries.get("fx") is not None:  # its numbers one by one
        fx, fy, cx, cy = (entries.number(name) for name in ("fx", "fy", "cx", "cy"))
        matrix = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    else:
        matrix = entries.numbers(
            "camera_matrix", entries.there("camera_matrix", MATRIX), (9,)
        )
    if not any(matrix):
        raise FileFormatError(
            f"{path}: expected a calibrated camera, got a camera_matrix (K) of zeros, "
            "as ROS says of one that is not "
            "calibrated; calibrate it, and give the file that this writes"
        )
    if not any(matrix[place] for place in (1, 2, 5)) and any(matrix[6:8]):
        # by columns: Open3D, ARKit
        matrix = [matrix[3 * column + row] for row in range(3) for column in range(3)]
    if matrix[3] or matrix[6] or matrix[7] or matrix[8] != 1.0:
        raise FileFormatError(
            f"{path}: camera_matrix: expected fx, skew, cx, 0, fy, "
            "cy, 0, 0, 1, got other numbers"
        )
    size = _size(entries)
    fisheye = kind == FISHEYE
    unread = _check_roi(entries, size)
    numbers = _distortion(
        entries,
        COEFFICIENTS[:4] if fisheye else IN_OPENCV,
        (0, 4) if fisheye else LENGTHS,
    )
    if numbers.pop("tauX", 0.0) or numbers.pop("tauY", 0.0):
        raise FileFormatError(
            f"{path}: expected no tilt of the sensor (tauX, tauY), got one; calibrate "
            "without CALIB_TILTED_MODEL"
        )
    numbers |= {
        "fx": matrix[0],
        "skew": matrix[1],
        "cx": matrix[2],
        "fy": matrix[4],
        "cy": matrix[5],
    }
    (height, width) = size
    (down, across) = _binning(entries)
    model = made(
        spec, kind, (height - height % down, width - width % across), numbers, 0.5
    )
    model = replace(model, size=(int(height // down), int(width // across)))
    rectified = _rectified(entries, matrix)
    return with_told(model, unread + entries.told(), rectified)


def _distortion(
    entries: Entries, names: Sequence[str], counts: Sequence[int]
) -> dict[str, float]:
    listed = entries.get(*DISTORTION)
    if nothing(listed) and not isinstance(listed, Mapping):
        coefficients = _coefficients(entries, names)
    else:
        coefficients = dict(
            zip(
                names,
                entries.numbers("distortion_coefficients", listed, counts),
                strict=False,
            )
        )
    model = entries.get("distortionmodel")
    if (
        isinstance(model, str)
        and model.strip().lower() == "none"
        and any(coefficients.values())
    ):
        what = "expected no distortion, as its distortion_model is none"
        raise FileFormatError(f"{entries.path}: {what}, got coefficients")
    return coefficients


def _coefficients(entries: Entries, names: Sequence[str]) -> dict[str, float]:
    return {name: entries.number(name, 0.0) for name in names}


def _rectified(entries: Entries, matrix: Sequence[float]) -> list[str]:
    x, skew, cx, y, cy = (matrix[place] for place in (0, 1, 2, 4, 5))
    other = []
    for name, short, expected in (
        ("rectification_matrix", "r", [1.0, 0, 0, 0, 1, 0, 0, 0, 1]),
        ("projection_matrix", "p", [x, skew, cx, 0, 0, y, cy, 0, 0, 0, 1, 0]),
    ):
        given = entries.get(plain(name), short)
        numbers = (
            expected
            if nothing(given)
            else entries.numbers(name, given, (len(expected),))
        )
        if any(
            abs(a - b) > 1e-6 * max(1.0, abs(b))
            for a, b in zip(numbers, expected, strict=True)
        ):
            other.append(name)
    return other


def _check_roi(entries: Entries, size: tuple[float, float]) -> list[str]:
    given = entries.get("roi")
    roi = Entries(
        entries.path,
        {str(key): given[key] for key in given} if isinstance(given, Mapping) else {},
    )
    x, y, height, width = _coefficients(
        roi, ("x_offset", "y_offset", "height", "width")
    ).values()
    roi.get("dorectify")
    if (x, y) != (0.0, 0.0) or (height, width) not in ((0.0, 0.0), size):
        raise FileFormatError(
            f"{entries.path}: expected a camera_info of whole pictures, got one of a "
            "part (roi); set it to 0"
        )
    return roi.told("roi.")


def _kind(path: str, named: object) -> str:
    name = re.sub(r"[-\s]", "_", str(named or "").strip().lower())
    if name == "pinhole":
        return BROWN_CONRADY
    if name not in OF_DISTORTION:
        raise FileFormatError(
            f"{path}: expected one of the distortion models "
            f"{', '.join(filter(None, OF_DISTORTION))}, got {name[:40]!r}"
            f"{describe_projection(name) or '; calibrate with one of these'}"
        )
    return OF_DISTORTION[name]


def _size(entries: Entries) -> tuple[float, float]:
    if (given := entries.get(*SIZE)) is not None:
        width, height = entries.numbers("image_size", given, (2,))
        return height, width
    width = entries.number("image_width", names=WIDTH)
    return entries.number("image_height", names=HEIGHT), width


def _binning(entries: Entries) -> tuple[float, float]:
    # pixels that ROS says are made into one; its calibration is for those before
    down, across = (
        entries.number(name, 1.0) or 1.0 for name in ("binning_y", "binning_x")
    )
    for name, pixels in (("binning_y", down), ("binning_x", across)):
        if pixels != int(pixels) or not 1 <= pixels <= MOST_BINNED:
            wanted = f"a whole number up to {MOST_BINNED}"
            raise FileFormatError(
                f"{entries.path}: {name}: expected {wanted}, got {pixels:g}"
            )
    return down, across
