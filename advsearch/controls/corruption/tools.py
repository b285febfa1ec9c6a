"""What the corruptions share: tables by severity, noise, blurs and warps in torch.

Pictures are (H, W, 3) float32 display-referred sRGB in [0, 1]. Lengths in the tables are pixels of a picture whose
smaller side has `REFERENCE` pixels, the size for which the corruptions were published; `scale` converts them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch import seeds

REFERENCE = 224
"""Smaller side in pixels of the pictures that the published tables were made for."""
LEVELS = 5
"""Severities run from 1 to this."""


def scale(image: Tensor) -> float:
    """Return pixels of this (H, W, 3) picture for a pixel of the reference size."""
    return min(image.shape[0], image.shape[1]) / REFERENCE


def reference_size(height: int, width: int) -> tuple[int, int]:
    """Return the size of a picture of the same shape whose smaller side has `REFERENCE` pixels."""
    side = min(height, width)
    return round(height * REFERENCE / side), round(width * REFERENCE / side)


def generator(seed: int, name: str) -> torch.Generator:
    """Return a source of random numbers of its own for each corruption."""
    return torch.Generator().manual_seed(seeds.stream(seed, f"corruption {name}"))


def at_level(table: Sequence[Sequence[float]], level: Tensor) -> tuple[Tensor, ...]:
    """Interpolate the rows of a table, one for each severity, linearly.

    Args:
        table: five rows of n numbers.
        level: () severity in [1, 5].

    Returns:
        n tensors of shape (), the row at the severity; differentiable.
    """
    rows = torch.tensor(table, dtype=torch.float32, device=level.device)
    return between(level, lambda whole: rows[whole - 1]).unbind()


def between(level: Tensor, make: Callable[[int], Tensor]) -> Tensor:
    """Mix what `make` returns for the two whole severities around one in [1, 5], on its device; differentiable."""
    below = min(int(level.detach()), LEVELS - 1)
    share = level - below
    if float(share.detach()) == 0.0 and not share.requires_grad:
        return make(below).to(level.device)
    low, high = make(below).to(level.device), make(below + 1).to(level.device)
    return low + share * (high - low)


def planes(image: Tensor) -> Tensor:
    """(H, W, C) to (1, C, H, W)."""
    return image.permute(2, 0, 1)[None]


def picture(stack: Tensor) -> Tensor:
    """(1, C, H, W) to (H, W, C)."""
    return stack[0].permute(1, 2, 0)


def blurred(image: Tensor, sigma: Tensor) -> Tensor:
    """Blur an (H, W, C) picture with a Gaussian of () standard deviation in pixels; edges are continued."""
    reach = max(1, math.ceil(4.0 * float(sigma.detach())))
    offsets = torch.arange(-reach, reach + 1, dtype=torch.float32, device=image.device)
    weights = torch.exp(-0.5 * (offsets / sigma) ** 2)
    weights = weights / weights.sum()
    channels = image.shape[2]
    padded = F.pad(planes(image), (reach,) * 4, mode="replicate")
    rows = F.conv2d(padded, weights.view(1, 1, -1, 1).expand(channels, 1, -1, 1), groups=channels)
    return picture(F.conv2d(rows, weights.view(1, 1, 1, -1).expand(channels, 1, 1, -1), groups=channels))


def streaked(image: Tensor, radius: Tensor, sigma: Tensor, angle: float, step: float) -> Tensor:
    """Blur an (H, W, C) picture along a line: a one-sided Gaussian, cut off at twice the radius.

    Args:
        image: the picture.
        radius: () half the length of the streak, in reference pixels.
        sigma: () standard deviation, in reference pixels.
        angle: of the line, in radians.
        step: pixels of this picture for a reference pixel.
    """
    count = math.ceil((2.0 * float(radius.detach()) + 1.0) * step)
    along = torch.arange(count, device=image.device) / step
    weights = torch.exp(-0.5 * (along / sigma) ** 2) * (2.0 * radius + 1.0 - along).clamp(0.0, 1.0)
    weights = weights / weights.sum()
    height, width = image.shape[:2]
    padded = F.pad(planes(image), (count,) * 4, mode="replicate")
    total = torch.zeros_like(image)
    for number, weight in enumerate(weights):
        down, across = round(number * math.sin(angle)), round(number * math.cos(angle))
        moved = padded[:, :, count + down : count + down + height, count + across : count + across + width]
        total = total + weight * picture(moved)
    return total


def warped(image: Tensor, shift: Tensor) -> Tensor:
    """Look every pixel up at another place.

    Args:
        image: (H, W, C).
        shift: (H, W, 2) how far to the right and down to look, in pixels; places outside are mirrored inwards.
    """
    height, width = image.shape[:2]
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    where = torch.stack([columns, rows], dim=-1).to(image.device) + shift.to(image.device)
    grid = where * torch.tensor([2.0 / width, 2.0 / height], device=image.device) - 1.0
    return picture(F.grid_sample(planes(image), grid[None], padding_mode="reflection", align_corners=False))


def resized(field: Tensor, height: int, width: int) -> Tensor:
    """Resize an (h, w, C) field to (height, width, C), smoothly."""
    if field.shape[:2] == (height, width):
        return field
    stack = F.interpolate(planes(field), (height, width), mode="bilinear", antialias=True, align_corners=False)
    return picture(stack).contiguous()
