"""OpenEXR pictures as linear red, green and blue: which part and layer, which window, which channels.

The format is that of the OpenEXR project, "Technical Introduction to OpenEXR" and "OpenEXR File Layout".
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenEXR

from advsearch import files
from advsearch.errors import AdvsearchError, FileFormatError
from advsearch.pictures import LARGEST_PIXELS, check_pixels
from advsearch.scene.importing.files import damaged, looks_like, shown

Plane = npt.NDArray[np.floating]
Planes = tuple[Plane, Plane, Plane]

LARGEST = 2 * LARGEST_PIXELS
"""Pixels times channels of a file (8192 x 4096 with 4), before `advsearch.files.scaled`."""
COLORS = {"r": "R", "red": "R", "g": "G", "green": "G", "b": "B", "blue": "B", "y": "Y", "ry": "RY", "by": "BY"}
"""Names of channels, in any case, and what they hold."""
WHOLE = ("", "rgba", "rgb", "beauty", "combined", "color", "colour", "main", "image")
"""Names of layers that are the picture itself, the likeliest first; others are taken where there is none of these."""
LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Of red, green and blue: ITU-R BT.709, which a file has that names no others."""
PRIMARIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.329)
CUBE = 1


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Swallow what OpenEXR prints about damaged files: on Python's standard output and on the process's stream 2."""
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
    """Read the picture of an OpenEXR file: its display window, which is black where the file has no data.

    Of several parts and layers the one that is called as the picture itself, or else the first with colours, is taken.

    Args:
        file: for messages.
        data: its content.

    Returns:
        Red, green and blue, each (H, W) in half or float, and clauses about what is left out.

    Raises:
        FileFormatError: it is damaged, too large, deep, a cube map, or has no colours.
    """
    if not data.startswith(b"\x76\x2f\x31\x01"):
        raise damaged(file, "an OpenEXR picture", looks_like(data))
    try:
        with _quiet():
            with OpenEXR.File(io.BytesIO(data), separate_channels=True, header_only=True) as picture:
                _check_size(file, picture)
            with OpenEXR.File(io.BytesIO(data), separate_channels=True) as picture:
                parts = [(dict(part.header), dict(part.channels)) for part in picture.parts]
                if not parts or any(len(channels) != len(header["channels"]) for header, channels in parts):
                    raise ValueError("pixels that end early")
                header, channels, notes = _chosen(file, parts)
                planes = {key: channel.pixels for key, channel in channels.items()}
    except (AdvsearchError, MemoryError):
        raise
    except Exception as error:
        raise FileFormatError(
            f"{file}: cannot be read as OpenEXR; it is damaged or cut short, export it again"
        ) from error
    if header.get("envmap") is not None and getattr(header["envmap"], "value", header["envmap"]) == CUBE:
        raise FileFormatError(f"{file}: expected a map of latitude and longitude, got a cube map; convert it")
    size = tuple(int(extent) for extent in _window(header, "dataWindow")[1])
    sized = all(plane.shape == size for key, plane in planes.items() if key not in ("RY", "BY"))
    if not sized or any(plane.dtype.kind != "f" or plane.ndim != 2 for plane in planes.values()):
        got = ", ".join(f"{name} {plane.dtype} {plane.shape}" for name, plane in planes.items())
        raise FileFormatError(f"{file}: expected channels of equal size in half or float, got {got}; save it again")
    whole = planes if "R" in planes else _colored(planes, size)
    given = header.get("chromaticities")
    if given is not None and not np.allclose(np.asarray(given, np.float64).ravel(), PRIMARIES, atol=2e-3):
        notes.append("its colours have primaries of their own and are taken for those of sRGB")
    return _displayed(header, (whole["R"], whole["G"], whole["B"]), notes), notes


def _check_size(file: Path, picture: Any) -> None:
    """Refuse a picture, opened without its pixels, that takes too much memory or has other than plain pixels."""
    values = 0
    for part in picture.parts:
        header = part.header
        if "deep" in str(header.get("type", "")):
            raise FileFormatError(f"{file}: expected one value a pixel, got a deep OpenEXR picture; flatten it")
        (height, width), (tall, wide) = (_window(header, name)[1] for name in ("dataWindow", "displayWindow"))
        values += max(width, 0) * max(height, 0) * len(header["channels"])
        check_pixels(file, max(wide, 0), max(tall, 0))
    most = files.scaled(LARGEST)
    if values > most:
        raise files.too_large(file, f"OpenEXR pictures of at most {most:,} pixels times channels", f"{values:,}")


def _window(header: Mapping[str, Any], name: str) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first row and column of a window, and its height and width."""
    low, high = (np.asarray(corner, dtype=np.int64) for corner in header[name])
    width, height = (int(extent) for extent in high - low + 1)
    return (int(low[1]), int(low[0])), (height, width)


def _chosen(
    file: Path, parts: list[tuple[dict[str, Any], dict[str, Any]]]
) -> tuple[dict[str, Any], dict[str, Any], list[str]]:
    """Return the header and the channels of the layer that is the picture, and clauses about other ones."""
    layers: list[tuple[str, dict[str, Any], dict[str, Any]]] = []
    for header, channels in parts:
        found: dict[str, dict[str, Any]] = {}
        for name, channel in channels.items():
            layer, _, last = name.rpartition(".")
            found.setdefault(layer, {}).setdefault(COLORS.get(last.lower(), last), channel)
        called = str(header.get("name", "")) if len(parts) > 1 else ""
        for layer, held in found.items():
            grey = "Y" in held and ("RY" in held) == ("BY" in held) and not {"R", "G", "B", "X", "Z"} & set(held)
            if grey or {"R", "G", "B"} <= set(held):
                layers.append((layer or called, header, held))
    if not layers:
        names = sorted({name for _, channels in parts for name in channels})
        got = ", ".join(shown(name, quoted=False) for name in names)
        raise FileFormatError(
            f"{file}: expected the channels R, G and B (or Y alone), got {got}; save the picture as plain RGB"
        )
    rank = {name: number for number, name in enumerate(WHOLE)}
    order = [
        (rank.get(name.split(".")[-1].lower(), len(WHOLE)), "R" not in held, number)
        for number, (name, _, held) in enumerate(layers)
    ]
    name, header, held = layers[min(order)[2]]
    others = ", ".join(shown(one) for one, _, _ in layers[:20] if one != name)
    taken = f"of its layers {shown(name)} is taken; left out: " if name else "layers are left out: "
    wanted = ("R", "G", "B") if "R" in held else ("Y", "RY", "BY")
    return header, {key: held[key] for key in wanted if key in held}, [taken + others] if others else []


def _colored(planes: Mapping[str, Plane], size: tuple[int, ...]) -> dict[str, Plane]:
    """Return red, green and blue from luminance, and where there is one, chroma: RY = (R - Y) / Y, and so BY."""
    luminance = planes["Y"]
    if "RY" not in planes:
        return dict.fromkeys("RGB", luminance)
    y = luminance.astype(np.float32)
    red, blue = ((_enlarged(planes[key], size) + 1.0) * y for key in ("RY", "BY"))
    green = (y - LUMINANCE[0] * red - LUMINANCE[2] * blue) / LUMINANCE[1]
    return {key: np.maximum(plane, 0.0).astype(np.float32) for key, plane in (("R", red), ("G", green), ("B", blue))}


def _enlarged(plane: Plane, size: tuple[int, ...]) -> Plane:
    """Interpolate a channel that has a value at every n-th row and column only."""
    found = plane.astype(np.float32)
    for axis in (0, 1):
        step = round(size[axis] / found.shape[axis])
        at = np.minimum(np.arange(size[axis]) / step, found.shape[axis] - 1)
        low = at.astype(np.int64)
        high, share = np.minimum(low + 1, found.shape[axis] - 1), (at - low).astype(np.float32)
        share = share[:, None] if axis == 0 else share[None, :]
        found = found.take(low, axis) * (1.0 - share) + found.take(high, axis) * share
    return found


def _displayed(header: Mapping[str, Any], planes: Planes, notes: list[str]) -> Planes:
    """Return what the display window shows of the data window."""
    (top, left), size = _window(header, "dataWindow")
    (high, near), (height, width) = _window(header, "displayWindow")
    if (top, left) == (high, near) and size == (height, width):
        return planes
    rows = slice(max(top, high), min(top + size[0], high + height))
    columns = slice(max(left, near), min(left + size[1], near + width))
    if rows.start - top or columns.start - left or rows.stop < top + size[0] or columns.stop < left + size[1]:
        notes.append("its data beyond the display window is left out")
    found = []
    for plane in planes:
        whole = np.zeros((height, width), plane.dtype)
        if rows.stop > rows.start and columns.stop > columns.start:
            inside = plane[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
            whole[rows.start - high : rows.stop - high, columns.start - near : columns.stop - near] = inside
        found.append(whole)
    return found[0], found[1], found[2]
