"""What `--spp auto` saves: samples and seconds at equal verified result.

    python benchmarks/close_calls.py [--spaces camera light texture] [--renders 40] [--seeds 10] [--resolution 64]

Fixed: so many renders at the default sample count. Auto: half of it, raised where the decision is close, with a quarter
to all of the fixed search's samples. For each the median over seeds of the verified margin (the mean of fresh trials at
a high sample count, rounded to 8 bits), and samples and seconds over those of the fixed search. The last line of a
space names the least share of the samples at which auto's median is not lower than that of the fixed search by more
than the standard error of their difference.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Sequence
from typing import Any

from advsearch import seeds, threads
from advsearch.api.attacking import problem_from_config
from advsearch.api.problem import Problem
from advsearch.attacks import make_policy, search
from advsearch.attacks.close_calls import CloseCalls
from advsearch.config import AttackConfig

TRIALS, TRIAL_SPP = 8, 64
SHARES = (0.25, 0.5, 0.75, 1.0)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--spaces", nargs="+", default=["camera", "light", "texture"])
    parser.add_argument("--renders", type=int, default=40)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--resolution", type=int, default=64)
    args = parser.parse_args(argv)
    threads.configure(None)
    print("| space | search | samples | seconds | verified margin, median (quartiles) |")
    print("| --- | --- | --- | --- | --- |")
    for space in args.spaces:
        measured(space, args.renders, args.seeds, args.resolution)
    return 0


def measured(space: str, renders: int, count: int, resolution: int) -> None:
    """One space: the fixed search, and auto at several budgets, turn by turn."""
    fixed, auto = (problem(space, resolution, spp) for spp in (None, "auto"))
    ratio = fixed.spp // auto.spp
    budgets = [0.0, *SHARES]
    margins: dict[float, list[float]] = {share: [] for share in budgets}
    seconds: dict[float, list[float]] = {share: [] for share in budgets}
    for seed in range(count):
        for share in budgets:
            one, steps = (auto, round(share * ratio * renders)) if share else (fixed, renders)
            one.seed = seeds.stream(7, "close calls", seed)
            policy = CloseCalls(make_policy("auto")) if share else make_policy("auto")
            begun = time.perf_counter()
            found = search(one.evaluator("search"), one.domain, policy, steps=steps, seed=seed)
            seconds[share].append(time.perf_counter() - begun)
            trials = [
                fixed.trial(found.best_u, seeds.stream(99, "trial", number), TRIAL_SPP) for number in range(TRIALS)
            ]
            margins[share].append(statistics.fmean(trial.margin for trial in trials))
    base = statistics.median(seconds[0.0])
    for share in budgets:
        low, middle, high = statistics.quantiles(margins[share], n=4)
        name, part = ("auto", f"{share:.2f}") if share else ("fixed", "1")
        print(
            f"| {space} | {name} | {part} | {statistics.median(seconds[share]) / base:.2f} "
            f"| {middle:.2f} ({low:.2f} to {high:.2f}) |",
            flush=True,
        )
    good = [share for share in SHARES if not_lower(margins[share], margins[0.0])]
    print(f"{space}: equal from {min(good):.2f} of the samples on" if good else f"{space}: never equal", flush=True)


def not_lower(mine: Sequence[float], theirs: Sequence[float]) -> bool:
    """Whether the median of one is not below the other's by more than the standard error of paired differences."""
    differences = [one - other for one, other in zip(mine, theirs, strict=True)]
    error = statistics.stdev(differences) / math.sqrt(len(differences))
    return statistics.median(mine) >= statistics.median(theirs) - error


def problem(space: str, resolution: int, spp: Any) -> Problem:
    """The bundled mug with one control."""
    config = AttackConfig(
        object="mug", controls={space: {}}, resolution=(resolution, resolution), measure="no", spp=spp
    )
    return problem_from_config(config)[0]


if __name__ == "__main__":
    sys.exit(main())
