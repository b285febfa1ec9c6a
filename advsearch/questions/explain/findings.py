"""What rows say beside rules: which factors decide, a box to rely on, and failures that look alike.

Factors. A factor's values are cut into parts that have equally many rows (a name is a part). The share is the variance
of the model's accuracy between the parts over the variance of the yes/no answers: the first-order Sobol index of the
answer, by parts (given-data estimators: Plischke, Borgonovo and Smith 2013). What differs inside a part is not in it,
so that the index without parts is at least as large. Of two factors it is that of the parts of both at once.

Of n answers and k parts, n times the share that is counted is Pearson's chi-squared statistic of a table of k x 2, and
the true share is its noncentrality over n (Cohen's w squared). The interval is that of the noncentrality (Smithson
2003, "Confidence Intervals"). Where answers are those of units (frames of drives), chance adds more to the statistic
than with independent ones: it is divided by how much more, which the deviations of units say, and is one of F, as that
is known from few units (Rao and Scott 1981, their first-order correction; Thomas and Rao 1987). `benchmarks/explain.py`
and `benchmarks/drives.py` print in how many of repeated samples it covers the truth.

The box is peeled (PRIM: Friedman and Fisher 1999, section 6): a thin slice of one factor, or one of its names, is taken
off again and again where that raises the accuracy of what is left the most. One half of the rows chooses the box, and
the other half, which has seen no choice, is asked once whether it keeps what is promised.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2, ncf, ncx2
from scipy.stats import f as fisher

from advsearch.attacks.trials import CONFIDENCE
from advsearch.explanations import Observations, RuleCondition, RuleConditions, covered, import_library

MOST_PARTS = 20
ROWS_IN_A_CELL = 25
"""Rows that a cell of two factors' parts has on average, at least."""
CHANCE = 0.01
"""Probability that any pair is told to decide together where none does; each is tested at its part (Bonferroni)."""

LEAST_SPREAD = 0.1
"""What chance adds for units, at least, of what it adds to independent answers, though units deviate in nothing."""

Places = npt.NDArray[np.int64]


@dataclass(frozen=True)
class FactorWeight:
    """What one factor, or two together, decide, by their numbers: a share of the variance of the answers, in [0, 1],
    without what chance adds to it, with its 95 % interval, and into how many parts it was cut."""

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
    count, wide = found.count, range(len(found.factors))
    alone = [_weight((k,), _parts(found, k, round(count ** (1.0 / 3.0))), found) for k in wide]
    pairs, tested = [], list(combinations(wide, 2))
    few = max(2, math.isqrt(count // ROWS_IN_A_CELL))
    coarse = [_parts(found, k, few) for k in wide]
    for i, j in tested:
        both = coarse[i] * (int(coarse[j].max()) + 1) + coarse[j]
        (first, k), (second, m), (joint, cells) = (_between(one, found.right) for one in (coarse[i], coarse[j], both))
        more, freedom = len(found) * (joint - first - second), max(1, cells - k - m + 1)
        if _exceeds(more, freedom, [_by_chance(one, found) for one in (both, coarse[i], coarse[j])], found) < (
            CHANCE / len(tested)
        ):
            pairs.append(_weight((i, j), both, found))
    return (*sorted(alone, key=lambda one: -one.share), *sorted(pairs, key=lambda one: -one.share))


def _parts(found: Observations, place: int, most: int) -> Places:
    """The part of each row (n,): a name, or one of at most so many parts of equally many rows."""
    column = found.values[:, place]
    if found.factors[place].options:
        return column.astype(np.int64)
    ends = np.unique(np.quantile(column, np.linspace(0.0, 1.0, min(max(2, most), MOST_PARTS) + 1)[1:-1]))
    return np.searchsorted(ends, column, side="left").astype(np.int64)


def _between(parts: Places, right: npt.NDArray[np.bool_]) -> tuple[float, int]:
    """The share of the variance between parts as it is counted, and the number of parts that have rows."""
    seen = np.bincount(parts)
    rate = np.bincount(parts, right)[seen > 0] / seen[seen > 0]
    mean = float(right.mean())
    return float((seen[seen > 0] * (rate - mean) ** 2).sum()) / len(right) / (mean * (1.0 - mean)), len(rate)


def _weight(places: tuple[int, ...], parts: Places, found: Observations) -> FactorWeight:
    (counted, k), n = _between(parts, found.right), len(found)
    by_chance = _by_chance(parts, found)
    if k < 2 or math.isnan(by_chance):
        return FactorWeight(places, 0.0, (0.0, 1.0), k)
    tail, spread = (1.0 - CONFIDENCE) / 2.0, by_chance / (k - 1)
    if found.independent:
        spread, others = 1.0, math.inf
    else:
        others = float(found.count - k)
    statistic = n * counted / spread
    low = spread * _noncentrality(statistic, k - 1, others, 1.0 - tail) / n
    high = spread * _noncentrality(max(statistic, k - 1.0), k - 1, others, tail) / n  # fewer: less than chance gives
    share = 1.0 - (1.0 - counted) * (n - 1) / max(n - k, 1) if found.independent else counted - by_chance / n
    return FactorWeight(places, max(share, 0.0), (min(low, 1.0), min(high, 1.0)), k)


def _by_chance(parts: Places, found: Observations) -> float:
    """What chance adds to the statistic of some parts, from how much units deviate: k - 1 where answers are
    independent; NaN where too few units say it."""
    seen, right = np.bincount(parts), found.right
    if found.independent:
        return float((seen > 0).sum() - 1)
    rate = np.bincount(parts, right) / np.maximum(seen, 1)
    units = np.unique(found.units, return_inverse=True)[1].reshape(-1)
    both, places = np.unique(parts * (units.max() + 1) + units, return_inverse=True)
    away = np.bincount(places.reshape(-1), right - rate[parts])
    of, in_part = both // (units.max() + 1), np.bincount(both // (units.max() + 1), minlength=len(seen))
    if found.count < 2 or found.count <= (seen > 0).sum() or (in_part[seen > 0] < 2).any():
        return math.nan
    each = np.bincount(of, away**2, minlength=len(seen))[seen > 0]
    mine = in_part[seen > 0]
    alone = float((each * mine / (mine - 1) / seen[seen > 0]).sum())
    together = np.bincount(both % (units.max() + 1), away)
    whole = float((together**2).sum()) * found.count / (found.count - 1) / len(right)
    mean = float(right.mean())
    adds = (alone - whole) / (mean * (1.0 - mean))
    return max(adds, LEAST_SPREAD * float((seen > 0).sum() - 1))


def _exceeds(more: float, freedom: int, by_chance: list[float], found: Observations) -> float:
    """How likely it is that chance makes the statistic of two factors exceed those of each by so much."""
    if found.independent:
        return float(chi2.sf(more, freedom))
    adds = by_chance[0] - by_chance[1] - by_chance[2]
    others = found.count - freedom - 1
    if not adds > 0.0 or others < 1:
        return 1.0
    return float(fisher.sf(more / adds, freedom, others))


def _noncentrality(statistic: float, freedom: int, others: float, probability: float) -> float:
    """The noncentrality at which a chi-squared variable, or `freedom` times one of F, is at most the statistic with a
    probability; 0 if none is."""

    def over(at: float) -> float:
        if others < math.inf:
            share = statistic / freedom
            less = ncf.cdf(share, freedom, others, at) if at > 0.0 else fisher.cdf(share, freedom, others)
        else:
            less = ncx2.cdf(statistic, freedom, at) if at > 0.0 else chi2.cdf(statistic, freedom)
        return float(np.nan_to_num(less)) - probability  # where the distribution is too far away to be computed: 0

    if over(0.0) <= 0.0:
        return 0.0
    end = statistic + 20.0
    while over(end) > 0.0:
        end *= 2.0
    return float(brentq(over, 0.0, end, xtol=1e-6))


SLICE = 0.05
"""Share of the rows left that is peeled off a side at a time."""
LEAST_INSIDE = 60
"""Fewer rows, or drives, than this cannot show an accuracy of 95 %."""
RESERVE = 0.01
"""By how much more the choosing rows have to show, since they were chosen by."""


@dataclass(frozen=True)
class Envelope:
    """A box, and what rows that did not choose it say; at most one condition for each factor. `at_least` is the lower
    end of the interval of the accuracy, and `held` whether that is as much as was asked for."""

    conditions: RuleConditions
    inside: Observations
    at_least: float
    held: bool


def find_envelope(choosing: Observations, counting: Observations, accuracy: float) -> Envelope | None:
    """Return the largest box that promises an accuracy in (0, 1), the lower end of a 95 % interval; None where no box
    of enough rows does. Some rows choose the box, and others try it, once."""
    conditions: RuleConditions = ()
    inside = np.ones(len(choosing), dtype=bool)
    while choosing.where(inside).interval[0] < min(accuracy + RESERVE, (1.0 + accuracy) / 2.0):
        best, kept = max(
            ((one, covered(one, choosing)) for one in _peeled(conditions, choosing, inside)),
            key=lambda pair: _mean(choosing, pair[1]),
            default=((), inside),
        )
        if not best or _units(choosing, kept) < LEAST_INSIDE:
            return None
        conditions, inside = best, kept
    tried = counting.where(covered(conditions, counting))
    low = tried.interval[0]
    return Envelope(conditions, tried, low, low >= accuracy)


def _units(found: Observations, inside: np.ndarray) -> int:
    return int(inside.sum()) if found.independent else len(np.unique(found.units[inside]))


def _mean(found: Observations, inside: np.ndarray) -> float:
    return float(found.right[inside].mean()) if _units(found, inside) >= LEAST_INSIDE else -1.0


def _peeled(conditions: RuleConditions, found: Observations, inside: np.ndarray) -> Iterator[RuleConditions]:
    """Boxes that are a little smaller, in one factor each."""
    own = {one.place: one for one in conditions}
    for place, factor in enumerate(found.factors):
        column = found.values[inside, place]
        if factor.options:
            whole = RuleCondition(place, options=frozenset(range(len(factor.options))))
            before = own.get(place, whole)
            assert before.options is not None
            smaller = [replace(before, options=before.options - {one}) for one in before.options]
            smaller = [one for one in smaller if one.options]
        else:
            before = own.get(place, RuleCondition(place))
            low, high = (float(f"{np.quantile(column, at):.3g}") for at in (SLICE, 1.0 - SLICE))
            smaller = [replace(before, low=low), replace(before, high=high)]
            if low < column.min() or low >= column.max():  # few different values: the least one goes
                smaller[0] = replace(before, low=float(column.min()))
            if high >= column.max():
                rest = column[column < column.max()]
                smaller[1] = replace(before, high=float(rest.max())) if len(rest) else before
        for one in smaller:
            if one != before and (one.low < one.high):
                yield tuple({**own, place: one}[key] for key in sorted({**own, place: one}))


MOST, FEWEST = 6, 8
"""Clusters at most, and failures of which clusters are sought at least."""

REFERENCES = 19
"""Draws of as many points from one normal distribution like them: groups in none of these may be as far apart."""

DIMENSIONS = 8
"""Principal components that distances are measured in."""


@dataclass(frozen=True)
class Clusters:
    """Groups of failures by number, the most typical and the largest group first; their mean silhouette, None where all
    are one group; and whether groups of a cloud without any are less apart."""

    members: tuple[tuple[int, ...], ...]
    silhouette: float | None
    apart: bool


def find_clusters(features: NDArray[np.float64], seed: int) -> Clusters:
    """Group failures by k-means over the directions of their features (n, F).

    How many groups there are is chosen by the mean silhouette (Rousseeuw 1987). They are apart if it is larger than
    that of each reference, grouped likewise (after Tibshirani, Walther and Hastie 2001). It takes scikit-learn.
    """
    lengths = np.linalg.norm(features, axis=1, keepdims=True)
    points = features / np.maximum(lengths, 1e-12)
    count = min(DIMENSIONS, *points.shape)
    if len(points) < FEWEST:
        return Clusters((tuple(range(len(points))),), None, False)
    points = import_library("sklearn.decomposition").PCA(count, random_state=0).fit_transform(points)
    generator = np.random.default_rng(seed)
    score, found = _grouped(points)
    spread = points.std(axis=0)
    drawn = (generator.standard_normal(points.shape) * spread for _ in range(REFERENCES))
    apart = all(_grouped(one)[0] < score for one in drawn)
    groups = [np.flatnonzero(found == k) for k in range(int(found.max()) + 1)]
    ordered = sorted((_by_distance(points, group) for group in groups), key=len, reverse=True)
    return Clusters(tuple(ordered), score if len(ordered) > 1 else None, apart and len(ordered) > 1)


def _grouped(points: NDArray[np.float64]) -> tuple[float, NDArray[np.int64]]:
    """Return the largest mean silhouette over numbers of groups, and the group of each point."""
    best = (-1.0, np.zeros(len(points), dtype=np.int64))
    distinct = len(np.unique(points.round(9), axis=0))
    for k in range(2, min(MOST, distinct - 1) + 1):
        found = import_library("sklearn.cluster").KMeans(k, n_init=4, random_state=0).fit_predict(points)
        score = float(import_library("sklearn.metrics").silhouette_score(points, found))
        if score > best[0]:
            best = score, found
    return best


def _by_distance(points: NDArray[np.float64], group: NDArray[np.intp]) -> tuple[int, ...]:
    away = np.linalg.norm(points[group] - points[group].mean(axis=0), axis=1)
    return tuple(int(one) for one in group[np.argsort(away, kind="stable")])
