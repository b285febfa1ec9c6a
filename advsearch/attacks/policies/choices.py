"""Discrete choices around a policy that knows only numbers: options outside, the continuous search inside."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from advsearch.attacks.domain import Block, Distribution, Domain, centre_of_option
from advsearch.attacks.evaluation import Evaluation
from advsearch.attacks.policies import racing
from advsearch.attacks.policies.base import Counts, Evaluated, Policy, Proposal, draw_seed, seeded
from advsearch.attacks.policies.racing import Race


@dataclass(frozen=True)
class Stay(Policy[Tensor]):
    """Proposes the configuration where it began, again and again; its state is that configuration. For wrappers."""

    name: ClassVar[str] = "stay"
    uses_gradient: ClassVar[bool] = False
    handles_choices: ClassVar[bool] = True

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Tensor:
        return domain.begin

    def propose(self, state: Tensor, n: int) -> tuple[tuple[Proposal, ...], Tensor]:
        return (Proposal(state),) * n, state

    def update(self, state: Tensor, evaluated: Evaluated) -> Tensor:
        return state


MOST = 256
"""No more combinations than this take part."""

MOST_NUMBERS = 2**24
"""And no more, but two, than have so many numbers together: each search keeps some vectors of that size."""


@dataclass(frozen=True, eq=False)
class ChoicesState:
    """Where the search stands.

    Attributes:
        domain: the whole one.
        numbers: (k,) positions in u of what is no choice.
        choices: (c,) positions in u of the choices.
        combinations: (n, c) the choices' elements of u, one row for each search in the race.
        race: between the combinations, over the numbers alone.
    """

    domain: Domain
    numbers: Tensor
    choices: Tensor
    combinations: Tensor
    race: Race


@dataclass(frozen=True)
class Choices(Policy[ChoicesState]):
    """Searches combinations of options outside and, with another policy, the numbers inside.

    Every combination of options has a search of its own over the numbers, and the combinations race: see `racing`. If
    there are more combinations than can have a whole evaluation in every round, a random choice of them takes part, the
    start's among them always.

    `search` puts this around every policy whose `handles_choices` is false, a user's own included.

    Attributes:
        policy: what searches the numbers.
    """

    policy: Policy[Any]

    name: ClassVar[str] = "choices"
    handles_choices: ClassVar[bool] = True

    @property
    def uses_gradient(self) -> bool:
        return self.policy.uses_gradient

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> ChoicesState:
        seed = draw_seed(generator)
        discrete = torch.cat([torch.full((block.size,), block.options > 0) for block in domain.blocks])
        numbers, choices = (~discrete).nonzero().flatten(), discrete.nonzero().flatten()
        inner = _without(domain, numbers)
        policy: Policy[Any] = Stay() if inner is None else self.policy
        each = 1 + (domain.gradient_cost if policy.uses_gradient else 0)
        counts = [block.options for block in domain.blocks if block.options]
        limit = min(MOST, math.prod(counts), max(2, MOST_NUMBERS // domain.dim))
        most = racing.most_runners(steps, each, limit)
        combinations = _combinations(counts, domain.begin[choices], most, seeded(seed, 0))
        search = (policy, _EMPTY if inner is None else inner)
        race = racing.line_up([search] * len(combinations), steps, seed)
        return ChoicesState(domain, numbers, choices, combinations, race)

    def propose(self, state: ChoicesState, n: int) -> tuple[tuple[Proposal, ...], ChoicesState]:
        proposals, race = racing.propose(state.race, n)
        state = replace(state, race=race)
        asked = zip(proposals, race.asked, strict=True)
        return tuple(replace(proposal, u=_whole(state, proposal.u, number)) for proposal, number in asked), state

    def update(self, state: ChoicesState, evaluated: Evaluated) -> ChoicesState:
        inner = [(u[state.numbers], _part(evaluation, state.numbers)) for u, evaluation in evaluated]
        return replace(state, race=racing.update(state.race, inner))

    def counts(self, state: ChoicesState) -> Counts:
        return racing.counts(state.race)

    def answer(self, state: ChoicesState) -> Distribution | None:
        inner = racing.answer(state.race)
        if inner is None:
            return None
        deviation = torch.zeros_like(state.domain.start)
        deviation[state.numbers] = inner.deviation
        return Distribution(_whole(state, inner.mean, racing.leader(state.race)), deviation)


def with_choices(policy: Policy[Any], domain: Domain) -> Policy[Any]:
    """Return the policy, inside `Choices` if the domain has discrete choices that it does not handle itself."""
    discrete = any(block.options for block in domain.blocks)
    return Choices(policy) if discrete and not policy.handles_choices else policy


_EMPTY = Domain(torch.zeros(1), (Block(1),))
"""Stands in where nothing but choices may vary; its one number is dropped."""


def _without(domain: Domain, numbers: Tensor) -> Domain | None:
    """Return the domain of the numbers alone; None if there are none."""
    blocks = tuple(block for block in domain.blocks if not block.options)
    if not blocks:
        return None
    first = None if domain.first is None else domain.first[numbers]
    return replace(domain, start=domain.start[numbers], blocks=blocks, first=first)


def _part(evaluation: Evaluation, numbers: Tensor) -> Evaluation:
    """Return the evaluation with the gradient of the numbers alone."""
    gradient = evaluation.gradient
    return evaluation if gradient is None else replace(evaluation, gradient=gradient[numbers])


def _whole(state: ChoicesState, numbers: Tensor, combination: int) -> Tensor:
    """Return the configuration with these numbers and that combination."""
    u = state.domain.begin.clone()
    u[state.numbers] = numbers[: len(state.numbers)]
    u[state.choices] = state.combinations[combination]
    return u


def _combinations(counts: list[int], begin: Tensor, most: int, generator: torch.Generator) -> Tensor:
    """Return (n, c) elements of u, n at most `most`, that of the start first and unchanged: all combinations in a
    random order, or so many distinct ones."""
    sizes = torch.tensor(counts)
    total = math.prod(counts)
    own = torch.floor(begin * sizes).long().clamp(max=sizes - 1)
    if total <= max(1024, 4 * most):
        every = torch.cartesian_prod(*(torch.arange(count) for count in counts)).reshape(total, len(counts))
        every = every[torch.randperm(total, generator=generator)]
        picked = every[~(every == own).all(dim=1)][: most - 1]
    else:
        seen = {tuple(own.tolist())}
        while len(seen) < most:
            seen.add(tuple(int(torch.randint(count, (1,), generator=generator)) for count in counts))
        picked = torch.tensor(sorted(seen - {tuple(own.tolist())})).reshape(-1, len(counts))
    middles = centre_of_option((picked + 0.5) / sizes, sizes)
    return torch.cat([begin[None], middles.to(begin.dtype)])
