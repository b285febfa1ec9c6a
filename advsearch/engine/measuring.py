"""Long measurements that can be stopped: what is measured is stored at once, and rows are kept as they come."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

from pydantic import TypeAdapter

from advsearch.interrupts import interruptible
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results.base import INTERRUPTED, OUT_OF_TIME, Fields, Result
from advsearch.runs.summary import NAME, read_result
from advsearch.viewer.pages import keep_answer

Row = TypeVar("Row")
Answer = TypeVar("Answer", bound=Result)
Kind = TypeVar("Kind", bound=Fields)
Measured = TypeVar("Measured")


class OutOfTime(Exception):
    """The time that a measurement was given is over."""


class Results:
    """What a run has measured, in its store; measures what is not there, until the time is up.

    Args:
        run: open; None where nothing is kept.
        seconds: after which nothing more is measured; one measurement is always made, so that it gets on.

    Attributes:
        made: how many measurements were made. What is stored is read back before the first.
    """

    def __init__(self, run: RunDirectory | None, seconds: float | None = None) -> None:
        self._run = run
        self._end = math.inf if seconds is None else time.monotonic() + seconds
        self.made = 0

    def get(self, key: str, measure: Callable[[], Any]) -> Any:
        """Return a JSON value: the one that is stored under a key, or what `measure` returns, which is stored then.

        Raises:
            OutOfTime: it is not stored, and the time is over.
        """
        stored = self.stored(key)
        if stored is None:
            self.check_time()
            self.made += 1
            stored = json.loads(json.dumps(measure()))
            self.put(key, stored)
        return stored

    def check_time(self) -> None:
        """Look whether there is time for another measurement.

        Raises:
            OutOfTime: there is none.
        """
        if self.made and time.monotonic() >= self._end:
            raise OutOfTime

    def value(self, key: str, kind: type[Measured], measure: Callable[[], Measured]) -> Measured:
        """Return what `measure` returns, or what is stored of this kind (a dataclass, or a list of some); as `get`."""
        adapter = TypeAdapter(kind)
        return adapter.validate_python(self.get(key, lambda: adapter.dump_python(measure(), mode="json")))

    def row(self, key: str, kind: type[Kind], measure: Callable[[], Kind]) -> Kind:
        """Return the fields that `measure` returns, or those of this kind that are stored; otherwise as `get`."""
        return kind.of(self.get(key, lambda: measure().to_dict()))

    def rows(self, key: str, kind: type[Kind], measure: Callable[[], Sequence[Kind]]) -> list[Kind]:
        """Return what `row` does, of several at once."""
        return [kind.of(one) for one in self.get(key, lambda: [one.to_dict() for one in measure()])]

    def put(self, key: str, value: Any) -> None:
        """Store a JSON value."""
        if self._run is not None:
            self._run.store.set_note(key, json.dumps(value))

    def stored(self, key: str) -> Any:
        """Return what is stored under a key, or None."""
        return None if self._run is None else self._run.store.noted(key)


def kept_rows(
    run: RunDirectory | None, results: Results, rows: Iterable[Row], result: Callable[[Sequence[Row], str], Answer]
) -> Answer:
    """Take rows until they end, the time is up or there is an interrupt, and keep what they come to after each.

    The summary never has fewer rows than an earlier sitting left in it: those are read back before anything is
    measured.

    Args:
        run: open; None where nothing is kept.
        results: what the rows are made from.
        rows: as they come.
        result: makes the result of the rows so far and of how it ended.
    """
    taken: list[Row] = []
    ending = INTERRUPTED
    try:
        with interruptible():
            for row in rows:
                taken.append(row)
                if results.made and run is not None:
                    run.write_summary(result(taken, ending))  # what a kill leaves
            ending = "done"
    except KeyboardInterrupt:
        pass
    except OutOfTime:
        ending = OUT_OF_TIME
    answer = result(taken, ending)
    if run is None:
        return answer
    if ending == INTERRUPTED and not results.made and (run.path / NAME).is_file():
        before = read_result(run.path)
        return before if isinstance(before, type(answer)) else answer
    return keep_answer(run, answer)
