"""What of a run's answer can be printed: patches, and textures unwrapped into pieces, in true millimetres."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage

from advsearch.config import AttackConfig
from advsearch.controls.base import Control
from advsearch.controls.patch import enlarged
from advsearch.controls.space import file_name
from advsearch.controls.texture import TextureControl
from advsearch.engine.loading import as_controls, load_scene
from advsearch.errors import FileFormatError, InputError
from advsearch.report.sheets import Mask, Piece
from advsearch.runs.directory import ARTIFACTS, CONFIG, find_run
from advsearch.runs.images import read_png, to_8bit
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.summary import read_result
from advsearch.scene.assets import Floats, Mesh
from advsearch.scene.description import NO_MAP
from advsearch.scene.raster import doubled_areas
from advsearch.scene.surface_map import Ints, rasterised

BLEED = 3.0
"""Millimetres of colour beyond the line to cut."""
FINEST = 0.2
"""Millimetres of a pixel that is fine enough: texels are divided until they are no larger, and are interpolated between
as the renderer does it."""
MOST_PARTS = 9
"""Parts of a texel along each side, odd: the middle one has the texel's own colour."""


def printable(run: str | Path, size: float) -> list[Piece]:
    """Return what of a run's answer can be printed.

    A patch is one piece. A texture has one for each connected part of the unwrapped surface, stretched along both sides
    to the mean size that its texels have on the object; what is left of distortion within a piece is in its name.

    Args:
        run: of `attack`, that has ended.
        size: of the real object, its longest side in millimetres, over 0.

    Raises:
        InputError: nothing of it can be printed, or the size is out of range.
        UnknownNameError: there is no such run.
        FileFormatError: the run is of another kind or has not ended, or lacks its files.
    """
    if not 1.0 <= size <= 10_000.0:
        raise InputError(f"size: expected the object's longest side in millimetres, 1 to 10000, got {size}")
    folder = find_run(run)
    summary = read_result(folder)
    if not isinstance(summary, AttackSummary):
        raise FileFormatError(f"{folder}: expected a run of attack, got one of {summary.command}")
    config = AttackConfig.from_yaml(folder / CONFIG)
    scene = load_scene(config.object, NO_MAP, up=config.up)
    pieces: list[Piece] = []
    for control in as_controls(config.controls):
        picture = folder / ARTIFACTS / f"{file_name(control.name)}.png"
        if control.kind == "patch":
            pixels = read_png(folder / ARTIFACTS / f"{control.name}-pixels.png")
            given = config.controls.get(control.name, {}).get("size")
            side = size * _side(control, summary, given)
            pieces.append(_piece(f"{control.name}, {side:.1f} mm a side", pixels, (side / len(pixels),) * 2, None))
        elif isinstance(control, TextureControl) and picture.is_file():
            mesh, named = control.mesh_in(scene.description).mesh, control.materials_in(scene.description)
            faces = None if named is None else np.concatenate([mesh.materials[one] for one in named])
            extent = float(np.ptp(scene.description.object.mesh.vertices, axis=0).max())
            pieces.extend(_charts(control.name, read_png(picture), mesh, faces, size / extent))
    if not pieces:
        raise InputError(f"{folder}: it has neither a texture nor a patch, so that there is nothing to print")
    return pieces


def _side(control: Control, summary: AttackSummary, given: object) -> float:
    """The side of a patch in object sizes: what was found, what was given, or its default."""
    found = (summary.configuration or {}).get(f"{control.name}.size")
    if found is not None and isinstance(found.value, (int, float)):
        return float(found.value)
    default = next(parameter.default for parameter in control.parameters if parameter.name == "size")
    return float(given if isinstance(given, (int, float)) else default)


def _charts(name: str, texture: Floats, mesh: Mesh, faces: Ints | None, scale: float) -> Iterator[Piece]:
    """Yield the connected parts of a texture as they are seen from outside, the largest first; with `faces` those of
    these faces.

    Neighbouring texels of one part lie a distance apart on the surface; the mean over the part, along columns and rows,
    is the size that they get. `scale` is in millimetres a mesh unit.
    """
    areas = doubled_areas(mesh.uvs[mesh.faces].astype(np.float64))
    charts = rasterised(mesh, (texture.shape[0], texture.shape[1]))
    places = charts.positions().astype(np.float64)
    labels, count = ndimage.label(charts.covered & (True if faces is None else np.isin(charts.face, faces)))
    boxes = ndimage.find_objects(labels)
    order = sorted(range(count), key=lambda index: -int((labels[boxes[index]] == index + 1).sum()))
    for number, index in enumerate(order, 1):
        rows, columns = boxes[index]
        inside = labels[rows, columns] == index + 1
        here = places[rows, columns] * scale
        steps = [_steps(here, inside, axis) for axis in (1, 0)]
        if not all(len(step) for step in steps):
            continue  # a line of texels has no area to print
        pixel = float(np.mean(steps[0])), float(np.mean(steps[1]))
        if min(pixel) <= 0.0:
            continue
        stretch = max(float(np.std(step) / np.mean(step)) for step in steps)
        nearest = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
        picture = texture[rows, columns][tuple(nearest)]
        if areas[np.unique(charts.face[rows, columns][inside])].sum() < 0.0:
            picture, inside = picture[:, ::-1], inside[:, ::-1]
        title = name if count == 1 else f"{name}, piece {number}"
        title += f" (sizes within it differ by {100 * stretch:.0f} %)" if stretch >= 0.005 else ""
        yield _piece(title, picture, pixel, inside)


def _steps(places: np.ndarray, inside: Mask, axis: int) -> np.ndarray:
    """Distances on the surface between texels that are neighbours along an axis, both inside; in millimetres."""
    lengths = np.linalg.norm(np.diff(places, axis=axis), axis=-1)
    both = np.minimum(inside.take(range(1, inside.shape[axis]), axis), inside.take(range(inside.shape[axis] - 1), axis))
    return np.asarray(lengths[both.astype(bool)])


def _piece(name: str, picture: Floats, pixel: tuple[float, float], inside: Mask | None) -> Piece:
    """Divide the pixels, and put the bleed around them."""
    parts = min(MOST_PARTS, 2 * math.ceil((max(pixel) / FINEST - 1.0) / 2.0) + 1) if max(pixel) > FINEST else 1
    fine = enlarged(torch.from_numpy(np.ascontiguousarray(picture)), parts) if parts > 1 else torch.from_numpy(picture)
    size = pixel[0] / parts, pixel[1] / parts
    columns, rows = (math.ceil(BLEED / side) for side in size)
    levels = np.pad(to_8bit(fine.numpy()), ((rows, rows), (columns, columns), (0, 0)), mode="edge")
    mask = None
    if inside is not None and not inside.all():
        mask = np.pad(inside.repeat(parts, 0).repeat(parts, 1), ((rows, rows), (columns, columns)))
    return Piece(name, levels, size, (columns, rows), mask)
