"""Write files atomically, by one process at a time, and never through links.

The threat: a process is killed or the disk is full while it writes; two processes write
into the same run; a run's folder is removed or renamed meanwhile; or somebody else has
made the folder, with a link to a file that would be displayed, copied or overwritten.
The kernel releases a lock when its process ends.

Used by all that writes: runs (`runs/directory.py`, `runs/files.py`, `runs/store.py`),
exports, pages and studies.
"""

from __future__ import annotations

import errno
import fcntl
import os
import sqlite3
import stat
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from advsearch.errors import FileFormatError, InputError, StorageError

# prefix of a file that is being written; a killed process may leave such a file
PART = ".part-"
_ADVICE = {
    errno.ENOSPC: "the disk is full; free some space or choose another place with `run`",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another place "
    "with `run`",
    errno.EROFS: "the file system is read-only; choose another place with `run`",
    errno.EACCES: "there is no permission to write there; choose another place with "
    "`run`",
    errno.EPERM: "writing there is not permitted; choose another place with `run`",
    errno.ENOTDIR: "a part of the path is a file, not a folder; choose another place "
    "with `run`",
    errno.EEXIST: "a file of that name stands where a folder is needed; choose another "
    "place with `run`",
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
    """Turn errors of writing inside the block into a `StorageError` that names `path`.

    These are errors of the operating system and of SQLite. The message states what the
    user can do, for example about a full disk.
    """
    try:
        yield
    except (OSError, sqlite3.OperationalError) as error:
        # If the folder of the run was moved, that is the cause of this error: then the
        # function raises an error that says so.
        check_not_moved(path)
        advice = _find_advice(error)
        if advice is None:
            text = getattr(error, "strerror", None) or error
            advice = f"{text}; choose another place with `run`"
        raise StorageError(f"cannot write {path}: {advice}") from error


def _find_advice(error: OSError | sqlite3.OperationalError) -> str | None:
    """Return what to do about an error; None if nothing is known about it."""
    if isinstance(error, OSError):
        return _ADVICE.get(error.errno or 0)
    for words, advice in _SQLITE_ADVICE.items():
        if words in str(error):
            return advice
    return None


@contextmanager
def name_setting_in_errors(setting: str) -> Iterator[None]:
    """Replace `run` by another setting in the advice of a `StorageError`."""
    try:
        yield
    except StorageError as error:
        raise StorageError(str(error).replace("`run`", f"`{setting}`")) from error


@contextmanager
def replace_file(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Yield a path to write to; its file replaces `path` at the end of the block.

    The replacement is atomic: if the block raises, or the process is killed, `path` is
    as it was before. Missing folders are created.

    Args:
        path: path of the file.
        durable: whether the file must survive a power cut; that takes about 10 ms.

    Raises:
        StorageError: the file cannot be written.
    """
    part = path.with_name(f"{PART}{os.getpid()}-{path.name}")
    # Without this check, the folder of a run that was moved would be created again.
    check_not_moved(path)
    try:
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            # A link of somebody else at this path would lead the writing elsewhere.
            part.unlink(missing_ok=True)
            yield part  # the caller writes this file
            if durable:
                _flush(part)
            os.replace(part, path)
            if durable:
                _flush(path.parent)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def check_free_folder(out: Path, setting: str) -> None:
    """Check that a folder to be written does not exist yet or is empty.

    A link is rejected: the finished folder could not replace it, and it may lead to
    files of somebody else.

    Args:
        out: path of the folder.
        setting: setting that names the folder, for the error.

    Raises:
        InputError: the path is a link, a file, or a folder that is not empty.
    """
    if os.path.islink(out):
        raise InputError(
            f"{setting}: expected a new or an empty folder, got the link "
            f"{out}; name the folder itself"
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(
            f"{setting}: {out} is there already and not empty; name another folder"
        )


def write_bytes(path: Path, data: bytes, *, durable: bool = False) -> Path:
    """Write data to a path atomically, and return the path.

    Args:
        path: path of the file.
        data: content of the file.
        durable: as for `replace_file`.
    """
    with replace_file(path, durable=durable) as part:
        part.write_bytes(data)
    return path


def write_text(path: Path, text: str, *, durable: bool = True) -> Path:
    """Write a text in UTF-8 to a path atomically, and return the path.

    Args:
        path: path of the file.
        text: content of the file.
        durable: as for `replace_file`.
    """
    return write_bytes(path, text.encode("utf-8"), durable=durable)


def _flush(path: Path) -> None:
    """Make a file or a folder durable: have the system write it to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class _OpenResults(NamedTuple):
    """The file with the results of a run that this process writes.

    Attributes:
        path: path of the file.
        file_id: its device and inode. A new file of the same name has another inode.
    """

    path: Path
    file_id: tuple[int, int]


_open: dict[Path, _OpenResults] = {}  # by the folder of the run


def _get_file_id(status: os.stat_result) -> tuple[int, int]:
    """Return device and inode of a file."""
    return status.st_dev, status.st_ino


def note_open(results: Path) -> Callable[[], None]:
    """Register that the results of a run are open for writing.

    From now on `check_not_moved` checks that the folder of the run is still there.

    Args:
        results: path of the file with the results.

    Returns:
        A function without arguments, to be called when the file is closed.
    """
    folder = results.parent
    with storage_errors(results):
        entry = _OpenResults(results, _get_file_id(results.stat()))
    _open[folder] = entry

    def note_closed() -> None:
        """Register that the results are closed."""
        # The run may have been opened again since.
        if _open.get(folder) is entry:
            del _open[folder]

    return note_closed


def check_not_moved(path: Path) -> None:
    """Check that the run folder around `path` was not removed or renamed meanwhile.

    Only folders of runs to which this process writes are checked. Such a folder must
    not be created again: writing to the files that are still open would succeed, but
    nobody could find them.

    Raises:
        StorageError: the folder was removed or renamed.
    """
    for folder in (path, *path.parents):
        if folder not in _open:
            continue
        results = _open[folder]
        if not _is_same_file(results.path, results.file_id):
            raise StorageError(
                f"{folder}: the folder of this run was removed or renamed while the "
                "run went on; start it again, or go on with what was renamed by "
                "advsearch resume"
            )


LOCK = ".lock"


def _is_same_file(path: Path, file_id: tuple[int, int]) -> bool:
    """Return whether a path still leads to the file that it led to.

    Args:
        path: path of the file.
        file_id: what `_get_file_id` returned for the file before.
    """
    try:
        return _get_file_id(path.stat()) == file_id
    except OSError:
        return False


def _make_lock_error(folder: Path, error: OSError, pid: str) -> Exception:
    """Return the error for a run directory that could not be locked.

    Args:
        folder: the run directory.
        error: error of the operating system.
        pid: process number that the lock file contains; it may be corrupt.
    """
    if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
        owner = f"process {pid}" if pid.isdecimal() else "another process"
        return InputError(
            f"{folder}: {owner} is working on this run; wait for it or choose "
            "another name with `run`"
        )
    if error.errno in (errno.ENOLCK, errno.EOPNOTSUPP):
        return StorageError(
            f"{folder}: the file system has no locks; choose a local disk with `run`"
        )
    return StorageError(
        f"cannot lock {folder}: {error.strerror}; choose another place with `run`"
    )


class RunLock:
    """The lock on a run directory, held until `release` or the end of the process."""

    def __init__(self, folder: Path) -> None:
        """Lock a run directory and write this process's number into the lock.

        Raises:
            InputError: another process holds the lock; the message names it.
            StorageError: the file system has no locks, or the file cannot be
                written.
            FileFormatError: the lock is no ordinary file.
        """
        self._path = folder / LOCK
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        with storage_errors(self._path):
            self._descriptor = os.open(self._path, flags, 0o644)
        self._check_ordinary_file()
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.truncate(self._descriptor, 0)
            os.write(self._descriptor, str(os.getpid()).encode())
        except OSError as error:
            # A process that holds the lock has written its number into the file. For other
            # errors the file may be empty.
            pid = os.pread(self._descriptor, 32, 0).decode(errors="replace")
            self.release()
            raise _make_lock_error(folder, error, pid) from None

    def _check_ordinary_file(self) -> None:
        """Check that the lock is an ordinary file; otherwise close it.

        Raises:
            FileFormatError: it is something else.
        """
        if not stat.S_ISREG(os.fstat(self._descriptor).st_mode):
            self.release()
            raise FileFormatError(
                f"{self._path}: expected an ordinary file, got a pipe or the like; "
                "remove it"
            )

    def release(self) -> None:
        """Release the lock, if it is held."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def is_held(folder: Path) -> bool:
    """Return whether a process works on the run in `folder`; nothing is written."""
    try:
        descriptor = os.open(folder / LOCK, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        # A shared lock is granted only if nobody holds the exclusive one.
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def check_no_links(run: Path, contents: Collection[str], unchecked_suffix: str) -> None:
    """Check that the folder of a run has only files and folders, and no links.

    In a run that somebody else made, a link may lead to any file, which would then be
    displayed, copied or overwritten. The run folder itself may be a link, since the
    user names it.

    Args:
        run: the folder of the run.
        contents: names in this folder that are checked, in addition to the lock; other
            names are ignored.
        unchecked_suffix: end of the path of a folder whose subfolders are not checked,
            such as that of thumbnails. The folder itself is checked.

    Raises:
        FileFormatError: there is a link, a pipe or another special file.
    """
    folders = [str(run)]
    while folders:
        folder = folders.pop()
        # In the folder of the run itself, other names are ignored.
        checked_names = (*contents, LOCK) if folder == str(run) else None
        for entry in _list_entries(folder, checked_names):
            _check_entry_kind(entry)
            # `folder` is the one that contains this subfolder.
            checks_subfolders = not folder.endswith(unchecked_suffix)
            if entry.is_dir(follow_symlinks=False) and checks_subfolders:
                folders.append(entry.path)  # its contents are checked, too


def _list_entries(folder: str, names: Collection[str] | None) -> list[os.DirEntry[str]]:
    """Return the entries of a folder; an empty list if the folder was removed.

    Args:
        folder: path of the folder.
        names: names of the entries to return; None for all.

    Raises:
        FileFormatError: it cannot be read.
    """
    try:
        with os.scandir(folder) as entries:
            return [entry for entry in entries if names is None or entry.name in names]
    except OSError as error:
        if error.errno == errno.ENOENT:  # it was removed meanwhile
            return []
        raise FileFormatError(
            f"{folder}: expected a folder of a run, got {error.strerror}"
        ) from None


def _check_entry_kind(entry: os.DirEntry[str]) -> None:
    """Check that an entry of a run's folder is a file or a folder.

    Raises:
        FileFormatError: it is a link, a pipe or another special file.
    """
    if entry.is_symlink():
        raise FileFormatError(
            f"{entry.path}: expected a file or a folder of this run, got a "
            "link; remove it"
        )
    if entry.is_dir(follow_symlinks=False):
        return
    # `RunLock` checks the lock itself when it opens it.
    if not entry.is_file(follow_symlinks=False) and entry.name != LOCK:
        raise FileFormatError(
            f"{entry.path}: expected a file of this run, got a "
            "pipe or the like; remove it"
        )
