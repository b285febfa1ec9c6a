"""Training on lessons. Weights are averaged over the steps; the average is what is judged and kept."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor, nn

from advsearch import seeds, threads
from advsearch.config import HardenConfig
from advsearch.engine.hardening.gradients import Gradients
from advsearch.engine.hardening.lessons import TOGETHER, Lesson, TextureLesson, harder, with_worst
from advsearch.models import Model
from advsearch.models.trainable import Trainable

BATCH = 24
WEIGHT_DECAY = 0.02
LARGEST_GRADIENT_NORM = 2.0
WARM_UP = 0.1
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
        config: what was asked for; of an optimiser of the user's, its own learning rate counts.
        optimiser: makes one of the parameters; None for AdamW.
        beside: further examples; a batch of them is taken with each step, from the start again when they end.
    """

    student: Trainable
    given: Model
    config: HardenConfig
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
        parameters, config = self.student.parameters(), self.config
        if self.optimiser is None:
            optimiser: torch.optim.Optimizer = torch.optim.AdamW(parameters, lr=config.rate, weight_decay=WEIGHT_DECAY)
        else:
            optimiser = self.optimiser(parameters)
        steps, done, places = self.steps(chosen), 0, self._places(chosen)
        highest = [float(group["lr"]) for group in optimiser.param_groups]
        rates = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, highest, total_steps=steps + 1, pct_start=WARM_UP, cycle_momentum=False
        )
        average = [one.detach().clone() for one in parameters]
        rng = np.random.default_rng([seeds.stream(config.seed, "order"), number])
        with threads.one_each_for_torch() as pool:
            gradients = Gradients(self.student, self.given, pool)
            for _ in range(config.epochs):
                order = rng.permutation(places)
                for begin in range(0, len(order), BATCH):
                    batch = [chosen[place] for place in order[begin : begin + BATCH]]
                    self._step(batch, gradients, optimiser, int(rng.integers(2**62)))
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
        return self.config.epochs * -(-len(self._places(chosen)) // BATCH)

    def _places(self, chosen: Sequence[Lesson]) -> list[int]:
        """Places of lessons, as often as an epoch looks at each."""
        often = [self.config.texture_looks if isinstance(one, TextureLesson) else 1 for one in chosen]
        return [place for place, times in enumerate(often) for _ in range(times)]

    def _step(self, batch: Sequence[Lesson], gradients: Gradients, optimiser: torch.optim.Optimizer, seed: int) -> None:
        optimiser.zero_grad(set_to_none=True)
        gradients.take(batch, None if self.beside is None else self._next(), seed)
        nn.utils.clip_grad_norm_(self.student.parameters(), LARGEST_GRADIENT_NORM)
        optimiser.step()

    def _next(self) -> tuple[Tensor, Tensor]:
        assert self.beside is not None
        found = next(self._further, None)
        if found is None:
            self._further = iter(self.beside)
            found = next(self._further)
        return found


def score(model: Model, held_back: Sequence[Lesson]) -> Score:
    """Judge a model on lessons, which stay as they are; those that nothing makes harder count for `clean` alone."""
    own = [copy.copy(one) for one in held_back]
    for one in own:
        if isinstance(one, TextureLesson):
            one.texture = copy.copy(one.texture)
    harder(own, model, HELD_BACK_STEPS)
    return Score(right_share(model, own, "plain"), right_share(model, with_worst(own), "worst"))


def right_share(model: Model, chosen: Sequence[Lesson], which: str) -> float:
    """Return the share of lessons of which a model has the "plain" or the "worst" picture right."""
    right = 0
    with torch.no_grad():
        for begin in range(0, len(chosen), TOGETHER):
            part = chosen[begin : begin + TOGETHER]
            answers = model(torch.stack([getattr(one, which) for one in part])).argmax(dim=1).tolist()
            right += sum(answer in one.right for answer, one in zip(answers, part, strict=True))
    return right / len(chosen)
