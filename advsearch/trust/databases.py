"""Check files of SQLite before they are used.

The threat: a database of somebody else has a view or a trigger, which is code that
SQLite runs and that may never end; its pages are corrupt; or the journal next to it
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
LARGEST = 64 << 30  # maximum bytes of a database, and of its journal
# maximum number of entries of a schema that are read; ours has fewer than ten
MAX_SCHEMA_ENTRIES = 100
_SUPER_JOURNAL_END = bytes.fromhex("d9d505f920a163d7")
"""Last bytes of a journal that names another file
(https://www.sqlite.org/fileformat2.html).
"""


@contextmanager
def translate_database_errors(path: Path) -> Iterator[None]:
    """Turn errors of SQLite inside the block into errors that name the file.

    Raises:
        FileFormatError: in place of an error of SQLite.
    """
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError) as error:
        # The message may quote the content of the file, so that it is escaped and cut.
        text = repr(str(error))[1:-1][:200]
        raise FileFormatError(
            f"{path}: expected a results.sqlite of advsearch, got {text}; {DAMAGED}"
        ) from error


def check_schema(db: sqlite3.Connection, path: Path, statements: str) -> None:
    """Check that a database has exactly the tables and indices of a schema.

    Any other entry is rejected: a view or a trigger is code, which may never end.

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
    """Return all entries of a schema, with the number of times that each occurs.

    An entry is (type, name, table, statement). Comments and line breaks, which SQLite
    ignores, are removed from the statement.
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
    """Return a statement without comments, on one line."""
    without_comments = "\n".join(
        line.partition("--")[0] for line in statement.split("\n")
    )
    return re.sub("[ \n]+", " ", without_comments).strip(" ")


def set_defensive_options(db: sqlite3.Connection) -> None:
    """Set the options of SQLite that are recommended for a database of somebody else.

    Its schema may not call functions and may not be changed, each page is checked when
    it is read, and the file is not mapped into the memory
    (https://www.sqlite.org/security.html). These statements do not read the schema, so
    that no code in it runs before the options are set.
    """
    db.execute("PRAGMA trusted_schema = OFF")
    db.execute("PRAGMA writable_schema = OFF")
    db.execute("PRAGMA cell_size_check = ON")
    db.execute("PRAGMA mmap_size = 0")


def check_before_writing(path: Path) -> None:
    """Check that it is safe to let SQLite write to a path.

    There must be no file yet, or an ordinary file. Through a link SQLite would write to
    another file, and a journal can make it delete another file.

    Raises:
        FileFormatError: the path is a link or a special file, or its journal names
            another file.
    """
    if os.path.islink(path):
        raise FileFormatError(
            f"{path}: expected a file of this run, got a link to another; {DAMAGED}"
        )
    if path.exists():
        # Raises FileFormatError if it is no ordinary file.
        open_regular(path, "a results.sqlite", LARGEST).close()
    _check_journal(path.with_name(f"{path.name}-journal"))


def _check_journal(journal: Path) -> None:
    """Reject a journal that names another file.

    SQLite writes such a journal for a transaction on several databases. It ends with
    the name of a file (the super-journal), which SQLite would delete, and with
    `_SUPER_JOURNAL_END`. Our own journals have neither.

    Args:
        journal: path of the journal; it need not exist.

    Raises:
        FileFormatError: the journal names a file.
    """
    if not os.path.lexists(journal):
        return
    with open_regular(journal, "a journal of SQLite", LARGEST) as file:
        size = os.fstat(file.fileno()).st_size
        file.seek(-min(len(_SUPER_JOURNAL_END), size), os.SEEK_END)
        last_bytes = file.read()
        names_other_file = last_bytes == _SUPER_JOURNAL_END
        if names_other_file:
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
    _check_database_exists(path)
    address = path.resolve().as_uri()
    db = sqlite3.connect(f"{address}?mode=ro", uri=True)
    try:
        # Any query would do, to find out whether the file can be read.
        read_version(db)
    except sqlite3.OperationalError:
        db.close()
        db = sqlite3.connect(f"{address}?immutable=1", uri=True)
    set_defensive_options(db)
    return db


def _check_database_exists(path: Path) -> None:
    """Check that there is a file with the results of a run.

    Raises:
        FileFormatError: there is none.
    """
    if not os.path.isfile(path):
        raise FileFormatError(
            f"{path}: expected the results of a run, got no such file; check the name "
            "of the run"
        )


def read_version(db: sqlite3.Connection) -> int:
    """Return the version of our schema in the header of a database."""
    return int(db.execute("PRAGMA user_version").fetchone()[0])
