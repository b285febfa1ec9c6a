"""Batches done by workers: as many calls under way as there are workers, and what is
lost is asked for again, at last item by item, so that an item that kills its workers is
known.
"""

from __future__ import annotations

import queue
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from contextlib import contextmanager
from itertools import islice
from typing import Any

from advsearch import threads
from advsearch.cluster import (
    BatchResult,
    WorkerDiedError,
    WorkerExecutor,
    Workers,
    WorkerStats,
    WorkerTask,
)
from advsearch.cluster.local import LocalExecutor
from advsearch.cluster.worker import (
    LOAD_DEADLINE,
    Failure,
    Reply,
    machine_name,
    run_batch,
    this_machine,
)
from advsearch.errors import ClusterError
from advsearch.interrupts import INTERRUPTS
from advsearch.registry import imported

LOCAL = "local"  # the cluster that is this machine

DEADLINE_FACTOR = 10.0  # times the median that a batch may take
MIN_DEADLINE = 60.0  # seconds that it may take at least
MEDIAN_OF = 101  # batches, the last ones, of which the median is taken
MIN_BATCHES = 5  # that a median takes

# batches that may kill all their workers before a first one is done
MAX_DEAD_STARTS = 5
POLL = 0.5  # seconds between two looks at who is there


class PoolWorkers:
    """`Workers` of an executor."""

    def __init__(
        self,
        executor: WorkerExecutor,
        task: WorkerTask,
        tell: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.facts: WorkerStats = executor.stats
        self._executor = executor
        self._task = task
        self._tell = tell
        self._clock = clock
        self._here = machine_name(this_machine())
        self._dead_starts = 0

    def results(self, batches: Iterable[Sequence[Any]]) -> Iterator[BatchResult]:
        source = iter(batches)
        waiting = deque[Sequence[Any]]()
        running = dict[Future[Reply], Sequence[Any]]()
        ended: queue.SimpleQueue[Future[Reply]] = queue.SimpleQueue()
        item_seconds = deque[float](maxlen=MEDIAN_OF)
        counted_at = self._clock()
        try:
            while True:
                INTERRUPTS.look()
                n_workers = self._executor.count_workers()
                now = self._clock()
                self.facts.workers = n_workers
                self.facts.alive += n_workers * (now - counted_at)
                counted_at = now
                while len(running) < n_workers and self._take_next(waiting, source):
                    items = waiting.popleft()
                    deadline = self._deadline(len(items), item_seconds)
                    future = self._executor.submit(
                        run_batch, self._task, items, deadline
                    )
                    running[future] = items
                    future.add_done_callback(ended.put)
                self.facts.most = max(self.facts.most, len(running))
                if not running and not self._take_next(waiting, source):
                    return
                ended_future = self._wait(ended)
                if ended_future is None:
                    continue
                items = running.pop(ended_future)
                error = (
                    BrokenExecutor()
                    if ended_future.cancelled()
                    else ended_future.exception()
                )
                if error is None:
                    reply = ended_future.result()
                    item_seconds.append(reply.seconds / max(1, len(items)))
                    yield self._result(items, reply)
                elif isinstance(error, BrokenExecutor):
                    self.facts.retried += 1
                    waiting.appendleft(items)
                elif not isinstance(error, WorkerDiedError):
                    raise error
                elif len(items) > 1:
                    self._count_dead_start()
                    waiting.extendleft(
                        items[index : index + 1]
                        for index in reversed(range(len(items)))
                    )
                else:
                    self._count_dead_start()
                    yield BatchResult(items, None, lost=str(error))
        finally:
            for future in running:
                future.cancel()

    def _wait(self, ended: queue.SimpleQueue[Future[Reply]]) -> Future[Reply] | None:
        """Return a future that has ended; None where none has for a moment."""
        try:
            return ended.get(timeout=POLL)
        except queue.Empty:
            return None

    @staticmethod
    def _take_next(
        waiting: deque[Sequence[Any]], source: Iterator[Sequence[Any]]
    ) -> bool:
        """Have a batch wait, unless one does. Return whether there is one."""
        if not waiting:
            waiting.extend(islice(source, 1))
        return bool(waiting)

    def _deadline(self, n_items: int, item_seconds: Sequence[float]) -> float:
        """Return the seconds after which a worker counts as hanging, and ends
        itself.
        """
        if len(item_seconds) < MIN_BATCHES:
            deadline = LOAD_DEADLINE
        else:
            deadline = max(
                MIN_DEADLINE,
                DEADLINE_FACTOR * n_items * statistics.median(item_seconds),
            )
        return max(deadline, self._task.seconds or 0.0)

    def _result(self, items: Sequence[Any], reply: Reply) -> BatchResult:
        if reply.failure is Failure.BUG:
            raise RuntimeError(f"on {reply.worker}:\n{reply.error}")
        if reply.failure is not None:
            raise ClusterError(reply.error)
        self.facts.batches += 1
        self.facts.busy += reply.seconds
        self.facts.loading += reply.loading
        self.facts.alive -= reply.loading
        machine: str | None = machine_name(reply.machine)
        if machine == self._here:
            machine = None
        elif machine is not None and machine not in self.facts.machines:
            self.facts.machines = {**self.facts.machines, machine: reply.machine}
            described = ", ".join(
                f"{key} {text}" for key, text in reply.machine.items()
            )
            self._tell(
                f"{reply.worker} is another machine than this ({described}): "
                "last bits of rows may differ"
            )
        return BatchResult(items, reply.value, reply.worker, machine)

    def _count_dead_start(self) -> None:
        """Raise ClusterError where workers die of whatever they are given, for example
        while they load.
        """
        self._dead_starts += 1
        if self._dead_starts >= MAX_DEAD_STARTS and not self.facts.batches:
            raise ClusterError(
                f"{self._executor.where}: workers died of the first "
                f"{self._dead_starts} batches, and none was done; "
                "try it with workers=null, or see whether a worker has enough memory "
                "for the scene and the model"
            )


@contextmanager
def open_workers(
    task: WorkerTask,
    *,
    workers: int | None,
    cluster: str | None,
    tell: Callable[[str], None],
) -> Iterator[Workers | None]:
    """Open workers for a task: processes of this machine, by default one a core, or
    those of a cluster, given by its scheduler's address or a YAML file. None where
    everything is done in this process.
    """
    if workers is None and cluster is None:
        yield None
        return
    executor: WorkerExecutor
    if cluster in (None, LOCAL):
        executor = LocalExecutor(workers or threads.cores())
    else:
        open_dask = imported("advsearch.cluster.dask_executor:open_dask")
        executor, task = open_dask(task, workers, cluster, tell)
    try:
        yield PoolWorkers(executor, task, tell)
    finally:
        executor.shutdown(cancel_futures=True)
