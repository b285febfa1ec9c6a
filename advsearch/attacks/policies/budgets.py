"""How many renders each policy takes to come within 1.05 of a known optimum: measured figures, held to by tests.

`benchmarks/closed_form.py` defines the objectives, measures and prints these numbers. They say what a policy can do
where nothing else is in the way: no noise, gradients (where a policy takes them) for free. For a noisy objective, or
gradients by differences, a policy takes more.
"""

from __future__ import annotations

from collections.abc import Mapping

RATIO = 1.05
"""An optimum counts as reached where the objective is at least this fraction of it, both measured from the start."""

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
    "halving": {
        "linear, linf": (200, None, None, None),
        "linear, l2": (5000, None, None, None),
        "linear, box": (None, None, None, None),
        "quadratic, box": (None, None, None, None),
        "hills, box": (1000, None),
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
"""Policy (with its defaults) -> objective -> renders for each of its dimensions; None where 20,000 are too few."""


def budget(policy: str, objective: str, dimensions: int) -> int | None:
    """Return the renders that a registered policy states for an objective; None if it cannot do it within 20,000."""
    return BUDGETS[policy][objective][DIMENSIONS[objective].index(dimensions)]
