"""The main job as a whole process: `advsearch attack --object mug --control texture`, warm and cold, and `--help`.

    python benchmarks/command.py [--runs 3] [--no-cold]

Prints seconds over what was asked for (30 warm, 90 cold, 0.5 for the help), so that 1 is the limit, and the largest
resident memory over 2.5 GiB. Cold means an empty kernel cache: the home folder is a new one.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time

ATTACK = ["attack", "--object", "mug", "--control", "texture", "--quiet"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3, help="warm runs that are counted (default 3)")
    parser.add_argument("--no-cold", action="store_true", help="leave the cold run out")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        helps = [run(["--help"], folder, {})[0] for _ in range(5)]
        report("advsearch --help", helps, 0.5)
        if not args.no_cold:
            seconds, _ = run(ATTACK, folder, {"HOME": folder})
            report("attack, cold", [seconds], 90.0)
        runs = [run(ATTACK, folder, {}) for _ in range(args.runs + 1)][1:]
        report("attack, warm", [seconds for seconds, _ in runs], 30.0)
        print(f"  attack, memory     {max(memory for _, memory in runs) / 2.5 / 2**30:.2f} of 2.5 GiB")


def report(name: str, seconds: list[float], limit: float) -> None:
    middle = statistics.median(seconds)
    print(
        f"  {name:18s} {middle / limit:.2f} of {limit:g} s   ({min(seconds):.2f} to {max(seconds):.2f} s)", flush=True
    )


def run(arguments: list[str], folder: str, environment: dict[str, str]) -> tuple[float, int]:
    """Run the command in a folder of its own; return its seconds and its largest resident memory in bytes."""
    begun = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "advsearch", *arguments],
        cwd=folder,
        env={**os.environ, **environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - begun
    if status != 0:
        raise SystemExit(f"advsearch {' '.join(arguments)} ended with status {os.waitstatus_to_exitcode(status)}")
    scale = 1 if sys.platform == "darwin" else 1024
    return seconds, usage.ru_maxrss * scale


if __name__ == "__main__":
    main()
