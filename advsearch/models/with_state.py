"""A network that takes a state beside pictures, as one of pictures alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, final

import torch
from torch import Tensor, nn

PICTURE = "observation.image"  # what a policy's `select_action` calls the picture


@final
class WithState(nn.Module):
    """A policy of pictures and a state that stays as it is.

    A policy with a method `select_action` is called as LeRobot's are: with one mapping of the pictures, as `PICTURE`,
    and of the state, after `reset` where it has one, since what it still holds belongs to an earlier picture. Others
    are called with the pictures and the mapping, or with the pictures alone where the state is empty.

    Args:
        network: the policy.
        state: numbers by name.
    """

    def __init__(self, network: Callable[..., Any], state: Mapping[str, Sequence[float]]) -> None:
        super().__init__()
        self.network, self.state = network, dict(state)
        self.training = False

    def forward(self, images: Tensor) -> Any:
        """Return what the policy does for pictures (N, ...); it gets each part of the state as (N, numbers)."""
        state = {name: images.new_tensor(numbers).expand(len(images), -1) for name, numbers in self.state.items()}
        select = getattr(self.network, "select_action", None)
        if select is None:
            return self.network(images, state) if state else self.network(images)
        getattr(self.network, "reset", lambda: None)()
        with torch.set_grad_enabled(torch.is_grad_enabled()):
            return select({PICTURE: images, **state})
