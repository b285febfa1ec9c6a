"""The box blocks of a domain as one small unit box: poses, cameras, lights, choices; everything but the norm balls."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain, centre_of_option
from advsearch.attacks.policies.base import seeded

MOST_SOBOL = 1000
"""More coordinates than this are screened with independent points; Sobol's advantage is long gone."""

MOVED = 4
"""About so many coordinates change in one local move; all, where there are no more."""

ANOTHER = 0.3
"""Share of moved choices that are drawn anew."""

NEAREST, FARTHEST = 0.01, 0.3
"""Standard deviations of local moves, in units of a coordinate's whole range; between them log-uniform."""


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Which elements of u these are, and what a point x in [0, 1]^k means: u[where] = low + width * x.

    Attributes:
        where: (k,) positions in u.
        low, width: (k,) of the bounds.
        periodic: (k,) whether 0 and 1 are the same place.
        options: (k,) the number of options of a discrete choice, or 0.
    """

    where: Tensor
    low: Tensor
    width: Tensor
    periodic: Tensor
    options: Tensor

    @property
    def count(self) -> int:
        """Number of coordinates."""
        return len(self.where)

    def take(self, u: Tensor) -> Tensor:
        """Return the points (..., k) at which configurations (..., d) stand."""
        return ((u[..., self.where] - self.low) / self.width).clamp_(0.0, 1.0)

    def put(self, u: Tensor, x: Tensor) -> Tensor:
        """Return a copy of configurations (..., d), moved to points (..., k)."""
        u = u.clone()
        u[..., self.where] = torch.clamp(self.low + self.width * x, self.low, self.low + self.width)
        return u

    def tidy(self, x: Tensor) -> Tensor:
        """Return points (n, k) brought back: angles wrap, choices go to the middle of their option, the rest clips."""
        x = torch.where(self.periodic, torch.remainder(x, 1.0), x).clamp_(0.0, 1.0)
        return torch.where(self.options > 0, centre_of_option(x, self.options.clamp(min=1)), x)

    def screen(self, seed: int, n: int) -> Tensor:
        """Return points (n, k) spread evenly: a scrambled Sobol sequence."""
        if n == 0:
            return torch.empty(0, self.count)
        if self.count > MOST_SOBOL:
            return self.tidy(torch.rand(n, self.count, generator=seeded(seed, 0)))
        engine = torch.quasirandom.SobolEngine(self.count, scramble=True, seed=seed)
        return self.tidy(engine.draw(n))

    def moves(self, x: Tensor, generator: torch.Generator) -> Tensor:
        """Return points (n, k), each near its own in x: a few coordinates of each moved, near or far."""
        n, k = x.shape
        far = math.log(FARTHEST / NEAREST)
        size = NEAREST * torch.exp(far * torch.rand(n, 1, generator=generator))
        moved = torch.rand(n, k, generator=generator) < MOVED / k
        moved[torch.arange(n), torch.randint(k, (n,), generator=generator)] = True
        near = x + moved * size * torch.randn(n, k, generator=generator)
        anew = moved & (self.options > 0) & (torch.rand(n, k, generator=generator) < ANOTHER)
        x = torch.where(self.options > 0, x, near)
        return self.tidy(torch.where(anew, torch.rand(n, k, generator=generator), x))

    def embed(self, x: Tensor, lengths: Tensor) -> Tensor:
        """Return points (n, k) as points (n, f) whose ordinary distances are what a surrogate needs.

        Differences are divided by (k,) lengths. An angle becomes a circle of circumference 2, an option the corner of
        a simplex with edges of length 1.
        """
        x = x.double()
        plain = ~self.periodic & (self.options == 0)
        angle = 2.0 * math.pi * x[:, self.periodic]
        radius = math.pi * lengths[self.periodic]
        parts = [x[:, plain] / lengths[plain], angle.cos() / radius, angle.sin() / radius]
        for j in torch.nonzero(self.options).flatten().tolist():
            count = int(self.options[j])
            number = (x[:, j] * count).long().clamp_(max=count - 1)
            corner = torch.nn.functional.one_hot(number, count).double()
            parts.append(corner / (math.sqrt(2.0) * lengths[j]))
        return torch.cat(parts, dim=1)


def box_coordinates(domain: Domain) -> Coordinates:
    """Return the coordinates of a domain that belong to no norm ball; there may be none."""
    boxes = [(block, part) for block, part in domain.parts() if block.norm == "box"]
    sizes = torch.tensor([block.size for block, _ in boxes], dtype=torch.long)
    where = [torch.arange(part.start, part.stop) for _, part in boxes]
    low = torch.tensor([block.low for block, _ in boxes])
    return Coordinates(
        where=torch.cat(where) if where else torch.empty(0, dtype=torch.long),
        low=low.repeat_interleave(sizes),
        width=(torch.tensor([block.high for block, _ in boxes]) - low).repeat_interleave(sizes),
        periodic=torch.tensor([block.periodic for block, _ in boxes], dtype=torch.bool).repeat_interleave(sizes),
        options=torch.tensor([block.options for block, _ in boxes], dtype=torch.long).repeat_interleave(sizes),
    )
