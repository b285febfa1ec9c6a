"""What the API tells whoever watches a run: the stage, how far it is, and messages. Standard library only."""

from __future__ import annotations

from typing import Protocol


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
"""Who watches, as a caller says it: True is a bar, False nobody, None a bar on a terminal (`watching`)."""


def watcher(watched: Watched) -> Progress:
    """Return who is told how far it is: the watcher that was given, and nobody where none was."""
    return NullProgress() if watched is None or isinstance(watched, bool) else watched
