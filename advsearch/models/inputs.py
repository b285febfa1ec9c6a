"""Adapt networks so that they can be called with floating-point images only.

Such networks take integer images, or further inputs: the image size or a state.
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
    """Call a network that takes images and their sizes with images only.

    The boxes of such a network are in pixels.

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
        """Return the network's output for images (N, 3, H, W) or (N, H, W, 3)."""
        height, width = (
            images.shape[1:3] if self.layout == "NHWC" else images.shape[2:4]
        )
        size = torch.tensor(
            [[width, height]], dtype=self.size_type, device=images.device
        )
        return self.network(images, size.repeat(len(images), 1))


@final
class EightBitInput(nn.Module):
    """Call a network of uint8 images with floating-point images from 0 to 255.

    Images are rounded, which has no gradient.

    Args:
        network: network from images in uint8, and further inputs, to an output.
    """

    def __init__(self, network: Callable[..., Any]) -> None:
        super().__init__()
        self.network = network
        self.training = False

    def forward(self, images: Tensor, *more: Tensor) -> Any:
        """Return the network's output for floating-point images.

        Args:
            images: images with values from 0 to 255.
            *more: further inputs, which are passed on.
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
        signature = inspect.signature(network.forward)
    except (TypeError, ValueError):  # it is not written in Python
        return []
    return [
        parameter.name
        for parameter in signature.parameters.values()
        if is_required(parameter)
    ]


def is_required(parameter: inspect.Parameter) -> bool:
    """Return whether a call has to pass a parameter."""
    variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    has_default = parameter.default is not inspect.Parameter.empty
    return parameter.kind not in variadic and not has_default


def takes_image_size(network: nn.Module) -> bool:
    """Return whether the names of a network's inputs are those of images and sizes."""
    names = list_required_inputs(network)
    return len(names) == 2 and names[1] in SIZE_INPUTS


PICTURE = "observation.image"  # the key of the image for a policy's `select_action`


@final
class WithState(nn.Module):
    """Call a policy of images and a constant state with images only.

    A policy with a method `select_action` is called as those of LeRobot: with one
    mapping of the images (key `PICTURE`) and of the state. Its `reset`, if it has one,
    is called before, because the policy may have stored an earlier image. Other
    policies are called with the images and the state, or with the images only if the
    state is empty.

    Args:
        network: the policy.
        state: numbers of the state by name, such as {"speed": [3.0]}.
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
            reset()  # forgets an earlier image
        # A policy may switch gradients on or off as it runs: this context restores the
        # switch at its end.
        with torch.set_grad_enabled(torch.is_grad_enabled()):
            return select({PICTURE: images, **state})
