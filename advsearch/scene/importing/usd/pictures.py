"""Picture files as textures of OpenUSD show them: in linear values, by the color space
that holds for them.
"""

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
EXR = b"\x76\x2f\x31\x01"  # how files begin
RADIANCE = b"#?"
PNG = b"\x89PNG"
LONGEST_SIDE = 1024  # texels of a picture that is computed anew
MODES_OF_8_BITS = ("1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "YCbCr")
GREY_MODES = ("1", "L", "LA")
GAMMA_OF_SRGB = 0.45455
CHANNELS_OF_PNG = {0: 1, 2: 3, 4: 2, 6: 4}  # by the color type


def is_of_8_bits(data: bytes) -> bool:
    """Whether a file is a picture with 8 bits a channel."""
    try:
        with Image.open(io.BytesIO(data), formats=reading.FORMATS) as image:
            return image.mode in MODES_OF_8_BITS and not _is_png_of_16_bits(data)
    except (OSError, ValueError, SyntaxError):
        return False


def has_colors_of_8_bits(data: bytes) -> bool:
    """Whether a file is a picture with 8 bits a channel, and three channels or four."""
    if not is_of_8_bits(data):
        return False
    with Image.open(io.BytesIO(data), formats=reading.FORMATS) as image:
        return image.mode not in GREY_MODES


def is_marked_srgb(data: bytes) -> bool:
    """Whether a picture is in sRGB for the sourceColorSpace auto: its file says so, or
    else it has colors of 8 bits.
    """
    try:
        with Image.open(io.BytesIO(data), formats=reading.FORMATS) as image:
            gamma = image.info.get("gamma")
            profile = image.info.get("icc_profile") or b""
            if "srgb" in image.info or b"sRGB" in profile[:4096]:
                return True
            if gamma is not None:
                return abs(float(gamma) - GAMMA_OF_SRGB) < 0.01
    except (OSError, ValueError, SyntaxError, TypeError):
        return False
    return has_colors_of_8_bits(data)


def decode_picture(data: bytes, path: str, *, is_srgb: bool) -> Array:
    """Return the linear values (H, W, 4) float32 of a picture file; large ones are
    averaged down.

    Raises OSError, ValueError, SyntaxError, EOFError, FileFormatError: it is no
    picture, damaged or too large.
    """
    if data.startswith((EXR, RADIANCE)):
        texels = _decode_radiance(data, path)
    else:
        with Image.open(io.BytesIO(data), formats=reading.FORMATS) as image:
            reading.check_decodable(image, path)
            if image.mode == "F" or image.mode.startswith("I"):
                grey = np.nan_to_num(np.asarray(image, np.float32))
                grey = grey if image.mode == "F" else grey / np.float32(65535.0)
                texels = np.stack([grey, grey, grey, np.ones_like(grey)], axis=2)
            elif _is_png_of_16_bits(data):
                texels = _decode_png_of_16_bits(data, image.size)
            else:
                texels = reading.pictures.display_image(
                    image,
                    LONGEST_SIDE if is_srgb else None,
                    path,
                    alpha=True,
                    raw=not is_srgb,
                )
    if is_srgb:
        texels = np.concatenate(
            [color.srgb_to_linear(texels[:, :, :3]), texels[:, :, 3:]], axis=2
        )
    height, width = texels.shape[:2]
    shrink = LONGEST_SIDE / max(height, width)
    if shrink >= 1.0:
        return np.asarray(texels, np.float32)
    return reading.pictures.area_average(
        texels.astype(np.float32),
        max(1, round(height * shrink)),
        max(1, round(width * shrink)),
    )


def _decode_radiance(data: bytes, path: str) -> Array:
    if data.startswith(EXR):
        planes, _ = reading.hdr.read_exr(Path(path), data)
        colors = np.stack([np.asarray(plane, np.float32) for plane in planes], axis=2)
    else:
        pixels, scale, _ = reading.hdr.read_radiance(Path(path), data)
        colors = reading.hdr.linear(pixels) * scale
    colors = np.nan_to_num(colors)
    return np.concatenate([colors, np.ones_like(colors[:, :, :1])], axis=2)


# ---- PNG with 16 bits a channel, of which Pillow keeps 8
# -------------------------------------------------------------


def _is_png_of_16_bits(data: bytes) -> bool:
    return data.startswith(PNG) and data[24:25] == b"\x10"


def _decode_png_of_16_bits(data: bytes, size: tuple[int, int]) -> Array:
    """Return the values (H, W, 4) in [0, 1] of a PNG file with 16 bits a channel.

    Raises ValueError: it is interlaced or damaged.
    """
    (width, height) = size
    color_type = data[25]
    is_interlaced = data[28]
    channels = CHANNELS_OF_PNG.get(color_type)
    if channels is None or is_interlaced:
        raise ValueError("an interlaced PNG of 16 bits; save it without interlacing")
    step = 2 * channels
    row_size = 1 + width * step
    content = bytearray()
    position = 8
    while position + 8 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        if data[position + 4 : position + 8] == b"IDAT":
            content += data[position + 8 : position + 8 + length]
        position += 12 + length
    try:
        raw = zlib.decompressobj().decompress(bytes(content), height * row_size)
    except zlib.error as error:
        raise ValueError(f"a damaged PNG ({error})") from None
    if len(raw) != height * row_size:
        raise ValueError("a PNG that is cut short")
    rows = np.frombuffer(raw, np.uint8).reshape(height, row_size)
    unfiltered = _unfilter(rows[:, 0], rows[:, 1:].reshape(height, width, step))
    values = np.ascontiguousarray(unfiltered).view(">u2").astype(
        np.float32
    ) / np.float32(65535.0)
    alpha = (
        values[:, :, channels - 1 :]
        if channels in (2, 4)
        else np.ones((height, width, 1), np.float32)
    )
    colors = values[:, :, :3] if channels >= 3 else values[:, :, :1].repeat(3, axis=2)
    return np.concatenate([colors, alpha], axis=2)


def _unfilter(filters: Array, filtered: Array) -> Array:
    """Undo the filters (H,) of rows of pixels (H, W, bytes): PNG specification, section
    9.

    A pixel depends on those to its left and above, so all on one diagonal are computed
    at once.
    """
    height, width, step = filtered.shape
    if filters.max(initial=0) > 4:
        raise ValueError("a PNG with an unknown filter")
    # with zeros above and to the left
    pixels = np.zeros((height + 1, width + 1, step), np.int16)
    for diagonal in range(height + width - 1):
        row = np.arange(max(0, diagonal - width + 1), min(height, diagonal + 1))
        column = diagonal - row
        left = pixels[row + 1, column]
        above = pixels[row, column + 1]
        corner = pixels[row, column]
        estimate = left + above - corner
        to_left, to_above, to_corner = (
            np.abs(estimate - near) for near in (left, above, corner)
        )
        is_left = (to_left <= to_above) & (to_left <= to_corner)
        paeth = np.where(is_left, left, np.where(to_above <= to_corner, above, corner))
        kind = filters[row][:, None]
        predicted = np.select(
            [kind == 1, kind == 2, kind == 3, kind == 4],
            [left, above, (left + above) // 2, paeth],
        )
        pixels[row + 1, column + 1] = (filtered[row, column] + predicted) & 255
    return pixels[1:, 1:].astype(np.uint8)
