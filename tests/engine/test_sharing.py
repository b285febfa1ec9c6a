"""One way to answer: queries by workers, the journal, and the page that names the functions on the way."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from advsearch.attacks import Query
from advsearch.cluster import InProcess
from advsearch.engine.journal import Journal, ParallelEvaluator, make_lost_evaluation, make_worker_call
from advsearch.errors import ClusterError
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import CachedEvaluation, Row
from conftest import ROOT
from stand_ins import StandInProblem, StandInWorkers


def queries(count: int, **more: Any) -> list[Query]:
    return [Query(torch.full((6,), 0.1 * number), number, "average", number, **more) for number in range(count)]


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


class RendererCount:
    """Counts what was not finite."""

    non_finite = 0


def test_what_nobody_could_answer_says_so_or_ends_the_run() -> None:
    (query,) = queries(1)
    answer = make_lost_evaluation(query, "they died")
    assert answer.is_lost and not answer.success and answer.required_judgement.payload == {"lost": "they died"}
    for wanted in ("picture", "light"):
        with pytest.raises(ClusterError, match="they died; `advsearch resume RUN workers=null`"):
            make_lost_evaluation(Query(query.u, 0, product=wanted), "they died")


def test_what_is_in_the_journal_is_not_asked_again(tmp_path: Path) -> None:
    problem: Any = StandInProblem()
    asked = list[int]()

    def evaluate(some: Sequence[Query]) -> Iterator[Any]:
        for one in some:
            asked.append(one.number)
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


def test_reading_back_takes_none_of_the_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("time.perf_counter", lambda: now)
    with RunDirectory.create(tmp_path / "run") as run:
        run.append_rows(
            *(Row("search", step, seconds=1.0, phase="search") for step in range(3)),
            cached=CachedEvaluation(2, b"", 0, 1),
        )
        late = Journal(run, ParallelEvaluator(StandInProblem())).make_time_check("search", 3.5)  # type: ignore[arg-type]
        assert late is not None and not late(1)
        now += 0.4
        assert not late(2) and not late(3), "half a second is left after what was read back"
        now += 0.6
        assert late(3)


def test_the_page_names_the_functions_on_the_way() -> None:
    page = (ROOT / "docs" / "one-question.md").read_text("utf-8")
    rows = re.findall(r"^\| `([a-z_/.]+)` \| (.*?) \|", page, re.MULTILINE)
    assert len(rows) > 10
    for place, functions in rows:
        folder = ROOT / "advsearch" / place
        files = sorted(folder.rglob("*.py")) if folder.is_dir() else [folder]
        defined = {
            one.name
            for file in files
            for one in ast.walk(ast.parse(file.read_text("utf-8")))
            if isinstance(one, (ast.FunctionDef, ast.ClassDef))
        }
        for name in re.findall(r"`([\w.]+)`", functions):
            assert set(name.split(".")) <= defined, f"{place} has no {name}"
