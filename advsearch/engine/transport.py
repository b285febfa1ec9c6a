"""Searches over base colours and light by light transport, and how far its pictures are from traced ones. Every `EVERY`
evaluations predictions are compared with traced pictures: where they are too far off (`engine.acceptance`), the matrix
is made anew. The ranking and all trials trace paths."""

from __future__ import annotations

import math
import statistics
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.engine.acceptance import Deviation, compared
from advsearch.engine.problem import Problem
from advsearch.scene.formation import to_8_bit
from advsearch.scene.transport.lights import (
    HAZE,
    NOISE,
    BasisRenderer,
    lights_to_collect,
    predicting,
    samples_to_collect,
    why_not,
)
from advsearch.scene.transport.matrix import TOO_LARGE, PredictingRenderer

WORTH = 16
"""Evaluations from which a search pays for the matrix, which costs as much as some 6 rendered ones with gradients
(`benchmarks/transport.py`)."""
WORTH_A_LIGHT = 8
"""Evaluations for each light from which a search pays for its basis picture."""
EVERY = 20
FEWEST_SCORES = 4
"""Trials whose spread says something."""
SPREAD = 1.64
"""Standard deviations under their mean above which 19 of 20 scores lie."""
AVOIDABLE = {
    HAZE: "leave the haze out",
    NOISE: "`denoise=oidn` takes the noise out",
    TOO_LARGE: "take a lower `resolution` or texture resolution, or set ADVSEARCH_LIMITS=2 where memory allows it",
}
"""Reasons to render that cost much, and what a user can do instead."""
Tick = Callable[[int], None]
Judged = float | Tensor


@dataclass(frozen=True)
class Conditions:
    """The conditions that matrices were made for: how many, how many of them were dropped for newer ones, comparisons
    after which there had to be more, and by how much the objective was larger under them than under unseen ones, at the
    last."""

    made: int
    dropped: int
    grown: int
    gap: float | None


def reason_against(problem: Problem, steps: int, specialise: bool) -> str | None:
    """Why a search renders instead of predicting, in words; None if it predicts."""
    if not specialise:
        return "nothing is left out"
    if steps < WORTH:
        return f"a matrix pays from {WORTH} evaluations on"
    reason = why_not(problem.renderer, varying(problem))
    if reason is None and problem.conditions is None:
        worth = WORTH_A_LIGHT * lights_to_collect(problem.renderer)
        return f"basis pictures pay from {worth} evaluations on" if steps < worth else None
    return reason


def remark(reason: str) -> str:
    """Return what a user should know of a search that renders for a reason; empty where it has to."""
    instead = next((what for why, what in AVOIDABLE.items() if reason.startswith(why)), "")
    costs = "Each step of the search is rendered, which takes several times as long as predicting it"
    return f"{costs}: {reason}; {instead}." if instead else ""


def varying(problem: Problem) -> list[str]:
    """The controls that vary by chance."""
    return [] if problem.conditions is None else [one.name for one in problem.space.controls[problem.searched :]]


class Predictor(ABC):
    """What predicts the pictures of a run's searches, in what way; its `deviations` from traced pictures, in order, and
    the seconds spent on making matrices and comparing."""

    way: ClassVar[str] = "matrix"
    deviations: list[Deviation]
    seconds: float

    exact: ClassVar[bool] = False
    """Whether equal configurations have equal objectives."""

    @property
    def drawn(self) -> bool:
        """Whether the search climbs under conditions that each evaluation draws anew; see `Domain.drawn`."""
        return False

    @property
    @abstractmethod
    def samples(self) -> int:
        """Samples a pixel that are traced before the search can begin."""

    @abstractmethod
    def prepare(self, tick: Tick = lambda samples: None) -> None:
        """Make the matrices at the start of the search; told of samples a pixel as they are traced."""

    @abstractmethod
    def passed(self, query: Query) -> None:
        """Remember a query that was read back."""

    @abstractmethod
    def evaluate(self, query: Query) -> Evaluation:
        """Answer one query of the search itself."""

    def answered(self, queries: Sequence[Query], traced: Evaluate) -> Iterator[Evaluation]:
        """Answer queries of a search itself, each when it is asked for; `traced` answers what is not predicted."""
        return map(self.evaluate, queries)

    @abstractmethod
    def size(self) -> tuple[int, int]:
        """Entries of the matrices, for one colour channel, and bytes."""

    @property
    @abstractmethod
    def traced(self) -> int:
        """Pictures that were traced for matrices and comparisons."""

    @property
    def renewed(self) -> int | None:
        """How often the matrix was made anew; None where none is."""
        return None

    def predicted(self, kind: str, evaluations: int) -> int:
        """How many of the first evaluations of a search were predicted."""
        return evaluations

    @property
    def given_up(self) -> str | None:
        """Why pictures were rendered from some evaluation on, in words; None if they were not."""
        return None

    @property
    def conditions(self) -> Conditions | None:
        """What there is to say of conditions; None where nothing varies."""
        return None


@dataclass(frozen=True, eq=False)
class ExpansionPoint:
    """Where a picture was linearised, and the matrix that was made there."""

    u: Tensor
    renderer: PredictingRenderer


@dataclass
class CleanMatrix:
    """The matrix of the clean configuration, for attacks that differ in nothing but their budget of change."""

    made: ExpansionPoint | None = None


@dataclass
class Transport(Predictor):
    """The matrices of a run's searches where nothing varies by chance. What comes after `steps` evaluations of a search
    belongs to the ranking, and is traced. `renewals` are, by kind of search, the evaluations at which the matrix was
    made anew, or, where there is none that could be, from which on pictures are traced. Every search begins at `clean`.
    """

    exact: ClassVar[bool] = True
    problem: Problem
    steps: int
    renewals: dict[str, list[int]] = field(default_factory=dict)
    clean: CleanMatrix = field(default_factory=CleanMatrix)
    deviations: list[Deviation] = field(default_factory=list)
    seconds: float = 0.0
    _optimism: float = 0.0
    _start: ExpansionPoint | None = None
    _collected: int = 0
    _present: dict[str, ExpansionPoint] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        return samples_to_collect(self.problem.renderer)

    def size(self) -> tuple[int, int]:
        return self.start.entries, self.start.bytes

    @property
    def renewed(self) -> int:
        return sum(len(found) for found in self.renewals.values()) if self._renewable else 0

    @property
    def _renewable(self) -> bool:
        """Whether there is something to linearise again: basis pictures of lights stay what they are."""
        return self.start.entries > 0

    def predicted(self, kind: str, evaluations: int) -> int:
        return min(evaluations, self._end(kind))

    def _end(self, kind: str) -> int:
        """The evaluation from which on pictures are traced."""
        found = self.renewals.get(kind)
        return self.steps if self._renewable or not found else min(found[0], self.steps)

    @property
    def given_up(self) -> str | None:
        found = [f"{at} of the {kind}" for kind, (at, *_) in self.renewals.items() if not self._renewable]
        return (
            f"pictures are rendered from evaluation {found[0]} on: predicted ones were too far off" if found else None
        )

    @property
    def traced(self) -> int:
        return (self._collected + self.renewed) * self._pictures + sum(one.pictures for one in self.deviations)

    def prepare(self, tick: Tick = lambda samples: None) -> None:
        if self.clean.made is None:
            self.clean.made = self._made(self.problem.domain.start, "start", 0, tick)
            self._collected = 1
        self._start = self.clean.made

    @property
    def _pictures(self) -> int:
        return self.start.lights if isinstance(self.start, BasisRenderer) else 1

    @property
    def start(self) -> PredictingRenderer:
        return self._begin.renderer

    @property
    def _begin(self) -> ExpansionPoint:
        if self._start is None:
            self.prepare()
        assert self._start is not None
        return self._start

    def passed(self, query: Query) -> None:
        self._compared(query)

    def evaluate(self, query: Query) -> Evaluation:
        renderer = self._compared(query)
        if renderer is None:
            return self.problem.evaluate(query)
        return replace(self.problem.evaluated(query, query.u, query.seed, renderer)[0], predicted=1)

    def likely(self, u: Tensor) -> bool:
        """Whether the picture that is predicted from the start would pass its trials, as far as those of the last
        configuration tell."""
        return self._score(u) > self._optimism

    def correct(self, u: Tensor, scores: Sequence[float]) -> None:
        """Learn from the scores of a configuration's trials how much more than their lower end its prediction says."""
        if len(scores) >= FEWEST_SCORES and all(map(math.isfinite, scores)):
            lower = statistics.fmean(scores) - SPREAD * statistics.stdev(scores)
            self._optimism = self._score(u) - lower

    def _score(self, u: Tensor) -> float:
        """That of the picture that is predicted from the start, rounded to 8 bits."""
        with torch.no_grad():
            return self.problem.judge(to_8_bit(self.start(u)), u).score

    def _compared(self, query: Query) -> PredictingRenderer | None:
        """The matrix to predict an evaluation with, compared and made anew where that is due; None gives up."""
        kind, number = query.kind, query.number
        if query.phase != "search" or number >= self._end(kind):
            return None
        place = self._present.setdefault(kind, self._begin)
        if number and number % EVERY == 0 and kind.startswith("search"):
            found = self.deviation(place.renderer, query.u, number)
            self.deviations.append(found)
            if not found.good:
                self.renewals.setdefault(kind, []).append(number)
                if not self._renewable:
                    return None
                place = self._present[kind] = self._made(query.u, kind, number)
        return place.renderer

    def _made(self, u: Tensor, kind: str, number: int, tick: Tick = lambda samples: None) -> ExpansionPoint:
        begun = time.perf_counter()
        seed = seeds.stream(self.problem.seed, f"transport {kind}", number)
        made = predicting(self.problem.renderer, u, seed, tick)
        self.seconds += time.perf_counter() - begun
        return ExpansionPoint(u.detach().clone(), made)

    def deviation(self, linear: PredictingRenderer, u: Tensor, index: int) -> Deviation:
        """Compare what a matrix predicts with traced pictures of several seeds."""
        begun = time.perf_counter()
        seed = seeds.stream(self.problem.seed, "transport check", index)
        problem = self.problem
        found = compared(lambda number: problem.view(linear, u, seeds.stream(seed, "view", number), problem.spp))
        self.seconds += time.perf_counter() - begun
        return found
