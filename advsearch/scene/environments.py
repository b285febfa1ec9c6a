"""Environments from pictures: ``--environment path.hdr|.exr``, equirectangular maps in linear radiance."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator
from os import PathLike
from pathlib import Path

import numpy as np
import numpy.typing as npt
import OpenEXR

from advsearch.errors import FileFormatError, InputError
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.importing.files import damaged, looks_like, read_bytes, safe_name
from advsearch.scene.importing.images import area_average
from advsearch.scene.importing.radiance import read_radiance

Floats = npt.NDArray[np.float32]

SUFFIXES = (".hdr", ".exr")
"""The pictures that can be imported."""

LARGEST = (512, 1024)
"""Rows and columns of the largest environment kept; larger ones are averaged down."""

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
    radiance = read_radiance(file, data) if file.suffix.lower() == ".hdr" else _read_exr(file, data)
    _check_values(file, radiance)
    notes = []
    height, width = radiance.shape[:2]
    if abs(width / (2 * height) - 1.0) > 0.01:
        notes.append(f"{file.name}: expected a map twice as wide as high, got {width} x {height}; it appears stretched")
    if not radiance.any():
        notes.append(f"{file.name}: the environment is black everywhere; it lights nothing")
    return EnvironmentAsset(safe_name(file), _sized(radiance), source=str(file), warnings=tuple(notes))


def _check_values(file: Path, radiance: Floats) -> None:
    """Refuse texels that are not light."""
    kinds = (
        ("NaN", np.isnan(radiance), "paint them over"),
        ("infinite", np.isinf(radiance), "clamp them, or save the map in 32-bit floats if half floats overflowed"),
        ("negative", radiance < 0.0, "clamp them to 0"),
    )
    for kind, bad, remedy in kinds:
        texels = bad.any(axis=2)
        if texels.any():
            row, column = np.unravel_index(int(texels.argmax()), texels.shape)
            value = ", ".join(f"{v:.4g}" for v in radiance[row, column])
            raise InputError(
                f"{file}: expected finite radiance of at least 0, got {int(texels.sum())} of {texels.size} texels"
                f" {kind} (the first in row {row}, column {column}: {value}); {remedy}"
            )


def _sized(radiance: Floats) -> Floats:
    """Average a map down to at most `LARGEST`, or repeat its texels up to at least `SMALLEST`."""
    height, width = radiance.shape[:2]
    radiance = radiance.repeat(-(-SMALLEST[0] // height), axis=0).repeat(-(-SMALLEST[1] // width), axis=1)
    height, width = radiance.shape[:2]
    scale = min(1.0, LARGEST[0] / height, LARGEST[1] / width)
    if scale == 1.0:
        return radiance
    target = max(1, round(height * scale)), max(1, round(width * scale))
    polar = (np.arange(height, dtype=np.float32) + np.float32(0.5)) * np.float32(np.pi / height)
    angle = np.sin(polar)[:, None, None]
    covered = area_average(angle, target[0], 1)
    return np.asarray(area_average(radiance * angle, *target) / covered, dtype=np.float32)


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


def _read_exr(file: Path, data: bytes) -> Floats:
    """Return the first part of an OpenEXR file as (H, W, 3) float32."""
    if not data.startswith(b"\x76\x2f\x31\x01"):
        raise damaged(file, "an OpenEXR picture", looks_like(data))
    try:
        with _quiet(), OpenEXR.File(str(file), separate_channels=True) as picture:
            channels = {name: np.array(channel.pixels) for name, channel in picture.channels().items()}
    except Exception as error:
        raise FileFormatError(
            f"{file}: cannot be read as OpenEXR; it is damaged or cut short, export it again"
        ) from error
    names = ("R", "G", "B") if "Y" not in channels or "R" in channels else ("Y", "Y", "Y")
    missing = [name for name in dict.fromkeys(names) if name not in channels]
    if missing or ("RY" in channels and names[0] == "Y"):
        raise FileFormatError(
            f"{file}: expected the channels R, G and B (or Y alone), got {', '.join(sorted(channels))};"
            " save the picture as plain RGB without layers"
        )
    planes = [channels[name] for name in names]
    if any(plane.dtype.kind != "f" or plane.shape != planes[0].shape for plane in planes):
        got = ", ".join(f"{name} {plane.dtype} {plane.shape}" for name, plane in zip(names, planes, strict=True))
        raise FileFormatError(f"{file}: expected channels of equal size in half or float, got {got}; save it again")
    return np.stack(planes, axis=2).astype(np.float32)
