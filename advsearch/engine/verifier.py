"""Trials of configurations: at a sample count that is chosen first, with seeds of their own, kept as rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import (
    SearchResult,
    Verification,
    choose_spp,
    run_trials,
    verify,
)
from advsearch.attacks.sample_count import most_samples
from advsearch.engine.ahead import TrialAhead, line_of
from advsearch.engine.budget import RenderBudget
from advsearch.engine.memory import Memory
from advsearch.engine.problem import Problem
from advsearch.engine.record import KEPT, Findings, Recorder, Stages
from advsearch.report.wording import count
from advsearch.tasks import Judgement

MANY = 64
"""Of a configuration with more numbers than this, a trial's row does not hold the values."""


@dataclass
class Verifier:
    """Makes the trials of one run: sample count, control group, answers, and configurations one at a time.

    Attributes:
        problem: what is tried.
        budget: how many, and the sample counts to choose from.
        recorder: keeps rows.
        memory: what the run has stored already.
        stages: told which stage runs.
        findings: gets the sample count, the control group's trials, pictures and the count of renders.
    """

    problem: Problem
    budget: RenderBudget
    recorder: Recorder
    memory: Memory
    stages: Stages
    findings: Findings = field(default_factory=Findings)
    _clean_spp: int = 0
    _probed: dict[tuple[str, int], Judgement] = field(default_factory=dict)

    def choose_spp(self, candidates: dict[str, Tensor]) -> None:
        """Raise the samples until no margin drifts, under the conditions that the scene comes with."""

        ladder = self.budget.ladder
        if len(ladder) > 1:
            self.stages.begin(
                "verification",
                "finding how many samples the check needs",
                most_samples(len(candidates), ladder),
                hint="more and more samples a pixel until noise no longer moves the answer (counted in samples a "
                "pixel); `verify_spp=NUMBER` leaves it out",
                at_most=True,
            )
        margins = {name: self._probe(name, u) for name, u in candidates.items()}
        self.findings.sample_count = choose_spp(margins, seed=self.problem.seed, ladder=ladder)

    def _probe(self, name: str, u: Tensor) -> Callable[[int, int], float]:
        """Margins of one configuration by sample count and seed; what was rendered before, in this life of the run or
        in an earlier one, is not rendered again."""
        kind, count = f"sample count {name}", 0

        def margin(spp: int, seed: int) -> float:
            nonlocal count
            number, count = count, count + 1
            trial = self._probed.get((kind, number))
            if trial is None:
                trial = self.memory.trial(kind, number)
                trial = trial or self.problem.trial(u, seed, spp, drawn=False)
                self.recorder.trial(kind, number, spp, trial, seed, u, drawn=False)
                self.findings.verification_renders += 1
                self._probed[kind, number] = trial
            self.stages.progress.advance(spp)
            return trial.score

        return margin

    def try_clean(self) -> None:
        """The control group: the clean configuration under the seeds that every other group gets.

        A start that looked wrong at first has been through it before the search, at a sample count of its own.
        """
        if self.clean_tried:
            return
        kind = "first control" if self.findings.search is None else "control"
        self._clean_spp = self.findings.spp
        self._announce(kind, self.problem.domain.start, self.budget.trials)
        self.findings.clean = run_trials(
            self._numbered(kind),
            self.problem.domain.start,
            spp=self.findings.spp,
            seed=self.problem.seed,
            trials=self.budget.trials,
            group="clean",
            on_trial=self._teller(kind, self.problem.domain.start),
        )

    @property
    def clean_tried(self) -> bool:
        """Whether the control group has been through its trials at this sample count."""
        return bool(self.findings.clean) and self._clean_spp == self.findings.spp

    def verified(
        self, kind: str, found: SearchResult, *, trials: int | None = None, curtailed: bool = False
    ) -> Verification:
        """Verify one search's answer against the control group, by as many trials if no other number is given;
        `curtailed` where only the verdict matters."""
        trials = self.budget.trials if trials is None else trials
        self._announce(kind, self.problem.domain.project(found.best_u), trials)
        return verify(
            self._numbered(kind),
            self.problem.domain,
            found.best_u,
            claim=found.ending,
            spp=self.findings.spp,
            seed=self.problem.seed,
            trials=trials,
            clean=self.findings.clean[:trials],
            rule=self.problem.rule,
            on_trial=self._teller(kind, self.problem.domain.project(found.best_u)),
            curtailed=curtailed,
        )

    def _numbered(self, kind: str) -> Callable[[Tensor, int, int], Judgement]:
        """Trials of one kind, one after the other; those that are stored are read back."""
        count = 0

        def trial(u: Tensor, seed: int, spp: int) -> Judgement:
            nonlocal count
            number, count = count, count + 1
            stored = self.memory.trial(kind, number)
            if stored is not None:
                return stored
            keep = partial(self.findings.pictures.__setitem__, (kind, number)) if number < KEPT else None
            return self.recorder.ahead.trial(self.problem, u, seed, spp, keep)

        return trial

    def _announce(self, kind: str, u: Tensor, trials: int) -> None:
        """Have the trials of a configuration made beforehand that are not stored."""
        seeded = ((number, seeds.stream(self.problem.seed, "verification", number)) for number in range(trials))
        new = ((number, seed) for number, seed in seeded if self.memory.trial(kind, number) is None)
        self.recorder.ahead.begin(
            [line_of(TrialAhead(u, seed, self.findings.spp, number < KEPT)) for number, seed in new]
        )

    def trial(self, kind: str, number: int, u: Tensor) -> Judgement:
        """One trial of a configuration of its own, with a seed of its own; read back if it is stored."""
        seed, spp = self._seed(kind, number), self.findings.spp
        trial = self.memory.trial(kind, number) or self.recorder.ahead.trial(self.problem, u, seed, spp)
        self.recorder.trial(kind, number, spp, trial, seed, u, described=self.problem.domain.dim <= MANY)
        self.findings.verification_renders += 1
        return trial

    def average(self) -> None:
        """Try configurations drawn from the whole space and budget: how often the model is wrong on average."""
        if self.findings.sample_count is None:
            self.choose_spp({"clean": self.problem.domain.start})
        self.begin("trying random configurations", self.budget.average, name="average", flags="`average`")
        found, kind, numbers = list[Judgement](), "average", range(self.budget.average)
        together = self.recorder.ahead.most(self.problem.domain.dim)
        for begin in numbers[::together]:
            drawn = {number: self._drawn(number) for number in numbers[begin : begin + together]}
            new = {number: u for number, u in drawn.items() if self.memory.trial(kind, number) is None}
            trials = (TrialAhead(u, self._seed(kind, n), self.findings.spp) for n, u in new.items())
            self.recorder.ahead.begin([line_of(one) for one in trials])
            for number, u in drawn.items():
                found.append(self.trial(kind, number, u))
                self.stages.progress.advance(1, **self.recorder.ahead.told)
        self.findings.average = tuple(found)

    def _drawn(self, number: int) -> Tensor:
        """The configuration of the average case with this number."""
        generator = torch.Generator().manual_seed(seeds.stream(self.problem.seed, "draw", number))
        return self.problem.domain.sample(generator)[0]

    def _seed(self, kind: str, number: int) -> int:
        """That of a trial of a configuration of its own."""
        return seeds.stream(self.problem.seed, kind, number)

    def begin(
        self,
        title: str,
        trials: int,
        *,
        name: str = "verification",
        flags: str = "`trials` or `verify_spp`",
        at_most: bool = False,
    ) -> None:
        """Begin a stage of so many trials."""
        most = "at most " if at_most else ""
        hint = f"{most}{trials} pictures of {count(self.findings.spp, 'sample')} a pixel; {flags} shorten it"
        self.stages.begin(name, title, trials, hint=hint, at_most=at_most)

    def _teller(self, kind: str, u: Tensor) -> Callable[[str, int, Judgement], None]:
        def on_trial(group: str, number: int, trial: Judgement) -> None:
            seed = seeds.stream(self.problem.seed, "verification", number)
            self.recorder.trial(kind, number, self.findings.spp, trial, seed, u)
            self.findings.verification_renders += 1
            self.stages.progress.advance(1, **self.recorder.ahead.told)

        return on_trial
