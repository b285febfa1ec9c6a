"""Compares a policy with random search at equal renders on closed-form objectives: how
often it is not worse.

    python benchmarks/policies.py [--policy auto] [--renders 40] [--noise 0 0.3]
        [--dimensions 1 3 6 12] [--seeds 6]

Objectives stand for what is met over poses, lights and choices: a bowl, a ramp, bumps,
waves of several lengths down to that of a pixel, a saturated margin, angles, and
choices. Each is divided by its standard deviation over the domain, and noise of a given
size in that unit is added to what a policy sees. The results are compared without
noise: "not worse" means better than random's or within 0.05.
"""

from __future__ import annotations

import argparse
import math
import sys
import zlib
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
import torch

from advsearch.attacks import (
    Block,
    Domain,
    Evaluation,
    Policy,
    Query,
    make_policy,
    search,
)

Doubles = npt.NDArray[np.float64]
Function = Callable[[Doubles], Doubles]
"""From (n, d) configurations to (n,) values."""
TIE = 0.05


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print one row for each noise; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--policy", default="auto")
    parser.add_argument("--renders", type=int, nargs="+", default=[40])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.3])
    parser.add_argument("--dimensions", type=int, nargs="+", default=[1, 3, 6, 12])
    parser.add_argument("--seeds", type=int, default=6)
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    print(
        "| renders | noise / standard deviation of the objective | not worse | "
        "better | searches |"
    )
    print("| --- | --- | --- | --- | --- |")
    for renders in args.renders:
        for noise in args.noise:
            gaps = np.array(
                [
                    gap(make_policy(args.policy), kind, d, renders, noise, seed)
                    for kind in KINDS
                    for d in args.dimensions
                    for seed in range(args.seeds)
                ]
            )
            not_worse = float((gaps > -TIE).mean())
            better = float((gaps > TIE).mean())
            print(
                f"| {renders} | {noise:g} | {100 * not_worse:.0f} % | "
                f"{100 * better:.0f} % | {len(gaps)} |",
                flush=True,
            )
    return 0


def gap(
    policy: Policy[object], kind: str, d: int, renders: int, noise: float, seed: int
) -> float:
    """How much better what a policy finds is than what random search finds, without
    noise, in standard deviations.
    """
    rng = np.random.default_rng([seed, d, zlib.crc32(kind.encode())])
    domain, function = KINDS[kind](rng, d)
    sample = domain.sample(torch.Generator().manual_seed(99), 500).double().numpy()
    spread = float(function(sample).std()) or 1.0

    def answer(by: Policy[object]) -> float:
        def evaluate(query: Query) -> Evaluation:
            key = [
                seed,
                query.row_index,
                zlib.crc32(query.u.numpy().tobytes()),
                zlib.crc32(by.name.encode()),
            ]
            value = float(function(query.u.double().numpy()[None])[0]) / spread
            value += noise * float(np.random.default_rng(key).normal())
            return Evaluation(value, None, False)

        found = search(
            partial(map, evaluate), domain, by, steps=renders, seed=seed
        ).best_u
        return float(function(found.double().numpy()[None])[0]) / spread

    return answer(policy) - answer(make_policy("random"))


# ---- the objectives
# ---------------------------------------------------------------------------


def waves(
    rng: np.random.Generator, d: int, length: float, count: int = 200
) -> Function:
    """A random smooth function whose features have about a given length (random Fourier
    features).
    """
    directions = rng.normal(size=(count, d)) / length
    phases = rng.uniform(0.0, 2.0 * np.pi, count)
    sizes = rng.normal(size=count)
    return lambda x: np.asarray(
        math.sqrt(2.0 / count) * np.cos(x @ directions.T + phases) @ sizes
    )


def box(rng: np.random.Generator, d: int, *blocks: Block) -> Domain:
    """The unit box, or blocks that fill it, with a start near the middle; choices start
    at their first option.
    """
    start = rng.uniform(0.3, 0.7, d)
    parts = blocks or (Block(d),)
    begin = 0
    for block in parts:
        if block.n_options:
            start[begin] = 0.5 / block.n_options
        begin += block.size
    return Domain(
        torch.tensor(start, dtype=torch.float32), tuple(parts), gradient_cost=10**6
    )


def bowl(rng: np.random.Generator, d: int) -> tuple[Domain, Function]:
    centre = rng.uniform(0.1, 0.9, d)
    steepness = rng.uniform(0.5, 2.0, d)
    return box(rng, d), lambda x: np.asarray(
        -((x - centre) ** 2 * steepness).sum(axis=1)
    )


def ramp(rng: np.random.Generator, d: int) -> tuple[Domain, Function]:
    slope = rng.normal(size=d)
    return box(rng, d), lambda x: np.asarray(x @ slope)


def bumps(rng: np.random.Generator, d: int) -> tuple[Domain, Function]:
    centres = rng.uniform(0.1, 0.9, (6, d))
    heights = rng.uniform(0.4, 1.0, 6)
    widths = rng.uniform(0.15, 0.3, 6) * math.sqrt(d)

    def function(x: Doubles) -> Doubles:
        squares = ((x[:, None] - centres) ** 2).sum(axis=2)
        return np.asarray((heights * np.exp(-squares / (2.0 * widths**2))).max(axis=1))

    return box(rng, d), function


def of_length(
    length: float,
) -> Callable[[np.random.Generator, int], tuple[Domain, Function]]:
    """Waves whose length is this share of the box's diagonal."""
    return lambda rng, d: (box(rng, d), waves(rng, d, length * math.sqrt(d)))


def two_scales(rng: np.random.Generator, d: int) -> tuple[Domain, Function]:
    slow = waves(rng, d, 0.35 * math.sqrt(d))
    fast = waves(rng, d, 0.03 * math.sqrt(d))
    return box(rng, d), lambda x: np.asarray(slow(x) + 0.5 * fast(x))


def saturated(rng: np.random.Generator, d: int) -> tuple[Domain, Function]:
    inner = waves(rng, d, 0.3 * math.sqrt(d))
    return box(rng, d), lambda x: np.asarray(np.tanh(3.0 * (inner(x) - 1.5)))


def angles(rng: np.random.Generator, d: int) -> tuple[Domain, Function]:
    turns = max(1, d // 2)
    orders = rng.integers(-2, 3, (60, turns))
    slopes = rng.normal(size=(60, d - turns)) / 0.5
    phases = rng.uniform(0.0, 2.0 * np.pi, 60)
    sizes = rng.normal(size=60)
    rough = waves(rng, d, 0.03 * math.sqrt(d))

    def function(x: Doubles) -> Doubles:
        inner = 2.0 * np.pi * x[:, :turns] @ orders.T + x[:, turns:] @ slopes.T + phases
        return np.asarray(math.sqrt(2.0 / 60) * np.cos(inner) @ sizes + 0.3 * rough(x))

    rest = (Block(d - turns),) if d > turns else ()
    return box(rng, d, Block(turns, periodic=True), *rest), function


def choices(rng: np.random.Generator, d: int) -> tuple[Domain, Function]:
    counts = (3, 8)[: min(2, d)]
    ways = len(counts)
    levels = [rng.normal(size=count) for count in counts]
    beside = [
        waves(rng, max(1, d - ways), 0.4 * math.sqrt(max(1, d - ways)))
        for _ in range(counts[0])
    ]

    def function(x: Doubles) -> Doubles:
        chosen = [
            np.minimum((x[:, j] * counts[j]).astype(int), counts[j] - 1)
            for j in range(ways)
        ]
        value = np.sum([levels[j][chosen[j]] for j in range(ways)], axis=0)
        if d > ways:
            value = (
                value
                + np.stack([one(x[:, ways:]) for one in beside])[
                    chosen[0], np.arange(len(x))
                ]
            )
        return np.asarray(value)

    rest = (Block(d - ways),) if d > ways else ()
    return box(
        rng, d, *(Block(1, n_options=count) for count in counts), *rest
    ), function


KINDS: dict[str, Callable[[np.random.Generator, int], tuple[Domain, Function]]] = {
    "bowl": bowl,
    "ramp": ramp,
    "bumps": bumps,
    "long waves": of_length(0.35),
    "waves": of_length(0.15),
    "pixel-scale waves": of_length(0.03),
    "two scales": two_scales,
    "saturated": saturated,
    "angles": angles,
    "choices": choices,
}

if __name__ == "__main__":
    sys.exit(main())
