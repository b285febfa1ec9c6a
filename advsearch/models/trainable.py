"""Networks to train further: a copy of a model's network, and the model that sees the copy's weights as they change."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from advsearch.errors import ModelError
from advsearch.models import reference
from advsearch.models.model import Model, logits_of
from advsearch.models.source import frozen, sharing_copy, split_weights


@dataclass(frozen=True, eq=False)
class Trainable:
    """A network that is trained, and what asks it.

    Attributes:
        net: a copy of the model's network; the parameters that are trained collect gradients.
        model: asks the same weights, in evaluation mode, without their gradients.
    """

    net: nn.Module
    model: Model

    def logits(self, images: Tensor) -> Tensor:
        """Return logits (N, C) of images (N, H, W, 3) sRGB in [0, 1], with a graph to the parameters."""
        with self._mixed_precision():
            x = self.model.preprocessing(images.to(self.model.device)).to(self.model.dtype)
            return logits_of(self.net(x), len(images), self.model.classes, self.model.name)

    def quickly(self, images: Tensor) -> Tensor:
        """Return what `model` says of images (N, H, W, 3), in the precision of `logits`."""
        with self._mixed_precision():
            logits: Tensor = self.model(images)
        return logits

    def twin(self) -> Trainable:
        """The same weights with gradients of their own, for another thread."""
        net = sharing_copy(self.net)
        return replace(self, net=net, model=replace(self.model, module=frozen(net, self.model.name)))

    def parameters(self) -> list[nn.Parameter]:
        """The parameters that are trained."""
        return [one for one in self.net.parameters() if one.requires_grad]

    def _mixed_precision(self) -> torch.autocast:
        """Convolutions and products of matrices in bfloat16, on a processor that has instructions for it.

        Several threads at one of them wait for each other busily: where others want the cores too it takes five
        times as long as in float32.
        """
        found: Mapping[str, object] = getattr(torch.cpu, "get_capabilities", dict)()  # torch 2.8 says nothing
        bfloat16 = self.model.device.type == "cpu" and bool(found.get("avx512_bf16"))
        return torch.autocast("cpu", torch.bfloat16, enabled=bfloat16)


def trainable(model: Model, layers: str = "all") -> Trainable:
    """Return a copy of a model's network to train further.

    It stays in evaluation mode: statistics of batches stay what they were learned as, and nothing is dropped.

    Args:
        model: of `load_model`.
        layers: "all", or "last" for the last layer that has parameters.

    Raises:
        ModelError: the network is no `nn.Module` that can be copied, is a program that was exported or scripted, or
            answers with something other than logits.
    """
    if model.probabilities or model.read is not None:
        raise ModelError(f"model {model.name}: only a classifier that answers with logits can be hardened")
    net = _copied(model)
    net.eval().requires_grad_(True)
    if layers == "last":
        owners = [one for one in net.modules() if next(one.parameters(recurse=False), None) is not None]
        net.requires_grad_(False)
        owners[-1].requires_grad_(True)
    made = Trainable(net, replace(model, module=frozen(net, model.name)))
    if not made.parameters():
        raise ModelError(f"model {model.name}: has no parameters to train")
    return made


def _copied(model: Model) -> nn.Module:
    name, weights = split_weights(model.name)
    if name == "reference":  # its model has lost its normalisation
        return reference.network(weights=weights)[0]
    module: Callable[[Tensor], object] = model.module
    programs = (torch.fx.GraphModule, torch.jit.ScriptModule)
    if not isinstance(module, nn.Module) or isinstance(module, programs):
        raise ModelError(
            f"model {model.name}: an exported program cannot be trained; name the code that builds the network "
            "(package.module:callable@weights.safetensors), or give an nn.Module from Python"
        )
    return copy.deepcopy(module)
