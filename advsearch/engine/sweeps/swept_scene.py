"""One scene of a sweep, ready to be rendered and shown to the models."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.described import Value
from advsearch.engine.loading import framed, make_renderer
from advsearch.engine.metrics import judgements
from advsearch.engine.sweeps.job import Job
from advsearch.engine.sweeps.light import Shown, SweptLight
from advsearch.engine.sweeps.points import Picks, Points
from advsearch.scene.formation import to_8_bit
from advsearch.scene.renderer import Renderer
from advsearch.scene.surfaces import Surfaces
from advsearch.tasks import Judgement, Mark
from advsearch.tasks.base import Truth

Values = dict[str, Value]


@dataclass(frozen=True, eq=False)
class Seen:
    """What models say of pictures.

    Attributes:
        judgements: for each model, of each picture.
        values: for each model, what is stored of each picture that it was shown.
        shown: for each model, how each picture was made.
        pictures: (n, H, W, 3) what the first model was shown.
    """

    judgements: list[list[Judgement]]
    values: list[list[Values]]
    shown: list[list[Shown]]
    pictures: Tensor


class SweptScene:
    """One scene, ready to be rendered and shown to the models.

    Args:
        job: what is swept.
        number: of the scene.

    Attributes:
        points: its configurations for each size of picture, on which what a control frames may depend.
        renderers: likewise.
        light: what predicts pictures of these that differ in light alone.
        not_finite: whether a picture had values that are not finite, which were set to 0.
    """

    def __init__(self, job: Job, number: int) -> None:
        place, config = job.places[number], job.config
        self.number, self._job = number, job
        self.points: dict[tuple[int, int], Points] = {}
        self.renderers: dict[tuple[int, int], Renderer] = {}
        self._spaces = {size: job.space(place, size) for size in dict.fromkeys(job.sizes)}
        for size, space in self._spaces.items():
            description = framed(place.scene.description, size)
            self.renderers[size] = make_renderer(
                description, space, size, config.denoise, config.seed, sampler=config.pixel_sampler
            )
            self.points[size] = job.points(space)
        self.light = {
            size: SweptLight(
                renderer,
                self.points[size],
                job.axes,
                job.spp,
                seeds.stream(config.seed, "sweep light", number),
                partial(self._score, job.sizes.index(size)),
                config.specialise,
            )
            for size, renderer in self.renderers.items()
        }
        self._truths = [None if task.varies else job.truth(place, k, {}) for k, task in enumerate(job.tasks)]

    @property
    def not_finite(self) -> bool:
        basis = any(one.not_finite for one in self.light.values())
        return basis or any(renderer.non_finite for renderer in self.renderers.values())

    def look(self, picks: Picks, noise: Sequence[int]) -> Seen:
        """Render or predict configurations, round to 8 bits, ask and judge.

        Args:
            picks: n of them.
            noise: a seed for each.
        """
        u, shown, pictures, values = {}, {}, {}, {}
        for size, points in self.points.items():
            u[size] = points.configurations(picks)
            with torch.no_grad():
                shown[size] = self.light[size].show(picks, u[size], noise, self.number * points.count)
            pictures[size] = to_8_bit(torch.stack([one.picture for one in shown[size]]))
            values[size] = points.values(u[size], picks)
        sizes = self._job.sizes
        return Seen(
            judgements=[self._judged(model, pictures[size], u[size], values[size]) for model, size in enumerate(sizes)],
            values=[values[size] for size in sizes],
            shown=[shown[size] for size in sizes],
            pictures=pictures[sizes[0]],
        )

    def _score(self, model: int, picture: Tensor, u: Tensor) -> float:
        """The margin of one model on one picture (H, W, 3), in logits."""
        values = self._spaces[self._job.sizes[model]].describe(u)
        return self._judged(model, to_8_bit(picture)[None], u[None], [values])[0].margin

    def trial(self, number: int, u: Tensor, seed: int, spp: int) -> Judgement:
        """What one model says of one configuration."""
        return self.judge(number, u, self.picture(number, u, seed, spp))

    def judge(self, number: int, u: Tensor, picture: Tensor) -> Judgement:
        """What one model says of the picture (H, W, 3) of one configuration."""
        values = self._spaces[self._job.sizes[number]].describe(u)
        return self._judged(number, picture[None], u[None], [values])[0]

    def truth(self, number: int, u: Tensor, values: Mapping[str, Value]) -> Truth:
        """What is true of a configuration, as the task of one model needs it.

        Args:
            number: of the model.
            u: (d,) the configuration.
            values: as it is described.
        """
        job = self._job
        if not job.tasks[number].varies:
            return self._truths[number]
        renderer = self.renderers[job.sizes[number]]
        return job.truth(job.places[self.number], number, values, lambda: renderer.surfaces(u))

    def picture(self, number: int, u: Tensor, seed: int, spp: int) -> Tensor:
        """The picture (H, W, 3) that one model sees of one configuration."""
        return self._pictures(self.renderers[self._job.sizes[number]], u[None], [seed], spp)[0]

    def surfaces(self, picks: Picks, size: tuple[int, int] | None = None, fineness: int = 1) -> Iterator[Surfaces]:
        """What is seen in the pixels of pictures, one after the other.

        Args:
            picks: n of them.
            size: (height, width) of the pictures; None for those that the first model is shown.
            fineness: parts of each side of a pixel.
        """
        size = size or self._job.sizes[0]
        for u in self.points[size].configurations(picks):
            yield self.renderers[size].surfaces(u, fineness)

    def marks(self, number: int, u: Tensor, picture: Tensor) -> list[Mark]:
        """What shows the answer of one model to the picture (H, W, 3) of one configuration."""
        values = self._spaces[self._job.sizes[number]].describe(u)
        with torch.no_grad():
            output = self._job.models[number](picture)
            return self._job.tasks[number].marks(output, self.truth(number, u, values))[0]

    @staticmethod
    def _pictures(renderer: Renderer, u: Tensor, noise: Sequence[int], spp: int) -> Tensor:
        with torch.no_grad():
            return to_8_bit(
                torch.stack([renderer(one, seed=seed, spp=spp) for one, seed in zip(u, noise, strict=True)])
            )

    def _judged(
        self, number: int, pictures: Tensor, u: Tensor, values: Sequence[Mapping[str, Value]]
    ) -> list[Judgement]:
        """What one model says of pictures (n, H, W, 3); a margin that is not finite becomes NaN."""
        task, truths = self._job.tasks[number], [self._truths[number]]
        if task.varies:
            truths = [self.truth(number, *one) for one in zip(u, values, strict=True)]
        with torch.no_grad():
            output = self._job.models[number](pictures)
        said = judgements(task, output, pictures, truths, self._job.metrics)
        return [
            replace(Judgement.of(one.score, one.margin, one.answer, one.payload), metrics=one.metrics) for one in said
        ]
