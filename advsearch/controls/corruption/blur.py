"""Corruptions by blur and by shifted pixels: defocus, glass, motion, zoom, Gaussian, elastic.

Hendrycks & Dietterich 2019, arXiv 1903.12261, appendix A. All are linear in the picture.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
import torch.nn.functional as F
from scipy import ndimage
from torch import Tensor

from advsearch.controls.corruption.tools import (
    REFERENCE,
    at_level,
    between,
    blurred,
    generator,
    picture,
    planes,
    reference_size,
    resized,
    scale,
    streaked,
    warped,
)

GAUSSIAN = ((1.0,), (2.0,), (3.0,), (4.0,), (6.0,))
"""Standard deviation, reference pixels."""
DEFOCUS = ((3.0,), (4.0,), (6.0,), (8.0,), (10.0,))
"""Radius of the disc, reference pixels."""
GLASS = ((0.7, 1, 2), (0.9, 2, 1), (1.0, 2, 3), (1.1, 3, 2), (1.5, 4, 2))
"""Standard deviation and farthest neighbour, reference pixels; number of passes."""
MOTION = ((10.0, 3.0), (15.0, 5.0), (15.0, 8.0), (15.0, 12.0), (20.0, 15.0))
"""Radius and standard deviation, reference pixels."""
ZOOM = ((1.11,), (1.15,), (1.2,), (1.24,), (1.3,))
"""Largest magnification."""
ZOOM_STEPS = 16
"""Magnified pictures that are averaged; the published ones take 11 to 16."""
ELASTIC = ((488.0, 170.8, 24.4), (488.0, 19.52, 48.8), (12.2, 2.44, 4.88), (17.08, 2.44, 4.88), (29.28, 2.44, 4.88))
"""Height of the wrinkles, their width, and how far a corner of the middle third moves; reference pixels."""


def gaussian_blur(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Blur with a Gaussian."""
    (sigma,) = at_level(GAUSSIAN, level)
    return blurred(image, sigma * scale(image))


def defocus_blur(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Blur with a disc, the picture of a point that a lens has out of focus."""
    (radius,) = at_level(DEFOCUS, level)
    radius = radius * scale(image)
    reach = math.ceil(float(radius.detach()) + 0.5)
    offsets = torch.arange(-reach, reach + 1, dtype=torch.float32, device=image.device)
    distance = torch.sqrt(offsets[:, None] ** 2 + offsets[None, :] ** 2)
    disc = (radius + 0.5 - distance).clamp(0.0, 1.0)
    return _convolved(image, disc / disc.sum())


def _convolved(image: Tensor, kernel: Tensor) -> Tensor:
    """Convolve an (H, W, 3) picture with a symmetric (2 r + 1, 2 r + 1) kernel; edges are continued."""
    height, width, reach = image.shape[0], image.shape[1], kernel.shape[0] // 2
    padded = F.pad(planes(image), (reach,) * 4, mode="replicate")
    size = (padded.shape[2] + 2 * reach, padded.shape[3] + 2 * reach)
    product = torch.fft.rfft2(padded, s=size) * torch.fft.rfft2(kernel, s=size)
    whole = torch.fft.irfft2(product, s=size)
    return picture(whole[:, :, 2 * reach : 2 * reach + height, 2 * reach : 2 * reach + width])


def motion_blur(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Blur along a line, within 45 degrees of the horizontal, as of a camera that moves."""
    radius, sigma = at_level(MOTION, level)
    turn = float(torch.rand((), generator=generator(seed, "motion blur")))
    return streaked(image, radius, sigma, math.radians(90.0 * turn - 45.0), scale(image))


def zoom_blur(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Average the picture with magnified ones, as of a camera that moves towards the object."""
    (largest,) = at_level(ZOOM, level)
    zooms = 1.0 + (largest - 1.0) * torch.linspace(0.0, 1.0, ZOOM_STEPS, device=level.device)
    matrices = torch.diag_embed((1.0 / zooms)[:, None].expand(-1, 2))
    theta = torch.cat([matrices, matrices.new_zeros(ZOOM_STEPS, 2, 1)], dim=2).to(image.device)
    height, width = image.shape[:2]
    grid = F.affine_grid(theta, [ZOOM_STEPS, 3, height, width], align_corners=False)
    copies = planes(image).expand(ZOOM_STEPS, -1, -1, -1)
    zoomed = F.grid_sample(copies, grid, padding_mode="border", align_corners=False)
    return (image + zoomed.sum(dim=0).permute(1, 2, 0)) / (ZOOM_STEPS + 1)


def glass_blur(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Look through frosted glass: blur, show at each pixel what a neighbour shows, blur again."""
    sigma = at_level(GLASS, level)[0] * scale(image)
    shift = between(level, lambda whole: _glass_shift(image.shape[0], image.shape[1], seed, whole))
    return blurred(warped(blurred(image, sigma), shift * scale(image)), sigma)


@lru_cache(maxsize=8)
def _glass_shift(height: int, width: int, seed: int, whole: int) -> Tensor:
    """(H, W, 2) how far each pixel looks at a whole severity, in reference pixels.

    One pixel after another, from the bottom right, takes over what a random neighbour shows by then; so what is shown
    may come from further away than one step.
    """
    tall, wide = reference_size(height, width)
    _, reach, passes = (int(value) for value in GLASS[whole - 1])
    source = generator(seed, "glass blur")
    shown = list(range(tall * wide))
    for _ in range(passes):
        jumps = torch.randint(-reach, reach, (tall, wide, 2), generator=source)
        to_neighbour = (jumps[..., 0] * wide + jumps[..., 1]).flatten().tolist()
        for row in range(tall - reach, reach, -1):
            for place in range(row * wide + wide - reach, row * wide + reach, -1):
                shown[place] = shown[place + to_neighbour[place]]
    came, place_of = torch.tensor(shown), torch.arange(tall * wide)
    across, down = came % wide - place_of % wide, came // wide - place_of // wide
    shift = torch.stack([across, down]).view(1, 2, tall, wide).float()
    return picture(F.interpolate(shift, (height, width), mode="nearest-exact"))


def elastic(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Shear the picture and wrinkle it; below severity 1 by less."""
    height, width = image.shape[:2]
    if float(severity.detach()) < 1.0:
        shift = severity * _elastic_shift(height, width, seed, 1).to(severity.device)
    else:
        shift = between(severity, lambda whole: _elastic_shift(height, width, seed, whole))
    return warped(image, scale(image) * shift)


@lru_cache(maxsize=8)
def _elastic_shift(height: int, width: int, seed: int, whole: int) -> Tensor:
    """(H, W, 2) how far each pixel looks at a whole severity, in reference pixels."""
    tall, wide = reference_size(height, width)
    wrinkle, smooth, corner = ELASTIC[whole - 1]
    source = generator(seed, "elastic")
    corners = (torch.rand(3, 2, generator=source) * 2.0 - 1.0) * corner
    noise = torch.rand(tall, wide, 2, generator=source) * 2.0 - 1.0
    waves = ndimage.gaussian_filter(noise.numpy(), (smooth, smooth, 0.0), mode="reflect", truncate=3.0)
    shift = torch.from_numpy(waves) * wrinkle + _shear(tall, wide, corners)
    return resized(shift, height, width)


def _shear(height: int, width: int, corners: Tensor) -> Tensor:
    """(H, W, 2) the affine shift that moves three corners of the middle square, (+, +), (+, -), (-, -), as asked."""
    third = REFERENCE // 3
    by_row = (corners[0] - corners[1]) / (2 * third)
    by_column = (corners[0] - corners[2]) / (2 * third) - by_row
    rows = torch.arange(height)[:, None, None] - (height - 1) / 2.0
    columns = torch.arange(width)[None, :, None] - (width - 1) / 2.0
    return (corners[0] + corners[2]) / 2.0 + rows * by_row + columns * by_column
