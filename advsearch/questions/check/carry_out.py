"""Checks gradients of a scene as it is, and plans a search over it: what `advsearch check` does."""

from __future__ import annotations

import math
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from pydantic import TypeAdapter
from torch import Tensor

from advsearch import seeds
from advsearch.controls import CONTROLS
from advsearch.engine import planning
from advsearch.engine.gradients import FACTORS, Bench, Loss, attempts, inside, smooth_loss
from advsearch.engine.naming import settings_alone
from advsearch.engine.problem import Problem
from advsearch.engine.record import Results, taken_rows
from advsearch.experiment import RunContext
from advsearch.progress import Progress
from advsearch.questions.attack.carry_out import LOADING, problem_from_config
from advsearch.questions.check.result import CheckConfig, CheckedRow, CheckResult, GainRow, SearchPlan, TexelRow
from advsearch.runs.results import Measured, PathLength
from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.description import DEFAULT_ENVIRONMENT
from advsearch.scene.formation import EVERYTHING, ITEMS, NOTHING
from advsearch.scene.gradients import BY_ADJOINT, BY_DIFFERENCES
from advsearch.scene.mitsuba_backend.material_adjoint import LIMITS
from advsearch.scene.renderer import Renderer

SCENES = (("mug", "studio"), ("bowl", "kitchen"), ("bottle", "noon"))  # bundled scenes that `check --all` goes through
RAW_SPP = 16  # samples a pixel of a working gradient of the linear loss, which is taken without denoiser
MOST = 256  # samples a pixel of the dearest gradient of the model's loss that is tried
REFERENCE_SPP, SEEDS = 64, (6, 16)
"""Samples a pixel of a reference render, and how many seeds it gets: until its noise is small."""
FEW_SEEDS = (3, 6)  # seeds of a reference of the model's loss, whose renders have more samples
HINT = "`resolution` or fewer controls shorten it, `seconds` ends it"
Finding = CheckedRow | SearchPlan | PathLength | GainRow | TexelRow
FINDINGS: TypeAdapter[list[Finding]] = TypeAdapter(list[Finding])


def checked(asked: RunContext[CheckConfig]) -> CheckResult:
    """Do what is asked, or go on with it. What is measured is stored at once, so that a check that was stopped goes on
    where it was and ends with the same rows; only times differ."""
    progress = asked.progress
    progress.stage(LOADING)
    parts, measured = parts_of(asked.config), 0
    results, configs = Results(asked.run, asked.config.seconds), [part.config for part in parts]

    def findings() -> Iterator[Finding]:
        nonlocal measured
        for part in parts:
            if (stored := results.stored(part.key)) is not None:  # measured before: nothing is loaded
                yield from FINDINGS.validate_python(stored)
            else:
                title = f"{part.config.object} in {part.config.lit_by}, {' and '.join(part.config.controls)}"
                title += f" ({part.number} of {len(parts)})" if len(parts) > 1 else ""
                progress.stage(f"loading {title}")
                taken, find = [], _linear if part.loss == "linear" else _model
                for finding in find(part, title, results, progress):
                    taken.append(finding.to_dict())
                    yield finding
                    if isinstance(finding, CheckedRow):  # whoever reads it can stop the check and find the row kept
                        how = f"{finding.value:.3g}" if finding.cosine is None else f"cosine {finding.cosine:.2f}"
                        what = f"{finding.object}, {finding.name} by {finding.estimator}"
                        progress.message(f"{what}: {how}, {finding.status}")
                results.put(part.key, taken)
            measured += 1

    def result(taken: list[Finding]) -> CheckResult:
        def those(kind: type[Any]) -> list[Any]:
            return [row for row in taken if isinstance(row, kind)]

        return asked.result(
            CheckResult,
            object=",".join(dict.fromkeys(config.object for config in configs)),
            environment=",".join(dict.fromkeys(config.lit_by for config in configs)),
            controls=list(dict.fromkeys(name for config in configs for name in config.controls)),
            measured=measured, planned=len(parts), rows=those(CheckedRow),
            plan=next(iter(those(SearchPlan)), None), bounces=next(iter(those(PathLength)), None),
            gains=those(GainRow), texels=those(TexelRow),
        )  # fmt: skip

    return taken_rows(asked, results, findings(), result)


@dataclass(frozen=True)
class CheckedPart:
    """One scene with its controls and one loss ("linear" or "model"): what is checked in one go; numbered from 1."""

    number: int
    config: CheckConfig
    loss: str

    @property
    def key(self) -> str:
        return f"check {self.number}"

    def row(self, measured: Measured, **more: Any) -> CheckedRow:
        place = {"object": self.config.object, "environment": self.config.lit_by, "loss": self.loss}
        return CheckedRow(**{**vars(measured), **place, **more})


def parts_of(config: CheckConfig) -> list[CheckedPart]:
    configs = []
    for object, environment in SCENES if config.all else ():
        own = environment == DEFAULT_ENVIRONMENT
        left_out = ["contents"] * (object == "bottle") + ["sky"] * (not own)  # it is closed; it would take its place
        for control, kind in CONTROLS.items():
            if kind.parameters and control not in left_out:  # of one without, the scene names them
                place = {"object": object, "environment": None if own else environment, "label": None}
                alone = {"controls": {control: {}}, **settings_alone(config, control, {})}
                configs.append(config.model_copy(update={**place, **alone}))
    asked = [(each, loss) for each in configs or [config] for loss in config.losses]
    return [CheckedPart(number, each, loss) for number, (each, loss) in enumerate(asked, start=1)]


def _linear(part: CheckedPart, title: str, results: Results, progress: Progress) -> Iterator[CheckedRow]:
    config = part.config
    problem, _ = problem_from_config(config, denoise="none")
    problem.renderer.formation = replace(problem.renderer.formation, transfer="linear")
    problem.renderer.plan = problem.renderer.plan.at_a_pixel()
    loss = smooth_loss(problem.renderer.formation.resolution, config.seed)
    bench = _bench(part, problem.renderer, loss, results, progress)
    bench = replace(bench, spp=config.spp if isinstance(config.spp, int) else RAW_SPP)
    for row in bench.derivatives(
        reference_spp=REFERENCE_SPP, seeds_of_reference=SEEDS, reference_factors=FACTORS[:2], tried=attempts,
        stage=partial(_stage, title, progress),
    ):  # fmt: skip
        yield part.row(row)


def _model(part: CheckedPart, title: str, results: Results, progress: Progress) -> Iterator[Finding]:
    config = part.config
    problem, _ = problem_from_config(config)
    renderer = problem.renderer
    counts = tuple(count for count in (*planning.COUNTS, MOST) if count >= problem.spp) or (problem.spp,)
    bench = replace(_bench(part, renderer, problem.loss, results, progress), spp=problem.spp)
    progress.stage(f"{title}: comparing ways to differentiate", planning.plan_gradients(renderer.plan), hint=HINT)
    renderer.plan = planning.measured_plan(replace(bench, seed=seeds.stream(config.seed, "measure")), counted=True)
    steps = {group.name: group.step for group in renderer.plan.groups}
    most = planning.cosine_samples(renderer.plan, counts=counts)
    progress.stage(f"{title}: the model's gradients", most, hint=f"counted in samples a pixel; {HINT}", at_most=True)
    table = list[Measured]()
    for row in planning.cosines(replace(bench, seed=config.seed, tick=progress.advance), counts=counts):
        table.append(row)
        yield part.row(row)
    renderer.plan, spp = planning.tuned(renderer.plan, table)
    if not config.all:
        yield from _planned(problem, part, spp or problem.spp, results, progress)
    wider = {group.name: group.step / steps[group.name] for group in renderer.plan.groups if steps[group.name]}
    for row in replace(bench, spp=spp or problem.spp).derivatives(
        reference_spp=planning.CONVERGED, seeds_of_reference=FEW_SEEDS, stage=partial(_stage, title, progress)
    ):
        group = f"{row.control}.{row.parameter.partition('.')[0]}"  # coordinates of one have a number behind it
        yield part.row(row, factor=wider.get(group, 1.0))


def _bench(part: CheckedPart, renderer: Renderer, loss: Loss, results: Results, progress: Progress) -> Bench:
    return Bench(
        renderer, loss, inside(renderer), seeds.stream(part.config.seed, "check"), RAW_SPP,
        keep=lambda name, measure: results.get(f"{part.key} {name}", measure), tick=lambda samples: progress.advance(1),
    )  # fmt: skip


def _stage(title: str, progress: Progress, name: str, most: int) -> None:
    progress.stage(f"{title}: {name}", most, hint=HINT, at_most=True)


def _planned(problem: Problem, part: CheckedPart, spp: int, results: Results, progress: Progress) -> Iterator[Finding]:
    config, renderer, u = part.config, problem.renderer, inside(problem.renderer)
    summary, used = problem.plan_summary(renderer.plan), {group.estimator for group in renderer.plan.groups}
    not_computed = {
        "boundary terms: nothing that an adjoint differentiates moves an outline": "material" not in used,
        "adjoint renders: no coordinate needs one": not used & BY_ADJOINT,
        "renders for differences: every derivative is an adjoint or of the picture itself": not used & BY_DIFFERENCES,
        "the volumetric integrator: there is no medium": not renderer.scene.volumetric,
        **{f"by the material form: {limit}": "material" in used for limit in LIMITS},
    }
    left_out = [text for text, true in not_computed.items() if true]
    yield SearchPlan(
        **{**vars(summary), "spp": spp}, left_out=left_out if config.specialise else ["nothing (`specialise=false`)"]
    )
    if not config.specialise:
        return
    seed, hint = seeds.stream(config.seed, "leaving out"), "`specialise=false` leaves it out"
    tick = progress.advance

    def lengths() -> PathLength:
        most = planning.most_pictures(problem)
        progress.stage("finding how many bounces of light matter", most, hint=hint, at_most=True)
        return planning.bounces_of(problem, config.seed, tick=tick)

    def gains() -> list[GainRow]:
        progress.stage("measuring what leaving things out saves", MOST_GRADIENTS, hint=hint, at_most=True)
        return measured_gains(renderer, problem.loss, u, seed=seed, spp=problem.spp, depth=length.depth, tick=tick)

    yield (length := results.row(f"{part.key} bounces", PathLength, lengths))
    yield from results.rows(f"{part.key} gains", GainRow, gains)
    yield from results.rows(f"{part.key} texels", TexelRow, lambda: resolved_texels(renderer, u, seed=seed))


ALL, BOUNCES = "everything above", "bounces"
"""Names of the rows in which all items are put back together, and in which paths have their full length."""
WHAT = {**ITEMS, BOUNCES: "bounces of light beyond the search's longest path", ALL: "all of these"}
"""What is left out, in words, for each row."""
AGREES = 1.2
"""Difference, as a share of what another seed changes, up to which two pictures or gradients agree: 1 is expected where
the random numbers are others."""
REPEATS = 3  # timed gradients of each
MOST_GRADIENTS = (2 + REPEATS) * (len(ITEMS) + 3)
"""That `measured_gains` takes: with every item put back, with all, with all bounces and with none."""
PER_PIXEL = 2.0
"""Texels a pixel that `TexelRow.enough` keeps: two samples a period (Nyquist), with room for oblique views."""


def measured_gains(
    renderer: Renderer, loss: Loss, u: Tensor, *, seed: int, spp: int, repeats: int = REPEATS,
    depth: int | None = None, tick: Callable[[], None] = lambda: None,
) -> list[GainRow]:  # fmt: skip
    """Put back what a renderer leaves out, item by item and all at once, and measure a gradient of a loss at u (d,).

    `depth` is the longest light path of the search, where it is shorter than the scene's; `tick` is called after each
    gradient. There is one row for each item, one for the bounces, and one for all.
    """
    scene = renderer.scene
    depth = scene.max_depth if depth is None else depth
    renderers = {"": renderer if depth == scene.max_depth else renderer.like(scene.like(max_depth=depth))}
    for item in ITEMS:
        renderers[item] = renderer.like(scene.like(max_depth=depth, leave_out=EVERYTHING - {item}))
    if depth < scene.max_depth:
        renderers[BOUNCES] = renderer
    renderers[ALL] = renderer.like(scene.like(leave_out=NOTHING))
    pictures, gradients = defaultdict[str, list[Tensor]](list), defaultdict[str, list[Tensor]](list)
    times = defaultdict[str, list[float]](list)
    for noise in (seed, seeds.stream(seed, "another")):  # the first compiles
        for item, each in renderers.items():
            with torch.no_grad():
                pictures[item].append(each(u, noise, spp))
            gradients[item].append(each.gradient(loss, u, noise, spp)[1])
            tick()
    for number in range(repeats):
        for item, each in renderers.items():
            begun = time.perf_counter()
            each.gradient(loss, u, seeds.stream(seed, "round", number), spp)
            times[item].append(time.perf_counter() - begun)
            tick()
    rows = []
    for item in list(renderers)[1:]:
        picture, gradient = (_share(values[""], values[item]) for values in (pictures, gradients))
        noise_with, noise_without = (float((other - first).norm()) for first, other in (pictures[item], pictures[""]))
        seconds, seconds_without = statistics.median(times[item]), statistics.median(times[""])
        variance = (noise_with / noise_without) ** 2 if noise_without > 0.0 else 1.0
        rows.append(
            GainRow(
                item=item, what=WHAT[item], time_gain=variance * seconds / seconds_without, picture_difference=picture,
                gradient_difference=gradient, safe=max(picture, gradient) <= AGREES, seconds=seconds,
            )
        )  # fmt: skip
    return rows


def _share(without: list[Tensor], having: list[Tensor]) -> float:
    """The difference at one seed over the root mean square of those that another seed makes."""
    size = math.sqrt(statistics.fmean(float((first - other).norm()) ** 2 for first, other in (without, having)))
    difference = float((having[0] - without[0]).norm())
    return difference / size if size > 0.0 else difference


def resolved_texels(renderer: Renderer, u: Tensor, *, seed: int, spp: int = 16) -> list[TexelRow]:
    """Return, for every searched texture, how its texels compare with the pixels that show them."""
    scene, rows = renderer.scene, []
    assembled = scene.assembly(renderer.space.inputs(u))
    inputs = {name: value.detach() for name, value in assembled.items() if name not in ON_PICTURE}
    for group in renderer.plan.groups:
        for name in sorted(renderer.routes.get(group.name, ())) if group.parameter == "texels" else ():
            bright, dark = ({**inputs, name: torch.full_like(inputs[name], level)} for level in (1.0, 0.0))
            difference = scene.guides(bright, seed, spp)[0] - scene.guides(dark, seed, spp)[0]
            pixels = int((difference.amax(dim=-1) > 0.0).sum())
            with scene.shorter(2):
                gradient = scene.adjoint(inputs, torch.ones(*scene.resolution, 3), seed, spp, wrt=[name])[name]
            seen, side = int((gradient.abs().amax(dim=-1) > 0.0).sum()), max(inputs[name].shape[:2])
            enough = side
            while enough > 2 and seen * (enough / 2 / side) ** 2 >= PER_PIXEL * pixels:
                enough //= 2
            rows.append(TexelRow(control=group.control, side=side, seen=seen, pixels=pixels, enough=enough))
    return rows
