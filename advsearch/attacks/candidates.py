"""What a search may answer with: the few best configurations it has seen, and many different failures.

The largest of many noisy values is mostly a lucky one (the winner's curse): with noise of one logit, the best of 40
equal configurations looks two logits better than it is. So a search keeps several candidates, renders each again with
seeds it has not used, the same seeds for all, and believes only those renders.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from advsearch.attacks.trials import CONFIDENCE, edge_of

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


LEAST_EFFECTIVE = 10.0
"""With fewer failures than so many, each of equal weight, no estimate is stated."""

BETS = 8
"""Sizes of a bet, each half of the one before; the capital is shared equally among them."""


@dataclass(frozen=True)
class FailureShare:
    """The share of configurations, drawn evenly from the budget, in which one render of the search is a success.

    Attributes:
        estimate: mean of the weighted draws; None where `effective` is under `LEAST_EFFECTIVE`, or a draw could not be
            evaluated.
        interval: 95 %; covers the share at least as often, however the draws were adapted, at any number of them.
        effective: failures of equal weight that would be worth as much: (sum w)^2 / sum w^2 (Kish 1965).
        draws: how many there were.
    """

    estimate: float | None
    interval: tuple[float, float]
    effective: float
    draws: int


def failure_share(weights: Tensor, bounds: Tensor, failed: Tensor, unknown: Tensor) -> FailureShare:
    """Return what draws from changing densities say of the share of failures under the even one.

    Draw t comes from a density q_t that may depend on all draws before it; x_t = w_t [failed], w_t = 1 / q_t relative
    to the even density, has the share p as its mean given these. Bets on the difference are fair games if the share is
    p: the capital of

        prod_t (1 - c + c x_t / p)   and   prod_t (1 + c (p - x_t) / (b_t - p)),  b_t the largest weight that q_t gives,

    a mean over bets c, exceeds 2 / 0.05 with a probability of 0.025 at most (Ville 1939), so the p at which neither
    does are a 95 % interval (Waudby-Smith and Ramdas 2024, "Estimating means of bounded random variables by betting").
    Both are monotone in p.

    Args:
        weights: (n,) w_t, over 0, n at least 1.
        bounds: (n,) b_t, at least 1 and w_t, known before draw t.
        failed: (n,) bool.
        unknown: (n,) bool: could not be evaluated; the interval holds whatever these are.
    """
    weights, bounds = weights.double(), bounds.double()
    low, high = weights * (failed & ~unknown), weights * (failed | unknown)
    sizes = 0.5 ** torch.arange(BETS, dtype=torch.float64)[:, None]
    limit = math.log(2.0 / (1.0 - CONFIDENCE)) + math.log(BETS)

    def against_low(p: float) -> bool:
        return float(torch.log(1.0 - sizes + sizes * low / p).sum(dim=1).logsumexp(dim=0)) >= limit

    def against_high(p: float) -> bool:
        return float(torch.log1p(sizes * (p - high) / (bounds - p)).sum(dim=1).logsumexp(dim=0)) >= limit

    total = float(low.sum())
    effective = total**2 / float(low.square().sum()) if total else 0.0
    stated = effective >= LEAST_EFFECTIVE and not bool(unknown.any())
    ends = edge_of(lambda p: not against_low(p)), edge_of(against_high)
    return FailureShare(min(1.0, total / len(low)) if stated else None, ends, effective, len(low))


MOST = 24
"""Failures that an answer lists, at most."""


@dataclass(frozen=True, eq=False)
class FoundFailure:
    """A configuration that a search claims to be a success, and stands for others near it.

    Attributes:
        u: (d,) float32.
        objective: that of its one render; biased upwards where it is the largest of many.
        ranges: by position in u the low and the high end of where the others lie, in u.
    """

    u: Tensor
    objective: float
    ranges: dict[int, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Failures:
    """What a search knows of different failures.

    Attributes:
        listed: at most `MOST`.
        over: positions in u of what tells cells apart; none where there are no cells.
        found: how many failing cells there are; without cells, failing draws.
        seen: how many cells, or draws, were looked at, failing or not.
        places: how many cells there are; None without cells.
        share: how large a part of all configurations fails, where that can be told.
    """

    listed: tuple[FoundFailure, ...]
    over: tuple[int, ...]
    found: int
    seen: int
    places: int | None
    share: FailureShare | None = None


def most_different(at: Tensor, worst: Sequence[float], around: Tensor, apart: Tensor, most: int = MOST) -> list[int]:
    """Return which to list: the worst first, then each time the one that is farthest from all before it.

    That is the greedy choice of k centres, whose largest distance is at most twice the least possible (Gonzalez 1985,
    "Clustering to minimize the maximum intercluster distance"). Of equals the worse one goes first.

    Args:
        at: (n, k) where they are, in shares of each range.
        worst: (n,) objectives.
        around: (k,) bool: ranges whose ends are the same place.
        apart: (k,) bool: discrete choices, where different is 1 apart.
        most: how many to return at most.
    """
    order = sorted(range(len(at)), key=lambda number: -worst[number])
    at = at[order].double()
    nearest, picked = torch.full((len(at),), torch.inf, dtype=torch.float64), list[int]()
    for _ in range(min(most, len(at))):
        chosen = int(nearest.argmax())
        picked.append(chosen)
        away = (at - at[chosen]).abs()
        away = torch.where(around, torch.minimum(away, 1.0 - away), away)
        away = torch.where(apart, (away > 0.0).double(), away)
        nearest = torch.minimum(nearest, away.norm(dim=1))
        nearest[picked] = -1.0
    return [order[number] for number in picked]
