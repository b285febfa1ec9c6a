"""Full factorial: a regular grid over a few numbers, as fine as the renders allow."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.attacks.domain import Block, Domain
from advsearch.attacks.policies.base import Evaluated, Policy, Proposal
from advsearch.errors import InputError


@dataclass(frozen=True, eq=False)
class GridState:
    """Where a grid stands.

    Attributes:
        axes: for each number the (m_i,) values that its element of u takes.
        order: (n,) numbers of the grid's points, coarse ones first.
        done: how many of them were proposed.
    """

    domain: Domain
    axes: tuple[Tensor, ...]
    order: Tensor
    done: int


@dataclass(frozen=True)
class Grid(Policy[GridState]):
    """Every combination of evenly spaced values, then nothing more.

    A number takes both its ends and what lies evenly between; an angle does not repeat its end; a discrete choice takes
    every option. Without `points`, numbers get one more value by turns as long as the whole grid fits into the renders.
    Points come coarse to fine: ends first, then middles, then quarters, so that a grid that is cut short has looked
    everywhere.

    An l-infinity ball is a box to a grid. Points outside an l2 ball are projected onto it, so they are not evenly
    spaced there. Either is of use in a few numbers only: a grid that does not fit into the renders is refused.

    Attributes:
        points: values for each number, at least 2; 0 for as many as fit.

    Raises:
        InputError: a value is outside what is said here; at the start, the grid (with two values for each number, if
            none are given) does not fit into the renders.
    """

    points: int = 0

    name: ClassVar[str] = "grid"
    uses_gradient: ClassVar[bool] = False
    handles_choices: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.points < 0 or self.points == 1:
            raise InputError(f"points: expected at least 2, or 0 for as many as fit, got {self.points}")

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> GridState:
        counts = _counts(domain, steps, self.points)
        low, high = _bounds(domain)
        blocks = [block for block in domain.blocks for _ in range(block.size)]
        axes = tuple(map(_axis, blocks, counts, low.tolist(), high.tolist()))
        return GridState(domain, axes, _coarse_to_fine(blocks, counts), 0)

    def propose(self, state: GridState, n: int) -> tuple[tuple[Proposal, ...], GridState]:
        numbers = state.order[state.done : state.done + n].tolist()
        proposals = tuple(Proposal(_point(state, number)) for number in numbers)
        return proposals, replace(state, done=state.done + len(numbers))

    def update(self, state: GridState, evaluated: Evaluated) -> GridState:
        return state


def _point(state: GridState, number: int) -> Tensor:
    """Return the configuration (d,) of a point of the grid."""
    values = []
    for axis in reversed(state.axes):
        number, place = divmod(number, len(axis))
        values.append(axis[place])
    return state.domain.project(torch.stack(values[::-1]))


def _counts(domain: Domain, steps: int, points: int) -> list[int]:
    """Return how many values each element of u takes."""
    options = [block.options for block in domain.blocks for _ in range(block.size)]
    numbers, combinations = options.count(0), math.prod(n for n in options if n)
    least = combinations * (points or 2) ** min(numbers, 64)
    if least > steps:
        more = f" and {combinations} combinations of options" if combinations > 1 else ""
        many = str(least) if least < 10**9 else "billions of"
        raise InputError(
            f"policy 'grid': {points or 2} values for each of {numbers} numbers{more} are {many} renders, and "
            f"there are {steps}; use policy sobol, cmaes, nes, pgd or auto, or give more `steps`"
        )
    each = points or max(2, int((steps // combinations) ** (1.0 / max(numbers, 1)) * (1 - 1e-9)))
    counts = [n or each for n in options]
    if points:
        return counts
    total, grew = math.prod(counts), True
    while grew and numbers:
        grew = False
        for j, fixed in enumerate(options):
            if not fixed and total // counts[j] * (counts[j] + 1) <= steps:
                total, grew = total // counts[j] * (counts[j] + 1), True
                counts[j] += 1
    return counts


def _bounds(domain: Domain) -> tuple[Tensor, Tensor]:
    """Return (d,) lower and upper ends of the axes: the domain's, and for an l2 ball the cube around it, cut."""
    low, high = domain.lower.clone(), domain.upper.clone()
    for block, part in domain.parts():
        if block.norm == "l2" and block.epsilon is not None:
            low[part] = low[part].maximum(domain.start[part] - block.epsilon)
            high[part] = high[part].minimum(domain.start[part] + block.epsilon)
    return low, high


def _axis(block: Block, count: int, low: float, high: float) -> Tensor:
    """Return (count,) evenly spaced values; an angle's end is its beginning and comes once."""
    if block.options:
        return (torch.arange(count) + 0.5) / count
    if block.periodic:
        return low + (high - low) * torch.arange(count) / count
    return torch.linspace(low, high, count)


def _coarse_to_fine(blocks: list[Block], counts: list[int]) -> Tensor:
    """Return (n,) numbers of all points (the last axis runs fastest), by the largest, then the sum of their levels."""
    largest, total = torch.zeros(1, dtype=torch.long), torch.zeros(1, dtype=torch.long)
    for block, count in zip(blocks, counts, strict=True):
        level = _levels(block, count)
        largest = torch.maximum(largest[:, None], level).flatten()
        total = (total[:, None] + level).flatten()
    return (largest * (int(total.max()) + 1) + total).argsort(stable=True)


def _levels(block: Block, count: int) -> Tensor:
    """Return (count,) how often an axis must be halved until a value is met: 0 for both ends and for every option."""
    level = torch.zeros(count, dtype=torch.long)
    gaps = [] if block.options else [(0, count if block.periodic else count - 1, 1)]
    while gaps:
        low, high, depth = gaps.pop()
        middle = (low + high) // 2
        if low < middle < high:
            level[middle] = depth
            gaps += [(low, middle, depth + 1), (middle, high, depth + 1)]
    return level
