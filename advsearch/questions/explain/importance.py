"""Estimate which factors decide the predictions, and how much.

The values of a factor are divided into groups with equally many rows (each name is a
group). The fraction of a factor is the variance of the accuracy between its groups,
divided by the variance of the predictions (1 if right, 0 if wrong). It is the
first-order Sobol index, estimated by groups (given-data estimators: Plischke, Borgonovo
and Smith 2013). Differences inside a group are not counted, so that the index without
groups is at least as large. The fraction of two factors is that of the groups that
their values have together.

For n predictions and k groups, n times the estimated fraction is Pearson's chi-squared
statistic of a table of k x 2. The true fraction is the noncentrality of that statistic,
divided by n (Cohen's w squared). Its interval is that of the noncentrality (Smithson
2003, "Confidence Intervals").

Predictions may come in clusters (frames of drives). Then the statistic of a factor
without effect is larger by the design effect, which is estimated from the residuals of
clusters. The statistic is divided by it (Rao and Scott 1981, their first-order
correction). Its distribution is then an F distribution, because the design effect is
estimated from few clusters (Thomas and Rao 1987). `benchmarks/explain.py` and
`benchmarks/drives.py` print how often the interval covers the truth.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy.optimize import brentq
from scipy.stats import chi2, ncf, ncx2
from scipy.stats import f as f_distribution

from advsearch.extend import rules, statistics
from advsearch.questions.explain.result import ParameterWeight

MAX_GROUPS = 20
"""Maximum number of groups of a factor with numbers."""
MIN_ROWS_PER_CELL = 25
"""Minimum of the average number of rows in a cell: a group of one factor and a group of
another.
"""
SIGNIFICANCE = 0.01
"""Maximum probability that any pair is reported if no factors interact (Bonferroni)."""
MIN_INFLATION = 0.1
"""Lower limit of the design effect of clusters."""

BoolArray = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


def find_importance(table: pd.DataFrame) -> list[ParameterWeight]:
    """Estimate how much each factor, and each interacting pair, decides predictions.

    The number of groups of a factor is about the cube root of the number of clusters.
    Factors of pairs have fewer groups, so that a cell of both has `MIN_ROWS_PER_CELL`
    rows on average.

    Args:
        table: a row for each prediction, with the columns `correct`, `unit` (the
            cluster) and a column for each factor. The keys of `attrs["units"]` are
            the names of the factors.

    Returns:
        The factors by descending fraction of the variance that they explain, then the
        pairs in the same way. Empty if all predictions are the same.
    """
    if table["correct"].nunique() < 2:
        return []
    table = rules.merge_repeats(table)
    sample = ClusteredPredictions(table)
    n_groups = round(sample.n_clusters ** (1.0 / 3.0))
    factors = list(table.attrs["units"])
    single_weights = [
        sample.estimate_weight([factor], cut_into_groups(table[factor], n_groups))
        for factor in factors
    ]
    pair_weights = _find_interacting_pairs(table, sample)
    return [*sort_by_fraction(single_weights), *sort_by_fraction(pair_weights)]


def _find_interacting_pairs(
    table: pd.DataFrame, sample: ClusteredPredictions
) -> list[ParameterWeight]:
    """Return the weights of the pairs of factors that interact significantly.

    Two factors interact if together they explain a larger fraction of the variance of
    predictions than the sum of what each explains.

    Args:
        table: the predictions, and a column of values for each factor.
        sample: the same predictions with their clusters.
    """
    # Two factors have n_groups^2 cells: few groups, so that a cell has
    # `MIN_ROWS_PER_CELL` clusters on average.
    n_groups = max(2, math.isqrt(sample.n_clusters // MIN_ROWS_PER_CELL))
    group_of_factor = {
        factor: cut_into_groups(table[factor], n_groups)
        for factor in table.attrs["units"]
    }
    pairs = list(combinations(group_of_factor, 2))
    pair_weights = []
    for factors in pairs:
        group_a, group_b = (group_of_factor[factor] for factor in factors)
        joint_group = cross_groups(group_a, group_b)
        p_value = sample.interaction_p_value(joint_group, group_a, group_b)
        if p_value < SIGNIFICANCE / len(pairs):
            pair_weights.append(sample.estimate_weight([*factors], joint_group))
    return pair_weights


def sort_by_fraction(weights: list[ParameterWeight]) -> list[ParameterWeight]:
    """Sort weights by their fraction of the variance, the largest first."""
    return sorted(weights, key=lambda weight: -weight.share)


def cut_into_groups(column: pd.Series, n_groups: int) -> IntArray:
    """Return the index of the group of each row (n,).

    Each name is a group. Numbers are cut at quantiles into at most `n_groups` groups of
    equally many rows.

    Args:
        column: (n,) values of a factor: names (a category) or numbers.
        n_groups: number of groups of numbers.
    """
    if column.dtype == "category":
        return np.asarray(column.cat.codes, dtype=np.int64)
    values = column.to_numpy()
    n_bins = min(max(2, n_groups), MAX_GROUPS)
    # quantiles between the groups; equal ones are merged, as many rows may have the
    # same value
    inner_edges = np.unique(
        np.quantile(values, np.linspace(0.0, 1.0, n_bins + 1)[1:-1])
    )
    return np.asarray(np.searchsorted(inner_edges, values, side="left"), dtype=np.int64)


def cross_groups(first: IntArray, second: IntArray) -> IntArray:
    """Return the joint group of each row (n,), from its groups by two factors.

    Two rows are in the same joint group if they are in the same group by both factors.
    """
    return first * (int(second.max()) + 1) + second


class _Correction(NamedTuple):
    """A fraction of the variance without what chance adds, and how it is distributed.

    Attributes:
        fraction: the corrected fraction.
        design_effect: by how much clusters make the statistic larger; 1 without them.
        error_degrees: degrees of freedom of F's denominator; infinity for chi-squared.
    """

    fraction: float
    design_effect: float
    error_degrees: float


class _Cells(NamedTuple):
    """What groups and clusters of predictions have in common.

    Attributes:
        cell_of_prediction: the cell of each prediction (n,).
        group: the group of each cell (cells,).
        cluster: the cluster of each cell (cells,).
    """

    cell_of_prediction: IntArray
    group: IntArray
    cluster: IntArray


class ClusteredPredictions:
    """Right and wrong predictions in clusters, such as drives, of equal weight.

    A cluster with many rows has the same weight as any other.

    Attributes:
        correct: whether each prediction is right (n,).
        cluster: index of the cluster of each prediction (n,).
        n_clusters: number of clusters.
        is_independent: whether each prediction is a cluster by itself.
        weight: weight of each prediction (n,), 1 on average.
        mean: weighted fraction of right predictions.
        variance: variance of the predictions.
    """

    def __init__(self, table: pd.DataFrame) -> None:
        """Read the predictions of a table.

        Args:
            table: has the columns `correct`, and `unit`, the cluster of each row.
        """
        self.correct: BoolArray = table["correct"].to_numpy()
        clusters, self.cluster = np.unique(table["unit"], return_inverse=True)
        self.n_clusters = len(clusters)
        self.is_independent = table["unit"].is_unique
        # The sum of the weights in each cluster is rows / clusters, so that the sum of
        # all weights is the number of rows.
        cluster_size = np.bincount(self.cluster)
        self.weight = len(self.correct) / self.n_clusters / cluster_size[self.cluster]
        self.mean = float(np.average(self.correct, weights=self.weight))
        # variance of a random number that is 1 or 0
        self.variance = self.mean * (1.0 - self.mean)

    def explained_fraction(self, group: IntArray) -> tuple[float, int]:
        """Return the fraction of the variance between groups, and the number of groups.

        The fraction is the weighted mean of (rate of the group - mean)^2 over the
        predictions, divided by their variance.

        Args:
            group: (n,) the group of each prediction. Indices without any prediction do
                not count as groups.
        """
        group_weight = np.bincount(group, self.weight)
        is_used = group_weight > 0
        used_weight = group_weight[is_used]
        group_rate = (
            np.bincount(group, self.weight * self.correct)[is_used] / used_weight
        )
        sum_of_squares = float((used_weight * (group_rate - self.mean) ** 2).sum())
        # The sum of all weights is the number of rows.
        fraction = sum_of_squares / len(self.correct) / self.variance
        n_groups = len(group_rate)
        return fraction, n_groups

    def estimate_weight(self, factors: list[str], group: IntArray) -> ParameterWeight:
        """Estimate the fraction of the variance between groups with its 95 % interval.

        Even the groups of a factor without effect differ by chance. What chance adds on
        average is subtracted from the fraction: as in the adjusted R squared if rows
        are independent, and by `expected_statistic` if they are in clusters. If that is
        not known, or if there is a single group, the fraction is 0 and its interval 0
        to 1: nothing is known.

        Args:
            factors: names of the factors.
            group: (n,) the group of each prediction, by the values of the factors.
        """
        fraction, n_groups = self.explained_fraction(group)
        chance_statistic = self.expected_statistic(group)  # without any effect
        is_known = n_groups >= 2 and not math.isnan(chance_statistic)
        if not is_known:
            return ParameterWeight(
                parameters=factors, share=0.0, interval=(0.0, 1.0), parts=n_groups
            )

        correction = self._correct_fraction(fraction, n_groups, chance_statistic)
        return ParameterWeight(
            parameters=factors,
            share=max(correction.fraction, 0.0),
            interval=self._estimate_fraction_interval(fraction, n_groups, correction),
            parts=n_groups,
        )

    def _estimate_fraction_interval(
        self, fraction: float, n_groups: int, correction: _Correction
    ) -> tuple[float, float]:
        """Return the 95 % interval of a fraction of the variance between groups.

        It follows from the statistic rows * fraction / design effect. That has a
        noncentral chi-squared distribution (with clusters, a noncentral F, multiplied
        by the degrees of freedom). Its noncentrality is rows * true fraction / design
        effect: an interval of the noncentrality gives one of the true fraction.

        Args:
            fraction: the explained fraction, before the correction.
            n_groups: number of groups.
            correction: its design effect and its degrees of freedom are used.
        """
        n_rows = len(self.correct)
        design_effect = correction.design_effect
        lower_noncentrality, upper_noncentrality = noncentrality_interval(
            n_rows * fraction / design_effect, n_groups - 1, correction.error_degrees
        )
        lower = min(design_effect * lower_noncentrality / n_rows, 1.0)
        upper = min(design_effect * upper_noncentrality / n_rows, 1.0)
        return lower, upper

    def _correct_fraction(
        self, fraction: float, n_groups: int, chance_statistic: float
    ) -> _Correction:
        """Subtract from a fraction of the variance what chance adds on average.

        Args:
            fraction: the explained fraction.
            n_groups: number of groups.
            chance_statistic: expected statistic of a factor without any effect.
        """
        n_rows = len(self.correct)
        if self.is_independent:
            # adjusted R squared: 1 - (1 - R²) (n - 1) / (n - k)
            residual_degrees = max(n_rows - n_groups, 1)
            corrected = 1.0 - (1.0 - fraction) * (n_rows - 1) / residual_degrees
            return _Correction(corrected, design_effect=1.0, error_degrees=math.inf)
        return _Correction(
            fraction - chance_statistic / n_rows,
            # Independent rows have `n_groups - 1` as their expected statistic.
            design_effect=chance_statistic / (n_groups - 1),
            error_degrees=float(self.n_clusters - n_groups),
        )

    def expected_statistic(self, group: IntArray) -> float:
        """Compute the expected chi-squared statistic of a factor without effect.

        The statistic is the number of rows times `explained_fraction`, that is the sum
        over groups of weight * (rate of the group - overall rate)^2, divided by the
        variance of a prediction. With independent rows, its expectation is (groups -
        1). With clusters, it is (groups - 1) times the design effect (Rao and Scott
        1981, section 3).

        The result is at least `MIN_INFLATION` times (groups - 1). It is NaN if a group
        has fewer than two clusters.

        Args:
            group: (n,) the group of each prediction.
        """
        group_weight = np.bincount(group, self.weight)
        is_used = group_weight > 0
        n_groups = int(is_used.sum())
        if self.is_independent:
            return float(n_groups - 1)

        cells = self._divide_into_cells(group)
        clusters_per_group = np.bincount(cells.group, minlength=len(group_weight))
        if not self._has_enough_clusters(n_groups, clusters_per_group[is_used]):
            return math.nan
        excess = self._estimate_excess(group, group_weight, cells, clusters_per_group)
        return max(excess, MIN_INFLATION * float(n_groups - 1))

    def _divide_into_cells(self, group: IntArray) -> _Cells:
        """Return the cells of predictions, by their groups (n,) and their clusters."""
        cell_id, index = np.unique(
            group * self.n_clusters + self.cluster, return_inverse=True
        )
        cell_group, cell_cluster = np.divmod(cell_id, self.n_clusters)
        return _Cells(index.reshape(-1), cell_group, cell_cluster)

    def _estimate_excess(
        self,
        group: IntArray,
        group_weight: npt.NDArray[Any],
        cells: _Cells,
        clusters_per_group: IntArray,
    ) -> float:
        """Estimate the expected statistic of a factor without effect from clusters.

        It is the sum over groups of weight * variance of the group's rate, minus rows *
        variance of the overall rate, divided by the variance of a prediction. The
        variances of the rates are estimated from the residuals of clusters.

        Args:
            group: (n,) the group of each prediction.
            group_weight: (groups,) sum of the weights; 0 for a group that is not used.
            cells: cells of the groups and the clusters.
            clusters_per_group: (groups,) number of clusters of each group.
        """
        is_used = group_weight > 0
        residual = self._weighted_residual(group, group_weight, is_used)
        cell_residual = np.bincount(cells.cell_of_prediction, residual)
        # (groups,) sum over the cells of each group
        squared_residual = np.bincount(
            cells.group, cell_residual**2, minlength=len(group_weight)
        )
        within_groups = within_group_variance(
            squared_residual[is_used],
            clusters_per_group[is_used],
            group_weight[is_used],
        )
        between_clusters = self._between_cluster_variance(cells.cluster, cell_residual)
        return float((within_groups - between_clusters) / self.variance)

    def _has_enough_clusters(self, n_groups: int, clusters_per_group: IntArray) -> bool:
        """Return whether the variances of rates can be estimated from clusters.

        That inside a group needs two clusters there, and that of the overall rate more
        clusters than groups.

        Args:
            n_groups: number of groups.
            clusters_per_group: (groups,) number of clusters of each group.
        """
        if self.n_clusters < 2 or self.n_clusters <= n_groups:
            return False
        return bool(clusters_per_group.min() >= 2)

    def _weighted_residual(
        self,
        group: IntArray,
        group_weight: npt.NDArray[Any],
        is_used: npt.NDArray[np.bool_],
    ) -> FloatArray:
        """Return weight * (prediction - rate of its group) of each prediction, (n,).

        The weights (`weight`) give each cluster the same total.

        Args:
            group: (n,) the group of each prediction.
            group_weight: (groups,) sum of the weights.
            is_used: (groups,) whether a group has any prediction, and so a rate.
        """
        n_correct = np.bincount(group, self.weight * self.correct)
        group_rate = np.divide(
            n_correct, group_weight, out=np.zeros(len(group_weight)), where=is_used
        )
        residual: FloatArray = self.weight * (self.correct - group_rate[group])
        return residual

    def _between_cluster_variance(
        self, cell_cluster: IntArray, cell_residual: npt.NDArray[Any]
    ) -> float:
        """Return the number of rows times the variance of the overall rate.

        The overall rate is that of all groups. With K clusters, whose weighted
        residuals have the sums r, its variance is sum(r^2) * K / (K - 1) / rows^2. The
        factor K / (K - 1) makes it unbiased. A cluster may have several cells, one in
        each of its groups.

        Args:
            cell_cluster: (cells,) the cluster of each cell.
            cell_residual: (cells,) sum of the weighted residuals of the cell.
        """
        cluster_residual = np.bincount(cell_cluster, cell_residual)
        sum_of_squares = float((cluster_residual**2).sum())
        # rows * variance: one of the two divisions by the rows cancels out
        return (
            sum_of_squares * self.n_clusters / (self.n_clusters - 1) / len(self.correct)
        )

    def interaction_p_value(
        self, joint_group: IntArray, first_group: IntArray, second_group: IntArray
    ) -> float:
        """Return the p-value of the interaction of two factors.

        The statistic of a grouping is the number of rows times its explained fraction.
        Without an interaction, the statistic of both factors together is the sum of the
        statistics of each. The excess over this sum is the test statistic. If rows are
        independent, its distribution is chi-squared. The degrees of freedom follow from
        the numbers of groups; a group of both factors is called a cell. With clusters
        the statistic is divided by its expectation, and its distribution is F. The
        p-value is 1 if there are too few clusters.

        Args:
            joint_group: (n,) the group of each prediction by both factors.
            first_group: (n,) its group by the first factor alone.
            second_group: (n,) its group by the second factor alone.
        """
        joint_fraction, n_cells = self.explained_fraction(joint_group)
        first_fraction, n_first = self.explained_fraction(first_group)
        second_fraction, n_second = self.explained_fraction(second_group)
        excess_fraction = joint_fraction - first_fraction - second_fraction
        statistic = len(self.correct) * excess_fraction
        # (cells - 1) - (first groups - 1) - (second groups - 1)
        degrees = max(1, n_cells - n_first - n_second + 1)
        if self.is_independent:
            return float(chi2.sf(statistic, degrees))

        expected = self._expected_excess(joint_group, first_group, second_group)
        error_degrees = self.n_clusters - degrees - 1
        # `expected_statistic` is NaN if it is not known: then this is False.
        is_known = expected > 0.0
        if not is_known or error_degrees < 1:
            return 1.0
        return float(f_distribution.sf(statistic / expected, degrees, error_degrees))

    def _expected_excess(
        self, joint_group: IntArray, first_group: IntArray, second_group: IntArray
    ) -> float:
        """Return the expected statistic of an interaction without effect.

        NaN if it is not known. The arguments are those of `interaction_p_value`.
        """
        expected = self.expected_statistic(joint_group)
        expected -= self.expected_statistic(first_group)
        expected -= self.expected_statistic(second_group)
        return expected


def within_group_variance(
    squared_residual: npt.NDArray[Any],
    clusters_per_group: IntArray,
    group_weight: npt.NDArray[Any],
) -> float:
    """Return the sum over groups of weight * variance of the group's rate.

    In a group with K clusters, whose weighted residuals have the sums r, the variance
    of the rate is sum(r^2) * K / (K - 1) / weight^2. The factor K / (K - 1) makes it
    unbiased.

    Args:
        squared_residual: (k,) sum(r^2) of each group.
        clusters_per_group: (k,) number of clusters of each group, at least 2.
        group_weight: (k,) sum of the weights in each group.
    """
    # weight * variance: one of the two divisions by the weight cancels out
    weighted_variance = (
        squared_residual * clusters_per_group / (clusters_per_group - 1) / group_weight
    )
    return float(weighted_variance.sum())


def noncentrality_interval(
    statistic: float, degrees: int, error_degrees: float
) -> tuple[float, float]:
    """Return the 95 % interval of the noncentrality of a statistic's distribution.

    At the lower end of the interval, the statistic is the 97.5 % quantile of the
    distribution; at the upper end, it is the 2.5 % quantile.

    Args:
        statistic: the statistic, of a chi-squared distribution; or of F, multiplied by
            `degrees`, so that it has about the same size.
        degrees: degrees of freedom.
        error_degrees: degrees of freedom of F's denominator; infinity for chi-squared.
    """
    # A factor without effect has `degrees` as its expected statistic. A smaller one is
    # chance: the upper bound would be too small with it, or 0.
    upper_statistic = max(statistic, float(degrees))
    tail = (1.0 - statistics.intervals.CONFIDENCE) / 2.0
    lower = find_noncentrality(statistic, degrees, error_degrees, 1.0 - tail)
    upper = find_noncentrality(upper_statistic, degrees, error_degrees, tail)
    return lower, upper


def find_noncentrality(
    statistic: float, degrees: int, error_degrees: float, probability: float
) -> float:
    """Find the noncentrality at which P(value <= statistic) is `probability`.

    The larger the noncentrality, the smaller is P. If P is at most `probability` even
    without any noncentrality, this returns 0.

    Args:
        statistic: statistic of a noncentral chi-squared distribution, or `degrees`
            times one of F.
        degrees: degrees of freedom.
        error_degrees: error degrees of freedom of F's denominator; infinity for
            chi-squared.
        probability: probability of a value up to the statistic.
    """

    def excess_probability(noncentrality: float) -> float:
        """Return P(value <= statistic) - `probability`, which falls to below 0."""
        cumulative = _compute_cumulative_probability(
            statistic, degrees, error_degrees, noncentrality
        )
        return cumulative - probability

    if excess_probability(0.0) <= 0.0:
        return 0.0
    upper_bound = statistic + 20.0  # a guess, doubled until it is a bound
    while excess_probability(upper_bound) > 0.0:
        upper_bound *= 2.0
    return float(brentq(excess_probability, 0.0, upper_bound, xtol=1e-6))


def _compute_cumulative_probability(
    statistic: float, degrees: int, error_degrees: float, noncentrality: float
) -> float:
    """Return the probability of a value up to a statistic.

    Args:
        statistic: statistic of a noncentral chi-squared distribution, or `degrees`
            times one of F.
        degrees: degrees of freedom.
        error_degrees: degrees of freedom of F's denominator; infinity for chi-squared.
        noncentrality: noncentrality of the distribution; 0 for a central one.
    """
    is_central = noncentrality <= 0.0
    if math.isinf(error_degrees):
        distribution = chi2(degrees) if is_central else ncx2(degrees, noncentrality)
        cumulative = distribution.cdf(statistic)
    else:
        central = f_distribution(degrees, error_degrees)
        distribution = (
            central if is_central else ncf(degrees, error_degrees, noncentrality)
        )
        cumulative = distribution.cdf(statistic / degrees)  # one of F
    # scipy returns NaN for a noncentrality that is too large: P is then about 0.
    return float(np.nan_to_num(cumulative))
