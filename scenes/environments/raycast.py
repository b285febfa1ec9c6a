"""A very small ray caster: rooms of quads, boxes and spheres, lit by their glowing
quads and spheres without shadows.

The viewer stands at the origin, about at table height; z is up, lengths are metres.
Light that has bounced more than once is a constant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .panorama import Array

# (s, t in [-1, 1], points (N, 3)) -> (N, 3) albedo or radiance
Surface = Callable[[Array, Array, Array], Array]
FAR = 1e9
BLOCK = 8192


def even(r: float, g: float, b: float) -> Surface:
    """One colour everywhere, linear."""
    color = np.array([r, g, b])
    return lambda s, t, p: np.broadcast_to(color, (len(s), 3))


GREY = even(0.5, 0.5, 0.5)


@dataclass(frozen=True, eq=False)
class Quad:
    """A rectangle: its middle, two half-edges, what it reflects and what it emits. Both
    sides look alike.
    """

    centre: Sequence[float]
    half_u: Sequence[float]
    half_v: Sequence[float]
    albedo: Surface = GREY
    glow: Surface | None = None


@dataclass(frozen=True, eq=False)
class Block:
    """An axis-aligned box between two corners, of one albedo."""

    low: Sequence[float]
    high: Sequence[float]
    albedo: Surface = GREY


@dataclass(frozen=True, eq=False)
class Globe:
    """A sphere of one albedo and, when glowing, one radiance."""

    centre: Sequence[float]
    radius: float
    albedo: Surface = GREY
    glow: Surface | None = None


@dataclass(frozen=True, eq=False)
class Hit:
    """Where rays meet a shape: distance (N,) (FAR where they do not), normal (N, 3),
    surface coordinates (N,).
    """

    distance: Array
    normal: Array
    s: Array
    t: Array


def room(
    low: Sequence[float],
    high: Sequence[float],
    walls: Surface,
    floor: Surface,
    ceiling: Surface,
) -> list[Quad]:
    """The six inner faces of a box; s runs along the wall, t up."""
    (x0, y0, z0) = low
    (x1, y1, z1) = high
    cx = (x0 + x1) / 2
    cy = (y0 + y1) / 2
    cz = (z0 + z1) / 2
    hx = (x1 - x0) / 2
    hy = (y1 - y0) / 2
    hz = (z1 - z0) / 2
    return [
        Quad((x1, cy, cz), (0, hy, 0), (0, 0, hz), walls),
        Quad((x0, cy, cz), (0, hy, 0), (0, 0, hz), walls),
        Quad((cx, y1, cz), (hx, 0, 0), (0, 0, hz), walls),
        Quad((cx, y0, cz), (hx, 0, 0), (0, 0, hz), walls),
        Quad((cx, cy, z0), (hx, 0, 0), (0, hy, 0), floor),
        Quad((cx, cy, z1), (hx, 0, 0), (0, hy, 0), ceiling),
    ]


def _meet(shape: Quad | Block | Globe, rays: Array) -> Hit:
    """Where rays from the origin meet a shape."""
    if isinstance(shape, Quad):
        return _quad(shape, rays)
    return _block(shape, rays) if isinstance(shape, Block) else _globe(shape, rays)


def _quad(shape: Quad, rays: Array) -> Hit:
    c, u, v = (
        np.asarray(a, dtype=np.float64)
        for a in (shape.centre, shape.half_u, shape.half_v)
    )
    normal = np.cross(u, v)
    normal = normal / np.linalg.norm(normal)
    slope = rays @ normal
    distance = np.where(
        np.abs(slope) > 1e-9,
        (c @ normal) / np.where(np.abs(slope) > 1e-9, slope, 1.0),
        FAR,
    )
    away = rays * np.minimum(distance, 1e6)[:, None] - c
    s = away @ u / (u @ u)
    t = away @ v / (v @ v)
    met = (distance > 1e-6) & (np.abs(s) <= 1.0) & (np.abs(t) <= 1.0)
    return Hit(np.where(met, distance, FAR), -np.sign(slope)[:, None] * normal, s, t)


def _block(shape: Block, rays: Array) -> Hit:
    low = np.asarray(shape.low, dtype=np.float64)
    high = np.asarray(shape.high, dtype=np.float64)
    inverse = 1.0 / np.where(np.abs(rays) > 1e-12, rays, 1e-12)
    a = low * inverse
    b = high * inverse
    near = np.minimum(a, b)
    far = np.maximum(a, b)
    axis = np.argmax(near, axis=1)
    enter = near.max(axis=1)
    leave = far.min(axis=1)
    met = (enter > 1e-6) & (enter < leave)
    normal = -np.sign(np.take_along_axis(rays, axis[:, None], axis=1)) * np.eye(3)[axis]
    zero = np.zeros(len(rays))
    return Hit(np.where(met, enter, FAR), normal, zero, zero)


def _globe(shape: Globe, rays: Array) -> Hit:
    c = np.asarray(shape.centre, dtype=np.float64)
    along = rays @ c
    inside = along**2 - c @ c + shape.radius**2
    distance = along - np.sqrt(np.maximum(inside, 0.0))
    met = (inside > 0.0) & (distance > 1e-6)
    zero = np.zeros(len(rays))
    return Hit(
        np.where(met, distance, FAR),
        (rays * distance[:, None] - c) / shape.radius,
        zero,
        zero,
    )


def _lamps(
    shapes: Sequence[Quad | Block | Globe],
) -> list[tuple[Array, Array | None, Array]]:
    """Sample points of everything that glows: (K, 3) places, their normal (None: all
    round) and (K, 3) power.
    """
    grid = np.array([-0.5, 0.5])
    s, t = (a.ravel() for a in np.meshgrid(grid, grid))
    found: list[tuple[Array, Array | None, Array]] = []
    for shape in shapes:
        if isinstance(shape, Quad) and shape.glow is not None:
            u = np.asarray(shape.half_u, dtype=np.float64)
            v = np.asarray(shape.half_v, dtype=np.float64)
            points = np.asarray(shape.centre) + s[:, None] * u + t[:, None] * v
            cross = np.cross(u, v)
            area = 4 * float(np.linalg.norm(cross))
            found.append(
                (
                    points,
                    cross / np.linalg.norm(cross),
                    shape.glow(s, t, points) * (area / len(s)),
                )
            )
        elif isinstance(shape, Globe) and shape.glow is not None:
            centre = np.asarray(shape.centre, dtype=np.float64)[None]
            found.append(
                (
                    centre,
                    None,
                    shape.glow(np.zeros(1), np.zeros(1), centre)
                    * (np.pi * shape.radius**2),
                )
            )
    return found


def _lit(
    points: Array,
    normals: Array,
    lamps: Sequence[tuple[Array, Array | None, Array]],
    ambient: Array,
) -> Array:
    """Irradiance (N, 3) at surface points, without shadows."""
    total: Array = np.broadcast_to(ambient, (len(points), 3)).copy()
    reach = (points**2).sum(axis=1)[:, None]
    lean = (points * normals).sum(axis=1)[:, None]
    for places, facing, power in lamps:
        square = np.maximum(
            reach - 2.0 * points @ places.T + (places**2).sum(axis=1), 0.04
        )
        received = np.maximum(normals @ places.T - lean, 0.0)
        weight = received / (square * np.sqrt(square))
        if facing is not None:
            weight *= np.abs(places @ facing - (points @ facing)[:, None]) / np.sqrt(
                square
            )
        total += weight @ power
    return total


def cast(
    rays: Array, shapes: Sequence[Quad | Block | Globe], ambient: Sequence[float]
) -> Array:
    """Return the (N, 3) linear radiance that arrives at the origin against unit
    directions (N, 3).

    Args:
        rays: unit directions.
        shapes: the room; it should be closed, what is not hit is black.
        ambient: irradiance added everywhere, for light that bounced more than once.
    """
    lamps = _lamps(shapes)
    light = np.asarray(ambient, dtype=np.float64)
    blocks = [rays[at : at + BLOCK] for at in range(0, len(rays), BLOCK)]
    return np.concatenate([_cast(block, shapes, lamps, light) for block in blocks])


def _cast(
    rays: Array,
    shapes: Sequence[Quad | Block | Globe],
    lamps: Sequence[tuple[Array, Array | None, Array]],
    ambient: Array,
) -> Array:
    """`cast` for a few thousand rays, whose intermediate results fit the processor's
    cache.
    """
    best = np.full(len(rays), FAR)
    radiance = np.zeros((len(rays), 3))
    albedo = np.zeros((len(rays), 3))
    normals = np.zeros((len(rays), 3))
    for shape in shapes:
        hit = _meet(shape, rays)
        near = np.nonzero(hit.distance < best - 1e-6)[0]
        if not len(near):
            continue
        best[near] = hit.distance[near]
        points = rays[near] * best[near, None]
        glow = None if isinstance(shape, Block) else shape.glow
        normals[near] = hit.normal[near]
        albedo[near] = (
            0.0 if glow is not None else shape.albedo(hit.s[near], hit.t[near], points)
        )
        radiance[near] = (
            glow(hit.s[near], hit.t[near], points) if glow is not None else 0.0
        )
    dull = np.nonzero((albedo > 0.0).any(axis=1))[0]
    points = rays[dull] * best[dull, None]
    radiance[dull] = albedo[dull] * _lit(points, normals[dull], lamps, ambient) / np.pi
    return radiance
