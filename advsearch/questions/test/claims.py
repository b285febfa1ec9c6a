"""How each kind of claim is tried: drawn pictures, a search, or the trials of a
counterexample.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice, repeat
from typing import Any

import torch
from torch import Tensor

from advsearch.extend import (
    AttackConfig,
    InputError,
    Problem,
    Progress,
    RunContext,
    RunDirectory,
    SceneConfig,
    policies,
    seeds,
    settings,
    statistics,
    tasks,
    wording,
    workbench,
)
from advsearch.questions.test import result as words
from advsearch.questions.test import settings as suites
from advsearch.questions.test.counterexamples import (
    TRIALS,
    Counterexample,
    decide_trials,
    is_over,
    outcome_of,
    scene_digest,
)
from advsearch.questions.test.result import (
    FAILED,
    HELD,
    TIME_OVER,
    UNDECIDED,
    Cause,
    ClaimResult,
)
from advsearch.questions.test.settings import (
    AnyClaim,
    ChangeClaim,
    NoWorseClaim,
    RightClaim,
    ShareClaim,
)

MANY = 4  # values of a configuration that are said in words, at most
# of a configuration with more numbers, a picture's row does not hold the values
MOST_KEPT = 64
ChangePicture = Callable[["workbench.Query", Tensor], Tensor]
"""Goes from a query and its picture to the picture that the other side is shown."""
AHEAD = 2  # pictures that are asked for at once, for each worker
ATTACK_WORKER = "advsearch.questions.attack.carry_out:attack_worker"
CLAIM_WORKER = "advsearch.questions.test.claims:claim_worker"


@dataclass
class Trial:
    """What claims are tried with, since `begun` by the clock; `warnings` gets what a
    reader has to know.
    """

    context: RunContext[suites.SuiteConfig]
    suite: suites.Suite
    begun: float
    warnings: list[str]

    @property
    def run(self) -> RunDirectory:
        return self.context.run

    @property
    def config(self) -> suites.SuiteConfig:
        return self.context.config

    @property
    def progress(self) -> Progress:
        return self.context.progress

    @property
    def passed(self) -> float:
        return time.perf_counter() - self.begun

    @property
    def seconds(self) -> float:
        return self.config.seconds or self.suite.seconds or math.inf

    @property
    def late(self) -> bool:
        return self.passed >= self.seconds

    def claim(
        self, asked: ClaimResult, claim: AnyClaim, config: SceneConfig
    ) -> ClaimResult:
        if isinstance(claim, ShareClaim | NoWorseClaim):
            return self._by_pictures(asked, claim, config)
        assert isinstance(config, AttackConfig)
        seconds = min(
            max(0.001, self.seconds - self.passed), config.seconds or math.inf
        )
        shared = {"workers": self.config.workers, "cluster": self.config.cluster}
        limited = {**shared, "seconds": seconds if math.isfinite(seconds) else None}
        own = config.model_copy(update=limited).with_only_here(config.only_here)
        summary = self.context.run_part(asked.name, own)
        assert isinstance(summary, workbench.AttackSummary)
        self.warnings += summary.warnings
        planned = own.model_copy(update={"steps": own.steps or summary.steps})
        verdict, reason, cause = words.search_verdict(summary, planned)
        shown = "clean" if summary.ending == "already wrong" else "adversarial"
        part = self.run.locate_part(self.run.path, asked.name)
        picture = part / "images" / f"{shown}.png"
        outcome: dict[str, Any] = {
            "answer": verdict,
            "reason": reason,
            "cause": cause,
            "part": asked.name,
        }
        outcome["pictures"] = sum(
            count for name, count in summary.renders.items() if name != "products"
        )
        is_kept = verdict == FAILED and picture.is_file()
        outcome["picture"] = (
            picture.relative_to(self.run.path).as_posix() if is_kept else None
        )
        return asked.model_copy(update=outcome)

    def _by_pictures(
        self, asked: ClaimResult, claim: ShareClaim | NoWorseClaim, config: SceneConfig
    ) -> ClaimResult:
        """Draw pictures until they decide: of the model alone, beside another model, or
        beside what it says of the same pictures changed.
        """
        problem = self._problem(config)
        kind = f"claim {asked.name}"
        spp = spp_of(config)
        shared = AttackConfig.of(
            config, workers=self.config.workers, cluster=self.config.cluster
        )
        worker = ATTACK_WORKER
        other = problem
        several = isinstance(claim, NoWorseClaim)
        # to the other side; without, a picture of its own
        shown: ChangePicture | None = None
        if isinstance(claim, NoWorseClaim):
            worker = CLAIM_WORKER
            other = self._problem(config.model_copy(update={"model": claim.than}))
            shared = shared.model_copy(update={"model": f"{config.model},{claim.than}"})
            if other.renderer.formation == problem.renderer.formation:
                shown = _same_picture
        elif isinstance(
            claim, ChangeClaim
        ):  # judged by what was true before it was changed
            shown = self._changed(claim, config, problem)
        sequence = statistics.sequential.ConfidenceSequence(
            self.suite.confidence, sides=1
        )
        least = least_mean(claim)
        values = list[float]()
        hidden = 0
        verdict = UNDECIDED
        worst: tuple[float, workbench.Query, str] | None = None
        wrong_payloads: list[Any] = []
        self.progress.stage(
            asked.name,
            claim.pictures,
            hint="fewer pictures in the suite shorten it",
            at_most=True,
        )
        with workbench.executor_for(shared, worker, self.progress) as executor:
            journal = workbench.Journal(
                self.run, workbench.Shared(problem, executor, "0" if several else "")
            )
            beside = None
            if not isinstance(claim, RightClaim):
                shared_by_workers = (
                    workbench.Shared(other, executor, "1")
                    if several
                    else workbench.Shared(other)
                )
                beside = workbench.Journal(self.run, shared_by_workers)
            for query, own, its in self._pairs(
                journal, drawn(problem, kind, claim.pictures, spp), beside, shown
            ):
                value, badness, text = valued(claim, own, its)
                if value is None:
                    hidden += 1
                    continue
                if not own.said.right:
                    wrong_payloads.append(own.said.payload)
                sequence.add(value)
                values.append(value)
                if value == 0.0 and (worst is None or badness > worst[0]):
                    worst = badness, query, text
                verdict = (
                    HELD
                    if sequence.is_over(least)
                    else FAILED
                    if sequence.is_under(least)
                    else UNDECIDED
                )
                if verdict != UNDECIDED:
                    break
        example = ""
        interval = sequence.interval
        mean = sequence.mean
        if worst is not None:
            example = f"{worst[2]}: {self._described(problem, worst[1])}"
        if isinstance(claim, NoWorseClaim):  # a mean of 1/2 is no difference
            interval = (2.0 * interval[0] - 1.0, 2.0 * interval[1] - 1.0)
            mean = 2.0 * mean - 1.0
            counts = (len(values), values.count(1.0), values.count(0.0))
            reason = words.difference_reason(verdict, counts, interval, claim.than)
        else:
            what = "right" if isinstance(claim, RightClaim) else "as claimed"
            outcomes = ""
            if isinstance(claim, RightClaim):
                outcomes = wording.outcomes_text(
                    workbench.count_outcomes(wrong_payloads), problem.task.name
                )
            reason = words.share_reason(
                what,
                verdict,
                values.count(1.0),
                len(values),
                interval,
                example,
                outcomes,
            )
        reason += (
            (f"; the object is not to be seen in {hidden} more, which are not counted")
            if hidden
            else ""
        )
        cause = Cause.OUT_OF_TIME if verdict == UNDECIDED and self.late else None
        reason += f"; {TIME_OVER}" if cause is Cause.OUT_OF_TIME else ""
        outcome: dict[str, Any] = {
            "answer": verdict,
            "reason": reason,
            "cause": cause,
            "interval": interval,
        }
        outcome |= {"pictures": len(values), "spp": spp}
        outcome["rate"] = mean if values else None
        outcome["picture"] = (
            self._picture(asked.name, problem, worst[1]) if worst else None
        )
        return asked.model_copy(update=outcome)

    def _changed(
        self, claim: ChangeClaim, config: SceneConfig, problem: Problem
    ) -> ChangePicture:
        """Return what shows a model the changed picture of a query."""
        if claim.when != workbench.AWAY:
            return lambda query, picture: workbench.changed(
                picture, claim.when, problem.model.cameras
            )
        other = self._problem(config)
        other.renderer.scene.assembly.away = True
        return lambda query, picture: other.picture(query.u, query.seed, query.spp)

    def _pairs(
        self, journal: workbench.Journal, queries: Iterator[workbench.Query], beside: workbench.Journal | None = None,
        shown: ChangePicture | None = None,
    ) -> Iterator[tuple[workbench.Query, policies.Evaluation, policies.Evaluation | None]]:  # fmt: skip
        """Yield queries, as many at once as there are workers for, until the time is
        over; with what is said of each, and what the other side says of what is `shown`
        to it of this picture; without, of a picture of its own.
        """
        pictures: dict[int, Tensor | None] = {}

        def here(queries: Sequence[workbench.Query]) -> Iterator[policies.Evaluation]:
            evaluations = journal.traced(
                [replace(query, keep=shown is not None) for query in queries]
            )
            for query, evaluation in zip(queries, evaluations, strict=True):
                pictures[query.number] = evaluation.picture
                yield evaluation

        def there(queries: Sequence[workbench.Query]) -> Iterable[policies.Evaluation]:
            assert beside is not None
            if shown is None:
                yield from beside.traced(queries)
                return
            problem = journal.traced.problem
            other = beside.traced.problem
            for query in queries:
                # what was asked before is read back, without its picture
                picture = pictures.get(query.number)
                if picture is None:
                    picture = problem.picture(query.u, query.seed, query.spp)
                yield policies.Evaluation.of(
                    other.judge(shown(query, picture), other.whole(query.u))
                )

        at_once = (
            1 if journal.traced.executor is None else AHEAD * (self.config.workers or 8)
        )
        while batch := list(islice(queries, at_once)):
            pictures.clear()
            mine: Iterable[policies.Evaluation] = journal.evaluate_all(batch, here)
            its: Iterable[policies.Evaluation | None] = repeat(None)
            if beside is not None:
                mine = list(mine)
                its = beside.evaluate_all(
                    [replace(query, kind=f"{query.kind} beside") for query in batch],
                    there,
                )
            for query, own, other in zip(batch, mine, its, strict=False):
                self.progress.advance(1, **journal.traced.told)
                yield query, own, other
            if self.late:
                return

    def counterexample(
        self, asked: ClaimResult, example: Counterexample, config: AttackConfig
    ) -> ClaimResult:
        """Try a counterexample: the model should be right on it. Trials by which it is
        added are no trials of it.
        """
        asked = asked.model_copy(
            update={
                "statement": f"{config.model} is right where it said {example.said}"
            }
        )
        try:
            parts = workbench.parts_of(config)
            problem = workbench.problem_on(parts, differentiated=False)
        except InputError as error:
            return asked.model_copy(
                update={"reason": words.cannot_be_judged(str(error))}
            )
        if file := example.changed_file(config):
            reason = (
                f"the file {file} is another one now; put it back, or remove the "
                "counterexample"
            )
            return asked.model_copy(update={"reason": reason})
        if scene_digest(parts.scene.description) != example.scene:
            reason = (
                "its scene is another one now; remove it, or add the adversarial "
                "scene of a new run"
            )
            return asked.model_copy(update={"reason": reason})
        start = problem.domain.start
        u = problem.domain.project(example.configuration(start))
        over = is_over(config)
        count = TRIALS[over]
        kind = (
            f"{'added ' if self.config.add is not None else ''}counterexample "
            f"{example.name}"
        )
        journal = workbench.Journal(self.run, workbench.Shared(problem))
        outcomes = list[bool | None]()
        wrong_payloads: list[Any] = []
        label = ""
        picture: str | None = None
        self.progress.stage(example.name, 4 * count if over else count, at_most=True)
        for query, trial, clean in self._trials_of(
            journal, kind, u, example.spp, over=over
        ):
            outcomes.append(outcome_of(trial, clean))
            right = outcomes.count(True)
            wrong = outcomes.count(False)
            if outcomes[-1] is False:
                wrong_payloads.append(trial.payload)
            if outcomes[-1] is False and not label:
                label = trial.prediction.label
                picture = self._picture(example.name, problem, query)
            # of one scene, it depends on the noise then
            if right + wrong == count or (right and wrong and not over):
                break
        right = outcomes.count(True)
        wrong = outcomes.count(False)
        verdict = decide_trials(right, wrong, over=over)
        interval = (
            statistics.intervals.clopper_pearson(right, right + wrong)
            if right + wrong
            else None
        )
        counts = (right, wrong, outcomes.count(None))
        became = wording.outcomes_text(
            workbench.count_outcomes(wrong_payloads), problem.task.name
        )
        reason = words.tried_reason(
            verdict, counts, label, interval, over=over, outcomes=became
        )
        outcome: dict[str, Any] = {"pictures": len(outcomes), "spp": example.spp}
        if self.late and right + wrong < count and not (right and wrong and not over):
            verdict = UNDECIDED
            reason = f"{reason}; {TIME_OVER}" if outcomes else TIME_OVER
            outcome["cause"] = Cause.OUT_OF_TIME
        outcome |= {"answer": verdict, "reason": reason}
        outcome |= {
            "picture": picture,
            "rate": right / (right + wrong) if right + wrong else None,
        }
        return asked.model_copy(update={**outcome, "interval": interval})

    def _trials_of(
        self, journal: workbench.Journal, kind: str, u: Tensor, spp: int, *, over: bool
    ) -> Iterator[tuple[workbench.Query, tasks.Judgement, tasks.Judgement | None]]:
        """Yield trials of one configuration (d,), and of the clean scene in the same
        conditions where these vary.
        """
        problem = journal.problem
        queries = list[workbench.Query]()
        for number in range(2 * TRIALS[over]):
            query = workbench.Query(
                u, seeds.stream(self.suite.seed, kind, number), kind, number, spp=spp
            )
            queries.append(query)
            if over:
                queries.append(
                    replace(query, u=problem.domain.start, kind=f"{kind}, clean")
                )
        evaluated = self._pairs(journal, iter(queries))
        for query, trial, _ in evaluated:
            clean = next(evaluated, None) if over else None
            if over and clean is None:
                return
            yield query, trial.said, None if clean is None else clean[1].said

    def _problem(self, config: SceneConfig) -> Problem:
        parts = workbench.parts_of(AttackConfig.of(config))
        # without those of the task, which stand in the reason
        remarks = [*parts.loaded[1]]
        problem = workbench.problem_on(parts, differentiated=False)
        self.warnings += [*problem.space.notes(parts.scene.description), *remarks]
        return problem

    def _picture(self, name: str, problem: Problem, query: workbench.Query) -> str:
        picture = problem.picture(query.u, query.seed, query.spp, drawn=query.drawn)
        return self.run.save_image(name, picture).relative_to(self.run.path).as_posix()

    def _described(self, problem: Problem, query: workbench.Query) -> str:
        values = list(problem.describe(query.u, query.seed).items())
        shown = []
        for name, value in values[:MANY]:
            unit = "" if value["unit"] in ("1", "name") else f" {value['unit']}"
            shown.append(f"{name} {wording.number_text(value['value'])}{unit}")
        return ", ".join([*shown, *(["..."] if len(values) > MANY else [])])


def claim_worker(values: dict[str, Any]) -> Callable[[Any], Any]:
    models = settings.split_names(str(values["model"]))

    def load_problem(name: str) -> Problem:
        config = AttackConfig(**{**values, "model": models[int(name)]})
        return workbench.problem_on(workbench.parts_of(config), differentiated=False)

    return workbench.worker_call(cache(load_problem))


def drawn(
    problem: Problem, kind: str, count: int, spp: int
) -> Iterator[workbench.Query]:
    """Draw configurations evenly from the whole space and budget, one after the other,
    each with a seed of its own.
    """
    for number in range(count):
        generator = torch.Generator().manual_seed(
            seeds.stream(problem.seed, f"{kind} draw", number)
        )
        (u,) = problem.domain.sample(generator)
        seed = seeds.stream(problem.seed, kind, number)
        values = problem.describe(u, seed) if problem.domain.dim <= MOST_KEPT else {}
        yield workbench.Query(
            u, seed, kind, number, spp=spp, values=values, sought=False
        )


def least_mean(claim: ShareClaim | NoWorseClaim) -> float:
    """Return what the mean of the draws, from 0 to 1, has to be over; of two models 1/2
    is that both are as good.
    """
    return (
        claim.at_least if isinstance(claim, ShareClaim) else 0.5 - claim.points / 200.0
    )


def check_pictures(name: str, claim: AnyClaim, confidence: float) -> str:
    """Return what has to be said of a claim's number of pictures before any is made;
    nothing where it is enough. An InputError where no predictions of so many pictures
    could decide it, or only one way.
    """
    if not isinstance(claim, ShareClaim | NoWorseClaim):
        return ""
    least = least_mean(claim)
    needed = max(
        statistics.sequential.draws_needed(mean, confidence=confidence)
        for mean in (least, 1.0 - least)
    )
    if claim.pictures < needed:
        raise InputError(
            f"claims.{name}.pictures: expected at least {needed}, as fewer cannot both "
            "hold and fail this claim at a "
            f"confidence of {wording.number_text(confidence)} whatever the model "
            f"predicts, got {claim.pictures}"
        )
    if not isinstance(claim, NoWorseClaim):
        return ""
    alike = statistics.sequential.draws_needed(least, confidence=confidence, value=0.5)
    if claim.pictures >= alike:
        return ""
    return (
        f"{name}: two models that predict alike are shown to be so by {alike} "
        f"pictures, and it takes {claim.pictures}."
    )


def valued(
    claim: ShareClaim | NoWorseClaim,
    own: policies.Evaluation,
    its: policies.Evaluation | None,
) -> tuple[float | None, float, str]:
    """Return what a picture says for a claim, from 0 to 1, or None where the object is
    not to be seen; how bad an example it is of what is against it, and which.
    """
    before = own.said.prediction
    hidden_from_other = (
        isinstance(claim, NoWorseClaim)
        and its is not None
        and its.said.prediction.is_out_of_view
    )
    # pictures of two sizes need not show the same
    if before.is_out_of_view or hidden_from_other:
        return None, 0.0, ""
    if its is None:
        badness = own.said.score if math.isfinite(own.said.score) else -math.inf
        return (
            float(own.said.right),
            badness,
            (f"most wrong where it says {before.label}"),
        )
    if isinstance(claim, ChangeClaim):
        after = its.said.prediction
        text = f"{before.label} before and {after.label} after"
        return float(workbench.as_claimed(claim.claim, before, after)), 0.0, text
    return (own.said.right - its.said.right + 1) / 2, 0.0, ""


def _same_picture(_query: workbench.Query, picture: Tensor) -> Tensor:
    return picture.clone()


def spp_of(config: SceneConfig) -> int:
    assert isinstance(config, suites.DrawnConfig)
    return workbench.ladder_of(config.verify_spp, config.pixel_sampler)[0]
