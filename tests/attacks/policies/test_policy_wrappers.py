"""What wraps policies: races, `restarts`, `portfolio`, discrete choices, and how they are named."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from advsearch.attacks import (
    CMAES,
    NES,
    PGD,
    Auto,
    Block,
    Choices,
    Domain,
    Ending,
    Evaluated,
    Evaluation,
    Policy,
    Portfolio,
    Proposal,
    Query,
    Random,
    Restarts,
    SearchResult,
    make_policy,
    search,
    seeded,
)
from advsearch.attacks.policies import choices
from advsearch.attacks.policies.choices import MAX_COMBINATIONS, wrap_choices
from advsearch.errors import InputError, UnknownNameError

BOX = Domain(torch.tensor([0.3, 0.6]), (Block(2),))


@dataclass(frozen=True)
class Still(Policy[tuple[Tensor, int]]):
    """Proposes u = (value, where it begins), `times` times; notes what it was promised in `plans`, and what evaluations
    cost in `costs`."""

    value: float
    times: int = 10**6
    gradient: bool = False
    plans: tuple[list[int], ...] = ()
    costs: tuple[list[int], ...] = ()
    name: ClassVar[str] = "still"
    handles_choices: ClassVar[bool] = True

    @property
    def uses_gradient(self) -> bool:
        return self.gradient

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> tuple[Tensor, int]:
        for plan in self.plans:
            plan.append(steps)
        return torch.tensor([self.value, float(domain.initial_point[1])]), 0

    def propose(self, state: tuple[Tensor, int], n: int) -> tuple[tuple[Proposal, ...], tuple[Tensor, int]]:
        u, done = state
        n = min(1 if self.gradient else n, self.times - done)
        return (Proposal(u, self.gradient),) * n, (u, done + n)

    def update(self, state: tuple[Tensor, int], evaluated: Evaluated) -> tuple[Tensor, int]:
        assert all(torch.equal(u, state[0]) for u, _ in evaluated)
        for costs in self.costs:
            costs += [evaluation.cost for _, evaluation in evaluated]
        return state


def played(
    policy: Policy[Any], steps: int, value: Callable[[Tensor], float], domain: Domain = BOX
) -> tuple[SearchResult, list[Tensor]]:
    seen: list[Tensor] = []

    def evaluate(query: Query) -> Evaluation:
        seen.append(query.u.clone())
        slope = torch.ones_like(query.u) if query.gradient else None
        cost = query.samples * (1 + domain.gradient_cost * (query.gradient is True))
        return Evaluation(value(query.u), slope, False, cost=cost)

    return search(partial(map, evaluate), domain, policy, steps=steps, seed=0, candidates=0), seen


def first(u: Tensor) -> float:
    return float(u[0])


# ---- races


@pytest.mark.parametrize(("n", "rounds"), [(1, 1), (2, 2), (3, 3), (4, 3), (5, 4), (8, 4), (9, 5)])
def test_rounds(n: int, rounds: int) -> None:
    assert choices.count_rounds(n) == rounds


@pytest.mark.parametrize(("steps", "each", "limit"), [(1, 1, 9), (40, 1, 999), (40, 13, 9), (1000, 1, 64), (39, 2, 8)])
def test_as_many_run_as_can_have_a_whole_evaluation_in_every_round(steps: int, each: int, limit: int) -> None:
    n = choices.max_runners(steps, each, limit)
    assert 1 <= n <= limit
    assert n == 1 or n * choices.count_rounds(n) * each <= steps
    assert n == limit or (n + 1) * choices.count_rounds(n + 1) * each > steps


def test_who_reached_more_goes_on_with_an_equal_share_of_every_round() -> None:
    """Four policies, 48 renders, three rounds of 16: 4 each, then 8 for the better two, then 16 for the best. Those of
    a round take turns."""
    policy = Portfolio(tuple(Still(value) for value in (0.2, 0.8, 0.4, 0.6)))
    result, seen = played(policy, 48, first)
    order = [round(float(u[0]), 1) for u in seen]
    assert order == [0.2, 0.8, 0.4, 0.6] * 4 + [0.8, 0.6] * 8 + [0.8] * 16
    assert result.stopped is Ending.BUDGET_SPENT


def test_each_plans_for_what_it_gets_if_it_stays_in() -> None:
    plans: list[int] = []
    played(Portfolio(tuple(Still(value, plans=(plans,)) for value in (0.2, 0.8, 0.4, 0.6))), 48, first)
    assert plans[:4] == [12] * 4  # the portfolio asks whether they can search here, for an equal share
    assert plans[4:] == [28] * 4  # 4 + 8 + 16


def test_renders_that_one_leaves_go_to_the_others() -> None:
    result, seen = played(Portfolio((Still(0.9, times=2), Still(0.5), Still(0.1, times=1))), 30, first)
    counts = Counter(round(float(u[0]), 1) for u in seen)
    assert counts == {0.9: 2, 0.5: 27, 0.1: 1}
    assert result.stopped is Ending.BUDGET_SPENT
    stalled, _ = played(Portfolio((Still(0.9, times=2), Still(0.5, times=3))), 30, first)
    assert (stalled.stopped, stalled.renders) == (Ending.STALLED, 5)


def test_a_costly_gradient_does_not_overdraw_a_share() -> None:
    """Ten renders each, four a gradient: two of them and two renders without."""
    domain = replace(BOX, gradient_cost=3)
    asked: list[bool] = []

    def evaluate(query: Query) -> Evaluation:
        asked.append(bool(query.gradient))
        slope = torch.ones_like(query.u) if query.gradient else None
        return Evaluation(float(query.u[0]), slope, False, cost=1 + 3 * bool(query.gradient))

    search(partial(map, evaluate), domain, Restarts(Still(0.5, gradient=True), 2), steps=20, seed=0, candidates=0)
    assert asked == [True] * 4 + [False] * 4


def test_renders_that_gradients_did_not_take_are_for_the_rounds_to_come() -> None:
    """Two searches, 40 renders, two rounds of 20: gradients that may take four renders, and take two."""
    domain = replace(BOX, gradient_cost=3)
    seen: list[float] = []

    def evaluate(query: Query) -> Evaluation:
        seen.append(round(float(query.u[0]), 1))
        slope = torch.ones_like(query.u) if query.gradient else None
        return Evaluation(float(query.u[0]), slope, False, cost=2 if query.gradient else 1)

    policy = Portfolio((Still(0.5, gradient=True), Still(0.9, gradient=True)))
    assert search(partial(map, evaluate), domain, policy, steps=40, seed=0, candidates=0).renders == 40
    assert seen[:8] == [0.5, 0.9] * 4 and set(seen[8:]) == {0.9}


def test_what_is_affordable() -> None:
    domain = replace(BOX, gradient_cost=3)
    wanted = Proposal(BOX.start, gradient=True, samples=2)
    assert wanted.limit_cost(domain, 9) is wanted
    assert wanted.limit_cost(domain, 8).gradient is False
    assert wanted.limit_cost(domain, 1).samples == 1
    free = Proposal(BOX.start, gradient="free", samples=2)
    assert (free.max_cost(domain), free.limit_cost(domain, 3).gradient, free.limit_cost(domain, 2).gradient) == (
        2,
        "free",
        False,
    )


# ---- restarts


def test_restarts_share_the_renders_and_begin_elsewhere() -> None:
    """Thirty-two renders are ten for each of three, by turns, and two more for the best of them."""
    _, seen = played(Restarts(Still(0.5), times=3), 32, first)
    begins = [float(u[1]) for u in seen]
    assert begins == begins[:3] * 10 + begins[:1] * 2
    assert begins[0] == pytest.approx(0.6)
    assert len(set(begins)) == 3


def test_restarts_do_not_move_the_ball() -> None:
    domain = Domain(torch.full((8,), 0.5), (Block(8, "linf", 0.1),))
    _, seen = played(Restarts(PGD(), times=4), 40, lambda u: float(u.sum()), domain)
    assert all(domain.contains(u) for u in seen)
    assert len({tuple(seen[k].tolist()) for k in range(4)}) == 4


def test_fewer_restarts_where_renders_are_few() -> None:
    _, seen = played(Restarts(Still(0.5), times=9), 4, first)
    assert len({float(u[1]) for u in seen}) == 4
    _, seen = played(Restarts(PGD(), times=9), 8, first, replace(BOX, gradient_cost=3))
    assert torch.equal(seen[0], BOX.start)


def test_restarts_find_the_higher_of_two_hills() -> None:
    def value(u: Tensor) -> float:
        return math.exp(-20 * float((u - 0.2).square().sum())) + 2 * math.exp(-20 * float((u - 0.85).square().sum()))

    def slope(u: Tensor) -> Tensor:
        low, high = ((math.exp(-20 * float((u - c).square().sum())), c) for c in (0.2, 0.85))
        return -40 * (low[0] * (u - low[1]) + 2 * high[0] * (u - high[1]))

    def evaluate(query: Query) -> Evaluation:
        return Evaluation(value(query.u), slope(query.u) if query.gradient else None, False)

    domain = Domain(torch.tensor([0.25, 0.15]), (Block(2),))
    alone = search(partial(map, evaluate), domain, PGD(step_size=0.1), steps=80, seed=0, candidates=0)
    several = search(
        partial(map, evaluate), domain, Restarts(PGD(step_size=0.1), times=8), steps=80, seed=0, candidates=0
    )
    assert value(alone.best_u) < 1.1
    assert value(several.best_u) > 1.9


# ---- portfolio


def test_a_portfolio_leaves_out_what_cannot_search_here() -> None:
    domain = Domain(torch.full((30,), 0.5), (Block(30, "linf", 0.1),))
    both = make_policy("portfolio", policies=["grid", "nes"])
    assert played(both, 20, first, domain)[0].stopped is Ending.BUDGET_SPENT
    with pytest.raises(InputError, match="policy 'grid': 2 values for each of 30 numbers are billions of renders"):
        played(make_policy("portfolio", policies=["grid"]), 20, first, domain)


def test_a_portfolio_answers_with_its_leaders_distribution() -> None:
    result, _ = played(Portfolio((NES(), CMAES())), 80, lambda u: -float((u - 0.4).square().sum()))
    assert result.distribution is not None
    assert result.distribution.mean.tolist() == pytest.approx([0.4, 0.4], abs=0.05)
    assert played(Portfolio((Random(), Still(0.2))), 20, first)[0].distribution is None


# ---- choices


def test_combinations_race_and_the_starts_is_among_them() -> None:
    """More combinations than renders: some, each once."""
    domain = Domain(torch.tensor([0.9, 0.9, 0.4]), (Block(1, options=50), Block(1, options=40), Block(1)))
    result, seen = played(Choices(NES()), 200, lambda u: float(u[0] + u[1]), domain)
    combinations = [(int(u[0] * 50), int(u[1] * 40)) for u in seen]
    assert combinations[0] == (45, 36)
    assert torch.equal(seen[0][:2], domain.start[:2])
    counts = Counter(combinations)
    assert 20 < len(counts) <= MAX_COMBINATIONS
    assert counts.most_common(1)[0][0] == (int(result.best_u[0] * 50), int(result.best_u[1] * 40))


def test_nothing_but_choices() -> None:
    domain = Domain(torch.tensor([0.1, 0.2]), (Block(1, options=3), Block(1, options=4)))
    result, seen = played(PGD(), 100, lambda u: float(u[0] - u[1]), domain)
    assert len({(int(u[0] * 3), int(u[1] * 4)) for u in seen}) == 12
    assert (int(result.best_u[0] * 3), int(result.best_u[1] * 4)) == (2, 0)
    assert result.gradients == 0


def test_choices_beside_a_ball_keep_its_gradient_and_its_distribution() -> None:
    domain = Domain(
        torch.tensor([0.5, 0.1, 0.5, 0.5]), (Block(1, "linf", 0.1), Block(1, options=3), Block(2, "l2", 0.2))
    )
    w = torch.tensor([1.0, 0.0, -1.0, 1.0])

    def evaluate(query: Query) -> Evaluation:
        bonus = 0.3 * (int(query.u[1] * 3) == 1)
        return Evaluation(float(w @ query.u) + bonus, w.clone() if query.gradient else None, False)

    best = search(partial(map, evaluate), domain, PGD(), steps=60, seed=0, candidates=0)
    assert best.best_u.tolist() == pytest.approx([0.6, 0.5, 0.5 - 0.02**0.5, 0.5 + 0.02**0.5], abs=1e-3)
    spread = search(partial(map, evaluate), domain, NES(), steps=200, seed=0, candidates=0).distribution
    assert spread is not None
    assert (float(spread.mean[1]), float(spread.deviation[1])) == (0.5, 0.0)
    drawn = spread.sample(seeded(0, 0), 5, domain)
    assert all(domain.contains(u) and float(u[1]) == 0.5 for u in drawn)


def test_who_handles_choices_is_left_alone() -> None:
    choosy = Domain(torch.tensor([0.1, 0.5]), (Block(1, options=3), Block(1)))
    for policy in (Auto(), Random(), Portfolio()):
        assert wrap_choices(policy, choosy) is policy
    assert wrap_choices(PGD(), choosy) == Choices(PGD())
    assert wrap_choices(PGD(), BOX) == PGD()


# ---- names


def test_nested_policies_are_made_by_name() -> None:
    assert make_policy("restarts", policy="pgd", times=4) == Restarts(PGD(), 4)
    assert make_policy("portfolio", policies=["pgd", "cmaes"]) == Portfolio((PGD(), CMAES()))
    assert make_policy("portfolio", policies="nes") == Portfolio((NES(),))
    spec = {"name": "restarts", "policy": {"name": "pgd", "momentum": 0.9}, "times": 2}
    assert make_policy("restarts", policy=spec) == Restarts(Restarts(PGD(momentum=0.9), 2))
    assert make_policy("restarts", policy=NES()) == Restarts(NES())


@pytest.mark.parametrize(
    ("name", "options", "error", "message"),
    [
        ("restarts", {"policy": "pdg"}, UnknownNameError, "unknown policy 'pdg'. Did you mean 'pgd'"),
        (
            "restarts",
            {"policy": {"name": "pgd", "speed": 1}},
            UnknownNameError,
            "unknown option of policy 'pgd': 'speed'",
        ),
        ("restarts", {"policy": None}, InputError, "policy of restarts: expected a name or a mapping"),
        ("restarts", {"policy": {"momentum": 0.9}}, InputError, "policy of restarts: expected a name or a mapping"),
        ("restarts", {"times": 0}, InputError, "times: expected at least 1, got 0"),
        ("portfolio", {"policies": []}, InputError, "policies of portfolio: expected one policy or more"),
        ("portfolio", {"policies": [3]}, InputError, "policies of portfolio: expected a name or a mapping"),
    ],
)
def test_wrong_nested_policies_say_what_is_wrong(
    name: str, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make_policy(name, **options)
    with pytest.raises(InputError, match="policy of restarts: expected a policy, got 'pgd'; use make_policy for names"):
        Restarts("pgd")  # type: ignore[arg-type]
