"""A car: a hatchback of five doors. Units are metres; it drives towards +x.

Body and cabin are stacks of outlines: superellipses seen from above, each with its own
length and width, at heights that follow the lines of hood, waist and roof. Windows,
lights, grilles and wheel arches are carved out of them.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise, product

import numpy as np
from scipy.special import logsumexp

import advsearch.questions.harden.objects.shapes as shapes
from advsearch.extend import assets
from advsearch.questions.harden.objects.family import Instance, family
from advsearch.questions.harden.objects.shapes import Array, Patch
from advsearch.questions.harden.objects.textures import (
    Paint,
    ParameterSampler,
    Texels,
    mix,
    painter,
    parse_hex_color,
    solid,
    step,
)

AXLES = (1.29, -1.33)
WHEEL = 0.33  # radius and width
TYRE = 0.215
ARCH = 0.385
WHEELS = tuple(product(AXLES, (1.0, -1.0)))  # x of the axle, and the side
MIDDLE = -0.5  # of the cabin
COLUMNS = 92
Height = Callable[[Array, Array, Array], Array]


def _outline(
    angle: Array, front: float, rear: float, half: float, power: float, middle: float
) -> tuple[Array, Array]:
    """Return x and y, each (N,), of points of a superellipse.

    That is an oval between an ellipse (power 2) and a rectangle (a large power). Its
    front and rear half may differ in length.

    Args:
        angle: parameters of the points (N,), from -pi to pi; 0 is the front end.
        front, rear: x of its ends.
        half: its extent along y and -y.
        power: power of the superellipse.
        middle: x of its center.
    """
    cosine = np.cos(angle)
    sine = np.sin(angle)
    half_length = np.where(cosine >= 0.0, front - middle, middle - rear)
    # x = a |cos|^(2/power) fulfils |x/a|^power + |y/b|^power = 1 with y likewise
    exponent = 2 / power
    x = middle + half_length * np.sign(cosine) * np.abs(cosine) ** exponent
    y = half * np.sign(sine) * np.abs(sine) ** exponent
    return x, y


def _shell(
    rows: Array, power: float, middle: float, height: Height, corner: float
) -> list[Patch]:
    """Create the painted patches of a stack of superellipses.

    Args:
        rows: (R, 4), for each superellipse the fraction of the height, half the width,
            and x of the front and of the rear end.
        power: power of the superellipses.
        middle: x of their center.
        height: returns z from fractions of the height, x and y.
        corner: where charts are cut: at this fraction of all columns to both sides of
            the middle of the front and of the rear.
    """
    angle = _outline_angles(rows, power, middle)
    points = _shell_points(
        rows=rows, power=power, middle=middle, height=height, angle=angle
    )
    normals = _shell_normals(points)
    opposite = COLUMNS // 2  # column 0 is the middle of the rear, this of the front
    cut = int(COLUMNS * corner)
    patches = []
    for first, last in pairwise(
        (0, cut, opposite - cut, opposite + cut, COLUMNS - cut, COLUMNS)
    ):
        part_points = points[:, first : last + 1]
        u = shapes.mean_lengths(part_points, axis=1)
        v = shapes.mean_lengths(part_points, axis=0)
        patches.append(
            shapes.grid(
                "paint",
                part_points,
                normals[:, first : last + 1],
                size=(float(u[-1]), float(v[-1])),
                down=v / v[-1],
                across=u / u[-1],
            )
        )
    return patches


def _outline_angles(rows: Array, power: float, middle: float) -> Array:
    """Return the angles (C,) of columns that are equally far apart along the widest
    outline.

    C is `COLUMNS` + 1: the first and the last are the middle of the rear. The arguments
    are those of `_shell`.
    """
    _, half, front, rear = rows[np.argmax(rows[:, 1])]
    fine = np.linspace(-np.pi, np.pi, 8001)
    x, y = _outline(
        fine,
        front=front - middle,
        rear=rear - middle,
        half=half,
        power=power,
        middle=0.0,
    )
    arc_length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    return np.interp(np.linspace(0.0, arc_length[-1], COLUMNS + 1), arc_length, fine)


def _shell_points(
    rows: Array, power: float, middle: float, height: Height, angle: Array
) -> Array:
    """Return the points (R, C, 3) of a stack of superellipses, one row for each.

    `angle` (C,) has the angles of the columns; the other arguments are those of
    `_shell`.
    """
    points = np.empty((len(rows), COLUMNS + 1, 3))
    for row, (share, half, front, rear) in zip(points, rows, strict=True):
        x, y = _outline(
            angle, front=front, rear=rear, half=half, power=power, middle=middle
        )
        row[:, 0] = x
        row[:, 1] = y
        row[:, 2] = height(np.full_like(x, share), x, y)
    return points


def _shell_normals(points: Array) -> Array:
    """Return the unit normals (R, C, 3) of a closed shell with points (R, C, 3).

    The first and the last column are the same points, so differences go on across them.
    """
    wrapped_points = np.concatenate([points[:, -2:-1], points, points[:, 1:2]], axis=1)
    column_tangent = np.gradient(wrapped_points, axis=1)[:, 1:-1]
    return shapes.normalize(np.cross(column_tangent, np.gradient(points, axis=0)))


def _line(knots: list[tuple[float, float]]) -> Callable[[Array], Array]:
    """Return z as a function of x along a spline through knots (x, z), x ascending."""
    curve = shapes.spline(knots, count=200)
    return lambda x: np.interp(x, curve[:, 0], curve[:, 1])


def _softest(*fields: Array) -> Array:
    """Return the minimum of several distances (N,), with corners rounded by about 3 cm.

    It is the smooth minimum -log(sum(exp(-30 d))) / 30, of distances cut to 1 m.
    """
    return np.asarray(
        logsumexp(-30.0 * np.clip(np.stack(fields), -1.0, 1.0), axis=0) / -30.0
    )


_BOTTOM = _line([(-2.2, 0.30), (-1.7, 0.20), (0.0, 0.175), (1.7, 0.185), (2.2, 0.235)])
_WAIST = _line(
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
_ROOF = _line(
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
_BODY = [  # share of the height, half the width, front end, rear end
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
_CABIN = [
    (0.0, 0.795, 1.0, -1.955),
    (0.25, 0.765, 0.79, -1.9),
    (0.5, 0.732, 0.57, -1.83),
    (0.75, 0.692, 0.34, -1.74),
    (0.88, 0.663, 0.2, -1.66),
    (0.95, 0.63, 0.08, -1.58),
    (0.985, 0.58, -0.06, -1.47),
    (1.0, 0.5, -0.22, -1.3),
]
_BODY_POWER = 4.2
_CABIN_POWER = 4.6


def _deck(x: Array, y: Array) -> Array:
    """Return the height of the top of the body, a little higher in the middle."""
    return np.asarray(_WAIST(x) + 0.045 * (1.0 - (y / 0.8) ** 2))


def _body_height(share: Array, x: Array, y: Array) -> Array:
    """Return z at a fraction of the height between the body's bottom and its top."""
    return np.asarray(_BOTTOM(x) + share * (_deck(x, y) - _BOTTOM(x)))


def _cabin_height(share: Array, x: Array, y: Array) -> Array:
    """Return z at a fraction of the height between the deck and the curved roof."""
    low = _deck(x, y) - 0.03
    return np.asarray(low + share * (_ROOF(x) + 0.035 * (1.0 - (y / 0.6) ** 2) - low))


def _inside(p: Array) -> dict[str, Array]:
    """Return about how far points (N, 3) lie inside each opening, by its name in
    `OPENINGS`.

    The values (N,) are in metres, and below 0 outside. Where an opening is on one end
    or side of the car only, they are -1 elsewhere. Numbers are measures of the car.
    """
    x, y, z = p.T
    abs_y = np.abs(y)
    cabin_radius = _cabin_radius(x, y)
    # about half the cabin's width
    half_width = np.interp(z, [0.93, 1.15, 1.36], [0.795, 0.735, 0.668])
    sill = _WAIST(x) + 0.04
    lintel = sill + 0.83 * (_ROOF(x) - sill)
    # distances behind the slanted line of the windscreen's pillar, and before that of
    # the rear one
    pillar = (0.60 - x) * 0.58 - (z - 0.93) * 0.81
    rear = (x + 1.62) * 0.72 - (z - 0.98) * 0.69
    lens = _inside_headlight(abs_y, x, z)
    low_grille = _softest(
        0.62 - abs_y, z - 0.24 + 0.02 * abs_y, 0.37 - 0.02 * abs_y - z
    )
    high_grille = _softest(
        0.41 - abs_y, z - 0.5 - 0.04 * abs_y, 0.64 + 0.04 * abs_y - z
    )
    arches = _inside_arches(abs_y, x, z)
    return {
        "cabin": 0.72 * (1.0 - cabin_radius),
        "front arch": arches[0],
        "rear arch": arches[1],
        "headlight": np.where(x > 1.2, lens, -1.0),
        "taillight": np.where(
            x < -1.0, _softest(abs_y - 0.40, -1.80 - x, z - 0.785, 0.955 - z), -1.0
        ),
        "low grille": np.where(x > 1.5, low_grille, -1.0),
        "high grille": np.where(x > 1.5, high_grille, -1.0),
        # the dark lower edge, higher at the back
        "valance": _BOTTOM(x) + np.where(x < -1.6, 0.13, 0.075) - z,
        "windscreen": np.where(
            x > 0.0, _softest(0.85 * half_width - abs_y, 1.36 - z), -1.0
        ),
        "rear window": np.where(
            x < -1.5, _softest(0.86 * half_width - abs_y, z - 1.045, 1.325 - z), -1.0
        ),
        "side windows": np.where(
            abs_y > 0.45, _softest(pillar, rear, z - sill, lintel - z), -1.0
        ),
    }


def _inside_headlight(abs_y: Array, x: Array, z: Array) -> Array:
    """Return how far points lie inside the outline of the headlights, seen from the
    front.

    Arguments and result are (N,); `abs_y` is the distance from the middle of the car.
    """
    lamp = abs_y - 0.42
    return _softest(lamp, x - 1.66, z - (0.565 + 0.1 * lamp), 0.665 + 0.2 * lamp - z)


def _cabin_radius(x: Array, y: Array) -> Array:
    """Return the radius (N,) of points in the superellipse of the cabin, 1 at its edge.

    It is seen from above; x and y are (N,).
    """
    reach = np.where(x >= MIDDLE, 0.9 - MIDDLE, MIDDLE + 1.86)
    return (
        np.abs((x - MIDDLE) / reach) ** _CABIN_POWER + np.abs(y / 0.72) ** _CABIN_POWER
    ) ** (1 / _CABIN_POWER)


def _inside_arches(abs_y: Array, x: Array, z: Array) -> list[Array]:
    """Return how far points lie inside the front and the rear wheel arch, two arrays
    (N,).

    The arguments are (N,); `abs_y` is the distance from the middle of the car.
    """
    return [
        np.where(abs_y > 0.4, ARCH - np.hypot(x - axle, z - WHEEL), -1.0)
        for axle in AXLES
    ]


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
"""What is carved out of the body and out of the cabin, and what it becomes."""


def _opening(name: str) -> shapes.Field:
    return lambda p: _inside(p)[name]


def _body_and_cabin() -> list[Patch]:
    """Create the body and the cabin with their openings."""
    # rows of smaller and smaller outlines at the full height: they close body and cabin
    # at the top, but for a hole in the body under the cabin
    deck = [
        (1.0, s * 0.78, s * 1.79, s * -1.965) for s in (0.92, 0.81, 0.69, 0.56, 0.43)
    ]
    roof = [
        (1.0, s * 0.5, MIDDLE + s * 0.28, MIDDLE - s * 0.8)
        for s in (0.75, 0.45, 0.15, 0.002)
    ]
    body = np.array([*shapes.spline(_BODY, count=23), *deck])
    cabin = np.array([*shapes.spline(_CABIN, count=16), *roof])
    parts = {
        "body": _shell(
            body, power=_BODY_POWER, middle=0.0, height=_body_height, corner=0.085
        ),
        "cabin": _shell(
            cabin, power=_CABIN_POWER, middle=MIDDLE, height=_cabin_height, corner=0.1
        ),
    }
    for part, openings in OPENINGS.items():
        for name, tag in openings.items():
            parts[part] = shapes.carve_patches(parts[part], _opening(name), tag)
    return parts["body"] + parts["cabin"]


def _wheels() -> list[Patch]:
    """Create the four wheels with tyres, rims and hubs. A rim has five forked spokes.

    One wheel is built around the z axis, its outer side up, and copied to its places.
    """
    half = TYRE / 2  # z of the outer side; 0 is the middle of the tyre
    rim = 0.212  # radius
    tyre = _tyre_profile(rim, half)
    deep = half - 0.06  # z of the dark ground behind the spokes
    wheel = shapes.lathe([("rubber", tyre)], columns=28)
    wheel += shapes.lathe(
        [
            (
                "rim",
                [(rim, half - 0.008), (rim - 0.014, half - 0.012), (rim - 0.02, deep)],
            )
        ],
        columns=28,
    )
    wheel += shapes.lathe([("well", [(rim - 0.02, deep), (0.0, deep)])], columns=24)
    spoke = np.array(
        [
            (0.03, 0.0, half - 0.035),
            (0.11, 0.0, half - 0.022),
            (rim - 0.012, 0.0, half - 0.018),
        ]
    )
    section = shapes.rectangle(0.03, 0.03, bevel=0.008, steps=1)
    for number, side in product(range(5), (-1.0, 1.0)):
        spoke[:, 1] = side * np.array([0.012, 0.018, 0.04])
        turn = shapes.rotation("z", 72.0 * number)
        wheel += shapes.transform_patches(
            shapes.sweep("rim", spoke, section, (1.0, 1.0, 1.15)), turn
        )
    hub = [(0.052, deep), (0.05, half - 0.02), (0.03, half - 0.01), (0.0, half - 0.008)]
    wheel += shapes.lathe(
        [("rim", shapes.round_corners(hub, radius=0.008, steps=2))], columns=20
    )
    patches = []
    for axle, side in WHEELS:
        # The wheel's axis is laid along y, outwards; then the wheel rolls a little.
        turn = shapes.rotation("y", 17.0 * axle) @ shapes.rotation("x", -90.0 * side)
        patches += shapes.transform_patches(
            wheel, turn, (axle, side * (0.852 - TYRE / 2), WHEEL)
        )
    return patches


def _tyre_profile(rim: float, half: float) -> list[tuple[float, float]]:
    """Return the points (r, z) of the profile of a tyre from one side of the rim to the
    other.
    """
    outside = [
        (rim, half - 0.008),
        (rim + 0.012, half),
        (0.29, half + 0.004),
        (WHEEL - 0.012, half - 0.02),
    ]
    tread = [(WHEEL, half - 0.05), (WHEEL, 0.0), (WHEEL, 0.05 - half)]
    return [*((r, -z) for r, z in outside), *tread[::-1], *outside[::-1]]


def _wells() -> list[Patch]:
    """Create the inside of the wheel arches, and the floor of the car.

    Each arch has a curved wall around the wheel, and a flat one towards the middle.
    """
    # around the axle: from below it at the front, over the top, to below it at the rear
    angle = np.radians(np.linspace(-30.0, 210.0, 17))
    outwards = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    patches = []
    for axle, side in WHEELS:
        inner = np.array([axle, 0.0, WHEEL]) + ARCH * outwards
        # the edges of the curved wall: in the car's side, and farther in
        rows = np.stack([inner + np.array([0.0, side * y, 0.0]) for y in (0.79, 0.56)])
        ring = rows[1]
        if side > 0:  # so that the faces of both sides look towards the wheel
            rows = rows[::-1]
            ring = ring[::-1]
        normals = np.broadcast_to(-outwards, rows.shape)
        across = np.linspace(0.0, 1.0, len(angle))
        patches.append(
            shapes.grid(
                "well", rows, normals, (ARCH * 4.2, 0.32), np.array([0.0, 1.0]), across
            )
        )
        patches.append(shapes.cap("well", ring, np.array([0.0, side, 0.0])))
    x, y = _outline(
        np.linspace(np.pi, -np.pi, 41)[:-1],
        front=1.97,
        rear=-1.99,
        half=0.79,
        power=_BODY_POWER,
        middle=0.0,
    )
    return [
        *patches,
        shapes.cap(
            "well",
            np.stack([x, y, np.full_like(x, 0.2)], axis=1),
            np.array([0.0, 0.0, -1.0]),
        ),
    ]


def _fittings() -> list[Patch]:
    """Create mirrors, plates, badges, door handles and other fittings."""
    patches = []
    for side in (1.0, -1.0):  # mirrors
        shell = shapes.box(
            "paint", (0.0, 0.0, 0.0), (0.12, 0.2, 0.125), bevel=0.055, steps=3
        )
        patches += shapes.transform_patches(
            shell, shapes.rotation("z", -14.0 * side), (0.57, side * 0.93, 1.005)
        )
        patches += shapes.box(
            "trim",
            (0.58, side * 0.83, 0.955),
            (0.06, 0.14, 0.035),
            bevel=0.012,
            steps=1,
        )
    plate = shapes.box("plate", (0, 0, 0), (0.014, 0.52, 0.112), bevel=0.004, steps=1)
    badge = shapes.lathe(
        [("rim", [(0.058, -0.02), (0.058, 0.006), (0.05, 0.012), (0.0, 0.014)])],
        columns=24,
    )
    for fitting, tilt, position in (
        (plate, -4.0, (2.146, 0.0, 0.428)),
        (plate, 3.0, (-2.138, 0.0, 0.705)),
        (badge, 78.0, (2.118, 0.0, 0.575)),
        (badge, -80.0, (-2.075, 0.0, 0.86)),
    ):
        patches += shapes.transform_patches(
            fitting, shapes.rotation("y", tilt), position
        )
    for side, x in product((1.0, -1.0), (0.05, -0.92)):  # handles of the doors
        patches += shapes.box(
            "paint", (x, side * 0.889, 0.775), (0.2, 0.032, 0.028), bevel=0.011, steps=1
        )
    spoiler = shapes.box(
        "paint", (0, 0, 0), (0.2, 1.04, 0.035), bevel=0.015, steps=2, cells=2
    )
    return [
        *patches,
        *shapes.transform_patches(
            spoiler, shapes.rotation("y", 9.0), (-1.60, 0.0, 1.364)
        ),
    ]


_DOORS = (
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
    """Paint lacquer, with dark lines for the gaps of doors, hood, tailgate and tank
    lid.

    A soft fold runs along both sides of the hood.
    """
    x, y, z = t.xyz.T
    out = np.abs(y)
    hood = shapes.distance_to_polylines(
        x, out, [(0.9, 0.74), (1.5, 0.70), (1.84, 0.58), (1.95, 0.3), (1.97, 0.0)]
    )
    gate = shapes.distance_to_polylines(
        out, z, [(0.66, 1.2), (0.70, 0.98), (0.62, 0.66), (0.55, 0.58), (0.0, 0.57)]
    )
    # distance to each gap, where it is on this side of the car; far away elsewhere
    gaps = [
        np.where(
            (out > 0.6) & (z < 1.02), shapes.distance_to_polylines(x, z, *_DOORS), 9.0
        ),
        np.where((x > 0.8) & (z > 0.6), hood, 9.0),
        np.where(x < -1.7, gate, 9.0),
        # the tank's lid
        np.where(
            (y < -0.6) & (x < -1.0), np.abs(np.hypot(x + 1.52, z - 0.80) - 0.075), 9.0
        ),
    ]
    fold = np.clip(
        1.0 - shapes.distance_to_polylines(x, out, [(0.95, 0.5), (1.9, 0.36)]) / 0.05,
        0.0,
        1.0,
    )
    shaded = mix(color, 0.75 * color, 0.4 * np.where((x > 0.8) & (z > 0.7), fold, 0.0))
    return mix(
        shaded, 0.12 * color, 0.9 * step(0.005 - np.min(gaps, axis=0), 0.0, soft=0.011)
    )


def _panes(t: Texels) -> Array:
    """Paint dark glass with the pillar between the doors, and the seats behind the
    windscreen.
    """
    x, y, z = t.xyz.T
    color = mix(
        parse_hex_color("20272b"),
        parse_hex_color("414d55"),
        np.clip((z - 0.95) / 0.5, 0.0, 1.0),
    )
    out = np.abs(y)
    seat = np.minimum(
        np.hypot((out - 0.36) / 0.24, (z - 1.0) / 0.2),
        np.hypot((out - 0.36) / 0.11, (z - 1.23) / 0.055),
    )
    ahead = np.where(x > 0.0, step(1.0 - seat, 0.0, soft=0.15), 0.0)
    pillar = np.where(out > 0.55, step(0.035 - np.abs(x + 0.25), 0.0, soft=0.01), 0.0)
    return mix(color, parse_hex_color("0b0c0d"), np.maximum(pillar, ahead))


def _lamps(t: Texels) -> Array:
    """Paint headlights: two bright lamps on each side, with dark rings around them."""
    _, y, z = t.xyz.T
    out = np.abs(y)
    lamp = np.minimum(np.hypot(out - 0.58, z - 0.62), np.hypot(out - 0.71, z - 0.64))
    base = mix(
        parse_hex_color("9aa4ab"),
        parse_hex_color("f4f7f8"),
        step(0.032 - lamp, 0.0, soft=0.01),
    )
    return mix(
        base,
        parse_hex_color("3a4045"),
        step(0.01 - np.abs(lamp - 0.039), 0.0, soft=0.008),
    )


def _tail(t: Texels) -> Array:
    """Paint taillights: dark red with a bright stripe."""
    z = t.xyz[:, 2]
    return mix(
        parse_hex_color("8e0d12"),
        parse_hex_color("d8392f"),
        step(0.018 - np.abs(z - 0.87), 0.0, soft=0.01),
    )


def _slats(t: Texels) -> Array:
    """Paint dark trim, with bright slats in the upper grille."""
    x, _, z = t.xyz.T
    slat = np.where(
        (x > 1.9) & (z > 0.48),
        step(0.006 - np.abs((z % 0.034) - 0.017), 0.0, soft=0.006),
        0.0,
    )
    return mix(parse_hex_color("17181a"), parse_hex_color("8b9095"), slat)


@painter
def _plate(t: Texels, ground: Array) -> Array:
    """Paint a licence plate: dark strokes on a light ground, which are nobody's number.

    It has eight cells along y, and the fourth one is empty.
    """
    # from -1 to 1 over the plate, which is painted before it is moved to its place
    y = t.xyz[:, 1] / 0.26
    z = t.xyz[:, 2] / 0.056
    cell = (y + 0.86) / 0.215
    field = (
        (np.abs(y) < 0.86)
        & (np.abs(z) < 0.62)
        & (np.floor(cell) != 3)
        & (t.xyz[:, 0] > -1.0)
    )
    # from the middle of a cell: two upright strokes, and two bars between them
    cell_fraction = np.abs(cell % 1.0 - 0.5)
    strokes = (np.abs(cell_fraction - 0.27) < 0.09) | (
        (cell_fraction < 0.3) & (np.abs(np.abs(z) - 0.5) < 0.13)
    )
    return mix(ground, parse_hex_color("16181c"), (field & strokes).astype(np.float64))


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


@family(metres=1.0, texels=384)
def car(sampler: ParameterSampler) -> Instance:
    """Make a car of random proportions and paint."""
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
    metal = sampler.sample_color("c4c7ca", "8d9094", "2d2f31", p_random=0.0)
    paints: dict[str, Paint] = {
        "paint": _lacquer(color),
        "glass": _panes,
        "headlight": _lamps,
        "taillight": _tail,
        "rubber": solid("1c1c1d"),
        "rim": solid(metal),
        "trim": _slats,
        "plate": _plate(sampler.sample_color("f2f2ec", "f0d264", p_random=0.0)),
        "well": solid("0a0a0b"),
    }
    texel_density = {
        "rubber": 0.3,
        "well": 0.15,
        "rim": 0.35,
        "trim": 0.7,
        "plate": 3.0,
    }
    return Instance(
        shapes.stretch_patches(patches, stretch),
        paints,
        material=FINISHES["paint"],
        texel_density=texel_density,
        finishes=FINISHES,
        drives=True,
    )
