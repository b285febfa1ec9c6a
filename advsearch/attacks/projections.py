"""Euclidean projections onto a norm ball cut by a box. Pure functions; no copy is made of what need not change."""

from __future__ import annotations

import math

import torch
from torch import Tensor

CHUNK = 32768
"""Elements worked on at once: small enough for a core's cache, and torch uses one thread below it."""

SLACK = 1e-6
"""A norm at most this fraction over the radius counts as inside, so that projecting twice changes nothing."""

_MAX_ITERATIONS = 100


def project_l2_box(u: Tensor, centre: Tensor, radius: float, low: float = 0.0, high: float = 1.0) -> Tensor:
    """Project onto the intersection of an l2 ball and a box.

    The result is the one nearest point, argmin_p ||p - u|| subject to ||p - centre|| <= radius and low <= p <= high.
    Clipping and then rescaling is not that point, and for a box that cuts deep it is far from it.

    The optimality conditions give p(t) = clip(centre + t (u - centre), low, high) with one multiplier t in (0, 1],
    t = 1 if p(1) lies in the ball. Otherwise t solves ||p(t) - centre|| = radius. In s = t^2 the squared norm is

        g(s) = sum_i min(s v_i^2, room_i^2),     v = u - centre, room_i = distance to the bound that v_i points at,

    concave, increasing and piecewise linear, so Newton's method from the left never overshoots and stops at the exact
    root after finitely many steps (two to six in practice). It is the scheme known from continuous quadratic knapsack
    problems (Cominetti, Mascarenhas, Silva 2014, "A Newton's method for the continuous quadratic knapsack problem").

    Args:
        u: (d,) float32, finite.
        centre: (d,) float32 inside the box.
        radius: radius of the ball, over 0.
        low, high: the box's bounds.

    Returns:
        (d,) float32. Points inside come back bit for bit; projecting again changes at most the last bits.
    """
    squares, rooms = [], []
    full = inside = 0.0
    for part, middle in zip(torch.split(u, CHUNK), torch.split(centre, CHUNK), strict=True):
        squares.append((part - middle).square_())
        rooms.append(part.clamp(low, high).sub_(middle).square_())
        full += float(squares[-1].sum())
        inside += float(rooms[-1].sum())
    if inside <= (radius * (1.0 + SLACK)) ** 2:
        return u.clamp(low, high)
    t = math.sqrt(_multiplier(squares, rooms, radius**2, radius**2 / full))
    projected = torch.empty_like(u)
    for out, part, middle in zip(
        torch.split(projected, CHUNK), torch.split(u, CHUNK), torch.split(centre, CHUNK), strict=True
    ):
        torch.lerp(middle, part, t, out=out).clamp_(low, high)
    return projected


def _multiplier(squares: list[Tensor], rooms: list[Tensor], target: float, s: float) -> float:
    """Solve sum_i min(s squares_i, rooms_i) = target for s by Newton's method, from an s that is not too large."""
    for _ in range(_MAX_ITERATIONS):
        value = slope = 0.0
        for square, room in zip(squares, rooms, strict=True):
            scaled = square * s
            slope += float(torch.dot(square, (scaled < room).to(square.dtype)))
            value += float(torch.minimum(scaled, room).sum())
        better = s + (target - value) / slope if slope > 0.0 else s
        if better <= s * (1.0 + 1e-7):
            break
        s = better
    return s
