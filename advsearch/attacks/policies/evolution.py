"""Evolution strategies, which need no gradients of the model.

`NES`, a natural evolution strategy with independent elements, follows the gradient of
the expected objective. `CMAES`, covariance matrix adaptation, only uses the ranks of
objectives.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.attacks.domain import (
    Distribution,
    Domain,
    compute_half_widths,
    find_periodic,
)
from advsearch.attacks.evaluation import (
    Evaluated,
    Policy,
    Proposal,
    draw_seed,
    limit_to_single_thread,
    seeded,
)
from advsearch.errors import InputError
from advsearch.seeds import derive_seed

MAX_FULL_DIM = 80
"""Largest dimension with a full covariance matrix. Above it only the diagonal is
adapted (Ros and Hansen 2008). From about this size on, the linear algebra would also
use several threads, so that last bits could differ.
"""

# More numbers are rejected: a generation would take longer than its renders, and a
# gradient ascent is far better there.
MAX_DIM = 10_000
MAX_STEP_SIZE = 10.0
MIN_STEP_SIZE = 1e-3
"""Limits of the step size, in half ranges. It can only reach the maximum if many
objectives are equal. A run of CMA-ES is over when its largest standard deviation is at
or below the minimum.
"""

Float64Array = npt.NDArray[np.float64]


def utilities(values: Sequence[float]) -> list[float]:
    """Return the weight of each of n objectives by its rank (Wierstra et al. 2014).

    The largest objective has rank 1. The weight is max(0, ln(n/2 + 1) - ln(rank)),
    divided by the sum of these over all ranks, minus 1/n. Weights sum to zero and are
    larger for larger objectives. Equal objectives share the mean weight of their ranks.
    """
    n = len(values)
    rank_weights = [
        max(0.0, math.log(n / 2 + 1) - math.log(rank)) for rank in range(1, n + 1)
    ]
    total = math.fsum(rank_weights)
    descending = sorted(values, reverse=True)
    weight_of_value = {}
    for value in set(values):
        mean_weight = _average_rank_weights(value, descending, rank_weights)
        weight_of_value[value] = mean_weight / total - 1.0 / n
    return [weight_of_value[value] for value in values]


def _average_rank_weights(
    value: float, descending: Sequence[float], rank_weights: Sequence[float]
) -> float:
    """Return the mean weight of the ranks that a value has among all values.

    Args:
        value: one of the values; equal ones share their ranks.
        descending: all values, the largest first.
        rank_weights: weight of each rank.
    """
    first = descending.index(value)  # index of the first of its ranks
    count = descending.count(value)
    return math.fsum(rank_weights[first : first + count]) / count


@dataclass(frozen=True, eq=False)
class NESState:
    """State of the search. Samples are not stored but drawn again from their seeds.

    Attributes:
        domain: domain of the search.
        seed: seed of random numbers.
        half_widths: (d,) half of the range of each element of u.
        mean: (d,) mean of the distribution, in u.
        deviation: (d,) standard deviation of the distribution, in half ranges.
        population: number of samples of a generation, even.
        generation: index of the current generation.
        values: objectives of those of its samples that were evaluated, the first ones.
    """

    domain: Domain
    seed: int
    half_widths: Tensor
    mean: Tensor
    deviation: Tensor
    population: int
    generation: int = 0
    values: tuple[float, ...] = ()

    def noise(self, number: int) -> Tensor:
        """Return standard normal noise (d,) for sample `number` of the generation.

        An odd sample has the negative of the one before (antithetic pairs).
        """
        pair, is_mirrored = divmod(number, 2)
        pairs_per_generation = self.population // 2
        generator = seeded(self.seed, self.generation * pairs_per_generation + pair)
        noise = torch.randn(self.domain.dim, generator=generator)
        return noise.neg_() if is_mirrored else noise

    def update_distribution(self) -> NESState:
        """Return the state with the distribution after a complete generation.

        With weights w_k by the rank of the objectives, standard normal samples s_k and
        the projection P onto the domain:

            mean      <- P(mean + deviation * sum_k w_k s_k)
            deviation <- deviation * exp(rate / 2 * sum_k w_k (s_k^2 - 1))
        """
        d = self.domain.dim
        # the sums over w_k s_k and w_k s_k^2
        mean_gradient, square_sum = self.sum_weighted_noise()
        # the rate of Wierstra et al. 2014
        rate = (3.0 + math.log(d)) / (5.0 * math.sqrt(d))
        # The sum over w_k (s_k^2 - 1) is that over w_k s_k^2, as the weights sum to 0.
        growth = square_sum.mul_(rate / 2.0).exp_()
        deviation = (self.deviation * growth).clamp_(MIN_STEP_SIZE, MAX_STEP_SIZE)
        # with the deviation of this generation, which is in half ranges
        step = self.half_widths * self.deviation * mean_gradient
        mean = self.domain.project(self.mean + step)
        generation = self.generation + 1
        return replace(
            self, mean=mean, deviation=deviation, generation=generation, values=()
        )

    def sum_weighted_noise(self) -> tuple[Tensor, Tensor]:
        """Return sum_k w_k s_k and sum_k w_k s_k^2 of a complete generation, (d,) each.

        Sample k has the standard normal noise s_k (d,), and a weight w_k by the rank of
        its objective (`utilities`).
        """
        weights = utilities(self.values)
        noise_sum = torch.zeros(self.domain.dim)
        square_sum = torch.zeros(self.domain.dim)
        # Samples come in pairs with the noise s and -s, which is drawn once.
        for number in range(0, self.population, 2):
            noise = self.noise(number)
            weight = weights[number]
            mirrored_weight = weights[number + 1]
            noise_sum.add_(noise, alpha=weight - mirrored_weight)
            square_sum.addcmul_(noise, noise, value=weight + mirrored_weight)
        return noise_sum, square_sum


@dataclass(frozen=True)
class NES(Policy[NESState]):
    """Separable natural evolution strategy (SNES; Wierstra, Schaul, Glasmachers, Sun,
    Peters and Schmidhuber 2014, "Natural evolution strategies", algorithm 6).

    The distribution is normal with independent elements, projected onto the domain.
    Each generation draws n samples u_k = P(mean + deviation * s_k), ranks them, and
    steps along the natural gradient of the expected utility:

        mean      <- P(mean + deviation * sum_k w_k s_k)
        deviation <- deviation * exp(rate / 2 * sum_k w_k (s_k^2 - 1))

    with w_k = max(0, ln(n/2 + 1) - ln(rank_k)) normalized to the sum 1, minus 1/n, and
    rate = (3 + ln d) / (5 sqrt d). Two things differ from the paper: samples come in
    pairs s and -s, and equal objectives share their weights.

    Its result is the distribution, besides the best configuration: a set of
    configurations that are bad on average. Memory and time of a step are those of a few
    vectors of the size of the domain, so it can search textures too. But it needs
    twenty to a hundred renders for each number.

    Attributes:
        sigma: first standard deviation, over 0 and at most 2, in units of half of each
            number's range (in a ball, of the part of it inside the ball).
        population: number of samples of a generation, even, at least 4; 0 for 4 + 3 ln
            d, rounded up to an even number.
    """

    sigma: float = 0.3
    population: int = 0

    name: ClassVar[str] = "nes"
    uses_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Check that all settings are within their limits."""
        _check_sigma(self.sigma)
        has_default_population = self.population == 0
        is_odd = self.population % 2 == 1
        if not has_default_population and (self.population < 4 or is_odd):
            raise InputError(
                "population: expected an even number of at least 4, or "
                f"0, got {self.population}"
            )

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> NESState:
        """Start at the domain's initial point.

        The standard deviation of an element is `sigma` times half of its range.

        Args:
            domain: domain of the search.
            generator: source of the seed.
            steps: renders of the search; not used.
        """
        # the default of CMA-ES (Hansen 2016), made even for pairs
        default_population = 4 + int(3 * math.log(domain.dim))
        default_population += default_population % 2
        return NESState(
            domain,
            draw_seed(generator),
            compute_half_widths(domain),
            mean=domain.initial_point,
            deviation=torch.full_like(domain.start, self.sigma),
            population=self.population or default_population,
        )

    def propose(self, state: NESState, n: int) -> tuple[tuple[Proposal, ...], NESState]:
        """Propose the next samples of the present generation, up to n."""
        first = len(state.values)
        proposals = []
        for number in range(first, min(first + n, state.population)):
            offset = state.half_widths * state.deviation * state.noise(number)
            proposals.append(Proposal(state.domain.project(state.mean + offset)))
        return tuple(proposals), state

    def update(self, state: NESState, evaluated: Evaluated) -> NESState:
        """Add evaluations to the generation, and update the distribution at its end."""
        new_values = [evaluation.objective for _, evaluation in evaluated]
        state = replace(state, values=(*state.values, *new_values))
        if len(state.values) < state.population:
            return state
        return state.update_distribution()

    def distribution(self, state: NESState) -> Distribution:
        return Distribution(state.mean, state.half_widths * state.deviation)


def _check_sigma(sigma: float) -> None:
    """Raise InputError if the first standard deviation is outside of (0, 2]."""
    if not 0.0 < sigma <= 2.0:
        raise InputError(
            "sigma: expected a number in (0, 2], in units of half the range, got "
            f"{sigma}"
        )


def _sample_normal(*shape: int) -> Float64Array:
    """Return standard normal numbers from numpy's global generator.

    pycma's default generator would be copied with every copy of a strategy.
    """
    return np.random.standard_normal(shape)  # noqa: NPY002


@contextmanager
def _isolate_numpy_random(seed: int, generation: int) -> Iterator[None]:
    """Seed numpy's global random generator for pycma, and restore it afterwards.

    pycma draws from that generator. Its warnings are ignored inside the context.

    Args:
        seed: seed of the search.
        generation: index of the generation; each has its own random numbers.
    """
    state_before = np.random.get_state()  # noqa: NPY002
    np.random.seed(derive_seed(seed, "pycma", generation))  # noqa: NPY002
    try:
        with warnings.catch_warnings(), limit_to_single_thread():
            warnings.simplefilter("ignore")
            yield
    finally:
        np.random.set_state(state_before)  # noqa: NPY002


@dataclass(frozen=True, eq=False)
class CMAESState:
    """State of the search. u = P(origin + half_widths * x) for coordinates x of pycma.

    Attributes:
        domain: domain of the search.
        seed: seed of random numbers.
        origin: (d,) configuration at x = 0, where the current run began.
        half_widths: (d,) half of the range of each element of u.
        is_periodic: (d,) which elements wrap, so that they are never out of the domain.
        strategy: pycma's object after the latest `ask`; it is copied before it is
            changed.
        generation: index of the current generation.
        points: (n, d) points of the generation, in x.
        values: objectives of those points that were evaluated, the first ones.
        violations: mean squared distance of the same points from the domain.
        best: largest objective of the current run.
        best_run: largest objective of all earlier runs, and the final distribution of
            the run that reached it; None in the first run.
    """

    domain: Domain
    seed: int
    origin: Tensor
    half_widths: Tensor
    is_periodic: Tensor
    strategy: Any
    generation: int
    points: Float64Array
    values: tuple[float, ...] = ()
    violations: tuple[float, ...] = ()
    best: float = -math.inf
    best_run: tuple[float, Distribution] | None = None

    @property
    def stds(self) -> Float64Array:
        return np.asarray(self.strategy.stds, dtype=np.float64)

    @property
    def distribution(self) -> Distribution:
        mean, _ = self.project(np.asarray(self.strategy.mean))
        return Distribution(
            mean, torch.from_numpy(self.stds).float() * self.half_widths
        )

    def project(self, x: Float64Array) -> tuple[Tensor, float]:
        """Return the configuration for pycma's coordinates, and how far out they are.

        Args:
            x: (d,) coordinates; 1 is half of the range of an element.

        Returns:
            The configuration (d,), projected onto the domain; and the mean squared
            distance from the domain over all elements of x, in units of x. Periodic
            elements wrap around and are never outside.
        """
        unprojected = torch.add(
            self.origin, self.half_widths * torch.from_numpy(x).float()
        )
        u = self.domain.project(unprojected)
        excess = ((unprojected - u) / self.half_widths).masked_fill_(
            self.is_periodic, 0.0
        )
        return u, float(torch.dot(excess, excess)) / len(x)

    def ask(self) -> CMAESState:
        """Return the state with the points of the next generation, sampled by pycma.

        pycma's object, the strategy, is changed in place. So it must not be shared with
        another state: it has to be a new one, or the copy that `tell` made.
        """
        generation = self.generation + 1
        with _isolate_numpy_random(self.seed, generation):
            points = np.array(self.strategy.ask())
        return replace(
            self, generation=generation, points=points, values=(), violations=()
        )

    def tell(self) -> CMAESState:
        """Return the state after passing a complete generation to a copy of pycma.

        If a point could not be evaluated, its objective is the smallest one minus the
        interquartile range. If a point is outside of the domain, its projection was
        evaluated. Its objective is made worse in proportion to its squared distance
        from the domain: by the interquartile range at a distance of one step size.
        """
        values = np.array(self.values)
        spread = _compute_interquartile_range(values)
        _fill_missing(values, spread)
        strategy = copy.deepcopy(self.strategy)
        step_size = max(strategy.sigma, 1e-30)  # avoids a division by 0
        penalty = spread * np.array(self.violations) / step_size**2
        with _isolate_numpy_random(self.seed, self.generation):
            # pycma minimizes, so the objective is negated and the penalty added
            strategy.tell(list(self.points), list(penalty - values))
        strategy.sigma = min(strategy.sigma, MAX_STEP_SIZE)
        return replace(self, strategy=strategy)


def _compute_interquartile_range(values: Float64Array) -> float:
    """Return the interquartile range of those values (n,) that are finite, or 0."""
    finite_values = values[np.isfinite(values)]
    if not finite_values.size:
        return 0.0
    lower_quartile, upper_quartile = np.percentile(finite_values, (25, 75))
    return float(upper_quartile - lower_quartile)


def _fill_missing(values: Float64Array, spread: float) -> None:
    """Replace values (n,) that are not finite, in place.

    They become the smallest finite value minus `spread`. If none is finite, all become
    equal, which teaches pycma nothing.
    """
    is_finite = np.isfinite(values)
    if is_finite.any():
        values[~is_finite] = values[is_finite].min() - spread
    else:
        values[:] = 0.0


@dataclass(frozen=True)
class CMAES(Policy[CMAESState]):
    """CMA-ES (Hansen and Ostermeier 2001; Hansen 2016, "The CMA evolution strategy: a
    tutorial") as implemented in pycma.

    Each generation draws points from a normal distribution, and moves its mean, its
    step size and its covariance towards the better half. Only ranks are used, so a
    noisy or saturated objective does little harm. The last generation may be cut short
    by the number of renders, and is lost then. So a search should have at least ten
    generations.

    A point outside the domain is projected and evaluated there. Its objective is made
    worse by

        spread * ||x - P(x)||^2 / (d sigma^2),

    where spread is the interquartile range of the generation's objectives, so that the
    mean does not drift outside. Angles wrap.

    A run ends when its largest standard deviation has fallen to a thousandth of half a
    range. The next one begins at a sample of the domain with twice the population
    (Auger and Hansen 2005, "A restart CMA evolution strategy with increasing population
    size"). The distribution that is returned is that of the run with the largest
    objective.

    pycma's object changes in place and draws from numpy's global generator. Here it is
    copied before every change, and the generator is seeded for it and restored at once,
    so that states can be replayed and pickled.

    Attributes:
        sigma: first standard deviation, over 0 and at most 2, in units of half of each
            number's range (in a ball, of the part of it inside the ball).
        population: number of points of a generation, at least 2; 0 for 4 + 3 ln d.
    """

    sigma: float = 0.3
    population: int = 0

    name: ClassVar[str] = "cmaes"
    uses_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Check that all settings are within their limits."""
        _check_sigma(self.sigma)
        if self.population < 0 or self.population == 1:
            raise InputError(
                "population: expected at least 2, or 0 for the default, "
                f"got {self.population}"
            )

    def start(
        self, domain: Domain, generator: torch.Generator, steps: int
    ) -> CMAESState:
        """Start pycma at the domain's initial point, and sample the first generation.

        Args:
            domain: domain of the search.
            generator: source of the seed.
            steps: renders of the search; not used.

        Raises:
            InputError: the domain has more than `MAX_DIM` numbers.
        """
        d = domain.dim
        domain.check_dim(MAX_DIM, "cmaes", "use policy pgd, auto or nes")
        population = self.population or 4 + int(3 * math.log(d))
        seed = draw_seed(generator)
        state = CMAESState(
            domain,
            seed,
            domain.initial_point,
            compute_half_widths(domain),
            find_periodic(domain),
            strategy=self._make_strategy(d, population, seed),
            generation=0,
            points=np.empty((0, d)),
        )
        return state.ask()

    def propose(
        self, state: CMAESState, n: int
    ) -> tuple[tuple[Proposal, ...], CMAESState]:
        points = state.points[len(state.values) :][:n]
        return tuple(Proposal(state.project(x)[0]) for x in points), state

    def update(self, state: CMAESState, evaluated: Evaluated) -> CMAESState:
        """Add evaluations to the generation; begin the next once it is complete.

        If the run has converged (its standard deviations are tiny), another run begins
        at a random point with twice the population, as in IPOP-CMA-ES (Auger and Hansen
        2005).
        """
        state = self._add_values(state, evaluated)
        if len(state.values) < len(state.points):
            return state
        state = state.tell()
        has_converged = float(state.stds.max()) <= MIN_STEP_SIZE
        if has_converged:
            state = self._begin_run(state)
        return state.ask()

    @staticmethod
    def _add_values(state: CMAESState, evaluated: Evaluated) -> CMAESState:
        """Return the state with the evaluations of the generation's next points."""
        values = [evaluation.objective for _, evaluation in evaluated]
        evaluated_points = state.points[len(state.values) :][: len(values)]
        # `project` returns a configuration, and how far x lies out of the domain
        violations = [state.project(x)[1] for x in evaluated_points]
        return replace(
            state,
            values=(*state.values, *values),
            violations=(*state.violations, *violations),
            best=max(state.best, *values),
        )

    def _begin_run(self, state: CMAESState) -> CMAESState:
        """Return the state of a run from a random point, with twice the population."""
        # (best objective, final distribution) of the best run so far
        best_run = state.best_run
        if best_run is None or state.best > best_run[0]:
            best_run = (state.best, state.distribution)
        doubled_population = 2 * len(state.points)
        strategy = self._make_strategy(state.domain.dim, doubled_population, state.seed)
        # the index of the generation gives each run another origin
        origin = state.domain.sample(seeded(state.seed, state.generation))[0]
        return replace(
            state, origin=origin, strategy=strategy, best=-math.inf, best_run=best_run
        )

    def distribution(self, state: CMAESState) -> Distribution:
        if state.best_run is not None and state.best_run[0] > state.best:
            return state.best_run[1]
        return state.distribution

    def _make_strategy(self, d: int, population: int, seed: int) -> Any:
        """Return pycma's strategy, centered on 0 with the standard deviation `sigma`.

        Args:
            d: number of coordinates.
            population: number of samples of a generation.
            seed: seed of the search.
        """
        options = {
            "CMA_diagonal": d > MAX_FULL_DIM,
            "popsize": population,
            "randn": _sample_normal,
            "seed": math.nan,  # leaves numpy's generator as it is
        }
        # no files, and nothing printed
        options |= {"signals_filename": "", "verbose": -9, "verb_log": 0}
        with _isolate_numpy_random(seed, generation=0):
            # imported here: it takes most of a second, and warns without matplotlib
            import cma

            return cma.CMAEvolutionStrategy(np.zeros(d), self.sigma, options)
