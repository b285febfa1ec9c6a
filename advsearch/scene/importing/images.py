"""Pictures for the importers: 8- and 16-bit image files as arrays, and exact area averaging."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy import sparse

from advsearch import files
from advsearch.errors import FileFormatError
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.files import LARGEST_FILE

Floats = npt.NDArray[np.float32]

TEXTURE_LIMIT = 1024
"""Longest side of an imported texture, in texels; larger ones are averaged down."""

FORMATS = ("BMP", "DDS", "GIF", "JPEG", "PNG", "PPM", "SGI", "TGA", "TIFF", "WEBP")
"""Formats of pictures, as Pillow names them. Pillow knows more; for some (EPS) it runs other programs."""

LARGEST_PIXELS = 1 << 26
"""Pixels that a picture may have (8192 x 8192), before `advsearch.files.scaled`; decoded they take 4 bytes each."""

MOST_SCANS = 64
"""Scans of a progressive JPEG, each of which takes as long to decode as a picture of its own; usual are ten."""

ORIENTATION = 0x0112
"""The tag of EXIF that says how a picture is to be turned, and these are the ways: mirrored left to right first, then
turned by so many right angles against the clock."""
_TURNS = {2: (True, 0), 3: (False, 2), 4: (True, 2), 5: (True, 1), 6: (False, 3), 7: (True, 3), 8: (False, 1)}

_BAND = 1 << 22  # pixels of a large picture that are averaged at a time


@contextlib.contextmanager
def without_pillows_limit() -> Iterator[None]:
    """Let Pillow open, but not decode, pictures of any size: what is decoded is up to `check_pixels`."""
    kept, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = kept


def check_pixels(path: Path | str, width: int, height: int, limit: int = LARGEST_PIXELS) -> None:
    """Refuse a picture with too many pixels before it is decoded.

    Raises:
        FileFormatError: it has more than `limit`, before `advsearch.files.scaled`.
    """
    if width * height > files.scaled(limit):
        expected = f"a picture of at most {files.scaled(limit):,} pixels"
        raise files.too_large(path, expected, f"{width} x {height}")


def read_picture(path: Path, limit: int | None = TEXTURE_LIMIT, *, raw: bool = False, upright: bool = False) -> Floats:
    """Read a picture file; arguments and result as for `display_image`.

    With `upright` it is turned as its file (EXIF) says that the camera was held.

    Raises:
        FileFormatError: it is missing, no ordinary file, no picture, too large or damaged.
    """
    try:
        data = files.read_bytes(path, "a picture file such as PNG", LARGEST_FILE)
        with warnings.catch_warnings(), without_pillows_limit():
            warnings.simplefilter("ignore")  # of odd metadata
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                values = display_image(image, limit, path, raw=raw)
                return _turned(values, image.getexif().get(ORIENTATION, 1)) if upright else values
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        reason = getattr(error, "strerror", None) or "one that cannot be read"
        raise FileFormatError(f"{path}: expected a picture file such as PNG, got {reason}; check the path") from error


def display_image(
    image: Image.Image,
    limit: int | None = TEXTURE_LIMIT,
    path: Path | str = "picture",
    *,
    alpha: bool = False,
    raw: bool = False,
) -> Floats:
    """Decode a picture.

    Args:
        image: an opened picture of any mode.
        limit: longest side of the result; larger pictures are averaged down in linear light, and so that what is
            transparent does not count. None: no limit.
        path: where it is from, for messages.
        alpha: keep it as a fourth channel, 1 where the picture has none; otherwise it is dropped.
        raw: it holds numbers, as a normal map does, and no colours; larger ones are averaged down as they are.

    Returns:
        (H, W, 3 or 4) float32 display-referred values in [0, 1], row 0 on top.

    Raises:
        FileFormatError: too many pixels, or a format that is not one of `FORMATS`.
        OSError, ValueError, SyntaxError: the file's pixels are truncated or damaged.
    """
    width, height = image.size
    check_pixels(path, width, height)
    if image.format not in (None, "MPO", *FORMATS):  # an MPO is a JPEG with a second picture
        raise FileFormatError(f"{path}: expected a picture such as PNG or JPEG, got {image.format}; convert it")
    if image.format in ("JPEG", "MPO") and _scans(image) > files.scaled(MOST_SCANS):
        raise files.too_large(path, f"a JPEG of at most {files.scaled(MOST_SCANS)} scans", f"{_scans(image)}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large pictures and odd metadata
        image.load()
        scale = 1.0 if limit is None else limit / max(height, width)
        display: Floats = np.arange(256, dtype=np.float32) / np.float32(255.0)
        if scale >= 1.0:
            return np.asarray(display[_steps(image, alpha=alpha)])
        target = max(1, round(height * scale)), max(1, round(width * scale))
        linear = display if raw else srgb_to_linear(display)

        weighted = not raw and (alpha or image.has_transparency_data)

        def band(top: int, end: int) -> Floats:
            steps = _steps(image.crop((0, top, width, end)), alpha=weighted)
            colors, share = linear[steps[:, :, :3]], display[steps[:, :, 3:]]
            return np.concatenate([colors, share, colors * share] if weighted else [colors], axis=2)

        averaged = banded_average(band, (height, width), target)
        if raw:
            return averaged
        colors, share = averaged[:, :, :3], averaged[:, :, 3:4]
        if weighted:
            colors = np.where(share > 0.0, averaged[:, :, 4:] / np.maximum(share, 1e-9), colors)
        return np.concatenate([linear_to_srgb(colors), share] if alpha else [linear_to_srgb(colors)], axis=2)


def _turned(values: Floats, orientation: object) -> Floats:
    mirrored, turns = _TURNS.get(orientation, (False, 0)) if isinstance(orientation, int) else (False, 0)
    return np.ascontiguousarray(np.rot90(values[:, ::-1] if mirrored else values, turns))


def _scans(image: Image.Image) -> int:
    """Return how many scans of an opened JPEG are still to be decoded."""
    file = getattr(image, "fp", None)
    if file is None:
        return 0
    place = file.tell()
    file.seek(0)
    count = int(file.read().count(b"\xff\xda"))
    file.seek(place)
    return count


def _steps(image: Image.Image, *, alpha: bool) -> npt.NDArray[np.uint8]:
    """Return the (H, W, 3) colours of a decoded picture in 8 bits; with alpha, (H, W, 4)."""
    if image.mode == "F" or image.mode.startswith("I"):  # grey in floats or 16 bits
        grey = np.nan_to_num(np.asarray(image, np.float32)) / np.float32(1.0 if image.mode == "F" else 65535.0)
        steps: npt.NDArray[np.uint8] = np.round(np.clip(grey, 0.0, 1.0) * 255.0).astype(np.uint8)
        steps = steps[:, :, None].repeat(3, axis=2)
    else:
        steps = np.asarray(image.convert("RGBA" if alpha or "transparency" in image.info else "RGB"))
    if alpha and steps.shape[2] == 3:
        steps = np.concatenate([steps, np.full_like(steps[:, :, :1], 255)], axis=2)
    return steps if alpha else steps[:, :, :3]


def banded_average(band: Callable[[int, int], Floats], size: tuple[int, int], target: tuple[int, int]) -> Floats:
    """Average an image down that is too large to hold in floats; the same as `area_average` of the whole.

    Args:
        band: returns rows from the first to before the second of its arguments, (n, W, C) float32.
        size: rows and columns of the image.
        target: rows and columns of the result, at most those.

    Returns:
        (H, W, C) float32.
    """
    down, across = _overlaps(size[0], target[0]), _overlaps(size[1], target[1])
    count = max(1, _BAND * target[0] // (size[0] * size[1]))
    pieces = []
    for start in range(0, target[0], count):
        rows = down[start : start + count]
        top, end = int(rows.indices.min()), int(rows.indices.max()) + 1
        pieces.append(_averaged(band(top, end), rows[:, top:end], across))
    return np.concatenate(pieces)


def area_average(image: Floats, height: int, width: int) -> Floats:
    """Resample an image to a smaller size; each new pixel is the exact mean over the area that it covers.

    Args:
        image: (H, W, C) float32, any values.
        height: rows of the result, at most H.
        width: columns of the result, at most W.

    Returns:
        (height, width, C) float32 with the same mean as `image`.
    """
    return _averaged(image, _overlaps(image.shape[0], height), _overlaps(image.shape[1], width))


def _averaged(image: Floats, down: sparse.csr_array, across: sparse.csr_array) -> Floats:
    """Average rows, then columns, by matrices as `_overlaps` makes them."""
    rows, columns, channels = image.shape
    height, width = down.shape[0], across.shape[0]
    low = down @ image.reshape(rows, columns * channels)
    sideways = low.reshape(height, columns, channels).transpose(1, 0, 2).reshape(columns, height * channels)
    result = (across @ sideways).reshape(width, height, channels).transpose(1, 0, 2)
    return np.ascontiguousarray(result, dtype=np.float32)


def _overlaps(source: int, target: int) -> sparse.csr_array:
    """Return the (target, source) matrix of the share of each source cell in each target cell; rows sum to 1."""
    cells = np.arange(target + 1) * (source / target)
    edges = np.unique(np.concatenate([cells, np.arange(source + 1, dtype=np.float64)]))
    middles, lengths = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    row = np.minimum((middles * (target / source)).astype(np.int64), target - 1)
    column = np.minimum(middles.astype(np.int64), source - 1)
    weights = sparse.coo_array((lengths, (row, column)), shape=(target, source)).tocsr()
    share = sparse.diags_array(1.0 / np.asarray(weights.sum(axis=1)).ravel())
    return sparse.csr_array(share @ weights)
