"""Repair of imported geometry: welding, faces without area, winding, normals.

Everything works on a `Soup`: welded points, and attributes that belong to the corners
of faces, so that no step has to care where a file splits its vertices. They are split
again, where normals or UVs differ, when the mesh is assembled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from advsearch.errors import InputError
from advsearch.scene.assets import Bools, Doubles, Ints, Mesh, face_vectors
from advsearch.scene.importing.files import Notes
from advsearch.scene.importing.parts import ImportedPart

WELD = 1e-6
"""Points closer than this share of the largest extent are one point; text and 32-bit
files round to about that.
"""
# twice the area, in squared extents, up to which a face counts as having none
FLAT = 1e-12
CREASE_DEGREES = 40.0
"""Where the normals of two neighbouring faces differ by more, a computed normal is not
smoothed across their edge.
"""
TRUSTED = 0.98
"""Share of the surface on which a file's normals must face the same way as the faces
for the normals to be kept.
"""


@dataclass(frozen=True, eq=False)
class Soup:
    """Triangles with welded points and per-corner attributes."""

    points: Doubles  # (P, 3), the largest extent 1
    faces: Ints  # (F, 3) points
    part: Ints  # (F,) the part of the file that the face belongs to
    normals: Doubles  # (F, 3, 3) unit normals of the corners; NaN where unknown
    uvs: Doubles  # (F, 3, 2); NaN where unknown
    # (F, 3, 3) linear factors of the base colour; 1 where the file gives none
    colors: Doubles
    # (F,) the faces that are flat where they have no normals; None where none are
    flat: Bools | None = None
    stored: Ints | None = (
        # (F, 3) vertices of the parts, one after the other, that the corners were;
        # None: unknown
        None
    )

    def only(self, keep: Bools) -> Soup:
        """Return the soup with a part of its faces; `keep` is (F,)."""
        held = {
            name: values
            for name, values in vars(self).items()
            if name != "points" and values is not None
        }
        return replace(self, **{name: values[keep] for name, values in held.items()})

    def reversed(self, turn: Bools) -> Soup:
        """Return the soup with some faces turned over; `turn` is (F,). Normals stay as
        they are.
        """
        order = np.where(turn[:, None], [0, 2, 1], [0, 1, 2])
        rows = np.arange(len(order))[:, None]
        corners = (
            "faces",
            "normals",
            "uvs",
            "colors",
            *(() if self.stored is None else ("stored",)),
        )
        return replace(
            self, **{name: getattr(self, name)[rows, order] for name in corners}
        )

    def face_vectors(self) -> Doubles:
        """Return (F, 3) vectors along the face normals, as long as twice the faces'
        areas.
        """
        return face_vectors(self.points[self.faces])


def compute_turn(up: str, front: str) -> Doubles:
    """Return the rotation (3, 3) from a file's axes to ours, where its front faces +x
    and its up axis +z.

    `up` is "y" or "z", `front` one of `FACINGS` along another axis.
    """
    ahead = np.eye(3)["xyz".index(front[1])] * (-1.0 if front[0] == "-" else 1.0)
    above = np.eye(3)["xyz".index(up)]
    return np.stack([ahead, np.cross(above, ahead), above]) + 0.0  # no zero has a sign


def join(parts: Sequence[ImportedPart], source: str, turn: Doubles) -> Soup:
    """Join parts, at least one, into one soup of unit extent with welded points, turned
    by a rotation (3, 3). Raises InputError, with the name of the file: vertices that
    are NaN or infinite, or no extent.
    """
    vertices = np.concatenate([part.vertices for part in parts])
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        first = int(bad.argmax())
        raise InputError(
            f"{source}: expected finite vertices, got {int(bad.sum())} of "
            f"{len(vertices)} with NaN or infinite"
            f" coordinates (the first: {vertices[first].tolist()}); repair the mesh or "
            "export it again"
        )
    faces = np.concatenate(
        [part.faces + start for part, start in zip(parts, starts[:-1], strict=True)]
    )
    low = vertices[np.unique(faces)].min(axis=0)
    size = extent_of(parts)
    if not 0.0 < size < np.inf:
        what = (
            "all vertices coincide"
            if size == 0.0
            else ("its extent is too large to compute with")
        )
        raise InputError(
            f"{source}: expected an object with a size, got a mesh in "
            f"which {what}; export it again"
        )
    points, index = np.unique(
        (vertices - low) / size @ turn.T + 0.0, axis=0, return_inverse=True
    )
    from scipy.spatial import cKDTree  # late, as in `parts`

    index = index.reshape(-1)
    pairs = cKDTree(points).query_pairs(WELD, output_type="ndarray")
    if len(pairs):
        cluster = connected(len(points), pairs[:, 0], pairs[:, 1])
        _, kept, merged = np.unique(cluster, return_index=True, return_inverse=True)
        points = points[kept]
        index = merged[index].astype(np.int64)
    counts = [len(part.faces) for part in parts]
    return Soup(
        points=points,
        faces=index[faces],
        part=np.arange(len(parts)).repeat(counts),
        normals=unit_vectors(
            np.concatenate([_corners(part.normals, part.faces, 3) for part in parts])
        )
        @ turn.T,
        uvs=np.concatenate([_corners(part.uvs, part.faces, 2) for part in parts]),
        colors=np.concatenate(
            [
                np.ones((len(p.faces), 3, 3)) if p.colors is None else p.colors
                for p in parts
            ]
        ),
        flat=np.array([part.flat for part in parts]).repeat(counts),
        stored=faces if any(part.movable is not None for part in parts) else None,
    )


def extent_of(parts: Sequence[ImportedPart]) -> float:
    """Return the largest extent of all faces together along an axis, in the file's
    unit; infinite beyond float64.
    """
    used = [part.vertices[np.unique(part.faces)] for part in parts]
    low = np.min([points.min(axis=0) for points in used], axis=0)
    high = np.max([points.max(axis=0) for points in used], axis=0)
    return float((high / 2 - low / 2).max()) * 2


def repaired(soup: Soup, source: str, notes: Notes) -> Soup:
    """Return a soup, as `join` gives it, without faces without area, its winding
    consistent and outward, every normal of unit length and on the front of its face.
    Raises InputError, with the name of the file: no face has an area.
    """
    flat = np.linalg.norm(soup.face_vectors(), axis=1) <= FLAT
    if flat.all():
        raise InputError(
            f"{source}: expected faces with an area, got {len(flat)} "
            "without; export it again"
        )
    if flat.any():
        notes.say(f"{int(flat.sum())} faces without area were removed")
        soup = soup.only(~flat)
    return _shaded(_wound(soup, notes), notes)


def assemble(soup: Soup) -> tuple[Mesh, Ints | None]:
    """Return the soup as a mesh, and which stored vertex each of its vertices was:
    corners with the same point, normal and UV, and the same stored vertex where that is
    known, become one.
    """
    normals = soup.normals.astype(np.float32) + np.float32(0.0)
    uvs = soup.uvs.astype(np.float32) + np.float32(0.0)
    corners = soup.faces.reshape(-1)
    keys = np.column_stack(
        [
            corners,
            normals.reshape(-1, 3).view(np.int32),
            uvs.reshape(-1, 2).view(np.int32),
        ]
    )
    if soup.stored is not None:
        keys = np.column_stack([keys, soup.stored.reshape(-1)])
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    mesh = Mesh(
        vertices=soup.points[corners[first]].astype(np.float32),
        faces=index.reshape(-1, 3).astype(np.uint32),
        normals=normals.reshape(-1, 3)[first],
        uvs=uvs.reshape(-1, 2)[first],
    )
    return mesh, None if soup.stored is None else soup.stored.reshape(-1)[first]


# --- winding ----------------------------------------


def _wound(soup: Soup, notes: Notes) -> Soup:
    turn, shell, twisted = _agreement(soup)
    if turn.any():
        notes.say(
            f"{int(turn.sum())} faces wound against their neighbours were turned over"
        )
    if twisted:
        notes.say(
            "has a one-sided surface (a Moebius strip), so some faces show their backs"
        )
    soup = soup.reversed(turn)
    inside_out = _inside_out(soup, shell)[shell]
    if inside_out.any():
        notes.say(
            f"{int(inside_out.sum())} faces were inside out and have been turned over"
        )
    return soup.reversed(inside_out)


def neighbours(faces: Ints) -> tuple[Ints, Ints, Bools]:
    """Return, for each edge of exactly two faces, the corner in each of them at which
    the edge starts (3 face + k).

    The third array tells whether both faces run along the edge in the same direction,
    that is, disagree in winding.
    """
    start = faces.reshape(-1)
    end = np.roll(faces, -1, axis=1).reshape(-1)
    low = np.minimum(start, end)
    high = np.maximum(start, end)
    order = np.lexsort((high, low))
    fresh = np.concatenate(
        [[True], (np.diff(low[order]) != 0) | (np.diff(high[order]) != 0)]
    )
    first = np.flatnonzero(fresh)
    pairs = first[np.diff(np.append(first, len(order))) == 2]
    left = order[pairs]
    right = order[pairs + 1]
    return left, right, start[left] == start[right]


def _agreement(soup: Soup) -> tuple[Bools, Ints, bool]:
    """Return which faces (F,) to turn over so that neighbours agree, keeping the way of
    most of each shell's area; the shell that each belongs to (F,); and whether some
    shell is one-sided. Every face stands for two nodes of a graph, "as it is" and
    "turned"; neighbours that agree are linked like to like, others crosswise. A shell
    is orientable when the two nodes of its faces fall into two components.
    """
    left, right, same_way = neighbours(soup.faces)
    area = np.linalg.norm(soup.face_vectors(), axis=1)
    f = left // 3
    g = right // 3
    count = len(area)
    a = np.concatenate([2 * f, 2 * f + 1])
    b = np.concatenate([2 * g + same_way, 2 * g + 1 - same_way])
    side = connected(2 * count, a, b)
    kept = side[0::2]
    turned = side[1::2]
    votes = np.bincount(kept, weights=area, minlength=int(side.max()) + 1)
    turn = (votes[turned] > votes[kept]) | (
        (votes[turned] == votes[kept]) & (turned < kept)
    )
    _, shell = np.unique(np.minimum(kept, turned), return_inverse=True)
    return turn, shell.astype(np.int64), bool((kept == turned).any())


def _inside_out(soup: Soup, shell: Ints) -> Bools:
    """Return, for each shell, whether it must be turned over: a closed shell, all of
    whose edges belong to exactly two faces of it, when its signed volume is negative,
    unless it lies within another closed shell (then it is the wall of a hollow) and the
    file's normals do not object; an open sheet when the file's normals point away from
    its front.
    """
    faces = np.bincount(shell)
    vectors = soup.face_vectors()
    count = len(faces)
    paired = (
        np.bincount(shell[neighbours(soup.faces)[0] // 3], minlength=len(faces)) * 2
    )
    closed = np.equal(paired, 3 * faces)
    corners = soup.points[soup.faces]
    sums = [np.bincount(shell, weights=place) for place in corners.mean(axis=1).T]
    middle = np.stack(sums, axis=1) / faces[:, None]
    volume = np.bincount(
        shell,
        weights=((corners[:, 0] - middle[shell]) * vectors).sum(axis=1),
        minlength=count,
    )
    toward = np.nan_to_num((soup.normals * vectors[:, None]).sum(axis=2)).sum(axis=1)
    # with the file's normals; 0 where it has none
    agreement = np.bincount(shell, weights=toward, minlength=count)
    low = np.full((count, 3), np.inf)
    high = np.full((count, 3), -np.inf)
    np.minimum.at(low, shell, corners.min(axis=1))
    np.maximum.at(high, shell, corners.max(axis=1))
    # then the whole object is inside out, hollows included
    mostly = volume[closed].sum() < 0.0
    negative = (volume < 0.0) ^ mostly
    for number in np.flatnonzero(closed & negative):
        around = (
            closed & (low < low[number]).all(axis=1) & (high > high[number]).all(axis=1)
        )
        negative[number] = not around.any() or (
            agreement[number] > 0.0 if mostly else agreement[number] < 0.0
        )
    return np.where(closed, negative ^ mostly, agreement < 0.0)


# --- normals ----------------------------------------


def _shaded(soup: Soup, notes: Notes) -> Soup:
    vectors = soup.face_vectors()
    area = np.linalg.norm(vectors, axis=1)
    known = np.isfinite(soup.normals).all(axis=2)
    front = (soup.normals * vectors[:, None]).sum(axis=2) > 0.0
    normals = soup.normals
    if known.any():
        weight = np.where(known, area[:, None], 0.0)
        share = float((weight * front).sum() / weight.sum())
        if share < 1.0 - TRUSTED:
            notes.say("its normals pointed inwards and were turned around")
            normals = -normals
            front = known & ~front
        elif share < TRUSTED:
            notes.say("its normals contradict its faces and were computed anew")
            front = np.zeros_like(front)
    if not front.all():
        made = smooth_normals(soup)
        if soup.flat is not None:
            made = np.where(
                soup.flat[:, None, None], unit_vectors(vectors)[:, None], made
            )
        normals = np.where((known & front)[:, :, None], normals, made)
    return replace(soup, normals=normals)


def smooth_normals(soup: Soup) -> Doubles:
    """Return unit normals of corners (F, 3, 3), smooth except across creases. At each
    point, the faces that can be reached from one another over edges with less than the
    crease angle share one normal: the mean of their normals weighted by their angles at
    that point (Thuermer and Wuethrich 1998).
    """
    unit = unit_vectors(soup.face_vectors())
    left, right, same_way = neighbours(soup.faces)
    gentle = (unit[left // 3] * unit[right // 3]).sum(axis=1) >= np.cos(
        np.radians(CREASE_DEGREES)
    )
    left = left[gentle & ~same_way]
    right = right[gentle & ~same_way]
    after = [corner - corner % 3 + (corner + 1) % 3 for corner in (left, right)]
    a = np.concatenate([left, after[0]])
    b = np.concatenate([after[1], right])
    group = connected(soup.faces.size, a, b)
    corners = soup.points[soup.faces]
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    angles: Doubles = np.arctan2(
        np.linalg.norm(np.cross(ahead, behind), axis=2), (ahead * behind).sum(axis=2)
    )
    weighted = unit[:, None] * angles[:, :, None]
    sums: Doubles = np.stack(
        [np.bincount(group, weighted[:, :, k].ravel()) for k in range(3)], axis=1
    )
    smooth = unit_vectors(sums)[group].reshape(-1, 3, 3)
    # NaN, where normals cancel, is not
    sound = (smooth * unit[:, None]).sum(axis=2, keepdims=True) > 0.0
    return np.where(sound, smooth, unit[:, None])


def _corners(values: Doubles | None, faces: Ints, width: int) -> Doubles:
    return np.full((len(faces), 3, width), np.nan) if values is None else values[faces]


def unit_vectors(vectors: Doubles) -> Doubles:
    """Scale vectors, along the last axis, to unit length; NaN where they have no
    direction.
    """
    with np.errstate(all="ignore"):
        largest = np.abs(vectors).max(axis=-1, keepdims=True)
        scaled = vectors / largest
        result = scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)
    return np.where(np.isfinite(result).all(axis=-1, keepdims=True), result, np.nan)


def connected(count: int, a: Ints, b: Ints) -> Ints:
    """Return the component (count,) of each node of a graph with edges between a
    and b.
    """
    from scipy.sparse import coo_array, csgraph  # late, as in `parts`

    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(count, count))
    return np.asarray(
        csgraph.connected_components(graph, directed=False)[1], dtype=np.int64
    )


# ---- Polygons as triangles: fans where those are right, else ears are cut off, for
# many polygons at a time ----------

# points that are compared with ears, in all; then the polygons that are left are cut up
# as fans
MOST_WORK = 50_000_000
# twice the area of a triangle, as a share of that of its polygon, up to which it has
# none
_FLAT = 1e-9


def cut_up(points: Doubles, counts: Ints, notes: Notes) -> tuple[Ints, Ints]:
    """Return the triangles of polygons, and the polygon of each, as `triangulated`;
    what is odd is noted.
    """
    if few := int((counts < 3).sum()):
        notes.say(
            f"{few:,} face{'' if few == 1 else 's'} of fewer than 3 corners left out"
        )
    triangles, owner, wrong = triangulated(points, counts)
    if wrong:
        notes.say(
            f"{wrong:,} faces cross themselves, or are too much work, and may be "
            "cut up wrongly"
        )
    return triangles, owner


def triangulated(points: Doubles, counts: Ints) -> tuple[Ints, Ints, int]:
    """Cut polygons up into triangles: return their corners (T, 3), as indices into
    `points`, in the order of the polygons; the polygon of each (T,); and of how many
    polygons some triangles may lie outside: they cross themselves, or were too much
    work.

    Where the triangles from a polygon's first corner all face as the polygon does (it
    is convex, mostly), these are taken. Otherwise ears are cut off (Meisters 1975) in
    the plane that the polygon lies in on average (Newell). Points (C, 3) are those of
    the corners of all polygons, one polygon after the other, and may be NaN; counts
    (P,) are of each one's corners, and those of fewer than 3 become no triangle.
    """
    starts = np.cumsum(counts) - counts
    kinds, group = np.unique(counts, return_inverse=True)
    triangles = []
    owners = []
    wrong = 0
    left = MOST_WORK
    for number, count in enumerate(kinds):
        if count < 3:
            continue
        polygons = np.flatnonzero(group == number)
        corners = starts[polygons, None] + np.arange(count)
        cut = np.stack(
            [
                corners[:, :1].repeat(count - 2, axis=1),
                corners[:, 1:-1],
                corners[:, 2:],
            ],
            axis=2,
        )
        if count > 3:
            flat = _flattened(points[corners])
            areas = _doubled_areas(flat[:, :1], flat[:, 1:-1], flat[:, 2:])
            bad = np.flatnonzero(
                (areas <= _FLAT * np.abs(areas.sum(axis=1))[:, None]).any(axis=1)
            )
            if len(bad):
                ears, failed, used = _ears(flat[bad], left)
                left = left - used
                wrong = wrong + failed
                cut[bad] = corners[bad][np.arange(len(bad))[:, None, None], ears]
        triangles.append(cut.reshape(-1, 3))
        owners.append(np.repeat(polygons, count - 2))
    if not owners:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64), wrong
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order], wrong


def _flattened(corners: Doubles) -> Doubles:
    """Return polygons (P, n, 3) in their planes, (P, n, 2), counter-clockwise and about
    1 large.
    """
    corners = corners - corners.mean(axis=1, keepdims=True)
    corners = corners / np.maximum(
        np.abs(corners).max(axis=(1, 2), keepdims=True), 1e-300
    )
    normal = np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    aside = np.eye(3)[np.abs(normal).argmin(axis=1)]
    across = np.cross(aside, normal)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    plane = np.stack([across, np.cross(normal, across)], axis=2)
    return np.asarray(corners @ plane)


def _doubled_areas(a: Doubles, b: Doubles, c: Doubles) -> Doubles:
    ahead = b - a
    aside = c - a
    return np.asarray(ahead[..., 0] * aside[..., 1] - ahead[..., 1] * aside[..., 0])


def _ears(flat: Doubles, budget: int) -> tuple[Ints, int, int]:
    """Cut the ears off polygons (P, n, 2) with the same number of corners, as
    `_flattened` gives them, all at once, each in turns of its own, with so many
    comparisons at most. Return the corners of the triangles (P, n - 2, 3); how many
    polygons with an area had no ear at some time, or were left over; and the
    comparisons that were made.
    """
    count, corners = flat.shape[:2]
    after = np.tile(np.roll(np.arange(corners), -1), (count, 1))
    before = np.tile(np.roll(np.arange(corners), 1), (count, 1))
    triangles = np.zeros((count, corners - 2, 3), dtype=np.int64)
    cut, tip, tries = (np.zeros(count, dtype=np.int64) for _ in range(3))
    failed = np.zeros(count, dtype=np.bool_)
    size = np.abs(
        _doubled_areas(flat, np.roll(flat, -1, axis=1), np.zeros(2)).sum(axis=1)
    )
    # only a corner that is not convex can lie in an ear
    dents = (
        _doubled_areas(np.roll(flat, 1, axis=1), flat, np.roll(flat, -1, axis=1))
        <= _FLAT * size[:, None]
    )
    dent = np.argsort(~dents, axis=1, kind="stable")[:, : int(dents.sum(axis=1).max())]
    there = np.take_along_axis(dents, dent, axis=1)
    places = np.take_along_axis(flat, dent[:, :, None], axis=1)
    busy = np.arange(count)
    used = 0
    while len(busy):
        b = tip[busy]
        a = before[busy, b]
        c = after[busy, b]
        left = corners - cut[busy]
        ear = left == 3
        hopeless = tries[busy] >= left
        if used < budget:
            used += places[busy].size // 2
            ends = [flat[busy, corner] for corner in (a, b, c)]
            ear |= _is_ear(ends, places[busy], there[busy], _FLAT * size[busy])
        else:
            hopeless[:] = True
        failed[busy] |= hopeless & ~ear
        ear |= hopeless
        tip[busy], tries[busy] = c, tries[busy] + 1
        rows = busy[ear]
        a = a[ear]
        b = b[ear]
        c = c[ear]
        triangles[rows, cut[rows]] = np.stack([a, b, c], axis=1)
        there[rows] &= dent[rows] != b[:, None]
        after[rows, a], before[rows, c], tries[rows] = c, a, 0
        cut[rows] += 1
        busy = busy[cut[busy] < corners - 2]
    return triangles, int((failed & (size > _FLAT)).sum()), used


def _is_ear(
    ends: list[Doubles], places: Doubles, there: Bools, least: Doubles
) -> Bools:
    """Tell of triangles, three times (P, 2), whether they have an area and hold no
    place (P, n, 2) that is there.
    """
    ear: Bools = _doubled_areas(*ends) > least
    x = places[ear, :, 0]
    y = places[ear, :, 1]
    inside = there[ear]
    for begin, end in zip(ends, [*ends[1:], ends[0]], strict=True):
        (x0, y0) = begin[ear, :, None].swapaxes(0, 1)
        (x1, y1) = end[ear, :, None].swapaxes(0, 1)
        inside &= (x1 - x0) * (y - y0) >= (y1 - y0) * (x - x0)
        inside &= (x != x0) | (y != y0)
    ear[ear] = ~inside.any(axis=1)
    return ear
