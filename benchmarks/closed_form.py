"""Renders within which each policy reaches 1.05 of a known optimum, over closed-form
objectives without noise.

    python benchmarks/closed_form.py [--policy cmaes nes] [--objective "linear, l2"]
        [--seeds 10]
    python benchmarks/closed_form.py --write

Measures by trying ever larger budgets (10, 20, 50, ... 20,000 renders) until the search
of every seed reaches the optimum, and prints a row for each policy and objective as
`BUDGETS` states it below; tests hold policies to that. `--write` measures nothing; it
puts the stated numbers into docs/policies/README.md. They say what a policy can do
where nothing else is in the way: for a noisy objective, or gradients by differences, it
takes more.

Objectives, each with a start, a domain and an optimum that other seeds change:

- linear: w . (u - start), w standard normal, in an l-infinity ball of radius 0.1, an l2
  ball of radius 0.1 sqrt(d), or the unit box;
- quadratic: concave, curvatures from 1 to 8, its peak inside the unit box;
- hills: the largest of six Gaussian hills; the start is on the slope of a lower one.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from advsearch.attacks import (
    POLICIES,
    Block,
    Domain,
    Evaluation,
    Policy,
    Query,
    make_policy,
    search,
    seeded,
)
from advsearch.errors import InputError

LADDER = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000)
PAGE = Path(__file__).resolve().parents[1] / "docs" / "policies" / "README.md"

RATIO = 1.05
"""An optimum counts as reached where the objective is at least this fraction of it,
both measured from the start.
"""

DIMENSIONS: Mapping[str, tuple[int, ...]] = {
    "linear, linf": (2, 10, 100, 1000),
    "linear, l2": (2, 10, 100, 1000),
    "linear, box": (2, 10, 100, 1000),
    "quadratic, box": (2, 10, 100, 1000),
    "hills, box": (2, 3),
}
"""The objectives, and the dimensions that each is measured in."""

BUDGETS: Mapping[str, Mapping[str, tuple[int | None, ...]]] = {
    "adam": {
        "linear, linf": (10, 10, 10, 10),
        "linear, l2": (10, 10, 10, 10),
        "linear, box": (10, 10, 10, 10),
        "quadratic, box": (10, 10, 10, 10),
        "hills, box": (None, None),
    },
    "archive": {
        "linear, linf": (100, 5000, None, None),
        "linear, l2": (100, 1000, None, None),
        "linear, box": (50, 500, None, None),
        "quadratic, box": (50, 100, None, None),
        "hills, box": (50, 200),
    },
    "auto": {
        "linear, linf": (10, 10, 10, 10),
        "linear, l2": (10, 10, 10, 10),
        "linear, box": (10, 50, 50, 50),
        "quadratic, box": (20, 50, 20, 20),
        "hills, box": (50, 200),
    },
    "cmaes": {
        "linear, linf": (100, 500, 2000, None),
        "linear, l2": (50, 200, 2000, 10_000),
        "linear, box": (100, 200, 2000, None),
        "quadratic, box": (100, 500, 2000, 20_000),
        "hills, box": (2000, 5000),
    },
    "grid": {
        "linear, linf": (10, 2000, None, None),
        "linear, l2": (20, None, None, None),
        "linear, box": (10, 2000, None, None),
        "quadratic, box": (2000, None, None, None),
        "hills, box": (200, 2000),
    },
    "mixture": {
        "linear, linf": (200, None, None, None),
        "linear, l2": (100, 5000, None, None),
        "linear, box": (200, None, None, None),
        "quadratic, box": (1000, 2000, None, None),
        "hills, box": (500, 1000),
    },
    "nes": {
        "linear, linf": (50, 500, 10_000, None),
        "linear, l2": (50, 200, 2000, None),
        "linear, box": (50, 500, 10_000, None),
        "quadratic, box": (100, 200, 5000, None),
        "hills, box": (None, None),
    },
    "pgd": {
        "linear, linf": (10, 10, 10, 10),
        "linear, l2": (10, 10, 10, 10),
        "linear, box": (10, 10, 10, 10),
        "quadratic, box": (20, 10, 10, 10),
        "hills, box": (None, None),
    },
    "portfolio": {
        "linear, linf": (10, 10, 10, 10),
        "linear, l2": (10, 10, 10, 10),
        "linear, box": (50, 1000, 50, 50),
        "quadratic, box": (50, 500, 50, 50),
        "hills, box": (100, 1000),
    },
    "random": {
        "linear, linf": (20, 10_000, None, None),
        "linear, l2": (1000, None, None, None),
        "linear, box": (2000, None, None, None),
        "quadratic, box": (2000, None, None, None),
        "hills, box": (200, 5000),
    },
    "restarts": {
        "linear, linf": (20, 20, 20, 20),
        "linear, l2": (20, 20, 20, 20),
        "linear, box": (20, 20, 20, 20),
        "quadratic, box": (50, 50, 50, 50),
        "hills, box": (50, None),
    },
    "sobol": {
        "linear, linf": (1000, None, None, None),
        "linear, l2": (500, None, None, None),
        "linear, box": (2000, None, None, None),
        "quadratic, box": (5000, None, None, None),
        "hills, box": (200, 2000),
    },
}
"""Policy (with its defaults) -> objective -> renders for each of its dimensions; None
where 20,000 are too few.
"""

BEGIN = "<!-- made by benchmarks/closed_form.py -->\n"
END = "<!-- end -->"


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print, or write the stated numbers into the page; returns the exit
    status.
    """
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--policy", nargs="+", default=list(POLICIES), choices=list(POLICIES)
    )
    parser.add_argument(
        "--objective", nargs="+", default=list(DIMENSIONS), choices=list(DIMENSIONS)
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument(
        "--write",
        action="store_true",
        help="put the stated numbers into docs/policies/README.md",
    )
    args = parser.parse_args(argv)
    if args.write:
        PAGE.write_text(with_table(PAGE.read_text("utf-8")), encoding="utf-8")
        return 0
    torch.set_num_threads(1)
    for name in args.policy:
        for objective in args.objective:
            row = tuple(
                measured(make_policy(name), objective, d, args.seeds)
                for d in DIMENSIONS[objective]
            )
            print(f"{name}: {objective!r}: {row},", flush=True)
    return 0


def measured(policy: Policy[object], objective: str, d: int, seeds: int) -> int | None:
    """Return the first budget of the ladder within which every seed reaches the
    optimum; None if no budget does.
    """
    for renders in LADDER:
        if all(reached(policy, objective, d, renders, seed) for seed in range(seeds)):
            return renders
    return None


def reached(
    policy: Policy[object], objective: str, d: int, renders: int, seed: int
) -> bool:
    """Return whether a search comes within the ratio of the optimum; a policy that
    refuses does not.

    Raises:
        RuntimeError: the result lies outside the domain, or is better than the optimum.
    """
    problem = OBJECTIVES[objective](d, seed)
    try:
        result = search(
            partial(map, problem.evaluate),
            problem.domain,
            policy,
            steps=renders,
            seed=seed,
            candidates=0,
        )
    except InputError:
        return False
    value = problem.value(result.best_u)
    if not problem.domain.contains(result.best_u) or value > problem.optimum * (
        1.0 + 1e-4
    ):
        raise RuntimeError(
            f"{policy.name} on {objective!r} in {d}: {value} of "
            f"{problem.optimum}, or outside"
        )
    return value >= problem.optimum / RATIO


def table() -> str:
    """Return the stated budgets as Markdown: a row for each policy, a column for each
    objective.
    """

    def cell(numbers: tuple[int | None, ...]) -> str:
        return " · ".join(
            "–" if number is None else f"{number:,}" for number in numbers
        )

    heads = [
        "policy",
        *(
            f"{name}: {' · '.join(f'{d:,}' for d in dims)}"
            for name, dims in DIMENSIONS.items()
        ),
    ]
    rows = [heads, ["---"] * len(heads)]
    rows += [
        [f"`{name}`", *(cell(BUDGETS[name][objective]) for objective in DIMENSIONS)]
        for name in BUDGETS
    ]
    return "".join("| " + " | ".join(row) + " |\n" for row in rows)


def with_table(page: str) -> str:
    """Return the page with the table in its place."""
    before, _, rest = page.partition(BEGIN)
    return before + BEGIN + table() + END + rest.partition(END)[2]


# ---- the objectives
# ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Problem:
    """An objective that is zero at the start (hills: over zero), and its largest value
    on the domain.
    """

    domain: Domain
    value: Callable[[Tensor], float]
    gradient: Callable[[Tensor], Tensor]
    optimum: float

    def evaluate(self, query: Query) -> Evaluation:
        """Evaluate without noise; more samples change nothing but the cost."""
        value = self.value(query.u)
        slope = self.gradient(query.u) if query.gradient else None
        return Evaluation(value, slope, False, cost=query.samples)


def domain_of(start: Tensor, norm: str) -> Domain:
    d = start.numel()
    epsilon = {"linf": 0.1, "l2": 0.1 * math.sqrt(d), "box": None}[norm]
    return Domain(start, (Block(d, norm, epsilon),))  # type: ignore[arg-type]


def linear(norm: str) -> Callable[[int, int], Problem]:
    def make(d: int, seed: int) -> Problem:
        rng = seeded(seed, d)
        start = 0.2 + 0.6 * torch.rand(d, generator=rng)
        w = torch.randn(d, generator=rng)
        domain = domain_of(start, norm)
        best = (
            domain.project(start + 1e4 * w)
            if norm == "l2"
            else torch.where(w > 0, domain.upper_bounds, domain.lower_bounds)
        )

        def value(u: Tensor) -> float:
            return float(torch.dot(w.double(), (u - start).double()))

        return Problem(domain, value, lambda u: w, value(best))

    return make


def quadratic(d: int, seed: int) -> Problem:
    rng = seeded(seed, d)
    start = 0.2 + 0.6 * torch.rand(d, generator=rng)
    peak = 0.1 + 0.8 * torch.rand(d, generator=rng)
    curvature = torch.linspace(0.0, math.log(8.0), d).exp()

    def value(u: Tensor) -> float:
        return 0.5 * float(
            torch.dot(curvature, (start - peak).square() - (u - peak).square())
        )

    return Problem(
        domain_of(start, "box"), value, lambda u: curvature * (peak - u), value(peak)
    )


def hills(d: int, seed: int) -> Problem:
    rng = seeded(seed, d)
    centres = 0.1 + 0.8 * torch.rand(6, d, generator=rng)
    heights = torch.cat([torch.ones(1), 0.5 + 0.4 * torch.rand(5, generator=rng)])
    width = 0.12 * math.sqrt(d)

    def each(u: Tensor) -> Tensor:
        return heights * torch.exp(
            -(u - centres).square().sum(dim=1) / (2.0 * width**2)
        )

    def gradient(u: Tensor) -> Tensor:
        values = each(u)
        k = int(values.argmax())
        return values[k] * (centres[k] - u) / width**2

    # the hill farthest from the highest
    lower = int((centres[1:] - centres[0]).square().sum(dim=1).argmax()) + 1
    start = (centres[lower] + 0.1 * torch.randn(d, generator=rng)).clamp(0.0, 1.0)
    return Problem(
        domain_of(start, "box"), lambda u: float(each(u).amax()), gradient, 1.0
    )


OBJECTIVES: dict[str, Callable[[int, int], Problem]] = {
    "linear, linf": linear("linf"),
    "linear, l2": linear("l2"),
    "linear, box": linear("box"),
    "quadratic, box": quadratic,
    "hills, box": hills,
}

if __name__ == "__main__":
    sys.exit(main())
