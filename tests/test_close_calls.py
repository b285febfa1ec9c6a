"""Samples where the decision is close: the rule, and what it buys on an objective whose noise is known."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch.attacks import Block, Domain, Evaluation, Policy, StepRecord, search
from advsearch.attacks.close_calls import CloseCalls, Noise, more_renders, pooled
from advsearch.attacks.evaluation import Wanted
from advsearch.attacks.policies import Proposal, Random, make_policy
from advsearch.errors import InputError

NOISE = 0.3
"""Standard deviation of one render; the objective itself spans 1."""
DOMAIN = Domain(torch.full((2,), 0.5), (Block(2),))


def true(u: Tensor) -> float:
    return 1.0 - float((u - 0.7).square().sum())


class Noisy:
    """The objective with noise that falls with the samples, and what was asked of it."""

    def __init__(self, seed: int) -> None:
        self.seed, self.samples = seed, [0]

    def __call__(self, u: Tensor, *, index: int, gradient: Wanted, samples: int = 1) -> Evaluation:
        generator = torch.Generator().manual_seed(1000 * self.seed + index)
        noise = NOISE / math.sqrt(samples) * float(torch.randn(1, generator=generator))
        self.samples.append(samples)
        return Evaluation(true(u) + noise, None, torch.zeros(2), False, cost=samples)


def test_what_is_clearly_worse_takes_no_render_more() -> None:
    assert more_renders(mean=0.0, best=1.0, noise=0.5, spent=1, most=8) == 0


def test_what_claims_to_be_the_best_is_asked_again() -> None:
    assert more_renders(mean=2.0, best=1.0, noise=0.5, spent=1, most=8) == 1
    assert more_renders(mean=2.0, best=-math.inf, noise=0.5, spent=4, most=8) == 4


def test_a_close_one_takes_what_makes_it_clear_in_doublings() -> None:
    assert more_renders(0.9, 1.0, noise=0.2, spent=1, most=8) == 1  # four are enough
    assert more_renders(0.9, 1.0, noise=0.2, spent=2, most=8) == 2
    assert more_renders(0.9, 1.0, noise=0.2, spent=4, most=8) == 0
    assert more_renders(1.0, 1.0, noise=0.2, spent=4, most=7) == 3
    assert more_renders(1.0, 1.0, noise=0.2, spent=7, most=7) == 0


@pytest.mark.parametrize("mean", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_never_close(mean: float) -> None:
    assert more_renders(mean, 1.0, 0.2, 1, 8) == 0
    assert more_renders(1.0, math.nan, 0.2, 1, 8) == 0
    assert more_renders(1.0, 1.0, 0.0, 1, 8) == 0


def test_renders_are_pooled_by_their_number() -> None:
    def one(objective: float, success: bool) -> Evaluation:
        return Evaluation(objective, None, torch.tensor([objective]), success, cost=2)

    both = pooled(one(1.0, False), 1, one(4.0, True), 2)
    assert both.objective == pytest.approx(3.0) and float(both.logits) == pytest.approx(3.0)
    assert both.success and both.cost == 4
    assert pooled(one(1.0, True), 1, one(-math.inf, False), 1).objective == -math.inf


def test_the_noise_is_learnt() -> None:
    generator = torch.Generator().manual_seed(0)
    known = Noise()
    assert math.isnan(known.deviation)
    for _ in range(400):
        one, other = (NOISE * torch.randn(2, generator=generator) / torch.tensor([1.0, 2.0])).tolist()
        known = known.after(one - other, 1, 4)
    assert known.deviation == pytest.approx(NOISE, rel=0.1)
    assert known.after(math.inf, 1, 1) == known


@pytest.mark.parametrize(
    ("given", "message"), [({"most": 1}, "at least 2 renders"), ({"noise": -1.0}, "noise: expected")]
)
def test_bad_options_are_refused(given: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        CloseCalls(Random(), **given)  # type: ignore[arg-type]


def test_the_budget_is_kept_and_samples_go_where_it_is_close() -> None:
    evaluate = Noisy(0)
    found = search(evaluate, DOMAIN, CloseCalls(Random(), most=8, noise=NOISE), steps=60, seed=0, candidates=0)
    assert found.renders <= 60
    assert max(evaluate.samples) > 1 and statistics.fmean(evaluate.samples[1:]) < 4.0


@dataclass(frozen=True)
class Fixed(Random):
    """Random search with a fixed number of samples."""

    samples: int = 1

    def propose(self, state: Any) -> tuple[Proposal | None, Any]:
        proposal, state = super().propose(state)
        return (None if proposal is None else replace(proposal, samples=self.samples)), state


def answer(policy: Policy[Any], seed: int) -> float:
    """The true objective of the configuration with the highest mean over its renders."""
    means: dict[bytes, tuple[float, int, Tensor]] = {}

    def keep(record: StepRecord, u: Tensor, evaluation: Evaluation) -> None:
        total, count, _ = means.get(u.numpy().tobytes(), (0.0, 0, u))
        total, count = total + evaluation.objective * evaluation.cost, count + evaluation.cost
        means[u.numpy().tobytes()] = (total, count, u)

    search(Noisy(seed), DOMAIN, policy, steps=60, seed=seed, candidates=0, on_step=keep)
    return true(max(means.values(), key=lambda one: one[0] / one[1])[2])


def test_at_equal_renders_it_ends_higher_than_any_fixed_count() -> None:
    close = statistics.fmean(answer(CloseCalls(Random()), seed) for seed in range(120))
    for samples in (1, 2, 4, 8):
        assert close > statistics.fmean(answer(Fixed(samples=samples), seed) for seed in range(120)), samples


def test_what_the_policy_underneath_handles_and_counts_is_passed_on() -> None:
    domain = Domain(torch.full((16,), 0.5), (Block(16, "linf", 0.3),))

    def evaluate(u: Tensor, *, index: int, gradient: Wanted, samples: int = 1) -> Evaluation:
        slope = torch.ones(16) * (1e4 if index == 12 else 1.0)
        return Evaluation(float(u.sum()), slope if gradient else None, torch.zeros(2), False, cost=samples)

    found = search(evaluate, domain, CloseCalls(make_policy("pgd"), noise=0.0), steps=20, seed=1, candidates=0)
    assert found.counts.shortened == 1
    assert CloseCalls(make_policy("auto")).handles_choices and not CloseCalls(make_policy("pgd")).handles_choices
