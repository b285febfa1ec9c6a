"""Translation of camera files of other tools to the entries of OpenCV's files.

The mapping is exact for ORB-SLAM and stella_vslam, KITTI's calibration, RealSense,
OpenSfM and OpenDroneMap, and Metashape's `<calibration>`. Principal points are measured
from the center of the first pixel, as in OpenCV.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from advsearch.errors import FileFormatError
from advsearch.scene.camera_entries import parse_number, select_camera
from advsearch.scene.importing.files import format_name

FIT_FISHEYE = (
    "calibrate it as a fisheye of OpenCV (cv2.fisheye.calibrate, Kalibr's "
    "pinhole-equi), or undistort the pictures"
)
OTHER_PROJECTIONS: Mapping[str, str] = {
    **dict.fromkeys(
        ("omni", "mei", "omnidir", "omnidirectional", "unified", "ucm"),
        "the unified model with a mirror",
    ),
    **dict.fromkeys(("ds", "double_sphere"), "the double sphere model"),
    **dict.fromkeys(("eucm", "extended_unified"), "the extended unified model"),
    **dict.fromkeys(("fov", "atan"), "the FOV model"),
    **dict.fromkeys(
        ("scaramuzza", "ocam", "omnicalib", "ocamcalib", "pinhole_full"),
        "a polynomial of an angle",
    ),
    **dict.fromkeys(("ftheta", "f_theta"), "a polynomial of an angle"),
    **dict.fromkeys(
        ("division", "simple_division", "radial_division"), "a division model"
    ),
    **dict.fromkeys(
        ("thin_prism_fisheye", "rad_tan_thin_prism_fisheye", "fisheye62", "fisheye624"),
        "a fisheye with tangential and thin prism terms",
    ),
    "inverse_brown_conrady": "Brown's polynomial from the picture to the ray",
    "modified_brown_conrady": "RealSense's variant of Brown's polynomial",
    "dual": "a blend of perspective and fisheye",
    "cylindrical": "a cylinder",
    "equisolid_fisheye": "an equisolid fisheye",
}
"""Descriptions of models that are not supported, by the names that tools give them."""

OTHER_FORMATS: tuple[tuple[str, str, str], ...] = (
    (
        r"# ?Bundle file",
        "a Bundler reconstruction, which has no size of its pictures",
        "write f, k1 and k2 of one of its cameras as COLMAP's cameras.txt: 1 "
        "RADIAL WIDTH HEIGHT f WIDTH/2 HEIGHT/2 k1 k2",
    ),
    (
        r"NVM_V3",
        "a model of VisualSFM, whose distortion goes from the picture to the ray",
        "reconstruct with COLMAP and give its cameras.txt, or undistort the pictures",
    ),
    (
        r"#\s*polynomial coefficients for the DIRECT mapping",
        "a calibration of OCamCalib (Scaramuzza), a polynomial of an angle",
        FIT_FISHEYE,
    ),
    (
        r"extrinsic\s",
        "a camera of MVSNet, which has no size of its picture",
        "write its intrinsic matrix as YAML: image_width, image_height and "
        "camera_matrix",
    ),
    (
        r"\[[A-Za-z][\w ]*\]\s*\n\s*[A-Za-z]\w*\s*=",
        "sections of an INI file, as of a ZED's calibration",
        "write one section as YAML: image_width, image_height, fx, fy, cx, cy, k1, k2, "
        "p1, p2, k3, each with a colon",
    ),
    (
        r"<\?xpacket|<x:xmpmeta",
        "XMP of RealityCapture or RealityScan",
        "export the registration as COLMAP's text, and give cameras.txt",
    ),
)
"""Formats that are not read: a pattern of their beginning, a description, and advice."""

METASHAPE_FILE = "calibration"
METASHAPE_PROJECT = ("document", "chunk", "sensors", "sensor")
ORBSLAM_CAMERA = re.compile(r"(Camera\d?)\.fx")
ORBSLAM_KINDS = {
    "pinhole": "radtan",
    "kannalabrandt8": "kannala_brandt",
    "rectified": "none",
}
ORBSLAM_SIZE_NAMES = {"width": "image_width", "height": "image_height"}
ORBSLAM_NON_LENS_KEYS = re.compile(
    r"(ORBextractor|Viewer|IMU|System|Stereo|RGBD|LoopClosing|File|Initializer|Tracking|Mapping|Preprocessing)\..*"
    r"|Camera\d?\.(fps|RGB|bf|b|overlappingBegin|overlappingEnd|name|setup|color_order)|ThDepth|DepthMapFactor"
)
STELLA_KINDS = {
    "perspective": "radtan",
    "fisheye": "fisheye",
    "equirectangular": "equirectangular",
}
STELLA_NAMES = {
    "cols": "image_width",
    "rows": "image_height",
    "model": "distortion_model",
}
KITTI_PROJECTION = re.compile(r"P\d")
KITTI_RAW = re.compile(r"K_(\d\d)")
KITTI_RECTIFIED = re.compile(r"P_(rect_\d\d)")
KITTI_NON_LENS_KEYS = re.compile(
    r"P\d|R0_rect|R_rect|Tr(_\w+)?|calib_time|corner_dist|(S|K|D|R|T|P)_(rect_)?\d\d"
)
REALSENSE_NAMES = {"ppx": "cx", "ppy": "cy", "model": "distortion_model"}
OPENSFM_KINDS = {
    **dict.fromkeys(("perspective", "simple_radial", "radial", "brown"), "radtan"),
    **dict.fromkeys(("fisheye", "fisheye_opencv"), "fisheye"),
    **dict.fromkeys(("spherical", "equirectangular"), "equirectangular"),
}
METASHAPE_KINDS = {
    "frame": "radtan",
    "fisheye": "fisheye",
    "spherical": "equirectangular",
}
# Entries of a camera of OpenSfM that are translated; any other is passed on as it is.
OPENSFM_TRANSLATED_KEYS = (
    "projection_type",
    "width",
    "height",
    "focal",
    "focal_x",
    "focal_y",
    "c_x",
    "c_y",
)


def describe_projection(name: str) -> str:
    """Describe an unsupported model: the end of an error message, after its name.

    The text begins with a comma. It is "" if the model is not known.
    """
    description = OTHER_PROJECTIONS.get(re.sub(r"[-\s]+", "_", name.strip().lower()))
    if description is None:
        return ""
    return f", {description}, another projection; {FIT_FISHEYE}"


def check_text_format(path: str, text: str) -> None:
    """Raise FileFormatError for a text in a known format that is not read."""
    start = text.lstrip()[:2000]  # enough to recognize each of these formats
    for pattern, description, advice in OTHER_FORMATS:
        if re.match(pattern, start):
            raise FileFormatError(
                f"{path}: expected a camera file, got {description}; {advice}"
            )


def check_xml_root(path: str, tag: str) -> None:
    """Raise FileFormatError for an XML file of Metashape that is no single camera."""
    if tag in METASHAPE_PROJECT:
        raise FileFormatError(
            f"{path}: expected one camera, got Metashape's <{tag}>, with sensors and "
            "poses; save the lens alone: Tools > Camera Calibration > Adjusted > Save, "
            "as Agisoft XML (<calibration>)"
        )


def translate_entries(
    path: str, camera_name: str, data: Mapping[str, Any]
) -> dict[str, Any] | None:
    """Translate the entries of one camera to those of OpenCV's files.

    The tool that wrote the file is recognized by the names of the entries: ORB-SLAM,
    KITTI, OpenSfM, stella_vslam, RealSense or Metashape. Files of the last three have
    one camera only, which has no name.

    Args:
        path: the file.
        camera_name: the name of the camera; "" if the user has not named one.
        data: all entries of the file.

    Returns:
        The entries, or None if the file is not of a tool that is translated here.

    Raises:
        FileFormatError: the projection is not supported, numbers are missing, or the
            file has several cameras and the user has not named one.
    """
    orbslam_matches = map(ORBSLAM_CAMERA.fullmatch, data)
    orbslam_cameras = [match[1] for match in orbslam_matches if match]
    if orbslam_cameras:
        return _translate_orbslam(path, camera_name, data, orbslam_cameras)
    kitti_cameras = _find_kitti(data)
    if kitti_cameras:
        return _translate_kitti(path, camera_name, data, kitti_cameras)
    if data and all(map(_is_opensfm_camera, data.values())):
        return _translate_opensfm(path, select_camera(path, camera_name, data))
    # the other tools write a single camera, which has no name
    return None if camera_name else _translate_single(path, data)


def _is_opensfm_camera(entry: object) -> bool:
    """Return whether an entry is a camera of OpenSfM."""
    return isinstance(entry, dict) and "projection_type" in entry


def _translate_single(path: str, data: Mapping[str, Any]) -> dict[str, Any] | None:
    """Translate a camera of stella_vslam, RealSense or Metashape; None for others.

    The arguments are those of `translate_entries`.
    """
    stella_camera = data.get("Camera")
    if isinstance(stella_camera, dict) and "model" in stella_camera:
        return _translate_stella(stella_camera)
    if "ppx" in data:  # RealSense's name of cx
        return _translate_realsense(data)
    # A projection that is not supported is Metashape's, too, if there is an f.
    has_known_projection = data.get("projection") in METASHAPE_KINDS
    if has_known_projection or ("projection" in data and "f" in data):
        return _translate_metashape(path, data)
    return None


def _translate_stella(camera: Mapping[str, Any]) -> dict[str, Any]:
    """Translate a camera of stella_vslam: its names, and the name of its model.

    Entries that are not about the lens are left out. They have the same names as in
    ORB-SLAM's files.
    """
    entries = {
        STELLA_NAMES.get(str(name), str(name)): value for name, value in camera.items()
    }
    kind = str(camera["model"])
    entries["distortion_model"] = STELLA_KINDS.get(kind, kind)
    return {
        name: value
        for name, value in entries.items()
        if not ORBSLAM_NON_LENS_KEYS.fullmatch(f"Camera.{name}")
    }


def _translate_orbslam(
    path: str, camera_name: str, data: Mapping[str, Any], cameras: list[str]
) -> dict[str, Any]:
    """Translate a camera of ORB-SLAM, whose entries are `Camera.fx` or `Camera1.fx`.

    Entries of other cameras, and those that are not about the lens, are left out.
    Names without a camera before a dot stay as they are.

    Args:
        path: the file, for messages.
        camera_name: "" if the user has not named one.
        data: all entries of the file.
        cameras: names of its cameras, the part before the dot: "Camera" if it has one
            camera, else "Camera1", "Camera2".
    """
    selected_camera = select_camera(path, camera_name, {name: name for name in cameras})
    stated_type = str(data.get("Camera.type", "PinHole"))
    entries: dict[str, Any] = {
        "distortion_model": ORBSLAM_KINDS.get(stated_type.lower(), stated_type)
    }
    other_cameras = {name for name in cameras if name != selected_camera}
    for name, value in data.items():
        camera, _, _entry_name = name.partition(".")
        is_other = camera in other_cameras or ORBSLAM_NON_LENS_KEYS.fullmatch(name)
        if is_other or name == "Camera.type":  # the distortion model above
            continue
        entries[_shorten_orbslam_name(name, selected_camera)] = value
    return entries


def _shorten_orbslam_name(name: str, selected_camera: str) -> str:
    """Return the name of an entry of ORB-SLAM without the selected camera before it.

    Several cameras share the entries of `Camera`, such as `Camera.width`. Other entries
    keep their names.
    """
    camera, _, entry_name = name.partition(".")
    if camera in (selected_camera, "Camera"):
        return ORBSLAM_SIZE_NAMES.get(entry_name, entry_name)
    return name


def _find_kitti(data: Mapping[str, Any]) -> dict[str, str]:
    """Return the names of the matrices of KITTI's cameras, by the cameras' names.

    The matrix K_02 is of the camera "02", P_rect_02 of "rect_02", and P2 of "P2".
    """
    cameras = dict[str, str]()
    for name, value in data.items():
        # KITTI separates numbers by blanks, which YAML reads as a string. A list was
        # written by another tool: OpenCV, for example, names a matrix P1, too.
        if not isinstance(value, str):
            continue
        if KITTI_PROJECTION.fullmatch(name):  # "P2" is the camera and its matrix
            cameras[name] = name
            continue
        match = KITTI_RAW.fullmatch(name) or KITTI_RECTIFIED.fullmatch(name)
        if match:
            camera_name = match[1]
            cameras[camera_name] = name
    return cameras


def _read_numbers(
    path: str, data: Mapping[str, Any], name: str, count: int
) -> list[float]:
    """Return the numbers of an entry that are separated by blanks.

    Raises FileFormatError if there are not `count` of them.
    """
    words = str(data.get(name, "")).split()
    if len(words) != count:
        raise FileFormatError(
            f"{path}: {name}: expected {count} numbers, got "
            f"{format_name(' '.join(words) or 'nothing')}"
        )
    return [parse_number(path, name, word) for word in words]


def _translate_kitti(
    path: str, camera_name: str, data: Mapping[str, Any], cameras: Mapping[str, str]
) -> dict[str, Any]:
    """Translate a camera of KITTI: a raw one with distortion, or a rectified one.

    A raw camera has K_nn (3, 3), D_nn (5 coefficients) and S_nn (the size of the
    image), where nn is its number. A rectified camera has P_rect_nn or Pn, a projection
    (3, 4) without distortion, and perhaps S_rect_nn. Other entries of KITTI are left
    out.

    Args:
        path: the file, for messages.
        camera_name: "" if the user has not named one.
        data: all entries of the file.
        cameras: for each name of a camera the name of its matrix, such as "P_rect_02".

    Raises:
        FileFormatError: the file has no size of the image, or numbers are missing.
    """
    matrix_name = select_camera(path, camera_name, cameras)
    entries = {
        name: value
        for name, value in data.items()
        if not KITTI_NON_LENS_KEYS.fullmatch(name)
    }
    entries["camera_matrix"] = _read_kitti_matrix(path, data, matrix_name)
    raw_match = KITTI_RAW.fullmatch(matrix_name)
    if raw_match:
        distortion_name = f"D_{raw_match[1]}"
        coefficients = _read_numbers(path, data, distortion_name, count=5)
        entries["distortion_coefficients"] = coefficients
    return entries | _read_kitti_size(path, data, matrix_name)


def _read_kitti_size(
    path: str, data: Mapping[str, Any], matrix_name: str
) -> dict[str, Any]:
    """Return `image_size` of a camera of KITTI; empty if other entries have the size.

    K_02 has its size in S_02, P_rect_02 in S_rect_02, and P2 has none.

    Args:
        path: the file, for messages.
        data: all entries of the file.
        matrix_name: name of the camera's matrix, such as "P_rect_02".

    Raises:
        FileFormatError: the file has no size of the image.
    """
    size_name = re.sub(r"^[KP]_", "S_", matrix_name)
    if size_name != matrix_name and size_name in data:
        return {"image_size": _read_numbers(path, data, size_name, count=2)}
    _check_has_size_entries(path, data)
    return {}


def _read_kitti_matrix(
    path: str, data: Mapping[str, Any], matrix_name: str
) -> list[float]:
    """Return the camera matrix of KITTI's camera, nine numbers row by row."""
    if KITTI_RAW.fullmatch(matrix_name):
        return _read_numbers(path, data, matrix_name, 9)
    # The projection (3, 4) is K [R | t]. A rectified camera has R = 1, so that the
    # first three columns are K.
    projection = _read_numbers(path, data, matrix_name, 12)
    return [*projection[0:3], *projection[4:7], *projection[8:11]]


def _check_has_size_entries(path: str, data: Mapping[str, Any]) -> None:
    """Raise FileFormatError if a file of KITTI does not state the size of the image."""
    if "image_width" not in data or "image_height" not in data:
        raise FileFormatError(
            f"{path}: KITTI's calibration has no size of the pictures; add it in two "
            "lines, as in image_width: 1242 and image_height: 375 (also 1241 x 376, "
            "1226 x 370, 1224 x 370)"
        )


def _translate_realsense(data: Mapping[str, Any]) -> dict[str, Any]:
    """Translate the intrinsics of RealSense.

    Its models "inverse Brown-Conrady" and "modified Brown-Conrady" are not supported
    and keep their names, which the reader rejects. But if all coefficients are 0, both
    are the same as a pinhole, and are translated to "none".
    """
    entries = {REALSENSE_NAMES.get(name, name): value for name, value in data.items()}
    model = _simplify_realsense_model(str(data.get("model", "none")))
    coefficients = data.get("coeffs")
    is_undistorted = isinstance(coefficients, list) and not any(coefficients)
    if model in ("kannala_brandt4", "kannala_brandt"):
        model = "kannala_brandt"
        # The model has four coefficients; the list may be longer.
        if isinstance(coefficients, list):
            entries["coeffs"] = coefficients[:4]
    elif model in ("inverse_brown_conrady", "modified_brown_conrady"):
        if is_undistorted:
            model = "none"
    entries["distortion_model"] = model
    return entries


def _simplify_realsense_model(stated_model: str) -> str:
    """Return the name of a distortion model of RealSense in one spelling.

    "distortion.brown_conrady" and "Brown Conrady" become "brown_conrady".
    """
    name = stated_model.rpartition(".")[2].strip().lower()
    return re.sub(r"[-\s]+", "_", name)


def _translate_opensfm(path: str, camera: Mapping[str, Any]) -> dict[str, Any]:
    """Translate a camera of OpenSfM, whose lengths are fractions of the larger side.

    A panorama needs no lengths. Those of an unknown kind are not translated, since the
    camera is rejected later.

    Args:
        path: the file, for messages.
        camera: entries of the camera.
    """
    stated_type = str(camera["projection_type"])
    kind = OPENSFM_KINDS.get(stated_type)  # None if it is unknown
    entries = {
        name: value
        for name, value in camera.items()
        if name not in OPENSFM_TRANSLATED_KEYS
    }
    width, height = _parse_side_lengths(path, camera)
    entries |= {
        "distortion_model": stated_type if kind is None else kind,
        "image_width": width,
        "image_height": height,
    }
    if kind not in (None, "equirectangular"):
        entries |= _scale_opensfm_lengths(path, camera, width, height)
    return entries


def _parse_side_lengths(path: str, entries: Mapping[str, Any]) -> tuple[float, float]:
    """Return the entries `width` and `height` of a camera; `path` is for messages.

    Raises FileFormatError: one of them is missing, or is no number.
    """
    width = parse_number(path, "width", entries.get("width"))
    height = parse_number(path, "height", entries.get("height"))
    return width, height


def _scale_opensfm_lengths(
    path: str, camera: Mapping[str, Any], width: float, height: float
) -> dict[str, float]:
    """Return the focal lengths and the principal point of OpenSfM's camera in pixels.

    OpenSfM's principal point counts from the middle of the image, OpenCV's from the
    center of the first pixel, which is (side - 1) / 2 before the middle. `focal` is the
    length along both axes, unless they have their own.

    Args:
        path: the file, for messages.
        camera: the camera's entries, in which lengths are fractions of the larger side.
        width: width of the image in pixels.
        height: height of the image in pixels.
    """
    focal_x = parse_number(path, "focal_x", camera.get("focal_x", camera.get("focal")))
    focal_y = parse_number(path, "focal_y", camera.get("focal_y", focal_x))
    shift_x = parse_number(path, "c_x", camera.get("c_x", 0.0))
    shift_y = parse_number(path, "c_y", camera.get("c_y", 0.0))
    larger_side = max(width, height)
    return {
        "fx": larger_side * focal_x,
        "fy": larger_side * focal_y,
        "cx": (width - 1.0) / 2.0 + larger_side * shift_x,
        "cy": (height - 1.0) / 2.0 + larger_side * shift_y,
    }


def _translate_metashape(path: str, data: Mapping[str, Any]) -> dict[str, Any]:
    """Translate a camera of Agisoft Metashape (manual, appendix "Camera models").

    Metashape's p1 is OpenCV's p2, and vice versa. k4 is the fourth coefficient of the
    radial polynomial. OpenCV has such a term only for a fisheye. Other coefficients,
    such as k1 to k3, have the same meaning, and stay as they are.

    Args:
        path: the file, for messages.
        data: entries of the file; a number that is missing is 0.

    Raises:
        FileFormatError: the size is missing, or a camera that is no fisheye has a k4.
    """
    stated_type = str(data.get("projection", "frame"))
    value_by_name = {
        name: parse_number(path, name, data.get(name, 0.0))
        for name in ("f", "cx", "cy", "b1", "b2", "k4", "p1", "p2")
    }
    width, height = _parse_side_lengths(path, data)
    translated_names = (*value_by_name, "projection", "width", "height")
    entries = {
        name: entry for name, entry in data.items() if name not in translated_names
    }
    # A type that is not supported keeps its name, and is rejected later.
    kind = METASHAPE_KINDS.get(stated_type, stated_type)
    entries |= {"distortion_model": kind, "image_width": width, "image_height": height}
    if kind == "equirectangular":
        return entries
    return entries | _name_metashape_lens(path, kind, value_by_name, (width, height))


def _name_metashape_lens(
    path: str, kind: str, value_by_name: Mapping[str, float], size: tuple[float, float]
) -> dict[str, Any]:
    """Return the entries of the lens of a camera of Metashape, by OpenCV's names.

    Args:
        path: the file, for messages.
        kind: kind of the model, which is no panorama.
        value_by_name: Metashape's numbers.
        size: width and height of the image in pixels.
    """
    entries: dict[str, Any] = {
        "camera_matrix": _make_metashape_matrix(value_by_name, *size),
        "p1": value_by_name["p2"],
        "p2": value_by_name["p1"],
    }
    if kind == "fisheye":
        entries["k4"] = value_by_name["k4"]
    else:
        _check_no_fourth_term(path, value_by_name["k4"])
    return entries


def _check_no_fourth_term(path: str, k4: float) -> None:
    """Raise FileFormatError if a camera that is no fisheye has a fourth radial term."""
    if k4:
        raise FileFormatError(
            f"{path}: k4: expected 0, got {k4:g}: the fourth radial "
            "term of Metashape is not OpenCV's; leave k4 out of the fit and optimize "
            "the cameras again"
        )


def _make_metashape_matrix(
    value_by_name: Mapping[str, float], width: float, height: float
) -> list[float]:
    """Return the camera matrix of Metashape's numbers, nine numbers row by row.

    The focal lengths are f + b1 along x and f along y, and b2 is the skew. Metashape's
    cx and cy count from the center of the image; the matrix's count from the center of
    the first pixel, (side - 1) / 2 before it. All are in pixels.
    """
    center_x = (width - 1.0) / 2.0 + value_by_name["cx"]
    center_y = (height - 1.0) / 2.0 + value_by_name["cy"]
    focal = value_by_name["f"]
    first_row = [focal + value_by_name["b1"], value_by_name["b2"], center_x]
    return [*first_row, 0.0, focal, center_y, 0.0, 0.0, 1.0]
