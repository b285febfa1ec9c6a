"""How far a run is, on standard error: bars on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, TextIO

from advsearch.cli.output import output_kept_clean
from advsearch.progress import NullProgress, Progress

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID

LINE_INTERVAL = 5.0
"""Seconds between two lines where there is no terminal."""


@contextmanager
def at_work(*, as_json: bool, quiet: bool) -> Iterator[Progress]:
    """Watch a command's work; where JSON is to be printed, keep everything else off standard output meanwhile."""
    with output_kept_clean() if as_json else nullcontext(), watching(quiet=quiet) as progress:
        yield progress


@contextmanager
def watching(*, quiet: bool = False) -> Iterator[Progress]:
    """Yield the progress that suits standard error: none when `quiet`, bars on a terminal, lines elsewhere."""
    if quiet:
        yield NullProgress()
    elif sys.stderr.isatty():
        with _bars() as bars:
            yield BarProgress(bars)
    else:
        yield LineProgress(sys.stderr)


class LineProgress:
    """Plain lines, at most one every `LINE_INTERVAL` seconds; messages at once.

    Args:
        stream: where they go.
        clock: seconds, growing.
    """

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream = stream
        self._clock = clock
        self._printed = clock()
        self._name, self._total, self._done, self._began = "", 0, 0, self._printed

    def stage(self, name: str, total: int | None = None) -> None:
        """See `Progress.stage`."""
        self._name, self._total, self._done, self._began = name, total or 0, 0, self._clock()

    def advance(self, n: int = 1, **info: float | str) -> None:
        """See `Progress.advance`."""
        self._done += n
        now = self._clock()
        if now - self._printed >= LINE_INTERVAL:
            self._printed = now
            self._print(", ".join([self._count(), *self._left(now), *([_info(info)] if info else [])]))

    def message(self, text: str) -> None:
        """See `Progress.message`."""
        self._print(text)

    def _count(self) -> str:
        return f"{self._name}: {self._done}" + (f" of {self._total}" if self._total else "")

    def _left(self, now: float) -> list[str]:
        if not self._total or not self._done:
            return []
        left = (now - self._began) / self._done * max(self._total - self._done, 0)
        return [f"{left:.0f} s left"]

    def _print(self, text: str) -> None:
        print(f"advsearch: {text}", file=self._stream, flush=True)


class BarProgress:
    """One bar for each stage, with time left.

    Args:
        bars: of rich, started.
    """

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._task: TaskID | None = None
        self._shown = ""

    def stage(self, name: str, total: int | None = None) -> None:
        """See `Progress.stage`."""
        self._end_stage()
        self._shown = ""
        self._task = self._bars.add_task(name, total=total, info="")

    def advance(self, n: int = 1, **info: float | str) -> None:
        """See `Progress.advance`."""
        if self._task is not None:
            self._shown = _info(info) if info else self._shown
            self._bars.update(self._task, advance=n, info=self._shown)

    def message(self, text: str) -> None:
        """See `Progress.message`."""
        self._bars.console.print(text, markup=False, highlight=False)

    def _end_stage(self) -> None:
        """Fill the bar of a stage whose length was unknown, or that ended early, and stop its clock."""
        if self._task is not None:
            done = next(task.completed for task in self._bars.tasks if task.id == self._task)
            self._bars.update(self._task, total=max(done, 1), completed=max(done, 1))
            self._bars.stop_task(self._task)


@contextmanager
def _bars() -> Iterator[Bars]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    time_left = TimeRemainingColumn(compact=True, elapsed_when_finished=True)
    texts = TextColumn("{task.description}", markup=False), TextColumn("{task.fields[info]}", markup=False)
    columns = (texts[0], BarColumn(bar_width=30), MofNCompleteColumn(), time_left, texts[1])
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
        yield bars


def _info(info: dict[str, float | str]) -> str:
    """Return ``best 0.31, epsilon 0.1``."""
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in info.items()
    )
