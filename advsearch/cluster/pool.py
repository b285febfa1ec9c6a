"""Workers as the coordinator sees them: they come and go, take calls and answer them. Dask is one kind of pool."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol


@dataclass(frozen=True)
class Joined:
    """The worker with that address is there."""

    worker: str


@dataclass(frozen=True)
class Left:
    """The worker with that address has gone, because it was told to or for another reason."""

    worker: str
    told: bool = False


@dataclass(frozen=True)
class Ended:
    """The call with that ticket has ended, and has returned the value."""

    ticket: int
    value: Any


@dataclass(frozen=True)
class Dropped:
    """The call with that ticket came to no end, because its worker or the connection went; the reason in words."""

    ticket: int
    reason: str = ""


@dataclass(frozen=True)
class Disconnected:
    """The scheduler has gone, and all workers with it."""


Event = Joined | Left | Ended | Dropped | Disconnected


class Pool(Protocol):
    """A pool of workers, each of which does one call after the other in the order in which it was given them."""

    @property
    def link(self) -> str:
        """Of a page that shows the workers; empty where there is none."""

    @property
    def where(self) -> str:
        """What it is, in a user's words."""

    def submit(self, ticket: int, worker: str, function: Callable[..., Any], *args: Any) -> None:
        """Have a worker call a function of a module; an `Ended` or `Dropped` with this ticket follows."""

    def restart(self, worker: str) -> None:
        """End a worker that does not answer; another may join in its place."""

    def forget(self, ticket: int) -> None:
        """Nothing will be done with the answer of this call."""

    def events(self, seconds: float) -> list[Event]:
        """Return what has happened since the last time; wait so long at most where nothing has."""

    def reconnect(self) -> None:
        """Find the scheduler again, or start another.

        Raises:
            ClusterError: it did not come back.
        """

    def close(self) -> None:
        """Let the workers go, those that were started for this pool for ever."""
