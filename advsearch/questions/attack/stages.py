"""The stages of an attack, one after the other: first look, search, random search beside it, verification. For the
smallest change that flips the prediction, searches and trials take turns, within ever smaller budgets."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
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
    Verification,
    count_right,
    make_policy,
    planned_renders,
    run_trials,
    search,
)
from advsearch.attacks.candidates import ATTEMPTS, MOST_CHECKS, ROUNDS, confirmed, scaled, smallest
from advsearch.attacks.evaluation import Query
from advsearch.attacks.verification import OVER_LOOKS, TRIAL_LOOKS
from advsearch.engine import surface_light
from advsearch.engine.bank import Bank
from advsearch.engine.gradients import planning
from advsearch.engine.gradients.bench import Bench, interior_point
from advsearch.engine.journal import PLAN, Journal
from advsearch.engine.judging import penalised
from advsearch.engine.problem import Problem
from advsearch.engine.record import Findings
from advsearch.engine.surface_light import SurfaceLight
from advsearch.engine.transport import CleanMatrix, PredictedSearch, Transport, refusal_of_matrices, remark
from advsearch.engine.verifier import Verifier, ladder_of
from advsearch.interrupts import interruptible
from advsearch.progress import Stages
from advsearch.questions.attack.ambient import find_ambient
from advsearch.questions.attack.settings import AttackConfig
from advsearch.report.wording import count
from advsearch.scene.predictor import Refusal, RefusalCause
from advsearch.scene.transport.matrix import TransportTooLargeError

MOST_FRAMES = 60
UNPRINTED = "search without print terms"
"""The kind of the search beside one with print terms: what these cost is told by its result."""
"""The note of what the model and the objective said of the first look, and of what it consists for each picture."""
FIRST_LOOK = 4
"""Renders of the clean configuration before the search; wrong in all of them, it goes through the full trials first."""


@dataclass
class Attack:
    """One search on one problem with its verification; what is known so far is in `findings`. Attacks with other
    budgets share the matrix `clean`."""

    journal: Journal
    config: AttackConfig
    policy: Policy[Any]
    stages: Stages
    findings: Findings = field(default_factory=Findings)
    clean: CleanMatrix = field(default_factory=CleanMatrix)

    def __post_init__(self) -> None:
        self.problem: Problem = self.journal.problem
        self._asked_spp = self.problem.spp  # a preparation may choose another one for the search
        looks = TRIAL_LOOKS if self.problem.conditions is None else OVER_LOOKS
        if self.config.trials is not None or self.config.smallest:
            looks = (self.config.trial_count,)
        self._verifier = Verifier(self.journal, ladder_of(self.config), self.stages, self.findings, looks)

    def carry_out(self) -> Findings:
        if self.config.smallest:
            scaled(self.problem.domain, 1.0)  # refuses what has no budget before anything is rendered
        try:
            with interruptible():
                self.plan()
                if self.worth_attacking():
                    self.collect_transport()
                    if self.config.smallest:
                        find_smallest(self, self._verifier)
                    else:
                        self.search_all()
                    self.verify()
                if self.config.average:
                    self._verifier.average(self.config.average)
        except KeyboardInterrupt:
            self.findings.interrupted = True
        self.stages.end()
        return self.findings

    def plan(self) -> None:
        problem, config, stored = self.problem, self.config, self.journal.note(PLAN)
        if stored is not None:
            problem.plan = problem.plan.restored(stored["plan"])
            problem.spp, problem.search_depth = stored["spp"], stored["search_depth"]
            return
        worth = config.specialise and (config.measure == "full" or problem.steps >= planning.WORTH_BOUNCES)
        against = surface_light.refusal_of_surface_light(problem, problem.steps, self.policy, config.specialise)
        if worth and against is not None:  # else no step will be rendered
            title, most = "finding how many bounces of light the search needs", planning.most_pictures(problem)
            hint = "few samples each; `specialise=false` leaves it out"
            self.stages.begin("setup", title, most, hint=hint, at_most=True)
            tick = self.stages.progress.advance
            problem.search_depth = planning.bounces_of(problem, problem.seed, tick=tick).depth
        self._measure()
        chosen = {"plan": problem.plan.to_dict(), "spp": problem.spp, "search_depth": problem.search_depth}
        self.journal.set_note(PLAN, chosen)

    def _measure(self) -> None:
        problem, config, progress = self.problem, self.config, self.stages.progress
        full = config.measure == "full"
        if config.measure == "no" or not self.policy.uses_gradient:
            return
        if not full and refusal_of_matrices(problem, problem.steps, config.specialise) is None:
            return  # derivatives will come from what predicts the pictures
        renderer, counted = problem.renderer, not full or config.deterministic
        seed = seeds.stream(problem.seed, "measure")
        u, tick = interior_point(renderer), lambda samples: progress.advance(1)
        bench = Bench(renderer, problem.loss, u, seed, problem.spp, tick=tick)
        gradients = planning.plan_gradients(renderer.plan, every=full)
        if gradients:
            hint = f"{gradients} gradients of {count(problem.spp, 'sample')} a pixel; `measure=no` leaves it out"
            self.stages.begin("setup", "measuring which gradients are best here", gradients, hint=hint)
        problem.plan = planning.measured_plan(bench, every=full, counted=counted)
        if full:
            samples = planning.cosine_samples(problem.plan)
            hint = "counted in samples a pixel; `measure=quick` leaves it out"
            self.stages.begin("setup", "choosing step and samples of gradients", samples, hint=hint, at_most=True)
            table = list(planning.cosines(replace(bench, tick=progress.advance)))
            problem.plan, spp = planning.tuned(problem.plan, table)
            problem.spp = spp if config.spp is None and spp is not None else problem.spp

    def worth_attacking(self) -> bool:
        """Look at the clean configuration; one that is wrong in every look goes through the full trials at once, as
        does one whose smallest change is wanted."""
        problem, config, findings = self.problem, self.config, self.findings
        spp, seed, start = self._asked_spp, seeds.stream(problem.seed, "first look"), problem.domain.start
        hint = "the first picture compiles the renderer's code"
        self.stages.begin("setup", "looking at the clean scene", FIRST_LOOK, hint=hint)

        def look(query: Query) -> Evaluation:
            evaluation = problem.evaluate(query)
            self.stages.progress.advance(1)
            return evaluation

        findings.first_look = run_trials(partial(map, look), start, spp=spp, seed=seed, trials=FIRST_LOOK)
        looks_right = any(trial.right for trial in findings.first_look)
        if not problem.rule.control or (looks_right and not config.smallest):
            return True
        self._verifier.choose_spp({"clean": start})
        self._verifier.begin("checking the clean scene with fresh renders", self._verifier.looks[0])
        self._verifier.try_clean()
        return not problem.rule.already_wrong(count_right(findings.clean, findings.spp))

    def verify(self) -> None:
        """Choose the sample count, then try the clean configuration, the adversarial configuration, that without print
        terms and the baseline's with equal seeds.

        The smallest change lies at the decision, where no sample count settles the margin: it is tried with that of the
        clean configuration, as on the way to it.
        """
        findings, problem, verifier = self.findings, self.problem, self._verifier
        answered, baseline, unprinted = findings.search, findings.baseline, findings.unprinted
        if answered is None:
            raise RuntimeError("nothing was searched, so there is nothing to verify")
        adversarial = problem.domain.project(answered.best_u)
        searched = [result for result in (answered, baseline, unprinted) if result is not None]
        if not self.config.smallest or findings.sample_count is None:
            pictures = sum((result.renders + result.gradients) * problem.draws for result in searched)
            candidates = {"adversarial": adversarial, "clean": problem.domain.start}
            verifier.choose_spp(candidates, searched=pictures * problem.spp)
        groups = len(searched) + (not verifier.clean_tried)
        verifier.begin("checking what was found with fresh renders", groups * verifier.count, at_most=True)
        verifier.try_clean()
        findings.verification = verifier.verified("verification", answered)
        if findings.verification.ending is Ending.ALREADY_WRONG:
            findings.smallest = None  # seen with other samples than before: no change at all flips the prediction
        if unprinted is not None:
            findings.unprinted_verification = verifier.verified("unprinted verification", unprinted)
        if baseline is not None:
            decided = findings.verification.ending is Ending.FOUND
            findings.baseline_verification = verifier.verified("baseline verification", baseline, curtailed=decided)
            self._take_the_worse(answered, baseline)
        if not self.config.smallest:
            check_failures(verifier, answered)
        if findings.verification.ending is Ending.FOUND:
            find_ambient(verifier, findings.verification.u)

    def _take_the_worse(self, result: SearchResult, baseline: SearchResult) -> None:
        """Let what the random search found be the run's if it is found and the worse one for the model, and remember
        that. It is chosen by its trials, so these are no evidence: it has to be the worse one in fresh ones, too."""
        findings = self.findings
        by_policy, by_chance = findings.verification, findings.baseline_verification
        if by_policy is None or by_chance is None or by_chance.ending is not Ending.FOUND:
            return
        if _rank(by_chance) <= _rank(by_policy):
            return
        title = "checking what the random search found again"
        self._verifier.begin(title, 2 * self._verifier.count, at_most=True)
        by_chance = self._verifier.verified("baseline verification", baseline, again=True)
        findings.baseline_verification = by_chance
        if _rank(by_chance) > _rank(by_policy):
            findings.beaten, findings.verification = by_policy, by_chance
            names = ("best_u", "best_objective", "claimed_objective", "success_rate")
            taken = {name: getattr(baseline, name) for name in names}
            findings.search = replace(result, **taken, distribution=None)

    def collect_transport(self) -> None:
        problem, steps, findings = self.problem, self.problem.steps, self.findings
        specialise = self.config.specialise
        matrix = refusal_of_matrices(problem, steps, specialise)
        surface = surface_light.refusal_of_surface_light(problem, steps, self.policy, specialise)
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
        too_short = not findings.surface_refused and refusal_of_matrices(problem, None, specialise) is None
        is_about_matrices = too_short or surface.cause is RefusalCause.NO_CAMERA
        self._renders_because(matrix if is_about_matrices else surface)

    def _prepare(self, predictor: PredictedSearch, title: str) -> None:
        hint = "from here on the search renders nothing (counted in samples a pixel); `specialise=false` leaves it out"
        self.stages.begin("transport", title, predictor.samples, hint=hint)
        self.findings.transport = predictor
        try:
            predictor.prepare(self.stages.progress.advance)
        except TransportTooLargeError as error:
            self.findings.transport = None
            self._renders_because(Refusal(str(error), RefusalCause.TOO_LARGE))

    def _renders_because(self, refusal: Refusal) -> None:
        self.findings.rendered_because = refusal
        if text := remark(refusal):
            self.stages.progress.message(text)

    def search_all(self) -> None:
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
        self, kind: str, policy: Policy[Any], steps: int, seed: int, frames: list[Any] | None = None,
        seconds: float | None = None, domain: Domain | None = None, ranked: bool = True,
    ) -> SearchResult:  # fmt: skip
        """Search, reading back what is stored already; `ranked` renders the best configurations again. Raises
        KeyboardInterrupt where it was interrupted; the result of an interrupted main search is kept before."""
        before, every = 0, max(1, -(-steps // MOST_FRAMES))

        def on_step(record: StepRecord, u: Tensor, evaluation: Evaluation) -> None:
            nonlocal before
            if evaluation.picture is not None and frames is not None:
                frames.append(evaluation.picture.numpy())
            self.stages.progress.advance(record.renders - before, best=record.best, **self.journal.traced.told)
            before = record.renders

        def evaluations(queries: Sequence[Query]) -> Iterator[Evaluation]:
            if frames is not None:
                queries = [
                    replace(query, keep=query.phase == "search" and query.number % every == 0) for query in queries
                ]
            passed = (lambda query: None) if transport is None else transport.passed
            return self.journal.evaluate_all(queries, self._evaluated, passed)

        transport = self.findings.transport
        exact, drawn = (transport.exact, transport.drawn) if transport is not None else (False, False)
        result = search(
            evaluations, replace(domain or self.problem.domain, exact=exact, drawn=drawn and policy.uses_gradient),
            policy, steps=steps, seed=seed, candidates=4 if ranked else 0, close=self.config.close_looks,
            late=self.journal.clock(kind, seconds), on_step=on_step, kind=kind, noise=self.problem.seed,
        )  # fmt: skip
        if result.ending is Ending.INTERRUPTED:
            self.findings.search = self.findings.search or result
            raise KeyboardInterrupt
        return result

    def _evaluated(self, queries: Sequence[Query]) -> Iterator[Evaluation]:
        transport, traced = self.findings.transport, self.journal.traced
        predicts = transport if queries and queries[0].phase == "search" else None
        evaluations = traced(queries) if predicts is None else predicts.evaluate_all(queries, traced)
        for query, evaluation in zip(queries, evaluations, strict=True):
            printed = self.config.printable and query.kind != UNPRINTED
            yield penalised(evaluation, self.problem.searched_space, query.u) if printed else evaluation

    def begin(self, name: str, title: str, steps: int, shorter: str) -> None:
        renders = planned_renders(steps, close=self.config.close_looks)
        hint = f"{renders} pictures of {count(self.problem.spp, 'sample')} a pixel; {shorter}"
        if self.findings.transport is not None:
            hint = f"{steps} pictures predicted and {renders - steps} traced; {shorter}"
        self.stages.begin(name, title, renders, hint=hint, at_most=True)


CONFIRMED = 40  # Trials in a row that the upper end of a smallest epsilon has to pass, or as many checks as have them


def find_smallest(attack: Attack, verifier: Verifier) -> None:
    """Bracket the smallest epsilon; every claim on the way goes through trials with seeds of its own.

    On the way the fewest trials that can verify anything are enough where none fails. The upper end is tried again in
    full, and what is verified at the end is the configuration there.
    """
    problem, findings, trials = attack.problem, attack.findings, verifier.count
    results: list[SearchResult] = []
    transport = findings.transport if isinstance(findings.transport, Transport) else None

    def searched(inside: Domain, number: int) -> Tensor:
        title = f"search {number + 1} of at most {ROUNDS}"
        attack.begin("search", title, problem.steps, "`steps` shortens each search")
        kind, seed = f"search {number}" if number else "search", seeds.stream(problem.seed, "smallest", number)
        ranked = transport is None  # what is predicted has no noise
        results.append(attack.search(kind, attack.policy, problem.steps, seed, domain=inside, ranked=ranked))
        findings.search = findings.search or results[0]  # what was found if this is interrupted
        verifier.begin("trying smaller changes", MOST_CHECKS * trials, at_most=True)
        return results[-1].best_u

    def passes(u: Tensor, check: int, few: int = trials) -> bool:
        allowed, scores, failures = problem.rule.allowed(trials), list[float](), 0
        while len(scores) < trials and failures <= allowed and (failures or len(scores) < few):
            (trial,) = verifier.trials(f"check {check}", {len(scores): u})
            scores.append(trial.score)
            failures += not trial.success
        if transport is not None:
            transport.correct(u, scores)
        if failures <= allowed:
            findings.search = replace(results[-1], best_u=u)
        return failures <= allowed

    def seems(u: Tensor, check: int) -> bool:
        return passes(u, check, problem.rule.fewest)

    times = -(-CONFIRMED // trials)
    bracket = smallest(searched, seems, problem.domain, likely=None if transport is None else transport.likely)
    if bracket.u is not None:
        verifier.begin("checking the smallest change", ATTEMPTS * times * trials, at_most=True)
    findings.smallest = bracket = confirmed(bracket, passes, problem.domain, times=times)
    winner = results[0]
    if bracket.u is not None:
        winner = replace(results[bracket.found_by], best_u=bracket.u, ending=Ending.FOUND)
    renders, gradients = (sum(getattr(result, name) for result in results) for name in ("renders", "gradients"))
    findings.search = replace(winner, renders=renders, gradients=gradients)


def _rank(verification: Verification) -> tuple[bool, float, float]:
    scores = [trial.score for trial in verification.counting]
    mean = sum(scores) / len(scores)
    return verification.ending is Ending.FOUND, verification.adversarial.rate, mean if mean == mean else -math.inf


TRIED = 8  # Different failures that are tried, at most: the first of the list


def check_failures(verifier: Verifier, result: SearchResult) -> None:
    """Verify the first of the different failures that a search found, each for itself: by the trials of the adversarial
    configuration, with the seeds that the control group had, up to the first that decides against it.

    Over conditions that vary one of them takes hundreds of trials, and nothing is tried here.
    """
    problem, findings = verifier.problem, verifier.findings
    known, rule = result.failures, problem.rule
    if known is None or not known.listed or rule.conditional or rule.already_wrong(count_right(findings.clean, 1)):
        return
    tried = known.listed[:TRIED]
    verifier.begin("checking different failures with fresh renders", len(tried) * verifier.count, at_most=True)
    findings.failures = tuple(
        verifier.verified(f"failure {number}", replace(result, best_u=failure.u), curtailed=True)
        for number, failure in enumerate(tried)
    )
