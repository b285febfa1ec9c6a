"""The policy that never moves: what is left to do where nothing may vary but what a wrapper varies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain
from advsearch.attacks.policies.base import Evaluated, Policy, Proposal


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
