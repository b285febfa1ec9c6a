"""Hammer and dumbbell. Units are centimetres."""

from __future__ import annotations

import numpy as np

import advsearch.questions.harden.objects.shapes as shapes
from advsearch.questions.harden.objects.family import Instance, family, sample_material
from advsearch.questions.harden.objects.shapes import Array, Patch
from advsearch.questions.harden.objects.textures import (
    Paint,
    ParameterSampler,
    Texels,
    band_mask,
    between,
    clouded,
    over,
    paint_or_random,
    rings,
    shade,
    solid,
    speckled,
    step,
    wood,
)


def _claw(
    sampler: ParameterSampler, half: float, start: float, length: float, drop: float
) -> list[Patch]:
    """Create two tapering prongs that curve downwards (towards -x) from the head.

    Args:
        sampler: samples how far they spread.
        half: half the width of the head.
        start: y of their roots.
        length: along +y.
        drop: by how much their tips are lower than their roots.
    """
    spread = sampler(0.34, low=0.2, high=0.5)
    t = np.linspace(0.0, 1.0, 14)  # from the root to the tip
    half_thickness = half * (0.72 * (1 - t) + 0.1)
    half_width = half * 0.47 * (1.0 - 0.25 * t)
    scale = np.stack([half_thickness, half_width], axis=1)
    section = shapes.rectangle(2.0, 2.0, bevel=0.5, steps=2)
    patches = []
    for side in (-1.0, 1.0):
        x = 0.25 * half - drop * t**1.8
        y = start + length * (t - 0.1 * t**2)
        z = side * half * (0.5 + spread * t)
        curve = np.stack([x, y, z], axis=1)
        patches += shapes.sweep(
            "head", curve, section, scale, first=(1.0, 0.0, 0.0), caps=True
        )
    return patches


def _points_on_y(*positions: float) -> Array:
    """Return points (K, 3) on the y axis."""
    return np.array([(0.0, y, 0.0) for y in positions])


def _peen(
    sampler: ParameterSampler, half: float, start: float, length: float
) -> list[Patch]:
    """Create a wedge (cross peen) or a ball at the back of the head, along +y.

    Args:
        sampler: chooses between both.
        half: half the width of the head.
        start: y of its root.
        length: along +y.
    """
    if sampler.chance(0.5):
        neck = _points_on_y(start - 0.3, start + 0.5 * length)
        center = (0.0, start + 0.75 * length, 0.0)
        stem = shapes.sweep(
            "head", neck, shapes.ellipse(1, 1, count=20), np.array([0.75, 0.6]) * half
        )
        return stem + shapes.sphere(
            "head", 0.95 * half, centre=center, rows=16, columns=24
        )
    path = _points_on_y(
        start, start + 0.3 * length, start + 0.9 * length, start + length
    )
    scale = np.array([[0.95, 0.95], [0.85, 0.95], [0.22, 0.9], [0.12, 0.85]]) * half
    return shapes.sweep(
        "head",
        path,
        shapes.rectangle(2.0, 2.0, bevel=0.4),
        scale,
        first=(1.0, 0.0, 0.0),
        caps=True,
    )


@family(metres=0.01)
def hammer(sampler: ParameterSampler) -> Instance:
    """Make a hammer whose handle runs along -x, and whose head lies along y.

    The head is at the origin, and its striking face at -y.
    """
    half = sampler(1.35, low=1.15, high=1.7)
    length = sampler(27.0, low=20.0, high=31.0)
    front = sampler(5.0, low=3.8, high=6.0)
    face = half * sampler(1.1, low=1.0, high=1.35)
    style = sampler.pick("claw", "claw", "peen", "sledge")
    eye = half * sampler(1.25, low=1.1, high=1.5)
    front = max(front, 2.2 * eye)

    head = _hammer_head(
        sampler, half=half, eye=eye, style=style, front=front, face=face
    )

    swelling, half_thickness, handle = _hammer_handle(sampler, half, length)

    # It lies on the head and on the swelling of the handle.
    head_height = max(half * 1.05, face * 1.2 if style == "sledge" else face)
    tilt = np.degrees(
        np.arctan2(head_height - half_thickness * (1.0 + swelling), 0.8 * length)
    )
    patches = shapes.transform_patches(
        shapes.transform_patches([*head, *handle], shapes.rotation("y", -float(tilt))),
        shapes.rotation("z", sampler(58.0, low=20.0, high=90.0)),
    )

    paints = _hammer_paints(sampler, front, length)
    return Instance(
        patches, paints, sample_material(sampler, roughness=0.38, clearcoat=0.2)
    )


def _hammer_head(
    sampler: ParameterSampler,
    half: float,
    eye: float,
    style: str,
    front: float,
    face: float,
) -> list[Patch]:
    """Create the head of a hammer of a style.

    Around the eye, through which the handle goes, is a block. A sledge's head is one
    block instead; other heads have a neck and a face in front, and a claw or a peen
    behind.

    Args:
        sampler: samples the shape of the block, the claw or the peen.
        half: half the width of the block around the eye.
        eye: half its length, about.
        style: "claw", "peen" or "sledge".
        front: length from the eye to the striking face.
        face: radius of the face.
    """
    scale = np.array([[0.82, 0.82], [1, 1], [1, 1], [0.86, 0.86]]) * half * 1.05
    path = _points_on_y(-eye * 1.1, -eye * 0.9, eye * 0.9, eye * 1.15)
    head = shapes.sweep(
        "head",
        path,
        shapes.rectangle(2.0, 2.0, bevel=0.45),
        scale,
        first=(1.0, 0.0, 0.0),
        caps=True,
    )
    if style == "sledge":
        path = _points_on_y(-front, -front + 0.3, front - 0.3, front)
        section = (
            shapes.polygon(8, bevel=0.1)
            if sampler.chance(0.5)
            else shapes.rectangle(1.8, 1.8, bevel=0.4)
        )
        scale = np.array([0.85, 1.0, 1.0, 0.85]) * face * 1.25
        head = shapes.sweep(
            "head", path, section, scale, first=(1.0, 0.0, 0.0), caps=True
        )
    else:
        path = _points_on_y(
            -eye * 0.9,
            -eye * 1.2,
            -0.62 * front,
            -0.7 * front,
            -0.74 * front,
            -front + 0.25,
            -front,
        )
        scale = np.array([0.85, 0.75, 0.72, 0.85, 1.0, 1.0, 0.88]) * np.array(
            [half] * 3 + [face] * 4
        )
        head += shapes.sweep(
            "head",
            path,
            shapes.ellipse(1.0, 1.0, count=28),
            scale,
            first=(1.0, 0.0, 0.0),
            caps=True,
        )
        if style == "claw":
            head += _claw(
                sampler,
                half=half,
                start=eye * 0.95,
                length=sampler(6.4, low=5.0, high=7.5),
                drop=sampler(2.6, low=1.2, high=3.6),
            )
        else:
            head += _peen(sampler, half, eye, sampler(4.0, low=3.0, high=5.0))
    return head


def _hammer_handle(
    sampler: ParameterSampler, half: float, length: float
) -> tuple[float, float, list[Patch]]:
    """Create the handle of a hammer, from the head along -x.

    It swells near its end, where it is held, is thinner in the middle, and its end is
    rounded.

    Args:
        sampler: samples its thickness and its section, an ellipse or a rounded square.
        half: half the width of the head.
        length: length from the head to the end.

    Returns:
        By what fraction it swells, half its thickness, and its patches.
    """
    t = np.linspace(0.0, 1.0, 30)  # from the head to the end
    swelling = sampler(0.16, low=0.0, high=0.3)
    swell = (
        1.0
        + swelling * np.exp(-(((t - 0.78) / 0.14) ** 2))
        - 0.5 * swelling * np.exp(-(((t - 0.45) / 0.2) ** 2))
    )
    # A quarter of an ellipse over the last twentieth. With 0.999 it does not close by
    # itself; the last scale, which is set to 0, closes the surface.
    end_fraction = ((t - 0.95) / 0.05).clip(0.0, 1.0)
    round_end = np.sqrt(np.clip(1.0 - end_fraction**2 * 0.999, 0.0, 1.0))
    round_end[-1] = 0.0
    half_thickness = half * sampler(0.72, low=0.6, high=0.9)
    half_width = half * sampler(0.92, low=0.75, high=1.1)
    top = half * 1.18  # x of the end that sticks out of the head
    path = np.stack([top - (length + top) * t, 0 * t, 0 * t], axis=1)
    scale = np.stack(
        [half_width * swell * round_end, half_thickness * swell * round_end], axis=1
    )
    scale[0] *= 0.9  # a bevel at the head
    if sampler.chance(0.6, canonical=True):
        section = shapes.ellipse(1.0, 1.0, count=24)
    else:
        section = shapes.rectangle(2.0, 2.0, bevel=0.7)
    handle = shapes.sweep("handle", path, section, scale, first=(0.0, 1.0, 0.0))
    return swelling, half_thickness, handle


def _hammer_paints(
    sampler: ParameterSampler, front: float, length: float
) -> dict[str, Paint]:
    """Sample the paints of the head and the handle of a hammer.

    The striking face is bright metal. A handle is of wood, dipped in color at its end,
    or has a ribbed rubber grip.

    Args:
        sampler: samples the paints.
        front: distance of the striking face from the middle of the head, at -y.
        length: length of the handle, along -x.
    """
    offset = sampler.offset()
    steel = sampler.sample_color("4b4f55", "8d9298", "2b2d30", "6b7078", wild=0.15)
    metal = over(
        clouded(steel, factor=0.8, scale=1.6, offset=offset, contrast=2.4),
        lambda t: step(-t.xyz[:, 1], 0.86 * front, soft=0.3),
        solid(shade(steel, 1.7)),
    )
    timber = wood(
        sampler.sample_color("c48f55", "a8743f", "d9b27c", "7a4f2a", wild=0.05),
        scale=0.9,
        offset=offset,
        axis=0,
    )
    stain = sampler.sample_color("8f2e22", "1f4e79", "d9a02b", "2d2d33", "3d6b4a")
    kind = sampler.pick("wood", "dipped", "rubber")
    hold = timber
    if kind == "dipped":
        hold = over(
            timber,
            between(
                -2 * length,
                -sampler(0.5, low=0.4, high=0.7) * length,
                axis=0,
                soft=0.05,
            ),
            solid(stain),
        )
    elif kind == "rubber":
        ribs = rings(stain, shade(stain, 0.7), period=1.1, share=0.2, axis=0)
        hold = over(
            solid(shade(stain, 0.5)),
            between(-2 * length, -0.45 * length, axis=0, soft=0.05),
            ribs,
        )
    return {
        "head": paint_or_random(sampler, length, metal, wild=0.3),
        "handle": paint_or_random(sampler, length, hold, wild=0.3),
    }


def _weights(
    sampler: ParameterSampler, style: str, at: float, length: float, radius: float
) -> list[Patch]:
    """Create the weight at the upper end of a dumbbell whose bar is along z.

    Args:
        sampler: chooses the nut of "plates".
        style: "hex", "globe", "plates" (three, each smaller, and a nut) or "round".
        at: z of its inner side.
        length: along z, but for a globe, which is as long as it is thick.
        radius: radius of the weight.
    """
    if style == "hex":
        path = [
            (0, 0, at),
            (0, 0, at + 0.12 * length),
            (0, 0, at + 0.85 * length),
            (0, 0, at + length),
        ]
        scale = np.array([0.86, 1.0, 1.0, 0.8]) * radius
        return shapes.sweep(
            "weight",
            path,
            shapes.polygon(6, bevel=0.14, steps=3),
            scale,
            first=(0.0, 1.0, 0.0),
            caps=True,
        )
    if style == "globe":
        return shapes.sphere(
            "weight", radius * 0.95, centre=(0.0, 0.0, at + 0.8 * radius)
        )
    n_plates = 3 if style == "plates" else 1
    patches = []
    z = at
    for i in range(n_plates):
        thickness = length / n_plates * 0.94  # the rest is a gap
        plate_radius = radius * (1.0 - 0.17 * i)
        hub_radius = 0.55 * plate_radius  # of the flat middle of both sides
        bevel = min(0.25 * thickness, 0.6)
        side = shapes.round_corners(
            [
                (hub_radius, z),
                (plate_radius, z),
                (plate_radius, z + thickness),
                (hub_radius, z + thickness),
            ],
            radius=bevel,
            steps=4,
        )
        under = [(0.0, z), (hub_radius, z)]
        top = [(hub_radius, z + thickness), (0.0, z + thickness)]
        patches += shapes.lathe(
            [
                ("weight", under),
                ("weight", shapes.subdivide(side, longest=1.2)),
                ("weight", top),
            ],
            columns=44,
        )
        z += length / n_plates
    if style == "plates":
        nut = shapes.ellipse(1.0, 1.0, count=24)
        if sampler.chance(0.5):
            nut = shapes.polygon(6, bevel=0.1)
        path = [(0, 0, z - 0.1), (0, 0, z + 0.6), (0, 0, z + 0.75)]
        scale = np.array([1.0, 1.0, 0.85]) * 0.42 * radius
        patches += shapes.sweep(
            "bar", path, nut, scale, first=(0.0, 1.0, 0.0), caps=True
        )
    return patches


@family(metres=0.01)
def dumbbell(sampler: ParameterSampler) -> Instance:
    """Make a dumbbell with weights of random shape."""
    style = sampler.pick("hex", "plates", "hex", "round", "globe")
    radius = sampler(4.6, low=3.6, high=6.2)
    grip = sampler(5.6, low=5.0, high=7.0)
    length = sampler(5.6, low=3.8, high=7.0)
    bar = sampler(1.45, low=1.2, high=1.9)
    swell = sampler(0.16, low=0.0, high=0.3)
    z = np.linspace(-grip - 0.6, grip + 0.6, 25)
    profile = np.stack(
        [bar * (1.0 + swell * np.cos(np.pi * z / (2 * grip + 1.2)) ** 2), z], axis=1
    )
    weights = _weights(sampler, style=style, at=grip, length=length, radius=radius)
    patches = (
        shapes.lathe([("bar", profile)], columns=28)
        + weights
        + shapes.transform_patches(weights, shapes.rotation("y", 180.0))
    )
    laid = shapes.transform_patches(
        shapes.transform_patches(patches, shapes.rotation("y", 90.0)),
        shapes.rotation("z", sampler(118.0, low=90.0, high=150.0)),
    )
    paints = _dumbbell_paints(
        sampler, grip=grip, style=style, length=length, radius=radius
    )
    return Instance(
        laid, paints, sample_material(sampler, roughness=0.42, clearcoat=0.2)
    )


def _dumbbell_paints(
    sampler: ParameterSampler, grip: float, style: str, length: float, radius: float
) -> dict[str, Paint]:
    """Sample the paints of a dumbbell: of its weights, and of its knurled bar.

    The dumbbell is painted before it is laid down, so that its bar is along z.

    Args:
        sampler: samples the paints.
        grip: half the length of the bar between the weights.
        style: style of the weights, as for `_weights`.
        length, radius: length and radius of the weights.
    """
    offset = sampler.offset()
    iron = sampler.sample_color(
        "26282b", "3a3d42", "8a8d92", "7a2f8f", "2f6f8f", "c23b4a", wild=0.25
    )
    weight = speckled(
        clouded(iron, factor=1.25, scale=2.5, offset=offset),
        shade(iron, 1.9),
        scale=0.35,
        offset=offset,
        amount=sampler(0.08, low=0.0, high=0.2),
    )
    # z of the outer side of a weight
    tip = grip + (length if style != "globe" else 1.75 * radius)
    accent = sampler.sample_color("c9ccd0", "f2f2f0", "d9a02b", "c23b4a")
    if sampler.chance(0.5, canonical=True):

        def on_both_ends(t: Texels) -> Array:
            """Return the mask of a ring on the outer side of each weight."""
            ring = band_mask(
                np.hypot(t.xyz[:, 0], t.xyz[:, 1]),
                0.34 * radius,
                0.44 * radius,
                soft=0.12,
            )
            return step(np.abs(t.xyz[:, 2]), tip - 0.6, soft=0.05) * ring

        weight = over(weight, on_both_ends, solid(accent))
    steel = sampler.sample_color("b4b8bd", "8d9298", "2b2d30", wild=0.2)
    # fine slanted lines on the part that is held
    knurl = over(
        solid(steel),
        lambda t: (
            (
                step(np.sin(90 * t.u + 60 * t.v), 0.3, soft=0.6)
                * between(-0.75 * grip, 0.75 * grip)(t)
            )
            * 0.6
        ),
        solid(shade(steel, 0.55)),
    )
    return {
        "weight": paint_or_random(sampler, 2 * tip, weight, wild=0.35),
        "bar": knurl,
    }
