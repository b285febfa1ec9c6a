"""Features of a network: the numbers that its last layer turns into logits.

The last layer is found by running the network once: by hooks on the `nn.Linear` layers
and convolutions of an `nn.Module`, or from such operators in a graph (`torch.export`).
If that layer returns one value per class, its input are the features, else its output.
For any other network, features are the logits minus their mean. Maps and sequences are
averaged over their positions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, final

import torch
from torch import Tensor, fx, nn

from advsearch.models.model import Model, check_images, join_outputs

LAYERS = (nn.Linear, nn.Conv1d, nn.Conv2d, nn.Conv3d)

_ATEN = torch.ops.aten

CHANNELS_LAST = {
    getattr(_ATEN, name).default: int(name == "addmm")
    for name in ("linear", "addmm", "mm", "matmul")
}
CHANNELS_SECOND = {
    getattr(_ATEN, name).default: 0
    for name in ("conv1d", "conv2d", "conv3d", "convolution")
}
OPERATORS: dict[Any, int] = {**CHANNELS_LAST, **CHANNELS_SECOND}
"""Operators that may be a last layer, and the index of the activation among their
arguments: 1 for ``addmm(bias, activation, weights)``, else 0.
"""

Read = Callable[[Tensor], Tensor]
"""Computes features (N, F) of a batch of N images as `Model.prepare` returns it."""


@final
@dataclass(frozen=True, eq=False)
class Features:
    """A model as a differentiable function from images to features.

    `features_of` creates it.
    """

    model: Model
    compute_batch: Read = field(repr=False)
    size: int  # F, numbers per image
    # Where the features come from, for messages and reports: "the input of head
    # (Linear), 192 numbers".
    source_description: str
    # False if the features are the logits, since no last layer was found.
    penultimate: bool = True

    def __call__(self, images: Tensor) -> Tensor:
        """Compute the features (N, F), float32, of images, differentiably.

        The images are as `Model` takes them. The network is run for the features only:
        logits need another run.

        Raises:
            InputError: they are no images, or values are clearly not in [0, 1].
        """
        images = check_images(images)
        batches = images.split(self.model.batch_limits[1])
        features: Tensor = join_outputs(
            [
                self.compute_batch(self.model.prepare(b))[: len(b)].float()
                for b in batches
            ]
        )
        return features.to(images.device)


def features_of(model: Model) -> Features:
    """Find the features of a model: the numbers that its last layer turns into logits.

    The model is run on gray images. Layers are found by hooks on PyTorch modules, or by
    running an exported graph node by node. If neither finds one, features are the
    logits minus their mean.
    """
    # Two images, if the network takes them: with one, an axis of size 1 that is not the
    # batch would look like it.
    batch_size = min(2, model.batch_limits[1])
    gray = torch.full((batch_size, *model.input_size, 3), 0.5)
    with torch.no_grad():
        x = model.prepare(gray)
        for trace_calls in (_trace_modules, _trace_graph):
            reader_and_layer = _find_last_layer(trace_calls, model, x)
            if reader_and_layer is not None:
                read, layer_description = reader_and_layer
                size = read(x).shape[1]
                description = f"the {layer_description}, {size} numbers"
                return Features(model, read, size, description)
    return _make_logit_features(model)


def _make_logit_features(model: Model) -> Features:
    """Return the logits of a model as its features, less their mean over the classes."""
    description = (
        f"the logits, {model.classes} numbers: no layer before them can be read in "
        f"a {type(model.module).__name__}"
    )

    def center_logits(x: Tensor) -> Tensor:
        """Return the logits of a batch, less their mean over the classes."""
        logits: Tensor = model.run_network(x)
        return logits - logits.mean(dim=1, keepdim=True)

    return Features(model, center_logits, model.classes, description, penultimate=False)


class _Call(NamedTuple):
    """A call of a layer of a network.

    Attributes:
        layer: a module, or a node of a graph.
        name: name for messages.
        input: input of the call; None if it is a weight and no activation, as where an
            operator multiplies two weights.
        output: output of the call.
        axis: axis of the channels in input and output.
    """

    layer: Any
    name: str
    input: Tensor | None
    output: Tensor
    axis: int


Calls = Callable[[Any, Tensor, Any], list[_Call]]
"""Runs a network (first argument) on a batch (second argument), and returns the calls
of its layers in their order. If the third argument is a layer, only its calls are
returned.
"""


def _find_last_layer(
    trace_calls: Calls, model: Model, x: Tensor
) -> tuple[Read, str] | None:
    """Find the features (N, F) of the last layer of a network.

    The head is the last layer whose output has a channel for each class. Features are
    its input; without a head they are the output of the last layer. They are averaged
    over all axes but the batch and the channels.

    Args:
        trace_calls: runs a network, and returns the calls of all of its layers, or of
            one of them (`Calls`).
        model: model with the network.
        x: a batch for it.

    Returns:
        The function that computes them, and a description of the layer; None if there
        is no such layer.
    """
    only_layer = None  # all layers are traced
    # calls whose output has a row for each image
    usable = [
        call
        for call in trace_calls(model.module, x, only_layer)
        if len(call.output) == len(x)
    ]
    if not usable:
        return None
    heads = [call for call in usable if call.output.shape[call.axis] == model.classes]
    last = (heads or usable)[-1]
    # the attribute of a call (`_Call`) that holds the features
    attribute = "input" if heads else "output"
    has_features = getattr(last, attribute) is not None  # an input may be a weight
    if not has_features:
        return None
    read = partial(_read_layer_features, trace_calls, model.module, last, attribute)
    return read, f"{attribute} of {last.name}"


def _read_layer_features(
    trace_calls: Calls, network: Any, layer_call: _Call, attribute: str, batch: Tensor
) -> Tensor:
    """Return the features (N, F) of a batch, by running the network on it.

    Args:
        trace_calls: runs the network, and returns the calls of a layer.
        network: the network.
        layer_call: any call of the layer.
        attribute: attribute of a call that holds the features, "input" or "output".
        batch: batch to run the network on.
    """
    # The last call counts if the network calls the layer several times.
    call = trace_calls(network, batch, layer_call.layer)[-1]
    value: Tensor = getattr(call, attribute)
    channels_last = value.movedim(layer_call.axis, -1)
    if value.dim() > 2:
        return channels_last.flatten(1, -2).mean(dim=1)
    return channels_last


def _trace_modules(network: Any, x: Tensor, only: nn.Module | None) -> list[_Call]:
    """Return the calls of the layers (`LAYERS`) of a module in their order, by hooks.

    Args:
        network: any network; a scripted program, or what is no `nn.Module`, has no such
            calls.
        x: a batch to run it on.
        only: if set, only calls of this layer are recorded; a layer of the network.
    """
    is_program = isinstance(network, torch.jit.ScriptModule)
    if is_program or not isinstance(network, nn.Module):
        return []
    names: dict[nn.Module, str] = {
        layer: name
        for name, layer in network.named_modules()
        if isinstance(layer, LAYERS)
    }
    recorder = _CallRecorder(names)
    with ExitStack() as hooks:
        for layer in names if only is None else [only]:
            handle = layer.register_forward_hook(recorder, with_kwargs=True)
            hooks.callback(handle.remove)
        network(x)
    return recorder.calls


@dataclass(eq=False)
class _CallRecorder:
    """Records the calls of layers, as a hook that PyTorch calls after each of them.

    Attributes:
        names: name of each layer in its network; empty for the network itself.
        calls: the calls so far.
    """

    names: Mapping[nn.Module, str]
    calls: list[_Call] = field(default_factory=list)

    def __call__(
        self,
        layer: nn.Module,
        args: tuple[Tensor, ...],
        kwargs: dict[str, Tensor],
        output: Tensor,
    ) -> None:
        """Record a call of a layer.

        It is left out if its output has another number of rows than its input: it does
        not work on the images of the batch.
        """
        input = args[0] if args else kwargs["input"]
        keeps_batch = len(input) == len(output) and input.dim() > 1
        if keeps_batch:
            # The name is "" if the network itself is a layer.
            layer_name = self.names[layer] or "the network"
            name = f"{layer_name} ({type(layer).__name__})"
            # Convolutions have (N, channels, ...).
            channel_axis = -1 if isinstance(layer, nn.Linear) else 1
            self.calls.append(_Call(layer, name, input, output, channel_axis))


def _trace_graph(network: Any, x: Tensor, only: fx.Node | None) -> list[_Call]:
    """Run a graph of operators, and return the calls of its layers (`OPERATORS`).

    Args:
        network: any network; only a graph, such as a `torch.export` program, has such
            calls.
        x: a batch to run it on.
        only: if set, only calls of this node are recorded.
    """
    if not isinstance(network, fx.GraphModule):
        return []
    reader = _GraphReader(network, only)
    reader.run(x)
    return reader.calls


class _GraphReader(fx.Interpreter):
    """Records the calls of the layers of a graph while it runs the graph.

    Attributes:
        only: if not None, only calls of this node are recorded.
        calls: the calls so far.
    """

    def __init__(self, network: fx.GraphModule, only: fx.Node | None) -> None:
        super().__init__(network)
        self.only = only
        self.calls: list[_Call] = []

    def run_node(self, n: fx.Node) -> Any:
        """Run a node, and record its call if it is a layer."""
        value = super().run_node(n)
        is_layer = n.op == "call_function" and n.target in OPERATORS
        is_traced = self.only is None or n is self.only
        if is_layer and is_traced and isinstance(value, Tensor):
            self.calls.append(
                _Call(
                    layer=n,
                    name=f"the operator {n.name}",
                    input=self._find_activation(n),
                    output=value,
                    axis=-1 if n.target in CHANNELS_LAST else 1,
                )
            )
        return value

    def _find_activation(self, layer: fx.Node) -> Any:
        """Return the activation that a layer gets; None if that is a weight."""
        source = layer.args[OPERATORS[layer.target]]
        # Weights come from `get_attr` nodes, activations from other nodes.
        if isinstance(source, fx.Node) and source.op != "get_attr":
            # `env` has the values of all nodes that are still needed. Those of this
            # node's arguments are deleted after `run_node`.
            return self.env[source]
        return None


# names of the features in an output of transformers, the most suitable first
PARTS = ("image_embeds", "pooler_output", "last_hidden_state")


def pooled(returned: Any, *, token: bool) -> Tensor | None:
    """Return the features (N, D) in an output of a network; None if there are none.

    Args:
        returned: a tensor, or an object or mapping with one of `PARTS`. Maps (N, D, H,
            W) are averaged over their positions.
        token: whether the features of tokens (N, T, D) are those of the first token, as
            in networks with a class token; otherwise they are the mean over tokens.
    """
    for part in PARTS:
        if isinstance(returned, Mapping):
            value = returned.get(part)
        else:
            value = getattr(returned, part, None)
        if isinstance(value, Tensor):
            return _average_positions(value, token=token)
    return returned if isinstance(returned, Tensor) else None


def _average_positions(value: Tensor, *, token: bool) -> Tensor:
    """Return the features (N, D) of images from those of their tokens or positions.

    Args:
        value: features of tokens (N, T, D), maps (N, D, H, W), or features (N, D).
        token: whether to return those of the first token instead of the mean.
    """
    if value.dim() == 3:  # tokens
        return value[:, 0] if token else value.mean(dim=1)
    if value.dim() == 4:  # maps
        return value.flatten(2).mean(dim=2)
    return value
