"""Vary environments at random, so that training has more kinds of light."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from advsearch.extend import assets

WARM = (1.06, 0.18, -1.25)
"""Logarithms of red, green and blue of light of 2,700 K, relative to light of 6,500 K.

Their mean is about zero.
"""
WARM_RANGE = (-0.24, 1.0)
"""Bounds of the uniform factor of `WARM`: about 10,000 and 2,700 K."""
WHITE_LIGHT_CHANGES = 0.5
"""Probability that the color temperature of an environment is changed."""


def vary_environment(
    environment: assets.EnvironmentAsset, rng: np.random.Generator
) -> assets.EnvironmentAsset:
    """Change the tint and contrast of an environment at random.

    With a probability of 1/2 it is mirrored, and, independently, with a probability of
    1/2 a soft light is added.
    """
    radiance = environment.radiance
    if rng.random() < 0.5:
        radiance = radiance[:, ::-1]
    tint = np.exp(rng.normal(0.0, 0.1, 3)).astype(np.float32)
    radiance = radiance * tint
    mean = float(radiance.mean()) + 1e-6  # not 0
    # A power above 1 raises the contrast, one below 1 lowers it. Radiance at the mean
    # stays the same.
    power = np.float32(rng.uniform(0.8, 1.15))
    radiance = mean * (radiance / mean) ** power
    if rng.random() < 0.5:
        radiance = radiance + mean * _sample_gray_light(radiance, rng)
    return replace(
        environment, radiance=np.ascontiguousarray(radiance, dtype=np.float32)
    )


def _sample_gray_light(
    radiance: npt.NDArray[np.float32], rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Sample a broad light (H, W, 1) for an environment map (H, W, 3)."""
    height, width = radiance.shape[:2]
    lobe = sample_lobe(height, width, rng)
    return lobe[..., None].astype(np.float32)


def sample_lobe(
    height: int, width: int, rng: np.random.Generator
) -> npt.NDArray[np.float64]:
    """Sample a broad light from above the horizon, as an environment map (H, W).

    It has the shape of a von Mises-Fisher density: it falls off as exp(sharpness *
    (cosine - 1)) with the angle between a texel's direction and the light's. Values are
    gray, and relative to the mean of the environment that the light is added to.

    Args:
        height, width: height and width of the map. The zenith is at the top, and the
            azimuth changes from column to column.
        rng: samples the direction, the size and the strength of the light.
    """
    # zenith angle and azimuth of each texel, and of the light
    theta = (np.arange(height) + 0.5)[:, None] * math.pi / height
    phi = (np.arange(width) + 0.5)[None, :] * 2.0 * math.pi / width
    # A zenith angle of 1.3 rad (74 degrees) is 16 degrees above the horizon.
    light_theta = rng.uniform(0.1, 1.3)
    light_phi = rng.uniform(0.0, 2.0 * math.pi)
    # Spherical law of cosines: cos(angle) = cos(a) cos(b) + sin(a) sin(b) cos(phi -
    # phi').
    vertical = np.cos(theta) * math.cos(light_theta)
    horizontal = np.sin(theta) * math.sin(light_theta)
    cosine = vertical + horizontal * np.cos(phi - light_phi)
    # The light falls to half its strength at about 15 degrees from its direction with
    # sharpness 20, and at 5.5 degrees with 150.
    sharpness = rng.uniform(20.0, 150.0)
    strength = rng.uniform(2.0, 12.0)
    return np.asarray(strength * np.exp(sharpness * (cosine - 1.0)))


def change_white_light(
    environment: assets.EnvironmentAsset, rng: np.random.Generator
) -> assets.EnvironmentAsset:
    """Change the color temperature of an environment in half of the cases.

    The linear sRGB channels are multiplied by exp(warmth * `WARM`), where the warmth is
    uniform in `WARM_RANGE`. A warmth of 0 is daylight (D65), 1 the light of a black
    body of 2,700 K (an incandescent lamp), and -0.24 that of 10,000 K (a clear sky in
    the shade).
    """
    if rng.random() >= WHITE_LIGHT_CHANGES:
        return environment
    warmth = rng.uniform(*WARM_RANGE)
    factors = np.exp(warmth * np.asarray(WARM)).astype(np.float32)
    return replace(
        environment, radiance=np.ascontiguousarray(environment.radiance * factors)
    )
