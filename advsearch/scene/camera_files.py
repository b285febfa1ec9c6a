"""Readers of camera files.

Formats are those of OpenCV, Kalibr (EuRoC), ROS (`camera_info`), camodocal (VINS),
COLMAP and nerfstudio; `camera_dialects` translates those of further tools.

The center of the first pixel is (0.5, 0.5) in COLMAP and nerfstudio, and (0, 0) in the
others; models are measured from the image's corner. An entry that is not read is noted,
or rejected if it changes the image.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn
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
    CameraEntries,
    add_notes,
    has_no_effect,
    make_camera_model,
    normalize_key,
    parse_number,
    select_camera,
)
from advsearch.scene.camera_model import (
    BROWN_CONRADY,
    COEFFICIENTS,
    EQUIRECTANGULAR,
    FISHEYE,
    CameraModel,
)
from advsearch.scene.importing.files import CAMERA_FORMAT_ADVICE, format_name
from advsearch.trust.stored_files import parse_json, parse_text, read_existing_text
from advsearch.trust.yaml_text import MAX_YAML_BYTES, parse_yaml

# Limit of the bytes of a JSON file, which may have the pose of every image.
MAX_JSON_SIZE = 1 << 25
# Coordinates of the center of the first pixel, measured from its corner. They are added
# to the principal point of a tool that measures from that center.
FIRST_PIXEL_CENTER = 0.5
MAX_BINNING = 64  # limit of the pixels along a side that a sensor bins into one
COLMAP_LINE = re.compile(r"\d+\s+[A-Za-z_]\w*\s.*")  # "1 PINHOLE 640 480 ..."
# Coefficients in the order of OpenCV and ROS.
OPENCV_COEFFICIENTS = (
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
OPENCV_COEFFICIENT_COUNTS = (0, 4, 5, 8, 12, 14)  # how many coefficients there may be
COLMAP_MODELS: Mapping[str, tuple[str, str]] = {
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
"""Kind and parameters of COLMAP's models.

FOV, EUCM, the division models and fisheyes with a thin prism are not supported.
"""
_BROWN_CONRADY_NAMES = (
    "plumb_bob rational_polynomial thin_prism radtan radial_tangential "
    "brown_conrady none"
).split()
KIND_OF_DISTORTION = {
    **dict.fromkeys((*_BROWN_CONRADY_NAMES, ""), BROWN_CONRADY),
    **dict.fromkeys(("equidistant", "fisheye", "kannala_brandt"), FISHEYE),
    EQUIRECTANGULAR: EQUIRECTANGULAR,
}
"""Kinds of the distortion models of ROS, Kalibr and EuRoC."""
CAMERA_MATRIX_KEYS = (
    *("cameramatrix", "k", "intrinsicmatrix", "mtx", "cameramatrix1", "m1"),
    *("intrinsics", "cameraintrinsics"),  # of ARKit
)
DISTORTION_KEYS = (
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
WIDTH_KEYS = ("imagewidth", "width", "w")
HEIGHT_KEYS = ("imageheight", "height", "h")
SIZE_KEYS = ("imagesize", "resolution", "imageresolution")
# of camodocal (VINS)
CAMODOCAL_GROUPS = (
    "projection_parameters",
    "distortion_parameters",
    "mirror_parameters",
)
CAMODOCAL_FISHEYE_KEYS = {
    "mu": "fx",
    "mv": "fy",
    "u0": "cx",
    "v0": "cy",
    "k2": "k1",
    "k3": "k2",
    "k4": "k3",
    "k5": "k4",
}
"""OpenCV's names of camodocal's parameters of a fisheye."""
MAX_FOCAL_MISMATCH = (
    0.01  # relative difference allowed between a focal length and an angle
)
LENS_KEYS = frozenset(
    ("camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h", *OPENCV_COEFFICIENTS)
)
"""Entries of nerfstudio about a camera; they are of all frames, or of a single one."""
SCENE_KEYS = frozenset(
    "frames aabb_scale scale offset applied_transform applied_scale ply_file_path "
    "orientation_override auto_scale_poses_override train_filenames val_filenames "
    "test_filenames camera_angle_x camera_angle_y file_path transform_matrix sharpness "
    "colmap_im_id mask_path depth_file_path "
    "semantic_path time rotation".split()
)
"""Entries of a transforms.json, and of its frames, that are not about the lens. The
angles among them replace focal lengths that are missing.
"""
VIEW_KEYS = frozenset(("object_to_camera", "up", "part", "set", "occluder"))
"""Entries of the camera file of a single photograph that are not about the lens (see
`advsearch.scene.photograph_files`).
"""


def _list_lines(text: str) -> list[str]:
    """Return the lines of a text that are neither blank nor comments."""
    return [
        line
        for line in text.splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]


def read_camera(spec: str) -> CameraModel:
    """Read a camera's model from a file.

    The format is recognized by the content: COLMAP's text, files of OpenCV, ROS,
    Kalibr, nerfstudio, and of some other tools.

    Args:
        spec: the file. If it has several cameras, one is named behind a #:
            ``camchain.yaml#cam1``, ``cameras.txt#3``.

    Raises:
        FileFormatError: the file is missing or of no known format; its projection is
            not supported; a number is out of its range; or an entry changes the image,
            but is not supported.
    """
    path, _, camera_name = spec.partition("#")
    text = _read_camera_text(path)
    lines = _list_lines(text)
    if lines and COLMAP_LINE.fullmatch(lines[0].strip()):
        return _read_colmap(spec, path, camera_name, lines)
    check_text_format(path, text)
    return make_camera(spec, _parse_file(path, text))


def make_camera(spec: str, entries: Mapping[str, Any]) -> CameraModel:
    """Return the camera model that the entries of a file describe.

    Args:
        spec: path of the file, with the name of one of its cameras behind a #:
            ``calib.yaml#cam1``. It is used for messages and names; nothing is read.
        entries: contents of the file, by name.

    Raises:
        FileFormatError: the projection is not supported, numbers are missing or out of
            their ranges, or the file has no camera of that name.
    """
    path, _, camera_name = spec.partition("#")
    data = {name: value for name, value in entries.items() if name not in VIEW_KEYS}
    # The translated entries are those of the selected camera alone.
    translated = translate_entries(path, camera_name, data)
    if translated is not None:
        return _read_opencv(spec, CameraEntries(path, translated))
    if "frames" in data or "fl_x" in data or "camera_angle_x" in data:
        return _read_nerfstudio(spec, camera_name, data)
    cameras = _find_kalibr_cameras(data)
    if cameras:
        return _read_kalibr_chain(spec, data, cameras)
    _check_no_camera_name(path, camera_name)
    if "intrinsics" in data and "camera_model" in data:
        return _read_kalibr(spec, CameraEntries(path, data))
    return _read_opencv(spec, CameraEntries(path, _flatten_groups(data)))


def _find_kalibr_cameras(data: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return those entries of a file that are cameras of Kalibr, by name."""
    return {
        name: entry
        for name, entry in data.items()
        if isinstance(entry, dict) and "intrinsics" in entry
    }


def _read_kalibr_chain(
    spec: str, data: Mapping[str, Any], cameras: Mapping[str, Any]
) -> CameraModel:
    """Return the model of one of the cameras in a file of Kalibr.

    Args:
        spec: the file, and perhaps the camera in it.
        data: all entries of the file.
        cameras: those of them that are cameras, by name.
    """
    path, _, camera_name = spec.partition("#")
    other_entries = {name: entry for name, entry in data.items() if name not in cameras}
    camera = CameraEntries(path, select_camera(path, camera_name, cameras))
    unread_outside = CameraEntries(path, other_entries).find_unread()
    return _read_kalibr(spec, camera, unread_outside)


def _check_no_camera_name(path: str, camera_name: str) -> None:
    """Raise FileFormatError if a user names a camera in a file of a single one."""
    if camera_name:
        raise FileFormatError(
            f"{path}: expected several cameras, as {camera_name!r} is requested, got "
            f"one; leave #{camera_name} out"
        )


def read_camera_entries(path: str) -> dict[str, Any]:
    """Return the entries of a camera file in YAML, JSON or XML, by name.

    Raises FileFormatError: it is no camera file, or cannot be read.
    """
    text = _read_camera_text(path)
    check_text_format(path, text)
    return _parse_file(path, text)


def _read_camera_text(path: str) -> str:
    """Return the text of a camera file.

    Raises FileFormatError: it is missing, too large, or has another kind of content.
    """
    suffix = Path(path).suffix.lower()
    if suffix in CAMERA_FORMAT_ADVICE and Path(path).is_file():
        raise FileFormatError(
            f"{path}: expected a camera as text, got {CAMERA_FORMAT_ADVICE[suffix]}"
        )
    if suffix in MESHES:
        raise FileFormatError(
            f"{path}: expected a camera file, got a mesh; it is an object's, not a "
            "camera's"
        )
    limit = MAX_JSON_SIZE if suffix == ".json" else MAX_YAML_BYTES
    return read_existing_text(path, "a camera file", limit)


def _flatten_groups(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return entries with those of camodocal's groups on the top level.

    {"projection_parameters": {"fx": 400}} becomes {"fx": 400}. The numbers of its
    fisheye lens (mu, mv, u0, v0) get the names that other programs use.
    """
    groups = {
        name: data[name]
        for name in CAMODOCAL_GROUPS
        if isinstance(data.get(name), dict)
    }
    entries = {name: value for name, value in data.items() if name not in groups}
    for group in groups.values():
        renamed_keys = CAMODOCAL_FISHEYE_KEYS if "mu" in group else {}
        entries |= {
            renamed_keys.get(str(key), str(key)): value for key, value in group.items()
        }
    return entries


def _parse_file(path: str, text: str) -> dict[str, Any]:
    """Parse a camera file that is XML, JSON or YAML.

    If a YAML file has several documents, the first one is parsed.

    Raises FileFormatError: it cannot be parsed, or is no mapping of names.
    """
    if text.lstrip().startswith("<"):
        return _parse_xml(path, text)
    is_json = path.lower().endswith(".json")
    data = (
        parse_text(path, text, "JSON", parse_json)
        if is_json
        else _parse_yaml(path, text)
    )
    if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
        _reject_content(path, data)
    return data


def _parse_yaml(path: str, text: str) -> Any:
    """Parse the first document of a YAML file, also of OpenCV's kind."""
    # OpenCV's YAML begins with a directive, and has tags, that are not standard.
    text = re.sub(r"\A%YAML[^\n]*\n", "", text)
    text = re.sub(r"!!opencv-(nd-)?matrix", "", text)
    # only the first document
    text = re.sub(r"\A\s*---[^\n]*\n", "", text).split("\n---")[0]
    return parse_text(path, text, "YAML, or COLMAP's cameras.txt", parse_yaml)


def _reject_content(path: str, data: object) -> NoReturn:
    """Raise FileFormatError for a file that is no mapping of names."""
    got = "an empty file" if data is None else f"a {type(data).__name__}"
    raise FileFormatError(
        f"{path}: expected a camera of OpenCV, Kalibr, ROS, COLMAP or nerfstudio, "
        f"got {got}; docs/cameras.md shows one of each"
    )


def _parse_xml(path: str, text: str) -> dict[str, Any]:
    """Parse a camera of OpenCV or Metashape in XML.

    An element with `data` is a matrix, and becomes the list of its words. Another
    element with elements in it becomes a dictionary, and any other its text.

    Raises FileFormatError: it is no XML of these two, or declares entities, by which a
    small file could become very large.
    """
    root = _parse_xml_root(path, text)
    return {element.tag: _convert_element(element) for element in root}


def _parse_xml_root(path: str, text: str) -> ElementTree.Element:
    """Return the root of a camera in XML; the errors are those of `_parse_xml`."""
    _check_has_no_entities(path, text)
    root: ElementTree.Element = parse_text(path, text, "XML", ElementTree.fromstring)
    check_xml_root(path, root.tag)
    if root.tag not in ("opencv_storage", METASHAPE_FILE):
        raise FileFormatError(
            f"{path}: expected a camera of OpenCV in <opencv_storage>, got "
            f"<{root.tag[:40]}>; docs/cameras.md has the formats that are read"
        )
    return root


def _check_has_no_entities(path: str, text: str) -> None:
    """Raise FileFormatError if the text of an XML file declares types or entities."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise FileFormatError(
            f"{path}: declares a document type or entities, which no camera needs; "
            "remove it"
        )


def _convert_element(element: ElementTree.Element) -> object:
    """Return the words of a matrix, the entries of a group, or a text."""
    inner = {entry.tag: (entry.text or "").strip() for entry in element}
    matrix = element.findtext("data")
    if matrix is not None:
        return matrix.split()
    return inner or (element.text or "").strip()


# ---- Formats ----


def _read_colmap(
    spec: str, path: str, camera_name: str, lines: Sequence[str]
) -> CameraModel:
    """Return the model of a camera of COLMAP's cameras.txt.

    A line has CAMERA_ID, MODEL, WIDTH, HEIGHT and the model's parameters. Some models
    have one focal length f for both axes.

    Args:
        spec: the file, and perhaps the camera in it.
        path: the file, for messages.
        camera_name: its CAMERA_ID; "" if the user has not named one.
        lines: the lines of the file that are neither blank nor comments.
    """
    words_by_id = {line.split()[0]: line.split() for line in lines}
    _check_lines_differ(path, words_by_id, lines)
    _, name, *values = select_camera(path, camera_name, words_by_id)
    _check_colmap_model(path, name)
    kind, parameters = COLMAP_MODELS[name]
    numbers = _parse_colmap_numbers(path, name, parameters, values)
    size = (numbers.pop("height"), numbers.pop("width"))
    if "f" in numbers:
        numbers["fy"] = numbers["fx"] = numbers.pop("f")
    # Without a pixel offset: COLMAP measures from the corner of the image.
    return make_camera_model(spec, kind, size, numbers)


def _check_lines_differ(
    path: str, words_by_id: Mapping[str, list[str]], lines: Sequence[str]
) -> None:
    """Raise FileFormatError if two lines of COLMAP are of one camera."""
    if len(words_by_id) < len(lines):
        raise FileFormatError(
            f"{path}: expected each camera once, got one with the same number twice; "
            "correct the file"
        )


def _check_colmap_model(path: str, name: str) -> None:
    """Raise FileFormatError if a name is not that of a model of COLMAP that is read."""
    if name not in COLMAP_MODELS:
        raise FileFormatError(
            f"{path}: expected one of COLMAP's models {', '.join(COLMAP_MODELS)}, got "
            f"{name[:40]}, which is another projection; calibrate with one of these "
            "(colmap model_converter cannot convert it), or undistort the pictures"
        )


def _parse_colmap_numbers(
    path: str, name: str, parameters: str, values: Sequence[str]
) -> dict[str, float]:
    """Return the numbers of a line of COLMAP by name, with the width and the height.

    Args:
        path: the file, for messages.
        name: name of the model.
        parameters: names of the model's numbers, separated by blanks.
        values: the numbers of the line.
    """
    keys = ["width", "height", *parameters.split()]
    if len(values) != len(keys):
        raise FileFormatError(
            f"{path}: {name}: expected {' '.join(keys)}, got {len(values)} numbers; "
            "correct the line"
        )
    return {
        key: parse_number(path, key, value)
        for key, value in zip(keys, values, strict=True)
    }


def _read_nerfstudio(
    spec: str, camera_name: str, data: Mapping[str, Any]
) -> CameraModel:
    """Return the model of a transforms.json, or of one of its frames.

    An entry of the frame replaces the entry of the same name that holds for all frames.
    A principal point that is missing is the center of the image.

    Args:
        spec: the file, and perhaps the frame in it.
        camera_name: name of the frame; "" if the user has not named one.
        data: all entries of the file.
    """
    path = spec.partition("#")[0]
    frames = _list_frames(data)
    lens = _select_lens(path, camera_name, frames)
    scene_entries = {key: value for key, value in data.items() if key not in SCENE_KEYS}
    entries = CameraEntries(path, scene_entries | lens)
    width = entries.get_number("w")
    height = entries.get_number("h")
    kind = _read_projection(path, entries)
    numbers = _read_nerfstudio_numbers(data, entries, kind, (height, width))
    model = make_camera_model(spec, kind, (height, width), numbers)
    unread = entries.find_unread()
    frame_entries = CameraEntries(path, _select_other_entries(frames))
    return add_notes(model, [*unread, *frame_entries.find_unread("frames.")])


def _read_nerfstudio_numbers(
    data: Mapping[str, Any],
    entries: CameraEntries,
    kind: str,
    size: tuple[float, float],
) -> dict[str, float]:
    """Return the numbers of a camera of nerfstudio in pixels, by name.

    Args:
        data: all entries of the file.
        entries: entries of the camera.
        kind: kind of its model.
        size: height and width of the image in pixels.
    """
    height, width = size
    # The angles of view are among the `SCENE_KEYS`, so that `entries` lacks them.
    numbers = _read_focal_lengths(entries.path, data, entries, width, height)
    numbers["cx"] = entries.get_number("cx", width / 2.0)
    numbers["cy"] = entries.get_number("cy", height / 2.0)
    is_fisheye = kind == FISHEYE
    names = COEFFICIENTS[:4] if is_fisheye else ("k1", "k2", "k3", "p1", "p2")
    numbers |= _read_optional_numbers(entries, names)
    return numbers


def _list_frames(data: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the frames of a transforms.json that are mappings; [] if there are none."""
    frames = data.get("frames") or []
    if not isinstance(frames, list):
        return []
    return [frame for frame in frames if isinstance(frame, dict)]


def _select_other_entries(frames: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the entries of frames that are about neither the lens nor the scene.

    If several frames have an entry of the same name, the last one's is returned.
    """
    other_entries = {}
    for frame in frames:
        for key, value in frame.items():
            if key not in LENS_KEYS | SCENE_KEYS:
                other_entries[key] = value
    return other_entries


def _read_projection(path: str, entries: CameraEntries) -> str:
    """Return the kind of a camera model by nerfstudio's entries.

    Raises:
        FileFormatError: the model is not supported.
    """
    name = str(entries.get("cameramodel") or "PINHOLE").upper()
    _check_nerfstudio_model(path, name)
    if entries.get("isfisheye"):  # whatever the name is
        return FISHEYE
    if name == "PERSPECTIVE":
        return BROWN_CONRADY
    kind, _ = COLMAP_MODELS[name]
    return kind


def _check_nerfstudio_model(path: str, name: str) -> None:
    """Raise FileFormatError if a camera model is none of those of nerfstudio's files."""
    if name not in (*COLMAP_MODELS, "PERSPECTIVE"):
        raise FileFormatError(
            f"{path}: expected one of the camera models {', '.join(COLMAP_MODELS)}, "
            f"got {format_name(name)}, which is another projection; calibrate with one "
            "of these"
        )


def _read_focal_lengths(
    path: str,
    data: Mapping[str, Any],
    entries: CameraEntries,
    width: float,
    height: float,
) -> dict[str, float]:
    """Return fx and fy in pixels, from lengths or from angles of view.

    If the file has both, the length is returned. If it has neither for y, fy is fx.

    Args:
        path: the file, for messages.
        data: all entries of the file, which may have the angles, radians.
        entries: entries of the camera, which may have the lengths.
        width: width of the image in pixels.
        height: height of the image in pixels.

    Raises:
        FileFormatError: length and angle along x contradict each other, or both are
            missing.
    """
    fx_by_angle = _compute_focal_length(path, data.get("camera_angle_x"), width)
    fy_by_angle = _compute_focal_length(path, data.get("camera_angle_y"), height)
    # Without an angle there is no default, and the length is required.
    fx = entries.get_number("fl_x", default=fx_by_angle)
    _check_focal_lengths_agree(path, fx, fx_by_angle)
    default_fy = fx if fy_by_angle is None else fy_by_angle
    return {"fx": fx, "fy": entries.get_number("fl_y", default=default_fy)}


def _check_focal_lengths_agree(path: str, fx: float, fx_by_angle: float | None) -> None:
    """Raise FileFormatError if a focal length contradicts that of an angle of view.

    Args:
        path: the file, for messages.
        fx: focal length along x in pixels.
        fx_by_angle: that of the angle of view; None if the file has no angle.
    """
    if fx_by_angle is not None and abs(fx - fx_by_angle) > MAX_FOCAL_MISMATCH * fx:
        raise FileFormatError(
            f"{path}: fl_x: expected {fx_by_angle:g}, as camera_angle_x states, got "
            f"{fx:g}; leave one out"
        )


def _select_lens(
    path: str, camera_name: str, frames: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the entries about the lens of a frame, or those that all frames share.

    Args:
        path: the file, for messages.
        camera_name: index of the frame, as text; "" if the user has not named one.
        frames: frames of the file.

    Raises:
        FileFormatError: there is no such frame, or the lenses of the frames differ and
            the user has not named one.
    """
    lenses = [
        {key: frame[key] for key in frame if key in LENS_KEYS} for frame in frames
    ]
    if not lenses:
        # A file without frames states its lens outside of them, and no frame adds to
        # it.
        lenses = [{}]
    first_lens: dict[str, Any] = lenses[0]
    if not camera_name and all(lens == first_lens for lens in lenses):
        return first_lens
    lens_by_index = {str(index): lens for index, lens in enumerate(lenses)}
    selected: dict[str, Any] = select_camera(path, camera_name, lens_by_index)
    return selected


def _compute_focal_length(path: str, angle: object, side: float) -> float | None:
    """Return the focal length, in pixels, of a field of view; None without an angle.

    Args:
        path: the file, for messages.
        angle: an entry of the file, radians; None if it is missing.
        side: side of the image, in pixels, that the angle spans.
    """
    if angle is None:
        return None
    half_angle = parse_number(path, "camera_angle", angle) / 2.0
    # 1e-9: an angle of 0 or less becomes a very long focal length
    return side / 2.0 / max(math.tan(half_angle), 1e-9)


def _read_kalibr(
    spec: str, entries: CameraEntries, unread: Sequence[str] = ()
) -> CameraModel:
    """Return the model of a camera of Kalibr.

    Args:
        spec: the file, and perhaps the camera in it.
        entries: entries of the camera.
        unread: names of entries outside of the camera that were not read. They are
            noted.

    Raises:
        FileFormatError: the camera is no pinhole, or numbers are missing.
    """
    path = entries.path
    model = str(entries.get("cameramodel") or "pinhole")
    _check_kalibr_model(path, model)
    kind = _find_kind(path, entries.get("distortionmodel"))
    intrinsics = entries.parse_numbers(
        "intrinsics", entries.get("intrinsics"), counts=(4,)
    )
    names = ("k1", "k2", "k3", "k4") if kind == FISHEYE else ("k1", "k2", "p1", "p2")
    resolution = entries.require("resolution")
    width, height = entries.parse_numbers("resolution", resolution, counts=(2,))
    numbers = _read_distortion(entries, names, counts=(0, 4))
    numbers |= zip(("fx", "fy", "cx", "cy"), intrinsics, strict=True)
    camera = make_camera_model(spec, kind, (height, width), numbers, FIRST_PIXEL_CENTER)
    return add_notes(camera, [*unread, *entries.find_unread()])


def _check_kalibr_model(path: str, model: str) -> None:
    """Raise FileFormatError if a camera model of Kalibr is no pinhole."""
    if model != "pinhole":
        advice = (
            describe_projection(model)
            or ", which is not read; calibrate as pinhole-equi or pinhole-radtan"
        )
        raise FileFormatError(
            f"{path}: expected the camera_model pinhole of Kalibr, got {model[:40]}"
            f"{advice}"
        )


def _read_opencv(spec: str, entries: CameraEntries) -> CameraModel:
    """Return the model of a camera of OpenCV or ROS.

    The calibration is of the sensor's pixels. ROS may bin several of them into one
    pixel of the image; the model has the size of that image.

    Args:
        spec: the file, and perhaps the camera in it.
        entries: entries of the camera.

    Raises FileFormatError: the sensor is tilted, images are of a region of interest, or
    numbers are missing.
    """
    path = entries.path
    kind = _find_opencv_kind(path, entries)
    if kind == EQUIRECTANGULAR:
        return _read_opencv_panorama(spec, entries)
    matrix = _read_camera_matrix(path, entries)
    height, width = _read_size(entries)
    unread_roi_keys = _check_roi(entries, (height, width))
    numbers = _read_opencv_distortion(entries, kind) | _name_matrix_entries(matrix)
    y_binning, x_binning = _read_binning(entries)
    # Pixels at the end that fill no bin are cut off. The model stores lengths as
    # fractions of the size without them.
    used_size = (height - height % y_binning, width - width % x_binning)
    model = make_camera_model(spec, kind, used_size, numbers, FIRST_PIXEL_CENTER)
    binned_size = (int(height // y_binning), int(width // x_binning))
    model = replace(model, calibrated_shape=binned_size)
    rectified_keys = _find_rectified(entries, matrix)
    return add_notes(model, unread_roi_keys + entries.find_unread(), rectified_keys)


def _read_opencv_panorama(spec: str, entries: CameraEntries) -> CameraModel:
    """Return the model of a panorama, which has a size and no other numbers.

    Binning and a region are not read here: `find_unread` rejects them. The arguments
    are those of `_read_opencv`.
    """
    size = _read_size(entries)
    panorama = make_camera_model(spec, EQUIRECTANGULAR, size, pixel_values={})
    return add_notes(panorama, entries.find_unread())


def _find_opencv_kind(path: str, entries: CameraEntries) -> str:
    """Return the kind of model that a camera of OpenCV or ROS states.

    Without an entry that states it, it is Brown's and Conrady's. If OpenCV's flag
    `fisheye_model` is set, the camera is a fisheye, whatever the other entries state.
    These must agree with each other all the same.

    Raises FileFormatError: two entries contradict each other, or the model is not
    supported.
    """
    # `entries` has keys in lower case, without underscores.
    keys = ("distortionmodel", "cameramodel", "modeltype")
    models = [entries.get(key) for key in keys]
    kinds = {_find_kind(path, model) for model in models if model is not None}
    is_fisheye = not has_no_effect(entries.get("fisheyemodel"))
    are_contradictory = len(kinds) > 1
    if are_contradictory:
        raise FileFormatError(
            f"{path}: expected one model, got a camera_model that contradicts the "
            "distortion_model"
        )
    return FISHEYE if is_fisheye else next(iter(kinds), BROWN_CONRADY)


def _read_camera_matrix(path: str, entries: CameraEntries) -> list[float]:
    """Return the camera matrix, nine numbers row by row.

    If the file has only fx, fy, cx and cy, the matrix is made of them. Some tools write
    it column by column, with cx and cy in the last row: then it is transposed.

    Raises:
        FileFormatError: it is missing, all zeros, or no camera matrix.
    """
    matrix = _read_matrix_numbers(entries)
    _check_is_calibrated(path, matrix)
    # A camera matrix is fx, skew, cx, 0, fy, cy, 0, 0, 1. Open3D and ARKit write it by
    # columns: fx, 0, 0, skew, fy, 0, cx, cy, 1.
    lacks_center_in_rows = not (matrix[1] or matrix[2] or matrix[5])
    has_center_in_last_row = bool(matrix[6] or matrix[7])
    is_by_columns = lacks_center_in_rows and has_center_in_last_row
    if is_by_columns:
        matrix = [matrix[3 * column + row] for row in range(3) for column in range(3)]
    _check_matrix_zeros(path, matrix)
    return matrix


def _read_matrix_numbers(entries: CameraEntries) -> list[float]:
    """Return the nine numbers of a camera matrix, in the order of the file."""
    if entries.get(*CAMERA_MATRIX_KEYS) is None and entries.get("fx") is not None:
        fx, fy, cx, cy = (entries.get_number(name) for name in ("fx", "fy", "cx", "cy"))
        return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    matrix = entries.require("camera_matrix", CAMERA_MATRIX_KEYS)
    return entries.parse_numbers("camera_matrix", matrix, counts=(9,))


def _check_is_calibrated(path: str, matrix: Sequence[float]) -> None:
    """Raise FileFormatError for a camera matrix of zeros."""
    if not any(matrix):
        raise FileFormatError(
            f"{path}: expected a calibrated camera, got a camera_matrix (K) of zeros, "
            "which ROS writes for a camera that is not calibrated; calibrate it, and "
            "use the file that this writes"
        )


def _check_matrix_zeros(path: str, matrix: Sequence[float]) -> None:
    """Raise FileFormatError if a matrix, row by row, is not that of a camera."""
    if matrix[3] or matrix[6] or matrix[7] or matrix[8] != 1.0:
        raise FileFormatError(
            f"{path}: camera_matrix: expected fx, skew, cx, 0, fy, cy, 0, 0, 1, got "
            "other numbers"
        )


def _name_matrix_entries(matrix: Sequence[float]) -> dict[str, float]:
    """Return the numbers of a camera matrix, nine row by row, that are not fixed."""
    fx, skew, cx, _, fy, cy = matrix[:6]
    return {"fx": fx, "skew": skew, "cx": cx, "fy": fy, "cy": cy}


def _read_distortion(
    entries: CameraEntries, names: Sequence[str], counts: Sequence[int]
) -> dict[str, float]:
    """Return the distortion coefficients, from a list or from single entries.

    Args:
        entries: entries of the camera.
        names: names of the coefficients, in the order of the list.
        counts: the lengths that the list may have.

    Raises:
        FileFormatError: the list has another length, or there are coefficients though
            the model is "none".
    """
    distortion = entries.get(*DISTORTION_KEYS)
    # If the list is missing or all zeros, the coefficients are single entries, such as
    # k1. An OpenCV matrix, which is a mapping, is always used.
    has_list = isinstance(distortion, Mapping) or not has_no_effect(distortion)
    if not has_list:
        coefficients = _read_optional_numbers(entries, names)
    else:
        values = entries.parse_numbers("distortion_coefficients", distortion, counts)
        # The list may have fewer coefficients than there are names.
        coefficients = dict(zip(names, values, strict=False))
    _check_stated_distortion(entries, coefficients)
    return coefficients


def _check_stated_distortion(
    entries: CameraEntries, coefficients: Mapping[str, float]
) -> None:
    """Raise FileFormatError for coefficients of a model that is "none"."""
    model = entries.get("distortionmodel")
    is_undistorted = isinstance(model, str) and model.strip().lower() == "none"
    if is_undistorted and any(coefficients.values()):
        raise FileFormatError(
            f"{entries.path}: expected no distortion, as its distortion_model is none, "
            "got coefficients"
        )


def _read_opencv_distortion(entries: CameraEntries, kind: str) -> dict[str, float]:
    """Return the distortion coefficients of a camera of OpenCV or ROS, by name.

    Raises FileFormatError: the sensor is tilted, which `CameraModel` cannot express.
    """
    if kind == FISHEYE:
        return _read_distortion(entries, COEFFICIENTS[:4], counts=(0, 4))
    coefficients = _read_distortion(
        entries, OPENCV_COEFFICIENTS, OPENCV_COEFFICIENT_COUNTS
    )
    x_tilt = coefficients.pop("tauX", 0.0)
    y_tilt = coefficients.pop("tauY", 0.0)
    if x_tilt or y_tilt:
        raise FileFormatError(
            f"{entries.path}: expected no tilt of the sensor (tauX, tauY), got one; "
            "calibrate without CALIB_TILTED_MODEL"
        )
    return coefficients


def _read_optional_numbers(
    entries: CameraEntries, names: Sequence[str]
) -> dict[str, float]:
    """Return entries that are numbers, by name; 0 for those that are missing."""
    return {name: entries.get_number(name, 0.0) for name in names}


def _find_rectified(entries: CameraEntries, matrix: Sequence[float]) -> list[str]:
    """Return the names of matrices of rectified images that differ from the camera's.

    A rectification matrix changes nothing if it is the identity. A projection changes
    nothing if it is the camera matrix and a column of zeros.

    Args:
        entries: entries of the camera.
        matrix: the camera matrix, nine numbers row by row.
    """
    fx, skew, cx, _, fy, cy = matrix[:6]
    differing_names = []
    for name, short_name, expected in (
        ("rectification_matrix", "r", [1.0, 0, 0, 0, 1, 0, 0, 0, 1]),
        ("projection_matrix", "p", [fx, skew, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]),
    ):
        value = entries.get(normalize_key(name), short_name)  # either of its names
        if has_no_effect(value):  # missing, or all zeros
            continue
        numbers = entries.parse_numbers(name, value, counts=(len(expected),))
        if _differ(numbers, expected):
            differing_names.append(name)
    return differing_names


def _differ(numbers: Sequence[float], expected: Sequence[float]) -> bool:
    """Return whether numbers differ from expected ones by more than rounding."""
    return any(
        abs(a - b) > 1e-6 * max(1.0, abs(b))
        for a, b in zip(numbers, expected, strict=True)
    )


def _check_roi(entries: CameraEntries, size: tuple[float, float]) -> list[str]:
    """Check that a region of interest of ROS is the full image.

    ROS writes zeros for the full image.

    Args:
        entries: entries of the camera.
        size: height and width of the image in pixels.

    Returns:
        The names of the region's entries that were not read, such as "roi.stamp".

    Raises:
        FileFormatError: the region is only a part of the image.
    """
    value = entries.get("roi")
    if not isinstance(value, Mapping):
        value = {}
    roi = CameraEntries(entries.path, {str(key): value[key] for key in value})
    numbers = _read_optional_numbers(roi, ("x_offset", "y_offset", "height", "width"))
    roi.get("dorectify")  # marks it as read: it changes nothing in a full image
    if not _is_full_image(numbers, size):
        raise FileFormatError(
            f"{entries.path}: expected a camera_info of full pictures, got one of a "
            "part (roi); set it to 0"
        )
    return roi.find_unread("roi.")


def _is_full_image(numbers: Mapping[str, float], size: tuple[float, float]) -> bool:
    """Return whether a region of interest of ROS is the full image.

    Args:
        numbers: offsets and size of the region in pixels, by ROS's names.
        size: height and width of the image in pixels.
    """
    offset = (numbers["x_offset"], numbers["y_offset"])
    roi_size = (numbers["height"], numbers["width"])
    return offset == (0.0, 0.0) and roi_size in ((0.0, 0.0), size)


def _find_kind(path: str, model: object) -> str:
    """Return the kind of a distortion model by the name that a tool gives it."""
    name = re.sub(r"[-\s]", "_", str(model or "").strip().lower())
    # A pinhole may have Brown's and Conrady's distortion.
    if name == "pinhole":
        return BROWN_CONRADY
    if name not in KIND_OF_DISTORTION:
        # The name "", of a model that is not stated, is left out of the message.
        supported_names = ", ".join(key for key in KIND_OF_DISTORTION if key)
        advice = describe_projection(name) or "; calibrate with one of these"
        raise FileFormatError(
            f"{path}: expected one of the distortion models {supported_names}, got "
            f"{name[:40]!r}{advice}"
        )
    return KIND_OF_DISTORTION[name]


def _read_size(entries: CameraEntries) -> tuple[float, float]:
    """Return the height and width of the image in pixels."""
    size = entries.get(*SIZE_KEYS)
    if size is not None:
        width, height = entries.parse_numbers("image_size", size, counts=(2,))
        return height, width
    width = entries.get_number("image_width", aliases=WIDTH_KEYS)
    return entries.get_number("image_height", aliases=HEIGHT_KEYS), width


def _read_binning(entries: CameraEntries) -> tuple[float, float]:
    """Return how many of the sensor's pixels ROS bins into one, along y and x."""
    # ROS writes 0 for no binning, as for 1.
    y_binning = entries.get_number("binning_y", 1.0) or 1.0
    x_binning = entries.get_number("binning_x", 1.0) or 1.0
    for name, pixels in (("binning_y", y_binning), ("binning_x", x_binning)):
        if pixels != int(pixels) or not 1 <= pixels <= MAX_BINNING:
            raise FileFormatError(
                f"{entries.path}: {name}: expected a whole number up to {MAX_BINNING}, "
                f"got {pixels:g}"
            )
    return y_binning, x_binning
