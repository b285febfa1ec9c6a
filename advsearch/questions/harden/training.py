"""How a classifier is hardened: it learns lessons, plain pictures and worst ones, and
what it said of plain ones.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.extend import Model, RunDirectory, seeds
from advsearch.questions.harden import lessons
from advsearch.questions.harden.lessons import (
    Lesson,
    RenderedLesson,
    TextureLesson,
    surprise,
    with_worst,
)
from advsearch.questions.harden.networks import Augmentation, Trainable, one_thread_each
from advsearch.questions.harden.result import PLAIN_SCENES, RENDERED_SCENES
from advsearch.questions.harden.rounds import Course, MakeOptimiser, Score, Take
from advsearch.questions.harden.scenes import FURTHER, TRAINING, SceneWork, Wanted

PART = 6  # lessons of a step that one thread works at
FIRST_STEPS = 4
HELD_BACK_STEPS = 8
"""Steps of each texture before a training, and of those that weights are judged on,
from where a search begins.
"""
AUGMENTATION = Augmentation(
    smallest_crop=0.75, largest_crop=1.15, turn=15.0, cutout=0.0
)
"""What happens to pictures while they are trained on; the search for worse ones sees
the same.
"""
# weight of the given model's answers to plain pictures, beside that of the right ones
KEEP = 1.0
MIXED = 0.5
MIXING = 0.4
"""Share of the parts that mix pictures, and both parameters of the beta distribution
that their weights come from.
"""
SHARED = 0.25
MOVED = 0.5
"""Shares of the scenes with a texture in which all views have the same, and in which
rendered controls vary too.
"""

Examples = Iterable[tuple[Tensor, Tensor]]
"""Batches of images (N, H, W, 3) sRGB in [0, 1] and class indices (N,), such as a
`DataLoader`'s.
"""


class ClassifierCourse(Course):
    """Keeps the answers to plain pictures of the model as it was given. Of the examples
    `beside` a batch is taken with each step, from the start again when they end.
    """

    batch = 24
    weight_decay = 0.02
    warm_up = 0.1
    average = 0.98

    def __init__(
        self, work: SceneWork, student: Trainable, optimiser: MakeOptimiser | None = None,
        beside: Examples | None = None,
    ) -> None:  # fmt: skip
        super().__init__(work, student, optimiser)
        self.views = (self.config.views, 2)
        self.beside = beside
        self._further: Iterator[tuple[Tensor, Tensor]] = iter(())

    @property
    def further(self) -> int:
        return RENDERED_SCENES if self.work.rendered else PLAIN_SCENES

    def draw(self, title: str, split: str, places: range) -> list[Lesson]:
        """Return lessons of scenes: for each control whose pictures a matrix says, and
        for all others together.

        In the training a fourth of the scenes have one texture for all views, in half
        of them the controls that are rendered vary by chance, and further scenes come
        on top: of what is rendered new scenes teach more than further views. Of what is
        rendered one in so many scenes is drawn as it is, too: there the given model's
        predictions count.
        """
        linear = self.work.linear
        rendered = self.work.rendered
        training = split == TRAINING
        views = self.views[not training]
        further = range(self.further * places[0], self.further * (places[-1] + 1))

        def drawing(
            number: int, controls: Sequence[str], views: int, plain: int, **how: Any
        ) -> Wanted:
            how = {
                "side": split,
                "number": number,
                "controls": controls,
                "views": views,
                "plain": plain,
                **how,
            }
            return partial(SceneWork.drawn, **how)

        wanted = list[Wanted]()
        for control in linear:
            for number in places:
                shared, moved = (
                    self.chance(control, number) if training else (False, False)
                )
                beside = self.work.beside if moved else ()
                wanted.append(
                    drawing(number, (control,), views, 1, shared=shared, beside=beside)
                )
        if rendered:
            wanted += [
                drawing(number, rendered, *((1, 1) if training else (views, 0)))
                for number in places
            ]
        if training:
            more = (rendered, 1, 0) if rendered else (linear[:1], 0, 1)
            wanted += [drawing(number, *more, side=FURTHER) for number in further]
        drawn = dict(self.work.each(title, wanted))
        return [lesson for place in range(len(wanted)) for lesson in drawn[place]]

    def chance(self, control: str, number: int) -> tuple[bool, bool]:
        """Return whether all views of a scene share a texture, and others vary beside
        it; not by turns, as objects.
        """
        shared, moved = np.random.default_rng(
            seeds.stream(self.config.seed, f"views of {control}", number)
        ).random(2)
        return bool(shared < SHARED), bool(moved < MOVED)

    def looks(self, item: Lesson) -> int:
        return self.config.texture_looks if isinstance(item, TextureLesson) else 1

    @contextmanager
    def gradients(self, new: Sequence[Lesson]) -> Iterator[Take]:
        lessons.harder(new, self.student.model, FIRST_STEPS)
        with one_thread_each() as pool:
            gradients = Gradients(self.student, self.work.model, pool)
            yield lambda batch, rng: gradients.take(
                batch, self._next(), int(rng.integers(2**62))
            )

    def _next(self) -> tuple[Tensor, Tensor] | None:
        if self.beside is None:
            return None
        if (batch := next(self._further, None)) is None:
            self._further = iter(self.beside)
            batch = next(self._further)
        return batch

    def score(self, held_back: Sequence[Lesson]) -> Score:
        """Judge the student, by textures that are searched against it; plain lessons
        count for `clean` alone.
        """
        own = [copy.copy(lesson) for lesson in held_back]
        model = self.student.model
        for lesson in own:
            if isinstance(lesson, TextureLesson):
                lesson.texture = lesson.texture.clone()
        lessons.harder(own, model, HELD_BACK_STEPS)

        def right(chosen: Sequence[Lesson], which: str) -> float:
            right = 0
            with torch.no_grad():
                for begin in range(0, len(chosen), lessons.TOGETHER):
                    part = chosen[begin : begin + lessons.TOGETHER]
                    said = (
                        model(torch.stack([getattr(lesson, which) for lesson in part]))
                        .argmax(dim=1)
                        .tolist()
                    )
                    right += sum(
                        index in lesson.right
                        for index, lesson in zip(said, part, strict=True)
                    )
            return right / len(chosen)

        return Score(right(own, "plain"), right(with_worst(own), "worst"))

    def save(self, run: RunDirectory, number: int, new: Sequence[Lesson]) -> None:
        lessons.save_pictures(run, number, new, self.student.model.labels)


class Gradients:
    """Takes gradients for a network that is trained, whose parameters collect them, on
    threads that have one of torch's each (side by side they wait at no barriers), each
    with a copy of the network that shares its weights.
    """

    def __init__(self, student: Trainable, given: Model, pool: Executor) -> None:
        self._student = student
        self._given = given
        self._pool = pool
        self._twins: list[Trainable] = []

    def take(
        self, batch: Sequence[Lesson], beside: tuple[Tensor, Tensor] | None, seed: int
    ) -> None:
        """Make the worst pictures of lessons worse, and leave the gradient of their
        loss with the parameters. Further images (N, H, W, 3) and class indices (N,)
        count too.
        """
        # textures first, so that both have the same parts
        batch = sorted(batch, key=lambda lesson: not isinstance(lesson, TextureLesson))

        def each(
            do: Callable[..., Sequence[Any]], chosen: Sequence[Lesson]
        ) -> list[Sequence[Any]]:
            parts = [
                chosen[begin : begin + PART] for begin in range(0, len(chosen), PART)
            ]
            self._twins += [self._student.twin() for _ in parts[len(self._twins) :]]
            return list(self._pool.map(do, parts, self._twins, itertools.count(seed)))

        def climb(
            part: Sequence[TextureLesson], twin: Trainable, seed: int
        ) -> Sequence[Tensor]:
            return lessons.slopes(
                part, twin.quickly, lambda images: _changed(images, seed)
            )

        def descend(
            part: Sequence[Lesson], twin: Trainable, seed: int
        ) -> Sequence[Tensor | None]:
            return torch.autograd.grad(
                self._loss(twin, part, *means, seed),
                twin.parameters(),
                allow_unused=True,
            )

        lessons.ascend(
            batch,
            lambda chosen: [slope for some in each(climb, chosen) for slope in some],
        )
        means = 1.0 / len(batch), 1.0 / max(1, len(with_worst(batch)))
        found = each(descend, batch)
        if beside is not None:
            loss = surprise(
                self._student.logits(beside[0]), [(int(label),) for label in beside[1]]
            ).mean()
            found.append(
                torch.autograd.grad(loss, self._student.parameters(), allow_unused=True)
            )
        for parameter, *own in zip(self._student.parameters(), *found, strict=True):
            some = [slope for slope in own if slope is not None]
            parameter.grad = torch.stack(some).sum(dim=0) if some else None

    def _loss(
        self,
        student: Trainable,
        part: Sequence[Lesson],
        plain: float,
        worst: float,
        seed: int,
    ) -> Tensor:
        """What is descended, of a part of a batch, textures first: so much of each
        plain picture and each worst one.

        Worst textures are changed as the search for them saw them: seen otherwise, they
        are no longer the worst. At times all that was rendered is mixed with each other
        (mixup, Zhang et al. 2018, arXiv 1710.09412), as no more pictures of it will
        come; a texture is another one each time. The given model's predictions count of
        scenes as they are alone: where something moved, it is right without being sure.
        """
        searched = with_worst(part)
        rng = np.random.default_rng(seed)
        mixed = list[int]()
        textured = [
            lesson.worst for lesson in searched if isinstance(lesson, TextureLesson)
        ]
        shown = [
            [lesson.plain for lesson in part],
            textured,
            [lesson.worst for lesson in searched[len(textured) :]],
        ]
        images = torch.cat(
            [_changed(torch.stack(some), seed) for some in shown if some]
        )
        taught = [*part, *searched]
        right = [lesson.right for lesson in taught]
        if rng.random() < MIXED:
            mixed = [
                place
                for place, lesson in enumerate(taught)
                if isinstance(lesson, RenderedLesson)
            ]
        others = rng.permutation(mixed).astype(int).tolist()
        drawn = float(rng.beta(MIXING, MIXING))
        share = min(drawn, 1.0 - drawn)
        if mixed:
            images[mixed] = torch.lerp(images[mixed], images[others], share)
        logits = student.logits(images)
        losses = surprise(logits, right)
        if mixed:
            of_others = surprise(logits[mixed], [right[place] for place in others])
            losses[mixed] = torch.lerp(losses[mixed], of_others, share)
        loss = plain * losses[: len(part)].sum() + worst * losses[len(part) :].sum()
        if as_given := [
            place
            for place, lesson in enumerate(part)
            if not isinstance(lesson, RenderedLesson)
        ]:
            with torch.no_grad():
                wanted = self._given(images[as_given])
            # only where the given model is right: the Kullback-Leibler divergence of
            # what it says
            known = [
                said in right[at]
                for said, at in zip(
                    wanted.argmax(dim=1).tolist(), as_given, strict=True
                )
            ]
            own, target = (
                F.log_softmax(some[known], dim=1) for some in (logits[as_given], wanted)
            )
            loss = loss + plain * KEEP * F.kl_div(
                own, target, reduction="sum", log_target=True
            )
        return loss


def _changed(images: Tensor, seed: int) -> Tensor:
    """Change pictures (N, H, W, 3) by chance; the same way whenever there are as many
    of them.
    """
    generator = torch.Generator().manual_seed(seed)
    return AUGMENTATION(images.permute(0, 3, 1, 2), generator).permute(0, 2, 3, 1)
