"""Time and memory of a search step over two thousand steps: neither may grow.

    python benchmarks/growth.py [--steps 2000] [--size 64] [--transport | --over camera]

The speed of a machine that others use too drifts by more than what is looked for. So every step is followed by a fixed
piece of work that has nothing to do with the search (the model on a picture of its own), and the ratio of the two is
what may not grow: its trend over the steps behind the first tenth (by then every kernel is compiled and every pool is
filled), by Theil and Sen's slope, with a 95 % interval from a bootstrap over blocks. Memory is what is resident at the
end over that after the first tenth. With `--over`, cameras vary by chance, and light on surfaces predicts pictures; its
comparisons with traced ones, every hundred steps, are part of their steps.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import statistics
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import theilslopes

from advsearch import seeds, threads

threads.configure()

from advsearch.attacks import Evaluate, Query, make_policy  # noqa: E402
from advsearch.engine.surface_light import SurfaceLight  # noqa: E402
from advsearch.engine.transport import Transport  # noqa: E402
from advsearch.questions.attack.carry_out import parts_of, problem_of_parts  # noqa: E402
from advsearch.questions.attack.settings import AttackConfig  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=2000, help="steps of the search (default 2000)")
    parser.add_argument("--size", type=int, default=64, help="side of the picture in pixels (default 64)")
    parser.add_argument("--transport", action="store_true", help="predict pictures by a matrix of light transport")
    parser.add_argument("--over", help="controls that vary by chance, camera among them: light on surfaces predicts")
    args = parser.parse_args()
    settings: dict[str, Any] = {"controls": {"texture": {"epsilon": 0.05} if args.over else {}}, "spp": 4}
    config = AttackConfig(object="mug", over=args.over or (), resolution=args.size, steps=args.steps, **settings)
    problem, _ = problem_of_parts(parts_of(config))
    model, policy = problem.model, make_policy("pgd")
    traced, light = partial(map, problem.evaluate), SurfaceLight(problem, args.steps)
    answered: Evaluate = traced
    if args.over or args.transport:
        predictor = light if args.over else Transport(problem, args.steps)
        predictor.prepare()
        answered = partial(predictor.evaluate_all, traced=traced)
    state = policy.start(problem.domain, torch.Generator().manual_seed(0), args.steps)
    ratios, seconds, memory = [], [], []
    yardstick = torch.rand(16, args.size, args.size, 3)
    for index in range(args.steps):
        begun = time.perf_counter()
        proposals, state = policy.propose(state, 1)
        if not proposals:  # nothing more to propose: go on measuring from where it stands
            break
        u = proposals[0].u
        query = Query(u, seeds.stream(0, "search", index), number=index, phase="search", gradient=True)
        (answer,) = answered([query])
        state = policy.update(state, [(u, answer)])
        seconds.append(time.perf_counter() - begun)
        begun = time.perf_counter()
        with torch.no_grad():
            model(yardstick)
        ratios.append(seconds[-1] / (time.perf_counter() - begun))
        memory.append(resident())
    tenth = len(seconds) // 10
    early, late = statistics.median(seconds[tenth : 2 * tenth]), statistics.median(seconds[-tenth:])
    growth, low, high = trend(ratios[tenth:])
    print(f"{len(seconds)} steps at {args.size} x {args.size}")
    print(f"  time of a step against the yardstick, growth over all: {growth:+.2%} (95 %: {low:+.2%} to {high:+.2%})")
    print(f"  time of a step as it is, last tenth over second:       {late / early:.3f} (the machine's drift included)")
    print(f"  memory, end over after the first tenth:                {memory[-1] / memory[tenth]:.3f}")
    print(f"  memory at the end:                                     {memory[-1] / 2**20:.0f} MiB")
    if args.over:
        said = light.given_up or "all predicted"
        print(f"  {len(light.deviations)} comparisons, light found anew {light.renewed} times; {said}")


def trend(ratios: list[float], blocks: int = 60, draws: int = 400) -> tuple[float, float, float]:
    """Return the relative growth from the first to the last, and its 95 % interval, from medians of blocks."""
    medians = np.array([math.log(statistics.median(block)) for block in np.array_split(ratios, blocks)])
    at = np.linspace(0.0, 1.0, blocks)
    generator = np.random.default_rng(0)
    picks = [np.sort(generator.integers(0, blocks, blocks)) for _ in range(draws)]
    slopes = [theilslopes(medians[one], at[one])[0] for one in picks]
    low, high = np.quantile(slopes, (0.025, 0.975))
    return math.expm1(theilslopes(medians, at)[0]), math.expm1(low), math.expm1(high)


def resident() -> int:
    """Return this process's resident memory in bytes."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    main()
