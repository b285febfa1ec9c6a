"""Photographs with a camera file beside them, and folders of such photographs.

``desk.yaml`` beside ``desk.jpg`` is a camera file in any supported format. It may have
further entries (`VIEW_KEYS`): the pose of the object, the part of the photograph to
use, settings of the scene, and a mask of what is in front of the object.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from advsearch.errors import FileFormatError, InputError
from advsearch.pictures import open_image
from advsearch.scene.assets import Float64Array
from advsearch.scene.backdrop import CROP, compute_view_settings, find_photograph_file
from advsearch.scene.camera_files import VIEW_KEYS, read_camera_entries
from advsearch.scene.description import SceneDescription
from advsearch.scene.rig import PhotographCameras, read_photograph_cameras
from advsearch.scene.settings import resolve_settings
from advsearch.trust.named_files import is_inside
from advsearch.trust.stored_files import (
    LARGEST_FILE,
    check_most,
    record_opened,
    track_opened_files,
)

CAMERA_SUFFIXES = (".yaml", ".yml", ".json")
PHOTOGRAPH_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff")
MAX_PHOTOGRAPHS = 1000  # limit of the photographs of a folder
MAX_FILES = 100_000  # limit of the files of all kinds in a folder
# Limit of the pixels of all photographs of a folder, which take three bytes each.
MAX_FOLDER_PIXELS = 1 << 28
VIEW_SETTINGS = ("camera.", "pose.", "ground.", "backdrop.")
"""Prefixes of the settings that a camera file may state."""


@dataclass(frozen=True, eq=False)
class PhotographView:
    """A photograph, and the entries of the camera file beside it.

    Attributes:
        spec: the photograph, and perhaps the part of it, ``desk.jpg#X,Y,WIDTH,HEIGHT``.
        file: its camera file; "" if there is none.
        camera: the camera file, if it has a lens; else None.
        settings: settings of the scene that the file states.
        object_to_camera: pose (4, 4) of the object; None if it is not stated.
        up: upwards direction (3,) in the camera's coordinates; None if not stated.
        occluder: path of a mask of what is in front of the object, or None.
    """

    spec: str
    file: str = ""
    camera: str | None = None
    settings: Mapping[str, float] = field(default_factory=dict)
    object_to_camera: Float64Array | None = None
    up: Float64Array | None = None
    occluder: str | None = None

    @property
    def stated_names(self) -> frozenset[str]:
        """Names of the entries and of the settings that the file states.

        They are used in messages: a lens, which may have any entries, is "a lens".
        """
        value_by_name = {
            "a lens": self.camera,
            "object_to_camera": self.object_to_camera,
            "up": self.up,
        }
        stated = {name for name, value in value_by_name.items() if value is not None}
        return frozenset(stated | set(self.settings))

    @property
    def replaced_settings(self) -> tuple[str, ...]:
        """Prefixes of settings that the file replaces, such as "camera."."""
        groups = {name.partition(".")[0] for name in self.settings}
        if self.object_to_camera is not None:
            groups |= {"camera", "pose", "ground"}
        return tuple(sorted(f"{group}." for group in groups))


def is_photograph_folder(spec: object) -> bool:
    """Return whether a `backdrop` setting names a folder of photographs."""
    return isinstance(spec, (str, Path)) and os.path.isdir(spec)


# ---- reading


def read_photograph_view(spec: str | Path) -> PhotographView:
    """Read the camera file beside a photograph, if there is one.

    The photograph itself is not read.

    Args:
        spec: a picture file, perhaps with the part to use,
            ``photo.jpg#X,Y,WIDTH,HEIGHT``. This part replaces one in the camera file.

    Raises:
        FileFormatError: the file cannot be used.
    """
    part_match = CROP.fullmatch(str(spec))
    path = Path(part_match["path"] if part_match else spec)
    file = find_camera_file(path)
    if file is None:
        return PhotographView(str(spec))
    # The camera file is recorded as one of the photograph's files.
    with track_opened_files(path):
        record_opened(file)
        entries = read_camera_entries(str(file))
    # Its `spec` has the part that the camera file states.
    view = _parse_view(file, path, entries)
    return replace(view, spec=str(spec)) if part_match else view


def find_camera_file(photograph: Path) -> Path | None:
    """Return the camera file beside a photograph: ``desk.yaml`` for ``desk.jpg``."""
    for suffix in CAMERA_SUFFIXES:
        file = photograph.with_suffix(suffix)
        if file != photograph and file.is_file():
            return file
    return None


def read_photograph_folder(
    folder: str | Path, *, has_camera: bool = False
) -> dict[str, PhotographView]:
    """Read the camera files of all photographs of a folder.

    Other files, hidden files and subfolders are ignored.

    Args:
        folder: the folder.
        has_camera: whether the user names a camera, or one file with the cameras of all
            photographs. Then photographs need no camera files.

    Returns:
        The views by the name of the photograph's file, in alphabetical order.

    Raises:
        FileFormatError: there are no photographs or too many, or they have too many
            pixels; a camera file is missing, or has other entries than the first one; a
            link leads out of the folder; or a file cannot be used.
    """
    directory = Path(folder)
    views: dict[str, PhotographView] = {}
    n_pixels = 0
    for path in _list_photographs(directory):
        _check_files(path, directory, has_camera=has_camera)
        n_pixels += _measure_pixels(path)
        check_most(
            directory, n_pixels, MAX_FOLDER_PIXELS, "photographs of at most {} pixels"
        )
        view = read_photograph_view(path)
        # The first view is compared with itself, which never fails.
        first_view = next(iter(views.values()), view)
        _check_same_statements(view, first_view)
        views[path.name] = view
    return views


def _measure_pixels(path: Path) -> int:
    """Return the number of pixels of a photograph, from its file."""
    with open_image(path, LARGEST_FILE) as image:
        return image.width * image.height


def _check_files(path: Path, directory: Path, *, has_camera: bool) -> None:
    """Check a photograph of a folder, and the camera file beside it.

    Raises FileFormatError: one of them is a link that leads out of the folder, or
    there is no camera file, and the user names no camera (`has_camera`).
    """
    file = find_camera_file(path)
    if file is None and not has_camera:
        _reject_without_camera(path)
    _check_inside(path, directory)
    if file is not None:
        _check_inside(file, directory)


def _reject_without_camera(path: Path) -> NoReturn:
    """Raise FileFormatError for a photograph that has no camera file beside it."""
    raise FileFormatError(
        f"{path}: expected its camera file beside it, such as "
        f"{path.with_suffix('.yaml').name}, got none; add it, remove the "
        "photograph from the folder, or set `camera` for all of them"
    )


def _list_photographs(folder: Path) -> list[Path]:
    """Return the photographs of a folder in alphabetical order.

    Raises:
        FileFormatError: there are none, or too many files.
    """
    paths: list[Path] = []
    with os.scandir(folder) as entries:
        for index, entry in enumerate(entries, start=1):
            check_most(folder, index, MAX_FILES, "a folder of at most {} files")
            if _is_visible_photograph(entry.name):
                paths.append(folder / entry.name)
    if not paths:
        raise FileFormatError(
            f"{folder}: expected photographs ({', '.join(PHOTOGRAPH_SUFFIXES)}), each "
            "with its camera file beside it, got none"
        )
    check_most(folder, len(paths), MAX_PHOTOGRAPHS, "at most {} photographs")
    return sorted(paths)


def _is_visible_photograph(file_name: str) -> bool:
    """Return whether a file is a photograph, by its name, and is not hidden."""
    is_photograph = Path(file_name).suffix.lower() in PHOTOGRAPH_SUFFIXES
    return is_photograph and not file_name.startswith(".")


def _check_inside(path: Path, folder: Path) -> None:
    """Raise FileFormatError if a file of a folder is a link that leads out of it."""
    if not is_inside(path, folder):
        raise FileFormatError(
            f"{path}: is a link out of its folder, which is not followed; copy the file"
        )


def _check_same_statements(view: PhotographView, first: PhotographView) -> None:
    """Raise FileFormatError unless the camera files of two views state the same names.

    Values that only one of the files states would be unknown for the other photograph.
    """
    for checked_view, other_view in ((view, first), (first, view)):
        missing = sorted(other_view.stated_names - checked_view.stated_names)
        if missing:
            # The message names the camera file, or the photograph if it has none. The
            # other view states something, so that it has a camera file.
            path = checked_view.file or checked_view.spec
            raise FileFormatError(
                f"{path}: expected {missing[0]}, which {Path(other_view.file).name} "
                "states; add it"
            )


# ---- entries of a camera file that are not about the lens


def _parse_view(
    file: Path, photograph: Path, entries: Mapping[str, Any]
) -> PhotographView:
    """Return the view that the entries of a camera file describe.

    Args:
        file: path of the camera file.
        photograph: path of its photograph, in the same folder.
        entries: entries of the camera file, by name.
    """
    stated = {name: entries[name] for name in VIEW_KEYS & entries.keys()}
    has_lens = bool(entries.keys() - VIEW_KEYS)  # all other entries are about the lens
    pose = _parse_pose(file, stated) if "object_to_camera" in stated else None
    spec = str(photograph)
    if "part" in stated:
        spec = _parse_part(file, spec, stated)
    return PhotographView(
        spec=spec,
        file=str(file),
        camera=str(file) if has_lens else None,
        settings=_parse_settings(file, stated.get("set", {})),
        object_to_camera=pose,
        up=_parse_numbers(file, "up", stated, counts=(3,)) if "up" in stated else None,
        occluder=_parse_occluder(file, stated),
    )


def _parse_pose(file: Path, stated: Mapping[str, Any]) -> Float64Array:
    """Return the pose (4, 4) of the object that a camera file states."""
    numbers = _parse_numbers(file, "object_to_camera", stated, counts=(12, 16))
    # The last row of a pose is always 0 0 0 1, and may be left out.
    pose = np.eye(4)
    n_rows = len(numbers) // 4
    pose[:n_rows] = numbers.reshape(-1, 4)
    return pose


def _parse_part(file: Path, photograph: str, stated: Mapping[str, Any]) -> str:
    """Return the path of a photograph with the part of it that a camera file states."""
    part = _parse_numbers(file, "part", stated, counts=(4,))
    spec = photograph + "#" + ",".join(f"{number:.0f}" for number in part.tolist())
    if not CROP.fullmatch(spec):
        raise FileFormatError(
            f"{file}: part: expected X, Y, WIDTH, HEIGHT in pixels, got "
            f"{stated['part']!s:.60}"
        )
    return spec


def _parse_numbers(
    file: Path, name: str, stated: Mapping[str, Any], counts: tuple[int, ...]
) -> Float64Array:
    """Return the finite numbers of an entry: a list, a list of rows, or a text.

    Args:
        file: path of the camera file, for messages.
        name: name of the entry.
        stated: entries of the file, by name.
        counts: the numbers of values that it may have, such as (12, 16).

    Raises:
        FileFormatError: it has another number of values, or values that are no finite
            numbers.
    """
    value = _unwrap_entry(stated[name])
    numbers = _to_flat_numbers(value)
    if len(numbers) not in counts or not np.isfinite(numbers).all():
        expected = " or ".join(map(str, counts))
        raise FileFormatError(
            f"{file}: {name}: expected {expected} finite numbers, got {value!s:.60}"
        )
    return numbers


def _unwrap_entry(value: object) -> object:
    """Return the list in a matrix of OpenCV or in a text; other values as they are."""
    if isinstance(value, Mapping):  # a matrix as OpenCV writes it
        value = value.get("data")
    if isinstance(value, str):
        return value.replace(",", " ").split()
    return value


def _to_flat_numbers(value: Any) -> Float64Array:
    """Return the numbers (N,) of an entry; none if it has other values."""
    try:
        return np.array(value, np.float64).reshape(-1)
    except (TypeError, ValueError):
        return np.empty(0)


def _parse_settings(file: Path, stated: object) -> dict[str, float]:
    """Return the settings of the scene that a camera file has in its entry `set`.

    Args:
        file: path of the camera file, for messages.
        stated: the entry: settings by name, such as {"ground.level": 0.2}.

    Raises:
        FileFormatError: it has other settings than those of the view, or values out of
            their range.
    """
    if not isinstance(stated, Mapping):
        raise FileFormatError(f"{file}: set: expected settings by name")
    _check_view_settings(file, stated)
    try:
        values = resolve_settings(stated)
    except InputError as error:
        raise FileFormatError(f"{file}: {error}") from None
    # A stated value is never None; "or" is for the type.
    return {str(name): float(values[name] or 0.0) for name in stated}


def _check_view_settings(file: Path, stated: Mapping[Any, object]) -> None:
    """Raise FileFormatError if a camera file sets what is not about the view."""
    for name in stated:
        if not str(name).startswith(VIEW_SETTINGS):
            raise FileFormatError(
                f"{file}: set: {name!s:.60} is not about the view; expected settings "
                f"that begin with {', '.join(VIEW_SETTINGS)}"
            )


def _parse_occluder(file: Path, stated: Mapping[str, Any]) -> str | None:
    """Return the path of the mask that a camera file names; None if it names none."""
    if "occluder" not in stated:
        return None
    name = str(stated["occluder"])
    mask = file.parent / name
    if "\0" in name or not is_inside(mask, file.parent):
        raise FileFormatError(
            f"{file}: occluder: expected a file in its folder or below, got {name:.80}"
        )
    return str(mask)


# ---- the scene in a photograph


def make_photograph_scene(
    description: SceneDescription,
    view: PhotographView,
    camera: str | PhotographCameras | None = None,
    occluder: str | Path | None = None,
) -> SceneDescription:
    """Return a scene as it is rendered into a photograph.

    Settings of the scene that the user requested are not replaced.

    Args:
        description: the scene.
        view: the photograph, and the entries of its camera file.
        camera: replaces the camera of the camera file. It is a camera file, the name of
            a camera, or the cameras of many photographs, which are looked up by the
            photograph. Names of the latter's files are accepted, too.
        occluder: replaces the mask of what is in front of the object.

    Raises:
        FileFormatError: a file cannot be used.
        InputError: the entries contradict the scene.
    """
    scene = _apply_stated_settings(description, view.settings)
    requested_camera = camera or view.camera
    photograph = find_photograph_file(view.spec)  # `spec` is a path: never None here
    scene = _with_requested_camera(scene, requested_camera, photograph)
    scene = scene.with_backdrop(view.spec, occluder or view.occluder)
    if view.object_to_camera is None:
        return scene
    return _apply_measured_pose(scene, view, view.object_to_camera)


def _with_requested_camera(
    scene: SceneDescription,
    requested_camera: str | PhotographCameras | None,
    photograph: Path | None,
) -> SceneDescription:
    """Return a scene with the camera that took a photograph, if there is one.

    Args:
        scene: the scene.
        requested_camera: a camera file, the name of a camera, or the cameras of many
            photographs or their file; None leaves the camera as it is.
        photograph: the file of the photograph.
    """
    cameras = requested_camera
    if isinstance(requested_camera, str):
        cameras = _read_cameras(requested_camera, photograph)
    if isinstance(cameras, str):
        return scene.with_camera(cameras)
    if cameras is not None and photograph is not None:
        return scene.with_photograph_camera(cameras, photograph)
    return scene


def _apply_stated_settings(
    description: SceneDescription, settings: Mapping[str, float]
) -> SceneDescription:
    """Return a scene with the settings of a camera file that the user has not
    requested.
    """
    stated = {
        name: value
        for name, value in settings.items()
        if name not in description.requested
    }
    # Controls (the parameters that a search varies) must not vary settings that the
    # user requested. Settings of the file are protected like these, except for those of
    # camera and pose.
    fixed = {name for name in stated if not name.startswith(("camera.", "pose."))}
    return replace(
        description,
        values={**description.values, **stated},
        requested=description.requested | fixed,
    )


def _read_cameras(spec: str, photograph: Path | None) -> str | PhotographCameras:
    """Return the cameras of many photographs in a file, or the file of a single one."""
    with track_opened_files(photograph or spec):
        return read_photograph_cameras(spec) or spec


def _apply_measured_pose(
    scene: SceneDescription, view: PhotographView, object_to_camera: Float64Array
) -> SceneDescription:
    """Return a scene with the measured pose (4, 4) of the object in a photograph."""
    try:
        measured = compute_view_settings(scene.object, object_to_camera, view.up)
    except InputError as error:
        raise InputError(f"{view.file}: {error}") from None
    measured_values = {
        name: value for name, value in measured.items() if name not in scene.requested
    }
    return replace(scene, values={**scene.values, **measured_values})
