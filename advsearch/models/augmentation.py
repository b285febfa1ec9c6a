"""What happens by chance to the pictures that a classifier is trained on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Generator, Tensor


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
