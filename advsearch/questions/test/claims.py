"""Test each kind of claim: by sampled pictures, a search, or trials of a
counterexample.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
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
    N_TRIALS,
    Counterexample,
    compute_scene_digest,
    decide_trials,
    evaluate_trial,
    varies_conditions,
)
from advsearch.questions.test.result import (
    FAILED,
    HELD,
    OUT_OF_TIME_REASON,
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

# maximum number of values of a configuration in a sentence
MAX_DESCRIBED_VALUES = 4
# the values of a configuration with more dimensions are not stored with its picture
MAX_STORED_VALUES = 64
ChangePicture = Callable[["workbench.Query", Tensor], Tensor]
"""Maps a query and its picture to the picture that the other side predicts."""
# pictures that are requested at once, for each worker
BATCHES_AHEAD = 2
Evaluated = tuple["workbench.Query", policies.Evaluation, policies.Evaluation | None]
"""A query, its evaluation, and that of the other side if there is one."""
ATTACK_WORKER = "advsearch.questions.attack.carry_out:attack_worker"
CLAIM_WORKER = "advsearch.questions.test.claims:claim_worker"


@dataclass
class _PictureSample:
    """What the pictures show that a claim was tested with.

    Attributes:
        scores: of each picture that counts, from 0 to 1; see `score_picture`.
        wrong_payloads: what the task recorded of wrong predictions.
        n_hidden: pictures without the object in view, which do not count.
        verdict: what they decide.
        worst: worst of the worst wrong picture: how bad it is, its query, and its text.
    """

    scores: list[float] = field(default_factory=list)
    wrong_payloads: list[Any] = field(default_factory=list)
    n_hidden: int = 0
    verdict: str = UNDECIDED
    worst: tuple[float, workbench.Query, str] | None = None


@dataclass
class ClaimTester:
    """Tests the claims of a suite.

    Attributes:
        context: context of the run.
        suite: the suite.
        start_time: when it began, by `time.perf_counter`.
        warnings: gets what a reader has to know.
    """

    context: RunContext[suites.SuiteConfig]
    suite: suites.Suite
    start_time: float
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
    def elapsed_seconds(self) -> float:
        """The seconds since it began."""
        return time.perf_counter() - self.start_time

    @property
    def time_limit(self) -> float:
        """The seconds after which nothing more begins; infinite without a limit."""
        return self.config.seconds or self.suite.seconds or math.inf

    @property
    def out_of_time(self) -> bool:
        """Whether the time is over."""
        return self.elapsed_seconds >= self.time_limit

    def test_claim(
        self, pending: ClaimResult, claim: AnyClaim, config: SceneConfig
    ) -> ClaimResult:
        """Test a claim, and return its result.

        Args:
            pending: the result without a verdict.
            claim: what is claimed.
            config: settings of its pictures, or of its search.
        """
        if isinstance(claim, ShareClaim | NoWorseClaim):
            return self._test_by_pictures(pending, claim, config)
        assert isinstance(config, AttackConfig)
        return self._test_by_search(pending, config)

    def _test_by_search(
        self, pending: ClaimResult, config: AttackConfig
    ) -> ClaimResult:
        """Test by a search, as a part of this run, that nothing breaks a model.

        The picture of a claim that fails is the adversarial one, or the clean one if
        that is wrong already.
        """
        search = self._make_search(config)
        summary = self.context.run_part(pending.name, search)
        assert isinstance(summary, workbench.AttackSummary)
        self.warnings += summary.warnings
        # with the number of steps that was chosen, if none was set
        planned = search.model_copy(update={"steps": search.steps or summary.steps})
        verdict, reason, cause = words.evaluate_search(summary, planned)
        image_name = "clean" if summary.ending == "already wrong" else "adversarial"
        part = self.run.locate_part(self.run.path, pending.name)
        image = part / "images" / f"{image_name}.png"
        picture = None
        if verdict == FAILED and image.is_file():
            picture = image.relative_to(self.run.path).as_posix()
        n_pictures = sum(
            count for name, count in summary.renders.items() if name != "products"
        )
        return pending.model_copy(
            update={
                "answer": verdict,
                "reason": reason,
                "cause": cause,
                "part": pending.name,
                "pictures": n_pictures,
                "picture": picture,
            }
        )

    def _make_search(self, config: AttackConfig) -> AttackConfig:
        """Return the settings of the search, within the remaining time."""
        remaining = max(0.001, self.time_limit - self.elapsed_seconds)
        seconds = min(remaining, config.seconds or math.inf)
        changes = {
            "workers": self.config.workers,
            "cluster": self.config.cluster,
            "seconds": seconds if math.isfinite(seconds) else None,
        }
        return config.model_copy(update=changes).with_python_only_parts(
            config.python_only_parts
        )

    def _test_by_pictures(
        self,
        pending: ClaimResult,
        claim: ShareClaim | NoWorseClaim,
        config: SceneConfig,
    ) -> ClaimResult:
        """Sample pictures until they decide a claim, or all of them are sampled.

        It is about the predictions of a model alone, or compared with those of another
        model or about changed pictures.
        """
        problem = self._load_problem(config)
        sequence = statistics.sequential.ConfidenceSequence(
            self.suite.confidence, sides=1
        )
        with self._open_evaluations(pending.name, claim, config, problem) as evaluated:
            sample = self._sample_pictures(evaluated, claim, sequence)

        example, picture = self._save_example(pending, sample.worst, problem)
        is_late = sample.verdict == UNDECIDED and self.out_of_time
        reason = _describe_sample(
            claim, sample, sequence.interval, example, problem.task.name
        )
        if sample.n_hidden:
            reason += (
                f"; the object is not to be seen in {sample.n_hidden} more, "
                "which are not counted"
            )
        if is_late:
            reason += f"; {OUT_OF_TIME_REASON}"
        rate = None
        if sample.scores:
            (rate,) = _to_claim_scale(claim, sequence.mean)
        return pending.model_copy(
            update={
                "answer": sample.verdict,
                "reason": reason,
                "cause": Cause.OUT_OF_TIME if is_late else None,
                "interval": _to_claim_scale(claim, *sequence.interval),
                "pictures": len(sample.scores),
                "spp": samples_per_pixel(config),
                "rate": rate,
                "picture": picture,
            }
        )

    @staticmethod
    def _sample_pictures(
        evaluated: Iterable[Any],
        claim: ShareClaim | NoWorseClaim,
        sequence: Any,
    ) -> _PictureSample:
        """Evaluate pictures until their scores decide the claim, or there are no more.

        Args:
            evaluated: queries with their evaluations, and those of the other side.
            claim: what is claimed.
            sequence: a confidence sequence of the mean score, which gets each score.

        Returns:
            The scores, the verdict, and the worst picture against the claim.
        """
        sample = _PictureSample()
        for query, evaluation, other in evaluated:
            score, badness, text = score_picture(claim, evaluation, other)
            if score is None:
                sample.n_hidden += 1
                continue
            judgement = evaluation.required_judgement
            if not judgement.right:
                sample.wrong_payloads.append(judgement.payload)
            sequence.add(score)
            sample.scores.append(score)
            is_worst = sample.worst is None or badness > sample.worst[0]
            if score == 0.0 and is_worst:
                sample.worst = (badness, query, text)
            sample.verdict = _decide(sequence, threshold_mean(claim))
            if sample.verdict != UNDECIDED:
                break
        return sample

    def _save_example(
        self,
        pending: ClaimResult,
        worst: tuple[float, workbench.Query, str] | None,
        problem: Problem,
    ) -> tuple[str, str | None]:
        """Describe the worst picture and store it; empty without one."""
        example = ""
        picture = None
        if worst is not None:
            _, query, text = worst
            example = f"{text}: {self._describe(problem, query)}"
            picture = self._save_picture(pending.name, problem, query)
        return example, picture

    @contextmanager
    def _open_evaluations(
        self,
        name: str,
        claim: ShareClaim | NoWorseClaim,
        config: SceneConfig,
        problem: Problem,
    ) -> Iterator[Iterator[Evaluated]]:
        """Open the workers that evaluate sampled pictures, of one or of two models.

        A claim that pictures are right has no other side. Else the other side is the
        other model, or the same one on changed pictures.

        Args:
            name: name of the claim.
            claim: the claim.
            config: settings of its pictures.
            problem: problem of the model under test.
        """
        worker_config = AttackConfig.from_config(
            config, workers=self.config.workers, cluster=self.config.cluster
        )
        worker = ATTACK_WORKER
        other = problem
        # without, the other side gets a rendering of its own
        change: ChangePicture | None = None
        has_two_models = isinstance(claim, NoWorseClaim)
        if isinstance(claim, NoWorseClaim):
            worker = CLAIM_WORKER
            other = self._load_problem(config.model_copy(update={"model": claim.than}))
            worker_config = worker_config.model_copy(
                update={"model": f"{config.model},{claim.than}"}
            )
            if other.renderer.formation == problem.renderer.formation:
                change = _same_picture
        elif isinstance(claim, ChangeClaim):
            # evaluated by what is true of the picture before the change
            change = self._make_change(claim, config, problem)
        self.progress.stage(
            name,
            claim.pictures,
            hint="fewer pictures in the suite shorten it",
            at_most=True,
        )
        queries = sample_queries(
            problem, f"claim {name}", claim.pictures, samples_per_pixel(config)
        )
        with workbench.open_executor(worker_config, worker, self.progress) as executor:
            # Workers find the problem of a model by its index; see `claim_worker`.
            problem_name = "0" if has_two_models else ""
            evaluator = workbench.ParallelEvaluator(problem, executor, problem_name)
            journal = workbench.Journal(self.run, evaluator)
            other_journal = None
            if not isinstance(claim, RightClaim):
                other_evaluator = workbench.ParallelEvaluator(other)
                if has_two_models:
                    other_evaluator = workbench.ParallelEvaluator(other, executor, "1")
                other_journal = workbench.Journal(self.run, other_evaluator)
            yield self._evaluate_pairs(journal, queries, other_journal, change)

    def _make_change(
        self, claim: ChangeClaim, config: SceneConfig, problem: Problem
    ) -> ChangePicture:
        """Return the function that changes the picture of a query as claimed."""
        if claim.when != workbench.WITHOUT_OBJECT:
            return lambda query, picture: workbench.change_image(
                picture, claim.when, problem.model.cameras
            )
        other = self._load_problem(config)
        other.renderer.scene.assembly.is_object_hidden = True
        return lambda query, picture: other.picture(query.u, query.seed, query.spp)

    def _evaluate_pairs(
        self,
        journal: workbench.Journal,
        queries: Iterator[workbench.Query],
        other_journal: workbench.Journal | None = None,
        change: ChangePicture | None = None,
    ) -> Iterator[Evaluated]:
        """Yield queries with their evaluations, until the time is over.

        As many are evaluated at once as there are workers for.

        Args:
            journal: evaluates the queries.
            queries: what to evaluate.
            other_journal: evaluates the other side, if there is one.
            change: makes the other side's picture of the first one; without it, the
                other side renders its own.
        """
        pictures: dict[int, Tensor | None] = {}  # of a batch, by number

        def evaluate(
            queries: Sequence[workbench.Query],
        ) -> Iterator[policies.Evaluation]:
            """Evaluate queries, and keep their pictures if they are to be changed."""
            evaluations = journal.evaluator(
                [replace(query, with_image=change is not None) for query in queries]
            )
            for query, evaluation in zip(queries, evaluations, strict=True):
                pictures[query.index] = evaluation.picture
                yield evaluation

        def evaluate_other(
            queries: Sequence[workbench.Query],
        ) -> Iterable[policies.Evaluation]:
            """Evaluate the other side: on changed pictures, or on its own ones."""
            assert other_journal is not None
            if change is None:
                yield from other_journal.evaluator(queries)
                return
            problem = journal.evaluator.problem
            other = other_journal.evaluator.problem
            for query in queries:
                # an evaluation that was read back has no picture
                picture = pictures.get(query.index)
                if picture is None:
                    picture = problem.picture(query.u, query.seed, query.spp)
                changed_picture = change(query, picture)
                judgement = other.judge(changed_picture, other.add_conditions(query.u))
                yield policies.Evaluation.from_judgement(judgement)

        batch_size = 1
        if journal.evaluator.executor is not None:
            # of a cluster the number of workers is not known
            batch_size = BATCHES_AHEAD * (self.config.workers or 8)
        while batch := list(islice(queries, batch_size)):
            pictures.clear()
            evaluations = journal.evaluate_all(batch, evaluate)
            others: Iterable[policies.Evaluation | None] = repeat(None)
            if other_journal is not None:
                # evaluates all, so that the pictures are there before they are changed
                evaluations = iter(list(evaluations))
                other_queries = [
                    replace(query, kind=f"{query.kind} beside") for query in batch
                ]
                others = other_journal.evaluate_all(other_queries, evaluate_other)
            for query, evaluation, other in zip(
                batch, evaluations, others, strict=False
            ):
                self.progress.advance(1, **journal.evaluator.progress_stats)
                yield query, evaluation, other
            if self.out_of_time:
                return

    def test_counterexample(
        self, pending: ClaimResult, example: Counterexample, config: AttackConfig
    ) -> ClaimResult:
        """Test a counterexample: the model should be right on it.

        One whose files or scene have changed, or that does not suit the model, stays
        undecided, with the reason.

        Args:
            pending: the result without a verdict.
            example: the counterexample.
            config: settings that it is tested with.
        """
        pending = pending.model_copy(
            update={
                "statement": f"{config.model} is right where it said "
                f"{example.wrong_label}"
            }
        )
        try:
            parts = workbench.load_parts(config)
            problem = workbench.make_problem(parts, differentiated=False)
        except InputError as error:
            reason = words.describe_unsuitable(str(error))
            return pending.model_copy(update={"reason": reason})
        file = example.find_changed_file(config)
        if file:
            reason = (
                f"the file {file} is another one now; put it back, or remove the "
                "counterexample"
            )
            return pending.model_copy(update={"reason": reason})
        if compute_scene_digest(parts.scene.description) != example.scene_digest:
            reason = (
                "its scene is another one now; remove it, or add the adversarial "
                "scene of a new run"
            )
            return pending.model_copy(update={"reason": reason})
        return self._test_by_trials(
            pending, example, problem, over=varies_conditions(config)
        )

    def _test_by_trials(
        self,
        pending: ClaimResult,
        example: Counterexample,
        problem: Problem,
        *,
        over: bool,
    ) -> ClaimResult:
        """Test a counterexample by trials with fresh seeds.

        They end when further ones would change nothing, or the time is over. The
        picture of the result is that of the first wrong trial.

        Args:
            pending: the result without a verdict.
            example: the counterexample.
            problem: problem of the model under test.
            over: whether conditions vary; then each trial has one of the clean scene
                under the same conditions, and does not count if the model is wrong
                there.
        """
        u = problem.domain.project(example.make_configuration(problem.domain.start))
        # trials by which it is added are not repeated as trials of the suite
        prefix = "added " if self.config.add is not None else ""
        kind = f"{prefix}counterexample {example.name}"
        journal = workbench.Journal(self.run, workbench.ParallelEvaluator(problem))
        outcomes = list[bool | None]()
        wrong_payloads = list[Any]()
        label = ""
        picture: str | None = None
        # Over conditions, up to twice as many trials are made, as some may not count;
        # each also renders the clean scene.
        max_trials = 4 * N_TRIALS[over] if over else N_TRIALS[over]
        self.progress.stage(example.name, max_trials, at_most=True)
        for query, trial, clean in self._run_trials(
            journal, kind, u, example.spp, over=over
        ):
            outcome = evaluate_trial(trial, clean)
            outcomes.append(outcome)
            if outcome is False:
                wrong_payloads.append(trial.payload)
                if not label:
                    label = trial.prediction.label
                    picture = self._save_picture(example.name, problem, query)
            if _has_enough_trials(outcomes, over=over):
                break

        update = _trials_result(outcomes, label, wrong_payloads, problem, over=over)
        if self.out_of_time and not _has_enough_trials(outcomes, over=over):
            update["answer"] = UNDECIDED
            update["reason"] = (
                f"{update['reason']}; {OUT_OF_TIME_REASON}"
                if outcomes
                else OUT_OF_TIME_REASON
            )
            update["cause"] = Cause.OUT_OF_TIME
        update["picture"] = picture
        update["spp"] = example.spp
        return pending.model_copy(update=update)

    def _run_trials(
        self, journal: workbench.Journal, kind: str, u: Tensor, spp: int, *, over: bool
    ) -> Iterator[tuple[workbench.Query, tasks.Judgement, tasks.Judgement | None]]:
        """Yield the trials of a configuration, until the time is over.

        Args:
            journal: which evaluates and stores them.
            kind: kind of their seeds and stored rows.
            u: (d,) the configuration.
            spp: samples per pixel.
            over: whether the clean scene is evaluated as well, under the same
                conditions.

        Yields:
            Query and judgement of the configuration, and the judgement of the clean
            scene, None without `over`.
        """
        problem = journal.problem
        queries = list[workbench.Query]()
        for index in range(2 * N_TRIALS[over]):
            seed = seeds.stream(self.suite.seed, kind, index)
            query = workbench.Query(u, seed, kind, index, spp=spp)
            queries.append(query)
            if over:
                clean_query = replace(
                    query, u=problem.domain.start, kind=f"{kind}, clean"
                )
                queries.append(clean_query)
        evaluated = self._evaluate_pairs(journal, iter(queries))
        for query, trial, _ in evaluated:
            if not over:
                yield query, trial.required_judgement, None
                continue
            # The next query is that of the clean scene; without it, the time is over.
            clean = next(evaluated, None)
            if clean is None:
                return
            yield query, trial.required_judgement, clean[1].required_judgement

    def _load_problem(self, config: SceneConfig) -> Problem:
        """Load scene, model and task; what there is to remark becomes a warning."""
        parts = workbench.load_parts(AttackConfig.from_config(config))
        # without the remarks of the task, which the reason has
        remarks = [*parts.model_and_warnings[1]]
        problem = workbench.make_problem(parts, differentiated=False)
        self.warnings += [*problem.space.list_notes(parts.scene.description), *remarks]
        return problem

    def _save_picture(self, name: str, problem: Problem, query: workbench.Query) -> str:
        """Save the picture of a query, and return its path inside the run."""
        picture = problem.picture(
            query.u, query.seed, query.spp, with_conditions=query.draws_conditions
        )
        return self.run.save_image(name, picture).relative_to(self.run.path).as_posix()

    def _describe(self, problem: Problem, query: workbench.Query) -> str:
        """Describe the first values of a configuration: ``pose.yaw 12.5 deg, ...``."""
        values = list(problem.describe(query.u, query.seed).items())
        texts = []
        for name, value in values[:MAX_DESCRIBED_VALUES]:
            unit = "" if value["unit"] in ("1", "name") else f" {value['unit']}"
            texts.append(f"{name} {wording.format_number(value['value'])}{unit}")
        if len(values) > MAX_DESCRIBED_VALUES:
            texts.append("...")
        return ", ".join(texts)


def claim_worker(values: dict[str, Any]) -> Callable[[Any], Any]:
    """Return what a worker process calls for a claim about two models.

    A model is loaded at its first use; requests name it by its index.
    """
    models = settings.split_names(str(values["model"]))

    def load_problem(name: str) -> Problem:
        config = AttackConfig(**{**values, "model": models[int(name)]})
        return workbench.make_problem(
            workbench.load_parts(config), differentiated=False
        )

    return workbench.make_worker_call(cache(load_problem))


def sample_queries(
    problem: Problem, kind: str, count: int, spp: int
) -> Iterator[workbench.Query]:
    """Yield configurations sampled uniformly from the full space and budget.

    Each has its own seed.
    """
    for index in range(count):
        generator = torch.Generator().manual_seed(
            seeds.stream(problem.seed, f"{kind} draw", index)
        )
        (u,) = problem.domain.sample(generator)
        seed = seeds.stream(problem.seed, kind, index)
        values = (
            problem.describe(u, seed) if problem.domain.dim <= MAX_STORED_VALUES else {}
        )
        yield workbench.Query(
            u, seed, kind, index, spp=spp, values=values, has_success=False
        )


def threshold_mean(claim: ShareClaim | NoWorseClaim) -> float:
    """Return what the mean of the scores, from 0 to 1, has to exceed.

    Of two models, a mean of 1/2 is that both are equally good.
    """
    if isinstance(claim, ShareClaim):
        return claim.at_least
    return 0.5 - claim.points / 200.0


def check_pictures(name: str, claim: AnyClaim, confidence: float) -> str:
    """Check a claim's number of pictures; return a remark, or "" if it is enough.

    A model that is always right has to be able to hold the claim with so many pictures,
    and one that is always wrong to fail it. The remark is about a claim that compares
    two models, if these are not enough for two that predict alike.

    Raises:
        InputError: if no predictions of so many pictures could decide it both ways.
    """
    if not isinstance(claim, ShareClaim | NoWorseClaim):
        return ""
    threshold = threshold_mean(claim)
    needed = max(
        statistics.sequential.count_needed_samples(mean, confidence=confidence)
        # what it takes to exceed the threshold, and to fall below it
        for mean in (threshold, 1.0 - threshold)
    )
    if claim.pictures < needed:
        raise InputError(
            f"claims.{name}.pictures: expected at least {needed}, as fewer cannot both "
            "hold and fail this claim at a "
            f"confidence of {wording.format_number(confidence)} whatever the model "
            f"predicts, got {claim.pictures}"
        )
    if not isinstance(claim, NoWorseClaim):
        return ""
    needed_if_equal = statistics.sequential.count_needed_samples(
        threshold, confidence=confidence, value=0.5
    )
    if claim.pictures >= needed_if_equal:
        return ""
    return (
        f"{name}: two models that predict alike are shown to be so by "
        f"{needed_if_equal} pictures, and it takes {claim.pictures}."
    )


def score_picture(
    claim: ShareClaim | NoWorseClaim,
    evaluation: policies.Evaluation,
    other: policies.Evaluation | None,
) -> tuple[float | None, float, str]:
    """Score a picture for a claim.

    Args:
        claim: what is claimed.
        evaluation: evaluation of the model under test.
        other: evaluation of the other side, if there is one.

    Returns:
        The score from 0 to 1: whether the model is right, or predicts as claimed; of
        two models 1 if only the first is right, 0 if only the other is, else 1/2. None
        if the object is out of view. How bad an example against the claim it is: the
        task's score. And a description of that.
    """
    before = evaluation.required_judgement.prediction
    # pictures of two sizes need not show the same
    is_hidden_from_other = (
        isinstance(claim, NoWorseClaim)
        and other is not None
        and other.required_judgement.prediction.is_out_of_view
    )
    if before.is_out_of_view or is_hidden_from_other:
        return None, 0.0, ""
    if other is None:
        score = evaluation.required_judgement.score
        badness = score if math.isfinite(score) else -math.inf
        text = f"most wrong where it says {before.label}"
        return float(evaluation.required_judgement.right), badness, text
    if isinstance(claim, ChangeClaim):
        after = other.required_judgement.prediction
        text = f"{before.label} before and {after.label} after"
        return float(workbench.meets_claim(claim.claim, before, after)), 0.0, text
    is_right = int(evaluation.required_judgement.right)
    is_other_right = int(other.required_judgement.right)
    return (is_right - is_other_right + 1) / 2, 0.0, ""


def _decide(
    sequence: statistics.sequential.ConfidenceSequence, threshold: float
) -> str:
    """Return the verdict of a confidence sequence of the mean."""
    if sequence.is_over(threshold):
        return HELD
    return FAILED if sequence.is_under(threshold) else UNDECIDED


def _to_claim_scale(
    claim: ShareClaim | NoWorseClaim, *means: float
) -> tuple[float, ...]:
    """Convert means of scores to fractions, or to differences of two models."""
    if isinstance(claim, NoWorseClaim):  # a mean of 1/2 is no difference
        return tuple(2.0 * mean - 1.0 for mean in means)
    return means


def _describe_sample(
    claim: ShareClaim | NoWorseClaim,
    sample: _PictureSample,
    interval: tuple[float, float],
    example: str,
    task: str,
) -> str:
    """Describe why sampled pictures decide a claim, or don't.

    Args:
        claim: what is claimed.
        sample: the pictures.
        interval: interval of the mean of their scores.
        example: the worst example against the claim.
        task: name of the task.
    """
    n_pictures = len(sample.scores)
    n_for = sample.scores.count(1.0)
    n_against = sample.scores.count(0.0)
    if isinstance(claim, NoWorseClaim):
        lower, upper = _to_claim_scale(claim, *interval)
        return words.describe_difference(
            sample.verdict,
            (n_pictures, n_for, n_against),
            (lower, upper),
            claim.than,
        )
    what = "as claimed"
    outcomes = ""
    if isinstance(claim, RightClaim):
        what = "right"
        outcome_counts = workbench.count_outcomes(sample.wrong_payloads)
        outcomes = wording.format_outcomes(outcome_counts, task)
    return words.describe_fraction(
        what, sample.verdict, n_for, n_pictures, interval, example, outcomes
    )


def _has_enough_trials(outcomes: Sequence[bool | None], *, over: bool) -> bool:
    """Return whether further trials of a counterexample change nothing.

    One scene that is right and wrong depends on the noise already. Otherwise it takes
    `N_TRIALS` that count.

    Args:
        outcomes: whether the model is right in each; None does not count.
        over: whether conditions vary.
    """
    n_right = outcomes.count(True)
    n_wrong = outcomes.count(False)
    depends_on_noise = n_right > 0 and n_wrong > 0 and not over
    return depends_on_noise or n_right + n_wrong == N_TRIALS[over]


def _trials_result(
    outcomes: Sequence[bool | None],
    label: str,
    wrong_payloads: Sequence[Any],
    problem: Problem,
    *,
    over: bool,
) -> dict[str, Any]:
    """Return what trials decide: fields of a `ClaimResult`.

    Args:
        outcomes: whether the model is right in each; None does not count.
        label: label of the first wrong prediction; empty without one.
        wrong_payloads: payloads of the wrong predictions.
        problem: problem of the model.
        over: whether conditions vary.
    """
    n_right = outcomes.count(True)
    n_wrong = outcomes.count(False)
    total = n_right + n_wrong
    verdict = decide_trials(n_right, n_wrong, over=over)
    interval = None
    rate = None
    if total:
        interval = statistics.intervals.clopper_pearson(n_right, total)
        rate = n_right / total
    reason = words.describe_trials(
        verdict,
        (n_right, n_wrong, outcomes.count(None)),
        label,
        interval,
        over=over,
        outcomes=wording.format_outcomes(
            workbench.count_outcomes(wrong_payloads), problem.task.name
        ),
    )
    return {
        "answer": verdict,
        "reason": reason,
        "pictures": len(outcomes),
        "rate": rate,
        "interval": interval,
    }


def _same_picture(_query: workbench.Query, picture: Tensor) -> Tensor:
    """Return the picture without a change, for another model."""
    return picture.clone()


def samples_per_pixel(config: SceneConfig) -> int:
    """Return the samples per pixel of a claim's pictures."""
    assert isinstance(config, suites.SampledConfig)
    return workbench.choose_ladder(config.verify_spp, config.pixel_sampler)[0]
