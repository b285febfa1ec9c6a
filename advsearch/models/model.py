"""The model: any network, seen as a differentiable function from display-referred
images to its output.
"""

from __future__ import annotations

import copy
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

# ---------------------------------------------------------------------------------------------------------------------
# A part of a network's work that is done again for its gradient, so that nothing is
# kept of it meanwhile.


class _Recomputed(torch.autograd.Function):
    """`torch.utils.checkpoint` does the same, but not under `autograd.grad`, or not
    with `mend_batch_norms`.
    """

    @staticmethod
    def forward(
        ctx: Any, ask: Callable[[Tensor], Any], structure: list[Any], images: Tensor
    ) -> tuple[Tensor, ...]:
        tensors, form = tree_flatten(ask(images))  # autograd is off in here
        structure.append(form)
        ctx.ask = ask
        ctx.save_for_backward(images)
        ctx.mark_non_differentiable(
            *(one for one in tensors if not one.is_floating_point())
        )
        return tuple(tensors)

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor | None) -> tuple[None, None, Tensor]:
        (images,) = ctx.saved_tensors  # again: it is to be differentiated once more
        again = torch.is_grad_enabled()
        with torch.enable_grad():
            images = images if again else images.detach().requires_grad_()
            tensors, _ = tree_flatten(ctx.ask(images))
        pairs = [
            pair
            for pair in zip(tensors, slopes, strict=True)
            if pair[0].requires_grad and pair[1] is not None
        ]
        if not pairs:
            return None, None, torch.zeros_like(images)
        outputs, given = zip(*pairs, strict=True)
        (slope,) = torch.autograd.grad(
            outputs, images, given, create_graph=again, allow_unused=True
        )
        return None, None, torch.zeros_like(images) if slope is None else slope


def recomputed(ask: Callable[[Tensor], Any], images: Tensor) -> Any:
    """Return what `ask` returns of images: tensors, in lists and mappings. Its gradient
    asks a second time, and takes the memory of one part instead of that of all (Chen et
    al. 2016, *Training Deep Nets with Sublinear Memory Cost*, section 3).
    """
    structure: list[Any] = []
    tensors = _Recomputed.apply(ask, structure, images)  # type: ignore[no-untyped-call]
    return tree_unflatten(list(tensors), structure[0])


CPU = torch.device("cpu")
PROGRAMS = (torch.fx.GraphModule, torch.jit.ScriptModule)
"""What exported and scripted networks are, which are run as they are: they are not
copied, and not trained.
"""

Triple = tuple[float, float, float]

#: Named (mean, std) pairs, for values in [0, 1] and channels in RGB order.
PRESETS: dict[str, tuple[Triple, Triple]] = {
    "imagenet": ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "half": ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
    "clip": ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)),
}

Read = Callable[[Any, int], Any]
"""From what a network returned to so many images, to its output; ValueError says what
was expected.
"""

# others count as this before the logarithm is taken: its derivative is finite in
# float32
SMALLEST_PROBABILITY = 1e-30
# how far outside [0, 1] a pixel may lie: finite differences overshoot a little
RANGE_TOLERANCE = 0.01
# pictures of a rig of which all is kept that the network has computed; of more, it
# computes it again
KEPT = 4

GIVEN_BY = {
    "classification": "a row of scores is what a classifier gives",
    "detection": "boxes are what a detector gives",
    "segmentation": "a score for each pixel is what a segmenter gives",
    "depth": "a number for each pixel is what a model of depth gives",
    "similarity": "features are what a network without a head gives",
    "command": "actions are what a policy gives",
}
"""What networks of a task return, by task, for messages."""


class RemoteNetwork:
    """A network elsewhere that only answers. A run keeps its answers, and states what
    they cost.
    """

    def __call__(self, pictures: Tensor) -> Any:
        """Return what the network says of pictures (N, 3, H, W) in [0, 1]."""
        raise NotImplementedError

    @property
    def sentence(self) -> str:
        """What a run has spent, for its reader."""
        raise NotImplementedError

    def keep_in(self, store: Any) -> None:
        """Keep answers and what is spent in a run from here on: an
        `advsearch.runs.store.Store`.
        """
        raise NotImplementedError


class ModelWarning(UserWarning):
    """A model that works, but not as an attack would like it to (probabilities,
    randomness, no gradient).
    """


def warn(message: str) -> None:
    """Warn of a model (ModelWarning)."""
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

    A `processor` stands for steps 2 to 4: from pictures (N, 3, H, W) in [0, 1], RGB, to
    what the network takes, of the same shape. Without `resizes` there is no first step:
    such a model is given pictures as they are rendered.
    """

    input_size: tuple[int, int]  # (height, width) in pixels
    mean: Triple = (0.0, 0.0, 0.0)  # one number per channel
    std: Triple = (1.0, 1.0, 1.0)  # likewise, over 0
    # (low, high) that black and white are sent to
    value_range: tuple[float, float] = (0.0, 1.0)
    layout: str = "NCHW"  # or "NHWC"
    channels: str = "RGB"  # or "BGR"
    processor: Callable[[Tensor], Tensor] | None = None
    resizes: bool = True

    def __call__(self, images: Tensor) -> Tensor:
        """Preprocess images (N, H, W, 3), display-referred sRGB in [0, 1], any floating
        dtype; differentiable.
        """
        x = images.permute(0, 3, 1, 2)
        if self.resizes and (x.shape[2], x.shape[3]) != self.input_size:
            x = F.interpolate(
                x,
                size=self.input_size,
                mode="bilinear",
                align_corners=False,
                antialias=True,
            )
        if self.processor:
            x = self.processor(x.clone())  # which may write into it
        else:
            low, high = self.value_range  # steps 2 and 4 are a factor and a summand
            gain = [(high - low) / std for std in self.std]
            offset = [
                (low - mean) / std
                for mean, std in zip(self.mean, self.std, strict=True)
            ]
            x = x.flip(1) if self.channels == "BGR" else x
            if gain != [1.0] * 3 or offset != [0.0] * 3:
                x = torch.addcmul(
                    x.new_tensor(offset).view(3, 1, 1),
                    x,
                    x.new_tensor(gain).view(3, 1, 1),
                )
        return (
            x.contiguous()
            if self.layout == "NCHW"
            else x.permute(0, 2, 3, 1).contiguous()
        )


@final
@dataclass(frozen=True, eq=False, repr=False)
class Model:
    """A network with everything that is needed to show it an image and read its output.
    Made by `load_model`.

    Args:
        module: the network. It takes what `preprocessing` returns and returns what
            `logits_of` describes.
        name: what to call it in messages and results.
        labels: one name per class, in index order.
        preprocessing: what happens to an image first.
        batch_limits: (fewest, most) images that the network takes at once. Larger
            batches are cut, smaller ones padded.
        probabilities: the network returns probabilities; their logarithm is returned:
            differences are log-odds.
        differentiable: a gradient of the logits reaches the image.
        attached: its gradient is that of its outputs only where `detach` does nothing,
            see `Detaching`.
        named: False if `labels` are placeholders.
        dtype: the type of the network's floating-point input.
        device: where the network lives. Images go there, the output comes back.
        read: from what the network returns for so many images, to its output: a tensor
            (N, ...), or a list with one thing for each; None for logits.
        asked: what `load_model` was given, where that says all of it; None for what
            exists in this session only.
        cameras: how many pictures are side by side in each image, which the network is
            shown one by one; the output is then a list with a tuple of theirs for each
            image.
        make_trainable: returns a new network with the same weights that can be trained
            further, where `module` is one made for inference alone; None for a copy of
            `module`.
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
    asked: str | None = field(default=None, repr=False)
    cameras: int = 1
    make_trainable: Callable[[], nn.Module] | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        height, width = self.input_size
        classes = f"{self.classes} classes, " if self.labels else ""
        return f"Model({self.name!r}, {classes}{height} x {width} pixels)"

    @property
    def input_size(self) -> tuple[int, int]:
        """(height, width) in pixels of the images that the network takes; others are
        resized.
        """
        return self.preprocessing.input_size

    @property
    def classes(self) -> int:
        """The number of classes."""
        return len(self.labels)

    def __call__(self, images: Tensor) -> Any:
        """Return the output for one image or a batch; differentiable with respect to
        the images.

        Args:
            images: (H, W, 3) or (N, H, W, 3), floating, display-referred sRGB in [0,
                1]. Non-finite values pass through: they are the search's to handle.

        Returns:
            Logits (N, classes), float32, on the device of the images; N is 1 for a
            single image. Of a network that returns probabilities p, log p. Where there
            is `read`, what that returns.

        Raises:
            InputError: not an image, or values that are clearly not in [0, 1].
            ModelError: the network's output is not (N, classes), or `read` finds no
                output in it.
        """
        images = checked_images(images)
        most = self.batch_limits[1]
        again = False
        if self.cameras > 1:
            images = images.unflatten(2, (self.cameras, -1)).movedim(2, 1).flatten(0, 1)
            most = max(most - most % self.cameras, min(most, self.cameras))
            alone = not isinstance(self.module, AllAtOnce)
            again = (
                alone
                and len(images) > KEPT
                and images.requires_grad
                and torch.is_grad_enabled()
            )
            most = min(most, KEPT) if again else most

        def kept(output: Tensor) -> Tensor:
            # a copy, for a network may write into the same memory again
            moved = output.to(images.device)
            return (
                moved.clone() if moved is output and not output.requires_grad else moved
            )

        def asked(part: Tensor) -> Any:
            return each_tensor(self.ask(self.prepared(part))[: len(part)], kept)

        parts = [
            recomputed(asked, part) if again else asked(part)
            for part in images.split(most)
        ]
        output = parts[0] if len(parts) == 1 else joined(parts)
        if self.cameras == 1:
            return output
        each = [output[number : number + 1] for number in range(len(output))]
        return [
            tuple(each[begin : begin + self.cameras])
            for begin in range(0, len(each), self.cameras)
        ]

    def copy_network(self) -> nn.Module:
        """Return a copy of the network, to train it further.

        Raises:
            ModelError: there is none, as of an exported program.
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
        """Return the same model with a network of the same kind, whose weights it
        shares, in evaluation mode.

        It sees the weights as they are trained in place, and collects no gradients for
        them.
        """
        shared = sharing_copy(network).eval().requires_grad_(False)
        return replace(self, module=shared, make_trainable=None)

    def label_set(self, text: str | int | Sequence[str | int]) -> LabelSet:
        """Return the classes that `text` names, e.g. ``"coffee mug,cup"`` or
        ``"#504"``; see `find_label_set`.
        """
        return find_label_set(text, self.labels, named=self.named)

    def prepared(self, images: Tensor) -> Tensor:
        """Return what the network is given for images (N, H, W, 3), no more than it
        takes at once.

        They are preprocessed, and of the network's type and device. Where they are too
        few, the last one is repeated. They are its own: it may write into them.
        """
        missing = self.batch_limits[0] - len(images)
        full = (
            torch.cat([images, images[-1:].expand(missing, -1, -1, -1)])
            if missing > 0
            else images
        )
        x = self.preprocessing(full.to(device=self.device, dtype=torch.float32)).to(
            self.dtype
        )
        return (
            x.clone()
            if x.untyped_storage().data_ptr() == images.untyped_storage().data_ptr()
            else x
        )

    def ask(self, x: Tensor, *, raw: bool = False) -> Any:
        """Return the output for a batch as `prepared` returns it, or, if `raw`, what
        the network itself gives.
        """
        INTERRUPTS.look()
        mode = (
            Detaching(ignored=True)
            if self.attached and torch.is_grad_enabled()
            else nullcontext()
        )
        # a network may switch gradients off as it runs
        with mode, torch.set_grad_enabled(torch.is_grad_enabled()):
            returned = self.module(x)
        if raw:
            return returned
        if self.read is not None:
            return read_by(self.read, returned, len(x), self.name)
        logits = logits_of(returned, len(x), len(self.labels), self.name)
        return (
            logits.clamp_min(SMALLEST_PROBABILITY).log()
            if self.probabilities
            else logits
        )


def sharing_copy(module: nn.Module) -> nn.Module:
    """Return a copy that has the same weights, but gradients of its own. Weights that
    were made in `torch.inference_mode` are copied: nothing can be differentiated
    through them.
    """

    def usable(weights: torch.Tensor) -> torch.Tensor:
        return weights.clone() if weights.is_inference() else weights

    memo: dict[int, Any] = {
        id(p): nn.Parameter(usable(p.detach()), p.requires_grad)
        for p in module.parameters()
    }
    memo.update({id(buffer): usable(buffer) for buffer in module.buffers()})
    return copy.deepcopy(module, memo)


DETACHING = (torch.Tensor.detach, torch.Tensor.detach_, torch.detach, torch.detach_)


class Detaching(TorchFunctionMode):
    """Looks on as a network detaches something, which it may be kept from: then
    gradients are those of its outputs.

    RT-DETR and its like choose queries by the scores of their encoder, and cut these
    off from their decoder, in evaluation too: that makes training stable (Zhu et al.
    2020, arXiv 2010.04159, appendix A.4), and hides from a search how the picture moves
    them.

    `detach` does nothing where it is `ignored`; `seen` says whether something with a
    gradient was to be detached.
    """

    def __init__(self, *, ignored: bool = False) -> None:
        super().__init__()
        self.ignored = ignored
        self.seen = False

    def __torch_function__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        """Call torch's function, or return what was to be detached as it is."""
        if function in DETACHING:
            self.seen = self.seen or args[0].requires_grad
            if self.ignored:
                return args[0]
        return function(*args, **(kwargs or {}))


def checked_images(images: Tensor) -> Tensor:
    """Return images as (N, H, W, 3); InputError for what is not an image in [0, 1]."""
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
    low, high = (float(end) for end in images.detach().aminmax())
    if -float("inf") < low < -RANGE_TOLERANCE or 1 + RANGE_TOLERANCE < high < float(
        "inf"
    ):
        raise InputError(
            f"{expected}, got values from {low:.4g} to {high:.4g}; `value_range` is "
            "for the network's side"
        )
    return images if images.dim() == 4 else images.unsqueeze(0)


def read_by(read: Read, returned: Any, count: int, name: str) -> Any:
    """Return the output that a reader finds in what a network returned. Raises
    ModelError where it finds none, or another number than `count`.
    """
    try:
        output = read(returned, count)
    except ValueError as error:
        meant = _task_of(returned)
        task = getattr(getattr(read, "__self__", None), "name", None)
        # actions look like rows of scores
        known = meant and task not in (meant, "command")
        other = (
            _other_task(str(meant))
            if known
            else ("wrap the network, or ask for another task")
        )
        advice = _no_scores(returned) or other
        raise ModelError(
            f"model {name}: {error}, got {described(returned)}; {advice}"
        ) from None
    if len(output) != count:
        raise ModelError(
            f"model {name}: expected an output for each of {count} "
            f"images, got {len(output)}"
        )
    mend_batch_norms(output)
    return output


def described(returned: Any) -> str:
    """Return what an output of a network is: its type, and the shape of a tensor."""
    return (
        f"one of shape {tuple(returned.shape)}"
        if isinstance(returned, Tensor)
        else type(returned).__name__
    )


def joined(parts: Sequence[Any]) -> Any:
    """Return the outputs of several batches as one: tensors (N, ...) and lists are put
    end to end.
    """
    return (
        torch.cat(list(parts))
        if isinstance(parts[0], Tensor)
        else list(chain.from_iterable(parts))
    )


def each_tensor(output: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """Return an output with a function of every tensor in it in that one's place, in
    plain dicts and lists: torch's trees end at kinds of these that nobody has told it,
    such as a library's outputs.
    """
    if isinstance(output, Tensor):
        return function(output)
    if isinstance(output, Mapping):
        return {name: each_tensor(part, function) for name, part in output.items()}
    if isinstance(output, (list, tuple)):
        return [each_tensor(part, function) for part in output]
    return output


def tensors_in(output: Any) -> list[Tensor]:
    """Return the tensors in an output, in their order."""
    found: list[Tensor] = []

    def keep(tensor: Tensor) -> Tensor:
        found.append(tensor)
        return tensor

    each_tensor(output, keep)
    return found


def logits_of(output: Any, count: int, classes: int | None, name: str) -> Tensor:
    """Return the logits (count, classes) float32 in what a network returned.

    Accepted are a tensor, an object with a tensor `logits`, a mapping with a tensor
    ``"logits"``, and a tuple or list whose first element is a tensor.

    Raises:
        ModelError: there is no such tensor, or its shape or type is not that of logits.
    """
    if (
        isinstance(output, Tensor)
        and output.is_floating_point()
        and output.shape == (count, classes)
    ):
        if output.requires_grad:
            mend_batch_norms(output)
        return output.float()
    tensor = _tensor_in(output)
    expected = (
        f"model {name}: expected logits of shape ({count}, {classes or 'classes'})"
    )
    if advice := _no_scores(output):
        raise ModelError(
            f"{expected}, got {described(tensor if tensor is not None else output)}; {advice}"
        )
    meant = _task_of(output)
    if meant in ("detection", "segmentation", "depth", "similarity") and (
        tensor is None or tensor.dim() != 4
    ):
        raise ModelError(f"{expected}, got {described(output)}; {_other_task(meant)}")
    if tensor is None:
        raise ModelError(
            f"{expected}, got {type(output).__name__}; wrap the network "
            "so that it returns one tensor"
        )
    got = tuple(tensor.shape)
    if (
        len(got) != 2
        or got[0] != count
        or got[1] < 2
        or (classes is not None and got[1] != classes)
    ):
        raise ModelError(f"{expected}, got {got}; {_advice(got)}")
    if not tensor.is_floating_point():
        raise ModelError(
            f"{expected} and floating type, got {tensor.dtype}; return "
            "scores, not the predicted class"
        )
    mend_batch_norms(tensor)
    return tensor.float()


def mend_batch_norms(output: Any) -> None:
    """Make gradients of an output right that pass batch norms: each is laid out in
    memory as its norm's input is.

    Of a single picture torch 2.13 reads a gradient that comes from
    ``flatten(2).transpose(1, 2)``, as in networks whose convolutions end in a
    transformer, in a wrong order on the CPU, without a word. Batches are right.
    """

    def laid_out(
        strides: tuple[int, ...], gradients: tuple[Tensor | None, ...]
    ) -> tuple[Tensor | None, ...]:
        first, *others = gradients
        if first is None or first.stride() == strides:
            return gradients
        laid = torch.empty_strided(
            first.shape, strides, dtype=first.dtype, device=first.device
        )
        return laid.copy_(first), *others

    waiting: list[Any] = [tensor.grad_fn for tensor in tensors_in(output)]
    seen = {None}
    while waiting:
        node = waiting.pop()
        if node in seen:
            continue
        seen.add(node)
        waiting.extend(before for before, _ in node.next_functions)
        if node.name().startswith("NativeBatchNorm"):
            node.register_prehook(
                partial(
                    laid_out,
                    torch.empty_like(node._saved_input, device="meta").stride(),
                )
            )


def _tensor_in(output: Any) -> Tensor | None:
    if isinstance(output, Mapping):
        output = output.get("logits")
    elif not isinstance(output, Tensor) and hasattr(output, "logits"):
        output = output.logits
    elif isinstance(output, (tuple, list)) and output:
        output = output[0]
    return output if isinstance(output, Tensor) else None


def _scores_in(returned: Any) -> Any:
    return (
        returned["out"]
        if isinstance(returned, Mapping) and "out" in returned
        else _tensor_in(returned)
    )


def _no_scores(returned: Any) -> str:
    """What to do with an output that has no scores: the classes that it chose, or
    losses; "" of any other.
    """
    parts = list(returned.values()) if isinstance(returned, Mapping) else [returned]
    if parts and all(isinstance(part, Tensor) and part.ndim == 0 for part in parts):
        return (
            "one number for all pictures is what a loss is: give the network as it "
            "is outside of training"
        )
    tensor = _scores_in(returned)
    # whose first part may be the labels of boxes
    listed = isinstance(returned, (list, tuple))
    if (
        tensor is None
        or listed
        or tensor.is_floating_point()
        or tensor.ndim not in (1, 3)
    ):
        return ""
    return (
        f"these are the classes that it chose ({tensor.dtype}): return its scores, "
        "as they are before the argmax"
    )


def _task_of(returned: Any) -> str | None:
    """Return the task whose networks return such a thing: boxes, features, numbers for
    each pixel, or rows of scores; None where it is none of these.
    """
    listed = isinstance(returned, (tuple, list))
    first = returned[0] if listed and returned else returned
    names = first if isinstance(first, Mapping) else dir(first)
    if not isinstance(first, Tensor) and ("boxes" in names or "pred_boxes" in names):
        return "detection"
    if (
        listed
        and len(returned) > 1
        and isinstance(first, Tensor)
        and first.dim() == 3
        and first.shape[2] == 4
    ):
        return "detection"  # (boxes (N, K, 4), scores ...)
    if isinstance(returned, Mapping) and any(
        word in str(key) for key in returned for word in ("depth", "disparity")
    ):
        return "depth"
    if hasattr(returned, "last_hidden_state") and not hasattr(returned, "logits"):
        return "similarity"
    if (
        listed
        and len(
            {
                part.shape[2:]
                for part in returned
                if isinstance(part, Tensor) and part.ndim == 4
            }
        )
        > 1
    ):
        return None  # maps of several sizes
    tensor = _scores_in(returned)
    return (
        {2: "classification", 4: "segmentation"}.get(tensor.dim())
        if isinstance(tensor, Tensor)
        else None
    )


def _other_task(name: str) -> str:
    return f"{GIVEN_BY[name]}: use `task={name}`"


def _advice(got: tuple[int, ...]) -> str:
    if len(got) == 4:
        return (
            f"{_other_task('segmentation')}. If these are a classifier's feature "
            "maps, wrap the network to pool them"
        )
    if len(got) > 2:
        return (
            "pass a classifier, or wrap the network to pool its output; if it is a "
            "detector, use `task=detection`"
        )
    if len(got) == 2 and got[1] == 1:
        return (
            "one score is not enough: wrap the network to return a score for each "
            "of the two classes"
        )
    if len(got) == 1:
        return "the network dropped its batch dimension: wrap it to keep it"
    return "wrap the network so that it returns one row of scores per image"
