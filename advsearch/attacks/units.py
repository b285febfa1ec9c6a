"""Shares of predictions that are not independent: frames of a drive, and what several models say of a picture, share
one draw. What was drawn, the *unit*, is independent of others, so that intervals and tests are over units.

Of units with o_u predictions each, of which k_u count, the share is sum k_u / sum o_u. With m for the true one and O
for the largest o_u, who stakes a share c of what he has, at each unit, on "more than m" wins nothing on average:

    K(m, c) = prod_u (1 - c o_u / O + c k_u / (O m))

So K exceeds 2 / a with a probability of a / 2 at most (Markov), whatever units are like and however few there are, also
where each has a share of its own (the product's mean is at most 1, by the inequality of the means). These are the bets
of `trials.ConfidenceSequence`, whose stakes they take. Where each unit has one prediction, the exact tests of
independent ones are taken, which are sharper: Clopper and Pearson, Newcombe, McNemar.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import hypergeom

from advsearch.attacks import trials
from advsearch.attacks.trials import CONFIDENCE, STAKES, capital_of_units, edge_of
from advsearch.errors import InputError

Numbers = npt.NDArray[np.float64]
Units = npt.NDArray[np.int64]


def per_unit(values: npt.ArrayLike, units: Units) -> Numbers:
    """Return the sums (m,) of values (n,) over each of the units that the rows (n,) belong to, in their order."""
    _, places = np.unique(units, return_inverse=True)
    return np.bincount(places.reshape(-1), np.asarray(values, dtype=np.float64)).astype(np.float64)


def share_interval(counted: npt.ArrayLike, of: npt.ArrayLike, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the interval of a share of predictions, whatever the number of independent units. Each has predictions,
    (n,) from 0, and one of them some; `counted` are (n,) from 0 to `of`; the confidence is between 0 and 1."""
    k, o = np.asarray(counted, dtype=np.float64), np.asarray(of, dtype=np.float64)
    if k.shape != o.shape or not o.size or o.max() <= 0 or (k < 0).any() or (k > o).any():
        raise InputError("share: expected counts from 0 to the predictions of each unit, and one prediction at least")
    if o.max() == 1.0:
        return trials.clopper_pearson(round(k.sum()), round(o.sum()), confidence)
    return _by_bets(k, o, confidence)


def _by_bets(counted: Numbers, of: Numbers, confidence: float) -> tuple[float, float]:
    rows, times = np.unique(np.stack([counted, of - counted, of], axis=1) / of.max(), axis=0, return_counts=True)
    least = np.log(2.0 / (1.0 - confidence))
    low = edge_of(lambda mean: capital_of_units(mean, rows[:, 0], rows[:, 2], times) < least)
    return low, edge_of(lambda mean: capital_of_units(1.0 - mean, rows[:, 1], rows[:, 2], times) >= least)


def mean_interval(values: npt.ArrayLike, low: float, high: float) -> tuple[float, float]:
    """Return the 95 % interval of the mean of independent numbers (n,) in a range that is known beforehand."""
    numbers = np.asarray(values, dtype=np.float64)
    if high <= low:
        return low, low
    shares = np.clip((numbers - low) / (high - low), 0.0, 1.0)
    first, last = _by_bets(shares, np.ones(len(shares)), CONFIDENCE)
    return low + (high - low) * first, low + (high - low) * last


def most_shown(units: int) -> float:
    """Return the lower end of a share's 95 % interval where so many units are right throughout: the most to show."""
    return _by_bets(np.ones(units), np.ones(units), CONFIDENCE)[0]


def paired_by_unit(first: Any, second: Any, units: Units) -> tuple[float, tuple[float, float], float]:
    """Return how much more often the second of two outcomes (n,) happens than the first, the 95 % interval of that, and
    how likely it is that chance parts them as far where neither happens more often, in (0, 1]; rows (n,) of one unit
    are not independent. The interval is without 0 where that is at most 0.05."""
    first, second = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if len(np.unique(units)) == len(units):
        both, lost, won = (first & second).sum(), (first & ~second).sum(), (~first & second).sum()
        counts = int(both), int(lost), int(won), len(first) - int(both + lost + won)
        return *trials.paired_difference(*counts), trials.mcnemar(counts[1], counts[2])
    of = per_unit(np.ones(len(first)), units)
    ahead = per_unit((1.0 + second - 1.0 * first) / 2.0, units)
    low, high = _by_bets(ahead, of, CONFIDENCE)
    scaled = np.stack([ahead, of - ahead, of]) / of.max()
    won = max(capital_of_units(0.5, scaled[side], scaled[2], np.ones(len(of))) for side in (0, 1))
    return float(second.mean() - first.mean()), (2 * low - 1, 2 * high - 1), float(min(1.0, 2.0 * np.exp(-won)))


SHARES = np.linspace(0.0, 1.0, 402)[1:-1]  # of right predictions on both sides, at which two shares are compared
EXCHANGES = 9_999  # how often units are dealt out anew, so that no probability is under 0.0001


def fewer_by_chance(
    inside: npt.ArrayLike, of: npt.ArrayLike, beside: npt.ArrayLike, rest: npt.ArrayLike, times: float = 1.0
) -> float:
    """Return how likely it is, in (0, 1], that so few predictions or fewer are right on one side of a rule, if as many
    are right on the other.

    Where each unit has one prediction that is Fisher's exact test, one-sided. Where all units have as many and lie on
    one side each, units are dealt out to the sides anew. Where the rule cuts through units, it is one over the least
    that bets on "fewer here than m, more there" have made of 1, of all m: a bound, also where sides of a unit are
    alike.

    Args:
        inside, of: (n,) of each unit, right predictions and predictions under the rule.
        beside, rest: (n,) those elsewhere.
        times: how many times there are each of these units.
    """
    k, a, r, b = (np.asarray(counts, dtype=np.float64) for counts in (inside, of, beside, rest))
    if not a.any() or not b.any():
        return 1.0
    if (a + b).max() == 1.0:
        here, there, right, others = (round(times * float(counts.sum())) for counts in (k, a, r, b))
        return float(hypergeom.cdf(here, there + others, here + right, there))
    if (np.minimum(a, b) == 0.0).all() and len(np.unique(a + b)) == 1:
        values, copies = np.unique(k + r, return_counts=True)
        copies, dealt = np.round(times * copies).astype(np.int64), round(times * float((a > 0).sum()))
        rng = np.random.default_rng(0)
        drawn = rng.multivariate_hypergeometric(copies, min(dealt, int(copies.sum())), EXCHANGES, method="marginals")
        return float((1 + (drawn @ values <= times * k.sum() + 1e-9).sum()) / (1 + EXCHANGES))
    rows, copies = np.unique(np.stack([a - k, a, r, b], axis=1), axis=0, return_counts=True)
    wrong, under, right, others = rows.T
    half = np.where((under > 0) & (others > 0), 0.5, 1.0)[:, None]
    bets = half * (wrong[:, None] / (1.0 - SHARES) - under[:, None]) / a.max()
    bets += half * (right[:, None] / SHARES - others[:, None]) / b.max()
    with np.errstate(divide="ignore"):
        won = [times * (copies[:, None] * np.log(np.maximum(1.0 + stake * bets, 0.0))).sum(axis=0) for stake in STAKES]
    least = (np.logaddexp.reduce(won, axis=0) - np.log(len(STAKES))).min()
    return float(min(1.0, np.exp(-least)))
