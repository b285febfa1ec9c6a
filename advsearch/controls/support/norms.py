"""Norms of the balls in which searched pixels stay, and the radii of these."""

from __future__ import annotations

import math

DEFAULT_EPSILON = 0.1
"""Default radius of the L-infinity ball; the default L2 ball has the same
root-mean-square change at its edge.
"""
NORMS = ("linf", "l2")


def compute_default_radius(
    norm: str, count: int, radius: float = DEFAULT_EPSILON
) -> float:
    """Return the radius of a ball over `count` colors where none is stated.

    `radius` is that of the L-infinity ball; the L2 ball is so large that its edge has
    the same root mean square.
    """
    return radius * (math.sqrt(count) if norm == "l2" else 1.0)
