"""Evolution strategies, without gradients: a natural one of independent elements, which
follows the gradient of the expected objective, and covariance matrix adaptation, which
learns where to look from ranks alone.
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
from advsearch.seeds import stream

MAX_FULL_DIM = 80
"""Up to so many numbers have a full covariance matrix; more have its diagonal (Ros and
Hansen 2008). Also about the size from which the linear algebra would use several
threads, whose last bits may differ.
"""

# more numbers are refused: a generation would take longer than renders, and an ascent
# is far ahead
MAX_DIM = 10_000
MAX_STEP_SIZE = 10.0
MIN_STEP_SIZE = 1e-3
"""In half ranges: the step size grows no further (it does where all objectives are
equal), and a run is over when its largest deviation is no more than this.
"""

Doubles = npt.NDArray[np.float64]


def utilities(values: Sequence[float]) -> list[float]:
    """Return weights that sum to zero, larger for larger objectives; equal objectives
    share theirs.
    """
    n = len(values)
    by_rank = [
        max(0.0, math.log(n / 2 + 1) - math.log(rank)) for rank in range(1, n + 1)
    ]
    total = math.fsum(by_rank)
    ranked = sorted(values, reverse=True)
    weight = {}
    for value in set(values):
        first = ranked.index(value)
        count = ranked.count(value)
        weight[value] = (
            math.fsum(by_rank[first : first + count]) / count / total - 1.0 / n
        )
    return [weight[value] for value in values]


@dataclass(frozen=True, eq=False)
class NESState:
    """Where the search stands: half ranges (d,), the mean (d,) in u and deviation (d,)
    in half ranges of the distribution, and the objectives of the generation so far.
    Samples are drawn again from their seeds, not kept.
    """

    domain: Domain
    seed: int
    scale: Tensor
    mean: Tensor
    deviation: Tensor
    population: int
    generation: int = 0
    values: tuple[float, ...] = ()

    def noise(self, number: int) -> Tensor:
        """Return sample `number` of the generation, (d,) standard normal; odd ones
        mirror the one before.
        """
        pair, mirrored = divmod(number, 2)
        generator = seeded(self.seed, self.generation * (self.population // 2) + pair)
        noise = torch.randn(self.domain.dim, generator=generator)
        return noise.neg_() if mirrored else noise


@dataclass(frozen=True)
class NES(Policy[NESState]):
    """Separable natural evolution strategy (SNES; Wierstra, Schaul, Glasmachers, Sun,
    Peters and Schmidhuber 2014, "Natural evolution strategies", algorithm 6).

    The distribution is normal with independent elements, projected onto the domain.
    Each generation draws n samples u_k = P(mean + deviation * s_k), ranks them, and
    steps along the natural gradient of the expected utility:

        mean      <- P(mean + deviation * sum_k w_k s_k)
        deviation <- deviation * exp(rate / 2 * sum_k w_k (s_k^2 - 1))

    with w_k = max(0, ln(n/2 + 1) - ln(rank_k)) normalised to the sum 1, less 1/n, and
    rate = (3 + ln d) / (5 sqrt d). We depart from it in that samples come in pairs s
    and -s, and equal objectives share their weights.

    Its result is the distribution, beside the best configuration met: a set of
    configurations that are bad on average. Memory and time a render are a few vectors
    of the domain's size, so it takes textures too; but it needs twenty to a hundred
    renders for each number.

    Attributes:
        sigma: first standard deviation in units of half of each number's range (half of
            what the ball leaves), over 0, at most 2.
        population: samples a generation, even, at least 4; 0 for 4 + 3 ln d, rounded up
            to even.
    """

    sigma: float = 0.3
    population: int = 0

    name: ClassVar[str] = "nes"
    uses_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not 0.0 < self.sigma <= 2.0:
            raise InputError(
                "sigma: expected a number in (0, 2], a share of half the "
                f"range, got {self.sigma}"
            )
        if self.population and (self.population < 4 or self.population % 2):
            raise InputError(
                "population: expected an even number of at least 4, or "
                f"0, got {self.population}"
            )

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> NESState:
        default = 4 + int(3 * math.log(domain.dim))
        population = self.population or default + default % 2
        deviation = torch.full_like(domain.start, self.sigma)
        return NESState(
            domain,
            draw_seed(generator),
            compute_half_widths(domain),
            domain.begin,
            deviation,
            population,
        )

    def propose(self, state: NESState, n: int) -> tuple[tuple[Proposal, ...], NESState]:
        numbers = range(len(state.values), min(len(state.values) + n, state.population))
        moves = (
            state.scale * state.deviation * state.noise(number) for number in numbers
        )
        return tuple(
            Proposal(state.domain.project(state.mean + move)) for move in moves
        ), state

    def update(self, state: NESState, evaluated: Evaluated) -> NESState:
        state = replace(
            state,
            values=(
                *state.values,
                *(evaluation.objective for _, evaluation in evaluated),
            ),
        )
        if len(state.values) < state.population:
            return state
        weights = utilities(state.values)
        d = state.domain.dim
        towards = torch.zeros(d)
        wider = torch.zeros(d)
        for first in range(0, state.population, 2):
            noise = state.noise(first)
            towards.add_(noise, alpha=weights[first] - weights[first + 1])
            wider.addcmul_(noise, noise, value=weights[first] + weights[first + 1])
        # weights sum to zero, so the -1 of every term drops out
        rate = (3.0 + math.log(d)) / (5.0 * math.sqrt(d))
        deviation = (state.deviation * wider.mul_(rate / 2.0).exp_()).clamp_(
            MIN_STEP_SIZE, MAX_STEP_SIZE
        )
        mean = state.domain.project(
            state.mean + state.scale * state.deviation * towards
        )
        return replace(
            state,
            mean=mean,
            deviation=deviation,
            generation=state.generation + 1,
            values=(),
        )

    def distribution(self, state: NESState) -> Distribution:
        return Distribution(state.mean, state.scale * state.deviation)


def _sample_normal(*shape: int) -> Doubles:
    """Standard normal numbers from numpy's global generator. (A copy of pycma's default
    carries its own along.)
    """
    return np.random.standard_normal(shape)  # noqa: NPY002


@contextmanager
def _isolate_numpy_random(seed: int, generation: int) -> Iterator[None]:
    """Let pycma draw numbers of its own from numpy's global generator, and put that
    back; its warnings are not ours.
    """
    state_before = np.random.get_state()  # noqa: NPY002
    np.random.seed(stream(seed, "pycma", generation))  # noqa: NPY002
    try:
        with warnings.catch_warnings(), limit_to_single_thread():
            warnings.simplefilter("ignore")
            yield
    finally:
        np.random.set_state(state_before)  # noqa: NPY002


@dataclass(frozen=True, eq=False)
class CMAESState:
    """Where the search stands. u = P(origin + scale * x) for coordinates x of pycma,
    whose strategy, as it is after the latest `ask`, is never written to again; of this
    generation's points (n, d) in x, the first have values and squared distances from
    the domain, means over elements (`outside`). `before` is the largest objective of
    the runs before, with the distribution at the end of the one that met it.
    """

    domain: Domain
    seed: int
    origin: Tensor
    scale: Tensor
    wraps: Tensor
    strategy: Any
    generation: int
    points: Doubles
    values: tuple[float, ...] = ()
    outside: tuple[float, ...] = ()
    best: float = -math.inf
    before: tuple[float, Distribution] | None = None

    @property
    def deviations(self) -> Doubles:
        return np.asarray(self.strategy.stds, dtype=np.float64)

    @property
    def distribution(self) -> Distribution:
        mean, _ = self.project(np.asarray(self.strategy.mean))
        return Distribution(
            mean, torch.from_numpy(self.deviations).float() * self.scale
        )

    def project(self, x: Doubles) -> tuple[Tensor, float]:
        """Return the configuration for coordinates x, and how far outside they lie:
        mean square over the elements.
        """
        wanted = torch.add(self.origin, self.scale * torch.from_numpy(x).float())
        u = self.domain.project(wanted)
        excess = ((wanted - u) / self.scale).masked_fill_(self.wraps, 0.0)
        return u, float(torch.dot(excess, excess)) / len(x)

    def ask(self) -> CMAESState:
        """Draw a generation; the strategy belongs to nobody else yet."""
        number = self.generation + 1
        with _isolate_numpy_random(self.seed, number):
            points = np.array(self.strategy.ask())
        return replace(self, generation=number, points=points, values=(), outside=())

    def tell(self) -> CMAESState:
        values = np.array(self.values)
        spread = 0.0
        finite = np.isfinite(values)
        if finite.any():
            low, high = np.percentile(values[finite], (25, 75))
            spread = float(high - low)
            values[~finite] = values[finite].min() - spread
        else:
            values[:] = 0.0
        strategy = copy.deepcopy(self.strategy)
        penalty = spread * np.array(self.outside) / max(strategy.sigma, 1e-30) ** 2
        with _isolate_numpy_random(self.seed, self.generation):
            strategy.tell(list(self.points), list(penalty - values))
        strategy.sigma = min(strategy.sigma, MAX_STEP_SIZE)
        return replace(self, strategy=strategy)


@dataclass(frozen=True)
class CMAES(Policy[CMAESState]):
    """CMA-ES (Hansen and Ostermeier 2001; Hansen 2016, "The CMA evolution strategy: a
    tutorial") as pycma has it.

    Each generation draws points from a normal distribution and moves its mean, its step
    size and its covariance towards the better half. It needs ranks only, so a noisy or
    saturated objective does not upset it. A generation that the renders cut short is
    lost, so it wants at least ten generations.

    A point outside the domain is projected and evaluated there. Its objective is made
    worse by

        spread * ||x - P(x)||^2 / (d sigma^2),

    spread the distance between the quartiles of the generation, so that the mean does
    not drift outside. Angles wrap.

    A run whose largest deviation has fallen under a thousandth of half a range has
    nothing more to find. The next one begins at a sample of the domain with twice the
    population (Auger and Hansen 2005, "A restart CMA evolution strategy with increasing
    population size"). The distribution returned is that of the run that met the largest
    objective.

    pycma's object changes as it goes and draws from numpy's global generator. Here it
    is copied before every change, and the generator is seeded for it and put back at
    once, so that states can be replayed and pickled.

    Attributes:
        sigma: first standard deviation in units of half of each number's range (half of
            what the ball leaves), over 0, at most 2.
        population: points a generation, at least 2; 0 for 4 + 3 ln d.
    """

    sigma: float = 0.3
    population: int = 0

    name: ClassVar[str] = "cmaes"
    uses_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not 0.0 < self.sigma <= 2.0:
            raise InputError(
                "sigma: expected a number in (0, 2], a share of half the "
                f"range, got {self.sigma}"
            )
        if self.population < 0 or self.population == 1:
            raise InputError(
                "population: expected at least 2, or 0 for the default, "
                f"got {self.population}"
            )

    def start(
        self, domain: Domain, generator: torch.Generator, steps: int
    ) -> CMAESState:
        d = domain.dim
        if d > MAX_DIM:
            raise InputError(
                f"policy 'cmaes': expected at most {MAX_DIM} numbers, got "
                f"{d}; use policy pgd, auto or nes"
            )
        population = self.population or 4 + int(3 * math.log(d))
        seed = draw_seed(generator)
        strategy = self._make_strategy(d, population, seed)
        scale = compute_half_widths(domain)
        around = find_periodic(domain)
        none = np.empty((0, d))
        return CMAESState(
            domain, seed, domain.begin, scale, around, strategy, 0, none
        ).ask()

    def propose(
        self, state: CMAESState, n: int
    ) -> tuple[tuple[Proposal, ...], CMAESState]:
        points = state.points[len(state.values) :][:n]
        return tuple(Proposal(state.project(x)[0]) for x in points), state

    def update(self, state: CMAESState, evaluated: Evaluated) -> CMAESState:
        values = [evaluation.objective for _, evaluation in evaluated]
        outside = [
            state.project(x)[1]
            for x in state.points[len(state.values) :][: len(values)]
        ]
        best = max(state.best, *values)
        state = replace(
            state,
            values=(*state.values, *values),
            outside=(*state.outside, *outside),
            best=best,
        )
        if len(state.values) < len(state.points):
            return state
        state = state.tell()
        if float(state.deviations.max()) > MIN_STEP_SIZE:
            return state.ask()
        # another run elsewhere, with twice the population; the better one of those that
        # are over is remembered
        before = state.before
        if before is None or state.best > before[0]:
            before = (state.best, state.distribution)
        strategy = self._make_strategy(
            state.domain.dim, 2 * len(state.points), state.seed
        )
        origin = state.domain.sample(seeded(state.seed, state.generation))[0]
        return replace(
            state, origin=origin, strategy=strategy, best=-math.inf, before=before
        ).ask()

    def distribution(self, state: CMAESState) -> Distribution:
        if state.before is not None and state.before[0] > state.best:
            return state.before[1]
        return state.distribution

    def _make_strategy(self, d: int, population: int, seed: int) -> Any:
        options = {
            "CMA_diagonal": d > MAX_FULL_DIM,
            "popsize": population,
            "randn": _sample_normal,
            "seed": math.nan,
        }
        options |= {"signals_filename": "", "verbose": -9, "verb_log": 0}
        with _isolate_numpy_random(seed, 0):
            # takes most of a second, and complains where there is no matplotlib
            import cma

            return cma.CMAEvolutionStrategy(np.zeros(d), self.sigma, options)
