"""Shares and tests of answers that share a draw: what is worked out by hand, and how seldom they err."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import fisher_exact

from advsearch.attacks.trials import (
    ConfidenceSequence,
    clopper_pearson,
    fewer_by_chance,
    mcnemar,
    mean_interval,
    most_shown,
    paired_by_unit,
    paired_difference,
    per_unit,
    share_interval,
)
from advsearch.errors import InputError

FRAMES = 8


def drives(rng: np.random.Generator, count: int, share: float, alike: float) -> npt.NDArray[np.bool_]:
    """Answers (drives, frames), right in this share of all, those of a drive alike."""
    own = rng.beta(share * (1 - alike) / alike, (1 - share) * (1 - alike) / alike, (count, 1))
    found: npt.NDArray[np.bool_] = rng.random((count, FRAMES)) < own
    return found


def test_of_independent_predictions_the_exact_intervals_and_tests_are_taken() -> None:
    units = np.arange(20)
    first, second = units < 12, (units >= 3) & (units < 19)
    assert share_interval(first, np.ones(20)) == clopper_pearson(12, 20)
    difference, interval, p = paired_by_unit(first, second, units)
    assert (difference, interval) == paired_difference(9, 3, 7, 1) and p == mcnemar(3, 7)
    under = units < 8
    exact = fisher_exact([[2, 6], [10, 2]], alternative="less").pvalue
    right = np.isin(units, [0, 1, *range(8, 18)])
    assert fewer_by_chance(right & under, under, right & ~under, ~under) == pytest.approx(exact)


def test_of_units_it_is_the_interval_by_bets_and_units_of_equal_predictions_are_draws() -> None:
    counts = [8, 8, 6, 2, 0, 8]
    sequence = ConfidenceSequence()
    for one in counts:
        sequence.add(one / 8)
    assert share_interval(counts, np.full(6, 8)) == pytest.approx(sequence.interval)
    assert mean_interval([one / 8 for one in counts], 0.0, 1.0) == pytest.approx(sequence.interval)
    low, high = mean_interval([2.0 + one for one in counts], 2.0, 10.0)
    assert (low, high) == pytest.approx(tuple(2.0 + 8.0 * end for end in sequence.interval))
    assert share_interval([0, 3, 0], [2, 4, 0]) == share_interval([3, 0], [4, 2]), "a unit without answers says nothing"
    assert mean_interval([3.0, 3.0], 3.0, 3.0) == (3.0, 3.0)
    with pytest.raises(InputError, match="one prediction at least"):
        share_interval([0, 0], [0, 0])


def test_few_units_show_little_and_more_show_more() -> None:
    shown = [most_shown(n) for n in (1, 3, 5, 10, 30, 100)]
    assert shown == sorted(shown) and 0.3 < shown[2] < 0.45 and shown[-1] > 0.94


def test_copies_of_a_prediction_say_no_more_than_one() -> None:
    rng = np.random.default_rng(0)
    one, other = rng.random((2, 40)) < 0.5
    units = np.repeat(np.arange(40), 9)
    low, high = share_interval(per_unit(np.repeat(one, 9), units), np.full(40, 9))
    alone = clopper_pearson(int(one.sum()), 40)
    assert low < alone[0] and alone[1] < high
    p = paired_by_unit(np.repeat(one, 9), np.repeat(other, 9), units)[2]
    assert p >= mcnemar(int((one & ~other).sum()), int((~one & other).sum()))


@pytest.mark.parametrize("count", [3, 5, 10, 30])
@pytest.mark.parametrize("alike", [0.3, 0.95])
def test_two_models_that_are_as_good_are_told_apart_in_5_of_100_at_most(count: int, alike: float) -> None:
    rng, told, missed = np.random.default_rng(count), 0, 0
    units = np.repeat(np.arange(count), FRAMES)
    for _ in range(150):
        first, second = (drives(rng, count, 0.8, alike).ravel() for _ in range(2))
        difference, (low, high), p = paired_by_unit(first, second, units)
        told, missed = told + (p <= 0.05), missed + (not low <= 0.0 <= high)
        assert (p <= 0.05) == (not low <= 0.0 <= high) and low <= difference <= high
    assert told <= 12 and missed <= 12


def test_a_small_loss_in_nearly_all_drives_is_no_gain_in_the_mean() -> None:
    """One model gains a little in nine drives of ten and loses all of the tenth: signs alone would tell it apart."""
    rng, told = np.random.default_rng(1), 0
    for _ in range(200):
        lost = rng.random(12) < 0.1
        first, second = np.zeros((2, 12, 9), bool)
        first[lost], second[~lost, 0] = True, True
        told += paired_by_unit(first.ravel(), second.ravel(), np.repeat(np.arange(12), 9))[2] <= 0.05
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
    return fewer_by_chance(*(one.sum(axis=1) for one in (right & under, under, right & ~under, ~under)))


@pytest.mark.parametrize("side", SIDES)
def test_a_rule_that_is_none_is_told_in_one_of_100_and_a_clear_one_always(side: str) -> None:
    rng = np.random.default_rng(2)
    assert sum(fewer(rng, side, count, 0.0) <= 0.01 for count in (6, 12, 40) for _ in range(100)) <= 9
    assert sum(fewer(rng, side, 60, 0.6) <= 0.01 for _ in range(20)) == 20
    assert fewer_by_chance([1, 2], [8, 8], [0, 0], [0, 0]) == 1.0, "nothing is elsewhere"
