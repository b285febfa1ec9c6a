"""Adam with projection: the optimiser that everybody knows, in the units of a domain."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain, half_widths
from advsearch.attacks.policies.base import NO_COUNTS, Counts, Evaluated, Policy, Proposal, draw_seed, seeded
from advsearch.attacks.policies.pgd import PATIENCE, clipped
from advsearch.errors import InputError


@dataclass(frozen=True, eq=False)
class AdamState:
    """Where the ascent stands.

    Attributes:
        steps: evaluations that the renders suffice for.
        scale: (d,) half range of each element, the unit of a step.
        u: (d,) what to propose next.
        mean: (d,) decaying mean of the gradients.
        square: (d,) decaying mean of their squares.
        taken: gradients so far.
        count: evaluations so far.
        flat: evaluations in a row whose gradient was zero.
        best: the largest objective so far.
        peak: (d,) where it was met.
        lengths: of the latest gradients, as `clipped` wants them.
        counts: outliers cut and steps taken back so far.
        shrunk: what the rate is multiplied by; half of it is gone after every objective that could not be computed.
    """

    domain: Domain
    steps: int
    seed: int
    scale: Tensor
    u: Tensor
    mean: Tensor
    square: Tensor
    taken: int = 0
    count: int = 0
    flat: int = 0
    best: float = -math.inf
    peak: Tensor | None = None
    shrunk: float = 1.0
    lengths: tuple[float, ...] = ()
    counts: Counts = NO_COUNTS


@dataclass(frozen=True)
class Adam(Policy[AdamState]):
    """Adam (Kingma and Ba 2015, algorithm 1) uphill, projected onto the domain after every step:

        m <- beta1 m + (1 - beta1) g,   v <- beta2 v + (1 - beta2) g^2
        u <- P(u + rate * scale * m' / (sqrt(v') + tiny)),   m' = m / (1 - beta1^t), v' = v / (1 - beta2^t)

    `scale` is half of each number's range (half of what a ball leaves), so a step means the same in every block. The
    rate falls in a line from `step_size` to a twentieth of it over the planned evaluations. We depart from the paper in
    beta2, 0.9 by default, since a search has tens of steps and not thousands; and in an l2 ball g^2 is the mean over
    the block, since there the best step for a constant gradient is along it and not along its signs.

    g is clipped first (see `pgd`). An evaluation without a gradient goes on along m. One whose objective could not be
    computed sends the search back to its best configuration, with m = v = 0 and half the rate. While there is no
    gradient but zero the step is random; after five zero gradients in a row there is nothing more to propose.

    Attributes:
        step_size: the first rate, over 0, at most 2.
        beta1, beta2: in [0, 1).

    Raises:
        InputError: a value is outside what is said here.
    """

    step_size: float = 0.3
    beta1: float = 0.8
    beta2: float = 0.9

    name: ClassVar[str] = "adam"
    uses_gradient: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not 0.0 < self.step_size <= 2.0:
            raise InputError(
                f"step_size: expected a number in (0, 2], a share of half the range, got {self.step_size}; try 0.3"
            )
        for name, value in (("beta1", self.beta1), ("beta2", self.beta2)):
            if not 0.0 <= value < 1.0:
                raise InputError(f"{name}: expected a number in [0, 1), got {value}; try 0.9")

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> AdamState:
        steps = max(1, steps // (1 + domain.gradient_cost))
        zero = torch.zeros_like(domain.start)
        return AdamState(domain, steps, draw_seed(generator), half_widths(domain), domain.begin, zero, zero)

    def propose(self, state: AdamState, n: int) -> tuple[tuple[Proposal, ...], AdamState]:
        if state.flat >= PATIENCE:
            return (), state
        return (Proposal(state.u, gradient=True, step_size=self._rate(state)),), state

    def update(self, state: AdamState, evaluated: Evaluated) -> AdamState:
        ((u, evaluation),) = evaluated
        rate = self._rate(state)
        state = replace(state, count=state.count + 1)
        if not evaluation.finite:
            return _retreat(state)
        if evaluation.objective > state.best:
            state = replace(state, best=evaluation.objective, peak=u)
        if evaluation.gradient is not None:
            gradient, lengths, outliers = clipped(state.domain, evaluation.gradient, state.lengths)
            counts = state.counts + outliers
            state = replace(self._learn(state, gradient), lengths=lengths, counts=counts)
        return replace(state, u=state.domain.project(torch.addcmul(u, state.scale, self._way(state), value=rate)))

    def counts(self, state: AdamState) -> Counts:
        return state.counts

    def _way(self, state: AdamState) -> Tensor:
        """Return the step for the rate 1, in units of `scale`; at random as long as nothing is known."""
        if not state.taken:
            return torch.randn(state.u.numel(), generator=seeded(state.seed, state.count)).sign_()
        mean = state.mean / (1.0 - self.beta1**state.taken)
        return mean / (state.square / (1.0 - self.beta2**state.taken)).sqrt_().clamp_(min=1e-30)

    def _rate(self, state: AdamState) -> float:
        """Return the step size of this evaluation."""
        return self.step_size * state.shrunk * max(0.05, 1.0 - state.count / state.steps)

    def _learn(self, state: AdamState, gradient: Tensor) -> AdamState:
        """Add a gradient to both means."""
        if not bool(gradient.any()):
            return replace(state, flat=state.flat + 1)
        mean = torch.lerp(gradient, state.mean, self.beta1)
        squares = gradient.square()
        for block, part in state.domain.parts():
            if block.norm == "l2":
                squares[part] = squares[part].mean()
        square = torch.lerp(squares, state.square, self.beta2)
        return replace(state, mean=mean, square=square, taken=state.taken + 1, flat=0)


def _retreat(state: AdamState) -> AdamState:
    """Go back to the best configuration, or else to where the search began, and forget the gradients."""
    zero = torch.zeros_like(state.u)
    u = state.domain.begin if state.peak is None else state.peak
    counts = state.counts + Counts(rejected=1)
    return replace(state, u=u, mean=zero, square=zero, taken=0, shrunk=state.shrunk / 2, counts=counts)
