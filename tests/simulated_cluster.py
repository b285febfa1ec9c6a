"""Workers that are only simulated, with a clock of their own: they run as fast as whoever gives them work."""

import heapq
import queue
from collections import deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import BrokenExecutor, Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from advsearch.cluster import MAX_DEATHS, WorkerDiedError, WorkerExecutor, WorkerStats, WorkerTask
from advsearch.cluster.worker import Reply, describe_machine
from advsearch.cluster.workers import PoolWorkers


@dataclass(eq=False)
class SimulatedCall:
    items: Sequence[Any]
    future: Future[Any]
    deaths: int = 0


@dataclass(eq=False)
class Simulated(WorkerExecutor):
    """See `WorkerExecutor`.

    Attributes:
        call: what a worker does with items.
        seconds: that an item takes, by the item.
        load: seconds until a worker has loaded, with its first call.
        again: seconds after which another worker stands in the place of one that died; None for never.
        lag: seconds until an answer arrives.
        kill: items of which a worker dies, at once.
        replies: what a worker says instead, by its name.
        now: the time.
        given: items of the calls that were submitted, in order.
        most: calls that were under way at once.
    """

    call: Callable[[Any], Any] = list
    seconds: Callable[[Any], float] = lambda item: 0.5
    load: float = 5.0
    lag: float = 0.0
    again: float | None = 1.0
    kill: Collection[Any] = ()
    replies: dict[str, Reply] = field(default_factory=dict)
    now: float = 0.0
    given: list[Any] = field(default_factory=list)
    most: int = 0
    description: str = "simulated"
    stats: WorkerStats = field(default_factory=WorkerStats)
    _events: list[tuple[float, int, Callable[[], None]]] = field(default_factory=list)
    _workers: dict[str, SimulatedCall | None] = field(default_factory=dict)
    _idle: deque[str] = field(default_factory=deque)
    _loaded: set[str] = field(default_factory=set)
    _waiting: deque[SimulatedCall] = field(default_factory=deque)
    _made: int = 0
    _order: int = 0

    def clock(self) -> float:
        return self.now

    def add(self, count: int = 1, after: float = 0.0) -> None:
        for _ in range(count):
            self.at(self.now + after, self._add_worker)

    def _add_worker(self) -> None:
        name = f"w{self._made}"
        self._made += 1
        self._workers[name] = None
        self._idle.append(name)
        self._give_out()

    def at(self, time: float, action: Callable[[], None]) -> None:
        """Do something to the workers at a time."""
        self._order += 1
        heapq.heappush(self._events, (time, self._order, action))

    @property
    def alive(self) -> list[str]:
        return list(self._workers)

    def end(self, worker: str) -> None:
        """A worker dies; another does what it had, unless enough have died of it."""
        if worker not in self._workers:
            return
        call = self._workers.pop(worker)
        if self.again is not None:
            self.add(after=self.again)
        if call is None:
            return
        self.stats.lost += 1
        call.deaths += 1
        if call.deaths < MAX_DEATHS:
            self._waiting.appendleft(call)
            self._give_out()
        else:
            call.future.set_exception(WorkerDiedError(f"no answer: {MAX_DEATHS} workers died of it"))

    def lose_scheduler(self) -> None:
        """What is under way is lost; the workers come back."""
        calls = [*self._waiting, *filter(None, self._workers.values())]
        self.add(len(self._workers), after=3.0)
        self._workers.clear()
        self._waiting.clear()
        for call in calls:
            with suppress(InvalidStateError):
                call.future.set_exception(BrokenExecutor("the scheduler has gone"))

    def count_workers(self) -> int:
        return len(self._workers)

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        _, items, _ = args
        call = SimulatedCall(items, Future())
        self.given.append(items)
        self._waiting.append(call)
        self._give_out()
        self.most = max(self.most, len(self._waiting) + sum(each is not None for each in self._workers.values()))
        return call.future

    def _give_out(self) -> None:
        while self._waiting and self._idle:
            worker = self._idle.popleft()
            if worker in self._workers:
                self._begin(worker, self._waiting.popleft())

    def _begin(self, worker: str, call: SimulatedCall) -> None:
        self._workers[worker] = call
        loading = 0.0 if worker in self._loaded else self.load
        self._loaded.add(worker)
        seconds = sum(map(self.seconds, call.items))
        if any(item in self.kill for item in call.items):
            self.at(self.now + loading, lambda: self.end(worker))
            return

        def answer() -> None:
            if self._workers.get(worker) is not call:
                return  # it died
            self._workers[worker] = None
            self._idle.append(worker)
            reply = Reply(self.call(call.items), seconds, loading, describe_machine(), worker)
            if call.future.set_running_or_notify_cancel():
                call.future.set_result(self.replies.get(worker, reply))
            self._give_out()

        self.at(self.now + loading + seconds + self.lag, answer)

    def advance(self, seconds: float) -> None:
        """Let what is next happen, within so long."""
        until = self.now + seconds
        if self._events and self._events[0][0] <= until:
            time, _, action = heapq.heappop(self._events)
            self.now = max(self.now, time)  # what was due meanwhile is late, not in the past
            action()
        else:
            self.now = until


class SimulatedWorkers(PoolWorkers):
    """`PoolWorkers` in simulated time."""

    def __init__(self, executor: Simulated, tell: Callable[[str], None] = lambda text: None) -> None:
        super().__init__(executor, WorkerTask("nowhere:nothing", {}), tell, executor.clock)
        self.simulated = executor

    def _wait(self, ended: queue.SimpleQueue[Any]) -> Future[Any] | None:
        if ended.empty():
            self.simulated.advance(0.5)
        return None if ended.empty() else ended.get_nowait()
