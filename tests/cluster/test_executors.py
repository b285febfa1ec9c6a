"""Real workers: processes of this machine, and a scheduler and workers of Dask that were started by themselves."""

import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from advsearch import registry
from advsearch.cluster import ClusterExecutor, WorkerDiedError, Workers, WorkerStats, WorkerTask
from advsearch.cluster.dask_executor import CLUSTER_CLASSES, MAX_TRIES, DaskExecutor, parse_site
from advsearch.cluster.local import LocalExecutor
from advsearch.cluster.worker import Failure, Reply, compute_version, run_batch
from advsearch.cluster.workers import CLUSTERS, open_workers
from advsearch.errors import ClusterError, FileFormatError, InputError
from conftest import ROOT

pytestmark = pytest.mark.island("advsearch.cluster.dask_executor")

psutil: Any = import_module("psutil")  # which Dask brings along
dask: Any = import_module("dask")
distributed: Any = import_module(
    "distributed"
)  # first: what it adds to the configuration would go again with what a test sets there
scheduling: Any = import_module("distributed.scheduler")
SCRIPTS = Path(sys.executable).parent


def pieces(count: int) -> Iterator[range]:
    return (range(first, first + 2) for first in range(0, count, 2))


def check(executor: Workers | None, count: int, added: int = 0) -> None:
    """All numbers come back once and squared."""
    assert executor is not None
    found = {n: v for done in executor.compute(pieces(count)) for n, v in zip(done.items, done.value, strict=True)}
    assert found == {number: number * number + added for number in range(count)}


def own_workers() -> list[Any]:
    """The processes of workers that this one has started."""
    return [one for one in psutil.Process().children() if "serve()" in " ".join(one.cmdline())]


@pytest.mark.medium
def test_processes_of_this_machine_are_killed_and_nothing_is_lost(capfd: pytest.CaptureFixture[str]) -> None:
    """They listen nowhere, Ctrl-C in a terminal passes by them, and a number of which each dies is said."""
    work = WorkerTask("cluster_work:squares", {"seconds": 0.01, "deadly": [301], "prints": True})
    with open_workers(work, workers=2, cluster=None, report_message=print) as executor:
        assert executor is not None
        seen: dict[int, Any] = {}
        lost: dict[int, str] = {}
        for count, done in enumerate(executor.compute(pieces(400))):
            seen |= dict.fromkeys(done.items, done.value)
            lost |= {done.items[0]: done.failure_reason} if done.failure_reason else {}
            if count == 20:
                workers = own_workers()
                assert len(workers) == 2 and not [c for one in workers for c in one.net_connections()]
                assert all(os.getsid(one.pid) == one.pid for one in workers)
                workers[0].kill()
        assert len(seen) == 400 and list(lost) == [301]
        facts = executor.stats
        assert facts is not None and facts.lost >= 4 and facts.max_running == 2
    assert not own_workers() and "printed" not in capfd.readouterr().out


@pytest.mark.medium
def test_workers_end_with_the_process_that_started_them() -> None:
    """In the middle of a batch, though it was killed."""
    script = """
from advsearch.cluster import WorkerTask
from advsearch.cluster.workers import open_workers
task = WorkerTask("cluster_work:squares", {"seconds": 600.0})
with open_workers(task, workers=1, cluster=None, report_message=print) as executor:
    list(executor.compute([range(1)]))
"""
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, env=environ) as asking:
        workers: list[Any] = []
        while not workers and asking.poll() is None:
            time.sleep(0.1)
            workers = psutil.Process(asking.pid).children()
        asking.kill()
    (worker,) = workers
    assert worker.wait(60.0) in (0, None)


@pytest.mark.medium
def test_a_worker_has_no_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A module that asks as it is imported, here by a worker, is told what to do."""
    monkeypatch.syspath_prepend(str(tmp_path))
    asks = "from advsearch.cluster.local import LocalExecutor\nLocalExecutor(2)\n"
    (tmp_path / "asking.py").write_text(asks)
    with open_workers(WorkerTask("asking:work", {}), workers=1, cluster=None, report_message=print) as executor:
        assert executor is not None
        with pytest.raises(ClusterError, match="asks for workers"):
            list(executor.compute(pieces(4)))


@pytest.mark.medium
def test_a_worker_that_hangs_ends_itself_and_is_replaced(capfd: pytest.CaptureFixture[str]) -> None:
    """Of a call that always hangs, as many as may die; the next call finds a worker."""
    executor = LocalExecutor(1)
    task = WorkerTask("cluster_work:squares", {"seconds": 600.0})
    try:
        with pytest.raises(WorkerDiedError, match="3 workers died of it"):
            executor.submit(run_batch, task, range(1), 0.2).result(60.0)
        quick = WorkerTask("cluster_work:squares", {})
        assert executor.submit(run_batch, quick, range(2, 4), 60.0).result(60.0).value == [4, 9]
    finally:
        executor.shutdown()
    assert executor.stats.lost == 3 and "in call" in capfd.readouterr().err, "the error output says where it hung"


@pytest.mark.medium
def test_a_worker_imports_nothing_from_the_current_folder(tmp_path: Path) -> None:
    """Nor the script that asks for it."""
    for name in ("pickle", "runpy", "advsearch", "json"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('of the current folder')")
    scripts = tmp_path / "scripts"
    scripts.mkdir()
    (scripts / "script.py").write_text(
        "print('imported', flush=True)\n"
        "from advsearch.cluster import WorkerTask\n"
        "from advsearch.cluster.workers import open_workers\n"
        "task = WorkerTask('cluster_work:squares', {})\n"
        "with open_workers(task, workers=1, cluster=None, report_message=print) as workers:\n"
        "    print([done.value for done in workers.compute([range(3)])])\n"
    )
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    command = [sys.executable, str(scripts / "script.py")]
    done = subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, text=True, check=False)
    assert done.stdout == "imported\n[[0, 1, 4]]\n", done.stderr


@contextmanager
def started(*words: str) -> Iterator[subprocess.Popen[bytes]]:
    """A process of Dask's own command line, which is ended at the end of the block."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen([str(SCRIPTS / "dask"), *words], env=environment, start_new_session=True, **quiet)  # type: ignore[call-overload]
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def free_port() -> str:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return str(one.getsockname()[1])


@pytest.mark.medium
def test_a_scheduler_and_workers_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files come along; the scheduler is killed while a result is fetched from it, and comes back under its address."""
    port = free_port()
    scheduler = ("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    worker = (
        "worker",
        f"tcp://127.0.0.1:{port}",
        "--nthreads",
        "1",
        "--no-dashboard",
        "--local-directory",
        str(tmp_path),
    )
    told: list[str] = []
    added = tmp_path / "added.txt"
    added.write_text("7")
    work = WorkerTask("cluster_work:squares", {"seconds": 0.01, "file": str(added)}, ("file",))
    with ExitStack() as later, started(*worker), started(*scheduler) as first:
        with open_workers(
            work, workers=None, cluster=f"tcp://127.0.0.1:{port}", report_message=told.append
        ) as executor:
            check(executor, 40, added=7)
            assert executor is not None
            results = executor.compute(pieces(200))
            seen = [number for _ in range(10) for number in next(results).items]
            fetch = distributed.Client._gather_remote

            async def killed(*args: Any) -> Any:
                monkeypatch.setattr(distributed.Client, "_gather_remote", fetch)
                os.killpg(first.pid, signal.SIGKILL)
                first.wait()
                for words in (scheduler, worker):
                    later.enter_context(started(*words))
                return await fetch(*args)

            monkeypatch.setattr(distributed.Client, "_gather_remote", killed)
            seen += [number for done in results for number in done.items]
            assert sorted(seen) == list(range(200))
            assert any("the scheduler has gone" in text for text in told)


def executor_of_nobody(**more: Any) -> Any:
    """An executor that has not connected, with a worker that may be given calls."""
    executor = object.__new__(DaskExecutor)
    vars(executor).update(
        description="here", stats=WorkerStats(), _usable_addresses=frozenset({"tcp://here"}), _refusal_by_address={},
        _sending=None,
        _report_message=lambda text: None, _contents={}, _plugin_name="files", **more,
    )  # fmt: skip
    return executor


def test_a_scheduler_that_went_and_came_back_between_two_looks_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its client runs at both, over another connection: what was under way is lost all the same."""
    connection = object()
    client = SimpleNamespace(
        status="running",
        scheduler_comm=connection,
        scheduler=SimpleNamespace(ncores=None),
        sync=lambda function, *args, **__: {"a": compute_version()},
    )
    now = time.monotonic()
    executor = executor_of_nobody(
        _client=client, _connection=connection, _counted_at=now, _alone_since=now, _looked_at=float("-inf")
    )
    again = list[object]()
    monkeypatch.setattr(executor, "_reconnect", lambda: again.append(client.scheduler_comm))
    monkeypatch.setattr("advsearch.cluster.dask_executor.LOOK_SECONDS", 0.0)
    assert executor.count_workers() == 1 and not again
    client.scheduler_comm = object()
    executor.count_workers()
    assert again == [client.scheduler_comm]


def looked_at(versions: dict[str, Any], seconds: float) -> tuple[int, list[str]]:
    """How many workers may be given calls, and what is told, of those with such versions after so long."""
    told = list[str]()
    connection, then = object(), time.monotonic() - seconds
    client = SimpleNamespace(
        status="running", scheduler_comm=connection, scheduler=SimpleNamespace(ncores=None),
        sync=lambda function, *args, **__: versions,
    )  # fmt: skip
    executor = executor_of_nobody(
        _client=client, _connection=connection, _counted_at=time.monotonic(), _alone_since=then,
        _looked_at=float("-inf"),
    )  # fmt: skip
    vars(executor).update(_usable_addresses=frozenset(), _report_message=told.append)
    return executor.count_workers(), told


def test_a_worker_of_another_version_is_refused_with_both() -> None:
    refused = f"it has advsearch 2, and {compute_version()} asks; install the same on both"
    count, told = looked_at(
        {"a": compute_version(), "b": "2", "c": ImportError("no advsearch"), "d": OSError("going")}, 0.0
    )
    assert count == 1
    assert told == [
        f"b is given nothing: {refused}",
        "c is given nothing: it cannot begin (no advsearch); install the same advsearch there",
    ]
    assert looked_at({"b": "2"}, 14.0)[0] == 0
    with pytest.raises(ClusterError, match="advsearch resume"):
        looked_at({"b": "2"}, 16.0)


def test_nobody_at_all_is_waited_for_and_then_said() -> None:
    assert looked_at({}, 299.0)[0] == 0
    with pytest.raises(ClusterError, match="300 s"):
        looked_at({}, 301.0)


class Prediction:
    """A future of Dask that ends so."""

    def __init__(self, status: str, comes: Any) -> None:
        self.status, self.comes, self.released = status, comes, False

    def __await__(self) -> Generator[None, None, Any]:
        return self._answer().__await__()

    async def _answer(self) -> Any:
        if isinstance(self.comes, BaseException):
            raise self.comes
        return self.comes

    def release(self) -> None:
        self.released = True


def called(monkeypatch: pytest.MonkeyPatch, *answers: Prediction, executor: Any = None) -> Any:
    """What comes of a call whose answers come so, one for each time that it is asked."""
    monkeypatch.setattr("advsearch.cluster.dask_executor.LOOK_SECONDS", 0.001)
    left = iter(answers)
    plugins = list[Any]()

    async def register_plugin(plugin: Any, name: str) -> None:
        plugins.append(plugin)

    client = SimpleNamespace(
        status="running", submit=lambda *args, **named: next(left), register_plugin=register_plugin, plugins=plugins
    )
    executor = executor_of_nobody() if executor is None else executor
    value = asyncio.run(executor._call(client, len, ("abc",)))
    assert all(one.released for one in answers) and not list(left)
    return value


ON_THE_WAY = [
    ("finished", distributed.comm.CommClosedError("in ConnectionPool.gather: Stream is closed")),
    ("finished", OSError("no route to host")),
    ("finished", TimeoutError("in 120 s")),
    ("finished", RuntimeError("of a thread that is not there any more")),
    ("lost", AssertionError("not there")),
    ("cancelled", distributed.client.FutureCancelledError(key="a", reason="scheduler-connection-lost")),
    ("cancelled", asyncio.CancelledError("by somebody else")),
    ("error", scheduling.NoValidWorkerError("a", set(), {"tcp://here"}, {}, 60.0)),
    ("error", scheduling.NoWorkerError("a", 60.0)),
]


@pytest.mark.parametrize(("status", "error"), ON_THE_WAY, ids=[type(error).__name__ for _, error in ON_THE_WAY])
def test_what_is_lost_on_the_way_is_asked_again(
    monkeypatch: pytest.MonkeyPatch, status: str, error: BaseException
) -> None:
    value = Prediction("finished", ("tcp://here", "value"))
    told = called(monkeypatch, Prediction(status, error), Prediction(status, error), value)
    assert told == "value"


def test_what_a_worker_cannot_begin_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the state of the call, not by the error's type, which may be the same."""
    for error in (distributed.comm.CommClosedError("its own"), OSError("the disk is gone"), ValueError("a bug")):
        with pytest.raises(ClusterError, match=f"a worker cannot begin .{type(error).__name__}: {error}"):
            called(monkeypatch, *(Prediction("error", error) for _ in range(MAX_TRIES)))
    killed = distributed.KilledWorker("a", SimpleNamespace(address="tcp://here"), 0)
    with pytest.raises(WorkerDiedError, match="no answer: 3 workers died of it"):
        called(monkeypatch, Prediction("error", killed))


def test_a_worker_that_is_not_fit_is_given_nothing_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it was to do is done elsewhere; files are sent once to all that come."""
    executor = executor_of_nobody()
    vars(executor)["_usable_addresses"] = frozenset({"tcp://here", "tcp://there"})
    full = Prediction("finished", ("tcp://here", Reply(failure=Failure.UNFIT, error="the disk is full")))
    lacks = Prediction("finished", ("tcp://there", Reply(failure=Failure.MISSING_FILES, error="it lacks mug.obj")))
    done = Prediction("finished", ("tcp://there", Reply(value=3)))
    assert called(monkeypatch, full, lacks, done, executor=executor).value == 3
    assert executor._refusal_by_address == {"tcp://here": "the disk is full"} and executor._sending.done()
    assert executor._usable_addresses == {"tcp://there"} and executor.stats.refused == 1
    executor._usable_addresses |= {"tcp://other"}
    assert called(monkeypatch, lacks, done, executor=executor).value == 3
    assert executor._refusal_by_address["tcp://there"] == "it lacks mug.obj", (
        "it has them not although it was sent them"
    )


def test_a_scheduler_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advsearch.cluster.dask_executor.CONNECT_SECONDS", 1.0)
    monkeypatch.setattr("advsearch.cluster.dask_executor.RECONNECT_SECONDS", 10_000.0)
    begun = time.monotonic()
    with pytest.raises(ClusterError, match="no scheduler"):
        with open_workers(
            WorkerTask("a:b", {}), workers=None, cluster="tcp://127.0.0.1:9", report_message=lambda text: None
        ):
            pass
    assert time.monotonic() - begun < 1_000.0  # and not `RECONNECT`


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("class: os.system\narguments: {command: ls}", "class: expected one of SLURMCluster.*got 'os.system'"),
        ("address: tcp://a:1\nclass: SLURMCluster", "expected either address, or class"),
        ("address: 5", "address: expected tcp://HOST:PORT"),
        ("address: tcp://a:1\nworkers: 3", "workers of a scheduler run already"),
        ("class: SLURMCluster\nworkers: none", "workers: expected a whole number"),
        ("class: SLURMCluster\nsecurity: yes", "security: expected names and values"),
        ("class: SLURMCluster", "SLURMCluster needs dask-jobqueue; pip install dask-jobqueue"),
        ("class: KubeCluster", "KubeCluster needs dask-kubernetes; pip install dask-kubernetes"),
        ("nanny: 3", "got nanny"),
    ],
)
def test_a_file_of_a_cluster_says_what_is_wrong_and_runs_nothing(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "cluster.yaml"
    path.write_text(text)
    with pytest.raises((InputError, FileFormatError), match=message):
        parse_site(None, str(path))


def test_a_cluster_is_an_address_a_file_or_this_machine(tmp_path: Path) -> None:
    path = tmp_path / "cluster.yaml"
    path.write_text("address: tls://10.0.0.1:8786\nsecurity: {tls_ca_file: ca.pem, require_encryption: true}")
    place = parse_site(None, str(path))
    assert place.address == "tls://10.0.0.1:8786"
    assert place.security == {"tls_ca_file": str(tmp_path / "ca.pem"), "require_encryption": True}
    assert LocalExecutor(3).description == "3 workers on this machine"
    with pytest.raises(InputError, match="leave one of the two out"):
        parse_site(2, "tcp://a:1")
    assert set(CLUSTER_CLASSES.values()) == {"dask_jobqueue", "dask_kubernetes.operator"}


def test_without_dask_the_message_is_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match="Dask"):
        with open_workers(WorkerTask("a:b", {}), workers=None, cluster="tcp://a:1", report_message=lambda text: None):
            pass


class Outside(ClusterExecutor):
    """Executors of another package, with one worker on this machine."""

    expected_values = ("outside",)

    @classmethod
    def reads(cls, cluster: str) -> bool:
        return cluster == "outside"

    @classmethod
    def open(cls, task: WorkerTask, n_workers: int | None, cluster: str, report_message: Any) -> Any:
        report_message(f"{n_workers} workers on {cluster}")
        return LocalExecutor(1), task


def open_on(cluster: str, told: list[str]) -> Any:
    return open_workers(WorkerTask("cluster_work:squares", {}), workers=3, cluster=cluster, report_message=told.append)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """What packages install, by its entry point."""
    entries: dict[str, Any] = {}

    def load(name: str) -> Any:
        if isinstance(entries[name], Exception):
            raise entries[name]
        return entries[name]

    def points(group: str) -> list[Any]:
        return [SimpleNamespace(name=one, value=f"other:{one}", load=partial(load, one)) for one in entries]

    monkeypatch.setattr(registry, "entry_points", points)
    vars(CLUSTERS).pop("_installed", None)
    yield entries
    vars(CLUSTERS).pop("_installed", None)


@pytest.mark.medium
def test_a_cluster_of_an_installed_package_does_the_work(installed: dict[str, Any]) -> None:
    told = list[str]()
    installed |= {"broken": ImportError("no module x"), "outside": Outside}
    with open_on("outside", told) as executor:
        check(executor, 6)
    assert told == ["3 workers on outside"]


def test_what_no_cluster_reads_is_refused_with_what_each_reads(
    installed: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusal() -> str:
        with pytest.raises(InputError) as refused, open_on("a", []):
            pass
        return str(refused.value)

    address = "the address of a scheduler such as tcp://10.0.0.1:8786"
    assert list(CLUSTERS) == ["dask"]
    assert refusal() == f"cluster: expected {address}, local, or a .yaml file, got 'a'"
    vars(CLUSTERS).pop("_installed")
    installed |= {"outside": Outside}
    assert refusal() == f"cluster: expected {address}, a .yaml file, local, or outside, got 'a'"
    installed["outside"] = ImportError("no module x")
    assert "outside = other:outside of group advsearch.clusters: cannot be imported (no module x)" in refusal()
    monkeypatch.setattr(CLUSTERS, "built_ins", {})
    installed["outside"] = Outside
    assert refusal() == "cluster: expected local, or outside, got 'a'"
    del installed["outside"]
    vars(CLUSTERS).pop("_installed")
    assert refusal().startswith("cluster: expected local, since no part of advsearch or of another package that opens")
