"""Lay texels over the surfaces of a scene, and compute the light on them.

What a texel sees of the others and of the environment is found once, by rays
(`trace_texel_rays`), and is a sparse matrix:

    E = S sky + F (reflectance E) / pi

    S: texels x cells of the environment, F: texels x texels

so that the irradiance E under any environment and for any texture takes a few sparse
products: radiosity (Goral et al. 1984). Light of small bright lamps in the map, which
few rays would meet, is found by rays towards them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.sparse
import torch
from torch import Tensor
from torch.nn import functional

from advsearch.extend import assets, prediction
from advsearch.predictors.surface_light.texel_rays import TexelGrid

BoolArray: TypeAlias = assets.BoolArray
Float32Array: TypeAlias = assets.Float32Array
Float64Array: TypeAlias = assets.Float64Array
IntArray: TypeAlias = assets.IntArray

GROUND_TEXELS = 112  # texels along each side of the ground
# Half the width of the ground that has texels, in object sizes. The ground beyond has
# the light of its border.
MAX_GROUND_REACH = 12.0
# Width of the ground's texels under the center of the object, in object sizes. It
# limits how sharp contact shadows are.
MIN_TEXEL_WIDTH = 0.01
FILTER_REACH = 2  # texels in each direction whose light counts at a point
GRID_SIGMA = 0.8  # standard deviation of the weight by distance in the grid, texels
SPACE_SIGMA = 1.5
"""Standard deviation of the weight by distance in space, in widths of a texel.

This weight excludes texels of another chart and those of the other wall of a cup.
"""

BINOMIAL = (1, 4, 6, 4, 1)


@dataclass(frozen=True, eq=False)
class LitTexels:
    """Texels that store light: the cells of all grids that lie on a surface.

    A cell that lies on no surface is no texel; it takes the light of the nearest one.
    """

    grids: tuple[TexelGrid, ...]  # grid of each surface, the searched one first
    positions: Float32Array  # (n, 3) positions in world space
    normals: Float32Array  # (n, 3)
    cell_of_texel: (
        IntArray  # (n,) index of each texel's cell, among the cells of all grids
    )
    texel_of_cell: IntArray  # (cells of all grids,) index of each cell's nearest texel
    # index of the first texel of each grid, followed by the number of all texels
    first_texels: tuple[int, ...]

    def select_grid(self, grid_index: int) -> slice:
        """Return the texels of a grid, by its index."""
        return slice(self.first_texels[grid_index], self.first_texels[grid_index + 1])


def join_texels(surfaces: Sequence[LitTexels]) -> LitTexels:
    """Join the texels of several surfaces, each with one grid.

    A grid has cells, and the cells on a chart of the mesh are its texels. Both are
    numbered on from surface to surface: the indices of a surface are shifted by the
    number of cells or texels of all surfaces before it.
    """
    # Indices of the first texel and the first cell of each surface. The last entries
    # are the total numbers, as in `LitTexels.first_texels`.
    texel_bounds = np.cumsum([0] + [len(texels.positions) for texels in surfaces])
    cell_bounds = np.cumsum([0] + [texels.grids[0].n_cells for texels in surfaces])
    grids = []
    cells = []
    texel_of_cell = []
    for texels, texel_offset, cell_offset in zip(
        surfaces, texel_bounds[:-1], cell_bounds[:-1], strict=True
    ):
        grids.append(replace(texels.grids[0], first_cell_index=int(cell_offset)))
        cells.append(texels.cell_of_texel + cell_offset)
        texel_of_cell.append(texels.texel_of_cell + texel_offset)
    return LitTexels(
        grids=tuple(grids),
        positions=np.concatenate([texels.positions for texels in surfaces]),
        normals=np.concatenate([texels.normals for texels in surfaces]),
        cell_of_texel=np.concatenate(cells),
        texel_of_cell=np.concatenate(texel_of_cell),
        first_texels=tuple(texel_bounds.tolist()),
    )


def make_mesh_texels(
    name: str,
    charts: prediction.Charts,
    vertices: Float32Array,
    normals: Float32Array,
    side: int = 0,
) -> LitTexels:
    """Return the texels over a mesh.

    Args:
        name: name of the mesh.
        charts: rasterized texture coordinates of the mesh.
        vertices: (V, 3) in world space.
        normals: (V, 3) in world space.
        side: side of the faces that the texels are on: 1 the front, -1 the back, 0
            both.
    """
    position, normal = _interpolate(charts, vertices, normals)
    # Texels are the covered cells, numbered row by row. This is the texel index of each
    # covered cell; for other cells the number means nothing.
    texel_of_covered = np.cumsum(charts.is_covered.ravel()) - 1
    nearest_covered = _find_nearest(charts.is_covered)
    rows, columns = np.nonzero(charts.is_covered)
    grid = TexelGrid(
        name,
        first_cell_index=0,
        shape=charts.is_covered.shape,
        ground_warp=None,
        face_side=side,
    )
    return LitTexels(
        grids=(grid,),
        positions=position[rows, columns],
        normals=normal[rows, columns],
        cell_of_texel=np.flatnonzero(charts.is_covered),
        texel_of_cell=texel_of_covered[nearest_covered],
        first_texels=(0, len(rows)),
    )


def make_ground_texels(
    name: str, height: float, half_width: float, center: tuple[float, float]
) -> LitTexels:
    """Return the texels over a level plane, small under the object and larger outwards.

    Along each axis of the grid, the position p from -1 to 1 lies at the distance
    `scale * sinh(rate * p)` from the center: texels are narrowest at the center, and
    grow with the distance from it.

    Args:
        name: name of the ground.
        height: height of the plane, in object sizes.
        half_width: half the plane's width; what is beyond `MAX_GROUND_REACH` gets no
            texels.
        center: x and y of the object's center.
    """
    half_width = min(half_width, MAX_GROUND_REACH)
    rate = _find_ground_rate(half_width)
    scale = half_width / math.sinh(rate)
    positions = _compute_ground_positions(rate, scale, height, center)
    up = np.array([0.0, 0.0, 1.0], dtype=np.float32)
    normals = np.broadcast_to(up, positions.shape).copy()
    grid = TexelGrid(
        name,
        first_cell_index=0,
        shape=(GROUND_TEXELS, GROUND_TEXELS),
        ground_warp=(center[0], center[1], scale, rate),
    )
    cells = np.arange(GROUND_TEXELS * GROUND_TEXELS)
    return LitTexels(
        grids=(grid,),
        positions=np.asarray(positions, np.float32),
        normals=normals,
        cell_of_texel=cells,  # every cell is a texel
        texel_of_cell=cells,
        first_texels=(0, GROUND_TEXELS * GROUND_TEXELS),
    )


def _find_ground_rate(half_width: float) -> float:
    """Return the rate for which the ground's texel at the center is `MIN_TEXEL_WIDTH`.

    The width of a texel is in proportion to the slope of the position. At the center
    the slope is scale * rate, and for equal texels it would be `half_width`, which is
    scale * sinh(rate). So the center's texel is narrower than an equal one by the ratio
    sinh(rate) / rate.
    """
    equal_width = 2.0 * half_width / GROUND_TEXELS
    return _find_warp_rate(equal_width / MIN_TEXEL_WIDTH)


def _compute_ground_positions(
    rate: float, scale: float, height: float, center: tuple[float, float]
) -> Float32Array:
    """Return the positions (n, 3) of the ground's texels; see `make_ground_texels`."""
    axis_position = (np.arange(GROUND_TEXELS) + 0.5) * 2.0 / GROUND_TEXELS - 1.0
    axis_offset = scale * np.sinh(rate * axis_position)
    y, x = np.meshgrid(axis_offset + center[1], axis_offset + center[0], indexing="ij")
    positions = np.stack([x, y, np.full_like(x, height)], axis=-1)
    return positions.reshape(-1, 3).astype(np.float32)


def _find_warp_rate(ratio: float) -> float:
    """Find the rate with sinh(rate) / rate = ratio, by bisection.

    For a ratio of 1 or less there is no such rate. Then the result is the lower bound,
    0.001, with which all texels of a grid have almost the same width.
    """
    lower = 1e-3
    upper = 20.0  # a ratio of twelve million
    for _ in range(60):  # halved so often, the interval is below rounding
        rate = 0.5 * (lower + upper)
        if math.sinh(rate) / rate < ratio:
            lower = rate
        else:
            upper = rate
    return lower


class _SurfacePoints(NamedTuple):
    """Points on a mesh.

    Attributes:
        row: (N,) their rows in the grid of the mesh's charts; the center of a cell has
            an integer.
        column: (N,) their columns, likewise.
        position: (N, 3) in world space.
        normal: (N, 3) at the points.
    """

    row: Float64Array
    column: Float64Array
    position: Float32Array
    normal: Float32Array


@dataclass(frozen=True, eq=False)
class _BilateralFilter:
    """A joint bilateral filter of light on a mesh.

    A texel's weight is the product of three: one falls with the distance in the grid,
    one with the distance in space, and one with the angle between the normals.

    Attributes:
        texels: texels of the mesh.
        charts: charts of the mesh.
        texel_width: texel width in world space.
        buried: (n,) texels that do not count.
    """

    texels: LitTexels
    charts: prediction.Charts
    texel_width: float
    buried: BoolArray

    def weigh_texels(self, points: _SurfacePoints) -> tuple[IntArray, Float64Array]:
        """Return the texels whose light counts at points, and their weights.

        Returns:
            Indices of texels, and weights that add up to 1 for each point, both
            (N, neighbors). Indices with the weight 0 mean nothing.
        """
        texel_index, weights = self.weigh_neighbors(points)
        # Points without any weight are changed in `texel_index` and `weights`.
        self.use_nearest_texel(points, texel_index, weights)
        weights /= weights.sum(axis=1, keepdims=True)
        return texel_index, weights

    def weigh_neighbors(self, points: _SurfacePoints) -> tuple[IntArray, Float64Array]:
        """Return the texels around points, and their weights.

        Returns:
            Indices of texels, -1 outside of the charts, and weights, both
            (N, neighbors).
        """
        texel_at = self._number_texels()
        n_rows, n_columns = texel_at.shape
        neighbors = []
        weights = []
        for row, column in _iter_neighbourhood(points.row, points.column):
            is_inside = (
                (row >= 0) & (row < n_rows) & (column >= 0) & (column < n_columns)
            )
            clipped_row = row.clip(0, n_rows - 1)
            clipped_column = column.clip(0, n_columns - 1)
            texel = np.where(is_inside, texel_at[clipped_row, clipped_column], -1)
            neighbors.append(texel)
            weights.append(self._weigh(points, row, column, texel))
        return np.stack(neighbors, axis=1), np.stack(weights, axis=1)

    def _number_texels(self) -> IntArray:
        """Return the index of the texel in each cell of the grid; -1 outside of charts.

        Texels are the covered cells, numbered row by row.
        """
        is_covered = self.charts.is_covered
        texel_at = np.cumsum(is_covered.ravel()).reshape(is_covered.shape) - 1
        return np.where(is_covered, texel_at, -1)

    def _weigh(
        self,
        points: _SurfacePoints,
        row: IntArray,
        column: IntArray,
        texel: IntArray,
    ) -> Float64Array:
        """Return the weights (N,) of the neighbors of points at rows and columns.

        A neighbor outside of the charts has the index -1, and gets the weight 0.
        """
        squared_distance = (row - points.row) ** 2 + (column - points.column) ** 2
        grid_distance = squared_distance / (2.0 * GRID_SIGMA**2)
        offset = self.texels.positions[texel] - points.position
        space_sigma = SPACE_SIGMA * self.texel_width
        distance = (offset**2).sum(axis=1) / (2.0 * space_sigma**2)
        cosine = (self.texels.normals[texel] * points.normal).sum(axis=1)
        # A neighbor round an edge, which faces elsewhere, has other light. The power
        # lets it count for half at 24 degrees, and for nothing at a right angle.
        similarity = np.clip(cosine, 0.0, 1.0) ** 8
        weight = np.exp(-grid_distance - distance) * similarity
        # The look-ups with -1 have read the last texel, which has no effect.
        is_used = (texel >= 0) & ~self.buried[texel]
        return np.where(is_used, weight, 0.0)

    def use_nearest_texel(
        self,
        points: _SurfacePoints,
        texel_index: IntArray,
        weights: Float64Array,
    ) -> None:
        """Give all the weight to the nearest texel if no neighbor of a point has any.

        Args:
            points: the points.
            texel_index: (N, neighbors) texels around the points; the first column is
                overwritten for points without weights.
            weights: (N, neighbors) their weights, likewise.
        """
        n_rows, n_columns = self.charts.is_covered.shape
        is_unweighted = weights.sum(axis=1) < 1e-6  # too little to divide by
        row = points.row[is_unweighted]
        column = points.column[is_unweighted]
        nearest_row = np.round(row).astype(int).clip(0, n_rows - 1)
        nearest_column = np.round(column).astype(int).clip(0, n_columns - 1)
        nearest_cell = nearest_row * n_columns + nearest_column
        texel_index[is_unweighted, 0] = self.texels.texel_of_cell[nearest_cell]
        weights[is_unweighted, 0] = 1.0


def make_lookup_matrix(
    texels: LitTexels,
    charts: prediction.Charts,
    shape: tuple[int, int],
    vertices: Float32Array,
    normals: Float32Array,
    buried: BoolArray,
) -> Tensor:
    """Return the matrix that smooths light and looks it up in a finer grid.

    The weights are those of a joint bilateral filter (Petschnigg et al. 2004, section
    4.1): near in the grid, near in space, facing the same direction.

    Args:
        texels: texels of the mesh; it is the only surface, or the first one.
        charts: charts of the mesh.
        shape: rows and columns of the finer grid.
        vertices, normals: (V, 3) in world space.
        buried: (n,) texels that lie inside something; their darkness does not count
            outside.

    Returns:
        Sparse, (cells of the finer grid, texels of the first surface).
    """
    if buried.all():
        # With no texel left there would be no light at all: so all of them count.
        buried = np.zeros_like(buried)
    fine_charts = prediction.rasterize_charts(charts.mesh, shape)
    # Cells up to `BORDER_TEXELS` outside of a chart count too: interpolation at the
    # chart's border reads them.
    is_near_chart = fine_charts.texels_to_covered <= prediction.BORDER_TEXELS
    points = _find_cell_points(fine_charts, is_near_chart, vertices, normals, charts)
    texel_width = _compute_texel_width(charts, vertices)
    bilateral_filter = _BilateralFilter(texels, charts, texel_width, buried)
    texel_index, weights = bilateral_filter.weigh_texels(points)
    _first, n_texels = texels.first_texels[:2]  # of the first surface
    size = (shape[0] * shape[1], n_texels)
    return _make_sparse(np.flatnonzero(is_near_chart), texel_index, weights, size)


def _find_cell_points(
    fine_charts: prediction.Charts,
    is_selected: BoolArray,
    vertices: Float32Array,
    normals: Float32Array,
    charts: prediction.Charts,
) -> _SurfacePoints:
    """Return the surface points of cells of a finer grid.

    Args:
        fine_charts: charts of the mesh in the finer grid.
        is_selected: (h, w) which cells of it.
        vertices, normals: (V, 3) in world space.
        charts: charts in whose grid the points have their rows and columns.
    """
    position, normal = _interpolate(fine_charts, vertices, normals)
    rows, columns = np.nonzero(is_selected)
    n_fine_rows, n_fine_columns = is_selected.shape
    n_rows, n_columns = charts.is_covered.shape
    return _SurfacePoints(
        row=(rows + 0.5) * n_rows / n_fine_rows - 0.5,
        column=(columns + 0.5) * n_columns / n_fine_columns - 0.5,
        position=position[rows, columns],
        normal=normal[rows, columns],
    )


def _make_sparse(
    fine_cell: IntArray,
    texel_index: IntArray,
    weights: Float64Array,
    size: tuple[int, int],
) -> Tensor:
    """Return a sparse matrix of weights, without those of 0.001 and less.

    So small weights change nothing that is visible, and would make the matrix larger.

    Args:
        fine_cell: (N,) row of the matrix for each row of the weights.
        texel_index: (N, neighbours) its columns.
        weights: (N, neighbours) its entries.
        size: rows and columns of the matrix.
    """
    is_entry = weights > 1e-3
    cell = np.broadcast_to(fine_cell[:, None], texel_index.shape)[is_entry]
    entries = (weights[is_entry].astype(np.float32), (cell, texel_index[is_entry]))
    return prediction.to_torch_csr(scipy.sparse.coo_matrix(entries, size).tocsr())


def _compute_texel_width(charts: prediction.Charts, vertices: Float32Array) -> float:
    """Return the mean width of a texel in world space.

    `vertices` are (V, 3) in world space, while the charts' areas are in the mesh's own
    coordinates. The mesh is scaled evenly, by the ratio of the largest extents.
    """
    extent = float(np.ptp(charts.mesh.vertices, axis=0).max())
    scale = np.ptp(vertices, axis=0).max() / max(extent, 1e-12)
    area = float(charts.compute_areas()[charts.is_covered].mean()) * float(scale) ** 2
    return math.sqrt(max(area, 1e-12))


def _iter_neighbourhood(
    y: Float64Array, x: Float64Array
) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield rows and columns (N,) of the neighbours of positions in a grid.

    A position's neighbours are the texels up to `FILTER_REACH` from the texel nearest
    to it. Each step yields one neighbour of all positions.

    Args:
        y: (N,) rows of the positions; the center of a texel has an integer.
        x: (N,) columns of the positions, likewise.
    """
    nearest_row = np.round(y).astype(int)
    nearest_column = np.round(x).astype(int)
    for row_offset in range(-FILTER_REACH, FILTER_REACH + 1):
        for column_offset in range(-FILTER_REACH, FILTER_REACH + 1):
            yield nearest_row + row_offset, nearest_column + column_offset


def make_smoothing_matrix(ground: LitTexels, sees_sky: BoolArray) -> Tensor:
    """Return the matrix that smooths the light of a ground, by 5 x 5 binomial weights.

    A texel that sees nothing of the sky lies under something, and is dark. It does not
    darken its neighbours: it gets the smoothed light of the nearest texel that sees the
    sky.

    Args:
        ground: texels of a ground, of whose grid every cell is a texel.
        sees_sky: (n,) whether each sees something of the sky; if none does, all count.

    Returns:
        Sparse, (texels, texels).
    """
    width, _height = ground.grids[0].shape  # the grid of a ground is square
    if not sees_sky.any():
        sees_sky = np.ones_like(sees_sky)
    is_used = sees_sky.reshape(width, width)
    nearest_used = _find_nearest(is_used)
    weights = _make_binomial_weights(is_used)
    # The row of a texel that is not used is that of the nearest one that is.
    rows = weights.astype(np.float32)[nearest_used]
    return prediction.to_torch_csr(rows)


def _make_binomial_weights(is_used: BoolArray) -> scipy.sparse.csr_array:
    """Return the weights (n, n) of used texels (w, w) for each texel.

    Rows sum to 1, or to 0 if no texel nearby is used.
    """
    width = len(is_used)
    # along one axis: each texel and two neighbours on each side
    axis_weights = scipy.sparse.diags_array(
        BINOMIAL, offsets=range(-2, 3), shape=(width, width), dtype=np.float64
    )
    # The Kronecker product weighs along both axes. Columns of texels that are not used
    # become 0, and then each row is divided by its sum.
    weights = scipy.sparse.csr_array(
        scipy.sparse.kron(axis_weights, axis_weights)
        @ scipy.sparse.diags_array(is_used.ravel().astype(float))
    )
    entries_per_row = np.diff(weights.indptr)
    row_sum_of_entry = np.repeat(weights.sum(axis=1), entries_per_row)
    weights.data /= np.maximum(row_sum_of_entry, 1e-12)
    return weights


def _interpolate(
    charts: prediction.Charts,
    vertices: Float32Array,
    normals: Float32Array,
) -> tuple[Float32Array, Float32Array]:
    """Return the position and the unit normal (h, w, 3) of the surface in each cell.

    Args:
        charts: face and barycentric weights of each cell.
        vertices: (V, 3) in world space.
        normals: (V, 3) in world space.
    """
    corners = charts.mesh.faces[charts.face_index]
    position = np.einsum("hwk,hwkc->hwc", charts.weights, vertices[corners])
    normal = np.einsum("hwk,hwkc->hwc", charts.weights, normals[corners])
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    unit_normal = normal / np.maximum(length, 1e-12)
    return position.astype(np.float32), unit_normal.astype(np.float32)


def _find_nearest(covered: BoolArray) -> IntArray:
    """Return for each cell (h * w,) the flat index of the nearest covered cell.

    A covered cell is its own nearest.
    """
    # takes long to import
    from scipy import ndimage

    rows, columns = ndimage.distance_transform_edt(
        ~covered, return_distances=False, return_indices=True
    )
    nearest: IntArray = (rows * covered.shape[1] + columns).ravel()
    return nearest


SKY_SHAPE = (32, 64)  # rows and columns of the cells of the environment
BLUR_WIDTHS = (
    math.radians(3.0),
    math.radians(6.0),
    math.radians(12.0),
    math.radians(24.0),
    math.radians(48.0),
)
"""Angles by which the environment is blurred for gloss, radians."""
BLURRED_SHAPE = (64, 128)  # rows and columns of the blurred maps
# Light of the environment above this multiple of the mean luminance is hot: texels
# send rays towards it.
HOT_FACTOR = 8.0
HOT_RAYS = 48  # rays from each texel towards hot light
HOT_LATTICE = (7, 11)
"""Steps along rows and columns of a lattice of `HOT_RAYS` points.

11 / 7 is 29 modulo 48, next to the golden ratio, and both coordinates are even.
"""
# If no more than this fraction of all light is hot, it is left to the cells.
MIN_HOT_FRACTION = 0.02
LUMINANCE_WEIGHTS = torch.tensor([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True, eq=False)
class SkyLight:
    """An environment's light, prepared for look-ups."""

    padded: Tensor  # (H, W + 2, 3) map, with a copied column at each end
    # (rows x columns, 3) mean radiance of each cell of `SKY_SHAPE`, without hot light
    cell_radiance: Tensor
    coarse_map: Tensor  # (h, w, 3) all light, in the shape `BLURRED_SHAPE`
    hot_directions: Tensor  # (k, 3) unit directions of hot light, in the map's axes
    hot_light: Tensor  # (k, 3) radiance times solid angle from each of them


def prepare_sky(padded: Tensor) -> SkyLight:
    """Prepare an environment's map (H, W + 2, 3) for look-ups.

    A texel's light above `HOT_FACTOR` times the mean, such as that of the sun, is hot.
    It gets rays of its own, since the coarse cells of the sky would blur its shadows.
    The rest stays in the cells (`cell_radiance`). If no more than `MIN_HOT_FRACTION` of
    all light is hot, all of it stays there. `coarse_map`, which gloss reflects, has all
    light in any case.
    """
    radiance = padded[:, 1:-1].detach()
    sine = _compute_texel_sines(radiance.shape[0], radiance.shape[1])
    hot_fraction = _find_hot_fraction(radiance, sine)
    hot_directions = torch.zeros(0, 3)
    hot_light = torch.zeros(0, 3)
    remaining = radiance
    if hot_fraction is not None:
        hot_radiance = radiance * hot_fraction[..., None]
        hot_power = hot_fraction * (radiance @ LUMINANCE_WEIGHTS) * sine
        hot_directions, hot_light = _sample_hot(hot_radiance, hot_power)
        remaining = radiance * (1.0 - hot_fraction[..., None])
    return SkyLight(
        padded=padded,
        cell_radiance=_average_cells(remaining, sine, SKY_SHAPE).reshape(-1, 3),
        coarse_map=_average_cells(radiance, sine, BLURRED_SHAPE),
        hot_directions=hot_directions,
        hot_light=hot_light,
    )


def _find_hot_fraction(radiance: Tensor, sine: Tensor) -> Tensor | None:
    """Return the fraction (H, W) of each texel's light that is above the limit.

    The result is None if no more than `MIN_HOT_FRACTION` of all light is.

    Args:
        radiance: (H, W, 3) radiance of the texels.
        sine: (H, W) their solid angles, in any unit.
    """
    luminance = radiance @ LUMINANCE_WEIGHTS
    mean_luminance = float((luminance * sine).sum() / sine.sum())
    hot_fraction = (
        1.0 - HOT_FACTOR * mean_luminance / luminance.clamp_min(1e-12)
    ).clamp_min(0.0)
    hot_power = float((hot_fraction * luminance * sine).sum())
    if hot_power > MIN_HOT_FRACTION * mean_luminance * float(sine.sum()):
        return hot_fraction
    return None


def _compute_texel_sines(n_rows: int, n_columns: int) -> Tensor:
    """Return the solid angles of a map's texels (rows, columns), in proportion.

    The solid angle of a texel is proportional to the sine of its polar angle. The
    texels of the first and last row are centered at the poles. At a pole the sine is 0,
    but the texel there reaches half a texel from the pole. So it gets the sine at a
    quarter of a texel, in the middle of that half.
    """
    polar = torch.linspace(0.0, math.pi, n_rows)
    sine = polar.sin().clamp_min(math.sin(0.25 * math.pi / n_rows))
    return sine[:, None].expand(n_rows, n_columns)


def _sample_hot(radiance: Tensor, power: Tensor) -> tuple[Tensor, Tensor]:
    """Sample directions towards hot light, and the light that comes from each.

    Hot texels get rays in proportion to their power. The map is interpolated linearly
    between its texels, so that the light of one texel covers two texels' width, with a
    weight that falls linearly to 0 (a tent). Its rays are spread over the tent by a
    lattice (`HOT_LATTICE`); so even a sun of one texel has a soft shadow.

    Args:
        radiance: (H, W, 3) radiance of the hot light.
        power: (H, W) luminance times solid angle, in units of the solid angle of a
            texel at the horizon.

    Returns:
        (k, 3) unit directions in the map's axes, and (k, 3) radiance times solid angle;
        k is `HOT_RAYS`. All rays carry the same luminance, since brighter texels get
        more of them.
    """
    n_rows, n_columns = power.shape
    cumulative = torch.cumsum(power.double().reshape(-1), 0)
    index = torch.arange(HOT_RAYS, dtype=torch.float64)
    # even steps through the cumulative power: half of the power gets half of the rays
    texel = torch.searchsorted(
        cumulative, (index + 0.5) / HOT_RAYS * cumulative[-1]
    ).clamp_max(power.numel() - 1)
    row = texel // n_columns
    column = texel % n_columns
    # The steps of the lattice are taken modulo its size, and scaled to [0, 1].
    row_offset = _to_tent((index * HOT_LATTICE[0] % HOT_RAYS + 0.5) / HOT_RAYS)
    column_offset = _to_tent((index * HOT_LATTICE[1] % HOT_RAYS + 0.5) / HOT_RAYS)
    # The first and last row are centered at the poles: row i has the polar angle
    # i pi / (n_rows - 1). A row begins at azimuth 0 with the left edge of its first
    # texel, whose center is 0.5 columns further.
    polar = ((row + row_offset) * (math.pi / (n_rows - 1))).clamp(0.0, math.pi)
    azimuth = (column + 0.5 + column_offset) * (2.0 * math.pi / n_columns)
    # solid angle of a texel at the horizon, in steradians
    solid_angle = math.pi / (n_rows - 1) * 2.0 * math.pi / n_columns
    power_per_ray = float(power.sum()) * solid_angle / HOT_RAYS
    unit_color = _normalize_luminance(radiance[row, column])
    return _to_direction(polar, azimuth, dim=1).float(), unit_color * power_per_ray


def _normalize_luminance(color: Tensor) -> Tensor:
    """Return colors (N, 3) scaled to a luminance of 1; black stays black."""
    return color / (color @ LUMINANCE_WEIGHTS)[:, None].clamp_min(1e-12)


def _to_tent(uniform: Tensor) -> Tensor:
    """Map numbers in [0, 1] to [-1, 1] with the density of a tent (inverse CDF)."""
    return torch.where(
        uniform < 0.5,
        (2.0 * uniform).sqrt() - 1.0,
        1.0 - (2.0 - 2.0 * uniform).sqrt(),
    )


def _to_direction(polar: Tensor, azimuth: Tensor, dim: int) -> Tensor:
    """Return unit directions in the axes of the environment's map.

    `polar` is the angle from straight up; the axes are stacked as dimension `dim`.
    """
    x = polar.sin() * azimuth.sin()
    z = -polar.sin() * azimuth.cos()
    return torch.stack([x, polar.cos(), z], dim=dim)


def _average_cells(
    radiance: Tensor, solid_angle: Tensor, size: tuple[int, int]
) -> Tensor:
    """Return the mean radiance in each cell of a coarser map, weighted by solid angle.

    Args:
        radiance: (H, W, 3) map.
        solid_angle: (H, W) solid angles of its texels, in any unit.
        size: rows and columns of the result (*size, 3).
    """
    # The solid angles are pooled as a fourth channel.
    weight = solid_angle[..., None]
    weighted = torch.cat([radiance * weight, weight], dim=-1)
    pooled = functional.adaptive_avg_pool2d(weighted.permute(2, 0, 1)[None], size)
    pooled = pooled[0].permute(1, 2, 0)
    return pooled[..., :3] / pooled[..., 3:].clamp_min(1e-12)


def blur_map(radiance: Tensor) -> Tensor:
    """Blur a map (h, w, 3) by each of `BLUR_WIDTHS`.

    The blur is a Gaussian over two directions: first along columns, over the polar
    angle, then along rows. A width is the root mean square of the angle by which light
    is spread, in radians. Each of the two directions has half of its square as the
    variance, so that sigma is the width / sqrt(2).

    Returns:
        (n_widths, h, w, 3) one blurred map for each width.
    """
    maps = []
    for blur_width in BLUR_WIDTHS:
        sigma = blur_width / math.sqrt(2.0)
        maps.append(_blur_rows(_blur_columns(radiance, sigma), sigma))
    return torch.stack(maps).clamp_min(0.0)


def _compute_polar_angles(n_rows: int) -> Tensor:
    """Return the polar angles (h,) of the centers of a map's rows, radians."""
    return (torch.arange(n_rows) + 0.5) * math.pi / n_rows


def _blur_columns(radiance: Tensor, sigma: float) -> Tensor:
    """Blur a map (h, w, 3) along its columns, by an angle in radians.

    Each row is weighted by its solid angle, which is small near the poles.
    """
    polar = _compute_polar_angles(len(radiance))
    exponent = (polar[:, None] - polar[None, :]).square() / (2.0 * sigma**2)
    column_kernel = torch.exp(-exponent) * polar.sin()[None, :]
    column_kernel = column_kernel / column_kernel.sum(dim=1, keepdim=True)
    blurred = column_kernel @ radiance.reshape(len(radiance), -1)
    return blurred.reshape(len(radiance), -1, 3)


def _blur_rows(radiance: Tensor, sigma: float) -> Tensor:
    """Blur a map (h, w, 3) along its rows, by an angle in radians.

    A row is periodic, so that it is blurred in the frequency domain: there the factor
    is exp(-(frequency s)^2 / 2), where s is the sigma of the azimuth. Near a pole, an
    angle sigma along the row is a large azimuth: s = sigma / sine.
    """
    n_columns = radiance.shape[1]
    polar = _compute_polar_angles(len(radiance))
    frequency = torch.arange(n_columns // 2 + 1)
    row_filter = torch.exp(
        -0.5 * (frequency[None, :] * sigma / polar.sin()[:, None]).square()
    )
    spectrum = torch.fft.rfft(radiance, dim=1) * row_filter[..., None]
    blurred: Tensor = torch.fft.irfft(spectrum, n=n_columns, dim=1)
    return blurred


def compute_directions(size: tuple[int, int]) -> Tensor:
    """Return the unit directions (h, w, 3) of the cells of a map, in its own axes."""
    n_rows, n_columns = size
    polar = (torch.arange(n_rows) + 0.5) * math.pi / n_rows
    azimuth = (torch.arange(n_columns) + 0.5) * 2.0 * math.pi / n_columns
    polar, azimuth = torch.meshgrid(polar, azimuth, indexing="ij")
    return _to_direction(polar, azimuth, dim=-1)


def compute_irradiance(
    view_matrices: tuple[Tensor, Tensor],
    sky: SkyLight,
    hot_cosines: Tensor | None,
    reflectance: Tensor,
    bounces: int,
) -> Tensor:
    """Return the irradiance (n, 3) of texels, with light between them.

    Each bounce adds the light that diffuse texels with the irradiance so far reflect,
    `reflectance * irradiance / pi`, to the light of the sky.

    Args:
        view_matrices: two sparse matrices from radiance to irradiance: one from the
            sky's cells (n, cells), one from the texels to each other (n, n).
        sky: the environment.
        hot_cosines: (n, k) cosines towards hot light, 0 where it is hidden; None if
            nothing is hot.
        reflectance: (n, 3) reflectance of the texels.
        bounces: how often light goes from texel to texel.
    """
    sky_view, texel_view = view_matrices
    from_sky = sky_view @ sky.cell_radiance
    if hot_cosines is not None:
        # Radiance times solid angle times cosine is an irradiance.
        from_sky = from_sky + hot_cosines @ sky.hot_light
    irradiance = from_sky
    for _ in range(bounces):
        irradiance = from_sky + texel_view @ (reflectance * irradiance / math.pi)
    return irradiance


def make_view_matrices(
    met_cells: npt.NDArray[np.int32], texel_of_cell: IntArray, n_texels: int
) -> tuple[Tensor, Tensor]:
    """Return the matrices from radiance to irradiance, by what the rays of texels met.

    They are sparse: from the sky's cells (n, cells), and from texels (n, n_texels). The
    density of a texel's rays is proportional to the cosine at its normal, so that its
    irradiance is pi times the mean radiance of what they meet.

    Args:
        met_cells: (n, rays) what each ray met. Below `len(texel_of_cell)` it is a cell
            of the grids; from there on a cell of the sky; and a negative value is
            something that does not shine.
        texel_of_cell: for each cell of the grids, the index of the texel whose light it
            has; a grid also has cells that are no texels.
        n_texels: number of texels of all grids.
    """
    n_cells = len(texel_of_cell)
    is_sky = met_cells >= n_cells
    is_texel = (met_cells >= 0) & (met_cells < n_cells)
    sky_column = met_cells[is_sky] - n_cells
    sky_view = _make_ray_matrix(is_sky, sky_column, SKY_SHAPE[0] * SKY_SHAPE[1])
    texel_column = texel_of_cell[met_cells[is_texel]]
    return sky_view, _make_ray_matrix(is_texel, texel_column, n_texels)


def _make_ray_matrix(
    is_entry: BoolArray, column: npt.NDArray[np.integer[Any]], n_columns: int
) -> Tensor:
    """Return a sparse matrix (n, columns) in which selected rays count pi / n_rays.

    Args:
        is_entry: (n, rays) which rays of each texel are selected.
        column: for each of these, texel by texel, its column.
        n_columns: number of columns.
    """
    n_texels, n_rays = is_entry.shape
    row = np.repeat(np.arange(n_texels), n_rays)
    values = np.full(len(column), math.pi / n_rays, dtype=np.float32)
    entries = (values, (row[is_entry.ravel()], column))
    size = (n_texels, n_columns)
    return prediction.to_torch_csr(scipy.sparse.coo_matrix(entries, size).tocsr())


def look_up_environment(padded: Tensor, directions: Tensor) -> Tensor:
    """Return the radiance (n, 3) of an environment in n directions.

    The nearest texel counts, without interpolation. In the map's axes y is up. The
    texels of the first row are centered straight up, those of the last straight down;
    the first column begins at azimuth 0 with its left edge.

    Args:
        padded: (H, W + 2, 3) map, with a copied column at each end.
        directions: (n, 3) in the map's axes, of any length.
    """
    n_rows = padded.shape[0]
    n_columns = padded.shape[1] - 2
    x, y, z = (directions / directions.norm(dim=1, keepdim=True)).unbind(dim=1)
    turn = torch.remainder(torch.atan2(x, -z) / (2.0 * math.pi), 1.0)  # 0 to 1
    row = (torch.acos(y.clamp(-1.0, 1.0)) * ((n_rows - 1) / math.pi)).round().long()
    column = (turn * n_columns).long().clamp_max(n_columns - 1)
    return padded[row, 1 + column]  # column 0 is a copy of the last
