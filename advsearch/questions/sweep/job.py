"""Sweeps. Here: what one is asked for, found and loaded: scenes, models, controls and axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from advsearch.attacks import Query
from advsearch.attacks.draws import Seeds
from advsearch.controls import Control, Space, make_control, make_space
from advsearch.described import Value
from advsearch.engine.journal import Sent
from advsearch.engine.judging import Looked, Metrics, check_truth, facts_of
from advsearch.engine.loading import Scene, framed
from advsearch.engine.objective import domain_of
from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.questions.sweep.axes import Axis, on_grid
from advsearch.questions.sweep.points import Drawn, Points
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.scene.description import ENVIRONMENT
from advsearch.scene.formation import next_count
from advsearch.tasks import Facts, Task
from advsearch.tasks.base import Truth

KIND = "sweep"
"""Rows of the sweep, and the stream of their seeds."""

SAMPLES = 100
"""Draws where there is no grid and nothing is said."""


@dataclass(frozen=True)
class NamedScene:
    """One of the scenes. Controls that are `held` stay where `u` (d,) has them, or as the scene is without it; `answer`
    is what the place is called beside the same one without the answer of a run, empty where there is no such."""

    object: str
    environment: str
    scene: Scene
    held: tuple[Control, ...] = ()
    u: Tensor | None = None
    answer: str = ""

    @property
    def values(self) -> dict[str, Value]:
        named: dict[str, Value] = {
            "object": {"value": self.object, "unit": ""},
            "environment": {"value": self.environment, "unit": ""},
        }
        return {**named, "answer": {"value": self.answer, "unit": ""}} if self.answer else named


@dataclass(frozen=True)
class Job:
    """Everything that was asked for, found and loaded: `controls` are drawn by chance; `aovs` are layers of ground
    truth that are kept of every picture of the first model (`scene.surfaces.AOVS`)."""

    config: SweepConfig
    places: tuple[NamedScene, ...]
    models: tuple[Model, ...]
    tasks: tuple[Task, ...]
    controls: tuple[Control, ...]
    axes: tuple[Axis, ...]
    aovs: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    metrics: Metrics = field(default_factory=dict)
    _bound: dict[int, dict[tuple[int, int], Points]] = field(default_factory=dict, init=False, repr=False)

    @property
    def samples(self) -> int:
        return self.config.samples or (SAMPLES if self.controls and not self.axes else 1)

    @cached_property
    def spp(self) -> int:
        """Samples a pixel, as the sampler has them."""
        return next_count(self.config.pixel_sampler, self.config.search_spp)

    @cached_property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        """(height, width) of the pictures for each model."""
        return tuple(self.config.resolution or model.input_size for model in self.models)

    @cached_property
    def first_of_size(self) -> tuple[bool, ...]:
        """Of each model, whether no model before it is shown the same pictures."""
        return tuple(size not in self.sizes[:model] for model, size in enumerate(self.sizes))

    # ---- what is asked ----------------------------------------------------------------------------------------------

    @cached_property
    def per_scene(self) -> int:
        """Pictures of a scene."""
        return next(iter(self.bound(0).values())).count

    @cached_property
    def seeds(self) -> Seeds:
        """Of the noise of draws."""
        return Seeds(self.config.seed, KIND)

    def bound(self, scene: int) -> dict[tuple[int, int], Points]:
        """The configurations of a scene for each size of picture; those of the last scene are held."""
        if scene not in self._bound:
            self._bound.clear()
            spaces = self.spaces(self.places[scene])
            self._bound[scene] = {size: self.points(space) for size, space in spaces.items()}
        return self._bound[scene]

    def queries(self, numbers: range) -> list[Sent]:
        """Ask all models about the pictures with these numbers, all of one scene, whose number is the name."""
        scene = numbers.start // self.per_scene
        before, models = scene * self.per_scene, len(self.models)
        place, keep = self.places[scene], self.config.keep_pictures != "none"
        held, found = {control.name for control in place.held}, list[Sent]()
        picked: dict[tuple[int, int], tuple[Tensor, list[dict[str, Value]]]] = {}
        for size, points in self.bound(scene).items():
            picks = points.picks(numbers.start - before, len(numbers), before)
            u = points.configurations(picks)
            picked[size] = u, points.values(u, picks)
        for k, number in enumerate(numbers):
            for model, size in enumerate(self.sizes):
                points, (u, values) = self.bound(scene)[size], picked[size]
                said, lit_by = place.values, points.lit_by(values[k])
                if lit_by is not None:
                    said["environment"] = {"value": lit_by, "unit": ""}
                said["model"] = {"value": self.models[model].name, "unit": ""}
                said |= {name: value for name, value in values[k].items() if name.partition(".")[0] not in held}
                seed, step = self.seeds(points.noise(number)), number * models + model
                query = Query(
                    u[k].clone(), seed, KIND, step, spp=self.spp, drawn=False, values=said, sought=False, keep=keep
                )
                found.append((str(scene), None, query))
        return found

    def spaces(self, place: NamedScene) -> dict[tuple[int, int], Space]:
        return {size: self.space(place, size) for size in dict.fromkeys(self.sizes)}

    def space(self, place: NamedScene, size: tuple[int, int]) -> Space:
        """The controls, those of the grid as choices, bound to a scene."""
        description = framed(place.scene.description, size)
        controls = (*place.held, *on_grid(self.controls, self.axes, description))
        if not controls:
            return Space((), None)
        space = make_space(controls, description)
        if not place.held:
            return space
        start = torch.cat([bound.start for bound in space.controls[: len(place.held)]])
        if place.u is not None and len(place.u) != len(start):
            raise InputError(
                f"answer_of: the answer of {place.answer} has {len(place.u)} numbers, and {place.object} takes "
                f"{len(start)}: it is another object, or it has changed since; do the run again"
            )
        return space.holding(start if place.u is None else place.u)

    def points(self, space: Space) -> Points:
        """The configurations of a space; those with an answer have the draws of those without it."""
        scenes = len(self.places) // 2 if self.places[0].answer else 0
        domain = domain_of(space.controls)
        among, config = len(self.places), self.config
        return Points(space, domain, self.axes, self.samples, config.sampler, config.seed, scenes, among)

    def truth(self, place: NamedScene, model: int, values: Mapping[str, Value], look: Looked | None = None) -> Truth:
        """What is true of a configuration, by what is described and seen of it, as the task of a model needs it."""
        return self.tasks[model].truth(self._facts(place, values, look))

    def _facts(self, place: NamedScene, values: Mapping[str, Value], look: Looked | None = None) -> Facts:
        return facts_of(place.scene, place.object, self.config, lambda: values, look)

    def check_truths(self, place: NamedScene) -> None:
        for task, model in zip(self.tasks, self.models, strict=True):
            check_truth(task, model, place.scene, self._facts(place, {}), self.config)


def check_scenes(places: Sequence[NamedScene], controls: Sequence[Control], axes: Sequence[Axis]) -> None:
    """Refuse to vary what the scenes were asked to have."""
    given = {name for place in places for name in place.scene.description.given}
    drawn = {control.name: control for control in controls}
    varied = {
        axis: drawn.get(axis.instance)
        or make_control(axis.instance, {"kind": axis.control, axis.parameter.name: axis.values[0]})
        for axis in axes
    }
    settings = {axis: control.setting(axis.parameter) for axis, control in varied.items()}
    for axis, setting in settings.items():
        if setting in given and setting != ENVIRONMENT:
            raise InputError(f"`grid` {axis.name}: `set` fixes it already; leave it out of one of the two")
    environments = list(dict.fromkeys(place.environment for place in places))
    choosing = [f"`grid` {axis.name}" for axis, setting in settings.items() if setting == ENVIRONMENT]
    choosing += [
        f"`controls` {control.name}"
        for control in controls
        for parameter in control.parameters
        if control.setting(parameter) == ENVIRONMENT and parameter.name in control.settings()
    ]
    if len(environments) > 1 and choosing:
        raise InputError(
            f"`environment={','.join(environments)}` and {choosing[0]} both choose what lights the scene; name all of "
            "them in one of the two, and leave the other out"
        )


def check_all(job: Job) -> tuple[Points, tuple[Drawn, ...]]:
    """Bind every scene once, so that what is wrong is said before anything is rendered. Returns the points of the first
    scene, and what the table shows of the draws: shares of the range where scenes, or pictures of different shapes,
    have different ones."""
    bound = []
    for place in job.places:
        spaces = list(job.spaces(place).values())
        _check_draws(place, spaces[0])
        bound += [(place, job.points(space)) for space in spaces]
        job.check_truths(place)
    first = bound[0][1]
    for place, points in bound:
        if points.drawn_numbers != first.drawn_numbers:
            raise InputError(
                f"`object` {place.object}: its controls draw other numbers than those of {job.places[0].object}; sweep "
                "the two by themselves"
            )
    drawn = []
    for versions in zip(*(points.drawn for _, points in bound), strict=True):
        same = all(one.parts == versions[0].parts for one in versions)
        shares = tuple([k / first.parts, (k + 1) / first.parts] for k in range(first.parts))
        drawn.append(versions[0] if same else replace(versions[0], unit="of its range", parts=shares, settled=False))
    return first, tuple(drawn)


def _check_draws(place: NamedScene, space: Space) -> None:
    for group in space.groups:
        if group.setting in place.scene.description.given - {ENVIRONMENT}:
            raise InputError(
                f"`controls` {group.control}: draws {group.parameter} by chance, and `set` {group.setting} fixes it; "
                "leave it out of one of the two"
            )
