"""What one configuration for many conditions comes to, over several seeds: how often it is found, and how far rates
spread.

    python benchmarks/over_seeds.py [--epsilons 0.2 0.3] [--seeds 0 1 2 3 4] [--more steps=150 baseline=false]

The command of docs/questions.md, as typed, once for each seed: `attack --object mug --control texture --over
camera,environment`. For each the ending, the verified rate with its interval, the samples a pixel of the check,
pictures of search and check, and processor seconds. A figure in the docs is that of at least five seeds, with its
spread; what is said to be found there is found in at least four of them.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Sequence

from advsearch import threads
from advsearch.attacks import Ending
from advsearch.questions.attack.carry_out import attack_once
from advsearch.questions.attack.settings import AttackConfig


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--epsilons", type=float, nargs="+", default=[0.2, 0.3])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--more", nargs="*", default=[], help="settings of attack, NAME=VALUE")
    args = parser.parse_args(argv)
    threads.configure(None)
    print("| epsilon | seed | ending | wrong in | 95 % | samples | search | check | CPU s | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for epsilon in args.epsilons:
        rates, found = list[float](), 0
        for seed in args.seeds:
            rate, ending = carried_out(epsilon, seed, dict(one.split("=", 1) for one in args.more))
            rates, found = [*rates, rate], found + ending
        spread = f"{min(rates):.3f} to {max(rates):.3f}, median {statistics.median(rates):.3f}"
        print(f"epsilon {epsilon}: found in {found} of {len(args.seeds)}; rates {spread}", flush=True)
    return 0


def carried_out(epsilon: float, seed: int, more: dict[str, str]) -> tuple[float, bool]:
    """Carry out one attack, print its row, and return the verified rate and whether it is found."""
    begun, used = time.perf_counter(), time.process_time()
    given = {"controls": {"texture": {}}, "over": {"camera": {}, "environment": {}}, "epsilon": epsilon, **more}
    summary = attack_once(AttackConfig(object="mug", seed=seed, **given)).summary
    spent, took = time.process_time() - used, time.perf_counter() - begun
    verified, renders = summary.verified, summary.renders
    assert verified is not None
    low, high = verified.interval
    row = [epsilon, seed, summary.ending, f"{verified.successes} of {verified.trials}", f"{low:.3f} to {high:.3f}"]
    row += [verified.spp, sum(n for name, n in renders.items() if name != "verification"), renders["verification"]]
    print("| " + " | ".join(map(str, [*row, f"{spent:.0f}", f"{took:.0f}"])) + " |", flush=True)
    return verified.rate, summary.ending == Ending.FOUND.value


if __name__ == "__main__":
    sys.exit(main())
