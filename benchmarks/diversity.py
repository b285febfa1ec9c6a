"""Distinct failures that `archive` finds beside random search at equal renders: cells in which the model is wrong.

    python benchmarks/diversity.py [--policy archive] [--renders 1000] [--noise 0.2] [--seeds 10]

A cell is one of 10 x 10 over two parameters; it fails where at least one evaluated configuration in it is wrong,
without the noise. Nothing is rendered. Four closed forms over six parameters stand
for what is met; in three failures are rare, and beside the two parameters of the cells four others have to be right:

- ball: wrong within a distance of 0.25 of a point of the four others, which moves with the cell;
- corner: wrong where all four are over 0.65, more or less by cell;
- choice: one of six options is wrong, where two numbers lie in a band that moves with the cell;
- common: wrong in a third of all configurations, where no policy can find three times as many cells.

Prints the medians of both over the seeds, the ratio of these, and the smallest ratio.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from statistics import median

import torch
from torch import Tensor

from advsearch.attacks import Block, Domain, Evaluation, make_policy, search

SIDE = 10
"""Parts of the range of each of the two parameters."""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print a row for each scene; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--policy", default="archive")
    parser.add_argument("--renders", type=int, default=1000)
    parser.add_argument("--noise", type=float, default=0.2, help="of the objective, as a share of its deviation")
    parser.add_argument("--seeds", type=int, default=10)
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    print("| scene | cells by the policy | by random search | ratio | smallest ratio |")
    print("| --- | --- | --- | --- | --- |")
    for scene in SCENES:
        pairs = [
            tuple(len(failing_cells(scene, one, args.renders, args.noise, seed)) for one in (args.policy, "random"))
            for seed in range(args.seeds)
        ]
        ours, theirs = median(one for one, _ in pairs), median(other for _, other in pairs)
        least = min(one / max(other, 1) for one, other in pairs)
        print(f"| {scene} | {ours:g} | {theirs:g} | {ours / max(theirs, 1):.1f} | {least:.1f} |", flush=True)
    return 0


# ---- closed forms ---------------------------------------------------------------------------------------------------


def failing_cells(scene: str, policy: str, renders: int, noise: float, seed: int) -> set[tuple[int, int]]:
    """Return the cells of the first two parameters in which a configuration that the search evaluated is wrong."""
    domain, margin = SCENES[scene]
    sample = domain.sample(torch.Generator().manual_seed(99), 300)
    spread = float(torch.tensor([margin(u) for u in sample]).std())
    cells = set()

    def evaluate(u: Tensor, *, index: int, gradient: object, samples: int = 1) -> Evaluation:
        generator = torch.Generator().manual_seed(100_003 * seed + index)
        exact = margin(u)
        if exact > 0.0:
            cells.add(cell(float(u[0]), float(u[1])))
        seen = exact + noise * spread * float(torch.randn(1, generator=generator))
        return Evaluation(seen, None, seen > 0.0)

    search(evaluate, domain, make_policy(policy), steps=renders, seed=seed, candidates=0)
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
