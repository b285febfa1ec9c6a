"""Searches over base colours by a matrix of light transport, and how far its pictures are from traced ones.

The evaluations of the search itself are predicted; the renders of the ranking after it and all trials trace paths.
Every `EVERY` evaluations the present configuration and that of the matrix are traced with one seed: where the change
between them is predicted wrongly by more than `BOUND`, the matrix is made anew at the present one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.evaluation import Wanted
from advsearch.engine.problem import OnImage, Problem
from advsearch.scene.transport.renderer import LinearRenderer, samples_to_collect, why_not

WORTH = 16
"""Evaluations from which a search pays for the matrix, which costs as much as some 6 rendered ones with gradients
(`benchmarks/transport.py`)."""
EVERY = 20
BOUND = 2.0
"""Levels of 255, root mean square over the picture. On the bundled mug a matrix made anew at 1.7 levels, half way
through 40 evaluations, moved the verified margin by 0.1 of 28 logits, for as long as all of them take."""
CHECK_SPP = 64
"""Samples a pixel of the traced pictures of a comparison."""
Tick = Callable[[int], None]


@dataclass(frozen=True)
class Deviation:
    """How far the prediction of one configuration is from what paths show.

    Attributes:
        levels: root mean square difference between the predicted and the traced change of the picture since the matrix
            was made, in levels of 255; both traced pictures have the same noise, most of which drops out.
        logits: predicted minus traced objective.
    """

    levels: float
    logits: float


def reason_against(problem: Problem, steps: int, specialise: bool) -> str | None:
    """Why a search renders instead of predicting, in words; None if it predicts."""
    if not specialise:
        return "nothing is left out"
    if problem.conditions is not None:
        return "conditions vary by chance"
    if steps < WORTH:
        return f"a matrix pays from {WORTH} evaluations on"
    return why_not(problem.renderer)


@dataclass(frozen=True, eq=False)
class Linearised:
    """A matrix and where it was made.

    Attributes:
        u: the configuration.
        index: of the evaluation there.
        renderer: None until it is needed, where a run goes on.
    """

    u: Tensor
    index: int
    renderer: LinearRenderer | None = None


@dataclass
class Transport:
    """The matrices of a run's searches.

    Attributes:
        problem: what is searched.
        steps: evaluations of a search; what comes after them belongs to the ranking, and is traced.
        renewals: by kind of search, the evaluations at which the matrix was made anew; may be filled before a search
            that goes on.
        deviations: what the comparisons found, in order.
        keep: told of `renewals` whenever there is another one.
        seconds: spent on making matrices and on comparing.
    """

    problem: Problem
    steps: int
    renewals: dict[str, list[int]] = field(default_factory=dict)
    keep: Callable[[dict[str, list[int]]], None] = lambda renewals: None
    deviations: list[Deviation] = field(default_factory=list)
    seconds: float = 0.0
    _start: Linearised | None = None
    _present: dict[str, Linearised] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        """Samples a pixel that making the matrices takes."""
        return samples_to_collect(self.problem.renderer)

    def prepare(self, tick: Tick = lambda samples: None) -> None:
        """Make the matrices at the start of the search; told of samples a pixel as they are traced."""
        self._start = self._made(self.problem.domain.start, "start", 0, tick)

    @property
    def start(self) -> LinearRenderer:
        """Where every search begins."""
        return self._ready(self._begin, "start")[1]

    @property
    def _begin(self) -> Linearised:
        if self._start is None:
            self.prepare()
        assert self._start is not None
        return self._start

    def passed(self, kind: str, index: int, u: Tensor) -> None:
        """Remember an evaluation that was read back: it may be one at which the matrix was made anew."""
        if index in self.renewals.get(kind, ()):
            self._present[kind] = Linearised(u.detach().clone(), index)

    def evaluator(self, kind: str, on_image: OnImage | None = None) -> Evaluate:
        """Return the evaluation of configurations of one search."""
        traced = self.problem.evaluator(kind, on_image)

        def evaluate(u: Tensor, *, index: int, gradient: Wanted, samples: int = 1) -> Evaluation:
            if index >= self.steps:
                return traced(u, index=index, gradient=gradient, samples=samples)
            renderer = self._compared(kind, index, u)
            noise = seeds.stream(self.problem.seed, kind, index)
            return self.problem.evaluated(u, noise, index, gradient, samples, on_image, renderer)[0]

        return evaluate

    def _compared(self, kind: str, index: int, u: Tensor) -> LinearRenderer:
        """The matrix to predict this evaluation with, compared and made anew where that is due."""
        present, renderer = self._ready(self._present.get(kind, self._begin), kind)
        if index and index % EVERY == 0 and kind.startswith("search"):
            found = self.deviation(renderer, present.u, u, index)
            self.deviations.append(found)
            if found.levels > BOUND:
                present = self._made(u, kind, index)
                self.renewals.setdefault(kind, []).append(index)
                self.keep(self.renewals)
        self._present[kind], renderer = self._ready(present, kind)
        return renderer

    def _ready(self, place: Linearised, kind: str) -> tuple[Linearised, LinearRenderer]:
        made = place if place.renderer is not None else self._made(place.u, kind, place.index)
        assert made.renderer is not None
        return made, made.renderer

    def _made(self, u: Tensor, kind: str, index: int, tick: Tick = lambda samples: None) -> Linearised:
        begun = time.perf_counter()
        seed = seeds.stream(self.problem.seed, f"transport {kind}", index)
        made = LinearRenderer(self.problem.renderer, u, seed, tick)
        self.seconds += time.perf_counter() - begun
        return Linearised(u.detach().clone(), index, made)

    def deviation(self, linear: LinearRenderer, at: Tensor, u: Tensor, index: int) -> Deviation:
        """Compare what a prediction says of the change since its matrix was made at `at` with what two traced pictures
        do."""
        begun, problem = time.perf_counter(), self.problem
        seed = seeds.stream(problem.seed, "transport check", index)
        with torch.no_grad():
            before, after = (problem.renderer(one, seed=seed, spp=CHECK_SPP) for one in (at, u))
            predicted = linear(u)
            off = float((((predicted - linear(at)) - (after - before)) ** 2).mean())
            logits = float(problem.loss(predicted) - problem.loss(after))
        self.seconds += time.perf_counter() - begun
        return Deviation(255.0 * math.sqrt(off), logits)
