"""How large a share of all configurations fails, from draws that prefer failures: importance sampling, with an interval
that holds at any number of draws."""

from __future__ import annotations

import math
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
