"""Hammer and dumbbell. Units are centimetres."""

from __future__ import annotations

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
    band_mask,
    choose_paint_or_random,
    compute_soft_step,
    make_range_mask,
    paint_over,
    paint_shaded_clouds,
    paint_solid_color,
    painter,
    rings,
    scale_brightness,
    wood,
)


def _claw(
    sampler: ParameterSampler,
    half_head: float,
    start: float,
    length: float,
    drop: float,
) -> list[Patch]:
    """Create two tapering prongs that curve downwards (towards -x) from the head.

    Args:
        sampler: samples how far they spread.
        half_head: half the width of the head.
        start: y of their roots.
        length: their extent along +y.
        drop: how far their tips are below their roots, along -x.
    """
    spread = sampler(0.34, low=0.2, high=0.5)
    t = np.linspace(0.0, 1.0, 14)  # from the root to the tip
    patches = []
    for side in (-1.0, 1.0):
        # The powers bend the prongs: the tips turn downwards.
        x = 0.25 * half_head - drop * t**1.8
        y = start + length * (t - 0.1 * t**2)
        z = side * half_head * (0.5 + spread * t)
        patches += _prong(np.stack([x, y, z], axis=1), half_head)
    return patches


def _prong(curve: Array, half_head: float) -> list[Patch]:
    """Create a prong of a claw along a curve (N, 3), which tapers to its end.

    Args:
        curve: from the root to the tip.
        half_head: half the width of the head.
    """
    t = np.linspace(0.0, 1.0, len(curve))
    half_thickness = half_head * (0.72 * (1 - t) + 0.1)
    half_width = half_head * 0.47 * (1.0 - 0.25 * t)
    scale = np.stack([half_thickness, half_width], axis=1)
    section = shapes.rectangle(2.0, 2.0, bevel=0.5, steps=2)
    return shapes.sweep_section(
        "head", curve, section, scale, start_axis=(1.0, 0.0, 0.0), has_caps=True
    )


def _points_on_y(*positions: float) -> Array:
    """Return points (K, 3) on the y axis."""
    return np.array([(0.0, y, 0.0) for y in positions])


def _peen(
    sampler: ParameterSampler, half_head: float, start: float, length: float
) -> list[Patch]:
    """Create a wedge (cross peen) or a ball at the back of the head, along +y.

    Args:
        sampler: chooses between both.
        half_head: half the width of the head.
        start: y of its root.
        length: its extent along +y.
    """
    if sampler.sample_bool(0.5):
        return _ball_peen(half_head, start, length)
    path = _points_on_y(
        start, start + 0.3 * length, start + 0.9 * length, start + length
    )
    # half-thickness and half-width: it becomes thin, and stays wide
    scale = np.array([[0.95, 0.95], [0.85, 0.95], [0.22, 0.9], [0.12, 0.85]])
    return shapes.sweep_section(
        "head",
        path,
        shapes.rectangle(2.0, 2.0, bevel=0.4),
        scale * half_head,
        start_axis=(1.0, 0.0, 0.0),
        has_caps=True,
    )


def _ball_peen(half_head: float, start: float, length: float) -> list[Patch]:
    """Create the back of a ball-peen hammer's head: a ball on a short neck, along +y.

    Args:
        half_head: half the width of the head.
        start: y of the neck's root.
        length: length along +y.
    """
    neck = shapes.sweep_section(
        "head",
        _points_on_y(start - 0.3, start + 0.5 * length),
        shapes.ellipse(1, 1, count=20),
        np.array([0.75, 0.6]) * half_head,
    )
    ball = shapes.make_sphere_patches(
        "head",
        0.95 * half_head,
        center=(0.0, start + 0.75 * length, 0.0),
        rows=16,
        columns=24,
    )
    return neck + ball


@make_family(unit_in_metres=0.01)
def hammer(sampler: ParameterSampler) -> Instance:
    """Make a hammer that lies on its side.

    It is built with the head at the origin along y, the striking face at -y, and the
    handle along -x. Then it is laid down and turned about z. Lengths are in
    centimeters, angles in degrees. `sampler(x, low=..., high=...)` returns x for the
    canonical hammer and a uniform sample for a random one.
    """
    half_head = sampler(1.35, low=1.15, high=1.7)
    length = sampler(27.0, low=20.0, high=31.0)
    sampled_front = sampler(5.0, low=3.8, high=6.0)
    face_radius = half_head * sampler(1.1, low=1.0, high=1.35)
    # "claw" is named twice, to be sampled twice as often
    style = sampler.sample_choice("claw", "claw", "peen", "sledge")
    half_eye = half_head * sampler(1.25, low=1.1, high=1.5)
    front = max(sampled_front, 2.2 * half_eye)  # outside the block around the eye

    head = _hammer_head(sampler, style, half_head, half_eye, front, face_radius)
    half_grip, handle = _hammer_handle(sampler, half_head, length)

    # half the thickness of the head; the factors are those of `_sledge_block`, nearly,
    # and of `_eye_block`
    half_face = face_radius * 1.2 if style == "sledge" else face_radius
    drop = max(half_head * 1.05, half_face) - half_grip
    lay = shapes.make_rotation_matrix("y", _compute_hammer_tilt(drop, length))
    turn = shapes.make_rotation_matrix("z", sampler(58.0, low=20.0, high=90.0))
    return Instance(
        shapes.transform_patches(shapes.transform_patches([*head, *handle], lay), turn),
        _hammer_paints(sampler, front, length),
        sample_material(sampler, roughness=0.38, clearcoat=0.2),
    )


def _compute_hammer_tilt(drop: float, length: float) -> float:
    """Return the angle in degrees by which the handle of a lying hammer is tilted down.

    The hammer lies on the head and on the swelling of the handle, at 0.8 of its length.

    Args:
        drop: by how much the head is thicker there, on one side.
        length: length of the handle.
    """
    return -float(np.degrees(np.arctan2(drop, 0.8 * length)))


def _hammer_head(
    sampler: ParameterSampler,
    style: str,
    half_head: float,
    half_eye: float,
    front: float,
    face_radius: float,
) -> list[Patch]:
    """Create the head of a hammer of a style.

    A sledge's head is one block. Other heads have a block around the eye, through which
    the handle goes, a neck and a face in front, and a claw or a peen behind.

    Args:
        sampler: samples the shape of the sledge, the claw or the peen.
        style: "claw", "peen" or "sledge".
        half_head: half the width of the block around the eye.
        half_eye: half the length of that block, about.
        front: length from the eye to the striking face.
        face_radius: radius of the face.
    """
    if style == "sledge":
        return _sledge_block(sampler, front, face_radius)
    block = _eye_block(half_head, half_eye)
    face = _striking_face(half_head, half_eye, front, face_radius)
    back = _sample_hammer_back(sampler, style, half_head, half_eye)
    return block + face + back


def _sample_hammer_back(
    sampler: ParameterSampler, style: str, half_head: float, half_eye: float
) -> list[Patch]:
    """Create what is behind the eye of a hammer: a claw or a peen of random length.

    Args:
        sampler: samples its shape.
        style: "claw" or "peen".
        half_head: half the width of the block around the eye.
        half_eye: half the length of that block, about.
    """
    if style == "claw":
        length = sampler(6.4, low=5.0, high=7.5)
        drop = sampler(2.6, low=1.2, high=3.6)
        return _claw(sampler, half_head, half_eye * 0.95, length, drop)
    length = sampler(4.0, low=3.0, high=5.0)
    return _peen(sampler, half_head, half_eye, length)


def _sledge_block(
    sampler: ParameterSampler, front: float, face_radius: float
) -> list[Patch]:
    """Create the head of a sledgehammer: a block with eight or four sides along y.

    Args:
        sampler: chooses the number of sides.
        front: length from the middle to each end.
        face_radius: radius of the face.
    """
    section = shapes.rectangle(1.8, 1.8, bevel=0.4)
    if sampler.sample_bool(0.5):
        section = shapes.polygon(8, bevel=0.1)
    return shapes.sweep_section(
        "head",
        _points_on_y(-front, -front + 0.3, front - 0.3, front),
        section,
        np.array([0.85, 1.0, 1.0, 0.85]) * face_radius * 1.25,
        start_axis=(1.0, 0.0, 0.0),
        has_caps=True,
    )


def _eye_block(half_head: float, half_eye: float) -> list[Patch]:
    """Create the beveled block around the eye, along y."""
    scale = np.array([[0.82, 0.82], [1, 1], [1, 1], [0.86, 0.86]])
    return shapes.sweep_section(
        "head",
        _points_on_y(-half_eye * 1.1, -half_eye * 0.9, half_eye * 0.9, half_eye * 1.15),
        shapes.rectangle(2.0, 2.0, bevel=0.45),
        scale * half_head * 1.05,
        start_axis=(1.0, 0.0, 0.0),
        has_caps=True,
    )


def _striking_face(
    half_head: float, half_eye: float, front: float, face_radius: float
) -> list[Patch]:
    """Create the round neck in front of the eye, and the face at its end (-y).

    Args:
        half_head: half the width of the block around the eye.
        half_eye: half the length of that block.
        front: distance of the striking face from the middle of the eye.
        face_radius: radius of the face.
    """
    # y of each ring, from the eye to the face
    path = _points_on_y(
        -half_eye * 0.9,
        -half_eye * 1.2,
        -0.62 * front,
        -0.7 * front,
        -0.74 * front,
        -front + 0.25,
        -front,
    )
    # The first three rings are of the neck, the others of the face.
    relative_scale = np.array([0.85, 0.75, 0.72, 0.85, 1.0, 1.0, 0.88])
    scale = relative_scale * np.array([half_head] * 3 + [face_radius] * 4)
    return shapes.sweep_section(
        "head",
        path,
        shapes.ellipse(1.0, 1.0, count=28),
        scale,
        start_axis=(1.0, 0.0, 0.0),
        has_caps=True,
    )


def _hammer_handle(
    sampler: ParameterSampler, half_head: float, length: float
) -> tuple[float, list[Patch]]:
    """Create the handle of a hammer, from the head along -x.

    It swells near its end, where it is held, is thinner in the middle, and its end is
    rounded.

    Args:
        sampler: samples its thickness and its section, an ellipse or a rounded square.
        half_head: half the width of the head.
        length: length from the head to the end.

    Returns:
        Approximately half its thickness where it is held, and its patches.
    """
    t = np.linspace(0.0, 1.0, 30)  # from the head to the end
    swelling = sampler(0.16, low=0.0, high=0.3)
    half_thickness = half_head * sampler(0.72, low=0.6, high=0.9)
    half_width = half_head * sampler(0.92, low=0.75, high=1.1)
    scale = _handle_scale(t, swelling, half_width, half_thickness)
    top_x = half_head * 1.18  # the end that sticks out of the head
    # from there to -`length`
    path = np.stack([top_x - (length + top_x) * t, 0 * t, 0 * t], axis=1)
    section = _sample_grip_section(sampler)  # is multiplied by `scale`
    handle = shapes.sweep_section(
        "handle", path, section, scale, start_axis=(0.0, 1.0, 0.0)
    )
    return half_thickness * (1.0 + swelling), handle


def _sample_grip_section(sampler: ParameterSampler) -> Array:
    """Sample the section (M, 2) of a handle: an ellipse, or a rounded square.

    It reaches from -1 to 1 on both axes.
    """
    if sampler.sample_bool(0.6, canonical=True):
        return shapes.ellipse(1.0, 1.0, count=24)
    return shapes.rectangle(2.0, 2.0, bevel=0.7)


def _handle_scale(
    t: Array, swelling: float, half_width: float, half_thickness: float
) -> Array:
    """Return half the extents (N, 2) of a hammer's handle along both axes of its section.

    Args:
        t: (N,) from 0 at the head to 1 at the end.
        swelling: by how much it swells where it is held, as a fraction.
        half_width, half_thickness: half its usual extents along y, the first axis of
            the section, and along the second axis.
    """
    # thicker around 0.78 of the length, thinner around 0.45
    grip = swelling * np.exp(-(((t - 0.78) / 0.14) ** 2))
    waist = 0.5 * swelling * np.exp(-(((t - 0.45) / 0.2) ** 2))
    relative_scale = 1.0 + grip - waist
    rounding = _handle_rounding(t)
    scale = np.stack(
        [
            half_width * relative_scale * rounding,
            half_thickness * relative_scale * rounding,
        ],
        axis=1,
    )
    scale[0] *= 0.9  # a bevel at the head
    return scale


def _handle_rounding(t: Array) -> Array:
    """Return the factors (N,) by which the end of a handle is rounded, 1 before it.

    They follow a quarter of an ellipse over the last twentieth; t is from 0 to 1.
    """
    end_fraction = ((t - 0.95) / 0.05).clip(0.0, 1.0)
    # With 0.999 the ellipse does not close by rounding errors, but exactly at the last
    # ring, whose factor is set to 0.
    rounding = np.sqrt(np.clip(1.0 - end_fraction**2 * 0.999, 0.0, 1.0))
    rounding[-1] = 0.0
    return np.asarray(rounding)


def _hammer_paints(
    sampler: ParameterSampler, front: float, length: float
) -> dict[str, Paint]:
    """Sample the paints of the head and the handle of a hammer.

    The striking face is bright metal.

    Args:
        sampler: samples the paints.
        front: distance of the striking face from the middle of the head, at -y.
        length: length of the handle, along -x.
    """
    offset = sampler.sample_noise_offset()
    steel = sampler.sample_color("4b4f55", "8d9298", "2b2d30", "6b7078", p_random=0.15)
    metal = paint_over(
        paint_shaded_clouds(steel, factor=0.8, scale=1.6, offset=offset, contrast=2.4),
        lambda t: compute_soft_step(-t.xyz[:, 1], 0.86 * front, soft=0.3),
        paint_solid_color(scale_brightness(steel, 1.7)),
    )
    handle = _hammer_handle_paint(sampler, length, offset)
    return {
        "head": choose_paint_or_random(sampler, length, metal, p_random=0.3),
        "handle": choose_paint_or_random(sampler, length, handle, p_random=0.3),
    }


def _hammer_handle_paint(
    sampler: ParameterSampler, length: float, offset: Array
) -> Paint:
    """Sample a handle of wood, one dipped in color, or one with a ribbed rubber grip.

    Args:
        sampler: samples kind and colors.
        length: length of the handle, along -x.
        offset: (3,) into the noise.
    """
    timber_color = sampler.sample_color(
        "c48f55", "a8743f", "d9b27c", "7a4f2a", p_random=0.05
    )
    timber = wood(timber_color, scale=0.9, offset=offset, axis=0)
    accent = sampler.sample_color("8f2e22", "1f4e79", "d9a02b", "2d2d33", "3d6b4a")
    kind = sampler.sample_choice("wood", "dipped", "rubber")
    if kind == "dipped":
        dip_start = -sampler(0.5, low=0.4, high=0.7) * length
        # the mask reaches the end of the handle and farther
        dipped = make_range_mask(-2 * length, dip_start, axis=0, soft=0.05)
        return paint_over(timber, dipped, paint_solid_color(accent))
    if kind == "rubber":
        return _paint_rubber_grip(accent, length)
    return timber


def _paint_rubber_grip(color: Array, length: float) -> Paint:
    """Paint a handle dark, with a ribbed grip of a color at its end.

    Args:
        color: color (3,) of the grip.
        length: length of the handle, along -x.
    """
    # the mask reaches the end of the handle and farther
    grip = make_range_mask(-2 * length, -0.45 * length, axis=0, soft=0.05)
    ribs = rings(color, scale_brightness(color, 0.7), period=1.1, fraction=0.2, axis=0)
    return paint_over(paint_solid_color(scale_brightness(color, 0.5)), grip, ribs)


def _make_weight(
    sampler: ParameterSampler, style: str, start: float, length: float, radius: float
) -> list[Patch]:
    """Create the weight at the upper end of a dumbbell whose bar is along z.

    Args:
        sampler: chooses the nut of "plates".
        style: "hex", "globe", "plates" (three, each smaller, and a nut) or "round".
        start: z of its inner side.
        length: its extent along z. A globe does not use it: its size is `radius`.
        radius: radius of the weight.
    """
    if style == "hex":
        return _hexagonal_weight(start, length, radius)
    if style == "globe":
        center_z = start + 0.8 * radius
        return shapes.make_sphere_patches(
            "weight", radius * 0.95, center=(0.0, 0.0, center_z)
        )
    if style == "round":
        return _plate(start, length, radius)
    return _three_plates(sampler, start, length, radius)


def _three_plates(
    sampler: ParameterSampler, start: float, length: float, radius: float
) -> list[Patch]:
    """Create three plates along z, each smaller than the one before, and a nut.

    Args:
        sampler: chooses the nut.
        start: z of the inner side of the first plate.
        length: extent of all plates along z.
        radius: radius of the first plate.
    """
    n_plates = 3
    patches = []
    z = start
    for i in range(n_plates):
        patches += _plate(z, length / n_plates, radius * (1.0 - 0.17 * i))
        z += length / n_plates
    return patches + _nut(sampler, z, radius)


def _hexagonal_weight(start: float, length: float, radius: float) -> list[Patch]:
    """Create a weight with six sides and beveled ends, along z from `start`."""
    path = [
        (0, 0, start),
        (0, 0, start + 0.12 * length),
        (0, 0, start + 0.85 * length),
        (0, 0, start + length),
    ]
    return shapes.sweep_section(
        "weight",
        path,
        shapes.polygon(6, bevel=0.14, steps=3),
        np.array([0.86, 1.0, 1.0, 0.8]) * radius,
        start_axis=(0.0, 1.0, 0.0),
        has_caps=True,
    )


def _plate(start: float, spacing: float, radius: float) -> list[Patch]:
    """Create a round plate with rounded edges, along z from `start`.

    Its thickness is 94 % of `spacing`: the rest is a gap before the next plate.
    """
    thickness = spacing * 0.94
    end = start + thickness
    hub_radius = 0.55 * radius  # radius of the flat middle of both sides
    # profiles of points (r, z)
    side = shapes.round_corners(
        [(hub_radius, start), (radius, start), (radius, end), (hub_radius, end)],
        radius=min(0.25 * thickness, 0.6),
        steps=4,
    )
    return shapes.revolve_profile(
        [
            ("weight", [(0.0, start), (hub_radius, start)]),
            ("weight", shapes.subdivide(side, longest=1.2)),
            ("weight", [(hub_radius, end), (0.0, end)]),
        ],
        columns=44,
    )


def _nut(sampler: ParameterSampler, start: float, radius: float) -> list[Patch]:
    """Create the nut that holds plates: round, or hexagonal.

    Args:
        sampler: chooses its shape.
        start: z at which the plates end.
        radius: radius of the largest plate.
    """
    section = shapes.ellipse(1.0, 1.0, count=24)
    if sampler.sample_bool(0.5):
        section = shapes.polygon(6, bevel=0.1)
    # It begins inside the last plate, so that no gap shows.
    path = [(0, 0, start - 0.1), (0, 0, start + 0.6), (0, 0, start + 0.75)]
    scale = np.array([1.0, 1.0, 0.85]) * 0.42 * radius
    return shapes.sweep_section(
        "bar", path, section, scale, start_axis=(0.0, 1.0, 0.0), has_caps=True
    )


@make_family(unit_in_metres=0.01)
def dumbbell(sampler: ParameterSampler) -> Instance:
    """Make a dumbbell with weights of random shape."""
    # "hex" is named twice, to be sampled twice as often
    style = sampler.sample_choice("hex", "plates", "hex", "round", "globe")
    radius = sampler(4.6, low=3.6, high=6.2)
    half_grip = sampler(5.6, low=5.0, high=7.0)  # half the bar between the weights
    length = sampler(5.6, low=3.8, high=7.0)  # length of a weight
    bar = _dumbbell_bar(sampler, half_grip)
    weight = _make_weight(sampler, style, half_grip, length, radius)
    other_weight = shapes.transform_patches(
        weight, shapes.make_rotation_matrix("y", 180.0)
    )
    patches = _lay_dumbbell(sampler, bar + weight + other_weight)
    paints = _dumbbell_paints(sampler, style, half_grip, length, radius)
    return Instance(
        patches, paints, sample_material(sampler, roughness=0.42, clearcoat=0.2)
    )


def _lay_dumbbell(sampler: ParameterSampler, upright: list[Patch]) -> list[Patch]:
    """Return a dumbbell that lies in a random direction, from one along the z axis."""
    lying = shapes.transform_patches(upright, shapes.make_rotation_matrix("y", 90.0))
    turn = shapes.make_rotation_matrix("z", sampler(118.0, low=90.0, high=150.0))
    return shapes.transform_patches(lying, turn)


def _dumbbell_bar(sampler: ParameterSampler, half_grip: float) -> list[Patch]:
    """Create the bar of a dumbbell along z, which is thickest in the middle.

    Its ends are 0.6 inside the weights.
    """
    radius = sampler(1.45, low=1.2, high=1.9)
    swelling = sampler(0.16, low=0.0, high=0.3)
    z = np.linspace(-half_grip - 0.6, half_grip + 0.6, 25)
    swell = swelling * np.cos(np.pi * z / (2 * half_grip + 1.2)) ** 2
    profile = np.stack([radius * (1.0 + swell), z], axis=1)
    return shapes.revolve_profile([("bar", profile)], columns=28)


def _dumbbell_paints(
    sampler: ParameterSampler,
    style: str,
    half_grip: float,
    length: float,
    radius: float,
) -> dict[str, Paint]:
    """Sample the paints of a dumbbell: of its weights, and of its knurled bar.

    The dumbbell is painted before it is laid down, so that its bar is along z.

    Args:
        sampler: samples the paints.
        style: style of the weights, as for `_make_weight`.
        half_grip: half the length of the bar between the weights.
        length, radius: length and radius of a weight.
    """
    weight = _sample_weight_paint(sampler)
    # z of the outer side of a weight. A globe has a radius of 0.95 `radius`, and its
    # center is 0.8 `radius` outside of the grip: see `_make_weight`.
    weight_length = 1.75 * radius if style == "globe" else length
    tip = half_grip + weight_length
    accent = sampler.sample_color("c9ccd0", "f2f2f0", "d9a02b", "c23b4a")
    if sampler.sample_bool(0.5, canonical=True):
        weight = paint_over(weight, _end_rings(tip, radius), paint_solid_color(accent))
    knurl = _sample_knurl(sampler, half_grip)
    return {
        "weight": choose_paint_or_random(sampler, 2 * tip, weight, p_random=0.35),
        "bar": knurl,
    }


def _sample_weight_paint(sampler: ParameterSampler) -> Paint:
    """Sample the paint of a dumbbell's weights: cast iron with specks, or a color."""
    offset = sampler.sample_noise_offset()
    iron = sampler.sample_color(
        "26282b", "3a3d42", "8a8d92", "7a2f8f", "2f6f8f", "c23b4a", p_random=0.25
    )
    return add_specks(
        paint_shaded_clouds(iron, factor=1.25, scale=2.5, offset=offset),
        scale_brightness(iron, 1.9),
        scale=0.35,
        offset=offset,
        amount=sampler(0.08, low=0.0, high=0.2),
    )


def _sample_knurl(sampler: ParameterSampler, half_grip: float) -> Paint:
    """Sample the steel of a bar that is knurled where it is held.

    Args:
        sampler: samples the color.
        half_grip: half the length of the bar between the weights.
    """
    steel = sampler.sample_color("b4b8bd", "8d9298", "2b2d30", p_random=0.2)
    return paint_over(
        paint_solid_color(steel),
        _knurl_mask(half_grip),
        paint_solid_color(scale_brightness(steel, 0.55)),
    )


@painter
def _end_rings(t: Texels, tip: float, radius: float) -> Array:
    """Return the mask of a ring on the outer side of each weight.

    Args:
        t: points to paint.
        tip: z of the outer side.
        radius: radius of a weight.
    """
    axis_distance = np.hypot(t.xyz[:, 0], t.xyz[:, 1])
    ring = band_mask(axis_distance, 0.34 * radius, 0.44 * radius, soft=0.12)
    return compute_soft_step(np.abs(t.xyz[:, 2]), tip - 0.6, soft=0.05) * ring


@painter
def _knurl_mask(t: Texels, half_grip: float) -> Array:
    """Return the mask of fine slanted lines on the part of the bar that is held."""
    lines = compute_soft_step(np.sin(90 * t.u + 60 * t.v), 0.3, soft=0.6)
    is_held = make_range_mask(-0.75 * half_grip, 0.75 * half_grip)(t)
    return lines * is_held * 0.6  # faint
