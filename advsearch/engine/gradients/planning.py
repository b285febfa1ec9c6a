"""Choose how gradients are computed, by measurements on the scene.

- Estimators: those with the least squared error x time.
- Steps (widths of finite differences) and sample counts: the cheapest whose gradients
  have a cosine similarity of `GOAL_COSINE` with the converged gradient of the model's
  own loss (docs/gradients.md).
- Bounces of light: as many as change the image. Paths of other lengths with one seed
  are the same, cut off earlier.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from advsearch import seeds
from advsearch.engine.gradients.bench import Bench, restrict_plan
from advsearch.engine.problem import Problem
from advsearch.runs.results import GradientStatus, Measured, PathCut, PathLength
from advsearch.scene.gradients import (
    ADJOINT_ESTIMATORS,
    DIFFERENCE_ESTIMATORS,
    GradientPlan,
    Group,
    select_compared,
)
from advsearch.scene.renderer import Renderer

# A *working* gradient has the sample count of a search. A *converged* one has many
# samples, and serves as the reference.

# cosine similarity with the converged gradient that a working gradient should have
GOAL_COSINE = 0.9
FACTORS = (1.0, 3.0, 9.0)
"""Widths of differences that are tried, as multiples of the planned width. The last one
is only tried if no other reaches the goal: it smooths away everything but the coarse
shape of the loss.
"""
SAMPLE_COUNTS = (8, 16, 32, 64, 128)
ADJOINT_RENDERS = 3.0  # an adjoint takes about as long as this many renders
CONVERGED_SPP = 128
CONVERGED_SPP_FACTOR = 4
"""Samples per pixel of a converged gradient. They are multiplied by the factor if such
gradients do not agree, or if a working gradient has more samples.
"""
# Number of converged gradients that are compared. Two can agree by chance if they have
# few elements.
N_CONVERGED = 3
MIN_AGREEMENT = 0.5
"""Smallest cosine c of two converged gradients at which they are a usable reference.
Below it the cosine of the mean of three with the true gradient is at most about
sqrt(3 c / (1 + 2 c)) = 0.87 (Spearman and Brown). Above it the noise of the converged
gradient, which is independent of that of the working one, can only reduce the measured
cosine. So a status of "ok" is right.
"""


def rate_cosine(cosine: float, agreement: float) -> GradientStatus:
    """Return whether a gradient agrees well enough with the converged one, as a status.

    - "reference unusable" if two converged gradients do not agree: their cosine is
      below `MIN_AGREEMENT`;
    - "ok" if the cosine reaches `GOAL_COSINE`;
    - "noisy" if it does not, but the converged gradients reach it among each other;
    - "reference unusable" if neither reaches it.

    Args:
        cosine: cosine of the gradient and the converged one.
        agreement: smallest cosine of two converged gradients.
    """
    if not agreement >= MIN_AGREEMENT:  # also if it is NaN
        return "reference unusable"
    if cosine >= GOAL_COSINE:
        return "ok"
    return "noisy" if agreement >= GOAL_COSINE else "reference unusable"


def list_comparable_sets(
    groups: Iterable[Group],
) -> list[tuple[tuple[Group, ...], tuple[str, ...]]]:
    """Return sets of groups, each of one control and with the same valid estimators.

    With each set come those of its estimators that are worth comparing. This depends on
    the number of coordinates of the set (`select_compared`).
    """
    sets: dict[tuple[str, tuple[str, ...]], list[Group]] = {}
    for group in groups:
        sets.setdefault((group.control, group.valid), []).append(group)
    sets_with_estimators = []
    for (_, valid), members in sets.items():
        n_coordinates = sum(group.size for group in members)
        compared_estimators = select_compared(valid, n_coordinates)
        sets_with_estimators.append((tuple(members), compared_estimators))
    return sets_with_estimators


def list_contested(
    plan: GradientPlan, *, with_all: bool = False
) -> list[tuple[tuple[Group, ...], tuple[str, ...]]]:
    """Return sets of groups for which several estimators are to be compared.

    The groups of a set belong to one control. None of them has an estimator that the
    user has forced.

    Args:
        plan: plan with the groups.
        with_all: whether all groups count. Otherwise only those count whose preferred
            estimator is "adjoint". For the others a comparison is not worth its time:
            for poses no estimator is best, as the loss of a model is too rough; for
            shapes one estimator, the material form, always has the least noise.

    Returns:
        The sets, each with its estimators.
    """
    open_groups = [
        group for group in plan.groups if _is_worth_comparing(group, with_all=with_all)
    ]
    return [
        (groups, estimators)
        for groups, estimators in list_comparable_sets(open_groups)
        if len(estimators) > 1
    ]


def _is_worth_comparing(group: Group, *, with_all: bool) -> bool:
    """Return whether estimators are compared for a group; see `list_contested`."""
    if group.is_forced or not group.valid:
        return False
    preferred, *_ = group.valid  # in the order of preference
    return with_all or preferred == "adjoint"


REPEATS = 3  # gradients that are computed with each estimator or setting


def count_plan_gradients(plan: GradientPlan, *, with_all: bool = False) -> int:
    """Return how many gradients `choose_estimators` computes."""
    n_estimators = sum(
        len(estimators) for _, estimators in list_contested(plan, with_all=with_all)
    )
    return REPEATS * n_estimators


def choose_estimators(
    bench: Bench,
    *,
    repeats: int = REPEATS,
    with_all: bool = False,
    count_renders: bool = False,
) -> GradientPlan:
    """Return the renderer's plan with every contested choice made by measurement.

    A choice is contested if several estimators can give the derivatives of a control.
    The score of an estimator is its squared error times its seconds. The smallest score
    is best: with it the error after equal time is smallest. The plan of the renderer
    itself is not changed.

    Args:
        bench: computes the gradients.
        repeats: number of gradients with each estimator.
        with_all: whether estimators are compared for all groups, also for those for
            which it is rarely worth its time (`list_contested`).
        count_renders: whether the cost of an estimator is its number of renders, and
            not its seconds (`ADJOINT_RENDERS` for an adjoint). So the choice is the
            same on a busy machine.
    """
    plan = bench.renderer.plan
    # each set of groups with the estimators that are compared for it
    for groups, estimators in list_contested(plan, with_all=with_all):
        scores = _score_estimators(
            bench, plan, groups, estimators, repeats, counts_renders=count_renders
        )
        best = min(scores, key=lambda name: scores[name])
        reason = _explain_scores(scores, best, bench.spp, count_renders)
        chosen_groups = [
            replace(group, estimator=best, reason=reason, estimator_costs=scores)
            for group in groups
        ]
        plan = _replace_groups(plan, chosen_groups)
    return plan


def _replace_groups(plan: GradientPlan, new_groups: Sequence[Group]) -> GradientPlan:
    """Return the plan with some groups replaced by new ones of the same names."""
    group_by_name = {group.name: group for group in new_groups}
    groups = tuple(group_by_name.get(group.name, group) for group in plan.groups)
    return replace(plan, groups=groups)


def _count_renders(plan: GradientPlan, estimator: str) -> float:
    """Return the renders that a gradient by one estimator takes.

    They are the image itself, the renders of the differences, and the adjoint, which
    takes as much time as `ADJOINT_RENDERS` renders.
    """
    is_adjoint = estimator in ADJOINT_ESTIMATORS
    return 1.0 + plan.renders + (ADJOINT_RENDERS if is_adjoint else 0.0)


def _score_estimators(
    bench: Bench,
    plan: GradientPlan,
    groups: Sequence[Group],
    estimators: Sequence[str],
    repeats: int,
    *,
    counts_renders: bool,
) -> dict[str, float]:
    """Return squared error times cost of each estimator, on groups of one control.

    Errors are differences from the mean gradient of the estimator that takes finite
    differences; its noise is subtracted. The cost is the seconds of a gradient, or the
    number of renders if `counts_renders` is set.
    """
    group_names = {group.name for group in groups}
    gradients_of_estimator = dict[str, Tensor]()
    cost_of_estimator = dict[str, float]()
    for estimator in estimators:
        single_plan = restrict_plan(plan, group_names, estimator)
        gradients, seconds = bench.compute_gradients(
            single_plan,
            stream="plan",
            repeats=repeats,
            label=f"{groups[0].name} by {estimator}",
        )
        cost = seconds
        if counts_renders:
            cost = _count_renders(single_plan, estimator)
        gradients_of_estimator[estimator] = gradients
        cost_of_estimator[estimator] = cost
    errors = _compute_squared_errors(gradients_of_estimator, repeats)
    return {name: error * cost_of_estimator[name] for name, error in errors.items()}


def _compute_squared_errors(
    gradients_of: Mapping[str, Tensor], repeats: int
) -> dict[str, float]:
    """Return the mean squared error of the gradients of each estimator.

    The mean gradient by finite differences is the reference, and counts as unbiased. So
    the error of finite differences is their variance. For any other estimator it is the
    mean squared distance from the reference, minus the variance of the reference. It is
    at least the variance of the estimator, which the subtraction may miss by chance.

    Args:
        gradients_of: (repeats, d) gradients by estimator; one takes differences.
        repeats: number of gradients of each estimator.
    """
    variance_of = {
        estimator: _sum_variances(gradients)
        for estimator, gradients in gradients_of.items()
    }
    reference = next(name for name in gradients_of if name in DIFFERENCE_ESTIMATORS)
    reference_gradient = gradients_of[reference].mean(dim=0)
    reference_variance = variance_of[reference] / repeats  # that of the mean
    errors = dict[str, float]()
    for estimator, gradients in gradients_of.items():
        variance = variance_of[estimator]
        if estimator == reference:
            errors[estimator] = variance
            continue
        squared_distance = (gradients - reference_gradient).square().sum(dim=1).mean()
        error = float(squared_distance) - reference_variance
        errors[estimator] = max(error, variance)
    return errors


def _sum_variances(gradients: Tensor) -> float:
    """Return the sum of the variances of all elements of gradients (repeats, d)."""
    residual = gradients - gradients.mean(dim=0)
    return float(residual.square().sum() / max(1, len(gradients) - 1))


def _explain_scores(
    scores: Mapping[str, float], best: str, spp: int, counts_renders: bool
) -> str:
    """Return why an estimator was chosen, for the plan.

    Args:
        scores: squared error times cost of each estimator.
        best: the chosen estimator.
        spp: samples per pixel of the gradients.
        counts_renders: whether the cost is a number of renders, and not seconds.
    """
    # All are 0 if the loss is flat, as that of a detector that detects nothing.
    is_flat = not any(scores.values())
    if is_flat:
        return f"as preferred: none of them has an error, measured at {spp} samples"
    cost = "renders" if counts_renders else "time"
    reason = f"least squared error x {cost}, measured at {spp} samples"
    has_multiples = scores[best] > 0.0
    if has_multiples:
        reason += f" (others, as multiples of it: {_list_multiples(scores, best)})"
    return reason


def _list_multiples(scores: Mapping[str, float], best: str) -> str:
    """Return the scores of all estimators but the best, as multiples of its score."""
    return ", ".join(
        f"{name} {score / scores[best]:.3g}"
        for name, score in scores.items()
        if name != best
    )


def count_cosine_samples(
    plan: GradientPlan, *, counts: Sequence[int] = SAMPLE_COUNTS
) -> int:
    """Return how many samples per pixel `measure_cosines` takes at most."""
    working_samples = REPEATS * sum(counts)
    # converged gradients are computed twice at most, the second time with more samples
    first_samples = N_CONVERGED * CONVERGED_SPP
    second_samples = CONVERGED_SPP_FACTOR * first_samples
    # the factors on the step of each control
    n_steps = sum(len(factors) for _, factors in _list_controls(plan))
    return (working_samples + first_samples + second_samples) * n_steps


def _list_controls(plan: GradientPlan) -> list[tuple[list[Group], Sequence[float]]]:
    """Return the differentiated groups of each control, and the factors to try.

    The steps of its finite differences are multiplied by a factor. A control without
    finite differences has only the first one, which is 1.
    """
    groups_of_control: dict[str, list[Group]] = {}
    for group in plan.groups:
        if group.estimator != "none":
            groups_of_control.setdefault(group.control, []).append(group)
    controls = list[tuple[list[Group], Sequence[float]]]()
    for groups in groups_of_control.values():
        has_steps = any(group.estimator in DIFFERENCE_ESTIMATORS for group in groups)
        controls.append((groups, FACTORS if has_steps else FACTORS[:1]))
    return controls


def measure_cosines(
    bench: Bench, *, counts: Sequence[int] = SAMPLE_COUNTS
) -> Iterator[Measured]:
    """Measure the cosine of working gradients with the converged one, for each control.

    The steps of differences are multiplied by each of `FACTORS`, in the working
    gradients and in the converged ones. With each factor the sample counts are tried in
    order, until one reaches the goal; then the next factor follows. The last factor is
    a fallback: it is only tried if no other has reached the goal. A control without
    finite differences has only the factor 1, and no fallback.

    Args:
        bench: computes the gradients; its renderer has the plan.
        counts: samples per pixel, ascending.

    Yields:
        A row for each control, factor and sample count that was measured.
    """
    base_plan = bench.renderer.plan
    for groups, factors in _list_controls(base_plan):
        yield from _measure_cosines_of_control(
            bench, base_plan, groups, factors, counts
        )


def _measure_cosines_of_control(
    bench: Bench,
    base_plan: GradientPlan,
    groups: Sequence[Group],
    factors: Sequence[float],
    counts: Sequence[int],
) -> Iterator[Measured]:
    """Measure the cosines of one control with each factor on the steps of differences.

    The arguments are those of `_measure_cosines`, but `base_plan` has the planned
    steps. The last factor is only tried if no other has reached the goal.
    """
    group_names = {group.name for group in groups}
    is_reached = False
    tried_plans = list[GradientPlan]()
    for factor in factors:
        is_fallback = factor == FACTORS[-1]
        if is_fallback and is_reached:
            break
        plan = restrict_plan(base_plan.scale_steps(factor), group_names)
        # Steps have an upper limit, so that a larger factor can give the same plan.
        if plan in tried_plans:
            continue
        tried_plans.append(plan)
        for row in _measure_cosines(bench, plan, groups, factor, counts):
            is_reached = is_reached or row.status == "ok"
            yield row


def _measure_cosines(
    bench: Bench,
    plan: GradientPlan,
    groups: Sequence[Group],
    factor: float,
    counts: Sequence[int],
) -> Iterator[Measured]:
    """Measure the cosine of one control's gradients with the converged gradient.

    Sample counts are tried in turn, until the cosine reaches the goal. The converged
    gradient is computed again with more samples, but only once, if its repeats do not
    agree well enough or if a working gradient, as a search uses it, has more samples.

    Args:
        bench: computes the gradients.
        plan: plan with the groups of the control, whose steps have the factor already.
        groups: groups of the control.
        factor: factor on the steps of differences, for the rows.
        counts: samples per pixel of working gradients, ascending.
    """
    label = f"{groups[0].control} x {factor:g}"
    converged = _converged_gradient(bench, plan, label, CONVERGED_SPP)
    was_repeated = False
    for spp in counts:
        needs_samples = converged.agreement < GOAL_COSINE or spp > CONVERGED_SPP
        if needs_samples and not was_repeated:
            converged_spp = CONVERGED_SPP_FACTOR * CONVERGED_SPP
            converged = _converged_gradient(bench, plan, label, converged_spp)
            was_repeated = True
        gradients, seconds = replace(bench, spp=spp).compute_gradients(
            plan, stream="working", repeats=REPEATS, label=f"{label} {spp}"
        )
        cosine = _compute_mean_cosine(gradients, converged.gradient)
        yield Measured(
            quantity="gradient",
            control=groups[0].control,
            estimator=", ".join(dict.fromkeys(group.estimator for group in groups)),
            factor=factor,
            spp=spp,
            repeats=REPEATS,
            cosine=cosine,
            reference_cosine=converged.agreement,
            seconds=seconds,
            status=rate_cosine(cosine, converged.agreement),
        )
        if cosine >= GOAL_COSINE:
            break


def _compute_mean_cosine(gradients: Tensor, converged: Tensor) -> float:
    """Return the mean cosine of gradients (repeats, d) with a converged one (d,)."""
    return statistics.fmean(_cosine(gradient, converged) for gradient in gradients)


class _ConvergedGradient(NamedTuple):
    """A converged gradient.

    Attributes:
        gradient: (d,) mean of several.
        agreement: smallest cosine of two of them.
    """

    gradient: Tensor
    agreement: float


def _converged_gradient(
    bench: Bench, plan: GradientPlan, label: str, spp: int
) -> _ConvergedGradient:
    """Compute a gradient with many samples per pixel."""
    gradients, _ = replace(bench, spp=spp).compute_gradients(
        plan,
        stream="converged",
        repeats=N_CONVERGED,
        label=f"{label} converged {spp}",
    )
    agreements = torch.tensor(
        [
            _cosine(gradient_a, gradient_b)
            for gradient_a, gradient_b in itertools.combinations(gradients, 2)
        ]
    )
    # The cosine with a zero gradient is NaN. Then the minimum of a tensor is NaN, so
    # that the reference is unusable. Python's `min` would depend on the order.
    return _ConvergedGradient(gradients.mean(dim=0), float(agreements.min()))


def _cosine(gradient_a: Tensor, gradient_b: Tensor) -> float:
    """Return the cosine similarity of two gradients (d,); NaN if one is zero."""
    norms = float(gradient_a.norm() * gradient_b.norm())
    return float(gradient_a @ gradient_b) / norms if norms > 0.0 else float("nan")


def choose_steps(
    plan: GradientPlan, table: Sequence[Measured]
) -> tuple[GradientPlan, int | None]:
    """Choose each control's step of differences from measured cosines.

    A setting is a step and a sample count. A gradient takes equally many renders with
    every setting, so that the cheapest one has the fewest samples per pixel. For each
    control the cheapest setting that reaches `GOAL_COSINE` is chosen; of equally cheap
    ones, that with the largest cosine. If none reaches the goal, the one with the
    largest cosine is chosen, and the reason of the group says so.

    Args:
        plan: plan with the steps.
        table: rows of `measure_cosines`.

    Returns:
        The plan with the chosen steps, and the largest sample count that a control
        needs; None if nothing was measured.
    """
    sample_counts = []
    # each row with its cosine, if that is a number
    measured = [
        (row, row.cosine)
        for row in table
        if row.cosine is not None and not math.isnan(row.cosine)
    ]
    for control in dict.fromkeys(row.control for row, _ in measured):
        rows = [(row, cosine) for row, cosine in measured if row.control == control]
        best, cosine = _choose_setting(rows)
        sample_counts.append(best.spp)
        remark = _describe_setting(best, cosine)
        plan = _scale_steps_of_control(plan, control, best.factor, remark)
    return plan, max(sample_counts) if sample_counts else None


def _describe_setting(row: Measured, cosine: float) -> str:
    """Return the remark of a control about the chosen setting and its cosine."""
    return (
        f"cosine {cosine:.2f} with the converged gradient at {row.spp} samples "
        f"and {row.factor:g} x the step{_describe_shortfall(row)}"
    )


def _scale_steps_of_control(
    plan: GradientPlan, control: str, factor: float, remark: str
) -> GradientPlan:
    """Return the plan with the steps of one control multiplied by a factor.

    `remark` is added to the reason of each of its groups.
    """
    groups = []
    for group, scaled in zip(plan.groups, plan.scale_steps(factor).groups, strict=True):
        if group.control == control:
            reason = f"{group.reason}; {remark}"
            group = replace(group, step=scaled.step, reason=reason)
        groups.append(group)
    return replace(plan, groups=tuple(groups))


def _choose_setting(
    rows: Sequence[tuple[Measured, float]],
) -> tuple[Measured, float]:
    """Return the cheapest setting that reaches the goal, or the one nearest to it.

    Settings are rows, each with its cosine, which is not NaN. Of equally cheap ones the
    one with the greatest cosine is returned.
    """

    def get_cost(row_with_cosine: tuple[Measured, float]) -> tuple[int, float]:
        row, cosine = row_with_cosine
        return row.spp, -cosine

    good_rows = [(row, cosine) for row, cosine in rows if row.status == "ok"]
    if good_rows:
        return min(good_rows, key=get_cost)
    return max(rows, key=itemgetter(1))  # the greatest cosine


def _describe_shortfall(row: Measured) -> str:
    """Return a remark if a setting does not reach the goal, otherwise "".

    It follows "cosine 0.80 with the converged gradient at 64 samples and 3 x the step".
    If converged gradients do not agree with each other, the cosine says little. Else
    the setting is only the best that was found.
    """
    if row.status == "ok":
        return ""
    agreement = row.reference_cosine  # of two converged gradients
    if agreement is not None and agreement < MIN_AGREEMENT:
        return f": which says little, two converged ones have {agreement:.2f}"
    return f": below {GOAL_COSINE:g}, the best that was found"


# segments of the shortest path: from a lamp to a surface and on to the camera
MIN_DEPTH = 2
# accepted root-mean-square change of the displayed image, in 8-bit levels
MAX_CHANGE = 0.5


def measure_path_length(
    renderer: Renderer,
    configurations: Sequence[Tensor],
    *,
    seed: int,
    spp: int,
    bound: float = MAX_CHANGE,
    tick: Callable[[], None] = lambda: None,
) -> PathLength:
    """Measure how short light paths may be for images to agree with those of full
    length.

    Images of all lengths have the same noise. Lengths are tried from the full one
    downwards, to the first whose image differs by more than the bound.

    Args:
        renderer: renders the images.
        configurations: full configurations (d,).
        seed: seed of the noise.
        spp: samples per pixel.
        bound: accepted change of the image, see `MAX_CHANGE`.
        tick: called after each image of a configuration.
    """
    # A denoiser would spread a change over its neighbors.
    renderer = renderer.copy_with(denoiser="none")
    full_depth = renderer.scene.max_depth
    noise_seeds = [seeds.derive_seed(seed, "half", half) for half in range(2)]
    trial = _DepthTrial(renderer, noise_seeds, spp, tick)
    cuts = trial.measure_cuts(configurations, bound)
    accepted_depths = [cut.depth for cut in cuts if cut.levels <= bound]
    chosen_depth = min(accepted_depths, default=full_depth)
    return PathLength(
        depth=chosen_depth,
        full=full_depth,
        cuts=cuts,
        configurations=len(configurations),
        reason=_explain_depth(cuts, chosen_depth, full_depth),
    )


@dataclass(frozen=True, eq=False)
class _DepthTrial:
    """Renders configurations with light paths of limited length.

    Attributes:
        renderer: renders the images, without a denoiser.
        noise_seeds: seeds of the noise; there is an image for each.
        spp: samples per pixel.
        tick: called after each image.
    """

    renderer: Renderer
    noise_seeds: Sequence[int]
    spp: int
    tick: Callable[[], None]

    def measure_cuts(
        self, configurations: Sequence[Tensor], bound: float
    ) -> list[PathCut]:
        """Measure the changes by shorter and shorter paths, up to one over the bound."""
        full_depth = self.renderer.scene.max_depth
        full_renderings = [self.render_twice(u, full_depth) for u in configurations]
        cuts = []
        for depth in range(full_depth - 1, MIN_DEPTH - 1, -1):
            cut = self.measure_cut(configurations, full_renderings, depth)
            cuts.append(cut)
            # NaN counts as too much
            if not cut.levels <= bound:
                break
        return cuts

    def render_twice(self, u: Tensor, depth: int) -> list[_Rendering]:
        """Render u (d,) with both seeds and paths of at most `depth` segments."""
        renderings = []
        for noise_seed in self.noise_seeds:
            rendering = _render_with_depth(
                self.renderer, u, noise_seed, self.spp, depth
            )
            renderings.append(rendering)
            self.tick()
        return renderings

    def measure_cut(
        self,
        configurations: Sequence[Tensor],
        full_renderings: Sequence[Sequence[_Rendering]],
        depth: int,
    ) -> PathCut:
        """Measure the largest change by shorter paths among configurations (d,).

        Args:
            configurations: the configurations.
            full_renderings: images of each of them, with paths of full length.
            depth: segments of the longest of the shorter paths.
        """
        # the largest changes among all configurations
        lost_light = 0.0
        changed_levels = 0.0
        for u, full in zip(configurations, full_renderings, strict=True):
            # fraction of the light that is lost, and change of the image in levels
            shorter = self.render_twice(u, depth)
            light, levels = _compare_depths(full, shorter)
            lost_light = max(lost_light, light)
            # `max` would drop NaN, of an image that is not finite
            changed_levels = float(np.maximum(changed_levels, levels))
        return PathCut(depth=depth, light=lost_light, levels=changed_levels)


class _Rendering(NamedTuple):
    """Linear radiance (H, W, 3) and the displayed image (H, W, 3) of it."""

    radiance: Tensor
    image: Tensor


def _render_with_depth(
    renderer: Renderer, u: Tensor, seed: int, spp: int, depth: int
) -> _Rendering:
    """Render u (d,) with light paths of at most `depth` segments."""
    with torch.no_grad(), renderer.scene.limit_depth(depth):
        radiance = renderer.radiance(u, seed, spp)
        displayed = renderer.formation.map_to_display(radiance)
        # with what controls change in the finished image, such as a blur
        image = renderer.space.apply_to_image(u, displayed)
        return _Rendering(radiance, image)


def _compare_depths(
    full: Sequence[_Rendering], shorter: Sequence[_Rendering]
) -> tuple[float, float]:
    """Return the fraction of light that shorter paths lose, and the change of the
    image.

    The change is a root mean square in 8-bit levels, without noise. Both arguments have
    two renderings, with the same two seeds.
    """
    difference_a, difference_b = (
        full_rendering.image - shorter_rendering.image
        for full_rendering, shorter_rendering in zip(full, shorter, strict=True)
    )
    # The product of two independent differences has no noise in its mean; so that mean
    # is that of the squared change, but can be below 0 by chance.
    rms_change = float((difference_a * difference_b).mean().clamp_min(0.0).sqrt())
    full_light = sum(float(rendering.radiance.mean()) for rendering in full)
    light = sum(float(rendering.radiance.mean()) for rendering in shorter)
    lost_light = 1.0 - light / full_light if full_light > 0.0 else 0.0
    return lost_light, 255.0 * rms_change


def _explain_depth(cuts: Sequence[PathCut], depth: int, full_depth: int) -> str:
    """Return why light paths of `depth` segments were chosen, as a clause.

    It states the light that they leave out, and that of the next shorter paths. Longer
    paths, which were tried before, are not mentioned.
    """
    texts = []
    for cut in cuts:
        # If all segments are needed, there is no cut of that depth.
        if cut.depth == depth:
            texts.append(
                f"paths of {depth} segments leave out {cut.light:.2%} of the light, "
                "which moves the picture by "
                f"{cut.levels:.2f} of 255 levels (bound {MAX_CHANGE:g})"
            )
        elif cut.depth < depth:
            texts.append(
                f"{cut.depth} would leave out {cut.light:.2%} and move it by "
                f"{cut.levels:.2f}"
            )
    return "; ".join(texts) or f"all {full_depth} segments"


# number of random configurations that are measured besides the clean one
N_RANDOM_CONFIGURATIONS = 2
# Samples per pixel. Few suffice, since the same paths are compared.
BOUNCE_SPP = 4
# Smallest number of renders of a search for which the measurement pays, as each path
# length takes a compilation.
MIN_RENDERS_FOR_BOUNCES = 200


def count_bounce_images(problem: Problem) -> int:
    """Return how many images `measure_problem_bounces` renders at most."""
    n_depths = 1 + problem.renderer.scene.max_depth - MIN_DEPTH
    images_per_depth = 2  # with independent noise
    return (1 + N_RANDOM_CONFIGURATIONS) * images_per_depth * n_depths


def measure_problem_bounces(
    problem: Problem, seed: int, tick: Callable[[], None] = lambda: None
) -> PathLength:
    """Measure how many bounces of light the images of a problem's search need.

    This is measured on the clean configuration and `N_RANDOM_CONFIGURATIONS` random
    ones of its domain. `tick` is called after each image.
    """
    full_configurations = [problem.make_full_configuration(problem.domain.start)]
    for index in range(N_RANDOM_CONFIGURATIONS):
        full_configurations.append(_sample_full_configuration(problem, seed, index))
    return measure_path_length(
        problem.renderer,
        full_configurations,
        seed=seeds.derive_seed(seed, "bounces"),
        spp=BOUNCE_SPP,
        tick=tick,
    )


def _sample_full_configuration(problem: Problem, seed: int, index: int) -> Tensor:
    """Return a random full configuration (d,) of a problem, by its index."""
    generator = torch.Generator().manual_seed(seeds.derive_seed(seed, "bounces", index))
    u = problem.domain.sample(generator)[0]
    condition_seed = seeds.derive_seed(seed, "conditions of bounces", index)
    return problem.make_full_configuration(u, condition_seed)
