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

    Of k successes, from 0 to n, in n trials, at least 1, with a = 1 - confidence in (0,
    1): low solves P(X >= k | low) = a/2 and high P(X <= k | high) = a/2, quantiles of
    beta distributions: B(a/2; k, n - k + 1), exactly 0 for k = 0, and B(1 - a/2; k + 1,
    n - k), exactly 1 for k = n. The interval covers the true rate at least as often as
    it says, at every n (Clopper and Pearson 1934).

    Raises:
        InputError: an argument is out of range.
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
    tail = (1.0 - confidence) / 2.0
    failures = trials - successes
    low = 0.0
    if successes:
        low = float(betaincinv(successes, failures + 1, tail))
    high = 1.0
    if failures:
        high = float(betaincinv(successes + 1, failures, 1.0 - tail))
    return low, high


def wilson_interval(rate: Any, n: Any) -> tuple[Any, Any]:
    """Return Wilson's 95 % score interval (1927) of rates of n trials.

    Both are numbers or arrays, and so are the lower and upper bounds.
    """
    # quantile of the normal distribution, one side of the interval
    z = float(ndtri(0.5 + CONFIDENCE / 2.0))
    center = rate + z * z / (2 * n)
    half_width = z * np.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    return (center - half_width) / scale, (center + half_width) / scale
