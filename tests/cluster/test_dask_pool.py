"""Real workers of Dask: processes on this machine, and a scheduler and workers that were started by themselves."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from conftest import ROOT
from covering import only

from advsearch.cluster import Executor, Work
from advsearch.cluster.dask_pool import CLASSES, executor_of, place_of, scheduler_gone
from advsearch.errors import ClusterError, FileFormatError, InputError

psutil: Any = import_module("psutil")  # which Dask brings along
dask: Any = import_module("dask")
SCRIPTS = Path(sys.executable).parent


def pieces(count: int) -> Iterator[range]:
    return (range(first, first + 2) for first in range(0, count, 2))


def check(executor: Executor | None, count: int, added: int = 0) -> None:
    """All numbers come back once and squared."""
    assert executor is not None
    found = {n: v for done in executor.results(pieces(count)) for n, v in zip(done.items, done.value, strict=True)}
    assert found == {number: number * number + added for number in range(count)}


def test_processes_of_this_machine_are_killed_and_nothing_is_lost() -> None:
    """Nothing listens beyond loopback; a number of which a worker dies each time is said."""
    told: list[str] = []
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


def test_a_scheduler_and_workers_of_their_own(tmp_path: Path) -> None:
    """Files come along; the scheduler is killed and comes back under its address."""
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
    with started(*worker), started(*scheduler) as first:
        with executor_of(work, workers=None, cluster=f"tcp://127.0.0.1:{port}", tell=told.append) as executor:
            check(executor, 40, added=7)
            assert executor is not None
            results = executor.results(pieces(200))
            seen = [number for _ in range(10) for number in next(results).items]
            os.killpg(first.pid, signal.SIGKILL)
            first.wait()
            with started(*scheduler), started(*worker):
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
        await asyncio.wait_for(gone, 1.0)

    asyncio.run(look())


def test_a_scheduler_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advsearch.cluster.dask_pool.CONNECT", 1.0)
    begun = time.monotonic()
    with pytest.raises(ClusterError, match=r"tcp://127.0.0.1:9: there is no scheduler that answers"):
        with executor_of(Work("a:b", {}), workers=None, cluster="tcp://127.0.0.1:9", tell=lambda text: None):
            pass
    assert time.monotonic() - begun < 30.0


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
