"""The parts that a mesh's surface is counted by: the cells of a map, and its faces.

The map is that of the mesh's own texture coordinates, cut into cells. Where these cannot tell places of the surface
apart (charts lie on each other, faces without area), the mesh is unwrapped anew for it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from advsearch.scene.assets import Doubles, Ints, Mesh
from advsearch.scene.importing.geometry import Soup
from advsearch.scene.importing.unwrap import unwrapped
from advsearch.scene.raster import doubled_areas, pixels_in, rasterised, weights_at

CELLS = 64
"""Cells along each side of the map."""

MOST_FACES = 20_000
"""Faces of a mesh that are counted one by one; those of a larger one are smaller than what a picture shows apart."""

DOUBLED = 0.01
"""Share of the map that charts may cover twice before the mesh is unwrapped anew."""

FLAT = 0.05
"""Share of the surface that may have no area on the map, likewise."""

COVERED = 0.02
"""Share of the unit square that charts have to cover, likewise."""

_FINE = 256  # side of the raster in which charts are looked at


class SurfaceParts:
    """The cells and the faces of a mesh.

    Args:
        mesh: with texture coordinates of whatever kind.

    Attributes:
        mesh: the mesh.
        unwrapped: whether the map is another one than that of its own texture coordinates.
        corners: (F, 3, 2) where each face lies on the map, in [0, 1]; v = 0 is the bottom.
        by_face: whether the faces are parts too: there are at most `MOST_FACES`.
        count: number of parts: `CELLS` * `CELLS` cells, row by row from v = 1, and then the faces.
        covered: (CELLS, CELLS) whether the middle of a cell lies in a chart.
        face: (count,) the face in the middle of each part; of a cell beside all charts, the nearest one.
        place: (count, 3) the middle of each part, in the mesh's coordinates.
        at: (count, 2) u and v of it.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._own = mesh.uvs[mesh.faces].astype(np.float64)
        self.unwrapped = not _tells_apart(mesh, self._own)
        self.corners = _unwrapped(mesh) if self.unwrapped else self._own
        charts = rasterised(_split(mesh, self.corners), CELLS)
        self.by_face = len(mesh.faces) <= MOST_FACES
        faces = np.arange(len(mesh.faces) if self.by_face else 0)
        self.count = CELLS * CELLS + len(faces)
        self.covered = charts.covered
        middles = mesh.vertices[mesh.faces[faces]].mean(axis=1)
        self.face = np.concatenate([charts.face.reshape(-1), faces])
        self.place = np.concatenate([charts.positions().reshape(-1, 3), middles]).astype(np.float64)
        row, column = np.divmod(np.arange(CELLS * CELLS), CELLS)
        cells = np.stack([(column + 0.5) / CELLS, 1.0 - (row + 0.5) / CELLS], axis=1)
        self.at = np.concatenate([cells, self.corners[faces].mean(axis=1)])

    @property
    def kinds(self) -> dict[str, slice]:
        """Which of the parts are cells, and which are faces."""
        cells = {"cell": slice(0, CELLS * CELLS)}
        return {**cells, "face": slice(CELLS * CELLS, self.count)} if self.by_face else cells

    def cells(self, face: Ints, uv: Doubles) -> Ints:
        """Return the cells (n,) of places on the surface.

        Args:
            face: (n,) numbers of faces.
            uv: (n, 2) the mesh's own texture coordinates there.
        """
        if self.unwrapped:
            weights = weights_at(self._own[face], uv[:, 1], uv[:, 0])  # rows run along v here
            weights = np.clip(np.nan_to_num(weights, nan=1 / 3, posinf=1 / 3, neginf=1 / 3), 0.0, 1.0)
            weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
            uv = np.einsum("nk,nkc->nc", weights, self.corners[face])
        column, row = (
            np.clip(np.floor(one * CELLS), 0, CELLS - 1).astype(np.int64) for one in (uv[:, 0], 1 - uv[:, 1])
        )
        return row * CELLS + column


def _tells_apart(mesh: Mesh, uvs: Doubles) -> bool:
    """Whether texture coordinates (F, 3, 2) give each place of a surface one of its own."""
    if uvs.min() < 0.0 or uvs.max() > 1.0:
        return False
    places = mesh.vertices[mesh.faces].astype(np.float64)
    surface = np.linalg.norm(np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]), axis=1)
    if surface[np.abs(doubled_areas(uvs)) < 1e-12].sum() > FLAT * surface.sum():
        return False
    _, row, column, _ = pixels_in(uvs * _FINE - 0.5, (_FINE, _FINE), tolerance=-1e-6)
    covered = len(np.unique(row * _FINE + column))
    return covered >= COVERED * _FINE**2 and len(row) - covered <= DOUBLED * covered


def _unwrapped(mesh: Mesh) -> Doubles:
    """New texture coordinates (F, 3, 2) that lie beside each other."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    points = (mesh.vertices - low).astype(np.float64) / max(float((high - low).max()), 1e-12)
    welded, number = np.unique(points, axis=0, return_inverse=True)
    faces = number.reshape(-1)[mesh.faces.astype(np.int64)]
    unknown = np.full((len(faces), 3, 3), np.nan)
    soup = Soup(welded, faces, np.zeros(len(faces), np.int64), unknown, unknown[..., :2], np.ones_like(unknown))
    return unwrapped(soup).uvs


def _split(mesh: Mesh, corners: Doubles) -> Mesh:
    """The mesh with other texture coordinates (F, 3, 2), its faces apart."""
    own = mesh.faces.reshape(-1)
    faces = np.arange(len(own), dtype=np.uint32).reshape(-1, 3)
    uvs = corners.reshape(-1, 2).astype(np.float32)
    return replace(mesh, vertices=mesh.vertices[own], faces=faces, normals=mesh.normals[own], uvs=uvs)
