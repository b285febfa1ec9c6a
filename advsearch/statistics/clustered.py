"""Intervals and tests of rates over clusters (units) of several rows each.

A unit may be a drive, whose frames are its rows. Units are independent; the rows of a
unit are not. All units have equal weights, however many rows each has: the rate is the
mean over units of k_u / o_u, where unit u has o_u rows and the event happens in k_u of
them. So each unit is a sample in [0, 1]. (The pooled rate, sum k_u / sum o_u, would
weight a drive by its number of frames. It has no interval without a known upper bound
of o_u.)

Intervals come from bets. Let m be the true mean. A gambler bets a fraction c of the
capital on each unit, on "more than m", and gains nothing on average. The capital starts
at 1 and becomes

    K(m, c) = prod_u (1 - c + c k_u / (o_u m))

So K exceeds 2 / a with a probability of at most a / 2 (Markov), for any distribution
and any number of units. This also holds if units have different true rates with the
mean m: by the inequality of arithmetic and geometric means, the mean of K is at most 1.
The fractions c are those of `sequential.ConfidenceSequence`.

If each unit has one row, the exact methods for independent rows are used, which are
sharper: Clopper and Pearson, Newcombe, McNemar.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.errors import InputError
from advsearch.statistics.intervals import CONFIDENCE, clopper_pearson
from advsearch.statistics.paired import mcnemar, paired_difference
from advsearch.statistics.sequential import STAKES, find_threshold, log_capital

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


def sum_per_unit(values: npt.ArrayLike, units: IntArray) -> FloatArray:
    """Return the sum of the values of each unit (a group of rows), (m,).

    Args:
        values: (n,) of each row.
        units: (n,) the unit of each row. Sums are in their ascending order.
    """
    _, unit_index = np.unique(units, return_inverse=True)
    weights = np.asarray(values, dtype=np.float64)
    # the sum of the weights with each index
    return np.bincount(unit_index.reshape(-1), weights).astype(np.float64)


def mean_rate(counted: npt.ArrayLike, rows: npt.ArrayLike) -> float:
    """Return the mean over units of the rate of an event in each unit.

    A unit is a group of rows, such as the frames of one drive. All units have equal
    weights. The result is NaN if no unit has a row.

    Args:
        counted: (n,) number of rows of each unit in which the event happens.
        rows: (n,) number of rows of each unit; units without any are left out.
    """
    n_counted = np.asarray(counted, dtype=np.float64)
    n_rows = np.asarray(rows, dtype=np.float64)
    n_counted = n_counted[n_rows > 0.0]
    n_rows = n_rows[n_rows > 0.0]
    if not len(n_rows):
        return math.nan
    has_equal_units = n_rows.min() == n_rows.max()
    if has_equal_units:  # the same mean, with less rounding
        return float(n_counted.sum() / n_rows.sum())
    return float((n_counted / n_rows).mean())


def rate_interval(
    counted: npt.ArrayLike, rows: npt.ArrayLike, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Return the confidence interval of the mean rate over units (`mean_rate`).

    It is valid for any number of units. If each unit has a single row, it is Clopper
    and Pearson's; otherwise it comes from bets on the rates of the units.

    Args:
        counted: (n,) number of rows of each unit in which the event happens.
        rows: (n,) number of rows of each unit; at least one has rows.
        confidence: between 0 and 1.

    Raises:
        InputError: counts are out of range.
    """
    n_counted = np.asarray(counted, dtype=np.float64)
    n_rows = np.asarray(rows, dtype=np.float64)
    _check_unit_counts(n_counted, n_rows)
    are_rows_independent = n_rows.max() == 1.0
    if are_rows_independent:
        return clopper_pearson(round(n_counted.sum()), round(n_rows.sum()), confidence)
    is_used = n_rows > 0.0
    return _betting_interval(n_counted[is_used] / n_rows[is_used], confidence)


def _check_unit_counts(n_counted: FloatArray, n_rows: FloatArray) -> None:
    """Check the counts of units.

    Args:
        n_counted: number of rows of each unit in which an event happens.
        n_rows: number of rows of each unit.

    Raises:
        InputError: a count is out of range, or no unit has rows.
    """
    has_rows = n_counted.shape == n_rows.shape and n_rows.size and n_rows.max() > 0
    if not has_rows or (n_counted < 0).any() or (n_counted > n_rows).any():
        raise InputError(
            "share: expected counts from 0 to the predictions of each unit, and one "
            "prediction at least"
        )


def _betting_interval(samples: FloatArray, confidence: float) -> tuple[float, float]:
    """Return the interval of the mean of independent samples in [0, 1], by betting.

    For each candidate mean, a gambler bets that the true mean is larger, and another
    that it is smaller. If the candidate is the true mean, neither gains on average. So
    a candidate is excluded if one of them has gained too much (Waudby-Smith and Ramdas
    2024, "Estimating means of bounded random variables by betting").

    Args:
        samples: (n,) samples.
        confidence: between 0 and 1.
    """
    values, counts = np.unique(samples, return_counts=True)
    # Each gambler starts with the capital 1. By Markov's inequality the probability
    # that chance turns it into 2 / (1 - confidence) is at most (1 - confidence) / 2,
    # and at most 1 - confidence for the two together.
    winning_log_capital = np.log(2.0 / (1.0 - confidence))

    def is_not_too_small(mean: float) -> bool:
        """Return whether bets on "more than the mean" have not won."""
        return bool(log_capital(mean, values, counts) < winning_log_capital)

    def is_too_large(mean: float) -> bool:
        """Return whether bets on "less than the mean" have won."""
        return bool(
            log_capital(1.0 - mean, 1.0 - values, counts) >= winning_log_capital
        )

    # Both are false for small means and true for large ones. `find_threshold` returns
    # where they become true: the lower and the upper bound of the interval.
    lower = find_threshold(is_not_too_small)
    upper = find_threshold(is_too_large)
    return lower, upper


def mean_interval(
    values: npt.ArrayLike, low: float, high: float
) -> tuple[float, float]:
    """Return the 95 % interval of the mean of independent values (n,) in a range.

    Args:
        values: (n,) values in the range.
        low, high: bounds of the range. They must be known before the values are
            sampled. So do not use the smallest and the largest value.
    """
    samples = np.asarray(values, dtype=np.float64)
    if high <= low:
        return low, low
    scaled = np.clip((samples - low) / (high - low), 0.0, 1.0)
    lower, upper = _betting_interval(scaled, CONFIDENCE)
    return low + (high - low) * lower, low + (high - low) * upper


def max_lower_bound(n_units: int) -> float:
    """Return the lower bound of the 95 % interval of a rate if all units are right.

    It is the largest that this number of units can show.
    """
    return _betting_interval(np.ones(n_units), CONFIDENCE)[0]


def compare_paired(
    first: Any, second: Any, units: IntArray
) -> tuple[float, tuple[float, float], float]:
    """Compare two outcomes of the same rows, which are clustered in units.

    All units have equal weights (`mean_rate`). If each unit has a single row, the
    interval of Newcombe and the exact test of McNemar are used, otherwise bets.

    Args:
        first, second: (n,) bool, whether each outcome happens.
        units: (n,) unit of each row.

    Returns:
        The rate of the second outcome minus that of the first; the 95 % interval of
        this difference; and the p-value, in (0, 1], of the hypothesis that neither
        happens more often. If the p-value is at most 0.05, the interval excludes 0.
    """
    first = np.asarray(first, dtype=bool)
    second = np.asarray(second, dtype=bool)
    n_rows = len(first)
    if len(np.unique(units)) == n_rows:
        return _compare_independent_rows(first, second)
    unit_rows = sum_per_unit(np.ones(n_rows), units)
    advantage = _compute_advantage(first, second)
    unit_advantage = sum_per_unit(advantage, units) / unit_rows
    lower, upper = _betting_interval(unit_advantage, CONFIDENCE)
    # the mean advantage a in [0, 1] is a difference 2 a - 1 of rates
    interval = (2 * lower - 1, 2 * upper - 1)
    second_rate = mean_rate(sum_per_unit(second, units), unit_rows)
    first_rate = mean_rate(sum_per_unit(first, units), unit_rows)
    return second_rate - first_rate, interval, _paired_p_value(unit_advantage)


def _compute_advantage(first: Any, second: Any) -> FloatArray:
    """Return the advantage of the second outcome in each row, in [0, 1] for bets.

    It is 0 if only the first outcome happens, 1 if only the second does, and 1/2
    otherwise.

    Args:
        first, second: (n,) bool, whether each outcome happens.
    """
    advantage: FloatArray = (1.0 + second - 1.0 * first) / 2.0
    return advantage


def _paired_p_value(unit_advantage: FloatArray) -> float:
    """Return the p-value of the hypothesis that two outcomes happen equally often.

    It comes from bets that the mean advantage is over 1/2, and that it is under 1/2.

    Args:
        unit_advantage: (m,) advantage of the second outcome in each unit, in [0, 1];
            1/2 means that both happen equally often there.

    Returns:
        The two-sided p-value, in (0, 1].
    """
    counts = np.ones(len(unit_advantage))  # each value counts once
    # bets that the second outcome happens more often, and that the first does
    max_log_capital = max(
        log_capital(0.5, unit_advantage, counts),
        log_capital(0.5, 1.0 - unit_advantage, counts),
    )
    # By Markov's inequality one over the capital is a p-value. It is doubled, since the
    # better one of two bets was chosen.
    return float(min(1.0, 2.0 * np.exp(-max_log_capital)))


def _compare_independent_rows(
    first: npt.NDArray[np.bool_], second: npt.NDArray[np.bool_]
) -> tuple[float, tuple[float, float], float]:
    """Compare two outcomes of independent rows by Newcombe's interval and McNemar's
    test.

    Args:
        first, second: (n,) bool, whether each outcome happens.

    Returns:
        The rate of the second outcome minus that of the first, its 95 % interval, and
        the p-value of the hypothesis that neither happens more often.
    """
    n_both = int((first & second).sum())
    n_first = int((first & ~second).sum())
    n_second = int((~first & second).sum())
    n_neither = len(first) - (n_both + n_first + n_second)
    difference, interval = paired_difference(n_both, n_first, n_second, n_neither)
    return difference, interval, mcnemar(n_first, n_second)


# Rates of right predictions under the null hypothesis, which is that the rate is the
# same inside and outside of a rule. Bets are computed for each of them.
NULL_RATES = np.linspace(0.0, 1.0, 402)[1:-1]
# number of permutations of a permutation test; no p-value is below 0.0001
N_PERMUTATIONS = 9_999


def one_sided_p_value(
    n_right_inside: npt.ArrayLike,
    n_inside: npt.ArrayLike,
    n_right_outside: npt.ArrayLike,
    n_outside: npt.ArrayLike,
    copies: float = 1.0,
) -> float:
    """Return the one-sided p-value of fewer right predictions inside a rule.

    A rule is a condition on the scene, such as "distance > 10"; predictions for scenes
    that fulfil it are inside. They are grouped in units, such as the frames of a drive,
    which are independent of each other and have equal weights. The null hypothesis is
    that the rate of right predictions is the same inside and outside. The test is

    - Fisher's exact test if each unit has a single prediction;
    - a permutation test of units if all units have equally many predictions and each
      unit lies either inside or outside;
    - a bound by bets (`_betting_p_value`) otherwise.

    Args:
        n_right_inside: (n,) right predictions of each unit inside.
        n_inside: (n,) predictions of each unit inside.
        n_right_outside: (n,) right predictions of each unit outside.
        n_outside: (n,) predictions of each unit outside.
        copies: number by which all units are multiplied, to predict the p-value of a
            larger sample; it need not be an integer.
    """
    right_inside = np.asarray(n_right_inside, dtype=np.float64)
    rows_inside = np.asarray(n_inside, dtype=np.float64)
    right_outside = np.asarray(n_right_outside, dtype=np.float64)
    rows_outside = np.asarray(n_outside, dtype=np.float64)
    if not rows_inside.any() or not rows_outside.any():
        return 1.0
    unit_rows = rows_inside + rows_outside
    if unit_rows.max() == 1.0:
        counts = (right_inside, rows_inside, right_outside, rows_outside)
        totals = [round(copies * float(count.sum())) for count in counts]
        return _fisher_p_value(*totals)
    return _clustered_p_value(
        right_inside, rows_inside, right_outside, rows_outside, copies
    )


def _clustered_p_value(
    right_inside: npt.NDArray[np.float64],
    rows_inside: npt.NDArray[np.float64],
    right_outside: npt.NDArray[np.float64],
    rows_outside: npt.NDArray[np.float64],
    copies: float,
) -> float:
    """Return the p-value of `one_sided_p_value` if units have several predictions.

    Args:
        right_inside: (n,) right predictions of each unit inside.
        rows_inside: (n,) predictions of each unit inside.
        right_outside: (n,) right predictions of each unit outside.
        rows_outside: (n,) predictions of each unit outside.
        copies: number by which all units are multiplied.
    """
    # By unit. A unit that has predictions on both sides is cut by the rule.
    has_inside = rows_inside > 0.0
    has_outside = rows_outside > 0.0
    is_cut = bool((has_inside & has_outside).any())
    are_equally_large = len(np.unique(rows_inside + rows_outside)) == 1
    if not is_cut and are_equally_large:
        return _permutation_p_value(
            right_inside + right_outside,
            # units are sampled, so their number has to be an integer
            n_inside=round(copies * float(has_inside.sum())),
            n_right_inside=copies * float(right_inside.sum()),
            times=copies,
        )
    rates = _compute_bet_rates(right_inside, rows_inside, right_outside, rows_outside)
    return _betting_p_value(rates, is_cut=is_cut, times=copies)


def _compute_bet_rates(
    right_inside: FloatArray,
    rows_inside: FloatArray,
    right_outside: FloatArray,
    rows_outside: FloatArray,
) -> FloatArray:
    """Return the rates (n, 4) of units that `_betting_p_value` takes.

    The bets are on wrong predictions inside, and on right ones outside.

    Args:
        right_inside: (n,) right predictions of each unit inside.
        rows_inside: (n,) predictions of each unit inside.
        right_outside: (n,) right predictions of each unit outside.
        rows_outside: (n,) predictions of each unit outside.
    """
    wrong_rate_inside = _divide_or_zero(rows_inside - right_inside, rows_inside)
    right_rate_outside = _divide_or_zero(right_outside, rows_outside)
    has_inside = rows_inside > 0.0
    has_outside = rows_outside > 0.0
    rates = np.stack(
        [wrong_rate_inside, has_inside, right_rate_outside, has_outside], axis=1
    )
    return rates


def _divide_or_zero(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Return quotients (n,), 0 where the denominator is 0."""
    quotient: FloatArray = np.divide(
        numerator,
        denominator,
        out=np.zeros_like(denominator),
        where=denominator > 0.0,
    )
    return quotient


def _fisher_p_value(
    right_inside: int, inside: int, right_outside: int, outside: int
) -> float:
    """Return the one-sided p-value of Fisher's exact test.

    It is the probability that at most `right_inside` right predictions are inside, if
    chance decides which of all predictions are inside.

    Args:
        right_inside: number of right predictions inside.
        inside: number of all predictions inside.
        right_outside: number of right predictions outside.
        outside: number of all predictions outside.
    """
    # The import takes half a second, and a search does not need it.
    from scipy.stats import hypergeom

    n_predictions = inside + outside
    n_right = right_inside + right_outside
    return float(hypergeom.cdf(right_inside, n_predictions, n_right, inside))


def _permutation_p_value(
    unit_right: FloatArray, *, n_inside: int, n_right_inside: float, times: float
) -> float:
    """Return the one-sided p-value of a permutation test over units of equal size.

    A permutation chooses by chance which units are inside. The p-value is the fraction
    of permutations with at most `n_right_inside` right predictions inside. Units with
    equally many right predictions are interchangeable, so that only the number of units
    of each kind is sampled.

    Args:
        unit_right: (n,) number of right predictions of each unit.
        n_inside: number of units inside, copies included.
        n_right_inside: number of right predictions in these units.
        times: number of copies of each unit.
    """
    values, n_units = np.unique(unit_right, return_counts=True)
    n_units = np.round(times * n_units).astype(np.int64)
    # `n_inside` and the number of all units are rounded separately
    n_sampled = min(n_inside, int(n_units.sum()))
    rng = np.random.default_rng(0)
    # (permutations, values): how many units with each value come inside
    sampled_units = rng.multivariate_hypergeometric(
        n_units, n_sampled, N_PERMUTATIONS, method="marginals"
    )
    is_as_few = sampled_units @ values <= n_right_inside + 1e-9  # 1e-9 for rounding
    # what was observed counts as one of the permutations
    return float((1 + is_as_few.sum()) / (1 + N_PERMUTATIONS))


def _betting_p_value(rates: FloatArray, *, is_cut: bool, times: float) -> float:
    """Return an upper bound of the p-value of fewer right predictions inside.

    The null hypothesis is that the rate of right predictions is some m both inside and
    outside. For each m (`NULL_RATES`) a gambler bets on "less than m inside, more than
    m outside". By Markov's inequality one over the final capital bounds the p-value.
    The true m is unknown, so the smallest capital over all m is used. The bound also
    holds if units have different rates.

    Args:
        rates: (n, 4) with columns for each unit: the rate of wrong predictions inside;
            1 if the unit has any predictions inside, else 0; the rate of right ones
            outside; 1 if it has any outside, else 0.
        is_cut: whether some unit has predictions both inside and outside. Then half of
            the stake is put on each side, since a unit can lose the stakes of both.
        times: number of copies of each unit.
    """
    # units with equal rates are counted, and computed once
    distinct_rates, n_units = np.unique(rates, axis=0, return_counts=True)
    gains = _compute_gains(distinct_rates)
    stake_fraction = 0.5 if is_cut else 1.0
    gains = stake_fraction * gains
    log_capitals = _compute_log_capitals(gains, n_units, times)
    # (m,) the capital is the mean over stakes
    log_capital_of_rate = np.logaddexp.reduce(log_capitals, axis=0)
    log_capital_of_rate = log_capital_of_rate - np.log(len(STAKES))
    smallest_log_capital = log_capital_of_rate.min()
    return float(min(1.0, np.exp(-smallest_log_capital)))


def _compute_log_capitals(
    gains: FloatArray, n_units: npt.NDArray[np.intp], times: float
) -> list[FloatArray]:
    """Return the logarithm of the final capital (m,) of bets with each of `STAKES`.

    Args:
        gains: (k, m) gain of k kinds of units, for each of m null hypotheses.
        n_units: (k,) number of units of each kind.
        times: number of copies of each unit.
    """
    log_capitals = []
    with np.errstate(divide="ignore"):  # the logarithm of a lost capital is -inf
        for stake in STAKES:
            log_factors = np.log(np.maximum(1.0 + stake * gains, 0.0))
            # over all units, and `times` copies of each
            log_capitals.append(times * (n_units[:, None] * log_factors).sum(axis=0))
    return log_capitals


def _compute_gains(rates: FloatArray) -> FloatArray:
    """Return the gains of units from a stake of 1 on each side, (n, m).

    They are for each of the m `NULL_RATES`. `rates` (n, 4) is as in `_betting_p_value`.
    """
    # columns (n, 1), which broadcast with the (m,) null rates to (n, m)
    wrong_inside, has_inside, right_outside, has_outside = (
        column[:, None] for column in rates.T
    )
    # Gain of a stake of 1 on each side: what is won, minus the stake. It is 0 on
    # average if the rate of right predictions is m, and so that of wrong ones 1 - m. On
    # a side without predictions there is neither stake nor gain.
    gain_inside = wrong_inside / (1.0 - NULL_RATES) - has_inside
    # not by a `gain_outside`, as the order of the sum determines the last bits
    gains: FloatArray = gain_inside + right_outside / NULL_RATES - has_outside
    return gains
