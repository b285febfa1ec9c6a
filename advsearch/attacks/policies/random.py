"""Random search: the baseline that every worst-case claim is measured against (docs/design.md, "The search")."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from advsearch.attacks.domain import Domain
from advsearch.attacks.policies.base import Evaluated, Policy, Proposal, draw_seed, seeded


@dataclass(frozen=True, eq=False)
class RandomState:
    """Where a random search stands: it remembers nothing but how many samples it has drawn."""

    domain: Domain
    seed: int
    drawn: int


@dataclass(frozen=True)
class Random(Policy[RandomState]):
    """Independent samples within the budget, by turns at the extremes of the norm balls and in their interior.

    The first is an extreme one: in many dimensions the corners of an l-infinity ball beat its interior (a random
    corner moves a linear objective sqrt(3) times as far as a uniform sample), so a baseline without them would be too
    easy to win against. See `Domain.sample`.
    """

    name: ClassVar[str] = "random"
    uses_gradient: ClassVar[bool] = False
    handles_choices: ClassVar[bool] = True

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> RandomState:
        return RandomState(domain, draw_seed(generator), 0)

    def propose(self, state: RandomState, n: int) -> tuple[tuple[Proposal, ...], RandomState]:
        numbers = range(state.drawn, state.drawn + n)
        us = (state.domain.sample(seeded(state.seed, k), extreme=k % 2 == 0)[0] for k in numbers)
        return tuple(map(Proposal, us)), replace(state, drawn=state.drawn + n)

    def update(self, state: RandomState, evaluated: Evaluated) -> RandomState:
        return state
