"""Rates that fall along an axis: isotonic fit, and a test of places where they rise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SIGNIFICANCE = 0.05
"""Largest fraction of falling curves for which a dip is reported by chance."""


@dataclass(frozen=True)
class Dip:
    """A distance at which an object is recognized less often than farther away.

    Attributes:
        distance: distance of the dip.
        counts: number of right images and of all images at this distance.
        until: largest of the farther distances that are compared with it.
        counts_beyond: number of right images and of all images at these distances.
        p_value: probability of such a large difference if the rate falls with the
            distance, times the number of comparisons.
    """

    distance: float
    counts: tuple[int, int]
    until: float
    counts_beyond: tuple[int, int]
    p_value: float

    @property
    def is_significant(self) -> bool:
        """Whether the dip is too clear to be explained by chance."""
        return self.p_value <= SIGNIFICANCE


def _fit_falling(
    right: NDArray[np.int64], counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Fit rates (m,) that do not rise with the distance, by isotonic regression.

    Args:
        right: (m,) number of right images at each distance, the nearest first.
        counts: (m,) number of images at each distance.
    """
    from scipy.optimize import isotonic_regression  # takes a quarter of a second

    fitted: NDArray[np.float64] = isotonic_regression(
        right / counts, weights=counts, increasing=False
    ).x
    return fitted


def find_dips(
    distances: Sequence[float], right: NDArray[np.int64], counts: NDArray[np.int64]
) -> tuple[Dip, ...]:
    """Find dips: distances at which an object is recognized less often than beyond.

    Each distance is compared with every range of distances that begins right behind it,
    by Fisher's exact one-sided test. The p-values are multiplied by the number of
    comparisons (Bonferroni). If the true rate falls with the distance, at most one
    curve in twenty has a significant dip (`benchmarks/first_seen.py --simulated`).
    Other dips are returned too, and may be chance.

    Args:
        distances: m distances in ascending order.
        right: (m,) number of images with a right prediction at each distance.
        counts: (m,) number of images at each distance.

    Returns:
        At most one dip for each distance, the nearest first.
    """
    # the last distance has none beyond
    dips = [
        _find_dip(near, distances, right, counts) for near in range(len(distances) - 1)
    ]
    return tuple(dip for dip in dips if dip is not None)


def _find_dip(
    near: int,
    distances: Sequence[float],
    right: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> Dip | None:
    """Return the clearest dip at a distance; None if no range beyond has a higher rate.

    Args:
        near: index of the distance.
        distances: m distances in ascending order.
        right: (m,) number of images with a right prediction at each distance.
        counts: (m,) number of images at each distance.
    """
    n_distances = len(distances)
    n_comparisons = n_distances * (n_distances - 1) / 2.0
    right_beyond = _sum_ranges_beyond(near, right)
    counts_beyond = _sum_ranges_beyond(near, counts)
    clearest = _find_clearest_dip(
        right[near], counts[near], right_beyond, counts_beyond
    )
    if clearest is None:
        return None
    best, p_value = clearest
    return Dip(
        distance=float(distances[near]),
        counts=(int(right[near]), int(counts[near])),
        # last distance of the range: `best` counts from the one behind `near`
        until=float(distances[near + 1 + best]),
        counts_beyond=(int(right_beyond[best]), int(counts_beyond[best])),
        p_value=min(1.0, p_value * n_comparisons),
    )


def _sum_ranges_beyond(near: int, values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the sum of values over every range that begins right behind a distance.

    Args:
        near: index of the distance.
        values: (m,) a value for each distance.

    Returns:
        (m - near - 1,) sums, by the end of the range, the nearest first.
    """
    # sums over the distances before each index
    sums_before = np.concatenate([[0], np.cumsum(values)])
    # the index after the last distance of each range
    end = np.arange(near + 2, len(values) + 1)
    sums_beyond: NDArray[np.int64] = sums_before[end] - sums_before[near + 1]
    return sums_beyond


def _find_clearest_dip(
    right: np.int64,
    count: np.int64,
    right_beyond: NDArray[np.int64],
    counts_beyond: NDArray[np.int64],
) -> tuple[int, float] | None:
    """Return the range beyond a distance with the clearest higher rate, and its p-value.

    Args:
        right: number of images with a right prediction at the distance.
        count: number of images at the distance.
        right_beyond: (k,) number of images with a right prediction in each range.
        counts_beyond: (k,) number of images in each range.

    Returns:
        The index of the range, and its p-value; None if no range has a higher rate.
    """
    p_values = _compute_p_values(right, count, right_beyond, counts_beyond)
    is_dip = right / count < right_beyond / counts_beyond
    if not is_dip.any():
        return None
    best = int(np.argmin(np.where(is_dip, p_values, np.inf)))
    return best, float(p_values[best])


def _compute_p_values(
    n_right: np.int64,
    n_images: np.int64,
    right_beyond: NDArray[np.int64],
    counts_beyond: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the p-values (r,) of as few right images here, by Fisher's exact test.

    It is the probability of as few, if chance decides which of the images here and
    beyond are right.

    Args:
        n_right: number of images with a right prediction at a distance.
        n_images: number of images there.
        right_beyond: (r,) right predictions in each of r ranges of distances beyond.
        counts_beyond: (r,) number of images in each range.
    """
    from scipy.stats import hypergeom  # takes half a second

    p_values: NDArray[np.float64] = hypergeom.cdf(
        n_right,
        counts_beyond + n_images,  # images here and beyond
        right_beyond + n_right,  # those that are right
        n_images,
    )
    return p_values
