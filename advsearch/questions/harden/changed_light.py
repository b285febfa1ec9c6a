"""Environments changed by chance: who is trained in them sees more kinds of light than
the bundled ones have.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from advsearch.extend import assets

WARM = (1.06, 0.18, -1.25)
"""Logarithms of what light of 2,700 K has of red, green and blue, beside light of 6,500
K; their mean is about zero.
"""
OF_WARM = (-0.24, 1.0)  # ends of the uniform factor of `WARM`: about 10,000 and 2,700 K
WHITE_LIGHT_CHANGES = 0.5  # how often the colour of light is changed


def varied(
    environment: assets.EnvironmentAsset, rng: np.random.Generator
) -> assets.EnvironmentAsset:
    """Mirror, tint, change the contrast of, and add one soft light to an environment,
    each by chance.
    """
    radiance = (
        environment.radiance[:, ::-1] if rng.random() < 0.5 else environment.radiance
    )
    radiance = radiance * np.exp(rng.normal(0.0, 0.1, 3)).astype(np.float32)
    mean = float(radiance.mean()) + 1e-6
    radiance = mean * (radiance / mean) ** np.float32(rng.uniform(0.8, 1.15))
    if rng.random() < 0.5:
        # a broad lobe from a random direction above the horizon, in units of the map's
        # mean
        height, width = radiance.shape[:2]
        theta = (np.arange(height) + 0.5)[:, None] * math.pi / height
        phi = (np.arange(width) + 0.5)[None, :] * 2.0 * math.pi / width
        tilt = rng.uniform(0.1, 1.3)
        turn = rng.uniform(0.0, 2.0 * math.pi)
        cosine = np.cos(theta) * math.cos(tilt) + np.sin(theta) * math.sin(
            tilt
        ) * np.cos(phi - turn)
        sharpness = rng.uniform(20.0, 150.0)
        lobe = rng.uniform(2.0, 12.0) * np.exp(sharpness * (cosine - 1.0))
        radiance = radiance + mean * lobe[..., None].astype(np.float32)
    return replace(
        environment, radiance=np.ascontiguousarray(radiance, dtype=np.float32)
    )


def white_light_changed(
    environment: assets.EnvironmentAsset, rng: np.random.Generator
) -> assets.EnvironmentAsset:
    """Change the colour temperature of all light of an environment, by chance, in one
    of two cases.

    Relative to daylight (D65), what a black body of 2,700 K (an incandescent lamp)
    gives in linear sRGB is about exp(`WARM`), and one of 10,000 K (a clear sky in the
    shade) about exp(-0.24 `WARM`); the amount is uniform between.
    """
    if rng.random() >= WHITE_LIGHT_CHANGES:
        return environment
    factors = np.exp(rng.uniform(*OF_WARM) * np.asarray(WARM)).astype(np.float32)
    return replace(
        environment, radiance=np.ascontiguousarray(environment.radiance * factors)
    )
