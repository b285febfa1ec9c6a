"""An executor on the workers of a Dask scheduler, on other machines or this one.

If a worker dies, Dask gives its call to another worker, and starts a new worker.
`Client.get_executor` is not used: its future never ends if fetching the result fails,
and it cannot exclude a worker with another version of advsearch. This module relies on
Dask to send a worker plugin also to workers that connect later
(https://distributed.dask.org).
"""

from __future__ import annotations

import asyncio
import importlib
import importlib.util
import logging
import time
import uuid
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Future
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from advsearch.extend import InputError, errors, settings, workers

# Maximum seconds to connect to a scheduler at first, and after the connection was lost.
CONNECT_SECONDS = 30.0
RECONNECT_SECONDS = 120.0
LOOK_SECONDS = 0.5  # seconds between two queries for the workers, and between retries
MAX_TRIES = 10  # maximum number of tries of a call that workers cannot start
# Maximum seconds for a reply of the scheduler, and for the end of a worker.
RESPONSE_SECONDS = 20.0

SILENT = logging.CRITICAL + 1
"""Level of Dask's log, which is above all levels. Errors are reported by this module,
and a worker that dies is no error here.
"""
CONFIG = {
    # A scheduler that was not started by this process has a limit of its own.
    "distributed.scheduler.allowed-failures": workers.MAX_DEATHS - 1,
    # a worker that starts on a busy machine may take long
    "distributed.comm.timeouts.connect": "120s",
    "distributed.comm.timeouts.tcp": "120s",
    # a lost worker that is not back after this time is not started again
    "distributed.deploy.lost-worker-timeout": "1h",
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.gil.enabled": False,
}

PATIENCE = 300.0
LESS_PATIENCE = 15.0
"""Seconds without a fit worker after which the run ends: `PATIENCE` if no worker is
connected, or `LESS_PATIENCE` if workers are connected that were refused.
"""

# Errors of Dask for a call whose worker has disconnected. The call is repeated.
NO_WORKER = ("NoValidWorkerError", "NoWorkerError")


@dataclass(frozen=True)
class ClusterSite:
    """Where workers run: at a running scheduler, or in a cluster to start.

    Attributes:
        description: name for messages.
        address: address of a running scheduler; empty if a cluster is started.
        start: function that starts a cluster; None if there is a scheduler.
        security: keywords of Dask's `Security`; None for no encryption.
        count: number of workers that the cluster starts with; None for its default.
    """

    description: str
    address: str = ""
    start: Callable[..., Any] | None = None
    security: Mapping[str, object] | None = None
    count: int | None = None


def make_file_plugin(contents: Mapping[str, bytes]) -> Any:
    """Return a plugin of Dask with which each worker writes the files of a task.

    Workers that connect later run it too.

    Args:
        contents: contents of the files, by path.
    """
    # comes with the extra `dask`
    from distributed import WorkerPlugin

    class SentFiles(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            # An error is ignored here: a worker that lacks files reports that when the
            # next call needs them.
            with suppress(OSError):
                workers.write_files(contents, workers.make_private_directory())

    return SentFiles()


def call_on_worker(function: Callable[..., Any], *args: Any) -> tuple[str, Any]:
    """Call a function on a worker; return the worker's address and the result."""
    # comes with the extra `dask`
    from distributed import get_worker

    return str(get_worker().address), function(*args)


class DaskExecutor(workers.ClusterExecutor):
    """An executor on a Dask cluster, see `ClusterExecutor`. It has to be shut down.

    A worker is fit if it can do the task. It is refused if it has another version of
    advsearch, or if a call showed that it cannot.
    """

    expected_values: ClassVar[tuple[str, ...]] = (
        "the address of a scheduler such as tcp://10.0.0.1:8786",
        "a .yaml file",
    )

    @classmethod
    def reads(cls, cluster: str) -> bool:
        return cluster.startswith(ADDRESS_SCHEMES) or cluster.endswith(FILE_SUFFIXES)

    @classmethod
    def open(
        cls,
        task: workers.WorkerTask,
        n_workers: int | None,
        cluster: str,
        report_message: Callable[[str], None],
    ) -> tuple[DaskExecutor, workers.WorkerTask]:
        """Return an executor on a cluster, and the task with the digests of its files.

        A worker compares the digests to check that it has the same files; see
        `ClusterExecutor.open`.

        Raises:
            InputError: Dask is not installed, or an argument is wrong.
            ClusterError: no scheduler answers.
        """
        site = parse_site(n_workers, cluster)
        if importlib.util.find_spec("distributed") is None:
            raise InputError(
                "cluster: needs Dask; pip install 'advsearch[dask]', or leave "
                "`cluster` out"
            )
        contents = workers.read_files(task)
        executor = cls(site, contents, report_message)
        return executor, replace(task, digests=workers.compute_digests(contents))

    def __init__(
        self,
        site: ClusterSite,
        contents: Mapping[str, bytes],
        report_message: Callable[[str], None],
    ) -> None:
        """Connect to the scheduler, or start the cluster.

        Args:
            site: the scheduler or the cluster on which the workers run.
            contents: contents of the task's files, by path, for workers that lack them.
            report_message: function that is called with messages for the user.

        Raises:
            ClusterError: no scheduler answers.
        """
        self.description = site.description
        self.stats = workers.WorkerStats()
        self._site = site
        self._contents = contents
        self._plugin_name = f"advsearch files {uuid.uuid4()}"
        self._report_message = report_message
        self._client: Any = None
        self._cluster: Any = None
        self._connection: Any = None
        # the sending of the files; None before it begins
        self._sending: asyncio.Future[Any] | None = None
        self._calls: set[Future[Any]] = set()
        # addresses of workers that get calls
        self._usable_addresses: frozenset[str] = frozenset()
        # why other workers get none, by their addresses
        self._refusal_by_address: dict[str, str] = {}
        # When the workers were last looked up. -inf stands for never, so that the first
        # count looks them up.
        self._looked_at = float("-inf")
        # when workers were last counted, and since when no fit worker is connected
        self._counted_at = self._alone_since = time.monotonic()
        try:
            self._open_connection(CONNECT_SECONDS)
        except BaseException:
            self.shutdown()
            raise

    def _open_connection(self, seconds: float) -> None:
        """Start the cluster if the site has one, and connect to its scheduler.

        Args:
            seconds: how long a failed connection is tried again.

        Raises:
            ClusterError: no scheduler answers.
        """
        # comes with the extra `dask`
        import dask
        import distributed

        untyped: Any = distributed  # the package has no types
        security = None
        if self._site.security:
            security = untyped.Security(**self._site.security)
        deadline = time.monotonic() + seconds
        dask.config.set(CONFIG)
        logging.getLogger("distributed").setLevel(SILENT)
        self._client = self._connect_until(security, deadline)
        # compared in `count_workers`, to notice that the client has connected again
        self._connection = self._client.scheduler_comm
        self._report_page()

    def _connect_until(self, security: Any, deadline: float) -> Any:
        """Return a client of the scheduler, which is tried until a deadline.

        `_connect` may fail early, as while a scheduler starts.

        Args:
            security: Dask's `Security` with the certificates; None for no encryption.
            deadline: time (`time.monotonic`) until which the scheduler may answer.

        Raises:
            ClusterError: no scheduler answers.
        """
        while True:
            try:
                return self._connect(security, deadline)
            # Dask raises these if nothing answers at the address, or if something other
            # than a scheduler answers.
            except (
                OSError,
                TimeoutError,
                asyncio.TimeoutError,
                RuntimeError,
                ValueError,
            ) as error:
                if time.monotonic() >= deadline:
                    raise self._make_connection_error(error) from error
                time.sleep(LOOK_SECONDS)

    def _make_connection_error(self, error: Exception) -> errors.ClusterError:
        """Return the error for a scheduler that does not answer."""
        return errors.ClusterError(
            f"{self.description}: there is no scheduler that answers "
            f"({error or type(error).__name__}); start one with dask "
            "scheduler, check address and certificates, and go on with "
            "advsearch resume"
        )

    def _report_page(self) -> None:
        """Report the address of Dask's page about the workers, if there is one."""
        # Dask draws its pages with bokeh; without it the link leads to an error.
        has_pages = importlib.util.find_spec("bokeh") is not None
        link = self._client.dashboard_link if has_pages else None
        if link:
            self._report_message(f"Dask shows its workers at {link}")

    def _connect(self, security: Any, deadline: float) -> Any:
        """Return a client of the scheduler; start the cluster first if that is due.

        Args:
            security: Dask's `Security` with the certificates; None for no encryption.
            deadline: time (`time.monotonic`) until which the scheduler may answer; at
                least one second from now is allowed.
        """
        import distributed  # late: an optional package, and it takes a second

        untyped: Any = distributed
        # started once, however often the connection is tried
        if self._cluster is None:
            self._start_cluster(security)
        seconds_left = min(CONNECT_SECONDS, deadline - time.monotonic())
        return untyped.Client(
            self._cluster or self._site.address,
            security=security,
            timeout=max(1.0, seconds_left),
            set_as_default=False,
        )

    def _start_cluster(self, security: Any) -> None:
        """Start the cluster of the site, if it has one, with its number of workers.

        Args:
            security: Dask's `Security` with the certificates; None for no encryption.
        """
        if self._site.start is None:
            return
        keywords = {} if security is None else {"security": security}
        self._cluster = self._site.start(**keywords)
        if self._site.count is not None:
            self._cluster.scale(self._site.count)

    # ---- who is there

    def count_workers(self) -> int:
        """Return how many workers can get calls now.

        The scheduler is asked for the workers every `LOOK_SECONDS`. If the connection
        was lost, this method connects again first.

        Raises:
            ClusterError: there has been no such worker for too long.
        """
        now = time.monotonic()
        if now - self._looked_at >= LOOK_SECONDS:
            self._look_for_workers()
        # The time without fit workers begins now if there is one now, or if this method
        # was not called for so long that workers may have come and gone.
        was_long_ago = now - self._counted_at > LESS_PATIENCE
        if self._usable_addresses or was_long_ago:
            self._alone_since = now
        self._check_waiting_time(now)
        self._counted_at = time.monotonic()
        return len(self._usable_addresses)

    def _look_for_workers(self) -> None:
        """Connect again if the connection was lost, and look up the workers."""
        client = self._client
        # A client may connect again by itself. Then it is running, but with another
        # connection, and the calls that were running are lost.
        is_connected = (
            client.status == "running" and client.scheduler_comm is self._connection
        )
        if not is_connected:
            self._reconnect()
        # A scheduler that does not answer is slow or about to end. The next look will
        # show which, so the old count is used until then.
        with suppress(OSError, TimeoutError, asyncio.TimeoutError):
            self._update_workers()
        self._looked_at = time.monotonic()

    def _update_workers(self) -> None:
        """Ask the scheduler which workers are connected, and sort them.

        Workers that have disconnected are counted as lost. New workers get calls if
        they have the same version of advsearch. Otherwise they are refused, and the
        reason is stored.
        """
        client = self._client
        connected = _read_connected_addresses(client)
        self.stats.lost += len(self._usable_addresses - connected)
        self._refusal_by_address = {
            address: reason
            for address, reason in self._refusal_by_address.items()
            if address in connected
        }
        fit = self._usable_addresses & connected
        new = connected - fit - set(self._refusal_by_address)
        fit |= self._sort_new_workers(client, new)
        # A call that ran during these queries may have refused a worker that was fit.
        self._usable_addresses = fit - set(self._refusal_by_address)

    def _sort_new_workers(self, client: Any, new: frozenset[str]) -> frozenset[str]:
        """Return the new workers that have our version of advsearch; refuse the others.

        Args:
            client: client of the connection that was used.
            new: addresses of workers.
        """
        if not new:
            return frozenset()
        versions = client.sync(
            self._versions, sorted(new), callback_timeout=RESPONSE_SECONDS
        )
        fit = frozenset[str]()
        for address, version in versions.items():
            if version == workers.compute_version():
                fit |= {address}
            else:
                self._refuse_version(address, version)
        return fit

    def _refuse_version(self, address: str, version: Any) -> None:
        """Refuse a worker that has another version of advsearch, or none.

        Args:
            address: address of the worker.
            version: its version, or the error that reading the version raised. An
                ImportError or AttributeError means that advsearch is missing or old.
                After any other error, such as that of a slow worker, the version is
                read again later.
        """
        if isinstance(version, str):
            self._refuse(
                address,
                f"it has advsearch {version}, and {workers.compute_version()} asks; "
                "install the same on both",
            )
        elif isinstance(version, (ImportError, AttributeError)):
            self._refuse(
                address,
                f"it cannot begin ({version}); install the same advsearch there",
            )

    async def _versions(self, addresses: list[str]) -> dict[str, Any]:
        """Return the version of advsearch of each worker by address, or the error of a
        worker that fails.
        """
        versions: dict[str, Any] = await self._client.run(
            workers.compute_version, workers=addresses, on_error="return"
        )
        return versions

    def _refuse(self, address: str, reason: str) -> None:
        """Give a worker no more calls, and report why, once."""
        self._usable_addresses -= {address}
        if address not in self._refusal_by_address:
            self._refusal_by_address[address] = reason
            self.stats.refused += 1
            self._report_message(f"{address} is given nothing: {reason}")

    def _check_waiting_time(self, now: float) -> None:
        """Raise ClusterError if there has been no fit worker for too long.

        The wait is shorter if workers are connected and were refused, since these will
        not become fit. If a fit worker is connected, `_alone_since` is recent.

        Args:
            now: time (`time.monotonic`) of this check.
        """
        patience = LESS_PATIENCE if self._refusal_by_address else PATIENCE
        if now - self._alone_since > patience:
            reasons = "; ".join(dict.fromkeys(self._refusal_by_address.values()))
            remark = f" ({reasons})" if reasons else ""
            raise errors.ClusterError(
                f"{self.description}: there was no worker that can do it for "
                f"{patience:.0f} s{remark}; what was stored is kept, so that the run can "
                "go on with advsearch resume"
            )

    def _reconnect(self) -> None:
        """Connect to the scheduler again.

        It may be a new scheduler with other workers. So the fit and the refused workers
        are forgotten, and files will be sent again.
        """
        self._report_message(
            f"{self.description}: the scheduler has gone; what was under way will be "
            "done again"
        )
        self.shutdown()
        self._usable_addresses = frozenset()
        self._refusal_by_address = {}
        self._sending = None
        self._open_connection(RECONNECT_SECONDS)
        self._alone_since = time.monotonic()

    # ---- calls

    def submit(
        self, function: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """Schedule a call of a module's function with positional arguments."""
        if kwargs:
            raise TypeError("a worker takes positional arguments only")
        call = self._call(self._client, function, args)
        future = asyncio.run_coroutine_threadsafe(call, self._client.loop.asyncio_loop)
        self._calls.add(future)
        future.add_done_callback(self._calls.discard)
        return future

    async def _call(
        self, client: Any, function: Callable[..., Any], args: tuple[Any, ...]
    ) -> Any:
        """Run a function on a worker and return its result.

        It is run again if the result was lost, or if the worker turned out to be unfit.

        Args:
            client: client of the connection that is open now.
            function: function to call.
            args: its positional arguments.

        Raises:
            WorkerDiedError: too many workers died during the call.
            ClusterError: workers cannot even begin it.
            BrokenExecutor: the connection to the scheduler is gone.
        """
        # comes with the extra `dask`
        from distributed import KilledWorker

        failed_starts = 0
        while client.status == "running":
            addresses = sorted(self._usable_addresses)
            future = _submit_call(client, function, args, addresses)
            try:
                result = await self._wait_for_accepted(client, future, addresses)
                if result is not None:
                    return result[1]
            except asyncio.CancelledError:
                # Dask cancels the future of a lost worker: then the call is repeated.
                # If asyncio cancels this call, its result is not needed any more.
                if future.status != "cancelled":
                    raise
            except KilledWorker:
                raise workers.WorkerDiedError(
                    f"no answer: {workers.MAX_DEATHS} workers died of it"
                ) from None
            except Exception as error:
                if _shows_failed_start(error, future):
                    failed_starts += 1
                    if failed_starts == MAX_TRIES:
                        raise self._make_start_error(error) from error
            finally:
                if client.status == "running":  # the scheduler may forget the call
                    future.release()
            # The call is repeated: its worker or its result was lost, or the worker was
            # unfit.
            self.stats.retried += 1
            await asyncio.sleep(LOOK_SECONDS)
        raise BrokenExecutor(f"{self.description}: the scheduler has gone")

    async def _wait_for_accepted(
        self, client: Any, future: Any, addresses: list[str]
    ) -> tuple[str, Any] | None:
        """Return the address of a call's worker and its value, if the reply is accepted.

        Args:
            client: client of the connection that was used.
            future: Dask's future of the call.
            addresses: addresses of the workers that may run it.

        Returns:
            None if all workers have disconnected, or if the worker was unfit.
        """
        result = await self._wait(future, addresses)
        if result is None:
            return None
        address, value = result
        is_rejected = await self._rejects_reply(client, address, value)
        return None if is_rejected else result

    def _make_start_error(self, error: Exception) -> errors.ClusterError:
        """Return the error for a call that workers cannot begin."""
        text = f"{type(error).__name__}: {error}"
        return errors.ClusterError(
            f"{self.description}: a worker cannot begin ({text})"
        )

    async def _wait(self, future: Any, addresses: list[str]) -> tuple[str, Any] | None:
        """Wait for a future of Dask, as long as a worker that may run it is left.

        Args:
            future: the future.
            addresses: addresses of the workers that may run it.

        Returns:
            The address of the worker and the value; None if all workers are gone.
        """

        async def fetch() -> tuple[str, Any]:
            result: tuple[str, Any] = await future
            return result

        fetching = asyncio.ensure_future(fetch())
        try:
            while True:
                done, _ = await asyncio.wait([fetching], timeout=LOOK_SECONDS)
                if done:
                    return fetching.result()
                if not self._usable_addresses.intersection(addresses):
                    return None
        finally:
            fetching.cancel()

    async def _rejects_reply(self, client: Any, address: str, value: Any) -> bool:
        """Send missing files or refuse an unfit worker, and return whether either was
        necessary.

        Then the call has to be run again. Files are sent if the worker lacks them and
        they were not sent yet. Otherwise a worker that is unfit or lacks files is
        refused, and another one gets the call.

        Args:
            client: client of the connection that was used.
            address: address of the worker.
            value: value that the call returned, a `Reply` for batches.
        """
        failure = value.failure if isinstance(value, workers.Reply) else None
        # Another call may be sending them now; then `_send_files` waits for it.
        were_files_sent = self._sending is not None and self._sending.done()
        if failure is workers.Failure.MISSING_FILES and not were_files_sent:
            await self._send_files(client)
            return True
        # A worker that still lacks files could not write those that were sent.
        if failure in (workers.Failure.UNFIT, workers.Failure.MISSING_FILES):
            self._refuse(address, value.error)
            return True
        return False

    async def _send_files(self, client: Any) -> None:
        """Send the files to all workers, or wait until another call has sent them."""
        if self._sending is None:
            sending = client.register_plugin(
                make_file_plugin(self._contents), name=self._plugin_name
            )
            self._sending = asyncio.ensure_future(sending)
        # Errors are ignored here: a worker that could not write the files replies
        # `MISSING_FILES` to its next call.
        with suppress(Exception):
            await asyncio.shield(self._sending)

    async def _forget_files(self, client: Any) -> None:
        """Tell the scheduler not to send the files to further workers."""
        await client.unregister_worker_plugin(name=self._plugin_name)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:
        """End all calls, remove the files that were sent, and disconnect.

        Workers that this executor started end; others stay. The arguments of
        `concurrent.futures.Executor` have no effect: all calls are cancelled.
        """
        for call in list(self._calls):
            call.cancel()
        client = self._client
        cluster = self._cluster
        self._remove_sent_files(client)
        self._client = self._cluster = None
        for connection in (client, cluster):
            if connection is not None:
                with suppress(Exception):  # the other end may have gone
                    connection.close(timeout=RESPONSE_SECONDS)

    def _remove_sent_files(self, client: Any) -> None:
        """Let the scheduler forget the files, if they were sent and it is connected.

        Args:
            client: client of the connection; None without one.
        """
        is_connected = client is not None and client.status == "running"
        if is_connected and self._sending is not None:  # files were sent
            with suppress(Exception):
                client.sync(
                    self._forget_files, client, callback_timeout=RESPONSE_SECONDS
                )


def _read_connected_addresses(client: Any) -> frozenset[str]:
    """Return the addresses of the workers that the scheduler is connected to.

    Args:
        client: client of the connection to the scheduler.
    """
    # the keys: `ncores` returns the number of cores of each worker by its address
    return frozenset(
        client.sync(client.scheduler.ncores, callback_timeout=RESPONSE_SECONDS)
    )


def _submit_call(
    client: Any,
    function: Callable[..., Any],
    args: tuple[Any, ...],
    addresses: list[str],
) -> Any:
    """Return Dask's future of a call that one of some workers shall run, once.

    Args:
        client: client of the connection that is open now.
        function: function to call.
        args: its positional arguments.
        addresses: addresses of the workers.
    """
    return client.submit(
        call_on_worker,
        function,
        *args,
        workers=addresses,
        allow_other_workers=False,
        pure=False,
        retries=0,
    )


def _shows_failed_start(error: Exception, future: Any) -> bool:
    """Return whether an error of a call means that its worker could not begin it.

    For instance, it could not import the function: `run_batch` catches errors of the
    call itself and returns them in its reply. Other errors mean that the worker or the
    result was lost: then the call is repeated.
    """
    is_worker_lost = type(error).__name__ in NO_WORKER
    return future.status == "error" and not is_worker_lost


ADDRESS_SCHEMES = ("tcp://", "tls://", "ws://", "wss://")
FILE_SUFFIXES = (".yaml", ".yml")

JOBS = (
    "SLURMCluster",
    "PBSCluster",
    "LSFCluster",
    "SGECluster",
    "MoabCluster",
    "OARCluster",
    "HTCondorCluster",
)
CLUSTER_CLASSES = {
    **dict.fromkeys(JOBS, "dask_jobqueue"),
    "KubeCluster": "dask_kubernetes.operator",
}
"""Classes of clusters that a file may name, with the module of each. Others are
rejected: with an arbitrary class, a file could run arbitrary code.
"""


def parse_site(n_workers: int | None, cluster: str) -> ClusterSite:
    """Return the scheduler or the cluster on which workers run.

    Args:
        n_workers: number of workers to start; None for the default.
        cluster: address of a scheduler, such as "tcp://10.0.0.1:8786", or path of a
            YAML file that describes the cluster.

    Raises:
        FileFormatError: the file has wrong or contradictory entries.
        InputError: `workers` is set although the scheduler has workers already, or a
            package for the cluster is not installed.
    """
    if cluster.startswith(ADDRESS_SCHEMES):
        site = ClusterSite(cluster, address=cluster)
    else:
        site = _read_site(Path(cluster), n_workers)
    _check_no_worker_number(site, n_workers)
    return site


def _check_no_worker_number(site: ClusterSite, n_workers: int | None) -> None:
    """Check that no number of workers is set for a scheduler, which has workers.

    Args:
        site: the scheduler or the cluster.
        n_workers: number of workers to start; None if it is not set.

    Raises:
        InputError: it is.
    """
    if site.address and n_workers is not None:
        raise InputError(
            "workers: the scheduler of `cluster` says how many there are; "
            "leave one of the two out"
        )


def _read_site(path: Path, n_workers: int | None) -> ClusterSite:
    """Read where workers run from a YAML file.

    Args:
        path: path of the file.
        n_workers: number of workers to start; None for the number in the file. Ignored
            for the address of a scheduler, whose workers run already.

    Raises:
        FileFormatError: the file has wrong or contradictory entries.
        InputError: a package for the cluster is not installed.
    """
    entries: dict[str, Any] = settings.read_yaml(path)
    _check_entries(path, entries)
    security = _read_security(path, entries)
    count = entries.get("workers") if n_workers is None else n_workers
    _check_worker_count(path, count)
    if "address" in entries:
        return _read_scheduler(path, entries, security)
    name = str(entries["class"])
    start = partial(_import_cluster(path, name), **(entries.get("arguments") or {}))
    count = 1 if count is None else count
    return ClusterSite(name, start=start, security=security, count=count)


def _check_worker_count(path: Path, count: object) -> None:
    """Check the number of workers of a cluster file; None, for the default, is right.

    Raises:
        FileFormatError: it is no whole number of at least 1.
    """
    is_count = isinstance(count, int) and not isinstance(count, bool) and count >= 1
    if count is not None and not is_count:
        raise errors.FileFormatError(
            f"{path}: workers: expected a whole number of at least 1, got {count!r}"
        )


def _read_security(path: Path, entries: dict[str, Any]) -> dict[str, object] | None:
    """Return the keywords of Dask's `Security` in a cluster file; None for none.

    Paths of certificates and keys are relative to the file, and become full paths.

    Args:
        path: path of the cluster file.
        entries: its content.
    """
    security = {**(entries.get("security") or {})}
    for name in (
        "tls_ca_file",
        "tls_client_cert",
        "tls_client_key",
        "tls_scheduler_cert",
        "tls_scheduler_key",
    ):
        if isinstance(security.get(name), str):
            security[name] = str(path.parent / security[name])
    return security or None


def _read_scheduler(
    path: Path, entries: dict[str, Any], security: dict[str, object] | None
) -> ClusterSite:
    """Return the scheduler that a cluster file names by its address.

    Args:
        path: path of the cluster file, for errors.
        entries: its content.
        security: keywords of Dask's `Security`; None for none.

    Raises:
        FileFormatError: the address has another form, or the file also has a number of
            workers.
    """
    address = str(entries["address"])
    if not address.startswith(ADDRESS_SCHEMES):
        raise errors.FileFormatError(
            f"{path}: address: expected tcp://HOST:PORT or tls://HOST:PORT"
        )
    if "workers" in entries:
        raise errors.FileFormatError(
            f"{path}: workers: the workers of a scheduler run already; leave it out"
        )
    return ClusterSite(address, address=address, security=security)


def _check_entries(path: Path, entries: dict[str, Any]) -> None:
    """Check the names and types of the entries of a cluster file.

    A file has either "address" (of a scheduler that runs), or "class" (of a cluster to
    start); "security" and "arguments" are mappings.

    Raises:
        FileFormatError: an entry is unknown, missing or of another type.
    """
    _check_entry_names(path, entries)
    for name in ("security", "arguments"):
        mapping = entries.get(name) or {}
        is_mapping = isinstance(mapping, dict)
        if not is_mapping or not all(isinstance(key, str) for key in mapping):
            raise errors.FileFormatError(
                f"{path}: {name}: expected names and values, got {mapping!r}"
            )


def _check_entry_names(path: Path, entries: dict[str, Any]) -> None:
    """Check that a cluster file has known entries, and "address" or "class".

    Raises:
        FileFormatError: an entry is unknown, or both or neither of the two are there.
    """
    known = {"address", "class", "arguments", "workers", "security"}
    unknown = sorted(set(entries) - known)
    has_both_or_neither = ("address" in entries) == ("class" in entries)
    if unknown or has_both_or_neither:
        got = "got both or neither"
        if unknown:
            got = f"got {', '.join(map(str, unknown))}"
        expected = (
            "expected either address, or class with arguments and workers; either "
            "may have security"
        )
        raise errors.FileFormatError(f"{path}: {expected}; {got}")


def _import_cluster(path: Path, name: str) -> Any:
    """Import one of the classes in `CLUSTER_CLASSES`, which start a cluster of Dask.

    Raises:
        FileFormatError: there is no such class.
        InputError: its package is not installed.
    """
    if name not in CLUSTER_CLASSES:
        raise errors.FileFormatError(
            f"{path}: class: expected one of {', '.join(CLUSTER_CLASSES)}, got {name!r}"
        )
    try:
        return getattr(importlib.import_module(CLUSTER_CLASSES[name]), name)
    except ImportError:
        package = CLUSTER_CLASSES[name].partition(".")[0].replace("_", "-")
        raise InputError(
            f"cluster: {name} needs {package}; pip install {package}"
        ) from None
