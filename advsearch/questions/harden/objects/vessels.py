"""Open containers of revolution: mug, bowl, bottle, vase, wine glass.

Lengths are in centimeters, and z is up. A number `draw(9.4, low=7.6, high=12.0)` is 9.4
of the canonical instance, and uniform between the bounds of others. Profiles are points
(r, z).
"""

from __future__ import annotations

import numpy as np

import advsearch.questions.harden.objects.shapes as shapes
from advsearch.questions.harden.objects.family import Instance, family, sample_material
from advsearch.questions.harden.objects.shapes import Array, Patch
from advsearch.questions.harden.objects.textures import (
    Paint,
    ParameterSampler,
    Texels,
    between,
    checks,
    clouded,
    dots,
    facing,
    gradient,
    mottled,
    over,
    paint_or_random,
    parse_hex_color,
    rings,
    sample_paint,
    shade,
    solid,
    speckled,
    step,
    stripes,
    zigzag,
)

# turns the seam of a lathe away from the default camera, at azimuth 40
SEAM_ROTATION = shapes.rotation("z", 220.0)
HANDLE_POINTS = 26  # points of the curve of a handle


def make_handle(
    sampler: ParameterSampler,
    style: str,
    low: float,
    high: float,
    reach: float,
    profile: Array,
    inset: float,
) -> list[Patch]:
    """Create a handle in the x-z plane, on the +x side of a wall.

    It is thicker at both roots. Its section is an ellipse or a rounded rectangle.

    Args:
        sampler: samples its thickness.
        style: "round", "ear" (widest at the top), "square" or "loop" (small).
        low, high: heights of its roots.
        reach: its extent from the wall.
        profile: profile of the wall (K, 2).
        inset: depth of the roots inside the wall.
    """
    low_root = shapes.radius_at_height(profile, low) - inset
    high_root = shapes.radius_at_height(profile, high) - inset
    curve = _handle_curve(style, (low_root, low), (high_root, high), reach)
    half_thickness = sampler(0.42, low=0.32, high=0.6)
    half_width = sampler(0.62, low=0.4, high=0.95)
    if sampler.chance(0.7, canonical=True):
        section = shapes.ellipse(half_thickness, half_width, count=16)
    else:
        section = shapes.rectangle(
            2 * half_thickness, 2 * half_width, bevel=0.6 * half_thickness
        )
    # up to a quarter thicker at both ends
    root_flare = 1.0 + 0.25 * np.abs(np.linspace(-1.0, 1.0, len(curve))) ** 4
    return shapes.sweep("handle", shapes.to_xz_plane(curve), section, root_flare)


def _handle_curve(
    style: str,
    low_root: tuple[float, float],
    high_root: tuple[float, float],
    reach: float,
) -> Array:
    """Return the curve (K, 2) of a handle from its upper to its lower root.

    A square handle has two rounded bends; the others go through knots at three heights.

    Args:
        style: as for `make_handle`.
        low_root, high_root: (r, z).
        reach: its extent from the wall.
    """
    low = low_root[1]
    high = high_root[1]
    edge = max(low_root[0], high_root[0])
    if style == "square":
        corners = [high_root, (edge + reach, high), (edge + reach, low), low_root]
        rounded = shapes.round_corners(corners, radius=0.45 * reach, steps=6)
        return shapes.spline(
            shapes.subdivide(rounded, longest=0.8), count=HANDLE_POINTS
        )
    # how far it extends at the top, the middle and the bottom, in units of `reach`
    top, middle, bottom = {
        "round": (0.82, 0.98, 0.82),
        "ear": (0.98, 0.9, 0.5),
        "loop": (0.85, 1.0, 0.85),
    }[style]
    height = high - low
    knots = [
        high_root,
        (edge + 0.45 * reach, high + 0.04 * height),
        (edge + top * reach, high - 0.16 * height),
        (edge + middle * reach, (low + high) / 2),
        (edge + bottom * reach, low + 0.18 * height),
        (edge + 0.3 * reach, low + 0.03 * height),
        low_root,
    ]
    return shapes.spline(knots, count=HANDLE_POINTS)


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
    kind = sampler.pick(
        "band", "plain", "bands", "dots", "stripes", "dip", "checks", "zigzag", "rings"
    )
    second = sampler.sample_color(
        "2f5d7c", "b5442e", "356b4f", "e0b040", "22262b", "f2efe6"
    )
    pale = "f4efe4"
    if kind == "band":
        return over(
            glaze,
            between(
                sampler(0.36, low=0.1, high=0.5) * height,
                sampler(0.72, low=0.55, high=0.9) * height,
                soft=0.12,
            ),
            accent,
        )
    if kind == "bands":
        return over(
            glaze,
            between(0.62 * height, 0.9 * height),
            rings(parse_hex_color(pale), second, period=0.13 * height),
        )
    if kind == "dots":
        return dots(
            glaze,
            second,
            cell=sampler(2.0, low=1.2, high=3.2),
            radius=sampler(0.3, low=0.2, high=0.4),
        )
    if kind == "stripes":
        ground = sampler.sample_color(pale, "f4f4f2")
        return stripes(
            ground,
            second,
            cell=sampler(1.8, low=1.0, high=4.0),
            share=sampler(0.5, low=0.25, high=0.6),
            slant=int(sampler.pick(0, 2)),
        )
    if kind == "checks":
        board = checks(
            sampler.sample_color(pale), second, cell=sampler(1.4, low=0.9, high=2.2)
        )
        return over(glaze, between(0.25 * height, 0.75 * height), board)
    if kind == "zigzag":
        return over(
            glaze,
            between(0.3 * height, 0.7 * height),
            zigzag(sampler.sample_color(pale), second, cell=2.5),
        )
    if kind == "dip":
        return over(
            glaze,
            between(sampler(0.5, low=0.3, high=0.7) * height, 2 * height, soft=0.1),
            accent,
        )
    if kind == "rings":
        return rings(
            sampler.sample_color(pale),
            second,
            period=height * sampler(0.12, low=0.06, high=0.25),
            share=sampler(0.5, low=0.2, high=0.7),
        )
    return glaze


@family(metres=0.01)
def mug(sampler: ParameterSampler) -> Instance:
    """Make a mug with a handle."""
    height = sampler(9.4, low=7.6, high=12.0)
    wall, side, body = _mug_body(sampler, height)

    style = sampler.pick("ear", "round", "square", "loop")
    grip_high = height * sampler(0.85, low=0.76, high=0.88)
    if style == "loop":
        grip_low = height * sampler(0.3, low=0.34, high=0.42)
    else:
        grip_low = height * sampler(0.2, low=0.16, high=0.3)
    grip = make_handle(
        sampler,
        style,
        low=grip_low,
        high=grip_high,
        reach=sampler(2.9, low=2.3, high=3.4),
        profile=side,
        inset=0.55 * wall,
    )

    paints = _mug_paints(sampler, height)
    patches = shapes.transform_patches(
        [*body, *shapes.transform_patches(grip, shapes.rotation("z", -108.0))],
        SEAM_ROTATION,
    )
    return Instance(
        patches,
        paints,
        sample_material(sampler, roughness=0.3, clearcoat=0.5),
        detail={"inside": 0.8, "base": 0.6},
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
    top = sampler(4.15, low=3.6, high=5.0)
    foot = top * sampler(0.93, low=0.72, high=1.02)
    belly = sampler(0.0, low=-0.06, high=0.13) * top
    wall = sampler(0.36, low=0.28, high=0.5)
    low = sampler(0.7, low=0.3, high=1.2)  # size of the round edge at the foot
    corners = [
        (foot - low, 0.0),
        (foot, low),
        (0.5 * (foot + top) + belly, 0.5 * height),
        (top, height),
    ]
    side = shapes.spline(np.array(corners[1:]), count=14)
    outside = np.concatenate([[corners[0], (foot - 0.3 * low, 0.25 * low)], side])
    body = shapes.vessel(outside, wall=wall, floor=sampler(0.6, low=0.5, high=0.9))
    return wall, side, body


def _mug_paints(sampler: ParameterSampler, height: float) -> dict[str, Paint]:
    """Sample the paints of a mug of a height, by the tags of its parts."""
    offset = sampler.offset()
    clay = sampler.sample_color(
        "e9dfca", "f3f1ec", "d9c7a5", "3a3f45", "8fa7a0", "b5442e", "6f8fb0"
    )
    specks = sampler.sample_color("7d6247", wild=0.2)
    glaze = speckled(
        clouded(clay, factor=0.93, scale=3.0, offset=offset),
        specks,
        scale=0.28,
        offset=offset,
        amount=sampler(0.06, low=0.0, high=0.14),
    )
    deep = sampler.sample_color("1f4e79", "2c6e63", "a63c2a", "d79b2b", "2d2d33")
    accent = clouded(deep, factor=1.35, scale=2.2, offset=offset)
    outer = paint_or_random(sampler, height, _ceramic(sampler, height, glaze, accent))
    # the inside is seldom decorated; else it is glazed or of one color
    inner = outer
    if not sampler.chance(0.15):
        inner = glaze
        if sampler.chance(0.5, canonical=True):
            inner = solid(sampler.sample_color("efe6d4", "f3f1ec", wild=0.3))
    raw_clay = solid("a98663")
    # the foot may be left without a glaze
    outside = outer
    if sampler.chance(0.4, canonical=True):
        outside = over(outer, between(-1.0, 0.35, soft=0.1), raw_clay)
    return {
        "outside": outside,
        "inside": inner,
        "base": raw_clay,
        "handle": sampler.pick(glaze, outer, accent),
    }


@family(metres=0.01)
def bowl(sampler: ParameterSampler) -> Instance:
    """Make a bowl."""
    radius = 8.0
    height = radius * sampler(0.86, low=0.6, high=1.0)
    body = _bowl_body(sampler, radius, height)
    offset = sampler.offset()
    clay = sampler.sample_color(
        "3f7f86", "e9dfca", "2f5d7c", "b5442e", "f3f1ec", "566b3f"
    )
    glaze = clouded(clay, factor=0.72, scale=2.6, offset=offset)
    accent = mottled(
        parse_hex_color("e8dcc0"), parse_hex_color("d6c39a"), scale=2.0, offset=offset
    )
    raw = solid("9b7352")
    if sampler.rng is None:
        rim = over(glaze, between(0.93 * height, 2 * height, soft=0.25), accent)
        outer = over(rim, between(-1.0, 0.55, soft=0.1), raw)
    else:
        outer = paint_or_random(
            sampler, 2 * radius, _ceramic(sampler, height, glaze, accent)
        )
    inner = sampler.pick(
        accent,
        glaze,
        outer,
        solid(sampler.sample_color("f3f1ec")),
        rings(clay, shade(clay, 1.3), period=height * 0.2),
    )
    paints = {"outside": outer, "inside": inner, "base": raw}
    return Instance(
        shapes.transform_patches(body, SEAM_ROTATION),
        paints,
        sample_material(sampler, roughness=0.28, clearcoat=0.5),
        detail={"base": 0.6},
    )


def _bowl_body(sampler: ParameterSampler, radius: float, height: float) -> list[Patch]:
    """Create the surface of a bowl on a foot ring.

    Args:
        sampler: samples its proportions.
        radius: radius of the rim before it flares.
        height: height of the rim.
    """
    foot = radius * sampler(0.42, low=0.34, high=0.55)
    ring = sampler(0.7, low=0.15, high=1.1)  # height of the foot ring
    # how far out the wall is at half height, in units of the radius
    full = sampler(0.86, low=0.72, high=0.97)
    flare = sampler(0.0, low=-0.03, high=0.1) * radius
    knots = [
        (foot * 1.04, ring),
        (radius * 0.5 * (0.72 + full) * 0.92, ring + 0.22 * (height - ring)),
        (radius * full, 0.55 * height),
        (radius * (0.5 + 0.5 * full), 0.8 * height),
        (radius + flare, height),
    ]
    return shapes.vessel(
        np.array([(foot, 0.0), *shapes.spline(knots, count=22)]),
        wall=sampler(0.45, low=0.32, high=0.65),
        floor=ring + 0.55,
        step=0.9,
    )


@family(metres=0.01)
def bottle(sampler: ParameterSampler) -> Instance:
    """Make a bottle with a cap and perhaps a label."""
    height = sampler(30.0, low=24.0, high=32.0)
    shoulder, patches = _bottle_body(sampler, height)
    paints = _bottle_paints(sampler, height, shoulder)
    return Instance(
        shapes.transform_patches(patches, SEAM_ROTATION),
        paints,
        sample_material(sampler, roughness=0.2, clearcoat=0.6),
        detail={"inside": 0.25, "base": 0.5},
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
    rise = height * sampler(0.15, low=0.08, high=0.22)
    slope = sampler(0.35, low=0.1, high=0.8)  # 0: square shoulder, 1: sloping
    taper = sampler(1.0, low=0.93, high=1.03)
    corners = [
        (radius * 0.82, 0.0),
        (radius * taper, 0.02 * height),
        (radius, shoulder),
        (
            neck_radius + (radius - neck_radius) * (0.55 - 0.35 * slope),
            shoulder + rise * (0.6 - 0.25 * slope),
        ),
        (neck_radius * 1.03, shoulder + rise),
        (neck_radius * 0.95, height - 1.6),
    ]
    curve = shapes.round_corners(
        corners, radius=[0.8, 0.45 * rise + 0.4, 0.6 * rise, 0.5 * rise], steps=7
    )
    # the thicker ring around the mouth
    ring_radius = neck_radius * 0.95 + sampler(0.28, low=0.1, high=0.4)
    ring = [
        (ring_radius, height - 1.5),
        (ring_radius, height - 0.6),
        (neck_radius * 0.97, height - 0.5),
        (neck_radius * 0.93, height),
    ]
    capped = sampler.chance(0.4)
    outside = np.concatenate([shapes.subdivide(curve, longest=1.6), ring])
    patches = shapes.vessel(
        outside, wall=sampler(0.35, low=0.3, high=0.45), floor=0.8, step=1.6, columns=48
    )
    if capped:
        patches += _cap(sampler, ring_radius + 0.12, height)
    return shoulder, patches


def _bottle_paints(
    sampler: ParameterSampler, height: float, shoulder: float
) -> dict[str, Paint]:
    """Sample the paints of a bottle: glass, a label, and often foil around its neck.

    Args:
        sampler: samples the paints.
        height: height of the bottle.
        shoulder: height at which the body begins to narrow; the label ends below.
    """
    offset = sampler.offset()
    glass = sampler.sample_color(
        "17351f", "4a2c14", "1d3f2a", "cfdde0", "2a4d69", "ece7dd", "111416"
    )
    surface = paint_or_random(
        sampler,
        height,
        clouded(glass, factor=1.25, scale=9.0, offset=offset),
        wild=0.25,
    )
    paper = sampler.sample_color("efe6cf", "f5f2ea", "20242a", "c9a24b", wild=0.3)
    ink = sampler.sample_color("7a1f2b", "23395d", "2e2a25", "b08d3c", wild=0.3)
    low = 0.14 * height
    high = min(sampler(0.44, low=0.3, high=0.5) * height, shoulder - 1.5)
    outer = (
        surface
        if sampler.chance(0.2)
        else _labelled(
            sampler, surface=surface, paper=paper, ink=ink, low=low, high=high
        )
    )
    foil = sampler.sample_color("6d1a26", "b08d3c", "1c1f24", "23395d", "d5d5d5")
    if sampler.chance(0.5, canonical=True):
        outer = over(
            outer,
            between(height * 0.8, 2 * height),
            speckled(solid(foil), shade(foil, 1.3), scale=0.5, offset=offset),
        )
    return {
        "outside": outer,
        "inside": solid(shade(glass, 0.6)),
        "base": solid(glass),
        "cap": solid(sampler.sample_color("c9a24b", "d0d0d0", "b5442e", "22262b")),
    }


def _cap(sampler: ParameterSampler, radius: float, height: float) -> list[Patch]:
    """Create the cap of a bottle: a cylinder around the end of its neck.

    Args:
        sampler: samples how far down it reaches.
        radius: radius of the cap.
        height: height of the bottle without it.
    """
    low = height - sampler(1.5, low=0.9, high=2.2)
    top = height + 0.35
    under = np.array([[0.6 * radius, low], [radius, low]])
    side = shapes.round_corners(
        [(radius, low), (radius, top), (0.6 * radius, top)], radius=0.3, steps=4
    )
    return shapes.lathe(
        [
            ("cap", under),
            ("cap", shapes.subdivide(side, longest=0.8)),
            ("cap", [[0.6 * radius, top], [0.0, top]]),
        ],
        columns=40,
    )


def _labelled(
    sampler: ParameterSampler,
    surface: Paint,
    paper: Array,
    ink: Array,
    low: float,
    high: float,
) -> Paint:
    """Paint a paper label around part of a bottle, centered opposite the texture's
    seam.

    It has a bar near its upper and its lower edge, a title, three lines of text and a
    round seal.

    Args:
        sampler: samples its width.
        surface: paint of the bottle.
        paper, ink: colors.
        low, high: heights of its edges.
    """
    azimuth = 180.0
    # degrees from the middle of the label to its sides
    half_angle = sampler(95.0, low=60.0, high=180.0)
    span = high - low
    label = over(
        surface,
        facing(azimuth, half_width=half_angle, low=low, high=high, soft=0.08),
        solid(paper),
    )
    label = over(
        label,
        facing(
            azimuth,
            half_width=half_angle - 6.0,
            low=high - 0.12 * span,
            high=high - 0.07 * span,
            soft=0.05,
        ),
        solid(ink),
    )
    label = over(
        label,
        facing(
            azimuth,
            half_width=half_angle - 6.0,
            low=low + 0.06 * span,
            high=low + 0.1 * span,
            soft=0.05,
        ),
        solid(ink),
    )
    title = facing(
        azimuth,
        half_width=0.42 * min(half_angle, 95.0),
        low=low + 0.6 * span,
        high=low + 0.76 * span,
        soft=0.05,
    )
    label = over(label, title, solid(shade(ink, 0.8)))
    for i, share in enumerate((0.5, 0.36, 0.44)):
        z = low + (0.5 - 0.1 * i) * span
        label = over(
            label,
            facing(
                azimuth,
                half_width=share * min(half_angle, 95.0),
                low=z,
                high=z + 0.035 * span,
                soft=0.05,
            ),
            solid(ink),
        )

    def seal(texels: Texels) -> Array:
        """Return the mask of a disc at the lower end of the label."""
        xyz = texels.xyz
        # from the middle of the label, wrapped to [-180, 180) degrees
        angle = np.radians(
            (np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0])) - azimuth + 180.0) % 360.0
            - 180.0
        )
        radius = float(np.hypot(xyz[:, 0], xyz[:, 1]).max())
        center_distance = np.hypot(angle * radius, xyz[:, 2] - (low + 0.2 * span))
        return step(0.09 * span - center_distance, 0.0, soft=0.08)

    return over(label, seal, solid("b08d3c"))


@family(metres=0.01)
def vase(sampler: ParameterSampler) -> Instance:
    """Make a vase, perhaps with handles."""
    height = 24.0
    belly_at, neck_at, profile, patches = _vase_body(sampler, height)
    patches += _vase_handles(sampler, belly_at, neck_at, profile)
    offset = sampler.offset()
    clay = sampler.sample_color(
        "f2f1ea", "b7562f", "2f6f6a", "26303c", "d9c7a5", "8a2f2a"
    )
    glaze = clouded(clay, factor=0.95, scale=4.0, offset=offset)
    outer = paint_or_random(
        sampler, height, _vase_paint(sampler, glaze, height, offset)
    )
    paints = {
        "outside": outer,
        "inside": solid(shade(clay, 0.8)),
        "base": solid("b79b7c"),
        "handle": glaze,
    }
    return Instance(
        shapes.transform_patches(patches, SEAM_ROTATION),
        paints,
        sample_material(sampler, roughness=0.25, clearcoat=0.6),
        detail={"inside": 0.35, "base": 0.5},
    )


def _vase_body(
    sampler: ParameterSampler, height: float
) -> tuple[float, float, Array, list[Patch]]:
    """Create a vase without handles.

    Args:
        sampler: samples its proportions.
        height: height of the lip.

    Returns:
        The heights of the belly (its widest place) and of the neck (the narrowest
        above); its outer profile (34, 2) of points (r, z); and its patches.
    """
    foot = sampler(3.6, low=2.6, high=4.4)
    belly = sampler(7.2, low=5.2, high=8.6)
    belly_at = height * sampler(0.52, low=0.3, high=0.68)
    neck = sampler(2.6, low=2.2, high=3.8)
    neck_at = height * sampler(0.84, low=0.78, high=0.88)
    lip = neck + sampler(1.5, low=0.5, high=2.6)
    knots = [
        (foot, 0.0),
        (foot * 0.97, 0.5),
        (0.45 * foot + 0.55 * belly, 0.48 * belly_at),
        (belly, belly_at),
        (0.45 * belly + 0.55 * neck, 0.45 * belly_at + 0.55 * neck_at),
        (neck, neck_at),
        (lip, height),
    ]
    profile = shapes.spline(knots, count=34)
    patches = shapes.vessel(
        profile, wall=sampler(0.4, low=0.35, high=0.6), floor=0.8, step=1.2
    )
    return belly_at, neck_at, profile, patches


def _vase_handles(
    sampler: ParameterSampler, belly_at: float, neck_at: float, profile: Array
) -> list[Patch]:
    """Create two handles on opposite sides of a vase, or none.

    Args:
        sampler: chooses, and samples their shape.
        belly_at, neck_at: heights between which they are.
        profile: profile of the vase (K, 2).
    """
    patches = list[Patch]()
    if sampler.chance(0.25):
        low = belly_at + 0.15 * (neck_at - belly_at)
        high = neck_at - 0.2
        ear = make_handle(
            sampler,
            "ear",
            low=low,
            high=high,
            reach=sampler(1.6, low=1.2, high=2.4),
            profile=profile,
            inset=0.2,
        )
        patches += [
            *shapes.transform_patches(ear, shapes.rotation("z", 130.0)),
            *shapes.transform_patches(ear, shapes.rotation("z", -50.0)),
        ]
    return patches


def _vase_paint(
    sampler: ParameterSampler, glaze: Paint, height: float, offset: Array
) -> Paint:
    """Paint a vase: blue brushwork on the canonical one; on others that or a
        decoration.

    Args:
        sampler: chooses, and samples the ink.
        glaze: the ground.
        height: height of the vase.
        offset: (3,) into the noise.
    """
    ink = sampler.sample_color("23408f", "1f2a33", "b5442e", "d79b2b", "e9dfca")
    if sampler.rng is not None and sampler.chance(0.6):
        return _ceramic(
            sampler, height, glaze, clouded(ink, factor=1.3, scale=3.0, offset=offset)
        )

    def scroll(texels: Texels) -> Array:
        """Return the mask of curling petals around the belly."""
        angle = np.arctan2(texels.xyz[:, 1], texels.xyz[:, 0])
        z = texels.xyz[:, 2] / height
        curl = np.abs(np.sin(3.0 * angle + 9.0 * np.sin(5.0 * z)))
        petal = curl * (0.5 + 0.5 * np.sin(30.0 * z + 2.0 * np.sin(6.0 * angle)))
        return step(petal, 0.55, soft=0.16) * between(
            0.24 * height, 0.74 * height, soft=0.1
        )(texels)

    def frieze(texels: Texels) -> Array:
        """Return the mask of a band of 16 teeth above the foot."""
        teeth = step(
            np.sin(16 * np.arctan2(texels.xyz[:, 1], texels.xyz[:, 0])), 0.0, soft=0.5
        )
        return between(0.09 * height, 0.17 * height, soft=0.1)(texels) * teeth

    paint = over(glaze, scroll, solid(ink))
    # rings of ink, as fractions of the height
    for low, high in (
        (0.05, 0.08),
        (0.18, 0.2),
        (0.215, 0.225),
        (0.76, 0.77),
        (0.785, 0.805),
        (0.96, 2.0),
    ):
        paint = over(paint, between(low * height, high * height, soft=0.12), solid(ink))
    return over(paint, frieze, solid(ink))


@family(metres=0.01)
def wine_glass(sampler: ParameterSampler) -> Instance:
    """Make a wine glass, perhaps with wine."""
    foot = sampler(3.5, low=2.9, high=4.2)
    stem = sampler(0.42, low=0.32, high=0.6)
    stem_top = sampler(9.5, low=6.0, high=12.0)
    depth, wall, outer = _glass_bowl(sampler, stem, stem_top)
    inner, lip = _glass_lip(outer, wall, stem_top, depth)
    profile = _glass_profile(
        stem_top=stem_top,
        depth=depth,
        inner=inner,
        foot=foot,
        stem=stem,
        outer=outer,
        lip=lip,
    )
    body = shapes.lathe(profile, columns=52)
    paints = _glass_paints(sampler, stem_top, depth)
    return Instance(
        shapes.transform_patches(body, SEAM_ROTATION),
        paints,
        sample_material(sampler, roughness=0.18, clearcoat=0.8, spread=0.12),
    )


def _glass_bowl(
    sampler: ParameterSampler, stem: float, stem_top: float
) -> tuple[float, float, Array]:
    """Sample the bowl of a wine glass, with the upper part of its stem.

    Args:
        sampler: samples its proportions.
        stem: radius of the stem.
        stem_top: height at which the bowl begins.

    Returns:
        The depth of the bowl; the thickness of its wall; and its outer profile (36, 2),
        points (r, z) from the stem up to the mouth.
    """
    bowl = sampler(4.1, low=3.2, high=5.0)
    depth = sampler(9.8, low=6.5, high=11.5)
    mouth = bowl * sampler(0.8, low=0.7, high=1.12)
    wide_at = sampler(0.42, low=0.3, high=0.55)
    wall = sampler(0.24, low=0.2, high=0.3)
    knob = sampler.chance(0.25)
    neck = [
        (stem * (2.2 if knob else 1.0), 0.78 * stem_top),
        (stem * 1.1, 0.92 * stem_top),
    ]
    cup = [
        (0.5 * bowl, stem_top + 0.07 * depth),
        (0.86 * bowl, stem_top + 0.2 * depth),
        (bowl, stem_top + wide_at * depth),
        (0.45 * bowl + 0.55 * mouth, stem_top + 0.76 * depth),
        (mouth, stem_top + depth),
    ]
    outer = shapes.spline([(stem, 0.6 * stem_top), *neck, *cup], count=36)
    return depth, wall, outer


def _glass_lip(
    outer: Array, wall: float, stem_top: float, depth: float
) -> tuple[Array, Array]:
    """Return the profile of the inside of a wine glass, and that of its rounded lip.

    Args:
        outer: (K, 2) points (r, z) from the stem up to the mouth.
        wall: thickness of the wall.
        stem_top: height at which the bowl begins.
        depth: depth of the bowl.

    Returns:
        The inside (n, 2) from the mouth downwards, without its floor; and three points
        (3, 2) of the half circle that joins the outside to it.
    """
    # the tangent (dr, dz), then turned to the right, which is outwards
    normal = np.gradient(outer, axis=0)
    normal = np.stack([normal[:, 1], -normal[:, 0]], axis=1) / np.linalg.norm(
        normal, axis=1, keepdims=True
    )
    inner = (outer - wall * normal)[::-1]
    # what is lower belongs to the floor
    inner = inner[inner[:, 1] > stem_top + 0.11 * depth]
    angle = np.pi * np.arange(1, 4) / 4
    # on along the profile, beyond the mouth
    side = np.array([-normal[-1, 1], normal[-1, 0]])
    curl = np.cos(angle)[:, None] * normal[-1] + np.sin(angle)[:, None] * side
    # around the middle of the wall's end
    lip = outer[-1] - wall / 2 * normal[-1] + wall / 2 * curl
    return inner, lip


def _glass_profile(
    stem_top: float,
    depth: float,
    inner: Array,
    foot: float,
    stem: float,
    outer: Array,
    lip: Array,
) -> list[tuple[str, Array]]:
    """Return the tags and profiles of the parts of a wine glass, in order.

    They go from the axis along the foot's lower side, up the outside, over the lip, and
    down the inside to the axis.

    Args:
        stem_top: height of the top of the stem.
        depth: depth of the bowl.
        inner, outer, lip: profiles of the bowl (K, 2); `inner` leads downwards.
        foot, stem: radii.
    """
    floor = stem_top + 0.08 * depth
    edge = (inner[-1, 0] * 0.6, floor + 0.25 * (inner[-1, 1] - floor))
    under = [(0.0, 0.12), (foot * 0.8, 0.12), (foot * 0.9, 0.0), (foot - 0.15, 0.0)]
    rising = [
        (foot, 0.28),
        (0.55 * foot, 0.6),
        (0.22 * foot, 1.25),
        (stem * 1.15, 2.4),
        (stem, 0.6 * stem_top),
    ]
    return [
        ("foot", shapes.subdivide(under, longest=1.5)),
        ("foot", np.array([under[-1], (foot, 0.08), *shapes.spline(rising, count=14)])),
        ("bowl", np.concatenate([outer, lip, inner[:1]])),
        ("inside", inner),
        ("inside", np.array([inner[-1], edge, (0.0, floor)])),
    ]


def _glass_paints(
    sampler: ParameterSampler, stem_top: float, depth: float
) -> dict[str, Paint]:
    """Sample the paints of a wine glass, which often has wine in it.

    The glass is opaque: wine is a color of its outside and its inside up to a level.

    Args:
        sampler: samples the paints.
        stem_top: height at which the bowl begins.
        depth: depth of the bowl.
    """
    height = stem_top + depth
    tint = sampler.sample_color(
        "c4dbe2", "d9e4e6", "e8d9c8", "8fb8a8", "c58a94", "7c9cc4", "f0f0ee", wild=0.3
    )
    drink = sampler.sample_color("6d1526", "d8b45a", "c46a6a", "3f1420", wild=0.15)
    level = stem_top + depth * sampler(0.48, low=0.3, high=0.62)
    plain = gradient(shade(tint, 0.86), shade(tint, 1.08), low=0.0, high=height)
    outside = inside = plain
    if sampler.chance(0.5, canonical=True):
        wine = clouded(drink, factor=0.8, scale=3.0, offset=sampler.offset())
        outside = over(plain, between(stem_top + 0.06 * depth, level, soft=0.1), wine)
        inside = over(plain, between(0.0, level, soft=0.1), solid(drink))
    outside = paint_or_random(sampler, height, outside, wild=0.3)
    if sampler.chance(0.2, canonical=True):
        outside = over(
            outside, between(height - 0.35, 2 * height, soft=0.1), solid("c9a24b")
        )
    if sampler.chance(0.7, canonical=True):
        foot_paint = sampler.pick(plain, outside, plain)
    else:
        foot_paint = sample_paint(sampler, height)
    return {"foot": foot_paint, "bowl": outside, "inside": inside}
