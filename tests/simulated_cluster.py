"""A pool of workers that are only simulated, with a clock of its own: it runs as fast as the coordinator can."""

from __future__ import annotations

import heapq
import queue
from collections import deque
from collections.abc import Callable, Collection
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from advsearch.cluster import SchedulerGoneError, Work
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
        gone: whether the scheduler has gone, and nobody has connected again.
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
    gone: bool = False
    _events: list[tuple[float, int, Callable[[], None]]] = field(default_factory=list)
    _free_at: dict[str, float] = field(default_factory=dict)
    _at: dict[Future[Any], str] = field(default_factory=dict)
    _ended: deque[Future[Any]] = field(default_factory=deque)
    _made: int = 0
    _order: int = 0

    @property
    def ended(self) -> Any:
        """The queue of a pool, whose time is simulated: `put`, `get` and `get_nowait` below."""
        return self

    def clock(self) -> float:
        return self.now

    def add(self, count: int = 1, after: float = 0.0) -> None:
        for _ in range(count):
            self._later(after, lambda name=f"w{self._made}": self._free_at.setdefault(name, self.now))  # type: ignore[misc]
            self._made += 1

    def _later(self, seconds: float, action: Callable[[], object]) -> None:
        self._order += 1
        heapq.heappush(self._events, (self.now + seconds, self._order, action))  # type: ignore[misc]

    def at(self, time: float, action: Callable[[], object]) -> None:
        """Do something to the workers at a time."""
        self._later(time - self.now, action)

    @property
    def alive(self) -> list[str]:
        return list(self._free_at)

    def end(self, worker: str) -> None:
        """A worker dies; what it had gets no answer."""
        if self._free_at.pop(worker, None) is None:
            return
        self._at = {future: one for future, one in self._at.items() if one != worker}
        if self.again is not None:
            self.add(after=self.again)

    def lose_scheduler(self) -> None:
        self.add(len(self._free_at), after=3.0)
        self._free_at.clear()
        self._at.clear()
        self.gone = True

    # ---- what the coordinator calls ---------------------------------------------------------------------------------

    def workers(self) -> Collection[str]:
        if self.gone:
            raise SchedulerGoneError
        return list(self._free_at)

    def submit(self, worker: str, function: Callable[..., Any], *args: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if worker not in self._free_at:
            return future
        self._at[future] = worker
        self.most = max(self.most, len(self._at))
        begin = max(self.now, self._free_at[worker])
        if function is prepare:
            told = self.answers.get(worker, Ready(HERE, self.load))
            self._free_at[worker] = begin + self.load
            self._answer(future, begin + self.load - self.now, told)
            return future
        _, items = args
        self.given.append(items)
        seconds = sum(map(self.seconds, items))
        self._free_at[worker] = begin + seconds
        if any(number in self.kill for number in items):
            self._later(begin - self.now, lambda: self.end(worker))
        elif any(number in self.hang for number in items):
            self._free_at[worker] = float("inf")
        elif begin + seconds < float("inf"):
            self._answer(future, begin + seconds + self.lag - self.now, lambda: Carried(self.call(items), seconds))
        return future

    def _answer(self, future: Future[Any], seconds: float, value: Any) -> None:
        def answer() -> None:
            if self._at.pop(future, None) is not None and future.set_running_or_notify_cancel():
                future.set_result(value() if callable(value) else value)

        self._later(seconds, answer)

    def restart(self, worker: str) -> None:
        self.end(worker)

    def put(self, future: Future[Any]) -> None:
        self._ended.append(future)

    def get(self, timeout: float) -> Future[Any]:
        until = self.now + timeout
        while self._events and not self._ended and self._events[0][0] <= until:
            self.now, _, action = heapq.heappop(self._events)
            action()
        if not self._ended:
            self.now = until
        return self.get_nowait()

    def get_nowait(self) -> Future[Any]:
        if not self._ended:
            raise queue.Empty
        return self._ended.popleft()

    def reconnect(self) -> None:
        if not self.returns:
            raise ClusterError("simulated: there is no scheduler that answers; go on with advsearch resume")
        self.gone = False

    def close(self) -> None:
        pass


def coordinator(pool: Simulated, tell: Callable[[str], None] = lambda text: None) -> Coordinator:
    """A coordinator of a simulated pool."""
    work = Work("nowhere:nothing", {})
    return Coordinator(pool, work, "key", Files({}, {}), "1", HERE, tell, pool.clock)


__all__ = ["HERE", "Failure", "Simulated", "coordinator"]
