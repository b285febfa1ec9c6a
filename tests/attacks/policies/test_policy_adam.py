"""The policy `adam`: steps in units of half a range, whatever the gradient's size."""

import math
from functools import partial

import pytest
import torch
from torch import Tensor

from advsearch.attacks import Adam, Block, Domain, Evaluation, Query, make_policy, search
from advsearch.errors import InputError

pytestmark = pytest.mark.island("advsearch.attacks.policies.adam")


def path(domain: Domain, slope: Tensor, policy: Adam, steps: int) -> list[Tensor]:
    seen: list[Tensor] = []

    def evaluate(query: Query) -> Evaluation:
        return Evaluation(float(query.u @ slope), slope.clone() if query.gradient else None, False)

    search(
        partial(map, evaluate),
        domain,
        policy,
        steps=steps,
        seed=0,
        candidates=0,
        on_step=lambda record, u, evaluation: seen.append(u),
    )
    return seen


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_the_first_step_is_a_share_of_half_the_range_of_every_block(size: float) -> None:
    """In an l2 ball the steps of the elements add up to that share of the radius, along the gradient."""
    domain = Domain(torch.full((6,), 0.5), (Block(2, "linf", 0.1), Block(2, low=0.3, high=0.7), Block(2, "l2", 0.2)))
    slope = size * torch.tensor([1.0, -5.0, 0.1, 2.0, 3.0, 4.0])
    first, second = path(domain, slope, Adam(step_size=0.25), 2)
    move = second - first
    assert torch.equal(first, domain.start)
    assert move[:4].tolist() == pytest.approx([0.025, -0.025, 0.05, 0.05], abs=1e-6)
    assert float(move[4:].norm()) == pytest.approx(0.05, abs=1e-6)
    assert float(move[5] / move[4]) == pytest.approx(4 / 3, abs=1e-4)


def test_the_rate_falls_in_a_line() -> None:
    domain = Domain(torch.full((2,), 0.5), (Block(2),))

    def evaluate(query: Query) -> Evaluation:
        return Evaluation(0.0, torch.ones(2) if query.gradient else None, False)

    history = search(partial(map, evaluate), domain, Adam(step_size=0.4), steps=10, seed=0, candidates=0).history
    assert [r.step_size for r in history] == pytest.approx([0.4 * (1 - k / 10) for k in range(10)])


@pytest.mark.parametrize("step_size", [math.nan, math.inf, -1.0, 0.0])
def test_a_step_that_is_no_positive_number_is_refused(step_size: float) -> None:
    with pytest.raises(InputError, match="step_size"):
        make_policy("adam", step_size=step_size)
