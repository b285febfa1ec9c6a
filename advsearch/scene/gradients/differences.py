"""Derivatives by differences of a number that renders give; the renders share their random numbers, and have no graph.

Each function writes the coordinates of its groups into `found`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from advsearch.scene.gradients.group import Group

Value = Callable[[Tensor], Tensor]
"""From a configuration (d,) to one number, at one seed."""


def central(value: Value, group: Group, u: Tensor, found: Tensor) -> None:
    """Two values for each coordinate of a group, `group.step` to either side."""
    for number in range(group.begin, group.begin + group.size):
        step = torch.zeros_like(u)
        step[number] = group.step
        (above, up), (below, down) = moved(u, step, group.periodic), moved(u, -step, group.periodic)
        rise = value(above) - value(below)
        found[number] = float(rise) / float((up - down)[number])


def moved(u: Tensor, step: Tensor, periodic: bool | Tensor) -> tuple[Tensor, Tensor]:
    """Return u + step brought back into the box, and the step that was really taken.

    Periodic coordinates wrap around, so that they can go the whole step.
    """
    there = u + step
    wrapped = torch.remainder(there, 1.0)
    clipped = there.clamp(0.0, 1.0)
    cyclic = torch.as_tensor(periodic).expand(u.shape)
    return torch.where(cyclic, wrapped, clipped), torch.where(cyclic, step, clipped - u)
