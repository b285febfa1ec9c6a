"""The journal of a run: what was asked and answered, as rows of its store. A question that is in it is not asked again.

So a run that was stopped goes on by asking everything once more, in the same order: it reads back what it knows, and a
search comes to where it was by being told all of it. It goes on only with the functions and networks that it began
with, which settings call by name only.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import CodeType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.cluster.executor import Workforce
from advsearch.engine.problem import Problem
from advsearch.engine.rows import LOST, judged, judgement_of, trial_row
from advsearch.engine.sharing import Shared
from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row, Told
from advsearch.scene.formation import levels_of
from advsearch.tasks.together import Ensemble

MADE_OF = "made of"
"""The note of functions and weights."""

LONGEST = 10_000
"""Characters of a function's source that are noted."""

NEAR, LEAST = 1e-3, 1e-4
"""Values of one picture are the same within this part of the larger, and this: other versions round differently."""


def check_made_of(
    run: RunDirectory, models: Sequence[Model], functions: Mapping[str, Callable[..., Any] | None] | None = None
) -> None:
    """Note what networks and functions are, or refuse to go on with others than a run began with.

    Args:
        run: open.
        models: by the name that they have in the run.
        functions: of the run, by setting; None where there is none.

    Raises:
        InputError: weights, or the code of a function, are other ones now.
    """
    several = [one.module.models if isinstance(one.module, Ensemble) else (one,) for one in models]
    networks = [one for some in several for one in some]
    now: dict[str, Any] = {f"model {one.name}": {"weights": weights_digest(one)} for one in networks}
    now |= {name: _function(one) for name, one in (functions or {}).items() if one is not None}
    before = run.store.noted(MADE_OF)
    if not isinstance(before, dict):
        run.store.set_note(MADE_OF, json.dumps(now))
        return
    for name, facts in now.items():
        noted = before.get(name)
        if not isinstance(noted, dict):
            continue
        for key, what in (("weights", "has other weights"), ("code", "is another function")):
            same_python = key != "code" or noted.get("python") == facts.get("python")
            if same_python and None not in (noted.get(key), facts.get(key)) and noted[key] != facts[key]:
                raise InputError(
                    f"{run.path}: cannot go on: {name} {what} now; take the one that it began with, or {run.again}"
                )


def weights_digest(model: Model) -> str | None:
    """Return the SHA-256 of a network's weights and buffers, with their names; None where it shows none."""
    try:
        state = model.module.state_dict()  # type: ignore[attr-defined]
        tensors = {name: one for name, one in state.items() if isinstance(one, torch.Tensor)}
        digest = hashlib.sha256()
        for name, one in sorted(tensors.items()):
            digest.update(f"{name} {one.dtype} {tuple(one.shape)}\n".encode())
            digest.update(one.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    except (AttributeError, RuntimeError, TypeError, NotImplementedError):
        return None
    return digest.hexdigest() if tensors else None


def same(before: Sequence[float | None], now: Sequence[float | None]) -> bool:
    """Whether values of a picture are those that they were; None is no number."""

    def near(one: float | None, other: float | None) -> bool:
        if one is None or other is None:
            return one is other
        return abs(one - other) <= max(LEAST, NEAR * max(abs(one), abs(other)))

    return len(before) == len(now) and all(map(near, before, now))


def finite(value: float | None) -> float | None:
    """Return a number, None where it is none."""
    return value if value is not None and math.isfinite(value) else None


def _function(function: Callable[..., Any]) -> dict[str, str | None]:
    """What is noted of a function: its source for a reader, and a digest of what it does, whatever it looks like."""
    while isinstance(function, partial):
        function = function.func
    bare = inspect.unwrap(function)
    bare = getattr(bare, "__func__", bare)
    if not hasattr(bare, "__code__"):
        bare = getattr(type(bare), "forward", None) or type(bare).__call__
    try:
        source: str | None = inspect.getsource(bare)[:LONGEST]
    except (OSError, TypeError):
        source = None
    code = getattr(bare, "__code__", None)
    kept = (getattr(bare, "__defaults__", None), [_content(one) for one in getattr(bare, "__closure__", None) or ()])
    said = None if code is None else repr((_parts(code, getattr(bare, "__doc__", None)), *map(_plain, kept)))
    digest = None if said is None else hashlib.sha256(said.encode()).hexdigest()
    return {"source": source, "code": digest, "python": "{}.{}".format(*sys.version_info)}


def _parts(code: CodeType, text: str | None = None) -> tuple[Any, ...]:
    """What a function does, without where it stands, what it is called and the text that describes it."""
    inner = [_parts(one) if isinstance(one, CodeType) else _plain(one) for one in code.co_consts if one != text]
    return code.co_code.hex(), inner, code.co_names, code.co_freevars


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # nothing is in it yet
        return None


def _plain(value: Any) -> Any:
    """Numbers and texts, however deep; of anything else its type, since its text may be another one in each process."""
    if isinstance(value, (tuple, list)):
        return [_plain(one) for one in value]
    if isinstance(value, frozenset):
        return sorted(map(repr, value))
    return value if isinstance(value, (int, float, complex, str, bytes, type(None))) else type(value).__name__


MACHINES = "machines"
"""The note under which the store keeps what they are."""


@dataclass
class Machines:
    """The other machines of a run.

    Attributes:
        run: keeps what they are; None keeps it in memory.
        known: by the name that rows have, what each is.
    """

    run: RunDirectory | None
    known: dict[str, dict[str, str]] = field(init=False)

    def __post_init__(self) -> None:
        self.known = (self.run.store.noted(MACHINES) if self.run is not None else None) or {}

    def meet(self, name: str | None, facts: Workforce | None) -> None:
        """Keep what a machine is, unless it is known, or like this one (None)."""
        if name is None or name in self.known:
            return
        self.known[name] = dict(facts.machines.get(name, {})) if facts is not None else {}
        if self.run is not None:
            self.run.store.set_note(MACHINES, json.dumps(self.known))

    @property
    def remarks(self) -> list[str]:
        """What a reader has to know."""
        if not self.known:
            return []
        told = "; ".join(", ".join(f"{key} {text}" for key, text in one.items()) for one in self.known.values())
        return [
            "Rows come from machines that are not alike, so that their last bits may differ; beside the one that kept "
            f"the run: {told}."
        ]


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
