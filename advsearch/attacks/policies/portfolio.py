"""Several policies on one budget; what does better gets more of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from advsearch.attacks.domain import Domain
from advsearch.attacks.policies import racing
from advsearch.attacks.policies.auto import Auto
from advsearch.attacks.policies.base import Policy, draw_seed, seeded
from advsearch.attacks.policies.choices import with_choices
from advsearch.attacks.policies.cmaes import CMAES
from advsearch.attacks.policies.racing import Race, Raced
from advsearch.errors import InputError


@dataclass(frozen=True)
class Portfolio(Raced):
    """Lets several policies search side by side and goes on with those that reached more.

    With n policies there are 1 + ceil(log2 n) rounds of equally many renders, see `racing`. Within a round every policy
    that is still in has an equal share; after it the better half goes on, by the largest objective reached so far. So
    of two policies each has a quarter of the renders, and the better one the other half. Each plans for what it gets
    if it stays in.

    A policy that cannot search the domain (it says so with an InputError: a grid over a texture) is left out; if none
    can, the first one's error is passed on.

    Attributes:
        policies: at least one; in `make_policy` a list of names, or of mappings with a name and options.

    Raises:
        InputError: there is no policy.
    """

    policies: tuple[Policy[Any], ...] = (Auto(), CMAES())

    name: ClassVar[str] = "portfolio"
    handles_choices: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "policies", tuple(self.policies))
        if not self.policies or not all(isinstance(policy, Policy) for policy in self.policies):
            raise InputError(f"policies of portfolio: expected one policy or more, got {self.policies!r}")

    @property
    def uses_gradient(self) -> bool:
        return any(policy.uses_gradient for policy in self.policies)

    def takes_differences(self, domain: Domain, steps: int) -> bool:
        return any(policy.takes_differences(domain, steps) for policy in self.policies)

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Race:
        seed = draw_seed(generator)
        searches, errors = [], []
        for policy in self.policies:
            whole = with_choices(policy, domain)
            try:
                whole.start(domain, seeded(seed, 0), max(1, steps // len(self.policies)))
            except InputError as error:
                errors.append(error)
            else:
                searches.append((whole, domain))
        if not searches:
            raise errors[0]
        return racing.line_up(searches, steps, seed)
