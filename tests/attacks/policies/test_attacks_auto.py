"""The policy `auto`: PGD bit for bit on norm balls, a real search everywhere else, and never worse than random."""

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.attacks import PGD, Auto, Block, Domain, Ending, Evaluation, Query, Random, SearchResult, search
from advsearch.attacks.evaluation import Policy, limit_to_single_thread, seeded
from advsearch.attacks.policies.auto import make_plan
from advsearch.attacks.policies.surrogate import find_box_coordinates, fit_gaussian_process
from covering import once_each

POSE = (Block(3, name="position"), Block(3, periodic=True, name="rotation"))
BALL = Block(40, "linf", 0.1, name="texture")
CHOICE = Block(1, n_options=4, name="backdrop")

DOMAINS = {
    "box": (Block(2, low=0.25, high=0.75),),
    "pose": POSE,
    "choice": (CHOICE,),
    "choices and numbers": (CHOICE, Block(2), Block(1, n_options=2)),
    "many": (Block(30),),
    "texture and pose": (BALL, *POSE, CHOICE),
    "pose between balls": (Block(5, "l2", 0.2), Block(2, periodic=True), BALL),
}


def domain_of(blocks: tuple[Block, ...], cost: int = 0, free: bool = False) -> Domain:
    size = sum(block.size for block in blocks)
    return Domain(0.3 + 0.4 * torch.rand(size, generator=seeded(1, size)), blocks, cost, free)


@dataclass
class Smooth:
    """A few broad waves seen through noise, with a gradient at the price of its domain."""

    domain: Domain
    noise: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, self.domain.dim])
        self.frequency = 2 * math.pi * rng.integers(-1, 2, (20, self.domain.dim))
        self.phase = rng.uniform(0, 2 * math.pi, 20)
        self.asked: list[bool | str] = []
        self.seen: list[Tensor] = []

    def value(self, u: Tensor) -> float:
        return float(np.cos(self.frequency @ u.double().numpy() + self.phase).sum()) / math.sqrt(10)

    def __call__(self, query: Query) -> Evaluation:
        u, gradient = query.u, query.gradient
        assert self.domain.contains(u)
        assert u.dtype == torch.float32
        self.asked.append(gradient)
        self.seen.append(u.clone())
        rng = np.random.default_rng([self.seed, query.row_index, zlib.crc32(u.numpy().tobytes())])
        value = self.value(u) + self.noise * rng.normal()
        slope = None
        if gradient:
            sine = np.sin(self.frequency @ u.double().numpy() + self.phase)
            slope = torch.tensor(-sine @ self.frequency, dtype=torch.float32)
        cost = 1 + (self.domain.gradient_cost if gradient is True else 0)
        return Evaluation(value, slope, value > 0, cost=cost)


def played(domain: Domain, policy: Policy[Any], steps: int, seed: int = 0) -> tuple[SearchResult, Smooth]:
    problem = Smooth(domain)
    return search(partial(map, problem), domain, policy, steps=steps, seed=seed), problem


@once_each("blocks, seed", [(BALL,), (Block(30, "l2", 0.4),), (BALL, Block(7, "l2", 0.1))], [0, 1])
def test_norm_balls_alone_are_pgd_bit_for_bit(blocks: tuple[Block, ...], seed: int) -> None:
    domain = domain_of(blocks)
    ours, first = played(domain, Auto(), 25, seed)
    theirs, second = played(domain, PGD(), 25, seed)
    assert torch.equal(torch.stack(first.seen), torch.stack(second.seen))
    assert first.asked == second.asked
    assert torch.equal(ours.best_u, theirs.best_u)
    assert [r.step_size for r in ours.history] == [r.step_size for r in theirs.history]


@once_each("name, price, steps", DOMAINS, [(0, False), (12, False), (12, True)], [1, 2, 3, 7, 40])
def test_it_stays_inside_and_spends_its_budget_exactly(name: str, price: tuple[int, bool], steps: int) -> None:
    """`Smooth` itself checks that every configuration lies in the domain."""
    cost, free = price
    result, problem = played(domain_of(DOMAINS[name], cost, free), Auto(), steps)
    assert result.stopped is Ending.BUDGET_SPENT
    assert result.history[-1].renders == steps
    assert torch.equal(problem.seen[0], problem.domain.start)
    if cost == 12:
        ball = "ball" in name or "texture" in name
        assert set(problem.asked) <= {False, "free" if ball and free else True}


def test_a_texture_beside_a_pose_takes_free_gradients_where_there_are_some() -> None:
    for cost, free, wanted in ((12, True, "free"), (12, False, True), (0, True, True)):
        domain = domain_of((BALL, *POSE), cost, free)
        plan = make_plan(domain, find_box_coordinates(domain), 40)
        assert (plan.screen, plan.ascent_start, plan.gradient) == (10, 20, wanted)
    result, problem = played(domain_of((BALL, *POSE), 12, True), Auto(), 40)
    balls = torch.stack(problem.seen)[:, :40]
    assert bool((balls[:20] == problem.domain.start[:40]).all())
    assert result.gradients == 19
    moved = torch.stack(problem.seen)[20:40, 40:]
    assert len({tuple(x) for x in moved.tolist()}) > 5


@pytest.mark.medium
def test_an_angle_is_searched_across_its_seam() -> None:
    """A peak of width 0.03 on the seam, whose both sides are equally good."""
    domain = Domain(torch.tensor([0.5, 0.5]), (Block(1, periodic=True), Block(1)), 10**6)

    def value(u: Tensor) -> float:
        distance = min(float(u[0]), 1.0 - float(u[0]))
        return math.exp(-((distance / 0.15) ** 2)) - (float(u[1]) - 0.5) ** 2

    sides, reached = set(), []
    for seed in range(4):

        def evaluate(query: Query) -> Evaluation:
            sides.add(float(query.u[0]) < 0.5) if value(query.u) > 0.9 else None
            return Evaluation(value(query.u), None, False)

        reached.append(value(search(partial(map, evaluate), domain, Auto(), steps=40, seed=seed).best_u))
    assert min(reached) > 0.97
    assert sides == {True, False}


def test_the_surrogate_predicts_what_it_has_not_seen_and_averages_noise() -> None:
    box = find_box_coordinates(domain_of((Block(2),)))
    x = box.sample_screen(3, 60)
    y = torch.sin(5 * x[:, 0]) + 0.2 * torch.randn(60, generator=seeded(0, 0))
    with limit_to_single_thread():
        surrogate = fit_gaussian_process(box, x, y)
    new = box.sample_screen(4, 200)
    mean, deviation = surrogate.predict(new)
    error = (mean - torch.sin(5 * new[:, 0])).square().mean().sqrt()
    assert float(error) < 0.12  # well under the noise of 0.2
    assert float(surrogate.scales.lengths[1]) > float(surrogate.scales.lengths[0])  # the second number does nothing
    assert float((mean - torch.sin(5 * new[:, 0])).abs().div(deviation).mean()) < 2.0


def waves(rng: np.random.Generator, d: int, length: float) -> Callable[[np.ndarray], float]:
    """A random smooth function of unit variance: a sum of random Fourier features with that correlation length."""
    w, b, a = rng.normal(size=(100, d)) / length, rng.uniform(0, 2 * np.pi, 100), rng.normal(size=100)
    return lambda x: float(math.sqrt(0.02) * np.cos(w @ x + b) @ a)


def peak(rng: np.random.Generator, d: int) -> Callable[[np.ndarray], float]:
    centre = rng.uniform(0.1, 0.9, d)
    return lambda x: -6.0 * float(np.square(x - centre).sum()) / math.sqrt(d)


def hills(rng: np.random.Generator, d: int) -> Callable[[np.ndarray], float]:
    centres, heights = rng.uniform(0.1, 0.9, (6, d)), rng.uniform(1.6, 4.0, 6)
    return lambda x: float((heights * np.exp(-np.square(centres - x).sum(1) / (0.1 * d))).max())


FUNCTIONS: dict[str, Callable[[np.random.Generator, int], Callable[[np.ndarray], float]]] = {
    "peak": peak,
    "hills": hills,
    "broad waves": lambda rng, d: waves(rng, d, 0.35 * math.sqrt(d)),
    "pixel-scale roughness": lambda rng, d: waves(rng, d, 0.03 * math.sqrt(d)),
}


def gap(kind: str, d: int, seed: int, noise: float = 0.3) -> float:
    """How much better, without noise, the answer of auto is than that of random search, both at 40 renders."""
    function = FUNCTIONS[kind](np.random.default_rng([seed, d]), d)
    domain = Domain(torch.full((d,), 0.45), (Block(d),), gradient_cost=2 * d)

    def reached(policy: Policy[Any]) -> float:
        def evaluate(query: Query) -> Evaluation:
            rng = np.random.default_rng([seed, query.row_index, zlib.crc32(query.u.numpy().tobytes())])
            value = function(query.u.double().numpy()) + noise * rng.normal()
            return Evaluation(value, None, value > 0)

        return function(search(partial(map, evaluate), domain, policy, steps=40, seed=seed).best_u.double().numpy())

    return reached(Auto()) - reached(Random())


@pytest.mark.medium
@pytest.mark.parametrize("kind", FUNCTIONS)
def test_it_beats_random_search_at_equal_renders(kind: str) -> None:
    """The mean gap of 12 searches is over zero. Over 120 searches it is 0.20, 0.27, 0.44 and 0.62 in the order of
    `FUNCTIONS` (in about one standard deviation of the function): 2.8 to 3.5 standard errors of a mean of 12."""
    gaps = [gap(kind, d, seed) for d in (2, 6) for seed in range(6)]
    assert sum(gaps) / len(gaps) > 0.0
