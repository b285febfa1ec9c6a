"""A Gaussian process (Matérn-5/2, a length for each coordinate, noise) over the box
blocks of a domain as one unit box. All is fitted by maximum likelihood over fixed
grids, and every proposal is one of finitely many, so that last bits of a factorisation
do not change a result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain, find_periodic, option_center
from advsearch.attacks.evaluation import Evaluated, seeded

# more coordinates than this are screened with independent points; Sobol's advantage is
# long gone
MAX_SOBOL_DIM = 1000
# about so many coordinates change in one local move; all, where there are no more
N_MOVED_COORDINATES = 4
RESAMPLED_FRACTION = 0.3  # share of moved choices that are drawn anew
# deviations of local moves, in a coordinate's whole range; between them log-uniform
MIN_MOVE = 0.01
MAX_MOVE = 0.3


@dataclass(frozen=True, eq=False)
class BoxCoordinates:
    """Which elements of u these are (k,), and what a point x in [0, 1]^k means:
    u[where] = low + width * x. At the ends of `periodic` ones is the same place; a
    discrete choice has `options`, others 0.
    """

    where: Tensor
    low: Tensor
    width: Tensor
    periodic: Tensor
    options: Tensor

    @property
    def count(self) -> int:
        return len(self.where)

    def from_configuration(self, u: Tensor) -> Tensor:
        """Return the points (..., k) at which configurations (..., d) stand."""
        return ((u[..., self.where] - self.low) / self.width).clamp_(0.0, 1.0)

    def to_configuration(self, u: Tensor, x: Tensor) -> Tensor:
        """Return a copy of configurations (..., d), moved to points (..., k)."""
        u = u.clone()
        u[..., self.where] = torch.clamp(
            self.low + self.width * x, self.low, self.low + self.width
        )
        return u

    def normalize(self, x: Tensor) -> Tensor:
        """Return points (n, k) brought back: angles wrap, choices go to the middle of
        their option, the rest clips.
        """
        x = torch.where(self.periodic, torch.remainder(x, 1.0), x).clamp_(0.0, 1.0)
        return torch.where(
            self.options > 0, option_center(x, self.options.clamp(min=1)), x
        )

    def sample_screen(self, seed: int, n: int) -> Tensor:
        """Return points (n, k) spread evenly: a scrambled Sobol sequence."""
        if n == 0:
            return torch.empty(0, self.count)
        if self.count > MAX_SOBOL_DIM:
            return self.normalize(torch.rand(n, self.count, generator=seeded(seed, 0)))
        engine = torch.quasirandom.SobolEngine(self.count, scramble=True, seed=seed)
        return self.normalize(engine.draw(n))

    def sample_moves(self, x: Tensor, generator: torch.Generator) -> Tensor:
        """Return points (n, k), each near its own in x: a few coordinates of each
        moved, near or far.
        """
        n, k = x.shape
        far = math.log(MAX_MOVE / MIN_MOVE)
        size = MIN_MOVE * torch.exp(far * torch.rand(n, 1, generator=generator))
        moved = torch.rand(n, k, generator=generator) < N_MOVED_COORDINATES / k
        moved[torch.arange(n), torch.randint(k, (n,), generator=generator)] = True
        near = x + moved * size * torch.randn(n, k, generator=generator)
        anew = (
            moved
            & (self.options > 0)
            & (torch.rand(n, k, generator=generator) < RESAMPLED_FRACTION)
        )
        x = torch.where(self.options > 0, x, near)
        return self.normalize(
            torch.where(anew, torch.rand(n, k, generator=generator), x)
        )

    def embed(self, x: Tensor, lengths: Tensor) -> Tensor:
        """Return points (n, k) as points (n, f) whose ordinary distances are what a
        surrogate needs.

        Differences are divided by (k,) lengths. An angle becomes a circle of
        circumference 2, an option the corner of a simplex with edges of length 1.
        """
        x = x.double()
        plain = ~self.periodic & (self.options == 0)
        angle = 2.0 * math.pi * x[:, self.periodic]
        radius = math.pi * lengths[self.periodic]
        parts = [
            x[:, plain] / lengths[plain],
            angle.cos() / radius,
            angle.sin() / radius,
        ]
        for j in torch.nonzero(self.options).flatten().tolist():
            count = int(self.options[j])
            number = (x[:, j] * count).long().clamp_(max=count - 1)
            corner = torch.nn.functional.one_hot(number, count).double()
            parts.append(corner / (math.sqrt(2.0) * lengths[j]))
        return torch.cat(parts, dim=1)


def find_box_coordinates(domain: Domain) -> BoxCoordinates:
    """Return the coordinates of a domain that belong to no norm ball; there may be
    none.
    """
    boxes = [
        torch.arange(part.start, part.stop)
        for block, part in domain.list_block_slices()
        if block.norm == "box"
    ]
    where = torch.cat([torch.empty(0, dtype=torch.long), *boxes])
    low = domain.lower[where]
    width = domain.upper[where] - domain.lower[where]
    return BoxCoordinates(
        where, low, width, find_periodic(domain)[where], domain.options[where]
    )


LENGTHS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Candidate lengths, times the square root of the number of coordinates (as distances
between points grow).
"""

# candidate variances of the noise, as shares of the signal's
NOISES = (1e-4, 1e-2, 0.1, 0.5, 2.0)
STRETCHES = (0.5, 2.0, 4.0)  # by how much one coordinate's length is changed on trial
# no length is more than this many times the root of the number of coordinates: it no
# longer matters then
MAX_LENGTH = 8.0
# gain in log-likelihood that a coordinate's own length must bring; less would fit the
# noise
MIN_LIKELIHOOD_GAIN = 1.0
# lengths and noise are fitted again after so many new points, or a tenth of all if that
# is more
REFIT_INTERVAL = 5
# so many of the best points and so many of the latest count, unless more are asked for
MEMORY = 100
MAX_SCALED_DIM = (
    16  # up to so many coordinates have lengths of their own; more share one
)


@dataclass(frozen=True, eq=False)
class Scales:
    """What is fitted: (k,) lengths, and the noise's variance as a share of the
    signal's.
    """

    lengths: Tensor
    noise: float


@dataclass(frozen=True, eq=False)
class Surrogate:
    """A fitted process at points (n, k) of the unit box: the Cholesky factor (n, n) of
    the kernel matrix with noise, of signal variance 1; its inverse times the centred
    values (n,); mean and variance of the signal; log-likelihood.
    """

    space: BoxCoordinates
    x: Tensor
    scales: Scales
    factor: Tensor
    weights: Tensor
    mean: float
    variance: float
    likelihood: float

    def predict(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation (m,) of the noise-free objective at points
        (m, k).
        """
        lengths = self.scales.lengths
        cross = kernel(self.space.embed(x, lengths), self.space.embed(self.x, lengths))
        solved = torch.linalg.solve_triangular(self.factor, cross.mT, upper=False)
        left = (1.0 - solved.square().sum(dim=0)).clamp_(min=1e-12)
        return self.mean + cross @ self.weights, (self.variance * left).sqrt_()


@dataclass(frozen=True, eq=False)
class Observations:
    """What was evaluated, points (n, k) and n objectives, not finite where it could not
    be, and the scales of the process behind it, fitted to the first `fitted`. The best
    and the latest points count, so many of each; for the scales `MEMORY`.
    """

    space: BoxCoordinates
    points: Tensor
    values: tuple[float, ...] = ()
    scales: Scales | None = None
    fitted: int = 0
    memory: int = MEMORY

    @property
    def has_finite(self) -> bool:
        return any(math.isfinite(value) for value in self.values)

    def extend(self, evaluated: Evaluated) -> Observations:
        points = torch.cat(
            [
                self.points,
                *(self.space.from_configuration(u)[None] for u, _ in evaluated),
            ]
        )
        return replace(
            self,
            points=points,
            values=(
                *self.values,
                *(evaluation.objective for _, evaluation in evaluated),
            ),
        )

    def fit_surrogate(self) -> tuple[Surrogate, Observations]:
        """Return the process behind what was seen, its scales fitted again if it is
        time; something is finite.

        What could not be evaluated counts as the smallest value; of many points the
        best and the latest count.
        """
        n = len(self.values)
        values = torch.tensor(self.values, dtype=torch.float64)
        finite = torch.isfinite(values)
        values = torch.where(finite, values, values[finite].min())
        scales = self.scales
        fitted = self.fitted
        if scales is None or n - fitted >= max(REFIT_INTERVAL, fitted // 10):
            used = _select_best_and_latest(values, MEMORY)
            scales = _find_best_scales(self.space, self.points[used], values[used])
            fitted = n
        used = _select_best_and_latest(values, self.memory)
        surrogate = fit(self.space, self.points[used], values[used], scales)
        return surrogate, replace(self, scales=scales, fitted=fitted)


def _select_best_and_latest(values: Tensor, memory: int) -> Tensor:
    """Return places of so many of the largest values and so many of the last; of all if
    there are no more.
    """
    last = len(values) - memory
    if last <= memory:
        return torch.arange(len(values))
    best = values[:last].argsort(descending=True, stable=True)[:memory]
    return torch.cat([best, torch.arange(last, len(values))])


def kernel(a: Tensor, b: Tensor) -> Tensor:
    """Matérn-5/2 correlation between points (n, f) and (m, f)."""
    r = math.sqrt(5.0) * torch.cdist(a, b)
    return (1.0 + r + r.square() / 3.0) * torch.exp(-r)


def fit(
    space: BoxCoordinates, x: Tensor, y: Tensor, scales: Scales | None = None
) -> Surrogate:
    """Return the process given values (n,) at points (n, k), mean and variance at their
    best; the scales too are fitted unless they are given.
    """
    scales = scales or _find_best_scales(space, x, y)
    points = space.embed(x, scales.lengths)
    n = len(x)
    matrix = kernel(points, points) + (scales.noise + 1e-8) * torch.eye(
        n, dtype=torch.float64
    )
    factor = torch.linalg.cholesky(matrix)
    both = torch.cholesky_solve(
        torch.stack([y.double(), torch.ones(n, dtype=torch.float64)], dim=1), factor
    )
    mean = float(both[:, 0].sum() / both[:, 1].sum())
    weights = both[:, 0] - mean * both[:, 1]
    variance = max(float(weights @ (y.double() - mean)) / n, 1e-30)
    likelihood = -0.5 * n * math.log(variance) - float(factor.diagonal().log().sum())
    return Surrogate(space, x, scales, factor, weights, mean, variance, likelihood)


def _find_best_scales(space: BoxCoordinates, x: Tensor, y: Tensor) -> Scales:
    """The most likely common length and noise, then length by length what the evidence
    asks for.
    """
    k = x.shape[1]
    unit = math.sqrt(k)

    def most_likely(tried: list[Scales]) -> Surrogate:
        return max(
            (fit(space, x, y, scales) for scales in tried),
            key=lambda fitted: fitted.likelihood,
        )

    best = most_likely(
        [
            Scales(torch.full((k,), unit * length).double(), noise)
            for length in LENGTHS
            for noise in NOISES
        ]
    )
    for j in range(k if 1 < k <= MAX_SCALED_DIM else 0):
        changed = []
        for stretch in STRETCHES:
            lengths = best.scales.lengths.clone()
            lengths[j] = min(unit * MAX_LENGTH, float(lengths[j]) * stretch)
            changed.append(Scales(lengths, best.scales.noise))
        other = most_likely(changed)
        if other.likelihood > best.likelihood + MIN_LIKELIHOOD_GAIN:
            best = other
    return best.scales
