"""Error against run time of a scene as it is: what `advsearch precision` does."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from typing_extensions import Unpack

from advsearch import seeds
from advsearch.api.keywords import DerivativeKeywords, NamedKeywords, Names, asks, configured
from advsearch.attacks import Policy, make_policy
from advsearch.cluster import Call, Executor
from advsearch.engine.attack_parts import LOADING, executor_for, problem_from_config
from advsearch.engine.gradients import Loss, inside, smooth_loss
from advsearch.engine.loading import Scene
from advsearch.engine.naming import AnyModel
from advsearch.engine.planning import measured_plan, plan_gradients
from advsearch.engine.problem import Problem
from advsearch.engine.record import Results, kept_rows
from advsearch.errors import InputError
from advsearch.files import JsonObject
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.precision.answer import PrecisionResult
from advsearch.questions.precision.benches import REFERENCE_SAMPLER, ObjectiveBench, PictureBench, curve_of, variants
from advsearch.questions.precision.figures import precision_figures
from advsearch.questions.precision.gradient import (
    GradientBench,
    GradientPart,
    estimated_parts,
    matrix_groups,
    theory_of,
    ways_to_predict,
)
from advsearch.questions.precision.points import UNKNOWN, Array, MeasuredSetting, Point, Theory, point_of
from advsearch.questions.precision.recommended import MeasuredLine, Section, report_of
from advsearch.questions.precision.rounds import (
    ReferencePart,
    Rounds,
    TimeBudget,
    in_rounds,
    shared_parts,
    timing_machine,
)
from advsearch.questions.precision.settings import PrecisionConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.files import write_bytes, write_text
from advsearch.runs.results.attack import SharedWork
from advsearch.runs.results.base import Formation
from advsearch.runs.summary import to_json
from advsearch.scene.renderer import Renderer
from advsearch.settings import split_names
from advsearch.viewer.pages import keep_answer


class PrecisionKeywords(DerivativeKeywords, NamedKeywords, total=False):
    objective: str | None
    quantities: Names
    seconds: float
    error: float
    rounds: int
    samplers: Names
    depths: str | Sequence[int]
    loss: Literal["linear", "model"]
    policies: Names
    steps: int
    repeats: int
    workers: int | None
    cluster: str | None
    out: str | Path | None


NUMBERS, FIGURE = "precision.json", "precision"


@asks(PrecisionConfig, PrecisionKeywords)
def precision(
    object: Scene | str | Path = "mug",
    model: AnyModel = "reference",
    *,
    progress: Watched = None,
    **settings: Unpack[PrecisionKeywords],
) -> PrecisionResult:
    """Measure error against run time of a scene, its gradients and searches over it (docs/precision.md)."""
    config = configured(PrecisionConfig, object=object, model=model, **settings)
    return precision_from_config(config, progress=watcher(progress))


def precision_from_config(
    config: PrecisionConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> PrecisionResult:
    """Measure error against run time and write figures and numbers.

    The picture, the gradient of each control and the policies are measured one after the other, each in one sitting, so
    that their times are beside each other; what is done is kept at once, and a run that was stopped goes on with the
    next, in the seconds that are left.
    """
    progress = progress or NullProgress()
    if config.out is None:
        with RunDirectory.of(config, resumed) as run:
            report = _measured(config, run, progress)
            report = report.model_copy(update={"figures": _write(run.path / "images", report)})
            return keep_answer(run, report)
    report, folder = _measured(config, None, progress), Path(config.out).expanduser()
    report = report.model_copy(update={"figures": _write(folder, report)})
    write_text(folder / NUMBERS, to_json(report) + "\n")
    return report


def _measured(config: PrecisionConfig, run: RunDirectory | None, progress: Progress) -> PrecisionResult:
    """Measure, and keep it in an open run, if there is one; no figures."""
    begun = time.perf_counter()
    progress.stage(LOADING, hint=f"then {config.seconds:g} seconds of measurements; `seconds` sets them")
    policies = {name: make_policy(name) for name in split_names(config.policies)}
    problem, warnings = problem_from_config(config)
    for text in warnings:
        progress.message(text)
    wanted = split_names(config.quantities)
    if "gradient" in wanted and not any(group.valid for group in problem.renderer.plan.groups):
        raise InputError(
            f"`controls` {','.join(config.controls)}: has no derivative; leave gradient out of `quantities`"
        )
    with executor_for(config, "advsearch.questions.precision.carry_out:references_of", progress) as executor:
        if executor is not None:
            progress.stage("workers load the scene and the model")
            for _ in executor.results([[None]]):
                pass  # the first of them is ready
        setup = time.perf_counter() - begun
        job, results = Measurement(config, problem, progress, policies, executor), Results(run)
        parts = [one for one in job.parts() if one.quantity in wanted]

        def sections() -> Iterator[Section]:
            left = config.seconds
            for number, part in enumerate(parts):
                share = part.share / math.fsum(one.share for one in parts[number:])
                stored = results.value(part.name, TimedSection, partial(part.timed, TimeBudget(share * left)))
                left = max(0.0, left - stored.seconds)
                yield stored.section

        def result(sections: Sequence[Section], ending: str) -> PrecisionResult:
            whole = Section(config.pixel_sampler)
            for one in sections:
                whole.extend(one)
            facts = None if executor is None else executor.facts
            return report_of(
                whole,
                config.error,
                run=None if run is None else str(run.path),
                object=config.object,
                model=problem.model.name,
                environment=problem.environment,
                controls=list(config.controls),
                ending=ending,
                image_formation=Formation.of(problem.renderer.formation),
                depth=problem.renderer.scene.max_depth,
                loss=config.loss,
                objective=config.objective or problem.task.objective,
                spp=problem.spp,
                machine=timing_machine(),
                shared=SharedWork.of_facts(facts, facts.machines if facts else {}),
                seconds={"budget": config.seconds, "setup": setup, "total": time.perf_counter() - begun},
                seed=config.seed,
                command_line=config.command_line(),
            )

        return kept_rows(run, results, sections(), result)


def references_of(settings: JsonObject) -> Call:
    """Return what carries out parts of the references of a configuration: what a worker does."""
    config = PrecisionConfig(**settings)
    job = Measurement(config, problem_from_config(config)[0], NullProgress(), {})

    def call(asked: Sequence[ReferencePart | None]) -> list[Array]:
        return [job.reference_part(one) for one in asked if one is not None]

    return call


def _write(folder: Path, report: PrecisionResult) -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    figures = precision_figures(report)
    return [str(write_bytes(folder / f"{FIGURE}.{kind}", data)) for kind, data in figures.items()]


SHARES = {"image": 0.45, "gradient": 0.3, "objective": 0.25}
"""Of the time, by quantity; what one doesn't use is the others'."""
REFERENCE_SHARE = 0.35
"""Of the time of a quantity, for its reference."""
CONFIRM_SHARE, CONFIRM_LEAST, CONFIRM_MOST = 0.4, 4, 64
"""Of the time of a gradient's measurements, for measuring the recommended setting again; how often at least for that to
count, and at most."""
VERIFY_SPP, VERIFY_RENDERS = 64, 4
"""Samples a pixel, and fresh renders, that verify what a search held."""
IMAGE = "image"


@dataclass
class TimedSection:
    """What was measured in one sitting, and the seconds that it took."""

    section: Section
    seconds: float


class MeasuredPart(NamedTuple):
    """What is measured in one sitting: of a quantity, under a name of its own, in a share of the time."""

    quantity: str
    name: str
    share: float
    measure: Callable[[TimeBudget], Section]

    def timed(self, budget: TimeBudget) -> TimedSection:
        """Measure, and return what came out and the seconds that it took."""
        begun = time.perf_counter()
        return TimedSection(self.measure(budget), time.perf_counter() - begun)


@dataclass
class Measurement:
    """What can be measured, part by part; `section` is that of the part at hand."""

    config: PrecisionConfig
    problem: Problem
    progress: Progress
    policies: Mapping[str, Policy[Any]]
    executor: Executor | None = None
    section: Section = field(init=False)

    def parts(self) -> list[MeasuredPart]:
        """Everything, in its order."""
        share = SHARES["gradient"] / max(1, len(self._divided))
        gradients = [
            MeasuredPart("gradient", _named(one), share, partial(self._gradient, one)) for one in self._divided
        ]
        first = MeasuredPart("image", IMAGE, SHARES["image"], self._image)
        return [first, *gradients, MeasuredPart("objective", "objective", SHARES["objective"], self._objective)]

    def reference_part(self, asked: ReferencePart) -> Array:
        """Return a part of a reference."""
        if asked.name == IMAGE:
            return self._pictures.part(asked.by, asked.spp, asked.seed)
        part = next(one for one in self._divided if _named(one) == asked.name)
        return self._bench(part).part_of(asked.by, asked.spp, asked.seed)

    @property
    def seed(self) -> int:
        """Root of the measurements' seeds."""
        return seeds.stream(self.config.seed, "precision")

    def _image(self, budget: TimeBudget) -> Section:
        self.section = Section(self.config.pixel_sampler)
        self.progress.stage("the picture: preparing every sampler and path length")
        bench = self._pictures
        chosen = list(bench.variants.values())
        share = budget.share(REFERENCE_SHARE)
        bench.refer(share, self.seed, self._timed("the picture: rendering references", share))
        for family, one in bench.pictures.items():
            self.section.refer("image", family, "", one, bench.part_spp[family], bench.margins[family])
        theories = {one.series: one.theory for one in chosen}
        families = {one.series: one.family for one in chosen}
        measured = self._rounds("the picture", bench.settings, bench.measure, budget)
        for measure in ("error", "margin_error"):
            self._take(measured, measure, bench.floor, lambda series: theories[series], families)
        return self.section

    @cached_property
    def _pictures(self) -> PictureBench:
        renderer, problem = self.problem.renderer, self.problem
        depths = [int(part) for part in split_names(self.config.depths)]
        chosen = variants(
            split_names(self.config.samplers),
            depths,
            renderer.scene.max_depth,
            volumetric=renderer.scene.volumetric,
            predicted=ways_to_predict(renderer),
        )
        whole, there = problem.whole(problem.domain.start), inside(renderer)
        there = torch.where(self._colored, there, whole)

        def margin(picture: Tensor) -> float:
            return -problem.judge(picture, whole).score

        return PictureBench(renderer, whole, margin, chosen, partial(shared_parts, self.executor, IMAGE), there)

    @cached_property
    def _colored(self) -> Tensor:
        """(d,) bool, which numbers change base colours alone: of these, predictions know others than those shown."""
        renderer = self.problem.renderer
        found, names = torch.zeros(len(renderer.start), dtype=torch.bool), matrix_groups(renderer)
        for group in renderer.plan.groups:
            found[group.coordinates] = group.name in names
        return found

    @cached_property
    def _divided(self) -> list[GradientPart]:
        renderer, _ = self._differentiated
        linear = self.config.loss == "linear"
        ways = ways_to_predict(renderer)
        return estimated_parts(renderer.plan.groups, linear=linear, by_matrix=matrix_groups(renderer), ways=ways)

    def _bench(self, part: GradientPart) -> GradientBench:
        renderer, loss = self._differentiated
        elsewhere = partial(shared_parts, self.executor, _named(part))
        return GradientBench(renderer, loss, inside(renderer), part, self._exact, elsewhere)

    @cached_property
    def _differentiated(self) -> tuple[Renderer, Loss]:
        renderer, problem = self.problem.renderer, self.problem
        if self.config.loss == "model":
            return renderer, problem.loss
        renderer = renderer.like(denoiser="none", transfer="linear")
        renderer.plan = renderer.plan.at_a_pixel()
        return renderer, smooth_loss(renderer.formation.resolution, self.config.seed)

    @cached_property
    def _exact(self) -> Renderer:
        renderer, _ = self._differentiated
        return renderer.like(renderer.scene.like(sampler=REFERENCE_SAMPLER))

    def _gradient(self, part: GradientPart, budget: TimeBudget) -> Section:
        self.section = Section(self.config.pixel_sampler)
        bench = self._bench(part)
        share = budget.share(REFERENCE_SHARE)
        bench.refer(share, self.seed, self._timed(f"gradient of {part.name}: references", share))
        if bench.reference is None:
            return self.section
        self.section.refer("gradient", bench.by, part.name, bench.reference, bench.part_spp)
        remark = bench.bias(budget, self.seed)
        self.section.warnings += [remark] if remark else []
        share = budget.share(1.0 - CONFIRM_SHARE)
        measured = self._rounds(f"gradient of {part.name}", bench.settings, bench.measure, share)
        linear, sampler = self.config.loss == "linear", self.config.pixel_sampler
        self._take(measured, "error", bench.floor, lambda series: theory_of(series, sampler) if linear else UNKNOWN)
        self._confirm(bench, part, budget)
        return self.section

    def _confirm(self, bench: GradientBench, part: GradientPart, budget: TimeBudget) -> None:
        """Measure the setting that is recommended so far again, with seeds of its own."""
        one = self.section.recommended("gradient", part.name, self.config.error)
        if one is None or one.spp is None:
            return
        like = next(setting for setting in bench.settings if setting.series == one.estimator)
        setting = replace(like, spp=one.spp, cost=like.cost / like.spp * one.spp)
        tick = self._timed(f"gradient of {part.name}: {one.estimator} with {one.spp} samples again", budget)
        measured = in_rounds(
            [setting],
            bench.measure,
            budget,
            rounds=CONFIRM_MOST,
            seed=seeds.stream(self.seed, "confirm"),
            on_done=lambda _: tick(),
        )
        samples = measured.results.get(setting, [])
        if len(samples) >= CONFIRM_LEAST:
            floor = bench.floor(setting, "error")
            line = next(each for each in self.section.lines if each.line == setting.line)
            line.again = point_of(setting, samples, "error", floor)

    def _objective(self, budget: TimeBudget) -> Section:
        problem, config, policies = self.problem, self.config, self.policies
        self.section = Section(config.pixel_sampler)
        if any(policy.uses_gradient for policy in policies.values()):
            self.progress.stage("measuring which gradients are best here", plan_gradients(problem.plan))
            at, seed = inside(problem.renderer), seeds.stream(config.seed, "measure")
            problem.plan = measured_plan(
                problem.renderer,
                problem.loss,
                at,
                seed=seed,
                spp=problem.spp,
                counted=True,
                tick=lambda: self.progress.advance(1),
            )
        bench = ObjectiveBench(
            partial(map, problem.evaluate), problem.seed, problem.domain, policies, config.steps, self._verified, budget
        )
        self.section.start = self._verified(problem.domain.start)
        settings = bench.settings(problem.spp)
        tick = self._timed("searching with each policy", budget)
        measured = in_rounds(
            settings,
            bench.measure,
            budget,
            rounds=config.repeats,
            seed=self.seed,
            least=1,
            warm_up=0,
            on_done=lambda setting: tick(policy=setting.series),
        )
        self.section.left_out += measured.left_out
        for setting, taken in measured.results.items():
            self.section.curves.append((setting, curve_of(setting.series, [marks for marks, _ in taken if marks])))
        return self.section

    def _verified(self, u: Tensor) -> float:
        """The mean objective of a configuration over fresh renders, rounded to 8 bits; the same seeds for all."""
        u = self.problem.domain.project(u)
        values = []
        for number in range(VERIFY_RENDERS):
            seed = seeds.stream(self.config.seed, "precision verification", number)
            with torch.no_grad():
                values.append(float(self.problem.loss(self.problem.picture(u, seed, VERIFY_SPP))))
        return sum(values) / len(values)

    def _rounds(
        self, name: str, settings: Sequence[MeasuredSetting], measure: Any, budget: TimeBudget
    ) -> Rounds[dict[str, float]]:
        tick = self._timed(f"{name}: measuring every setting in rounds", budget)
        measured: Rounds[dict[str, float]] = in_rounds(
            settings,
            measure,
            budget,
            rounds=self.config.rounds,
            seed=self.seed,
            on_done=lambda setting: tick(now=setting.series, samples=setting.spp),
        )
        self.section.left_out += measured.left_out
        return measured

    def _take(
        self,
        measured: Rounds[dict[str, float]],
        measure: str,
        floor: Callable[[MeasuredSetting, str], float],
        theory: Callable[[str], Theory],
        families: Mapping[str, str] | None = None,
    ) -> None:
        lines: dict[tuple[str, str, str], list[Point]] = {}
        for setting, taken in measured.results.items():
            lines.setdefault(setting.line, []).append(point_of(setting, taken, measure, floor(setting, measure)))
        for line, points in lines.items():
            points.sort(key=lambda point: point.setting.spp)
            family = (families or {}).get(line[2], "")
            self.section.lines.append(MeasuredLine(line, measure, points, theory(line[2]), family))

    def _timed(self, name: str, budget: TimeBudget) -> Callable[..., None]:
        """Begin a stage that ends with a budget of seconds, and return what tells how many have passed."""
        total, done = max(1, math.ceil(budget.left)), 0
        self.progress.stage(name, total, hint="counted in seconds; `seconds` sets them", at_most=True)

        def tick(**info: float | str) -> None:
            nonlocal done
            passed = min(total, total - math.ceil(budget.left))
            self.progress.advance(passed - done, **info)
            done = passed

        return tick


def _named(part: GradientPart) -> str:
    return f"gradient of {part.name}"
