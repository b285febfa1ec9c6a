"""Several policies on one budget; what does better gets more of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch

from advsearch.attacks.domain import Domain
from advsearch.attacks.policies import racing
from advsearch.attacks.policies.auto import Auto
from advsearch.attacks.policies.base import Policy, draw_seed, seeded
from advsearch.attacks.policies.choices import with_choices
from advsearch.attacks.policies.cmaes import CMAES
from advsearch.attacks.policies.pgd import PGD
from advsearch.attacks.policies.racing import Race, Raced
from advsearch.errors import InputError


@dataclass(frozen=True)
class Restarts(Raced):
    """Lets a policy search `times` times, each with an equal share of the renders; they take turns, step by step.

    The first begins where the policy would begin by itself, the others at samples of the domain (`Domain.sample`); the
    norm balls stay where they are. One that has nothing more to propose leaves its renders to the rest. For an
    objective with several peaks, where a gradient finds the nearest. Discrete choices are fixed outside (`Choices`), so
    every combination of options has its own restarts.

    Attributes:
        policy: what searches; in `make_policy` a name, or a mapping with a name and options.
        times: at least 1; fewer if the renders do not suffice for one evaluation each.

    Raises:
        InputError: a value is outside what is said here.
    """

    policy: Policy[Any] = field(default_factory=PGD)
    times: int = 4

    name: ClassVar[str] = "restarts"

    def __post_init__(self) -> None:
        if not isinstance(self.policy, Policy):
            raise InputError(f"policy of restarts: expected a policy, got {self.policy!r}; use make_policy for names")
        if self.times < 1:
            raise InputError(f"times: expected at least 1, got {self.times}")

    @property
    def uses_gradient(self) -> bool:
        return self.policy.uses_gradient

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Race:
        seed = draw_seed(generator)
        each = 1 + (domain.gradient_cost if self.policy.uses_gradient else 0)
        count = max(1, min(self.times, steps // each))
        begins = (domain.begin, *(domain.sample(seeded(seed, number))[0] for number in range(1, count)))
        return racing.line_up([(self.policy, replace(domain, first=begin)) for begin in begins], steps, seed, rounds=1)


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
