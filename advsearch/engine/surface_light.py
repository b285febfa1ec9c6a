"""Searches over base colours under cameras and environments that vary by chance, by light kept on surfaces.

Every evaluation looks through cameras that no evaluation has had before, under environments of a bank. Before the
search, and every `EVERY` evaluations, pictures are traced beside predicted ones. Where these are further off than two
levels, and than a rendered evaluation's own noise, the light is found anew for the present base colours; where that was
so the time before, too, or before the search, pictures are traced from there on, or predicted by matrices instead.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.engine.bank import stratified
from advsearch.engine.problem import Problem
from advsearch.engine.transport import BOUND, CHECK_SPP, Conditions, Deviation, Predictor, Tick
from advsearch.scene.formation import to_8_bit
from advsearch.scene.renderer import Renderer
from advsearch.scene.surface.arrangement import MAP
from advsearch.scene.surface.plan import varied
from advsearch.scene.surface.renderer import SurfaceRenderer

LIGHTS = 64
"""Environments in the bank, where they vary."""
EVERY = 100
COMPARED = 2
"""Pictures of a comparison."""
TOGETHER = 8
"""Pictures that the model is asked about at once."""


@dataclass
class SurfaceLight(Predictor):
    """The light on surfaces of a run whose searches look at conditions that vary by chance.

    Attributes:
        problem: what is searched.
        steps: evaluations of a search; what comes after them belongs to the ranking, and is traced.
        renewals: the evaluations at which light was found anew.
        ended: the evaluation from which on pictures are traced; None where they never are.
    """

    way: ClassVar[str] = "surface light"
    problem: Problem
    steps: int
    deviations: list[Deviation] = field(default_factory=list)
    renewals: list[int] = field(default_factory=list)
    ended: int | None = None
    seconds: float = 0.0
    _renderer: SurfaceRenderer | None = None
    _lights: list[Tensor] = field(default_factory=list)
    _compared: int = 0

    # ---- what a predictor says --------------------------------------------------------------------------------------

    @property
    def samples(self) -> int:
        return LIGHTS

    @property
    def conditions(self) -> Conditions:
        return Conditions(len(self._lights), self._renderer.dropped if self._renderer else 0, 0, None)

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
        return evaluations if self.ended is None else min(evaluations, self.ended)

    def size(self) -> tuple[int, int]:
        return self.renderer.entries, self.renderer.bytes

    def prepare(self, tick: Tick = lambda samples: None) -> None:
        """Find the light under every environment of the bank, and see how far its pictures are off."""
        begun, problem = time.perf_counter(), self.problem
        assert problem.conditions is not None
        start = problem.whole(problem.domain.start)
        self._renderer = SurfaceRenderer(problem.renderer, start, seeds.stream(problem.seed, "surface light"))
        self._conditions = replace(problem.space, controls=problem.space.controls[problem.searched :])
        names = [one.name for one in self._conditions.controls]
        of_light = [name for name in names if MAP in varied(problem.renderer, [name])]
        self._of_light = torch.zeros(len(problem.conditions.start), dtype=torch.bool)
        for group in self._conditions.groups:
            if group.control in of_light:
                self._of_light[group.coordinates] = True
        seed = seeds.stream(problem.seed, "bank")
        self._lights = [stratified(problem.conditions, number, seed) for number in range(LIGHTS if of_light else 1)]
        with torch.no_grad():
            for numbers in self._lights:
                self.renderer.light(self._inputs(numbers))
                tick(LIGHTS // len(self._lights))
        self.seconds += time.perf_counter() - begun
        self._compare(problem.domain.start, 0)

    @property
    def renderer(self) -> SurfaceRenderer:
        """What predicts pictures."""
        if self._renderer is None:
            self.prepare()
        assert self._renderer is not None
        return self._renderer

    @property
    def too_far_off(self) -> str | None:
        """Why it predicts nothing, from the comparison before the search, in words."""
        first = self.deviations[0] if self.deviations else None
        if first is None or first.levels <= first.most:
            return None
        return f"light on surfaces is {first.levels:.1f} levels of 255 off, where {first.most:.1f} would do"

    def passed(self, query: Query) -> None:
        self._come_to(query)

    def evaluate(self, query: Query) -> Evaluation:
        self._come_to(query)
        if self.ended is not None and query.number >= self.ended:
            return self.problem.evaluate(query)
        wholes = [torch.cat([query.u, numbers]) for numbers in self._drawn(query)]
        answer = self.problem.mean_under(
            lambda some, at: self._pictures(wholes[some], at), wholes, query.u, query.gradient, TOGETHER
        )
        if not query.keep:
            return answer
        with torch.no_grad():
            return replace(answer, picture=to_8_bit(self._pictures([self.problem.whole(query.u)], query.u)[0]))

    # ---- evaluations ------------------------------------------------------------------------------------------------

    def _drawn(self, query: Query) -> list[Tensor]:
        """The conditions of an evaluation: fresh cameras under environments of the bank."""
        problem, count = self.problem, self.problem.draws
        assert problem.conditions is not None
        generator = torch.Generator().manual_seed(seeds.stream(problem.seed, f"surface {query.kind}", query.number))
        order = torch.randint(len(self._lights), (count,), generator=generator).tolist()
        fresh = problem.conditions.sample(generator, count)
        lights = [self._lights[number] for number in order]
        return [torch.where(self._of_light, *both) for both in zip(lights, fresh, strict=True)]

    def _inputs(self, numbers: Tensor) -> dict[str, Tensor]:
        """What conditions set in the scene."""
        with torch.no_grad():
            return self.problem.renderer.scene.assembly(self._conditions.inputs(numbers))

    def _pictures(self, wholes: Sequence[Tensor], u: Tensor) -> Tensor:
        """Predicted pictures (n, H, W, 3) of u under conditions, with a graph."""
        own = self.problem.searched_space.inputs(u)
        given = [self._inputs(whole[len(u) :]) for whole in wholes]
        return self.renderer.pictures(given, self.renderer.color(own), [torch.cat([u, w[len(u) :]]) for w in wholes])

    # ---- comparisons ------------------------------------------------------------------------------------------------

    def _come_to(self, query: Query) -> None:
        """Compare where that is due."""
        due = query.kind == "search" and query.phase == "search" and query.number % EVERY == 0
        if due and query.number > self._compared and self.ended is None:
            self._compared = query.number
            before = self.deviations[-1]
            found = self._compare(query.u, query.number)
            if found.levels <= found.most:
                return
            if before.levels > before.most and self.renewals and self.renewals[-1] == query.number - EVERY:
                self.ended = query.number
                return
            begun = time.perf_counter()
            self.renderer.renew(self.problem.whole(query.u))
            self.renewals.append(query.number)
            self.seconds += time.perf_counter() - begun

    def _deviation(self, whole: Tensor, seed: int) -> Deviation:
        """Compare a predicted picture and a rendered one with traced ones."""
        problem, renderer = self.problem, self.problem.renderer
        with torch.no_grad():
            predicted, rendered = self.renderer(whole), renderer(whole, seeds.stream(seed, "rendered"), problem.spp)
            shown = renderer(whole, seeds.stream(seed, "shown"), CHECK_SPP)
        off, good = levels_off(renderer, (predicted, rendered), whole, seed, CHECK_SPP)
        values = [problem.judge(one, whole).objective or 0.0 for one in (predicted, shown)]
        return Deviation(off, values[0] - values[1], max(BOUND, good), pictures=4)

    def _compare(self, u: Tensor, index: int) -> Deviation:
        """Compare predicted pictures with traced ones under conditions, and keep what was found."""
        begun, problem = time.perf_counter(), self.problem
        query = Query(u, 0, kind="surface check", number=index)
        wholes = [torch.cat([u, one]) for one in self._drawn(query)[:COMPARED]]
        found = [self._deviation(whole, seeds.stream(problem.seed, query.kind, index)) for whole in wholes]
        self.deviations.append(over_all(found))
        self.seconds += time.perf_counter() - begun
        return self.deviations[-1]


def levels_off(renderer: Renderer, pictures: Sequence[Tensor], u: Tensor, seed: int, spp: int) -> list[float]:
    """Return how far pictures (H, W, 3) of a configuration are off, levels of 255.

    They are compared with two that are traced without the denoiser, which leaves its own marks in all that it is given.
    The mean product of the differences to both is the squared error without their noise, which a square would count.

    Args:
        renderer: the one that traces.
        pictures: to be compared.
        u: (d,) the configuration.
        seed: of the noise.
        spp: samples a pixel of each of the two.
    """
    undenoised = renderer.like(denoiser="none")
    with torch.no_grad():
        one, other = (undenoised(u, seeds.stream(seed, "traced", half), spp) for half in range(2))
    squares = [float(((picture - one) * (picture - other)).mean()) for picture in pictures]
    return [255.0 * math.sqrt(max(0.0, square)) for square in squares]


def over_all(found: Sequence[Deviation]) -> Deviation:
    """Return what several comparisons say together: of all pictures the root mean square difference, and the mean of
    what it may be."""
    return Deviation(
        levels=statistics.fmean(one.levels**2 for one in found) ** 0.5,
        logits=statistics.fmean(one.logits for one in found),
        most=statistics.fmean(one.most for one in found),
        pictures=sum(one.pictures for one in found),
    )
