"""Objectives in closed form for the stability suite, and how badly scaled an objective is. Pure torch."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.attacks import Block, Domain, Evaluation, Query

Value = Callable[[Tensor], Tensor]
"""From (d,) float64 in [0, 1] to a number with a graph; the larger the better."""
Disturb = Callable[[Tensor, int], Tensor]
"""From a gradient (d,) float32 and the number of its evaluation to the gradient that the policy sees."""


@dataclass
class Toy:
    """An objective without a renderer, as a search wants it.

    Attributes:
        value: the objective.
        domain: where.
        scale: factor on the objective, as if it were in other units.
        disturb: what becomes of gradients.
        broken: numbers of evaluations whose objective is NaN, as is their gradient.
        threshold: an objective over it is a success.
    """

    value: Value
    domain: Domain
    scale: float = 1.0
    disturb: Disturb | None = None
    broken: frozenset[int] = frozenset()
    threshold: float = math.inf

    def __call__(self, query: Query) -> Evaluation:
        """Answer a query; gradients cost nothing."""
        at = query.u.detach().double().requires_grad_()
        value = self.scale * self.value(at)
        slope = None
        if query.gradient:
            (slope,) = torch.autograd.grad(value, at)
            slope = slope.float()
            if self.disturb is not None:
                slope = self.disturb(slope, query.number)
        objective = float(value.detach())
        if query.number in self.broken:
            objective = math.nan
            slope = None if slope is None else torch.full_like(slope, math.nan)
        return Evaluation(objective, slope, objective > self.threshold, cost=query.samples)


def box_domain(start: Sequence[float]) -> Domain:
    """Return a box in which every number is a block of its own, as parameters of controls are."""
    return Domain(torch.tensor(start), tuple(Block(1, name=f"number {i}") for i in range(len(start))))


def quadratic(peak: Sequence[float], curvatures: Sequence[float]) -> Value:
    """Return minus half the sum of curvature x squared distance from the peak."""
    middle, weights = torch.tensor(peak, dtype=torch.float64), torch.tensor(curvatures, dtype=torch.float64)
    return lambda u: -0.5 * (weights * (u - middle).square()).sum()


def valley(u: Tensor) -> Tensor:
    """Rosenbrock's curved valley (1960), turned over: 0 at its peak u = (0.75, 0.75), condition number there 2508.

    x = 4 u - 2, value = -(100 (x_2 - x_1^2)^2 + (1 - x_1)^2).
    """
    x, y = 4.0 * u[0] - 2.0, 4.0 * u[1] - 2.0
    return -(100.0 * (y - x.square()).square() + (1.0 - x).square())


def hessian(value: Callable[[Tensor], float], u: Tensor, directions: Tensor, steps: Sequence[float]) -> Tensor:
    """Estimate second derivatives by differences.

    Args:
        value: the objective; with common random numbers where it is noisy.
        u: (d,) where.
        directions: (k, d).
        steps: k half-widths.

    Returns:
        (k, k) float64, symmetric: second derivatives along the directions.
    """
    moves = [step * direction for step, direction in zip(steps, directions, strict=True)]
    here, found = value(u), torch.zeros(len(moves), len(moves), dtype=torch.float64)
    for i, one in enumerate(moves):
        found[i, i] = (value(u + one) - 2.0 * here + value(u - one)) / steps[i] ** 2
        for j, other in enumerate(moves[:i]):
            crossed = value(u + one + other) - value(u + one - other) - value(u - one + other) + value(u - one - other)
            found[i, j] = found[j, i] = crossed / (4.0 * steps[i] * steps[j])
    return found


def condition_number(second: Tensor) -> float:
    """Return the largest over the smallest absolute eigenvalue of a symmetric matrix (k, k); infinite if that is 0."""
    sizes = torch.linalg.eigvalsh(second.double()).abs()
    return float(sizes.max() / sizes.min()) if float(sizes.min()) > 0.0 else math.inf
