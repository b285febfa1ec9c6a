"""Learn the distribution of failures as a mixture, and estimate the failure rate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.extend import InputError, Policy, policies

MAX_DIM = (
    50  # more numbers are refused: there would never be enough draws to learn from
)
WINDOW = 1000
ELITE_FRACTION = 0.1
MIN_ELITE = 10
"""Where fewer draws failed, those with the largest objectives stand in for failures: a
tenth of them, ten at least.
"""

N_FIT_ROUNDS = 8
UNIFORM_DEVIATION = 12**-0.5
PRIOR_COUNT = 3.0
"""Deviation of the even distribution in shares of a range; it counts for so many draws
of each component, so that what does not matter stays wide.
"""

MIN_DEVIATION = (
    0.02  # deviations of a number, in shares of its range, at least and at most
)
MAX_DEVIATION = 10.0
DISTINCTIVE_FRACTION = 0.5
"""A number tells a component apart where its deviation is under so much of the even
one's; an option, where it has more than so much of the probability.
"""


@dataclass(frozen=True, eq=False)
class Ranges:
    """The d elements of u in shares of their ranges: options (d,) of each choice, 0 of
    a number, and which (d,) are angles.
    """

    n_options: Tensor
    is_periodic: Tensor

    def compute_offset(self, x: Tensor, mean: Tensor) -> Tensor:
        """Return the offset of x from a mean; of an angle the shorter, within a
        half.
        """
        offset = x - mean
        wrapped_offset = torch.remainder(offset + 0.5, 1.0) - 0.5
        return torch.where(self.is_periodic, wrapped_offset, offset)

    def compute_bounds(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Return the offsets of the lower and upper bound of each range from a mean."""
        half = torch.full_like(mean, 0.5)
        lower = torch.where(self.is_periodic, -half, -mean)
        upper = torch.where(self.is_periodic, half, 1.0 - mean)
        return lower, upper


@dataclass(frozen=True, eq=False)
class Components:
    """A mixture of k products: normal distributions (k, d) cut to their ranges, in
    shares of these, and probabilities of options (k, d, most options); the weights (k,)
    have the sum 1.
    """

    weights: Tensor
    means: Tensor
    deviations: Tensor
    options: Tensor

    def compute_log_densities(self, x: Tensor, ranges: Ranges) -> Tensor:
        """Return the logarithms (n, k) of weight times density of each component.

        The density at x (n, d) is relative to the uniform density.
        """
        lower_offset, upper_offset = ranges.compute_bounds(self.means)
        lower_cdf = torch.special.ndtr(lower_offset / self.deviations)
        upper_cdf = torch.special.ndtr(upper_offset / self.deviations)
        scaled = ranges.compute_offset(x[:, None], self.means) / self.deviations
        log_density = -0.5 * scaled.square() - torch.log(
            self.deviations * math.sqrt(2.0 * math.pi) * (upper_cdf - lower_cdf)
        )
        option = (x * ranges.n_options).long().clamp(max=self.options.shape[2] - 1)
        probability = self.options.expand(len(x), *self.options.shape).gather(
            3, option[:, None, :, None].expand(-1, len(self.weights), -1, 1)
        )
        log_density = torch.where(
            ranges.n_options > 0,
            torch.log(probability[..., 0] * ranges.n_options.clamp(min=1)),
            log_density,
        )
        return self.weights.log() + log_density.sum(dim=2)

    def sample(self, generator: torch.Generator, ranges: Ranges) -> Tensor:
        """Return one sample (d,) of the mixture, in fractions of each range."""
        k = int(torch.multinomial(self.weights, 1, generator=generator))
        mean = self.means[k]
        deviation = self.deviations[k]
        lower_offset, upper_offset = ranges.compute_bounds(mean)
        lower_cdf = torch.special.ndtr(lower_offset / deviation)
        upper_cdf = torch.special.ndtr(upper_offset / deviation)
        uniform = torch.rand(len(mean), generator=generator, dtype=torch.float64)
        cdf = torch.lerp(lower_cdf, upper_cdf, uniform)
        x = mean + deviation * torch.special.ndtri(cdf)
        wrapped = torch.remainder(x, 1.0)
        clipped = x.nan_to_num(0.5).clamp(0.0, 1.0)
        x = torch.where(ranges.is_periodic, wrapped, clipped)
        option = torch.multinomial(self.options[k], 1, generator=generator)[:, 0]
        option_center = (option + 0.5) / ranges.n_options.clamp(min=1)
        return torch.where(ranges.n_options > 0, option_center, x)

    def maximize(
        self, x: Tensor, weights: Tensor, ranges: Ranges, even: Tensor
    ) -> Components:
        """Return the components after one step of expectation and maximisation.

        Args:
            x: (n, d) samples, in fractions of each range.
            weights: (n,) of the samples.
            ranges: of the elements.
            even: (k, d, most options) uniform probabilities of options, the prior.
        """
        responsibility = (
            self.compute_log_densities(x, ranges).softmax(dim=1) * weights[:, None]
        )
        counts = responsibility.sum(dim=0)
        portion = (responsibility / counts.clamp(min=1e-12)).T
        offset = ranges.compute_offset(x[:, None], self.means)
        shift = torch.einsum("kn,nkd->kd", portion, offset)
        spread = torch.einsum("kn,nkd->kd", portion, (offset - shift).square())
        means, deviations = self._divide_out_prior(
            shift, spread, counts[:, None], ranges
        )
        max_options = even.shape[2]
        option = (x * ranges.n_options).long().clamp(max=max_options - 1)
        is_option = torch.nn.functional.one_hot(option, max_options).double()
        options = _estimate_options(portion, is_option, counts, even)
        fraction = counts / counts.sum()
        new_weights = 0.75 * fraction + 0.25 / len(fraction)
        return Components(new_weights, means, deviations, options)

    def _divide_out_prior(
        self, shift: Tensor, spread: Tensor, counts: Tensor, ranges: Ranges
    ) -> tuple[Tensor, Tensor]:
        """Return means and deviations (k, d) without the uniform density.

        Args:
            shift: (k, d) from the old means to those of the samples.
            spread: (k, d) variance of the samples.
            counts: (k, 1) samples of each component.
            ranges: of the elements.
        """
        variance = (
            (counts * spread + PRIOR_COUNT * UNIFORM_DEVIATION**2)
            / (counts + PRIOR_COUNT)
        ).clamp(max=0.999 * UNIFORM_DEVIATION**2)
        precision = 1.0 / variance - 1.0 / UNIFORM_DEVIATION**2
        deviations = (1.0 / precision).sqrt().clamp(MIN_DEVIATION, MAX_DEVIATION)
        means = self.means + shift
        tilted = deviations.square() * (means / variance - 0.5 / UNIFORM_DEVIATION**2)
        means = torch.where(
            ranges.is_periodic, torch.remainder(means, 1.0), tilted.clamp(0.0, 1.0)
        )
        return means, deviations


def _estimate_options(
    portion: Tensor, is_option: Tensor, counts: Tensor, even: Tensor
) -> Tensor:
    """Return the probabilities of options (k, d, most options), with the even prior.

    Args:
        portion: (k, n) of each sample in each component.
        is_option: (n, d, most options) float64, 1 for the option of a sample, else 0.
        counts: (k,) samples of each component.
        even: (k, d, most options) uniform probabilities.
    """
    frequency = torch.einsum("kn,ndo->kdo", portion, is_option)
    option_counts = counts[:, None][..., None]
    return (option_counts * frequency + PRIOR_COUNT * even) / (
        option_counts + PRIOR_COUNT
    )


@dataclass(frozen=True, eq=False)
class MixtureState:
    """State of the search.

    Points are in fractions of each range.

    Attributes:
        domain: of the search.
        seed: of its random numbers.
        ranges: of the elements of u.
        generation: index of the present generation.
        mixtures: mixtures of the generations in the window; None of a uniform one.
        points: (n, d) samples of the present generation.
        evaluated_points: (m, d) the latest `WINDOW` samples that were evaluated.
        log: (t, 5) of all samples: objective, failed, unknown, weight and largest
            weight; see `estimate_failure_rate`.
        n_evaluated: samples of the present generation that were evaluated.
    """

    domain: policies.Domain
    seed: int
    ranges: Ranges
    generation: int
    mixtures: tuple[Components | None, ...]
    points: Tensor
    evaluated_points: Tensor
    log: Tensor
    n_evaluated: int = 0

    def to_configuration(self, x: Tensor) -> Tensor:
        """Return the configuration (d,) of x, which is in fractions of each range."""
        width = self.domain.upper - self.domain.lower
        return self.domain.project((self.domain.lower + x * width).float())

    def find_distinctive_ranges(
        self, mixture: Components, k: int
    ) -> dict[int, tuple[float, float]]:
        """Return the ranges that distinguish a component, by index in u.

        They reach two deviations to both sides, or are those of the most probable
        option.
        """
        lower = self.domain.lower.double()
        width = (self.domain.upper - self.domain.lower).double()
        ranges: dict[int, tuple[float, float]] = {}
        for index, n_options in enumerate(self.ranges.n_options.tolist()):
            if n_options:
                bounds = self._option_bounds(mixture.options[k, index], n_options)
            else:
                bounds = self._number_bounds(
                    float(mixture.means[k, index]),
                    float(mixture.deviations[k, index]),
                    is_periodic=bool(self.ranges.is_periodic[index]),
                )
            if bounds is not None:
                low, high = (float(lower[index] + x * width[index]) for x in bounds)
                ranges[index] = (low, high)
        return ranges

    @staticmethod
    def _option_bounds(
        probabilities: Tensor, n_options: int
    ) -> tuple[float, float] | None:
        """Return the range of the most probable option; None if it is not distinct."""
        option = int(probabilities.argmax())
        if not float(probabilities[option]) > DISTINCTIVE_FRACTION:
            return None
        return option / n_options, (option + 1) / n_options

    @staticmethod
    def _number_bounds(
        mean: float, deviation: float, *, is_periodic: bool
    ) -> tuple[float, float] | None:
        """Return the range of a number; None if it is wide, or goes through 0."""
        reach = 2.0 * deviation
        crosses_zero = is_periodic and (mean - reach < 0.0 or mean + reach > 1.0)
        if crosses_zero or not reach < 2.0 * DISTINCTIVE_FRACTION * UNIFORM_DEVIATION:
            return None
        return max(0.0, mean - reach), min(1.0, mean + reach)


@dataclass(frozen=True)
class Mixture(Policy[MixtureState]):
    """Cross-entropy method (Rubinstein and Kroese 2004, "The cross-entropy method")
    with a mixture, as in the population Monte Carlo of Cappe, Douc, Guillin, Marin and
    Robert 2008, "Adaptive importance sampling in general mixture classes".

    Each generation is drawn from a mixture of as many products of normal distributions,
    cut to the ranges, and of probabilities of options, with a share that is drawn
    evenly whatever was learnt (Hesterberg 1995, "Weighted average importance sampling
    and defensive mixture distributions"). The first is even. The next is fitted by
    expectation and maximisation to the draws that failed (as long as these are few, to
    those with the largest objectives), weighed by the even density over the mean
    density that they came from (the balance heuristic of Veach and Guibas 1995).

    Its result is a failure for each component, and with the share of all configurations
    that fail: see `estimate_failure_rate`. That share is of single renders with the
    search's samples. In an l2 ball no share is told.

    Attributes:
        components: of the mixture, 1 to 20.
        even: share of the draws that is even, 0.05 to 1; weights are 1 / even at most.
        population: draws a generation, at least 2.
    """

    components: int = 4
    even: float = 0.2
    population: int = 20

    name: ClassVar[str] = "mixture"
    uses_gradient: ClassVar[bool] = False
    handles_choices: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not 1 <= self.components <= 20:
            raise InputError(
                "components: expected 1 to 20 parts of a mixture, got "
                f"{self.components}"
            )
        if not 0.05 <= self.even <= 1.0:
            raise InputError(
                "even: expected a number in [0.05, 1], a share of the "
                f"draws, got {self.even}"
            )
        if self.population < 2:
            raise InputError(f"population: expected at least 2, got {self.population}")

    def start(
        self, domain: policies.Domain, generator: torch.Generator, steps: int
    ) -> MixtureState:
        if domain.dim > MAX_DIM:
            raise InputError(
                f"policy 'mixture': expected at most {MAX_DIM} numbers, got "
                f"{domain.dim}; use pgd or auto"
            )
        ranges = Ranges(domain.options, policies.find_periodic(domain))
        nothing = torch.empty(0, domain.dim, dtype=torch.float64)
        log = torch.empty(0, 5, dtype=torch.float64)
        state = MixtureState(
            domain, policies.draw_seed(generator), ranges, 0, (), nothing, nothing, log
        )
        return self._begin_generation(state, None)

    def propose(
        self, state: MixtureState, n: int
    ) -> tuple[tuple[policies.Proposal, ...], MixtureState]:
        next_points = state.points[state.n_evaluated :][:n]
        configurations = [state.to_configuration(x) for x in next_points]
        return tuple(policies.Proposal(u) for u in configurations), state

    def update(
        self, state: MixtureState, evaluated: policies.Evaluated
    ) -> MixtureState:
        points = state.points[state.n_evaluated :][: len(evaluated)]
        mixture = state.mixtures[-1]
        with policies.limit_to_single_thread():
            weights = (1.0 / self._density(mixture, points, state.ranges)).tolist()
        max_weight = 1.0 if mixture is None else 1.0 / self.even
        rows = [
            (
                evaluation.objective,
                evaluation.success,
                not math.isfinite(evaluation.objective),
                weight,
                max_weight,
            )
            for (_, evaluation), weight in zip(evaluated, weights, strict=True)
        ]
        state = replace(
            state,
            log=torch.cat([state.log, torch.tensor(rows, dtype=torch.float64)]),
            evaluated_points=torch.cat([state.evaluated_points, points]),
            n_evaluated=state.n_evaluated + len(evaluated),
        )
        if state.n_evaluated < self.population:
            return state
        return self._begin_generation(state, self._fit(state))

    def failures(self, state: MixtureState) -> policies.Failures:
        """Return a failure for each component that has some, and the failure rate."""
        with policies.limit_to_single_thread():
            failure_rate = policies.estimate_failure_rate(
                state.log[:, 3],
                state.log[:, 4],
                state.log[:, 1] > 0,
                state.log[:, 2] > 0,
            )
        has_l2_block = any(block.norm == "l2" for block in state.domain.blocks)
        n_failures = int((state.log[:, 1] * (1.0 - state.log[:, 2])).sum())
        return policies.Failures(
            self._list_examples(state),
            (),
            n_failures,
            len(state.log),
            None,
            None if has_l2_block else failure_rate,
        )

    def _list_examples(self, state: MixtureState) -> tuple[policies.FoundFailure, ...]:
        """Return the worst failure in the window of each component that has some."""
        log = state.log[-len(state.evaluated_points) :]
        mixture = state.mixtures[-1]
        is_failure = log[:, 1].bool() & ~log[:, 2].bool()
        points = state.evaluated_points[is_failure]
        objectives = log[is_failure, 0]
        if not len(points):
            return ()
        component_of_point = torch.zeros(len(points))
        components = [0]
        if mixture is not None:
            weights = mixture.weights
            component_of_point = mixture.compute_log_densities(
                points, state.ranges
            ).argmax(dim=1)
            components = sorted(
                set(component_of_point.tolist()), key=lambda k: -float(weights[k])
            )
        examples = []
        for k in components:
            members = (component_of_point == k).nonzero().flatten()
            worst = int(members[objectives[members].argmax()])
            u = state.to_configuration(points[worst])
            ranges = (
                {} if mixture is None else state.find_distinctive_ranges(mixture, k)
            )
            examples.append(policies.FoundFailure(u, float(objectives[worst]), ranges))
        return tuple(examples)

    def _begin_generation(
        self, state: MixtureState, mixture: Components | None
    ) -> MixtureState:
        """Begin the next generation: sample its points from a mixture.

        Some of them are uniform; without a mixture all are.
        """
        number = state.generation + 1
        rng = policies.seeded(state.seed, number)
        n_options = state.ranges.n_options
        points = torch.rand(
            self.population, len(n_options), generator=rng, dtype=torch.float64
        )
        points = torch.where(
            n_options > 0,
            policies.option_center(points, n_options.clamp(min=1)),
            points,
        )
        for row in range(self.population):
            if mixture is not None and float(torch.rand(1, generator=rng)) >= self.even:
                points[row] = mixture.sample(rng, state.ranges)
        window = WINDOW // self.population * self.population or self.population
        n_generations = window // self.population + 1
        return replace(
            state,
            generation=number,
            points=points,
            mixtures=(*state.mixtures, mixture)[-n_generations:],
            evaluated_points=state.evaluated_points[-window:],
            n_evaluated=0,
        )

    def _density(self, mixture: Components | None, x: Tensor, ranges: Ranges) -> Tensor:
        """Return the density (n,) of a generation at x (n, d), relative to uniform."""
        if mixture is None:
            return torch.ones(len(x), dtype=torch.float64)
        mixture_density = (
            mixture.compute_log_densities(x, ranges).logsumexp(dim=1).exp()
        )
        return self.even + (1.0 - self.even) * mixture_density

    def _fit(self, state: MixtureState) -> Components | None:
        """Return the mixture fitted to the failures in the window.

        None where nothing could be evaluated.
        """
        log = state.log[-len(state.evaluated_points) :]
        ranges = state.ranges
        is_elite = self._find_elite(log)
        points = state.evaluated_points[is_elite]
        if not len(points):
            return None
        with policies.limit_to_single_thread():
            densities = [
                self._density(mixture, points, ranges) for mixture in state.mixtures
            ]
            weights = 1.0 / torch.stack(densities).mean(dim=0)
            # scaled to have the effective sample size as their sum
            weights *= weights.sum() / weights.square().sum()
            center_index = policies.select_diverse(
                points,
                log[is_elite, 0].tolist(),
                ranges.is_periodic,
                ranges.n_options > 0,
                self.components,
            )
            means = points[center_index]
            even = self._uniform_options(len(means), ranges)
            mixture = Components(
                torch.full((len(means),), 1.0 / len(means), dtype=torch.float64),
                means,
                torch.full_like(means, 0.5 * UNIFORM_DEVIATION),
                even,
            )
            for _ in range(N_FIT_ROUNDS):
                mixture = mixture.maximize(points, weights, ranges, even)
        return mixture

    @staticmethod
    def _find_elite(log: Tensor) -> Tensor:
        """Return which samples a mixture is fitted to, (n,) bool.

        These are the failures; where they are few, the largest objectives too.
        """
        is_known = ~log[:, 2].bool()
        is_elite = is_known & log[:, 1].bool()
        if int(is_elite.sum()) < MIN_ELITE:
            n_elite = max(MIN_ELITE, math.ceil(ELITE_FRACTION * len(log)))
            n_elite = min(int(is_known.sum()), n_elite)
            objectives = torch.where(is_known, log[:, 0], -math.inf)
            is_elite[objectives.topk(n_elite).indices] = True
        return is_elite

    @staticmethod
    def _uniform_options(n_components: int, ranges: Ranges) -> Tensor:
        """Return uniform probabilities of options, (k, d, most options)."""
        n_elements = len(ranges.n_options)
        max_options = max(1, int(ranges.n_options.max()))
        options = torch.ones(n_components, n_elements, max_options, dtype=torch.float64)
        options *= torch.arange(max_options) < ranges.n_options.clamp(min=1)[:, None]
        return options / options.sum(dim=2, keepdim=True)
