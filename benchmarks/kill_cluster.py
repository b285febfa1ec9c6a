"""Kills workers, scheduler and the process that asked, in turn and at random moments; compares rows with a whole run's.

    python benchmarks/kill_cluster.py [--kills 100] [--resolution 32] [--rows 2000]

A scheduler and two workers are started by Dask's own command line, and again when they were killed; a sweep that was
killed is resumed. Every row must agree in every column but times, and be there once. The exit status is 3 if not.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from kill import rows_of

VICTIMS = ("worker", "scheduler", "coordinator", "workers")
"""Who is killed in turn; the last are all workers at once."""

STARTUP, PAUSE = 20.0, 6.0
"""Seconds until rows come at first, and the mean between two kills after that."""

QUIET = subprocess.DEVNULL


class Cluster:
    """A scheduler and workers of their own, which are started again when they have ended.

    Args:
        folder: for what workers keep.
        workers: how many.
    """

    def __init__(self, folder: Path, workers: int = 2) -> None:
        with socket.socket() as one:
            one.bind(("127.0.0.1", 0))
            self.port = one.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        worker = ("worker", self.address, "--nthreads", "1", "--no-dashboard", "--local-directory", str(folder))
        scheduler = ("scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        self._words = {"scheduler": scheduler, **{f"worker {number}": worker for number in range(workers)}}
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def see_to_it(self) -> None:
        """Start what does not run."""
        for name, words in self._words.items():
            if name not in self._running or self._running[name].poll() is not None:
                dask = [str(Path(sys.executable).parent / "dask"), *words]
                self._running[name] = subprocess.Popen(dask, stdout=QUIET, stderr=QUIET, start_new_session=True)

    def kill(self, kind: str, chance: random.Random) -> None:
        """Kill the scheduler, one worker with its nanny, or all of them."""
        names = [name for name in self._words if name.startswith(kind.removesuffix("s"))]
        for name in names if kind == "workers" else [chance.choice(names)]:
            if self._running[name].poll() is None:
                os.killpg(self._running[name].pid, signal.SIGKILL)
            self._running[name].wait()

    def end(self) -> None:
        """Kill everything."""
        for one in self._running.values():
            if one.poll() is None:
                os.killpg(one.pid, signal.SIGKILL)
            one.wait()


def main(argv: Sequence[str] | None = None) -> int:
    """Kill, resume, compare; returns 0 if the rows agree, 3 otherwise."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--rows", type=int, default=2000)
    args = parser.parse_args(argv)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))  # what was started ends too
    grid = ["--grid", f"pose.yaw=0:360:{max(2, args.rows // 8)}", "--grid", "camera.elevation=5:60:8"]
    words = ["sweep", "--object", "mug", *grid, "--resolution", str(args.resolution), "--trials", "6"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        begin([*words, "--threads", "1", "--run", str(folder / "whole")]).wait()
        cluster = Cluster(folder / "local")
        try:
            kills = killed([*words, "--run", str(folder / "killed")], folder / "killed", cluster, args.kills)
        finally:
            cluster.end()
        whole, other = rows_of(folder / "whole"), rows_of(folder / "killed")
    same = whole == other
    print(f"sweep: {len(whole)} rows, kills {kills}, rows {'agree' if same else 'DIFFER'}")
    return 0 if same else 3


def begin(words: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start advsearch."""
    command = [sys.executable, "-m", "advsearch", *words, "--quiet"]
    return subprocess.Popen(command, stdout=QUIET, stderr=QUIET)


def killed(first: Sequence[str], run: Path, cluster: Cluster, wanted: int) -> dict[str, int]:
    """Sweep until the end, killing on the way; return how often who was killed."""
    chance, kills = random.Random(1), dict.fromkeys(VICTIMS, 0)
    child: subprocess.Popen[bytes] | None = None
    strike = time.monotonic() + STARTUP
    while True:
        cluster.see_to_it()
        if child is None or child.poll() is not None:
            if child is not None and child.returncode == 0:
                return kills
            known = (run / "run.yaml").is_file()
            child = begin(["resume", str(run)] if known else [*first, "--cluster", cluster.address])
        time.sleep(0.2)
        if sum(kills.values()) < wanted and time.monotonic() > strike:
            victim = VICTIMS[sum(kills.values()) % len(VICTIMS)]
            kills[victim] += 1
            if victim == "coordinator":
                child.kill()
                child.wait()
            else:
                cluster.kill(victim, chance)
            strike = time.monotonic() + chance.expovariate(1.0 / PAUSE) + (STARTUP if victim != "worker" else 0.0)


if __name__ == "__main__":
    sys.exit(main())
