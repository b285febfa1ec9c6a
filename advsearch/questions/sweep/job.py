"""Sweeps. Here: what one is asked for, found and loaded: scenes, models, controls and
axes.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluation, Query, Trials, run_trials
from advsearch.attacks.domain import Seeds
from advsearch.controls import Control, Space, make_control, make_space
from advsearch.engine.image_changes import AWAY, as_claimed, changed
from advsearch.engine.journal import Journal, Sent, Shared
from advsearch.engine.judging import Metrics, check_truth, domain_of
from advsearch.engine.loading import Scene, framed, make_renderer
from advsearch.engine.problem import Prepared, Problem
from advsearch.engine.record import rate_of
from advsearch.engine.rendering import facts_about
from advsearch.engine.verifier import Verifier, ladder_of
from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.models.features import Features, features_of
from advsearch.options import Value
from advsearch.progress import Stages
from advsearch.questions.sweep.axes import Axis, Drawn, Points, on_grid
from advsearch.questions.sweep.predicting import PredictedSweep, SweptPicture
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import WorstVerified
from advsearch.questions.sweep.tracks import ConstantVelocity, Tracker
from advsearch.runs.directory import RunDirectory
from advsearch.scene.color import to_8_bit
from advsearch.scene.description import ENVIRONMENT, OBJECT
from advsearch.scene.formation import next_count
from advsearch.scene.renderer import Renderer
from advsearch.tasks import Facts, Judgement, Task
from advsearch.viewer import thumbnails

KIND = "sweep"  # rows of the sweep, and the stream of their seeds
SAMPLES = 100  # draws where there is no grid and nothing is said


@dataclass(frozen=True)
class NamedScene:
    """One of the scenes. Controls that are `held` stay where `u` (d,) has them, or as
    the scene is without it; `beside_clean` is what the place is called beside the same
    one without the adversarial scene of a run, empty where there is no such.
    """

    object: str
    environment: str
    scene: Scene
    held: tuple[Control, ...] = ()
    u: Tensor | None = None
    beside_clean: str = ""

    @property
    def names(self) -> dict[str, str]:
        named = {"object": self.object, "environment": self.environment}
        return {**named, "answer": self.beside_clean} if self.beside_clean else named


@dataclass(frozen=True)
class Job:
    """Everything that was asked for, found and loaded: `controls` are drawn by chance;
    `aovs` are layers of ground truth that are kept of every picture of the first model
    (`scene.formation.AOVS`).
    """

    config: SweepConfig
    places: tuple[NamedScene, ...]
    models: tuple[Model, ...]
    tasks: tuple[Task, ...]
    controls: tuple[Control, ...]
    axes: tuple[Axis, ...]
    aovs: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    metrics: Metrics = field(default_factory=dict)
    tracker: Tracker = ConstantVelocity
    _bound: dict[int, dict[tuple[int, int], Points]] = field(
        default_factory=dict, init=False, repr=False
    )

    @property
    def samples(self) -> int:
        return self.config.samples or (
            SAMPLES if self.controls and not self.axes else 1
        )

    @cached_property
    def spp(self) -> int:
        """Samples a pixel, as the sampler has them."""
        return next_count(self.config.pixel_sampler, self.config.search_spp)

    @cached_property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        """(height, width) of the pictures for each model."""
        return tuple(
            self.config.resolution or model.input_size for model in self.models
        )

    @cached_property
    def first_of_size(self) -> tuple[bool, ...]:
        """Of each model, whether no model before it is shown the same pictures."""
        return tuple(
            size not in self.sizes[:model] for model, size in enumerate(self.sizes)
        )

    @cached_property
    def per_scene(self) -> int:
        """Pictures of a scene."""
        return next(iter(self.bound(0).values())).count

    @cached_property
    def seeds(self) -> Seeds:
        return Seeds(self.config.seed, KIND)

    def bound(self, scene: int) -> dict[tuple[int, int], Points]:
        """The configurations of a scene for each size of picture; those of the last
        scene are held.
        """
        if scene not in self._bound:
            self._bound.clear()
            place = self.places[scene]
            sizes = dict.fromkeys(self.sizes)
            self._bound[scene] = {
                size: self.points(self.space(place, size)) for size in sizes
            }
        return self._bound[scene]

    def queries(self, numbers: range) -> list[Sent]:
        """Ask all models about the pictures with these numbers, all of one scene, whose
        number is the name.
        """
        scene = numbers.start // self.per_scene
        place = self.places[scene]
        before = scene * self.per_scene
        keep = self.config.keep_pictures != "none"
        held = {control.name for control in place.held}
        queries: dict[int, Query] = {}
        for size, points in self.bound(scene).items():
            u = points.configurations(numbers.start - before, len(numbers), before)
            described = points.values(u, numbers.start - before)
            for number, configuration, values in zip(
                numbers, u, described, strict=True
            ):
                names = place.names
                lit_by = points.space.lit_by(values)
                if lit_by is not None:
                    names["environment"] = lit_by
                seed = self.seeds(points.noise(number))
                for model in (
                    model for model, own in enumerate(self.sizes) if own == size
                ):
                    names["model"] = self.models[model].name
                    told: dict[str, Value] = {
                        name: {"value": text, "unit": ""}
                        for name, text in names.items()
                    }
                    told |= {
                        name: value
                        for name, value in values.items()
                        if name.partition(".")[0] not in held
                    }
                    step = number * len(self.models) + model
                    queries[step] = Query(
                        configuration.clone(), seed, KIND, step, spp=self.spp, drawn=False, values=told, sought=False,
                        keep=keep,
                    )  # fmt: skip
        return [(str(scene), None, queries[step]) for step in sorted(queries)]

    def space(self, place: NamedScene, size: tuple[int, int]) -> Space:
        """The controls, those of the grid as choices, bound to a scene."""
        description = framed(place.scene.description, size)
        controls = (*place.held, *on_grid(self.controls, self.axes, description))
        if not controls:
            return Space((), None)
        space = make_space(controls, description)
        if place.held:
            start = torch.cat(
                [bound.start for bound in space.controls[: len(place.held)]]
            )
            if place.u is not None and len(place.u) != len(start):
                raise InputError(
                    "adversarial_of: the adversarial configuration of "
                    f"{place.beside_clean} has {len(place.u)} "
                    f"numbers, and {place.object} takes {len(start)}: it is another "
                    "object, or it has changed since; "
                    "do the run again"
                )
            space = space.holding(start if place.u is None else place.u)
        for group in space.groups:
            if group.setting in place.scene.description.given - {ENVIRONMENT}:
                raise InputError(
                    f"`controls` {group.control}: draws {group.parameter} by chance, "
                    f"and `set` {group.setting} fixes "
                    "it; leave it out of one of the two"
                )
        return space

    def points(self, space: Space) -> Points:
        """The configurations of a space; those with an adversarial scene have the draws
        of those without it.
        """
        scenes = len(self.places) // 2 if self.places[0].beside_clean else 0
        domain = domain_of(space.controls)
        config = self.config
        return Points(
            space,
            domain,
            self.axes,
            self.samples,
            config.sampler,
            config.seed,
            scenes,
            len(self.places),
        )

    def facts(self, place: NamedScene, values: Mapping[str, Value]) -> Facts:
        description = place.scene.description
        config = self.config
        return facts_about(
            description, place.object, config.label, lambda: values, judge=config.judge
        )


def check_scenes(
    places: Sequence[NamedScene], controls: Sequence[Control], axes: Sequence[Axis]
) -> None:
    given = {name for place in places for name in place.scene.description.given}
    drawn = {control.name: control for control in controls}
    choosing = list[str]()
    for axis in axes:
        settings = {"kind": axis.control, axis.parameter.name: axis.values[0]}
        setting = (
            drawn.get(axis.instance) or make_control(axis.instance, settings)
        ).setting(axis.parameter)
        if setting == ENVIRONMENT:
            choosing.append(f"`grid` {axis.name}")
        elif setting in given:
            raise InputError(
                f"`grid` {axis.name}: `set` fixes it already; leave it "
                "out of one of the two"
            )
    environments = list(dict.fromkeys(place.environment for place in places))
    choosing += [
        f"`controls` {control.name}"
        for control in controls
        for parameter in control.parameters
        if control.setting(parameter) == ENVIRONMENT
        and parameter.name in control.settings()
    ]
    if len(environments) > 1 and choosing:
        raise InputError(
            f"`environment={','.join(environments)}` and {choosing[0]} both choose "
            "what lights the scene; name all of "
            "them in one of the two, and leave the other out"
        )


def check_all(job: Job) -> tuple[Points, tuple[Drawn, ...]]:
    """Bind every scene once, so that what is wrong is said before anything is rendered.
    Returns the points of the first scene, and what the table shows of the draws: shares
    of the range where scenes, or pictures of different shapes, have different ones.
    """
    bound = []
    for scene, place in enumerate(job.places):
        bound += [(place, points) for points in job.bound(scene).values()]
        for task, model in zip(job.tasks, job.models, strict=True):
            check_truth(
                task,
                model,
                place.scene,
                job.facts(place, {}),
                job.config.image_settings,
            )
    first = bound[0][1]
    for place, points in bound:
        if points.drawn_numbers != first.drawn_numbers:
            raise InputError(
                f"`object` {place.object}: its controls draw other numbers than those "
                f"of {job.places[0].object}; sweep "
                "the two by themselves"
            )
    drawn = []
    for versions in zip(*(points.drawn for _, points in bound), strict=True):
        same = all(one.parts == versions[0].parts for one in versions)
        shares = tuple(
            [k / first.parts, (k + 1) / first.parts] for k in range(first.parts)
        )
        drawn.append(
            versions[0]
            if same
            else replace(versions[0], unit="of its range", parts=shares, settled=False)
        )
    return first, tuple(drawn)


class SweptScene:
    """One scene, ready to be rendered and shown to the models: a `Problem` for each of
    them. Points, renderers and what predicts pictures are there for each size of
    picture, on which what a control frames may depend.
    """

    def __init__(self, job: Job, number: int) -> None:
        place = job.places[number]
        config = job.config
        self.number, self.job, self.points = number, job, job.bound(number)
        self._without: dict[tuple[int, int], Renderer] = {}
        self.renderers = {size: self._renderer(size) for size in self.points}
        facts = partial(
            facts_about,
            place.scene.description,
            place.object,
            config.label,
            judge=config.judge,
        )
        spp = job.spp
        seed = config.seed
        self.problems = tuple(
            Problem(
                self.renderers[size],
                self.points[size].space,
                model,
                task,
                facts,
                None,
                spp,
                seed,
                metrics=job.metrics,
            )
            for size, model, task in zip(job.sizes, job.models, job.tasks, strict=True)
        )
        seed = seeds.stream(seed, "sweep light", number)
        self.predicted = dict[tuple[int, int], PredictedSweep]()
        for size, points in self.points.items():
            problem = self.problems[job.sizes.index(size)]
            before = number * points.count
            self.predicted[size] = PredictedSweep(
                problem, points, job.axes, seed, config.specialise, before
            )

    @property
    def not_finite(self) -> int:
        rendered = sum(renderer.non_finite for renderer in self.renderers.values())
        return rendered + sum(one.not_finite for one in self.predicted.values())

    def evaluate_all(
        self, queries: Sequence[Query], prepared: Prepared | None = None
    ) -> list[Evaluation]:
        """Answer queries of neighbouring rows: a picture is made once for each size,
        and a model sees all of its own at once. Nothing is prepared for these.
        """
        begun = time.perf_counter()
        before = self.not_finite
        job = self.job
        models = len(job.models)
        made = {size: self._made(size, queries) for size in self.points}
        said: dict[int, Judgement] = {}
        for model, (size, problem) in enumerate(
            zip(job.sizes, self.problems, strict=True)
        ):
            mine = [query for query in queries if query.number % models == model]
            if mine:
                shown = torch.stack(
                    [made[size][query.number // models].picture for query in mine]
                )
                judged = problem.judge_several(
                    shown, [query.u for query in mine], [query.values for query in mine]
                )
                judged = self._with_claims(problem, size, mine, shown, judged)
                said |= {
                    query.number: judgement
                    for query, judgement in zip(mine, judged, strict=True)
                }
        wrong = {
            number // models
            for number, judgement in said.items()
            if not judgement.right
        }
        seconds = (time.perf_counter() - begun) / len(queries)
        evaluations = list[Evaluation]()
        for query in queries:
            number, model = divmod(query.number, models)
            picture = made[job.sizes[model]][number]
            cost = picture.traced * job.first_of_size[model]
            evaluation = Evaluation.of(
                said[query.number],
                cost=cost,
                predicted=picture.predicted,
                seconds=seconds,
            )
            if (
                model == 0
                and query.keep
                and (job.config.keep_pictures == "all" or number in wrong)
            ):
                evaluation = replace(
                    evaluation, small=thumbnails.thumbnail(picture.picture)
                )
            if model == 0 and job.aovs:
                surfaces = self.renderers[job.sizes[0]].surfaces(query.u)
                layers = {
                    name: layer.numpy()
                    for name, layer in surfaces.layers(job.aovs, OBJECT).items()
                }
                evaluation = replace(
                    evaluation, layers=(layers, surfaces.notes(job.aovs))
                )
            evaluations.append(evaluation)
        so_far = [one.summary() for one in self.predicted.values()]
        return [
            *evaluations[:-1],
            replace(
                evaluations[-1],
                light=so_far,
                non_finite=max(0, self.not_finite - before),
            ),
        ]

    def _with_claims(
        self,
        problem: Problem,
        size: tuple[int, int],
        mine: Sequence[Query],
        shown: Tensor,
        judged: list[Judgement],
    ) -> list[Judgement]:
        """Return judgements of pictures (n, H, W, 3) with a number for each claim about
        changed ones: 1 where it is as claimed. What is true stays what it was before
        the change.
        """
        wholes = [query.u for query in mine]
        listed = [query.values for query in mine]
        for claim, when in self.job.config.claims:
            if when == AWAY:  # rendered with the same noise
                # by a renderer of its own: a scene in which something was far away has
                # other last bits
                renderer = (
                    self._without[size]
                    if size in self._without
                    else self._renderer(size)
                )
                self._without[size], renderer.scene.assembly.away = renderer, True
                with torch.no_grad():
                    rendered = [
                        renderer(query.u, query.seed, query.spp) for query in mine
                    ]
                pictures = torch.stack(list(map(to_8_bit, rendered)))
            else:
                pictures = torch.stack(
                    [changed(picture, when, problem.model.cameras) for picture in shown]
                )
            after = problem.judge_several(pictures, wholes, listed)
            for k, (before, now) in enumerate(zip(judged, after, strict=True)):
                held = float(as_claimed(claim, before.prediction, now.prediction))
                judged[k] = replace(
                    before, metrics={**(before.metrics or {}), f"{claim} {when}": held}
                )
        return judged

    def _renderer(self, size: tuple[int, int]) -> Renderer:
        config = self.job.config
        space = self.points[size].space
        description = framed(self.job.places[self.number].scene.description, size)
        return make_renderer(
            description,
            space,
            size,
            config.denoise,
            config.seed,
            sampler=config.pixel_sampler,
        )

    def _made(
        self, size: tuple[int, int], queries: Sequence[Query]
    ) -> dict[int, SweptPicture]:
        """The pictures of one size, rounded to 8 bits, by their numbers."""
        models = len(self.job.models)
        before = self.number * self.points[size].count
        shown = [
            query for query in queries if self.job.sizes[query.number % models] == size
        ]
        with torch.no_grad():
            made = self.predicted[size].pictures(
                {query.number // models - before: query for query in shown}
            )
        return {
            before + number: replace(swept, picture=to_8_bit(swept.picture))
            for number, swept in made.items()
        }

    def picture(self, query: Query) -> Tensor:
        """Return the picture (H, W, 3) that the first model is asked about."""
        (made,) = self._made(self.job.sizes[0], [query]).values()
        return made.picture


class OpenScenes:
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
        """The same by its number as text: see
        `advsearch.engine.journal.worker_call`.
        """
        return self.open(int(name))

    def asked(self, number: int) -> tuple[SweptScene, list[Query]]:
        """The scene of a picture, open, and what its models are asked about it."""
        sent = self.job.queries(range(number, number + 1))
        return self.named(str(sent[0][0])), [query for _, _, query in sent]

    def picture(self, number: int) -> Tensor:
        """The picture (H, W, 3) as the first model sees it."""
        scene, (query, *_) = self.asked(number)
        return scene.picture(query)

    def thumbnail(self, number: int) -> bytes:
        """The same as a small JPEG."""
        return thumbnails.thumbnail(self.picture(number))

    def find_features(self) -> Features:
        """Find what reads the features that the first model decides by. Raises
        InputError: the task has none.
        """
        if self.job.tasks[0].varies:
            raise InputError(
                f"task {self.job.config.task_name}: features are read of classifiers"
            )
        return features_of(self.job.models[0])


def check_worst(
    problem: Problem,
    config: SweepConfig,
    u: Tensor,
    run: RunDirectory | None,
    stages: Stages,
) -> WorstVerified | None:
    """Render a configuration again, and say how often the model is wrong; None without
    trials. Those that the run has stored already are not made again.
    """
    if config.trials == 0:
        return None
    ladder = ladder_of(config.verify_spp, config.pixel_sampler)
    verifier = Verifier(Journal(run, Shared(problem)), ladder, stages, sought=False)
    verifier.choose_spp({"worst": u})
    verifier.begin("checking the worst configuration with fresh renders", config.trials)
    spp = verifier.findings.spp
    count = verifier.findings.sample_count
    tried = run_trials(
        verifier.evaluate_all, u, spp=spp, seed=config.seed, trials=config.trials
    )
    wrong = [trial for trial in tried if trial.success]
    rate = rate_of(Trials(len(wrong), len(tried), spp), tried, wrong)
    settled = len(verifier.ladder) == 1 or (count is not None and count.converged)
    return WorstVerified(
        **vars(rate), converged=settled, renders=verifier.findings.verification_renders
    )
