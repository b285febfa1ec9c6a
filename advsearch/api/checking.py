"""Checks gradients of a scene as it is: what `advsearch check` does."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from advsearch import seeds
from advsearch.api.attacking import problem_from_config
from advsearch.api.naming import run_settings_for
from advsearch.api.problem import Problem
from advsearch.config import AttackConfig
from advsearch.controls import CONTROLS
from advsearch.evaluation.gradients import (
    EXPENSIVE,
    FACTORS,
    Estimate,
    Loss,
    Probe,
    Reference,
    estimates,
    inside,
    probes,
    reference,
    scale_of,
    smooth_loss,
    verdict,
)
from advsearch.evaluation.planning import CONVERGED, COUNTS, cosines, measured_plan, tuned
from advsearch.progress import NullProgress, Progress
from advsearch.scene.description import DEFAULT_ENVIRONMENT
from advsearch.scene.plan import STEP_RANGE, GroupPlan

SCENES = (("mug", "studio"), ("bowl", "kitchen"), ("bottle", "noon"))
"""Bundled scenes that `check --all` goes through."""
LOSSES = ("linear", "model")
RAW_SPP = 16
"""Samples a pixel of a working gradient of the linear loss, which is taken without denoiser."""
MOST = 256
"""Samples a pixel of the dearest gradient of the model's loss that is tried; `advsearch plan` stops before."""
REFERENCE_SPP, SEEDS = 64, (6, 16)
"""Samples a pixel of a reference render, and how many seeds it gets: until its noise is small."""
FEW_SEEDS = (3, 6)
"""Seeds of a reference of the model's loss, whose renders have more samples."""
WHOLE = "*"
"""What stands for the parameter in rows about a whole control."""
REPEATS, AGAIN = 6, 8
"""Gradients of one estimator, from which its mean and its noise come; and of one with a wider step."""


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
        One row for each parameter, estimator and loss, as DESIGN section 6 lists them. For the model's loss the
        estimator, the step and the samples are those that reach the goal soonest, and rows with `WHOLE` for their
        parameter have the cosine of a control's working gradients with the converged one.
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


# ---- inside ---------------------------------------------------------------------------------------------------------


def _configurations(config: AttackConfig, everything: bool) -> Iterator[AttackConfig]:
    if not everything:
        yield config
        return
    for object, environment in SCENES:
        for control in CONTROLS:
            if control == "contents" and object == "bottle":
                continue  # a bottle is closed
            if control == "sky" and environment != DEFAULT_ENVIRONMENT:
                continue  # a sky takes the place of the environment
            update: dict[str, Any] = {
                "object": object,
                "environment": environment,
                "controls": {control: {}},
                "label": None,
                **run_settings_for(config, control, {}),
            }
            yield config.model_copy(update=update)


def _linear(config: AttackConfig, progress: Progress) -> list[dict[str, Any]]:
    problem, _ = problem_from_config(config, denoise="none")
    problem.renderer.formation = replace(problem.renderer.formation, transfer="linear")
    loss = smooth_loss(problem.renderer.formation.resolution, config.seed)
    return _rows(
        problem,
        config,
        loss,
        "linear",
        config.spp if isinstance(config.spp, int) else RAW_SPP,
        progress,
        tried=attempts,
        high=REFERENCE_SPP,
        repeats=SEEDS,
        factors=FACTORS[:2],
    )


def _model(config: AttackConfig, progress: Progress) -> list[dict[str, Any]]:
    problem, _ = problem_from_config(config)
    renderer, u = problem.renderer, inside(problem.renderer)
    counts = tuple(count for count in (*COUNTS, MOST) if count >= problem.spp) or (problem.spp,)
    measuring = seeds.stream(config.seed, "measure")
    renderer.plan = measured_plan(renderer, problem.loss, u, seed=measuring, spp=problem.spp, counted=True)
    steps = {group.name: group.step for group in renderer.plan.groups}
    table = cosines(renderer, problem.loss, u, seed=config.seed, counts=counts)
    renderer.plan, spp = tuned(renderer.plan, table)
    rows = []
    for row in table:
        progress.advance(1)
        taken = [group.estimator for group in renderer.plan.groups if group.control == row.control]
        names = {"parameter": WHOLE, "estimator": ", ".join(dict.fromkeys(taken))}
        rows.append({**_place(config, "model"), **vars(row), **names, "status": row.status})
    single = _rows(
        problem,
        config,
        problem.loss,
        "model",
        spp or problem.spp,
        progress,
        tried=lambda group: [(group.estimator, 1.0)],
        high=CONVERGED,
        repeats=FEW_SEEDS,
        factors=(1.0,),
    )
    wider = {group.name: group.step / steps[group.name] for group in renderer.plan.groups if steps[group.name]}
    for one in single:
        group = f"{one['control']}.{one['parameter'].partition('.')[0]}"  # coordinates of one have a number behind it
        one["factor"] = one["reference_factor"] = wider.get(group, 1.0)
    return rows + single


def _rows(
    problem: Problem,
    config: AttackConfig,
    loss: Loss,
    name: str,
    spp: int,
    progress: Progress,
    *,
    tried: Callable[[GroupPlan], list[tuple[str, float]]],
    high: int,
    repeats: tuple[int, int],
    factors: Sequence[float],
) -> list[dict[str, Any]]:
    """Rows of single parameters, with references of `high` samples, so many seeds, and steps so many times as wide."""
    renderer, seed = problem.renderer, seeds.stream(config.seed, "check")
    u = inside(renderer)
    along = probes(renderer, loss, u, seed, spp)
    references = {
        probe.name: reference(
            renderer,
            loss,
            u,
            probe,
            seed=seed,
            # what acts on the picture clips: its mean depends on the noise, so both get the same
            spp=spp if probe.group.estimator == "image" else max(spp, high),
            repeats=repeats,
            factors=factors,
        )
        for probe in along
    }
    found = []
    for group in _sets(along):
        beside = [references[one.name] for one in along if one.group.control == group[0].group.control]
        good: set[str] = set()
        for estimator, factor in tried(group[0].group):
            wanted = group if factor == 1.0 else [one for one in group if one.name not in good]
            if not wanted:
                break
            many = REPEATS if factor == 1.0 else AGAIN  # another try has to be surer
            measured = estimates(renderer, loss, u, estimator, wanted, seed=seed, spp=spp, repeats=many, factor=factor)
            for probe, estimate in zip(wanted, measured, strict=True):
                against = references[probe.name]
                row = _row(probe, estimate, against, scale_of(against, beside))
                good |= {probe.name} if row["status"] == "ok" else set()
                found.append({**_place(config, name), **row, "spp": spp})
                progress.advance(1)
    return found


def attempts(group: GroupPlan) -> list[tuple[str, float]]:
    """Estimators to measure on a group, with the multiple of the step; other steps for what falls short with the first.

    Differences of the loss and of the picture are the same for a linear loss, so that wider steps are tried with one.
    """
    forced = "forced" in group.reason
    names = [group.estimator] if forced else [one for one in group.valid if one not in EXPENSIVE]
    wide = next((one for one in ("differences", "secant", "forward") if one in names), None)
    found = [(one, 1.0) for one in names]
    if wide is None:
        return found
    tried = {group.step}
    for factor in FACTORS[1:]:
        step = min(factor * group.step, STEP_RANGE[1])
        if step not in tried:
            tried.add(step)
            found.append((wide, factor))
    return found


def _row(probe: Probe, estimate: Estimate, against: Reference, size: float) -> dict[str, Any]:
    status, error = verdict(estimate, against, size)
    return {
        "control": probe.group.control,
        "parameter": probe.name.partition(".")[2],
        "estimator": estimate.estimator,
        "factor": estimate.factor,
        "gradient": estimate.value,
        "reference": against.value,
        "reference_steps": list(against.steps),
        "reference_factor": against.factor,
        "reference_noise": against.noise,
        "relative_error": error,
        "noise": estimate.noise / size if size else float("inf"),
        "seconds": estimate.seconds,
        "status": status,
    }


def _sets(found: Sequence[Probe]) -> list[list[Probe]]:
    """Probes that one gradient answers together: of one control, with the same valid estimators."""
    sets: dict[tuple[str, tuple[str, ...], str], list[Probe]] = {}
    for probe in found:
        sets.setdefault((probe.group.control, probe.group.valid, probe.group.estimator), []).append(probe)
    return list(sets.values())


def _place(config: AttackConfig, loss: str) -> dict[str, Any]:
    return {"object": config.object, "environment": config.environment, "loss": loss}
