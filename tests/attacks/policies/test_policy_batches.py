"""Batches: what a policy proposes does not depend on how many proposals it is asked for at once; a last batch may be
cut."""

from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch.attacks import POLICIES, Block, Domain, Evaluation, Policy, make_policy
from advsearch.attacks.policies.choices import wrap_choices
from covering import once_each

NUMBERS = Domain(torch.tensor([0.3, 0.6, 0.5, 0.5]), (Block(2), Block(2, "linf", 0.2)))
CHOICES = Domain(torch.tensor([0.2, 0.1, 0.9]), (Block(1, n_options=3), Block(1), Block(1, n_options=2)))
COSTLY = Domain(torch.tensor([0.3, 0.6]), (Block(2),), gradient_cost=4)
DOMAINS = {"numbers": NUMBERS, "choices": CHOICES, "differences": COSTLY}
RACES: dict[str, dict[str, Any]] = {
    "restarts of nes": {"name": "restarts", "policy": "nes"},
    "restarts of auto": {"name": "restarts", "policy": "auto", "times": 3},
    "restarts of restarts": {"name": "restarts", "policy": {"name": "restarts", "times": 2}, "times": 3},
    "restarts of portfolio": {
        "name": "restarts",
        "policy": {"name": "portfolio", "policies": ["pgd", "nes"]},
        "times": 3,
    },
    "portfolio of races": {"name": "portfolio", "policies": ["restarts", "sobol", {"name": "portfolio"}]},
}
FORMS: dict[str, Policy[Any]] = {name: make_policy(name) for name in POLICIES}
if {"restarts", "portfolio", "sobol"} <= FORMS.keys():  # else they are hidden, see hidden_islands.py
    FORMS |= {name: make_policy(**options) for name, options in RACES.items()}
STEPS = 40


def worth(u: Tensor, gradient: object, samples: int, cost: int) -> Evaluation:
    """A function of u alone, so that the order of evaluations does not matter; half of all gradients take fewer renders
    than they may."""
    slope = torch.cos(5.0 * u) * 5.0 if gradient else None
    value = float(torch.sin(5.0 * u).sum())
    price = samples * (1 + (cost - int(100 * value) % 2 * (cost // 2) if gradient is True else 0))
    return Evaluation(value, slope, value > 1.0, cost=price)


def proposed(policy: Policy[Any], domain: Domain, n: int) -> tuple[list[tuple[Any, ...]], list[int]]:
    """Return what was proposed until the renders were spent, and the sizes of the batches."""
    policy = wrap_choices(policy, domain)
    state = policy.start(domain, torch.Generator().manual_seed(3), STEPS)
    seen: list[tuple[Any, ...]] = []
    sizes, spent = [], 0
    while spent < STEPS:
        proposals, state = policy.propose(state, n)
        if not proposals:
            break
        evaluated = [(p.u, worth(p.u, p.gradient, p.samples, domain.gradient_cost)) for p in proposals]
        seen += [(*p.u.tolist(), p.gradient, p.samples, str(p.step_size)) for p in proposals]
        sizes.append(len(proposals))
        spent += sum(evaluation.cost for _, evaluation in evaluated)
        state = policy.update(state, evaluated)
    return seen, sizes


@pytest.mark.medium
@once_each("policy, domain", FORMS, DOMAINS)
def test_a_batch_has_what_would_have_come_one_by_one(policy: str, domain: str) -> None:
    alone, _ = proposed(FORMS[policy], DOMAINS[domain], 1)
    for n in (2, 3, 16, 1000):
        together, sizes = proposed(FORMS[policy], DOMAINS[domain], n)
        assert together[: len(alone)] == alone, n  # the last batch may go beyond the renders
        assert max(sizes) <= n


@pytest.mark.parametrize("policy", FORMS)
def test_of_a_batch_that_is_cut_the_first_count(policy: str) -> None:
    """What a policy knows after a whole batch and the first half of another is what it knows where these came one by
    one; and it can be asked for more."""

    def known(n: int, most: int) -> tuple[Any, ...]:
        one = wrap_choices(FORMS[policy], CHOICES)
        state, told = one.start(CHOICES, torch.Generator().manual_seed(3), STEPS), 0
        while told < most:
            proposals, state = one.propose(state, n)
            first = proposals[: most - told]
            state = one.update(state, [(p.u, worth(p.u, p.gradient, p.samples, 0)) for p in first])
            told += len(first)
        answer, failures = one.distribution(state), one.failures(state)
        assert len(one.propose(state, n)[0]) <= n
        return (
            one.counts(state),
            answer and (answer.mean.tolist(), answer.deviation.tolist()),
            failures
            and (failures.n_failures, failures.n_visited, [failure.objective for failure in failures.examples]),
        )

    assert known(8, 11) == known(1, 11)
