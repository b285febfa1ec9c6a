"""Shares of wrong predictions with and without each of many parts, and what is told from chance."""

import numpy as np
import pytest
from scipy.stats import chi2_contingency

from advsearch.questions.sweep.surface import (
    N_PERMUTATIONS,
    PartCounts,
    _compare_rates,
    _compute_likelihood_ratio,
    compare_parts,
    permute_draws,
)


def test_the_interval_of_a_difference_is_newcombe_s() -> None:
    # Newcombe (1998), table II, method 10: 56/70 - 48/80 and 9/10 - 3/10
    difference, low, high = _compare_rates(np.array([56, 9]), np.array([70, 10]), np.array([48, 3]), np.array([80, 10]))
    assert difference == pytest.approx([0.2, 0.6])
    assert low == pytest.approx([0.0524, 0.1705], abs=1e-4) and high == pytest.approx([0.3339, 0.8090], abs=1e-4)


def test_the_statistic_is_that_of_the_likelihood_ratio() -> None:
    k, n = np.array([7, 0, 12]), np.array([20, 5, 12])
    found = _compute_likelihood_ratio(k, n, 15, 50)
    for one, (wrong, seen) in zip(found, zip(k, n, strict=True), strict=True):
        table = [[wrong, seen - wrong], [15 - wrong, 35 - seen + wrong]]
        expected = chi2_contingency(table, correction=False, lambda_="log-likelihood").statistic
        assert one == pytest.approx(expected)


def test_wrong_predictions_are_shared_out_to_the_last() -> None:
    counts = PartCounts(2, 9, 4, seed=1)
    for number in range(9):
        counts.add_image(np.array([0] if number % 3 else [0, 1]), number < 4)
    assert counts.visible_counts.tolist() == [9, 3] and counts.wrong_counts.tolist() == [4, 2]
    assert (counts.permuted_counts[:, 0] == 4).all() and len(counts.permuted_counts) == N_PERMUTATIONS
    assert counts.permuted_counts[:, 1].mean() == pytest.approx(4 * 3 / 9, abs=0.2)


@pytest.mark.medium
def test_nothing_is_told_where_nothing_is_but_what_is_there() -> None:
    random, told = np.random.default_rng(3), 0
    for trial in range(60):
        wrong = random.random(40) < 0.4
        counts = PartCounts(60, 40, int(wrong.sum()), seed=trial)
        angle, width = random.random(40), 0.4
        for picture, failed in zip(angle, wrong, strict=True):  # neighbours are seen together
            counts.add_image(np.flatnonzero((np.arange(60) / 60 - picture) % 1.0 < width), bool(failed))
        told += bool(compare_parts(counts, slice(0, 60), 5).significant.any())
    assert told <= 8  # 3 on average; 9 or more once in 200


def test_a_part_that_decides_is_told_and_one_that_is_always_there_is_not_compared() -> None:
    counts = PartCounts(3, 24, 12, seed=0)
    for number in range(24):
        counts.add_image(np.array([0, *([1] if number < 12 else [])]), number < 12)
    found = compare_parts(counts, slice(0, 3), 5)
    assert found.compared.tolist() == [False, True, False] and found.significant.tolist() == [False, True, False]
    assert found.difference[1] == 1.0 and found.low[1] == found.strength[1] > 0.6 and np.isnan(found.p[0])
    assert compare_parts(counts, slice(1, 2), 5).p.tolist() == [1 / (1 + N_PERMUTATIONS)]


def test_predictions_of_a_drive_are_exchanged_whole() -> None:
    wrong, draws = np.array([1, 1, 0, 0, 1, 0], np.int8), np.array([0, 1, 2, 0, 1, 2])
    packed = permute_draws(wrong, draws, seed=0)
    assert packed is not None and permute_draws(wrong, np.arange(6), seed=0) is None
    shared = np.unpackbits(packed, axis=0, count=N_PERMUTATIONS)
    order = np.argsort(draws, kind="stable").reshape(3, 2)
    drives = {tuple(one) for one in wrong[order].tolist()}
    assert all({tuple(one) for one in dealt[order].tolist()} == drives for dealt in shared), "whole drives, each once"
    assert len({tuple(one) for one in shared.tolist()}) == 6, "in all orders"


@pytest.mark.medium
def test_parts_that_some_drives_show_are_told_from_chance_by_drive() -> None:
    """Six drives of ten frames, each all wrong or all right: row by row, a part that three show would be told."""
    told = 0
    for trial in range(40):
        random = np.random.default_rng(trial)
        draws, wrong = np.repeat(np.arange(6), 10), np.repeat(random.random(6) < 0.5, 10)
        shows = np.repeat(random.random((6, 8)) < 0.5, 10, axis=0)
        exchanged = permute_draws(wrong.astype(np.int8), draws, seed=trial)
        counts = PartCounts(8, 60, int(wrong.sum()), seed=trial, permuted_failures=exchanged)
        for seen, failed in zip(shows, wrong, strict=True):
            counts.add_image(np.flatnonzero(seen), bool(failed))
        found = compare_parts(counts, slice(0, 8), 5)
        told += bool(found.significant.any())
        assert np.isnan(found.low).all() and (found.strength[found.compared] >= 0.0).all()
    assert told <= 6
