"""List the runs in a folder, with their status and a short result."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from advsearch.errors import AdvsearchError
from advsearch.runs import files, store, summary
from advsearch.runs.directory import CONFIG, check_links, is_run
from advsearch.runs.results import Result
from advsearch.settings import read_yaml
from advsearch.trust.writing import is_held

FAULT = "it cannot be read, which is a fault of advsearch"


@dataclass(frozen=True)
class ListedRun:
    """An entry in the list of runs.

    Attributes:
        name: name of the run, that of its folder.
        path: path of the folder.
        command: command that made the run.
        object: name of the object.
        controls: names of the controls.
        rows: number of stored rows.
        state: "running" if a process works on it, "stopped" if it can be resumed,
            otherwise the status with which it ended.
        outcome: the result in a few words.
        kinds: number of rows by kind.
        started: whether its settings were stored, so that it can be resumed.
        when: time of its start in seconds since 1970 (UTC); None if unknown.
        fault: what is wrong with its files; empty if nothing is.
    """

    name: str
    path: str
    command: str
    object: str
    controls: tuple[str, ...]
    rows: int
    state: str
    outcome: str
    kinds: Mapping[str, int]
    started: bool
    when: float | None
    fault: str = ""


def list_runs(folder: Path) -> list[ListedRun]:
    """Return the runs in a folder, sorted by name.

    A run that cannot be read completely is listed with what can be read.
    """
    if not folder.is_dir():
        return []
    return [
        read_listed_run(path)
        for path in sorted(folder.iterdir())
        if path.is_dir() and is_run(path)
    ]


def is_finished(path: Path) -> bool:
    """Return whether a run has come to its end.

    It has not if it was interrupted, or killed while its report was written.
    """
    has_result = (path / summary.NAME).is_file()
    if not has_result or summary.read_result(path).is_unfinished:
        return False
    # A run that was killed while its report was written has a result, but can still be
    # resumed.
    return not files.is_results_database(path / store.NAME) or not can_resume(path)


def can_resume(path: Path) -> bool:
    """Return whether a search of a run can go on: its cached evaluations are stored."""
    with store.Store(path / store.NAME, read_only=True) as results:
        return results.has_cached


# by path and `counts`, the state of the files when they were read, and the entry
_LISTED: dict[tuple[str, bool], tuple[object, ListedRun]] = {}


def read_listed_run(path: Path, *, counts: bool = True) -> ListedRun:
    """Return the entry of a run in the list of runs.

    What cannot be read is left out, and `fault` states why. The entry is cached until
    the files of the run change. If a process works on the run and rows are counted, it
    is read again each time.

    Args:
        path: path of the run.
        counts: whether to count its rows, which takes a second for a million.
    """
    running = is_held(path)
    key = (os.path.abspath(path), counts)
    state = _find_state_of_files(path, running)
    is_cached = key in _LISTED and _LISTED[key][0] == state
    count_may_change = running and counts
    if not is_cached or count_may_change:
        _LISTED[key] = state, _read_checked_run(path, counts, running)
    return _LISTED[key][1]


def _find_state_of_files(path: Path, running: bool) -> tuple[object, ...]:
    """Return a value that changes when the entry of a run in the list may change.

    It has the times and sizes of the files that are read. It has the path as it was
    passed, too, since the entry contains it.

    Args:
        path: path of the run.
        running: whether a process works on the run.
    """
    names = (CONFIG, summary.NAME, store.NAME, f"{store.NAME}-wal")
    return (str(path), running, *(_state(path / name) for name in names))


def _read_checked_run(path: Path, counts: bool, running: bool) -> ListedRun:
    """Read the entry of a run in the list of runs, with a fault if there is any.

    Args:
        path: path of the run.
        counts: whether to count its rows.
        running: whether a process works on the run.
    """
    faults: list[str] = []
    try:
        check_links(path)
        listed = _make_listed_run(path, counts, running, faults)
    # whatever is wrong with one run, the others are listed
    except Exception as error:
        fault = f"{FAULT}: {type(error).__name__}"
        if isinstance(error, AdvsearchError):
            fault = str(error)
        faults.append(fault)
        listed = _make_damaged_run(path)
    return replace(listed, fault=faults[0] if faults else "")


def _make_damaged_run(path: Path) -> ListedRun:
    """Return the entry of a run of which nothing can be read."""
    return ListedRun(
        path.name,
        str(path),
        command="?",
        object="?",
        controls=(),
        rows=0,
        state="damaged",
        outcome="",
        kinds={},
        started=False,
        when=None,
    )


def _state(path: Path) -> object:
    """Return a value that changes when a file is written; None if it is missing or
    empty.
    """
    with suppress(OSError):
        file = os.lstat(path)
        # A reader of the database leaves an empty log, which counts as missing.
        if file.st_size:
            return file.st_ino, file.st_size, file.st_mtime_ns
    return None


def _make_listed_run(
    path: Path, counts: bool, running: bool, faults: list[str]
) -> ListedRun:
    """Read the entry of one run in the list of runs.

    A file that cannot be read is left out, and `faults` gets a sentence about it.

    Args:
        path: path of the run.
        counts: whether to count its rows, which opens the database.
        running: whether a process works on the run.
        faults: list of sentences, to which those about this run are added.
    """
    config = _read_listed_config(path, faults)
    result = _read_listed_result(path, faults)
    kinds = _count_stored_rows(path, faults) if counts else {}
    command = config.get("command") or (result.command if result else "?")
    return ListedRun(
        path.name,
        str(path),
        command=str(command),
        object=_name_listed_objects(config, result),
        controls=_name_listed_controls(config, result),
        rows=sum(kinds.values()),
        state=_find_state(result, running),
        outcome=result.outcome_summary if result else "",
        kinds=kinds,
        started=bool(config),
        when=_find_start_time(path),
    )


def _read_listed_config(path: Path, faults: list[str]) -> dict[str, object]:
    """Return the settings of a run; empty if they cannot be read.

    Args:
        path: path of the run.
        faults: list of sentences, to which one about the file may be added.
    """
    config: dict[str, object] = {}
    # an error is added to the faults, and not raised
    with _collect_faults(faults, path / CONFIG):
        config = read_yaml(path / CONFIG)
    return config


def _read_listed_result(path: Path, faults: list[str]) -> Result | None:
    """Return the result of a run; None if it cannot be read.

    Args:
        path: path of the run.
        faults: list of sentences, to which one about the file may be added.
    """
    result: Result | None = None
    # an error is added to the faults, and not raised
    with _collect_faults(faults, path / summary.NAME):
        result = summary.read_result(path)
    return result


def _count_stored_rows(path: Path, faults: list[str]) -> dict[str, int]:
    """Count the rows of a run by kind; none if they cannot be read.

    Args:
        path: path of the run.
        faults: list of sentences, to which one about the store may be added.
    """
    kinds: dict[str, int] = {}
    with (
        _collect_faults(faults, path / store.NAME),
        store.Store(path / store.NAME, read_only=True) as results,
    ):
        kinds = results.count_by_kind()
    return kinds


def _name_listed_objects(config: Mapping[str, object], result: Result | None) -> str:
    """Return the objects of a run, from its settings or else from its result."""
    object_name = config.get("object") or _get_object_names(result)
    # If the settings could be read, the command has no object, and the name is empty.
    if not object_name and not config:
        return "?"
    return str(object_name)


def _name_listed_controls(
    config: Mapping[str, object], result: Result | None
) -> tuple[str, ...]:
    """Return the names of the controls of a run, from its result or its settings."""
    controls = getattr(result, "controls", ()) or config.get("controls") or ()
    if not isinstance(controls, (list, tuple, dict)):
        controls = ("?",)
    return tuple(map(str, controls))


def _find_state(result: Result | None, running: bool) -> str:
    """Return the state of a run, see `ListedRun`."""
    if running:
        return "running"
    if result is None or result.is_unfinished:
        return "stopped"
    return str(getattr(result, "ending", "done"))


def _get_object_names(result: Result | None) -> str:
    """Return the object or the objects of a result, separated by commas."""
    return getattr(result, "object", None) or ",".join(getattr(result, "objects", ()))


def _find_start_time(path: Path) -> float | None:
    """Return when the settings of a run were written, or else its result."""
    for file in (path / CONFIG, path / summary.NAME):
        if file.exists():
            return file.stat().st_mtime
    return None


@contextmanager
def _collect_faults(faults: list[str], file: Path) -> Iterator[None]:
    """Add errors about a file to the faults, but not that it is missing."""
    try:
        yield
    except AdvsearchError as error:
        if os.path.lexists(file):
            faults.append(str(error))
