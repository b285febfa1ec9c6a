"""Trials of configurations: at a sample count that is chosen first, with seeds of their own, kept as rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluation, SearchResult, Verification, choose_spp, run_trials, verify
from advsearch.attacks.draws import batches
from advsearch.attacks.evaluation import Query, most_at_once
from advsearch.attacks.sample_count import LADDER, margins_of, most_samples
from advsearch.config.scene import SceneConfig
from advsearch.engine.journal import Journal, digest
from advsearch.engine.problem import Problem
from advsearch.engine.record import KEPT, Findings, Stages
from advsearch.engine.transport import Predictor
from advsearch.report.wording import count as plural
from advsearch.scene.formation import next_count
from advsearch.tasks import Judgement

MANY = 64
"""Of a configuration with more numbers than this, a trial's row does not hold the values."""


def ladder_of(config: SceneConfig) -> Sequence[int]:
    """Return the samples a pixel that a verification climbs, as the sampler has them; the only count, if one was asked
    for."""
    asked = getattr(config, "verify_spp", None)
    return LADDER if asked is None else (next_count(config.pixel_sampler, asked),)


@dataclass
class Verifier:
    """Makes the trials of one run: sample count, control group, answers, and configurations one at a time.

    Attributes:
        journal: of the run.
        ladder: samples a pixel to choose from; a single count is taken as it is.
        stages: told which stage runs.
        findings: gets the sample count, the control group's trials, pictures and the count of renders.
        looks: trials of each group; of several numbers, those after which the verdict may stand.
    """

    journal: Journal
    ladder: Sequence[int]
    stages: Stages
    findings: Findings = field(default_factory=Findings)
    looks: tuple[int, ...] = (0,)
    _clean_spp: int = 0
    _clean_kind: str = "control"
    _asked: set[tuple[str, int]] = field(default_factory=set)
    _known: dict[tuple[bytes, int, int], Evaluation] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.problem: Problem = self.journal.problem

    @property
    def count(self) -> int:
        """Trials of each group, at most."""
        return self.looks[-1]

    def answers(
        self, queries: Sequence[Query], *, in_samples: bool = False, predictor: Predictor | None = None
    ) -> Iterator[Evaluation]:
        """Answer trials, keep their pictures, and count each once; the bar counts them, or their samples a pixel.

        A trial of which the search for the sample count has the answer already is not rendered again. A `predictor`
        answers what it can in place of renders, which alone are counted.
        """
        made = self._made if predictor is None else partial(predictor.answered, traced=self._made)
        for query, answer in zip(queries, self.journal.answers(queries, made), strict=True):
            if answer.picture is not None:
                self.findings.pictures[query.kind, query.number] = answer.picture
            if in_samples and self.problem.conditions is None:
                self._known[_asked(query)] = answer
            if answer.predicted:
                self.findings.predicted_trials += 1
            elif in_samples or _asked(query) not in self._known:
                self._asked.add((query.kind, query.number))
            self.findings.verification_renders = len(self._asked)
            self.stages.progress.advance(query.spp if in_samples else 1, **self.journal.traced.told)
            yield answer

    def _made(self, queries: Sequence[Query]) -> Iterator[Evaluation]:
        """Answers that are in no row: known from another row, or else made."""
        known = [self._known.get(_asked(query)) for query in queries]
        new = iter(self.journal.traced([one for one, answer in zip(queries, known, strict=True) if answer is None]))
        for answer in known:
            yield next(new) if answer is None else replace(answer, cost=0)

    def choose_spp(self, candidates: dict[str, Tensor]) -> None:
        """Raise the samples until more would not change the verdict, under the conditions that the scene comes with."""

        ladder, trials = self.ladder, self.looks[0] if self.problem.conditions is None else 0
        if len(ladder) > 1:
            self.stages.begin(
                "verification",
                "finding how many samples the check needs",
                most_samples(len(candidates), ladder, trials),
                hint="more and more samples a pixel until noise no longer moves the answer (counted in samples a "
                "pixel); `verify_spp=NUMBER` leaves it out",
                at_most=True,
            )
        answers = partial(self.answers, in_samples=True)
        margins = {name: margins_of(answers, f"sample count {name}", u, keep=KEPT) for name, u in candidates.items()}
        self.findings.sample_count = choose_spp(margins, seed=self.problem.seed, ladder=ladder, trials=trials)

    def try_clean(self) -> None:
        """The control group: the clean configuration under the seeds that every other group gets.

        A start that looked wrong at first has been through it before the search, at a sample count of its own.
        """
        if self.clean_tried:
            return
        self._clean_spp = self.findings.spp
        self._clean_kind = "first control" if self.findings.search is None else "control"
        self.findings.clean = run_trials(
            self.answers,
            self.problem.domain.start,
            spp=self.findings.spp,
            seed=self.problem.seed,
            trials=self.looks[0],
            kind=self._clean_kind,
            keep=KEPT,
        )

    @property
    def clean_tried(self) -> bool:
        """Whether the control group has been through its trials at this sample count."""
        return bool(self.findings.clean) and self._clean_spp == self.findings.spp

    def verified(
        self, kind: str, found: SearchResult, *, trials: int | None = None, curtailed: bool = False
    ) -> Verification:
        """Verify one search's answer against the control group, by as many trials if no other number is given;
        `curtailed` where only the verdict matters. A control group that has too few trials gets more."""
        clean = self.findings.clean
        checked = verify(
            self.answers,
            self.problem.domain,
            found.best_u,
            claim=found.ending,
            spp=self.findings.spp,
            seed=self.problem.seed,
            trials=self.looks if trials is None else trials,
            clean=clean if trials is None else clean[:trials],
            rule=self.problem.rule,
            kind=kind,
            control=self._clean_kind,
            keep=KEPT,
            curtailed=curtailed,
        )
        if len(checked.clean_trials) > len(clean):
            self.findings.clean = checked.clean_trials
        return checked

    def trials(
        self,
        kind: str,
        configurations: Mapping[int, Tensor],
        *,
        sought: bool = True,
        predictor: Predictor | None = None,
    ) -> Iterator[Judgement]:
        """Try configurations once each, every one with a seed of its own, by their numbers among those of a kind; a
        `predictor` as for `answers`."""
        problem, queries = self.problem, list[Query]()
        for number, u in configurations.items():
            seed = seeds.stream(problem.seed, kind, number)
            values = problem.describe(u, seed) if problem.domain.dim <= MANY else {}
            queries.append(Query(u, seed, kind, number, spp=self.findings.spp, values=values, sought=sought))
        for answer in self.answers(queries, predictor=predictor):
            yield answer.said

    def average(self, count: int) -> None:
        """Try configurations drawn from the whole space and budget: how often the model is wrong on average."""
        problem, found = self.problem, list[Judgement]()
        self.begin("trying random configurations", count, name="average", flags="`average`")
        for numbers in batches(0, count, most_at_once(problem.domain.dim)):
            generators = [torch.Generator().manual_seed(seeds.stream(problem.seed, "draw", one)) for one in numbers]
            drawn = [problem.domain.sample(one)[0] for one in generators]
            found += self.trials("average", dict(zip(numbers, drawn, strict=True)))
        self.findings.average = tuple(found)

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
        hint = f"{most}{trials} pictures of {plural(self.findings.spp, 'sample')} a pixel; {flags} shorten it"
        self.stages.begin(name, title, trials, hint=hint, at_most=at_most)


def _asked(query: Query) -> tuple[bytes, int, int]:
    """What tells the picture of a trial from others, where no conditions are drawn."""
    return digest(query.u), query.seed, query.spp
