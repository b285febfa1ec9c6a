"""The journal of a run: what was asked and answered, as rows of its store. What is in
it is not asked again, so a run goes on by asking everything once more, with the
functions and networks that it began with; the rest is answered in order, by workers
where there are some.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from types import CellType, CodeType
from typing import Any, Protocol, TypeAlias

import numpy as np
import torch
from torch import Tensor

from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.cluster import Call, Workers, WorkerStats
from advsearch.engine.problem import Prepared, Problem
from advsearch.engine.record import LOST, judged, judgement_of, trial_row
from advsearch.errors import ClusterError, InputError
from advsearch.models import Model, RemoteNetwork
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row, Told
from advsearch.scene.color import levels_of
from advsearch.tasks import Judgement, Prediction
from advsearch.tasks.together import Ensemble

ProblemKey = str | float
"""Tells a problem from others that workers hold: its name, or by how much its ambient
light is multiplied.
"""
Sent: TypeAlias = tuple[ProblemKey, Prepared | None, Query]
"""The name of the problem, what it has been prepared with, and what is asked."""


class Answerer(Protocol):
    """What answers queries: a `Problem`, or a scene of a sweep."""

    def evaluate_all(
        self, queries: Sequence[Query], prepared: Prepared | None = None
    ) -> Iterable[Evaluation]:
        """See `advsearch.attacks.evaluation.Evaluate`; with what the problem that asks
        has been prepared with.
        """


@dataclass
class Shared:
    """Answers queries of a problem: several at once by an executor of `worker_call`,
    where there is one, and all others here. Its `name` tells it from others that
    workers hold. A sweep asks scenes, and has none.
    """

    own: Problem | None
    executor: Workers | None = None
    name: ProblemKey = ""

    @property
    def problem(self) -> Problem:
        if self.own is None:
            raise RuntimeError(
                "a sweep has a problem for each scene and model, and none of its own"
            )
        return self.own

    @property
    def facts(self) -> WorkerStats | None:
        return None if self.executor is None else self.executor.facts

    @property
    def told(self) -> dict[str, float | str]:
        """The same, beside a bar."""
        return {} if self.facts is None else self.facts.told

    def __call__(self, queries: Sequence[Query]) -> Iterator[Evaluation]:
        """Answer queries, each when it is its turn."""
        if self.executor is None or len(queries) < 2:
            yield from map(self.problem.evaluate, queries)
            return
        sent: list[Sent] = [
            (self.name, self.problem.prepared, query) for query in queries
        ]
        early = dict[int, Evaluation]()
        turn = 0
        numbers = {id(item): number for number, item in enumerate(sent)}
        results: Any = self.executor.results([item] for item in sent)
        with closing(results):
            for done in results:
                number = numbers[id(done.items[0])]
                evaluation = (
                    lost(queries[number], done.lost) if done.lost else done.value[0]
                )
                early[number] = replace(evaluation, machine=done.machine)
                while turn in early:
                    self.problem.renderer.non_finite += early[turn].non_finite
                    yield early.pop(turn)
                    turn += 1


def worker_call(named: Callable[[Any], Answerer]) -> Call:
    """Return what answers queries that were sent: what a worker does."""

    def call(sent: Sequence[Sent]) -> list[Evaluation]:
        evaluations = list[Evaluation]()
        for name, items in groupby(sent, lambda item: item[0]):
            # prepared with the same, as they are sent together
            (_, prepared, first), *others = items
            evaluations += named(name).evaluate_all(
                [first, *(query for _, _, query in others)], prepared
            )
        return evaluations

    return call


def lost(query: Query, why: str) -> Evaluation:
    """Return what stands for an evaluation that nobody could make."""
    if query.wanted != "judgement":
        what = "a picture" if query.wanted == "picture" else "the light of a condition"
        raise ClusterError(
            f"{what}: {why}; `advsearch resume RUN workers=null` makes it here"
        )
    gradient = torch.zeros_like(query.u) if query.gradient else None
    cost = 0 if query.phase is None else query.samples
    said = Judgement(
        math.nan,
        math.nan,
        right=False,
        prediction=Prediction(LOST, None, None),
        payload={"lost": why},
    )
    return Evaluation(math.nan, gradient, False, cost=cost, judgement=said, lost=True)


MADE_OF = "made of"  # the note of functions and weights


def check_made_of(
    run: RunDirectory,
    models: Sequence[Model],
    functions: Mapping[str, Callable[..., Any] | None] | None = None,
) -> None:
    """Note what networks and functions are, or refuse to go on with others than a run
    began with. A model behind an address keeps its answers in the run.
    """
    facts: dict[str, str | None] = {}
    for model in models:
        for network in (
            model.module.models if isinstance(model.module, Ensemble) else (model,)
        ):
            if isinstance(network.module, RemoteNetwork):
                network.module.keep_in(run.store)
            facts[f"model {network.name}"] = weights_digest(network)
    facts |= {
        name: code_digest(function)
        for name, function in (functions or {}).items()
        if function is not None
    }
    run.check_unchanged(
        MADE_OF, {name: digest for name, digest in facts.items() if digest is not None}
    )


def weights_digest(model: Model) -> str | None:
    """Return the SHA-256 of a network's weights and buffers, with their names; None
    where it shows none.
    """
    try:
        state = model.module.state_dict()  # type: ignore[attr-defined]
        tensors = {
            name: tensor for name, tensor in state.items() if isinstance(tensor, Tensor)
        }
        digest = hashlib.sha256()
        for name, tensor in sorted(tensors.items()):
            digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
            digest.update(
                tensor.detach()
                .cpu()
                .contiguous()
                .flatten()
                .view(torch.uint8)
                .numpy()
                .tobytes()
            )
    except (AttributeError, RuntimeError, TypeError, NotImplementedError):
        return None
    return digest.hexdigest() if tensors else None


def code_digest(function: Callable[..., Any]) -> str | None:
    """Return a digest of what a function does, and of the arrays that an object holds
    which is called as one; None where it has no Python code.
    """
    while isinstance(function, partial):
        function = function.func
    bare = inspect.unwrap(function)
    bare = getattr(bare, "__func__", bare)
    arrays: list[Any] = []
    if not hasattr(bare, "__code__"):
        arrays = [
            (name, _plain(value))
            for name, value in sorted(getattr(bare, "__dict__", {}).items())
        ]
        arrays = [pair for pair in arrays if isinstance(pair[1], bytes)]
        bare = getattr(type(bare), "forward", None) or type(bare).__call__
    code = getattr(bare, "__code__", None)
    if code is None:
        return None
    cells = [_plain(cell) for cell in getattr(bare, "__closure__", None) or ()]
    parts = (
        _parts(code, getattr(bare, "__doc__", None)),
        _plain(getattr(bare, "__defaults__", None)),
        cells,
        arrays,
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _parts(code: CodeType, text: str | None = None) -> tuple[Any, ...]:
    """What a function does, without where it stands, what it is called and the text
    that describes it.
    """
    inner = [
        _parts(part) if isinstance(part, CodeType) else _plain(part)
        for part in code.co_consts
        if part != text
    ]
    return code.co_code.hex(), inner, code.co_names, code.co_freevars


def _plain(value: Any) -> Any:
    """Numbers and texts, however deep, and a digest of an array; of anything else its
    type, since its text may be another one in each process.
    """
    if isinstance(value, CellType):
        try:
            return _plain(value.cell_contents)
        except ValueError:  # nothing is in it yet
            return None
    if isinstance(value, (tuple, list)):
        return [_plain(part) for part in value]
    if isinstance(value, frozenset):
        return sorted(map(repr, value))
    if isinstance(value, (np.ndarray, Tensor)):
        array = np.ascontiguousarray(
            value.detach().cpu() if isinstance(value, Tensor) else value
        )
        return hashlib.sha256(
            f"{array.dtype} {array.shape}".encode() + array.tobytes()
        ).digest()
    return (
        value
        if isinstance(value, (int, float, complex, str, bytes, type(None)))
        else type(value).__name__
    )


MACHINES = "machines"  # the note under which the store keeps what they are


# the note under which the store keeps how derivatives are obtained
PLAN = "gradient plan"


@dataclass
class Journal:
    """What a run has asked and was answered, without a run directory kept in `rows`;
    `traced` answers what nothing predicts. It counts queries that nobody could answer
    (`lost`), and knows the machines that are not like this one, by the names that rows
    have.
    """

    run: RunDirectory | None
    traced: Shared
    rows: list[Row] = field(default_factory=list)
    lost: int = 0
    machines: dict[str, dict[str, str]] = field(default_factory=dict)
    _counts: dict[str, int] = field(default_factory=dict)
    _trials: dict[str, dict[int, Evaluation]] = field(default_factory=dict)
    _opened: bool = False

    @property
    def problem(self) -> Problem:
        return self.traced.problem

    def __post_init__(self) -> None:
        # once, and not for another problem of the same run
        if self.run is not None and not self._opened:
            self.machines |= self.note(MACHINES) or {}
            self._counts |= self.run.store.counts()
            self._opened = True

    # ---- queries

    def evaluate_all(
        self,
        queries: Sequence[Query],
        evaluate: Evaluate | None = None,
        passed: Callable[[Query], None] = lambda query: None,
    ) -> Iterator[Evaluation]:
        """Answer queries in their order: from the journal, or else by `evaluate` (None
        for `traced`), and then they are in it. `passed` is told of every query of a
        search that is read back.
        """
        stored = [self._read(query) for query in queries]
        evaluate = self.traced if evaluate is None else evaluate
        asked = iter(
            evaluate(
                [
                    query
                    for query, known in zip(queries, stored, strict=True)
                    if known is None
                ]
            )
        )
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
        """The trials of a kind by their numbers: those of earlier lives, and of this
        one.
        """
        if kind not in self._trials:
            rows = (
                ()
                if self.run is None or kind not in self._counts
                else self.run.store.rows(kind)
            )
            # old ones don't say it
            stored = {row.step: row for row in rows if row.correct is not None}
            self._trials[kind] = {
                step: Evaluation.of(
                    judgement_of(row),
                    predicted=0 if row.seed is not None else row.spp or 1,
                )
                for step, row in stored.items()
            }
            self.lost += sum(
                trial.said.prediction.label == LOST
                for trial in self._trials[kind].values()
            )
        return self._trials[kind]

    def _read(self, query: Query) -> Evaluation | None:
        if query.phase is None:
            return self._trials_of(query.kind).get(query.number)
        if self.run is None or query.number >= self._counts.get(query.kind, 0):
            return None
        stored = self.run.store.told(query.kind, query.number)
        if stored is None:
            return None
        row, beside = stored
        if beside.u != digest(query.u) or row.seed != query.seed:
            raise InputError(
                f"{self.run.path}: cannot resume: evaluation {query.number} of the "
                f"{query.kind} is not the one that "
                "was stored, so advsearch, its packages or the number of threads have "
                "changed since; "
                f"{self.run.again}"
            )
        if beside.non_finite:
            self.problem.renderer.non_finite += beside.non_finite
        return Evaluation(
            objective=math.nan if row.objective is None else row.objective,
            gradient=None
            if beside.gradient is None
            else torch.from_numpy(beside.gradient.copy()),
            success=bool(row.success),
            non_finite=beside.non_finite,
            cost=beside.cost,
            judgement=None if row.correct is None else judgement_of(row),
            picture=None
            if beside.picture is None
            else torch.from_numpy(beside.picture.copy()).float() / 255.0,
        )

    def keep(
        self, evaluated: Sequence[tuple[Query, Evaluation]], *, numbered: bool = False
    ) -> list[Row]:
        """Write evaluations in one transaction, a row each; what a search was told goes
        beside it. If `numbered`, the place of a row in the store is the query's number,
        in whatever order they come.
        """
        rows = list[Row]()
        told = None
        for query, evaluation in evaluated:
            self.lost += evaluation.lost
            if (name := evaluation.machine) is not None and name not in self.machines:
                facts = self.traced.facts
                self.machines[name] = (
                    {} if facts is None else dict(facts.machines.get(name, {}))
                )
                self.set_note(MACHINES, self.machines)
            if query.phase is None:
                values = dict(query.values)
                if query.drawn:
                    values |= self.problem.conditions_of(query.u, query.seed)
                # it has no noise of its own
                seed = None if evaluation.predicted else query.seed
                spp = evaluation.predicted or query.spp
                row = trial_row(
                    query.kind,
                    query.number,
                    seed,
                    spp,
                    evaluation.said,
                    values,
                    sought=query.sought,
                )
                row = replace(
                    row,
                    machine=evaluation.machine,
                    renders=evaluation.cost,
                    seconds=evaluation.seconds,
                )
                if not numbered:
                    self._trials_of(query.kind)[query.number] = replace(
                        evaluation, picture=None
                    )
            elif query.number < self._counts.get(
                query.kind, 0
            ):  # it had a row when the run, done by then, was opened
                continue
            else:
                row, told = self._row_of_search(query, evaluation)
            rows.append(replace(row, id=query.number + 1) if numbered else row)
        if self.run is None:
            for row in rows:
                self.rows.append(
                    replace(row, id=row.id or len(self.rows) + 1, time=time.time())
                )
        elif rows:
            self.run.record(*rows, told=told)
        return rows

    def _row_of_search(self, query: Query, evaluation: Evaluation) -> tuple[Row, Told]:
        problem = self.problem
        finite = evaluation.finite
        gradient = evaluation.gradient
        picture = evaluation.picture
        row = Row(
            query.kind,
            query.number,
            query.seed,
            None if evaluation.predicted else problem.spp * query.samples,
            objective=evaluation.objective if finite else math.nan,
            success=evaluation.success and finite,
            values=problem.describe(query.u),
            seconds=evaluation.seconds,
            phase=query.phase,
            renders=0 if evaluation.predicted else evaluation.cost * problem.draws,
            machine=evaluation.machine,
        )
        told = Told(
            query.number,
            digest(query.u),
            evaluation.non_finite,
            evaluation.cost,
            None if gradient is None else gradient.detach().numpy(),
            None if picture is None else levels_of(picture).numpy(),
        )
        return row if evaluation.judgement is None else judged(
            row, evaluation.judgement
        ), told

    def clock(self, kind: str, seconds: float | None) -> Callable[[int], bool] | None:
        """Return what says whether the time of a search is over, that of its earlier
        lives included.

        An evaluation that is read back never ends the search before the one after which
        it was ended; if the store has renders of the ranking, that is the last one
        before these.
        """
        if seconds is None:
            return None
        stored: Iterable[Row] = (
            ()
            if self.run is None or not self.run.store.goes_on
            else self.run.store.rows(kind)
        )
        phases = [(row.phase, row.seconds or 0.0) for row in stored]
        explored = [spent for phase, spent in phases if phase == "search"]
        left = seconds - math.fsum(explored)
        begun = time.perf_counter()

        def late(count: int) -> bool:
            nonlocal begun
            if count < len(explored):
                begun = time.perf_counter()  # to read back takes none of the time
                return False
            return len(phases) > len(explored) or time.perf_counter() - begun >= left

        return late

    @property
    def remarks(self) -> list[str]:
        """What a reader has to know of the other machines."""
        if not self.machines:
            return []
        told = "; ".join(
            ", ".join(f"{key} {text}" for key, text in facts.items())
            for facts in self.machines.values()
        )
        return [
            "Rows come from machines that are not alike, so that their last bits may "
            "differ; beside the one that kept "
            f"the run: {told}."
        ]

    # ---- notes

    def note(self, key: str) -> Any:
        return None if self.run is None else self.run.store.noted(key)

    def set_note(self, key: str, value: Any) -> None:
        if self.run is not None:
            self.run.store.set_note(key, json.dumps(value))


def digest(u: Tensor) -> bytes:
    return hashlib.blake2b(
        np.ascontiguousarray(u.detach().numpy()).tobytes(), digest_size=16
    ).digest()
