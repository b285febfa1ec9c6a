"""Groups of failures by features that are made up here."""

from __future__ import annotations

import numpy as np
import pytest

from advsearch.explanations.clusters import find_clusters


@pytest.mark.parametrize("kinds", [2, 3])
def test_planted_kinds_are_told_with_the_most_typical_first(kinds: int) -> None:
    generator = np.random.default_rng(kinds)
    centres, sizes = generator.standard_normal((kinds, 40)), [20, 12, 9][:kinds]
    truth = np.repeat(np.arange(kinds), sizes)
    noise = 0.35 * generator.standard_normal((len(truth), 40))
    noise[np.cumsum(sizes) - 1] = 0.0
    found = find_clusters(3.0 * (centres[truth] + noise), 0)
    assert found.apart and found.silhouette is not None and found.silhouette > 0.3
    assert [set(truth[list(members)]) for members in found.members] == [{k} for k in range(kinds)]
    assert [members[0] for members in found.members] == list(np.cumsum(sizes) - 1)


def test_groups_of_a_cloud_are_not_called_apart() -> None:
    told = [
        find_clusters(np.random.default_rng(seed).standard_normal((60, 30)) + 1.0, seed).apart for seed in range(10)
    ]
    assert sum(told) <= 2


def test_few_or_equal_failures_are_one_kind() -> None:
    one = find_clusters(np.ones((1, 5)), 0)
    assert one.members == ((0,),) and one.silhouette is None and not one.apart
    assert [len(members) for members in find_clusters(np.ones((30, 5)), 0).members] == [30]
    assert len(find_clusters(np.random.default_rng(0).standard_normal((7, 4)), 0).members) == 1
