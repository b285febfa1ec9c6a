"""The rounds of a hardening: scenes are drawn, a copy of the model is trained on all of
them, and that part of the way to its weights is kept which is best on scenes that it
was not trained on.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch

# by optimisers, too: before there are scenes, whose changes make Python collect what is
# new
import torch._dynamo
from safetensors import torch as safetensors
from torch import Tensor, nn

from advsearch.extend import RunDirectory, seeds, wording, workbench
from advsearch.questions.harden.networks import Trainable
from advsearch.questions.harden.result import TrainingRound
from advsearch.questions.harden.scenes import TRAINING, VALIDATION, SceneWork

WEIGHTS = "artifacts/hardened.safetensors"  # the weights that are kept, in the run
ROUND = "artifacts/round-{:03d}.safetensors"  # those after each round
ROUNDS = "rounds"  # the note of what each round came to
LARGEST_GRADIENT_NORM = 2.0
JUDGED = 168  # scenes by which weights are chosen, at most
PARTS = (1.0, 0.85, 0.7, 0.55, 0.4, 0.25)
"""Of the way from the weights that were given to the trained ones, which are judged."""

MakeOptimiser = Callable[[Sequence[nn.Parameter]], torch.optim.Optimizer]
# leaves the gradient of a batch with the parameters
Take = Callable[[Sequence[Any], np.random.Generator], None]


class Score(NamedTuple):
    """How a model does on scenes that it was not trained on: its share of plain
    pictures, and of the worst ones.
    """

    clean: float
    robust: float


class Course(ABC):
    """How models of one kind are trained, on items of which each has one picture of a
    scene or more.

    Attributes:
        work, student: what draws from scenes, with the model as it was given; the copy
            that is trained.
        optimiser: makes one of the parameters, whose own learning rate counts; None for
            AdamW.
        own: items that are trained on beside those that are drawn.
        further: scenes that are drawn on top of each one of the training.
        views: that are drawn of a scene of the training, and of one by which weights
            are chosen.
        batch, warm_up: items of a step; share of the steps in which the learning rate
            rises.
        average: weight of the past in the average of the weights, per step, which a
            round ends with.
    """

    batch: ClassVar[int]
    weight_decay: ClassVar[float]
    warm_up: ClassVar[float]
    average: ClassVar[float] = 0.0
    views: tuple[int, int]

    def __init__(
        self,
        work: SceneWork,
        student: Trainable,
        optimiser: MakeOptimiser | None = None,
        own: Sequence[Any] = (),
    ) -> None:
        self.work = work
        self.config = work.config
        self.student = student
        self.optimiser = optimiser
        self.own = own

    @property
    def further(self) -> int:
        return 0

    @abstractmethod
    def draw(self, title: str, split: str, places: range) -> list[Any]:
        """Return items of the scenes with these numbers of a split; `title` is what the
        progress says.
        """

    @abstractmethod
    def looks(self, item: Any) -> int:
        """Return how often an epoch looks at an item."""

    @abstractmethod
    def gradients(self, new: Sequence[Any]) -> AbstractContextManager[Take]:
        """Begin a round in which these are new; inside there is what takes
        gradients.
        """

    @abstractmethod
    def score(self, held_back: Sequence[Any]) -> Score:
        """Judge the student on items that it was not trained on, which stay as they
        are.
        """

    @abstractmethod
    def save(self, run: RunDirectory, number: int, new: Sequence[Any]) -> None:
        """Write the pictures of a round's new items into `PICTURES` of the run."""

    def steps(self, pool: Sequence[Any]) -> int:
        return self.config.epochs * -(-sum(map(self.looks, pool)) // self.batch)

    def round(
        self,
        number: int,
        pool: Sequence[Any],
        new: Sequence[Any] = (),
        tick: Callable[[], None] = lambda: None,
    ) -> None:
        """Train on items in an order that the number of the round decides."""
        parameters = self.student.parameters()
        rate = self.config.rate
        make = self.optimiser or partial(
            torch.optim.AdamW, lr=rate, weight_decay=self.weight_decay
        )
        optimiser = make(parameters)
        n_rates = self.steps(pool) + 1
        rates = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, [float(group["lr"]) for group in optimiser.param_groups], total_steps=n_rates,
            pct_start=warm_up_fraction(self.warm_up, n_rates), cycle_momentum=False,
        )  # fmt: skip
        average = [parameter.detach().clone() for parameter in parameters]
        done = 0
        rng = np.random.default_rng([seeds.stream(self.config.seed, "order"), number])
        places = [
            place for place, item in enumerate(pool) for _ in range(self.looks(item))
        ]
        with self.gradients(new) as take:
            for _ in range(self.config.epochs):
                order = rng.permutation(places)
                for begin in range(0, len(order), self.batch):
                    take(
                        [pool[place] for place in order[begin : begin + self.batch]],
                        rng,
                    )
                    nn.utils.clip_grad_norm_(parameters, LARGEST_GRADIENT_NORM)
                    optimiser.step()
                    rates.step()
                    done += 1
                    decay = min(self.average, done / (done + 5))
                    for kept, parameter in zip(average, parameters, strict=True):
                        kept.lerp_(parameter.detach(), 1.0 - decay)
                    tick()
        with torch.no_grad():
            for kept, parameter in zip(average, parameters, strict=True):
                parameter.copy_(kept)


def warm_up_fraction(fraction: float, n_rates: int) -> float:
    """Return the fraction of the steps in which the rate rises, or a little more where
    that is a single step.

    OneCycleLR divides by the steps of its rise but one.
    """
    return fraction * 1.001 if math.isclose(fraction * n_rates, 1.0) else fraction


class Rounds:
    """The rounds of a run; `done` is what each came to, of which the first is the model
    as it was.
    """

    def __init__(self, run: RunDirectory, course: Course) -> None:
        self.run = run
        self.course = course
        self.config = course.config
        self.progress = course.work.progress
        self.done = [
            TrainingRound.of(noted)
            for noted in json.loads(run.store.note(ROUNDS) or "[]")
        ]

    @property
    def judged(self) -> int:
        """Scenes by which weights are chosen, for each control: a third as many as a
        round adds, up to `JUDGED`.
        """
        return min(-(-self.config.scenes // 3), JUDGED)

    @property
    def best(self) -> int:
        """The round whose weights are kept: the most robust one whose clean accuracy is
        within what may be lost.
        """
        allowed = [
            number for number, done in enumerate(self.done) if self._allowed(done.clean)
        ]
        return max(
            allowed, key=lambda number: (self.done[number].robust, number), default=0
        )

    def _allowed(self, clean: float) -> bool:
        return clean >= self.done[0].clean - self.config.clean_loss - 1e-9

    def carry_out(self) -> None:
        """Do what is left of the rounds; the student has the best weights afterwards,
        which the run keeps.
        """
        course = self.course
        config = self.config
        net = self.course.student.net
        if len(self.done) <= config.rounds:
            pool = list(course.own)
            begun = 0
            held_back = course.draw(
                "drawing scenes to choose weights by", VALIDATION, range(self.judged)
            )
            if not self.done:
                self.progress.stage("judging the model as it is")
                self.keep(0, [], course.score(held_back), 0, 0.0)
            for number in range(1, config.rounds + 1):
                net.load_state_dict(self._weights(number - 1))
                places = range((number - 1) * config.scenes, number * config.scenes)
                new = course.draw(f"round {number}: drawing scenes", TRAINING, places)
                pool += new
                if number < len(self.done):
                    continue  # done before this run was stopped
                self.progress.stage(f"round {number}: training", course.steps(pool))
                with workbench.all_for_torch():
                    # others are as hard as their training left them
                    course.round(
                        number, pool, pool[begun:], lambda: self.progress.advance(1)
                    )
                    self.progress.stage(
                        f"round {number}: choosing weights", len(PARTS), at_most=True
                    )
                    judged, part = self.mixed(held_back)
                begun = len(pool)
                self.keep(number, new, judged, len(pool), part)
        net.load_state_dict(self._weights(self.best))
        self._save(WEIGHTS)

    def mixed(self, held_back: Sequence[Any]) -> tuple[Score, float]:
        """Leave the student with the best part of the way from the weights that were
        given; return its score and it.

        The best one is right most often on the worst pictures among those that lose no
        more on plain ones than they may; where all lose more, it is the one that loses
        least. Less of the way learned less: once that shows, the smaller parts are not
        looked at, as each costs a search of its own.
        """
        net = self.course.student.net
        given = self._weights(0)
        scores = dict[float, Score]()
        learned = {name: weight.clone() for name, weight in net.state_dict().items()}

        def take(part: float) -> None:
            mixed = {name: torch.lerp(given[name], weight, part) for name, weight in learned.items()
                     if weight.is_floating_point()}  # fmt: skip
            net.load_state_dict({**learned, **mixed})

        for part in PARTS:
            take(part)
            scores[part] = self.course.score(held_back)
            self.progress.advance(1, worst=scores[part].robust)
            allowed = {
                part: score.robust
                for part, score in scores.items()
                if self._allowed(score.clean)
            }
            if allowed and [*allowed.values()][-1] < max(allowed.values()):
                break
        best = max(
            allowed or scores,
            key=lambda part: allowed[part] if allowed else scores[part].clean,
        )
        take(best)
        return scores[best], best

    def keep(
        self, number: int, new: Sequence[Any], judged: Score, trained: int, part: float
    ) -> None:
        """Keep the weights of a round, with its new pictures and what it came to."""
        self._save(ROUND.format(number))
        self.course.save(self.run, number, new)
        self.done.append(
            TrainingRound(lessons=trained, part=part, **judged._asdict(), kept=False)
        )
        self.run.store.set_note(
            ROUNDS, json.dumps([done.model_dump() for done in self.done])
        )
        clean, worst = map(wording.percent, judged)
        self.progress.message(
            f"round {number}: {clean} of plain pictures right, {worst} of the worst"
        )

    def _save(self, name: str) -> None:
        # two names may be of one tensor, which safetensors refuses
        state = self.course.student.net.state_dict()
        kept = {
            key: weight.clone(memory_format=torch.contiguous_format)
            for key, weight in state.items()
        }
        self.run.write_file(name, safetensors.save(kept))

    def _weights(self, number: int) -> dict[str, Tensor]:
        return safetensors.load((self.run.path / ROUND.format(number)).read_bytes())
