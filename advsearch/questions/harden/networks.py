"""Networks that are trained further: copies that collect gradients, and what happens to
their images by chance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from advsearch.extend import Model, errors


@dataclass(frozen=True, eq=False)
class Trainable:
    """A copy of a network whose trained parameters collect gradients, and a model that
    asks the same weights.

    The model is in evaluation mode, and collects no gradients for the weights.
    """

    net: nn.Module
    model: Model

    def logits(self, images: Tensor) -> Tensor:
        """Return logits (N, C) of images (N, H, W, 3) sRGB in [0, 1], with a graph to
        the parameters.
        """
        asked = replace(self.model, module=self.net, attached=False)
        with self._mixed_precision():
            x = self.model.preprocessing(images.to(self.model.device)).to(
                self.model.dtype
            )
            logits: Tensor = asked.ask(x)
        return logits

    def quickly(self, images: Tensor) -> Tensor:
        """Return what `model` says of images (N, H, W, 3), in the precision of
        `logits`.
        """
        with self._mixed_precision():
            logits: Tensor = self.model(images)
        return logits

    def twin(self) -> Trainable:
        """Return the same weights with gradients of their own, for another thread."""
        net: nn.Module = self.model.with_network(self.net).module  # type: ignore[assignment]
        for parameter, own in zip(net.parameters(), self.net.parameters(), strict=True):
            parameter.requires_grad_(own.requires_grad)
        return Trainable(net, self.model.with_network(net))

    def parameters(self) -> list[nn.Parameter]:
        """Return the parameters that are trained."""
        return [weights for weights in self.net.parameters() if weights.requires_grad]

    def _mixed_precision(self) -> torch.autocast:
        """Compute convolutions and products of matrices in bfloat16, on a processor
        that has instructions for it.

        Several threads at one of them wait for each other busily: where others want the
        cores too it takes five times as long as in float32.
        """
        # torch 2.8 says nothing
        processor: Mapping[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
        bfloat16 = self.model.device.type == "cpu" and bool(
            processor.get("avx512_bf16")
        )
        return torch.autocast("cpu", torch.bfloat16, enabled=bfloat16)


def trainable(model: Model, layers: str = "all", *, logits: bool = True) -> Trainable:
    """Copy a model's network to train it further.

    It stays in evaluation mode: statistics of batches stay what they were learned as,
    and nothing is dropped.

    Args:
        model: whose network is copied.
        layers: "all", or "last" for the last one that has parameters.
        logits: whether it has to return logits.

    Raises:
        ModelError: the network cannot be trained, has no parameters, or returns
            something other than logits.
    """
    if logits and (model.probabilities or model.read is not None):
        raise errors.ModelError(
            f"model {model.name}: only a classifier that returns logits can be hardened"
        )
    net = model.copy_network()
    net.eval().requires_grad_(True)
    if layers == "last":
        owners = [
            layer
            for layer in net.modules()
            if next(layer.parameters(recurse=False), None) is not None
        ]
        net.requires_grad_(False)
        owners[-1].requires_grad_(True)
    made = Trainable(net, model.with_network(net))
    if not made.parameters():
        raise errors.ModelError(f"model {model.name}: has no parameters to train")
    return made


@contextmanager
def one_thread_each() -> Iterator[ThreadPoolExecutor]:
    """Open as many threads as torch has, each of which has one of torch's: side by side
    they wait at no barriers.
    """
    count = torch.get_num_threads()
    with ThreadPoolExecutor(
        count, "advsearch-torch", torch.set_num_threads, (1,)
    ) as pool:
        try:
            yield pool
        finally:
            torch.set_num_threads(count)


@dataclass(frozen=True)
class Augmentation:
    """What may happen to a training image, in this order; every amount is drawn anew
    for every image.

    The side of the square crop is uniform between two parts of the image's side (1 and
    1 switch it off); its place is uniform inside the image or, where it is larger,
    around it; there the border goes on.
    """

    flip: float = 0.5  # probability of a horizontal mirror image
    smallest_crop: float = 0.8
    largest_crop: float = 1.0
    # half width of the uniform angle that the crop is turned by, in degrees
    turn: float = 0.0
    brightness: float = 0.1  # half width of the uniform shift, display-referred
    # half width of the uniform factor around 1 that scales deviations from the image's
    # mean
    contrast: float = 0.25
    colour: float = 0.08  # half width of the uniform factor around 1, per channel
    blur: float = 0.15  # probability of a 3 x 3 binomial blur
    # upper end of the uniform standard deviation of gaussian noise, display-referred
    noise: float = 0.04
    noisy: float = 0.3  # probability that noise is added at all
    cutout: float = 0.2  # probability that a grey square hides a part
    # upper end of the square's side, as a part of the image's
    largest_cutout: float = 0.3

    def __call__(self, images: Tensor, generator: Generator) -> Tensor:
        """Return changed images (N, 3, H, W), float32 in [0, 1], from images of the
        same kind.
        """
        count = len(images)

        def uniform(low: float, high: float, *each: int) -> Tensor:
            return low + (high - low) * torch.rand(
                math.prod([count, *each]), generator=generator
            )

        def chosen(probability: float) -> Tensor:
            return torch.rand(count, generator=generator) < probability

        scale = uniform(self.smallest_crop, self.largest_crop)
        shift = uniform(-1.0, 1.0, 2).view(2, count) * (1.0 - scale).abs()
        mirror = 1.0 - 2.0 * chosen(self.flip).float()
        angle = uniform(-self.turn, self.turn) * (math.pi / 180.0)
        along = scale * angle.cos()
        across = scale * angle.sin()
        rows = (
            torch.stack([along * mirror, -across, shift[0]], 1),
            torch.stack([across * mirror, along, shift[1]], 1),
        )
        grid = F.affine_grid(
            torch.stack(rows, 1), list(images.shape), align_corners=False
        )
        x = F.grid_sample(
            images, grid, mode="bilinear", padding_mode="border", align_corners=False
        )
        # ((x - mean) gain + mean + shift) colour, as one affine map
        gain = 1.0 + uniform(-self.contrast, self.contrast).view(count, 1, 1, 1)
        colour = 1.0 + uniform(-self.colour, self.colour, 3).view(count, 3, 1, 1)
        lighter = uniform(-self.brightness, self.brightness).view(count, 1, 1, 1)
        x = torch.addcmul(
            (x.mean(dim=(1, 2, 3), keepdim=True) * (1.0 - gain) + lighter) * colour,
            x,
            gain * colour,
        )
        blurred = chosen(self.blur)
        if bool(blurred.any()):
            taps = x.new_tensor([0.25, 0.5, 0.25])
            kernel = (taps[:, None] * taps[None, :]).expand(3, 1, 3, 3)
            x[blurred] = F.conv2d(
                F.pad(x[blurred], (1, 1, 1, 1), mode="replicate"), kernel, groups=3
            )
        noisy = chosen(self.noisy)
        if some := int(noisy.sum()):
            deviation = (self.noise * torch.rand(some, generator=generator)).view(
                some, 1, 1, 1
            )
            x[noisy] += deviation * torch.randn(
                (some, *x.shape[1:]), generator=generator
            )
        x.clamp_(0.0, 1.0)
        hidden = chosen(self.cutout).tolist()
        (height, width) = x.shape[2:]
        for index, (size, top, left, grey) in enumerate(
            torch.rand((count, 4), generator=generator).tolist()
        ):
            if hidden[index]:
                side = max(
                    1,
                    int((0.3 + 0.7 * size) * self.largest_cutout * min(height, width)),
                )
                row = int(top * (height - side))
                column = int(left * (width - side))
                x[index, :, row : row + side, column : column + side] = grey
        return x
