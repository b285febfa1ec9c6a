"""Quality diversity: many different failures instead of one, kept in an archive over
chosen parameters.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Container, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from advsearch.extend import InputError, Policy, errors, policies, seeds

# The archive is a grid of cells over a few parameters of the domain. These are called
# the measures, as in ribs.

# Domains of more numbers are rejected, because every cell stores a full configuration.
MAX_DIM = 10_000
MAX_CELLS = 1_000_000  # largest number of cells of an archive
# Largest number of measures. With more, nearly every configuration would have its own
# cell.
MAX_MEASURES = 4
RESAMPLED_FRACTION = 0.1
"""Fraction of a generation that are random samples of the domain, and probability that
a discrete choice of an offspring is sampled again.
"""

# Number of stored configurations that are sampled for an offspring. The one with the
# largest objective is its first parent.
TOURNAMENT = 4
SIGMA = 0.1
LINE_SIGMA = 0.3
"""Standard deviation of a random step, in half ranges, and of a step along the line
through both parents, as a fraction of their distance.
"""

# factor of random steps in the measures, so that offspring reach other cells
MEASURE_SIGMA_FACTOR = 4.0
N_CANDIDATES = 300  # number of candidates that the surrogate chooses a generation from
# fraction of the candidates whose measures are uniform samples
ANY_CELL_FRACTION = 0.5
# Weight of a larger objective in a cell that has a failure already. The weight of a
# first failure in a cell is 1.
IMPROVEMENT_WEIGHT = 0.1
# number of the best, and of the latest, configurations that the surrogate is fitted to
MEMORY = 300


@dataclass(frozen=True, eq=False)
class ArchiveState:
    """State of the search.

    Attributes:
        domain: domain of the search.
        seed: seed of random numbers.
        measure_indices: (k,) indices in u of the parameters that span the archive.
        half_widths: (d,) half of the range of each element of u.
        archive: archive of ribs; it is copied before it is changed.
        generation: index of the current generation.
        points: (n, d) configurations of the current generation.
        values: objectives of those points that were evaluated, which are the first.
        successes: whether the model failed at these points.
        observations: evaluations that the surrogate is fitted to; None if the domain
            does not suit a surrogate (`_make_observations`).
    """

    domain: policies.Domain
    seed: int
    measure_indices: Tensor
    half_widths: Tensor
    archive: Any
    generation: int
    points: Tensor
    values: tuple[float, ...] = ()
    successes: tuple[bool, ...] = ()
    observations: policies.Observations | None = None

    def add_generation(self) -> ArchiveState:
        """Return the state with the current generation added to a copy of the archive.

        The generation may be incomplete. A configuration without a finite objective is
        left out.
        """
        objectives = np.array(self.values)
        is_finite = np.isfinite(objectives)
        archive = copy.deepcopy(self.archive)
        if is_finite.any():
            points = self.points[: len(objectives)][torch.from_numpy(is_finite)]
            measures = points[:, self.measure_indices].double().numpy()
            archive.add(
                points.numpy(),
                objectives[is_finite],
                measures,
                wrong=np.array(self.successes)[is_finite],
            )
        return replace(self, archive=archive)

    def make_offspring(self, samples: Tensor, rng: torch.Generator) -> Tensor:
        """Return offspring (n, d) of the archive, which may be out of bounds.

        Each has two parents. Its numbers are those of the first, plus noise, plus a
        random step along the line to the second. Its discrete choices are those of the
        first parent; with probability `RESAMPLED_FRACTION` a choice is that of a random
        sample instead.

        Args:
            samples: (n, d) random configurations of the domain, one for each offspring,
                from which choices are taken.
            rng: generator of random numbers; it advances.
        """
        count, dim = samples.shape
        first, second = self._sample_parents(count)
        noise = torch.randn(count, dim, generator=rng)
        # The noise is larger in the parameters that span the archive.
        noise[:, self.measure_indices] *= MEASURE_SIGMA_FACTOR
        # (n, 1) fraction of the way from the first parent to the second
        line_fraction = LINE_SIGMA * torch.randn(count, 1, generator=rng)
        offspring: Tensor = (
            first + SIGMA * self.half_widths * noise + line_fraction * (second - first)
        )
        is_resampled = torch.rand(count, dim, generator=rng) < RESAMPLED_FRACTION
        choices = torch.where(is_resampled, samples, first)
        return torch.where(self.domain.option_counts > 0, choices, offspring)

    def _sample_parents(self, count: int) -> tuple[Tensor, Tensor]:
        """Return two parents (count, d) of each offspring.

        Both are elites, which are the configurations stored in the cells. The first is
        the best of `TOURNAMENT` random elites, the second any random elite.
        """
        # Sampling changes the archive's random generator, so a copy is sampled.
        archive = copy.deepcopy(self.archive)
        elites = archive.sample_elites((TOURNAMENT + 1) * count)
        shape = (TOURNAMENT + 1, count)
        solutions = torch.from_numpy(elites["solution"]).unflatten(0, shape)
        objectives = torch.from_numpy(elites["objective"]).unflatten(0, shape)
        # row 0 are the second parents; the other rows compete to be the first
        winner = objectives[1:].argmax(0)
        return solutions[1 + winner, torch.arange(count)], solutions[0]

    def select_most_promising(
        self, surrogate: policies.Surrogate, points: Tensor, count: int
    ) -> Tensor:
        """Return the `count` most promising of the candidates `points` (n, d).

        The promise of a candidate is the probability that it exceeds the objective to
        beat in its cell. In a cell that has a failure already, it is multiplied by
        `IMPROVEMENT_WEIGHT`. The best candidate of each cell comes before all others.

        Args:
            surrogate: predicts mean and standard deviation of the objective.
            points: (n, d) candidates.
            count: number of candidates to return.
        """
        mean, deviation = surrogate.predict(surrogate.box.from_configuration(points))
        # objectives of the cells that have a failure, and a threshold for all others
        failed_objective_of_cell, threshold = self._find_objectives_to_beat()
        measures = points[:, self.measure_indices].double().numpy()
        cells = self.archive.index_of(measures).tolist()
        to_beat = torch.tensor(
            [failed_objective_of_cell.get(cell, threshold) for cell in cells]
        )
        weight = _weight_cells(cells, failed_objective_of_cell)
        # (mean - to_beat) / deviation is normal under the surrogate
        promise = weight * torch.special.ndtr((mean - to_beat) / deviation)
        order = promise.argsort(descending=True, stable=True).tolist()
        return points[_order_by_cell(order, cells)[:count]]

    def _find_objectives_to_beat(self) -> tuple[dict[int, float], float]:
        """Return the objective that a new configuration has to beat in each cell.

        Returns:
            The objectives of cells that have a failure, by index of the cell; and one
            value for all other cells. That is the smallest objective of a failure, or
            without any failure the largest objective so far.
        """
        elites = self.archive.data()
        objectives = torch.from_numpy(elites["objective"])
        is_wrong = torch.from_numpy(elites["wrong"])
        wrong_objectives = objectives[is_wrong]
        wrong_cells = elites["index"][elites["wrong"]].tolist()
        objective_of_cell = dict(
            zip(wrong_cells, wrong_objectives.tolist(), strict=True)
        )
        if bool(is_wrong.any()):
            return objective_of_cell, float(wrong_objectives.min())
        return objective_of_cell, float(objectives.max())


def _weight_cells(cells: Sequence[int], failed_cells: Container[int]) -> Tensor:
    """Return the weight of each candidate by its cell, (n,) float32.

    Args:
        cells: index of the cell of each candidate.
        failed_cells: indices of the cells that have a failure already.
    """
    return torch.tensor(
        [IMPROVEMENT_WEIGHT if cell in failed_cells else 1.0 for cell in cells]
    )


def _order_by_cell(order: list[int], cells: list[int]) -> list[int]:
    """Return the order with the first candidate of each cell before all others.

    Args:
        order: indices of the candidates, the best first.
        cells: index of the cell of each candidate.
    """
    first_of_cell = dict[int, int]()
    for index in order:
        first_of_cell.setdefault(cells[index], index)
    others = [index for index in order if first_of_cell[cells[index]] != index]
    return [*first_of_cell.values(), *others]


def _find_cell_ranges(
    measure_indices: Sequence[int],
    boundaries: Sequence[Any],
    grid_index: Sequence[int],
) -> dict[int, tuple[float, float]]:
    """Return the range (low, high) of each parameter of the archive in a cell.

    Args:
        measure_indices: indices in u of the parameters that are axes of the archive;
            they are the keys of the result.
        boundaries: boundaries of the cells on each axis, ascending.
        grid_index: index of the cell on each axis.
    """
    ranges = {}
    for measure, axis_boundaries, index in zip(
        measure_indices, boundaries, grid_index, strict=True
    ):
        low = float(axis_boundaries[index])
        high = float(axis_boundaries[index + 1])
        ranges[measure] = (low, high)
    return ranges


def _make_candidates(
    state: ArchiveState, observations: policies.Observations, rng: torch.Generator
) -> Tensor:
    """Return candidates (n, d) for a surrogate to choose from.

    They are offspring of the archive, moved into the bounds. In a fraction of them
    (`ANY_CELL_FRACTION`), the parameters that span the archive are sampled uniformly,
    so that they reach cells far from their parents.

    A surrogate is used only in domains without norm balls (`_make_observations`). There
    every element of u is a box coordinate, with the same index.

    Args:
        state: state of the search.
        observations: evaluations so far; only their box coordinates are used.
        rng: generator of random numbers; it advances.
    """
    box = observations.box
    uniform = torch.rand(N_CANDIDATES, box.count, generator=rng)
    samples = box.low + box.width * uniform
    offspring = state.make_offspring(samples, rng)
    n_any_cell = int(ANY_CELL_FRACTION * N_CANDIDATES)
    measures = state.measure_indices
    offspring[:n_any_cell, measures] = samples[:n_any_cell, measures]
    # `normalize` moves points into the unit box, and choices to the center of an
    # option.
    x = box.normalize((offspring - box.low) / box.width)
    return box.to_configuration(offspring, x)


def _make_archive(
    domain: policies.Domain, measure_indices: Tensor, dims: Sequence[int], seed: int
) -> Any:
    """Return an empty archive of the package ribs: a grid over some parameters' ranges.

    ribs calls these parameters measures.

    Args:
        domain: domain of the search.
        measure_indices: (k,) indices in u of the parameters that span the archive.
        dims: number of cells along each of these axes.
        seed: seed of the search.
    """
    from ribs import archives  # an optional package, which takes seconds to import

    lower = domain.lower_bounds[measure_indices].tolist()
    upper = domain.upper_bounds[measure_indices].tolist()
    return archives.GridArchive(
        solution_dim=domain.dim,
        dims=dims,
        seed=seeds.derive_seed(seed, "archive"),
        ranges=list(zip(lower, upper, strict=True)),
        solution_dtype=np.float32,
        objective_dtype=np.float64,
        measures_dtype=np.float64,
        # each cell also has a flag: whether the model was wrong
        extra_fields={"wrong": ((), np.bool_)},
    )


def _make_observations(domain: policies.Domain) -> policies.Observations | None:
    """Return empty observations for a surrogate, or None for a search without one.

    A search has no surrogate if the domain has norm balls, or too many numbers.
    """
    box = policies.find_box_coordinates(domain)
    has_norm_balls = box.count < domain.dim
    has_too_many_numbers = domain.dim > policies.MAX_SCALED_DIM
    if has_norm_balls or has_too_many_numbers:
        return None
    return policies.Observations(box, torch.empty(0, box.count), memory=MEMORY)


@dataclass(frozen=True)
class MapElites(Policy[ArchiveState]):
    """MAP-Elites (Mouret and Clune 2015, "Illuminating search spaces by mapping
    elites") with the package ribs.

    The archive is a grid over a few parameters. Each cell stores the configuration with
    the largest objective whose parameters lie in the cell, whatever its other
    parameters are. A new configuration is made from two stored ones. The first, a, is
    the best of four random ones; the second, b, is a random one. As in Vassiliades and
    Mouret 2018, "Discovering the elite hypervolume by leveraging interspecies
    correlation", it is

        P(a + 0.1 s z + 0.3 (b - a) y),

    where P is the projection onto the domain, the vector z and the number y are
    standard normal, and s is half of each number's range. For the parameters of the
    archive s is four times as large, so that a change that makes the model fail in one
    cell is tried in others. A discrete choice is that of a, or with probability 0.1 a
    random one. A tenth of all configurations are random, so that every part of the
    domain can be reached.

    In a box of at most 16 numbers, renders are saved as in Gaier, Asteroth and Mouret
    2017 (arXiv 1702.03713). 300 candidates are made this way; in half of them the
    parameters of the archive are random. A Gaussian process that is fitted to all
    evaluations chooses a generation among them: from different cells, those that most
    likely fail where no failure is known yet.

    The objective is noisy, so a cell may store a configuration that was lucky. Only
    verified ones count as failures.

    Attributes:
        over: names of the parameters that span the archive, at most 4, separated by
            commas ("pose.yaw", "camera.target.0"); empty for the first two.
        cells: number of cells that each number's range is divided into, 2 to 1,000. A
            discrete choice has a cell for each option.
        population: number of configurations of a generation, at least 2.
    """

    over: str = ""
    cells: int = 10
    population: int = 10

    name: ClassVar[str] = "archive"
    uses_gradient: ClassVar[bool] = False
    handles_choices: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check that ribs is installed and all settings are within their limits."""
        if find_spec("ribs") is None:
            raise InputError(
                "policy 'archive' needs ribs, which is not installed: pip "
                "install 'advsearch[archive]'"
            )
        if not 2 <= self.cells <= 1000:
            raise InputError(
                f"cells: expected 2 to 1000 parts of each range, got {self.cells}"
            )
        if self.population < 2:
            raise InputError(f"population: expected at least 2, got {self.population}")

    def start(
        self, domain: policies.Domain, generator: torch.Generator, steps: int
    ) -> ArchiveState:
        """Start with an empty archive.

        The first generation has the initial point and random samples. A surrogate is
        used only if `_make_observations` says that the domain suits it.

        Args:
            domain: domain of the search.
            generator: source of the seed.
            steps: renders of the search; not used.

        Raises:
            InputError: the domain has too many numbers, or the archive too many cells.
        """
        domain.check_dim(MAX_DIM, "archive", "use pgd or auto")
        seed = policies.draw_seed(generator)
        measure_indices = self._find_measure_indices(domain)
        cells_of_axes = self._count_cells_of_axes(domain, measure_indices)
        archive = _make_archive(domain, measure_indices, cells_of_axes, seed)
        random_points = domain.sample(policies.seeded(seed, 0), self.population - 1)
        return ArchiveState(
            domain,
            seed,
            measure_indices,
            policies.compute_half_widths(domain),
            archive,
            generation=0,
            points=torch.cat([domain.initial_point[None], random_points]),
            observations=_make_observations(domain),
        )

    def _count_cells_of_axes(
        self, domain: policies.Domain, measure_indices: Tensor
    ) -> list[int]:
        """Return the number of cells along each axis of the archive.

        Args:
            domain: domain of the search.
            measure_indices: (k,) indices in u of the parameters that span the archive.

        Raises:
            InputError: the archive has too many cells.
        """
        # A choice has a cell for each option. A number has 0 options, and `cells`
        # cells.
        option_counts = domain.option_counts[measure_indices].tolist()
        cells_of_axes = [n_options or self.cells for n_options in option_counts]
        n_cells = math.prod(cells_of_axes)
        if n_cells > MAX_CELLS:
            raise InputError(
                f"cells: expected at most {MAX_CELLS} in all, got "
                f"{n_cells}; set `cells` lower"
            )
        return cells_of_axes

    def propose(
        self, state: ArchiveState, n: int
    ) -> tuple[tuple[policies.Proposal, ...], ArchiveState]:
        return tuple(
            policies.Proposal(u) for u in state.points[len(state.values) :][:n]
        ), state

    def update(
        self, state: ArchiveState, evaluated: policies.Evaluated
    ) -> ArchiveState:
        """Add evaluations to the generation; start the next once it is complete."""
        state = self._add_evaluations(state, evaluated)
        if len(state.values) < len(state.points):
            return state
        return self._start_generation(state.add_generation())

    @staticmethod
    def _add_evaluations(
        state: ArchiveState, evaluated: policies.Evaluated
    ) -> ArchiveState:
        """Return the state with the evaluations of the generation's next points."""
        new_values = [evaluation.objective for _, evaluation in evaluated]
        new_successes = [evaluation.success for _, evaluation in evaluated]
        observations = state.observations
        if observations is not None:
            observations = observations.extend(evaluated)
        return replace(
            state,
            values=(*state.values, *new_values),
            successes=(*state.successes, *new_successes),
            observations=observations,
        )

    def failures(self, state: ArchiveState) -> policies.Failures:
        """Return how many cells contain a failure, and diverse examples of these.

        The evaluations of the current generation are counted as well, even if it is not
        complete yet.
        """
        state = state.add_generation()  # with the current generation
        # one row for each cell that stores a configuration
        elites = state.archive.data()
        failed_rows = np.flatnonzero(elites["wrong"])
        examples = _choose_examples(
            state,
            elites["solution"][failed_rows],
            elites["objective"][failed_rows].tolist(),
            state.archive.int_to_grid_index(elites["index"][failed_rows]),
        )
        return policies.Failures(
            tuple(examples),
            cell_parameter_indices=tuple(state.measure_indices.tolist()),
            n_failures=len(failed_rows),
            n_visited=len(elites["objective"]),
            n_cells=int(state.archive.cells),
        )

    def _start_generation(self, state: ArchiveState) -> ArchiveState:
        """Begin the next generation: sample or choose its configurations.

        Each is a random sample of the domain with probability `RESAMPLED_FRACTION`. The
        others are offspring of the archive; if there is a surrogate, it chooses them
        among many candidates. While the archive is empty, all are random samples.
        """
        # no configuration of the new generation is evaluated yet
        state = replace(state, generation=state.generation + 1, values=(), successes=())
        domain = state.domain
        rng = policies.seeded(state.seed, state.generation)
        if state.archive.empty:  # nothing could be evaluated so far
            return replace(state, points=domain.sample(rng, self.population))
        # The order in a generation has no meaning, so random samples come first.
        is_random = torch.rand(self.population, generator=rng) < RESAMPLED_FRACTION
        n_random = int(is_random.sum())
        samples = domain.sample(rng, self.population)
        random_points = samples[:n_random]
        if state.observations is None:
            # Offspring may get new options for their choices from the other samples.
            offspring = state.make_offspring(samples[n_random:], rng)
            points = torch.stack([*random_points, *map(domain.project, offspring)])
            return replace(state, points=points)
        return self._choose_by_surrogate(state, random_points, rng)

    def _choose_by_surrogate(
        self, state: ArchiveState, random_points: Tensor, rng: torch.Generator
    ) -> ArchiveState:
        """Return the state with a generation that a surrogate has completed.

        Args:
            state: state of the search, with observations.
            random_points: (k, d) the first configurations of the generation.
            rng: generator of random numbers; it advances.
        """
        assert state.observations is not None
        count = self.population - len(random_points)
        with policies.limit_to_single_thread():
            surrogate, observations = state.observations.fit_surrogate()
            candidates = _make_candidates(state, observations, rng)
            promising_points = state.select_most_promising(surrogate, candidates, count)
        points = torch.cat([random_points, promising_points])
        return replace(state, points=points, observations=observations)

    def _find_measure_indices(self, domain: policies.Domain) -> Tensor:
        """Return the indices (k,) of the parameters that span the archive.

        They are those named in the option `over`, such as "pose.yaw, pose.pitch", by
        default the first two of the domain.

        Raises:
            UnknownNameError: the domain has no parameter of that name.
            InputError: a name occurs twice, or there are too many.
        """
        names = [name.strip() for name in self.over.split(",") if name.strip()]
        if not names:
            return torch.arange(min(2, domain.dim))
        index_of_name = {name: index for index, name in enumerate(domain.element_names)}
        _check_measures(names, index_of_name)
        return torch.tensor([index_of_name[name] for name in names])


def _choose_examples(
    state: ArchiveState,
    configurations: Any,
    objectives: Sequence[float],
    grid_indices: Any,
) -> list[policies.FoundFailure]:
    """Return diverse failures of the archive, each with the ranges of its cell.

    Args:
        state: state of the search.
        configurations: (n, d) array of the failure in each cell that has one.
        objectives: their objectives.
        grid_indices: (n, k) array, index of these cells on each axis of the archive.
    """
    # position of each cell in the grid, as a fraction of each axis
    positions = torch.from_numpy(grid_indices / state.archive.dims)
    measures = state.measure_indices.tolist()
    boundaries = state.archive.boundaries
    examples = []
    for index in _select_diverse_cells(state, positions, objectives):
        ranges = _find_cell_ranges(measures, boundaries, grid_indices[index])
        u = torch.from_numpy(configurations[index].copy())
        examples.append(policies.FoundFailure(u, objectives[index], ranges))
    return examples


def _select_diverse_cells(
    state: ArchiveState, positions: Tensor, objectives: Sequence[float]
) -> list[int]:
    """Return the indices of cells that are far from each other, the worst first.

    Args:
        state: state of the search.
        positions: (n, k) positions of the cells in the grid, as fractions of its axes.
        objectives: objectives of the configurations in the cells.
    """
    return policies.select_diverse(
        positions,
        objectives,
        is_periodic=policies.find_periodic(state.domain)[state.measure_indices],
        is_discrete=state.domain.option_counts[state.measure_indices] > 0,
    )


def _check_measures(names: Sequence[str], known_names: Collection[str]) -> None:
    """Raise an error if parameters can't span an archive.

    Raises:
        UnknownNameError: the domain has no parameter of that name.
        InputError: a name occurs twice, or there are too many.
    """
    for name in names:
        if name not in known_names:
            raise errors.UnknownNameError(
                "parameter in `over` of policy 'archive':", name, known_names
            )
    if len(set(names)) != len(names) or len(names) > MAX_MEASURES:
        raise InputError(
            f"over: expected 1 to {MAX_MEASURES} different "
            f"parameters, got {', '.join(names)}"
        )
