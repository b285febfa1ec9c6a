"""Searches in which cameras move, predicted by stored light on surfaces.

At intervals predicted images are compared with traced ones. If they are not accurate
enough, the light is computed again for the current base colors, if these are searched.
After a second failure in a row, further images are traced, or predicted by matrices
(docs/surface-light.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from advsearch.extend import Policy, Problem, color, prediction, results, seeds
from advsearch.predictors.surface_light import renderer as surface_renderer
from advsearch.predictors.surface_light.arrangement import (
    CAMERA_INPUTS,
    COLOR_INPUT,
    ENVIRONMENT_INPUT,
)
from advsearch.predictors.surface_light.renderer import (
    LitCameraView,
    MapFingerprint,
    SurfaceRenderer,
)
from advsearch.predictors.surface_light.view_rays import RAYS_PER_PIXEL

MIN_IMAGES = 32
"""Smallest number of images of a search for which the light pays. The light and a
comparison take as long as about 25 rendered images, or 45 if the first views do not
decide.
"""
# If no camera moves, light on surfaces has no advantage.
NO_CAMERA = prediction.Refusal("no camera moves", prediction.RefusalCause.NO_CAMERA)
# number of environments whose light is stored, if conditions change the environment
N_LIGHTS = 64
# first interval between two comparisons, as a number of evaluations
COMPARISON_INTERVAL = 100
BATCH_SIZE = 8  # images in a batch of the model
N_CONDITION_SETS = 4
"""Number of sets of conditions of a random search, which are used in turn. Such a
search can't adapt to them, since it does not learn from evaluations. So the views of
the cameras can be stored, and are traced only once for each set.
"""


def find_surface_light_refusal(
    problem: Problem, steps: int, policy: Policy[Any]
) -> prediction.Refusal | None:
    """Return why light on surfaces does not predict a search; None if it may.

    Whether its predictions are accurate is measured later.

    Args:
        problem: problem of the search.
        steps: evaluations of the search.
        policy: policy by which it searches.
    """
    names = [control.name for control in problem.space.controls]
    changed_inputs = prediction.find_changed_inputs(problem.renderer, names)
    moves_camera = bool(changed_inputs & CAMERA_INPUTS)
    if not moves_camera:
        return NO_CAMERA
    return (
        _find_search_refusal(problem, steps, policy)
        or _find_forced_refusal(problem)
        or surface_renderer.find_refusal(problem.renderer, names)
    )


def _find_search_refusal(
    problem: Problem, steps: int, policy: Policy[Any]
) -> prediction.Refusal | None:
    """Return why a search is too short, or needs rendered images; None if it does not."""
    n_images = steps * problem.conditions_per_evaluation
    if n_images < MIN_IMAGES:
        return prediction.Refusal(
            f"light on surfaces pays from {MIN_IMAGES} pictures on",
            prediction.RefusalCause.TOO_FEW_STEPS,
        )
    if policy.takes_differences(problem.domain, steps):
        return prediction.Refusal(
            f"{policy.name} takes derivatives that need rendered pictures"
        )
    return None


def _find_forced_refusal(problem: Problem) -> prediction.Refusal | None:
    """Return a refusal if the user forces an estimator of rendered images, else None."""
    for group in problem.gradient_plan.groups:
        # The user may force an estimator of derivatives of rendered images. Derivatives
        # of predicted images are computed in another way.
        needs_estimator = group.estimator not in ("none", "image")
        if group.is_forced and needs_estimator:
            return prediction.Refusal(f"the estimator of {group.name} is forced")
    return None


@dataclass
class SurfaceLight(prediction.PredictedSearch):
    """The light on surfaces of a run whose searches have many cameras.

    The light of an environment on all surfaces is computed once and stored. Then images
    of other cameras, and with other base colors, can be predicted. If conditions change
    the environment, the bank has the light of `N_LIGHTS` of them.

    Attributes:
        light_u: (d,) configuration whose light is computed; None for the start.
        moving_coordinates: indices of the coordinates of u that move; None for those of
            cameras and environments.
        _is_moving: (d,) bool, which searched coordinates move a camera or change the
            environment.
        _has_moving: whether there is such a coordinate.
        _searches_colors: whether a searched coordinate changes base colors.
        _needs_new_light: (k,) bool, which coordinates of the conditions change the
            environment, so that other light has to be computed.
        _input_space: controls whose scene inputs are computed for an image.
    """

    method: ClassVar[str] = "surface light"
    title: ClassVar[str] = "finding the light on surfaces"
    light_u: Tensor | None = None
    moving_coordinates: Tensor | None = None
    _renderer: SurfaceRenderer | None = None
    # (k,) coordinates of each condition of the bank
    _bank_conditions: list[Tensor] = field(default_factory=list)
    _n_lights: int = 0
    # index of the evaluation before which predictions are compared again; 0 at first,
    # which means `COMPARISON_INTERVAL`
    _next_comparison: int = 0
    # views of the cameras, by the index of the set of conditions and the first index of
    # the batch in it
    _stored_views: dict[tuple[int, int], list[LitCameraView]] = field(
        default_factory=dict
    )

    def __post_init__(self) -> None:
        """Find which coordinates move cameras, change environments and color surfaces.

        Sets the private attributes that the class docstring lists.
        """
        problem = self.problem
        # number of searched coordinates
        n_searched = problem.domain.dim
        self._inputs_of_control = self._find_inputs_of_controls()
        self._is_moving = self._find_moving_coordinates()
        self._has_moving = bool(self._is_moving.any())
        is_coloring = self._find_coordinates(frozenset({COLOR_INPUT}))[:n_searched]
        self._searches_colors = bool(is_coloring.any())
        self.draws_conditions = problem.conditions is not None and self._searches_colors
        self._input_space = self._select_input_space()
        # coordinates of the conditions only, which follow the searched ones
        self._needs_new_light = self._find_coordinates_of_light()[n_searched:]

    def _find_inputs_of_controls(self) -> dict[str, frozenset[str]]:
        """Return the scene inputs that each control changes, by its name."""
        renderer = self.problem.renderer
        return {
            control.name: prediction.find_changed_inputs(renderer, [control.name])
            for control in self.problem.space.controls
        }

    def _find_moving_coordinates(self) -> Tensor:
        """Return which searched coordinates move something, (d,) bool.

        These are the stated `moving_coordinates`, or else those that move a camera or
        change the environment.
        """
        n_searched = self.problem.domain.dim
        if self.moving_coordinates is not None:
            return torch.zeros(n_searched, dtype=torch.bool).index_fill_(
                0, self.moving_coordinates, True
            )
        is_moving = self._find_coordinates(CAMERA_INPUTS | {ENVIRONMENT_INPUT})
        # the searched coordinates come first, those of the conditions after them
        return is_moving[:n_searched]

    def _select_input_space(self) -> prediction.Space:
        """Return the space of the controls whose scene inputs have to be computed.

        Base colors are applied separately. So if nothing that is searched moves, these
        are only the controls of the conditions, which come last.
        """
        space = self.problem.space
        if self._has_moving:
            return space
        # `problem.n_searched` is None without conditions: then all controls count
        n_searched_controls = self.problem.n_searched or 0
        return replace(space, controls=space.controls[n_searched_controls:])

    def _find_coordinates(self, inputs: frozenset[str]) -> Tensor:
        """Return which coordinates of the full space change given inputs, (d,) bool.

        What changes is known for each control as a whole. So all coordinates of a
        control count if it changes any of the inputs.

        Args:
            inputs: names of scene inputs, such as "environment.padded".
        """
        space = self.problem.space
        changes_inputs = torch.zeros(len(space.start), dtype=torch.bool)
        for group in space.groups:
            changes_inputs[group.coordinates] = bool(
                self._inputs_of_control[group.control] & inputs
            )
        return changes_inputs

    def _find_coordinates_of_light(self) -> Tensor:
        """Return which coordinates of the full space need new light, (d,) bool.

        These are the coordinates that change the environment. If conditions vary, the
        light of many environments is stored. Then coordinates that only scale the
        brightness are left out, since the stored light can be scaled likewise.
        """
        needs_new_light = self._find_coordinates(frozenset({ENVIRONMENT_INPUT}))
        if self.problem.conditions is None:
            return needs_new_light
        for group in self.problem.space.groups:
            changes_environment = bool(needs_new_light[group.coordinates].all())
            if changes_environment and self._only_scales_environment(group):
                needs_new_light[group.coordinates] = False
        return needs_new_light

    def _only_scales_environment(self, group: prediction.Group) -> bool:
        """Return whether a group only changes how bright the environment is.

        Two environment maps are computed, for two values of the coordinates of the
        group. Only the brightness differs if one map is a multiple of the other.
        """
        start = self.problem.make_full_configuration(self.problem.domain.start)
        fingerprints = []
        # Any two different values in (0, 1) would do. At a bound of the range the
        # environment might be black.
        for value in (0.3, 0.8):
            full_u = start.clone()
            full_u[group.coordinates] = value
            environment = self._compute_inputs(full_u)[ENVIRONMENT_INPUT]
            fingerprints.append(MapFingerprint.compute(environment))
        first_map, second_map = fingerprints
        # the ratio is None if neither map is a multiple of the other
        return first_map.compute_map_ratio(second_map) is not None

    @property
    def preparation_spp(self) -> int:
        return N_LIGHTS

    def summarize_conditions(self) -> results.BankOfConditions | None:
        """Return the state of the bank of lights; None without conditions."""
        if self.problem.conditions is None:
            return None
        return results.BankOfConditions(
            created=self._n_lights, dropped=self.renderer.n_dropped, grown=0, gap=None
        )

    def count_entries_and_bytes(self) -> tuple[int, int]:
        return self.renderer.n_entries, self.renderer.n_bytes

    @property
    def accuracy_refusal(self) -> prediction.Refusal | None:
        if not self.deviations or self.deviations[0].is_accepted:
            return None
        return prediction.Refusal(f"light on surfaces is {self.deviations[0].reason}")

    def count_predicted(self, kind: str, evaluations: int) -> int:
        """Return how many of the first evaluations of a search were predicted.

        Args:
            kind: kind of the search.
            evaluations: how many evaluations it has had.
        """
        # The search of kind "search" comes first. If it has given predictions up,
        # images of all later ones are traced.
        search_failed = "search" in self.first_traced
        if search_failed and kind != "search":
            return 0
        return super().count_predicted(kind, evaluations)

    def prepare(self, tick: prediction.ProgressCallback = lambda samples: None) -> None:
        """Compute the light under every condition of the bank, and check its accuracy.

        The first predicted images are compared with traced ones.

        Args:
            tick: called after each light with the progress that it stands for. The sum
                over all lights is about `N_LIGHTS`.
        """
        problem = self.problem
        u = problem.domain.start if self.light_u is None else self.light_u
        with self.measure_seconds(), torch.no_grad():
            # Without a seed, the conditions leave the scene unchanged.
            full_u = problem.make_full_configuration(u)
            light_seed = seeds.derive_seed(problem.seed, "surface light")
            self._renderer = SurfaceRenderer(problem.renderer, full_u, light_seed)
            self._bank_conditions = self._sample_bank_conditions()
            self._store_lights(self._renderer, u, tick)
            # The renderer drops stored lights if they do not fit into memory.
            n_stored = len(self._renderer.stored_lights)
            self._n_lights = n_stored + self._renderer.n_dropped
        self._compare(u, index=0)

    def _store_lights(
        self, renderer: SurfaceRenderer, u: Tensor, tick: prediction.ProgressCallback
    ) -> None:
        """Compute and store the light of u (d,) under each condition of the bank."""
        for condition in self._bank_conditions:
            inputs = self._compute_inputs(torch.cat([u, condition]))
            # only called to compute and store the light
            renderer.get_light_and_factor(inputs)
            # `N_LIGHTS` is the length of the progress bar (`n_samples`), also if there
            # is a single condition
            tick(N_LIGHTS // len(self._bank_conditions))

    def _sample_bank_conditions(self) -> list[Tensor]:
        """Return the conditions (k,) of the bank, each of which gets its light.

        If the problem has no conditions, the list has a single one without coordinates,
        so that other code need not tell the cases apart.
        """
        problem = self.problem
        if problem.conditions is None:
            return [torch.empty(0)]
        seed = seeds.derive_seed(problem.seed, "bank")
        # If no coordinate of the conditions changes the light, one light serves all.
        n_conditions = N_LIGHTS if bool(self._needs_new_light.any()) else 1
        return [
            prediction.sample_condition(problem.conditions, index, seed)
            for index in range(n_conditions)
        ]

    @property
    def renderer(self) -> SurfaceRenderer:
        """The renderer that has the light; it is prepared on first use."""
        if self._renderer is None:
            self.prepare()
        assert self._renderer is not None
        return self._renderer

    def evaluate_all(
        self, queries: Sequence[prediction.Query], trace: prediction.Evaluate
    ) -> Iterator[prediction.Evaluation]:
        """Evaluate queries of a search, or trials, in their order.

        If neither conditions nor colors vary, images do not depend on earlier
        evaluations, and are predicted in batches. Otherwise `evaluate` predicts them
        one by one.

        Args:
            queries: the queries.
            trace: evaluates queries by rendered images. It gets the first query that
                cannot be predicted, and all that follow it.
        """
        # images of the latest batch, by the position of the query in `queries`
        predicted_images: dict[int, Tensor] = {}
        can_batch = self.problem.conditions is None and not self._searches_colors
        for position, query in enumerate(queries):
            # Compares predictions if that is due; they may be given up by this.
            self.replay(query)
            if self._must_trace(query):
                yield from trace(queries[position:])
                return
            if can_batch and position not in predicted_images:
                batch = queries[position : position + self.renderer.batch_size]
                predicted_images = self._predict_batch(batch, first_position=position)
            # None without batches: then `evaluate` predicts the image
            image = predicted_images.get(position)
            yield self.evaluate(query, image)

    def _predict_batch(
        self, batch: Sequence[prediction.Query], first_position: int
    ) -> dict[int, Tensor]:
        """Return the predicted image (H, W, 3) of each query of a batch, by position."""
        images = self.renderer.predict_images([query.u for query in batch])
        return dict(enumerate(images, start=first_position))

    def _must_trace(self, query: prediction.Query) -> bool:
        """Return whether a query has to be rendered.

        It has to if predictions were given up before it, or if its gradient takes
        differences of rendered images. A "free" gradient takes none.
        """
        requests_all = query.gradient is True  # and not "free"
        costs_renders = self.problem.domain.gradient_cost > 0
        if requests_all and costs_renders:
            return True
        # number of predicted evaluations among the first ones, up to this query
        n_predicted = self.count_predicted(query.kind, query.row_index + 1)
        is_predicted = query.row_index < n_predicted
        return not is_predicted

    def evaluate(
        self, query: prediction.Query, image: Tensor | None = None
    ) -> prediction.Evaluation:
        """Evaluate a query by predicted images.

        Args:
            query: the query.
            image: (H, W, 3) image of the query that is predicted already. Without it, a
                query of a search is evaluated by its mean over conditions; if there are
                no conditions, over a single image.
        """
        # a query of a search has a phase, "search" or "ranking"
        is_trial = query.phase is None
        if is_trial:
            return self._evaluate_trial(query, image)
        if image is not None:
            return self._evaluate_image(query, image)
        return self._evaluate_over_conditions(query)

    def _evaluate_trial(
        self, query: prediction.Query, image: Tensor | None
    ) -> prediction.Evaluation:
        """Evaluate a trial, which tests a configuration outside of the search.

        The predicted image is rounded to 8 bits, as a file would hold it.

        Args:
            query: the trial.
            image: (H, W, 3) predicted image; None to predict it here.
        """
        full_u = self.problem.make_full_configuration(query.u)
        with torch.no_grad():
            if image is None:
                image = self.renderer(full_u)
            rounded = color.round_to_8_bit(image)
        return prediction.Evaluation.from_judgement(
            self.problem.judge(rounded, full_u),
            cost=0,  # nothing is rendered
            predicted=RAYS_PER_PIXEL,  # samples per pixel of a predicted image
            picture=rounded if query.includes_image else None,
        )

    def _evaluate_image(
        self, query: prediction.Query, image: Tensor
    ) -> prediction.Evaluation:
        """Evaluate a query of a search by its predicted image, without derivative."""
        # There are no conditions here, so that the full configuration is u itself.
        evaluated, _ = self.problem.evaluate_batch(
            lambda u: image[None],  # a batch of one image
            full_configurations=[query.u],
            u=query.u,
            gradient=False,
        )
        ((evaluation, _),) = evaluated
        return replace(
            evaluation,
            cost=query.samples,
            predicted=RAYS_PER_PIXEL,  # samples per pixel of a predicted image
            picture=color.round_to_8_bit(image) if query.includes_image else None,
        )

    def _evaluate_over_conditions(
        self, query: prediction.Query
    ) -> prediction.Evaluation:
        """Evaluate a query of a search by its mean over conditions.

        An image is predicted under each of the `conditions_per_evaluation` conditions.
        An image that the query requests shows the scene without random conditions.
        """
        problem = self.problem
        conditions = self._choose_conditions(
            query.kind,
            self._find_set_index(query),
            problem.conditions_per_evaluation,
        )
        full_configurations = [
            torch.cat([query.u, condition]) for condition in conditions
        ]
        predict = partial(self._predict_slice, query, full_configurations)
        evaluation = problem.evaluate_conditions(
            predict, full_configurations, query.u, query.gradient, BATCH_SIZE
        )
        evaluation = replace(evaluation, cost=query.samples, predicted=RAYS_PER_PIXEL)
        if not query.includes_image:
            return evaluation
        return replace(evaluation, picture=self._predict_clean_image(query.u))

    def _find_set_index(self, query: prediction.Query) -> int:
        """Return the index of the set of conditions under which a query is evaluated."""
        if self._reuses_conditions(query.kind):
            return query.row_index % N_CONDITION_SETS
        return query.row_index

    def _predict_slice(
        self,
        query: prediction.Query,
        full_configurations: Sequence[Tensor],
        batch: slice,
        u: Tensor,
    ) -> Tensor:
        """Return predicted images (n, H, W, 3) of a slice of full configurations.

        Args:
            query: the query, on which it depends if views of the cameras are stored.
            full_configurations: all full configurations.
            batch: the slice.
            u: (d,) the searched coordinates, perhaps with a gradient.
        """
        key: tuple[int, int] | None = None
        if self._reuses_conditions(query.kind):
            # the key under which the views of this batch of conditions are stored
            key = (self._find_set_index(query), batch.start)
        return self._predict_images(full_configurations[batch], u, key)

    def _predict_clean_image(self, u: Tensor) -> Tensor:
        """Return the predicted image (H, W, 3) of u (d,), without random conditions."""
        with torch.no_grad():
            # Without a seed, the conditions leave the scene unchanged.
            clean_full_u = self.problem.make_full_configuration(u)
            images = self._predict_images([clean_full_u], u)
            return color.round_to_8_bit(images[0])

    def _reuses_conditions(self, kind: str) -> bool:
        """Return whether a search uses a few sets of conditions in turn.

        A random search ("baseline") does. But if something that is searched moves, the
        views of the cameras differ each time, and nothing is gained.
        """
        has_conditions = self.problem.conditions is not None
        return kind == "baseline" and has_conditions and not self._has_moving

    def _choose_conditions(self, kind: str, number: int, count: int) -> list[Tensor]:
        """Return the conditions (k,) of an evaluation: new cameras under stored lights.

        The coordinates that need new light come from a random condition of the bank,
        whose light is stored. All others, such as those of cameras, are sampled anew.

        Args:
            kind: kind of the search, for the seed.
            number: index of the evaluation, for the seed.
            count: number of conditions.
        """
        problem = self.problem
        if problem.conditions is None:
            # the bank has a single condition without coordinates, which is repeated
            return self._bank_conditions * count
        condition_seed = seeds.derive_seed(problem.seed, f"surface {kind}", number)
        generator = torch.Generator().manual_seed(condition_seed)
        n_lights = len(self._bank_conditions)
        positions = torch.randint(n_lights, (count,), generator=generator).tolist()
        new_conditions = problem.conditions.sample(generator, count)
        # all are (k,), as `_needs_new_light` is
        return [
            torch.where(
                self._needs_new_light, self._bank_conditions[position], new_condition
            )
            for position, new_condition in zip(positions, new_conditions, strict=True)
        ]

    def _compute_inputs(self, full_u: Tensor) -> dict[str, Tensor]:
        """Return the scene inputs of a full configuration.

        `_input_space` has all controls. But if no searched control moves anything, it
        has only those of the conditions. Then only their inputs are computed: those of
        searched controls, which are base colors, are left out.
        """
        with torch.no_grad():
            # The coordinates of the conditions are the last ones of `full_u`.
            first = len(full_u) - len(self._input_space.start)
            inputs = self._input_space.inputs(full_u[first:])
            # completed by the inputs that nothing changes
            return self.problem.renderer.scene.input_assembler(inputs)

    def _predict_images(
        self,
        full_configurations: Sequence[Tensor],
        u: Tensor,
        key: tuple[int, int] | None = None,
    ) -> Tensor:
        """Return predicted images (n, H, W, 3), with a graph from u.

        Args:
            full_configurations: n full configurations, whose searched coordinates are
                u.
            u: (d,) the searched coordinates, perhaps with a gradient.
            key: (index of a set of conditions, first index of the batch in it). The
                views of the cameras are stored under this key for later calls. None to
                store nothing.
        """
        # base colors, with a graph from u
        color = self.renderer.get_color(self.problem.searched_space.inputs(u))
        # The same configurations with a graph from u, for controls that change the
        # finished image, such as a blur.
        variable_configurations = [
            torch.cat([u, full_u[len(u) :]]) for full_u in full_configurations
        ]
        inputs = [self._compute_inputs(full_u) for full_u in full_configurations]
        views = self._find_views(inputs, key)
        return self.renderer.compose_images(
            views, inputs, color, variable_configurations
        )

    def _find_views(
        self, inputs: Sequence[dict[str, Tensor]], key: tuple[int, int] | None
    ) -> Iterable[LitCameraView]:
        """Return the views of the cameras, traced or stored under a key."""
        if key is None:
            # an iterator, so that only one view at a time is in memory
            return self.renderer.trace_views(inputs)
        if key not in self._stored_views:
            self._stored_views[key] = list(self.renderer.trace_views(inputs))
        return self._stored_views[key]

    def replay(self, query: prediction.Query) -> None:
        """Bring the predictor to its state at a query: compare it if that is due.

        Before a query is evaluated, and also if its evaluation is read from the store,
        the comparison that belongs to it is made.

        It is due every `COMPARISON_INTERVAL` evaluations of the search if base colors
        are searched, since the stored light was reflected by earlier colors. Otherwise
        the interval doubles as long as predictions are accurate. After one inaccurate
        comparison the light is computed again for the current colors, if colors are
        searched. After two in a row, all further images are traced.

        Args:
            query: the query that is evaluated next.
        """
        if not self._is_comparison_due(query):
            return
        # the comparison before, whose deviation is the latest so far
        was_accurate = self.deviations[-1].is_accepted
        is_accurate = self._compare(query.u, query.row_index).is_accepted
        interval = COMPARISON_INTERVAL
        if is_accurate and not self._searches_colors:
            # doubles: the next comparison is at twice the index of this one
            interval = query.row_index
        self._next_comparison = query.row_index + interval
        if is_accurate:
            return
        # Without searched colors, nothing is done after a first failure.
        if not was_accurate:
            self.stop_predicting("search", query.row_index)
        elif self._searches_colors:
            self._renew_light(query.u)

    def _is_comparison_due(self, query: prediction.Query) -> bool:
        """Return whether predictions have to be compared before a query.

        Other kinds than "search", such as "baseline", and the ranking take the
        predictor as the search has left it.
        """
        is_of_search = query.kind == "search" and query.phase == "search"
        predictions_failed = self.tracing_reason is not None
        next_comparison = self._next_comparison or COMPARISON_INTERVAL
        is_due = query.row_index >= next_comparison
        return is_of_search and not predictions_failed and is_due

    def _renew_light(self, u: Tensor) -> None:
        """Compute the light again for the base colors of u (d,)."""
        with self.measure_seconds():
            full_u = self.problem.make_full_configuration(u)
            self.renderer.update_base_color(full_u)
        assert self.n_renewals is not None  # None only for a `Bank`
        self.n_renewals += 1

    def _compare(self, u: Tensor, index: int) -> prediction.Deviation:
        """Compare predicted images with traced ones, and store the deviation.

        The first view is that of u. In the other views, searched cameras and
        environments are random, since the search may go anywhere. All views have new
        conditions.

        Args:
            u: (d,) the searched coordinates.
            index: index of the evaluation, for the seed.
        """
        problem = self.problem
        kind = "surface check"
        seed = seeds.derive_seed(problem.seed, kind, index)
        with self.measure_seconds():
            configurations = self._sample_compared_configurations(u, seed)
            conditions = self._choose_conditions(kind, index, prediction.N_VIEWS)
            full_configurations = [
                torch.cat([view_u, condition])
                for view_u, condition in zip(configurations, conditions, strict=True)
            ]
        compare_view = partial(self._compare_surface_view, full_configurations, seed)
        return self.compare(compare_view)

    def _sample_compared_configurations(self, u: Tensor, seed: int) -> Tensor:
        """Return the searched coordinates (N_VIEWS, d) of the views of a comparison."""
        generator = torch.Generator().manual_seed(seed)
        random_configurations = self.problem.domain.sample(
            generator, prediction.N_VIEWS
        )
        # random in the moving coordinates, else u
        configurations = torch.where(self._is_moving, random_configurations, u)
        configurations[0] = u  # the first view is that of u itself
        return configurations

    def _compare_surface_view(
        self, full_configurations: Sequence[Tensor], seed: int, number: int
    ) -> prediction.ComparedView:
        """Compare the predicted image of a view, by its number, with traced ones."""
        # The allowed error of the margin grows with the change that the search has made
        # (`Problem.compare_view`). Random coordinates are no such change. If no colors
        # are searched, all coordinates move something, and count as random.
        is_random = self._is_moving
        if not self._searches_colors:
            is_random = torch.ones_like(self._is_moving)
        return self.problem.compare_view(
            self.renderer,
            full_configurations[number],
            seeds.derive_seed(seed, "view", number),
            self.problem.search_spp,
            is_random=is_random,
        )
