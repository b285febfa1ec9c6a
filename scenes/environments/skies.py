"""Outdoor environments: an overcast sky, and two clear ones baked from Mitsuba's
`sunsky` emitter.

The clear skies are Mitsuba's (Hosek and Wilkie 2012, 2013): their radiance is read on a
coarse grid, rounded to three digits and interpolated, which loses nothing of so smooth
a function and makes the bake independent of the machine's last bits. The sun is not
smooth: half a degree wide and thousands of times brighter than the sky, it would cost
low sample counts dearly. Its irradiance, integrated from the same emitter, is therefore
spread over a spot about `SUN_WIDTH` degrees wide, and shadows are as soft as that.
Below the horizon lies a plain field, lit by that sky.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from .panorama import Array, EnvironmentFamily

SUN_WIDTH = 3.0  # degrees, the spot's standard deviation
ROWS = 24  # of the grid on which the clear sky is read
COLUMNS = 64
TURBIDITY = 3.0


def _ground(rays: Array, color: tuple[float, float, float], level: Array) -> Array:
    """A field with darker patches and a lighter band towards the horizon, as
    radiance.
    """
    depth = np.maximum(-rays[:, 2], 1e-3)
    x = rays[:, 0] / depth
    y = rays[:, 1] / depth
    patch = 0.9 + 0.1 * np.sin(1.3 * x + np.sin(0.9 * y)) * np.sin(
        1.1 * y + 2.0 * np.sin(0.5 * x)
    ) * np.minimum(1.0, 6.0 * depth)
    haze = np.exp(-depth / 0.05)[:, None]
    field = np.array(color) * patch[:, None]
    seen: Array = level * (field * (1.0 - haze) + np.array([0.3, 0.33, 0.36]) * haze)
    return seen


def _skyline(rays: Array) -> Array:
    """Elevation sine of low wooded hills around the horizon."""
    a = np.arctan2(rays[:, 1], rays[:, 0])
    return (
        0.035
        + 0.018 * np.sin(3.0 * a + 1.0)
        + 0.012 * np.sin(7.0 * a)
        + 0.006 * np.sin(23.0 * a)
        + 0.004 * np.sin(61.0 * a)
    )


def _landscape(rays: Array, sky: Array, level: Array) -> Array:
    """The sky above, wooded hills at the horizon, a field below; `level` is the (3,)
    irradiance over pi.
    """
    field = _ground(rays, (0.24, 0.23, 0.15), level)
    hills = (
        np.array([0.05, 0.075, 0.045])
        * level
        * (1.0 + 4.0 * np.clip(rays[:, 2:], 0.0, 0.1))
    )
    return np.where(
        (rays[:, 2] > _skyline(rays))[:, None],
        sky,
        np.where((rays[:, 2] > 0.0)[:, None], hills, field),
    )


def overcast(rays: Array) -> Array:
    """The CIE standard overcast sky, three times brighter at the zenith than at the
    horizon, with soft clouds.
    """
    up = np.clip(rays[:, 2], 0.0, 1.0)
    x = rays[:, 0] / (up + 0.35)
    y = rays[:, 1] / (up + 0.35)
    cloud = np.sin(2.1 * x + 1.3 * np.sin(1.7 * y)) * np.sin(
        1.9 * y + 1.1 * np.sin(2.3 * x + 1.0)
    ) + 0.5 * np.sin(4.3 * x - 3.1 * y)
    veil = (1.0 + 2.0 * up) / 3.0 * (1.0 + 0.13 * cloud)
    sun = np.maximum(rays @ np.array([0.55, -0.2, 0.81]), 0.0) ** 8
    sky = (veil + 0.5 * sun)[:, None] * np.array([0.95, 0.99, 1.05])
    return _landscape(rays, sky, np.full(3, 0.85))


# ---------------------------------------------------------------------------------------------------
# clear skies


def _towards(azimuth: float, elevation: float) -> Array:
    a = np.radians(azimuth)
    e = np.radians(elevation)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def _evaluate(emitter: Any, mi: Any, rays: Array) -> Array:
    """Radiance (N, 3) of a Mitsuba emitter against unit directions (N, 3)."""
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(
        *(
            mi.Float(np.ascontiguousarray(-rays[:, i]).astype(np.float32))
            for i in range(3)
        )
    )
    radiance: Array = np.array(emitter.eval(si, True), dtype=np.float64).T.reshape(
        -1, 3
    )
    return radiance


def _digits(values: Array, digits: int = 3) -> Array:
    """Round to significant digits."""
    size = 10.0 ** (digits - 1 - np.floor(np.log10(np.maximum(np.abs(values), 1e-12))))
    return np.round(values * size) / size


@functools.lru_cache(maxsize=4)
def _bake(azimuth: float, elevation: float) -> tuple[Array, Array]:
    """Read Mitsuba's sky and sun for a sun direction in degrees.

    Returns:
        (ROWS, COLUMNS, 3) sky radiance, row 0 at the horizon and the last at the zenith,
            equally spaced in the square
        root of the elevation (denser near the horizon), column 0 at azimuth 0; and the (3,)
            irradiance of the sun
        across its beam.
    """
    from advsearch.scene.mitsuba_backend.variant import import_mitsuba

    mi = import_mitsuba()
    sun = _towards(azimuth, elevation)
    spec = {
        "type": "sunsky",
        "turbidity": TURBIDITY,
        "sun_direction": [float(c) for c in sun],
    }
    a = 2 * np.pi * np.arange(COLUMNS) / COLUMNS
    e = np.maximum(np.pi / 2 * np.linspace(0.0, 1.0, ROWS) ** 2, 1e-3)[:, None]
    grid = np.stack(
        [
            np.cos(e) * np.cos(a),
            np.cos(e) * np.sin(a),
            np.broadcast_to(np.sin(e), (ROWS, COLUMNS)),
        ],
        axis=-1,
    )
    sky = _evaluate(
        mi.load_dict({**spec, "sun_scale": 0.0}), mi, grid.reshape(-1, 3)
    ).reshape(ROWS, COLUMNS, 3)

    side = np.cross(sun, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, sun)
    r = np.tan(np.radians(0.4)) * (2 * (np.arange(200) + 0.5) / 200 - 1)
    x, y = (v.ravel() for v in np.meshgrid(r, r))
    beam = sun + x[:, None] * side + y[:, None] * up
    beam /= np.linalg.norm(beam, axis=1, keepdims=True)
    disc = _evaluate(mi.load_dict({**spec, "sky_scale": 0.0}), mi, beam)
    return _digits(sky), _digits(disc.sum(axis=0) * (r[1] - r[0]) ** 2)


def _sky(table: Array, rays: Array) -> Array:
    """Interpolate a baked sky, smoothly (cubic in azimuth and elevation), clamped to
    the horizon.
    """
    row = np.sqrt(np.arcsin(np.clip(rays[:, 2], 0.0, 1.0)) / (np.pi / 2)) * (ROWS - 1)
    column = (np.arctan2(rays[:, 1], rays[:, 0]) / (2 * np.pi) % 1.0) * COLUMNS
    i = np.floor(row).astype(np.int64)
    j = np.floor(column).astype(np.int64)
    s = row - i
    t = column - j
    total = np.zeros((len(rays), 3))
    for di, wi in zip(range(-1, 3), _weights(s), strict=True):
        for dj, wj in zip(range(-1, 3), _weights(t), strict=True):
            total += (wi * wj)[:, None] * table[
                np.clip(i + di, 0, ROWS - 1), (j + dj) % COLUMNS
            ]
    return np.maximum(total, 0.0)


def _weights(t: Array) -> tuple[Array, Array, Array, Array]:
    """Cubic B-spline weights of the four samples around a position t in [0, 1) between
    the middle two.
    """
    return (
        (1 - t) ** 3 / 6,
        (3 * t**3 - 6 * t**2 + 4) / 6,
        (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
        t**3 / 6,
    )


def clear(azimuth: float, elevation: float, rays: Array) -> Array:
    """A clear sky with the sun in a direction given in degrees."""
    table, beam = _bake(azimuth, elevation)
    sun = _towards(azimuth, elevation)
    width = np.radians(SUN_WIDTH)
    # integrates to one over the sphere
    spot = np.exp((rays @ sun - 1.0) / width**2) / (2 * np.pi * width**2)
    sky = _sky(table, rays)
    level = np.pi * sky[rays[:, 2] > 0.0].mean(axis=0) + beam * sun[2]
    above = _landscape(rays, sky, level / np.pi)
    whole: Array = above + spot[:, None] * beam
    return whole


def noon(rays: Array) -> Array:
    """Clear sky, sun at 58 degrees."""
    return clear(-5.0, 58.0, rays)


def low_sun(rays: Array) -> Array:
    """Clear sky, sun at 14 degrees, to the right of the default camera."""
    return clear(98.0, 14.0, rays)


_SCRIPT = "scenes/environments/skies.py"
SKIES = (
    EnvironmentFamily("overcast", "train", overcast, _SCRIPT),
    EnvironmentFamily("noon", "train", noon, _SCRIPT, needs_mitsuba=True),
    EnvironmentFamily("low-sun", "heldout", low_sun, _SCRIPT, needs_mitsuba=True),
)
