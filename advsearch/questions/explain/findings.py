"""What rows say beside rules: which factors decide, a box to rely on, and failures that look alike.

Factors. A factor's values are cut into parts that have equally many rows (a name is a part). The share is the variance
of the model's accuracy between the parts over the variance of the yes/no answers: the first-order Sobol index of the
answer, by parts (given-data estimators: Plischke, Borgonovo and Smith 2013). What differs inside a part is not in it,
so that the index without parts is at least as large. Of two factors it is that of the parts of both at once.

Of n answers and k parts, n times the share that is counted is Pearson's chi-squared statistic of a table of k x 2, and
the true share is its noncentrality over n (Cohen's w squared). The interval is that of the noncentrality (Smithson
2003, "Confidence Intervals"). `benchmarks/explain.py` prints in how many of repeated samples it covers the truth.

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
from scipy.stats import chi2, ncx2

from advsearch.attacks import clopper_pearson
from advsearch.attacks.trials import CONFIDENCE
from advsearch.explanations import Observations, RuleCondition, RuleConditions, covered, import_library

MOST_PARTS = 20
ROWS_IN_A_CELL = 25
"""Rows that a cell of two factors' parts has on average, at least."""
CHANCE = 0.01
"""Probability that any pair is told to decide together where none does; each is tested at its part (Bonferroni)."""

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
    count, wide = len(found), range(len(found.factors))
    alone = [_weight((k,), _parts(found, k, round(count ** (1.0 / 3.0))), found.right) for k in wide]
    pairs, tested = [], list(combinations(wide, 2))
    few = max(2, math.isqrt(count // ROWS_IN_A_CELL))
    coarse = [_parts(found, k, few) for k in wide]
    for i, j in tested:
        both = coarse[i] * (int(coarse[j].max()) + 1) + coarse[j]
        (first, k), (second, m), (joint, cells) = (_between(one, found.right) for one in (coarse[i], coarse[j], both))
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


def _between(parts: Places, right: npt.NDArray[np.bool_]) -> tuple[float, int]:
    """The share of the variance between parts as it is counted, and the number of parts that have rows."""
    seen = np.bincount(parts)
    rate = np.bincount(parts, right)[seen > 0] / seen[seen > 0]
    mean = float(right.mean())
    return float((seen[seen > 0] * (rate - mean) ** 2).sum()) / len(right) / (mean * (1.0 - mean)), len(rate)


def _weight(places: tuple[int, ...], parts: Places, right: npt.NDArray[np.bool_]) -> FactorWeight:
    (counted, k), n = _between(parts, right), len(right)
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


SLICE = 0.05
"""Share of the rows left that is peeled off a side at a time."""
LEAST_INSIDE = 60
"""Fewer rows than this cannot show an accuracy of 95 %."""
RESERVE = 0.01
"""By how much more the choosing rows have to show, since they were chosen by."""


@dataclass(frozen=True)
class Envelope:
    """A box, and what rows that did not choose it say; at most one condition for each factor. `at_least` is the lower
    end of the interval of the accuracy, and `held` whether that is as much as was asked for."""

    conditions: RuleConditions
    right: int
    of: int
    at_least: float
    held: bool


def find_envelope(choosing: Observations, counting: Observations, accuracy: float) -> Envelope | None:
    """Return the largest box that promises an accuracy in (0, 1), the lower end of a 95 % interval; None where no box
    of enough rows does. Some rows choose the box, and others try it, once."""
    conditions: RuleConditions = ()
    inside = np.ones(len(choosing), dtype=bool)
    while _at_least(choosing.right[inside]) < min(accuracy + RESERVE, (1.0 + accuracy) / 2.0):
        best, kept = max(
            ((one, covered(one, choosing)) for one in _peeled(conditions, choosing, inside)),
            key=lambda pair: _mean(choosing.right[pair[1]]),
            default=((), inside),
        )
        if not best or int(kept.sum()) < LEAST_INSIDE:
            return None
        conditions, inside = best, kept
    right = counting.right[covered(conditions, counting)]
    low = _at_least(right)
    return Envelope(conditions, int(right.sum()), len(right), low, low >= accuracy)


def _at_least(right: np.ndarray) -> float:
    return clopper_pearson(int(right.sum()), len(right))[0] if len(right) else 0.0


def _mean(right: np.ndarray) -> float:
    return float(right.mean()) if len(right) >= LEAST_INSIDE else -1.0


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
    """Group failures by k-means over the directions of their features.

    How many groups there are is chosen by the mean silhouette (Rousseeuw 1987). They are apart if it is larger than
    that of each reference, grouped likewise (after Tibshirani, Walther and Hastie 2001).

    Args:
        features: (n, F), n at least 1.
        seed: of the references.

    Raises:
        InputError: scikit-learn is not installed.
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
