"""Gives batches to workers, one to each, and takes what comes of them. A batch of which `DEATHS` workers died is cut in
halves, and a single item given up in words. A worker that takes far longer than the median counts as dead; its late
answers change nothing."""

from __future__ import annotations

import queue
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any

from advsearch.cluster import Done, Pool, SchedulerGoneError, Work, WorkerDiedError, Workforce
from advsearch.cluster.worker import Carried, Failure, Files, MachineInfo, Ready, carry_out_batch, machine_name, prepare
from advsearch.errors import ClusterError
from advsearch.interrupts import INTERRUPTS

DEATHS = 3  # workers that may die of a batch before it is cut in halves or given up
LOADS = 5  # times that as many workers as there are may die while they get ready, and none does, before all is given up

SLOW, LEAST_DEADLINE, FIRST_DEADLINE = 10.0, 60.0, 900.0
"""Times the median that a batch may take, least seconds of that, and seconds before there is a median."""

MEDIAN_OF = 101  # batches, the last ones, of which the median is taken
ENOUGH = 5  # batches that a median takes

PATIENCE, LESS_PATIENCE = 300.0, 15.0
"""Seconds without any worker after which there is no hope; where those that are there are refused, fewer."""

POLL = 0.5  # seconds between two looks at the clock, and at who is there


@dataclass(eq=False)
class _Batch:
    items: Sequence[Any]
    turn: int  # the call of `results` that wants it
    deaths: int = 0


@dataclass(eq=False)
class _Worker:
    address: str
    ready: bool = False
    sent: bool = False
    machine: str | None = None
    call: Future[Any] | None = None  # what it is at since when: a batch, or, with none, it gets ready
    batch: _Batch | None = None
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
        self._pool, self._tell, self._clock = pool, tell, clock
        self._work, self._key, self._files, self._version = work, key, files, version
        self._here = machine_name(machine)
        self._workers: dict[str, _Worker] = {}
        self._owners: dict[Future[Any], _Worker] = {}
        self._idle: deque[_Worker] = deque()
        self._avoided: dict[str, str] = {}  # those that are given nothing, as long as they are there: why, or empty
        self._todo: deque[_Batch] = deque()
        self._turn = self._under_way = 0  # calls of `results`, and batches of the last one that workers have
        self._per_item: deque[float] = deque(maxlen=MEDIAN_OF)
        self._load_deaths = self._seen = 0
        self._looked_at = float("-inf")
        self._counted_at = self._alone_since = clock()

    def results(self, batches: Iterable[Sequence[Any]]) -> Iterator[Done]:
        self._turn += 1
        turn, source = self._turn, iter(batches)
        self._todo.clear()
        self._under_way = 0  # what an earlier call has left comes to nothing
        self._per_item.clear()  # those before may have taken other times
        if not self._workers:
            self._alone_since = self._clock()
        try:
            while True:
                INTERRUPTS.look()
                if turn != self._turn:
                    raise RuntimeError("these results were given up when others were asked for")
                if self._clock() - self._looked_at >= POLL:
                    yield from self._look_around()
                self._give_out(source)
                if not self._todo and not self._under_way:  # there may be more, and nobody yet who is ready for it
                    self._todo.extend(_Batch(items, turn) for items in islice(source, 1))
                    if not self._todo:
                        return
                ended = list[Future[Any]]()
                with suppress(queue.Empty):  # of a moment
                    ended.append(self._pool.ended.get(timeout=POLL))
                    while True:
                        ended.append(self._pool.ended.get_nowait())
                # as a list: nobody may go on asking
                yield from [done for future in ended for done in self._answered(future)]
        finally:
            if turn == self._turn:
                self._turn += 1
                self._todo.clear()

    # ---- giving out -------------------------------------------------------------------------------------------------

    def _give_out(self, source: Iterator[Sequence[Any]]) -> None:
        while self._idle:
            if not self._todo:
                self._todo.extend(_Batch(items, self._turn) for items in islice(source, 1))
            if not self._todo:
                return
            worker = self._idle.popleft()
            if self._workers.get(worker.address) is worker:  # it has not gone meanwhile
                worker.batch = batch = self._todo.popleft()
                self._under_way += 1
                self._submit(worker, carry_out_batch, self._key, batch.items)

    def _prepare(self, worker: _Worker) -> None:
        """Have a worker get ready; it may have the files already, and is `sent` them otherwise."""
        files = self._files if worker.sent else Files(self._files.digests, {})
        self._submit(worker, prepare, self._key, self._work, files, self._version)

    def _submit(self, worker: _Worker, function: Callable[..., Any], *args: Any) -> None:
        worker.since = self._clock()
        worker.call = self._pool.submit(worker.address, function, *args)
        self._owners[worker.call] = worker
        worker.call.add_done_callback(self._pool.ended.put)

    # ---- what comes back --------------------------------------------------------------------------------------------

    def _answered(self, future: Future[Any]) -> Iterator[Done]:
        if future not in self._owners or future.cancelled():
            return  # late, or the scheduler has gone, which the next look tells
        worker = self._owners[future]
        if isinstance(future.exception(), WorkerDiedError):
            yield from self._died(worker)
            return
        value, batch = future.result(), worker.batch
        del self._owners[future]
        worker.call = worker.batch = None
        if worker.ready:
            self._idle.append(worker)
        wanted = batch is not None and batch.turn == self._turn
        self._under_way -= wanted
        if isinstance(value, Ready):
            name = machine_name(value.machine)
            if name != self._here:
                worker.machine = name
                if name not in self.facts.machines:
                    self.facts.machines = {**self.facts.machines, name: value.machine}
                    told = ", ".join(f"{key} {text}" for key, text in value.machine.items())
                    self._tell(f"{worker.address} is another machine than this ({told}): last bits of rows may differ")
            self._count_time()
            self._load_deaths, worker.ready = 0, True
            self._idle.append(worker)
            self.facts.loading += value.seconds
            self.facts.workers += 1
            self.facts.most = max(self.facts.most, self.facts.workers)
        elif isinstance(value, Carried) and batch is not None:
            self.facts.batches += 1
            self.facts.busy += value.seconds
            self._per_item.append(value.seconds / max(1, len(batch.items)))
            if wanted:
                yield Done(batch.items, value.value, worker.address, worker.machine)
        elif not isinstance(value, Failure):
            raise TypeError(f"on {worker.address}: {value!r:.80}")
        elif value.missing and not worker.sent:
            worker.sent = True
            self._prepare(worker)
        elif value.unfit or value.missing or value.forgotten:
            if batch is not None and wanted:
                self._todo.appendleft(batch)
            self._take_back(worker)
            if value.forgotten:
                self._workers[worker.address] = again = _Worker(worker.address)
                self._prepare(again)
            else:
                self.facts.refused += 1
                self._avoided[worker.address] = value.text
                self._tell(f"{worker.address} is given nothing: {value.text}")
        elif value.trace:
            raise RuntimeError(f"on {worker.address}:\n{value.trace}")
        else:
            raise ClusterError(value.text)

    # ---- workers that come and go -----------------------------------------------------------------------------------

    def _look_around(self) -> Iterator[Done]:
        self._count_time()
        now = self._looked_at = self._clock()
        try:
            there = dict.fromkeys(self._pool.workers())
        except SchedulerGoneError:
            self._tell(f"{self._pool.where}: the scheduler has gone; what was under way will be done again")
            for worker in list(self._workers.values()):
                self._take_back(worker)
            self._avoided.clear()
            self._pool.reconnect()
            self.facts.link, self._alone_since = self._pool.link, self._clock()
            self._looked_at = float("-inf")
            return
        for worker in [worker for worker in self._workers.values() if worker.address not in there]:
            yield from self._died(worker)
        self._avoided = {address: why for address, why in self._avoided.items() if address in there}
        for address in there:
            if address not in self._workers and address not in self._avoided:
                self._workers[address] = worker = _Worker(address)
                self._seen = max(self._seen, len(self._workers))
                self._prepare(worker)
        for worker in [worker for worker in self._workers.values() if worker.call is not None]:
            batch, deadline = worker.batch, FIRST_DEADLINE
            if batch is not None:
                if len(self._per_item) >= ENOUGH:
                    deadline = max(LEAST_DEADLINE, SLOW * statistics.median(self._per_item) * len(batch.items))
                deadline = max(deadline, self._work.seconds or 0.0)
            if now - worker.since > deadline:
                self._tell(f"{worker.address} has not answered for {now - worker.since:.0f} s, so it is ended")
                self._pool.restart(worker.address)
                yield from self._died(worker)
        patience = LESS_PATIENCE if any(self._avoided.values()) else PATIENCE
        if not self._workers and now - self._alone_since > patience:
            self._give_up(f"there was no worker that can do it for {patience:.0f} s")

    def _died(self, worker: _Worker) -> Iterator[Done]:
        self.facts.lost += 1
        self._avoided[worker.address] = ""  # until it is seen to be gone
        batch = self._take_back(worker)
        if not worker.ready:
            self._load_deaths += 1
            if self._load_deaths >= LOADS * max(2, self._seen) and not self.facts.workers:
                self._give_up(f"{self._load_deaths} workers died while they loaded the scene and the model")
        if batch is None:
            return
        batch.deaths += 1
        if batch.deaths < DEATHS:
            return
        self._todo.remove(batch)
        half = len(batch.items) // 2
        if half:
            self._todo.extendleft(_Batch(items, self._turn) for items in (batch.items[half:], batch.items[:half]))
        else:
            yield Done(batch.items, None, worker.address, lost=f"no answer: {batch.deaths} workers died of it")

    def _take_back(self, worker: _Worker) -> _Batch | None:
        self._count_time()
        self._workers.pop(worker.address, None)
        self.facts.workers -= worker.ready
        if not self._workers:
            self._alone_since = self._clock()
        if worker.call is not None:
            del self._owners[worker.call]
            worker.call.cancel()
        batch = worker.batch
        if batch is None or batch.turn != self._turn:
            return None
        self._under_way -= 1
        self.facts.retried += 1
        self._todo.appendleft(batch)
        return batch

    def _count_time(self) -> None:
        now = self._clock()
        self.facts.alive += self.facts.workers * (now - self._counted_at)
        self._counted_at = now

    def _give_up(self, text: str) -> None:
        reasons = "; ".join(dict.fromkeys(filter(None, self._avoided.values())))
        why = f" ({reasons})" if reasons and reasons != text else ""
        raise ClusterError(
            f"{self._pool.where}: {text}{why}; what was stored is kept, so that the run can go on with advsearch resume"
        )
