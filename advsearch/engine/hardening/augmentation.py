"""Random changes of training images, a batch at a time, cheap on a CPU, from an explicit generator; differentiable."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Generator, Tensor


@dataclass(frozen=True)
class Augmentation:
    """What may happen to a training image, in this order; every amount is drawn anew for every image.

    Args:
        flip: probability of a horizontal mirror image.
        smallest_crop, largest_crop: ends of the uniform side of the square crop, as parts of the image's side; its
            place is uniform inside the image or, where it is larger, around it; there the border goes on. 1 and 1
            switch cropping off.
        turn: half width of the uniform angle that the crop is turned by, in degrees.
        brightness: half width of the uniform shift, display-referred.
        contrast: half width of the uniform factor around 1 that scales deviations from the image's mean.
        colour: half width of the uniform factor around 1, per channel.
        blur: probability of a 3 x 3 binomial blur.
        noise: upper end of the uniform standard deviation of gaussian noise, display-referred.
        noisy: probability that noise is added at all.
        cutout: probability that a grey square hides a part.
        largest_cutout: upper end of the square's side, as a part of the image's.
    """

    flip: float = 0.5
    smallest_crop: float = 0.8
    largest_crop: float = 1.0
    turn: float = 0.0
    brightness: float = 0.1
    contrast: float = 0.25
    colour: float = 0.08
    blur: float = 0.15
    noise: float = 0.04
    noisy: float = 0.3
    cutout: float = 0.2
    largest_cutout: float = 0.3

    def __call__(self, images: Tensor, generator: Generator) -> Tensor:
        """Return changed images (N, 3, H, W), float32 in [0, 1], from images of the same kind."""
        x = self._crop_and_flip(images, generator)
        x = self._jitter(x, generator)
        x = self._blur(x, generator)
        x = self._add_noise(x, generator)
        return self._hide(x.clamp_(0.0, 1.0), generator)

    def _crop_and_flip(self, x: Tensor, generator: Generator) -> Tensor:
        count = len(x)
        scale = _uniform(count, self.smallest_crop, self.largest_crop, generator)
        shift = _uniform(2 * count, -1.0, 1.0, generator).view(2, count) * (1.0 - scale).abs()
        mirror = 1.0 - 2.0 * _chosen(count, self.flip, generator).float()
        angle = _uniform(count, -self.turn, self.turn, generator) * (math.pi / 180.0)
        along, across = scale * angle.cos(), scale * angle.sin()
        rows = (
            torch.stack([along * mirror, -across, shift[0]], 1),
            torch.stack([across * mirror, along, shift[1]], 1),
        )
        grid = F.affine_grid(torch.stack(rows, 1), list(x.shape), align_corners=False)
        return F.grid_sample(x, grid, mode="bilinear", padding_mode="border", align_corners=False)

    def _jitter(self, x: Tensor, generator: Generator) -> Tensor:
        count = len(x)
        gain = 1.0 + _uniform(count, -self.contrast, self.contrast, generator).view(count, 1, 1, 1)
        colour = 1.0 + _uniform(3 * count, -self.colour, self.colour, generator).view(count, 3, 1, 1)
        shift = _uniform(count, -self.brightness, self.brightness, generator).view(count, 1, 1, 1)
        mean = x.mean(dim=(1, 2, 3), keepdim=True)
        # ((x - mean) gain + mean + shift) colour, as one affine map
        return torch.addcmul((mean * (1.0 - gain) + shift) * colour, x, gain * colour)

    def _blur(self, x: Tensor, generator: Generator) -> Tensor:
        chosen = _chosen(len(x), self.blur, generator)
        if bool(chosen.any()):
            taps = x.new_tensor([0.25, 0.5, 0.25])
            kernel = (taps[:, None] * taps[None, :]).expand(3, 1, 3, 3)
            x[chosen] = F.conv2d(F.pad(x[chosen], (1, 1, 1, 1), mode="replicate"), kernel, groups=3)
        return x

    def _add_noise(self, x: Tensor, generator: Generator) -> Tensor:
        chosen = _chosen(len(x), self.noisy, generator)
        count = int(chosen.sum())
        if count:
            deviation = _uniform(count, 0.0, self.noise, generator).view(count, 1, 1, 1)
            x[chosen] += deviation * torch.randn((count, *x.shape[1:]), generator=generator)
        return x

    def _hide(self, x: Tensor, generator: Generator) -> Tensor:
        chosen = _chosen(len(x), self.cutout, generator).tolist()
        height, width = x.shape[2:]
        draws = torch.rand((len(x), 4), generator=generator).tolist()
        for index, (size, top, left, grey) in enumerate(draws):
            if chosen[index]:
                side = max(1, int((0.3 + 0.7 * size) * self.largest_cutout * min(height, width)))
                row, column = int(top * (height - side)), int(left * (width - side))
                x[index, :, row : row + side, column : column + side] = grey
        return x


def _uniform(count: int, low: float, high: float, generator: Generator) -> Tensor:
    return low + (high - low) * torch.rand(count, generator=generator)


def _chosen(count: int, probability: float, generator: Generator) -> Tensor:
    return torch.rand(count, generator=generator) < probability
