"""Plans a search on its scene: how it differentiates, and what it leaves out. What `advsearch plan` does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from advsearch import seeds
from advsearch.api.attacking import problem_from_config
from advsearch.api.bounces import bounces_of
from advsearch.api.problem import Problem
from advsearch.config import AttackConfig
from advsearch.evaluation.gradients import inside
from advsearch.evaluation.leaving_out import measured_gains, resolved_texels, rows_of
from advsearch.evaluation.planning import GOAL, Cosine, cosines, measured_plan, tuned
from advsearch.progress import NullProgress, Progress
from advsearch.scene.plan import BY_DIFFERENCES


def plan(config: AttackConfig, *, progress: Progress | None = None) -> dict[str, Any]:
    """Choose how every derivative is obtained and what is left out, by measurement, and say why.

    Returns:
        The plan with its reasons, the cosines that chose steps and samples, the limits of the estimators, and what is
        left out with its gain and the proof that it is safe.
    """
    progress = progress or NullProgress()
    progress.stage("set-up")
    problem, _ = problem_from_config(config)
    renderer, seed = problem.renderer, seeds.stream(config.seed, "measure")
    u = inside(renderer)
    progress.stage("estimators")
    renderer.plan = measured_plan(renderer, problem.loss, u, seed=seed, spp=problem.spp, every=True)
    progress.stage("steps and samples")
    table = cosines(renderer, problem.loss, u, seed=seed)
    renderer.plan, spp = tuned(renderer.plan, table)
    progress.stage("the other denoiser")
    other = "none" if config.denoise == "oidn" else "oidn"
    theirs, _ = problem_from_config(config, denoise=other)
    theirs.plan = theirs.plan.with_estimator({one.name: one.estimator for one in renderer.plan.groups}, "as beside")
    tables = {config.denoise: table, other: cosines(theirs.renderer, theirs.loss, u, seed=seed)}
    problem.plan = renderer.plan
    dropped = leaving_out(problem, config, progress) if config.specialise else {}
    chosen = renderer.plan.to_dict()
    used = {group.estimator for group in renderer.plan.groups}
    return {
        "schema": 1,
        "command": "plan",
        "object": config.object,
        "environment": config.environment,
        "controls": list(config.controls),
        "model": problem.model.name,
        "image_formation": renderer.formation.summary(),
        **chosen,
        "spp": spp or problem.spp,
        "cosines": [{"denoise": name, **vars(row)} for name, rows in tables.items() for row in rows],
        "denoise": quieter(tables, config.denoise),
        "left_out": _left_out(problem) if config.specialise else [],
        "specialised": config.specialise,
        **dropped,
        "limits": _limits() if "material" in used else [],
    }


def leaving_out(problem: Problem, config: AttackConfig, progress: Progress) -> dict[str, Any]:
    """Measure what leaving things out of a search's renders brings, and prove it safe.

    Returns:
        "gains": a row for each item and one for all; "bounces": the path length and why; "texels": what is searched
        beyond what a pixel shows.
    """
    renderer, seed = problem.renderer, seeds.stream(config.seed, "leaving out")
    u = inside(renderer)
    progress.stage("bounces")
    bounces = bounces_of(problem, config.seed)
    progress.stage("what is left out")
    gains = measured_gains(
        renderer,
        problem.loss,
        u,
        seed=seed,
        spp=problem.spp,
        depth=bounces.depth,
        tick=lambda: progress.advance(1),
    )
    return {
        "gains": rows_of(gains),
        "bounces": {**vars(bounces), "cuts": [vars(cut) for cut in bounces.cuts], "reason": bounces.reason},
        "texels": [vars(one) for one in resolved_texels(renderer, u, seed=seed)],
    }


def quieter(tables: Mapping[str, Sequence[Cosine]], asked: str) -> dict[str, str]:
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
    advised = min(measured, key=rank) if measured else asked
    reached = bool(measured) and not rank(advised)[0]
    why = (
        f"a cosine of {GOAL:g} in every control, in less time"
        if reached
        else "the greater cosine, though below the goal"
        if measured
        else "nothing was measured"
    )
    return {"asked": asked, "advised": advised, "reason": why}


def _limits() -> list[Any]:
    """What the material form does not cover, as it states itself."""
    from advsearch.scene.material_form import LIMITS

    return [vars(limit) if hasattr(limit, "__dict__") else str(limit) for limit in LIMITS]


def _left_out(problem: Problem) -> list[str]:
    """What this search does not compute, in sentences."""
    used = {group.estimator for group in problem.renderer.plan.groups}
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
