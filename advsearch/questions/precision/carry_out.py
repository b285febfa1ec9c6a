"""Error against run time of a scene as it is: what `advsearch precision` does."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import torch

from advsearch import seeds, threads
from advsearch.cluster.worker import processor
from advsearch.engine.gradients import Loss, inside, smooth_loss
from advsearch.engine.problem import Problem
from advsearch.engine.record import Results, taken_rows
from advsearch.errors import InputError
from advsearch.experiment import RunContext
from advsearch.progress import Progress
from advsearch.questions.attack.carry_out import LOADING, problem_from_config
from advsearch.questions.precision import benches
from advsearch.questions.precision import result as room
from advsearch.questions.precision.benches import OIDN, GradientBench, GradientPart, PictureBench, TimeBudget
from advsearch.questions.precision.result import PrecisionConfig, PrecisionPoint, PrecisionResult, Recommended, Sitting
from advsearch.questions.precision.rule import RoundUp, confirmed, fit_line, point_of, reaching, warning_of
from advsearch.runs.results import Formation
from advsearch.scene.formation import next_count
from advsearch.settings import split_names
from advsearch.trust.writing import write_bytes

SHARES = {"image": 0.6, "gradient": 0.4}  # of the time, by quantity; what one doesn't use is the others'
REFERENCE_SHARE = 0.35  # of the time of a quantity, for its reference
CONFIRM_SHARE, CONFIRM_LEAST, CONFIRM_MOST = 0.4, 4, 64
"""Of the time of a gradient's measurements, for measuring the recommended setting again; how often at least for that to
count, and at most."""


def measured(asked: RunContext[PrecisionConfig]) -> PrecisionResult:
    """Measure error against run time and write figures and numbers.

    The picture and the gradient of each control are measured one after the other, each in one sitting, so that their
    times are beside each other; what is done is kept at once, and a run that was stopped goes on with the next, in the
    seconds that are left.
    """
    config, begun = asked.config, time.perf_counter()
    asked.progress.stage(LOADING, hint=f"then {config.seconds:g} seconds of measurements; `seconds` sets them")
    run, (problem, remarks) = asked.run, problem_from_config(config)
    for remark in remarks:
        asked.progress.message(remark)
    job, results = Measurement(config, problem, asked.progress), Results(run)
    setup = time.perf_counter() - begun

    def sittings() -> Iterator[Sitting]:
        left, shares = config.seconds, [share for _, share, _ in job.sittings]
        for number, (name, share, measure) in enumerate(job.sittings):
            budget = TimeBudget(left * share / math.fsum(shares[number:]))
            sitting = results.row(name, Sitting, partial(measure, budget))
            left = max(0.0, left - sitting.took)
            yield sitting

    def result(sittings: list[Sitting]) -> PrecisionResult:
        points, again, references, left_out, warnings = (
            [row for sitting in sittings for row in getattr(sitting, name)]
            for name in ("points", "again", "references", "left_out", "warnings")
        )
        slopes = []
        for line in lines_of(points).values():
            if (slope := fit_line(line, job.or_steeper(line[0]))) is not None:
                slopes.append(slope)
                warnings += filter(None, [warning_of(slope, line)])
        return asked.result(
            PrecisionResult, model=problem.model.name, environment=problem.environment,
            depth=problem.renderer.scene.max_depth, loss=config.loss, spp=problem.spp, goal=config.error,
            image_formation=Formation.of(problem.renderer.formation), machine=timing_machine(), points=points,
            slopes=slopes, references=references, left_out=left_out, warnings=[*warnings, *room.cautions(points)],
            recommendations=recommended(points, again, config.error, job.round_up, job.or_steeper), figures=[],
            seconds={"budget": config.seconds, "setup": setup},
        )  # fmt: skip

    taken = taken_rows(asked, results, sittings(), result)
    (run.path / "images").mkdir(exist_ok=True)
    figures = room.precision_figures(taken)
    written = [write_bytes(run.path / "images" / f"precision.{kind}", data) for kind, data in figures.items()]
    return taken.model_copy(update={"figures": [str(path) for path in written]})


class Measurement:
    """What can be measured, sitting by sitting: of each its name, its share of the time, and what measures it."""

    def __init__(self, config: PrecisionConfig, problem: Problem, progress: Progress) -> None:
        self._config, self._problem, self._progress = config, problem, progress
        self._seed = seeds.stream(config.seed, "precision")
        self._linear, wanted = config.loss == "linear", split_names(config.quantities)
        renderer, self._loss = problem.renderer, cast(Loss, problem.loss)
        if self._linear:
            renderer = renderer.like(denoiser="none", transfer="linear")
            renderer.plan = renderer.plan.at_a_pixel()
            self._loss = smooth_loss(renderer.formation.resolution, config.seed)
        self._renderer, parts = renderer, benches.gradient_parts(renderer.plan.groups, linear=self._linear)
        if "gradient" in wanted and not parts:
            names = ",".join(config.controls)
            raise InputError(f"`controls` {names}: has no derivative; leave gradient out of `quantities`")
        self.sittings: list[tuple[str, float, Callable[[TimeBudget], Sitting]]] = []
        if "image" in wanted:
            self.sittings.append(("image", SHARES["image"], self._pictures))
        for part in parts if "gradient" in wanted else ():
            share = SHARES["gradient"] / len(parts)
            self.sittings.append((f"gradient of {part.name}", share, partial(self._gradients, part)))

    def round_up(self, point: PrecisionPoint, samples: float) -> int:
        """Return the next number of samples that a setting takes. A line of the picture is named after its sampler; one
        of a gradient has that of the run."""
        sampler = self._config.pixel_sampler if point.quantity == "gradient" else point.estimator.removesuffix(OIDN)
        return next_count(sampler, samples)

    def or_steeper(self, point: PrecisionPoint) -> bool | None:
        """Return whether the error of a line may fall faster than that of independent samples; None where theory says
        nothing: differences have the bias of their step, the material form its limits, and the denoiser its own.

        Stratification never makes the slope shallower, and often steeper (Owen 1997).
        """
        if point.quantity == "gradient":
            unbiased = self._linear and point.estimator == "adjoint"
            return self._config.pixel_sampler != "independent" if unbiased else None
        return point.estimator != "independent" if point.family == "none" else None

    def _pictures(self, budget: TimeBudget) -> Sitting:
        problem = self._problem
        u = problem.whole(problem.domain.start)
        samplers = split_names(self._config.samplers)
        bench = PictureBench(problem.renderer, u, lambda picture: -problem.judge(picture, u).score, samplers)
        return self._sitting("the picture", bench, budget)

    def _gradients(self, part: GradientPart, budget: TimeBudget) -> Sitting:
        renderer, title, begun = self._renderer, f"gradient of {part.name}", time.perf_counter()
        bench = GradientBench(renderer, self._loss, inside(renderer), part)
        sitting = self._sitting(title, bench, budget.share(1.0 - CONFIRM_SHARE * (1.0 - REFERENCE_SHARE)))
        chosen = recommended(sitting.points, [], self._config.error, self.round_up, self.or_steeper)[0]
        remark = bench.bias(self._seed) if budget.left > 0.0 else None
        again: list[PrecisionPoint] = []
        if chosen.estimator is not None and chosen.spp is not None:
            like = next(setting for setting in bench.settings if setting.estimator == chosen.estimator)
            setting = replace(like, spp=chosen.spp, cost=like.cost / like.spp * chosen.spp)
            tick = self._stage(f"{title}: {chosen.estimator} with {chosen.spp} samples again", budget)
            seed = seeds.stream(self._seed, "confirm")
            measured = benches.in_rounds(
                [setting], bench.measure, budget, rounds=CONFIRM_MOST, seed=seed, on_done=lambda _: tick()
            )
            samples = [numbers["gradient"] for numbers in measured.results[setting]]
            if len(samples) >= CONFIRM_LEAST:
                again = [point_of(setting, samples, bench.floor(setting, "gradient"))]
        warnings, took = [remark] if remark else [], time.perf_counter() - begun
        return sitting.model_copy(update={"again": again, "warnings": warnings, "took": took})

    def _sitting(self, title: str, bench: PictureBench | GradientBench, budget: TimeBudget) -> Sitting:
        begun, share = time.perf_counter(), budget.share(REFERENCE_SHARE)
        references = bench.refer(share, self._seed, self._stage(f"{title}: references", share))
        tick = self._stage(f"{title}: measuring every setting in rounds", budget)
        measured = benches.in_rounds(
            bench.settings, bench.measure, budget, rounds=self._config.rounds, seed=self._seed,
            on_done=lambda setting: tick(now=setting.estimator, samples=setting.spp),
        )  # fmt: skip
        points = []
        for setting, samples in measured.results.items():
            for quantity in samples[0]:
                named = replace(setting, quantity=quantity)
                points.append(point_of(named, [each[quantity] for each in samples], bench.floor(setting, quantity)))
        lines: dict[str, list[str]] = {}
        for setting in measured.left_out:
            lines.setdefault(f"{title} by {setting.estimator}", []).append(str(setting.spp))
        left_out = [f"{line}: {', '.join(counts)} samples" for line, counts in lines.items()]
        return Sitting(points=points, references=references, left_out=left_out, took=time.perf_counter() - begun)

    def _stage(self, name: str, budget: TimeBudget) -> Callable[..., None]:
        total, done = max(1, math.ceil(budget.left)), 0
        self._progress.stage(name, total, hint="counted in seconds; `seconds` sets them", at_most=True)

        def tick(**info: float | str) -> None:
            nonlocal done
            passed = min(total, total - math.ceil(budget.left))
            self._progress.advance(passed - done, **info)
            done = passed

        return tick


def lines_of(points: Sequence[PrecisionPoint]) -> dict[tuple[str, ...], list[PrecisionPoint]]:
    lines: dict[tuple[str, ...], list[PrecisionPoint]] = {}
    for point in points:
        lines.setdefault((point.quantity, point.control, point.family, point.estimator), []).append(point)
    return {key: sorted(line, key=lambda point: point.spp) for key, line in lines.items()}


def recommended(
    points: Sequence[PrecisionPoint], again: Sequence[PrecisionPoint], goal: float, round_up: RoundUp,
    or_steeper: Callable[[PrecisionPoint], bool | None] = lambda point: None,
) -> list[Recommended]:  # fmt: skip
    """Return, for each thing that can be asked for, the setting that reaches a goal soonest, if any is known to; one
    that was measured `again` by what that said."""
    asked: dict[tuple[str, ...], list[Recommended]] = {}
    for key, line in lines_of(points).items():
        found = reaching(line, goal, round_up, or_steeper(line[0]))
        asked.setdefault(key[:3], []).extend([found] if found else [])
    best = []
    for (quantity, control, family), reached in asked.items():
        chosen = min(
            reached, key=lambda row: row.seconds or 0.0, default=Recommended(quantity=quantity, control=control)
        )
        for point in again:
            if (point.control, point.estimator) == (chosen.control, chosen.estimator) and quantity == "gradient":
                chosen = confirmed(chosen, point, round_up)
        best.append(chosen.model_copy(update={"family": family}))
    return best


def timing_machine(cpu_info: Path = Path("/proc/cpuinfo")) -> room.Machine:
    used = {"torch": torch.get_num_threads()}
    if "drjit" in sys.modules:
        used["render"] = int(sys.modules["drjit"].thread_count())
    return room.Machine(cpu=processor(cpu_info), cores=threads.cores(), threads=used)
