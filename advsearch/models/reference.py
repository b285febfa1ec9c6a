"""The bundled reference classifier: a small residual network for images of 128 x 128
pixels.

The network is simple on purpose, because it is only an example of a model to attack. It
has 1.2 million parameters (4.7 MB in float32) and needs about 65 million multiply-adds
per image. It has SiLU in place of ReLU so that the logits are smooth functions of the
image, whose gradients are informative.
"""

from __future__ import annotations

import copy
import json
from importlib import resources
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors import torch as safetensors
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

from advsearch.errors import ModelError
from advsearch.models.labels import LabelsOrigin
from advsearch.models.model import Model, Preprocessing
from advsearch.models.probe import probe_model
from advsearch.models.source import freeze_network, load_weights

INPUT_SIZE = (128, 128)
STEM = 24  # channels of the first convolution
WIDTHS = (32, 64, 128, 192)  # channels of each stage
DEPTHS = (1, 1, 2, 1)  # residual blocks of each stage
# Mean and standard deviation of display-referred values, for all channels.
MEAN = 0.45
STD = 0.25
WEIGHTS = "reference.safetensors"
METADATA = "reference.json"
REMEDY = "run `make reference` to train it, or install a release, which contains it"


class ReferenceNet(nn.Module):
    """A residual network for at least 2 classes.

    It has a stem of stride 2, four stages of strides 4 to 32, average pooling, dropout
    of pooled features in training, and a linear layer.
    """

    def __init__(self, classes: int, *, dropout: float = 0.1) -> None:
        """Build the layers with random weights.

        Args:
            classes: number of logits.
            dropout: probability that a pooled feature is dropped in training.
        """
        super().__init__()
        # The stem halves the image, and the first block of each stage halves it again.
        layers: list[nn.Module] = [_Convolution(3, STEM, 5, stride=2), nn.SiLU()]
        width = STEM
        for stage_width, depth in zip(WIDTHS, DEPTHS, strict=True):
            for block_index in range(depth):
                stride = 2 if block_index == 0 else 1
                layers.append(_Residual(width, stage_width, stride=stride))
                width = stage_width
        self.features = nn.Sequential(*layers)
        self.dropout = nn.Dropout(dropout)
        self.head = nn.Linear(width, classes)
        self._initialize_weights()

    def _initialize_weights(self) -> None:
        """Draw random weights for an untrained network."""
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(
                    module.weight, mode="fan_out", nonlinearity="relu"
                )
        # small weights, so that all classes are nearly equally probable at first
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.zeros_(self.head.bias)

    def forward(self, images: Tensor) -> Tensor:
        """Return logits (N, classes) of images.

        Args:
            images: (N, 3, H, W), display-referred sRGB in [0, 1]; H and W at least 32.
        """
        x = ((images - MEAN) * (1.0 / STD)).contiguous(
            memory_format=torch.channels_last
        )
        features: Tensor = self.features(x).mean(dim=(2, 3))
        logits: Tensor = self.head(self.dropout(features))
        return logits


class _Convolution(nn.Module):
    """A convolution without bias, followed by batch normalization."""

    def __init__(
        self, inputs: int, outputs: int, size: int, *, stride: int = 1
    ) -> None:
        """Build the layers.

        Args:
            inputs, outputs: channels.
            size: side of the kernel in pixels.
            stride: stride of the convolution.
        """
        super().__init__()
        self.convolve = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)
        self.normalise = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.normalise(self.convolve(x))
        return result


class _Residual(nn.Module):
    """A residual block of two 3 x 3 convolutions and a shortcut.

    The shortcut is average-pooled and projected where the shape changes.
    """

    def __init__(self, inputs: int, outputs: int, *, stride: int) -> None:
        """Build the layers of a block.

        Args:
            inputs, outputs: channels.
            stride: stride of the first convolution, and of the shortcut's pooling.
        """
        super().__init__()
        self.first = _Convolution(inputs, outputs, 3, stride=stride)
        self.second = _Convolution(outputs, outputs, 3)
        shortcut: list[nn.Module] = [nn.AvgPool2d(stride)] if stride > 1 else []
        if inputs != outputs:
            shortcut.append(_Convolution(inputs, outputs, 1))
        self.shortcut = nn.Sequential(*shortcut)
        self.activation = nn.SiLU()

    def forward(self, x: Tensor) -> Tensor:
        """Return the output of the block for an input (N, channels, H, W)."""
        branch = self.second(self.activation(self.first(x)))
        result: Tensor = self.activation(branch + self.shortcut(x))
        return result


def build(classes: int, *, dropout: float = 0.1) -> ReferenceNet:
    """Return an untrained network in channels-last memory format.

    Its weights depend on torch's current random state.

    Raises:
        ModelError: there are fewer than two classes.
    """
    if classes < 2:
        raise ModelError(
            f"reference network: expected at least 2 classes, got {classes}"
        )
    return ReferenceNet(classes, dropout=dropout).to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def fold_batch_norms(net: ReferenceNet) -> ReferenceNet:
    """Return a copy for inference, in evaluation mode and with frozen parameters.

    In evaluation mode a batch norm is linear, so that it is merged into the convolution
    before it. That is faster, and gives the same logits.
    """
    copied = copy.deepcopy(net).eval().requires_grad_(False)
    for module in list(copied.modules()):
        for name, layer in module.named_children():
            if isinstance(layer, _Convolution):
                setattr(
                    module, name, fuse_conv_bn_eval(layer.convolve, layer.normalise)
                )
    return copied.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def get_data_folder() -> Path:
    """Return the folder of the installed package that holds the weights."""
    return Path(str(resources.files("advsearch.models").joinpath("data")))


def load(folder: Path | None = None, weights: Path | None = None) -> Model:
    """Return the model "reference" with its labels.

    Args:
        folder: folder with `WEIGHTS` and `METADATA`; by default that of the package.
        weights: a safetensors file with other weights for the same labels.

    Raises:
        ModelError: a file of the folder is missing or corrupt, or weights are not of
            this version's network.
        FileFormatError: `weights` is missing or is not safetensors.
    """
    net, labels = load_network(folder, weights)
    name = "reference" if weights is None else f"reference@{weights}"
    model = Model(
        freeze_network(fold_batch_norms(net), name),
        name,
        labels=(),  # set by `probe_model`
        preprocessing=Preprocessing(INPUT_SIZE),
        # The folded network has no batch norms. For training it is loaded once more.
        make_trainable=lambda: load_network(folder, weights)[0],
    )
    return probe_model(model, labels, LabelsOrigin("labels of the reference model"))


def load_network(
    folder: Path | None = None, weights: Path | None = None
) -> tuple[ReferenceNet, tuple[str, ...]]:
    """Load the network and its labels. The network can be trained further.

    Args:
        folder: folder with `WEIGHTS` and `METADATA`; by default that of the package.
        weights: a safetensors file whose weights replace those of the folder, after
            these were loaded.

    Raises:
        ModelError: a file of the folder is missing or corrupt, or weights are not of
            this version's network.
        FileFormatError: `weights` is missing or is not safetensors.
    """
    folder = folder or get_data_folder()
    labels, state = _read_reference_files(folder)
    net = build(len(labels))
    try:
        net.load_state_dict(state)
    except RuntimeError as error:
        raise ModelError(
            f"the weights in {folder / WEIGHTS} are of another network; {REMEDY}"
        ) from error
    if weights is not None:
        load_weights(net, weights, "reference")
    return net, labels


def _read_reference_files(folder: Path) -> tuple[tuple[str, ...], dict[str, Tensor]]:
    """Return the labels and the weights in a folder.

    Raises:
        ModelError: a file is missing or corrupt.
    """
    try:
        metadata = json.loads((folder / METADATA).read_text(encoding="utf-8"))
        labels = tuple(str(label) for label in metadata["labels"])
        return labels, safetensors.load((folder / WEIGHTS).read_bytes())
    except FileNotFoundError as error:
        raise ModelError(
            f"the reference model is missing ({error.filename}); {REMEDY}"
        ) from None
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise ModelError(
            f"the reference model in {folder} cannot be read ({error}); {REMEDY}"
        ) from None
