"""The scenes of a sweep: each answers queries by all models, rendered or predicted, which depends on query and job
alone, so that anybody may. Pictures that differ in light alone are put together from basis pictures, once these pay
(docs/transport.md). And the worst configuration, checked again (docs/sweeps.md, "What it says")."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluation, Query, Trials, run_trials
from advsearch.engine.journal import Journal, Shared
from advsearch.engine.judging import facts_of
from advsearch.engine.loading import framed, make_renderer
from advsearch.engine.problem import Prepared, Problem
from advsearch.engine.record import Stages, rate_of
from advsearch.engine.verifier import Verifier, ladder_of
from advsearch.questions.sweep.job import Job
from advsearch.questions.sweep.points import Points
from advsearch.questions.sweep.predicting import PredictedSweep, SweptPicture
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import WorstVerified
from advsearch.runs.directory import RunDirectory
from advsearch.scene.description import OBJECT
from advsearch.scene.formation import to_8_bit
from advsearch.scene.renderer import Renderer
from advsearch.tasks import Judgement
from advsearch.viewer import thumbnails


class SweptScene:
    """One scene, ready to be rendered and shown to the models: a `Problem` for each of them. Points, renderers and what
    predicts pictures are there for each size of picture, on which what a control frames may depend."""

    def __init__(self, job: Job, number: int) -> None:
        place, config = job.places[number], job.config
        self.number, self.job = number, job
        self.points: dict[tuple[int, int], Points] = {}
        self.renderers: dict[tuple[int, int], Renderer] = {}
        spaces = job.spaces(place)
        for size, space in spaces.items():
            description = framed(place.scene.description, size)
            self.renderers[size] = make_renderer(
                description, space, size, config.denoise, config.seed, sampler=config.pixel_sampler
            )
            self.points[size] = job.points(space)
        facts, spp, seed = partial(facts_of, place.scene, place.object, config), job.spp, config.seed
        self.problems = tuple(
            Problem(self.renderers[size], spaces[size], model, task, facts, None, spp, seed, metrics=job.metrics)
            for size, model, task in zip(job.sizes, job.models, job.tasks, strict=True)
        )
        seed, self.predicted = seeds.stream(seed, "sweep light", number), dict[tuple[int, int], PredictedSweep]()
        for size, points in self.points.items():
            problem, before = self.problems[job.sizes.index(size)], number * points.count
            self.predicted[size] = PredictedSweep(problem, points, job.axes, seed, config.specialise, before)

    @property
    def not_finite(self) -> int:
        rendered = sum(renderer.non_finite for renderer in self.renderers.values())
        return rendered + sum(one.not_finite for one in self.predicted.values())

    def answers(self, queries: Sequence[Query], prepared: Prepared | None = None) -> list[Evaluation]:
        """Answer queries of neighbouring rows: a picture is made once for each size, and a model sees all of its own at
        once. Nothing is prepared for these."""
        begun, before, job = time.perf_counter(), self.not_finite, self.job
        models = len(job.models)
        made = {size: self._made(size, queries) for size in self.points}
        said: dict[int, Judgement] = {}
        for model, (size, problem) in enumerate(zip(job.sizes, self.problems, strict=True)):
            mine = [query for query in queries if query.number % models == model]
            if mine:
                shown = torch.stack([made[size][query.number // models].picture for query in mine])
                judged = problem.judge_several(shown, [query.u for query in mine], [query.values for query in mine])
                said |= {query.number: judgement for query, judgement in zip(mine, judged, strict=True)}
        wrong = {number // models for number, judgement in said.items() if not judgement.right}
        seconds, answers = (time.perf_counter() - begun) / len(queries), list[Evaluation]()
        for query in queries:
            number, model = divmod(query.number, models)
            picture, first = made[job.sizes[model]][number], job.first_of_size[model]
            answer = Evaluation.of(
                said[query.number], cost=picture.traced * first, predicted=picture.predicted, seconds=seconds
            )
            if model == 0 and query.keep and (job.config.keep_pictures == "all" or number in wrong):
                answer = replace(answer, small=thumbnails.thumbnail(picture.picture))
            if model == 0 and job.aovs:
                surfaces = self.renderers[job.sizes[0]].surfaces(query.u)
                layers = {name: layer.numpy() for name, layer in surfaces.layers(job.aovs, OBJECT).items()}
                answer = replace(answer, layers=(layers, surfaces.notes(job.aovs)))
            answers.append(answer)
        so_far = [one.summary() for one in self.predicted.values()]
        return [*answers[:-1], replace(answers[-1], light=so_far, non_finite=max(0, self.not_finite - before))]

    def _made(self, size: tuple[int, int], queries: Sequence[Query]) -> dict[int, SweptPicture]:
        """The pictures of one size, rounded to 8 bits, by their numbers."""
        job, models, before = self.job, len(self.job.models), self.number * self.points[size].count
        asked = {one.number // models - before: one for one in queries if job.sizes[one.number % models] == size}
        with torch.no_grad():
            made = self.predicted[size].pictures(asked)
        return {before + number: replace(one, picture=to_8_bit(one.picture)) for number, one in made.items()}

    def pictures(self, queries: Sequence[Query]) -> Tensor:
        """Return the pictures (n, H, W, 3) of rows as the first model sees them."""
        made, models = self._made(self.job.sizes[0], queries), len(self.job.models)
        return torch.stack([made[number].picture for number in dict.fromkeys(one.number // models for one in queries)])


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


def check_worst(
    problem: Problem, config: SweepConfig, u: Tensor, run: RunDirectory | None, stages: Stages
) -> WorstVerified | None:
    """Render a configuration again, and say how often the model is wrong; None without trials. Those that the run has
    stored already are not made again."""
    if config.trials == 0:
        return None
    verifier = Verifier(Journal(run, Shared(problem)), ladder_of(config), stages, sought=False)
    verifier.choose_spp({"worst": u})
    verifier.begin("checking the worst configuration with fresh renders", config.trials)
    spp, count = verifier.findings.spp, verifier.findings.sample_count
    tried = run_trials(verifier.answers, u, spp=spp, seed=config.seed, trials=config.trials)
    wrong = [trial for trial in tried if trial.success]
    rate = rate_of(Trials(len(wrong), len(tried), spp), tried, wrong)
    settled = len(verifier.ladder) == 1 or (count is not None and count.converged)
    return WorstVerified(**vars(rate), converged=settled, renders=verifier.findings.verification_renders)
