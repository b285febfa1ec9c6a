"""Natural evolution strategy with independent elements: follows the gradient of the expected objective."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.attacks.domain import Distribution, Domain, half_widths, wraps
from advsearch.attacks.policies.base import Evaluated, Policy, Proposal, draw_seed, seeded
from advsearch.errors import InputError

NARROWEST, WIDEST = 1e-4, 2.0
"""Bounds of the deviations, in half ranges."""


@dataclass(frozen=True, eq=False)
class NESState:
    """Where the search stands. Samples are drawn again from their seeds, not kept.

    Attributes:
        scale: (d,) half range of each element.
        wraps: (d,) whether leaving the bounds is coming round.
        mean: (d,) of the distribution, in u.
        deviation: (d,) of the distribution, in units of `scale`.
        population: samples a generation, even.
        generation: number of this one.
        values: objectives of its samples so far.
    """

    domain: Domain
    seed: int
    scale: Tensor
    wraps: Tensor
    mean: Tensor
    deviation: Tensor
    population: int
    generation: int = 0
    values: tuple[float, ...] = ()


@dataclass(frozen=True)
class NES(Policy[NESState]):
    """Separable natural evolution strategy (SNES; Wierstra, Schaul, Glasmachers, Sun, Peters and Schmidhuber 2014,
    "Natural evolution strategies", algorithm 6).

    The distribution is normal with independent elements, projected onto the domain. Each generation draws n samples
    u_k = P(mean + deviation * s_k), ranks them, and steps along the natural gradient of the expected utility:

        mean      <- P(mean + deviation * sum_k w_k s_k)
        deviation <- deviation * exp(rate / 2 * sum_k w_k (s_k^2 - 1))

    with w_k = max(0, ln(n/2 + 1) - ln(rank_k)) normalised to the sum 1, less 1/n, and rate = (3 + ln d) / (5 sqrt d).
    We depart from it in that samples come in pairs s and -s, and equal objectives share their weights.

    Its answer is the distribution, beside the best configuration met: a set of configurations that are bad on average.
    Memory and time a render are a few vectors of the domain's size, so it takes textures too; but it needs twenty to a
    hundred renders for each number.

    Attributes:
        sigma: first standard deviation in units of half of each number's range (half of what the ball leaves), over 0,
            at most 2.
        population: samples a generation, even, at least 4; 0 for 4 + 3 ln d, rounded up to even.

    Raises:
        InputError: a value is outside what is said here.
    """

    sigma: float = 0.3
    population: int = 0

    name: ClassVar[str] = "nes"
    uses_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not 0.0 < self.sigma <= 2.0:
            raise InputError(f"sigma: expected a number in (0, 2], a share of half the range, got {self.sigma}")
        if self.population and (self.population < 4 or self.population % 2):
            raise InputError(f"population: expected an even number of at least 4, or 0, got {self.population}")

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> NESState:
        default = 4 + int(3 * math.log(domain.dim))
        return NESState(
            domain=domain,
            seed=draw_seed(generator),
            scale=half_widths(domain),
            wraps=wraps(domain),
            mean=domain.begin,
            deviation=torch.full_like(domain.start, self.sigma),
            population=self.population or default + default % 2,
        )

    def propose(self, state: NESState, n: int) -> tuple[tuple[Proposal, ...], NESState]:
        numbers = range(len(state.values), min(len(state.values) + n, state.population))
        moves = (state.scale * state.deviation * _noise(state, number) for number in numbers)
        return tuple(Proposal(state.domain.project(state.mean + move)) for move in moves), state

    def update(self, state: NESState, evaluated: Evaluated) -> NESState:
        state = replace(state, values=(*state.values, *(evaluation.objective for _, evaluation in evaluated)))
        return state if len(state.values) < state.population else _learn(state)

    def answer(self, state: NESState) -> Distribution:
        return Distribution(state.mean, state.scale * state.deviation)


def _noise(state: NESState, number: int) -> Tensor:
    """Return sample `number` of the generation, (d,) standard normal; odd ones mirror the one before."""
    pair, mirrored = divmod(number, 2)
    generator = seeded(state.seed, state.generation * (state.population // 2) + pair)
    noise = torch.randn(state.domain.dim, generator=generator)
    return noise.neg_() if mirrored else noise


def utilities(values: Sequence[float]) -> list[float]:
    """Return weights that sum to zero, larger for larger objectives; equal objectives share theirs."""
    n = len(values)
    by_rank = [max(0.0, math.log(n / 2 + 1) - math.log(rank)) for rank in range(1, n + 1)]
    total = math.fsum(by_rank)
    ranked = sorted(values, reverse=True)
    weight = {}
    for value in set(values):
        first, count = ranked.index(value), ranked.count(value)
        weight[value] = math.fsum(by_rank[first : first + count]) / count / total - 1.0 / n
    return [weight[value] for value in values]


def _learn(state: NESState) -> NESState:
    """Move the distribution after a whole generation."""
    weights = utilities(state.values)
    d = state.domain.dim
    towards, wider = torch.zeros(d), torch.zeros(d)
    for first in range(0, state.population, 2):
        noise = _noise(state, first)
        towards.add_(noise, alpha=weights[first] - weights[first + 1])
        wider.addcmul_(noise, noise, value=weights[first] + weights[first + 1])
    rate = (3.0 + math.log(d)) / (5.0 * math.sqrt(d))  # weights sum to zero, so the -1 of every term drops out
    deviation = (state.deviation * wider.mul_(rate / 2.0).exp_()).clamp_(NARROWEST, WIDEST)
    mean = state.domain.project(state.mean + state.scale * state.deviation * towards)
    return replace(state, mean=mean, deviation=deviation, generation=state.generation + 1, values=())
