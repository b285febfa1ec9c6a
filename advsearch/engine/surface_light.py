"""Searches in which cameras move, by light kept on surfaces (docs/surface-light.md). Pictures are traced beside
predicted ones: where these are too far off, the light is found anew for the present base colours, if they are searched;
the second time in a row pictures are traced from there on, or predicted by matrices."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluate, Evaluation, Policy
from advsearch.attacks.evaluation import Query
from advsearch.controls import Space
from advsearch.engine.acceptance import VIEWS, ComparedView, Deviation, compared
from advsearch.engine.bank import stratified
from advsearch.engine.problem import Problem
from advsearch.engine.transport import Conditions, Predictor, Tick
from advsearch.scene.formation import to_8_bit
from advsearch.scene.mitsuba_backend.surface import RAYS
from advsearch.scene.surface import renderer as surface_renderer
from advsearch.scene.surface.arrangement import CAMERAS, COLOR, MAP
from advsearch.scene.surface.renderer import Look, Sketch, SurfaceRenderer

WORTH = 32
"""Pictures of a search from which on the light pays: it and a comparison take as long as some 25 rendered ones, or 45
where the first views do not decide."""
NO_CAMERA = "no camera moves"
"""The reason where light on surfaces has no advantage."""
LIGHTS = 64
"""Environments in the bank, where they vary."""
EVERY = 100
TOGETHER = 8
"""Pictures that the model is asked about at once."""
AGAIN = 4
"""Evaluations of a random search from which on cameras and environments come again: nothing learns from them, and what
each camera sees is known then."""


def reason_against(problem: Problem, steps: int, policy: Policy[Any], specialise: bool) -> str | None:
    """Why light on surfaces does not predict a search, in words; None if it may: how far it is off is measured then."""
    if not specialise:
        return "nothing is left out"
    names = [one.name for one in problem.space.controls]
    if not surface_renderer.varied(problem.renderer, names) & CAMERAS:
        return NO_CAMERA
    if steps * problem.draws < WORTH:
        return f"light on surfaces pays from {WORTH} pictures on"
    if policy.takes_differences(problem.domain, steps):
        return f"{policy.name} takes derivatives that need rendered pictures"
    for group in problem.plan.groups:
        if "forced" in group.reason and group.estimator not in ("none", "image"):
            return f"the estimator of {group.name} is forced"
    return surface_renderer.why_not(problem.renderer, names)


@dataclass
class SurfaceLight(Predictor):
    """The light on surfaces of a run whose searches look through many cameras, found `at` (d,), or at the start. What
    comes after `steps` evaluations of a search belongs to the ranking, and is traced. The numbers of u at `places`
    move, without these those of cameras and environments. Light was found anew at the evaluations `renewals`; from
    `ended` on pictures are traced."""

    way: ClassVar[str] = "surface light"
    problem: Problem
    steps: int
    at: Tensor | None = None
    places: Tensor | None = None
    deviations: list[Deviation] = field(default_factory=list)
    renewals: list[int] = field(default_factory=list)
    ended: int | None = None
    seconds: float = 0.0
    _renderer: SurfaceRenderer | None = None
    _lights: list[Tensor] = field(default_factory=list)
    _made: int = 0
    _next: int = 0
    _looks: dict[tuple[int, int], list[Look]] = field(default_factory=dict)

    # ---- what a predictor says --------------------------------------------------------------------------------------

    @property
    def samples(self) -> int:
        return LIGHTS

    @property
    def conditions(self) -> Conditions | None:
        if self.problem.conditions is None:
            return None
        return Conditions(self._made, self._renderer.dropped if self._renderer else 0, 0, None)

    @property
    def drawn(self) -> bool:
        return self.problem.conditions is not None and self._colored

    @property
    def renewed(self) -> int:
        return len(self.renewals)

    @property
    def traced(self) -> int:
        return sum(one.pictures for one in self.deviations)

    @property
    def given_up(self) -> str | None:
        if self.ended is None:
            return None
        return f"pictures are rendered from evaluation {self.ended} on: predicted ones were too far off"

    def predicted(self, kind: str, evaluations: int) -> int:
        return evaluations if (end := self._end(kind)) is None else min(evaluations, end)

    def _end(self, kind: str) -> int | None:
        """The evaluation of a search from which on pictures are traced: the first, where an earlier search gave up."""
        return self.ended if kind == "search" or self.ended is None else 0

    def size(self) -> tuple[int, int]:
        return self.renderer.entries, self.renderer.bytes

    def prepare(self, tick: Tick = lambda samples: None) -> None:
        """Find the light, under every environment of the bank, and see how far its pictures are off."""
        begun, problem = time.perf_counter(), self.problem
        at = problem.domain.start if self.at is None else self.at
        start = problem.whole(at)
        self._renderer = SurfaceRenderer(problem.renderer, start, seeds.stream(problem.seed, "surface light"))
        self._lights = [start[problem.domain.dim :]]
        if problem.conditions is not None:
            seed, count = seeds.stream(problem.seed, "bank"), LIGHTS if bool(self._of_light.any()) else 1
            self._lights = [stratified(problem.conditions, number, seed) for number in range(count)]
        with torch.no_grad():
            for numbers in self._lights:
                self.renderer.kept_light(self._inputs(torch.cat([at, numbers])))
                tick(LIGHTS // len(self._lights))
        self._made = len(self._renderer.lights) + self._renderer.dropped
        self.seconds += time.perf_counter() - begun
        self._compare(at, 0)

    @cached_property
    def _moving(self) -> Tensor:
        """(d,) which numbers of u move."""
        if self.places is not None:
            return torch.zeros(self.problem.domain.dim, dtype=torch.bool).index_fill_(0, self.places, True)
        return self._changing(CAMERAS | {MAP})[: self.problem.domain.dim]

    @cached_property
    def _colored(self) -> bool:
        return bool(self._changing(frozenset({COLOR}))[: self.problem.domain.dim].any())

    @cached_property
    def _of_light(self) -> Tensor:
        """(k,) which numbers of the conditions take another light, and not only a brighter one."""
        problem = self.problem
        found, start = self._changing(frozenset({MAP})), problem.whole(problem.domain.start)
        for group in problem.space.groups:
            if bool(found[group.coordinates].all()):
                one, other = start.clone(), start.clone()
                one[group.coordinates], other[group.coordinates] = 0.3, 0.8
                sketches = [Sketch.of(self._inputs(at)[MAP]) for at in (one, other)]
                found[group.coordinates] = sketches[0].times(sketches[1]) is None
        return found[problem.domain.dim :]

    def _changing(self, inputs: frozenset[str]) -> Tensor:
        """Which numbers of the whole space belong to controls that change some inputs of the scene."""
        space = self.problem.space
        found = torch.zeros(len(space.start), dtype=torch.bool)
        renderer = self.problem.renderer
        names = {one.name for one in space.controls if inputs & surface_renderer.varied(renderer, [one.name])}
        for group in space.groups:
            found[group.coordinates] = group.control in names
        return found

    @property
    def renderer(self) -> SurfaceRenderer:
        if self._renderer is None:
            self.prepare()
        assert self._renderer is not None
        return self._renderer

    @property
    def too_far_off(self) -> str | None:
        """Why it predicts nothing, from the comparison before the search, in words."""
        first = self.deviations[0] if self.deviations else None
        return None if first is None or first.good else f"light on surfaces is {first.reason}"

    def passed(self, query: Query) -> None:
        self._come_to(query)

    def answered(self, queries: Sequence[Query], traced: Evaluate) -> Iterator[Evaluation]:
        """Answer queries of one search, or trials, by what else answers them from the first that is not predicted."""
        ahead: dict[int, Tensor] = {}
        for place, query in enumerate(queries):
            self._come_to(query)
            end = self._end(query.kind)
            differences = query.gradient is True and self.problem.domain.gradient_cost > 0
            if differences or (end is not None and query.number >= end):
                yield from traced(queries[place:])
                return
            if place not in ahead and self.problem.conditions is None and not self._colored:
                ahead = self._ahead(queries, place)
            yield self.evaluate(query, ahead.get(place))

    def _ahead(self, queries: Sequence[Query], place: int) -> dict[int, Tensor]:
        some = [one.u for one in queries[place : place + self.renderer.at_once]]
        with torch.no_grad():
            pictures = self.renderer.pictures([self._inputs(u) for u in some], self.renderer.there, some)
        return dict(enumerate(pictures, place))

    def evaluate(self, query: Query, picture: Tensor | None = None) -> Evaluation:
        """Answer a query; its picture (H, W, 3) may be there already."""
        if query.phase is None:
            whole = self.problem.whole(query.u)
            with torch.no_grad():
                shown = to_8_bit(self.renderer(whole) if picture is None else picture)
            said = self.problem.judge(shown, whole)
            return Evaluation.of(said, cost=0, predicted=RAYS, picture=shown if query.keep else None)
        if picture is not None:
            ((answer, _),), _ = self.problem.judged(lambda at: picture[None], [query.u], query.u, False)
            kept = to_8_bit(picture) if query.keep else None
            return replace(answer, cost=query.samples, predicted=RAYS, picture=kept)
        again = query.kind == "baseline" and self.problem.conditions is not None and not self._moves
        number = query.number % AGAIN if again else query.number
        drawn = self._drawn(replace(query, number=number), self.problem.draws)
        wholes = [torch.cat([query.u, numbers]) for numbers in drawn]
        answer = self.problem.mean_under(
            lambda some, at: self._pictures(wholes[some], at, (number, some.start) if again else None),
            wholes,
            query.u,
            query.gradient,
            TOGETHER,
        )
        answer = replace(answer, cost=query.samples, predicted=RAYS)
        if not query.keep:
            return answer
        with torch.no_grad():
            return replace(answer, picture=to_8_bit(self._pictures([self.problem.whole(query.u)], query.u)[0]))

    # ---- evaluations ------------------------------------------------------------------------------------------------

    def _drawn(self, query: Query, count: int) -> list[Tensor]:
        """The conditions of an evaluation: fresh cameras under environments of the bank."""
        problem = self.problem
        if problem.conditions is None:
            return self._lights * count
        generator = torch.Generator().manual_seed(seeds.stream(problem.seed, f"surface {query.kind}", query.number))
        order = torch.randint(len(self._lights), (count,), generator=generator).tolist()
        fresh = problem.conditions.sample(generator, count)
        lights = [self._lights[number] for number in order]
        return [torch.where(self._of_light, *both) for both in zip(lights, fresh, strict=True)]

    def _inputs(self, whole: Tensor) -> dict[str, Tensor]:
        """What a configuration of the whole space sets in the scene; without the base colour, where the searched
        controls set nothing else."""
        space, first = self._asked
        with torch.no_grad():
            return self.problem.renderer.scene.assembly(space.inputs(whole[first:]))

    @cached_property
    def _asked(self) -> tuple[Space, int]:
        """The controls that are asked for inputs, and the first of their numbers."""
        problem = self.problem
        if self._moves:
            return problem.space, 0
        return replace(problem.space, controls=problem.space.controls[problem.searched or 0 :]), problem.domain.dim

    @cached_property
    def _moves(self) -> bool:
        return bool(self._moving.any())

    def _pictures(self, wholes: Sequence[Tensor], u: Tensor, key: tuple[int, int] | None = None) -> Tensor:
        """Return pictures (n, H, W, 3) of u under conditions, with a graph. What the cameras of a key see is kept."""
        color = self.renderer.color(self.problem.searched_space.inputs(u))
        places = [torch.cat([u, whole[len(u) :]]) for whole in wholes]
        inputs = [self._inputs(one) for one in wholes]
        if key is None:
            return self.renderer.shown(self.renderer.looks(inputs), inputs, color, places)
        if key not in self._looks:
            self._looks[key] = list(self.renderer.looks(inputs))
        return self.renderer.shown(self._looks[key], inputs, color, places)

    # ---- comparisons ------------------------------------------------------------------------------------------------

    def _come_to(self, query: Query) -> None:
        """Compare where that is due: every `EVERY` evaluations where base colours are searched, as their light gets
        old; otherwise after twice as many each time, until predictions are too far off."""
        due = query.kind == "search" and query.phase == "search" and query.number >= (self._next or EVERY)
        if due and self.ended is None:
            before = self.deviations[-1]
            found = self._compare(query.u, query.number)
            self._next = query.number + (query.number if found.good and not self._colored else EVERY)
            if found.good:
                return
            if not before.good:
                self.ended = query.number
            if self.ended is not None or not self._colored:
                return
            begun = time.perf_counter()
            self.renderer.renew(self.problem.whole(query.u))
            self.renewals.append(query.number)
            self.seconds += time.perf_counter() - begun

    def _compare(self, u: Tensor, index: int) -> Deviation:
        """Compare predicted pictures with traced ones, and keep what was found. The first is that of u; in the others,
        searched cameras and environments are anywhere."""
        begun, problem = time.perf_counter(), self.problem
        query = Query(u, 0, kind="surface check", number=index)
        seed = seeds.stream(problem.seed, query.kind, index)
        elsewhere = problem.domain.sample(torch.Generator().manual_seed(seed), VIEWS)
        places = torch.where(self._moving, elsewhere, u)
        places[0] = u
        wholes = [torch.cat(both) for both in zip(places, self._drawn(query, VIEWS), strict=True)]

        drawn = self._moving if self._colored else torch.ones_like(self._moving)

        def view(number: int) -> ComparedView:
            seen = seeds.stream(seed, "view", number)
            return problem.view(self.renderer, wholes[number], seen, problem.spp, drawn=drawn)

        self.deviations.append(compared(view))
        self.seconds += time.perf_counter() - begun
        return self.deviations[-1]
