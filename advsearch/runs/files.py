"""Files that are written whole or not at all, and what a full or read-only disk becomes. And one process to a run.

A kill of the process never leaves a part of a file under its name. A power cut may empty a picture or the report that
was written in the last half minute (they can be made again); `run.yaml` and `summary.json` are on the disk when their
writer returns.

What keeps a run to one process is an advisory lock that the kernel drops when the process ends, however it ends.
"""

from __future__ import annotations

import errno
import fcntl
import os
import sqlite3
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from advsearch.errors import FileFormatError, InputError, StorageError

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


NAME = ".lock"


class RunLock:
    """The lock on a run directory, held from construction until `release` or the end of the process.

    Raises:
        InputError: another process works on this run; the message names it.
        StorageError: the lock file cannot be written, or the file system has no locks.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        with storage_errors(self._path):
            self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        if not stat.S_ISREG(os.fstat(self._descriptor).st_mode):
            self.release()
            raise FileFormatError(f"{self._path}: expected an ordinary file, got a pipe or the like; remove it")
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.truncate(self._descriptor, 0)
            os.write(self._descriptor, str(os.getpid()).encode())
        except OSError as error:
            message = _refusal(error, folder, self._owner())
            self.release()
            raise message from None

    def release(self) -> None:
        """Give the lock up; a second call does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _owner(self) -> str:
        pid = os.pread(self._descriptor, 32, 0).decode(errors="replace")
        return f"process {pid}" if pid.isdigit() else "another process"


def is_held(folder: Path) -> bool:
    """Whether a process works on the run in `folder`; nothing is written."""
    try:
        descriptor = os.open(folder / NAME, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def _refusal(error: OSError, folder: Path, owner: str) -> Exception:
    if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
        return InputError(f"{folder}: {owner} is working on this run; wait for it or choose another name with `run`")
    if error.errno in (errno.ENOLCK, errno.EOPNOTSUPP):
        return StorageError(f"{folder}: the file system has no locks; choose a local disk with `run`")
    return StorageError(f"cannot lock {folder}: {error.strerror}; choose another place with `run`")
