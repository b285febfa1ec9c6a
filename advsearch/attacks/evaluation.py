"""What one render of one configuration tells a search: the only thing that passes from a scene to a policy."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import torch
from torch import Tensor

from advsearch.tasks import Judgement

Wanted = bool | Literal["free"]
"""Which derivative is wanted: none, all of it, or only what costs no extra render, with zeros elsewhere."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One configuration, rendered once and judged.

    Attributes:
        objective: what is maximised; a noisy number, because a render is.
        gradient: (d,) float32 derivative of the objective with respect to u, or None where it was not asked for.
        success: the model's answer is what is sought, by the task. Never derived from the objective.
        non_finite: gradient elements that were NaN or infinite and were set to zero where they arose.
        cost: pictures that were rendered for it, at least 1: one, and those that differences took, each times
            `samples`. An adjoint is not a picture and counts 0; `SearchResult.gradients` counts it.
        judgement: what the task says of it, for the log; None where there is no task. No policy looks at it.
    """

    objective: float
    gradient: Tensor | None
    success: bool
    non_finite: int = 0
    cost: int = 1
    judgement: Judgement | None = None

    @property
    def finite(self) -> bool:
        """Whether the objective is a number that can be compared."""
        return math.isfinite(self.objective)


class Evaluate(Protocol):
    """Renders a configuration and judges it; supplied by whoever owns the scene."""

    def __call__(self, u: Tensor, *, index: int, gradient: Wanted, samples: int = 1) -> Evaluation:
        """Evaluate u.

        Args:
            u: (d,) float32 in [0, 1]; must not be written to.
            index: which of the search's seeds to render with. Equal indices mean equal seeds, others independent
                ones.
            gradient: whether the derivative is wanted. "free" only ever comes where the domain has
                `partial_gradients`.
            samples: how many times the search's own samples per pixel to render with, at least 1. The evaluation
                costs as many times its renders: samples * (1 + gradient_cost) with a gradient, samples without. Only
                passed where it is not 1, so an evaluation that no policy asks for more need not know it.
        """
        ...


def usable(evaluation: Evaluation) -> Evaluation:
    """Return the evaluation as policies may see it: every number in it can be computed with.

    The rule, the same for every policy:

    - gradient elements that are NaN or infinite become zero and are added to `non_finite`;
    - an objective that is NaN or infinite becomes -inf ("the worst there is"), its gradient zero and its success
      false.

    Args:
        evaluation: as it came from the renderer and the model.

    Returns:
        The same object where nothing was wrong.
    """
    gradient, bad = evaluation.gradient, 0
    if gradient is not None and not math.isfinite(float(gradient.sum(dtype=torch.float64))):
        bad = int((~torch.isfinite(gradient)).sum())
        gradient = torch.nan_to_num(gradient, nan=0.0, posinf=0.0, neginf=0.0)
    if not evaluation.finite:
        zero = None if gradient is None else torch.zeros_like(gradient)
        return replace(
            evaluation,
            objective=-math.inf,
            gradient=zero,
            success=False,
            non_finite=evaluation.non_finite + bad,
        )
    if bad:
        return replace(evaluation, gradient=gradient, non_finite=evaluation.non_finite + bad)
    return evaluation
