"""Streets as geometry: road between pavements and houses, with trees and lamps. Lengths are metres.

The avenue is 300 m long and runs along x. The object stands at the origin, in the lane of those who drive towards +x.
At both ends it meets another street, whose houses close the view; beyond them lies a plain to the horizon. What stands
where is a `StreetPlan`; `crossing.py` is made of the same parts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from advsearch.scene.assets import Doubles, Floats, Material
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.parts import Footprint, MeshPart
from advsearch.scene.places import paint
from advsearch.scene.places.houses import DEPTH, Fronts
from advsearch.scene.places.quads import DRY, FRONT, KERBS, ROAD, SHOWN, WET, Quads, Wall, shown

END, CROSSING, FAR = 150.0, 12.0, 4000.0  # where the street ends, how wide what it meets is, how far the plain goes
KERB = 0.12
TREES = (-118.0, -97.0, -76.0, -55.0, -34.0, -15.0, 22.0, 43.0, 64.0, 85.0, 106.0, 127.0)
"""x of the trees on the right; those on the left stand 9 m on."""
POSTS = tuple(range(-135, 150, 30))  # x of the lamp posts, to the right and to the left in turn
POST_AT, TREE_AT = (-3.05, 6.55), (-4.4, 7.9)  # y of the posts and of the trees, on the right and on the left
LAMP_HEIGHT, ARM = 7.5, 1.7
POST, TRUNK, TRUNK_HEIGHT = 0.1, 0.14, 2.5  # radii of posts and trunks, and how high a trunk is at least
LAMP_SIZE = (0.36, 0.22)  # of the area that shines, level
WALL, PANE, LEAF, IRON = (
    Material(roughness=0.85, specular=0.25), Material(roughness=0.06, specular=0.6),
    Material(roughness=0.7, specular=0.25), Material(roughness=0.45, specular=0.5),
)  # fmt: skip
WET_WALL = Material(roughness=0.5, specular=0.4)
LIT = {  # luminance by night, cd/m2: a lamp puts 15 lux on the road below it (7.5 m, 0.36 x 0.22 m)
    "street-lamps": np.array((10650.0 * 1.16, 10650.0 * 0.98, 10650.0 * 0.73), np.float32),
    "lit-windows": np.array((36.0, 23.5, 10.0), np.float32),
    "shops": np.array((62.0, 48.0, 31.0), np.float32),
}


class Tree(NamedTuple):
    """Where a tree stands; the two numbers choose its kind, turn and size."""

    x: float
    y: float
    number: int
    side: int = 0


class StreetPlan(NamedTuple):
    """What stands where."""

    ground: Callable[[], Quads]  # makes road and pavements
    fronts: tuple[tuple[Wall, float, float, int], ...]  # of houses: walls, from where to where along them, seeds
    trees: tuple[Tree, ...]
    posts: tuple[tuple[float, float, float], ...]  # (x, y) of the foot of each lamp post, and y of its lamp
    # makes further meshes, from the metres of one object size
    more: Callable[[float], tuple[MeshPart, ...]] = lambda metres: ()


@lru_cache(maxsize=4)
def built(
    plan: StreetPlan, metres: float, candelas: float | None, *, wet: bool, dark: bool, snow: bool = False
) -> tuple[MeshPart, ...]:
    """Return the meshes of a place, with lengths in the metres of one object size.

    Args:
        candelas: luminance of a radiance of 1, cd/m2; None where the light has no unit.
        wet: whether the road is dark and reflects.
        dark: whether lamps and windows shine.
        snow: whether snow lies on all that faces up; on the road it is driven on.
    """
    rows, ground = _houses(plan.fronts), WET if wet else DRY
    grey, white = np.full((2, 2, 3), 0.25, np.float32), np.full((2, 2, 3), 0.9, np.float32)
    tone = 1.0 + 0.25 * paint._clouds(128, 128, 32, 400) + 0.2 * paint._grain(128, 128, 401)
    grass = linear_to_srgb(np.clip(paint.tint((0.075, 0.095, 0.045)) * tone[..., None], 0.0, 1.0))
    fallen, plain = Quads(), Quads()
    corners = FAR * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    plain.level((-FAR, FAR), (-FAR, FAR), -0.05, corners / 50.0)
    iron, lamps = _posts(plan.posts)
    walls, trees, posts = (quads.swept(fallen) if snow else quads for quads in (rows.walls, _trees(plan.trees), iron))
    made = (
        (ROAD, plan.ground(), _display(paint.road, wet, snow), ground),
        ("houses", walls, _display(paint.walls), WET_WALL if wet else WALL),
        ("windows", rows.dark, _display(paint.panes), PANE),
        ("lit-windows", rows.lit, _display(paint.panes), PANE),
        ("shops", rows.shops, _display(paint.panes), PANE),
        ("trees", trees, _leaves(), LEAF),
        ("posts", posts, grey, IRON),
        ("street-lamps", lamps, white, PANE),
        ("plain", plain, white if snow else grass, WALL),
        *((("snow", fallen, white, WALL),) if snow else ()),
    )
    shine = {name: cd[None, None] / np.float32(candelas) for name, cd in LIT.items()} if dark and candelas else {}
    solids = {
        "houses": tuple(house_row(row, metres) for row in plan.fronts),
        "trees": tuple(column(tree.x, tree.y, TRUNK, KERB + TRUNK_HEIGHT, metres) for tree in plan.trees),
        "posts": tuple(column(x, y, POST, KERB + LAMP_HEIGHT, metres) for x, y, _ in plan.posts),
    }
    meshes = (
        MeshPart(
            name, quads.mesh(metres), base, finish,
            emission=shine.get(name), laid=True, solids=solids.get(name, ()),
        )
        for name, quads, base, finish in made
    )  # fmt: skip
    return (*meshes, *plan.more(metres))


def house_row(row: tuple[Wall, float, float, int], metres: float) -> Footprint:
    """Return what a row of houses takes up, as high as the lowest house, in units of `metres`."""
    frame, begin, end, _ = row
    along = np.array([begin, end, end, begin])
    out = np.array([0.0, 0.0, -DEPTH, -DEPTH])
    outline = frame.world(along, out, np.zeros(4))[:, :2]
    height = paint.GROUND_FLOOR + 2.0 * paint.FLOOR
    return Footprint(outline / metres, 0.0, height / metres)


def column(x: float, y: float, radius: float, top: float, metres: float) -> Footprint:
    """Return what something round takes up, from the ground to its top, in units of `metres`."""
    turn = np.arange(8) * (np.pi / 4.0)
    outline = np.array([x, y]) + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return Footprint(outline / metres, 0.0, top / metres)


@lru_cache(maxsize=8)
def _display(texture: Callable[..., Floats], *arguments: bool) -> Floats:
    return shown(texture(*arguments))


@lru_cache(maxsize=2)
def _houses(fronts: tuple[tuple[Wall, float, float, int], ...]) -> Fronts:
    row = Fronts()
    for frame, begin, end, seed in fronts:
        row.build(frame, begin, end, seed)
    return row


def level(quads: Quads, x: Sequence[float], y: Sequence[float], z: float, v: tuple[float, float] | None = None) -> None:
    """Add a level rectangle of ground; `v` are the y whose ground it shows, its own unless given."""
    (x0, x1), (y0, y1) = sorted(x), sorted(y)
    u = np.array([x0, x1, x1, x0]) / paint.GROUND_PERIOD
    quads.level((x0, x1), (y0, y1), z, np.stack([u, _shown(*(v or (y0, y1)))[[0, 0, 1, 1]]], axis=-1))


def _shown(*y: float) -> Doubles:
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
        corners = [(begin, edge, 0.0), (end, edge, 0.0), (end, edge, KERB), (begin, edge, KERB)]
        v = (edge - out * np.array([0.02, 0.02, 0.1, 0.1]) - low) / (high - low)
        uvs = np.stack([np.array([begin, end, end, begin]) / paint.GROUND_PERIOD, v], axis=-1)
        quads.add(np.array([corners])[:, :: int(-out)], uvs[None, :: int(-out)])


def closed(quads: Quads) -> None:
    """Add the streets that a street along x meets at its ends."""
    for sign in (-1.0, 1.0):
        level(quads, (sign * END, sign * (END + CROSSING)), (-64.0, 64.0), 0.0, (2.4, 5.2))
        level(quads, (sign * (END + CROSSING), sign * (END + CROSSING + 4.0)), (-64.0, 64.0), KERB, (-9.9, -6.0))


def _ground() -> Quads:
    quads = Quads()
    street(quads, -END, END)
    closed(quads)
    return quads


@lru_cache(maxsize=2)
def _trees(places: tuple[Tree, ...]) -> Quads:
    quads = Quads()
    trees = [_tree(seed) for seed in range(3)]
    for x, y, number, side in places:
        kind = trees[(number + side) % len(trees)]
        turn, size = 2.4 * number + side, 0.9 + 0.2 * ((5 * number + 3 * side) % 7) / 7.0
        matrix = size * np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0, 0, 1.0]])
        for corners, uvs, normals in zip(kind.corners, kind.uvs, kind.normals, strict=True):
            quads.add(corners @ matrix.T + [x, y, KERB], uvs, normals @ (matrix / size).T)
    return quads


LEAVES, CLUMPS = 3800, 40


def _tree(seed: int) -> Quads:
    """A trunk, some boughs and leaves in clumps, which are shaded as the clump is round."""
    rng, quads = np.random.Generator(np.random.PCG64(500 + seed)), Quads()
    limb(quads, np.array([0.0, 0.0, 0.0]), np.array([0.05, 0.03, 3.0]), 0.17, 0.12)
    way = rng.normal(size=(CLUMPS, 3))
    way *= rng.uniform(0.55, 1.0, (CLUMPS, 1)) / np.linalg.norm(way, axis=1, keepdims=True)
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
    corners = place[:, None] + np.stack([-along, -0.5 * aside, along, 0.5 * aside], axis=1) * size[:, None]
    round_ = 0.7 * away + 0.5 * (place - [0.0, 0.0, 4.9]) / [1.75, 1.75, 2.3] + [0.0, 0.0, 0.25]
    round_ /= np.linalg.norm(round_, axis=1, keepdims=True)
    flat = np.cross(along, aside)
    flat *= np.sign((flat * round_).sum(axis=1, keepdims=True))
    turned = np.where((np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]) * flat).sum(1) < 0.0)[0]
    corners[turned] = corners[turned, ::-1]
    shading = 0.75 * round_ + 0.5 * flat
    shading /= np.linalg.norm(shading, axis=1, keepdims=True)
    u = rng.random((LEAVES, 1, 1)) * 0.5 + 0.48
    uvs = np.concatenate([u + 0.0 * corners[..., :1], 0.5 + 0.0 * corners[..., :1]], axis=-1)
    quads.add(corners, uvs, np.repeat(shading[:, None], 4, axis=1))
    return quads


def _leaves() -> Floats:
    t = np.linspace(0.0, 1.0, 16, dtype=np.float32)[None, :, None]
    green = paint.tint((0.055, 0.105, 0.022)) * (1.0 - t) + paint.tint((0.13, 0.19, 0.04)) * t
    bark = paint.tint((0.085, 0.065, 0.048)) * (1.0 + 0.3 * t)
    return linear_to_srgb(np.concatenate([bark, green], axis=1).repeat(2, axis=0))


def limb(quads: Quads, start: Doubles, end: Doubles, thick: float, thin: float, sides: int = 7) -> None:
    """A tapering round limb from one place to another."""
    ahead = (end - start) / np.linalg.norm(end - start)
    aside = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    aside /= np.linalg.norm(aside)
    above = np.cross(ahead, aside)
    turn = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.cos(turn)[:, None] * aside + np.sin(turn)[:, None] * above
    low, high = start + thick * ring, end + thin * ring
    corners = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
    normals = np.stack([ring[:-1], ring[1:], ring[1:], ring[:-1]], axis=1)
    uvs = np.broadcast_to([0.2, 0.5], (sides, 4, 2)) + np.array([0.08, 0.0]) * np.arange(sides)[:, None, None] / sides
    quads.add(corners, uvs, normals)


def lamp_places(posts: Sequence[tuple[float, float, float]]) -> Doubles:
    """Return where the middle of each shining area is, (N, 3) metres."""
    return np.array([(x, lamp, KERB + LAMP_HEIGHT - 0.07) for x, _, lamp in posts])


def _posts(posts: Sequence[tuple[float, float, float]]) -> tuple[Quads, Quads]:
    """The posts with their heads, and the areas that shine, facing down."""
    quads, shining = Quads(), Quads()
    half, wide = LAMP_SIZE[0] / 2 + 0.06, LAMP_SIZE[1] / 2 + 0.05
    level = np.array([(-1, -1, 0), (-1, 1, 0), (1, 1, 0), (1, -1, 0)]) * [LAMP_SIZE[1] / 2.0, LAMP_SIZE[0] / 2.0, 0.0]
    for (x, y, z), (_, at, _) in zip(lamp_places(posts), posts, strict=True):
        foot = np.array([x, at, KERB])
        top = foot + np.array([0.0, 0.0, LAMP_HEIGHT])
        limb(quads, foot, foot + np.array([0.0, 0.0, 1.1]), 0.11, 0.1, 10)
        limb(quads, foot + np.array([0.0, 0.0, 1.0]), top, 0.07, 0.045, 10)
        limb(quads, top - [0.0, 0.0, 0.06], np.array([x, y, top[2] + 0.02]), 0.04, 0.03, 8)
        head = Wall((x, y, z), (0.0, -1.0 if at < y else 1.0, 0.0))
        quads.boxes(head, np.array([[-wide, wide, -half - 0.1, half, 0.004, 0.12]]), np.zeros((1, 4)), SHOWN)
        back = Wall((x, y, z), tuple(-np.array(head.out)))
        quads.boxes(back, np.array([[-wide, wide, 0.0, half + 0.1, 0.004, 0.12]]), np.zeros((1, 4)), (FRONT,))
        shining.add(np.array([[(x, y, z)]]) + level, np.zeros((1, 4, 2)) + 0.5)
    return quads, shining


def trees_along() -> tuple[Tree, ...]:
    """Return the trees on both sides of a street, those on the left 9 m on."""
    return tuple(Tree(x + 9.0 * side, y, n, side) for side, y in enumerate(TREE_AT) for n, x in enumerate(TREES))


def posts_along(xs: Sequence[float] = POSTS) -> tuple[tuple[float, float, float], ...]:
    """Return the posts of a street, to the right and to the left in turn."""
    reach = (ARM, -ARM)
    return tuple((x, POST_AT[n % 2], POST_AT[n % 2] + reach[n % 2]) for n, x in enumerate(xs))


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
AVENUE = StreetPlan(_ground, ((RIGHT, -END, END, 1), (LEFT, -END, END, 2), *ends()), trees_along(), posts_along())
