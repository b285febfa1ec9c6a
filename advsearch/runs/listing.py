"""The runs in a folder at a glance."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from advsearch.errors import AdvsearchError
from advsearch.runs import files, store, summary
from advsearch.runs.directory import CONFIG, is_run
from advsearch.runs.results.base import Result
from advsearch.settings import read_yaml


@dataclass(frozen=True)
class Listed:
    """One run.

    Attributes:
        command: that made it.
        object: what the model should recognise; empty where a command has none.
        controls: what could change.
        state: ``"running"`` where a process works on it, ``"stopped"`` where it can be resumed, else its ending.
        answer: what came out, in a few words.
        kinds: how many rows there are of each kind.
        begun: whether its settings are there, without which it cannot be resumed.
        when: it was begun, seconds since 1970 (UTC); None where that is not known.
    """

    name: str
    path: str
    command: str
    object: str
    controls: tuple[str, ...]
    rows: int
    state: str
    answer: str
    kinds: Mapping[str, int]
    begun: bool
    when: float | None


def listed_runs(folder: Path) -> list[Listed]:
    """Return the runs in a folder, by name; what cannot be read is shown as far as it can."""
    if not folder.is_dir():
        return []
    return [listed_run(path) for path in sorted(folder.iterdir()) if path.is_dir() and is_run(path)]


def finished(path: Path) -> bool:
    """Whether a run has come to its end; one that was interrupted, or killed while its report was written, has not."""
    if not (path / summary.NAME).is_file() or summary.read_result(path).goes_on:
        return False
    return not files.is_results_database(path / store.NAME) or not can_resume(path)


def can_resume(path: Path) -> bool:
    """Whether a run keeps what a search needs to go on."""
    with store.Store(path / store.NAME, read_only=True) as results:
        return results.goes_on


def listed_run(path: Path, *, counts: bool = True) -> Listed:
    """Return the run in a folder; what cannot be read is shown as far as it can. To count rows takes a second for a
    million."""
    config: dict[str, object] = {}
    result: Result | None = None
    kinds: dict[str, int] = {}
    with suppress(AdvsearchError):
        config = read_yaml(path / CONFIG)
    with suppress(AdvsearchError):
        result = summary.read_result(path)
    if counts:
        with suppress(AdvsearchError), store.Store(path / store.NAME, read_only=True) as results:
            kinds = results.counts()
    object_name = getattr(result, "object", None) or ",".join(getattr(result, "objects", ()))
    controls = getattr(result, "controls", ()) or config.get("controls") or ()
    ending = "stopped" if result is None or result.goes_on else str(getattr(result, "ending", "done"))
    return Listed(
        name=path.name,
        path=str(path),
        command=str(config.get("command") or (result.command if result else "?")),
        object=str(config.get("object") or object_name or ("" if config else "?")),
        controls=tuple(map(str, controls)) if isinstance(controls, (list, tuple, dict)) else ("?",),
        rows=sum(kinds.values()),
        state="running" if files.is_held(path) else ending,
        answer=result.brief if result else "",
        kinds=kinds,
        begun=bool(config),
        when=_when(path),
    )


def _when(path: Path) -> float | None:
    for name in (CONFIG, summary.NAME):
        with suppress(OSError):
            return (path / name).stat().st_mtime
    return None
