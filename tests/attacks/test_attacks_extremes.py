"""Policies and objectives at the ends of arithmetic: huge logits, ties, NaN, noise without a variance, many steps."""

import copy
import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from advsearch import seeds
from advsearch.attacks import (
    POLICIES,
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
from advsearch.attacks.evaluation import limit_to_single_thread
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.controls.base import Parameter
from advsearch.controls.ranges import Range, parse_spec
from advsearch.files import JsonObject
from advsearch.models import load_model
from advsearch.models.model import Model, Preprocessing
from advsearch.scene.color import linear_to_srgb, round_to_8_bit
from advsearch.tasks import Classification, Judgement, Prediction

LABELS, IMAGE = (0,), torch.zeros(1, 2, 2, 3)
STEPS, LONG = 40, 10_000
LOGITS = 1e-3
"""Difference in logits that single precision may make: a thousandth of what noise moves a margin by."""
FORMS = {name: kind.plain for name, kind in OBJECTIVE_KINDS.items() if kind.plain is not None}
"""Every objective of logits."""
WITH_OPTIONS: dict[str, JsonObject] = {
    "restarts": {"policy": "pgd", "times": 2},
    "portfolio": {"policies": ["pgd", "cmaes"]},
}


def differentiable(
    value: Callable[[Tensor], Tensor],
    query: Query,
    broken: Sequence[int] = (),
    disturb: Callable[[Tensor, int], Tensor] = lambda slope, number: slope,
) -> Evaluation:
    """Answer a query by a function of u (d,) float64; NaN at some numbers, and with disturbed gradients."""
    at = query.u.detach().double().requires_grad_()
    objective = value(at)
    (slope,) = torch.autograd.grad(objective, at)
    factor = math.nan if query.row_index in broken else 1.0
    shown = disturb(slope.float(), query.row_index) * factor if query.gradient else None
    number = float(objective.detach()) * factor
    return Evaluation(number, shown, number > 0.0, cost=query.samples)


def found(evaluate: Callable[[Query], Evaluation], domain: Domain, name: str, **options: Any) -> SearchResult:
    policy = make_policy(name, **WITH_OPTIONS.get(name, {}))
    return search(partial(map, evaluate), domain, policy, **{"steps": STEPS, "seed": 1, **options})


def box(*start: float) -> Domain:
    return Domain(torch.tensor(start), tuple(Block(1, name=f"number {i}") for i in range(len(start))))


def quadratic(u: Tensor) -> Tensor:
    away = (u - torch.tensor([0.7, 0.4])).square() * torch.tensor([1.0, 2.0])
    return -0.5 * away.sum() - 1.0


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


def test_tied_logits_share_the_gradient_and_a_tie_is_no_success() -> None:
    task, tied = Classification(), torch.tensor([[1.0, 1.0, 0.0, -1.0], [2.0, 2.0, 2.0, 2.0]])
    _, slope = differentiated([0.0, 3.0, 3.0, 3.0], FORMS["margin"], torch.float32)
    assert not (task.score(tied, LABELS) > 0.0).any() and all(one.right for one in task.judge(tied, LABELS))
    assert slope[1:].tolist() == pytest.approx([1.0 / 3.0] * 3)


class Certain(nn.Module):
    """Answers with probabilities that are exactly 1 and 0."""

    def forward(self, x: Tensor) -> Tensor:
        light = x.mean(dim=(1, 2, 3))
        return torch.stack([light, 0.5 - light, torch.zeros_like(light)], dim=1).mul(1e4).softmax(dim=1)


def test_a_model_of_probabilities_0_and_1_is_left_or_said_to_be_flat() -> None:
    model = Model(Certain(), "certain", ("a", "b", "c"), Preprocessing((8, 8)), probabilities=True)
    image = torch.full((8, 8, 3), 0.9, requires_grad=True)
    logits = model(image)
    (slope,) = torch.autograd.grad(FORMS["margin"](logits, IMAGE, LABELS)[0], image)
    assert set(model.module(image.permute(2, 0, 1)[None]).detach().flatten().tolist()) == {0.0, 1.0}
    assert torch.isfinite(logits).all() and torch.isfinite(slope).all()

    def light(u: Tensor) -> Tensor:
        return FORMS["margin"](model(u.float().expand(8, 8, 3)), IMAGE, LABELS)[0].double()

    flat = found(partial(differentiable, light), box(0.9), "pgd", seed=0, candidates=0)
    assert flat.ending is Ending.STALLED or float((flat.best_u - 0.9).abs().max()) > 0.1


@pytest.mark.parametrize(("steps", "ends"), [((0,), False), ((7, 8), False), ((3, 4, 5), True)])
@pytest.mark.parametrize("name", POLICIES)
def test_nan_is_counted_and_three_in_a_row_end_a_search(name: str, steps: tuple[int, ...], ends: bool) -> None:
    result = found(partial(differentiable, quadratic, broken=steps), box(0.2, 0.2), name, candidates=2, repeats=1)
    assert math.isfinite(result.best_objective) and torch.isfinite(result.best_u).all()
    assert result.non_finite_objectives == sum(record.step in steps for record in result.history)
    assert (result.ending is Ending.NON_FINITE) == ends


@pytest.mark.parametrize("name", POLICIES)
def test_nothing_is_found_in_a_model_whose_prediction_never_changes(name: str) -> None:
    result = found(partial(differentiable, lambda u: 0.0 * u.sum() - 1.0), box(0.2, 0.2), name)
    assert result.success_rate == 0.0
    assert name not in ("pgd", "adam") or result.ending is Ending.STALLED


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
            value = margin(seeds.derive_seed(run, f"trial {query.u.tolist()}", query.seed))
            return Evaluation.from_judgement(
                Judgement(value, -value, value <= 0.0, Prediction("wrong" if value > 0.0 else "right"))
            )

        result = found(noisy, domain, "random", seed=run, render_seed=run)
        checked = verify(partial(map, trial), domain, result.best_u, spp=1, seed=run, claim=result.ending)
        assert checked.ending is not Ending.FOUND


def noise(kind: str, number: int, size: int, generator: torch.Generator) -> Tensor:
    """Noise (size,) of one gradient, its median absolute value 1; a heavy tail is Pareto's with index 1.5.

    "elements": every element has a tail of its own; "lengths": gaussian, and its size has one; "spike": none, but one
    gradient that is nothing but noise, 1e12 times too large.
    """

    def heavy(count: int) -> Tensor:
        uniform = torch.rand(count, generator=generator, dtype=torch.float64).clamp_min(1e-12)
        signs = torch.randint(0, 2, (count,), generator=generator, dtype=torch.float64) * 2.0 - 1.0
        return (signs * (uniform.pow(-1.0 / 1.5) - 1.0) / 0.59).float()

    normal = torch.randn(size, generator=generator) / 0.674
    if kind == "spike":
        return 1e12 * normal if number == 20 else 0.0 * normal
    if kind == "elements":
        return heavy(size)
    return normal * float(heavy(1).abs()) if kind == "lengths" else normal


@cache
def share_of_optimum(name: str, kind: str) -> float:
    """Median over seeds of what a search in 60 numbers reaches of the largest value of a linear objective, with noise
    that is in the median twice as large as the gradient."""
    size = 60
    start = torch.full((size,), 0.5)
    domain = Domain(start, (Block(size - 1, "l2", 1.0), Block(1, name="number")))
    weights = torch.linspace(-1.0, 1.0, size).double()

    def value(u: Tensor) -> Tensor:
        return (weights * (u - 0.5)).sum()

    def disturb(slope: Tensor, number: int, seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(1000 * seed + number)
        return slope + 2.0 * slope.abs().mean() * noise(kind, number, size, generator)

    best = float(value(domain.project(start + 1e3 * weights.float()).double()))
    evaluates = [partial(differentiable, value, disturb=partial(disturb, seed=seed)) for seed in range(9)]
    reached = [found(each, domain, name, steps=100, seed=seed, candidates=0) for seed, each in enumerate(evaluates)]
    return statistics.median(result.best_objective for result in reached) / best


@pytest.mark.medium
@pytest.mark.parametrize("name", ["pgd", "adam"])
@pytest.mark.parametrize("kind", ["elements", "lengths", "spike"])
def test_heavy_tails_make_a_search_little_worse_than_gaussian_noise(kind: str, name: str) -> None:
    usual = 1.0 if kind == "spike" else share_of_optimum(name, "gaussian")
    assert usual / share_of_optimum(name, kind) <= 1.25


@pytest.mark.medium
def test_verdicts_in_single_and_double_precision_differ_only_on_the_boundary() -> None:
    """Between two pictures with different answers the boundary is found by bisection in single precision; there the two
    may disagree, and what matters is how far from the boundary they still do."""
    model = load_model("reference")
    exact: Any = copy.deepcopy(model.module)
    exact = exact.double()
    tones = torch.rand(12, 4, 4, 3, generator=torch.Generator().manual_seed(0)).permute(0, 3, 1, 2)
    large = torch.nn.functional.interpolate(tones, size=model.input_size, mode="bicubic")
    pictures = large.clamp(0.0, 1.0).permute(0, 2, 3, 1)

    def answers(images: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad(), limit_to_single_thread():
            x = model.preprocessing(images)
            return model.module(x), exact(x.double())

    first = answers(pictures)[0].argmax(dim=1)
    pairs = [(i, i + 1) for i in range(len(pictures) - 1) if first[i] != first[i + 1]]
    assert len(pairs) >= 2
    for i, j in pairs:
        low, high = pictures[i], pictures[j]
        for _ in range(24):
            middle = 0.5 * (low + high)
            same = answers(middle[None])[0].argmax() == first[i]
            low, high = (middle, high) if same else (low, middle)
        single, double = answers(torch.stack([low, high]))
        top = double.topk(2, dim=1).values
        wrong = single.argmax(dim=1) != double.argmax(dim=1)
        assert float((single.double() - double).abs().max()) <= LOGITS
        assert float(((top[:, 0] - top[:, 1]) * wrong).max()) <= LOGITS


def test_the_8_bit_picture_is_the_same_but_for_ties_and_the_model_does_not_notice() -> None:
    model = load_model("reference")
    radiance = 1.2 * torch.rand(*model.input_size, 3, generator=torch.Generator().manual_seed(1))
    single, double = round_to_8_bit(linear_to_srgb(radiance)), round_to_8_bit(linear_to_srgb(radiance.double()))
    off = ((single.double() - double) * 255.0).abs().round()
    assert float(off.max()) <= 1.0 and float((off > 0.0).double().mean()) <= 1e-4
    with torch.no_grad():
        assert float((model(single) - model(double.float())).abs().max()) <= LOGITS


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pgd", "adam"])
def test_ten_thousand_steps_stay_inside_the_budget_and_at_the_peak(name: str) -> None:
    target = torch.full((52,), 0.8).double()
    blocks = (Block(1, name="box"), Block(1, periodic=True, name="angle"), Block(50, "l2", 1.0))
    domain = Domain(torch.full((52,), 0.3), blocks)

    def value(u: Tensor) -> Tensor:
        turned = torch.cos((u[1] - target[1]) * 2.0 * math.pi)
        return turned - (u[0] - target[0]).square() - (u[2:] - target[2:]).square().mean()

    result = found(partial(differentiable, value), domain, name, steps=LONG, seed=0, candidates=0)
    assert (len(result.history), result.non_finite_objectives) == (LONG, 0)
    assert domain.violation(result.best_u) <= 2e-6
    assert float(value(domain.project(target.float()).double())) - result.best_objective <= 1e-3


@pytest.mark.medium
def test_an_angle_that_goes_round_in_small_steps_does_not_drift_and_no_two_steps_have_one_seed() -> None:
    domain = Domain(torch.zeros(1), (Block(1, periodic=True, name="angle"),))
    u, exact, step = torch.zeros(1), 0.0, 0.000_731
    for _ in range(LONG):
        u = domain.project(u + step)
        exact = (exact + step) % 1.0
    drift = abs(float(u) - exact)
    assert min(drift, 1.0 - drift) <= 1e-3
    assert len({seeds.derive_seed(0, "search", index) for index in range(LONG)}) >= LONG - 1


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
            slope = self.disturb(exact.float(), query.row_index)
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


@pytest.mark.medium
@pytest.mark.parametrize("name", ["pgd", "adam"])
@pytest.mark.parametrize(
    ("curvatures", "scale"), [([RATIO, 1.0], 1.0), ([1.0, RATIO], 1.0), ([1.0, 1.0], RATIO), ([1.0, 1.0], 1.0 / RATIO)]
)
def test_curvatures_and_derivatives_that_differ_by_a_million_take_no_more_evaluations(
    name: str, curvatures: list[float], scale: float
) -> None:
    assert evaluations(name, curvatures, scale) <= 1.5 * evaluations(name, [1.0, 1.0], 1.0)


def medians(value: Value, start: Sequence[float], steps: int, far: Callable[[SearchResult], float]) -> dict[str, float]:
    """How far each policy ends from the peak, a median over seeds."""
    toy = Toy(value, box_domain(start))
    return {
        name: statistics.median(far(toy.search(name, steps=steps, seed=seed)[0]) for seed in range(5))
        for name in ("random", "auto", "pgd", "adam", "cmaes")
    }


def valley(u: Tensor) -> Tensor:
    """Rosenbrock's curved valley (1960), turned over: 0 at its peak u = (0.75, 0.75), condition number there 2508.

    x = 4 u - 2, value = -(100 (x_2 - x_1^2)^2 + (1 - x_1)^2).
    """
    x, y = 4.0 * u[0] - 2.0, 4.0 * u[1] - 2.0
    return -(100.0 * (y - x.square()).square() + (1.0 - x).square())


@pytest.mark.island("advsearch.questions.stability")
@pytest.mark.slow
def test_policies_get_through_a_curved_valley() -> None:
    """PGD steps by signs in numbers that are blocks of their own, so it goes round the bend in small steps: it gets
    down into the valley, and no further than random search does in two dimensions."""
    from advsearch.questions.stability.scenes import condition_number, estimate_hessian

    start = [0.2, 0.75]
    gaps = medians(valley, start, 400, lambda result: -result.best_objective)
    second = estimate_hessian(
        lambda u: float(valley(u)), torch.tensor([0.75, 0.75]).double(), torch.eye(2).double(), [1e-3] * 2
    )
    assert 0.9 <= condition_number(second) / 2508.0 <= 1.1
    assert all(gaps[name] <= gaps["random"] for name in ("auto", "adam", "cmaes"))
    assert gaps["pgd"] <= -0.01 * float(valley(torch.tensor(start))) and min(gaps["auto"], gaps["cmaes"]) <= 1e-3


@pytest.mark.slow
def test_a_peak_a_thousandth_of_the_range_wide_is_found_by_what_converges(width: float = 1e-3) -> None:
    peak = torch.tensor([0.63, 0.3712]).double()

    def value(u: Tensor) -> Tensor:
        return -torch.log1p(((u - peak) / torch.tensor([1.0, width]).double()).square()).sum()

    off = medians(value, [0.2, 0.9], 150, lambda result: abs(float(result.best_u[1] - peak[1])))
    assert all(off[name] <= 3.0 * width for name in ("pgd", "adam", "cmaes"))


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
