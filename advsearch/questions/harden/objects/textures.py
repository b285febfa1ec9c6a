"""Procedural base colours: small functions from surface points to display-referred
sRGB.

A `Paint` maps `Texels` to (N, 3) colours in [0, 1]. Painting in object coordinates
(`xyz`) makes patterns run on across the edges of charts; painting in chart coordinates
(`u`, `v` times `size`) suits patterns that should wrap around a part. Lengths are in
the object's units.
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

# ---- One way to write a family: each proportion and each colour is stated once, with
# what else it may be ------------

T = TypeVar("T")
Color = Array  # (3,) display-referred sRGB


def hexed(code: str) -> Color:
    """Return the colour written as six hexadecimal digits."""
    return np.array([int(code[i : i + 2], 16) / 255.0 for i in (0, 2, 4)])


@dataclass(frozen=True)
class Draw:
    """Draws an instance's proportions; without a generator, gives the canonical
    ones.
    """

    # the source of randomness, or None for the canonical instance
    rng: np.random.Generator | None

    def __call__(self, canonical: float, low: float, high: float) -> float:
        """Return a number uniform in [low, high], or the canonical one."""
        return canonical if self.rng is None else float(self.rng.uniform(low, high))

    def pick(self, canonical: T, *others: T) -> T:
        """Return one of the choices, all equally likely, or the canonical one."""
        choices = (canonical, *others)
        return (
            canonical
            if self.rng is None
            else choices[int(self.rng.integers(len(choices)))]
        )

    def chance(self, probability: float, canonical: bool = False) -> bool:
        """Return True with a probability, or the canonical one."""
        return canonical if self.rng is None else bool(self.rng.random() < probability)

    def offset(self) -> Array:
        """Return a (3,) shift into the noise, so that no two instances show the same
        clouds.
        """
        return (
            np.array([1.7, 9.2, 5.5])
            if self.rng is None
            else self.rng.uniform(0.0, 16.0, 3)
        )

    def colour(self, canonical: str, *others: str, wild: float = 0.4) -> Color:
        """Return the canonical colour; when drawing, one of those given, jittered, or
        with chance `wild` any colour.
        """
        rng = self.rng
        if rng is None:
            return hexed(canonical)
        if rng.random() < wild:
            return np.array(
                colorsys.hsv_to_rgb(
                    rng.random(), rng.random() ** 0.7, rng.uniform(0.15, 0.97)
                )
            )
        base = hexed(self.pick(canonical, *others))
        return np.clip(
            base * rng.uniform(0.85, 1.12) + rng.uniform(-0.05, 0.05, 3), 0.02, 0.98
        )


Options = ParamSpec("Options")


@dataclass(frozen=True, eq=False)
class Texels:
    """Points to colour: positions (N, 3), chart coordinates (N,) in [0, 1], and the
    chart's size in object units.
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
    """Make of a function of texels and options one of the options alone, which returns
    the paint (or the mask).
    """

    @wraps(paint)
    def with_options(*args: Options.args, **kwargs: Options.kwargs) -> Paint:
        return lambda t: paint(t, *args, **kwargs)

    return with_options


def shade(color: Color, factor: float) -> Color:
    """Return the colour made darker (factor below 1) or lighter (above 1), clipped to
    [0, 1].
    """
    return np.clip(color * factor, 0.0, 1.0)


_LATTICE = np.random.Generator(np.random.PCG64(20)).random((16, 16, 16))


def noise(points: Array) -> Array:
    """Value noise: (N, 3) points to (N,) values in [0, 1], smooth at a scale of 1,
    period 16 along each axis.
    """
    cell = np.floor(points)
    share = points - cell
    smooth = cell + share * share * (3.0 - 2.0 * share)
    return np.asarray(map_coordinates(_LATTICE, smooth.T, order=1, mode="grid-wrap"))


def mix(a: Array, b: Array, weight: Array) -> Array:
    """Blend colours (3,) or (N, 3) by (N,) weights: 0 gives a, 1 gives b."""
    return a + (b - a) * weight[:, None]


def within(value: Array, low: float, high: float, soft: float) -> Array:
    """Return 1 between two values and 0 outside, with ramps `soft` wide."""
    return step(value, low, soft) * step(-value, -high, soft)


def step(value: Array, edge: float, soft: float) -> Array:
    """Return 0 below the edge and 1 above it, with a ramp `soft` wide."""
    return np.clip((value - edge) / soft + 0.5, 0.0, 1.0)


@painter
def solid(t: Texels, color: Color | str) -> Array:
    """One colour."""
    return np.broadcast_to(
        hexed(color) if isinstance(color, str) else color, (len(t.u), 3)
    )


@painter
def mottled(
    t: Texels, a: Color, b: Color, scale: float, offset: Array, contrast: float = 2.0
) -> Array:
    """Clouds of two colours, `scale` wide."""
    at = t.xyz / scale + offset
    clouds = (noise(at) + noise(at * 2.0 + 5.3) * 0.5) / 1.5
    return mix(a, b, np.clip((clouds - 0.5) * contrast + 0.5, 0.0, 1.0))


def clouded(
    color: Color, factor: float, scale: float, offset: Array, contrast: float = 2.0
) -> Paint:
    """Clouds of a colour and a shade of it, `scale` wide."""
    return mottled(color, shade(color, factor), scale, offset, contrast)


def speckled(
    base: Paint, color: Color, scale: float, offset: Array, amount: float = 0.16
) -> Paint:
    """Small irregular specks on another paint; `amount` is about the share of the
    surface they cover.
    """
    return over(
        base,
        lambda t: step(noise(t.xyz / scale + offset), 1.0 - 1.1 * amount, 0.12),
        solid(color),
    )


@painter
def gradient(
    t: Texels, a: Color, b: Color, low: float, high: float, axis: int = 2
) -> Array:
    """From colour a at `low` to colour b at `high` along an axis."""
    return mix(a, b, np.clip((t.xyz[:, axis] - low) / (high - low), 0.0, 1.0))


@painter
def wood(
    t: Texels,
    color: Color,
    scale: float,
    offset: Array,
    axis: int = 2,
    contrast: float = 0.45,
) -> Array:
    """Wood with its grain along an axis: wobbling growth rings and fine fibres; rings
    are about `scale` apart.
    """
    stretch = np.full(3, 1.0 / scale)
    stretch[axis] = 0.12 / scale
    p = t.xyz * stretch + offset
    across = [i for i in range(3) if i != axis]
    ring = p[:, across[0]] + 0.6 * p[:, across[1]] + 1.6 * noise(p * 0.45)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * ring * 0.8)
    fibre = noise(p * np.where(np.arange(3) == axis, 1.0, 4.0))
    grain = contrast * (0.55 * rings**2 + 0.45 * fibre)
    return np.asarray(np.clip(color * (1.0 - grain)[:, None] * 1.12, 0.0, 1.0))


@painter
def rings(
    t: Texels, a: Color, b: Color, period: float, share: float = 0.5, axis: int = 2
) -> Array:
    """Stripes across an axis; colour b takes `share` of every period."""
    return mix(
        a, b, step(share / 2 - np.abs(t.xyz[:, axis] / period % 1.0 - 0.5), 0.0, 0.06)
    )


def _cells(t: Texels, cell: float) -> tuple[Array, Array]:
    """Chart coordinates counted in cells about `cell` wide, a whole number of them
    across the chart.
    """
    return t.u * max(1, round(t.size[0] / cell)), t.v * max(1, round(t.size[1] / cell))


@painter
def stripes(
    t: Texels, a: Color, b: Color, cell: float, share: float = 0.5, slant: int = 0
) -> Array:
    """Stripes up the chart, `cell` apart; `slant` cells of shift from bottom to top."""
    across, _ = _cells(t, cell)
    return mix(
        a, b, step(share / 2 - np.abs((across + slant * t.v) % 1.0 - 0.5), 0.0, 0.08)
    )


@painter
def checks(t: Texels, a: Color, b: Color, cell: float) -> Array:
    """A chequer board with squares `cell` wide."""
    across, up = _cells(t, 2 * cell)
    return mix(a, b, (np.floor(2 * across) + np.floor(2 * up)) % 2.0)


def dots(base: Paint, color: Color, cell: float, radius: float = 0.3) -> Paint:
    """Round dots in staggered rows on another paint; radius in cells."""

    def staggered(t: Texels) -> Array:
        across, up = _cells(t, cell)
        across = across + 0.5 * (np.floor(up) % 2.0)
        return step(radius - np.hypot(across % 1.0 - 0.5, up % 1.0 - 0.5), 0.0, 0.1)

    return over(base, staggered, solid(color))


@painter
def zigzag(t: Texels, a: Color, b: Color, cell: float) -> Array:
    """Chevrons running around the chart, `cell` high."""
    across, up = _cells(t, cell)
    return mix(
        a,
        b,
        step(0.25 - np.abs((up + np.abs(across % 1.0 - 0.5)) % 1.0 - 0.5), 0.0, 0.1),
    )


@painter
def over(t: Texels, base: Paint, mask: Mask, top: Paint) -> Array:
    """One paint over another, where the mask is above 0."""
    weight = mask(t)
    near = np.nonzero(weight)[0]
    color = np.array(base(t))
    if len(near):
        part = Texels(t.xyz[near], t.u[near], t.v[near], t.size)
        color[near] = mix(color[near], top(part), weight[near])
    return color


@painter
def between(
    t: Texels, low: float, high: float, axis: int = 2, soft: float = 0.02
) -> Array:
    """1 where a coordinate lies between two values; the edges are `soft` wide, in
    object units.
    """
    return within(t.xyz[:, axis], low, high, soft)


@painter
def facing(
    t: Texels,
    degrees: float,
    half_width: float,
    low: float,
    high: float,
    soft: float = 0.02,
) -> Array:
    """1 on a label: within `half_width` degrees of the azimuth `degrees` about z, and
    between two heights.
    """
    weight = within(t.xyz[:, 2], low, high, soft)
    near = np.nonzero(weight)[0]
    angle = np.degrees(np.arctan2(t.xyz[near, 1], t.xyz[near, 0]))
    away = np.abs((angle - degrees + 180.0) % 360.0 - 180.0)
    weight[near] *= step(half_width - away, 0.0, 2.0)
    return weight


def anything(draw: Draw, size: float) -> Paint:
    """A paint of any kind in any colours, for instances whose texture says nothing
    about their class, and which are about so large; `draw` must hold a generator.
    """
    a = draw.colour("808080", wild=1.0)
    b = draw.colour("808080", wild=1.0)
    cell = size * draw(0.1, 0.05, 0.2)
    at = draw.offset()
    kind = draw.pick(
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
    if kind == "rings":
        return rings(a, b, cell, draw(0.5, 0.2, 0.8), axis=int(draw.pick(0, 1, 2)))
    if kind == "stripes":
        return stripes(a, b, cell, draw(0.5, 0.2, 0.8), int(draw.pick(0, 1, 3)))
    if kind == "checks":
        return checks(a, b, cell)
    if kind == "dots":
        return dots(solid(a), b, cell, draw(0.3, 0.18, 0.42))
    if kind == "zigzag":
        return zigzag(a, b, cell)
    if kind == "mottled":
        return mottled(a, b, 1.5 * cell, at, draw(2.0, 1.0, 4.0))
    if kind == "speckled":
        return speckled(solid(a), b, 0.4 * cell, at, draw(0.2, 0.1, 0.4))
    if kind == "gradient":
        return gradient(a, b, 0.0, size, axis=int(draw.pick(0, 1, 2)))
    if kind == "wood":
        return wood(
            draw.colour("9a6a3c", "c89b62", "5b3a22"),
            0.5 * cell,
            at,
            axis=int(draw.pick(0, 1, 2)),
        )
    return solid(a)


def natural(draw: Draw, size: float, paint: Paint, wild: float = 0.35) -> Paint:
    """Return the paint, or when drawing, with chance `wild`, one of `anything` in its
    place.
    """
    return anything(draw, size) if draw.chance(wild) else paint
