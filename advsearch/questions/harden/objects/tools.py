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
    draw: ParameterSampler, half: float, start: float, length: float, drop: float
) -> list[Patch]:
    """Two tapering prongs that curve downwards (towards -x) from the head, along +y."""
    spread = draw(0.34, 0.2, 0.5)
    t = np.linspace(0.0, 1.0, 14)
    thick = half * (0.72 * (1 - t) + 0.1)
    broad = half * 0.47 * (1.0 - 0.25 * t)
    scale = np.stack([thick, broad], axis=1)
    section = shapes.rectangle(2.0, 2.0, 0.5, 2)
    patches = []
    for side in (-1.0, 1.0):
        down = 0.25 * half - drop * t**1.8
        along = start + length * (t - 0.1 * t**2)
        curve = np.stack([down, along, side * half * (0.5 + spread * t)], axis=1)
        patches += shapes.sweep(
            "head", curve, section, scale, first=(1.0, 0.0, 0.0), caps=True
        )
    return patches


def _along_y(*positions: float) -> Array:
    """Return points (K, 3) on the y axis."""
    return np.array([(0.0, y, 0.0) for y in positions])


def _peen(
    draw: ParameterSampler, half: float, start: float, length: float
) -> list[Patch]:
    """A wedge (cross peen) or a ball at the back of the head, along +y."""
    if draw.chance(0.5):
        neck = _along_y(start - 0.3, start + 0.5 * length)
        middle = (0.0, start + 0.75 * length, 0.0)
        stem = shapes.sweep(
            "head", neck, shapes.ellipse(1, 1, 20), np.array([0.75, 0.6]) * half
        )
        return stem + shapes.sphere("head", 0.95 * half, middle, 16, 24)
    path = _along_y(start, start + 0.3 * length, start + 0.9 * length, start + length)
    scale = np.array([[0.95, 0.95], [0.85, 0.95], [0.22, 0.9], [0.12, 0.85]]) * half
    return shapes.sweep(
        "head",
        path,
        shapes.rectangle(2.0, 2.0, 0.4),
        scale,
        first=(1.0, 0.0, 0.0),
        caps=True,
    )


@family(metres=0.01)
def hammer(draw: ParameterSampler) -> Instance:
    """Make a hammer whose handle runs along -x, and whose head lies along y.

    The head is at the origin, and its striking face at -y.
    """
    half = draw(1.35, 1.15, 1.7)
    length = draw(27.0, 20.0, 31.0)
    front = draw(5.0, 3.8, 6.0)
    face = half * draw(1.1, 1.0, 1.35)
    style = draw.pick("claw", "claw", "peen", "sledge")
    eye = half * draw(1.25, 1.1, 1.5)
    front = max(front, 2.2 * eye)

    head = _hammer_head(draw, half, eye, style, front, face)

    belly, thick, stick = _hammer_stick(draw, half, length)

    top = max(half * 1.05, face if style != "sledge" else face * 1.2)
    tilt = np.degrees(np.arctan2(top - thick * (1.0 + belly), 0.8 * length))
    patches = shapes.transform_patches(
        shapes.transform_patches([*head, *stick], shapes.rotation("y", -float(tilt))),
        shapes.rotation("z", draw(58.0, 20.0, 90.0)),
    )

    paints = _hammer_paints(draw, front, length)
    return Instance(patches, paints, sample_material(draw, 0.38, 0.2))


def _hammer_head(
    draw: ParameterSampler,
    half: float,
    eye: float,
    style: str,
    front: float,
    face: float,
) -> list[Patch]:
    """Create the head of a hammer of a style."""
    scale = np.array([[0.82, 0.82], [1, 1], [1, 1], [0.86, 0.86]]) * half * 1.05
    path = _along_y(-eye * 1.1, -eye * 0.9, eye * 0.9, eye * 1.15)
    head = shapes.sweep(
        "head",
        path,
        shapes.rectangle(2.0, 2.0, 0.45),
        scale,
        first=(1.0, 0.0, 0.0),
        caps=True,
    )
    if style == "sledge":
        path = _along_y(-front, -front + 0.3, front - 0.3, front)
        section = (
            shapes.polygon(8, 0.1)
            if draw.chance(0.5)
            else shapes.rectangle(1.8, 1.8, 0.4)
        )
        scale = np.array([0.85, 1.0, 1.0, 0.85]) * face * 1.25
        head = shapes.sweep(
            "head", path, section, scale, first=(1.0, 0.0, 0.0), caps=True
        )
    else:
        path = _along_y(
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
            shapes.ellipse(1.0, 1.0, 28),
            scale,
            first=(1.0, 0.0, 0.0),
            caps=True,
        )
        if style == "claw":
            head += _claw(
                draw, half, eye * 0.95, draw(6.4, 5.0, 7.5), draw(2.6, 1.2, 3.6)
            )
        else:
            head += _peen(draw, half, eye, draw(4.0, 3.0, 5.0))
    return head


def _hammer_stick(
    draw: ParameterSampler, half: float, length: float
) -> tuple[float, float, list[Patch]]:
    """Create the handle of a hammer; also return its swelling and its thickness."""
    t = np.linspace(0.0, 1.0, 30)
    belly = draw(0.16, 0.0, 0.3)
    grip = (
        1.0
        + belly * np.exp(-(((t - 0.78) / 0.14) ** 2))
        - 0.5 * belly * np.exp(-(((t - 0.45) / 0.2) ** 2))
    )
    ends = np.sqrt(
        np.clip(1.0 - ((t - 0.95) / 0.05).clip(0.0, 1.0) ** 2 * 0.999, 0.0, 1.0)
    )
    ends[-1] = 0.0
    thick = half * draw(0.72, 0.6, 0.9)
    broad = half * draw(0.92, 0.75, 1.1)
    reach = half * 1.18
    path = np.stack([reach - (length + reach) * t, 0 * t, 0 * t], axis=1)
    scale = np.stack([broad * grip * ends, thick * grip * ends], axis=1)
    scale[0] *= 0.9
    section = (
        shapes.ellipse(1.0, 1.0, 24)
        if draw.chance(0.6, True)
        else shapes.rectangle(2.0, 2.0, 0.7)
    )
    stick = shapes.sweep("handle", path, section, scale, first=(0.0, 1.0, 0.0))
    return belly, thick, stick


def _hammer_paints(
    draw: ParameterSampler, front: float, length: float
) -> dict[str, Paint]:
    """Sample the paints of a hammer."""
    offset = draw.offset()
    steel = draw.sample_color("4b4f55", "8d9298", "2b2d30", "6b7078", wild=0.15)
    metal = over(
        clouded(steel, 0.8, 1.6, offset, 2.4),
        lambda t: step(-t.xyz[:, 1], 0.86 * front, 0.3),
        solid(shade(steel, 1.7)),
    )
    timber = wood(
        draw.sample_color("c48f55", "a8743f", "d9b27c", "7a4f2a", wild=0.05),
        0.9,
        offset,
        axis=0,
    )
    stain = draw.sample_color("8f2e22", "1f4e79", "d9a02b", "2d2d33", "3d6b4a")
    kind = draw.pick("wood", "dipped", "rubber")
    hold = timber
    if kind == "dipped":
        hold = over(
            timber,
            between(-2 * length, -draw(0.5, 0.4, 0.7) * length, axis=0, soft=0.05),
            solid(stain),
        )
    elif kind == "rubber":
        ribs = rings(stain, shade(stain, 0.7), 1.1, 0.2, axis=0)
        hold = over(
            solid(shade(stain, 0.5)),
            between(-2 * length, -0.45 * length, axis=0, soft=0.05),
            ribs,
        )
    return {
        "head": paint_or_random(draw, length, metal, 0.3),
        "handle": paint_or_random(draw, length, hold, 0.3),
    }


def _weights(
    draw: ParameterSampler, style: str, at: float, length: float, radius: float
) -> list[Patch]:
    """Create the weight on the +x end of the bar, built along z and rotated
    afterwards.
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
            shapes.polygon(6, 0.14, 3),
            scale,
            first=(0.0, 1.0, 0.0),
            caps=True,
        )
    if style == "globe":
        return shapes.sphere("weight", radius * 0.95, (0.0, 0.0, at + 0.8 * radius))
    plates = 3 if style == "plates" else 1
    patches = []
    z = at
    for i in range(plates):
        thick = length / plates * 0.94
        size = radius * (1.0 - 0.17 * i)
        bevel = min(0.25 * thick, 0.6)
        side = shapes.round_corners(
            [(0.55 * size, z), (size, z), (size, z + thick), (0.55 * size, z + thick)],
            bevel,
            4,
        )
        under = [(0.0, z), (0.55 * size, z)]
        top = [(0.55 * size, z + thick), (0.0, z + thick)]
        patches += shapes.lathe(
            [
                ("weight", under),
                ("weight", shapes.subdivide(side, 1.2)),
                ("weight", top),
            ],
            44,
        )
        z += length / plates
    if style == "plates":
        nut = (
            shapes.polygon(6, 0.1) if draw.chance(0.5) else shapes.ellipse(1.0, 1.0, 24)
        )
        path = [(0, 0, z - 0.1), (0, 0, z + 0.6), (0, 0, z + 0.75)]
        scale = np.array([1.0, 1.0, 0.85]) * 0.42 * radius
        patches += shapes.sweep(
            "bar", path, nut, scale, first=(0.0, 1.0, 0.0), caps=True
        )
    return patches


@family(metres=0.01)
def dumbbell(draw: ParameterSampler) -> Instance:
    """Make a dumbbell with weights of random shape."""
    style = draw.pick("hex", "plates", "hex", "round", "globe")
    radius = draw(4.6, 3.6, 6.2)
    grip = draw(5.6, 5.0, 7.0)
    length = draw(5.6, 3.8, 7.0)
    bar = draw(1.45, 1.2, 1.9)
    swell = draw(0.16, 0.0, 0.3)
    z = np.linspace(-grip - 0.6, grip + 0.6, 25)
    profile = np.stack(
        [bar * (1.0 + swell * np.cos(np.pi * z / (2 * grip + 1.2)) ** 2), z], axis=1
    )
    weights = _weights(draw, style, grip, length, radius)
    patches = (
        shapes.lathe([("bar", profile)], 28)
        + weights
        + shapes.transform_patches(weights, shapes.rotation("y", 180.0))
    )
    laid = shapes.transform_patches(
        shapes.transform_patches(patches, shapes.rotation("y", 90.0)),
        shapes.rotation("z", draw(118.0, 90.0, 150.0)),
    )
    paints = _dumbbell_paints(draw, grip, style, length, radius)
    return Instance(laid, paints, sample_material(draw, 0.42, 0.2))


def _dumbbell_paints(
    draw: ParameterSampler, grip: float, style: str, length: float, radius: float
) -> dict[str, Paint]:
    """Sample the paints of a dumbbell."""
    offset = draw.offset()
    iron = draw.sample_color(
        "26282b", "3a3d42", "8a8d92", "7a2f8f", "2f6f8f", "c23b4a", wild=0.25
    )
    weight = speckled(
        clouded(iron, 1.25, 2.5, offset),
        shade(iron, 1.9),
        0.35,
        offset,
        draw(0.08, 0.0, 0.2),
    )
    tip = grip + (length if style != "globe" else 1.75 * radius)
    accent = draw.sample_color("c9ccd0", "f2f2f0", "d9a02b", "c23b4a")
    if draw.chance(0.5, True):

        def on_both_ends(t: Texels) -> Array:
            ring = band_mask(
                np.hypot(t.xyz[:, 0], t.xyz[:, 1]), 0.34 * radius, 0.44 * radius, 0.12
            )
            return step(np.abs(t.xyz[:, 2]), tip - 0.6, 0.05) * ring

        weight = over(weight, on_both_ends, solid(accent))
    steel = draw.sample_color("b4b8bd", "8d9298", "2b2d30", wild=0.2)
    knurl = over(
        solid(steel),
        lambda t: (
            (
                step(np.sin(90 * t.u + 60 * t.v), 0.3, 0.6)
                * between(-0.75 * grip, 0.75 * grip)(t)
            )
            * 0.6
        ),
        solid(shade(steel, 0.55)),
    )
    return {"weight": paint_or_random(draw, 2 * tip, weight, 0.35), "bar": knurl}
