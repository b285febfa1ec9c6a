"""Raindrops on a sheet of glass before the camera: small lenses through which rays are refracted.

A drop is a spherical cap of water on the outer side of the sheet. A ray that leaves the camera in the direction d meets
the sheet at a distance of D, shifted by its place in the aperture (the camera is focused far away, so that drops are
blurred as in a photograph), is refracted into the water (Snell's law; the sheet itself is plane and changes no
direction), and out of it at the cap, or is lost where it would be reflected there. Where caps overlap, the higher one
counts. The light that passes is Fresnel's, unpolarised (Born and Wolf, Principles of Optics, section 1.5).

Only directions change: the scene is taken to be far away compared to the sheet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from advsearch.scene.assets import Floats, Ints

WATER = 1.33
"""Index of refraction."""
DISTANCE, APERTURE = 60.0, 1.0
"""Of the sheet from the camera, and radius of the camera's aperture, millimetres."""
CONTACT = (25.0, 42.0)
"""Angles between a drop's surface and the glass at its rim, degrees."""
SPREAD = 0.45
"""Of the logarithm of radii."""
BEYOND = 1.1
"""How far over the edge of the picture the drops go, in half widths."""
GRID = 1024
"""Along a side of the grid that says which drop is where."""


@dataclass(frozen=True, eq=False)
class Raindrops:
    """Drops on a square of the sheet, in millimetres from where the camera looks.

    Attributes:
        half: half a side of the square.
        drops: (N, 4) float32, of each the x and y of its middle, its radius on the sheet and that of its curvature.
        grid: (GRID, GRID) number of the drop that is highest in the middle of each cell, rows along y; N for none.
    """

    half: float
    drops: Floats
    grid: Ints


def raindrops(count: int, size: float, seed: int, tangent: float) -> Raindrops:
    """Return `count` drops, with a median radius of `size` millimetres, for a camera with the tangent of half its field
    of view along the larger side; the seed says where they are, and how large."""
    random, half = np.random.default_rng(seed), BEYOND * DISTANCE * tangent
    places = random.uniform(-half, half, (count, 2))
    radii = size * np.exp(SPREAD * random.standard_normal(count).clip(-2.5, 2.5))
    curvature = radii / np.sin(np.radians(random.uniform(*CONTACT, count)))
    at = (np.arange(GRID) + 0.5) / GRID * 2.0 * half - half
    grid, height = np.full((GRID, GRID), count), np.zeros((GRID, GRID))
    for number, ((x, y), radius, curve) in enumerate(zip(places, radii, curvature, strict=True)):
        rows, columns = (np.flatnonzero(np.abs(at - middle) <= radius) for middle in (y, x))
        away = (at[rows] - y)[:, None] ** 2 + (at[columns] - x)[None] ** 2
        tall = np.sqrt(np.maximum(curve**2 - away, 0.0)) - math.sqrt(curve**2 - radius**2)
        place = np.ix_(rows, columns)
        above = (away < radius**2) & (tall > height[place])
        grid[place] = np.where(above, number, grid[place])
        height[place] = np.where(above, tall, height[place])
    return Raindrops(half, np.column_stack([places, radii, curvature]).astype(np.float32), grid)
