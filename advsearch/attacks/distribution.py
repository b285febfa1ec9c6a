"""A distribution of configurations: what a search may answer with instead of one point."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain


@dataclass(frozen=True, eq=False)
class Distribution:
    """A normal distribution with independent elements, projected onto the domain.

    Attributes:
        mean: (d,) float32, inside the domain.
        deviation: (d,) float32, at least 0.
    """

    mean: Tensor
    deviation: Tensor

    def sample(self, generator: torch.Generator, n: int, domain: Domain) -> Tensor:
        """Return (n, d) float32 configurations P(mean + deviation * z), z standard normal, P the projection.

        Args:
            generator: source of randomness; advances.
            n: how many, at least 1.
            domain: the one that was searched.
        """
        noise = torch.randn(n, domain.dim, generator=generator)
        return torch.stack([domain.project(self.mean + self.deviation * one) for one in noise])
