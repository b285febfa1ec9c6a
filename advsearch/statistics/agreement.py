"""Agreement of two measurements of the same rows, which are clustered in units.

A unit may be a frame with several objects, which are its rows. Units are independent;
the rows of a unit are not. Rates, kappa and the rank correlation are computed from all
rows. Intervals of kappa and of the correlation are computed by leaving out one unit at
a time (jackknife, Efron and Stein 1981, "The jackknife estimate of variance"), on the
scale of Fisher's z, with a quantile of Student's t.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import betaincinv, stdtrit
from scipy.stats import rankdata

from advsearch.errors import InputError
from advsearch.statistics.clustered import sum_per_unit
from advsearch.statistics.intervals import CONFIDENCE, clopper_pearson

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MIN_UNITS = 5
"""Smallest number of units for an interval of kappa, of a correlation or of a
conditional rate. Each of the two events has to happen in as many units.
"""
# Larger correlations are clipped, as Fisher's z of 1 is infinite.
MAX_CORRELATION = 0.9999


def compute_kappa(first: npt.ArrayLike, second: npt.ArrayLike) -> float:
    """Compute Cohen's kappa of two outcomes: how much they agree beyond chance.

    It is (p - e) / (1 - e), where p is the rate at which they agree, and e is the rate
    at which independent outcomes with the same frequencies would agree (Cohen 1960, "A
    coefficient of agreement for nominal scales").

    Args:
        first, second: (n,) bool, whether each outcome happens in each row.

    Returns:
        Kappa, 1 for full agreement and 0 for agreement by chance; NaN if both outcomes
        are constant and equal, or there are no rows.
    """
    first = np.asarray(first, dtype=bool)
    second = np.asarray(second, dtype=bool)
    if not len(first):
        return math.nan
    first_rate = float(first.mean())
    second_rate = float(second.mean())
    expected = first_rate * second_rate + (1.0 - first_rate) * (1.0 - second_rate)
    if expected >= 1.0:
        return math.nan
    agreement = float((first == second).mean())
    return (agreement - expected) / (1.0 - expected)


def compute_rank_correlation(first: npt.ArrayLike, second: npt.ArrayLike) -> float:
    """Compute Spearman's rank correlation of two measurements.

    It is the correlation of their ranks; equal values get the mean of their ranks
    (Spearman 1904, "The proof and measurement of association between two things").

    Args:
        first, second: (n,) measurements of the same rows.

    Returns:
        The coefficient in [-1, 1]; NaN with fewer than three rows, or if one of the
        measurements is constant.
    """
    first_rank = rankdata(first)
    second_rank = rankdata(second)
    if len(first_rank) < 3:
        return math.nan
    is_constant = not np.ptp(first_rank) or not np.ptp(second_rank)
    if is_constant:
        return math.nan
    return float(np.corrcoef(first_rank, second_rank)[0, 1])


def correlation_interval(
    statistic: Callable[[Any, Any], float],
    first: npt.ArrayLike,
    second: npt.ArrayLike,
    units: IntArray,
) -> tuple[float, float] | None:
    """Return the 95 % interval of a coefficient of two measurements of the same rows.

    Rows are grouped in units, such as the drives that frames come from. Rows of one
    unit may depend on each other, but units are independent. The variance comes from
    the jackknife: the coefficient is computed again without each unit. Its values are
    transformed by Fisher's z = atanh(r) first, which makes them nearly normal.

    Args:
        statistic: function that computes the coefficient, in [-1, 1], from both
            measurements: `compute_kappa` or `compute_rank_correlation`.
        first, second: (n,) measurements.
        units: (n,) unit of each row.

    Returns:
        Lower and upper bound; None with fewer than `MIN_UNITS` units, or if the
        coefficient is not defined without one of them.
    """
    first = np.asarray(first)
    second = np.asarray(second)
    names, unit_index = np.unique(units, return_inverse=True)
    n_units = len(names)
    if n_units < MIN_UNITS:
        return None
    # the coefficient without the rows of one unit, for each unit
    values_without_unit = np.empty(n_units)
    for unit in range(n_units):
        is_other = unit_index != unit
        values_without_unit[unit] = statistic(first[is_other], second[is_other])
    value = statistic(first, second)
    if not math.isfinite(value) or not np.isfinite(values_without_unit).all():
        return None
    return _compute_fisher_interval(value, values_without_unit)


def _compute_fisher_interval(
    value: float, values_without_unit: FloatArray
) -> tuple[float, float]:
    """Return the 95 % interval of a coefficient by the jackknife of Fisher's z.

    Args:
        value: the coefficient of all rows.
        values_without_unit: (m,) the coefficient without the rows of each unit.
    """
    half_width = _compute_jackknife_half_width(_to_fisher_z(values_without_unit))
    center = float(_to_fisher_z(np.array(value)))
    # tanh turns Fisher's z into a coefficient again
    return math.tanh(center - half_width), math.tanh(center + half_width)


def _compute_jackknife_half_width(z: npt.NDArray[np.float64]) -> float:
    """Return half the width of the interval of a nearly normal value.

    Args:
        z: (m,) the value without each of m units.
    """
    n_units = len(z)
    # variance by the jackknife (Efron and Stein 1981)
    variance = (n_units - 1) / n_units * float(((z - z.mean()) ** 2).sum())
    probability = (1.0 + CONFIDENCE) / 2.0  # 0.975 lies below the upper bound
    return float(stdtrit(n_units - 1, probability)) * math.sqrt(variance)


def _to_fisher_z(values: FloatArray) -> FloatArray:
    """Return atanh of coefficients, which are cut at `MAX_CORRELATION`."""
    z: FloatArray = np.arctanh(np.clip(values, -MAX_CORRELATION, MAX_CORRELATION))
    return z


def count_units(happens: npt.ArrayLike, units: IntArray) -> int:
    """Return the number of units in which an event (n,) happens in some row."""
    return len(np.unique(np.asarray(units)[np.asarray(happens, dtype=bool)]))


def estimate_rate(
    happens: npt.ArrayLike, units: IntArray
) -> tuple[float, tuple[float, float]]:
    """Return the rate of an event over all rows, and its 95 % interval over units.

    Rows of one unit may depend on each other, but units are independent. First the
    effective number of rows is computed: this many independent rows would give the rate
    the same variance. Then the interval is Clopper and Pearson's for that number (Korn
    and Graubard 1998, "Confidence intervals for proportions with small expected number
    of positive counts estimated from survey data"). If the event happens in all rows or
    in none, there is no variance, and each unit counts as one row.

    Args:
        happens: (n,) bool, whether the event happens in each row; n > 0.
        units: (n,) unit of each row, such as the drive of a frame.

    Raises:
        InputError: there are no rows.
    """
    n_rows = len(units)
    if not n_rows:
        raise InputError("rate: expected at least one row, got none")
    event = np.asarray(happens, dtype=bool)
    rate = float(event.mean())
    n_units = len(np.unique(units))
    if n_units == n_rows:
        return rate, clopper_pearson(int(event.sum()), n_rows)
    variance = _compute_rate_variance(event - rate, units)
    n_effective = float(n_units)
    if variance > 0.0 and n_units > 1:
        n_effective = _count_effective_rows(rate, variance, n_rows, n_units)
    return rate, _make_beta_interval(rate * n_effective, n_effective)


def _compute_rate_variance(residuals: npt.ArrayLike, units: IntArray) -> float:
    """Return the variance of a rate over rows that are grouped in units.

    The sums of residuals over units are independent, so their squares add up to the
    variance of the rate.

    Args:
        residuals: (n,) 1 minus the rate for rows in which the event happens, else 0
            minus the rate.
        units: (n,) unit of each row.
    """
    n_rows = len(units)
    n_units = len(np.unique(units))
    unit_residual = sum_per_unit(residuals, units)
    variance = float((unit_residual**2).sum()) / n_rows**2
    # m / (m - 1) corrects for the estimated mean of m units
    variance *= n_units / max(n_units - 1, 1)
    return variance


def _count_effective_rows(
    rate: float, variance: float, n_rows: int, n_units: int
) -> float:
    """Return how many independent rows would give a rate the same variance.

    The rate of n independent rows has the variance rate (1 - rate) / n, which is solved
    for n. The squared ratio of Student's quantiles makes n smaller, since the variance
    is estimated from few units (Korn and Graubard 1998).

    Args:
        rate: rate of the event over all rows.
        variance: variance of this rate, estimated over units.
        n_rows: number of rows, which is also the maximum of the result.
        n_units: number of units.
    """
    probability = (1.0 + CONFIDENCE) / 2.0  # 0.975 lies below the upper bound
    quantile_ratio = float(
        stdtrit(n_rows - 1, probability) / stdtrit(n_units - 1, probability)
    )
    n_effective = rate * (1.0 - rate) / variance * quantile_ratio**2
    return min(n_effective, float(n_rows))


def _make_beta_interval(successes: float, trials: float) -> tuple[float, float]:
    """Return Clopper and Pearson's 95 % interval of a success rate.

    Unlike in `clopper_pearson`, successes and trials need not be integers. The bounds
    are quantiles of beta distributions.
    """
    tail = (1.0 - CONFIDENCE) / 2.0
    failures = trials - successes
    low = 0.0
    if successes > 0.0:
        low = float(betaincinv(successes, failures + 1.0, tail))
    high = 1.0
    if failures > 0.0:
        high = float(betaincinv(successes + 1.0, failures, 1.0 - tail))
    return low, high
