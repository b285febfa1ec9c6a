"""The bundled reference classifier: a small residual network for images of 128 x 128 pixels.

Plain on purpose: it is the victim, not the method. 1.2 million parameters, 4.7 MB in float32, about 65 million
multiply-adds an image. SiLU instead of ReLU keeps the logits smooth in the image, so that gradients mean something.

And networks to train further: a copy of a model's network, and the model that sees its weights as they change.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors import torch as safetensors
from torch import Generator, Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

from advsearch.errors import ModelError
from advsearch.models.model import Model, Preprocessing, logits_of
from advsearch.models.probe import PROGRAMS, probe
from advsearch.models.source import frozen, load_weights, sharing_copy, split_weights

INPUT_SIZE = (128, 128)
STEM, WIDTHS, DEPTHS = 24, (32, 64, 128, 192), (1, 1, 2, 1)
MEAN, STD = 0.45, 0.25  # of display-referred values; one pair for all channels is enough
WEIGHTS, RECORD = "reference.safetensors", "reference.json"
REMEDY = "run `make reference` to train it, or install a release, which contains it"


class ReferenceNet(nn.Module):
    """A residual network for at least 2 classes: stem of stride 2, four stages of strides 4 to 32, average pooling,
    dropout of pooled features in training, a linear layer."""

    def __init__(self, classes: int, *, dropout: float = 0.1) -> None:
        super().__init__()
        layers: list[nn.Module] = [_Convolution(3, STEM, 5, stride=2), nn.SiLU()]
        width = STEM
        for wider, depth in zip(WIDTHS, DEPTHS, strict=True):
            for position in range(depth):
                layers.append(_Residual(width, wider, stride=2 if position == 0 else 1))
                width = wider
        self.features = nn.Sequential(*layers)
        self.dropout = nn.Dropout(dropout)
        self.head = nn.Linear(width, classes)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.zeros_(self.head.bias)

    def forward(self, images: Tensor) -> Tensor:
        """Return logits (N, classes) of images (N, 3, H, W), display-referred sRGB in [0, 1]; H and W at least 32."""
        x = ((images - MEAN) * (1.0 / STD)).contiguous(memory_format=torch.channels_last)
        features: Tensor = self.features(x).mean(dim=(2, 3))
        logits: Tensor = self.head(self.dropout(features))
        return logits


class _Convolution(nn.Module):
    """A convolution without bias, then batch normalisation."""

    def __init__(self, inputs: int, outputs: int, size: int, *, stride: int = 1) -> None:
        super().__init__()
        self.convolve = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)
        self.normalise = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.normalise(self.convolve(x))
        return result


class _Residual(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut, which is average-pooled and projected where the shape changes."""

    def __init__(self, inputs: int, outputs: int, *, stride: int) -> None:
        super().__init__()
        self.first = _Convolution(inputs, outputs, 3, stride=stride)
        self.second = _Convolution(outputs, outputs, 3)
        shortcut: list[nn.Module] = [nn.AvgPool2d(stride)] if stride > 1 else []
        if inputs != outputs:
            shortcut.append(_Convolution(inputs, outputs, 1))
        self.shortcut = nn.Sequential(*shortcut)
        self.activation = nn.SiLU()

    def forward(self, x: Tensor) -> Tensor:
        branch = self.second(self.activation(self.first(x)))
        result: Tensor = self.activation(branch + self.shortcut(x))
        return result


def build(classes: int, *, dropout: float = 0.1) -> ReferenceNet:
    """Return an untrained network in channels-last memory format; weights come from torch's current random state."""
    if classes < 2:
        raise ModelError(f"reference network: expected at least 2 classes, got {classes}")
    return ReferenceNet(classes, dropout=dropout).to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def folded(net: ReferenceNet) -> ReferenceNet:
    """Return a copy for inference: evaluation mode, normalisation merged into the convolutions, parameters frozen."""
    copied = copy.deepcopy(net).eval().requires_grad_(False)
    for module in list(copied.modules()):
        for name, layer in module.named_children():
            if isinstance(layer, _Convolution):
                setattr(module, name, fuse_conv_bn_eval(layer.convolve, layer.normalise))
    return copied.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def data_folder() -> Path:
    """Return the folder of the installed package that holds the weights."""
    return Path(str(resources.files("advsearch.models").joinpath("data")))


def load(folder: Path | None = None, weights: Path | None = None) -> Model:
    """Return the model "reference" with its labels, from the folder with its two files (by default the package's own),
    or with other weights from a safetensors file. Raises ModelError: they are missing, damaged, or do not fit this
    version's network; FileFormatError: `weights` is missing or is not safetensors."""
    net, labels = network(folder, weights)
    name = "reference" if weights is None else f"reference@{weights}"
    bare = Model(frozen(folded(net), name), name, (), Preprocessing(INPUT_SIZE))
    return probe(bare, labels, "labels of the reference model")


def network(folder: Path | None = None, weights: Path | None = None) -> tuple[ReferenceNet, tuple[str, ...]]:
    """Return the network with its weights, which can be trained further, and the labels; arguments and errors as for
    `load`."""
    folder = folder or data_folder()
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        labels = tuple(str(label) for label in record["labels"])
        state = safetensors.load((folder / WEIGHTS).read_bytes())
    except FileNotFoundError as error:
        raise ModelError(f"the reference model is not there ({error.filename}); {REMEDY}") from None
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise ModelError(f"the reference model in {folder} cannot be read ({error}); {REMEDY}") from None
    net = build(len(labels))
    try:
        net.load_state_dict(state)
    except RuntimeError as error:
        raise ModelError(f"the weights in {folder / WEIGHTS} are of another network; {REMEDY}") from error
    if weights is not None:
        load_weights(net, weights, "reference")
    return net, labels


@dataclass(frozen=True, eq=False)
class Trainable:
    """A copy of a model's network, whose trained parameters collect gradients, and a model that asks the same weights,
    in evaluation mode, without their gradients."""

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
        return [weights for weights in self.net.parameters() if weights.requires_grad]

    def _mixed_precision(self) -> torch.autocast:
        """Convolutions and products of matrices in bfloat16, on a processor that has instructions for it. Several
        threads at one of them wait for each other busily: where others want the cores too it takes five times as long
        as in float32."""
        processor: Mapping[str, object] = getattr(torch.cpu, "get_capabilities", dict)()  # torch 2.8 says nothing
        bfloat16 = self.model.device.type == "cpu" and bool(processor.get("avx512_bf16"))
        return torch.autocast("cpu", torch.bfloat16, enabled=bfloat16)


def trainable(model: Model, layers: str = "all", *, logits: bool = True) -> Trainable:
    """Return a copy of a model's network to train further: all `layers`, or the "last" one that has parameters. Raises
    ModelError: as `copied_network`, or the network returns something other than `logits`, where it has to. It stays in
    evaluation mode: statistics of batches stay what they were learned as, and nothing is dropped."""
    if logits and (model.probabilities or model.read is not None):
        raise ModelError(f"model {model.name}: only a classifier that returns logits can be hardened")
    net = copied_network(model)
    net.eval().requires_grad_(True)
    if layers == "last":
        owners = [layer for layer in net.modules() if next(layer.parameters(recurse=False), None) is not None]
        net.requires_grad_(False)
        owners[-1].requires_grad_(True)
    made = Trainable(net, replace(model, module=frozen(net, model.name)))
    if not made.parameters():
        raise ModelError(f"model {model.name}: has no parameters to train")
    return made


def copied_network(model: Model) -> nn.Module:
    """Return a copy of the network of a model, to train further; a ModelError where there is none, as of an exported
    program."""
    name, weights = split_weights(model.name)
    if name == "reference":  # its model has lost its normalisation
        return network(weights=weights)[0]
    if not isinstance(model.module, nn.Module) or isinstance(model.module, PROGRAMS):
        raise ModelError(
            f"model {model.name}: an exported program cannot be trained; name the code that builds the network "
            "(package.module:callable@weights.safetensors), or give an nn.Module from Python"
        )
    return copy.deepcopy(model.module)


# ---- What happens by chance to the pictures that a classifier is trained on -----------------------------------------


@dataclass(frozen=True)
class Augmentation:
    """What may happen to a training image, in this order; every amount is drawn anew for every image.

    The side of the square crop is uniform between two parts of the image's side (1 and 1 switch it off); its place is
    uniform inside the image or, where it is larger, around it; there the border goes on.
    """

    flip: float = 0.5  # probability of a horizontal mirror image
    smallest_crop: float = 0.8
    largest_crop: float = 1.0
    turn: float = 0.0  # half width of the uniform angle that the crop is turned by, in degrees
    brightness: float = 0.1  # half width of the uniform shift, display-referred
    contrast: float = 0.25  # half width of the uniform factor around 1 that scales deviations from the image's mean
    colour: float = 0.08  # half width of the uniform factor around 1, per channel
    blur: float = 0.15  # probability of a 3 x 3 binomial blur
    noise: float = 0.04  # upper end of the uniform standard deviation of gaussian noise, display-referred
    noisy: float = 0.3  # probability that noise is added at all
    cutout: float = 0.2  # probability that a grey square hides a part
    largest_cutout: float = 0.3  # upper end of the square's side, as a part of the image's

    def __call__(self, images: Tensor, generator: Generator) -> Tensor:
        """Return changed images (N, 3, H, W), float32 in [0, 1], from images of the same kind."""
        count = len(images)

        def uniform(low: float, high: float, *each: int) -> Tensor:
            return low + (high - low) * torch.rand(math.prod([count, *each]), generator=generator)

        def chosen(probability: float) -> Tensor:
            return torch.rand(count, generator=generator) < probability

        scale = uniform(self.smallest_crop, self.largest_crop)
        shift = uniform(-1.0, 1.0, 2).view(2, count) * (1.0 - scale).abs()
        mirror = 1.0 - 2.0 * chosen(self.flip).float()
        angle = uniform(-self.turn, self.turn) * (math.pi / 180.0)
        along, across = scale * angle.cos(), scale * angle.sin()
        rows = (torch.stack([along * mirror, -across, shift[0]], 1), torch.stack([across * mirror, along, shift[1]], 1))
        grid = F.affine_grid(torch.stack(rows, 1), list(images.shape), align_corners=False)
        x = F.grid_sample(images, grid, mode="bilinear", padding_mode="border", align_corners=False)
        # ((x - mean) gain + mean + shift) colour, as one affine map
        gain = 1.0 + uniform(-self.contrast, self.contrast).view(count, 1, 1, 1)
        colour = 1.0 + uniform(-self.colour, self.colour, 3).view(count, 3, 1, 1)
        lighter = uniform(-self.brightness, self.brightness).view(count, 1, 1, 1)
        x = torch.addcmul((x.mean(dim=(1, 2, 3), keepdim=True) * (1.0 - gain) + lighter) * colour, x, gain * colour)
        blurred = chosen(self.blur)
        if bool(blurred.any()):
            taps = x.new_tensor([0.25, 0.5, 0.25])
            kernel = (taps[:, None] * taps[None, :]).expand(3, 1, 3, 3)
            x[blurred] = F.conv2d(F.pad(x[blurred], (1, 1, 1, 1), mode="replicate"), kernel, groups=3)
        noisy = chosen(self.noisy)
        if some := int(noisy.sum()):
            deviation = (self.noise * torch.rand(some, generator=generator)).view(some, 1, 1, 1)
            x[noisy] += deviation * torch.randn((some, *x.shape[1:]), generator=generator)
        x.clamp_(0.0, 1.0)
        hidden, (height, width) = chosen(self.cutout).tolist(), x.shape[2:]
        for index, (size, top, left, grey) in enumerate(torch.rand((count, 4), generator=generator).tolist()):
            if hidden[index]:
                side = max(1, int((0.3 + 0.7 * size) * self.largest_cutout * min(height, width)))
                row, column = int(top * (height - side)), int(left * (width - side))
                x[index, :, row : row + side, column : column + side] = grey
        return x
