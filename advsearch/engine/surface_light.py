"""Searches in which cameras move, by light kept on surfaces (docs/surface-light.md).
Pictures are traced beside predicted ones: where these are too far off, the light is
found anew for the present base colours, if they are searched; the second time in a row
pictures are traced from there on, or predicted by matrices.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluate, Evaluation, Policy
from advsearch.attacks.evaluation import Query
from advsearch.engine.acceptance import VIEWS, ComparedView, Deviation
from advsearch.engine.bank import stratified
from advsearch.engine.problem import Problem
from advsearch.engine.transport import PredictedSearch
from advsearch.runs.results import BankOfConditions
from advsearch.scene.color import to_8_bit
from advsearch.scene.mitsuba_backend.surface import RAYS
from advsearch.scene.predictor import Refusal, RefusalCause
from advsearch.scene.surface import renderer as surface_renderer
from advsearch.scene.surface.arrangement import CAMERAS, COLOR, MAP
from advsearch.scene.surface.renderer import Look, Sketch, SurfaceRenderer
from advsearch.scene.transport.matrix import Tick

WORTH = 32
"""Pictures of a search from which on the light pays: it and a comparison take as long
as some 25 rendered ones, or 45 where the first views do not decide.
"""
# where light on surfaces has no advantage
NO_CAMERA = Refusal("no camera moves", RefusalCause.NO_CAMERA)
LIGHTS = 64  # environments in the bank, where they vary
EVERY = 100
TOGETHER = 8  # pictures that the model is asked about at once
AGAIN = 4
"""Evaluations of a random search from which on cameras and environments come again:
nothing learns from them, and what each camera sees is known then.
"""


def refusal_of_surface_light(
    problem: Problem, steps: int, policy: Policy[Any], specialise: bool
) -> Refusal | None:
    """Return why light on surfaces does not predict a search; None if it may: how far
    it is off is measured then.
    """
    if not specialise:
        return Refusal("nothing is left out")
    if problem.renderer.composed:
        return Refusal(problem.renderer.composed)
    names = [control.name for control in problem.space.controls]
    if not surface_renderer.varied(problem.renderer, names) & CAMERAS:
        return NO_CAMERA
    if steps * problem.draws < WORTH:
        return Refusal(
            f"light on surfaces pays from {WORTH} pictures on",
            RefusalCause.TOO_FEW_STEPS,
        )
    if policy.takes_differences(problem.domain, steps):
        return Refusal(f"{policy.name} takes derivatives that need rendered pictures")
    for group in problem.plan.groups:
        if group.is_forced and group.estimator not in ("none", "image"):
            return Refusal(f"the estimator of {group.name} is forced")
    return surface_renderer.why_not(problem.renderer, names)


@dataclass
class SurfaceLight(PredictedSearch):
    """The light on surfaces of a run whose searches look through many cameras, found
    `at` (d,), or at the start. The numbers of u at `places` move, without these those
    of cameras and environments.
    """

    way: ClassVar[str] = "surface light"
    at: Tensor | None = None
    places: Tensor | None = None
    _renderer: SurfaceRenderer | None = None
    _lights: list[Tensor] = field(default_factory=list)
    _made: int = 0
    _next: int = 0
    _looks: dict[tuple[int, int], list[Look]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """See what numbers of the whole space change."""
        problem = self.problem
        renderer = self.problem.renderer
        searched = problem.domain.dim
        space = problem.space
        changes = {
            control.name: surface_renderer.varied(renderer, [control.name])
            for control in space.controls
        }

        def changing(inputs: frozenset[str]) -> Tensor:
            which = torch.zeros(len(space.start), dtype=torch.bool)
            for group in space.groups:
                which[group.coordinates] = bool(changes[group.control] & inputs)
            return which

        self._moving = changing(CAMERAS | {MAP})[:searched]
        if self.places is not None:
            self._moving = torch.zeros(searched, dtype=torch.bool).index_fill_(
                0, self.places, True
            )
        self._moves = bool(self._moving.any())
        self._colored = bool(changing(frozenset({COLOR}))[:searched].any())
        self.drawn = problem.conditions is not None and self._colored
        # what is asked for inputs: without the base colour, where the searched controls
        # set nothing else
        self._asked = (
            space
            if self._moves
            else replace(space, controls=space.controls[problem.searched or 0 :])
        )
        # of the conditions, what takes another light, and not only a brighter one
        of_light = changing(frozenset({MAP}))
        start = problem.whole(problem.domain.start)
        for group in space.groups if problem.conditions is not None else ():
            if bool(of_light[group.coordinates].all()):
                low = start.clone()
                high = start.clone()
                low[group.coordinates], high[group.coordinates] = 0.3, 0.8
                darker, brighter = (
                    Sketch.of(self._inputs(whole)[MAP]) for whole in (low, high)
                )
                of_light[group.coordinates] = darker.times(brighter) is None
        self._of_light = of_light[searched:]

    @property
    def samples(self) -> int:
        return LIGHTS

    def conditions(self) -> BankOfConditions | None:
        if self.problem.conditions is None:
            return None
        return BankOfConditions(
            made=self._made, dropped=self.renderer.dropped, grown=0, gap=None
        )

    def size(self) -> tuple[int, int]:
        return self.renderer.entries, self.renderer.bytes

    @property
    def too_far_off(self) -> Refusal | None:
        first = self.deviations[0] if self.deviations else None
        return (
            None
            if first is None or first.good
            else Refusal(f"light on surfaces is {first.reason}")
        )

    def predicted(self, kind: str, evaluations: int) -> int:
        if "search" in self.ends and kind != "search":
            # another search is later, and is traced from its first evaluation on
            return 0
        return super().predicted(kind, evaluations)

    def prepare(self, tick: Tick = lambda samples: None) -> None:
        """Find the light, under every environment of the bank, and see how far its
        pictures are off.
        """
        problem = self.problem
        at = problem.domain.start if self.at is None else self.at
        with self.timed(), torch.no_grad():
            start = problem.whole(at)
            self._renderer = SurfaceRenderer(
                problem.renderer, start, seeds.stream(problem.seed, "surface light")
            )
            self._lights = [start[problem.domain.dim :]]
            if problem.conditions is not None:
                seed = seeds.stream(problem.seed, "bank")
                count = LIGHTS if bool(self._of_light.any()) else 1
                self._lights = [
                    stratified(problem.conditions, number, seed)
                    for number in range(count)
                ]
            for numbers in self._lights:
                self._renderer.kept_light(self._inputs(torch.cat([at, numbers])))
                tick(LIGHTS // len(self._lights))
            self._made = len(self._renderer.lights_kept) + self._renderer.dropped
        self._compare(at, 0)

    @property
    def renderer(self) -> SurfaceRenderer:
        if self._renderer is None:
            self.prepare()
        assert self._renderer is not None
        return self._renderer

    def evaluate_all(
        self, queries: Sequence[Query], traced: Evaluate
    ) -> Iterator[Evaluation]:
        """Answer queries of one search, or trials, by what else answers them from the
        first that is not predicted.
        """
        ahead: dict[int, Tensor] = {}
        for place, query in enumerate(queries):
            self.passed(query)
            differences = (
                query.gradient is True and self.problem.domain.gradient_cost > 0
            )
            if (
                differences
                or self.predicted(query.kind, query.number + 1) <= query.number
            ):
                yield from traced(queries[place:])
                return
            if (
                place not in ahead
                and self.problem.conditions is None
                and not self._colored
            ):
                us = [
                    later.u for later in queries[place : place + self.renderer.at_once]
                ]
                ahead = dict(enumerate(self.renderer.pictures(us), place))
            yield self.evaluate(query, ahead.get(place))

    def evaluate(self, query: Query, picture: Tensor | None = None) -> Evaluation:
        """Answer a query; its picture (H, W, 3) may be there already."""
        problem = self.problem
        if query.phase is None:
            whole = problem.whole(query.u)
            with torch.no_grad():
                shown = to_8_bit(self.renderer(whole) if picture is None else picture)
            kept = shown if query.keep else None
            return Evaluation.of(
                problem.judge(shown, whole), cost=0, predicted=RAYS, picture=kept
            )
        if picture is not None:
            ((evaluation, _),), _ = problem.judged(
                lambda at: picture[None], [query.u], query.u, False
            )
            kept = to_8_bit(picture) if query.keep else None
            return replace(evaluation, cost=query.samples, predicted=RAYS, picture=kept)
        again = (
            query.kind == "baseline"
            and problem.conditions is not None
            and not self._moves
        )
        number = query.number % AGAIN if again else query.number
        wholes = [
            torch.cat([query.u, numbers])
            for numbers in self._drawn(query.kind, number, problem.draws)
        ]

        def predicted(some: slice, at: Tensor) -> Tensor:
            return self._pictures(
                wholes[some], at, (number, some.start) if again else None
            )

        evaluation = problem.mean_under(
            predicted, wholes, query.u, query.gradient, TOGETHER
        )
        evaluation = replace(evaluation, cost=query.samples, predicted=RAYS)
        if not query.keep:
            return evaluation
        with torch.no_grad():
            return replace(
                evaluation,
                picture=to_8_bit(self._pictures([problem.whole(query.u)], query.u)[0]),
            )

    def _drawn(self, kind: str, number: int, count: int) -> list[Tensor]:
        """The conditions of an evaluation: fresh cameras under environments of the
        bank.
        """
        problem = self.problem
        if problem.conditions is None:
            return self._lights * count
        generator = torch.Generator().manual_seed(
            seeds.stream(problem.seed, f"surface {kind}", number)
        )
        order = torch.randint(len(self._lights), (count,), generator=generator).tolist()
        fresh = problem.conditions.sample(generator, count)
        lights = [self._lights[number] for number in order]
        return [
            torch.where(self._of_light, *both)
            for both in zip(lights, fresh, strict=True)
        ]

    def _inputs(self, whole: Tensor) -> dict[str, Tensor]:
        """What a configuration of the whole space sets in the scene; without the base
        colour, where the searched controls set nothing else.
        """
        with torch.no_grad():
            inputs = self._asked.inputs(whole[len(whole) - len(self._asked.start) :])
            return self.problem.renderer.scene.assembly(inputs)

    def _pictures(
        self, wholes: Sequence[Tensor], u: Tensor, key: tuple[int, int] | None = None
    ) -> Tensor:
        """Return pictures (n, H, W, 3) of u under conditions, with a graph. What the
        cameras of a key see is kept.
        """
        color = self.renderer.color(self.problem.searched_space.inputs(u))
        places = [torch.cat([u, whole[len(u) :]]) for whole in wholes]
        inputs = [self._inputs(whole) for whole in wholes]
        if key is not None and key not in self._looks:
            self._looks[key] = list(self.renderer.looks(inputs))
        looks = self.renderer.looks(inputs) if key is None else self._looks[key]
        return self.renderer.shown(looks, inputs, color, places)

    def passed(self, query: Query) -> None:
        """Compare where that is due: every `EVERY` evaluations where base colours are
        searched, as their light gets old; otherwise after twice as many each time,
        until predictions are too far off.
        """
        due = (
            query.kind == "search"
            and query.phase == "search"
            and query.number >= (self._next or EVERY)
        )
        if not due or self.given_up:
            return
        before = self.deviations[-1].good
        good = self._compare(query.u, query.number).good
        self._next = query.number + (
            query.number if good and not self._colored else EVERY
        )
        if not good and not before:
            self.give_up("search", query.number)
        elif not good and self._colored:
            with self.timed():
                self.renderer.renew(self.problem.whole(query.u))
            self.renewed = (self.renewed or 0) + 1

    def _compare(self, u: Tensor, index: int) -> Deviation:
        """Compare predicted pictures with traced ones, and keep what was found. The
        first is that of u; in the others, searched cameras and environments are
        anywhere.
        """
        problem = self.problem
        kind = "surface check"
        seed = seeds.stream(problem.seed, kind, index)
        with self.timed():
            elsewhere = problem.domain.sample(
                torch.Generator().manual_seed(seed), VIEWS
            )
            places = torch.where(self._moving, elsewhere, u)
            places[0] = u
            wholes = [
                torch.cat(both)
                for both in zip(places, self._drawn(kind, index, VIEWS), strict=True)
            ]
            drawn = self._moving if self._colored else torch.ones_like(self._moving)

        def view(number: int) -> ComparedView:
            noise = seeds.stream(seed, "view", number)
            return problem.view(
                self.renderer, wholes[number], noise, problem.spp, drawn=drawn
            )

        return self.compare(view)
