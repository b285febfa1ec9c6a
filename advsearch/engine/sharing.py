"""Queries answered by workers, in the order in which they were asked."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Protocol, TypeAlias

import torch

from advsearch.attacks import Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.cluster.executor import Call, Executor, Workforce
from advsearch.engine.problem import Prepared, Problem
from advsearch.engine.rows import no_answer
from advsearch.errors import ClusterError

Sent: TypeAlias = tuple[str, Prepared | None, Query]
"""The name of the problem, what it has been prepared with, and what is asked."""


class Answering(Protocol):
    """What answers queries: a `Problem`, or a scene of a sweep."""

    prepared: Any

    def answers(self, queries: Sequence[Query]) -> Iterable[Evaluation]:
        """See `advsearch.attacks.evaluation.Evaluate`."""


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
        numbers = {id(one): number for number, one in enumerate(sent)}
        results: Any = executor.results([one] for one in sent)
        with closing(results):
            for done in results:
                number = numbers[id(done.items[0])]
                answer = lost(queries[number], done.lost) if done.lost else done.value[0]
                early[number] = replace(answer, machine=done.machine)
                while turn in early:
                    self.problem.renderer.non_finite += early[turn].non_finite
                    yield early.pop(turn)
                    turn += 1


def answering(named: Callable[[str], Answering]) -> Call:
    """Return what answers queries that were sent: what a worker does.

    Args:
        named: returns what answers the queries to a name; it keeps what it has loaded.
    """

    def call(sent: Sequence[Sent]) -> list[Evaluation]:
        found = list[Evaluation]()
        for name, some in groupby(sent, lambda one: one[0]):
            listed, asked = list(some), named(name)
            asked.prepared = listed[0][1]  # the same of all that are sent together
            found += asked.answers([query for _, _, query in listed])
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
    cost = 0 if query.phase is None else query.samples
    return Evaluation(math.nan, gradient, False, cost=cost, judgement=no_answer(why), lost=True)
