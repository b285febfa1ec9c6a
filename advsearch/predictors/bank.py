"""Searches over base colors under random conditions, predicted by a bank of matrices.

The bank has a matrix of light transport for each of its conditions, and grows during
the search (docs/transport.md).
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from advsearch.extend import (
    Policy,
    Problem,
    color,
    prediction,
    results,
    seeds,
    stored_files,
)

# initial number of conditions in the bank, as a multiple of those of an evaluation
INITIAL_CONDITIONS = 8
# While the bank grows, one condition is added for each `DRAWS_PER_CONDITION` that are
# drawn.
DRAWS_PER_CONDITION = 4
COMPARISON_INTERVAL = 100  # number of evaluations from one comparison to the next
# A comparison traces this many new conditions, and predicts as many of the bank.
N_COMPARED = 16
# The bank grows if the objective under unseen conditions is smaller by this number of
# standard errors.
MIN_STANDARD_ERRORS = 1.0
SPP = 4  # samples per pixel of a condition's light (see `problem.LIGHT_DEPTH`)
BATCH_SIZE = 16  # images in a batch of the model


def _compare_means(
    bank_objectives: Sequence[float], unseen_objectives: Sequence[float]
) -> tuple[float, float]:
    """Return the difference of two mean objectives, and its standard error.

    The difference is over 0 if the search does better under conditions of the bank than
    under unseen ones: then it has adapted to the bank. The standard error is
    sqrt(var_1 / n_1 + var_2 / n_2).

    Args:
        bank_objectives: objectives under conditions of the bank.
        unseen_objectives: objectives under new conditions.
    """
    bank_mean = statistics.fmean(bank_objectives)
    gap = bank_mean - statistics.fmean(unseen_objectives)
    variances = (
        statistics.pvariance(objectives) / len(objectives)
        for objectives in (bank_objectives, unseen_objectives)
    )
    return gap, math.sqrt(sum(variances))


@dataclass(frozen=True, eq=False)
class Condition:
    """A condition of the bank, and its matrix.

    Attributes:
        index: index in the sequence of all conditions of the bank.
        u: (d,) coordinates of the condition.
        renderer: predicts images under the condition.
        depends_on_searched_only: whether the inputs of the matrix, such as base colors,
            depend only on the searched controls, and not on the condition.
    """

    index: int
    u: Tensor
    renderer: prediction.LinearRenderer
    depends_on_searched_only: bool


def _predict_image_under(
    condition: Condition, searched_inputs: Mapping[str, Tensor], u: Tensor
) -> Tensor:
    """Return the predicted image (H, W, 3) of u (d,) under a condition.

    Args:
        condition: the condition.
        searched_inputs: the scene inputs that the searched controls set at u.
        u: (d,) the searched coordinates.
    """
    full_u = torch.cat([u, condition.u])
    renderer = condition.renderer
    if not condition.depends_on_searched_only:
        # computes the inputs from the full configuration first
        return renderer(full_u)
    # `linearized_at` has the inputs of the matrix by name
    matrix_inputs = {name: searched_inputs[name] for name in renderer.linearized_at}
    return renderer.predict_image(matrix_inputs, full_u)


@dataclass
class Bank(prediction.PredictedSearch):
    """The matrices of a run whose searches have random conditions.

    The bank begins with some conditions, and grows during the search. At regular
    intervals it is compared with unseen conditions. It grows on only if the search has
    adapted to the conditions of the bank, or if predictions are inaccurate.

    Attributes:
        collect_light: collects the light of conditions, on workers if there are any.
        growth_steps: indices of the evaluations whose comparison let the bank grow on.
        gaps: for each comparison, the mean objective under conditions of the bank minus
            that under unseen conditions.
    """

    method: ClassVar[str] = "matrix"
    title: ClassVar[str] = "collecting light transport"

    collect_light: prediction.Evaluate
    draws_conditions: bool = field(default=True, kw_only=True)
    n_renewals: int | None = field(default=None, kw_only=True)
    growth_steps: list[int] = field(default_factory=list)
    gaps: list[float] = field(default_factory=list)
    # conditions in memory, the newest last
    _conditions: list[Condition] = field(default_factory=list)
    # u at each comparison that let the bank grow, by the index of the evaluation
    _grown_at: dict[int, Tensor] = field(default_factory=dict)
    # inputs of the newest matrix, to share tensors that are equal
    _latest_inputs: dict[str, Tensor] = field(default_factory=dict)
    _image_renderer: prediction.LinearRenderer | None = None
    # light that is being collected, for conditions up to `_collected_until`
    _incoming: Iterator[prediction.Evaluation] = field(default_factory=lambda: iter(()))
    _collected_until: int = 0
    _bytes: int = 0
    _latest_step: int = 0
    _n_dropped: int = 0

    @property
    def preparation_spp(self) -> int:
        return self._count_conditions(0) * SPP

    def count_entries_and_bytes(self) -> tuple[int, int]:
        entries = sum(condition.renderer.n_entries for condition in self._conditions)
        return entries, self._bytes

    def summarize_conditions(self) -> results.BankOfConditions:
        """Return how the bank has grown, and the gap of its latest comparison.

        The gap is the mean objective under conditions of the bank minus that under
        unseen ones.
        """
        return results.BankOfConditions(
            created=self._count_conditions(self._latest_step),
            dropped=self._n_dropped,
            grown=len(self.growth_steps),
            gap=self.gaps[-1] if self.gaps else None,
        )

    def prepare(self, tick: prediction.ProgressCallback = lambda samples: None) -> None:
        self._fill(0, tick)

    def replay(self, query: prediction.Query) -> None:
        """Bring the bank to the state in which a query is evaluated.

        At every `COMPARISON_INTERVAL`-th query of a search, the bank is compared with
        unseen conditions, and may grow from there on. Then the matrices that it has by
        this query are made.
        """
        if query.kind == "search" and query.phase == "search":
            self._latest_step = query.row_index
            is_due = query.row_index > 0 and query.row_index % COMPARISON_INTERVAL == 0
            if is_due:
                self._compare(query.u, query.row_index)
        self._fill(self._latest_step)
        if query.includes_image:
            # Only called because the first image makes a renderer, which is counted in
            # `n_traced`. The count has to be the same if the evaluation of the query is
            # read from the store.
            self._render_image(query.u)

    def evaluate(self, query: prediction.Query) -> prediction.Evaluation:
        """Evaluate a query by its mean over conditions of the bank.

        If the image is requested, it shows the scene without random conditions.
        """
        self.replay(query)  # the comparison and the growth that are due
        conditions = self._choose_conditions(query.kind, query.row_index)
        # with the cost and the samples of the prediction
        evaluation = self._evaluate_under(conditions, query.u, query.gradient)
        if not query.includes_image:
            return evaluation
        return replace(
            evaluation, picture=color.round_to_8_bit(self._render_image(query.u))
        )

    def _evaluate_under(
        self,
        conditions: Sequence[Condition],
        u: Tensor,
        gradient: prediction.WhichGradient,
    ) -> prediction.Evaluation:
        """Evaluate u by its mean over conditions of the bank.

        Args:
            conditions: conditions of the bank.
            u: (d,) the searched coordinates.
            gradient: whether a derivative is computed.
        """
        full_configurations = [torch.cat([u, condition.u]) for condition in conditions]

        def predict(batch: slice, variable_u: Tensor) -> Tensor:
            return self._predict_images(conditions[batch], variable_u)

        evaluation = self.problem.evaluate_conditions(
            predict, full_configurations, u, gradient, BATCH_SIZE
        )
        # samples per pixel of the prediction: a matrix counts as one
        return replace(evaluation, predicted=1)

    def _choose_conditions(self, kind: str, index: int) -> list[Condition]:
        """Return the conditions under which a query is evaluated.

        The conditions that the bank has gained since the previous query come first, so
        that each of them is used soon. The others are random. In the ranking after the
        search no condition is new.

        Args:
            kind: kind of the search.
            index: index of the query.
        """
        count = min(self.problem.conditions_per_evaluation, len(self._conditions))
        previous_index = index - 1
        if kind != "search":
            # Any other search runs after "search", when the bank no longer grows. So
            # all conditions that it had at its latest step are old.
            previous_index = self._latest_step
        size_before = self._count_conditions(previous_index)
        conditions = self._conditions
        new = [condition for condition in conditions if condition.index >= size_before]
        old = [condition for condition in conditions if condition.index < size_before]
        new = new[:count]
        return new + self._sample(old, count - len(new), f"bank {kind}", index)

    def _sample(
        self, conditions: Sequence[Condition], count: int, stream: str, index: int
    ) -> list[Condition]:
        """Return `count` random conditions out of some, none of them twice.

        Args:
            conditions: conditions to choose from.
            count: number of conditions.
            stream: name of the stream of random numbers.
            index: index in that stream.
        """
        generator = torch.Generator().manual_seed(
            seeds.derive_seed(self.problem.seed, stream, index)
        )
        order = torch.randperm(len(conditions), generator=generator).tolist()
        return [conditions[position] for position in order[:count]]

    def _predict_images(self, conditions: Sequence[Condition], u: Tensor) -> Tensor:
        """Return predicted images (n, H, W, 3) under n conditions, with a graph from u.

        If the searched controls alone set all inputs of a matrix, such as base colors,
        these are computed once for all conditions.

        Args:
            conditions: n conditions of the bank.
            u: (d,) the searched coordinates.
        """
        searched_inputs = self.problem.searched_space.inputs(u)
        images = [
            _predict_image_under(condition, searched_inputs, u)
            for condition in conditions
        ]
        return torch.stack(images)

    def _render_image(self, u: Tensor) -> Tensor:
        """Return the image (H, W, 3) of u (d,) without random conditions."""
        if self._image_renderer is None:
            seed = seeds.derive_seed(self.problem.seed, "bank still")
            # Without a seed, the conditions are those that leave the scene unchanged.
            # These never vary, so that one renderer is enough.
            start = self.problem.make_full_configuration(self.problem.domain.start)
            self._image_renderer = self.problem.make_linear_renderer(start, seed, SPP)
            self.n_traced += 1
        with torch.no_grad():
            return self._image_renderer(self.problem.make_full_configuration(u))

    def _count_conditions(self, index: int) -> int:
        """Return the number of conditions that the bank has at an evaluation.

        This includes conditions that were dropped. It follows from these rules:

        - The bank begins with `INITIAL_CONDITIONS` for each draw of an evaluation.
        - It grows from the start to the first comparison, and from each comparison in
          `growth_steps` to the next one. While it grows, it gains one condition for
          every `DRAWS_PER_CONDITION` draws. A draw is a use of a condition: each
          evaluation makes `conditions_per_evaluation` draws.
        - In the second half of a search it does not grow, so that the search can
          converge.

        Args:
            index: index of the evaluation.
        """
        last_index_of_first_half = self.steps // 2 - 1
        # later evaluations have the same number
        index = min(index, last_index_of_first_half)
        n_growing_steps = 0  # number of evaluations so far at which the bank grew
        for begin in (0, *self.growth_steps):
            n_since_begin = max(index - begin + 1, 0)  # 0 if it begins later
            # the next comparison, which ends the growth, is `COMPARISON_INTERVAL` later
            n_growing_steps += min(n_since_begin, COMPARISON_INTERVAL)
        draws_per_step = self.problem.conditions_per_evaluation
        n_initial = INITIAL_CONDITIONS * draws_per_step
        n_draws = n_growing_steps * draws_per_step
        return n_initial + n_draws // DRAWS_PER_CONDITION

    def _make_query(self, condition_index: int) -> prediction.Query:
        """Return the query that collects the light of the condition with an index.

        A matrix is exact near the configuration at which its light is collected. The
        search moves, so this is the configuration at the latest comparison before the
        condition was added, or the start.

        Args:
            condition_index: index of the condition in the bank's sequence.
        """
        assert self.problem.conditions is not None
        u = self._find_light_configuration(condition_index)
        bank_seed = seeds.derive_seed(self.problem.seed, "bank")
        condition = prediction.sample_condition(
            self.problem.conditions, condition_index, bank_seed
        )
        seed = seeds.derive_seed(self.problem.seed, "bank matrix", condition_index)
        return prediction.Query(
            torch.cat([u, condition]), seed, spp=SPP, requested_output="light"
        )

    def _find_light_configuration(self, condition_index: int) -> Tensor:
        """Return u (d,) at which the light of a condition is collected."""
        u = self.problem.domain.start
        # The steps of the comparisons after which the bank grew are ascending, so that
        # the latest one that applies remains.
        for growth_step in self.growth_steps:
            size_before = self._count_conditions(growth_step - 1)
            was_added_later = condition_index >= size_before
            if was_added_later:
                u = self._grown_at[growth_step]
        return u

    def _fill(
        self, index: int, tick: prediction.ProgressCallback = lambda samples: None
    ) -> None:
        """Make the matrices of all conditions that the bank has by an evaluation.

        Args:
            index: index of the evaluation.
            tick: called with the samples of each condition that is made.
        """
        size = self._count_conditions(index)
        first_missing = self._first_missing
        if first_missing >= size:
            return
        with self.measure_seconds():
            # An earlier call may have requested the light of these conditions already:
            # that of all with an index below `_collected_until`.
            is_requested = first_missing < self._collected_until
            if not is_requested:
                self._request_light(first_missing, evaluation_index=index)
            for number in range(first_missing, size):
                # `_incoming` yields light in the order of the conditions
                light = next(self._incoming).collected_light
                self._add_condition(self._make_condition(number, light))
                tick(SPP)
                self._drop_oldest()

    @property
    def _first_missing(self) -> int:
        """The index of the first condition without a matrix."""
        if not self._conditions:
            return 0
        # The newest condition is the last. Older ones may have been dropped, so that
        # their number does not tell the index.
        return self._conditions[-1].index + 1

    def _add_condition(self, condition: Condition) -> None:
        """Add a condition to the bank, and the memory that its matrix takes."""
        self._conditions.append(condition)
        self._bytes += condition.renderer.n_bytes

    def _request_light(self, first_missing: int, evaluation_index: int) -> None:
        """Request the light of all conditions that the bank gains before a comparison.

        They are requested at once, so that workers collect them in parallel. How many
        are added later is decided by the comparison.

        Args:
            first_missing: index of the first condition without a matrix.
            evaluation_index: index of the current evaluation.
        """
        # comparisons are at the multiples of `COMPARISON_INTERVAL`
        n_intervals = evaluation_index // COMPARISON_INTERVAL
        next_comparison = (n_intervals + 1) * COMPARISON_INTERVAL
        last_before_comparison = next_comparison - 1
        self._collected_until = self._count_conditions(last_before_comparison)
        queries = [
            self._make_query(number)
            for number in range(first_missing, self._collected_until)
        ]
        self._incoming = iter(self.collect_light(queries))

    def _drop_oldest(self) -> None:
        """Drop the oldest matrices while all take too much memory; one always stays."""
        while len(self._conditions) > 1 and self._bytes > stored_files.scale_limit(
            prediction.MAX_BYTES
        ):
            self._bytes -= self._conditions.pop(0).renderer.n_bytes
            self._n_dropped += 1

    def _make_condition(
        self, number: int, light: prediction.LinearizedScene | None
    ) -> Condition:
        """Return the condition with an index, with the matrix of its light.

        Args:
            number: index of the condition in the bank's sequence.
            light: light that another process has collected; None to collect it here.
        """
        query = self._make_query(number)
        dim = self.problem.domain.dim
        renderer = self.problem.make_linear_renderer(query.u, query.seed, SPP, light)
        self.n_traced += 1
        # By name, the inputs of the scene at which the matrix was computed. They were
        # set by the searched controls and those of the condition together.
        inputs = renderer.linearized_at
        depends_on_searched_only = self._depend_on_searched_only(inputs, query.u[:dim])
        # in place, so that equal tensors of several conditions take memory only once
        self._share_equal_inputs(inputs)
        return Condition(number, query.u[dim:], renderer, depends_on_searched_only)

    def _depend_on_searched_only(self, inputs: dict[str, Tensor], u: Tensor) -> bool:
        """Return whether a condition has no influence on inputs of the scene.

        It has none if the searched controls, at u (d,), by themselves set all of them,
        and to the same values.
        """
        with torch.no_grad():
            searched_inputs = self.problem.searched_space.inputs(u)
        return all(
            name in searched_inputs and torch.equal(searched_inputs[name], value)
            for name, value in inputs.items()
        )

    def _share_equal_inputs(self, inputs: dict[str, Tensor]) -> None:
        """Replace inputs that equal those of the previous matrix by the same tensors.

        This saves memory.

        Args:
            inputs: inputs of the newest matrix by name; the dict of its renderer, which
                is changed.
        """
        for name, value in inputs.items():
            previous = self._latest_inputs.get(name)
            if previous is not None and torch.equal(previous, value):
                inputs[name] = previous
        self._latest_inputs = dict(inputs)

    def _compare(self, u: Tensor, index: int) -> None:
        """Compare the bank with unseen conditions, and let it grow if it must.

        It grows if the search does clearly worse under unseen conditions than under
        those of the bank, or if predictions are too far from traced images.

        Args:
            u: (d,) current configuration of the search.
            index: index of the evaluation.
        """
        problem = self.problem
        with self.measure_seconds():
            seed = seeds.derive_seed(problem.seed, "bank check", index)
            unseen_objectives = self._trace_unseen(u, seed)
            conditions = self._sample(self._conditions, N_COMPARED, "bank check", index)
            bank_objectives = self._predict_objectives(u, conditions)
            # mean of the bank minus mean of the unseen conditions
            gap, standard_error = _compare_means(bank_objectives, unseen_objectives)
            self.gaps.append(gap)
            self.n_traced += N_COMPARED
        compare_view = partial(self._compare_condition_view, conditions, u, seed)
        is_accurate = self.compare(compare_view).is_accepted  # stores the deviation
        # the search has adapted to the conditions of the bank
        is_overfitted = gap > MIN_STANDARD_ERRORS * standard_error
        if not is_accurate or is_overfitted:
            # `_count_conditions` lets the bank grow from these steps on
            self._grown_at[index] = u.detach().clone()
            self.growth_steps.append(index)

    def _compare_condition_view(
        self, conditions: Sequence[Condition], u: Tensor, seed: int, number: int
    ) -> prediction.ComparedView:
        """Compare the predicted image of u (d,) under a condition with traced ones.

        There may be more views than conditions, which are then used again.
        """
        condition = conditions[number % len(conditions)]
        return self.problem.compare_view(
            condition.renderer,
            torch.cat([u, condition.u]),
            seeds.derive_seed(seed, "view", number),
            SPP,
        )

    def _predict_objectives(
        self, u: Tensor, conditions: Sequence[Condition]
    ) -> list[float]:
        """Return the objectives of predicted images of u (d,), one per condition."""
        evaluated, _ = self.problem.evaluate_batch(
            partial(self._predict_images, conditions),
            [torch.cat([u, condition.u]) for condition in conditions],
            u,
            gradient=False,
        )
        # each evaluation comes with the output of the model
        return [evaluation.objective for evaluation, _ in evaluated]

    def _trace_unseen(self, u: Tensor, seed: int) -> list[float]:
        """Return the objectives of traced images under `N_COMPARED` new conditions.

        They are random, as those of a search without a bank.

        Args:
            u: (d,) the searched coordinates.
            seed: seed of the conditions and of the noise.
        """
        objectives = []
        for index in range(N_COMPARED):
            # one seed for both the condition and the noise
            draw_seed = seeds.derive_seed(seed, "draw", index)
            full_u = self.problem.make_full_configuration(u, draw_seed)
            query = prediction.Query(u, draw_seed)  # without a gradient
            evaluation, _ = self.problem.evaluate_full(query, full_u, draw_seed)
            objectives.append(evaluation.objective)
        return objectives


class BankMethod(prediction.PredictionMethod):
    """Predicts searches with random conditions by a matrix for each of some of them."""

    name = "bank"
    pictures_are = "predicted by matrices"

    def find_search_refusal(
        self, problem: Problem, steps: int, policy: Policy[Any]
    ) -> prediction.Refusal | None:
        if problem.conditions is None:
            return prediction.NOTHING_MOVES
        return prediction.find_matrix_refusal(problem, steps, specialise=True)

    def make_search(
        self,
        problem: Problem,
        steps: int,
        *,
        collect_light: prediction.Evaluate,
        clean_matrix: prediction.CleanMatrix,
    ) -> prediction.PredictedSearch:
        return Bank(problem, steps, collect_light)
