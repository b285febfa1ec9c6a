"""Make lessons: training examples from scenes, with plain and adversarial images.

The image of a texture or a patch is linear in it. So a lesson with a texture has a
matrix of light transport of one view, which predicts the image of any texture, and its
derivative, without rendering. Each time that the lesson is used, the search for its
adversarial texture goes on (warm starts: Zheng et al. 2020, arXiv 1912.11969). If
several views share a texture, it is searched by expectation over transformation (EOT,
Athalye et al. 2018).

All other lessons are rendered at random configurations. For training there are two
images of each, as new scenes teach more than further configurations of the same scene.
For validation there are more, of which the worst counts.
"""

from __future__ import annotations

import io
import json
import re
import tarfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.extend import (
    Model,
    Problem,
    RunDirectory,
    color,
    policies,
    seeds,
    writing,
)

IMAGE_DIRECTORY = "artifacts/pictures"
"""Directory of the training's images in the run."""
SPP = 2
"""Samples per pixel of an image; many noisy lessons teach more than few without noise.
"""
MATRIX_SPP = 4
"""Samples per pixel of a matrix of light transport."""
MAX_DEPTH = 4
"""Segments of the longest light path."""
STEP_FRACTION = 0.5
"""Step of an adversarial texture, as a fraction of its budget."""
BATCH_SIZE = 32
"""Batch size of the model's predictions."""


Renderer = Callable[..., Tensor]
"""Renders a configuration (d,) with a `seed` and `spp` to an image (H, W, 3)."""


@dataclass(eq=False)
class Lesson:
    """One scene under sampled conditions, with its plain image.

    Attributes:
        right_classes: indices of the right classes.
        plain_image_uint8: the plain image (H, W, 3) uint8, to save memory. In a lesson
            with two rendered images, a single control has changed in it.
    """

    right_classes: tuple[int, ...]
    plain_image_uint8: Tensor

    @property
    def plain_image(self) -> Tensor:
        """The image of `plain_image_uint8` (H, W, 3), sRGB in [0, 1]."""
        return self.plain_image_uint8 / 255.0

    @property
    def worst_image(self) -> Tensor:
        """The worst image so far (H, W, 3), sRGB in [0, 1]; here the plain one."""
        return self.plain_image


@dataclass(eq=False)
class TextureLesson(Lesson):
    """A lesson with an adversarial texture, whose images need no rendering.

    Attributes:
        space: maps configurations to textures.
        domain: the configurations that are allowed.
        image_predictor: predicts the image of a texture by a matrix; its scene was released.
        conditions: the sampled conditions of the view.
        texture: the adversarial configuration (d,). Other lessons may share it, and it
            is changed in place.
    """

    space: Any
    domain: policies.Domain
    image_predictor: Any
    conditions: Tensor
    texture: Tensor

    def compute_image(self, u: Tensor) -> Tensor:
        """Return the image (H, W, 3) of a texture, with a graph.

        Args:
            u: the texture as a configuration (d,), without the conditions.
        """
        inputs = self.space.inputs(u)
        # `linearized_at` has the inputs of the scene in which the image is linear.
        linear_names = self.image_predictor.linearized_at.keys()
        texture_inputs = {name: inputs[name] for name in linear_names}
        # Controls that change the finished image read the full configuration.
        configuration = torch.cat([u, self.conditions])
        image: Tensor = self.image_predictor.predict_image(
            texture_inputs, configuration
        )
        return image

    @property
    def worst_image(self) -> Tensor:
        with torch.no_grad():
            return color.round_to_8_bit(self.compute_image(self.texture))


@dataclass(eq=False)
class RenderedLesson(Lesson):
    """A lesson with images of random configurations.

    Attributes:
        images_uint8: the images (N, H, W, 3) uint8.
        losses: the loss of each image (N,) when it was last evaluated; infinite before.
    """

    images_uint8: Tensor
    losses: Tensor

    @classmethod
    def create(
        cls, right_classes: tuple[int, ...], plain: Tensor, images: Tensor
    ) -> RenderedLesson:
        """Create a lesson whose images have not been evaluated yet.

        Their losses are infinite until then, so the first image counts as the worst.

        Args:
            right_classes: indices of the right classes.
            plain: the plain image (H, W, 3) in [0, 1].
            images: the other images (N, H, W, 3) in [0, 1].
        """
        never_evaluated = torch.full((len(images),), torch.inf)
        return cls(
            right_classes,
            color.to_uint8(plain),
            color.to_uint8(images),
            never_evaluated,
        )

    @property
    def worst_image(self) -> Tensor:
        return self.images_uint8[int(self.losses.argmax())] / 255.0


def make_lessons(
    problem: Problem,
    n_views: int,
    seed: int,
    *,
    n_plain: int = 0,
    n_tries: int | None = None,
    shares_texture: bool = False,
) -> list[Lesson]:
    """Make lessons from views of one scene, each with its own sampled conditions.

    A lesson has what one training step needs of a scene: an image with its right
    classes, and further images, of which the step uses the worst.

    Args:
        problem: the scene with the controls that make it harder.
        n_views: number of views that have worst images.
        seed: root of the samples.
        n_plain: further views without worst images.
        n_tries: number of random configurations of each view that are rendered if a
            matrix of light transport cannot predict the images (see
            `sample_configurations`). None renders each view twice: with a single
            control changed, and with all of them.
        shares_texture: whether one adversarial texture is optimized for all views,
            instead of one for each view.
    """
    # With a matrix of light transport an image is a linear function of the texture, so
    # the texture can be optimized in each training step without a render.
    has_matrix = bool(n_views) and problem.is_linear
    lessons = list[Lesson]()
    with torch.no_grad(), problem.renderer.scene.limit_depth(MAX_DEPTH):
        if has_matrix:
            lessons += _make_texture_lessons(problem, n_views, seed, shares_texture)
        else:
            lessons += _make_rendered_lessons(problem, n_views, seed, n_tries)
        lessons += _make_plain_lessons(problem, n_plain, seed)
    return lessons


def _find_right_classes(problem: Problem) -> tuple[int, ...]:
    """Return the indices of the right classes of a scene."""
    return tuple(int(index) for index in problem.find_truth())


def _make_texture_lessons(
    problem: Problem, views: int, seed: int, shares_texture: bool
) -> list[TextureLesson]:
    """Make a lesson with a matrix of light transport for each view of a scene.

    Each view has sampled conditions of its own. All values of its first texture are at
    a bound, chosen at random. With `shares_texture` all lessons have the same tensor, so
    that a step of one of them changes the texture of all.

    Args:
        problem: the scene with the controls that are searched.
        views: number of views, which is the number of lessons.
        seed: root of the samples.
        shares_texture: whether all views share one texture.
    """
    # The lessons stay in memory during the full training, so they have spaces without
    # the scene, which is large.
    full_space = replace(problem.space, scene=None)
    make_lesson = partial(
        TextureLesson,
        right_classes=_find_right_classes(problem),
        space=replace(problem.searched_space, scene=None),
        domain=problem.domain,
    )
    view_seeds = [seeds.derive_seed(seed, "lesson", number) for number in range(views)]
    textures = _sample_textures(problem.domain, seed, view_seeds, shares_texture)
    return [
        make_lesson(
            texture=texture, **_make_view_fields(problem, full_space, view_seed)
        )
        for texture, view_seed in zip(textures, view_seeds, strict=True)
    ]


def _sample_textures(
    domain: policies.Domain,
    seed: int,
    view_seeds: Sequence[int],
    shares_texture: bool,
) -> list[Tensor]:
    """Sample the first texture (d,) of each view of a scene.

    Args:
        domain: the searched space with its bounds.
        seed: seed of the texture that all views share.
        view_seeds: seeds of the textures of views that share none.
        shares_texture: whether all views get one tensor.
    """
    if shares_texture:
        return [_sample_texture(domain, seed)] * len(view_seeds)
    return [_sample_texture(domain, view_seed) for view_seed in view_seeds]


def _make_view_fields(problem: Problem, full_space: Any, seed: int) -> dict[str, Any]:
    """Return the fields of a `TextureLesson` that belong to one view of the scene.

    Args:
        problem: the scene with the controls that are searched.
        full_space: the problem's space without the scene.
        seed: seed of the conditions of the view, and of the noise.
    """
    domain = problem.domain
    configuration = problem.make_full_configuration(domain.start, seed)
    linear = problem.make_linear_renderer(configuration, seed, MATRIX_SPP)
    levels = color.to_uint8(linear(configuration))
    linear.release_scene(full_space)  # keeps only the matrix and this space
    return {
        "plain_image_uint8": levels,
        "image_predictor": linear,
        # A slice would keep the full configuration in memory, a clone does not.
        "conditions": configuration[domain.dim :].clone(),
    }


def _sample_texture(domain: policies.Domain, seed: int) -> Tensor:
    """Sample a configuration (d,) with all values at bounds, from which a search begins."""
    generator = torch.Generator().manual_seed(seed)
    samples = domain.sample(generator, extreme=True)  # a single sample (1, d)
    return samples[0].clone()


def _make_rendered_lessons(
    problem: Problem, views: int, seed: int, n_tries: int | None
) -> list[RenderedLesson]:
    """Make a lesson with renders of random configurations for each view of a scene.

    With `n_tries`, the plain image is that of the clean configuration, and there are
    `n_tries` images of random ones. If it is None, one random control has changed in the
    plain image, and all controls have changed in the only other image.

    Args:
        problem: the scene with the controls that are varied.
        views: number of views, which is the number of lessons.
        seed: root of the samples.
        n_tries: number of random configurations of each view, or None.
    """
    right_classes = _find_right_classes(problem)
    render = problem.renderer.copy_with(quick=True)
    rendered_lessons = []
    for number in range(views):
        view_seed = seeds.derive_seed(seed, "lesson", number)
        plain_image, *images = _render_lesson_images(
            problem, render, view_seed, n_tries
        )
        rendered_lessons.append(
            RenderedLesson.create(right_classes, plain_image, torch.stack(images))
        )
    return rendered_lessons


def _render_lesson_images(
    problem: Problem, render: Renderer, seed: int, n_tries: int | None
) -> list[Tensor]:
    """Render the images (H, W, 3) of a lesson, the plain one first.

    Args:
        problem: the scene with the controls that are varied.
        render: renders a full configuration.
        seed: seed of the configurations, the conditions and the noise.
        n_tries: number of random configurations, or None.
    """
    domain = problem.domain
    # A full configuration has the searched coordinates, then the conditions.
    full_start = problem.make_full_configuration(domain.start, seed)
    conditions = full_start[domain.dim :].clone()
    return [
        render(torch.cat([u, conditions]), seed=seed, spp=SPP)
        for u in _sample_lesson_configurations(problem, seed, n_tries)
    ]


def _sample_lesson_configurations(
    problem: Problem, seed: int, n_tries: int | None
) -> list[Tensor]:
    """Sample the configurations (d,) of a lesson, that of the plain image first.

    Args:
        problem: problem of the scene.
        seed: seed of the samples.
        n_tries: number of random configurations after that of the clean scene. None
            for two changed configurations: one random control by itself, and all
            controls.
    """
    domain = problem.domain
    generator = torch.Generator().manual_seed(seed)
    if n_tries is not None:
        return [domain.start, *sample_configurations(domain, generator, n_tries)]
    n_controls = len(problem.searched_space.controls)
    samples = sample_configurations(domain, generator, n_controls + 1)
    # `sample_configurations` changes each control by itself, then all together.
    single_changes = samples[:n_controls]
    all_changed = samples[n_controls]
    index = torch.randint(n_controls, (), generator=generator)
    return [single_changes[index], all_changed]


def _make_plain_lessons(problem: Problem, views: int, seed: int) -> list[Lesson]:
    """Make a lesson with one plain render for each view."""
    right_classes = _find_right_classes(problem)
    render = problem.renderer.copy_with(quick=True)
    plain_lessons = []
    for number in range(views):
        view_seed = seeds.derive_seed(seed, "plain lesson", number)
        configuration = problem.make_full_configuration(problem.domain.start, view_seed)
        image = render(configuration, seed=view_seed, spp=SPP)
        plain_lessons.append(Lesson(right_classes, color.to_uint8(image)))
    return plain_lessons


def sample_configurations(
    domain: policies.Domain, generator: torch.Generator, count: int
) -> Tensor:
    """Sample configurations (count, d) at random.

    Controls take turns: in the first sample only the first control changes, in the next
    only the second, and so on. Then all change together, and the turns begin again. A
    control that does not change has its start values.

    Searches often end with values at bounds. So in about half of the configurations,
    each changed value is moved with probability 1/2 to the nearer bound of its range.
    Choices and periodic values have no bounds.

    Args:
        domain: the searched space with its bounds.
        generator: source of randomness.
        count: number of configurations.
    """
    samples = domain.sample(generator, count)  # (count, d)
    is_at_bound = _choose_values_at_bounds(domain, generator, count)
    is_unchanged = _alternate_controls(domain, count)
    is_lower_nearer = samples - domain.lower_bounds < domain.upper_bounds - samples
    nearer_bound = torch.where(
        is_lower_nearer, domain.lower_bounds, domain.upper_bounds
    )
    samples = torch.where(is_at_bound, nearer_bound, samples)
    samples = torch.where(is_unchanged, domain.start, samples)
    return torch.stack([domain.project(u) for u in samples])


def _choose_values_at_bounds(
    domain: policies.Domain, generator: torch.Generator, count: int
) -> Tensor:
    """Choose at random which values (count, d) of configurations move to a bound.

    Half of the configurations have none. Choices and periodic values have no bounds.
    """
    is_at_bound = torch.rand((count, domain.dim), generator=generator) < 0.5
    uses_bounds = torch.rand(count, 1, generator=generator) < 0.5
    is_at_bound = is_at_bound & uses_bounds
    for block, columns in domain.list_block_slices():
        if block.n_options or block.periodic:
            is_at_bound[:, columns] = False
    return is_at_bound


def _alternate_controls(domain: policies.Domain, count: int) -> Tensor:
    """Return a mask (count, d) of the values that stay as they are at the start.

    The controls take turns: each changes by itself, then all change together.
    """
    # the name of a block of coordinates is "CONTROL.PARAMETER"
    control_of_block = [
        block.name.rpartition(".")[0] for block, _ in domain.list_block_slices()
    ]
    controls = list(dict.fromkeys(control_of_block))
    turn_of_all = len(controls)
    # (count,) the index of the control that changes, or `turn_of_all`
    turn = torch.arange(count) % (len(controls) + 1)
    is_unchanged = torch.zeros(count, domain.dim, dtype=torch.bool)
    for control, (_, columns) in zip(
        control_of_block, domain.list_block_slices(), strict=True
    ):
        is_changed = (turn == controls.index(control)) | (turn == turn_of_all)
        is_unchanged[:, columns] = ~is_changed[:, None]
    return is_unchanged


def negative_log_likelihood(
    logits: Tensor, right_classes: Sequence[tuple[int, ...]]
) -> Tensor:
    """Return the negative log-likelihood (N,) of any right class.

    Args:
        logits: (N, C).
        right_classes: indices of the right classes of each row.
    """
    log_probabilities = F.log_softmax(logits, dim=1)
    return torch.stack(
        [
            -row[list(classes)].logsumexp(dim=0)
            for row, classes in zip(log_probabilities, right_classes, strict=True)
        ]
    )


def select_hard_lessons(
    candidates: Sequence[Lesson],
) -> list[TextureLesson | RenderedLesson]:
    """Return the lessons that have a worst image besides the plain one."""
    return [
        lesson
        for lesson in candidates
        if isinstance(lesson, (TextureLesson, RenderedLesson))
    ]


def search_worse_images(
    selected: Sequence[Lesson], model: Model, steps: int = 1
) -> None:
    """Search for worse images of lessons, which are changed in place.

    Textures take `steps` steps of ascent. For lessons with several rendered images, the
    loss of each image is computed again: it decides which one is the worst.

    Args:
        selected: the lessons.
        model: model that should get the images wrong.
        steps: number of steps of the search of textures.
    """
    for start in range(0, len(selected), BATCH_SIZE):
        batch = selected[start : start + BATCH_SIZE]
        ascend_textures(batch, partial(compute_texture_gradients, model=model), steps)
        _update_losses(batch, model)


def _update_losses(batch: Sequence[Lesson], model: Model) -> None:
    """Compute the losses of all images of the lessons that have several rendered ones.

    The images of all these lessons are evaluated as one batch, which is faster. Each
    lesson then gets the losses of its own images (K,), so that the worst of them can be
    selected. A lesson with a single image has nothing to select.
    """
    rendered_lessons = [
        lesson
        for lesson in batch
        if isinstance(lesson, RenderedLesson) and len(lesson.images_uint8) > 1
    ]
    if not rendered_lessons:
        return
    losses = _evaluate_rendered_images(rendered_lessons, model)
    n_images = [len(lesson.images_uint8) for lesson in rendered_lessons]
    for lesson, lesson_losses in zip(
        rendered_lessons, losses.split(n_images), strict=True
    ):
        # `clone`, as `split` returns views that keep the losses of all lessons in
        # memory.
        lesson.losses = lesson_losses.clone()


def _evaluate_rendered_images(
    rendered_lessons: Sequence[RenderedLesson], model: Model
) -> Tensor:
    """Return the losses (N,) of the images of lessons, one lesson after the other."""
    right_classes = []
    for lesson in rendered_lessons:
        right_classes += [lesson.right_classes] * len(lesson.images_uint8)
    with torch.no_grad():
        images = torch.cat([lesson.images_uint8 for lesson in rendered_lessons]) / 255.0
        return negative_log_likelihood(model(images), right_classes)


def ascend_textures(
    selected: Sequence[Lesson],
    compute_gradients: Callable[[Sequence[TextureLesson]], Sequence[Tensor]],
    steps: int = 1,
) -> None:
    """Take steps of steepest ascent with the textures of lessons, in place.

    Gradients of views that share a texture are summed, and the texture takes one step.
    Lessons without a texture do not change.

    Args:
        selected: the lessons.
        compute_gradients: returns the gradient of each lesson, as
            `compute_texture_gradients` does.
        steps: number of steps.
    """
    texture_lessons = [
        lesson for lesson in selected if isinstance(lesson, TextureLesson)
    ]
    if not texture_lessons:
        return
    # Lessons that share a texture have the same tensor: one of them stands for all.
    lesson_of_texture = {id(lesson.texture): lesson for lesson in texture_lessons}
    for _ in range(steps):
        gradients = compute_gradients(texture_lessons)
        gradient_sums = _sum_by_texture(texture_lessons, gradients)
        for texture_id, lesson in lesson_of_texture.items():
            _move_texture(lesson, gradient_sums[texture_id])


def _sum_by_texture(
    texture_lessons: Sequence[TextureLesson], gradients: Sequence[Tensor]
) -> dict[int, Tensor]:
    """Return the sum of the gradients (d,) of each texture, by the `id` of the texture.

    Args:
        texture_lessons: lessons, some of which may share a texture.
        gradients: gradient of each lesson.
    """
    gradient_sums = dict[int, Tensor]()
    for lesson, gradient in zip(texture_lessons, gradients, strict=True):
        texture_id = id(lesson.texture)
        gradient_sums[texture_id] = gradient + gradient_sums.get(texture_id, 0.0)
    return gradient_sums


def _move_texture(lesson: TextureLesson, gradient: Tensor) -> None:
    """Take a step of steepest ascent with the texture of a lesson, in place."""
    # Its length is 1 in the norm of the domain.
    direction = lesson.domain.compute_steepest_step(lesson.texture, gradient)
    moved_texture = lesson.texture + STEP_FRACTION * direction
    lesson.texture.copy_(lesson.domain.project(moved_texture))


def compute_texture_gradients(
    selected: Sequence[TextureLesson],
    model: Callable[[Tensor], Tensor],
    change: Callable[[Tensor], Tensor] = lambda images: images,
) -> Sequence[Tensor]:
    """Return the gradient (d,) of each lesson's loss with respect to its texture.

    Args:
        selected: the lessons.
        model: function that returns logits (N, C).
        change: function that is applied to the images (N, H, W, 3) before, such as an
            augmentation.
    """
    textures = [lesson.texture.clone().requires_grad_() for lesson in selected]
    images = torch.stack(
        [lesson.compute_image(u) for lesson, u in zip(selected, textures, strict=True)]
    )
    right_classes = [lesson.right_classes for lesson in selected]
    # Losses do not depend on each other's textures, so the sum has the gradient of each.
    loss = negative_log_likelihood(model(change(images)), right_classes).sum()
    return torch.autograd.grad(loss, textures)


def save_lesson_images(
    run: RunDirectory, number: int, selected: Sequence[Lesson], labels: Sequence[str]
) -> None:
    """Write the images of a round's lessons, and those of all rounds as a WebDataset.

    The images are ``CLASS/ROUND-LESSON-plain.png`` and ``...-worst.png`` in
    `IMAGE_DIRECTORY` of the run. The WebDataset is next to that directory. It has a
    ``.png`` of each image, a ``.cls`` with the index of its class, and a ``.json`` with
    that and the kind of image. Members have no time and no owner, so that equal images
    give equal files.

    Args:
        run: run directory.
        number: number of the round.
        selected: lessons of the round.
        labels: names of the model's classes.
    """
    for index, lesson in enumerate(selected):
        class_directory = _name_class_directory(lesson.right_classes[0], labels)
        (run.path / class_directory).mkdir(parents=True, exist_ok=True)
        name = f"{number:03d}-{index:05d}"
        run.save_image(f"{name}-plain", lesson.plain_image, class_directory)
        has_worst_image = bool(select_hard_lessons([lesson]))
        if has_worst_image:
            run.save_image(f"{name}-worst", lesson.worst_image, class_directory)
    _write_webdataset(run.path / IMAGE_DIRECTORY)


def _name_class_directory(class_index: int, labels: Sequence[str]) -> str:
    """Return the directory of the images of a class, relative to the run."""
    label = re.sub(r"[^a-z0-9]+", "-", labels[class_index].lower()).strip("-")
    return f"{IMAGE_DIRECTORY}/{class_index:04d}-{label}"


def _write_webdataset(directory: Path) -> None:
    """Write the images of a directory into a tar file next to it.

    `save_lesson_images` describes the directory and the tar file.
    """
    with (
        writing.replace_file(directory.with_suffix(".tar")) as temporary_path,
        tarfile.open(temporary_path, "w") as tar,
    ):
        for path in sorted(directory.glob("*/*.png")):
            for suffix, data in _make_webdataset_sample(path).items():
                member = tarfile.TarInfo(f"{path.parent.name}-{path.stem}.{suffix}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))


def _make_webdataset_sample(path: Path) -> dict[str, bytes]:
    """Return the content of the files of an image in a WebDataset, by their suffix.

    Args:
        path: the image, CLASS-LABEL/ROUND-LESSON-KIND.png.
    """
    class_digits, _, _ = path.parent.name.partition("-")
    class_index = int(class_digits)
    _, _, kind = path.stem.rpartition("-")
    metadata = json.dumps({"class": class_index, "kind": kind})
    return {
        "png": path.read_bytes(),
        "cls": str(class_index).encode(),
        "json": metadata.encode(),
    }
