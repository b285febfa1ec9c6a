"""Trials of configurations, kept as rows: of what was found, of different failures,
also on other models.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import (
    Ending,
    Evaluation,
    SearchResult,
    Verification,
    choose_spp,
    run_trials,
    verify,
)
from advsearch.attacks.domain import batches
from advsearch.attacks.evaluation import Query, most_at_once
from advsearch.attacks.trials import (
    CONDITIONS,
    LADDER,
    OVER_LADDER,
    SampleCount,
    affordable,
    choose_rate_spp,
    margins_of,
    most_samples,
)
from advsearch.cluster import Workers
from advsearch.engine.journal import Journal, Shared
from advsearch.engine.problem import Problem
from advsearch.engine.record import KEPT, Findings
from advsearch.engine.transport import PredictedSearch
from advsearch.errors import InputError
from advsearch.progress import Progress, Stages
from advsearch.report.wording import count as plural
from advsearch.runs.directory import RunDirectory
from advsearch.runs.summary import read_configuration
from advsearch.scene.color import to_8_bit
from advsearch.scene.formation import next_count
from advsearch.tasks import Judgement

# of a configuration with more numbers than this, a trial's row does not hold the values
MANY = 64


def ladder_of(verify_spp: int | None, sampler: str) -> Sequence[int]:
    """Return the samples per pixel that a verification climbs, as the sampler has them:
    one, if it is stated.
    """
    return LADDER if verify_spp is None else (next_count(sampler, verify_spp),)


@dataclass
class Verifier:
    """Makes the trials of one run: sample count (of a ladder; a single one is taken as
    it is), control group, adversarial configurations, and configurations one at a time.
    Each group has as many trials as the last of `calibrates`; after those before, the
    verdict may stand. What comes of them, pictures and the count of renders are in
    `findings`. Rows say of a success where some prediction is `sought`.
    """

    journal: Journal
    ladder: Sequence[int]
    stages: Stages
    findings: Findings = field(default_factory=Findings)
    looks: tuple[int, ...] = (0,)
    sought: bool = True
    _clean_spp: int = 0
    _clean_kind: str = "control"
    _asked: set[tuple[str, int]] = field(default_factory=set)

    @classmethod
    def open(
        cls, run: RunDirectory, problem: Problem, ladder: Sequence[int], stages: Stages
    ) -> Verifier:
        """Return what makes the trials of a run in this process, and stores them."""
        return cls(Journal(run, Shared(problem)), ladder, stages)

    def __post_init__(self) -> None:
        self.problem: Problem = self.journal.problem

    @property
    def count(self) -> int:
        return self.looks[-1]

    def evaluate_all(
        self,
        queries: Sequence[Query],
        *,
        in_samples: bool = False,
        predictor: PredictedSearch | None = None,
    ) -> Iterator[Evaluation]:
        """Answer trials, keep their pictures, and count each once; the bar counts them,
        or their samples a pixel. A `predictor` answers what it can in place of renders,
        which alone are counted.
        """
        made = (
            None
            if predictor is None
            else partial(predictor.evaluate_all, traced=self.journal.traced)
        )
        queries = (
            queries
            if self.sought
            else [replace(query, sought=False) for query in queries]
        )
        for query, evaluation in zip(
            queries, self.journal.evaluate_all(queries, made), strict=True
        ):
            if evaluation.picture is not None:
                self.findings.pictures[query.kind, query.number] = evaluation.picture
            if evaluation.predicted:
                self.findings.predicted_trials += 1
            else:
                self._asked.add((query.kind, query.number))
            self.findings.verification_renders = len(self._asked)
            self.stages.progress.advance(
                query.spp if in_samples else 1, **self.journal.traced.told
            )
            yield evaluation

    def choose_spp(
        self, candidates: dict[str, Tensor], searched: int | None = None
    ) -> None:
        """Raise the samples until more would not change the verdict: under the
        conditions that the scene comes with, or until they would not change the share
        of conditions, where these vary. There, searches that took so many samples bound
        those of the check.
        """
        over = self.problem.conditions is not None
        ladder = self.ladder
        trials = self.looks[0]
        choose: Callable[..., SampleCount] = partial(choose_spp, trials=trials)
        most = most_samples(len(candidates), ladder, trials)
        if over:
            if len(ladder) > 1:
                ladder = OVER_LADDER
                if searched is not None:
                    ladder = affordable(
                        ladder, (len(candidates) + 1) * self.count, searched
                    )
            choose = choose_rate_spp
            most = CONDITIONS * len(candidates) * sum(ladder)
        if len(ladder) > 1:
            hint = (
                "more and more samples a pixel until noise no longer moves the result "
                "(counted in samples a pixel); "
                "`verify_spp=NUMBER` leaves it out"
            )
            title = "finding how many samples the check needs"
            self.stages.begin("verification", title, most, hint=hint, at_most=True)
        evaluate = partial(self.evaluate_all, in_samples=True)
        margins = {
            name: margins_of(evaluate, f"sample count {name}", u, keep=KEPT, drawn=over)
            for name, u in candidates.items()
        }
        self.findings.sample_count = choose(
            margins, seed=self.problem.seed, ladder=ladder
        )

    def try_clean(self) -> None:
        """The control group: the clean configuration under the seeds that every other
        group gets.

        A start that looked wrong at first has been through it before the search, at a
        sample count of its own.
        """
        if self.clean_tried:
            return
        self._clean_spp = self.findings.spp
        self._clean_kind = (
            "first control" if self.findings.search is None else "control"
        )
        self.findings.clean = run_trials(
            self.evaluate_all,
            self.problem.domain.start,
            spp=self._clean_spp,
            seed=self.problem.seed,
            trials=self.looks[0],
            kind=self._clean_kind,
            keep=KEPT,
        )

    @property
    def clean_tried(self) -> bool:
        return bool(self.findings.clean) and self._clean_spp == self.findings.spp

    def verified(
        self,
        kind: str,
        found: SearchResult,
        *,
        curtailed: bool = False,
        again: bool = False,
    ) -> Verification:
        """Verify what one search found against the control group; `curtailed` where
        only the verdict matters. A control group that has too few trials gets more.
        `again`: in trials after all others, both groups anew.
        """
        checked = verify(
            self.evaluate_all,
            self.problem.domain,
            found.best_u,
            claim=found.ending,
            spp=self.findings.spp,
            seed=self.problem.seed,
            trials=self.looks,
            clean=() if again else self.findings.clean,
            rule=self.problem.rule,
            kind=kind,
            control=self._clean_kind,
            keep=KEPT,
            curtailed=curtailed,
            begin=self.count if again else 0,
        )
        if not again:
            self.findings.clean = checked.clean_trials
        return checked

    def trials(
        self,
        kind: str,
        configurations: Mapping[int, Tensor],
        *,
        sought: bool = True,
        predictor: PredictedSearch | None = None,
    ) -> Iterator[Judgement]:
        """Try configurations once each, every one with a seed of its own, by their
        numbers among those of a kind; a `predictor` as for `evaluate_all`.
        """
        problem = self.problem
        queries = list[Query]()
        for number, u in configurations.items():
            seed = seeds.stream(problem.seed, kind, number)
            values = problem.describe(u, seed) if problem.domain.dim <= MANY else {}
            queries.append(
                Query(
                    u,
                    seed,
                    kind,
                    number,
                    spp=self.findings.spp,
                    values=values,
                    sought=sought,
                )
            )
        for evaluation in self.evaluate_all(queries, predictor=predictor):
            yield evaluation.said

    def trials_of(
        self,
        kind: str,
        count: int,
        find_configuration: Callable[[int], Tensor],
        *,
        sought: bool = True,
        predictor: PredictedSearch | None = None,
    ) -> Iterator[Judgement]:
        """Try configurations of a kind, numbered from 0, in batches that fit into
        memory; see `trials`.
        """
        for numbers in batches(0, count, most_at_once(self.problem.domain.dim)):
            configurations = {number: find_configuration(number) for number in numbers}
            yield from self.trials(
                kind, configurations, sought=sought, predictor=predictor
            )

    def average(self, count: int) -> None:
        """Try configurations drawn from the whole space and budget: how often the model
        is wrong on average.
        """
        problem = self.problem
        self.begin(
            "trying random configurations", count, name="average", flags="`average`"
        )

        def draw(number: int) -> Tensor:
            generator = torch.Generator().manual_seed(
                seeds.stream(problem.seed, "draw", number)
            )
            return problem.domain.sample(generator)[0]

        self.findings.average = tuple(self.trials_of("average", count, draw))

    def begin(
        self,
        title: str,
        trials: int,
        *,
        name: str = "verification",
        flags: str = "`trials` or `verify_spp`",
        at_most: bool = False,
    ) -> None:
        most = "at most " if at_most else ""
        hint = (
            f"{most}{trials} pictures of {plural(self.findings.spp, 'sample')} a "
            f"pixel; {flags} shorten it"
        )
        self.stages.begin(name, title, trials, hint=hint, at_most=at_most)


@dataclass(frozen=True, eq=False)
class RetrialCondition:
    """What a configuration is tried under. Conditions of equal source are shown the
    same picture before it is changed: (H, W, 3) sRGB in [0, 1], by the seed of its
    trial; those of equal light get theirs from one linear radiance, as their scenes are
    the same and only tone curves or models differ (None: this one renders by itself).
    `change` goes from the picture and the seed of the trial to what the model is shown.
    """

    name: str
    problem: Problem
    spp: int
    source: Hashable
    change: Callable[[Tensor, int], Tensor] | None = None
    light: Hashable = None


class Retrials:
    """Tries the clean scene and adversarial ones under conditions, each in so many
    trials; what the run has stored already is read back. Trial k has the same seed, of
    a root that nothing else uses, for all of them. An executor's workers hold the
    problems by the names of their conditions; without, pictures are made here.
    """

    def __init__(
        self,
        conditions: Sequence[RetrialCondition],
        run: RunDirectory,
        progress: Progress,
        *,
        trials: int,
        seed: int,
        executor: Workers | None = None,
    ) -> None:
        self._progress = progress
        self._count = trials
        self._seed = seed
        first = Journal(run, Shared(conditions[0].problem))
        self._journals = {
            condition.name: replace(
                first, traced=Shared(condition.problem, executor, condition.name)
            )
            for condition in conditions
        }
        self._clean: dict[str, tuple[Judgement, ...]] = {}
        self._pictures: dict[tuple[Hashable, int, int], Tensor] = {}
        self._lights: dict[tuple[Hashable, int, int], Tensor] = {}
        self._sharing = Counter(
            condition.light for condition in conditions if condition.light is not None
        )
        self._pictured = ""

    def clean(self, condition: RetrialCondition) -> tuple[Judgement, ...]:
        if condition.name not in self._clean:
            self._clean[condition.name] = run_trials(
                partial(self._evaluations, "clean", condition),
                condition.problem.domain.start,
                spp=condition.spp,
                seed=self._seed,
                trials=self._count,
                kind=f"clean under {condition.name}",
            )
        return self._clean[condition.name]

    def adversarial(
        self, kind: str, u: Tensor, condition: RetrialCondition
    ) -> Verification:
        """Try a configuration (d,) under one condition, beside the clean scene; a claim
        of nothing is never confirmed. Its rows are called "KIND under CONDITION".
        """
        return verify(
            partial(self._evaluations, kind, condition),
            condition.problem.domain,
            u,
            claim=Ending.NOT_VERIFIED,
            spp=condition.spp,
            seed=self._seed,
            trials=self._count,
            clean=self.clean(condition),
            rule=condition.problem.rule,
            kind=f"{kind} under {condition.name}",
        )

    def _evaluations(
        self, kind: str, condition: RetrialCondition, queries: Sequence[Query]
    ) -> Iterator[Evaluation]:
        changed = partial(self._changed, kind, condition)
        for evaluation in self._journals[condition.name].evaluate_all(queries, changed):
            self._progress.advance(1)
            yield evaluation

    def _changed(
        self, kind: str, condition: RetrialCondition, queries: Sequence[Query]
    ) -> Iterator[Evaluation]:
        """Judge pictures as the condition changes them; those of the present
        configuration are kept for others.
        """
        if kind != self._pictured:
            self._pictures.clear()
            self._lights.clear()
            self._pictured = kind
        problem = condition.problem
        shared = self._journals[condition.name].traced
        keys = [(condition.source, query.seed, condition.spp) for query in queries]
        new = [
            replace(q, wanted="picture")
            for q, key in zip(queries, keys, strict=True)
            if key not in self._pictures
        ]
        sent = iter(shared(new) if shared.executor is not None and len(new) > 1 else ())
        for query, key in zip(queries, keys, strict=True):
            machine = None
            if key not in self._pictures:
                evaluation = next(sent, None)
                if evaluation is None or evaluation.picture is None:  # it is made here
                    self._pictures[key] = self._rendered(condition, query.u, query.seed)
                else:
                    self._pictures[key], machine = (
                        evaluation.picture,
                        evaluation.machine,
                    )
            picture = self._pictures[key]
            picture = (
                picture
                if condition.change is None
                else condition.change(picture, query.seed)
            )
            said = problem.judge(to_8_bit(picture), problem.whole(query.u, query.seed))
            yield Evaluation.of(said, machine=machine)

    def _rendered(self, condition: RetrialCondition, u: Tensor, seed: int) -> Tensor:
        """As `Problem.picture`, from the radiance of other conditions with the same
        light where there are any.
        """
        problem = condition.problem
        key = (condition.light, seed, condition.spp)
        if self._sharing[condition.light] < 2:
            return problem.picture(u, seed, condition.spp)
        renderer = problem.renderer
        whole = problem.whole(u, seed)
        with torch.no_grad():
            if key not in self._lights:
                self._lights[key] = renderer.radiance(whole, seed, condition.spp)
            return to_8_bit(
                renderer.space.picture(
                    whole, renderer.formation.display(self._lights[key])
                )
            )


def kept_configuration(folder: Path, problem: Problem) -> torch.Tensor:
    u = torch.from_numpy(read_configuration(folder))
    if u.shape != problem.domain.start.shape:
        raise InputError(
            f"{folder}: its configuration has {len(u)} numbers, and its scene has "
            f"{problem.domain.dim} now: the "
            "object or advsearch has changed since; do the run again"
        )
    return u
