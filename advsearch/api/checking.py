"""Checks and plans gradients of a scene as it is: what `advsearch check` and `advsearch plan` do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from advsearch import seeds
from advsearch.api.attacking import problem_from_config
from advsearch.api.problem import Problem
from advsearch.config import AttackConfig
from advsearch.controls import CONTROLS
from advsearch.evaluation.gradients import (
    EXPENSIVE,
    Loss,
    Probe,
    estimates,
    inside,
    probes,
    reference,
    scale_of,
    smooth_loss,
    verdict,
)
from advsearch.evaluation.planning import COUNTS, GOAL, Cosine, cosines, measured_plan, tuned
from advsearch.progress import NullProgress, Progress
from advsearch.scene.plan import BY_DIFFERENCES, ESTIMATORS

SCENES = (("mug", "studio"), ("bowl", "kitchen"), ("bottle", "noon"))
"""Bundled scenes that `check --all` goes through."""
LOSSES = ("linear", "model")
RAW_SPP = 16
"""Samples a pixel of a working gradient of the linear loss, which is taken without denoiser."""
REFERENCE_SPP = 64
"""Samples a pixel of a reference render; seeds are added until the reference's noise is small."""


def check(
    config: AttackConfig, *, losses: Sequence[str] = LOSSES, everything: bool = False, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """Compare the gradient of every parameter with differences, on the actual scene.

    Args:
        config: scene, model, controls, resolution, samples and seed.
        losses: "linear", a smooth linear loss of the raw picture before the tone curve; "model", the model's own loss
            in the run's image formation.
        everything: every control, on each of `SCENES`.
        progress: told how far it is.

    Returns:
        One row for each parameter, estimator and loss, as DESIGN section 6 lists them, and for the model's loss one
        row for each control with the cosine of a working gradient with the converged one.
    """
    progress = progress or NullProgress()
    rows: list[dict[str, Any]] = []
    for one in _configurations(config, everything):
        progress.stage(f"{one.object} in {one.environment}: {', '.join(one.controls)}")
        if "linear" in losses:
            rows += _linear(one, progress)
        if "model" in losses:
            rows += _model(one, progress)
    return rows


def plan(config: AttackConfig, *, progress: Progress | None = None) -> dict[str, Any]:
    """Choose how every derivative is obtained, by measurement, and say why.

    Returns:
        The plan with its reasons, the cosines that chose steps and samples, and the limits of the estimators.
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
        "left_out": _left_out(problem),
        "limits": _limits() if "material" in used else [],
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
        reached = all(min(row.cosine, row.converged) >= GOAL for row in best)
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


# ---- inside ---------------------------------------------------------------------------------------------------------


def _configurations(config: AttackConfig, everything: bool) -> Iterator[AttackConfig]:
    if not everything:
        yield config
        return
    for object, environment in SCENES:
        for control in CONTROLS:
            if control == "contents" and object == "bottle":
                continue  # a bottle is closed
            update: dict[str, Any] = {
                "object": object,
                "environment": environment,
                "controls": {control: {}},
                "label": None,
            }
            yield config.model_copy(update=update)


def _linear(config: AttackConfig, progress: Progress) -> list[dict[str, Any]]:
    problem, _ = problem_from_config(config, denoise="none")
    problem.renderer.formation = replace(problem.renderer.formation, transfer="linear")
    loss = smooth_loss(problem.renderer.formation.resolution, config.seed)
    return _rows(problem, config, loss, "linear", config.spp if isinstance(config.spp, int) else RAW_SPP, progress)


def _model(config: AttackConfig, progress: Progress) -> list[dict[str, Any]]:
    problem, _ = problem_from_config(config)
    renderer = problem.renderer
    counts = tuple(count for count in COUNTS if count >= problem.spp) or (problem.spp,)
    table = cosines(renderer, problem.loss, inside(renderer), seed=config.seed, counts=counts)
    rows = []
    for row in table:
        progress.advance(1)
        status = "ok" if row.cosine >= 0.9 else "reference unusable" if row.converged < 0.9 else "noisy"
        rows.append({**_place(config, "model"), **vars(row), "parameter": "*", "status": status})
    return rows


def _rows(
    problem: Problem, config: AttackConfig, loss: Loss, name: str, spp: int, progress: Progress
) -> list[dict[str, Any]]:
    renderer, seed = problem.renderer, seeds.stream(config.seed, "check")
    u = inside(renderer)
    found = []
    for group in _sets(probes(renderer, loss, u, seed, spp)):
        on_picture = group[0].group.estimator == "image"  # clips: its mean depends on the noise, so both get the same
        high = spp if on_picture else max(spp, REFERENCE_SPP)
        references = [reference(renderer, loss, u, one, seed=seed, spp=high) for one in group]
        forced = "forced" in group[0].group.reason
        wanted = [group[0].group.estimator] if forced else [one for one in group[0].group.valid if one not in EXPENSIVE]
        for estimator in wanted:
            measured = estimates(renderer, loss, u, estimator, group, seed=seed, spp=spp)
            for probe, against, estimate in zip(group, references, measured, strict=True):
                size = scale_of(against, references)
                status, error = verdict(estimate, against, size)
                found.append(
                    {
                        **_place(config, name),
                        "control": probe.group.control,
                        "parameter": probe.name.partition(".")[2],
                        "estimator": estimator,
                        "gradient": estimate.value,
                        "reference": against.value,
                        "reference_steps": list(against.steps),
                        "reference_noise": against.noise,
                        "relative_error": error,
                        "noise": estimate.noise / size if size else float("inf"),
                        "spp": spp,
                        "seconds": estimate.seconds,
                        "status": status,
                    }
                )
                progress.advance(1)
    return found


def _sets(found: Sequence[Probe]) -> list[list[Probe]]:
    """Probes that one gradient answers together: of one control, with the same valid estimators."""
    sets: dict[tuple[str, tuple[str, ...], str], list[Probe]] = {}
    for probe in found:
        sets.setdefault((probe.group.control, probe.group.valid, probe.group.estimator), []).append(probe)
    return list(sets.values())


def _place(config: AttackConfig, loss: str) -> dict[str, Any]:
    return {"object": config.object, "environment": config.environment, "loss": loss}


__all__ = ["ESTIMATORS", "check", "plan"]
