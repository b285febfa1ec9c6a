"""Policies that look without learning: random search, the baseline of every worst-case
claim; quasi-random points, which fill the domain more evenly; and a grid, as fine as
the renders allow.
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

MAX_SOBOL_DIM = (
    21_201  # Scipy has direction numbers for so many dimensions (Joe and Kuo 2008)
)
# numbers of a Sobol sequence that are drawn and kept at once, at most, and one point at
# least
MAX_CHUNK_NUMBERS = 2**20


NO_POINTS = torch.empty(0, 0)


@dataclass(frozen=True, eq=False)
class PointsState:
    """Where a search stands that does not look at evaluations: how many configurations
    are done, and what the next ones come from, if not from the seed alone: points (n,
    k), the whole grid or so many of a sequence.
    """

    domain: Domain
    seed: int = 0
    points: Tensor = NO_POINTS
    n_proposed: int = 0

    def propose(self, us: Iterable[Tensor]) -> tuple[tuple[Proposal, ...], PointsState]:
        proposals = tuple(map(Proposal, us))
        return proposals, replace(self, n_proposed=self.n_proposed + len(proposals))


class NonAdaptivePolicy(Policy[PointsState]):
    """A policy that proposes what it would propose anyway."""

    uses_gradient: ClassVar[bool] = False
    handles_choices: ClassVar[bool] = True

    def update(self, state: PointsState, evaluated: Evaluated) -> PointsState:
        return state


@dataclass(frozen=True)
class Random(NonAdaptivePolicy):
    """Independent samples within the budget, by turns at the extremes of the norm balls
    and in their interior.

    The first is an extreme one: in many dimensions the corners of an l-infinity ball
    beat its interior (a random corner moves a linear objective sqrt(3) times as far as
    a uniform sample), so a baseline without them would be too easy to win against. See
    `Domain.sample`.
    """

    name: ClassVar[str] = "random"

    def start(
        self, domain: Domain, generator: torch.Generator, steps: int
    ) -> PointsState:
        return PointsState(domain, draw_seed(generator))

    def propose(
        self, state: PointsState, n: int
    ) -> tuple[tuple[Proposal, ...], PointsState]:
        numbers = range(state.n_proposed, state.n_proposed + n)
        return state.propose(
            state.domain.sample(seeded(state.seed, k), extreme=k % 2 == 0)[0]
            for k in numbers
        )


@dataclass(frozen=True)
class Sobol(NonAdaptivePolicy):
    """A scrambled Sobol sequence over the whole domain (Sobol 1967; scrambled as by
    Owen 1998, Matousek 1998).

    - bounds and l-infinity balls: the sequence's number, stretched to what bounds and
    ball leave;
    - a discrete choice: the middle of the option it falls on;
    - an l2 ball: a direction from the normal quantiles of the block's numbers, and a
      radius from one number more, so that points are uniform in the ball; then
      projected onto the bounds.

    In a few dimensions it finds what `random` finds in fewer renders; the advantage is
    gone after a dozen. The points of one sequence do not depend on what they are worth,
    so they are a fair sample of the domain's average too.
    """

    name: ClassVar[str] = "sobol"

    def start(
        self, domain: Domain, generator: torch.Generator, steps: int
    ) -> PointsState:
        size = domain.dim + sum(block.norm == "l2" for block in domain.blocks)
        if size > MAX_SOBOL_DIM:
            raise InputError(
                f"policy 'sobol': expected at most {MAX_SOBOL_DIM} dimensions, got "
                f"{size}; use "
                "policy random, nes, pgd or auto"
            )
        seed = draw_seed(generator)
        most = max(1, MAX_CHUNK_NUMBERS // size)
        count = 2 ** max(0, min(steps - 1, most - 1).bit_length())
        return PointsState(domain, seed, sample_sobol_points(size, seed, 0, count))

    def propose(
        self, state: PointsState, n: int
    ) -> tuple[tuple[Proposal, ...], PointsState]:
        count, size = state.points.shape
        if state.n_proposed and state.n_proposed % count == 0:
            state = replace(
                state,
                points=sample_sobol_points(size, state.seed, state.n_proposed, count),
            )
        return state.propose(
            to_domain(state.domain, x)
            for x in state.points[state.n_proposed % count :][:n]
        )


def sample_sobol_points(size: int, seed: int, begin: int, count: int) -> Tensor:
    """Return `count` points of the scrambled sequence of that seed from number `begin`
    on: (count, size) float32. The first call takes a power of two, which is what keeps
    the points balanced.
    """
    from scipy.stats import qmc  # takes most of a second, and few runs need it

    engine = qmc.Sobol(size, scramble=True, seed=seed)
    if begin:
        engine.fast_forward(begin)
    return torch.from_numpy(engine.random(count)).float()


def to_domain(domain: Domain, x: Tensor) -> Tensor:
    """Return the configuration (d,) for a point (d + number of l2 blocks,) of the unit
    cube; see `Sobol`.
    """
    u = torch.lerp(domain.lower, domain.upper, x[: domain.dim])
    radii = iter(x[domain.dim :].tolist())
    for block, part in domain.list_block_slices():
        if block.options:
            u[part] = option_center(x[part], block.options)
        elif block.norm == "l2" and block.epsilon is not None:
            direction = torch.special.ndtri(x[part].double().clamp(1e-9, 1.0 - 1e-9))
            length = block.epsilon * next(radii) ** (1.0 / block.size)
            norm = max(float(torch.linalg.vector_norm(direction)), 1e-30)
            u[part] = domain.start[part] + (direction * (length / norm)).float()
    return domain.project(u)


@dataclass(frozen=True)
class Grid(NonAdaptivePolicy):
    """Every combination of evenly spaced values, then nothing more.

    A number takes both its ends and what lies evenly between; an angle does not repeat
    its end; a discrete choice takes every option. Without `points`, numbers get one
    more value by turns as long as the whole grid fits into the renders. Points come
    coarse to fine: ends first, then middles, then quarters, so that a grid that is cut
    short has looked everywhere.

    An l-infinity ball is a box to a grid. Points outside an l2 ball are projected onto
    it, so they are not evenly spaced there. Either is of use in a few numbers only: a
    grid that does not fit into the renders is refused.

    Attributes:
        points: values for each number, at least 2; 0 for as many as fit.
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
        counts = _count_values(domain, steps, self.points)
        points = torch.cartesian_prod(*_make_axes(domain, counts))
        points = points.reshape(-1, domain.dim)
        order = _order_coarse_to_fine(_list_blocks(domain), counts)
        return PointsState(domain, points=points[order])

    def propose(
        self, state: PointsState, n: int
    ) -> tuple[tuple[Proposal, ...], PointsState]:
        return state.propose(
            map(
                state.domain.project,
                state.points[state.n_proposed : state.n_proposed + n],
            )
        )


def _list_blocks(domain: Domain) -> list[Block]:
    """Return the block of each element of u."""
    return [block for block in domain.blocks for _ in range(block.size)]


def _make_axes(domain: Domain, counts: Sequence[int]) -> list[Tensor]:
    """Return the values of each element of u, (count,) in rising order."""
    lower = domain.lower.clone()
    upper = domain.upper.clone()
    for block, part in domain.list_block_slices():
        # the cube around the ball
        if block.norm == "l2" and block.epsilon is not None:
            lower[part] = lower[part].maximum(domain.start[part] - block.epsilon)
            upper[part] = upper[part].minimum(domain.start[part] + block.epsilon)
    axes = []
    for block, count, low, high in zip(
        _list_blocks(domain), counts, lower.tolist(), upper.tolist(), strict=True
    ):
        if block.options:
            axes.append((torch.arange(count) + 0.5) / count)
        elif block.periodic:  # the upper bound is the lower one, and comes once
            axes.append(low + (high - low) * torch.arange(count) / count)
        else:
            axes.append(torch.linspace(low, high, count))
    return axes


def _order_coarse_to_fine(blocks: Sequence[Block], counts: Sequence[int]) -> Tensor:
    """Return the indices of all points of a grid, (n,), the coarse ones first.

    They are sorted by the largest level of a point, then by the sum of its levels. The
    last axis of the grid runs fastest.
    """
    max_level = torch.zeros(1, dtype=torch.long)
    level_sum = max_level
    for level in map(_compute_levels, blocks, counts):
        max_level = torch.maximum(max_level[:, None], level).flatten()
        level_sum = (level_sum[:, None] + level).flatten()
    sort_key = max_level * (int(level_sum.max()) + 1) + level_sum
    return sort_key.argsort(stable=True)


def _count_values(domain: Domain, steps: int, points: int) -> list[int]:
    """Return how many values each element of u takes.

    Args:
        domain: to search.
        steps: renders that the grid may take.
        points: values of each number; 0 for as many as fit.

    Raises:
        InputError: the grid does not fit into the renders.
    """
    options = domain.options.tolist()
    numbers = options.count(0)
    combinations = math.prod(n for n in options if n)
    least = combinations * (points or 2) ** min(numbers, 64)
    if least > steps:
        more = (
            f" and {combinations} combinations of options" if combinations > 1 else ""
        )
        many = str(least) if least < 10**9 else "billions of"
        raise InputError(
            f"policy 'grid': {points or 2} values for each of {numbers} numbers{more} "
            f"are {many} renders, and "
            f"there are {steps}; use policy sobol, cmaes, nes, pgd or auto, or give "
            "more `steps`"
        )
    each = points or max(
        2, int((steps // combinations) ** (1.0 / max(numbers, 1)) * (1 - 1e-9))
    )
    counts = [n or each for n in options]
    total = math.prod(counts)
    grew = not points
    while grew:
        grew = False
        for j, fixed in enumerate(options):
            if not fixed and total // counts[j] * (counts[j] + 1) <= steps:
                total = total // counts[j] * (counts[j] + 1)
                grew = True
                counts[j] += 1
    return counts


def _compute_levels(block: Block, count: int) -> Tensor:
    """Return (count,) how often an axis must be halved until a value is met: 0 for both
    ends and for every option.
    """
    level = torch.zeros(count, dtype=torch.long)
    gaps = [] if block.options else [(0, count if block.periodic else count - 1, 1)]
    while gaps:
        low, high, depth = gaps.pop()
        middle = (low + high) // 2
        if low < middle < high:
            level[middle] = depth
            gaps += [(low, middle, depth + 1), (middle, high, depth + 1)]
    return level
