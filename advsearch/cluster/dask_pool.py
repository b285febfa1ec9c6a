"""From what a user says (`workers`, `cluster`) to an executor over workers of Dask, in an event loop of its own. Relied
on (https://distributed.dask.org): the scheduler tells the topic "all" of each worker that it adds and removes; a call
that is pinned to a worker runs nowhere else; a nanny starts a worker that died again, at another address; processes are
spawned, and end with their parent."""

from __future__ import annotations

import ast
import asyncio
import hashlib
import importlib
import importlib.util
import json
import logging
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from advsearch import threads
from advsearch.cluster import Disconnected, Dropped, Ended, Event, Executor, Joined, Left, Work
from advsearch.cluster.coordinator import Coordinator
from advsearch.cluster.worker import Failure, read_files, this_machine, version
from advsearch.errors import ClusterError, FileFormatError, InputError
from advsearch.settings import read_yaml

CONNECT, RECONNECT = 30.0, 120.0
"""Seconds to find a scheduler at first, and to find it again when it has gone."""

LOOK = 0.5
"""Seconds between two looks at whether the scheduler is there."""

RESYNC = 10.0
"""Seconds between two looks at who is there: an event may get lost."""

RESTART = 20.0
"""Seconds that a worker may take to end."""

SILENT = logging.CRITICAL + 1
"""Level of Dask's log: what matters of it is said in a user's words, and a worker that dies is no error here."""

CONFIG = {
    "distributed.worker.multiprocessing-method": "spawn",  # a fork would share what Mitsuba and torch hold
    "distributed.scheduler.allowed-failures": 1_000_000,  # who died of what is counted by the coordinator
    "distributed.admin.large-graph-warning-threshold": "2GiB",  # files of a scene are sent once a worker
    "distributed.comm.timeouts.connect": "120s",  # a worker that starts on a busy machine takes its time,
    "distributed.comm.timeouts.tcp": "120s",  # and one that gives up is not started again,
    "distributed.deploy.lost-worker-timeout": "1h",  # nor is one that is not back after this
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.gil.enabled": False,
}


NO_WORKER = ("NoValidWorkerError", "NoWorkerError")
"""Errors by which a scheduler ends a call whose worker has not been there for long."""


@dataclass(frozen=True)
class Site:
    """Where workers are, in a user's words: the address of a scheduler that runs, or what starts a cluster and with how
    many workers (None: as it starts); and keywords of Dask's `Security`."""

    where: str
    address: str = ""
    start: Callable[..., Any] | None = None
    security: Mapping[str, object] | None = None
    count: int | None = None


def local(workers: int) -> Site:
    """Return the place of so many processes on this machine, which nobody else can reach."""

    def start(**more: Any) -> Any:
        # comes with the extra `dask`
        import distributed

        make: Any = distributed.LocalCluster
        return make(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=0,
            silence_logs=SILENT,
            env={"OMP_NUM_THREADS": "1"},
            **more,
        )

    return Site(f"{workers} workers on this machine", start=start)


class DaskPool:
    """See `pool.Pool`. Close it."""

    def __init__(self, place: Site) -> None:
        self.where, self.link = place.where, ""
        self._place = place
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._calls: dict[int, asyncio.Task[None]] = {}
        self._known: set[str] = set()
        self._client: Any = None
        self._cluster: Any = None
        self._watch: asyncio.Task[None] | None = None
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="cluster", daemon=True)
        self._thread.start()
        try:
            self._done(self._open(CONNECT))
        except BaseException:
            self.close()
            raise

    # ---- what the coordinator calls ---------------------------------------------------------------------------------

    def submit(self, ticket: int, worker: str, function: Callable[..., Any], *args: Any) -> None:

        def begin() -> None:
            self._calls[ticket] = self._loop.create_task(self._call(ticket, worker, function, args))

        self._loop.call_soon_threadsafe(begin)

    def forget(self, ticket: int) -> None:

        def cancel() -> None:
            if (call := self._calls.pop(ticket, None)) is not None:
                call.cancel()

        self._loop.call_soon_threadsafe(cancel)

    def restart(self, worker: str) -> None:
        """See `Pool.restart`; a worker without a nanny is only told to close."""
        self._begin(self._restart(worker))

    def events(self, seconds: float) -> list[Event]:
        found: list[Event] = []
        try:
            found.append(self._events.get(timeout=seconds))
            while True:
                found.append(self._events.get_nowait())
        except queue.Empty:
            return found

    def reconnect(self) -> None:
        self._done(self._leave())
        self._done(self._open(RECONNECT))

    def close(self) -> None:
        if self._loop.is_closed():
            return
        try:
            self._done(self._leave(), RESTART)
        except Exception:  # it was going anyway
            pass
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(RESTART)
        if not self._thread.is_alive():
            self._loop.close()

    # ---- in the loop ------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        """Run the loop; processes that it starts inherit that Ctrl-C, which a terminal sends to all, is ours alone."""
        resource_tracker.ensure_running()  # else it begins later, and lets the signal through again
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        self._loop.run_forever()

    def _begin(self, work: Any) -> Future[None]:
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def _done(self, work: Any, seconds: float | None = None) -> None:
        self._begin(work).result(seconds)

    async def _open(self, seconds: float) -> None:
        # comes with the extra `dask`
        import dask
        import distributed

        made: Any = distributed
        security = made.Security(**self._place.security) if self._place.security else None
        deadline = time.monotonic() + seconds
        dask.config.set(CONFIG)
        logging.getLogger("distributed").setLevel(SILENT)
        while True:
            try:
                if self._place.start is not None and self._cluster is None:
                    named = {} if security is None else {"security": security}
                    self._cluster = await self._place.start(asynchronous=True, **named)
                    if self._place.count is not None:
                        self._cluster.scale(self._place.count)
                self._client = await made.Client(
                    self._cluster or self._place.address,
                    asynchronous=True,
                    security=security,
                    timeout=max(1.0, min(CONNECT, deadline - time.monotonic())),
                    set_as_default=False,
                )
                self._known = set()
                self._client.subscribe_topic("all", self._told)
                await self._look_around()
                break
            except (OSError, TimeoutError, asyncio.TimeoutError, RuntimeError, ValueError) as error:
                if time.monotonic() >= deadline:
                    raise ClusterError(
                        f"{self.where}: there is no scheduler that answers ({error or type(error).__name__}); start "
                        "one with dask scheduler, check address and certificates, and go on with advsearch resume"
                    ) from error
                client, self._client = self._client, None
                await _close(client)
                for worker in self._known:  # that it was told of already
                    self._events.put(Left(worker, told=True))
                await asyncio.sleep(LOOK)
        drawn = importlib.util.find_spec("bokeh") is not None  # what Dask draws its pages with
        self.link = str(self._client.dashboard_link or "") if drawn else ""
        self._watch = self._loop.create_task(self._watching(self._client))

    async def _leave(self) -> None:
        """Let go of calls, client and cluster."""
        for call in (self._watch, *self._calls.values()):
            if call is not None:
                call.cancel()
        self._calls.clear()
        self._watch = None
        client, cluster, self._client, self._cluster = self._client, self._cluster, None, None
        if client is not None and client.status == "running":
            client.unsubscribe_topic("all")  # or the scheduler tells it of its own leaving
        await _close(client)
        await _close(cluster)

    async def _call(self, ticket: int, worker: str, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
        """Have a worker call a function, again where its answer was lost on the way, and tell what came of it."""
        client, event = self._client, None
        while event is None and client.status == "running":  # else all workers are gone, which `_watching` says
            future = client.submit(
                function, *args, workers=[worker], allow_other_workers=False, pure=False, retries=0, priority=-ticket
            )
            try:
                event = await self._outcome(ticket, future)
            finally:
                if client.status == "running":
                    future.release()
            if event is None:
                await asyncio.sleep(LOOK)
        self._calls.pop(ticket, None)
        if event is not None:
            self._events.put(event)

    async def _outcome(self, ticket: int, future: Any) -> Event | None:
        """Return what came of a call, or None where that was lost on the way.

        No type of an error tells the work from the way to it, but Dask's state does: a call that ended with an error
        has the state "error", by word of the scheduler. Whatever else is raised comes from fetching the answer, or from
        a future that was let go when a connection was lost.
        """
        # comes with the extra `dask`
        from distributed import KilledWorker

        try:
            return Ended(ticket, await future)
        except asyncio.CancelledError:
            if ticket not in self._calls:  # `forget` or `_leave`
                raise
            return None
        except KilledWorker as error:
            return Dropped(ticket, str(error))
        except Exception as error:
            its_own = future.status == "error" and type(error).__name__ not in NO_WORKER
            return Ended(ticket, _failure(error)) if its_own else None

    async def _restart(self, worker: str) -> None:
        client = self._client
        try:
            await asyncio.wait_for(
                client.restart_workers([worker], timeout=RESTART, raise_for_error=False), RESTART + LOOK
            )
        except Exception:  # it has no nanny, or that does not answer either
            try:
                await asyncio.wait_for(client.retire_workers([worker], close_workers=True), RESTART)
            except Exception:
                logging.getLogger(__name__).debug("%s could not be ended", worker, exc_info=True)

    def _told(self, event: tuple[float, Any]) -> None:
        _, message = event
        action = message.get("action") if isinstance(message, Mapping) else None
        if action == "add-worker":
            self._there(message["worker"])
        elif action == "remove-worker":
            self._known.discard(message["worker"])
            self._events.put(Left(message["worker"], told=bool(message.get("expected"))))

    def _there(self, worker: str) -> None:
        if worker not in self._known:
            self._known.add(worker)
            self._events.put(Joined(worker))

    async def _look_around(self) -> None:
        info = await self._client.scheduler.identity(n_workers=-1)
        there = set(info["workers"])
        for worker in self._known - there:
            self._events.put(Left(worker))
        self._known &= there
        for worker in there:
            self._there(worker)

    async def _watching(self, client: Any) -> None:
        looking = self._loop.create_task(self._looking_around())
        try:
            await scheduler_gone(client)
        finally:
            looking.cancel()
        self._events.put(Disconnected())

    async def _looking_around(self) -> None:
        while True:
            await asyncio.sleep(RESYNC)
            with suppress(Exception):  # slow; the next look will tell
                await asyncio.wait_for(self._look_around(), RESYNC)


async def _close(one: Any) -> None:
    """Close a client or a cluster, where there is one, whether or not its other end is there."""
    if one is None:
        return
    try:
        await asyncio.wait_for(one.close(), RESTART)
    except Exception:
        logging.getLogger(__name__).debug("closing %r failed", one, exc_info=True)


async def scheduler_gone(client: Any) -> None:
    """Wait until a client of Dask has lost its scheduler, also where it has found it again between two looks.

    A client that connects again does so by a connection of its own. What was under way is lost all the same.
    """
    connection = client.scheduler_comm
    while client.status == "running" and client.scheduler_comm is connection:
        await asyncio.sleep(LOOK)


def _failure(error: Exception) -> Failure:
    """What a call that raised comes to: nothing of ours does, so the worker could not even begin."""
    text = f"{type(error).__name__}: {error}"
    if isinstance(error, (ImportError, AttributeError)):
        return Failure(f"it cannot begin ({text}); install the same advsearch there", unfit=True)
    if isinstance(error, (OSError, MemoryError)):
        return Failure(f"it cannot begin ({text})", unfit=True)
    return Failure(text, trace=text)


LOCAL = "local"

SCHEMES = ("tcp://", "tls://", "ws://", "wss://")

CLASSES = {
    **dict.fromkeys(
        ("SLURMCluster", "PBSCluster", "LSFCluster", "SGECluster", "MoabCluster", "OARCluster", "HTCondorCluster"),
        "dask_jobqueue",
    ),
    "KubeCluster": "dask_kubernetes.operator",
}
"""Classes of clusters that a file may name, and where each is; anything else would be code that the file runs."""


@contextmanager
def executor_of(
    work: Work, *, workers: int | None, cluster: str | None, tell: Callable[[str], None]
) -> Iterator[Executor | None]:
    """Open an executor of a work for the block, on a cluster by its scheduler's address, "local", or a YAML file; None
    where everything is done in this process."""
    if workers is None and cluster is None:
        yield None
        return
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError("workers: needs Dask; pip install 'advsearch[dask]', or leave `workers` out") from None
    files = read_files(work)
    said = [work.function, work.settings, work.threads, sorted(files.named.items())]
    key = hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:32]
    place = place_of(workers, cluster)
    pool = DaskPool(place)
    try:
        if pool.link:
            tell(f"Dask shows its workers at {pool.link}")
        yield Coordinator(pool, work, key, files, version(), this_machine(), tell)
    finally:
        pool.close()


def check_main() -> None:
    """Check that workers on this machine can import the script that runs: each does, as `multiprocessing` has it, and
    would ask again what is asked outside of `if __name__ == "__main__":`."""
    main, name = sys.modules["__main__"], '`if __name__ == "__main__":`'
    spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    while frame is not None and not (frame.f_code.co_name == "<module>" and frame.f_globals is vars(main)):
        frame = frame.f_back
    if file is None or frame is None or (spec is not None and spec.name.endswith("__main__")):
        return
    try:
        tree = ast.parse(Path(file).read_text(encoding="utf-8"))
    except OSError:
        raise InputError(f"workers: expected a script that they can import, got {file}; put it into a file") from None
    except (ValueError, SyntaxError):
        return
    line, guards = frame.f_lineno, ("__name__", "parent_process", "current_process")
    for one in (node for node in ast.walk(tree) if isinstance(node, ast.If) and node.lineno <= line):
        leaves = any(isinstance(part, ast.NotEq) for part in ast.walk(one.test))  # where it is imported
        if (leaves or line <= (one.end_lineno or 0)) and any(guard in ast.unparse(one.test) for guard in guards):
            return
    raise InputError(
        f"workers: expected {file} to ask under {name}, got a call outside of it, in line {line}; put it there: "
        "every worker imports the script and would ask again"
    )


def place_of(workers: int | None, cluster: str | None) -> Site:
    """Return where so many workers are: of a scheduler's address, "local", or a YAML file; by default on this machine,
    one a core."""
    if cluster is None or cluster == LOCAL:
        check_main()
        return local(workers or threads.cores())
    if cluster.startswith(SCHEMES):
        if workers is not None:
            raise InputError("workers: the scheduler of `cluster` says how many there are; leave one of the two out")
        return Site(cluster, address=cluster)
    path = Path(cluster)
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(
            f"cluster: expected the address of a scheduler such as tcp://10.0.0.1:8786, local, or a .yaml file, got "
            f"{cluster!r}"
        )
    return _from_file(path, workers)


def _from_file(path: Path, workers: int | None) -> Site:
    said = read_yaml(path)
    unknown = sorted(set(said) - {"address", "class", "arguments", "workers", "security"})
    if unknown or ("address" in said) == ("class" in said):
        got = f"got {', '.join(map(str, unknown))}" if unknown else "got both or neither"
        raise FileFormatError(
            f"{path}: expected either address, or class with arguments and workers; beside it security; {got}"
        )
    security, arguments = (_mapping(path, said, name) for name in ("security", "arguments"))
    for name in ("tls_ca_file", "tls_client_cert", "tls_client_key", "tls_scheduler_cert", "tls_scheduler_key"):
        if isinstance(security.get(name), str):
            security[name] = str(path.parent / security[name])
    count = workers if workers is not None else said.get("workers")
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise FileFormatError(f"{path}: workers: expected a whole number of at least 1, got {count!r}")
    if "address" in said:
        if not str(said["address"]).startswith(SCHEMES):
            raise FileFormatError(f"{path}: address: expected tcp://HOST:PORT or tls://HOST:PORT")
        if count is not None:
            raise InputError("workers: the scheduler of `cluster` says how many there are; leave one of the two out")
        return Site(str(said["address"]), address=str(said["address"]), security=security or None)
    name = str(said["class"])
    if name not in CLASSES:
        raise FileFormatError(f"{path}: class: expected one of {', '.join(CLASSES)}, got {name!r}")
    module = CLASSES[name]
    try:
        found = getattr(importlib.import_module(module), name)
    except ImportError:
        package = module.partition(".")[0].replace("_", "-")
        raise InputError(f"cluster: {name} needs {package}; pip install {package}") from None
    return Site(name, start=lambda **more: found(**{**arguments, **more}), security=security or None, count=count or 1)


def _mapping(path: Path, said: Mapping[str, Any], name: str) -> dict[str, Any]:
    given = said.get(name) or {}
    if not isinstance(given, dict) or not all(isinstance(key, str) for key in given):
        raise FileFormatError(f"{path}: {name}: expected names and values, got {given!r}")
    return dict(given)
