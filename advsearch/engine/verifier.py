"""Trials of configurations, stored as rows.

They verify the results of searches and different failures, also on other models and
under other conditions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

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
from advsearch.attacks.domain import split_into_batches
from advsearch.attacks.evaluation import Query, max_batch_size
from advsearch.attacks.trials import (
    LADDER,
    N_CONDITIONS,
    OVER_LADDER,
    MarginsOf,
    SampleCount,
    choose_rate_spp,
    count_max_samples,
    limit_ladder,
    make_margin_function,
)
from advsearch.cluster import Workers
from advsearch.engine.journal import Journal, ParallelEvaluator
from advsearch.engine.prediction import PredictedSearch, make_methods
from advsearch.engine.problem import Problem
from advsearch.engine.record import MAX_STORED_IMAGES, RunState
from advsearch.errors import InputError
from advsearch.progress import Progress, Stages
from advsearch.report.wording import format_count as plural
from advsearch.runs.directory import RunDirectory
from advsearch.runs.summary import read_configuration
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.formation import round_sample_count
from advsearch.scene.predictor import Refusal, RefusalCause
from advsearch.tasks import Judgement

# The row of a trial has the values of its configuration if these are at most this many.
MAX_DESCRIBED_COORDINATES = 64


def choose_ladder(verify_spp: int | None, sampler: str) -> Sequence[int]:
    """Return the samples per pixel that a verification may choose from, ascending.

    It is a single count if `verify_spp` states one, rounded as the sampler needs it.
    """
    return LADDER if verify_spp is None else (round_sample_count(sampler, verify_spp),)


@dataclass
class Verifier:
    """Runs the trials of one run, and collects their results.

    It chooses the sample count, and tries the control group, adversarial
    configurations, and single configurations.

    Attributes:
        journal: evaluates and stores the trials.
        spp_ladder: sample counts to choose from, ascending; a single one is not tested.
        progress_stages: stages of the progress of the run.
        run_state: results, images and the number of renders.
        look_sizes: numbers of trials, ascending, after which there may be a verdict
            (`attacks.verify`); the last is the largest number of trials of a group.
        has_success: whether a certain prediction is sought, so that rows state whether
            a trial is a success.
    """

    journal: Journal
    spp_ladder: Sequence[int]
    progress_stages: Stages
    run_state: RunState = field(default_factory=RunState)
    look_sizes: tuple[int, ...] = (0,)
    has_success: bool = True
    _clean_spp: int = 0
    _clean_kind: str = "control"
    # kind and number of all trials that were rendered
    _rendered: set[tuple[str, int]] = field(default_factory=set)

    @classmethod
    def open(
        cls, run: RunDirectory, problem: Problem, ladder: Sequence[int], stages: Stages
    ) -> Verifier:
        """Return a verifier that renders in this process and stores in a run
        directory.
        """
        return cls(Journal(run, ParallelEvaluator(problem)), ladder, stages)

    def __post_init__(self) -> None:
        self.problem: Problem = self.journal.problem

    @property
    def n_trials(self) -> int:
        """Largest number of trials of a group."""
        return self.look_sizes[-1]

    def evaluate_all(
        self,
        queries: Sequence[Query],
        *,
        in_samples: bool = False,
        predictor: PredictedSearch | None = None,
    ) -> Iterator[Evaluation]:
        """Evaluate trials lazily and in order; store their images, and count renders.

        A trial counts as one render, even if it is evaluated again: then its result is
        read from the store.

        Args:
            queries: the trials.
            in_samples: whether the progress bar counts samples per pixel, and not
                trials.
            predictor: predicts the images that it can; the others are rendered. None to
                render all.
        """
        evaluate = None
        if predictor is not None:
            evaluate = partial(predictor.evaluate_all, trace=self.journal.evaluator)
        if not self.has_success:  # then no row has a success
            queries = [replace(query, has_success=False) for query in queries]
        evaluations = self.journal.evaluate_all(queries, evaluate)
        for query, evaluation in zip(queries, evaluations, strict=True):
            self._record_trial(query, evaluation)
            steps = query.spp if in_samples else 1
            worker_stats = self.journal.evaluator.progress_stats
            self.progress_stages.progress.advance(steps, **worker_stats)
            yield evaluation

    def _record_trial(self, query: Query, evaluation: Evaluation) -> None:
        """Store the image of a trial, if it has one, and count its render."""
        trial = (query.kind, query.row_index)
        if evaluation.picture is not None:
            self.run_state.trial_images[trial] = evaluation.picture
        if evaluation.predicted:
            self.run_state.n_predicted_trials += 1
        else:
            self._rendered.add(trial)  # a set, in which each trial counts once
        self.run_state.verification_renders = len(self._rendered)

    def choose_spp(
        self, candidates: dict[str, Tensor], search_samples: int | None = None
    ) -> None:
        """Choose the samples per pixel of the verification, and store the choice.

        They are raised until more samples would not change the verdict. If conditions
        vary by chance, they are raised until more samples would not change the fraction
        of conditions under which the model is wrong.

        Args:
            candidates: configurations (d,) by name, such as the clean one.
            search_samples: samples per pixel of all renders of the searches. If
                conditions vary, the verification may not take more. None for no limit.
        """
        has_conditions = self.problem.conditions is not None
        choose: Callable[..., SampleCount] = choose_rate_spp
        if not has_conditions:
            choose = partial(choose_spp, trials=self.look_sizes[0])
        ladder = self._find_ladder(len(candidates), search_samples)
        # with a single sample count nothing is rendered
        if len(ladder) > 1:
            self._begin_sample_count_stage(
                self._count_max_samples(len(candidates), ladder)
            )
        margins = self._make_margin_functions(candidates, has_conditions)
        self.run_state.sample_count = choose(
            margins, seed=self.problem.seed, ladder=ladder
        )

    def _count_max_samples(self, n_candidates: int, ladder: Sequence[int]) -> int:
        """Return the samples per pixel of all renders that choose a sample count.

        It is for the progress bar, as if every sample count of the ladder was tried.
        """
        if self.problem.conditions is not None:
            return N_CONDITIONS * n_candidates * sum(ladder)
        return count_max_samples(n_candidates, ladder, self.look_sizes[0])

    def _find_ladder(
        self, n_candidates: int, search_samples: int | None
    ) -> Sequence[int]:
        """Return the sample counts to choose from, ascending.

        If conditions vary, they are limited, but a single count, set by the user, stays.
        """
        is_set_by_user = len(self.spp_ladder) == 1
        if self.problem.conditions is None or is_set_by_user:
            return self.spp_ladder
        return self._list_affordable_counts(n_candidates, search_samples)

    def _make_margin_functions(
        self, candidates: Mapping[str, Tensor], draws_conditions: bool
    ) -> dict[str, MarginsOf]:
        """Return functions that measure margins of candidates (d,), by their name."""
        evaluate = partial(self.evaluate_all, in_samples=True)
        return {
            name: make_margin_function(
                evaluate,
                f"sample count {name}",
                u,
                n_images=MAX_STORED_IMAGES,
                draws_conditions=draws_conditions,
            )
            for name, u in candidates.items()
        }

    def _begin_sample_count_stage(self, max_samples: int) -> None:
        """Begin the stage of the progress in which the sample count is chosen.

        `max_samples` are the samples per pixel of all its renders, at most.
        """
        self.progress_stages.begin(
            "verification",
            "finding how many samples the check needs",
            max_samples,
            hint="more and more samples a pixel until noise no longer moves the result "
            "(counted in samples a pixel); `verify_spp=NUMBER` leaves it out",
            at_most=True,
        )

    def _list_affordable_counts(
        self, n_candidates: int, search_samples: int | None
    ) -> Sequence[int]:
        """Return the sample counts to choose from if conditions vary.

        A count is left out if the verification would take many more samples with it
        than the searches did (`limit_ladder`).

        Args:
            n_candidates: number of configurations to verify.
            search_samples: samples per pixel of all renders of the searches; None for
                no limit.
        """
        if search_samples is None:
            return OVER_LADDER
        n_groups = n_candidates + 1  # a group of trials for each, and the control group
        return limit_ladder(OVER_LADDER, n_groups * self.n_trials, search_samples)

    def run_clean_trials(self) -> None:
        """Run the trials of the clean configuration, which are the control group.

        They have the same seeds as those of the adversarial configuration. If they were
        run at this sample count already, nothing is done.

        There may be two groups. If the model seems to be wrong about the clean scene, a
        first group is run before the search, to confirm that. If this shows that the
        model is right, the search is run. After it the sample count is chosen again. If
        it differs, a second group is run. The rows of both have different kinds.
        """
        # at this sample count
        if self.has_clean_trials:
            return
        self._clean_spp = self.run_state.spp
        is_before_search = self.run_state.search_result is None
        self._clean_kind = "first control" if is_before_search else "control"
        self.run_state.clean_trials = run_trials(
            self.evaluate_all,
            self.problem.domain.start,
            spp=self._clean_spp,
            seed=self.problem.seed,
            # `verify` runs more if the first look does not decide
            trials=self.look_sizes[0],
            kind=self._clean_kind,
            n_images=MAX_STORED_IMAGES,
        )

    @property
    def has_clean_trials(self) -> bool:
        """Whether the control group was tried at the current sample count."""
        return (
            bool(self.run_state.clean_trials) and self._clean_spp == self.run_state.spp
        )

    def verify(
        self,
        kind: str,
        result: SearchResult,
        *,
        curtailed: bool = False,
        with_new_trials: bool = False,
    ) -> Verification:
        """Verify the configuration that a search found against the control group.

        The control group is the clean scene in trials of the same seeds. If it has too
        few trials it gets more, which later calls use as well.

        Args:
            kind: kind of the rows.
            result: result of the search.
            curtailed: whether trials end as soon as the verdict is certain. That saves
                renders if only the verdict is needed, and not the success rate.
            with_new_trials: whether both groups get new trials with new seeds, numbered
                after all others.
        """
        # with new seeds the control group starts again
        clean_trials = () if with_new_trials else self.run_state.clean_trials
        verification = verify(
            self.evaluate_all,
            self.problem.domain,
            result.best_u,
            claim=result.ending,  # an ending of FOUND claims a failure
            spp=self.run_state.spp,
            seed=self.problem.seed,
            trials=self.look_sizes,  # numbers of trials after which there is a look
            clean=clean_trials,
            rule=self.problem.verification_rule,
            kind=kind,
            control_kind=self._clean_kind,
            n_images=MAX_STORED_IMAGES,
            curtailed=curtailed,
            # numbered after all others, so that their seeds are new too
            first_index=self.n_trials if with_new_trials else 0,
        )
        if not with_new_trials:
            self.run_state.clean_trials = verification.clean_trials
        return verification

    def prepare_predictor(self, u: Tensor, coordinates: Tensor, n_images: int) -> None:
        """Prepare a predictor of trials, if one is cheaper than rendering them.

        The trials vary some coordinates of a configuration. If a method can follow
        these, accurately enough and at less cost than rendering, the state gets it as
        `predictor`. Else the state gets the reason as `predictor_refusal`, unless the
        method is for other coordinates. The number of samples is known by then.

        Args:
            u: (d,) the configuration.
            coordinates: (k,) indices of the coordinates that vary.
            n_images: about how many trials there are.
        """
        state = self.run_state
        state.predictor = None
        for method in make_methods():
            refusal = method.find_trials_refusal(
                self.problem, coordinates, state.spp, n_images
            )
            if refusal is None:
                predictor = method.make_trials(self.problem, u, coordinates)
                refusal = self._prepare_trials(predictor)
            if refusal is None:
                state.predictor = predictor
                state.predictor_refusal = None
                return
            if refusal.cause is not RefusalCause.NOTHING_MOVES:
                state.predictor_refusal = refusal

    def _prepare_trials(self, predictor: PredictedSearch) -> Refusal | None:
        """Prepare a predictor of trials; return why it is too inaccurate, if it is."""
        stages = self.progress_stages
        hint = "`specialise=false` leaves it out"
        stages.begin("transport", predictor.title, predictor.preparation_spp, hint=hint)
        # It compares predicted images with traced ones, and may refuse.
        predictor.prepare(stages.progress.advance)
        return predictor.accuracy_refusal

    def try_configurations(
        self,
        kind: str,
        configurations: Mapping[int, Tensor],
        *,
        has_success: bool = True,
        predictor: PredictedSearch | None = None,
    ) -> Iterator[Judgement]:
        """Try configurations (d,) once each, every one with its own seed.

        Args:
            kind: kind of the rows, such as "average".
            configurations: configurations by their index among those of the kind.
            has_success: whether rows state if the trial is a success.
            predictor: predicts images in place of renders; None to render all.
        """
        queries = [
            self._make_trial_query(kind, number, u, has_success=has_success)
            for number, u in configurations.items()
        ]
        for evaluation in self.evaluate_all(queries, predictor=predictor):
            yield evaluation.required_judgement

    def _make_trial_query(
        self, kind: str, number: int, u: Tensor, *, has_success: bool
    ) -> Query:
        """Return the query of a single trial of a configuration (d,).

        The row of the trial states the values of the configuration, unless it has many:
        the texels of a texture would fill the store.
        """
        problem = self.problem
        seed = seeds.derive_seed(problem.seed, kind, number)
        values: dict[str, Any] = {}
        if problem.domain.dim <= MAX_DESCRIBED_COORDINATES:
            # values may depend on the conditions, which follow from the seed
            values = problem.describe(u, seed)
        spp = self.run_state.spp
        return Query(
            u, seed, kind, number, spp=spp, values=values, has_success=has_success
        )

    def try_in_batches(
        self,
        kind: str,
        count: int,
        find_configuration: Callable[[int], Tensor],
        *,
        has_success: bool = True,
        predictor: PredictedSearch | None = None,
    ) -> Iterator[Judgement]:
        """Try `count` configurations of a kind, in batches that fit into memory.

        Args:
            kind: kind of the rows, such as "average".
            count: number of configurations.
            find_configuration: returns the configuration (d,) with a number, from 0.
            has_success: whether rows state if the trial is a success.
            predictor: predicts images in place of renders; None to render all.
        """
        batch_size = max_batch_size(self.problem.domain.dim)
        for numbers in split_into_batches(0, count, batch_size):
            configurations = {number: find_configuration(number) for number in numbers}
            yield from self.try_configurations(
                kind, configurations, has_success=has_success, predictor=predictor
            )

    def try_random(self, n_trials: int) -> None:
        """Try random configurations: how often is the model wrong on average?

        Each is sampled at random from the domain of the search.
        """
        problem = self.problem
        self.begin_stage(
            "trying random configurations", n_trials, name="average", flags="`average`"
        )

        def sample_configuration(number: int) -> Tensor:
            """Return the random configuration (d,) with a number."""
            generator = torch.Generator().manual_seed(
                seeds.derive_seed(problem.seed, "draw", number)
            )
            return problem.domain.sample(generator)[0]

        trials = self.try_in_batches("average", n_trials, sample_configuration)
        self.run_state.random_trials = tuple(trials)

    def begin_stage(
        self,
        title: str,
        n_trials: int,
        *,
        name: str = "verification",
        flags: str = "`trials` or `verify_spp`",
        at_most: bool = False,
    ) -> None:
        """Begin a stage of the progress that renders trials.

        Args:
            title: title for the progress bar.
            n_trials: how many there will be.
            name: name of the stage.
            flags: settings that shorten it, for the hint.
            at_most: whether there may be fewer.
        """
        bound = "at most " if at_most else ""
        samples = plural(self.run_state.spp, "sample")
        hint = f"{bound}{n_trials} pictures of {samples} a pixel; {flags} shorten it"
        self.progress_stages.begin(name, title, n_trials, hint=hint, at_most=at_most)


@dataclass(frozen=True, eq=False)
class RetrialCondition:
    """A condition under which configurations are tried again.

    Attributes:
        name: name of the condition.
        problem: judges its images.
        spp: samples per pixel.
        image_key: key of the rendered image. Conditions with equal keys share the image
            of a trial, (H, W, 3) sRGB in [0, 1].
        change_image: function from the rendered image and the seed of the trial to the
            image that the model gets, such as a compression; None to use the rendered
            image.
        radiance_key: key of the linear radiance. Conditions with equal keys share the
            radiance of a trial, because only their tone curves or models differ. None
            for a condition that shares none.
    """

    name: str
    problem: Problem
    spp: int
    image_key: Hashable
    change_image: Callable[[Tensor, int], Tensor] | None = None
    radiance_key: Hashable = None


class Retrials:
    """Tries the clean scene and adversarial ones again, under other conditions.

    Trials that the run has stored are read. Trial k has the same seed for all
    conditions.

    Images and radiances that several conditions need are cached, for trials of one kind
    at a time.
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
        """Make a journal for each condition; all of them share one store.

        Args:
            conditions: conditions under which configurations are tried again.
            run: run whose store has the rows.
            progress: progress, which counts the trials.
            trials: number of trials of a configuration under a condition.
            seed: root of the trials' seeds; nothing else uses it.
            executor: workers that have the problems by the names of their conditions;
                None to render in this process.
        """
        self._progress = progress
        self._n_trials = trials
        self._seed = seed
        self._journals = _make_journals(conditions, run, executor)
        # clean trials by the name of their condition
        self._clean: dict[str, tuple[Judgement, ...]] = {}
        # Cached images and radiances. A key is (`image_key` or `radiance_key`, seed,
        # samples per pixel).
        self._images: dict[tuple[Hashable, int, int], Tensor] = {}
        self._radiances: dict[tuple[Hashable, int, int], Tensor] = {}
        # kind of the trials whose images and radiances are cached
        self._cached_kind = ""
        # Number of conditions by `radiance_key`. If there are several, they share the
        # radiance.
        self._n_conditions_of_radiance = Counter(
            condition.radiance_key
            for condition in conditions
            if condition.radiance_key is not None
        )

    def run_clean_trials(self, condition: RetrialCondition) -> tuple[Judgement, ...]:
        """Return the trials of the clean scene under a condition."""
        if condition.name not in self._clean:
            self._clean[condition.name] = run_trials(
                partial(self._evaluate_trials, "clean", condition),
                condition.problem.domain.start,
                spp=condition.spp,
                seed=self._seed,
                trials=self._n_trials,
                kind=f"clean under {condition.name}",
            )
        return self._clean[condition.name]

    def try_adversarial(
        self, kind: str, u: Tensor, condition: RetrialCondition
    ) -> Verification:
        """Try a configuration under one condition, compared with the clean scene.

        The search was run under other conditions, so that it claims nothing about this
        one. So NOT_VERIFIED stands for the ending of the search, and only success rates
        are compared. The rows have the kind "KIND under CONDITION".

        Args:
            kind: kind of the trials, such as "verification".
            u: (d,) the configuration.
            condition: condition under which it is tried.
        """
        return verify(
            partial(self._evaluate_trials, kind, condition),
            condition.problem.domain,
            u,
            claim=Ending.NOT_VERIFIED,
            spp=condition.spp,
            seed=self._seed,
            trials=self._n_trials,
            clean=self.run_clean_trials(condition),
            rule=condition.problem.verification_rule,
            kind=f"{kind} under {condition.name}",
        )

    def _evaluate_trials(
        self, kind: str, condition: RetrialCondition, queries: Sequence[Query]
    ) -> Iterator[Evaluation]:
        """Evaluate trials in order, or read them from the store.

        Args:
            kind: "clean", or the kind of the adversarial configuration; images are
                shared among conditions for trials of one kind.
            condition: condition of the trials.
            queries: the trials.
        """
        evaluate = partial(self._evaluate_new, kind, condition)
        journal = self._journals[condition.name]
        for evaluation in journal.evaluate_all(queries, evaluate):
            self._progress.advance(1)
            yield evaluation

    def _evaluate_new(
        self, kind: str, condition: RetrialCondition, queries: Sequence[Query]
    ) -> Iterator[Evaluation]:
        """Evaluate trials that are not stored, under one condition.

        Rendered images are cached before the condition changes them (`change_image`),
        since other conditions, such as another compression, may need the same ones. The
        cache is emptied when trials of another kind begin. Missing images are rendered
        by workers if there are any, and one by one in this process otherwise.

        Args:
            kind: kind of the trials, for which images are cached.
            condition: condition of the trials.
            queries: the trials; each has another seed, and so another image.
        """
        self._begin_kind(kind)
        # In the cache of one kind, a seed belongs to one configuration.
        keys = [(condition.image_key, query.seed, condition.spp) for query in queries]
        missing = [
            replace(query, requested_output="picture")
            for query, key in zip(queries, keys, strict=True)
            if key not in self._images
        ]
        # The loop below takes the next one for each missing image, in the same order.
        from_workers = self._render_on_workers(condition, missing)
        for query, key in zip(queries, keys, strict=True):
            # name of the worker's machine, if one rendered the image
            machine: str | None = None
            if key not in self._images:
                rendered = next(from_workers, None)
                self._images[key], machine = self._find_image(
                    condition, query, rendered
                )
            # with the change of the image that belongs to the condition
            judgement = self._judge_changed(condition, self._images[key], query)
            yield Evaluation.from_judgement(judgement, machine=machine)

    def _begin_kind(self, kind: str) -> None:
        """Empty the caches if they have images and radiances of another kind."""
        if kind != self._cached_kind:
            self._images.clear()
            self._radiances.clear()
            self._cached_kind = kind

    def _find_image(
        self, condition: RetrialCondition, query: Query, rendered: Evaluation | None
    ) -> tuple[Tensor, str | None]:
        """Return the image (H, W, 3) of a trial, and the worker's machine.

        It is rendered here, without a machine, if no worker has `rendered` it.
        """
        if rendered is None or rendered.picture is None:
            return self._render(condition, query.u, query.seed), None
        return rendered.picture, rendered.machine

    @staticmethod
    def _judge_changed(
        condition: RetrialCondition, image: Tensor, query: Query
    ) -> Judgement:
        """Judge a rendered image (H, W, 3) after the change of a condition."""
        if condition.change_image is not None:
            image = condition.change_image(image, query.seed)
        full_u = condition.problem.make_full_configuration(query.u, query.seed)
        return condition.problem.judge(round_to_8_bit(image), full_u)

    def _render_on_workers(
        self, condition: RetrialCondition, queries: Sequence[Query]
    ) -> Iterator[Evaluation]:
        """Return an iterator over images of queries, rendered by workers.

        It is empty if the caller has to render the images in this process. That is the
        case without workers, and for a single query, whose radiance may be cached here
        for other conditions (`_render`).

        Args:
            condition: condition of the trials.
            queries: queries for images that are not cached.
        """
        evaluator = self._journals[condition.name].evaluator
        if evaluator.workers is not None and len(queries) > 1:
            return iter(evaluator(queries))
        return iter(())

    def _render(self, condition: RetrialCondition, u: Tensor, seed: int) -> Tensor:
        """Return the image (H, W, 3) of a configuration under a condition.

        If several conditions have the same radiance, it is cached. They differ only in
        how the image is formed from it.

        Args:
            condition: the condition.
            u: (d,) the searched coordinates.
            seed: seed of the noise and of random conditions.
        """
        problem = condition.problem
        # 0 if the key is None, as these are not counted
        n_conditions = self._n_conditions_of_radiance[condition.radiance_key]
        is_radiance_shared = n_conditions >= 2
        if not is_radiance_shared:
            return problem.picture(u, seed, condition.spp)
        full_u = problem.make_full_configuration(u, seed)
        with torch.no_grad():
            radiance = self._find_shared_radiance(condition, full_u, seed)
            # the same two steps by which `problem.picture` forms an image
            displayed = problem.renderer.formation.map_to_display(radiance)
            image = problem.renderer.space.apply_to_image(full_u, displayed)
            return round_to_8_bit(image)

    def _find_shared_radiance(
        self, condition: RetrialCondition, full_u: Tensor, seed: int
    ) -> Tensor:
        """Return the radiance (H, W, 3) of a full configuration, rendered only once."""
        key = (condition.radiance_key, seed, condition.spp)
        if key not in self._radiances:
            renderer = condition.problem.renderer
            self._radiances[key] = renderer.radiance(full_u, seed, condition.spp)
        return self._radiances[key]


def _make_journals(
    conditions: Sequence[RetrialCondition],
    run: RunDirectory,
    executor: Workers | None,
) -> dict[str, Journal]:
    """Return a journal for each condition, by its name; all of them share one store.

    All journals are copies of one, so that rows and notes are read from the store only
    once. Its own evaluator is replaced in all of them.
    """
    template_journal = Journal(run, ParallelEvaluator(conditions[0].problem))
    journals = {}
    for condition in conditions:
        evaluator = ParallelEvaluator(condition.problem, executor, condition.name)
        journals[condition.name] = replace(template_journal, evaluator=evaluator)
    return journals


def read_stored_configuration(directory: Path, problem: Problem) -> torch.Tensor:
    """Return the configuration (d,) that a run directory has stored.

    Args:
        directory: the run directory.
        problem: problem of the current scene, to whose domain it must fit.

    Raises:
        InputError: the scene has another number of coordinates now.
    """
    u = torch.from_numpy(read_configuration(directory))
    if u.shape != problem.domain.start.shape:
        raise InputError(
            f"{directory}: its configuration has {len(u)} numbers, and its scene has "
            f"{problem.domain.dim} now: the "
            "object or advsearch has changed since; do the run again"
        )
    return u
