"""Corruptions by noise: Gaussian, shot, impulse and speckle (Hendrycks & Dietterich 2019, arXiv 1903.12261, app. A).

The noise is one fixed draw, chosen by the seed: the same at every severity, so that the picture changes smoothly
with the severity, and the same in every render.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from advsearch.controls.corruption.tools import at_level, generator

GAUSSIAN = ((0.08,), (0.12,), (0.18,), (0.26,), (0.38,))
"""Standard deviation, sRGB."""
SHOT = ((60.0,), (25.0,), (12.0,), (5.0,), (3.0,))
"""Photons in a white pixel."""
IMPULSE = ((0.03,), (0.06,), (0.09,), (0.17,), (0.27,))
"""Share of the values that are lost."""
SPECKLE = ((0.15,), (0.2,), (0.35,), (0.45,), (0.6,))
"""Standard deviation relative to the value."""
_DARK = 1e-3
"""Keeps the slope of a square root finite in black."""


@lru_cache(maxsize=8)
def _normal(height: int, width: int, seed: int, name: str) -> Tensor:
    return torch.randn(height, width, 3, generator=generator(seed, name))


@lru_cache(maxsize=8)
def _uniform(height: int, width: int, seed: int, name: str) -> Tensor:
    return torch.rand(height, width, 3, generator=generator(seed, name))


def gaussian_noise(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Add normal noise, as of a sensor in the dark."""
    (sigma,) = at_level(GAUSSIAN, level)
    return image + sigma * _normal(image.shape[0], image.shape[1], seed, "gaussian noise").to(image.device)


def speckle_noise(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Add normal noise in proportion to the value."""
    (sigma,) = at_level(SPECKLE, level)
    return image + image * sigma * _normal(image.shape[0], image.shape[1], seed, "speckle noise").to(image.device)


def shot_noise(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Count photons: Poisson numbers with the picture as their mean, by inverting the distribution function.

    The values are exact. Counts have no derivative, so each is taken to keep its place in the distribution, a number
    of standard deviations from the mean, when the mean or the spread changes a little.
    """
    (photons,) = at_level(SHOT, level)
    share = _uniform(image.shape[0], image.shape[1], seed, "shot noise").to(image.device)
    with torch.no_grad():
        counted = poisson(image * photons, share) / photons
        away = (counted - image) / torch.sqrt(image / photons + _DARK)
    return image + away * torch.sqrt(image / photons + _DARK)


def poisson(mean: Tensor, share: Tensor) -> Tensor:
    """Return the Poisson numbers of given means at given shares of the distribution; no derivative.

    Args:
        mean: any shape, 0 to about 80.
        share: the same shape, in [0, 1).
    """
    chance = torch.exp(-mean.double())
    total, count = chance.clone(), torch.zeros_like(chance)
    for number in range(1, 400):
        short = share > total
        if not bool(short.any()):
            break
        count += short
        chance *= mean / number
        total += chance
    return count.to(mean.dtype)


def impulse_noise(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Replace a share of the values by 0 or 1 ("salt and pepper").

    A value is lost at once, which has no derivative by the share of lost ones; taken instead is that of the average
    over all draws of which ones are lost.
    """
    (lost,) = at_level(IMPULSE, level)
    height, width = image.shape[:2]
    turn = _uniform(height, width, seed, "impulse noise").to(image.device)
    extreme = (_uniform(height, width, seed, "impulse value") < 0.5).float().to(image.device)
    kept = torch.where(turn < lost.detach(), extreme, image)
    return kept + (lost - lost.detach()) * (extreme - image.detach())
