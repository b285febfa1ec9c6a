"""Geometric primitives of the bundled objects: patches, each with a chart.

A `Patch` is a piece of a mesh. Its chart is a rectangle of the texture, with chart
coordinates in [0, 1]^2. A function maps chart coordinates to points of the surface, so
that textures are painted in object coordinates and have no visible seams. Everything is
float64, with z up. Lengths are in the unit of the object, mostly centimetres. Faces are
counter-clockwise seen from outside, and the charts are not mirrored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, pairwise, product
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline, RegularGridInterpolator

from advsearch.extend import assets

# ---- plane and space curves
# ----------------------------------------------------------------------------------

Array: TypeAlias = npt.NDArray[np.float64]
Points: TypeAlias = Array | Sequence[Sequence[float] | Array]


def normalize(vectors: Array) -> Array:
    """Normalize vectors (..., 3) or (..., 2); zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def radius_at_height(profile: Array, height: float) -> float:
    """Return the radius of a profile (K, 2) of points (r, z), with rising z, at a
    height.
    """
    return float(np.interp(height, profile[:, 1], profile[:, 0]))


def arc_lengths(curve: Array) -> Array:
    """Return the arc length (K,) from the start of a polyline (K, D) to each point."""
    return np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]
    )


def distance_to_polylines(x: Array, y: Array, *paths: Points) -> Array:
    """Return the distance (N,) from points to the nearest of several polylines.

    Args:
        x, y: coordinates of the points (N,).
        paths: polylines (K, 2).
    """
    distance = np.full(len(x), np.inf)
    for (x0, y0), (x1, y1) in chain.from_iterable(map(pairwise, paths)):
        dx = x1 - x0
        dy = y1 - y0
        # the nearest point of the segment, as a fraction of its length
        t = np.clip(((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        segment_distance = np.hypot(x - x0 - t * dx, y - y0 - t * dy)
        distance = np.minimum(distance, segment_distance)
    return distance


def to_xz_plane(curve: Array) -> Array:
    """Return a plane curve (K, 2) as one (K, 3) in the plane of x and z."""
    return np.insert(curve, 1, 0.0, axis=1)


def make_rotation_matrix(axis: str, degrees: float) -> Array:
    """Return the matrix (3, 3) of a right-handed rotation about a coordinate axis.

    It turns column vectors. The axis is "x", "y" or "z".
    """
    cosine = np.cos(np.radians(degrees))
    sine = np.sin(np.radians(degrees))
    # the plane in which it turns, from i towards j
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[[i, i, j, j], [i, j, i, j]] = cosine, -sine, sine, cosine
    return matrix


def sample_spline(points: Points, count: int) -> Array:
    """Sample a Catmull-Rom curve through points (K, D) at `count` points, ends
    included.

    Its parameter is the length along the polyline of the points, so that unevenly
    spaced points do not make it overshoot.
    """
    knots = np.asarray(points, dtype=np.float64)
    arc_length = arc_lengths(knots)
    slopes = np.gradient(knots, arc_length, axis=0)
    curve = CubicHermiteSpline(arc_length, knots, slopes)
    return np.asarray(curve(np.linspace(0.0, arc_length[-1], count)))


def round_corners(
    corners: Points, radius: float | Sequence[float], steps: int = 5
) -> Array:
    """Round the inner corners of an open polyline (K, D), by parabolas.

    Args:
        corners: the polyline; its first and last point stay as they are.
        radius: distance from a corner at which its rounding begins, for all corners or
            (K - 2,). It is reduced to half of the shorter edge at the corner.
        steps: edges of a rounded corner.
    """
    points = np.asarray(corners, dtype=np.float64)
    n_inner = max(len(points) - 2, 0)
    radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), (n_inner,))
    rounded_points = [points[0]]
    for index in range(n_inner):
        previous, corner, following = points[index : index + 3]
        rounded_points.extend(
            _round_corner(previous, corner, following, float(radii[index]), steps)
        )
    rounded_points.append(points[-1])
    return np.array(rounded_points)


def _round_corner(
    previous: Array, corner: Array, following: Array, radius: float, steps: int
) -> list[Array]:
    """Return the points (D,) of a rounded corner between two other points.

    Args:
        previous, corner, following: three consecutive points (D,) of a polyline.
        radius: how far from the corner the rounding begins on both edges, at most.
        steps: edges of the rounding; it has `steps` + 1 points.
    """
    to_previous = previous - corner
    to_next = following - corner
    # a little less than half an edge, so that two roundings never meet
    reach = min(
        radius,
        0.499 * float(np.linalg.norm(to_previous)),
        0.499 * float(np.linalg.norm(to_next)),
    )
    if reach <= 1e-9:  # a sharp corner
        return [corner]
    start = corner + normalize(to_previous) * reach
    end = corner + normalize(to_next) * reach
    t = np.linspace(0.0, 1.0, steps + 1)[:, None]
    # quadratic Bezier curve whose control point is the corner
    return list((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)


def subdivide(points: Points, longest: float) -> Array:
    """Divide the edges of a polyline (K, D) that are longer than `longest`.

    All pieces of an edge are equally long.
    """
    curve = np.asarray(points, dtype=np.float64)
    parts = [curve[:1]]
    for start, end in pairwise(curve):
        edge_length = float(np.linalg.norm(end - start))
        # The ratio is rounded, so that rounding errors add no piece.
        n_pieces = max(1, int(np.ceil(round(edge_length / longest, 6))))
        t = np.arange(1, n_pieces + 1) / n_pieces  # without the start
        parts.append(start + (end - start) * t[:, None])
    return np.concatenate(parts)


def polygon(sides: int, bevel: float = 0.12, steps: int = 2) -> Array:
    """Return a regular polygon with rounded corners as a closed section (M, 2).

    Its circumradius is 1, and a flat side is at the bottom.
    """
    # The first and last corner of a polyline are not rounded. So the polygon is
    # continued by two corners, and the first and last point are cut off. -0.5 places a
    # side, and not a corner, at the bottom, where the angle is -pi / 2.
    angle = 2 * np.pi * (np.arange(sides + 2) - 0.5) / sides - np.pi / 2
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return round_corners(ring, radius=bevel, steps=steps)[1:-1]


def rectangle(width: float, height: float, bevel: float, steps: int = 3) -> Array:
    """Return a rounded rectangle around the origin as a closed section (M, 2).

    It is counter-clockwise.

    Args:
        width, height: width and height of the rectangle.
        bevel: distance from a corner at which its rounding begins.
        steps: edges of a rounded corner.
    """
    # The first and last corner of a polyline are not rounded. So the rectangle is
    # continued by two corners, and the first and last point are cut off.
    half_width = width / 2
    half_height = height / 2
    corners = [
        (half_width, -half_height),
        (half_width, half_height),
        (-half_width, half_height),
        (-half_width, -half_height),
        (half_width, -half_height),
        (half_width, half_height),
    ]
    return round_corners(corners, radius=bevel, steps=steps)[1:-1]


def ellipse(half_width: float, half_height: float, count: int = 20) -> Array:
    """Return an ellipse with two half-axes as a closed counter-clockwise section
    (count, 2).
    """
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([half_width * np.cos(angle), half_height * np.sin(angle)], axis=1)


ChartToPoints = Callable[[Array, Array], Array]
HARD_ANGLE = 40.0
"""Angle in degrees. If two parts of a profile meet at more, their edge stays hard."""


@dataclass(frozen=True, eq=False)
class Patch:
    """A piece of surface with one chart.

    Attributes:
        tag: any string, which selects the paint. In all functions of this module `tag`
            has this meaning.
        vertices: positions (V, 3).
        normals: unit normals (V, 3), outwards.
        uvs: chart coordinates (V, 2) in [0, 1].
        faces: vertex indices (F, 3).
        size: width and height of the chart in object units, which decide its size in
            the atlas.
        compute_rest_points: maps u (N,) and v (N,) to surface points (N, 3) before any
            transform. The patch is painted at these points.
    """

    tag: str
    vertices: Array
    normals: Array
    uvs: Array
    faces: assets.IntArray
    size: tuple[float, float]
    compute_rest_points: ChartToPoints


def transform_patches(
    patches: Iterable[Patch],
    rotation: Array | None = None,
    offset: Sequence[float] = (0.0, 0.0, 0.0),
) -> list[Patch]:
    """Return patches rotated and then translated.

    Their paint moves with them, because it depends on `compute_rest_points`, which stays
    the same.

    Args:
        patches: patches to move; they are not changed.
        rotation: matrix (3, 3); None for no rotation.
        offset: translation (3,).
    """
    matrix = np.eye(3) if rotation is None else rotation
    translation = np.asarray(offset, dtype=np.float64)
    return [
        replace(
            patch,
            vertices=patch.vertices @ matrix.T + translation,
            normals=patch.normals @ matrix.T,
        )
        for patch in patches
    ]


def stretch_patches(
    patches: Iterable[Patch], factors: Sequence[float] | Array
) -> list[Patch]:
    """Return patches scaled along x, y and z.

    Their paint is scaled with them, because it depends on `compute_rest_points`, which
    stays the same.
    """
    scale = np.asarray(factors, dtype=np.float64)
    return [
        replace(
            patch,
            vertices=patch.vertices * scale,
            normals=normalize(patch.normals / scale),
        )
        for patch in patches
    ]


def make_grid_patch(
    tag: str,
    points: Array,
    normals: Array,
    size: tuple[float, float],
    down: Array,
    across: Array,
) -> Patch:
    """Create the patch of a grid of points (R, C, 3) with unit normals.

    The patch has a chart, which is the rectangle of its texture. The atlas paints each
    texel at its 3-D point, which is interpolated bilinearly between the grid's points.

    Args:
        tag: tag of the paint.
        points: u grows from column to column, and v from row to row; the cross
            product of these directions points outwards.
        normals: (R, C, 3).
        size: width and height of the chart in object units.
        down: chart coordinate v of the rows (R,), increasing from 0 to 1.
        across: chart coordinate u of the columns (C,), increasing from 0 to 1.
    """
    rows, columns = points.shape[:2]
    vertices = points.reshape(-1, 3)
    # `fill_value=None` extrapolates: texels of the gutter lie a little outside of [0,
    # 1].
    interpolate = RegularGridInterpolator(
        (down, across), points, bounds_error=False, fill_value=None
    )
    return Patch(
        tag=tag,
        vertices=vertices,
        normals=normals.reshape(-1, 3),
        uvs=_grid_uvs(down, across),
        faces=_grid_faces(vertices, rows, columns),
        size=size,
        compute_rest_points=partial(_interpolate_points, interpolate),
    )


def _interpolate_points(
    interpolate: Callable[[Array], Any], u: Array, v: Array
) -> Array:
    """Return the points (N, 3) at chart coordinates (N,).

    Args:
        interpolate: returns the points at (N, 2) pairs of v and u.
        u, v: chart coordinates.
    """
    return np.asarray(interpolate(np.stack([v, u], axis=-1)))


def _grid_uvs(down: Array, across: Array) -> Array:
    """Return the chart coordinates (R * C, 2) of a grid, row by row.

    Args:
        down: chart coordinate v of the rows (R,).
        across: chart coordinate u of the columns (C,).
    """
    grid_size = (len(down), len(across))
    u = np.broadcast_to(across, grid_size)
    v = np.broadcast_to(down[:, None], grid_size)
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def _grid_faces(vertices: Array, rows: int, columns: int) -> assets.IntArray:
    """Return the triangles (F, 3) of a grid of vertices (rows * columns, 3).

    Triangles without area are left out: they are where a row shrinks to a point.
    """
    # A cell has two triangles. Their vertices are relative to the first of the cell.
    row = np.arange(rows - 1)[:, None]
    column = np.arange(columns - 1)
    first_vertices = (row * columns + column).reshape(-1, 1)
    relative_vertices = [[0, 1, columns + 1, 0, columns + 1, columns]]
    faces = (first_vertices + relative_vertices).reshape(-1, 3).astype(np.int64)
    area = np.linalg.norm(assets.compute_area_vectors(vertices[faces]), axis=1)
    typical_area = float(np.median(area[area > 0.0]))
    with_area: assets.IntArray = faces[area > 1e-6 * typical_area]
    return with_area


def _compute_length_fractions(curve: Array) -> tuple[Array, float]:
    """Return the arc lengths (K,) of a polyline as fractions, and its total length."""
    arc_length = arc_lengths(curve)
    return arc_length / arc_length[-1], float(arc_length[-1])


def _fan(count: int) -> assets.IntArray:
    """Return the faces (count, 3) between vertex 0 and a ring of the next vertices."""
    index = np.arange(count)  # indices within the ring
    following = (index + 1) % count
    faces = np.stack([np.zeros_like(index), 1 + index, 1 + following], axis=1)
    return faces.astype(np.int64)


def _profile_normals(polylines: Sequence[Array]) -> list[Array]:
    """Return the unit normals (K, 2) of consecutive polylines, as (r, z).

    The points (r, z) of a polyline follow each other with the material on their left.
    So a direction (dr, dz) that is turned to the right, (dz, -dr), points outwards.
    Where a polyline ends on the axis, its normal is along the axis. Where two polylines
    meet at less than `HARD_ANGLE` degrees, they share the mean of their normals.
    """
    all_directions = [_profile_directions(polyline) for polyline in polylines]
    min_smooth_cosine = np.cos(np.radians(HARD_ANGLE))
    for index in range(len(polylines) - 1):
        gap = polylines[index][-1] - polylines[index + 1][0]
        is_joined = float(np.linalg.norm(gap)) < 1e-9  # up to rounding
        end_direction = all_directions[index][-1]
        next_direction = all_directions[index + 1][0]
        is_smooth = float(end_direction @ next_direction) > min_smooth_cosine
        if is_joined and is_smooth:
            mean_direction = normalize(end_direction + next_direction)
            all_directions[index][-1] = mean_direction
            all_directions[index + 1][0] = mean_direction
    return [_turn_right(directions) for directions in all_directions]


def _turn_right(directions: Array) -> Array:
    """Return directions (K, 2) of a plane turned to the right by 90 degrees."""
    return np.stack([directions[:, 1], -directions[:, 0]], axis=1)


def _profile_directions(polyline: Array) -> Array:
    """Return the unit directions (K, 2) of a profile (K, 2) of points (r, z).

    They are horizontal where it ends on the axis, as at a pole.
    """
    segments = np.diff(polyline, axis=0)
    # central differences, one-sided at the ends
    directions = np.concatenate(
        [segments[:1], polyline[2:] - polyline[:-2], segments[-1:]]
    )
    for end in (0, -1):
        is_on_axis = polyline[end, 0] < 1e-9
        if is_on_axis:
            directions[end] = (segments[end][0], 0.0)
    return normalize(directions)


def _revolve_curve(curve: Array, theta: Array) -> Array:
    """Turn a curve (K, 2) of points (r, z) about the z axis to angles (M,), in radians.

    Returns:
        (K, M, 3): the points of each angle.
    """
    heights = np.broadcast_to(curve[:, 1:], (len(curve), len(theta)))
    return np.stack(
        [curve[:, :1] * np.cos(theta), curve[:, :1] * np.sin(theta), heights], axis=-1
    )


@dataclass(frozen=True, eq=False)
class _DiscChart:
    """Chart of a surface of revolution with a pole: a disc around the pole.

    Attributes:
        curve: profile (K, 2) of points (r, z), from the pole outwards.
        radial_fraction: distance of its points from the pole in the chart (K,): the
            arc length as a fraction.
        x_sign: -1 if the disc is seen from below, where the x axis has the other
            direction, else 1.
    """

    curve: Array
    radial_fraction: Array
    x_sign: float

    def compute_uvs(self, theta: Array) -> Array:
        """Return the chart coordinates (1 + (K - 1) * M, 2) of the pole, then of rings.

        Args:
            theta: angles about the z axis (M,), in radians.
        """
        chart_radius = 0.5 * self.radial_fraction[1:, None]
        ring_uvs = [
            0.5 + chart_radius * self.x_sign * np.cos(theta),
            0.5 + chart_radius * np.sin(theta),
        ]
        pole_uv = [[0.5, 0.5]]
        return np.concatenate([pole_uv, np.stack(ring_uvs, axis=-1).reshape(-1, 2)])

    def compute_points(self, u: Array, v: Array) -> Array:
        """Return the points (N, 3) at chart coordinates (N,)."""
        # from [0, 1] to [-1, 1], so that the disc has radius 1 around the pole
        x = (2 * u - 1) * self.x_sign
        y = 2 * v - 1
        # The corners of the chart are outside of the disc and get the color of its rim.
        pole_distance = np.minimum(np.hypot(x, y), 1.0)
        radius = np.interp(pole_distance, self.radial_fraction, self.curve[:, 0])
        z = np.interp(pole_distance, self.radial_fraction, self.curve[:, 1])
        angle = np.arctan2(y, x)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)


def _disc(tag: str, profile: Array, normals: Array, columns: int) -> Patch:
    """Create a piece of a surface of revolution that starts or ends on the axis.

    Args:
        tag: tag of the paint.
        profile: (K, 2) points (r, z).
        normals: (K, 2), as (r, z), at these points.
        columns: number of faces around the axis.
    """
    # The material is on the left of a profile. So a profile that ends on the axis (r is
    # 0) faces up, and one that begins there faces down.
    faces_up = profile[-1, 0] < 1e-9
    triangles = _disc_triangles(columns, profile)
    x_sign = 1.0
    if faces_up:
        # the same points, but from the pole outwards
        profile = profile[::-1]
        normals = normals[::-1]
    else:
        x_sign = -1.0
        triangles = triangles[:, ::-1]
    radial_fraction, length = _compute_length_fractions(profile)
    chart = _DiscChart(profile, radial_fraction, x_sign)
    theta = 2 * np.pi * np.arange(columns) / columns
    return Patch(
        tag=tag,
        vertices=_revolve_from_pole(profile, theta),
        normals=_revolve_from_pole(normals, theta),
        uvs=chart.compute_uvs(theta),
        faces=triangles,
        size=(2 * length, 2 * length),  # `length` is the radius of the unrolled disc
        compute_rest_points=chart.compute_points,
    )


def _revolve_from_pole(curve: Array, theta: Array) -> Array:
    """Rotate a curve (K, 2) whose first point is on the axis to angles (M,).

    Returns:
        (1 + (K - 1) * M, 3): the pole, then ring by ring.
    """
    pole = [[0.0, 0.0, curve[0, 1]]]
    return np.concatenate([pole, _revolve_curve(curve[1:], theta).reshape(-1, 3)])


def _disc_triangles(columns: int, curve: Array) -> assets.IntArray:
    """Return the triangles (F, 3) of a disc with rings of vertices around a pole.

    Vertex 0 is the pole; then come rings of `columns` vertices, one for each other
    point of the curve (K, 2). The triangles are counter-clockwise seen from above.
    """
    column = np.arange(columns)
    next_column = (column + 1) % columns
    n_rings = len(curve) - 1
    faces = [_fan(columns)]  # from the pole to the first ring
    for row in range(n_rings - 1):
        # indices of the first vertices of two neighboring rings
        inner = 1 + row * columns
        outer = 1 + (row + 1) * columns
        faces += [
            np.stack([inner + column, outer + column, outer + next_column], axis=1),
            np.stack(
                [inner + column, outer + next_column, inner + next_column], axis=1
            ),
        ]
    return np.concatenate(faces)


def _wall(tag: str, profile: Array, normals: Array, columns: int) -> list[Patch]:
    """Create a piece of a surface of revolution as an unrolled band.

    A band that is much wider than high is cut into 2 or 4 charts, because long charts
    leave much of the texture atlas empty.

    Args:
        tag: tag of the paint.
        profile: (K, 2) points (r, z).
        normals: (K, 2), as (r, z), at these points.
        columns: faces around.
    """
    theta = 2 * np.pi * np.arange(columns + 1) / columns
    # The seam has two columns at the same points. With 2 pi they would differ in the
    # last bits.
    theta[-1] = 0.0
    points = _revolve_curve(profile, theta)
    normal = _revolve_curve(normals, theta)
    down, length = _compute_length_fractions(profile)
    # The circumference at the upper quartile of the radii. That at the largest radius
    # would depend on single points, such as a lip.
    width = 2 * np.pi * float(np.quantile(profile[:, 0], 0.75))
    n_pieces = _count_wall_charts(width, length, columns)
    piece_columns = columns // n_pieces
    across = np.arange(piece_columns + 1) / piece_columns
    size = (width / n_pieces, length)
    pieces = [
        np.s_[:, start : start + piece_columns + 1]
        for start in range(0, piece_columns * n_pieces, piece_columns)
    ]
    return [
        make_grid_patch(tag, points[piece], normal[piece], size, down, across)
        for piece in pieces
    ]


def _count_wall_charts(width: float, length: float, columns: int) -> int:
    """Return the number of charts that a band is cut into.

    Args:
        width: circumference of the band.
        length: its length from one edge to the other.
        columns: faces around it.
    """
    can_be_quartered = columns % 4 == 0
    if width > 6 * length and can_be_quartered:
        return 4
    return 2 if width > 3 * length else 1


def revolve_profile(
    profile: Sequence[tuple[str, Points]], columns: int = 56
) -> list[Patch]:
    """Rotate a profile about the z axis.

    Args:
        profile: consecutive pieces (tag, (K, 2) points (r, z)). Their points follow each
            other with the material on their left: along the bottom away from the axis,
            up the outside, over the lip, down the inside. A piece becomes a disc if it
            is mostly flat and one of its ends is on the axis, otherwise a band.
        columns: number of faces around the axis.
    """
    tags = [tag for tag, _ in profile]
    curves = [np.asarray(curve, dtype=np.float64) for _, curve in profile]
    patches = []
    for tag, curve, normals in zip(tags, curves, _profile_normals(curves), strict=True):
        if _becomes_disc(curve):
            patches.append(_disc(tag, curve, normals, columns))
        else:
            patches += _wall(tag, curve, normals, columns)
    return patches


def _becomes_disc(curve: Array) -> bool:
    """Return whether a profile (K, 2) is mostly flat, with one of its ends on the axis."""
    starts_on_axis = curve[0, 0] < 1e-9  # a radius of 0, up to rounding
    ends_on_axis = curve[-1, 0] < 1e-9
    has_single_pole = starts_on_axis != ends_on_axis
    radius_change = abs(curve[-1, 0] - curve[0, 0])
    _, length = _compute_length_fractions(curve)
    is_mostly_flat = radius_change > 0.5 * length
    return bool(has_single_pole and is_mostly_flat)


def make_vessel(
    outside: Array, wall: float, floor: float, *, columns: int = 56, step: float = 0.7
) -> list[Patch]:
    """Create an open container with a constant wall thickness.

    Its tags are "base", "outside" (with the rounded lip) and "inside".

    Args:
        outside: profile (K, 2) of points (r, z) from the foot (z about 0, r > 0) to the
            lip.
        wall: thickness of the wall.
        floor: height of the floor inside.
        columns: number of faces around the axis.
        step: longest edge along the profile.
    """
    normal, inner = _inner_profile(outside, wall)  # `inner` is from the lip downwards
    lip = _round_lip(outside, wall, normal)
    inside = _vessel_inside(outside, inner, wall, floor)
    fillet_end = inside[-1]
    outside_with_lip = np.concatenate([outside, lip, inside[:1]])
    base = _hollow_base(outside[0], wall, floor)
    pieces = [
        ("base", subdivide(base, longest=3 * step)),
        ("outside", subdivide(outside_with_lip, longest=step)),
        ("inside", subdivide(inside, longest=step)),
        ("inside", subdivide([fillet_end, (0.0, floor)], longest=3 * step)),
    ]
    return revolve_profile(pieces, columns=columns)


def _vessel_inside(outside: Array, inner: Array, wall: float, floor: float) -> Array:
    """Return the profile of a container's inside, from the lip to the rounded floor edge.

    Args:
        outside: profile (K, 2) of the outside.
        inner: profile (L, 2) of the inside without a floor, from the lip downwards.
        wall: thickness of the wall.
        floor: height of the floor.
    """
    max_radius = float(outside[:, 0].max())
    fillet = min(1.5 * wall, 0.3 * max_radius)  # radius between wall and floor
    is_open = inner[:, 0] > 0.05 * max_radius  # not where a narrow inside closes
    return _round_floor_edge(inner, is_open, fillet, floor)


def _round_floor_edge(
    inner: Array, is_open: assets.BoolArray, fillet: float, floor: float
) -> Array:
    """Return the profile of a container's wall inside, rounded where it meets the floor.

    Args:
        inner: profile (K, 2) of the inside without a floor, from the lip downwards.
        is_open: whether the container is open at each of its points (K,).
        fillet: radius of the rounding.
        floor: height of the floor.
    """
    ascending_inner = inner[::-1]
    floor_radius = radius_at_height(ascending_inner, floor)
    floor_edge = np.array([floor_radius, floor])
    fillet_end = np.array([max(floor_radius - fillet, 0.4 * floor_radius), floor])
    is_above_fillet = inner[:, 1] > floor + fillet
    inner_wall = inner[is_above_fillet & is_open]
    rounding = _bezier(inner_wall[-1], floor_edge, fillet_end)
    return np.concatenate([inner_wall, rounding])


def _hollow_base(
    foot: Array, wall: float, floor: float
) -> list[Sequence[float] | Array]:
    """Return the profile of a container's base, which is hollow inside a foot ring.

    Args:
        foot: (r, z) of the outer edge of the foot ring.
        wall: thickness of the wall.
        floor: height of the floor inside the container.
    """
    # how far the middle of the base lies above the foot ring
    inset = min(0.35 * wall, 0.3 * floor)
    return [(0.0, inset), (0.86 * foot[0], inset), (0.9 * foot[0], foot[1]), foot]


def _bezier(start: Array, control: Array, end: Array) -> Array:
    """Return four points (4, 2) of a quadratic Bezier curve, its end but not its
    start.
    """
    t = np.linspace(0.0, 1.0, 5)[1:, None]
    return np.asarray((1 - t) ** 2 * start + 2 * t * (1 - t) * control + t**2 * end)


def _inner_profile(outside: Array, wall: float) -> tuple[Array, Array]:
    """Return the normals (K, 2) of a profile, and the profile of the inside of its wall.

    The inside is the profile moved inwards by the thickness of the wall. In tight bends
    some of its steps have the opposite direction of the profile's. The points at which
    these steps begin are removed, until none is left. The inside is returned from the
    lip downwards.
    """
    (normal,) = _profile_normals([outside])
    inner = outside - wall * normal
    remaining = np.arange(len(outside))  # indices of the points that are not removed
    while len(remaining) > 2:
        inner_steps = np.diff(inner[remaining], axis=0)
        outer_steps = np.diff(outside[remaining], axis=0)
        is_backward = (inner_steps * outer_steps).sum(axis=1) <= 0.0
        if not is_backward.any():
            break
        # The last point, at the lip, begins no step, and stays.
        step_starts = remaining[:-1]
        lip = remaining[-1]
        remaining = np.append(step_starts[~is_backward], lip)
    from_lip_downwards = inner[remaining][::-1]
    return normal, from_lip_downwards


def _round_lip(outside: Array, wall: float, normal: Array) -> Array:
    """Return five points (5, 2) of the half circle over the lip of a wall.

    The half circle leads from the outside to the inside; its ends are left out.

    Args:
        outside: profile (K, 2) that ends at the lip.
        wall: thickness of the wall.
        normal: (K, 2) of the profile, outwards.
    """
    angle = np.pi * np.arange(1, 6) / 6
    center = outside[-1] - wall / 2 * normal[-1]
    outwards = wall / 2 * normal[-1]
    # `outwards` turned by 90 degrees to the left, which is the profile's direction
    upwards = np.array([-outwards[1], outwards[0]])
    lip: Array = (
        center + np.cos(angle)[:, None] * outwards + np.sin(angle)[:, None] * upwards
    )
    return lip


def make_sphere_patches(
    tag: str,
    radius: float,
    center: Sequence[float] = (0.0, 0.0, 0.0),
    rows: int = 24,
    columns: int = 40,
) -> list[Patch]:
    """Create a sphere of three charts: two polar caps and a band.

    Args:
        tag: tag of the paint.
        radius: radius of the sphere.
        center: center of the sphere.
        rows: faces from pole to pole.
        columns: faces around the z axis.
    """
    angle = np.pi * np.arange(rows + 1) / rows - np.pi / 2
    curve = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    # exactly on the axis, which a cosine is not
    curve[[0, -1], 0] = 0.0
    # the caps reach from the poles to 45 degrees of latitude
    cut = rows // 4
    pieces = [
        (tag, curve[: cut + 1]),
        (tag, curve[cut : rows - cut + 1]),
        (tag, curve[rows - cut :]),
    ]
    return transform_patches(revolve_profile(pieces, columns=columns), offset=center)


def compute_frames(path: Array, first: Sequence[float]) -> tuple[Array, Array, Array]:
    """Return unit tangents and two normals along a path, with minimal twist.

    Args:
        path: (N, 3).
        first: vector whose part normal to the path is the first normal at the start.

    Returns:
        Three arrays (N, 3): tangents, first normals, second normals.
    """
    tangent = normalize(np.gradient(path, axis=0))
    normal = np.empty_like(path)
    current = np.asarray(first, dtype=np.float64)
    for i, direction in enumerate(tangent):
        # the previous normal without its component along the new tangent
        current = normalize(current - (current @ direction) * direction)
        normal[i] = current
    return tangent, normal, np.cross(tangent, normal)


def sweep_section(
    tag: str,
    path: Points,
    section: Array,
    scale: Array | Sequence[float] | float = 1.0,
    *,
    start_axis: Sequence[float] = (0.0, 0.0, 1.0),
    has_caps: bool = False,
    frame: tuple[Array, Array, Array] | None = None,
) -> list[Patch]:
    """Create the surface that a closed section sweeps along a path (N, 3).

    Args:
        tag: tag of the paint.
        path: the centers of the section.
        section: (M, 2) counter-clockwise, coordinates along the first and second
            normal.
        scale: a number, (N,) or (N, 2): the section's scale at each center, (N, 2) for
            both axes of the section; 0 closes the surface in a point.
        start_axis: direction (3,) of the section's first axis at the start of the path.
        has_caps: whether both ends are closed with flat faces and a hard edge.
        frame: tangents and normals to use in place of `compute_frames(path,
            start_axis)`.
    """
    centers = np.asarray(path, dtype=np.float64)
    if frame is None:
        frame = compute_frames(centers, start_axis)
    tangent, first_normal, second_normal = frame
    scales = _to_axis_scales(scale, len(centers))
    points = _sweep_points(section, scales, centers, first_normal, second_normal)
    ring_fraction, width = _measure_rings(section, scales)
    # distance along the path of each ring
    down = mean_lengths(points)
    # The first column of the chart is repeated as the last one.
    side = make_grid_patch(
        tag,
        _repeat_first(points, axis=1),
        _repeat_first(_sweep_normals(points, tangent), axis=1),
        size=(width, float(down[-1])),
        down=down / down[-1],
        across=ring_fraction,
    )
    return [side, *_sweep_caps(tag, points, tangent)] if has_caps else [side]


def _measure_rings(section: Array, scales: Array) -> tuple[Array, float]:
    """Return the chart coordinates of a closed section, and the width of its chart.

    The coordinates (M + 1,) are those of its points (M, 2), and of the first one again.

    Args:
        section: the section.
        scales: its scales (N, 2) along the path.
    """
    closed_section = _repeat_first(section, axis=0)
    ring_fraction, ring_length = _compute_length_fractions(closed_section)
    # The circumference at the upper quartile of the scales, so that the ends, which may
    # shrink to a point, hardly matter.
    width = ring_length * float(np.quantile(scales.mean(axis=1), 0.75))
    return ring_fraction, width


def _sweep_caps(tag: str, points: Array, tangent: Array) -> list[Patch]:
    """Create the flat faces at both ends of a swept surface.

    Args:
        tag: tag of the paint.
        points: points (N, M, 3), ring by ring.
        tangent: unit tangents (N, 3) of the path.
    """
    # Rings are counter-clockwise seen from the end of the path. The first face is
    # seen from the other side, so its ring is reversed.
    return [
        make_cap_face(tag, points[0][::-1], -tangent[0]),
        make_cap_face(tag, points[-1], tangent[-1]),
    ]


def _to_axis_scales(scale: Array | Sequence[float] | float, count: int) -> Array:
    """Return scales (count, 2) along both axes of a section; see `sweep_section`."""
    scales = np.asarray(scale, dtype=np.float64)
    if scales.ndim < 2:  # the same scale along both axes
        scales = scales.reshape(-1, 1)
    return np.broadcast_to(scales, (count, 2))


def _repeat_first(rings: Array, axis: int) -> Array:
    """Close rings of points by repeating the first one at the end of an axis."""
    return np.concatenate([rings, np.take(rings, [0], axis=axis)], axis=axis)


def _sweep_points(
    section: Array,
    scales: Array,
    centers: Array,
    first_normal: Array,
    second_normal: Array,
) -> Array:
    """Return the points (N, M, 3) of a section (M, 2) at each of the centers (N, 3).

    There it is scaled by `scales` (N, 2), and its two axes are the normals (N, 3).
    """
    scaled_section = section[None] * scales[:, None]
    return (
        centers[:, None]
        + scaled_section[..., :1] * first_normal[:, None]
        + scaled_section[..., 1:] * second_normal[:, None]
    )


def _sweep_normals(points: Array, tangent: Array) -> Array:
    """Return the unit normals (N, M, 3) of a swept surface with points (N, M, 3).

    Where the first or last ring is a single point, they are along the path, outwards.

    Args:
        points: ring by ring.
        tangent: unit tangents (N, 3) of the path.
    """
    ring_tangent = np.roll(points, -1, axis=1) - np.roll(points, 1, axis=1)
    normals = np.cross(ring_tangent, np.gradient(points, axis=0))
    normal_length = np.linalg.norm(normals, axis=-1)
    normals = normalize(normals)
    # Where a ring is a single point, the cross product is 0, up to rounding.
    negligible_length = 1e-7 * float(normal_length.max())
    # Outwards is backwards at the first ring, and forwards at the last.
    for row, direction in ((0, -1.0), (-1, 1.0)):
        is_point = normal_length[row] < negligible_length
        normals[row, is_point] = direction * tangent[row]
    return normals


def mean_lengths(points: Array, axis: int = 0) -> Array:
    """Return the lengths (R,) along a grid of points (R, C, 3) to each of its rows.

    They are arc lengths from the first row, averaged over the columns. With axis 1,
    they are the lengths (C,) to each column, averaged over the rows.
    """
    steps = np.linalg.norm(np.diff(points, axis=axis), axis=-1).mean(axis=1 - axis)
    return np.concatenate([[0.0], np.cumsum(steps)])


def make_cap_face(tag: str, ring: Array, normal: Array) -> Patch:
    """Create a flat face that is bounded by a convex ring (M, 3).

    The ring is counter-clockwise seen from outside, and `normal` (3,) is the outward
    unit normal. The face is a fan of triangles around its middle. The chart is its
    bounding rectangle, with u in the direction from the middle to the first point of
    the ring.
    """
    center = ring.mean(axis=0)
    x_axis = _make_perpendicular(normalize(ring[0] - center), normal)
    y_axis = np.cross(normal, x_axis)
    plane_points = np.stack(
        [(ring - center) @ x_axis, (ring - center) @ y_axis], axis=1
    )
    chart = _PlaneChart(
        center, x_axis, y_axis, plane_points.min(axis=0), np.ptp(plane_points, axis=0)
    )
    vertices = np.concatenate([center[None], ring])
    plane_vertices = np.concatenate([[[0.0, 0.0]], plane_points])
    return Patch(
        tag=tag,
        vertices=vertices,
        normals=np.tile(normal, (len(vertices), 1)),
        uvs=(plane_vertices - chart.lower) / chart.extent,
        faces=_fan(len(ring)),
        size=(float(chart.extent[0]), float(chart.extent[1])),
        compute_rest_points=chart.compute_points,
    )


def _make_perpendicular(direction: Array, normal: Array) -> Array:
    """Return a unit direction (3,) made exactly perpendicular to a unit normal (3,)."""
    return normalize(direction - (direction @ normal) * normal)


@dataclass(frozen=True, eq=False)
class _PlaneChart:
    """Chart of a flat face: a rectangle in its plane.

    Attributes:
        center: origin (3,) of coordinates in the plane.
        x_axis, y_axis: unit vectors (3,).
        lower: lower left corner of the rectangle (2,).
        extent: width and height of the rectangle (2,).
    """

    center: Array
    x_axis: Array
    y_axis: Array
    lower: Array
    extent: Array

    def compute_points(self, u: Array, v: Array) -> Array:
        """Return the points (N, 3) at chart coordinates (N,)."""
        return np.asarray(
            self.center
            + (u * self.extent[0] + self.lower[0])[:, None] * self.x_axis
            + (v * self.extent[1] + self.lower[1])[:, None] * self.y_axis
        )


def make_rounded_box(
    tag: str,
    center: Sequence[float],
    size: Sequence[float],
    bevel: float,
    steps: int = 2,
    cells: int = 1,
) -> list[Patch]:
    """Create a box with rounded edges and smooth normals, with a chart for each face.

    Args:
        tag: tag of the paint.
        center: center of the box.
        size: extent along x, y and z.
        bevel: radius of the edges.
        steps: number of cells across half of an edge's rounding; the other half belongs
            to the next face.
        cells: number of cells across the flat part of a face, along each of its axes.
    """
    half = np.asarray(size, dtype=np.float64) / 2
    # With 0.95 a small flat part is left between the edges.
    bevel = min(bevel, 0.95 * float(half.min()))
    flat = half - bevel  # half the size of the flat parts
    coordinates = [
        _edge_coordinates(float(half_length), bevel, steps, cells)
        for half_length in flat
    ]
    box = _RoundedBox(np.asarray(center, dtype=np.float64), half, bevel, coordinates)
    return [
        box.make_face(tag, axis, side) for axis, side in product(range(3), (1.0, -1.0))
    ]


@dataclass(frozen=True, eq=False)
class _RoundedBox:
    """A box with rounded edges.

    Attributes:
        center: its center (3,).
        half: half its size (3,).
        bevel: radius of its edges.
        coordinates: coordinates of the grid of its faces along each axis, relative to
            the center.
    """

    center: Array
    half: Array
    bevel: float
    coordinates: Sequence[Array]

    def make_face(self, tag: str, axis: int, side: float) -> Patch:
        """Create a face.

        Args:
            tag: tag of the paint.
            axis: axis that the face is perpendicular to: 0, 1 or 2.
            side: 1 for the upper face, -1 for the lower one.
        """
        # the two axes of the face: columns follow i (chart coordinate u), rows j (v)
        i = (axis + 1) % 3
        j = (axis + 2) % 3
        normals, points = self._compute_face(axis, side)
        across = self._to_chart(i)
        if side < 0:
            # The columns of a lower face have the reverse order. Its u is counted from
            # the other side, so that it increases, too.
            across = 1.0 - across[::-1]
        return make_grid_patch(
            tag,
            points + self.center,
            normals,
            size=(2 * float(self.half[i]), 2 * float(self.half[j])),
            down=self._to_chart(j),
            across=across,
        )

    def _to_chart(self, axis: int) -> Array:
        """Return the coordinates along an axis in [0, 1] instead of [-half, half]."""
        half = self.half[axis]
        return np.asarray((self.coordinates[axis] + half) / (2 * half))

    def _compute_face(self, axis: int, side: float) -> tuple[Array, Array]:
        """Return normals and points (V, U, 3) of a face, around the center of the box.

        The core is the box made smaller by the bevel on each side. Each point is at the
        distance `bevel` from the core, between a point on the face of the sharp box and
        the nearest point of the core.

        Args:
            axis: axis that the face is perpendicular to: 0, 1 or 2.
            side: 1 for the upper face, -1 for the lower one.
        """
        core = self.half - self.bevel
        sharp_points = self._compute_sharp_face(axis)
        core_points = np.clip(sharp_points, -core, core)
        normals = normalize(sharp_points - core_points)
        points = core_points + self.bevel * normals
        if side < 0:
            # The upper face, rotated by 180 degrees about the axis of v, is the lower
            # one. A rotation, unlike a mirroring, leaves its front outside.
            points = points[:, ::-1].copy()
            normals = normals[:, ::-1].copy()
            points[..., axis] *= -1.0
            normals[..., axis] *= -1.0
        return normals, points

    def _compute_sharp_face(self, axis: int) -> Array:
        """Return the points (V, U, 3) of the upper face of the box without rounding."""
        i = (axis + 1) % 3
        j = (axis + 2) % 3
        u = self.coordinates[i]
        v = self.coordinates[j]
        points = np.empty((len(v), len(u), 3))
        points[..., axis] = self.half[axis]
        points[..., i] = u[None]
        points[..., j] = v[:, None]
        return points


def _edge_coordinates(flat: float, bevel: float, steps: int, cells: int) -> Array:
    """Return ascending coordinates along an axis of a box's face, around its middle.

    The cells of the rounded edges at both ends have equal angles. The rounding ends at
    45 degrees, where the next face begins.

    Args:
        flat: half the length of the flat part.
        bevel: radius of the edges.
        steps: number of cells across half of an edge's rounding.
        cells: number of cells across the flat part.
    """
    angle = np.linspace(0.0, np.pi / 4, steps + 1)
    edge = flat + bevel * np.tan(angle)
    upper_edge = edge[1:]  # without its start, which is the end of the flat part
    lower_edge = -upper_edge[::-1]
    flat_part = np.linspace(-flat, flat, cells + 1)
    return np.concatenate([lower_edge, flat_part, upper_edge])


# ---- cutting
# ----------------------------------------------------------------------------------
# Cutting patches along curves. What is carved out of a smooth surface becomes a part of
# its own.
#
# A curve is where a function of the surface's points, a field, is zero. Triangles that
# it crosses are split there, so that the cut is as smooth as the field and not as coarse
# as the grid.


Field = Callable[[Array], Array]
"""Maps points (N, 3) to values (N,): approximate distances to the cut, positive inside.
"""
SNAP = 0.1
"""Fraction of an edge's length within which a cut is moved to the edge's end.

That avoids thin triangles.
"""


def carve_patches(
    patches: Iterable[Patch], inside: Field, tag: str | None
) -> list[Patch]:
    """Cut patches along the curves where a field is 0, and change the tag of the inside.

    Args:
        patches: smooth patches that are not transformed yet.
        inside: function of points (V, 3) that returns values (V,), which are positive
            inside the region to cut out. For example, a window in a car.
        tag: tag of the inside; None removes the inside.
    """
    carved_patches = []
    for patch in patches:
        value = _snap_to_vertices(patch, np.array(inside(patch.vertices)))
        has_inside = value.max() > 0.0
        if has_inside:
            carved_patches += _cut_patch(patch, value, tag)
        else:
            carved_patches.append(patch)
    return carved_patches


def _cut_patch(patch: Patch, value: Array, tag: str | None) -> list[Patch]:
    """Cut a patch into what is outside and what is inside; parts without faces are none.

    Args:
        patch: the patch.
        value: values at its vertices (V,), positive inside.
        tag: tag of the inside; None removes the inside.
    """
    cut, is_inside = _split(patch, value)
    parts = []
    for faces, part_tag in (
        (cut.faces[~is_inside], patch.tag),
        (cut.faces[is_inside], tag),
    ):
        if len(faces) and part_tag is not None:
            parts.append(crop_chart(replace(cut, faces=faces, tag=part_tag)))
    return parts


def _snap_to_vertices(patch: Patch, value: Array) -> Array:
    """Set the value of a vertex to 0 if a cut is very near to it (`SNAP`).

    The cut then goes through that vertex, which avoids a thin triangle.

    Args:
        patch: the patch that is cut.
        value: value of the field at its vertices (V,), which is changed and returned.
    """
    edges = _edges(patch)
    crossed_edges = edges[_are_crossed(edges, value)]  # (E, 2)
    # how far the cut is from each end of an edge, as a fraction of the edge
    distance = np.abs(value[crossed_edges])
    fraction = distance / distance.sum(axis=1, keepdims=True)
    near_vertices = crossed_edges[fraction < SNAP]
    value[near_vertices] = 0.0
    return value


def crop_chart(patch: Patch) -> Patch:
    """Return the patch with its chart cropped to the part that its faces use.

    The coordinates of that part are stretched to [0, 1] again. The size of the chart
    shrinks to that of the part.
    """
    used_uvs = patch.uvs[np.unique(patch.faces)]
    lower = used_uvs.min(axis=0)
    extent = np.ptp(used_uvs, axis=0)
    width, height = patch.size
    return replace(
        patch,
        uvs=np.clip((patch.uvs - lower) / extent, 0.0, 1.0),
        size=(width * float(extent[0]), height * float(extent[1])),
        compute_rest_points=partial(_compute_cropped_points, patch, lower, extent),
    )


def _compute_cropped_points(
    patch: Patch, lower: Array, extent: Array, u: Array, v: Array
) -> Array:
    """Return the points (N, 3) at coordinates (N,) of a part of a patch's chart.

    Args:
        patch: patch with the full chart.
        lower: lower left corner (2,) of the part, in chart coordinates.
        extent: width and height (2,) of the part, in chart coordinates.
        u, v: coordinates in the part, in [0, 1].
    """
    return patch.compute_rest_points(lower[0] + u * extent[0], lower[1] + v * extent[1])


def _edges(patch: Patch) -> assets.IntArray:
    """Return the unique edges (E, 2) of a patch as sorted vertex indices."""
    pairs = np.concatenate(
        [patch.faces[:, [0, 1]], patch.faces[:, [1, 2]], patch.faces[:, [2, 0]]]
    )
    return np.asarray(np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int64))


def _are_crossed(edges: assets.IntArray, value: Array) -> assets.BoolArray:
    """Return whether the values (V,) at both ends of each edge differ in sign (E,)."""
    is_crossed: assets.BoolArray = value[edges[:, 0]] * value[edges[:, 1]] < 0.0
    return is_crossed


@dataclass(frozen=True, eq=False)
class _EdgeCuts:
    """New vertices where edges of a patch are cut.

    Attributes:
        first, second: indices of the ends of each edge (E,).
        fraction: where the cut is, as a fraction of the edge from its first end (E, 1).
    """

    first: assets.IntArray
    second: assets.IntArray
    fraction: Array

    @classmethod
    def at_zero(cls, edges: assets.IntArray, value: Array) -> _EdgeCuts:
        """Cut edges (E, 2) where the value is 0, which has different signs at both ends.

        Args:
            edges: indices of vertices.
            value: value of each vertex (V,).
        """
        first, second = edges.T
        # value(first) + fraction * (value(second) - value(first)) = 0
        fraction = (value[first] / (value[first] - value[second]))[:, None]
        return cls(first, second, fraction)

    def add_to(self, attribute: Array) -> Array:
        """Return an attribute (V, k) of the vertices, then of the cuts."""
        difference = attribute[self.second] - attribute[self.first]
        cut_attribute = attribute[self.first] + self.fraction * difference
        return np.concatenate([attribute, cut_attribute])


def _split(patch: Patch, value: Array) -> tuple[Patch, assets.BoolArray]:
    """Split the triangles of a patch where the values (V,) of its vertices change sign.

    Each edge whose ends have different signs gets one new vertex, where the value is 0.

    Returns:
        The patch with new vertices and faces, and whether each face is inside (F,),
        that is where the values are positive.
    """
    edges = _edges(patch)
    crossed_edges = edges[_are_crossed(edges, value)]
    cuts = _EdgeCuts.at_zero(crossed_edges, value)
    normals = cuts.add_to(patch.normals)
    # Interpolated normals are shorter than 1. They are normalized in place.
    cut_normals = normals[len(patch.normals) :]
    cut_normals /= np.linalg.norm(cut_normals, axis=1, keepdims=True)
    cut_of_edge = _number_cuts(crossed_edges, first=len(patch.vertices))
    faces, is_inside = _split_faces(patch, value, cut_of_edge)
    split_patch = replace(
        patch,
        vertices=cuts.add_to(patch.vertices),
        normals=normals,
        uvs=cuts.add_to(patch.uvs),
        faces=np.array(faces),
    )
    return split_patch, np.array(is_inside)


def _number_cuts(
    crossed_edges: assets.IntArray, first: int
) -> dict[tuple[int, int], int]:
    """Return the index of the new vertex of each edge, by the indices of its ends.

    Args:
        crossed_edges: (E, 2) ends of the edges that are cut.
        first: index of the first new vertex.
    """
    return {
        (int(start), int(end)): first + index
        for index, (start, end) in enumerate(crossed_edges)
    }


def _split_faces(
    patch: Patch, value: Array, cut_of_edge: dict[tuple[int, int], int]
) -> tuple[list[tuple[int, int, int]], list[bool]]:
    """Split the faces that change sign; return all faces, and whether each is inside.

    Args:
        patch: before its new vertices are added.
        value: value of its vertices (V,), positive inside.
        cut_of_edge: index of the new vertex of each edge that is cut, by the indices of
            its ends, the smaller one first.
    """
    faces: list[tuple[int, int, int]] = []
    is_inside: list[bool] = []
    for face in patch.faces:
        face_values = value[face]
        is_uncut = face_values.min() >= 0.0 or face_values.max() <= 0.0
        if is_uncut:
            faces += _divide_polygon(face.tolist())  # the triangle itself
            is_inside.append(bool(face_values.sum() > 0.0))
            continue
        outline = _outline_with_cuts(face, value, cut_of_edge)
        inside_triangles, outside_triangles = _divide_outline(outline)
        faces += [*inside_triangles, *outside_triangles]
        is_inside += [True] * len(inside_triangles) + [False] * len(outside_triangles)
    return faces, is_inside


def _divide_outline(
    outline: Sequence[tuple[int, float]],
) -> tuple[list[tuple[int, int, int]], list[tuple[int, int, int]]]:
    """Divide a triangle with cuts into triangles inside and outside.

    Vertices with the value 0, such as the cuts, belong to both parts.

    Args:
        outline: index and value of each vertex around the triangle.
    """
    inside_part = [vertex for vertex, at_vertex in outline if at_vertex >= 0.0]
    outside_part = [vertex for vertex, at_vertex in outline if at_vertex <= 0.0]
    return _divide_polygon(inside_part), _divide_polygon(outside_part)


def _divide_polygon(corners: Sequence[int]) -> list[tuple[int, int, int]]:
    """Divide a convex polygon into triangles that share its first corner."""
    first_corner = corners[0]
    return [(first_corner, second, third) for second, third in pairwise(corners[1:])]


def _outline_with_cuts(
    face: assets.IntArray, value: Array, cut_of_edge: Mapping[tuple[int, int], int]
) -> list[tuple[int, float]]:
    """Return the vertices around a triangle, with the cuts of its edges between them.

    An entry has the index of the vertex and its value, which is 0 at a cut.

    Args:
        face: indices of the triangle's vertices (3,).
        value: value of each vertex (V,).
        cut_of_edge: index of the vertex that cuts an edge, by the indices of the edge's
            ends, the smaller one first.
    """
    outline: list[tuple[int, float]] = []
    for i in range(3):
        start = int(face[i])
        end = int(face[(i + 1) % 3])
        outline.append((start, float(value[start])))
        cut = cut_of_edge.get((min(start, end), max(start, end)))
        if cut is not None:
            outline.append((cut, 0.0))
    return outline
