"""One way to answer: queries by workers, and the journal."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from advsearch.attacks import Query
from advsearch.cluster import InProcess
from advsearch.engine.journal import Journal, ParallelEvaluator, make_worker_call
from advsearch.runs.directory import RunDirectory
from stand_ins import StandInProblem, StandInWorkers


def queries(count: int, **more: Any) -> list[Query]:
    return [Query(torch.full((6,), 0.1 * number), number, "average", number, **more) for number in range(count)]


class RendererCount:
    """Counts what was not finite."""

    n_non_finite = 0


def test_answers_come_in_the_order_of_the_queries_whoever_gives_them() -> None:
    here, there = StandInProblem(), StandInProblem()
    here.preparation, here.renderer = None, RendererCount()  # type: ignore[attr-defined]
    problem: Any = here
    workers: Any = StandInWorkers(InProcess(make_worker_call(lambda name: there)))
    alone, shared = (list(ParallelEvaluator(problem, executor)(queries(5))) for executor in (None, workers))
    assert [one.required_judgement for one in alone] == [one.required_judgement for one in shared] and len(
        workers.given
    ) == 5
    assert [one.machine for one in shared] == [*["ab12"] * 4, None], "the last was answered first"
    assert len(list(ParallelEvaluator(problem, workers)(queries(1)))) == 1 and len(workers.given) == 5, (
        "one alone is done here"
    )


def test_what_is_in_the_journal_is_not_asked_again(tmp_path: Path) -> None:
    problem: Any = StandInProblem()
    asked = list[int]()

    def evaluate(some: Sequence[Query]) -> Iterator[Any]:
        for one in some:
            asked.append(one.row_index)
            yield problem.evaluate(one)

    with RunDirectory.create(tmp_path / "run") as run:
        first = list(Journal(run, ParallelEvaluator(problem)).evaluate_all(queries(3), evaluate))
        journal = Journal(run, ParallelEvaluator(problem))
        again = list(journal.evaluate_all(queries(5), evaluate))
        assert asked == [0, 1, 2, 3, 4] and [one.required_judgement for one in again[:3]] == [
            one.required_judgement for one in first
        ]
        stopped = journal.evaluate_all(queries(8), evaluate)
        for _ in range(6):
            next(stopped)
        assert run.store.count_rows("average") == 6, "a row is kept before its answer is seen, and no more is asked for"
