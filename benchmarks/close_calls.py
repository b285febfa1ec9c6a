"""What `--spp auto` saves: samples and seconds at equal verified result.

    python benchmarks/close_calls.py [--spaces camera light pose texture] [--renders 40] [--seeds 10] [--resolution 128]

The same search with as many renders, at the default sample count and at half of it with a closer look at the best ones
while it is close. For each the median over seeds of the verified margin (the mean of fresh trials at a high sample
count, rounded to 8 bits), and samples and seconds over those of the default, ranking of the best ones included; and the
mean difference of the margins, auto minus default, with its standard error.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

from torch import Tensor

from advsearch import seeds, threads
from advsearch.attacks import Query, make_policy, search
from advsearch.config import CLOSE_LOOKS
from advsearch.engine.problem import Problem
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig

TRIALS, TRIAL_SPP = 8, 64


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--spaces", nargs="+", default=["camera", "light", "pose", "texture"])
    parser.add_argument("--renders", type=int, default=40)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--resolution", type=int, default=128)
    args = parser.parse_args(argv)
    threads.configure(None)
    print("| space | search | samples | seconds | verified margin, median (quartiles) | difference |")
    print("| --- | --- | --- | --- | --- | --- |")
    for space in args.spaces:
        measured(space, args.renders, args.seeds, args.resolution)
    return 0


def measured(space: str, renders: int, count: int, resolution: int) -> None:
    """One space, both searches turn by turn."""
    problems = {"default": problem(space, resolution, None), "auto": problem(space, resolution, "auto")}
    margins: dict[str, list[float]] = {name: [] for name in problems}
    samples: dict[str, list[float]] = {name: [] for name in problems}
    seconds: dict[str, list[float]] = {name: [] for name in problems}
    for seed in range(count):
        for name, one in problems.items():
            one.seed = seeds.stream(7, "close calls", seed)
            close = CLOSE_LOOKS if name == "auto" else 0
            evaluate, policy = partial(map, one.evaluate), make_policy("auto")
            begun = time.perf_counter()
            found = search(evaluate, one.domain, policy, steps=renders, seed=seed, close=close, noise=one.seed)
            seconds[name].append(time.perf_counter() - begun)
            samples[name].append(found.renders * one.spp)
            margins[name].append(verified(problems["default"], found.best_u))
    differences = [auto - default for auto, default in zip(margins["auto"], margins["default"], strict=True)]
    error = statistics.stdev(differences) / math.sqrt(count)
    for name in problems:
        low, middle, high = statistics.quantiles(margins[name], n=4)
        spent, took = (
            statistics.median(each[name]) / statistics.median(each["default"]) for each in (samples, seconds)
        )
        behind = f"{statistics.fmean(differences):+.2f} +- {error:.2f}" if name == "auto" else "-"
        print(
            f"| {space} | {name} | {spent:.2f} | {took:.2f} | {middle:.2f} ({low:.2f} to {high:.2f}) | {behind} |",
            flush=True,
        )


def verified(one: Problem, u: Tensor) -> float:
    """Mean margin of fresh trials."""
    queries = [Query(u, seeds.stream(99, "trial", number), spp=TRIAL_SPP) for number in range(TRIALS)]
    return statistics.fmean(one.evaluate(query).said.margin for query in queries)


def problem(space: str, resolution: int, spp: Any) -> Problem:
    """The bundled mug with one control."""
    config = AttackConfig(
        object="mug", controls={space: {}}, resolution=(resolution, resolution), measure="no", spp=spp
    )
    return problem_from_config(config)[0]


if __name__ == "__main__":
    sys.exit(main())
