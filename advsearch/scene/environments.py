"""Environments from pictures: ``--environment path.hdr|.exr``, equirectangular maps in linear radiance."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable, Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenEXR

from advsearch import files
from advsearch.errors import AdvsearchError, FileFormatError, InputError
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.importing.files import damaged, looks_like, read_bytes, safe_name, shown
from advsearch.scene.importing.images import LARGEST_PIXELS, area_average, banded_average
from advsearch.scene.importing.radiance import linear, read_radiance

Floats = npt.NDArray[np.float32]
Plane = npt.NDArray[np.floating]
Planes = tuple[Plane, Plane, Plane]
Bools = npt.NDArray[np.bool_]

SUFFIXES = (".hdr", ".exr")
"""The pictures that can be imported."""

LARGEST = (512, 1024)
"""Rows and columns of the largest environment kept; larger ones are averaged down."""

LARGEST_EXR = 2 * LARGEST_PIXELS
"""Pixels times channels of an OpenEXR file (8192 x 4096 with 4), before `advsearch.files.scaled`."""

SMALLEST = (4, 8)
"""Rows and columns that a smaller environment is brought up to by repeating its texels; renderers need a few."""


def import_environment(path: str | PathLike[str]) -> EnvironmentAsset:
    """Read an equirectangular environment map.

    Maps larger than `LARGEST` are averaged down, each texel weighted by the solid angle that it covers, so that the
    light from each direction stays the same in the mean. Row 0 is up; columns stay in the file's order.

    Args:
        path: a Radiance ``.hdr`` (RGBE), or an ``.exr`` with channels R, G and B, or Y alone (grey), in half or float.

    Raises:
        FileFormatError: the file is missing, of another kind, damaged, or lacks channels; the message names it.
        InputError: values that are negative, NaN or infinite; the message counts them and gives the first position.
    """
    file = Path(path)
    data = read_bytes(file, "environment", SUFFIXES)
    if file.suffix.lower() == ".hdr":
        pixels = read_radiance(file, data)
        radiance, size = _sized(lambda top, end: linear(pixels[top:end]), pixels.shape[:2]), pixels.shape[:2]
    else:
        planes = _read_exr(file, data)
        _check_values(file, planes)
        size = planes[0].shape
        radiance = _sized(lambda top, end: _stacked(planes, top, end), size)
    notes = []
    height, width = size
    if abs(width / (2 * height) - 1.0) > 0.01:
        notes.append(f"{file.name}: expected a map twice as wide as high, got {width} x {height}; it appears stretched")
    if not radiance.any():
        notes.append(f"{file.name}: the environment is black everywhere; it lights nothing")
    return EnvironmentAsset(safe_name(file), radiance, source=str(file), warnings=tuple(notes), photographed=True)


def _stacked(planes: Planes, top: int, end: int) -> Floats:
    """Return some rows of three planes (H, W) as (n, W, 3) float32."""
    return np.stack([plane[top:end] for plane in planes], axis=2).astype(np.float32)


def _check_values(file: Path, planes: Planes) -> None:
    """Refuse texels that are not light."""
    kinds: tuple[tuple[str, Callable[[Plane], Bools], str], ...] = (
        ("NaN", np.isnan, "paint them over"),
        ("infinite", np.isinf, "clamp them, or save the map in 32-bit floats if half floats overflowed"),
        ("negative", lambda plane: plane < 0.0, "clamp them to 0"),
    )
    for kind, bad, remedy in kinds:
        texels = bad(planes[0]) | bad(planes[1]) | bad(planes[2])
        if texels.any():
            row, column = np.unravel_index(int(texels.argmax()), texels.shape)
            value = ", ".join(f"{float(plane[row, column]):.4g}" for plane in planes)
            raise InputError(
                f"{file}: expected finite radiance of at least 0, got {int(texels.sum())} of {texels.size} texels"
                f" {kind} (the first in row {row}, column {column}: {value}); {remedy}"
            )


def _sized(band: Callable[[int, int], Floats], size: tuple[int, int]) -> Floats:
    """Average a map down to at most `LARGEST`, or repeat its texels up to at least `SMALLEST`.

    Args:
        band: returns the map's rows from the first to before the second of its arguments, (n, W, 3) float32.
        size: the map's rows and columns.
    """
    height, width = size
    scale = min(1.0, LARGEST[0] / height, LARGEST[1] / width)
    if scale == 1.0:
        return band(0, height).repeat(-(-SMALLEST[0] // height), axis=0).repeat(-(-SMALLEST[1] // width), axis=1)
    target = max(1, round(height * scale)), max(1, round(width * scale))
    polar = (np.arange(height, dtype=np.float32) + np.float32(0.5)) * np.float32(np.pi / height)
    angle = np.sin(polar)[:, None, None]
    covered = area_average(angle, target[0], 1)
    weighted = banded_average(lambda top, end: band(top, end) * angle[top:end], size, target)
    return np.asarray(weighted / covered, dtype=np.float32)


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


def _read_exr(file: Path, data: bytes) -> Planes:
    """Return red, green and blue of the first part of an OpenEXR file, each (H, W) in half or float."""
    if not data.startswith(b"\x76\x2f\x31\x01"):
        raise damaged(file, "an OpenEXR picture", looks_like(data))
    try:
        with _quiet():
            with OpenEXR.File(io.BytesIO(data), separate_channels=True, header_only=True) as picture:
                _check_exr_size(file, picture)
            with OpenEXR.File(io.BytesIO(data), separate_channels=True) as picture:
                channels = {name: channel.pixels for name, channel in picture.channels().items()}
    except (AdvsearchError, MemoryError):
        raise
    except Exception as error:
        raise FileFormatError(
            f"{file}: cannot be read as OpenEXR; it is damaged or cut short, export it again"
        ) from error
    names = ("R", "G", "B") if "Y" not in channels or "R" in channels else ("Y", "Y", "Y")
    missing = [name for name in dict.fromkeys(names) if name not in channels]
    if missing or ("RY" in channels and names[0] == "Y"):
        got = ", ".join(shown(name, quoted=False) for name in sorted(channels))
        raise FileFormatError(
            f"{file}: expected the channels R, G and B (or Y alone), got {got};"
            " save the picture as plain RGB without layers"
        )
    planes = channels[names[0]], channels[names[1]], channels[names[2]]
    if any(plane.dtype.kind != "f" or plane.shape != planes[0].shape or plane.ndim != 2 for plane in planes):
        got = ", ".join(f"{name} {plane.dtype} {plane.shape}" for name, plane in zip(names, planes, strict=True))
        raise FileFormatError(f"{file}: expected channels of equal size in half or float, got {got}; save it again")
    return planes


def _check_exr_size(file: Path, picture: Any) -> None:
    """Refuse a picture, opened without its pixels, that takes too much memory or has other than plain pixels."""
    values = 0
    for part in picture.parts:
        header = part.header
        if "deep" in str(header.get("type", "")):
            raise FileFormatError(f"{file}: expected one value a pixel, got a deep OpenEXR picture; flatten it")
        low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
        width, height = (int(extent) for extent in high - low + 1)
        values += max(width, 0) * max(height, 0) * len(header["channels"])
    most = files.scaled(LARGEST_EXR)
    if values > most:
        raise files.too_large(file, f"OpenEXR pictures of at most {most:,} pixels times channels", f"{values:,}")
