"""Triangles to pixels: the one rasteriser, in numpy, for silhouettes, texture charts and baked textures.

Each triangle is cut into the spans of rows that it crosses, and each span into pixels.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

TOLERANCE = 1e-6
"""Barycentric weight by which a pixel's centre may miss a triangle, so that shared edges leave no gaps."""
MISS = 1e-4
"""Pixels by which a centre may miss a triangle and still be looked at."""


def pixels_in(
    corners: Doubles, shape: tuple[int, int], tolerance: float = TOLERANCE
) -> tuple[Ints, Ints, Ints, Doubles]:
    """List the pixels whose centres lie in each of many triangles, triangle by triangle.

    Args:
        corners: (F, 3, 2) column and row; integers are pixel centres. Triangles without area cover nothing.
        shape: (height, width) of the raster.
        tolerance: barycentric weight by which a centre may miss its triangle.

    Returns:
        For every such pixel: its triangle, row, column (N,) and the corners' barycentric weights (N, 3).
    """
    face, row, column = pixels_near(corners, shape, 10.0 * MISS)
    weights = weights_at(corners[face], row, column)
    inside = (weights >= -tolerance).all(axis=1)
    return face[inside], row[inside], column[inside], weights[inside]


def pixels_near(corners: Doubles, shape: tuple[int, int], miss: float = MISS) -> tuple[Ints, Ints, Ints]:
    """List the pixels whose centres lie in each of many triangles, or next to it; also in flat ones.

    Args:
        corners: as in `pixels_in`.
        shape: as in `pixels_in`.
        miss: pixels by which a centre may miss its triangle, along its row or its column.

    Returns:
        For every such pixel: its triangle, row and column (N,).
    """
    face, row = _ranges(corners[..., 1].min(axis=1), corners[..., 1].max(axis=1), shape[0], miss)
    span, column = _ranges(*_crossing(corners[face], row, miss), shape[1], miss)
    return face[span], row[span], column


def texels_read(corners: Doubles, shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Return the texels (h, w) that bilinear lookups anywhere in some triangles read; lookups repeat at the border.

    Args:
        corners: (F, 3, 2) column and row, as in `pixels_in`, at most half a texel outside of the texture.
        shape: height and width of the texture.
    """
    moved = corners + 1.0  # a lookup between two texels is in the cell of the first; -1 is the last one again
    low, high = np.floor(moved[..., 1].min(axis=1) - MISS), np.floor(moved[..., 1].max(axis=1) + MISS)
    face, row = _ranges(low, high, shape[0] + 1, 0.0)
    here, rows = moved[face], row[:, None]
    edges = [_crossing(here, row + k, MISS) for k in (0, 1)]
    within = (here[..., 1] >= rows - MISS) & (here[..., 1] <= rows + 1 + MISS)
    left = np.where(within, here[..., 0], np.inf).min(axis=1)
    right = np.where(within, here[..., 0], -np.inf).max(axis=1)
    for begin, end in edges:
        left = np.where(begin <= end, np.minimum(left, begin), left)
        right = np.where(begin <= end, np.maximum(right, end), right)
    span, column = _ranges(np.floor(left - MISS), np.floor(right + MISS), shape[1] + 1, 0.0)
    read = np.zeros(shape, np.bool_)
    for down in (0, 1):
        for across in (0, 1):
            read[(row[span] - 1 + down) % shape[0], (column - 1 + across) % shape[1]] = True
    return read


def weights_at(corners: Doubles, row: Ints | Doubles, column: Ints | Doubles) -> Doubles:
    """Return the barycentric weights (N, 3) of pixel centres in triangles (N, 3, 2); NaN where one has no area."""
    (ax, ay), (bx, by), (cx, cy) = (corners[:, number].T for number in range(3))
    with np.errstate(all="ignore"):
        scale = 1.0 / doubled_areas(corners)
        second = ((column - ax) * (cy - ay) - (row - ay) * (cx - ax)) * scale
        third = ((bx - ax) * (row - ay) - (by - ay) * (column - ax)) * scale
        return np.stack([1.0 - second - third, second, third], axis=-1)


def doubled_areas(corners: Doubles) -> Doubles:
    """Return twice the signed area (F,) of flat triangles (F, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _ranges(low: Doubles, high: Doubles, size: int, miss: float) -> tuple[Ints, Ints]:
    """List the integers of [low, high] within [0, size - 1] for many intervals: each one's interval, and its value."""
    first = np.maximum(np.ceil(low - miss), 0.0).astype(np.int64)
    last = np.minimum(np.floor(high + miss), size - 1.0).astype(np.int64)
    counts = np.maximum(last - first + 1, 0)
    owner = np.repeat(np.arange(len(counts)), counts)
    begin = np.cumsum(counts) - counts
    return owner, first[owner] + np.arange(len(owner)) - begin[owner]


def _crossing(corners: Doubles, row: Ints, miss: float) -> tuple[Doubles, Doubles]:
    """Leftmost and rightmost column where a row's line meets a triangle: corners (N, 3, 2), row (N,)."""
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for begin, end in ((0, 1), (1, 2), (2, 0)):
        (x0, y0), (x1, y1) = corners[:, begin].T, corners[:, end].T
        rise = y1 - y0
        share = np.clip((row - y0) / np.where(rise == 0.0, 1.0, rise), 0.0, 1.0)
        meets = (np.minimum(y0, y1) - miss <= row) & (row <= np.maximum(y0, y1) + miss) & (rise != 0.0)
        x = x0 + share * (x1 - x0)
        left, right = np.where(meets, np.minimum(left, x), left), np.where(meets, np.maximum(right, x), right)
    empty = left > right
    return np.where(empty, 0.0, left), np.where(empty, -1.0, right)
