"""Evaluations and trials that do not wait for each other, carried out by workers before it is their turn.

Whoever knows what comes next says so (`Ahead.begin`); when its turn comes, the answer is there (`Ahead.take`). What was
not announced, or without workers, is carried out here in its turn. Both ways ask the same function of the same problem,
so that a run has the same rows.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields
from typing import Any

import torch
from torch import Tensor

from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.evaluation import Wanted
from advsearch.cluster.executor import Done, Executor, Workforce
from advsearch.engine.problem import OnImage, Problem
from advsearch.engine.rows import no_answer
from advsearch.tasks import Judgement

MOST, MOST_NUMBERS = 1024, 2**24
"""Configurations that are announced at once, and the numbers that they have together, at most."""


@dataclass(frozen=True, eq=False)
class AheadAnswer:
    """What came of one configuration.

    Attributes:
        value: an evaluation, or the judgement of a trial.
        picture: (H, W, 3) sRGB in [0, 1], where it was wanted.
        non_finite: values of pictures that were not finite and were set to 0.
    """

    value: Any
    picture: Tensor | None = None
    non_finite: int = 0


@dataclass(frozen=True, eq=False)
class TrialAhead:
    """A trial: see `Problem.trial`.

    Attributes:
        u: (d,) of the searched controls.
        seed: of its render.
        spp: samples a pixel.
        kept: whether the picture is wanted.
    """

    u: Tensor
    seed: int
    spp: int
    kept: bool = False

    def seen(self, problem: Problem) -> AheadAnswer:
        """Carry it out."""
        pictures: list[Tensor] = []
        judgement = problem.trial(self.u, self.seed, self.spp, keep=pictures.append)
        return AheadAnswer(judgement, pictures[0] if self.kept else None)

    def lost(self, why: str) -> AheadAnswer:
        """What stands for it where nobody could carry it out."""
        return AheadAnswer(no_answer(why))


@dataclass(frozen=True, eq=False)
class EvaluationAhead:
    """An evaluation without derivative: see `Problem.evaluator`.

    Attributes:
        u: (d,) of the searched controls.
        index: of its seed.
        kind: of search, whose seeds it has.
        spp: samples a pixel of the search.
        search_depth: longest light path of the search.
        kept: whether the picture is wanted.
    """

    u: Tensor
    index: int
    kind: str
    spp: int
    search_depth: int | None
    kept: bool = False

    def seen(self, problem: Problem) -> AheadAnswer:
        """Carry it out; the problem takes the samples and the light paths."""
        problem.spp, problem.search_depth = self.spp, self.search_depth
        pictures: list[Tensor] = []
        told = OnImage(lambda index: True, lambda index, image: pictures.append(image)) if self.kept else None
        evaluation = problem.evaluator(self.kind, told)(self.u, index=self.index, gradient=False)
        return AheadAnswer(evaluation, pictures[0] if pictures else None)

    def lost(self, why: str) -> AheadAnswer:
        """What stands for it where nobody could carry it out."""
        return AheadAnswer(Evaluation(math.nan, None, False, judgement=no_answer(why)))


Announced = TrialAhead | EvaluationAhead


def seen_by(problem: Problem) -> Callable[[Sequence[Announced]], list[AheadAnswer]]:
    """Return what carries out what is announced of a problem: what a worker does."""

    def call(announced: Sequence[Announced]) -> list[AheadAnswer]:
        found = []
        for one in announced:
            before = problem.renderer.non_finite
            seen = one.seen(problem)
            found.append(AheadAnswer(seen.value, seen.picture, problem.renderer.non_finite - before))
        return found

    return call


@dataclass(eq=False)
class Ahead:
    """What workers carry out ahead of its turn, in the order of the turns.

    Attributes:
        executor: of `seen_by`; None where there are no workers, and everything is done in its turn.
        non_finite: values of pictures that were not finite there.
        lost: configurations of which every worker died.
        machine: of the latest answer that was taken; None where it is like this one.
    """

    executor: Executor | None = None
    non_finite: int = 0
    lost: int = 0
    machine: str | None = None
    _waiting: deque[Announced] = field(default_factory=deque)
    _coming: Generator[AheadAnswer, None, None] | None = None

    def most(self, dim: int) -> int:
        """Return how many configurations of so many numbers are announced at once, at most; 1 without workers."""
        return 1 if self.executor is None else max(2, min(MOST, MOST_NUMBERS // dim))

    @property
    def facts(self) -> Workforce | None:
        """How the workers do; None where there are none."""
        return None if self.executor is None else self.executor.facts

    @property
    def told(self) -> dict[str, float | str]:
        """The same, beside a bar."""
        return {} if self.facts is None else self.facts.told

    def begin(self, announced: Sequence[Announced]) -> None:
        """Say what comes next, in its order; what is left of what was said before comes to nothing."""
        if self._coming is not None:
            self._coming.close()
        executor, self._coming = self.executor, None
        self._waiting.clear()
        if executor is not None and len(announced) > 1:
            self._waiting.extend(announced)
            self._coming = self._answers(executor, list(announced))

    def take(self, wanted: Announced) -> AheadAnswer | None:
        """Return what came of the next configuration; None where it is another one, or none was announced."""
        if self._coming is None or not self._waiting or not _same(self._waiting[0], wanted):
            return None
        self._waiting.popleft()
        return next(self._coming)

    def _answers(self, executor: Executor, announced: Sequence[Announced]) -> Generator[AheadAnswer, None, None]:
        ones, early, turn = (range(n, n + 1) for n in range(len(announced))), dict[int, Done](), 0
        results: Any = executor.results(ones, announced)
        with closing(results):
            for done in results:
                early[done.numbers.start] = done
                while turn in early:
                    one = early.pop(turn)
                    seen = announced[turn].lost(one.lost) if one.lost else one.value[0]
                    self.non_finite, self.lost = self.non_finite + seen.non_finite, self.lost + bool(one.lost)
                    self.machine = one.machine
                    yield seen
                    turn += 1

    def machine_of_row(self) -> str | None:
        """Return the machine of the latest answer, once: the next row may be of a picture that was made here."""
        machine, self.machine = self.machine, None
        return machine

    def trial(
        self, problem: Problem, u: Tensor, seed: int, spp: int, keep: Callable[[Tensor], None] | None = None
    ) -> Judgement:
        """Return a trial: see `Problem.trial`."""
        seen = self.take(TrialAhead(u, seed, spp, keep is not None))
        if seen is None:
            return problem.trial(u, seed, spp) if keep is None else problem.trial(u, seed, spp, keep=keep)
        if keep is not None and seen.picture is not None:
            keep(seen.picture)
        judgement: Judgement = seen.value
        return judgement

    def evaluator(self, problem: Problem, evaluate: Evaluate, kind: str, on_image: OnImage | None) -> Evaluate:
        """Return the evaluation that takes what was announced, and for the rest is `evaluate`, which tells pictures."""

        def evaluated(u: Tensor, *, index: int, gradient: Wanted, samples: int = 1) -> Evaluation:
            kept = on_image is not None and on_image.wants(index)
            wanted = EvaluationAhead(u, index, kind, problem.spp, problem.search_depth, kept)
            seen = None if gradient or samples > 1 else self.take(wanted)
            if seen is None:
                return evaluate(u, index=index, gradient=gradient, **({} if samples == 1 else {"samples": samples}))
            if on_image is not None and seen.picture is not None:
                on_image.tell(index, seen.picture)
            evaluation: Evaluation = seen.value
            return evaluation

        return evaluated


def _same(one: Announced, other: Announced) -> bool:
    """Whether both are the same configuration, seen in the same way."""
    if type(one) is not type(other):
        return False
    pairs = [(getattr(one, each.name), getattr(other, each.name)) for each in fields(one)]
    return all(torch.equal(a, b) if isinstance(a, Tensor) else a == b for a, b in pairs)
