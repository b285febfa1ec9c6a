"""A crossing: the avenue with another one across it, zebras and a stop sign. Lengths
are metres.

The object stands at the origin as at the stop line, and the other street is `AHEAD` of
it.
"""

from __future__ import annotations

import numpy as np

from advsearch.scene.assets import Mesh
from advsearch.scene.geometry import make_rotation
from advsearch.scene.library import load_object
from scenes.places import avenue, paint
from scenes.places.avenue import (
    END,
    KERB,
    StreetPlan,
    Tree,
    asphalt,
    level,
    painted,
    street,
)
from scenes.places.houses import DEPTH
from scenes.places.models import Look, Node, Primitive, make_primitive
from scenes.places.paint import BAY, FRONTS
from scenes.places.quads import FRONT, TOP, Quads, Wall
from scenes.places.road import KERBS

AHEAD = 14.0  # x of the middle of the other street, which is as wide
MIDDLE = sum(KERBS) / 2.0
NEAR = AHEAD + MIDDLE - KERBS[1]  # x of its kerbs
FAR = AHEAD + MIDDLE - KERBS[0]
WEST = AHEAD + MIDDLE - FRONTS[1]  # x of its fronts
EAST = AHEAD + MIDDLE - FRONTS[0]
SIDE_END = 64.0
STOP = (3.6, 4.0)  # x of the stop line and of the zebra across the lane ahead
ZEBRA = (4.9, 7.9)
STRIPE = 0.5
SIGN = (4.4, -2.95)
SIGN_LOW = 1.5  # of the bundled stop sign's lower end over the pavement, on a post


def _ground() -> Quads:
    quads = Quads()
    side = Quads()
    (right, left) = KERBS
    (low, high) = FRONTS
    street(quads, -END, STOP[0] - 0.4)
    street(quads, STOP[0] - 0.4, NEAR, marked=False)
    street(quads, FAR, FAR + 5.0, marked=False)
    street(quads, FAR + 5.0, END)
    avenue.closed(quads)
    asphalt(quads, (NEAR, FAR), (low, high))
    for x, turn in ((NEAR, 1), (FAR, -1)):  # kerbs of the other street at the corners
        for y0, y1 in ((low, right), (left, high)):
            corners = np.array(
                [[(x, y0, 0.0), (x, y1, 0.0), (x, y1, KERB), (x, y0, KERB)]]
            )
            v = (right - 0.1 - low) / (high - low) + np.zeros(4)
            uvs = np.stack(
                [np.array([y0, y1, y1, y0]) / paint.GROUND_PERIOD, v], axis=-1
            )[None]
            quads.add(corners[:, ::turn], uvs[:, ::turn])
    # the other street, as if it ran along x
    for begin, end in ((-SIDE_END, low), (high, SIDE_END)):
        street(side, begin, end)
    for corners, uvs, normals in zip(side.corners, side.uvs, side.normals, strict=True):
        x, y, z = np.moveaxis(corners, -1, 0)
        quads.add(np.stack([AHEAD + MIDDLE - y, x, z], axis=-1), uvs, normals)
    painted(quads, STOP, (right + 0.6, MIDDLE - 0.2))
    painted(quads, (FAR + 4.0, FAR + 4.4), (MIDDLE + 0.2, left - 0.6))
    for first in (ZEBRA[0], FAR + 0.9):
        for y in np.arange(right + 0.55, left - STRIPE, 2.0 * STRIPE):
            painted(quads, (first, first + ZEBRA[1] - ZEBRA[0]), (y, y + STRIPE))
    for begin in (left + 0.9, right - 3.9):
        for x in np.arange(NEAR + 0.55, FAR - STRIPE, 2.0 * STRIPE):
            painted(quads, (x, x + STRIPE), (begin, begin + 3.0))
    return quads


def _sign() -> tuple[dict[str, Look], tuple[Node, ...]]:
    """Return the bundled stop sign on a post instead of its stand, each of its
    materials as one of its own.
    """
    asset = load_object("stop-sign")
    post = Quads()
    assert asset.size_in_metres is not None
    foot = np.array([*SIGN, KERB])
    low = np.array([*SIGN, KERB + SIGN_LOW])
    avenue.limb(post, foot, low + np.array([0.0, 0.0, 0.1]), 0.035, 0.035, 10)
    linear = asset.size_in_metres * make_rotation(180.0, 0.0, 0.0)
    mesh = asset.mesh
    vertices = (mesh.vertices.astype(np.float64) @ linear.T + low).astype(np.float32)
    normals = (
        mesh.normals.astype(np.float64) @ linear.T / asset.size_in_metres
    ).astype(np.float32)
    looks = dict[str, Look]()
    primitives = list[Primitive]()
    for name, look in (
        ("face", "sign"),
        ("metal", "sign-metal"),
        ("post", "sign-tube"),
    ):
        faces = mesh.faces[mesh.materials[name]]
        primitives.append(Primitive(Mesh(vertices, faces, normals, mesh.uvs), look))
        looks[look] = Look(asset.base_color, asset.finishes[name])
    looks["sign-post"] = Look(np.full(3, 0.45, np.float32), avenue.IRON)
    return looks, (Node(primitives), Node([make_primitive(post, "sign-post")]))


def _fronts() -> tuple[tuple[Wall, float, float, int], ...]:
    """Rows that begin and end with whole houses at the corners."""

    def row(length: float) -> float:
        return BAY * int(length / BAY) + 0.01

    long = row(END - EAST)
    west = row(END + WEST)
    east = row(SIDE_END - FRONTS[1] - DEPTH)
    (low, high) = FRONTS
    side = row(SIDE_END + FRONTS[0] - DEPTH)
    facing_east = Wall((WEST, 0.0, KERB), (1.0, 0.0, 0.0))
    facing_west = Wall((EAST, 0.0, KERB), (-1.0, 0.0, 0.0))
    return (
        (avenue.RIGHT, -WEST, -WEST + west, 1), (avenue.RIGHT, -EAST - long, -EAST, 6),
        (avenue.LEFT, WEST - west, WEST, 2), (avenue.LEFT, EAST, EAST + long, 7),
        (facing_east, high + DEPTH, high + DEPTH + east, 8), (facing_east, low - DEPTH - side, low - DEPTH, 9),
        (facing_west, -high - DEPTH - east, -high - DEPTH, 10), (facing_west, DEPTH - low, DEPTH - low + side, 11),
        (Wall((AHEAD, SIDE_END - 2.0, KERB), (0.0, -1.0, 0.0)), -20.0, 20.0, 12),
        (Wall((AHEAD, 2.0 - SIDE_END, KERB), (0.0, 1.0, 0.0)), -20.0, 20.0, 13),
        *avenue.ends(),
    )  # fmt: skip


def _clear(x: float) -> bool:
    return not WEST - 1.0 < x < EAST + 1.0


CROSSING = StreetPlan(
    _ground,
    _fronts(),
    (
        *(tree for tree in avenue.trees_along() if _clear(tree.x)),
        *(
            Tree((NEAR - 2.1, FAR + 2.1)[n % 2], y, n)
            for n, y in enumerate((24.0, 33.0, 42.0, -19.0, -28.0, -37.0))
        ),
    ),
    (
        *(post for post in avenue.posts_along() if _clear(post[0])),
        *avenue.posts_along((30.0, -1.0)),
    ),
    {
        "day": {"map": "avenue", "lux": 75000.0},
        "dusk": {"map": "avenue-dusk", "lux": 12.0},
        "night": {"map": "avenue-night", "lux": 0.3},
    },
    {"lane_width": 3.5, "valid": {"x": [-END, END], "y": [-SIDE_END, SIDE_END]}},
    *_sign(),
    (avenue.round_solid("the post of a sign", [SIGN], 0.035, KERB + SIGN_LOW),),
)


# ---------------------------------------------------------------------------------------------------------------------
# A car park: rows of bays along two lanes, with trees and lamps, and houses around it.
# Lengths are metres.
#
# The object stands in a bay at the origin, with its front towards a lane.

DEEP = 5.0  # of a bay, and how many are beside each other
WIDE = 2.5
BAYS = 17
# where rows begin in x: two back to back, then a lane, and so on
ROWS = (-18.5, -7.5, -2.5, 8.5, 13.5, 24.5)
LINE = 0.1
(BEGIN, CAR_PARK_END) = (-20.0, 31.0)
HALF = 24.0
WALK = 7.0
"""From and to in x, half of what it is in y, and how wide the pavement around it is."""


def _car_park_ground() -> Quads:
    quads = Quads()
    asphalt(quads, (BEGIN, CAR_PARK_END), (-HALF, HALF))
    edges = WIDE * (np.arange(BAYS + 1) - BAYS / 2.0)
    for x in ROWS:
        for y in edges:
            painted(quads, (x, x + DEEP), (y - LINE / 2.0, y + LINE / 2.0))
    for x in (-2.5, 13.5):  # between rows that stand back to back
        painted(quads, (x - LINE / 2.0, x + LINE / 2.0), (edges[0], edges[-1]))
    for ends in ((BEGIN - WALK, BEGIN), (CAR_PARK_END, CAR_PARK_END + WALK)):
        level(quads, ends, (-HALF - WALK, HALF + WALK), KERB, (-9.9, -9.9 + WALK))
    for sign in (-1.0, 1.0):
        level(
            quads,
            (BEGIN, CAR_PARK_END),
            (sign * HALF, sign * (HALF + WALK)),
            KERB,
            (-9.9, -9.9 + WALK),
        )
    around = [
        (BEGIN, HALF, CAR_PARK_END - BEGIN, (0.0, -1.0)),
        (CAR_PARK_END, -HALF, CAR_PARK_END - BEGIN, (0.0, 1.0)),
    ]
    around += [
        (BEGIN, -HALF, 2.0 * HALF, (1.0, 0.0)),
        (CAR_PARK_END, HALF, 2.0 * HALF, (-1.0, 0.0)),
    ]
    for x, y, long, (out_x, out_y) in around:  # kerbs
        frame = Wall((x, y, 0.0), (out_x, out_y, 0.0))
        shown = np.array([[0.0, long / 24.0, 0.345, 0.348]])
        quads.boxes(
            frame, np.array([[0.0, long, 0.0, 0.16, 0.0, KERB]]), shown, (FRONT, TOP)
        )
    return quads


CAR_PARK_MIDDLE = (BEGIN + CAR_PARK_END) / 2.0
OUT = HALF + WALK
CAR_PARK = StreetPlan(
    _car_park_ground,
    (
        (Wall((CAR_PARK_MIDDLE, OUT, KERB), (0.0, -1.0, 0.0)), -40.0, 40.0, 21),
        (Wall((CAR_PARK_MIDDLE, -OUT, KERB), (0.0, 1.0, 0.0)), -40.0, 40.0, 22),
        (Wall((BEGIN - WALK, 0.0, KERB), (1.0, 0.0, 0.0)), -40.0, 40.0, 23),
        (Wall((CAR_PARK_END + WALK, 0.0, KERB), (-1.0, 0.0, 0.0)), -40.0, 40.0, 24),
    ),
    tuple(
        Tree(x, sign * (HALF + 1.8), number, side)
        for side, sign in enumerate((-1.0, 1.0))
        for number, x in enumerate((-16.0, -8.5, 9.0, 17.0, 24.0))
    ),
    (
        *(
            (x, y, y + arm)
            for x in (-2.5, 13.5)
            for y, arm in ((-WIDE * 5.5, -1.7), (WIDE * 5.5, 1.7))
        ),
        *((-13.0, sign * (HALF + 0.6), sign * (HALF - 1.1)) for sign in (-1.0, 1.0)),
    ),
    CROSSING.lights,
)
