"""From the groups of controls to the blocks of a search's domain: the one place where the two meet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from advsearch.attacks import Block, Domain
from advsearch.controls.base import BoundControl


def domain_of(controls: Sequence[BoundControl], start: Tensor | None = None, **more: Any) -> Domain:
    """Return where a search over some controls may look: the budgets of all their groups, in the order of u.

    Args:
        controls: of a space, or some of them.
        start: (d,) float32; by default the controls' own, which leaves the scene as it is.
        **more: other fields of `Domain`: `gradient_cost`, `partial_gradients`.
    """
    blocks = tuple(
        Block(
            group.size,
            group.budget.norm,  # type: ignore[arg-type]
            group.budget.epsilon,
            periodic=group.periodic,
            name=f"{control.name}.{group.parameter}",
            options=group.options,
        )
        for control in controls
        for group in control.groups
    )
    if start is None:
        start = torch.cat([control.start for control in controls]) if controls else torch.zeros(0)
    return Domain(start, blocks, **more)
