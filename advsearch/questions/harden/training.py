"""Train a classifier on plain and worst images.

A part of the loss keeps its predictions of plain images near those of the original
model.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

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
    negative_log_likelihood,
    select_hard_lessons,
)
from advsearch.questions.harden.networks import (
    Augmentation,
    Trainable,
    open_single_threaded_pool,
)
from advsearch.questions.harden.result import PLAIN_SCENES, RENDERED_SCENES
from advsearch.questions.harden.rounds import (
    ComputeGradient,
    MakeOptimizer,
    Score,
    Trainer,
)
from advsearch.questions.harden.scenes import FURTHER, TRAINING, Job, SceneJobs

LESSONS_PER_PART = 6
"""Number of lessons of a batch that one thread computes."""
N_FIRST_STEPS = 4
"""Steps of the search for each new texture before a round trains."""
N_VALIDATION_STEPS = 8
"""Steps of the search for textures of the validation; it begins anew for all weights."""
AUGMENTATION = Augmentation(
    smallest_crop=0.75,
    largest_crop=1.15,
    max_rotation_degrees=15.0,
    cutout_probability=0.0,
)
"""Augmentation of training images. The search for worse images has the same."""
ORIGINAL_MODEL_WEIGHT = 1.0
"""Weight of the divergence from the original model's predictions in the loss."""
MIXUP_PROBABILITY = 0.5
"""Probability that a part of a batch mixes its images."""
MIXUP_BETA = 0.4
"""Both parameters of the beta distribution of the mixing weights."""
SHARED_TEXTURE_PROBABILITY = 0.25
"""Probability that all views of a scene share one texture."""
RANDOM_CONTROLS_PROBABILITY = 0.5
"""Probability that rendered controls vary, too, in a scene with a texture."""

Examples = Iterable[tuple[Tensor, Tensor]]
"""Batches of images (N, H, W, 3) sRGB in [0, 1] and class indices (N,), such as those
of a `DataLoader`.
"""


class ClassifierTrainer(Trainer):
    """Train a classifier on lessons.

    Its predictions of plain images stay near those of the original model.

    Attributes:
        n_views: number of views of a training scene, and of a validation scene, for
            controls with a matrix of light transport.
        user_examples: batches of the user's own images and class indices; None without
            any.
    """

    batch_size = 24
    weight_decay = 0.02
    warm_up_fraction = 0.1
    average_decay = 0.98

    def __init__(
        self,
        work: SceneJobs,
        student: Trainable,
        optimiser: MakeOptimizer | None = None,
        beside: Examples | None = None,
    ) -> None:
        """Set up the trainer.

        Args:
            work: samples lessons from scenes.
            student: the copy of the network that is trained.
            optimiser: function from a list of parameters to an optimizer; None for
                AdamW.
            beside: batches of the user's own images and class indices. Each step also
                trains with one of them. When they end, they are repeated.
        """
        super().__init__(work, student, optimiser)
        # The validation only compares weights, for which two views suffice.
        n_validation_views = 2
        self.n_views = (self.config.views, n_validation_views)
        self.user_examples = beside
        self._example_batches: Iterator[tuple[Tensor, Tensor]] = iter(())

    @property
    def n_further_scenes(self) -> int:
        return RENDERED_SCENES if self.scene_jobs.rendered_controls else PLAIN_SCENES

    def sample_items(
        self, title: str, split: str, scene_numbers: range
    ) -> list[Lesson]:
        """Make lessons of scenes.

        Some controls, such as textures, have a matrix of light transport: a scene has
        lessons for each of them. All other controls together have lessons with rendered
        images. The training split also has lessons of further scenes, as a new scene
        teaches more than one more view of the same scene.

        Args:
            title: title of the stage that the progress reports.
            split: split that the scenes belong to.
            scene_numbers: numbers of the scenes.
        """
        jobs = self._matrix_jobs(split, scene_numbers)
        jobs += self._rendered_jobs(split, scene_numbers)
        if split == TRAINING:
            jobs += self._further_jobs(scene_numbers)
        # Jobs end in any order; the lessons are returned in the order of the jobs.
        lessons_of_job = dict(self.scene_jobs.run_jobs(title, jobs))
        sampled_lessons: list[Lesson] = []
        for index in range(len(jobs)):
            sampled_lessons += lessons_of_job[index]
        return sampled_lessons

    def _matrix_jobs(self, split: str, scene_numbers: range) -> list[Job]:
        """Return the jobs that make lessons with a matrix of light transport.

        There is a job for each scene and each control that has such a matrix. In scenes
        of the training split, views may share a texture, and other controls may vary.

        Args:
            split: name of the split.
            scene_numbers: numbers of its scenes.
        """
        controls_and_numbers = itertools.product(
            self.scene_jobs.matrix_controls, scene_numbers
        )
        return [
            self._make_matrix_job(split, control, number)
            for control, number in controls_and_numbers
        ]

    def _make_matrix_job(self, split: str, control: str, number: int) -> Job:
        """Return the job that makes the lessons of a scene for one control.

        Args:
            split: name of the split.
            control: control whose images a matrix of light transport predicts.
            number: number of the scene.
        """
        training_views, validation_views = self.n_views
        n_views = validation_views
        shares_texture = False
        varies_others = False
        if split == TRAINING:
            n_views = training_views
            shares_texture, varies_others = self.sample_scene_options(control, number)
        return _make_job(
            split,
            number,
            (control,),
            views=n_views,
            # one view without a worst image, to keep the clean accuracy
            plain=1,
            shared=shares_texture,
            varying_controls=self.scene_jobs.random_controls if varies_others else (),
        )

    def _rendered_jobs(self, split: str, scene_numbers: range) -> list[Job]:
        """Return the jobs that make lessons by rendering, one for each scene.

        In a view with worst images, all controls without a matrix of light transport
        change together. A training scene has one such view, and one plain view, on which
        the student should predict as the original model does. A validation scene has
        only views with worst images.
        """
        controls = self.scene_jobs.rendered_controls
        if not controls:
            return []
        n_views = 1
        n_plain = 1
        if split != TRAINING:
            _, n_views = self.n_views
            n_plain = 0
        return [
            _make_job(split, number, controls, views=n_views, plain=n_plain)
            for number in scene_numbers
        ]

    def _further_jobs(self, scene_numbers: range) -> list[Job]:
        """Return the jobs of the further scenes of the training, with one view each.

        If there are controls without a matrix of light transport, they change in that
        view; otherwise it is a plain view.

        Args:
            scene_numbers: numbers of the scenes of the round, which follow each other.
        """
        # Each scene of the round has `n_further_scenes` scenes in the split `FURTHER`,
        # which are numbered from 0 over all rounds.
        first = self.n_further_scenes * scene_numbers[0]
        end = self.n_further_scenes * (scene_numbers[-1] + 1)
        if self.scene_jobs.rendered_controls:
            controls = self.scene_jobs.rendered_controls
            n_views = 1
            n_plain = 0
        else:
            # A job needs a control. A plain view does not change it, so it may be any.
            controls = self.scene_jobs.matrix_controls[:1]
            n_views = 0
            n_plain = 1
        return [
            _make_job(FURTHER, number, controls, views=n_views, plain=n_plain)
            for number in range(first, end)
        ]

    def sample_scene_options(self, control: str, number: int) -> tuple[bool, bool]:
        """Decide at random how a training scene differs from the usual.

        At random, and not in every fourth scene, for example: objects take turns, so
        these scenes would always have the same objects.

        Args:
            control: control whose images a matrix of light transport predicts.
            number: number of the scene.

        Returns:
            Whether the views share a texture, and whether other controls vary.
        """
        seed = seeds.derive_seed(self.config.seed, f"views of {control}", number)
        shared_sample, varied_sample = np.random.default_rng(seed).random(2)
        shares_texture = bool(shared_sample < SHARED_TEXTURE_PROBABILITY)
        varies_others = bool(varied_sample < RANDOM_CONTROLS_PROBABILITY)
        return shares_texture, varies_others

    def uses_per_epoch(self, item: Lesson) -> int:
        """Return how often an epoch uses a lesson, more often with a texture."""
        if isinstance(item, TextureLesson):
            return self.config.texture_uses_per_epoch
        return 1

    @contextmanager
    def open_gradient_context(self, new: Sequence[Lesson]) -> Iterator[ComputeGradient]:
        """Search for worse images of the new lessons, then open threads for gradients.

        Args:
            new: lessons that no earlier round has used.
        """
        # Worse images are searched for the student, and not for the original model.
        lessons.search_worse_images(new, self.student.model, N_FIRST_STEPS)
        with open_single_threaded_pool() as pool:
            gradients = GradientComputer(
                self.student, original_model=self.scene_jobs.model, pool=pool
            )
            yield partial(self._compute_batch_gradient, gradients)

    def _compute_batch_gradient(
        self,
        gradients: GradientComputer,
        batch: Sequence[Lesson],
        rng: np.random.Generator,
    ) -> None:
        """Compute the gradient of a batch of lessons, and store it in `grad`.

        The user's next batch of examples is added, if there are any.
        """
        examples = self.next_examples()
        seed = int(rng.integers(2**62))  # fits an int64
        gradients.compute(batch, examples, seed)

    def next_examples(self) -> tuple[Tensor, Tensor] | None:
        """Return the next batch of the user's examples; None if there are none.

        They begin again when they end.
        """
        if self.user_examples is None:
            return None
        batch = next(self._example_batches, None)
        if batch is None:
            self._example_batches = iter(self.user_examples)
            batch = next(self._example_batches)
        return batch

    def evaluate_student(self, validation_items: Sequence[Lesson]) -> Score:
        """Evaluate the student on held-back lessons, which are not changed.

        Textures are searched against the student. Plain lessons count only for the
        clean accuracy.
        """
        # A search sets attributes of lessons, and changes their textures in place. Both
        # are copied.
        searched = [copy.copy(lesson) for lesson in validation_items]
        for lesson in searched:
            if isinstance(lesson, TextureLesson):
                lesson.texture = lesson.texture.clone()
        model = self.student.model
        lessons.search_worse_images(searched, model, N_VALIDATION_STEPS)
        hard_lessons = select_hard_lessons(searched)
        clean = _accuracy(model, searched, lambda lesson: lesson.plain_image)
        robust = _accuracy(model, hard_lessons, lambda lesson: lesson.worst_image)
        return Score(clean, robust)

    def save_images(
        self, run: RunDirectory, number: int, new: Sequence[Lesson]
    ) -> None:
        lessons.save_lesson_images(run, number, new, self.student.model.labels)


def _make_job(
    split: str,
    number: int,
    controls: Sequence[str],
    views: int,
    plain: int,
    **options: Any,
) -> Job:
    """Return the job that makes lessons of a scene.

    A job is an unbound method: the worker that runs it passes its own `SceneJobs`.

    Args:
        split: name of the split of scenes.
        number: number of the scene.
        controls: controls that make the views harder together.
        views: number of views with worst images.
        plain: number of further views of the plain scene.
        **options: further arguments of `SceneJobs.sample_lessons`.
    """
    return partial(
        SceneJobs.sample_lessons,
        split=split,
        number=number,
        controls=controls,
        views=views,
        plain=plain,
        **options,
    )


def _accuracy(
    model: Model, selected: Sequence[Lesson], get_image: Callable[[Lesson], Tensor]
) -> float:
    """Return the fraction of lessons whose images a model gets right.

    Args:
        model: model that returns logits.
        selected: lessons, at least one.
        get_image: returns the image (H, W, 3) of a lesson.
    """
    n_right = 0
    with torch.no_grad():
        for start in range(0, len(selected), lessons.BATCH_SIZE):
            batch = selected[start : start + lessons.BATCH_SIZE]
            logits = model(torch.stack([get_image(lesson) for lesson in batch]))
            predicted = logits.argmax(dim=1).tolist()
            right_classes = [lesson.right_classes for lesson in batch]
            n_right += sum(_compare_classes(predicted, right_classes))
    return n_right / len(selected)


def _compare_classes(
    predicted: Sequence[int], right_classes: Sequence[tuple[int, ...]]
) -> list[bool]:
    """Return whether each predicted class is one of the right ones of its image."""
    return [
        index in classes
        for index, classes in zip(predicted, right_classes, strict=True)
    ]


class GradientComputer:
    """Compute gradients of a network on several threads.

    A batch is divided into parts. Each part has a copy of the network, which shares its
    weights.
    """

    def __init__(
        self, student: Trainable, original_model: Model, pool: Executor
    ) -> None:
        """Set up without copies of the network; they are made when parts need them.

        Args:
            student: the network, whose parameters collect the gradients.
            original_model: the model before it was trained.
            pool: threads, in each of which torch uses a single thread.
        """
        self._student = student
        self._original_model = original_model
        self._pool = pool
        # copies of the student that share its weights, one for each part of a batch
        self._twins: list[Trainable] = []

    def compute(
        self,
        batch: Sequence[Lesson],
        further_batch: tuple[Tensor, Tensor] | None,
        seed: int,
    ) -> None:
        """Make the worst images of lessons worse, and compute the gradient of the loss.

        The gradient is stored in `grad` of each parameter. A further batch adds its
        mean loss. Parts of the batch are computed at the same time on threads.

        Args:
            batch: the lessons.
            further_batch: the user's own images (N, H, W, 3) and class indices (N,), or
                None.
            seed: seed of the augmentation.
        """
        batch = _put_textures_first(batch)
        self._ascend_textures(batch, seed)
        gradients = self._map_parts(self._make_part_gradient(batch), batch, seed)
        if further_batch is not None:
            gradients.append(self._compute_further_gradient(*further_batch))
        for parameter, *part_gradients in zip(
            self._student.parameters(), *gradients, strict=True
        ):
            parameter.grad = _sum_gradients(part_gradients)

    def _make_part_gradient(
        self, batch: Sequence[Lesson]
    ) -> Callable[..., Sequence[Tensor | None]]:
        """Return the function that computes the gradient of the loss of a part.

        The loss is a mean over plain images plus a mean over worst images. A part has
        a sum of losses, weighted by the counts of the full batch. So the sum of the
        parts' gradients is the gradient of the means.

        Args:
            batch: the full batch.
        """
        plain_weight = 1.0 / len(batch)
        worst_weight = 1.0 / max(1, len(select_hard_lessons(batch)))
        return partial(
            self._compute_part_gradient,
            plain_weight=plain_weight,
            worst_weight=worst_weight,
        )

    def _compute_part_gradient(
        self,
        part: Sequence[Lesson],
        twin: Trainable,
        part_seed: int,
        *,
        plain_weight: float,
        worst_weight: float,
    ) -> Sequence[Tensor | None]:
        """Return the gradient of the loss of a part by each parameter.

        Args:
            part: the lessons, textures first.
            twin: the part's copy of the network.
            part_seed: seed of the augmentation.
            plain_weight: weight of each plain image.
            worst_weight: weight of each worst image.
        """
        loss = self._loss(twin, part, plain_weight, worst_weight, part_seed)
        return torch.autograd.grad(loss, twin.parameters(), allow_unused=True)

    def _ascend_textures(self, batch: Sequence[Lesson], seed: int) -> None:
        """Take a step of the search for worse textures, on augmented images.

        The textures are changed in place. Gradients are computed in parts on threads,
        each with its own copy of the network (`twin`).
        """
        lessons.ascend_textures(
            batch, partial(self._compute_texture_gradients, seed=seed)
        )

    def _compute_texture_gradients(
        self, texture_lessons: Sequence[TextureLesson], seed: int
    ) -> list[Tensor]:
        """Return the gradients of all lessons, part by part on the threads."""
        parts = self._map_parts(_compute_gradients_of_part, texture_lessons, seed)
        return list(itertools.chain.from_iterable(parts))

    def _compute_further_gradient(
        self, images: Tensor, labels: Tensor
    ) -> Sequence[Tensor | None]:
        """Return the gradient of the mean loss of further images by each parameter.

        Args:
            images: (N, H, W, 3).
            labels: class indices (N,).
        """
        right_classes = [(int(label),) for label in labels]
        logits = self._student.logits(images)
        loss = negative_log_likelihood(logits, right_classes).mean()
        return torch.autograd.grad(loss, self._student.parameters(), allow_unused=True)

    def _map_parts(
        self,
        function: Callable[..., Sequence[Any]],
        selected: Sequence[Lesson],
        seed: int,
    ) -> list[Sequence[Any]]:
        """Apply a function to parts of lessons on threads; return its results in order.

        Args:
            function: is called with the part, a copy of the network for this part
                alone, and a seed that depends on the index of the part.
            selected: the lessons.
            seed: seed of the first part; each next part has the next number.
        """
        parts = [
            selected[start : start + LESSONS_PER_PART]
            for start in range(0, len(selected), LESSONS_PER_PART)
        ]
        # Threads cannot share a network whose gradients are computed, so each part has
        # a copy.
        while len(self._twins) < len(parts):
            self._twins.append(self._student.copy_for_thread())
        twins = self._twins[: len(parts)]
        part_seeds = range(seed, seed + len(parts))
        return list(self._pool.map(function, parts, twins, part_seeds))

    def _loss(
        self,
        student: Trainable,
        part: Sequence[Lesson],
        plain_weight: float,
        worst_weight: float,
        seed: int,
    ) -> Tensor:
        """Return the loss of a part of a batch.

        Args:
            student: the network that is trained.
            part: the lessons, textures first.
            plain_weight: weight of each plain image.
            worst_weight: weight of each worst image.
            seed: seed of the augmentation and the mixing.
        """
        # the lesson of each image: first the plain images, then the worst ones
        lesson_of_image: list[Lesson] = [*part, *select_hard_lessons(part)]
        right_classes = [lesson.right_classes for lesson in lesson_of_image]
        images = _augment_images(part, seed)
        mixing = _mix_images(images, lesson_of_image, seed)
        logits = student.logits(images)
        losses = _compute_mixed_losses(logits, right_classes, mixing)
        plain_loss = losses[: len(part)].sum()
        worst_loss = losses[len(part) :].sum()
        loss = plain_weight * plain_loss + worst_weight * worst_loss
        unrendered = _find_unrendered(part)
        if not unrendered:
            return loss
        # The student should predict these images as the original model does.
        divergence = self._divergence_from_original(
            images[unrendered],
            logits[unrendered],
            right=[right_classes[index] for index in unrendered],
        )
        return loss + plain_weight * ORIGINAL_MODEL_WEIGHT * divergence

    def _divergence_from_original(
        self, images: Tensor, logits: Tensor, right: Sequence[tuple[int, ...]]
    ) -> Tensor:
        """Return the Kullback-Leibler divergence KL(original || student) of predictions.

        It is summed over the images that the original model gets right.

        Args:
            images: images (N, H, W, 3).
            logits: the student's logits for them (N, classes).
            right: right classes of each image.
        """
        with torch.no_grad():
            original_logits = self._original_model(images)
        predicted = original_logits.argmax(dim=1).tolist()
        is_right = _compare_classes(predicted, right)
        return F.kl_div(
            F.log_softmax(logits[is_right], dim=1),
            F.log_softmax(original_logits[is_right], dim=1),
            reduction="sum",
            log_target=True,
        )


def _sum_gradients(part_gradients: Sequence[Tensor | None]) -> Tensor | None:
    """Return the sum of the gradients of a parameter; None if no part has one.

    A part whose loss does not depend on the parameter has None.
    """
    used = [gradient for gradient in part_gradients if gradient is not None]
    return torch.stack(used).sum(dim=0) if used else None


def _put_textures_first(batch: Sequence[Lesson]) -> list[Lesson]:
    """Return a batch with the lessons that have textures first.

    So the parts of the search, which has textures only, and those of the loss have the
    same textures, and augment them equally.
    """
    textures = [lesson for lesson in batch if isinstance(lesson, TextureLesson)]
    others = [lesson for lesson in batch if not isinstance(lesson, TextureLesson)]
    return [*textures, *others]


def _compute_gradients_of_part(
    part: Sequence[TextureLesson], twin: Trainable, part_seed: int
) -> Sequence[Tensor]:
    """Return the gradient (d,) of the loss by the texture of each lesson of a part.

    Args:
        part: the lessons.
        twin: the part's copy of the network.
        part_seed: seed of the augmentation.
    """
    return lessons.compute_texture_gradients(
        part, twin.evaluation_logits, lambda images: _augment(images, part_seed)
    )


class _Mixing(NamedTuple):
    """How rendered images of a part were mixed with each other (mixup).

    Attributes:
        mixed: indices of the images that are mixed; none unless the part is mixed
            (`MIXUP_PROBABILITY`).
        partners: index of the partner of each.
        partner_weight: the weight of the partner, at most 1/2.
    """

    mixed: list[int]
    partners: list[int]
    partner_weight: float


def _mix_images(
    images: Tensor, lesson_of_image: Sequence[Lesson], seed: int
) -> _Mixing:
    """Mix rendered images with each other in place, at random (mixup).

    Zhang et al. 2018, arXiv 1710.09412. Rendered images stay the same in all epochs, so
    that the network could memorize them. Textures need no mixing, as they change in
    each step.

    Args:
        images: (N, H, W, 3), which are changed.
        lesson_of_image: the lesson that each image belongs to (N,).
        seed: seed of the choice whether they are mixed, of the partners and of the
            weight.
    """
    rng = np.random.default_rng(seed)
    mixed = list[int]()
    if rng.random() < MIXUP_PROBABILITY:
        mixed = _find_rendered(lesson_of_image)
    partners = rng.permutation(mixed).astype(int).tolist()
    sampled_weight = float(rng.beta(MIXUP_BETA, MIXUP_BETA))
    # At most 1/2, so that the image itself always has the larger weight.
    partner_weight = min(sampled_weight, 1.0 - sampled_weight)
    if mixed:
        # Both operands are copies, so that every partner is an image before the mixing.
        images[mixed] = torch.lerp(images[mixed], images[partners], partner_weight)
    return _Mixing(mixed, partners, partner_weight)


def _compute_mixed_losses(
    logits: Tensor, right_classes: Sequence[tuple[int, ...]], mixing: _Mixing
) -> Tensor:
    """Return the negative log-likelihood (N,) of images, some of which are mixed.

    A mixed image has the classes of both images, weighted as its pixels are.

    Args:
        logits: the student's logits (N, classes).
        right_classes: indices of the right classes of each image before the mixing.
        mixing: how the images were mixed.
    """
    losses = negative_log_likelihood(logits, right_classes)
    mixed = mixing.mixed
    if mixed:
        partner_losses = negative_log_likelihood(
            logits[mixed], [right_classes[index] for index in mixing.partners]
        )
        losses[mixed] = torch.lerp(losses[mixed], partner_losses, mixing.partner_weight)
    return losses


def _find_rendered(lesson_of_image: Sequence[Lesson]) -> list[int]:
    """Return the indices of the images whose lesson is a `RenderedLesson`."""
    return [
        index
        for index, lesson in enumerate(lesson_of_image)
        if isinstance(lesson, RenderedLesson)
    ]


def _find_unrendered(part: Sequence[Lesson]) -> list[int]:
    """Return the indices of the lessons that are no `RenderedLesson`.

    On their plain images, the student stays near the original model's predictions. In a
    `RenderedLesson` a control has changed even in the plain image, and the original
    model, even if it is right, may be unsure about it. (These images are also the mixed
    ones.) The index of a lesson is that of its plain image, as plain images come first.
    """
    return [
        index
        for index, lesson in enumerate(part)
        if not isinstance(lesson, RenderedLesson)
    ]


def _augment_images(part: Sequence[Lesson], seed: int) -> Tensor:
    """Return the plain images of lessons, then the worst ones, augmented (N, H, W, 3).

    Plain images, worst textures and worst renders are augmented as separate groups with
    the same seed. So the group of textures is augmented as in the search that found
    them. Under another augmentation they might no longer be the worst.

    Args:
        part: the lessons, textures first.
        seed: seed of the augmentation.
    """
    plain_images = [lesson.plain_image for lesson in part]
    worst_textures = [
        lesson.worst_image for lesson in part if isinstance(lesson, TextureLesson)
    ]
    worst_renders = [
        lesson.worst_image for lesson in part if isinstance(lesson, RenderedLesson)
    ]
    return torch.cat(
        [
            _augment(torch.stack(group), seed)
            for group in (plain_images, worst_textures, worst_renders)
            if group
        ]
    )


def _augment(images: Tensor, seed: int) -> Tensor:
    """Augment images (N, H, W, 3), equally for equal N and seed."""
    generator = torch.Generator().manual_seed(seed)
    return AUGMENTATION(images.permute(0, 3, 1, 2), generator).permute(0, 2, 3, 1)
