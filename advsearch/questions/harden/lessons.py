"""What a model is trained on: plain renders of scenes, and the worst configurations of
them that short searches find.

Where light arrives linearly (textures, patches), a lesson holds a matrix of light
transport of one view, which says the picture of any texture and its derivative without
rendering: its adversarial texture is searched further each time that the lesson comes
up (warm starts: Zheng et al. 2020, arXiv 1912.11969). A texture that several views
share is one of expectation over transformation (EOT, Athalye et al. 2018). Everything
else is rendered at random configurations: twice to train on, as new scenes teach more
than further configurations of one, and more often to choose weights by.
"""

from __future__ import annotations

import io
import json
import re
import tarfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
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

PICTURES = "artifacts/pictures"  # what was trained on, in the run
SPP = 2
MATRIX_SPP = 4
DEPTH = 4
"""Samples a pixel of a lesson's pictures, and of a matrix of light transport; segments
of the longest path: many lessons with some noise teach more than few without.
"""
STEP = 0.5  # a step of an adversarial texture, as a share of its budget
TOGETHER = 32  # pictures that a model is asked about at once


@dataclass(eq=False)
class Lesson:
    """One scene under conditions that were drawn for it: indices of its right classes, and its picture as it is, (H, W,
    3) uint8, as there are many; of a scene that is rendered twice, that with one control moved."""

    right: tuple[int, ...]
    levels: Tensor

    @property
    def plain(self) -> Tensor:
        """(H, W, 3) the picture of `levels`, sRGB in [0, 1]."""
        return self.levels / 255.0

    @property
    def worst(self) -> Tensor:
        """(H, W, 3) the worst picture that is known."""
        return self.plain


@dataclass(eq=False)
class TextureLesson(Lesson):
    """A lesson whose pictures `linear` says, the scene being let go of: the space and
    the domain of its texture, the numbers of the conditions that it was made for, and
    the adversarial texture (d,), which other views may share and which changes in
    place.
    """

    space: Any
    domain: policies.Domain
    linear: Any
    numbers: Tensor
    texture: Tensor

    def picture(self, u: Tensor) -> Tensor:
        """Return the picture (H, W, 3) of a texture, with a graph."""
        inputs = self.space.inputs(u)
        moved = {name: inputs[name] for name in self.linear.there}
        image: Tensor = self.linear.shown(moved, torch.cat([u, self.numbers]))
        return image

    @property
    def worst(self) -> Tensor:
        with torch.no_grad():
            return color.to_8_bit(self.picture(self.texture))


@dataclass(eq=False)
class RenderedLesson(Lesson):
    """A lesson whose pictures (N, H, W, 3) uint8 were rendered at random
    configurations, with the loss (N,) of each when a model last looked at it; infinite
    of those that none has.
    """

    pictures: Tensor
    losses: Tensor

    @classmethod
    def of(
        cls, right: tuple[int, ...], plain: Tensor, pictures: Tensor
    ) -> RenderedLesson:
        """Return a lesson of a picture (H, W, 3) and some (N, H, W, 3) in [0, 1], the
        first the worst so far.
        """
        return cls(
            right,
            color.levels_of(plain),
            color.levels_of(pictures),
            torch.full((len(pictures),), torch.inf),
        )

    @property
    def worst(self) -> Tensor:
        return self.pictures[int(self.losses.argmax())] / 255.0


def lessons(
    problem: Problem,
    views: int,
    seed: int,
    *,
    plain: int = 0,
    tries: int | None = None,
    shared: bool = False,
) -> list[Lesson]:
    """Draw lessons from so many views of one scene, each with conditions of its own,
    drawn by chance, and from `plain` views of it as it is, which nothing makes harder.
    Where no matrix says the pictures, `tries` configurations are rendered beside each
    view as it is (see `tried`); None for two renders of a view: one of the controls
    moved, and all of them. Views that are `shared` have one adversarial texture.
    """
    domain = problem.domain
    start = problem.domain.start
    linear = views and problem.is_linear
    quickly = problem.renderer.like(quick=True)
    drawn = list[Lesson]()
    right = tuple(int(index) for index in problem.truth())
    space, whole_space = (
        replace(space, scene=None) for space in (problem.searched_space, problem.space)
    )

    def begun(seed: int) -> Tensor:
        return domain.sample(torch.Generator().manual_seed(seed), extreme=True)[
            0
        ].clone()

    common = begun(seed)
    with torch.no_grad(), problem.renderer.scene.shorter(DEPTH):
        for number in range(views):
            view = seeds.stream(seed, "lesson", number)
            whole = problem.whole(start, view)
            numbers = whole[domain.dim :].clone()  # and not all that it is a part of
            if linear:
                made = problem.linearised(whole, view, MATRIX_SPP)
                levels = color.levels_of(made(whole))
                texture = common if shared else begun(view)
                made.let_go(whole_space)
                drawn.append(
                    TextureLesson(right, levels, space, domain, made, numbers, texture)
                )
                continue
            generator = torch.Generator().manual_seed(view)
            if tries is None:
                *alone, together = tried(
                    domain, generator, 1 + len(problem.searched_space.controls)
                )
                wanted = [
                    alone[torch.randint(len(alone), (), generator=generator)],
                    together,
                ]
            else:
                wanted = [start, *tried(domain, generator, tries)]
            first, *pictures = (
                quickly(torch.cat([u, numbers]), seed=view, spp=SPP) for u in wanted
            )
            drawn.append(RenderedLesson.of(right, first, torch.stack(pictures)))
        for number in range(plain):
            view = seeds.stream(seed, "plain lesson", number)
            drawn.append(
                Lesson(
                    right,
                    color.levels_of(
                        quickly(problem.whole(start, view), seed=view, spp=SPP)
                    ),
                )
            )
    return drawn


def tried(domain: policies.Domain, generator: torch.Generator, count: int) -> Tensor:
    """Draw configurations (count, d) at random. In half of them each number is moved to
    the nearer end of its range by chance, as searches end where several numbers are.
    Choices, and numbers that are periodic, have no ends. Of several controls each moves
    alone in turn, then all of them at once.
    """
    drawn = domain.sample(generator, count)
    at_ends = (torch.rand(drawn.shape, generator=generator) < 0.5) & (
        torch.rand(count, 1, generator=generator) < 0.5
    )
    owners = [block.name.rpartition(".")[0] for block, _ in domain.parts()]
    controls = list(dict.fromkeys(owners))
    turn = torch.arange(count) % (len(controls) + 1)
    for owner, (block, part) in zip(owners, domain.parts(), strict=True):
        if block.options or block.periodic:
            at_ends[:, part] = False
        still = (turn != controls.index(owner)) & (turn != len(controls))
        drawn[still, part] = domain.start[part]
        at_ends[still, part] = False
    ends = torch.where(
        drawn - domain.lower < domain.upper - drawn, domain.lower, domain.upper
    )
    return torch.stack(
        [domain.project(row) for row in torch.where(at_ends, ends, drawn)]
    )


def surprise(logits: Tensor, right: Sequence[tuple[int, ...]]) -> Tensor:
    """Return (N,): the negative logarithm of the probability that logits (N, C) give to
    the right classes of each.
    """
    known = F.log_softmax(logits, dim=1)
    return torch.stack(
        [-row[list(of)].logsumexp(dim=0) for row, of in zip(known, right, strict=True)]
    )


def with_worst(some: Sequence[Lesson]) -> list[TextureLesson | RenderedLesson]:
    """Those lessons that something makes harder."""
    return [
        lesson for lesson in some if isinstance(lesson, (TextureLesson, RenderedLesson))
    ]


def harder(chosen: Sequence[Lesson], model: Model, steps: int = 1) -> None:
    """Make lessons harder for a model: further steps of textures, and a look at what
    was rendered more than once.
    """
    for begin in range(0, len(chosen), TOGETHER):
        part = chosen[begin : begin + TOGETHER]
        ascend(part, partial(slopes, model=model), steps)
        several = [
            lesson
            for lesson in part
            if isinstance(lesson, RenderedLesson) and len(lesson.pictures) > 1
        ]
        if several:
            with torch.no_grad():
                pictures = torch.cat([lesson.pictures for lesson in several]) / 255.0
                loss = surprise(
                    model(pictures),
                    [lesson.right for lesson in several for _ in lesson.pictures],
                )
            for lesson, losses in zip(
                several,
                loss.split([len(each.pictures) for each in several]),
                strict=True,
            ):
                lesson.losses = losses.clone()


def ascend(
    some: Sequence[Lesson],
    slopes_of: Callable[[Sequence[TextureLesson]], Sequence[Tensor]],
    steps: int = 1,
) -> None:
    """Steps uphill of textures, by what `slopes` says; views that share one add up.
    Other lessons stay as they are.
    """
    chosen = [lesson for lesson in some if isinstance(lesson, TextureLesson)]
    for _ in range(steps if chosen else 0):
        total = dict[int, Tensor]()
        for lesson, slope in zip(chosen, slopes_of(chosen), strict=True):
            total[id(lesson.texture)] = slope + total.get(id(lesson.texture), 0.0)
        for lesson in {id(lesson.texture): lesson for lesson in chosen}.values():
            steepest = lesson.domain.steepest(lesson.texture, total[id(lesson.texture)])
            lesson.texture.copy_(
                lesson.domain.project(lesson.texture + STEP * steepest)
            )


def slopes(
    chosen: Sequence[TextureLesson],
    model: Callable[[Tensor], Tensor],
    change: Callable[[Tensor], Tensor] = lambda images: images,
) -> Sequence[Tensor]:
    """Return the derivative (d,) of each lesson's loss by its texture; `change` is of
    the pictures (N, H, W, 3).
    """
    leaves = [lesson.texture.clone().requires_grad_() for lesson in chosen]
    pictures = torch.stack(
        [lesson.picture(u) for lesson, u in zip(chosen, leaves, strict=True)]
    )
    return torch.autograd.grad(
        surprise(model(change(pictures)), [lesson.right for lesson in chosen]).sum(),
        leaves,
    )


def save_pictures(
    run: RunDirectory, number: int, chosen: Sequence[Lesson], labels: Sequence[str]
) -> None:
    """Write the pictures of a round's lessons into `PICTURES` of the run, and those of
    all rounds as a WebDataset.

    The pictures are ``CLASS/ROUND-LESSON-plain.png`` and ``...-worst.png``. The
    WebDataset stands beside their folder. It has of each picture a ``.png``, a ``.cls``
    with the index of its class and a ``.json`` with that and the kind of picture.
    Members have no time and no owner, so that equal pictures make equal files.
    """
    folder = run.path / PICTURES
    for place, lesson in enumerate(chosen):
        name = re.sub(r"[^a-z0-9]+", "-", labels[lesson.right[0]].lower()).strip("-")
        class_folder = f"{PICTURES}/{lesson.right[0]:04d}-{name}"
        (run.path / class_folder).mkdir(parents=True, exist_ok=True)
        for kind in ("plain", "worst") if with_worst([lesson]) else ("plain",):
            run.save_image(
                f"{number:03d}-{place:05d}-{kind}", getattr(lesson, kind), class_folder
            )
    with (
        writing.replacing(folder.with_suffix(".tar")) as part,
        tarfile.open(part, "w") as tar,
    ):
        for path in sorted(folder.glob("*/*.png")):
            index = int(path.parent.name[:4])
            kind = path.stem.rpartition("-")[2]
            facts = json.dumps({"class": index, "kind": kind})
            for suffix, data in {
                "png": path.read_bytes(),
                "cls": str(index).encode(),
                "json": facts.encode(),
            }.items():
                member = tarfile.TarInfo(f"{path.parent.name}-{path.stem}.{suffix}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))
