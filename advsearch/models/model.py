"""Define the model: a network as a differentiable function from display-referred images
to its output.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import Any, final

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_unflatten

from advsearch.errors import InputError, ModelError
from advsearch.interrupts import INTERRUPTS
from advsearch.models.all_at_once import AllAtOnce
from advsearch.models.labels import LabelSet, find_label_set

# ---- recomputation of a batch for its gradient, which saves memory ----


class _Recomputed(torch.autograd.Function):
    """Compute a function of images without storing activations.

    For the gradient, the function is computed again. `torch.utils.checkpoint` does the
    same, but not under `autograd.grad`, and not with `correct_batch_norm_gradients`.
    """

    @staticmethod
    def forward(
        ctx: Any,
        function: Callable[[Tensor], Any],
        structures: list[Any],
        images: Tensor,
    ) -> tuple[Tensor, ...]:
        """Return the tensors in what a function returns for images, without a graph.

        Args:
            ctx: stores what `backward` needs.
            function: the function; it is called again for the gradient.
            structures: list to which the nesting of the returned tensors is appended:
                autograd allows only a flat tuple of tensors as the result.
            images: (N, H, W, 3).
        """
        tensors, structure = tree_flatten(function(images))  # autograd is off in here
        structures.append(structure)
        ctx.function = function
        ctx.save_for_backward(images)
        ctx.mark_non_differentiable(
            *(tensor for tensor in tensors if not tensor.is_floating_point())
        )
        return tuple(tensors)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[None, None, Tensor]:
        """Return the gradient by the images, for the gradients of all returned tensors.

        The function is computed again, this time with a graph. Autograd requires a
        value for each argument of `forward`: None for `function` and `structures`,
        which are no tensors, and the gradient for `images`.
        """
        (images,) = ctx.saved_tensors
        # Autograd switches gradients on in here only if the caller wants a gradient of
        # this gradient (`create_graph=True`).
        create_graph = torch.is_grad_enabled()
        with torch.enable_grad():
            if not create_graph:
                # The graph of this computation begins at the images.
                images = images.detach().requires_grad_()
            tensors, _ = tree_flatten(ctx.function(images))
        image_gradient = _propagate_gradients(
            tensors, images, gradients, create_graph=create_graph
        )
        if image_gradient is None:
            image_gradient = torch.zeros_like(images)
        return None, None, image_gradient


def _propagate_gradients(
    tensors: Sequence[Tensor],
    images: Tensor,
    gradients: Sequence[Tensor | None],
    *,
    create_graph: bool,
) -> Tensor | None:
    """Return the gradient by images for the gradients of tensors; None if it is zero.

    Args:
        tensors: tensors that were computed from the images.
        images: (N, H, W, 3).
        gradients: gradient of each tensor; None if it is zero.
        create_graph: whether the result has a graph, for a gradient of it.
    """
    outputs = []
    output_gradients = []
    for tensor, gradient in zip(tensors, gradients, strict=True):
        if tensor.requires_grad and gradient is not None:
            outputs.append(tensor)
            output_gradients.append(gradient)
    if not outputs:
        return None
    (image_gradient,) = torch.autograd.grad(
        outputs, images, output_gradients, create_graph=create_graph, allow_unused=True
    )
    return image_gradient


def compute_checkpointed(function: Callable[[Tensor], Any], images: Tensor) -> Any:
    """Return `function(images)` without storing activations.

    For the gradient, the function is computed a second time. If each batch is passed by
    a call of its own, memory holds the activations of one batch at a time (Chen et al.
    2016, *Training Deep Nets with Sublinear Memory Cost*, section 3).

    Args:
        function: function that returns a tensor, or lists and mappings of tensors.
        images: (N, H, W, 3).
    """
    # `apply` returns a flat tuple of tensors, and appends their nesting to this list.
    structures: list[Any] = []
    tensors = _Recomputed.apply(function, structures, images)  # type: ignore[no-untyped-call]
    return tree_unflatten(list(tensors), structures[0])


CPU = torch.device("cpu")
PROGRAMS = (torch.fx.GraphModule, torch.jit.ScriptModule)
"""Types of exported and scripted networks, which can be neither copied nor trained."""

Triple = tuple[float, float, float]

#: Named (mean, std) pairs, for values in [0, 1] and channels in RGB order.
PRESETS: dict[str, tuple[Triple, Triple]] = {
    "imagenet": ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "half": ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
    "clip": ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)),
}

Read = Callable[[Any, int], Any]
"""Finds the output in what a network returned (first argument) for a number of images
(second argument). Raises ValueError, with what was expected, if it is not there.
"""

# Smaller probabilities are clamped to this before the logarithm: its derivative is
# finite in float32.
MIN_PROBABILITY = 1e-30
# Maximum distance of a pixel from [0, 1]: finite differences overshoot a little.
RANGE_TOLERANCE = 0.01
# Maximum number of images of a rig whose activations are stored; for more, the network
# recomputes them.
MAX_STORED_IMAGES = 4

OUTPUTS_BY_TASK = {
    "classification": "a row of scores is what a classifier gives",
    "detection": "boxes are what a detector gives",
    "segmentation": "a score for each pixel is what a segmenter gives",
    "depth": "a number for each pixel is what a depth model gives",
    "similarity": "features are what a network without a head gives",
    "command": "actions are what a policy gives",
}
"""What networks return, by the task that reads it, for messages."""


class RemoteNetwork:
    """A network on another machine, which returns answers but no gradients.

    A run stores its answers and reports their cost.
    """

    def __call__(self, pictures: Tensor) -> Any:
        """Return the network's output for images (N, 3, H, W) in [0, 1]."""
        raise NotImplementedError

    @property
    def spending_sentence(self) -> str:
        """What a run has spent, as a sentence."""
        raise NotImplementedError

    def store_answers_in(self, store: Any) -> None:
        """Store answers and what is spent in a run from now on.

        Args:
            store: an `advsearch.runs.store.Store`.
        """
        raise NotImplementedError


class ModelWarning(UserWarning):
    """Warn that a model works, but is hard to attack.

    For example, it returns probabilities, is random, or has no gradient.
    """


def warn(message: str) -> None:
    """Issue a ModelWarning."""
    warnings.warn(message, ModelWarning, stacklevel=4)


@dataclass(frozen=True)
class Preprocessing:
    """What happens to an image before the network sees it, in this order.

    1. Antialiased bilinear resize to `input_size` (only if the size differs).
    2. `x -> low + (high - low) x`, from [0, 1] to `value_range`.
    3. Channel order: RGB, or reversed to BGR.
    4. `x -> (x - mean) / std`, in the units of `value_range` and in the order of
    `channels`.
    5. Layout: NCHW (contiguous), or NHWC.

    Attributes:
        input_size: (height, width) in pixels.
        mean: one number per channel, in the order of `channels`.
        std: likewise; greater than 0.
        value_range: (low, high), the values of black and white.
        layout: "NCHW" or "NHWC".
        channels: "RGB" or "BGR".
        processor: replaces steps 2 to 4. It takes images (N, 3, H, W) in [0, 1], RGB,
            and returns what the network takes, of the same shape.
        resizes: whether there is step 1. Without it the model gets images of the size
            at which they are rendered.
    """

    input_size: tuple[int, int]
    mean: Triple = (0.0, 0.0, 0.0)
    std: Triple = (1.0, 1.0, 1.0)
    value_range: tuple[float, float] = (0.0, 1.0)
    layout: str = "NCHW"
    channels: str = "RGB"
    processor: Callable[[Tensor], Tensor] | None = None
    resizes: bool = True

    def __call__(self, images: Tensor) -> Tensor:
        """Preprocess images for the network; differentiable.

        Args:
            images: (N, H, W, 3) display-referred sRGB in [0, 1], of any floating dtype.

        Returns:
            (N, 3, H, W), or (N, H, W, 3) for the layout NHWC, at `input_size`.
        """
        x = self._resize_to_input(images.permute(0, 3, 1, 2))
        if self.processor:
            # a copy, as the processor may write into its argument
            x = self.processor(x.clone())
        else:
            x = self._normalize(x)
        if self.layout == "NCHW":
            return x.contiguous()
        return x.permute(0, 2, 3, 1).contiguous()

    def _resize_to_input(self, x: Tensor) -> Tensor:
        """Return images (N, 3, H, W) at `input_size`, if the network needs that size."""
        if not self.resizes or (x.shape[2], x.shape[3]) == self.input_size:
            return x
        return F.interpolate(
            x,
            size=self.input_size,
            mode="bilinear",
            align_corners=False,
            antialias=True,
        )

    def _normalize(self, x: Tensor) -> Tensor:
        """Apply value range, channel order and normalization to images (N, 3, H, W).

        Value range and normalization are linear, so that one gain and one offset per
        channel do both. `mean` and `std` are in the order of the channels that the
        network takes, BGR or RGB.
        """
        # (low + (high - low) x - mean) / std = gain x + offset
        low, high = self.value_range
        gain = [(high - low) / std for std in self.std]
        offset = [
            (low - mean) / std for mean, std in zip(self.mean, self.std, strict=True)
        ]
        if self.channels == "BGR":
            x = x.flip(1)
        is_identity = gain == [1.0] * 3 and offset == [0.0] * 3
        if is_identity:
            return x
        gain_of_channel = x.new_tensor(gain).view(3, 1, 1)
        return torch.addcmul(x.new_tensor(offset).view(3, 1, 1), x, gain_of_channel)


@final
@dataclass(frozen=True, eq=False, repr=False)
class Model:
    """A network with all that is needed to run it on an image and to read its output.

    It is created by `load_model`.

    Args:
        module: the network. It takes what `preprocessing` returns. It returns logits in
            a form that `read_logits` accepts, or what `read` takes.
        name: name of the model in messages and results.
        labels: one name per class, in index order.
        preprocessing: preprocessing of an image.
        batch_limits: (minimum, maximum) batch size of the network. Larger batches are
            split, smaller ones padded.
        probabilities: whether the network returns probabilities. Then the model returns
            their logarithms, whose differences are log-odds.
        differentiable: whether a gradient of the logits reaches the image.
        attached: whether the network's calls of `detach` are ignored: without that its
            gradient does not predict its outputs, see `DetachMode`.
        named: whether `labels` are names; False for placeholders ("class 0").
        dtype: dtype of the network's floating-point input.
        device: device of the network. Images are moved there, and the output back.
        read: finds the output in what the network returns for a number of images: a
            tensor (N, ...), or a list with one element for each image; None for logits.
        spec: the argument of `load_model`, if the model can be loaded again from it;
            None if the model exists only in this session.
        cameras: number of cameras of a rig, whose images are side by side in each
            image. The network gets them one by one. If there are several cameras, the
            output for an image is a tuple with the output for each camera.
        make_trainable: returns a new network with the same weights that can be trained
            further. It is needed if `module` is made for inference only; None if a copy
            of `module` can be trained.
    """

    module: Callable[[Tensor], Any] = field(repr=False)
    name: str
    labels: tuple[str, ...] = field(repr=False)
    preprocessing: Preprocessing
    batch_limits: tuple[int, int] = (1, 64)
    probabilities: bool = False
    differentiable: bool = True
    attached: bool = False
    named: bool = True
    dtype: torch.dtype = torch.float32
    device: torch.device = CPU
    read: Read | None = field(default=None, repr=False)
    spec: str | None = field(default=None, repr=False)
    cameras: int = 1
    make_trainable: Callable[[], nn.Module] | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        height, width = self.input_size
        classes = f"{self.classes} classes, " if self.labels else ""
        return f"Model({self.name!r}, {classes}{height} x {width} pixels)"

    @property
    def input_size(self) -> tuple[int, int]:
        """(height, width) in pixels of the images that the network takes.

        Images of other sizes are resized.
        """
        return self.preprocessing.input_size

    @property
    def classes(self) -> int:
        """The number of classes."""
        return len(self.labels)

    def __call__(self, images: Tensor) -> Any:
        """Return the output for one image or a batch, differentiably.

        Args:
            images: (H, W, 3) or (N, H, W, 3), floating, display-referred sRGB in [0,
                1]. The images of several cameras are side by side in each of them.
                Non-finite values pass through: the search handles them.

        Returns:
            Logits (N, classes), float32, on the device of the images; N is 1 for a
            single image. They are log p if the network returns probabilities p. With
            `read`, the output is what that returns. With several cameras (`cameras`),
            it is a list of N tuples: the output for each camera, of batch size 1.

        Raises:
            InputError: they are no images, or values are clearly not in [0, 1].
            ModelError: the network's output is not (N, classes), or `read` finds no
                output in it.
        """
        images = self._split_cameras(check_images(images))
        # whether activations are computed again for the gradient, and not stored
        recomputes = self._must_recompute(images)
        run = partial(self._run_batch, device=images.device)
        outputs = [
            compute_checkpointed(run, batch) if recomputes else run(batch)
            for batch in images.split(self._find_max_batch(recomputes=recomputes))
        ]
        output = outputs[0] if len(outputs) == 1 else join_outputs(outputs)
        return output if self.cameras == 1 else self._group_by_image(output)

    def _run_batch(self, batch: Tensor, device: torch.device) -> Any:
        """Return the output for a batch of images (N, H, W, 3), on a device."""
        # `prepare` fills up a batch that is too small with copies of an image: the
        # outputs for these are cut off.
        output = self.run_network(self.prepare(batch))[: len(batch)]
        return map_tensors(output, partial(_copy_to_device, device=device))

    def _split_cameras(self, images: Tensor) -> Tensor:
        """Return the images of all cameras, (N * cameras, H, W, 3).

        Args:
            images: (N, H, cameras * W, 3), the cameras side by side.
        """
        if self.cameras == 1:
            return images
        images_by_camera: Tensor = images.unflatten(2, (self.cameras, -1))
        return images_by_camera.movedim(2, 1).flatten(0, 1)

    def _group_by_image(self, output: Any) -> list[tuple[Any, ...]]:
        """Return a tuple for each image, with the output for each of its cameras.

        Args:
            output: tensor or list with an element for each camera of each image.
        """
        # A slice of one element keeps the batch axis of a tensor.
        camera_outputs = [output[index : index + 1] for index in range(len(output))]
        return [
            tuple(camera_outputs[start : start + self.cameras])
            for start in range(0, len(camera_outputs), self.cameras)
        ]

    def _must_recompute(self, images: Tensor) -> bool:
        """Return whether the gradient must compute activations again to save memory.

        It must if the images (N, H, W, 3) come from several cameras, there are more
        than `MAX_STORED_IMAGES`, and a gradient is required. A network that takes the
        images of all cameras at once cannot be split into smaller batches.
        """
        return (
            self.cameras > 1
            and not isinstance(self.module, AllAtOnce)
            and len(images) > MAX_STORED_IMAGES
            and images.requires_grad
            and torch.is_grad_enabled()
        )

    def _find_max_batch(self, *, recomputes: bool) -> int:
        """Return the maximum number of images in a batch.

        The images of all cameras of a rig stay in one batch, if they fit into it.

        Args:
            recomputes: whether the activations of each batch are computed again for
                the gradient. Then memory is saved by batches of at most
                `MAX_STORED_IMAGES`.
        """
        max_batch = self.batch_limits[1]
        fits_full_rig = max_batch >= self.cameras
        if fits_full_rig:
            max_batch -= max_batch % self.cameras  # as many full rigs as fit
        return min(max_batch, MAX_STORED_IMAGES) if recomputes else max_batch

    def copy_network(self) -> nn.Module:
        """Return a copy of the network, to train it further.

        Raises:
            ModelError: there is none, since an exported program cannot be trained.
        """
        if self.make_trainable is not None:
            return self.make_trainable()
        if not isinstance(self.module, nn.Module) or isinstance(self.module, PROGRAMS):
            raise ModelError(
                f"model {self.name}: an exported program cannot be trained; name the "
                "code that builds the network "
                "(package.module:callable@weights.safetensors), or give an nn.Module "
                "from Python"
            )
        return copy.deepcopy(self.module)

    def with_network(self, network: nn.Module) -> Model:
        """Return the same model with another network of the same kind.

        The model has a copy of the network in evaluation mode that shares the memory of
        its weights: the copy follows when the network is trained in place. Parameters
        of the copy are other objects, which collect no gradients; those of `network`
        still do.
        """
        shared = copy_sharing_weights(network).eval().requires_grad_(False)
        # `make_trainable` would return the weights of the old network.
        return replace(self, module=shared, make_trainable=None)

    def label_set(self, text: str | int | Sequence[str | int]) -> LabelSet:
        """Return the classes that a text names; see `find_label_set`.

        Args:
            text: such as ``"coffee mug,cup"`` or ``"#504"``.
        """
        return find_label_set(text, self.labels, named=self.named)

    def prepare(self, images: Tensor) -> Tensor:
        """Preprocess a batch of images for the network.

        They get the network's dtype and device. Copies of the last image fill a batch
        that is smaller than the network needs.

        Args:
            images: (N, H, W, 3), where N is at most the maximum batch size.

        Returns:
            What the network takes, with at least the minimum batch size. It shares no
            memory with the images, as the network may write into it.
        """
        n_missing = self.batch_limits[0] - len(images)
        batch = images
        if n_missing > 0:
            batch = torch.cat([images, images[-1:].expand(n_missing, -1, -1, -1)])
        batch = batch.to(device=self.device, dtype=torch.float32)
        x = self.preprocessing(batch).to(self.dtype)
        shares_memory = (
            x.untyped_storage().data_ptr() == images.untyped_storage().data_ptr()
        )
        return x.clone() if shares_memory else x

    def run_network(self, x: Tensor, *, raw: bool = False) -> Any:
        """Run the network on a batch that `prepare` returned.

        Args:
            x: the batch.
            raw: whether to return the network's own return value, before the output is
                read from it.

        Returns:
            The output as `Model` returns it; with `raw`, the network's own return
            value.
        """
        returned = self._call_network(x)
        if raw:
            return returned
        if self.read is not None:
            return read_output(self.read, returned, len(x), self.name)
        logits = read_logits(returned, len(x), len(self.labels), self.name)
        if self.probabilities:
            return logits.clamp_min(MIN_PROBABILITY).log()
        return logits

    def _call_network(self, x: Tensor) -> Any:
        """Return the network's own return value for a batch that `prepare` returned."""
        INTERRUPTS.raise_pending()  # ends here after Ctrl-C
        computes_gradients = torch.is_grad_enabled()
        # For an `attached` model, `detach` does nothing, so that gradients pass it.
        ignores_detach = self.attached and computes_gradients
        detach_mode = DetachMode(ignored=True) if ignores_detach else nullcontext()
        # The network may switch gradients on or off as it runs: this context restores
        # the switch at its end.
        with detach_mode, torch.set_grad_enabled(computes_gradients):
            return self.module(x)


def _copy_to_device(output: Tensor, device: torch.device) -> Tensor:
    """Return an output on a device.

    It is a copy, because the network may write its next output into the same memory. An
    output with a gradient is a new tensor in each call.
    """
    returned = output.to(device)
    may_be_overwritten = returned is output and not output.requires_grad
    return returned.clone() if may_be_overwritten else returned


def copy_sharing_weights(module: nn.Module) -> nn.Module:
    """Return a copy of a module that shares its weights, but not their gradients.

    Parameters of the copy are new objects with the memory of the old ones. Weights that
    were created in `torch.inference_mode` are copied, since autograd cannot use them.
    """

    def make_differentiable(weights: torch.Tensor) -> torch.Tensor:
        """Return weights through which autograd can differentiate."""
        return weights.clone() if weights.is_inference() else weights

    # the object that `deepcopy` uses in place of a copy, by the id of the original
    replacements: dict[int, Any] = {}
    for parameter in module.parameters():
        weights = make_differentiable(parameter.detach())
        replacements[id(parameter)] = nn.Parameter(weights, parameter.requires_grad)
    for buffer in module.buffers():  # these have no gradients
        replacements[id(buffer)] = make_differentiable(buffer)
    return copy.deepcopy(module, replacements)


DETACHING = (torch.Tensor.detach, torch.Tensor.detach_, torch.detach, torch.detach_)


class DetachMode(TorchFunctionMode):
    """Observe whether a network detaches tensors, or ignore that it does.

    RT-DETR and similar networks choose queries by the scores of their encoder, and
    detach the queries from their decoder, in evaluation too. This makes training stable
    (Zhu et al. 2020, arXiv 2010.04159, appendix A.4). But it hides from a search how
    the image changes the queries.

    Attributes:
        ignored: whether `detach` does nothing.
        has_detached: whether the network has called `detach` for a tensor with a
            gradient.
    """

    def __init__(self, *, ignored: bool = False) -> None:
        super().__init__()
        self.ignored = ignored
        self.has_detached = False

    def __torch_function__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        """Call a function of torch, unless it is a `detach` that is ignored.

        torch calls this method in place of each of its functions while the mode is
        active.

        Args:
            function: function of torch that the network calls.
            types: types of its arguments; not used.
            args: its positional arguments; the first of `detach` is the tensor.
            kwargs: its keyword arguments.
        """
        if function in DETACHING:
            tensor = args[0]
            self.has_detached = self.has_detached or tensor.requires_grad
            if self.ignored:
                return tensor
        return function(*args, **(kwargs or {}))


def check_images(images: Tensor) -> Tensor:
    """Return images as a batch (N, H, W, 3).

    Args:
        images: (H, W, 3) or (N, H, W, 3), floating.

    Raises:
        InputError: type, shape or dtype are others, or a value is outside of [0, 1] by
            more than `RANGE_TOLERANCE`.
    """
    expected = (
        "images: expected a floating-point tensor (H, W, 3) or (N, H, W, 3) in [0, 1]"
    )
    if not isinstance(images, Tensor):
        raise InputError(
            f"{expected}, got {type(images).__name__}; convert it with torch.from_numpy"
        )
    if images.dim() not in (3, 4) or images.shape[-1] != 3 or 0 in images.shape:
        raise InputError(
            f"{expected}, got the shape {tuple(images.shape)}; channels come last"
        )
    if not images.is_floating_point():
        raise InputError(f"{expected}, got {images.dtype}; divide 8-bit values by 255")
    _check_unit_range(images, expected)
    return images if images.dim() == 4 else images.unsqueeze(0)


def _check_unit_range(images: Tensor, expected: str) -> None:
    """Raise InputError if a value is outside of [0, 1] by more than `RANGE_TOLERANCE`.

    NaN and infinity pass: the search handles them.

    Args:
        images: tensor of any shape, not empty.
        expected: beginning of the message.
    """
    low, high = (float(limit) for limit in images.detach().aminmax())
    is_too_low = -math.inf < low < -RANGE_TOLERANCE
    is_too_high = 1 + RANGE_TOLERANCE < high < math.inf
    if is_too_low or is_too_high:
        raise InputError(
            f"{expected}, got values from {low:.4g} to {high:.4g}; `value_range` is "
            "for the network's side"
        )


def read_output(read: Read, returned: Any, count: int, name: str) -> Any:
    """Read the output from what a network returned.

    Args:
        read: reads it; see `Read`.
        returned: what the network returned.
        count: number of images.
        name: name of the model, for messages.

    Raises:
        ModelError: there is no output, or not one for each image.
    """
    try:
        output = read(returned, count)
    except ValueError as error:
        # `read` is usually a method of a task. The name of that task is for the advice.
        task = getattr(getattr(read, "__self__", None), "name", None)
        raise ModelError(
            f"model {name}: {error}, got {describe_output(returned)}; "
            f"{_advise_on_output(returned, task)}"
        ) from None
    if len(output) != count:
        raise ModelError(
            f"model {name}: expected an output for each of {count} "
            f"images, got {len(output)}"
        )
    # torch computes some gradients of batch norms wrongly; hooks correct them.
    correct_batch_norm_gradients(output)
    return output


def _advise_on_output(returned: Any, task: str | None) -> str:
    """Return what to do about an output that a task cannot read.

    Args:
        returned: what the network returned.
        task: name of the task; None if it is not known.
    """
    advice = _advise_on_missing_scores(returned)
    if advice:
        return advice
    other_task_advice = "wrap the network, or ask for another task"
    if task == "command":
        # Actions have the form of rows of scores: the guess would be classification.
        return other_task_advice
    likely_task = _guess_task(returned)
    if likely_task and likely_task != task:
        return _advise_other_task(likely_task)
    return other_task_advice


def describe_output(returned: Any) -> str:
    """Describe an output of a network by its type, or the shape of a tensor."""
    if isinstance(returned, Tensor):
        return f"one of shape {tuple(returned.shape)}"
    return type(returned).__name__


def join_outputs(outputs: Sequence[Any]) -> Any:
    """Concatenate the outputs of several batches: tensors (N, ...), or lists."""
    if isinstance(outputs[0], Tensor):
        return torch.cat(list(outputs))
    return list(chain.from_iterable(outputs))


def map_tensors(output: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """Apply a function to every tensor in an output.

    The result has plain dicts and lists. `torch.utils._pytree` cannot be used, because
    for it a subclass of dict that is not registered, such as a library's output, is a
    leaf.

    Args:
        output: a tensor, or mappings and sequences of tensors and other values.
        function: function of a tensor; other values stay as they are.
    """
    if isinstance(output, Tensor):
        return function(output)
    if isinstance(output, Mapping):
        return {name: map_tensors(part, function) for name, part in output.items()}
    if isinstance(output, (list, tuple)):
        return [map_tensors(part, function) for part in output]
    return output


def list_tensors(output: Any) -> list[Tensor]:
    """Return the tensors in an output, in their order."""
    tensors: list[Tensor] = []

    def collect(tensor: Tensor) -> Tensor:
        """Append a tensor to the list, and return it unchanged."""
        tensors.append(tensor)
        return tensor

    map_tensors(output, collect)
    return tensors


def read_logits(output: Any, count: int, classes: int | None, name: str) -> Tensor:
    """Return the logits (count, classes), float32, in a network's return value.

    Accepted are a tensor, an object with a tensor `logits`, a mapping with a tensor
    ``"logits"``, and a tuple or list whose first element is a tensor.

    Args:
        output: output of the network.
        count: number of images.
        classes: number of classes; None if it is unknown.
        name: name of the model, for messages.

    Raises:
        ModelError: there is no such tensor, or its shape or type is not that of logits.
    """
    # The usual case, a tensor of the right shape, comes first because it is fast. It
    # never applies if `classes` is None.
    if (
        isinstance(output, Tensor)
        and output.is_floating_point()
        and output.shape == (count, classes)
    ):
        if output.requires_grad:
            correct_batch_norm_gradients(output)
        return output.float()
    return _find_checked_logits(output, count, classes, name)


def _find_checked_logits(
    output: Any, count: int, classes: int | None, name: str
) -> Tensor:
    """Return the logits in a network's return value of any accepted form.

    The arguments and errors are those of `read_logits`.
    """
    tensor = _find_logits(output)
    expected = (
        f"model {name}: expected logits of shape ({count}, {classes or 'classes'})"
    )
    _check_is_classifier(output, tensor, expected)
    if tensor is None:
        raise ModelError(
            f"{expected}, got {type(output).__name__}; wrap the network "
            "so that it returns one tensor"
        )
    _check_logits(tensor, count, classes, expected)
    correct_batch_norm_gradients(tensor)
    return tensor.float()


def _check_logits(
    tensor: Tensor, count: int, classes: int | None, expected: str
) -> None:
    """Raise ModelError if a tensor is not of the shape or the type of logits.

    Args:
        tensor: tensor in the output of a network.
        count: number of images.
        classes: number of classes; None if it is unknown.
        expected: beginning of the message.
    """
    shape = tuple(tensor.shape)
    has_rows = len(shape) == 2 and shape[0] == count and shape[1] >= 2
    if not has_rows or (classes is not None and shape[1] != classes):
        raise ModelError(f"{expected}, got {shape}; {_advise_on_shape(shape)}")
    if not tensor.is_floating_point():
        raise ModelError(
            f"{expected} and floating type, got {tensor.dtype}; return "
            "scores, not the predicted class"
        )


def _check_is_classifier(output: Any, tensor: Tensor | None, expected: str) -> None:
    """Raise ModelError for an output that is clearly not that of a classifier.

    Such an output has losses (the network is in training mode), class indices instead
    of scores (an argmax was taken), or the form of another task's output.

    Args:
        output: output of the network.
        tensor: tensor of logits in it; None if there is none.
        expected: beginning of the message, such as "model net: expected logits".
    """
    advice = _advise_on_missing_scores(output)
    if advice:
        got = describe_output(output if tensor is None else tensor)
        raise ModelError(f"{expected}, got {got}; {advice}")
    likely_task = _guess_task(output)
    other_tasks = ("detection", "segmentation", "depth", "similarity")
    # For a map of scores for each pixel, the caller raises an error with better advice,
    # about its shape.
    is_map = tensor is not None and tensor.dim() == 4
    if likely_task in other_tasks and not is_map:
        raise ModelError(
            f"{expected}, got {describe_output(output)}; "
            f"{_advise_other_task(likely_task)}"
        )


def correct_batch_norm_gradients(output: Any) -> None:
    """Add hooks to the graph of an output that prevent wrong gradients of batch norms.

    On the CPU, batch norms of torch 2.13 read the gradient of a single image in a wrong
    order, without a warning, if it comes from ``flatten(2).transpose(1, 2)``. Networks
    whose convolutions are followed by a transformer are examples. Gradients of batches
    are right. The batch norm assumes that its gradient has the memory layout of its
    input, so the hooks copy it to that layout.

    Args:
        output: output of a network, whose graph gets hooks.
    """
    # Walk back through the graph of the output, and hook every batch norm in it.
    pending: list[Any] = [tensor.grad_fn for tensor in list_tensors(output)]
    visited = {None}  # a tensor without a graph has the node None
    while pending:
        node = pending.pop()
        if node in visited:
            continue
        visited.add(node)
        pending.extend(next_node for next_node, _ in node.next_functions)
        if node.name().startswith("NativeBatchNorm"):
            # `empty_like` keeps the order of axes in memory; a "meta" tensor takes
            # none.
            strides = torch.empty_like(node._saved_input, device="meta").stride()
            node.register_prehook(partial(_apply_strides, strides))


def _apply_strides(
    strides: tuple[int, ...], gradients: tuple[Tensor | None, ...]
) -> tuple[Tensor | None, ...]:
    """Return the gradients that reach a batch norm, the first with these strides.

    Args:
        strides: strides of the input of the batch norm.
        gradients: gradients with respect to each output of the batch norm. The first
            output is the normalized images; the others are statistics.
    """
    gradient, *rest = gradients
    if gradient is None or gradient.stride() == strides:
        return gradients
    strided = torch.empty_strided(
        gradient.shape, strides, dtype=gradient.dtype, device=gradient.device
    )
    return strided.copy_(gradient), *rest


def _find_logits(output: Any) -> Tensor | None:
    """Return the tensor of logits in an output; None if there is none."""
    if isinstance(output, Mapping):
        output = output.get("logits")
    elif not isinstance(output, Tensor) and hasattr(output, "logits"):
        output = output.logits
    elif isinstance(output, (tuple, list)) and output:
        output = output[0]
    return output if isinstance(output, Tensor) else None


def _find_scores(returned: Any) -> Any:
    """Return the scores of images or of pixels in an output; None if it has none.

    Segmenters of torchvision return scores under "out".
    """
    if isinstance(returned, Mapping) and "out" in returned:
        return returned["out"]
    return _find_logits(returned)


def _advise_on_missing_scores(returned: Any) -> str:
    """Return what to do about an output without scores; "" for any other output.

    Such an output has losses, as in training, or the indices of chosen classes.

    Args:
        returned: what the network returned.
    """
    values = list(returned.values()) if isinstance(returned, Mapping) else [returned]
    are_losses = all(isinstance(value, Tensor) and value.ndim == 0 for value in values)
    if values and are_losses:
        return (
            "one number for all images is a loss: give the network as it is outside "
            "of training"
        )
    # The first element of a list may be the labels of boxes: no advice is given.
    if isinstance(returned, (list, tuple)):
        return ""
    tensor = _find_scores(returned)
    # Chosen classes are integers, (N,) or for each pixel (N, H, W).
    if tensor is None or tensor.is_floating_point() or tensor.ndim not in (1, 3):
        return ""
    return (
        f"these are the classes that it chose ({tensor.dtype}): return its scores, "
        "as they are before the argmax"
    )


def _guess_task(returned: Any) -> str | None:
    """Guess the task of a network from its output, for advice in a message.

    Args:
        returned: what the network returned.

    Returns:
        Name of a task in `OUTPUTS_BY_TASK`; None if nothing suggests one.
    """
    if _looks_like_boxes(returned):
        return "detection"
    if _looks_like_depth(returned):
        return "depth"
    # an encoder of transformers
    if hasattr(returned, "last_hidden_state") and not hasattr(returned, "logits"):
        return "similarity"
    if isinstance(returned, (tuple, list)):
        maps = [x for x in returned if isinstance(x, Tensor) and x.ndim == 4]
        if len({feature_map.shape[2:] for feature_map in maps}) > 1:
            return None  # feature maps of several sizes
    scores = _find_scores(returned)
    if not isinstance(scores, Tensor):
        return None
    # scores are (N, classes), or for each pixel (N, classes, H, W)
    task_of_dimensions = {2: "classification", 4: "segmentation"}
    return task_of_dimensions.get(scores.dim())


def _looks_like_depth(returned: Any) -> bool:
    """Return whether an output of a network is a mapping that names depths."""
    if not isinstance(returned, Mapping):
        return False
    names = [str(key) for key in returned]
    return any("depth" in name or "disparity" in name for name in names)


def _looks_like_boxes(returned: Any) -> bool:
    """Return whether an output of a network looks like that of a detector.

    Detectors return one of these: a tuple that begins with boxes (N, K, 4), followed by
    scores; a mapping or an object with a field "boxes" or "pred_boxes"; or a list of
    such mappings, one for each image.
    """
    is_sequence = isinstance(returned, (tuple, list))
    first = returned[0] if is_sequence and returned else returned
    if isinstance(first, Tensor):
        is_boxes = first.dim() == 3 and first.shape[2] == 4
        # Boxes are followed by their scores.
        has_scores = is_sequence and len(returned) > 1
        return has_scores and is_boxes
    # keys of a mapping, or attributes of an object
    field_names = first if isinstance(first, Mapping) else dir(first)
    return "boxes" in field_names or "pred_boxes" in field_names


def _advise_other_task(name: str) -> str:
    """Return the advice to use another task."""
    return f"{OUTPUTS_BY_TASK[name]}: use `task={name}`"


def _advise_on_shape(shape: tuple[int, ...]) -> str:
    """Return what to do about an output whose shape is not (N, classes)."""
    if len(shape) == 4:
        return (
            f"{_advise_other_task('segmentation')}. If these are a classifier's "
            "feature maps, wrap the network to pool them"
        )
    if len(shape) > 2:
        return (
            "pass a classifier, or wrap the network to pool its output; if it is a "
            "detector, use `task=detection`"
        )
    if len(shape) == 2 and shape[1] == 1:
        return (
            "one score is not enough: wrap the network to return a score for each "
            "of the two classes"
        )
    if len(shape) == 1:
        return "the network dropped its batch dimension: wrap it to keep it"
    return "wrap the network so that it returns one row of scores per image"
