"""Quasi-random points, which fill the domain more evenly than random ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.extend import InputError, policies

# largest number of dimensions of scipy's Sobol sequences (Joe and Kuo 2008)
MAX_SOBOL_DIM = 21_201
# About the largest number of values of Sobol points that are computed at once. The
# number of points is rounded up to a power of two, so there may be twice as many.
MAX_CHUNK_NUMBERS = 2**20


@dataclass(frozen=True)
class Sobol(policies.NonAdaptivePolicy):
    """A scrambled Sobol sequence over the whole domain (Sobol 1967; scrambled as by
    Owen 1998, Matousek 1998).

    A point of the sequence, in [0, 1]^k, becomes a configuration:

    - bounds and l-infinity balls: a number is scaled to the intersection of bounds and
      ball;
    - a discrete choice: a number becomes the center of its option;
    - an l2 ball: normal quantiles of the block's numbers give a direction, and one more
      number gives the distance from the center, so that points are uniform in the ball;
      then they are projected onto the bounds.

    In a few dimensions it needs fewer renders than `random`. The advantage is gone
    after a dozen. The points do not depend on evaluations, so they are also a fair
    sample for the average over the domain.
    """

    name: ClassVar[str] = "sobol"

    def start(
        self, domain: policies.Domain, generator: torch.Generator, steps: int
    ) -> policies.PointsState:
        """Start the sequence, with its first chunk of points."""
        size = _count_sobol_dimensions(domain)
        seed = policies.draw_seed(generator)
        max_points = max(1, MAX_CHUNK_NUMBERS // size)
        n_points = min(steps, max_points)
        # Rounded up to a power of two, because Sobol points are balanced in such
        # numbers. So `MAX_CHUNK_NUMBERS` may be exceeded, but not by a factor of 2.
        chunk_size = 2 ** max(0, (n_points - 1).bit_length())
        points = sample_sobol_points(size, seed, begin=0, count=chunk_size)
        return policies.PointsState(domain, seed, points)

    def propose(
        self, state: policies.PointsState, n: int
    ) -> tuple[tuple[policies.Proposal, ...], policies.PointsState]:
        """Propose the next points of the sequence, at most n.

        Points are computed in chunks; the next chunk follows once this one is used up.
        """
        chunk_size, size = state.points.shape
        index_in_chunk = state.n_proposed % chunk_size
        if state.n_proposed and index_in_chunk == 0:
            points = sample_sobol_points(size, state.seed, state.n_proposed, chunk_size)
            state = replace(state, points=points)
        next_points = state.points[index_in_chunk:][:n]
        return state.propose(policies.to_domain(state.domain, x) for x in next_points)


def _count_sobol_dimensions(domain: policies.Domain) -> int:
    """Return the number of dimensions of the sequence for a domain.

    It is one for each element, and one for the distance from the center of each l2
    ball. The ball's elements only decide the direction (`policies.to_domain`).

    Raises:
        InputError: there are more than `MAX_SOBOL_DIM`.
    """
    n_l2_balls = sum(block.norm == "l2" for block in domain.blocks)
    size = domain.dim + n_l2_balls
    if size > MAX_SOBOL_DIM:
        raise InputError(
            f"policy 'sobol': expected at most {MAX_SOBOL_DIM} dimensions, got "
            f"{size}; use policy random, nes, pgd or auto"
        )
    return size


def sample_sobol_points(size: int, seed: int, begin: int, count: int) -> Tensor:
    """Return points (count, size) float32 of a scrambled Sobol sequence.

    Args:
        size: number of dimensions.
        seed: seed of the scrambling.
        begin: number of the first point.
        count: number of points; a power of two, which keeps them balanced.
    """
    from scipy.stats import qmc  # takes most of a second, and few runs need it

    engine = qmc.Sobol(size, scramble=True, seed=seed)
    if begin:
        engine.fast_forward(begin)
    return torch.from_numpy(engine.random(count)).float()
