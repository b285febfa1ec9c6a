"""One piece of a mesh file, as the readers of all formats hand it on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from advsearch.scene.importing.surfaces import ImportedSurface

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ImportedPart:
    """One piece of a mesh file, with the transform of its place in the file applied.

    Attributes:
        vertices: (V, 3) float64 positions in the file's axes and units; may hold NaN.
        faces: (F, 3) int64 vertex indices, F > 0.
        normals: (V, 3) float64 of the file, not necessarily unit length or finite; None when the file gives none.
        uvs: (V, 2) float64 of the file, v = 0 at the bottom row; None when the file gives none.
        colors: (F, 3, 3) float64 linear colour of each corner in [0, 1], which multiplies the base colour in linear
            light; None when the file gives none.
        surface: the part's material.
        node: number of its node in a glTF file; -1 in others.
        flat: where the file gives no normals, its faces are flat; otherwise smooth normals are made.
    """

    vertices: Array
    faces: npt.NDArray[np.int64]
    normals: Array | None
    uvs: Array | None
    colors: Array | None
    surface: ImportedSurface
    node: int = -1
    flat: bool = False


def placed(part: ImportedPart, matrix: Array) -> ImportedPart:
    """Return a part moved to its place in the file by an affine transform (4, 4)."""
    if np.array_equal(matrix, np.eye(4)):
        return part
    turn, normals = matrix[:3, :3], part.normals
    with np.errstate(all="ignore"):
        vertices = part.vertices @ turn.T + matrix[:3, 3]
        if normals is not None:  # a normal turns with the cofactors of the matrix
            normals = normals @ np.cross(turn[[1, 2, 0]], turn[[2, 0, 1]]).T
    if not np.linalg.det(turn) < 0.0:
        return replace(part, vertices=vertices, normals=normals)
    colors = None if part.colors is None else part.colors[:, ::-1]  # a mirror turns faces over, and cofactors normals
    return replace(
        part, vertices=vertices, faces=part.faces[:, ::-1], normals=None if normals is None else -normals, colors=colors
    )


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
