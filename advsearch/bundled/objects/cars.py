"""A car: a hatchback of five doors. Units are metres; it drives towards +x.

Body and cabin are stacks of outlines: superellipses seen from above, each with its own length and width, at heights
that follow the lines of hood, waist and roof. Windows, lights, grilles and wheel arches are carved out of them.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise, product

import numpy as np

from advsearch.bundled.objects.draw import Draw, hexed
from advsearch.bundled.objects.family import Instance, family
from advsearch.bundled.objects.shapes import (
    Array,
    Field,
    Patch,
    away_from,
    box,
    cap,
    carved,
    grid,
    lathe,
    mean_lengths,
    placed,
    rectangle,
    rotation,
    rounded,
    spline,
    stretched,
    sweep,
    unit,
)
from advsearch.bundled.objects.textures import Paint, Texels, mix, painter, solid, step
from advsearch.scene.assets import Material

AXLES = (1.29, -1.33)
WHEEL, TYRE = 0.33, 0.215  # radius and width
ARCH = 0.385
WHEELS = tuple(product(AXLES, (1.0, -1.0)))  # x of the axle, and the side
MIDDLE = -0.5  # of the cabin
COLUMNS = 92
Height = Callable[[Array, Array, Array], Array]


# ------------------------------------------------------------------------------------------------------- outlines


def _outline(angle: Array, front: float, rear: float, half: float, power: float, middle: float) -> tuple[Array, Array]:
    """x and y of a superellipse about (middle, 0) that reaches from `rear` to `front` and `half` to each side."""
    c, s = np.cos(angle), np.sin(angle)
    reach = np.where(c >= 0.0, front - middle, middle - rear)
    return middle + reach * np.sign(c) * np.abs(c) ** (2 / power), half * np.sign(s) * np.abs(s) ** (2 / power)


def _shell(rows: Array, power: float, middle: float, height: Height, corner: float) -> list[Patch]:
    """Painted patches of a stack of outlines.

    Args:
        rows: (R, 4) share of the height, half the width, front and rear end of each.
        power: of the superellipses.
        middle: x about which they are drawn.
        height: from share, x and y to z.
        corner: share of the columns from the middles of front and rear at which it is cut.
    """
    # angles are equally far apart along the widest outline, symmetrical, from the rear's middle
    _, half, front, rear = rows[np.argmax(rows[:, 1])]
    fine = np.linspace(-np.pi, np.pi, 8001)
    x, y = _outline(fine, front - middle, rear - middle, half, power, 0.0)
    at = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    angle = np.interp(np.linspace(0.0, at[-1], COLUMNS + 1), at, fine)
    points = np.empty((len(rows), COLUMNS + 1, 3))
    for row, (share, half, front, rear) in zip(points, rows, strict=True):
        x, y = _outline(angle, front, rear, half, power, middle)
        row[:, 0], row[:, 1], row[:, 2] = x, y, height(np.full_like(x, share), x, y)
    around = np.concatenate([points[:, -2:-1], points, points[:, 1:2]], axis=1)
    across = np.gradient(around, axis=1)[:, 1:-1]
    normals = unit(np.cross(across, np.gradient(points, axis=0)))
    opposite, cut = COLUMNS // 2, int(COLUMNS * corner)
    patches = []
    for first, last in pairwise((0, cut, opposite - cut, opposite + cut, COLUMNS - cut, COLUMNS)):
        part = points[:, first : last + 1]
        u, v = (mean_lengths(part, axis) for axis in (1, 0))
        size = (float(u[-1]), float(v[-1]))
        patches.append(grid("paint", part, normals[:, first : last + 1], size, v / v[-1], u / u[-1]))
    return patches


def _line(knots: list[tuple[float, float]]) -> Callable[[Array], Array]:
    """A smooth function through knots (x, value) in order of x."""
    curve = spline(knots, 200)
    return lambda x: np.interp(x, curve[:, 0], curve[:, 1])


def _softest(*fields: Array) -> Array:
    """The least of some distances, with corners rounded by about 3 cm."""
    k = 30.0
    values: Array = -np.log(np.exp(-k * np.clip(np.stack(fields), -1.0, 1.0)).sum(axis=0)) / k
    return values


# ----------------------------------------------------------------------------------------------------------- body

_BOTTOM = _line([(-2.2, 0.30), (-1.7, 0.20), (0.0, 0.175), (1.7, 0.185), (2.2, 0.235)])
_WAIST = _line(
    [
        (-2.2, 1.0), (-1.9, 0.995), (-1.2, 0.975), (-0.4, 0.945), (0.4, 0.925), (0.95, 0.9), (1.4, 0.845),
        (1.75, 0.775), (2.0, 0.7), (2.2, 0.62),
    ]
)  # fmt: skip
_ROOF = _line([(-2.2, 1.26), (-1.75, 1.345), (-1.3, 1.405), (-0.7, 1.435), (-0.2, 1.43), (0.2, 1.395), (1.1, 1.2)])
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
_BODY_POWER, _CABIN_POWER = 4.2, 4.6


def _body_height(share: Array, x: Array, y: Array) -> Array:
    top, low = _WAIST(x) + 0.045 * (1.0 - (y / 0.8) ** 2), _BOTTOM(x)
    return np.asarray(low + share * (top - low))


def _cabin_height(share: Array, x: Array, y: Array) -> Array:
    low = _WAIST(x) + 0.045 * (1.0 - (y / 0.8) ** 2) - 0.03
    return np.asarray(low + share * (_ROOF(x) + 0.035 * (1.0 - (y / 0.6) ** 2) - low))


def _within(front: float, rear: float, half: float, power: float, middle: float) -> Field:
    """Inside an outline, whatever the height."""

    def inside(p: Array) -> Array:
        reach = np.where(p[:, 0] >= middle, front - middle, middle - rear)
        size = (np.abs((p[:, 0] - middle) / reach) ** power + np.abs(p[:, 1] / half) ** power) ** (1 / power)
        return np.asarray(half * (1.0 - size))

    return inside


def _arch(axle: float) -> Field:
    return lambda p: np.where(np.abs(p[:, 1]) > 0.4, ARCH - np.hypot(p[:, 0] - axle, p[:, 2] - WHEEL), -1.0)


def _headlight(p: Array) -> Array:
    out = np.abs(p[:, 1]) - 0.42
    low, high = 0.565 + 0.1 * out, 0.665 + 0.2 * out
    return np.where(p[:, 0] > 1.2, _softest(out, p[:, 0] - 1.66, p[:, 2] - low, high - p[:, 2]), -1.0)


def _taillight(p: Array) -> Array:
    out = np.abs(p[:, 1]) - 0.40
    return np.where(p[:, 0] < -1.0, _softest(out, -1.80 - p[:, 0], p[:, 2] - 0.785, 0.955 - p[:, 2]), -1.0)


def _grille(half: float, low: float, high: float, lean: float = 0.0) -> Field:
    def inside(p: Array) -> Array:
        out = np.abs(p[:, 1])
        hole = _softest(half - out, p[:, 2] - low - lean * out, high + lean * out - p[:, 2])
        return np.where(p[:, 0] > 1.5, hole, -1.0)

    return inside


def _valance(p: Array) -> Array:
    """The dark lower edge all round, higher at the back."""
    return _BOTTOM(p[:, 0]) + np.where(p[:, 0] < -1.6, 0.13, 0.075) - p[:, 2]


def _half(z: Array) -> Array:
    """About half the cabin's width at a height."""
    return np.interp(z, [0.93, 1.15, 1.36], [0.795, 0.735, 0.668])


def _windscreen(p: Array) -> Array:
    inside = _softest(0.85 * _half(p[:, 2]) - np.abs(p[:, 1]), 1.36 - p[:, 2])
    return np.where(p[:, 0] > 0.0, inside, -1.0)


def _rear_window(p: Array) -> Array:
    inside = _softest(0.86 * _half(p[:, 2]) - np.abs(p[:, 1]), p[:, 2] - 1.045, 1.325 - p[:, 2])
    return np.where(p[:, 0] < -1.5, inside, -1.0)


def _side_windows(p: Array) -> Array:
    x, z = p[:, 0], p[:, 2]
    low = _WAIST(x) + 0.04
    high = low + 0.83 * (_ROOF(x) - low)
    pillar = (0.60 - x) * 0.58 - (z - 0.93) * 0.81  # distance behind the line of the windscreen's pillar
    rear = (x + 1.62) * 0.72 - (z - 0.98) * 0.69
    return np.where(np.abs(p[:, 1]) > 0.45, _softest(pillar, rear, z - low, high - z), -1.0)


CARVED: tuple[tuple[Field, str | None], ...] = (
    (_within(0.9, -1.86, 0.72, _CABIN_POWER, MIDDLE), None),
    *((_arch(axle), None) for axle in AXLES),
    (_headlight, "headlight"),
    (_taillight, "taillight"),
    (_grille(0.62, 0.24, 0.37, -0.02), "trim"),
    (_grille(0.41, 0.5, 0.64, 0.04), "trim"),
    (_valance, "trim"),
)
"""What is carved out of the body, and what it becomes."""


def _body_and_cabin() -> list[Patch]:
    deck = [(1.0, s * 0.78, s * 1.79, s * -1.965) for s in (0.92, 0.81, 0.69, 0.56, 0.43)]
    body = _shell(np.array([*spline(_BODY, 23), *deck]), _BODY_POWER, 0.0, _body_height, 0.085)
    for inside, tag in CARVED:
        body = carved(body, inside, tag)
    roof = [(1.0, s * 0.5, MIDDLE + s * 0.28, MIDDLE - s * 0.8) for s in (0.75, 0.45, 0.15, 0.002)]
    cabin = _shell(np.array([*spline(_CABIN, 16), *roof]), _CABIN_POWER, MIDDLE, _cabin_height, 0.1)
    for window in (_windscreen, _rear_window, _side_windows):
        cabin = carved(cabin, window, "glass")
    return body + cabin


# --------------------------------------------------------------------------------------------------------- wheels


def _wheel() -> list[Patch]:
    """A wheel about the z axis, its outer side up, in the middle of the tyre."""
    half, rim = TYRE / 2, 0.212
    outside = [(rim, half - 0.008), (rim + 0.012, half), (0.29, half + 0.004), (WHEEL - 0.012, half - 0.02)]
    tread = [(WHEEL, half - 0.05), (WHEEL, 0.0), (WHEEL, 0.05 - half)]
    tyre = [*((r, -z) for r, z in outside), *tread[::-1], *outside[::-1]]
    deep = half - 0.06
    patches = lathe([("rubber", tyre)], 28)
    patches += lathe([("rim", [(rim, half - 0.008), (rim - 0.014, half - 0.012), (rim - 0.02, deep)])], 28)
    patches += lathe([("well", [(rim - 0.02, deep), (0.0, deep)])], 24)
    spoke = np.array([(0.03, 0.0, half - 0.035), (0.11, 0.0, half - 0.022), (rim - 0.012, 0.0, half - 0.018)])
    section = rectangle(0.03, 0.03, 0.008, 1)
    for number, side in product(range(5), (-1.0, 1.0)):
        spoke[:, 1] = side * np.array([0.012, 0.018, 0.04])
        patches += placed(sweep("rim", spoke, section, (1.0, 1.0, 1.15)), rotation("z", 72.0 * number))
    hub = [(0.052, deep), (0.05, half - 0.02), (0.03, half - 0.01), (0.0, half - 0.008)]
    return patches + lathe([("rim", rounded(hub, 0.008, 2))], 20)


def _wheels() -> list[Patch]:
    patches = []
    for axle, side in WHEELS:
        turn = rotation("y", 17.0 * axle) @ rotation("x", -90.0 * side)
        patches += placed(_wheel(), turn, (axle, side * (0.852 - TYRE / 2), WHEEL))
    return patches


def _wells() -> list[Patch]:
    """The insides of the wheel arches, and the floor."""
    angle = np.radians(np.linspace(-30.0, 210.0, 17))
    outwards = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    patches = []
    for axle, side in WHEELS:
        inner = np.array([axle, 0.0, WHEEL]) + ARCH * outwards
        rows = np.stack([inner + np.array([0.0, side * y, 0.0]) for y in (0.79, 0.56)])
        ring = rows[1]
        if side > 0:
            rows, ring = rows[::-1], ring[::-1]
        normals = np.broadcast_to(-outwards, rows.shape)
        across = np.linspace(0.0, 1.0, len(angle))
        patches.append(grid("well", rows, normals, (ARCH * 4.2, 0.32), np.array([0.0, 1.0]), across))
        patches.append(cap("well", ring, np.array([0.0, side, 0.0])))
    x, y = _outline(np.linspace(np.pi, -np.pi, 41)[:-1], 1.97, -1.99, 0.79, _BODY_POWER, 0.0)
    return [*patches, cap("well", np.stack([x, y, np.full_like(x, 0.2)], axis=1), np.array([0.0, 0.0, -1.0]))]


# ------------------------------------------------------------------------------------------------------- fittings


def _fittings() -> list[Patch]:
    patches = []
    for side in (1.0, -1.0):  # mirrors
        shell = box("paint", (0.0, 0.0, 0.0), (0.12, 0.2, 0.125), 0.055, 3)
        patches += placed(shell, rotation("z", -14.0 * side), (0.57, side * 0.93, 1.005))
        patches += box("trim", (0.58, side * 0.83, 0.955), (0.06, 0.14, 0.035), 0.012, 1)
    plate = box("plate", (0, 0, 0), (0.014, 0.52, 0.112), 0.004, 1)
    badge = lathe([("rim", [(0.058, -0.02), (0.058, 0.006), (0.05, 0.012), (0.0, 0.014)])], 24)
    for thing, lean, place in (
        (plate, -4.0, (2.146, 0.0, 0.428)),
        (plate, 3.0, (-2.138, 0.0, 0.705)),
        (badge, 78.0, (2.118, 0.0, 0.575)),
        (badge, -80.0, (-2.075, 0.0, 0.86)),
    ):
        patches += placed(thing, rotation("y", lean), place)
    for side, x in product((1.0, -1.0), (0.05, -0.92)):  # handles of the doors
        patches += box("paint", (x, side * 0.889, 0.775), (0.2, 0.032, 0.028), 0.011, 1)
    spoiler = box("paint", (0, 0, 0), (0.2, 1.04, 0.035), 0.015, 2, 2)
    return [*patches, *placed(spoiler, rotation("y", 9.0), (-1.60, 0.0, 1.364))]


# --------------------------------------------------------------------------------------------------------- paints


_DOORS = (
    [(0.86, 1.0), (0.88, 0.6), (0.84, 0.32), (0.78, 0.25), (-0.9, 0.25)],
    [(-0.26, 1.0), (-0.24, 0.6), (-0.27, 0.25)],
    [(-1.3, 1.1), (-1.22, 0.86), (-1.05, 0.70), (-0.93, 0.5), (-0.88, 0.32), (-0.9, 0.25)],
)


@painter
def _lacquer(t: Texels, color: Array) -> Array:
    """Paint with the gaps of doors, hood and tailgate."""
    x, y, z = t.xyz.T
    out = np.abs(y)
    hood = away_from(x, out, [(0.9, 0.74), (1.5, 0.70), (1.84, 0.58), (1.95, 0.3), (1.97, 0.0)])
    gate = away_from(out, z, [(0.66, 1.2), (0.70, 0.98), (0.62, 0.66), (0.55, 0.58), (0.0, 0.57)])
    gaps = [
        np.where((out > 0.6) & (z < 1.02), away_from(x, z, *_DOORS), 9.0),
        np.where((x > 0.8) & (z > 0.6), hood, 9.0),
        np.where(x < -1.7, gate, 9.0),
        np.where((y < -0.6) & (x < -1.0), np.abs(np.hypot(x + 1.52, z - 0.80) - 0.075), 9.0),  # the tank's lid
    ]
    fold = np.clip(1.0 - away_from(x, out, [(0.95, 0.5), (1.9, 0.36)]) / 0.05, 0.0, 1.0)
    shaded = mix(color, 0.75 * color, 0.4 * np.where((x > 0.8) & (z > 0.7), fold, 0.0))
    return mix(shaded, 0.12 * color, 0.9 * step(0.005 - np.min(gaps, axis=0), 0.0, 0.011))


def _panes(t: Texels) -> Array:
    """Dark glass, with the pillar between the doors, and behind the windscreen what one sees of two seats."""
    x, y, z = t.xyz.T
    color = mix(hexed("20272b"), hexed("414d55"), np.clip((z - 0.95) / 0.5, 0.0, 1.0))
    out = np.abs(y)
    seat = np.minimum(np.hypot((out - 0.36) / 0.24, (z - 1.0) / 0.2), np.hypot((out - 0.36) / 0.11, (z - 1.23) / 0.055))
    ahead = np.where(x > 0.0, step(1.0 - seat, 0.0, 0.15), 0.0)
    pillar = np.where(out > 0.55, step(0.035 - np.abs(x + 0.25), 0.0, 0.01), 0.0)
    return mix(color, hexed("0b0c0d"), np.maximum(pillar, ahead))


def _lamps(t: Texels) -> Array:
    """A headlight: two round lamps in a bright housing."""
    _, y, z = t.xyz.T
    out = np.abs(y)
    lamp = np.minimum(np.hypot(out - 0.58, z - 0.62), np.hypot(out - 0.71, z - 0.64))
    base = mix(hexed("9aa4ab"), hexed("f4f7f8"), step(0.032 - lamp, 0.0, 0.01))
    return mix(base, hexed("3a4045"), step(0.01 - np.abs(lamp - 0.039), 0.0, 0.008))


def _tail(t: Texels) -> Array:
    z = t.xyz[:, 2]
    return mix(hexed("8e0d12"), hexed("d8392f"), step(0.018 - np.abs(z - 0.87), 0.0, 0.01))


def _slats(t: Texels) -> Array:
    """Dark plastic; the grilles have bright slats."""
    x, _, z = t.xyz.T
    slat = np.where((x > 1.9) & (z > 0.48), step(0.006 - np.abs((z % 0.034) - 0.017), 0.0, 0.006), 0.0)
    return mix(hexed("17181a"), hexed("8b9095"), slat)


@painter
def _plate(t: Texels, ground: Array) -> Array:
    """A licence plate: dark strokes on a light ground; nobody's number."""
    y, z = t.xyz[:, 1] / 0.26, t.xyz[:, 2] / 0.056
    cell = (y + 0.86) / 0.215
    field = (np.abs(y) < 0.86) & (np.abs(z) < 0.62) & (np.floor(cell) != 3) & (t.xyz[:, 0] > -1.0)
    place = np.abs(cell % 1.0 - 0.5)
    strokes = (np.abs(place - 0.27) < 0.09) | ((place < 0.3) & (np.abs(np.abs(z) - 0.5) < 0.13))
    return mix(ground, hexed("16181c"), (field & strokes).astype(np.float64))


GLASS = Material(roughness=0.04, specular=0.6)
FINISHES = {
    "paint": Material(roughness=0.38, clearcoat=1.0),
    "glass": GLASS,
    "headlight": GLASS,
    "taillight": GLASS,
    "rubber": Material(roughness=0.85),
    "rim": Material(roughness=0.3, metallic=0.9),
    "trim": Material(roughness=0.5),
    "plate": Material(roughness=0.4),
    "well": Material(roughness=0.95),
}


@family(metres=1.0, texels=384)
def car(draw: Draw) -> Instance:
    color = draw.colour("2a5fa8", "b3202a", "d9dadb", "2f6f4f", "e0a02c", "3a3f45", wild=0.2)
    stretch = np.array([draw(1.0, 0.94, 1.07), draw(1.0, 0.96, 1.05), draw(1.0, 0.95, 1.1)])
    patches = [*_body_and_cabin(), *_wheels(), *_wells(), *_fittings()]
    metal = draw.colour("c4c7ca", "8d9094", "2d2f31", wild=0.0)
    paints: dict[str, Paint] = {
        "paint": _lacquer(color),
        "glass": _panes,
        "headlight": _lamps,
        "taillight": _tail,
        "rubber": solid("1c1c1d"),
        "rim": solid(metal),
        "trim": _slats,
        "plate": _plate(draw.colour("f2f2ec", "f0d264", wild=0.0)),
        "well": solid("0a0a0b"),
    }
    detail = {"rubber": 0.3, "well": 0.15, "rim": 0.35, "trim": 0.7, "plate": 3.0}
    return Instance(stretched(patches, stretch), paints, FINISHES["paint"], detail, FINISHES)
