"""Plane and space curves from which the bundled objects are made. Float64; lengths in the object's units."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def unit(vectors: Array) -> Array:
    """Return vectors (..., 3) or (..., 2) scaled to length one; zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def rotation(axis: str, degrees: float) -> Array:
    """Return the (3, 3) right-handed rotation about the axis "x", "y" or "z" by an angle in degrees."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = c
    turn[i, j], turn[j, i] = -s, s
    return turn


def spline(points: Sequence[Sequence[float]] | Array, count: int) -> Array:
    """Return `count` points of the Catmull-Rom curve (chord-length knots) through (K, D) points, ends included."""
    knots = np.asarray(points, dtype=np.float64)
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
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


def rounded(corners: Sequence[Sequence[float]] | Array, radius: float | Sequence[float], steps: int = 5) -> Array:
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


def dense(curve: Array, longest: float) -> Array:
    """Return the polyline with edges longer than `longest` cut into equal pieces."""
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
