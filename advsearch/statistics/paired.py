"""Compare two rates over the same trials."""

from __future__ import annotations

import math

from scipy.special import bdtr

from advsearch.errors import InputError
from advsearch.statistics.intervals import wilson_interval


def paired_difference(
    both: int, first: int, second: int, neither: int
) -> tuple[float, tuple[float, float]]:
    """Return how much more often the second of two paired outcomes happens.

    The interval comes from the Wilson intervals of both rates and their correlation
    (Newcombe 1998, "Improved confidence intervals for the difference between binomial
    proportions based on paired data", method 10).

    Args:
        both, first, second, neither: counts of pairs in which both happen, the first
            alone, the second alone, or neither.

    Returns:
        The difference of the rates, and its 95 % interval.
    """
    n = both + first + second + neither
    if n < 1 or min(both, first, second, neither) < 0:
        raise InputError(
            f"pairs: expected at least one, got {both}, {first}, {second} and {neither}"
        )
    second_rate = (both + second) / n
    first_rate = (both + first) / n
    second_low, second_high = map(float, wilson_interval(second_rate, n))
    first_low, first_high = map(float, wilson_interval(first_rate, n))
    correlation = _phi_coefficient(both, first, second, neither)
    difference = second_rate - first_rate
    # the difference is smallest where the second rate is low and the first high
    below = _combine_distances(
        second_rate - second_low, first_high - first_rate, correlation
    )
    above = _combine_distances(
        second_high - second_rate, first_rate - first_low, correlation
    )
    return difference, (max(-1.0, difference - below), min(1.0, difference + above))


def _combine_distances(
    second_distance: float, first_distance: float, correlation: float
) -> float:
    """Return the distance from a difference of rates to one of its bounds.

    The distances from both rates to their bounds add up as standard deviations of
    correlated variables do.
    """
    squared = (
        second_distance * second_distance
        - 2 * correlation * second_distance * first_distance
        + first_distance * first_distance
    )
    return math.sqrt(max(0.0, squared))  # not below 0 by rounding


def _phi_coefficient(both: int, first: int, second: int, neither: int) -> float:
    """Return the correlation of two outcomes, with Newcombe's continuity correction.

    Args:
        both, first, second, neither: numbers of pairs in which both outcomes happen,
            only the first, only the second, or neither.
    """
    product = (both + first) * (second + neither) * (both + second) * (first + neither)
    if not product:  # an outcome that happens always or never
        return 0.0
    # n^2 times the covariance; a positive one is made smaller by the correction
    covariance = float(both * neither - first * second)
    if covariance > 0.0:
        n = both + first + second + neither
        covariance = max(covariance - n / 2.0, 0.0)
    return covariance / math.sqrt(product)


def mcnemar(first: int, second: int) -> float:
    """Return the p-value of McNemar's exact two-sided test of two paired outcomes.

    The null hypothesis is that neither outcome happens more often. Then the pairs in
    which only one of them happens are tosses of a fair coin. The p-value, in (0, 1], is
    the probability of tosses at least as uneven as these: twice the smaller tail of the
    binomial distribution (McNemar 1947, "Note on the sampling error of the difference
    between correlated proportions or percentages").

    Args:
        first: number of pairs in which only the first outcome happens.
        second: number of those in which only the second does.
    """
    if min(first, second) < 0:
        raise InputError(f"pairs: expected numbers from 0, got {first} and {second}")
    n_discordant = first + second
    if not n_discordant:
        return 1.0
    return min(1.0, 2.0 * float(bdtr(min(first, second), n_discordant, 0.5)))
