"""The file of `results.sqlite`: its tables, how it is opened, and how an older one is brought up to date."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from advsearch.errors import FileFormatError
from advsearch.files import open_regular
from advsearch.runs.files import storage_errors

DAMAGED = "it is damaged, or not made by advsearch: take it from a copy, or run again"

LARGEST = 64 << 30
"""Most bytes of it."""

APPLICATION_ID = 0x41445653
"""In the header of every results.sqlite that is ours: "ADVS"."""

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
    -- What an evaluation told its search beside its row: only until the run is done.
    CREATE TABLE told (
        row         INTEGER PRIMARY KEY REFERENCES evaluations (id),
        number      INTEGER NOT NULL, -- of its seed
        u           BLOB    NOT NULL, -- digest of the configuration
        non_finite  INTEGER NOT NULL, -- numbers of the gradient that were not
        cost        INTEGER NOT NULL, -- in evaluations
        gradient    BLOB,             -- float32, where one was wanted
        picture     BLOB,             -- levels of 8 bits, where it is kept for the animation
        height      INTEGER           -- of that, in pixels
    );
    """,
    """
    -- Of rows of a search: search, or ranking where a candidate was rendered again at its end. NULL in older rows.
    ALTER TABLE evaluations ADD COLUMN phase TEXT;
    -- {"feature": 0.31, ...}: numbers that the run's metrics say of the picture. NULL where there are none.
    ALTER TABLE evaluations ADD COLUMN metrics_json TEXT;
    """,
)
"""What turns a file of version n into one of version n + 1. Never change one that was released; add another."""


def is_results_database(path: Path) -> bool:
    """Return whether the file at `path` starts like a results.sqlite of advsearch."""
    try:
        with open_regular(path, "a results.sqlite", LARGEST) as file:
            header = file.read(72)
    except (OSError, FileFormatError):
        return False
    return header[:15] == b"SQLite format 3" and header[68:72] == APPLICATION_ID.to_bytes(4, "big")


def is_bare(path: Path) -> bool:
    """Return whether the file at `path`, which is ours, has no tables yet: its process was killed as it made them."""
    with readable(path), closing(connect_to_read(path)) as db:
        return _version(db) == 0 and not _schema(db)


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn what SQLite says of a damaged file inside the block into an error that names it."""
    try:
        yield
    except sqlite3.Error as error:
        text = repr(str(error))[1:-1][:200]  # it quotes what is in the file
        raise FileFormatError(f"{path}: expected a results.sqlite of advsearch, got {text}; {DAMAGED}") from error


def check_schema(db: sqlite3.Connection, path: Path) -> None:
    """Check that the file has what `MIGRATIONS` make and no more: a view or a trigger is code, and may never end."""
    if _schema(db) != _own_schema():
        db.close()
        raise FileFormatError(f"{path}: expected the tables of a run, got others; {DAMAGED}")


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


def connect_to_write(path: Path) -> sqlite3.Connection:
    """Open or make the file and bring it up to date."""
    if path.is_symlink():
        raise FileFormatError(f"{path}: expected a file of this run, got a link to another; {DAMAGED}")
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


def connect_to_read(path: Path) -> sqlite3.Connection:
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


def check_version(db: sqlite3.Connection, path: Path) -> None:
    version = _version(db)
    if version != len(MIGRATIONS):
        db.close()
        advice = "use a newer advsearch" if version > len(MIGRATIONS) else "it is not a finished results.sqlite"
        raise FileFormatError(f"{path}: expected version {len(MIGRATIONS)} of the results, got {version}; {advice}")
