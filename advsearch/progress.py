"""Display the progress of an experiment in a terminal, in a notebook or as lines of
text (`progress=True`).
"""

from __future__ import annotations

import sys
import threading
import time
import unicodedata
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import wraps
from typing import IO, Any, Protocol, TypeVar

from advsearch.errors import InputError


class Progress(Protocol):
    """The interface of objects that display progress.

    An experiment calls the methods. They should return at once, and raise nothing.
    """

    def stage(
        self,
        name: str,
        total: int | None = None,
        *,
        hint: str = "",
        at_most: bool = False,
    ) -> None:
        """End the previous stage and begin another; by default this does nothing.

        Args:
            name: name of the stage for the user, such as "searching".
            total: number of its steps; None if they are not counted.
            hint: what the stage consists of, and in backticks the setting that makes it
                shorter, such as "40 pictures; lower `steps`".
            at_most: whether `total` is an upper bound, so that the stage may end
                earlier.
        """
        return

    def advance(self, n: int = 1, **info: float | str) -> None:
        """Report that `n` more steps of the stage are done.

        `info` has values to display with the number of steps, such as ``best=0.31``.
        """
        return

    def message(self, text: str) -> None:
        """Display one sentence for the user, such as a warning."""
        return


class NullProgress(Progress):
    """A `Progress` that displays nothing."""


class Stages:
    """Reports the stages of a run to a `Progress`, and measures how long they take.

    Attributes:
        progress: object that displays the stages.
        seconds: seconds by name of the stage.
    """

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.seconds: dict[str, float] = {}
        self._name = ""
        self._started = time.perf_counter()
        self._stage_started = self._started

    def begin(
        self,
        name: str,
        title: str,
        total: int | None = None,
        *,
        hint: str = "",
        at_most: bool = False,
    ) -> None:
        """End the current stage, and begin another.

        Args:
            name: name under which its seconds are stored. Stages of the same name add
                up.
            title: name of the stage for the user, such as "searching".
            total: number of its steps; None if they are not counted.
            hint: what the stage consists of, and the setting that makes it shorter.
            at_most: whether `total` is an upper bound.
        """
        self.end()
        self._name = name
        self._stage_started = time.perf_counter()
        self.progress.stage(title, total, hint=hint, at_most=at_most)

    def end(self) -> None:
        """End the stage that runs, and add its seconds to those of its name."""
        if self._name:
            self.seconds[self._name] = (
                self.seconds.get(self._name, 0.0)
                + time.perf_counter()
                - self._stage_started
            )
            self._name = ""

    @property
    def total_seconds(self) -> float:
        return time.perf_counter() - self._started


ProgressOption = Progress | bool | None
"""The argument `progress` of functions: True for a display, False for none, None for
one on a terminal only, or an object that displays the progress.
"""


def as_progress(option: ProgressOption) -> Progress:
    """Return the object that displays progress, or a `NullProgress` if the option is
    none.
    """
    return NullProgress() if option is None or isinstance(option, bool) else option


Function = TypeVar("Function", bound=Callable[..., Any])
# Seconds after which a line announces a stage without a terminal. Shorter stages get no
# line.
ANNOUNCE_SECONDS = 2.0
MAX_BARS = 5  # maximum number of bars that are visible at once in a terminal
MIN_UPDATE_SECONDS = 0.2  # minimum seconds between two updates of a notebook's line
# Minimum time between two lines without a terminal: in seconds, and as a fraction of
# the time that the stage has lasted.
LINE_INTERVAL = 5.0
LINE_FRACTION = 0.1


def open_progress(
    requested: ProgressOption, format_names: Callable[[str], str] = str
) -> AbstractContextManager[Progress]:
    """Return an object that displays progress, to be used in a `with` block.

    Args:
        requested: True for a display in a notebook, a terminal or a stream of lines;
            None for bars in a terminal only; False for no display; or an object with
            the methods of `Progress`, which is returned.
        format_names: function that replaces settings in a text, such as "`steps`", by
            the form in which the reader writes them, such as "--steps".

    Raises:
        InputError: `requested` is something else.
    """
    if requested not in (None, True, False):
        if not callable(getattr(requested, "stage", None)):
            raise InputError(
                f"progress: expected True, False, None or a Progress, got {requested!r:.80}"
            )
        return nullcontext(requested)  # type: ignore[arg-type]
    if requested is False:
        return nullcontext(NullProgress())
    return _open_display(format_names, everywhere=bool(requested))


def _open_display(
    format_names: Callable[[str], str], *, everywhere: bool
) -> AbstractContextManager[Progress]:
    """Return bars in a terminal, or another display elsewhere.

    Args:
        format_names: function that replaces settings in a text.
        everywhere: whether to display a line in a notebook, and lines of text on a
            stream, too.
    """
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    is_notebook = getattr(shell, "kernel", None) is not None
    if everywhere and is_notebook:
        return NotebookProgress(format_names)
    stream = sys.stderr  # None in a process without a terminal or a pipe
    if stream is not None and stream.isatty():
        # A `Screen` around the terminal would escape the control characters of bars, so
        # they are written to the stream inside of it.
        terminal = getattr(stream, "stream", stream)
        return BarProgress(terminal, format_names)
    if everywhere and stream is not None:
        return LineProgress(stream, format_names)
    return nullcontext(NullProgress())


def with_progress_option(function: Function) -> Function:
    """Make a function accept True, False and None as its keyword `progress`, too.

    The function itself expects an object that displays progress (`open_progress`).
    """

    @wraps(function)
    def wrapper(*args: Any, progress: ProgressOption = None, **keywords: Any) -> Any:
        with open_progress(progress) as opened_progress:
            return function(*args, progress=opened_progress, **keywords)

    return wrapper  # type: ignore[return-value]


class LineProgress:
    """Displays progress as lines of text on a stream.

    A stage is announced when it has lasted `ANNOUNCE_SECONDS`. After that, a line with
    its progress is printed every `LINE_INTERVAL` seconds or more. Inside of a `with`
    block this also happens if the stage reports no steps. Messages are printed at once.
    """

    def __init__(
        self,
        stream: IO[str],
        format_names: Callable[[str], str] = str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Display progress as lines of text.

        Args:
            stream: stream to which the lines are written.
            format_names: function that replaces settings in a text, such as "`steps`",
                by the form in which the reader writes them, such as "--steps".
            clock: function that returns the time in seconds; tests pass another one.
        """
        self._stream = stream
        self._format_names = format_names
        self._clock = clock
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._name = ""
        self._stage_title = ""
        self._info = ""
        self._total: int | None = None
        self._printed_at: float | None = None  # None: the stage was not announced yet
        self._at_most = False  # whether `_total` is an upper bound
        self._done = 0
        self._stage_started = clock()

    def stage(
        self,
        name: str,
        total: int | None = None,
        *,
        hint: str = "",
        at_most: bool = False,
    ) -> None:
        """Begin another stage; its first line is printed when it has lasted a while."""
        with self._lock:
            self._name = name
            self._total = total
            self._at_most = at_most
            self._stage_title = name + (f": {self._format_names(hint)}" if hint else "")
            self._done = 0
            self._info = ""
            self._stage_started = self._clock()
            self._printed_at = None

    def advance(self, n: int = 1, **info: float | str) -> None:
        with self._lock:
            self._done += n
            self._info = format_info(info) if info else self._info
        self.print_if_due()

    def message(self, text: str) -> None:
        with self._lock:
            self._print(self._format_names(text))

    def print_if_due(self) -> None:
        """Print a line if it is time for one.

        A stage is announced when it has lasted a while; the longer it lasts, the rarer
        are the lines that follow.
        """
        with self._lock:
            now = self._clock()
            elapsed = now - self._stage_started
            printed_at = self._printed_at
            if printed_at is None:  # the stage is not announced yet
                # the name is empty before the first stage
                if self._name and elapsed >= ANNOUNCE_SECONDS:
                    self._printed_at = now
                    self._print(self._stage_title)
                return
            interval = max(LINE_INTERVAL, LINE_FRACTION * elapsed)
            if now - printed_at >= interval:
                self._printed_at = now
                self._print(f"{self._name}: {self._format_state()}")

    def _format_state(self) -> str:
        """Return the state of the stage as text.

        An example is ``12 of at most 40, 10 s, at most 25 s left, best 0.31``.
        """
        done = self._done
        total = self._total
        elapsed = self._clock() - self._stage_started
        texts = []
        if total is not None:
            limit = "at most " if self._at_most else ""
            texts.append(f"{done} of {limit}{total}")
        elif done:
            texts.append(f"{done} done")
        times = _seconds(elapsed) + self._format_time_left(elapsed)
        return ", ".join(filter(None, [*texts, times, self._info]))

    def _format_time_left(self, elapsed: float) -> str:
        """Return the seconds left as the end of a text; "" if they are unknown.

        Args:
            elapsed: seconds since the beginning of the stage.
        """
        done = self._done
        total = self._total
        if not total or not 0 < done < total:
            return ""
        # Most stages with an upper bound end long before it. So the remaining time is
        # only printed after a tenth of the steps.
        is_unsure = self._at_most and 10 * done < total
        if is_unsure:
            return ""
        seconds_left = elapsed / done * (total - done)
        limit = "at most " if self._at_most else ""
        return f", {limit}{_seconds(seconds_left)} left"

    def _print(self, text: str) -> None:
        print(f"advsearch: {text}", file=self._stream, flush=True)

    def __enter__(self) -> LineProgress:
        """Start the thread that prints lines from time to time."""

        def tick_every_second() -> None:
            while not self._ended.wait(1.0):
                self.print_if_due()

        self._thread = threading.Thread(
            target=tick_every_second, name="progress", daemon=True
        )
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


class NotebookProgress(LineProgress):
    """Displays progress as a line below the cell of a notebook.

    The line disappears at the end of the `with` block. Messages remain.
    """

    def __init__(self, format_names: Callable[[str], str] = str) -> None:
        super().__init__(sys.stdout, format_names)
        self._updated = 0.0
        display = sys.modules["IPython"].display.display
        self._handle = display({"text/plain": ""}, raw=True, display_id=True)

    def print_if_due(self) -> None:
        with self._lock:
            if self._clock() - self._updated >= MIN_UPDATE_SECONDS:
                self._updated = self._clock()
                self._handle.update(
                    {"text/plain": f"{self._name}, {self._format_state()}"}, raw=True
                )

    def _print(self, text: str) -> None:
        print(text, flush=True)

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        self._handle.update({"text/plain": ""}, raw=True)


class BarProgress:
    """Displays progress as bars of the package rich in a terminal, one for each stage.

    The bars disappear at the end of the `with` block.
    """

    def __init__(
        self, terminal: IO[str], format_names: Callable[[str], str] = str
    ) -> None:
        """Display progress as bars in a terminal.

        Args:
            terminal: stream of the terminal.
            format_names: function that replaces settings in a text, such as "`steps`",
                by the form in which the reader writes them, such as "--steps".
        """
        # imported late, so that --help answers at once
        from rich import progress as bars
        from rich.console import Console

        columns = (
            bars.TextColumn("{task.description}", markup=False),
            bars.BarColumn(bar_width=12),
            bars.MofNCompleteColumn(separator=" of "),
            bars.TimeElapsedColumn(),
            bars.TimeRemainingColumn(),
            bars.TextColumn("{task.fields[info]}", markup=False),
        )
        self.bars = bars.Progress(
            *columns, console=Console(file=terminal), transient=True
        )
        self._format_names = format_names

    def stage(
        self,
        name: str,
        total: int | None = None,
        *,
        hint: str = "",
        at_most: bool = False,
    ) -> None:
        """End the previous stage and begin another with a new bar.

        The bar of the previous stage becomes full. Only the newest `MAX_BARS` bars stay
        visible.

        Args:
            name: name of the stage for the user, such as "searching".
            total: number of its steps; None if they are not counted.
            hint: what the stage consists of, printed above the bars.
            at_most: whether `total` is an upper bound.
        """
        self._complete_last_bar()
        # Hide all but the last MAX_BARS - 1, since another bar is added below.
        for bar in self.bars.tasks[: -(MAX_BARS - 1)]:
            self.bars.update(bar.id, visible=False)
        if hint:
            self._print(f"{name}: {self._format_names(hint)}", style="dim")
        self.bars.add_task(
            escape_text(name + (", at most" if at_most else "")), total=total, info=""
        )

    def _complete_last_bar(self) -> None:
        """Make the last bar full, whatever its number of steps."""
        if self.bars.tasks:
            last_bar = self.bars.tasks[-1]
            steps = max(last_bar.completed, 1)
            self.bars.update(last_bar.id, total=steps, completed=steps)

    def advance(self, n: int = 1, **info: float | str) -> None:
        """See `Progress.advance`. Before the first stage nothing is displayed."""
        for bar in self.bars.tasks[-1:]:  # the last one, or none
            text = escape_text(format_info(info)) if info else bar.fields["info"]
            self.bars.update(bar.id, advance=n, info=text)

    def message(self, text: str) -> None:
        self._print(self._format_names(text))

    def _print(self, text: str, **look: Any) -> None:
        self.bars.console.print(
            escape_text(text), markup=False, highlight=False, **look
        )

    def __enter__(self) -> BarProgress:
        self.bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bars.stop()


def _seconds(seconds: float) -> str:
    """Return ``25 s`` for times below 99.5 seconds, and ``3 min 5 s`` for longer ones."""
    # late, so that --help answers at once
    from advsearch.report.wording import format_seconds

    return f"{seconds:.0f} s" if seconds < 99.5 else format_seconds(seconds)


def format_info(info: dict[str, float | str]) -> str:
    """Return ``best 0.31, epsilon 0.1``."""
    values = {
        name: f"{value:.3g}" if isinstance(value, float) else value
        for name, value in info.items()
    }
    return ", ".join(f"{name} {value}" for name, value in values.items())


def escape_text(text: str, encoding: str = "utf-8") -> str:
    """Return text with escapes for characters that could control a terminal.

    Names in messages may come from other people. Characters that are not printable are
    escaped, except for line ends and tabs.
    """
    if not text.isascii() or not text.isprintable():
        text = "".join(map(_escape_char, text))
    return text.encode(encoding, "backslashreplace").decode(encoding)


def _escape_char(char: str) -> str:
    """Return a character if it is printable, otherwise Python's escape for it."""
    if char in "\n\t" or char.isprintable() or unicodedata.category(char) == "Zs":
        return char
    code = ord(char)
    if code < 0x100:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
