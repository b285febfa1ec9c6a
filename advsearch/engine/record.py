"""What an attack knows so far, how long each stage took, and the rows it leaves in the run's store."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluation, SampleCount, SearchResult, StepRecord, Verification
from advsearch.attacks.smallest import Bracket
from advsearch.engine.ahead import Ahead
from advsearch.engine.machines import Machines
from advsearch.engine.memory import Memory
from advsearch.engine.problem import Problem
from advsearch.engine.rows import judged, trial_row
from advsearch.engine.transport import Predictor
from advsearch.progress import Progress
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row, Told
from advsearch.tasks import Judgement

MEASURED = ("centre", "region", "map")
"""Kinds of trials that seek no answer but see what the model says."""


KEPT = 4
"""Pictures of each group of trials that are kept."""


@dataclass
class Findings:
    """What is known so far; whatever is still None or empty was not reached.

    Attributes:
        first_look: a few renders of the clean configuration at the search's sample count.
        search: what the policy claims.
        baseline: what the random search claims.
        sample_count: how the sample count of the verification was chosen.
        clean: the control group's trials.
        verification: of the policy's answer.
        baseline_verification: of the random search's.
        unprinted: what the policy claims without print terms, where the search has them.
        unprinted_verification: of that.
        beaten: verification of the policy's own answer, where the random search's turned out worse for the model and is
            the run's answer instead.
        failures: verification of the first of the different failures that the policy answers with.
        average: trials of configurations drawn from the whole space.
        smallest: the least epsilon, where it was asked for.
        pictures: of the first trials, (H, W, 3) with 8-bit values in [0, 1], by kind and number; of a run that goes on
            only those that it made itself.
        frames: pictures of the search as 8-bit values in [0, 1], for the animation.
        interrupted: somebody pressed Ctrl-C.
        transport: what predicted the pictures of the searches, if anything did.
        rendered_because: why nothing did, in words.
        verification_renders: renders spent on choosing the sample count and on trials.
    """

    first_look: tuple[Judgement, ...] = ()
    search: SearchResult | None = None
    baseline: SearchResult | None = None
    sample_count: SampleCount | None = None
    clean: tuple[Judgement, ...] = ()
    verification: Verification | None = None
    baseline_verification: Verification | None = None
    unprinted: SearchResult | None = None
    unprinted_verification: Verification | None = None
    beaten: Verification | None = None
    failures: tuple[Verification, ...] = ()
    average: tuple[Judgement, ...] = ()
    smallest: Bracket | None = None
    pictures: dict[tuple[str, int], Tensor] = field(default_factory=dict)
    frames: list[Any] = field(default_factory=list)
    interrupted: bool = False
    transport: Predictor | None = None
    rendered_because: str = ""
    verification_renders: int = 0

    @property
    def spp(self) -> int:
        """Samples a pixel of the verification.

        Raises:
            RuntimeError: it has not been chosen yet.
        """
        if self.sample_count is None:
            raise RuntimeError("the sample count of the verification has not been chosen yet")
        return self.sample_count.spp


class Stages:
    """Tells a watcher which stage runs, and keeps the time of each.

    Attributes:
        progress: the watcher.
        seconds: time of each stage by name, in seconds.
        started: when the first began, by `time.perf_counter`.
    """

    def __init__(self, progress: Progress, started: float | None = None) -> None:
        self.progress = progress
        self.started = time.perf_counter() if started is None else started
        self.seconds: dict[str, float] = {}
        self._name = ""
        self._begun = self.started

    def begin(self, name: str, title: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        """End the stage before and begin another; a `name` that comes twice adds up. The rest: `Progress.stage`."""
        self.end()
        self._name, self._begun = name, time.perf_counter()
        self.progress.stage(title, total, hint=hint, at_most=at_most)

    def end(self) -> None:
        """End the stage that runs, if one does."""
        if self._name:
            self.seconds[self._name] = self.seconds.get(self._name, 0.0) + time.perf_counter() - self._begun
            self._name = ""

    @property
    def total(self) -> float:
        """Seconds since the first stage began."""
        return time.perf_counter() - self.started


class Recorder:
    """Writes what is evaluated to the run's store, or holds it in memory.

    Args:
        run: the open run directory, or None.
        problem: names labels and describes configurations.
        memory: what the store has already, which is not written again.
        ahead: knows on which machine a picture was made.

    Attributes:
        rows: what was evaluated, where there is no run directory.
    """

    def __init__(self, run: RunDirectory | None, problem: Problem, memory: Memory, ahead: Ahead | None = None) -> None:
        self.run = run
        self.ahead = ahead or Ahead()
        self.machines = Machines(run)
        self.rows: list[Row] = []
        self._problem = problem
        self._memory = memory
        self._renders: dict[str, int] = {}

    def step(self, kind: str, record: StepRecord, u: Tensor, evaluation: Evaluation) -> None:
        """Keep one evaluation of a search."""
        renders = record.renders - self._renders.get(kind, 0)
        self._renders[kind] = record.renders
        if self._memory.holds(kind, record.step):
            return
        problem = self._problem
        row = Row(
            kind=kind,
            step=record.step,
            seed=seeds.stream(problem.seed, kind, record.index),
            spp=problem.spp * record.samples,
            objective=record.objective,
            success=record.success,
            values=problem.describe(u),
            seconds=record.seconds,
            renders=renders * problem.draws,
            phase=record.phase,
            machine=self._machine(),
        )
        row = row if evaluation.judgement is None else judged(row, evaluation.judgement)
        self._keep(row, lambda: self._memory.told(kind, record.index, u, evaluation))

    def trial(
        self,
        kind: str,
        number: int,
        spp: int,
        trial: Judgement,
        seed: int,
        u: Tensor,
        *,
        described: bool = False,
        drawn: bool = True,
    ) -> None:
        """Keep one trial.

        Args:
            kind: what it is for.
            number: within its kind.
            spp: samples a pixel.
            trial: what came out.
            seed: of its render.
            u: (d,) of the searched controls.
            described: whether to say u, which the trials of one kind may have in common, beside the conditions.
            drawn: whether it had conditions of its own, where they vary by chance.
        """
        if self._memory.holds(kind, number):
            return
        told = self._problem.describe(u, seed) if described else {}
        told = {**told, **(self._problem.conditions_of(u, seed) if drawn else {})}
        made = self._machine()
        self._keep(trial_row(kind, number, seed, spp, trial, told, sought=kind not in MEASURED, machine=made))

    def _keep(self, row: Row, told: Callable[[], Told] | None = None) -> None:
        """Store a row, and what its evaluation told a search; hold the row where there is no store."""
        if self.run is None:
            self.rows.append(replace(row, id=len(self.rows) + 1, time=time.time()))
        else:
            self.run.record(row, told=None if told is None else told())

    def _machine(self) -> str | None:
        """The machine on which the picture of this row was made, if that is not like this one."""
        if self.ahead.executor is None:
            return None
        name = self.ahead.machine_of_row()
        self.machines.meet(name, self.ahead.facts)
        return name
