"""The gradient of a batch of lessons: plain pictures and the worst ones, which are made worse first, count alike.

A network that answers plain pictures as it did before has lost nothing (learning without forgetting: Li and Hoiem 2016,
arXiv 1606.09282): where the given model is right, its answers count beside the right ones.

Threads share a batch, a few lessons at a time, each with a copy of the network: what they do is the same whatever their
number is.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from advsearch.models import Model
from advsearch.models.reference import Trainable
from advsearch.questions.harden.lessons import (
    Lesson,
    RenderedLesson,
    TextureLesson,
    ascend,
    slopes,
    surprise,
    with_worst,
)


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


PART = 6
"""Lessons that one thread works at."""
AUGMENTATION = Augmentation(smallest_crop=0.75, largest_crop=1.15, turn=15.0, cutout=0.0)
"""What happens to pictures while they are trained on; the search for worse ones sees the same."""
KEEP = 1.0
"""Weight of the given model's answers to plain pictures, beside that of the right ones."""
MIXED, MIXING = 0.5, 0.4
"""Share of the parts that mix pictures, and both parameters of the beta distribution that their weights come from."""

AnyLesson = TypeVar("AnyLesson", bound=Lesson)
Found = TypeVar("Found")


class Gradients:
    """Takes gradients for a network that is trained.

    Args:
        student: the network; its parameters collect the gradients.
        given: the model as it was given; its answers to plain pictures are kept.
        pool: threads that have one of torch's each.
    """

    def __init__(self, student: Trainable, given: Model, pool: Executor) -> None:
        self._student, self._given, self._pool = student, given, pool
        self._twins: list[Trainable] = []

    def take(self, batch: Sequence[Lesson], beside: tuple[Tensor, Tensor] | None, seed: int) -> None:
        """Make the worst pictures of lessons worse, and leave the gradient of their loss with the parameters.

        Args:
            batch: lessons.
            beside: further images (N, H, W, 3) and class indices (N,), which count too.
            seed: of what is random.
        """
        batch = sorted(batch, key=lambda one: not isinstance(one, TextureLesson))  # parts are those of `_slopes`
        ascend(batch, lambda chosen: self._slopes(chosen, seed))
        plain, worst = 1.0 / len(batch), 1.0 / max(1, len(with_worst(batch)))

        def descend(number: int, twin: Trainable, part: Sequence[Lesson]) -> list[Tensor | None]:
            loss = self._loss(twin, part, plain, worst, seed + number)
            return list(torch.autograd.grad(loss, twin.parameters(), allow_unused=True))

        def descend_beside(images: Tensor, labels: Tensor) -> list[Tensor | None]:
            loss = surprise(self._student.logits(images), [(int(label),) for label in labels]).mean()
            return list(torch.autograd.grad(loss, self._student.parameters(), allow_unused=True))

        others = [] if beside is None else [self._pool.submit(descend_beside, *beside)]
        found = [*self._each(descend, batch), *(one.result() for one in others)]
        for parameter, *own in zip(self._student.parameters(), *found, strict=True):
            some = [one for one in own if one is not None]
            parameter.grad = torch.stack(some).sum(dim=0) if some else None

    def _each(
        self, do: Callable[[int, Trainable, Sequence[AnyLesson]], Found], chosen: Sequence[AnyLesson]
    ) -> list[Found]:
        """Have something done with each part of some lessons, with its number and a copy of the network."""
        parts = [chosen[begin : begin + PART] for begin in range(0, len(chosen), PART)]
        while len(self._twins) < len(parts):
            self._twins.append(self._student.twin())
        return list(self._pool.map(do, itertools.count(), self._twins, parts))

    def _slopes(self, chosen: Sequence[TextureLesson], seed: int) -> list[Tensor]:
        """What `slopes` says."""

        def climb(number: int, twin: Trainable, part: Sequence[TextureLesson]) -> Sequence[Tensor]:
            return slopes(part, twin.quickly, lambda images: _changed(images, seed + number))

        return [one for some in self._each(climb, chosen) for one in some]

    def _loss(self, student: Trainable, part: Sequence[Lesson], plain: float, worst: float, seed: int) -> Tensor:
        """What is descended, of a part of a batch, textures first: so much of each plain picture and each worst one.

        Worst textures are changed as the search for them saw them: seen otherwise, they are no longer the worst. At
        times all that was rendered is mixed with each other (mixup, Zhang et al. 2018, arXiv 1710.09412), as no more
        pictures of it will come; a texture is another one each time. The given model's answers count of scenes as they
        are alone: where something moved, it is right without being sure.
        """
        searched, rng = with_worst(part), np.random.default_rng(seed)
        textured = [one.worst for one in searched if isinstance(one, TextureLesson)]
        shown = [[one.plain for one in part], textured, [one.worst for one in searched[len(textured) :]]]
        images = torch.cat([_changed(torch.stack(some), seed) for some in shown if some])
        taught = [*part, *searched]
        right = [one.right for one in taught]
        mixed = [place for place, one in enumerate(taught) if isinstance(one, RenderedLesson)]
        if rng.random() >= MIXED:
            mixed = []
        others, drawn = rng.permutation(mixed).astype(int).tolist(), float(rng.beta(MIXING, MIXING))
        share = min(drawn, 1.0 - drawn)
        if mixed:
            images[mixed] = torch.lerp(images[mixed], images[others], share)
        logits = student.logits(images)
        found = surprise(logits, right)
        if mixed:
            of_others = surprise(logits[mixed], [right[place] for place in others])
            found[mixed] = torch.lerp(found[mixed], of_others, share)
        as_given = [place for place, one in enumerate(part) if not isinstance(one, RenderedLesson)]
        loss = plain * found[: len(part)].sum() + worst * found[len(part) :].sum()
        if as_given:
            kept = self._forgotten(images[as_given], logits[as_given], [right[place] for place in as_given])
            loss = loss + plain * KEEP * kept
        return loss

    def _forgotten(self, plain: Tensor, logits: Tensor, right: Sequence[tuple[int, ...]]) -> Tensor:
        """The Kullback-Leibler divergence of what the given model says of plain pictures (N, H, W, 3), where it is
        right, to what logits (N, C) say; a sum over all."""
        with torch.no_grad():
            wanted = self._given(plain)
        known = [said in own for said, own in zip(wanted.argmax(dim=1).tolist(), right, strict=True)]
        target = F.log_softmax(wanted[known], dim=1)
        return F.kl_div(F.log_softmax(logits[known], dim=1), target, reduction="sum", log_target=True)


def _changed(images: Tensor, seed: int) -> Tensor:
    """Change pictures (N, H, W, 3) by chance; the same way whenever there are as many of them."""
    generator = torch.Generator().manual_seed(seed)
    return AUGMENTATION(images.permute(0, 3, 1, 2), generator).permute(0, 2, 3, 1)
