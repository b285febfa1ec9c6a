"""One policy from several starts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch

from advsearch.extend import InputError, Policy, policies


@dataclass(frozen=True)
class Restarts(policies.RacingPolicy[policies.Race]):
    """Runs a policy `times` times, each with an equal fraction of the renders.

    The runs take turns, step by step. The first begins where the policy would begin by
    itself, the others at samples of the domain (`Domain.sample`); norm balls stay
    around the start. A run that has nothing more to propose leaves its renders to the
    others. This is for an objective with several peaks, of which a gradient finds the
    nearest. Discrete choices are fixed outside (`Choices`), so every combination of
    options has its own restarts.

    Attributes:
        policy: policy that searches; in `make_policy` a name, or a mapping with a name
            and options.
        times: number of runs, at least 1. There are fewer if the renders do not suffice
            for one evaluation each.
    """

    policy: Policy[Any] = field(default_factory=policies.PGD)
    times: int = 4

    name: ClassVar[str] = "restarts"

    def __post_init__(self) -> None:
        """Check that the policy is one, and the number of restarts."""
        if not isinstance(self.policy, Policy):
            raise InputError(
                "policy of restarts: expected a policy, got "
                f"{self.policy!r}; use make_policy for names"
            )
        if self.times < 1:
            raise InputError(f"times: expected at least 1, got {self.times}")

    @property
    def uses_gradient(self) -> bool:
        return self.policy.uses_gradient

    def start(
        self, domain: policies.Domain, generator: torch.Generator, steps: int
    ) -> policies.Race:
        """Start the policy from several points; the first is the domain's own.

        There are at most `times` starts, and so few that the renders (`steps`) allow
        each at least one evaluation with its gradient.
        """
        seed = policies.draw_seed(generator)
        initial_points = [domain.initial_point]
        for number in range(1, self._count_starts(domain, steps)):
            initial_points.append(domain.sample(policies.seeded(seed, number))[0])
        searches = [
            (self.policy, replace(domain, restart_point=point))
            for point in initial_points
        ]
        # With a single round, no search is dropped before the end.
        return policies.start_race(searches, steps, seed, rounds=1)

    def _count_starts(self, domain: policies.Domain, steps: int) -> int:
        """Return how many searches there are, of which each can be evaluated."""
        renders_per_evaluation = 1
        if self.policy.uses_gradient:
            renders_per_evaluation += domain.gradient_cost
        return max(1, min(self.times, steps // renders_per_evaluation))
