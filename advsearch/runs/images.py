"""Pictures of a run, (H, W, 3) or (H, W), of numpy or torch, as files: 8-bit PNG of sRGB values, rounded as
verification rounds them, so that the file is exactly what was classified; EXR in float32; an animation of the search.
"""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from advsearch.errors import FileFormatError
from advsearch.pictures import png_of
from advsearch.runs.files import replacing, write_bytes

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]

BAD_PICTURE = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)
"""What Pillow raises of a file that is no picture, a damaged one or one that is far too large."""

DIFFERENCE_GAIN = 5.0

ANIMATION_BYTES = 3_000_000

ANIMATION_FRAMES = 60  # most frames of an animation; of more, every second, third, ... is shown, and always the last
ANIMATION_SIDE = 320  # longest side of an animation in pixels; larger pictures are averaged down

_PALETTE_PIXELS = 200_000

FRAME_MS, LAST_FRAME_MS = 100, 2500


def to_8bit(image: Any) -> Bytes:
    """Return ``round(255 clip(image, 0, 1))`` in float32 with halves to even; NaN becomes 0."""
    scaled: Floats = np.clip(np.nan_to_num(_floats(image), nan=0.0), 0.0, 1.0) * np.float32(255.0)
    return np.rint(scaled).astype(np.uint8)


def difference(before: Any, after: Any, gain: float = DIFFERENCE_GAIN) -> Floats:
    """Return ``0.5 + gain (after - before)`` clipped to [0, 1]: mid grey where nothing changed."""
    moved: Floats = np.float32(0.5) + np.float32(gain) * (_floats(after) - _floats(before))
    return np.clip(moved, 0.0, 1.0)


def png_bytes(image: Any) -> bytes:
    """Return the display-referred picture as an 8-bit PNG; equal pictures give equal bytes."""
    return png_of(_picture(to_8bit(image)))


def smaller_png(data: bytes, side: int) -> bytes:
    """Return the picture of a PNG as a PNG whose longest side is at most `side` pixels."""
    buffer = io.BytesIO()
    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        image.thumbnail((side, side))
        image.save(buffer, "PNG")
    return buffer.getvalue()


def write_png(path: Path, image: Any) -> Path:
    """Write the display-referred picture as an 8-bit PNG, whole or not at all, and return the path."""
    return write_bytes(path, png_bytes(image))


def read_png(path: Path) -> Floats:
    """Return the display-referred picture, (H, W, 3) in [0, 1], in a PNG."""
    try:
        with Image.open(path, formats=("PNG",)) as image:
            values: Floats = np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255.0)
            return values
    except BAD_PICTURE as error:
        raise FileFormatError(f"{path}: expected a PNG picture, got {error}") from None


def write_exr(path: Path, image: Any) -> Path:
    """Write float32 values as an EXR (scan lines, ZIP), whole or not at all, and return the path."""
    values = np.ascontiguousarray(_picture(_floats(image)))
    return _write_exr(path, {"Y" if values.ndim == 2 else "RGB": values}, {})


def write_layers(path: Path, layers: Mapping[str, Any], notes: Mapping[str, str]) -> Path:
    """Write channels (H, W) by name, such as ``normal.X``, as one EXR, whole or not at all, and return the path:
    numbers in float32, whole numbers as 32 bits, and notes on what they mean as attributes of the file."""
    channels = {}
    for name, layer in layers.items():
        values = layer.numpy() if hasattr(layer, "numpy") else np.asarray(layer)
        whole = values.dtype.kind in "iu"
        channels[name] = np.ascontiguousarray(values.astype(np.uint32 if whole else np.float32))
    return _write_exr(path, channels, notes)


def _write_exr(path: Path, channels: Mapping[str, Any], notes: Mapping[str, str]) -> Path:
    # late: OpenEXR takes long to import
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **notes}
    with replacing(path) as part:
        try:
            with OpenEXR.File(header, dict(channels)) as file:
                file.write(os.fspath(part))
        except RuntimeError as error:
            number = errno.ENOSPC if "No space left" in str(error) else errno.EIO
            raise OSError(number, str(error)) from error
    return path


def animation_bytes(frames: Sequence[Any]) -> bytes:
    """Return the display-referred pictures as a GIF that repeats, holds its last frame and is at most 3 MB."""
    chosen, shrink = _spread(frames, ANIMATION_FRAMES), 1
    while True:
        pictures = [_shrunk(to_8bit(frame), shrink) for frame in chosen]
        data = _gif(pictures)
        if len(data) <= ANIMATION_BYTES or min(pictures[0].shape[:2]) < 16:
            return data
        if len(chosen) > 10:
            chosen = _spread(chosen, min(len(chosen) * 9 // 10, len(chosen) * ANIMATION_BYTES // len(data)))
        else:
            shrink *= 2


def _gif(pictures: Sequence[Bytes]) -> bytes:
    """Return a GIF with one palette for all frames, by Pillow itself: 20 times as fast as through imageio."""
    pixels = np.concatenate(pictures)
    stride = 1 + pixels.shape[0] * pixels.shape[1] // _PALETTE_PIXELS
    palette = Image.fromarray(np.ascontiguousarray(pixels[::stride])).quantize(256)
    frames = [Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures]
    several, buffer = len(frames) > 1, io.BytesIO()
    durations = [FRAME_MS] * (len(frames) - 1) + [LAST_FRAME_MS] if several else LAST_FRAME_MS
    frames[0].save(buffer, "GIF", loop=0, duration=durations, save_all=several, append_images=frames[1:])
    return buffer.getvalue()


def _spread(frames: Sequence[Any], count: int) -> list[Any]:
    """Return at most `count` frames at even distances, with the first and the last."""
    places = np.linspace(0, len(frames) - 1, min(count, len(frames)))
    return [frames[int(place)] for place in np.rint(places)]


def _shrunk(picture: Bytes, least: int) -> Bytes:
    """Return the picture with its longest side at most `ANIMATION_SIDE` / `least`, by averaging whole blocks."""
    block = max(least, -(-max(picture.shape[:2]) * least // ANIMATION_SIDE))
    height, width = (side // block * block for side in picture.shape[:2])
    if block == 1 or not height or not width:
        return picture
    blocks = picture[:height, :width].reshape(height // block, block, width // block, block, -1)
    means: Floats = blocks.mean(axis=(1, 3), dtype=np.float32)
    return np.rint(means).astype(np.uint8)


def _picture(array: Any) -> Any:
    """Return (H, W, 3) or (H, W); one channel loses its axis."""
    squeezed = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    if squeezed.ndim != 2 and not (squeezed.ndim == 3 and squeezed.shape[2] == 3):
        raise ValueError(f"expected a picture of shape (H, W, 3) or (H, W), got {tuple(array.shape)}")
    return squeezed


def _floats(image: Any) -> Floats:
    return np.asarray(image.detach().cpu() if hasattr(image, "detach") else image, dtype=np.float32)
