"""Read image files that other people may have made.

Only formats of images are read, and no file that takes too much time or memory.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageOps

from advsearch.errors import FileFormatError
from advsearch.trust import stored_files
from advsearch.trust.stored_files import make_size_error, scale_limit

FORMATS = ("PNG", "JPEG", "BMP", "GIF", "PPM", "DDS", "SGI", "TIFF", "WEBP", "TGA")
"""Formats of images that are read, by their names in Pillow, in the order in which they
are tried.

Pillow knows more formats, and runs other programs for some (EPS). Common formats come
first: for the sixth and later ones Pillow imports all its plugins, which takes 0.1 s.
"""

# Users may raise the limits below by an environment variable (`scale_limit`).
MAX_FILE_BYTES = 1 << 28  # maximum size of a file that `load_upright` reads
# Maximum number of pixels (8192 x 8192). A decoded pixel takes 4 bytes.
MAX_PIXELS = 1 << 26
# Maximum number of scans of a progressive JPEG. Each takes as long to decode as an
# image. Ten are usual.
MAX_SCANS = 64


@contextlib.contextmanager
def without_pillows_limit() -> Iterator[None]:
    """Let Pillow open images of any size inside the block.

    The caller rejects images that are too large by `check_pixels` before they are
    decoded.
    """
    pixel_limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = pixel_limit


def check_pixels(
    path: Path | str, width: int, height: int, limit: int = MAX_PIXELS
) -> None:
    """Check that an image does not have too many pixels, before it is decoded.

    Args:
        path: path of its file, for errors.
        width: width in pixels.
        height: height in pixels.
        limit: maximum number of pixels. Users may raise it by an environment variable
            (`scale_limit`).

    Raises:
        FileFormatError: it has more.
    """
    scaled_limit = scale_limit(limit)
    if width * height > scaled_limit:
        expected = f"a picture of at most {scaled_limit:,} pixels"
        raise make_size_error(path, expected, f"{width} x {height}")


def check_decodable(image: Image.Image, path: Path | str) -> None:
    """Check that an opened image can be decoded without too much time and memory.

    Raises:
        FileFormatError: it has too many pixels, its format is not one of `FORMATS`, or
            it is a JPEG with too many scans, each of which takes time to decode.
    """
    check_pixels(path, *image.size)
    # an MPO is a JPEG with a second picture
    if image.format not in (None, "MPO", *FORMATS):
        raise FileFormatError(
            f"{path}: expected a picture such as PNG or JPEG, got "
            f"{image.format}; convert it"
        )
    if image.format in ("JPEG", "MPO"):
        _check_scan_count(image, path)


def _check_scan_count(image: Image.Image, path: Path | str) -> None:
    """Check that a JPEG does not have too many scans.

    Raises:
        FileFormatError: it has.
    """
    n_scans = _count_scans(image)
    max_scans = scale_limit(MAX_SCANS)  # users may raise the limit
    if n_scans > max_scans:
        raise make_size_error(
            path, f"a JPEG of at most {max_scans} scans", f"{n_scans}"
        )


@contextlib.contextmanager
def open_image(path: Path, limit: int) -> Iterator[Image.Image]:
    """Open an image file of at most `limit` bytes for the block, which may decode it.

    Raises:
        FileFormatError: the file is missing, not an ordinary file, not an image, too
            large or corrupt. Errors of decoding inside the block are converted too.
    """
    try:
        data = stored_files.read_bytes(path, "a picture file such as PNG", limit)
        with warnings.catch_warnings(), without_pillows_limit():
            warnings.simplefilter("ignore")  # Pillow warns of unusual metadata
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                yield image
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        reason = getattr(error, "strerror", None) or "one that cannot be read"
        raise FileFormatError(
            f"{path}: expected a picture file such as PNG, got {reason}; check the path"
        ) from error


def encode_levels(levels: npt.NDArray[np.uint8]) -> bytes:
    """Return a picture of 8 bits, (H, W, 3 or 4), as a PNG."""
    file = io.BytesIO()
    Image.fromarray(levels).save(file, "PNG")
    return file.getvalue()


def load_upright(path: Path, side: int) -> npt.NDArray[np.float32]:
    """Read an image upright, and reduce it to a maximum size.

    It is rotated as the camera noted in the file. Transparency is ignored.

    Args:
        path: path of the image file.
        side: maximum of width and height in pixels; a larger image is made smaller.

    Returns:
        (H, W, 3) float32, display-referred in [0, 1], row 0 on top.

    Raises:
        FileFormatError: the file is missing, not an image, too large or corrupt.
    """
    with open_image(path, MAX_FILE_BYTES) as image:
        check_decodable(image, path)
        # rotated by the orientation that the camera has stored in the file
        rotated = ImageOps.exif_transpose(image)
        reduced = Image.fromarray(to_8bit_levels(rotated, alpha=False))
        if max(reduced.size) > side:
            # BOX averages the pixels
            reduced.thumbnail((side, side), Image.Resampling.BOX)
        levels = np.asarray(reduced, np.float32)
        values: npt.NDArray[np.float32] = levels / np.float32(255.0)
        return values


def to_8bit_levels(image: Image.Image, *, alpha: bool) -> npt.NDArray[np.uint8]:
    """Return the colors of a decoded image in 8 bits.

    Args:
        image: image of any mode; "F" is a gray image with white at 1.0, and modes that
            begin with "I" are gray with white at 65535.
        alpha: whether to return the alpha channel. An image without one is opaque.

    Returns:
        (H, W, 3) uint8, or (H, W, 4) with alpha.
    """
    levels = _convert_to_levels(image, alpha=alpha)
    has_alpha = levels.shape[2] == 4
    if alpha and not has_alpha:
        opaque = np.full_like(levels[:, :, :1], 255)
        levels = np.concatenate([levels, opaque], axis=2)
    return levels if alpha else levels[:, :, :3]


def _convert_to_levels(image: Image.Image, *, alpha: bool) -> npt.NDArray[np.uint8]:
    """Return an image in 8 bits, with three channels, or four if it has an alpha channel.

    Args:
        image: image of any mode, as `to_8bit_levels` takes it.
        alpha: whether an alpha channel is made for an image of another mode than gray.
    """
    if image.mode == "F":
        return _convert_gray(image, white=1.0)
    if image.mode.startswith("I"):
        return _convert_gray(image, white=65535.0)
    has_transparent_color = "transparency" in image.info
    mode = "RGBA" if alpha or has_transparent_color else "RGB"
    levels: npt.NDArray[np.uint8] = np.asarray(image.convert(mode))
    return levels


def _convert_gray(image: Image.Image, *, white: float) -> npt.NDArray[np.uint8]:
    """Return a gray image in 8 bits with three equal channels, (H, W, 3).

    Args:
        image: image with one channel.
        white: its level of white.
    """
    gray = np.nan_to_num(np.asarray(image, np.float32)) / np.float32(white)
    levels = np.round(np.clip(gray, 0.0, 1.0) * 255.0).astype(np.uint8)
    channels: npt.NDArray[np.uint8] = levels[:, :, None].repeat(3, axis=2)
    return channels


def _count_scans(image: Image.Image) -> int:
    """Count the scans in the file of a JPEG.

    A progressive JPEG has several, and each may take as long to decode as an image. The
    position in the file is restored.
    """
    file = getattr(image, "fp", None)
    if file is None:  # decoded already
        return 0
    position = file.tell()
    file.seek(0)
    # the marker with which each scan begins
    count = int(file.read().count(b"\xff\xda"))
    file.seek(position)
    return count
