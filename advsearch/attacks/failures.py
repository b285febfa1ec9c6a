"""Many different failures: what a search may answer with beside the one worst configuration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.attacks.trials import CONFIDENCE, edge_of

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
