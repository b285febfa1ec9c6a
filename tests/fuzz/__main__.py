"""``make fuzz``: run all cases of a seed and print what went wrong, and a table of how they ended."""

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

from fuzz.cases import make
from fuzz.run import run


def main() -> int:
    """Run the cases; return 1 if one of them failed."""
    parser = argparse.ArgumentParser(prog="make fuzz", description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=400, help="how many")
    parser.add_argument("--only", default="", help="only those whose description contains this")
    parser.add_argument("--number", type=int, help="only this one")
    parser.add_argument("--keep", type=Path, help="a new folder for the files; by default they are deleted")
    given = parser.parse_args()
    cases = [(k, make(given.seed, k)) for k in range(given.cases) if given.number in (None, k)]
    cases = [(k, case) for k, case in cases if given.only in case.what]
    endings: Counter[tuple[str, str]] = Counter()
    failed = 0
    slowest, largest = 0.0, 0
    with tempfile.TemporaryDirectory() as scratch:
        for outcome in run(cases, (given.keep or Path(scratch)).resolve()):
            endings[outcome.what.split(":")[0], outcome.ending] += 1
            slowest, largest = max(slowest, outcome.cpu), max(largest, outcome.growth)
            if outcome.faults:
                failed += 1
                print(f"{outcome.number} {outcome.what}: {outcome.ending}; {'; '.join(outcome.faults)}")
                print(f"    {outcome.cpu:.1f} s, {outcome.growth >> 20} MiB; {outcome.message[:600]}", flush=True)
            elif given.number is not None:
                print(f"{outcome.what}: {outcome.ending}; {outcome.message}")
    for (kind, ending), count in sorted(endings.items()):
        print(f"{kind:14} {ending:10} {count:5}")
    print(f"seed {given.seed}: {len(cases)} cases, {failed} failed; at most {slowest:.1f} s, {largest >> 20} MiB")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
