"""The journal of a run: its queries and their evaluations, as rows of its store.

A stored evaluation is not computed again. So a run is resumed by sending all queries
once more, with the same functions and networks. Queries that are not stored are
evaluated in order, by workers if there are any.
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
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.cluster import BatchFunction, BatchResult, Workers, WorkerStats
from advsearch.engine.problem import Preparation, Problem
from advsearch.engine.record import (
    LOST_LABEL,
    add_judgement,
    make_trial_row,
    read_judgement,
)
from advsearch.errors import ClusterError, InputError
from advsearch.models import Model, RemoteNetwork
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import CachedEvaluation, Row
from advsearch.scene.color import to_uint8
from advsearch.tasks import Judgement, Prediction
from advsearch.tasks.together import Ensemble

ProblemKey = str | float
"""Identifies a problem among those of workers: its name, or the factor of its ambient
light.
"""
WorkItem: TypeAlias = tuple[ProblemKey, Preparation | None, Query]
"""A query for a worker: (key of the problem, preparation of the problem, query)."""


class Evaluator(Protocol):
    """Evaluates queries: a `Problem`, or a scene of a sweep."""

    def evaluate_all(
        self, queries: Sequence[Query], preparation: Preparation | None = None
    ) -> Iterable[Evaluation]:
        """Evaluate queries in order; see `advsearch.attacks.evaluation.Evaluate`.

        `preparation` is the preparation of the problem that sends them.
        """


@dataclass
class ParallelEvaluator:
    """Evaluates the queries of a problem, in parallel if there are workers.

    Attributes:
        optional_problem: the problem; None for a sweep, which has one for each scene
            and model.
        workers: workers that run `make_worker_call`; None to evaluate in this process.
        problem_key: identifies the problem among those of workers.
    """

    optional_problem: Problem | None
    workers: Workers | None = None
    problem_key: ProblemKey = ""

    @property
    def problem(self) -> Problem:
        if self.optional_problem is None:
            raise RuntimeError(
                "a sweep has a problem for each scene and model, and none of its own"
            )
        return self.optional_problem

    @property
    def worker_stats(self) -> WorkerStats | None:
        """Statistics of the workers; None without workers."""
        return None if self.workers is None else self.workers.stats

    @property
    def progress_stats(self) -> dict[str, float | str]:
        """Statistics of the workers for a progress bar."""
        return {} if self.worker_stats is None else self.worker_stats.progress_counts

    def __call__(self, queries: Sequence[Query]) -> Iterator[Evaluation]:
        """Evaluate queries, and yield the evaluations in the order of the queries.

        Workers finish in any order. A result waits here until the results of all
        earlier queries have been yielded.
        """
        # a single query is evaluated here: sending it away would save no time
        if self.workers is None or len(queries) < 2:
            yield from map(self.problem.evaluate, queries)
        else:
            yield from self._evaluate_on_workers(self.workers, queries)

    def _evaluate_on_workers(
        self, workers: Workers, queries: Sequence[Query]
    ) -> Iterator[Evaluation]:
        """Evaluate queries on workers, and yield the evaluations in their order."""
        items: list[WorkItem] = [
            (self.problem_key, self.problem.preparation, query) for query in queries
        ]
        # A result has the very object that was sent, so that its id finds the query.
        index_of_item = {id(item): index for index, item in enumerate(items)}
        # evaluations that came too early, by the index of their query
        waiting = dict[int, Evaluation]()
        next_index = 0
        results: Any = workers.compute([item] for item in items)
        with closing(results):
            for result in results:
                index = index_of_item[id(result.items[0])]
                waiting[index] = _make_worker_evaluation(queries[index], result)
                while next_index in waiting:
                    evaluation = waiting.pop(next_index)
                    # The renderer counts non-finite values as it renders. A worker has
                    # another renderer, so that its count is added here.
                    self.problem.renderer.n_non_finite += evaluation.n_non_finite
                    yield evaluation
                    next_index += 1


def _make_worker_evaluation(query: Query, result: BatchResult) -> Evaluation:
    """Return the evaluation of a query from a worker's result, with its machine."""
    if result.failure_reason:
        evaluation = make_lost_evaluation(query, result.failure_reason)
    else:
        evaluation = result.value[0]
    return replace(evaluation, machine=result.machine)


def make_worker_call(get_evaluator: Callable[[Any], Evaluator]) -> BatchFunction:
    """Return the function that a worker runs on queries that were sent to it.

    `get_evaluator` returns the evaluator of a problem by its key (`ProblemKey`).
    """

    def call(items: Sequence[WorkItem]) -> list[Evaluation]:
        """Evaluate work items, and return the evaluations in their order."""
        evaluations = list[Evaluation]()
        # `groupby` groups neighbors, and queries of one problem follow one another
        for key, group in groupby(items, _get_problem_key):
            items_of_problem = list(group)
            # All of them were sent together, and have the same preparation.
            _, preparation, _ = items_of_problem[0]
            queries = [query for _, _, query in items_of_problem]
            evaluations += get_evaluator(key).evaluate_all(queries, preparation)
        return evaluations

    return call


def _get_problem_key(item: WorkItem) -> ProblemKey:
    """Return the key of the problem of a work item."""
    key, _preparation, _query = item
    return key


def make_lost_evaluation(query: Query, reason: str) -> Evaluation:
    """Return the evaluation of a query whose workers all died.

    The search goes on with a result that teaches it nothing: objective and margin are
    NaN, and the gradient is zero.

    Args:
        query: query that was lost.
        reason: why it was lost, to follow a colon in a message.

    Raises:
        ClusterError: the query is for an image or for light, which nothing replaces.
    """
    _check_loss_is_replaceable(query, reason)
    gradient = torch.zeros_like(query.u) if query.gradient else None
    # An evaluation of a search, which has a phase, is paid from the budget of renders,
    # also if it is lost. A trial has no cost.
    cost = 0 if query.phase is None else query.samples
    return Evaluation(
        objective=math.nan,
        gradient=gradient,
        success=False,
        cost=cost,
        judgement=_make_lost_judgement(reason),
        is_lost=True,
    )


def _make_lost_judgement(reason: str) -> Judgement:
    """Return the judgement of an image that was never rendered."""
    return Judgement(
        score=math.nan,
        margin=math.nan,
        right=False,
        prediction=Prediction(LOST_LABEL),
        payload={"lost": reason},
    )


def _check_loss_is_replaceable(query: Query, reason: str) -> None:
    """Raise ClusterError for a lost query whose image or light nothing replaces."""
    if query.requested_output != "judgement":
        product = (
            "a picture"
            if query.requested_output == "picture"
            else "the light of a condition"
        )
        raise ClusterError(
            f"{product}: {reason}; `advsearch resume RUN workers=null` makes it here"
        )


DIGESTS_NOTE = "made of"  # the note that has the digests of functions and weights


def check_digests(
    run: RunDirectory,
    models: Sequence[Model],
    functions: Mapping[str, Callable[..., Any] | None] | None = None,
) -> None:
    """Store the digests of networks and functions, or check those of a resumed run.

    The digests of a new run are stored. A resumed run has to have the same digests. A
    model behind an address has none, as its weights are elsewhere. Its outputs are
    stored in the run instead.

    Args:
        run: run that is new or resumed.
        models: models of the run; of an ensemble each network counts.
        functions: user functions by name; None for one that was not given.

    Raises:
        InputError: a network or a function is not the one that the run began with.
    """
    digests: dict[str, str | None] = {}
    for model in models:
        for network in _list_networks(model):
            if isinstance(network.module, RemoteNetwork):
                network.module.store_answers_in(run.store)
            # None if the weights can't be read, as behind an address
            digests[f"model {network.name}"] = compute_weights_digest(network)
    for name, function in (functions or {}).items():
        if function is not None:
            digests[name] = compute_code_digest(function)
    known_digests = {
        name: digest for name, digest in digests.items() if digest is not None
    }
    # stores them if the run is new
    run.check_unchanged(DIGESTS_NOTE, known_digests)


def _list_networks(model: Model) -> Sequence[Model]:
    """Return the networks of an ensemble, or the model itself if it is none."""
    if isinstance(model.module, Ensemble):
        return model.module.models
    return (model,)


def compute_weights_digest(model: Model) -> str | None:
    """Return the SHA-256 of a network's weights and buffers, with their names.

    None for a network that does not give access to them, such as a user's function.
    """
    try:
        state = model.module.state_dict()  # type: ignore[attr-defined]
        tensors = {
            name: tensor for name, tensor in state.items() if isinstance(tensor, Tensor)
        }
        digest = _hash_tensors(tensors)
    except (AttributeError, RuntimeError, TypeError, NotImplementedError):
        return None  # it has no weights that can be read, such as a user's function
    return digest if tensors else None


def _hash_tensors(tensors: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of tensors with their names, data types and shapes."""
    digest = hashlib.sha256()
    # by name, since a network may list them in any order
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        # as bytes, since NumPy has no bfloat16
        flat = tensor.detach().cpu().contiguous().flatten()
        digest.update(flat.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def compute_code_digest(function: Callable[..., Any]) -> str | None:
    """Return the SHA-256 of what a function does; None if it has no Python code.

    It covers code, constants, defaults, closures and the arguments that a `partial`
    holds. If the function is an object with `__call__` or `forward`, it also covers the
    arrays that the object holds.
    """
    function, partial_arguments = _unwrap_partials(function)
    # without decorators, and a method without its object
    callee: Any = inspect.unwrap(function)
    callee = getattr(callee, "__func__", callee)
    arrays: list[Any] = []
    is_object = not hasattr(callee, "__code__")
    if is_object:
        arrays = _list_array_digests(callee)
        # a module of PyTorch computes in `forward`
        cls = type(callee)
        callee = getattr(cls, "forward", None) or cls.__call__
    code = getattr(callee, "__code__", None)
    if code is None:
        return None
    components = (*_simplify_callee(callee, code), arrays, *partial_arguments)
    return hashlib.sha256(repr(components).encode()).hexdigest()


def _unwrap_partials(
    function: Callable[..., Any],
) -> tuple[Callable[..., Any], list[tuple[Any, Any]]]:
    """Return the function in a `partial`, perhaps of a `partial`, and their arguments.

    The arguments, simplified, are those of the outermost `partial` first.
    """
    partial_arguments = []
    while isinstance(function, partial):
        keywords = sorted(function.keywords.items())
        partial_arguments.append((_simplify(function.args), _simplify(keywords)))
        function = function.func
    return function, partial_arguments


def _simplify_callee(callee: Any, code: CodeType) -> tuple[Any, Any, list[Any]]:
    """Return code, defaults and closure of a callee, each in a reproducible form."""
    closure = getattr(callee, "__closure__", None) or ()
    return (
        # the docstring, to leave it out
        _simplify_code(code, getattr(callee, "__doc__", None)),
        _simplify(getattr(callee, "__defaults__", None)),
        [_simplify(cell) for cell in closure],
    )


def _list_array_digests(holder: Any) -> list[tuple[str, Any]]:
    """Return name and digest of each array that is an attribute of an object.

    An attribute of type bytes is listed, too, with its value.
    """
    attributes = sorted(getattr(holder, "__dict__", {}).items())
    simplified = [(name, _simplify(value)) for name, value in attributes]
    # `_simplify` returns bytes for arrays (their digests) and for bytes.
    return [(name, digest) for name, digest in simplified if isinstance(digest, bytes)]


def _simplify_code(code: CodeType, docstring: str | None = None) -> tuple[Any, ...]:
    """Return the code of a function in a form whose repr is the same in every process.

    Name, line numbers and docstring are left out, as a change of these does not change
    what the function computes. Names of local variables are left out for that reason.

    Args:
        code: compiled code of the function.
        docstring: docstring of the function. Python stores it among the constants,
            where it is left out. None for code without one: then all constants that are
            None are left out, which makes no difference between two digests.
    """
    constants = [
        _simplify_code(constant)
        if isinstance(constant, CodeType)
        else _simplify(constant)
        for constant in code.co_consts
        if constant != docstring
    ]
    return code.co_code.hex(), constants, code.co_names, code.co_freevars


def _simplify(value: Any) -> Any:
    """Return a value whose repr is the same in every process.

    Numbers and strings stay, also in containers; arrays become their SHA-256, and other
    objects the name of their type.
    """
    if isinstance(value, CellType):
        return _simplify_cell(value)
    if isinstance(value, (tuple, list)):
        return [_simplify(item) for item in value]
    # A set among the constants of code is a frozenset. Its order differs from process
    # to process.
    if isinstance(value, frozenset):
        return sorted(map(repr, value))
    if isinstance(value, (np.ndarray, Tensor)):
        return _hash_array(value)
    if isinstance(value, (int, float, complex, str, bytes, type(None))):
        return value
    return type(value).__name__


def _simplify_cell(cell: CellType) -> Any:
    """Return the simplified value of a variable of a closure; None if it is empty."""
    try:
        return _simplify(cell.cell_contents)
    except ValueError:  # the cell is empty
        return None


def _hash_array(value: npt.NDArray[Any] | Tensor) -> bytes:
    """Return the SHA-256 of an array's data type, shape and contents."""
    if isinstance(value, Tensor):
        value = value.detach().cpu()
    array = np.ascontiguousarray(value)
    header = f"{array.dtype} {array.shape}".encode()
    return hashlib.sha256(header + array.tobytes()).digest()


# Keys of notes in the store: descriptions of machines that differ from this one, and
# the plan by which derivatives are computed.
MACHINES_NOTE = "machines"
PLAN_NOTE = "gradient plan"


@dataclass
class Journal:
    """The stored evaluations of a run.

    Attributes:
        run_directory: directory whose store has the rows; None to store them in `rows`.
        evaluator: evaluates queries whose images are not predicted.
        rows: rows of a journal without a run directory.
        n_lost: number of queries whose workers all died.
        machines: descriptions of machines that differ from this one, by the name in the
            rows that they evaluated.
    """

    run_directory: RunDirectory | None
    evaluator: ParallelEvaluator
    rows: list[Row] = field(default_factory=list)
    n_lost: int = 0
    machines: dict[str, dict[str, str]] = field(default_factory=dict)
    _counts: dict[str, int] = field(default_factory=dict)
    _trials: dict[str, dict[int, Evaluation]] = field(default_factory=dict)
    _opened: bool = False

    @property
    def problem(self) -> Problem:
        """The problem whose queries are evaluated."""
        return self.evaluator.problem

    def __post_init__(self) -> None:
        """Read from the store which machines and how many rows the run has.

        A copy made by `dataclasses.replace`, for another problem of the same run, gets
        `_opened` and the same dicts, which are changed in place. So nothing is read
        again.
        """
        if self.run_directory is not None and not self._opened:
            self.machines |= self.get_note(MACHINES_NOTE) or {}
            self._counts |= self.run_directory.store.count_by_kind()
            self._opened = True

    # ---- queries

    def evaluate_all(
        self,
        queries: Sequence[Query],
        evaluate: Evaluate | None = None,
        on_replay: Callable[[Query], None] = lambda query: None,
    ) -> Iterator[Evaluation]:
        """Yield the evaluations of queries in their order, from the store or new ones.

        New evaluations are stored before they are yielded.

        Args:
            queries: queries in order.
            evaluate: evaluates those that are not stored; None for the journal's own
                evaluator.
            on_replay: called with every query of a search that is read from the store.
                A trial depends on no state, and is not reported.
        """
        stored = [self._read(query) for query in queries]
        # those without a stored evaluation, to evaluate in one call
        new_queries = [
            query
            for query, evaluation in zip(queries, stored, strict=True)
            if evaluation is None
        ]
        evaluate = self.evaluator if evaluate is None else evaluate
        # lazy: an evaluation is computed when it is requested by `next` below
        new_evaluations = iter(evaluate(new_queries))
        for query, evaluation in zip(queries, stored, strict=True):
            # a query without a phase is a trial of the verification
            belongs_to_search = query.phase is not None
            if evaluation is None:
                evaluation = self._store_next(query, new_evaluations)
            elif belongs_to_search:
                on_replay(query)
            yield evaluation

    def _store_next(
        self, query: Query, new_evaluations: Iterator[Evaluation]
    ) -> Evaluation:
        """Compute the next new evaluation, that of a query, and store it.

        Only searches have a time limit, for which `make_time_check` reads the seconds
        of their rows.
        """
        started = time.perf_counter()
        evaluation = next(new_evaluations)
        seconds = None
        if query.phase is not None:
            seconds = time.perf_counter() - started
        self.store([(query, replace(evaluation, seconds=seconds))])
        return evaluation

    def _trials_of(self, kind: str) -> dict[int, Evaluation]:
        """Return the evaluated trials of a kind by their index.

        `store` adds new trials to this dict. The first call for a kind reads its rows
        from the store, and counts the lost ones: their workers died, which their label
        says.
        """
        if kind in self._trials:
            return self._trials[kind]
        trials = self._read_stored_trials(kind)
        self._trials[kind] = trials
        self.n_lost += sum(
            trial.required_judgement.prediction.label == LOST_LABEL
            for trial in trials.values()
        )
        return trials

    def _read_stored_trials(self, kind: str) -> dict[int, Evaluation]:
        """Return the stored trials of a kind by their index."""
        rows: Iterable[Row] = ()
        # `_counts` has the kinds of which rows were stored before
        if self.run_directory is not None and kind in self._counts:
            rows = self.run_directory.store.rows(kind)
        # Rows of old runs may have no judgement.
        return {
            row.step: _restore_trial(row) for row in rows if row.correct is not None
        }

    def _read(self, query: Query) -> Evaluation | None:
        """Return the stored evaluation of a query; None if there is none.

        Non-finite values of the stored gradient are added to the renderer's count, as
        when the query was evaluated.

        Raises:
            InputError: the stored evaluation is one of another configuration.
        """
        is_trial = query.phase is None
        if is_trial:
            return self._trials_of(query.kind).get(query.row_index)
        n_stored = self._counts.get(query.kind, 0)
        if self.run_directory is None or query.row_index >= n_stored:
            return None
        stored = self.run_directory.store.read_cached(query.kind, query.row_index)
        # A complete run deletes what the rows do not have, such as gradients.
        if stored is None:
            return None
        row, cached = stored
        _check_same_query(query, row, cached, self.run_directory)
        if cached.non_finite:
            self.problem.renderer.n_non_finite += cached.non_finite
        return _restore_evaluation(row, cached)

    def store(
        self,
        evaluated: Sequence[tuple[Query, Evaluation]],
        *,
        id_is_number: bool = False,
    ) -> list[Row]:
        """Store evaluations in one transaction, a row each.

        For an evaluation of a search, gradient and image are stored with the row. There
        is room for one gradient and image in a call, so that such an evaluation is
        stored by itself.

        Args:
            evaluated: queries and their evaluations; trials, or a single evaluation of
                a search.
            id_is_number: whether the id of a row is the index of its query plus 1, so
                that it does not depend on the order in which rows come. This is for
                rows of a sweep, which are not cached in memory.

        Returns:
            The rows.
        """
        rows = list[Row]()
        cached = None
        for query, evaluation in evaluated:
            self.n_lost += evaluation.is_lost
            self._note_machine(evaluation.machine)
            if self._has_search_row(query):
                continue
            is_trial = query.phase is None
            if is_trial:
                row = self._row_of_trial(query, evaluation)
                if not id_is_number:
                    self._cache_trial(query, evaluation)
            else:
                row, cached = self._row_of_search(query, evaluation)
            if id_is_number:
                row = replace(row, id=query.row_index + 1)  # ids begin at 1
            rows.append(row)
        self._append_to_store(rows, cached)
        return rows

    def _has_search_row(self, query: Query) -> bool:
        """Return whether the store has the row of a search's query already.

        It may have the row, but not its gradient, which is deleted when a run is
        complete. So the query was evaluated again, but is not stored again.
        """
        is_of_search = query.phase is not None
        return is_of_search and query.row_index < self._counts.get(query.kind, 0)

    def _append_to_store(
        self, rows: Sequence[Row], cached: CachedEvaluation | None
    ) -> None:
        """Append rows to the store, or to `rows` without a run directory.

        `cached` is what the store has besides the row of a search's evaluation.
        """
        if self.run_directory is None:
            self._append_in_memory(rows)
        elif rows:
            self.run_directory.append_rows(*rows, cached=cached)

    def _cache_trial(self, query: Query, evaluation: Evaluation) -> None:
        """Cache a trial, so that later calls find it; its image is stored elsewhere."""
        trials = self._trials_of(query.kind)
        trials[query.row_index] = replace(evaluation, picture=None)

    def _append_in_memory(self, rows: Iterable[Row]) -> None:
        """Append rows to those of a journal without a run.

        They get the id and the time that the store of a run would add.
        """
        for row in rows:
            row_id = row.id or len(self.rows) + 1
            self.rows.append(replace(row, id=row_id, time=time.time()))

    def _note_machine(self, name: str | None) -> None:
        """Store the description of a machine that differs from this one.

        Args:
            name: name of the machine in the rows that it evaluated; None for a machine
                like this one. Nothing is done for a name that is stored already.
        """
        if name is None or name in self.machines:
            return
        stats = self.evaluator.worker_stats
        description: dict[str, str] = {}
        if stats is not None:
            # `stats.machines` has the description of each machine by its name
            description = dict(stats.machines.get(name, {}))
        self.machines[name] = description
        self.set_note(MACHINES_NOTE, self.machines)

    def _row_of_trial(self, query: Query, evaluation: Evaluation) -> Row:
        """Return the row of a trial.

        The row has the values that the query states and, if its conditions are random,
        the values of these.
        """
        values = dict(query.values)
        if query.draws_conditions:
            values |= self.problem.describe_conditions(query.u, query.seed)
        row = make_trial_row(
            query.kind,
            query.row_index,
            # `predicted` is 0 for a rendered image. A predicted one has no noise, hence
            # no seed, and `predicted` are the samples per pixel of the prediction.
            seed=None if evaluation.predicted else query.seed,
            spp=evaluation.predicted or query.spp,
            judgement=evaluation.required_judgement,
            values=values,
            has_success=query.has_success,
        )
        return replace(
            row,
            machine=evaluation.machine,
            renders=evaluation.cost,
            seconds=evaluation.seconds,
        )

    def _row_of_search(
        self, query: Query, evaluation: Evaluation
    ) -> tuple[Row, CachedEvaluation]:
        """Return the row of a search's evaluation, and the values to resume it.

        These are values that the row does not have: digest of the configuration, cost,
        gradient and image. The store deletes them when the run is complete.

        Args:
            query: the query.
            evaluation: its evaluation.
        """
        problem = self.problem
        is_finite = evaluation.is_finite
        is_predicted = bool(evaluation.predicted)
        # A cost of 1 is an image under each of the conditions of an evaluation.
        n_renders = evaluation.cost * problem.conditions_per_evaluation
        row = Row(
            query.kind,
            query.row_index,
            query.seed,
            # A predicted image was not rendered, so it has neither samples nor renders.
            spp=None if is_predicted else problem.search_spp * query.samples,
            objective=evaluation.objective if is_finite else math.nan,
            success=evaluation.success and is_finite,
            values=problem.describe(query.u),
            seconds=evaluation.seconds,
            phase=query.phase,
            renders=0 if is_predicted else n_renders,
            machine=evaluation.machine,
        )
        if evaluation.judgement is not None:
            row = add_judgement(row, evaluation.judgement)
        return row, _make_cached_evaluation(query, evaluation)

    def make_time_check(
        self, kind: str, seconds: float | None
    ) -> Callable[[int], bool] | None:
        """Return a function that tells whether the time of a search is over.

        The function takes the number of evaluations so far. In a resumed run, the time
        of the earlier process counts. Evaluations that are read from the store take no
        time, and the search does not end before the last of them. If the store has rows
        of the ranking, which follows the search, the search had ended already. Then it
        ends again after its last stored evaluation.

        Args:
            kind: kind of the search, such as "search".
            seconds: time limit of the search; None for no limit, and then the result is
                None.
        """
        if seconds is None:
            return None
        search_seconds = []
        has_ranking = False
        for row in self._read_earlier_rows(kind):
            if row.phase == "search":
                search_seconds.append(row.seconds or 0.0)
            else:  # "ranking"
                has_ranking = True
        seconds_left = seconds - math.fsum(search_seconds)
        n_stored = len(search_seconds)
        clock = _Clock(n_stored, has_ranking, seconds_left, started=time.perf_counter())
        return clock.is_out_of_time

    def _read_earlier_rows(self, kind: str) -> Iterable[Row]:
        """Return the rows of a search that an earlier process began; empty without one."""
        # The store has cached evaluations if an earlier process has begun the run.
        if self.run_directory is not None and self.run_directory.store.has_cached:
            return self.run_directory.store.rows(kind)
        return ()

    @property
    def remarks(self) -> list[str]:
        """A sentence about machines that are not like this one, if there are any."""
        if not self.machines:
            return []
        descriptions = "; ".join(
            ", ".join(f"{key} {text}" for key, text in description.items())
            for description in self.machines.values()
        )
        return [
            "Rows come from machines that are not alike, so that their last bits may "
            f"differ; beside the one that kept the run: {descriptions}."
        ]

    # ---- notes

    def get_note(self, key: str) -> Any:
        """Return the stored note of a key; None if there is none."""
        return (
            None
            if self.run_directory is None
            else self.run_directory.store.read_json_note(key)
        )

    def set_note(self, key: str, value: Any) -> None:
        """Store a value that JSON can hold as the note of a key."""
        if self.run_directory is not None:
            self.run_directory.store.write_note(key, json.dumps(value))


def _check_same_query(
    query: Query, row: Row, cached: CachedEvaluation, run: RunDirectory
) -> None:
    """Raise InputError if a stored evaluation is that of another configuration."""
    # `cached.u` is the digest of the configuration
    is_same_query = cached.u == compute_digest(query.u) and row.seed == query.seed
    if not is_same_query:
        raise InputError(
            f"{run.path}: cannot resume: evaluation "
            f"{query.row_index} of the {query.kind} is not the one that was "
            "stored, so advsearch, its packages or the number of threads have "
            "changed since; "
            f"{run.restart_advice}"
        )


@dataclass
class _Clock:
    """Measures the time of a search, as described at `Journal.make_time_check`.

    Attributes:
        n_stored: number of evaluations that are read from the store.
        has_ranking: whether the store has rows of the ranking, which follows the search.
        seconds_left: time limit, without the time of earlier processes.
        started: when the clock was reset.
    """

    n_stored: int
    has_ranking: bool
    seconds_left: float
    started: float

    def is_out_of_time(self, n_evaluations: int) -> bool:
        """Return whether the search must end after `n_evaluations`."""
        is_from_store = n_evaluations < self.n_stored
        if is_from_store:
            # The clock is reset as long as evaluations are read from the store, so
            # that reading them takes none of the time.
            self.started = time.perf_counter()
            return False
        elapsed = time.perf_counter() - self.started
        return self.has_ranking or elapsed >= self.seconds_left


def compute_digest(u: Tensor) -> bytes:
    """Return 16 bytes that identify a configuration (d,) by all its bits."""
    array = np.ascontiguousarray(u.detach().numpy())
    return hashlib.blake2b(array.tobytes(), digest_size=16).digest()


def _make_cached_evaluation(query: Query, evaluation: Evaluation) -> CachedEvaluation:
    """Return the values of a search's evaluation that its row does not have."""
    gradient = None
    if evaluation.gradient is not None:
        gradient = evaluation.gradient.detach().numpy()
    image = None
    if evaluation.picture is not None:
        image = to_uint8(evaluation.picture).numpy()
    return CachedEvaluation(
        query.row_index,
        compute_digest(query.u),
        evaluation.n_non_finite,
        evaluation.cost,
        gradient,
        image,
    )


def _restore_trial(row: Row) -> Evaluation:
    """Return the evaluation of a trial from its row.

    It states the number of samples per pixel of a prediction, or 0 for a rendered image.
    A predicted image has no seed (`Journal._row_of_trial`).
    """
    is_predicted = row.seed is None
    predicted = 0
    if is_predicted:
        predicted = row.spp or 1
    return Evaluation.from_judgement(read_judgement(row), predicted=predicted)


def _restore_evaluation(row: Row, cached: CachedEvaluation) -> Evaluation:
    """Return a search's evaluation from the store, with what a search needs of it.

    A row of an old run may have no judgement, and then no `correct` either. Arrays of
    the store are read-only, so they are copied.

    Args:
        row: row of the evaluation.
        cached: gradient, image and cost, which the row does not have.
    """
    gradient = None
    if cached.gradient is not None:
        gradient = torch.from_numpy(cached.gradient.copy())
    image = None
    if cached.picture is not None:
        # stored with 8 bits
        image = torch.from_numpy(cached.picture.copy()).float() / 255.0
    return Evaluation(
        objective=math.nan if row.objective is None else row.objective,
        gradient=gradient,
        success=bool(row.success),
        n_non_finite=cached.non_finite,
        cost=cached.cost,
        judgement=None if row.correct is None else read_judgement(row),
        picture=image,
    )
