"""Compute batches by workers: each worker runs one call at a time.

A batch whose worker was lost is submitted again. If several workers die during it, its
items are submitted one by one, to find the item that kills them.

`advsearch.extend` offers this module to added clusters. Its `__all__` has also what
these import.
"""

from __future__ import annotations

import queue
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from contextlib import contextmanager, suppress
from itertools import islice
from typing import Any

from advsearch import threads
from advsearch.catalog import list_built_ins
from advsearch.cluster import (
    MAX_DEATHS,
    BatchResult,
    ClusterExecutor,
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
    compute_digests,
    compute_version,
    describe_machine,
    digest_machine,
    make_private_directory,
    read_files,
    run_batch,
    write_files,
)
from advsearch.errors import ClusterError, InputError
from advsearch.interrupts import INTERRUPTS
from advsearch.registry import Registry

__all__ = [
    "CLUSTERS",
    "MAX_DEATHS",
    "ClusterExecutor",
    "Failure",
    "PoolWorkers",
    "Reply",
    "WorkerDiedError",
    "WorkerStats",
    "WorkerTask",
    "compute_digests",
    "compute_version",
    "make_private_directory",
    "open_workers",
    "read_files",
    "write_files",
]

CLUSTERS: Registry[type[ClusterExecutor]] = Registry(
    "advsearch.clusters",
    list_built_ins("cluster"),
    "a subclass of ClusterExecutor with `expected_values`",
    lambda name, entry: (
        isinstance(entry, type)
        and issubclass(entry, ClusterExecutor)
        and hasattr(entry, "expected_values")
    ),
)
"""Executors on clusters, imported when a cluster is opened."""

LOCAL = "local"  # name of the cluster that is this machine

# A batch may take this many times the median time of earlier ones, and at least
# MIN_DEADLINE seconds.
DEADLINE_FACTOR = 10.0
MIN_DEADLINE = 60.0
MEDIAN_WINDOW = 101  # maximum number of batches of which the median is taken
MIN_BATCHES = 5  # minimum number of batches for a median
# Maximum number of batches whose workers die before any batch has finished.
MAX_DEAD_STARTS = 5
POLL_SECONDS = 0.5  # seconds between two counts of workers


class PoolWorkers:
    """`Workers` of an executor."""

    def __init__(
        self,
        executor: WorkerExecutor,
        task: WorkerTask,
        report_message: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Make workers for a task.

        Args:
            executor: executor that runs calls on its workers.
            task: function and settings that the workers load.
            report_message: function that is called with messages for the user.
            clock: function that returns the time in seconds; tests pass another one.
        """
        self.stats: WorkerStats = executor.stats
        self._executor = executor
        self._task = task
        self._report_message = report_message
        self._clock = clock
        self._this_machine = digest_machine(describe_machine())
        self._dead_starts = 0

    def compute(self, batches: Iterable[Sequence[Any]]) -> Iterator[BatchResult]:
        """Compute batches on the workers, and yield results in the order of their ends.

        If the workers of a batch die, the batch is split into its items, to find the
        item that kills them. A single item whose workers die gives a result without a
        value.

        Args:
            batches: items of each batch; a batch is taken when a worker is free.
        """
        queued = _BatchQueue(batches)
        running = dict[Future[Reply], Sequence[Any]]()
        ended: queue.SimpleQueue[Future[Reply]] = queue.SimpleQueue()
        # seconds per item of the last batches, for the deadline of the next
        item_seconds = deque[float](maxlen=MEDIAN_WINDOW)
        counted_at = self._clock()  # time of the last count of workers
        try:
            while True:
                INTERRUPTS.raise_pending()
                counted_at = self._count_workers(counted_at)
                self._submit_batches(queued, running, ended, item_seconds)
                if not running and not queued.has_next():
                    return
                ended_future = self._wait(ended)
                if ended_future is not None:
                    items = running.pop(ended_future)
                    yield from self._read_end(items, ended_future, queued, item_seconds)
        finally:
            for future in running:
                future.cancel()

    def _count_workers(self, counted_at: float) -> float:
        """Count the workers and the seconds for which they were connected.

        Args:
            counted_at: time of the last count.

        Returns:
            The time of this count.
        """
        n_workers = self._executor.count_workers()
        now = self._clock()
        self.stats.workers = n_workers
        self.stats.alive += n_workers * (now - counted_at)
        return now

    def _submit_batches(
        self,
        queued: _BatchQueue,
        running: dict[Future[Reply], Sequence[Any]],
        ended: queue.SimpleQueue[Future[Reply]],
        item_seconds: Sequence[float],
    ) -> None:
        """Give a batch to each worker that is free.

        Args:
            queued: queue of batches that wait for a worker.
            running: the items of each running batch, to which batches are added.
            ended: gets the futures of these batches when they end.
            item_seconds: seconds per item of the last batches.
        """
        while len(running) < self.stats.workers and queued.has_next():
            items = queued.take()
            deadline = self._deadline(len(items), item_seconds)
            future = self._executor.submit(run_batch, self._task, items, deadline)
            running[future] = items
            future.add_done_callback(ended.put)  # puts the future itself
        self.stats.max_running = max(self.stats.max_running, len(running))

    def _read_end(
        self,
        items: Sequence[Any],
        ended_future: Future[Reply],
        queued: _BatchQueue,
        item_seconds: deque[float],
    ) -> Iterator[BatchResult]:
        """Yield the result of a batch that has ended, or put it back into the queue.

        Args:
            items: items of the batch.
            ended_future: its future.
            queued: queue of batches that wait for a worker.
            item_seconds: seconds per item of the last batches; this one is added.
        """
        error = _get_error(ended_future)
        if error is not None:
            yield from self._handle_loss(items, error, queued)
            return
        reply = ended_future.result()
        item_seconds.append(reply.seconds / max(1, len(items)))
        yield self._read_reply(items, reply)

    def _handle_loss(
        self, items: Sequence[Any], error: BaseException, queued: _BatchQueue
    ) -> Iterator[BatchResult]:
        """Put a batch without a reply back into the queue, or give it up.

        A batch of several items is put back as single items if its workers died. For a
        single item whose workers died, a result without a value is yielded.

        Args:
            items: items of the batch.
            error: error that came instead of a reply.
            queued: queue of batches that wait for a worker.

        Raises:
            BaseException: `error`, if neither the executor nor a worker was lost.
        """
        if isinstance(error, BrokenExecutor):
            # The connection to the workers was lost; the batch itself is fine.
            self.stats.retried += 1
            queued.put_back(items)
            return
        if not isinstance(error, WorkerDiedError):
            raise error
        # It raises an error if too many workers die before any batch has finished.
        self._count_dead_start()
        if len(items) > 1:
            queued.put_back_singly(items)
        else:
            yield BatchResult(items, None, failure_reason=str(error))

    def _wait(self, ended: queue.SimpleQueue[Future[Reply]]) -> Future[Reply] | None:
        """Return a future that has ended; None if none ends within `POLL_SECONDS`."""
        try:
            return ended.get(timeout=POLL_SECONDS)
        except queue.Empty:
            return None

    def _deadline(self, n_items: int, item_seconds: Sequence[float]) -> float:
        """Return the seconds after which a batch counts as hanging.

        Its worker ends itself then. The deadline is a multiple of the time that the
        items would take at the median speed of the last batches. Before there are
        `MIN_BATCHES` of them, it is `LOAD_DEADLINE`. It is at least
        `task.min_timeout_seconds`, if the task states that time.

        Args:
            n_items: number of items of the batch.
            item_seconds: seconds per item of the last batches.
        """
        if len(item_seconds) < MIN_BATCHES:
            deadline = LOAD_DEADLINE
        else:
            deadline = max(
                MIN_DEADLINE,
                DEADLINE_FACTOR * n_items * statistics.median(item_seconds),
            )
        return max(deadline, self._task.min_timeout_seconds or 0.0)

    def _read_reply(self, items: Sequence[Any], reply: Reply) -> BatchResult:
        """Return the result in a worker's reply, and count its times and its machine.

        Args:
            items: items of the batch.
            reply: reply of the worker.

        Raises:
            RuntimeError: the worker's code raised an unexpected error.
            ClusterError: any other failure.
        """
        if reply.failure is Failure.BUG:
            raise RuntimeError(f"on {reply.worker}:\n{reply.error}")
        if reply.failure is not None:
            raise ClusterError(reply.error)
        self._count_times(reply)
        machine: str | None = digest_machine(reply.machine)
        if machine == self._this_machine:  # rows of this machine name no machine
            machine = None
        elif machine is not None:
            self._note_machine(machine, reply)
        return BatchResult(items, reply.value, reply.worker, machine)

    def _count_times(self, reply: Reply) -> None:
        """Add a batch and its times to the statistics of the workers."""
        self.stats.batches += 1
        self.stats.busy += reply.seconds
        self.stats.loading += reply.loading_seconds
        # `compute` adds all seconds for which workers are connected to `alive`. The
        # seconds of loading are subtracted again.
        self.stats.alive -= reply.loading_seconds

    def _note_machine(self, machine: str, reply: Reply) -> None:
        """Store and report a machine that differs from this one, at its first reply.

        Args:
            machine: digest of the machine's properties.
            reply: its reply, which has these properties.
        """
        if machine in self.stats.machines:
            return
        self.stats.machines = {**self.stats.machines, machine: reply.machine}
        description = ", ".join(f"{key} {text}" for key, text in reply.machine.items())
        self._report_message(
            f"{reply.worker} is another machine than this ({description}): "
            "last bits of rows may differ"
        )

    def _count_dead_start(self) -> None:
        """Count the death of a worker, and give up if no worker ever finished a batch.

        Workers that die from the beginning, for example while loading a scene that is
        too large, would otherwise be restarted without end.

        Raises:
            ClusterError: `MAX_DEAD_STARTS` workers died, and no batch was finished.
        """
        self._dead_starts += 1
        if self._dead_starts >= MAX_DEAD_STARTS and not self.stats.batches:
            raise ClusterError(
                f"{self._executor.description}: workers died of the first "
                f"{self._dead_starts} batches, and none was done; try it with "
                "workers=null, or see whether a worker has enough memory for the scene "
                "and the model"
            )


class _BatchQueue:
    """The batches that wait for a worker.

    Batches that were put back come first, then those of an iterable, which are taken
    from it when they are needed.
    """

    def __init__(self, batches: Iterable[Sequence[Any]]) -> None:
        self._source = iter(batches)
        self._waiting = deque[Sequence[Any]]()

    def has_next(self) -> bool:
        """Return whether there is a batch; it is taken from the iterable for that."""
        if not self._waiting:
            self._waiting.extend(islice(self._source, 1))
        return bool(self._waiting)

    def take(self) -> Sequence[Any]:
        """Return the next batch, which `has_next` has found, and remove it."""
        return self._waiting.popleft()

    def put_back(self, items: Sequence[Any]) -> None:
        """Make a batch the next one again."""
        self._waiting.appendleft(items)

    def put_back_singly(self, items: Sequence[Any]) -> None:
        """Make the items of a batch the next ones, in order, each a batch by itself."""
        for index in reversed(range(len(items))):
            self._waiting.appendleft(items[index : index + 1])


def _get_error(future: Future[Reply]) -> BaseException | None:
    """Return the error of a future that has ended; None if it has a result."""
    # a future is only cancelled if the connection of the executor is lost
    if future.cancelled():
        return BrokenExecutor()
    return future.exception()


@contextmanager
def open_workers(
    task: WorkerTask,
    *,
    workers: int | None,
    cluster: str | None,
    report_message: Callable[[str], None],
) -> Iterator[Workers | None]:
    """Open workers for a task, and end them after the block.

    Args:
        task: function and settings that the workers load.
        workers: number of processes; None for the default, which is one for each core
            on this machine.
        cluster: the cluster on which they run, such as the address of a scheduler;
            "local" or None for this machine.
        report_message: function that is called with messages for the user.

    Yields:
        The workers; None if neither `workers` nor `cluster` is set: then this process
        computes everything itself.
    """
    if workers is None and cluster is None:
        yield None
        return
    executor, task = _open_executor(task, workers, cluster, report_message)
    try:
        yield PoolWorkers(executor, task, report_message)
    finally:
        executor.shutdown(cancel_futures=True)


def _open_executor(
    task: WorkerTask,
    workers: int | None,
    cluster: str | None,
    report_message: Callable[[str], None],
) -> tuple[WorkerExecutor, WorkerTask]:
    """Return an executor on this machine or a cluster, and the task that it runs.

    The arguments are those of `open_workers`.
    """
    if cluster is None or cluster == LOCAL:
        return LocalExecutor(workers or threads.count_cores()), task
    executor_class = _find_executor_class(cluster)
    return executor_class.open(task, workers, cluster, report_message)


def _find_executor_class(cluster: str) -> type[ClusterExecutor]:
    """Return the class of the executor that reads a value of the setting `cluster`.

    Raises:
        InputError: there is none, or an entry that may read it cannot be imported.
    """
    for (
        name
    ) in CLUSTERS:  # one after the other, so that no more than needed are imported
        with suppress(InputError):
            executor_class = CLUSTERS[name]
            if executor_class.reads(cluster):
                return executor_class
    # An entry that cannot be imported raises its error here.
    values = [value for name in CLUSTERS for value in CLUSTERS[name].expected_values]
    if not values:
        raise InputError(
            "cluster: expected local, since no part of advsearch or of another package "
            f"that opens clusters is installed, got {cluster!r}"
        )
    *first_values, last_value = values
    expected = ", ".join([*first_values, LOCAL, f"or {last_value}"])
    raise InputError(f"cluster: expected {expected}, got {cluster!r}")
