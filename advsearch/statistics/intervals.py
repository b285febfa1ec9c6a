"""Confidence intervals of a rate of independent trials."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import betaincinv, ndtri

from advsearch.errors import InputError

CONFIDENCE = 0.95  # confidence of every interval that is printed


def clopper_pearson(
    successes: int, trials: int, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Return the exact two-sided binomial interval of a success rate.

    It covers the true rate with at least the stated confidence, for any number of
    trials (Clopper and Pearson 1934). Let there be k successes in n trials, and a = 1 -
    confidence. At the lower bound, k successes or more have the probability a/2; at the
    upper bound, k or fewer have it. Both are quantiles of beta distributions: B(a/2; k,
    n - k + 1), or 0 for k = 0, and B(1 - a/2; k + 1, n - k), or 1 for k = n.

    Args:
        successes: k, from 0 to n.
        trials: n, at least 1.
        confidence: between 0 and 1.

    Raises:
        InputError: an argument is out of range.
    """
    _check_binomial_counts(successes, trials, confidence)
    tail = (1.0 - confidence) / 2.0
    failures = trials - successes
    low = 0.0
    if successes:
        low = float(betaincinv(successes, failures + 1, tail))
    high = 1.0
    if failures:
        high = float(betaincinv(successes + 1, failures, 1.0 - tail))
    return low, high


def _check_binomial_counts(successes: int, trials: int, confidence: float) -> None:
    """Check counts of trials and a confidence.

    Raises:
        InputError: one is out of range.
    """
    if trials < 1:
        raise InputError(f"trials: expected at least 1, got {trials}")
    if not 0 <= successes <= trials:
        raise InputError(
            f"successes: expected a number from 0 to {trials}, got {successes}"
        )
    if not 0.0 < confidence < 1.0:
        raise InputError(
            f"confidence: expected a number between 0 and 1, got {confidence}"
        )


def wilson_interval(rate: Any, n: Any) -> tuple[Any, Any]:
    """Return Wilson's 95 % score interval (1927) of rates of n trials.

    Args:
        rate: fraction of successes, a number or an array.
        n: number of trials, a number or an array of the same shape.

    Returns:
        The lower and the upper bound, in the shape of `rate`.
    """
    # The normal distribution has 2.5 % above 1.96.
    z = float(ndtri(0.5 + CONFIDENCE / 2.0))
    center = rate + z * z / (2 * n)
    half_width = z * np.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    return (center - half_width) / scale, (center + half_width) / scale
