"""Workers of this machine: processes of their own, which answer over a pipe. Nothing listens, and no script is imported
again. Ctrl-C, which a terminal sends to its own session, does not reach them; they end when this process does."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from queue import SimpleQueue
from typing import Any

from advsearch.cluster import WorkerDiedError
from advsearch.cluster.worker import SERVING
from advsearch.errors import InputError

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
