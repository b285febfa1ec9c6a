"""Make the measurements of a run that may be stopped and resumed.

Each measurement is stored under a key as soon as it is made. A resumed run reads it
back.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

from advsearch.interrupts import reraise_lost_interrupt
from advsearch.runs.results import INTERRUPTED, OUT_OF_TIME, Fields, Result
from advsearch.runs.summary import NAME, read_stored_result

Row = TypeVar("Row")
AnyFields = TypeVar("AnyFields", bound=Fields)
AnyResult = TypeVar("AnyResult", bound=Result)


class OutOfTime(Exception):
    """Raised if the time for measurements is up."""


class Measurements:
    """The measurements in the store of a run; new ones are made until the time is up.

    At least one new measurement is made, so that a run makes progress each time that it
    is resumed. Stored measurements are read back before.

    Attributes:
        n_new_measurements: number of measurements that were made, and not read back.

    Args:
        context: `experiment.RunContext` of the run that stores them.
        seconds: time from now in seconds, after which no measurement is started; None
            for no limit.
    """

    def __init__(self, context: Any, seconds: float | None = None) -> None:
        self._context = context
        self._store = context.run.store
        self._end = math.inf if seconds is None else time.monotonic() + seconds
        self.n_new_measurements = 0

    def get_or_measure(self, key: str, measure: Callable[[], Any]) -> Any:
        """Return the JSON value that is stored under a key, or measure and store it.

        Args:
            key: key of the measurement in the store of the run.
            measure: function that measures it and returns a value with a JSON form.

        Raises:
            OutOfTime: it would have to be measured, the time is up, and something was
                measured since the run was started or resumed.
        """
        stored = self.read_stored(key)
        if stored is None:
            # The first one is always made, or a run with too little time would make no
            # progress however often it is resumed.
            if self.n_new_measurements and time.monotonic() >= self._end:
                raise OutOfTime
            self.n_new_measurements += 1
            # encoded and decoded, so that it is equal to what is read back later
            stored = json.loads(json.dumps(measure()))
            self.put(key, stored)
        return stored

    def get_or_measure_row(
        self, key: str, row_type: type[AnyFields], measure: Callable[[], AnyFields]
    ) -> AnyFields:
        """Return the fields that are stored under a key, or measure and store them.

        Args:
            key: key of the measurement in the store of the run.
            row_type: class of the fields.
            measure: measures them.

        Raises:
            OutOfTime: they would have to be measured, and the time is up.
        """
        return row_type.from_values(
            self.get_or_measure(key, lambda: measure().to_dict())
        )

    def get_or_measure_rows(
        self,
        key: str,
        row_type: type[AnyFields],
        measure: Callable[[], Sequence[AnyFields]],
    ) -> list[AnyFields]:
        """Return the rows that are stored under a key, or measure and store them.

        Args:
            key: key of the measurement in the store of the run.
            row_type: class of the rows.
            measure: measures the rows.

        Raises:
            OutOfTime: they would have to be measured, and the time is up.
        """
        return [
            row_type.from_values(row)
            for row in self.get_or_measure(
                key, lambda: [row.to_dict() for row in measure()]
            )
        ]

    def put(self, key: str, value: Any) -> None:
        self._store.write_note(key, json.dumps(value))

    def read_stored(self, key: str) -> Any:
        return self._store.read_json_note(key)

    def make_result_of_rows(
        self, rows: Iterable[Row], make_result: Callable[[list[Row]], AnyResult]
    ) -> AnyResult:
        """Collect rows until they end, and return their result.

        It ends earlier if the time is up or the user presses Ctrl-C. The summary is
        written after each new row, so that a kill of the process leaves it. A resumed
        run never has fewer rows than before: if an interrupt comes before all stored
        rows were read, the earlier result is returned.

        Args:
            rows: iterator that measures each row when it is taken; stored rows come
                first.
            make_result: makes the result from the rows so far.
        """
        collected_rows = self._collect_rows(rows, make_result)
        result = make_result(collected_rows)
        earlier_result = self._find_earlier_result(type(result))
        return result if earlier_result is None else earlier_result

    def _collect_rows(
        self, rows: Iterable[Row], make_result: Callable[[list[Row]], AnyResult]
    ) -> list[Row]:
        """Collect rows until they end or are interrupted, and set the ending of the run.

        See `make_result_of_rows` for the arguments.
        """
        context = self._context
        collected_rows: list[Row] = []
        # The status in summaries that are written before the last row. It is replaced
        # when the rows end, or the time is up.
        context.ending = INTERRUPTED
        try:
            with reraise_lost_interrupt():
                for row in rows:
                    collected_rows.append(row)
                    if self.n_new_measurements:  # otherwise the row was read back
                        context.run.write_summary(make_result(collected_rows))
                context.ending = "done"
        except KeyboardInterrupt:
            pass  # the status stays `INTERRUPTED`
        except OutOfTime:
            context.ending = OUT_OF_TIME
        return collected_rows

    def _find_earlier_result(self, kind: type[AnyResult]) -> AnyResult | None:
        """Return the earlier result of an interrupted run; None if it is not needed.

        Stored rows come first. If the user interrupted before any new row, some stored
        rows may not have been read, and the earlier result may have more rows.

        Args:
            kind: class of the result.
        """
        run = self._context.run
        may_lack_stored_rows = (
            self._context.ending == INTERRUPTED and not self.n_new_measurements
        )
        if may_lack_stored_rows and (run.path / NAME).is_file():
            earlier_result = read_stored_result(run.path)
            if isinstance(earlier_result, kind):
                return earlier_result
        return None
