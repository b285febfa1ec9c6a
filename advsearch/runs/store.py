"""Store every evaluated configuration of a run in `results.sqlite`.

When `Store.append` returns, its rows survive a kill of the process (write-ahead log). A
power cut loses the rows of at most about a second. On a slow disk it may lose more, so
that waiting for the disk takes at most 2 % of the time.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, final, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from advsearch.errors import FileFormatError
from advsearch.files import JsonValue
from advsearch.options import NOT_A_NUMBER, OUT_OF_VIEW, Value
from advsearch.runs.files import SCHEMA, check_version, connect_to_write
from advsearch.runs.results import to_json_value
from advsearch.trust.databases import (
    DAMAGED,
    check_schema,
    connect_to_read,
    translate_database_errors,
)
from advsearch.trust.stored_files import parse_json
from advsearch.trust.writing import check_not_moved, note_open, storage_errors

NAME = "results.sqlite"
# Minimum seconds between two writes that wait for the disk. A power cut may lose the
# rows in between.
SYNC_INTERVAL = 1.0
SYNC_SHARE = 0.02  # maximum fraction of the time that waiting for the disk may take


@dataclass(frozen=True)
class Row:
    """A row of the table `evaluations`: an evaluated configuration.

    `files.SCHEMA` describes the columns. NaN and infinity are stored as None. These
    fields need more explanation:

    Attributes:
        success: whether the prediction is what the search looks for; None if there is
            no search, as in a sweep.
        renders: number of rendered images; 0 if they were predicted instead, None if
            they were not counted.
        phase: phase of a search; None for trials (verification renders).
        payload: other data of the prediction as JSON values, such as boxes.
        values: the configuration; maps a parameter to its value and unit.
        metrics: numbers by name of the metric.
        time: time of writing in seconds since 1970; set by the store.
        id: number of the row in the file, from 1; set by the store if it is None.
    """

    kind: str
    step: int
    seed: int | None = None
    spp: int | None = None
    objective: float | None = None
    score: float | None = None
    success: bool | None = None
    correct: bool | None = None
    margin: float | None = None
    label: str | None = None
    label_index: int | None = None
    probability: float | None = None
    payload: JsonValue = None
    values: Mapping[str, Value] = field(default_factory=dict)
    seconds: float | None = None
    renders: int | None = None
    phase: str | None = None
    metrics: Mapping[str, float | None] = field(default_factory=dict)
    machine: str | None = None
    time: float | None = None
    id: int | None = None

    @property
    def is_out_of_view(self) -> bool:
        """Whether the object could not be seen in the image, so that nothing was
        predicted.
        """
        return self.label == OUT_OF_VIEW


@dataclass(frozen=True)
class CachedEvaluation:
    """The data of an evaluation that a search needs to be resumed, in addition to the
    row.

    The state of a policy depends only on the evaluations that it has received. So a
    search is resumed by passing all of them to the policy again.

    Attributes:
        number: index of the evaluation in the search.
        u: digest of the configuration, to check that it is the same.
        non_finite: number of entries of the gradient that were not finite.
        cost: cost in evaluations.
        gradient: (d,); None if there is none.
        picture: (H, W, 3); None if it is not stored.
    """

    number: int
    u: bytes
    non_finite: int
    cost: int
    gradient: NDArray[np.float32] | None = None
    picture: NDArray[np.uint8] | None = None


# Cached evaluations are in the table "told", which has these columns after the id of
# the row.
_CACHED_COLUMNS = "number, u, non_finite, cost, gradient, picture, height"
_AS_JSON = ("payload", "values", "metrics")
_COLUMNS = tuple(
    f"{field.name}_json" if field.name in _AS_JSON else field.name
    for field in fields(Row)
)
_INSERT = (
    f"INSERT INTO evaluations ({', '.join(_COLUMNS)}) VALUES "
    f"({', '.join('?' * len(_COLUMNS))}) ON CONFLICT DO NOTHING"
)

_INSERT_CACHED = (
    "INSERT INTO told SELECT id, ?, ?, ?, ?, ?, ?, ? FROM evaluations WHERE kind = ? "
    "AND step = ?"
)


@final
class Store:
    """The open database `results.sqlite` of a run.

    Close it, or use it in a `with` block. With `read_only`, it may be read while
    another process writes it.
    """

    FILE: ClassVar[str] = NAME  # name of the file in the directory of a run
    # label for rows that have none
    NOT_A_NUMBER: ClassVar[str] = NOT_A_NUMBER

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        """Open a database, and check its version and its tables.

        Args:
            path: path of the file.
            read_only: whether it is only read. Otherwise it is made if it is missing.

        Raises:
            FileFormatError: it was not written by advsearch, or by another version.
        """
        self.path = path
        # the first rows are synced at once
        self._next_sync = -math.inf
        with translate_database_errors(path):
            self._db = connect_to_read(path) if read_only else connect_to_write(path)
            check_version(self._db, path)
            check_schema(self._db, path, SCHEMA)
        # function to call when the file is closed
        self._note_closed: Callable[[], None] | None = None
        if not read_only:
            self._note_closed = note_open(path)

    @staticmethod
    def is_in(run: Path) -> bool:
        """Return whether a run directory has results."""
        return (run / NAME).is_file()

    @classmethod
    def open_to_read(cls, run: Path) -> Store:
        """Open the results in a run directory for reading, while another process may
        write them.
        """
        return cls(run / NAME, read_only=True)

    def append(
        self, rows: Sequence[Row], cached: CachedEvaluation | None = None
    ) -> None:
        """Add rows in one transaction: if the disk is full, none of them is stored.

        When this returns, they survive a kill of the process. Only now and then the
        function waits until the disk has them, so that a power cut may lose the last
        rows. A row whose kind and step are stored already changes nothing.

        Args:
            rows: rows of evaluations.
            cached: data that a search needs to be resumed and the last row lacks,
                such as the gradient of its evaluation; None if there is nothing.
        """
        check_not_moved(self.path)
        start_time = time.monotonic()
        timestamp = time.time()  # monotonic time has no date
        must_sync = start_time >= self._next_sync
        # With FULL, SQLite waits until the disk has the rows.
        mode = "FULL" if must_sync else "NORMAL"
        with storage_errors(self.path):
            self._db.execute(f"PRAGMA synchronous = {mode}")
            with self._db:  # one transaction
                self._insert(rows, cached, timestamp)
        if must_sync:
            self._schedule_sync(start_time)

    def _insert(
        self, rows: Sequence[Row], cached: CachedEvaluation | None, timestamp: float
    ) -> None:
        """Insert rows, and what belongs to the last one, into the tables.

        Args:
            rows: rows of evaluations.
            cached: data that a search needs and the last row lacks; None without any.
            timestamp: the time of writing, seconds since 1970.
        """
        self._db.executemany(_INSERT, (_encode(row, timestamp) for row in rows))
        if cached is not None:
            row = rows[-1]
            values = (*_encode_cached(cached), row.kind, row.step)
            self._db.execute(_INSERT_CACHED, values)

    def _schedule_sync(self, start_time: float) -> None:
        """Set when the next write waits for the disk, after one that did.

        On a slow disk it is later, so that waiting takes at most `SYNC_SHARE` of the
        time.

        Args:
            start_time: monotonic time when the last write began.
        """
        end_time = time.monotonic()
        # includes the time for encoding, which is short
        sync_seconds = end_time - start_time
        wait_seconds = max(SYNC_INTERVAL, sync_seconds / SYNC_SHARE)
        self._next_sync = end_time + wait_seconds

    def _select(self, query: str, *parameters: Any) -> Iterator[Any]:
        """Yield the rows of a SELECT query.

        Errors of SQLite become FileFormatError. The context that does this is left
        before each row is yielded, so that errors of the caller pass unchanged.

        Args:
            query: the query after "SELECT".
            *parameters: values for its question marks.
        """
        with translate_database_errors(self.path):
            cursor = self._db.execute(f"SELECT {query}", parameters)
            row = cursor.fetchone()
        while row is not None:
            yield row
            with translate_database_errors(self.path):
                row = cursor.fetchone()

    def rows(self, kind: str | None = None, after: int = 0) -> Iterator[Row]:
        """Yield rows in the order of their ids.

        Args:
            kind: kind of the rows; None for all kinds.
            after: only rows with a larger id.
        """
        condition = "id > ?"
        parameters: list[int | str] = [after]
        if kind is not None:
            condition += " AND kind = ?"
            parameters.append(kind)
        for values in self._select(
            f"{', '.join(_COLUMNS)} FROM evaluations WHERE {condition} ORDER BY id",
            *parameters,
        ):
            yield _decode(values, self.path)

    def read_row(self, kind: str, step: int) -> Row | None:
        """Return the row of a kind with a step; None if there is none."""
        query = (
            f"{', '.join(_COLUMNS)} FROM evaluations WHERE kind = ? AND step = ? "
            "ORDER BY id DESC LIMIT 1"
        )
        return next(
            (_decode(values, self.path) for values in self._select(query, kind, step)),
            None,
        )

    def read_cached(self, kind: str, step: int) -> tuple[Row, CachedEvaluation] | None:
        """Return a row of a search, with the data that the search needs to be resumed.

        Args:
            kind: kind of the search.
            step: index of the evaluation.

        Returns:
            The row, and its cached data such as the gradient. None if there is no such
            row, or if the run is done: then the cached data have been deleted.
        """
        row = self.read_row(kind, step)
        if row is None:
            return None
        cached_rows = self._select(f"{_CACHED_COLUMNS} FROM told WHERE row = ?", row.id)
        values = next(cached_rows, None)
        if values is None:
            return None
        return row, _decode_cached(values, self.path)

    def iterate_images(
        self, kind: str, after: int, until: int
    ) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield the index in the search, and the image (H, W, 3), of rows of a kind.

        Images are stored only until the run is done.

        Args:
            kind: kind of the rows.
            after: only rows with a larger id.
            until: only rows with at most this id.
        """
        query = (
            # NULL instead of the gradient, which is not needed here
            "number, u, non_finite, cost, NULL, picture, height FROM told JOIN "
            "evaluations ON row = id "
            "WHERE kind = ? AND id > ? AND id <= ? AND picture IS NOT NULL ORDER BY id"
        )
        for values in self._select(query, kind, after, until):
            evaluation = _decode_cached(values, self.path)
            assert evaluation.picture is not None
            yield evaluation.number, evaluation.picture

    @property
    def has_cached(self) -> bool:
        """Whether there are cached evaluations: then the run is not done."""
        return bool(next(self._select("EXISTS (SELECT * FROM told)"))[0])

    def delete_cached(self) -> None:
        """Delete the cached evaluations, since a run that is done is not resumed.

        Their gradients and images take most of the file, so it is compacted then.
        """
        check_not_moved(self.path)
        with storage_errors(self.path):
            with self._db:
                n_deleted = self._db.execute("DELETE FROM told").rowcount
            if n_deleted:
                self._db.execute("VACUUM")

    def get_last_step(self, kind: str) -> int:
        """Return the largest step of a kind of rows, -1 if there is none."""
        query = "coalesce(max(step), -1) FROM evaluations WHERE kind = ?"
        ((step,),) = self._select(query, kind)
        return int(step)

    def count_rows(self, kind: str | None = None) -> int:
        """Return the number of rows of a kind; None for all kinds."""
        query = "count(*) FROM evaluations"
        if kind is None:
            counts = self._select(query)
        else:
            counts = self._select(f"{query} WHERE kind = ?", kind)
        ((count,),) = counts
        return int(count)

    def find_missing_steps(self, kind: str, count: int) -> Iterator[range]:
        """Yield the steps that have no row of a kind; consecutive ones as one range.

        Args:
            kind: kind of the rows.
            count: number of expected steps, which are 0 to count - 1. If there are rows
                beyond, a range may be empty.
        """
        expected = 0  # the step after that of the previous row
        steps = self._select("step FROM evaluations WHERE kind = ? ORDER BY step", kind)
        for (step,) in steps:
            if step > expected:
                yield range(expected, min(step, count))
            expected = step + 1
        if expected < count:
            yield range(expected, count)

    def count_by_kind(self) -> dict[str, int]:
        query = "kind, count(*) FROM evaluations GROUP BY kind ORDER BY kind"
        return {str(kind): count for kind, count in self._select(query)}

    def read_note(self, key: str) -> str | None:
        """Return the text that is stored under a key, None if there is none."""
        for (text,) in self._select("value FROM meta WHERE key = ?", key):
            return str(text)
        return None

    def read_json_note(self, key: str) -> Any:
        """Return the JSON value that is stored under a key, None if there is none.

        Raises:
            FileFormatError: the stored text is no JSON.
        """
        text = self.read_note(key)
        try:
            return None if text is None else parse_json(text)
        except ValueError as error:
            raise FileFormatError(
                f"{self.path}: expected JSON in the note {key!r}, "
                f"got {error}; {DAMAGED}"
            ) from None

    @property
    def has_model_answers(self) -> bool:
        """Whether a model behind an address has answered, which took time and money."""
        return any(self._select("key FROM meta WHERE key LIKE ? LIMIT 1", "answer %"))

    def write_note(self, key: str, value: str) -> None:
        """Store a text under a key, and replace an earlier one."""
        check_not_moved(self.path)
        with storage_errors(self.path), self._db:
            self._db.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, value))

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._db.close()
        if self._note_closed is not None:
            self._note_closed()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


_FIELDS = tuple(field.name for field in fields(Row))
_ENCODED_FIELDS = _FIELDS[:-2]  # without the time and the id, which `_encode` adds
# Types that SQLite stores as they are. So are finite floats; NaN and infinity are not.
_SIMPLE = frozenset({str, int, bool, type(None)})
_JSON = json.JSONEncoder(allow_nan=False)


def _encode_cached(cached: CachedEvaluation) -> tuple[Any, ...]:
    """Return a cached evaluation as the values of its columns, for SQLite.

    Arrays become bytes. The height of the picture is stored as well; its width follows
    from the number of bytes.
    """
    gradient = None if cached.gradient is None else cached.gradient.tobytes()
    picture = None if cached.picture is None else cached.picture.tobytes()
    height = None if cached.picture is None else len(cached.picture)
    numbers = (cached.number, cached.u, cached.non_finite, cached.cost)
    return (*numbers, gradient, picture, height)


def _encode(row: Row, stamp: float) -> tuple[Any, ...]:
    """Return a row as the values of its columns, for SQLite.

    Numbers of NumPy and torch become numbers of Python, mappings become JSON, and empty
    metrics become NULL. Time and id are the last columns.

    Args:
        row: row of an evaluation.
        stamp: the time of writing, seconds since 1970.
    """
    values = []
    for name in _ENCODED_FIELDS:
        value = getattr(row, name)
        if name == "metrics" and not value:
            value = None
        elif name in _AS_JSON and value is not None:
            value = _encode_json(value)
        else:
            # SQLite stores these as they are. Most values are of this kind, so
            # `to_json_value`, which takes longer, is only called for others.
            is_finite_float = type(value) is float and math.isfinite(value)
            is_simple = type(value) in _SIMPLE or is_finite_float
            if not is_simple:
                value = to_json_value(value)
        values.append(value)
    return (*values, stamp, row.id)


def _encode_json(value: Any) -> str:
    """Return a value as JSON."""
    try:
        return _JSON.encode(value)
    # The value contains NaN or numbers of numpy. Converting it is slow, so it is only
    # done if encoding fails.
    except (TypeError, ValueError):
        return _JSON.encode(to_json_value(value))


_PYTHON_TYPES: dict[Any, tuple[type, ...]] = {bool: (int,), float: (float, int)}
_TYPES: dict[str, tuple[type, ...]] = {
    name: tuple(
        held
        for kind in get_args(hint) or (hint,)
        for held in _PYTHON_TYPES.get(kind, (kind,))
    )
    for name, hint in get_type_hints(Row).items()
} | {"payload": (str, type(None)), "metrics": (str, type(None)), "values": (str,)}
"""The types of the values in each column. SQLite itself accepts any type in any column.
"""

_INFINITE = (math.inf, -math.inf)
# Maximum magnitude of a number in a row. Results computed from larger ones may
# overflow.
MAX_NUMBER = 1e300

MAX_STEP = (1 << 32) - 1


def _decode(values: tuple[Any, ...], path: Path) -> Row:
    """Return a row from the values of its columns.

    Each value is checked, since another person may have written the file, and SQLite
    allows any type in any column.

    Args:
        values: values in the order of the fields of `Row`.
        path: path of the file, for the message.

    Raises:
        FileFormatError: a column has another type, or a number that no row has.
    """
    by_name = dict(zip(_FIELDS, values, strict=True))
    # `_decode_json_columns` also replaces JSON texts by their values.
    wrong_column = _find_wrong_column(by_name) or _decode_json_columns(by_name)
    if wrong_column is not None:
        raise FileFormatError(
            f"{path}: row {by_name['id']!r}: expected another type of "
            f"{wrong_column}; {DAMAGED}"
        )
    # SQLite has no bool: it is 0 or 1
    for name in ("success", "correct"):
        by_name[name] = None if by_name[name] is None else bool(by_name[name])
    return Row(**by_name)


def _find_wrong_column(by_name: Mapping[str, Any]) -> str | None:
    """Return the first column whose value no row has, JSON apart; None if all fit."""
    for name, value in by_name.items():
        if not isinstance(value, _TYPES[name]) or value in _INFINITE:
            return name
    return None if 0 <= by_name["step"] <= MAX_STEP else "step"


def _decode_json_columns(by_name: dict[str, Any]) -> str | None:
    """Replace the JSON texts in a row by the values that they encode.

    Args:
        by_name: values by column, which are changed in place.

    Returns:
        The first column whose JSON does not fit a row; None if all fit.
    """
    # `_parse_named` returns None for a text that does not fit
    by_name["values"] = _parse_named(by_name["values"], _is_value)
    if by_name["values"] is None:
        return "values_json"
    metrics_text = by_name["metrics"]  # NULL for a row without metrics
    by_name["metrics"] = (
        {} if metrics_text is None else _parse_named(metrics_text, _is_number_or_none)
    )
    if by_name["metrics"] is None:
        return "metrics_json"
    if by_name["payload"] is not None:
        try:
            by_name["payload"] = parse_json(by_name["payload"], finite=True)
        except ValueError:
            return "payload_json"
    return None


def _decode_cached(values: tuple[Any, ...], path: Path) -> CachedEvaluation:
    """Return a cached evaluation from the values of its columns.

    Args:
        values: values in the order of `_CACHED_COLUMNS`.
        path: path of the file, for the message.

    Raises:
        FileFormatError: a column has another type, or the picture another size.
    """
    try:
        return _make_cached(values)
    except (TypeError, ValueError) as error:
        raise FileFormatError(
            f"{path}: expected the cached evaluations of a search, got something else "
            f"({error})"
        ) from None


def _make_cached(values: tuple[Any, ...]) -> CachedEvaluation:
    """Return a cached evaluation from the values of `_CACHED_COLUMNS`.

    Raises:
        TypeError, ValueError: a column has another type, or the picture another size.
    """
    number, u_digest, non_finite, cost, gradient, picture, height = values
    types = [type(value) for value in (number, u_digest, non_finite, cost)]
    if types != [int, bytes, int, int]:
        raise TypeError("a column of another type")
    if gradient is not None:
        gradient = np.frombuffer(gradient, np.float32)
    if picture is not None:
        picture = np.frombuffer(picture, np.uint8).reshape(height, -1, 3)
    return CachedEvaluation(
        number, u_digest, non_finite, cost, gradient=gradient, picture=picture
    )


def _parse_named(text: str, fits: Callable[[Any], bool]) -> dict[str, Any] | None:
    """Return the JSON object in a text.

    Args:
        text: the JSON.
        fits: whether a value of the object is allowed.

    Returns:
        The object; None if it is none, or if a value is not allowed.
    """
    try:
        named = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return named if isinstance(named, dict) and all(map(fits, named.values())) else None


def _is_value(entry: object) -> bool:
    """Return whether an entry is the value of a parameter with its unit.

    It has the form `{"value": ..., "unit": ...}`. The value is a text, None, a finite
    number, or a list of these.
    """
    if (
        not isinstance(entry, dict)
        or not isinstance(entry.get("unit"), str)
        or "value" not in entry
    ):
        return False
    values = entry["value"] if isinstance(entry["value"], list) else [entry["value"]]
    return all(isinstance(value, str) or _is_number_or_none(value) for value in values)


def _is_number_or_none(value: object) -> bool:
    """Return whether a value is None or a number as rows have them, which is finite."""
    return value is None or (
        isinstance(value, (int, float)) and -MAX_NUMBER <= value <= MAX_NUMBER
    )
