"""Decoder of image files to linear values, for textures of OpenUSD."""

from __future__ import annotations

import io
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from advsearch.extend import color, reading

Array = npt.NDArray[Any]
# First bytes of image files.
EXR = b"\x76\x2f\x31\x01"
RADIANCE = b"#?"
PNG = b"\x89PNG"
MAX_SIDE = 1024  # largest width and height of a decoded image, texels
MODES_OF_8_BITS = ("1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "YCbCr")
GREY_MODES = ("1", "L", "LA")
GAMMA_OF_SRGB = 0.45455
CHANNELS_OF_PNG = {0: 1, 2: 3, 4: 2, 6: 4}  # number of channels by color type


def is_of_8_bits(data: bytes) -> bool:
    """Return whether a file is an image with 8 bits a channel."""
    try:
        with Image.open(io.BytesIO(data), formats=reading.FORMATS) as image:
            return image.mode in MODES_OF_8_BITS and not _is_png_of_16_bits(data)
    except (OSError, ValueError, SyntaxError):
        return False


def has_colors_of_8_bits(data: bytes) -> bool:
    """Return whether a file is an image with 8 bits a channel that is not grey."""
    if not is_of_8_bits(data):
        return False
    with Image.open(io.BytesIO(data), formats=reading.FORMATS) as image:
        return image.mode not in GREY_MODES


def is_marked_srgb(data: bytes) -> bool:
    """Return whether an image is sRGB for the sourceColorSpace auto.

    It is if its file states so. If the file states nothing, it is if the image has
    colors of 8 bits.
    """
    try:
        with Image.open(io.BytesIO(data), formats=reading.FORMATS) as image:
            gamma = image.info.get("gamma")
            icc_profile = image.info.get("icc_profile") or b""
            if "srgb" in image.info or b"sRGB" in icc_profile[:4096]:
                return True
            if gamma is not None:
                return abs(float(gamma) - GAMMA_OF_SRGB) < 0.01
    except (OSError, ValueError, SyntaxError, TypeError):
        return False
    return has_colors_of_8_bits(data)


def decode_image(data: bytes, path: str, *, is_srgb: bool) -> Array:
    """Return the linear values (H, W, 4) float32 of an image file.

    Large images are averaged down.

    Args:
        data: the file.
        path: its path, for messages.
        is_srgb: whether its values are sRGB, and not linear. This holds for all
            formats, also for .exr, which is usually linear.

    Raises:
        OSError, ValueError, SyntaxError, EOFError, FileFormatError: it is no image,
            corrupt or too large.
    """
    if data.startswith((EXR, RADIANCE)):
        texels = _decode_radiance(data, path)
    else:
        texels = _decode_image(data, path, is_srgb)
    if is_srgb:
        linear = color.srgb_to_linear(texels[:, :, :3])
        texels = np.concatenate([linear, texels[:, :, 3:]], axis=2)
    return _limit_size(texels)


def _limit_size(texels: Array) -> Array:
    """Return texels (H, W, C) as float32, averaged down to `MAX_SIDE` if larger."""
    height, width = texels.shape[:2]
    scale = MAX_SIDE / max(height, width)
    if scale >= 1.0:
        return np.asarray(texels, np.float32)
    return reading.pictures.average_area(
        texels.astype(np.float32),
        max(1, round(height * scale)),
        max(1, round(width * scale)),
    )


def _decode_image(data: bytes, path: str, is_srgb: bool) -> Array:
    """Return the stored values (H, W, 4) in [0, 1] of an image file.

    Grey integers of more than 8 bits are divided by 65535. Grey floats stay as they
    are.

    Args:
        data: bytes of the file.
        path: its path, for messages.
        is_srgb: whether its values are sRGB colors, and not numbers.
    """
    with Image.open(io.BytesIO(data), formats=reading.FORMATS) as image:
        reading.check_decodable(image, path)
        # Pillow opens an image of 16-bit grey as "I;16" or "I", and of floats as "F".
        if image.mode == "F" or image.mode.startswith("I"):
            return _decode_grey(image)
        if _is_png_of_16_bits(data):
            return _decode_png_of_16_bits(data, image.size)
        # Colors are averaged down here, since this needs less memory. `decode_image`
        # averages numbers down in float.
        limit = MAX_SIDE if is_srgb else None
        return reading.pictures.load_display_image(
            image, limit, path, keep_alpha=True, is_raw=not is_srgb
        )


def _decode_grey(image: Image.Image) -> Array:
    """Return the values (H, W, 4) of an image of grey floats, or of 16-bit integers."""
    grey = np.nan_to_num(np.asarray(image, np.float32))
    if image.mode.startswith("I"):
        grey = grey / np.float32(65535.0)
    return np.stack([grey, grey, grey, np.ones_like(grey)], axis=2)


def _decode_radiance(data: bytes, path: str) -> Array:
    """Return the linear values (H, W, 4) of an OpenEXR or Radiance file, opaque."""
    if data.startswith(EXR):
        planes, _ = reading.hdr.read_exr(Path(path), data)
        colors = np.stack([np.asarray(plane, np.float32) for plane in planes], axis=2)
    else:
        pixels, scale, _ = reading.hdr.read_radiance(Path(path), data)
        colors = reading.hdr.decode_rgbe(pixels) * scale
    colors = np.nan_to_num(colors)
    return np.concatenate([colors, np.ones_like(colors[:, :, :1])], axis=2)


# ---- PNG with 16 bits a channel, which Pillow reduces to 8 bits ----


def _is_png_of_16_bits(data: bytes) -> bool:
    """Return whether a file is PNG, and its header states 16 bits a channel."""
    return data.startswith(PNG) and data[24:25] == b"\x10"


def _decode_png_of_16_bits(data: bytes, size: tuple[int, int]) -> Array:
    """Return the values (H, W, 4) in [0, 1] of a PNG file with 16 bits a channel.

    All rows are compressed together. A row is one byte, its filter, and then its
    pixels.

    Args:
        data: bytes of the file.
        size: width and height in pixels.

    Raises:
        ValueError: it is interlaced or corrupt.
    """
    (width, height) = size
    # two bytes of the first chunk, IHDR (PNG specification, section 11.2.2)
    color_type = data[25]
    is_interlaced = data[28]
    channels = CHANNELS_OF_PNG.get(color_type)
    if channels is None or is_interlaced:
        raise ValueError("an interlaced PNG of 16 bits; save it without interlacing")
    pixel_size = 2 * channels
    row_size = 1 + width * pixel_size
    row_bytes = _decompress(_join_png_data(data), height * row_size)
    rows = np.frombuffer(row_bytes, np.uint8).reshape(height, row_size)
    filtered = rows[:, 1:].reshape(height, width, pixel_size)
    unfiltered = np.ascontiguousarray(_unfilter(rows[:, 0], filtered))
    values = unfiltered.view(">u2").astype(np.float32) / np.float32(65535.0)
    return _expand_to_rgba(values)


def _decompress(compressed: bytes, size: int) -> bytes:
    """Return the first `size` bytes of the data of a PNG file.

    Raises:
        ValueError: it is corrupt, or has fewer bytes.
    """
    try:
        content = zlib.decompressobj().decompress(compressed, size)
    except zlib.error as error:
        raise ValueError(f"a damaged PNG ({error})") from None
    if len(content) != size:
        raise ValueError("a PNG that is cut short")
    return content


def _expand_to_rgba(values: Array) -> Array:
    """Return values (H, W, 4) of an image with grey or color, and perhaps alpha."""
    (height, width, channels) = values.shape
    alpha = np.ones((height, width, 1), np.float32)
    if channels in (2, 4):
        alpha = values[:, :, channels - 1 :]
    if channels >= 3:
        colors = values[:, :, :3]
    else:
        colors = values[:, :, :1].repeat(3, axis=2)
    return np.concatenate([colors, alpha], axis=2)


def _join_png_data(data: bytes) -> bytes:
    """Return the concatenated IDAT chunks of a PNG file.

    After 8 bytes, a file is chunks: 4 bytes of length, 4 of type, the data, and 4 of
    checksum.
    """
    content = bytearray()
    position = 8
    while position + 8 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        if data[position + 4 : position + 8] == b"IDAT":
            content += data[position + 8 : position + 8 + length]
        position += 12 + length
    return bytes(content)


def _unfilter(filters: Array, filtered: Array) -> Array:
    """Undo the filters of a PNG image (PNG specification, section 9).

    A stored byte is the true one minus a prediction, modulo 256. The prediction is
    computed from the same byte of the pixels to the left, above, and above to the left,
    which have to be known first. So pixels are computed diagonal by diagonal: those on
    the same diagonal do not depend on each other.

    Args:
        filters: (H,) the filter of each row: 0 none, 1 left, 2 above, 3 their mean, 4
            Paeth.
        filtered: (H, W, bytes) pixels.

    Returns:
        (H, W, bytes) uint8.

    Raises:
        ValueError: a filter is unknown.
    """
    height, width, pixel_size = filtered.shape
    if filters.max(initial=0) > 4:
        raise ValueError("a PNG with an unknown filter")
    # The image with a row of zeros above and a column of zeros to the left, which are
    # what its first pixels are predicted from. 16 bits hold the sum of two bytes.
    padded = np.zeros((height + 1, width + 1, pixel_size), np.int16)
    for diagonal in range(height + width - 1):
        # (N,) padded row and column of the pixels on the diagonal of the image
        first_row = max(0, diagonal - width + 1)
        padded_row = np.arange(first_row, min(height, diagonal + 1)) + 1
        padded_column = diagonal + 2 - padded_row
        left = padded[padded_row, padded_column - 1]
        above = padded[padded_row - 1, padded_column]
        above_left = padded[padded_row - 1, padded_column - 1]
        row_filter = filters[padded_row - 1][:, None]
        predicted = _predict(row_filter, left, above, above_left)
        stored = filtered[padded_row - 1, padded_column - 1]
        padded[padded_row, padded_column] = (stored + predicted) & 255  # modulo 256
    return padded[1:, 1:].astype(np.uint8)


def _predict(row_filter: Array, left: Array, above: Array, above_left: Array) -> Array:
    """Return what the filters (N, 1) of pixels predict from their neighbors (N, bytes).

    A filter of 0 predicts 0.
    """
    return np.select(
        [row_filter == 1, row_filter == 2, row_filter == 3, row_filter == 4],
        [left, above, (left + above) // 2, _paeth(left, above, above_left)],
    )


def _paeth(left: Array, above: Array, corner: Array) -> Array:
    """Return the Paeth predictor: the neighbor closest to left + above - corner.

    If several are equally close, the left one is preferred, then the one above.
    """
    estimate = left + above - corner
    to_left = np.abs(estimate - left)
    to_above = np.abs(estimate - above)
    to_corner = np.abs(estimate - corner)
    is_left = (to_left <= to_above) & (to_left <= to_corner)
    return np.where(is_left, left, np.where(to_above <= to_corner, above, corner))
