"""Distinct failures that `archive` finds beside random search at equal renders: cells in which the model is wrong.

    python benchmarks/diversity.py [--policy archive] [--renders 1000] [--noise 0.2] [--seeds 10]
    python benchmarks/diversity.py --rendered banana chair hammer [--renders 300] [--seeds 1] [--resolution 64]

A cell is one of 10 x 10 over two parameters. In the first, nothing is rendered: a cell fails where at least one
evaluated configuration in it is wrong, without the noise. Four closed forms over six parameters stand for what is met;
in three failures are rare, and beside the two parameters of the cells four others have to be right:

- ball: wrong within a distance of 0.25 of a point of the four others, which moves with the cell;
- corner: wrong where all four are over 0.65, more or less by cell;
- choice: one of six options is wrong, where two numbers lie in a band that moves with the cell;
- common: wrong in a third of all configurations, where no policy can find three times as many cells.

The second renders bundled objects with the reference model, over the ten parameters of pose and camera; cells are over
pose.yaw and camera.elevation. A cell fails where the worst configuration that was met in it is wrong in each of two
fresh renders of 16 samples a pixel. It also prints the share of failures in the random search.

Both print the medians of both over the seeds, the ratio of these, and the smallest ratio.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from statistics import median
from typing import Any

import torch
from torch import Tensor

from advsearch import threads
from advsearch.attacks import Block, Domain, Evaluation, Policy, Query, StepRecord, make_policy, search
from advsearch.engine.problem import Problem
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.seeds import stream

SIDE = 10
"""Parts of the range of each of the two parameters."""

OVER = "pose.yaw,camera.elevation"
"""The two parameters, where pictures are rendered."""

TRIALS, TRIAL_SPP = 2, 16


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print a row for each scene; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--policy", default="archive")
    parser.add_argument("--renders", type=int, default=1000)
    parser.add_argument("--noise", type=float, default=0.2, help="of the objective, as a share of its deviation")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--rendered", nargs="+", default=[], metavar="OBJECT")
    parser.add_argument("--resolution", type=int, default=64)
    args = parser.parse_args(argv)
    print("| scene | cells by the policy | by random search | ratio | smallest ratio |")
    print("| --- | --- | --- | --- | --- |")
    seeds = range(args.seeds)
    if args.rendered:
        threads.configure(None)
        for name in args.rendered:
            problem = _problem(name, args.resolution)
            pairs, rates = [], []
            for seed in seeds:
                theirs, rate = rendered_cells(problem, make_policy("random"), args.renders, seed)
                ours, _ = rendered_cells(problem, make_policy(args.policy, over=OVER), args.renders, seed)
                pairs.append((len(ours), len(theirs)))
                rates.append(rate)
            _print(f"{name}, {100 * median(rates):.0f} % wrong", pairs)
        return 0
    torch.set_num_threads(1)
    for scene in SCENES:
        both = [
            [failing_cells(scene, one, args.renders, args.noise, k) for k in seeds] for one in (args.policy, "random")
        ]
        _print(scene, [(len(ours), len(theirs)) for ours, theirs in zip(*both, strict=True)])
    return 0


def _print(scene: str, pairs: Sequence[tuple[int, int]]) -> None:
    """Print a row: cells of the policy and of random search by seed."""
    ours, theirs = median(one for one, _ in pairs), median(other for _, other in pairs)
    least = min(one / max(other, 1) for one, other in pairs)
    print(f"| {scene} | {ours:g} | {theirs:g} | {ours / max(theirs, 1):.1f} | {least:.1f} |", flush=True)


# ---- rendered -------------------------------------------------------------------------------------------------------


def _problem(name: str, resolution: int) -> Problem:
    config = AttackConfig(object=name, controls={"pose": {}, "camera": {}}, resolution=resolution, measure="no")
    return problem_from_config(config)[0]


def rendered_cells(
    problem: Problem, policy: Policy[Any], renders: int, seed: int
) -> tuple[set[tuple[int, int]], float]:
    """Return the cells over `OVER` in which a search met a failure that holds, and the share of its wrong renders."""
    problem.seed = stream(31, "diversity", seed)
    first, second = (problem.domain.names.index(name) for name in OVER.split(","))
    worst: dict[tuple[int, int], tuple[float, Tensor]] = {}
    wrong = 0

    def note(record: StepRecord, u: Tensor, evaluation: Evaluation) -> None:
        nonlocal wrong
        at = cell(float(u[first]), float(u[second]))
        wrong += evaluation.success
        if evaluation.success and (at not in worst or evaluation.objective > worst[at][0]):
            worst[at] = evaluation.objective, u.clone()

    search(
        partial(map, problem.evaluate),
        problem.domain,
        policy,
        steps=renders,
        seed=seed,
        candidates=0,
        on_step=note,
        kind=policy.name,
        noise=problem.seed,
    )

    def holds(u: Tensor) -> bool:
        queries = (Query(u, stream(problem.seed, "again", number), spp=TRIAL_SPP) for number in range(TRIALS))
        return all(problem.evaluate(query).success for query in queries)

    return {at for at, (_, u) in worst.items() if holds(u)}, wrong / renders


# ---- closed forms ---------------------------------------------------------------------------------------------------


def failing_cells(scene: str, policy: str, renders: int, noise: float, seed: int) -> set[tuple[int, int]]:
    """Return the cells of the first two parameters in which a configuration that the search evaluated is wrong."""
    domain, margin = SCENES[scene]
    sample = domain.sample(torch.Generator().manual_seed(99), 300)
    spread = float(torch.tensor([margin(u) for u in sample]).std())
    cells = set()

    def evaluate(query: Query) -> Evaluation:
        generator = torch.Generator().manual_seed(100_003 * seed + query.number)
        exact = margin(query.u)
        if exact > 0.0:
            cells.add(cell(float(query.u[0]), float(query.u[1])))
        seen = exact + noise * spread * float(torch.randn(1, generator=generator))
        return Evaluation(seen, None, seen > 0.0)

    search(partial(map, evaluate), domain, make_policy(policy), steps=renders, seed=seed, candidates=0)
    return cells


def cell(first: float, second: float) -> tuple[int, int]:
    """Return the cell of two shares of a range."""
    return min(int(SIDE * first), SIDE - 1), min(int(SIDE * second), SIDE - 1)


def ball(u: Tensor) -> float:
    """Over 0 near a point of the last four numbers that moves with the first two."""
    centre = 0.5 + 0.2 * torch.stack([u[0] - 0.5, u[1] - 0.5, 0.5 - u[0], u[0] - u[1]])
    return 0.25 - float((u[2:] - centre).norm())


def corner(u: Tensor) -> float:
    """Over 0 where the last four numbers are large."""
    return float(u[2:].min()) - 0.65 - 0.1 * math.sin(6.0 * float(u[0])) * math.cos(4.0 * float(u[1]))


def choice(u: Tensor) -> float:
    """Over 0 under the third of six options, where two numbers lie in a band."""
    away = abs(float(u[3]) - 0.3 - 0.4 * float(u[0])) + abs(float(u[4]) - 0.7 + 0.4 * float(u[1]))
    return 0.25 - away - (0.0 if int(6 * float(u[2])) == 2 else 1.0)


def common(u: Tensor) -> float:
    """Over 0 in a third of all."""
    return float(u[2] + u[3]) - 1.18


BOX = Domain(torch.full((6,), 0.2), tuple(Block(1, name=f"number {k}") for k in range(6)))
MIXED = Domain(
    torch.full((5,), 0.25),
    tuple(Block(1, name=f"number {k}", options=6 if k == 2 else 0) for k in range(5)),
)
SCENES: dict[str, tuple[Domain, Callable[[Tensor], float]]] = {
    "ball": (BOX, ball),
    "corner": (BOX, corner),
    "choice": (MIXED, choice),
    "common": (BOX, common),
}


if __name__ == "__main__":
    sys.exit(main())
