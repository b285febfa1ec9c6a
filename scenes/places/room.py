"""A room for what stands on tables: a table, shelves with books, a window and a lamp.
Lengths are metres.

The object stands at the origin, on the table. The room is closed: by day light comes
from the window, whose pane is painted with what is outside and shines, and in the
evening from the lamp on the ceiling.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from advsearch.scene.assets import Float32Array, Float64Array, Material
from scenes.places.models import Look, Node, PlaceModel, make_primitive
from scenes.places.paint import _clouds, _grain, tint
from scenes.places.quads import FRONT, SHOWN, Quads, Wall
from scenes.places.road import shown

LOW = (-1.75, -2.0, -0.75)  # corners of the room
HIGH = (2.6, 1.9, 1.85)
# from and to in x and y of its top, which is at height 0
TABLE = ((-0.45, 0.45), (-0.8, 0.8))
THICK = 0.035
CASE = ((-1.75, -1.46), (-1.5, 1.1))
BOARDS = (-0.69, -0.33, 0.03, 0.39, 0.75, 1.11)
"""From and to in x and y of the shelves at the wall, and the heights of their
boards.
"""
# from and to in x and z, in the wall at the largest y
WINDOW = ((-0.9, 1.5), (0.12, 1.5))
REVEAL = 0.16  # how far the pane stands back, and half a side of the lamp
LAMP = 0.24
# luminance of the window's sky by day and by night, and of the lamp, cd/m2
DAY = 2600.0
NIGHT = 0.6
SHADE = 4200.0
STRIP = 0.5
TEXEL = 0.0125
COLUMNS = 96
"""How high each strip of the texture is, how large a texel, and how many there are
along a strip of 1.2 m.
"""
OUTSIDE = 1000.0  # how far what lies behind a wall reaches
LONG = TEXEL * COLUMNS
PLANKS, PLASTER, OAK, WHITE = range(4)
COLORS = (  # linear reflectance; behind the first five, of books
    (0.20, 0.115, 0.062), (0.62, 0.58, 0.51), (0.34, 0.19, 0.095), (0.66, 0.65, 0.62), (0.09, 0.09, 0.09),
    (0.32, 0.05, 0.04), (0.05, 0.11, 0.24), (0.07, 0.17, 0.10), (0.42, 0.30, 0.09), (0.50, 0.46, 0.38),
    (0.10, 0.07, 0.05), (0.22, 0.26, 0.30), (0.36, 0.16, 0.07),
)  # fmt: skip
BOOKS = tuple(range(5, len(COLORS)))
MATT = Material(roughness=0.8, specular=0.3)
VARNISH = Material(roughness=0.35, specular=0.45)


def make_room() -> PlaceModel:
    """Return the room by day, with the evening as a variant."""
    texture = _texture()
    outside = _outside()
    black = np.full(3, 0.02, np.float32)
    white = np.full(3, 0.8, np.float32)
    lamp = np.array((1.0, 0.82, 0.56), np.float32) * np.float32(SHADE)
    ground = Quads()
    pane = Quads()
    ceiling = Quads()
    _flat(ground, (LOW[0], HIGH[0]), (LOW[1], HIGH[1]), LOW[2], PLANKS)
    _flat(ground, *TABLE, 0.0, OAK)
    wall = Wall((0.0, HIGH[1] + REVEAL, 0.0), (0.0, -1.0, 0.0))
    pane.wall(
        wall,
        np.array([[*WINDOW[0], *WINDOW[1]]]),
        0.0,
        np.array([[0.0, 1.0, 0.0, 1.0]]),
    )
    _flat(ceiling, (0.3 - LAMP, 0.3 + LAMP), (-LAMP, LAMP), HIGH[2] - 0.06, WHITE, -1)
    looks = {
        "floor": Look(texture, VARNISH),
        "walls": Look(texture, MATT),
        "furniture": Look(texture, VARNISH),
        "books": Look(texture, MATT),
        "window": Look(black, VARNISH, outside * np.float32(DAY)),
        "dark-window": Look(black, VARNISH, outside * np.float32(NIGHT)),
        "lamp": Look(white, MATT),
        "lit-lamp": Look(white, MATT, lamp),
    }
    nodes = (
        Node([make_primitive(ground, "floor")]),
        Node([make_primitive(_walls(), "walls")]),
        Node([make_primitive(_furniture(), "furniture")]),
        Node([make_primitive(_books(), "books")]),
        Node([make_primitive(pane, "window", evening="dark-window")]),
        Node([make_primitive(ceiling, "lamp", evening="lit-lamp")]),
    )
    file = {
        "ground": ["floor"],
        "floor": LOW[2],
        "lights": {
            "day": {"map": "room", "lux": 200.0},
            "evening": {"map": "room-evening", "lux": 120.0, "variant": "evening"},
        },
        "solids": [*_solid_walls(), *_solid_furniture(), _solid_ceiling()],
    }
    return PlaceModel(looks, nodes, file)


def _texture() -> Float32Array:
    """All strips, row 0 at v = 1: (h, w, 3) display-referred multiples of 1/255."""
    rows = round(STRIP / TEXEL)
    fine = _grain(rows * len(COLORS), COLUMNS, 700)
    cloud = _clouds(rows * len(COLORS), COLUMNS, 16, 701)
    strips = []
    for number, color in enumerate(COLORS):
        part = slice(rows * number, rows * (number + 1))
        tone = 1.0 + 0.05 * fine[part] + 0.04 * cloud[part]
        if number in (PLANKS, OAK):  # grain along the strip
            tone = tone + 0.10 * np.repeat(
                cloud[part][:, :1] + 0.6 * fine[part][:, :1], COLUMNS, axis=1
            )
        if number == PLANKS:
            board = np.arange(rows) // 10
            shade = np.random.Generator(np.random.PCG64(702)).uniform(
                0.75, 1.2, (rows // 10, 2)
            )
            halves = (np.arange(COLUMNS)[None] + 37 * board[:, None]) % COLUMNS
            tone = (
                tone * shade[board[:, None], (halves >= COLUMNS // 2).astype(np.int64)]
            )
            joint = (np.arange(rows) % 10 == 0)[:, None] | np.isin(
                halves, (0, COLUMNS // 2)
            )
            tone = np.where(joint, 0.55 * tone, tone)
        strips.append(tint(color) * tone[..., None])
    return shown(np.clip(np.concatenate(strips), 0.004, 0.9).astype(np.float32)[::-1])


def _outside() -> Float32Array:
    """What is seen through the window, 1 for the sky, row 0 above: sky, trees and a
    lawn behind glazing bars.
    """
    wide = 400
    high = 240
    u, v = np.meshgrid(
        (np.arange(wide) + 0.5) / wide, 1.0 - (np.arange(high) + 0.5) / high
    )
    cloud = _clouds(high, wide, 48, 704).astype(np.float64)
    sky = np.array([0.80, 0.92, 1.0]) * (0.8 + 0.35 * v + 0.08 * cloud)[..., None]
    trees = 0.34 + 0.09 * cloud[:1] + 0.04 * np.sin(9.0 * u)
    green = (
        np.array([0.09, 0.13, 0.055])
        * (np.where(v < 0.16, 1.8, 0.75) * (1.0 + 0.4 * cloud))[..., None]
    )
    return np.asarray(np.where((v < trees)[..., None], green, sky), np.float32)


def _solid_box(
    name: str,
    x: tuple[float, float],
    y: tuple[float, float],
    heights: tuple[float, float],
) -> dict[str, Any]:
    outline = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
    return {
        "name": name,
        "outline": [list(corner) for corner in outline],
        "heights": list(heights),
    }


def _solid_walls() -> list[dict[str, Any]]:
    """Return what lies behind the four walls."""
    (x0, y0, _) = LOW
    (x1, y1, _) = HIGH
    heights = (LOW[2], HIGH[2])
    wide = (x0 - OUTSIDE, x1 + OUTSIDE)
    deep = (y0 - OUTSIDE, y1 + OUTSIDE)
    sides = (
        ((wide[0], x0), deep),
        ((x1, wide[1]), deep),
        (wide, (deep[0], y0)),
        (wide, (y1, deep[1])),
    )
    return [_solid_box("a wall", x, y, heights) for x, y in sides]


def _solid_ceiling() -> dict[str, Any]:
    """Return what lies above the ceiling, where its lamp hangs."""
    wide = (LOW[0] - OUTSIDE, HIGH[0] + OUTSIDE)
    deep = (LOW[1] - OUTSIDE, HIGH[1] + OUTSIDE)
    return _solid_box("the ceiling", wide, deep, (HIGH[2], HIGH[2] + OUTSIDE))


def _solid_furniture() -> list[dict[str, Any]]:
    """Return what shelves and table top take up."""
    name = "a piece of furniture"
    return [
        _solid_box(name, *CASE, (LOW[2], BOARDS[-1])),
        _solid_box(name, *TABLE, (-THICK, -0.001)),
    ]


def _rows(
    strip: int, low: Float64Array | float, high: Float64Array | float
) -> tuple[Float64Array, Float64Array]:
    """v of the lower and the upper edge of something that shows a strip, which is only
    so high.
    """
    first = STRIP * strip + 0.02
    reach = np.minimum(np.asarray(high) - np.asarray(low), STRIP - 0.04)
    return first / (STRIP * len(COLORS)) + 0.0 * reach, (first + reach) / (
        STRIP * len(COLORS)
    )


def _block(
    quads: Quads,
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    strip: int,
) -> None:
    low, high = map(float, _rows(strip, *z))
    for out, row in (
        (-1.0, (*x, -y[1], -y[0], *z)),
        (1.0, (-x[1], -x[0], y[0], y[1], *z)),
    ):
        uvs = np.array([[row[0] / LONG, row[1] / LONG, low, high]])
        faces = SHOWN if out < 0.0 else (FRONT,)
        quads.boxes(Wall((0.0, 0.0, 0.0), (0.0, out, 0.0)), np.array([row]), uvs, faces)


def _flat(
    quads: Quads,
    x: tuple[float, float],
    y: tuple[float, float],
    z: float,
    strip: int,
    up: int = 1,
) -> None:
    """Add a level rectangle that faces up or down, in stripes along y that show the
    strip over and over.
    """
    edges = np.linspace(*x, max(1, round((x[1] - x[0]) / (STRIP - 0.1))) + 1)
    for x0, x1 in pairwise(edges):
        low, high = _rows(strip, x0, x1)
        along = np.array([y[0], y[0], y[1], y[1]]) / LONG + x0
        across = np.array([low, high, high, low])
        quads.level((x0, x1), y, z, np.stack([along, across], axis=-1), up)


def _walls() -> Quads:
    quads = Quads()
    _flat(quads, (LOW[0], HIGH[0]), (LOW[1], HIGH[1]), HIGH[2], WHITE, -1)
    (left, right), (sill, head) = WINDOW

    def wall(frame: Wall, *rows: tuple[float, float, float, float]) -> None:
        places = np.array(rows)
        uvs = np.column_stack(
            [places[:, :2] / LONG, *_rows(PLASTER, places[:, 2], places[:, 3])]
        )
        quads.wall(frame, places, 0.0, uvs)

    heights = (LOW[2], HIGH[2])
    sides = (
        (Wall((LOW[0], 0.0, 0.0), (1.0, 0.0, 0.0)), LOW[1], HIGH[1]),
        (Wall((HIGH[0], 0.0, 0.0), (-1.0, 0.0, 0.0)), -HIGH[1], -LOW[1]),
        (Wall((0.0, LOW[1], 0.0), (0.0, 1.0, 0.0)), -HIGH[0], -LOW[0]),
    )
    for frame, begin, end in sides:
        wall(frame, (begin, end, *heights))
    lit = Wall((0.0, HIGH[1], 0.0), (0.0, -1.0, 0.0))
    wall(lit, (LOW[0], left, *heights), (right, HIGH[0], *heights))
    wall(lit, (left, right, LOW[2], sill), (left, right, head, HIGH[2]))
    for frame, begin, end in (*sides, (lit, LOW[0], HIGH[0])):  # skirting boards
        uvs = np.array(
            [[begin / LONG, end / LONG, *map(float, _rows(WHITE, 0.0, 0.09))]]
        )
        quads.boxes(
            frame, np.array([[begin, end, 0.0, 0.015, LOW[2], LOW[2] + 0.09]]), uvs
        )
    back = HIGH[1] + REVEAL
    _block(
        quads,
        (left - 0.05, right + 0.05),
        (HIGH[1] - 0.12, back),
        (sill - 0.03, sill),
        WHITE,
    )
    _block(
        quads, (left - 0.02, right + 0.02), (HIGH[1], back), (head, head + 0.03), WHITE
    )
    for x in (left, right):
        _block(
            quads,
            (x - 0.03, x) if x == left else (x, x + 0.03),
            (HIGH[1], back),
            (sill, head),
            WHITE,
        )
    for x in np.linspace(left, right, 4):
        _block(
            quads,
            (x - 0.025, x + 0.025),
            (back - 0.05, back - 0.01),
            (sill, head),
            WHITE,
        )
    for z in (sill, head - 0.4, head):
        _block(
            quads,
            (left, right),
            (back - 0.045, back - 0.015),
            (z - 0.025, z + 0.025),
            WHITE,
        )
    return quads


def _furniture() -> Quads:
    quads, ((x0, x1), (y0, y1)) = Quads(), TABLE
    under = 0.001
    # the top itself is what things stand on
    _block(quads, (x0, x1), (y0, y1), (-THICK, -under), OAK)
    for x in (x0 + 0.04, x1 - 0.1):
        for y in (y0 + 0.04, y1 - 0.1):
            _block(quads, (x, x + 0.06), (y, y + 0.06), (LOW[2], -THICK), OAK)
    for y in (y0 + 0.05, y1 - 0.075):
        _block(
            quads, (x0 + 0.1, x1 - 0.1), (y, y + 0.025), (-THICK - 0.09, -THICK), OAK
        )
    (back, front), (begin, end) = CASE
    for z in BOARDS:
        _block(quads, (back, front), (begin, end), (z - 0.025, z), WHITE)
    for y in (begin - 0.025, (begin + end) / 2.0 - 0.0125, end):
        _block(quads, (back, front), (y, y + 0.025), (LOW[2], BOARDS[-1]), WHITE)
    _block(quads, (back, back + 0.01), (begin, end), (LOW[2], BOARDS[-1]), WHITE)
    return quads


def _books() -> Quads:
    quads = Quads()
    rng = np.random.Generator(np.random.PCG64(703))
    (_, front), (begin, end) = CASE
    halves = (
        (begin + 0.02, (begin + end) / 2.0 - 0.03),
        ((begin + end) / 2.0 + 0.03, end - 0.02),
    )
    for z in BOARDS[:-1]:
        for first, last in halves:
            y = first
            stop = last - rng.uniform(0.0, 0.45)
            while y < stop - 0.05:
                wide = rng.uniform(0.018, 0.05)
                high = rng.uniform(0.19, 0.30)
                deep = rng.uniform(0.15, 0.23)
                _block(
                    quads,
                    (front - 0.03 - deep, front - 0.03),
                    (y, y + wide),
                    (z, z + high),
                    int(rng.choice(BOOKS)),
                )
                y += wide + 0.002
    return quads
