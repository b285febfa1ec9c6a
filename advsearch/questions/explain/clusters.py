"""Failures that look alike to the model: clusters of what it decides by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from advsearch.extend import rules

MAX_CLUSTERS = 6
MIN_FAILURES = 8  # of which clusters are sought
N_REFERENCES = 19
"""Samples of as many points from one normal distribution like them: clusters in none of
these may be as far apart.
"""
N_COMPONENTS = 8  # principal components that distances are measured in

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Clusters:
    """Clusters of failures.

    Attributes:
        members: indices of the failures of each, the most typical first; the largest
            cluster first.
        silhouette: the mean; None where all are one cluster.
        are_separated: whether clusters of a cloud without any are less far apart.
    """

    members: tuple[tuple[int, ...], ...]
    silhouette: float | None
    are_separated: bool


def find_clusters(features: FloatArray, seed: int) -> Clusters:
    """Cluster failures by k-means over the directions of their features (n, F).

    The number of clusters is chosen by the mean silhouette (Rousseeuw 1987). The
    clusters count as apart if their silhouette is larger than that of each of
    `N_REFERENCES` random clouds of points, which are clustered in the same way (after
    Tibshirani, Walther and Hastie 2001). Fewer failures than `MIN_FAILURES` are a
    single cluster.

    Args:
        features: (n, F) features of the model for each failure.
        seed: seed of the random clouds.

    Raises:
        InputError: scikit-learn is missing.
    """
    lengths = np.linalg.norm(features, axis=1, keepdims=True)
    directions = features / np.maximum(lengths, 1e-12)  # not divided by 0
    if len(directions) < MIN_FAILURES:
        all_failures = tuple(range(len(directions)))
        return Clusters((all_failures,), silhouette=None, are_separated=False)
    decomposition = rules.import_library("sklearn.decomposition")
    n_components = min(N_COMPONENTS, *directions.shape)
    points = decomposition.PCA(n_components, random_state=0).fit_transform(directions)

    silhouette, cluster = cluster_points(points)
    is_apart = _is_clearer_than_noise(seed, points, silhouette)

    members = [
        sort_by_distance(points, np.flatnonzero(cluster == k))
        for k in range(int(cluster.max()) + 1)
    ]
    members.sort(key=len, reverse=True)
    if len(members) < 2:
        return Clusters(tuple(members), silhouette=None, are_separated=False)
    return Clusters(tuple(members), silhouette=silhouette, are_separated=is_apart)


def _is_clearer_than_noise(seed: int, points: FloatArray, silhouette: float) -> bool:
    """Return whether points (n, d) cluster better than each of `N_REFERENCES` clouds
    without clusters: by a higher silhouette.

    A cloud has as many points, normal with the same deviation in each dimension.

    Args:
        seed: seed of the references.
        points: points that were clustered.
        silhouette: silhouette of their clusters.
    """
    generator = np.random.default_rng(seed)
    spread = points.std(axis=0)
    references = (
        generator.standard_normal(points.shape) * spread for _ in range(N_REFERENCES)
    )
    return all(cluster_points(reference)[0] < silhouette for reference in references)


def sort_by_distance(points: FloatArray, members: IntArray) -> tuple[int, ...]:
    """Return members of a cluster by rising distance from its centre."""
    distance = np.linalg.norm(points[members] - points[members].mean(axis=0), axis=1)
    return tuple(members[np.argsort(distance, kind="stable")].tolist())


def cluster_points(points: FloatArray) -> tuple[float, IntArray]:
    """Cluster points (n, d) by k-means.

    The number of clusters is the one with the largest mean silhouette.

    Returns:
        The mean silhouette, -1 if none can be computed; and the cluster of each point
        (n,).
    """
    k_means = rules.import_library("sklearn.cluster").KMeans
    compute_silhouette = rules.import_library("sklearn.metrics").silhouette_score
    best_silhouette = -1.0
    best_cluster = np.zeros(len(points), dtype=np.int64)
    # The silhouette needs fewer clusters than points, and k-means needs at least as
    # many different points as clusters. Points that differ by rounding errors alone
    # count as the same.
    n_distinct = len(np.unique(points.round(9), axis=0))
    max_clusters = min(MAX_CLUSTERS, n_distinct - 1)
    for k in range(2, max_clusters + 1):
        cluster = k_means(k, n_init=4, random_state=0).fit_predict(points)
        silhouette = float(compute_silhouette(points, cluster))
        if silhouette > best_silhouette:
            best_silhouette = silhouette
            best_cluster = cluster
    return best_silhouette, best_cluster
