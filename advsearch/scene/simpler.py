"""A mesh with fewer faces, to look at: vertices that lie in one cell of a grid become one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from advsearch.scene.assets import Floats, Mesh

GRIDS = (384, 256, 192, 128, 96, 64, 48, 32, 24, 16, 12, 8)
"""Cells of the grid along the mesh's largest extent, tried one after the other."""

TEXTURE_CELLS = 32
"""Cells of the texture along each side: vertices of one place that lie in different ones stay apart, as at seams."""

Numbers = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Simpler:
    """Which vertices and faces of a mesh are left.

    Attributes:
        kept: (W,) number of the vertex that each one left has its normal and texture coordinates from.
        place: (W,) number of the place that each one left stands at.
        places: (V,) number of the place that each vertex of the mesh goes to.
        faces: (G, 3) indices of those left.
    """

    kept: Numbers
    place: Numbers
    places: Numbers
    faces: npt.NDArray[np.uint32]

    def of(self, mesh: Mesh) -> Mesh:
        """Return what is left of the mesh, or of one that only stands elsewhere.

        Each vertex stands at the mean of those that came together there.
        """
        counts = np.bincount(self.places)
        mean = np.stack([np.bincount(self.places, mesh.vertices[:, axis]) / counts for axis in range(3)], axis=1)
        places: Floats = mean[self.place].astype(np.float32)
        return Mesh(places, self.faces, mesh.normals[self.kept], mesh.uvs[self.kept])


def simpler(mesh: Mesh, most: int) -> Simpler | None:
    """Return how a mesh is shown with at most `most` faces, or the fewest of a coarse grid; None: it has no more.

    After Rossignac and Borrel (1993, "Multi-resolution 3D approximations for rendering complex scenes"): vertices are
    clustered by a grid, and a face of which two corners meet is left out. Both sides of a seam of the texture move
    together, so that no gap opens.
    """
    if len(mesh.faces) <= most:
        return None
    low = mesh.vertices.min(axis=0)
    extent = max(float((mesh.vertices.max(axis=0) - low).max()), 1e-12)
    chart = np.floor(mesh.uvs.astype(np.float64) * TEXTURE_CELLS).astype(np.int64)
    for grid in GRIDS:
        cells = np.floor((mesh.vertices - low) / extent * (grid - 1) + 0.5).astype(np.int64)
        places = np.unique(_key(cells), return_inverse=True)[1].reshape(-1)
        together = _key(np.column_stack([places, chart]))
        _, kept, left = np.unique(together, return_index=True, return_inverse=True)
        faces = left.reshape(-1)[mesh.faces]
        first, second, third = places[kept][faces].T
        faces = faces[(first != second) & (second != third) & (third != first)]
        if len(faces) <= most:
            break
    return Simpler(kept, places[kept], places, np.unique(faces, axis=0).astype(np.uint32))


def _key(rows: Numbers) -> Numbers:
    """Return one number for each row of whole numbers, the same for equal rows only."""
    low = rows.min(axis=0)
    sizes = rows.max(axis=0) - low + 1
    key = np.zeros(len(rows), np.int64)
    for column, size in zip((rows - low).T, sizes, strict=True):
        key = key * size + column
    return key
