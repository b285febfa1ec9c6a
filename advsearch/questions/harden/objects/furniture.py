"""Chair and table lamp. Units are centimetres."""

from __future__ import annotations

from itertools import product

import numpy as np

import advsearch.questions.harden.objects.shapes as shapes
from advsearch.questions.harden.objects.family import Instance, family, sample_material
from advsearch.questions.harden.objects.shapes import Array, Patch
from advsearch.questions.harden.objects.textures import (
    Color,
    Paint,
    ParameterSampler,
    between,
    checks,
    clouded,
    dots,
    gradient,
    over,
    paint_or_random,
    parse_hex_color,
    rings,
    shade,
    solid,
    stripes,
    wood,
)

Point = tuple[float, float, float]


def _post(
    tag: str, low: Point, high: Point, section: Array, ends: tuple[float, float]
) -> list[Patch]:
    """Create a straight post between two points, with slightly beveled ends.

    Args:
        tag: tag of its paint.
        low, high: its ends.
        section: (M, 2), for a radius of 1.
        ends: radii at `low` and at `high`; the radius changes evenly between them.
    """
    t = np.array([0.0, 0.02, 0.5, 0.98, 1.0])
    path = np.array(low) + t[:, None] * (np.array(high) - np.array(low))
    # the first and last ring are smaller: the bevel
    scale = (ends[0] + (ends[1] - ends[0]) * t) * np.array([0.9, 1.0, 1.0, 1.0, 0.9])
    # the section's first axis must not be along the post
    is_lying = abs(high[0] - low[0]) > abs(high[2] - low[2])
    return shapes.sweep(
        tag,
        path,
        section,
        scale,
        first=(0.0, 0.0, 1.0) if is_lying else (1.0, 0.0, 0.0),
        caps=True,
    )


@family(metres=0.01)
def chair(sampler: ParameterSampler) -> Instance:
    """Make a chair that faces +x, with its back at -x."""
    width = sampler(43.0, low=36.0, high=50.0)
    depth = sampler(42.0, low=36.0, high=48.0)
    seat_height = sampler(45.0, low=40.0, high=50.0)
    total_height = sampler(92.0, low=78.0, high=108.0)
    seat_thickness = sampler(3.6, low=2.4, high=5.5)
    leg_radius = sampler(2.1, low=1.5, high=3.0)
    splay = sampler(1.5, low=0.0, high=6.0)
    lean = sampler(5.0, low=1.0, high=11.0)
    section = _leg_section(sampler)
    taper = (leg_radius * sampler(0.75, low=0.55, high=1.0), leg_radius)
    x = depth / 2 - leg_radius - 0.4
    y = width / 2 - leg_radius - 0.4
    patches: list[Patch] = []
    patches += _chair_legs(
        x=x,
        splay=splay,
        y=y,
        seat_height=seat_height,
        seat_thickness=seat_thickness,
        section=section,
        taper=taper,
    )
    patches += shapes.box(
        "seat",
        (0.0, 0.0, seat_height - seat_thickness / 2),
        (depth, width, seat_thickness),
        bevel=0.45 * seat_thickness,
        steps=3,
        cells=2,
    )
    if sampler.chance(0.35):
        patches += shapes.box(
            "cushion",
            (0.5, 0.0, seat_height + 1.4),
            (depth - 4.0, width - 4.0, 4.4),
            bevel=2.1,
            steps=3,
            cells=2,
        )
    if sampler.chance(0.55, canonical=True):
        patches += _chair_rungs(
            sampler,
            seat_height=seat_height,
            splay=splay,
            x=x,
            y=y,
            leg_radius=leg_radius,
            section=section,
        )
    patches += _chair_back(
        sampler,
        x=x,
        y=y,
        seat_height=seat_height,
        total_height=total_height,
        lean=lean,
        leg_radius=leg_radius,
        section=section,
    )
    rotated = shapes.transform_patches(
        patches, shapes.rotation("z", sampler(8.0, low=-25.0, high=25.0))
    )
    return Instance(
        rotated,
        _chair_paints(sampler, total_height),
        sample_material(sampler, roughness=0.45, clearcoat=0.2),
    )


def _leg_section(sampler: ParameterSampler) -> Array:
    """Sample the section (M, 2) of the legs of a chair: square or round."""
    square = sampler.chance(0.5, canonical=True)
    return (
        shapes.rectangle(2.0, 2.0, bevel=0.5, steps=2)
        if square
        else shapes.ellipse(1.0, 1.0, count=16)
    )


def _chair_legs(
    x: float,
    splay: float,
    y: float,
    seat_height: float,
    seat_thickness: float,
    section: Array,
    taper: tuple[float, float],
) -> list[Patch]:
    """Create the four legs of a chair, which stand wider apart at the floor.

    Args:
        x, y: x and y of the top of the leg at +x and +y; the others mirror it.
        splay: by how much a foot lies farther out than its top, along x and y.
        seat_height: seat height of the upper side of the seat.
        seat_thickness: seat thickness of the seat.
        section: (M, 2), for a radius of 1.
        taper: radii at the floor and at the top.
    """
    patches = list[Patch]()
    for sign_x, sign_y in product((-1.0, 1.0), repeat=2):
        foot = (sign_x * (x + splay), sign_y * (y + splay), 0.0)
        patches += _post(
            "up",
            foot,
            (sign_x * x, sign_y * y, seat_height - seat_thickness + 0.5),
            section,
            taper,
        )
    return patches


def _chair_rungs(
    sampler: ParameterSampler,
    seat_height: float,
    splay: float,
    x: float,
    y: float,
    leg_radius: float,
    section: Array,
) -> list[Patch]:
    """Create the rungs of a chair: one along each side, and one across between them.

    Args:
        sampler: samples their height.
        seat_height: seat height of the upper side of the seat.
        splay, x, y, section: as in `_chair_legs`.
        leg_radius: leg radius of the legs; rungs are thinner.
    """
    patches = list[Patch]()
    low = seat_height * sampler(0.36, low=0.25, high=0.6)
    # how far out the legs are at that height
    spread = splay * (1.0 - low / seat_height)
    front_x = x + spread
    side_y = y + spread
    thin = (0.55 * leg_radius, 0.55 * leg_radius)
    thinner = (0.5 * leg_radius, 0.5 * leg_radius)
    for sign_y in (-1.0, 1.0):
        patches += _post(
            "along",
            (-front_x, sign_y * side_y, low),
            (front_x, sign_y * side_y, low),
            section,
            thin,
        )
    patches += _post("cross", (0.0, -side_y, low), (0.0, side_y, low), section, thinner)
    return patches


def _chair_paints(sampler: ParameterSampler, total_height: float) -> dict[str, Paint]:
    """Sample the paints of a chair by the tags of its parts.

    All wood is painted with one paint, or else shows its grain along each part.
    Cushions, and sometimes the seat, have a fabric.

    Args:
        sampler: samples the paints.
        total_height: total height of the chair.
    """
    offset = sampler.offset()
    timber = sampler.sample_color(
        "a86f3d", "c79a63", "6b4226", "3a2418", "d8bc92", wild=0.0
    )
    paint_color = sampler.sample_color(
        "f0ede4", "2f5d7c", "b5442e", "3d6b4a", "22262b", "e0b040"
    )
    painted = sampler.chance(0.4)
    wood_paint = paint_or_random(sampler, total_height, solid(paint_color), wild=0.5)

    def grain(axis: int) -> Paint:
        """Return the paint of a part whose grain, if any, runs along an axis."""
        return (
            wood_paint
            if painted
            else wood(timber, scale=3.2, offset=offset, axis=axis, contrast=0.36)
        )

    fabric = sampler.sample_color("8a2f2a", "2f4f6f", "566b3f", "c9b48a", "4a4a4f")
    cover = sampler.pick(
        clouded(fabric, factor=0.8, scale=1.5, offset=offset),
        stripes(fabric, shade(fabric, 1.5), cell=6.0),
        checks(fabric, parse_hex_color("efe6d4"), cell=4.0),
        dots(solid(fabric), parse_hex_color("f4efe4"), cell=6.0),
    )
    seat_paint = cover if sampler.chance(0.25) else grain(0)
    return {
        "up": grain(2),
        "along": grain(0),
        "cross": grain(1),
        "seat": seat_paint,
        "cushion": cover,
    }


def _chair_back(
    sampler: ParameterSampler,
    x: float,
    y: float,
    seat_height: float,
    total_height: float,
    lean: float,
    leg_radius: float,
    section: Array,
) -> list[Patch]:
    """Create the back of a chair: two posts, and what is between them.

    That is vertical slats below a rail ("slats" with a second rail below them, "arch"
    without), horizontal bars ("ladder"), or one board ("panel").

    Args:
        sampler: samples the kind and its proportions.
        x, y: x and y of the tops of the legs, which the posts continue upwards.
        seat_height: seat height of the upper side of the seat.
        total_height: total height of the top of the back.
        lean: by how much the top lies farther back than the seat.
        leg_radius: radius of the posts, at their lower end.
        section: (M, 2) of the posts, for a radius of 1.
    """
    style = sampler.pick("slats", "ladder", "panel", "arch")
    patches: list[Patch] = []
    foot = seat_height - 2.0  # inside the seat

    def back_x(z: float) -> float:
        """Return the x of the leaning back at a height."""
        return -x - lean * (z - seat_height) / (total_height - seat_height)

    for sign_y in (-1.0, 1.0):
        patches += _post(
            "up",
            (back_x(foot), sign_y * y, foot),
            (back_x(total_height), sign_y * y, total_height),
            section,
            (leg_radius, 0.85 * leg_radius),
        )
    tilt = shapes.rotation(
        "y", -float(np.degrees(np.arctan2(lean, total_height - seat_height)))
    )
    depth = sampler(1.6, low=1.2, high=2.4)

    def slat(
        tag: str, z: float, width: float, height: float, center_y: float = 0.0
    ) -> list[Patch]:
        """Create a board of the back, which leans with it.

        Args:
            tag: tag of its paint.
            z: height of its middle.
            width, height: width and height of the board.
            center_y: y of its middle.
        """
        return shapes.transform_patches(
            shapes.box(tag, (0.0, 0.0, 0.0), (depth, width, height), bevel=0.5),
            tilt,
            (back_x(z), center_y, z),
        )

    inner_width = 2 * (y - 0.3 * leg_radius)
    back_height = total_height - seat_height
    if style in ("slats", "arch"):
        patches += slat(
            "cross", total_height - 0.09 * back_height, inner_width, 0.14 * back_height
        )
        if style == "slats":
            patches += slat(
                "cross",
                seat_height + 0.2 * back_height,
                inner_width,
                0.09 * back_height,
            )
        count = int(sampler.pick(5, 3, 4, 6))
        low = (
            seat_height + 0.22 * back_height if style == "slats" else seat_height - 1.0
        )
        for i in range(count):
            top = total_height - 0.15 * back_height
            patches += slat(
                "up",
                (low + top) / 2,
                inner_width * sampler(0.075, low=0.05, high=0.11),
                top - low + 1.0,
                inner_width * ((i + 1) / (count + 1) - 0.5),
            )
    elif style == "ladder":
        count = int(sampler.pick(3, 2, 4))
        for i in range(count):
            z = seat_height + back_height * (0.28 + 0.66 * i / max(1, count - 1))
            patches += slat(
                "cross", z, inner_width, back_height * sampler(0.15, low=0.1, high=0.2)
            )
    else:
        tall = sampler(0.6, low=0.35, high=0.75) * back_height
        patches += slat(
            "cushion" if sampler.chance(0.3) else "up",
            total_height - tall / 2 - 0.04 * back_height,
            inner_width,
            tall,
        )
    return patches


def _shade(
    sampler: ParameterSampler,
    low: float,
    high: float,
    bottom_radius: float,
    top_radius: float,
) -> list[Patch]:
    """Create an open lampshade with a thin wall.

    Its profile is one closed loop: up the outside, over the rim, down the lining.

    Args:
        sampler: samples how much it bulges.
        low, high: heights of its edges.
        bottom_radius, top_radius: bottom radius and top radius of its edges.
    """
    wall = 0.25
    belly = sampler(0.0, low=-0.1, high=0.12) * bottom_radius
    outer = shapes.spline(
        [
            (bottom_radius, low),
            ((bottom_radius + top_radius) / 2 + belly, (low + high) / 2),
            (top_radius, high),
        ],
        count=14,
    )
    inner = (outer - np.array([wall, 0.0]))[::-1]
    pieces = [
        ("shade", shapes.subdivide(outer, longest=2.0)),
        ("rim", [outer[-1], inner[0]]),
        ("lining", inner),
        ("rim", [inner[-1], outer[0]]),
    ]
    return shapes.lathe(pieces, columns=56)


def _lamp_base(
    sampler: ParameterSampler, style: str, low: float, radius: float, stem_radius: float
) -> list[Patch]:
    """Create the base of a lamp, from the table to the bulb.

    Args:
        sampler: samples its proportions.
        style: "disc" (a flat foot with a thin stem), "body" or "gourd" (a body with a
            waist).
        low: height of its top.
        radius: radius of the foot.
        stem_radius: stem radius of the top.
    """
    # profiles of points (r, z): the lower side, and the flat top
    under = [(0.0, 0.0), (radius - 0.4, 0.0)]
    top = [(stem_radius, low), (0.0, low)]
    if style == "disc":
        thick = sampler(2.0, low=1.2, high=3.2)
        corners = [
            under[-1],
            (radius, 0.4),
            (radius * 0.96, thick),
            (stem_radius * 2.0, thick * 1.4),
            (stem_radius, thick * 2.2),
            top[0],
        ]
        side = shapes.subdivide(
            shapes.round_corners(corners, radius=[0.3, 0.5, 1.0, 1.2], steps=5),
            longest=1.6,
        )
        return shapes.lathe(
            [("base", under), ("base", side), ("base", top)], columns=44
        )
    belly = radius * sampler(1.12, low=0.95, high=1.4)
    belly_height = sampler(0.38, low=0.28, high=0.6) * low  # height of the belly
    waist = [(0.45 * belly, 0.72 * low)]
    if style == "gourd":
        waist = [(0.55 * belly, 0.6 * low), (0.72 * belly, 0.73 * low)]
    knots = [
        (radius * 0.96, 1.2),
        (radius * 0.8, 2.4),
        (belly, belly_height),
        *waist,
        (stem_radius * 1.5, 0.86 * low),
        (stem_radius, 0.93 * low),
    ]
    body = shapes.spline(knots, count=34)
    ring = shapes.round_corners(
        [under[-1], (radius, 0.2), (radius, 1.2), knots[0]], radius=[0.15, 0.3], steps=3
    )
    neck = [knots[-1], top[0]]
    return shapes.lathe(
        [
            ("base", under),
            ("foot", ring),
            ("body", body),
            ("base", neck),
            ("base", top),
        ],
        columns=44,
    )


def _shade_paint(
    sampler: ParameterSampler,
    linen: Color,
    offset: Array,
    low: float,
    total_height: float,
) -> Paint:
    """Sample the paint of a lamp's shade.

    Args:
        sampler: samples the pattern and the color of its second part.
        linen: color of the cloth.
        offset: (3,) into the noise.
        low, total_height: heights of the shade's lower and upper edge.
    """
    weave = clouded(linen, factor=0.93, scale=1.2, offset=offset)
    kind = sampler.pick("plain", "band", "stripes", "dots", "rings", "gradient")
    accent = sampler.sample_color("b08d3c", "7a1f2b", "23395d", "efe6cf")
    if kind == "band":
        for band in (
            between(0.0, low + 1.4),
            between(total_height - 1.4, 2 * total_height),
        ):
            weave = over(weave, band, solid(accent))
    elif kind == "stripes":
        weave = stripes(
            linen,
            accent,
            cell=sampler(5.0, low=3.0, high=9.0),
            share=sampler(0.4, low=0.2, high=0.6),
        )
    elif kind == "dots":
        weave = dots(weave, accent, cell=sampler(6.0, low=4.0, high=9.0))
    elif kind == "rings":
        weave = rings(linen, accent, period=sampler(6.0, low=3.0, high=10.0))
    elif kind == "gradient":
        weave = gradient(linen, shade(linen, 0.6), low=low, high=total_height)
    else:
        for hem in (
            between(0.0, low + 0.5),
            between(total_height - 0.5, 2 * total_height),
        ):
            weave = over(weave, hem, solid(shade(linen, 0.75)))
    return paint_or_random(sampler, total_height, weave, wild=0.3)


@family(metres=0.01)
def lamp(sampler: ParameterSampler) -> Instance:
    """Make a table lamp of random proportions, shade and base."""
    total_height = sampler(48.0, low=42.0, high=58.0)
    shade_height = sampler(20.0, low=14.0, high=24.0)
    bottom_radius = sampler(16.5, low=12.0, high=19.0)
    top_radius = bottom_radius * sampler(0.6, low=0.35, high=1.0)
    low = total_height - shade_height
    radius = sampler(7.4, low=6.0, high=9.5)
    stem_radius = sampler(0.8, low=0.6, high=1.3)
    style = sampler.pick("body", "disc", "gourd")
    base = _lamp_base(
        sampler,
        style=style,
        low=low + 0.25 * shade_height,
        radius=radius,
        stem_radius=stem_radius,
    )
    patches = base + _shade(
        sampler,
        low=low,
        high=total_height,
        bottom_radius=bottom_radius,
        top_radius=top_radius,
    )
    patches += shapes.sphere(
        "bulb",
        min(3.0, 0.4 * top_radius),
        centre=(0.0, 0.0, low + 0.42 * shade_height),
        rows=12,
        columns=20,
    )
    patches += _lamp_frame(
        total_height=total_height,
        shade_height=shade_height,
        top_radius=top_radius,
        bottom_radius=bottom_radius,
        low=low,
    )
    paints = _lamp_paints(sampler, low, total_height, style)
    return Instance(
        patches,
        paints,
        sample_material(sampler, roughness=0.4, clearcoat=0.3),
        detail={"lining": 0.6},
    )


def _lamp_frame(
    total_height: float,
    shade_height: float,
    top_radius: float,
    bottom_radius: float,
    low: float,
) -> list[Patch]:
    """Create the rod of a lamp and the three spokes that hold its shade.

    Args:
        total_height: total height of the lamp, which is the upper edge of the shade.
        shade_height, top_radius, bottom_radius: shade height, top radius and bottom
            radius of the shade.
        low: height of the shade's lower edge.
    """
    patches = list[Patch]()
    ring_z = total_height - 0.12 * shade_height
    # radius of the shade there
    inside = top_radius + (bottom_radius - top_radius) * 0.12
    for angle in (20.0, 140.0, 260.0):
        spoke = shapes.sweep(
            "base",
            [(0.0, 0.0, ring_z), (inside, 0.0, ring_z)],
            shapes.ellipse(0.22, 0.22, count=8),
        )
        patches += shapes.transform_patches(spoke, shapes.rotation("z", angle))
    rod = [
        (0, 0, z)
        for z in (low + 0.2 * shade_height, ring_z, ring_z + 0.8, ring_z + 1.0)
    ]
    patches += shapes.sweep(
        "base",
        rod,
        shapes.ellipse(0.35, 0.35, count=10),
        (1.0, 1.0, 1.6, 0.0),
        first=(1.0, 0.0, 0.0),
    )
    return patches


def _lamp_paints(
    sampler: ParameterSampler, low: float, total_height: float, style: str
) -> dict[str, Paint]:
    """Sample the paints of a lamp by the tags of its parts.

    Args:
        sampler: samples the paints.
        low, total_height: heights of the shade's edges.
        style: style of the base, as for `_lamp_base`.
    """
    offset = sampler.offset()
    linen = sampler.sample_color(
        "f1e3c4", "f4f1e8", "c9b48a", "b5442e", "2f5d7c", "3d6b4a", "20242a", wild=0.25
    )
    cloth = _shade_paint(
        sampler, linen=linen, offset=offset, low=low, total_height=total_height
    )
    clay = sampler.sample_color(
        "2f6f6a", "23408f", "b5442e", "f2f1ea", "22262b", "8a5a32", "c9a24b"
    )
    body = paint_or_random(
        sampler,
        total_height,
        clouded(clay, factor=1.3, scale=4.0, offset=offset),
        wild=0.35,
    )
    metal = sampler.sample_color("b08d3c", "2b2d30", "b4b8bd", "8a5a32", wild=0.15)
    return {
        "shade": cloth,
        "rim": solid(shade(linen, 0.8)),
        "lining": solid("f4f0e4"),
        "bulb": solid("fbf6e6"),
        "body": body,
        "foot": solid(metal),
        "base": body if style == "disc" and sampler.chance(0.5) else solid(metal),
    }
