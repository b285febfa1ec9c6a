"""SQLite's files: they hold the tables that we make and no code, and opening one
touches no other file.

The threat: a database of somebody else has a view or a trigger, which is code that
SQLite runs and that may never end; its pages are damaged; or the journal beside it
names a file that SQLite would delete.

Used by the results of runs (`runs/store.py`, `runs/files.py`).
"""

from __future__ import annotations

import os
import re
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from advsearch.errors import FileFormatError
from advsearch.trust.stored_files import open_regular

DAMAGED = "it is damaged, or not made by advsearch: take it from a copy, or run again"
LARGEST = 64 << 30  # bytes of a database, and of its journal
MAX_SCHEMA_ENTRIES = 100  # of a schema that are looked at; ours has fewer than ten
_JOURNAL = bytes.fromhex("d9d505f920a163d7")
"""The last bytes of a journal that names a file
(https://www.sqlite.org/fileformat2.html).
"""


@contextmanager
def translate_database_errors(path: Path) -> Iterator[None]:
    """Turn what SQLite says of a damaged file inside the block into an error that names
    it.
    """
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError) as error:
        text = repr(str(error))[1:-1][:200]  # it quotes what is in the file
        raise FileFormatError(
            f"{path}: expected a results.sqlite of advsearch, got {text}; {DAMAGED}"
        ) from error


def check_schema(db: sqlite3.Connection, path: Path, statements: str) -> None:
    """Check that a database has exactly the tables and indices of a schema.

    Any other entry is refused: a view or a trigger is code, which may never end.

    Args:
        db: the database; it is closed if the check fails.
        path: path of its file, for the error.
        statements: SQL statements that create the right schema.
    """
    if read_schema(db) != _schema_of(statements):
        db.close()
        raise FileFormatError(
            f"{path}: expected the tables of a run, got others; {DAMAGED}"
        )


@cache
def _schema_of(statements: str) -> Counter[Any]:
    """Return the schema that SQL statements make, as `read_schema` returns it."""
    with closing(sqlite3.connect(":memory:")) as db:
        db.executescript(statements)
        return read_schema(db)


def read_schema(db: sqlite3.Connection) -> Counter[Any]:
    """Return every entry of a schema, whatever its name, and how often it is there.

    An entry is (type, name, table, statement). The statement has no comments and line
    breaks, which mean nothing to SQLite.
    """
    entries = db.execute(
        "SELECT type, name, tbl_name, sql FROM sqlite_master"
        # A right schema has far fewer entries; a hostile one may have any number.
    ).fetchmany(MAX_SCHEMA_ENTRIES)
    return Counter(
        (*names, None if sql is None else _strip_comments(str(sql)))
        for *names, sql in entries
    )


def _strip_comments(statement: str) -> str:
    without_comments = "\n".join(
        line.partition("--")[0] for line in statement.split("\n")
    )
    return re.sub("[ \n]+", " ", without_comments).strip(" ")


def protect(db: sqlite3.Connection) -> None:
    """Make SQLite careful with a database that may be somebody else's: its schema calls
    no functions, and each page is checked when it is read.

    Nothing here reads the schema, so none of the file's own statements has run by then.
    """
    db.execute("PRAGMA trusted_schema = OFF")
    db.execute("PRAGMA writable_schema = OFF")
    db.execute("PRAGMA cell_size_check = ON")
    db.execute("PRAGMA mmap_size = 0")


def check_before_writing(path: Path) -> None:
    """Check that it is safe to let SQLite write to a path.

    There must be no file yet, or an ordinary file. A link could lead the writing to
    another file, and a journal can make SQLite delete another file.

    Raises:
        FileFormatError: the path is a link or a special file, or its journal names
            another file.
    """
    if os.path.islink(path):
        raise FileFormatError(
            f"{path}: expected a file of this run, got a link to another; {DAMAGED}"
        )
    if path.exists():
        # raises where it is no ordinary file
        open_regular(path, "a results.sqlite", LARGEST).close()
    _check_journal(path.with_name(f"{path.name}-journal"))


def _check_journal(journal: Path) -> None:
    """Refuse a journal that names a file, as a transaction on several databases writes.

    Such a journal ends with the name of a file (a super-journal), which SQLite would
    delete. Our own journals have none.

    Args:
        journal: path of the journal; it need not exist.

    Raises:
        FileFormatError: the journal names a file.
    """
    if not os.path.lexists(journal):
        return
    with open_regular(journal, "a journal of SQLite", LARGEST) as file:
        size = os.fstat(file.fileno()).st_size
        file.seek(-min(len(_JOURNAL), size), os.SEEK_END)
        last_bytes = file.read()
        if last_bytes == _JOURNAL:
            raise FileFormatError(
                f"{journal}: expected the journal of one file, got one that names "
                "another; remove it"
            )


def connect_to_read(path: Path) -> sqlite3.Connection:
    """Open a database for reading.

    To read a database in WAL mode, SQLite has to create a file next to it. If it
    cannot, as on a read-only disk, the database is opened as one that never changes.

    Raises:
        FileFormatError: there is no such file.
    """
    if not os.path.isfile(path):
        raise FileFormatError(
            f"{path}: expected the results of a run, got no such file; check the name "
            "of the run"
        )
    address = path.resolve().as_uri()
    db = sqlite3.connect(f"{address}?mode=ro", uri=True)
    try:
        # any query would do: it shows whether the file can be read
        read_version(db)
    except sqlite3.OperationalError:
        db.close()
        db = sqlite3.connect(f"{address}?immutable=1", uri=True)
    protect(db)
    return db


def read_version(db: sqlite3.Connection) -> int:
    """Return the version that the header has."""
    return int(db.execute("PRAGMA user_version").fetchone()[0])
