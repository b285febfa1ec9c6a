"""Plans a search on its scene: how it differentiates, and what it leaves out. What `advsearch plan` does."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from typing_extensions import Unpack

from advsearch import seeds
from advsearch.api.keywords import DerivativeKeywords, NamedKeywords, asks, configured
from advsearch.engine.attack_parts import LOADING, problem_from_config
from advsearch.engine.gradients import Loss, inside
from advsearch.engine.loading import Scene
from advsearch.engine.naming import AnyModel
from advsearch.engine.planning import (
    GOAL,
    bounces_of,
    cosine_samples,
    cosines,
    measured_plan,
    most_pictures,
    plan_gradients,
    tuned,
)
from advsearch.engine.problem import Problem
from advsearch.engine.record import Results, kept_rows
from advsearch.engine.transport import WORTH
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.plan.answer import DenoiserAdvice, EstimatorLimit, GainRow, PlanResult, TexelRow
from advsearch.questions.plan.settings import PlanConfig
from advsearch.report.wording import count
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results.base import CosineRow, Formation, PathLength
from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.formation import EVERYTHING, ITEMS, NOTHING
from advsearch.scene.gradients import BY_ADJOINT, BY_DIFFERENCES
from advsearch.scene.mitsuba_backend.material_adjoint import LIMITS
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.lights import predicting, why_not
from advsearch.scene.transport.matrix import SPP


class PlanKeywords(DerivativeKeywords, NamedKeywords, total=False):
    objective: str | None
    seconds: float | None


PlannedRow = CosineRow | PathLength | GainRow | TexelRow


@asks(PlanConfig, PlanKeywords)
def plan(
    object: Scene | str | Path = "mug",
    model: AnyModel = "reference",
    *,
    progress: Watched = None,
    **settings: Unpack[PlanKeywords],
) -> PlanResult:
    """Choose how every derivative of a search is obtained and what is left out, by measurement (docs/gradients.md)."""
    config = configured(PlanConfig, object=object, model=model, **settings)
    return plan_from_config(config, progress=watcher(progress))


def plan_from_config(
    config: PlanConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> PlanResult:
    """Choose how every derivative is obtained and what is left out, by measurement, and say why.

    What is measured is kept at once in a run directory, so that a plan that was stopped, by Ctrl-C, by a kill or
    because its `seconds` were over, goes on where it was and ends with the same rows; times differ, and what is chosen
    by them (estimators, the better denoiser) may.
    """
    progress, begun = progress or NullProgress(), time.perf_counter()
    with RunDirectory.of(config, resumed) as run:
        progress.stage(LOADING)
        work = _Measurements(problem_from_config(config)[0], config, Results(run, config.seconds), progress)

        def result(rows: Sequence[PlannedRow], ending: str) -> PlanResult:
            return work.result(rows, ending, str(run.path), time.perf_counter() - begun)

        return kept_rows(run, work.results, work.rows(), result)


class _Measurements:
    """What a plan measures, one after the other, what matters most first."""

    def __init__(self, problem: Problem, config: PlanConfig, results: Results, progress: Progress) -> None:
        self._problem, self._config, self.results, self._progress = problem, config, results, progress
        self._other = "none" if config.denoise == "oidn" else "oidn"
        self._seed = seeds.stream(config.seed, "measure")
        self._plan = problem.renderer.plan
        self._controls = list(dict.fromkeys(one.control for one in self._plan.groups if one.estimator != "none"))
        self._gradients = plan_gradients(self._plan, every=True)
        self._left = ["ways to differentiate"] * bool(self._gradients)
        self._left += [f"step and samples of {name}" for name in self._controls]
        self._left += ["what can be left out"] * config.specialise
        self._left += [f"{name} with denoiser {self._other}" for name in self._controls]

    def rows(self) -> Iterator[PlannedRow]:
        """Measure, and yield each row as it comes, until the time of the results is up."""
        if self._gradients:
            self._compare_estimators()
            self._left.pop(0)
        own: list[CosineRow] = []
        for control in self._controls:
            for row in self._cosines(self._problem, control, f"choosing step and samples for {control}"):
                own.append(row)
                yield row
            self._left.pop(0)
        if self._config.specialise:
            self._problem.renderer.plan, _ = tuned(self._plan, own)
            yield from self._leaving_out()
            self._left.pop(0)
        if not self._controls:
            return
        self.results.check_time()
        self._progress.stage("loading the scene for the other denoiser")
        other, _ = problem_from_config(self._config, denoise=self._other)
        other.plan = other.plan.with_estimator({one.name: one.estimator for one in self._plan.groups}, "as beside")
        for control in self._controls:
            yield from self._cosines(other, control, f"the same for {control} with denoiser {self._other}")
            self._left.pop(0)

    def result(self, rows: Sequence[PlannedRow], ending: str, run: str, seconds: float) -> PlanResult:
        """Return what the rows so far come to."""
        problem, config = self._problem, self._config
        table = [row for row in rows if isinstance(row, CosineRow)]
        tables = {name: [row for row in table if row.denoise == name] for name in (config.denoise, self._other)}
        chosen, spp = tuned(self._plan, tables[config.denoise])
        used = {group.estimator for group in chosen.groups}
        gradient = problem.plan_summary(chosen)
        left_out = config.specialise and "what can be left out" not in self._left
        return PlanResult(
            run=run,
            object=config.object,
            environment=problem.environment,
            controls=list(config.controls),
            model=problem.model.name,
            ending=ending,
            not_measured=list(self._left),
            image_formation=Formation.of(problem.renderer.formation),
            renders_per_gradient=gradient.renders_per_gradient,
            spp=spp or problem.spp,
            groups=gradient.groups,
            cosines=table,
            denoise=quieter(tables, config.denoise),
            left_out=_left_out(problem, used) if config.specialise else [],
            specialised=config.specialise,
            gains=[row for row in rows if isinstance(row, GainRow)] or None,
            bounces=next((row for row in rows if isinstance(row, PathLength)), None),
            texels=[row for row in rows if isinstance(row, TexelRow)] if left_out else None,
            limits=[EstimatorLimit.of(one) for one in LIMITS] if "material" in used else [],
            seconds={"total": seconds},
            seed=config.seed,
            command_line=config.command_line(),
        )

    def _compare_estimators(self) -> None:
        problem, renderer = self._problem, self._problem.renderer
        hint = f"{self._gradients} gradients of {count(problem.spp, 'sample')} a pixel; `resolution` shortens it"
        self._progress.stage("comparing ways to differentiate", self._gradients, hint=hint)
        self._plan = renderer.plan = measured_plan(
            renderer,
            problem.loss,
            inside(renderer),
            seed=self._seed,
            spp=problem.spp,
            every=True,
            tick=lambda: self._progress.advance(1),
            keep=self.results.get,
        )

    def _cosines(self, problem: Problem, control: str, title: str) -> Iterator[CosineRow]:
        renderer, only = problem.renderer, (control,)

        def kept(name: str, measure: Callable[[], Any]) -> Any:
            return self.results.get(f"{renderer.formation.denoiser} {name}", measure)

        hint = "counted in samples a pixel; `resolution` shortens it, `seconds` ends it"
        self._progress.stage(title, cosine_samples(renderer.plan, controls=only), hint=hint, at_most=True)
        u, tick = inside(renderer), self._progress.advance
        for row in cosines(renderer, problem.loss, u, seed=self._seed, controls=only, tick=tick, keep=kept):
            yield row
            self._progress.message(  # whoever reads it can stop the plan and find the row kept
                f"{control}: a gradient of {row.spp} samples and {row.factor:g} x the step has a cosine of "
                f"{row.cosine:.2f} with the converged one"
            )

    def _leaving_out(self) -> Iterator[PlannedRow]:
        problem, renderer, progress = self._problem, self._problem.renderer, self._progress
        seed, u = seeds.stream(self._config.seed, "leaving out"), inside(renderer)

        def tick() -> None:
            progress.advance(1)

        def lengths() -> PathLength:
            progress.stage("finding how many bounces of light matter", most_pictures(problem), hint=hint, at_most=True)
            return bounces_of(problem, self._config.seed, tick=tick)

        def gains() -> list[GainRow]:
            progress.stage("measuring what leaving things out saves", most_gradients(), hint=hint, at_most=True)
            depth = length.depth
            return measured_gains(renderer, problem.loss, u, seed=seed, spp=problem.spp, depth=depth, tick=tick)

        hint = "`specialise=false` leaves it out"
        yield (length := self.results.row("bounces", PathLength, lengths))
        yield from self.results.rows("gains", GainRow, gains)
        yield from self.results.rows("texels", TexelRow, lambda: resolved_texels(renderer, u, seed=seed))


def quieter(tables: Mapping[str, Sequence[CosineRow]], asked: str) -> DenoiserAdvice:
    """Say which denoiser makes the better gradients, by the cosines of each: the one that reaches the goal in all
    controls in less time.

    A denoiser is part of the image formation, the same in search and verification, so that this is advice: another one
    is another question.
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


def _left_out(problem: Problem, used: set[str]) -> list[str]:
    """What a search with these estimators does not compute, in sentences."""
    known = {
        "boundary terms: nothing that an adjoint differentiates moves an outline": "material" not in used,
        "adjoint renders: no coordinate needs one": not used & BY_ADJOINT,
        "renders for differences: every derivative is an adjoint or of the picture itself": not used & BY_DIFFERENCES,
        "the volumetric integrator: there is no medium": not problem.renderer.scene.volumetric,
    }
    return [text for text, true in known.items() if true]


ALL = "everything above"
"""Name of the row in which all items are put back together."""
BOUNCES = "bounces"
"""Name of the row in which paths have their full length."""
RENDERS = "renders"
"""Name of the row in which steps render, where a matrix of light transport predicts them."""
WHAT = {
    **ITEMS,
    BOUNCES: "bounces of light beyond the search's longest path",
    ALL: "all of these",
    RENDERS: "renders of the steps that light transport predicts",
}
"""What is left out, in words, for each row."""
AGREES = 1.2
"""Difference, as a share of what another seed changes, up to which two pictures or gradients agree: 1 is expected where
the random numbers are others."""


REPEATS = 3
"""Timed gradients of each."""


def most_gradients(repeats: int = REPEATS) -> int:
    """Return how many gradients `measured_gains` takes at most: with every item put back, with all, with all bounces
    and with none, twice to compare and then timed, and predicted ones."""
    return (2 + repeats) * (len(ITEMS) + 4)


def measured_gains(
    renderer: Renderer,
    loss: Loss,
    u: Tensor,
    *,
    seed: int,
    spp: int,
    repeats: int = REPEATS,
    depth: int | None = None,
    tick: Callable[[], None] = lambda: None,
) -> list[GainRow]:
    """Put back what a renderer leaves out, item by item and all at once, and measure a gradient of a loss at u (d,).

    `depth` is the longest light path of the search, where it is shorter than the scene's; `tick` is called after each
    gradient. There is one row for each item, one for all, and where light transport can predict the pictures of a
    search one for that too: against a rendered gradient, with a share of the making as large as the shortest search
    that predicts has, its picture beside one of as many samples as its own.
    """
    scene = renderer.scene
    depth = scene.max_depth if depth is None else depth
    everyone = {"": renderer if depth == scene.max_depth else renderer.like(scene.like(max_depth=depth))}
    for item in ITEMS:
        everyone[item] = renderer.like(scene.like(max_depth=depth, leave_out=EVERYTHING - {item}))
    if depth < scene.max_depth:
        everyone[BOUNCES] = renderer
    everyone[ALL] = renderer.like(scene.like(leave_out=NOTHING))
    first = [_one(each, loss, u, seed, spp, tick) for each in everyone.values()]  # compiles, and compares
    again = [_one(each, loss, u, seeds.stream(seed, "another"), spp, tick) for each in everyone.values()]
    noises = [seeds.stream(seed, "round", number) for number in range(repeats)]
    rounds = [[_seconds(each, loss, u, noise, spp, tick) for each in everyone.values()] for noise in noises]
    typical = [statistics.median(times) for times in zip(*rounds, strict=True)]
    rows = [
        _row(item, (first[0], again[0], typical[0]), (first[number], again[number], typical[number]))
        for number, item in list(enumerate(everyone))[1:]
    ]
    if why_not(renderer) is None:
        both = seed, seeds.stream(seed, "another")
        predicted = [_predicted(renderer, loss, u, noise, spp, tick) for noise in both]
        seconds = statistics.fmean(one[2] for one in predicted)
        row = _row(RENDERS, (predicted[0][:2], predicted[1][:2], seconds), (first[0], again[0], typical[0]))
        with torch.no_grad():  # at few samples the denoiser's own bias is in a rendered picture
            clean, other = (renderer(u, noise, SPP) for noise in both)
        apart = _share(clean - predicted[0][0], predicted[1][0] - predicted[0][0], other - clean)
        rows.append(
            row.model_copy(update={"picture_difference": apart, "safe": max(apart, row.gradient_difference) <= AGREES})
        )
    return rows


GradientSamples = tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor], float]
"""The picture and the gradient of one seed, those of another, and the seconds of a gradient."""


def _row(item: str, without: GradientSamples, having: GradientSamples) -> GainRow:
    (first, again, seconds), (first_with, again_with, seconds_with) = without, having
    picture, gradient = (
        _share(first_with[k] - first[k], again[k] - first[k], again_with[k] - first_with[k]) for k in range(2)
    )
    noise = _ratio(again_with[0] - first_with[0], again[0] - first[0])
    return GainRow(
        item=item,
        what=WHAT[item],
        gain=noise**2 * seconds_with / seconds,
        picture_difference=picture,
        gradient_difference=gradient,
        safe=picture <= AGREES and gradient <= AGREES,
        seconds=seconds_with,
    )


def _predicted(
    renderer: Renderer, loss: Loss, u: Tensor, seed: int, spp: int, tick: Callable[[], None]
) -> tuple[Tensor, Tensor, float]:
    """The picture and the gradient that light transport predicts, and the seconds of a gradient with its share of the
    making."""
    begun = time.perf_counter()
    made = predicting(renderer, u, seed).renderer
    with torch.no_grad():
        picture = made(u, seed, spp)
    ready = time.perf_counter()
    gradient = made.gradient(loss, u, seed, spp)[1]
    seconds = time.perf_counter() - ready + (ready - begun) / WORTH
    tick()
    return picture, gradient, seconds


def _one(
    renderer: Renderer, loss: Loss, u: Tensor, seed: int, spp: int, tick: Callable[[], None]
) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        picture = renderer(u, seed, spp)
    gradient = renderer.gradient(loss, u, seed, spp)[1]
    tick()
    return picture, gradient


def _seconds(renderer: Renderer, loss: Loss, u: Tensor, seed: int, spp: int, tick: Callable[[], None]) -> float:
    begun = time.perf_counter()
    renderer.gradient(loss, u, seed, spp)
    tick()
    return time.perf_counter() - begun


def _share(difference: Tensor, *noises: Tensor) -> float:
    """The size of a difference over the root mean square of those that another seed makes."""
    size = math.sqrt(statistics.fmean(float(noise.norm()) ** 2 for noise in noises))
    return float(difference.norm()) / size if size > 0.0 else float(difference.norm())


def _ratio(above: Tensor, below: Tensor) -> float:
    size = float(below.norm())
    return float(above.norm()) / size if size > 0.0 else 1.0


PER_PIXEL = 2.0
"""Texels a pixel that `TexelRow.enough` keeps: two samples a period (Nyquist), with room for oblique views."""


def resolved_texels(renderer: Renderer, u: Tensor, *, seed: int, spp: int = 16) -> list[TexelRow]:
    """Return, for every searched texture, how its texels compare with the pixels that show them."""
    found = []
    groups = [group for group in renderer.plan.groups if group.parameter == "texels"]
    assembled = renderer.scene.assembly(renderer.space.inputs(u))
    inputs = {name: value.detach() for name, value in assembled.items() if name not in ON_PICTURE}
    for group in groups:
        for name in sorted(renderer.routes.get(group.name, ())):
            found.append(_texels(renderer.scene, group.control, name, inputs, seed, spp))
    return found


def _texels(scene: MitsubaScene, control: str, name: str, inputs: dict[str, Tensor], seed: int, spp: int) -> TexelRow:
    texture = inputs[name]
    bright, dark = ({**inputs, name: torch.full_like(texture, level)} for level in (1.0, 0.0))
    difference = scene.guides(bright, seed, spp)[0] - scene.guides(dark, seed, spp)[0]
    pixels = int((difference.amax(dim=-1) > 0.0).sum())
    with scene.shorter(2):
        gradient = scene.adjoint(inputs, torch.ones(*scene.resolution, 3), seed, spp, wrt=[name])[name]
    seen, side = int((gradient.abs().amax(dim=-1) > 0.0).sum()), max(texture.shape[:2])
    enough = side
    while enough > 2 and seen * (enough / 2 / side) ** 2 >= PER_PIXEL * pixels:
        enough //= 2
    return TexelRow(control=control, side=side, seen=seen, pixels=pixels, enough=enough)
