"""A pool of workers that are only simulated, with a clock of its own: it runs as fast as the coordinator can."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

from advsearch.cluster import Disconnected, Ended, Event, Joined, Left, Work
from advsearch.cluster.coordinator import Coordinator
from advsearch.cluster.worker import Carried, Failure, Files, Ready, prepare
from advsearch.errors import ClusterError

HERE = {"processor": "here"}


@dataclass
class Simulated:
    """What `advsearch.cluster.Pool` asks for.

    Attributes:
        call: what a worker does with a range.
        seconds: that a number takes, by its number.
        load: seconds until a worker is ready.
        again: seconds after which another worker stands in the place of one that died; None for never.
        lag: seconds until an answer arrives; a worker that dies takes those with it that have not.
        kill: numbers of which a worker dies, at once.
        hang: numbers that a worker never ends.
        answers: what a worker says when it gets ready, by its name; else it is ready, and like this machine.
        returns: whether a scheduler that has gone comes back.
        now: the time.
        link: of no page.
        where: how it is called.
        given: batches that were given to a worker, in order.
        most: calls that were under way at once.
    """

    call: Callable[[Any], Any] = list
    seconds: Callable[[Any], float] = lambda number: 0.5
    load: float = 5.0
    lag: float = 0.0
    again: float | None = 1.0
    kill: Collection[int] = ()
    hang: Collection[int] = ()
    answers: dict[str, Any] = field(default_factory=dict)
    returns: bool = True
    now: float = 0.0
    link: str = ""
    where: str = "simulated"
    given: list[Any] = field(default_factory=list)
    most: int = 0
    _events: list[tuple[float, int, Any]] = field(default_factory=list)
    _free_at: dict[str, float] = field(default_factory=dict)
    _at: dict[int, str] = field(default_factory=dict)
    _made: int = 0
    _order: int = 0

    def clock(self) -> float:
        return self.now

    def add(self, count: int = 1, after: float = 0.0) -> None:
        for _ in range(count):
            self._later(after, Joined(f"w{self._made}"))
            self._made += 1

    def _later(self, seconds: float, event: Event | Callable[[], None]) -> None:
        self._order += 1
        heapq.heappush(self._events, (self.now + seconds, self._order, event))

    def at(self, time: float, action: Callable[[], None]) -> None:
        """Do something to the workers at a time."""
        self._later(time - self.now, action)

    @property
    def alive(self) -> list[str]:
        return list(self._free_at)

    def end(self, worker: str, *, told: bool = False) -> None:
        """A worker dies; what it had gets no answer."""
        if self._free_at.pop(worker, None) is None:
            return
        self._at = {ticket: one for ticket, one in self._at.items() if one != worker}
        self._later(0.0, Left(worker, told))
        if self.again is not None:
            self.add(after=self.again)

    def lose_scheduler(self) -> None:
        workers, self._at = len(self._free_at), {}
        self._free_at.clear()
        self._later(0.0, Disconnected())
        self.again, again = None, self.again
        self.add(workers, after=3.0)
        self.again = again

    # ---- what the coordinator calls ---------------------------------------------------------------------------------

    def submit(self, ticket: int, worker: str, function: Callable[..., Any], *args: Any) -> None:
        if worker not in self._free_at:
            return
        self._at[ticket] = worker
        self.most = max(self.most, len(self._at))
        begin = max(self.now, self._free_at[worker])
        if function is prepare:
            told = self.answers.get(worker, Ready(HERE, self.load))
            self._free_at[worker] = begin + self.load
            self._later(begin + self.load - self.now, self._answer(ticket, told))
            return
        _, items = args
        self.given.append(items)
        seconds = sum(map(self.seconds, items))
        self._free_at[worker] = begin + seconds
        if any(number in self.kill for number in items):
            self._later(begin - self.now, lambda: self.end(worker))
        elif any(number in self.hang for number in items):
            self._free_at[worker] = float("inf")
        elif begin + seconds < float("inf"):
            until = begin + seconds + self.lag - self.now
            self._later(until, self._answer(ticket, lambda: Carried(self.call(items), seconds)))

    def _answer(self, ticket: int, value: Any) -> Any:
        def answer() -> Event | None:
            if self._at.pop(ticket, None) is None:
                return None
            return Ended(ticket, value() if callable(value) else value)

        return answer

    def forget(self, ticket: int) -> None:
        self._at.pop(ticket, None)

    def restart(self, worker: str) -> None:
        self.end(worker)

    def events(self, seconds: float) -> list[Event]:
        found: list[Event] = []
        until = self.now + seconds
        while self._events and not found and self._events[0][0] <= until:
            self.now, _, event = heapq.heappop(self._events)
            made = event() if callable(event) else event
            if isinstance(made, Joined):
                self._free_at[made.worker] = self.now
            if made is not None:
                found.append(made)
        if not found:
            self.now = until
        return found

    def reconnect(self) -> None:
        if not self.returns:
            raise ClusterError("simulated: there is no scheduler that answers; go on with advsearch resume")

    def close(self) -> None:
        pass


def coordinator(pool: Simulated, tell: Callable[[str], None] = lambda text: None) -> Coordinator:
    """A coordinator of a simulated pool."""
    work = Work("nowhere:nothing", {})
    return Coordinator(pool, work, "key", Files({}, {}), "1", HERE, tell, pool.clock)


__all__ = ["HERE", "Failure", "Simulated", "coordinator"]
