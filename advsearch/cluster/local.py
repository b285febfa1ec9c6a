"""An executor on processes of this machine.

`ProcessPoolExecutor` is not used for three reasons. A process that `spawn` starts
imports the caller's script again, and modules of the standard library (pickle, runpy)
from the current folder, where another file may have the same name. If one process dies,
all others end, too, with their work and everything that they have loaded. And the
processes remain if their parent is killed.

The processes here get the module path of the parent, reply over a pipe, open no port,
and end when the parent ends. Ctrl-C does not reach them, since they are not in the
session of the terminal.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from threading import Lock
from typing import Any

from advsearch.cluster import MAX_DEATHS, WorkerDiedError, WorkerExecutor, WorkerStats
from advsearch.cluster.worker import SERVE_VARIABLE
from advsearch.errors import InputError

START_CODE = (
    "import sys; sys.path[:] = sys.argv[1:]; from advsearch.cluster.worker import "
    "serve; serve()"
)
"""The code that a worker process runs. Its arguments are the entries of `sys.path`.

The path is set before anything else is imported: otherwise a file in the current folder
could replace a module.
"""


class WorkerProcess:
    """A worker process, which runs one call at a time."""

    def __init__(self) -> None:
        """Start the process.

        Calls are written to its standard input, and results are read from its standard
        output.
        """
        # one thread for each process, since the processes share the cores
        environ = {**os.environ, "OMP_NUM_THREADS": "1", SERVE_VARIABLE: "1"}
        # START_CODE takes the entries of the path as its arguments
        command = [sys.executable, "-c", START_CODE, *sys.path]
        self._popen = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environ,
            # Ctrl-C in the terminal must not reach it: this process ends the workers.
            start_new_session=True,
        )

    def call(self, function: Callable[..., Any], *args: Any) -> Any:
        """Run a function in the process, and return its result.

        Args:
            function: function at the top level of a module, so that it can be pickled.
            args: its positional arguments.

        Raises:
            WorkerDiedError: the process ends before it returns.
        """
        assert self._popen.stdin is not None and self._popen.stdout is not None
        request = pickle.dumps((function, args))
        try:
            self._popen.stdin.write(request)
            self._popen.stdin.flush()
            return pickle.load(self._popen.stdout)
        except (
            OSError,
            ValueError,
            EOFError,
            pickle.UnpicklingError,
        ) as error:  # the other end has gone
            raise WorkerDiedError from error

    def kill(self) -> None:
        """End the process; a `call` that waits for its result raises WorkerDiedError."""
        with suppress(OSError):
            self._popen.kill()

    def close(self) -> None:
        """End the process, and close its pipes."""
        # An OSError of closing a pipe is ignored: the process may have died before.
        with suppress(OSError), self._popen:
            self._popen.kill()


class LocalExecutor(WorkerExecutor):
    """An executor whose processes are started when they are needed, and replaced if
    they die.
    """

    def __init__(self, count: int) -> None:
        """Make an executor of `count` processes.

        A process is started when it is needed for the first time.

        Raises:
            InputError: this process is a worker itself. It comes here if it imports a
                script of the user that starts a run when it is imported.
        """
        _check_is_no_worker()
        self.description = f"{count} workers on this machine"
        self.stats = WorkerStats()
        self._count = count
        # Each thread waits for the results of one process.
        self._threads = ThreadPoolExecutor(count, "worker")
        self._lock = Lock()
        self._idle: list[WorkerProcess] = []
        self._busy: set[WorkerProcess] = set()
        self._closed = False

    def count_workers(self) -> int:
        return self._count

    def submit(
        self, function: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """Schedule a call of a module's function with positional arguments."""
        if kwargs:
            raise TypeError("a worker takes positional arguments only")
        return self._threads.submit(self._call, function, args)

    def _call(self, function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
        """Run a function in a process and return its result.

        If the process dies, for instance for lack of memory, the function is run again
        in another one.

        Raises:
            WorkerDiedError: `MAX_DEATHS` processes died during the call.
        """
        for _ in range(MAX_DEATHS):
            process = self._take_process()
            try:
                value = process.call(function, *args)
            except WorkerDiedError:
                self._count_death(process)  # removes it from the busy ones
                continue
            with self._lock:  # the next call may use the process
                self._busy.discard(process)
                self._idle.append(process)
            return value
        raise WorkerDiedError(f"no answer: {MAX_DEATHS} workers died of it")

    def _take_process(self) -> WorkerProcess:
        """Return an idle process, or start one if none is idle; it is marked as busy.

        Raises:
            WorkerDiedError: the executor was shut down.
        """
        with self._lock:
            if self._closed:
                raise WorkerDiedError("the workers were let go")
            process = self._idle.pop() if self._idle else WorkerProcess()
            self._busy.add(process)
            return process

    def _count_death(self, process: WorkerProcess) -> None:
        """Release a process that has died, and count the death and the new try."""
        process.close()
        with self._lock:
            self._busy.discard(process)
            self.stats.lost += 1
            self.stats.retried += 1

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes, even in the middle of a call, whose result is lost.

        Args:
            wait: whether to wait until the processes have ended.
            cancel_futures: an argument of `concurrent.futures.Executor`, not used:
                calls that have not started are always cancelled.
        """
        with self._lock:
            self._closed = True
            for process in self._busy:
                process.kill()
        self._threads.shutdown(wait, cancel_futures=True)
        for process in self._idle:
            process.close()


def _check_is_no_worker() -> None:
    """Check that this process is no worker, which must not start workers itself.

    Raises:
        InputError: it is one.
    """
    # the variable is set in the environment of each worker
    is_worker = SERVE_VARIABLE in os.environ
    if is_worker:
        raise InputError(
            "workers: a module that a worker imports asks for workers itself; put "
            "what it asks under "
            '`if __name__ == "__main__":`'
        )
