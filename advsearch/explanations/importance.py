"""Which factors decide, and which of them together: shares of the variance of the answers, with intervals that hold.

A factor's values are cut into parts that have equally many rows (a name is a part). The share is the variance of the
model's accuracy between the parts over the variance of the yes/no answers: the first-order Sobol index of the answer,
by parts (given-data estimators: Plischke, Borgonovo and Smith 2013). What differs inside a part is not in it, so that
the index without parts is at least as large. Of two factors it is that of the parts of both at once.

Of n answers and k parts, n times the share that is counted is Pearson's chi-squared statistic of a table of k x 2, and
the true share is its noncentrality over n (Cohen's w squared). The interval is that of the noncentrality (Smithson
2003, "Confidence Intervals"). `benchmarks/explain.py` prints in how many of repeated samples it covers the truth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from advsearch.attacks.trials import CONFIDENCE
from advsearch.explanations.observations import Observations

MOST_PARTS = 20
ROWS_IN_A_CELL = 25
"""Rows that a cell of two factors' parts has on average, at least."""
CHANCE = 0.01
"""Probability that any pair is told to decide together where none does; each is tested at its part (Bonferroni)."""

Places = npt.NDArray[np.int64]


@dataclass(frozen=True)
class FactorWeight:
    """What one factor, or two together, decide.

    Attributes:
        places: numbers of the factors.
        share: of the variance of the answers, in [0, 1]; what chance adds to it is taken off.
        interval: of the share, 95 %.
        parts: how many it was cut into, of two all pairs of parts.
    """

    places: tuple[int, ...]
    share: float
    interval: tuple[float, float]
    parts: int


def find_importance(found: Observations) -> tuple[FactorWeight, ...]:
    """Return each factor by falling share, then the pairs that decide together more than each of the two by itself.

    Nothing where the answers are all the same.
    """
    if len(set(found.right.tolist())) < 2:
        return ()
    count, wide = len(found), range(len(found.factors))
    alone = [_weight((k,), _parts(found, k, round(count ** (1.0 / 3.0))), found.right) for k in wide]
    pairs, tested = [], list(combinations(wide, 2))
    few = max(2, math.isqrt(count // ROWS_IN_A_CELL))
    coarse = [_parts(found, k, few) for k in wide]
    for i, j in tested:
        both = coarse[i] * (int(coarse[j].max()) + 1) + coarse[j]
        (first, k), (second, m), (joint, cells) = (_counted(one, found.right) for one in (coarse[i], coarse[j], both))
        more, freedom = count * (joint - first - second), max(1, cells - k - m + 1)
        if chi2.sf(more, freedom) < CHANCE / len(tested):
            pairs.append(_weight((i, j), both, found.right))
    return (*sorted(alone, key=lambda one: -one.share), *sorted(pairs, key=lambda one: -one.share))


def _parts(found: Observations, place: int, most: int) -> Places:
    """The part of each row (n,): a name, or one of at most so many parts of equally many rows."""
    column = found.values[:, place]
    if found.factors[place].options:
        return column.astype(np.int64)
    ends = np.unique(np.quantile(column, np.linspace(0.0, 1.0, min(max(2, most), MOST_PARTS) + 1)[1:-1]))
    return np.searchsorted(ends, column, side="left").astype(np.int64)


def _counted(parts: Places, right: npt.NDArray[np.bool_]) -> tuple[float, int]:
    """The share of the variance between parts as it is counted, and the number of parts that have rows."""
    seen = np.bincount(parts)
    rate = np.bincount(parts, right)[seen > 0] / seen[seen > 0]
    mean = float(right.mean())
    return float((seen[seen > 0] * (rate - mean) ** 2).sum()) / len(right) / (mean * (1.0 - mean)), len(rate)


def _weight(places: tuple[int, ...], parts: Places, right: npt.NDArray[np.bool_]) -> FactorWeight:
    (counted, k), n = _counted(parts, right), len(right)
    if k < 2:
        return FactorWeight(places, 0.0, (0.0, 1.0), k)
    tail = (1.0 - CONFIDENCE) / 2.0
    low = _noncentrality(n * counted, k - 1, 1.0 - tail) / n
    high = _noncentrality(max(n * counted, k - 1.0), k - 1, tail) / n  # fewer would be less than chance gives
    share = 1.0 - (1.0 - counted) * (n - 1) / max(n - k, 1)
    return FactorWeight(places, max(share, 0.0), (min(low, 1.0), min(high, 1.0)), k)


def _noncentrality(statistic: float, freedom: int, probability: float) -> float:
    """The noncentrality at which a chi-squared variable is at most the statistic with a probability; 0 if none is."""

    def over(at: float) -> float:
        return float(ncx2.cdf(statistic, freedom, at) if at > 0.0 else chi2.cdf(statistic, freedom)) - probability

    if over(0.0) <= 0.0:
        return 0.0
    end = statistic + 20.0
    while over(end) > 0.0:
        end *= 2.0
    return float(brentq(over, 0.0, end, xtol=1e-6))
