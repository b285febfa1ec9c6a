"""The mixture that learns where failures lie: how large a share it says that they are, and where."""

import math
from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch import Tensor

from advsearch.attacks import Block, Domain, Evaluation, Query, make_policy, search
from advsearch.attacks.candidates import FailureRate, Failures, estimate_failure_rate
from advsearch.attacks.evaluation import limit_to_single_thread

BOX = Domain(
    torch.full((4,), 0.5),
    (
        Block(1, name="yaw", periodic=True),
        Block(1, name="height"),
        Block(1, name="light"),
        Block(1, name="kind", n_options=4),
    ),
)
Margin = Callable[[Tensor], Tensor]
"""Over 0 where the model is wrong."""


def corner(u: Tensor) -> Tensor:
    """A fifth of two numbers each: a share of 0.04."""
    return torch.minimum(u[1] - 0.8, 0.2 - u[2])


def across(u: Tensor) -> Tensor:
    """Round the end of an angle, for one of four options: a share of 0.2 / 4."""
    return torch.minimum((u[0] - 0.5).abs() - 0.4, torch.where(u[3] > 0.75, 1.0, -0.2))


def two(u: Tensor) -> Tensor:
    """Two places apart: a share of 0.02."""
    low = torch.minimum(0.1 - u[1], 0.1 - u[2])
    return torch.maximum(low, torch.minimum(u[1] - 0.9, u[2] - 0.9))


def learnt(margin: Margin, seed: int, renders: int = 400) -> Failures:
    def evaluate(query: Query) -> Evaluation:
        value = float(margin(query.u))
        return Evaluation(value, None, value > 0.0)

    policy = make_policy("mixture")
    found = search(partial(map, evaluate), BOX, policy, steps=renders, seed=seed, candidates=0).failures
    assert found is not None
    return found


def share(known: Failures) -> FailureRate:
    assert known.failure_rate is not None
    return known.failure_rate


@pytest.mark.medium
@pytest.mark.parametrize(("margin", "truth"), [(corner, 0.04), (across, 0.05), (two, 0.02)])
def test_its_share_is_the_true_one_with_less_error_than_even_draws(margin: Margin, truth: float) -> None:
    found = [share(learnt(margin, seed)) for seed in range(8)]
    estimates = torch.tensor([one.estimate for one in found])
    assert all(one.interval[0] <= truth <= one.interval[1] for one in found)
    error = float((estimates / truth - 1.0).square().mean().sqrt())
    assert error < math.sqrt((1.0 - truth) / truth / 400)  # of even draws
    spread = float(estimates.std()) / math.sqrt(len(found))
    assert abs(float(estimates.mean()) - truth) < 3.0 * spread < truth


@pytest.mark.medium
def test_it_answers_with_a_failure_for_each_place_and_what_tells_it_apart() -> None:
    known = learnt(two, 1)
    assert known.n_failures > 5 * 0.02 * known.n_visited and known.n_cells is None
    heights = [float(one.u[1]) for one in known.examples]
    assert all(two(one.u) > 0.0 for one in known.examples)
    assert min(heights) < 0.2 and max(heights) > 0.8
    assert all(set(one.ranges) == {1, 2} for one in known.examples)
    (options,) = {one.ranges.get(3) for one in learnt(across, 0).examples}
    assert options == (0.75, 1.0)


def test_an_interval_covers_as_often_as_it_says() -> None:
    """Draws from two densities in turn, of which the second depends on what the first saw."""
    missed, truth = 0, 0.1
    for seed in range(100):
        rng = torch.Generator().manual_seed(seed)
        even = torch.rand(150, generator=rng)
        often = 0.5 if bool((even[:50] < truth).any()) else 0.0  # share that is drawn from below 0.2
        inside = torch.rand(150, generator=rng) < often
        x = torch.where(inside, 0.2 * even, even)
        density = torch.where(x < 0.2, 1.0 - often + 5.0 * often, 1.0 - often)
        x[:50], density[:50] = even[:50], 1.0
        bounds = torch.cat([torch.ones(50), torch.full((100,), 1.0 / (1.0 - often))])
        with limit_to_single_thread():
            told = estimate_failure_rate(1.0 / density, bounds, x < truth, torch.zeros(150, dtype=torch.bool))
        missed += not told.interval[0] <= truth <= told.interval[1]
    assert missed <= 5
