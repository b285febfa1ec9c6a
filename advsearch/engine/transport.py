"""Searches whose images are predicted, and their simplest predictor: a matrix.

The matrix of light transport predicts images where nothing varies by chance. Every
`EVERY` evaluations predictions are compared with traced images: where they are too far
off (`engine.acceptance`), the matrix is computed again. The ranking and all trials trace
paths.
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
"""Evaluations of a search from which on the matrix pays.

It costs as much as some 6 rendered evaluations with gradients
(`benchmarks/transport.py`).
"""
# evaluations for each light from which on basis images pay
WORTH_A_LIGHT = 8
EVERY = 20  # evaluations from one comparison to the next
FEWEST_SCORES = 4  # trials from which a standard deviation is estimated
SPREAD = 1.64  # standard deviations below the mean above which 19 of 20 scores lie
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
    """Return why a search is not predicted by matrices; None if it is.

    Args:
        problem: of the search.
        steps: its evaluations; None for any number.
        specialise: the setting of this name.
    """
    if not specialise:
        return Refusal("nothing is left out")
    if problem.renderer.composed:
        return Refusal(problem.renderer.composed)
    if steps is not None and steps < WORTH:
        return Refusal(
            f"a matrix pays from {WORTH} evaluations on", RefusalCause.TOO_FEW_STEPS
        )
    condition_names = []
    if problem.conditions is not None:
        conditions = problem.space.controls[problem.searched :]
        condition_names = [control.name for control in conditions]
    refusal = why_not(problem.renderer, condition_names)
    if refusal is not None or problem.conditions is not None or steps is None:
        return refusal
    min_steps = WORTH_A_LIGHT * lights_to_collect(problem.renderer)
    if steps < min_steps:
        return Refusal(
            f"basis pictures pay from {min_steps} evaluations on",
            RefusalCause.TOO_FEW_STEPS,
        )
    return None


def remark(refusal: Refusal | None) -> str:
    """Return advice for a search that renders; "" where nothing else is possible."""
    advice = "" if refusal is None else ADVICE.get(refusal.cause, "")
    if not advice:
        return ""
    costs = (
        "Each step of the search is rendered, which takes several times as long "
        "as predicting it"
    )
    return f"{costs}: {refusal}; {advice}."


@dataclass
class PredictedSearch(ABC):
    """A predictor of the images of a run's searches.

    All of it follows from the seed, so that a resumed run computes the same again.

    Attributes:
        way: method, for reports.
        exact: whether equal configurations have equal objectives.
        problem: of the searches.
        steps: evaluations of a search; those after them belong to the ranking, and are
            traced.
        drawn: whether each evaluation draws conditions; see `Domain.drawn`.
        deviations: from traced images, of each comparison.
        traced: images that were traced, for the predictor and to compare it.
        seconds: spent on both.
        renewed: how often the predictor was computed again; None where it never is.
        ends: by kind of search, the evaluation from which on images are traced, as
            predictions were too far off.
        given_up: why images are traced, as a sentence; None while they are predicted.
    """

    way: ClassVar[str] = "matrix"
    exact: ClassVar[bool] = False

    problem: Problem
    steps: int
    drawn: bool = field(default=False, kw_only=True)
    deviations: list[Deviation] = field(default_factory=list, kw_only=True)
    traced: int = field(default=0, kw_only=True)
    seconds: float = field(default=0.0, kw_only=True)
    renewed: int | None = field(default=0, kw_only=True)
    ends: dict[str, int] = field(default_factory=dict, kw_only=True)
    given_up: str | None = field(default=None, kw_only=True)

    @property
    @abstractmethod
    def samples(self) -> int:
        """Samples per pixel that are traced before the search can begin."""

    @abstractmethod
    def prepare(self, tick: Tick = lambda samples: None) -> None:
        """Compute the predictor at the start of the search.

        `tick` is called with samples per pixel as they are traced.
        """

    @property
    def too_far_off(self) -> Refusal | None:
        """Why it cannot be used, by images that were traced to prepare it; None if it can."""
        return None

    @abstractmethod
    def passed(self, query: Query) -> None:
        """Replay a query that was read from the store.

        Comparisons and renewals happen as they did when it was evaluated.
        """

    @abstractmethod
    def evaluate(self, query: Query) -> Evaluation:
        """Evaluate one query of the search itself."""

    def evaluate_all(
        self, queries: Sequence[Query], traced: Evaluate
    ) -> Iterator[Evaluation]:
        """Evaluate queries of a search lazily; `traced` evaluates those not predicted."""
        return map(self.evaluate, queries)

    @abstractmethod
    def size(self) -> tuple[int, int]:
        """Return the entries of the matrices, for one color channel, and their bytes."""

    def conditions(self) -> BankOfConditions | None:
        """Return the state of a bank of conditions; None where nothing varies."""
        return None

    def predicted(self, kind: str, evaluations: int) -> int:
        """Return how many of the first evaluations of a search were predicted."""
        return min(evaluations, self.ends.get(kind, evaluations))

    def compare(self, view: Callable[[int], ComparedView]) -> Deviation:
        """Compare predictions with traced images, and store the deviation.

        `view` compares a single view; see `acceptance.compared`.
        """
        with self.timed():
            self.deviations.append(compared(view))
        self.traced += self.deviations[-1].pictures
        return self.deviations[-1]

    def give_up(self, kind: str, number: int, where: str = "") -> None:
        """Trace images from an evaluation of a kind of search on."""
        self.ends[kind] = number
        reason = (
            f"pictures are rendered from evaluation {number}{where} on: predicted "
            "ones were too far off"
        )
        self.given_up = self.given_up or reason

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Count the time of a block as spent on the predictor."""
        started = time.perf_counter()
        yield
        self.seconds += time.perf_counter() - started

    def summary(self) -> LinearTransport:
        """Return what a result stores of the predictor."""
        entries, n_bytes = self.size()
        error = None
        if self.deviations:
            error = PredictionError.of(self.deviations[-1])
        return LinearTransport(
            used=True,
            way=self.way,
            reason=self.given_up,
            conditions=self.conditions(),
            entries=entries,
            bytes=n_bytes,
            seconds=self.seconds,
            renewed=self.renewed,
            error=error,
        )


@dataclass
class CleanMatrix:
    """The matrix of the clean configuration.

    Attacks that differ only in their budget of change share it.
    """

    made: Predictor | None = None


@dataclass
class Transport(PredictedSearch):
    """The matrices of a run's searches where nothing varies by chance.

    Attributes:
        clean: the matrix with which every search begins.
    """

    exact: ClassVar[bool] = True
    clean: CleanMatrix = field(default_factory=CleanMatrix)
    # by how much predicted scores are above the lower end of those of trials
    _score_bias: float = 0.0
    # the latest matrix of each kind of search
    _current: dict[str, Predictor] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        return samples_to_collect(self.problem.renderer)

    def prepare(self, tick: Tick = lambda samples: None) -> None:
        if self.clean.made is None:
            start = self.problem.domain.start
            self.clean.made = self._make_predictor(start, "start", 0, tick)

    @property
    def start(self) -> Predictor:
        """The matrix of the clean configuration."""
        self.prepare()
        assert self.clean.made is not None
        return self.clean.made

    def size(self) -> tuple[int, int]:
        return self.start.entries, self.start.bytes

    def _make_predictor(
        self, u: Tensor, kind: str, number: int, tick: Tick = lambda samples: None
    ) -> Predictor:
        """Compute the matrix at u (d,)."""
        with self.timed():
            seed = seeds.stream(self.problem.seed, f"transport {kind}", number)
            predictor = predicting(self.problem.renderer, u, seed, tick)
        self.traced += predictor.lights
        return predictor

    def passed(self, query: Query) -> None:
        self._update_predictor(query)

    def evaluate(self, query: Query) -> Evaluation:
        predictor = self._update_predictor(query)
        if predictor is None:
            return self.problem.evaluate(query)
        evaluation, _ = self.problem.evaluated(
            query, query.u, query.seed, predictor.renderer
        )
        return replace(evaluation, predicted=1)

    def _update_predictor(self, query: Query) -> Predictor | None:
        """Return the predictor of a query; None where it is traced.

        Where that is due, the predictor is compared with traced images and, if it is
        too far off, computed again.
        """
        kind = query.kind
        number = query.number
        if query.phase != "search" or number >= self.predicted(kind, self.steps):
            return None
        predictor = self._current.setdefault(kind, self.start)
        if number == 0 or number % EVERY or not kind.startswith("search"):
            return predictor
        seed = seeds.stream(self.problem.seed, "transport check", number)
        deviation = self.compare(
            lambda view: self.problem.view(
                predictor,
                query.u,
                seeds.stream(seed, "view", view),
                self.problem.spp,
            )
        )
        if deviation.good:
            return predictor
        # Basis images of lights do not depend on u: nothing can be linearised again.
        if self.start.entries == 0:
            self.give_up(kind, number, f" of the {kind}")
            return None
        self._current[kind] = self._make_predictor(query.u, kind, number)
        self.renewed = (self.renewed or 0) + 1
        return self._current[kind]

    def likely(self, u: Tensor) -> bool:
        """Return whether the predicted image of u (d,) would pass its trials.

        That is judged by the scores of the trials of the last configuration.
        """
        return self._predict_score(u) > self._score_bias

    def correct(self, u: Tensor, scores: Sequence[float]) -> None:
        """Update the bias of predicted scores from those of a configuration's trials.

        The bias is the predicted score minus the lower end of the trials' scores.
        """
        if len(scores) >= FEWEST_SCORES and all(map(math.isfinite, scores)):
            lower_end = statistics.fmean(scores) - SPREAD * statistics.stdev(scores)
            self._score_bias = self._predict_score(u) - lower_end

    def _predict_score(self, u: Tensor) -> float:
        """Return the score of the image that is predicted from the start."""
        with torch.no_grad():
            image = to_8_bit(self.start(u))
            return self.problem.judge(image, u).score
