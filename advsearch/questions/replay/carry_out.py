"""`replay`: the answer of a run under other conditions than it was searched and verified under."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from advsearch import seeds
from advsearch.api.keywords import Names, RunKeywords, asks, configured
from advsearch.engine.attack_parts import LOADING, SEARCHED_WITH, AttackParts, parts_in, problem_of_parts
from advsearch.engine.attack_result import AttackResult
from advsearch.engine.naming import different
from advsearch.engine.problem import Problem
from advsearch.engine.retrial import RetrialCondition, Retrials, kept_answer
from advsearch.engine.rows import control_group, verified_rate
from advsearch.errors import InputError
from advsearch.interrupts import interruptible
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.replay.answer import NOT_DONE, ReplayResult, ReplayRow
from advsearch.questions.replay.settings import ReplayConfig
from advsearch.questions.replay.ways import OWN_LIGHT, Way, ways_of
from advsearch.runs import made_with
from advsearch.runs.directory import RunDirectory, find_run, only_here
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.base import INTERRUPTED
from advsearch.runs.store import NAME, Store
from advsearch.runs.summary import attack_of
from advsearch.scene.exporting.cycles import BlenderError
from advsearch.viewer.pages import write_page

if TYPE_CHECKING:
    from typing_extensions import Unpack


class ReplayKeywords(RunKeywords, total=False):
    """Of `replay`."""

    ways: Names | None
    model: Names | None
    trials: int
    threads: int | None


@asks(ReplayConfig, ReplayKeywords)
def replay(
    answer: str | Path | AttackResult, *, progress: Watched = None, **settings: Unpack[ReplayKeywords]
) -> ReplayResult:
    """Render the answer of a run under other conditions, each beside the clean scene (docs/questions.md).

    All other arguments are the settings of `advsearch replay`. The run is kept, in `run` or under runs/.

    Args:
        answer: of an attack that was kept and has ended: its result, or name or folder of its run.
        progress: True shows a bar, False none, None one on a terminal; or told how far it is.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    if not isinstance(answer, AttackResult):
        return replay_from_config(configured(ReplayConfig, answer=answer, **settings), progress=watcher(progress))
    if answer.run is None:
        raise InputError("answer: expected an attack that was kept, got one that was not; give it a `run`")
    needed = [one for one in only_here(answer.run) if not one.startswith(SEARCHED_WITH)]
    config = configured(ReplayConfig, answer=answer.run, **settings).with_only_here(needed)
    return replay_from_config(
        config, progress=watcher(progress), parts=None if answer.parts is None else answer.parts()
    )


def replay_from_config(
    config: ReplayConfig,
    *,
    progress: Progress | None = None,
    resumed: Path | None = None,
    parts: AttackParts | None = None,
) -> ReplayResult:
    """Render an answer again as a configuration describes; every trial is stored at once, and a run goes on with the
    next.

    Args:
        config: what.
        progress: told how far it is.
        resumed: the folder of a run to go on with.
        parts: what the attack was asked with; None loads what its run names.

    Raises:
        InputError: the run has no answer, or its scene is another one now.
        FileFormatError: it did not end, or is of another command.
    """
    begun, progress = time.perf_counter(), progress or NullProgress()
    progress.stage(LOADING)
    folder = find_run(config.answer)
    summary = attack_of(folder)
    if summary.adversarial is None:
        raise InputError(f"{folder}: ended with {summary.ending!r}, so that there is no answer to render again")
    different((OWN_MODEL, *config.models), "model")
    parts = parts or parts_in(folder)
    threads = {} if config.threads is None else {"threads": config.threads}
    again = partial(problem_of_parts, parts, **threads)
    problem, warnings = again()
    warnings += _changed(folder, parts)
    u = kept_answer(folder, problem)
    ways = [*_ways(config, again, problem, summary), *_models(config, again, problem, summary)]
    ending, seed = "done", seeds.stream(parts.config.seed, "replay")
    with RunDirectory.of(config, resumed) as run:
        table = _Table(ways, u, config.trials, seed, run, progress)
        try:
            with interruptible():
                for batch in _batches(ways):
                    table.fill(batch)
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
            table=[row for _, row in sorted(table.rows.items())],
            renders=table.renders,
            warnings=warnings,
            seconds={"total": time.perf_counter() - begun},
            seed=parts.config.seed,
            command_line=config.command_line(),
        )
        run.write_summary(result)
        write_page(run.path, result)
        return result


@dataclass
class _Table:
    """The rows so far.

    Attributes:
        ways: the conditions of all rows.
        u: (d,) the answer.
        trials: of the answer in each row, and of the clean scene.
        seed: root of theirs.
        run: keeps them.
        progress: told of every trial.
        rows: by the place of their condition among `ways`.
        renders: pictures that were rendered.
    """

    ways: Sequence[Way]
    u: torch.Tensor
    trials: int
    seed: int
    run: RunDirectory
    progress: Progress
    rows: dict[int, ReplayRow] = field(default_factory=dict)
    renders: int = 0

    def fill(self, batch: Sequence[int]) -> None:
        """Add the rows of some conditions that share their renders: the clean scene under all of them, then the answer.

        A condition that cannot be had, or that Blender fails at, gets a row that says why.
        """
        ways = [self.ways[number] for number in batch]
        missing = next((way.missing for way in ways if way.missing), "")
        try:
            if not missing:
                self._try(batch, ways)
        except BlenderError as error:
            missing = str(error)
        if missing:
            self.rows |= {number: _not_done(way, missing) for number, way in zip(batch, ways, strict=True)}

    def _try(self, batch: Sequence[int], ways: Sequence[Way]) -> None:
        text = (
            ", ".join(dict.fromkeys(way.name for way in ways)) if len(ways) > 1 else f"{ways[0].name}: {ways[0].text}"
        )
        total = 2 * self.trials * len(ways)
        self.progress.stage(f"replaying, {text}", total, hint="`trials` or `ways` shorten it")
        conditions = [way.condition() for way in ways]
        renderers = {id(one.problem.renderer): one.problem.renderer for one in conditions}.values()
        before = sum(one.renders for one in renderers)
        retrials = Retrials(conditions, self.run, self.progress, trials=self.trials, seed=self.seed)
        try:
            for condition in conditions:
                retrials.clean(condition)
            for number, way, condition in zip(batch, ways, conditions, strict=True):
                self.rows[number] = _row(way, condition, retrials, self.u)
        finally:
            self.renders += sum(one.renders for one in renderers) - before


def _batches(ways: Sequence[Way]) -> list[list[int]]:
    """The places of the conditions that share their renders, and each of the others by itself."""
    sharing = [number for number, way in enumerate(ways) if way.shares]
    return [sharing, *([number] for number, way in enumerate(ways) if not way.shares)]


def _changed(folder: Path, parts: AttackParts) -> list[str]:
    """What a reader has to know of a file that was another one when the run was made."""
    with Store(folder / NAME, read_only=True) as results:
        noted = results.noted(made_with.NOTE)
    before = [one for one in noted if isinstance(one, dict)] if isinstance(noted, list) else []
    name = made_with.changed_file(before, made_with.made_with(parts.config.plain()))
    return [f"{name} is not what it was when the run was made: what does not hold may come from that."] if name else []


Again = Callable[..., tuple[Problem, list[str]]]
"""The problem of the run with some settings changed, and warnings; see `problem_of_parts`."""

OWN_MODEL = "the run's own"
"""What no other model is called."""


def _spp(summary: AttackSummary) -> int:
    return summary.sample_count.spp if summary.sample_count else summary.verified.spp if summary.verified else 64


def _ways(config: ReplayConfig, again: Again, problem: Problem, summary: AttackSummary) -> Iterator[Way]:
    """The run's own condition, and those that are asked for."""

    def sized(size: tuple[int, int]) -> Problem:
        return again(resolution=size)[0]

    own, *others = ways_of(problem, _spp(summary), sized)
    yield own
    yield from (way for way in others if way.name in config.chosen)


def _models(config: ReplayConfig, again: Again, problem: Problem, summary: AttackSummary) -> Iterator[Way]:
    """Other models, loaded before anything is rendered; those that are shown pictures as the run's own model is take
    its renders."""
    for name in config.models:
        other = again(model=name, ensemble=None)[0]
        shares = other.renderer.formation == problem.renderer.formation
        if shares:
            other = replace(other, renderer=problem.renderer)
        source = OWN_LIGHT if shares else name
        condition = RetrialCondition(f"model: {name}", other, _spp(summary), source, light=source)
        yield Way("model", partial(_given, condition), name, shares=shares)


def _given(condition: RetrialCondition) -> RetrialCondition:
    return condition


def _not_done(way: Way, reason: str) -> ReplayRow:
    return ReplayRow(way=way.name, condition=way.text, ending=NOT_DONE, reason=reason)


def _row(way: Way, condition: RetrialCondition, retrials: Retrials, u: torch.Tensor) -> ReplayRow:
    checked = retrials.answer("answer", u, condition)
    return ReplayRow(
        way=way.name,
        condition=way.text,
        ending=checked.ending.value,
        clean=control_group(retrials.clean(condition), condition.spp),
        verified=verified_rate(checked),
    )
