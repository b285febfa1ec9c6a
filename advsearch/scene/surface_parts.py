"""Divide a mesh's surface into parts that can be counted: cells of a map, and faces.

The map is the square of the mesh's own texture coordinates, cut into cells. If several
points of the surface have the same texture coordinates (charts overlap, or faces have
no area there), the mesh gets new ones from xatlas.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xatlas
from scipy.sparse import coo_array

from advsearch.scene.assets import (
    Float64Array,
    IntArray,
    Mesh,
    compute_area_vectors,
    group_indices,
)
from advsearch.scene.importing.geometry import (
    TriangleSoup,
    find_components,
    find_shared_edges,
    normalize_vectors,
)
from advsearch.scene.raster import (
    Charts,
    compute_barycentric,
    compute_doubled_areas,
    rasterize_charts,
    rasterize_triangles,
)

ATLAS_SIZE = 512
# texels between charts in an atlas of `ATLAS_SIZE`: two in a texture of half that size
ATLAS_PADDING = 4
# factor on lengths, since xatlas ignores faces below about 1e-7 square units
_XATLAS_SCALE = 100.0
# xatlas treats neighbors as one plane if the product of their normals is over 1 - 1e-4
_MIN_FLUSH_COSINE = 1.0 - 1.5e-4
# smallest cosine between a normal and the mean of its plane, up to which treating it as
# a plane does no harm
_MIN_PLANE_COSINE = np.cos(np.radians(10.0))
# a mesh with more faces is always cut where the surface turns
_FACES_PER_ATLAS = 20_000
_CELL_FACES = ((200_000, 1_500), (10_000, 500))
"""Faces of a mesh above which it is cut for the sake of speed, and how many faces
xatlas then gets at a time at most.

Its time grows with the square of that number: whole, a mesh of 15,000 faces took 3.1
seconds, and so cut 0.4. Larger meshes are cut less, since each chart needs a border.
"""
# more are no surface but a heap of faces, and xatlas would take minutes over them
_MAX_PATCHES = 10_000
# rounds of averaging normals, so that noise does not fray the borders of patches
_SMOOTHING_ROUNDS = 10


def unwrap(soup: TriangleSoup, chart_group: IntArray | None = None) -> TriangleSoup:
    """Return faces with new texture coordinates from xatlas.

    xatlas cuts the surface into charts, which it lays side by side into the unit
    square, without overlap. If the mesh is in very many pieces, xatlas is not used: all
    faces become triangles of one size in a grid. The result is deterministic.

    Args:
        soup: the faces.
        chart_group: (F,) a number for each face; no chart has faces with different
            numbers. None: there is no such limit.
    """
    # (F,) index of the patch of each face: xatlas gets the patches one by one
    patch = _find_patches(soup)
    if chart_group is not None:
        # patches are cut further where the group changes
        patch_and_group = patch * (int(chart_group.max()) + 1) + chart_group
        patch = np.unique(patch_and_group, return_inverse=True)[1].reshape(-1)
    has_too_many_patches = int(patch.max()) >= _MAX_PATCHES  # counted from 0
    if has_too_many_patches:
        return replace(soup, uvs=_make_grid_uvs(len(soup.faces)))
    uvs = _unwrap_patches(soup, patch)
    # An interpolated look-up near a border of the square also reads texels at the
    # opposite border. xatlas leaves no gap there, so that the charts are shrunk: by
    # half a gap on each side.
    margin = 0.5 * ATLAS_PADDING / ATLAS_SIZE
    return replace(soup, uvs=margin + (1.0 - 2.0 * margin) * np.clip(uvs, 0.0, 1.0))


def _unwrap_patches(soup: TriangleSoup, patch: IntArray) -> Float64Array:
    """Return texture coordinates (F, 3, 2) of faces, patch by patch, from xatlas.

    Args:
        soup: the faces.
        patch: (F,) the patch of each face.
    """
    groups = group_indices(patch)
    atlas = _generate_atlas(soup, groups)
    uvs = np.empty((len(soup.faces), 3, 2))
    for index, group in enumerate(groups):
        _vertices, corners, atlas_uvs = atlas[index]
        uvs[group] = np.asarray(atlas_uvs, dtype=np.float64)[np.asarray(corners)]
    return uvs


def _make_grid_uvs(count: int) -> Float64Array:
    """Return texture coordinates (count, 3, 2): two faces in each cell of a grid.

    Faces 0 and 1 are the lower left and the upper right half of the first cell, faces 2
    and 3 those of the second, and so on, row by row from the bottom. The grid is the
    smallest square grid that has room for all faces.

    Args:
        count: number of faces.
    """
    n_columns = int(np.ceil(np.sqrt(np.ceil(count / 2))))
    face = np.arange(count)
    cell = face // 2
    cell_corner = np.stack([cell % n_columns, cell // n_columns], axis=1)[:, None, :]
    # A margin in each cell, and a gap between its two halves, keep faces apart.
    lower_half = np.array([[0.05, 0.05], [0.85, 0.05], [0.05, 0.85]])
    is_lower = (face % 2 == 0)[:, None, None]
    in_cell = np.where(is_lower, lower_half, 1.0 - lower_half)
    return np.asarray((cell_corner + in_cell) / n_columns)


def _generate_atlas(soup: TriangleSoup, groups: Sequence[IntArray]) -> xatlas.Atlas:
    """Unwrap groups of faces into one atlas, of `ATLAS_SIZE` if they fit into it.

    Each group is passed to xatlas as a mesh of its own, so that no chart has faces of
    two groups. If not all charts fit into one atlas of `ATLAS_SIZE`, xatlas makes
    several; then it is run again for one atlas of any size.

    Args:
        soup: the faces.
        groups: for each group the indices of its faces.
    """
    for resolution in (ATLAS_SIZE, 0):  # 0: one atlas, however large
        options = xatlas.PackOptions()
        options.resolution = resolution
        options.padding = ATLAS_PADDING
        atlas = _make_unpacked_atlas(soup, groups)
        atlas.generate(xatlas.ChartOptions(), options)
        if atlas.atlas_count == 1:
            break
    return atlas


def _make_unpacked_atlas(
    soup: TriangleSoup, groups: Sequence[IntArray]
) -> xatlas.Atlas:
    """Return an atlas with a mesh for each group of faces, before it is packed."""
    atlas = xatlas.Atlas()
    for group in groups:
        used, corners = np.unique(soup.faces[group], return_inverse=True)
        atlas.add_mesh(
            (soup.points[used] * _XATLAS_SCALE).astype(np.float32),
            corners.reshape(-1, 3).astype(np.uint32),
        )
    return atlas


def _are_straight(normals: Float64Array, plane: IntArray) -> bool:
    """Return whether all faces have about the mean normal of their plane.

    Args:
        normals: (F, 3).
        plane: (F,) index of the plane of each face.
    """
    plane_sums: Float64Array = np.stack(
        [np.bincount(plane, normals[:, axis]) for axis in range(3)], axis=1
    )
    plane_normals = normalize_vectors(plane_sums)[plane]
    is_straight = (normals * plane_normals).sum(axis=1) > _MIN_PLANE_COSINE
    return bool(is_straight.all())


def _find_patches(soup: TriangleSoup) -> IntArray:
    """Cut a mesh that xatlas cannot unwrap well in one piece.

    xatlas 0.0.11 takes neighbouring faces with almost the same normal for one plane. On
    a finely tessellated smooth surface this goes on from face to face around the full
    object, which is then flattened like a sheet of paper. If the surface is closed, and
    so has no border, the process crashes. Such meshes, and large ones, are cut where
    the surface turns from one of 14 directions to another. Large ones are also cut into
    pieces of about `_CELL_FACES` faces.

    Returns:
        The patch of each face (F,), numbered from 0.
    """
    normals: Float64Array = normalize_vectors(soup.compute_area_vectors())
    count = len(normals)
    # The two faces of each shared edge. `find_shared_edges` returns corners, and the
    # corners 3 f to 3 f + 2 are those of face f.
    left_corner, right_corner, _ = find_shared_edges(soup.faces)
    face = left_corner // 3
    neighbour = right_corner // 3
    patch = np.zeros(count, dtype=np.int64)
    # whether both faces of an edge stay in one patch
    is_same = np.ones(len(face), np.bool_)
    if _has_to_be_cut(normals, face, neighbour):
        direction = _find_directions(normals, face, neighbour)
        is_same = direction[face] == direction[neighbour]
        patch = find_components(count, face[is_same], neighbour[is_same])
    piece = _find_pieces(soup, patch)
    if piece is None:
        return patch
    is_same &= piece[face] == piece[neighbour]
    return find_components(count, face[is_same], neighbour[is_same])


def _has_to_be_cut(normals: Float64Array, face: IntArray, neighbour: IntArray) -> bool:
    """Return whether a mesh is large, or has a curved surface that counts as one plane.

    Args:
        normals: (F, 3) unit normals of the faces.
        face: (E,) index of one face of each shared edge.
        neighbour: (E,) index of the other face.
    """
    count = len(normals)
    is_flush = (normals[face] * normals[neighbour]).sum(axis=1) > _MIN_FLUSH_COSINE
    plane = find_components(count, face[is_flush], neighbour[is_flush])
    return count > _FACES_PER_ATLAS or not _are_straight(normals, plane)


def _find_directions(
    normals: Float64Array, face: IntArray, neighbour: IntArray
) -> IntArray:
    """Return the index (F,) of the cutting direction nearest to each face's normal.

    The directions are the 14 of `_make_cut_directions`. The normals are smoothed
    before.

    Args:
        normals: (F, 3) unit normals of the faces.
        face: (E,) index of one face of each shared edge.
        neighbour: (E,) index of the other face.
    """
    smoothed = _smooth_normals(normals, face, neighbour)
    return np.asarray((smoothed @ _make_cut_directions().T).argmax(axis=1))


def _find_pieces(soup: TriangleSoup, patch: IntArray) -> IntArray | None:
    """Cut the patches of a large mesh into pieces, since xatlas is slow for large ones.

    Args:
        soup: the faces.
        patch: (F,) number of the patch that each face is in.

    Returns:
        (F,) the piece of each face; None if the mesh is too small to need that.
    """
    # The largest meshes come first. A mesh with more than `min_faces` faces gets pieces
    # of at most `max_faces`.
    for min_faces, max_faces in _CELL_FACES:
        if len(patch) > min_faces:
            centers = soup.points[soup.faces].mean(axis=1)
            return _halve_patches(centers, patch, max_faces)
    return None


def _smooth_normals(
    normals: Float64Array, face: IntArray, neighbour: IntArray
) -> Float64Array:
    """Average the normals of faces with their neighbours', in several rounds.

    A round replaces each normal by the unit mean of itself and its neighbours'.

    Args:
        normals: (F, 3) unit normals of the faces.
        face: (E,) index of one face of each shared edge.
        neighbour: (E,) index of the other face.
    """
    count = len(normals)
    itself = np.arange(count)
    rows = np.concatenate([face, neighbour, itself])
    columns = np.concatenate([neighbour, face, itself])
    average = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    average = average.tocsr()
    smoothed = normals
    for _ in range(_SMOOTHING_ROUNDS):
        smoothed = np.nan_to_num(normalize_vectors(average @ smoothed))
    return smoothed


def _make_cut_directions() -> Float64Array:
    """Return the 14 unit directions of a cube's faces and corners."""
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return np.concatenate([faces, corners / np.sqrt(3.0)])


def _halve_patches(centers: Float64Array, patch: IntArray, max_faces: int) -> IntArray:
    """Halve patches until each has at most `max_faces` faces.

    Args:
        centers: (F, 3) centers of the faces.
        patch: (F,) number of the patch that each face is in.
        max_faces: largest number of faces of a piece.

    Returns:
        (F,) the piece of each face, numbered from 0.
    """
    piece_of_face = np.zeros(len(patch), dtype=np.int64)
    n_pieces = 0
    remaining = group_indices(patch)  # groups of faces that may be too large
    while remaining:
        group = remaining.pop()
        if len(group) > max_faces:
            remaining += _halve_group(centers, group)
        else:
            piece_of_face[group] = n_pieces
            n_pieces += 1
    return piece_of_face


def _halve_group(centers: Float64Array, group: IntArray) -> list[IntArray]:
    """Cut a group of faces (n,) across its longest axis, at the median of the centers.

    Args:
        centers: (F, 3) centers of all faces.
        group: (n,) indices of the faces of the group.
    """
    axis = np.ptp(centers[group], axis=0).argmax()
    order = group[np.argsort(centers[group, axis], kind="stable")]
    middle = len(order) // 2
    return [order[:middle], order[middle:]]


MAP_SIZE = 64  # cells along each side of the map
# of a mesh, which are counted one by one; smaller ones cannot be distinguished in an
# image
MAX_FACES = 20_000
# fraction of the map that charts may cover twice before the mesh is unwrapped anew
MAX_DOUBLED_FRACTION = 0.01
MAX_FLAT_FRACTION = (
    0.05  # fraction of the surface that may have no area on the map, likewise
)
MIN_COVERED_FRACTION = (
    0.02  # fraction of the unit square that charts have to cover, likewise
)
_TEST_RASTER_SIZE = 256  # width of the raster in which charts are compared


class SurfaceParts:
    """The parts of a mesh's surface: the cells of a map, and its faces.

    Attributes:
        mesh: mesh with texture coordinates of any kind.
        is_unwrapped: whether the map is not that of the mesh's own texture coordinates.
        face_uvs: (F, 3, 2) where each face lies on the map, in [0, 1]; v = 0 is the
            bottom.
        counts_faces: whether the faces are parts too.
        n_parts: number of parts: cells, row by row from v = 1, and then the faces.
        is_covered: (CELLS, CELLS) whether the center of a cell lies in a chart.
        face_of_part: (count,) the face at the center of each part; of a cell outside of
            all charts the nearest one.
        centers: (count, 3) that center, in the mesh's coordinates.
        center_uvs: (count, 2) and its u and v.
    """

    def __init__(self, mesh: Mesh) -> None:
        """Rasterise the map, and find the center of each cell and of each face.

        The parts of a surface are the cells of its map, row by row, and then its faces.
        A mesh with more than `MAX_FACES` faces has the cells alone.

        Args:
            mesh: the mesh. If its texture coordinates do not tell all points apart, it
                is unwrapped anew.
        """
        self.mesh = mesh
        self._mesh_uvs = mesh.uvs[mesh.faces].astype(np.float64)
        self.is_unwrapped = not _has_unique_uvs(mesh, self._mesh_uvs)
        self.face_uvs = _unwrap_mesh(mesh) if self.is_unwrapped else self._mesh_uvs
        charts = _rasterise_map(mesh, self.face_uvs)
        self.counts_faces = len(mesh.faces) <= MAX_FACES
        n_face_parts = len(mesh.faces) if self.counts_faces else 0
        faces = np.arange(n_face_parts)  # indices of the faces that are parts
        self.n_parts = MAP_SIZE * MAP_SIZE + len(faces)
        self.is_covered = charts.is_covered
        self.face_of_part = np.concatenate([charts.face_index.reshape(-1), faces])
        self.centers = _compute_part_centers(charts, mesh, faces)
        face_center_uvs = self.face_uvs[faces].mean(axis=1)
        self.center_uvs = np.concatenate([_make_cell_uvs(), face_center_uvs])

    @property
    def part_slices(self) -> dict[str, slice]:
        """Which of the parts are cells, and which are faces."""
        kinds = {"cell": slice(0, MAP_SIZE * MAP_SIZE)}
        if self.counts_faces:
            kinds["face"] = slice(MAP_SIZE * MAP_SIZE, self.n_parts)
        return kinds

    def find_cells(self, face: IntArray, uv: Float64Array) -> IntArray:
        """Return the index (n,) of the cell of the map that each point is in.

        If the map has its own texture coordinates (`is_unwrapped`), the point's
        coordinates in it follow from its barycentric weights in the face. Points
        outside of the map count as on its border.

        Args:
            face: (n,) index of the face.
            uv: (n, 2) the mesh's own texture coordinates.
        """
        if self.is_unwrapped:
            u, v = uv.T
            # `compute_barycentric` takes the position in the order of row and column.
            weights = compute_barycentric(self._mesh_uvs[face], v, u)
            # In a face without area the weights are NaN or infinite. A weight of 1/3
            # for each corner is the middle of the face.
            weights = np.nan_to_num(weights, nan=1 / 3, posinf=1 / 3, neginf=1 / 3)
            weights = np.clip(weights, 0.0, 1.0)
            weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
            uv = np.einsum("nk,nkc->nc", weights, self.face_uvs[face])
        map_u, map_v = uv.T
        # v points up, and rows go down
        column_and_row = np.floor(np.stack([map_u, 1 - map_v]) * MAP_SIZE)
        column, row = np.clip(column_and_row, 0, MAP_SIZE - 1).astype(np.int64)
        return np.asarray(row * MAP_SIZE + column)


def _compute_part_centers(charts: Charts, mesh: Mesh, faces: IntArray) -> Float64Array:
    """Return the centers (count, 3) of the cells of a map, then of faces of a mesh.

    Args:
        charts: the rasterized map.
        mesh: the mesh.
        faces: (F,) indices of the faces that are parts.
    """
    cell_centers = charts.compute_positions().reshape(-1, 3)
    face_centers = mesh.vertices[mesh.faces[faces]].mean(axis=1)
    return np.concatenate([cell_centers, face_centers]).astype(np.float64)


def _make_cell_uvs() -> Float64Array:
    """Return u and v (cells, 2) of the middle of each cell; row 0 is at v = 1."""
    row, column = np.divmod(np.arange(MAP_SIZE * MAP_SIZE), MAP_SIZE)
    return np.stack([(column + 0.5) / MAP_SIZE, 1.0 - (row + 0.5) / MAP_SIZE], axis=1)


def _unwrap_mesh(mesh: Mesh) -> Float64Array:
    """Return new texture coordinates (F, 3, 2) of a mesh that do not overlap.

    Vertices at the same position count as one, so that charts are not cut at old seams,
    and the mesh is scaled to a size of 1, as `unwrap` expects.
    """
    lower = mesh.vertices.min(axis=0)
    upper = mesh.vertices.max(axis=0)
    extent = max(float((upper - lower).max()), 1e-12)
    points = (mesh.vertices - lower).astype(np.float64) / extent
    unique_points, unique_index = np.unique(points, axis=0, return_inverse=True)
    faces = unique_index.reshape(-1)[mesh.faces.astype(np.int64)]
    return unwrap(_make_bare_soup(unique_points, faces)).uvs


def _make_bare_soup(points: Float64Array, faces: IntArray) -> TriangleSoup:
    """Return faces (F, 3) of points (N, 3) as `unwrap` expects them.

    `unwrap` uses points and faces alone: the other fields are fillers.
    """
    n_faces = len(faces)
    return TriangleSoup(
        points=points,
        faces=faces,
        part_of_face=np.zeros(n_faces, np.int64),
        normals=np.full((n_faces, 3, 3), np.nan),
        uvs=np.full((n_faces, 3, 2), np.nan),
        colors=np.ones((n_faces, 3, 3)),
    )


def _rasterise_map(mesh: Mesh, uvs: Float64Array) -> Charts:
    """Rasterise texture coordinates (F, 3, 2) of a mesh's faces into the map's
    cells.
    """
    # every corner of a face becomes a vertex, as its texture coordinates are its own
    vertex = mesh.faces.reshape(-1)
    faces = np.arange(len(vertex), dtype=np.uint32).reshape(-1, 3)
    flat_uvs = uvs.reshape(-1, 2).astype(np.float32)
    separate = Mesh(mesh.vertices[vertex], faces, mesh.normals[vertex], flat_uvs)
    return rasterize_charts(separate, MAP_SIZE)


def _has_unique_uvs(mesh: Mesh, uvs: Float64Array) -> bool:
    """Return whether different points of a surface have different texture coordinates.

    There are four conditions. The coordinates are in the unit square. Almost all of the
    surface has an area in the texture. The faces cover enough of the square, and hardly
    any of it twice.

    Args:
        mesh: the mesh.
        uvs: (F, 3, 2) texture coordinates of the corners of its faces.
    """
    if uvs.min() < 0.0 or uvs.max() > 1.0:
        return False
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    areas = np.linalg.norm(compute_area_vectors(corners), axis=1)
    is_flat = np.abs(compute_doubled_areas(uvs)) < 1e-12
    if areas[is_flat].sum() > MAX_FLAT_FRACTION * areas.sum():
        return False
    return _covers_map_once(uvs)


def _covers_map_once(uvs: Float64Array) -> bool:
    """Return whether faces cover enough of the unit square, and hardly any of it twice.

    They are tested on a raster of `_TEST_RASTER_SIZE` pixels a side.

    Args:
        uvs: (F, 3, 2) texture coordinates of the corners of the faces.
    """
    # The raster has the center of its first pixel at 0. By the negative tolerance a
    # pixel on the border of two faces is in neither.
    _face, row, column, _weights = rasterize_triangles(
        uvs * _TEST_RASTER_SIZE - 0.5,
        (_TEST_RASTER_SIZE, _TEST_RASTER_SIZE),
        tolerance=-1e-6,
    )
    # There is one entry for each pixel of each face. A pixel in several faces has
    # several entries.
    n_covered = len(np.unique(row * _TEST_RASTER_SIZE + column))
    n_repeated = len(row) - n_covered
    covers_enough = n_covered >= MIN_COVERED_FRACTION * _TEST_RASTER_SIZE**2
    return covers_enough and n_repeated <= MAX_DOUBLED_FRACTION * n_covered
