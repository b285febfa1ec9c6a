"""Trainable copies of networks, and random augmentation of their images."""

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
    """A copy of a network whose trained parameters collect gradients.

    Attributes:
        network: the network that is trained.
        model: model that predicts with the same weights, in evaluation mode and without
            gradients for the weights.
    """

    network: nn.Module
    model: Model

    def logits(self, images: Tensor) -> Tensor:
        """Return logits (N, C) with a graph to the parameters.

        Args:
            images: (N, H, W, 3) sRGB in [0, 1].
        """
        # `self.model` has no gradients for its weights, so its network is replaced by
        # the one that is trained. With `attached=False`, a `detach` inside the network
        # stops gradients, as in ordinary training.
        trained_model = replace(self.model, module=self.network, attached=False)
        with self._mixed_precision():
            x = trained_model.preprocessing(images.to(trained_model.device))
            logits: Tensor = trained_model.run_network(x.to(trained_model.dtype))
        return logits

    def evaluation_logits(self, images: Tensor) -> Tensor:
        """Return the logits of `model` for images (N, H, W, 3) in mixed precision."""
        with self._mixed_precision():
            logits: Tensor = self.model(images)
        return logits

    def copy_for_thread(self) -> Trainable:
        """Return the same weights with gradients of their own, for another thread."""
        # `with_network` returns a model with a copy of the network that shares its
        # weights, and whose parameters collect no gradients. They get that back here.
        network: nn.Module = self.model.with_network(self.network).module  # type: ignore[assignment]
        for parameter, original in zip(
            network.parameters(), self.network.parameters(), strict=True
        ):
            parameter.requires_grad_(original.requires_grad)
        return Trainable(network, self.model.with_network(network))

    def parameters(self) -> list[nn.Parameter]:
        """Return the parameters that are trained."""
        return [
            weights for weights in self.network.parameters() if weights.requires_grad
        ]

    def _mixed_precision(self) -> torch.autocast:
        """Return a context that uses bfloat16 if the processor has instructions for it.

        Without such instructions bfloat16 is slow. It is also slow if torch divides a
        product among several threads while other threads use the cores: that takes five
        times as long as in float32. `open_single_threaded_pool` prevents it.
        """
        # torch 2.8 has no `get_capabilities`: `dict` returns no capabilities instead
        get_capabilities = getattr(torch.cpu, "get_capabilities", dict)
        capabilities: Mapping[str, object] = get_capabilities()
        is_on_cpu = self.model.device.type == "cpu"
        uses_bfloat16 = is_on_cpu and bool(capabilities.get("avx512_bf16"))
        return torch.autocast("cpu", torch.bfloat16, enabled=uses_bfloat16)


def make_trainable(
    model: Model, layers: str = "all", *, logits: bool = True
) -> Trainable:
    """Copy a model's network to train it further.

    The copy stays in evaluation mode: batch normalization uses the statistics that it
    was trained with, and dropout does nothing.

    Args:
        model: model whose network is copied; it does not change.
        layers: "all", or "last" for the last one that has parameters.
        logits: whether the network has to return logits, as the loss of a classifier
            needs.

    Raises:
        ModelError: the network cannot be trained, has no parameters, or returns
            something other than logits.
    """
    # a model that returns probabilities, or whose output a function of its own reads
    returns_no_logits = model.probabilities or model.read is not None
    if logits and returns_no_logits:
        raise errors.ModelError(
            f"model {model.name}: only a classifier that returns logits can be hardened"
        )
    network = model.copy_network()
    network.eval().requires_grad_(True)
    if layers == "last":
        _freeze_all_but_last_layer(network)
    trainable = Trainable(network, model.with_network(network))
    if not trainable.parameters():
        raise errors.ModelError(f"model {model.name}: has no parameters to train")
    return trainable


def _freeze_all_but_last_layer(network: nn.Module) -> None:
    """Let only the parameters of the last layer that has some collect gradients.

    Layers come in the order of their definition, so the last one is usually the head.
    """
    layers_with_parameters = [
        layer
        for layer in network.modules()
        if next(layer.parameters(recurse=False), None) is not None
    ]
    network.requires_grad_(False)
    layers_with_parameters[-1].requires_grad_(True)


@contextmanager
def open_single_threaded_pool() -> Iterator[ThreadPoolExecutor]:
    """Open a pool of as many threads as torch has.

    In each of them torch uses a single thread, so that they do not wait for each other.
    """
    count = torch.get_num_threads()
    with ThreadPoolExecutor(
        max_workers=count,
        thread_name_prefix="advsearch-torch",
        initializer=torch.set_num_threads,
        initargs=(1,),
    ) as pool:
        try:
            yield pool
        finally:
            torch.set_num_threads(count)


@dataclass(frozen=True)
class Augmentation:
    """Random changes of training images, in the order of the attributes.

    Every amount is sampled for every image. A square crop lies at a uniform position
    inside the image; if it is larger than the image, the border is repeated around it.

    Attributes:
        flip: probability of a horizontal mirror image.
        smallest_crop, largest_crop: bounds of the crop's side, as a fraction of the
            image's side; 1 and 1 switch cropping off.
        max_rotation_degrees: bound of the angle that the crop is rotated by, in degrees.
        brightness: bound of the shift, display-referred.
        contrast: bound of the relative change of deviations from the image's mean.
        max_channel_change: bound of the relative change of each channel.
        blur: probability of a 3 x 3 binomial blur.
        max_noise_deviation: bound of the standard deviation of gaussian noise,
            display-referred.
        noise_probability: probability of noise.
        cutout_probability: probability that a gray square hides a part.
        largest_cutout: bound of the square's side, as a fraction of the image's side.
    """

    flip: float = 0.5
    smallest_crop: float = 0.8
    largest_crop: float = 1.0
    max_rotation_degrees: float = 0.0
    brightness: float = 0.1
    contrast: float = 0.25
    max_channel_change: float = 0.08
    blur: float = 0.15
    max_noise_deviation: float = 0.04
    noise_probability: float = 0.3
    cutout_probability: float = 0.2
    largest_cutout: float = 0.3

    def __call__(self, images: Tensor, generator: Generator) -> Tensor:
        """Return augmented images (N, 3, H, W), float32 in [0, 1]."""
        x = self._crop(images, generator)
        x = self._change_colors(x, generator)
        # The rest changes x in place.
        self._blur_some(x, generator)
        self._add_noise(x, generator)
        x.clamp_(0.0, 1.0)
        self._cut_out(x, generator)
        return x

    def _crop(self, images: Tensor, generator: Generator) -> Tensor:
        """Resample mirrored, rotated and scaled crops of images (N, 3, H, W).

        Each image gets its own random crop. The size of the images stays the same.
        """
        matrices = self._sample_crop_matrices(len(images), generator)
        grid = F.affine_grid(matrices, list(images.shape), align_corners=False)
        return F.grid_sample(
            images, grid, mode="bilinear", padding_mode="border", align_corners=False
        )

    def _sample_crop_matrices(self, count: int, generator: Generator) -> Tensor:
        """Sample matrices (count, 2, 3) from coordinates of a crop to those of its image.

        In the coordinates of `affine_grid` an image extends from -1 to 1, and a crop from
        -scale to scale around its center.
        """
        scale = _uniform(
            self.smallest_crop, self.largest_crop, count, generator=generator
        )
        shift_x, shift_y = _sample_crop_shifts(scale, generator)
        is_mirrored = _choose(self.flip, count, generator)
        mirror = 1.0 - 2.0 * is_mirrored.float()  # -1 or 1
        degrees = _sample_around_zero(
            self.max_rotation_degrees, count, generator=generator
        )
        angle = degrees * (math.pi / 180.0)
        cosine = scale * angle.cos()
        sine = scale * angle.sin()
        x_row = torch.stack([cosine * mirror, -sine, shift_x], dim=1)
        y_row = torch.stack([sine * mirror, cosine, shift_y], dim=1)
        return torch.stack([x_row, y_row], dim=1)

    def _change_colors(self, x: Tensor, generator: Generator) -> Tensor:
        """Change contrast, brightness and color of images (N, 3, H, W)."""
        count = len(x)
        contrast = _sample_around_zero(self.contrast, count, generator=generator)
        color = _sample_around_zero(
            self.max_channel_change, count, 3, generator=generator
        )
        brightness = _sample_around_zero(self.brightness, count, generator=generator)
        contrast_factor = 1.0 + contrast.view(count, 1, 1, 1)
        color_factor = 1.0 + color.view(count, 3, 1, 1)
        mean = x.mean(dim=(1, 2, 3), keepdim=True)
        # ((x - mean) * contrast + mean + brightness) * color, as one affine map of x
        shift = mean * (1.0 - contrast_factor) + brightness.view(count, 1, 1, 1)
        return torch.addcmul(shift * color_factor, x, contrast_factor * color_factor)

    def _blur_some(self, x: Tensor, generator: Generator) -> None:
        """Blur some of the images (N, 3, H, W) in place."""
        is_blurred = _choose(self.blur, len(x), generator)
        if not bool(is_blurred.any()):
            return
        taps = x.new_tensor([0.25, 0.5, 0.25])
        kernel = (taps[:, None] * taps[None, :]).expand(3, 1, 3, 3)
        padded = F.pad(x[is_blurred], (1, 1, 1, 1), mode="replicate")
        x[is_blurred] = F.conv2d(padded, kernel, groups=3)

    def _add_noise(self, x: Tensor, generator: Generator) -> None:
        """Add gaussian noise to some of the images (N, 3, H, W) in place."""
        is_noisy = _choose(self.noise_probability, len(x), generator)
        n_noisy = int(is_noisy.sum())
        if n_noisy == 0:
            return
        deviation = self.max_noise_deviation * torch.rand(n_noisy, generator=generator)
        noise = torch.randn((n_noisy, *x.shape[1:]), generator=generator)
        x[is_noisy] += deviation.view(n_noisy, 1, 1, 1) * noise

    def _cut_out(self, x: Tensor, generator: Generator) -> None:
        """Hide a part of some of the images (N, 3, H, W) by a gray square in place."""
        is_hidden = _choose(self.cutout_probability, len(x), generator).tolist()
        height, width = x.shape[2:]
        samples = torch.rand((len(x), 4), generator=generator).tolist()
        for index, (size, top, left, gray) in enumerate(samples):
            if not is_hidden[index]:
                continue
            # from 30 % of the largest side up to all of it
            fraction = (0.3 + 0.7 * size) * self.largest_cutout
            side = max(1, int(fraction * min(height, width)))
            row = int(top * (height - side))
            column = int(left * (width - side))
            x[index, :, row : row + side, column : column + side] = gray


def _sample_crop_shifts(scale: Tensor, generator: Generator) -> Tensor:
    """Sample shifts (2, N) of the centers of crops, x and then y, from their scales (N,).

    If the center is moved by at most |1 - scale|, a smaller crop stays inside the image,
    and a larger one contains it. (A rotation is ignored here.)
    """
    count = len(scale)
    # The samples are flat: the first half of them is for x, the second for y.
    relative_shift = _sample_around_zero(1.0, count, 2, generator=generator)
    max_shift = (1.0 - scale).abs()
    return relative_shift.view(2, count) * max_shift


def _sample_around_zero(bound: float, *shape: int, generator: Generator) -> Tensor:
    """Return uniform samples (N,) between -bound and bound; N is that of `_uniform`."""
    return _uniform(-bound, bound, *shape, generator=generator)


def _uniform(lower: float, upper: float, *shape: int, generator: Generator) -> Tensor:
    """Return uniform samples (N,), where N is the number of elements of a shape."""
    return lower + (upper - lower) * torch.rand(math.prod(shape), generator=generator)


def _choose(probability: float, count: int, generator: Generator) -> Tensor:
    """Return a mask (count,) whose values are each true with a probability."""
    return torch.rand(count, generator=generator) < probability
