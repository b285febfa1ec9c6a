"""Radiance pictures (.hdr): shared-exponent RGB, run-length encoded line by line.

Nothing that we depend on reads them, except Mitsuba, which must not be imported before its LLVM has been chosen. The
format is that of the Radiance reference manual, "File Formats" (Ward 1997); XYZE pictures are refused.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.pictures import check_pixels
from advsearch.scene.importing.files import damaged, looks_like, shown

Floats = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]

_RESOLUTION = re.compile(rb"([-+])([YX]) +(\d{1,6}) +([-+])([YX]) +(\d{1,6})\r?\n")
_NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def read_radiance(path: Path, data: bytes) -> tuple[Bytes, Floats, list[str]]:
    """Unpack a Radiance RGBE picture; `linear` makes floats of it, which take three times the memory.

    Args:
        path: the file, for messages.
        data: its content.

    Returns:
        (H, W, 4) uint8: three mantissas and an exponent; row 0 is the top, column 0 the left. (3,) float32 by which the
        linear values are multiplied: the inverse of all COLORCORR lines. And clauses about what is left out.

    Raises:
        FileFormatError: not a Radiance picture, one in XYZ colours, too large, or cut short.
    """
    found = re.search(rb"\r?\n\r?\n", data)
    if not data.startswith(b"#?") or not found:
        got = looks_like(data) if not data.startswith(b"#?") else "half a header"
        raise damaged(path, "a Radiance .hdr picture", got)
    head, rest = data[: found.start()], data[found.end() :]
    coding = re.search(rb"^FORMAT=\s*(\S+)", head, re.MULTILINE)
    if coding and coding[1] != b"32-bit_rle_rgbe":
        got = shown(coding[1].decode("latin-1"), quoted=False)
        raise FileFormatError(f"{path}: expected FORMAT=32-bit_rle_rgbe, got {got}; convert it to RGB")
    size = _RESOLUTION.match(rest)
    if not size or not int(size[3]) or not int(size[6]) or size[2] == size[5]:
        line = rest[:30].split(b"\n")[0].decode("latin-1")
        raise FileFormatError(f"{path}: expected a size like '-Y 512 +X 1024', got {line!r}; save the picture again")
    lines, length = int(size[3]), int(size[6])
    check_pixels(path, length, lines)
    pixels = _scanlines(path, rest[size.end() :], lines, length)
    pixels = pixels[:: 1 if _forward(size[1], size[2]) else -1, :: 1 if _forward(size[4], size[5]) else -1]
    scale, notes = _scale(head)
    return pixels if size[2] == b"Y" else pixels.transpose(1, 0, 2), scale, notes


def _forward(sign: bytes, axis: bytes) -> bool:
    """Whether what runs along an axis comes in our order: from the top, and from the left."""
    return sign == (b"-" if axis == b"Y" else b"+")


def _scale(head: bytes) -> tuple[Floats, list[str]]:
    """Return the factors (3,) that undo what a header says the colours were multiplied by, and clauses.

    EXPOSURE lines are not undone, as nowhere else: the exposure of pictures is metered.
    """
    scale, notes = np.ones(3), list[str]()
    for text in re.findall(rb"^COLORCORR=(.*)$", head, re.MULTILINE)[:100]:
        numbers = np.array([float(one) for one in re.findall(_NUMBER, text)[:4]])
        undone = scale / numbers if len(numbers) == 3 and (numbers > 0.0).all() else np.full(3, np.nan)
        if ((undone > 1e-20) & (undone < 1e20)).all():
            scale = undone
        else:
            notes.append(f"its line {shown('COLORCORR=' + text.decode('latin-1'))} is left out")
    return scale.astype(np.float32), notes


def linear(pixels: Bytes) -> Floats:
    """Return the linear values (H, W, 3) float32, at least 0, of pixels (H, W, 4).

    A value is mantissa x 2^(exponent - 136), as in Mitsuba.
    """
    scale = np.ldexp(np.float32(1.0), pixels[:, :, 3].astype(np.int32) - 136)
    scale = np.where(pixels[:, :, 3] == 0, np.float32(0.0), scale)
    return np.ascontiguousarray(pixels[:, :, :3].astype(np.float32) * scale[:, :, None], dtype=np.float32)


def _scanlines(path: Path, body: bytes, height: int, width: int) -> Bytes:
    """Decode the scanlines, each in whichever of the three encodings it uses, to (height, width, 4) bytes."""
    result = np.empty((height, width, 4), np.uint8)
    position, mark = 0, bytes([2, 2, width >> 8 & 0xFF, width & 0xFF])
    for row in range(height):
        try:
            if 8 <= width < 32768 and body[position : position + 4] == mark:
                position = _run_lengths(body, position + 4, result[row])
            else:
                position = _plain_line(body, position, result[row])
        except (IndexError, ValueError):
            got = f"{row} whole ones and the start of another"
            raise damaged(
                path, f"{height} scanlines of {width} pixels", f"{got}; the file is cut short or damaged"
            ) from None
    return result


def _run_lengths(body: bytes, position: int, line: Bytes) -> int:
    """Fill a line (W, 4) from its four run-length encoded channels; return the position after them."""
    width = len(line)
    for channel in range(4):
        pieces, filled = [], 0
        while filled < width:
            count = body[position]
            if count > 128:
                count -= 128
                pieces.append(body[position + 1 : position + 2] * count)
                position += 2
            else:
                pieces.append(body[position + 1 : position + 1 + count])
                position += 1 + count
            filled += count
            if count == 0:
                raise ValueError("a run of length zero")
        line[:, channel] = np.frombuffer(b"".join(pieces), np.uint8)
    return position


def _plain_line(body: bytes, position: int, line: Bytes) -> int:
    """Fill a line (W, 4) from pixels of four bytes, where (1, 1, 1, n) repeats the last; return the next position."""
    width = len(line)
    raw = np.frombuffer(body, np.uint8, count=min(4 * width, len(body) - position), offset=position)
    if len(raw) == 4 * width and not (raw.reshape(width, 4)[:, :3] == 1).all(axis=1).any():
        line[:] = raw.reshape(width, 4)
        return position + 4 * width
    filled, shift = 0, 0
    while filled < width:
        pixel = body[position : position + 4]
        position += 4
        if pixel[:3] == b"\x01\x01\x01":
            count = pixel[3] << shift
            if filled == 0 or filled + count > width:
                raise ValueError("a repeat that does not fit")
            line[filled : filled + count] = line[filled - 1]
            filled, shift = filled + count, shift + 8
        else:
            line[filled] = np.frombuffer(pixel, np.uint8)
            filled, shift = filled + 1, 0
    return position
