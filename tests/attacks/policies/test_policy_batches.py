"""Batches: what a policy proposes does not depend on how many proposals it is asked for at once."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch.attacks import POLICIES, Block, Domain, Evaluation, Policy, Query, make_policy, search
from advsearch.attacks.policies.choices import with_choices

NUMBERS = Domain(torch.tensor([0.3, 0.6, 0.5, 0.5]), (Block(2), Block(2, "linf", 0.2)))
CHOICES = Domain(torch.tensor([0.2, 0.1, 0.9]), (Block(1, options=3), Block(1), Block(1, options=2)))
COSTLY = Domain(torch.tensor([0.3, 0.6]), (Block(2),), gradient_cost=4)
DOMAINS = {"numbers": NUMBERS, "choices": CHOICES, "differences": COSTLY}
FORMS: dict[str, Policy[Any]] = {
    **{name: make_policy(name) for name in POLICIES},
    "halving of cmaes": make_policy("halving", policy="cmaes", starts=3),
    "halving of pgd": make_policy("halving", policy="pgd", starts=3),
    "restarts of nes": make_policy("restarts", policy="nes"),
    "portfolio of halvings": make_policy("portfolio", policies=["halving", "sobol", {"name": "halving", "eta": 2}]),
}
STEPS = 40


def worth(u: Tensor, gradient: object, samples: int, cost: int) -> Evaluation:
    """A function of u alone, so that the order of evaluations does not matter."""
    slope = torch.cos(5.0 * u) * 5.0 if gradient else None
    price = samples * (1 + (cost if gradient is True else 0))
    return Evaluation(float(torch.sin(5.0 * u).sum()), slope, False, cost=price)


def proposed(policy: Policy[Any], domain: Domain, n: int) -> tuple[list[tuple[Any, ...]], list[int]]:
    """Return what was proposed until the renders were spent, and the sizes of the batches."""
    policy = with_choices(policy, domain)
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


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize("policy", FORMS)
def test_a_batch_has_what_would_have_come_one_by_one(policy: str, domain: str) -> None:
    alone, _ = proposed(FORMS[policy], DOMAINS[domain], 1)
    for n in (2, 5, 1000):
        together, sizes = proposed(FORMS[policy], DOMAINS[domain], n)
        assert together[: len(alone)] == alone, n  # the last batch may go beyond the renders
        assert max(sizes) <= n


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize("policy", FORMS)
def test_a_search_that_time_cuts_off_in_a_batch_has_the_first_rows_of_a_whole_one(policy: str, domain: str) -> None:
    def rows(late: int) -> list[tuple[float, int, float]]:
        def evaluate(query: Query) -> Evaluation:
            return worth(query.u, query.gradient, query.samples, DOMAINS[domain].gradient_cost)

        found = search(
            partial(map, evaluate),
            DOMAINS[domain],
            FORMS[policy],
            steps=STEPS,
            seed=0,
            candidates=0,
            late=lambda done: done >= late,
        )
        return [(one.objective, one.seed, one.step_size) for one in found.history]

    whole = rows(STEPS)
    for late in (1, 3, 7):
        assert repr(rows(late)) == repr(whole[:late])


@pytest.mark.parametrize("policy", ["cmaes", "halving", "nes", "random", "sobol", "portfolio of halvings"])
def test_a_population_fills_a_batch(policy: str) -> None:
    assert max(proposed(FORMS[policy], NUMBERS, 4)[1]) == 4


def test_the_whole_screen_of_auto_is_one_batch_and_then_every_point_waits_for_the_one_before() -> None:
    sizes = proposed(FORMS["auto"], COSTLY, 1000)[1]
    assert sizes == [math.ceil(STEPS / 2)] + [1] * (STEPS // 2)


def test_combinations_of_options_come_together_where_each_has_one_render_in_a_round() -> None:
    domain = Domain(torch.tensor([0.2, 0.9]), (Block(1, options=16), Block(1, options=2)))
    assert max(proposed(FORMS["pgd"], domain, 1000)[1]) > 4


@pytest.mark.parametrize("policy", ["adam", "pgd"])
def test_steps_along_a_gradient_come_alone(policy: str) -> None:
    assert set(proposed(FORMS[policy], NUMBERS, 9)[1]) == {1}
