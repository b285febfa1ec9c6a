"""Chair and table lamp. Units are centimetres."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import numpy as np

import advsearch.questions.harden.objects.shapes as shapes
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
    checks,
    choose_paint_or_random,
    dots,
    gradient,
    make_range_mask,
    paint_over,
    paint_shaded_clouds,
    paint_solid_color,
    parse_hex_color,
    rings,
    scale_brightness,
    stripes,
    wood,
)

Point = tuple[float, float, float]
LEG_INSET = 0.4
"""Distance from the outside of a leg to the edge of the seat."""


class _Legs(NamedTuple):
    """The legs of a chair. The two at -x are continued by the posts of its back.

    Attributes:
        x, y: position of the top of the leg at +x and +y; the others mirror it.
        splay: how much farther out a foot is than the top of its leg, along x and y.
        radius: radius at the top.
        foot_radius: radius at the floor.
        section: section of a leg (M, 2), for a radius of 1.
    """

    x: float
    y: float
    splay: float
    radius: float
    foot_radius: float
    section: Array


def _post(
    tag: str, low: Point, high: Point, section: Array, radii: tuple[float, float]
) -> list[Patch]:
    """Create a straight post between two points, with slightly beveled ends.

    Args:
        tag: tag of its paint.
        low, high: its end points.
        section: (M, 2), for a radius of 1.
        radii: radii at `low` and at `high`; the radius changes evenly between them.
    """
    t = np.array([0.0, 0.02, 0.5, 0.98, 1.0])  # from `low` to `high`
    path = np.array(low) + t[:, None] * (np.array(high) - np.array(low))
    bevel = np.array([0.9, 1.0, 1.0, 1.0, 0.9])  # the first and last ring are smaller
    scale = (radii[0] + (radii[1] - radii[0]) * t) * bevel
    # `sweep_section` needs a first axis of the section that is not along the post
    is_lying = abs(high[0] - low[0]) > abs(high[2] - low[2])
    first_axis = (0.0, 0.0, 1.0) if is_lying else (1.0, 0.0, 0.0)
    return shapes.sweep_section(
        tag, path, section, scale, start_axis=first_axis, has_caps=True
    )


class _ChairSize(NamedTuple):
    """Measures of a chair in centimeters.

    Attributes:
        width, depth: size of the seat along y and x.
        seat_height, total_height: heights of the seat, and of the top of the back.
        seat_thickness: thickness of the seat.
        leg_radius: radius of a leg at its top.
        splay: how much farther out a foot is than the top of its leg.
        lean: how far the back's top is behind the seat.
    """

    width: float
    depth: float
    seat_height: float
    total_height: float
    seat_thickness: float
    leg_radius: float
    splay: float
    lean: float


@make_family(unit_in_metres=0.01)  # built in centimeters
def chair(sampler: ParameterSampler) -> Instance:
    """Make a chair that faces +x, with its back at -x, and turn it a little about z.

    Lengths are in centimeters, angles in degrees. `sampler(x, low=..., high=...)`
    returns x for the canonical chair and a uniform sample for a random one.
    """
    size = _sample_chair_size(sampler)
    legs = _sample_legs(sampler, size)
    patches = _chair_legs(legs, size.seat_height - size.seat_thickness)
    seat_size = (size.depth, size.width, size.seat_thickness)
    patches += _chair_seat(sampler, seat_size, size.seat_height)
    if sampler.sample_bool(0.55, canonical=True):
        patches += _chair_rungs(sampler, legs, size.seat_height)
    patches += _chair_back(
        sampler, legs, size.seat_height, size.total_height, size.lean
    )
    rotated = shapes.transform_patches(
        patches, shapes.make_rotation_matrix("z", sampler(8.0, low=-25.0, high=25.0))
    )
    return Instance(
        rotated,
        _chair_paints(sampler, size.total_height),
        sample_material(sampler, roughness=0.45, clearcoat=0.2),
    )


def _sample_chair_size(sampler: ParameterSampler) -> _ChairSize:
    """Sample the measures of a chair."""
    return _ChairSize(
        width=sampler(43.0, low=36.0, high=50.0),
        depth=sampler(42.0, low=36.0, high=48.0),
        seat_height=sampler(45.0, low=40.0, high=50.0),
        total_height=sampler(92.0, low=78.0, high=108.0),
        seat_thickness=sampler(3.6, low=2.4, high=5.5),
        leg_radius=sampler(2.1, low=1.5, high=3.0),
        splay=sampler(1.5, low=0.0, high=6.0),
        lean=sampler(5.0, low=1.0, high=11.0),
    )


def _sample_legs(sampler: ParameterSampler, size: _ChairSize) -> _Legs:
    """Sample the legs of a chair: their section, and their radius at the floor."""
    section = _leg_section(sampler)
    return _Legs(
        x=size.depth / 2 - size.leg_radius - LEG_INSET,
        y=size.width / 2 - size.leg_radius - LEG_INSET,
        splay=size.splay,
        radius=size.leg_radius,
        foot_radius=size.leg_radius * sampler(0.75, low=0.55, high=1.0),
        section=section,
    )


def _leg_section(sampler: ParameterSampler) -> Array:
    """Sample the section (M, 2) of the legs of a chair: square or round."""
    if sampler.sample_bool(0.5, canonical=True):
        return shapes.rectangle(2.0, 2.0, bevel=0.5, steps=2)
    return shapes.ellipse(1.0, 1.0, count=16)


def _chair_legs(legs: _Legs, seat_bottom: float) -> list[Patch]:
    """Create the four legs of a chair, which stand wider apart at the floor.

    Args:
        legs: their position and size.
        seat_bottom: height of the lower side of the seat.
    """
    top_z = seat_bottom + 0.5  # inside the seat, so that no gap shows
    patches = list[Patch]()
    for sign_x, sign_y in product((-1.0, 1.0), repeat=2):
        foot = (sign_x * (legs.x + legs.splay), sign_y * (legs.y + legs.splay), 0.0)
        top = (sign_x * legs.x, sign_y * legs.y, top_z)
        radii = (legs.foot_radius, legs.radius)
        patches += _post("up", foot, top, legs.section, radii)
    return patches


def _chair_seat(
    sampler: ParameterSampler, size: Point, seat_height: float
) -> list[Patch]:
    """Create the seat of a chair, sometimes with a cushion on it.

    Args:
        sampler: decides whether there is a cushion.
        size: extent of the seat along x, y and z.
        seat_height: height of its upper side.
    """
    depth, width, thickness = size
    middle = (0.0, 0.0, seat_height - thickness / 2)
    patches = shapes.make_rounded_box(
        "seat", middle, size, bevel=0.45 * thickness, steps=3, cells=2
    )
    if sampler.sample_bool(0.35):
        # The cushion overlaps the seat a little, so that there is no gap.
        cushion_middle = (0.5, 0.0, seat_height + 1.4)
        cushion_size = (depth - 4.0, width - 4.0, 4.4)
        patches += shapes.make_rounded_box(
            "cushion", cushion_middle, cushion_size, bevel=2.1, steps=3, cells=2
        )
    return patches


def _chair_rungs(
    sampler: ParameterSampler, legs: _Legs, seat_height: float
) -> list[Patch]:
    """Create the rungs of a chair: one along each side, and one across between them.

    Args:
        sampler: samples their height.
        legs: the legs that they connect.
        seat_height: height of the upper side of the seat.
    """
    z = seat_height * sampler(0.36, low=0.25, high=0.6)
    # how far out the splayed legs are at that height
    spread = legs.splay * (1.0 - z / seat_height)
    x = legs.x + spread
    y = legs.y + spread
    side_radii = (0.55 * legs.radius, 0.55 * legs.radius)
    cross_radii = (0.5 * legs.radius, 0.5 * legs.radius)
    patches = list[Patch]()
    for side_y in (-1.0 * y, 1.0 * y):
        patches += _post(
            "along", (-x, side_y, z), (x, side_y, z), legs.section, side_radii
        )
    return patches + _post(
        "cross", (0.0, -y, z), (0.0, y, z), legs.section, cross_radii
    )


def _chair_paints(sampler: ParameterSampler, total_height: float) -> dict[str, Paint]:
    """Sample the paints of a chair by the tags of its parts.

    All wood is painted with one paint, or else shows its grain along each part.
    Cushions, and sometimes the seat, have a fabric.

    Args:
        sampler: samples the paints.
        total_height: height of the chair.
    """
    offset = sampler.sample_noise_offset()
    make_wood = _sample_chair_wood(sampler, total_height, offset)
    fabric = _sample_fabric(sampler, offset)
    seat_paint = fabric if sampler.sample_bool(0.25) else make_wood(0)
    return {
        "up": make_wood(2),
        "along": make_wood(0),
        "cross": make_wood(1),
        "seat": seat_paint,
        "cushion": fabric,
    }


def _sample_chair_wood(
    sampler: ParameterSampler, total_height: float, offset: Array
) -> Callable[[int], Paint]:
    """Sample the paint of wooden parts, as a function of the axis of their grain.

    The grain shows unless the wood is painted.

    Args:
        sampler: samples the colors.
        total_height: height of the chair.
        offset: (3,) into the noise.
    """
    timber = sampler.sample_color(
        "a86f3d", "c79a63", "6b4226", "3a2418", "d8bc92", p_random=0.0
    )
    paint_color = sampler.sample_color(
        "f0ede4", "2f5d7c", "b5442e", "3d6b4a", "22262b", "e0b040"
    )
    is_painted = sampler.sample_bool(0.4)
    wood_paint = choose_paint_or_random(
        sampler, total_height, paint_solid_color(paint_color), p_random=0.5
    )
    if is_painted:
        return lambda axis: wood_paint
    return lambda axis: wood(timber, scale=3.2, offset=offset, axis=axis, contrast=0.36)


def _sample_fabric(sampler: ParameterSampler, offset: Array) -> Paint:
    """Sample the paint of a fabric, with an offset (3,) into the noise."""
    color = sampler.sample_color("8a2f2a", "2f4f6f", "566b3f", "c9b48a", "4a4a4f")
    return sampler.sample_choice(
        paint_shaded_clouds(color, factor=0.8, scale=1.5, offset=offset),
        stripes(color, scale_brightness(color, 1.5), cell=6.0),
        checks(color, parse_hex_color("efe6d4"), cell=4.0),
        dots(paint_solid_color(color), parse_hex_color("f4efe4"), cell=6.0),
    )


class _ChairBack(NamedTuple):
    """The leaning plane between the posts of a chair's back.

    Attributes:
        bottom, top: heights of the seat, and of the top of the back.
        bottom_x: x at the height of the seat.
        lean: how far the top is behind (towards -x) `bottom_x`.
        width: width between the posts.
        board_thickness: thickness of the boards in it.
    """

    bottom: float
    top: float
    bottom_x: float
    lean: float
    width: float
    board_thickness: float

    @property
    def height(self) -> float:
        """The height of the back above the seat."""
        return self.top - self.bottom

    def x_at(self, z: float) -> float:
        """Return the x of the plane at a height."""
        return self.bottom_x - self.lean * (z - self.bottom) / (self.top - self.bottom)

    def make_board(
        self, tag: str, z: float, width: float, height: float, y: float = 0.0
    ) -> list[Patch]:
        """Create a board that leans with the back.

        Args:
            tag: tag of its paint.
            z, y: height and y of its middle.
            width, height: its size.
        """
        tilt = -float(np.degrees(np.arctan2(self.lean, self.height)))
        return shapes.transform_patches(
            shapes.make_rounded_box(
                tag, (0.0, 0.0, 0.0), (self.board_thickness, width, height), bevel=0.5
            ),
            shapes.make_rotation_matrix("y", tilt),
            (self.x_at(z), y, z),
        )


def _chair_back(
    sampler: ParameterSampler,
    legs: _Legs,
    seat_height: float,
    total_height: float,
    lean: float,
) -> list[Patch]:
    """Create the back of a chair: two posts, and what is between them.

    Args:
        sampler: samples the kind and its proportions.
        legs: legs that the posts continue upwards.
        seat_height: height of the upper side of the seat.
        total_height: height of the top of the back.
        lean: how far the top is behind the seat.
    """
    style = sampler.sample_choice("slats", "ladder", "panel", "arch")
    back = _ChairBack(
        bottom=seat_height,
        top=total_height,
        bottom_x=-legs.x,
        lean=lean,
        width=2 * (legs.y - 0.3 * legs.radius),
        board_thickness=sampler(1.6, low=1.2, high=2.4),
    )
    return _back_posts(back, legs) + _back_boards(sampler, style, back)


def _back_boards(
    sampler: ParameterSampler, style: str, back: _ChairBack
) -> list[Patch]:
    """Create what is between the posts of a chair's back.

    Args:
        sampler: samples the proportions.
        style: "slats" are vertical slats between two rails. "arch" has the upper rail
            only. "ladder" has horizontal bars, and "panel" one board.
        back: size and position of the back.
    """
    if style in ("slats", "arch"):
        return _slatted_back(sampler, back, has_lower_rail=style == "slats")
    if style == "ladder":
        return _ladder_back(sampler, back)
    return _panel_back(sampler, back)


def _back_posts(back: _ChairBack, legs: _Legs) -> list[Patch]:
    """Create the two posts of a chair's back, which begin inside the seat."""
    low_z = back.bottom - 2.0
    radii = (legs.radius, 0.85 * legs.radius)
    patches = list[Patch]()
    for y in (-1.0 * legs.y, 1.0 * legs.y):
        low = (back.x_at(low_z), y, low_z)
        high = (back.x_at(back.top), y, back.top)
        patches += _post("up", low, high, legs.section, radii)
    return patches


def _slatted_back(
    sampler: ParameterSampler, back: _ChairBack, *, has_lower_rail: bool
) -> list[Patch]:
    """Create vertical slats below a rail; without a lower rail they reach the seat.

    Args:
        sampler: samples how many slats there are, and their widths.
        back: size and position of the back.
        has_lower_rail: whether there is a rail below the slats.
    """
    patches = back.make_board(
        "cross", back.top - 0.09 * back.height, back.width, 0.14 * back.height
    )
    # 1 cm inside the seat, so that there is no gap
    low = back.bottom - 1.0
    if has_lower_rail:
        low = back.bottom + 0.22 * back.height
        patches += back.make_board(
            "cross", back.bottom + 0.2 * back.height, back.width, 0.09 * back.height
        )
    return patches + _back_slats(sampler, back, low)


def _back_slats(sampler: ParameterSampler, back: _ChairBack, low: float) -> list[Patch]:
    """Create the vertical slats of a back, from a height up to the upper rail."""
    high = back.top - 0.15 * back.height
    patches = list[Patch]()
    n_slats = int(sampler.sample_choice(5, 3, 4, 6))
    for i in range(n_slats):
        patches += back.make_board(
            "up",
            (low + high) / 2,
            back.width * sampler(0.075, low=0.05, high=0.11),
            high - low + 1.0,
            # at equal distances from each other and from both posts
            y=back.width * ((i + 1) / (n_slats + 1) - 0.5),
        )
    return patches


def _ladder_back(sampler: ParameterSampler, back: _ChairBack) -> list[Patch]:
    """Create two to four horizontal bars, evenly spaced up to the top."""
    patches = list[Patch]()
    n_bars = int(sampler.sample_choice(3, 2, 4))
    for i in range(n_bars):
        z = back.bottom + back.height * (0.28 + 0.66 * i / max(1, n_bars - 1))
        height = back.height * sampler(0.15, low=0.1, high=0.2)
        patches += back.make_board("cross", z, back.width, height)
    return patches


def _panel_back(sampler: ParameterSampler, back: _ChairBack) -> list[Patch]:
    """Create a single board, sometimes with the fabric of a cushion."""
    height = sampler(0.6, low=0.35, high=0.75) * back.height
    tag = "cushion" if sampler.sample_bool(0.3) else "up"
    z = back.top - height / 2 - 0.04 * back.height
    return back.make_board(tag, z, back.width, height)


class _ShadeSize(NamedTuple):
    """The size of a lampshade.

    Attributes:
        bottom, top: heights of its edges.
        height: height from edge to edge.
        bottom_radius, top_radius: radii of its edges.
    """

    bottom: float
    top: float
    height: float
    bottom_radius: float
    top_radius: float


def _shade(sampler: ParameterSampler, size: _ShadeSize) -> list[Patch]:
    """Create an open lampshade with a thin wall.

    Its profile is one closed loop: up the outside, over the rim, down the lining.

    Args:
        sampler: samples how much it bulges.
        size: the size of the shade.
    """
    wall = 0.25  # thickness
    outer = _shade_profile(sampler, size)
    # The inside is the outside, moved towards the axis and followed downwards.
    inner = (outer - np.array([wall, 0.0]))[::-1]
    pieces = [
        ("shade", shapes.subdivide(outer, longest=2.0)),
        ("rim", [outer[-1], inner[0]]),
        ("lining", inner),
        ("rim", [inner[-1], outer[0]]),
    ]
    return shapes.revolve_profile(pieces, columns=56)


def _shade_profile(sampler: ParameterSampler, size: _ShadeSize) -> Array:
    """Sample the profile (14, 2) of points (r, z) of a shade's outside, upwards."""
    bulge = sampler(0.0, low=-0.1, high=0.12) * size.bottom_radius
    middle_radius = (size.bottom_radius + size.top_radius) / 2 + bulge
    knots = [
        (size.bottom_radius, size.bottom),
        (middle_radius, (size.bottom + size.top) / 2),
        (size.top_radius, size.top),
    ]
    return shapes.sample_spline(knots, count=14)


def _lamp_base(
    sampler: ParameterSampler,
    style: str,
    height: float,
    foot_radius: float,
    stem_radius: float,
) -> list[Patch]:
    """Create the base of a lamp, from the table to the bulb.

    Args:
        sampler: samples its proportions.
        style: "disc" (a flat foot with a thin stem), "body" or "gourd" (a body with a
            waist).
        height: height of its top.
        foot_radius: radius of the foot.
        stem_radius: radius of the flat top.
    """
    if style == "disc":
        return _disc_base(sampler, height, foot_radius, stem_radius)
    return _body_base(
        sampler, height, foot_radius, stem_radius, has_waist=style == "gourd"
    )


def _disc_base(
    sampler: ParameterSampler, height: float, foot_radius: float, stem_radius: float
) -> list[Patch]:
    """Create a flat foot with a thin stem.

    Args:
        sampler: samples the thickness of the foot.
        height: height of the stem's end.
        foot_radius: radius of the foot.
        stem_radius: radius of the stem.
    """
    thickness = sampler(2.0, low=1.2, high=3.2)
    # profiles of points (r, z)
    under = [(0.0, 0.0), (foot_radius - 0.4, 0.0)]
    top = [(stem_radius, height), (0.0, height)]
    corners = [
        under[-1],
        (foot_radius, 0.4),
        (foot_radius * 0.96, thickness),
        (stem_radius * 2.0, thickness * 1.4),
        (stem_radius, thickness * 2.2),
        top[0],
    ]
    side = shapes.round_corners(corners, radius=[0.3, 0.5, 1.0, 1.2], steps=5)
    return shapes.revolve_profile(
        [
            ("base", under),
            ("base", shapes.subdivide(side, longest=1.6)),
            ("base", top),
        ],
        columns=44,
    )


def _body_base(
    sampler: ParameterSampler,
    height: float,
    foot_radius: float,
    stem_radius: float,
    *,
    has_waist: bool,
) -> list[Patch]:
    """Create the base of a lamp as a turned body on a foot ring.

    Args:
        sampler: samples radius and height of the belly.
        height: height of the stem's end.
        foot_radius: radius of the foot ring.
        stem_radius: radius of the stem at the top.
        has_waist: whether the body narrows above the belly and widens again, as a gourd
            does.
    """
    belly_knots = _sample_belly_knots(sampler, height, foot_radius, has_waist=has_waist)
    # profiles of points (r, z)
    under = [(0.0, 0.0), (foot_radius - 0.4, 0.0)]
    top = [(stem_radius, height), (0.0, height)]
    knots = [
        *belly_knots,
        (stem_radius * 1.5, 0.86 * height),
        (stem_radius, 0.93 * height),
    ]
    foot_corners = [under[-1], (foot_radius, 0.2), (foot_radius, 1.2), knots[0]]
    foot_ring = shapes.round_corners(foot_corners, radius=[0.15, 0.3], steps=3)
    pieces: list[tuple[str, Points]] = [
        ("base", under),
        ("foot", foot_ring),
        ("body", shapes.sample_spline(knots, count=34)),
        ("base", [knots[-1], top[0]]),
        ("base", top),
    ]
    return shapes.revolve_profile(pieces, columns=44)


def _sample_belly_knots(
    sampler: ParameterSampler, height: float, foot_radius: float, *, has_waist: bool
) -> list[tuple[float, float]]:
    """Sample points (r, z) of a turned body, from the foot over the belly upwards.

    Args:
        sampler: samples radius and height of the belly.
        height: height of the stem's end.
        foot_radius: radius of the foot ring.
        has_waist: whether it narrows above the belly and widens again.
    """
    belly = foot_radius * sampler(1.12, low=0.95, high=1.4)
    belly_height = sampler(0.38, low=0.28, high=0.6) * height
    above_belly = [(0.45 * belly, 0.72 * height)]
    if has_waist:
        above_belly = [(0.55 * belly, 0.6 * height), (0.72 * belly, 0.73 * height)]
    return [
        (foot_radius * 0.96, 1.2),
        (foot_radius * 0.8, 2.4),
        (belly, belly_height),
        *above_belly,
    ]


def _shade_paint(
    sampler: ParameterSampler,
    linen: Color,
    offset: Array,
    bottom: float,
    top: float,
) -> Paint:
    """Sample the paint of a lamp's shade: its cloth, patterned or with colored edges.

    Args:
        sampler: samples the pattern and the color of its second part.
        linen: color of the cloth.
        offset: (3,) into the noise.
        bottom, top: heights of the shade's edges.
    """
    cloth = paint_shaded_clouds(linen, factor=0.93, scale=1.2, offset=offset)
    pattern = sampler.sample_choice(
        "plain", "band", "stripes", "dots", "rings", "gradient"
    )
    accent = sampler.sample_color("b08d3c", "7a1f2b", "23395d", "efe6cf")
    if pattern == "plain":
        hem_color = scale_brightness(linen, 0.75)
        paint = _paint_edges(cloth, hem_color, 0.5, bottom, top)
    elif pattern == "band":
        paint = _paint_edges(cloth, accent, 1.4, bottom, top)
    elif pattern == "gradient":
        paint = gradient(linen, scale_brightness(linen, 0.6), low=bottom, high=top)
    else:
        paint = _sample_shade_pattern(sampler, pattern, linen, cloth, accent)
    return choose_paint_or_random(sampler, top, paint, p_random=0.3)


def _paint_edges(
    cloth: Paint, color: Color, width: float, bottom: float, top: float
) -> Paint:
    """Return the paint of a shade with both edges of another color.

    Args:
        cloth: paint of the shade.
        color: color of the edges.
        width: width of the edges.
        bottom, top: heights of the shade's edges.
    """
    edge_paint = paint_solid_color(color)
    lower_edge = paint_over(cloth, make_range_mask(0.0, bottom + width), edge_paint)
    return paint_over(lower_edge, make_range_mask(top - width, 2 * top), edge_paint)


def _sample_shade_pattern(
    sampler: ParameterSampler, pattern: str, linen: Color, cloth: Paint, accent: Color
) -> Paint:
    """Sample the proportions of a pattern of a lamp's shade.

    Args:
        sampler: samples the proportions.
        pattern: "stripes", "dots" or "rings".
        linen: color of the cloth.
        cloth: paint of the cloth.
        accent: color of the pattern.
    """
    if pattern == "stripes":
        cell = sampler(5.0, low=3.0, high=9.0)
        fraction = sampler(0.4, low=0.2, high=0.6)
        return stripes(linen, accent, cell=cell, fraction=fraction)
    if pattern == "dots":
        return dots(cloth, accent, cell=sampler(6.0, low=4.0, high=9.0))
    return rings(linen, accent, period=sampler(6.0, low=3.0, high=10.0))


@make_family(unit_in_metres=0.01)
def lamp(sampler: ParameterSampler) -> Instance:
    """Make a table lamp of random proportions, shade and base.

    Lengths are in centimeters. `sampler(x, low=..., high=...)` returns x for the
    canonical lamp and a uniform sample for a random one, and `sampler.sample_choice` the first
    choice or a random one.
    """
    size = _sample_shade_size(sampler)
    foot_radius = sampler(7.4, low=6.0, high=9.5)
    stem_radius = sampler(0.8, low=0.6, high=1.3)
    style = sampler.sample_choice("body", "disc", "gourd")  # style of the base
    # The base reaches into the shade, to just under the bulb.
    base_height = size.bottom + 0.25 * size.height
    patches = _lamp_base(sampler, style, base_height, foot_radius, stem_radius)
    patches += _shade(sampler, size)
    patches += _bulb(size)
    patches += _lamp_frame(size)
    return Instance(
        patches,
        _lamp_paints(sampler, size.bottom, size.top, style),
        sample_material(sampler, roughness=0.4, clearcoat=0.3),
        texel_density={"lining": 0.6},  # fewer texels: it is hardly visible
    )


def _sample_shade_size(sampler: ParameterSampler) -> _ShadeSize:
    """Sample the size of a lampshade, whose upper edge is the top of the lamp."""
    total_height = sampler(48.0, low=42.0, high=58.0)
    shade_height = sampler(20.0, low=14.0, high=24.0)
    bottom_radius = sampler(16.5, low=12.0, high=19.0)
    return _ShadeSize(
        bottom=total_height - shade_height,
        top=total_height,
        height=shade_height,
        bottom_radius=bottom_radius,
        top_radius=bottom_radius * sampler(0.6, low=0.35, high=1.0),
    )


def _bulb(size: _ShadeSize) -> list[Patch]:
    """Create the bulb inside of a shade."""
    return shapes.make_sphere_patches(
        "bulb",
        min(3.0, 0.4 * size.top_radius),
        center=(0.0, 0.0, size.bottom + 0.42 * size.height),
        rows=12,
        columns=20,
    )


def _lamp_frame(size: _ShadeSize) -> list[Patch]:
    """Create the rod of a lamp and the three spokes that hold its shade.

    Args:
        size: the size of the shade.
    """
    # The spokes are 12 % below the upper edge of the shade, and end at its wall.
    spoke_z = size.top - 0.12 * size.height
    spoke_length = size.top_radius + (size.bottom_radius - size.top_radius) * 0.12
    # from the bulb up to a small knob above the spokes
    rod_heights = (
        size.bottom + 0.2 * size.height,
        spoke_z,
        spoke_z + 0.8,
        spoke_z + 1.0,
    )
    rod = shapes.sweep_section(
        "base",
        [(0, 0, z) for z in rod_heights],
        shapes.ellipse(0.35, 0.35, count=10),
        (1.0, 1.0, 1.6, 0.0),
        start_axis=(1.0, 0.0, 0.0),
    )
    return _lamp_spokes(spoke_z, spoke_length) + rod


def _lamp_spokes(z: float, length: float) -> list[Patch]:
    """Create three spokes of a length at a height."""
    patches = list[Patch]()
    for angle in (20.0, 140.0, 260.0):
        spoke = shapes.sweep_section(
            "base",
            [(0.0, 0.0, z), (length, 0.0, z)],
            shapes.ellipse(0.22, 0.22, count=8),
        )
        patches += shapes.transform_patches(
            spoke, shapes.make_rotation_matrix("z", angle)
        )
    return patches


LINENS = ("f1e3c4", "f4f1e8", "c9b48a", "b5442e", "2f5d7c", "3d6b4a", "20242a")
"""Colors of lampshades."""


def _lamp_paints(
    sampler: ParameterSampler, shade_bottom: float, total_height: float, style: str
) -> dict[str, Paint]:
    """Sample the paints of a lamp by the tags of its parts.

    Args:
        sampler: samples the paints.
        shade_bottom: height of the lower edge of the shade.
        total_height: height of its upper edge.
        style: style of the base, as for `_lamp_base`.
    """
    offset = sampler.sample_noise_offset()
    linen = sampler.sample_color(*LINENS, p_random=0.25)
    cloth = _shade_paint(sampler, linen, offset, shade_bottom, total_height)
    body = _sample_body_paint(sampler, total_height, offset)
    metal = sampler.sample_color("b08d3c", "2b2d30", "b4b8bd", "8a5a32", p_random=0.15)
    # a flat foot may be painted as a body is
    is_base_painted = style == "disc" and sampler.sample_bool(0.5)
    return {
        "shade": cloth,
        "rim": paint_solid_color(scale_brightness(linen, 0.8)),
        "lining": paint_solid_color("f4f0e4"),
        "bulb": paint_solid_color("fbf6e6"),
        "body": body,
        "foot": paint_solid_color(metal),
        "base": body if is_base_painted else paint_solid_color(metal),
    }


def _sample_body_paint(
    sampler: ParameterSampler, total_height: float, offset: Array
) -> Paint:
    """Sample the paint of a lamp's turned body: clouds of a clay, or any other paint.

    Args:
        sampler: samples the paint.
        total_height: height of the lamp.
        offset: (3,) into the noise.
    """
    clay = sampler.sample_color(
        "2f6f6a", "23408f", "b5442e", "f2f1ea", "22262b", "8a5a32", "c9a24b"
    )
    clouds = paint_shaded_clouds(clay, factor=1.3, scale=4.0, offset=offset)
    return choose_paint_or_random(sampler, total_height, clouds, p_random=0.35)
