"""Adapt networks with further inputs, or with integer images, to networks of images
alone.
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
"""Names of the image size (width, height) among the inputs of exported RT-DETR, D-FINE
and DEIM, which multiply boxes by it (`RTDETRPostProcessor` of lyuwenyu/RT-DETR;
`onnx_inf.py` of Peterande/D-FINE).
"""

SIZE_TYPES = {
    "tensor(int64)": torch.int64,
    "tensor(int32)": torch.int32,
    "tensor(float)": torch.float32,
}
"""The types of image sizes by their names in onnxruntime."""


@final
class WithImageSize(nn.Module):
    """A network that also takes the size of its images; its boxes are then in pixels.

    Args:
        network: network from images and their sizes (N, 2), (width, height) in pixels,
            to an output.
        size_type: dtype of these sizes.
        layout: layout of the images, "NCHW" or "NHWC".
    """

    def __init__(
        self, network: Callable[..., Any], size_type: torch.dtype, layout: str
    ) -> None:
        """Wrap the network; a wrapper is always in evaluation mode."""
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
    """A network that takes integers from 0 to 255 (uint8); the rounding has no
    gradient.

    Args:
        network: network from images in uint8, and further inputs, to an output.
    """

    def __init__(self, network: Callable[..., Any]) -> None:
        super().__init__()
        self.network = network
        self.training = False

    def forward(self, images: Tensor, *more: Tensor) -> Any:
        """Return the network's output for floating-point images with values from 0 to
        255.
        """
        return self.network(
            images.detach().round().clamp(0.0, 255.0).to(torch.uint8), *more
        )


def list_required_inputs(network: nn.Module) -> list[str]:
    """Return the names of the inputs without a default of a network's `forward`.

    The list is empty if the network is not written in Python.
    """
    if isinstance(network, torch.jit.ScriptModule):
        arguments = network.forward.schema.arguments[1:]  # type: ignore[attr-defined]
        return [
            argument.name for argument in arguments if not argument.has_default_value()
        ]
    try:
        parameters = list(inspect.signature(network.forward).parameters.values())
    except (TypeError, ValueError):  # it is not written in Python
        return []
    variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [
        parameter.name
        for parameter in parameters
        if parameter.kind not in variadic
        and parameter.default is inspect.Parameter.empty
    ]


def takes_image_size(network: nn.Module) -> bool:
    """Whether a network takes images and their sizes, by the names of its inputs."""
    names = list_required_inputs(network)
    return len(names) == 2 and names[1] in SIZE_INPUTS


PICTURE = "observation.image"  # the key of the image for a policy's `select_action`


@final
class WithState(nn.Module):
    """A policy of images and a constant state.

    A policy with a method `select_action` is called as LeRobot's are: with one mapping
    of the images, as `PICTURE`, and of the state (numbers by name), after `reset` if it
    has one, because it may still hold an earlier image. Others are called with the
    images and the mapping, or with the images alone if the state is empty.
    """

    def __init__(
        self, network: Callable[..., Any], state: Mapping[str, Sequence[float]]
    ) -> None:
        super().__init__()
        self.network = network
        self.state = dict(state)
        self.training = False

    def forward(self, images: Tensor) -> Any:
        """Return the policy's output for images.

        Args:
            images: (N, ...). Each entry of the state is repeated for every image, to
                (N, numbers).
        """
        state = {
            name: images.new_tensor(numbers).expand(len(images), -1)
            for name, numbers in self.state.items()
        }
        select = getattr(self.network, "select_action", None)
        if select is None:
            return self.network(images, state) if state else self.network(images)
        reset = getattr(self.network, "reset", None)
        if reset is not None:
            reset()
        # A policy may switch gradients off or on as it runs: this restores the mode.
        with torch.set_grad_enabled(torch.is_grad_enabled()):
            return select({PICTURE: images, **state})
