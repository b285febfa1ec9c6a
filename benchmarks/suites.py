"""What the bundled suites take: ten claims on the mug, and a light one with counterexamples only.

    python benchmarks/suites.py [--runs 1]

Prints the seconds of the whole command over what was asked for on two cores (180, and 30 for the light one), after a
first run of the light one, so that kernels are warm. Exits with 1 if a suite has another number of claims, no claim of
each verdict, or takes longer.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SUITES = Path(__file__).resolve().parent.parent / "suites"
ASKED = {"mug": (10, 180.0, {"held", "failed", "undecided"}), "light": (1, 30.0, {"failed"})}
"""Claims of each suite, its seconds, and the verdicts that are among them."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1, help="runs of each suite that are counted (default 1)")
    args = parser.parse_args()
    tried("light")
    bad = 0
    for name, (claims, limit, answers) in ASKED.items():
        runs = [tried(name) for _ in range(args.runs)]
        seconds, found = min(one[0] for one in runs), runs[-1][1]
        told = ", ".join(f"{found.count(one)} {one}" for one in sorted(set(found)))
        print(f"  {name:6s} {seconds / limit:.2f} of {limit:g} s   ({seconds:.1f} s; {told})", flush=True)
        bad += seconds > limit or len(found) != claims or not answers <= set(found)
    return 1 if bad else 0


def tried(name: str) -> tuple[float, list[str]]:
    """Return the seconds of a suite, from the start of the process to its end, and its claims' verdicts."""
    only = ["--only", "counterexamples"] if name == "light" else ["--all"]
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        command = [sys.executable, "-m", "advsearch", "test", str(SUITES / f"{name}.yaml"), *only, "--json", "--quiet"]
        done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, check=False)
        seconds = time.perf_counter() - begun
    return seconds, [one["answer"] for one in json.loads(done.stdout)["claims"]]


if __name__ == "__main__":
    sys.exit(main())
