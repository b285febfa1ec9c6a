"""Policies and objectives at the ends of arithmetic: huge logits, ties, random predictions, and any unit."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import (
    Block,
    Domain,
    Ending,
    Evaluation,
    Query,
    SearchResult,
    make_policy,
    search,
    verify,
)
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.controls.base import Parameter
from advsearch.controls.ranges import Range, parse_spec
from advsearch.files import JsonObject
from advsearch.tasks import Judgement, Prediction

LABELS, IMAGE = (0,), torch.zeros(1, 2, 2, 3)
STEPS, LONG = 40, 10_000
"""Difference in logits that single precision may make: a thousandth of what noise moves a margin by."""
FORMS = {name: kind.plain for name, kind in OBJECTIVE_KINDS.items() if kind.plain is not None}
"""Every objective of logits."""
WITH_OPTIONS: dict[str, JsonObject] = {
    "restarts": {"policy": "pgd", "times": 2},
    "portfolio": {"policies": ["pgd", "cmaes"]},
}


def found(evaluate: Callable[[Query], Evaluation], domain: Domain, name: str, **options: Any) -> SearchResult:
    policy = make_policy(name, **WITH_OPTIONS.get(name, {}))
    return search(partial(map, evaluate), domain, policy, **{"steps": STEPS, "seed": 1, **options})


def box(*start: float) -> Domain:
    return Domain(torch.tensor(start), tuple(Block(1, name=f"number {i}") for i in range(len(start))))


# ---- what a model may answer ----------------------------------------------------------------------------------------


def differentiated(row: Sequence[float], objective: Any, dtype: torch.dtype) -> tuple[float, Tensor]:
    at = torch.tensor([row]).to(dtype).requires_grad_()
    value = objective(at, IMAGE, LABELS)[0]
    (slope,) = torch.autograd.grad(value, at)
    return float(value.detach()), slope[0]


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize(
    ("row", "same"),
    [
        # logits themselves are no more exact than the distance of neighbouring 32-bit numbers at 10,000
        *(
            ([1e4, -1e4, 0.0, 5e3], 2.0**-10),
            ([-1e4, 1e4, 9e3, 0.0], 2.0**-10),
            ([1e4, 9999.0, 9998.0, -1e4], 2.0**-10),
        ),
        *(([1.0, 1.0, 0.0, -1.0], 1e-5), ([2.0, 2.0, 2.0, 2.0], 1e-5), ([0.0, 3.0, 3.0, 3.0], 1e-5)),
        *(([200.0, -200.0, 0.0, -300.0], 1e-5), ([-200.0, 200.0, 0.0, -300.0], 1e-5)),
    ],
)
def test_objectives_of_huge_and_tied_logits_are_as_in_double_precision(
    name: str, row: list[float], same: float
) -> None:
    value, slope = differentiated(row, FORMS[name], torch.float32)
    exact, wanted = differentiated(row, FORMS[name], torch.float64)
    assert math.isfinite(value) and torch.isfinite(slope).all() and slope.any()
    assert abs(value - exact) <= same * max(1.0, abs(exact))
    assert (slope - wanted).abs().max() <= same * wanted.abs().max()


@pytest.mark.medium
@pytest.mark.parametrize("rate", [0.1, 0.5, 0.9])
def test_what_a_search_claims_of_random_predictions_is_never_verified(rate: float) -> None:
    domain = box(0.5, 0.5)
    for run in range(100):

        def margin(seed: int) -> float:
            return float(torch.rand(1, generator=torch.Generator().manual_seed(seed))) - (1.0 - rate)

        def noisy(query: Query) -> Evaluation:
            value = margin(query.seed)
            return Evaluation(value, None, value > 0.0)

        def trial(query: Query, run: int = run) -> Evaluation:
            # the picture decides, so another configuration gives another answer
            value = margin(seeds.stream(run, f"trial {query.u.tolist()}", query.seed))
            return Evaluation.from_judgement(
                Judgement(value, -value, value <= 0.0, Prediction("wrong" if value > 0.0 else "right"))
            )

        result = found(noisy, domain, "random", seed=run, render_seed=run)
        checked = verify(partial(map, trial), domain, result.best_u, spp=1, seed=run, claim=result.ending)
        assert checked.ending is not Ending.FOUND


# ---- stiff objectives -----------------------------------------------------------------------------------------------

Value = Callable[[Tensor], Tensor]
"""From (d,) float64 in [0, 1] to a number with a graph; the larger the better."""
RATIO, PEAK = 1e6, [0.63, 0.37]


@dataclass
class Toy:
    """An objective without a renderer, as a search wants it.

    Attributes:
        scale: factor on the objective, as if it were in other units.
        disturb: from a gradient (d,) and the number of its evaluation to what the policy sees.
    """

    value: Value
    domain: Domain
    scale: float = 1.0
    disturb: Callable[[Tensor, int], Tensor] = lambda slope, number: slope

    def __call__(self, query: Query) -> Evaluation:
        """Answer a query; gradients cost nothing."""
        at = query.u.detach().double().requires_grad_()
        value = self.scale * self.value(at)
        slope = None
        if query.gradient:
            (exact,) = torch.autograd.grad(value, at)
            slope = self.disturb(exact.float(), query.number)
        return Evaluation(float(value.detach()), slope, False, cost=query.samples)

    def search(self, policy: str, steps: int, seed: int = 0) -> tuple[SearchResult, Tensor]:
        """Search, and return the result and the configurations (n, d) that were evaluated."""
        tried: list[Tensor] = []

        def note(record: object, u: Tensor, evaluation: object) -> None:
            tried.append(u)

        made = make_policy(policy)
        result = search(partial(map, self), self.domain, made, steps=steps, seed=seed, candidates=0, on_step=note)
        return result, torch.stack(tried)


def box_domain(start: Sequence[float]) -> Domain:
    """Return a box in which every number is a block of its own, as parameters of controls are."""
    return Domain(torch.tensor(start), tuple(Block(1, name=f"number {i}") for i in range(len(start))))


def unequal(peak: Sequence[float], curvatures: Sequence[float]) -> Value:
    """Return minus half the sum of curvature x squared distance from the peak."""
    middle, weights = torch.tensor(peak, dtype=torch.float64), torch.tensor(curvatures, dtype=torch.float64)
    return lambda u: -0.5 * (weights * (u - middle).square()).sum()


def evaluations(name: str, curvatures: Sequence[float], scale: float) -> float:
    """Until every number is within .01 of the peak, a mean over seeds; infinite if one never is. `scale` is a factor on
    the first number's derivative."""
    counts = []
    for seed in range(5):
        toy = Toy(
            unequal(PEAK, curvatures), box_domain([0.15, 0.9]), disturb=lambda g, _: g * torch.tensor([scale, 1.0])
        )
        near = ((toy.search(name, steps=100, seed=seed)[1] - torch.tensor(PEAK)).abs().amax(dim=1) <= 0.01).nonzero()
        counts.append(float(near[0]) + 1.0 if len(near) else math.inf)
    return statistics.fmean(counts)


@pytest.mark.parametrize("name", ["pgd", "adam"])
@pytest.mark.parametrize(
    ("curvatures", "scale"),
    [([RATIO, 1.0], 1.0), ([1.0, RATIO], 1.0), ([1.0, 1.0], RATIO), ([1.0, 1.0], 1.0 / RATIO)],
)
def test_curvatures_and_derivatives_that_differ_by_a_million_take_no_more_evaluations(
    name: str, curvatures: list[float], scale: float
) -> None:
    assert evaluations(name, curvatures, scale) <= 1.5 * evaluations(name, [1.0, 1.0], 1.0)


# ---- units ----------------------------------------------------------------------------------------------------------


def same_path(toys: Sequence[Toy], *policies: str) -> None:
    """One problem in other units: each policy goes through the same configurations, but for rounding."""
    for name in policies:
        first, *others = (toy.search(name, steps=60)[1] for toy in toys)
        assert all(float((tried - first).abs().max()) <= 1e-5 for tried in others), name


def lamp_and_rotation(watt: float, degree: float) -> Toy:
    """An objective of a power and an angle in other units; the ranges are read and mapped as those of any control."""
    power = Parameter("power", (), "W", 0.0, 12.0 * watt, 1.0 * watt, "")
    angle = Parameter("angle", (), "degrees", 0.0, 90.0 * degree, 10.0 * degree, "")
    specs = [parse_spec(one.name, one, [one.low, one.high]) for one in (power, angle)]  # as --control would
    ranges = [spec for spec in specs if isinstance(spec, Range)]

    def value(u: Tensor) -> Tensor:
        watts = ranges[0].interpolate(u[0]) / watt
        degrees = ranges[1].interpolate(u[1]) / degree
        return -((watts - 7.3) ** 2) - 0.01 * (degrees - 33.0 - 2.0 * watts) ** 2

    return Toy(value, box_domain([ranges[0].find_coordinate(watt), ranges[1].find_coordinate(10.0 * degree)]))


@pytest.mark.medium
def test_a_search_in_milliwatts_and_radians_goes_the_way_of_one_in_watts_and_degrees() -> None:
    toys = [lamp_and_rotation(*units) for units in ((1.0, 1.0), (1e3, math.pi / 180.0), (1e-6, 3600.0))]
    same_path(toys, "pgd", "adam", "cmaes", "auto", "nes", "sobol")


@pytest.mark.medium
def test_a_search_of_the_objective_times_a_million_goes_the_same_way() -> None:
    toys = [Toy(unequal([0.7, 0.4], [1.0, 30.0]), box_domain([0.1, 0.9]), scale) for scale in (1.0, 1e-6, 1e6)]
    same_path(toys, "pgd", "adam", "cmaes", "nes", "auto")
