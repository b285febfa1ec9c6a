"""Searches of one run: rendered or predicted, read back where they are stored, a random one beside the policy's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from torch import Tensor

from advsearch import seeds
from advsearch.attacks import (
    Domain,
    Ending,
    Evaluate,
    Evaluation,
    Policy,
    SearchResult,
    StepRecord,
    make_policy,
    planned_renders,
    search,
)
from advsearch.attacks.search import Line
from advsearch.engine.ahead import AheadLine, evaluation_ahead
from advsearch.engine.bank import Bank
from advsearch.engine.budget import RenderBudget
from advsearch.engine.memory import TRANSPORT, Frames, Memory
from advsearch.engine.print_terms import less_print_terms, penalised
from advsearch.engine.problem import OnImage, Problem
from advsearch.engine.record import Findings, Recorder, Stages
from advsearch.engine.transport import CleanMatrix, Transport, reason_against, remark
from advsearch.report.wording import count
from advsearch.scene.transport.renderer import TransportTooLargeError

UNPRINTED = "search without print terms"
"""The kind of the search beside one with print terms: what these cost is told by its answer."""


@dataclass
class Searches:
    """The searches of one run.

    Attributes:
        problem: what is attacked.
        budget: how many evaluations.
        policy: what proposes.
        recorder: keeps rows.
        memory: what the run has stored already.
        stages: told which stage runs.
        findings: gets the searches, their pictures and what predicts them.
        specialise: whether pictures may be predicted.
        clean: the matrix that other attacks share.
    """

    problem: Problem
    budget: RenderBudget
    policy: Policy[Any]
    recorder: Recorder
    memory: Memory
    stages: Stages
    findings: Findings
    specialise: bool
    clean: CleanMatrix

    def collect_transport(self) -> None:
        """Make the matrix that predicts the pictures of the searches, where there can be one and it pays."""
        problem, steps, findings = self.problem, self.budget.steps, self.findings
        self._renders_because(reason_against(problem, steps, self.specialise) or "")
        if findings.rendered_because:
            return
        stored, keep = self.memory.note(TRANSPORT), partial(self.memory.set_note, TRANSPORT)
        if problem.conditions is None:
            findings.transport = Transport(problem, steps, renewals=stored or {}, keep=keep, clean=self.clean)
        else:
            findings.transport = Bank(problem, steps, grown=stored or [], keep=keep, ahead=self.recorder.ahead)
        hint = "from here on the search renders nothing (counted in samples a pixel); `specialise=false` leaves it out"
        self.stages.begin("transport", "collecting light transport", findings.transport.samples, hint=hint)
        try:
            findings.transport.prepare(self.stages.progress.advance)
        except TransportTooLargeError as error:
            findings.transport = None
            self._renders_because(str(error))

    def _renders_because(self, reason: str) -> None:
        """Keep why the search renders, and say so where that needn't be."""
        self.findings.rendered_because = reason
        if told := remark(reason):
            self.stages.progress.message(told)

    def run(self) -> None:
        """The search, the same without print terms where it has them, and the random one, each with as many renders."""
        budget, findings, seed = self.budget, self.findings, self.problem.seed
        frames = Frames(budget.steps)
        findings.frames = frames.pictures
        self.begin("search", f"searching with {self.policy.name}", budget.steps, "`steps` or `seconds` shorten it")
        findings.search = self.search("search", self.policy, budget.steps, self.problem.seed, frames, budget.seconds)
        steps = budget.steps if budget.seconds is None else _spent(findings.search)
        if self.problem.printable:
            title = "searching without print terms, to see what they cost"
            self.begin("without print terms", title, steps, "`printable=false` leaves both out")
            findings.unprinted = self.search(UNPRINTED, self.policy, steps, seed)
        if not budget.baseline or self.policy.name == "random":
            return
        self.begin("baseline", "searching at random, to compare", steps, "`baseline=false` leaves it out")
        findings.baseline = self.search("baseline", make_policy("random"), steps, seeds.stream(seed, "baseline"))

    def search(
        self,
        kind: str,
        policy: Policy[Any],
        steps: int,
        seed: int,
        frames: Frames | None = None,
        seconds: float | None = None,
        domain: Domain | None = None,
        ranked: bool = True,
    ) -> SearchResult:
        """Search, reading back what is stored already; `ranked` renders the best configurations again.

        Raises:
            KeyboardInterrupt: the search was interrupted; the result of an interrupted main search is kept before.
        """

        before = 0

        def on_step(record: StepRecord, u: Tensor, evaluation: Evaluation) -> None:
            nonlocal before
            self.recorder.step(kind, record, u, evaluation)
            self.stages.progress.advance(record.renders - before, best=record.best, **self.recorder.ahead.told)
            before = record.renders

        def announce(lines: Callable[[], Sequence[Line]]) -> None:
            if not self.recorder.ahead.begun:
                self.recorder.ahead.begin([self._ahead(line, kind, frames) for line in lines()])

        domain = self.problem.domain if domain is None else domain
        found = search(
            self._evaluator(kind, frames),
            self._as_evaluated(domain, policy),
            policy,
            steps=steps,
            seed=seed,
            candidates=4 if ranked else 0,
            close=self.budget.close_looks,
            late=self.memory.clock(kind, steps, seconds),
            on_step=on_step,
            announce=None if self.findings.transport is not None else announce,
            together=self.recorder.ahead.most(domain.dim),
        )
        if found.ending is Ending.INTERRUPTED:
            self.findings.search = self.findings.search or found
            raise KeyboardInterrupt
        return found

    def _ahead(self, line: Line, kind: str, frames: Frames | None) -> AheadLine:
        """A line of evaluations, without those that are stored."""
        problem, answer = self.problem, None
        while True:
            try:
                coming = next(line) if answer is None else line.send(answer)
            except StopIteration:
                return
            answer = self.memory.evaluation(kind, coming.step)
            if answer is None:
                one, kept = coming.proposal, _kept(frames, coming.index)
                answer = yield evaluation_ahead(problem, kind, one.u, coming.index, one.gradient, one.samples, kept)
                answer = penalised(answer, problem.searched_space, one.u) if self._penalises(kind) else answer

    def _as_evaluated(self, domain: Domain, policy: Policy[Any]) -> Domain:
        """The domain with what is known of the noise of its evaluations."""
        transport = self.findings.transport
        drawn = isinstance(transport, Bank) and policy.uses_gradient
        return replace(domain, exact=isinstance(transport, Transport), drawn=drawn)

    def _evaluator(self, kind: str, frames: Frames | None) -> Evaluate:
        """What the evaluations of a search come from: rendered, or predicted; what is stored is read back."""
        transport = self.findings.transport

        def make(tell: OnImage | None) -> Evaluate:
            made = (self.problem if transport is None else transport).evaluator(kind, tell)
            if transport is None and self.recorder.ahead.executor is not None:
                made = self.recorder.ahead.evaluator(self.problem, made, kind, tell)
            return less_print_terms(made, self.problem.searched_space) if self._penalises(kind) else made

        if transport is None:
            return self.memory.evaluator(kind, make, frames)
        return self.memory.evaluator(kind, make, frames, transport.passed)

    def _penalises(self, kind: str) -> bool:
        """Whether print terms are taken from the objective of a search."""
        return self.problem.printable and kind != UNPRINTED

    def begin(self, name: str, title: str, steps: int, shorter: str) -> None:
        """Begin the stage of a search of at most so many steps, and its ranking."""
        renders = planned_renders(steps, close=self.budget.close_looks)
        hint = f"{renders} pictures of {count(self.problem.spp, 'sample')} a pixel; {shorter}"
        if self.findings.transport is not None:
            hint = f"{steps} pictures predicted and {renders - steps} traced; {shorter}"
        self.stages.begin(name, title, renders, hint=hint, at_most=True)


def _kept(frames: Frames | None, index: int) -> bool:
    """Whether somebody wants the picture of an evaluation."""
    return frames is not None and frames.wants(index)


def _spent(found: SearchResult) -> int:
    """Renders of the search itself, without those of the ranking."""
    return max(1, found.history[-1].renders) if found.history else 1
