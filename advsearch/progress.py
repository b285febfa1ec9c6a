"""What the API tells whoever watches a run: the stage, how far it is, and messages. Standard library only."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """A watcher of a run. Its methods return at once and never raise because of what they are shown."""

    def stage(self, name: str, total: int | None = None) -> None:
        """End the stage before and begin `name` (``"search"``, say) of `total` steps; None when that isn't known."""

    def advance(self, n: int = 1, **info: float | str) -> None:
        """Report `n` more steps of the stage done. `info` is shown beside the bar: ``best=0.31``."""

    def message(self, text: str) -> None:
        """Show one sentence that a person should read: a warning, say."""


class NullProgress:
    """The watcher that looks away: what a Python call uses when it is given none."""

    def stage(self, name: str, total: int | None = None) -> None:
        """See `Progress.stage`."""

    def advance(self, n: int = 1, **info: float | str) -> None:
        """See `Progress.advance`."""

    def message(self, text: str) -> None:
        """See `Progress.message`."""
