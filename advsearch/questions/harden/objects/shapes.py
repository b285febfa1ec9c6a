"""Primitives of the bundled objects: patches of surface that carry their own chart of
the texture.

A `Patch` is a piece of mesh with local texture coordinates in [0, 1]^2 and a function
that says which point of the surface a texture coordinate is, so that textures are
painted in object coordinates and meet without seams. Everything is float64 and z up;
lengths are in whatever unit the object was written in (centimetres, mostly). Faces are
counter-clockwise seen from outside, and the charts are not mirrored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline, RegularGridInterpolator

from advsearch.extend import assets

# ---- Plane and space curves from which the bundled objects are made. Float64; lengths
# in the object's units ---------

Array: TypeAlias = npt.NDArray[np.float64]
Points: TypeAlias = Array | Sequence[Sequence[float] | Array]


def unit(vectors: Array) -> Array:
    """Return vectors (..., 3) or (..., 2) scaled to length one; zero vectors stay
    zero.
    """
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def at_height(profile: Array, height: float) -> float:
    """Return how far from the axis a profile (K, 2) of points (r, z) with rising z is
    at a height.
    """
    return float(np.interp(height, profile[:, 1], profile[:, 0]))


def lengths(curve: Array) -> Array:
    """Return how far along a polyline (K, D) its points are: (K,), from 0."""
    return np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]
    )


def away_from(x: Array, y: Array, *paths: Points) -> Array:
    """Return how far points (N,) are from the nearest of some polylines (K, 2)."""
    away = np.full(len(x), np.inf)
    for (x0, y0), (x1, y1) in chain.from_iterable(map(pairwise, paths)):
        dx = x1 - x0
        dy = y1 - y0
        t = np.clip(((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        away = np.minimum(away, np.hypot(x - x0 - t * dx, y - y0 - t * dy))
    return away


def upright(curve: Array) -> Array:
    """Return a plane curve (K, 2) as one (K, 3) in the plane of x and z."""
    return np.insert(curve, 1, 0.0, axis=1)


def rotation(axis: str, degrees: float) -> Array:
    """Return the (3, 3) right-handed rotation about the axis "x", "y" or "z" by an
    angle in degrees.
    """
    c = np.cos(np.radians(degrees))
    s = np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turn = np.eye(3)
    turn[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return turn


def spline(points: Points, count: int) -> Array:
    """Return `count` points of the Catmull-Rom curve (chord-length knots) through (K,
    D) points, ends included.
    """
    knots = np.asarray(points, dtype=np.float64)
    at = lengths(knots)
    return np.asarray(
        CubicHermiteSpline(at, knots, np.gradient(knots, at, axis=0))(
            np.linspace(0.0, at[-1], count)
        )
    )


def rounded(corners: Points, radius: float | Sequence[float], steps: int = 5) -> Array:
    """Return the open polyline (K, D) with its inner corners rounded off, from a
    distance on, one number or K - 2 of them and at most half an edge, in so many steps.
    """
    points = np.asarray(corners, dtype=np.float64)
    radii = np.broadcast_to(
        np.asarray(radius, dtype=np.float64), (max(len(points) - 2, 0),)
    )
    out = [points[0]]
    for before, corner, after, wanted in zip(
        points, points[1:], points[2:], radii, strict=False
    ):
        a = before - corner
        b = after - corner
        reach = min(
            float(wanted),
            0.499 * float(np.linalg.norm(a)),
            0.499 * float(np.linalg.norm(b)),
        )
        if reach <= 1e-9:
            out.append(corner)
            continue
        p = corner + unit(a) * reach
        q = corner + unit(b) * reach
        t = np.linspace(0.0, 1.0, steps + 1)[:, None]
        out.extend((1 - t) ** 2 * p + 2 * t * (1 - t) * corner + t**2 * q)
    out.append(points[-1])
    return np.array(out)


def dense(points: Points, longest: float) -> Array:
    """Return the polyline with edges longer than `longest` cut into equal pieces."""
    curve = np.asarray(points, dtype=np.float64)
    out = [curve[:1]]
    for a, b in pairwise(curve):
        pieces = max(1, int(np.ceil(round(float(np.linalg.norm(b - a)) / longest, 6))))
        out.append(a + (b - a) * (np.arange(1, pieces + 1) / pieces)[:, None])
    return np.concatenate(out)


def polygon(sides: int, bevel: float = 0.12, steps: int = 2) -> Array:
    """Return a regular polygon of circumradius 1, a flat side down, corners rounded: a
    closed section (M, 2).
    """
    angle = 2 * np.pi * (np.arange(sides + 2) - 0.5) / sides - np.pi / 2
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return rounded(ring, bevel, steps)[1:-1]


def rectangle(width: float, height: float, bevel: float, steps: int = 3) -> Array:
    """Return a rounded rectangle, centred, counter-clockwise, as a closed section (M,
    2).
    """
    w = width / 2
    h = height / 2
    corners = [(w, -h), (w, h), (-w, h), (-w, -h), (w, -h), (w, h)]
    return rounded(corners, bevel, steps)[1:-1]


def ellipse(width: float, height: float, count: int = 20) -> Array:
    """Return an ellipse with the given half-axes, counter-clockwise, as a closed
    section (count, 2).
    """
    t = 2 * np.pi * np.arange(count) / count
    return np.stack([width * np.cos(t), height * np.sin(t)], axis=1)


Rest = Callable[[Array, Array], Array]
# degrees; where two parts of a profile meet at more than this, the edge stays hard
HARD_ANGLE = 40.0


@dataclass(frozen=True, eq=False)
class Patch:
    """A piece of surface with one chart."""

    tag: str  # which paint it gets; any string. So it is in all functions here.
    vertices: Array  # (V, 3) positions
    normals: Array  # (V, 3) unit normals, outwards
    uvs: Array  # (V, 2) chart coordinates in [0, 1]
    faces: assets.Ints  # (F, 3) vertex indices
    # width and height of the chart, in object units; its share of the atlas follows
    # from it
    size: tuple[float, float]
    # maps (N,) u and (N,) v to the (N, 3) surface points as they were before `placed`
    rest: Rest


def placed(
    patches: Iterable[Patch],
    rotation: Array | None = None,
    offset: Sequence[float] = (0.0, 0.0, 0.0),
) -> list[Patch]:
    """Rotate patches by a (3, 3) rotation, then move them. What is painted on them
    moves along.
    """
    turn = np.eye(3) if rotation is None else rotation
    move = np.asarray(offset, dtype=np.float64)
    return [
        replace(p, vertices=p.vertices @ turn.T + move, normals=p.normals @ turn.T)
        for p in patches
    ]


def stretched(
    patches: Iterable[Patch], factors: Sequence[float] | Array
) -> list[Patch]:
    """Stretch patches along x, y and z by three factors. What is painted on them
    stretches along.
    """
    by = np.asarray(factors, dtype=np.float64)
    return [
        replace(p, vertices=p.vertices * by, normals=unit(p.normals / by))
        for p in patches
    ]


def grid(
    tag: str,
    points: Array,
    normals: Array,
    size: tuple[float, float],
    down: Array,
    across: Array,
) -> Patch:
    """Return the patch over a grid of points (R, C, 3) with unit normals: u runs along
    columns, v along rows, du x dv points outwards; `down` (R,) and `across` (C,) are
    the rows' v and the columns' u, which increase from 0 to 1.
    """
    rows, columns = points.shape[:2]
    u = np.broadcast_to(across, (rows, columns))
    v = np.broadcast_to(down[:, None], (rows, columns))

    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(
        -1
    )
    faces = (
        (corner[:, None] + [[0, 1, columns + 1, 0, columns + 1, columns]])
        .reshape(-1, 3)
        .astype(np.int64)
    )
    area = np.linalg.norm(assets.face_vectors(points.reshape(-1, 3)[faces]), axis=1)
    # none where a row shrinks to a point
    faces = faces[area > 1e-6 * float(np.median(area[area > 0.0]))]
    places = RegularGridInterpolator(
        (down, across), points, bounds_error=False, fill_value=None
    )

    def rest(at_u: Array, at_v: Array) -> Array:
        return np.asarray(places(np.stack([at_v, at_u], axis=-1)))

    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)
    return Patch(
        tag, points.reshape(-1, 3), normals.reshape(-1, 3), uvs, faces, size, rest
    )


def _along(curve: Array) -> tuple[Array, float]:
    """Return (K,) normalised arc lengths of a polyline, and its length."""
    at = lengths(curve)
    return at / at[-1], float(at[-1])


def _fan(count: int) -> assets.Ints:
    """The faces (count, 3) between a middle, which is vertex 0, and a ring of `count`
    vertices after it.
    """
    j = np.arange(count)
    return np.stack([np.zeros_like(j), 1 + j, 1 + (j + 1) % count], axis=1).astype(
        np.int64
    )


def _profile_normals(parts: Sequence[Array]) -> list[Array]:
    """Unit normals (dz, -dr) of consecutive (r, z) polylines, shared where they meet
    smoothly or on the axis.
    """
    directions = []
    for part in parts:
        step = np.diff(part, axis=0)
        direction = np.concatenate([step[:1], part[2:] - part[:-2], step[-1:]])
        for end, row in ((0, 0), (-1, -1)):
            if part[end, 0] < 1e-9:
                direction[row] = (step[row][0], 0.0)
        directions.append(unit(direction))
    for before, after, p, q in zip(
        directions, directions[1:], parts, parts[1:], strict=False
    ):
        meets = float(np.linalg.norm(p[-1] - q[0])) < 1e-9
        if meets and float(before[-1] @ after[0]) > np.cos(np.radians(HARD_ANGLE)):
            before[-1] = after[0] = unit(before[-1] + after[0])
    return [np.stack([d[:, 1], -d[:, 0]], axis=1) for d in directions]


def _around(curve: Array, theta: Array) -> Array:
    """Points (K, M, 3) of a curve (K, 2) of points (r, z) at angles (M,) about the z
    axis.
    """
    up = np.broadcast_to(curve[:, 1:], (len(curve), len(theta)))
    return np.stack(
        [curve[:, :1] * np.cos(theta), curve[:, :1] * np.sin(theta), up], axis=-1
    )


def _disc(tag: str, profile: Array, normals: Array, columns: int) -> Patch:
    """A piece of a surface of revolution that starts or ends on the axis, charted by
    its distance from the pole.
    """
    inwards = profile[-1, 0] < 1e-9
    curve, normal = (profile[::-1], normals[::-1]) if inwards else (profile, normals)
    at, length = _along(curve)
    theta = 2 * np.pi * np.arange(columns) / columns
    # a profile that ends on the axis faces up: seen from above it is not mirrored
    side = 1.0 if inwards else -1.0
    vertices, vertex_normals = (
        np.concatenate(
            [[[0.0, 0.0, rows[0, 1]]], _around(rows[1:], theta).reshape(-1, 3)]
        )
        for rows in (curve, normal)
    )
    around = [
        0.5 + 0.5 * side * at[1:, None] * np.cos(theta),
        0.5 + 0.5 * at[1:, None] * np.sin(theta),
    ]
    uvs = np.concatenate([[[0.5, 0.5]], np.stack(around, axis=-1).reshape(-1, 2)])

    j = np.arange(columns)
    k = (j + 1) % columns
    faces = [_fan(columns)]
    for row in range(len(curve) - 2):
        a = 1 + row * columns
        b = 1 + (row + 1) * columns
        faces += [
            np.stack([a + j, b + j, b + k], axis=1),
            np.stack([a + j, b + k, a + k], axis=1),
        ]
    triangles = np.concatenate(faces)

    def rest(u: Array, v: Array) -> Array:
        x = (2 * u - 1) * side
        y = 2 * v - 1
        rho = np.minimum(np.hypot(x, y), 1.0)
        radius = np.interp(rho, at, curve[:, 0])
        angle = np.arctan2(y, x)
        return np.stack(
            [
                radius * np.cos(angle),
                radius * np.sin(angle),
                np.interp(rho, at, curve[:, 1]),
            ],
            axis=-1,
        )

    size = (2 * length, 2 * length)
    return Patch(
        tag,
        vertices,
        vertex_normals,
        uvs,
        triangles if inwards else triangles[:, ::-1],
        size,
        rest,
    )


def _wall(tag: str, profile: Array, normals: Array, columns: int) -> list[Patch]:
    """A piece of a surface of revolution charted as an unrolled band, cut in 2 or 4
    where it would be a long strip.
    """
    theta = 2 * np.pi * np.arange(columns + 1) / columns
    theta[-1] = 0.0  # the seam's two columns are the same points, to the bit
    points = _around(profile, theta)
    normal = _around(normals, theta)
    down, length = _along(profile)
    width = 2 * np.pi * float(np.quantile(profile[:, 0], 0.75))
    pieces = (
        1 if width <= 3 * length else 2 if width <= 6 * length or columns % 4 else 4
    )
    each = columns // pieces
    columns_of = (np.s_[:, at : at + each + 1] for at in range(0, each * pieces, each))
    across = np.arange(each + 1) / each
    size = (width / pieces, length)
    return [
        grid(tag, points[piece], normal[piece], size, down, across)
        for piece in columns_of
    ]


def lathe(profile: Sequence[tuple[str, Points]], columns: int = 56) -> list[Patch]:
    """Turn a profile about the z axis.

    Args:
        profile: consecutive pieces (tag, (K, 2) points (r, z)), walked with the
            material on the left: along the bottom away from the axis, up the outside,
            over the lip, down the inside. A piece becomes a disc where it is mostly
            flat and touches the axis, a band otherwise.
        columns: faces around.
    """
    curves = [np.asarray(curve, dtype=np.float64) for _, curve in profile]
    patches = []
    for (tag, _), curve, normals in zip(
        profile, curves, _profile_normals(curves), strict=True
    ):
        touches = (
            min(curve[0, 0], curve[-1, 0]) < 1e-9 <= max(curve[0, 0], curve[-1, 0])
        )
        flat = abs(curve[-1, 0] - curve[0, 0]) > 0.5 * _along(curve)[1]
        patches += (
            [_disc(tag, curve, normals, columns)]
            if touches and flat
            else _wall(tag, curve, normals, columns)
        )
    return patches


def vessel(
    outside: Array, wall: float, floor: float, *, columns: int = 56, step: float = 0.7
) -> list[Patch]:
    """An open container: an "outside" profile (K, 2) of (r, z) from the foot (z about
    0, r > 0) up to the lip, which is rounded, an "inside" at constant wall thickness
    with a floor at a height, and a "base"; with so many faces around, and a longest
    edge along the profile.
    """
    normal = _profile_normals([outside])[0]
    inner = outside - wall * normal
    keep = np.arange(len(outside))
    # points at which it runs backwards, as in tight bends, go; the last one stays
    while len(keep) > 2:
        back = (np.diff(inner[keep], axis=0) * np.diff(outside[keep], axis=0)).sum(
            axis=1
        ) <= 0.0
        if not back.any():
            break
        keep = np.append(keep[:-1][~back], keep[-1])
    inner = inner[keep][::-1]
    half = np.pi * np.arange(1, 6) / 6
    top = outside[-1] - wall / 2 * normal[-1]
    across = wall / 2 * normal[-1]
    up = np.array([-across[1], across[0]])
    lip = top + np.cos(half)[:, None] * across + np.sin(half)[:, None] * up
    fillet = min(1.5 * wall, 0.3 * float(outside[:, 0].max()))
    edge = at_height(inner[::-1], floor)
    inner = inner[
        (inner[:, 1] > floor + fillet)
        & (inner[:, 0] > 0.05 * float(outside[:, 0].max()))
    ]
    t = np.linspace(0.0, 1.0, 5)[1:, None]
    turn = np.array([max(edge - fillet, 0.4 * edge), floor])
    inside = np.concatenate(
        [
            inner,
            (1 - t) ** 2 * inner[-1]
            + 2 * t * (1 - t) * np.array([edge, floor])
            + t**2 * turn,
        ]
    )
    foot = outside[0]
    inset = min(0.35 * wall, 0.3 * floor)
    pieces = [
        (
            "base",
            dense(
                [(0.0, inset), (0.86 * foot[0], inset), (0.9 * foot[0], foot[1]), foot],
                3 * step,
            ),
        ),
        ("outside", dense(np.concatenate([outside, lip, inner[:1]]), step)),
        ("inside", dense(inside, step)),
        ("inside", dense([turn, (0.0, floor)], 3 * step)),
    ]
    return lathe(pieces, columns)


def sphere(
    tag: str,
    radius: float,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    rows: int = 24,
    columns: int = 40,
) -> list[Patch]:
    """A sphere in three charts: two polar caps and a band."""
    angle = np.pi * np.arange(rows + 1) / rows - np.pi / 2
    curve = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    curve[[0, -1], 0] = 0.0
    cut = rows // 4
    pieces = [
        (tag, curve[: cut + 1]),
        (tag, curve[cut : rows - cut + 1]),
        (tag, curve[rows - cut :]),
    ]
    return placed(lathe(pieces, columns), offset=centre)


def frames(path: Array, first: Sequence[float]) -> tuple[Array, Array, Array]:
    """Return unit tangents and two normals (N, 3) each along a path (N, 3), turning as
    little as possible; `first` is a vector, not along the path, whose part across it is
    the first normal at the start.
    """
    tangent = unit(np.gradient(path, axis=0))
    normal = np.empty_like(path)
    current = np.asarray(first, dtype=np.float64)
    for i, direction in enumerate(tangent):
        current = unit(current - (current @ direction) * direction)
        normal[i] = current
    return tangent, normal, np.cross(tangent, normal)


def sweep(
    tag: str,
    path: Points,
    section: Array,
    scale: Array | Sequence[float] | float = 1.0,
    *,
    first: Sequence[float] = (0.0, 0.0, 1.0),
    caps: bool = False,
    frame: tuple[Array, Array, Array] | None = None,
) -> list[Patch]:
    """Move a closed section along a path (N, 3).

    Args:
        section: (M, 2) counter-clockwise, coordinates along the first and second
            normal.
        scale: one number, (N,) or (N, 2): the section's scale at each centre; 0 closes
            the surface in a point.
        first: where the section's first axis points at the start.
        caps: close both ends with flat faces and a hard edge.
        frame: tangents and normals to use in place of `frames(path, first)`.
    """
    centres = np.asarray(path, dtype=np.float64)
    tangent, a, b = frames(centres, first) if frame is None else frame
    scales = np.asarray(scale, dtype=np.float64)
    scales = np.broadcast_to(
        scales.reshape(-1, 1) if scales.ndim < 2 else scales, (len(centres), 2)
    )
    flat = section[None] * scales[:, None]
    points = centres[:, None] + flat[..., :1] * a[:, None] + flat[..., 1:] * b[:, None]
    normals = np.cross(
        np.roll(points, -1, axis=1) - np.roll(points, 1, axis=1),
        np.gradient(points, axis=0),
    )
    long = np.linalg.norm(normals, axis=-1)
    normals = unit(normals)
    for row, side in ((0, -1.0), (-1, 1.0)):  # where a row is a point
        normals[row][long[row] < 1e-7 * float(long.max())] = side * tangent[row]
    ring, around = _along(np.concatenate([section, section[:1]]))
    closed = np.concatenate([points, points[:, :1]], axis=1)
    closed_normals = np.concatenate([normals, normals[:, :1]], axis=1)
    down = mean_lengths(points)
    width = around * float(np.quantile(scales.mean(axis=1), 0.75))
    patches = [
        grid(
            tag, closed, closed_normals, (width, float(down[-1])), down / down[-1], ring
        )
    ]
    if caps:
        patches += [
            cap(tag, points[0][::-1], -tangent[0]),
            cap(tag, points[-1], tangent[-1]),
        ]
    return patches


def mean_lengths(points: Array, axis: int = 0) -> Array:
    """Return mean lengths along an axis of a grid of points (R, C, 3), from 0."""
    steps = np.linalg.norm(np.diff(points, axis=axis), axis=-1).mean(axis=1 - axis)
    return np.concatenate([[0.0], np.cumsum(steps)])


def cap(tag: str, ring: Array, normal: Array) -> Patch:
    """A flat face bounded by a convex ring (M, 3), counter-clockwise seen from outside,
    with the given unit normal.
    """
    centre = ring.mean(axis=0)
    x = unit(ring[0] - centre)
    x = unit(x - (x @ normal) * normal)
    y = np.cross(normal, x)
    flat = np.stack([(ring - centre) @ x, (ring - centre) @ y], axis=1)
    low = flat.min(axis=0)
    span = flat.max(axis=0) - flat.min(axis=0)
    uvs = (np.concatenate([[[0.0, 0.0]], flat]) - low) / span
    vertices = np.concatenate([centre[None], ring])

    def rest(u: Array, v: Array) -> Array:
        return np.asarray(
            centre
            + (u * span[0] + low[0])[:, None] * x
            + (v * span[1] + low[1])[:, None] * y
        )

    size = (float(span[0]), float(span[1]))
    return Patch(
        tag,
        vertices,
        np.tile(normal, (len(vertices), 1)),
        uvs,
        _fan(len(ring)),
        size,
        rest,
    )


def box(
    tag: str,
    centre: Sequence[float],
    size: Sequence[float],
    bevel: float,
    steps: int = 2,
    cells: int = 1,
) -> list[Patch]:
    """A box with edges and corners rounded by a radius: six charts, smooth normals,
    cells across half an edge's rounding (`steps`) and across the flat part of a face,
    each way.
    """
    half = np.asarray(size, dtype=np.float64) / 2
    bevel = min(bevel, 0.95 * float(half.min()))
    core = half - bevel
    patches = []
    for axis in range(3):
        i = (axis + 1) % 3
        j = (axis + 2) % 3
        for side in (1.0, -1.0):
            # equal angles
            edges = [
                core[k] + bevel * np.tan(np.linspace(0.0, np.pi / 4, steps + 1))
                for k in (i, j)
            ]
            flats = [np.linspace(-core[k], core[k], cells + 1) for k in (i, j)]
            u, v = (
                np.concatenate([-edge[:0:-1], flat, edge[1:]])
                for edge, flat in zip(edges, flats, strict=True)
            )
            cube = np.empty((len(v), len(u), 3))
            cube[..., axis] = half[axis]
            cube[..., i], cube[..., j] = u[None], v[:, None]
            inner = np.clip(cube, -core, core)
            normal = unit(cube - inner)
            points = inner + bevel * normal
            if side < 0:  # half a turn about the j axis: keeps orientation
                points = points[:, ::-1].copy()
                normal = normal[:, ::-1].copy()
                points[..., axis] *= -1.0
                normal[..., axis] *= -1.0
            down = (v + half[j]) / (2 * half[j])
            across = (u + half[i]) / (2 * half[i])
            across = across if side > 0 else 1.0 - across[::-1]
            extent = (2 * float(half[i]), 2 * float(half[j]))
            patches.append(
                grid(
                    tag,
                    points + np.asarray(centre, dtype=np.float64),
                    normal,
                    extent,
                    down,
                    across,
                )
            )
    return patches


# ---------------------------------------------------------------------------------------------------------------------
# Cutting patches along curves: what is carved out of a smooth surface becomes a part
# with an edge of its own.
#
# A curve is where a function of the surface's points is zero. Triangles that it crosses
# are split there, so that the edge is as smooth as the function and not as coarse as
# the grid.


# (N, 3) points to (N,) values, positive inside; about the distance to the edge
Field = Callable[[Array], Array]
# share of an edge within which a cut goes through the edge's end: thinner slivers are
# not worth a triangle
SNAP = 0.1


def carved(patches: Iterable[Patch], inside: Field, tag: str | None) -> list[Patch]:
    """Return patches, smooth and not placed yet, with what lies inside under a tag of
    its own; None leaves it out.
    """
    pieces = []
    for patch in patches:
        edges = _edges(patch)
        value = np.array(inside(patch.vertices))
        ends = value[edges]
        crossed = ends[:, 0] * ends[:, 1] < 0.0
        share = np.abs(ends[crossed]) / np.abs(ends[crossed]).sum(axis=1, keepdims=True)
        value[edges[crossed][share < SNAP]] = 0.0
        if value.max() <= 0.0:
            pieces.append(patch)
            continue
        cut, side = _split(patch, value)
        for faces, part in ((cut.faces[~side], patch.tag), (cut.faces[side], tag)):
            if len(faces) and part is not None:
                pieces.append(cropped(replace(cut, faces=faces, tag=part)))
    return pieces


def cropped(patch: Patch) -> Patch:
    """Return the patch with a chart that is as large as what its faces use of it."""
    used = patch.uvs[np.unique(patch.faces)]
    low = used.min(axis=0)
    span = np.ptp(used, axis=0)
    size = (patch.size[0] * float(span[0]), patch.size[1] * float(span[1]))
    uvs = np.clip((patch.uvs - low) / span, 0.0, 1.0)
    return replace(
        patch,
        uvs=uvs,
        size=size,
        rest=lambda u, v: patch.rest(low[0] + u * span[0], low[1] + v * span[1]),
    )


def _edges(patch: Patch) -> assets.Ints:
    pairs = np.concatenate(
        [patch.faces[:, [0, 1]], patch.faces[:, [1, 2]], patch.faces[:, [2, 0]]]
    )
    return np.asarray(np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int64))


def _split(patch: Patch, value: Array) -> tuple[Patch, assets.Bools]:
    """The patch with its triangles split where the values change sign, and (F,) whether
    each face is inside.
    """
    edges = _edges(patch)
    crossed = edges[value[edges[:, 0]] * value[edges[:, 1]] < 0.0]
    a, b = crossed.T
    share = (value[a] / (value[a] - value[b]))[:, None]
    extra = [
        one[a] + share * (one[b] - one[a])
        for one in (patch.vertices, patch.normals, patch.uvs)
    ]
    extra[1] /= np.linalg.norm(extra[1], axis=1, keepdims=True)
    number = {
        (int(i), int(j)): len(patch.vertices) + k for k, (i, j) in enumerate(crossed)
    }
    faces: list[tuple[int, int, int]] = []
    side: list[bool] = []
    for face in patch.faces:
        here = value[face]
        if here.min() >= 0.0 or here.max() <= 0.0:
            faces.append(tuple(int(i) for i in face))  # type: ignore[arg-type]
            side.append(bool(here.sum() > 0.0))
            continue
        around: list[tuple[int, float]] = []  # the outline with the cuts in it
        for i in range(3):
            one = int(face[i])
            other = int(face[(i + 1) % 3])
            around.append((one, float(value[one])))
            cut = number.get((min(one, other), max(one, other)))
            if cut is not None:
                around.append((cut, 0.0))
        for sign in (1.0, -1.0):
            part = [index for index, at in around if at * sign >= 0.0]
            for k in range(1, len(part) - 1):
                faces.append((part[0], part[k], part[k + 1]))
                side.append(sign > 0.0)
    before = (patch.vertices, patch.normals, patch.uvs)
    places, normals, uvs = (
        np.concatenate([one, more]) for one, more in zip(before, extra, strict=True)
    )
    return replace(
        patch, vertices=places, normals=normals, uvs=uvs, faces=np.array(faces)
    ), np.array(side)
