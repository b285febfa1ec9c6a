"""What a model is trained on: plain renders of scenes, and the worst configurations of them that short searches find.

Where light arrives linearly (textures, patches), a lesson holds a matrix of light transport of one view, which says the
picture of any texture and its derivative without rendering: its adversarial texture is searched further each time that
the lesson comes up (warm starts: Zheng et al. 2020, arXiv 1912.11969). A texture that several views share is one of
expectation over transformation (EOT, Athalye et al. 2018). Everything else is rendered at random configurations, half
of them with numbers at the ends of their ranges. To train on, a scene is rendered twice, as new scenes teach more than
further configurations of one; to choose weights by, it is rendered more often, and the configuration that is worst for
the model as it is counts.
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

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Domain
from advsearch.controls import Space
from advsearch.engine.problem import Problem
from advsearch.models import Model
from advsearch.runs.files import replacing
from advsearch.runs.images import write_png
from advsearch.scene.formation import levels_of, to_8_bit
from advsearch.scene.transport.lights import why_not
from advsearch.scene.transport.matrix import LinearRenderer

SPP, MATRIX_SPP, DEPTH = 2, 4, 4
"""Samples a pixel of a lesson's pictures, and of a matrix of light transport; segments of the longest path: many
lessons with some noise teach more than few without."""
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
class Disguise:
    """An adversarial texture (d,), of one view or shared by several."""

    u: Tensor


@dataclass(eq=False)
class TextureLesson(Lesson):
    """A lesson whose pictures `linear` says, the scene being let go of: the space and the domain of its texture, the
    numbers of the conditions that it was made for, and the adversarial texture."""

    space: Space
    domain: Domain
    linear: LinearRenderer
    numbers: Tensor
    texture: Disguise

    def picture(self, u: Tensor) -> Tensor:
        """Return the picture (H, W, 3) of a texture, with a graph."""
        inputs = self.space.inputs(u)
        return self.linear.shown({name: inputs[name] for name in self.linear.there}, torch.cat([u, self.numbers]))

    @property
    def worst(self) -> Tensor:
        """(H, W, 3) the picture of the adversarial texture as it is now."""
        with torch.no_grad():
            return to_8_bit(self.picture(self.texture.u))


@dataclass(eq=False)
class RenderedLesson(Lesson):
    """A lesson whose pictures (N, H, W, 3) uint8 were rendered at random configurations, with the loss (N,) of each
    when a model last looked at it; infinite of those that none has."""

    pictures: Tensor
    losses: Tensor

    @classmethod
    def of(cls, right: tuple[int, ...], plain: Tensor, pictures: Tensor) -> RenderedLesson:
        """Return a lesson of a picture (H, W, 3) and some (N, H, W, 3) in [0, 1], the first the worst so far."""
        return cls(right, levels_of(plain), levels_of(pictures), torch.full((len(pictures),), torch.inf))

    @property
    def worst(self) -> Tensor:
        """(H, W, 3) the picture whose loss was highest."""
        return self.pictures[int(self.losses.argmax())] / 255.0


def plain_lessons(problem: Problem, views: int, seed: int) -> list[Lesson]:
    """Draw views of one scene as it is: lessons that nothing makes harder. Arguments as for `lessons`."""
    right = tuple(int(index) for index in problem.truth())
    drawn = [seeds.stream(seed, "plain lesson", number) for number in range(views)]
    quickly = problem.renderer.like(quick=True)
    with torch.no_grad(), quickly.scene.shorter(DEPTH):
        pictures = [quickly(problem.whole(problem.domain.start, view), seed=view, spp=SPP) for view in drawn]
    return [Lesson(right, levels_of(picture)) for picture in pictures]


def has_matrix(problem: Problem) -> bool:
    """Whether a matrix of light transport says the pictures of what is searched."""
    return why_not(problem.renderer, [control.name for control in problem.space.controls[problem.searched :]]) is None


def lessons(problem: Problem, views: int, seed: int, *, tries: int | None = None, shared: bool = False) -> list[Lesson]:
    """Draw lessons from so many views of one scene, each with conditions of its own, drawn by chance. Where no matrix
    says the pictures, `tries` configurations are rendered beside each view as it is (see `tried`); None for two renders
    of a view: one of the controls moved, and all of them. Views that are `shared` have one adversarial texture."""

    def begun(seed: int) -> Disguise:
        return Disguise(problem.domain.sample(torch.Generator().manual_seed(seed), extreme=True)[0])

    linear, quickly, found = has_matrix(problem), problem.renderer.like(quick=True), list[Lesson]()
    right = tuple(int(index) for index in problem.truth())
    common, whole_space = begun(seed), replace(problem.space, scene=None)
    space = replace(problem.searched_space, scene=None)
    with torch.no_grad(), problem.renderer.scene.shorter(DEPTH):
        for number in range(views):
            view = seeds.stream(seed, "lesson", number)
            whole = problem.whole(problem.domain.start, view)
            numbers = whole[problem.domain.dim :].clone()  # and not all that it is a part of
            if linear:
                made = LinearRenderer(problem.renderer, whole, view, spp=MATRIX_SPP, quick=True)
                plain, texture = made(whole), common if shared else begun(view)
                made.let_go(whole_space)
                found.append(TextureLesson(right, levels_of(plain), space, problem.domain, made, numbers, texture))
                continue
            generator = torch.Generator().manual_seed(view)
            if tries is None:
                *alone, together = tried(problem.domain, generator, 1 + len(problem.searched_space.controls))
                wanted = [alone[torch.randint(len(alone), (), generator=generator)], together]
            else:
                wanted = [problem.domain.start, *tried(problem.domain, generator, tries)]
            plain, *pictures = (quickly(torch.cat([u, numbers]), seed=view, spp=SPP) for u in wanted)
            found.append(RenderedLesson.of(right, plain, torch.stack(pictures)))
    return found


def tried(domain: Domain, generator: torch.Generator, count: int) -> Tensor:
    """Draw configurations (count, d) at random. In half of them each number is moved to the nearer end of its range by
    chance, as searches end where several numbers are. Choices, and numbers that are periodic, have no ends. Of several
    controls each moves alone in turn, then all of them at once."""
    drawn = domain.sample(generator, count)
    at_ends = (torch.rand(drawn.shape, generator=generator) < 0.5) & (torch.rand(count, 1, generator=generator) < 0.5)
    owners = [block.name.rpartition(".")[0] for block, _ in domain.parts()]
    controls = list(dict.fromkeys(owners))
    turn = torch.arange(count) % (len(controls) + 1)
    for owner, (block, part) in zip(owners, domain.parts(), strict=True):
        if block.options or block.periodic:
            at_ends[:, part] = False
        still = (turn != controls.index(owner)) & (turn != len(controls))
        drawn[still, part] = domain.start[part]
        at_ends[still, part] = False
    ends = torch.where(drawn - domain.lower < domain.upper - drawn, domain.lower, domain.upper)
    return torch.stack([domain.project(row) for row in torch.where(at_ends, ends, drawn)])


def surprise(logits: Tensor, right: Sequence[tuple[int, ...]]) -> Tensor:
    """Return (N,): the negative logarithm of the probability that logits (N, C) give to the right classes of each."""
    found = F.log_softmax(logits, dim=1)
    return torch.stack([-row[list(of)].logsumexp(dim=0) for row, of in zip(found, right, strict=True)])


def with_worst(some: Sequence[Lesson]) -> list[TextureLesson | RenderedLesson]:
    """Those lessons that something makes harder."""
    return [lesson for lesson in some if isinstance(lesson, (TextureLesson, RenderedLesson))]


def harder(chosen: Sequence[Lesson], model: Model, steps: int = 1) -> None:
    """Make the worst pictures of lessons worse for a model: further steps of their textures, and a look at what was
    rendered in several configurations."""
    for begin in range(0, len(chosen), TOGETHER):
        part = chosen[begin : begin + TOGETHER]
        ascend(part, partial(slopes, model=model), steps)
        several = [one for one in part if isinstance(one, RenderedLesson) and len(one.pictures) > 1]
        if several:
            with torch.no_grad():
                pictures = torch.cat([lesson.pictures for lesson in several]) / 255.0
                loss = surprise(model(pictures), [lesson.right for lesson in several for _ in lesson.pictures])
            for lesson, losses in zip(several, loss.split([len(one.pictures) for one in several]), strict=True):
                lesson.losses = losses.clone()


def ascend(
    some: Sequence[Lesson], slopes_of: Callable[[Sequence[TextureLesson]], Sequence[Tensor]], steps: int = 1
) -> None:
    """Steps uphill of the textures of lessons, by what `slopes` says of them; views that share one add up. Lessons
    without a texture stay as they are."""
    chosen = [lesson for lesson in some if isinstance(lesson, TextureLesson)]
    for _ in range(steps if chosen else 0):
        total = dict[Disguise, tuple[Domain, Tensor]]()
        for lesson, slope in zip(chosen, slopes_of(chosen), strict=True):
            before = total.get(lesson.texture)
            total[lesson.texture] = lesson.domain, slope if before is None else before[1] + slope
        for texture, (domain, slope) in total.items():
            texture.u = domain.project(texture.u + STEP * domain.steepest(texture.u, slope))


def slopes(
    chosen: Sequence[TextureLesson],
    model: Callable[[Tensor], Tensor],
    change: Callable[[Tensor], Tensor] = lambda images: images,
) -> Sequence[Tensor]:
    """Return the derivative (d,) of the loss of each lesson with respect to its texture; `change` is what happens to
    the pictures (N, H, W, 3) before the model sees them."""
    leaves = [lesson.texture.u.clone().requires_grad_() for lesson in chosen]
    pictures = torch.stack([lesson.picture(u) for lesson, u in zip(chosen, leaves, strict=True)])
    return torch.autograd.grad(surprise(model(change(pictures)), [one.right for one in chosen]).sum(), leaves)


def save_pictures(folder: Path, number: int, chosen: Sequence[Lesson], labels: Sequence[str]) -> None:
    """Write the pictures of a round's lessons, ``CLASS/ROUND-LESSON-plain.png`` and ``...-worst.png``, and those of all
    rounds as a WebDataset beside the folder: of each picture a ``.png``, a ``.cls`` with the index of its class and a
    ``.json`` with that and the kind of picture. Members have no time and no owner, so that equal pictures make equal
    files."""
    for place, lesson in enumerate(chosen):
        name = re.sub(r"[^a-z0-9]+", "-", labels[lesson.right[0]].lower()).strip("-")
        for kind in ("plain", "worst") if with_worst([lesson]) else ("plain",):
            path = folder / f"{lesson.right[0]:04d}-{name}" / f"{number:03d}-{place:05d}-{kind}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, getattr(lesson, kind))
    with replacing(folder.with_suffix(".tar")) as part, tarfile.open(part, "w") as tar:
        for path in sorted(folder.glob("*/*.png")):
            index, kind = int(path.parent.name[:4]), path.stem.rpartition("-")[2]
            facts = json.dumps({"class": index, "kind": kind})
            for suffix, data in {"png": path.read_bytes(), "cls": str(index).encode(), "json": facts.encode()}.items():
                member = tarfile.TarInfo(f"{path.parent.name}-{path.stem}.{suffix}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))
