"""Workers of a Dask scheduler, on other machines or this one. Relied on (https://distributed.dask.org): a call that is
pinned to a worker runs nowhere else; a nanny starts a worker that died again, at another address."""

from __future__ import annotations

import asyncio
import hashlib
import importlib
import importlib.util
import json
import logging
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from advsearch import threads
from advsearch.cluster import Executor, Pool, SchedulerGoneError, Work, WorkerDiedError
from advsearch.cluster.coordinator import Coordinator
from advsearch.cluster.worker import SERVING, Failure, Files, read_files, this_machine, version
from advsearch.errors import ClusterError, FileFormatError, InputError
from advsearch.settings import read_yaml

# ---------------------------------------------------------------------------------------------------------------------
# Workers of this machine: processes of their own, which answer over a pipe. Nothing listens, and no script is imported
# again. Ctrl-C, which a terminal sends to its own session, does not reach them; they end when this process does.

BEGIN = "import sys; sys.path[:] = sys.argv[1:]; from advsearch.cluster.worker import serve; serve()"
"""The path first, or a file in the current folder could stand for a module."""


class Process:
    """One worker, and a thread that waits for its answers."""

    def __init__(self) -> None:
        environ = {**os.environ, "OMP_NUM_THREADS": "1", SERVING: "1"}
        command = [sys.executable, "-c", BEGIN, *sys.path]
        self.popen = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environ, start_new_session=True
        )
        self.thread = ThreadPoolExecutor(1, "worker")

    def call(self, function: Callable[..., Any], *args: Any) -> Any:
        """Have it call a function of a module. Raises WorkerDiedError."""
        assert self.popen.stdin is not None and self.popen.stdout is not None
        asked = pickle.dumps((function, args))
        try:
            self.popen.stdin.write(asked)
            self.popen.stdin.flush()
            return pickle.load(self.popen.stdout)
        except (OSError, ValueError, EOFError, pickle.UnpicklingError) as error:  # the other end has gone
            self.end()
            raise WorkerDiedError from error

    def end(self) -> None:
        """Kill it; who waits for its answers hears that it has gone."""
        with suppress(OSError), self.popen:
            self.popen.kill()
        self.thread.shutdown(wait=False, cancel_futures=True)


class LocalPool:
    """A `Pool` of so many processes; one that has died is replaced."""

    def __init__(self, count: int) -> None:
        if SERVING in os.environ:
            raise InputError(
                "workers: a module that a worker imports asks for workers itself; put what it asks under "
                '`if __name__ == "__main__":`'
            )
        self.where, self.link = f"{count} workers on this machine", ""
        self.ended: SimpleQueue[Future[Any]] = SimpleQueue()
        self._count, self._made = count, 0
        self._processes: dict[str, Process] = {}

    def workers(self) -> Collection[str]:
        for name in [name for name, process in self._processes.items() if process.popen.poll() is not None]:
            self.restart(name)
        while len(self._processes) < self._count:
            self._made += 1
            self._processes[f"worker {self._made}"] = Process()
        return self._processes.keys()

    def submit(self, worker: str, function: Callable[..., Any], *args: Any) -> Future[Any]:
        process = self._processes[worker]
        return process.thread.submit(process.call, function, *args)

    def restart(self, worker: str) -> None:
        self._processes.pop(worker).end()

    def reconnect(self) -> None:
        """There is no scheduler that could go."""

    def close(self) -> None:
        for worker in list(self._processes):
            self.restart(worker)


CONNECT, RECONNECT = 30.0, 120.0  # seconds to find a scheduler at first, and to find it again when it has gone
LOOK = 0.5  # seconds between two tries to reach a scheduler
RESTART = 20.0  # seconds that a worker may take to end, and that a scheduler may take to say who is there

SILENT = logging.CRITICAL + 1
"""Level of Dask's log: what matters of it is said in a user's words, and a worker that dies is no error here."""

CONFIG = {
    "distributed.scheduler.allowed-failures": 1_000_000,  # who died of what is counted by the coordinator
    "distributed.admin.large-graph-warning-threshold": "2GiB",  # files of a scene are sent once a worker
    "distributed.comm.timeouts.connect": "120s",  # a worker that starts on a busy machine takes its time
    "distributed.comm.timeouts.tcp": "120s",
    "distributed.deploy.lost-worker-timeout": "1h",  # one that is not back after this is not started again
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.gil.enabled": False,
}

NO_WORKER = ("NoValidWorkerError", "NoWorkerError")  # that end a call whose worker is not there


@dataclass(frozen=True)
class Site:
    """Where workers are, in a user's words: the address of a scheduler that runs, or what starts a cluster and with how
    many workers (None: as it starts); and keywords of Dask's `Security`."""

    where: str
    address: str = ""
    start: Callable[..., Any] | None = None
    security: Mapping[str, object] | None = None
    count: int | None = None


class DaskPool:
    """See `Pool`. Close it."""

    def __init__(self, site: Site) -> None:
        self.where, self.link = site.where, ""
        self.ended: SimpleQueue[Future[Any]] = SimpleQueue()
        self._site = site
        self._client: Any = None
        self._cluster: Any = None
        self._connection: Any = None
        self._there: Collection[str] = ()
        self._calls: set[Future[Any]] = set()
        try:
            self._open(CONNECT)
        except BaseException:
            self.close()
            raise

    def _open(self, seconds: float) -> None:
        # comes with the extra `dask`
        import dask
        import distributed

        made: Any = distributed
        security = made.Security(**self._site.security) if self._site.security else None
        deadline = time.monotonic() + seconds
        dask.config.set(CONFIG)
        logging.getLogger("distributed").setLevel(SILENT)
        while True:
            try:
                if self._site.start is not None and self._cluster is None:
                    self._cluster = self._site.start(**({} if security is None else {"security": security}))
                    if self._site.count is not None:
                        self._cluster.scale(self._site.count)
                left = max(1.0, min(CONNECT, deadline - time.monotonic()))
                where = self._cluster or self._site.address
                self._client = made.Client(where, security=security, timeout=left, set_as_default=False)
                break
            except (OSError, TimeoutError, asyncio.TimeoutError, RuntimeError, ValueError) as error:
                if time.monotonic() >= deadline:
                    raise ClusterError(
                        f"{self.where}: there is no scheduler that answers ({error or type(error).__name__}); start "
                        "one with dask scheduler, check address and certificates, and go on with advsearch resume"
                    ) from error
                time.sleep(LOOK)
        self._connection, self._there = self._client.scheduler_comm, ()
        drawn = importlib.util.find_spec("bokeh") is not None  # what Dask draws its pages with
        self.link = str(self._client.dashboard_link or "") if drawn else ""

    def workers(self) -> Collection[str]:
        client = self._client
        # A client that connects again does so by a connection of its own. What was under way is lost all the same.
        if client.status != "running" or client.scheduler_comm is not self._connection:
            raise SchedulerGoneError
        with suppress(OSError, TimeoutError, asyncio.TimeoutError):  # slow, or going; the next look will tell
            self._there = client.sync(client.scheduler.ncores, callback_timeout=RESTART).keys()
        return self._there

    def submit(self, worker: str, function: Callable[..., Any], *args: Any) -> Future[Any]:
        future = self._begin(self._call(self._client, worker, function, args))
        self._calls.add(future)
        future.add_done_callback(self._calls.discard)
        return future

    def _begin(self, work: Any) -> Future[Any]:
        return asyncio.run_coroutine_threadsafe(work, self._client.loop.asyncio_loop)

    async def _call(self, client: Any, worker: str, function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
        """Have a worker call a function, again where its answer was lost on the way, and return what it answered.

        No type of an error tells the work from the way to it, but Dask's state does: a call that ended with an error
        has the state "error", by word of the scheduler. Whatever else is raised comes from fetching the answer, or from
        a future that was let go when a connection was lost.
        """
        # comes with the extra `dask`
        from distributed import KilledWorker

        while client.status == "running":
            future = client.submit(function, *args, workers=[worker], allow_other_workers=False, pure=False, retries=0)
            try:
                return await future
            except asyncio.CancelledError:
                if future.status != "cancelled":  # it is this call that nobody wants any more
                    raise
            except KilledWorker as error:
                raise WorkerDiedError(str(error)) from None
            except Exception as error:
                # nothing of ours raises, so the worker could not even begin
                if future.status == "error" and type(error).__name__ not in NO_WORKER:
                    text = f"{type(error).__name__}: {error}"
                    if not isinstance(error, (ImportError, AttributeError, OSError, MemoryError)):
                        return Failure(text, trace=text)
                    advice = "" if isinstance(error, (OSError, MemoryError)) else "; install the same advsearch there"
                    return Failure(f"it cannot begin ({text}){advice}", unfit=True)
            finally:
                if client.status == "running":
                    future.release()
            await asyncio.sleep(LOOK)
        raise asyncio.CancelledError  # all workers are gone, which `workers` says

    def restart(self, worker: str) -> None:
        """See `Pool.restart`; a worker without a nanny is only told to close."""
        self._begin(self._restart(self._client, worker))

    async def _restart(self, client: Any, worker: str) -> None:
        try:
            await asyncio.wait_for(
                client.restart_workers([worker], timeout=RESTART, raise_for_error=False), RESTART + LOOK
            )
        except Exception:  # it has no nanny, or that does not answer either
            with suppress(Exception):
                await asyncio.wait_for(client.retire_workers([worker], close_workers=True), RESTART)

    def reconnect(self) -> None:
        self.close()
        self._open(RECONNECT)

    def close(self) -> None:
        for call in list(self._calls):
            call.cancel()
        client, cluster, self._client, self._cluster = self._client, self._cluster, None, None
        for end in (client, cluster):
            if end is not None:
                with suppress(Exception):  # whether or not its other end is there
                    end.close(timeout=RESTART)


LOCAL = "local"
SCHEMES = ("tcp://", "tls://", "ws://", "wss://")

JOBS = ("SLURMCluster", "PBSCluster", "LSFCluster", "SGECluster", "MoabCluster", "OARCluster", "HTCondorCluster")
CLASSES = {**dict.fromkeys(JOBS, "dask_jobqueue"), "KubeCluster": "dask_kubernetes.operator"}
"""Classes of clusters that a file may name, and where each is; anything else would be code that the file runs."""


@contextmanager
def executor_of(
    work: Work, *, workers: int | None, cluster: str | None, tell: Callable[[str], None]
) -> Iterator[Executor | None]:
    """Open an executor of a work for the block: on processes of this machine, by default one a core, or on a cluster by
    its scheduler's address or a YAML file; None where everything is done in this process."""
    if workers is None and cluster is None:
        yield None
        return
    pool: Pool
    if cluster in (None, LOCAL):
        key, files, pool = "here", Files({}, {}), LocalPool(workers or threads.cores())
    else:
        site = site_of(workers, str(cluster))
        if importlib.util.find_spec("distributed") is None:
            raise InputError("cluster: needs Dask; pip install 'advsearch[dask]', or leave `cluster` out")
        files = read_files(work)
        asked = [work.function, work.settings, work.threads, sorted(files.digests.items())]
        key = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()[:32]
        pool = DaskPool(site)
    try:
        if pool.link:
            tell(f"Dask shows its workers at {pool.link}")
        yield Coordinator(pool, work, key, files, version(), this_machine(), tell)
    finally:
        pool.close()


def site_of(workers: int | None, cluster: str) -> Site:
    """Return where workers are, of a scheduler's address or a YAML file, and how many of them are wanted."""
    if cluster.startswith(SCHEMES):
        site = Site(cluster, address=cluster)
    elif cluster.endswith((".yaml", ".yml")):
        site = _from_file(Path(cluster), workers)
    else:
        raise InputError(
            f"cluster: expected the address of a scheduler such as tcp://10.0.0.1:8786, local, or a .yaml file, got "
            f"{cluster!r}"
        )
    if site.address and workers is not None:
        raise InputError("workers: the scheduler of `cluster` says how many there are; leave one of the two out")
    return site


def _from_file(path: Path, workers: int | None) -> Site:
    said: dict[str, Any] = read_yaml(path)
    unknown = sorted(set(said) - {"address", "class", "arguments", "workers", "security"})
    if unknown or ("address" in said) == ("class" in said):
        got = f"got {', '.join(map(str, unknown))}" if unknown else "got both or neither"
        expected = "expected either address, or class with arguments and workers; beside it security"
        raise FileFormatError(f"{path}: {expected}; {got}")
    for name in ("security", "arguments"):
        given = said.get(name) or {}
        if not isinstance(given, dict) or not all(isinstance(key, str) for key in given):
            raise FileFormatError(f"{path}: {name}: expected names and values, got {given!r}")
    security, arguments = {**(said.get("security") or {})}, said.get("arguments") or {}
    for name in ("tls_ca_file", "tls_client_cert", "tls_client_key", "tls_scheduler_cert", "tls_scheduler_key"):
        if isinstance(security.get(name), str):
            security[name] = str(path.parent / security[name])
    count = said.get("workers") if workers is None else workers
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise FileFormatError(f"{path}: workers: expected a whole number of at least 1, got {count!r}")
    if "address" in said:
        if not str(said["address"]).startswith(SCHEMES):
            raise FileFormatError(f"{path}: address: expected tcp://HOST:PORT or tls://HOST:PORT")
        if "workers" in said:
            raise FileFormatError(f"{path}: workers: the scheduler says how many there are; leave it out")
        return Site(str(said["address"]), address=str(said["address"]), security=security or None)
    name = str(said["class"])
    if name not in CLASSES:
        raise FileFormatError(f"{path}: class: expected one of {', '.join(CLASSES)}, got {name!r}")
    try:
        start = getattr(importlib.import_module(CLASSES[name]), name)
    except ImportError:
        package = CLASSES[name].partition(".")[0].replace("_", "-")
        raise InputError(f"cluster: {name} needs {package}; pip install {package}") from None
    return Site(name, start=partial(start, **arguments), security=security or None, count=count or 1)
