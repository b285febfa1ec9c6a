"""What a network sees before it decides: the numbers that its last layer turns into logits.

It is found by running the network once: a hook on the last `nn.Linear` or convolution of an `nn.Module`, or the last
such operator of a graph (`torch.export`), reads its input where it returns one value per class, else its output.
For any other network it is the logits less their mean. Maps and sequences are averaged over their positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, final

import torch
from torch import Tensor, fx, nn

from advsearch.models.model import Model, checked_images

LAYERS = (nn.Linear, nn.Conv1d, nn.Conv2d, nn.Conv3d)

_ATEN = torch.ops.aten

OPERATORS: dict[Any, int] = {
    _ATEN.linear.default: 0,
    _ATEN.addmm.default: 1,
    _ATEN.mm.default: 0,
    _ATEN.matmul.default: 0,
    _ATEN.conv1d.default: 0,
    _ATEN.conv2d.default: 0,
    _ATEN.conv3d.default: 0,
    _ATEN.convolution.default: 0,
}
"""Operators that may be a last layer, and which of their arguments is the activation."""

CHANNELS_LAST = (_ATEN.linear.default, _ATEN.addmm.default, _ATEN.mm.default, _ATEN.matmul.default)

Read = Callable[[Tensor], Tensor]
"""From a batch as `Model.batches` yields it, N images, to features (N, F)."""


@final
@dataclass(frozen=True, eq=False)
class Features:
    """A model seen as a differentiable function from images to features. Made by `features_of`.

    Args:
        model: the network and its preprocessing.
        read: what gets the features out of it.
        size: F, numbers per image.
        source: where they come from, for messages and reports, e.g. "the input of head (Linear), 192 numbers".
        penultimate: False where they are the logits, for want of anything else.
    """

    model: Model
    read: Read = field(repr=False)
    size: int
    source: str
    penultimate: bool = True

    def __call__(self, images: Tensor) -> Tensor:
        """Return the features (N, F), float32, of images as `Model` takes them; differentiable.

        One more run of the network: the logits are not computed along.

        Raises:
            InputError: not an image, or values that are clearly not in [0, 1].
        """
        images = checked_images(images)
        batches = images.split(self.model.batch_limits[1])
        parts = [self.read(self.model.prepared(one))[: len(one)].float() for one in batches]
        return (parts[0] if len(parts) == 1 else torch.cat(parts)).to(images.device)


def features_of(model: Model) -> Features:
    """Return the penultimate features of a model, found by showing it grey images; see the module's docstring."""
    grey = torch.full((min(2, model.batch_limits[1]), *model.input_size, 3), 0.5)
    with torch.no_grad():
        x = model.prepared(grey)
        for find in (_layer, _node):
            found = find(model, x)
            if found is not None:
                read, where = found
                size = read(x).shape[1]
                return Features(model, read, size, f"the {where}, {size} numbers")
    why = f"the logits, {model.classes} numbers: no layer before them can be read in a {type(model.module).__name__}"

    def centred(x: Tensor) -> Tensor:
        logits: Tensor = model.ask(x)
        return logits - logits.mean(dim=1, keepdim=True)

    return Features(model, centred, model.classes, why, penultimate=False)


def _layer(model: Model, x: Tensor) -> tuple[Read, str] | None:
    """Return how to read the last layer of a module that calls its layers, if it has one."""
    network = model.module
    if not isinstance(network, nn.Module) or isinstance(network, torch.jit.ScriptModule):
        return None
    named: dict[nn.Module, str] = {layer: name for name, layer in network.named_modules() if isinstance(layer, LAYERS)}
    calls: list[tuple[nn.Module, Tensor, Tensor]] = []
    _watch(network, list(named), x, calls)
    usable = [(layer, made) for layer, given, made in calls if len(given) == len(made) == len(x) and given.dim() > 1]
    heads = [layer for layer, made in usable if made.shape[_axis(layer)] == model.classes]
    if not usable:
        return None
    layer = heads[-1] if heads else usable[-1][0]
    where = f"{'input' if heads else 'output'} of {named[layer] or 'the network'} ({type(layer).__name__})"

    def read(batch: Tensor) -> Tensor:
        seen: list[tuple[nn.Module, Tensor, Tensor]] = []
        _watch(network, [layer], batch, seen)
        _, given, made = seen[-1]
        return _pooled(given if heads else made, _axis(layer))

    return read, where


def _watch(
    network: nn.Module, layers: list[nn.Module], x: Tensor, calls: list[tuple[nn.Module, Tensor, Tensor]]
) -> None:
    """Run the network and append every call of the layers: the layer, what went in, what came out."""

    def keep(layer: nn.Module, args: tuple[Tensor, ...], kwargs: dict[str, Tensor], made: Tensor) -> None:
        calls.append((layer, args[0] if args else kwargs["input"], made))

    handles = [layer.register_forward_hook(keep, with_kwargs=True) for layer in layers]
    try:
        network(x)
    finally:
        for handle in handles:
            handle.remove()


def _axis(layer: nn.Module) -> int:
    return -1 if isinstance(layer, nn.Linear) else 1


def _node(model: Model, x: Tensor) -> tuple[Read, str] | None:
    """Return how to read the last layer of a graph of operators, such as a program of `torch.export`, if it has one."""
    graph = model.module
    if not isinstance(graph, fx.GraphModule):
        return None
    layers = [node for node in graph.graph.nodes if node.op == "call_function" and node.target in OPERATORS]
    made = _values(graph, layers, x)
    layers = [node for node in layers if node in made and len(made[node]) == len(x)]
    heads = [node for node in layers if made[node].shape[_axis_of(node)] == model.classes]
    if not layers:
        return None
    layer = heads[-1] if heads else layers[-1]
    wanted = layer.args[OPERATORS[layer.target]] if heads else layer
    if not isinstance(wanted, fx.Node) or wanted.op == "get_attr":
        return None
    where = f"{'input' if heads else 'output'} of the operator {layer.name}"

    def read(batch: Tensor) -> Tensor:
        return _pooled(_values(graph, [wanted], batch)[wanted], _axis_of(layer))

    return read, where


def _values(graph: fx.GraphModule, nodes: list[fx.Node], x: Tensor) -> dict[fx.Node, Tensor]:
    """Run a graph and return the values of some of its nodes."""
    wanted, found = set(nodes), {}

    class Reader(fx.Interpreter):
        def run_node(self, n: fx.Node) -> Any:
            value = super().run_node(n)
            if n in wanted and isinstance(value, Tensor):
                found[n] = value
            return value

    Reader(graph).run(x)
    return found


def _axis_of(node: fx.Node) -> int:
    return -1 if node.target in CHANNELS_LAST else 1


def _pooled(value: Tensor, axis: int) -> Tensor:
    """Return features (N, F): the mean over all axes but the first and `axis`."""
    channels_last = value.movedim(axis, -1)
    return channels_last.flatten(1, -2).mean(dim=1) if value.dim() > 2 else channels_last
