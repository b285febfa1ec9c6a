"""How each kind of claim is tried: drawn pictures, a search, or the trials of a counterexample."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import islice
from typing import Any

import torch
from torch import Tensor

import advsearch.questions.test.result as words
from advsearch import seeds
from advsearch.attacks import Evaluation
from advsearch.attacks.evaluation import Query
from advsearch.attacks.trials import ConfidenceSequence, clopper_pearson, draws_needed
from advsearch.config import SceneConfig
from advsearch.described import OUT_OF_VIEW
from advsearch.engine.journal import Journal, Shared, worker_call
from advsearch.engine.problem import AWAY, Problem, as_claimed, changed
from advsearch.engine.verifier import ladder_of
from advsearch.errors import InputError
from advsearch.files import JsonObject
from advsearch.progress import Progress
from advsearch.questions.attack.carry_out import executor_for, parts_of, problem_of
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.studies import carry_out_part
from advsearch.questions.attack.summary import AttackSummary
from advsearch.questions.test.counterexamples import TRIALS, Counterexample, is_over, scene_digest
from advsearch.questions.test.result import FAILED, HELD, TIME_OVER, UNDECIDED, ClaimResult
from advsearch.questions.test.settings import AnyClaim, ChangeClaim, DrawnConfig, NoWorseClaim, RightClaim, ShareClaim
from advsearch.report.wording import number_text
from advsearch.runs.directory import IMAGES, PARTS, RunDirectory
from advsearch.settings import split_names

MANY = 4  # values of a configuration that are said in words, at most

MOST_KEPT = 64  # of a configuration with more numbers, a picture's row does not hold the values

AHEAD = 2  # pictures that are asked for at once, for each worker


@dataclass
class Trial:
    """What claims are tried with: `confidence` is of each that pictures decide, `late` whether the time of the suite is
    over and `left` the seconds until then, infinite without a limit; `warnings` gets what a reader has to know."""

    run: RunDirectory
    confidence: float
    late: Callable[[], bool]
    left: Callable[[], float]
    workers: int | None
    cluster: str | None
    progress: Progress
    warnings: list[str] = field(default_factory=list)

    def claim(self, asked: ClaimResult, claim: AnyClaim, config: SceneConfig) -> ClaimResult:
        """Try a claim that is asked and undecided; what was asked before is read back."""
        if isinstance(claim, RightClaim):
            return self._right(asked, claim, config)
        if isinstance(claim, NoWorseClaim):
            return self._no_worse(asked, claim, config)
        if isinstance(claim, ChangeClaim):
            return self._changes(asked, claim, config)
        assert isinstance(config, AttackConfig)
        return self._not_broken(asked, config)

    def _right(self, asked: ClaimResult, claim: RightClaim, config: SceneConfig) -> ClaimResult:
        problem, shared = self._problem(config), self._shared(config)
        sequence, right, hidden, verdict = ConfidenceSequence(self.confidence, sides=1), 0, 0, UNDECIDED
        wrong: tuple[float, Query, str] | None = None
        self.progress.stage(asked.name, claim.pictures, hint="fewer pictures in the suite shorten it", at_most=True)
        with executor_for(shared, "advsearch.questions.attack.carry_out:attack_worker", self.progress) as executor:
            journal = Journal(self.run, Shared(problem, executor))
            queries = drawn(problem, f"claim {asked.name}", claim.pictures, spp_of(config))
            for query, evaluation in self._evaluations(journal, queries):
                judged = evaluation.said
                if judged.prediction.label == OUT_OF_VIEW:
                    hidden += 1
                    continue
                sequence.add(float(judged.right))
                right += judged.right
                score = judged.score if math.isfinite(judged.score) else -math.inf
                if not judged.right and (wrong is None or score > wrong[0]):
                    wrong = score, query, judged.prediction.label
                verdict = decided(sequence, least_mean(claim))
                if verdict != UNDECIDED:
                    break
        worst, picture = "", None
        if wrong is not None:
            _, query, label = wrong
            worst = f"most wrong where it says {label}: {self._described(problem, query)}"
            picture = self._picture(asked.name, problem, query)
        reason = words.share_reason("right", verdict, right, sequence.count, sequence.interval, worst)
        reason += f"; the object is not to be seen in {hidden} more, which are not counted" if hidden else ""
        return self._decided(asked, verdict, reason, sequence, config, picture)

    def _no_worse(self, asked: ClaimResult, claim: NoWorseClaim, config: SceneConfig) -> ClaimResult:
        problem, other = self._problem(config), self._problem(config.model_copy(update={"model": claim.than}))
        same = other.renderer.formation == problem.renderer.formation
        sequence, ours, theirs, verdict = ConfidenceSequence(self.confidence, sides=1), 0, 0, UNDECIDED
        first = None
        shared = self._shared(config).model_copy(update={"model": f"{config.model},{claim.than}"})
        with executor_for(shared, "advsearch.questions.test.claims:claim_worker", self.progress) as executor:
            journal = Journal(self.run, Shared(problem, executor, "0"))
            beside = Journal(self.run, Shared(other, executor, "1"))
            shown = (lambda _, picture: picture.clone()) if same else None
            for query, own, its in self._pairs(asked, claim, config, journal, beside, shown):
                ours += own.said.right and not its.said.right
                theirs += its.said.right and not own.said.right
                if first is None and its.said.right and not own.said.right:
                    first = query
                sequence.add((own.said.right - its.said.right + 1) / 2)
                verdict = decided(sequence, least_mean(claim))
                if verdict != UNDECIDED:
                    break
        low, high = sequence.interval
        counts = (sequence.count, ours, theirs)
        reason = words.difference_reason(verdict, counts, (2 * low - 1, 2 * high - 1), claim.than)
        picture = None if first is None else self._picture(asked.name, problem, first)
        return self._decided(asked, verdict, reason, sequence, config, picture, (-1.0, 2.0))

    def _changes(self, asked: ClaimResult, claim: ChangeClaim, config: SceneConfig) -> ClaimResult:
        """Whether a change of the picture changes what the model says, or not."""
        problem = self._problem(config)
        other = self._problem(config) if claim.when == AWAY else problem
        other.renderer.scene.assembly.away = claim.when == AWAY
        sequence, held, example, verdict = ConfidenceSequence(self.confidence, sides=1), 0, "", UNDECIDED
        picture = None
        shared = self._shared(config)
        with executor_for(shared, "advsearch.questions.attack.carry_out:attack_worker", self.progress) as executor:
            journal, beside = Journal(self.run, Shared(problem, executor)), Journal(self.run, Shared(problem))

            def shown(query: Query, picture: Tensor) -> Tensor:  # judged by what was true before it was changed
                if claim.when == AWAY:
                    return other.picture(query.u, query.seed, query.spp)
                return changed(picture, claim.when, problem.model.cameras)

            for query, own, its in self._pairs(asked, claim, config, journal, beside, shown):
                before, after = own.said.prediction, its.said.prediction
                right = as_claimed(claim.claim, before, after)
                held += right
                if not right and picture is None:
                    example = f"{before.label} before and {after.label} after: {self._described(problem, query)}"
                    picture = self._picture(asked.name, problem, query)
                sequence.add(float(right))
                verdict = decided(sequence, least_mean(claim))
                if verdict != UNDECIDED:
                    break
        reason = words.share_reason("as claimed", verdict, held, sequence.count, sequence.interval, example)
        return self._decided(asked, verdict, reason, sequence, config, picture)

    def _pairs(
        self, asked: ClaimResult, claim: NoWorseClaim | ChangeClaim, config: SceneConfig, journal: Journal,
        beside: Journal, shown: Callable[[Query, Tensor], Tensor] | None,
    ) -> Iterator[tuple[Query, Evaluation, Evaluation]]:  # fmt: skip
        """Yield a claim's pictures, what is said of each, and what the other side says of what is `shown` to it of this
        picture; without, of a picture of its own."""
        kind = f"claim {asked.name}"
        self.progress.stage(asked.name, claim.pictures, hint="fewer pictures in the suite shorten it", at_most=True)
        problem, other = journal.traced.problem, beside.traced.problem
        pictures: dict[int, Tensor | None] = {}

        def here(queries: Sequence[Query]) -> Iterator[Evaluation]:
            evaluations = journal.traced([replace(query, keep=shown is not None) for query in queries])
            for query, evaluation in zip(queries, evaluations, strict=True):
                pictures[query.number] = evaluation.picture
                yield evaluation

        def there(queries: Sequence[Query]) -> Iterable[Evaluation]:
            if shown is None:
                yield from beside.traced(queries)
                return
            for query in queries:
                picture = pictures.get(query.number)  # what was asked before is read back, without its picture
                if picture is None:
                    picture = problem.picture(query.u, query.seed, query.spp)
                yield Evaluation.of(other.judge(shown(query, picture), other.whole(query.u)))

        for batch in self._batches(journal, drawn(problem, kind, claim.pictures, spp_of(config))):
            pictures.clear()
            mine = list(journal.evaluate_all(batch, here))
            both = beside.evaluate_all([replace(query, kind=f"{kind} beside") for query in batch], there)
            for query, own, its in zip(batch, mine, both, strict=True):
                self.progress.advance(1, **journal.traced.told)
                yield query, own, its

    def _not_broken(self, asked: ClaimResult, config: AttackConfig) -> ClaimResult:
        seconds = min(self.left(), config.seconds or math.inf)
        shared = {"workers": self.workers, "cluster": self.cluster}
        limited = {**shared, "seconds": seconds if math.isfinite(seconds) else None}
        own = config.model_copy(update=limited).with_only_here(config.only_here)
        summary = carry_out_part(self.run.path / PARTS / asked.name, own, self.progress)
        assert isinstance(summary, AttackSummary)
        self.warnings += summary.warnings
        verdict, reason = words.search_verdict(summary, own.model_copy(update={"steps": own.steps or summary.steps}))
        shown = "clean" if summary.ending == "already wrong" else "adversarial"
        file = f"{PARTS}/{asked.name}/{IMAGES}/{shown}.png"
        outcome: dict[str, Any] = {"answer": verdict, "reason": reason, "part": asked.name}
        outcome["pictures"] = sum(count for name, count in summary.renders.items() if name != "products")
        outcome["picture"] = file if verdict == FAILED and (self.run.path / file).is_file() else None
        return asked.model_copy(update=outcome)

    def counterexample(
        self, asked: ClaimResult, example: Counterexample, config: AttackConfig, *, added: bool = False
    ) -> ClaimResult:
        """Try a counterexample: the model should be right on it. Trials by which it is `added` are no trials of it."""
        asked = asked.model_copy(update={"statement": f"{config.model} is right where it said {example.said}"})
        parts = parts_of(config)
        if scene_digest(parts.scene) != example.scene:
            reason = "its scene is another one now; remove it, or add the adversarial scene of a new run"
            return asked.model_copy(update={"reason": reason})
        problem = problem_of(config, parts.scene, parts.loaded[0], differentiated=False)
        u = problem.domain.project(example.configuration(problem.domain.start))
        count, tried, right, label, picture = TRIALS[is_over(config)], 0, 0, "", None
        self.progress.stage(example.name, count, at_most=True)
        kind = f"{'added ' if added else ''}counterexample {example.name}"
        queries = (
            Query(u, seeds.stream(problem.seed, kind, number), kind, number, spp=example.spp) for number in range(count)
        )
        for query, evaluation in self._evaluations(Journal(self.run, Shared(problem)), queries):
            tried, right = tried + 1, right + evaluation.said.right
            if not evaluation.said.right and not label:
                label, picture = evaluation.said.prediction.label, self._picture(example.name, problem, query)
            if 0 < right < tried:
                break  # it depends on the noise, whatever comes
        interval = clopper_pearson(right, tried) if tried else None
        verdict, reason = words.tried_reason(right, tried - right, label, interval)
        if tried < count and not 0 < right < tried:
            verdict, reason = UNDECIDED, TIME_OVER
        outcome = {"answer": verdict, "reason": reason, "pictures": tried, "spp": example.spp, "picture": picture}
        outcome |= {"rate": right / tried if tried else None, "interval": interval}
        return asked.model_copy(update=outcome)

    def _problem(self, config: SceneConfig) -> Problem:
        whole = AttackConfig.of(config)
        parts = parts_of(whole)
        problem = problem_of(whole, parts.scene, parts.loaded[0], differentiated=False)
        self.warnings += [*problem.space.notes(parts.scene.description), *parts.loaded[1]]
        return problem

    def _shared(self, config: SceneConfig) -> AttackConfig:
        return AttackConfig.of(config, workers=self.workers, cluster=self.cluster)

    def _evaluations(self, journal: Journal, queries: Iterator[Query]) -> Iterator[tuple[Query, Evaluation]]:
        for batch in self._batches(journal, queries):
            for query, evaluation in zip(batch, journal.evaluate_all(batch), strict=True):
                self.progress.advance(1, **journal.traced.told)
                yield query, evaluation

    def _batches(self, journal: Journal, queries: Iterator[Query]) -> Iterator[list[Query]]:
        """As many at once as there are workers for, until the time is over."""
        at_once = 1 if journal.traced.executor is None else AHEAD * (self.workers or 8)
        while batch := list(islice(queries, at_once)):
            yield batch
            if self.late():
                return

    def _picture(self, name: str, problem: Problem, query: Query) -> str:
        self.run.save_image(name, problem.picture(query.u, query.seed, query.spp, drawn=query.drawn))
        return f"{IMAGES}/{name}.png"

    def _described(self, problem: Problem, query: Query) -> str:
        values = list(problem.describe(query.u, query.seed).items())
        shown = []
        for name, value in values[:MANY]:
            unit = "" if value["unit"] in ("1", "name") else f" {value['unit']}"
            shown.append(f"{name} {number_text(value['value'])}{unit}")
        return ", ".join([*shown, *(["..."] if len(values) > MANY else [])])

    def _decided(
        self, asked: ClaimResult, verdict: str, reason: str, sequence: ConfidenceSequence, config: SceneConfig,
        picture: str | None, scale: tuple[float, float] = (0.0, 1.0),
    ) -> ClaimResult:  # fmt: skip
        """What drawn pictures say; `scale` has the value of a mean of 0, and how much more that of 1 is."""
        begin, wide = scale
        low, high = sequence.interval
        late = f"; {TIME_OVER}" if verdict == UNDECIDED and self.late() else ""
        outcome = {"answer": verdict, "reason": reason + late, "pictures": sequence.count, "picture": picture}
        outcome["rate"] = begin + wide * sequence.mean if sequence.count else None
        outcome |= {"interval": (begin + wide * low, begin + wide * high), "spp": spp_of(config)}
        return asked.model_copy(update=outcome)


def claim_worker(settings: JsonObject) -> Callable[[Any], Any]:
    """Return what evaluates the queries of a claim about two models, named by their place: what a worker does."""
    models = split_names(str(settings["model"]))

    def problem(name: str) -> Problem:
        config = AttackConfig(**{**settings, "model": models[int(name)]})
        parts = parts_of(config)
        return problem_of(config, parts.scene, parts.loaded[0], differentiated=False)

    return worker_call(cache(problem))


def drawn(problem: Problem, kind: str, count: int, spp: int) -> Iterator[Query]:
    """Draw configurations evenly from the whole space and budget, one after the other, each with a seed of its own."""
    for number in range(count):
        generator = torch.Generator().manual_seed(seeds.stream(problem.seed, f"{kind} draw", number))
        (u,) = problem.domain.sample(generator)
        seed = seeds.stream(problem.seed, kind, number)
        values = problem.describe(u, seed) if problem.domain.dim <= MOST_KEPT else {}
        yield Query(u, seed, kind, number, spp=spp, values=values, sought=False)


def least_mean(claim: ShareClaim | NoWorseClaim) -> float:
    """Return what the mean of the draws, from 0 to 1, has to be over; of two models 1/2 is that both are as good."""
    return claim.at_least if isinstance(claim, ShareClaim) else 0.5 - claim.points / 200.0


def check_pictures(name: str, claim: AnyClaim, confidence: float) -> str:
    """Return what has to be said of a claim's number of pictures before any is made; nothing where it is enough. An
    InputError where no predictions of so many pictures could decide it, or only one way."""
    if not isinstance(claim, ShareClaim | NoWorseClaim):
        return ""
    least = least_mean(claim)
    needed = max(draws_needed(mean, confidence=confidence) for mean in (least, 1.0 - least))
    if claim.pictures < needed:
        raise InputError(
            f"claims.{name}.pictures: expected at least {needed}, as fewer cannot both hold and fail this claim at a "
            f"confidence of {number_text(confidence)} whatever the model predicts, got {claim.pictures}"
        )
    alike = draws_needed(least, confidence=confidence, value=0.5) if isinstance(claim, NoWorseClaim) else 0
    if claim.pictures >= alike:
        return ""
    return (
        f"{name}: two models that predict alike are shown to be so by {alike} pictures, and it takes {claim.pictures}."
    )


def decided(sequence: ConfidenceSequence, least: float) -> str:
    """Return what draws say of the claim that their mean is at least so large."""
    return HELD if sequence.is_over(least) else FAILED if sequence.is_under(least) else UNDECIDED


def spp_of(config: SceneConfig) -> int:
    """Return the samples a pixel of each picture."""
    assert isinstance(config, DrawnConfig)
    return ladder_of(AttackConfig.of(config, verify_spp=config.verify_spp))[0]
