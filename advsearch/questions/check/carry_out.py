"""Checks gradients of a scene as it is: what `advsearch check` does."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from typing_extensions import Unpack

from advsearch import seeds
from advsearch.api.keywords import asks, configured
from advsearch.controls import CONTROLS
from advsearch.engine.attack_parts import LOADING, problem_from_config
from advsearch.engine.gradients import (
    FACTORS,
    Estimate,
    Loss,
    Probe,
    Reference,
    agreement,
    estimates,
    inside,
    probes,
    reference,
    smooth_loss,
)
from advsearch.engine.loading import Scene
from advsearch.engine.naming import AnyModel, settings_alone
from advsearch.engine.planning import CONVERGED, COUNTS, cosine_samples, cosines, measured_plan, plan_gradients, tuned
from advsearch.engine.problem import Problem
from advsearch.engine.record import Results, kept_rows
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.check.answer import (
    WHOLE,
    CheckedPlace,
    CheckedRow,
    CheckedRows,
    CheckResult,
    DerivativeRow,
    DirectionRow,
)
from advsearch.questions.check.settings import CheckConfig
from advsearch.questions.plan.carry_out import PlanKeywords
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results.base import CosineRow
from advsearch.scene.description import DEFAULT_ENVIRONMENT
from advsearch.scene.gradients import STEP_RANGE, Group, compared


class CheckKeywords(PlanKeywords, total=False):
    """Of `check`."""

    all: bool
    loss: Literal["linear", "model", "both"]


SCENES = (("mug", "studio"), ("bowl", "kitchen"), ("bottle", "noon"))
"""Bundled scenes that `check --all` goes through."""
RAW_SPP = 16
"""Samples a pixel of a working gradient of the linear loss, which is taken without denoiser."""
MOST = 256
"""Samples a pixel of the dearest gradient of the model's loss that is tried; `advsearch plan` stops before."""
REFERENCE_SPP, SEEDS = 64, (6, 16)
"""Samples a pixel of a reference render, and how many seeds it gets: until its noise is small."""
FEW_SEEDS = (3, 6)
"""Seeds of a reference of the model's loss, whose renders have more samples."""
REPEATS, AGAIN = 6, 8
"""Gradients of one estimator, from which its mean and its noise come; and of one with a wider step."""
IN_SAMPLES = "counted in samples a pixel; `resolution` or fewer controls shorten it, `seconds` ends it"
IN_PARAMETERS = "one for each parameter; `resolution` or fewer controls shorten it, `seconds` ends it"
"""What whoever waits is told of the long stages."""


@asks(CheckConfig, CheckKeywords)
def check(
    object: Scene | str | Path = "mug",
    model: AnyModel = "reference",
    *,
    progress: Watched = None,
    **settings: Unpack[CheckKeywords],
) -> CheckResult:
    """Compare the gradient of every parameter of a scene with differences (docs/gradients.md)."""
    config = configured(CheckConfig, object=object, model=model, **settings)
    return check_from_config(config, progress=watcher(progress))


def check_from_config(
    config: CheckConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> CheckResult:
    """Do what a configuration describes, or go on with it, and keep it in a run directory; see `check`.

    What is measured is stored at once, so that a check that was stopped, by Ctrl-C, by a kill or because its `seconds`
    were over, goes on where it was and ends with the same rows; only times differ.
    """
    progress, begun = progress or NullProgress(), time.perf_counter()
    progress.stage(LOADING)
    parts = parts_of(config)
    with RunDirectory.of(config, resumed) as run:
        results, measured = Results(run, config.seconds), 0

        def rows() -> Iterator[CheckedRow]:
            nonlocal measured
            for part in parts:
                yield from _rows_of(part, len(parts), results, progress)
                measured += 1

        def result(rows: Sequence[CheckedRow], ending: str) -> CheckResult:
            return CheckResult(
                run=str(run.path),
                object=",".join(dict.fromkeys(part.config.object for part in parts)),
                environment=",".join(dict.fromkeys(part.config.lit_by for part in parts)),
                controls=list(dict.fromkeys(name for part in parts for name in part.config.controls)),
                ending=ending,
                measured=measured,
                planned=len(parts),
                rows=list(rows),
                seconds={"total": time.perf_counter() - begun},
                seed=config.seed,
                command_line=config.command_line(),
            )

        return kept_rows(run, results, rows(), result)


@dataclass(frozen=True)
class CheckedPart:
    """One scene with its controls and one loss ("linear" or "model"): what is checked in one go; numbered from 1."""

    number: int
    config: CheckConfig
    loss: str

    @property
    def key(self) -> str:
        """Under which its results are stored."""
        return f"check {self.number}"


def parts_of(config: CheckConfig) -> list[CheckedPart]:
    asked = [(one, loss) for one in _configurations(config) for loss in config.losses]
    return [CheckedPart(number, one, loss) for number, (one, loss) in enumerate(asked, start=1)]


def _configurations(config: CheckConfig) -> Iterator[CheckConfig]:
    if not config.all:
        yield config
        return
    for object, environment in SCENES:
        for control in CONTROLS:
            if not CONTROLS[control].parameters:
                continue  # the scene names them
            if control == "contents" and object == "bottle":
                continue  # a bottle is closed
            if control == "sky" and environment != DEFAULT_ENVIRONMENT:
                continue  # a sky takes the place of the environment
            yield config.model_copy(
                update={
                    "object": object,
                    "environment": None if environment == DEFAULT_ENVIRONMENT else environment,
                    "controls": {control: {}},
                    "label": None,
                    **settings_alone(config, control, {}),
                }
            )


def _rows_of(part: CheckedPart, parts: int, results: Results, progress: Progress) -> Iterator[CheckedRow]:
    """The rows of a part, as they come; of one that was measured before, without loading anything."""
    stored = results.stored(part.key)
    if stored is not None:
        yield from CheckedRows.of({"rows": stored}).rows
        return
    config = part.config
    what = f"{config.object} in {config.lit_by}, {' and '.join(config.controls)}"
    title = f"{what} ({part.number} of {parts})" if parts > 1 else what
    progress.stage(f"loading {title}")
    rows = []
    for row in (_linear if part.loss == "linear" else _model)(part, title, results, progress):
        rows.append(row.to_dict())
        yield row
        progress.message(_line(row))  # whoever reads it can stop the check and find the row kept
    results.put(part.key, rows)


def _line(row: CheckedRow) -> str:
    how = f"cosine {row.cosine:.2f}" if isinstance(row, DirectionRow) else f"{row.gradient:.3g}"
    return f"{row.object}, {row.name} by {row.estimator}: {how}, {row.status}"


def _linear(part: CheckedPart, title: str, results: Results, progress: Progress) -> Iterator[DerivativeRow]:
    config = part.config
    problem, _ = problem_from_config(config, denoise="none")
    problem.renderer.formation = replace(problem.renderer.formation, transfer="linear")
    problem.renderer.plan = problem.renderer.plan.at_a_pixel()
    loss = smooth_loss(problem.renderer.formation.resolution, config.seed)
    yield from _rows(
        problem,
        part,
        title,
        loss,
        config.spp if isinstance(config.spp, int) else RAW_SPP,
        results,
        progress,
        tried=attempts,
        high=REFERENCE_SPP,
        repeats=SEEDS,
        factors=FACTORS[:2],
    )


def _model(part: CheckedPart, title: str, results: Results, progress: Progress) -> Iterator[CheckedRow]:
    config = part.config
    problem, _ = problem_from_config(config)
    renderer, u = problem.renderer, inside(problem.renderer)
    counts = tuple(count for count in (*COUNTS, MOST) if count >= problem.spp) or (problem.spp,)

    def kept(name: str, measure: Callable[[], Any]) -> Any:
        return results.get(f"{part.key} {name}", measure)

    progress.stage(f"{title}: comparing ways to differentiate", plan_gradients(renderer.plan))
    renderer.plan = measured_plan(
        renderer,
        problem.loss,
        u,
        seed=seeds.stream(config.seed, "measure"),
        spp=problem.spp,
        counted=True,
        tick=lambda: progress.advance(1),
        keep=kept,
    )
    steps = {group.name: group.step for group in renderer.plan.groups}
    most = cosine_samples(renderer.plan, counts=counts)
    progress.stage(f"{title}: the model's gradients", most, hint=IN_SAMPLES, at_most=True)
    table: list[CosineRow] = []
    tick = progress.advance
    for row in cosines(renderer, problem.loss, u, seed=config.seed, counts=counts, tick=tick, keep=kept):
        table.append(row)
        taken = [group.estimator for group in renderer.plan.groups if group.control == row.control]
        names = ", ".join(dict.fromkeys(taken))
        yield DirectionRow(
            **vars(_place(part)), **row.model_dump(exclude={"denoise"}), parameter=WHOLE, estimator=names
        )
    renderer.plan, spp = tuned(renderer.plan, table)
    wider = {group.name: group.step / steps[group.name] for group in renderer.plan.groups if steps[group.name]}
    for one in _rows(
        problem,
        part,
        title,
        problem.loss,
        spp or problem.spp,
        results,
        progress,
        tried=lambda group: [(group.estimator, 1.0)],
        high=CONVERGED,
        repeats=FEW_SEEDS,
        factors=(1.0,),
    ):
        group = f"{one.control}.{one.parameter.partition('.')[0]}"  # coordinates of one have a number behind it
        factor = wider.get(group, 1.0)
        yield one.model_copy(update={"factor": factor, "reference_factor": factor})


def _rows(
    problem: Problem,
    part: CheckedPart,
    title: str,
    loss: Loss,
    spp: int,
    results: Results,
    progress: Progress,
    *,
    tried: Callable[[Group], list[tuple[str, float]]],
    high: int,
    repeats: tuple[int, int],
    factors: Sequence[float],
) -> Iterator[DerivativeRow]:
    """Rows of single parameters, with references of `high` samples, so many seeds, and steps so many times as wide."""
    renderer, seed = problem.renderer, seeds.stream(part.config.seed, "check")
    u = inside(renderer)
    progress.stage(f"{title}: choosing directions")
    along = probes(renderer, loss, u, seed, spp)
    for control in dict.fromkeys(probe.group.control for probe in along):
        mine = [probe for probe in along if probe.group.control == control]
        progress.stage(f"{title}: references for {control}", len(mine), hint=IN_PARAMETERS)
        references: dict[str, Reference] = {}
        for probe in mine:

            def referred(probe: Probe = probe) -> Reference:
                # what acts on the picture clips: its mean depends on the noise, so both get the same
                many = spp if probe.group.estimator == "image" else max(spp, high)
                return reference(renderer, loss, u, probe, seed=seed, spp=many, repeats=repeats, factors=factors)

            references[probe.name] = results.value(_key(part, "reference", [probe]), Reference, referred)
            progress.advance(1)
        sets = _sets(mine)
        most = sum(len(tried(group[0].group)) for group in sets)
        progress.stage(f"{title}: gradients for {control}", most, hint=f"{REPEATS} by each estimator", at_most=True)
        for group in sets:
            good: set[str] = set()
            for estimator, factor in tried(group[0].group):
                wanted = group if factor == 1.0 else [one for one in group if one.name not in good]
                if not wanted:
                    break

                def estimated(
                    wanted: Sequence[Probe] = wanted, estimator: str = estimator, factor: float = factor
                ) -> list[Estimate]:
                    many = REPEATS if factor == 1.0 else AGAIN  # another try has to be surer
                    return estimates(
                        renderer, loss, u, estimator, wanted, seed=seed, spp=spp, repeats=many, factor=factor
                    )

                key = _key(part, f"{estimator} x {factor:g}", wanted)
                for probe, one in zip(wanted, results.value(key, list[Estimate], estimated), strict=True):
                    row = _row(part, spp, probe, one, references[probe.name], list(references.values()))
                    good |= {probe.name} if row.status == "ok" else set()
                    yield row
                progress.advance(1)


def _key(part: CheckedPart, what: str, along: Sequence[Probe]) -> str:
    return f"{part.key} {what} {','.join(probe.name for probe in along)}"


def attempts(group: Group) -> list[tuple[str, float]]:
    """Estimators to measure on a group, with the multiple of the step; other steps for what falls short with the first.

    Differences of the loss and of the picture are the same for a linear loss, so that wider steps are tried with one.
    """
    forced = "forced" in group.reason
    names = [group.estimator] if forced else [*compared(group.valid, group.size)]
    wide = next((one for one in ("differences", "secant") if one in names), None)
    tries = [(one, 1.0) for one in names]
    if wide is None:
        return tries
    tried = {group.step}
    for factor in FACTORS[1:]:
        step = min(factor * group.step, STEP_RANGE[1])
        if step not in tried:
            tried.add(step)
            tries.append((wide, factor))
    return tries


def _row(
    part: CheckedPart, spp: int, probe: Probe, estimate: Estimate, against: Reference, beside: Sequence[Reference]
) -> DerivativeRow:
    judged = agreement(estimate, against, beside)
    return DerivativeRow(
        **vars(_place(part)),
        control=probe.group.control,
        parameter=probe.name.partition(".")[2],
        estimator=estimate.estimator,
        factor=estimate.factor,
        spp=spp,
        gradient=estimate.value,
        reference=against.value,
        reference_steps=against.steps,
        reference_factor=against.factor,
        reference_noise=against.noise,
        relative_error=judged.error,
        noise=judged.noise,
        seconds=estimate.seconds,
        status=judged.status,
    )


def _sets(along: Sequence[Probe]) -> list[list[Probe]]:
    """Probes that one gradient answers together: of one control, with the same valid estimators."""
    sets: dict[tuple[str, tuple[str, ...], str], list[Probe]] = {}
    for probe in along:
        sets.setdefault((probe.group.control, probe.group.valid, probe.group.estimator), []).append(probe)
    return list(sets.values())


def _place(part: CheckedPart) -> CheckedPlace:
    return CheckedPlace(object=part.config.object, environment=part.config.lit_by, loss=part.loss)
