"""Ctrl-C, counted: code of others that swallows an interrupt does not lose it."""

from __future__ import annotations

from advsearch.interrupts import INTERRUPTS
from advsearch.progress import Progress

LOADING_STAGES = 2
"""The first stages of a command: modules are imported, then a scene and a model are loaded, which imports more."""


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
