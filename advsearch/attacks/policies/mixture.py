"""Learn the distribution of failures as a mixture, and estimate the failure rate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.extend import InputError, Policy, policies

# More numbers are rejected, as there would never be enough samples to learn from.
MAX_DIM = 50
WINDOW = 1000  # number of the latest samples that a mixture is fitted to
ELITE_FRACTION = 0.1
MIN_ELITE = 10
"""A mixture is fitted to the samples that failed. If fewer than `MIN_ELITE` failed, it
is also fitted to the samples with the largest objectives: a fraction `ELITE_FRACTION`
of all samples, but at least `MIN_ELITE`.
"""

N_FIT_ROUNDS = 8  # number of steps of expectation maximization
UNIFORM_STD = 12**-0.5
PRIOR_COUNT = 3.0
"""The prior of each element is the uniform distribution on [0, 1], whose standard
deviation is `UNIFORM_STD`. It counts as much as `PRIOR_COUNT` samples of a component,
so that an element that does not matter stays wide.
"""

# fraction of the total weight that is divided equally among the components
UNIFORM_WEIGHT = 0.25
# standard deviation of a component before the first round of its fit
INITIAL_STD = 0.5 * UNIFORM_STD
# limits of the standard deviation of a number, as fractions of its range
MIN_STD = 0.02
MAX_STD = 10.0
DISTINCTIVE_FRACTION = 0.5
"""A number is distinctive of a component if its standard deviation is less than this
fraction of `UNIFORM_STD`. An option is distinctive if its probability exceeds this.
"""

# columns of `MixtureState.log`
(
    OBJECTIVE_COLUMN,
    FAILED_COLUMN,
    UNKNOWN_COLUMN,
    WEIGHT_COLUMN,
    MAX_WEIGHT_COLUMN,
) = range(5)


@dataclass(frozen=True, eq=False)
class Ranges:
    """Kinds of the d elements of a point, whose values are fractions of their ranges.

    Attributes:
        n_options: (d,) number of options of a choice; 0 for a number.
        is_periodic: (d,) whether it is an angle.
    """

    n_options: Tensor
    is_periodic: Tensor

    def find_option(self, x: Tensor, max_options: int) -> Tensor:
        """Return the index (n, d) of the option that each element of x (n, d) means.

        Option i of n is [i / n, (i + 1) / n). The index is 0 for a number.
        """
        return (x * self.n_options).long().clamp(max=max_options - 1)

    def compute_offset(self, x: Tensor, mean: Tensor) -> Tensor:
        """Return the offset of x from a mean.

        For an angle it is that of the shorter direction, in [-0.5, 0.5).
        """
        offset = x - mean
        wrapped_offset = torch.remainder(offset + 0.5, 1.0) - 0.5
        return torch.where(self.is_periodic, wrapped_offset, offset)

    def compute_bounds(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Return the offsets of the lower and upper bound of each range from a mean.

        An angle has no bounds: it goes half a turn to both sides of its mean.
        """
        half = torch.full_like(mean, 0.5)
        lower = torch.where(self.is_periodic, -half, -mean)
        upper = torch.where(self.is_periodic, half, 1.0 - mean)
        return lower, upper


@dataclass(frozen=True, eq=False)
class Components:
    """A mixture of k components.

    A component is a product over the d elements of a point: a normal distribution
    truncated to the element's range, or a categorical distribution if the element is
    a choice. Each element has the tensors of both; it is a choice if `Ranges.n_options`
    is over 0.

    Attributes:
        weights: (k,) weights of the components, with the sum 1.
        means: (k, d) means of the normal distributions, as fractions of each range.
        stds: (k, d) standard deviations before truncation, as fractions of each range.
        option_probs: (k, d, m) probabilities of options, m the largest number of
            options of an element.
    """

    weights: Tensor
    means: Tensor
    stds: Tensor
    option_probs: Tensor

    def compute_log_densities(self, x: Tensor, ranges: Ranges) -> Tensor:
        """Return log(weight * density) (n, k) of each component at points x (n, d).

        Densities are relative to the uniform density on the ranges.
        """
        log_density = torch.where(
            ranges.n_options > 0,
            self._compute_categorical_log_densities(x, ranges),
            self._compute_normal_log_densities(x, ranges),
        )  # (n, k, d)
        return self.weights.log() + log_density.sum(dim=2)

    def _compute_normal_log_densities(self, x: Tensor, ranges: Ranges) -> Tensor:
        """Return log densities (n, k, d) of the truncated normal distributions."""
        lower_offset, upper_offset = ranges.compute_bounds(self.means)
        lower_cdf = torch.special.ndtr(lower_offset / self.stds)
        upper_cdf = torch.special.ndtr(upper_offset / self.stds)
        z = ranges.compute_offset(x[:, None], self.means) / self.stds
        # of the normal density, cut to the probability between the bounds
        normalizer = self.stds * math.sqrt(2.0 * math.pi) * (upper_cdf - lower_cdf)
        return -0.5 * z.square() - torch.log(normalizer)

    def _compute_categorical_log_densities(self, x: Tensor, ranges: Ranges) -> Tensor:
        """Return the log densities (n, k, d) of discrete choices in each component.

        They are relative to the uniform density. One of m options takes up 1 / m of the
        range, so that its relative density is m times its probability.

        Args:
            x: (n, d) points, in fractions of each range.
            ranges: kinds of the d elements.
        """
        n_points = len(x)
        n_components, _, max_options = self.option_probs.shape
        option = ranges.find_option(x, max_options)  # (n, d)
        # `gather` needs an index of as many axes: (n, k, d, 1) into (n, k, d, m)
        index = option[:, None, :, None].expand(-1, n_components, -1, 1)
        probs = self.option_probs.expand(n_points, *self.option_probs.shape)
        prob = probs.gather(3, index)[..., 0]  # (n, k, d)
        return torch.log(prob * ranges.n_options.clamp(min=1))

    def sample(self, generator: torch.Generator, ranges: Ranges) -> Tensor:
        """Return one sample (d,) of the mixture, in fractions of each range.

        A discrete choice is the center of its option's part of [0, 1].

        Args:
            generator: generator of random numbers; it advances.
            ranges: kinds of the d elements.
        """
        k = int(torch.multinomial(self.weights, 1, generator=generator))
        x = self._sample_numbers(k, generator, ranges)
        option = torch.multinomial(self.option_probs[k], 1, generator=generator)[:, 0]
        option_center = (option + 0.5) / ranges.n_options.clamp(min=1)
        return torch.where(ranges.n_options > 0, option_center, x)

    def _sample_numbers(
        self, k: int, generator: torch.Generator, ranges: Ranges
    ) -> Tensor:
        """Return one sample (d,) of the truncated normal distributions of component k.

        It is sampled by inverting the distribution function.
        """
        mean = self.means[k]
        std = self.stds[k]
        lower_offset, upper_offset = ranges.compute_bounds(mean)
        lower_cdf = torch.special.ndtr(lower_offset / std)
        upper_cdf = torch.special.ndtr(upper_offset / std)
        uniform = torch.rand(len(mean), generator=generator, dtype=torch.float64)
        cdf = torch.lerp(lower_cdf, upper_cdf, uniform)
        x = mean + std * torch.special.ndtri(cdf)
        wrapped = torch.remainder(x, 1.0)
        # `ndtri` is infinite at 0 and 1: x is clipped to a bound. Where rounding goes
        # beyond 0 or 1 it is NaN: the center of the range is taken.
        clipped = x.nan_to_num(0.5).clamp(0.0, 1.0)
        return torch.where(ranges.is_periodic, wrapped, clipped)

    def maximize(
        self, x: Tensor, weights: Tensor, ranges: Ranges, uniform_probs: Tensor
    ) -> Components:
        """Return the components after one step of expectation maximization (EM).

        The fraction `UNIFORM_WEIGHT` of the total weight is divided equally among the
        components, so that none vanishes.

        Args:
            x: (n, d) samples, in fractions of each range.
            weights: (n,) weights of the samples; their sum is the effective number of
                samples.
            ranges: kinds of the d elements.
            uniform_probs: (k, d, m) uniform probabilities of options, the prior.
        """
        # E step: (n, k) probability that a sample comes from a component, times the
        # weight of the sample
        log_densities = self.compute_log_densities(x, ranges)
        responsibility = log_densities.softmax(dim=1) * weights[:, None]
        counts = responsibility.sum(dim=0)  # (k,) number of samples of each component
        # M step. (k, n) weights of the samples in each component, with the sum 1;
        # clamped, since a component may have no samples at all.
        sample_weights = (responsibility / counts.clamp(min=1e-12)).T
        means, stds = self._fit_normals(x, sample_weights, counts, ranges)
        option = ranges.find_option(x, max_options=uniform_probs.shape[2])
        option_probs = _estimate_option_probs(
            sample_weights, option, counts, uniform_probs
        )
        fraction = counts / counts.sum()
        new_weights = (1.0 - UNIFORM_WEIGHT) * fraction
        new_weights += UNIFORM_WEIGHT / len(fraction)
        return Components(new_weights, means, stds, option_probs)

    def _fit_normals(
        self, x: Tensor, sample_weights: Tensor, counts: Tensor, ranges: Ranges
    ) -> tuple[Tensor, Tensor]:
        """Return means and standard deviations (k, d) of the normal distributions,
        before they are truncated to the ranges.

        Args:
            x: (n, d) samples, in fractions of each range.
            sample_weights: (k, n) weights of the samples in each component, with the
                sum 1.
            counts: (k,) number of samples of each component.
            ranges: kinds of the d elements.
        """
        # Means are computed from offsets x - old mean, in which angles do not wrap.
        offset = ranges.compute_offset(x[:, None], self.means)  # (n, k, d)
        mean_offset, variance = _compute_moments(offset, sample_weights)
        sample_means = self.means + mean_offset
        return _correct_truncation(sample_means, variance, counts[:, None], ranges)


def _compute_moments(values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weighted mean and variance of values by component, (k, d) each.

    Args:
        values: (n, k, d) values of n samples.
        weights: (k, n) weights of the samples in each component, with the sum 1.
    """
    mean = torch.einsum("kn,nkd->kd", weights, values)
    squared_residual = (values - mean).square()
    variance = torch.einsum("kn,nkd->kd", weights, squared_residual)
    return mean, variance


def _correct_truncation(
    sample_means: Tensor, variance: Tensor, counts: Tensor, ranges: Ranges
) -> tuple[Tensor, Tensor]:
    """Estimate normal distributions from samples that are truncated to [0, 1].

    The density of the samples is a normal density times the uniform one on [0, 1]. The
    uniform one is approximated by a normal density with its mean (1/2) and variance. In
    a product of normal densities, precisions (1 / variance) add up, and so do means
    times precisions. So the contribution of the uniform density is subtracted from
    both. The mean of an angle is not corrected, as angles wrap and are not truncated.

    Args:
        sample_means: (k, d) means of the samples.
        variance: (k, d) variances of the samples.
        counts: (k, 1) number of samples of each component.
        ranges: kinds of the d elements.

    Returns:
        Means and standard deviations before truncation, (k, d) each.
    """
    uniform_mean = 0.5
    uniform_variance = UNIFORM_STD**2
    pooled_variance = _pool_variance(variance, counts)
    precision = 1.0 / pooled_variance - 1.0 / uniform_variance
    stds = (1.0 / precision).sqrt().clamp(MIN_STD, MAX_STD)
    corrected_means = stds.square() * (
        sample_means / pooled_variance - uniform_mean / uniform_variance
    )
    means = torch.where(
        ranges.is_periodic,
        torch.remainder(sample_means, 1.0),
        corrected_means.clamp(0.0, 1.0),
    )
    return means, stds


def _pool_variance(variance: Tensor, counts: Tensor) -> Tensor:
    """Return the variance (k, d) of the samples, averaged with that of the prior.

    The prior is the uniform distribution, which counts as `PRIOR_COUNT` samples. The
    result is below the variance of the prior.

    Args:
        variance: (k, d) variances of the samples.
        counts: (k, 1) number of samples of each component.
    """
    uniform_variance = UNIFORM_STD**2
    pooled_variance = (counts * variance + PRIOR_COUNT * uniform_variance) / (
        counts + PRIOR_COUNT
    )
    return pooled_variance.clamp(max=0.999 * uniform_variance)


def _estimate_option_probs(
    sample_weights: Tensor, option: Tensor, counts: Tensor, uniform_probs: Tensor
) -> Tensor:
    """Return the probabilities of options (k, d, m).

    They are the weighted frequencies in the samples, averaged with uniform
    probabilities that count as `PRIOR_COUNT` samples.

    Args:
        sample_weights: (k, n) weights of the samples in each component; each row sums
            to 1.
        option: (n, d) int64, index of the option of each sample.
        counts: (k,) number of samples of each component.
        uniform_probs: (k, d, m) uniform probabilities.
    """
    max_options = uniform_probs.shape[2]
    indicator = torch.nn.functional.one_hot(option, max_options).double()  # (n, d, m)
    frequency = torch.einsum("kn,ndo->kdo", sample_weights, indicator)
    n_samples = counts[:, None, None]
    return (n_samples * frequency + PRIOR_COUNT * uniform_probs) / (
        n_samples + PRIOR_COUNT
    )


@dataclass(frozen=True, eq=False)
class MixtureState:
    """State of the search.

    The values of a point are fractions of each range.

    Attributes:
        domain: domain of the search.
        seed: seed of its random numbers.
        ranges: ranges of the elements of u.
        generation: index of the current generation.
        mixtures: mixture of each generation in the window, the current one last; None
            for a generation of uniform samples.
        points: (n, d) samples of the current generation.
        evaluated_points: (m, d) the latest evaluated samples, about `WINDOW` of them.
        log: (t, 5) float64, a row for each evaluated sample: objective; failed; unknown
            (no objective could be computed); importance weight; and the largest
            importance weight that it could have had (see `estimate_failure_rate`).
        n_evaluated: number of samples of the current generation that were evaluated.
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

    @property
    def window_log(self) -> Tensor:
        """(m, 5) rows of `log` that belong to `evaluated_points`, the latest ones."""
        return self.log[len(self.log) - len(self.evaluated_points) :]

    def to_configuration(self, x: Tensor) -> Tensor:
        """Return the configuration (d,) of x, which is in fractions of each range."""
        width = self.domain.upper_bounds - self.domain.lower_bounds
        return self.domain.project((self.domain.lower_bounds + x * width).float())

    def find_distinctive_ranges(
        self, mixture: Components, k: int
    ) -> dict[int, tuple[float, float]]:
        """Return the ranges (low, high) that distinguish component k, by index in u.

        They describe the failures that a component represents. The range of a number
        extends two standard deviations below and above the mean; that of a choice is
        its most probable option. An element whose distribution is nearly uniform is
        left out.

        Args:
            mixture: the mixture.
            k: index of the component.

        Returns:
            Bounds in the units of u, by index in u.
        """
        lower = self.domain.lower_bounds.double()
        width = (self.domain.upper_bounds - self.domain.lower_bounds).double()
        ranges: dict[int, tuple[float, float]] = {}
        for index in range(len(self.ranges.n_options)):
            bounds = self._find_bounds(mixture, k, index)
            if bounds is not None:
                low, high = (float(lower[index] + x * width[index]) for x in bounds)
                ranges[index] = (low, high)
        return ranges

    def _find_bounds(
        self, mixture: Components, k: int, index: int
    ) -> tuple[float, float] | None:
        """Return the range of one element that distinguishes component k, or None.

        It is in fractions of the full range; `index` is that of the element in u.
        """
        n_options = int(self.ranges.n_options[index])
        if n_options:
            return self._option_bounds(mixture.option_probs[k, index], n_options)
        return self._number_bounds(
            float(mixture.means[k, index]),
            float(mixture.stds[k, index]),
            is_periodic=bool(self.ranges.is_periodic[index]),
        )

    @staticmethod
    def _option_bounds(
        probabilities: Tensor, n_options: int
    ) -> tuple[float, float] | None:
        """Return the range of the most probable option, or None if it is not probable
        enough to be distinctive.

        Option i of n is [i / n, (i + 1) / n), in fractions of the full range.
        """
        option = int(probabilities.argmax())
        is_distinctive = float(probabilities[option]) > DISTINCTIVE_FRACTION
        if not is_distinctive:
            return None
        return option / n_options, (option + 1) / n_options

    @staticmethod
    def _number_bounds(
        mean: float, std: float, *, is_periodic: bool
    ) -> tuple[float, float] | None:
        """Return the range of a number, in fractions of the full range, or None.

        It is None if it is too wide to be distinctive. It is also None for an angle
        whose range goes through 0, which two ascending bounds can't express.
        """
        # clearly less spread than the uniform distribution
        is_distinctive = std < DISTINCTIVE_FRACTION * UNIFORM_STD
        lower = mean - 2.0 * std
        upper = mean + 2.0 * std
        crosses_zero = is_periodic and (lower < 0.0 or upper > 1.0)
        if crosses_zero or not is_distinctive:
            return None
        return max(0.0, lower), min(1.0, upper)


@dataclass(frozen=True)
class Mixture(Policy[MixtureState]):
    """Cross-entropy method (Rubinstein and Kroese 2004, "The cross-entropy method")
    with a mixture, as in the population Monte Carlo of Cappe, Douc, Guillin, Marin and
    Robert 2008, "Adaptive importance sampling in general mixture classes".

    Each generation is sampled from a mixture. Its components are products of truncated
    normal distributions and of probabilities of options. A fraction of the samples is
    uniform, whatever was learned (Hesterberg 1995, "Weighted average importance
    sampling and defensive mixture distributions"). The first generation is all uniform.
    Each next mixture is fitted by expectation maximization to the samples that failed;
    as long as these are few, to those with the largest objectives. A sample is weighted
    by the uniform density divided by the mean density of the mixtures (the balance
    heuristic of Veach and Guibas 1995).

    Its result is a failure for each component, and an estimate of the fraction of all
    configurations that fail (`estimate_failure_rate`). It counts failures in single
    renders with the samples per pixel of the search. With an l2 ball there is no
    estimate.

    Attributes:
        components: number of components of the mixture, 1 to 20.
        even: fraction of the samples that is uniform, 0.05 to 1. Importance weights are
            at most 1 / `even`.
        population: number of samples of a generation, at least 2.
    """

    components: int = 4
    even: float = 0.2
    population: int = 20

    name: ClassVar[str] = "mixture"
    uses_gradient: ClassVar[bool] = False
    handles_choices: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check that all settings are within their limits."""
        if not 1 <= self.components <= 20:
            raise InputError(
                "components: expected 1 to 20 parts of a mixture, got "
                f"{self.components}"
            )
        if not 0.05 <= self.even <= 1.0:
            raise InputError(
                "even: expected a number in [0.05, 1], the fraction of samples that is "
                f"uniform, got {self.even}"
            )
        if self.population < 2:
            raise InputError(f"population: expected at least 2, got {self.population}")

    def start(
        self, domain: policies.Domain, generator: torch.Generator, steps: int
    ) -> MixtureState:
        """Start with a generation of uniform samples.

        Args:
            domain: domain of the search.
            generator: source of the seed.
            steps: renders of the search; not used.

        Raises:
            InputError: the domain has more than `MAX_DIM` numbers.
        """
        domain.check_dim(MAX_DIM, "mixture", "use pgd or auto")
        no_points = torch.empty(0, domain.dim, dtype=torch.float64)
        state = MixtureState(
            domain,
            policies.draw_seed(generator),
            Ranges(domain.option_counts, policies.find_periodic(domain)),
            generation=0,
            mixtures=(),
            points=no_points,
            evaluated_points=no_points,
            log=torch.empty(0, 5, dtype=torch.float64),
        )
        return self._begin_generation(state, mixture=None)

    def propose(
        self, state: MixtureState, n: int
    ) -> tuple[tuple[policies.Proposal, ...], MixtureState]:
        next_points = state.points[state.n_evaluated :][:n]
        configurations = [state.to_configuration(x) for x in next_points]
        return tuple(policies.Proposal(u) for u in configurations), state

    def update(
        self, state: MixtureState, evaluated: policies.Evaluated
    ) -> MixtureState:
        """Log evaluations, and fit a new mixture after each complete generation."""
        # Samples are proposed and evaluated in order, so these are the next ones.
        points = state.points[state.n_evaluated :][: len(evaluated)]
        rows = self._make_log_rows(state, evaluated, points)
        state = replace(
            state,
            log=torch.cat([state.log, torch.tensor(rows, dtype=torch.float64)]),
            evaluated_points=torch.cat([state.evaluated_points, points]),
            n_evaluated=state.n_evaluated + len(evaluated),
        )
        # samples of this generation that are evaluated
        is_complete = state.n_evaluated >= self.population
        if not is_complete:
            return state
        next_mixture = self._fit(state)
        return self._begin_generation(state, next_mixture)

    def _make_log_rows(
        self, state: MixtureState, evaluated: policies.Evaluated, points: Tensor
    ) -> list[tuple[float, bool, bool, float, float]]:
        """Return the rows of the log for evaluated points (n, d), by its columns.

        The importance weight of a sample is the uniform density divided by the density
        from which it was drawn.
        """
        mixture = state.mixtures[-1]  # that of the current generation
        with policies.limit_to_single_thread():
            weights = (1.0 / self._density(mixture, points, state.ranges)).tolist()
        # Without a mixture the density is 1. With one, the fraction `even` of samples
        # is uniform, so that the density is at least `even`.
        max_weight = 1.0 if mixture is None else 1.0 / self.even
        rows = []
        for (_, evaluation), weight in zip(evaluated, weights, strict=True):
            objective = evaluation.objective
            is_unknown = not math.isfinite(objective)
            # a success of the search is a failure of the model
            row = (objective, evaluation.success, is_unknown, weight, max_weight)
            rows.append(row)
        return rows

    def failures(self, state: MixtureState) -> policies.Failures:
        """Return the worst failure of each component, and the estimated failure rate.

        The mixture has no cells, so samples are counted instead. With an l2 ball no
        rate is estimated: samples are projected onto the ball, so that they are not
        uniform in it, and their weights are wrong.
        """
        has_failed = state.log[:, FAILED_COLUMN] > 0
        is_unknown = state.log[:, UNKNOWN_COLUMN] > 0
        failures = policies.Failures(
            self._list_examples(state),
            cell_parameter_indices=(),
            n_failures=int((has_failed & ~is_unknown).sum()),
            n_visited=len(state.log),
            n_cells=None,
        )
        if any(block.norm == "l2" for block in state.domain.blocks):
            return failures
        with policies.limit_to_single_thread():
            failure_rate = policies.estimate_failure_rate(
                weights=state.log[:, WEIGHT_COLUMN],
                bounds=state.log[:, MAX_WEIGHT_COLUMN],
                failed=has_failed,
                unknown=is_unknown,
            )
        return replace(failures, failure_rate=failure_rate)

    def _list_examples(self, state: MixtureState) -> tuple[policies.FoundFailure, ...]:
        """Return the worst failure of each component, by descending weight.

        A component without failures is left out. Only samples in the window, the latest
        ones, are used. Before the first mixture all samples form one component.
        """
        log = state.window_log
        mixture = state.mixtures[-1]
        # a sample that could not be evaluated ("unknown") is no failure
        is_failure = log[:, FAILED_COLUMN].bool() & ~log[:, UNKNOWN_COLUMN].bool()
        points = state.evaluated_points[is_failure]
        objectives = log[is_failure, OBJECTIVE_COLUMN]
        if not len(points):
            return ()
        component_of_point = self._assign_components(mixture, points, state.ranges)
        examples = []
        for k in self._rank_components(mixture, component_of_point):
            is_member = component_of_point == k
            example = _choose_worst_example(
                state, k, points[is_member], objectives[is_member]
            )
            examples.append(example)
        return tuple(examples)

    @staticmethod
    def _assign_components(
        mixture: Components | None, points: Tensor, ranges: Ranges
    ) -> Tensor:
        """Return the index (n,) of the component that each point (n, d) most likely
        comes from; 0 without a mixture.
        """
        if mixture is None:
            return torch.zeros(len(points), dtype=torch.long)
        return mixture.compute_log_densities(points, ranges).argmax(dim=1)

    @staticmethod
    def _rank_components(
        mixture: Components | None, component_of_point: Tensor
    ) -> list[int]:
        """Return the components that have points, those of most weight first."""
        if mixture is None:
            return [0]
        weights = mixture.weights
        return sorted(
            set(component_of_point.tolist()), key=lambda k: -float(weights[k])
        )

    def _begin_generation(
        self, state: MixtureState, mixture: Components | None
    ) -> MixtureState:
        """Begin the next generation: sample its points from a mixture.

        Each point is uniform with probability `even`; without a mixture all are. Only
        mixtures and points of the latest `WINDOW` samples are stored.

        Args:
            state: state of the search.
            mixture: mixture to sample from, or None.
        """
        generation = state.generation + 1
        rng = policies.seeded(state.seed, generation)
        points = self._sample_points(state.ranges, mixture, rng)
        # The window consists of complete generations. Their samples are stored, and
        # their mixtures besides that of the generation that begins here.
        n_past_generations = max(1, WINDOW // self.population)
        n_past_points = n_past_generations * self.population
        n_mixtures = n_past_generations + 1
        return replace(
            state,
            generation=generation,
            points=points,
            mixtures=(*state.mixtures, mixture)[-n_mixtures:],
            evaluated_points=state.evaluated_points[-n_past_points:],
            n_evaluated=0,
        )

    def _sample_points(
        self, ranges: Ranges, mixture: Components | None, rng: torch.Generator
    ) -> Tensor:
        """Return the points (n, d) of a generation, in fractions of each range.

        Each is uniform with probability `even`, otherwise from the mixture; without a
        mixture all are uniform.
        """
        points = self._sample_uniform(ranges, rng)
        if mixture is None:
            return points
        for row in range(self.population):
            stays_uniform = float(torch.rand(1, generator=rng)) < self.even
            if not stays_uniform:
                points[row] = mixture.sample(rng, ranges)
        return points

    def _sample_uniform(self, ranges: Ranges, rng: torch.Generator) -> Tensor:
        """Return uniform points (n, d) of a generation, in fractions of each range.

        A discrete choice is at the center of an option's part of the range.
        """
        n_options = ranges.n_options
        points = torch.rand(
            self.population, len(n_options), generator=rng, dtype=torch.float64
        )
        centers = policies.option_center(points, n_options.clamp(min=1))
        return torch.where(n_options > 0, centers, points)

    def _density(self, mixture: Components | None, x: Tensor, ranges: Ranges) -> Tensor:
        """Return the density (n,) of a generation at x (n, d), relative to uniform.

        It includes the generation's uniform samples.
        """
        if mixture is None:
            return torch.ones(len(x), dtype=torch.float64)
        # (n, k), with the weights of the components
        log_densities = mixture.compute_log_densities(x, ranges)
        mixture_density = log_densities.logsumexp(dim=1).exp()
        return self.even + (1.0 - self.even) * mixture_density

    def _fit(self, state: MixtureState) -> Components | None:
        """Fit a mixture to the worst of the latest samples, by EM.

        Samples are weighted by the uniform density divided by the mean density of all
        generations in the window. The components begin at samples that are far from
        each other. The result is None if nothing could be evaluated.
        """
        log = state.window_log
        ranges = state.ranges
        # the failures; if they are few, also the samples with the largest objectives
        is_elite = self._find_elite(log)
        points = state.evaluated_points[is_elite]
        if not len(points):
            return None
        objectives = log[is_elite, OBJECTIVE_COLUMN]
        with policies.limit_to_single_thread():
            weights = self._weight_points(state, points)
            mixture = self._make_initial_mixture(points, objectives, ranges)
            uniform_probs = mixture.option_probs  # the initial ones are uniform
            for _ in range(N_FIT_ROUNDS):
                mixture = mixture.maximize(points, weights, ranges, uniform_probs)
        return mixture

    def _weight_points(self, state: MixtureState, points: Tensor) -> Tensor:
        """Return the weights (n,) of points (n, d) that a mixture is fitted to.

        Their sum is the effective sample size, (sum w)^2 / sum w^2. It is compared with
        the `PRIOR_COUNT` samples of the prior.
        """
        densities = [
            self._density(mixture, points, state.ranges) for mixture in state.mixtures
        ]
        # `WEIGHT_COLUMN` of the log has a sample's weight by the density of its own
        # generation. Here the mean density of all generations is used instead.
        weights = 1.0 / torch.stack(densities).mean(dim=0)
        weights *= weights.sum() / weights.square().sum()
        return weights

    def _make_initial_mixture(
        self, points: Tensor, objectives: Tensor, ranges: Ranges
    ) -> Components:
        """Return wide components around points that are far from each other.

        Args:
            points: (n, d) samples, in fractions of each range.
            objectives: (n,) their objectives.
            ranges: kinds of the d elements.
        """
        center_index = policies.select_diverse(
            points,
            objectives.tolist(),
            ranges.is_periodic,
            ranges.n_options > 0,
            limit=self.components,
        )
        return self._make_initial_components(points[center_index], ranges)

    def _make_initial_components(self, centers: Tensor, ranges: Ranges) -> Components:
        """Return wide components of equal weight around centers (k, d)."""
        n_components = len(centers)
        return Components(
            weights=torch.full(
                (n_components,), 1.0 / n_components, dtype=torch.float64
            ),
            means=centers,
            stds=torch.full_like(centers, INITIAL_STD),
            option_probs=self._make_uniform_option_probs(n_components, ranges),
        )

    @staticmethod
    def _find_elite(log: Tensor) -> Tensor:
        """Return which samples a mixture is fitted to, (n,) bool.

        These are the failures; if they are few, also the samples with the largest
        objectives. A sample that could not be evaluated ("unknown") is left out.

        Args:
            log: (n, 5) samples; columns are objective, failed, unknown and two weights.
        """
        is_known = ~log[:, UNKNOWN_COLUMN].bool()
        is_elite = is_known & log[:, FAILED_COLUMN].bool()
        if int(is_elite.sum()) < MIN_ELITE:
            n_elite = max(MIN_ELITE, math.ceil(ELITE_FRACTION * len(log)))
            n_elite = min(int(is_known.sum()), n_elite)
            objectives = torch.where(is_known, log[:, OBJECTIVE_COLUMN], -math.inf)
            is_elite[objectives.topk(n_elite).indices] = True
        return is_elite

    @staticmethod
    def _make_uniform_option_probs(n_components: int, ranges: Ranges) -> Tensor:
        """Return uniform probabilities of options, (k, d, m).

        They are 0 beyond an element's options; a number is treated as one option.
        """
        n_elements = len(ranges.n_options)
        max_options = max(1, int(ranges.n_options.max()))
        probs = torch.ones(n_components, n_elements, max_options, dtype=torch.float64)
        probs *= torch.arange(max_options) < ranges.n_options.clamp(min=1)[:, None]
        return probs / probs.sum(dim=2, keepdim=True)


def _choose_worst_example(
    state: MixtureState, k: int, points: Tensor, objectives: Tensor
) -> policies.FoundFailure:
    """Return the failure of a component with the largest objective.

    It has the ranges that are distinctive of the component; none without a mixture.

    Args:
        state: state of the search.
        k: index of the component.
        points: (n, d) failures of the component, in fractions of each range.
        objectives: (n,) their objectives.
    """
    worst = int(objectives.argmax())
    u = state.to_configuration(points[worst])
    mixture = state.mixtures[-1]
    ranges = {}
    if mixture is not None:
        ranges = state.find_distinctive_ranges(mixture, k)
    return policies.FoundFailure(u, float(objectives[worst]), ranges)
