"""The scenes of a sweep: each answers queries about its pictures, rendered or predicted, by all models of the sweep.

What comes of a query depends on it and on the job alone, so it may be answered anywhere, in whatever company.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluation, Query
from advsearch.described import Value
from advsearch.engine.loading import framed, make_renderer
from advsearch.engine.metrics import judgements
from advsearch.engine.sweeps.job import Job
from advsearch.engine.sweeps.light import SweptLight
from advsearch.engine.sweeps.points import Picks, Points
from advsearch.engine.sweeps.predicting import SweptPicture, SweptPredictor, WantedPicture
from advsearch.engine.sweeps.surface_light import SweptSurfaceLight
from advsearch.scene.description import OBJECT
from advsearch.scene.formation import to_8_bit
from advsearch.scene.renderer import Renderer
from advsearch.scene.surfaces import Surfaces
from advsearch.tasks import Judgement, Mark
from advsearch.tasks.base import Truth
from advsearch.viewer import thumbnails


class SweptScene:
    """One scene, ready to be rendered and shown to the models: what a `Problem` is to an attack.

    Args:
        job: what is swept.
        number: of the scene.

    Attributes:
        job, number: likewise.
        points: its configurations for each size of picture, on which what a control frames may depend.
        renderers: likewise.
        light: what predicts pictures of these that differ in little.
        prepared: nothing.
    """

    prepared: Any = None

    def __init__(self, job: Job, number: int) -> None:
        place, config = job.places[number], job.config
        self.number, self.job = number, job
        self.points: dict[tuple[int, int], Points] = {}
        self.renderers: dict[tuple[int, int], Renderer] = {}
        self._spaces = job.spaces(place)
        for size, space in self._spaces.items():
            description = framed(place.scene.description, size)
            self.renderers[size] = make_renderer(
                description, space, size, config.denoise, config.seed, sampler=config.pixel_sampler
            )
            self.points[size] = job.points(space)
        self.light = {size: self._predictor(size) for size in self.renderers}
        self._truths = [None if task.varies else job.truth(place, k, {}) for k, task in enumerate(job.tasks)]

    def _predictor(self, size: tuple[int, int]) -> SweptPredictor:
        """What predicts the pictures of one size: basis pictures where they pay, or light on surfaces."""
        job, config, points = self.job, self.job.config, self.points[size]
        seed, score = seeds.stream(config.seed, "sweep light", self.number), partial(self._score, job.sizes.index(size))
        scene = (self.renderers[size], points, job.axes, job.spp, seed, score, config.specialise)
        basis = SweptLight(*scene, before=self.number * points.count)
        if basis.reason is None:
            return basis
        surface = SweptSurfaceLight(*scene, before=self.number * points.count)
        return surface if surface.reason is None or not basis.reason else basis

    @property
    def not_finite(self) -> int:
        """How many values of pictures were not finite, and were set to 0."""
        rendered = sum(renderer.non_finite for renderer in self.renderers.values())
        return rendered + sum(light.not_finite for light in self.light.values())

    # ---- rows of the sweep ------------------------------------------------------------------------------------------

    def answers(self, queries: Sequence[Query]) -> list[Evaluation]:
        """Answer queries of neighbouring rows: a picture is made once for each size, and a model sees all of its own at
        once.

        Args:
            queries: by `Job.queries`, or some of these.
        """
        begun, before, job = time.perf_counter(), self.not_finite, self.job
        models = len(job.models)
        made = {size: self._made(size, queries) for size in self.points}
        said: dict[int, Judgement] = {}
        for model, size in enumerate(job.sizes):
            mine = [one for one in queries if one.number % models == model]
            if mine:
                shown = torch.stack([made[size][one.number // models].picture for one in mine])
                judged = self._judged(model, shown, [(one.u, one.values) for one in mine])
                said |= {one.number: judgement for one, judgement in zip(mine, judged, strict=True)}
        pictures, wrong = made[job.sizes[0]], {number // models for number, one in said.items() if not one.right}
        seconds, answers = (time.perf_counter() - begun) / len(queries), list[Evaluation]()
        for query in queries:
            number, model = divmod(query.number, models)
            one, first = made[job.sizes[model]][number], job.first_of_size[model]
            answer = Evaluation.of(
                said[query.number], cost=one.traced * first, predicted=one.predicted, seconds=seconds
            )
            if model == 0 and query.keep and (job.config.keep_pictures == "all" or number in wrong):
                answer = replace(answer, small=thumbnails.thumbnail(pictures[number].picture))
            if model == 0 and job.aovs:
                surfaces = self.renderers[job.sizes[0]].surfaces(query.u)
                layers = {name: one.numpy() for name, one in surfaces.layers(job.aovs, OBJECT).items()}
                answer = replace(answer, layers=(layers, surfaces.notes(job.aovs)))
            answers.append(answer)
        so_far = [one.summary() for one in self.light.values()]
        return [*answers[:-1], replace(answers[-1], light=so_far, non_finite=max(0, self.not_finite - before))]

    def _made(self, size: tuple[int, int], queries: Sequence[Query]) -> dict[int, SweptPicture]:
        """The pictures of one size, rounded to 8 bits, by their numbers."""
        job, models = self.job, len(self.job.models)
        before, asked = self.number * self.points[size].count, dict[int, WantedPicture]()
        for one in queries:
            number, model = divmod(one.number, models)
            if job.sizes[model] == size:
                asked[number] = WantedPicture(number - before, one.u, one.seed)
        with torch.no_grad():
            shown = self.light[size].pictures(list(asked.values()))
        return {n: replace(one, picture=to_8_bit(one.picture)) for n, one in zip(asked, shown, strict=True)}

    def pictures(self, queries: Sequence[Query]) -> Tensor:
        """Return the pictures (n, H, W, 3) of rows as the first model sees them."""
        shown = self._made(self.job.sizes[0], queries)
        return torch.stack([one.picture for one in shown.values()])

    # ---- single pictures --------------------------------------------------------------------------------------------

    def _score(self, model: int, picture: Tensor, u: Tensor) -> float:
        """The margin of one model on one picture (H, W, 3), in logits."""
        return self.judge(model, u, to_8_bit(picture)).margin

    def judge(self, model: int, u: Tensor, picture: Tensor) -> Judgement:
        """What one model says of the picture (H, W, 3) of one configuration."""
        return self._judged(model, picture[None], [(u, {})])[0]

    def truth(self, model: int, u: Tensor, listed: Mapping[str, Value]) -> Truth:
        """What is true of a configuration (d,), as the task of one model needs it.

        Args:
            model: number of it.
            u: the configuration.
            listed: values of the grid as they were given, in the place of what single precision makes of them.
        """
        job, size = self.job, self.job.sizes[model]
        if not job.tasks[model].varies:
            return self._truths[model]
        place, renderer = job.places[self.number], self.renderers[size]
        values = {name: listed.get(name, one) for name, one in self._spaces[size].describe(u).items()}
        return job.truth(place, model, values, lambda: renderer.surfaces(u))

    def picture(self, model: int, u: Tensor, seed: int, spp: int) -> Tensor:
        """The picture (H, W, 3) that one model sees of one configuration."""
        with torch.no_grad():
            return to_8_bit(self.renderers[self.job.sizes[model]](u, seed=seed, spp=spp))

    def surfaces(self, picks: Picks, size: tuple[int, int] | None = None, fineness: int = 1) -> Iterator[Surfaces]:
        """What is seen in the pixels of pictures, one after the other.

        Args:
            picks: n of them.
            size: (height, width) of the pictures; None for those that the first model is shown.
            fineness: parts of each side of a pixel.
        """
        size = size or self.job.sizes[0]
        for u in self.points[size].configurations(picks):
            yield self.renderers[size].surfaces(u, fineness)

    def marks(self, model: int, u: Tensor, picture: Tensor) -> list[Mark]:
        """What shows the answer of one model to the picture (H, W, 3) of one configuration."""
        with torch.no_grad():
            output = self.job.models[model](picture)
            return self.job.tasks[model].marks(output, self.truth(model, u, {}))[0]

    def _judged(
        self, model: int, pictures: Tensor, shown: Sequence[tuple[Tensor, Mapping[str, Value]]]
    ) -> list[Judgement]:
        """What one model says of pictures (n, H, W, 3) of configurations; a margin that is not finite becomes NaN."""
        task, truths = self.job.tasks[model], [self._truths[model]]
        if task.varies:
            truths = [self.truth(model, *one) for one in shown]
        with torch.no_grad():
            output = self.job.models[model](pictures)
        said = judgements(task, output, pictures, truths, self.job.metrics)
        return [
            replace(Judgement.of(one.score, one.margin, one.answer, one.payload), metrics=one.metrics) for one in said
        ]


class Scenes:
    """The scenes of a sweep in this process, of which the last one is held.

    Args:
        job: what is swept.
    """

    def __init__(self, job: Job) -> None:
        self.job = job
        self.scene: SweptScene | None = None

    def open(self, number: int) -> SweptScene:
        """The scene with this number; loading it lets the one before go."""
        if self.scene is None or self.scene.number != number:
            self.scene = None
            self.scene = SweptScene(self.job, number)
        return self.scene

    def named(self, name: str) -> SweptScene:
        """The same by its number as text: see `advsearch.engine.sharing.answering`."""
        return self.open(int(name))

    def picture(self, number: int) -> Tensor:
        """Return the picture (H, W, 3) with this number as the first model sees it."""
        sent = self.job.queries(range(number, number + 1))
        return self.named(sent[0][0]).pictures([query for _, _, query in sent])[0]
