"""The stages of an attack, one after the other: first look, search, random search beside it, verification."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
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
    Verification,
    choose_spp,
    count_right,
    make_policy,
    planned_renders,
    run_trials,
)
from advsearch.attacks import search as run_search
from advsearch.attacks import verify as run_verify
from advsearch.attacks.sample_count import most_samples
from advsearch.attacks.smallest import ATTEMPTS, MOST_CHECKS, ROUNDS, confirmed, scaled, smallest
from advsearch.engine.bank import Bank
from advsearch.engine.bounces import WORTH, bounces_of, most_pictures
from advsearch.engine.budget import Preparation, RenderBudget
from advsearch.engine.gradients import inside
from advsearch.engine.memory import PLAN, TRANSPORT, Frames, Memory
from advsearch.engine.planning import cosine_samples, cosines, measured_plan, plan_gradients, tuned
from advsearch.engine.problem import Problem
from advsearch.engine.record import KEPT, Findings, Recorder, Stages
from advsearch.engine.transport import Transport, reason_against
from advsearch.interrupts import interruptible
from advsearch.report.wording import count
from advsearch.scene.transport.renderer import TransportTooLargeError
from advsearch.tasks import Judgement

FIRST_LOOK = 4
"""Renders of the clean configuration before the search; wrong in all of them, it goes through the full trials first."""

CONFIRMED = 40
"""Trials in a row that the upper end of a smallest epsilon has to pass, or as many checks as have them."""

MANY = 64
"""Of a configuration with more numbers than this, a trial's row does not hold the values."""


@dataclass
class Attack:
    """One search on one problem with its verification; what is known so far is in `findings`.

    Attributes:
        problem: what is attacked.
        budget: what it may spend.
        policy: what proposes.
        recorder: keeps rows.
        memory: what the run has stored already.
        stages: told which stage runs.
        preparation: what is measured before.
        findings: filled by `carry_out`.
    """

    problem: Problem
    budget: RenderBudget
    policy: Policy[Any]
    recorder: Recorder
    memory: Memory
    stages: Stages
    preparation: Preparation = field(default_factory=Preparation)
    findings: Findings = field(default_factory=Findings)
    _clean_spp: int = 0
    _probed: dict[tuple[str, int], Judgement] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._asked_spp = self.problem.spp  # a preparation may choose another one for the search

    def carry_out(self) -> Findings:
        """Do everything; what an interrupt leaves undone is missing from the findings."""
        if self.budget.smallest:
            scaled(self.problem.domain, 1.0)  # refuses what has no budget before anything is rendered
        try:
            with interruptible():
                self.plan()
                if self.worth_attacking():
                    self.collect_transport()
                    if self.budget.smallest:
                        find_smallest(self)
                    else:
                        self.search()
                    self.verify()
                if self.budget.average:
                    self.average()
        except KeyboardInterrupt:
            self.findings.interrupted = True
        self.stages.end()
        return self.findings

    # ---- before the search ------------------------------------------------------------------------------------------

    def plan(self) -> None:
        """Measure the gradient plan, or take the one that the run was begun with."""
        problem, stored = self.problem, self.memory.note(PLAN)
        if stored is None:
            self._cut_paths()
            self._measure()
            chosen = {"plan": problem.plan.to_dict(), "spp": problem.spp, "search_depth": problem.search_depth}
            self.memory.set_note(PLAN, chosen)
            return
        problem.plan = problem.plan.restored(stored["plan"])
        problem.spp, problem.search_depth = stored["spp"], stored.get("search_depth")

    def _cut_paths(self) -> None:
        """Leave bounces of light out of the search's renders, where it is long enough for that to pay."""
        problem, wanted = self.problem, self.preparation
        if wanted.specialise and (wanted.measure == "full" or self.budget.steps >= WORTH):
            self.stages.begin(
                "setup",
                "finding how many bounces of light the search needs",
                most_pictures(problem),
                hint="few samples each; `specialise=false` leaves it out",
                at_most=True,
            )
            problem.search_depth = bounces_of(problem, problem.seed, tick=self._advance).depth

    def _measure(self) -> None:
        """Replace the first gradient plan by a measured one, as far as the preparation wants that."""
        problem, wanted = self.problem, self.preparation
        renderer, full = problem.renderer, wanted.measure == "full"
        if wanted.measure == "no" or not self.policy.uses_gradient:
            return
        if not full and reason_against(problem, self.budget.steps, wanted.specialise) is None:
            return  # derivatives will come from what predicts the pictures
        u, seed = inside(renderer), seeds.stream(problem.seed, "measure")
        gradients = plan_gradients(renderer.plan, every=full)
        if gradients:
            self.stages.begin(
                "setup",
                "measuring which gradients are best here",
                gradients,
                hint=f"{gradients} gradients of {count(problem.spp, 'sample')} a pixel; `measure=no` leaves it out",
            )
        problem.plan = measured_plan(
            renderer,
            problem.loss,
            u,
            seed=seed,
            spp=problem.spp,
            every=full,
            counted=not full or wanted.counted,
            tick=self._advance,
        )
        if full:
            self.stages.begin(
                "setup",
                "choosing step and samples of gradients",
                cosine_samples(problem.plan),
                hint="counted in samples a pixel; `measure=quick` leaves it out",
                at_most=True,
            )
            table = list(cosines(renderer, problem.loss, u, seed=seed, tick=self._advance))
            plan, spp = tuned(problem.plan, table)
            problem.plan = plan
            problem.spp = spp if wanted.chosen_spp and spp is not None else problem.spp

    def worth_attacking(self) -> bool:
        """Look at the clean configuration; one that is wrong in every look goes through the full trials at once, as
        does one whose smallest change is wanted."""
        problem, budget, findings = self.problem, self.budget, self.findings
        seed, start = seeds.stream(problem.seed, "first look"), problem.domain.start
        self.stages.begin(
            "setup", "looking at the clean scene", FIRST_LOOK, hint="the first picture compiles the renderer's code"
        )
        findings.first_look = run_trials(
            problem.trial,
            start,
            spp=self._asked_spp,
            seed=seed,
            trials=FIRST_LOOK,
            on_trial=lambda *_: self._advance(),
        )
        looks_right = any(trial.right for trial in findings.first_look)
        if not self.problem.rule.control or (looks_right and not budget.smallest):
            return True
        self.choose_spp({"clean": start})
        self._begin_trials("checking the clean scene with fresh renders", budget.trials)
        self.clean_trials()
        return not self.problem.rule.already_wrong(count_right(findings.clean, findings.spp))

    # ---- searching --------------------------------------------------------------------------------------------------

    def search(self) -> None:
        """The search, and the random one beside it, with as many renders."""
        budget, findings, seed = self.budget, self.findings, self.problem.seed
        frames = Frames(budget.steps)
        findings.frames = frames.pictures
        self._begin_search(
            "search", f"searching with {self.policy.name}", budget.steps, "`steps` or `seconds` shorten it"
        )
        findings.search = self.one_search(
            "search", self.policy, budget.steps, self.problem.seed, frames, budget.seconds
        )
        if not budget.baseline or self.policy.name == "random":
            return
        steps = budget.steps if budget.seconds is None else _spent(findings.search)
        self._begin_search("baseline", "searching at random, to compare", steps, "`baseline=false` leaves it out")
        findings.baseline = self.one_search("baseline", make_policy("random"), steps, seeds.stream(seed, "baseline"))

    def one_search(
        self,
        kind: str,
        policy: Policy[Any],
        steps: int,
        seed: int,
        frames: Frames | None = None,
        seconds: float | None = None,
        domain: Domain | None = None,
    ) -> SearchResult:
        """Search, reading back what is stored already.

        Raises:
            KeyboardInterrupt: the search was interrupted; the result of an interrupted main search is kept before.
        """

        before = 0

        def on_step(record: StepRecord, u: Tensor, evaluation: Evaluation) -> None:
            nonlocal before
            self.recorder.step(kind, record, u, evaluation)
            self.stages.progress.advance(record.renders - before, best=record.best)
            before = record.renders

        domain = self.problem.domain if domain is None else domain
        found = run_search(
            self._evaluator(kind, frames),
            replace(domain, exact=True) if isinstance(self.findings.transport, Transport) else domain,
            policy,
            steps=steps,
            seed=seed,
            close=self.budget.close_looks,
            late=self.memory.clock(kind, steps, seconds),
            on_step=on_step,
        )
        if found.ending is Ending.INTERRUPTED:
            self.findings.search = self.findings.search or found
            raise KeyboardInterrupt
        return found

    def _evaluator(self, kind: str, frames: Frames | None) -> Evaluate:
        """What the evaluations of a search come from: rendered, or predicted; what is stored is read back."""
        transport = self.findings.transport
        if transport is None:
            return self.memory.evaluator(kind, lambda tell: self.problem.evaluator(kind, tell), frames)
        return self.memory.evaluator(kind, lambda tell: transport.evaluator(kind, tell), frames, transport.passed)

    def collect_transport(self) -> None:
        """Make the matrix that predicts the pictures of the searches, where there can be one and it pays."""
        problem, steps, findings = self.problem, self.budget.steps, self.findings
        findings.rendered_because = reason_against(problem, steps, self.preparation.specialise) or ""
        if findings.rendered_because:
            return
        stored, keep = self.memory.note(TRANSPORT), partial(self.memory.set_note, TRANSPORT)
        if problem.conditions is None:
            findings.transport = Transport(problem, steps, renewals=stored or {}, keep=keep)
        else:
            findings.transport = Bank(problem, steps, grown=stored or [], keep=keep)
        hint = "from here on the search renders nothing (counted in samples a pixel); `specialise=false` leaves it out"
        self.stages.begin("transport", "collecting light transport", findings.transport.samples, hint=hint)
        try:
            findings.transport.prepare(self._advance)
        except TransportTooLargeError as error:
            findings.transport, findings.rendered_because = None, str(error)

    # ---- verification -----------------------------------------------------------------------------------------------

    def verify(self) -> None:
        """Choose the sample count, then try the clean configuration, the answer and the baseline's with equal seeds."""
        findings, problem = self.findings, self.problem
        found, baseline = findings.search, findings.baseline
        if found is None:
            raise RuntimeError("nothing was searched, so there is nothing to verify")
        answer = problem.domain.project(found.best_u)
        self.choose_spp({"clean": problem.domain.start, "adversarial": answer})
        groups = 1 + (baseline is not None) + (not self._clean_tried)
        self._begin_trials("checking the answer with fresh renders", groups * self.budget.trials, at_most=True)
        self.clean_trials()
        findings.verification = self.verified("verification", found)
        if findings.verification.ending is Ending.ALREADY_WRONG:
            findings.smallest = None  # seen with other samples than before: no change at all flips the answer
        if baseline is not None:
            decided = findings.verification.ending is Ending.FOUND
            findings.baseline_verification = self.verified("baseline verification", baseline, curtailed=decided)
            self._take_the_worse(found, baseline)

    def _take_the_worse(self, found: SearchResult, baseline: SearchResult) -> None:
        """Let the random search's answer be the run's if it is the worse one for the model, and remember that."""
        findings = self.findings
        own, other = findings.verification, findings.baseline_verification
        if own is None or other is None or _rank(other) <= _rank(own):
            return
        findings.beaten, findings.verification = own, other
        findings.search = replace(
            found,
            best_u=baseline.best_u,
            best_objective=baseline.best_objective,
            claimed_objective=baseline.claimed_objective,
            success_rate=baseline.success_rate,
            distribution=None,
        )

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

    def clean_trials(self) -> None:
        """The control group: the clean configuration under the seeds that every other group gets.

        A start that looked wrong at first has been through it before the search, at a sample count of its own.
        """
        if self._clean_tried:
            return
        kind = "first control" if self.findings.search is None else "control"
        self._clean_spp = self.findings.spp
        self.findings.clean = run_trials(
            self._trial(kind),
            self.problem.domain.start,
            spp=self.findings.spp,
            seed=self.problem.seed,
            trials=self.budget.trials,
            group="clean",
            on_trial=self._teller(kind, self.problem.domain.start),
        )

    @property
    def _clean_tried(self) -> bool:
        """Whether the control group has been through its trials at this sample count."""
        return bool(self.findings.clean) and self._clean_spp == self.findings.spp

    def verified(self, kind: str, found: SearchResult, *, curtailed: bool = False) -> Verification:
        """Verify one search's answer against the control group; `curtailed` where only the verdict matters."""
        return run_verify(
            self._trial(kind),
            self.problem.domain,
            found.best_u,
            claim=found.ending,
            spp=self.findings.spp,
            seed=self.problem.seed,
            trials=self.budget.trials,
            clean=self.findings.clean,
            rule=self.problem.rule,
            on_trial=self._teller(kind, self.problem.domain.project(found.best_u)),
            curtailed=curtailed,
        )

    def _trial(self, kind: str) -> Callable[[Tensor, int, int], Judgement]:
        """Trials of one kind, one after the other; those that are stored are read back."""
        count = 0

        def trial(u: Tensor, seed: int, spp: int) -> Judgement:
            nonlocal count
            number, count = count, count + 1
            stored = self.memory.trial(kind, number)
            if stored is not None:
                return stored
            if number >= KEPT:
                return self.problem.trial(u, seed, spp)
            return self.problem.trial(u, seed, spp, keep=partial(self.findings.pictures.__setitem__, (kind, number)))

        return trial

    def one_trial(self, kind: str, number: int, u: Tensor) -> Judgement:
        """One trial of a configuration of its own, with a seed of its own; read back if it is stored."""
        seed, spp = seeds.stream(self.problem.seed, kind, number), self.findings.spp
        trial = self.memory.trial(kind, number) or self.problem.trial(u, seed, spp)
        self.recorder.trial(kind, number, spp, trial, seed, u, described=self.problem.domain.dim <= MANY)
        self.findings.verification_renders += 1
        return trial

    def average(self) -> None:
        """Try configurations drawn from the whole space and budget: how often the model is wrong on average."""
        if self.findings.sample_count is None:
            self.choose_spp({"clean": self.problem.domain.start})
        self._begin_trials("trying random configurations", self.budget.average, name="average", flags="`average`")
        found: list[Judgement] = []
        for number in range(self.budget.average):
            generator = torch.Generator().manual_seed(seeds.stream(self.problem.seed, "draw", number))
            u = self.problem.domain.sample(generator)[0]
            found.append(self.one_trial("average", number, u))
            self._advance()
        self.findings.average = tuple(found)

    def _begin_search(self, name: str, title: str, steps: int, shorter: str) -> None:
        """Begin the stage of a search of at most so many steps, and its ranking."""
        renders = planned_renders(steps, close=self.budget.close_looks)
        hint = f"{renders} pictures of {count(self.problem.spp, 'sample')} a pixel; {shorter}"
        if self.findings.transport is not None:
            hint = f"{steps} pictures predicted and {renders - steps} traced; {shorter}"
        self.stages.begin(name, title, renders, hint=hint, at_most=True)

    def _begin_trials(
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

    def _advance(self, steps: int = 1) -> None:
        self.stages.progress.advance(steps)

    def _teller(self, kind: str, u: Tensor) -> Callable[[str, int, Judgement], None]:
        def on_trial(group: str, number: int, trial: Judgement) -> None:
            seed = seeds.stream(self.problem.seed, "verification", number)
            self.recorder.trial(kind, number, self.findings.spp, trial, seed, u)
            self.findings.verification_renders += 1
            self.stages.progress.advance(1)

        return on_trial


def _rank(verification: Verification) -> tuple[bool, int, float]:
    """How bad an answer is for the model: found, then successes, then the mean margin."""
    scores = [trial.score for trial in verification.adversarial_trials]
    mean = sum(scores) / len(scores)
    mean = mean if mean == mean else -math.inf
    return verification.ending is Ending.FOUND, verification.adversarial.successes, mean


def _spent(found: SearchResult) -> int:
    """Renders of the search itself, without those of the ranking."""
    return max(1, found.history[-1].renders) if found.history else 1


# ---- the smallest change --------------------------------------------------------------------------------------------


def find_smallest(attack: Attack) -> None:
    """Bracket the smallest epsilon; every claim on the way goes through trials with seeds of its own.

    What is verified at the end is the configuration at the upper end of the bracket.
    """
    problem, budget, findings = attack.problem, attack.budget, attack.findings
    results: list[SearchResult] = []

    def found(inside: Domain, number: int) -> Tensor:
        attack._begin_search(
            "search", f"search {number + 1} of at most {ROUNDS}", budget.steps, "`steps` shortens each search"
        )
        kind, seed = f"search {number}" if number else "search", seeds.stream(problem.seed, "smallest", number)
        results.append(attack.one_search(kind, attack.policy, budget.steps, seed, domain=inside))
        attack._begin_trials("trying smaller changes", MOST_CHECKS * budget.trials, at_most=True)
        return results[-1].best_u

    def passes(u: Tensor, check: int) -> bool:
        failures, allowed = 0, problem.rule.allowed(budget.trials)
        for number in range(budget.trials):
            failures += not attack.one_trial(f"check {check}", number, u).success
            attack._advance()
            if failures > allowed:
                return False
        return True

    times = -(-CONFIRMED // budget.trials)
    likely = findings.transport.likely if isinstance(findings.transport, Transport) else None
    bracket = smallest(found, passes, problem.domain, likely=likely)
    if bracket.u is not None:
        most = ATTEMPTS * times * budget.trials
        attack._begin_trials("checking the smallest change", most, at_most=True)
    bracket = confirmed(bracket, passes, problem.domain, times=times)
    renders, gradients = sum(one.renders for one in results), sum(one.gradients for one in results)
    answer = results[0].best_u if bracket.u is None else bracket.u
    ending = results[0].ending if bracket.u is None else Ending.FOUND
    findings.smallest = bracket
    own = results[0 if bracket.u is None else bracket.found_by]
    findings.search = replace(own, best_u=answer, ending=ending, renders=renders, gradients=gradients)
