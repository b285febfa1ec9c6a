"""One process to a run: an advisory lock that the kernel drops when the process ends, however it ends."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
from pathlib import Path

from advsearch.errors import FileFormatError, InputError, StorageError
from advsearch.runs.files import storage_errors

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
