"""Streets as geometry: road between pavements and houses, with trees and lamps. Lengths
are metres.

The avenue is 300 m long and runs along x. The object stands at the origin, in the lane
of those who drive towards +x. At both ends it meets another street, whose houses close
the view; beyond them lies a plain to the horizon. What stands where is a `StreetPlan`;
`crossing.py` is made of the same parts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from advsearch.scene.assets import Float32Array, Float64Array, Material
from advsearch.scene.color import linear_to_srgb
from scenes.places import paint
from scenes.places.houses import DEPTH, Fronts
from scenes.places.models import Look, Node, PlaceModel, Primitive, make_primitive
from scenes.places.quads import FRONT, SHOWN, Quads, Wall
from scenes.places.road import DRY, KERBS, WET, shown

END = 150.0  # where the street ends, how wide what it meets is, how far the plain goes
CROSSING = 12.0
FAR = 4000.0
KERB = 0.12
TREES = (
    -118.0,
    -97.0,
    -76.0,
    -55.0,
    -34.0,
    -15.0,
    22.0,
    43.0,
    64.0,
    85.0,
    106.0,
    127.0,
)
"""x of the trees on the right; those on the left stand 9 m on."""
# x of the lamp posts, to the right and to the left in turn
POSTS = tuple(range(-135, 150, 30))
POST_AT = (-3.05, 6.55)  # y of the posts and of the trees, on the right and on the left
TREE_AT = (-4.4, 7.9)
LAMP_HEIGHT = 7.5
ARM = 1.7
POST = 0.1  # radii of posts and trunks, and how high a trunk is at least
TRUNK = 0.14
TRUNK_HEIGHT = 2.5
LAMP_SIZE = (0.36, 0.22)  # of the area that shines, level
WALL = Material(roughness=0.85, specular=0.25)  # fmt: skip
PANE = Material(roughness=0.06, specular=0.6)
LEAF = Material(roughness=0.7, specular=0.25)
IRON = Material(roughness=0.45, specular=0.5)
WET_WALL = Material(roughness=0.5, specular=0.4)
# luminance by night, cd/m2: a lamp puts 15 lux on the road below it (7.5 m, 0.36 x 0.22
# m)
LAMPS = {
    "street-lamps": (10650.0 * 1.16, 10650.0 * 0.98, 10650.0 * 0.73),
    "lit-windows": (36.0, 23.5, 10.0),
    "shops": (62.0, 48.0, 31.0),
}


class Tree(NamedTuple):
    """Where a tree stands; the two numbers choose its kind, turn and size."""

    x: float
    y: float
    number: int
    side: int = 0


@dataclass(frozen=True, eq=False)
class StreetPlan:
    """What stands where."""

    ground: Callable[[], Quads]  # makes road and pavements
    # of houses: walls, from where to where along them, seeds
    fronts: tuple[tuple[Wall, float, float, int], ...]
    trees: tuple[Tree, ...]
    # (x, y) of the foot of each lamp post, and y of its lamp
    posts: tuple[tuple[float, float, float], ...]
    lights: Mapping[str, Mapping[str, Any]]  # as its YAML file has them
    # further entries of that file
    more: Mapping[str, Any] = field(default_factory=dict)
    looks: Mapping[str, Look] = field(default_factory=dict)  # further materials
    nodes: tuple[Node, ...] = ()  # and what has them
    solids: tuple[Mapping[str, Any], ...] = ()
    has_weather: bool = False  # whether it may be wet, or lie in snow


def make_street(plan: StreetPlan) -> PlaceModel:
    """Return a street with all that stands in it."""
    rows = _houses(plan.fronts)
    iron, lamps = _posts(plan.posts)
    plain = Quads()
    corners = FAR * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    plain.level((-FAR, FAR), (-FAR, FAR), -0.05, corners / 50.0)
    weather = plan.has_weather
    roads = {"wet": "wet-road", "snow": "snowy-road"} if weather else {}
    plains = {"snow": "snowy-plain"} if weather else {}
    walls = {"wet": "wet-houses"} if weather else {}
    nodes = [
        Node([make_primitive(plan.ground(), "road", **roads)]),
        Node(_swept(rows.walls, "houses", weather, **walls)),
        Node([make_primitive(rows.dark, "windows")]),
        Node([make_primitive(rows.lit, "lit-windows")]),
        Node([make_primitive(rows.shops, "shops")]),
        *_tree_nodes(plan.trees, weather),
        Node(_swept(iron, "posts", weather)),
        Node([make_primitive(lamps, "street-lamps")]),
        Node([make_primitive(plain, "plain", **plains)]),
        *plan.nodes,
    ]
    used = {
        look
        for node in nodes
        for one in node.primitives
        for look in (one.look, *one.variants.values())
    }
    looks = {
        name: look
        for name, look in {**_make_looks(), **plan.looks}.items()
        if name in used
    }
    file = {
        "ground": ["road"],
        "lamps": {name: list(luminance) for name, luminance in LAMPS.items()},
        **plan.more,
        "lights": {name: dict(light) for name, light in plan.lights.items()},
        "solids": [*_list_solids(plan), *map(dict, plan.solids)],
    }
    return PlaceModel(looks, nodes, file)


def _make_looks() -> dict[str, Look]:
    tone = (
        1.0
        + 0.25 * paint._clouds(128, 128, 32, 400)
        + 0.2 * paint._grain(128, 128, 401)
    )
    grass = linear_to_srgb(
        np.clip(paint.tint((0.075, 0.095, 0.045)) * tone[..., None], 0.0, 1.0)
    )
    walls = shown(paint.walls())
    panes = shown(paint.panes())
    white = np.full(3, 0.9, np.float32)
    return {
        "road": Look(shown(paint.road(False)), DRY),
        "wet-road": Look(shown(paint.road(True)), WET),
        "snowy-road": Look(shown(paint.road(False, True)), DRY),
        "houses": Look(walls, WALL),
        "wet-houses": Look(walls, WET_WALL),
        "windows": Look(panes, PANE),
        "lit-windows": Look(panes, PANE),
        "shops": Look(panes, PANE),
        "trees": Look(_leaves(), LEAF),
        "posts": Look(np.full(3, 0.25, np.float32), IRON),
        "street-lamps": Look(white, PANE),
        "plain": Look(grass, WALL),
        "snowy-plain": Look(white, WALL),
        "snow": Look(white, WALL),
    }


def _swept(quads: Quads, look: str, has_snow: bool, **variants: str) -> list[Primitive]:
    """Return what does not face up, and what does, which snow may lie on."""
    if not has_snow:
        return [make_primitive(quads, look, **variants)]
    fallen = Quads()
    bare = quads.swept(fallen)
    return [
        make_primitive(bare, look, **variants),
        make_primitive(fallen, look, **variants, snow="snow"),
    ]


def _tree_nodes(trees: tuple[Tree, ...], has_snow: bool) -> list[Node]:
    kinds = [_swept(_tree(seed), "trees", has_snow) for seed in range(3)]
    nodes = []
    for x, y, number, side in trees:
        turn = 2.4 * number + side
        size = 0.9 + 0.2 * ((5 * number + 3 * side) % 7) / 7.0
        pose = np.eye(4)
        pose[:2, :2] = np.array(
            [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        )
        pose[:3, :3] *= size
        pose[:3, 3] = x, y, KERB
        nodes.append(Node(kinds[(number + side) % len(kinds)], pose))
    return nodes


def _list_solids(plan: StreetPlan) -> list[dict[str, Any]]:
    top = paint.GROUND_FLOOR + 2.0 * paint.FLOOR  # of the lowest house
    houses = []
    for frame, begin, end, _ in plan.fronts:
        along = np.array([begin, end, end, begin])
        out = np.array([0.0, 0.0, -DEPTH, -DEPTH])
        outline = frame.world(along, out, np.zeros(4))[:, :2]
        houses.append(
            {"name": "a house", "outline": outline.tolist(), "heights": [0.0, top]}
        )
    return [
        *houses,
        round_solid(
            "the trunk of a tree",
            [(tree.x, tree.y) for tree in plan.trees],
            TRUNK,
            KERB + TRUNK_HEIGHT,
        ),
        round_solid(
            "a lamp post", [(x, y) for x, y, _ in plan.posts], POST, KERB + LAMP_HEIGHT
        ),
    ]


def round_solid(
    name: str, positions: Sequence[tuple[float, float]], radius: float, top: float
) -> dict[str, Any]:
    """Return what something round takes up from the ground to its top, as the YAML file
    has it.
    """
    return {
        "name": name,
        "at": [list(map(float, at)) for at in positions],
        "radius": radius,
        "heights": [0.0, top],
    }


def _houses(fronts: tuple[tuple[Wall, float, float, int], ...]) -> Fronts:
    row = Fronts()
    for frame, begin, end, seed in fronts:
        row.build(frame, begin, end, seed)
    return row


def level(
    quads: Quads,
    x: Sequence[float],
    y: Sequence[float],
    z: float,
    v: tuple[float, float] | None = None,
) -> None:
    """Add a level rectangle of ground; `v` are the y whose ground it shows, its own
    unless given.
    """
    (x0, x1) = sorted(x)
    (y0, y1) = sorted(y)
    u = np.array([x0, x1, x1, x0]) / paint.GROUND_PERIOD
    quads.level(
        (x0, x1),
        (y0, y1),
        z,
        np.stack([u, _shown(*(v or (y0, y1)))[[0, 0, 1, 1]]], axis=-1),
    )


def _shown(*y: float) -> Float64Array:
    """Texture coordinates of the ground at y."""
    return (np.array(y) - paint.FRONTS[0]) / (paint.FRONTS[1] - paint.FRONTS[0])


ASPHALT = (2.4, 5.2)  # y between which the ground has no markings


def asphalt(quads: Quads, x: tuple[float, float], y: tuple[float, float]) -> None:
    """Add a road without markings, in strips that show different parts of it."""
    count = max(1, round((y[1] - y[0]) / (ASPHALT[1] - ASPHALT[0])))
    for number, edges in enumerate(pairwise(np.linspace(*y, count + 1))):
        rows = _shown(*ASPHALT[:: -1 if number % 2 else 1])
        u = (np.array([x[0], x[1], x[1], x[0]]) + 7.3 * number) / paint.GROUND_PERIOD
        quads.level(x, edges, 0.0, np.stack([u, rows[[0, 0, 1, 1]]], axis=-1))


def painted(quads: Quads, x: tuple[float, float], y: tuple[float, float]) -> None:
    """Add a rectangle of white paint on a road: it shows the line along the kerb."""
    line = _shown(KERBS[0] + 0.45 - 0.04, KERBS[0] + 0.45 + 0.04)
    corners = np.array([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])])
    along = (corners - corners[:1]).sum(axis=-1) / paint.GROUND_PERIOD + x[0] + y[0]
    quads.level(x, y, 0.004, np.stack([along, line[[0, 0, 1, 1]]], axis=-1))


def street(quads: Quads, begin: float, end: float, *, marked: bool = True) -> None:
    """Add a road along x with its pavements and kerbs."""
    low, high = paint.FRONTS
    right, left = KERBS
    if marked:
        level(quads, (begin, end), (right, left), 0.0)
    else:
        asphalt(quads, (begin, end), (right, left))
    for edge, wall, out in ((right, low, 1.0), (left, high, -1.0)):
        level(quads, (begin, end), (edge, wall), KERB)
        corners = [
            (begin, edge, 0.0),
            (end, edge, 0.0),
            (end, edge, KERB),
            (begin, edge, KERB),
        ]
        v = (edge - out * np.array([0.02, 0.02, 0.1, 0.1]) - low) / (high - low)
        uvs = np.stack(
            [np.array([begin, end, end, begin]) / paint.GROUND_PERIOD, v], axis=-1
        )
        quads.add(np.array([corners])[:, :: int(-out)], uvs[None, :: int(-out)])


def closed(quads: Quads) -> None:
    """Add the streets that a street along x meets at its ends."""
    for sign in (-1.0, 1.0):
        level(
            quads, (sign * END, sign * (END + CROSSING)), (-64.0, 64.0), 0.0, (2.4, 5.2)
        )
        level(
            quads,
            (sign * (END + CROSSING), sign * (END + CROSSING + 4.0)),
            (-64.0, 64.0),
            KERB,
            (-9.9, -6.0),
        )


def _ground() -> Quads:
    quads = Quads()
    street(quads, -END, END)
    closed(quads)
    return quads


LEAVES = 3800
CLUMPS = 40


def _tree(seed: int) -> Quads:
    """A trunk, some boughs and leaves in clumps, which are shaded as the clump is
    round.
    """
    rng = np.random.Generator(np.random.PCG64(500 + seed))
    quads = Quads()
    limb(quads, np.array([0.0, 0.0, 0.0]), np.array([0.05, 0.03, 3.0]), 0.17, 0.12)
    way = rng.normal(size=(CLUMPS, 3))
    way *= rng.uniform(0.55, 1.0, (CLUMPS, 1)) / np.linalg.norm(
        way, axis=1, keepdims=True
    )
    middle = np.array([0.0, 0.0, 5.2]) + way * [1.75, 1.75, 2.3]
    for at in middle[:9]:
        limb(quads, np.array([0.05, 0.03, 2.8]), at, 0.08, 0.025)
    clump = rng.integers(CLUMPS, size=LEAVES)
    away = rng.normal(size=(LEAVES, 3))
    away *= rng.random((LEAVES, 1)) ** 0.4 / np.linalg.norm(away, axis=1, keepdims=True)
    place = middle[clump] + away * [0.85, 0.85, 0.7]
    along, aside = rng.normal(size=(2, LEAVES, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    aside -= (aside * along).sum(axis=1, keepdims=True) * along
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    size = rng.uniform(0.075, 0.135, (LEAVES, 1))
    corners = (
        place[:, None]
        + np.stack([-along, -0.5 * aside, along, 0.5 * aside], axis=1) * size[:, None]
    )
    round_ = (
        0.7 * away
        + 0.5 * (place - [0.0, 0.0, 4.9]) / [1.75, 1.75, 2.3]
        + [0.0, 0.0, 0.25]
    )
    round_ /= np.linalg.norm(round_, axis=1, keepdims=True)
    flat = np.cross(along, aside)
    flat *= np.sign((flat * round_).sum(axis=1, keepdims=True))
    turned = np.where(
        (
            np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
            * flat
        ).sum(1)
        < 0.0
    )[0]
    corners[turned] = corners[turned, ::-1]
    shading = 0.75 * round_ + 0.5 * flat
    shading /= np.linalg.norm(shading, axis=1, keepdims=True)
    u = rng.random((LEAVES, 1, 1)) * 0.5 + 0.48
    uvs = np.concatenate(
        [u + 0.0 * corners[..., :1], 0.5 + 0.0 * corners[..., :1]], axis=-1
    )
    quads.add(corners, uvs, np.repeat(shading[:, None], 4, axis=1))
    return quads


def _leaves() -> Float32Array:
    t = np.linspace(0.0, 1.0, 16, dtype=np.float32)[None, :, None]
    green = (
        paint.tint((0.055, 0.105, 0.022)) * (1.0 - t)
        + paint.tint((0.13, 0.19, 0.04)) * t
    )
    bark = paint.tint((0.085, 0.065, 0.048)) * (1.0 + 0.3 * t)
    return linear_to_srgb(np.concatenate([bark, green], axis=1).repeat(2, axis=0))


def limb(
    quads: Quads,
    start: Float64Array,
    end: Float64Array,
    thick: float,
    thin: float,
    sides: int = 7,
) -> None:
    """A tapering round limb from one place to another."""
    ahead = (end - start) / np.linalg.norm(end - start)
    aside = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    aside /= np.linalg.norm(aside)
    above = np.cross(ahead, aside)
    turn = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.cos(turn)[:, None] * aside + np.sin(turn)[:, None] * above
    low = start + thick * ring
    high = end + thin * ring
    corners = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
    normals = np.stack([ring[:-1], ring[1:], ring[1:], ring[:-1]], axis=1)
    uvs = (
        np.broadcast_to([0.2, 0.5], (sides, 4, 2))
        + np.array([0.08, 0.0]) * np.arange(sides)[:, None, None] / sides
    )
    quads.add(corners, uvs, normals)


def lamp_places(posts: Sequence[tuple[float, float, float]]) -> Float64Array:
    """Return where the middle of each shining area is, (N, 3) metres."""
    return np.array([(x, lamp, KERB + LAMP_HEIGHT - 0.07) for x, _, lamp in posts])


def _posts(posts: Sequence[tuple[float, float, float]]) -> tuple[Quads, Quads]:
    """The posts with their heads, and the areas that shine, facing down."""
    quads = Quads()
    shining = Quads()
    half = LAMP_SIZE[0] / 2 + 0.06
    wide = LAMP_SIZE[1] / 2 + 0.05
    level = np.array([(-1, -1, 0), (-1, 1, 0), (1, 1, 0), (1, -1, 0)]) * [
        LAMP_SIZE[1] / 2.0,
        LAMP_SIZE[0] / 2.0,
        0.0,
    ]
    for (x, y, z), (_, at, _) in zip(lamp_places(posts), posts, strict=True):
        foot = np.array([x, at, KERB])
        top = foot + np.array([0.0, 0.0, LAMP_HEIGHT])
        limb(quads, foot, foot + np.array([0.0, 0.0, 1.1]), 0.11, 0.1, 10)
        limb(quads, foot + np.array([0.0, 0.0, 1.0]), top, 0.07, 0.045, 10)
        limb(
            quads,
            top - [0.0, 0.0, 0.06],
            np.array([x, y, top[2] + 0.02]),
            0.04,
            0.03,
            8,
        )
        head = Wall((x, y, z), (0.0, -1.0 if at < y else 1.0, 0.0))
        quads.boxes(
            head,
            np.array([[-wide, wide, -half - 0.1, half, 0.004, 0.12]]),
            np.zeros((1, 4)),
            SHOWN,
        )
        back = Wall((x, y, z), tuple(-np.array(head.out)))
        quads.boxes(
            back,
            np.array([[-wide, wide, 0.0, half + 0.1, 0.004, 0.12]]),
            np.zeros((1, 4)),
            (FRONT,),
        )
        shining.add(np.array([[(x, y, z)]]) + level, np.zeros((1, 4, 2)) + 0.5)
    return quads, shining


def trees_along() -> tuple[Tree, ...]:
    """Return the trees on both sides of a street, those on the left 9 m on."""
    return tuple(
        Tree(x + 9.0 * side, y, n, side)
        for side, y in enumerate(TREE_AT)
        for n, x in enumerate(TREES)
    )


def posts_along(xs: Sequence[float] = POSTS) -> tuple[tuple[float, float, float], ...]:
    """Return the posts of a street, to the right and to the left in turn."""
    reach = (ARM, -ARM)
    return tuple(
        (x, POST_AT[n % 2], POST_AT[n % 2] + reach[n % 2]) for n, x in enumerate(xs)
    )


def ends() -> tuple[tuple[Wall, float, float, int], ...]:
    """Return the houses that close a street along x at either end."""
    away = END + CROSSING + 4.0
    return (
        (Wall((away, 0.0, KERB), (-1.0, 0.0, 0.0)), -62.0, 62.0, 3),
        (Wall((-away, 0.0, KERB), (1.0, 0.0, 0.0)), -62.0, 62.0, 4),
    )


RIGHT, LEFT = (  # walls on either side of a street along x; along the right one x falls
    Wall((0.0, paint.FRONTS[0], KERB), (0.0, 1.0, 0.0)), Wall((0.0, paint.FRONTS[1], KERB), (0.0, -1.0, 0.0)),
)  # fmt: skip
AVENUE = StreetPlan(
    _ground,
    ((RIGHT, -END, END, 1), (LEFT, -END, END, 2), *ends()),
    trees_along(),
    posts_along(),
    {
        "day": {"map": "avenue", "lux": 75000.0},
        "wet": {"map": "avenue-wet", "lux": 9000.0, "variant": "wet"},
        "snow": {"map": "avenue-wet", "lux": 9000.0, "variant": "snow"},
        "dusk": {"map": "avenue-dusk", "lux": 12.0},
        "night": {"map": "avenue-night", "lux": 0.3},
    },
    {"lane_width": 3.5, "valid": {"x": [-END, END]}},
    has_weather=True,
)
