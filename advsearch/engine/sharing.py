"""Queries answered by workers, in the order in which they were asked."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import torch

from advsearch.attacks import Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.cluster.executor import Call, Executor, Workforce
from advsearch.engine.problem import Prepared, Problem
from advsearch.engine.rows import no_answer
from advsearch.errors import ClusterError

Sent: TypeAlias = tuple[str, Prepared, Query]
"""The name of the problem, what it has been prepared with, and what is asked."""


@dataclass
class Shared:
    """Answers queries of a problem: several at once by workers, where there are some, and all others here.

    Attributes:
        problem: what is asked.
        executor: of `answering`; None where there are no workers.
        name: of the problem, where workers hold several.
    """

    problem: Problem
    executor: Executor | None = None
    name: str = ""

    def __call__(self, queries: Sequence[Query]) -> Iterable[Evaluation]:
        """Answer them: see `advsearch.attacks.evaluation.Evaluate`."""
        if self.executor is None or len(queries) < 2:
            return map(self.problem.evaluate, queries)
        return self._sent(self.executor, queries)

    @property
    def facts(self) -> Workforce | None:
        """How the workers do; None where there are none."""
        return None if self.executor is None else self.executor.facts

    @property
    def told(self) -> dict[str, float | str]:
        """The same, beside a bar."""
        return {} if self.facts is None else self.facts.told

    def _sent(self, executor: Executor, queries: Sequence[Query]) -> Iterator[Evaluation]:
        """What workers say, each when it is its turn."""
        sent: list[Sent] = [(self.name, self.problem.prepared, query) for query in queries]
        early, turn = dict[int, Evaluation](), 0
        results: Any = executor.results((range(number, number + 1) for number in range(len(sent))), sent)
        with closing(results):
            for done in results:
                number = done.numbers.start
                answer = lost(queries[number], done.lost) if done.lost else done.value[0]
                early[number] = replace(answer, machine=done.machine)
                while turn in early:
                    self.problem.renderer.non_finite += early[turn].non_finite
                    yield early.pop(turn)
                    turn += 1


def answering(problem_of: Callable[[str], Problem]) -> Call:
    """Return what answers queries of problems, by their names: what a worker does."""
    held: dict[str, Problem] = {}

    def call(sent: Sequence[Sent]) -> list[Evaluation]:
        found = []
        for name, prepared, query in sent:
            if name not in held:
                held[name] = problem_of(name)
            held[name].prepared = prepared
            found.append(held[name].evaluate(query))
        return found

    return call


def lost(query: Query, why: str) -> Evaluation:
    """Return what stands for an answer that nobody could give.

    Raises:
        ClusterError: nothing can stand for it.
    """
    if query.wanted != "judgement":
        what = "a picture" if query.wanted == "picture" else "the light of a condition"
        raise ClusterError(f"{what}: {why}; `advsearch resume RUN workers=null` makes it here")
    gradient = torch.zeros_like(query.u) if query.gradient else None
    return Evaluation(math.nan, gradient, False, cost=query.samples, judgement=no_answer(why), lost=True)
