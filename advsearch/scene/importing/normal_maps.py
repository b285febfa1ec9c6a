"""Normal maps in tangent space: what pictures say.

A texel is `(n + 1) / 2` with n the unit normal in the frame (tangent, bitangent, normal) of the surface: the tangent
runs along u, and the bitangent up the picture (glTF 2.0, section 3.9.3; others call that OpenGL's convention).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]

FLAT = np.array([0.5, 0.5, 1.0], np.float32)
"""The texel of a normal map that changes nothing."""
LARGEST_SCALE = 100.0
"""Larger factors of x and y make no visible difference."""
LOWEST = 0.01
"""Least z of a normal before it is scaled to length 1: it points out of the surface."""
BLUE = 0.1
"""How much bluer than red a normal map is, on average; a grey map of heights is not."""
LENGTH, MOSTLY = 0.2, 0.9
"""By how much the length of a normal in a picture is off 1 at most, and of what share of the texels that is asked."""


def normal_map(picture: Floats, scale: float = 1.0) -> Floats:
    """Return a normal map (H, W, 3) with unit normals that point out of the surface.

    Args:
        picture: (H, W, 3) in [0, 1], its values as they are in the file.
        scale: factor of x and y, finite.
    """
    factor = min(max(scale, -LARGEST_SCALE), LARGEST_SCALE)
    normals = picture * 2.0 - 1.0
    normals[..., :2] *= factor
    normals[..., 2] = np.maximum(normals[..., 2], LOWEST)
    return texels_of(normals)


def holds_normals(picture: Floats) -> bool:
    """Tell whether a picture (H, W, 3) holds normals, and not heights, which are grey."""
    off = np.abs(np.linalg.norm(picture * 2.0 - 1.0, axis=2) - 1.0)
    blue = float((picture[..., 2] - picture[..., 0]).mean(dtype=np.float64))
    return blue > BLUE and bool((off < LENGTH).mean() > MOSTLY)


def texels_of(normals: npt.NDArray[np.floating]) -> Floats:
    """Return normals (..., 3) of any length as texels."""
    unit = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return np.asarray(unit * 0.5 + 0.5, dtype=np.float32)
