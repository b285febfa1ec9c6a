"""Files that are written whole or not at all, and what a full or read-only disk becomes.

A kill of the process never leaves a part of a file under its name. A power cut may empty a picture or the report that
was written in the last half minute (they can be made again); `run.yaml` and `summary.json` are on the disk when their
writer returns.
"""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from advsearch.errors import StorageError

PART = ".part-"
"""Prefix of a file that is still being written; what a killed process may leave behind."""

_ADVICE = {
    errno.ENOSPC: "the disk is full; free some space or choose another place with `run`",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another place with `run`",
    errno.EROFS: "the file system is read-only; choose another place with `run`",
    errno.EACCES: "there is no permission to write there; choose another place with `run`",
    errno.EPERM: "writing there is not permitted; choose another place with `run`",
    errno.ENOTDIR: "a part of the path is a file, not a folder; choose another place with `run`",
    errno.EEXIST: "a file of that name stands where a folder is needed; choose another place with `run`",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one with `run`",
}

_SQLITE_ADVICE = {
    "full": _ADVICE[errno.ENOSPC],
    "readonly": _ADVICE[errno.EROFS],
    "unable to open": _ADVICE[errno.EACCES],
    "locked": "another program holds it; close that and try again",
}


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn the errors of the operating system and of SQLite inside the block into a `StorageError` that names `path`.

    Raises:
        StorageError: something in the block could not be read or written.
    """
    try:
        yield
    except (OSError, sqlite3.OperationalError) as error:
        raise StorageError(f"cannot write {path}: {_advice(error)}") from error


@contextmanager
def placed_by(setting: str) -> Iterator[None]:
    """Let the advice of a `StorageError` inside the block name the setting that says where the file goes."""
    try:
        yield
    except StorageError as error:
        raise StorageError(str(error).replace("`run`", f"`{setting}`")) from error


@contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Yield a path to write to; when the block ends well its file takes the place of `path` in one step.

    When the block raises, or the process is killed, `path` is as it was before. Missing folders are made.

    Args:
        path: the file to write or to replace.
        durable: wait until the file is on the disk and survives a power cut; some 10 ms.

    Raises:
        StorageError: the file could not be written.
    """
    part = path.with_name(f"{PART}{os.getpid()}-{path.name}")
    try:
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield part
            if durable:
                _flush(part)
            os.replace(part, path)
            if durable:
                _flush(path.parent)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes, *, durable: bool = False) -> Path:
    """Write `data` to `path`, whole or not at all, and return the path; `durable` as for `replacing`.

    Raises:
        StorageError: the file could not be written.
    """
    with replacing(path, durable=durable) as part:
        part.write_bytes(data)
    return path


def write_text(path: Path, text: str, *, durable: bool = True) -> Path:
    """Write `text` in UTF-8 to `path`, whole or not at all, and return the path; `durable` as for `replacing`.

    Raises:
        StorageError: the file could not be written.
    """
    return write_bytes(path, text.encode("utf-8"), durable=durable)


def _flush(path: Path) -> None:
    """Ask the operating system to put a file, or the entries of a folder, on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _advice(error: OSError | sqlite3.Error) -> str:
    if isinstance(error, OSError):
        return _ADVICE.get(error.errno or 0, f"{error.strerror or error}; choose another place with `run`")
    for words, advice in _SQLITE_ADVICE.items():
        if words in str(error):
            return advice
    return f"{error}; choose another place with `run`"
