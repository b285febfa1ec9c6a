"""Environments from pictures: ``--environment path.hdr|.exr``, equirectangular maps in linear radiance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from advsearch.errors import InputError
from advsearch.scene.assets import Bools, EnvironmentAsset, Floats
from advsearch.scene.importing.files import read_bytes, safe_name
from advsearch.scene.importing.hdr import Plane, Planes, linear, read_exr, read_radiance
from advsearch.scene.importing.pictures import area_average, banded_average

SUFFIXES = (".hdr", ".exr")
"""The pictures that can be imported."""

LARGEST = (512, 1024)
"""Rows and columns of the largest environment kept; larger ones are averaged down."""

SMALLEST = (4, 8)
"""Rows and columns that a smaller environment is brought up to by repeating its texels; renderers need a few."""


@dataclass(frozen=True, eq=False)
class LightPicture:
    """A picture in linear radiance: its size in rows and columns; `band`, which returns the rows from its first
    argument to before its second, (n, W, 3) float32; and clauses about what is left out."""

    size: tuple[int, int]
    band: Callable[[int, int], Floats]
    notes: tuple[str, ...]


def read_light(path: Path, what: str = "environment") -> LightPicture:
    """Read an ``.hdr`` or ``.exr`` picture of any shape.

    Raises:
        FileFormatError, InputError: as for `import_environment`.
    """
    data = read_bytes(path, what, SUFFIXES)
    if path.suffix.lower() == ".hdr":
        pixels, scale, notes = read_radiance(path, data)
        return LightPicture(pixels.shape[:2], lambda top, end: linear(pixels[top:end]) * scale, tuple(notes))
    planes, notes = read_exr(path, data)
    _check_values(path, planes)

    def stacked(top: int, end: int) -> Floats:
        return np.stack([plane[top:end] for plane in planes], axis=2).astype(np.float32)

    return LightPicture(planes[0].shape, stacked, tuple(notes))


def import_environment(path: str | PathLike[str]) -> EnvironmentAsset:
    """Read an equirectangular environment map: a Radiance ``.hdr`` (RGBE), or an ``.exr`` with channels R, G and B, or
    Y alone (grey), in half or float; see `advsearch.scene.importing.hdr`.

    Maps larger than `LARGEST` are averaged down, each texel weighted by the solid angle that it covers, so that the
    light from each direction stays the same in the mean. Row 0 is up; columns stay in the file's order.

    Raises:
        FileFormatError: the file is missing, of another kind, damaged, or lacks channels; the message names it.
        InputError: values that are negative, NaN or infinite; the message counts them and gives the first position.
    """
    file = Path(path)
    picture = read_light(file)
    notes = [f"{file.name}: {note}" for note in picture.notes]
    height, width = picture.size
    if abs(width / (2 * height) - 1.0) > 0.01:
        notes.append(f"{file.name}: expected a map twice as wide as high, got {width} x {height}; it appears stretched")
    radiance = _sized(picture.band, picture.size)
    if not radiance.any():
        notes.append(f"{file.name}: the environment is black everywhere; it lights nothing")
    return EnvironmentAsset(safe_name(file), radiance, source=str(file), warnings=tuple(notes), photographed=True)


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
    """Average a map down to at most `LARGEST`, and repeat its texels up to at least `SMALLEST`; see `LightPicture`."""
    height, width = size
    scale = min(1.0, LARGEST[0] / height, LARGEST[1] / width)
    if scale == 1.0:
        texels = band(0, height)
    else:
        target = max(1, round(height * scale)), max(1, round(width * scale))
        polar = (np.arange(height, dtype=np.float32) + np.float32(0.5)) * np.float32(np.pi / height)
        angle = np.sin(polar)[:, None, None]
        covered = area_average(angle, target[0], 1)
        texels = banded_average(lambda top, end: band(top, end) * angle[top:end], size, target) / covered
    down, across = (-(-least // extent) for least, extent in zip(SMALLEST, texels.shape[:2], strict=True))
    return np.asarray(texels.repeat(down, axis=0).repeat(across, axis=1), dtype=np.float32)
