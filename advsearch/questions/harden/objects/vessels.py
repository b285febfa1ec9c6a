"""Open containers of revolution: mug, bowl, bottle, vase, wine glass.

Lengths are in centimeters, and z is up. `sampler(9.4, low=7.6, high=12.0)` is 9.4 for
the canonical instance, and uniform between the bounds for others. Profiles are points
(r, z).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

import advsearch.questions.harden.objects.shapes as shapes
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
    add_specks,
    checks,
    choose_paint_or_random,
    compute_soft_step,
    dots,
    gradient,
    make_facing_mask,
    make_range_mask,
    paint_over,
    paint_shaded_clouds,
    paint_solid_color,
    paint_two_color_clouds,
    painter,
    parse_hex_color,
    rings,
    sample_paint,
    scale_brightness,
    stripes,
    zigzag,
)

# turns the seam of a lathe away from the default camera, which is at an azimuth of 40
SEAM_ROTATION = shapes.make_rotation_matrix("z", 220.0)
HANDLE_POINTS = 26  # points of the curve of a handle
LABEL_AZIMUTH = 180.0  # degrees about z; opposite the seam of the texture
PALE = "f4efe4"  # the light color of printed patterns


def make_handle(
    sampler: ParameterSampler,
    style: str,
    bottom: float,
    top: float,
    reach: float,
    profile: Array,
    inset: float,
) -> list[Patch]:
    """Create a handle in the x-z plane, on the +x side of a wall.

    It is thicker at both roots. Its section is an ellipse or a rounded rectangle.

    Args:
        sampler: samples its thickness.
        style: "round", "ear" (widest at the top), "square" or "loop" (small).
        bottom, top: heights of its roots.
        reach: its extent from the wall.
        profile: profile of the wall (K, 2).
        inset: depth of the roots inside the wall.
    """
    bottom_radius = shapes.radius_at_height(profile, bottom) - inset
    top_radius = shapes.radius_at_height(profile, top) - inset
    curve = _handle_curve(style, (bottom_radius, bottom), (top_radius, top), reach)
    section = _sample_handle_section(sampler)
    # up to a quarter thicker at both ends
    root_flare = 1.0 + 0.25 * np.abs(np.linspace(-1.0, 1.0, len(curve))) ** 4
    return shapes.sweep_section(
        "handle", shapes.to_xz_plane(curve), section, root_flare
    )


def _sample_handle_section(sampler: ParameterSampler) -> Array:
    """Sample the section (M, 2) of a handle: an ellipse or a rounded rectangle."""
    half_thickness = sampler(0.42, low=0.32, high=0.6)
    half_width = sampler(0.62, low=0.4, high=0.95)
    if sampler.sample_bool(0.7, canonical=True):
        return shapes.ellipse(half_thickness, half_width, count=16)
    return shapes.rectangle(
        2 * half_thickness, 2 * half_width, bevel=0.6 * half_thickness
    )


REACHES = {
    "round": (0.82, 0.98, 0.82),
    "ear": (0.98, 0.9, 0.5),
    "loop": (0.85, 1.0, 0.85),
}
"""How far a handle extends near the top, the middle and the bottom, as fractions."""


def _handle_curve(
    style: str,
    bottom_root: tuple[float, float],
    top_root: tuple[float, float],
    reach: float,
) -> Array:
    """Return the curve (K, 2) of a handle from its upper to its lower root.

    Args:
        style: "round", "ear" (widest at the top), "square" or "loop" (small).
        bottom_root, top_root: (r, z) where the handle meets the wall.
        reach: its extent from the wall.
    """
    if style == "square":
        return _square_handle_curve(bottom_root, top_root, reach)
    bottom = bottom_root[1]
    top = top_root[1]
    wall_radius = max(bottom_root[0], top_root[0])
    upper_reach, middle_reach, lower_reach = REACHES[style]
    height = top - bottom
    knots = [
        top_root,
        (wall_radius + 0.45 * reach, top + 0.04 * height),
        (wall_radius + upper_reach * reach, top - 0.16 * height),
        (wall_radius + middle_reach * reach, (bottom + top) / 2),
        (wall_radius + lower_reach * reach, bottom + 0.18 * height),
        (wall_radius + 0.3 * reach, bottom + 0.03 * height),
        bottom_root,
    ]
    return shapes.sample_spline(knots, count=HANDLE_POINTS)


def _square_handle_curve(
    bottom_root: tuple[float, float], top_root: tuple[float, float], reach: float
) -> Array:
    """Return the curve (K, 2) of a handle with two rounded bends, downwards.

    Args:
        bottom_root, top_root: (r, z) where the handle meets the wall.
        reach: its extent from the wall.
    """
    outer = max(bottom_root[0], top_root[0]) + reach
    corners = [top_root, (outer, top_root[1]), (outer, bottom_root[1]), bottom_root]
    rounded = shapes.round_corners(corners, radius=0.45 * reach, steps=6)
    # The spline distributes its points evenly; the dense polyline keeps its corners.
    dense = shapes.subdivide(rounded, longest=0.8)
    return shapes.sample_spline(dense, count=HANDLE_POINTS)


def _ceramic(
    sampler: ParameterSampler, height: float, glaze: Paint, accent: Paint
) -> Paint:
    """Sample a decoration as a potter or a printer puts it around a vessel.

    Args:
        sampler: samples its kind, its proportions and its second color.
        height: height of the vessel.
        glaze: the ground of most decorations; alone on a plain vessel.
        accent: the paint of a single band, and of the upper part of a dipped vessel.
    """
    kind = sampler.sample_choice(
        "band", "plain", "bands", "dots", "stripes", "dip", "checks", "zigzag", "rings"
    )
    second_color = sampler.sample_color(
        "2f5d7c", "b5442e", "356b4f", "e0b040", "22262b", "f2efe6"
    )
    if kind in ("band", "bands", "checks", "zigzag", "dip"):
        return _ceramic_belt(sampler, kind, height, glaze, accent, second_color)
    if kind == "dots":
        cell = sampler(2.0, low=1.2, high=3.2)
        radius = sampler(0.3, low=0.2, high=0.4)
        return dots(glaze, second_color, cell=cell, radius=radius)
    if kind == "stripes":
        return _ceramic_stripes(sampler, second_color)
    if kind == "rings":
        return _ceramic_rings(sampler, height, second_color)
    return glaze


def _ceramic_stripes(sampler: ParameterSampler, color: Array) -> Paint:
    """Sample stripes of a color on a pale ground."""
    return stripes(
        sampler.sample_color(PALE, "f4f4f2"),
        color,
        cell=sampler(1.8, low=1.0, high=4.0),
        fraction=sampler(0.5, low=0.25, high=0.6),
        slant=int(sampler.sample_choice(0, 2)),
    )


def _ceramic_rings(sampler: ParameterSampler, height: float, color: Array) -> Paint:
    """Sample rings of a color on a pale ground, for a vessel of a height."""
    return rings(
        sampler.sample_color(PALE),
        color,
        period=height * sampler(0.12, low=0.06, high=0.25),
        fraction=sampler(0.5, low=0.2, high=0.7),
    )


def _ceramic_belt(
    sampler: ParameterSampler,
    kind: str,
    height: float,
    glaze: Paint,
    accent: Paint,
    second_color: Array,
) -> Paint:
    """Sample a decoration between two heights of a vessel.

    Args:
        sampler: samples heights and colors.
        kind: "band", "dip" (all above a height), "bands", "checks" or "zigzag".
        height: height of the vessel.
        glaze: paint of the rest of the vessel.
        accent: paint of a band and of the dipped part.
        second_color: color of the pattern of the other kinds.
    """
    if kind == "band":
        low = sampler(0.36, low=0.1, high=0.5) * height
        high = sampler(0.72, low=0.55, high=0.9) * height
        return paint_over(glaze, make_range_mask(low, high, soft=0.12), accent)
    if kind == "dip":
        low = sampler(0.5, low=0.3, high=0.7) * height
        # twice the height: up to the top, with some margin for the lip
        return paint_over(glaze, make_range_mask(low, 2 * height, soft=0.1), accent)
    return _sample_patterned_belt(sampler, kind, height, glaze, second_color)


def _sample_patterned_belt(
    sampler: ParameterSampler, kind: str, height: float, glaze: Paint, color: Array
) -> Paint:
    """Sample a belt with a pattern of two colors.

    Args:
        sampler: samples the proportions and the pale color.
        kind: "bands", "checks" or "zigzag".
        height: height of the vessel.
        glaze: paint of the rest of the vessel.
        color: the other color of the pattern.
    """
    if kind == "bands":
        bands = rings(parse_hex_color(PALE), color, period=0.13 * height)
        return paint_over(glaze, make_range_mask(0.62 * height, 0.9 * height), bands)
    pale = sampler.sample_color(PALE)
    if kind == "checks":
        board = checks(pale, color, cell=sampler(1.4, low=0.9, high=2.2))
        return paint_over(glaze, make_range_mask(0.25 * height, 0.75 * height), board)
    chevrons = zigzag(pale, color, cell=2.5)
    return paint_over(glaze, make_range_mask(0.3 * height, 0.7 * height), chevrons)


@make_family(unit_in_metres=0.01)
def mug(sampler: ParameterSampler) -> Instance:
    """Make a mug with a handle.

    Lengths are in centimeters. `sampler(x, low=..., high=...)` returns x for the
    canonical mug and a uniform sample for a random one.
    """
    height = sampler(9.4, low=7.6, high=12.0)
    wall, side, body = _mug_body(sampler, height)
    handle = _mug_handle(sampler, height, wall, side)
    paints = _mug_paints(sampler, height)
    # -108 degrees: in the usual view the handle is at the side, where it is visible.
    turn = shapes.make_rotation_matrix("z", -108.0)
    patches = [*body, *shapes.transform_patches(handle, turn)]
    return Instance(
        shapes.transform_patches(patches, SEAM_ROTATION),
        paints,
        sample_material(sampler, roughness=0.3, clearcoat=0.5),
        # These parts are hardly visible, so they get fewer texels.
        texel_density={"inside": 0.8, "base": 0.6},
    )


def _mug_handle(
    sampler: ParameterSampler, height: float, wall: float, side: Array
) -> list[Patch]:
    """Create the handle of a mug on its +x side.

    Args:
        sampler: samples its style and its size.
        height: height of the mug.
        wall: thickness of its wall.
        side: profile (K, 2) of its side.
    """
    style = sampler.sample_choice("ear", "round", "square", "loop")
    handle_top = height * sampler(0.85, low=0.76, high=0.88)
    if style == "loop":
        # never the canonical mug, whose handle is an "ear": so 0.3 is not used
        handle_bottom = height * sampler(0.3, low=0.34, high=0.42)
    else:
        handle_bottom = height * sampler(0.2, low=0.16, high=0.3)
    return make_handle(
        sampler,
        style,
        bottom=handle_bottom,
        top=handle_top,
        reach=sampler(2.9, low=2.3, high=3.4),
        profile=side,
        inset=0.55 * wall,
    )


def _mug_body(
    sampler: ParameterSampler, height: float
) -> tuple[float, Array, list[Patch]]:
    """Create a mug without its handle.

    Args:
        sampler: samples its proportions.
        height: height of the mug.

    Returns:
        The thickness of its wall; the profile (14, 2) of its side, points (r, z) from
        the foot's edge upwards; and its patches.
    """
    rim = sampler(4.15, low=3.6, high=5.0)
    foot = rim * sampler(0.93, low=0.72, high=1.02)
    bulge = sampler(0.0, low=-0.06, high=0.13) * rim
    wall = sampler(0.36, low=0.28, high=0.5)
    edge = sampler(0.7, low=0.3, high=1.2)  # size of the round edge at the foot
    side = shapes.sample_spline(
        [(foot, edge), (0.5 * (foot + rim) + bulge, 0.5 * height), (rim, height)],
        count=14,
    )
    foot_edge = [(foot - edge, 0.0), (foot - 0.3 * edge, 0.25 * edge)]
    outside = np.concatenate([foot_edge, side])
    body = shapes.make_vessel(outside, wall=wall, floor=sampler(0.6, low=0.5, high=0.9))
    return wall, side, body


def _mug_paints(sampler: ParameterSampler, height: float) -> dict[str, Paint]:
    """Sample the paints of a mug of a height, by the tags of its parts.

    Args:
        sampler: samples the paints; the canonical mug has a raw foot.
        height: height of the mug.
    """
    offset = sampler.sample_noise_offset()
    glaze = _sample_speckled_glaze(sampler, offset)
    deep_color = sampler.sample_color("1f4e79", "2c6e63", "a63c2a", "d79b2b", "2d2d33")
    accent = paint_shaded_clouds(deep_color, factor=1.35, scale=2.2, offset=offset)
    decoration = _ceramic(sampler, height, glaze, accent)
    decorated = choose_paint_or_random(sampler, height, decoration)
    inside = _mug_inside(sampler, decorated, glaze)
    raw_clay = paint_solid_color("a98663")
    outside = decorated
    if sampler.sample_bool(0.4, canonical=True):  # the foot is left without a glaze
        outside = paint_over(decorated, make_range_mask(-1.0, 0.35, soft=0.1), raw_clay)
    return {
        "outside": outside,
        "inside": inside,
        "base": raw_clay,
        "handle": sampler.sample_choice(glaze, decorated, accent),
    }


def _sample_speckled_glaze(sampler: ParameterSampler, offset: Array) -> Paint:
    """Sample a glaze with specks, with an offset (3,) into the noise."""
    clay = sampler.sample_color(
        "e9dfca", "f3f1ec", "d9c7a5", "3a3f45", "8fa7a0", "b5442e", "6f8fb0"
    )
    specks = sampler.sample_color("7d6247", p_random=0.2)
    return add_specks(
        paint_shaded_clouds(clay, factor=0.93, scale=3.0, offset=offset),
        specks,
        scale=0.28,
        offset=offset,
        amount=sampler(0.06, low=0.0, high=0.14),
    )


def _mug_inside(sampler: ParameterSampler, decorated: Paint, glaze: Paint) -> Paint:
    """Sample the inside of a mug: seldom decorated, else of one color or glazed."""
    if sampler.sample_bool(0.15):
        return decorated
    if sampler.sample_bool(0.5, canonical=True):
        return paint_solid_color(sampler.sample_color("efe6d4", "f3f1ec", p_random=0.3))
    return glaze


@make_family(unit_in_metres=0.01)
def bowl(sampler: ParameterSampler) -> Instance:
    """Make a bowl."""
    radius = 8.0
    height = radius * sampler(0.86, low=0.6, high=1.0)
    body = _bowl_body(sampler, radius, height)
    return Instance(
        shapes.transform_patches(body, SEAM_ROTATION),
        _bowl_paints(sampler, radius, height),
        sample_material(sampler, roughness=0.28, clearcoat=0.5),
        texel_density={"base": 0.6},
    )


def _bowl_paints(
    sampler: ParameterSampler, radius: float, height: float
) -> dict[str, Paint]:
    """Sample the paints of a bowl, by the tags of its parts.

    The canonical bowl is glazed, with a pale rim and a raw foot; the others have any
    decoration of a potter.

    Args:
        sampler: samples the paints.
        radius: radius of the rim.
        height: height of the rim.
    """
    offset = sampler.sample_noise_offset()
    clay = sampler.sample_color(
        "3f7f86", "e9dfca", "2f5d7c", "b5442e", "f3f1ec", "566b3f"
    )
    glaze = paint_shaded_clouds(clay, factor=0.72, scale=2.6, offset=offset)
    accent = paint_two_color_clouds(
        parse_hex_color("e8dcc0"), parse_hex_color("d6c39a"), scale=2.0, offset=offset
    )
    raw_clay = paint_solid_color("9b7352")
    is_canonical = sampler.rng is None
    if is_canonical:
        outside = _paint_canonical_bowl(height, glaze, accent, raw_clay)
    else:
        decoration = _ceramic(sampler, height, glaze, accent)
        outside = choose_paint_or_random(sampler, 2 * radius, decoration)
    pale = paint_solid_color(sampler.sample_color("f3f1ec"))
    clay_rings = rings(clay, scale_brightness(clay, 1.3), period=height * 0.2)
    inside = sampler.sample_choice(accent, glaze, outside, pale, clay_rings)
    return {"outside": outside, "inside": inside, "base": raw_clay}


def _paint_canonical_bowl(
    height: float, glaze: Paint, rim_paint: Paint, raw_clay: Paint
) -> Paint:
    """Return the paint of a glazed bowl with a pale rim and a raw foot.

    Args:
        height: height of the rim.
        glaze: paint of the most part.
        rim_paint: paint of the rim.
        raw_clay: paint of the foot.
    """
    is_rim = make_range_mask(0.93 * height, 2 * height, soft=0.25)
    with_rim = paint_over(glaze, is_rim, rim_paint)
    return paint_over(with_rim, make_range_mask(-1.0, 0.55, soft=0.1), raw_clay)


def _bowl_body(sampler: ParameterSampler, radius: float, height: float) -> list[Patch]:
    """Create the surface of a bowl on a foot ring.

    Args:
        sampler: samples its proportions.
        radius: radius of the rim before it flares.
        height: height of the rim.
    """
    foot_radius = radius * sampler(0.42, low=0.34, high=0.55)
    foot_height = sampler(0.7, low=0.15, high=1.1)
    # how far out the wall is at half height, in units of the radius
    fullness = sampler(0.86, low=0.72, high=0.97)
    flare = sampler(0.0, low=-0.03, high=0.1) * radius
    knots = [
        (foot_radius * 1.04, foot_height),
        (
            radius * 0.5 * (0.72 + fullness) * 0.92,
            foot_height + 0.22 * (height - foot_height),
        ),
        (radius * fullness, 0.55 * height),
        (radius * (0.5 + 0.5 * fullness), 0.8 * height),
        (radius + flare, height),
    ]
    return shapes.make_vessel(
        np.array([(foot_radius, 0.0), *shapes.sample_spline(knots, count=22)]),
        wall=sampler(0.45, low=0.32, high=0.65),
        floor=foot_height + 0.55,
        step=0.9,
    )


@make_family(unit_in_metres=0.01)
def bottle(sampler: ParameterSampler) -> Instance:
    """Make a bottle with a cap and perhaps a label."""
    height = sampler(30.0, low=24.0, high=32.0)
    shoulder, patches = _bottle_body(sampler, height)
    paints = _bottle_paints(sampler, height, shoulder)
    return Instance(
        shapes.transform_patches(patches, SEAM_ROTATION),
        paints,
        sample_material(sampler, roughness=0.2, clearcoat=0.6),
        texel_density={"inside": 0.25, "base": 0.5},
    )


def _bottle_body(sampler: ParameterSampler, height: float) -> tuple[float, list[Patch]]:
    """Create the surface of a bottle, perhaps with a cap.

    Args:
        sampler: samples its proportions.
        height: height of the neck's end.

    Returns:
        The height of its shoulder, where the body begins to narrow; and its patches.
    """
    radius = sampler(3.75, low=3.0, high=4.8)
    neck_radius = sampler(1.35, low=1.0, high=1.7)
    shoulder = height * sampler(0.62, low=0.45, high=0.68)
    body = _sample_bottle_side(sampler, height, radius, neck_radius, shoulder)
    ring_radius = neck_radius * 0.95 + sampler(0.28, low=0.1, high=0.4)
    has_cap = sampler.sample_bool(0.4)
    mouth = _mouth_ring(ring_radius, neck_radius, height)
    outside = np.concatenate([shapes.subdivide(body, longest=1.6), mouth])
    patches = shapes.make_vessel(
        outside, wall=sampler(0.35, low=0.3, high=0.45), floor=0.8, step=1.6, columns=48
    )
    if has_cap:
        patches += _cap(sampler, ring_radius + 0.12, height)
    return shoulder, patches


def _sample_bottle_side(
    sampler: ParameterSampler,
    height: float,
    radius: float,
    neck_radius: float,
    shoulder: float,
) -> Array:
    """Sample the profile (K, 2), (r, z), of a bottle from its foot to its mouth.

    Args:
        sampler: samples the shoulder and the taper.
        height: height of the neck's end.
        radius, neck_radius: radii of the body and of the neck.
        shoulder: height at which the body begins to narrow.
    """
    rise = height * sampler(0.15, low=0.08, high=0.22)  # from the shoulder to the neck
    slope = sampler(0.35, low=0.1, high=0.8)  # 0: square shoulder, 1: sloping
    taper = sampler(1.0, low=0.93, high=1.03)
    middle_of_shoulder = (
        neck_radius + (radius - neck_radius) * (0.55 - 0.35 * slope),
        shoulder + rise * (0.6 - 0.25 * slope),
    )
    corners = [
        (radius * 0.82, 0.0),
        (radius * taper, 0.02 * height),
        (radius, shoulder),
        middle_of_shoulder,
        (neck_radius * 1.03, shoulder + rise),
        (neck_radius * 0.95, height - 1.6),
    ]
    roundings = [0.8, 0.45 * rise + 0.4, 0.6 * rise, 0.5 * rise]
    return shapes.round_corners(corners, radius=roundings, steps=7)


def _mouth_ring(
    ring_radius: float, neck_radius: float, height: float
) -> list[tuple[float, float]]:
    """Return the points (r, z) of the thicker ring around the mouth of a bottle.

    Args:
        ring_radius: radius of the ring.
        neck_radius: radius of the neck.
        height: height of the bottle.
    """
    return [
        (ring_radius, height - 1.5),
        (ring_radius, height - 0.6),
        (neck_radius * 0.97, height - 0.5),
        (neck_radius * 0.93, height),
    ]


def _bottle_paints(
    sampler: ParameterSampler, height: float, shoulder: float
) -> dict[str, Paint]:
    """Sample the paints of a bottle: glass, a label, and often foil around its neck.

    Args:
        sampler: samples the paints.
        height: height of the bottle.
        shoulder: height at which the body begins to narrow; the label ends below.
    """
    offset = sampler.sample_noise_offset()
    glass = sampler.sample_color(
        "17351f", "4a2c14", "1d3f2a", "cfdde0", "2a4d69", "ece7dd", "111416"
    )
    clouds = paint_shaded_clouds(glass, factor=1.25, scale=9.0, offset=offset)
    outside = choose_paint_or_random(sampler, height, clouds, p_random=0.25)
    outside = _sample_bottle_label(sampler, outside, height, shoulder)
    outside = _sample_foil(sampler, outside, height, offset)
    cap_color = sampler.sample_color("c9a24b", "d0d0d0", "b5442e", "22262b")
    return {
        "outside": outside,
        "inside": paint_solid_color(scale_brightness(glass, 0.6)),
        "base": paint_solid_color(glass),
        "cap": paint_solid_color(cap_color),
    }


def _sample_bottle_label(
    sampler: ParameterSampler, glass: Paint, height: float, shoulder: float
) -> Paint:
    """Sample the label of a bottle, which four of five bottles have.

    Args:
        sampler: samples colors and size.
        glass: paint of the bottle.
        height: height of the bottle.
        shoulder: height at which the body begins to narrow; the label ends below.
    """
    paper = sampler.sample_color("efe6cf", "f5f2ea", "20242a", "c9a24b", p_random=0.3)
    ink = sampler.sample_color("7a1f2b", "23395d", "2e2a25", "b08d3c", p_random=0.3)
    bottom = 0.14 * height
    top = min(sampler(0.44, low=0.3, high=0.5) * height, shoulder - 1.5)
    has_label = not sampler.sample_bool(0.2)
    if not has_label:
        return glass
    return _add_label(sampler, glass, paper, ink, bottom, top)


def _sample_foil(
    sampler: ParameterSampler, surface: Paint, height: float, offset: Array
) -> Paint:
    """Paint foil around the neck of half of all bottles.

    Args:
        sampler: samples the color.
        surface: paint of the bottle.
        height: height of the bottle.
        offset: (3,) into the noise.
    """
    foil = sampler.sample_color("6d1a26", "b08d3c", "1c1f24", "23395d", "d5d5d5")
    if not sampler.sample_bool(0.5, canonical=True):
        return surface
    bright_foil = scale_brightness(foil, 1.3)
    foil_paint = add_specks(
        paint_solid_color(foil), bright_foil, scale=0.5, offset=offset
    )
    return paint_over(surface, make_range_mask(height * 0.8, 2 * height), foil_paint)


def _cap(sampler: ParameterSampler, radius: float, bottle_height: float) -> list[Patch]:
    """Create the cap of a bottle: a cylinder around the end of its neck.

    Args:
        sampler: samples how far down it reaches.
        radius: radius of the cap.
        bottle_height: height of the bottle without it.
    """
    bottom = bottle_height - sampler(1.5, low=0.9, high=2.2)
    top = bottle_height + 0.35
    under = np.array([[0.6 * radius, bottom], [radius, bottom]])
    side = shapes.round_corners(
        [(radius, bottom), (radius, top), (0.6 * radius, top)], radius=0.3, steps=4
    )
    return shapes.revolve_profile(
        [
            ("cap", under),
            ("cap", shapes.subdivide(side, longest=0.8)),
            ("cap", [[0.6 * radius, top], [0.0, top]]),
        ],
        columns=40,
    )


class _Label(NamedTuple):
    """A label around a bottle.

    Attributes:
        half_angle: degrees from its middle to its sides.
        bottom, top: heights of its edges.
    """

    half_angle: float
    bottom: float
    top: float

    @property
    def height(self) -> float:
        """Height of the label."""
        return self.top - self.bottom

    @property
    def half_text_angle(self) -> float:
        """Degrees from its middle to the sides of text as wide as possible.

        Text stays on the half of the bottle that is seen from the front.
        """
        return min(self.half_angle, 95.0)


def _add_label(
    sampler: ParameterSampler,
    surface: Paint,
    paper: Array,
    ink: Array,
    bottom: float,
    top: float,
) -> Paint:
    """Paint a paper label around a part of a bottle, opposite the texture's seam.

    It has a bar near its upper and its lower edge, a title, three lines of text and a
    round seal.

    Args:
        sampler: samples its width.
        surface: paint of the bottle.
        paper, ink: colors.
        bottom, top: heights of its edges.
    """
    label = _Label(sampler(95.0, low=60.0, high=180.0), bottom, top)
    background = make_facing_mask(
        LABEL_AZIMUTH, half_width=label.half_angle, low=bottom, high=top, soft=0.08
    )
    paint = paint_over(surface, background, paint_solid_color(paper))
    paint = _add_bars(paint, label, ink)
    paint = _add_text(paint, label, ink)
    return paint_over(paint, _seal(bottom, label.height), paint_solid_color("b08d3c"))


def _add_bars(base: Paint, label: _Label, ink: Array) -> Paint:
    """Paint a bar of a color near the upper and near the lower edge of a label."""
    half_angle = label.half_angle - 6.0
    height = label.height
    upper_edge = label.top - 0.07 * height
    lower_edge = label.bottom + 0.06 * height
    paint = _add_rectangle(base, half_angle, label.top - 0.12 * height, upper_edge, ink)
    return _add_rectangle(
        paint, half_angle, lower_edge, label.bottom + 0.1 * height, ink
    )


def _add_text(base: Paint, label: _Label, ink: Array) -> Paint:
    """Paint a title and three lines of text, each of another length, as bars."""
    bottom = label.bottom
    height = label.height
    paint = _add_rectangle(
        base,
        0.42 * label.half_text_angle,
        bottom + 0.6 * height,
        bottom + 0.76 * height,
        scale_brightness(ink, 0.8),
    )
    for i, relative_length in enumerate((0.5, 0.36, 0.44)):
        half_angle = relative_length * label.half_text_angle
        z = bottom + (0.5 - 0.1 * i) * height
        paint = _add_rectangle(paint, half_angle, z, z + 0.035 * height, ink)
    return paint


def _add_rectangle(
    base: Paint, half_width: float, low: float, high: float, color: Array
) -> Paint:
    """Paint a rectangle of a label over a paint.

    Args:
        base: the paint.
        half_width: degrees from the middle of the label to its sides.
        low, high: heights.
        color: color (3,) of the rectangle.
    """
    mask = make_facing_mask(
        LABEL_AZIMUTH, half_width=half_width, low=low, high=high, soft=0.05
    )
    return paint_over(base, mask, paint_solid_color(color))


@painter
def _seal(t: Texels, bottom: float, height: float) -> Array:
    """Return the mask of a disc at the lower end of a label.

    Args:
        t: points of the bottle.
        bottom, height: lower edge and height of the label.
    """
    x, y, z = t.xyz.T
    # azimuth from the middle of the label, wrapped to [-180, 180) degrees
    degrees = (np.degrees(np.arctan2(y, x)) - LABEL_AZIMUTH + 180.0) % 360.0 - 180.0
    radius = float(np.hypot(x, y).max())  # radius of the bottle
    center_distance = np.hypot(
        np.radians(degrees) * radius, z - (bottom + 0.2 * height)
    )
    return compute_soft_step(0.09 * height - center_distance, 0.0, soft=0.08)


class _VaseBody(NamedTuple):
    """A vase without handles.

    Attributes:
        belly_height: height of the belly, its widest part.
        neck_height: height of the neck, the narrowest part above the belly.
        profile: outer profile (34, 2) of points (r, z).
        patches: its surface.
    """

    belly_height: float
    neck_height: float
    profile: Array
    patches: list[Patch]


@make_family(unit_in_metres=0.01)
def vase(sampler: ParameterSampler) -> Instance:
    """Make a vase, perhaps with handles."""
    height = 24.0
    body = _vase_body(sampler, height)
    patches = [*body.patches, *_vase_handles(sampler, body)]
    return Instance(
        shapes.transform_patches(patches, SEAM_ROTATION),
        _vase_paints(sampler, height),
        sample_material(sampler, roughness=0.25, clearcoat=0.6),
        texel_density={"inside": 0.35, "base": 0.5},
    )


def _vase_paints(sampler: ParameterSampler, height: float) -> dict[str, Paint]:
    """Sample the paints of a vase of a height, by the tags of its parts."""
    offset = sampler.sample_noise_offset()
    clay = sampler.sample_color(
        "f2f1ea", "b7562f", "2f6f6a", "26303c", "d9c7a5", "8a2f2a"
    )
    glaze = paint_shaded_clouds(clay, factor=0.95, scale=4.0, offset=offset)
    decoration = _vase_paint(sampler, glaze, height, offset)
    return {
        "outside": choose_paint_or_random(sampler, height, decoration),
        "inside": paint_solid_color(scale_brightness(clay, 0.8)),
        "base": paint_solid_color("b79b7c"),
        "handle": glaze,
    }


def _vase_body(sampler: ParameterSampler, height: float) -> _VaseBody:
    """Create a vase without handles.

    Args:
        sampler: samples its proportions.
        height: height of the lip.
    """
    foot = sampler(3.6, low=2.6, high=4.4)
    belly = sampler(7.2, low=5.2, high=8.6)
    belly_height = height * sampler(0.52, low=0.3, high=0.68)
    neck = sampler(2.6, low=2.2, high=3.8)
    neck_height = height * sampler(0.84, low=0.78, high=0.88)
    lip = neck + sampler(1.5, low=0.5, high=2.6)
    # points (r, z), with one halfway between the foot, the belly and the neck each
    knots = [
        (foot, 0.0),
        (foot * 0.97, 0.5),
        (0.45 * foot + 0.55 * belly, 0.48 * belly_height),
        (belly, belly_height),
        (0.45 * belly + 0.55 * neck, 0.45 * belly_height + 0.55 * neck_height),
        (neck, neck_height),
        (lip, height),
    ]
    profile = shapes.sample_spline(knots, count=34)
    patches = shapes.make_vessel(
        profile, wall=sampler(0.4, low=0.35, high=0.6), floor=0.8, step=1.2
    )
    return _VaseBody(belly_height, neck_height, profile, patches)


def _vase_handles(sampler: ParameterSampler, body: _VaseBody) -> list[Patch]:
    """Create two handles on opposite sides of a vase; most vases have none.

    Args:
        sampler: chooses, and samples their shape.
        body: the vase.
    """
    if not sampler.sample_bool(0.25):
        return []
    ear = make_handle(
        sampler,
        "ear",
        bottom=body.belly_height + 0.15 * (body.neck_height - body.belly_height),
        top=body.neck_height - 0.2,
        reach=sampler(1.6, low=1.2, high=2.4),
        profile=body.profile,
        inset=0.2,
    )
    return [
        *shapes.transform_patches(ear, shapes.make_rotation_matrix("z", 130.0)),
        *shapes.transform_patches(ear, shapes.make_rotation_matrix("z", -50.0)),
    ]


INK_RINGS = (
    (0.05, 0.08),
    (0.18, 0.2),
    (0.215, 0.225),
    (0.76, 0.77),
    (0.785, 0.805),
    (0.96, 2.0),
)
"""Lower and upper edges of rings of ink around a vase, as fractions of its height."""


def _vase_paint(
    sampler: ParameterSampler, glaze: Paint, height: float, offset: Array
) -> Paint:
    """Paint a vase with brushwork, or with another decoration of a potter.

    The canonical vase has blue brushwork.

    Args:
        sampler: chooses, and samples the ink.
        glaze: the ground.
        height: height of the vase.
        offset: (3,) into the noise.
    """
    ink = sampler.sample_color("23408f", "1f2a33", "b5442e", "d79b2b", "e9dfca")
    is_canonical = sampler.rng is None
    if not is_canonical and sampler.sample_bool(0.6):
        accent = paint_shaded_clouds(ink, factor=1.3, scale=3.0, offset=offset)
        return _ceramic(sampler, height, glaze, accent)
    paint = paint_over(glaze, _scroll(height), paint_solid_color(ink))
    for low, high in INK_RINGS:
        ring = make_range_mask(low * height, high * height, soft=0.12)
        paint = paint_over(paint, ring, paint_solid_color(ink))
    return paint_over(paint, _frieze(height), paint_solid_color(ink))


@painter
def _scroll(t: Texels, height: float) -> Array:
    """Return the mask of curling petals around the belly of a vase of a height."""
    angle = np.arctan2(t.xyz[:, 1], t.xyz[:, 0])
    z = t.xyz[:, 2] / height
    # Six ridges around the vase sway to both sides with the height. Nearly level waves
    # across them divide them into petals.
    ridges = np.abs(np.sin(3.0 * angle + 9.0 * np.sin(5.0 * z)))
    waves = 0.5 + 0.5 * np.sin(30.0 * z + 2.0 * np.sin(6.0 * angle))
    petals = compute_soft_step(ridges * waves, 0.55, soft=0.16)
    mask_belly = make_range_mask(0.24 * height, 0.74 * height, soft=0.1)
    return petals * mask_belly(t)


@painter
def _frieze(t: Texels, height: float) -> Array:
    """Return the mask of a band of 16 teeth above the foot of a vase of a height."""
    angle = np.arctan2(t.xyz[:, 1], t.xyz[:, 0])
    teeth = compute_soft_step(np.sin(16 * angle), 0.0, soft=0.5)
    return make_range_mask(0.09 * height, 0.17 * height, soft=0.1)(t) * teeth


class _GlassBowl(NamedTuple):
    """The bowl of a wine glass, with the upper part of its stem.

    Attributes:
        bottom: height at which the bowl begins, on top of the stem.
        depth: depth of the bowl.
        wall: thickness of its wall.
        outer: outer profile (36, 2), points (r, z) from the stem up to the mouth.
    """

    bottom: float
    depth: float
    wall: float
    outer: Array


@make_family(unit_in_metres=0.01)
def wine_glass(sampler: ParameterSampler) -> Instance:
    """Make a wine glass, perhaps with wine."""
    foot_radius = sampler(3.5, low=2.9, high=4.2)
    stem_radius = sampler(0.42, low=0.32, high=0.6)
    stem_height = sampler(9.5, low=6.0, high=12.0)
    bowl_of_glass = _glass_bowl(sampler, stem_radius, stem_height)
    profile = _glass_profile(bowl_of_glass, foot_radius, stem_radius)
    body = shapes.revolve_profile(profile, columns=52)
    return Instance(
        shapes.transform_patches(body, SEAM_ROTATION),
        _glass_paints(sampler, stem_height, bowl_of_glass.depth),
        sample_material(sampler, roughness=0.18, clearcoat=0.8, spread=0.12),
    )


def _glass_bowl(
    sampler: ParameterSampler, stem_radius: float, stem_height: float
) -> _GlassBowl:
    """Sample the bowl of a wine glass, with the upper part of its stem.

    Args:
        sampler: samples its proportions.
        stem_radius: radius of the stem.
        stem_height: height at which the bowl begins.
    """
    radius = sampler(4.1, low=3.2, high=5.0)
    depth = sampler(9.8, low=6.5, high=11.5)
    mouth = radius * sampler(0.8, low=0.7, high=1.12)
    widest = sampler(0.42, low=0.3, high=0.55)  # its height, as a fraction of the depth
    wall = sampler(0.24, low=0.2, high=0.3)
    # some stems have a knob, 2.2 times as thick
    knob_factor = 2.2 if sampler.sample_bool(0.25) else 1.0
    stem = [
        (stem_radius, 0.6 * stem_height),
        (stem_radius * knob_factor, 0.78 * stem_height),
        (stem_radius * 1.1, 0.92 * stem_height),
    ]
    cup = [
        (0.5 * radius, stem_height + 0.07 * depth),
        (0.86 * radius, stem_height + 0.2 * depth),
        (radius, stem_height + widest * depth),
        (0.45 * radius + 0.55 * mouth, stem_height + 0.76 * depth),
        (mouth, stem_height + depth),
    ]
    outer = shapes.sample_spline([*stem, *cup], count=36)
    return _GlassBowl(stem_height, depth, wall, outer)


def _glass_lip(glass: _GlassBowl) -> tuple[Array, Array]:
    """Return the profile of the inside of a wine glass, and that of its rounded lip.

    Returns:
        The inside (n, 2) from the mouth downwards, without its floor; and three points
        (3, 2) of the half circle that joins the outside to it.
    """
    tangent = np.gradient(glass.outer, axis=0)  # (dr, dz)
    # turned to the right, which is outwards
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    normal = normal / np.linalg.norm(tangent, axis=1, keepdims=True)
    inner = (glass.outer - glass.wall * normal)[::-1]
    is_wall = inner[:, 1] > glass.bottom + 0.11 * glass.depth  # the floor is below
    inner = inner[is_wall]
    # A half circle around the middle of the wall's end, from its outside to its inside.
    angle = np.pi * np.arange(1, 4) / 4
    outwards = normal[-1]
    upwards = np.array([-outwards[1], outwards[0]])  # on along the profile
    unit_circle = np.cos(angle)[:, None] * outwards + np.sin(angle)[:, None] * upwards
    half_wall = glass.wall / 2
    lip = glass.outer[-1] - half_wall * outwards + half_wall * unit_circle
    return inner, lip


def _glass_profile(
    glass: _GlassBowl, foot_radius: float, stem_radius: float
) -> list[tuple[str, Array]]:
    """Return the tags and profiles of the parts of a wine glass, in order.

    They go from the axis along the foot's lower side, up the outside, over the lip, and
    down the inside to the axis.

    Args:
        glass: the bowl.
        foot_radius, stem_radius: radii of the foot and of the stem.
    """
    inner, lip = _glass_lip(glass)
    floor = glass.bottom + 0.08 * glass.depth
    floor_edge = (inner[-1, 0] * 0.6, floor + 0.25 * (inner[-1, 1] - floor))
    return [
        *_glass_foot(glass, foot_radius, stem_radius),
        ("bowl", np.concatenate([glass.outer, lip, inner[:1]])),
        ("inside", inner),
        ("inside", np.array([inner[-1], floor_edge, (0.0, floor)])),
    ]


def _glass_foot(
    glass: _GlassBowl, foot_radius: float, stem_radius: float
) -> list[tuple[str, Array]]:
    """Return the tags and profiles of the foot and the stem of a wine glass, outwards.

    Args:
        glass: the bowl on top of the stem.
        foot_radius, stem_radius: radii of the foot and of the stem.
    """
    under = [
        (0.0, 0.12),
        (foot_radius * 0.8, 0.12),
        (foot_radius * 0.9, 0.0),
        (foot_radius - 0.15, 0.0),
    ]
    rising = [
        (foot_radius, 0.28),
        (0.55 * foot_radius, 0.6),
        (0.22 * foot_radius, 1.25),
        (stem_radius * 1.15, 2.4),
        (stem_radius, 0.6 * glass.bottom),
    ]
    stem = shapes.sample_spline(rising, count=14)
    upper_side = [under[-1], (foot_radius, 0.08), *stem]
    return [
        ("foot", shapes.subdivide(under, longest=1.5)),
        ("foot", np.array(upper_side)),
    ]


TINTS = ("c4dbe2", "d9e4e6", "e8d9c8", "8fb8a8", "c58a94", "7c9cc4", "f0f0ee")
"""Colors of glass."""


def _glass_paints(
    sampler: ParameterSampler, stem_height: float, depth: float
) -> dict[str, Paint]:
    """Sample the paints of a wine glass, which often has wine in it.

    Args:
        sampler: samples the paints.
        stem_height: height at which the bowl begins.
        depth: depth of the bowl.
    """
    height = stem_height + depth
    tint = sampler.sample_color(*TINTS, p_random=0.3)
    drink = sampler.sample_color("6d1526", "d8b45a", "c46a6a", "3f1420", p_random=0.15)
    level = stem_height + depth * sampler(0.48, low=0.3, high=0.62)
    glass = gradient(
        scale_brightness(tint, 0.86), scale_brightness(tint, 1.08), low=0.0, high=height
    )
    outside = glass
    inside = glass
    if sampler.sample_bool(0.5, canonical=True):  # filled
        bottom = stem_height + 0.06 * depth
        outside, inside = _fill_with_wine(sampler, glass, drink, bottom, level)
    outside = choose_paint_or_random(sampler, height, outside, p_random=0.3)
    outside = _sample_golden_rim(sampler, outside, height)
    foot = _sample_foot_paint(sampler, glass, outside, height)
    return {"foot": foot, "bowl": outside, "inside": inside}


def _sample_golden_rim(sampler: ParameterSampler, paint: Paint, height: float) -> Paint:
    """Return the paint of a glass; the canonical and one in five have a golden rim.

    Args:
        sampler: decides at random.
        paint: paint of the outside.
        height: height of the glass.
    """
    if not sampler.sample_bool(0.2, canonical=True):
        return paint
    # twice the height: the mask reaches the top and farther
    is_rim = make_range_mask(height - 0.35, 2 * height, soft=0.1)
    return paint_over(paint, is_rim, paint_solid_color("c9a24b"))


def _fill_with_wine(
    sampler: ParameterSampler, glass: Paint, drink: Array, bottom: float, level: float
) -> tuple[Paint, Paint]:
    """Return the paints of the outside and the inside of a glass with wine.

    The glass is not transparent: wine is painted on its outside and its inside, up to a
    level.

    Args:
        sampler: samples the offset into the noise.
        glass: paint of the glass.
        drink: color (3,) of the wine.
        bottom, level: heights at which the wine begins and ends.
    """
    offset = sampler.sample_noise_offset()
    wine = paint_shaded_clouds(drink, factor=0.8, scale=3.0, offset=offset)
    outside = paint_over(glass, make_range_mask(bottom, level, soft=0.1), wine)
    is_filled = make_range_mask(0.0, level, soft=0.1)
    return outside, paint_over(glass, is_filled, paint_solid_color(drink))


def _sample_foot_paint(
    sampler: ParameterSampler, glass: Paint, outside: Paint, height: float
) -> Paint:
    """Sample the paint of the foot of a wine glass: mostly glass, or as the bowl.

    Args:
        sampler: chooses the paint.
        glass: paint of the glass.
        outside: paint of the bowl.
        height: height of the glass.
    """
    if sampler.sample_bool(0.7, canonical=True):
        # `glass` is named twice, to be sampled twice as often
        return sampler.sample_choice(glass, outside, glass)
    return sample_paint(sampler, height)
