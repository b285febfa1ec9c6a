"""Procedural base colors: functions from surface points to display-referred sRGB.

A `Paint` maps `Texels` to (N, 3) colors in [0, 1]. A pattern in object coordinates
(`xyz`) continues across the edges of charts. A pattern in chart coordinates (`u`, `v`
times `size`) wraps around a part. Lengths are in the object's units.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np
from scipy.ndimage import map_coordinates

from advsearch.questions.harden.objects.shapes import Array

# ---- sampling: a family states each proportion and each color once, as its canonical
# value with the range or the choices that other instances have
# ----------------------------------------------------------------------------------

T = TypeVar("T")
Color = Array  # (3,) display-referred sRGB


def parse_hex_color(code: str) -> Color:
    """Return the color that six hexadecimal digits stand for."""
    return np.array([int(code[i : i + 2], 16) / 255.0 for i in (0, 2, 4)])


@dataclass(frozen=True)
class ParameterSampler:
    """Samples the parameters of an instance, or returns the canonical ones.

    ``sampler(9.4, low=7.6, high=12.0)`` is 9.4 without a generator, else uniform.
    """

    # the source of randomness, or None for the canonical instance
    rng: np.random.Generator | None

    def __call__(self, canonical: float, low: float, high: float) -> float:
        """Return a uniform sample in [low, high], or the canonical value."""
        return canonical if self.rng is None else float(self.rng.uniform(low, high))

    def sample_choice(self, canonical: T, *others: T) -> T:
        """Return one of the choices, all equally likely, or the canonical one.

        A choice that is named twice is twice as likely.
        """
        if self.rng is None:
            return canonical
        choices = (canonical, *others)
        return choices[int(self.rng.integers(len(choices)))]

    def sample_bool(self, probability: float, canonical: bool = False) -> bool:
        """Return True with a probability; without a generator `canonical`."""
        return canonical if self.rng is None else bool(self.rng.random() < probability)

    def sample_noise_offset(self) -> Array:
        """Return an offset (3,) into the noise, so that instances have other clouds."""
        if self.rng is None:
            return np.array([1.7, 9.2, 5.5])
        return self.rng.uniform(0.0, 16.0, 3)

    def sample_color(
        self, canonical: str, *others: str, p_random: float = 0.4
    ) -> Color:
        """Return a color near one of the named colors, or any color (3,).

        Without a generator it is the canonical one.

        Args:
            canonical, *others: codes of six hexadecimal digits, all equally likely.
            p_random: probability of any other color.
        """
        rng = self.rng
        if rng is None:
            return parse_hex_color(canonical)
        if rng.random() < p_random:
            return _sample_any_color(rng)
        base = parse_hex_color(self.sample_choice(canonical, *others))
        brightness = rng.uniform(0.85, 1.12)
        tint = rng.uniform(-0.05, 0.05, 3)
        return np.clip(base * brightness + tint, 0.02, 0.98)


def _sample_any_color(rng: np.random.Generator) -> Color:
    """Sample a color of any hue; saturated colors a little more often, and no black."""
    hue = rng.random()
    saturation = rng.random() ** 0.7
    value = rng.uniform(0.15, 0.97)
    return np.array(colorsys.hsv_to_rgb(hue, saturation, value))


Options = ParamSpec("Options")


@dataclass(frozen=True, eq=False)
class Texels:
    """Points that are painted.

    Attributes:
        xyz: positions (N, 3).
        u, v: chart coordinates (N,) in [0, 1].
        size: width and height of the chart in object units.
    """

    xyz: Array
    u: Array
    v: Array
    size: tuple[float, float]


Paint = Callable[[Texels], Array]
Mask = Callable[[Texels], Array]  # (N,) weights in [0, 1]


def painter(
    paint: Callable[Concatenate[Texels, Options], Array],
) -> Callable[Options, Paint]:
    """Turn a function of texels and options into a function of the options alone.

    That function returns a paint or a mask, a function of texels. For example,
    `rings(a, b, period=2.0)` is a paint, and `rings(a, b, period=2.0)(t)` are colors.
    """

    @wraps(paint)
    def with_options(*args: Options.args, **kwargs: Options.kwargs) -> Paint:
        return lambda t: paint(t, *args, **kwargs)

    return with_options


def scale_brightness(color: Color, factor: float) -> Color:
    """Return a darker (factor below 1) or lighter (above 1) color, clipped to [0,
    1].
    """
    return np.clip(color * factor, 0.0, 1.0)


_LATTICE = np.random.Generator(np.random.PCG64(20)).random((16, 16, 16))


def compute_value_noise(points: Array) -> Array:
    """Return smooth value noise (N,) in [0, 1] at points (N, 3).

    It interpolates random values at the points of a lattice whose spacing is 1. They
    repeat after 16 along each axis.
    """
    cell = np.floor(points)
    fraction = points - cell
    # bent so that linear interpolation has no creases at the lattice (smoothstep)
    smooth = cell + fraction * fraction * (3.0 - 2.0 * fraction)
    return np.asarray(map_coordinates(_LATTICE, smooth.T, order=1, mode="grid-wrap"))


def blend_colors(a: Array, b: Array, weight: Array) -> Array:
    """Blend colors (3,) or (N, 3) by (N,) weights: 0 gives a, 1 gives b."""
    return a + (b - a) * weight[:, None]


def band_mask(value: Array, low: float, high: float, soft: float) -> Array:
    """Return 1 between two values and 0 outside, with ramps `soft` wide."""
    return compute_soft_step(value, low, soft=soft) * compute_soft_step(
        -value, -high, soft=soft
    )


def compute_soft_step(value: Array, edge: float, soft: float) -> Array:
    """Return 0 below the edge and 1 above it, with a ramp `soft` wide."""
    return np.clip((value - edge) / soft + 0.5, 0.0, 1.0)


@painter
def paint_solid_color(t: Texels, color: Color | str) -> Array:
    """Paint a single color."""
    return np.broadcast_to(
        parse_hex_color(color) if isinstance(color, str) else color, (len(t.u), 3)
    )


@painter
def paint_two_color_clouds(
    t: Texels, a: Color, b: Color, scale: float, offset: Array, contrast: float = 2.0
) -> Array:
    """Paint clouds of two colors, `scale` wide.

    With a `contrast` above 1, more of the surface has one of the two colors unmixed.
    `offset` (3,) is added to positions, so that instances have different clouds.
    """
    position = t.xyz / scale + offset
    # two octaves; the second is shifted, so that both have no common center
    clouds = (
        compute_value_noise(position) + compute_value_noise(position * 2.0 + 5.3) * 0.5
    ) / 1.5
    return blend_colors(a, b, np.clip((clouds - 0.5) * contrast + 0.5, 0.0, 1.0))


def paint_shaded_clouds(
    color: Color, factor: float, scale: float, offset: Array, contrast: float = 2.0
) -> Paint:
    """Paint clouds of a color and a shade of it, `scale` wide."""
    return paint_two_color_clouds(
        color,
        scale_brightness(color, factor),
        scale=scale,
        offset=offset,
        contrast=contrast,
    )


def add_specks(
    base: Paint, color: Color, scale: float, offset: Array, amount: float = 0.16
) -> Paint:
    """Paint small irregular specks, `scale` wide, over another paint.

    They cover about the fraction `amount` of its area. `offset` (3,) is added to
    positions, so that instances have different specks.
    """
    # The noise is seldom near 1, so that the threshold falls faster than `amount` grows.
    threshold = 1.0 - 1.1 * amount
    return paint_over(
        base,
        lambda t: compute_soft_step(
            compute_value_noise(t.xyz / scale + offset), threshold, soft=0.12
        ),
        paint_solid_color(color),
    )


@painter
def gradient(
    t: Texels, a: Color, b: Color, low: float, high: float, axis: int = 2
) -> Array:
    """Paint a gradient from color a at `low` to color b at `high` along an axis."""
    return blend_colors(a, b, np.clip((t.xyz[:, axis] - low) / (high - low), 0.0, 1.0))


@painter
def wood(
    t: Texels,
    color: Color,
    scale: float,
    offset: Array,
    axis: int = 2,
    contrast: float = 0.45,
) -> Array:
    """Paint wood with growth rings about `scale` apart, and fibers along an axis.

    Args:
        t: points to paint.
        color: color of its light parts.
        scale: distance of the growth rings, about.
        offset: (3,) added to the coordinates of the noise, so that each object has a
            grain of its own.
        axis: axis of the fibers: 0 is x, 1 is y, 2 is z.
        contrast: by how much the grain is darker, as a fraction.
    """
    stretch = np.full(3, 1.0 / scale)
    stretch[axis] = 0.12 / scale  # the grain is long along the axis
    grain_position = t.xyz * stretch + offset
    growth_rings = _compute_growth_rings(grain_position, axis)
    # fibers are four times as fine across the axis as the rings are
    is_axis = np.arange(3) == axis
    fibers = compute_value_noise(grain_position * np.where(is_axis, 1.0, 4.0))
    grain = contrast * (0.55 * growth_rings**2 + 0.45 * fibers)
    brightening = 1.12  # makes up for some of what the grain darkens
    return np.asarray(np.clip(color * (1.0 - grain)[:, None] * brightening, 0.0, 1.0))


def _compute_growth_rings(grain_position: Array, axis: int) -> Array:
    """Return a wave (N,) in [0, 1] across wood, with a period at each growth ring.

    It is a slanted plane wave that is bent by noise. The factors are chosen by eye.

    Args:
        grain_position: points (N, 3), in units of the distance of the rings.
        axis: axis of the fibers.
    """
    first_cross, second_cross = (i for i in range(3) if i != axis)
    ring_phase = (
        grain_position[:, first_cross]
        + 0.6 * grain_position[:, second_cross]
        + 1.6 * compute_value_noise(grain_position * 0.45)
    )
    return np.asarray(0.5 + 0.5 * np.sin(2 * np.pi * ring_phase * 0.8))


@painter
def rings(
    t: Texels, a: Color, b: Color, period: float, fraction: float = 0.5, axis: int = 2
) -> Array:
    """Paint stripes across an axis, one in each `period`; `fraction` of it is color b.

    Where the axis is z, these are rings around an upright object.
    """
    distance_from_middle = np.abs(t.xyz[:, axis] / period % 1.0 - 0.5)
    return blend_colors(
        a, b, compute_soft_step(fraction / 2 - distance_from_middle, 0.0, soft=0.06)
    )


def _cells(t: Texels, cell: float) -> tuple[Array, Array]:
    """Return chart coordinates (N,) across and up, in cells about `cell` wide.

    The chart has a whole number of cells along each side, so that patterns meet at
    seams.
    """
    return t.u * max(1, round(t.size[0] / cell)), t.v * max(1, round(t.size[1] / cell))


@painter
def stripes(
    t: Texels, a: Color, b: Color, cell: float, fraction: float = 0.5, slant: int = 0
) -> Array:
    """Paint stripes of color b on a, which run up the chart, about `cell` apart.

    They take `fraction` of the width, and shift by `slant` cells from the bottom to the
    top.
    """
    across, _ = _cells(t, cell)
    distance_from_middle = np.abs((across + slant * t.v) % 1.0 - 0.5)
    return blend_colors(
        a, b, compute_soft_step(fraction / 2 - distance_from_middle, 0.0, soft=0.08)
    )


@painter
def checks(t: Texels, a: Color, b: Color, cell: float) -> Array:
    """Paint a checkerboard with squares `cell` wide."""
    across, up = _cells(t, 2 * cell)  # a pattern repeats after two squares
    return blend_colors(a, b, (np.floor(2 * across) + np.floor(2 * up)) % 2.0)


def dots(base: Paint, color: Color, cell: float, radius: float = 0.3) -> Paint:
    """Paint round dots over another paint, in rows that are staggered by half a cell.

    Cells are about `cell` wide; the radius of the dots is in cells.
    """

    def dot_mask(t: Texels) -> Array:
        """Return 1 inside the dots; every other row is shifted by half a cell."""
        across, up = _cells(t, cell)
        across = across + 0.5 * (np.floor(up) % 2.0)
        center_distance = np.hypot(across % 1.0 - 0.5, up % 1.0 - 0.5)
        return compute_soft_step(radius - center_distance, 0.0, soft=0.1)

    return paint_over(base, dot_mask, paint_solid_color(color))


@painter
def zigzag(t: Texels, a: Color, b: Color, cell: float) -> Array:
    """Paint chevrons around the chart, `cell` high."""
    across, up = _cells(t, cell)
    line_height = np.abs(across % 1.0 - 0.5)  # a triangular wave
    distance_from_line = np.abs((up + line_height) % 1.0 - 0.5)
    return blend_colors(
        a, b, compute_soft_step(0.25 - distance_from_line, 0.0, soft=0.1)
    )


@painter
def paint_over(t: Texels, base: Paint, mask: Mask, top: Paint) -> Array:
    """Paint one paint over another where the mask is above 0."""
    weight = mask(t)
    covered = np.nonzero(weight)[0]
    color = np.array(base(t))
    if len(covered):
        covered_texels = Texels(t.xyz[covered], t.u[covered], t.v[covered], t.size)
        color[covered] = blend_colors(
            color[covered], top(covered_texels), weight[covered]
        )
    return color


@painter
def make_range_mask(
    t: Texels, low: float, high: float, axis: int = 2, soft: float = 0.02
) -> Array:
    """Return the mask of texels between two values of a coordinate.

    Args:
        t: points to paint.
        low, high: the two values.
        axis: axis of the coordinate: 0 is x, 1 is y, 2 is z.
        soft: width of the ramp at both edges.
    """
    return band_mask(t.xyz[:, axis], low, high, soft=soft)


@painter
def make_facing_mask(
    t: Texels,
    degrees: float,
    half_width: float,
    low: float,
    high: float,
    soft: float = 0.02,
) -> Array:
    """Return the mask of a label: texels between two heights that face an azimuth.

    Args:
        t: points to paint.
        degrees: azimuth about z of the middle of the label.
        half_width: how far it reaches to both sides, in degrees.
        low, high: heights.
        soft: width of the ramp at its lower and upper edge. At both sides the ramp is 2
            degrees wide.
    """
    weight = band_mask(t.xyz[:, 2], low, high, soft=soft)
    in_band = np.nonzero(weight)[0]
    angle = np.degrees(np.arctan2(t.xyz[in_band, 1], t.xyz[in_band, 0]))
    angle_distance = np.abs((angle - degrees + 180.0) % 360.0 - 180.0)
    weight[in_band] *= compute_soft_step(half_width - angle_distance, 0.0, soft=2.0)
    return weight


PAINT_KINDS = (
    "solid",
    "rings",
    "stripes",
    "checks",
    "dots",
    "zigzag",
    "mottled",
    "speckled",
    "gradient",
    "wood",
)
"""Kinds of paints that `sample_paint` samples."""


def sample_paint(sampler: ParameterSampler, size: float) -> Paint:
    """Sample a paint of any kind and colors.

    A model that is trained on objects with such paints cannot recognize their class by
    the texture alone.

    Args:
        sampler: sampler with a generator.
        size: approximate size of the object, which the patterns are scaled by.
    """
    # With `p_random` 1 it is any color, and "808080" is never used.
    a = sampler.sample_color("808080", p_random=1.0)
    b = sampler.sample_color("808080", p_random=1.0)
    cell = size * sampler(0.1, low=0.05, high=0.2)
    offset = sampler.sample_noise_offset()
    kind = sampler.sample_choice(*PAINT_KINDS)
    if kind in ("mottled", "speckled", "wood"):
        return _sample_irregular_paint(sampler, kind, a, b, cell, offset)
    if kind in ("rings", "gradient"):
        return _sample_paint_along_axis(sampler, kind, a, b, cell, size)
    if kind in ("stripes", "dots", "checks", "zigzag"):
        return _sample_chart_pattern(sampler, kind, a, b, cell)
    return paint_solid_color(a)


def _sample_chart_pattern(
    sampler: ParameterSampler, kind: str, a: Color, b: Color, cell: float
) -> Paint:
    """Sample a regular pattern of two colors in chart coordinates.

    Args:
        sampler: samples the proportions.
        kind: "stripes", "dots", "checks" or "zigzag".
        a, b: colors (3,).
        cell: width that the pattern is scaled by.
    """
    if kind == "stripes":
        fraction = sampler(0.5, low=0.2, high=0.8)
        slant = int(sampler.sample_choice(0, 1, 3))
        return stripes(a, b, cell=cell, fraction=fraction, slant=slant)
    if kind == "dots":
        radius = sampler(0.3, low=0.18, high=0.42)
        return dots(paint_solid_color(a), b, cell=cell, radius=radius)
    if kind == "checks":
        return checks(a, b, cell=cell)
    return zigzag(a, b, cell=cell)


def _sample_irregular_paint(
    sampler: ParameterSampler, kind: str, a: Color, b: Color, cell: float, offset: Array
) -> Paint:
    """Sample clouds or specks of two colors, or wood, which has a color of its own.

    Args:
        sampler: samples the proportions.
        kind: "mottled", "speckled" or "wood".
        a, b: colors (3,); wood does not use them.
        cell: width that the pattern is scaled by.
        offset: (3,) added to positions, so that instances differ.
    """
    if kind == "mottled":
        contrast = sampler(2.0, low=1.0, high=4.0)
        return paint_two_color_clouds(
            a, b, scale=1.5 * cell, offset=offset, contrast=contrast
        )
    if kind == "speckled":
        amount = sampler(0.2, low=0.1, high=0.4)
        return add_specks(
            paint_solid_color(a), b, scale=0.4 * cell, offset=offset, amount=amount
        )
    timber = sampler.sample_color("9a6a3c", "c89b62", "5b3a22")
    axis = int(sampler.sample_choice(0, 1, 2))
    return wood(timber, scale=0.5 * cell, offset=offset, axis=axis)


def _sample_paint_along_axis(
    sampler: ParameterSampler, kind: str, a: Color, b: Color, cell: float, size: float
) -> Paint:
    """Sample rings, or a gradient over the size of the instance, along an axis."""
    if kind == "rings":
        fraction = sampler(0.5, low=0.2, high=0.8)
        axis = int(sampler.sample_choice(0, 1, 2))
        return rings(a, b, period=cell, fraction=fraction, axis=axis)
    axis = int(sampler.sample_choice(0, 1, 2))
    return gradient(a, b, low=0.0, high=size, axis=axis)


def choose_paint_or_random(
    sampler: ParameterSampler, size: float, paint: Paint, p_random: float = 0.35
) -> Paint:
    """Return the paint, or with probability `p_random` a sample of `sample_paint`.

    The canonical instance has the paint.
    """
    return sample_paint(sampler, size) if sampler.sample_bool(p_random) else paint
