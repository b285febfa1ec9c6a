"""Norms of the balls in which searched pixels stay, and the radii of these."""

from __future__ import annotations

import math

DEFAULT_EPSILON = 0.1
"""Default radius of the L-infinity ball; the default L2 ball has the same
root-mean-square change at its edge.
"""
NORMS = ("linf", "l2")


def radius(
    norm: str, epsilon: float | None, count: int, default: float = DEFAULT_EPSILON
) -> float:
    """Return the radius of a ball over `count` colors, the default where none is given:
    in an L2 ball so large that its edge has the same root-mean-square.
    """
    if epsilon is not None:
        return float(epsilon)
    return default * (math.sqrt(count) if norm == "l2" else 1.0)
