"""`replay`: the answer of a run under other conditions than it was searched and verified under."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from advsearch import seeds
from advsearch.api.attack import LOADING, problem_from_config
from advsearch.api.keywords import ReplayKeywords, asks, configured
from advsearch.attacks import count_right
from advsearch.config import AttackConfig, ReplayConfig
from advsearch.engine.naming import different
from advsearch.engine.problem import Problem
from advsearch.engine.replaying import Way, ways_of
from advsearch.engine.retrial import RetrialCondition, Retrials
from advsearch.engine.rows import verified_rate
from advsearch.errors import InputError
from advsearch.interrupts import interruptible
from advsearch.progress import NullProgress, Progress
from advsearch.runs.answer import read_answer
from advsearch.runs.directory import CONFIG, RunDirectory, find_run
from advsearch.runs.results.attack import AttackSummary, ControlGroup
from advsearch.runs.results.base import INTERRUPTED
from advsearch.runs.results.replay import NOT_DONE, ReplayResult, ReplayRow
from advsearch.runs.summary import attack_of
from advsearch.scene.exporting.cycles import BlenderError
from advsearch.viewer.pages import write_page

if TYPE_CHECKING:
    from typing_extensions import Unpack


@asks(ReplayConfig, ReplayKeywords)
def replay(answer: str | Path, *, progress: Progress | None = None, **settings: Unpack[ReplayKeywords]) -> ReplayResult:
    """Render the answer of a run under other conditions, each beside the clean scene (docs/questions.md).

    All other arguments are the settings of `advsearch replay`. The run is kept, in `run` or under runs/.

    Args:
        answer: name or folder of a run of `attack` that has ended.
        progress: told how far it is.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    return replay_from_config(configured(ReplayConfig, answer=answer, **settings), progress=progress)


def replay_from_config(
    config: ReplayConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> ReplayResult:
    """Render an answer again as a configuration describes; every trial is stored at once, and a run goes on with the
    next.

    Raises:
        InputError: the run has no answer, or its scene is another one now.
        FileFormatError: it did not end, or is of another command.
    """
    begun, progress = time.perf_counter(), progress or NullProgress()
    progress.stage(LOADING)
    folder = find_run(config.answer)
    summary, theirs = attack_of(folder), AttackConfig.from_yaml(folder / CONFIG)
    if config.threads is not None:
        theirs = theirs.model_copy(update={"threads": config.threads})
    if summary.adversarial is None:
        raise InputError(f"{folder}: ended with {summary.ending!r}, so that there is no answer to render again")
    different((OWN_MODEL, *config.models), "model")
    problem, warnings = problem_from_config(theirs)
    u = kept_answer(folder, problem)
    ways = [*_ways(config, theirs, problem, summary), *_models(config, theirs, summary)]
    rows: list[ReplayRow] = []
    ending, renders = "done", 0
    with RunDirectory.of(config, resumed) as run:
        try:
            with interruptible():
                for way in ways:
                    if way.missing:
                        rows.append(_not_done(way, way.missing))
                        continue
                    total = 2 * config.trials
                    progress.stage(f"replaying, {way.name}: {way.text}", total, hint="`trials` or `ways` shorten it")
                    condition = way.condition()
                    before = condition.problem.renderer.renders
                    seed = seeds.stream(theirs.seed, "replay")
                    retrials = Retrials([condition], run, progress, trials=config.trials, seed=seed)
                    try:
                        rows.append(_row(way, condition, retrials, u))
                    except BlenderError as error:
                        rows.append(_not_done(way, str(error)))
                    renders += condition.problem.renderer.renders - before
        except KeyboardInterrupt:
            ending = INTERRUPTED
        result = ReplayResult(
            run=str(run.path),
            answer=str(folder),
            answered=summary.ending,
            object=summary.object,
            model=summary.model,
            task=summary.task,
            environment=summary.environment,
            controls=summary.controls,
            ending=ending,
            table=rows,
            renders=renders,
            warnings=warnings,
            seconds={"total": time.perf_counter() - begun},
            seed=theirs.seed,
            command_line=config.command_line(),
        )
        run.write_summary(result)
        write_page(run.path, result)
        return result


OWN_MODEL = "the run's own"
"""What no other model is called."""


def kept_answer(folder: Path, problem: Problem) -> torch.Tensor:
    """Return the configuration (d,) that a run answers with, of its problem loaded again.

    Raises:
        InputError: the scene is another one now.
        FileFormatError: there is none.
    """
    u = torch.from_numpy(read_answer(folder))
    if u.shape != problem.domain.start.shape:
        raise InputError(
            f"{folder}: its answer has {len(u)} numbers, and its scene has {problem.domain.dim} now: the object or "
            "advsearch has changed since; do the run again"
        )
    return u


def _spp(summary: AttackSummary) -> int:
    return summary.sample_count.spp if summary.sample_count else summary.verified.spp if summary.verified else 64


def _ways(config: ReplayConfig, theirs: AttackConfig, problem: Problem, summary: AttackSummary) -> Iterator[Way]:
    """The run's own condition, and those that are asked for."""

    def sized(size: tuple[int, int]) -> Problem:
        return problem_from_config(theirs.model_copy(update={"resolution": size}))[0]

    own, *others = ways_of(problem, _spp(summary), sized)
    yield own
    yield from (way for way in others if way.name in config.chosen)


def _models(config: ReplayConfig, theirs: AttackConfig, summary: AttackSummary) -> Iterator[Way]:
    """Other models, each shown the scene as it takes pictures."""
    for name in config.models:
        own = AttackConfig.of(theirs, model=name, ensemble=None)

        def condition(own: AttackConfig = own, name: str = name) -> RetrialCondition:
            return RetrialCondition(f"model: {name}", problem_from_config(own)[0], _spp(summary), name)

        yield Way("model", condition, name)


def _not_done(way: Way, reason: str) -> ReplayRow:
    return ReplayRow(way=way.name, condition=way.text, ending=NOT_DONE, reason=reason)


def _row(way: Way, condition: RetrialCondition, retrials: Retrials, u: torch.Tensor) -> ReplayRow:
    checked = retrials.answer("answer", u, condition)
    counted = count_right(retrials.clean(condition), condition.spp)
    return ReplayRow(
        way=way.name,
        condition=way.text,
        ending=checked.ending.value,
        clean=ControlGroup(
            correct=counted.successes, trials=counted.trials, rate=counted.rate, interval=counted.interval
        ),
        verified=verified_rate(checked.adversarial, checked.adversarial_trials),
    )
