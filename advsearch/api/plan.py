"""Plans a search on its scene: how it differentiates, and what it leaves out. What `advsearch plan` does."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from advsearch import seeds
from advsearch.api.attack import LOADING, problem_from_config
from advsearch.config import AttackConfig
from advsearch.engine.bounces import bounces_of, most_pictures
from advsearch.engine.gradients import inside
from advsearch.engine.planning import GOAL, cosine_samples, cosines, measured_plan, plan_gradients, tuned
from advsearch.engine.problem import Problem
from advsearch.evaluation.leaving_out import measured_gains, most_gradients, resolved_texels
from advsearch.progress import NullProgress, Progress
from advsearch.report.wording import count
from advsearch.runs.results.base import INTERRUPTED, OUT_OF_TIME, Formation
from advsearch.runs.results.plan import (
    CosineRow,
    DenoiserAdvice,
    EstimatorLimit,
    GainRow,
    PathLength,
    PlanResult,
    TexelRow,
)
from advsearch.scene.gradients.plan import BY_DIFFERENCES, GradientPlan


def plan(config: AttackConfig, *, progress: Progress | None = None) -> PlanResult:
    """Choose how every derivative is obtained and what is left out, by measurement, and say why.

    Args:
        config: scene, model, controls; after its `seconds` nothing more is measured.
        progress: told how far it is.
    """
    progress, begun = progress or NullProgress(), time.monotonic()
    progress.stage(LOADING)
    problem, _ = problem_from_config(config)
    work = _Measurements(problem, config, progress)
    work.compare_estimators()
    left, ending = work.steps(), "done"
    try:
        while left:
            if config.seconds is not None and time.monotonic() - begun >= config.seconds:
                ending = OUT_OF_TIME
                break
            left[0][1]()
            left.pop(0)
    except KeyboardInterrupt:
        ending = INTERRUPTED
    tables, (chosen, spp) = work.tables, work.chosen
    used = {group.estimator for group in chosen.groups}
    gradient = problem.plan_summary(chosen)
    return PlanResult(
        object=config.object,
        environment=problem.space.environment or config.lit_by,
        controls=list(config.controls),
        model=problem.model.name,
        ending=ending,
        not_measured=[what for what, _ in left],
        image_formation=Formation.of(problem.renderer.formation),
        renders_per_gradient=gradient.renders_per_gradient,
        spp=spp,
        groups=gradient.groups,
        cosines=[row for rows in tables.values() for row in rows],
        denoise=quieter(tables, config.denoise),
        left_out=_left_out(problem, used) if config.specialise else [],
        specialised=config.specialise,
        gains=work.gains,
        bounces=work.bounces,
        texels=work.texels,
        limits=_limits() if "material" in used else [],
    )


class _Measurements:
    """What a plan measures, one after the other.

    Args:
        problem: whose renderer's plan is measured; it is replaced by the one that is chosen.
        config: of the plan.
        progress: told how far it is.

    Attributes:
        tables: denoiser to the cosines so far.
        gains, bounces, texels: what leaving things out brings; None before it was measured.
    """

    def __init__(self, problem: Problem, config: AttackConfig, progress: Progress) -> None:
        self._problem, self._config, self._progress = problem, config, progress
        self._other = "none" if config.denoise == "oidn" else "oidn"
        self._theirs: Problem | None = None
        self.tables: dict[str, list[CosineRow]] = {config.denoise: [], self._other: []}
        self.gains: list[GainRow] | None = None
        self.bounces: PathLength | None = None
        self.texels: list[TexelRow] | None = None

    @property
    def chosen(self) -> tuple[GradientPlan, int]:
        """The plan and the samples a pixel that follow from what was measured so far."""
        plan, spp = tuned(self._problem.renderer.plan, self.tables[self._config.denoise])
        return plan, spp or self._problem.spp

    def compare_estimators(self) -> None:
        """Choose every contested estimator."""
        renderer, seed = self._problem.renderer, seeds.stream(self._config.seed, "measure")
        gradients = plan_gradients(renderer.plan, every=True)
        if gradients:
            hint = f"{gradients} gradients of {count(self._problem.spp, 'sample')} a pixel; `resolution` shortens it"
            self._progress.stage("comparing ways to differentiate", gradients, hint=hint)
        renderer.plan = measured_plan(
            renderer,
            self._problem.loss,
            inside(renderer),
            seed=seed,
            spp=self._problem.spp,
            every=True,
            tick=lambda: self._progress.advance(1),
        )

    def steps(self) -> list[tuple[str, Callable[[], None]]]:
        """What is to be measured then, by name, what matters most first."""
        groups = self._problem.renderer.plan.groups
        controls = dict.fromkeys(group.control for group in groups if group.estimator != "none")
        own = [(f"step and samples of {name}", partial(self._compare, name)) for name in controls]
        last = [(f"{name} with denoiser {self._other}", partial(self._compare_other, name)) for name in controls]
        return own + [("what can be left out", self._leave_out)] * self._config.specialise + last

    def _compare(self, control: str) -> None:
        title = f"choosing step and samples for {control}"
        self.tables[self._config.denoise] += self._cosines(self._problem, control, title)

    def _compare_other(self, control: str) -> None:
        if self._theirs is None:
            self._progress.stage("loading the scene for the other denoiser")
            self._theirs, _ = problem_from_config(self._config, denoise=self._other)
            estimators = {one.name: one.estimator for one in self._problem.renderer.plan.groups}
            self._theirs.plan = self._theirs.plan.with_estimator(estimators, "as beside")
        title = f"the same for {control} with denoiser {self._other}"
        self.tables[self._other] += self._cosines(self._theirs, control, title)

    def _cosines(self, problem: Problem, control: str, title: str) -> list[CosineRow]:
        renderer, only = problem.renderer, (control,)
        hint = "counted in samples a pixel; `resolution` shortens it, `seconds` ends it"
        self._progress.stage(title, cosine_samples(renderer.plan, controls=only), hint=hint, at_most=True)
        seed, u = seeds.stream(self._config.seed, "measure"), inside(renderer)
        rows = []
        for row in cosines(renderer, problem.loss, u, seed=seed, controls=only, tick=self._progress.advance):
            rows.append(row)
            self._progress.message(
                f"{control}: a gradient of {row.spp} samples and {row.factor:g} x the step has a cosine of "
                f"{row.cosine:.2f} with the converged one"
            )
        return rows

    def _leave_out(self) -> None:
        before = self._problem.renderer.plan
        self._problem.renderer.plan, _ = self.chosen
        try:
            self.gains, self.bounces, self.texels = leaving_out(self._problem, self._config, self._progress)
        finally:
            self._problem.renderer.plan = before


def leaving_out(
    problem: Problem, config: AttackConfig, progress: Progress
) -> tuple[list[GainRow], PathLength, list[TexelRow]]:
    """Measure what leaving things out of a search's renders brings, and prove it safe.

    Returns:
        A row for each item and one for all; the path length and why; what is searched beyond what a pixel shows.
    """
    renderer, seed = problem.renderer, seeds.stream(config.seed, "leaving out")
    u = inside(renderer)

    def tick() -> None:
        progress.advance(1)

    hint = "`specialise=false` leaves it out"
    progress.stage("finding how many bounces of light matter", most_pictures(problem), hint=hint, at_most=True)
    bounces = bounces_of(problem, config.seed, tick=tick)
    progress.stage("measuring what leaving things out saves", most_gradients(), hint=hint, at_most=True)
    gains = measured_gains(renderer, problem.loss, u, seed=seed, spp=problem.spp, depth=bounces.depth, tick=tick)
    return gains, bounces, resolved_texels(renderer, u, seed=seed)


def quieter(tables: Mapping[str, Sequence[CosineRow]], asked: str) -> DenoiserAdvice:
    """Say which denoiser makes the better gradients: the one that reaches the goal in all controls in less time.

    A denoiser is part of the image formation, the same in search and verification, so that this is advice: another one
    is another question.

    Args:
        tables: denoiser to its measured cosines.
        asked: the run's.
    """

    def rank(name: str) -> tuple[bool, float]:
        best = [
            max((row for row in tables[name] if row.control == control), key=lambda row: row.cosine)
            for control in dict.fromkeys(row.control for row in tables[name])
        ]
        reached = all(row.status == "ok" for row in best)
        return not reached, sum(row.seconds for row in best) if reached else -min(row.cosine for row in best)

    measured = [name for name in tables if tables[name]]
    if len(measured) == 1 and len(tables) > 1:
        return DenoiserAdvice(asked=asked, advised=asked, reason="the other one was not measured")
    advised = min(measured, key=rank) if measured else asked
    reached = bool(measured) and not rank(advised)[0]
    why = (
        f"a cosine of {GOAL:g} in every control, in less time"
        if reached
        else "the greater cosine, though below the goal"
        if measured
        else "nothing was measured"
    )
    return DenoiserAdvice(asked=asked, advised=advised, reason=why)


def _limits() -> list[EstimatorLimit]:
    """What the material form does not cover, as it states itself."""
    from advsearch.scene.mitsuba_backend.material_form.adjoint import LIMITS

    return [EstimatorLimit.of(limit) for limit in LIMITS]


def _left_out(problem: Problem, used: set[str]) -> list[str]:
    """What a search with these estimators does not compute, in sentences."""
    said = []
    if not used & {"boundary", "guided", "material"}:
        said.append("boundary terms: nothing that an adjoint differentiates moves an outline")
    if not used & {"adjoint", "boundary", "guided", "material"}:
        said.append("adjoint renders: no coordinate needs one")
    if not used & BY_DIFFERENCES:
        said.append("renders for differences: every derivative is an adjoint or of the picture itself")
    if not problem.renderer.scene.volumetric:
        said.append("the volumetric integrator: there is no medium")
    return said
