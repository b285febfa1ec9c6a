"""Training on lessons. Weights are averaged over the steps; the average is what is judged and kept."""

from __future__ import annotations

import copy
import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
import torch._dynamo  # by optimisers, too: before there are scenes, whose changes make Python collect what is new
import torch.nn.functional as F
from safetensors import torch as safetensors
from torch import Tensor, nn

from advsearch import seeds, threads
from advsearch.models import Model
from advsearch.models.augmentation import Augmentation
from advsearch.models.reference import Trainable
from advsearch.progress import Progress
from advsearch.questions.harden import lessons
from advsearch.questions.harden.lessons import Lesson, RenderedLesson, TextureLesson, surprise, with_worst
from advsearch.questions.harden.result import HardenConfig, TrainingRound
from advsearch.questions.harden.scenes import TRAINING, VALIDATION
from advsearch.report.wording import percent
from advsearch.runs.directory import ARTIFACTS, RunDirectory
from advsearch.runs.files import write_bytes

BATCH, PART = 24, 6  # lessons of a step, and those of it that one thread works at
WEIGHT_DECAY, LARGEST_GRADIENT_NORM, WARM_UP, AVERAGE = 0.02, 2.0, 0.1, 0.98
"""`AVERAGE` is the weight of the past in the average of the weights, per step."""
HELD_BACK_STEPS = 8  # steps of the textures that weights are judged on, from where a search begins
AUGMENTATION = Augmentation(smallest_crop=0.75, largest_crop=1.15, turn=15.0, cutout=0.0)
"""What happens to pictures while they are trained on; the search for worse ones sees the same."""
KEEP = 1.0  # weight of the given model's answers to plain pictures, beside that of the right ones
MIXED, MIXING = 0.5, 0.4
"""Share of the parts that mix pictures, and both parameters of the beta distribution that their weights come from."""

Examples = Iterable[tuple[Tensor, Tensor]]
"""Batches of images (N, H, W, 3) sRGB in [0, 1] and class indices (N,), such as a `DataLoader`'s."""
MakeOptimiser = Callable[[Sequence[nn.Parameter]], torch.optim.Optimizer]


@dataclass
class Course:
    """A training of a student, which keeps the answers to plain pictures of the model as it was given. `optimiser`
    makes one of the parameters, whose own learning rate counts; None for AdamW. Of the examples `beside` a batch is
    taken with each step, from the start again when they end."""

    student: Trainable
    given: Model
    config: HardenConfig
    optimiser: MakeOptimiser | None = None
    beside: Examples | None = None
    _further: Iterator[tuple[Tensor, Tensor]] = field(default_factory=lambda: iter(()))

    def round(self, number: int, chosen: Sequence[Lesson], tick: Callable[[], None] = lambda: None) -> None:
        """Train on lessons in an order that the number of the round decides; the student has the average of the weights
        afterwards."""
        parameters, config, places = self.student.parameters(), self.config, self._places(chosen)
        usual = torch.optim.AdamW(parameters, lr=config.rate, weight_decay=WEIGHT_DECAY)
        optimiser = usual if self.optimiser is None else self.optimiser(parameters)
        highest = [float(group["lr"]) for group in optimiser.param_groups]
        steps, done = self.steps(chosen), 0
        rates = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, highest, total_steps=steps + 1, pct_start=WARM_UP, cycle_momentum=False
        )
        average = [parameter.detach().clone() for parameter in parameters]
        rng = np.random.default_rng([seeds.stream(config.seed, "order"), number])
        with threads.one_each_for_torch() as pool:
            gradients = Gradients(self.student, self.given, pool)
            for _ in range(config.epochs):
                order = rng.permutation(places)
                for begin in range(0, len(order), BATCH):
                    batch = [chosen[place] for place in order[begin : begin + BATCH]]
                    gradients.take(batch, self._next(), int(rng.integers(2**62)))
                    nn.utils.clip_grad_norm_(parameters, LARGEST_GRADIENT_NORM)
                    optimiser.step()
                    rates.step()
                    done += 1
                    decay = min(AVERAGE, done / (done + 5))
                    for kept, parameter in zip(average, parameters, strict=True):
                        kept.lerp_(parameter.detach(), 1.0 - decay)
                    tick()
        with torch.no_grad():
            for kept, parameter in zip(average, parameters, strict=True):
                parameter.copy_(kept)

    def steps(self, chosen: Sequence[Lesson]) -> int:
        """Steps of a round over lessons."""
        return self.config.epochs * -(-len(self._places(chosen)) // BATCH)

    def _places(self, chosen: Sequence[Lesson]) -> list[int]:
        """Places of lessons, as often as an epoch looks at each."""
        often = [self.config.texture_looks if isinstance(lesson, TextureLesson) else 1 for lesson in chosen]
        return [place for place, times in enumerate(often) for _ in range(times)]

    def _next(self) -> tuple[Tensor, Tensor] | None:
        if self.beside is None:
            return None
        if (batch := next(self._further, None)) is None:
            self._further = iter(self.beside)
            batch = next(self._further)
        return batch


class Gradients:
    """Takes gradients for a network that is trained, whose parameters collect them, on threads that have one of torch's
    each (side by side they wait at no barriers), each with a copy of the network that shares its weights."""

    def __init__(self, student: Trainable, given: Model, pool: Executor) -> None:
        self._student, self._given, self._pool = student, given, pool
        self._twins: list[Trainable] = []

    def take(self, batch: Sequence[Lesson], beside: tuple[Tensor, Tensor] | None, seed: int) -> None:
        """Make the worst pictures of lessons worse, and leave the gradient of their loss with the parameters. Further
        images (N, H, W, 3) and class indices (N,) count too."""
        batch = sorted(batch, key=lambda one: not isinstance(one, TextureLesson))  # so that both have the same parts

        def each(do: Callable[..., Sequence[Any]], chosen: Sequence[Lesson]) -> list[Sequence[Any]]:
            parts = [chosen[begin : begin + PART] for begin in range(0, len(chosen), PART)]
            self._twins += [self._student.twin() for _ in parts[len(self._twins) :]]
            return list(self._pool.map(do, parts, self._twins, itertools.count(seed)))

        def climb(part: Sequence[TextureLesson], twin: Trainable, seed: int) -> Sequence[Tensor]:
            return lessons.slopes(part, twin.quickly, lambda images: _changed(images, seed))

        def descend(part: Sequence[Lesson], twin: Trainable, seed: int) -> Sequence[Tensor | None]:
            return torch.autograd.grad(self._loss(twin, part, *means, seed), twin.parameters(), allow_unused=True)

        lessons.ascend(batch, lambda chosen: [slope for some in each(climb, chosen) for slope in some])
        means = 1.0 / len(batch), 1.0 / max(1, len(with_worst(batch)))
        found = each(descend, batch)
        if beside is not None:
            loss = surprise(self._student.logits(beside[0]), [(int(label),) for label in beside[1]]).mean()
            found.append(torch.autograd.grad(loss, self._student.parameters(), allow_unused=True))
        for parameter, *own in zip(self._student.parameters(), *found, strict=True):
            some = [slope for slope in own if slope is not None]
            parameter.grad = torch.stack(some).sum(dim=0) if some else None

    def _loss(self, student: Trainable, part: Sequence[Lesson], plain: float, worst: float, seed: int) -> Tensor:
        """What is descended, of a part of a batch, textures first: so much of each plain picture and each worst one.

        Worst textures are changed as the search for them saw them: seen otherwise, they are no longer the worst. At
        times all that was rendered is mixed with each other (mixup, Zhang et al. 2018, arXiv 1710.09412), as no more
        pictures of it will come; a texture is another one each time. The given model's predictions count of scenes as
        they
        are alone: where something moved, it is right without being sure.
        """
        searched, rng, mixed = with_worst(part), np.random.default_rng(seed), list[int]()
        textured = [lesson.worst for lesson in searched if isinstance(lesson, TextureLesson)]
        shown = [[lesson.plain for lesson in part], textured, [one.worst for one in searched[len(textured) :]]]
        images = torch.cat([_changed(torch.stack(some), seed) for some in shown if some])
        taught = [*part, *searched]
        right = [lesson.right for lesson in taught]
        if rng.random() < MIXED:
            mixed = [place for place, lesson in enumerate(taught) if isinstance(lesson, RenderedLesson)]
        others, drawn = rng.permutation(mixed).astype(int).tolist(), float(rng.beta(MIXING, MIXING))
        share = min(drawn, 1.0 - drawn)
        if mixed:
            images[mixed] = torch.lerp(images[mixed], images[others], share)
        logits = student.logits(images)
        losses = surprise(logits, right)
        if mixed:
            of_others = surprise(logits[mixed], [right[place] for place in others])
            losses[mixed] = torch.lerp(losses[mixed], of_others, share)
        loss = plain * losses[: len(part)].sum() + worst * losses[len(part) :].sum()
        if as_given := [place for place, lesson in enumerate(part) if not isinstance(lesson, RenderedLesson)]:
            with torch.no_grad():
                wanted = self._given(images[as_given])
            # only where the given model is right: the Kullback-Leibler divergence of what it says
            known = [said in right[at] for said, at in zip(wanted.argmax(dim=1).tolist(), as_given, strict=True)]
            own, target = (F.log_softmax(some[known], dim=1) for some in (logits[as_given], wanted))
            loss = loss + plain * KEEP * F.kl_div(own, target, reduction="sum", log_target=True)
        return loss


def _changed(images: Tensor, seed: int) -> Tensor:
    """Change pictures (N, H, W, 3) by chance; the same way whenever there are as many of them."""
    generator = torch.Generator().manual_seed(seed)
    return AUGMENTATION(images.permute(0, 3, 1, 2), generator).permute(0, 2, 3, 1)


class Score(NamedTuple):
    """How a model does on lessons that it was not trained on: its share of plain pictures, and of the worst ones,
    searched for against these weights."""

    clean: float
    robust: float


def score(model: Model, held_back: Sequence[Lesson]) -> Score:
    """Judge a model on lessons, which stay as they are; those that nothing makes harder count for `clean` alone."""
    own = [copy.copy(one) for one in held_back]
    for lesson in own:
        if isinstance(lesson, TextureLesson):
            lesson.texture = copy.copy(lesson.texture)
    lessons.harder(own, model, HELD_BACK_STEPS)
    return Score(right_share(model, own, "plain"), right_share(model, with_worst(own), "worst"))


def right_share(model: Model, chosen: Sequence[Lesson], which: str) -> float:
    """Return the share of lessons of which a model has the "plain" or the "worst" picture right."""
    right = 0
    with torch.no_grad():
        for begin in range(0, len(chosen), lessons.TOGETHER):
            part = chosen[begin : begin + lessons.TOGETHER]
            said = model(torch.stack([getattr(lesson, which) for lesson in part])).argmax(dim=1).tolist()
            right += sum(index in lesson.right for index, lesson in zip(said, part, strict=True))
    return right / len(chosen)


WEIGHTS = "hardened.safetensors"
ROUND = "round-{:03d}.safetensors"
ROUNDS = "rounds"
FIRST_STEPS = 4  # steps of each texture before a training
VALIDATION_VIEWS, JUDGED = 2, 168
PARTS = (1.0, 0.85, 0.7, 0.55, 0.4, 0.25)
"""Of the way from the weights that were given to the trained ones, which are judged."""

Draw = Callable[[str, str, Sequence[int], int], list[Lesson]]
"""From what to tell the progress, the name of a split, numbers of its scenes and the views of each to lessons."""


class TrainingRounds:
    """The rounds of a run; `done` is what each came to, of which the first is the model as it was."""

    def __init__(self, run: RunDirectory, course: Course, draw: Draw, progress: Progress) -> None:
        self.run, self.course, self.draw, self.progress = run, course, draw, progress
        self.done = [TrainingRound.of(noted) for noted in json.loads(run.store.note(ROUNDS) or "[]")]

    @staticmethod
    def right_share(model: Model, chosen: Sequence[Lesson]) -> float:
        """Return the share of plain pictures that a model has right."""
        return right_share(model, chosen, "plain")

    @property
    def judged(self) -> int:
        """Scenes by which weights are chosen, for each control: a third as many as a round adds, up to `JUDGED`."""
        return min(-(-self.course.config.scenes // 3), JUDGED)

    @property
    def best(self) -> int:
        """The round whose weights are kept: the most robust one whose clean accuracy is within what may be lost."""
        allowed = [number for number, done in enumerate(self.done) if self._allowed(done.clean)]
        return max(allowed, key=lambda number: (self.done[number].robust, number))

    def _allowed(self, clean: float) -> bool:
        return clean >= self.done[0].clean - self.course.config.clean_loss - 1e-9

    def carry_out(self) -> None:
        """Do what is left of the rounds; the student has the best weights afterwards, which the run keeps."""
        student, config, folder = self.course.student, self.course.config, self.run.path / ARTIFACTS
        if len(self.done) <= config.rounds:
            pool, begun, title = list[Lesson](), 0, "drawing scenes to choose weights by"
            held_back = self.draw(title, VALIDATION, range(self.judged), VALIDATION_VIEWS)
            if not self.done:
                self.keep(0, [], score(student.model, held_back), 0, 0.0)
            for number in range(1, config.rounds + 1):
                places = range((number - 1) * config.scenes, number * config.scenes)
                new = self.draw(f"round {number}: drawing scenes", TRAINING, places, config.views)
                pool += new
                if number < len(self.done):
                    continue  # done before this run was stopped
                student.net.load_state_dict(self._weights(number - 1))
                self.progress.stage(f"round {number}: training", self.course.steps(pool))
                with threads.all_for_torch():
                    # others are as hard as their training left them
                    lessons.harder(pool[begun:], student.model, FIRST_STEPS)
                    self.course.round(number, pool, lambda: self.progress.advance(1))
                    judged, part = self.mixed(held_back)
                begun = len(pool)
                self.keep(number, new, judged, len(pool), part)
        student.net.load_state_dict(self._weights(self.best))
        self._save(WEIGHTS)
        lessons.write_archive(folder / lessons.FOLDER, folder / lessons.ARCHIVE)

    def mixed(self, held_back: Sequence[Lesson]) -> tuple[Score, float]:
        """Leave the student with the best part of the way from the weights that were given; return its score and it.

        The best one is right most often on the worst pictures among those that lose no more on plain ones than they
        may; where all lose more, it is the one that loses least. Less of the way learned less: once that shows, the
        smaller parts are not looked at, as each costs a search of its own.
        """
        student, given, found = self.course.student, self._weights(0), dict[float, Score]()
        learned = {name: weight.clone() for name, weight in student.net.state_dict().items()}

        def take(part: float) -> None:
            mixed = {name: torch.lerp(given[name], weight, part) for name, weight in learned.items()
                     if weight.is_floating_point()}  # fmt: skip
            student.net.load_state_dict({**learned, **mixed})

        for part in PARTS:
            take(part)
            found[part] = score(student.model, held_back)
            allowed = {part: each.robust for part, each in found.items() if self._allowed(each.clean)}
            if allowed and [*allowed.values()][-1] < max(allowed.values()):
                break
        best = max(allowed, key=lambda part: allowed[part], default=max(found, key=lambda part: found[part].clean))
        take(best)
        return found[best], best

    def keep(self, number: int, new: Sequence[Lesson], judged: Score, trained: int, part: float) -> None:
        """Keep the weights of a round, with its new pictures and what it came to."""
        self._save(ROUND.format(number))
        labels = self.course.student.model.labels
        lessons.save_pictures(self.run.path / ARTIFACTS / lessons.FOLDER, number, new, labels)
        self.done.append(TrainingRound(lessons=trained, part=part, **judged._asdict(), kept=False))
        self.run.store.set_note(ROUNDS, json.dumps([done.model_dump() for done in self.done]))
        clean, worst = percent(judged.clean), percent(judged.robust)
        self.progress.message(f"round {number}: {clean} of plain pictures right, {worst} of the worst")

    def _save(self, name: str) -> None:
        state = {key: weight.contiguous() for key, weight in self.course.student.net.state_dict().items()}
        write_bytes(self.run.path / ARTIFACTS / name, safetensors.save(state))

    def _weights(self, number: int) -> dict[str, Tensor]:
        return safetensors.load((self.run.path / ARTIFACTS / ROUND.format(number)).read_bytes())
