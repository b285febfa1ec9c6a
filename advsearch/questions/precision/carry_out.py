"""Error against run time of a scene as it is: what `advsearch precision` does."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from advsearch.api.keywords import DerivativeKeywords, NamedKeywords, Names, asks, configured
from advsearch.attacks import make_policy
from advsearch.cluster.executor import Call, Executor
from advsearch.engine.attack_parts import LOADING, executor_for, problem_from_config
from advsearch.engine.loading import Scene
from advsearch.engine.measuring import Results, kept_rows
from advsearch.engine.naming import AnyModel
from advsearch.engine.problem import Problem
from advsearch.errors import InputError
from advsearch.files import JsonObject
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.precision.answer import PrecisionResult, PrecisionSubject
from advsearch.questions.precision.diagrams import precision_figures
from advsearch.questions.precision.measurement import Measurement
from advsearch.questions.precision.points import Array
from advsearch.questions.precision.recommended import Section, report_of
from advsearch.questions.precision.rounds import ReferencePart, TimeBudget, timing_machine
from advsearch.questions.precision.settings import PrecisionConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.files import write_bytes, write_text
from advsearch.runs.results.attack import SharedWork
from advsearch.runs.results.base import Formation
from advsearch.runs.summary import to_json
from advsearch.settings import split_names
from advsearch.viewer.pages import write_page

if TYPE_CHECKING:
    from typing_extensions import Unpack


class PrecisionKeywords(DerivativeKeywords, NamedKeywords, total=False):
    """Of `precision`."""

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

    Args:
        config: scene, model, controls, what to measure and for how long.
        progress: told how far it is.
        resumed: the folder of a run to go on with.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    progress = progress or NullProgress()
    if config.out is None:
        with RunDirectory.of(config, resumed) as run:
            report = _measured(config, run, progress)
            report = report.model_copy(update={"figures": _write(run.path / "images", report)})
            run.write_summary(report)
            write_page(run.path, report)
            return report
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
    with _executor(config, progress) as executor:
        setup = time.perf_counter() - begun
        job, results = Measurement(config, problem, progress, policies, executor), Results(run)
        parts = [one for one in job.parts() if one.quantity in wanted]

        def sections() -> Iterator[Section]:
            left = config.seconds
            for number, part in enumerate(parts):
                share = part.share / math.fsum(one.share for one in parts[number:])
                stored = results.get(part.name, partial(part.timed, TimeBudget(share * left)))
                left = max(0.0, left - stored["seconds"])
                yield Section.of(stored["section"])

        def result(sections: Sequence[Section], ending: str) -> PrecisionResult:
            whole = Section(config.pixel_sampler)
            for one in sections:
                whole.extend(one)
            seconds = {"budget": config.seconds, "setup": setup, "total": time.perf_counter() - begun}
            path = None if run is None else str(run.path)
            facts = None if executor is None else executor.facts
            shared = SharedWork.of_facts(facts, facts.machines if facts else {})
            report = report_of(_subject(config, problem, path, ending, seconds), whole, config.error)
            return report.model_copy(update={"shared": shared})

        return kept_rows(run, results, sections(), result)


@contextmanager
def _executor(config: PrecisionConfig, progress: Progress) -> Iterator[Executor | None]:
    """Open what carries out parts of references, its first worker ready; None for this process."""
    with executor_for(
        config, "advsearch.questions.precision.carry_out:references_of", progress, ahead=False
    ) as executor:
        if executor is not None:
            progress.stage("workers load the scene and the model")
            for _ in executor.results([[None]]):
                pass
        yield executor


def references_of(settings: JsonObject) -> Call:
    """Return what carries out parts of the references of a configuration: what a worker does."""
    config = PrecisionConfig(**settings)
    job = Measurement(config, problem_from_config(config)[0], NullProgress(), {})

    def call(asked: Sequence[ReferencePart | None]) -> list[Array]:
        return [job.reference_part(one) for one in asked if one is not None]

    return call


def _subject(
    config: PrecisionConfig, problem: Problem, run: str | None, ending: str, seconds: dict[str, float]
) -> PrecisionSubject:
    """What was asked for, and on what it was measured."""
    return PrecisionSubject(
        run=run,
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
        seconds=seconds,
        seed=config.seed,
        command_line=config.command_line(),
    )


def _write(folder: Path, report: PrecisionResult) -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    figures = precision_figures(report)
    return [str(write_bytes(folder / f"{FIGURE}.{kind}", data)) for kind, data in figures.items()]
