"""Policies that do not learn from evaluations: random search, the baseline of every
worst-case claim, and a grid, as fine as the renders allow. `NonAdaptivePolicy` is the
class over these.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.attacks.domain import Block, Domain, option_center
from advsearch.attacks.evaluation import Evaluated, Policy, Proposal, draw_seed, seeded
from advsearch.errors import InputError

NO_POINTS = torch.empty(0, 0)


@dataclass(frozen=True, eq=False)
class PointsState:
    """State of a search that does not use evaluations.

    Attributes:
        domain: domain of the search.
        seed: seed of random numbers.
        points: (n, k) points from which configurations are made: the full grid, or the
            current chunk of a sequence. Empty for random samples.
        n_proposed: number of configurations that were proposed so far.
    """

    domain: Domain
    seed: int = 0
    points: Tensor = NO_POINTS
    n_proposed: int = 0

    def propose(
        self, configurations: Iterable[Tensor]
    ) -> tuple[tuple[Proposal, ...], PointsState]:
        """Return proposals of configurations, and the state that counts them."""
        proposals = tuple(map(Proposal, configurations))
        return proposals, replace(self, n_proposed=self.n_proposed + len(proposals))


class NonAdaptivePolicy(Policy[PointsState]):
    """A policy whose proposals do not depend on evaluations."""

    uses_gradient: ClassVar[bool] = False
    handles_choices: ClassVar[bool] = True

    def update(self, state: PointsState, evaluated: Evaluated) -> PointsState:
        return state


@dataclass(frozen=True)
class Random(NonAdaptivePolicy):
    """Independent samples within the budget, alternately at the extremes of the norm
    balls and in their interior.

    The first is an extreme one. In many dimensions the corners of an l-infinity ball
    are better than its interior: a random corner changes a linear objective sqrt(3)
    times as much as a uniform sample. So a baseline without them would be too easy to
    beat. See `Domain.sample`.
    """

    name: ClassVar[str] = "random"

    def start(
        self, domain: Domain, generator: torch.Generator, steps: int
    ) -> PointsState:
        return PointsState(domain, draw_seed(generator))

    def propose(
        self, state: PointsState, n: int
    ) -> tuple[tuple[Proposal, ...], PointsState]:
        """Propose n samples, of which those with even numbers are extreme ones."""
        numbers = range(state.n_proposed, state.n_proposed + n)
        return state.propose(
            state.domain.sample(seeded(state.seed, k), extreme=k % 2 == 0)[0]
            for k in numbers
        )


def to_domain(domain: Domain, x: Tensor) -> Tensor:
    """Return the configuration (d,) for a point of the unit cube.

    Uniform points give uniform configurations, except in l2 balls that are cut by
    bounds.

    Args:
        domain: domain of the configuration.
        x: (d + number of l2 blocks,) in [0, 1]. The first d elements belong to those of
            u; the others decide the distance from the center in each l2 ball.
    """
    u = torch.lerp(domain.lower_bounds, domain.upper_bounds, x[: domain.dim])
    distance_numbers = iter(x[domain.dim :].tolist())  # one for each l2 ball, in order
    for block, part in domain.list_block_slices():
        if block.n_options:
            u[part] = option_center(x[part], block.n_options)
        elif block.norm == "l2" and block.epsilon is not None:
            # Normal quantiles of uniform numbers are a normal vector, whose direction
            # is uniform. They are infinite at 0 and 1, hence the clamp.
            direction = torch.special.ndtri(x[part].double().clamp(1e-9, 1.0 - 1e-9))
            # volume grows with distance**size, so this is uniform in the ball
            length = block.epsilon * next(distance_numbers) ** (1.0 / block.size)
            norm = max(float(torch.linalg.vector_norm(direction)), 1e-30)
            u[part] = domain.start[part] + (direction * (length / norm)).float()
    return domain.project(u)


@dataclass(frozen=True)
class Grid(NonAdaptivePolicy):
    """Every combination of evenly spaced values, then nothing more.

    The values of a number are both bounds and evenly spaced values between them. For an
    angle both bounds are the same, so only one of them is a value. A discrete choice
    has all its options. Without `points`, each number in turn gets one more value, as
    long as the grid fits into the renders. Points are ordered from coarse to fine:
    bounds first, then centers, then quarters. So a grid that is cut short covers the
    whole domain.

    An l-infinity ball is a box. Points outside an l2 ball are projected onto it, so
    they are not evenly spaced there. A grid is only useful for few numbers; it is
    rejected if it does not fit into the renders.

    Attributes:
        points: number of values of each number, at least 2; 0 for as many as fit.
    """

    points: int = 0

    name: ClassVar[str] = "grid"

    def __post_init__(self) -> None:
        if self.points < 0 or self.points == 1:
            raise InputError(
                "points: expected at least 2, or 0 for as many as fit, "
                f"got {self.points}"
            )

    def start(
        self, domain: Domain, generator: torch.Generator, steps: int
    ) -> PointsState:
        """Start with all points of the grid, sorted from coarse to fine."""
        counts = _count_values(domain, steps, self.points)
        points = torch.cartesian_prod(*_make_axes(domain, counts))
        points = points.reshape(-1, domain.dim)  # of a single axis it would be (n,)
        order = _order_coarse_to_fine(_list_block_of_elements(domain), counts)
        return PointsState(domain, points=points[order])

    def propose(
        self, state: PointsState, n: int
    ) -> tuple[tuple[Proposal, ...], PointsState]:
        next_points = state.points[state.n_proposed :][:n]
        return state.propose(map(state.domain.project, next_points))


def _list_block_of_elements(domain: Domain) -> list[Block]:
    """Return the block of each element of u."""
    return [block for block in domain.blocks for _ in range(block.size)]


def _make_axes(domain: Domain, counts: Sequence[int]) -> list[Tensor]:
    """Return the grid's values for each element of u, ascending, (count,) each.

    An l2 ball is replaced by the smallest cube around it, cut by the block's bounds.

    Args:
        domain: domain of the search.
        counts: number of values of each element.
    """
    lower = domain.lower_bounds.clone()
    upper = domain.upper_bounds.clone()
    for block, part in domain.list_block_slices():
        if block.norm == "l2" and block.epsilon is not None:
            lower[part] = lower[part].maximum(domain.start[part] - block.epsilon)
            upper[part] = upper[part].minimum(domain.start[part] + block.epsilon)
    blocks = _list_block_of_elements(domain)
    elements = zip(blocks, counts, lower.tolist(), upper.tolist(), strict=True)
    return [_make_axis(*element) for element in elements]


def _make_axis(block: Block, count: int, low: float, high: float) -> Tensor:
    """Return `count` values of one element of u between two bounds, ascending."""
    is_choice = block.n_options > 0
    if is_choice:  # the center of each option's part of [0, 1]
        return (torch.arange(count) + 0.5) / count
    if block.periodic:  # both bounds are the same angle: only one is listed
        return low + (high - low) * torch.arange(count) / count
    return torch.linspace(low, high, count)


def _order_coarse_to_fine(blocks: Sequence[Block], counts: Sequence[int]) -> Tensor:
    """Return the indices of all points of a grid, (n,), the coarse ones first.

    A value at a bound of an axis has level 0, at the center 1, at a quarter 2, and so
    on (`_compute_levels`). Points are sorted by the largest level of their values, then
    by the sum of the levels. So a search that ends early has evaluated a coarse grid.
    Indices are those of `torch.cartesian_prod`, in which the last axis varies fastest.

    Args:
        blocks: block of each axis.
        counts: number of values of each axis.
    """
    # (n,) for all points of the grid over the axes so far, which is empty at first
    max_level = torch.zeros(1, dtype=torch.long)
    level_sum = torch.zeros(1, dtype=torch.long)
    for axis_level in map(_compute_levels, blocks, counts):
        # Every point so far is combined with every value of this axis: (n, count),
        # which `flatten` numbers with the last axis fastest.
        max_level = torch.maximum(max_level[:, None], axis_level).flatten()
        level_sum = (level_sum[:, None] + axis_level).flatten()
    # Sorts by the pair (max_level, level_sum): the factor exceeds every sum.
    factor = int(level_sum.max()) + 1
    sort_key = max_level * factor + level_sum
    return sort_key.argsort(stable=True)


def _count_values(domain: Domain, steps: int, points: int) -> list[int]:
    """Return how many values the grid has for each element of u.

    A choice has all its options. Numbers have `points` values each, or as many as the
    renders allow, at least 2.

    Args:
        domain: domain to search.
        steps: renders that the grid may take.
        points: number of values of each number; 0 for as many as fit.

    Raises:
        InputError: the grid does not fit into the renders.
    """
    options = domain.option_counts.tolist()  # 0 for a number
    _check_grid_fits(options, steps, min_values=points or 2)
    if points:
        return [n_options or points for n_options in options]
    return _fill_budget(options, steps)


def _check_grid_fits(options: Sequence[int], steps: int, min_values: int) -> None:
    """Raise InputError if a grid does not fit into the renders.

    Args:
        options: number of options of each element; 0 for a number.
        steps: renders that the grid may take.
        min_values: smallest number of values of each number.
    """
    n_numbers = options.count(0)
    n_combinations = math.prod(count for count in options if count)
    # 2^64 exceeds any budget already; a larger power would only take long to compute
    min_renders = n_combinations * min_values ** min(n_numbers, 64)
    if min_renders > steps:
        combinations_text = ""
        if n_combinations > 1:
            combinations_text = f" and {n_combinations} combinations of options"
        renders_text = "billions of" if min_renders >= 10**9 else str(min_renders)
        raise InputError(
            f"policy 'grid': {min_values} values for each of {n_numbers} "
            f"numbers{combinations_text} are {renders_text} renders, and there are "
            f"{steps}; use policy sobol, cmaes, nes, pgd or auto, or give more `steps`"
        )


def _fill_budget(options: Sequence[int], steps: int) -> list[int]:
    """Return how many values each element of u has so that the grid just fits.

    Args:
        options: number of options of each element; 0 for a number, which gets at least
            2 values.
        steps: largest number of points of the grid.
    """
    n_combinations = math.prod(count for count in options if count)
    root = (steps // n_combinations) ** (1.0 / max(options.count(0), 1))
    # reduced a little, as rounding errors might make the root too large
    values_each = max(2, int(root * (1 - 1e-9)))
    counts = [count or values_each for count in options]
    numbers = [index for index, n_options in enumerate(options) if not n_options]
    _grow_axes(counts, numbers, steps)
    return counts


def _grow_axes(counts: list[int], numbers: Sequence[int], steps: int) -> None:
    """Give each number of a grid one more value in turn, as long as the grid fits.

    Args:
        counts: number of values of each element of u; it is changed.
        numbers: indices of the elements that are numbers.
        steps: largest number of points of the grid.
    """
    total = math.prod(counts)
    has_grown = True
    while has_grown:
        has_grown = False
        for index in numbers:
            grown_total = total // counts[index] * (counts[index] + 1)
            if grown_total <= steps:
                total = grown_total
                counts[index] += 1
                has_grown = True


def _compute_levels(block: Block, count: int) -> Tensor:
    """Return the level (count,) of each value of an axis.

    It is how often the axis must be halved until the value is reached: 0 at both
    bounds, 1 at the center. All options of a choice have level 0.
    """
    level = torch.zeros(count, dtype=torch.long)
    if block.n_options:
        return level
    # The upper bound of an angle has the index `count`. It equals the lower bound, and
    # is no value of the axis.
    last = count if block.periodic else count - 1
    gaps = [(0, last, 1)]  # (lower index, upper index, level of the middle between)
    while gaps:
        lower, upper, depth = gaps.pop()
        middle = (lower + upper) // 2
        if lower < middle < upper:
            level[middle] = depth
            gaps += [(lower, middle, depth + 1), (middle, upper, depth + 1)]
    return level
