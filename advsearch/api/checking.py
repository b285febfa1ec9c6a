"""Checks gradients of a scene as it is: what `advsearch check` does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
from advsearch.evaluation.planning import COUNTS, cosines
from advsearch.progress import NullProgress, Progress

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
        rows.append({**_place(config, "model"), **vars(row), "parameter": "*", "status": row.status})
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
