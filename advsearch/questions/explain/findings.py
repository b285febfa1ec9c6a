"""What rows say beside rules: which factors decide, a box to rely on, and failures that look alike.

Factors. A factor's values are cut into parts that have equally many rows (a name is a part). The share is the variance
of the model's accuracy between the parts over the variance of the yes/no predictions: the first-order Sobol index of
the prediction, by parts (given-data estimators: Plischke, Borgonovo and Smith 2013). What differs inside a part is not
in it, so that the index without parts is at least as large. Of two factors it is that of the parts of both at once.

Of n predictions and k parts, n times the share that is counted is Pearson's chi-squared statistic of a table of k x 2,
and the true share is its noncentrality over n (Cohen's w squared). The interval is that of the noncentrality (Smithson
2003, "Confidence Intervals"). Where predictions are those of units (frames of drives), chance adds more to the
statistic than with independent ones: it is divided by how much more, which the deviations of units say, and is one of
F, as that is known from few units (Rao and Scott 1981, their first-order correction; Thomas and Rao 1987).
`benchmarks/explain.py` and `benchmarks/drives.py` print in how many of repeated samples it covers the truth.

The box is peeled (PRIM: Friedman and Fisher 1999, section 6): a thin slice of one factor, or one of its names, is taken
off again and again where that raises the accuracy of what is left the most. One half of the rows chooses the box, and
the other half, which has seen no choice, is asked once whether it keeps what is promised.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2, ncf, ncx2
from scipy.stats import f as fisher

from advsearch import rules
from advsearch.questions.explain.result import EnvelopeRow, ParameterWeight, RightOf, RuleNotTold
from advsearch.rules import CountedRule, RuleCondition, RuleConditions, covered, interval_of, merge_repeats, share_of
from advsearch.runs.tables import count_wrong_outcomes
from advsearch.statistics.intervals import CONFIDENCE

MOST_PARTS = 20
ROWS_IN_A_CELL = 25  # Rows that a cell of two factors' parts has on average, at least
CHANCE = 0.01
"""Probability that any pair is told to decide together where none does; each is tested at its part (Bonferroni)."""
LEAST_SPREAD = 0.1
"""What chance adds for units, at least, of what it adds to independent predictions, though units deviate in nothing."""
Places = npt.NDArray[np.int64]


def find_importance(table: pd.DataFrame) -> list[ParameterWeight]:
    """Return each factor of a table (`rules`) by falling share, without what chance adds to it, then the pairs that
    decide together more than each of the two by itself. Nothing where the predictions are all the same."""
    if table["correct"].nunique() < 2:
        return []
    table = merge_repeats(table)
    predictions, factors = _Predictions(table), list(table.attrs["units"])
    fine, few = round(predictions.count ** (1.0 / 3.0)), max(2, math.isqrt(predictions.count // ROWS_IN_A_CELL))
    alone = [predictions.weight([factor], _parts(table[factor], fine)) for factor in factors]
    pairs, tested = [], list(combinations(factors, 2))
    coarse = {factor: _parts(table[factor], few) for factor in factors}
    for pair in tested:
        first, second = (coarse[factor] for factor in pair)
        both = first * (int(second.max()) + 1) + second
        if predictions.chance_of_more(both, first, second) < CHANCE / len(tested):
            pairs.append(predictions.weight([*pair], both))
    return [weight for weights in (alone, pairs) for weight in sorted(weights, key=lambda weight: -weight.share)]


def _parts(column: pd.Series, most: int) -> Places:
    """The part of each row (n,): a name, or one of at most so many parts of equally many rows."""
    if column.dtype == "category":
        return np.asarray(column.cat.codes, dtype=np.int64)
    values = column.to_numpy()
    ends = np.unique(np.quantile(values, np.linspace(0.0, 1.0, min(max(2, most), MOST_PARTS) + 1)[1:-1]))
    return np.asarray(np.searchsorted(ends, values, side="left"), dtype=np.int64)


class _Predictions:
    """The predictions of a table: (n,) whether they are right, the number of the unit of each, and its weight: all
    units weigh the same, so that few with many rows do not decide; 1 on average."""

    def __init__(self, table: pd.DataFrame) -> None:
        self.right: npt.NDArray[np.bool_] = table["correct"].to_numpy()
        units, self.units = np.unique(table["unit"], return_inverse=True)
        self.count, self.independent = len(units), table["unit"].is_unique
        self.weights = len(self.right) / self.count / np.bincount(self.units)[self.units]
        self.mean = float(np.average(self.right, weights=self.weights))
        self.variance = self.mean * (1.0 - self.mean)

    def between(self, parts: Places) -> tuple[float, int]:
        """The share of the variance between parts as it is counted, and the number of parts that have rows."""
        seen = np.bincount(parts, self.weights)
        rate = np.bincount(parts, self.weights * self.right)[seen > 0] / seen[seen > 0]
        return float((seen[seen > 0] * (rate - self.mean) ** 2).sum()) / len(self.right) / self.variance, len(rate)

    def weight(self, factors: list[str], parts: Places) -> ParameterWeight:
        (counted, k), n, by_chance = self.between(parts), len(self.right), self.by_chance(parts)
        if k < 2 or math.isnan(by_chance):
            return ParameterWeight(parameters=factors, share=0.0, interval=(0.0, 1.0), parts=k)
        tail, spread, others = (1.0 - CONFIDENCE) / 2.0, by_chance / (k - 1), float(self.count - k)
        if self.independent:
            spread, others = 1.0, math.inf
        statistic = n * counted / spread
        low = spread * _noncentrality(statistic, k - 1, others, 1.0 - tail) / n
        high = spread * _noncentrality(max(statistic, k - 1.0), k - 1, others, tail) / n  # fewer: less than chance
        share = 1.0 - (1.0 - counted) * (n - 1) / max(n - k, 1) if self.independent else counted - by_chance / n
        interval = min(low, 1.0), min(high, 1.0)
        return ParameterWeight(parameters=factors, share=max(share, 0.0), interval=interval, parts=k)

    def by_chance(self, parts: Places) -> float:
        """What chance adds to the statistic of some parts, from how much units deviate: k - 1 where predictions are
        independent; NaN where too few units say it."""
        seen, right = np.bincount(parts, self.weights), self.right
        if self.independent:
            return float((seen > 0).sum() - 1)
        rate = np.divide(np.bincount(parts, self.weights * right), seen, out=np.zeros(len(seen)), where=seen > 0)
        both, places = np.unique(parts * self.count + self.units, return_inverse=True)
        away = np.bincount(places.reshape(-1), self.weights * (right - rate[parts]))
        of, unit = both // self.count, both % self.count
        in_part = np.bincount(of, minlength=len(seen))
        if self.count < 2 or self.count <= (seen > 0).sum() or (in_part[seen > 0] < 2).any():
            return math.nan
        each = np.bincount(of, away**2, minlength=len(seen))[seen > 0]
        mine = in_part[seen > 0]
        alone = float((each * mine / (mine - 1) / seen[seen > 0]).sum())
        together = np.bincount(unit, away)
        whole = float((together**2).sum()) * self.count / (self.count - 1) / len(right)
        return max((alone - whole) / self.variance, LEAST_SPREAD * float((seen > 0).sum() - 1))

    def chance_of_more(self, both: Places, one: Places, other: Places) -> float:
        """How likely it is that chance makes the statistic of two factors exceed those of each by so much."""
        (joint, cells), (first, k), (second, m) = (self.between(parts) for parts in (both, one, other))
        more, freedom = len(self.right) * (joint - first - second), max(1, cells - k - m + 1)
        if self.independent:
            return float(chi2.sf(more, freedom))
        adds = self.by_chance(both) - self.by_chance(one) - self.by_chance(other)
        others = self.count - freedom - 1
        if not adds > 0.0 or others < 1:
            return 1.0
        return float(fisher.sf(more / adds, freedom, others))


def _noncentrality(statistic: float, freedom: int, others: float, probability: float) -> float:
    """Where a chi-squared variable, or `freedom` times one of F, is at most the statistic with a probability; or 0."""

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


SLICE = 0.05  # Share of the rows left that is peeled off a side at a time
LEAST_INSIDE = 60  # Fewer rows, or drives, than this cannot show an accuracy of 95 %
RESERVE = 0.01  # By how much more the choosing rows have to show, since they were chosen by


def find_envelope(choosing: pd.DataFrame, counting: pd.DataFrame, accuracy: float) -> EnvelopeRow | None:
    """Return the largest box that promises an accuracy in (0, 1), the lower end of a 95 % interval; None where no box
    of enough rows does. Some rows choose the box, and others try it, once."""
    if choosing.empty:
        return None
    conditions: RuleConditions = ()
    inside, independent = choosing, choosing["unit"].is_unique
    while interval_of(inside)[0] < min(accuracy + RESERVE, (1.0 + accuracy) / 2.0):
        best: RuleConditions | None = None
        most, kept = -1.0, inside
        for smaller in _peeled(conditions, inside):
            left = choosing[covered(smaller, choosing)]
            enough = (len(left) if independent else left["unit"].nunique()) >= LEAST_INSIDE
            if enough and left["correct"].mean() > most:
                best, most, kept = smaller, left["correct"].mean(), left
        if best is None:
            return None
        conditions, inside = best, kept
    tried = right_of(counting[covered(conditions, counting)])
    rows = [condition.row for condition in conditions]
    return EnvelopeRow(conditions=rows, **vars(tried), accuracy=accuracy, held=tried.interval[0] >= accuracy)


def _peeled(conditions: RuleConditions, inside: pd.DataFrame) -> Iterator[RuleConditions]:
    """Boxes that are a little smaller than the one that has some rows, in one factor each."""
    own = {one.factor: one for one in conditions}
    for factor, unit in inside.attrs["units"].items():
        column, before = inside[factor], own.get(factor, RuleCondition(factor, unit))
        if column.dtype == "category":
            names = before.options or frozenset(column.cat.categories)
            smaller = [replace(before, options=names - {one}) for one in sorted(names)] if len(names) > 1 else []
        else:
            values = column.to_numpy()
            low, high = (float(f"{np.quantile(values, at):.3g}") for at in (SLICE, 1.0 - SLICE))
            smaller = [replace(before, low=low), replace(before, high=high)]
            if low < values.min() or low >= values.max():  # few different values: the least one goes
                smaller[0] = replace(before, low=float(values.min()))
            if high >= values.max():
                rest = values[values < values.max()]
                smaller[1] = replace(before, high=float(rest.max())) if len(rest) else before
        for one in smaller:
            if one != before and one.low < one.high:
                box = {**own, factor: one}
                yield tuple(box[name] for name in inside.attrs["units"] if name in box)


def right_of(rows: pd.DataFrame) -> RightOf:
    """Count right rows; their share is the mean over units."""
    return RightOf(
        right=int(rows["correct"].sum()),
        total=len(rows),
        interval=interval_of(rows),
        share=None if rows.empty else share_of(rows),
        outcomes=count_wrong_outcomes(rows),
    )


def cautions(table: pd.DataFrame, importance: Sequence[ParameterWeight]) -> list[str]:
    """Return what a reader has to know of the rows of a table and of what decides."""
    texts, draws = list[str](), table["unit"].nunique()
    if draws == 1:
        texts.append(
            "The rows are of one draw: a single drive, or pictures that differ in noise alone. The shares are of this "
            "one, and nothing is shown of others."
        )
    elif draws < rules.FEWEST_ROWS:
        texts.append(f"The rows are of {draws} draws, each with several, which are not independent: few show little.")
    if table["correct"].nunique() < 2:
        always = "right" if table["correct"].all() else "wrong"
        texts.append(f"The model is {always} in every row: there is nothing to tell apart.")
    elif all(weight.interval[0] <= 0.0 for weight in importance):
        texts.append("No parameter is shown to decide anything: the intervals of all their shares begin at 0.")
    return texts


def rule_counts(rule: CountedRule) -> dict[str, Any]:
    """Return what a rule is, and how often the model is right under it and elsewhere."""
    conditions = [one.row for one in rule.conditions]
    return {"conditions": conditions, **vars(right_of(rule.inside)), "elsewhere": right_of(rule.elsewhere)}


def not_told(rule: CountedRule | None, rows: int) -> RuleNotTold | None:
    """Return what is said of a rule that is not told, found in so many rows."""
    if rule is None:
        return None
    times, needed = rule.times_needed(), None
    if times is not None:  # with two digits that mean something: 173.2 becomes 180
        step: int = 10 ** max(0, math.floor(math.log10(times * rows)) - 1)
        needed = math.ceil(times * rows / step) * step
    return RuleNotTold(**rule_counts(rule), chance=rule.chance, asked=rules.CHANCE, rows=needed)


MOST, FEWEST = 6, 8  # Clusters at most, and failures of which clusters are sought at least
REFERENCES = 19
"""Draws of as many points from one normal distribution like them: groups in none of these may be as far apart."""
DIMENSIONS = 8  # Principal components that distances are measured in


@dataclass(frozen=True)
class Clusters:
    """Groups of failures by number, the most typical and the largest group first; their mean silhouette, None where all
    are one group; and whether groups of a cloud without any are less apart."""

    members: tuple[tuple[int, ...], ...]
    silhouette: float | None
    apart: bool


def find_clusters(features: NDArray[np.float64], seed: int) -> Clusters:
    """Group failures by k-means over the directions of their features (n, F). How many groups there are is chosen by
    the mean silhouette (Rousseeuw 1987). They are apart if it is larger than that of each reference, grouped likewise
    (after Tibshirani, Walther and Hastie 2001). It takes scikit-learn."""
    lengths = np.linalg.norm(features, axis=1, keepdims=True)
    points = features / np.maximum(lengths, 1e-12)
    count = min(DIMENSIONS, *points.shape)
    if len(points) < FEWEST:
        return Clusters((tuple(range(len(points))),), None, False)
    points = rules.import_library("sklearn.decomposition").PCA(count, random_state=0).fit_transform(points)
    generator = np.random.default_rng(seed)
    score, found = _grouped(points)
    spread = points.std(axis=0)
    drawn = (generator.standard_normal(points.shape) * spread for _ in range(REFERENCES))
    apart = all(_grouped(one)[0] < score for one in drawn)
    groups = [np.flatnonzero(found == k) for k in range(int(found.max()) + 1)]
    away = [np.linalg.norm(points[group] - points[group].mean(axis=0), axis=1) for group in groups]
    typical = [group[np.argsort(far, kind="stable")].tolist() for group, far in zip(groups, away, strict=True)]
    ordered = sorted(map(tuple, typical), key=len, reverse=True)
    return Clusters(tuple(ordered), score if len(ordered) > 1 else None, apart and len(ordered) > 1)


def _grouped(points: NDArray[np.float64]) -> tuple[float, NDArray[np.int64]]:
    """Return the largest mean silhouette over numbers of groups, and the group of each point."""
    best = (-1.0, np.zeros(len(points), dtype=np.int64))
    distinct = len(np.unique(points.round(9), axis=0))
    for k in range(2, min(MOST, distinct - 1) + 1):
        groups = rules.import_library("sklearn.cluster").KMeans(k, n_init=4, random_state=0).fit_predict(points)
        score = float(rules.import_library("sklearn.metrics").silhouette_score(points, groups))
        if score > best[0]:
            best = score, groups
    return best
