"""Shares and tests of answers that share a draw: what is worked out by hand, and how seldom they err."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import fisher_exact

from advsearch.errors import InputError
from advsearch.statistics.clustered import (
    compare_paired,
    max_lower_bound,
    mean_interval,
    mean_rate,
    one_sided_p_value,
    rate_interval,
    sum_per_unit,
)
from advsearch.statistics.intervals import clopper_pearson
from advsearch.statistics.paired import mcnemar, paired_difference
from advsearch.statistics.sequential import ConfidenceSequence

FRAMES = 8


def drives(rng: np.random.Generator, count: int, share: float, alike: float) -> npt.NDArray[np.bool_]:
    """Answers (drives, frames), right in this share of all, those of a drive alike."""
    own = rng.beta(share * (1 - alike) / alike, (1 - share) * (1 - alike) / alike, (count, 1))
    found: npt.NDArray[np.bool_] = rng.random((count, FRAMES)) < own
    return found


def test_of_independent_predictions_the_exact_intervals_and_tests_are_taken() -> None:
    units = np.arange(20)
    first, second = units < 12, (units >= 3) & (units < 19)
    assert rate_interval(first, np.ones(20)) == clopper_pearson(12, 20)
    difference, interval, p = compare_paired(first, second, units)
    assert (difference, interval) == paired_difference(9, 3, 7, 1) and p == mcnemar(3, 7)
    under = units < 8
    exact = fisher_exact([[2, 6], [10, 2]], alternative="less").pvalue
    right = np.isin(units, [0, 1, *range(8, 18)])
    assert one_sided_p_value(right & under, under, right & ~under, ~under) == pytest.approx(exact)


def test_of_units_it_is_the_interval_by_bets_and_units_of_equal_predictions_are_draws() -> None:
    counts = [8, 8, 6, 2, 0, 8]
    sequence = ConfidenceSequence()
    for one in counts:
        sequence.add(one / 8)
    assert rate_interval(counts, np.full(6, 8)) == pytest.approx(sequence.interval)
    assert mean_interval([one / 8 for one in counts], 0.0, 1.0) == pytest.approx(sequence.interval)
    low, high = mean_interval([2.0 + one for one in counts], 2.0, 10.0)
    assert (low, high) == pytest.approx(tuple(2.0 + 8.0 * end for end in sequence.interval))
    assert rate_interval([0, 3, 0], [2, 4, 0]) == rate_interval([3, 0], [4, 2]), "a unit without answers says nothing"
    assert mean_interval([3.0, 3.0], 3.0, 3.0) == (3.0, 3.0)
    with pytest.raises(InputError, match="one prediction at least"):
        rate_interval([0, 0], [0, 0])


def test_few_units_show_little_and_more_show_more() -> None:
    shown = [max_lower_bound(n) for n in (1, 3, 5, 10, 30, 100)]
    assert shown == sorted(shown) and 0.3 < shown[2] < 0.45 and shown[-1] > 0.94


def test_copies_of_a_prediction_say_no_more_than_one() -> None:
    rng = np.random.default_rng(0)
    one, other = rng.random((2, 40)) < 0.5
    units = np.repeat(np.arange(40), 9)
    low, high = rate_interval(sum_per_unit(np.repeat(one, 9), units), np.full(40, 9))
    alone = clopper_pearson(int(one.sum()), 40)
    assert low < alone[0] and alone[1] < high
    p = compare_paired(np.repeat(one, 9), np.repeat(other, 9), units)[2]
    assert p >= mcnemar(int((one & ~other).sum()), int((~one & other).sum()))


@pytest.mark.medium
@pytest.mark.parametrize("count", [3, 5, 10, 30])
@pytest.mark.parametrize("alike", [0.3, 0.95])
def test_two_models_that_are_as_good_are_told_apart_in_5_of_100_at_most(count: int, alike: float) -> None:
    rng, told, missed = np.random.default_rng(count), 0, 0
    units = np.repeat(np.arange(count), FRAMES)
    for _ in range(150):
        first, second = (drives(rng, count, 0.8, alike).ravel() for _ in range(2))
        difference, (low, high), p = compare_paired(first, second, units)
        told, missed = told + (p <= 0.05), missed + (not low <= 0.0 <= high)
        assert (p <= 0.05) == (not low <= 0.0 <= high) and low <= difference <= high
    assert told <= 12 and missed <= 12


@pytest.mark.medium
def test_a_small_loss_in_nearly_all_drives_is_no_gain_in_the_mean() -> None:
    """One model gains a little in nine drives of ten and loses all of the tenth: signs alone would tell it apart."""
    rng, told = np.random.default_rng(1), 0
    for _ in range(200):
        lost = rng.random(12) < 0.1
        first, second = np.zeros((2, 12, 9), bool)
        first[lost], second[~lost, 0] = True, True
        told += compare_paired(first.ravel(), second.ravel(), np.repeat(np.arange(12), 9))[2] <= 0.05
    assert told <= 15


SIDES: dict[str, Callable[[np.random.Generator, int], npt.NDArray[np.bool_]]] = {
    "some drives": lambda rng, n: np.repeat(rng.random((n, 1)) < 0.4, FRAMES, axis=1),
    "some frames": lambda rng, n: np.repeat(np.arange(FRAMES)[None] < 3, n, axis=0),
    "some frames of some drives": lambda rng, n: (rng.random((n, 1)) < 0.5) & (np.arange(FRAMES) < 4),
}


def fewer(rng: np.random.Generator, side: str, count: int, less: float) -> float:
    """How likely it is by chance that drives are right as seldom on one side, where they are so much less."""
    under = SIDES[side](rng, count)
    right = np.where(under, drives(rng, count, 0.8 - less, 0.4), drives(rng, count, 0.8, 0.4))
    return one_sided_p_value(*(one.sum(axis=1) for one in (right & under, under, right & ~under, ~under)))


@pytest.mark.medium
@pytest.mark.parametrize("side", SIDES)
def test_a_rule_that_is_none_is_told_in_one_of_100_and_a_clear_one_always(side: str) -> None:
    rng = np.random.default_rng(2)
    assert sum(fewer(rng, side, count, 0.0) <= 0.01 for count in (6, 12, 40) for _ in range(100)) <= 9
    assert sum(fewer(rng, side, 60, 0.6) <= 0.01 for _ in range(20)) == 20
    assert one_sided_p_value([1, 2], [8, 8], [0, 0], [0, 0]) == 1.0, "nothing is elsewhere"


LARGE = 12  # predictions of the units that have many


def unequal(
    rng: np.random.Generator, count: int, rare: float, small: float, large: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Right predictions and predictions of units: most have one, right by a chance `small`; some have many, each right
    by a chance `large`: frames of drives in which the object is out of view in most."""
    is_large = rng.random(count) < rare
    of = np.where(is_large, LARGE, 1)
    return rng.binomial(of, np.where(is_large, large, small)), of


@pytest.mark.medium
@pytest.mark.parametrize(("rare", "small", "large"), [(0.1, 1.0, 0.0), (0.1, 0.9, 0.2), (0.5, 0.3, 0.9)])
@pytest.mark.parametrize("count", [3, 5, 10, 30])
def test_the_interval_over_units_of_unequal_size_covers_their_mean(
    count: int, rare: float, small: float, large: float
) -> None:
    """The largest unit may not be among those that were seen."""
    rng, truth = np.random.default_rng(count), (1 - rare) * small + rare * large
    covered, runs = 0, 300
    for _ in range(runs):
        counted, of = unequal(rng, count, rare, small, large)
        low, high = rate_interval(counted, of)
        covered += low <= truth <= high
        assert low <= mean_rate(counted, of) <= high
    assert covered >= 0.94 * runs


def test_all_units_weigh_the_same() -> None:
    assert mean_rate([1, 3, 0], [1, 12, 0]) == pytest.approx((1.0 + 0.25) / 2)
    units = np.repeat([0, 1], [1, 12])
    first, second = np.arange(13) < 1, np.arange(13) > 6
    difference, (low, high), p = compare_paired(first, second, units)
    assert difference == pytest.approx((0.0 - 1.0 + 0.5 - 0.0) / 2) and low < difference < high and p > 0.05
    assert compare_paired(first, second, np.zeros(13, np.int64))[2] == 1.0, "one unit shows nothing"


@pytest.mark.medium
@pytest.mark.parametrize("count", [5, 12, 30])
def test_two_models_as_good_over_units_of_unequal_size_are_told_apart_in_5_of_100_at_most(count: int) -> None:
    """One gains where much is seen, which is rare, and loses as much over all units where little is."""
    rng, told, missed, runs = np.random.default_rng(count), 0, 0, 300
    for _ in range(runs):
        is_large = rng.random(count) < 0.1
        units = np.repeat(np.arange(count), np.where(is_large, LARGE, 1))
        is_gain = is_large[units]
        second = np.where(is_gain, True, rng.random(len(units)) < 8.0 / 9.0)
        first = np.where(is_gain, False, True)
        _, (low, high), p = compare_paired(first, second, units)
        told, missed = told + (p <= 0.05), missed + (not low <= 0.0 <= high)
    assert told <= 0.06 * runs and missed <= 0.06 * runs


@pytest.mark.medium
@pytest.mark.parametrize("is_cut", [False, True])
@pytest.mark.parametrize("count", [6, 12, 40])
def test_a_rule_of_no_effect_on_the_mean_of_unequal_units_is_told_in_2_of_100_at_most(count: int, is_cut: bool) -> None:
    """Under the rule units have one prediction more often, which says little of each; the mean over units is alike."""
    rng, told, runs = np.random.default_rng(count), 0, 400
    for _ in range(runs):
        is_under = rng.random(count) < 0.4
        of = np.where(rng.random(count) < np.where(is_under, 0.8, 0.2), 1, LARGE)
        inside = np.where(is_under, of, 0)
        outside = np.where(is_under, LARGE if is_cut else 0, of)
        told += one_sided_p_value(rng.binomial(inside, 0.7), inside, rng.binomial(outside, 0.7), outside) <= 0.01
    assert told <= 0.02 * runs
