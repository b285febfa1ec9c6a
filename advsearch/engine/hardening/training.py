"""Training on lessons: in each step plain pictures and the worst ones, which are made worse as it goes, count alike.

A network that answers plain pictures as it did before has lost nothing (learning without forgetting: Li and Hoiem 2016,
arXiv 1606.09282): where the given model is right, its answers count beside the right ones.

Weights are averaged over the steps; the average is what is judged and kept.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from advsearch.config.hardening import TEXTURE_LOOKS
from advsearch.engine.hardening.augmentation import Augmentation
from advsearch.engine.hardening.lessons import TOGETHER, Lesson, RenderedLesson, TextureLesson, ascend, harder, surprise
from advsearch.models import Model
from advsearch.models.trainable import Trainable

BATCH = 24
AUGMENTATION = Augmentation(smallest_crop=0.75, largest_crop=1.15, turn=15.0, cutout=0.0)
"""What happens to pictures while they are trained on; the search for worse ones sees the same."""
WEIGHT_DECAY = 0.02
LARGEST_GRADIENT_NORM = 2.0
WARM_UP = 0.1
KEEP = 1.0
"""Weight of the given model's answers to plain pictures, beside that of the right ones."""
MIXED_STEPS, MIXING = 0.5, 0.4
"""Share of the steps that mix pictures, and both parameters of the beta distribution that the parts come from."""
AVERAGE = 0.98
"""Weight of the past in the average of the weights, per step."""
HELD_BACK_STEPS = 8
"""Steps of the textures that weights are judged on, from where a search begins."""

Examples = Iterable[tuple[Tensor, Tensor]]
"""Batches of images (N, H, W, 3) sRGB in [0, 1] and class indices (N,), such as a `DataLoader`'s."""
MakeOptimiser = Callable[[Sequence[nn.Parameter]], torch.optim.Optimizer]


@dataclass(frozen=True)
class Score:
    """How a model does on lessons that it was not trained on.

    Attributes:
        clean: share of plain pictures that it has right.
        robust: share of the worst pictures, searched for against these weights.
    """

    clean: float
    robust: float


@dataclass
class Course:
    """A training.

    Attributes:
        student: what is trained.
        given: the model as it was given; its answers to plain pictures are kept.
        rate: the highest learning rate; of an optimiser of the user's, its own counts.
        epochs: how often a round looks at each lesson.
        seed: of the order.
        optimiser: makes one of the parameters; None for AdamW.
        beside: further examples; a batch of them is taken with each step, from the start again when they end.
    """

    student: Trainable
    given: Model
    rate: float
    epochs: int
    seed: int
    optimiser: MakeOptimiser | None = None
    beside: Examples | None = None
    _further: Iterator[tuple[Tensor, Tensor]] = field(default_factory=lambda: iter(()))

    def round(self, number: int, chosen: Sequence[Lesson], tick: Callable[[], None] = lambda: None) -> None:
        """Train on lessons; the student has the average of the weights afterwards.

        Args:
            number: of the round; decides the order.
            chosen: lessons.
            tick: told of every step.
        """
        parameters = self.student.parameters()
        if self.optimiser is None:
            optimiser: torch.optim.Optimizer = torch.optim.AdamW(parameters, lr=self.rate, weight_decay=WEIGHT_DECAY)
        else:
            optimiser = self.optimiser(parameters)
        steps, done, looks = self.steps(chosen), 0, _looks(chosen)
        highest = [float(group["lr"]) for group in optimiser.param_groups]
        rates = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, highest, total_steps=steps + 1, pct_start=WARM_UP, cycle_momentum=False
        )
        average = [one.detach().clone() for one in parameters]
        rng = np.random.default_rng([self.seed, number])
        for _ in range(self.epochs):
            order = rng.permutation(looks)
            for begin in range(0, len(order), BATCH):
                batch = [chosen[place] for place in order[begin : begin + BATCH]]
                self._step(batch, optimiser, int(rng.integers(2**62)))
                rates.step()
                done += 1
                decay = min(AVERAGE, done / (done + 5))
                for kept, one in zip(average, parameters, strict=True):
                    kept.lerp_(one.detach(), 1.0 - decay)
                tick()
        with torch.no_grad():
            for kept, one in zip(average, parameters, strict=True):
                one.copy_(kept)

    def steps(self, chosen: Sequence[Lesson]) -> int:
        """Steps of a round over lessons."""
        return self.epochs * -(-len(_looks(chosen)) // BATCH)

    def _step(self, batch: Sequence[Lesson], optimiser: torch.optim.Optimizer, seed: int) -> None:
        def change(images: Tensor) -> Tensor:
            """The same random changes whenever it is called."""
            generator = torch.Generator().manual_seed(seed)
            return AUGMENTATION(images.permute(0, 3, 1, 2), generator).permute(0, 2, 3, 1)

        ascend(batch, self.student.model, change=change)
        searched = [one for one in batch if isinstance(one, (TextureLesson, RenderedLesson))]
        images = change(torch.stack([one.plain for one in batch]))
        if searched:
            images = torch.cat([images, change(torch.stack([one.worst for one in searched]))])
        loss = self._loss(images, [*batch, *searched], len(batch), np.random.default_rng(seed))
        if self.beside is not None:
            shown, labels = self._next()
            truth = [(int(label),) for label in labels]
            loss = loss + surprise(self.student.logits(shown), truth).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.student.parameters(), LARGEST_GRADIENT_NORM)
        optimiser.step()

    def _loss(self, images: Tensor, taught: Sequence[Lesson], plain: int, rng: np.random.Generator) -> Tensor:
        """What is descended, of pictures (N, H, W, 3) of as many lessons: so many plain ones, then the worst ones.

        In some steps all that was rendered is mixed with each other (mixup, Zhang et al. 2018, arXiv 1710.09412), as no
        more pictures of it will come; a texture is another one each time.
        """
        right = [one.right for one in taught]
        mixed = [place for place, one in enumerate(taught) if isinstance(one, RenderedLesson)]
        if rng.random() >= MIXED_STEPS:
            mixed = []
        others, drawn = rng.permutation(mixed).astype(int).tolist(), float(rng.beta(MIXING, MIXING))
        share = min(drawn, 1.0 - drawn)
        if mixed:
            images[mixed] = torch.lerp(images[mixed], images[others], share)
        logits = self.student.logits(images)
        found = surprise(logits, right)
        if mixed:
            of_others = surprise(logits[mixed], [right[place] for place in others])
            found[mixed] = torch.lerp(found[mixed], of_others, share)
        loss = found[:plain].mean()
        unmixed = sorted({*range(plain)} - {*mixed})
        if unmixed:
            kept = self._forgotten(images[unmixed], logits[unmixed], [right[place] for place in unmixed])
            loss = loss + KEEP * kept / plain
        if len(taught) > plain:
            loss = loss + found[plain:].mean()
        for one, now in zip(taught[plain:], found[plain:].tolist(), strict=True):
            if isinstance(one, RenderedLesson) and not mixed:
                one.learned(now)
        return loss

    def _forgotten(self, plain: Tensor, logits: Tensor, right: Sequence[tuple[int, ...]]) -> Tensor:
        """The Kullback-Leibler divergence of what the given model says of plain pictures (N, H, W, 3), where it is
        right, to what logits (N, C) say; a sum over all."""
        with torch.no_grad():
            wanted = self.given(plain)
        known = [said in own for said, own in zip(wanted.argmax(dim=1).tolist(), right, strict=True)]
        target = F.log_softmax(wanted[known], dim=1)
        return F.kl_div(F.log_softmax(logits[known], dim=1), target, reduction="sum", log_target=True)

    def _next(self) -> tuple[Tensor, Tensor]:
        assert self.beside is not None
        found = next(self._further, None)
        if found is None:
            self._further = iter(self.beside)
            found = next(self._further)
        return found


def _looks(chosen: Sequence[Lesson]) -> list[int]:
    """Places of lessons, as often as an epoch looks at each."""
    return [
        place for place, one in enumerate(chosen) for _ in range(TEXTURE_LOOKS if isinstance(one, TextureLesson) else 1)
    ]


def score(model: Model, held_back: Sequence[Lesson]) -> Score:
    """Judge a model on lessons, which stay as they are; those that nothing makes harder count for `clean` alone."""
    own = [copy.copy(one) for one in held_back]
    for one in own:
        if isinstance(one, TextureLesson):
            one.texture = copy.copy(one.texture)
    harder(own, model, HELD_BACK_STEPS)
    searched = [one for one in own if isinstance(one, (TextureLesson, RenderedLesson))]
    return Score(right_share(model, own, "plain"), right_share(model, searched, "worst"))


def right_share(model: Model, chosen: Sequence[Lesson], which: str) -> float:
    """Return the share of lessons of which a model has the "plain" or the "worst" picture right."""
    right = 0
    with torch.no_grad():
        for begin in range(0, len(chosen), TOGETHER):
            part = chosen[begin : begin + TOGETHER]
            answers = model(torch.stack([getattr(one, which) for one in part])).argmax(dim=1).tolist()
            right += sum(answer in one.right for answer, one in zip(answers, part, strict=True))
    return right / len(chosen)
