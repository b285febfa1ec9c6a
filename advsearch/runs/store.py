"""`results.sqlite`: every evaluated configuration of a run.

What survives: when `Store.append` returns, its rows are handed to the operating system (write-ahead log), so that
killing the process loses nothing. A power cut loses at most the rows written within a second after the last one known
to be on the disk, and never damages the file: `append` forces the log to the disk when the last time is a second ago
(on a slow disk, so long ago that this takes 2 % of the time).
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, final, get_args, get_type_hints

from advsearch.described import Value
from advsearch.errors import FileFormatError
from advsearch.files import JsonValue, open_regular, parse_json
from advsearch.runs.files import storage_errors
from advsearch.runs.results.base import plain

NAME = "results.sqlite"

_DAMAGED = "it is damaged, or not made by advsearch: take it from a copy, or run again"

LARGEST = 64 << 30
"""Most bytes of it."""

APPLICATION_ID = 0x41445653
"""In the header of every results.sqlite that is ours: "ADVS"."""

SYNC_INTERVAL = 1.0
"""Least seconds between two forced writes to the disk; what a power cut may cost."""

SYNC_SHARE = 0.02
"""Largest share of the time that forced writes may take."""

MIGRATIONS = (
    """
    -- How this file came to be; times are UTC. PRAGMA user_version is the number of migrations it has been through.
    CREATE TABLE meta (
        key   TEXT PRIMARY KEY,
        value TEXT NOT NULL
    ) WITHOUT ROWID;
    INSERT INTO meta VALUES ('created', strftime('%Y-%m-%dT%H:%M:%SZ', 'now'));

    -- One row for each evaluated configuration, in the order in which they were evaluated.
    CREATE TABLE evaluations (
        id          INTEGER PRIMARY KEY, -- grows by one
        kind        TEXT    NOT NULL,    -- what it was for: search, baseline, verification, control, ...
        step        INTEGER NOT NULL,    -- step or trial within its kind, from 0
        seed        INTEGER,             -- of the render
        spp         INTEGER,             -- samples per pixel of the render
        objective   REAL,                -- what was maximised; NULL when it was not a number
        success     INTEGER,             -- 1 when the model was wrong, 0 when right, NULL when not judged
        label       TEXT,                -- the class that the model answered
        label_index INTEGER,             -- its number
        probability REAL,                -- the model's probability for it, in [0, 1]
        values_json TEXT    NOT NULL,    -- {"camera.azimuth": {"value": 130.0, "unit": "degrees"}, ...}
        seconds     REAL,                -- that the evaluation took
        time        REAL    NOT NULL     -- when the row was written, seconds since 1970 (UTC)
    );
    CREATE INDEX evaluations_kind ON evaluations (kind, step);
    """,
    """
    -- Pictures that the evaluation took: more than one where derivatives came from differences, or it was rendered
    -- with a multiple of the samples. NULL in rows of version 1.
    ALTER TABLE evaluations ADD COLUMN renders INTEGER;
    """,
    """
    -- What the model said, whatever a search was after. NULL in older rows, but those of a sweep, where `success` said
    -- that the model was wrong; now a sweep's rows have no success: nothing is sought there.
    ALTER TABLE evaluations ADD COLUMN correct INTEGER; -- 1 when the answer was a right one, else 0
    ALTER TABLE evaluations ADD COLUMN margin REAL;     -- largest logit of a wrong class minus largest of a right one
    UPDATE evaluations SET correct = coalesce(success = 0, 0), margin = objective, success = NULL WHERE kind = 'sweep';
    """,
    """
    -- What a task keeps of an answer beside its words, as JSON (boxes, masks). NULL where it keeps nothing, and in
    -- older rows.
    ALTER TABLE evaluations ADD COLUMN payload_json TEXT;
    """,
    """
    -- A step of a kind is there once, whoever writes it how often.
    DELETE FROM evaluations WHERE id NOT IN (SELECT min(id) FROM evaluations GROUP BY kind, step);
    DROP INDEX evaluations_kind;
    CREATE UNIQUE INDEX evaluations_step ON evaluations (kind, step);
    -- What the row was evaluated on, by its name in the note "machines". NULL for the machine that wrote the row.
    ALTER TABLE evaluations ADD COLUMN machine TEXT;
    """,
    """
    -- What a task says of an answer, over 0 where it is what is sought. Before, `objective` held it in all rows but
    -- those of searches, of which it is not known (NULL).
    ALTER TABLE evaluations ADD COLUMN score REAL;
    UPDATE evaluations SET score = objective, objective = NULL
        WHERE kind <> 'baseline' AND substr(kind, 1, 6) <> 'search';
    """,
    """
    -- Of rows of a search: search, or ranking where a candidate was rendered again at its end. NULL in older rows.
    ALTER TABLE evaluations ADD COLUMN phase TEXT;
    -- {"feature": 0.31, ...}: numbers that the run's metrics say of the picture. NULL where there are none.
    ALTER TABLE evaluations ADD COLUMN metrics_json TEXT;
    """,
)
"""What turns a file of version n into one of version n + 1. Never change one that was released; add another."""


@dataclass(frozen=True)
class Row:
    """One evaluated configuration.

    Attributes:
        kind: what it was evaluated for: ``"search"``, ``"baseline"``, ``"verification"``, ``"control"``.
        step: step of the search or number of the trial, from 0.
        seed: of the render.
        spp: samples per pixel of the render.
        objective: what is maximised, of this picture; stored as None when it is not a number, or nothing is maximised.
        score: what the run's task says of the answer: over 0 where it is what is sought; stored as None when it is not
            a number.
        success: whether the answer is what the attack is after; None where nothing is sought, as in a sweep.
        correct: whether the answer is right; None in rows of older runs.
        margin: how wrong it is, by the run's task, over 0 where it is not right; in classification the largest logit of
            a wrong class minus the largest of a right one; stored as None when it is not a number.
        label: what the model answered, in words.
        label_index: the number of that class; None where there are no classes.
        probability: the model's probability for it, in [0, 1]; None where it gives none.
        payload: what the run's task keeps of the answer beside its words, as JSON values; None where there is nothing.
        values: parameter to ``{"value": ..., "unit": ...}``.
        seconds: that the evaluation took.
        renders: pictures that it took; None where that was not counted.
        phase: of a search: ``"search"``, or ``"ranking"`` where a candidate was rendered again at the end; None of
            trials, and in rows of older runs.
        metrics: numbers that the run's metrics say of the picture, by name; None where one is not a number.
        machine: what it was evaluated on, by its name in the note "machines"; None for the machine that wrote the row.
        time: when it was written, seconds since 1970; set by the store.
        id: place in the file, from 1; set by the store where it is not given.
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


_AS_JSON = ("payload", "values", "metrics")
_COLUMNS = tuple(f"{one.name}_json" if one.name in _AS_JSON else one.name for one in fields(Row))
_INSERT = (
    f"INSERT INTO evaluations ({', '.join(_COLUMNS)}) VALUES ({', '.join('?' * len(_COLUMNS))}) ON CONFLICT DO NOTHING"
)


@final
class Store:
    """The open `results.sqlite` of a run. Close it, or use it in a `with` block.

    Args:
        path: the file; made when it is not there, unless `read_only`.
        read_only: open for reading beside a process that writes.

    Raises:
        FileFormatError: the file is missing (`read_only`), is not a results.sqlite, or is of a newer advsearch.
        StorageError: it cannot be written.
    """

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        self.path = path
        self._next_sync = -math.inf
        with _readable(path):
            self._db = _connect_to_read(path) if read_only else _connect_to_write(path)
            _check_version(self._db, path)
            _check_schema(self._db, path)

    def append(self, rows: Iterable[Row]) -> None:
        """Add rows in one transaction; they survive a kill of the process when this returns.

        A row whose kind and step are there already changes nothing.

        Raises:
            StorageError: the disk is full or can't be written; none of these rows is kept.
        """
        began, stamp = time.monotonic(), time.time()
        force = began >= self._next_sync
        with storage_errors(self.path):
            self._db.execute(f"PRAGMA synchronous = {'FULL' if force else 'NORMAL'}")
            with self._db:
                self._db.executemany(_INSERT, (_encode(row, stamp) for row in rows))
        if force:
            ended = time.monotonic()
            self._next_sync = ended + max(SYNC_INTERVAL, (ended - began) / SYNC_SHARE)

    def rows(self, kind: str | None = None, after: int = 0) -> Iterator[Row]:
        """Yield the rows, or those of one kind, in the order in which they were written.

        Args:
            kind: of the rows; None for all.
            after: the id behind which to begin.
        """
        where, given = ("id > ?", (after,)) if kind is None else ("id > ? AND kind = ?", (after, kind))
        with _readable(self.path):
            cursor = self._db.execute(f"SELECT {', '.join(_COLUMNS)} FROM evaluations WHERE {where} ORDER BY id", given)
        while (values := self._next(cursor)) is not None:
            yield _decode(values, self.path)

    def row(self, kind: str, step: int) -> Row | None:
        """Return the last row of a kind with a step; None where there is none."""
        with _readable(self.path):
            found = self._db.execute(
                f"SELECT {', '.join(_COLUMNS)} FROM evaluations WHERE kind = ? AND step = ? ORDER BY id DESC LIMIT 1",
                (kind, step),
            ).fetchone()
        return None if found is None else _decode(found, self.path)

    def last_step(self, kind: str) -> int:
        """Return the largest step of a kind; -1 where there is none."""
        with _readable(self.path):
            found = self._db.execute("SELECT max(step) FROM evaluations WHERE kind = ?", (kind,)).fetchone()[0]
        return -1 if found is None else int(found)

    def count(self, kind: str | None = None) -> int:
        """Return how many rows there are, or how many of one kind."""
        where, given = ("", ()) if kind is None else (" WHERE kind = ?", (kind,))
        with _readable(self.path):
            return int(self._db.execute(f"SELECT count(*) FROM evaluations{where}", given).fetchone()[0])

    def curve(self, kind: str) -> list[tuple[int, float | None]]:
        """Return (step, objective) of every row of one kind, in the order in which they were written."""
        return [(row.step, row.objective) for row in self.rows(kind)]

    def missing(self, kind: str, count: int) -> Iterator[range]:
        """Yield the steps from 0 to `count` of which there is no row of a kind, neighbours together."""
        expected = 0
        with _readable(self.path):
            cursor = self._db.execute("SELECT step FROM evaluations WHERE kind = ? ORDER BY step", (kind,))
        while (found := self._next(cursor)) is not None:
            if found[0] > expected:
                yield range(expected, min(found[0], count))
            expected = found[0] + 1
        if expected < count:
            yield range(expected, count)

    def _next(self, cursor: sqlite3.Cursor) -> Any:
        with _readable(self.path):
            return cursor.fetchone()

    def counts(self) -> dict[str, int]:
        """Return how many rows there are of each kind."""
        with _readable(self.path):
            found = self._db.execute("SELECT kind, count(*) FROM evaluations GROUP BY kind ORDER BY kind").fetchall()
        return {str(kind): count for kind, count in found}

    def note(self, key: str) -> str | None:
        """Return what was noted under `key`, or None."""
        with _readable(self.path):
            found = self._db.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        return None if found is None else str(found[0])

    def noted(self, key: str) -> Any:
        """Return the JSON value that was noted under `key`, or None.

        Raises:
            FileFormatError: what was noted is no JSON.
        """
        text = self.note(key)
        try:
            return None if text is None else parse_json(text)
        except ValueError as error:
            raise FileFormatError(f"{self.path}: expected JSON in the note {key!r}, got {error}; {_DAMAGED}") from None

    def set_note(self, key: str, value: str) -> None:
        """Keep a text under `key`, in place of what was there.

        Raises:
            StorageError: the disk is full or can't be written.
        """
        with storage_errors(self.path), self._db:
            self._db.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, value))

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._db.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def is_ours(path: Path) -> bool:
    """Return whether the file at `path` starts like a results.sqlite of advsearch."""
    try:
        with open_regular(path, "a results.sqlite", LARGEST) as file:
            header = file.read(72)
    except (OSError, FileFormatError):
        return False
    return header[:15] == b"SQLite format 3" and header[68:72] == APPLICATION_ID.to_bytes(4, "big")


def is_bare(path: Path) -> bool:
    """Return whether the file at `path`, which is ours, has no tables yet: its process was killed as it made them."""
    with _readable(path), closing(_connect_to_read(path)) as db:
        return _version(db) == 0 and not _schema(db)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn what SQLite says of a damaged file inside the block into an error that names it."""
    try:
        yield
    except sqlite3.Error as error:
        text = repr(str(error))[1:-1][:200]  # it quotes what is in the file
        raise FileFormatError(f"{path}: expected a results.sqlite of advsearch, got {text}; {_DAMAGED}") from error


def _check_schema(db: sqlite3.Connection, path: Path) -> None:
    """Check that the file has what `MIGRATIONS` make and no more: a view or a trigger is code, and may never end."""
    if _schema(db) != _own_schema():
        db.close()
        raise FileFormatError(f"{path}: expected the tables of a run, got others; {_DAMAGED}")


@cache
def _own_schema() -> frozenset[Any]:
    with closing(sqlite3.connect(":memory:")) as db:
        _migrate(db)
        return _schema(db)


def _schema(db: sqlite3.Connection) -> frozenset[Any]:
    """Return the tables and the like, and the columns of the rows; a column that is computed is another one."""
    parts = db.execute("SELECT type, name FROM sqlite_master WHERE name NOT LIKE 'sqlite%'").fetchall()
    columns = db.execute("PRAGMA table_xinfo(evaluations)").fetchall()
    return frozenset([*parts, *((name, kind, hidden) for _, name, kind, *_, hidden in columns)])


def _connect_to_write(path: Path) -> sqlite3.Connection:
    """Open or make the file and bring it up to date."""
    if path.is_symlink():
        raise FileFormatError(f"{path}: expected a file of this run, got a link to another; {_DAMAGED}")
    if path.exists():
        open_regular(path, "a results.sqlite", LARGEST).close()
    with storage_errors(path):
        db = sqlite3.connect(path)
        version = _version(db)
        if version == 0:
            _make(db)
        _migrate(db)
    return db


def _make(db: sqlite3.Connection) -> None:
    """Start an empty file. There is nothing in it to lose yet, so the disk isn't waited for."""
    db.execute("PRAGMA synchronous = OFF")
    db.execute(f"PRAGMA application_id = {APPLICATION_ID}")  # before the log, so that the file itself has it
    db.execute("PRAGMA journal_mode = WAL")


def _connect_to_read(path: Path) -> sqlite3.Connection:
    """Open the file for reading; where the log's index can't be made (a read-only disk), as one that never changes."""
    if not os.path.isfile(path):
        raise FileFormatError(f"{path}: expected the results of a run, got no such file; check the name of the run")
    address = path.resolve().as_uri()
    db = sqlite3.connect(f"{address}?mode=ro", uri=True)
    try:
        _version(db)
    except sqlite3.OperationalError:
        db.close()
        db = sqlite3.connect(f"{address}?immutable=1", uri=True)
    return _migrated_copy(db) if 0 < _version(db) < len(MIGRATIONS) else db


def _migrated_copy(db: sqlite3.Connection) -> sqlite3.Connection:
    """An older file's contents in memory, as the present version has them; the file stays as it is."""
    copy = sqlite3.connect(":memory:")
    db.backup(copy)
    db.close()
    _migrate(copy)
    return copy


def _migrate(db: sqlite3.Connection) -> None:
    """Bring a file up to date."""
    for number, script in enumerate(MIGRATIONS[_version(db) :], start=_version(db) + 1):
        db.executescript(f"BEGIN; {script} PRAGMA user_version = {number}; COMMIT;")


def _version(db: sqlite3.Connection) -> int:
    return int(db.execute("PRAGMA user_version").fetchone()[0])


def _check_version(db: sqlite3.Connection, path: Path) -> None:
    version = _version(db)
    if version != len(MIGRATIONS):
        db.close()
        advice = "use a newer advsearch" if version > len(MIGRATIONS) else "it is not a finished results.sqlite"
        raise FileFormatError(f"{path}: expected version {len(MIGRATIONS)} of the results, got {version}; {advice}")


_FIELDS = tuple(one.name for one in fields(Row))
_NAMES = _FIELDS[:-1]  # without the id
_OTHERS = _NAMES[:-1]  # without the time
_SIMPLE = frozenset({str, int, bool, type(None)})
_JSON = json.JSONEncoder(allow_nan=False)


def _encode(row: Row, stamp: float) -> tuple[Any, ...]:
    """Return the row's columns. Numbers of numpy and torch become Python's."""
    return (*(_encoded(name, getattr(row, name)) for name in _OTHERS), stamp, row.id)


def _encoded(name: str, value: Any) -> Any:
    if name not in _AS_JSON:
        return _column(value)
    return None if value is None or (name == "metrics" and not value) else _json(value)


def _column(value: Any) -> Any:
    simple = type(value) in _SIMPLE or (type(value) is float and value - value == 0.0)
    return value if simple else plain(value)


def _json(value: object) -> str:
    try:
        return _JSON.encode(value)
    except (TypeError, ValueError):
        return json.dumps(plain(value), allow_nan=False)


def _column_types() -> dict[str, tuple[type, ...]]:
    """Return what each column of a row holds; SQLite itself takes anything anywhere."""
    held: dict[Any, tuple[type, ...]] = {bool: (int,), float: (float, int)}
    hints = {name: get_args(hint) or (hint,) for name, hint in get_type_hints(Row).items() if name not in _AS_JSON}
    types = {name: tuple(kind for part in parts for kind in held.get(part, (part,))) for name, parts in hints.items()}
    return {**types, "payload": (str, type(None)), "metrics": (str, type(None)), "values": (str,)}


_TYPES = _column_types()


def _decode(values: tuple[Any, ...], path: Path) -> Row:
    given = dict(zip(_FIELDS, values, strict=True))
    wrong = [name for name, value in given.items() if not isinstance(value, _TYPES[name])]
    if not wrong:
        given["values"] = _values(given["values"])
        wrong = ["values_json"] if given["values"] is None else []
    if not wrong:
        given["metrics"] = {} if given["metrics"] is None else _metrics(given["metrics"])
        wrong = ["metrics_json"] if given["metrics"] is None else []
    if not wrong and given["payload"] is not None:
        try:
            given["payload"] = parse_json(given["payload"])
        except ValueError:
            wrong = ["payload_json"]
    if wrong:
        raise FileFormatError(f"{path}: row {given['id']!r}: expected another type of {wrong[0]}; {_DAMAGED}")
    for name in ("success", "correct"):
        given[name] = None if given[name] is None else bool(given[name])
    return Row(**given)


def _values(text: str) -> dict[str, Value] | None:
    """Return the values of a row, None where they are not what `Row` says."""
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return values if isinstance(values, dict) else None


def _metrics(text: str) -> dict[str, float | None] | None:
    """Return the metrics of a row, None where they are not numbers by name."""
    found: Any = _values(text)
    numbers = found is not None and all(one is None or type(one) in (int, float) for one in found.values())
    return dict(found) if numbers else None
