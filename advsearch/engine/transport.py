"""Searches whose pictures are predicted; here: by a matrix of light transport, where
nothing varies by chance. Every `EVERY` evaluations predictions are compared with traced
pictures: where they are too far off (`engine.problem`), the matrix is made anew. The
ranking and all trials trace paths.
"""

from __future__ import annotations

import math
import statistics
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.engine.acceptance import ComparedView, Deviation, compared
from advsearch.engine.problem import Problem
from advsearch.runs.results import BankOfConditions, LinearTransport, PredictionError
from advsearch.scene.color import to_8_bit
from advsearch.scene.predictor import Predictor, Refusal, RefusalCause
from advsearch.scene.transport.lights import (
    lights_to_collect,
    predicting,
    samples_to_collect,
    why_not,
)
from advsearch.scene.transport.matrix import Tick

WORTH = 16
"""Evaluations from which a search pays for the matrix, which costs as much as some 6
rendered ones with gradients (`benchmarks/transport.py`).
"""
# evaluations for each light from which a search pays for its basis picture
WORTH_A_LIGHT = 8
EVERY = 20
FEWEST_SCORES = 4  # trials whose spread says something
SPREAD = 1.64  # standard deviations under their mean above which 19 of 20 scores lie
ADVICE = {
    RefusalCause.HAZE: "leave the haze out",
    RefusalCause.NOISE: "`denoise=oidn` takes the noise out",
    RefusalCause.TOO_LARGE: "take a lower `resolution` or texture resolution, or set "
    "ADVSEARCH_LIMITS=2 where memory "
    "allows it",
}
"""What a user can do where rendering costs much, by the cause of a refusal."""


def refusal_of_matrices(
    problem: Problem, steps: int | None, specialise: bool
) -> Refusal | None:
    """Return why a search of so many steps (None: of any number) is not predicted by
    matrices; None if it is.
    """
    if not specialise:
        return Refusal("nothing is left out")
    if problem.renderer.composed:
        return Refusal(problem.renderer.composed)
    if steps is not None and steps < WORTH:
        return Refusal(
            f"a matrix pays from {WORTH} evaluations on", RefusalCause.TOO_FEW_STEPS
        )
    by_chance = (
        problem.space.controls[problem.searched :]
        if problem.conditions is not None
        else ()
    )
    refusal = why_not(problem.renderer, [control.name for control in by_chance])
    if refusal is None and problem.conditions is None and steps is not None:
        worth = WORTH_A_LIGHT * lights_to_collect(problem.renderer)
        if steps < worth:
            return Refusal(
                f"basis pictures pay from {worth} evaluations on",
                RefusalCause.TOO_FEW_STEPS,
            )
    return refusal


def remark(refusal: Refusal | None) -> str:
    """Return what a user should know of a search that renders; empty where nothing else
    is possible.
    """
    advice = "" if refusal is None else ADVICE.get(refusal.cause, "")
    if not advice:
        return ""
    costs = (
        "Each step of the search is rendered, which takes several times as long "
        "as "
        "predicting it"
    )
    return f"{costs}: {refusal}; {advice}."


@dataclass
class PredictedSearch(ABC):
    """What predicts the pictures of a run's searches. All of it follows from the seed,
    so that it can be made again.
    """

    way: ClassVar[str] = "matrix"  # how, in words
    exact: ClassVar[bool] = False  # whether equal configurations have equal objectives

    problem: Problem
    # evaluations of a search; what comes after them belongs to the ranking, and is
    # traced
    steps: int
    # whether each evaluation draws conditions; see `Domain.drawn`
    drawn: bool = field(default=False, kw_only=True)
    # from traced pictures, in order
    deviations: list[Deviation] = field(default_factory=list, kw_only=True)
    # pictures, for what predicts and to be compared
    traced: int = field(default=0, kw_only=True)
    seconds: float = field(default=0.0, kw_only=True)  # spent on both
    # how often it was made anew; None where it never is
    renewed: int | None = field(default=0, kw_only=True)
    # by kind of search, the evaluation from which on pictures are traced, as predicted
    # ones were too far off
    ends: dict[str, int] = field(default_factory=dict, kw_only=True)
    given_up: str | None = field(default=None, kw_only=True)  # says so

    @property
    @abstractmethod
    def samples(self) -> int:
        """Samples a pixel that are traced before the search can begin."""

    @abstractmethod
    def prepare(self, tick: Tick = lambda samples: None) -> None:
        """Make what predicts at the start of the search; told of samples a pixel as
        they are traced.
        """

    @property
    def too_far_off(self) -> Refusal | None:
        """Why it cannot be used, as far as images that were traced to prepare it tell;
        None if it can.
        """
        return None

    @abstractmethod
    def passed(self, query: Query) -> None:
        """Remember a query that was read back: compare, and make anew, what an
        evaluation would have.
        """

    @abstractmethod
    def evaluate(self, query: Query) -> Evaluation:
        """Answer one query of the search itself."""

    def evaluate_all(
        self, queries: Sequence[Query], traced: Evaluate
    ) -> Iterator[Evaluation]:
        """Answer queries of a search itself, each when it is asked for; `traced`
        answers what is not predicted.
        """
        return map(self.evaluate, queries)

    @abstractmethod
    def size(self) -> tuple[int, int]:
        """Entries of the matrices, for one colour channel, and bytes."""

    def conditions(self) -> BankOfConditions | None:
        """What there is to say of conditions; None where nothing varies."""
        return None

    def predicted(self, kind: str, evaluations: int) -> int:
        """How many of the first evaluations of a search were predicted."""
        return min(evaluations, self.ends.get(kind, evaluations))

    def compare(self, view: Callable[[int], ComparedView]) -> Deviation:
        """Compare predictions with traced pictures, and keep what was found; see
        `compared`.
        """
        with self.timed():
            self.deviations.append(compared(view))
        self.traced += self.deviations[-1].pictures
        return self.deviations[-1]

    def give_up(self, kind: str, number: int, where: str = "") -> None:
        """Have pictures traced from an evaluation of a kind of search on."""
        self.ends[kind] = number
        why = (
            f"pictures are rendered from evaluation {number}{where} on: predicted "
            "ones were too far off"
        )
        self.given_up = self.given_up or why

    @contextmanager
    def timed(self) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        self.seconds += time.perf_counter() - begun

    def summary(self) -> LinearTransport:
        entries, size = self.size()
        return LinearTransport(
            used=True,
            way=self.way,
            reason=self.given_up,
            conditions=self.conditions(),
            entries=entries,
            bytes=size,
            seconds=self.seconds,
            renewed=self.renewed,
            error=PredictionError.of(self.deviations[-1]) if self.deviations else None,
        )


@dataclass
class CleanMatrix:
    """The matrix of the clean configuration, for attacks that differ in nothing but
    their budget of change.
    """

    made: Predictor | None = None


@dataclass
class Transport(PredictedSearch):
    """The matrices of a run's searches where nothing varies by chance; every search
    begins with the `clean` one.
    """

    exact: ClassVar[bool] = True
    clean: CleanMatrix = field(default_factory=CleanMatrix)
    _optimism: float = 0.0
    _present: dict[str, Predictor] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        return samples_to_collect(self.problem.renderer)

    def prepare(self, tick: Tick = lambda samples: None) -> None:
        self.clean.made = self.clean.made or self._made(
            self.problem.domain.start, "start", 0, tick
        )

    @property
    def start(self) -> Predictor:
        self.prepare()
        assert self.clean.made is not None
        return self.clean.made

    def size(self) -> tuple[int, int]:
        return self.start.entries, self.start.bytes

    def _made(
        self, u: Tensor, kind: str, number: int, tick: Tick = lambda samples: None
    ) -> Predictor:
        with self.timed():
            seed = seeds.stream(self.problem.seed, f"transport {kind}", number)
            made = predicting(self.problem.renderer, u, seed, tick)
        self.traced += made.lights
        return made

    def passed(self, query: Query) -> None:
        self._at(query)

    def evaluate(self, query: Query) -> Evaluation:
        present = self._at(query)
        if present is None:
            return self.problem.evaluate(query)
        return replace(
            self.problem.evaluated(query, query.u, query.seed, present.renderer)[0],
            predicted=1,
        )

    def _at(self, query: Query) -> Predictor | None:
        """What predicts an evaluation, compared and made anew where that is due; None
        where it is traced.
        """
        kind = query.kind
        number = query.number
        if query.phase != "search" or number >= self.predicted(kind, self.steps):
            return None
        present = self._present.setdefault(kind, self.start)
        if number == 0 or number % EVERY or not kind.startswith("search"):
            return present
        seed = seeds.stream(self.problem.seed, "transport check", number)
        deviation = self.compare(
            lambda view: self.problem.view(
                present, query.u, seeds.stream(seed, "view", view), self.problem.spp
            )
        )
        if deviation.good:
            return present
        # basis pictures of lights stay what they are: there is nothing to linearise
        # again
        if self.start.entries == 0:
            self.give_up(kind, number, f" of the {kind}")
            return None
        self._present[kind] = self._made(query.u, kind, number)
        self.renewed = (self.renewed or 0) + 1
        return self._present[kind]

    def likely(self, u: Tensor) -> bool:
        """Whether the picture that is predicted from the start would pass its trials,
        as far as those of the last configuration tell.
        """
        return self._score(u) > self._optimism

    def correct(self, u: Tensor, scores: Sequence[float]) -> None:
        """Learn from the scores of a configuration's trials how much more than their
        lower end its prediction says.
        """
        if len(scores) >= FEWEST_SCORES and all(map(math.isfinite, scores)):
            lower = statistics.fmean(scores) - SPREAD * statistics.stdev(scores)
            self._optimism = self._score(u) - lower

    def _score(self, u: Tensor) -> float:
        with torch.no_grad():
            return self.problem.judge(to_8_bit(self.start(u)), u).score
