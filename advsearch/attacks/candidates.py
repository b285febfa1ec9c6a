"""The few best configurations of a search, and which of them is best once luck is taken out.

The largest of many noisy values is mostly a lucky one (the winner's curse): with noise of one logit, the best of 40
equal configurations looks two logits better than it is. So a search keeps several candidates, renders each again with
seeds it has not used, the same seeds for all, and believes only those renders.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

SAME = 1e-4
"""Configurations that differ by less than this in every element are one candidate (an 8-bit level is 4e-3)."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A configuration worth a second look.

    Attributes:
        u: (d,) the configuration.
        objective: its raw objective when it was admitted, biased upwards.
        success: whether that render was a success.
        again: objectives of its renders since then, in the search and in the ranking; -inf for one that was not finite.
        successes: how many of these were a success.
    """

    u: Tensor
    objective: float
    success: bool
    again: tuple[float, ...] = ()
    successes: int = 0

    @property
    def believed(self) -> float:
        """Mean objective of the new renders; the raw one if there are none."""
        return math.fsum(self.again) / len(self.again) if self.again else self.objective

    @property
    def rate(self) -> float:
        """Fraction of new renders that are a success; of the raw one if there are none."""
        return self.successes / len(self.again) if self.again else float(self.success)


def admit(pool: tuple[Candidate, ...], new: Candidate, size: int) -> tuple[Candidate, ...]:
    """Return the pool with `new` in it if it belongs to the best `size` distinct ones, best first.

    A success beats what is none, then the objective counts; of two that are nearly the same configuration the better
    stays. One that is in the pool exactly as it is gets another look by it, as unbiased as those of the ranking.
    """
    for old in pool:
        if torch.equal(old.u, new.u):
            looked = replace(old, again=(*old.again, new.objective), successes=old.successes + new.success)
            return tuple(looked if c is old else c for c in pool)
    if len(pool) >= size and _raw(new) <= _raw(pool[-1]):
        return pool
    for old in pool:
        if float((old.u - new.u).abs().amax()) < SAME:
            if _raw(new) <= _raw(old):
                return pool
            pool = tuple(c for c in pool if c is not old)
            break
    return tuple(sorted((*pool, new), key=_raw, reverse=True)[:size])


def with_last(pool: tuple[Candidate, ...], last: Candidate | None, size: int) -> tuple[Candidate, ...]:
    """Return the pool, of at most `size`, with the last configuration of a search in it, if need be for its worst."""
    if last is None or any(torch.equal(one.u, last.u) for one in pool):
        return pool
    return (*pool[: size - 1], last)


def contenders(pool: tuple[Candidate, ...], shared: int) -> tuple[Candidate, ...]:
    """Return the winner so far and those that are not clearly worse, in their order.

    One is clearly worse if the mean of its differences from the winner, seed by seed, is larger than the standard error
    of that mean, and its success rate is no higher. (The race of Maron and Moore 1994, with normal intervals of one
    deviation in place of Hoeffding's: a search needs the better of two, not a proof.)

    Args:
        pool: candidates that had the same seeds in their last renders.
        shared: how many of these there were, at least 2 for anyone to be clearly worse.
    """
    if shared < 2 or len(pool) < 2:
        return pool
    leader = best(pool)
    return tuple(one for one in pool if one is leader or not _worse(one, leader, shared))


def _worse(one: Candidate, leader: Candidate, shared: int) -> bool:
    behind = [a - b for a, b in zip(leader.again[-shared:], one.again[-shared:], strict=True)]
    if not all(map(math.isfinite, behind)):
        return not math.isfinite(one.believed)
    mean = math.fsum(behind) / shared
    variance = math.fsum((each - mean) ** 2 for each in behind) / (shared - 1)
    return one.rate <= leader.rate and mean > math.sqrt(variance / shared)


def best(pool: tuple[Candidate, ...]) -> Candidate:
    """Return the winner: by success rate, then by objective, of the new renders where every candidate has had its
    own."""
    if all(c.again for c in pool):
        return max(pool, key=lambda c: (c.rate, c.believed))
    return pool[0]


def _raw(candidate: Candidate) -> tuple[bool, float]:
    return candidate.success, candidate.objective
