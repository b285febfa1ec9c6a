"""Gives batches to workers, `DEPTH` at most to each, and takes what comes of them. A batch whose worker died is then
the only one that a worker has, so that it is known what it died of: after `DEATHS` it is cut in halves, and a single
item given up in words. A worker that takes far longer than the median counts as dead; its late answers change nothing.
"""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from advsearch.cluster import Disconnected, Done, Dropped, Ended, Event, Joined, Left, Pool, Work, Workforce
from advsearch.cluster.worker import Carried, Failure, Files, MachineInfo, Ready, carry_out_batch, machine_name, prepare
from advsearch.errors import ClusterError
from advsearch.interrupts import INTERRUPTS

DEPTH = 2
"""Batches that a worker has at once: the one it is at, and the next (`Work.ahead`), so that it never waits."""

DEATHS = 3
"""Workers that may die of a batch before it is cut in halves or given up."""

LOADS = 5
"""Times that as many workers as there are may die while they get ready, and none gets ready, before all is given up."""

SLOW, LEAST_DEADLINE, FIRST_DEADLINE = 10.0, 60.0, 900.0
"""Times the median that a batch may take, least seconds of that, and seconds before there is a median."""

MEDIAN_OF = 101
"""Batches, the last ones, of which the median is taken."""

ENOUGH = 5
"""Batches that a median takes."""

PATIENCE, LESS_PATIENCE = 300.0, 15.0
"""Seconds without any worker after which there is no hope; where those that are there are refused, fewer."""

POLL = 0.5
"""Seconds between two looks at the clock where nothing happens."""


@dataclass(eq=False)
class _Batch:
    items: Sequence[Any]
    alone: bool = False
    deaths: int = 0
    wanted: bool = True


@dataclass(eq=False)
class _Worker:
    address: str
    ready: bool = False
    sent: bool = False
    machine: str | None = None
    tickets: list[int] = field(default_factory=list)
    since: float = 0.0


class Coordinator:
    """An `Executor` over a pool of workers. Rows that are made on a machine like `machine` need no mark."""

    def __init__(
        self,
        pool: Pool,
        work: Work,
        key: str,
        files: Files,
        version: str,
        machine: MachineInfo,
        tell: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.facts = Workforce(link=pool.link)
        self._pool, self._key, self._tell, self._clock = pool, key, tell, clock
        self._depth = DEPTH if work.ahead else 1
        self._work, self._files, self._version = work, files, version
        self._here = machine_name(machine)
        self._machines: dict[str, MachineInfo] = {}
        self._workers: dict[str, _Worker] = {}
        self._refused: dict[str, str] = {}
        self._tickets: dict[int, tuple[_Worker, _Batch | None]] = {}
        self._next_ticket = self._under_way = 0
        self._todo: deque[_Batch] = deque()
        self._call = 0
        self._events: deque[Event] = deque()
        self._free: deque[_Worker] = deque()
        self._per_item: deque[float] = deque(maxlen=MEDIAN_OF)
        self._load_deaths = self._seen = 0
        self._counted_at = self._alone_since = self._looked_at = clock()

    def results(self, batches: Iterable[Sequence[Any]]) -> Iterator[Done]:
        self._let_go()  # what an earlier call has left under way
        self._call += 1
        call, source = self._call, iter(batches)
        self._per_item.clear()  # those before may have taken other times
        if not self._workers:
            self._alone_since = self._clock()
        try:
            while True:
                INTERRUPTS.look()
                if call != self._call:
                    raise RuntimeError("these results were given up when others were asked for")
                self._give_out(source)
                if not self._todo and not self._under_way:
                    items = next(source, None)  # there may be more, and nobody yet who is ready for it
                    if items is None:
                        return
                    self._todo.append(_Batch(items))
                if not self._events:
                    self._events.extend(self._pool.events(POLL))
                while self._events:
                    yield from self._happened(self._events.popleft())
                self._count_time()
                yield from self._look_at_clock()
        finally:
            if call == self._call:
                self._let_go()

    def _let_go(self) -> None:
        """Let what is under way come to nothing."""
        self._todo.clear()
        for _, one in self._tickets.values():
            if one is not None:
                one.wanted = False

    # ---- giving out -------------------------------------------------------------------------------------------------

    def _give_out(self, source: Iterator[Sequence[Any]]) -> None:
        while self._free:
            worker = self._free[0]
            if not self._is_there(worker):
                self._free.popleft()
                continue
            if not self._todo:
                items = next(source, None)
                if items is None:
                    return
                self._todo.append(_Batch(items))
            one = self._todo.popleft()
            if one.alone:
                idle = next((free for free in self._free if not free.tickets and self._is_there(free)), None)
                if idle is None:  # soon
                    self._todo.appendleft(one)
                    return
                worker = idle
                self._free = deque(free for free in self._free if free is not worker)
            else:
                self._free.popleft()
            self._submit(worker, one)

    def _is_there(self, worker: _Worker) -> bool:
        return self._workers.get(worker.address) is worker

    def _submit(self, worker: _Worker, one: _Batch | None, *, send: bool = False) -> None:
        """Give a worker a batch, or have it get ready; `send` it the files then, which it may have already."""
        ticket, self._next_ticket = self._next_ticket, self._next_ticket + 1
        if not worker.tickets:
            worker.since = self._clock()
        worker.tickets.append(ticket)
        self._tickets[ticket] = worker, one
        self._under_way += one is not None
        if one is None:
            files = self._files if send else self._files.named_only
            self._pool.submit(ticket, worker.address, prepare, self._key, self._work, files, self._version)
        else:
            self._pool.submit(ticket, worker.address, carry_out_batch, self._key, one.items)

    # ---- what happens -----------------------------------------------------------------------------------------------

    def _happened(self, event: Event) -> Iterator[Done]:
        if isinstance(event, Joined):
            if event.worker not in self._workers and event.worker not in self._refused:
                self._workers[event.worker] = worker = _Worker(event.worker)
                self._seen = max(self._seen, len(self._workers))
                self._submit(worker, None)
        elif isinstance(event, Left):
            self._refused.pop(event.worker, None)
            yield from self._gone(event.worker, died=not event.told)
        elif isinstance(event, Dropped):
            found = self._tickets.get(event.ticket)
            if found is not None:
                yield from self._gone(found[0].address, died=True)
        elif isinstance(event, Ended):
            yield from self._answered(event)
        elif isinstance(event, Disconnected):
            self._tell(f"{self._pool.where}: the scheduler has gone; what was under way will be done again")
            for address in list(self._workers):
                yield from self._gone(address, died=False)
            self._refused.clear()
            self._pool.reconnect()
            self.facts.link = self._pool.link
            self._alone_since = self._clock()

    def _answered(self, event: Ended) -> Iterator[Done]:
        worker, one = self._tickets.pop(event.ticket, (None, None))
        if worker is None:
            return  # late
        self._under_way -= one is not None
        worker.tickets.remove(event.ticket)
        worker.since = self._clock()
        value = event.value
        if isinstance(value, Ready):
            self._is_ready(worker, value)
        elif isinstance(value, Carried) and one is not None:
            self.facts.batches += 1
            self.facts.busy += value.seconds
            self._per_item.append(value.seconds / max(1, len(one.items)))
            self._set_free(worker, self._depth if one.alone else 1)
            if one.wanted:
                yield Done(one.items, value.value, worker.address, worker.machine)
        elif isinstance(value, Failure):
            if one is not None and one.wanted and (value.unfit or value.forgotten):
                self._todo.appendleft(one)
            if value.forgotten:
                self._forget(worker)
                self._requeue(worker)
                self._workers[worker.address] = again = _Worker(worker.address)
                self._submit(again, None)
            elif value.missing and not worker.sent:
                worker.sent = True
                self._submit(worker, None, send=True)
            elif value.unfit or value.missing:
                # give a worker nothing more
                self.facts.refused += 1
                self._refused[worker.address] = value.text
                self._tell(f"{worker.address} is given nothing: {value.text}")
                self._forget(worker)
                self._requeue(worker)
            elif value.trace:
                raise RuntimeError(f"on {worker.address}:\n{value.trace}")
            else:
                raise ClusterError(value.text)

    def _is_ready(self, worker: _Worker, value: Ready) -> None:
        name = machine_name(value.machine)
        if name != self._here:
            worker.machine = name
            if name not in self._machines:
                self._machines[name] = value.machine
                self.facts.machines = dict(self._machines)
                told = ", ".join(f"{key} {text}" for key, text in value.machine.items())
                self._tell(f"{worker.address} is another machine than this ({told}): last bits of rows may differ")
        self._count_time()
        self._load_deaths = 0
        self.facts.loading += value.seconds
        worker.ready = True
        self.facts.workers += 1
        self.facts.most = max(self.facts.most, self.facts.workers)
        self._set_free(worker, self._depth)

    def _set_free(self, worker: _Worker, places: int) -> None:
        """Note places for batches: the first one of a worker that has nothing to do in front of all others."""
        idle = not worker.tickets
        self._free.extendleft([worker] * idle)
        self._free.extend([worker] * (places - idle))

    def _gone(self, address: str, *, died: bool) -> Iterator[Done]:
        """Take back what a worker had; what it was at when it died is suspected."""
        worker = self._workers.get(address)
        if worker is None:
            return
        self._forget(worker)
        head = self._tickets.get(worker.tickets[0]) if worker.tickets else None
        if died:
            self.facts.lost += 1
        if died and head is not None and not worker.ready:
            self._load_deaths += 1
            if self._load_deaths >= LOADS * max(2, self._seen) and not self.facts.workers:
                self._give_up(f"{self._load_deaths} workers died while they loaded the scene and the model")
        held = [self._tickets[ticket][1] for ticket in worker.tickets] if died else []
        suspects = [one for one in held if one is not None and one.wanted]
        self._requeue(worker)
        for one in suspects:
            one.alone = True
        if len(suspects) != 1:
            return
        (suspect,) = suspects
        suspect.deaths += 1
        if suspect.deaths < DEATHS:
            return
        self._todo.remove(suspect)
        items = suspect.items
        if len(items) > 1:
            half = len(items) // 2
            self._todo.appendleft(_Batch(items[half:], alone=True))
            self._todo.appendleft(_Batch(items[:half], alone=True))
        else:
            yield Done(items, None, address, lost=f"no answer: {suspect.deaths} workers died of it")

    def _forget(self, worker: _Worker) -> None:
        self._count_time()
        self._workers.pop(worker.address, None)
        self.facts.workers -= worker.ready
        if not self._workers:
            self._alone_since = self._clock()

    def _requeue(self, worker: _Worker) -> None:
        """Put what a worker had back in front, in its order."""
        for ticket in reversed(worker.tickets):
            _, one = self._tickets.pop(ticket, (None, None))
            self._pool.forget(ticket)
            if one is not None:
                self._under_way -= 1
            if one is not None and one.wanted:
                self.facts.retried += 1
                self._todo.appendleft(one)
        worker.tickets.clear()

    # ---- the clock --------------------------------------------------------------------------------------------------

    def _count_time(self) -> None:
        now = self._clock()
        self.facts.alive += self.facts.workers * (now - self._counted_at)
        self._counted_at = now

    def _look_at_clock(self) -> Iterator[Done]:
        now = self._clock()
        if now - self._looked_at < POLL:
            return
        self._looked_at = now
        median = statistics.median(self._per_item) if len(self._per_item) >= ENOUGH else None
        for worker in list(self._workers.values()):
            if not worker.tickets:
                continue
            one = self._tickets[worker.tickets[0]][1]
            deadline = FIRST_DEADLINE
            if one is not None and median is not None:
                deadline = max(LEAST_DEADLINE, SLOW * median * len(one.items))
            if one is not None and self._work.seconds is not None:
                deadline = max(deadline, self._work.seconds)
            if now - worker.since > deadline:
                self._tell(f"{worker.address} has not answered for {now - worker.since:.0f} s, so it is ended")
                self._pool.restart(worker.address)
                yield from self._gone(worker.address, died=True)
        patience = LESS_PATIENCE if self._refused else PATIENCE
        if not self._workers and now - self._alone_since > patience:
            self._give_up(f"there was no worker that can do it for {patience:.0f} s")

    def _give_up(self, text: str) -> None:
        reasons = "; ".join(dict.fromkeys(self._refused.values()))
        raise ClusterError(
            f"{self._pool.where}: {text}" + (f" ({reasons})" if reasons and reasons != text else "") + "; what was "
            "stored is kept, so that the run can go on with advsearch resume"
        )
