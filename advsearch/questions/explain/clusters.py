"""Cluster failures by the model's features: those in a cluster look alike to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from advsearch.extend import rules

MAX_CLUSTERS = 6
MIN_FAILURES = 8  # minimum number of failures that are clustered
N_REFERENCES = 19
"""Number of random clouds without clusters, to which the clusters of failures are
compared. They have as many points, of one normal distribution.
"""
N_COMPONENTS = 8  # principal components in which distances are measured

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Clusters:
    """Clusters of failures.

    Attributes:
        members: indices of the failures in each cluster, the most typical first. The
            largest cluster comes first.
        silhouette: mean silhouette; None if there is a single cluster.
        are_separated: whether the clusters have a higher silhouette than those of
            random clouds without clusters.
    """

    members: tuple[tuple[int, ...], ...]
    silhouette: float | None
    are_separated: bool


def find_clusters(features: FloatArray, seed: int) -> Clusters:
    """Cluster failures by k-means over the directions of their features (n, F).

    The number of clusters is chosen by the mean silhouette (Rousseeuw 1987). The
    clusters count as separated if their silhouette is larger than that of each of
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
    directions = features / np.maximum(lengths, 1e-12)  # no division by 0
    if len(directions) < MIN_FAILURES:
        all_failures = tuple(range(len(directions)))
        return Clusters((all_failures,), silhouette=None, are_separated=False)
    decomposition = rules.import_library("sklearn.decomposition")
    n_components = min(N_COMPONENTS, *directions.shape)
    points = decomposition.PCA(n_components, random_state=0).fit_transform(directions)

    silhouette, cluster_of_point = cluster_points(points)
    members = _list_members(points, cluster_of_point)
    if len(members) < 2:
        return Clusters(members, silhouette=None, are_separated=False)
    are_separated = _is_clearer_than_noise(seed, points, silhouette)
    return Clusters(members, silhouette, are_separated)


def _list_members(
    points: FloatArray, cluster_of_point: IntArray
) -> tuple[tuple[int, ...], ...]:
    """Return the points of each cluster, the most central first; the largest is first.

    Args:
        points: (n, d).
        cluster_of_point: index of the cluster of each point (n,).
    """
    n_clusters = int(cluster_of_point.max()) + 1
    members = [
        sort_by_distance(points, np.flatnonzero(cluster_of_point == index))
        for index in range(n_clusters)
    ]
    members.sort(key=len, reverse=True)
    return tuple(members)


def _is_clearer_than_noise(seed: int, points: FloatArray, silhouette: float) -> bool:
    """Return whether points have a higher silhouette than random clouds of points.

    Each of `N_REFERENCES` clouds has as many points, from a normal distribution with
    the same standard deviation in each dimension.

    Args:
        seed: seed of the clouds.
        points: (n, d) points that were clustered.
        silhouette: silhouette of their clusters.
    """
    generator = np.random.default_rng(seed)
    spread = points.std(axis=0)
    references = (
        generator.standard_normal(points.shape) * spread for _ in range(N_REFERENCES)
    )
    return all(cluster_points(reference)[0] < silhouette for reference in references)


def sort_by_distance(points: FloatArray, members: IntArray) -> tuple[int, ...]:
    """Return the members of a cluster, sorted by their distance from its center.

    Args:
        points: (n, d) all points.
        members: indices of the points in the cluster.
    """
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
    # many distinct points as clusters. Points that differ only by rounding errors are
    # not distinct.
    n_distinct = len(np.unique(points.round(9), axis=0))
    max_clusters = min(MAX_CLUSTERS, n_distinct - 1)
    for k in range(2, max_clusters + 1):
        cluster = k_means(k, n_init=4, random_state=0).fit_predict(points)
        silhouette = float(compute_silhouette(points, cluster))
        if silhouette > best_silhouette:
            best_silhouette = silhouette
            best_cluster = cluster
    return best_silhouette, best_cluster
