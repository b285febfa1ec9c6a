"""Confidence sequences: right at all times together, decided as soon as draws allow, and monotone."""

import math
import runpy
from pathlib import Path

import pytest

from advsearch.errors import InputError
from advsearch.statistics.sequential import STAKES, ConfidenceSequence, count_needed_samples, log_capital_of_counts

STUDY = Path(__file__).resolve().parents[2] / "benchmarks" / "sequential.py"


def of(*values: float, confidence: float = 0.95) -> ConfidenceSequence:
    sequence = ConfidenceSequence(confidence)
    for value in values:
        sequence.add(value)
    return sequence


def test_the_capital_is_that_of_the_bets_made_one_after_the_other() -> None:
    draws, mean = [1.0, 0.0, 0.5, 1.0, 1.0], 0.4
    made = [math.prod(1.0 - stake + stake * one / mean for one in draws) for stake in STAKES]
    assert math.exp(log_capital_of_counts(mean, {1.0: 3, 0.0: 1, 0.5: 1})) == pytest.approx(sum(made) / len(made))
    assert log_capital_of_counts(mean, {}) == 0.0, "1 before any draw"


def test_an_interval_holds_what_is_not_excluded_and_nothing_else() -> None:
    sequence = of(*[1.0] * 40, *[0.0] * 5)
    low, high = sequence.interval
    assert low < sequence.mean == 40 / 45 < high
    assert sequence.is_over(low - 1e-6) and not sequence.is_over(low + 1e-6)
    assert sequence.is_under(high + 1e-6) and not sequence.is_under(high - 1e-6)
    assert of().interval == (0.0, 1.0) and math.isnan(of().mean)


def test_right_and_wrong_change_places() -> None:
    low, high = of(1.0, 1.0, 0.0, 0.5).interval
    other_low, other_high = of(0.0, 0.0, 1.0, 0.5).interval
    assert (low, high) == pytest.approx((1.0 - other_high, 1.0 - other_low))


@pytest.mark.parametrize(("least", "most"), [(0.5, 8), (0.9, 50), (0.95, 100)])
def test_draws_that_all_agree_decide_soon(least: float, most: int) -> None:
    sequence, count = ConfidenceSequence(), 0
    while not sequence.is_over(least):
        sequence.add(1.0)
        count += 1
    assert math.log(2 / 0.05) / -math.log(least) <= count <= most, "never before a bet of everything would"


def test_a_surer_interval_is_wider() -> None:
    draws = [1.0] * 20 + [0.0] * 4
    (low, high), (wide_low, wide_high) = of(*draws).interval, of(*draws, confidence=0.999).interval
    assert wide_low < low < high < wide_high


@pytest.mark.parametrize("share", [0.5, 0.95])
def test_the_true_mean_is_excluded_at_any_time_less_often_than_the_error(share: float) -> None:
    """A small form of the study: 400 runs of 150 draws, each looked at after every draw."""
    study = runpy.run_path(str(STUDY))
    missed = study["missed"](share, 0.0, runs=400, draws=150, confidence=0.8, seed=1)
    assert max(missed) <= 0.2 * 400, "80 % ends, so that there is something to see"
    assert min(missed) > 0, "it is not merely the whole of [0, 1]"


@pytest.mark.medium
def test_a_claim_of_one_side_is_wrong_no_more_often_and_takes_fewer_draws() -> None:
    study = runpy.run_path(str(STUDY))
    given = {"runs": 300, "draws": 120, "confidence": 0.8, "seed": 2}
    (held, failed, _), _ = study["decisions"](0.8, 0.8, **given)
    assert max(held, failed) <= 0.2
    assert study["decisions"](0.8, 0.95, **given)[1] < study["decisions"](0.8, 0.95, **given, sides=2)[1]
    sequence = ConfidenceSequence(sides=1)
    for _ in range(41):
        sequence.add(1.0)
    assert sequence.is_over(0.9) and not of(*[1.0] * 41).is_over(0.9), "the study's rule is that of the code"


@pytest.mark.parametrize(("mean", "value"), [(0.5, 1.0), (0.9, 1.0), (0.99, 1.0), (0.475, 0.5)])
def test_the_draws_that_a_claim_needs_are_the_fewest_that_show_it(mean: float, value: float) -> None:
    needed = count_needed_samples(mean, confidence=0.95, value=value)
    sequence = ConfidenceSequence(sides=1)
    for count in range(1, needed + 1):
        sequence.add(value)
        assert sequence.is_over(mean) is (count == needed)


def test_what_is_no_share_is_refused() -> None:
    with pytest.raises(InputError, match=r"from 0 to 1, got 1\.5"):
        of(1.5)
    with pytest.raises(InputError, match="confidence: expected a number between 0 and 1"):
        ConfidenceSequence(95.0)
