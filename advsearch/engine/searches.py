"""Searches of one run: rendered or predicted, read back where they are stored, a random one beside the policy's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from advsearch import seeds
from advsearch.attacks import (
    Domain,
    Ending,
    Evaluation,
    Policy,
    SearchResult,
    StepRecord,
    make_policy,
    planned_renders,
    search,
)
from advsearch.attacks.evaluation import Query
from advsearch.config import AttackConfig
from advsearch.engine import surface_light
from advsearch.engine.bank import Bank
from advsearch.engine.journal import Journal
from advsearch.engine.objective import penalised
from advsearch.engine.problem import Problem
from advsearch.engine.record import Findings, Stages
from advsearch.engine.surface_light import SurfaceLight
from advsearch.engine.transport import CleanMatrix, Predictor, Transport, reason_against, remark
from advsearch.report.wording import count
from advsearch.scene.transport.matrix import TransportTooLargeError

MOST_FRAMES = 60
"""Pictures of a search that its animation has, at most."""

UNPRINTED = "search without print terms"
"""The kind of the search beside one with print terms: what these cost is told by its answer."""


@dataclass
class Searches:
    """The searches of one run.

    Attributes:
        journal: of the run.
        config: how long it searches, and what for.
        policy: what proposes.
        stages: told which stage runs.
        findings: gets the searches, their pictures and what predicts them.
        clean: the matrix that other attacks share.
    """

    journal: Journal
    config: AttackConfig
    policy: Policy[Any]
    stages: Stages
    findings: Findings
    clean: CleanMatrix

    def __post_init__(self) -> None:
        self.problem: Problem = self.journal.problem

    def collect_transport(self) -> None:
        """Make the matrix that predicts the pictures of the searches, where there can be one and it pays."""
        problem, steps, findings = self.problem, self.problem.steps, self.findings
        matrix, surface = reason_against(problem, steps, self.config.specialise), self.against_surface_light()
        if matrix is None and problem.conditions is None:
            self._prepare(Transport(problem, steps, clean=self.clean), "collecting light transport")
            return
        if surface is None:
            light = SurfaceLight(problem, steps)
            self._prepare(light, "finding the light on surfaces")
            surface = light.too_far_off
            if surface is None:
                return
            findings.transport, findings.surface_refused = None, surface
            others = "rendered" if matrix else "predicted by matrices"
            self.stages.progress.message(f"Pictures are {others}: {surface}.")
        if matrix is None:
            self._prepare(Bank(problem, steps, self.journal.traced), "collecting light transport")
            return
        self._renders_because(matrix if surface == surface_light.NO_CAMERA else surface)

    def against_surface_light(self) -> str | None:
        """Why light on surfaces does not predict the search, in words; None if it may."""
        return surface_light.reason_against(self.problem, self.problem.steps, self.policy, self.config.specialise)

    def _prepare(self, predictor: Predictor, title: str) -> None:
        """Make what predicts pictures; where its matrix would be too large, pictures are rendered."""
        hint = "from here on the search renders nothing (counted in samples a pixel); `specialise=false` leaves it out"
        self.stages.begin("transport", title, predictor.samples, hint=hint)
        self.findings.transport = predictor
        try:
            predictor.prepare(self.stages.progress.advance)
        except TransportTooLargeError as error:
            self.findings.transport = None
            self._renders_because(str(error))

    def _renders_because(self, reason: str) -> None:
        """Keep why the search renders, and say so where that needn't be."""
        self.findings.rendered_because = reason
        if told := remark(reason):
            self.stages.progress.message(told)

    def run(self) -> None:
        """The search, the same without print terms where it has them, and the random one, each with as many renders."""
        config, findings, steps = self.config, self.findings, self.problem.steps
        self.begin("search", f"searching with {self.policy.name}", steps, "`steps` or `seconds` shorten it")
        seed, frames = self.problem.seed, findings.frames
        findings.search = self.search("search", self.policy, steps, seed, frames, config.seconds)
        if config.seconds is not None:  # renders of the search itself, without those of the ranking
            steps = max(1, findings.search.history[-1].renders) if findings.search.history else 1
        if config.printable:
            title = "searching without print terms, to see what they cost"
            self.begin("without print terms", title, steps, "`printable=false` leaves both out")
            findings.unprinted = self.search(UNPRINTED, self.policy, steps, seed)
        if not config.baseline or self.policy.name == "random":
            return
        self.begin("baseline", "searching at random, to compare", steps, "`baseline=false` leaves it out")
        findings.baseline = self.search("baseline", make_policy("random"), steps, seeds.stream(seed, "baseline"))

    def search(
        self,
        kind: str,
        policy: Policy[Any],
        steps: int,
        seed: int,
        frames: list[Any] | None = None,
        seconds: float | None = None,
        domain: Domain | None = None,
        ranked: bool = True,
    ) -> SearchResult:
        """Search, reading back what is stored already; `ranked` renders the best configurations again.

        Raises:
            KeyboardInterrupt: the search was interrupted; the result of an interrupted main search is kept before.
        """

        before, every = 0, max(1, -(-steps // MOST_FRAMES))

        def on_step(record: StepRecord, u: Tensor, evaluation: Evaluation) -> None:
            nonlocal before
            if evaluation.picture is not None and frames is not None:
                frames.append(evaluation.picture.numpy())
            self.stages.progress.advance(record.renders - before, best=record.best, **self.journal.traced.told)
            before = record.renders

        def answers(queries: Sequence[Query]) -> Iterator[Evaluation]:
            if frames is not None:
                queries = [replace(one, keep=one.phase == "search" and one.number % every == 0) for one in queries]
            passed = (lambda query: None) if self.findings.transport is None else self.findings.transport.passed
            return self.journal.answers(queries, self._evaluated, passed)

        domain = self.problem.domain if domain is None else domain
        transport = self.findings.transport
        exact, drawn = (transport.exact, transport.drawn) if transport is not None else (False, False)
        found = search(
            answers,
            replace(domain, exact=exact, drawn=drawn and policy.uses_gradient),
            policy,
            steps=steps,
            seed=seed,
            candidates=4 if ranked else 0,
            close=self.config.close_looks,
            late=self.journal.clock(kind, seconds),
            on_step=on_step,
            kind=kind,
            noise=self.problem.seed,
        )
        if found.ending is Ending.INTERRUPTED:
            self.findings.search = self.findings.search or found
            raise KeyboardInterrupt
        return found

    def _evaluated(self, queries: Sequence[Query]) -> Iterator[Evaluation]:
        """Have queries of one search answered: predicted where something predicts, and traced otherwise."""
        transport, traced = self.findings.transport, self.journal.traced
        predicted = transport is not None and bool(queries) and queries[0].phase == "search"
        answers = transport.answered(queries, traced) if transport is not None and predicted else traced(queries)
        for query, answer in zip(queries, answers, strict=True):
            printed = self.config.printable and query.kind != UNPRINTED
            yield penalised(answer, self.problem.searched_space, query.u) if printed else answer

    def begin(self, name: str, title: str, steps: int, shorter: str) -> None:
        """Begin the stage of a search of at most so many steps, and its ranking."""
        renders = planned_renders(steps, close=self.config.close_looks)
        hint = f"{renders} pictures of {count(self.problem.spp, 'sample')} a pixel; {shorter}"
        if self.findings.transport is not None:
            hint = f"{steps} pictures predicted and {renders - steps} traced; {shorter}"
        self.stages.begin(name, title, renders, hint=hint, at_most=True)
