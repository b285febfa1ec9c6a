"""Real spherical harmonics of degrees 0 to 2 over an environment map (Ramamoorthi and Hanrahan 2001, section 3)."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor


@lru_cache(maxsize=4)
def real_harmonics(height: int, width: int) -> Tensor:
    """Return the nine over a map of equal angles, each with root mean square 1 over the sphere: (height, width, 9)."""
    theta = (torch.arange(height) + 0.5) * math.pi / height
    phi = (torch.arange(width) + 0.5) * 2.0 * math.pi / width
    x = theta.sin()[:, None] * phi.cos()[None]
    y = theta.sin()[:, None] * phi.sin()[None]
    z = theta.cos()[:, None].expand(height, width)
    root3, root15, root5 = math.sqrt(3.0), math.sqrt(15.0), math.sqrt(5.0)
    return torch.stack(
        [
            torch.ones_like(z),
            root3 * y,
            root3 * z,
            root3 * x,
            root15 * x * y,
            root15 * y * z,
            root5 / 2.0 * (3.0 * z * z - 1.0),
            root15 * x * z,
            root15 / 2.0 * (x * x - y * y),
        ],
        dim=-1,
    )
