"""Triangles to pixels: the one rasteriser, in numpy, for silhouettes, texture charts
and baked textures.

Each triangle is cut into the spans of rows that it crosses, and each span into pixels.

And where on a mesh each texel of its texture lies: the UV charts rasterised at the
texel centres. Row 0 is at v = 1, as in every texture of ours. A texel belongs to the
triangle that its centre lies in; one that no chart covers takes over what the nearest
covered texel has, so that bilinear lookups at a chart's border find values that
continue it.

`MeshSurface` finds places on a mesh by rays and the connected region around them, for
what is stuck onto it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from advsearch.errors import InputError
from advsearch.scene.assets import Bools, Doubles, Floats, Ints, Mesh, face_vectors
from advsearch.scene.importing.geometry import connected

# barycentric weight by which a pixel's centre may miss a triangle, so that shared edges
# leave no gaps
TOLERANCE = 1e-6
MISS = 1e-4  # pixels by which a centre may miss a triangle and still be looked at


def pixels_in(
    corners: Doubles, shape: tuple[int, int], tolerance: float = TOLERANCE
) -> tuple[Ints, Ints, Ints, Doubles]:
    """List the pixels of a raster (height, width) whose centres lie in each of many
    triangles, or miss it by a barycentric weight of at most `tolerance`, triangle by
    triangle: for every such pixel its triangle, row and column (N,), and the corners'
    barycentric weights (N, 3). Corners (F, 3, 2) are columns and rows, integers at
    pixel centres; triangles without area cover nothing.
    """
    face, row, column = pixels_near(corners, shape, 10.0 * MISS)
    weights = weights_at(corners[face], row, column)
    inside = (weights >= -tolerance).all(axis=1)
    return face[inside], row[inside], column[inside], weights[inside]


def pixels_near(
    corners: Doubles, shape: tuple[int, int], miss: float = MISS
) -> tuple[Ints, Ints, Ints]:
    """List the pixels whose centres lie in each of many triangles, also flat ones, or
    miss it by so many pixels along their row or column; arguments as of `pixels_in`,
    returns triangle, row and column (N,).
    """
    face, row = _ranges(
        corners[..., 1].min(axis=1), corners[..., 1].max(axis=1), shape[0], miss
    )
    span, column = _ranges(*_crossing(corners[face], row, miss), shape[1], miss)
    return face[span], row[span], column


def texels_read(corners: Doubles, shape: tuple[int, int]) -> Bools:
    """Return the texels (h, w) that bilinear lookups anywhere in triangles (F, 3, 2),
    as of `pixels_in` and at most half a texel outside of the texture, read; lookups
    repeat at the border.
    """
    # a lookup between two texels is in the cell of the first; -1 is the last one again
    moved = corners + 1.0
    low = np.floor(moved[..., 1].min(axis=1) - MISS)
    high = np.floor(moved[..., 1].max(axis=1) + MISS)
    face, row = _ranges(low, high, shape[0] + 1, 0.0)
    here = moved[face]
    rows = row[:, None]
    edges = [_crossing(here, row + k, MISS) for k in (0, 1)]
    within = (here[..., 1] >= rows - MISS) & (here[..., 1] <= rows + 1 + MISS)
    left = np.where(within, here[..., 0], np.inf).min(axis=1)
    right = np.where(within, here[..., 0], -np.inf).max(axis=1)
    for begin, end in edges:
        left = np.where(begin <= end, np.minimum(left, begin), left)
        right = np.where(begin <= end, np.maximum(right, end), right)
    span, column = _ranges(
        np.floor(left - MISS), np.floor(right + MISS), shape[1] + 1, 0.0
    )
    read = np.zeros(shape, np.bool_)
    for down in (0, 1):
        for across in (0, 1):
            read[
                (row[span] - 1 + down) % shape[0], (column - 1 + across) % shape[1]
            ] = True
    return read


def weights_at(
    corners: Doubles, row: Ints | Doubles, column: Ints | Doubles
) -> Doubles:
    """Return the barycentric weights (N, 3) of pixel centres in triangles (N, 3, 2);
    NaN where one has no area.
    """
    (ax, ay), (bx, by), (cx, cy) = (corners[:, number].T for number in range(3))
    with np.errstate(all="ignore"):
        scale = 1.0 / doubled_areas(corners)
        second = ((column - ax) * (cy - ay) - (row - ay) * (cx - ax)) * scale
        third = ((bx - ax) * (row - ay) - (by - ay) * (column - ax)) * scale
        return np.stack([1.0 - second - third, second, third], axis=-1)


def doubled_areas(corners: Doubles) -> Doubles:
    """Return twice the signed area (F,) of flat triangles (F, 3, 2)."""
    a = corners[:, 1] - corners[:, 0]
    b = corners[:, 2] - corners[:, 0]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _ranges(low: Doubles, high: Doubles, size: int, miss: float) -> tuple[Ints, Ints]:
    """List the integers of [low, high] within [0, size - 1] for many intervals: each
    one's interval, and its value.
    """
    first = np.maximum(np.ceil(low - miss), 0.0).astype(np.int64)
    last = np.minimum(np.floor(high + miss), size - 1.0).astype(np.int64)
    counts = np.maximum(last - first + 1, 0)
    owner = np.repeat(np.arange(len(counts)), counts)
    begin = np.cumsum(counts) - counts
    return owner, first[owner] + np.arange(len(owner)) - begin[owner]


def _crossing(corners: Doubles, row: Ints, miss: float) -> tuple[Doubles, Doubles]:
    left = np.full(len(row), np.inf)
    right = np.full(len(row), -np.inf)
    for begin, end in ((0, 1), (1, 2), (2, 0)):
        (x0, y0) = corners[:, begin].T
        (x1, y1) = corners[:, end].T
        rise = y1 - y0
        share = np.clip((row - y0) / np.where(rise == 0.0, 1.0, rise), 0.0, 1.0)
        meets = (
            (np.minimum(y0, y1) - miss <= row)
            & (row <= np.maximum(y0, y1) + miss)
            & (rise != 0.0)
        )
        x = x0 + share * (x1 - x0)
        left = np.where(meets, np.minimum(left, x), left)
        right = np.where(meets, np.maximum(right, x), right)
    empty = left > right
    return np.where(empty, 0.0, left), np.where(empty, -1.0, right)


# texels around a chart that belong to it: a bilinear lookup inside reaches one texel
# beyond it
BORDER = 2.0


@dataclass(frozen=True, eq=False)
class Charts:
    """The rasterised charts of a mesh."""

    mesh: Mesh
    # (h, w) of the face that each texel lies in; uncovered texels have that of the
    # nearest covered one
    face: Ints
    # (h, w, 3) barycentric weights of the face's three corners, at least 0, adding up
    # to 1
    weights: Doubles
    covered: Bools  # (h, w) the texel's centre lies in a chart
    distance: Doubles  # (h, w) texels to the nearest covered texel; 0 where covered

    @property
    def touched(self) -> Bools:
        """(h, w): a lookup on the surface can touch the texel; it is in a chart or
        `BORDER` texels around one.
        """
        return np.asarray(self.distance <= BORDER)

    def positions(self) -> Floats:
        """Return (h, w, 3) positions in mesh coordinates."""
        corners = self.mesh.vertices[self.mesh.faces[self.face]]
        return np.asarray(
            np.einsum("hwk,hwkc->hwc", self.weights, corners), dtype=np.float32
        )

    def normals(self) -> Floats:
        """Return (h, w, 3) unit shading normals."""
        corners = self.mesh.normals[self.mesh.faces[self.face]]
        normals = np.einsum("hwk,hwkc->hwc", self.weights, corners)
        lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
        flat = _face_normals(self.mesh)[self.face]
        return np.where(
            lengths > 1e-6, normals / np.maximum(lengths, 1e-6), flat
        ).astype(np.float32)

    def areas(self) -> Floats:
        """Return the surface area (h, w) that each texel stands for, in squared mesh
        units; 0 where no chart is.
        """
        places = self.mesh.vertices[self.mesh.faces].astype(np.float64)
        surface = np.linalg.norm(face_vectors(places), axis=1)
        texels = np.abs(doubled_areas(_in_texels(self.mesh, self.covered.shape)))
        share = np.where(texels > 0.0, surface / np.maximum(texels, 1e-12), 0.0)
        return np.where(self.covered, share[self.face], 0.0).astype(np.float32)


def texels_of_faces(
    mesh: Mesh, faces: Ints, shape: tuple[int, int]
) -> tuple[Bools, float]:
    """Return the texels (h, w) that bilinear lookups on some faces, by their numbers
    (N,), read and lookups on all others do not, and their share of those that lookups
    on these faces read.
    """
    corners = _in_texels(mesh, shape)
    ours = np.isin(np.arange(len(mesh.faces)), faces)
    read = texels_read(corners[ours], shape)
    alone = read & ~texels_read(corners[~ours], shape)
    return alone, float(alone.sum()) / max(1, int(read.sum()))


def rasterised(mesh: Mesh, resolution: int | tuple[int, int]) -> Charts:
    """Find the face and the barycentric weights behind every texel centre of a texture,
    square where its resolution is one number. Where charts overlap, one of their faces
    wins. Raises InputError: the texture coordinates cover no texel.
    """
    shape = (resolution, resolution) if isinstance(resolution, int) else resolution
    corners = _in_texels(mesh, shape)
    face, row, column = pixels_near(corners, shape)
    if len(face) == 0:
        raise InputError(
            f"mesh texture coordinates: none of the {shape[0]} x {shape[1]} texels "
            "lies in a triangle; unwrap the mesh "
            "again"
        )
    corners = corners[face]
    points = np.stack([column, row], axis=1)
    whole = doubled_areas(corners)
    parts = []
    # barycentric weights, clipped to the triangle
    for begin, end in ((1, 2), (2, 0), (0, 1)):
        a = corners[:, begin] - points
        b = corners[:, end] - points
        parts.append(
            (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / np.where(whole == 0.0, 1.0, whole)
        )
    weights = np.maximum(np.stack(parts, axis=1), 0.0)
    total = weights.sum(axis=1, keepdims=True)
    weights = np.where(total > 0.0, weights / np.maximum(total, 1e-12), 1.0 / 3.0)
    face_map = np.zeros(shape, np.int64)
    weight_map = np.zeros((*shape, 3))
    covered = np.zeros(shape, np.bool_)
    face_map[row, column], weight_map[row, column], covered[row, column] = (
        face,
        weights,
        True,
    )
    distance, nearest = ndimage.distance_transform_edt(~covered, return_indices=True)
    return Charts(
        mesh, face_map[tuple(nearest)], weight_map[tuple(nearest)], covered, distance
    )


def looked_up(
    texels: Floats, x: npt.NDArray[np.floating], y: npt.NDArray[np.floating]
) -> Floats:
    """Look a repeating texture (H, W, C) up with bilinear interpolation of its values
    at columns and rows (...), any number of textures away, where integers are texel
    centres: (..., C) float32.
    """
    height, width = texels.shape[:2]
    left = np.floor(x)
    top = np.floor(y)
    fx = (x - left).astype(np.float32)[..., None]
    fy = (y - top).astype(np.float32)[..., None]
    columns = [((left + k) % width).astype(np.int64) for k in (0, 1)]
    rows = [((top + k) % height).astype(np.int64) for k in (0, 1)]
    upper = texels[rows[0], columns[0]] * (1 - fx) + texels[rows[0], columns[1]] * fx
    lower = texels[rows[1], columns[0]] * (1 - fx) + texels[rows[1], columns[1]] * fx
    return np.asarray(upper * (1 - fy) + lower * fy, dtype=np.float32)


class MeshSurface:
    """The faces of a mesh, ready for rays and for neighbourhoods."""

    def __init__(self, mesh: Mesh) -> None:
        self._corners = mesh.vertices[mesh.faces].astype(np.float64)
        self.normals = _face_normals(mesh)
        self._low, self._high = self._corners.min(axis=1), self._corners.max(axis=1)
        # Pairs (E, 2) of faces with an edge in common, across UV seams too
        places = welded(mesh)[0][mesh.faces]
        edges = np.sort(
            np.concatenate([places[:, [0, 1]], places[:, [1, 2]], places[:, [2, 0]]]),
            axis=1,
        )
        order = np.lexsort((edges[:, 1], edges[:, 0]))
        same = (edges[order][1:] == edges[order][:-1]).all(axis=1)
        owner = order % len(mesh.faces)
        self._neighbours = np.stack([owner[:-1][same], owner[1:][same]], axis=1)

    def hit(self, origin: Doubles, direction: Doubles) -> tuple[int, Doubles]:
        """Return the first face that a ray from (3,) outside the mesh in a unit
        direction (3,) meets, from either side, and the point (3,) where it does. If it
        meets none: the face with the corner nearest to the ray's line, and that corner.
        """
        a = self._corners[:, 0]
        b = self._corners[:, 1]
        c = self._corners[:, 2]
        # Moeller and Trumbore 1997, all faces at once
        across = np.cross(direction, c - a)
        determinant = ((b - a) * across).sum(axis=1)
        inverse = np.where(
            np.abs(determinant) > 1e-15,
            1.0 / np.where(determinant == 0.0, 1.0, determinant),
            0.0,
        )
        offset = origin - a
        first = (offset * across).sum(axis=1) * inverse
        turned = np.cross(offset, b - a)
        second = (turned @ direction) * inverse
        distance = ((c - a) * turned).sum(axis=1) * inverse
        slack = 1e-9
        meets = (
            (inverse != 0.0)
            & (first >= -slack)
            & (second >= -slack)
            & (first + second <= 1.0 + slack)
        )
        meets &= distance > 0.0
        if meets.any():
            face = int(np.where(meets, distance, np.inf).argmin())
            return face, origin + distance[face] * direction
        aside = np.linalg.norm(np.cross(self._corners - origin, direction), axis=-1)
        face, corner = np.unravel_index(aside.argmin(), aside.shape)
        return int(face), self._corners[face, corner]

    def region(
        self, face: int, point: Doubles, normal: Doubles, radius: float
    ) -> Bools:
        """Return which faces (F,) lie within a radius of a point (3,), face a direction
        (3,), and are reached from one face, which always counts, over edges between
        such faces. The other wall of a cup, or the next slat of a chair, are not.
        """
        gap = np.maximum(np.maximum(self._low - point, point - self._high), 0.0)
        inside = (np.linalg.norm(gap, axis=1) <= radius) & (self.normals @ normal > 0.0)
        inside[face] = True
        links = self._neighbours[inside[self._neighbours].all(axis=1)]
        labels = connected(len(inside), *links.T)
        return np.asarray(inside & (labels == labels[face]))


def welded(mesh: Mesh) -> tuple[Ints, int]:
    """Return the number of the place that each vertex lies at (V,), and how many places
    there are. Vertices that UV seams and creases split share a place: 1e-5 of the
    mesh's largest extent apart or less.
    """
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    rounded = np.round(mesh.vertices.astype(np.float64) / max(extent, 1e-12) * 1e5)
    place = (
        np.unique(rounded, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)
    )
    return place, int(place.max()) + 1


def _in_texels(mesh: Mesh, shape: tuple[int, int]) -> Doubles:
    """Texture coordinates of the faces' corners, (F, 3, 2): column and row, integers at
    texel centres. Where a texture repeats, each face is moved by whole textures, so
    that its middle lies in the first one.
    """
    uvs = mesh.uvs[mesh.faces].astype(np.float64)
    if mesh.repeats:
        uvs -= np.floor(uvs.mean(axis=1, keepdims=True))
    return np.stack(
        [uvs[..., 0] * shape[1] - 0.5, (1.0 - uvs[..., 1]) * shape[0] - 0.5], axis=-1
    )


def _face_normals(mesh: Mesh) -> Doubles:
    normals = face_vectors(mesh.vertices[mesh.faces].astype(np.float64))
    return np.asarray(
        normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    )
