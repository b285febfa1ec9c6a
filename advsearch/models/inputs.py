"""Networks that want more than pictures, or these as whole numbers, as networks of
pictures alone.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, final

import torch
from torch import Tensor, nn

SIZE_INPUTS = frozenset(
    ["orig_target_sizes", "orig_target_size", "orig_sizes", "orig_size"]
)
"""What exports of RT-DETR, D-FINE and DEIM call the size of a picture: (width, height),
which they multiply boxes by (`RTDETRPostProcessor` of lyuwenyu/RT-DETR; `onnx_inf.py`
of Peterande/D-FINE).
"""

SIZE_TYPES = {
    "tensor(int64)": torch.int64,
    "tensor(int32)": torch.int32,
    "tensor(float)": torch.float32,
}
"""The types in which onnxruntime may say that a network takes them."""


@final
class WithImageSize(nn.Module):
    """A network that also takes the size of its pictures; boxes are then in pixels of
    these.

    Args:
        network: from pictures and their sizes (N, 2), (width, height) in pixels, to an
            output.
        size_type: the type of these sizes.
        layout: of the pictures, "NCHW" or "NHWC".
    """

    def __init__(
        self, network: Callable[..., Any], size_type: torch.dtype, layout: str
    ) -> None:
        super().__init__()
        self.network = network
        self.size_type = size_type
        self.layout = layout
        self.training = False

    def forward(self, images: Tensor) -> Any:
        """Return the network's output for pictures (N, 3, H, W) or (N, H, W, 3)."""
        height, width = (
            images.shape[1:3] if self.layout == "NHWC" else images.shape[2:4]
        )
        size = torch.tensor(
            [[width, height]], dtype=self.size_type, device=images.device
        )
        return self.network(images, size.repeat(len(images), 1))


@final
class EightBitInput(nn.Module):
    """A network that takes whole numbers from 0 to 255 (uint8); no gradient goes
    through the rounding to these.

    Args:
        network: from pictures in uint8, and what else it takes, to an output.
    """

    def __init__(self, network: Callable[..., Any]) -> None:
        super().__init__()
        self.network = network
        self.training = False

    def forward(self, images: Tensor, *more: Tensor) -> Any:
        """Return the network's output for floating-point pictures with values from 0 to
        255.
        """
        return self.network(
            images.detach().round().clamp(0.0, 255.0).to(torch.uint8), *more
        )


def names_of_inputs(network: nn.Module) -> list[str]:
    """Return the names of what a network has to be called with; none where Python
    cannot tell.
    """
    if isinstance(network, torch.jit.ScriptModule):
        taken = network.forward.schema.arguments[1:]  # type: ignore[attr-defined]
        return [one.name for one in taken if not one.has_default_value()]
    try:
        parameters = list(inspect.signature(network.forward).parameters.values())
    except (TypeError, ValueError):  # it is not written in Python
        return []
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [
        parameter.name
        for parameter in parameters
        if parameter.kind not in variable
        and parameter.default is inspect.Parameter.empty
    ]


def takes_image_size(network: nn.Module) -> bool:
    """Whether a network is called with pictures and their sizes, by the names of what
    it takes.
    """
    names = names_of_inputs(network)
    return len(names) == 2 and names[1] in SIZE_INPUTS


PICTURE = "observation.image"  # what a policy's `select_action` calls the picture


@final
class WithState(nn.Module):
    """A policy of pictures and a state that stays as it is.

    A policy with a method `select_action` is called as LeRobot's are: with one mapping
    of the pictures, as `PICTURE`, and of the state (numbers by name), after `reset`
    where it has one, since what it still holds belongs to an earlier picture. Others
    are called with the pictures and the mapping, or with the pictures alone where the
    state is empty.
    """

    def __init__(
        self, network: Callable[..., Any], state: Mapping[str, Sequence[float]]
    ) -> None:
        super().__init__()
        self.network = network
        self.state = dict(state)
        self.training = False

    def forward(self, images: Tensor) -> Any:
        """Return what the policy does for pictures (N, ...); it gets each part of the
        state as (N, numbers).
        """
        state = {
            name: images.new_tensor(numbers).expand(len(images), -1)
            for name, numbers in self.state.items()
        }
        select = getattr(self.network, "select_action", None)
        if select is None:
            return self.network(images, state) if state else self.network(images)
        getattr(self.network, "reset", lambda: None)()
        with torch.set_grad_enabled(torch.is_grad_enabled()):
            return select({PICTURE: images, **state})
