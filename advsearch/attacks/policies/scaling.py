"""One length for every element of u, so that policies that move all elements alike can do so in any domain."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain


def half_widths(domain: Domain) -> Tensor:
    """Return (d,) float32, over 0: how far each element may go while all others go as far.

    - "box": half of the bounds' distance, or the block's reach over the square root of its size if that is given;
    - "linf": half of what bounds and ball leave;
    - "l2": epsilon over the square root of the block's size, at most half of the bounds' distance.
    """
    half = (domain.upper - domain.lower) / 2.0
    for block, part in domain.parts():
        if block.norm == "l2" or block.reach is not None:
            half[part] = min(block.radius / math.sqrt(block.size), (block.high - block.low) / 2.0)
    return half.clamp_(min=torch.finfo(torch.float32).tiny)


def wraps(domain: Domain) -> Tensor:
    """Return (d,) bool: the elements that may leave their bounds, because there they come round again."""
    around = torch.zeros(domain.dim, dtype=torch.bool)
    for block, part in domain.parts():
        around[part] = block.periodic
    return around
