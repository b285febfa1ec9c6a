"""Norms and default radii of the balls that limit searched pixels."""

from __future__ import annotations

import math

DEFAULT_EPSILON = 0.1
"""Default radius of the L-infinity ball. A change at the edge of the default L2 ball has
this root mean square.
"""
NORMS = ("linf", "l2")


def compute_default_radius(
    norm: str, count: int, radius: float = DEFAULT_EPSILON
) -> float:
    """Return the default radius of a ball in a norm.

    A change at the edge of the L2 ball has the root mean square `radius`.

    Args:
        norm: "linf" or "l2".
        count: number of values, e.g. three for each pixel.
        radius: radius of the L-infinity ball.
    """
    return radius * (math.sqrt(count) if norm == "l2" else 1.0)
