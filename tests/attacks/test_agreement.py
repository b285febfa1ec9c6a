"""Kappa, rank correlation and their intervals over clusters, by published numbers, scipy and simulation."""

import math

import numpy as np
import pytest
from scipy.stats import spearmanr

from advsearch.statistics import agreement, clustered


def test_kappa_of_a_published_table() -> None:
    """Cohen's kappa of 20, 5, 10 and 15 of 50: p = .7, e = .5 (Wikipedia, "Cohen's kappa", simple example)."""
    first = np.repeat([True, True, False, False], [20, 5, 10, 15])
    second = np.repeat([True, False, True, False], [20, 5, 10, 15])
    assert agreement.compute_kappa(first, second) == pytest.approx(0.4)


def test_kappa_is_undefined_where_nothing_varies() -> None:
    assert math.isnan(agreement.compute_kappa([True, True], [True, True]))
    assert math.isnan(agreement.compute_kappa([], []))


def test_rank_correlation_is_that_of_scipy_with_ties() -> None:
    generator = np.random.default_rng(0)
    first = generator.integers(0, 5, 40)
    second = first + generator.integers(0, 4, 40)
    assert agreement.compute_rank_correlation(first, second) == pytest.approx(spearmanr(first, second).statistic)
    assert math.isnan(agreement.compute_rank_correlation([1.0, 1.0, 1.0], [1.0, 2.0, 3.0]))


def test_rate_of_one_row_a_unit_is_the_exact_interval() -> None:
    happens = np.repeat([True, False], [3, 7])
    value, interval = agreement.estimate_rate(happens, np.arange(10))
    assert value == pytest.approx(0.3)
    assert interval == pytest.approx(clustered.rate_interval(happens, np.ones(10)))


def test_too_few_units_have_no_interval() -> None:
    values = np.arange(12.0)
    units = np.arange(12) % 4
    assert agreement.correlation_interval(agreement.compute_rank_correlation, values, values, units) is None


def test_an_interval_over_rows_would_be_too_narrow() -> None:
    """Each row eight times: the interval over units stays as it is, as if each was there once."""
    generator = np.random.default_rng(1)
    first = generator.standard_normal(20)
    second = first + generator.standard_normal(20)
    single = agreement.correlation_interval(agreement.compute_rank_correlation, first, second, np.arange(20))
    rows = np.repeat(np.arange(20), 8)
    copied = agreement.correlation_interval(agreement.compute_rank_correlation, first[rows], second[rows], rows)
    assert single is not None and copied is not None
    assert copied == pytest.approx(single, abs=1e-3)


def draw_clustered_margins(generator: np.random.Generator, n_units: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return margins of photographs and twins (n,), eight of each unit, and the units; units and rows have effects."""
    shared = 0.7 * generator.standard_normal((n_units, 1)) + generator.standard_normal((n_units, 8))
    photo = 1.0 + shared + 0.4 * generator.standard_normal((n_units, 1)) + 0.8 * generator.standard_normal((n_units, 8))
    twin = 0.5 + shared + 0.4 * generator.standard_normal((n_units, 1)) + 0.8 * generator.standard_normal((n_units, 8))
    return photo.ravel(), twin.ravel(), np.repeat(np.arange(n_units), 8)


@pytest.mark.medium
def test_intervals_cover_what_a_large_sample_has() -> None:
    """In 94 % of 300 sets of 25 clusters at least; the truth is that of 20,000 clusters."""
    photo, twin, _ = draw_clustered_margins(np.random.default_rng(0), 20_000)
    true_correlation = spearmanr(photo, twin).statistic
    true_kappa = agreement.compute_kappa(photo < 0.0, twin < 0.0)
    true_agreement = float(((photo < 0.0) == (twin < 0.0)).mean())
    generator = np.random.default_rng(1)
    n_covered = np.zeros(3)
    for _ in range(300):
        photo, twin, units = draw_clustered_margins(generator, 25)
        intervals = (
            agreement.correlation_interval(agreement.compute_rank_correlation, photo, twin, units),
            agreement.correlation_interval(agreement.compute_kappa, photo < 0.0, twin < 0.0, units),
            agreement.estimate_rate((photo < 0.0) == (twin < 0.0), units)[1],
        )
        for index, truth in enumerate((true_correlation, true_kappa, true_agreement)):
            interval = intervals[index]
            assert interval is not None
            n_covered[index] += interval[0] <= truth <= interval[1]
    assert (n_covered / 300 >= 0.94).all(), n_covered / 300
