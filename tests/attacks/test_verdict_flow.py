"""Whole checks, carried out by the code that runs with margins in place of pictures: small forms of a study."""

import math
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from advsearch.attacks import Ending
from advsearch.attacks.trials import N_CONDITIONS, OVER_LADDER, choose_rate_spp, estimate_moved_fraction
from advsearch.attacks.verification import TRIAL_LOOKS


@pytest.fixture(scope="module")
def study() -> dict[str, Any]:
    return runpy.run_path(str(Path(__file__).resolve().parents[2] / "benchmarks" / "verdict_flow.py"))


@pytest.mark.medium
def test_what_holds_too_seldom_is_seldom_found_whatever_chooses(study: dict[str, Any]) -> None:
    """At .5 and by 6 of 6, or by trials that the sample count has looked at, some of these would be found."""
    checks = [study["checked"](0.5, root, failures=4) for root in range(20)]
    assert not any(one.verification.ending is Ending.FOUND for one in checks)
    assert not any(failure.ending is Ending.FOUND for one in checks for failure in one.failure_verifications)
    covered = [one.verification.adversarial_counts.interval for one in checks]
    assert np.mean([low <= 0.5 <= high for low, high in covered]) >= 0.85


@pytest.mark.medium
def test_a_configuration_that_is_chosen_by_its_trials_is_tried_in_others(study: dict[str, Any]) -> None:
    """The random search's answer is the run's only by trials that come after those by which it was chosen."""
    checks = [study["checked"](0.9, root) for root in range(20)]
    chosen = [one for one in checks if one.outdone_verification is not None]
    assert chosen, "else there is nothing to see"
    for one in checks:
        assert one.verification.first_index == (TRIAL_LOOKS[-1] if one.outdone_verification is not None else 0)
    for one in chosen:
        assert len(one.verification.clean_trials) >= TRIAL_LOOKS[0] and one.baseline_verification is one.verification


@pytest.mark.medium
def test_a_configuration_that_wins_once_and_not_again_is_not_the_runs(study: dict[str, Any]) -> None:
    checks = [study["checked"](0.9, root) for root in range(20)]
    assert any(one.outdone_verification is None and one.baseline_verification.first_index > 0 for one in checks)


def steady(noise: float, shift: float = 0.0, middle: float = 3.0) -> Any:
    def margins(spp: int, seeds: Any) -> list[float]:
        conditions = [np.random.default_rng(seed).normal() for seed in seeds]
        rng = np.random.default_rng([spp, *seeds])
        scale = math.sqrt(16 / spp)
        return [middle + 2.5 * one + scale * (shift + noise * float(rng.normal())) for one in conditions]

    return margins


def test_conditions_near_the_decision_ask_for_no_more_samples() -> None:
    """Noise moves them to one side as often as to the other: the rate stays."""
    counts = [choose_rate_spp({"answer": steady(0.2), "clean": steady(0.2)}, seed=seed) for seed in range(10)]
    assert sum(one.spp == 16 for one in counts) >= 8 and all(one.converged for one in counts)
    assert counts[0].renders == 2 * 2 * N_CONDITIONS


def test_noise_that_moves_the_rate_does_and_what_no_rung_settles_is_said() -> None:
    moving = choose_rate_spp({"answer": steady(0.2, shift=-1.0)}, seed=0)
    assert moving.spp == 64
    never = choose_rate_spp({"answer": lambda spp, seeds: [math.nan] * len(seeds)}, seed=0)
    assert (never.spp, never.converged) == (OVER_LADDER[-1], False)
    assert choose_rate_spp({"answer": steady(0.2)}, seed=0, ladder=(32,)).renders == 0


def test_the_share_that_moves_is_that_of_a_mean_change() -> None:
    here = np.linspace(-10.0, 10.0, 200)
    assert estimate_moved_fraction(here, here) == 0.0
    assert estimate_moved_fraction(here, here - 1.0) == pytest.approx(0.05, abs=0.005), (
        "a twentieth lies within 1 of zero"
    )


@pytest.mark.parametrize("number", [0, 20, 60])
def test_the_rate_is_seldom_far_off_at_the_chosen_count(study: dict[str, Any], number: int) -> None:
    errors = np.array([study["chosen"](study["CASES"][number], root)[1] for root in range(60)])
    for far, most in study["MOST_OFF"].items():
        assert np.mean(errors > far) <= most + study["error_of"](most, 60)
