"""The smallest change and the region, on objectives whose answers are known."""

import math
from functools import partial
from typing import Literal

import pytest
import torch
from torch import Tensor

from advsearch.attacks import Block, Domain, Evaluation, Query, make_policy, search
from advsearch.attacks.candidates import (
    RATIO,
    Bracket,
    confirm_bracket,
    find_smallest_change,
    scale_domain,
    shrink_towards_start,
)

NORMS = {"linf": lambda w: float(w.abs().sum()), "l2": lambda w: float(w.norm())}


def linear(size: int, norm: Literal["linf", "l2"], share: float) -> tuple[Domain, Tensor, float]:
    """A linear model whose smallest flipping epsilon is `share` of the domain's: the domain, weights and bias."""
    weights = torch.randn(size, generator=torch.Generator().manual_seed(size))
    epsilon = 0.4
    bias = -share * epsilon * NORMS[norm](weights)  # dual norm: the most that an epsilon can gain
    return Domain(torch.full((size,), 0.5), (Block(size, norm, epsilon),)), weights, bias


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("size", [2, 30, 1000])
@pytest.mark.parametrize("share", [0.9, 0.3, 0.03])
def test_the_smallest_epsilon_of_a_linear_model_is_within_five_per_cent(
    norm: Literal["linf", "l2"], size: int, share: float
) -> None:
    domain, weights, bias = linear(size, norm, share)

    def value(u: Tensor) -> float:
        return float((u - domain.start) @ weights) + bias

    def evaluate(query: Query) -> Evaluation:
        return Evaluation(value(query.u), weights.clone(), value(query.u) > 0.0)

    def found(inside: Domain, number: int) -> Tensor:
        return search(partial(map, evaluate), inside, make_policy("pgd"), steps=20, seed=number).best_u

    bracket = find_smallest_change(found, lambda u, _: value(u) > 0.0, domain)
    assert bracket.u is not None and bracket.is_closed
    assert scale_domain(domain, bracket.smallest_passing_scale).contains(bracket.u) and value(bracket.u) > 0.0
    assert share <= bracket.smallest_passing_scale <= RATIO * share  # the closed form
    assert bracket.largest_failing_scale <= share
    assert bracket.searches <= 12


def test_an_end_that_passed_by_luck_moves_out_until_it_passes_again() -> None:
    domain, weights, bias = linear(5, "linf", 0.5)

    def margin(u: Tensor) -> float:
        return float((u - domain.start) @ weights) + bias

    edge = shrink_towards_start(domain, domain.start + 0.4 * weights.sign(), 0.5)
    lucky = Bracket(0.48, 0.5, edge, 3, 10)
    sure = confirm_bracket(lucky, lambda u, _: margin(u) > 0.02 * -bias, domain)
    assert 0.5 < sure.smallest_passing_scale <= 0.5 * RATIO and sure.u is not None and margin(sure.u) > 0.0
    assert scale_domain(domain, sure.smallest_passing_scale).contains(sure.u)
    assert confirm_bracket(lucky, lambda u, _: True, domain).smallest_passing_scale == 0.5
    nothing = Bracket(1.0, math.inf, None, 1, 1)
    assert confirm_bracket(nothing, lambda u, _: False, domain) is nothing


@pytest.mark.island("advsearch.questions.region")
def test_a_region_fills_the_box_in_which_the_prediction_stays() -> None:
    from advsearch.questions.region.boxes import grow_box

    low, high = torch.tensor([0.2, 0.0, 0.3]), torch.tensor([0.7, 1.0, 0.6])
    region = grow_box(lambda u, _: bool(((u >= low) & (u <= high)).all()), torch.tensor([0.5, 0.5, 0.4]), seed=1)
    assert bool((region.low >= low).all()) and bool((region.high <= high).all())
    assert region.volume > 0.8 * float((high - low).prod())
    assert region.n_same == region.samples == 200 and region.interval[0] > 0.97


@pytest.mark.island("advsearch.questions.region")
def test_a_region_in_a_disc_keeps_what_it_promises() -> None:
    from advsearch.questions.region.boxes import grow_box

    centre = torch.tensor([0.5, 0.45])
    region = grow_box(lambda u, _: float((u - 0.5).norm()) < 0.3, centre, seed=3)
    points = torch.lerp(region.low, region.high, torch.rand(20_000, 2, generator=torch.Generator().manual_seed(9)))
    share = float(((points - 0.5).norm(dim=1) < 0.3).float().mean())
    assert region.interval[0] <= share + 0.01 and share > 0.95
    assert 0.1 < region.volume < 0.2  # the largest square in the disc has 0.18
    assert bool(((centre >= region.low) & (centre <= region.high)).all())
