"""Test claims by sampled images or by a search, and counterexamples by trials."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import islice, repeat
from typing import Any, NamedTuple

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
    Counterexample,
    compute_scene_digest,
    count_trials,
    decide_trials,
    is_right_in_trial,
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
"""Returns the image that the other side predicts, for a query and its image."""
# number of images per worker that are requested at once
BATCHES_AHEAD = 2
# assumed number of workers of a cluster, since it is not known
CLUSTER_WORKERS = 8
Evaluated = tuple["workbench.Query", policies.Evaluation, policies.Evaluation | None]
"""A query, its evaluation by the model under test, and that by the other side. The last
one is None if there is no other side.
"""
ATTACK_WORKER = "advsearch.questions.attack.carry_out:attack_worker"
CLAIM_WORKER = "advsearch.questions.test.claims:claim_worker"


class _OtherSide(NamedTuple):
    """What the predictions of the model under test are compared with.

    It is another model, or the same model on changed images.

    Attributes:
        journal: evaluates the other side, and stores its evaluations.
        change_image: changes the image of the model under test to that of the other
            side; None if the other side renders its own image.
    """

    journal: workbench.Journal
    change_image: ChangePicture | None


class _PictureScore(NamedTuple):
    """What an image shows about a claim.

    Attributes:
        score: from 0 (against the claim) to 1 (for it); None if the image does not
            count, because the object is out of view.
        violation_score: rank as an example against the claim: the image with the
            largest value is reported.
        text: description of the predictions.
    """

    score: float | None
    violation_score: float = 0.0
    text: str = ""


class _Example(NamedTuple):
    """The image that is reported as an example against a claim.

    Attributes:
        violation_score: its rank, see `_PictureScore`.
        query: its query.
        text: description of the predictions.
    """

    violation_score: float
    query: workbench.Query
    text: str


@dataclass
class _PictureSample:
    """What sampled images show about a claim.

    Attributes:
        scores: score of each image that counts, from 0 to 1; see `score_picture`.
        wrong_payloads: data that the task has stored about wrong predictions.
        n_hidden: number of images with the object out of view, which do not count.
        verdict: verdict from the images so far.
        worst: the worst example against the claim; None if there is none.
    """

    scores: list[float] = field(default_factory=list)
    wrong_payloads: list[Any] = field(default_factory=list)
    n_hidden: int = 0
    verdict: str = UNDECIDED
    worst: _Example | None = None

    def add_score(self, score: float, judgement: tasks.Judgement) -> None:
        """Add the score of an image that counts, and what is stored if it is wrong."""
        self.scores.append(score)
        if not judgement.right:
            self.wrong_payloads.append(judgement.payload)

    def add_example(
        self, violation_score: float, query: workbench.Query, text: str
    ) -> None:
        """Add an example against the claim; only the worst one stays."""
        if self.worst is None or violation_score > self.worst.violation_score:
            self.worst = _Example(violation_score, query, text)


@dataclass
class _TrialSample:
    """What trials of a counterexample show.

    Attributes:
        outcomes: whether the model is right in each trial; None for a trial that does
            not count.
        wrong_payloads: data that the task has stored about wrong predictions.
        label: label of the first wrong prediction; empty if there is none.
        picture: path of its image inside the run; None if there is none.
    """

    outcomes: list[bool | None] = field(default_factory=list)
    wrong_payloads: list[Any] = field(default_factory=list)
    label: str = ""
    picture: str | None = None

    def add_outcome(self, outcome: bool | None, trial: tasks.Judgement) -> bool:
        """Add the outcome of a trial, and return whether the model is wrong in it.

        The outcome is None for a trial that does not count.
        """
        self.outcomes.append(outcome)
        is_wrong = outcome is False
        if is_wrong:
            self.wrong_payloads.append(trial.payload)
        return is_wrong

    @property
    def n_right(self) -> int:
        return self.outcomes.count(True)

    @property
    def n_wrong(self) -> int:
        return self.outcomes.count(False)

    @property
    def n_uncounted(self) -> int:
        return self.outcomes.count(None)

    def is_enough(self, *, has_conditions: bool) -> bool:
        """Return whether no further trials are needed.

        If a single scene was predicted right and wrong, it depends on the noise, and
        the verdict is certain to be undecided. Otherwise `count_trials` trials that
        count are needed.

        Args:
            has_conditions: whether conditions, such as the light, vary between trials.
        """
        depends_on_noise = self.n_right > 0 and self.n_wrong > 0 and not has_conditions
        n_counted = self.n_right + self.n_wrong
        n_needed = count_trials(has_conditions=has_conditions)
        # Trials are added one at a time, so that their number is never exceeded.
        return depends_on_noise or n_counted == n_needed


@dataclass
class ClaimTester:
    """Test the claims of a suite.

    Attributes:
        context: context of the run.
        suite: the suite.
        start_time: start of the test, by `time.perf_counter`.
        warnings: sentences that a reader has to know; the tester appends to them.
        model_names: names of loaded models, by the setting `model`; the tester adds
            them.
    """

    context: RunContext[suites.SuiteConfig]
    suite: suites.Suite
    start_time: float
    warnings: list[str]
    model_names: dict[str, str] = field(default_factory=dict)

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
        """The seconds since the start of the test."""
        return time.perf_counter() - self.start_time

    @property
    def time_limit(self) -> float:
        """The seconds after which no further test begins; infinite without a limit."""
        return self.config.seconds or self.suite.seconds or math.inf

    @property
    def out_of_time(self) -> bool:
        """Whether the time is over."""
        return self.elapsed_seconds >= self.time_limit

    def test_claim(
        self, untested_result: ClaimResult, claim: AnyClaim, config: SceneConfig
    ) -> ClaimResult:
        """Test a claim, and return its result.

        Args:
            untested_result: the result without a verdict.
            claim: what is claimed.
            config: settings of its pictures, or of its search.
        """
        if isinstance(claim, ShareClaim | NoWorseClaim):
            return self._test_by_pictures(untested_result, claim, config)
        assert isinstance(config, AttackConfig)
        return self._test_by_search(untested_result, config)

    def _test_by_search(
        self, untested_result: ClaimResult, config: AttackConfig
    ) -> ClaimResult:
        """Test the claim that no search breaks a model, by an attack.

        The attack is a part of this run. The claim fails if the attack finds a verified
        adversarial scene.

        Args:
            untested_result: the result without a verdict, which is filled in.
            config: settings of the attack.
        """
        search = self._make_search(config)
        summary = self.context.run_part(untested_result.name, search)
        assert isinstance(summary, workbench.AttackSummary)
        self.warnings += summary.warnings
        # If no number of steps was set, the search has chosen one.
        planned = search.model_copy(update={"steps": search.steps or summary.steps})
        evaluated = words.evaluate_search(summary, planned)
        picture = None
        if evaluated.verdict == FAILED:
            picture = self._find_search_picture(untested_result.name, summary)
        update = {
            "verdict": evaluated.verdict,
            "reason": evaluated.reason,
            "cause": evaluated.cause,
            "part": untested_result.name,
            "pictures": _count_rendered(summary),
            "picture": picture,
        }
        return untested_result.model_copy(update=update)

    def _find_search_picture(
        self, name: str, summary: workbench.AttackSummary
    ) -> str | None:
        """Return the path of an image that the model gets wrong, relative to the run.

        It is the adversarial image; or the clean image, if the model is already wrong
        there. None if the search has not stored it.

        Args:
            name: name of the claim, and of the part of the run.
            summary: summary of the search.
        """
        image_name = "clean" if summary.ending == "already wrong" else "adversarial"
        part = self.run.locate_part(self.run.path, name)
        image = part / "images" / f"{image_name}.png"
        return image.relative_to(self.run.path).as_posix() if image.is_file() else None

    def _make_search(self, config: AttackConfig) -> AttackConfig:
        """Return the settings of the search, within the remaining time."""
        # at least a millisecond, as a limit has to be positive
        remaining = max(0.001, self.time_limit - self.elapsed_seconds)
        seconds = min(remaining, config.seconds or math.inf)  # infinite without limits
        changes = {
            "workers": self.config.workers,
            "cluster": self.config.cluster,
            "seconds": seconds if math.isfinite(seconds) else None,
        }
        # Python objects in the settings, such as a model, are lost in the copy: they
        # are added again.
        return config.model_copy(update=changes).with_python_only_parts(
            config.python_only_parts
        )

    def _test_by_pictures(
        self,
        untested_result: ClaimResult,
        claim: ShareClaim | NoWorseClaim,
        config: SceneConfig,
    ) -> ClaimResult:
        """Sample pictures until they decide a claim, or all of them are sampled.

        The claim is about the predictions of one model, or compares them with those of
        another model, or with those on changed images. A confidence sequence is valid
        at all sample sizes at once, so that sampling may stop as soon as the claim is
        decided.

        Args:
            untested_result: the result without a verdict, which is filled in.
            claim: the claim.
            config: settings of the pictures.
        """
        name = untested_result.name
        problem = self._load_problem(config)
        # A claim is held by the lower bound of the mean score, and failed by the upper
        # bound. At most one of the two is wrong, so each may be one-sided.
        sequence = statistics.sequential.ConfidenceSequence(
            self.suite.confidence, sides=1
        )
        with self._open_evaluations(name, claim, config, problem) as evaluated:
            sample = self._sample_pictures(evaluated, claim, sequence)

        example, picture = self._report_worst(name, problem, sample.worst)
        is_late = sample.verdict == UNDECIDED and self.out_of_time
        task = problem.task.name
        reason = _describe_sample(claim, sample, sequence.interval, example, task)
        if is_late:
            reason += f"; {OUT_OF_TIME_REASON}"
        update = {
            **_make_sample_fields(claim, sample, sequence),
            "reason": reason,
            "cause": Cause.OUT_OF_TIME if is_late else None,
            "spp": samples_per_pixel(config),
            "picture": picture,
        }
        return untested_result.model_copy(update=update)

    def _report_worst(
        self, name: str, problem: Problem, worst: _Example | None
    ) -> tuple[str, str | None]:
        """Describe the worst example against a claim, and save its picture.

        Args:
            name: name of the claim.
            problem: problem of the model under test.
            worst: the example; None if there is none.

        Returns:
            The description, and the path of the picture; "" and None without example.
        """
        if worst is None:
            return "", None
        example = f"{worst.text}: {self._describe(problem, worst.query)}"
        return example, self._save_picture(name, problem, worst.query)

    @staticmethod
    def _sample_pictures(
        evaluated: Iterable[Evaluated],
        claim: ShareClaim | NoWorseClaim,
        sequence: statistics.sequential.ConfidenceSequence,
    ) -> _PictureSample:
        """Evaluate pictures until their scores decide the claim, or there are no more.

        Args:
            evaluated: queries, each with the evaluation by the model under test and
                that of the other side, or None.
            claim: what is claimed.
            sequence: confidence sequence of the mean score, to which each score is
                added.

        Returns:
            The scores, the verdict, and the worst picture against the claim.
        """
        sample = _PictureSample()
        for query, evaluation, other in evaluated:
            score, violation_score, text = score_picture(claim, evaluation, other)
            # The object is not visible in the picture, so nothing can be predicted.
            if score is None:
                sample.n_hidden += 1
                continue
            sequence.add(score)
            sample.add_score(score, evaluation.required_judgement)
            is_against_claim = score == 0.0
            if is_against_claim:
                sample.add_example(violation_score, query, text)
            sample.verdict = _decide(sequence, compute_score_threshold(claim))
            if sample.verdict != UNDECIDED:
                break
        return sample

    @contextmanager
    def _open_evaluations(
        self,
        name: str,
        claim: ShareClaim | NoWorseClaim,
        config: SceneConfig,
        problem: Problem,
    ) -> Iterator[Iterator[Evaluated]]:
        """Open the workers that evaluate sampled pictures, of one or of two models.

        The other side is what the model is compared with: another model, or the same
        model on changed images. A claim that images are right has no other side.

        Args:
            name: name of the claim.
            claim: the claim.
            config: settings of its images.
            problem: problem of the model under test.

        Yields:
            The queries with their evaluations.
        """
        worker_call, worker_config = self._choose_worker(claim, config)
        other_problem, change = self._load_other_side(claim, config, problem)
        hint = "fewer pictures in the suite shorten it"
        self.progress.stage(name, claim.pictures, hint=hint, at_most=True)
        queries = sample_queries(
            problem, f"claim {name}", claim.pictures, samples_per_pixel(config)
        )
        with workbench.open_executor(
            worker_config, worker_call, self.progress
        ) as executor:
            evaluator, other_evaluator = _make_evaluators(
                claim, problem, other_problem, executor
            )
            journal = workbench.Journal(self.run, evaluator)
            other = None
            if other_evaluator is not None:
                other_journal = workbench.Journal(self.run, other_evaluator)
                other = _OtherSide(other_journal, change)
            yield self._evaluate_queries(journal, queries, other)

    def _choose_worker(
        self, claim: ShareClaim | NoWorseClaim, config: SceneConfig
    ) -> tuple[str, AttackConfig]:
        """Return the function that workers call, and their settings.

        If the claim is about two models, the settings name both.
        """
        worker_config = AttackConfig.from_config(
            config, workers=self.config.workers, cluster=self.config.cluster
        )
        if not isinstance(claim, NoWorseClaim):
            return ATTACK_WORKER, worker_config
        both_models = {"model": f"{config.model},{claim.than}"}
        return CLAIM_WORKER, worker_config.model_copy(update=both_models)

    def _load_other_side(
        self, claim: ShareClaim | NoWorseClaim, config: SceneConfig, problem: Problem
    ) -> tuple[Problem, ChangePicture | None]:
        """Return the problem of the other side, and the function that makes its images.

        The other side is what the model under test is compared with. The function makes
        its image from the image of the model under test. It is None if the other side
        renders its own images. If there is no other side, it is None, too, and the
        problem is that of the model under test.

        Args:
            claim: the claim.
            config: settings of the pictures.
            problem: problem of the model under test.
        """
        if isinstance(claim, NoWorseClaim):
            other = self._load_problem(config.model_copy(update={"model": claim.than}))
            takes_same_images = other.renderer.formation == problem.renderer.formation
            # `_same_picture` returns an image unchanged: it is not rendered twice.
            return other, _same_picture if takes_same_images else None
        if isinstance(claim, ChangeClaim):
            # The ground truth is that of the picture before the change.
            return problem, self._make_change(claim, config, problem)
        return problem, None

    def _make_change(
        self, claim: ChangeClaim, config: SceneConfig, problem: Problem
    ) -> ChangePicture:
        """Return the function that changes the image of a query as the claim states.

        Args:
            claim: a claim about predictions under a change, such as a blurred image.
            config: settings of the scene.
            problem: problem of the model under test.
        """
        # `claim.when` names the change, such as "blurred".
        if claim.when != workbench.WITHOUT_OBJECT:
            return lambda query, picture: workbench.change_image(
                picture, claim.when, problem.model.cameras
            )
        # The scene is loaded once more, and its object is hidden in all renders.
        without_object = self._load_problem(config)
        without_object.renderer.scene.input_assembler.is_object_hidden = True
        return lambda query, picture: without_object.picture(
            query.u, query.seed, query.spp
        )

    def _evaluate_queries(
        self,
        journal: workbench.Journal,
        queries: Iterator[workbench.Query],
        other_side: _OtherSide | None = None,
    ) -> Iterator[Evaluated]:
        """Yield queries with their evaluations by both sides, until the time is over.

        Queries are evaluated in batches that keep all workers busy. The evaluation by
        the other side is None if there is none.

        Args:
            journal: evaluates the queries.
            queries: the queries.
            other_side: what the model is compared with, such as another model; None if
                there is no other side.
        """
        batch_size = self._choose_batch_size(journal)
        while batch := list(islice(queries, batch_size)):
            evaluations, others = _evaluate_sides(journal, other_side, batch)
            for query, evaluation, other in zip(
                batch, evaluations, others, strict=False
            ):
                self.progress.advance(1, **journal.evaluator.progress_stats)
                yield query, evaluation, other
            if self.out_of_time:
                return

    def _choose_batch_size(self, journal: workbench.Journal) -> int:
        """Return how many queries are evaluated at once.

        Without workers a batch has one query, so that nothing more is rendered once the
        claim is decided.
        """
        if journal.evaluator.workers is None:
            return 1
        # The number of workers of a cluster is not known.
        n_workers = self.config.workers or CLUSTER_WORKERS
        return BATCHES_AHEAD * n_workers

    def test_counterexample(
        self,
        untested_result: ClaimResult,
        example: Counterexample,
        config: AttackConfig,
    ) -> ClaimResult:
        """Test a counterexample: the model should be right on it.

        If its files or its scene have changed, or if it does not suit the model, its
        verdict stays undecided, as in `untested_result`, and the reason is added.

        Args:
            untested_result: the result without a verdict, which is filled in.
            example: the counterexample.
            config: settings with which it is tested.
        """
        statement = _state_counterexample(config.model, example)
        untested_result = untested_result.model_copy(update={"statement": statement})
        try:
            parts = workbench.load_parts(config)
            # Trials need no derivatives.
            problem = workbench.make_problem(parts, differentiated=False)
        except InputError as error:
            reason = words.describe_unsuitable(str(error))
            return untested_result.model_copy(update={"reason": reason})
        reason = _explain_change(example, config, parts)
        if reason:
            return untested_result.model_copy(update={"reason": reason})
        return self._test_by_trials(
            untested_result, example, problem, has_conditions=varies_conditions(config)
        )

    def _test_by_trials(
        self,
        untested_result: ClaimResult,
        example: Counterexample,
        problem: Problem,
        *,
        has_conditions: bool,
    ) -> ClaimResult:
        """Test a counterexample by trials with fresh seeds.

        Args:
            untested_result: the result without a verdict.
            example: the counterexample.
            problem: problem of the model under test.
            has_conditions: whether conditions vary. Then the clean scene is rendered
                under the same conditions in each trial, and the trial does not count if
                the model is wrong there.
        """
        sample = self._sample_trials(example, problem, has_conditions=has_conditions)
        # fields of the result that follow from the trials: verdict, reason, counts, ...
        update = _trials_result(
            sample, problem.task.name, has_conditions=has_conditions
        )
        is_late = self.out_of_time and not sample.is_enough(
            has_conditions=has_conditions
        )
        if is_late:
            # The reason states what the trials were, if there were any.
            reasons = [update["reason"]] if sample.outcomes else []
            update |= _make_late_fields(reasons)
        update |= {"picture": sample.picture, "spp": example.spp}
        return untested_result.model_copy(update=update)

    def _sample_trials(
        self, example: Counterexample, problem: Problem, *, has_conditions: bool
    ) -> _TrialSample:
        """Make trials until further ones would change nothing, or the time is over.

        The picture of the first wrong trial is saved.

        Args:
            example: the counterexample.
            problem: problem of the model under test.
            has_conditions: whether conditions vary; then the clean scene is rendered in
                each trial, too.
        """
        # Because of rounding, stored offsets may exceed the budget by a little.
        u = problem.domain.project(example.make_configuration(problem.domain.start))
        # When the counterexample is added (setting `add`), trials have other seeds than
        # in later tests of the suite.
        prefix = "added " if self.config.add is not None else ""
        kind = f"{prefix}counterexample {example.name}"
        journal = workbench.Journal(self.run, workbench.ParallelEvaluator(problem))
        max_renders = _count_trial_renders(has_conditions=has_conditions)
        self.progress.stage(example.name, max_renders, at_most=True)
        sample = _TrialSample()
        for query, trial, clean in self._run_trials(
            journal, kind, u, example.spp, has_conditions=has_conditions
        ):
            is_wrong = sample.add_outcome(is_right_in_trial(trial, clean), trial)
            if is_wrong and not sample.label:
                sample.label = trial.prediction.label
                sample.picture = self._save_picture(example.name, problem, query)
            if sample.is_enough(has_conditions=has_conditions):
                break
        return sample

    def _run_trials(
        self,
        journal: workbench.Journal,
        kind: str,
        u: Tensor,
        spp: int,
        *,
        has_conditions: bool,
    ) -> Iterator[tuple[workbench.Query, tasks.Judgement, tasks.Judgement | None]]:
        """Yield the trials of a configuration, until the time is over.

        There are twice as many trials as needed, since some may not count. The caller
        stops when it has enough of them.

        Args:
            journal: evaluates the trials, and stores them.
            kind: kind of their seeds and stored rows.
            u: (d,) the configuration.
            spp: samples per pixel.
            has_conditions: whether conditions vary. Then the clean scene is evaluated
                as well, under the same conditions.

        Yields:
            Query and judgement of the configuration, and the judgement of the clean
            scene. The latter is None without varying conditions.
        """
        queries = self._list_trial_queries(
            journal.problem, kind, u, spp, has_conditions=has_conditions
        )
        evaluated = self._evaluate_queries(journal, iter(queries))
        for query, trial, _ in evaluated:
            if not has_conditions:
                yield query, trial.required_judgement, None
                continue
            # The next evaluation is that of the clean scene. It is missing if the time
            # is over.
            clean_result = next(evaluated, None)
            if clean_result is None:
                return
            _, clean, _ = clean_result  # query, evaluation, no other side
            yield query, trial.required_judgement, clean.required_judgement

    def _list_trial_queries(
        self, problem: Problem, kind: str, u: Tensor, spp: int, *, has_conditions: bool
    ) -> list[workbench.Query]:
        """Return the queries of trials, each followed by that of the clean scene, if any.

        Args:
            problem: problem of the model under test.
            kind: kind of their seeds and stored rows.
            u: (d,) the configuration.
            spp: samples per pixel.
            has_conditions: whether conditions vary, so that the clean scene is evaluated.
        """
        clean_u = problem.domain.start
        queries = list[workbench.Query]()
        for index in range(2 * count_trials(has_conditions=has_conditions)):
            seed = seeds.derive_seed(self.suite.seed, kind, index)
            query = workbench.Query(u, seed, kind, index, spp=spp)
            queries.append(query)
            if has_conditions:
                queries.append(replace(query, u=clean_u, kind=f"{kind}, clean"))
        return queries

    def _load_problem(self, config: SceneConfig) -> Problem:
        """Load scene, model and task, and add remarks on them to the warnings."""
        parts = workbench.load_parts(AttackConfig.from_config(config))
        _, model_warnings = parts.model_and_warnings
        # Copied, because `make_problem` appends remarks of the task to this list. These
        # are in the reason of each claim, and are no warnings.
        remarks = list(model_warnings)
        problem = workbench.make_problem(parts, differentiated=False)
        self.model_names[config.model] = problem.model.name
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


def _count_rendered(summary: workbench.AttackSummary) -> int:
    """Return the number of images that an attack has rendered."""
    # "products" are images that were computed by matrices of light transport, and
    # not rendered.
    return sum(count for name, count in summary.renders.items() if name != "products")


def _make_sample_fields(
    claim: ShareClaim | NoWorseClaim,
    sample: _PictureSample,
    sequence: statistics.sequential.ConfidenceSequence,
) -> dict[str, object]:
    """Return the numbers of a `ClaimResult` that follow from sampled images.

    Args:
        claim: what is claimed.
        sample: the images.
        sequence: confidence sequence of the mean score.
    """
    rate = None
    if sample.scores:
        # a tuple with one converted number for each argument
        (rate,) = _to_claim_scale(claim, sequence.mean)
    return {
        "verdict": sample.verdict,
        "interval": _to_claim_scale(claim, *sequence.interval),
        "pictures": len(sample.scores),
        "rate": rate,
    }


def _make_evaluators(
    claim: ShareClaim | NoWorseClaim,
    problem: Problem,
    other_problem: Problem,
    executor: Any,
) -> tuple[workbench.ParallelEvaluator, workbench.ParallelEvaluator | None]:
    """Make the evaluators of the model under test, and of the other side, if any.

    Args:
        claim: the claim.
        problem: problem of the model under test.
        other_problem: problem of the other side.
        executor: the workers.
    """
    if isinstance(claim, NoWorseClaim):
        # Workers (`claim_worker`) load both models. A request names the model
        # by its index: "0" is the one under test, "1" the other one.
        return (
            workbench.ParallelEvaluator(problem, executor, "0"),
            workbench.ParallelEvaluator(other_problem, executor, "1"),
        )
    evaluator = workbench.ParallelEvaluator(problem, executor)
    if isinstance(claim, RightClaim):
        return evaluator, None
    # Changed images are predicted in this process, without workers.
    return evaluator, workbench.ParallelEvaluator(other_problem)


def _state_counterexample(model: str, example: Counterexample) -> str:
    """State what is claimed about a model by a counterexample."""
    return f"{model} is right on a scene that was predicted as {example.wrong_label}"


def _explain_change(
    example: Counterexample, config: AttackConfig, parts: workbench.AttackParts
) -> str:
    """Return why a counterexample is not tested, if it has changed; else "".

    Args:
        example: the counterexample.
        config: settings with which it is tested.
        parts: loaded parts of its attack.
    """
    changed_file = example.find_changed_file(config)
    if changed_file:
        return (
            f"the file {changed_file} has changed; restore it, or remove the "
            "counterexample"
        )
    if compute_scene_digest(parts.scene.description) != example.scene_digest:
        return (
            "its scene has changed; remove it, or add the adversarial scene of a "
            "new run"
        )
    return ""


def _make_late_fields(reasons: Sequence[str]) -> dict[str, Any]:
    """Return the fields of a result whose test ended since the time was over.

    Args:
        reasons: what is known about it.
    """
    return {
        "verdict": UNDECIDED,
        "reason": "; ".join([*reasons, OUT_OF_TIME_REASON]),
        "cause": Cause.OUT_OF_TIME,
    }


def _count_trial_renders(*, has_conditions: bool) -> int:
    """Return the maximum number of renders of the trials of a counterexample."""
    max_renders = count_trials(has_conditions=has_conditions)
    if has_conditions:
        # Twice as many trials as needed may be made, since some may not count. Each
        # has two renders, one of them of the clean scene.
        max_renders *= 2 * 2
    return max_renders


def _evaluate_sides(
    journal: workbench.Journal,
    other_side: _OtherSide | None,
    batch: Sequence[workbench.Query],
) -> tuple[Iterable[policies.Evaluation], Iterable[policies.Evaluation | None]]:
    """Return the evaluations of a batch of queries by the model and by the other side.

    Args:
        journal: evaluates the model under test, and stores the rows.
        other_side: what the model is compared with; None if there is no other side.
        batch: the queries.
    """
    if other_side is None:
        # No images are needed for another side.
        evaluate = partial(_evaluate_with_pictures, journal, None)
        return journal.evaluate_all(batch, evaluate), repeat(None)
    return _evaluate_batch(journal, other_side, batch)


def _evaluate_with_pictures(
    journal: workbench.Journal,
    pictures: dict[int, Tensor | None] | None,
    queries: Sequence[workbench.Query],
) -> Iterator[policies.Evaluation]:
    """Evaluate queries, and store their images by the index of the query.

    Args:
        journal: its evaluator renders the images and predicts them.
        pictures: mapping to which the images are added; None if they are not needed.
        queries: the queries.
    """
    with_image = pictures is not None
    # an iterator, which evaluates a query when its evaluation is requested
    evaluations = journal.evaluator(
        [replace(query, includes_image=with_image) for query in queries]
    )
    for query, evaluation in zip(queries, evaluations, strict=True):
        if pictures is not None:
            pictures[query.row_index] = evaluation.picture
        yield evaluation


def _evaluate_batch(
    journal: workbench.Journal,
    other_side: _OtherSide,
    batch: Sequence[workbench.Query],
) -> tuple[Iterable[policies.Evaluation], Iterable[policies.Evaluation]]:
    """Return the evaluations of both sides of a batch of queries.

    Args:
        journal: evaluates the model under test, and stores the rows.
        other_side: what the model is compared with.
        batch: the queries.
    """
    # Images are stored, by the index of the query, only if the other side changes them.
    pictures: dict[int, Tensor | None] | None = {}
    if other_side.change_image is None:
        pictures = None
    # Evaluations are computed when they are requested. With a list, all images are
    # stored before the other side changes them.
    evaluations = list(
        journal.evaluate_all(batch, partial(_evaluate_with_pictures, journal, pictures))
    )
    # Another kind, so that the store has separate rows for the other side.
    other_queries = [replace(query, kind=f"{query.kind} beside") for query in batch]
    others = other_side.journal.evaluate_all(
        other_queries,
        partial(_evaluate_other_side, other_side, journal.evaluator.problem, pictures),
    )
    return evaluations, others


def _evaluate_other_side(
    other_side: _OtherSide,
    problem: Problem,
    pictures: Mapping[int, Tensor | None] | None,
    queries: Sequence[workbench.Query],
) -> Iterator[policies.Evaluation]:
    """Evaluate what the model under test is compared with.

    That is a model on the same images after a change, such as blurring; or another
    model on its own images.

    Args:
        other_side: the evaluator and, if images are changed, the change.
        problem: problem of the model under test.
        pictures: its images, by the index of the query; None if there is no change.
        queries: the queries.
    """
    if other_side.change_image is None or pictures is None:
        # Both are None: the other side renders its own images.
        yield from other_side.journal.evaluator(queries)
        return
    other_problem = other_side.journal.evaluator.problem
    for query in queries:
        # There is no image if the evaluation was read from the store of a resumed run.
        picture = pictures.get(query.row_index)
        if picture is None:
            picture = problem.picture(query.u, query.seed, query.spp)
        changed_picture = other_side.change_image(query, picture)
        # Claims that are tested by images have no varying conditions, so that no seed
        # is needed.
        full_configuration = other_problem.make_full_configuration(query.u)
        judgement = other_problem.judge(changed_picture, full_configuration)
        yield policies.Evaluation.from_judgement(judgement)


def claim_worker(values: dict[str, Any]) -> Callable[[Any], Any]:
    """Return the function that a worker process calls for a claim about two models.

    A request names its model by index, "0" or "1". A model is loaded at its first use.

    Args:
        values: settings of the claim's pictures, with both models.
    """
    models = settings.split_names(str(values["model"]))

    def load_problem(model_index: str) -> Problem:
        """Load the problem of a model by its index."""
        config = AttackConfig(**{**values, "model": models[int(model_index)]})
        return workbench.make_problem(
            workbench.load_parts(config), differentiated=False
        )

    # `cache` loads each model once.
    return workbench.make_worker_call(cache(load_problem))


def sample_queries(
    problem: Problem, kind: str, count: int, spp: int
) -> Iterator[workbench.Query]:
    """Yield configurations that are sampled uniformly from all allowed ones.

    Each has its own seed of the noise. The samples depend only on the kind and the
    index, so that a resumed run has the same samples.

    Args:
        problem: problem of the model under test.
        kind: kind of their seeds and stored rows.
        count: number of configurations.
        spp: samples per pixel.
    """
    for index in range(count):
        generator = torch.Generator().manual_seed(
            seeds.derive_seed(problem.seed, f"{kind} draw", index)
        )
        (u,) = problem.domain.sample(generator)  # one configuration
        seed = seeds.derive_seed(problem.seed, kind, index)
        # Values of parameters are stored with the row, except for large textures.
        values = {}
        if problem.domain.dim <= MAX_STORED_VALUES:
            values = problem.describe(u, seed)
        # Only a search has a success, the prediction that it looks for.
        yield workbench.Query(
            u, seed, kind, index, spp=spp, values=values, has_success=False
        )


def compute_score_threshold(claim: ShareClaim | NoWorseClaim) -> float:
    """Return the threshold that the mean of the scores has to exceed, from 0 to 1.

    For a claim about two models, a mean of 1/2 means that both are equally good. It is
    less by 1/200 for each percentage point by which the model is right less often.
    """
    if isinstance(claim, ShareClaim):
        return claim.at_least
    return 0.5 - claim.points / 200.0


def check_pictures(name: str, claim: AnyClaim, confidence: float) -> str:
    """Check a claim's number of images; return a remark, or "" if it is enough.

    With that number of images, the verdict has to be "held" for a model that is always
    right, and "failed" for one that is always wrong. Otherwise the test is useless. For
    a claim that compares two models, the result is a remark if the claim could not be
    held for two models with the same predictions.

    Raises:
        InputError: with that number of images, one of the two verdicts is impossible.
    """
    if not isinstance(claim, ShareClaim | NoWorseClaim):
        return ""
    count_needed = partial(
        statistics.sequential.count_needed_samples, confidence=confidence
    )
    threshold = compute_score_threshold(claim)
    # Images of score 1 until the lower bound exceeds the threshold; and images of score
    # 0 until the upper bound is below it. The latter is the same as scores of 1 for the
    # threshold 1 - t.
    n_to_hold = count_needed(threshold)
    n_to_fail = count_needed(1.0 - threshold)
    needed = max(n_to_hold, n_to_fail)
    if claim.pictures < needed:
        raise _make_too_few_pictures_error(name, claim.pictures, needed, confidence)
    if not isinstance(claim, NoWorseClaim):
        return ""
    # Models that predict alike have a score of 1/2 on each picture.
    return _remark_on_equal_models(name, claim, count_needed(threshold, value=0.5))


def _make_too_few_pictures_error(
    name: str, n_pictures: int, needed: int, confidence: float
) -> InputError:
    """Make the error that a claim has fewer pictures than are needed for a verdict."""
    return InputError(
        f"claims.{name}.pictures: expected at least {needed}, since with fewer one "
        "of the verdicts held and failed is impossible at a confidence of "
        f"{wording.format_number(confidence)}, got {n_pictures}"
    )


def _remark_on_equal_models(
    name: str, claim: NoWorseClaim, needed_if_equal: int
) -> str:
    """Return a remark if a claim has too few images for two equal models, else "".

    Args:
        name: name of the claim.
        claim: the claim.
        needed_if_equal: number of images with which it can be held for them.
    """
    if claim.pictures >= needed_if_equal:
        return ""
    return (
        f"{name}: for two models with the same predictions, this claim can be held "
        f"with {needed_if_equal} images, and it has at most {claim.pictures}."
    )


def score_picture(
    claim: ShareClaim | NoWorseClaim,
    evaluation: policies.Evaluation,
    other: policies.Evaluation | None,
) -> _PictureScore:
    """Score an image for a claim.

    The score is 1 if the model is right, or if its prediction under a change
    (`ChangeClaim`, a kind of `ShareClaim`) is as claimed; and 0 otherwise. For two
    models it is 1 if only the first is right, 0 if only the other is right, and 1/2 if
    both are right or both are wrong. If the object is not visible, the score is None,
    and the image does not count.

    Args:
        claim: what is claimed.
        evaluation: evaluation of the model under test.
        other: evaluation of the other side, if there is one.
    """
    judgement = evaluation.required_judgement
    prediction = judgement.prediction
    if prediction.is_out_of_view:
        return _PictureScore(None)
    if other is None:
        return _score_alone(judgement)
    other_judgement = other.required_judgement
    other_prediction = other_judgement.prediction
    if isinstance(claim, ChangeClaim):
        return _score_change(claim, prediction, other_prediction)
    # Images of different sizes may differ in whether the object is visible.
    if other_prediction.is_out_of_view:
        return _PictureScore(None)
    difference = int(judgement.right) - int(other_judgement.right)  # -1, 0 or 1
    return _PictureScore((difference + 1) / 2)


def _score_change(
    claim: ChangeClaim, before: tasks.Prediction, after: tasks.Prediction
) -> _PictureScore:
    """Score an image by the predictions before and after a change."""
    # No image violates such a claim more than another: the first one is reported.
    text = f"{before.label} before and {after.label} after"
    is_as_claimed = workbench.meets_claim(claim.claim, before, after)
    return _PictureScore(float(is_as_claimed), text=text)


def _score_alone(judgement: tasks.Judgement) -> _PictureScore:
    """Score an image by the judgement of the model under test alone."""
    # The larger the score of a judgement, the more wrong is the model. The image
    # with the largest score is reported, but not one with an infinite score or NaN.
    violation_score = -math.inf
    if math.isfinite(judgement.score):
        violation_score = judgement.score
    text = f"most wrong where it says {judgement.prediction.label}"
    return _PictureScore(float(judgement.right), violation_score, text)


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
    if isinstance(claim, NoWorseClaim):
        # A mean of 1/2 is a difference of 0, a mean of 1 one of 1.
        return tuple(2.0 * mean - 1.0 for mean in means)
    return means


def _describe_sample(
    claim: ShareClaim | NoWorseClaim,
    sample: _PictureSample,
    interval: tuple[float, float],
    example: str,
    task: str,
) -> str:
    """Describe why sampled images decide a claim, or why they do not.

    Args:
        claim: what is claimed.
        sample: the pictures.
        interval: confidence interval of the mean score.
        example: text about the worst picture against the claim; empty if there is none.
            It is not used for a `NoWorseClaim`.
        task: name of the task.
    """
    if isinstance(claim, NoWorseClaim):
        reason = _describe_compared_sample(claim, sample, interval)
    else:
        reason = _describe_share_sample(claim, sample, interval, example, task)
    if sample.n_hidden:
        reason += (
            f"; the object is not to be seen in {sample.n_hidden} more, "
            "which are not counted"
        )
    return reason


def _describe_compared_sample(
    claim: NoWorseClaim, sample: _PictureSample, interval: tuple[float, float]
) -> str:
    """Describe how often each of two models alone is right; see `_describe_sample`."""
    lower, upper = _to_claim_scale(claim, *interval)
    return words.describe_difference(
        sample.verdict,
        n_pictures=len(sample.scores),
        n_only_this=sample.scores.count(1.0),
        n_only_other=sample.scores.count(0.0),
        interval=(lower, upper),
        other_model=claim.than,
    )


def _describe_share_sample(
    claim: ShareClaim,
    sample: _PictureSample,
    interval: tuple[float, float],
    example: str,
    task: str,
) -> str:
    """Describe in how many images the claim is met; see `_describe_sample`."""
    is_right_claim = isinstance(claim, RightClaim)
    outcomes = ""
    if is_right_claim:
        outcome_counts = workbench.count_outcomes(sample.wrong_payloads)
        outcomes = wording.format_outcomes(outcome_counts, task)
    return words.describe_fraction(
        "right" if is_right_claim else "as claimed",
        sample.verdict,
        sample.scores.count(1.0),  # images for the claim
        len(sample.scores),
        interval,
        example,
        outcomes,
    )


def _trials_result(
    sample: _TrialSample, task: str, *, has_conditions: bool
) -> dict[str, Any]:
    """Return the fields of a `ClaimResult` that follow from trials.

    Args:
        sample: the trials.
        task: name of the task.
        has_conditions: whether conditions vary.
    """
    n_right = sample.n_right
    total = n_right + sample.n_wrong
    verdict = decide_trials(n_right, sample.n_wrong, has_conditions=has_conditions)
    interval = None
    if total:
        interval = statistics.intervals.clopper_pearson(n_right, total)
    return {
        "verdict": verdict,
        "reason": _explain_trials(
            sample, verdict, interval, task, has_conditions=has_conditions
        ),
        "pictures": len(sample.outcomes),
        "rate": n_right / total if total else None,
        "interval": interval,
    }


def _explain_trials(
    sample: _TrialSample,
    verdict: str,
    interval: tuple[float, float] | None,
    task: str,
    *,
    has_conditions: bool,
) -> str:
    """Describe why trials of a counterexample have a verdict.

    Args:
        sample: the trials.
        verdict: HELD, FAILED or UNDECIDED.
        interval: interval of the fraction of right trials; None if no trial counts.
        task: name of the task.
        has_conditions: whether conditions vary.
    """
    outcome_counts = workbench.count_outcomes(sample.wrong_payloads)
    return words.describe_trials(
        verdict,
        n_right=sample.n_right,
        n_wrong=sample.n_wrong,
        n_uncounted=sample.n_uncounted,
        label=sample.label,
        interval=interval,
        has_conditions=has_conditions,
        outcomes=wording.format_outcomes(outcome_counts, task),
    )


def _same_picture(_query: workbench.Query, picture: Tensor) -> Tensor:
    """Return a copy of the image, for another model."""
    return picture.clone()


def samples_per_pixel(config: SceneConfig) -> int:
    """Return the samples per pixel of a claim's pictures."""
    assert isinstance(config, suites.SampledConfig)
    return workbench.choose_ladder(config.verify_spp, config.pixel_sampler)[0]
