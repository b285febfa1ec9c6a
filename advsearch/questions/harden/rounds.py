"""The rounds of a hardening.

Each round samples scenes, and trains a copy of the model on all scenes so far. Then it
interpolates between the original and the trained weights. Its result is the
interpolation that is best on validation scenes.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch

# Optimizers import this module when they are made. It is imported here, before scenes
# are loaded: with many objects in memory, the import makes garbage collection slow.
import torch._dynamo
from safetensors import torch as safetensors
from torch import Tensor, nn

from advsearch.extend import RunDirectory, seeds, wording, workbench
from advsearch.questions.harden.networks import Trainable
from advsearch.questions.harden.result import TrainingRound
from advsearch.questions.harden.scenes import TRAINING, VALIDATION, SceneJobs

WEIGHTS_FILE = "artifacts/hardened.safetensors"
"""File of the best weights in the run."""
ROUND_FILE = "artifacts/round-{:03d}.safetensors"
"""File of the weights after each round."""
ROUNDS_NOTE = "rounds"
"""Note of a run: the result of each round."""
MAX_GRADIENT_NORM = 2.0
"""Larger gradients are scaled down to this norm."""
MAX_VALIDATION_SCENES = 168
"""Maximum number of validation scenes."""
INTERPOLATIONS = (1.0, 0.85, 0.7, 0.55, 0.4, 0.25)
"""Interpolations that are evaluated: 0 is the original weights, 1 the trained ones."""

MakeOptimizer = Callable[[Sequence[nn.Parameter]], torch.optim.Optimizer]
ComputeGradient = Callable[[Sequence[Any], np.random.Generator], None]
"""Computes the gradient of a batch of items, and stores it in `grad` of the parameters.
"""


class Score(NamedTuple):
    """Accuracy on validation scenes: of plain images, and of the worst ones."""

    clean: float
    robust: float


class Trainer(ABC):
    """Trains models of one task on items, each of which has images of a scene.

    Attributes:
        scene_jobs: samples items from scenes; it has the original model.
        student: the copy that is trained.
        optimiser: creates the optimizer of the parameters, with a learning rate of its
            own; None for AdamW.
        custom_items: the user's own items, which each round trains on.
        n_further_scenes: number of scenes that are sampled in addition to each training
            scene.
        n_views: number of views of a training scene, and of a validation scene.
        batch_size: number of items of a step.
        weight_decay: weight decay of AdamW.
        warm_up_fraction: fraction of the steps in which the learning rate rises.
        average_decay: decay per step of the running average of the weights, which is
            the result of a round.
    """

    batch_size: ClassVar[int]
    weight_decay: ClassVar[float]
    warm_up_fraction: ClassVar[float]
    average_decay: ClassVar[float] = 0.0
    n_views: tuple[int, int]

    def __init__(
        self,
        work: SceneJobs,
        student: Trainable,
        optimiser: MakeOptimizer | None = None,
        custom_items: Sequence[Any] = (),
    ) -> None:
        """Set up the trainer.

        Args:
            work: samples scenes of the run, and makes items from them.
            student: the copy of the network that is trained.
            optimiser: function from a list of parameters to an optimizer; None for
                AdamW.
            custom_items: the user's own items, which each round trains on.
        """
        self.scene_jobs = work
        self.config = work.config
        self.student = student
        self.optimiser = optimiser
        self.custom_items = custom_items

    @property
    def n_further_scenes(self) -> int:
        """Number of scenes that are sampled in addition to each training scene."""
        return 0

    @abstractmethod
    def sample_items(self, title: str, split: str, scene_numbers: range) -> list[Any]:
        """Sample the items of scenes.

        Args:
            title: title of the stage that the progress reports.
            split: split that the scenes belong to.
            scene_numbers: numbers of the scenes.
        """

    @abstractmethod
    def uses_per_epoch(self, item: Any) -> int:
        """Return how often an epoch uses an item."""

    @abstractmethod
    def open_gradient_context(
        self, new: Sequence[Any]
    ) -> AbstractContextManager[ComputeGradient]:
        """Return a context in which gradients are computed.

        Args:
            new: items that no earlier round has used.
        """

    @abstractmethod
    def evaluate_student(self, validation_items: Sequence[Any]) -> Score:
        """Evaluate the student on items of the validation, which are not changed."""

    @abstractmethod
    def save_images(self, run: RunDirectory, number: int, new: Sequence[Any]) -> None:
        """Write the images of a round's new items into `IMAGE_DIRECTORY` of the run."""

    def count_steps(self, pool: Sequence[Any]) -> int:
        """Return the number of optimizer steps of a round."""
        n_items = sum(self.uses_per_epoch(item) for item in pool)
        return self.config.epochs * math.ceil(n_items / self.batch_size)

    def train_round(
        self,
        number: int,
        training_items: Sequence[Any],
        new: Sequence[Any] = (),
        tick: Callable[[], None] = lambda: None,
    ) -> None:
        """Train the student on items.

        At the end the student gets the running average of its weights, which usually
        generalizes better than the last ones.

        Args:
            number: number of the round, which decides the order of the items.
            training_items: all items of this and earlier rounds.
            new: items that no earlier round has used.
            tick: function that is called after each step, for the progress.
        """
        parameters = self.student.parameters()
        optimizer, schedule = self._make_optimizer(
            parameters, self.count_steps(training_items)
        )
        average = [parameter.detach().clone() for parameter in parameters]
        rng = self._make_order_generator(number)
        with self.open_gradient_context(new) as compute_gradient:
            batches = self._iterate_batches(training_items, rng)
            for n_steps, batch in enumerate(batches, start=1):
                compute_gradient(batch, rng)
                _take_step(parameters, optimizer, schedule)
                self._update_average(n_steps, average, parameters)
                tick()
        _copy_average(average, parameters)

    def _make_order_generator(self, number: int) -> np.random.Generator:
        """Return the random generator of a round.

        It shuffles each epoch when the epoch begins (`_iterate_batches`). In between,
        gradients sample from it.
        """
        order_seed = seeds.derive_seed(self.config.seed, "order")
        return np.random.default_rng([order_seed, number])

    def _iterate_batches(
        self, pool: Sequence[Any], rng: np.random.Generator
    ) -> Iterator[list[Any]]:
        """Yield the batches of all epochs, each epoch in another order.

        An epoch has each item as often as `uses_per_epoch` states.
        """
        item_indices = self._list_uses(pool)
        for _ in range(self.config.epochs):
            order = rng.permutation(item_indices)
            for start in range(0, len(order), self.batch_size):
                batch_indices = order[start : start + self.batch_size]
                yield [pool[index] for index in batch_indices]

    def _list_uses(self, pool: Sequence[Any]) -> list[int]:
        """Return the indices of the items of an epoch, each as often as it is used."""
        indices = list[int]()
        for index, item in enumerate(pool):
            indices += [index] * self.uses_per_epoch(item)
        return indices

    def _update_average(
        self, n_steps: int, average: Sequence[Tensor], parameters: Sequence[Tensor]
    ) -> None:
        """Move the running average of the parameters towards their values after a step.

        Its decay is smaller in the first steps, so that it soon forgets the weights
        that the round began with.

        Args:
            n_steps: number of steps so far, including the last one.
            average: average of each parameter, which is changed in place.
            parameters: the parameters after the step.
        """
        decay = min(self.average_decay, n_steps / (n_steps + 5))
        for mean, parameter in zip(average, parameters, strict=True):
            mean.lerp_(parameter.detach(), 1.0 - decay)

    def _make_optimizer(
        self, parameters: Sequence[nn.Parameter], n_steps: int
    ) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
        """Create the optimizer of a round, and its schedule of learning rates.

        Args:
            parameters: parameters that are trained.
            n_steps: number of steps of the round.
        """
        make_optimizer = self.optimiser or partial(
            torch.optim.AdamW, lr=self.config.rate, weight_decay=self.weight_decay
        )
        optimizer = make_optimizer(parameters)
        return optimizer, _make_schedule(optimizer, n_steps, self.warm_up_fraction)


def _make_schedule(
    optimizer: torch.optim.Optimizer, n_steps: int, warm_up_fraction: float
) -> torch.optim.lr_scheduler.LRScheduler:
    """Create the schedule of learning rates of a round.

    The rate rises to its maximum in the warm-up and then falls to nearly 0 (one
    cycle, Smith and Topin 2018, arXiv 1708.07120).

    Args:
        optimizer: optimizer, whose rates are the maximum.
        n_steps: number of steps of the round.
        warm_up_fraction: fraction of the steps in which the rate rises.
    """
    # `train_round` calls `schedule.step` after each step, also after the last one. So
    # the schedule has a further rate, which is not used.
    n_rates = n_steps + 1
    return torch.optim.lr_scheduler.OneCycleLR(
        optimizer,
        [float(group["lr"]) for group in optimizer.param_groups],
        total_steps=n_rates,
        pct_start=adjust_warm_up(warm_up_fraction, n_rates),
        # not every optimizer has a momentum
        cycle_momentum=False,
    )


def _take_step(
    parameters: Sequence[nn.Parameter],
    optimizer: torch.optim.Optimizer,
    schedule: torch.optim.lr_scheduler.LRScheduler,
) -> None:
    """Change parameters by their gradient, whose norm is limited.

    Without a limit, a few very wrong images could make a step so large that it undoes
    others.
    """
    nn.utils.clip_grad_norm_(parameters, MAX_GRADIENT_NORM)
    optimizer.step()
    schedule.step()


def _copy_average(average: Sequence[Tensor], parameters: Sequence[Tensor]) -> None:
    """Set the parameters to their running average."""
    with torch.no_grad():
        for mean, parameter in zip(average, parameters, strict=True):
            parameter.copy_(mean)


def _interpolate(
    original: Mapping[str, Tensor], trained: Mapping[str, Tensor], interpolation: float
) -> dict[str, Tensor]:
    """Return weights between the original (0) and the trained ones (1).

    Tensors that are not floating point, such as counters of batches, are not
    interpolated but taken from the trained ones.
    """
    interpolated = {
        name: torch.lerp(original[name], weight, interpolation)
        for name, weight in trained.items()
        if weight.is_floating_point()
    }
    return {**trained, **interpolated}


def adjust_warm_up(fraction: float, n_rates: int) -> float:
    """Return the fraction of the steps in which the learning rate rises.

    If the rate rises for n steps, OneCycleLR divides by n - 1. If n is 1, the fraction
    is made a little larger, so that it does not divide by zero.

    Args:
        fraction: the fraction.
        n_rates: number of all steps of the schedule.
    """
    n_rising_steps = fraction * n_rates
    is_single_step = math.isclose(n_rising_steps, 1.0)
    return fraction * 1.001 if is_single_step else fraction


class Rounds:
    """The rounds of a run.

    Attributes:
        finished_rounds: the result of each round that has ended. Round 0 is the
            original model.
    """

    def __init__(self, run: RunDirectory, trainer: Trainer) -> None:
        """Prepare the rounds, with the results of those that are done already."""
        self.run = run
        self.trainer = trainer
        self.config = trainer.config
        self.progress = trainer.scene_jobs.progress
        self.finished_rounds = [
            TrainingRound.from_values(fields)
            for fields in json.loads(run.store.read_note(ROUNDS_NOTE) or "[]")
        ]

    @property
    def n_validation_scenes(self) -> int:
        """Number of validation scenes for each control.

        A third as many as a round adds, up to `MAX_VALIDATION_SCENES`.
        """
        return min(math.ceil(self.config.scenes / 3), MAX_VALIDATION_SCENES)

    @property
    def best_round_number(self) -> int:
        """Number of the most robust round that has enough clean accuracy.

        If several are as robust, it is the last. It is 0, the original model, if there
        is no such round.
        """
        allowed = [
            number
            for number, training_round in enumerate(self.finished_rounds)
            if self.is_allowed(training_round.clean)
        ]
        return max(
            allowed,
            key=lambda number: (self.finished_rounds[number].robust, number),
            default=0,
        )

    def is_allowed(self, clean: float) -> bool:
        """Return whether a clean accuracy has fallen by no more than allowed."""
        # 1e-9 is for rounding errors: a fall by exactly `clean_loss` is allowed.
        return clean >= self.finished_rounds[0].clean - self.config.clean_loss - 1e-9

    def execute(self) -> None:
        """Run the rounds that are left, and write the best weights.

        Afterwards the student has the best weights.
        """
        n_trained_rounds = len(self.finished_rounds) - 1  # without round 0
        is_done = n_trained_rounds >= self.config.rounds
        if not is_done:
            self._run_rounds()
        network = self.trainer.student.network
        network.load_state_dict(self.read_weights(self.best_round_number))
        self.write_weights(WEIGHTS_FILE)

    def _run_rounds(self) -> None:
        """Run the rounds that are left; round 0 evaluates the original model.

        A run that was stopped continues after its last stored round. Items are not
        stored: those of earlier rounds are sampled again from their seeds, since later
        rounds train on them too.
        """
        held_back = self._sample_validation_items()
        if not self.finished_rounds:
            self._evaluate_original(held_back)
        pool = list(self.trainer.custom_items)
        # Items at the start of the pool that a round of this session has trained on.
        n_used = 0
        # Round 0 is the original model, so the first round of training is 1.
        for number in range(1, self.config.rounds + 1):
            new_items = self._begin_round(number)
            pool += new_items
            is_done_before = number < len(self.finished_rounds)  # in an earlier session
            if is_done_before:
                continue
            score, interpolation = self._train(number, pool, n_used, held_back)
            n_used = len(pool)
            self.store_round(number, new_items, score, len(pool), interpolation)

    def _sample_validation_items(self) -> list[Any]:
        """Sample the items by which weights are chosen."""
        return self.trainer.sample_items(
            "drawing scenes for the choice of weights",
            VALIDATION,
            range(self.n_validation_scenes),
        )

    def _evaluate_original(self, held_back: Sequence[Any]) -> None:
        """Store round 0, the score of the original model on items of the validation."""
        self.progress.stage("evaluating the original model")
        original_score = self.trainer.evaluate_student(held_back)
        self.store_round(0, [], original_score, n_trained=0, interpolation=0.0)

    def _begin_round(self, number: int) -> list[Any]:
        """Load the weights of the round before into the student, and sample new items."""
        network = self.trainer.student.network
        network.load_state_dict(self.read_weights(number - 1))
        n_scenes = self.config.scenes
        return self.trainer.sample_items(
            f"round {number}: drawing scenes",
            TRAINING,
            range((number - 1) * n_scenes, number * n_scenes),
        )

    def _train(
        self, number: int, pool: Sequence[Any], n_used: int, held_back: Sequence[Any]
    ) -> tuple[Score, float]:
        """Train the student, and load the best interpolation of weights into it.

        Args:
            number: number of the round.
            pool: items that it is trained on.
            n_used: number of items at the start of the pool that earlier rounds of this
                session have used. The search for their worst images goes on; for all
                other items it begins.
            held_back: items of the validation, which are not trained on.

        Returns:
            The score on the held-back items, and the interpolation: 0 is the original
            weights, 1 the trained ones.
        """
        self.progress.stage(f"round {number}: training", self.trainer.count_steps(pool))
        with workbench.all_for_torch():
            self.trainer.train_round(
                number,
                pool,
                new=pool[n_used:],
                tick=lambda: self.progress.advance(1),
            )
            self.progress.stage(
                f"round {number}: choosing weights",
                len(INTERPOLATIONS),
                at_most=True,
            )
            return self.select_interpolation(held_back)

    def select_interpolation(self, held_back: Sequence[Any]) -> tuple[Score, float]:
        """Load the best mixture of original and trained weights into the student.

        Among the mixtures with enough clean accuracy, the best one is right most often
        on the worst images. If none has enough, the best one has the highest clean
        accuracy.

        Args:
            held_back: items of the validation split, which are not trained on.

        Returns:
            The score of the best mixture, and its interpolation.
        """
        network = self.trainer.student.network
        original = self.read_weights(0)
        trained = {
            name: weight.clone() for name, weight in network.state_dict().items()
        }
        scores = self._score_interpolations(original, trained, held_back)
        allowed_scores = self._select_allowed(scores)
        if allowed_scores:
            best = max(allowed_scores, key=lambda key: allowed_scores[key].robust)
        else:
            best = max(scores, key=lambda key: scores[key].clean)
        network.load_state_dict(_interpolate(original, trained, best))
        return scores[best], best

    def _score_interpolations(
        self,
        original: Mapping[str, Tensor],
        trained: Mapping[str, Tensor],
        held_back: Sequence[Any],
    ) -> dict[float, Score]:
        """Return the scores of mixtures of weights by their interpolation.

        `INTERPOLATIONS` are tried from the trained weights towards the original ones.
        Mixtures nearer to the original weights have learned less, so once the accuracy
        on worst images falls, the others are not evaluated: each would take a search of
        its own.

        Args:
            original: weights of the original model.
            trained: weights after the training of the round.
            held_back: items of the validation split.
        """
        scores = dict[float, Score]()
        for interpolation in INTERPOLATIONS:
            mixture = _interpolate(original, trained, interpolation)
            self.trainer.student.network.load_state_dict(mixture)
            score = self.trainer.evaluate_student(held_back)
            scores[interpolation] = score
            self.progress.advance(1, worst=score.robust)
            if self._has_fallen(scores):
                break
        return scores

    def _has_fallen(self, scores: Mapping[float, Score]) -> bool:
        """Return whether the last allowed score is less robust than an earlier one."""
        allowed_scores = self._select_allowed(scores).values()
        robust = [score.robust for score in allowed_scores]
        return bool(robust) and robust[-1] < max(robust)

    def _select_allowed(self, scores: Mapping[float, Score]) -> dict[float, Score]:
        """Return the scores with enough clean accuracy, in the same order."""
        return {
            interpolation: score
            for interpolation, score in scores.items()
            if self.is_allowed(score.clean)
        }

    def store_round(
        self,
        number: int,
        new_items: Sequence[Any],
        score: Score,
        n_trained: int,
        interpolation: float,
    ) -> None:
        """Store the weights of a round, its new images and its result.

        Args:
            number: number of the round.
            new_items: its new items.
            score: the score of the weights.
            n_trained: number of items that the weights were trained on; 0 for the
                original model.
            interpolation: fraction of the trained weights in the mixture; the rest is
                the original weights.
        """
        # The result is stored last: a round that was stopped before is trained again.
        self.write_weights(ROUND_FILE.format(number))
        self.trainer.save_images(self.run, number, new_items)
        self.finished_rounds.append(
            TrainingRound(
                lessons=n_trained,
                part=interpolation,
                clean=score.clean,
                robust=score.robust,
                is_selected=False,
            )
        )
        self._write_results()
        self._report_round(number, score)

    def _report_round(self, number: int, score: Score) -> None:
        """Report the accuracies of a round to the user."""
        clean = wording.percent(score.clean)
        worst = wording.percent(score.robust)
        self.progress.message(
            f"round {number}: {clean} of plain pictures right, {worst} of the worst"
        )

    def _write_results(self) -> None:
        """Store the results of all rounds so far as a note of the run."""
        stored_results = [
            training_round.model_dump() for training_round in self.finished_rounds
        ]
        self.run.store.write_note(ROUNDS_NOTE, json.dumps(stored_results))

    def write_weights(self, name: str) -> None:
        """Write the student's weights into a file of the run."""
        state = self.trainer.student.network.state_dict()
        # Two names may belong to the same tensor, which safetensors rejects: so each
        # gets a copy.
        cloned = {
            key: weight.clone(memory_format=torch.contiguous_format)
            for key, weight in state.items()
        }
        self.run.write_file(name, safetensors.save(cloned))

    def read_weights(self, number: int) -> dict[str, Tensor]:
        """Read the weights of a round."""
        return safetensors.load(
            (self.run.path / ROUND_FILE.format(number)).read_bytes()
        )
