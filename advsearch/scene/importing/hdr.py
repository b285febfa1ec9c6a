"""Pictures of radiance in linear RGB: OpenEXR (which part, layer, window, channels) and
Radiance (.hdr).

The format of the first is that of the OpenEXR project, "Technical Introduction to
OpenEXR" and "OpenEXR File Layout". The second has shared-exponent RGB, run-length
encoded line by line, as in the Radiance reference manual, "File Formats" (Ward 1997);
XYZE pictures are refused. Nothing that we depend on reads it, except Mitsuba, which
must not be imported before its LLVM has been chosen.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenEXR

from advsearch.errors import AdvsearchError, FileFormatError
from advsearch.pictures import LARGEST_PIXELS, check_pixels
from advsearch.scene.assets import Floats
from advsearch.scene.importing.files import damaged, looks_like, shown
from advsearch.trust.stored_files import check_most

Plane = npt.NDArray[np.floating]
Planes = tuple[Plane, Plane, Plane]
# pixels times channels of a file (8192 x 4096 with 4), before `scaled`
LARGEST = 2 * LARGEST_PIXELS
COLORS = {
    "r": "R",
    "red": "R",
    "g": "G",
    "green": "G",
    "b": "B",
    "blue": "B",
    "y": "Y",
    "ry": "RY",
    "by": "BY",
}
"""Names of channels, in any case, and what they hold."""
WHOLE = ("", "rgba", "rgb", "beauty", "combined", "color", "colour", "main", "image")
"""Names of layers that are the picture itself, the likeliest first; others are taken
where there is none of these.
"""
# of red, green and blue: ITU-R BT.709, which a file has that names no others
LUMINANCE = (0.2126, 0.7152, 0.0722)
PRIMARIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.329)
CUBE = 1


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Swallow what OpenEXR prints about damaged files: on Python's standard output and
    on the process's stream 2.
    """
    with contextlib.ExitStack() as undo:
        undo.enter_context(contextlib.redirect_stdout(io.StringIO()))
        with contextlib.suppress(OSError):  # no error stream at all
            kept = os.dup(2)
            undo.callback(os.close, kept)
            undo.callback(os.dup2, kept, 2)
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), 2)
        yield


def read_exr(file: Path, data: bytes) -> tuple[Planes, list[str]]:
    """Read the picture of an OpenEXR file: red, green and blue, each (H, W) in half or
    float, of its display window, which is black where the file has no data; and clauses
    about what is left out.

    Of several parts and layers the one that is called as the picture itself, or else
    the first with colours, is taken. Raises FileFormatError: it is damaged, too large,
    deep, a cube map, or has no colours.
    """
    if not data.startswith(b"\x76\x2f\x31\x01"):
        raise damaged(file, "an OpenEXR picture", looks_like(data))
    try:
        with _quiet():
            with OpenEXR.File(
                io.BytesIO(data), separate_channels=True, header_only=True
            ) as picture:
                _check_size(file, picture)
            with OpenEXR.File(io.BytesIO(data), separate_channels=True) as picture:
                parts = [
                    (dict(part.header), dict(part.channels)) for part in picture.parts
                ]
                if not parts or any(
                    len(channels) != len(header["channels"])
                    for header, channels in parts
                ):
                    raise ValueError("pixels that end early")
                header, channels, notes = _chosen(file, parts)
                planes = {key: channel.pixels for key, channel in channels.items()}
    except (AdvsearchError, MemoryError):
        raise
    except Exception as error:
        message = (
            f"{file}: cannot be read as OpenEXR; it is damaged or cut short, "
            "export it again"
        )
        raise FileFormatError(message) from error
    if (
        header.get("envmap") is not None
        and getattr(header["envmap"], "value", header["envmap"]) == CUBE
    ):
        raise FileFormatError(
            f"{file}: expected a map of latitude and longitude, got "
            "a cube map; convert it"
        )
    size = _window(header, "dataWindow")[1]
    sized = all(
        plane.shape == size for key, plane in planes.items() if key not in ("RY", "BY")
    )
    if not sized or any(
        plane.dtype.kind != "f" or plane.ndim != 2 for plane in planes.values()
    ):
        got = ", ".join(
            f"{name} {plane.dtype} {plane.shape}" for name, plane in planes.items()
        )
        raise FileFormatError(
            f"{file}: expected channels of equal size in half or "
            f"float, got {got}; save it again"
        )
    whole = planes if "R" in planes else _colored(planes, size)
    primaries = header.get("chromaticities")
    if primaries is not None and not np.allclose(
        np.asarray(primaries, np.float64).ravel(), PRIMARIES, atol=2e-3
    ):
        notes.append(
            "its colours have primaries of their own and are taken for those of sRGB"
        )
    return _displayed(header, (whole["R"], whole["G"], whole["B"]), notes), notes


def _check_size(file: Path, picture: Any) -> None:
    values = 0
    for part in picture.parts:
        header = part.header
        if "deep" in str(header.get("type", "")):
            raise FileFormatError(
                f"{file}: expected one value a pixel, got a deep "
                "OpenEXR picture; flatten it"
            )
        (height, width), (tall, wide) = (
            _window(header, name)[1] for name in ("dataWindow", "displayWindow")
        )
        values += max(width, 0) * max(height, 0) * len(header["channels"])
        check_pixels(file, max(wide, 0), max(tall, 0))
    check_most(
        file, values, LARGEST, "OpenEXR pictures of at most {} pixels times channels"
    )


def _window(
    header: Mapping[str, Any], name: str
) -> tuple[tuple[int, int], tuple[int, int]]:
    low, high = (np.asarray(corner, dtype=np.int64) for corner in header[name])
    width, height = map(int, high - low + 1)
    # its first row and column, and its size
    return (int(low[1]), int(low[0])), (height, width)


def _chosen(
    file: Path, parts: list[tuple[dict[str, Any], dict[str, Any]]]
) -> tuple[dict[str, Any], dict[str, Any], list[str]]:
    layers: list[tuple[str, dict[str, Any], dict[str, Any]]] = []
    for header, channels in parts:
        by_layer: dict[str, dict[str, Any]] = {}
        for name, channel in channels.items():
            layer, _, last = name.rpartition(".")
            by_layer.setdefault(layer, {}).setdefault(
                COLORS.get(last.lower(), last), channel
            )
        called = str(header.get("name", "")) if len(parts) > 1 else ""
        for layer, held in by_layer.items():
            grey = (
                "Y" in held
                and ("RY" in held) == ("BY" in held)
                and not {"R", "G", "B", "X", "Z"} & set(held)
            )
            if grey or {"R", "G", "B"} <= set(held):
                layers.append((layer or called, header, held))
    if not layers:
        got = ", ".join(
            shown(name, quoted=False)
            for name in sorted({name for _, held in parts for name in held})
        )
        wanted = "expected the channels R, G and B (or Y alone)"
        raise FileFormatError(
            f"{file}: {wanted}, got {got}; save the picture as plain RGB"
        )

    def rank(
        layer: tuple[str, Mapping[str, Any], Mapping[str, Any]],
    ) -> tuple[int, bool]:
        last = layer[0].split(".")[-1].lower()
        return WHOLE.index(last) if last in WHOLE else len(WHOLE), "R" not in layer[2]

    name, header, held = min(layers, key=rank)
    others = ", ".join(shown(layer) for layer, _, _ in layers[:20] if layer != name)
    taken = (
        f"of its layers {shown(name)} is taken; left out: "
        if name
        else "layers are left out: "
    )
    keys = ("R", "G", "B") if "R" in held else ("Y", "RY", "BY")
    return (
        header,
        {key: held[key] for key in keys if key in held},
        [taken + others] if others else [],
    )


def _colored(planes: Mapping[str, Plane], size: tuple[int, ...]) -> dict[str, Plane]:
    """Return red, green and blue from luminance, and where there is one, chroma: RY =
    (R - Y) / Y, and so BY.
    """
    if "RY" not in planes:
        return dict.fromkeys("RGB", planes["Y"])
    y = planes["Y"].astype(np.float32)
    chroma = list[Plane]()
    for plane in (planes["RY"].astype(np.float32), planes["BY"].astype(np.float32)):
        for axis in (0, 1):  # it has a value at every n-th row and column only
            last = plane.shape[axis] - 1
            at = np.minimum(
                np.arange(size[axis]) / round(size[axis] / (last + 1)), last
            )
            low = at.astype(np.int64)
            share = np.expand_dims((at - low).astype(np.float32), 1 - axis)
            plane = (
                plane.take(low, axis) * (1.0 - share)
                + plane.take(np.minimum(low + 1, last), axis) * share
            )
        chroma.append((plane + 1.0) * y)
    red, blue = chroma
    green = (y - LUMINANCE[0] * red - LUMINANCE[2] * blue) / LUMINANCE[1]
    colors = {"R": red, "G": green, "B": blue}
    return {
        key: np.maximum(plane, 0.0).astype(np.float32) for key, plane in colors.items()
    }


def _displayed(header: Mapping[str, Any], planes: Planes, notes: list[str]) -> Planes:
    (top, left), size = _window(header, "dataWindow")
    (high, near), (height, width) = _window(header, "displayWindow")
    if (top, left) == (high, near) and size == (height, width):
        return planes
    rows = slice(max(top, high), min(top + size[0], high + height))
    columns = slice(max(left, near), min(left + size[1], near + width))
    if (
        rows.start - top
        or columns.start - left
        or rows.stop < top + size[0]
        or columns.stop < left + size[1]
    ):
        notes.append("its data beyond the display window is left out")

    def displayed(plane: Plane) -> Plane:
        whole = np.zeros((height, width), plane.dtype)
        if rows.stop > rows.start and columns.stop > columns.start:
            inside = plane[
                rows.start - top : rows.stop - top,
                columns.start - left : columns.stop - left,
            ]
            whole[
                rows.start - high : rows.stop - high,
                columns.start - near : columns.stop - near,
            ] = inside
        return whole

    red, green, blue = map(displayed, planes)
    return red, green, blue


Bytes = npt.NDArray[np.uint8]
_RESOLUTION = re.compile(rb"([-+])([YX]) +(\d{1,6}) +([-+])([YX]) +(\d{1,6})\r?\n")
_NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def read_radiance(path: Path, data: bytes) -> tuple[Bytes, Floats, list[str]]:
    """Unpack a Radiance RGBE picture: (H, W, 4) uint8, three mantissas and an exponent,
    row 0 on top, of which `linear` makes floats that take three times the memory; (3,)
    float32 by which the linear values are multiplied, the inverse of all COLORCORR
    lines; and clauses about what is left out. Raises FileFormatError: not a Radiance
    picture, one in XYZ colours, too large, or cut short.
    """
    end = re.search(rb"\r?\n\r?\n", data)
    if not data.startswith(b"#?") or not end:
        got = looks_like(data) if not data.startswith(b"#?") else "half a header"
        raise damaged(path, "a Radiance .hdr picture", got)
    head = data[: end.start()]
    rest = data[end.end() :]
    coding = re.search(rb"^FORMAT=\s*(\S+)", head, re.MULTILINE)
    if coding and coding[1] != b"32-bit_rle_rgbe":
        got = shown(coding[1].decode("latin-1"), quoted=False)
        raise FileFormatError(
            f"{path}: expected FORMAT=32-bit_rle_rgbe, got {got}; convert it to RGB"
        )
    size = _RESOLUTION.match(rest)
    if not size or not int(size[3]) or not int(size[6]) or size[2] == size[5]:
        line = rest[:30].split(b"\n")[0].decode("latin-1")
        raise FileFormatError(
            f"{path}: expected a size like '-Y 512 +X 1024', got "
            f"{line!r}; save the picture again"
        )
    lines = int(size[3])
    length = int(size[6])
    check_pixels(path, length, lines)
    pixels = _scanlines(path, rest[size.end() :], lines, length)
    # in our order it comes from the top, and from the left
    down, across = (
        1 if sign + axis in (b"-Y", b"+X") else -1
        for sign, axis in (size.group(1, 2), size.group(4, 5))
    )
    pixels = pixels[::down, ::across]
    scale = np.ones(3)  # but not EXPOSURE lines, as nowhere else: exposure is metered
    notes = list[str]()
    for text in re.findall(rb"^COLORCORR=(.*)$", head, re.MULTILINE)[:100]:
        numbers = np.array(list(map(float, re.findall(_NUMBER, text)[:4])))
        undone = (
            scale / numbers
            if len(numbers) == 3 and (numbers > 0.0).all()
            else np.full(3, np.nan)
        )
        if ((undone > 1e-20) & (undone < 1e20)).all():
            scale = undone
        else:
            notes.append(
                f"its line {shown('COLORCORR=' + text.decode('latin-1'))} is left out"
            )
    return (
        pixels if size[2] == b"Y" else pixels.transpose(1, 0, 2),
        scale.astype(np.float32),
        notes,
    )


def linear(pixels: Bytes) -> Floats:
    """Return the linear values (H, W, 3) float32 of pixels (H, W, 4): mantissa x
    2^(exponent - 136), as in Mitsuba.
    """
    scale = np.ldexp(np.float32(1.0), pixels[:, :, 3].astype(np.int32) - 136)
    scale = np.where(pixels[:, :, 3] == 0, np.float32(0.0), scale)
    return np.ascontiguousarray(
        pixels[:, :, :3].astype(np.float32) * scale[:, :, None], dtype=np.float32
    )


def _scanlines(path: Path, body: bytes, height: int, width: int) -> Bytes:
    result = np.empty((height, width, 4), np.uint8)
    position = 0
    mark = bytes([2, 2, width >> 8 & 0xFF, width & 0xFF])
    for row in range(height):
        try:
            if 8 <= width < 32768 and body[position : position + 4] == mark:
                position = _run_lengths(body, position + 4, result[row])
            else:
                position = _plain_line(body, position, result[row])
        except (IndexError, ValueError):
            got = (
                f"{row} whole ones and the start of another; the file is cut short "
                "or damaged"
            )
            raise damaged(path, f"{height} scanlines of {width} pixels", got) from None
    return result


def _run_lengths(body: bytes, position: int, line: Bytes) -> int:
    """Fill a line (W, 4) from its four run-length encoded channels; return the position
    after them.
    """
    for channel in range(4):
        pieces = []
        filled = 0
        while filled < len(line):
            count = body[position]
            if count == 0:
                raise ValueError("a run of length zero")
            size, times = (1, count - 128) if count > 128 else (count, 1)
            pieces.append(body[position + 1 : position + 1 + size] * times)
            position = position + 1 + size
            filled = filled + size * times
        line[:, channel] = np.frombuffer(b"".join(pieces), np.uint8)
    return position


def _plain_line(body: bytes, position: int, line: Bytes) -> int:
    """Fill a line (W, 4) from pixels of four bytes, where (1, 1, 1, n) repeats the
    last; return the next position.
    """
    width = len(line)
    raw = np.frombuffer(
        body, np.uint8, count=min(4 * width, len(body) - position), offset=position
    )
    if (
        len(raw) == 4 * width
        and not (raw.reshape(width, 4)[:, :3] == 1).all(axis=1).any()
    ):
        line[:] = raw.reshape(width, 4)
        return position + 4 * width
    filled = 0
    shift = 0
    while filled < width:
        pixel = body[position : position + 4]
        position = position + 4
        if pixel[:3] == b"\x01\x01\x01":
            count = pixel[3] << shift
            if filled == 0 or filled + count > width:
                raise ValueError("a repeat that does not fit")
            line[filled : filled + count] = line[filled - 1]
            filled = filled + count
            shift = shift + 8
        else:
            line[filled] = np.frombuffer(pixel, np.uint8)
            filled = filled + 1
            shift = 0
    return position
