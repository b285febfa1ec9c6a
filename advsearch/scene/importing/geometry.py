"""Repair of imported geometry: welding, faces without area, winding, normals.

All steps work on a `TriangleSoup`: welded points, and attributes of the corners of
faces. So no step depends on how a file splits its vertices. Vertices are split again,
where normals or UVs differ, when the mesh is assembled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.errors import InputError
from advsearch.scene.assets import (
    BoolArray,
    Float32Array,
    Float64Array,
    IntArray,
    Mesh,
    compute_area_vectors,
)
from advsearch.scene.importing.files import Notes
from advsearch.scene.importing.parts import ImportedPart

WELD_DISTANCE = 1e-6
"""Points closer than this fraction of the largest extent become one point; text and
32-bit files round to about that.
"""
# Faces up to this doubled area, in squared extents, are treated as having no area.
MIN_DOUBLED_AREA = 1e-12
CREASE_DEGREES = 40.0
"""Largest angle between two neighboring faces at which normals are smoothed across
their edge.
"""
MIN_NORMAL_AGREEMENT = 0.98
"""Fraction of the surface on which a file's normals must agree with the faces for the
normals to be used.
"""


@dataclass(frozen=True, eq=False)
class TriangleSoup:
    """Triangles with welded points and per-corner attributes.

    P points, F faces; the corner k of face f is entry (f, k).
    """

    points: Float64Array  # (P, 3), the largest extent 1
    faces: IntArray  # (F, 3) points
    part_of_face: IntArray  # (F,) the part of the file that the face belongs to
    normals: Float64Array  # (F, 3, 3) unit normals of the corners; NaN if unknown
    uvs: Float64Array  # (F, 3, 2); NaN if unknown
    # (F, 3, 3) linear factors of the base color; 1 if the file has none.
    colors: Float64Array
    # (F,) whether a face is shaded flat if it has no normals; None if no face is.
    is_flat: BoolArray | None = None
    # (F, 3) for each corner its vertex in the concatenated parts; None if unknown.
    stored_vertices: IntArray | None = None

    def select_faces(self, mask: BoolArray) -> TriangleSoup:
        """Return the soup with the faces selected by a mask (F,)."""
        # All fields but the points have an entry for each face.
        selected = {
            name: values[mask]
            for name, values in vars(self).items()
            if name != "points" and values is not None
        }
        return replace(self, **selected)

    def flip_faces(self, mask: BoolArray) -> TriangleSoup:
        """Return the soup with the faces of a mask (F,) wound the other way.

        The normals of the corners keep their direction.
        """
        # The last two corners of a flipped face are swapped, with all their attributes.
        order = np.where(mask[:, None], [0, 2, 1], [0, 1, 2])
        rows = np.arange(len(order))[:, None]
        names = ["faces", "normals", "uvs", "colors"]
        if self.stored_vertices is not None:
            names.append("stored_vertices")
        return replace(
            self, **{name: getattr(self, name)[rows, order] for name in names}
        )

    def compute_area_vectors(self) -> Float64Array:
        """Return face normals (F, 3), as long as twice the faces' areas."""
        return compute_area_vectors(self.points[self.faces])


def compute_rotation(up: str, front: str) -> Float64Array:
    """Return the rotation (3, 3) from a file's axes to ours (front +x, up +z).

    Args:
        up: "y" or "z".
        front: one of `FRONT_AXES`, such as "-y", but not along `up`.
    """
    sign = front[0]
    letter = front[1]
    front_axis = np.eye(3)["xyz".index(letter)]
    front_axis = front_axis * (-1.0 if sign == "-" else 1.0)
    up_axis = np.eye(3)["xyz".index(up)]
    side_axis = np.cross(up_axis, front_axis)
    # Adding 0 turns -0.0 into 0.0.
    return np.stack([front_axis, side_axis, up_axis]) + 0.0


def _check_extent(extent: float, source: str) -> None:
    """Raise InputError if the extent of an object is 0, infinite or NaN.

    `source` is the name of the file, for messages.
    """
    if 0.0 < extent < np.inf:
        return
    problem = "its extent is too large to compute with"
    if extent == 0.0:
        problem = "all vertices coincide"
    raise InputError(
        f"{source}: expected an object with a size, got a mesh in "
        f"which {problem}; export it again"
    )


def join_parts(
    parts: Sequence[ImportedPart], source: str, turn: Float64Array
) -> TriangleSoup:
    """Join parts into one soup of unit extent with welded points.

    A vertex v becomes turn (v - lower_corner) / extent, where lower_corner is the lower
    corner of the bounding box and extent its largest side. The box is that of the
    vertices which faces use. Normals are rotated too, and become unit vectors.

    Args:
        parts: at least one.
        source: name of the file, for messages.
        turn: rotation (3, 3) that is applied to all parts.

    Raises:
        InputError: vertices are NaN or infinite, or the object has no extent.
    """
    faces = _concatenate_faces(parts)
    points, point_of_vertex = _join_points(parts, faces, source, turn)
    n_faces = [len(part.faces) for part in parts]
    return TriangleSoup(
        points=points,
        faces=point_of_vertex[faces],
        part_of_face=np.arange(len(parts)).repeat(n_faces),
        normals=_join_normals(parts) @ turn.T,
        uvs=_join_uvs(parts),
        colors=_join_colors(parts),
        is_flat=np.array([part.flat for part in parts]).repeat(n_faces),
        stored_vertices=faces if _has_movable_part(parts) else None,
    )


def _join_points(
    parts: Sequence[ImportedPart], faces: IntArray, source: str, turn: Float64Array
) -> tuple[Float64Array, IntArray]:
    """Weld the vertices of all parts, scaled to extent 1 and turned; see `join_parts`.

    Args:
        parts: the parts.
        faces: (F, 3) the faces of all parts, as indices of all their vertices.
        source: name of the file, for messages.
        turn: the rotation (3, 3).

    Returns:
        The points (P, 3), and the point of each vertex (V,) of the concatenated parts.
    """
    vertices = np.concatenate([part.vertices for part in parts])
    _check_finite(vertices, source)
    used = find_used(faces, len(vertices))
    lower_corner = vertices[used].min(axis=0)
    extent = compute_extent(parts)
    _check_extent(extent, source)
    scaled_vertices = (vertices - lower_corner) / extent
    # Adding 0 turns -0.0 into 0.0, so that both are one point.
    return _weld(scaled_vertices @ turn.T + 0.0)


def _join_normals(parts: Sequence[ImportedPart]) -> Float64Array:
    """Return the unit normals of the corners of all parts, (F, 3, 3); NaN if unknown."""
    normals = [_gather_at_corners(part.normals, part.faces, 3) for part in parts]
    return normalize_vectors(np.concatenate(normals))


def _join_uvs(parts: Sequence[ImportedPart]) -> Float64Array:
    """Return the UVs of the corners of all parts, (F, 3, 2); NaN if unknown."""
    return np.concatenate(
        [_gather_at_corners(part.uvs, part.faces, 2) for part in parts]
    )


def _join_colors(parts: Sequence[ImportedPart]) -> Float64Array:
    """Return the factors of the colors of the corners of all parts, (F, 3, 3).

    They are 1, which changes nothing, where a part has no colors.
    """
    colors = [
        np.ones((len(part.faces), 3, 3)) if part.colors is None else part.colors
        for part in parts
    ]
    return np.concatenate(colors)


def _has_movable_part(parts: Sequence[ImportedPart]) -> bool:
    """Return whether some part has joints or morph targets.

    They move vertices as the file stores them, so that the stored vertex of each corner
    has to be known.
    """
    return any(part.movable is not None for part in parts)


def _concatenate_faces(parts: Sequence[ImportedPart]) -> IntArray:
    """Return the faces (F, 3) of all parts, as indices of all their vertices."""
    vertex_starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    return np.concatenate(
        [
            part.faces + start
            for part, start in zip(parts, vertex_starts[:-1], strict=True)
        ]
    )


def _check_finite(vertices: Float64Array, source: str) -> None:
    """Raise InputError if vertices (V, 3) are NaN or infinite."""
    is_bad = ~np.isfinite(vertices).all(axis=1)
    if is_bad.any():
        first_bad = int(is_bad.argmax())
        raise InputError(
            f"{source}: expected finite vertices, got {int(is_bad.sum())} of "
            f"{len(vertices)} with NaN or infinite"
            f" coordinates (the first: {vertices[first_bad].tolist()}); repair the mesh or "
            "export it again"
        )


def _weld(vertices: Float64Array) -> tuple[Float64Array, IntArray]:
    """Merge vertices (V, 3) that are closer than `WELD_DISTANCE` into one point.

    Returns:
        The points (P, 3), and the point of each vertex (V,).
    """
    # Imported here, since the reader of USD, a separate process, needs no scipy.
    from scipy.spatial import cKDTree

    # Equal vertices are merged first, which leaves fewer points for the search of near
    # ones. Points that are connected by a chain of near pairs are a cluster. The first
    # point of a cluster replaces all others.
    first_vertex, point_of_vertex = find_unique_rows(vertices)
    points = vertices[first_vertex]
    pairs = cKDTree(points).query_pairs(WELD_DISTANCE, output_type="ndarray")
    if len(pairs):
        cluster = find_components(len(points), pairs[:, 0], pairs[:, 1])
        _, first_of_cluster, cluster_of_point = np.unique(
            cluster, return_index=True, return_inverse=True
        )
        points = points[first_of_cluster]
        point_of_vertex = cluster_of_point[point_of_vertex].astype(np.int64)
    return points, point_of_vertex


def find_unique_rows(rows: npt.NDArray[Any]) -> tuple[IntArray, IntArray]:
    """Find the distinct rows of an array (N, k), in rising order.

    It is `numpy.unique(rows, axis=0)` in a third of the time. Rows must have no NaN.

    Returns:
        The first index of each distinct row (U,); and for each row (N,) the index of
        the distinct row that it equals.
    """
    order = np.lexsort(rows.T[::-1])  # sorted by the first column, then the second, ...
    is_new = np.ones(len(rows), np.bool_)
    is_new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    unique_of_row = np.empty(len(rows), np.int64)
    unique_of_row[order] = np.cumsum(is_new) - 1
    return order[is_new], unique_of_row


def find_used(faces: IntArray, count: int) -> IntArray:
    """Return the indices (U,), in rising order, of the vertices that faces use.

    `count` is the number of all vertices.
    """
    is_used = np.zeros(count, np.bool_)
    is_used[faces] = True
    return np.flatnonzero(is_used)


def list_used_vertices(parts: Sequence[ImportedPart]) -> list[Float64Array]:
    """Return for each part the vertices (U, 3) that its faces use."""
    return [part.vertices[find_used(part.faces, len(part.vertices))] for part in parts]


def compute_extent(parts: Sequence[ImportedPart]) -> float:
    """Return the largest extent of all faces along an axis, in the file's unit.

    It is infinite if it is too large for float64.
    """
    used_vertices = list_used_vertices(parts)
    lower = np.min([points.min(axis=0) for points in used_vertices], axis=0)
    upper = np.max([points.max(axis=0) for points in used_vertices], axis=0)
    # Halves are subtracted, since numpy would warn about a difference that overflows.
    # Python's multiplication yields infinity without a warning.
    return float((upper / 2 - lower / 2).max()) * 2


def repair_soup(soup: TriangleSoup, source: str, notes: Notes) -> TriangleSoup:
    """Repair a soup that `join_parts` returned.

    Faces without area are removed, the winding becomes consistent and outward, and
    every normal has unit length and is on the front of its face.

    Args:
        soup: the soup, of extent 1.
        source: name of the file, for messages.
        notes: notes about the file, to which the changes are added.

    Raises:
        InputError: no face has an area; the message names the file, `source`.
    """
    has_no_area = (
        np.linalg.norm(soup.compute_area_vectors(), axis=1) <= MIN_DOUBLED_AREA
    )
    if has_no_area.all():
        raise InputError(
            f"{source}: expected faces with an area, got {len(has_no_area)} "
            "without; export it again"
        )
    if has_no_area.any():
        notes.warn(f"{int(has_no_area.sum())} faces without area were removed")
        soup = soup.select_faces(~has_no_area)
    return _fix_normals(_fix_winding(soup, notes), notes)


def make_mesh_from_soup(soup: TriangleSoup) -> tuple[Mesh, IntArray | None]:
    """Return the soup as a mesh, and the stored vertex of each of its vertices.

    The stored vertex of a corner is the index of its vertex in the file's concatenated
    parts. It is known if `soup.stored_vertices` is not None; otherwise the second value
    is None. Corners become one vertex of the mesh if they have the same point, normal
    and UV, and also the same stored vertex if that is known.
    """
    normals = _round_to_float32(soup.normals).reshape(-1, 3)
    uvs = _round_to_float32(soup.uvs).reshape(-1, 2)
    keys = _make_corner_keys(soup, normals, uvs)
    first_corner, vertex_of_corner = find_unique_rows(keys)
    point_of_vertex = soup.faces.reshape(-1)[first_corner]
    mesh = Mesh(
        vertices=soup.points[point_of_vertex].astype(np.float32),
        faces=vertex_of_corner.reshape(-1, 3).astype(np.uint32),
        normals=normals[first_corner],
        uvs=uvs[first_corner],
    )
    if soup.stored_vertices is None:
        return mesh, None
    return mesh, soup.stored_vertices.reshape(-1)[first_corner]


def _make_corner_keys(
    soup: TriangleSoup, normals: Float32Array, uvs: Float32Array
) -> npt.NDArray[Any]:
    """Return a row of integers (3 F, k) for each corner, equal for the same vertex.

    Floats are compared by their bits, as integers.

    Args:
        soup: the faces.
        normals: (3 F, 3) normal at each corner.
        uvs: (3 F, 2) UVs at each corner.
    """
    corners = soup.faces.reshape(-1)
    keys = np.column_stack([corners, normals.view(np.int32), uvs.view(np.int32)])
    if soup.stored_vertices is not None:
        keys = np.column_stack([keys, soup.stored_vertices.reshape(-1)])
    return keys


def _round_to_float32(values: Float64Array) -> Float32Array:
    """Return values as float32, without -0.0, whose bits are not those of 0.0."""
    rounded: Float32Array = values.astype(np.float32) + np.float32(0.0)
    return rounded


# ---- Winding ----


def _fix_winding(soup: TriangleSoup, notes: Notes) -> TriangleSoup:
    """Return the soup with consistent and outward winding, and note the changes.

    Faces wound against their neighbors are turned over first. Then shells that are
    inside out are turned over. A shell is a set of faces that are connected by edges.
    """
    is_turned, shell, has_moebius_strip = _find_turned_faces(soup)
    _note_turned_faces(is_turned, has_moebius_strip, notes)
    soup = soup.flip_faces(is_turned)
    is_shell_inside_out = _find_inside_out_shells(soup, shell)
    is_inside_out = is_shell_inside_out[shell]
    if is_inside_out.any():
        notes.warn(
            f"{int(is_inside_out.sum())} faces were inside out and have been turned "
            "over"
        )
    return soup.flip_faces(is_inside_out)


def _note_turned_faces(
    is_turned: BoolArray, has_moebius_strip: bool, notes: Notes
) -> None:
    """Warn of faces (F,) that are turned over for their neighbors, and of one side."""
    if is_turned.any():
        notes.warn(
            f"{int(is_turned.sum())} faces wound against their neighbours were turned "
            "over"
        )
    if has_moebius_strip:
        notes.warn(
            "has a one-sided surface (a Moebius strip), so the backs of some faces are "
            "visible"
        )


def find_shared_edges(faces: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """Find the edges that belong to exactly two faces (F, 3).

    A face has three sides. Side k runs from corner k to the next corner of the face,
    and is identified by its first corner, which has the index 3 f + k in face f. Two
    sides with the same ends are one edge.

    Returns:
        For each edge (E,) its side in one face, and its side in the other face. And
        (E,) whether both sides run in the same direction: then the faces disagree in
        winding.
    """
    start = faces.reshape(-1)
    end = np.roll(faces, -1, axis=1).reshape(-1)
    left_corner, right_corner = _pair_sides(start, end)
    return left_corner, right_corner, start[left_corner] == start[right_corner]


def _pair_sides(start: IntArray, end: IntArray) -> tuple[IntArray, IntArray]:
    """Return the two sides of each edge (E,) that has exactly two.

    Args:
        start, end: (3 F,) the points at the ends of each side of a face.
    """
    lower = np.minimum(start, end)
    upper = np.maximum(start, end)
    # Sorted by their ends, the sides of an edge follow one another.
    sorted_sides = np.lexsort((upper, lower))
    ends_differ = (np.diff(lower[sorted_sides]) != 0) | (
        np.diff(upper[sorted_sides]) != 0
    )
    edge_begin = np.flatnonzero(np.concatenate([[True], ends_differ]))
    n_sides = np.diff(np.append(edge_begin, len(sorted_sides)))
    pair_begin = edge_begin[n_sides == 2]
    return sorted_sides[pair_begin], sorted_sides[pair_begin + 1]


def _link_windings(
    left_face: IntArray, right_face: IntArray, same_direction: BoolArray
) -> tuple[IntArray, IntArray]:
    """Link the states of neighboring faces that agree in winding.

    Each face f has two states, which are nodes of a graph: 2 f for "as it is" and
    2 f + 1 for "turned". A shared edge links each state of its left face to the state
    of its right face that agrees with it.

    Args:
        left_face: (E,) one face of each shared edge.
        right_face: (E,) the other face.
        same_direction: (E,) whether both run along the edge in the same direction, so
            that one of them must be turned.

    Returns:
        The first and the second node (2 E,) of each link.
    """
    left_as_is = 2 * left_face
    left_turned = 2 * left_face + 1
    right_as_is = 2 * right_face
    right_turned = 2 * right_face + 1
    match_of_as_is = np.where(same_direction, right_turned, right_as_is)
    match_of_turned = np.where(same_direction, right_as_is, right_turned)
    first_node = np.concatenate([left_as_is, left_turned])
    second_node = np.concatenate([match_of_as_is, match_of_turned])
    return first_node, second_node


def _select_windings(
    winding_as_is: IntArray, winding_turned: IntArray, area: Float64Array
) -> BoolArray:
    """Return which faces (F,) to turn over, so that most area of each shell stays.

    A shell has two consistent windings. The windings of all shells are numbered from 0.
    One winding of a shell leaves a face as it is, and the other turns it over. The one
    that leaves more area as it is is selected.

    Args:
        winding_as_is: (F,) index of the winding that leaves the face as it is.
        winding_turned: (F,) index of the winding that turns the face over.
        area: (F,) twice the area of each face.
    """
    n_windings = int(max(winding_as_is.max(), winding_turned.max())) + 1
    # (windings,) the area of the faces that each winding leaves as they are
    unturned_area = np.bincount(winding_as_is, weights=area, minlength=n_windings)
    # (F,) for the face's shell, the area that stays if the face stays, or is turned
    area_if_face_stays = unturned_area[winding_as_is]
    area_if_face_turned = unturned_area[winding_turned]
    # If both areas are equal, the winding with the lower index is selected. It leaves
    # the first face of the shell as it is: windings are numbered in the order of nodes,
    # and the first face's node "as it is" comes first.
    is_tie = area_if_face_turned == area_if_face_stays
    is_turned_lower = winding_turned < winding_as_is
    is_turned: BoolArray = (area_if_face_turned > area_if_face_stays) | (
        is_tie & is_turned_lower
    )
    return is_turned


def _find_turned_faces(soup: TriangleSoup) -> tuple[BoolArray, IntArray, bool]:
    """Decide which faces to turn over so that neighbours agree in winding.

    Every face f has two nodes in a graph: 2 f for "as it is" and 2 f + 1 for "turned".
    If two neighbours agree, their equal nodes are linked; otherwise the opposite ones.
    So a connected component is a consistent winding of all faces of a shell, and the
    shell's other component is the reverse winding. If both are the same component, the
    shell is one-sided. The winding that turns less area over is selected.

    Returns:
        Which faces (F,) to turn over; the shell of each face (F,); and whether some
        shell is one-sided.
    """
    left_corner, right_corner, same_direction = find_shared_edges(soup.faces)
    area = np.linalg.norm(soup.compute_area_vectors(), axis=1)
    # Corner c is a corner of face c // 3.
    first_node, second_node = _link_windings(
        left_corner // 3, right_corner // 3, same_direction
    )
    component = find_components(2 * len(area), first_node, second_node)
    component_as_is = component[0::2]
    component_turned = component[1::2]
    is_turned = _select_windings(component_as_is, component_turned, area)
    has_moebius_strip = bool((component_as_is == component_turned).any())
    shell = _number_shells(component_as_is, component_turned)
    return is_turned, shell, has_moebius_strip


def _number_shells(component_as_is: IntArray, component_turned: IntArray) -> IntArray:
    """Return the shell of each face (F,), from the components of its two windings (F,).

    A shell has two components, or one if it is one-sided. The lower one identifies the
    shell.
    """
    shell_component = np.minimum(component_as_is, component_turned)
    _, shell = np.unique(shell_component, return_inverse=True)
    return shell.astype(np.int64)


def _compute_shell_bounds(
    soup: TriangleSoup, shell: IntArray, n_shells: int
) -> tuple[Float64Array, Float64Array]:
    """Return the lower and the upper corner (S, 3) of the box around each shell."""
    corners = soup.points[soup.faces]
    lower = np.full((n_shells, 3), np.inf)
    upper = np.full((n_shells, 3), -np.inf)
    np.minimum.at(lower, shell, corners.min(axis=1))
    np.maximum.at(upper, shell, corners.max(axis=1))
    return lower, upper


def _find_closed_shells(
    soup: TriangleSoup, shell: IntArray, face_counts: IntArray
) -> BoolArray:
    """Return for each shell (S,) whether all its edges belong to two of its faces.

    In a closed shell of n faces, the 3 n sides of the faces are paired into edges, so
    that twice the number of shared edges is 3 n.

    Args:
        soup: the faces.
        shell: (F,) the shell of each face.
        face_counts: (S,) the number of faces of each shell.
    """
    left_corner, _, _ = find_shared_edges(soup.faces)
    edge_shell = shell[left_corner // 3]  # corner c is a corner of face c // 3
    paired_edges = np.bincount(edge_shell, minlength=len(face_counts)) * 2
    return np.equal(paired_edges, 3 * face_counts)


def _find_inside_out_shells(soup: TriangleSoup, shell: IntArray) -> BoolArray:
    """Return for each shell (S,) whether it must be turned over.

    In a closed shell every edge belongs to exactly two faces. Closed shells are handled
    in two steps. First, if their signed volumes add up to less than 0, all of them are
    turned over. Second, a shell whose volume is negative then is turned over, too. But
    if it is inside another closed shell, it may be the wall of a hollow space: it is
    turned over only if the file's normals point away from its front. An open shell is
    turned over if the file's normals point away from its front.

    Args:
        soup: a soup whose neighbours agree in winding.
        shell: the shell of each face, (F,).
    """
    face_counts = np.bincount(shell)
    vectors = soup.compute_area_vectors()
    n_shells = len(face_counts)
    is_closed = _find_closed_shells(soup, shell, face_counts)
    volume = _compute_signed_volumes(soup, shell, vectors, face_counts)
    agreement = _compute_normal_agreement(soup, shell, vectors, n_shells)
    bounds = _compute_shell_bounds(soup, shell, n_shells)
    is_closed_turned = _find_inside_out_closed_shells(
        is_closed, volume, agreement, bounds
    )
    is_open_turned = agreement < 0.0
    return np.where(is_closed, is_closed_turned, is_open_turned)


def _find_inside_out_closed_shells(
    is_closed: BoolArray,
    volume: Float64Array,
    agreement: Float64Array,
    bounds: tuple[Float64Array, Float64Array],
) -> BoolArray:
    """Return which closed shells (S,) to turn over, by the two steps of the caller.

    The values of open shells mean nothing.

    Args:
        is_closed: (S,) which shells are closed.
        volume: (S,) signed volumes.
        agreement: (S,) how far the file's normals agree with the faces.
        bounds: lower and upper corners (S, 3) of the boxes of all shells.
    """
    # First step. Turning reverses the signs of volumes and agreements.
    are_all_turned = volume[is_closed].sum() < 0.0
    is_negative = (volume < 0.0) != are_all_turned
    agreement_after_step = -agreement if are_all_turned else agreement
    # Second step
    is_turned_again = is_negative.copy()
    for index in np.flatnonzero(is_closed & is_negative):
        if _is_enclosed(int(index), is_closed, bounds):
            is_turned_again[index] = agreement_after_step[index] < 0.0
    # A closed shell that is turned over in both steps is as before.
    is_turned: BoolArray = is_turned_again != are_all_turned
    return is_turned


def _is_enclosed(
    index: int, is_closed: BoolArray, bounds: tuple[Float64Array, Float64Array]
) -> bool:
    """Return whether a closed shell has a bounding box around that of shell `index`.

    Args:
        index: index of the shell.
        is_closed: (S,) which shells are closed.
        bounds: lower and upper corners (S, 3) of the boxes of all shells.
    """
    lower, upper = bounds
    is_enclosing = (
        is_closed
        & (lower < lower[index]).all(axis=1)
        & (upper > upper[index]).all(axis=1)
    )
    return bool(is_enclosing.any())


def _compute_normal_agreement(
    soup: TriangleSoup, shell: IntArray, vectors: Float64Array, n_shells: int
) -> Float64Array:
    """Return how far the file's normals agree with the faces of each shell, (S,).

    It is a sum of cosines weighted by area: positive if most normals are on the fronts
    of faces, negative if most are on the backs, and 0 without normals.

    Args:
        soup: the faces.
        shell: (F,) the shell of each face.
        vectors: (F, 3) normals of the faces, as long as twice the areas.
        n_shells: number of shells.
    """
    corner_agreement = (soup.normals * vectors[:, None]).sum(axis=2)
    face_agreement = np.nan_to_num(corner_agreement).sum(axis=1)
    return np.asarray(np.bincount(shell, weights=face_agreement, minlength=n_shells))


def _compute_signed_volumes(
    soup: TriangleSoup, shell: IntArray, vectors: Float64Array, face_counts: IntArray
) -> Float64Array:
    """Return six times the signed volume of each shell, (S,).

    It is the sum of tetrahedra from the shell's center to its faces, which is also
    accurate far from the origin. It is positive if the fronts of faces are outside.

    Args:
        soup: the faces.
        shell: (F,) the shell of each face.
        vectors: (F, 3) normals of the faces, as long as twice the faces' areas.
        face_counts: (S,) the number of faces of each shell.
    """
    corners = soup.points[soup.faces]
    coordinate_sums = [
        np.bincount(shell, weights=coordinate) for coordinate in corners.mean(axis=1).T
    ]
    center = np.stack(coordinate_sums, axis=1) / face_counts[:, None]
    # The volume is base * height / 3, and a vector is twice the base: so these are six
    # times the volumes.
    tetrahedra = ((corners[:, 0] - center[shell]) * vectors).sum(axis=1)
    return np.asarray(
        np.bincount(shell, weights=tetrahedra, minlength=len(face_counts))
    )


# ---- Normals ----


def _fix_normals(soup: TriangleSoup, notes: Notes) -> TriangleSoup:
    """Return the soup with a normal on the front of its face at every corner.

    A normal of the file is used if `_turn_normals` finds it on the front. A normal that
    is missing, or on the back of its face, is computed. A computed normal is smooth, or
    in a part with flat shading that of the face.
    """
    vectors = soup.compute_area_vectors()
    is_known = np.asarray(np.isfinite(soup.normals).all(axis=2))
    normals, is_front = _turn_normals(soup, vectors, is_known, notes)
    if not is_front.all():
        is_used = (is_known & is_front)[:, :, None]
        normals = np.where(is_used, normals, _compute_normals(soup, vectors))
    return replace(soup, normals=normals)


def _turn_normals(
    soup: TriangleSoup, vectors: Float64Array, is_known: BoolArray, notes: Notes
) -> tuple[Float64Array, BoolArray]:
    """Return the file's normals (F, 3, 3), and which (F, 3) are on the front of a face.

    If they are on the front of their faces on almost all of the surface
    (`MIN_NORMAL_AGREEMENT`), they stay as they are. If they are on the back on almost
    all of it, they are all reversed. Otherwise none counts as being on the front.

    Args:
        soup: the faces.
        vectors: (F, 3) normals of the faces, as long as twice the areas.
        is_known: (F, 3) which corners have a normal.
        notes: notes about the file, to which changes are added.
    """
    is_front = (soup.normals * vectors[:, None]).sum(axis=2) > 0.0
    if not is_known.any():
        return soup.normals, is_front
    front_fraction = _compute_front_fraction(is_known, is_front, vectors)
    if front_fraction < 1.0 - MIN_NORMAL_AGREEMENT:  # most are on the back
        notes.warn("its normals pointed inwards and were turned around")
        return -soup.normals, is_known & ~is_front
    if front_fraction < MIN_NORMAL_AGREEMENT:
        notes.warn("its normals contradict its faces and were computed anew")
        return soup.normals, np.zeros_like(is_front)
    return soup.normals, is_front


def _compute_front_fraction(
    is_known: BoolArray, is_front: BoolArray, vectors: Float64Array
) -> float:
    """Return the fraction of the area with known normals where they are on the front.

    Args:
        is_known: (F, 3) which corners have a normal.
        is_front: (F, 3) which corners have a normal on the front of their face.
        vectors: (F, 3) normals of the faces, as long as twice the areas.
    """
    area = np.linalg.norm(vectors, axis=1)
    known_area = np.where(is_known, area[:, None], 0.0)
    return float((known_area * is_front).sum() / known_area.sum())


def _compute_normals(soup: TriangleSoup, vectors: Float64Array) -> Float64Array:
    """Compute normals of corners (F, 3, 3): of the face where flat, and smooth elsewhere.

    `vectors` are normals of the faces, of any length.
    """
    computed = compute_smooth_normals(soup)
    if soup.is_flat is not None:
        face_normals = normalize_vectors(vectors)[:, None]
        computed = np.where(soup.is_flat[:, None, None], face_normals, computed)
    return computed


def _compute_cosines(
    face_normals: Float64Array, left_corner: IntArray, right_corner: IntArray
) -> Float64Array:
    """Return the cosine between the faces at each edge, (E,), given a corner of each."""
    # Corner c is a corner of face c // 3.
    left_normals = face_normals[left_corner // 3]
    right_normals = face_normals[right_corner // 3]
    return np.asarray((left_normals * right_normals).sum(axis=1))


def compute_smooth_normals(soup: TriangleSoup) -> Float64Array:
    """Compute unit normals of corners (F, 3, 3), smooth except across creases.

    At each point, faces share one normal if they are connected by edges whose angle is
    below the crease angle. It is the mean of the faces' normals. Each is weighted by
    the angle between the two sides of the face that meet at the point (Thuermer and
    Wuethrich 1998).
    """
    face_normals = normalize_vectors(soup.compute_area_vectors())
    smoothing_group = _find_smoothing_groups(soup, face_normals)
    weighted = face_normals[:, None] * _compute_corner_angles(soup)[:, :, None]
    unit_sums = normalize_vectors(_sum_by_group(weighted, smoothing_group))
    smooth_normals = unit_sums[smoothing_group].reshape(-1, 3, 3)
    # A mean that is not on the front of a face is replaced by the face's normal. So is
    # a mean of NaN, where normals cancel.
    cosine = (smooth_normals * face_normals[:, None]).sum(axis=2, keepdims=True)
    return np.where(cosine > 0.0, smooth_normals, face_normals[:, None])


def _sum_by_group(vectors: Float64Array, group: IntArray) -> Float64Array:
    """Return the sum (G, 3) of the vectors of corners (F, 3, 3) in each group.

    `group` (3 F,) is the group of each corner.
    """
    vector_sums: Float64Array = np.stack(
        [np.bincount(group, weights=vectors[:, :, axis].ravel()) for axis in range(3)],
        axis=1,
    )
    return vector_sums


def _find_smoothing_groups(soup: TriangleSoup, face_normals: Float64Array) -> IntArray:
    """Return for each corner (3 F,) the group of corners with which it shares a normal.

    Two faces meet in two corners at each end of their shared edge. These two get the
    same normal, unless the edge is a crease or the faces disagree in winding. So
    corners are the nodes of a graph, linked by smooth edges, and its connected
    components are the groups.
    """
    left_corner, right_corner, same_direction = find_shared_edges(soup.faces)
    cosine = _compute_cosines(face_normals, left_corner, right_corner)
    is_smooth = (cosine >= np.cos(np.radians(CREASE_DEGREES))) & ~same_direction
    left_start = left_corner[is_smooth]
    left_end = _get_next_corner(left_start)
    right_start = right_corner[is_smooth]
    right_end = _get_next_corner(right_start)
    # The two faces run along the edge in opposite directions. So the corner at which it
    # starts in one face meets the corner at which it ends in the other.
    left_nodes = np.concatenate([left_start, left_end])
    right_nodes = np.concatenate([right_end, right_start])
    return find_components(soup.faces.size, left_nodes, right_nodes)


def _get_next_corner(corner: IntArray) -> IntArray:
    """Return the corner that follows each corner in its face, as 3 face + k."""
    return corner - corner % 3 + (corner + 1) % 3


def _compute_corner_angles(soup: TriangleSoup) -> Float64Array:
    """Return the angle in radians at each corner, (F, 3)."""
    # by arctan2, which is accurate for angles near 0 and 180 degrees too
    corners = soup.points[soup.faces]
    to_next = np.roll(corners, -1, axis=1) - corners
    to_previous = np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(to_next, to_previous), axis=2)
    cosine = (to_next * to_previous).sum(axis=2)
    return np.asarray(np.arctan2(sine, cosine))


def _gather_at_corners(
    values: Float64Array | None, faces: IntArray, width: int
) -> Float64Array:
    """Return values (V, width) of vertices at corners, (F, 3, width); NaN for None."""
    if values is None:
        return np.full((len(faces), 3, width), np.nan)
    return values[faces]


def normalize_vectors(vectors: Float64Array) -> Float64Array:
    """Scale vectors, along the last axis, to unit length.

    Vectors without a direction become NaN.
    """
    with np.errstate(all="ignore"):
        # Divide by the largest entry first, so that squares neither overflow nor
        # vanish.
        largest = np.abs(vectors).max(axis=-1, keepdims=True)
        scaled = vectors / largest
        unit_vectors = scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)
    return np.where(
        np.isfinite(unit_vectors).all(axis=-1, keepdims=True), unit_vectors, np.nan
    )


def find_components(count: int, edge_starts: IntArray, edge_ends: IntArray) -> IntArray:
    """Return the connected component (count,) of each node of a graph.

    Components are numbered from 0.

    Args:
        count: number of nodes.
        edge_starts, edge_ends: (E,) the two nodes of each edge, in either order.
    """
    # Imported here, since the reader of USD, a separate process, needs no scipy.
    from scipy.sparse import coo_array, csgraph

    # Only which entries are stored matters, and not their values.
    values = np.ones(len(edge_starts), np.int8)
    graph = coo_array((values, (edge_starts, edge_ends)), shape=(count, count))
    _, component = csgraph.connected_components(graph, directed=False)
    return np.asarray(component, dtype=np.int64)


# ---- Triangulation of many polygons at a time: fans if those are right, else ears ----

# Limit of the comparisons of points with ears; beyond it, ears are cut off untested.
MOST_WORK = 50_000_000
# Triangles up to this fraction of their polygon's area are treated as having no area.
_MIN_AREA_FRACTION = 1e-9


def triangulate_and_note(
    points: Float64Array, counts: IntArray, notes: Notes
) -> tuple[IntArray, IntArray]:
    """Triangulate polygons, and note those that are degenerate or may be wrong.

    Args:
        points: (C, 3) the corners of all polygons, concatenated; may be NaN.
        counts: (P,) the number of corners of each polygon.
        notes: notes about the file, to which sentences are added.

    Returns:
        The corners of the triangles (T, 3), as indices into `points`; and the polygon
        of each triangle (T,).
    """
    _note_degenerate_polygons(counts, notes)
    triangles, polygon, n_wrong = triangulate(points, counts)
    if n_wrong:
        notes.warn(
            f"{n_wrong:,} faces cross themselves, or are too complex, and may be "
            "divided wrongly"
        )
    return triangles, polygon


def _note_degenerate_polygons(counts: IntArray, notes: Notes) -> None:
    """Note how many polygons, with these numbers of corners (P,), have no triangle."""
    n_degenerate = int((counts < 3).sum())
    if n_degenerate:
        plural = "" if n_degenerate == 1 else "s"
        notes.warn(f"{n_degenerate:,} face{plural} of fewer than 3 corners left out")


def triangulate(
    points: Float64Array, counts: IntArray
) -> tuple[IntArray, IntArray, int]:
    """Triangulate polygons.

    A polygon is first divided into a fan of triangles from its first corner. That is
    right if all of them face as the polygon does, as in any convex polygon. Otherwise
    ears are cut off (Meisters 1975) in the polygon's mean plane (Newell's method).

    Args:
        points: (C, 3) the corners of all polygons, concatenated; may be NaN.
        counts: (P,) the number of corners of each polygon. Polygons with fewer than 3
            corners have no triangle.

    Returns:
        The corners of the triangles (T, 3), as indices into `points`, in the order of
        the polygons; the polygon of each triangle (T,); and the number of polygons that
        may be divided wrongly, because they cross themselves or were too much work.
    """
    starts = np.cumsum(counts) - counts  # the first corner of each polygon
    triangles = []
    owners = []
    n_wrong = 0
    budget = MOST_WORK  # comparisons of points with ears, for all polygons
    for count in np.unique(counts[counts >= 3]):  # equally many corners, in parallel
        polygons = np.flatnonzero(counts == count)
        corners = starts[polygons, None] + np.arange(count)
        equal_triangles, n_failed, n_compared = _triangulate_equal(
            points, corners, budget
        )
        budget = budget - n_compared
        n_wrong = n_wrong + n_failed
        triangles.append(equal_triangles.reshape(-1, 3))
        owners.append(np.repeat(polygons, count - 2))
    restored_triangles, owner = _restore_order(triangles, owners)
    return restored_triangles, owner, n_wrong


def _restore_order(
    triangles: list[IntArray], owners: list[IntArray]
) -> tuple[IntArray, IntArray]:
    """Concatenate groups of triangles, sorted by their polygon.

    Args:
        triangles: the corners (T, 3) of the triangles of each group.
        owners: the polygon (T,) of each triangle of each group.

    Returns:
        The corners of all triangles (T, 3), and the polygon of each (T,).
    """
    if not owners:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order]


def _triangulate_equal(
    points: Float64Array, corners: IntArray, budget: int
) -> tuple[IntArray, int, int]:
    """Triangulate polygons (P, n) with the same number of corners.

    Each polygon is divided into a fan of triangles from its first corner. If one of
    these has no positive area, the polygon is not convex, and ears are cut off instead.

    Args:
        points: (C, 3).
        corners: (P, n) indices into `points`.
        budget: limit of the comparisons of points with ears; once it is reached, the
            remaining ears are cut off without tests.

    Returns:
        The triangles (P, n - 2, 3), the number of polygons that may be wrong, and the
        number of comparisons made.
    """
    fans = _make_fans(corners)
    if corners.shape[1] == 3:  # a triangle is its own fan
        return fans, 0, 0
    projected = _project_to_planes(points[corners])
    concave = _find_concave_polygons(projected)
    if not len(concave):
        return fans, 0, 0
    ears, n_failed, n_compared = _cut_ears(projected[concave], budget)
    # `ears` are (concave, n - 2, 3) positions in a polygon. Each is replaced by the
    # index of the point that the polygon has there.
    polygon_rows = np.arange(len(concave))[:, None, None]
    fans[concave] = corners[concave][polygon_rows, ears]
    return fans, n_failed, n_compared


def _make_fans(corners: IntArray) -> IntArray:
    """Divide polygons (P, n) into fans of triangles (P, n - 2, 3) from the first corner."""
    fan_tips = corners[:, :1].repeat(corners.shape[1] - 2, axis=1)
    return np.stack([fan_tips, corners[:, 1:-1], corners[:, 2:]], axis=2)


def _find_concave_polygons(projected: Float64Array) -> IntArray:
    """Return the indices of polygons (P, n, 2) with a fan triangle of no positive area."""
    areas = _compute_doubled_areas(
        projected[:, :1], projected[:, 1:-1], projected[:, 2:]
    )
    min_area = _MIN_AREA_FRACTION * np.abs(areas.sum(axis=1))[:, None]
    return np.flatnonzero((areas <= min_area).any(axis=1))


def _project_to_planes(corners: Float64Array) -> Float64Array:
    """Project polygons (P, n, 3) to their planes, (P, n, 2).

    The plane is the one whose normal is the sum of the cross products of successive
    corners (Newell). Seen from the normal's side the results are counter-clockwise;
    they are centered, and scaled so that their largest coordinate is about 1.
    """
    corners = corners - corners.mean(axis=1, keepdims=True)
    sizes = np.abs(corners).max(axis=(1, 2), keepdims=True)
    corners = corners / np.maximum(sizes, 1e-300)  # never by 0
    normal = np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    # The axis that is the least parallel to the normal has the most accurate cross
    # product with it.
    other_axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    x_axis = np.cross(other_axis, normal)
    x_axis /= np.maximum(np.linalg.norm(x_axis, axis=1, keepdims=True), 1e-300)
    plane_axes = np.stack([x_axis, np.cross(normal, x_axis)], axis=2)
    return np.asarray(corners @ plane_axes)


def _compute_doubled_areas(
    a: Float64Array, b: Float64Array, c: Float64Array
) -> Float64Array:
    """Return twice the signed area of triangles with corners (..., 2)."""
    to_b = b - a
    to_c = c - a
    return np.asarray(to_b[..., 0] * to_c[..., 1] - to_b[..., 1] * to_c[..., 0])


def _compute_doubled_polygon_areas(flat: Float64Array) -> Float64Array:
    """Return twice the area of polygons with corners (P, n, 2), (P,).

    The signed areas of the triangles between the origin and each side add up to it.
    """
    successors = np.roll(flat, -1, axis=1)
    side_areas = _compute_doubled_areas(flat, successors, np.zeros(2))
    doubled_areas: Float64Array = np.abs(side_areas.sum(axis=1))
    return doubled_areas


class _EarCutter:
    """Polygons (P, n, 2) from which ears are cut off, all in parallel.

    Attributes:
        flat: (P, n, 2) the corners.
        dent: (P, d) indices of the corners that are not convex, and may lie in an ear;
            padded with convex ones.
        is_present: (P, d) whether the corner in `dent` is not convex and not cut off.
        dent_points: (P, d, 2) coordinates of these corners.
        triangles: (P, n - 2, 3) the corners of the ears that were cut off.
        n_cut: (P,) number of ears that were cut off so far.
        next_corner: (P, n) a linked list of the remaining corners.
        previous_corner: (P, n) the same list backwards.
        tip: (P,) the corner that is tried next.
        n_tries: (P,) number of corners tried since the last ear.
        is_failed: (P,) whether a polygon lacked an ear, or was over the budget.
        area: (P,) twice the area of each polygon.
        active: indices of the polygons that are not triangulated yet.
        n_compared: number of comparisons of a corner with a triangle so far.
    """

    def __init__(self, flat: Float64Array) -> None:
        """Start with all corners of all polygons, the first of which is tried first."""
        count, n_corners = flat.shape[:2]
        corner = np.arange(n_corners)
        self.flat = flat
        self.next_corner = np.tile(np.roll(corner, -1), (count, 1))
        self.previous_corner = np.tile(np.roll(corner, 1), (count, 1))
        self.triangles = np.zeros((count, n_corners - 2, 3), dtype=np.int64)
        self.n_cut = np.zeros(count, dtype=np.int64)
        self.tip = np.zeros(count, dtype=np.int64)
        self.n_tries = np.zeros(count, dtype=np.int64)
        self.is_failed = np.zeros(count, dtype=np.bool_)
        self.area = _compute_doubled_polygon_areas(flat)
        self.dent, self.is_present = _find_dents(flat, self.area)
        self.dent_points = np.take_along_axis(flat, self.dent[:, :, None], axis=1)
        self.active = np.arange(count)
        self.n_compared = 0

    def step(self, budget: int) -> None:
        """Try the tip of every active polygon; cut it off if it is an ear.

        Then the next corner is the tip. Polygons with all their triangles are no longer
        active.

        Args:
            budget: limit of the comparisons; then all ears are cut off untested.
        """
        active = self.active
        # (active,) the tip b of each, and its neighbours a and c
        b = self.tip[active]
        a = self.previous_corner[active, b]
        c = self.next_corner[active, b]
        is_cut = self._decide_cuts(a, b, c, budget)
        self.tip[active] = c
        self.n_tries[active] += 1
        self._cut(active[is_cut], a[is_cut], b[is_cut], c[is_cut])
        n_triangles = self.triangles.shape[1]
        self.active = active[self.n_cut[active] < n_triangles]

    def _decide_cuts(
        self, a: IntArray, b: IntArray, c: IntArray, budget: int
    ) -> BoolArray:
        """Return which active polygons lose their corner b, between a and c.

        A polygon loses it if b is the tip of an ear, or if only three corners are left.
        It also loses it, and is marked as failed, if all corners were tried without
        finding an ear, or once the budget is spent.

        Args:
            a, b, c: (active,) three successive corners of each active polygon.
            budget: limit of the comparisons.
        """
        active = self.active
        n_left = self.flat.shape[1] - self.n_cut[active]
        is_cut = n_left == 3  # the last triangle
        is_hopeless = self.n_tries[active] >= n_left  # all corners were tried
        if self.n_compared < budget:
            is_cut |= self._find_ears(a, b, c)
        else:  # the budget is spent: all others are cut off untested
            is_hopeless[:] = True
        self.is_failed[active] |= is_hopeless & ~is_cut
        return np.asarray(is_cut | is_hopeless)

    def _find_ears(self, a: IntArray, b: IntArray, c: IntArray) -> BoolArray:
        """Return which active polygons have an ear at b, and count the comparisons.

        Args:
            a, b, c: (active,) three successive corners of each active polygon.
        """
        active = self.active
        dent_points = self.dent_points[active]
        # Each dent is compared with one triangle.
        n_dents = dent_points.size // 2  # points have two coordinates
        self.n_compared += n_dents
        corners = [self.flat[active, corner] for corner in (a, b, c)]
        min_area = _MIN_AREA_FRACTION * self.area[active]
        return _is_ear(corners, dent_points, self.is_present[active], min_area)

    def _cut(self, rows: IntArray, a: IntArray, b: IntArray, c: IntArray) -> None:
        """Cut an ear off each of some polygons.

        The triangle is stored, and its tip b is removed from the linked list of corners
        and from the dents.

        Args:
            rows: (N,) the polygons.
            a, b, c: (N,) the corners of the ear: the tip b and its neighbours.
        """
        self.triangles[rows, self.n_cut[rows]] = np.stack([a, b, c], axis=1)
        self.is_present[rows] &= self.dent[rows] != b[:, None]  # b is cut off
        self.next_corner[rows, a] = c
        self.previous_corner[rows, c] = a
        self.n_tries[rows] = 0  # without b, other corners may be ears
        self.n_cut[rows] += 1


def _cut_ears(flat: Float64Array, budget: int) -> tuple[IntArray, int, int]:
    """Triangulate polygons (P, n, 2) by cutting off ears, in all polygons in parallel.

    Each polygon has a tip, the corner that is tried next. If the triangle of the tip
    and its two neighbours is an ear, it is cut off; otherwise the tip moves on. A
    polygon whose corners have all been tried has no ear, and its tip is cut off anyway.

    Args:
        flat: polygons as `_project_to_planes` returns them.
        budget: limit of the comparisons; then all ears are cut off untested.

    Returns:
        The corners of the triangles (P, n - 2, 3); how many polygons with an area
        lacked an ear at some time, or were over the budget; and the comparisons made.
    """
    cutter = _EarCutter(flat)
    while len(cutter.active):
        cutter.step(budget)
    # Corners are scaled to about 1, so that an area is compared with that of a square.
    is_wrong = cutter.is_failed & (cutter.area > _MIN_AREA_FRACTION)
    return cutter.triangles, int(is_wrong.sum()), cutter.n_compared


def _find_dents(
    flat: Float64Array, doubled_area: Float64Array
) -> tuple[IntArray, BoolArray]:
    """Find the dents of polygons: their corners that are not convex.

    A triangle of three successive corners is an ear if it contains no other corner. If
    it contains any, it contains a dent. So only dents have to be tested.

    Args:
        flat: (P, n, 2) the corners of the polygons.
        doubled_area: (P,) twice the area of each polygon.

    Returns:
        The indices of the dents (P, d), where d is the largest number of dents in a
        polygon; polygons with fewer are padded with other corners. And (P, d) whether
        an index is that of a dent, and not padding.
    """
    previous = np.roll(flat, 1, axis=1)
    following = np.roll(flat, -1, axis=1)
    # negative where the polygon turns to the right, which is a dent
    corner_area = _compute_doubled_areas(previous, flat, following)
    is_dent = corner_area <= _MIN_AREA_FRACTION * doubled_area[:, None]
    max_dents = int(is_dent.sum(axis=1).max())
    is_convex = ~is_dent
    dents_first = np.argsort(is_convex, axis=1, kind="stable")  # False sorts first
    dent = dents_first[:, :max_dents]
    return dent, np.take_along_axis(is_dent, dent, axis=1)


def _is_ear(
    corners: list[Float64Array],
    points: Float64Array,
    is_present: BoolArray,
    min_area: Float64Array,
) -> BoolArray:
    """Return which triangles have an area and contain no present point, (P,).

    A point is inside if it is on the left of all three sides, which run
    counter-clockwise. A point on a side is inside, but one at a corner is not.

    Args:
        corners: the three corners of each triangle, (P, 2) each.
        points: (P, n, 2) points that may lie in them.
        is_present: (P, n) which of the points are tested.
        min_area: (P,) doubled area up to which a triangle is treated as having none.
    """
    is_ear: BoolArray = _compute_doubled_areas(*corners) > min_area
    candidates = points[is_ear]
    is_inside = is_present[is_ear]
    for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
        is_inside &= _is_left_of_side(candidates, start[is_ear], end[is_ear])
    is_ear[is_ear] = ~is_inside.any(axis=1)
    return is_ear


def _is_left_of_side(
    points: Float64Array, start: Float64Array, end: Float64Array
) -> BoolArray:
    """Return which points (E, n, 2) are left of a side or on it, but not at its start.

    Args:
        points: the points.
        start, end: (E, 2) the ends of the side.
    """
    x = points[:, :, 0]
    y = points[:, :, 1]
    x0 = start[:, :1]
    y0 = start[:, 1:]
    x1 = end[:, :1]
    y1 = end[:, 1:]
    is_left: BoolArray = (x1 - x0) * (y - y0) >= (y1 - y0) * (x - x0)
    # A point at a corner of the triangle is not in it.
    is_left &= (x != x0) | (y != y0)
    return is_left
