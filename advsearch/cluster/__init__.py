"""Work on several processors: batches, done here (`InProcess`) or by worker processes
(`workers.open_workers`).

Workers stand behind one interface, `concurrent.futures.Executor`: a pure function of a
module and picklable arguments go in, a future comes out. What a batch comes to depends
on the batch and the run's settings alone, so that anybody may do it, any number of
times.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any, Protocol

from advsearch.errors import ClusterError
from advsearch.files import JsonObject
from advsearch.trust.code import allowed_code

Call = Callable[[Sequence[Any]], Any]  # what does one batch; a pure function of it

DEATHS = 3  # workers that may die of a call before it is given up


@dataclass(frozen=True)
class WorkerTask:
    """What a worker does with batches, in a form that can be sent to it."""

    # "package.module:function", which takes the settings and returns a `Call`
    function: str
    settings: JsonObject
    # settings that may hold paths, separated by commas, whose files are sent along
    files: tuple[str, ...] = ()
    threads: int = 1  # for rendering, of a worker
    # that a batch may take at least; None: by the median of those before
    seconds: float | None = None
    # that a worker may import by its name, as this process
    code: tuple[str, ...] = field(default_factory=allowed_code)
    # SHA-256 of the files by path, for workers elsewhere
    digests: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class BatchResult:
    """What came of a batch, or of one item of a batch of which workers died."""

    items: Sequence[Any]
    value: Any  # what the call returned
    worker: str = ""  # who did it; empty in this process
    # by its name in `WorkerStats.machines`; None where it is like this one
    machine: str | None = None
    lost: str = ""  # why nothing came back, only of a single item

    def require_value(self, title: str) -> Any:
        """Return what the call returned.

        Raises:
            ClusterError: nothing came back; `title` says what was given out.
        """
        if self.lost:
            raise ClusterError(f"{title}: {self.lost}")
        return self.value


@dataclass
class WorkerStats:
    """How the workers did."""

    workers: int = 0  # that are there
    most: int = 0  # that had work at once, at most
    lost: int = 0  # that died
    refused: int = 0  # that cannot do it
    retried: int = 0  # batches that were given out again
    batches: int = 0  # that came back
    busy: float = 0.0  # seconds that workers were at batches
    loading: float = 0.0  # seconds that they loaded scenes and models
    alive: float = 0.0  # seconds that they were there, those of loading left out
    # that are not like this one, by name
    machines: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @property
    def told(self) -> dict[str, float | str]:
        """The same, beside a progress bar."""
        counts = {"lost": self.lost, "retried": self.retried}
        return {
            "workers": self.workers,
            **{name: count for name, count in counts.items() if count},
        }


class Workers(Protocol):
    """Does batches."""

    @property
    def facts(self) -> WorkerStats | None:
        """How the workers do; None where there are none."""

    def results(self, batches: Iterable[Sequence[Any]]) -> Iterator[BatchResult]:
        """Do batches, and yield what comes of them, in any order, each once.

        Only as many are taken from `batches` before their results are asked for as
        there are workers. Raises an AdvsearchError that a batch raises, or ClusterError
        where there is nobody to do it.
        """


class InProcess:
    """Does one batch after the other in this process."""

    facts: WorkerStats | None = None

    def __init__(self, call: Call) -> None:
        self._call = call

    def results(self, batches: Iterable[Sequence[Any]]) -> Iterator[BatchResult]:
        """See `Workers.results`; they come in order."""
        for items in batches:
            yield BatchResult(items, self._call(items))


class WorkerDiedError(Exception):
    """What a future ends with where `DEATHS` workers died of its call."""


class WorkerExecutor(Executor):
    """An executor that gives a call to another worker where one dies of it.

    A future ends with a WorkerDiedError where `DEATHS` died; with a BrokenExecutor or
    cancelled where the way to the workers was lost, so that the call has to be
    submitted again.
    """

    where: str  # what it is, in a user's words
    stats: WorkerStats

    @abstractmethod
    def count_workers(self) -> int:
        """Return how many calls can be under way now. Raises ClusterError where there
        has been no worker for long.
        """
