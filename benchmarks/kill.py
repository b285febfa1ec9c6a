"""Kills a run with SIGKILL at random moments, resumes it each time, and compares the
rows with those of a whole run.

    python benchmarks/kill.py [--kills 50] [--resolution 32] [--command
        attack|verdict|sweep|views|workers|
        drive|drive-workers|over-path]

Every row must agree in every column but times. The attack has an adjoint, so it runs
under `--deterministic`; the sweep does not. The rows of `views` are predicted by light
on surfaces. With workers the process that is killed is the one that gives them work;
they have to end by themselves.
"""

from __future__ import annotations

import argparse
import random
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


def main(argv: Sequence[str] | None = None) -> int:
    """Kill, resume, compare; returns 0 if the rows agree, 3 otherwise."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--command", choices=COMMANDS, default="attack")
    args = parser.parse_args(argv)
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


def _start(words: Sequence[str]) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "advsearch", *words, "--quiet"]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


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


if __name__ == "__main__":
    sys.exit(main())
