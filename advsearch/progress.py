"""How far a question is: what the API tells whoever watches, in a terminal or a notebook (`progress=True`)."""

from __future__ import annotations

import html
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import IO, TYPE_CHECKING, Any, Protocol, TypeVar

from advsearch.errors import InputError

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID


class Progress(Protocol):
    """A watcher of a run. Its methods return at once and never raise because of what they are shown."""

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        """End the stage before and begin another.

        Args:
            name: what is being done, in a user's words: "searching", say.
            total: steps that it has; None where nothing counts them.
            hint: what it consists of, and in backticks the setting that shortens it: "40 pictures; lower `steps`".
            at_most: `total` is an upper bound: the stage may end before.
        """

    def advance(self, n: int = 1, **info: float | str) -> None:
        """Report `n` more steps of the stage done. `info` is shown beside the bar: ``best=0.31``."""

    def message(self, text: str) -> None:
        """Show one sentence that a person should read: a warning, say."""


class NullProgress:
    """The watcher that looks away: what a Python call uses when it is given none."""

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        """See `Progress.stage`."""

    def advance(self, n: int = 1, **info: float | str) -> None:
        """See `Progress.advance`."""

    def message(self, text: str) -> None:
        """See `Progress.message`."""


Watched = Progress | bool | None
"""Who watches, as a caller says it: True is a bar, False nobody, None a bar on a terminal."""


def watcher(watched: Watched) -> Progress:
    """Return who is told how far it is: the watcher that was given, and nobody where none was."""
    return NullProgress() if watched is None or isinstance(watched, bool) else watched


Function = TypeVar("Function", bound=Callable[..., Any])

PATIENCE = 2.0
"""Seconds after which a stage is announced where there is no terminal; a shorter one is not worth a line."""

LINE_INTERVAL, LINE_SHARE = 5.0, 0.1
"""Seconds between two lines where there is no terminal, and the share of a stage's time so far that they are at least.
"""

MOST_BARS = 5
"""Stages that a terminal shows at once."""

UPDATE = 0.2
"""Least seconds between two pictures of a notebook's bar."""


@contextmanager
def watched(asked: Watched) -> Iterator[Progress]:
    """Yield the progress that a call asked for, see `Watched`. Raises InputError where it is something else."""
    if asked not in (None, True, False):
        if not callable(getattr(asked, "stage", None)):
            raise InputError(f"progress: expected True, False, None or a Progress, got {asked!r:.80}")
        yield asked  # type: ignore[misc]
    elif asked and in_notebook():
        with NotebookProgress() as shown:
            yield shown
    elif asked is not False and sys.stderr is not None and sys.stderr.isatty():
        with bars(sys.stderr) as drawn:
            yield drawn
    elif asked and sys.stderr is not None:
        with lines(sys.stderr) as told:
            yield told
    else:
        yield NullProgress()


def shows_progress(function: Function) -> Function:
    """Let a function with a keyword `progress` be called with what `watched` takes."""

    @wraps(function)
    def shown(*args: Any, progress: Watched = None, **named: Any) -> Any:
        with watched(progress) as watcher:
            return function(*args, progress=watcher, **named)

    return shown  # type: ignore[return-value]


def in_notebook() -> bool:
    """Whether a notebook asks, which shows HTML."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return getattr(shell, "kernel", None) is not None


class LineProgress:
    """Plain lines on a stream: what a stage is once it has lasted `PATIENCE` seconds, then how far it is every
    `LINE_INTERVAL` seconds or more; messages at once. `written` is as for `BarProgress`."""

    def __init__(
        self, stream: IO[str], clock: Callable[[], float] = time.monotonic, written: Callable[[str], str] = str
    ) -> None:
        self._stream, self._clock, self._written, self._lock = stream, clock, written, threading.Lock()
        self._name, self._hint, self._info = "", "", ""
        self._total: int | None = None
        self._at_most = self._announced = False
        self._done, self._began, self._printed = 0, clock(), clock()

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        with self._lock:
            self._name, self._total, self._hint, self._at_most = name, total, self._written(hint), at_most
            self._done, self._began, self._announced, self._info = 0, self._clock(), False, ""

    def advance(self, n: int = 1, **info: float | str) -> None:
        with self._lock:
            self._done += n
            self._info = info_text(info) if info else self._info
        self.tick()

    def message(self, text: str) -> None:
        with self._lock:
            self._print(self._written(text))

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
    """One bar for each stage, in bars of rich that are started, with the time that it took and what is left; the last
    `MOST_BARS` are shown. `written` writes the settings that a text names as whoever reads it does."""

    def __init__(self, bars: Bars, written: Callable[[str], str] = str) -> None:
        self._bars, self._written = bars, written
        self._task: TaskID | None = None
        self._shown = ""
        self._hinted: set[str] = set()

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        if self._task is not None:
            done = next(task.completed for task in self._bars.tasks if task.id == self._task)
            self._bars.update(self._task, total=max(done, 1), completed=max(done, 1), at_most=False)
            self._bars.stop_task(self._task)
        if hint and hint not in self._hinted:
            self._hinted.add(hint)
            self._bars.console.print(
                _escaped(f"{name}: {self._written(hint)}"), style="dim", markup=False, highlight=False
            )
        self._shown = ""
        self._task = self._bars.add_task(_escaped(name), total=total, info="", at_most=at_most)
        for task in self._bars.tasks[:-MOST_BARS]:
            self._bars.update(task.id, visible=False)

    def advance(self, n: int = 1, **info: float | str) -> None:
        if self._task is not None:
            self._shown = _escaped(info_text(info)) if info else self._shown
            self._bars.update(self._task, advance=n, info=self._shown)

    def message(self, text: str) -> None:
        self._bars.console.print(_escaped(self._written(text)), markup=False, highlight=False)


class NotebookProgress:
    """One bar below the cell of a notebook: the stage, how far it is, and messages below it.

    In a `with` block the bar goes at the end, and messages stay.
    """

    def __init__(self) -> None:
        self._name, self._info, self._messages = "", "", list[str]()
        self._total: int | None = None
        self._at_most, self._done = False, 0
        self._begun = self._drawn = time.monotonic()
        self._ended = False
        self._handle = sys.modules["IPython"].display.display(self, display_id=True)

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        self._name, self._total, self._at_most = name, total, at_most
        self._done, self._info, self._begun = 0, "", time.monotonic()
        self._draw()

    def advance(self, n: int = 1, **info: float | str) -> None:
        self._done += n
        self._info = info_text(info) if info else self._info
        if time.monotonic() - self._drawn >= UPDATE:
            self._draw()

    def message(self, text: str) -> None:
        self._messages.append(text)
        self._draw()

    def __enter__(self) -> NotebookProgress:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended = True
        self._draw()

    def _draw(self) -> None:
        self._drawn = time.monotonic()
        self._handle.update(self)

    def _repr_html_(self) -> str:
        notes = "".join(f"<div>{html.escape(text)}</div>" for text in self._messages)
        if self._ended:
            return notes
        known = f' value="{self._done}" max="{self._total}"' if self._total else ""
        return f"<div>{html.escape(self._text)} <progress{known}></progress></div>{notes}"

    def __repr__(self) -> str:
        return "\n".join([*([] if self._ended else [self._text]), *self._messages])

    @property
    def _text(self) -> str:
        count = count_text(self._done, self._total, self._at_most)
        times = times_text(time.monotonic() - self._begun, self._done, self._total, self._at_most)
        return ", ".join(part for part in (self._name, count, times, self._info) if part)


def count_text(done: float, total: float | None, at_most: bool) -> str:
    """Return ``12 of 40`` or ``12 of at most 40``; nothing where nothing is counted."""
    if total is None:
        return f"{done:.0f} done" if done else ""
    return f"{done:.0f} of {'at most ' if at_most else ''}{total:.0f}"


def times_text(elapsed: float, done: float, total: float | None, at_most: bool) -> str:
    """Return ``10 s, 25 s left``: the time so far, and what is left if the other steps take as long as those before.

    Below a tenth of an upper bound it leaves that out: most such stages end long before.
    """
    if not total or not done or done >= total or (at_most and 10 * done < total):
        return _seconds(elapsed)
    left = elapsed / done * (total - done)
    return f"{_seconds(elapsed)}, {'at most ' if at_most else ''}{_seconds(left)} left"


def _seconds(seconds: float) -> str:
    # late, so that --help answers at once
    from advsearch.report.wording import seconds_text

    return f"{seconds:.0f} s" if seconds < 99.5 else seconds_text(seconds)


@contextmanager
def lines(stream: IO[str], written: Callable[[str], str] = str) -> Iterator[LineProgress]:
    """Print lines now and then, also of a stage that is silent for long; see `LineProgress`."""
    progress, ended = LineProgress(stream, written=written), threading.Event()

    def call() -> None:
        while not ended.wait(1.0):
            progress.tick()

    thread = threading.Thread(target=call, name="progress", daemon=True)
    thread.start()
    try:
        yield progress
    finally:
        ended.set()
        thread.join()


@contextmanager
def bars(terminal: IO[str], written: Callable[[str], str] = str) -> Iterator[BarProgress]:
    """Draw bars on a terminal, which are gone behind the block; see `BarProgress`."""
    # late, so that --help answers at once
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
    with Bars(*columns, console=Console(file=terminal), transient=True) as drawn:
        yield BarProgress(drawn, written)


def info_text(info: dict[str, float | str]) -> str:
    """Return ``best 0.31, epsilon 0.1``."""
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in info.items()
    )


def _escaped(text: str) -> str:
    """A text with what would steer a terminal written as an escape: names in it are others'."""
    signs = (one if one.isprintable() or one in "\n\t" else one.encode("unicode_escape").decode() for one in text)
    return "".join(signs)
