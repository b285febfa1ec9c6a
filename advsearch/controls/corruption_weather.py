"""Corruptions by weather: fog, frost and snow, made from noise.

Hendrycks & Dietterich 2019, arXiv 1903.12261, appendix A, for fog and snow. Their frost is photographs; here it is
grown from noise, with the published weights.
"""

from __future__ import annotations

import cmath
import math
from functools import lru_cache

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from advsearch.controls.corruption_filters import at_level, between, generator, reference_size, resized, streaked

FOG = ((1.5,), (2.0,), (2.5,), (2.5,), (3.0,))
"""How dense the fog is."""
FOG_DECAY = (2.0, 2.0, 1.7, 1.5, 1.4)
"""How fast its details lose height: less is rougher."""
FROST = ((1.0, 0.4), (0.8, 0.6), (0.7, 0.7), (0.65, 0.7), (0.6, 0.75))
"""Weight of the picture and of the frost."""
FEATHER_AREA = 260
"""Square half-pixels of the reference picture for each feather of ice."""
ICE = (0.86, 0.95, 1.0)
"""Colour of the ice, sRGB."""
SNOW = (
    (0.1, 0.3, 3.0, 0.5, 10.0, 4.0),
    (0.2, 0.3, 2.0, 0.5, 12.0, 4.0),
    (0.55, 0.3, 4.0, 0.9, 12.0, 8.0),
    (0.55, 0.3, 4.5, 0.85, 12.0, 8.0),
    (0.55, 0.3, 2.5, 0.85, 12.0, 12.0),
)
"""Mean and spread of the noise, size of a flake, noise over which there is one, radius and spread of its streak."""
SNOW_KEEP = ((0.8,), (0.7,), (0.7,), (0.65,), (0.55,))
"""Weight of the picture; the rest is a paler one."""
LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in a grey."""


def fog(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Add drifts of white, and scale the brightest value back to what it was."""
    height, width = image.shape[:2]
    (density,) = at_level(FOG, level)
    drift = between(level, lambda whole: _drift(height, width, seed, FOG_DECAY[whole - 1]))
    brightest = image.max()
    return (image + density * drift.to(image.device)) * brightest / (brightest + density)


@lru_cache(maxsize=8)
def _drift(height: int, width: int, seed: int, decay: float) -> Tensor:
    """(H, W, 1) fog in [0, 1]."""
    tall, wide = reference_size(height, width)
    return resized(fractal(max(tall, wide), decay, generator(seed, "fog"))[:tall, :wide, None], height, width)


def fractal(side: int, decay: float, source: torch.Generator) -> Tensor:
    """Return fractal noise in [0, 1], at least side x side, made by midpoint displacement on a torus.

    Each step doubles the grid: new points are the mean of their four neighbours plus noise, whose height falls by
    `decay` squared from step to step (Fournier, Fussell, Carpenter 1982, Computer rendering of stochastic models).
    """
    grid, height = torch.zeros(1, 1), 1.0
    while grid.shape[0] < side:
        size = grid.shape[0]
        noise = (torch.rand(3, size, size, generator=source) * 2.0 - 1.0) * height
        right, down = grid.roll(-1, 1), grid.roll(-1, 0)
        middle = (grid + right + down + right.roll(-1, 0)) / 4.0 + noise[0]
        finer = torch.empty(2 * size, 2 * size)
        finer[::2, ::2], finer[1::2, 1::2] = grid, middle
        finer[::2, 1::2] = (grid + right + middle + middle.roll(1, 0)) / 4.0 + noise[1]
        finer[1::2, ::2] = (grid + down + middle + middle.roll(1, 1)) / 4.0 + noise[2]
        grid, height = finer, height / decay**2
    grid = grid - grid.min()
    return grid / grid.max()


def frost(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Lay ice crystals over the picture."""
    keep, ice = at_level(FROST, level)
    return keep * image + ice * _crystals(image.shape[0], image.shape[1], seed).to(image.device)


@lru_cache(maxsize=4)
def _crystals(height: int, width: int, seed: int) -> Tensor:
    """(H, W, 3) ice in [0, 1]: feathers of crystals over a film that is thicker in places, a little blue."""
    tall, wide = reference_size(height, width)
    source = generator(seed, "frost")
    film = fractal(max(tall, wide), 1.4, source)[:tall, :wide, None]
    feathers = resized(_feathers(2 * tall, 2 * wide, source), tall, wide)
    ice = 0.2 + 0.3 * film + (0.45 + 0.75 * film) * feathers
    return resized((ice * torch.tensor(ICE)).clamp(0.0, 1.0), height, width)


def _feathers(height: int, width: int, source: torch.Generator) -> Tensor:
    """Return (height, width, 1) in [0, 1]: ice needles with barbs at 60 degrees, as ice grows on glass."""
    canvas = Image.new("L", (width, height))
    pen = ImageDraw.Draw(canvas)
    drawn = torch.rand(height * width // FEATHER_AREA, 5, generator=source).tolist()
    for shine, across, down, turn, size in sorted(drawn):
        start, along = complex(across * width, down * height), cmath.rect(1.0, 2.0 * math.pi * turn)
        length = 12.0 + 110.0 * size**3
        _line(pen, start, start + length * along, shine)
        for step in range(4, int(length), 4):
            uneven = 0.5 + 0.5 * math.sin(step + 50.0 * turn)
            barb = (0.2 + 0.35 * uneven) * (length - step) * along
            for side in (math.pi / 3.0, -math.pi / 3.0):
                _line(pen, start + step * along, start + step * along + barb * cmath.rect(1.0, side), 0.7 * shine)
    return torch.from_numpy(np.asarray(canvas, dtype=np.float32) / 255.0)[..., None]


def _line(pen: ImageDraw.ImageDraw, begin: complex, end: complex, shine: float) -> None:
    pen.line((begin.real, begin.imag, end.real, end.imag), fill=int(255.0 * shine))


def snow(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Pale the picture and let streaks of snow fall before it."""
    (keep,) = at_level(SNOW_KEEP, level)
    layer = between(level, lambda whole: _snowfall(image.shape[0], image.shape[1], seed, whole)).to(image.device)
    grey = (image * image.new_tensor(LUMA)).sum(dim=-1, keepdim=True)
    pale = torch.maximum(image, 1.5 * grey + 0.5)
    return keep * image + (1.0 - keep) * pale + layer + layer.rot90(2)


@lru_cache(maxsize=8)
def _snowfall(height: int, width: int, seed: int, whole: int) -> Tensor:
    """(H, W, 1) falling snow in [0, 1] at a whole severity."""
    tall, wide = reference_size(height, width)
    mean, spread, flake, over, radius, sigma = SNOW[whole - 1]
    source = generator(seed, "snow")
    angle = math.radians(-135.0 + 90.0 * float(torch.rand((), generator=source)))
    noise = mean + spread * torch.randn(math.ceil(tall / flake), math.ceil(wide / flake), 1, generator=source)
    flakes = resized(noise, tall, wide)
    flakes = torch.where(flakes < over, torch.zeros_like(flakes), flakes)
    streaks = streaked(flakes, torch.tensor(radius), torch.tensor(sigma), angle, 1.0)
    return resized(streaks.clamp(0.0, 1.0), height, width)
