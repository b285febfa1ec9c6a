"""Samples where the decision is close: a configuration is rendered again only while it may be the best.

A search keeps the best of many noisy objectives. One that is clearly worse than the best so far needs no better
estimate. One that may be better, or claims to be, does: the maximum of noisy numbers is biased upwards, and a lucky
one would stay the best for ever. With a noise of standard deviation s / sqrt(n) in the mean of n renders, a
configuration is clearly worse once

    best - mean >= Z s / sqrt(n)      so      n = (Z s / (best - mean))^2 renders are enough to tell.

That is the race of Maron and Moore (1994) with normal intervals in place of Hoeffding's. What it costs is bounded by
`most` renders a configuration, and what it saves is the samples of all others. On a smooth objective of two numbers in
noise of 0.1, 0.3 and 1 of its range, at 60 and 240 renders, random search with `most=4` ended higher than random search
with any fixed count of 1, 2, 4 or 8 (means of 120 searches); asking again only in *both* directions ended lower.

A step of an ascent decides nothing: each is meant to be better than the one before, the next gradient corrects it, and
the search ranks the last ones by fresh renders anyway. So what came with a gradient is not rendered again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Generic

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain
from advsearch.attacks.evaluation import Evaluation
from advsearch.attacks.policies.base import Counts, Policy, Proposal, State
from advsearch.errors import InputError

Z = 1.0
"""Standard deviations at which a difference counts as clear: a search needs the better of two, not a proof."""


def more_renders(mean: float, best: float, noise: float, spent: int, most: int, z: float = Z) -> int:
    """Return how many renders more a configuration is worth.

    Args:
        mean: of its objective over `spent` renders.
        best: mean objective of the best configuration so far; -inf before there is one.
        noise: standard deviation of the objective of one render, at least 0.
        spent: renders so far, at least 1.
        most: renders of a configuration, at most.
        z: see the module.

    Returns:
        0 where it is clearly worse than the best or nothing is left, else enough to tell, at most as many as were spent
        (so that a mean that moves is asked again).
    """
    if spent >= most or noise <= 0.0 or not math.isfinite(mean) or math.isnan(best):
        return 0
    gap = best - mean
    enough = most if gap * math.sqrt(most) <= z * noise else math.ceil((z * noise / gap) ** 2 - 1e-9)
    return max(0, min(enough - spent, spent, most - spent))


def pooled(one: Evaluation, spent: int, other: Evaluation, added: int) -> Evaluation:
    """Return the evaluation of a configuration after `added` renders more: the mean by renders, the first's gradient.

    Success is that of the side with more renders. An objective that was not finite stays so.
    """
    share = added / (spent + added)
    objective = (1.0 - share) * one.objective + share * other.objective
    return replace(
        one,
        objective=objective if math.isfinite(objective) else -math.inf,
        logits=(1.0 - share) * one.logits + share * other.logits,
        success=other.success if added >= spent else one.success,
        non_finite=one.non_finite + other.non_finite,
        cost=one.cost + other.cost,
    )


@dataclass(frozen=True)
class Noise:
    """What is known about the noise of one render, from configurations that were rendered again.

    Attributes:
        squares: sum of squared differences of two means, each over what a single render's would be.
        count: how many.
    """

    squares: float = 0.0
    count: int = 0

    @property
    def deviation(self) -> float:
        """Standard deviation of one render; NaN where nothing is known."""
        return math.sqrt(self.squares / self.count) if self.count else math.nan

    def after(self, difference: float, spent: int, added: int) -> Noise:
        """Return what is known after means of `spent` and of `added` renders differed by so much."""
        if not math.isfinite(difference):
            return self
        return Noise(self.squares + difference**2 / (1.0 / spent + 1.0 / added), self.count + 1)


@dataclass(frozen=True, eq=False)
class Calls(Generic[State]):
    """State of `CloseCalls`.

    Attributes:
        inner: of the policy.
        best: mean objective of the best configuration.
        noise: of one render.
        pending: a configuration that is rendered again, its evaluation so far, its renders, and how many are added.
    """

    inner: State
    best: float = -math.inf
    noise: Noise = field(default_factory=Noise)
    pending: tuple[Tensor, Evaluation, int, int] | None = None


@dataclass(frozen=True)
class CloseCalls(Policy[Calls[Any]]):
    """Another policy at few samples, which are raised where a configuration may be the best.

    The policy underneath sees one evaluation a configuration: the mean of all its renders. One that came with a gradient
    is rendered once.

    Attributes:
        policy: what proposes.
        most: renders of one configuration, at most, in the search's own samples; at least 2.
        noise: standard deviation of the objective of one render; None measures it, beginning with the first
            configuration, which is rendered twice.

    Raises:
        InputError: a value is outside what is said here.
    """

    policy: Policy[Any]
    most: int = 4
    noise: float | None = None

    name: ClassVar[str] = "close_calls"

    def __post_init__(self) -> None:
        if self.most < 2:
            raise InputError(f"most: expected at least 2 renders of one configuration, got {self.most}")
        if self.noise is not None and not 0.0 <= self.noise < math.inf:
            raise InputError(f"noise: expected a number of at least 0, got {self.noise}")

    @property
    def uses_gradient(self) -> bool:
        """As the policy underneath."""
        return self.policy.uses_gradient

    @property
    def handles_choices(self) -> bool:  # type: ignore[override]
        """As the policy underneath."""
        return self.policy.handles_choices

    def counts(self, state: Calls[Any]) -> Counts:
        """See `Policy.counts`."""
        return self.policy.counts(state.inner)

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Calls[Any]:
        """See `Policy.start`."""
        return Calls(self.policy.start(domain, generator, steps))

    def propose(self, state: Calls[Any]) -> tuple[Proposal | None, Calls[Any]]:
        """Return the configuration that is rendered again, or the next of the policy underneath."""
        if state.pending is not None:
            u, _, _, added = state.pending
            return Proposal(u, samples=added), state
        proposal, inner = self.policy.propose(state.inner)
        return proposal, replace(state, inner=inner)

    def update(self, state: Calls[Any], u: Tensor, evaluation: Evaluation) -> Calls[Any]:
        """Render it again while the decision is close, else tell the policy underneath."""
        spent, known = 1, state.noise
        if state.pending is None and evaluation.gradient is not None:
            return replace(state, inner=self.policy.update(state.inner, u, evaluation))
        if state.pending is not None:
            _, before, spent, _ = state.pending
            added = evaluation.cost  # the end of a budget may have allowed fewer than were asked for
            known = known.after(evaluation.objective - before.objective, spent, added)
            evaluation, spent = pooled(before, spent, evaluation, added), spent + added
        more = self._more(evaluation.objective, state.best, known, spent)
        if more:
            return replace(state, noise=known, pending=(u, evaluation, spent, more))
        inner = self.policy.update(state.inner, u, evaluation)
        return Calls(inner, max(state.best, evaluation.objective), known)

    def _more(self, mean: float, best: float, known: Noise, spent: int) -> int:
        if self.noise is None and not known.count:
            return 1 if spent == 1 and math.isfinite(mean) else 0
        deviation = known.deviation if self.noise is None else self.noise
        return more_renders(mean, best, deviation, spent, self.most)
