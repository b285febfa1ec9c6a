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
    half_thickness = sampler(0.42, low=0.32, high=0.6)
    half_width = sampler(0.62, low=0.4, high=0.95)
    if sampler.sample_bool(0.7, canonical=True):
        section = shapes.ellipse(half_thickness, half_width, count=16)
    else:
        section = shapes.rectangle(
            2 * half_thickness, 2 * half_width, bevel=0.6 * half_thickness
        )
    # up to a quarter thicker at both ends
    root_flare = 1.0 + 0.25 * np.abs(np.linspace(-1.0, 1.0, len(curve))) ** 4
    return shapes.sweep_section(
        "handle", shapes.to_xz_plane(curve), section, root_flare
    )


def _handle_curve(
    style: str,
    bottom_root: tuple[float, float],
    top_root: tuple[float, float],
    reach: float,
) -> Array:
    """Return the curve (K, 2) of a handle from its upper to its lower root.

    A square handle has two rounded bends; the others go through knots at three heights.

    Args:
        style: "round", "ear" (widest at the top), "square" or "loop" (small).
        bottom_root, top_root: (r, z) where the handle meets the wall.
        reach: its extent from the wall.
    """
    bottom = bottom_root[1]
    top = top_root[1]
    wall_radius = max(bottom_root[0], top_root[0])
    if style == "square":
        outer = wall_radius + reach
        corners = [top_root, (outer, top), (outer, bottom), bottom_root]
        rounded = shapes.round_corners(corners, radius=0.45 * reach, steps=6)
        # The spline distributes its points evenly; the dense polyline keeps its
        # corners.
        return shapes.sample_spline(
            shapes.subdivide(rounded, longest=0.8), count=HANDLE_POINTS
        )
    # how far it extends near the top, the middle and the bottom, in units of `reach`
    upper_reach, middle_reach, lower_reach = {
        "round": (0.82, 0.98, 0.82),
        "ear": (0.98, 0.9, 0.5),
        "loop": (0.85, 1.0, 0.85),
    }[style]
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
        return dots(
            glaze,
            second_color,
            cell=sampler(2.0, low=1.2, high=3.2),
            radius=sampler(0.3, low=0.2, high=0.4),
        )
    if kind == "stripes":
        return stripes(
            sampler.sample_color(PALE, "f4f4f2"),
            second_color,
            cell=sampler(1.8, low=1.0, high=4.0),
            fraction=sampler(0.5, low=0.25, high=0.6),
            slant=int(sampler.sample_choice(0, 2)),
        )
    if kind == "rings":
        return rings(
            sampler.sample_color(PALE),
            second_color,
            period=height * sampler(0.12, low=0.06, high=0.25),
            fraction=sampler(0.5, low=0.2, high=0.7),
        )
    return glaze


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
    if kind == "bands":
        bands = rings(parse_hex_color(PALE), second_color, period=0.13 * height)
        return paint_over(glaze, make_range_mask(0.62 * height, 0.9 * height), bands)
    if kind == "checks":
        board = checks(
            sampler.sample_color(PALE),
            second_color,
            cell=sampler(1.4, low=0.9, high=2.2),
        )
        return paint_over(glaze, make_range_mask(0.25 * height, 0.75 * height), board)
    chevrons = zigzag(sampler.sample_color(PALE), second_color, cell=2.5)
    return paint_over(glaze, make_range_mask(0.3 * height, 0.7 * height), chevrons)


@make_family(unit_in_metres=0.01)
def mug(sampler: ParameterSampler) -> Instance:
    """Make a mug with a handle.

    Lengths are in centimeters. `sampler(x, low=..., high=...)` returns x for the
    canonical mug and a uniform sample for a random one.
    """
    height = sampler(9.4, low=7.6, high=12.0)
    wall, side, body = _mug_body(sampler, height)

    style = sampler.sample_choice("ear", "round", "square", "loop")
    handle_top = height * sampler(0.85, low=0.76, high=0.88)
    if style == "loop":
        # never the canonical mug, whose handle is an "ear": so 0.3 is not used
        handle_bottom = height * sampler(0.3, low=0.34, high=0.42)
    else:
        handle_bottom = height * sampler(0.2, low=0.16, high=0.3)
    handle = make_handle(
        sampler,
        style,
        bottom=handle_bottom,
        top=handle_top,
        reach=sampler(2.9, low=2.3, high=3.4),
        profile=side,
        inset=0.55 * wall,
    )

    paints = _mug_paints(sampler, height)
    patches = shapes.transform_patches(
        # -108 degrees: in the usual view the handle is at the side, where it is
        # visible.
        [
            *body,
            *shapes.transform_patches(handle, shapes.make_rotation_matrix("z", -108.0)),
        ],
        SEAM_ROTATION,
    )
    return Instance(
        patches,
        paints,
        sample_material(sampler, roughness=0.3, clearcoat=0.5),
        # These parts are hardly visible, so they get fewer texels.
        texel_density={"inside": 0.8, "base": 0.6},
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
    clay = sampler.sample_color(
        "e9dfca", "f3f1ec", "d9c7a5", "3a3f45", "8fa7a0", "b5442e", "6f8fb0"
    )
    specks = sampler.sample_color("7d6247", p_random=0.2)
    glaze = add_specks(
        paint_shaded_clouds(clay, factor=0.93, scale=3.0, offset=offset),
        specks,
        scale=0.28,
        offset=offset,
        amount=sampler(0.06, low=0.0, high=0.14),
    )
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
        with_rim = paint_over(
            glaze, make_range_mask(0.93 * height, 2 * height, soft=0.25), accent
        )
        outside = paint_over(with_rim, make_range_mask(-1.0, 0.55, soft=0.1), raw_clay)
    else:
        decoration = _ceramic(sampler, height, glaze, accent)
        outside = choose_paint_or_random(sampler, 2 * radius, decoration)
    inside = sampler.sample_choice(
        accent,
        glaze,
        outside,
        paint_solid_color(sampler.sample_color("f3f1ec")),
        rings(clay, scale_brightness(clay, 1.3), period=height * 0.2),
    )
    return {"outside": outside, "inside": inside, "base": raw_clay}


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
    body = shapes.round_corners(
        corners, radius=[0.8, 0.45 * rise + 0.4, 0.6 * rise, 0.5 * rise], steps=7
    )
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
    outside = choose_paint_or_random(
        sampler,
        height,
        paint_shaded_clouds(glass, factor=1.25, scale=9.0, offset=offset),
        p_random=0.25,
    )
    paper = sampler.sample_color("efe6cf", "f5f2ea", "20242a", "c9a24b", p_random=0.3)
    ink = sampler.sample_color("7a1f2b", "23395d", "2e2a25", "b08d3c", p_random=0.3)
    label_bottom = 0.14 * height
    label_top = min(sampler(0.44, low=0.3, high=0.5) * height, shoulder - 1.5)
    has_label = not sampler.sample_bool(0.2)
    if has_label:
        outside = _add_label(sampler, outside, paper, ink, label_bottom, label_top)
    foil = sampler.sample_color("6d1a26", "b08d3c", "1c1f24", "23395d", "d5d5d5")
    if sampler.sample_bool(0.5, canonical=True):
        foil_paint = add_specks(
            paint_solid_color(foil),
            scale_brightness(foil, 1.3),
            scale=0.5,
            offset=offset,
        )
        outside = paint_over(
            outside, make_range_mask(height * 0.8, 2 * height), foil_paint
        )
    return {
        "outside": outside,
        "inside": paint_solid_color(scale_brightness(glass, 0.6)),
        "base": paint_solid_color(glass),
        "cap": paint_solid_color(
            sampler.sample_color("c9a24b", "d0d0d0", "b5442e", "22262b")
        ),
    }


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
    # degrees from the middle of the label to its sides
    half_angle = sampler(95.0, low=60.0, high=180.0)
    # text stays on the half of the bottle that is seen from the front
    half_text_angle = min(half_angle, 95.0)
    height = top - bottom

    def add(
        base: Paint, half_width: float, low: float, high: float, color: Array
    ) -> Paint:
        """Paint a rectangle of the label, `half_width` in degrees, over a paint."""
        mask = make_facing_mask(
            LABEL_AZIMUTH, half_width=half_width, low=low, high=high, soft=0.05
        )
        return paint_over(base, mask, paint_solid_color(color))

    background = make_facing_mask(
        LABEL_AZIMUTH, half_width=half_angle, low=bottom, high=top, soft=0.08
    )
    label = paint_over(surface, background, paint_solid_color(paper))
    half_bar_angle = half_angle - 6.0
    label = add(label, half_bar_angle, top - 0.12 * height, top - 0.07 * height, ink)
    label = add(
        label, half_bar_angle, bottom + 0.06 * height, bottom + 0.1 * height, ink
    )
    label = add(
        label,
        0.42 * half_text_angle,
        bottom + 0.6 * height,
        bottom + 0.76 * height,
        scale_brightness(ink, 0.8),
    )
    # lines of text, each of another length
    for i, relative_length in enumerate((0.5, 0.36, 0.44)):
        z = bottom + (0.5 - 0.1 * i) * height
        label = add(
            label, relative_length * half_text_angle, z, z + 0.035 * height, ink
        )
    return paint_over(label, _seal(bottom, height), paint_solid_color("b08d3c"))


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
    offset = sampler.sample_noise_offset()
    clay = sampler.sample_color(
        "f2f1ea", "b7562f", "2f6f6a", "26303c", "d9c7a5", "8a2f2a"
    )
    glaze = paint_shaded_clouds(clay, factor=0.95, scale=4.0, offset=offset)
    decoration = _vase_paint(sampler, glaze, height, offset)
    paints = {
        "outside": choose_paint_or_random(sampler, height, decoration),
        "inside": paint_solid_color(scale_brightness(clay, 0.8)),
        "base": paint_solid_color("b79b7c"),
        "handle": glaze,
    }
    return Instance(
        shapes.transform_patches(patches, SEAM_ROTATION),
        paints,
        sample_material(sampler, roughness=0.25, clearcoat=0.6),
        texel_density={"inside": 0.35, "base": 0.5},
    )


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
    # rings of ink, as fractions of the height
    for low, high in (
        (0.05, 0.08),
        (0.18, 0.2),
        (0.215, 0.225),
        (0.76, 0.77),
        (0.785, 0.805),
        (0.96, 2.0),
    ):
        paint = paint_over(
            paint,
            make_range_mask(low * height, high * height, soft=0.12),
            paint_solid_color(ink),
        )
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
    upper_side = [
        under[-1],
        (foot_radius, 0.08),
        *shapes.sample_spline(rising, count=14),
    ]
    return [
        ("foot", shapes.subdivide(under, longest=1.5)),
        ("foot", np.array(upper_side)),
        ("bowl", np.concatenate([glass.outer, lip, inner[:1]])),
        ("inside", inner),
        ("inside", np.array([inner[-1], floor_edge, (0.0, floor)])),
    ]


def _glass_paints(
    sampler: ParameterSampler, stem_height: float, depth: float
) -> dict[str, Paint]:
    """Sample the paints of a wine glass, which often has wine in it.

    The glass is not transparent: wine is painted on its outside and its inside, up to a
    level.

    Args:
        sampler: samples the paints.
        stem_height: height at which the bowl begins.
        depth: depth of the bowl.
    """
    height = stem_height + depth
    tint = sampler.sample_color(
        "c4dbe2",
        "d9e4e6",
        "e8d9c8",
        "8fb8a8",
        "c58a94",
        "7c9cc4",
        "f0f0ee",
        p_random=0.3,
    )
    drink = sampler.sample_color("6d1526", "d8b45a", "c46a6a", "3f1420", p_random=0.15)
    level = stem_height + depth * sampler(0.48, low=0.3, high=0.62)
    glass = gradient(
        scale_brightness(tint, 0.86), scale_brightness(tint, 1.08), low=0.0, high=height
    )
    outside = glass
    inside = glass
    if sampler.sample_bool(0.5, canonical=True):  # filled
        wine = paint_shaded_clouds(
            drink, factor=0.8, scale=3.0, offset=sampler.sample_noise_offset()
        )
        is_wine = make_range_mask(stem_height + 0.06 * depth, level, soft=0.1)
        outside = paint_over(glass, is_wine, wine)
        inside = paint_over(
            glass, make_range_mask(0.0, level, soft=0.1), paint_solid_color(drink)
        )
    outside = choose_paint_or_random(sampler, height, outside, p_random=0.3)
    if sampler.sample_bool(0.2, canonical=True):  # a golden rim
        is_rim = make_range_mask(height - 0.35, 2 * height, soft=0.1)
        outside = paint_over(outside, is_rim, paint_solid_color("c9a24b"))
    if sampler.sample_bool(0.7, canonical=True):
        # `glass` is named twice, to be sampled twice as often
        foot_paint = sampler.sample_choice(glass, outside, glass)
    else:
        foot_paint = sample_paint(sampler, height)
    return {"foot": foot_paint, "bowl": outside, "inside": inside}
