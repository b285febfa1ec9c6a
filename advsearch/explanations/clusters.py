"""Failures that look alike to a model: clusters in the numbers that it decides by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from advsearch.explanations.libraries import import_library

MOST, FEWEST = 6, 8
"""Clusters at most, and failures of which clusters are sought at least."""

REFERENCES = 19
"""Draws of as many points from one normal distribution like them: groups in none of these may be as far apart."""

DIMENSIONS = 8
"""Principal components that distances are measured in."""


@dataclass(frozen=True)
class Clusters:
    """Groups of failures.

    Attributes:
        members: of each group the failures by number, the most typical first; the largest group first.
        silhouette: mean of it, in -1 to 1; None where all are one group.
        apart: whether groups of a cloud without any are less apart.
    """

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
