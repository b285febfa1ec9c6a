"""How far a run is, on standard error: bars on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, TextIO

from advsearch.cli.flags import with_flags
from advsearch.cli.output import output_kept_clean
from advsearch.cli.screen import printable, raw
from advsearch.interrupts import INTERRUPTS
from advsearch.progress import NullProgress, Progress

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID

PATIENCE = 2.0
"""Seconds after which a stage is announced where there is no terminal; a shorter one is not worth a line."""

LINE_INTERVAL, LINE_SHARE = 5.0, 0.1
"""Seconds between two lines where there is no terminal, and the share of a stage's time so far that they are at least.
"""

MOST_BARS = 5
"""Stages that a terminal shows at once."""

LOADING_STAGES = 2
"""The first stages of a command: modules are imported, then a scene and a model are loaded, which imports more."""


@contextmanager
def at_work(*, as_json: bool, quiet: bool) -> Iterator[Progress]:
    """Watch a command's work; where JSON is to be printed, keep everything else off standard output meanwhile."""
    with output_kept_clean() if as_json else nullcontext(), watching(quiet=quiet) as watcher:
        progress = LoadingProgress(watcher)
        progress.stage("starting: PyTorch and Mitsuba are loaded")
        yield progress
        progress.end()


@contextmanager
def watching(*, quiet: bool = False) -> Iterator[Progress]:
    """Yield the progress that suits standard error: none when `quiet`, bars on a terminal, lines elsewhere."""
    if quiet:
        yield NullProgress()
    elif sys.stderr.isatty():
        with _bars() as bars:
            yield BarProgress(bars)
    else:
        lines = LineProgress(sys.stderr)
        with _called_every_second(lines.tick):
            yield lines


class LoadingProgress:
    """A watcher that raises an interrupt which came while something was loaded, when that stage ends.

    Modules that are being imported and native code make other errors of an interrupt, or none. After `LOADING_STAGES`
    all that catches one is ours and answers it.

    Args:
        progress: is told everything.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._begun = 0

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        """See `Progress.stage`.

        Raises:
            KeyboardInterrupt: one came while something was loaded.
        """
        if self._begun <= LOADING_STAGES:
            INTERRUPTS.check()
        self._begun += 1
        self._progress.stage(name, total, hint=hint, at_most=at_most)

    def advance(self, n: int = 1, **info: float | str) -> None:
        """See `Progress.advance`."""
        self._progress.advance(n, **info)

    def message(self, text: str) -> None:
        """See `Progress.message`."""
        self._progress.message(text)

    def end(self) -> None:
        """End the work.

        Raises:
            KeyboardInterrupt: nothing but imports was there, and one came meanwhile.
        """
        if self._begun < LOADING_STAGES:
            INTERRUPTS.check()


class LineProgress:
    """Plain lines: what a stage is once it has lasted `PATIENCE` seconds, then how far it is every `LINE_INTERVAL`
    seconds or more; messages at once.

    Args:
        stream: where they go.
        clock: seconds, growing.
    """

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream, self._clock, self._lock = stream, clock, threading.Lock()
        self._name, self._hint, self._info = "", "", ""
        self._total: int | None = None
        self._at_most = self._announced = False
        self._done, self._began, self._printed = 0, clock(), clock()

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        """See `Progress.stage`."""
        with self._lock:
            self._name, self._total, self._hint, self._at_most = name, total, with_flags(hint), at_most
            self._done, self._began, self._announced, self._info = 0, self._clock(), False, ""

    def advance(self, n: int = 1, **info: float | str) -> None:
        """See `Progress.advance`."""
        with self._lock:
            self._done += n
            self._info = _info(info) if info else self._info
        self.tick()

    def message(self, text: str) -> None:
        """See `Progress.message`."""
        with self._lock:
            self._print(with_flags(text))

    def tick(self) -> None:
        """Print a line if it is time for one."""
        with self._lock:
            now = self._clock()
            if self._name and not self._announced and now - self._began >= PATIENCE:
                self._announced, self._printed = True, now
                self._print(self._name + (f": {self._hint}" if self._hint else ""))
            elif self._announced and now - self._printed >= max(LINE_INTERVAL, LINE_SHARE * (now - self._began)):
                self._printed = now
                count = count_text(self._done, self._total, self._at_most)
                times = times_text(now - self._began, self._done, self._total, self._at_most)
                self._print(f"{self._name}: " + ", ".join(part for part in (count, times, self._info) if part))

    def _print(self, text: str) -> None:
        print(f"advsearch: {text}", file=self._stream, flush=True)


class BarProgress:
    """One bar for each stage, with the time that it took and what is left; the last `MOST_BARS` are shown.

    Args:
        bars: of rich, started.
    """

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._task: TaskID | None = None
        self._shown = ""
        self._hinted: set[str] = set()

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        """See `Progress.stage`."""
        self._end_stage()
        if hint and hint not in self._hinted:
            self._hinted.add(hint)
            self._bars.console.print(
                printable(f"{name}: {with_flags(hint)}"), style="dim", markup=False, highlight=False
            )
        self._shown = ""
        self._task = self._bars.add_task(printable(name), total=total, info="", at_most=at_most)
        for task in self._bars.tasks[:-MOST_BARS]:
            self._bars.update(task.id, visible=False)

    def advance(self, n: int = 1, **info: float | str) -> None:
        """See `Progress.advance`."""
        if self._task is not None:
            self._shown = printable(_info(info)) if info else self._shown
            self._bars.update(self._task, advance=n, info=self._shown)

    def message(self, text: str) -> None:
        """See `Progress.message`."""
        self._bars.console.print(printable(with_flags(text)), markup=False, highlight=False)

    def _end_stage(self) -> None:
        """Fill the bar of a stage whose length was unknown, or that ended early, and stop its clock."""
        if self._task is not None:
            done = next(task.completed for task in self._bars.tasks if task.id == self._task)
            self._bars.update(self._task, total=max(done, 1), completed=max(done, 1), at_most=False)
            self._bars.stop_task(self._task)


def count_text(done: float, total: float | None, at_most: bool) -> str:
    """Return ``12 of 40`` or ``12 of at most 40``; nothing where nothing is counted."""
    if total is None:
        return f"{done:.0f} done" if done else ""
    return f"{done:.0f} of {'at most ' if at_most else ''}{total:.0f}"


def times_text(elapsed: float, done: float, total: float | None, at_most: bool) -> str:
    """Return ``10 s, 25 s left``: the time so far, and what is left if the other steps take as long as those before."""
    if not total or not done or done >= total:
        return _seconds(elapsed)
    left = elapsed / done * (total - done)
    return f"{_seconds(elapsed)}, {'at most ' if at_most else ''}{_seconds(left)} left"


def _seconds(seconds: float) -> str:
    from advsearch.report.wording import seconds_text

    return f"{seconds:.0f} s" if seconds < 99.5 else seconds_text(seconds)


@contextmanager
def _called_every_second(function: Callable[[], None]) -> Iterator[None]:
    """Call a function every second in a thread of its own inside the block: a stage may be silent for long."""
    ended = threading.Event()

    def call() -> None:
        while not ended.wait(1.0):
            function()

    thread = threading.Thread(target=call, name="progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def _bars() -> Iterator[Bars]:
    from rich.console import Console
    from rich.progress import BarColumn, ProgressColumn, Task, TextColumn
    from rich.progress import Progress as Bars
    from rich.text import Text

    class Counted(ProgressColumn):
        """How many steps are done, and the times."""

        def render(self, task: Task) -> Text:
            at_most, elapsed = bool(task.fields["at_most"]), task.finished_time or task.elapsed or 0.0
            count = count_text(task.completed, task.total, at_most)
            times = times_text(elapsed, task.completed, task.total, at_most)
            return Text(", ".join(part for part in (count, times, task.fields["info"]) if part))

    columns = (TextColumn("{task.description}", markup=False), BarColumn(bar_width=12), Counted())
    with Bars(*columns, console=Console(file=raw(sys.stderr)), transient=True) as bars:
        yield bars


def _info(info: dict[str, float | str]) -> str:
    """Return ``best 0.31, epsilon 0.1``."""
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in info.items()
    )
