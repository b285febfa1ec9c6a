"""The journal of a run: what was asked and answered, as rows of its store. A question that is in it is not asked again.

So a run that was stopped goes on by asking everything once more, in the same order: it reads back what it knows, and a
search comes to where it was by being told all of it.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.engine.going_on import same
from advsearch.engine.machines import Machines
from advsearch.engine.problem import Problem
from advsearch.engine.rows import LOST, judged, judgement_of, trial_row
from advsearch.engine.sharing import Shared
from advsearch.errors import InputError
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row, Told
from advsearch.scene.formation import levels_of

PLAN = "gradient plan"
"""The note under which the store keeps how derivatives are obtained."""


@dataclass
class Journal:
    """What a run has asked and was answered. Without a run directory it is kept in memory.

    Attributes:
        run: the open run directory, or None.
        traced: answers what nothing predicts.
        problem: whose questions they are; it describes configurations.
        rows: what was written, where there is no run directory.
        lost: queries that nobody could answer.
        machines: on which answers were made that are not like this one.
    """

    run: RunDirectory | None
    traced: Shared
    rows: list[Row] = field(default_factory=list)
    lost: int = 0
    machines: Machines = field(default_factory=lambda: Machines(None))
    _counts: dict[str, int] = field(default_factory=dict)
    _trials: dict[str, dict[int, Evaluation]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.problem: Problem = self.traced.problem
        if self.run is not None and self.machines.run is None:  # not that of another problem of the same run
            self.machines = Machines(self.run)
            self._counts |= self.run.store.counts()

    # ---- queries ----------------------------------------------------------------------------------------------------

    def answers(
        self,
        queries: Sequence[Query],
        evaluate: Evaluate | None = None,
        passed: Callable[[Query], None] = lambda query: None,
    ) -> Iterator[Evaluation]:
        """Answer queries in their order: from the journal, or else by asking, and then they are in it.

        Args:
            queries: of one kind.
            evaluate: answers what is not in the journal; None for `traced`.
            passed: told of every query of a search that is read back.

        Raises:
            InputError: an evaluation of a search is another one than it was.
        """
        stored = [self._read(query) for query in queries]
        evaluate = self.traced if evaluate is None else evaluate
        asked = iter(evaluate([query for query, known in zip(queries, stored, strict=True) if known is None]))
        for query, known in zip(queries, stored, strict=True):
            begun = time.perf_counter()
            if known is None:
                known = next(asked)
                seconds = None if query.phase is None else time.perf_counter() - begun
                self.keep([(query, replace(known, seconds=seconds))])
            elif query.phase is not None:
                passed(query)
            yield known

    def _trials_of(self, kind: str) -> dict[int, Evaluation]:
        """The trials of a kind by their numbers: those of earlier lives, and of this one."""
        if kind not in self._trials:
            rows = () if self.run is None or kind not in self._counts else self.run.store.rows(kind)
            stored = {row.step: row for row in rows if row.correct is not None}  # old ones don't say it
            self._trials[kind] = {
                step: Evaluation.of(judgement_of(row), predicted=0 if row.seed is not None else row.spp or 1)
                for step, row in stored.items()
            }
            self.lost += sum(one.said.answer.label == LOST for one in self._trials[kind].values())
        return self._trials[kind]

    def _holds(self, query: Query) -> bool:
        """Whether an evaluation of a search had its row when the run was opened."""
        return query.number < self._counts.get(query.kind, 0)

    def _read(self, query: Query) -> Evaluation | None:
        if query.phase is None:
            return self._trials_of(query.kind).get(query.number)
        told = self.run.store.told(query.kind, query.number) if self.run is not None and self._holds(query) else None
        if told is None:
            return None
        row, beside = told
        if beside.u != digest(query.u) or row.seed != query.seed:
            path, again = ("", "") if self.run is None else (self.run.path, self.run.again)
            raise InputError(
                f"{path}: cannot go on: evaluation {query.number} of the {query.kind} is another one now than it was, "
                f"so advsearch, its packages or the number of threads have changed since; {again}"
            )
        if beside.non_finite:
            self.problem.renderer.non_finite += beside.non_finite
        return Evaluation(
            objective=math.nan if row.objective is None else row.objective,
            gradient=None if beside.gradient is None else torch.from_numpy(beside.gradient.copy()),
            success=bool(row.success),
            non_finite=beside.non_finite,
            cost=beside.cost,
            judgement=None if row.correct is None else judgement_of(row),
            picture=None if beside.picture is None else torch.from_numpy(beside.picture.copy()).float() / 255.0,
        )

    def keep(self, answered: Sequence[tuple[Query, Evaluation]], *, numbered: bool = False) -> list[Row]:
        """Write answers in one transaction, a row each; what a search was told goes beside it.

        Args:
            answered: queries with their answers; of a search one at a time.
            numbered: whether the place of a row in the store is the query's number, in whatever order they come.

        Returns:
            The rows.
        """
        rows, told = list[Row](), None
        for query, answer in answered:
            self.lost += answer.lost
            if answer.machine is not None:
                self.machines.meet(answer.machine, self.traced.facts)
            if query.phase is None:
                row = self._row_of_trial(query, answer)
                if not numbered:
                    self._trials_of(query.kind)[query.number] = replace(answer, picture=None)
            elif self._holds(query):  # of a run that was done
                continue
            else:
                row, told = self._row_of_search(query, answer)
            rows.append(replace(row, id=query.number + 1) if numbered else row)
        if self.run is None:
            for row in rows:
                self.rows.append(replace(row, id=row.id or len(self.rows) + 1, time=time.time()))
        elif rows:
            self.run.record(*rows, told=told)
        return rows

    def _row_of_trial(self, query: Query, answer: Evaluation) -> Row:
        values = dict(query.values)
        if query.drawn:
            values |= self.problem.conditions_of(query.u, query.seed)
        seed = None if answer.predicted else query.seed  # it has no noise of its own
        spp = answer.predicted or query.spp
        said, told = answer.said, {"machine": answer.machine, "renders": answer.cost, "seconds": answer.seconds}
        return trial_row(query.kind, query.number, seed, spp, said, values, sought=query.sought, **told)

    def _row_of_search(self, query: Query, answer: Evaluation) -> tuple[Row, Told]:
        problem = self.problem
        row = Row(
            kind=query.kind,
            step=query.number,
            seed=query.seed,
            spp=None if answer.predicted else problem.spp * query.samples,
            objective=answer.objective if (finite := answer.finite) else math.nan,
            success=answer.success and finite,
            values=problem.describe(query.u),
            seconds=answer.seconds,
            renders=0 if answer.predicted else answer.cost * problem.draws,
            phase=query.phase,
            machine=answer.machine,
        )
        told = Told(
            number=query.number,
            u=digest(query.u),
            non_finite=answer.non_finite,
            cost=answer.cost,
            gradient=None if answer.gradient is None else answer.gradient.detach().numpy(),
            picture=None if answer.picture is None else levels_of(answer.picture).numpy(),
        )
        return row if answer.judgement is None else judged(row, answer.judgement), told

    def clock(self, kind: str, seconds: float | None) -> Callable[[int], bool] | None:
        """Return what says whether the time of a search is over, that of its earlier lives included.

        An evaluation that is read back never ends the search before the one after which it was ended; if the store has
        renders of the ranking, that is the last one before these.

        Args:
            kind: of search.
            seconds: allowed; None for no limit.
        """
        if seconds is None:
            return None
        stored: Iterable[Row] = () if self.run is None or not self.run.store.goes_on else self.run.store.rows(kind)
        phases = [(row.phase, row.seconds or 0.0) for row in stored]
        explored = [spent for phase, spent in phases if phase == "search"]
        left, begun = seconds - math.fsum(explored), time.perf_counter()

        def late(count: int) -> bool:
            nonlocal begun
            if count < len(explored):
                begun = time.perf_counter()  # to read back takes none of the time
                return False
            return len(phases) > len(explored) or time.perf_counter() - begun >= left

        return late

    # ---- notes ------------------------------------------------------------------------------------------------------

    def note(self, key: str) -> Any:
        """Return the JSON value that was noted, or None."""
        return None if self.run is None else self.run.store.noted(key)

    def set_note(self, key: str, value: Any) -> None:
        """Keep a JSON value."""
        if self.run is not None:
            self.run.store.set_note(key, json.dumps(value))


def other_answers(run: RunDirectory | None, values: Mapping[str, tuple[float | None, float | None]]) -> InputError:
    """Return the error of a run that goes on with another model or objective, from what these said and say."""
    told = ", ".join(
        f"{name} was {before} and is {now}" for name, (before, now) in values.items() if not same([before], [now])
    )
    path, again = ("", "") if run is None else (run.path, run.again)
    return InputError(
        f"{path}: cannot go on: the same picture of the clean scene has other values now ({told}), so model, "
        f"objective or scene are not those that it began with; take these again, or {again}"
    )


def digest(u: Tensor) -> bytes:
    """Return what tells a configuration from others."""
    return hashlib.blake2b(np.ascontiguousarray(u.detach().numpy()).tobytes(), digest_size=16).digest()
