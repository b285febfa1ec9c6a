"""How far a run is, on standard error: bars on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from advsearch.cli.flags import with_flags
from advsearch.cli.output import output_kept_clean
from advsearch.cli.screen import raw
from advsearch.interrupts import INTERRUPTS
from advsearch.progress import NullProgress, Progress
from advsearch.watching import bars, lines

LOADING_STAGES = 2
"""The first stages of a command: modules are imported, then a scene and a model are loaded, which imports more."""


@contextmanager
def at_work(*, as_json: bool, quiet: bool) -> Iterator[Progress]:
    """Watch a command's work; where JSON is to be printed, keep everything else off standard output meanwhile."""
    with output_kept_clean() if as_json else nullcontext(), watch_progress(quiet=quiet) as watcher:
        progress = LoadingProgress(watcher)
        progress.stage("starting: loading PyTorch and Mitsuba")
        yield progress
        progress.end()


@contextmanager
def watch_progress(*, quiet: bool = False) -> Iterator[Progress]:
    """Yield the progress that suits standard error: none when `quiet`, bars on a terminal, lines elsewhere."""
    if quiet:
        yield NullProgress()
    elif sys.stderr.isatty():
        with bars(raw(sys.stderr), with_flags) as drawn:
            yield drawn
    else:
        with lines(sys.stderr, with_flags) as told:
            yield told


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
        self._progress.advance(n, **info)

    def message(self, text: str) -> None:
        self._progress.message(text)

    def end(self) -> None:
        """End the work.

        Raises:
            KeyboardInterrupt: nothing but imports was there, and one came meanwhile.
        """
        if self._begun < LOADING_STAGES:
            INTERRUPTS.check()
