"""The problem of a search: scene, space, model, task and objective in one.

A `Problem` evaluates the queries of `attacks`. u (d,) are the coordinates of the
controls that are searched. Other controls may vary by chance, such as the weather:
these are the *conditions*. A *full configuration* consists of u, followed by the
coordinates of the conditions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Domain, Evaluation, Objective
from advsearch.attacks.evaluation import Query, WhichGradient
from advsearch.attacks.verification import (
    EASIER,
    OVER_CONDITIONS,
    WORST_CASE,
    VerificationRule,
)
from advsearch.controls import Control, Space
from advsearch.engine.acceptance import ComparedView, compare_with_traced
from advsearch.engine.judging import (
    ConfigurationInputs,
    DescribeConfiguration,
    Metrics,
    RenderSurfaces,
    add_visible_things,
    judge_images,
    make_domain,
    mean_metrics,
)
from advsearch.engine.rendering import find_visible_things, list_camera_renders
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.options import Value
from advsearch.runs.results import GroupDerivative, PlannedGradient
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.description import NO_ENVIRONMENT
from advsearch.scene.gradients import GradientPlan, Group
from advsearch.scene.mitsuba_backend.shared_paths import SharedPaths
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.lights import find_refusal
from advsearch.scene.transport.matrix import (
    LinearizedScene,
    LinearRenderer,
    find_linear_inputs,
)
from advsearch.tasks import Facts, Judgement, Mark, Task
from advsearch.tasks.base import Output, Truth, mean, most_frequent_judgement


class Preparation(NamedTuple):
    """Values that are measured before a search, and sent to workers with its queries.

    Attributes:
        spp: samples per pixel.
        search_depth: segments of the longest light path; None for that of the scene.
        gradient_plan: how derivatives are computed.
    """

    spp: int
    search_depth: int | None
    gradient_plan: GradientPlan


LIGHT_DEPTH = 4
"""Segments of the longest light path that is collected under each of many conditions.
A search learns more from many conditions with some noise and without longer paths than
from few that are exact.
"""

MAX_CACHED_COORDINATES = 64
"""The truth of a configuration is cached if it has at most this many coordinates
besides base colors.
"""

MAX_CACHED_TRUTHS = 512
"""Largest number of truths that are cached."""


def _add_to_cache(cached: dict[bytes, Any], key: bytes, value: Any) -> None:
    """Add a value to a cache, and remove its oldest values if it is full.

    A cache has at most `MAX_CACHED_TRUTHS` values. A dict keeps the order in which keys
    were added.
    """
    while len(cached) >= MAX_CACHED_TRUTHS:
        del cached[next(iter(cached))]
    cached[key] = value


# why nothing is computed for the conditions; a plan has it as the reason of a group
VARIES_BY_CHANCE = "forced: it varies by chance, so nobody asks for its derivative"


def _split_batch(outputs: Output, count: int) -> list[Output]:
    """Return the model's output of each of `count` images, as batches of one image."""
    return [outputs[index : index + 1] for index in range(count)]


@dataclass
class Problem:
    """Evaluates configurations of a scene by renderer, model, task and objective.

    Attributes:
        renderer: `render(u, seed, spp)` of full configurations.
        space: all controls: those that are searched, then those that vary by chance.
        model: predicts what an image shows.
        task: evaluates the model's output, and defines success.
        make_facts: returns the facts from which the task derives the ground truth. Its
            arguments are functions that describe and render a configuration.
        objective: the function that a search maximizes; None for a sweep, which only
            evaluates images.
        search_spp: samples per pixel of a search.
        seed: root seed.
        n_searched: number of controls that are searched; None for all. The others are
            the conditions: every image has new ones from their full range.
        steps: number of renders of a search.
        conditions_per_evaluation: number of conditions of an evaluation, whose
            objective is the mean over them; 1 without conditions.
        search_depth: segments of the longest light path in a search; None for that of
            the scene.
        aovs: names of the layers of ground truth that are stored for the clean and the
            adversarial scene (`formation.AOVS`).
        metrics: user functions whose values are stored with every image.
        shared_paths: traces the light paths that trials of one seed share only once;
            None if each trial is traced in full.
        domain: the domain of the searched controls.
        conditions: the domain of the conditions; None if there are none.
    """

    renderer: Renderer
    space: Space
    model: Model
    task: Task
    make_facts: Callable[[DescribeConfiguration, RenderSurfaces], Facts]
    objective: Objective | None
    search_spp: int
    seed: int
    n_searched: int | None = None
    steps: int = 0
    conditions_per_evaluation: int = 1
    search_depth: int | None = None
    aovs: tuple[str, ...] = ()
    metrics: Metrics = field(default_factory=dict)
    shared_paths: SharedPaths | None = None
    domain: Domain = field(init=False)
    conditions: Domain | None = field(init=False)

    def __post_init__(self) -> None:
        self.gradient_plan = self.renderer.plan
        self._truths: dict[bytes, Truth] = {}
        self._things: dict[bytes, JsonObject | None] = {}

    @property
    def gradient_plan(self) -> GradientPlan:
        """How derivatives are computed."""
        return self.renderer.plan

    @gradient_plan.setter
    def gradient_plan(self, plan: GradientPlan) -> None:
        """Set the plan of the gradient.

        Groups of conditions are forced to the estimator "none", as their derivatives
        are never requested. `domain` and `conditions` are created again, since the
        domain states the cost of a gradient, which depends on the plan.
        """
        searched, conditions = self._split_controls()
        condition_names = {control.name for control in conditions}
        estimator_by_group = {
            group.name: "none"
            for group in plan.groups
            if group.control in condition_names
        }
        self.renderer.plan = plan.force_estimators(
            estimator_by_group, reason=VARIES_BY_CHANCE
        )
        self.domain = make_domain(
            searched, gradient_cost=self.renderer.plan.renders, partial_gradients=True
        )
        self.conditions = make_domain(conditions) if conditions else None

    def _split_controls(self) -> tuple[tuple[Control, ...], tuple[Control, ...]]:
        """Return the controls that are searched, and those that vary by chance."""
        controls = self.space.controls
        n_searched = self.n_searched
        if n_searched is None:  # all are searched
            n_searched = len(controls)
        return controls[:n_searched], controls[n_searched:]

    @property
    def preparation(self) -> Preparation:
        """What another process needs to evaluate the same problem."""
        return Preparation(self.search_spp, self.search_depth, self.gradient_plan)

    @cached_property
    def searched_space(self) -> Space:
        """The space of the searched controls alone."""
        return replace(self.space, controls=self.space.controls[: self.n_searched])

    @property
    def environment(self) -> str:
        """The name of the environment under which the scene is rendered."""
        if self.space.environment_name:
            return self.space.environment_name
        scene = self.space.scene
        return NO_ENVIRONMENT if scene is None else scene.environment_name

    @property
    def is_linear(self) -> bool:
        """Whether matrices of light transport predict the images of this problem."""
        conditions = self.space.controls[self.n_searched :]
        condition_names = [control.name for control in conditions]
        return find_refusal(self.renderer, condition_names) is None

    @property
    def verification_rule(self) -> VerificationRule:
        """The rule by which trials verify a success."""
        if self.task.minimise:
            return EASIER
        return WORST_CASE if self.conditions is None else OVER_CONDITIONS

    # ---- pictures

    def make_full_configuration(
        self, u: Tensor, draw_seed: int | None = None
    ) -> Tensor:
        """Return the full configuration: u (d,), followed by conditions.

        Conditions are the coordinates of the controls that vary by chance, such as the
        light. With a `draw_seed` they are sampled from their full range. Without one
        they have the values that leave the scene unchanged.
        """
        if self.conditions is None:
            return u
        if draw_seed is None:
            return torch.cat([u, self.conditions.start])
        # The noise has the same seed. Another stream makes the conditions independent
        # of it.
        generator = torch.Generator().manual_seed(
            seeds.derive_seed(draw_seed, "conditions")
        )
        # `sample` returns a batch (1, d) of one configuration
        return torch.cat([u, self.conditions.sample(generator)[0]])

    def picture(
        self, u: Tensor, seed: int, spp: int, *, with_conditions: bool = True
    ) -> Tensor:
        """Render a configuration as a file would hold it.

        Args:
            u: (d,) the configuration.
            seed: seed of the noise, and of the conditions if these are sampled.
            spp: samples per pixel.
            with_conditions: whether conditions are sampled; else they leave the scene
                unchanged.

        Returns:
            (H, W, 3) sRGB in [0, 1], rounded to 8 bits.
        """
        full_u = self.make_full_configuration(u, seed if with_conditions else None)
        # Light paths that are the same in all trials of this seed are traced once.
        with torch.no_grad(), self.renderer.share_paths(self.shared_paths):
            return round_to_8_bit(self.renderer(full_u, seed=seed, spp=spp))

    def judge(self, image: Tensor, full_u: Tensor) -> Judgement:
        """Judge whether the model is right on an image, and by which margin.

        Args:
            image: (H, W, 3) sRGB in [0, 1].
            full_u: full configuration of the image: searched coordinates, followed by
                the conditions. It determines what is true of the image.

        Returns:
            The judgement. It has the value of the objective, if there is one.
        """
        if self.objective is None:
            # Without an objective, `judge_images` does all that is needed. `{}`: no
            # stated values in place of the configuration's.
            return self.judge_images(image[None], [full_u], [{}])[0]
        with torch.no_grad():
            output = self.model(image)
            truth = self.find_truth(full_u)
            values = self.objective(
                output, image[None], truth, self.make_objective_inputs(full_u)
            )
            # the batch has one image
            (judgement,) = self._judge_outputs(output, image[None], [truth], [full_u])
            return replace(judgement, objective=float(values[0]))

    def judge_images(
        self,
        images: Tensor,
        full_configurations: Sequence[Tensor],
        stated_values: Sequence[Mapping[str, Value]],
    ) -> list[Judgement]:
        """Judge images that the model gets in one batch.

        The judgements have no value of the objective. If a margin is infinite or NaN,
        the judgement is that of a model that returned NaN.

        Args:
            images: (N, H, W, 3) sRGB in [0, 1].
            full_configurations: N full configurations, one for each image.
            stated_values: N mappings from parameters such as "camera.azimuth" to exact
                values, which replace the single-precision ones of the configurations.
        """
        with torch.no_grad():
            output = self.model(images)
            truths = self._find_truth_of_each(full_configurations, stated_values)
            judged = self._judge_outputs(output, images, truths, full_configurations)
        return [_without_objective(judgement) for judgement in judged]

    def _find_truth_of_each(
        self,
        full_configurations: Sequence[Tensor],
        stated_values: Sequence[Mapping[str, Value]],
    ) -> list[Truth]:
        """Return the truth of each configuration, or one that holds for all of them."""
        if not self.task.varies:
            return [self.find_truth()]
        return [
            self.find_truth(full_u, values)
            for full_u, values in zip(full_configurations, stated_values, strict=True)
        ]

    def _judge_outputs(
        self,
        output: Output,
        pictures: Tensor,
        truths: Sequence[Truth],
        full_configurations: Sequence[Tensor],
    ) -> list[Judgement]:
        """Judge a model's output by the task and the user's metrics.

        If the scene has other things than the object, such as a car next to it, the
        payload of each judgement gets the visible part of each thing. It is rendered
        and cached once for all configurations that differ only in colors, since colors
        hide nothing.

        Args:
            output: the model's output for all N images.
            pictures: (N, H, W, 3) sRGB in [0, 1].
            truths: N truths, or one that holds for all images.
            full_configurations: N full configurations (d,), one for each image.
        """
        judged = list(judge_images(self.task, output, pictures, truths, self.metrics))
        has_other_things = self.space.scene is not None and self.space.scene.things
        if not has_other_things:
            return judged
        for index, full_u in enumerate(full_configurations):
            things = self._find_cached_things(full_u)
            judged[index] = add_visible_things(judged[index], things)
        return judged

    def _find_cached_things(self, full_u: Tensor) -> JsonObject | None:
        """Return what a full configuration shows of each thing, rendered only once."""
        # coordinates that may change what is visible
        key = full_u.detach()[self._changes_more_than_colors].numpy().tobytes()
        if key not in self._things:
            things = find_visible_things(self.renderer, full_u)
            _add_to_cache(self._things, key, things)
        return self._things[key]

    def compare_view(
        self,
        predict: Callable[[Tensor], Tensor],
        full_u: Tensor,
        seed: int,
        spp: int,
        *,
        is_random: Tensor | None = None,
        renderer: Renderer | None = None,
    ) -> ComparedView:
        """Compare a predicted image with traced images of the same configuration.

        The start of the search is predicted as well. So the comparison can tell the
        error of the prediction from the change that the search makes.

        Args:
            predict: function from a full configuration to an image (H, W, 3).
            full_u: the full configuration: searched coordinates, then conditions.
            seed: seed of the noise of the traced images.
            spp: samples per pixel of a rendered image.
            is_random: (d,) bool, which searched coordinates of `full_u` were set to
                random values for this comparison, to test predictions wherever the
                search may go. They are no change by the search.
            renderer: traces the images; None for that of the problem.
        """
        with torch.no_grad():
            predicted = predict(full_u)
            start = self._make_compared_start(full_u, is_random)
            is_start = torch.equal(start, full_u)
            predicted_start = None if is_start else predict(start)

        return compare_with_traced(
            renderer or self.renderer,
            predicted,
            full_u,
            seed,
            spp,
            self._measure_image_margin,
            predicted_start,
        )

    def _measure_image_margin(self, image: Tensor, u: Tensor) -> float:
        """Return the model's margin on an image of a full configuration u (d,)."""
        return self.judge(image, u).margin

    def _make_compared_start(self, full_u: Tensor, is_random: Tensor | None) -> Tensor:
        """Return the start of the search (d,) under the conditions of a configuration.

        Random coordinates have the same values in both, so that only the change by the
        search is a difference.
        """
        dim = self.domain.dim
        start = torch.cat([self.domain.start, full_u[dim:]])
        if is_random is not None:
            start[:dim][is_random] = full_u[:dim][is_random]
        return start

    def find_marks(self, image: Tensor, full_u: Tensor) -> list[Mark]:
        """Return the boxes and masks of prediction and truth on an image (H, W, 3)."""
        return self.predict_with_marks(image, full_u)[1]

    def predict_with_marks(
        self, image: Tensor, full_u: Tensor
    ) -> tuple[bool, list[Mark]]:
        """Return whether the model is right on an image, and what to draw into it.

        Args:
            image: (H, W, 3) sRGB in [0, 1].
            full_u: full configuration of the image, by which its truth is found.

        Returns:
            Whether the prediction is right; and the marks, which are boxes and masks of
            the prediction and of the truth.
        """
        with torch.no_grad():
            output = self.model(image)
            truth = self.find_truth(full_u)
            # the task answers for a batch, which has one image here
            is_right = self.task.judge(output, truth)[0].right
            return is_right, self.task.marks(output, truth)[0]

    def find_truth(
        self,
        full_u: Tensor | None = None,
        stated_values: Mapping[str, Value] | None = None,
    ) -> Truth:
        """Return what is true of the scene at a full configuration, such as a distance.

        Args:
            full_u: the full configuration; None for the start of the search.
            stated_values: exact values by parameter ("camera.azimuth"). They replace
                those of the configuration, which has single precision only.
        """
        if full_u is None or not self.task.varies:
            return self._start_truth
        # A truth may depend on what the camera sees, which base colors do not change.
        # So it is cached by the other coordinates, if these are few.
        geometric_u = full_u.detach()[self._changes_more_than_colors]
        key = geometric_u.numpy().tobytes()
        if not stated_values and key in self._truths:
            return self._truths[key]
        facts = self._make_facts_of_cameras(full_u, stated_values or {})
        truth = self.task.truth(facts)
        is_short = len(geometric_u) <= MAX_CACHED_COORDINATES
        if not stated_values and is_short and not _has_read_numbers(facts):
            _add_to_cache(self._truths, key, truth)
        return truth

    def _make_facts_of_cameras(
        self, full_u: Tensor, stated_values: Mapping[str, Value]
    ) -> Facts:
        """Return the facts of the main camera, with those of a rig's cameras.

        Args:
            full_u: the full configuration.
            stated_values: exact values, which replace those of the configuration.
        """
        describe = partial(self._describe_with_stated, full_u, stated_values)
        n_rig_cameras = 0 if self.space.scene is None else len(self.space.scene.rig)
        # one function for the main camera, then one for each camera of a rig
        renders = list_camera_renders(self.renderer, full_u, n_rig_cameras)
        facts, *camera_facts = [
            self.make_facts(describe, render_surfaces) for render_surfaces in renders
        ]
        return replace(facts, facts_of_views=tuple(camera_facts))

    def _describe_with_stated(
        self, full_u: Tensor, stated_values: Mapping[str, Value]
    ) -> dict[str, Value]:
        """Return the values of all parameters, with the stated ones."""
        values = self.space.describe(full_u)
        return {name: stated_values.get(name, value) for name, value in values.items()}

    @cached_property
    def _start_truth(self) -> Truth:
        """What is true at the start, and always if the task's truth does not vary."""
        start = self.make_full_configuration(self.domain.start)
        if self.task.varies:
            # `find_truth` only reads this property for a truth that does not vary, or
            # without a configuration.
            return self.find_truth(start)
        # Both are functions, which are only called if the task needs their result.
        facts = self.make_facts(
            lambda: self.space.describe(start),
            lambda: self.renderer.find_surfaces(start),
        )
        return self.task.truth(facts)

    @cached_property
    def _changes_more_than_colors(self) -> Tensor:
        """Whether each coordinate changes more than the colors of surfaces, (d,) bool.

        Coordinates that change the finished image, such as a blur, count as well.
        """
        # names of the inputs in which an image is linear, which are base colors
        color_inputs = find_linear_inputs(self.renderer)
        changes_more = torch.ones(len(self.space.start), dtype=torch.bool)
        for group in self.space.groups:
            # Names of the scene inputs that the group changes; None for a group that
            # only changes the finished image.
            changed_inputs = self.renderer.inputs_by_group.get(group.name)
            if changed_inputs:
                only_colors = changed_inputs <= color_inputs  # a subset
                changes_more[group.coordinates] = not only_colors
        return changes_more

    def make_objective_inputs(
        self, *full_configurations: Tensor
    ) -> ConfigurationInputs:
        """Return the inputs that an objective may read at full configurations."""
        return ConfigurationInputs(self.space, self.searched_space, full_configurations)

    def describe(self, u: Tensor, draw_seed: int | None = None) -> dict[str, Value]:
        """Describe the searched controls of a configuration in values with units.

        Args:
            u: (d,) the searched coordinates.
            draw_seed: seed of the conditions, on which values may depend. Without one
                the conditions leave the scene unchanged.
        """
        return self.space.describe(
            self.make_full_configuration(u, draw_seed),
            self.space.controls[: self.n_searched],
        )

    def summarize_plan(self, plan: GradientPlan) -> PlannedGradient:
        """Return what a result stores of a plan, each step in its parameter's unit."""
        groups = []
        # the other fields of `GroupDerivative`, for each group
        group_fields = plan.to_dict()["groups"]
        for group, fields in zip(plan.groups, group_fields, strict=True):
            step, unit = self._compute_step_in_unit(group)
            groups.append(GroupDerivative(**fields, step_in_unit=step, unit=unit))
        return PlannedGradient(
            renders_per_gradient=plan.renders, spp=plan.spp, groups=groups
        )

    def _compute_step_in_unit(self, group: Group) -> tuple[float | None, str]:
        """Return a group's step of finite differences in its parameter's unit, such as
        degrees, and the unit.

        It is half the difference between the values one step above and one step below
        the center of the range. The result is (None, "") if the group has several
        coordinates, has no step, or has a value that is no number.
        """
        # A group with finite differences has a step, and a reason for its size.
        has_step = bool(group.step_reason)
        if not has_step or group.size != 1:
            return None, ""
        u = self.make_full_configuration(self.domain.start).clone()
        step = min(group.step, 0.5)  # from the center, it stays within the range
        lower = self._describe_shifted(u, group, 0.5 - step)
        upper = self._describe_shifted(u, group, 0.5 + step)
        if lower is None or upper is None:
            return None, ""
        if not isinstance(lower["value"], (int, float)):
            return None, ""
        difference = float(upper["value"]) - float(lower["value"])
        return abs(difference) / 2.0, lower["unit"]

    def _describe_shifted(
        self, u: Tensor, group: Group, coordinate: float
    ) -> Value | None:
        """Return the value of a group, {"value": 30.0, "unit": ...}, at a coordinate.

        The coordinate is set in u (d,). None if the group describes no value.
        """
        u[group.coordinates] = coordinate
        return self.space.describe(u).get(group.name)

    def describe_conditions(self, u: Tensor, draw_seed: int) -> dict[str, Value]:
        """Describe the conditions of a draw in values with units.

        The result is empty if there are no conditions.
        """
        if self.conditions is None:
            return {}
        return self.space.describe(
            self.make_full_configuration(u, draw_seed),
            self.space.controls[self.n_searched :],
        )

    # ---- evaluations

    def evaluate_all(
        self, queries: Sequence[Query], preparation: Preparation | None = None
    ) -> Iterator[Evaluation]:
        """Evaluate queries lazily, in their order.

        Args:
            queries: the queries.
            preparation: gradient plan, samples per pixel and depth of light paths that
                another process measured for the same problem. They are set first, so
                that both processes compute the same.
        """
        if preparation is not None:
            self.search_spp = preparation.spp
            self.search_depth = preparation.search_depth
            # setting an equal plan would only cost time
            if self.gradient_plan != preparation.gradient_plan:
                self.gradient_plan = preparation.gradient_plan
        return map(self.evaluate, queries)

    def evaluate(self, query: Query) -> Evaluation:
        """Evaluate one query: collect light, render an image, or judge one.

        This is the only place where a run renders, predicts and judges. There are four
        kinds of queries: for light for a predictor, for an image, for a trial of the
        verification (it has no phase), and for an evaluation of the search.
        """
        non_finite_before = self.renderer.n_non_finite
        if query.requested_output == "light":
            evaluation = self._collect_light(query)
        elif query.requested_output == "picture":
            evaluation = self._render_picture(query)
        elif query.phase is None:
            evaluation = self._evaluate_trial(query)
        elif self.conditions is None:
            evaluation, _ = self.evaluate_full(query, query.u, query.seed)
        else:
            evaluation = self._evaluate_over_conditions(query)
        # The count of the renderer is over all renders of the query, those of light and
        # of images included. It replaces the count of the evaluation.
        n_non_finite = self.renderer.n_non_finite - non_finite_before
        if n_non_finite:
            return replace(evaluation, n_non_finite=n_non_finite)
        return evaluation

    def _collect_light(self, query: Query) -> Evaluation:
        """Evaluate a query for light, which has no objective."""
        linear = self.make_linear_renderer(query.u, query.seed, query.spp)
        return Evaluation(
            math.nan, gradient=None, success=False, collected_light=linear.collected
        )

    def _render_picture(self, query: Query) -> Evaluation:
        """Evaluate a query for an image, which has no objective."""
        image = self.picture(query.u, query.seed, query.spp)
        return Evaluation(math.nan, gradient=None, success=False, picture=image)

    def _evaluate_trial(self, query: Query) -> Evaluation:
        """Evaluate a trial of the verification: render an image anew and judge it.

        The image has 8 bits, as a file would store it. Its conditions are sampled if
        the query requests that.
        """
        image = self.picture(
            query.u, query.seed, query.spp, with_conditions=query.draws_conditions
        )
        full_u = self.make_full_configuration(
            query.u, query.seed if query.draws_conditions else None
        )
        judgement = self.judge(image, full_u)
        return Evaluation.from_judgement(
            judgement, picture=image if query.includes_image else None
        )

    def _evaluate_over_conditions(self, query: Query) -> Evaluation:
        """Evaluate a query of a search by its mean over sampled conditions.

        Each of the `conditions_per_evaluation` conditions is rendered once. The noise
        of its image has the same seed as the condition. If the query requests an image,
        it is rendered under conditions that leave the scene unchanged, as no sampled
        one represents all of them.
        """
        query_without_image = replace(query, includes_image=False)
        evaluated = []
        for index in range(self.conditions_per_evaluation):
            seed = seeds.derive_seed(query.seed, "draw", index)
            full_u = self.make_full_configuration(query.u, seed)
            evaluated.append(self.evaluate_full(query_without_image, full_u, seed))
        evaluation = self.average_evaluations(evaluated, query.u)
        if not query.includes_image:
            return evaluation
        image = self.picture(
            query.u, query.seed, self.search_spp, with_conditions=False
        )
        return replace(evaluation, picture=image)

    def _compute_objective(
        self,
        outputs: Output,
        pictures: Tensor,
        truth: Truth,
        inputs: ConfigurationInputs,
    ) -> Tensor:
        """Return the objective (N,) of images, with a graph for its derivative.

        Args:
            outputs: the model's output for all N images.
            pictures: (N, H, W, 3) sRGB in [0, 1].
            truth: what is true of all images.
            inputs: what the objective may read of the configurations, such as "u".
        """
        if self.objective is None:  # only a sweep has none
            raise RuntimeError("a sweep has no objective")
        return self.objective(outputs, pictures, truth, inputs)

    def make_linear_renderer(
        self,
        full_u: Tensor,
        seed: int,
        spp: int,
        collected_light: LinearizedScene | None = None,
    ) -> LinearRenderer:
        """Return a renderer that predicts images near a full configuration.

        It collects the light of the scene once. Images are linear in that light, so
        that other colors and intensities need no further rays.

        Args:
            full_u: the full configuration: searched coordinates, then conditions.
            seed: seed of the noise.
            spp: samples per pixel.
            collected_light: light that an earlier call collected at `full_u`; None to
                collect it now.
        """
        # images are only linear in some of them
        input_names = self._searched_inputs & find_linear_inputs(self.renderer)
        # Light paths are no longer than those of a search.
        depth = LIGHT_DEPTH
        if self.search_depth is not None:
            depth = min(LIGHT_DEPTH, self.search_depth)
        with self.renderer.scene.limit_depth(depth):
            return LinearRenderer(
                self.renderer,
                full_u,
                seed,
                spp=spp,
                # less exact and smaller, as one is made for each of many conditions
                quick=True,
                names=input_names,
                collected=collected_light,
            )

    @property
    def _searched_inputs(self) -> frozenset[str]:
        """Scene inputs that the search changes, such as "object.base_color"."""
        searched_names = {control.name for control in self.searched_space.controls}
        searched_inputs: frozenset[str] = frozenset()
        for group in self.gradient_plan.groups:
            if group.control in searched_names:
                searched_inputs |= self.renderer.inputs_by_group.get(
                    group.name, frozenset()
                )
        return searched_inputs

    def evaluate_full(
        self, query: Query, full_u: Tensor, seed: int, renderer: Renderer | None = None
    ) -> tuple[Evaluation, Output]:
        """Evaluate a query of a search by one image of a full configuration.

        The gradient has two parts. One goes through the image and is estimated by the
        renderer. The other exists only if the objective reads the configuration itself,
        for example a texture that should be smooth.

        Args:
            query: the query, which states whether a gradient is requested.
            full_u: the full configuration: searched coordinates, then conditions.
            seed: seed of the noise.
            renderer: renderer of the image, such as a predictor; None for that of the
                problem.

        Returns:
            The evaluation and the model's output.
        """
        renderer = self.renderer if renderer is None else renderer
        non_finite_before = renderer.n_non_finite
        renders_before = renderer.n_renders  # without regard to their samples
        truth = self.find_truth(full_u)
        variable_u = full_u.detach().clone().requires_grad_(bool(query.gradient))
        loss = _RecordingLoss(self, truth, variable_u)
        value, gradient = self._compute_value_and_gradient(
            renderer, loss, full_u, query, seed
        )
        image, output = loss.calls[0]  # at u itself
        (judgement,) = self._judge_outputs(output, image[None], [truth], [full_u])
        evaluation = Evaluation(
            objective=float(value),
            gradient=gradient,
            success=judgement.success,
            n_non_finite=renderer.n_non_finite - non_finite_before,
            # Each render counts `samples` times. There is at least 1, since a renderer
            # that predicts counts none.
            cost=max(1, renderer.n_renders - renders_before) * query.samples,
            judgement=judgement,
            picture=round_to_8_bit(image) if query.includes_image else None,
        )
        return evaluation, output

    def _compute_value_and_gradient(
        self,
        renderer: Renderer,
        loss: _RecordingLoss,
        full_u: Tensor,
        query: Query,
        seed: int,
    ) -> tuple[Tensor, Tensor | None]:
        """Return the objective at a full configuration (d,), and its gradient (d,).

        The gradient is None if the query requests none.
        """
        spp = self.search_spp * query.samples
        with self._limit_search_depth(renderer):
            if not query.gradient:
                with torch.no_grad():
                    return loss(renderer(full_u, seed=seed, spp=spp)), None
            # a "free" gradient leaves out derivatives that cost renders
            value, gradient = renderer.gradient(
                loss, full_u, seed, spp, free=query.gradient == "free"
            )
        if loss.inputs.used:
            gradient = gradient + loss.input_gradient
        return value, gradient

    def _limit_search_depth(self, renderer: Renderer) -> AbstractContextManager[None]:
        """Return a context in which light paths are as short as those of a search.

        Without a `search_depth` the context changes nothing.
        """
        if self.search_depth is None:
            return nullcontext()
        return renderer.scene.limit_depth(self.search_depth)

    def evaluate_batch(
        self,
        render: Callable[[Tensor], Tensor],
        full_configurations: Sequence[Tensor],
        u: Tensor,
        gradient: WhichGradient,
    ) -> tuple[list[tuple[Evaluation, Output]], Tensor | None]:
        """Evaluate images of one u under N conditions in one batch of the model.

        Args:
            render: function from u (d,) to images (N, H, W, 3), with a graph.
            full_configurations: N full configurations, which differ in conditions only.
            u: (d,) the searched coordinates, equal in all of them.
            gradient: which derivative is requested. "free" counts as all of it, as
                predicted images are differentiated at no cost.

        Returns:
            First, for each image, an evaluation without derivative and the model's
            output. Second, the derivative (d,) by u of a weighted sum of the objectives
            (`compute_condition_weights`); None if no gradient is requested.
        """
        needs_gradient = bool(gradient)
        variable_u = u.detach().clone().requires_grad_(needs_gradient)
        with torch.set_grad_enabled(needs_gradient):
            images = render(variable_u)
            outputs = self.model(images)
            outputs_of_images = _split_batch(outputs, len(full_configurations))
            truths = [self.find_truth(full_u) for full_u in full_configurations]
            values = self._compute_objectives_of_batch(
                outputs,
                images,
                truths,
                _insert_searched_coordinates(full_configurations, variable_u),
            )
            derivative = None
            if needs_gradient:
                derivative = _differentiate_weighted_sum(values, variable_u)
        judgements = self._judge_outputs(outputs, images, truths, full_configurations)
        evaluations = [
            Evaluation(float(value), None, judgement.success, judgement=judgement)
            for value, judgement in zip(values.detach(), judgements, strict=True)
        ]
        return list(zip(evaluations, outputs_of_images, strict=True)), derivative

    def _compute_objectives_of_batch(
        self,
        outputs: Output,
        images: Tensor,
        truths: Sequence[Truth],
        full_configurations: Sequence[Tensor],
    ) -> Tensor:
        """Return the objectives (N,) of a batch of images, with a graph.

        Args:
            outputs: the model's output for all N images.
            images: (N, H, W, 3) sRGB in [0, 1].
            truths: what is true of each image; all are equal if the truth of the task
                does not vary.
            full_configurations: N full configurations, which an objective may read.
        """
        if self.task.varies:
            outputs_of_images = _split_batch(outputs, len(truths))
            return self._compute_objective_of_each(
                outputs_of_images, images, truths, full_configurations
            )
        inputs = self.make_objective_inputs(*full_configurations)
        return self._compute_objective(outputs, images, truths[0], inputs)

    def _compute_objective_of_each(
        self,
        outputs: Sequence[Output],
        images: Tensor,
        truths: Sequence[Any],
        full_configurations: Sequence[Tensor],
    ) -> Tensor:
        """Return the objectives (N,) of images of which each has its own truth.

        An objective takes a single truth, so that it is called once for each image.

        Args:
            outputs: N outputs of the model, each for a batch of one image.
            images: (N, H, W, 3) sRGB in [0, 1].
            truths: N truths.
            full_configurations: N full configurations (d,).
        """
        objectives = []
        for output, image, truth, full_u in zip(
            outputs, images.split(1), truths, full_configurations, strict=True
        ):
            inputs = self.make_objective_inputs(full_u)
            objectives.append(self._compute_objective(output, image, truth, inputs))
        return torch.cat(objectives)

    def evaluate_conditions(
        self,
        render: Callable[[slice, Tensor], Tensor],
        full_configurations: Sequence[Tensor],
        u: Tensor,
        gradient: WhichGradient,
        batch_size: int,
    ) -> Evaluation:
        """Evaluate u by its mean over conditions whose images are predicted.

        Args:
            render: function from a slice of the conditions and u (d,) to their images
                (N, H, W, 3), with a graph.
            full_configurations: full configuration of each condition.
            u: (d,) the searched coordinates.
            gradient: which derivative is requested. "free" counts as all of it.
            batch_size: images in a batch of the model.
        """
        evaluated = []
        derivatives = []
        for begin in range(0, len(full_configurations), batch_size):
            batch = slice(begin, begin + batch_size)
            # `derivative` is that of the sum over the batch
            batch_evaluated, derivative = self.evaluate_batch(
                partial(render, batch), full_configurations[batch], u, gradient
            )
            evaluated += batch_evaluated
            derivatives.append(derivative)
        mean_derivative = _divide_sum(derivatives, len(full_configurations))
        return self.average_evaluations(evaluated, u, mean_derivative)

    def average_evaluations(
        self,
        evaluated: Sequence[tuple[Evaluation, Output]],
        u: Tensor,
        gradient: Tensor | None = None,
    ) -> Evaluation:
        """Return the evaluation of u (d,) that is the mean over conditions.

        It is a success if enough of the evaluations are successes: the percentage is
        that of the rule `OVER_CONDITIONS`. The cost is the largest of the evaluations,
        and not their sum, because a cost of 1 means one image under every condition.

        Args:
            evaluated: an evaluation and the model's output for each condition.
            u: (d,) the searched coordinates.
            gradient: (d,) gradient of the mean. If the evaluations have gradients, it
                is ignored, and the mean of these is taken.
        """
        evaluations, outputs = zip(*evaluated, strict=True)
        mean_gradient = _average_gradients(evaluations, u.numel())
        if mean_gradient is not None:
            gradient = mean_gradient
        judged = _list_judgements(evaluations)
        judgement = self._average_judgements(judged, outputs)
        total_objective = sum(evaluation.objective for evaluation in evaluations)
        return Evaluation(
            objective=total_objective / len(evaluations),
            gradient=gradient,
            success=_is_success_over_conditions(evaluations),
            n_non_finite=sum(evaluation.n_non_finite for evaluation in evaluations),
            cost=max(evaluation.cost for evaluation in evaluations),
            judgement=replace(judgement, metrics=mean_metrics(judged)),
        )

    def _average_judgements(
        self, judged: Sequence[Judgement], outputs: Sequence[Output]
    ) -> Judgement:
        """Return the judgement over several conditions.

        If one truth holds under all conditions, the task judges the average of the
        outputs. If the truth varies with the conditions, no single truth fits that
        average: then scores and margins are averaged, and the most frequent prediction
        is taken.

        Args:
            judged: judgement under each condition.
            outputs: the model's output under each condition, for one image each.
        """
        if self.task.varies:
            most_frequent = most_frequent_judgement(judged)
            score = mean([judgement.score for judgement in judged])
            margin = mean([judgement.margin for judgement in judged])
            return Judgement.from_margin(
                score, margin, most_frequent.prediction, most_frequent.payload
            )
        with torch.no_grad():
            output = self.task.average(list(outputs))
            return self.task.judge(output, self.find_truth())[0]

    def compute_loss(self, image: Tensor) -> Tensor:
        """Return the objective of an image (H, W, 3) near the start, with a graph.

        Truth and inputs of the objective are those of the start.
        """
        inputs = self.make_objective_inputs(
            self.make_full_configuration(self.domain.start)
        )
        output = self.model(image)
        values = self._compute_objective(output, image[None], self.find_truth(), inputs)
        return values[0]


@dataclass(eq=False)
class _RecordingLoss:
    """The objective of an image, as a function that records its calls.

    The first call is at u itself; any later ones are at neighbors of u, for finite
    differences.

    Attributes:
        problem: the problem.
        truth: what is true of the scene at u.
        variable_u: (d,) the full configuration, with a graph if a gradient is requested.
        inputs: the inputs that the objective may read at u. `inputs.used` is set once it
            has read one.
        calls: image and output of each call.
        input_gradient: derivative of the objective by u that does not go through the
            image.
    """

    problem: Problem
    truth: Truth
    variable_u: Tensor
    inputs: ConfigurationInputs = field(init=False)
    calls: list[tuple[Tensor, Output]] = field(default_factory=list)
    input_gradient: Tensor = field(default_factory=lambda: torch.zeros(()))

    def __post_init__(self) -> None:
        self.inputs = self.problem.make_objective_inputs(self.variable_u)

    def __call__(self, image: Tensor) -> Tensor:
        """Return the objective of an image (H, W, 3), and record the call."""
        output = self.problem.model(image)
        self.calls.append((image.detach(), output))
        values = self.problem._compute_objective(
            output, image[None], self.truth, self.inputs
        )
        objective = values[0]
        if self.inputs.used and len(self.calls) == 1:  # the call at u itself
            self.input_gradient = _differentiate_by_inputs(objective, self.variable_u)
        return objective


def _without_objective(judgement: Judgement) -> Judgement:
    """Return a judgement without the value of the objective, its metrics included."""
    # `from_margin` checks that the margin is finite, and sets no objective. It takes no
    # metrics, so these are added.
    without_objective = Judgement.from_margin(
        judgement.score,
        judgement.margin,
        judgement.prediction,
        judgement.payload,
    )
    return replace(without_objective, metrics=judgement.metrics)


def _has_read_numbers(facts: Facts) -> bool:
    """Return whether a task has read values of the configuration, perhaps colors.

    `Facts.numbers` is a cached property, which `vars` contains once it was read.
    """
    return "numbers" in vars(facts)


def _insert_searched_coordinates(
    full_configurations: Sequence[Tensor], u: Tensor
) -> list[Tensor]:
    """Return full configurations with u (d,), and its graph, as searched coordinates.

    An objective may read the configuration itself, so that it needs the graph.
    """
    return [torch.cat([u, full_u[len(u) :]]) for full_u in full_configurations]


def _divide_sum(derivatives: Sequence[Tensor | None], count: int) -> Tensor | None:
    """Return the sum of derivatives (d,) divided by a count; None if all are None."""
    total_derivative = None
    for derivative in derivatives:
        if total_derivative is None:
            total_derivative = derivative
        elif derivative is not None:
            total_derivative = total_derivative + derivative
    return None if total_derivative is None else total_derivative / count


def _list_judgements(evaluations: Sequence[Evaluation]) -> list[Judgement]:
    """List the judgements of those evaluations that have one."""
    return [
        evaluation.judgement
        for evaluation in evaluations
        if evaluation.judgement is not None
    ]


def _is_success_over_conditions(evaluations: Sequence[Evaluation]) -> bool:
    """Return whether enough evaluations are successes, by the rule over conditions."""
    n_successes = sum(evaluation.success for evaluation in evaluations)
    n_needed = OVER_CONDITIONS.count_percent(len(evaluations))
    return n_successes >= n_needed


def _average_gradients(evaluations: Sequence[Evaluation], dim: int) -> Tensor | None:
    """Return the mean of the gradients (dim,) of evaluations; None if none has one."""
    # without the derivatives by the conditions, which come last
    gradients = [
        evaluation.gradient[:dim]
        for evaluation in evaluations
        if evaluation.gradient is not None
    ]
    return torch.stack(gradients).mean(dim=0) if gradients else None


def _differentiate_by_inputs(objective: Tensor, variable_u: Tensor) -> Tensor:
    """Return the part of an objective's derivative by u that bypasses the image.

    An objective may read the configuration itself, such as a texture that it wants to
    be smooth. That part of the derivative is exact; only the part that goes through the
    image is estimated, as the gradient plan states.

    Args:
        objective: the objective, without axes.
        variable_u: (d,) the coordinates, which require a gradient.

    Returns:
        The derivative (d,), or a zero without axes if there is no such part.
    """
    if objective.requires_grad:
        (gradient,) = torch.autograd.grad(
            objective, variable_u, retain_graph=True, allow_unused=True
        )
        if gradient is not None:
            return gradient
    return torch.zeros(())


def _differentiate_weighted_sum(values: Tensor, u: Tensor) -> Tensor:
    """Return the derivative (d,) by u of objectives (n,) of conditions, weighted.

    The weights are those of `compute_condition_weights`. Objectives without a graph do
    not depend on u: then the derivative is 0.
    """
    if not values.requires_grad:
        return torch.zeros_like(u, requires_grad=False)
    weighted_sum = (values * compute_condition_weights(values)).sum()
    (derivative,) = torch.autograd.grad(weighted_sum, u)
    return derivative


def compute_condition_weights(values: Tensor) -> Tensor:
    """Return the weights (n,) of conditions in a derivative, for their objectives (n,).

    They are proportional to exp(-z), where z is the objective divided by the standard
    deviation of all objectives. Their mean is 1. So the smaller the objective, the
    larger the weight. With equal weights a search would mostly raise the objective
    under conditions where that is easy, and the prediction is often wrong there
    already (Li et al. 2021, *Tilted Empirical Risk Minimization*, section 2, with a
    tilt of the opposite sign). All weights are 1 if the objectives are equal, or not
    finite.
    """
    objectives = values.detach()
    spread = objectives.new_zeros(())
    if len(objectives) > 1:
        spread = objectives.std()
    if not bool(torch.isfinite(spread)) or float(spread) == 0.0:
        return torch.ones_like(objectives)
    return len(objectives) * torch.softmax(-objectives / spread, dim=0)
