"""Compute batches of work in this process (`InProcess`) or by workers
(`workers.open_workers`).

All kinds of workers have the interface of `concurrent.futures.Executor`: `submit` takes
a pure function of a module and picklable arguments, and returns a future. The result of
a batch depends only on the batch and the settings of the run, so any worker may compute
it, and more than once.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

from advsearch.files import JsonObject
from advsearch.trust.code import allowed_code

# a pure function of a batch that computes its result
BatchFunction = Callable[[Sequence[Any]], Any]

MAX_DEATHS = 3  # number of workers that may die during a call before it fails


@dataclass(frozen=True)
class WorkerTask:
    """How workers compute batches, in a form that can be sent to them."""

    # "package.module:function", which takes the settings and returns a `BatchFunction`
    function_path: str
    settings: JsonObject
    # names of settings that may hold paths, separated by commas; these files are sent
    # to workers that lack them
    path_setting_names: tuple[str, ...] = ()
    threads: int = 1  # number of threads with which a worker renders
    # Seconds that a batch may take at least before its worker is stopped. None if the
    # limit depends only on the median of earlier batches.
    min_timeout_seconds: float | None = None
    # modules of the user that this process may import, and workers, too
    allowed_modules: tuple[str, ...] = field(default_factory=allowed_code)
    # SHA-256 of the files by path, for workers elsewhere
    digests: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class BatchResult:
    """The result of a batch, or of a single item during which workers died."""

    items: Sequence[Any]
    value: Any  # return value of the call
    worker: str = ""  # empty in this process
    # name in `WorkerStats.machines`; None if it is like this machine
    machine: str | None = None
    # Why there is no value; empty if there is one. Only a single item has no value.
    failure_reason: str = ""


@dataclass
class WorkerStats:
    """Counts and times of the workers of a run."""

    workers: int = 0  # number of workers that are connected now
    max_running: int = 0  # maximum number of batches that ran at the same time
    lost: int = 0  # number of workers that died or disconnected
    refused: int = 0  # number of workers that cannot do the task
    retried: int = 0  # number of batches that were submitted again
    batches: int = 0  # number of finished batches
    # Seconds, summed over all workers: computing batches, loading scenes and models,
    # and being connected (without loading).
    busy: float = 0.0
    loading: float = 0.0
    alive: float = 0.0
    # machines that differ from this one, by name
    machines: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @property
    def progress_counts(self) -> dict[str, float | str]:
        """Counts to display next to a progress bar."""
        counts: dict[str, float | str] = {"workers": self.workers}
        if self.lost:
            counts["lost"] = self.lost
        if self.retried:
            counts["retried"] = self.retried
        return counts


class Workers(Protocol):
    """Computes batches."""

    @property
    def stats(self) -> WorkerStats | None:
        """Counts and times of the workers, None without workers."""

    def compute(self, batches: Iterable[Sequence[Any]]) -> Iterator[BatchResult]:
        """Compute batches, and yield the result of each once, in any order.

        Batches are taken from the iterable as they are needed: never more than one for
        each worker before a result is requested.

        Raises:
            AdvsearchError: if a batch raises it.
            ClusterError: if there is no worker.
        """


class InProcess:
    """Computes batches one after the other in this process."""

    stats: WorkerStats | None = None

    def __init__(self, call: BatchFunction) -> None:
        self._call = call

    def compute(self, batches: Iterable[Sequence[Any]]) -> Iterator[BatchResult]:
        """Compute batches in order; see `Workers.compute`."""
        for items in batches:
            yield BatchResult(items, self._call(items))


class WorkerDiedError(Exception):
    """Raised by a future if `MAX_DEATHS` workers died during its call."""


class WorkerExecutor(Executor):
    """An executor that submits a call again if its worker dies.

    A future ends with a WorkerDiedError if `MAX_DEATHS` workers died. It ends with a
    BrokenExecutor, or is cancelled, if the connection to the workers was lost; then the
    call has to be submitted again.
    """

    description: str  # name for messages, such as "4 workers on this machine"
    stats: WorkerStats

    @abstractmethod
    def count_workers(self) -> int:
        """Return how many calls can run at once now.

        Raises:
            ClusterError: if there has been no worker for long.
        """


class ClusterExecutor(WorkerExecutor):
    """An executor on the workers of a cluster, which the setting `cluster` names.

    Other packages may add one (docs/extending.md).

    Attributes:
        expected_values: the values of `cluster` that it reads, for messages, such as "a
            .yaml file".
    """

    expected_values: ClassVar[tuple[str, ...]]

    @classmethod
    @abstractmethod
    def reads(cls, cluster: str) -> bool:
        """Return whether `open` reads a value of the setting `cluster`."""

    @classmethod
    @abstractmethod
    def open(
        cls,
        task: WorkerTask,
        n_workers: int | None,
        cluster: str,
        report_message: Callable[[str], None],
    ) -> tuple[WorkerExecutor, WorkerTask]:
        """Return an executor on a cluster, and the task that its workers run.

        Args:
            task: function and settings that the workers load.
            n_workers: number of workers to start, which is the setting `workers`; None
                for the default.
            cluster: the value of the setting `cluster`.
            report_message: function that is called with messages for the user.

        Raises:
            InputError: a setting is wrong, or a package is not installed.
            ClusterError: the cluster does not answer.
        """
