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
"""Probability that the color of light is changed."""


def vary_environment(
    environment: assets.EnvironmentAsset, rng: np.random.Generator
) -> assets.EnvironmentAsset:
    """Change the tint and contrast of an environment; perhaps mirror it or add a soft
    light.

    Each of the latter two happens in half of the cases.
    """
    radiance = environment.radiance
    if rng.random() < 0.5:
        radiance = radiance[:, ::-1]
    radiance = radiance * np.exp(rng.normal(0.0, 0.1, 3)).astype(np.float32)
    # contrast: a power of the radiance relative to the mean
    mean = float(radiance.mean()) + 1e-6
    radiance = mean * (radiance / mean) ** np.float32(rng.uniform(0.8, 1.15))
    if rng.random() < 0.5:
        height, width = radiance.shape[:2]
        lobe = sample_lobe(height, width, rng)
        radiance = radiance + mean * lobe[..., None].astype(np.float32)
    return replace(
        environment, radiance=np.ascontiguousarray(radiance, dtype=np.float32)
    )


def sample_lobe(
    height: int, width: int, rng: np.random.Generator
) -> npt.NDArray[np.float64]:
    """Sample a broad light from above the horizon, as an environment map (H, W).

    It falls off as exp(sharpness * (cosine - 1)), with the cosine of the angle from its
    middle. Values are relative to the mean of the environment that it is added to.

    Args:
        height, width: height and width of the map, which has the zenith at the top and
            azimuths across.
        rng: samples its direction, its size and its strength.
    """
    theta = (np.arange(height) + 0.5)[:, None] * math.pi / height
    phi = (np.arange(width) + 0.5)[None, :] * 2.0 * math.pi / width
    zenith = rng.uniform(0.1, 1.3)
    azimuth = rng.uniform(0.0, 2.0 * math.pi)
    # of the angle between the direction of each texel and that of the light
    cosine = np.cos(theta) * math.cos(zenith) + np.sin(theta) * math.sin(
        zenith
    ) * np.cos(phi - azimuth)
    sharpness = rng.uniform(20.0, 150.0)
    lobe = rng.uniform(2.0, 12.0) * np.exp(sharpness * (cosine - 1.0))
    return np.asarray(lobe)


def change_white_light(
    environment: assets.EnvironmentAsset, rng: np.random.Generator
) -> assets.EnvironmentAsset:
    """Change the color temperature of an environment in half of the cases.

    The linear sRGB channels are multiplied by exp(a * `WARM`), with a uniform in
    `WARM_RANGE`. Relative to daylight (D65), the light of a black body of 2,700 K (an
    incandescent lamp) has a of about 1, and that of 10,000 K (a clear sky in the shade)
    about -0.24.
    """
    if rng.random() >= WHITE_LIGHT_CHANGES:
        return environment
    factors = np.exp(rng.uniform(*WARM_RANGE) * np.asarray(WARM)).astype(np.float32)
    return replace(
        environment, radiance=np.ascontiguousarray(environment.radiance * factors)
    )
