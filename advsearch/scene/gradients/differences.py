"""Derivatives by differences of a number that renders give; the renders share their random numbers, and have no graph.

Each function writes the coordinates of its groups into `found`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from advsearch.scene.gradients.group import Group

Value = Callable[[Tensor], Tensor]
"""From a configuration (d,) to one number, at one seed."""
DIRECTIONS = 4
"""Random directions of one `simultaneous` gradient."""


def central(value: Value, group: Group, u: Tensor, found: Tensor) -> None:
    """Two values for each coordinate of a group, `group.step` to either side."""
    for number in range(group.begin, group.begin + group.size):
        step = torch.zeros_like(u)
        step[number] = group.step
        (above, up), (below, down) = moved(u, step, group.periodic), moved(u, -step, group.periodic)
        rise = value(above) - value(below)
        found[number] = float(rise) / float((up - down)[number])


def one_sided(value: Value, groups: Sequence[Group], u: Tensor, found: Tensor) -> None:
    """One value for each coordinate, and one for all."""
    if not groups:
        return
    here = float(value(u))
    for group in groups:
        for number in range(group.begin, group.begin + group.size):
            step = torch.zeros_like(u)
            step[number] = group.step if group.periodic or float(u[number]) + group.step <= 1.0 else -group.step
            there, width = moved(u, step, group.periodic)
            found[number] = (float(value(there)) - here) / float(width[number])


def random_directions(value: Value, groups: Sequence[Group], u: Tensor, seed: int, found: Tensor) -> None:
    """Simultaneous perturbation (Spall 1992, section 2) along a few random sign vectors, scaled by the steps."""
    if not groups:
        return
    scale, periodic = torch.zeros_like(u), torch.zeros_like(u)
    for group in groups:
        scale[group.coordinates] = group.step
        periodic[group.coordinates] = float(group.periodic)
    generator = torch.Generator().manual_seed(seed % 2**63)
    total = torch.zeros_like(u)
    for _ in range(DIRECTIONS):
        signs = torch.randint(0, 2, u.shape, generator=generator).to(u.dtype) * 2.0 - 1.0
        (above, up), (below, down) = (moved(u, way * signs * scale, periodic.bool()) for way in (1.0, -1.0))
        rise = float(value(above) - value(below))
        width = up - down
        total += torch.where(width == 0.0, 0.0, rise / torch.where(width == 0.0, 1.0, width))
    found += total / DIRECTIONS


def moved(u: Tensor, step: Tensor, periodic: bool | Tensor) -> tuple[Tensor, Tensor]:
    """Return u + step brought back into the box, and the step that was really taken.

    Periodic coordinates wrap around, so that they can go the whole step.
    """
    there = u + step
    wrapped = torch.remainder(there, 1.0)
    clipped = there.clamp(0.0, 1.0)
    cyclic = torch.as_tensor(periodic).expand(u.shape)
    return torch.where(cyclic, wrapped, clipped), torch.where(cyclic, step, clipped - u)
