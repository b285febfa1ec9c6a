"""Ball, banana and book. Units are centimetres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np

import advsearch.questions.harden.objects.shapes as shapes
from advsearch.extend import assets
from advsearch.questions.harden.objects.family import Instance, family, sample_material
from advsearch.questions.harden.objects.shapes import Array, Patch
from advsearch.questions.harden.objects.textures import (
    Paint,
    ParameterSampler,
    Texels,
    clouded,
    mix,
    noise,
    over,
    paint_or_random,
    painter,
    parse_hex_color,
    sample_paint,
    shade,
    solid,
    step,
)

_GOLDEN = (1.0 + 5.0**0.5) / 2.0
_SIGNS = ((a, b) for a in (-1.0, 1.0) for b in (-_GOLDEN, _GOLDEN))
PENTAGONS = shapes.normalize(
    np.array(
        [
            corner
            for a, b in _SIGNS
            for corner in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))
        ]
    )
)
"""The 12 unit directions of an icosahedron's corners: the middles of a football's dark
panels.
"""
_NEAR = PENTAGONS @ PENTAGONS.T > 0.4
_FACES = [
    face
    for face in combinations(range(12), 3)
    if all(_NEAR[pair] for pair in combinations(face, 2))
]
HEXAGONS = shapes.normalize(
    np.array([PENTAGONS[list(face)].sum(axis=0) for face in _FACES])
)
"""The 20 unit directions of its face middles: the middles of the light panels."""


def football_seams(direction: Array) -> tuple[Array, Array]:
    """Return how far unit directions (N, 3) are from the seams of a football.

    The panels are the faces of a truncated icosahedron. A direction crosses the face
    for which its projection on the face's normal, over the face's distance from the
    centre, is largest.

    Returns:
        About the distance to the nearest seam (N,), and whether the panel is a pentagon
        (N,).
    """
    # projections over the distances of both kinds of faces from the centre, if that of
    # the corners is 1
    pentagon = direction @ PENTAGONS.T / 0.9393
    hexagon = direction @ HEXAGONS.T / 0.9149
    both = np.sort(np.concatenate([pentagon, hexagon], axis=1), axis=1)
    # At a seam the two largest are equal.
    return both[:, -1] - both[:, -2], pentagon.max(axis=1) > hexagon.max(axis=1)


def basketball_seams(directions: Array) -> Array:
    """Return about the distance (N,) of unit directions (N, 3) to the nearest seam.

    A basketball has two great circles as seams, and a curve on either side of y = 0
    that comes closest to it, 0.42, where z is 0.
    """
    x, y, z = np.abs(directions).T
    curved_seam = np.abs(y - (0.42 + 0.38 * z**2))
    return np.asarray(np.minimum(np.minimum(x, z), curved_seam))


def tennis_seam(directions: Array) -> Array:
    """Return about the distance (N,) of unit directions (N, 3) to the seam.

    The seam of a tennis ball is where a polynomial is 0; half its value is about the
    distance.
    """
    x, y, z = directions.T
    return np.asarray(np.abs(x**2 - y**2 - 0.75 * z * (1.2 - 0.2 * z**2)) * 0.5)


def _press_seams(
    patches: list[Patch], radius: float, depth: float, seam: Callable[[Array], Array]
) -> list[Patch]:
    """Press grooves along seams into a sphere.

    Normals stay those of the sphere: in a picture the groove is a dark line, not an
        edge.

    Args:
        patches: patches of the sphere, around the origin.
        radius: radius of the sphere.
        depth: depth of the groove, as a fraction of the radius; it falls with the
            distance from the seam as a Gaussian.
        seam: returns the distance (N,) of directions (N, 3) of about length 1 to the
            seam.
    """
    pressed = []
    for patch in patches:
        seam_distance = seam(patch.vertices / radius)
        fraction = depth * np.exp(-((seam_distance / 0.03) ** 2))
        vertices = patch.vertices * (1.0 - fraction)[:, None]
        pressed.append(replace(patch, vertices=vertices))
    return pressed


@painter
def _football(t: Texels, light: Array, dark: Array, offset: Array) -> Array:
    """Paint dark pentagons, light hexagons and gray seams on a sphere around the
    origin.
    """
    seam_distance, pentagon = football_seams(shapes.normalize(t.xyz))
    # both a little darker in irregular clouds
    base = (
        mix(light, dark, pentagon.astype(np.float64))
        * (1.0 - 0.06 * noise(t.xyz / 2.0 + offset))[:, None]
    )
    return mix(parse_hex_color("3a3a3a"), base, step(seam_distance, 0.012, soft=0.016))


@painter
def _beach(t: Texels, colors: list[Array], light: Array, radius: float) -> Array:
    """Paint six segments in colors, and light caps at both poles."""
    turn = np.arctan2(t.xyz[:, 1], t.xyz[:, 0]) / (2 * np.pi) % 1.0
    # turn: the angle about z, in turns from 0 to 1
    segment = np.minimum((turn * 6).astype(np.int64), 5)  # a turn may round to 1
    is_pole = np.abs(t.xyz[:, 2]) > 0.955 * radius
    return np.where(is_pole[:, None], light, np.array(colors)[segment])


@painter
def _near_to(t: Texels, seam: Callable[[Array], Array], reach: float) -> Array:
    """Return the mask of texels of a sphere that are within `reach` of a seam."""
    return step(-seam(shapes.normalize(t.xyz)), -reach, soft=0.02)


@painter
def _star(t: Texels, radius: float) -> Array:
    """Return the mask of a star with five points on a sphere, seen along z."""
    x = t.xyz[:, 0]
    y = t.xyz[:, 1]
    return step(
        np.cos(5 * np.arctan2(y, x)) * 0.25 - np.hypot(x, y) / radius, -0.55, soft=0.04
    )


@family(metres=0.01)
def ball(sampler: ParameterSampler) -> Instance:
    """Make a football, or a ball of another pattern."""
    radius = 11.0
    style = sampler.pick(
        "football", "beach", "basket", "tennis", "star", "plain", "wild", "wild"
    )
    squash = sampler(1.0, low=0.95, high=1.03)
    patches = shapes.sphere("ball", radius, rows=28, columns=48)
    turn = shapes.rotation("z", sampler(12.0, low=0.0, high=360.0)) @ shapes.rotation(
        "x", sampler(24.0, low=0.0, high=180.0)
    )
    offset = sampler.offset()
    light = sampler.sample_color("f1f0ea", "f4f4f2", "e8d34a", wild=0.3)
    dark = sampler.sample_color("1d1f22", "23395d", "b5442e", wild=0.3)
    paint, patches = _ball_surface(
        sampler,
        style=style,
        light=light,
        radius=radius,
        offset=offset,
        patches=patches,
        dark=dark,
    )
    shaped = [
        replace(p, vertices=p.vertices * np.array([1.0, 1.0, squash]))
        for p in shapes.transform_patches(patches, turn)
    ]
    return Instance(
        shaped, {"ball": paint}, sample_material(sampler, roughness=0.4, clearcoat=0.3)
    )


def _ball_surface(
    sampler: ParameterSampler,
    style: str,
    light: Array,
    radius: float,
    offset: Array,
    patches: list[Patch],
    dark: Array,
) -> tuple[Paint, list[Patch]]:
    """Sample the paint of a ball of a style, and return it with the ball's patches.

    A football and a basketball have grooves pressed into their patches.

    Args:
        sampler: samples colors.
        style: "football", "beach", "basket", "tennis", "star", "plain" or "wild".
        light, dark: colors of some styles.
        radius: radius of the ball.
        offset: (3,) into the noise.
        patches: patches of a sphere.
    """
    if style == "beach":
        bright = [
            sampler.sample_color(code, wild=0.5)
            for code in "d8342c f4f4f2 2f6fb5 f4f4f2 eeb52d f4f4f2".split()
        ]
        paint = _beach(
            [color if sampler.chance(0.7) else light for color in bright], light, radius
        )
    elif style == "basket":
        skin = sampler.sample_color("c8642b", "b5532a", "7a3b22", wild=0.2)
        paint = over(
            clouded(skin, factor=0.85, scale=0.7, offset=offset),
            _near_to(basketball_seams, reach=0.03),
            solid("1b1715"),
        )
        patches = _press_seams(patches, radius, 0.015, basketball_seams)
    elif style == "tennis":
        felt = sampler.sample_color("c9d63c", "d5dc4a", "e08a2e", wild=0.25)
        paint = over(
            clouded(felt, factor=0.85, scale=0.6, offset=offset),
            _near_to(tennis_seam, reach=0.045),
            solid("eeeee6"),
        )
    elif style == "star":
        paint = over(solid(dark), _star(radius), solid(light))
    elif style == "plain":
        paint = clouded(dark, factor=1.2, scale=3.0, offset=offset)
    elif style == "wild":
        paint = sample_paint(sampler, 2 * radius)
    else:
        paint = _football(light, dark, offset)
        patches = _press_seams(
            patches,
            radius,
            0.008,
            # grooves narrower than those of a basketball
            lambda d: football_seams(shapes.normalize(d))[0] * 1.5,
        )
    return paint, patches


@family(metres=0.01)
def banana(sampler: ParameterSampler) -> Instance:
    """Make a banana of random bend and ripeness."""
    length = sampler(19.0, low=15.0, high=22.0)
    bend = sampler(105.0, low=65.0, high=130.0)
    thick = sampler(1.65, low=1.45, high=2.1)
    stem = sampler(2.4, low=1.6, high=3.6)
    path, radius = _banana_shape(
        sampler, bend=bend, length=length, stem=stem, thick=thick
    )
    section = _banana_section(sampler)
    patches = shapes.sweep(
        "banana", path, section, radius, first=(0.0, 0.0, 1.0), caps=True
    )
    patches = shapes.transform_patches(
        patches, shapes.rotation("y", sampler(9.0, low=0.0, high=14.0))
    )
    patches = shapes.transform_patches(
        patches, shapes.rotation("z", sampler(78.0, low=45.0, high=120.0))
    )

    paint = _banana_paint(sampler, path, stem)

    return Instance(
        patches,
        {"banana": paint_or_random(sampler, length, paint, wild=0.4)},
        sample_material(sampler, roughness=0.45, clearcoat=0.1),
    )


def _banana_shape(
    sampler: ParameterSampler, bend: float, length: float, stem: float, thick: float
) -> tuple[Array, Array]:
    """Return the path (N, 3) of a banana from its stem, and its radius (N,) along it.

    The path is in the x-y plane.

    Args:
        sampler: samples the thickness of the stem.
        bend: by how many degrees the path turns from end to end.
        length: length of the path.
        stem: length of the stem.
        thick: the largest radius.
    """
    count = 44
    t = np.linspace(0.0, 1.0, count)
    # direction of each step, from -bend/2 to bend/2; it turns faster at both ends
    angle = np.radians(bend * (t + 0.05 * np.sin(2 * np.pi * t)) - bend / 2)[:-1]
    path = np.zeros((count, 3))
    path[1:, 0] = np.cumsum(np.sin(angle)) * (length / (count - 1))
    path[1:, 1] = np.cumsum(np.cos(angle)) * (length / (count - 1))

    position = t * length  # distance from the end of the stem
    # the radius rises from the stem, and falls to a blunt tip
    rise = np.clip((position - stem) / (0.26 * length), 0.0, 1.0) ** 0.75
    fall = np.clip((length - position) / (0.24 * length), 0.0, 1.0) ** 0.62
    body = np.sin(0.5 * np.pi * rise) * np.maximum(np.sin(0.5 * np.pi * fall), 0.26)
    # the stem is thicker where it was cut
    neck = sampler(0.3, low=0.24, high=0.4)
    stem_radius = neck * (1.0 + 0.25 * np.exp(-position / 0.5))
    radius = thick * np.maximum(stem_radius, body)
    # smoothed by a mean of five
    radius = np.convolve(np.pad(radius, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    return path, radius


def _banana_section(sampler: ParameterSampler) -> Array:
    """Sample the section (30, 2) of a banana, about a unit circle, with five ridges."""
    ridge = sampler(0.06, low=0.02, high=0.1)
    phi = 2 * np.pi * np.arange(30) / 30
    # |cos(2.5 phi)| has five maxima around the circle
    lumps = 1.0 + ridge * (np.abs(np.cos(2.5 * phi)) - 0.6)
    return np.stack([np.cos(phi), np.sin(phi)], axis=1) * lumps[:, None]


def _banana_paint(sampler: ParameterSampler, path: Array, stem: float) -> Paint:
    """Sample the paint of a banana: green and brown towards its ends, with flecks.

    Args:
        sampler: samples its color and how many flecks it has.
        path: (N, 3) of the banana, whose ends are those of the stem and of the tip.
        stem: length of the stem.
    """
    offset = sampler.offset()
    skin = sampler.sample_color("f0c930", "f3d64a", "e3b62a", "b7c04a", wild=0.0)
    tip, brown, green = map(parse_hex_color, ("3a2a18", "6b4520", "a9b13c"))
    amount = sampler(0.1, low=0.0, high=0.22)

    def paint(t: Texels) -> Array:
        """Paint the skin, then green, flecks, the brown stem and both dark ends."""
        xyz = t.xyz
        stem_distance = np.linalg.norm(xyz - path[0], axis=1)
        tip_distance = np.linalg.norm(xyz - path[-1], axis=1)
        color = mix(skin, shade(skin, 0.86), noise(xyz / 2.2 + offset))
        stem_green = np.clip(1.0 - (stem_distance - 0.9 * stem) / 2.6, 0.0, 1.0)
        color = mix(color, green, stem_green * 0.75)
        color = mix(color, green, np.clip(1.0 - tip_distance / 2.2, 0.0, 1.0) * 0.5)
        fleck = step(
            noise(xyz * np.array([1.9, 1.9, 3.1]) + offset), 1.0 - amount, soft=0.08
        )
        fleck = np.maximum(
            fleck, step(noise(xyz * 3.7 + offset), 1.02 - amount, soft=0.08)
        )
        color = mix(color, brown, fleck * 0.85)
        color = mix(color, brown, step(-stem_distance, -0.5 * stem, soft=1.3) * 0.5)
        color = mix(color, tip, step(-stem_distance, -0.45, soft=0.5))
        return mix(color, tip, step(-tip_distance, -0.75, soft=0.5))

    return paint


@family(metres=0.01)
def book(sampler: ParameterSampler) -> Instance:
    """Make a closed hardback that lies on its back cover.

    The spine runs along y at -x; the pages show at the other three sides.
    """
    width = sampler(15.5, low=12.0, high=18.0)
    height = 22.5
    thick = sampler(4.2, low=2.2, high=6.0)
    board = sampler(0.34, low=0.2, high=0.45)
    lip = sampler(0.4, low=0.2, high=0.6)
    bulge = sampler(0.35, low=0.0, high=0.7)
    patches: list[Patch] = []
    for z in (board / 2, thick - board / 2):
        patches += shapes.box(
            "cover", (0.25, 0.0, z), (width, height, board), bevel=0.12
        )
    size = (width - lip - 0.5, height - 2 * lip, thick - 2 * board + 0.04)
    patches += shapes.box(
        "pages", (0.3 - lip / 2, 0.0, thick / 2), size, bevel=0.05, steps=1
    )
    patches += _round_spine(
        thick=thick, width=width, bulge=bulge, board=board, height=height
    )
    turned = shapes.transform_patches(
        patches, shapes.rotation("z", sampler(-122.0, low=-150.0, high=-100.0))
    )

    front, pages_paint, spine = _book_paints(sampler, height, width, thick)

    return Instance(
        turned,
        {"cover": front, "pages": pages_paint, "spine": spine},
        sample_material(sampler, roughness=0.55, clearcoat=0.0),
    )


def _round_spine(
    thick: float, width: float, bulge: float, board: float, height: float
) -> list[Patch]:
    """Create the rounded spine of a book.

    Its section in the x-z plane lies between two half ellipses that bulge towards -x.

    Args:
        thick, width, height: thick, width and height of the book.
        bulge: by how much it bulges.
        board: its thickness, which is that of the covers.
    """
    half = thick / 2
    angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
    cosine = np.cos(angle)
    sine = np.sin(angle)
    # points (x, z); -width / 2 + 0.25 is the edge of the covers, which the spine
    # overlaps a little on both sides
    outer = np.stack(
        [-width / 2 + 0.25 - bulge * cosine - 0.1, half + half * sine], axis=1
    )
    inner = np.stack(
        [-width / 2 + 0.25 - bulge * cosine + board, half + (half - board) * sine],
        axis=1,
    )[::-1]
    return _spine(outer, inner, height)


def _book_paints(
    sampler: ParameterSampler, height: float, width: float, thick: float
) -> tuple[Paint, Paint, Paint]:
    """Sample the paints of the cover, the pages and the spine of a book, in this order.

    Args:
        sampler: samples the paints.
        height, width, thick: height, width and thick of the book.
    """
    offset = sampler.offset()
    cloth = sampler.sample_color(
        "7a1f2b", "1f3f5f", "2f5b46", "20242a", "c98a3a", "5b3a6b", "d8d0bd"
    )
    gold = sampler.sample_color("d8b45a", "efe6cf", "1d1f22", wild=0.25)
    base = paint_or_random(
        sampler,
        height,
        clouded(cloth, factor=0.85, scale=0.6, offset=offset, contrast=1.2),
        wild=0.3,
    )
    title = sampler.pick("frame", "blocks", "picture", "plain")
    front = _front(
        sampler,
        base=base,
        gold=gold,
        title=title,
        width=width,
        height=height,
        thick=thick,
    )
    paper = parse_hex_color("f4f2ea")
    if sampler.chance(0.7, canonical=True):
        paper = parse_hex_color("ece2c8")

    def pages_paint(t: Texels) -> Array:
        """Paint the edges of pages: fine lines along them."""
        # fine across the sheets (z), and long along them
        lines = noise(
            np.stack(
                [t.xyz[:, 2] * 9.0, 0.08 * t.xyz[:, 0], 0.08 * t.xyz[:, 1]], axis=1
            )
            + offset
        )
        return np.asarray(paper * (0.72 + 0.28 * lines)[:, None])

    def spine(t: Texels) -> Array:
        """Paint two bands at each end, and words in a block in the middle."""
        y = np.abs(t.xyz[:, 1]) / height  # 0 in the middle, 1/2 at the ends
        band = np.maximum(
            step(0.008 - np.abs(y - 0.36), 0.0, soft=0.006),
            step(0.008 - np.abs(y - 0.42), 0.0, soft=0.006),
        )
        block = step(0.16 - y, 0.0, soft=0.01) * step(
            0.22 * thick - np.abs(t.xyz[:, 2] - thick / 2), 0.0, soft=0.05
        )
        # noise that changes along the spine only, nearly: bars instead of letters
        words = step(
            noise(
                np.stack([t.xyz[:, 1] * 1.8, t.xyz[:, 2] * 0.2, 0 * y], axis=1) + 3.0
            ),
            0.36,
            soft=0.1,
        )
        return mix(base(t), gold, np.maximum(band, block * words))

    return front, pages_paint, spine


def _spine(outer: Array, inner: Array, height: float) -> list[Patch]:
    """Extrude the section of the spine along y, and close it at both ends.

    Args:
        outer: (K, 2) points (x, z) of its outer side, upwards.
        inner: (K, 2) points (x, z) of its inner side, downwards.
        height: height of the book; the extent along y.
    """
    loop = np.concatenate([outer, inner])[::-1]
    # the path leads along -y, and the section's axes are x and z
    frame = (
        np.tile([0.0, -1.0, 0.0], (2, 1)),
        np.tile([1.0, 0.0, 0.0], (2, 1)),
        np.tile([0.0, 0.0, 1.0], (2, 1)),
    )
    patches = shapes.sweep(
        "spine", [(0.0, height / 2, 0.0), (0.0, -height / 2, 0.0)], loop, frame=frame
    )
    size = (
        float(np.ptp(outer[:, 1])),
        float(np.ptp(outer[:, 0])) + float(np.linalg.norm(outer[0] - inner[-1])),
    )
    for side in (1.0, -1.0):
        # the face at this end, as a grid of two rows: the outer and the inner curve
        rows = [
            np.insert(curve, 1, side * height / 2, axis=1)
            for curve in (outer, inner[::-1])
        ]
        ends = np.stack(rows if side > 0 else rows[::-1])
        normal = np.broadcast_to([0.0, side, 0.0], ends.shape)
        patches.append(
            shapes.grid(
                "spine",
                ends,
                normal,
                size,
                np.array([0.0, 1.0]),
                np.linspace(0.0, 1.0, len(outer)),
            )
        )
    return patches


def _front(
    sampler: ParameterSampler,
    base: Paint,
    gold: Array,
    title: str,
    width: float,
    height: float,
    thick: float,
) -> Paint:
    """Paint the covers of a book, with a title and decoration on the front.

    A title "plain" has nothing. "picture" has a picture with a round spot in it;
    "frame" has a frame along the edges; "blocks" and "frame" have a ring as a seal. All
    but "plain" have lines of words.

    Args:
        sampler: samples the color of a picture.
        base: paint of both covers.
        gold: color of the decoration and the words.
        title: "plain", "picture", "frame" or "blocks".
        width, height, thick: width, height and thick of the book.
    """
    accent = sampler.sample_color("c9a24b", "2f6f8f", "b5442e", "3d6b4a")

    def inside(x: Array, y: Array, half_width: float, half_height: float) -> Array:
        """Return the mask of a rectangle around the origin, for points (x, y)."""
        in_width = step(half_width - np.abs(x), 0.0, soft=0.12)
        return in_width * step(half_height - np.abs(y), 0.0, soft=0.12)

    def paint(t: Texels) -> Array:
        """Paint the base, and on the upper side the decoration and the words."""
        # from the middle of the cover, which is a little beside that of the book
        x = t.xyz[:, 0] - 0.25
        y = -t.xyz[:, 1]
        top = (t.xyz[:, 2] > thick - 0.1).astype(np.float64)
        color = base(t)
        if title == "plain":
            return color
        if title == "picture":
            picture = inside(x, y + 0.12 * height, 0.36 * width, 0.26 * height) * top
            color = mix(color, accent, picture)
            color = mix(
                color,
                gold,
                picture
                * step(0.16 * width - np.hypot(x, y + 0.12 * height), 0.0, soft=0.15),
            )
        if title == "frame":
            frame = inside(x, y, 0.43 * width, 0.45 * height) - inside(
                x, y, 0.43 * width - 0.28, 0.45 * height - 0.28
            )
            color = mix(color, gold, frame * top)
        # rows 2 units high; along a row noise decides where there is a word
        words = step(
            noise(np.stack([x * 1.5, 0 * x, np.floor(y / 2.0)], axis=1) + 7.0),
            0.3,
            soft=0.08,
        )
        rows = step(np.abs((y / 2.0) % 1.0 - 0.5), 0.22, soft=0.1) * words
        lines = inside(x, y - 0.24 * height, 0.32 * width, 0.09 * height) * rows
        color = mix(color, gold, np.clip(lines, 0.0, 1.0) * top)
        if title != "picture":
            center_distance = np.hypot(x, y + 0.16 * height)
            seal = step(0.14 * width - center_distance, 0.0, soft=0.12) - step(
                0.1 * width - center_distance, 0.0, soft=0.12
            )
            color = mix(color, gold, seal * top)
        return color

    return paint


# ---- stop sign
# ----------------------------------------------------------------------------------
# A stop sign as it stands at road works, on a low stand. Units are metres; it is read
# from +x.
#
# The stand is low because data sets draw the box of a stop sign around its plate: on a
# tall post the box of all that is there would be another one.

_STROKES = {  # letters in a cell 1 high and 0.6 wide: runs of points (x, y)
    "S": [
        [
            (0.58, 0.82),
            (0.48, 0.97),
            (0.12, 0.97),
            (0.02, 0.84),
            (0.02, 0.66),
            (0.12, 0.54),
            (0.48, 0.46),
            (0.58, 0.34),
            (0.58, 0.16),
            (0.48, 0.03),
            (0.12, 0.03),
            (0.02, 0.18),
        ]
    ],
    "T": [[(0.0, 0.97), (0.6, 0.97)], [(0.3, 0.97), (0.3, 0.0)]],
    "O": [
        [
            (0.02, 0.2),
            (0.02, 0.8),
            (0.14, 0.97),
            (0.46, 0.97),
            (0.58, 0.8),
            (0.58, 0.2),
            (0.46, 0.03),
            (0.14, 0.03),
            (0.02, 0.2),
        ]
    ],
    "P": [
        [
            (0.04, 0.0),
            (0.04, 0.97),
            (0.46, 0.97),
            (0.58, 0.85),
            (0.58, 0.58),
            (0.46, 0.46),
            (0.04, 0.46),
        ]
    ],
}
FINISHES = {
    "face": assets.Material(roughness=0.35, clearcoat=0.4),
    "metal": assets.Material(roughness=0.5, metallic=0.6),
    "post": assets.Material(roughness=0.45, metallic=0.7),
    "rubber": assets.Material(roughness=0.85),
}


def _word_strokes(letters: str, height: float) -> list[Array]:
    """Return the strokes of a word around the origin, each a polyline (K, 2).

    Args:
        letters: keys of `_STROKES`.
        height: height of a letter.
    """
    strokes = []
    for k, letter in enumerate(letters):
        # letters are 0.74 apart and 0.6 wide: half of the gap, 0.07, is at their left
        left = ((k - len(letters) / 2) * 0.74 + 0.07) * height
        corner = np.array([left, -height / 2])
        strokes += [np.array(path) * height + corner for path in _STROKES[letter]]
    return strokes


@painter
def _face(t: Texels, red: Array, radius: float) -> Array:
    """Paint the plate of a stop sign around the origin, which looks along +x.

    The word and a rim are white on red.

    Args:
        t: points of the plate.
        red: color.
        radius: radius from the middle of the octagon to its corners.
    """
    apothem = radius * np.cos(np.pi / 8)  # from the middle to the sides
    side_angles = np.pi * (np.arange(8) + 0.5) / 4 + np.pi / 8
    y = t.xyz[:, 1]
    z = t.xyz[:, 2]
    # apothem of the octagon whose outline goes through each texel
    out = np.max([y * np.cos(a) + z * np.sin(a) for a in side_angles], axis=0)
    rim = step(out - 0.915 * apothem, 0.0, soft=0.006)
    rim = rim * step(0.985 * apothem - out, 0.0, soft=0.006)

    strokes = _word_strokes("STOP", 0.52 * apothem)
    stroke_distance = shapes.distance_to_polylines(y, z, *strokes)
    word = step(0.05 * apothem - stroke_distance, 0.0, soft=0.006)
    return mix(red, parse_hex_color("f3f2ee"), np.maximum(rim, word))


@family(metres=1.0, texels=192)
def stop_sign(sampler: ParameterSampler) -> Instance:
    """Make a stop sign on a post."""
    radius = sampler(0.45, low=0.4, high=0.5)
    height = sampler(0.74, low=0.66, high=0.84)
    red = sampler.sample_color("b3121d", "a8161f", "c0202a", wild=0.0)
    plate = _sign_plate(radius, height)
    post = _sign_post(height, radius)
    foot = shapes.box(
        "rubber", (0.0, 0.0, 0.03), (0.6, 0.36, 0.06), bevel=0.02, steps=2
    )
    foot += shapes.box("post", (0, 0, 0.07), (0.1, 0.1, 0.05), bevel=0.01, steps=1)
    heights = (height - 0.5 * radius, height + 0.5 * radius)
    clamps = [
        patch
        for z in heights
        for patch in shapes.box(
            "post", (0.008, 0.0, z), (0.05, 0.09, 0.03), bevel=0.006, steps=1
        )
    ]
    grey = sampler.sample_color("9a9da0", "7d8083", wild=0.0)
    paints = {
        "face": _face(red, radius),
        "metal": solid("a4a7aa"),
        "post": solid(grey),
        "rubber": solid("1d1d1f"),
    }
    turned = shapes.transform_patches(
        [*plate, *post, *foot, *clamps],
        shapes.rotation("z", sampler(0.0, low=-25.0, high=25.0)),
    )
    return Instance(
        turned,
        paints,
        FINISHES["face"],
        detail={"metal": 0.25, "post": 0.18, "rubber": 0.3},
        finishes=FINISHES,
    )


def _sign_plate(radius: float, height: float) -> list[Patch]:
    """Create the octagonal plate of a stop sign, which looks along +x, in front of the
    post.

    Args:
        radius: radius from its middle to its corners.
        height: height of its middle.
    """
    ring = shapes.polygon(8, bevel=0.02, steps=2) * radius
    ahead = np.array([1.0, 0.0, 0.0])
    # an octagon that looks along +x, its middle at the origin
    back = np.insert(ring, 0, 0.0, axis=1)
    edge = shapes.sweep(
        "metal", [(0.0, 0.0, 0.0), 0.004 * ahead], ring, first=(0.0, 1.0, 0.0)
    )
    plate = [
        shapes.cap("face", back + 0.004 * ahead, ahead),
        *edge,
        shapes.cap("metal", back[::-1], -ahead),
    ]
    return shapes.transform_patches(plate, offset=(0.036, 0.0, height))


def _sign_post(height: float, radius: float) -> list[Patch]:
    """Create the post of a stop sign: a closed tube that ends behind the plate.

    Args:
        height: height of the middle of the plate.
        radius: radius of the plate.
    """
    tube = shapes.round_corners(
        [
            (0.03, 0.0),
            (0.03, height + 0.7 * radius),
            (0.0, height + 0.7 * radius + 0.004),
        ],
        radius=0.004,
        steps=2,
    )
    return shapes.lathe(
        [("post", [(0.0, 0.0), (0.03, 0.0)]), ("post", tube[:-1]), ("post", tube[-2:])],
        columns=20,
    )
