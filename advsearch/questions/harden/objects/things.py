"""Ball, banana and book in centimetres, and a stop sign in metres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

import advsearch.questions.harden.objects.shapes as shapes
from advsearch.extend import assets
from advsearch.questions.harden.objects.family import (
    Instance,
    make_family,
    sample_material,
)
from advsearch.questions.harden.objects.shapes import Array, Patch
from advsearch.questions.harden.objects.textures import (
    Paint,
    ParameterSampler,
    Texels,
    blend_colors,
    choose_paint_or_random,
    compute_soft_step,
    compute_value_noise,
    paint_over,
    paint_shaded_clouds,
    paint_solid_color,
    painter,
    parse_hex_color,
    sample_paint,
    scale_brightness,
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
"""The 12 unit directions of an icosahedron's corners: the centers of a football's dark
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
"""The 20 unit directions of its face centers: the centers of the light panels."""
PENTAGON_DISTANCE = 0.9393
"""Distance of the pentagons from the center of a truncated icosahedron whose corners are
at a distance of 1.
"""
HEXAGON_DISTANCE = 0.9149
"""The same of its hexagons."""
BANANA_POINTS = 44  # points of the path of a banana
BANANA_BROWN = "6b4520"  # color of flecks and of the stem
COVER_SHIFT = 0.25
"""Distance of the covers' middle from the origin of a book, along +x."""


def football_seams(directions: Array) -> tuple[Array, Array]:
    """Return how far unit directions (N, 3) are from the seams of a football.

    The panels are the faces of a truncated icosahedron. A direction crosses the face
    for which its projection on the face's normal, over the face's distance from the
    center, is largest.

    Returns:
        Approximate distances to the nearest seam (N,), and whether each panel is a
        pentagon (N,).
    """
    to_pentagons = directions @ PENTAGONS.T / PENTAGON_DISTANCE
    to_hexagons = directions @ HEXAGONS.T / HEXAGON_DISTANCE
    ascending = np.sort(np.concatenate([to_pentagons, to_hexagons], axis=1), axis=1)
    # At a seam the two largest are equal.
    seam_distance = ascending[:, -1] - ascending[:, -2]
    return seam_distance, to_pentagons.max(axis=1) > to_hexagons.max(axis=1)


def basketball_seams(directions: Array) -> Array:
    """Return the approximate distance (N,) of unit directions (N, 3) to the nearest seam.

    A basketball has two great circles as seams, and a curve on either side of y = 0.
    The curve is nearest to y = 0 where z is 0: there y is 0.42.
    """
    x, y, z = np.abs(directions).T
    curved_seam = np.abs(y - (0.42 + 0.38 * z**2))
    return np.asarray(np.minimum(np.minimum(x, z), curved_seam))


def tennis_seam(directions: Array) -> Array:
    """Return the approximate distance (N,) of unit directions (N, 3) to the seam.

    The seam of a tennis ball is where a polynomial is 0. Half of its absolute value is
    approximately the distance. Its factors decide how far the seam winds.
    """
    x, y, z = directions.T
    polynomial = x**2 - y**2 - 0.75 * z * (1.2 - 0.2 * z**2)
    return np.asarray(np.abs(polynomial) * 0.5)


def _press_seams(
    patches: list[Patch], radius: float, depth: float, seam: Callable[[Array], Array]
) -> list[Patch]:
    """Press grooves along seams into a sphere.

    Normals stay those of the sphere: in a picture the groove is a dark line, not an
    edge.

    Args:
        patches: patches of the sphere, around the origin.
        radius: radius of the sphere.
        depth: depth of the groove, as a fraction of the radius; it decreases with the
            distance from the seam as a Gaussian.
        seam: function that returns the distance (N,) to the seam of directions (N, 3),
            which have a length of approximately 1.
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
    """Paint dark pentagons, light hexagons and gray seams on a sphere at the origin."""
    seam_distance, is_pentagon = football_seams(shapes.normalize(t.xyz))
    panels = blend_colors(light, dark, is_pentagon.astype(np.float64))
    clouds = 1.0 - 0.06 * compute_value_noise(t.xyz / 2.0 + offset)  # up to 6 % darker
    off_seam = compute_soft_step(seam_distance, 0.012, soft=0.016)
    return blend_colors(parse_hex_color("3a3a3a"), panels * clouds[:, None], off_seam)


@painter
def _beach(t: Texels, colors: list[Array], light: Array, radius: float) -> Array:
    """Paint six segments in colors, and light caps at both poles."""
    # the angle about z, from 0 to 1
    turn = np.arctan2(t.xyz[:, 1], t.xyz[:, 0]) / (2 * np.pi) % 1.0
    segment = np.minimum((turn * 6).astype(np.int64), 5)  # a turn may round to 1
    is_pole = np.abs(t.xyz[:, 2]) > 0.955 * radius
    return np.where(is_pole[:, None], light, np.array(colors)[segment])


@painter
def _near_to(t: Texels, seam: Callable[[Array], Array], reach: float) -> Array:
    """Return the mask of texels of a sphere that are within `reach` of a seam."""
    return compute_soft_step(-seam(shapes.normalize(t.xyz)), -reach, soft=0.02)


@painter
def _star(t: Texels, radius: float) -> Array:
    """Return the mask of a star with five points on a sphere, seen along z."""
    x = t.xyz[:, 0]
    y = t.xyz[:, 1]
    points = np.cos(5 * np.arctan2(y, x)) * 0.25  # five maxima around z
    return compute_soft_step(points - np.hypot(x, y) / radius, -0.55, soft=0.04)


@make_family(unit_in_metres=0.01)
def ball(sampler: ParameterSampler) -> Instance:
    """Make a football, or a ball of another pattern.

    Lengths are in centimeters, angles in degrees. Its pattern gets a random direction,
    by rotations about the x and then the z axis.
    """
    radius = 11.0
    # "random" is named twice, to be sampled twice as often
    style = sampler.sample_choice(
        "football", "beach", "basket", "tennis", "star", "plain", "random", "random"
    )
    # a factor along z, after the rotations, so that the ball is flat where it lies
    squash = sampler(1.0, low=0.95, high=1.03)
    about_z = shapes.make_rotation_matrix("z", sampler(12.0, low=0.0, high=360.0))
    about_x = shapes.make_rotation_matrix("x", sampler(24.0, low=0.0, high=180.0))
    offset = sampler.sample_noise_offset()
    light = sampler.sample_color("f1f0ea", "f4f4f2", "e8d34a", p_random=0.3)
    dark = sampler.sample_color("1d1f22", "23395d", "b5442e", p_random=0.3)
    paint = _ball_paint(sampler, style, light, dark, radius, offset)
    sphere = shapes.make_sphere_patches("ball", radius, rows=28, columns=48)
    rotated = shapes.transform_patches(
        _press_ball(sphere, style, radius), about_z @ about_x
    )
    return Instance(
        _squash(rotated, squash),
        {"ball": paint},
        sample_material(sampler, roughness=0.4, clearcoat=0.3),
    )


def _squash(patches: list[Patch], factor: float) -> list[Patch]:
    """Scale the vertices of patches along z; normals stay as they are."""
    return [
        replace(patch, vertices=patch.vertices * np.array([1.0, 1.0, factor]))
        for patch in patches
    ]


def _press_ball(sphere: list[Patch], style: str, radius: float) -> list[Patch]:
    """Press the grooves of a football or a basketball into a sphere.

    Balls of other styles stay smooth.
    """
    if style == "basket":
        return _press_seams(sphere, radius, depth=0.015, seam=basketball_seams)
    if style == "football":
        return _press_seams(sphere, radius, depth=0.008, seam=_narrow_football_seam)
    return sphere


def _narrow_football_seam(directions: Array) -> Array:
    """Return 1.5 times the distance (N,) of directions (N, 3) to a football's seam.

    With a larger distance a groove is narrower, narrower than that of a basketball.
    """
    seam_distance, _ = football_seams(shapes.normalize(directions))
    return seam_distance * 1.5


def _ball_paint(
    sampler: ParameterSampler,
    style: str,
    light: Array,
    dark: Array,
    radius: float,
    offset: Array,
) -> Paint:
    """Sample the paint of a ball of a style.

    Args:
        sampler: samples colors.
        style: "football", "beach", "basket", "tennis", "star", "plain" or "random".
        light, dark: colors of some styles.
        radius: radius of the ball.
        offset: (3,) into the noise.
    """
    if style == "beach":
        return _beach(_beach_colors(sampler, light), light, radius)
    if style == "basket":
        return _sample_basketball(sampler, offset)
    if style == "tennis":
        return _sample_tennis_ball(sampler, offset)
    if style == "star":
        star = _star(radius)
        return paint_over(paint_solid_color(dark), star, paint_solid_color(light))
    if style == "plain":
        return paint_shaded_clouds(dark, factor=1.2, scale=3.0, offset=offset)
    if style == "random":
        return sample_paint(sampler, 2 * radius)
    return _football(light, dark, offset)


def _sample_basketball(sampler: ParameterSampler, offset: Array) -> Paint:
    """Sample the paint of a basketball, with an offset (3,) into the noise."""
    skin = sampler.sample_color("c8642b", "b5532a", "7a3b22", p_random=0.2)
    return paint_over(
        paint_shaded_clouds(skin, factor=0.85, scale=0.7, offset=offset),
        _near_to(basketball_seams, reach=0.03),
        paint_solid_color("1b1715"),
    )


def _sample_tennis_ball(sampler: ParameterSampler, offset: Array) -> Paint:
    """Sample the paint of a tennis ball, with an offset (3,) into the noise."""
    felt = sampler.sample_color("c9d63c", "d5dc4a", "e08a2e", p_random=0.25)
    return paint_over(
        paint_shaded_clouds(felt, factor=0.85, scale=0.6, offset=offset),
        _near_to(tennis_seam, reach=0.045),
        paint_solid_color("eeeee6"),
    )


def _beach_colors(sampler: ParameterSampler, light: Array) -> list[Array]:
    """Sample the colors of a beach ball's six segments, some of them light."""
    bright_colors = [
        sampler.sample_color(code, p_random=0.5)
        for code in "d8342c f4f4f2 2f6fb5 f4f4f2 eeb52d f4f4f2".split()
    ]
    return [color if sampler.sample_bool(0.7) else light for color in bright_colors]


@make_family(unit_in_metres=0.01)
def banana(sampler: ParameterSampler) -> Instance:
    """Make a banana of random bend and ripeness.

    Lengths are in centimeters, `bend` and rotations in degrees. `sampler(x, low=...,
    high=...)` returns x for the canonical banana and a uniform sample for a random one.
    """
    length = sampler(19.0, low=15.0, high=22.0)
    bend = sampler(105.0, low=65.0, high=130.0)
    max_radius = sampler(1.65, low=1.45, high=2.1)
    stem_length = sampler(2.4, low=1.6, high=3.6)
    path = _banana_path(bend, length)
    radius = _banana_radius(sampler, length, stem_length, max_radius)
    section = _banana_section(sampler)
    patches = shapes.sweep_section(
        "banana", path, section, radius, start_axis=(0.0, 0.0, 1.0), has_caps=True
    )
    rotated = _lay_banana(sampler, patches)
    paint = _banana_paint(sampler, path, stem_length)
    return Instance(
        rotated,
        {"banana": choose_paint_or_random(sampler, length, paint, p_random=0.4)},
        sample_material(sampler, roughness=0.45, clearcoat=0.1),
    )


def _lay_banana(sampler: ParameterSampler, patches: list[Patch]) -> list[Patch]:
    """Tilt a banana about the y axis, and turn it about z, at random."""
    tilt = shapes.make_rotation_matrix("y", sampler(9.0, low=0.0, high=14.0))
    turn = shapes.make_rotation_matrix("z", sampler(78.0, low=45.0, high=120.0))
    return shapes.transform_patches(shapes.transform_patches(patches, tilt), turn)


def _banana_path(bend: float, length: float) -> Array:
    """Return the path (`BANANA_POINTS`, 3) of a banana in the x-y plane, from its stem.

    Args:
        bend: by how many degrees the path turns from end to end.
        length: length of the path.
    """
    t = np.linspace(0.0, 1.0, BANANA_POINTS)
    # direction of each step, from -bend/2 to bend/2; it turns faster at both ends
    angle = np.radians(bend * (t + 0.05 * np.sin(2 * np.pi * t)) - bend / 2)[:-1]
    step_length = length / (BANANA_POINTS - 1)
    path = np.zeros((BANANA_POINTS, 3))
    path[1:, 0] = np.cumsum(np.sin(angle)) * step_length
    path[1:, 1] = np.cumsum(np.cos(angle)) * step_length
    return path


def _banana_radius(
    sampler: ParameterSampler, length: float, stem_length: float, max_radius: float
) -> Array:
    """Return the radius (`BANANA_POINTS`,) of a banana along its path from the stem.

    Args:
        sampler: samples the thickness of the stem.
        length: length of the path.
        stem_length: length of the stem.
        max_radius: the largest radius.
    """
    stem_distance = np.linspace(0.0, 1.0, BANANA_POINTS) * length
    tip_distance = length - stem_distance
    # The radius of the body, as a fraction of the largest one, grows from 0 to 1 over
    # about a quarter of the length at both ends. With powers below 1 they are plumper.
    rise = np.clip((stem_distance - stem_length) / (0.26 * length), 0.0, 1.0) ** 0.75
    rise_from_tip = np.clip(tip_distance / (0.24 * length), 0.0, 1.0) ** 0.62
    # the tip ends with 26 % of the largest radius, not in a point
    blunt_tip = np.maximum(np.sin(0.5 * np.pi * rise_from_tip), 0.26)
    body = np.sin(0.5 * np.pi * rise) * blunt_tip
    # the radius of the stem, which is thicker where it was cut
    neck = sampler(0.3, low=0.24, high=0.4)
    stem = neck * (1.0 + 0.25 * np.exp(-stem_distance / 0.5))
    radius = max_radius * np.maximum(stem, body)
    # Each radius is replaced by the mean of five neighbors, so that stem and body join
    # without an edge. The first and the last radius are repeated for that.
    padded_radius = np.pad(radius, 2, mode="edge")
    return np.convolve(padded_radius, np.ones(5) / 5, mode="valid")


def _banana_section(sampler: ParameterSampler) -> Array:
    """Sample the section (30, 2) of a banana, about a unit circle, with five ridges."""
    ridge = sampler(0.06, low=0.02, high=0.1)
    phi = 2 * np.pi * np.arange(30) / 30
    # |cos(2.5 phi)| has five maxima around the circle
    lumps = 1.0 + ridge * (np.abs(np.cos(2.5 * phi)) - 0.6)
    return np.stack([np.cos(phi), np.sin(phi)], axis=1) * lumps[:, None]


def _banana_paint(sampler: ParameterSampler, path: Array, stem_length: float) -> Paint:
    """Sample the paint of a banana: green and brown towards its ends, with flecks.

    Args:
        sampler: samples its color and how many flecks it has.
        path: (N, 3) of the banana, whose ends are those of the stem and of the tip.
        stem_length: length of the stem.
    """
    offset = sampler.sample_noise_offset()
    skin = sampler.sample_color("f0c930", "f3d64a", "e3b62a", "b7c04a", p_random=0.0)
    fleck_amount = sampler(0.1, low=0.0, high=0.22)
    return _banana_skin(skin, path, stem_length, offset, fleck_amount)


@painter
def _banana_skin(
    t: Texels,
    skin: Array,
    path: Array,
    stem_length: float,
    offset: Array,
    fleck_amount: float,
) -> Array:
    """Paint the skin, then green, flecks, the brown stem and both dark ends.

    Args:
        t: points of the banana.
        skin: color where it is ripe.
        path: (N, 3) of the banana, whose ends are those of the stem and of the tip.
        stem_length: length of the stem.
        offset: (3,) into the noise.
        fleck_amount: as for `_flecks`.
    """
    stem_distance = np.linalg.norm(t.xyz - path[0], axis=1)
    tip_distance = np.linalg.norm(t.xyz - path[-1], axis=1)
    clouds = compute_value_noise(t.xyz / 2.2 + offset)
    color = blend_colors(skin, scale_brightness(skin, 0.86), clouds)

    color = _paint_ends_green(color, stem_distance, tip_distance, stem_length)
    flecks = _flecks(t.xyz, offset, fleck_amount)
    color = blend_colors(color, parse_hex_color(BANANA_BROWN), flecks * 0.85)
    return _darken_ends(color, stem_distance, tip_distance, stem_length)


def _paint_ends_green(
    color: Array, stem_distance: Array, tip_distance: Array, stem_length: float
) -> Array:
    """Paint both ends of a banana green, which fades towards its middle.

    Green fades over 2.6 cm from the stem, and over 2.2 cm from the tip.

    Args:
        color: colors (N, 3) of points.
        stem_distance, tip_distance: distances (N,) from the ends of stem and tip.
        stem_length: length of the stem.
    """
    green = parse_hex_color("a9b13c")
    stem_green = np.clip(1.0 - (stem_distance - 0.9 * stem_length) / 2.6, 0.0, 1.0)
    tip_green = np.clip(1.0 - tip_distance / 2.2, 0.0, 1.0)
    color = blend_colors(color, green, stem_green * 0.75)
    return blend_colors(color, green, tip_green * 0.5)


def _darken_ends(
    color: Array, stem_distance: Array, tip_distance: Array, stem_length: float
) -> Array:
    """Blend the colors (N, 3) of a banana with brown at the stem, and dark at both ends.

    Args:
        color: colors of points.
        stem_distance, tip_distance: distances (N,) from both ends.
        stem_length: length of the stem.
    """
    dark = parse_hex_color("3a2a18")
    # Distances are negated, since `compute_soft_step` is 1 above its threshold: each
    # mask covers what is nearer than that.
    stem_brown = compute_soft_step(-stem_distance, -0.5 * stem_length, soft=1.3)
    stem_end = compute_soft_step(-stem_distance, -0.45, soft=0.5)
    tip_end = compute_soft_step(-tip_distance, -0.75, soft=0.5)
    color = blend_colors(color, parse_hex_color(BANANA_BROWN), stem_brown * 0.5)
    color = blend_colors(color, dark, stem_end)
    return blend_colors(color, dark, tip_end)


def _flecks(points: Array, offset: Array, amount: float) -> Array:
    """Return the mask (N,) of a banana's flecks at points (N, 3): large and small ones.

    Args:
        points: points of the surface.
        offset: (3,) into the noise.
        amount: with a larger amount flecks cover more of the surface; not a fraction.
    """
    large_noise = compute_value_noise(points * np.array([1.9, 1.9, 3.1]) + offset)
    small_noise = compute_value_noise(points * 3.7 + offset)
    large = compute_soft_step(large_noise, 1.0 - amount, soft=0.08)
    return np.maximum(large, compute_soft_step(small_noise, 1.02 - amount, soft=0.08))


class _BookSize(NamedTuple):
    """The size of a book that lies on its back cover.

    Attributes:
        width: extent along x, from the spine to the edge of the covers.
        height: extent along y.
        thickness: extent along z.
    """

    width: float
    height: float
    thickness: float


@make_family(unit_in_metres=0.01)
def book(sampler: ParameterSampler) -> Instance:
    """Make a closed hardback that lies on its back cover.

    The spine runs along y at -x; the pages are visible at the other three sides.
    Lengths are in centimeters, and 22.5 is the height of a usual hardback. `sampler(x,
    low=..., high=...)` returns x for the canonical book and a uniform sample for a
    random one.
    """
    width = sampler(15.5, low=12.0, high=18.0)
    size = _BookSize(width, 22.5, thickness=sampler(4.2, low=2.2, high=6.0))
    board = sampler(0.34, low=0.2, high=0.45)  # thickness of a cover
    overhang = sampler(0.4, low=0.2, high=0.6)  # how far covers extend over the pages
    bulge = sampler(0.35, low=0.0, high=0.7)
    patches = [
        *_book_covers(size, board),
        *_book_pages(size, board, overhang),
        *_round_spine(size, bulge, board),
    ]
    # -122 degrees: seen from the usual camera, the spine is at the side and the front
    # cover is readable.
    turn = shapes.make_rotation_matrix("z", sampler(-122.0, low=-150.0, high=-100.0))
    return Instance(
        shapes.transform_patches(patches, turn),
        _book_paints(sampler, size),
        sample_material(sampler, roughness=0.55, clearcoat=0.0),
    )


def _book_covers(size: _BookSize, board: float) -> list[Patch]:
    """Create the back cover and the front cover of a book, `board` thick."""
    patches: list[Patch] = []
    for z in (board / 2, size.thickness - board / 2):
        patches += shapes.make_rounded_box(
            "cover", (COVER_SHIFT, 0.0, z), (size.width, size.height, board), bevel=0.12
        )
    return patches


def _book_pages(size: _BookSize, board: float, overhang: float) -> list[Patch]:
    """Create the block of a book's pages.

    Args:
        size: the size of the book.
        board: thickness of a cover.
        overhang: how far covers extend over the pages.
    """
    # Along x the pages reach from 0.55 - width / 2, near the inner side of the spine, to
    # width / 2 + 0.05 - overhang, which is 0.2 + `overhang` before the edge of the
    # covers.
    center = (0.3 - overhang / 2, 0.0, size.thickness / 2)
    pages_size = (
        size.width - overhang - 0.5,
        size.height - 2 * overhang,
        size.thickness - 2 * board + 0.04,  # 0.02 inside of each cover, without a gap
    )
    return shapes.make_rounded_box("pages", center, pages_size, bevel=0.05, steps=1)


def _round_spine(size: _BookSize, bulge: float, board: float) -> list[Patch]:
    """Create the rounded spine of a book.

    Its section in the x-z plane lies between two half ellipses that bulge towards -x.

    Args:
        size: the size of the book.
        bulge: how far it bulges.
        board: thickness of the spine, which is that of the covers.
    """
    half = size.thickness / 2
    angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
    cover_edge = -size.width / 2 + COVER_SHIFT
    x = cover_edge - bulge * np.cos(angle)
    # It overlaps the covers a little on both sides: by 0.1 and by its thickness.
    outer = np.stack([x - 0.1, half + half * np.sin(angle)], axis=1)
    inner = np.stack([x + board, half + (half - board) * np.sin(angle)], axis=1)
    return _spine(outer, inner[::-1], size.height)


def _book_paints(sampler: ParameterSampler, size: _BookSize) -> dict[str, Paint]:
    """Sample the paints of a book by the tags of its parts.

    Args:
        sampler: samples the paints.
        size: the size of the book.
    """
    offset = sampler.sample_noise_offset()
    cloth_color = sampler.sample_color(
        "7a1f2b", "1f3f5f", "2f5b46", "20242a", "c98a3a", "5b3a6b", "d8d0bd"
    )
    gold = sampler.sample_color("d8b45a", "efe6cf", "1d1f22", p_random=0.25)
    clouds = paint_shaded_clouds(
        cloth_color, factor=0.85, scale=0.6, offset=offset, contrast=1.2
    )
    cloth = choose_paint_or_random(sampler, size.height, clouds, p_random=0.3)
    style = sampler.sample_choice("frame", "blocks", "picture", "plain")
    cover = _cover_paint(sampler, style, cloth, gold, size)
    paper = parse_hex_color("f4f2ea")
    if sampler.sample_bool(0.7, canonical=True):
        paper = parse_hex_color("ece2c8")
    return {
        "cover": cover,
        "pages": _page_edges(paper, offset),
        "spine": _spine_paint(cloth, gold, size),
    }


@painter
def _page_edges(t: Texels, paper: Array, offset: Array) -> Array:
    """Paint the edges of pages in the color of paper, with fine lines along them."""
    x, y, z = t.xyz.T
    # The noise is fine across the sheets (z), and long along them.
    position = np.stack([z * 9.0, 0.08 * x, 0.08 * y], axis=1)
    lines = compute_value_noise(position + offset)
    return np.asarray(paper * (0.72 + 0.28 * lines)[:, None])


@painter
def _spine_paint(t: Texels, cloth: Paint, gold: Array, size: _BookSize) -> Array:
    """Paint two golden bands at each end of a spine, and words in its middle.

    The words are bars without letters.
    """
    _, y, z = t.xyz.T
    # distance from the middle along the spine, 1/2 at its ends
    height_fraction = np.abs(y) / size.height
    bands = np.maximum(
        compute_soft_step(0.008 - np.abs(height_fraction - 0.36), 0.0, soft=0.006),
        compute_soft_step(0.008 - np.abs(height_fraction - 0.42), 0.0, soft=0.006),
    )
    # The words fill the middle: 32 % of the height, and 44 % of the thickness.
    in_height = compute_soft_step(0.16 - height_fraction, 0.0, soft=0.01)
    from_middle = np.abs(z - size.thickness / 2)
    in_thickness = compute_soft_step(
        0.22 * size.thickness - from_middle, 0.0, soft=0.05
    )
    # noise that changes mostly along the spine: it gives bars instead of letters
    noise_position = np.stack([y * 1.8, z * 0.2, np.zeros_like(y)], axis=1) + 3.0
    bars = compute_soft_step(compute_value_noise(noise_position), 0.36, soft=0.1)
    words = in_height * in_thickness * bars
    return blend_colors(cloth(t), gold, np.maximum(bands, words))


def _spine(outer: Array, inner: Array, height: float) -> list[Patch]:
    """Extrude the section of the spine along y, and close it at both ends.

    Args:
        outer: (K, 2) points (x, z) of its outer side, upwards.
        inner: (K, 2) points (x, z) of its inner side, downwards.
        height: height of the book; the extent along y.
    """
    upward_inner = inner[::-1]
    # Up the outer side and down the inner one is clockwise; a section has to be
    # counter-clockwise.
    section = np.concatenate([outer, inner])[::-1]
    # the path leads along -y, and the section's axes are x and z
    tangent = np.tile([0.0, -1.0, 0.0], (2, 1))
    first_normal = np.tile([1.0, 0.0, 0.0], (2, 1))
    second_normal = np.tile([0.0, 0.0, 1.0], (2, 1))
    path = [(0.0, height / 2, 0.0), (0.0, -height / 2, 0.0)]
    patches = shapes.sweep_section(
        "spine", path, section, frame=(tangent, first_normal, second_normal)
    )
    for side in (1.0, -1.0):
        patches.append(_spine_end(outer, upward_inner, side, height))
    return patches


def _spine_end(outer: Array, inner: Array, side: float, height: float) -> Patch:
    """Create the face at one end of the spine, between its outer and its inner curve.

    Args:
        outer, inner: (K, 2) points (x, z) of both sides, upwards.
        side: 1 for the end at +y, -1 for that at -y.
        height: height of the book.
    """
    outer_row, inner_row = (
        np.insert(curve, 1, side * height / 2, axis=1) for curve in (outer, inner)
    )
    # The order of the two rows decides to which side the face looks.
    rows = [outer_row, inner_row] if side > 0 else [inner_row, outer_row]
    points = np.stack(rows)
    # The chart is as wide as the curves are high, and as high as the spine is deep.
    chart_width = float(np.ptp(outer[:, 1]))
    bulge = float(np.ptp(outer[:, 0]))
    thickness = float(np.linalg.norm(outer[0] - inner[0]))
    return shapes.make_grid_patch(
        "spine",
        points,
        normals=np.broadcast_to([0.0, side, 0.0], points.shape),
        size=(chart_width, bulge + thickness),
        down=np.array([0.0, 1.0]),
        across=np.linspace(0.0, 1.0, len(outer)),
    )


def _cover_paint(
    sampler: ParameterSampler, style: str, cloth: Paint, gold: Array, size: _BookSize
) -> Paint:
    """Sample the paint of a book's covers, with a decoration on the front.

    Args:
        sampler: samples the color of a picture.
        style: "plain" for nothing; "picture" has lines of words and a picture; "frame"
            has words, a ring as a seal, and a frame along the edges; "blocks" has words
            and a seal.
        cloth: paint of both covers.
        gold: color of the decoration and the words.
        size: the size of the book.
    """
    accent = sampler.sample_color("c9a24b", "2f6f8f", "b5442e", "3d6b4a")
    if style == "plain":
        return cloth
    return _decorated_cover(style, cloth, gold, accent, size)


@painter
def _decorated_cover(
    t: Texels, style: str, cloth: Paint, gold: Array, accent: Array, size: _BookSize
) -> Array:
    """Paint the cloth, and on the front the decoration and the words.

    Args:
        t: points of the covers.
        style: "picture", "frame" or "blocks", see `_cover_paint`.
        cloth: paint of both covers.
        gold: color of the decoration and the words.
        accent: color of the picture.
        size: the size of the book.
    """
    color = cloth(t)
    # From the middle of the cover, with y downwards: the spine is at -x, so that
    # the upper edge of the front cover is at +y of the book.
    x = t.xyz[:, 0] - COVER_SHIFT
    y = -t.xyz[:, 1]
    is_front = (t.xyz[:, 2] > size.thickness - 0.1).astype(np.float64)
    if style == "picture":
        picture = _picture_mask(x, y, size) * is_front
        color = blend_colors(color, accent, picture)
        color = blend_colors(color, gold, picture * _picture_spot(x, y, size))
    if style == "frame":
        color = blend_colors(color, gold, _frame_mask(x, y, size) * is_front)
    color = blend_colors(color, gold, _word_mask(x, y, size) * is_front)
    if style != "picture":
        color = blend_colors(color, gold, _seal_mask(x, y, size) * is_front)
    return color


def _in_rectangle(x: Array, y: Array, half_width: float, half_height: float) -> Array:
    """Return the mask of a rectangle around the origin, for points (x, y), each (N,)."""
    in_width = compute_soft_step(half_width - np.abs(x), 0.0, soft=0.12)
    return in_width * compute_soft_step(half_height - np.abs(y), 0.0, soft=0.12)


# Masks (N,) of what is on the front of a book. They take x and y (N,) from the middle
# of the cover, with y downwards.


def _picture_mask(x: Array, y: Array, size: _BookSize) -> Array:
    """Return the mask of a picture above the middle."""
    from_picture_middle = y + 0.12 * size.height
    return _in_rectangle(x, from_picture_middle, 0.36 * size.width, 0.26 * size.height)


def _picture_spot(x: Array, y: Array, size: _BookSize) -> Array:
    """Return the mask of a round spot in the middle of the picture."""
    center_distance = np.hypot(x, y + 0.12 * size.height)
    return compute_soft_step(0.16 * size.width - center_distance, 0.0, soft=0.15)


def _frame_mask(x: Array, y: Array, size: _BookSize) -> Array:
    """Return the mask of a frame along the edges, 0.28 wide."""
    half_width = 0.43 * size.width
    half_height = 0.45 * size.height
    outside = _in_rectangle(x, y, half_width, half_height)
    return outside - _in_rectangle(x, y, half_width - 0.28, half_height - 0.28)


def _word_mask(x: Array, y: Array, size: _BookSize) -> Array:
    """Return the mask of lines of words below the middle."""
    # Lines are 2 units apart. Along a line, noise decides where there is a word; 7.0 is
    # any offset into the noise.
    line_number = np.floor(y / 2.0)
    no_change = np.zeros_like(x)
    noise_position = np.stack([x * 1.5, no_change, line_number], axis=1)
    words = compute_soft_step(compute_value_noise(noise_position + 7.0), 0.3, soft=0.08)
    from_line_middle = np.abs((y / 2.0) % 1.0 - 0.5)
    lines = compute_soft_step(from_line_middle, 0.22, soft=0.1) * words
    from_block_middle = y - 0.24 * size.height  # y is downwards
    block = _in_rectangle(x, from_block_middle, 0.32 * size.width, 0.09 * size.height)
    return np.clip(block * lines, 0.0, 1.0)


def _seal_mask(x: Array, y: Array, size: _BookSize) -> Array:
    """Return the mask of a ring above the middle."""
    center_distance = np.hypot(x, y + 0.16 * size.height)
    disc = compute_soft_step(0.14 * size.width - center_distance, 0.0, soft=0.12)
    return disc - compute_soft_step(0.1 * size.width - center_distance, 0.0, soft=0.12)


# ---- stop sign
# ----------------------------------------------------------------------------------
# A stop sign as it stands at road works, on a low stand. Units are metres; its plate
# looks along +x.
#
# The stand is low because data sets draw the box of a stop sign around its plate: with a
# tall post the box of the object would be much larger.

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
    # in heights of a letter, which is 0.6 wide: distance between letters, and half of
    # the gap between them
    spacing = 0.74
    half_gap = 0.07
    strokes = []
    for index, letter in enumerate(letters):
        left = ((index - len(letters) / 2) * spacing + half_gap) * height
        corner = np.array([left, -height / 2])
        strokes += [np.array(path) * height + corner for path in _STROKES[letter]]
    return strokes


@painter
def _face(t: Texels, red: Array, radius: float) -> Array:
    """Paint the plate of a stop sign, which faces +x.

    The word and a rim are white on red. The plate is painted before it is moved, so its
    center is at the origin.

    Args:
        t: points of the plate.
        red: color.
        radius: radius from the middle of the octagon to its corners.
    """
    _, y, z = t.xyz.T
    apothem = radius * np.cos(np.pi / 8)  # from the middle of the octagon to its sides
    texel_apothem = _octagon_apothem(y, z)
    # The rim is white between 91.5 % and 98.5 % of the apothem.
    rim = compute_soft_step(texel_apothem - 0.915 * apothem, 0.0, soft=0.006)
    rim = rim * compute_soft_step(0.985 * apothem - texel_apothem, 0.0, soft=0.006)

    strokes = _word_strokes("STOP", 0.52 * apothem)
    stroke_distance = shapes.distance_to_polylines(y, z, *strokes)
    word = compute_soft_step(0.05 * apothem - stroke_distance, 0.0, soft=0.006)
    return blend_colors(red, parse_hex_color("f3f2ee"), np.maximum(rim, word))


def _octagon_apothem(y: Array, z: Array) -> Array:
    """Return the apothem (N,) of the octagon whose outline goes through each point.

    Args:
        y, z: coordinates (N,) from the middle of the octagon.
    """
    # Directions of the eight sides' normals, in the plane of y and z. Corners are at 22.5
    # degrees and every 45 degrees from there. A normal is half of that, pi / 8, after
    # each corner.
    side_angles = np.pi * (np.arange(8) + 0.5) / 4 + np.pi / 8
    projections = [y * np.cos(angle) + z * np.sin(angle) for angle in side_angles]
    return np.asarray(np.max(projections, axis=0))


@make_family(unit_in_metres=1.0, texels=192)
def stop_sign(sampler: ParameterSampler) -> Instance:
    """Make a stop sign on a post, turned a little about z.

    Lengths are in metres; the angle is in degrees.
    """
    radius = sampler(0.45, low=0.4, high=0.5)
    height = sampler(0.74, low=0.66, high=0.84)  # height of the plate's middle
    red = sampler.sample_color("b3121d", "a8161f", "c0202a", p_random=0.0)
    patches = [
        *_sign_plate(radius, height),
        *_sign_post(height, radius),
        *_sign_stand(),
        *_sign_clamps(radius, height),
    ]
    paints = _sign_paints(sampler, red, radius)
    turn = shapes.make_rotation_matrix("z", sampler(0.0, low=-25.0, high=25.0))
    return Instance(
        shapes.transform_patches(patches, turn),
        paints,
        FINISHES["face"],
        texel_density={"metal": 0.25, "post": 0.18, "rubber": 0.3},
        materials_by_tag=FINISHES,
    )


def _sign_paints(
    sampler: ParameterSampler, red: Array, radius: float
) -> dict[str, Paint]:
    """Sample the paints of a stop sign by the tags of its parts.

    Args:
        sampler: samples the gray of the post.
        red: color of the plate.
        radius: radius of the plate.
    """
    gray = sampler.sample_color("9a9da0", "7d8083", p_random=0.0)
    return {
        "face": _face(red, radius),
        "metal": paint_solid_color("a4a7aa"),
        "post": paint_solid_color(gray),
        "rubber": paint_solid_color("1d1d1f"),
    }


def _sign_stand() -> list[Patch]:
    """Create the rubber foot of a stop sign, with a block that holds the post."""
    foot = shapes.make_rounded_box(
        "rubber", (0.0, 0.0, 0.03), (0.6, 0.36, 0.06), bevel=0.02, steps=2
    )
    block = shapes.make_rounded_box(
        "post", (0, 0, 0.07), (0.1, 0.1, 0.05), bevel=0.01, steps=1
    )
    return foot + block


def _sign_clamps(radius: float, height: float) -> list[Patch]:
    """Create the two clamps between the post and the plate of a stop sign.

    Args:
        radius, height: radius of the plate, and height of its middle.
    """
    patches = list[Patch]()
    for z in (height - 0.5 * radius, height + 0.5 * radius):
        patches += shapes.make_rounded_box(
            "post", (0.008, 0.0, z), (0.05, 0.09, 0.03), bevel=0.006, steps=1
        )
    return patches


def _sign_plate(radius: float, height: float) -> list[Patch]:
    """Create the octagonal plate of a stop sign, which looks along +x.

    Args:
        radius: radius from its middle to its corners.
        height: height of its middle.
    """
    thickness = 0.004
    ring = shapes.polygon(8, bevel=0.02, steps=2) * radius
    forwards = np.array([1.0, 0.0, 0.0])
    # an octagon whose middle is the origin
    back = np.insert(ring, 0, 0.0, axis=1)
    edge = shapes.sweep_section(
        "metal",
        [(0.0, 0.0, 0.0), thickness * forwards],
        ring,
        start_axis=(0.0, 1.0, 0.0),
    )
    plate = [
        shapes.make_cap_face("face", back + thickness * forwards, forwards),
        *edge,
        shapes.make_cap_face("metal", back[::-1], -forwards),
    ]
    return shapes.transform_patches(plate, offset=(0.036, 0.0, height))


def _sign_post(height: float, plate_radius: float) -> list[Patch]:
    """Create the post of a stop sign: a closed tube that ends behind the plate.

    Args:
        height: height of the middle of the plate.
        plate_radius: radius of the plate.
    """
    top = height + 0.7 * plate_radius
    tube = shapes.round_corners(
        [(0.03, 0.0), (0.03, top), (0.0, top + 0.004)], radius=0.004, steps=2
    )
    bottom = [(0.0, 0.0), (0.03, 0.0)]
    return shapes.revolve_profile(
        [("post", bottom), ("post", tube[:-1]), ("post", tube[-2:])], columns=20
    )
