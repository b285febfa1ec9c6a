"""The texels of light that lie over the surfaces of a scene, and how their light is looked up between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy.sparse
from torch import Tensor

from advsearch.scene.mitsuba_backend.texel_rays import TexelGrid
from advsearch.scene.surface_map import BORDER, Charts, rasterised
from advsearch.scene.transport.matrix import by_rows

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]

SIDE = 160
"""Texels a side over the searched object."""
GROUND = 112
"""Texels a side over the ground."""
NEAR = 12.0
"""Half the side of the ground that has texels, object sizes; further out there is the light of its border."""
FINEST = 0.01
"""Side of the ground's texels under the middle of the object, object sizes: contact shadows are that sharp."""
REACH = 2
"""Texels to each side that the light of a place is taken from."""
WIDTH = 0.8
"""Standard deviation of the weight of these, texels."""
SAME = 1.5
"""Standard deviation of the weight of their distance in space, sides of a texel: those of another chart take no part,
nor those of the other wall of a cup."""

BINOMIAL = (1, 4, 6, 4, 1)


@dataclass(frozen=True, eq=False)
class Texels:
    """Where light is kept: those cells of all grids that lie on a surface.

    Attributes:
        grids: of each surface, the searched one first.
        places, normals: (n, 3), in world space.
        cells: (n,) the cell of all grids that each lies in.
        of_cell: (cells of all grids,) number of the texel that each cell has the light of, the nearest one.
        begin: of each grid its first texel, and the number of all.
    """

    grids: tuple[TexelGrid, ...]
    places: Floats
    normals: Floats
    cells: Ints
    of_cell: Ints
    begin: tuple[int, ...]

    def of(self, number: int) -> slice:
        """The texels of a grid."""
        return slice(self.begin[number], self.begin[number + 1])


def together(some: Sequence[Texels]) -> Texels:
    """Return the texels of several surfaces as one."""
    first = np.cumsum([0] + [len(one.places) for one in some])
    cells = np.cumsum([0] + [one.grids[0].count for one in some])
    return Texels(
        grids=tuple(replace(one.grids[0], first=int(cell)) for one, cell in zip(some, cells[:-1], strict=True)),
        places=np.concatenate([one.places for one in some]),
        normals=np.concatenate([one.normals for one in some]),
        cells=np.concatenate([one.cells + cell for one, cell in zip(some, cells[:-1], strict=True)]),
        of_cell=np.concatenate([one.of_cell + begin for one, begin in zip(some, first[:-1], strict=True)]),
        begin=tuple(int(one) for one in first),
    )


def on_mesh(name: str, charts: Charts, vertices: Floats, normals: Floats, side: int = 0) -> Texels:
    """Return the texels over a mesh.

    Args:
        name: of the shape.
        charts: its texture coordinates, rasterised.
        vertices, normals: (V, 3) in world space.
        side: of its faces, as `TexelGrid` has it.
    """
    place, normal = _surface(charts, vertices, normals)
    number = np.cumsum(charts.covered.ravel()) - 1
    rows, columns = np.nonzero(charts.covered)
    return Texels(
        grids=(TexelGrid(name, 0, charts.covered.shape, None, side),),
        places=place[rows, columns],
        normals=normal[rows, columns],
        cells=np.flatnonzero(charts.covered),
        of_cell=number[_nearest(charts.covered)],
        begin=(0, len(rows)),
    )


def on_ground(name: str, height: float, reach: float, middle: tuple[float, float]) -> Texels:
    """Return the texels over a level plane, small under the object and large far off.

    Args:
        name: of the shape.
        height: of the plane.
        reach: half its side.
        middle: x and y of the object.
    """
    reach = min(reach, NEAR)
    rate = _rate(reach / (FINEST * GROUND / 2.0))
    scale = reach / math.sinh(rate)
    share = (np.arange(GROUND) + 0.5) * 2.0 / GROUND - 1.0
    along = scale * np.sinh(rate * share)
    y, x = np.meshgrid(along + middle[1], along + middle[0], indexing="ij")
    places = np.stack([x, y, np.full_like(x, height)], axis=-1).reshape(-1, 3).astype(np.float32)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0], dtype=np.float32), places.shape).copy()
    grid = TexelGrid(name, 0, (GROUND, GROUND), (middle[0], middle[1], scale, rate))
    every = np.arange(GROUND * GROUND)
    return Texels((grid,), places, up, every, every, (0, GROUND * GROUND))


def between(
    texels: Texels,
    charts: Charts,
    shape: tuple[int, int],
    vertices: Floats,
    normals: Floats,
    buried: npt.NDArray[np.bool_],
) -> Tensor:
    """Return the matrix (cells of a finer grid x texels of the first surface) that smooths light and looks it up.

    The weights are those of a joint bilateral filter (Petschnigg et al. 2004, section 4.1): near in the grid, near in
    space, and facing the same way.

    Args:
        texels: of the mesh alone, or with this mesh first.
        charts: as they were rasterised for its texels.
        shape: rows and columns of the finer grid.
        vertices, normals: (V, 3) in world space.
        buried: (n,) texels that lie inside of something, whose darkness does not count outside.
    """
    buried = buried & ~buried.all()
    fine = rasterised(charts.mesh, shape)
    place, normal = _surface(fine, vertices, normals)
    rows, columns = np.nonzero(fine.distance <= BORDER)
    at, facing = place[rows, columns], normal[rows, columns]
    side = math.sqrt(max(_side_squared(charts, vertices), 1e-12))
    tall, wide = charts.covered.shape
    y, x = (rows + 0.5) * tall / shape[0] - 0.5, (columns + 0.5) * wide / shape[1] - 0.5
    number = np.where(charts.covered, np.cumsum(charts.covered.ravel()).reshape(charts.covered.shape) - 1, -1)
    found, weights = [], []
    for down in range(-REACH, REACH + 1):
        for across in range(-REACH, REACH + 1):
            row, column = np.round(y).astype(int) + down, np.round(x).astype(int) + across
            inside = (row >= 0) & (row < tall) & (column >= 0) & (column < wide)
            one = np.where(inside, number[row.clip(0, tall - 1), column.clip(0, wide - 1)], -1)
            far = ((row - y) ** 2 + (column - x) ** 2) / (2.0 * WIDTH**2)
            apart = ((texels.places[one] - at) ** 2).sum(axis=1) / (2.0 * (SAME * side) ** 2)
            alike = np.clip((texels.normals[one] * facing).sum(axis=1), 0.0, 1.0) ** 8
            found.append(one)
            weights.append(np.where((one >= 0) & ~buried[one], np.exp(-far - apart) * alike, 0.0))
    chosen, weight = np.stack(found, axis=1), np.stack(weights, axis=1)
    lost = weight.sum(axis=1) < 1e-6
    chosen[lost, 0] = texels.of_cell[
        np.round(y[lost]).astype(int).clip(0, tall - 1) * wide + np.round(x[lost]).astype(int).clip(0, wide - 1)
    ]
    weight[lost, 0] = 1.0
    weight /= weight.sum(axis=1, keepdims=True)
    taken = weight > 1e-3
    cell = np.broadcast_to((rows * shape[1] + columns)[:, None], chosen.shape)[taken]
    size = shape[0] * shape[1], texels.begin[1]
    return by_rows(scipy.sparse.coo_matrix((weight[taken].astype(np.float32), (cell, chosen[taken])), size).tocsr())


def smoothed(ground: Texels, lit: npt.NDArray[np.bool_]) -> Tensor:
    """Return the matrix (cells x texels of a ground) that smooths its light, by the binomial of 5 x 5 texels.

    Those that see nothing of the sky lie under something. What is next to it takes no part of their darkness, which a
    look-up beside the edge would mix in.

    Args:
        ground: its texels alone.
        lit: (n,) which of them see the sky; none of them is the same as all.
    """
    side = ground.grids[0].shape[0]
    inside = (lit if lit.any() else ~lit).reshape(side, side)
    source = _nearest(inside)
    row, column = np.divmod(np.arange(side * side), side)
    chosen, weights = [], []
    for down, tall in zip(range(-2, 3), BINOMIAL, strict=True):
        for across, wide in zip(range(-2, 3), BINOMIAL, strict=True):
            y, x = row + down, column + across
            there = (y >= 0) & (y < side) & (x >= 0) & (x < side)
            at = y.clip(0, side - 1) * side + x.clip(0, side - 1)
            chosen.append(at)
            weights.append(tall * wide * (there & inside.ravel()[at]))
    places, weight = np.stack(chosen, axis=1), np.stack(weights, axis=1).astype(np.float64)
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    every = scipy.sparse.csr_matrix(
        (weight.ravel().astype(np.float32), places.ravel(), np.arange(side * side + 1) * 25), (side * side, side * side)
    )
    return by_rows(every[source])


def _surface(charts: Charts, vertices: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """Place and unit shading normal of each texel (h, w, 3), in world space."""
    corners = charts.mesh.faces[charts.face]
    place = np.einsum("hwk,hwkc->hwc", charts.weights, vertices[corners])
    normal = np.einsum("hwk,hwkc->hwc", charts.weights, normals[corners])
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return place.astype(np.float32), (normal / np.maximum(length, 1e-12)).astype(np.float32)


def _side_squared(charts: Charts, vertices: Floats) -> float:
    """The area of a texel in world space, the mean over those on the surface."""
    areas, mesh = charts.areas(), charts.mesh
    scale = np.ptp(vertices, axis=0).max() / max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-12)
    return float(areas[charts.covered].mean()) * float(scale) ** 2


def _nearest(covered: npt.NDArray[np.bool_]) -> Ints:
    """For each cell of a grid the nearest covered one, by their places in the flat grid."""
    # takes long to import
    from scipy import ndimage

    rows, columns = ndimage.distance_transform_edt(~covered, return_distances=False, return_indices=True)
    found: Ints = (rows * covered.shape[1] + columns).ravel()
    return found


def _rate(ratio: float) -> float:
    """The rate for which sinh(rate) / rate is a ratio, by bisection; small where that is 1 or less."""
    low, high = 1e-3, 20.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if math.sinh(middle) / middle < ratio else (low, middle)
    return low
