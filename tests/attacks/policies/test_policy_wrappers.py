"""What wraps policies: rounds of a race, `restarts` and discrete choices."""

import math
from functools import partial

import pytest
import torch
from torch import Tensor

from advsearch.attacks import NES, PGD, Block, Domain, Evaluation, Query, search, seeded


@pytest.mark.island("advsearch.attacks.policies.restarts")
def test_restarts_find_the_higher_of_two_hills() -> None:
    from advsearch.attacks import Restarts

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


def test_choices_beside_a_ball_keep_its_gradient_and_its_distribution() -> None:
    domain = Domain(
        torch.tensor([0.5, 0.1, 0.5, 0.5]), (Block(1, "linf", 0.1), Block(1, n_options=3), Block(2, "l2", 0.2))
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
