"""Read which objects photographs show, and where: directories in BOP's form, and lists.

BOP's form (Hodan et al. 2018, "BOP: Benchmark for 6D object pose estimation") has
`scene_gt.json`, `scene_camera.json`, `rgb/`, and meshes in millimeters in `models/`. A
list (CSV, JSON or YAML) has a row for each object in a photograph (docs/twins.md).
Poses lead from the coordinates of the mesh's file to those of the camera, which are x
to the right, y down and z forwards, as in OpenCV.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt

from advsearch.extend import InputError, errors, reading, stored_files

Float64Array = npt.NDArray[np.float64]

MAX_JSON_BYTES = 1 << 26  # size of a file with all poses of a scene
MAX_YAML_BYTES = 1 << 17  # size of a list in YAML, which is slow to read
MAX_VIEWS = 100_000  # number of objects in photographs of one run
MAX_IMAGE_DIGITS = 12  # digits of an image's number in BOP's form
MAX_OBJECT_NUMBER = 999_999  # in BOP's form: file names have six digits
MAX_TEXT = 200  # characters of a frame, label or condition; the rest is cut
MAX_NUMBER = 1e9  # numbers of a pose or a camera, in any unit
MAX_ROTATION_ERROR = 0.02  # of an entry of R R^T, compared with the identity
PINHOLE_KIND = (
    "brown-conrady"  # kind of a camera model; it is a pinhole at distortion 0
)
MAX_SKEW = 1e-6  # as a fraction of the focal length; a larger one is rejected
GROUND_TRUTH = "scene_gt.json"
PHOTO_FOLDERS = ("rgb", "gray")
PHOTO_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".webp")
LIST_SUFFIXES = (".csv", ".json", ".yaml", ".yml")
REQUIRED_LIST_KEYS = ("photograph", "object", "pose")
LIST_KEYS = (
    *REQUIRED_LIST_KEYS,
    "camera",
    "K",
    "unit",
    "label",
    "condition",
    "frame",
    "mask",
)
"""The keys that a row of a list must have, and all keys that it may have."""


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion; all numbers are in pixels.

    The principal point is measured from the corner of the photograph.
    """

    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def pixel_aspect(self) -> float:
        """Height of a pixel over its width, in angles: fx / fy."""
        return self.fx / self.fy


@dataclass(frozen=True, eq=False)
class PhotographedObject:
    """An object as a photograph shows it.

    Attributes:
        photograph: file of the photograph.
        frame: name of the independent unit that it belongs to: a photograph, or a
            scene.
        object: name of the object.
        mesh: file of the mesh.
        unit: unit of the coordinates of the mesh and of the pose.
        pose: (4, 4) map from the coordinates of the mesh's file to the camera's.
        camera: camera that took the photograph.
        label: the right label; empty takes the object's name.
        condition: condition of the photograph, such as "dim"; empty if there is none.
        mask: file with the mask of the full silhouette; None without one.
        visible_mask: file with the mask of what is visible of it; None without one.
        visible: fraction of the silhouette that is visible; None if unknown.
        box: x, y, width and height of the silhouette in pixels, from the data set.
        where: file and entry that state it, for messages.
    """

    photograph: Path
    frame: str
    object: str
    mesh: Path
    unit: str
    pose: Float64Array
    camera: Pinhole
    label: str = ""
    condition: str = ""
    mask: Path | None = None
    visible_mask: Path | None = None
    visible: float | None = None
    box: tuple[float, float, float, float] | None = None
    where: str = ""


@dataclass(frozen=True)
class Listing:
    """The objects in photographs that a directory or a list states.

    Attributes:
        objects: objects in photographs, in the order of the files.
        n_missing: number of objects whose photograph is missing.
    """

    objects: list[PhotographedObject]
    n_missing: int = 0


def read_photographs(path: Path) -> Listing:
    """Read a directory in BOP's form or a list.

    Raises:
        InputError: there is neither, or something in it cannot be used; the message
            names the file and the entry.
    """
    if path.suffix.lower() in LIST_SUFFIXES:
        listing = Listing(list(_read_list(path)))
    else:
        listing = _read_bop(path)
    # A missing photograph of a list is an error, so `n_missing` is that of a directory.
    if not listing.objects:
        raise InputError(
            f"photographs: {path} names {listing.n_missing} objects in photographs, "
            "and none of these photographs is in it; copy them, or name another folder"
        )
    # `{}` in the text becomes the limit.
    stored_files.check_most(
        path, len(listing.objects), MAX_VIEWS, "at most {} objects in photographs"
    )
    return listing


# ---- BOP


def _read_bop(folder: Path) -> Listing:
    """Read all scenes of a data set, of a split or of one scene."""
    scenes = _find_scenes(folder)
    if not scenes:
        raise InputError(
            f"photographs: expected a folder in BOP's form, with {GROUND_TRUTH} in it "
            f"or in its scenes, or a list ({', '.join(LIST_SUFFIXES)}), got {folder}"
        )
    models = _find_models(folder)
    objects: list[PhotographedObject] = []
    n_missing = 0
    for scene in scenes:
        condition = scene.name if len(scenes) > 1 else ""
        listing = _read_scene(scene, models, condition)
        objects += listing.objects
        n_missing += listing.n_missing
    return Listing(objects, n_missing)


def _find_scenes(folder: Path) -> list[Path]:
    """Return the folders of scenes: the folder itself, or those one or two below it."""
    for pattern in (GROUND_TRUTH, f"*/{GROUND_TRUTH}", f"*/*/{GROUND_TRUTH}"):
        scenes = sorted(file.parent for file in folder.glob(pattern))
        if scenes:
            return scenes
    return []


def _find_models(folder: Path) -> Path:
    """Return the folder of meshes: in the folder, or in one of the two above it."""
    resolved = folder.resolve()
    for parent in (resolved, *resolved.parents[:2]):
        if (parent / "models").is_dir():
            return parent / "models"
    raise InputError(
        f"photographs: expected the meshes of {folder} in a folder models in it or "
        "above it, got none"
    )


def _read_scene(scene: Path, models: Path, condition: str) -> Listing:
    """Read one scene of a data set in the format of BOP (bop.felk.cvut.cz).

    `scene_gt.json` has poses of objects by image number, and `scene_camera.json` has
    the cameras. Lengths are in millimeters.

    Args:
        scene: directory of the scene.
        models: directory of the meshes.
        condition: condition of all its photographs, such as "night"; or empty.
    """
    truths = _read_json(scene / GROUND_TRUTH)
    cameras = _read_json(scene / "scene_camera.json")
    infos: Mapping[str, Any] = {}
    if (scene / "scene_gt_info.json").is_file():
        infos = _read_json(scene / "scene_gt_info.json")
    bop_scene = _BopScene(scene, models, condition, cameras, infos)
    objects: list[PhotographedObject] = []
    n_missing = 0
    for image, entries in truths.items():
        image_objects = bop_scene.read_objects(image, entries)
        # Data sets are often downloaded without all photographs.
        if image_objects is None:
            n_missing += len(entries)
        else:
            objects += image_objects
    return Listing(objects, n_missing)


@dataclass(frozen=True)
class _BopScene:
    """A scene of a data set in BOP's form.

    Attributes:
        directory: directory of the scene.
        models: directory of the meshes.
        condition: condition of all its photographs, such as "night"; or empty.
        cameras: the camera of each image, by its number as text, unchecked.
        infos: likewise, what `scene_gt_info.json` has about the image's objects.
    """

    directory: Path
    models: Path
    condition: str
    cameras: Mapping[str, Any]
    infos: Mapping[str, Any]

    def read_objects(self, image: str, entries: Any) -> list[PhotographedObject] | None:
        """Read the objects of an image; None if its photograph is missing.

        Args:
            image: number of the image, as text.
            entries: what the ground truth has about it, unchecked.
        """
        where = f"{self.directory / GROUND_TRUTH}: image {image[:20]}"
        is_number = image.isdecimal() and len(image) <= MAX_IMAGE_DIGITS
        if not is_number or not _is_rows(entries):
            raise errors.FileFormatError(f"{where}: expected a list of objects")
        photograph = _find_photograph(self.directory, int(image))
        if photograph is None:
            return None
        shared = self._read_shared_values(image, photograph, where)
        infos = self.infos.get(image)
        return [
            PhotographedObject(
                **shared,
                **_read_bop_silhouette(self.directory, image, index, infos),
                **_read_bop_object(where, entry, self.models),
            )
            for index, entry in enumerate(entries)
        ]

    def _read_shared_values(
        self, image: str, photograph: Path, where: str
    ) -> dict[str, Any]:
        """Return the fields that all objects of an image share.

        Args:
            image: number of the image, as text.
            photograph: its photograph.
            where: location in the ground truth, for messages.
        """
        return {
            "photograph": photograph,
            "frame": f"{self.directory.name}/{image}",
            "camera": _read_bop_camera(self.directory, self.cameras, image),
            "unit": "mm",
            "condition": self.condition,
            "where": where,
        }


def _read_bop_silhouette(
    scene: Path, image: str, index: int, infos: Any
) -> dict[str, Any]:
    """Return the masks, the visible fraction and the box of an object; None if unknown.

    Args:
        scene: directory of the scene.
        image: number of the image, as text.
        index: index of the object among those of the image.
        infos: what `scene_gt_info.json` has about the image's objects, unchecked.
    """
    info: Mapping[str, Any] = {}
    if _is_rows(infos) and index < len(infos):
        info = infos[index]
    return {
        "mask": _find_mask(scene, "mask", image, index),
        "visible_mask": _find_mask(scene, "mask_visib", image, index),
        "visible": _get_fraction(info),
        "box": _get_box(info),
    }


def _read_bop_object(
    where: str, entry: Mapping[str, Any], models: Path
) -> dict[str, Any]:
    """Return object, mesh and pose of an entry of the ground truth.

    Args:
        where: location in the file, for messages.
        entry: entry of the object.
        models: directory of the meshes.
    """
    number = entry.get("obj_id")
    if not isinstance(number, int) or not 0 <= number <= MAX_OBJECT_NUMBER:
        raise errors.FileFormatError(f"{where}: expected obj_id, a whole number")
    name = f"obj_{number:06d}"
    mesh = models / f"{name}.ply"
    if not mesh.is_file():
        raise errors.FileFormatError(f"{where}: expected the mesh {mesh}, got none")
    return {"object": name, "mesh": mesh, "pose": _read_bop_pose(entry, where)}


def _read_bop_pose(entry: Mapping[str, Any], where: str) -> Float64Array:
    """Return the pose (4, 4) of an entry of the ground truth: mesh to camera."""
    rotation = _to_numbers(entry.get("cam_R_m2c"), f"{where}: cam_R_m2c", 9)
    translation = _to_numbers(entry.get("cam_t_m2c"), f"{where}: cam_t_m2c", 3)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.reshape(3, 3)
    matrix[:3, 3] = translation
    return _check_pose(matrix, where)


def _read_bop_camera(scene: Path, cameras: Mapping[str, Any], image: str) -> Pinhole:
    """Return the camera of an image; in its file, pixel centers are whole numbers."""
    where = f"{scene / 'scene_camera.json'}: image {image[:20]}"
    entry = cameras.get(image)
    if not isinstance(entry, dict):
        raise errors.FileFormatError(f"{where}: expected its camera, got none")
    return _make_pinhole(_to_numbers(entry.get("cam_K"), f"{where}: cam_K", 9), where)


def _find_photograph(scene: Path, image: int) -> Path | None:
    """Return the photograph with a number in a BOP scene; None if it is missing."""
    for folder in PHOTO_FOLDERS:
        for suffix in PHOTO_SUFFIXES:
            file = scene / folder / f"{image:06d}{suffix}"
            if file.is_file():
                return file
    return None


def _find_mask(scene: Path, folder: str, image: str, index: int) -> Path | None:
    """Return the mask of an image's object by its index; None if it is missing."""
    file = scene / folder / f"{int(image):06d}_{index:06d}.png"
    return file if file.is_file() else None


def _get_fraction(info: Mapping[str, Any]) -> float | None:
    """Return the visible fraction that BOP states; None if it is no valid number."""
    value = info.get("visib_fract")
    if not isinstance(value, (int, float)) or not 0.0 <= value <= 1.0:
        return None
    return float(value)


def _get_box(info: Mapping[str, Any]) -> tuple[float, float, float, float] | None:
    """Return the box of the silhouette that BOP states; None if there is none."""
    numbers = info.get("bbox_obj")
    if not isinstance(numbers, list) or len(numbers) != 4:
        return None
    if not all(isinstance(number, (int, float)) for number in numbers):
        return None
    x, y, width, height = map(float, numbers)
    return (x, y, width, height) if width > 0.0 and height > 0.0 else None


def _read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file with an entry for each image."""
    text = stored_files.read_existing_text(
        path, "a JSON file of a scene", MAX_JSON_BYTES
    )
    content = stored_files.parse_text(path, text, "JSON", stored_files.parse_json)
    if not isinstance(content, dict):
        raise errors.FileFormatError(f"{path}: expected an object with the images")
    return content


def _is_rows(value: object) -> TypeGuard[list[dict[str, Any]]]:
    """Return whether a value read from a file is a list of mappings."""
    return isinstance(value, list) and all(isinstance(row, dict) for row in value)


# ---- lists


def _read_list(path: Path) -> Iterator[PhotographedObject]:
    """Yield the rows of a list of photographs."""
    for number, row in enumerate(_read_rows(path), start=1):
        yield _read_row(row, path, f"{path}: row {number}")


def _read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a list of photographs, in CSV, JSON or YAML.

    A row is a mapping. Rows of CSV have texts as values, and no keys for empty cells.
    """
    rows = _parse_list(path)
    if isinstance(rows, dict):  # JSON or YAML with the list under this key
        rows = rows.get("photographs")
    if not _is_rows(rows):
        raise errors.FileFormatError(
            f"{path}: expected a list with a row for each object in a photograph"
        )
    return list(rows)


def _parse_list(path: Path) -> Any:
    """Return the content of a list of photographs, in CSV, JSON or YAML, unchecked."""
    suffix = path.suffix.lower()
    is_yaml = suffix not in (".csv", ".json")  # ".yaml" or ".yml"
    text = stored_files.read_existing_text(
        path, "a list of photographs", MAX_YAML_BYTES if is_yaml else MAX_JSON_BYTES
    )
    if suffix == ".csv":
        return [
            {key: value for key, value in row.items() if value}
            for row in csv.DictReader(io.StringIO(text))
        ]
    if suffix == ".json":
        return stored_files.parse_text(path, text, "JSON", stored_files.parse_json)
    from advsearch.extend import workbench  # imports torch

    return stored_files.parse_text(path, text, "YAML", workbench.parse_yaml)


def _read_row(row: Mapping[str, Any], path: Path, where: str) -> PhotographedObject:
    """Read a row of a list: one object in one photograph.

    Args:
        row: values by the names in `LIST_KEYS`.
        path: path of the list; names of files are relative to its directory.
        where: the list and the row, for messages.

    Raises:
        FileFormatError: a value is missing or not valid.
    """
    _check_keys(row, where)
    photograph = _get_file(row, "photograph", path, where)
    mesh = _get_file(row, "object", path, where)
    matrix = _read_matrix(row, where)
    unit = str(row.get("unit", "m"))
    if unit not in ("mm", "cm", "m", "in"):
        raise errors.FileFormatError(f"{where}: unit: expected mm, cm, m or in")
    return PhotographedObject(
        photograph=photograph,
        frame=str(row.get("frame") or photograph.name)[:MAX_TEXT],
        object=mesh.stem,
        mesh=mesh,
        unit=unit,
        pose=_check_pose(matrix, where),
        camera=_read_row_camera(row, path, photograph, where),
        label=str(row.get("label") or "")[:MAX_TEXT],
        condition=str(row.get("condition") or "")[:MAX_TEXT],
        mask=_get_file(row, "mask", path, where) if "mask" in row else None,
        where=where,
    )


def _read_matrix(row: Mapping[str, Any], where: str) -> Float64Array:
    """Return the pose of a row as a matrix (4, 4), which may not be valid.

    It is a matrix (3, 4) or (4, 4) in the row. The last row of the latter is 0, 0, 0, 1.
    """
    numbers = _to_numbers(row["pose"], f"{where}: pose", 12, 16)
    matrix = np.eye(4)
    matrix[:3] = numbers[:12].reshape(3, 4)
    return matrix


def _check_keys(row: Mapping[str, Any], where: str) -> None:
    """Reject a row with an unknown key, or without a required one."""
    unknown = sorted(map(str, set(row) - set(LIST_KEYS)))
    if unknown:
        raise errors.FileFormatError(
            f"{where}: expected some of {', '.join(LIST_KEYS)}, got {unknown[0][:40]}"
        )
    for key in REQUIRED_LIST_KEYS:
        if key not in row:
            raise errors.FileFormatError(f"{where}: expected {key}, got none")


def _get_file(row: Mapping[str, Any], key: str, path: Path, where: str) -> Path:
    """Return the path of a file that a row names.

    It has to be in the directory of the list or below: a list may come from others.

    Args:
        row: values of the row by name.
        key: name of the value, such as "mask".
        path: path of the list.
        where: the list and the row, for messages.
    """
    name = str(row[key])
    file = path.parent / name
    if "\0" in name or not reading.is_inside(file, path.parent):
        raise errors.FileFormatError(
            f"{where}: {key}: expected a file in the folder of the list or below, got "
            f"{name[:80]}"
        )
    if not file.is_file():
        raise errors.FileFormatError(f"{where}: {key}: there is no file {name[:80]}")
    return file


def _read_row_camera(
    row: Mapping[str, Any], path: Path, photograph: Path, where: str
) -> Pinhole:
    """Return the camera of a row: its `K`, or that of a camera file.

    `K` is the matrix (3, 3) of a pinhole camera, with focal lengths and principal point
    in pixels.

    Args:
        row: values of the row by name.
        path: path of the list; names of files are relative to its directory.
        photograph: path of the photograph, whose size turns fractions into pixels.
        where: the list and the row, for messages.
    """
    has_matrix = "K" in row
    has_file = "camera" in row
    if has_matrix == has_file:  # both or neither
        raise errors.FileFormatError(
            f"{where}: expected either K, nine numbers in pixels, or camera, a file"
        )
    if has_matrix:
        return _make_pinhole(_to_numbers(row["K"], f"{where}: K", 9), where)
    # imports torch
    from advsearch.extend import workbench

    file = _get_file(row, "camera", path, where)
    model = workbench.read_camera(str(file))
    return _scale_to_photograph(model, photograph, where)


def _scale_to_photograph(model: Any, photograph: Path, where: str) -> Pinhole:
    """Return the pinhole of a camera model, in pixels of a photograph.

    Args:
        model: the camera model; its lengths are fractions of the width and the height.
        photograph: path of the photograph.
        where: the list and the row, for messages.

    Raises:
        InputError: the lens has a distortion.
    """
    # These are fractions of the width and the height.
    lens = {key: model.intrinsic_by_name[key] for key in ("fx", "fy", "cx", "cy")}
    distortion = [
        value for key, value in model.intrinsic_by_name.items() if key not in lens
    ]
    if any(distortion) or model.kind != PINHOLE_KIND:
        raise InputError(
            f"{where}: camera: expected a pinhole, got a lens with distortion; "
            "undistort the photographs first"
        )
    height, width = reading.pictures.read_image_size(photograph)
    return Pinhole(
        lens["fx"] * width, lens["fy"] * height, lens["cx"] * width, lens["cy"] * height
    )


# ---- numbers


def _to_numbers(value: Any, where: str, *counts: int) -> Float64Array:
    """Return finite numbers from a list, or from a text with spaces between them.

    Args:
        value: value from a file, which may have any type.
        where: location in the file, for messages.
        *counts: allowed counts of numbers.

    Raises:
        FileFormatError: the value is not such a list or text.
    """
    words: Sequence[Any] = value.split() if isinstance(value, str) else value
    expected = " or ".join(map(str, counts))
    try:
        # `float(True)` is 1.0, so booleans have to be rejected here.
        has_booleans = any(isinstance(word, bool) for word in words)
        if len(words) not in counts or has_booleans:
            raise ValueError
        numbers = np.array([float(word) for word in words], np.float64)
    except (TypeError, ValueError):
        raise errors.FileFormatError(
            f"{where}: expected {expected} numbers, got {str(value)[:60]}"
        ) from None
    if not np.isfinite(numbers).all() or np.abs(numbers).max() > MAX_NUMBER:
        raise errors.FileFormatError(f"{where}: expected finite numbers")
    return numbers


def _check_pose(matrix: Float64Array, where: str) -> Float64Array:
    """Return a pose (4, 4) with the nearest rotation.

    Measured rotations are off by some thousandths. The object has to be in front of the
    camera.
    """
    rotation = matrix[:3, :3]
    _check_rotation(rotation, where)
    if matrix[2, 3] <= 0.0:
        raise errors.FileFormatError(
            f"{where}: expected an object before the camera (z > 0), got z = "
            f"{matrix[2, 3]:g}"
        )
    left, _, right = np.linalg.svd(rotation)
    pose: Float64Array = matrix.copy()
    pose[:3, :3] = left @ right
    return np.asarray(pose)


def _check_rotation(rotation: Float64Array, where: str) -> None:
    """Raise an error if a matrix (3, 3) is not close to a rotation."""
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0.0:
        raise errors.FileFormatError(
            f"{where}: expected a rotation, got a matrix that stretches or mirrors"
        )


def _make_pinhole(numbers: Float64Array, where: str) -> Pinhole:
    """Return the camera of a matrix K (9,).

    In K, the centers of pixels have whole numbers as coordinates.
    """
    # K is [[fx, skew, cx], [0, fy, cy], [0, 0, 1]].
    fx, skew, cx, _, fy, cy, *_ = numbers.tolist()
    if not (fx > 0.0 and fy > 0.0 and math.isfinite(fx / fy)):
        raise errors.FileFormatError(f"{where}: expected focal lengths over 0")
    if abs(skew) > MAX_SKEW * fx:
        raise errors.FileFormatError(f"{where}: expected a camera without skew")
    # A `Pinhole` measures from the corner of the photograph, from which the center of
    # the first pixel is at 0.5.
    return Pinhole(fx, fy, cx + 0.5, cy + 0.5)
