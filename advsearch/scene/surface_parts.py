"""The parts that a mesh's surface is counted by: the cells of a map, and its faces.

The map is that of the mesh's own texture coordinates, cut into cells. Where these
cannot tell places of the surface apart (charts lie on each other, faces without area),
the mesh is unwrapped anew for it, with xatlas.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import xatlas
from scipy.sparse import coo_array

from advsearch.scene.assets import Doubles, Ints, Mesh, face_vectors, grouped
from advsearch.scene.importing.geometry import Soup, connected, neighbours, unit_vectors
from advsearch.scene.raster import doubled_areas, pixels_in, rasterised, weights_at

ATLAS_SIZE = 512
# texels between charts in an atlas of `ATLAS_SIZE`: two in a texture of half that size
ATLAS_PADDING = 4
_SCALE = 100.0  # xatlas takes faces under about 1e-7 square units for empty
# xatlas takes neighbours whose normals have a product over 1 - 1e-4 for one plane
_FLUSH = 1.0 - 1.5e-4
# how far the normals of what it takes for a plane may stray before it matters
_PLANE = np.cos(np.radians(10.0))
# faces that xatlas gets at a time, about; its time grows faster than their number
_MANY = 20_000
_LARGE = 200_000  # faces of a mesh from which on that is felt
_PIECE = 1_500  # faces that xatlas then gets at a time, at most
# more are no surface but a heap of faces, and xatlas would take minutes over them
_MOST_PATCHES = 10_000
# rounds of averaging normals, so that noise does not fray the borders of patches
_SMOOTHING = 10


def unwrapped(soup: Soup, apart: Ints | None = None) -> Soup:
    """Return the soup with UVs from xatlas: charts that do not overlap, inside the unit
    square; deterministic. Faces with different numbers in `apart` (F,) get charts of
    their own. The faces of a mesh in very many pieces become triangles of one size,
    side by side in a grid.
    """
    patch = _patches(soup)
    if apart is not None:
        patch = np.unique(patch * (int(apart.max()) + 1) + apart, return_inverse=True)[
            1
        ].reshape(-1)
    if int(patch.max()) >= _MOST_PATCHES:  # two faces to each cell of a grid
        count = len(soup.faces)
        columns = int(np.ceil(np.sqrt(np.ceil(count / 2))))
        cell = np.arange(count) // 2
        corner = np.stack([cell % columns, cell // columns], axis=1)[:, None, :]
        half = np.array([[0.05, 0.05], [0.85, 0.05], [0.05, 0.85]])
        inside = np.where((np.arange(count) % 2 == 0)[:, None, None], half, 1.0 - half)
        return replace(soup, uvs=np.asarray((corner + inside) / columns))
    groups = grouped(patch)
    for size in (ATLAS_SIZE, 0):  # 0: one atlas, however large
        atlas = xatlas.Atlas()
        for group in groups:
            used, corners = np.unique(soup.faces[group], return_inverse=True)
            atlas.add_mesh(
                (soup.points[used] * _SCALE).astype(np.float32),
                corners.reshape(-1, 3).astype(np.uint32),
            )
        options = xatlas.PackOptions()
        options.resolution = size
        options.padding = ATLAS_PADDING
        atlas.generate(xatlas.ChartOptions(), options)
        if atlas.atlas_count == 1:
            break
    result = np.empty((len(soup.faces), 3, 2))
    for number, group in enumerate(groups):
        _, corners, uvs = atlas[number]
        result[group] = np.asarray(uvs, dtype=np.float64)[np.asarray(corners)]
    # lookups repeat at the border, where xatlas keeps nothing apart
    margin = 0.5 * ATLAS_PADDING / ATLAS_SIZE
    return replace(soup, uvs=margin + (1.0 - 2.0 * margin) * np.clip(result, 0.0, 1.0))


def _patches(soup: Soup) -> Ints:
    """Cut a mesh that xatlas cannot unwrap well in one piece; return the patch of each
    face (F,), numbered from 0.

    xatlas 0.0.11 takes neighbouring faces that hardly bend for one plane. On a finely
    tessellated smooth surface that goes on from face to face around the whole object,
    which is then flattened like a sheet of paper; where a closed surface leaves no
    border, the process crashes. Such meshes, and large ones for the sake of speed, are
    cut where the surface turns from one of 14 directions to another.
    """
    unit: Doubles = unit_vectors(soup.face_vectors())
    left, right, _ = neighbours(soup.faces)
    f = left // 3
    g = right // 3
    flush = (unit[f] * unit[g]).sum(axis=1) > _FLUSH
    plane = connected(len(unit), f[flush], g[flush])
    mean: Doubles = np.stack([np.bincount(plane, unit[:, k]) for k in range(3)], axis=1)
    straight = (unit * unit_vectors(mean)[plane]).sum(axis=1) > _PLANE
    if straight.all() and len(unit) <= _MANY:
        return np.zeros(len(unit), dtype=np.int64)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(
        -1, 3
    ) / np.sqrt(3.0)
    own = np.arange(len(unit))
    links = np.concatenate([f, g, own]), np.concatenate([g, f, own])
    average = coo_array(
        (np.ones(len(links[0])), links), shape=(len(unit), len(unit))
    ).tocsr()
    smoothed = unit
    for _ in range(_SMOOTHING):  # the normals of faces with their neighbours'
        smoothed = np.nan_to_num(unit_vectors(average @ smoothed))
    facing = smoothed @ np.concatenate([axes, corners]).T
    direction = facing.argmax(axis=1)
    same = direction[f] == direction[g]
    patch = connected(len(unit), f[same], g[same])
    if len(unit) <= _LARGE:
        return patch
    cell = _cells(soup.points[soup.faces].mean(axis=1), patch)
    near = same & (cell[f] == cell[g])
    return connected(len(unit), f[near], g[near])


def _cells(middles: Doubles, patch: Ints) -> Ints:
    """Halve patches (F,) until they are small; return the cell (F,) of each face, whose
    middles are (F, 3).
    """
    cell = np.zeros(len(patch), dtype=np.int64)
    count = 0
    left = grouped(patch)
    while left:
        group = left.pop()
        if len(group) > _PIECE:
            axis = np.ptp(middles[group], axis=0).argmax()
            order = group[np.argsort(middles[group, axis], kind="stable")]
            left += [order[: len(order) // 2], order[len(order) // 2 :]]
        else:
            cell[group], count = count, count + 1
    return cell


CELLS = 64  # cells along each side of the map
# of a mesh, which are counted one by one; smaller ones are not told apart in a picture
MOST_FACES = 20_000
# share of the map that charts may cover twice before the mesh is unwrapped anew
DOUBLED = 0.01
FLAT = 0.05  # share of the surface that may have no area on the map, likewise
COVERED = 0.02  # share of the unit square that charts have to cover, likewise
_FINE = 256  # side of the raster in which charts are looked at


class SurfaceParts:
    """The cells and the faces of a mesh with texture coordinates of whatever kind."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._own = mesh.uvs[mesh.faces].astype(np.float64)
        # whether the map is another one than that of its own texture coordinates
        self.unwrapped = not _tells_apart(mesh, self._own)
        # (F, 3, 2) where each face lies on the map, in [0, 1]; v = 0 is the bottom
        self.corners = self._own
        if self.unwrapped:
            low = mesh.vertices.min(axis=0)
            high = mesh.vertices.max(axis=0)
            points = (mesh.vertices - low).astype(np.float64) / max(
                float((high - low).max()), 1e-12
            )
            welded, number = np.unique(points, axis=0, return_inverse=True)
            corners = number.reshape(-1)[mesh.faces.astype(np.int64)]
            unknown = np.full((len(corners), 3, 3), np.nan)
            part = np.zeros(len(corners), np.int64)
            self.corners = unwrapped(
                Soup(
                    welded,
                    corners,
                    part,
                    unknown,
                    unknown[..., :2],
                    np.ones_like(unknown),
                )
            ).uvs
        own = mesh.faces.reshape(-1)
        apart = np.arange(len(own), dtype=np.uint32).reshape(-1, 3)
        uvs = self.corners.reshape(-1, 2).astype(np.float32)
        charts = rasterised(
            Mesh(mesh.vertices[own], apart, mesh.normals[own], uvs), CELLS
        )
        self.by_face = len(mesh.faces) <= MOST_FACES  # whether the faces are parts too
        faces = np.arange(len(mesh.faces) if self.by_face else 0)
        # of the parts: cells, row by row from v = 1, and then the faces
        self.count = CELLS * CELLS + len(faces)
        # (CELLS, CELLS) whether the middle of a cell lies in a chart
        self.covered = charts.covered
        middles = mesh.vertices[mesh.faces[faces]].mean(axis=1)
        # the face in the middle of each part (count,), of a cell beside all charts the
        # nearest one; that middle (count, 3), in the mesh's coordinates; and its u and
        # v (count, 2)
        self.face = np.concatenate([charts.face.reshape(-1), faces])
        self.place = np.concatenate(
            [charts.positions().reshape(-1, 3), middles]
        ).astype(np.float64)
        row, column = np.divmod(np.arange(CELLS * CELLS), CELLS)
        cells = np.stack([(column + 0.5) / CELLS, 1.0 - (row + 0.5) / CELLS], axis=1)
        self.at = np.concatenate([cells, self.corners[faces].mean(axis=1)])

    @property
    def kinds(self) -> dict[str, slice]:
        """Which of the parts are cells, and which are faces."""
        cells = {"cell": slice(0, CELLS * CELLS)}
        return (
            {**cells, "face": slice(CELLS * CELLS, self.count)}
            if self.by_face
            else cells
        )

    def cells(self, face: Ints, uv: Doubles) -> Ints:
        """Return the cells (n,) of places on faces (n,), at the mesh's own texture
        coordinates (n, 2).
        """
        if self.unwrapped:
            # rows run along v here
            weights = weights_at(self._own[face], uv[:, 1], uv[:, 0])
            weights = np.clip(
                np.nan_to_num(weights, nan=1 / 3, posinf=1 / 3, neginf=1 / 3), 0.0, 1.0
            )
            weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
            uv = np.einsum("nk,nkc->nc", weights, self.corners[face])
        cells = np.floor(np.stack([uv[:, 0], 1 - uv[:, 1]]) * CELLS)
        column, row = np.clip(cells, 0, CELLS - 1).astype(np.int64)
        return np.asarray(row * CELLS + column)


def _tells_apart(mesh: Mesh, uvs: Doubles) -> bool:
    if uvs.min() < 0.0 or uvs.max() > 1.0:
        return False
    surface = np.linalg.norm(
        face_vectors(mesh.vertices[mesh.faces].astype(np.float64)), axis=1
    )
    if surface[np.abs(doubled_areas(uvs)) < 1e-12].sum() > FLAT * surface.sum():
        return False
    _, row, column, _ = pixels_in(uvs * _FINE - 0.5, (_FINE, _FINE), tolerance=-1e-6)
    covered = len(np.unique(row * _FINE + column))
    return covered >= COVERED * _FINE**2 and len(row) - covered <= DOUBLED * covered
