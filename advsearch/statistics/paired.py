"""Comparison of two shares over the same trials."""

from __future__ import annotations

import math

from scipy.special import bdtr

from advsearch.errors import InputError
from advsearch.statistics.intervals import wilson


def paired_difference(
    both: int, first: int, second: int, neither: int
) -> tuple[float, tuple[float, float]]:
    """Return how much more often the second of two paired outcomes happens than the
    first, and its 95 % interval, from counts of pairs: both, the first alone, the
    second alone, neither. It comes from the Wilson intervals of both shares and their
    correlation (Newcombe 1998, "Improved confidence intervals for the difference
    between binomial proportions based on paired data", method 10).
    """
    n = both + first + second + neither
    if n < 1 or min(both, first, second, neither) < 0:
        raise InputError(
            f"pairs: expected at least one, got {both}, {first}, {second} and {neither}"
        )
    shares = (both + second) / n, (both + first) / n
    (low, high), (other_low, other_high) = (
        map(float, wilson(share, n)) for share in shares
    )
    spread = (both + first) * (second + neither) * (both + second) * (first + neither)
    covariance = float(both * neither - first * second)
    if covariance > 0.0:
        covariance = max(covariance - n / 2.0, 0.0)
    phi = covariance / math.sqrt(spread) if spread else 0.0
    (p, q) = shares
    down = (shares[0] - low, other_high - shares[1])
    up = high - shares[0], shares[1] - other_low
    below, above = (
        math.sqrt(max(0.0, a * a - 2 * phi * a * b + b * b)) for a, b in (down, up)
    )
    return p - q, (max(-1.0, p - q - below), min(1.0, p - q + above))


def mcnemar(first: int, second: int) -> float:
    """Return how likely it is, in (0, 1], that of pairs in which one outcome alone
    happens, chance splits so many so unevenly: the exact, two-sided test of McNemar
    (1947, "Note on the sampling error of the difference between correlated proportions
    or percentages"): twice the smaller tail of the binomial distribution, as these
    pairs are throws of a fair coin where neither happens more often.
    """
    if min(first, second) < 0:
        raise InputError(f"pairs: expected numbers from 0, got {first} and {second}")
    return (
        min(1.0, 2.0 * float(bdtr(min(first, second), first + second, 0.5)))
        if first + second
        else 1.0
    )
