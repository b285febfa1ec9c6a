"""Several policies on one budget, of which the better ones continue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from advsearch.extend import InputError, Policy
from advsearch.extend import policies as policy_parts


@dataclass(frozen=True)
class Portfolio(policy_parts.RacingPolicy[policy_parts.Race]):
    """Runs several policies in parallel and continues with the better ones.

    With n policies there are 1 + ceil(log2 n) rounds of equally many renders, see
    `choices`. In a round, its renders are divided equally among the policies that are
    left. After it the better half continues, by the largest objective so far. So with
    two policies each gets a quarter of the renders, and the better one the other half.

    A policy that cannot search the domain, for example a grid over a texture, raises an
    InputError when it starts. It is left out. If no policy can search the domain, the
    error of the first one is raised.

    Attributes:
        policies: at least one policy; in `make_policy` a list of names, or of mappings
            with a name and options.
    """

    policies: tuple[Policy[Any], ...] = (policy_parts.Auto(), policy_parts.CMAES())

    name: ClassVar[str] = "portfolio"
    handles_choices: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check that the policies are policies, and that there is one."""
        object.__setattr__(self, "policies", tuple(self.policies))
        if not self.policies or not all(
            isinstance(policy, Policy) for policy in self.policies
        ):
            raise InputError(
                "policies of portfolio: expected one policy or more, got "
                f"{self.policies!r}"
            )

    @property
    def uses_gradient(self) -> bool:
        return any(policy.uses_gradient for policy in self.policies)

    def takes_differences(self, domain: policy_parts.Domain, steps: int) -> bool:
        return any(policy.takes_differences(domain, steps) for policy in self.policies)

    def start(
        self, domain: policy_parts.Domain, generator: torch.Generator, steps: int
    ) -> policy_parts.Race:
        """Start a race of the policies that can search the domain.

        Raises:
            InputError: none of them can; it is the error of the first.
        """
        seed = policy_parts.draw_seed(generator)
        policies = self._find_suitable_policies(domain, seed, steps)
        return policy_parts.start_race(
            [(policy, domain) for policy in policies], steps, seed
        )

    def _find_suitable_policies(
        self, domain: policy_parts.Domain, seed: int, steps: int
    ) -> list[Policy[Any]]:
        """Return the policies that can search the domain, at least one.

        Raises:
            InputError: none of them can; it is the error of the first.
        """
        steps_each = max(1, steps // len(self.policies))
        suitable = []
        errors = []
        for policy in self.policies:
            wrapped = policy_parts.wrap_choices(policy, domain)
            try:
                # This only tests whether the policy can search the domain. The race
                # starts it again, when the number of searches is known.
                wrapped.start(domain, policy_parts.seeded(seed, 0), steps_each)
            except InputError as error:
                errors.append(error)
            else:
                suitable.append(wrapped)
        if not suitable:
            raise errors[0]
        return suitable
