"""Teapot and frying pan: turned bodies with swept parts. Units are centimetres."""

from __future__ import annotations

import numpy as np

import advsearch.questions.harden.objects.shapes as shapes
from advsearch.questions.harden.objects.family import Instance, family, sample_material
from advsearch.questions.harden.objects.shapes import Array, Patch, Points
from advsearch.questions.harden.objects.textures import (
    Paint,
    ParameterSampler,
    Texels,
    between,
    clouded,
    dots,
    over,
    paint_or_random,
    rings,
    shade,
    solid,
    speckled,
    step,
    stripes,
    wood,
)


def _spout(sampler: ParameterSampler, radius: float, height: float) -> list[Patch]:
    """Create a spout along +x with an open, hollow end.

    One closed ring is swept along the path to the tip, then over the lip and back down
    the inside for a few points, where it shrinks to a point.

    Args:
        sampler: samples its proportions.
        radius, height: radius and height of the teapot's body.
    """
    path = _spout_path(sampler, radius, height)
    root_radius = sampler(1.75, low=1.3, high=2.2)
    tip_radius = sampler(0.72, low=0.55, high=0.95)
    scale = (
        tip_radius
        + (root_radius - tip_radius) * (1.0 - np.linspace(0.0, 1.0, 18)) ** 1.3
    )
    tangent, first, second = shapes.compute_frames(path, (0.0, 1.0, 0.0))
    # points of the path that the rings are at: over the lip at the tip (the last point
    # several times) and back down inside
    ring_index = np.array([*range(18), 17, 17, 17, 16, 15, 14, 13])
    inner_radii = scale[[17, 16, 15, 14, 13]] - 0.24  # less the thickness of the wall
    radii = np.concatenate(
        [
            scale,
            [
                tip_radius - 0.06,
                tip_radius - 0.12,
                inner_radii[0],
                inner_radii[1],
                inner_radii[2],
                inner_radii[3],
                0.0,
            ],
        ]
    )
    # the rings of the lip lie a little ahead of the tip, so that it is round
    ahead = np.zeros(len(ring_index))
    ahead[18:21] = (0.1, 0.12, 0.06)
    frame = (tangent[ring_index], first[ring_index], second[ring_index])
    return shapes.sweep(
        "spout",
        path[ring_index] + ahead[:, None] * tangent[ring_index],
        shapes.ellipse(1.0, 1.0, count=20),
        radii,
        frame=frame,
    )


def _spout_path(sampler: ParameterSampler, radius: float, height: float) -> Array:
    """Sample the path (18, 3) of a spout in the x-z plane, from the body to the tip.

    A curved one has the shape of an S: it bulges out and downwards in its lower half,
        and is bent back a little before the tip.

    Args:
        sampler: samples its style and its ends.
        radius, height: radius and height of the teapot's body.
    """
    style = sampler.pick("curved", "straight")
    start = np.array([radius * 0.72, 0.0, height * sampler(0.34, low=0.26, high=0.42)])
    tip = np.array(
        [
            radius * sampler(1.85, low=1.6, high=2.0),
            0.0,
            height * sampler(0.94, low=0.8, high=1.02),
        ]
    )
    # how far it departs from a straight line, as a fraction of the radius
    bend = 0.22 if style == "curved" else 0.04
    middle = (start + tip) / 2 + np.array([bend, 0.0, -0.6 * bend]) * radius * 0.5
    above = (
        start + (tip - start) * 0.8 + np.array([-bend * 0.1, 0.0, -0.1 * bend]) * radius
    )
    return shapes.spline([start, middle, above, tip], count=18)


@family(metres=0.01)
def teapot(sampler: ParameterSampler) -> Instance:
    """Make a teapot with spout, handle and lid of random proportions."""
    radius = sampler(7.2, low=6.4, high=8.0)
    height = sampler(10.2, low=8.0, high=12.5)
    side, body = _teapot_body(sampler, radius, height)
    grip = _teapot_handle(sampler, side, radius, height)
    patches = [
        *body,
        *_spout(sampler, radius, height),
        *shapes.transform_patches(grip, shapes.rotation("z", 180.0)),
    ]
    patches = shapes.transform_patches(patches, shapes.rotation("z", 118.0))
    paints = _teapot_paints(sampler, height)
    return Instance(
        patches,
        paints,
        sample_material(sampler, roughness=0.25, clearcoat=0.7),
        detail={"base": 0.6},
    )


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
    foot = radius * sampler(0.58, low=0.5, high=0.75)
    mouth = radius * sampler(0.48, low=0.42, high=0.6)
    # a fraction of the height, and of the radius halfway up to the belly
    belly_height = sampler(0.45, low=0.35, high=0.58)
    fullness = sampler(0.9, low=0.82, high=0.97)
    knots = [
        (foot, 0.5),
        (radius * fullness, 0.5 * belly_height * height),
        (radius, belly_height * height),
        (radius * (0.97 * fullness), (0.42 * belly_height + 0.58) * height),
        (mouth, height),
    ]
    side = shapes.spline(knots, count=26)
    dome = sampler(1.5, low=0.7, high=2.4)
    knob_radius = sampler(1.0, low=0.7, high=1.4)
    top = height + dome + 0.2  # of the lid
    # over the edge of the mouth, with a narrow groove where the lid begins
    rim = [
        (mouth, height),
        (mouth * 0.97, height + 0.02),
        (mouth * 0.94, height - 0.12),
        (mouth * 0.94, height + 0.05),
        (mouth * 0.97, height + 0.05),
    ]
    lid = shapes.spline(
        [
            rim[-1],
            (mouth * 0.9, height + 0.35),
            (mouth * 0.55, height + 0.75 * dome + 0.2),
            (0.35, top),
        ],
        count=10,
    )
    knob = shapes.spline(
        [
            (0.45, top),
            (0.5, top + 0.3),
            (knob_radius, top + 0.45 + knob_radius * 0.6),
            (0.7 * knob_radius, top + 0.45 + 1.35 * knob_radius),
            (0.0, top + 0.45 + 1.6 * knob_radius),
        ],
        count=12,
    )
    profile: list[tuple[str, Points]] = [
        (
            "base",
            [(0.0, 0.2), (foot * 0.8, 0.2), (foot * 0.86, 0.0), (foot * 0.97, 0.0)],
        ),
        ("body", [(foot * 0.97, 0.0), *side]),
        ("body", rim),
        ("lid", lid),
        ("knob", [lid[-1], *knob]),
    ]
    return side, shapes.lathe(profile, columns=56)


def _teapot_handle(
    sampler: ParameterSampler, side: Array, radius: float, height: float
) -> list[Patch]:
    """Create the handle in the x-z plane, on the +x side of the body.

    Args:
        sampler: samples its curve and its section.
        side: profile (K, 2) of the body.
        radius, height: radius and height of the body.
    """
    span = sampler(0.9, low=0.75, high=1.0)
    high = height * 0.84
    low = height * (0.84 - 0.62 * span)
    # both ends lie a little inside the wall
    top_root, low_root = (shapes.radius_at_height(side, z) - 0.25 for z in (high, low))
    reach = radius * sampler(0.72, low=0.5, high=0.9)
    lift = sampler(0.05, low=-0.02, high=0.2) * height
    knots = [
        (top_root, high),
        (radius + 0.35 * reach, high + lift),
        (radius + 0.9 * reach, high - 0.1 * (high - low)),
        (radius + sampler(0.95, low=0.7, high=1.0) * reach, 0.5 * (high + low)),
        (radius + 0.4 * reach, low + 0.08 * (high - low)),
        (low_root, low),
    ]
    section = shapes.ellipse(
        sampler(0.5, low=0.4, high=0.7), sampler(0.62, low=0.45, high=0.85), count=16
    )
    return shapes.sweep(
        "handle",
        shapes.to_xz_plane(shapes.spline(knots, count=26)),
        section,
        1.0 + 0.2 * np.abs(np.linspace(-1, 1, 26)) ** 3,  # thicker at both ends
    )


def _teapot_paints(sampler: ParameterSampler, height: float) -> dict[str, Paint]:
    """Sample the paints of a teapot of a height, by the tags of its parts."""
    offset = sampler.offset()
    clay = sampler.sample_color(
        "7b2d26", "f2eee4", "2f5d7c", "3d5c47", "22262b", "c98a3a", "e7b9b0"
    )
    glaze = clouded(clay, factor=1.25, scale=3.5, offset=offset, contrast=1.6)
    second = sampler.sample_color("e8cfa0", "23408f", "c9a24b", "f4efe4", "b5442e")
    kind = sampler.pick("bands", "plain", "dots", "stripes", "rings", "speckle")
    if kind == "bands":
        paint = over(
            glaze, between(0.7 * height, 0.74 * height, soft=0.1), solid(second)
        )
        paint = over(
            paint, between(0.77 * height, 0.785 * height, soft=0.1), solid(second)
        )
    elif kind == "dots":
        paint = dots(
            glaze,
            second,
            cell=sampler(2.6, low=1.6, high=4.0),
            radius=sampler(0.28, low=0.18, high=0.4),
        )
    elif kind == "stripes":
        paint = stripes(
            clay,
            second,
            cell=sampler(3.0, low=1.5, high=5.0),
            share=sampler(0.4, low=0.2, high=0.6),
        )
    elif kind == "rings":
        paint = rings(clay, second, period=sampler(2.0, low=1.0, high=4.0))
    elif kind == "speckle":
        paint = speckled(glaze, second, scale=0.5, offset=offset)
    else:
        paint = glaze
    paint = paint_or_random(sampler, height + 4.0, paint)
    trim = sampler.pick(glaze, solid(second), paint)
    return {
        "base": solid("a98663"),
        "body": paint,
        "lid": sampler.pick(paint, trim),
        "spout": sampler.pick(glaze, paint),
        "handle": sampler.pick(glaze, trim),
        "knob": solid(second) if sampler.chance(0.5, canonical=True) else trim,
    }


@family(metres=0.01)
def frying_pan(sampler: ParameterSampler) -> Instance:
    """Make a frying pan with a random handle."""
    base = sampler(10.5, low=9.0, high=11.5)
    rim = sampler(13.0, low=12.2, high=14.5)
    depth = sampler(4.2, low=2.8, high=5.5)
    wall = sampler(0.38, low=0.3, high=0.55)
    side = shapes.spline(
        [
            (base - 0.8, 0.0),
            (base, 0.25),
            (base + 0.55 * (rim - base), 0.5 * depth),
            (rim, depth),
        ],
        count=14,
    )
    body = shapes.vessel(side, wall=wall, floor=0.5, columns=64, step=1.6)

    length = sampler(18.0, low=14.0, high=21.0)
    root = np.array([rim - 0.6, 0.0, 0.78 * depth])
    rise = sampler(2.6, low=0.6, high=4.5)
    grip = _pan_handle(sampler, root, length, rise)
    rivets = _wall_rivets(side, depth, wall)
    bracket = _pan_bracket(rim, depth, length, rise)
    patches = shapes.transform_patches(
        [*body, *grip, *rivets, *bracket], shapes.rotation("z", 118.0)
    )
    paints = _pan_paints(sampler, rim, depth)
    return Instance(
        patches,
        paints,
        sample_material(sampler, roughness=0.38, clearcoat=0.3),
        detail={"base": 0.5},
    )


def _wall_rivets(side: Array, depth: float, wall: float) -> list[Patch]:
    """Create the rivets on the inside of a pan's wall."""
    inner_radius = shapes.radius_at_height(side, 0.72 * depth) - wall
    return _pan_rivets(inner_radius, 0.72 * depth)


def _pan_bracket(rim: float, depth: float, length: float, rise: float) -> list[Patch]:
    """Create the bracket that holds the handle of a pan: a flat bar through the wall.

    Args:
        rim: radius of the pan's rim.
        depth: depth of the pan.
        length, rise: length and rise of the handle.
    """
    spine = [
        (rim - 1.4, 0.72 * depth),
        (rim - 0.3, 0.75 * depth),
        (rim + 0.2 * length, 0.78 * depth + 0.5 * rise),
    ]
    return shapes.sweep(
        "bracket",
        shapes.to_xz_plane(np.array(spine)),
        shapes.rectangle(0.7, 3.0, bevel=0.25),
        (1.0, 1.0, 0.62),
        caps=True,
    )


def _pan_handle(
    sampler: ParameterSampler, root: Array, length: float, rise: float
) -> list[Patch]:
    """Create a handle along +x, which rises and has a round end.

    Its section is scaled along the path: it is narrow at the root and has its full
        width after a third.

    Args:
        sampler: samples its curve and its section.
        root: where it begins (3,).
        length: along x.
        rise: by how much it is higher at its end, about.
    """
    knots = [
        (0.0, 0.0),
        (0.22 * length, 0.55 * rise),
        (0.6 * length, rise),
        (length, rise * sampler(1.05, low=0.8, high=1.2)),
    ]
    path = shapes.spline(root + shapes.to_xz_plane(np.array(knots)), count=26)
    t = np.linspace(0.0, 1.0, 26)  # from the root to the end
    width = sampler(1.15, low=0.85, high=1.5)
    thick = sampler(0.62, low=0.45, high=0.9)
    shape = (0.62 + 0.38 * np.clip(t / 0.35, 0.0, 1.0) ** 1.5) * (
        1.0 + sampler(0.12, low=0.0, high=0.25) * np.sin(np.pi * t)
    )
    # a quarter of an ellipse over the last 6 %
    round_end = np.sqrt(
        np.clip(1.0 - ((t - 0.94) / 0.06).clip(0.0, 1.0) ** 2, 0.0, 1.0)
    )
    thickness = thick * (0.7 + 0.3 * np.clip(t / 0.3, 0.0, 1.0))
    scale = np.stack([thickness, width * shape], axis=1) * round_end[:, None]
    if sampler.chance(0.5, canonical=True):
        section = shapes.ellipse(1.0, 1.0, count=20)
    else:
        section = shapes.rectangle(2.0, 2.0, bevel=0.7)
    return shapes.sweep("handle", path, section, scale)


def _pan_rivets(radius: float, height: float) -> list[Patch]:
    """Create the two rivets of the bracket on the inside of a pan."""
    center = (radius + 0.02, 0.0, height)
    rivet = shapes.sphere("rivet", 0.38, centre=center, rows=8, columns=12)
    left = shapes.transform_patches(rivet, offset=(0.0, -1.1, 0.0))
    right = shapes.transform_patches(rivet, offset=(0.0, 1.1, 0.0))
    return left + right


def _pan_paints(
    sampler: ParameterSampler, rim: float, depth: float
) -> dict[str, Paint]:
    """Sample the paints of a pan, by the tags of its parts.

    Args:
        sampler: samples the paints.
        rim: radius of its rim.
        depth: height of its rim.
    """
    offset = sampler.offset()
    coat = sampler.sample_color(
        "2b2c2e", "3a3a3c", "1c1d1f", "8c8f94", "5c4033", wild=0.2
    )

    def turned(t: Texels) -> Array:
        """Return the mask of faint rings, as turning leaves."""
        return (
            step(
                np.sin(2 * np.pi * np.hypot(t.xyz[:, 0], t.xyz[:, 1]) / 0.9),
                0.6,
                soft=0.8,
            )
            * 0.35
        )

    inside = speckled(
        clouded(coat, factor=1.2, scale=5.0, offset=offset),
        shade(coat, 1.7),
        scale=0.5,
        offset=offset,
        amount=0.06,
    )
    if sampler.chance(0.4, canonical=True):
        inside = over(inside, turned, solid(shade(coat, 1.6)))
    outer = sampler.sample_color(
        "a9231f", "2b2c2e", "9a9da1", "2f5d7c", "3d6b4a", "d9822b"
    )
    # darker towards the bottom, with a dark line at the rim
    enamel = clouded(outer, factor=0.85, scale=5.0, offset=offset)
    enamel = over(
        enamel, between(-1.0, 0.25 * depth, soft=0.6 * depth), solid(shade(outer, 0.6))
    )
    enamel = over(enamel, between(depth - 0.1, 2 * depth, soft=0.15), solid("2b2c2e"))
    outside = paint_or_random(sampler, 2 * rim, enamel, wild=0.3)
    inside = paint_or_random(sampler, 2 * rim, inside, wild=0.2)
    style = sampler.pick("black", "wood", "wild")
    handle_paints = {
        "black": solid(sampler.sample_color("1b1b1d", "2a2a2c", wild=0.1)),
        "wood": wood(
            sampler.sample_color("8a5a32", "b98550", wild=0.0),
            scale=1.4,
            offset=offset,
            axis=0,
        ),
        "wild": solid(sampler.sample_color("a9231f")),
    }
    steel = solid(sampler.sample_color("b9bcc0", "8c8f94", wild=0.1))
    paints = {
        "outside": outside,
        "inside": inside,
        "handle": handle_paints[style],
        "rivet": steel,
        "bracket": steel,
    }
    paints["base"] = solid(sampler.sample_color("77797c", "2b2c2e"))
    return paints
