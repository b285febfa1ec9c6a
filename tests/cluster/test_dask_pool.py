"""Real workers of Dask: processes on this machine, and a scheduler and workers that were started by themselves."""

from __future__ import annotations

import asyncio
import os
import queue
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from conftest import ROOT
from covering import only

from advsearch.cluster import Dropped, Ended, Event, Executor, Work
from advsearch.cluster.dask_pool import CLASSES, DaskPool, executor_of, place_of, scheduler_gone
from advsearch.errors import ClusterError, FileFormatError, InputError

psutil: Any = import_module("psutil")  # which Dask brings along
dask: Any = import_module("dask")
distributed: Any = import_module(
    "distributed"
)  # first: what it adds to the configuration would go again with what a test sets there
scheduling: Any = import_module("distributed.scheduler")
SCRIPTS = Path(sys.executable).parent


def pieces(count: int) -> Iterator[range]:
    return (range(first, first + 2) for first in range(0, count, 2))


def check(executor: Executor | None, count: int, added: int = 0) -> None:
    """All numbers come back once and squared."""
    assert executor is not None
    found = {n: v for done in executor.results(pieces(count)) for n, v in zip(done.items, done.value, strict=True)}
    assert found == {number: number * number + added for number in range(count)}


def test_processes_of_this_machine_are_killed_and_nothing_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing listens beyond loopback; a number of which a worker dies each time is said. The scheduler goes once as
    it is found, too."""
    told: list[str] = []
    look, failing = DaskPool._look_around, [distributed.comm.CommClosedError("in identity: Stream is closed")]

    async def fails_once(self: DaskPool) -> None:
        if failing:
            raise failing.pop()
        await look(self)

    monkeypatch.setattr(DaskPool, "_look_around", fails_once)
    work = Work("cluster_work:squares", {"seconds": 0.01, "deadly": [301]})
    with executor_of(work, workers=2, cluster=None, tell=told.append) as executor:
        assert executor is not None
        results = executor.results(pieces(400))
        seen: dict[int, Any] = {}
        lost: dict[int, str] = {}
        for count, done in enumerate(results):
            seen |= dict.fromkeys(done.items, done.value)
            lost |= {done.items[0]: done.lost} if done.lost else {}
            mine = psutil.Process().children(recursive=True)
            if count == 1:
                listening = [one for process in (psutil.Process(), *mine) for one in process.net_connections("tcp")]
                addresses = {one.laddr.ip for one in listening if one.status == "LISTEN"}
                assert addresses == {"127.0.0.1"}
            if count == 20:
                workers = [one for one in mine if "spawn_main" in " ".join(one.cmdline())]
                assert len(workers) >= 2, "they are spawned, never forked"
                for one in workers:  # Ctrl-C, which a terminal sends to all, is for the main process
                    blocked = Path(f"/proc/{one.pid}/status").read_text().partition("SigBlk:")[2].split()[0]
                    assert int(blocked, 16) >> (signal.SIGINT - 1) & 1
                workers[0].kill()
        assert len(seen) == 400 and list(lost) == [301]
        facts = executor.facts
        assert facts is not None and facts.lost >= 4 and facts.most == 2


@pytest.mark.slow
def test_a_worker_that_takes_long_to_start_again_is_waited_for(tmp_path: Path) -> None:
    """The only one dies, and needs more than the 15 seconds after which Dask gives up by itself."""
    begun, late = tmp_path / "begun", tmp_path / "late.py"
    late.write_text(
        f"import pathlib, time\nbegun = pathlib.Path({str(begun)!r})\n"
        "time.sleep(17.0) if begun.exists() else begun.touch()\n"
    )
    work = Work("cluster_work:squares", {"seconds": 0.01})
    with dask.config.set({"distributed.worker.preload": [str(late)]}):
        with executor_of(work, workers=1, cluster=None, tell=lambda text: None) as executor:
            assert executor is not None
            seen: set[int] = set()
            for done in executor.results(pieces(100)):
                if not seen:
                    mine = psutil.Process().children(recursive=True)
                    next(one for one in mine if "spawn_main" in " ".join(one.cmdline())).kill()
                seen |= set(done.items)
            assert seen == set(range(100)) and executor.facts is not None and executor.facts.lost == 1


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
    work = Work("cluster_work:squares", {"seconds": 0.01, "file": str(added)}, ("file",))
    with ExitStack() as later, started(*worker), started(*scheduler) as first:
        with executor_of(work, workers=None, cluster=f"tcp://127.0.0.1:{port}", tell=told.append) as executor:
            check(executor, 40, added=7)
            assert executor is not None
            results = executor.results(pieces(200))
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


def test_a_scheduler_that_went_and_came_back_between_two_looks_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its client runs at both, over another connection: what was under way is lost all the same."""
    monkeypatch.setattr("advsearch.cluster.dask_pool.LOOK", 0.01)
    client = SimpleNamespace(status="running", scheduler_comm=object())

    async def look() -> None:
        gone = asyncio.create_task(scheduler_gone(client))
        await asyncio.sleep(0.05)
        assert not gone.done()
        client.scheduler_comm = object()
        await asyncio.wait_for(gone, 60.0)

    asyncio.run(look())


class Answer:
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


def called(monkeypatch: pytest.MonkeyPatch, *answers: Answer) -> list[Event]:
    """What is told of a call whose answers come so, one for each time that it is asked."""
    monkeypatch.setattr("advsearch.cluster.dask_pool.LOOK", 0.0)
    left, pool = iter(answers), object.__new__(DaskPool)
    client = SimpleNamespace(status="running", submit=lambda *args, **named: next(left))
    vars(pool).update(_client=client, _calls={5: None}, _events=queue.SimpleQueue())
    asyncio.run(pool._call(5, "tcp://here", len, ("abc",)))
    assert all(one.released for one in answers) and not list(left) and not pool._calls
    return pool.events(0.0)


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
    told = called(monkeypatch, Answer(status, error), Answer(status, error), Answer("finished", "value"))
    assert told == [Ended(5, "value")]


def test_what_a_worker_cannot_begin_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the state of the call, not by the error's type, which may be the same."""
    for error, unfit in (
        (distributed.comm.CommClosedError("its own"), True),
        (OSError("the disk is gone"), True),
        (ImportError("no advsearch"), True),
        (ValueError("a bug"), False),
    ):
        (told,) = called(monkeypatch, Answer("error", error))
        assert isinstance(told, Ended) and told.value.unfit is unfit and str(error) in told.value.text
    killed = distributed.KilledWorker("a", SimpleNamespace(address="tcp://here"), 0)
    (told,) = called(monkeypatch, Answer("error", killed))
    assert isinstance(told, Dropped)


def test_a_scheduler_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advsearch.cluster.dask_pool.CONNECT", 1.0)
    begun = time.monotonic()
    with pytest.raises(ClusterError, match=r"tcp://127.0.0.1:9: there is no scheduler that answers"):
        with executor_of(Work("a:b", {}), workers=None, cluster="tcp://127.0.0.1:9", tell=lambda text: None):
            pass
    assert time.monotonic() - begun < 100.0  # and not `RECONNECT`


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("class: os.system\narguments: {command: ls}", "class: expected one of SLURMCluster.*got 'os.system'"),
        ("address: tcp://a:1\nclass: SLURMCluster", "expected either address, or class"),
        ("address: 5", "address: expected tcp://HOST:PORT"),
        ("address: tcp://a:1\nworkers: 3", "says how many there are"),
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
        place_of(None, str(path))


def test_a_cluster_is_an_address_a_file_or_this_machine(tmp_path: Path) -> None:
    path = tmp_path / "cluster.yaml"
    path.write_text("address: tls://10.0.0.1:8786\nsecurity: {tls_ca_file: ca.pem, require_encryption: true}")
    place = place_of(None, str(path))
    assert place.address == "tls://10.0.0.1:8786"
    assert place.security == {"tls_ca_file": str(tmp_path / "ca.pem"), "require_encryption": True}
    assert place_of(3, None).where == "3 workers on this machine"
    for workers, cluster, message in (
        (2, "tcp://a:1", "leave one of the two out"),
        (None, "a", "expected the address"),
    ):
        with pytest.raises(InputError, match=message):
            place_of(workers, cluster)
    assert set(CLASSES.values()) == {"dask_jobqueue", "dask_kubernetes.operator"}


ASKING = {
    "ask()": False,
    "with open(__file__):\n    ask()": False,
    "def main():\n    ask()\nmain()": False,
    "import threading\none = threading.Thread(target=ask)\none.start()\none.join()": False,
    "if __name__ == '__main__':\n    ask()": True,
    "def main():\n    ask()\nif '__main__' == __name__:\n    main()": True,
    "if __name__ != '__main__':\n    raise SystemExit\nask()": True,
}


FEW = [one for one in ASKING if one.startswith(("import", "def main():\n    ask()\nmain", "if __name__ =="))]


@pytest.mark.parametrize("text", only(FEW, ASKING))
def test_a_script_that_every_worker_would_run_again_is_told_what_to_do(tmp_path: Path, text: str) -> None:
    script = tmp_path / "script.py"
    begin = "from advsearch.cluster.dask_pool import place_of\ndef ask():\n    place_of(2, None)\n"
    script.write_text(begin + text, encoding="utf-8")
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, env=environ, check=False)
    last = done.stderr.strip().rpartition("\n")[2]
    wanted = f'workers: expected {script} to ask under `if __name__ == "__main__":`, got a call outside of it, in line'
    assert (wanted in last) is not ASKING[text], done.stderr
    assert ASKING[text] or done.stderr.count("\n") < 20


def test_a_script_that_comes_through_a_pipe_has_no_workers() -> None:
    script = "from advsearch.cluster.dask_pool import place_of; place_of(2, None)"
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable], input=script, capture_output=True, text=True, env=environ, check=False)
    assert "expected a script that they can import, got <stdin>; put it into a file" in done.stderr


def test_without_dask_the_message_is_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"needs Dask; pip install 'advsearch\[dask\]'"):
        with executor_of(Work("a:b", {}), workers=2, cluster=None, tell=lambda text: None):
            pass
