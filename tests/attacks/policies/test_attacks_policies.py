"""Policies on objectives with a known optimum, and one battery that every registered policy must pass."""

import math
import pickle
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch import attacks
from advsearch.attacks import (
    PGD,
    POLICIES,
    Block,
    Domain,
    Ending,
    Evaluate,
    Evaluation,
    Policy,
    Query,
    get_objective,
    make_policy,
    policies,
    search,
)
from advsearch.attacks.evaluation import seeded
from advsearch.attacks.objectives import OBJECTIVES
from advsearch.catalog import list_built_ins
from advsearch.errors import InputError
from covering import once_each

RATIO = 1.05  # an optimum counts as reached within this factor (STYLE, and the figure of adversarial-library)
STEPS = 60
DIMS = (2, 30, 1000)


@dataclass(frozen=True)
class Problem:
    """A closed-form objective, zero at the start, whose largest value on its domain is known."""

    domain: Domain
    value: Callable[[Tensor], float]
    gradient: Callable[[Tensor], Tensor]
    optimum: float

    def evaluator(self, seed: int = 0, noise: float = 0.0) -> Evaluate:
        """Evaluate with gaussian noise: on the value, of `noise` x 5 % of the optimum; on every gradient element, of
        `noise` x the gradient's root mean square (so with noise 1 half of the gradient's energy is noise)."""

        def evaluate(query: Query) -> Evaluation:
            rng = seeded(seed, query.row_index)
            exact = self.gradient(query.u)
            rough = exact + noise * exact.square().mean().sqrt() * torch.randn(exact.shape, generator=rng)
            value = self.value(query.u) + noise * 0.05 * self.optimum * float(torch.randn(1, generator=rng))
            return Evaluation(value, rough if query.gradient else None, value > 0)

        return partial(map, evaluate)


def domain_of(start: Tensor, norm: str) -> Domain:
    d = start.numel()
    epsilon = {"linf": 0.1, "l2": 0.1 * math.sqrt(d), "box": None}[norm]
    return Domain(start, (Block(d, norm, epsilon),))  # type: ignore[arg-type]


def linear(d: int, norm: str, seed: int) -> Problem:
    """w.(u - start); the start is uniform in the box, so that the box cuts the ball. The optimum is a corner of a box,
    or the point where an l2 ball's surface, cut by the box, touches a plane (the projection of a point far along w)."""
    rng = seeded(seed, d)
    start, w = torch.rand(d, generator=rng), torch.randn(d, generator=rng)
    domain = domain_of(start, norm)
    best = (
        domain.project(start + 1e4 * w)
        if norm == "l2"
        else torch.where(w > 0, domain.upper_bounds, domain.lower_bounds)
    )

    def value(u: Tensor) -> float:
        return float((w.double() * (u - start).double()).sum())

    return Problem(domain, value, lambda u: w, value(best))


def quadratic(d: int, norm: str, seed: int, *, inside: bool) -> Problem:
    """A concave quadratic with curvatures from 1 to 8 and its peak inside the domain or outside. For a box the optimum
    is the clipped peak; for an l2 ball it is found by exact projected gradient steps, run until they stand still."""
    rng = seeded(seed, d)
    start = torch.rand(d, generator=rng) * 0.6 + 0.2
    domain = domain_of(start, norm)
    curvature = torch.linspace(0.0, math.log(8.0), d).exp()
    offset = torch.randn(d, generator=rng) * {"linf": 0.1, "l2": 0.1, "box": 0.5}[norm]
    peak = domain.project(start + 0.5 * offset) if inside else start + 3.0 * offset

    def value(u: Tensor) -> float:
        energy = curvature.double() * ((start - peak).double().square() - (u - peak).double().square())
        return 0.5 * float(energy.sum())

    best = domain.project(peak)
    if norm == "l2" and not inside:
        for _ in range(150):
            best = domain.project(best + curvature * (peak - best) / 8.0)
    return Problem(domain, value, lambda u: curvature * (peak - u), value(best))


def make_problem(kind: str, norm: str, d: int, seed: int) -> Problem:
    if kind == "linear":
        return linear(d, norm, seed)
    return quadratic(d, norm, seed, inside=kind == "peak inside")


KINDS = ("linear", "peak inside", "peak outside")
NORMS = ("linf", "l2", "box")


@once_each("kind, norm, d", KINDS, NORMS, DIMS)
def test_pgd_reaches_the_optimum(kind: str, norm: str, d: int) -> None:
    problem = make_problem(kind, norm, d, seed=1)
    result = search(problem.evaluator(), problem.domain, PGD(), steps=STEPS, seed=0)
    assert problem.value(result.best_u) <= problem.optimum * (1 + 1e-4)
    assert problem.value(result.best_u) >= problem.optimum / RATIO
    assert problem.domain.contains(result.best_u)


@once_each("kind, norm, d", KINDS, NORMS, DIMS)
def test_pgd_reaches_the_optimum_through_noise(kind: str, norm: str, d: int) -> None:
    values = []
    for seed in range(3):
        problem = make_problem(kind, norm, d, seed)
        result = search(problem.evaluator(seed, noise=0.5), problem.domain, PGD(), steps=STEPS, seed=seed)
        values.append(problem.value(result.best_u) / problem.optimum)
    assert sum(values) / 3 >= 1 / RATIO


def test_pgd_starts_at_the_start_and_steps_by_a_fraction_of_epsilon() -> None:
    problem = linear(50, "linf", seed=0)
    seen: list[Tensor] = []
    search(
        problem.evaluator(),
        problem.domain,
        PGD(step_size=0.25),
        steps=2,
        seed=0,
        candidates=0,
        on_step=lambda record, u, evaluation: seen.append(u),
    )
    assert torch.equal(seen[0], problem.domain.start)
    assert float((seen[1] - seen[0]).abs().max()) == pytest.approx(0.025, abs=1e-6)


def test_pgd_halves_its_step_when_the_objective_stalls_and_not_before() -> None:
    problem = quadratic(20, "linf", seed=0, inside=True)
    result = search(problem.evaluator(), problem.domain, PGD(), steps=STEPS, seed=0)
    sizes = [record.step_size for record in result.history]
    assert sizes[0] == PGD().step_size
    assert all(b in (a, a / 2) for a, b in pairwise(sizes))
    assert sizes[-1] <= sizes[0] / 8
    climbing = Domain(torch.zeros(4), (Block(4),))

    def evaluate(query: Query) -> Evaluation:
        return Evaluation(float(query.row_index), torch.ones(4), False)

    assert search(partial(map, evaluate), climbing, PGD(), steps=STEPS, seed=0).history[-1].step_size == PGD().step_size


def test_a_non_finite_objective_sends_pgd_back_with_half_the_step() -> None:
    wall = 0.55

    def evaluate(query: Query) -> Evaluation:
        value = float(query.u[0]) if float(query.u[0]) < wall else math.nan
        return Evaluation(value, torch.ones(1) if query.gradient else None, False)

    domain = Domain(torch.tensor([0.5]), (Block(1, "linf", 0.1),))
    result = search(partial(map, evaluate), domain, PGD(step_size=1.0, momentum=0.0), steps=STEPS, seed=0)
    assert result.stopped is Ending.BUDGET_SPENT
    assert 0 < result.non_finite_objectives < STEPS / 2
    assert float(result.best_u[0]) > 0.54


MIXED = Domain(
    torch.rand(18, generator=seeded(0, 0)),
    (Block(8, "linf", 0.1, name="texture"), Block(6, "l2", 0.2), Block(4, name="pose")),
)
FEW = Domain(torch.tensor([0.4, 0.5, 0.7]), (Block(1, "linf", 0.1), Block(1, "l2", 0.2), Block(1)))
CHOOSY = Domain(
    torch.tensor([0.1, 0.3, 0.6, 0.2, 0.7]),
    (Block(1, n_options=3), Block(1, periodic=True), Block(2, low=0.1, high=0.9), Block(1, n_options=2)),
    gradient_cost=2,
)

OPTIONS: dict[str, dict[str, Any]] = {
    "adam": {"step_size": 1.0, "beta1": 0.0, "beta2": 0.99},
    "archive": {"cells": 4, "population": 4},
    "auto": {},
    "cmaes": {"sigma": 1.0, "population": 4},
    "grid": {"points": 2},
    "mixture": {"components": 2, "even": 0.5, "population": 4},
    "nes": {"sigma": 0.1, "population": 4},
    "pgd": {"step_size": 0.5, "momentum": 0.9, "random_start": True},
    "portfolio": {"policies": ["pgd", "nes", {"name": "restarts", "policy": "adam", "times": 2}]},
    "random": {},
    "restarts": {"policy": {"name": "nes", "population": 4}, "times": 3},
    "sobol": {},
}
"""Every registered policy runs with its defaults and with these, or with `halved`."""


def halved(name: str) -> dict[str, Any]:
    """Options for a policy of which `OPTIONS` says nothing: half of each number, and switches turned."""
    given: dict[str, Any] = {}
    for one in fields(POLICIES[name]):  # type: ignore[arg-type]
        if isinstance(one.default, bool):
            given[one.name] = not one.default
        elif isinstance(one.default, (int, float)):
            given[one.name] = one.default / 2 if isinstance(one.default, float) else (one.default + 1) // 2
    return given


def every_policy() -> list[Policy[Any]]:
    made = [make_policy(name) for name in POLICIES]
    for name in POLICIES:
        options = OPTIONS.get(name, halved(name))
        try:
            made += [make_policy(name, **options)] if options else []
        except InputError as error:
            pytest.fail(f"{error}; give {name} options that it takes, not its defaults, in OPTIONS of {__file__}")
    return made


def label(policy: Any) -> str | None:
    if not isinstance(policy, Policy):
        return None
    return policy.name if policy == make_policy(policy.name) else f"{policy.name} with options"


def test_the_classes_of_all_policies_are_offered_by_their_packages() -> None:
    for part in list_built_ins("policy").values():
        name = part.import_path.rpartition(":")[2]
        assert getattr(attacks, name) is getattr(policies, name) is POLICIES[part.name]
    with pytest.raises(AttributeError, match="there is no 'Annealing', and no policy with such a class"):
        attacks.Annealing  # noqa: B018


battery = pytest.mark.parametrize("policy", every_policy(), ids=label)


def domain_for(policy: Policy[Any]) -> Domain:
    """A grid refuses what does not fit into its renders; see its own tests."""
    return FEW if policy.name == "grid" else MIXED


def classifier(d: int = 18, objective: str = "margin", nan_at: int = -1) -> Evaluate:
    """A small random network of u with four classes, seen through noise, as an `evaluate`."""
    rng = seeded(1, 1)
    first, second = torch.randn(d, 12, generator=rng), torch.randn(12, 4, generator=rng)

    def evaluate(query: Query) -> Evaluation:
        x = query.u.clone().requires_grad_(bool(query.gradient))
        noise = 0.01 / math.sqrt(query.samples) * torch.randn(d, generator=seeded(7, query.row_index))
        logits = (((x + noise) @ first).tanh() @ second)[None]
        value = get_objective(objective)(logits, torch.zeros(1, 1, 1, 3), (0, 2))[0]
        slope = torch.autograd.grad(value, x)[0] if query.gradient else None
        if slope is not None and query.row_index % 3 == 1:
            slope[query.row_index % d] = math.nan
        number = math.nan if query.row_index == nan_at else float(value.detach())
        return Evaluation(number, slope, bool(logits.argmax() % 2), cost=query.samples)

    return partial(map, evaluate)


@pytest.mark.medium
@once_each("policy, objective", every_policy(), sorted(OBJECTIVES), ids=label)
def test_the_battery(policy: Policy[Any], objective: str) -> None:
    """Stays inside, keeps dtype and shape, honours the budget, survives NaN, and repeats with its seed."""
    domain = domain_for(policy)

    def run(seed: int) -> list[Tensor]:
        seen: list[Tensor] = []

        def look(record: object, u: Tensor, evaluation: Evaluation) -> None:
            assert (u.dtype, u.shape) == (torch.float32, (domain.dim,))
            assert domain.contains(u)
            seen.append(u.clone())

        evaluate = classifier(domain.dim, objective, nan_at=4)
        result = search(evaluate, domain, policy, steps=15, seed=seed, candidates=2, repeats=2, on_step=look)
        assert result.history[-1].renders == 15 or (policy.name, result.stopped) == ("grid", Ending.STALLED)
        assert result.renders <= 15 + 2 * 2
        if policy.name != "portfolio":
            assert (result.gradients > 0) == policy.uses_gradient
        assert result.gradients == 0 or policy.uses_gradient
        assert result.non_finite_objectives == 1
        assert result.best_u.dtype == torch.float32
        assert domain.contains(result.best_u)
        assert math.isfinite(result.best_objective)
        return seen

    first, second, other = run(3), run(3), run(4)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    if policy.name in ("random", "sobol", "nes", "cmaes") or getattr(policy, "random_start", False):
        assert not torch.equal(first[0], other[0])


@once_each("policy, bad", every_policy(), [math.nan, -math.inf, math.inf], ids=label)
def test_half_of_the_domain_cannot_be_evaluated(policy: Policy[Any], bad: float) -> None:
    domain = domain_for(policy)
    inner = classifier(domain.dim)

    def evaluate(query: Query) -> Evaluation:
        (evaluation,) = inner([query])
        if float(query.u[-1]) <= float(domain.start[-1]) + 1e-3 or query.row_index % 3 == 0:
            return evaluation
        return replace(evaluation, objective=bad, gradient=query.u * math.nan if query.gradient else None)

    result = search(partial(map, evaluate), domain, policy, steps=40, seed=1, candidates=0)
    assert result.stopped in (Ending.BUDGET_SPENT, Ending.STALLED)
    assert result.non_finite_objectives < 30
    assert math.isfinite(result.best_objective)


@pytest.mark.medium
@battery
def test_choices_and_angles_are_searched_by_every_policy(policy: Policy[Any]) -> None:
    """The best option of two choices is worth more than the numbers; angles are met on both sides of their seam."""
    seen: list[Tensor] = []

    def evaluate(query: Query) -> Evaluation:
        u = query.u
        assert CHOOSY.contains(u)
        seen.append(u)
        first, second = min(2, int(u[0] * 3)), min(1, int(u[4] * 2))
        value = 2.0 * (first == 2) + (second == 0) + 0.2 * math.sin(2.0 * math.pi * float(u[1])) + 0.2 * float(u[2])
        slope = torch.tensor([0.0, 0.4 * math.pi * math.cos(2.0 * math.pi * float(u[1])), 0.2, 0.0, 0.0])
        cost = query.samples * (3 if query.gradient else 1)
        return Evaluation(value, slope if query.gradient else None, False, cost=cost)

    result = search(partial(map, evaluate), CHOOSY, policy, steps=144, seed=0, candidates=0)
    assert (int(result.best_u[0] * 3), int(result.best_u[4] * 2)) == (2, 0)
    assert {(int(u[0] * 3), int(u[4] * 2)) for u in seen} == {(a, b) for a in range(3) for b in range(2)}
    assert result.best_objective > 3.1


@battery
def test_states_are_passed_and_not_kept(policy: Policy[Any]) -> None:
    """Going back to an old state, or to one that was pickled, replays the same future; numpy's and torch's global
    generators stand where they stood."""
    domain = domain_for(policy)
    evaluate = classifier(domain.dim)

    def play(state: object, steps: int, index: int) -> tuple[object, Tensor]:
        seen = []
        for k in range(index, index + steps):
            (proposal,), state = policy.propose(state, 1)
            seen.append(proposal.u)
            query = Query(proposal.u, k, row_index=3 * k, gradient=proposal.gradient, samples=proposal.samples)
            (evaluation,) = evaluate([query])
            state = policy.update(state, [(proposal.u, evaluation)])
        return state, torch.stack(seen)

    before = np.random.get_state(legacy=False)["state"]["key"].copy(), torch.random.get_rng_state()  # noqa: NPY002
    state: object = policy.start(domain, torch.Generator().manual_seed(0), 60)
    for middle in (3, 16):
        if policy.name == "grid" and middle == 16:
            break
        state, _ = play(state, middle, 0)
        stored = pickle.dumps(state)
        _, once = play(state, 5, 4)
        _, again = play(state, 5, 4)
        _, restored = play(pickle.loads(stored), 5, 4)
        assert torch.equal(once, again)
        assert torch.equal(once, restored)
    after = np.random.get_state(legacy=False)["state"]["key"], torch.random.get_rng_state()  # noqa: NPY002
    assert np.array_equal(before[0], after[0])
    assert torch.equal(before[1], after[1])


def test_pgd_goes_back_to_its_best_when_it_has_fallen_behind() -> None:
    """A peak that only the first steps see; then the gradient leads away from it, downhill."""

    def evaluate(query: Query) -> Evaluation:
        return Evaluation(5.0 if query.row_index == 2 else -0.1 * query.row_index, torch.ones(2), False)

    seen: list[Tensor] = []
    domain = Domain(torch.full((2,), 0.5), (Block(2, "linf", 0.4),))
    search(
        partial(map, evaluate),
        domain,
        PGD(step_size=0.125, momentum=0.0),
        steps=40,
        seed=0,
        candidates=0,
        on_step=lambda record, u, evaluation: seen.append(u),
    )
    returned = [k for k in range(3, 40) if float(seen[k][0]) < float(seen[k - 1][0]) - 1e-6]
    assert returned, "it never went back"
    assert float((seen[returned[0]] - seen[2]).abs().max()) <= 0.4 * 0.125 + 1e-6
