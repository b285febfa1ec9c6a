"""Chooses estimators (least squared error x time), steps and sample counts (the
cheapest with a cosine of `GOAL` with the converged gradient of the model's own loss,
docs/gradients.md) and bounces of light (as many as change the picture: paths of other
lengths with one seed are the same, cut off earlier) by measurement on the scene.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.engine.gradients.bench import Bench, restrict_plan
from advsearch.engine.problem import Problem
from advsearch.runs.results import GradientStatus, Measured, PathCut, PathLength
from advsearch.scene.gradients import (
    BY_ADJOINT,
    BY_DIFFERENCES,
    GradientPlan,
    Group,
    compared,
)
from advsearch.scene.renderer import Renderer

GOAL = 0.9  # cosine with the converged gradient that a working gradient should have
FACTORS = (1.0, 3.0, 9.0)
"""Steps that are tried, as multiples of the plan's; the last only where no other will
do: it smooths away all but the coarse shape of the loss.
"""
COUNTS = (8, 16, 32, 64, 128)
ADJOINT_RENDERS = 3.0  # renders that take about as long as an adjoint
CONVERGED = 128
AGAIN = 4
"""Samples a pixel of a gradient that counts as converged, and times as many where these
do not agree, or where a working gradient has more.
"""
# converged gradients that are taken. Two of a few numbers can agree by luck.
WITNESSES = 3
TELLS = 0.5
"""Converged gradients of which two have a smaller cosine than this tell nothing: the
cosine of the mean of three with the truth is then about sqrt(3 c / (1 + 2 c)) (Spearman
and Brown), 0.87 and less. Above it the noise of the converged one, which is independent
of the working one's, only makes the measured cosine smaller: what is called `ok` is so.
"""


def status_of(cosine: float, converged: float) -> GradientStatus:
    """Return whether a cosine with the converged gradient is good enough; "reference
    unusable" where the converged ones don't agree well enough (`converged` is the
    smallest cosine of two of them) to tell.
    """
    if not converged >= TELLS:
        return "reference unusable"
    if cosine >= GOAL:
        return "ok"
    return "noisy" if converged >= GOAL else "reference unusable"


def comparable_sets(
    groups: Iterable[Group],
) -> list[tuple[tuple[Group, ...], tuple[str, ...]]]:
    """Return sets of groups of one control that have the same valid estimators, and
    those of these that are worth comparing on each set.
    """
    sets: dict[tuple[str, tuple[str, ...]], list[Group]] = {}
    for group in groups:
        sets.setdefault((group.control, group.valid), []).append(group)
    return [
        (tuple(members), compared(valid, sum(group.size for group in members)))
        for (_, valid), members in sets.items()
    ]


def contested(
    plan: GradientPlan, *, every: bool = False
) -> list[tuple[tuple[Group, ...], tuple[str, ...]]]:
    """Return groups of one control with the estimators to compare on them, where there
    is more than one and none was forced: wherever several are valid (`every`), or only
    where the interior adjoint is preferred so far: over poses, the model's loss is so
    rough that none has won, and over shapes the material form is the quietest.
    """
    open_groups = [
        group
        for group in plan.groups
        if not group.is_forced
        and group.valid
        and (every or group.valid[0] == "adjoint")
    ]
    return [
        (groups, estimators)
        for groups, estimators in comparable_sets(open_groups)
        if len(estimators) > 1
    ]


REPEATS = 3  # gradients that are taken of everything that is compared


def plan_gradients(plan: GradientPlan, *, every: bool = False) -> int:
    return REPEATS * sum(
        len(candidates) for _, candidates in contested(plan, every=every)
    )


def measured_plan(
    bench: Bench, *, repeats: int = REPEATS, every: bool = False, counted: bool = False
) -> GradientPlan:
    """Return the renderer's plan, which is not changed, with every contested choice
    made by measurement. If `counted`, the renders that an estimator needs stand for its
    time (`ADJOINT_RENDERS` for an adjoint), so that the choice is the same on a busy
    machine.
    """
    plan = bench.renderer.plan

    def scores_of(
        groups: Sequence[Group], candidates: Sequence[str]
    ) -> dict[str, float]:
        """Squared error x seconds. The reference is the mean of the differences among
        the candidates, whose own noise is taken off the others' errors.
        """
        measured = dict[str, Tensor]()
        seconds = dict[str, float]()
        noise = dict[str, float]()
        for estimator in candidates:
            alone = restrict_plan(plan, {group.name for group in groups}, estimator)
            place = f"{groups[0].name} by {estimator}"
            several, seconds[estimator] = bench.gradients(alone, "plan", repeats, place)
            if counted:
                seconds[estimator] = (
                    1.0
                    + alone.renders
                    + (ADJOINT_RENDERS if estimator in BY_ADJOINT else 0.0)
                )
            measured[estimator] = several
            noise[estimator] = float(
                (several - several.mean(dim=0)).square().sum() / max(1, repeats - 1)
            )
        judge = next(
            estimator for estimator in candidates if estimator in BY_DIFFERENCES
        )
        scores = dict[str, float]()
        truth = measured[judge].mean(dim=0)
        for estimator, several in measured.items():
            error = (
                float((several - truth).square().sum(dim=1).mean())
                - noise[judge] / repeats
            )
            error = noise[judge] if estimator == judge else max(error, noise[estimator])
            scores[estimator] = error * seconds[estimator]
        return scores

    for groups, candidates in contested(plan, every=every):
        scores = scores_of(groups, candidates)
        best = min(scores, key=lambda name: scores[name])
        reason = (
            f"least squared error x {'renders' if counted else 'time'}, measured "
            f"at {bench.spp} samples"
        )
        if scores[best] > 0.0:
            others = ", ".join(
                f"{name} {score / scores[best]:.3g}"
                for name, score in scores.items()
                if name != best
            )
            reason += f" (others, as multiples of it: {others})"
        elif not any(
            scores.values()
        ):  # a loss that is flat here, as of a detector that sees nothing
            reason = (
                "as preferred: none of them has an error, measured at "
                f"{bench.spp} samples"
            )
        chosen = {
            group.name: replace(group, estimator=best, reason=reason, measured=scores)
            for group in groups
        }
        plan = replace(
            plan, groups=tuple(chosen.get(group.name, group) for group in plan.groups)
        )
    return plan


def cosine_samples(plan: GradientPlan, *, counts: Sequence[int] = COUNTS) -> int:
    """Return the samples a pixel that the gradients of `cosines` take in all, at
    most.
    """
    each = REPEATS * sum(counts) + WITNESSES * (1 + AGAIN) * CONVERGED
    return each * sum(len(factors) for _, factors in _controls_of(plan))


def _controls_of(plan: GradientPlan) -> list[tuple[list[Group], Sequence[float]]]:
    """The groups of each control that are differentiated, and the steps that are tried
    of them.
    """
    differentiated = [group for group in plan.groups if group.estimator != "none"]
    names = dict.fromkeys(group.control for group in differentiated)
    controls = [
        [group for group in differentiated if group.control == name] for name in names
    ]
    by_steps = [
        any(group.estimator in BY_DIFFERENCES for group in groups)
        for groups in controls
    ]
    return [
        (groups, FACTORS if steps else FACTORS[:1])
        for groups, steps in zip(controls, by_steps, strict=True)
    ]


def cosines(bench: Bench, *, counts: Sequence[int] = COUNTS) -> Iterator[Measured]:
    """Measure, control by control, the cosine of working gradients with the converged
    one at the same step.

    Sample counts are tried in their order until one reaches the goal at a step; then
    the next step follows. `cosine_samples` bounds the samples of all gradients.
    """
    base = bench.renderer.plan

    def rows_at(
        plan: GradientPlan, groups: Sequence[Group], factor: float
    ) -> Iterator[Measured]:
        control = groups[0].control
        estimators = ", ".join(dict.fromkeys(group.estimator for group in groups))
        place = f"{control} x {factor:g}"

        def converged(spp: int) -> tuple[Tensor, float]:
            several, _ = replace(bench, spp=spp).gradients(
                plan, "converged", WITNESSES, f"{place} converged {spp}"
            )
            agreements = torch.tensor(
                [_cosine(*pair) for pair in itertools.combinations(several, 2)]
            )
            return several.mean(dim=0), float(agreements.min())  # NaN if one is

        many = CONVERGED
        truth, agreement = converged(many)
        for spp in counts:
            if many == CONVERGED and (agreement < GOAL or spp > CONVERGED):
                many = AGAIN * CONVERGED
                truth, agreement = converged(many)
            several, seconds = replace(bench, spp=spp).gradients(
                plan, "working", REPEATS, f"{place} {spp}"
            )
            mean = statistics.fmean(_cosine(gradient, truth) for gradient in several)
            yield Measured(
                quantity="gradient",
                control=control,
                estimator=estimators,
                factor=factor,
                spp=spp,
                repeats=REPEATS,
                cosine=mean,
                reference_cosine=agreement,
                seconds=seconds,
                status=status_of(mean, agreement),
            )
            if mean >= GOAL:
                break

    for groups, factors in _controls_of(base):
        reached = False
        tried = list[GradientPlan]()
        for factor in factors:
            if factor == FACTORS[-1] and reached:
                break
            plan = restrict_plan(
                base.with_steps(factor), {group.name for group in groups}
            )
            if plan in tried:  # no step can be wider
                continue
            tried.append(plan)
            for row in rows_at(plan, groups, factor):
                reached = reached or row.status == "ok"
                yield row


def _cosine(one: Tensor, other: Tensor) -> float:
    size = float(one.norm() * other.norm())
    return float(one @ other) / size if size > 0.0 else float("nan")


def tuned(
    plan: GradientPlan, table: Sequence[Measured]
) -> tuple[GradientPlan, int | None]:
    """Return the plan with each control's step chosen from measured cosines, and the
    sample count that all then need.

    Of the settings that reach the goal, the one with the fewest samples wins (all take
    as many renders), of equal ones that with the greatest cosine; where none does, the
    one with the greatest cosine, and the reason says so. The sample count is None where
    nothing was measured.
    """
    counts = []
    measured = [
        (row, row.cosine)
        for row in table
        if row.cosine is not None and not math.isnan(row.cosine)
    ]
    for control in dict.fromkeys(row.control for row, _ in measured):
        rows = [(row, cosine) for row, cosine in measured if row.control == control]
        chosen, cosine = max(rows, key=lambda measured: measured[1])
        shortfall = f": below {GOAL:g}, the best that was found"
        if chosen.reference_cosine is not None and chosen.reference_cosine < TELLS:
            shortfall = (
                ": which says little, two converged ones have "
                f"{chosen.reference_cosine:.2f}"
            )
        if good := [(row, cosine) for row, cosine in rows if row.status == "ok"]:
            shortfall = ""
            (chosen, cosine) = min(
                good, key=lambda measured: (measured[0].spp, -measured[1])
            )
        counts.append(chosen.spp)
        said = (
            f"cosine {cosine:.2f} with the converged gradient at {chosen.spp} samples"
        )
        said += f" and {chosen.factor:g} x the step{shortfall}"
        groups = tuple(
            replace(group, step=scaled.step, reason=f"{group.reason}; {said}")
            if group.control == control
            else group
            for group, scaled in zip(
                plan.groups, plan.with_steps(chosen.factor).groups, strict=True
            )
        )
        plan = replace(plan, groups=groups)
    return plan, max(counts) if counts else None


# segments of the shortest path tried: light that reaches the camera from a surface that
# it falls on
SHORTEST = 2
# root-mean-square change of the displayed picture, in 8-bit levels, that a search
# accepts
BOUND = 0.5


def measured_bounces(
    renderer: Renderer,
    configurations: Sequence[Tensor],
    *,
    seed: int,
    spp: int,
    bound: float = BOUND,
    tick: Callable[[], None] = lambda: None,
) -> PathLength:
    """Return the shortest paths whose pictures agree with those of the full length to
    within a bound, all with the same noise; and what was measured, from the full length
    downwards to the first that misses the bound.
    """
    # a denoiser would spread a change over its neighbours
    raw = renderer.like(denoiser="none")
    full = raw.scene.max_depth
    noises = [seeds.stream(seed, "half", half) for half in range(2)]

    def pictures(u: Tensor, depth: int) -> list[tuple[Tensor, Tensor]]:
        rendered = []
        for noise in noises:
            with torch.no_grad(), raw.scene.shorter(depth):
                radiance = raw.radiance(u, noise, spp)
                rendered.append(
                    (radiance, raw.space.picture(u, raw.formation.display(radiance)))
                )
            tick()
        return rendered

    wholes = [pictures(u, full) for u in configurations]
    cuts = []
    chosen = full
    for depth in range(full - 1, SHORTEST - 1, -1):
        light = levels = 0.0
        for u, whole in zip(configurations, wholes, strict=True):
            shorter = pictures(u, depth)
            first, second = (
                long[1] - short[1] for long, short in zip(whole, shorter, strict=True)
            )
            # the product of two independent differences has no noise in its mean
            bias = float((first * second).mean().clamp_min(0.0).sqrt())
            all_of_it, left = (
                sum(float(radiance.mean()) for radiance, _ in both)
                for both in (whole, shorter)
            )
            light = max(light, 1.0 - left / all_of_it if all_of_it > 0.0 else 0.0)
            levels = max(levels, 255.0 * bias)
        cuts.append(PathCut(depth=depth, light=light, levels=levels))
        if not levels <= bound:
            break
        chosen = depth
    said = []
    for cut in cuts:
        if cut.depth == chosen:
            said.append(
                f"paths of {chosen} segments leave out {cut.light:.2%} of the light, "
                "which moves the picture by "
                f"{cut.levels:.2f} of 255 levels (bound {BOUND:g})"
            )
        elif cut.depth < chosen:
            said.append(
                f"{cut.depth} would leave out {cut.light:.2%} and move it by "
                f"{cut.levels:.2f}"
            )
    reason = "; ".join(said) or f"all {full} segments"
    return PathLength(
        depth=chosen,
        full=full,
        cuts=cuts,
        configurations=len(configurations),
        reason=reason,
    )


DRAWS = 2  # configurations, beside the clean one, that the measurement looks at
BOUNCE_SPP = 4  # samples a pixel: the same paths are compared, so that few are enough
# renders of a search from which the measurement pays; each path length costs a
# compilation
WORTH_BOUNCES = 200


def most_pictures(problem: Problem) -> int:
    return (1 + DRAWS) * 2 * (1 + problem.renderer.scene.max_depth - SHORTEST)


def bounces_of(
    problem: Problem, seed: int, tick: Callable[[], None] = lambda: None
) -> PathLength:
    """Measure the bounces that a problem's search needs, over its clean configuration
    and random ones of its space.
    """
    drawn = [
        problem.domain.sample(
            torch.Generator().manual_seed(seeds.stream(seed, "bounces", number))
        )[0]
        for number in range(DRAWS)
    ]
    conditions = [
        seeds.stream(seed, "conditions of bounces", number) for number in range(DRAWS)
    ]
    wholes = [problem.whole(problem.domain.start)]
    wholes += [
        problem.whole(u, draw) for u, draw in zip(drawn, conditions, strict=True)
    ]
    return measured_bounces(
        problem.renderer,
        wholes,
        seed=seeds.stream(seed, "bounces"),
        spp=BOUNCE_SPP,
        tick=tick,
    )
