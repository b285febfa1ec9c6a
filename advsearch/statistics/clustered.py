"""Intervals and tests of shares over units of several rows each, such as drives of
several frames.

Rows of one unit are not independent; units are. All units weigh the same, however many
rows each has. The share is the mean over units of the share of each: mean_u k_u / o_u,
for units with o_u rows of which k_u count. (The pooled share, sum k_u / sum o_u, weighs
a drive by its frames in view. It has no interval without a bound on o_u, and the
largest o_u that was observed is none.) So each unit is one draw in [0, 1].

With m for the true mean, a gambler who stakes a fraction c of the capital at each unit
on "more than m" wins nothing on
average:

    K(m, c) = prod_u (1 - c + c k_u / (o_u m))

So K exceeds 2 / a with a probability of a / 2 at most (Markov), whatever units are like
and however few there are. It holds too where each unit has a share of its own: the
product's mean is at most 1, by the inequality of the means. The stakes are those of
`sequential.ConfidenceSequence`. Where each unit has one row, the exact tests of
independent rows are used, which are sharper: Clopper and Pearson, Newcombe, McNemar.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.errors import InputError
from advsearch.statistics.intervals import CONFIDENCE, clopper_pearson
from advsearch.statistics.paired import mcnemar, paired_difference
from advsearch.statistics.sequential import STAKES, edge_of, log_capital

Numbers = npt.NDArray[np.float64]
Units = npt.NDArray[np.int64]


def per_unit(values: npt.ArrayLike, units: Units) -> Numbers:
    """Return the sums (m,) of values (n,) over each of the units that the rows (n,)
    belong to, in their order.
    """
    _, places = np.unique(units, return_inverse=True)
    return np.bincount(places.reshape(-1), np.asarray(values, dtype=np.float64)).astype(
        np.float64
    )


def mean_share(counted: npt.ArrayLike, of: npt.ArrayLike) -> float:
    """Return the mean over units of the share of each: `counted` (n,) of the
    predictions `of` (n,) of a unit; units without predictions are left out. NaN without
    any.
    """
    k = np.asarray(counted, dtype=np.float64)
    o = np.asarray(of, dtype=np.float64)
    k = k[o > 0.0]
    o = o[o > 0.0]
    if not len(o):
        return math.nan
    if o.min() == o.max():
        return float(k.sum() / o.sum())
    return float((k / o).mean())


def share_interval(
    counted: npt.ArrayLike, of: npt.ArrayLike, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Return the interval of the mean over units of the share of each (`mean_share`),
    whatever the number of units. Each has predictions, (n,) from 0, and one of them
    some; `counted` are (n,) from 0 to `of`; the confidence is between 0 and 1.
    """
    k = np.asarray(counted, dtype=np.float64)
    o = np.asarray(of, dtype=np.float64)
    if (
        k.shape != o.shape
        or not o.size
        or o.max() <= 0
        or (k < 0).any()
        or (k > o).any()
    ):
        raise InputError(
            "share: expected counts from 0 to the predictions of each "
            "unit, and one prediction at least"
        )
    if o.max() == 1.0:
        return clopper_pearson(round(k.sum()), round(o.sum()), confidence)
    return _by_bets(k[o > 0.0] / o[o > 0.0], confidence)


def _by_bets(shares: Numbers, confidence: float) -> tuple[float, float]:
    """Return the interval of the mean of independent draws (n,) in [0, 1]."""
    values, times = np.unique(shares, return_counts=True)
    least = np.log(2.0 / (1.0 - confidence))
    low = edge_of(lambda mean: log_capital(mean, values, times) < least)
    return low, edge_of(
        lambda mean: log_capital(1.0 - mean, 1.0 - values, times) >= least
    )


def mean_interval(
    values: npt.ArrayLike, low: float, high: float
) -> tuple[float, float]:
    """Return the 95 % interval of the mean of independent numbers (n,) in a range that
    is known beforehand: from the plan, never from the numbers.
    """
    numbers = np.asarray(values, dtype=np.float64)
    if high <= low:
        return low, low
    first, last = _by_bets(
        np.clip((numbers - low) / (high - low), 0.0, 1.0), CONFIDENCE
    )
    return low + (high - low) * first, low + (high - low) * last


def most_shown(units: int) -> float:
    """Return the lower end of a share's 95 % interval where so many units are right
    throughout: the most to show.
    """
    return _by_bets(np.ones(units), CONFIDENCE)[0]


def paired_by_unit(
    first: Any, second: Any, units: Units
) -> tuple[float, tuple[float, float], float]:
    """Return how much more often the second of two outcomes (n,) happens than the first, the 95 % interval of that, and
    how likely it is that chance parts them as far where neither happens more often, in (0, 1]; rows (n,) of one unit
    are not independent, and all units weigh the same (`mean_share`). The interval is without 0 where that is at most
    0.05."""
    first = np.asarray(first, dtype=bool)
    second = np.asarray(second, dtype=bool)
    if len(np.unique(units)) == len(units):
        both = (first & second).sum()
        lost = (first & ~second).sum()
        won = (~first & second).sum()
        counts = int(both), int(lost), int(won), len(first) - int(both + lost + won)
        return *paired_difference(*counts), mcnemar(counts[1], counts[2])
    of = per_unit(np.ones(len(first)), units)
    ahead = per_unit((1.0 + second - 1.0 * first) / 2.0, units)
    low, high = _by_bets(ahead / of, CONFIDENCE)
    once = np.ones(len(of))
    most_won = max(
        log_capital(0.5, ahead / of, once), log_capital(0.5, 1.0 - ahead / of, once)
    )
    difference = mean_share(per_unit(second, units), of) - mean_share(
        per_unit(first, units), of
    )
    return (
        difference,
        (2 * low - 1, 2 * high - 1),
        float(min(1.0, 2.0 * np.exp(-most_won))),
    )


# of right predictions on both sides, at which two shares are compared
SHARES = np.linspace(0.0, 1.0, 402)[1:-1]
# how often units are dealt out anew, so that no probability is under 0.0001
EXCHANGES = 9_999


def fewer_by_chance(
    inside: npt.ArrayLike,
    of: npt.ArrayLike,
    beside: npt.ArrayLike,
    rest: npt.ArrayLike,
    times: float = 1.0,
) -> float:
    """Return how likely it is, in (0, 1], that so few predictions or fewer are right on
    one side of a rule, if as many are right on the other.

    Where each unit has one prediction that is Fisher's exact test, one-sided. Where all
    units have as many and lie on one side each, units are dealt out to the sides anew.
    Elsewhere, where the rule cuts through units or some have more predictions than
    others, it is one over the least that bets on "fewer here than m, more there" have
    made of 1, of all m: a bound, also where sides of a unit are alike. All units of a
    side weigh the same (`mean_share`).

    Args:
        inside, of: (n,) of each unit, right predictions and predictions under the rule.
        beside, rest: (n,) those elsewhere.
        times: how many times there are each of these units.
    """
    k, a, r, b = (
        np.asarray(counts, dtype=np.float64) for counts in (inside, of, beside, rest)
    )
    if not a.any() or not b.any():
        return 1.0
    if (a + b).max() == 1.0:
        # takes half a second, and a search needs none of it
        from scipy.stats import hypergeom

        here, there, right, others = (
            round(times * float(counts.sum())) for counts in (k, a, r, b)
        )

        return float(hypergeom.cdf(here, there + others, here + right, there))
    is_cut = bool(((a > 0.0) & (b > 0.0)).any())
    if not is_cut and len(np.unique(a + b)) == 1:
        values, copies = np.unique(k + r, return_counts=True)
        copies = np.round(times * copies).astype(np.int64)
        dealt = round(times * float((a > 0).sum()))
        rng = np.random.default_rng(0)
        drawn = rng.multivariate_hypergeometric(
            copies, min(dealt, int(copies.sum())), EXCHANGES, method="marginals"
        )
        return float(
            (1 + (drawn @ values <= times * k.sum() + 1e-9).sum()) / (1 + EXCHANGES)
        )
    # What a unit wins or loses on each side; half is staked on each where a unit can
    # have both.
    wrong_here = np.divide(a - k, a, out=np.zeros_like(a), where=a > 0.0)
    right_there = np.divide(r, b, out=np.zeros_like(b), where=b > 0.0)
    rows, copies = np.unique(
        np.stack([wrong_here, a > 0.0, right_there, b > 0.0], axis=1),
        axis=0,
        return_counts=True,
    )
    wrong, is_here, right, is_there = (column[:, None] for column in rows.T)
    bets = (0.5 if is_cut else 1.0) * (
        wrong / (1.0 - SHARES) - is_here + right / SHARES - is_there
    )
    with np.errstate(divide="ignore"):
        won = [
            times
            * (copies[:, None] * np.log(np.maximum(1.0 + stake * bets, 0.0))).sum(
                axis=0
            )
            for stake in STAKES
        ]
    least = (np.logaddexp.reduce(won, axis=0) - np.log(len(STAKES))).min()
    return float(min(1.0, np.exp(-least)))
