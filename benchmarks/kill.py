"""Kills a run with SIGKILL at random moments, resumes it each time, and compares the
rows with those of a run that was left alone.

    python benchmarks/kill.py [--kills 50] [--resolution 32] [--command
        attack|verdict|sweep|views|workers|
        drive|drive-workers|over-path]
    python benchmarks/kill.py --cluster [--kills 100] [--seconds 3600]

Every row must agree in every column but times. The attack has an adjoint, so it runs
under `--deterministic`; the sweep does not. The rows of `views` are predicted by light
on surfaces. With workers the process that is killed is the one that gives them work;
they have to end by themselves.

With --cluster a scheduler and two workers are started by Dask's own command line, and
again when they were killed; they and the process that gives them work are killed in
turn. A sweep and an attack on three objects take turns. After so many seconds nothing
more is killed. The exit status is 3 if rows differ, or a run does not end.
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

from advsearch.runs.store import NAME, Row, Store

TEXTURE = [
    "--control",
    "texture",
    "--steps",
    "60",
    "--trials",
    "30",
    "--verify-spp",
    "32",
    "--deterministic",
]
POSE = [
    "--control",
    "pose",
    "--policy",
    "nes",
    "--steps",
    "120",
    "--average",
    "60",
    "--trials",
    "30",
    "--spp",
    "2",
]
VERDICT = [
    "--control",
    "texture",
    "--steps",
    "20",
    "--epsilon",
    "0.02",
    "--deterministic",
]
VIEWS = [
    f"--grid=camera.{values}"
    for values in ("azimuth=0:360:40", "elevation=5:60:10", "sizes=2:5:5")
]
DRIVE = [
    "sweep",
    "--path",
    "approach+orbit",
    "--fps",
    "4",
    "--grid",
    "environment.rotation=0,120,240",
]
DRIVE += [
    "--trials",
    "0",
    "--control",
    "sensor={shot: [0, 0.1]}",
    "--samples",
    "3",
    "--threads",
    "1",
]
OVER = ["attack", *TEXTURE, "--over", "path", "--path", "approach"]
COMMANDS = {
    "attack": ["attack", *TEXTURE],
    "verdict": ["attack", *VERDICT],
    "sweep": [
        "sweep",
        "--grid",
        "pose.yaw=0:360:40",
        "--grid",
        "camera.elevation=5:60:10",
        "--threads",
        "1",
    ],
    "views": ["sweep", *VIEWS, "--workers", "2"],
    "workers": ["attack", *POSE, "--verify-spp", "8", "--workers", "2"],
    "drive": DRIVE,
    "drive-workers": [*DRIVE, "--workers", "2"],
    "over-path": OVER,
}
STARTUP = {
    **dict.fromkeys(COMMANDS, 2.5),
    "views": 6.0,
    "workers": 6.0,
    "drive-workers": 4.0,
}
"""Seconds that pass before the first picture: nothing would come of it if every kill
came before.
"""


CLUSTER_COMMANDS = {
    "sweep": [
        "--grid",
        "pose.yaw=0:360:50",
        "--grid",
        "camera.elevation=5:60:16",
        "--trials",
        "6",
    ],
    "attack": [
        *(
            "--control",
            "camera,pose,light",
            "--steps",
            "8",
            "--average",
            "20",
            "--trials",
            "6",
            "--verify-spp",
            "8",
        )
    ],
}
"""What is carried out on bundled objects."""

OBJECTS = {"sweep": "mug", "attack": "mug,bowl,teapot"}

VICTIMS = ("worker", "scheduler", "coordinator", "workers")
"""Who is killed in turn; the last are all workers at once."""

PAUSE = 4.0
MORE = 6.0
"""Mean seconds between two kills, and those that are added unless one worker died: so
long takes a start.
"""

OF_A_RUN = 20
"""Kills of a run at most, so that every command has its share."""

LONGEST = 600.0
"""Seconds that a run may take after the last kill."""

QUIET = subprocess.DEVNULL


class Cluster:
    """A scheduler and workers of their own, which are started again when they have
    ended.

    Args:
        folder: for what workers keep.
        workers: how many.
    """

    def __init__(self, folder: Path, workers: int = 2) -> None:
        with socket.socket() as free_socket:
            free_socket.bind(("127.0.0.1", 0))
            self.port = free_socket.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        worker = (
            "worker",
            self.address,
            "--nthreads",
            "1",
            "--no-dashboard",
            "--local-directory",
            str(folder),
        )
        scheduler = (
            "scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            str(self.port),
            "--no-dashboard",
        )
        self._words = {
            "scheduler": scheduler,
            **{f"worker {number}": worker for number in range(workers)},
        }
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start_missing(self) -> None:
        """Start what does not run."""
        for name, words in self._words.items():
            if name not in self._running or self._running[name].poll() is not None:
                dask = [str(Path(sys.executable).parent / "dask"), *words]
                self._running[name] = subprocess.Popen(
                    dask, stdout=QUIET, stderr=QUIET, start_new_session=True
                )

    def kill(self, kind: str, chance: random.Random) -> None:
        """Kill the scheduler, one worker with its nanny, or all of them."""
        names = [
            name for name in self._words if name.startswith(kind.removesuffix("s"))
        ]
        for name in names if kind == "workers" else [chance.choice(names)]:
            if self._running[name].poll() is None:
                os.killpg(self._running[name].pid, signal.SIGKILL)
            self._running[name].wait()

    def end(self) -> None:
        """Kill everything."""
        for process in self._running.values():
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


class Kills:
    """When who is killed.

    Args:
        wanted: how many.
        seconds: after which nobody is.
    """

    def __init__(self, wanted: int, seconds: float) -> None:
        self.counts = dict.fromkeys(VICTIMS, 0)
        self.chance = random.Random(1)
        self._wanted, self._end = wanted, time.monotonic() + seconds
        self._next = time.monotonic()
        self.wait(MORE)

    @property
    def total(self) -> int:
        return sum(self.counts.values())

    @property
    def over(self) -> bool:
        return self.total >= self._wanted or time.monotonic() > self._end

    def wait(self, seconds: float) -> None:
        """Kill nobody for so long and a while."""
        self._next = time.monotonic() + seconds + self.chance.expovariate(1.0 / PAUSE)

    def due(self) -> str | None:
        """Return who is to be killed now."""
        if self.over or time.monotonic() < self._next:
            return None
        victim = VICTIMS[self.total % len(VICTIMS)]
        self.counts[victim] += 1
        self.wait(0.0 if victim == "worker" else MORE)
        return victim


def main(argv: Sequence[str] | None = None) -> int:
    """Kill, resume, compare; returns 0 if the rows agree, 3 otherwise."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--command", choices=COMMANDS, default="attack")
    parser.add_argument("--cluster", action="store_true")
    parser.add_argument("--seconds", type=float, default=3600.0)
    args = parser.parse_args(argv)
    # what was started ends too
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))
    return kill_cluster(args) if args.cluster else kill_run(args)


def kill_run(args: argparse.Namespace) -> int:
    """Kill and resume one command."""
    command = [
        *COMMANDS[args.command],
        "--object",
        "mug",
        "--resolution",
        str(args.resolution),
    ]
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole"
        killed = Path(folder) / "killed"
        begun = time.perf_counter()
        if status := _start([*command, "--run", str(whole)]).wait():
            raise SystemExit(f"the run that is not killed ended with status {status}")
        seconds = time.perf_counter() - begun
        kills = _killed(
            [*command, "--run", str(killed)],
            killed,
            args.kills,
            seconds,
            STARTUP[args.command],
        )
        same = rows_of(whole) == rows_of(killed)
        print(
            f"{args.command}: {len(rows_of(whole))} rows, {kills} kills, rows "
            f"{'agree' if same else 'DIFFER'}"
        )
    return 0 if same else 3


def kill_cluster(args: argparse.Namespace) -> int:
    """Kill scheduler, workers and the process that gives them work."""
    shared = ["--resolution", str(args.resolution), "--spp", "2"]
    commands = {
        name: [name, "--object", OBJECTS[name], *words, *shared]
        for name, words in CLUSTER_COMMANDS.items()
    }
    held = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        whole = {}
        for one, words in commands.items():
            _start([*words, "--run", str(folder / one)]).wait()
            whole[one] = rows_below(folder / one)
        kills = Kills(args.kills, args.seconds)
        turn = 0
        cluster = Cluster(folder / "local")
        try:
            while turn < len(commands) or not kills.over:
                one = list(commands)[turn % len(commands)]
                run = folder / f"killed-{turn}"
                before = kills.total
                ended = killed_in_cluster(
                    [*commands[one], "--run", str(run)], run, cluster, kills
                )
                held.append(ended and rows_below(run) == whole[one])
                rows = sum(map(len, whole[one].values()))
                said = "agree" if held[-1] else "DIFFER"
                print(
                    f"{one}: {rows} rows, {kills.total - before} kills, rows {said}",
                    flush=True,
                )
                turn += 1
        finally:
            cluster.end()
    print(f"{kills.total} kills: {kills.counts}; {sum(held)} of {len(held)} runs agree")
    return 0 if all(held) else 3


def _start(words: Sequence[str]) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "advsearch", *words, "--quiet"]
    return subprocess.Popen(command, stdout=QUIET, stderr=QUIET)


def _killed(
    first: Sequence[str], folder: Path, wanted: int, seconds: float, startup: float
) -> int:
    """Start the run and kill it, resume and kill it, until it is done; return how often
    it was killed.

    Each life lasts as long as a start takes and a share of the rest, so that the kills
    spread over the whole run.
    """
    moments = random.Random(1)
    kills = 0
    while True:
        known = (folder / "run.yaml").is_file() and (folder / NAME).is_file()
        child = _start(["resume", str(folder)] if known else first)
        life = (
            startup + moments.expovariate(wanted / seconds) if kills < wanted else None
        )
        try:
            child.wait(life)
            return kills
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
            kills += 1


def rows_of(folder: Path) -> list[Row]:
    """Return the rows of a run without times."""
    with Store(folder / NAME, read_only=True) as store:
        return [
            Row(**{**vars(row), "seconds": None, "time": None}) for row in store.rows()
        ]


def rows_below(run: Path) -> dict[str, list[Row]]:
    """Return the rows of a run and of its parts, by where they are."""
    return {
        str(path.parent.relative_to(run)): rows_of(path.parent)
        for path in sorted(run.rglob(NAME))
    }


def killed_in_cluster(
    first: Sequence[str], run: Path, cluster: Cluster, kills: Kills
) -> bool:
    """Carry out a command until its end, killing on the way; return whether there was
    one.
    """
    child: subprocess.Popen[bytes] | None = None
    before = kills.total
    end = time.monotonic() + LONGEST
    while time.monotonic() < end:
        cluster.start_missing()
        if child is None or child.poll() is not None:
            if child is not None and child.returncode == 0:
                return True
            known = (run / "run.yaml").is_file()
            child = _start(
                ["resume", str(run), f"cluster={cluster.address}"]
                if known
                else [*first, "--cluster", cluster.address]
            )
        time.sleep(0.2)
        victim = kills.due() if kills.total - before < OF_A_RUN else None
        if victim is not None:
            end = time.monotonic() + LONGEST
            if victim == "coordinator":
                child.kill()
                child.wait()
            else:
                cluster.kill(victim, kills.chance)
    if child is not None:
        child.kill()
        child.wait()
    return False


if __name__ == "__main__":
    sys.exit(main())
