"""A car: a hatchback with five doors. Units are metres; it drives towards +x.

Body and cabin are stacks of outlines: superellipses seen from above, each with its own
length and width, at heights that follow the lines of hood, waist and roof. The waist is
the line below the windows. Windows, lights, grilles and wheel arches are carved out of
body and cabin. Numbers without an explanation are measures of the car in metres.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise, product

import numpy as np
from scipy.special import logsumexp

import advsearch.questions.harden.objects.shapes as shapes
from advsearch.extend import assets
from advsearch.questions.harden.objects.family import Instance, make_family
from advsearch.questions.harden.objects.shapes import Array, Patch
from advsearch.questions.harden.objects.textures import (
    Paint,
    ParameterSampler,
    Texels,
    blend_colors,
    compute_soft_step,
    paint_solid_color,
    painter,
    parse_hex_color,
)

AXLES = (1.29, -1.33)  # x of the front and the rear axle
WHEEL = 0.33  # radius of a wheel, and the height of its axle
TYRE = 0.215  # width of a tyre
RIM = 0.212  # radius of a rim
ARCH = 0.385  # radius of a wheel arch
WHEEL_POSITIONS = tuple(product(AXLES, (1.0, -1.0)))  # (x of the axle, sign of y)
WHEEL_SIDE = 0.852  # distance of a wheel's outer side from the middle of the car
CABIN_X = -0.5  # x of the middle of the cabin
COLUMNS = 92  # faces around the body
OUTSIDE = -1.0
"""Depth inside an opening of points at another end or side of the car: they are outside.
"""
FAR = 9.0
"""Distance in metres that stands for "not on this side of the car"."""
Height = Callable[[Array, Array, Array], Array]
"""Returns z from the fraction of the height, x and y, all (N,)."""


def _outline(
    angle: Array,
    front: float,
    rear: float,
    half_width: float,
    power: float,
    center_x: float,
) -> tuple[Array, Array]:
    """Return x and y, each (N,), of points of a superellipse.

    That is an oval between an ellipse (power 2) and a rectangle (a large power). Its
    front and rear half may differ in length.

    Args:
        angle: parameters of the points (N,), from -pi to pi; 0 is the front end.
        front, rear: x of its front and its rear end.
        half_width: its extent along y and -y.
        power: power of the superellipse.
        center_x: x of its center.
    """
    cosine = np.cos(angle)
    sine = np.sin(angle)
    # Points with a positive cosine are on the front half.
    half_length = np.where(cosine >= 0.0, front - center_x, center_x - rear)
    # x = a |cos|^(2/power) fulfils |x/a|^power + |y/b|^power = 1 with y likewise
    exponent = 2 / power
    x = center_x + half_length * np.sign(cosine) * np.abs(cosine) ** exponent
    y = half_width * np.sign(sine) * np.abs(sine) ** exponent
    return x, y


def _shell(
    levels: Array, power: float, center_x: float, height: Height, corner: float
) -> list[Patch]:
    """Create the painted patches of a shell that follows a stack of superellipses.

    The shell is cut into five charts, so that each is nearly flat and its texture is
    hardly distorted.

    Args:
        levels: (R, 4), a row for each superellipse: its fraction of the height, half
            its width, and x of its front and its rear end.
        power: power of the superellipses.
        center_x: x of their center.
        height: returns z from fractions of the height, x and y.
        corner: where charts are cut: at this fraction of all columns to both sides of
            the middle of the front and of the rear.
    """
    angle = _outline_angles(levels, power, center_x)
    points = _shell_points(levels, power, center_x, height, angle)
    normals = _shell_normals(points)
    # The columns go around the shell, from the middle of the rear to the same again.
    front = COLUMNS // 2  # the middle of the front
    cut = int(COLUMNS * corner)
    # one half of the rear, a side, the front, the other side, the other half of the rear
    chart_bounds = (0, cut, front - cut, front + cut, COLUMNS - cut, COLUMNS)
    patches = []
    for first, last in pairwise(chart_bounds):
        columns = np.s_[:, first : last + 1]
        patches.append(_make_shell_patch(points[columns], normals[columns]))
    return patches


def _make_shell_patch(points: Array, normals: Array) -> Patch:
    """Create the painted patch of some columns of a shell.

    Args:
        points: (R, C, 3), from bottom to top and from column to column.
        normals: (R, C, 3).
    """
    length_to_column = shapes.mean_lengths(points, axis=1)
    length_to_row = shapes.mean_lengths(points, axis=0)
    width = float(length_to_column[-1])
    height = float(length_to_row[-1])
    return shapes.make_grid_patch(
        "paint",
        points,
        normals,
        size=(width, height),
        down=length_to_row / height,
        across=length_to_column / width,
    )


def _outline_angles(levels: Array, power: float, center_x: float) -> Array:
    """Return angles (C,) of columns that are evenly spaced along the widest outline.

    C is `COLUMNS` + 1: the first and the last column are the middle of the rear.

    Args:
        levels: (R, 4), a row for each outline: fraction of the height, half the width,
            x of the front and of the rear end.
        power: power of the superellipses.
        center_x: x of their center.
    """
    widest = levels[np.argmax(levels[:, 1])]
    _, half_width, front, rear = widest
    # -pi and pi are the middle of the rear. The outline is moved so that its center is at
    # x = 0, which does not change lengths along it.
    fine_angle = np.linspace(-np.pi, np.pi, 8001)
    x, y = _outline(
        fine_angle,
        front=front - center_x,
        rear=rear - center_x,
        half_width=half_width,
        power=power,
        center_x=0.0,
    )
    arc_length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    # the angles at which the length along the outline is a multiple of the spacing
    column_length = np.linspace(0.0, arc_length[-1], COLUMNS + 1)
    return np.interp(column_length, arc_length, fine_angle)


def _shell_points(
    levels: Array, power: float, center_x: float, height: Height, angle: Array
) -> Array:
    """Return the points (R, C, 3) of a stack of R superellipses.

    Each outline has the same angles, so that columns run from bottom to top.

    Args:
        levels: (R, 4), a row for each outline: fraction of the height, half the width,
            x of the front and of the rear end.
        power: power of the superellipses.
        center_x: x of their center.
        height: function that returns z from the fraction of the height, x and y.
        angle: angles of the columns (C,).
    """
    points = np.empty((len(levels), COLUMNS + 1, 3))
    for index, (height_fraction, half_width, front, rear) in enumerate(levels):
        x, y = _outline(angle, front, rear, half_width, power, center_x)
        points[index, :, 0] = x
        points[index, :, 1] = y
        points[index, :, 2] = height(np.full_like(x, height_fraction), x, y)
    return points


def _shell_normals(points: Array) -> Array:
    """Return the unit normals (R, C, 3) of a closed shell with points (R, C, 3).

    The first and the last column are the same points. So each gets a neighbor from the
    other end of the columns, and both have the same normals.
    """
    before_first = points[:, -2:-1]
    after_last = points[:, 1:2]
    wrapped_points = np.concatenate([before_first, points, after_last], axis=1)
    wrapped_tangent = np.gradient(wrapped_points, axis=1)
    around = wrapped_tangent[:, 1:-1]  # without the two added columns
    upwards = np.gradient(points, axis=0)
    return shapes.normalize(np.cross(around, upwards))


def _make_height_curve(knots: list[tuple[float, float]]) -> Callable[[Array], Array]:
    """Return the function from x to z of a spline through knots (x, z), x ascending."""
    curve = shapes.sample_spline(knots, count=200)
    return lambda x: np.interp(x, curve[:, 0], curve[:, 1])


def _soft_minimum(*fields: Array) -> Array:
    """Return the minimum of several distances (N,), with corners rounded by about 3 cm.

    If each distance is that to one edge of an opening, positive inside, the minimum is
    positive inside of all edges. It is the smooth minimum -log(sum(exp(-30 d))) / 30,
    and distances are clipped to 1 m.
    """
    sharpness = 30.0  # per metre
    distances = np.clip(np.stack(fields), -1.0, 1.0)
    return np.asarray(logsumexp(-sharpness * distances, axis=0) / -sharpness)


# Functions from x to the height of the body's lower edge, of the lower edge of the
# windows (the waist), and of the roof.
_bottom_z = _make_height_curve(
    [(-2.2, 0.30), (-1.7, 0.20), (0.0, 0.175), (1.7, 0.185), (2.2, 0.235)]
)
_waist_z = _make_height_curve(
    [
        (-2.2, 1.0),
        (-1.9, 0.995),
        (-1.2, 0.975),
        (-0.4, 0.945),
        (0.4, 0.925),
        (0.95, 0.9),
        (1.4, 0.845),
        (1.75, 0.775),
        (2.0, 0.7),
        (2.2, 0.62),
    ]
)
_roof_z = _make_height_curve(
    [
        (-2.2, 1.26),
        (-1.75, 1.345),
        (-1.3, 1.405),
        (-0.7, 1.435),
        (-0.2, 1.43),
        (0.2, 1.395),
        (1.1, 1.2),
    ]
)
_BODY = [  # fraction of the height, half the width, front end, rear end
    (0.0, 0.80, 1.98, -2.0),
    (0.03, 0.835, 2.06, -2.06),
    (0.1, 0.86, 2.1, -2.1),
    (0.28, 0.872, 2.135, -2.135),
    (0.45, 0.878, 2.14, -2.14),
    (0.62, 0.889, 2.13, -2.125),
    (0.75, 0.898, 2.1, -2.1),
    (0.82, 0.885, 2.06, -2.085),
    (0.9, 0.868, 2.01, -2.065),
    (0.96, 0.845, 1.95, -2.04),
    (0.985, 0.82, 1.89, -2.01),
    (1.0, 0.78, 1.79, -1.965),
]
_CABIN = [  # the same of the cabin
    (0.0, 0.795, 1.0, -1.955),
    (0.25, 0.765, 0.79, -1.9),
    (0.5, 0.732, 0.57, -1.83),
    (0.75, 0.692, 0.34, -1.74),
    (0.88, 0.663, 0.2, -1.66),
    (0.95, 0.63, 0.08, -1.58),
    (0.985, 0.58, -0.06, -1.47),
    (1.0, 0.5, -0.22, -1.3),
]
_BODY_POWER = 4.2  # powers of the superellipses
_CABIN_POWER = 4.6


def _deck(x: Array, y: Array) -> Array:
    """Return the height of the top of the body, a little higher in the middle."""
    return np.asarray(_waist_z(x) + 0.045 * (1.0 - (y / 0.8) ** 2))


def _body_height(height_fraction: Array, x: Array, y: Array) -> Array:
    """Return z at a fraction of the height between the body's bottom and its top."""
    bottom = _bottom_z(x)
    return np.asarray(bottom + height_fraction * (_deck(x, y) - bottom))


def _cabin_height(height_fraction: Array, x: Array, y: Array) -> Array:
    """Return z at a fraction of the height between the deck and the curved roof."""
    bottom = _deck(x, y) - 0.03  # inside the body, so that no gap shows
    roof = _roof_z(x) + 0.035 * (1.0 - (y / 0.6) ** 2)
    return np.asarray(bottom + height_fraction * (roof - bottom))


def _compute_depths_inside(points: Array) -> dict[str, Array]:
    """Return how far points (N, 3) lie inside each opening, by its name in `OPENINGS`.

    The values (N,) are approximate distances to the edge in metres, below 0 outside.
    """
    x, y, z = points.T
    abs_y = np.abs(y)
    # the height of the dark lower edge (the valance), which is larger at the rear
    valance_height = np.where(x < -1.6, 0.13, 0.075)
    return {
        "cabin": 0.72 * (1.0 - _cabin_radius(x, y)),
        "front arch": _inside_arch(AXLES[0], abs_y, x, z),
        "rear arch": _inside_arch(AXLES[1], abs_y, x, z),
        **_inside_lights(abs_y, x, z),
        **_inside_grilles(abs_y, x, z),
        "valance": _bottom_z(x) + valance_height - z,
        **_inside_windows(abs_y, x, z),
    }


def _inside_lights(abs_y: Array, x: Array, z: Array) -> dict[str, Array]:
    """Return how far points lie inside the headlights and the taillights.

    Args:
        abs_y, x, z: coordinates of the points (N,); y without its sign.
    """
    headlight = _inside_headlight(abs_y, x, z)
    taillight = _soft_minimum(abs_y - 0.40, -1.80 - x, z - 0.785, 0.955 - z)
    return {
        "headlight": np.where(x > 1.2, headlight, OUTSIDE),
        "taillight": np.where(x < -1.0, taillight, OUTSIDE),
    }


def _inside_grilles(abs_y: Array, x: Array, z: Array) -> dict[str, Array]:
    """Return how far points lie inside the two grilles, below 0 outside.

    Their lower and upper edges are slanted.

    Args:
        abs_y, x, z: coordinates of the points (N,); y without its sign, as a car is
            symmetric.
    """
    # The smallest of the distances to the side, to the lower and to the upper edge.
    low_grille = _soft_minimum(
        0.62 - abs_y, z - 0.24 + 0.02 * abs_y, 0.37 - 0.02 * abs_y - z
    )
    high_grille = _soft_minimum(
        0.41 - abs_y, z - 0.5 - 0.04 * abs_y, 0.64 + 0.04 * abs_y - z
    )
    is_front = x > 1.5
    return {
        "low grille": np.where(is_front, low_grille, OUTSIDE),
        "high grille": np.where(is_front, high_grille, OUTSIDE),
    }


def _inside_windows(abs_y: Array, x: Array, z: Array) -> dict[str, Array]:
    """Return how far points lie inside the windows of the cabin.

    Args:
        abs_y, x, z: coordinates of the points (N,); y without its sign, as a car is
            symmetric.
    """
    # approximately half the cabin's width at each height
    half_width = np.interp(z, [0.93, 1.15, 1.36], [0.795, 0.735, 0.668])

    # Each argument of `_soft_minimum` is the distance to one edge, positive inside.
    windscreen = _soft_minimum(0.85 * half_width - abs_y, 1.36 - z)
    rear_window = _soft_minimum(0.86 * half_width - abs_y, z - 1.045, 1.325 - z)
    side_windows = _inside_side_windows(x, z)

    is_front = x > 0.0
    is_rear = x < -1.5
    is_side = abs_y > 0.45
    return {
        "windscreen": np.where(is_front, windscreen, OUTSIDE),
        "rear window": np.where(is_rear, rear_window, OUTSIDE),
        "side windows": np.where(is_side, side_windows, OUTSIDE),
    }


def _inside_side_windows(x: Array, z: Array) -> Array:
    """Return how far points lie inside the outline of the side windows.

    They lie between two heights and two slanted pillars. Arguments and result are (N,).
    """
    lower_edge = _waist_z(x) + 0.04
    upper_edge = lower_edge + 0.83 * (_roof_z(x) - lower_edge)
    # The pillars are lines in the x-z plane, through (0.6, 0.93) and (-1.62, 0.98). The
    # distance of a point is its product with the normal, which points to the windows:
    # (-0.58, -0.81) and (0.72, -0.69).
    behind_front_pillar = (0.60 - x) * 0.58 - (z - 0.93) * 0.81
    before_rear_pillar = (x + 1.62) * 0.72 - (z - 0.98) * 0.69
    return _soft_minimum(
        behind_front_pillar, before_rear_pillar, z - lower_edge, upper_edge - z
    )


def _inside_headlight(abs_y: Array, x: Array, z: Array) -> Array:
    """Return how far points lie inside the outline of the headlights.

    Arguments and result are (N,); `abs_y` is the distance from the middle of the car.
    """
    from_inner_edge = abs_y - 0.42
    lower_edge = 0.565 + 0.1 * from_inner_edge
    upper_edge = 0.665 + 0.2 * from_inner_edge
    return _soft_minimum(from_inner_edge, x - 1.66, z - lower_edge, upper_edge - z)


def _cabin_radius(x: Array, y: Array) -> Array:
    """Return the radius (N,) of points in the superellipse of the cabin, 1 at its edge.

    It is seen from above, and reaches from x = -1.86 to 0.9, and to 0.72 on both sides;
    x and y are (N,).
    """
    half_length = np.where(x >= CABIN_X, 0.9 - CABIN_X, CABIN_X + 1.86)
    relative_x = np.abs((x - CABIN_X) / half_length)
    relative_y = np.abs(y / 0.72)
    return (relative_x**_CABIN_POWER + relative_y**_CABIN_POWER) ** (1 / _CABIN_POWER)


def _inside_arch(axle: float, abs_y: Array, x: Array, z: Array) -> Array:
    """Return how far points lie inside the two wheel arches of an axle.

    Arguments and result are (N,); `axle` is its x, and `abs_y` the distance from the
    middle of the car.
    """
    return np.where(abs_y > 0.4, ARCH - np.hypot(x - axle, z - WHEEL), OUTSIDE)


OPENINGS: dict[str, dict[str, str | None]] = {
    "body": {
        "cabin": None,
        "front arch": None,
        "rear arch": None,
        "headlight": "headlight",
        "taillight": "taillight",
        "low grille": "trim",
        "high grille": "trim",
        "valance": "trim",
    },
    "cabin": dict.fromkeys(("windscreen", "rear window", "side windows"), "glass"),
}
"""Openings of the body and of the cabin, with the tags that they get.

An opening without a tag (None) is removed.
"""


def _make_opening_field(name: str) -> shapes.Field:
    """Return the field of an opening, positive inside it."""
    return lambda points: _compute_depths_inside(points)[name]


def _body_and_cabin() -> list[Patch]:
    """Create the body and the cabin with their openings."""
    body = _carve_openings(_body_shell(), OPENINGS["body"])
    cabin = _carve_openings(_cabin_shell(), OPENINGS["cabin"])
    return body + cabin


def _body_shell() -> list[Patch]:
    """Create the body without openings.

    At its top is the last outline, scaled about the center, at the full height. It keeps
    a hole, which is under the cabin.
    """
    _, half_width, front, rear = _BODY[-1]
    deck = [
        (1.0, scale * half_width, scale * front, scale * rear)
        for scale in (0.92, 0.81, 0.69, 0.56, 0.43)
    ]
    levels = np.array([*shapes.sample_spline(_BODY, count=23), *deck])
    return _shell(levels, _BODY_POWER, center_x=0.0, height=_body_height, corner=0.085)


def _cabin_shell() -> list[Patch]:
    """Create the cabin without openings; its roof is the last outline made smaller."""
    # The last outline of the cabin reaches from 0.28 m before its middle to 0.8 m behind.
    roof = [
        (1.0, scale * 0.5, CABIN_X + scale * 0.28, CABIN_X - scale * 0.8)
        for scale in (0.75, 0.45, 0.15, 0.002)
    ]
    levels = np.array([*shapes.sample_spline(_CABIN, count=16), *roof])
    return _shell(
        levels, _CABIN_POWER, center_x=CABIN_X, height=_cabin_height, corner=0.1
    )


def _carve_openings(
    shell: list[Patch], tag_of_opening: Mapping[str, str | None]
) -> list[Patch]:
    """Carve openings out of a shell; see `OPENINGS`."""
    for opening, tag in tag_of_opening.items():
        shell = shapes.carve_patches(shell, _make_opening_field(opening), tag)
    return shell


def _wheels() -> list[Patch]:
    """Create the four wheels: one wheel, copied to its positions."""
    wheel = _wheel()
    patches = []
    for axle_x, side in WHEEL_POSITIONS:
        # First the wheel's outer side is turned from +z to the side of the car. Then the
        # wheel rolls about its axis, by different angles at both axles, so that spokes
        # differ.
        turn_outwards = shapes.make_rotation_matrix("x", -90.0 * side)
        roll_degrees = 17.0 * axle_x
        roll = shapes.make_rotation_matrix("y", roll_degrees)
        center = (axle_x, side * (WHEEL_SIDE - TYRE / 2), WHEEL)
        patches += shapes.transform_patches(wheel, roll @ turn_outwards, center)
    return patches


def _wheel() -> list[Patch]:
    """Create a wheel around the z axis, its outer side up: tyre, rim, spokes and hub."""
    outer_z = TYRE / 2  # z of the outer side; 0 is the middle of the tyre
    disc_z = outer_z - 0.06  # z of the dark disc behind the spokes
    # profiles of points (r, z)
    rim_edge = [
        (RIM, outer_z - 0.008),
        (RIM - 0.014, outer_z - 0.012),
        (RIM - 0.02, disc_z),
    ]
    dark_disc = [(RIM - 0.02, disc_z), (0.0, disc_z)]
    return [
        *shapes.revolve_profile([("rubber", _tyre_profile(RIM, outer_z))], columns=28),
        *shapes.revolve_profile([("rim", rim_edge)], columns=28),
        *shapes.revolve_profile([("well", dark_disc)], columns=24),
        *_spokes(outer_z),
        *_hub(outer_z, disc_z),
    ]


def _hub(outer_z: float, disc_z: float) -> list[Patch]:
    """Create the rounded hub of a wheel.

    Args:
        outer_z: z of the outer side of the wheel.
        disc_z: z of the disc that the hub stands on.
    """
    corners = [
        (0.052, disc_z),
        (0.05, outer_z - 0.02),
        (0.03, outer_z - 0.01),
        (0.0, outer_z - 0.008),
    ]
    profile = shapes.round_corners(corners, radius=0.008, steps=2)
    return shapes.revolve_profile([("rim", profile)], columns=20)


def _spokes(outer_z: float) -> list[Patch]:
    """Create the five forked spokes of a wheel, each of two bars that move apart.

    Args:
        outer_z: z of the outer side of the wheel.
    """
    section = shapes.rectangle(0.03, 0.03, bevel=0.008, steps=1)
    patches = []
    for number, side in product(range(5), (-1.0, 1.0)):
        # the path of a bar from the hub along +x to the rim
        bar = [
            (0.03, side * 0.012, outer_z - 0.035),
            (0.11, side * 0.018, outer_z - 0.022),
            (RIM - 0.012, side * 0.04, outer_z - 0.018),
        ]
        scale = (1.0, 1.0, 1.15)  # a little thicker at the rim
        patches += shapes.transform_patches(
            shapes.sweep_section("rim", bar, section, scale),
            shapes.make_rotation_matrix("z", 72.0 * number),
        )
    return patches


def _tyre_profile(rim: float, outer_z: float) -> list[tuple[float, float]]:
    """Return the points (r, z) of a tyre, from its inner side to its outer side.

    Args:
        rim: radius of the rim.
        outer_z: z of the outer side; the inner one is at -z.
    """
    outer_side = [
        (rim, outer_z - 0.008),
        (rim + 0.012, outer_z),
        (0.29, outer_z + 0.004),
        (WHEEL - 0.012, outer_z - 0.02),
    ]
    inner_side = [(r, -z) for r, z in outer_side]
    tread = [(WHEEL, 0.05 - outer_z), (WHEEL, 0.0), (WHEEL, outer_z - 0.05)]
    return [*inner_side, *tread, *outer_side[::-1]]


def _wells() -> list[Patch]:
    """Create the insides of the four wheel arches, and the floor of the car."""
    patches = []
    for axle_x, side in WHEEL_POSITIONS:
        patches += _well(axle_x, side)
    return [*patches, _floor()]


def _floor() -> Patch:
    """Create the flat floor of the car, which looks down."""
    # clockwise seen from above; -pi is the same point as pi
    angle = np.linspace(np.pi, -np.pi, 41)[:-1]
    x, y = _outline(
        angle,
        front=1.97,
        rear=-1.99,
        half_width=0.79,
        power=_BODY_POWER,
        center_x=0.0,
    )
    ring = np.stack([x, y, np.full_like(x, 0.2)], axis=1)
    return shapes.make_cap_face("well", ring, np.array([0.0, 0.0, -1.0]))


def _well(axle: float, side: float) -> list[Patch]:
    """Create the inside of a wheel arch: a curved wall, and a flat wall at its inner end.

    Args:
        axle: x of the axle.
        side: 1 at +y, -1 at -y.
    """
    # 240 degrees around the axle, from below it at the front over the top to the rear
    angle = np.radians(np.linspace(-30.0, 210.0, 17))
    outwards = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    arc = np.array([axle, 0.0, WHEEL]) + ARCH * outwards
    # the edges of the curved wall: in the side of the car, and at its inner end
    outer_edge = arc + np.array([0.0, side * 0.79, 0.0])
    inner_edge = arc + np.array([0.0, side * 0.56, 0.0])
    edges = np.stack([outer_edge, inner_edge])
    # The order of points decides to which side faces look. At +y both parts are
    # reversed, so that they look towards the wheel there, too.
    if side > 0:
        edges = edges[::-1]
        inner_edge = inner_edge[::-1]
    return [
        _curved_well_wall(edges, outwards),
        shapes.make_cap_face("well", inner_edge, np.array([0.0, side, 0.0])),
    ]


def _curved_well_wall(edges: Array, outwards: Array) -> Patch:
    """Create the curved wall between two arcs around an axle.

    Args:
        edges: (2, N, 3) the arcs.
        outwards: directions (N, 3) from the axle; the wall looks towards the axle.
    """
    return shapes.make_grid_patch(
        "well",
        edges,
        np.broadcast_to(-outwards, edges.shape),
        # 4.2 radians are 240 degrees; the chart may be larger than the wall is deep
        size=(ARCH * 4.2, 0.32),
        down=np.array([0.0, 1.0]),
        across=np.linspace(0.0, 1.0, len(outwards)),
    )


def _fittings() -> list[Patch]:
    """Create mirrors, plates, badges, door handles and a spoiler."""
    spoiler = shapes.make_rounded_box(
        "paint", (0, 0, 0), (0.2, 1.04, 0.035), bevel=0.015, steps=2, cells=2
    )
    return [
        *_mirrors(),
        *_plates_and_badges(),
        *_door_handles(),
        *shapes.transform_patches(
            spoiler, shapes.make_rotation_matrix("y", 9.0), (-1.60, 0.0, 1.364)
        ),
    ]


def _mirrors() -> list[Patch]:
    """Create the two mirrors."""
    return [*_mirror(1.0), *_mirror(-1.0)]


def _mirror(side: float) -> list[Patch]:
    """Create a mirror: a painted shell on a dark arm.

    Args:
        side: 1 at +y, -1 at -y.
    """
    shell = shapes.make_rounded_box(
        "paint", (0.0, 0.0, 0.0), (0.12, 0.2, 0.125), bevel=0.055, steps=3
    )
    turn = shapes.make_rotation_matrix("z", -14.0 * side)
    arm = shapes.make_rounded_box(
        "trim", (0.58, side * 0.83, 0.955), (0.06, 0.14, 0.035), bevel=0.012, steps=1
    )
    return [*shapes.transform_patches(shell, turn, (0.57, side * 0.93, 1.005)), *arm]


def _plates_and_badges() -> list[Patch]:
    """Create a licence plate and a badge at the front, and the same at the rear."""
    plate = shapes.make_rounded_box(
        "plate", (0, 0, 0), (0.014, 0.52, 0.112), bevel=0.004, steps=1
    )
    badge = shapes.revolve_profile(
        [("rim", [(0.058, -0.02), (0.058, 0.006), (0.05, 0.012), (0.0, 0.014)])],
        columns=24,
    )
    patches = []
    # Each is tilted about the y axis. A badge is made facing +z: +78 degrees turn it
    # towards the front, and -80 towards the rear.
    for fitting, degrees, position in (
        (plate, -4.0, (2.146, 0.0, 0.428)),
        (plate, 3.0, (-2.138, 0.0, 0.705)),
        (badge, 78.0, (2.118, 0.0, 0.575)),
        (badge, -80.0, (-2.075, 0.0, 0.86)),
    ):
        patches += shapes.transform_patches(
            fitting, shapes.make_rotation_matrix("y", degrees), position
        )
    return patches


def _door_handles() -> list[Patch]:
    """Create the handles of the four doors."""
    patches = []
    for side, x in product((1.0, -1.0), (0.05, -0.92)):
        patches += shapes.make_rounded_box(
            "paint", (x, side * 0.889, 0.775), (0.2, 0.032, 0.028), bevel=0.011, steps=1
        )
    return patches


_DOORS = (  # the gaps of the doors as polylines (x, z)
    [(0.86, 1.0), (0.88, 0.6), (0.84, 0.32), (0.78, 0.25), (-0.9, 0.25)],
    [(-0.26, 1.0), (-0.24, 0.6), (-0.27, 0.25)],
    [
        (-1.3, 1.1),
        (-1.22, 0.86),
        (-1.05, 0.70),
        (-0.93, 0.5),
        (-0.88, 0.32),
        (-0.9, 0.25),
    ],
)


@painter
def _lacquer(t: Texels, color: Array) -> Array:
    """Paint lacquer, with dark lines for the gaps between parts of the body.

    A soft fold runs along both sides of the hood.
    """
    x, y, z = t.xyz.T
    fold_line = [(0.95, 0.5), (1.9, 0.36)]
    fold_distance = shapes.distance_to_polylines(x, np.abs(y), fold_line)
    fold = np.clip(1.0 - fold_distance / 0.05, 0.0, 1.0)
    is_hood = (x > 0.8) & (z > 0.7)
    hood_fold = np.where(is_hood, fold, 0.0)
    shaded = blend_colors(color, 0.75 * color, 0.4 * hood_fold)
    is_gap = compute_soft_step(0.005 - _gap_distance(t), 0.0, soft=0.011)
    return blend_colors(shaded, 0.12 * color, 0.9 * is_gap)


_HOOD = [(0.9, 0.74), (1.5, 0.70), (1.84, 0.58), (1.95, 0.3), (1.97, 0.0)]
"""The gap of the hood as a polyline (x, distance from the middle of the car)."""
_TAILGATE = [(0.66, 1.2), (0.70, 0.98), (0.62, 0.66), (0.55, 0.58), (0.0, 0.57)]
"""The gap of the tailgate as a polyline (distance from the middle of the car, z)."""


def _gap_distance(t: Texels) -> Array:
    """Return the distance (N,) to the nearest gap of doors, hood, tailgate or tank lid.

    A gap counts only on its own side of the car; elsewhere it is far away.
    """
    x, y, z = t.xyz.T
    abs_y = np.abs(y)
    doors = shapes.distance_to_polylines(x, z, *_DOORS)
    hood = shapes.distance_to_polylines(x, abs_y, _HOOD)
    tailgate = shapes.distance_to_polylines(abs_y, z, _TAILGATE)
    tank_lid = np.abs(np.hypot(x + 1.52, z - 0.80) - 0.075)  # a circle
    gaps = [
        np.where((abs_y > 0.6) & (z < 1.02), doors, FAR),
        np.where((x > 0.8) & (z > 0.6), hood, FAR),
        np.where(x < -1.7, tailgate, FAR),
        np.where((y < -0.6) & (x < -1.0), tank_lid, FAR),
    ]
    return np.asarray(np.min(gaps, axis=0))


def _panes(t: Texels) -> Array:
    """Paint dark glass, with a pillar between the doors and seats in the windscreen."""
    x, y, z = t.xyz.T
    abs_y = np.abs(y)
    height_fraction = np.clip((z - 0.95) / 0.5, 0.0, 1.0)  # lighter towards the roof
    glass = blend_colors(
        parse_hex_color("20272b"), parse_hex_color("414d55"), height_fraction
    )
    pillar = compute_soft_step(0.035 - np.abs(x + 0.25), 0.0, soft=0.01)
    side_pillar = np.where(abs_y > 0.55, pillar, 0.0)
    front_seat = np.where(x > 0.0, _seat_mask(abs_y, z), 0.0)
    dark = np.maximum(side_pillar, front_seat)
    return blend_colors(glass, parse_hex_color("0b0c0d"), dark)


def _seat_mask(abs_y: Array, z: Array) -> Array:
    """Return the weight (N,) of the seats in front of a pane: backrests with headrests.

    Args:
        abs_y: distance from the middle of the car (N,).
        z: height (N,).
    """
    backrest = np.hypot((abs_y - 0.36) / 0.24, (z - 1.0) / 0.2)
    headrest = np.hypot((abs_y - 0.36) / 0.11, (z - 1.23) / 0.055)
    return compute_soft_step(1.0 - np.minimum(backrest, headrest), 0.0, soft=0.15)


def _lamps(t: Texels) -> Array:
    """Paint headlights: two bright lamps on each side, with dark rings around them."""
    _, y, z = t.xyz.T
    abs_y = np.abs(y)
    # distance from the middle of the nearer lamp
    lamp_distance = np.minimum(
        np.hypot(abs_y - 0.58, z - 0.62), np.hypot(abs_y - 0.71, z - 0.64)
    )
    lamp = compute_soft_step(0.032 - lamp_distance, 0.0, soft=0.01)
    ring = compute_soft_step(0.01 - np.abs(lamp_distance - 0.039), 0.0, soft=0.008)
    lit = blend_colors(parse_hex_color("9aa4ab"), parse_hex_color("f4f7f8"), lamp)
    return blend_colors(lit, parse_hex_color("3a4045"), ring)


def _taillights(t: Texels) -> Array:
    """Paint taillights: dark red with a bright stripe."""
    stripe = compute_soft_step(0.018 - np.abs(t.xyz[:, 2] - 0.87), 0.0, soft=0.01)
    return blend_colors(parse_hex_color("8e0d12"), parse_hex_color("d8392f"), stripe)


def _slats(t: Texels) -> Array:
    """Paint dark trim, with bright slats in the upper grille."""
    x, _, z = t.xyz.T
    is_upper_grille = (x > 1.9) & (z > 0.48)
    from_middle = np.abs((z % 0.034) - 0.017)  # slats are 3.4 cm apart
    slat = np.where(
        is_upper_grille, compute_soft_step(0.006 - from_middle, 0.0, soft=0.006), 0.0
    )
    return blend_colors(parse_hex_color("17181a"), parse_hex_color("8b9095"), slat)


@painter
def _plate(t: Texels, ground: Array) -> Array:
    """Paint a licence plate: dark strokes on a light ground, which are no real number.

    It has eight cells along y, and the fourth one is empty. Each other cell has a sign
    of two upright strokes and two bars between them.
    """
    # from -1 to 1 over the plate, which is painted before it is moved to its position
    y = t.xyz[:, 1] / 0.26
    z = t.xyz[:, 2] / 0.056
    cell = (y + 0.86) / 0.215  # 8 cells from -0.86 to 0.86
    is_within_margin = (np.abs(y) < 0.86) & (np.abs(z) < 0.62)
    is_filled = np.floor(cell) != 3
    # distance from the middle of the cell, in units of its width
    from_middle = np.abs(cell % 1.0 - 0.5)
    is_upright = np.abs(from_middle - 0.27) < 0.09
    is_bar = (from_middle < 0.3) & (np.abs(np.abs(z) - 0.5) < 0.13)
    strokes = is_within_margin & is_filled & (is_upright | is_bar)
    return blend_colors(ground, parse_hex_color("16181c"), strokes.astype(np.float64))


GLASS = assets.Material(roughness=0.04, specular=0.6)
FINISHES = {
    "paint": assets.Material(roughness=0.38, clearcoat=1.0),
    "glass": GLASS,
    "headlight": GLASS,
    "taillight": GLASS,
    "rubber": assets.Material(roughness=0.85),
    "rim": assets.Material(roughness=0.3, metallic=0.9),
    "trim": assets.Material(roughness=0.5),
    "plate": assets.Material(roughness=0.4),
    "well": assets.Material(roughness=0.95),
}


TEXEL_DENSITY = {"rubber": 0.3, "well": 0.15, "rim": 0.35, "trim": 0.7, "plate": 3.0}
"""Texels per length, relative to the paint: fewer for parts that are hardly visible, more
for the signs on the plate.
"""


# built in metres; the texture is 384 texels wide
@make_family(unit_in_metres=1.0, texels=384)
def car(sampler: ParameterSampler) -> Instance:
    """Make a car of random proportions and paint.

    Lengths are in metres. `sampler(x, low=..., high=...)` returns x for the canonical
    car and a uniform sample for a random one.
    """
    color = sampler.sample_color(
        "2a5fa8", "b3202a", "d9dadb", "2f6f4f", "e0a02c", "3a3f45", p_random=0.2
    )
    stretch = np.array(
        [
            sampler(1.0, low=0.94, high=1.07),
            sampler(1.0, low=0.96, high=1.05),
            sampler(1.0, low=0.95, high=1.1),
        ]
    )
    patches = [*_body_and_cabin(), *_wheels(), *_wells(), *_fittings()]
    return Instance(
        shapes.stretch_patches(patches, stretch),
        _sample_paints(sampler, color),
        material=FINISHES["paint"],  # the main one of `materials_by_tag`
        texel_density=TEXEL_DENSITY,
        materials_by_tag=FINISHES,
        drives=True,  # it can move along a path as a vehicle does
    )


def _sample_paints(sampler: ParameterSampler, color: Array) -> dict[str, Paint]:
    """Sample the paints of a car by the tags of its patches.

    Args:
        sampler: samples the colors of the rims and of the plates.
        color: color (3,) of the lacquer.
    """
    metal = sampler.sample_color("c4c7ca", "8d9094", "2d2f31", p_random=0.0)
    return {
        "paint": _lacquer(color),
        "glass": _panes,
        "headlight": _lamps,
        "taillight": _taillights,
        "rubber": paint_solid_color("1c1c1d"),
        "rim": paint_solid_color(metal),
        "trim": _slats,
        "plate": _plate(sampler.sample_color("f2f2ec", "f0d264", p_random=0.0)),
        "well": paint_solid_color("0a0a0b"),
    }
