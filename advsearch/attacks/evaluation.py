"""The one question to renderer and model, and its answer: all that passes between a scene and a search or a trial."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor

from advsearch.described import Value
from advsearch.tasks import Judgement

WhichGradient = bool | Literal["free"]
"""Which derivative is wanted: none, all of it, or only what costs no extra render, with zeros elsewhere."""

Phase = Literal["search", "ranking"]

MOST, MOST_NUMBERS = 1024, 2**21
"""Queries that are asked at once, and the numbers that their configurations have together, at most."""


def most_at_once(dim: int) -> int:
    """Return how many configurations of so many numbers are asked about at once, at most."""
    return max(2, min(MOST, MOST_NUMBERS // dim))


@dataclass(frozen=True, eq=False)
class Query:
    """One question: what does the model say of this configuration under this noise?

    A query of a search is about the picture as it is rendered, at the search's own samples and light paths, and over
    the conditions that it draws. A trial is about the picture as a file would hold it, rounded to 8 bits.

    Attributes:
        u: (d,) float32 in [0, 1], the configuration; must not be written to.
        seed: of the noise, and of the conditions that are drawn. Equal seeds mean equal noise.
        kind: which rows the answer belongs to, such as "search" or "verification".
        number: its place among these rows, from 0.
        phase: of a search; None for a trial.
        gradient: whether the derivative is wanted. "free" only ever comes where the domain has `partial_gradients`.
        samples: of a search: how many times its own samples per pixel to render with, at least 1. The answer costs as
            many times its renders: samples * (1 + gradient_cost) with a gradient, samples without.
        spp: of a trial: samples a pixel.
        drawn: of a trial: whether conditions are drawn; otherwise the scene has those it comes with.
        values: of a trial: what its row says of the configuration, which trials of one kind may have in common.
        sought: of a trial: whether a search seeks some answer there, so that there is a success.
        wanted: what the answer is: a judgement; a picture alone; or "light", from which pictures can be predicted
            (`advsearch.scene.transport`), at u of the whole space.
        keep: whether the answer has the picture, too; of a row of a sweep, the bytes of a small one.
    """

    u: Tensor
    seed: int
    kind: str = "search"
    number: int = 0
    phase: Phase | None = None
    gradient: WhichGradient = False
    samples: int = 1
    spp: int = 1
    drawn: bool = True
    values: Mapping[str, Value] = field(default_factory=dict)
    sought: bool = True
    wanted: Literal["judgement", "picture", "light"] = "judgement"
    keep: bool = False


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The answer to a query.

    Attributes:
        objective: what is maximised; a noisy number, because a render is.
        gradient: (d,) float32 derivative of the objective with respect to u, or None where it was not asked for.
        success: the model's answer is what is sought, by the task. Never derived from the objective.
        non_finite: gradient elements that were NaN or infinite and were set to zero where they arose.
        cost: pictures that were rendered for it, at least 1: one, and those that differences took, each times
            `samples`. An adjoint is not a picture and counts 0; `SearchResult.gradients` counts it. 0 of a row of a
            sweep whose picture was predicted, or rendered for another model.
        judgement: what the task says of it, for the log; None where there is no task. No policy looks at it.
        picture: (H, W, 3) 8-bit values in [0, 1], where it was asked for.
        light: what was asked for as "light"; of the last row of a batch of a sweep, what was predicted so far.
        predicted: 0 if its picture was rendered; samples a pixel of what predicted it, 1 of a matrix.
        small: JPEG file of the picture of a row of a sweep, where it is kept.
        layers: ground truth of it by name, and notes, where they are kept.
        seconds: that it took; None where whoever asks has to look at the clock.
        machine: on which it was made, by its name among the workers' machines; None where that is like this one.
        lost: whether nobody could answer, since every worker that tried died.
    """

    objective: float
    gradient: Tensor | None
    success: bool
    non_finite: int = 0
    cost: int = 1
    judgement: Judgement | None = None
    picture: Tensor | None = None
    light: Any = None
    predicted: int = 0
    small: bytes | None = None
    layers: tuple[Mapping[str, Any], Mapping[str, str]] | None = None
    seconds: float | None = None
    machine: str | None = None
    lost: bool = False

    @classmethod
    def of(cls, judgement: Judgement, **more: Any) -> Evaluation:
        """Return the answer to a query without derivative, from what the task says."""
        value = math.nan if judgement.objective is None else judgement.objective
        return cls(value, None, judgement.success, judgement=judgement, **more)

    @property
    def said(self) -> Judgement:
        """What the task says.

        Raises:
            RuntimeError: there is no task, or another answer was wanted.
        """
        if self.judgement is None:
            raise RuntimeError("this answer has no judgement")
        return self.judgement

    @property
    def finite(self) -> bool:
        """Whether the objective is a number that can be compared."""
        return math.isfinite(self.objective)


Evaluate = Callable[[Sequence[Query]], Iterable[Evaluation]]
"""Answers queries, in their order, each when it is asked for; whoever stops asking leaves the rest undone. Supplied by
whoever owns the scene. `functools.partial(map, f)` makes one of a function of one query."""


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
            evaluation, objective=-math.inf, gradient=zero, success=False, non_finite=evaluation.non_finite + bad
        )
    if bad:
        return replace(evaluation, gradient=gradient, non_finite=evaluation.non_finite + bad)
    return evaluation
