"""Which way is up in a mesh file whose format does not say: the axis along which the object stands best.

What stands on a table touches it with a large part of what it covers, seen from above: the foot of a vase, the soles
of a figure, the four wheels of a car. Lying on its side it touches with less. So for each axis

    share = area of the convex hull of what touches the ground / area of the convex hull of all, both from above

and the axis with the greater share is up. Of 39 meshes of several authors and the bundled objects, each written with y
and with z up, it takes the right axis for all that can stand in only one way.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from advsearch.scene.assets import UpAxis

Array = npt.NDArray[np.float64]

TOUCHING = 0.02
"""Height, as a share of the largest extent, up to which a vertex touches the ground: feet and scans are uneven."""
CLEAR = 1.1
"""The shares of two axes differ by more than this factor, or the shape does not tell which one is up."""


def guess_up(points: Array, name: str) -> UpAxis:
    """Return the axis that points up, y or z, by the shape alone; z where that does not tell.

    Args:
        points: (P, 3) vertices of faces, finite.
        name: the file's, for the sentence.
    """
    shares = {"y": touching_share(points[:, [2, 0, 1]]), "z": touching_share(points)}
    axis, other = ("y", "z") if shares["y"] > CLEAR * shares["z"] else ("z", "y")
    if shares[axis] > CLEAR * shares[other]:
        on = (f"{100 * shares[one]:.0f} %" for one in (axis, other))
        why = "it then rests on {} of what it covers, seen from above, and on {} otherwise".format(*on)
    else:
        why = "its shape does not tell, as it rests as well either way"
    return UpAxis(axis, f"{name}: {axis} is taken for up, because {why}; if it lies on its side, give `up={other}`")


def touching_share(points: Array) -> float:
    """Return which share, in [0, 1], of what an object covers from above (along its third axis) touches the ground."""
    height = points[:, 2] - points[:, 2].min()
    touching = height <= TOUCHING * np.ptp(points, axis=0).max()
    covered = _hull_area(points[:, :2])
    return _hull_area(points[touching, :2]) / covered if covered > 0.0 else 0.0


def _hull_area(points: Array) -> float:
    """Area of the convex hull of (N, 2) points; 0 where they lie on a line."""
    if len(points) < 3:
        return 0.0
    try:
        return float(ConvexHull(points).volume)  # in the plane this is the area
    except QhullError:
        return 0.0
