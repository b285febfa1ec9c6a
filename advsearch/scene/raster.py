"""Rasterization of triangles, for silhouettes, texture charts and baked textures.

Each triangle is divided into its spans in the rows that it crosses, and each span into
pixels.

`Charts` has the position on a mesh of each texel of its texture: the UV charts
rasterized at the texel centers. Row 0 is at v = 1, as in all our textures. A texel
belongs to the triangle that contains its center. A texel outside of all charts has the
values of the nearest covered texel, so that bilinear look-ups at a chart's border read
values that continue the chart.

`MeshSurface` finds points on a mesh by rays, and the connected region around a point,
for patches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from advsearch.errors import InputError
from advsearch.scene.assets import (
    BoolArray,
    Float32Array,
    Float64Array,
    IntArray,
    Mesh,
    compute_area_vectors,
)
from advsearch.scene.importing.geometry import find_components

# Barycentric weight by which a pixel's center may miss a triangle, so that shared edges
# leave no gaps.
TOLERANCE = 1e-6
# Pixels by which a center may miss a triangle and still be a candidate.
PIXEL_TOLERANCE = 1e-4


def rasterize_triangles(
    corners: Float64Array, shape: tuple[int, int], tolerance: float = TOLERANCE
) -> tuple[IntArray, IntArray, IntArray, Float64Array]:
    """List the pixels of a raster whose centers lie in triangles.

    Args:
        corners: (F, 3, 2) columns and rows of the triangles' corners, integers at pixel
            centers; triangles without area cover nothing.
        shape: height and width of the raster.
        tolerance: largest barycentric weight by which a center may miss a triangle.

    Returns:
        For each pixel of each triangle, triangle by triangle, the triangle, row and
        column (N,), and the corners' barycentric weights (N, 3).
    """
    # Candidates may miss a triangle by more than the tolerance, so that rounding leaves
    # none out. Those whose weights are too negative are removed below.
    face, row, column = find_candidate_pixels(corners, shape, 10.0 * PIXEL_TOLERANCE)
    weights = compute_barycentric(corners[face], row, column)
    is_inside = (weights >= -tolerance).all(axis=1)
    return face[is_inside], row[is_inside], column[is_inside], weights[is_inside]


def find_candidate_pixels(
    corners: Float64Array, shape: tuple[int, int], tolerance: float = PIXEL_TOLERANCE
) -> tuple[IntArray, IntArray, IntArray]:
    """List the pixels whose centers lie in triangles, or almost.

    A triangle without area has pixels, too: those along its line.

    Args:
        corners: (F, 3, 2) columns and rows of the triangles' corners, integers at pixel
            centers.
        shape: height and width of the raster.
        tolerance: distance, in pixels along a row or column, by which a center may miss
            a triangle.

    Returns:
        Triangle, row and column (N,).
    """
    y = corners[..., 1]
    height, width = shape
    # (S,) triangle and row of each span, the part of a triangle in one row of pixels
    face, row = _list_integers_within(y.min(axis=1), y.max(axis=1), height, tolerance)
    left, right = _cross_rows(corners[face], row, tolerance)
    # (N,) span and column of each pixel
    span, column = _list_integers_within(left, right, width, tolerance)
    return face[span], row[span], column


def find_read_texels(corners: Float64Array, shape: tuple[int, int]) -> BoolArray:
    """Return the texels (h, w) that bilinear look-ups in triangles read.

    A look-up at a point reads the four texels around it: those at its row and column
    rounded down, and the next ones. The square between the centers of these four is
    called a cell here. First the cells that a triangle touches are found, then the four
    texels of each. The texture repeats at its border.

    Args:
        corners: (F, 3, 2) column and row of each corner, integers at texel centers, and
            at most half a texel outside of the texture.
        shape: height and width of the texture.
    """
    height, width = shape
    cell_row, cell_column = _find_touched_cells(corners, shape)
    is_read = np.zeros(shape, np.bool_)
    # Cell i is between the texels i - 1 and i. The remainder wraps texels beyond the
    # border to the opposite one.
    for read_row in (cell_row - 1, cell_row):
        for read_column in (cell_column - 1, cell_column):
            is_read[read_row % height, read_column % width] = True
    return is_read


def _find_touched_cells(
    corners: Float64Array, shape: tuple[int, int]
) -> tuple[IntArray, IntArray]:
    """Return the row and the column of each cell that a triangle touches.

    Cell i of a row is between the centers of the texels i - 1 and i. A row of n texels
    has n + 1 cells, 0 to n: the first is between the texels -1 and 0, and the last
    between n - 1 and n. Since the texture repeats, the texel -1 is the texel n - 1, and
    the texel n is the texel 0.

    Args:
        corners: (F, 3, 2) column and row of each corner, integers at texel centers.
        shape: height and width of the texture.
    """
    height, width = shape
    # Cell i covers the texel coordinates i - 1 to i. After adding 1 it covers i to i +
    # 1, so that a point's cell is its coordinate rounded down.
    cell_corners = corners + 1.0
    # (F,) first and last row of cells that each triangle touches
    first_row = np.floor(cell_corners[..., 1].min(axis=1) - PIXEL_TOLERANCE)
    last_row = np.floor(cell_corners[..., 1].max(axis=1) + PIXEL_TOLERANCE)
    # (S,) triangle and row of each strip, the part of a triangle in one row of cells
    face, row = _list_integers_within(first_row, last_row, height + 1, tolerance=0.0)
    left, right = _find_column_span(cell_corners[face], row)
    first_column = np.floor(left - PIXEL_TOLERANCE)
    last_column = np.floor(right + PIXEL_TOLERANCE)
    # (N,) strip and column of each cell that a strip touches
    strip, column = _list_integers_within(
        first_column, last_column, width + 1, tolerance=0.0
    )
    return row[strip], column


def _find_column_span(
    corners: Float64Array, row: IntArray
) -> tuple[Float64Array, Float64Array]:
    """Return the smallest and largest column of triangles between two rows.

    Each triangle (N, 3, 2) is cut to the strip between its row (N,) and the next. The
    smallest and the largest column of the part that remains are at a corner inside the
    strip, or where an edge crosses one of the two rows.

    Returns:
        (N,) smallest and (N,) largest column; (inf, -inf) where nothing is left.
    """
    x = corners[..., 0]
    is_in_strip = _are_in_strips(corners[..., 1], row)
    left = np.where(is_in_strip, x, np.inf).min(axis=1)
    right = np.where(is_in_strip, x, -np.inf).max(axis=1)
    for border_row in (row, row + 1):
        first_column, last_column = _cross_rows(corners, border_row, PIXEL_TOLERANCE)
        # The range of a triangle that does not cross the row is empty.
        crosses = first_column <= last_column
        left = np.where(crosses, np.minimum(left, first_column), left)
        right = np.where(crosses, np.maximum(right, last_column), right)
    return left, right


def _are_in_strips(y: Float64Array, row: IntArray) -> BoolArray:
    """Return whether corners (N, 3) are between the row (N,) of a strip and the next.

    Args:
        y: rows of the corners.
        row: first row of each strip.
    """
    strip_start = row[:, None]
    strip_end = strip_start + 1
    is_after_start = y >= strip_start - PIXEL_TOLERANCE
    return np.asarray(is_after_start & (y <= strip_end + PIXEL_TOLERANCE))


def compute_barycentric(
    corners: Float64Array, row: IntArray | Float64Array, column: IntArray | Float64Array
) -> Float64Array:
    """Return the barycentric weights (N, 3) of points in triangles (N, 3, 2).

    A corner's weight is the area between the point and the opposite side, as a fraction
    of the triangle's. Inside the triangle all three weights are in [0, 1]; outside at
    least one is negative. The weights in a triangle without area are NaN or infinite.

    Args:
        corners: (N, 3, 2) columns and rows of the corners.
        row: (N,) rows of the points.
        column: (N,) columns of the points.
    """
    ax, ay = corners[:, 0].T
    bx, by = corners[:, 1].T
    cx, cy = corners[:, 2].T
    with np.errstate(all="ignore"):
        scale = 1.0 / compute_doubled_areas(corners)
        weight_b = ((column - ax) * (cy - ay) - (row - ay) * (cx - ax)) * scale
        weight_c = ((bx - ax) * (row - ay) - (by - ay) * (column - ax)) * scale
        return np.stack([1.0 - weight_b - weight_c, weight_b, weight_c], axis=-1)


def compute_doubled_areas(corners: Float64Array) -> Float64Array:
    """Return twice the signed area (F,) of flat triangles (F, 3, 2)."""
    a = corners[:, 1] - corners[:, 0]
    b = corners[:, 2] - corners[:, 0]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _list_integers_within(
    lower: Float64Array, upper: Float64Array, size: int, tolerance: float
) -> tuple[IntArray, IntArray]:
    """List the integers in each of N intervals, one interval after the other.

    Args:
        lower: (N,) lower bounds of the intervals.
        upper: (N,) upper bounds. An interval whose upper bound is below its lower bound
            is empty.
        size: integers outside of [0, size - 1] are left out.
        tolerance: distance by which each interval is widened on both sides.

    Returns:
        For each integer the index of its interval (K,), and the integer (K,).
    """
    first_integer = np.maximum(np.ceil(lower - tolerance), 0.0).astype(np.int64)
    last_integer = np.minimum(np.floor(upper + tolerance), size - 1.0).astype(np.int64)
    counts = np.maximum(last_integer - first_integer + 1, 0)
    interval = np.repeat(np.arange(len(counts)), counts)
    # position of each interval's first integer in the list
    start = np.cumsum(counts) - counts
    integer = first_integer[interval] + np.arange(len(interval)) - start[interval]
    return interval, integer


def _cross_rows(
    corners: Float64Array, row: IntArray, tolerance: float
) -> tuple[Float64Array, Float64Array]:
    """Return the first and last column (N,) of triangles (N, 3, 2) on rows (N,).

    These are the columns at which the triangle's edges cross its row. An edge that ends
    at most `tolerance` before the row counts as crossing it at that end. Level edges
    are left out, since the other two edges have the same ends. If no edge crosses the
    row, the range is empty: the first column is 0 and the last -1.
    """
    left = np.full(len(row), np.inf)
    right = np.full(len(row), -np.inf)
    for start_corner, end_corner in ((0, 1), (1, 2), (2, 0)):
        x, crosses = _cross_edge(
            corners[:, start_corner], corners[:, end_corner], row, tolerance
        )
        left = np.where(crosses, np.minimum(left, x), left)
        right = np.where(crosses, np.maximum(right, x), right)
    is_empty = left > right
    return np.where(is_empty, 0.0, left), np.where(is_empty, -1.0, right)


def _cross_edge(
    start: Float64Array, end: Float64Array, row: IntArray, tolerance: float
) -> tuple[Float64Array, BoolArray]:
    """Return the column (N,) at which each edge crosses its row, and whether it does.

    Args:
        start: (N, 2) column and row of the edge's first end.
        end: (N, 2) column and row of its other end.
        row: (N,) the row to cross.
        tolerance: distance by which an edge may end before the row.
    """
    x0, y0 = start.T
    x1, y1 = end.T
    rise = y1 - y0
    is_level = rise == 0.0
    # Fraction of the edge at which the row is. It is clipped to the edge's ends, since
    # the row may be beyond them by up to the tolerance.
    fraction = np.clip((row - y0) / np.where(is_level, 1.0, rise), 0.0, 1.0)
    crosses = (
        (np.minimum(y0, y1) - tolerance <= row)
        & (row <= np.maximum(y0, y1) + tolerance)
        & ~is_level
    )
    return x0 + fraction * (x1 - x0), np.asarray(crosses)


# Distance from a chart, in texels, up to which texels belong to it: a bilinear look-up
# inside of the chart reads one texel beyond it.
BORDER_TEXELS = 2.0


@dataclass(frozen=True, eq=False)
class Charts:
    """The rasterized charts of a mesh."""

    mesh: Mesh
    # (h, w) index of the face that contains each texel's center. A texel outside of all
    # charts has the face of the nearest covered texel.
    face_index: IntArray
    # (h, w, 3) barycentric weights of the face's three corners, at least 0, adding up
    # to 1
    weights: Float64Array
    is_covered: BoolArray  # (h, w) whether the texel's center is in a chart
    texels_to_covered: (
        Float64Array  # (h, w) texels to the nearest covered texel, which have 0
    )

    @property
    def is_readable(self) -> BoolArray:
        """(h, w) whether a look-up on the surface can read the texel.

        Such a texel is in a chart, or at most `BORDER_TEXELS` texels from one.
        """
        return np.asarray(self.texels_to_covered <= BORDER_TEXELS)

    def compute_positions(self) -> Float32Array:
        """Return (h, w, 3) positions in mesh coordinates."""
        corners = self.mesh.vertices[self.mesh.faces[self.face_index]]
        return np.asarray(
            np.einsum("hwk,hwkc->hwc", self.weights, corners), dtype=np.float32
        )

    def compute_normals(self) -> Float32Array:
        """Return unit shading normals (h, w, 3), or face normals where these cancel."""
        corners = self.mesh.normals[self.mesh.faces[self.face_index]]
        normals = np.einsum("hwk,hwkc->hwc", self.weights, corners)
        lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
        unit_normals = normals / np.maximum(lengths, 1e-6)
        face_normals = _compute_face_normals(self.mesh)[self.face_index]
        return np.where(lengths > 1e-6, unit_normals, face_normals).astype(np.float32)

    def compute_areas(self) -> Float32Array:
        """Return the surface area (h, w) of each texel, in squared mesh units.

        It is the area of the texel's face on the surface, divided by the face's area in
        the texture, in texels. It is 0 outside of all charts.
        """
        corners = self.mesh.vertices[self.mesh.faces].astype(np.float64)
        texel_corners = _to_texel_coordinates(self.mesh, self.is_covered.shape)
        # Both are twice an area, on the surface and in texels. Only their ratio is
        # used.
        doubled_areas = np.linalg.norm(compute_area_vectors(corners), axis=1)
        doubled_texels = np.abs(compute_doubled_areas(texel_corners))
        area_per_texel = np.where(
            doubled_texels > 0.0, doubled_areas / np.maximum(doubled_texels, 1e-12), 0.0
        )
        areas = np.where(self.is_covered, area_per_texel[self.face_index], 0.0)
        return areas.astype(np.float32)


def find_exclusive_texels(
    mesh: Mesh, faces: IntArray, shape: tuple[int, int]
) -> tuple[BoolArray, float]:
    """Return the texels that bilinear look-ups read on the given faces and no others.

    Args:
        mesh: the mesh.
        faces: (N,) indices of the faces.
        shape: height and width of the texture.

    Returns:
        (h, w) texels that look-ups on these faces read, but look-ups on other faces do
        not; and their fraction of all texels that look-ups on these faces read.
    """
    corners = _to_texel_coordinates(mesh, shape)
    is_selected = np.isin(np.arange(len(mesh.faces)), faces)
    is_read = find_read_texels(corners[is_selected], shape)
    is_exclusive = is_read & ~find_read_texels(corners[~is_selected], shape)
    return is_exclusive, float(is_exclusive.sum()) / max(1, int(is_read.sum()))


def rasterize_charts(mesh: Mesh, resolution: int | tuple[int, int]) -> Charts:
    """Find the face and the barycentric weights of every texel of a texture.

    Where charts overlap, a texel belongs to the face with the largest index. A texel
    outside of all charts has the values of the nearest texel inside one.

    Args:
        mesh: mesh with texture coordinates.
        resolution: height and width, or both as one number.

    Raises:
        InputError: the texture coordinates cover no texel.
    """
    shape = (resolution, resolution) if isinstance(resolution, int) else resolution
    corners = _to_texel_coordinates(mesh, shape)
    face, row, column = find_candidate_pixels(corners, shape)
    _check_any_texel_covered(face, shape)
    points = np.stack([column, row], axis=1)
    weights = _compute_clipped_weights(corners[face], points)
    face_map = np.zeros(shape, np.int64)
    weight_map = np.zeros((*shape, 3))
    is_covered = np.zeros(shape, np.bool_)
    face_map[row, column] = face
    weight_map[row, column] = weights
    is_covered[row, column] = True
    return _fill_charts(mesh, face_map, weight_map, is_covered)


def _check_any_texel_covered(face: IntArray, shape: tuple[int, int]) -> None:
    """Check that the triangles of a texture of some shape cover a texel.

    Args:
        face: (N,) the triangle of each texel that is covered.
        shape: height and width of the texture.

    Raises:
        InputError: no texel is covered.
    """
    if len(face) == 0:
        raise InputError(
            f"mesh texture coordinates: none of the {shape[0]} x {shape[1]} texels "
            "lies in a triangle; unwrap the mesh again"
        )


def _fill_charts(
    mesh: Mesh, face_map: IntArray, weight_map: Float64Array, is_covered: BoolArray
) -> Charts:
    """Return charts whose texels outside have the values of the nearest covered texel.

    Args:
        mesh: mesh with texture coordinates.
        face_map: (h, w) face of each covered texel.
        weight_map: (h, w, 3) barycentric weights of each covered texel.
        is_covered: (h, w) whether a texel is covered.
    """
    # A covered texel is its own nearest one, at the distance 0.
    distance, nearest_indices = ndimage.distance_transform_edt(
        ~is_covered, return_indices=True
    )
    nearest = tuple(nearest_indices)  # rows and columns, each (h, w)
    return Charts(
        mesh=mesh,
        face_index=face_map[nearest],
        weights=weight_map[nearest],
        is_covered=is_covered,
        texels_to_covered=distance,
    )


def _compute_clipped_weights(corners: Float64Array, points: IntArray) -> Float64Array:
    """Return the barycentric weights (N, 3) of points, clipped to their triangles.

    A point outside of its triangle has negative weights. They become 0, and the others
    are scaled so that they add up to 1. In a triangle without area all are 1 / 3.

    Args:
        corners: (N, 3, 2) columns and rows of the corners of each point's triangle.
        points: (N, 2) columns and rows of the points.
    """
    doubled_area = compute_doubled_areas(corners)
    divisor = np.where(doubled_area == 0.0, 1.0, doubled_area)
    corner_weights = []
    for next_corner, previous_corner in ((1, 2), (2, 0), (0, 1)):
        a = corners[:, next_corner] - points
        b = corners[:, previous_corner] - points
        # twice the signed area between the point and the side opposite of the corner,
        # as a fraction of the triangle's, which has the same sign for points inside
        corner_weights.append((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / divisor)
    weights = np.maximum(np.stack(corner_weights, axis=1), 0.0)
    total = weights.sum(axis=1, keepdims=True)
    return np.where(total > 0.0, weights / np.maximum(total, 1e-12), 1.0 / 3.0)


def look_up_texture(
    texels: Float32Array, x: npt.NDArray[np.floating], y: npt.NDArray[np.floating]
) -> Float32Array:
    """Look a repeating texture up with bilinear interpolation.

    Args:
        texels: (H, W, C) the texture.
        x: columns (...), integers at texel centers. Outside of it the texture repeats.
        y: rows (...), likewise.

    Returns:
        (..., C) float32.
    """
    height, width = texels.shape[:2]
    # The first of the four texels around each point, and the offset (0 to 1) from it.
    left = np.floor(x)
    top = np.floor(y)
    column_fraction = (x - left).astype(np.float32)[..., None]
    row_fraction = (y - top).astype(np.float32)[..., None]
    columns = _wrap_neighbors(left, width)
    upper_row, lower_row = _wrap_neighbors(top, height)
    upper = _interpolate_columns(texels, upper_row, columns, column_fraction)
    lower = _interpolate_columns(texels, lower_row, columns, column_fraction)
    mean = upper * (1 - row_fraction) + lower * row_fraction
    return np.asarray(mean, dtype=np.float32)


def _wrap_neighbors(
    first: npt.NDArray[np.floating], size: int
) -> tuple[IntArray, IntArray]:
    """Return rows or columns (...) and the next ones, wrapped at a texture's border.

    Args:
        first: (...) whole numbers, which may be outside of the texture.
        size: number of rows or columns of the texture.
    """
    return (first % size).astype(np.int64), ((first + 1) % size).astype(np.int64)


def _interpolate_columns(
    texels: Float32Array,
    row: IntArray,
    columns: tuple[IntArray, IntArray],
    fraction: Float32Array,
) -> npt.NDArray[np.floating]:
    """Interpolate linearly between two texels of a row, (..., C).

    Args:
        texels: (H, W, C) the texture.
        row: (...) row of both texels.
        columns: (...) column of the left texel, and (...) of the right one.
        fraction: (..., 1) 0 at the left texel and 1 at the right one.
    """
    left_column, right_column = columns
    left_part = texels[row, left_column] * (1 - fraction)
    return np.asarray(left_part + texels[row, right_column] * fraction)


class MeshSurface:
    """The faces of a mesh, prepared for intersections with rays and for neighborhoods.

    Attributes:
        normals: (F, 3) unit normals of the faces.
    """

    def __init__(self, mesh: Mesh) -> None:
        """Compute boxes and normals of the faces, and which faces are neighbors."""
        self._corners = mesh.vertices[mesh.faces].astype(np.float64)
        self.normals = _compute_face_normals(mesh)
        self._lower = self._corners.min(axis=1)
        self._upper = self._corners.max(axis=1)
        self._neighbours = _find_neighboring_faces(mesh)  # (E, 2) pairs of faces

    def find_hit(
        self, origin: Float64Array, direction: Float64Array
    ) -> tuple[int, Float64Array]:
        """Find the first face that a ray meets, from either side.

        Args:
            origin: (3,) start of the ray, outside of the mesh.
            direction: (3,) unit vector.

        Returns:
            The face, and the point (3,) at which the ray meets it. If the ray meets no
            face, the point is the corner nearest to the ray's line, and the face is one
            with this corner.
        """
        distance = self._intersect(origin, direction)
        if np.isfinite(distance).any():
            face = int(distance.argmin())
            return face, origin + distance[face] * direction
        # length of the cross product with a unit vector: the distance from the line
        to_corners = np.cross(self._corners - origin, direction)
        line_distance = np.linalg.norm(to_corners, axis=-1)
        face, corner = np.unravel_index(line_distance.argmin(), line_distance.shape)
        return int(face), self._corners[face, corner]

    def _intersect(self, origin: Float64Array, direction: Float64Array) -> Float64Array:
        """Return the distance (F,) at which a ray meets each face, or infinity.

        The method is that of Moeller and Trumbore 1997, for all faces at once. As in
        the paper t goes from the face's corner a to the origin, and u and v are the
        barycentric weights of b and c where the ray meets the plane of the face. A ray
        in that plane does not meet the face. Faces behind the origin are ignored.

        Args:
            origin: (3,) start of the ray.
            direction: (3,) its direction.
        """
        a = self._corners[:, 0]
        b = self._corners[:, 1]
        c = self._corners[:, 2]
        p = np.cross(direction, c - a)
        determinant = ((b - a) * p).sum(axis=1)
        # 0 means that the ray is in the plane of the face
        inverse = _invert_unless_tiny(determinant)
        t = origin - a
        u = (t * p).sum(axis=1) * inverse
        q = np.cross(t, b - a)
        v = (q @ direction) * inverse
        distance = ((c - a) * q).sum(axis=1) * inverse
        # The slack prevents rounding from letting a ray pass between two neighbors.
        slack = 1e-9
        is_hit = (inverse != 0.0) & (u >= -slack) & (v >= -slack)
        is_hit &= (u + v <= 1.0 + slack) & (distance > 0.0)
        return np.where(is_hit, distance, np.inf)

    def find_region(
        self, face: int, point: Float64Array, normal: Float64Array, radius: float
    ) -> BoolArray:
        """Return the faces around a point that are connected to a face.

        Faces are returned if their bounding boxes are within the radius, if they face
        the direction `normal`, and if a chain of such faces, neighbor by neighbor,
        connects them to the face. So a patch on a cup leaves out the opposite wall of
        the cup, and a patch on a chair's slat leaves out the next slat.

        Args:
            face: index of the face at which the chains begin. It is always returned.
            point: (3,) center.
            normal: (3,) direction.
            radius: radius in the unit of the mesh.

        Returns:
            (F,) bool.
        """
        # offset from the point to each face's bounding box, 0 along axes where they
        # overlap
        box_gap = np.maximum(np.maximum(self._lower - point, point - self._upper), 0.0)
        is_near = np.linalg.norm(box_gap, axis=1) <= radius
        is_inside = is_near & (self.normals @ normal > 0.0)
        is_inside[face] = True
        # pairs of neighbors that are both inside
        is_pair_inside = is_inside[self._neighbours].all(axis=1)
        left_face, right_face = self._neighbours[is_pair_inside].T
        component = find_components(len(is_inside), left_face, right_face)
        return np.asarray(is_inside & (component == component[face]))


def _invert_unless_tiny(values: Float64Array) -> Float64Array:
    """Return 1 / value for each value (N,), and 0 for values that are about 0."""
    divisor = np.where(values == 0.0, 1.0, values)
    return np.where(np.abs(values) > 1e-15, 1.0 / divisor, 0.0)


def _find_neighboring_faces(mesh: Mesh) -> IntArray:
    """Return the pairs (E, 2) of faces that share an edge.

    Edges are compared by the positions of their ends: at a UV seam the faces on both
    sides have different vertices at the same positions.
    """
    # (F, 3) corners of the faces, with one index for all vertices at one position
    point_of_vertex = weld_vertices(mesh)[0]
    corners = point_of_vertex[mesh.faces]
    # (3 F, 2) edges in three blocks, each with one edge of all faces
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    # Sorted by their ends, equal edges follow one another: their faces are neighbors.
    edges = np.sort(edges, axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    is_same = (edges[order][1:] == edges[order][:-1]).all(axis=1)
    face = order % len(mesh.faces)  # each block of edges has one edge of every face
    return np.stack([face[:-1][is_same], face[1:][is_same]], axis=1)


def weld_vertices(mesh: Mesh) -> tuple[IntArray, int]:
    """Return the index of the position of each vertex (V,), and the number of positions.

    Vertices that UV seams and creases split share a position. Positions are rounded to
    1e-5 of the mesh's largest extent.
    """
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    rounded = np.round(mesh.vertices.astype(np.float64) / max(extent, 1e-12) * 1e5)
    index = np.unique(rounded, axis=0, return_inverse=True)[1].reshape(-1)
    index = index.astype(np.int64)
    return index, int(index.max()) + 1


def _to_texel_coordinates(mesh: Mesh, shape: tuple[int, int]) -> Float64Array:
    """Return texture coordinates of the faces' corners (F, 3, 2) in texels.

    They are column and row, with row 0 at v = 1. The center of the first texel is at 0,
    so half a texel is subtracted. If the texture repeats, each face is moved by
    integers, so that its center is in the unit square.
    """
    uvs = mesh.uvs[mesh.faces].astype(np.float64)
    if mesh.repeats:
        uvs -= np.floor(uvs.mean(axis=1, keepdims=True))
    column = uvs[..., 0] * shape[1] - 0.5
    row = (1.0 - uvs[..., 1]) * shape[0] - 0.5
    return np.stack([column, row], axis=-1)


def _compute_face_normals(mesh: Mesh) -> Float64Array:
    """Return the unit normals (F, 3) of a mesh's faces."""
    vectors = compute_area_vectors(mesh.vertices[mesh.faces].astype(np.float64))
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-20))
