"""What `--deterministic` costs, and how far apart two runs with the same seed lie without it.

    python benchmarks/deterministic.py [--resolution 96] [--steps 30] [--repeats 3]

Attacks the texture of the bundled mug, whose gradient is an adjoint. Prints the seconds of the search with
`--deterministic` over those without, turn by turn, and the largest difference between the verified margins of the runs
of each kind, which is 0 where they agree bit for bit.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from collections.abc import Sequence
from typing import Any


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--resolution", type=int, default=96)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args(argv)
    seconds: dict[str, list[float]] = {"without": [], "with": []}
    margins: dict[str, list[float]] = {"without": [], "with": []}
    endings: set[str] = set()
    for _ in range(args.repeats):
        for kind, flags in (("without", []), ("with", ["--deterministic"])):
            summary = _attack(args, flags)
            seconds[kind].append(summary["seconds"]["search"])
            margins[kind].append(summary["verified"]["margin"])
            endings.add(summary["ending"])
    medians = {kind: statistics.median(values) for kind, values in seconds.items()}
    print(f"seconds of a search with --deterministic over without: {medians['with'] / medians['without']:.2f}")
    for kind, values in margins.items():
        print(
            f"verified margins {kind}: {statistics.fmean(values):.2f}, apart by at most {max(values) - min(values):.3g}"
        )
    print(f"endings: {', '.join(sorted(endings))}")
    return 0


def _attack(args: argparse.Namespace, flags: Sequence[str]) -> Any:
    words = [
        sys.executable,
        "-m",
        "advsearch",
        "attack",
        "--object",
        "mug",
        "--control",
        "texture",
        "--json",
        "--quiet",
    ]
    words += ["--resolution", str(args.resolution), "--steps", str(args.steps), "--no-baseline", "--overwrite"]
    words += ["--verify-spp", "64", "--run", "deterministic-benchmark", *flags]
    return json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)


if __name__ == "__main__":
    sys.exit(main())
