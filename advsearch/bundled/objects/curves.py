"""Plane and space curves from which the bundled objects are made. Float64; lengths in the object's units."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, pairwise
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]
Points: TypeAlias = Array | Sequence[Sequence[float] | Array]


def unit(vectors: Array) -> Array:
    """Return vectors (..., 3) or (..., 2) scaled to length one; zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def at_height(profile: Array, height: float) -> float:
    """Return how far from the axis a profile (K, 2) of points (r, z) with rising z is at a height."""
    return float(np.interp(height, profile[:, 1], profile[:, 0]))


def lengths(curve: Array) -> Array:
    """Return how far along a polyline (K, D) its points are: (K,), from 0."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])


def away_from(x: Array, y: Array, *paths: Points) -> Array:
    """Return how far points (N,) are from the nearest of some polylines (K, 2)."""
    away = np.full(len(x), np.inf)
    for (x0, y0), (x1, y1) in chain.from_iterable(map(pairwise, paths)):
        dx, dy = x1 - x0, y1 - y0
        t = np.clip(((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        away = np.minimum(away, np.hypot(x - x0 - t * dx, y - y0 - t * dy))
    return away


def upright(curve: Array) -> Array:
    """Return a plane curve (K, 2) as one (K, 3) in the plane of x and z."""
    return np.insert(curve, 1, 0.0, axis=1)


def rotation(axis: str, degrees: float) -> Array:
    """Return the (3, 3) right-handed rotation about the axis "x", "y" or "z" by an angle in degrees."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = c
    turn[i, j], turn[j, i] = -s, s
    return turn


def spline(points: Points, count: int) -> Array:
    """Return `count` points of the Catmull-Rom curve (chord-length knots) through (K, D) points, ends included."""
    knots = np.asarray(points, dtype=np.float64)
    at = lengths(knots)
    slope = np.gradient(knots, at, axis=0)
    t = np.linspace(0.0, at[-1], count)
    i = np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(knots) - 2)
    span = (at[i + 1] - at[i])[:, None]
    x = (t - at[i])[:, None] / span
    start, end = knots[i], knots[i + 1]
    first, last = slope[i] * span, slope[i + 1] * span
    turn = 2 * start - 2 * end + first + last
    curve: Array = ((turn * x + (3 * end - 3 * start - 2 * first - last)) * x + first) * x + start
    return curve


def rounded(corners: Points, radius: float | Sequence[float], steps: int = 5) -> Array:
    """Return the open polyline (K, D) with its inner corners rounded off.

    Args:
        corners: the polyline.
        radius: how far from each inner corner the rounding starts, one number or K - 2 of them; at most half an edge.
        steps: edges per rounding.
    """
    points = np.asarray(corners, dtype=np.float64)
    radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), (max(len(points) - 2, 0),))
    out = [points[0]]
    for before, corner, after, wanted in zip(points, points[1:], points[2:], radii, strict=False):
        a, b = before - corner, after - corner
        reach = min(float(wanted), 0.499 * float(np.linalg.norm(a)), 0.499 * float(np.linalg.norm(b)))
        if reach <= 1e-9:
            out.append(corner)
            continue
        p, q = corner + unit(a) * reach, corner + unit(b) * reach
        t = np.linspace(0.0, 1.0, steps + 1)[:, None]
        out.extend((1 - t) ** 2 * p + 2 * t * (1 - t) * corner + t**2 * q)
    out.append(points[-1])
    return np.array(out)


def dense(points: Points, longest: float) -> Array:
    """Return the polyline with edges longer than `longest` cut into equal pieces."""
    curve = np.asarray(points, dtype=np.float64)
    out = [curve[:1]]
    for a, b in pairwise(curve):
        pieces = max(1, int(np.ceil(round(float(np.linalg.norm(b - a)) / longest, 6))))
        out.append(a + (b - a) * (np.arange(1, pieces + 1) / pieces)[:, None])
    return np.concatenate(out)


def polygon(sides: int, bevel: float = 0.12, steps: int = 2) -> Array:
    """Return a regular polygon of circumradius 1, a flat side down, corners rounded: a closed section (M, 2)."""
    angle = 2 * np.pi * (np.arange(sides + 2) - 0.5) / sides - np.pi / 2
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return rounded(ring, bevel, steps)[1:-1]


def rectangle(width: float, height: float, bevel: float, steps: int = 3) -> Array:
    """Return a rounded rectangle, centred, counter-clockwise, as a closed section (M, 2)."""
    w, h = width / 2, height / 2
    corners = [(w, -h), (w, h), (-w, h), (-w, -h), (w, -h), (w, h)]
    return rounded(corners, bevel, steps)[1:-1]


def ellipse(width: float, height: float, count: int = 20) -> Array:
    """Return an ellipse with the given half-axes, counter-clockwise, as a closed section (count, 2)."""
    t = 2 * np.pi * np.arange(count) / count
    return np.stack([width * np.cos(t), height * np.sin(t)], axis=1)
