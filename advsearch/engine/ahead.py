"""Evaluations and trials that do not wait for each other, carried out by workers before it is their turn.

Whoever knows what comes next says so (`Ahead.begin`), in lines: within a line each waits for the answer to the one
before, as in a search along gradients, and no line waits for another. When its turn comes, the answer is there
(`Ahead.take`). What was not announced, or without workers, is carried out here in its turn. Both ways ask the same
function of the same problem, so that a run has the same rows.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields
from typing import Any, TypeAlias

import torch
from torch import Tensor

from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.evaluation import Wanted
from advsearch.cluster.executor import Done, Executor, Workforce
from advsearch.engine.problem import OnImage, Problem
from advsearch.engine.rows import no_answer
from advsearch.errors import ClusterError
from advsearch.scene.gradients.plan import GradientPlan
from advsearch.scene.transport.renderer import Linearised, LinearRenderer
from advsearch.tasks import Judgement

MOST, MOST_NUMBERS = 1024, 2**24
"""Configurations that are announced at once, and the numbers that they have together, at most."""

MOST_HELD = 2**27
"""Numbers of answers, derivatives included, that may be there before their turn; then only the first line goes on."""


@dataclass(frozen=True, eq=False)
class AheadAnswer:
    """What came of one configuration.

    Attributes:
        value: an evaluation, the judgement of a trial, what a matrix collected, or a picture.
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
    """An evaluation: see `Problem.evaluator`.

    Attributes:
        u: (d,) of the searched controls.
        index: of its seed.
        kind: of search, whose seeds it has.
        spp: samples a pixel of the search.
        search_depth: longest light path of the search.
        plan: how the derivative that is wanted is obtained; None where none is.
        gradient: which derivative is wanted.
        samples: how many times the search's samples.
        kept: whether the picture is wanted.
    """

    u: Tensor
    index: int
    kind: str
    spp: int
    search_depth: int | None
    plan: GradientPlan | None = None
    gradient: Wanted = False
    samples: int = 1
    kept: bool = False

    def seen(self, problem: Problem) -> AheadAnswer:
        """Carry it out; the problem takes the samples, the light paths and the plan."""
        problem.spp, problem.search_depth = self.spp, self.search_depth
        if self.plan is not None and problem.plan != self.plan:
            problem.plan = self.plan
        pictures: list[Tensor] = []
        told = OnImage(lambda index: True, lambda index, image: pictures.append(image)) if self.kept else None
        evaluate = problem.evaluator(self.kind, told)
        evaluation = evaluate(self.u, index=self.index, gradient=self.gradient, samples=self.samples)
        return AheadAnswer(evaluation, pictures[0] if pictures else None)

    def lost(self, why: str) -> AheadAnswer:
        """What stands for it where nobody could carry it out."""
        gradient = torch.zeros_like(self.u) if self.gradient else None
        return AheadAnswer(Evaluation(math.nan, gradient, False, cost=self.samples, judgement=no_answer(why)))


@dataclass(frozen=True, eq=False)
class MatrixAhead:
    """A matrix of light transport: see `LinearRenderer`.

    Attributes:
        u: (d,) of the whole space, where it is made.
        seed: of its noise.
        spp: samples a pixel.
        depth: longest light path in segments.
        names: of the inputs that get one.
    """

    u: Tensor
    seed: int
    spp: int
    depth: int
    names: frozenset[str]

    def made(self, problem: Problem, collected: Linearised | None = None) -> LinearRenderer:
        """Make it, unless it is there."""
        with problem.renderer.scene.shorter(self.depth):
            return LinearRenderer(
                problem.renderer,
                self.u,
                self.seed,
                spp=self.spp,
                quick=True,
                names=self.names,
                collected=collected,
            )

    def seen(self, problem: Problem) -> AheadAnswer:
        """Carry it out."""
        return AheadAnswer(self.made(problem).collected)

    def lost(self, why: str) -> AheadAnswer:
        """Nothing can stand for it.

        Raises:
            ClusterError: always.
        """
        raise ClusterError(f"the matrix of a condition: {why}; `advsearch resume RUN workers=null` makes it here")


@dataclass(frozen=True, eq=False)
class PictureAhead:
    """A picture: see `Problem.picture`.

    Attributes:
        u: (d,) of the searched controls.
        seed: of its render.
        spp: samples a pixel.
        of: the name of the problem, where there are several.
    """

    u: Tensor
    seed: int
    spp: int
    of: str

    def seen(self, problem: Problem) -> AheadAnswer:
        """Carry it out."""
        return AheadAnswer(problem.picture(self.u, self.seed, self.spp))

    def lost(self, why: str) -> AheadAnswer:
        """Nothing can stand for it.

        Raises:
            ClusterError: always.
        """
        raise ClusterError(f"a picture for {self.of}: {why}; `advsearch resume RUN workers=null` makes it here")


Announced = TrialAhead | EvaluationAhead | MatrixAhead | PictureAhead
AheadLine: TypeAlias = Generator[Announced, Any, None]
"""What is announced, one after the other; it is sent the value of each answer before it says what comes next."""


def evaluation_ahead(
    problem: Problem, kind: str, u: Tensor, index: int, gradient: Wanted, samples: int, kept: bool
) -> EvaluationAhead:
    """Return an evaluation of a problem as it is now."""
    plan = problem.plan if gradient else None
    return EvaluationAhead(u, index, kind, problem.spp, problem.search_depth, plan, gradient, samples, kept)


def line_of(announced: Announced) -> AheadLine:
    """Return a line of one."""
    yield announced


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
class _Begun:
    """A line that was begun.

    Attributes:
        line: itself.
        place: among all of them; the first ones go first.
        waiting: what it has asked for and nobody has taken; the latest may have no answer yet.
        answers: to the first of these.
    """

    line: AheadLine
    place: int
    waiting: deque[Announced] = field(default_factory=deque)
    answers: deque[tuple[AheadAnswer, Done]] = field(default_factory=deque)


@dataclass(eq=False)
class Ahead:
    """What workers carry out ahead of its turn, in the order of the turns: line by line.

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
    _lines: deque[_Begun] = field(default_factory=deque)
    _coming: Generator[None, None, None] | None = None

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

    @property
    def begun(self) -> bool:
        """Whether something is announced whose turn is still to come."""
        while self._lines and not self._lines[0].waiting:
            self._lines.popleft()
        return bool(self._lines)

    def begin(self, lines: Sequence[AheadLine]) -> None:
        """Say what comes next, in its order; what is left of what was said before comes to nothing."""
        self._end()
        if self.executor is None or len(lines) < 2:
            return
        begun = [_Begun(line, place) for place, line in enumerate(lines)]
        asked = [(one, first) for one in begun if (first := next(one.line, None)) is not None]
        if len(asked) > 1:
            self._lines.extend(begun)
            self._coming = self._answers(self.executor, asked)

    def take(self, wanted: Announced) -> AheadAnswer | None:
        """Return what came of the next configuration; None where it is another one, or none was announced."""
        if not self.begun or self._coming is None:
            return None
        line = self._lines[0]
        if not _same(line.waiting[0], wanted):
            self._end()
            return None
        while not line.answers:
            next(self._coming)
        line.waiting.popleft()
        seen, done = line.answers.popleft()
        self.non_finite, self.lost = self.non_finite + seen.non_finite, self.lost + bool(done.lost)
        self.machine = done.machine
        return seen

    def _end(self) -> None:
        """Let what is left come to nothing."""
        if self._coming is not None:
            self._coming.close()
        self._coming = None
        self._lines.clear()

    def _answers(self, executor: Executor, asked: Sequence[tuple[_Begun, Announced]]) -> Generator[None, None, None]:
        """Return what carries on all lines, and pauses after each answer."""
        given: list[Announced | None] = []
        owners: list[_Begun] = []
        ready: list[tuple[int, int]] = []
        held = MOST_HELD // (2 * asked[0][1].u.numel())

        def ask(line: _Begun, announced: Announced) -> None:
            heapq.heappush(ready, (line.place, len(given)))
            given.append(announced)
            owners.append(line)
            line.waiting.append(announced)

        def ranges() -> Iterator[range | None]:
            while True:
                full = sum(len(line.answers) for line in self._lines) >= held
                if not ready or (full and ready[0][0] > self._lines[0].place):
                    yield None
                else:
                    number = heapq.heappop(ready)[1]
                    yield range(number, number + 1)

        def come() -> Generator[None, None, None]:
            results: Any = executor.results(ranges(), given)
            with closing(results):
                for done in results:
                    number = done.numbers.start
                    line, announced, given[number] = owners[number], given[number], None
                    assert announced is not None
                    seen = announced.lost(done.lost) if done.lost else done.value[0]
                    line.answers.append((seen, done))
                    try:
                        ask(line, line.line.send(seen.value))
                    except StopIteration:
                        pass
                    yield

        for line, first in asked:
            ask(line, first)
        return come()

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
            seen = self.take(evaluation_ahead(problem, kind, u, index, gradient, samples, kept)) if self.begun else None
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
