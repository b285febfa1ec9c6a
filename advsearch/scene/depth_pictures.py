"""Pictures of depth: how far what a photograph shows is from its camera.

Depth counts along the camera's axis, as depth cameras and BOP have it. 0, and what is
no finite number, is unknown.
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any, Literal

import numpy as np

from advsearch.errors import FileFormatError
from advsearch.pictures import MAX_PIXELS, check_decodable, check_pixels, open_image
from advsearch.scene.assets import Float32Array
from advsearch.scene.importing.hdr import read_exr
from advsearch.trust.stored_files import LARGEST_FILE, read_existing_bytes

EXR_SUFFIX = ".exr"
ARRAY_SUFFIX = ".npy"
# a file, and the length of one of its levels in metres
SCALED = re.compile(r"(?P<path>.+)#(?P<metres>\d+\.?\d*(e-?\d+)?|\.\d+)", re.IGNORECASE)
LEVEL_BITS = ("I;16", "I;16B", "I;16L", "I")  # modes of pictures of 16 bits
MAX_DEPTH = 1e5  # metres
EXPECTED = "a picture of depth"


def is_depth(spec: str | Path) -> bool:
    """Return whether an occluder is a picture of depth, by how it is asked for."""
    text = str(spec)
    suffix = Path(text).suffix.lower()
    return suffix in (EXR_SUFFIX, ARRAY_SUFFIX) or SCALED.fullmatch(text) is not None


def check_no_depth(mode: str, path: Path) -> None:
    """Raise FileFormatError if a mask has the mode of a depth picture, 16 bits.

    `mode` is Pillow's; those of 16 bits are the keys of `LEVEL_BITS`.
    """
    if mode in LEVEL_BITS:
        raise FileFormatError(
            f"{path}: expected a mask of 8 bits, got a picture of 16 bits; if it is "
            "one of depth, give the metres of a level behind its name, as in "
            f"{path}#0.001"
        )


def read_depth(spec: str | Path) -> Float32Array:
    """Read a picture of depth.

    Args:
        spec: an .exr or .npy file in metres; or a grey picture with the length of one
            of its levels in metres behind its name, ``depth.png#0.001``.

    Returns:
        (H, W) float32 metres along the camera's axis; infinite where not known.

    Raises:
        FileFormatError: the file is missing, too large, corrupt, has several different
            channels, or depths below 0 or over `MAX_DEPTH`.
    """
    scaled = SCALED.fullmatch(str(spec))
    path = Path(scaled["path"] if scaled else spec)
    metres = float(scaled["metres"]) if scaled else 1.0
    channels = _read_channels(path)
    _check_channels_agree(channels, path)
    depth = channels[..., 0].astype(np.float64) * metres
    # 0 is how cameras of depth write that they do not know it
    depth[~np.isfinite(depth) | (depth == 0.0)] = np.inf
    _check_depth_range(depth, path)
    return depth.astype(np.float32)


def _check_channels_agree(channels: np.ndarray, path: Path) -> None:
    """Raise FileFormatError if a picture (H, W, c) has several depths for a pixel.

    A grey picture may be stored as three equal channels.
    """
    # NaN differs from itself.
    differs_from_first = channels != channels[..., :1]
    if differs_from_first[np.isfinite(channels)].any():
        raise FileFormatError(
            f"{path}: expected one depth for each pixel, got channels that differ; "
            "save depth as grey"
        )


def _check_depth_range(depth: np.ndarray, path: Path) -> None:
    """Raise FileFormatError if known depths, metres, are below 0 or too large."""
    known = depth[np.isfinite(depth)]
    if known.size and not 0.0 < known.min() <= known.max() <= MAX_DEPTH:
        raise FileFormatError(
            f"{path}: expected depths of 0 to {MAX_DEPTH:g} metres, got "
            f"{known.min():g} to {known.max():g}; check the metres of a level"
        )


def _read_channels(path: Path) -> np.ndarray:
    """Return what a picture of depth has in its channels (H, W, c), as it is stored."""
    suffix = path.suffix.lower()
    if suffix == EXR_SUFFIX:
        planes, _ = read_exr(path, read_existing_bytes(path, EXPECTED, LARGEST_FILE))
        return np.stack(planes, axis=2)
    if suffix == ARRAY_SUFFIX:
        return _read_array(path)[..., None]
    with open_image(path, LARGEST_FILE) as image:
        check_decodable(image, path)
        levels = np.asarray(image)
    return levels if levels.ndim == 3 else levels[..., None]


def _read_array(path: Path) -> np.ndarray:
    """Return the numbers (H, W) of an .npy file.

    The header is read by itself, so that shape, type and length are checked before any
    memory is taken for the numbers, and pickled objects are never loaded.

    Raises FileFormatError: it is no array of two axes of numbers, is too large, or does
    not have the length that its header states.
    """
    data = read_existing_bytes(path, EXPECTED, LARGEST_FILE)
    stream = io.BytesIO(data)
    shape, is_by_columns, dtype = _read_array_header(path, stream)
    _check_array_form(path, shape, dtype)
    height, width = shape
    check_pixels(path, width, height, MAX_PIXELS)
    content = data[stream.tell() :]
    _check_array_length(path, content, (height, width), dtype)
    order: Literal["F", "C"] = "F" if is_by_columns else "C"
    numbers: np.ndarray = np.frombuffer(content, dtype)
    return numbers.reshape((height, width), order=order)


def _read_array_header(
    path: Path, stream: io.BytesIO
) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, order and type of an .npy file; the order is whether by columns.

    Raises FileFormatError: the header cannot be read.
    """
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        header: tuple[tuple[int, ...], bool, np.dtype[Any]] = read_header(stream)
    except (ValueError, KeyError, EOFError, SyntaxError, RecursionError) as error:
        raise FileFormatError(
            f"{path}: expected an array of NumPy, got a file that is corrupt or of "
            "another version; save it again"
        ) from error
    return header


def _check_array_form(path: Path, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Raise FileFormatError if an array is not (height, width) of numbers."""
    has_form = len(shape) == 2 and min(shape) > 0 and dtype.kind in "fiu"
    if not has_form:
        raise FileFormatError(
            f"{path}: expected an array (height, width) of numbers, got one of shape "
            f"{str(shape)[:40]} of {str(dtype)[:40]}"
        )


def _check_array_length(
    path: Path, content: bytes, size: tuple[int, int], dtype: np.dtype[Any]
) -> None:
    """Raise FileFormatError if a file has not as many numbers as its header states."""
    height, width = size
    if len(content) != height * width * dtype.itemsize:
        raise FileFormatError(
            f"{path}: expected {height} x {width} numbers, got a file of another "
            "length; save it again"
        )
