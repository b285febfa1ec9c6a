"""The scenes of a sweep: each answers queries by all models, rendered or predicted, which depends on query and job
alone, so that anybody may. Pictures that differ in light alone are put together from basis pictures, once these pay
(docs/transport.md). And the worst configuration, checked again (docs/sweeps.md, "What it says")."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluation, Query, Trials, choose_spp, run_trials
from advsearch.attacks.trials import margins_of, most_samples
from advsearch.described import Value
from advsearch.engine.acceptance import CHECK_SPP, VIEWS
from advsearch.engine.journal import Journal, Shared
from advsearch.engine.judging import judgements
from advsearch.engine.loading import framed, make_renderer
from advsearch.engine.record import Stages, rate_of
from advsearch.engine.sweeps import Job
from advsearch.engine.sweeps.points import Picks, Points
from advsearch.engine.sweeps.predicting import PAYS, SweptPicture, SweptPredictor, SweptSurfaceLight, WantedPicture
from advsearch.engine.verifier import ladder_of
from advsearch.files import scaled
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results.sweep import WorstVerified
from advsearch.scene.description import OBJECT
from advsearch.scene.formation import to_8_bit
from advsearch.scene.renderer import Renderer
from advsearch.scene.surfaces import Surfaces
from advsearch.scene.transport.lights import NOISE, BasisRenderer, Lights, lighting
from advsearch.scene.transport.matrix import MOST_BYTES, SPP
from advsearch.tasks import Judgement, Mark
from advsearch.tasks.base import Truth
from advsearch.viewer import thumbnails


@dataclass
class SweptLight(SweptPredictor):
    """Predicts pictures of one scene at one size from basis pictures."""

    way: ClassVar[str] = "basis pictures"
    samples: ClassVar[int] = SPP

    def _follows(self) -> frozenset[str]:
        self._moving, self._lights = lighting(self.renderer), 0
        return frozenset(self._moving.groups)

    def _reason(self) -> str | None:
        if not any(self._moving.groups.values()):
            return ""
        if not self.specialise:
            return "nothing is left out"
        if self.renderer.formation.denoiser != "oidn":
            return NOISE
        groups, inputs = self._groups, self.renderer.scene.assembly(self.renderer.space.inputs(self.renderer.start))
        self._lights = len(Lights(self.renderer, self._moving, inputs).alone)
        samples = self._lights * SPP + VIEWS * (2 * CHECK_SPP + self.spp)
        least = math.ceil(PAYS * samples / self.spp)
        if groups.size < least:
            return f"basis pictures pay where {least} pictures or more differ in light alone; here {groups.size} do"
        height, width = self.renderer.formation.resolution
        if groups.at_once * self._lights * 8 * height * width > scaled(MOST_BYTES):
            return f"basis pictures of {groups.count} groups take too much memory; make light the last axes of the grid"
        return None

    @property
    def _traced(self) -> int:
        return self._lights

    @property
    def _bytes(self) -> int:
        return sum(one.bytes for one in self._held.values() if one is not None)

    @property
    def not_finite(self) -> int:
        return sum(one.non_finite for one in self._held.values() if one is not None)

    def _made(self, u: Tensor, seed: int) -> BasisRenderer:
        return BasisRenderer(self.renderer, u, seed, moving=self._moving)

    def _predicted(self, made: BasisRenderer, us: Sequence[Tensor]) -> list[Tensor]:
        return [made(u) for u in us]


class SweptScene:
    """One scene, ready to be rendered and shown to the models: what a `Problem` is to an attack. Points, renderers and
    what predicts pictures are there for each size of picture, on which what a control frames may depend."""

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
        rendered = sum(renderer.non_finite for renderer in self.renderers.values())
        return rendered + sum(light.not_finite for light in self.light.values())

    # ---- rows of the sweep ------------------------------------------------------------------------------------------

    def answers(self, queries: Sequence[Query]) -> list[Evaluation]:
        """Answer queries of neighbouring rows: a picture is made once for each size, and a model sees all of its own at
        once."""
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
        return self.judge(model, u, to_8_bit(picture)).margin

    def judge(self, model: int, u: Tensor, picture: Tensor) -> Judgement:
        return self._judged(model, picture[None], [(u, {})])[0]

    def truth(self, model: int, u: Tensor, listed: Mapping[str, Value]) -> Truth:
        """What is true of a configuration (d,), as the task of one model needs it; values of the grid as they were
        `listed`, not what single precision makes of them."""
        job, size = self.job, self.job.sizes[model]
        if not job.tasks[model].varies:
            return self._truths[model]
        place, renderer = job.places[self.number], self.renderers[size]
        values = {name: listed.get(name, one) for name, one in self._spaces[size].describe(u).items()}
        return job.truth(place, model, values, lambda: renderer.surfaces(u))

    def picture(self, model: int, u: Tensor, seed: int, spp: int) -> Tensor:
        with torch.no_grad():
            return to_8_bit(self.renderers[self.job.sizes[model]](u, seed=seed, spp=spp))

    def surfaces(self, picks: Picks, size: tuple[int, int] | None = None, fineness: int = 1) -> Iterator[Surfaces]:
        """What is seen in the pixels of pictures, one after the other: of a size, by default that of the first model,
        in `fineness` parts of each side of a pixel."""
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
    """The scenes of a sweep in this process, of which the last one is held."""

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
        """The same by its number as text: see `advsearch.engine.journal.answering`."""
        return self.open(int(name))

    def picture(self, number: int) -> Tensor:
        sent = self.job.queries(range(number, number + 1))
        return self.named(sent[0][0]).pictures([query for _, _, query in sent])[0]


PROBES = "sample count worst"
"""Rows of the renders that chose the sample count."""


@dataclass(frozen=True)
class OneModel:
    """A swept scene as one of the models sees it: what a `Problem` is to an attack."""

    view: SweptScene
    model: int

    def evaluate(self, query: Query) -> Evaluation:
        picture = self.view.picture(self.model, query.u, query.seed, query.spp)
        return Evaluation.of(self.view.judge(self.model, query.u, picture))


def check_worst(
    view: SweptScene, job: Job, model: int, u: Tensor, run: RunDirectory | None, stages: Stages
) -> WorstVerified | None:
    """Render a configuration again, and say how often the model is wrong; None without trials. Those that the run has
    stored already are not made again."""
    config = job.config
    if config.trials == 0:
        return None
    seed, ladder = config.seed, ladder_of(config)
    stages.begin(
        "verification",
        "finding how many samples the check needs",
        most_samples(1, ladder),
        hint="the worst configuration, counted in samples a pixel; `verify_spp=NUMBER` leaves it out",
        at_most=True,
    )
    problem: Any = OneModel(view, model)
    journal = Journal(run, Shared(problem))

    def answers(queries: Sequence[Query], *, in_samples: bool = False) -> Iterator[Evaluation]:
        asked = [replace(one, drawn=False, sought=False) for one in queries]
        for query, answer in zip(asked, journal.answers(asked), strict=True):
            stages.progress.advance(query.spp if in_samples else 1)
            yield answer

    margins = margins_of(partial(answers, in_samples=True), PROBES, u, sought=False)
    count = choose_spp({"worst": margins}, seed=seed, ladder=ladder)
    hint = f"{config.trials} pictures of {count.spp} samples a pixel; `trials` or `verify_spp` shorten it"
    stages.begin("verification", "checking the worst configuration with fresh renders", config.trials, hint=hint)
    tried = run_trials(answers, u, spp=count.spp, seed=seed, trials=config.trials)
    settled = count.converged or len(ladder) == 1
    renders = count.renders + len(tried)
    wrong = [trial for trial in tried if trial.success]
    rate = rate_of(Trials(len(wrong), len(tried), count.spp), tried, wrong)
    return WorstVerified(**vars(rate), converged=settled, renders=renders)
