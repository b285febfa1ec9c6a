"""Teapot and frying pan: turned bodies with swept parts. Units are centimetres."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

import advsearch.questions.harden.objects.shapes as shapes
from advsearch.extend import assets
from advsearch.questions.harden.objects.family import (
    Instance,
    make_family,
    sample_material,
)
from advsearch.questions.harden.objects.shapes import Array, Patch, Points
from advsearch.questions.harden.objects.textures import (
    Color,
    Paint,
    ParameterSampler,
    Texels,
    add_specks,
    choose_paint_or_random,
    compute_soft_step,
    dots,
    make_range_mask,
    paint_over,
    paint_shaded_clouds,
    paint_solid_color,
    painter,
    rings,
    scale_brightness,
    stripes,
    wood,
)

SPOUT_POINTS = 18  # points of the path of a spout
SPOUT_WALL = 0.24  # thickness
VIEW_DEGREES = 118.0
"""Rotation about z of teapot and pan, which the default camera sees from the side."""


def _spout(sampler: ParameterSampler, radius: float, height: float) -> list[Patch]:
    """Create a spout along +x with an open, hollow end.

    A closed ring is swept along the path to the tip, then over the lip and back down
    the inside for a few points, where it shrinks to a point.

    Args:
        sampler: samples its proportions.
        radius, height: radius and height of the teapot's body.
    """
    path = _spout_path(sampler, radius, height)
    root_radius = sampler(1.75, low=1.3, high=2.2)
    tip_radius = sampler(0.72, low=0.55, high=0.95)
    t = np.linspace(0.0, 1.0, SPOUT_POINTS)  # from the body to the tip
    outer_radii = tip_radius + (root_radius - tip_radius) * (1.0 - t) ** 1.3
    point_of_ring, radii, distance_ahead = _spout_rings(outer_radii)
    path_frame = shapes.compute_frames(path, (0.0, 1.0, 0.0))
    tangent, first_normal, second_normal = (axis[point_of_ring] for axis in path_frame)
    ring_centers = path[point_of_ring] + distance_ahead[:, None] * tangent
    return shapes.sweep_section(
        "spout",
        ring_centers,
        shapes.ellipse(1.0, 1.0, count=20),
        radii,
        frame=(tangent, first_normal, second_normal),
    )


def _spout_rings(outer_radii: Array) -> tuple[assets.IntArray, Array, Array]:
    """Return the rings of a spout: its outside, its lip, and its hollow inside.

    Args:
        outer_radii: radii (`SPOUT_POINTS`,) of the outside at the points of the path.

    Returns:
        Three arrays (R,) with an entry for each ring: the index of its point of the
        path, its radius, and how far it lies ahead of that point.
    """
    tip = SPOUT_POINTS - 1
    # Two rings make the round lip at the tip, four go back down inside of the wall, and
    # the last one, with radius 0, closes the hollow.
    outside = range(SPOUT_POINTS)
    lip = [tip, tip]
    inside = [tip, tip - 1, tip - 2, tip - 3]
    point_of_ring = np.array([*outside, *lip, *inside, tip - 4])
    lip_radii = [outer_radii[tip] - 0.06, outer_radii[tip] - 0.12]
    inner_radii = outer_radii[inside] - SPOUT_WALL
    radii = np.concatenate([outer_radii, lip_radii, inner_radii, [0.0]])
    # Both rings of the lip and the first one inside lie a little ahead of the tip, so
    # that the lip is round.
    distance_ahead = np.zeros(len(point_of_ring))
    distance_ahead[SPOUT_POINTS : SPOUT_POINTS + 3] = (0.1, 0.12, 0.06)
    return point_of_ring, radii, distance_ahead


def _spout_path(sampler: ParameterSampler, radius: float, height: float) -> Array:
    """Sample the path of a spout in the x-z plane, from the body to the tip.

    A curved spout has the shape of an S: it bulges out and downwards in the middle, and
    is bent back a little before the tip.

    Args:
        sampler: samples the style of the spout and its ends.
        radius, height: radius and height of the teapot's body.

    Returns:
        The path (`SPOUT_POINTS`, 3).
    """
    style = sampler.sample_choice("curved", "straight")
    start_z = height * sampler(0.34, low=0.26, high=0.42)
    tip_x = radius * sampler(1.85, low=1.6, high=2.0)
    tip_z = height * sampler(0.94, low=0.8, high=1.02)
    start = np.array([radius * 0.72, 0.0, start_z])
    tip = np.array([tip_x, 0.0, tip_z])
    # how far it departs from a straight line, as a fraction of the radius
    bend = 0.22 if style == "curved" else 0.04
    bulge = np.array([bend, 0.0, -0.6 * bend]) * radius * 0.5
    bend_back = np.array([-bend * 0.1, 0.0, -0.1 * bend]) * radius
    middle = (start + tip) / 2 + bulge
    before_tip = start + (tip - start) * 0.8 + bend_back
    return shapes.sample_spline([start, middle, before_tip, tip], count=SPOUT_POINTS)


@make_family(unit_in_metres=0.01)
def teapot(sampler: ParameterSampler) -> Instance:
    """Make a teapot with spout, handle and lid of random proportions."""
    radius = sampler(7.2, low=6.4, high=8.0)
    height = sampler(10.2, low=8.0, high=12.5)
    patches = _teapot_patches(sampler, radius, height)
    view_rotation = shapes.make_rotation_matrix("z", VIEW_DEGREES)
    return Instance(
        shapes.transform_patches(patches, view_rotation),
        _teapot_paints(sampler, height),
        sample_material(sampler, roughness=0.25, clearcoat=0.7),
        texel_density={"base": 0.6},
    )


def _teapot_patches(
    sampler: ParameterSampler, radius: float, height: float
) -> list[Patch]:
    """Create a teapot with its spout at +x and its handle at -x.

    Args:
        sampler: samples its proportions.
        radius, height: radius and height of its body.
    """
    side, body = _teapot_body(sampler, radius, height)
    handle = _teapot_handle(sampler, side, radius, height)
    # Spout and handle are both made at +x, and the handle is turned.
    opposite = shapes.make_rotation_matrix("z", 180.0)
    return [
        *body,
        *_spout(sampler, radius, height),
        *shapes.transform_patches(handle, opposite),
    ]


def _teapot_body(
    sampler: ParameterSampler, radius: float, height: float
) -> tuple[Array, list[Patch]]:
    """Return the profile (26, 2) of the side, and the body with its lid and knob.

    Points of profiles are (r, z). The side goes from the foot over the belly to the
    mouth.

    Args:
        sampler: samples its proportions.
        radius: radius of the belly.
        height: height of the mouth.
    """
    knots = _sample_teapot_knots(sampler, radius, height)
    foot, _ = knots[0]
    mouth, _ = knots[-1]
    side = shapes.sample_spline(knots, count=26)
    under = [(0.0, 0.2), (foot * 0.8, 0.2), (foot * 0.86, 0.0), (foot * 0.97, 0.0)]
    profile: list[tuple[str, Points]] = [
        ("base", under),
        ("body", [under[-1], *side]),
        *_lid_profile(sampler, mouth, height),
    ]
    return side, shapes.revolve_profile(profile, columns=56)


def _sample_teapot_knots(
    sampler: ParameterSampler, radius: float, height: float
) -> list[tuple[float, float]]:
    """Sample the points (r, z) of a teapot's side, from the foot to the mouth.

    Args:
        sampler: samples its proportions.
        radius: radius of the belly.
        height: height of the mouth.
    """
    foot = radius * sampler(0.58, low=0.5, high=0.75)
    mouth = radius * sampler(0.48, low=0.42, high=0.6)
    # a fraction of the height, and of the radius halfway up to the belly
    belly_height = sampler(0.45, low=0.35, high=0.58)
    fullness = sampler(0.9, low=0.82, high=0.97)
    return [
        (foot, 0.5),
        (radius * fullness, 0.5 * belly_height * height),
        (radius, belly_height * height),
        (radius * (0.97 * fullness), (0.42 * belly_height + 0.58) * height),
        (mouth, height),
    ]


def _lid_profile(
    sampler: ParameterSampler, mouth: float, height: float
) -> list[tuple[str, Points]]:
    """Return the tags and profiles of a teapot's mouth, lid and knob, upwards.

    Args:
        sampler: samples the lid's dome and the knob's radius.
        mouth, height: radius and height of the mouth.
    """
    dome = sampler(1.5, low=0.7, high=2.4)
    knob_radius = sampler(1.0, low=0.7, high=1.4)
    top = height + dome + 0.2  # height of the lid's top
    rim = _mouth_rim(mouth, height)
    lid_knots = [
        rim[-1],
        (mouth * 0.9, height + 0.35),
        (mouth * 0.55, height + 0.75 * dome + 0.2),
        (0.35, top),
    ]
    lid = shapes.sample_spline(lid_knots, count=10)
    knob = _knob_profile(knob_radius, top)
    return [("body", rim), ("lid", lid), ("knob", [lid[-1], *knob])]


def _mouth_rim(mouth: float, height: float) -> list[tuple[float, float]]:
    """Return the points (r, z) of the edge of a teapot's mouth.

    It has a narrow groove where the lid begins.

    Args:
        mouth, height: radius and height of the mouth.
    """
    return [
        (mouth, height),
        (mouth * 0.97, height + 0.02),
        (mouth * 0.94, height - 0.12),
        (mouth * 0.94, height + 0.05),
        (mouth * 0.97, height + 0.05),
    ]


def _knob_profile(radius: float, bottom: float) -> Array:
    """Return the points (12, 2), (r, z), of the knob of a lid.

    Args:
        radius: radius of the knob.
        bottom: height at which it begins.
    """
    knots = [
        (0.45, bottom),
        (0.5, bottom + 0.3),
        (radius, bottom + 0.45 + radius * 0.6),
        (0.7 * radius, bottom + 0.45 + 1.35 * radius),
        (0.0, bottom + 0.45 + 1.6 * radius),
    ]
    return shapes.sample_spline(knots, count=12)


def _teapot_handle(
    sampler: ParameterSampler, side: Array, radius: float, height: float
) -> list[Patch]:
    """Create the handle in the x-z plane, on the +x side of the body.

    Args:
        sampler: samples its curve and its section.
        side: profile (K, 2) of the body.
        radius, height: radius and height of the body.
    """
    curve = _sample_teapot_handle_curve(sampler, side, radius, height)
    section = shapes.ellipse(
        sampler(0.5, low=0.4, high=0.7), sampler(0.62, low=0.45, high=0.85), count=16
    )
    root_flare = 1.0 + 0.2 * np.abs(np.linspace(-1, 1, 26)) ** 3  # thicker at both ends
    return shapes.sweep_section(
        "handle", shapes.to_xz_plane(curve), section, root_flare
    )


def _sample_teapot_handle_curve(
    sampler: ParameterSampler, side: Array, radius: float, height: float
) -> Array:
    """Sample the curve (26, 2), (x, z), of a teapot's handle, from top to bottom.

    Args:
        sampler: samples how far it reaches.
        side: profile (K, 2) of the body.
        radius, height: radius and height of the body.
    """
    span = sampler(0.9, low=0.75, high=1.0)
    top = height * 0.84
    bottom = height * (0.84 - 0.62 * span)
    # both ends lie a little inside the wall
    top_radius = shapes.radius_at_height(side, top) - 0.25
    bottom_radius = shapes.radius_at_height(side, bottom) - 0.25
    reach = radius * sampler(0.72, low=0.5, high=0.9)
    lift = sampler(0.05, low=-0.02, high=0.2) * height
    middle_reach = sampler(0.95, low=0.7, high=1.0) * reach
    knots = [
        (top_radius, top),
        (radius + 0.35 * reach, top + lift),
        (radius + 0.9 * reach, top - 0.1 * (top - bottom)),
        (radius + middle_reach, 0.5 * (top + bottom)),
        (radius + 0.4 * reach, bottom + 0.08 * (top - bottom)),
        (bottom_radius, bottom),
    ]
    return shapes.sample_spline(knots, count=26)


def _teapot_paints(sampler: ParameterSampler, height: float) -> dict[str, Paint]:
    """Sample the paints of a teapot of a height, by the tags of its parts."""
    offset = sampler.sample_noise_offset()
    clay = sampler.sample_color(
        "7b2d26", "f2eee4", "2f5d7c", "3d5c47", "22262b", "c98a3a", "e7b9b0"
    )
    glaze = paint_shaded_clouds(
        clay, factor=1.25, scale=3.5, offset=offset, contrast=1.6
    )
    accent = sampler.sample_color("e8cfa0", "23408f", "c9a24b", "f4efe4", "b5442e")
    decoration = _teapot_decoration(sampler, clay, glaze, accent, height, offset)
    body = choose_paint_or_random(sampler, height + 4.0, decoration)
    return {
        "base": paint_solid_color("a98663"),
        "body": body,
        **_sample_attached_paints(sampler, glaze, paint_solid_color(accent), body),
    }


def _sample_attached_paints(
    sampler: ParameterSampler, glaze: Paint, accent: Paint, body: Paint
) -> dict[str, Paint]:
    """Sample which paint the lid, the spout, the handle and the knob of a teapot have.

    Args:
        sampler: chooses the paints.
        glaze: paint of the clay.
        accent: paint of the decoration's color.
        body: paint of the body.
    """
    trim = sampler.sample_choice(glaze, accent, body)
    lid = sampler.sample_choice(body, trim)
    spout = sampler.sample_choice(glaze, body)
    handle = sampler.sample_choice(glaze, trim)
    has_accent_knob = sampler.sample_bool(0.5, canonical=True)
    return {
        "lid": lid,
        "spout": spout,
        "handle": handle,
        "knob": accent if has_accent_knob else trim,
    }


def _teapot_decoration(
    sampler: ParameterSampler,
    clay: Color,
    glaze: Paint,
    accent: Color,
    height: float,
    offset: Array,
) -> Paint:
    """Sample what is painted on the body of a teapot.

    Args:
        sampler: samples the kind and its proportions.
        clay: color of the teapot.
        glaze: paint of that color.
        accent: color of the decoration.
        height: height of the teapot.
        offset: (3,) into the noise.
    """
    kind = sampler.sample_choice(
        "bands", "plain", "dots", "stripes", "rings", "speckle"
    )
    if kind == "bands":
        return _paint_bands(glaze, paint_solid_color(accent), height)
    if kind == "dots":
        cell = sampler(2.6, low=1.6, high=4.0)
        radius = sampler(0.28, low=0.18, high=0.4)
        return dots(glaze, accent, cell=cell, radius=radius)
    if kind == "stripes":
        cell = sampler(3.0, low=1.5, high=5.0)
        fraction = sampler(0.4, low=0.2, high=0.6)
        return stripes(clay, accent, cell=cell, fraction=fraction)
    if kind == "rings":
        return rings(clay, accent, period=sampler(2.0, low=1.0, high=4.0))
    if kind == "speckle":
        return add_specks(glaze, accent, scale=0.5, offset=offset)
    return glaze


def _paint_bands(glaze: Paint, accent: Paint, height: float) -> Paint:
    """Paint two bands around a teapot of a height, the upper one narrower."""
    lower_band = make_range_mask(0.7 * height, 0.74 * height, soft=0.1)
    upper_band = make_range_mask(0.77 * height, 0.785 * height, soft=0.1)
    return paint_over(paint_over(glaze, lower_band, accent), upper_band, accent)


class _PanSize(NamedTuple):
    """Measures of a frying pan in centimeters.

    Attributes:
        base_radius, rim_radius: radii at the bottom and at the rim.
        depth: height of the rim.
        wall: thickness of the wall.
    """

    base_radius: float
    rim_radius: float
    depth: float
    wall: float


@make_family(unit_in_metres=0.01)
def frying_pan(sampler: ParameterSampler) -> Instance:
    """Make a frying pan with a random handle."""
    size = _PanSize(
        base_radius=sampler(10.5, low=9.0, high=11.5),
        rim_radius=sampler(13.0, low=12.2, high=14.5),
        depth=sampler(4.2, low=2.8, high=5.5),
        wall=sampler(0.38, low=0.3, high=0.55),
    )
    view_rotation = shapes.make_rotation_matrix("z", VIEW_DEGREES)
    patches = _pan_patches(sampler, size)
    return Instance(
        shapes.transform_patches(patches, view_rotation),
        _pan_paints(sampler, size.rim_radius, size.depth),
        sample_material(sampler, roughness=0.38, clearcoat=0.3),
        texel_density={"base": 0.5},
    )


def _pan_patches(sampler: ParameterSampler, size: _PanSize) -> list[Patch]:
    """Create the body of a pan, and its handle along +x with bracket and rivets."""
    side = _pan_side(size)
    body = shapes.make_vessel(side, wall=size.wall, floor=0.5, columns=64, step=1.6)
    length = sampler(18.0, low=14.0, high=21.0)
    root = np.array([size.rim_radius - 0.6, 0.0, 0.78 * size.depth])
    rise = sampler(2.6, low=0.6, high=4.5)
    handle = _pan_handle(sampler, root, length, rise)
    bracket = _pan_bracket(size.rim_radius, size.depth, length, rise)
    # The bracket goes through the wall at this height.
    rivet_z = 0.72 * size.depth
    rivets = _pan_rivets(shapes.radius_at_height(side, rivet_z) - size.wall, rivet_z)
    return [*body, *handle, *rivets, *bracket]


def _pan_side(size: _PanSize) -> Array:
    """Return the profile (14, 2), (r, z), of a pan's outside, from bottom to rim."""
    widening = size.rim_radius - size.base_radius
    knots = [
        (size.base_radius - 0.8, 0.0),
        (size.base_radius, 0.25),
        (size.base_radius + 0.55 * widening, 0.5 * size.depth),
        (size.rim_radius, size.depth),
    ]
    return shapes.sample_spline(knots, count=14)


def _pan_bracket(
    rim_radius: float, depth: float, length: float, rise: float
) -> list[Patch]:
    """Create the bracket that holds the handle of a pan: a flat bar through the wall.

    Args:
        rim_radius: radius of the pan's rim.
        depth: depth of the pan.
        length: length of the handle.
        rise: by how much the end of the handle is higher than its root.
    """
    path = [
        (rim_radius - 1.4, 0.72 * depth),
        (rim_radius - 0.3, 0.75 * depth),
        (rim_radius + 0.2 * length, 0.78 * depth + 0.5 * rise),
    ]
    return shapes.sweep_section(
        "bracket",
        shapes.to_xz_plane(np.array(path)),
        shapes.rectangle(0.7, 3.0, bevel=0.25),
        (1.0, 1.0, 0.62),
        has_caps=True,
    )


def _pan_handle(
    sampler: ParameterSampler, root: Array, length: float, rise: float
) -> list[Patch]:
    """Create a handle along +x, which rises and has a round end.

    Its section is scaled along the path: it is narrow at the root and has its full
    width after a third.

    Args:
        sampler: samples its curve and its section.
        root: point at which it begins (3,).
        length: its length along x.
        rise: approximate height of its end above the root.
    """
    end_rise = rise * sampler(1.05, low=0.8, high=1.2)
    knots = [(0.0, 0.0), (0.22 * length, 0.55 * rise), (0.6 * length, rise)]
    curve = shapes.to_xz_plane(np.array([*knots, (length, end_rise)]))
    path = shapes.sample_spline(root + curve, count=26)
    scale = _sample_pan_handle_scale(sampler)
    # Sections reach from -1 to 1; `scale` makes them as wide as the handle.
    if sampler.sample_bool(0.5, canonical=True):
        section = shapes.ellipse(1.0, 1.0, count=20)
    else:
        section = shapes.rectangle(2.0, 2.0, bevel=0.7)
    return shapes.sweep_section("handle", path, section, scale)


def _sample_pan_handle_scale(sampler: ParameterSampler) -> Array:
    """Sample half the thickness and half the width (26, 2) along a pan's handle."""
    t = np.linspace(0.0, 1.0, 26)  # from the root to the end
    max_width = sampler(1.15, low=0.85, high=1.5)
    max_thickness = sampler(0.62, low=0.45, high=0.9)
    bulge = sampler(0.12, low=0.0, high=0.25)  # in the middle
    relative_width = (0.62 + 0.38 * np.clip(t / 0.35, 0.0, 1.0) ** 1.5) * (
        1.0 + bulge * np.sin(np.pi * t)
    )
    relative_thickness = 0.7 + 0.3 * np.clip(t / 0.3, 0.0, 1.0)
    # a quarter of an ellipse over the last 6 %
    end_fraction = ((t - 0.94) / 0.06).clip(0.0, 1.0)
    rounding = np.sqrt(np.clip(1.0 - end_fraction**2, 0.0, 1.0))
    scale = np.stack(
        [max_thickness * relative_thickness, max_width * relative_width], axis=1
    )
    return scale * rounding[:, None]


def _pan_rivets(radius: float, height: float) -> list[Patch]:
    """Create the two rivets of the bracket on the inside of a pan.

    Args:
        radius: radius of the inside of the wall at that height.
        height: height of the rivets.
    """
    center = (radius + 0.02, 0.0, height)
    rivet = shapes.make_sphere_patches("rivet", 0.38, center=center, rows=8, columns=12)
    left = shapes.transform_patches(rivet, offset=(0.0, -1.1, 0.0))
    right = shapes.transform_patches(rivet, offset=(0.0, 1.1, 0.0))
    return left + right


def _pan_paints(
    sampler: ParameterSampler, rim_radius: float, depth: float
) -> dict[str, Paint]:
    """Sample the paints of a pan, by the tags of its parts.

    Args:
        sampler: samples the paints.
        rim_radius: radius of its rim.
        depth: height of its rim.
    """
    offset = sampler.sample_noise_offset()
    coating = _pan_coating(sampler, offset)
    enamel = _pan_enamel(sampler, depth, offset)
    outside = choose_paint_or_random(sampler, 2 * rim_radius, enamel, p_random=0.3)
    inside = choose_paint_or_random(sampler, 2 * rim_radius, coating, p_random=0.2)
    handle = _sample_pan_handle_paint(sampler, offset)
    steel = paint_solid_color(sampler.sample_color("b9bcc0", "8c8f94", p_random=0.1))
    return {
        "outside": outside,
        "inside": inside,
        "handle": handle,
        "rivet": steel,
        "bracket": steel,
        "base": paint_solid_color(sampler.sample_color("77797c", "2b2c2e")),
    }


def _sample_pan_handle_paint(sampler: ParameterSampler, offset: Array) -> Paint:
    """Sample the paint of a pan's handle, with an offset (3,) into the noise.

    The colors of all three kinds are sampled, whichever is used.
    """
    kind = sampler.sample_choice("black", "wood", "colored")
    black = sampler.sample_color("1b1b1d", "2a2a2c", p_random=0.1)
    timber = sampler.sample_color("8a5a32", "b98550", p_random=0.0)
    color = sampler.sample_color("a9231f")
    if kind == "wood":
        return wood(timber, scale=1.4, offset=offset, axis=0)
    return paint_solid_color(black if kind == "black" else color)


def _pan_coating(sampler: ParameterSampler, offset: Array) -> Paint:
    """Sample the speckled coating of the inside of a pan, often with faint rings.

    Args:
        sampler: samples the color and whether it has rings.
        offset: (3,) into the noise.
    """
    coat = sampler.sample_color(
        "2b2c2e", "3a3a3c", "1c1d1f", "8c8f94", "5c4033", p_random=0.2
    )
    coating = add_specks(
        paint_shaded_clouds(coat, factor=1.2, scale=5.0, offset=offset),
        scale_brightness(coat, 1.7),
        scale=0.5,
        offset=offset,
        amount=0.06,
    )
    if sampler.sample_bool(0.4, canonical=True):
        return paint_over(
            coating, _turning_rings(), paint_solid_color(scale_brightness(coat, 1.6))
        )
    return coating


@painter
def _turning_rings(t: Texels) -> Array:
    """Return the mask of faint rings around the z axis, as turning leaves."""
    phase = 2 * np.pi * np.hypot(t.xyz[:, 0], t.xyz[:, 1]) / 0.9
    return compute_soft_step(np.sin(phase), 0.6, soft=0.8) * 0.35


def _pan_enamel(sampler: ParameterSampler, depth: float, offset: Array) -> Paint:
    """Sample the outside of a pan: darker at the bottom, with a dark line at the rim.

    Args:
        sampler: samples the color.
        depth: height of the rim.
        offset: (3,) into the noise.
    """
    color = sampler.sample_color(
        "a9231f", "2b2c2e", "9a9da1", "2f5d7c", "3d6b4a", "d9822b"
    )
    enamel = paint_shaded_clouds(color, factor=0.85, scale=5.0, offset=offset)
    is_bottom = make_range_mask(-1.0, 0.25 * depth, soft=0.6 * depth)
    enamel = paint_over(
        enamel, is_bottom, paint_solid_color(scale_brightness(color, 0.6))
    )
    return paint_over(
        enamel,
        make_range_mask(depth - 0.1, 2 * depth, soft=0.15),
        paint_solid_color("2b2c2e"),
    )
