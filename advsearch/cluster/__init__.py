"""Work on many processors: batches carried out by an `Executor`, in this process (`InProcess`), or on a `Pool` of
workers (`coordinator.Coordinator`). Anybody may do it, any number of times: it depends on the batch and the run's
settings alone."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any, Protocol

from advsearch.files import JsonObject
from advsearch.trust.code import allowed_code

Call = Callable[[Sequence[Any]], Any]  # what carries out one batch; a pure function of it


@dataclass(frozen=True)
class Work:
    """What batches are of, so that another process can carry them out: ``"package.module:function"``, which takes the
    settings and returns a `Call`; which settings may hold paths, separated by commas, whose files go along; processor
    threads of a worker; seconds that a batch may take at least (None: by the median); and the code that a worker may
    import by its name, as this process."""

    function: str
    settings: JsonObject
    files: tuple[str, ...] = ()
    threads: int = 1
    seconds: float | None = None
    code: tuple[str, ...] = field(default_factory=allowed_code)


@dataclass(frozen=True, eq=False)
class Done:
    """What came of one batch, or of a part of one that workers died of; what the call returned; who carried it out,
    empty in this process; what machine that is, by its name in `Workforce.machines`, None where it is like this one;
    and why nothing came back, only of batches of one item."""

    items: Sequence[Any]
    value: Any
    worker: str = ""
    machine: str | None = None
    lost: str = ""


@dataclass
class Workforce:
    """How the workers did: those that are ready, at once at most, died, and cannot do the work; batches that were given
    out again and came back; seconds spent on batches, on getting ready, and ready; machines that are not like this one,
    by name, and the link of a page that shows the workers."""

    workers: int = 0
    most: int = 0
    lost: int = 0
    refused: int = 0
    retried: int = 0
    batches: int = 0
    busy: float = 0.0
    loading: float = 0.0
    alive: float = 0.0
    machines: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    link: str = ""

    @property
    def told(self) -> dict[str, float | str]:
        counts = {"lost": self.lost, "retried": self.retried}
        return {"workers": self.workers, **{name: count for name, count in counts.items() if count}}


class Executor(Protocol):
    """Carries out batches."""

    @property
    def facts(self) -> Workforce | None:
        """How the workers do; None where there are none."""

    def results(self, batches: Iterable[Sequence[Any]]) -> Iterator[Done]:
        """Carry out batches, and yield what comes of them, in any order, each once; an AdvsearchError is what one
        raises, or that nobody can. Only a few are taken from `batches` before their results are asked for. Where nobody
        goes on asking, what is under way comes to nothing, and other batches may follow."""


class InProcess:
    """Carries out one batch after the other in this process."""

    facts: Workforce | None = None

    def __init__(self, call: Call) -> None:
        self._call = call

    def results(self, batches: Iterable[Sequence[Any]]) -> Iterator[Done]:
        """See `Executor.results`; they come in order."""
        for items in batches:
            yield Done(items, self._call(items))


class WorkerDiedError(Exception):
    """What the future of a call ends with whose worker has gone."""


class SchedulerGoneError(Exception):
    """The scheduler of a pool has gone, and all workers and calls with it."""


class Pool(Protocol):
    """Workers, each of which does one call at a time."""

    where: str  # what it is, in a user's words

    link: str  # of a page that shows the workers; empty where there is none

    @property
    def ended(self) -> SimpleQueue[Future[Any]]:
        """Futures of calls that have ended, put there by who submitted them."""

    def workers(self) -> Collection[str]:
        """Return the addresses of the workers that are there. Raises SchedulerGoneError."""

    def submit(self, worker: str, function: Callable[..., Any], *args: Any) -> Future[Any]:
        """Have a worker call a function of a module. The future ends with a WorkerDiedError or never if it dies."""

    def restart(self, worker: str) -> None:
        """End a worker that does not answer; another may stand in its place, at another address."""

    def reconnect(self) -> None:
        """Find the scheduler again, or start another. Raises ClusterError where there is none."""

    def close(self) -> None:
        """Let the workers go, those that were started for this pool for ever."""
