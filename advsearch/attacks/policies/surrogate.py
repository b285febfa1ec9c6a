"""A Gaussian process (Matérn-5/2, a length scale for each coordinate, noise) over the
box blocks of a domain, which form one unit box. It is fitted by maximum likelihood over
fixed grids, and every proposal is one of finitely many candidates, so that the last
bits of a factorization do not change a result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain, find_periodic, option_center
from advsearch.attacks.evaluation import Evaluated, seeded

# Largest number of coordinates for which the screen is a Sobol sequence. With more of
# them it has independent points, as Sobol's advantage is long gone.
MAX_SOBOL_DIM = 1000
# expected number of coordinates that a local move changes
N_MOVED_COORDINATES = 4
RESAMPLED_FRACTION = 0.3  # fraction of the moved choices that are sampled anew
# standard deviation of local moves, as fractions of a coordinate's range; log-uniform
# between these
MIN_MOVE = 0.01
MAX_MOVE = 0.3


@dataclass(frozen=True, eq=False)
class BoxCoordinates:
    """The k coordinates of the unit box: u[indices] = low + width * x, x in [0, 1]^k.

    Attributes:
        indices: (k,) of the elements of u.
        low: (k,) their lower bounds.
        width: (k,) of their ranges.
        periodic: (k,) whether 0 and 1 mean the same value, as for an angle.
        option_counts: (k,) number of options of a discrete choice; 0 for a number.
    """

    indices: Tensor
    low: Tensor
    width: Tensor
    periodic: Tensor
    option_counts: Tensor

    @property
    def count(self) -> int:
        return len(self.indices)

    def from_configuration(self, u: Tensor) -> Tensor:
        """Return the points (..., k) of configurations (..., d)."""
        return ((u[..., self.indices] - self.low) / self.width).clamp_(0.0, 1.0)

    def to_configuration(self, u: Tensor, x: Tensor) -> Tensor:
        """Return a copy of configurations (..., d) whose box coordinates are the points
        x (..., k) of the unit box; the other elements of u stay.
        """
        u = u.clone()
        u[..., self.indices] = torch.clamp(
            self.low + self.width * x, self.low, self.low + self.width
        )
        return u

    def normalize(self, x: Tensor) -> Tensor:
        """Return points (n, k) moved into the box: angles wrap, choices go to the
        center of their option, other numbers are clipped.
        """
        x = torch.where(self.periodic, torch.remainder(x, 1.0), x).clamp_(0.0, 1.0)
        return torch.where(
            self.option_counts > 0, option_center(x, self.option_counts.clamp(min=1)), x
        )

    def sample_screen(self, seed: int, n: int) -> Tensor:
        """Return evenly spread points (n, k), of a scrambled Sobol sequence.

        With very many coordinates they are independent points instead. `normalize`
        moves their choices to the centers of options.
        """
        if n == 0:
            return torch.empty(0, self.count)
        if self.count > MAX_SOBOL_DIM:
            return self.normalize(torch.rand(n, self.count, generator=seeded(seed, 0)))
        engine = torch.quasirandom.SobolEngine(self.count, scramble=True, seed=seed)
        return self.normalize(engine.draw(n))

    def sample_moves(self, x: Tensor, generator: torch.Generator) -> Tensor:
        """Return the points x (n, k) after a random move of each, (n, k).

        A few coordinates of each point are selected to move, at least one. A selected
        number changes by normal noise of a random size. A selected choice is sampled
        again with the probability `RESAMPLED_FRACTION`, and otherwise stays. Points are
        moved back into the box at the end (`normalize`).

        Args:
            x: (n, k) points of the unit box.
            generator: generator of random numbers; it advances.
        """
        n, k = x.shape
        # log-uniform from `MIN_MOVE` to `MAX_MOVE`
        log_range = math.log(MAX_MOVE / MIN_MOVE)
        size = MIN_MOVE * torch.exp(log_range * torch.rand(n, 1, generator=generator))
        is_moved = _select_moved(n, k, generator)
        noise = torch.randn(n, k, generator=generator)
        is_choice = self.option_counts > 0
        x = torch.where(is_choice, x, x + is_moved * size * noise)
        may_resample = torch.rand(n, k, generator=generator) < RESAMPLED_FRACTION
        is_resampled = is_moved & is_choice & may_resample
        uniform = torch.rand(n, k, generator=generator)
        return self.normalize(torch.where(is_resampled, uniform, x))

    def embed(self, x: Tensor, lengths: Tensor) -> Tensor:
        """Map points to features whose Euclidean distances the kernel uses.

        Every coordinate is divided by its length scale. An angle becomes a point on a
        circle of circumference 2. An option becomes the corner of a simplex, so that
        different options have the distance 1.

        Args:
            x: (n, k) points of the unit box.
            lengths: (k,) length scales.

        Returns:
            (n, f) float64.
        """
        x = x.double()
        is_plain = ~self.periodic & (self.option_counts == 0)
        angle = 2.0 * math.pi * x[:, self.periodic]
        # the circle has the radius 1 / pi, divided by the length scale
        scaled_length = math.pi * lengths[self.periodic]
        features = [
            x[:, is_plain] / lengths[is_plain],
            angle.cos() / scaled_length,
            angle.sin() / scaled_length,
        ]
        for coordinate in torch.nonzero(self.option_counts).flatten().tolist():
            corner = self._embed_choice(x, coordinate)
            features.append(corner / (math.sqrt(2.0) * lengths[coordinate]))
        return torch.cat(features, dim=1)

    def _embed_choice(self, x: Tensor, coordinate: int) -> Tensor:
        """Return the one-hot code (n, options) of a choice, by its coordinate.

        Two different codes are sqrt(2) apart.
        """
        n_options = int(self.option_counts[coordinate])
        option = (x[:, coordinate] * n_options).long().clamp_(max=n_options - 1)
        return torch.nn.functional.one_hot(option, n_options).double()


def _select_moved(n: int, k: int, generator: torch.Generator) -> Tensor:
    """Select which coordinates of n points move, at least one of each, (n, k) bool."""
    is_moved = torch.rand(n, k, generator=generator) < N_MOVED_COORDINATES / k
    always_moved = torch.randint(k, (n,), generator=generator)
    is_moved[torch.arange(n), always_moved] = True
    return is_moved


def find_box_coordinates(domain: Domain) -> BoxCoordinates:
    """Return the coordinates of a domain that belong to no norm ball; there may be
    none.
    """
    index_blocks = [
        torch.arange(part.start, part.stop)
        for block, part in domain.list_block_slices()
        if block.norm == "box"
    ]
    # an empty one first, since `cat` needs at least one tensor
    indices = torch.cat([torch.empty(0, dtype=torch.long), *index_blocks])
    return BoxCoordinates(
        indices,
        low=domain.lower_bounds[indices],
        width=domain.upper_bounds[indices] - domain.lower_bounds[indices],
        periodic=find_periodic(domain)[indices],
        option_counts=domain.option_counts[indices],
    )


LENGTHS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Candidate length scales, in units of the square root of the number of coordinates, as
distances between points grow with it.
"""

# candidate variances of the noise, as fractions of the signal's
NOISE_VARIANCES = (1e-4, 1e-2, 0.1, 0.5, 2.0)
# factors by which the length scale of a single coordinate is changed on trial
LENGTH_FACTORS = (0.5, 2.0, 4.0)
# largest length scale, in the same units: above it the coordinate no longer matters
MAX_LENGTH = 8.0
# gain in log-likelihood that a coordinate's own length must bring; less would fit the
# noise
MIN_LIKELIHOOD_GAIN = 1.0
# new points after which length scales and noise are fitted again, or a tenth of all if
# that is more
REFIT_INTERVAL = 5
# number of the best points, and of the latest points, that a process is fitted to
MEMORY = 100
# Largest number of coordinates that have their own length scales. More of them share
# one.
MAX_SCALED_DIM = 16


@dataclass(frozen=True, eq=False)
class Scales:
    """Hyperparameters of the process.

    Attributes:
        lengths: (k,) length scales.
        noise: variance of the noise, as a fraction of the signal's.
    """

    lengths: Tensor
    noise: float


@dataclass(frozen=True, eq=False)
class Surrogate:
    """A process fitted to n points.

    Attributes:
        box: kinds of the k coordinates.
        x: (n, k) points of the unit box.
        scales: hyperparameters.
        factor: (n, n) Cholesky factor of the kernel matrix with noise, for a signal of
            variance 1.
        weights: (n,) the inverse of that matrix, times the values without their mean.
        mean: mean of the signal.
        variance: variance of the signal.
        likelihood: log-likelihood, up to a constant.
    """

    box: BoxCoordinates
    x: Tensor
    scales: Scales
    factor: Tensor
    weights: Tensor
    mean: float
    variance: float
    likelihood: float

    def predict(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Predict the noise-free objective at points.

        Args:
            x: (m, k) points of the unit box.

        Returns:
            Mean and standard deviation, (m,) each.
        """
        lengths = self.scales.lengths
        # (m, n) correlations of the new points with the known ones
        cross = kernel(self.box.embed(x, lengths), self.box.embed(self.x, lengths))
        solved = torch.linalg.solve_triangular(self.factor, cross.mT, upper=False)
        # fraction of the signal's variance that the known points leave; over 0, also at
        # a known point
        unexplained = (1.0 - solved.square().sum(dim=0)).clamp_(min=1e-12)
        return self.mean + cross @ self.weights, (self.variance * unexplained).sqrt_()


@dataclass(frozen=True, eq=False)
class Observations:
    """The evaluations of a search, and the scales of the process behind them.

    Attributes:
        box: kinds of the k coordinates.
        points: (n, k) points that were evaluated.
        values: n objectives; not finite if a point could not be evaluated.
        scales: scales of the latest fit; None before the first.
        n_fitted: number of points when the scales were fitted.
        memory: number of the best points, and of the latest points, that a process is
            fitted to. Its scales are always fitted to `MEMORY` of each.
    """

    box: BoxCoordinates
    points: Tensor
    values: tuple[float, ...] = ()
    scales: Scales | None = None
    n_fitted: int = 0
    memory: int = MEMORY

    @property
    def has_finite(self) -> bool:
        return any(math.isfinite(value) for value in self.values)

    def extend(self, evaluated: Evaluated) -> Observations:
        """Return the observations with further evaluations."""
        new_points = [self.box.from_configuration(u)[None] for u, _ in evaluated]
        new_values = [evaluation.objective for _, evaluation in evaluated]
        return replace(
            self,
            points=torch.cat([self.points, *new_points]),
            values=(*self.values, *new_values),
        )

    def fit_surrogate(self) -> tuple[Surrogate, Observations]:
        """Fit a Gaussian process; return it, and the observations with its scales.

        At least one value must be finite; others count as the smallest one. If there
        are many points, only the best and the latest are used. The scales (length
        scales and noise) take long to fit. So they are fitted again only after
        `REFIT_INTERVAL` new points, or a tenth of all points if that is more.
        """
        n_points = len(self.values)
        values = self._replace_non_finite_values()
        scales = self.scales
        n_fitted = self.n_fitted  # number of points when the scales were fitted
        refit_interval = max(REFIT_INTERVAL, n_fitted // 10)
        if scales is None or n_points - n_fitted >= refit_interval:
            scales = self._fit_scales(values)
            n_fitted = n_points
        used = _select_best_and_latest(values, self.memory)
        used_points = self.points[used]
        surrogate = fit_gaussian_process(self.box, used_points, values[used], scales)
        return surrogate, replace(self, scales=scales, n_fitted=n_fitted)

    def _replace_non_finite_values(self) -> Tensor:
        """Return the values (n,) float64, with the smallest one for each that is not
        finite.
        """
        values = torch.tensor(self.values, dtype=torch.float64)
        is_finite = torch.isfinite(values)
        return torch.where(is_finite, values, values[is_finite].min())

    def _fit_scales(self, values: Tensor) -> Scales:
        """Return the scales that fit finite objectives (n,) of the points best.

        As fitting scales is slow, it uses `MEMORY` of the best and of the latest
        points, even if `self.memory`, for predictions, is larger.
        """
        used = _select_best_and_latest(values, MEMORY)
        return _find_best_scales(self.box, self.points[used], values[used])


def _select_best_and_latest(values: Tensor, memory: int) -> Tensor:
    """Return the indices of the best and of the latest values.

    The latest are the last `memory` values; the best are the `memory` largest of the
    earlier ones, and come first. If there are at most 2 * `memory` values, the indices
    of all are returned in order.
    """
    n_earlier = len(values) - memory
    if n_earlier <= memory:
        return torch.arange(len(values))
    order = values[:n_earlier].argsort(descending=True, stable=True)
    latest = torch.arange(n_earlier, len(values))
    return torch.cat([order[:memory], latest])


def kernel(a: Tensor, b: Tensor) -> Tensor:
    """Return the Matérn-5/2 correlations (n, m) between points (n, f) and (m, f)."""
    r = math.sqrt(5.0) * torch.cdist(a, b)
    return (1.0 + r + r.square() / 3.0) * torch.exp(-r)


def fit_gaussian_process(
    box: BoxCoordinates, x: Tensor, y: Tensor, scales: Scales | None = None
) -> Surrogate:
    """Fit a Gaussian process to values at points of the unit box.

    Its mean and variance maximize the likelihood.

    Args:
        box: kinds of the k coordinates.
        x: (n, k) points.
        y: (n,) values.
        scales: length scales of the kernel and variance of the noise; by default those
            of maximum likelihood.
    """
    scales = scales or _find_best_scales(box, x, y)
    n = len(x)
    factor = _factorize_kernel(box.embed(x, scales.lengths), scales.noise)
    right_sides = torch.stack([y.double(), torch.ones(n, dtype=torch.float64)], dim=1)
    # K^-1 y and K^-1 1, with which generalised least squares give the mean
    solved_values, solved_ones = torch.cholesky_solve(right_sides, factor).T
    mean = float(solved_values.sum() / solved_ones.sum())
    weights = solved_values - mean * solved_ones
    # (y - mean)' K^-1 (y - mean) / n
    variance = max(float(weights @ (y.double() - mean)) / n, 1e-30)
    likelihood = -0.5 * n * math.log(variance) - float(factor.diagonal().log().sum())
    return Surrogate(box, x, scales, factor, weights, mean, variance, likelihood)


def _factorize_kernel(features: Tensor, noise: float) -> Tensor:
    """Return the Cholesky factor (n, n) of the kernel matrix of features (n, f)."""
    # 1e-8 keeps the matrix positive definite where points coincide
    diagonal = (noise + 1e-8) * torch.eye(len(features), dtype=torch.float64)
    factor: Tensor = torch.linalg.cholesky(kernel(features, features) + diagonal)
    return factor


def _find_best_scales(box: BoxCoordinates, x: Tensor, y: Tensor) -> Scales:
    """Return the length scales and the noise with the largest likelihood.

    First a common length scale and the noise are chosen from grids. Then the length
    scale of each coordinate in turn is multiplied by a factor, if that increases the
    log likelihood by more than `MIN_LIKELIHOOD_GAIN`.

    Args:
        box: kinds of the k coordinates.
        x: (n, k) points of the unit box.
        y: (n,) values.
    """
    k = x.shape[1]
    best = _find_most_likely(box, x, y, _list_common_scales(k))
    # A single coordinate is fitted already. With many coordinates all share one scale.
    if not 1 < k <= MAX_SCALED_DIM:
        return best.scales
    for coordinate in range(k):
        candidates = _list_changed_scales(best.scales, coordinate)
        changed = _find_most_likely(box, x, y, candidates)
        if changed.likelihood > best.likelihood + MIN_LIKELIHOOD_GAIN:
            best = changed
    return best.scales


def _find_most_likely(
    box: BoxCoordinates, x: Tensor, y: Tensor, candidates: list[Scales]
) -> Surrogate:
    """Return the process of the largest likelihood, fitted with each of some scales.

    The first three arguments are those of `fit_gaussian_process`.
    """
    fits = [fit_gaussian_process(box, x, y, scales) for scales in candidates]
    return max(fits, key=lambda surrogate: surrogate.likelihood)


def _list_common_scales(k: int) -> list[Scales]:
    """Return a grid of noises and of lengths that all k coordinates share."""
    # Distances in the unit box grow with the square root of its dimension.
    length_unit = math.sqrt(k)
    return [
        Scales(torch.full((k,), length_unit * length).double(), noise)
        for length in LENGTHS
        for noise in NOISE_VARIANCES
    ]


def _list_changed_scales(scales: Scales, coordinate: int) -> list[Scales]:
    """Return scales in which the length of one coordinate is multiplied by a factor."""
    max_length = math.sqrt(len(scales.lengths)) * MAX_LENGTH
    changed_scales = []
    for factor in LENGTH_FACTORS:
        lengths = scales.lengths.clone()
        changed_length = float(lengths[coordinate]) * factor
        lengths[coordinate] = min(max_length, changed_length)
        changed_scales.append(Scales(lengths, scales.noise))
    return changed_scales
