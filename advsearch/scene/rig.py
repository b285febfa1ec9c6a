"""Rigs: several cameras of one scene, simultaneous or one after the other (a clip).

The first camera is that of the scene, which controls and paths move. The others are
mounted on it, or stand around the object at the same height and distance. Supported
files are a list of cameras in our own format, Kalibr's camchain with its extrinsics,
frames of nerfstudio's transforms.json, and COLMAP's images.txt with the cameras.txt
beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import FileFormatError
from advsearch.scene.assets import Float64Array, make_pose
from advsearch.scene.camera_files import (
    LENS_KEYS,
    MAX_JSON_SIZE,
    make_camera,
    read_camera,
)
from advsearch.scene.camera_model import CameraModel
from advsearch.scene.poses import make_rotation
from advsearch.scene.skeleton import compute_rotation_entries
from advsearch.trust.stored_files import (
    parse_json,
    parse_text,
    read_existing_text,
    read_text,
)
from advsearch.trust.yaml_text import MAX_YAML_BYTES, parse_yaml

MAX_CAMERAS = 32
MAX_DISTANCE = 1e4  # limit of the distance to the first camera, meters or object sizes
ENTRY_KEYS = ("name", "place", "turn", "around", "fov", "later")
MAX_DELAY = 60.0  # limit of the seconds after the first image
MAX_TURN = 3600.0  # limit of the angles of an entry, degrees
MIN_FOV = 1.0  # limits of the field of view of an entry, degrees
MAX_FOV = 170.0
# Rotation from a camera's axes in files (x to the right, y down, z ahead) to Mitsuba's
# (x to the left, y up, z ahead).
AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
# Rotation from nerfstudio's axes of a camera (x to the right, y up, z back) to x to the
# right, y down, z ahead.
FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# Lower limit of the scale of positions in a file; its inverse is the upper limit.
MIN_SCALE = 1e-6
COLMAP_IMAGES = "images.txt"
MAX_IMAGES_SIZE = 1 << 26  # limit of COLMAP's images; their lines of points are skipped
KALIBR_TRANSFORM = "T_cn_cnm1"  # transform from the previous camera to this one


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A camera of a rig, relative to the first camera of the rig."""

    name: str
    # (4, 4) from its axes (x to the right, y down, z ahead) to those of the first
    # camera; meters, or object sizes.
    pose: Float64Array
    # Azimuth around the object relative to the first camera, degrees
    # counter-clockwise from above.
    azimuth: float = 0.0
    # Field of view along the larger side, degrees; None for that of the first camera.
    fov: float | None = None
    # Intrinsics and distortion; None for those of the first camera.
    camera_model: CameraModel | None = None
    # Seconds after the first image, along the path of a control.
    delay: float = 0.0

    def make_inputs(
        self,
        inputs: Mapping[str, Tensor],
        first_pose: Tensor,
        center: Tensor,
        unit_metres: float,
    ) -> dict[str, Tensor]:
        """Return the scene inputs of this camera, given those of the first camera.

        The mount's pose is relative to the first camera's. The result is rotated about
        the vertical through the object's center by the mount's azimuth. If the mount
        has a field of view or a lens, it replaces that of the first camera.

        Args:
            inputs: scene inputs of the first camera.
            first_pose: (4, 4) pose of the first camera, used if the inputs have none.
            center: (3,) center of the object.
            unit_metres: length of a unit of the scene, in meters.
        """
        # The mount's axes are OpenCV's (x right, y down), the scene's are Mitsuba's (x
        # left, y up): `AXES` converts both sides.
        mount_pose = torch.from_numpy(AXES @ self.pose @ AXES).float()
        mount_pose[:3, 3] /= unit_metres
        first_to_world = inputs.get("camera.to_world", first_pose)
        # from the right: from the mount to the first camera, to the world, and around
        to_world = self._compute_orbit_rotation(center) @ first_to_world @ mount_pose
        camera_inputs = {**inputs, "camera.to_world": to_world}
        return {**camera_inputs, **self._make_lens_inputs()}

    def _make_lens_inputs(self) -> dict[str, Tensor]:
        """Return the scene inputs of the mount's own field of view and lens, if any."""
        lens_inputs = dict[str, Tensor]()
        if self.fov is not None:
            lens_inputs["camera.fov"] = torch.tensor([self.fov])
        if self.camera_model is not None:
            lens_inputs["camera.lens"] = torch.tensor(
                self.camera_model.intrinsics, dtype=torch.float32
            )
        return lens_inputs

    def _compute_orbit_rotation(self, center: Tensor) -> Tensor:
        """Return the rotation (4, 4) about the vertical through a center by the azimuth."""
        orbit_rotation = torch.eye(4)
        orbit_rotation[:3, :3] = torch.from_numpy(make_rotation(self.azimuth, 0.0, 0.0))
        # With the shift c - R c, the rotation leaves the center c where it is.
        orbit_rotation[:3, 3] = center - orbit_rotation[:3, :3] @ center
        return orbit_rotation


def read_rig(spec: str) -> tuple[RigCamera, ...]:
    """Read the cameras of a rig.

    Args:
        spec: the file. Frames of a transforms.json are named by index, and the first
            name is the rig's first camera: ``transforms.json#0,4,8``. All images of an
            images.txt are cameras, or only those named by IMAGE_ID:
            ``images.txt#3,7``.

    Returns:
        The cameras. The tuple is empty if this is no rig: if the file has one camera,
        or if one of its cameras is named (``#cam1``).

    Raises:
        FileFormatError: there are more than `MAX_CAMERAS`, numbers out of their range,
            or models of different kinds.
    """
    path, _, camera_names = spec.partition("#")
    if Path(path).name == COLMAP_IMAGES:
        return _read_colmap(path, camera_names)
    # The frames of a transforms.json are usually photographs of a single camera, and
    # only a rig if several are named.
    if Path(path).suffix.lower() == ".json" and "," in camera_names:
        return _read_transforms(path, camera_names)
    names_single_camera = "#" in spec
    has_rig_format = Path(path).suffix.lower() in (".yaml", ".yml")
    if names_single_camera or not has_rig_format:
        return ()
    return _read_yaml_rig(path)


def _read_yaml_rig(path: str) -> tuple[RigCamera, ...]:
    """Read a rig in our own format, or a camchain; empty if the file has no rig.

    Raises:
        FileFormatError: it is a rig that cannot be used.
    """
    try:
        data = parse_yaml(read_text(Path(path), "a camera file", MAX_YAML_BYTES))
    except (OSError, ValueError):
        # The file is then read as that of a single camera, which reports the error.
        return ()
    if not isinstance(data, dict):
        return ()
    if isinstance(data.get("cameras"), list):
        mounts = _read_entries(path, data)
    else:
        mounts = _read_camchain(path, data)
    if mounts:
        _check_mounts(path, mounts)
    return mounts


def _read_entries(path: str, data: Mapping[str, Any]) -> tuple[RigCamera, ...]:
    """Return the cameras of our own format, which has no other entries than `cameras`.

    Raises:
        FileFormatError: it has others, or one of its cameras cannot be used.
    """
    if set(data) != {"cameras"}:
        raise FileFormatError(
            f"{path}: expected `cameras` alone, got {', '.join(map(str, data))[:80]}"
        )
    return tuple(
        _read_entry(path, index, entry) for index, entry in enumerate(data["cameras"])
    )


@dataclass(frozen=True, eq=False)
class PhotographCameras:
    """The cameras of many photographs, which are in one file.

    Attributes:
        path: COLMAP's images.txt with the cameras.txt beside it, or a transforms.json.
        files: files of the photographs, by the names of their entries.
        read_entry: function of the name of an entry that returns its pose and model, as
            `find_pose_and_model` does.
    """

    path: str
    files: Mapping[str, str]
    read_entry: Callable[[str], tuple[Float64Array, CameraModel]]

    def find_pose_and_model(self, photograph: Path) -> tuple[Float64Array, CameraModel]:
        """Return pose and model of the camera that took a photograph, by its file name.

        If files in several folders have that name, the folders are compared, too.

        Returns:
            The pose (4, 4), from the camera's axes (x to the right, y down, z ahead) to
            the file's world; and the model.

        Raises:
            FileFormatError: an entry cannot be used, or none or several entries are for
                the photograph.
        """
        return self.read_entry(_find_photograph(self.path, self.files, photograph))


def read_photograph_cameras(path: str) -> PhotographCameras | None:
    """Read the cameras of many photographs from an images.txt or a transforms.json.

    Args:
        path: the file, without the name of one of its cameras.

    Returns:
        The cameras; None if the file is of another kind.

    Raises:
        FileFormatError: the file cannot be used.
    """
    if Path(path).name == COLMAP_IMAGES:
        return _read_image_cameras(path)
    if Path(path).suffix.lower() != ".json":
        return None
    try:
        data = parse_json(read_text(Path(path), "a camera file", MAX_JSON_SIZE))
    except (OSError, ValueError):
        # The file is then read as that of a single camera, which reports the error.
        return None
    if not isinstance(data, dict) or "frames" not in data:
        return None
    frames = _check_frames(path, data)["frames"]
    files = {str(i): str(frame.get("file_path", "")) for i, frame in enumerate(frames)}

    def read_frame(name: str) -> tuple[Float64Array, CameraModel]:
        return _read_frame_pose(path, data, name), make_camera(f"{path}#{name}", data)

    return PhotographCameras(path, files, read_frame)


def _read_image_cameras(path: str) -> PhotographCameras:
    """Read the cameras of the photographs in COLMAP's images.txt.

    The file has a line with the pose of each photograph; its lens is in the cameras.txt
    beside it, and is read when the photograph is requested.
    """
    words_by_id = _parse_images(path)
    files = {name: words[-1] for name, words in words_by_id.items()}
    read_model = cache(read_camera)  # many images have one camera

    def read_image(name: str) -> tuple[Float64Array, CameraModel]:
        words = words_by_id[name]
        pose = _parse_image(f"{path}: image {name[:40]}", words)
        return pose, read_model(_name_image_camera(path, words))

    return PhotographCameras(path, files, read_image)


def _find_photograph(path: str, files: Mapping[str, str], photograph: Path) -> str:
    """Return the name of the entry of a camera file that is for a photograph.

    The paths in a camera file are often those of another computer. So the result is the
    entry whose path has the most parts in common with the photograph's, from the end.

    Args:
        path: path of the camera file, for messages.
        files: path of the photograph of each entry, by the entry's name.
        photograph: path of the photograph.

    Raises:
        FileFormatError: no entry fits, or several do equally well.
    """
    # number of parts that each path has in common with the photograph's
    counts = {
        name: _count_shared_parts(file, photograph) for name, file in files.items()
    }
    largest = max(counts.values(), default=0)
    # If no path has a part in common, no entry is for this photograph.
    names = [name for name, count in counts.items() if count == largest and count > 0]
    if len(names) == 1:
        return names[0]
    examples = ", ".join(PurePosixPath(file).name[:40] for file in files.values())
    raise FileFormatError(
        f"{path}: expected one camera of the photograph {photograph.name[:80]}, got "
        f"{len(names) or 'none'}; its photographs are {examples[:120]}"
    )


def _count_shared_parts(file: str, photograph: Path) -> int:
    """Return how many parts two paths share, counted from the last one.

    For "images/a.jpg" and "/home/me/images/a.jpg" it is 2. If the first has no suffix,
    as in files of Instant NGP, the suffix of the other is ignored.
    """
    path = PurePosixPath(file.replace("\\", "/"))
    full = photograph.absolute()
    if not path.suffix:
        full = full.with_suffix("")
    count = 0
    for part, other in zip(reversed(path.parts), reversed(full.parts), strict=False):
        if part != other:
            break
        count += 1
    return count


def _check_mounts(spec: str, mounts: Sequence[RigCamera]) -> None:
    """Raise FileFormatError unless cameras of a rig fit together.

    There have to be 2 to `MAX_CAMERAS` with different names. The first is the scene's
    camera, to which the others are relative: it must have no pose, azimuth or delay.
    """
    if not 2 <= len(mounts) <= MAX_CAMERAS:
        raise FileFormatError(
            f"{spec}: expected 2 to {MAX_CAMERAS} cameras, got {len(mounts)}"
        )
    if len({mount.name for mount in mounts}) < len(mounts):
        raise FileFormatError(f"{spec}: expected a different name for each camera")
    first_mount = mounts[0]
    is_moved = not np.allclose(first_mount.pose, np.eye(4))
    if is_moved or first_mount.azimuth or first_mount.delay:
        # keys of an entry: `around` is the azimuth, and `later` the delay
        raise FileFormatError(
            f"{spec}: the first camera is that of the scene; it must have no place, "
            "turn, around or later"
        )


def _read_entry(spec: str, index: int, entry: Any) -> RigCamera:
    """Return the camera of an entry of our own format.

    Any of `ENTRY_KEYS` may be missing. A camera without a pose or a field of view has
    that of the first camera.

    Args:
        spec: the file, for messages.
        index: index of the camera from 0, for messages and a default name.
        entry: the entry, which has to be a dictionary.

    Raises:
        FileFormatError: the entry has other keys, or values out of their range.
    """
    where = f"{spec}: camera {index + 1}"
    if not isinstance(entry, dict) or not set(entry) <= set(ENTRY_KEYS):
        raise FileFormatError(
            f"{where}: expected entries among {', '.join(ENTRY_KEYS)}, got "
            f"{str(entry)[:80]!r}"
        )
    name = _check_camera_name(where, entry.get("name", f"camera {index + 1}"))
    pose = _read_entry_pose(where, entry)
    (orbit_angle,) = _parse_numbers(
        where, "around", [entry.get("around", 0.0)], 1, MAX_TURN
    )
    fov = _read_entry_fov(where, entry["fov"]) if "fov" in entry else None
    delay = _read_entry_delay(where, entry)
    return RigCamera(name=name, pose=pose, azimuth=orbit_angle, fov=fov, delay=delay)


def _check_camera_name(where: str, name: Any) -> str:
    """Return the name of an entry of our own format, which has to be a short text.

    Args:
        where: file and camera, for messages.
        name: the value of `name`, or a default.

    Raises:
        FileFormatError: it is empty, too long, or no text.
    """
    if not isinstance(name, str) or not 0 < len(name) <= 40:
        raise FileFormatError(
            f"{where}: name: expected a short text, got {str(name)[:80]!r}"
        )
    return name


def _read_entry_fov(where: str, value: Any) -> float:
    """Return the field of view of an entry of our own format, in degrees.

    Args:
        where: file and camera, for messages.
        value: the value of `fov`.

    Raises:
        FileFormatError: it is out of range.
    """
    (fov,) = _parse_numbers(where, "fov", [value], 1, MAX_FOV)
    if fov < MIN_FOV:
        raise FileFormatError(
            f"{where}: fov: expected {MIN_FOV:g} to {MAX_FOV:g} degrees, got {fov:g}"
        )
    return fov


def _read_entry_delay(where: str, entry: Mapping[str, Any]) -> float:
    """Return the delay of an entry of our own format, in seconds; 0 if it has none.

    Args:
        where: file and camera, for messages.
        entry: the entry.

    Raises:
        FileFormatError: it is out of range.
    """
    (delay,) = _parse_numbers(where, "later", [entry.get("later", 0.0)], 1, MAX_DELAY)
    if delay < 0.0:
        raise FileFormatError(
            f"{where}: later: expected 0 to {MAX_DELAY:g} seconds, got {delay:g}"
        )
    return delay


def _read_entry_pose(where: str, entry: Mapping[str, Any]) -> Float64Array:
    """Return the pose (4, 4) of an entry of our own format, by `turn` and `place`.

    It maps coordinates of the camera to those of the first one. In both x is to the
    right, y down, z ahead. `turn` has yaw, pitch and roll in degrees, and `place` the
    position in meters.

    Args:
        where: file and camera, for messages.
        entry: the entry; a missing `turn` or `place` is 0.
    """
    angles = entry.get("turn", [0.0] * 3)
    yaw, pitch, roll = _parse_numbers(where, "turn", angles, 3, MAX_TURN)
    # The arguments of `make_rotation` are angles about z, y and x. In the axes of a
    # camera, the yaw is about y, the pitch about x, and the roll about z.
    yaw_rotation = make_rotation(0.0, yaw, 0.0)
    pitch_rotation = make_rotation(0.0, 0.0, pitch)
    roll_rotation = make_rotation(roll, 0.0, 0.0)
    rotation = yaw_rotation @ pitch_rotation @ roll_rotation
    position = _parse_numbers(
        where, "place", entry.get("place", [0.0] * 3), 3, MAX_DISTANCE
    )
    return make_pose(rotation, position)


def _parse_numbers(
    where: str, key: str, value: Any, count: int, limit: float
) -> list[float]:
    """Return an entry as a list of `count` finite numbers within a limit.

    Args:
        where: file and camera, for messages.
        key: name of the entry, for messages.
        value: the entry.
        count: number of values that it must have.
        limit: largest absolute value of each number.

    Raises:
        FileFormatError: it is no such list.
    """
    has_right_length = isinstance(value, list) and len(value) == count
    if not has_right_length or not all(_is_within_limit(x, limit) for x in value):
        raise FileFormatError(
            f"{where}: {key}: expected {count} numbers up to {limit:g}, got "
            f"{str(value)[:80]!r}"
        )
    return list(map(float, value))


def _is_within_limit(value: Any, limit: float) -> bool:
    """Return whether a value is a finite number whose absolute value is within a limit.

    Booleans are no numbers.
    """
    is_finite = type(value) in (int, float) and math.isfinite(value)
    return is_finite and bool(abs(value) <= limit)


def _to_rows(value: Any) -> list[list[Any]]:
    """Return a list of lists as it is, and an empty list for any other value."""
    if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
        return []
    return value


def _read_camchain(spec: str, data: Mapping[str, Any]) -> tuple[RigCamera, ...]:
    """Return the cameras of Kalibr's camchain, the first one first.

    Cameras are in the order of their numbers (cam0, cam1). Each but the first states
    its transform from the camera before it.

    Args:
        spec: the file.
        data: its content.

    Returns:
        The cameras; empty if the file has one, too many, or no transforms.
    """
    cameras = {
        name: camera
        for name, camera in data.items()
        if isinstance(camera, dict) and "intrinsics" in camera
    }
    # shorter names first: cam9 comes before cam10
    names = sorted(cameras, key=lambda name: (len(str(name)), str(name)))
    has_extrinsics = all(KALIBR_TRANSFORM in cameras[name] for name in names[1:])
    if not 2 <= len(names) <= MAX_CAMERAS or not has_extrinsics:
        return ()
    poses = _chain_poses(spec, names, cameras)
    models = [read_camera(f"{spec}#{name}") for name in names]
    return _make_mounts(spec, names, poses, models)


def _chain_poses(
    spec: str, names: Sequence[str], cameras: Mapping[str, Mapping[str, Any]]
) -> list[Float64Array]:
    """Return the poses (4, 4) of a camchain's cameras relative to the first.

    Args:
        spec: the file, for messages.
        names: names of the cameras in their order.
        cameras: their entries by name. Each but the first has a transform, which leads
            from the previous camera's coordinates to the camera's.
    """
    poses: list[Float64Array] = [np.eye(4)]
    for name in names[1:]:
        from_previous = _parse_rigid(
            f"{spec}: {name}", KALIBR_TRANSFORM, cameras[name][KALIBR_TRANSFORM]
        )
        poses.append(poses[-1] @ np.linalg.inv(from_previous))
    return poses


def _read_transforms(path: str, frame_names: str) -> tuple[RigCamera, ...]:
    """Return frames of nerfstudio's transforms.json as cameras.

    `frame_names` are their indices, with commas.
    """
    data = _parse_transforms(path)
    frames = data["frames"]
    names = _parse_names(
        path, frame_names, [str(index) for index in range(len(frames))]
    )
    poses = [_read_frame_pose(path, data, name) for name in names]
    selected = [frames[int(name)] for name in names]
    return _make_mounts(path, names, poses, _read_frame_models(path, names, selected))


def _parse_transforms(path: str) -> dict[str, Any]:
    """Parse a transforms.json, whose `frames` are a list of mappings."""
    text = read_existing_text(path, "a camera file", MAX_JSON_SIZE)
    return _check_frames(path, parse_text(path, text, "JSON", parse_json))


def _check_frames(path: str, data: Any) -> dict[str, Any]:
    """Return a transforms.json as it is; raise FileFormatError unless it is one."""
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not all(
        isinstance(frame, dict) for frame in frames
    ):
        raise FileFormatError(
            f"{path}: expected `frames`, a list with a camera each, as nerfstudio "
            "writes it"
        )
    return dict(data)


def _read_frame_pose(path: str, data: Mapping[str, Any], name: str) -> Float64Array:
    """Return the pose (4, 4) of a frame, which maps from its camera to the world.

    The camera's axes are x to the right, y down, z ahead. The tool may have scaled the
    scene: positions are divided by the scale that the file states.

    Args:
        path: path of the transforms.json.
        data: content of the file.
        name: index of the frame, as a text.
    """
    frame = data["frames"][int(name)]
    matrix = _parse_rigid(
        f"{path}: frame {name}", "transform_matrix", frame.get("transform_matrix")
    )
    pose = matrix @ FROM_OPENGL
    pose[:3, 3] /= _read_applied_scale(path, data)
    return np.asarray(pose)


def _read_frame_models(
    path: str, names: Sequence[str], frames: Sequence[Mapping[str, Any]]
) -> list[CameraModel]:
    """Return the camera models of frames of a transforms.json.

    Args:
        path: the file.
        names: indices of the frames in the file, as texts.
        frames: entries of these frames.
    """
    lenses = [
        {key: frame[key] for key in frame if key in LENS_KEYS} for frame in frames
    ]
    first_model = read_camera(f"{path}#{names[0]}")
    models = []
    for name, lens in zip(names, lenses, strict=True):
        # Usually all frames have the same lens, whose model is read only once.
        has_first_lens = lens == lenses[0]
        models.append(first_model if has_first_lens else read_camera(f"{path}#{name}"))
    return models


def _read_applied_scale(path: str, data: Mapping[str, Any]) -> float:
    """Return the factor by which the positions in a transforms.json were multiplied.

    It is nerfstudio's `applied_scale`, times the scale within its `applied_transform`.
    The rotation and the shift of that transform are ignored: they move all cameras
    alike, and only poses relative to each other are used. Instant NGP's `scale` and
    `offset` are ignored, too: they were not applied to the positions in the file.

    Raises:
        FileFormatError: the transform is not composed of rotation, shift and scale, or
            the scale is out of range.
    """
    scale = 1.0
    if data.get("applied_scale") is not None:
        values = [data["applied_scale"]]
        (scale,) = _parse_numbers(path, "applied_scale", values, 1, 1.0 / MIN_SCALE)
    if data.get("applied_transform") is not None:
        scale *= _measure_scale(path, data["applied_transform"])
    if not MIN_SCALE <= scale <= 1.0 / MIN_SCALE:
        limits = f"from {MIN_SCALE:g} to {1.0 / MIN_SCALE:g}"
        raise FileFormatError(
            f"{path}: applied_scale: expected a scale {limits}, got {scale:g}; correct "
            "it"
        )
    return scale


def _read_colmap(path: str, image_ids: str) -> tuple[RigCamera, ...]:
    """Return the images of COLMAP's images.txt as cameras.

    Args:
        path: the file.
        image_ids: ids of the images, with commas; "" for all images.
    """
    # (image id: the ten words of its line)
    words_by_id = _parse_images(path)
    all_ids = list(words_by_id)
    selected_ids = _parse_names(
        path, image_ids or ",".join(all_ids), known_names=all_ids
    )
    poses = [
        _parse_image(f"{path}: image {image_id[:40]}", words_by_id[image_id])
        for image_id in selected_ids
    ]
    models = [
        _read_image_model(path, words_by_id[image_id]) for image_id in selected_ids
    ]
    return _make_mounts(path, selected_ids, poses, models)


def _read_image_model(path: str, words: Sequence[str]) -> CameraModel:
    """Return the model of an image of COLMAP, from the cameras.txt beside it.

    `words` are the ten words of the image's line. The ninth is the camera's id.
    """
    return read_camera(_name_image_camera(path, words))


def _name_image_camera(path: str, words: Sequence[str]) -> str:
    """Return the argument of `read_camera` for the camera of an image's line."""
    return f"{Path(path).with_name('cameras.txt')}#{words[8]}"


def _parse_images(path: str) -> dict[str, list[str]]:
    """Return the ten words of each image's line in COLMAP's images.txt, by image id.

    They are the id, a quaternion with the real part first, a shift, the id of the
    camera, and the file. Quaternion and shift map the world to the camera.
    """
    text = read_existing_text(path, "COLMAP's images", MAX_IMAGES_SIZE)
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    # Each image has two lines: its pose, and its points, which are not needed.
    image_lines = [line for line in lines[::2] if line.strip()]
    # the last of ten words is the file, whose name may have blanks
    words_of_images = [line.split(maxsplit=9) for line in image_lines]
    words_by_id = {words[0]: words for words in words_of_images}
    _check_different_images(path, len(words_by_id), len(image_lines))
    return words_by_id


def _check_different_images(path: str, n_different: int, n_images: int) -> None:
    """Check that COLMAP's images.txt has images, each with an id of its own.

    Args:
        path: the file, for messages.
        n_different: number of different ids.
        n_images: number of images.

    Raises:
        FileFormatError: it has none, or an id twice.
    """
    if n_different == 0:
        raise FileFormatError(
            f"{path}: expected 2 to {MAX_CAMERAS} different cameras, got none"
        )
    if n_different < n_images:
        raise FileFormatError(
            f"{path}: expected each image once, got one with the same number twice; "
            "correct the file"
        )


def _parse_image(where: str, words: Sequence[str]) -> Float64Array:
    """Return the pose (4, 4) of an image of COLMAP, which maps from camera to world.

    Args:
        where: file and image, for messages.
        words: IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID and NAME of its line.

    Raises FileFormatError: there are not ten words, or the quaternion does not have the
    length 1.
    """
    if len(words) != 10:
        raise FileFormatError(
            f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got "
            f"{len(words)} words; between two images there must be a line of points, "
            "which may be empty"
        )
    try:
        numbers = list(map(float, words[1:8]))
    except ValueError:
        numbers = []
    *quaternion, tx, ty, tz = _parse_numbers(where, "pose", numbers, 7, MAX_DISTANCE)
    rotation = _make_unit_rotation(where, quaternion)
    # inverted, since the file has the map from the world to the camera
    return np.asarray(np.linalg.inv(make_pose(rotation, [tx, ty, tz])), np.float64)


def _make_unit_rotation(where: str, quaternion: Sequence[float]) -> Float64Array:
    """Return the rotation (3, 3) of a quaternion w, x, y, z.

    Raises FileFormatError: it does not have the length 1. `where` names it.
    """
    w, x, y, z = quaternion
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.99 < length < 1.01:  # it is written with few digits
        raise FileFormatError(
            f"{where}: expected a quaternion of length 1, got one of {length:.3g}"
        )
    entries = compute_rotation_entries(x / length, y / length, z / length, w / length)
    return np.reshape(entries, (3, 3))


def _parse_names(path: str, listing_text: str, known_names: Sequence[str]) -> list[str]:
    """Split a list of cameras such as "cam0,cam2" into names.

    Args:
        path: the file, for messages.
        listing_text: the list.
        known_names: names of the file's cameras.

    Raises FileFormatError: they are not 2 to `MAX_CAMERAS` different names of the file.
    """
    names = list(map(str.strip, listing_text.split(",")))
    if not 2 <= len(names) <= MAX_CAMERAS or len(set(names)) < len(names):
        raise FileFormatError(
            f"{path}: expected 2 to {MAX_CAMERAS} different cameras, got {len(names)}"
        )
    unknown = [name for name in names if name not in known_names]
    if unknown:
        listing = _join_first_names(known_names)
        raise FileFormatError(
            f"{path}: expected some of its cameras {listing}, got {unknown[0][:40]!r}"
        )
    return names


def _join_first_names(names: Sequence[str]) -> str:
    """Return the first eight of some names with commas, and "..." if there are more."""
    more = ", ..." if len(names) > 8 else ""
    return ", ".join(names[:8]) + more


def _make_mounts(
    spec: str,
    names: Sequence[object],
    poses: Sequence[Float64Array],
    models: Sequence[CameraModel],
) -> tuple[RigCamera, ...]:
    """Return cameras with poses relative to the first.

    Args:
        spec: the file, for messages.
        names: names of the cameras.
        poses: (4, 4) for each from its coordinates (x to the right, y down, z ahead) to
            those of a common world.
        models: lens of each.

    Raises FileFormatError: the lenses are of different kinds.
    """
    kinds = sorted({model.kind for model in models})
    if len(kinds) > 1:
        raise FileFormatError(
            f"{spec}: expected cameras of one model, got {' and '.join(kinds)}"
        )
    to_first = np.linalg.inv(poses[0])
    return tuple(
        RigCamera(str(name), to_first @ pose, camera_model=model)
        for name, pose, model in zip(names, poses, models, strict=True)
    )


def _measure_scale(path: str, applied_transform: Any) -> float:
    """Return the scale of nerfstudio's `applied_transform`.

    Args:
        path: the file, for messages.
        applied_transform: 3 or 4 rows of 4 numbers, by which the tool has moved and
            scaled the scene.

    Raises FileFormatError: it is not a rotation times a scale, with a shift.
    """
    rows = _to_rows(applied_transform)
    cells = [cell for row in rows for cell in row]
    count = 12 if len(rows) == 3 else 16  # 3 or 4 rows of 4 numbers
    numbers = _parse_numbers(path, "applied_transform", cells, count, MAX_DISTANCE)
    linear = np.reshape(numbers, (-1, 4))[:3, :3]
    # For a rotation R, the matrix M = s R has the determinant s^3, and M M^T is s^2
    # times the identity.
    scale = float(abs(float(np.linalg.det(linear))) ** (1.0 / 3.0))
    if not np.allclose(linear @ linear.T, scale**2 * np.eye(3), atol=1e-3 * scale**2):
        raise FileFormatError(
            f"{path}: applied_transform: expected a rotation, a shift and a scale, "
            "got another map"
        )
    return scale


def _parse_rigid(where: str, key: str, value: Any) -> Float64Array:
    """Return an entry of four rows as a rigid transform (4, 4): rotation and shift.

    Raises FileFormatError: it is another map. `where` and `key` name it in the message.
    """
    cells = [cell for row in _to_rows(value) for cell in row]
    numbers = _parse_numbers(where, key, cells, 16, MAX_DISTANCE)
    matrix = np.array(numbers).reshape(4, 4)
    rotation = matrix[:3, :3]
    is_rotation = (
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
        and np.linalg.det(rotation) > 0.0
    )
    if not is_rotation or not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise FileFormatError(
            f"{where}: {key}: expected a rotation and a shift, got another map"
        )
    return matrix
