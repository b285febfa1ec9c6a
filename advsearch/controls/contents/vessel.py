"""The inside of a vessel: where rain would collect in a mesh, and how wide it is there at every height.

Rain falls on the mesh from above. Water that cannot run off (a height map with its basins filled: Barnes, Lehman and
Mulla 2014, arXiv 1511.04463, section 2) marks the inside and its brim; rays from the axis of that basin then find the
wall all around at a few heights. A lamp shade catches rain as seen from above, but its wall has a gap below: the rays
tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from advsearch.scene.assets import Mesh, ObjectAsset
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.raster import pixels_in

Doubles = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

GRID = 128
"""Cells of the height map along the longer side of the mesh."""
ROWS = 40
"""Heights at which the wall is looked for."""
COLUMNS = 96
"""Directions in which it is looked for."""
SHALLOWEST = 0.03
"""Smallest depth of a vessel in object sizes."""
NARROWEST = 5e-4
"""Smallest opening of a vessel in squared object sizes."""
CLOSED = 0.97
"""Share of the rays that have to meet the wall."""
BRIM = 0.985
"""A full vessel is filled to this share of its depth."""


@dataclass(frozen=True, eq=False)
class Vessel:
    """The inside of a vessel that stands upright.

    Attributes:
        axis: (2,) x and y of the line that the wall is seen from.
        heights: (R,) evenly spaced z, from the floor to the brim.
        radii: (R, K) distance of the wall from the axis, in K evenly spaced directions from +x counter-clockwise.
        color: (3,) linear reflectance of the wall's lower half.
    """

    axis: Doubles
    heights: Doubles
    radii: Doubles
    color: Doubles


@lru_cache(maxsize=8)
def interior(asset: ObjectAsset) -> Vessel | None:
    """Find the inside of an object in its default pose; None if it is no vessel."""
    mesh = asset.mesh
    basin = _basin(mesh)
    if basin is None:
        return None
    axis, floor, rim = basin
    heights = np.linspace(floor, floor + BRIM * (rim - floor), ROWS)
    inset = 0.004 * (rim - floor)  # a ray along a flat floor would see anything
    rows = [_wall(mesh, axis, max(float(height), floor + inset)) for height in heights]
    radii, faces = np.stack([row[0] for row in rows]), np.concatenate([row[1] for row in rows[: ROWS // 2]])
    met = np.isfinite(radii)
    if met.mean() < CLOSED or not met.any(axis=1).all():
        return None
    middle = np.array([np.median(row[np.isfinite(row)]) for row in radii])
    return Vessel(axis, heights, np.where(met, radii, middle[:, None]), _color(asset, faces[faces >= 0]))


def _basin(mesh: Mesh) -> tuple[Doubles, float, float] | None:
    """Return the axis (2,), the floor and the rim of the largest basin, or None if there is none worth the name."""
    from scipy import ndimage

    low, cell, ground = _height_map(mesh)
    water = _filled(ground)
    labels, count = ndimage.label(water - ground > 1e-3)
    if count == 0:
        return None
    volumes = ndimage.sum_labels(water - ground, labels, np.arange(1, count + 1))
    mine = labels == 1 + int(np.argmax(volumes))
    depth = np.where(mine, water - ground, 0.0)
    if depth.max() < SHALLOWEST or mine.sum() * cell * cell < NARROWEST:
        return None
    row, column = np.nonzero(mine)
    weight = depth[mine]
    axis = low + cell * np.array([(column * weight).sum(), (row * weight).sum()]) / weight.sum()
    return axis, float(ground[mine].min()), float(water[mine].max())


def _height_map(mesh: Mesh) -> tuple[Doubles, float, Doubles]:
    """Highest surface over a grid with an empty margin: place of cell (0, 0), side of a cell, (h, w) heights.

    Edges are drawn as well as faces, so that a thin upright wall is not missed between two cells.
    """
    vertices = mesh.vertices.astype(np.float64)
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    cell = float((high - low).max()) / GRID
    low = low - 1.5 * cell
    width, height = (np.ceil((high - low) / cell).astype(np.int64) + 2).tolist()
    ground = np.full((height, width), vertices[:, 2].min() - 1.0)
    corners = vertices[mesh.faces.astype(np.int64)]
    placed = (corners[..., :2] - low) / cell
    face, row, column, weights = pixels_in(placed, (height, width))
    np.maximum.at(ground, (row, column), (weights * corners[face, :, 2]).sum(axis=1))
    for share in np.linspace(0.0, 1.0, 9):
        for begin, end in ((0, 1), (1, 2), (2, 0)):
            place = np.rint(placed[:, begin] + share * (placed[:, end] - placed[:, begin])).astype(np.int64)
            at = corners[:, begin, 2] + share * (corners[:, end, 2] - corners[:, begin, 2])
            np.maximum.at(ground, (place[:, 1], place[:, 0]), at)
    return low, cell, ground


def _filled(ground: Doubles) -> Doubles:
    """The level of water on a height map (h, w) from whose edges it runs off.

    Every cell stands as high as its ground or its lowest neighbour's water, whichever is higher; repeated until
    nothing changes.
    """
    water = np.full_like(ground, np.inf)
    water[[0, -1]], water[:, [0, -1]] = ground[[0, -1]], ground[:, [0, -1]]
    while True:
        lowest = np.minimum(
            np.minimum(water[:-2, 1:-1], water[2:, 1:-1]), np.minimum(water[1:-1, :-2], water[1:-1, 2:])
        )
        level = np.maximum(ground[1:-1, 1:-1], np.minimum(lowest, water[1:-1, 1:-1]))
        if np.array_equal(level, water[1:-1, 1:-1]):
            return water
        water[1:-1, 1:-1] = level


def _wall(mesh: Mesh, axis: Doubles, height: float) -> tuple[Doubles, Ints]:
    """Cast level rays from the axis at one height.

    Returns:
        (COLUMNS,) distance of the first surface in each direction, infinite where there is none, and its face or -1.
    """
    face, begin, end = _section(mesh, height)
    begin, end = begin - axis, end - axis
    angle = np.arange(COLUMNS) * 2.0 * np.pi / COLUMNS
    toward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    side_begin = toward[:, :1] * begin[:, 1] - toward[:, 1:] * begin[:, 0]  # on which side of the ray, (COLUMNS, S)
    side_end = toward[:, :1] * end[:, 1] - toward[:, 1:] * end[:, 0]
    crossed = (side_begin > 0.0) != (side_end > 0.0)
    share = side_begin / np.where(crossed, side_begin - side_end, 1.0)
    distance = (toward @ begin.T) * (1.0 - share) + (toward @ end.T) * share
    distance = np.where(crossed & (distance > 0.0), distance, np.inf)
    if distance.shape[1] == 0:
        return np.full(COLUMNS, np.inf), np.full(COLUMNS, -1)
    first = distance.argmin(axis=1)
    nearest = distance[np.arange(COLUMNS), first]
    return nearest, np.where(np.isfinite(nearest), face[first], -1)


def _section(mesh: Mesh, height: float) -> tuple[Ints, Doubles, Doubles]:
    """Cut a mesh at a height: the faces that are cut (S,), and the ends (S, 2) of the cut through each."""
    corners = mesh.vertices[mesh.faces.astype(np.int64)].astype(np.float64)
    above = corners[..., 2] > height
    face = np.nonzero(above.any(axis=1) & ~above.all(axis=1))[0]
    corners, above = corners[face], above[face]
    alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))  # the corner on its side
    number = np.arange(len(face))
    apex = corners[number, alone]
    ends = []
    for step in (1, 2):
        other = corners[number, (alone + step) % 3]
        share = (height - apex[:, 2]) / np.where(other[:, 2] == apex[:, 2], 1.0, other[:, 2] - apex[:, 2])
        ends.append(apex[:, :2] + share[:, None] * (other[:, :2] - apex[:, :2]))
    return face, ends[0], ends[1]


def _color(asset: ObjectAsset, faces: Ints) -> Doubles:
    """Mean linear reflectance (3,) of the texture at the middles of some faces."""
    middle = asset.mesh.uvs[asset.mesh.faces[faces].astype(np.int64)].mean(axis=1)
    middle -= np.floor(middle) if asset.mesh.repeats else 0.0
    height, width = asset.base_color.shape[:2]
    column = np.clip((middle[:, 0] * width).astype(np.int64), 0, width - 1)
    row = np.clip(((1.0 - middle[:, 1]) * height).astype(np.int64), 0, height - 1)
    return np.asarray(srgb_to_linear(asset.base_color[row, column]).mean(axis=0), dtype=np.float64)
