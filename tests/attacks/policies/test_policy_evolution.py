"""The policies `cmaes` and `nes`: ranks alone decide, bounds hold, memory and time stay those of a few vectors."""

import math
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch.attacks import CMAES, NES, Block, Domain, Evaluate, Evaluation, Policy, Query, search, seeded
from advsearch.attacks.policies.evolution import MAX_STEP_SIZE
from advsearch.errors import InputError

both = pytest.mark.parametrize("policy", [CMAES(), NES()], ids=lambda policy: policy.name)


def evaluator(value: Callable[[Tensor], float], noise: float = 0.0) -> Evaluate:
    def evaluate(query: Query) -> Evaluation:
        error = noise * float(torch.randn(1, generator=seeded(5, query.row_index)))
        return Evaluation(value(query.u) + error, None, False)

    return partial(map, evaluate)


def bowl(centre: float) -> Callable[[Tensor], float]:
    return lambda u: -float((u - centre).square().sum())


@both
def test_only_ranks_matter(policy: Policy[Any]) -> None:
    """A monotone change of the objective, however steep, changes no proposal (bitwise: ranks are the same)."""
    domain = Domain(torch.full((4,), 0.5), (Block(4, low=0.25, high=0.75),))
    if policy.name == "cmaes":
        domain = Domain(torch.full((4,), 0.5), (Block(4, periodic=True),))  # no bounds, so no penalty that has a size

    def played(change: Callable[[float], float]) -> Tensor:
        seen: list[Tensor] = []
        search(
            evaluator(lambda u: change(bowl(0.6)(u))),
            domain,
            policy,
            steps=60,
            seed=0,
            candidates=0,
            on_step=lambda record, u, evaluation: seen.append(u),
        )
        return torch.stack(seen)

    assert torch.equal(played(lambda v: v), played(lambda v: 1e6 * math.exp(50.0 * v)))


@both
def test_a_peak_on_the_seam_of_an_angle_is_met_from_both_sides(policy: Policy[Any]) -> None:
    domain = Domain(torch.tensor([0.6, 0.6]), (Block(1, periodic=True), Block(1)))

    def value(u: Tensor) -> float:
        return math.cos(2.0 * math.pi * float(u[0])) - (float(u[1]) - 0.5) ** 2

    sides: set[bool] = set()
    result = search(
        evaluator(value),
        domain,
        policy,
        steps=200,
        seed=0,
        candidates=0,
        on_step=lambda record, u, evaluation: sides.add(float(u[0]) < 0.5) if record.step > 120 else None,
    )
    assert value(result.best_u) > 0.999
    assert sides == {True, False}


@pytest.mark.medium
@both
def test_through_noise_the_mean_is_better_than_the_best_that_was_seen(policy: Policy[Any]) -> None:
    """Noise of a third of the bowl's height: one lucky render says nothing, the distribution averages."""
    domain = Domain(torch.full((6,), 0.2), (Block(6),))
    means, lucky = [], []
    for seed in range(4):
        result = search(evaluator(bowl(0.7), noise=0.5), domain, policy, steps=400, seed=seed, candidates=0)
        assert result.distribution is not None
        means.append(bowl(0.7)(result.distribution.mean))
        lucky.append(bowl(0.7)(result.best_u))
    assert sum(means) > sum(lucky)
    assert sum(means) / 4 > -0.4  # the start is at -1.5


@both
@pytest.mark.parametrize("norm", ["linf", "l2", "box"])
def test_an_optimum_in_a_corner_is_reached_and_the_mean_stays_inside(policy: Policy[Any], norm: str) -> None:
    domain = Domain(torch.full((5,), 0.45), (Block(5, norm, {"linf": 0.2, "l2": 0.3, "box": None}[norm]),))  # type: ignore[arg-type]
    w = torch.tensor([1.0, -2.0, 0.5, 1.5, -1.0])
    far = domain.project(domain.start + 1e4 * w)
    best = float(w @ far if norm == "l2" else w @ torch.where(w > 0, domain.upper_bounds, domain.lower_bounds))
    result = search(evaluator(lambda u: float(w @ u)), domain, policy, steps=400, seed=0, candidates=0)
    start = float(w @ domain.start)
    assert result.distribution is not None
    assert domain.contains(result.distribution.mean)
    assert float(w @ result.best_u) - start > 0.97 * (best - start)
    assert float(w @ result.distribution.mean) - start > 0.9 * (best - start)


def test_cmaes_learns_a_ridge() -> None:
    """Two numbers matter by their sum, a hundred times less by their difference; separable steps zigzag there."""
    domain = Domain(torch.full((2,), 0.2), (Block(2),))

    def ridge(u: Tensor) -> float:
        return -100.0 * float(u[0] - u[1]) ** 2 - float(u[0] + u[1] - 1.4) ** 2

    best = ridge(search(evaluator(ridge), domain, CMAES(), steps=150, seed=0, candidates=0).best_u)
    assert best > -1e-4


def test_cmaes_is_separable_in_many_dimensions_and_refuses_more() -> None:
    many = Domain(torch.full((3000,), 0.5), (Block(3000, "linf", 0.1),))
    state = CMAES().start(many, seeded(0, 0), 100)
    assert state.points.shape[1] == 3000
    for _ in range(len(state.points)):
        (proposal,), state = CMAES().propose(state, 1)
        state = CMAES().update(state, [(proposal.u, Evaluation(float(proposal.u[0]), None, False))])
    assert len(pickle.dumps(state)) < 200 * 8 * 3000  # a full matrix alone has 3000 x 8 x 3000
    over = Domain(torch.full((10_001,), 0.5), (Block(10_001, "linf", 0.1),))
    with pytest.raises(InputError, match="cmaes"):
        search(evaluator(bowl(0.5)), over, CMAES(), steps=10, seed=0)


def test_samples_come_in_mirrored_pairs() -> None:
    domain = Domain(torch.full((3,), 0.5), (Block(3),))
    seen: list[Tensor] = []
    search(
        evaluator(bowl(0.5)),
        domain,
        NES(sigma=0.1, population=4),
        steps=4,
        seed=0,
        candidates=0,
        on_step=lambda record, u, evaluation: seen.append(u),
    )
    assert torch.allclose(seen[0] + seen[1], torch.ones(3), atol=1e-6)
    assert torch.allclose(seen[2] + seen[3], torch.ones(3), atol=1e-6)
    assert not torch.allclose(seen[0], seen[2])


def test_nes_narrows_on_a_peak_and_widens_on_a_slope() -> None:
    domain = Domain(torch.full((3,), 0.5), (Block(3),))
    narrow = search(evaluator(bowl(0.5)), domain, NES(sigma=0.5), steps=300, seed=0).distribution
    slope = search(evaluator(lambda u: float(u[0])), domain, NES(sigma=0.02), steps=60, seed=0).distribution
    assert narrow is not None and slope is not None
    assert float(narrow.deviation.max()) < 0.05
    assert 0.01 < float(slope.deviation[0]) <= 0.5 * MAX_STEP_SIZE
