"""Adam (Kingma and Ba 2015) as gradient ascent, projected onto the domain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.extend import policies


@dataclass(frozen=True)
class Adam(policies.AscentPolicy):
    """Adam (Kingma and Ba 2015, algorithm 1) uphill, projected onto the domain after
    every step:

        m <- beta1 m + (1 - beta1) g,   v <- beta2 v + (1 - beta2) g^2
        u <- P(u + rate * scale * m' / (sqrt(v') + tiny))
        m' = m / (1 - beta1^t),   v' = v / (1 - beta2^t)

    `scale` is half of each number's range (in a ball, of the part of it inside the
    ball), so that a step means the same in every block. The rate falls linearly from
    `step_size` to a twentieth of it over the planned evaluations. Two things differ
    from the paper. beta2 is 0.9 by default, since a search has tens of steps and not
    thousands. In an l2 ball g^2 is the mean over the block, since there the best step
    for a constant gradient is along the gradient and not along its signs.

    g is clipped first (see `pgd.clip_gradient`). After an evaluation without a
    gradient, the step follows m. After an objective that could not be computed, the
    search returns to its best configuration, with m = v = 0 and half the rate. As long
    as all gradients are zero, steps are random; after five of these in a row there is
    nothing more to propose.

    Attributes:
        step_size: the first rate, over 0, at most 2.
        beta1, beta2: decay of the means of gradients and of their squares, in [0, 1).
    """

    step_size: float = 0.3
    beta1: float = 0.8
    beta2: float = 0.9

    name: ClassVar[str] = "adam"

    def __post_init__(self) -> None:
        """Check that all settings are within their limits."""
        if not 0.0 < self.step_size <= 2.0:
            raise self.make_range_error(
                "step_size", "(0, 2], in units of half the range", example=0.3
            )
        for beta in ("beta1", "beta2"):
            if not 0.0 <= getattr(self, beta) < 1.0:
                raise self.make_range_error(beta, "[0, 1)", example=0.9)

    def start(
        self, domain: policies.Domain, generator: torch.Generator, steps: int
    ) -> policies.Ascent:
        """Start at the domain's initial point, with means of zero."""
        # every step needs a gradient, which costs renders too
        steps = max(1, steps // (1 + domain.gradient_cost))
        return policies.Ascent(
            domain,
            steps,
            policies.draw_seed(generator),
            u=domain.initial_point,
            direction=torch.zeros_like(domain.start),
            step_size=self.step_size,
        )

    def compute_step_size(self, state: policies.Ascent) -> float:
        return state.decay_step_size(state.n_evaluations)

    def retreat(self, state: policies.Ascent) -> policies.Ascent:
        """Go back to the best configuration (`peak`), or to the initial point if none.

        The accumulated gradients are set to zero.
        """
        u = state.domain.initial_point if state.peak is None else state.peak.u
        return replace(
            state,
            u=u,
            direction=torch.zeros_like(u),
            mean_square=policies.NO_SQUARES,  # a zero; the next gradient makes it (d,)
            n_updates=0,
        )

    def accumulate_gradient(
        self, state: policies.Ascent, gradient: Tensor
    ) -> policies.Ascent:
        """Add a gradient to the decayed means of gradients and of their squares.

        In an l2 block the square of each element is the mean over the block: there the
        best step is along the gradient and not along its signs.
        """
        squares = gradient.square()
        for block, part in state.domain.list_block_slices():
            if block.norm == "l2":
                squares[part] = squares[part].mean()
        # beta m + (1 - beta) g
        mean = torch.lerp(gradient, state.direction, self.beta1)
        return replace(
            state,
            direction=mean,
            mean_square=torch.lerp(squares, state.mean_square, self.beta2),
        )

    def take_step(
        self, state: policies.Ascent, u: Tensor, objective: float
    ) -> policies.Ascent:
        """Take a step along the mean gradient divided by its root mean square.

        As long as there is no gradient, each element goes up or down at random.

        Args:
            state: state of the ascent.
            u: (d,) the latest configuration.
            objective: its objective, which Adam does not use.
        """
        direction = self._compute_direction(state)
        latest_index = state.n_evaluations - 1  # index of the latest evaluation
        rate = state.decay_step_size(latest_index)
        half_widths = policies.compute_half_widths(state.domain)
        u = torch.addcmul(u, half_widths, direction, value=rate)
        return replace(state, u=state.domain.project(u))

    def _compute_direction(self, state: policies.Ascent) -> Tensor:
        """Return the direction (d,) of a step, of about 1 in each element."""
        has_gradient = state.n_updates > 0
        if has_gradient:
            # m' and v', without the bias of means that began at zero
            mean = state.direction / (1.0 - self.beta1**state.n_updates)
            mean_square = state.mean_square / (1.0 - self.beta2**state.n_updates)
            return mean / mean_square.sqrt_().clamp_(min=1e-30)
        generator = policies.seeded(state.seed, state.n_evaluations)
        noise = torch.randn(state.u.numel(), generator=generator)
        return noise.sign_()
