"""Indoor environments: a studio and six rooms. Lengths in metres, the table top is at z
= 0, colours linear.
"""

from __future__ import annotations

import numpy as np

from .panorama import Array, EnvironmentFamily
from .raycast import Block, Globe, Quad, Surface, cast, even, room

# ----------------------------------------------------------------------------------------------------
# surfaces


def planks(dark: float, light: float, across: int = 1) -> Surface:
    """Wooden boards 12 cm wide; `across` is the coordinate that counts them."""

    def paint(s: Array, t: Array, p: Array) -> Array:
        board = np.floor(p[:, across] / 0.12)
        tone = dark + (light - dark) * (
            0.5
            + 0.5
            * np.sin(
                board * 12.9898 + 3.0 * np.floor(p[:, 1 - across] / 0.9 + board * 0.37)
            )
        )
        joint = np.where(np.abs(p[:, across] / 0.12 - board - 0.5) > 0.46, 0.5, 1.0)
        boards: Array = (tone * joint)[:, None] * np.array([1.0, 0.62, 0.34])
        return boards

    return paint


def tiles(
    a: float,
    b: float,
    size: float = 0.3,
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Surface:
    """A chequered floor."""

    def paint(s: Array, t: Array, p: Array) -> Array:
        odd = (np.floor(p[:, 0] / size) + np.floor(p[:, 1] / size)) % 2.0
        tiles: Array = (a + (b - a) * odd)[:, None] * np.array(tint)
        return tiles

    return paint


def bricks(r: float, g: float, b: float) -> Surface:
    """A brick wall."""

    def paint(s: Array, t: Array, p: Array) -> Array:
        row = np.floor(p[:, 2] / 0.17)
        along = (p[:, 0] + p[:, 1]) / 0.52 + 0.5 * (row % 2.0)
        tone = 0.75 + 0.25 * np.sin(np.floor(along) * 7.1 + row * 3.7)
        joint = (p[:, 2] / 0.17 % 1.0 < 0.1) | (along % 1.0 < 0.035)
        return np.where(joint[:, None], 0.36, tone[:, None] * np.array([r, g, b]))

    return paint


def picture(
    a: tuple[float, float, float], b: tuple[float, float, float], seed: float
) -> Surface:
    """An abstract painting in a dark frame."""

    def paint(s: Array, t: Array, p: Array) -> Array:
        wave = 0.5 + 0.5 * np.sin(3.0 * s + seed + 2.5 * np.sin(4.0 * t + 2.0 * seed))
        color = np.array(a) + (np.array(b) - np.array(a)) * wave[:, None]
        return np.where((np.maximum(np.abs(s), np.abs(t)) > 0.9)[:, None], 0.05, color)

    return paint


def shelves(seed: float) -> Surface:
    """A wall of books."""

    def paint(s: Array, t: Array, p: Array) -> Array:
        along = (p[:, 0] + p[:, 1]) / 0.045
        row = np.floor(p[:, 2] / 0.34)
        book = np.floor(along + 0.3 * np.sin(row * 5.0))
        phase = (
            book[:, None] * 2.399
            + row[:, None] * 1.7
            + seed
            + np.array([0.0, 2.0, 4.0])
        )
        color = 0.22 + 0.2 * np.sin(phase)
        board = (p[:, 2] / 0.34 % 1.0 < 0.09) | (
            p[:, 2] / 0.34 % 1.0 > 0.78 + 0.08 * np.sin(book * 3.1)
        )
        return np.where(board[:, None], np.array([0.2, 0.12, 0.06]), color)

    return paint


def outlook(
    level: float,
    columns: int = 2,
    rows: int = 2,
    ground: float = -0.35,
    warm: float = 0.0,
) -> Surface:
    """What is seen through a window: sky brightening upwards, a dark line of trees,
    lawn; with glazing bars.
    """
    tint = np.array([1.0 + 0.5 * warm, 1.0, 1.0 - 0.5 * warm])

    def paint(s: Array, t: Array, p: Array) -> Array:
        sky = np.array([0.72, 0.86, 1.0]) * (0.8 + 0.35 * np.clip(t, -1, 1))[:, None]
        hills = ground + 0.08 * np.sin(5.0 * s) + 0.05 * np.sin(11.0 * s + 1.0)
        lawn = (
            np.array([0.2, 0.24, 0.1]) * np.where(t < ground - 0.25, 1.3, 0.55)[:, None]
        )
        color = level * np.where((t < hills)[:, None], lawn, sky) * tint
        bars = (np.abs(((s + 1) / 2 * columns + 0.5) % 1.0 - 0.5) < 0.022 * columns) | (
            np.abs(((t + 1) / 2 * rows + 0.5) % 1.0 - 0.5) < 0.022 * rows
        )
        return np.where(bars[:, None], 0.035 * level, color)

    return paint


def softbox(
    level: float, tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Surface:
    """A diffuser, a little brighter in the middle."""
    return lambda s, t, p: (
        level * (1.15 - 0.3 * np.maximum(s**2, t**2))[:, None] * np.array(tint)
    )


# -------------------------------------------------------------------------------------------------------
# rooms


def _tilted(
    azimuth: float,
    elevation: float,
    distance: float,
    wide: float,
    tall: float,
    glow: Surface,
) -> Quad:
    """A panel in a direction (degrees) that faces the origin; half-extents in
    metres.
    """
    a = np.radians(azimuth)
    e = np.radians(elevation)
    out = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    side = np.array([-np.sin(a), np.cos(a), 0.0])
    return Quad(
        tuple(out * distance),
        tuple(side * wide),
        tuple(np.cross(out, side) * tall),
        glow=glow,
    )


def studio(rays: Array) -> Array:
    """A grey cove: a large softbox left of the default camera, a weaker one to its
    right, a top light, a rim strip.
    """
    grey = even(0.34, 0.34, 0.35)
    shapes = room((-4, -4, -1.0), (4, 4, 3.4), grey, even(0.28, 0.28, 0.28), grey)
    shapes += [
        _tilted(-15.0, 38.0, 2.6, 1.0, 0.8, softbox(9.0)),
        _tilted(105.0, 28.0, 3.0, 0.8, 0.9, softbox(3.4, (0.92, 0.97, 1.06))),
        _tilted(205.0, 40.0, 3.0, 0.22, 1.1, softbox(8.0, (1.05, 1.0, 0.94))),
        _tilted(60.0, 84.0, 2.2, 0.9, 0.9, softbox(3.6)),
    ]
    return cast(rays, shapes, (0.5, 0.5, 0.5))


def day_room(rays: Array) -> Array:
    """A living room by day: two tall windows, a boarded floor, a bookcase, a sofa."""
    shapes: list[Quad | Block | Globe] = list(
        room(
            (-3.4, -2.6, -0.8),
            (2.4, 2.8, 1.9),
            even(0.72, 0.69, 0.62),
            planks(0.25, 0.42),
            even(0.82, 0.82, 0.8),
        )
    )
    for y in (-1.1, 1.2):
        shapes.append(
            Quad((2.38, y, 0.65), (0, 0.72, 0), (0, 0, 0.95), glow=outlook(6.0, 2, 3))
        )
    shapes.append(
        Quad((-0.4, -2.58, 0.75), (0.6, 0, 0), (0, 0, 0.8), glow=outlook(4.0, 2, 2))
    )
    shapes += [
        Block((-3.4, -0.9, -0.8), (-3.0, 1.5, 1.3), shelves(1.0)),
        Block((-2.2, 2.0, -0.8), (0.2, 2.8, -0.35), even(0.16, 0.2, 0.3)),
        Block((-2.2, 2.5, -0.4), (0.2, 2.8, 0.1), even(0.16, 0.2, 0.3)),
        Quad(
            (1.3, 2.78, 0.7),
            (0.4, 0, 0),
            (0, 0, 0.3),
            picture((0.7, 0.3, 0.1), (0.1, 0.2, 0.4), 1.0),
        ),
        Quad(
            (-2.4, -2.57, 0.6),
            (0.35, 0, 0),
            (0, 0, 0.45),
            picture((0.6, 0.6, 0.5), (0.3, 0.1, 0.1), 2.0),
        ),
        Globe((1.6, -2.1, -0.1), 0.33, even(0.08, 0.2, 0.05)),
    ]
    return cast(rays, shapes, (0.9, 0.88, 0.84))


def kitchen(rays: Array) -> Array:
    """A bright kitchen: a wide window over the worktop, white cupboards, chequered
    floor, a lamp over the table.
    """
    shapes: list[Quad | Block | Globe] = list(
        room(
            (-2.3, -2.0, -0.85),
            (2.2, 2.2, 1.65),
            even(0.66, 0.7, 0.64),
            tiles(0.08, 0.6),
            even(0.85, 0.85, 0.83),
        )
    )
    shapes += [
        Quad((0.2, -1.98, 0.75), (0.95, 0, 0), (0, 0, 0.6), glow=outlook(6.5, 3, 1)),
        Quad((2.18, 0.9, 0.35), (0, 0.42, 0), (0, 0, 0.95), glow=outlook(4.5, 1, 3)),
        Block((-2.3, -2.0, -0.85), (2.2, -1.4, 0.0), even(0.78, 0.77, 0.72)),
        Block((-2.3, -2.0, 0.0), (2.2, -1.36, 0.04), even(0.22, 0.13, 0.07)),
        Block((-2.3, -1.4, -0.85), (-1.7, 1.0, 0.0), even(0.78, 0.77, 0.72)),
        Block((-2.3, -1.4, 0.6), (-1.95, 0.9, 1.3), even(0.3, 0.45, 0.42)),
        Block((-2.3, 1.2, -0.85), (-1.6, 1.9, 1.1), even(0.62, 0.64, 0.66)),
        Quad(
            (0.2, 0.3, 1.35),
            (0.35, 0, 0),
            (0, 0.35, 0),
            glow=softbox(7.0, (1.0, 0.85, 0.62)),
        ),
        Globe((-1.5, -1.7, 0.2), 0.16, even(0.6, 0.12, 0.05)),
        Globe((1.4, -1.7, 0.17), 0.13, even(0.75, 0.5, 0.06)),
        Quad(
            (0.7, 2.18, 0.5),
            (0.5, 0, 0),
            (0, 0, 0.35),
            picture((0.75, 0.7, 0.5), (0.2, 0.35, 0.2), 4.0),
        ),
    ]
    return cast(rays, shapes, (1.0, 0.98, 0.92))


def evening_room(rays: Array) -> Array:
    """A sitting room at night: three warm lamps, dark red walls, a blue window."""
    shapes: list[Quad | Block | Globe] = list(
        room(
            (-2.8, -2.5, -0.7),
            (2.9, 2.4, 1.8),
            even(0.42, 0.17, 0.12),
            planks(0.12, 0.24, 0),
            even(0.6, 0.52, 0.42),
        )
    )
    warm = (1.0, 0.62, 0.3)
    shapes += [
        Quad(
            (0.9, 2.38, 0.6),
            (0.7, 0, 0),
            (0, 0, 0.7),
            glow=lambda s, t, p: (
                np.broadcast_to(np.array([0.06, 0.1, 0.22]), (len(s), 3))
                * (1.0 + 0.4 * t)[:, None]
            ),
        ),
        Globe((2.0, -0.7, 0.75), 0.24, glow=even(*(42.0 * np.array(warm)))),
        Globe((-1.9, -1.5, 0.6), 0.2, glow=even(*(26.0 * np.array(warm)))),
        Globe((0.4, 1.9, 0.35), 0.17, glow=even(*(30.0 * np.array(warm)))),
        Quad(
            (0.0, -0.2, 1.75),
            (0.3, 0, 0),
            (0, 0.3, 0),
            glow=softbox(9.0, (1.0, 0.72, 0.42)),
        ),
        Block((-2.8, 0.2, -0.7), (-2.4, 1.9, 1.0), shelves(4.0)),
        Block((-1.6, -2.5, -0.7), (1.0, -1.7, -0.3), even(0.12, 0.2, 0.14)),
        Block((-1.6, -2.5, -0.3), (1.0, -2.2, 0.15), even(0.12, 0.2, 0.14)),
        Block((1.85, -0.85, -0.7), (2.15, -0.55, 0.5), even(0.25, 0.14, 0.07)),
        Quad(
            (-0.9, -2.48, 0.9),
            (0.5, 0, 0),
            (0, 0, 0.35),
            picture((0.5, 0.4, 0.2), (0.1, 0.12, 0.2), 3.0),
        ),
    ]
    return cast(rays, shapes, (0.75, 0.42, 0.22))


def gallery(rays: Array) -> Array:
    """A white exhibition hall: rows of ceiling panels, paintings, a pale stone
    floor.
    """
    shapes: list[Quad | Block | Globe] = list(
        room(
            (-6.0, -3.0, -1.0),
            (7.0, 3.2, 3.0),
            even(0.8, 0.8, 0.79),
            tiles(0.4, 0.46, 0.9),
            even(0.7, 0.7, 0.7),
        )
    )
    for x in (-4.5, -1.5, 1.5, 4.5):
        for y in (-1.4, 1.6):
            shapes.append(
                Quad(
                    (x, y, 2.97),
                    (1.0, 0, 0),
                    (0, 0.22, 0),
                    glow=softbox(8.0, (1.0, 0.97, 0.9)),
                )
            )
    colors = [
        (0.7, 0.1, 0.05),
        (0.05, 0.2, 0.5),
        (0.8, 0.6, 0.1),
        (0.1, 0.3, 0.15),
        (0.4, 0.1, 0.4),
        (0.05, 0.05, 0.07),
    ]
    for i, x in enumerate((-4.2, -1.6, 1.0, 3.6)):
        shapes.append(
            Quad(
                (x, -2.97, 0.8),
                (0.55 + 0.2 * (i % 2), 0, 0),
                (0, 0, 0.75),
                picture(colors[i], colors[(i + 2) % 6], float(i)),
            )
        )
        shapes.append(
            Quad(
                (x + 0.7, 3.17, 0.8),
                (0.8 - 0.2 * (i % 2), 0, 0),
                (0, 0, 0.6),
                picture(colors[(i + 3) % 6], colors[(i + 1) % 6], i + 9.0),
            )
        )
    shapes += [
        Block((3.0, -0.5, -1.0), (3.8, 0.3, 0.1), even(0.75, 0.75, 0.75)),
        Globe((3.4, -0.1, 0.45), 0.34, even(0.1, 0.1, 0.12)),
        Block((-3.6, 0.2, -1.0), (-2.0, 0.8, -0.5), even(0.05, 0.05, 0.05)),
    ]
    return cast(rays, shapes, (1.2, 1.2, 1.15))


def corridor(rays: Array) -> Array:
    """A long narrow hall: a line of ceiling lights, a bright glass door at one end,
    green walls.
    """
    shapes: list[Quad | Block | Globe] = list(
        room(
            (-9.0, -1.3, -0.9),
            (6.0, 1.3, 1.7),
            even(0.4, 0.52, 0.46),
            tiles(0.2, 0.34, 0.4, (1.0, 0.92, 0.8)),
            even(0.75, 0.75, 0.72),
        )
    )
    for x in (-7.0, -4.5, -2.0, 0.5, 3.0):
        shapes.append(
            Quad(
                (x, 0.0, 1.68),
                (0.5, 0, 0),
                (0, 0.14, 0),
                glow=softbox(11.0, (0.92, 1.0, 0.94)),
            )
        )
    shapes.append(
        Quad((5.98, 0.0, 0.2), (0, 0.9, 0), (0, 0, 1.05), glow=outlook(7.0, 2, 2))
    )
    for i, x in enumerate((-6.0, -3.2, -0.4, 2.4, 4.6)):
        for y, shift in ((-1.28, 0.0), (1.28, 1.0)):
            shapes.append(
                Quad(
                    (x + shift, y, 0.12),
                    (0.42, 0, 0),
                    (0, 0, 1.0),
                    even(*((0.3, 0.16, 0.08) if i % 2 else (0.12, 0.2, 0.34))),
                )
            )
    shapes.append(Block((1.2, 0.95, -0.9), (2.2, 1.3, -0.2), even(0.45, 0.3, 0.16)))
    return cast(rays, shapes, (0.9, 0.95, 0.9))


def loft(rays: Array) -> Array:
    """A brick loft late in the day: a row of steel-framed windows, a concrete floor,
    hanging lamps.
    """
    shapes: list[Quad | Block | Globe] = list(
        room(
            (-4.5, -3.2, -0.9),
            (3.6, 3.4, 2.6),
            bricks(0.42, 0.17, 0.1),
            even(0.3, 0.29, 0.28),
            even(0.32, 0.22, 0.14),
        )
    )
    for x in (-3.0, -0.6, 1.8):
        shapes.append(
            Quad(
                (x, 3.38, 0.9),
                (0.95, 0, 0),
                (0, 0, 1.2),
                glow=outlook(5.5, 4, 5, -0.6, 0.35),
            )
        )
    for x in (-1.5, 1.2):
        shapes.append(Globe((x, -0.9, 1.3), 0.16, glow=even(30.0, 20.0, 10.0)))
    for x in (-2.4, 0.4, 3.2):
        shapes.append(
            Block((x, -3.2, 2.3), (x + 0.25, 3.4, 2.6), even(0.16, 0.09, 0.05))
        )
    shapes += [
        Block((-4.5, -2.0, -0.9), (-3.7, 0.8, -0.1), even(0.2, 0.18, 0.16)),
        Block((0.8, -3.2, -0.9), (2.6, -2.4, -0.4), even(0.5, 0.22, 0.06)),
        Quad(
            (-1.2, -3.17, 0.8),
            (0.9, 0, 0),
            (0, 0, 0.6),
            picture((0.8, 0.75, 0.6), (0.15, 0.15, 0.18), 6.0),
        ),
    ]
    return cast(rays, shapes, (0.85, 0.68, 0.52))


_SCRIPT = "scenes/environments/rooms.py"
ROOMS = (
    EnvironmentFamily("studio", "train", studio, _SCRIPT),
    EnvironmentFamily("day-room", "train", day_room, _SCRIPT),
    EnvironmentFamily("kitchen", "train", kitchen, _SCRIPT),
    EnvironmentFamily("evening-room", "heldout", evening_room, _SCRIPT),
    EnvironmentFamily("gallery", "heldout", gallery, _SCRIPT),
    EnvironmentFamily("corridor", "heldout", corridor, _SCRIPT),
    EnvironmentFamily("loft", "heldout", loft, _SCRIPT),
)
