"""Quality diversity: many different failures instead of one, kept in an archive over
chosen parameters.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from advsearch.extend import InputError, Policy, errors, policies, seeds

MOST = 10_000  # more numbers are refused: every cell keeps a whole configuration
MOST_CELLS = 1_000_000  # an archive has no more
# parameters that span it; with more, nearly every configuration has a cell of its own
MOST_SPANNED = 4
# share of the configurations, and of the discrete choices, that are drawn anew
ANEW = 0.1
# so many kept configurations are drawn, and the one with the largest objective is
# changed
TOURNAMENT = 4
SIGMA = 0.1
LINE = 0.3
"""Standard deviations of a step, in half of each number's range, and of one along the
line through two configurations, in their distance.
"""

# how much larger steps are in the parameters that span the archive: that is where there
# are cells to fill
WIDER = 4.0
CANDIDATES = 300  # configurations that the surrogate chooses a generation from
ELSEWHERE = 0.5  # share of these whose parameters of the archive are drawn anew
# what a larger objective in a cell that fails already counts for, beside a failure in
# another
BETTER = 0.1
# the surrogate is made from so many of the best configurations and so many of the
# latest
MEMORY = 300


@dataclass(frozen=True, eq=False)
class ArchiveState:
    """Where the search stands: positions (k,) in u of what spans the archive, half of
    each number's range (d,), the archive of ribs, which is never written to again, this
    generation's configurations (n, d), objectives and successes of the first of them,
    and what the surrogate is made from; None where there are too many numbers, or a
    norm ball.
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
        """Return the state with a copy of the archive that has the generation so far.

        What could not be evaluated has no cell.
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

        Each has two parents. Its options are those of the first, now and then of a
        sample (n, d).
        """
        count, dim = samples.shape
        # Sampling changes the generator of an archive.
        archive = copy.deepcopy(self.archive)
        elites = archive.sample_elites((TOURNAMENT + 1) * count)
        shape = (TOURNAMENT + 1, count)
        solutions = torch.from_numpy(elites["solution"]).unflatten(0, shape)
        objectives = torch.from_numpy(elites["objective"]).unflatten(0, shape)
        winner = objectives[1:].argmax(0)
        first = solutions[1 + winner, torch.arange(count)]
        second = solutions[0]
        noise = torch.randn(count, dim, generator=rng)
        noise[:, self.measure_indices] *= WIDER
        line_step = LINE * torch.randn(count, 1, generator=rng)
        offspring: Tensor = (
            first + SIGMA * self.half_widths * noise + line_step * (second - first)
        )
        is_resampled = torch.rand(count, dim, generator=rng) < ANEW
        for block, part in self.domain.list_block_slices():
            if block.options:
                offspring[:, part] = torch.where(
                    is_resampled[:, part], samples[:, part], first[:, part]
                )
        return offspring

    def select_most_promising(
        self, surrogate: policies.Surrogate, points: Tensor, count: int
    ) -> Tensor:
        """Return the most promising of the candidates (n, d), (count, d).

        They are of different cells as long as there are enough: those that most likely
        fail where nothing fails yet. Where something does, a larger objective than its
        own counts for `BETTER` as much.
        """
        mean, deviation = surrogate.predict(surrogate.space.from_configuration(points))
        elites = self.archive.data()
        objectives = torch.from_numpy(elites["objective"])
        is_wrong = torch.from_numpy(elites["wrong"])
        wrong_objectives = objectives[is_wrong]
        wrong_cells = elites["index"][elites["wrong"]].tolist()
        objective_of_cell = dict(
            zip(wrong_cells, wrong_objectives.tolist(), strict=True)
        )
        threshold = float(
            wrong_objectives.min() if bool(is_wrong.any()) else objectives.max()
        )
        measures = points[:, self.measure_indices].double().numpy()
        cells = self.archive.index_of(measures).tolist()
        to_beat = torch.tensor(
            [objective_of_cell.get(cell, threshold) for cell in cells]
        )
        weight = torch.tensor(
            [BETTER if cell in objective_of_cell else 1.0 for cell in cells]
        )
        promise = weight * torch.special.ndtr((mean - to_beat) / deviation)
        order = promise.argsort(descending=True, stable=True).tolist()
        return points[_one_per_cell_first(order, cells)[:count]]


def _one_per_cell_first(order: list[int], cells: list[int]) -> list[int]:
    """Return the order with the first candidate of each cell before all others."""
    first_of_cell = dict[int, int]()
    for index in order:
        first_of_cell.setdefault(cells[index], index)
    others = [index for index in order if first_of_cell[cells[index]] != index]
    return [*first_of_cell.values(), *others]


@dataclass(frozen=True)
class MapElites(Policy[ArchiveState]):
    """MAP-Elites (Mouret and Clune 2015, "Illuminating search spaces by mapping
    elites") with the package ribs.

    The archive is a grid over a few parameters. Each cell keeps the configuration with
    the largest objective that fell into it, whatever the parameters beyond are there. A
    new configuration is made of two kept ones, a the best of four that are drawn, b one
    that is drawn, as by Vassiliades and Mouret 2018, "Discovering the elite hypervolume
    by leveraging interspecies correlation":

        P(a + 0.1 s z + 0.3 (b - a) y),

    z a vector and y a number, standard normal, s half of each number's range, four
    times that for the parameters of the archive: what makes the model fail in one cell
    is tried in others. A discrete choice is that of a, or, one in ten, drawn anew. One
    in ten configurations is drawn anew, so that no part of the domain is out of reach.

    In a box of few numbers (16) renders are saved as by Gaier, Asteroth and Mouret 2017
    (arXiv 1702.03713): 300 are made so, of half of them the parameters of the archive
    drawn anew, and a Gaussian process fitted to what was seen chooses a generation
    among them: of different cells, those that most likely fail where nothing does yet.

    The objective is noisy, so a cell may keep a configuration that was lucky; only
    verified ones count as failures.

    Attributes:
        over: the parameters that span the archive, at most 4, separated by commas, by
            name ("pose.yaw", "camera.target.0"); empty for the first two.
        cells: how many parts each number's range has in the archive, 2 to 1,000; a
            discrete choice has its options.
        population: configurations a generation, at least 2.
    """

    over: str = ""
    cells: int = 10
    population: int = 10

    name: ClassVar[str] = "archive"
    uses_gradient: ClassVar[bool] = False
    handles_choices: ClassVar[bool] = True

    def __post_init__(self) -> None:
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
        if domain.dim > MOST:
            raise InputError(
                f"policy 'archive': expected at most {MOST} numbers, got "
                f"{domain.dim}; use pgd or auto"
            )
        seed = policies.draw_seed(generator)
        spanned = self._spanned(domain)
        dims = [options or self.cells for options in domain.options[spanned].tolist()]
        if math.prod(dims) > MOST_CELLS:
            raise InputError(
                f"cells: expected at most {MOST_CELLS} in all, got "
                f"{math.prod(dims)}; set `cells` lower"
            )
        from ribs import archives  # an extra, and it takes seconds

        archive = archives.GridArchive(
            solution_dim=domain.dim,
            dims=dims,
            seed=seeds.stream(seed, "archive"),
            ranges=list(
                zip(
                    domain.lower[spanned].tolist(),
                    domain.upper[spanned].tolist(),
                    strict=True,
                )
            ),
            solution_dtype=np.float32,
            objective_dtype=np.float64,
            measures_dtype=np.float64,
            extra_fields={"wrong": ((), np.bool_)},
        )
        first = [
            domain.begin[None],
            domain.sample(policies.seeded(seed, 0), self.population - 1),
        ]
        box = policies.find_box_coordinates(domain)
        few = box.count == domain.dim <= policies.MAX_SCALED_DIM
        seen = (
            policies.Observations(box, torch.empty(0, box.count), memory=MEMORY)
            if few
            else None
        )
        return ArchiveState(
            domain,
            seed,
            spanned,
            policies.compute_half_widths(domain),
            archive,
            0,
            torch.cat(first),
            observations=seen,
        )

    def propose(
        self, state: ArchiveState, n: int
    ) -> tuple[tuple[policies.Proposal, ...], ArchiveState]:
        return tuple(
            policies.Proposal(u) for u in state.points[len(state.values) :][:n]
        ), state

    def update(
        self, state: ArchiveState, evaluated: policies.Evaluated
    ) -> ArchiveState:
        values = (*state.values, *(evaluation.objective for _, evaluation in evaluated))
        wrong = (*state.successes, *(evaluation.success for _, evaluation in evaluated))
        seen = (
            None if state.observations is None else state.observations.extend(evaluated)
        )
        state = replace(state, values=values, successes=wrong, observations=seen)
        return (
            state
            if len(values) < len(state.points)
            else self._next(state.add_generation())
        )

    def failures(self, state: ArchiveState) -> policies.Failures:
        """Return the cells whose configuration is a success.

        Those of a generation that is not complete yet count.
        """
        archive = state.add_generation().archive
        measure_indices = tuple(state.measure_indices.tolist())
        elites = archive.data()
        wrong = np.flatnonzero(elites["wrong"])
        grid_indices = archive.int_to_grid_index(elites["index"][wrong])
        objectives = elites["objective"][wrong].tolist()
        is_periodic = policies.find_periodic(state.domain)[state.measure_indices]
        is_discrete = state.domain.options[state.measure_indices] > 0
        chosen = policies.select_diverse(
            torch.from_numpy(grid_indices / archive.dims),
            objectives,
            is_periodic,
            is_discrete,
        )
        examples = []
        for number in chosen:
            ranges = {
                measure: (float(edges[cell]), float(edges[cell + 1]))
                for measure, edges, cell in zip(
                    measure_indices,
                    archive.boundaries,
                    grid_indices[number],
                    strict=True,
                )
            }
            u = torch.from_numpy(elites["solution"][wrong[number]].copy())
            examples.append(policies.FoundFailure(u, objectives[number], ranges))
        return policies.Failures(
            tuple(examples),
            measure_indices,
            len(wrong),
            len(elites["objective"]),
            int(archive.cells),
        )

    def _next(self, state: ArchiveState) -> ArchiveState:
        """Begin the next generation; no other state has the archive yet."""
        state = replace(state, generation=state.generation + 1, values=(), successes=())
        domain = state.domain
        rng = policies.seeded(state.seed, state.generation)
        if state.archive.empty:
            return replace(state, points=domain.sample(rng, self.population))
        n_new = int((torch.rand(self.population, generator=rng) < ANEW).sum())
        samples = domain.sample(rng, self.population)
        observations = state.observations
        if observations is None:
            offspring = [
                domain.project(u) for u in state.make_offspring(samples[n_new:], rng)
            ]
            return replace(state, points=torch.stack([*samples[:n_new], *offspring]))
        with policies.use_one_thread():
            surrogate, observations = observations.fit_surrogate()
            box = observations.space
            uniform = torch.rand(CANDIDATES, box.count, generator=rng)
            candidates = box.low + box.width * uniform
            offspring_points = state.make_offspring(candidates, rng)
            # Some are moved to any cell.
            n_moved = int(ELSEWHERE * CANDIDATES)
            offspring_points[:n_moved, state.measure_indices] = candidates[
                :n_moved, state.measure_indices
            ]
            x = box.normalize((offspring_points - box.low) / box.width)
            points = state.select_most_promising(
                surrogate,
                box.to_configuration(offspring_points, x),
                self.population - n_new,
            )
        points = torch.cat([samples[:n_new], points])
        return replace(state, points=points, observations=observations)

    def _spanned(self, domain: policies.Domain) -> Tensor:
        """Return the indices (k,) of the parameters that span the archive."""
        names = [name.strip() for name in self.over.split(",") if name.strip()]
        if not names:
            return torch.arange(min(2, domain.dim))
        index_of_name = {name: index for index, name in enumerate(domain.names)}
        for name in names:
            if name not in index_of_name:
                raise errors.UnknownNameError(
                    "parameter in `over` of policy 'archive':", name, index_of_name
                )
        if len(set(names)) != len(names) or len(names) > MOST_SPANNED:
            raise InputError(
                f"over: expected 1 to {MOST_SPANNED} different "
                f"parameters, got {', '.join(names)}"
            )
        return torch.tensor([index_of_name[name] for name in names])
