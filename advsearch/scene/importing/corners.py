"""Geometry whose corners look their values up, as most formats have it, made into parts with vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from advsearch.scene.importing.imported_part import ImportedPart
from advsearch.scene.importing.surfaces import ImportedSurface

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Looked:
    """Values that the corners of triangles look up.

    Attributes:
        values: (N, C) float64.
        index: (F, 3) int64 rows of `values`; -1 where a corner has none.
    """

    values: Array
    index: Ints

    def at(self, chosen: Ints) -> Looked | None:
        """Return the values of some triangles (f,); None where these have none at all."""
        index = self.index[chosen]
        return Looked(self.values, index) if (index >= 0).any() else None


def split_at_corners(
    points: Looked,
    normals: Looked | None,
    uvs: Looked | None,
    colors: Array | None,
    surface: ImportedSurface,
    *,
    flat: bool = False,
) -> ImportedPart:
    """Return a part in which corners with the same point, normal and texture coordinate are one vertex.

    Args:
        points: (N, 3) positions, and one for every corner.
        normals: (N, 3), or None.
        uvs: (N, 2), or None.
        colors: as in `ImportedPart`.
        surface: of the part.
        flat: as in `ImportedPart`.
    """
    given = [one for one in (points, normals, uvs) if one is not None]
    key, most = np.zeros(points.index.size, dtype=np.int64), 1
    for one in given:
        if most * (len(one.values) + 1) >= 2**63:  # numbered anew, so that it does not overflow
            key = np.unique(key, return_inverse=True)[1].reshape(-1)
            most = len(key)
        key = key * (len(one.values) + 1) + one.index.reshape(-1) + 1
        most *= len(one.values) + 1
    _, first, faces = np.unique(key, return_index=True, return_inverse=True)

    def rows(one: Looked | None) -> Array | None:
        if one is None:
            return None
        index = one.index.reshape(-1)[first]
        return np.where(index[:, None] >= 0, one.values[index], np.nan)

    vertices = points.values[points.index.reshape(-1)[first]]
    return ImportedPart(vertices, faces.reshape(-1, 3), rows(normals), rows(uvs), colors, surface, flat=flat)
