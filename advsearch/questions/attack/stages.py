"""The stages of an attack, in the order of `advsearch.questions.attack.run`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

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
    count_planned_renders,
    count_right,
    run_trials,
    search,
)
from advsearch.attacks.candidates import (
    MAX_CHECKS,
    MAX_CONFIRMATIONS,
    MAX_SEARCHES,
    Bracket,
    confirm_bracket,
    find_smallest_change,
)
from advsearch.attacks.evaluation import Query
from advsearch.engine.crop import CroppedSearch
from advsearch.engine.gradients import planning
from advsearch.engine.gradients.bench import Bench, find_interior_point
from advsearch.engine.journal import PLAN_NOTE, Journal
from advsearch.engine.judging import subtract_print_penalty
from advsearch.engine.prediction import (
    CleanMatrix,
    PredictedSearch,
    PredictionMethod,
    find_general_refusal,
    make_methods,
)
from advsearch.engine.problem import Problem
from advsearch.engine.record import RunState
from advsearch.engine.transport import (
    Transport,
    find_matrix_refusal,
    make_rendering_remark,
)
from advsearch.engine.verifier import Verifier
from advsearch.engine.windows import find_crop_refusal
from advsearch.progress import Stages
from advsearch.questions.attack.ambient import find_ambient
from advsearch.report.wording import format_count
from advsearch.scene.predictor import Refusal, RefusalCause
from advsearch.scene.transport.matrix import TransportTooLargeError
from advsearch.tasks import Judgement

# Causes of refusals which would not help the user: another method is the right one.
UNHELPFUL_CAUSES = (RefusalCause.NOTHING_MOVES, RefusalCause.NO_CAMERA)
MAX_FRAMES = 60  # frames in the animation of a search
N_RANKED = 4  # best configurations of a search that are rendered again
UNPRINTED = "search without print terms"
"""Kind of the queries of the search without print terms. Print terms keep colors
printable; what they cost is measured by a search without them.
"""
N_FIRST_LOOKS = 4
"""Renders of the clean configuration before the search. If the model is wrong in all of
them, the configuration goes through the full trials before anything is searched.
"""

Measure = Literal["no", "quick", "full"]
"""Which gradient estimators are measured before a search: none, the contested ones, or
all, with step and samples.
"""


def plan_renders(
    policy: Policy[Any],
    journal: Journal,
    stages: Stages,
    *,
    specialise: bool,
    measure: Measure,
    deterministic: bool,
    chooses_spp: bool,
) -> None:
    """Choose light bounces, gradient estimators and samples of a search by measurement.

    The choice is set in the journal's problem and stored, so that a run that is
    continued uses the same. Bounces are measured only if no method that always has all
    bounces may predict the images of the search. Gradient estimators are measured if
    matrices of light transport cannot, or if a full measurement is requested.

    Args:
        policy: policy of the search. Gradients are measured only if it uses them.
        journal: journal of the run.
        stages: reports what is measured.
        specialise: whether renders may leave out what the search does not need.
        measure: which gradient estimators are measured.
        deterministic: whether counted renders, and not measured times, decide which
            estimator is best.
        chooses_spp: whether a full measurement may choose the samples per pixel.
    """
    problem = journal.problem
    stored = journal.get_note(PLAN_NOTE)
    if stored is not None:  # of a run that is continued
        _restore_choice(problem, stored)
        return
    is_full = measure == "full"
    if specialise and _pays_to_measure_bounces(problem, policy, is_full=is_full):
        _choose_bounces(problem, stages)
    if policy.uses_gradient and _pays_to_measure_gradients(
        problem, measure, specialise=specialise
    ):
        _measure_gradients(
            problem,
            stages,
            full=is_full,
            deterministic=deterministic,
            chooses_spp=chooses_spp,
        )
    _store_choice(journal)


def _store_choice(journal: Journal) -> None:
    """Store the plan, the samples and the light bounces of a problem in its run."""
    problem = journal.problem
    choice = {
        "plan": problem.gradient_plan.to_dict(),
        "spp": problem.search_spp,
        "search_depth": problem.search_depth,
    }
    journal.set_note(PLAN_NOTE, choice)


def _restore_choice(problem: Problem, stored: Mapping[str, Any]) -> None:
    """Set the plan, the samples and the light bounces that a run has stored."""
    problem.gradient_plan = problem.gradient_plan.restore(stored["plan"])
    problem.search_spp = stored["spp"]
    problem.search_depth = stored["search_depth"]


def _pays_to_measure_bounces(
    problem: Problem, policy: Policy[Any], *, is_full: bool
) -> bool:
    """Return whether to measure how many light bounces a search needs.

    Args:
        problem: problem of the attack, whose renders may leave out bounces.
        policy: policy of the search.
        is_full: whether a full measurement is requested.
    """
    # for few renders the measurement would cost more than it saves
    has_enough_renders = problem.steps >= planning.MIN_RENDERS_FOR_BOUNCES
    if not (is_full or has_enough_renders):
        return False
    if problem.renderer.composition_reason:  # then nothing predicts the images
        return True
    # If a method that always has all bounces may predict the images, then none are left
    # out.
    methods = [method for method in make_methods() if not method.follows_bounces]
    return all(
        method.find_search_refusal(problem, problem.steps, policy) is not None
        for method in methods
    )


def _pays_to_measure_gradients(
    problem: Problem, measure: Measure, *, specialise: bool
) -> bool:
    """Return whether to measure which gradient estimators are best for a search.

    A quick measurement is left out if matrices of light transport predict the images:
    then no gradient is rendered.

    Args:
        problem: problem of the attack.
        measure: which gradient estimators are to be measured.
        specialise: whether images may be predicted.
    """
    if measure == "no":
        return False
    matrix_refusal = find_matrix_refusal(problem, problem.steps, specialise)
    can_matrices_predict = matrix_refusal is None
    return measure == "full" or not can_matrices_predict


def _choose_bounces(problem: Problem, stages: Stages) -> None:
    """Choose how many bounces of light the search renders.

    Fewer bounces are faster to render. The choice is stored in the problem; the
    verification always renders all bounces.
    """
    stages.begin(
        "setup",
        "finding how many bounces of light the search needs",
        planning.count_bounce_images(problem),
        hint="few samples each; `specialise=false` leaves it out",
        at_most=True,
    )
    tick = stages.progress.advance
    path_length = planning.measure_problem_bounces(problem, problem.seed, tick=tick)
    problem.search_depth = path_length.depth


def _measure_gradients(
    problem: Problem,
    stages: Stages,
    *,
    full: bool,
    deterministic: bool,
    chooses_spp: bool,
) -> None:
    """Choose the gradient estimators of a search by measurement, for its plan.

    Args:
        problem: gets the plan, and perhaps another number of samples.
        stages: reports what is measured.
        full: whether all estimators are measured, and then steps and samples. Else only
            controls for which two or more estimators may be the best are measured.
        deterministic: whether counted renders, and not measured times, decide which
            estimator is best.
        chooses_spp: whether a full measurement may choose the samples per pixel.
    """
    # A quick measurement is too short to measure times: it counts renders.
    counts_renders = not full or deterministic
    bench = _make_loss_bench(problem, stages)
    _begin_measuring_gradients(problem, stages, with_all=full)
    problem.gradient_plan = planning.choose_estimators(
        bench, with_all=full, count_renders=counts_renders
    )
    if full:
        spp = _choose_gradient_steps(problem, bench, stages)
        if chooses_spp and spp is not None:
            problem.search_spp = spp


def _begin_measuring_gradients(
    problem: Problem, stages: Stages, *, with_all: bool
) -> None:
    """Begin the stage in which gradient estimators are measured, if any are.

    Args:
        problem: problem of the attack.
        stages: stages of the run.
        with_all: whether all estimators are measured, and not only contested ones.
    """
    n_gradients = planning.count_plan_gradients(
        problem.renderer.plan, with_all=with_all
    )
    if n_gradients:
        samples = format_count(problem.search_spp, "sample")
        hint = (
            f"{n_gradients} gradients of {samples} a pixel; `measure=no` leaves it out"
        )
        title = "measuring which gradients are best here"
        stages.begin("setup", title, n_gradients, hint=hint)


def _make_loss_bench(problem: Problem, stages: Stages) -> Bench:
    """Return what measures gradients of a problem's loss, and reports each."""
    return Bench(
        renderer=problem.renderer,
        loss=problem.compute_loss,
        u=find_interior_point(problem.renderer),
        seed=seeds.derive_seed(problem.seed, "measure"),
        spp=problem.search_spp,
        tick=lambda samples: stages.progress.advance(1),
    )


def _choose_gradient_steps(
    problem: Problem, bench: Bench, stages: Stages
) -> int | None:
    """Choose the steps of finite differences by measurement, for the problem's plan.

    Args:
        problem: problem whose plan gets the steps.
        bench: measures gradients of the problem's loss.
        stages: reports what is measured.

    Returns:
        The samples per pixel that suffice for gradients; None if that is not known.
    """
    # Gradients of several steps and sample counts are compared by their cosine with a
    # reference. Progress is counted in samples, since the sample counts differ.
    samples = planning.count_cosine_samples(problem.gradient_plan)
    title = "choosing step and samples of gradients"
    hint = "counted in samples a pixel; `measure=quick` leaves it out"
    stages.begin("setup", title, samples, hint=hint, at_most=True)
    cosine_bench = replace(bench, tick=stages.progress.advance)
    table = list(planning.measure_cosines(cosine_bench))
    problem.gradient_plan, spp = planning.choose_steps(problem.gradient_plan, table)
    return spp


def evaluate_clean_scene(
    journal: Journal, stages: Stages, spp: int
) -> tuple[Judgement, ...]:
    """Render the clean configuration `N_FIRST_LOOKS` times, and evaluate the images.

    Args:
        journal: journal of the run.
        stages: reports the progress.
        spp: samples per pixel.
    """
    problem = journal.problem
    seed = seeds.derive_seed(problem.seed, "first look")
    start = problem.domain.start
    hint = "the first picture compiles the renderer's code"
    stages.begin("setup", "looking at the clean scene", N_FIRST_LOOKS, hint=hint)

    def evaluate_all(queries: Sequence[Query]) -> Iterator[Evaluation]:
        """Evaluate queries one after another, and report each."""
        for query in queries:
            evaluation = problem.evaluate(query)
            stages.progress.advance(1)
            yield evaluation

    return run_trials(evaluate_all, start, spp=spp, seed=seed, trials=N_FIRST_LOOKS)


def is_already_wrong(verifier: Verifier, *, in_any_case: bool) -> bool:
    """Return whether the clean scene is wrong, so that there is nothing to search for.

    The full trials of the clean scene decide. They are made only if the model was wrong
    in every one of the first renders, or with `in_any_case`. If the rule of success does
    not compare with the clean scene, a wrong clean scene is no reason to stop.

    Args:
        verifier: verifier of the attack, whose state has the first renders.
        in_any_case: whether the trials are made even if the model was right once.
    """
    problem = verifier.problem
    findings = verifier.run_state
    compares_with_clean = problem.verification_rule.has_control
    if not compares_with_clean:
        return False
    was_right_once = any(trial.right for trial in findings.first_look_trials)
    if was_right_once and not in_any_case:
        return False
    _try_clean_scene(verifier)
    counts = count_right(findings.clean_trials, findings.spp)
    return problem.verification_rule.is_already_wrong(counts)


def _try_clean_scene(verifier: Verifier) -> None:
    """Choose the samples per pixel for the clean scene, and make its trials."""
    verifier.choose_spp({"clean": verifier.problem.domain.start})
    # trials after which a verdict is first possible
    min_trials = verifier.look_sizes[0]
    verifier.begin_stage("checking the clean scene with fresh renders", min_trials)
    verifier.run_clean_trials()


def choose_predictor(
    policy: Policy[Any],
    journal: Journal,
    stages: Stages,
    findings: RunState,
    *,
    specialise: bool,
    clean: CleanMatrix,
) -> PredictedSearch | None:
    """Prepare and return the cheapest predictor that is accurate here.

    A predictor replaces renders by something faster, such as a matrix of light
    transport. Predictors are tried in turn, the cheapest first. If one is too
    inaccurate, the next one is tried. If one takes too much memory, no other one is
    tried. A refusal is the reason why a predictor is not used, or None if it may be
    used. Refusals are stored in `findings` and reported.

    Args:
        policy: policy of the search.
        journal: journal of the run.
        stages: reports the preparation.
        findings: findings of the attack.
        specialise: whether images may be predicted.
        clean: the matrix of light transport of the clean scene, which attacks may share.

    Returns:
        The predictor, perhaps one that renders only a part of each image; None if every
        step is rendered in full.
    """
    problem = journal.problem
    refusal = find_general_refusal(problem, specialise)
    if refusal is not None and not specialise:  # renders are not cropped either
        _report_rendering(refusal, stages, findings)
        return None
    if refusal is None:
        refusals = [
            (method, method.find_search_refusal(problem, problem.steps, policy))
            for method in make_methods()
        ]
        candidates = [method for method, refusal in refusals if refusal is None]
        tried = _try_methods(candidates, journal, stages, findings, clean)
        if isinstance(tried, PredictedSearch):
            return tried
        refusal = tried or _choose_refusal(problem, refusals)
    return _crop_search(problem, refusal, stages, findings)


def _try_methods(
    methods: Sequence[PredictionMethod],
    journal: Journal,
    stages: Stages,
    findings: RunState,
    clean: CleanMatrix,
) -> PredictedSearch | Refusal | None:
    """Prepare predictors in turn until one is accurate, or takes too much memory.

    See `choose_predictor` for the other arguments.

    Args:
        methods: methods that may predict the images, the cheapest first.

    Returns:
        The accurate predictor; else why the last one that was tried is not used. None
        without methods.
    """
    refusal = None
    for index, method in enumerate(methods):
        predictor = method.make_search(
            journal.problem,
            journal.problem.steps,
            collect_light=journal.evaluator,
            clean_matrix=clean,
        )
        refusal = _prepare(predictor, stages)
        if refusal is None:
            return predictor
        if refusal.cause is RefusalCause.TOO_LARGE:
            return refusal
        findings.inaccuracy_refusal = refusal
        _report_inaccuracy(refusal, stages, methods[index + 1 :])
    return refusal


def _report_inaccuracy(
    refusal: Refusal, stages: Stages, next_methods: Sequence[PredictionMethod]
) -> None:
    """Report that a predictor is too inaccurate, and what replaces it."""
    instead = next_methods[0].pictures_are if next_methods else "rendered"
    stages.progress.message(f"Pictures are {instead}: {refusal}.")


def _choose_refusal(
    problem: Problem, refusals: Sequence[tuple[PredictionMethod, Refusal | None]]
) -> Refusal:
    """Return the refusal to report if no method could be tried.

    Only one reason is reported: that of matrices, or that of another method. The user
    can act on the refusal of matrices if they need only more steps. If no camera moves,
    light on surfaces would not help anyway.

    Args:
        problem: problem of the attack.
        refusals: every method, and why it does not predict the images.
    """
    matrix_refusal = find_matrix_refusal(problem, problem.steps, specialise=True)
    if matrix_refusal is None:
        # A matrix could predict each condition, and a predictor that does is missing.
        matrix_refusal = Refusal("no predictor for conditions that vary is installed")
    if find_matrix_refusal(problem, steps=None, specialise=True) is None:
        return matrix_refusal
    for _method, refusal in refusals:
        if refusal is None or refusal.cause in UNHELPFUL_CAUSES:
            continue
        if refusal != matrix_refusal:  # that of a bank of matrices is the same
            return refusal
    return matrix_refusal


def _crop_search(
    problem: Problem, refusal: Refusal, stages: Stages, findings: RunState
) -> PredictedSearch | None:
    """Prepare a search that renders only the part of each image that can change.

    Args:
        problem: problem of the attack.
        refusal: why nothing predicts the images. It is always stored, and it is
            reported if full images are rendered.
        stages: reports the preparation.
        findings: gets the refusals.

    Returns:
        The prepared crop; None if full images are rendered.
    """
    can_be_cropped = find_crop_refusal(problem) is None
    if can_be_cropped:
        crop = CroppedSearch(problem, problem.steps)
        findings.crop_refusal = _prepare(crop, stages)
        if findings.crop_refusal is None:
            findings.predictor_refusal = refusal
            return crop
    _report_rendering(refusal, stages, findings)
    return None


def _prepare(predictor: PredictedSearch, stages: Stages) -> Refusal | None:
    """Prepare a predictor, and return why it cannot be used; None if it can.

    Args:
        predictor: what predicts the images of a search, or renders parts of them.
        stages: reports the preparation.
    """
    hint = (
        f"from here on the search {predictor.what_it_renders} (counted in samples a "
        "pixel); `specialise=false` leaves it out"
    )
    stages.begin("transport", predictor.title, predictor.preparation_spp, hint=hint)
    try:
        predictor.prepare(stages.progress.advance)
    except TransportTooLargeError as error:
        return Refusal(str(error), RefusalCause.TOO_LARGE)
    return predictor.accuracy_refusal


def _report_rendering(refusal: Refusal, stages: Stages, findings: RunState) -> None:
    """Report and store why images are rendered."""
    findings.predictor_refusal = refusal
    text = make_rendering_remark(refusal)
    if text:
        stages.progress.message(text)


@dataclass
class Searches:
    """Makes the searches of one attack, with predicted images or rendered ones.

    Attributes:
        journal: replays stored evaluations, and stores the others.
        stages: reports the progress.
        run_state: findings so far; their `predictor` predicts images.
        printable: whether objectives include print terms.
        max_extra_repeats: largest number of further renders of candidates that are close to
            the best.
    """

    journal: Journal
    stages: Stages
    run_state: RunState
    printable: bool = False
    max_extra_repeats: int = 0

    @property
    def problem(self) -> Problem:
        return self.journal.problem

    def begin_stage(self, name: str, title: str, steps: int, shorter: str) -> None:
        """Begin the stage of a search.

        Args:
            name: name of the stage.
            title: title for the progress.
            steps: steps of the search.
            shorter: sentence about the settings that shorten it.
        """
        n_renders = count_planned_renders(
            steps, max_extra_repeats=self.max_extra_repeats
        )
        samples = format_count(self.problem.search_spp, "sample")
        hint = f"{n_renders} pictures of {samples} a pixel; {shorter}"
        if self._is_predicted(steps):
            # A search ends with a ranking of the best configurations, always rendered.
            n_rendered = n_renders - steps
            hint = f"{steps} pictures predicted and {n_rendered} traced; {shorter}"
        self.stages.begin(name, title, n_renders, hint=hint, at_most=True)

    def _is_predicted(self, steps: int) -> bool:
        """Return whether images of a search of some steps are predicted.

        It is assumed that every search is predicted if the main one, "search", is.
        """
        predictor = self.run_state.predictor
        return predictor is not None and bool(
            predictor.count_predicted("search", steps)
        )

    def _mark_domain(self, domain: Domain, policy: Policy[Any]) -> Domain:
        """Return the domain, marked with what its evaluations are like.

        `is_noise_free` means that evaluations have no noise; rendered ones always have
        some. `draws_conditions` means that the predictor samples the conditions of an
        evaluation by itself, which it does for policies that use gradients.

        Args:
            domain: domain to search.
            policy: policy that searches it.
        """
        predictor = self.run_state.predictor
        if predictor is None:
            return replace(domain, is_noise_free=False, draws_conditions=False)
        return replace(
            domain,
            is_noise_free=predictor.is_exact,
            draws_conditions=predictor.draws_conditions and policy.uses_gradient,
        )

    def run_search(
        self,
        kind: str,
        policy: Policy[Any],
        steps: int,
        seed: int,
        *,
        frames: list[Any] | None = None,
        seconds: float | None = None,
        domain: Domain | None = None,
        ranked: bool = True,
    ) -> SearchResult:
        """Search with one policy; stored evaluations are read instead of made again.

        Args:
            kind: kind of the search, such as "search" or "baseline", under which its
                evaluations are stored as rows.
            policy: proposes configurations.
            steps: number of evaluations.
            seed: seed of the policy; renders have the seed of the problem.
            frames: list to fill with images of the search, (H, W, 3) in [0, 1] rounded
                to 8 bits, at most `MAX_FRAMES` and evenly spaced; None for none.
            seconds: seconds that the search may take; None for no limit.
            domain: domain to search; None for that of the problem.
            ranked: whether the best configurations are rendered again.

        Raises:
            KeyboardInterrupt: the search was interrupted. If it was the first search,
                its result so far is stored in `run_state.search_result`.
        """
        result = search(
            self._make_evaluate(steps, has_frames=frames is not None),
            self._mark_domain(domain or self.problem.domain, policy),
            policy,
            steps=steps,
            seed=seed,
            candidates=N_RANKED if ranked else 0,
            max_extra_repeats=self.max_extra_repeats,
            is_out_of_time=self.journal.make_time_check(kind, seconds),
            on_step=self._make_step_report(frames),
            kind=kind,
            render_seed=self.problem.seed,
        )
        self._check_not_interrupted(result)
        return result

    def _check_not_interrupted(self, result: SearchResult) -> None:
        """Raise `KeyboardInterrupt` if a search was interrupted, and store its result.

        The first search is the main one. The result of a later search that was
        interrupted is dropped.
        """
        if result.ending is not Ending.INTERRUPTED:
            return
        if self.run_state.search_result is None:
            self.run_state.search_result = result
        raise KeyboardInterrupt

    def _make_evaluate(
        self, steps: int, *, has_frames: bool
    ) -> Callable[[Sequence[Query]], Iterator[Evaluation]]:
        """Return the function that evaluates the queries of a search.

        Evaluations that the journal has stored are replayed instead of made again.

        Args:
            steps: steps of the search.
            has_frames: whether evaluations have an image at most `MAX_FRAMES` times, in
                evenly spaced steps.
        """
        frame_interval = max(1, math.ceil(steps / MAX_FRAMES))
        predictor = self.run_state.predictor

        def evaluate(queries: Sequence[Query]) -> Iterator[Evaluation]:
            """Evaluate queries, or replay what is stored of them."""
            if has_frames:
                queries = [_request_frame(query, frame_interval) for query in queries]
            on_replay = _ignore_replay if predictor is None else predictor.replay
            return self.journal.evaluate_all(queries, self._evaluate, on_replay)

        return evaluate

    def _make_step_report(
        self, frames: list[Any] | None
    ) -> Callable[[StepRecord, Tensor, Evaluation], None]:
        """Return the function that reports each step of a search.

        Args:
            frames: gets the images of steps that have one; None to drop them.
        """
        renders_before = 0

        def report_step(record: StepRecord, u: Tensor, evaluation: Evaluation) -> None:
            """Store the image of a step, if it has one, and report its renders."""
            nonlocal renders_before
            if evaluation.picture is not None and frames is not None:
                frames.append(evaluation.picture.numpy())
            new_renders = record.renders - renders_before
            self.stages.progress.advance(
                new_renders, best=record.best, **self.journal.evaluator.progress_stats
            )
            renders_before = record.renders

        return report_step

    def _evaluate(self, queries: Sequence[Query]) -> Iterator[Evaluation]:
        """Evaluate queries with predicted or rendered images.

        If there is a predictor, it evaluates the steps of the search. The ranking at
        the end, which compares the best configurations, is rendered. If colors have to
        be printable, print terms are subtracted from the objective.

        Args:
            queries: queries of a single phase, "search" or "ranking".
        """
        evaluations = self._evaluate_objectives(queries)
        for query, evaluation in zip(queries, evaluations, strict=True):
            # `UNPRINTED` is the kind of the search that measures what the terms cost
            has_print_terms = self.printable and query.kind != UNPRINTED
            if has_print_terms:
                space = self.problem.searched_space
                evaluation = subtract_print_penalty(evaluation, space, query.u)
            yield evaluation

    def _evaluate_objectives(self, queries: Sequence[Query]) -> Iterator[Evaluation]:
        """Evaluate queries of a single phase, without print terms."""
        evaluate_rendered = self.journal.evaluator
        predictor = self.run_state.predictor
        if predictor is None or not queries:
            return evaluate_rendered(queries)
        if queries[0].phase == "ranking":
            return predictor.rank_all(queries, evaluate_rendered)
        # It renders, too: to check its predictions, and after it was given up.
        return predictor.evaluate_all(queries, evaluate_rendered)


def _request_frame(query: Query, interval: int) -> Query:
    """Return a query, with a request for an image if its step has a frame.

    Args:
        query: the query.
        interval: steps from one image to the next.
    """
    is_due = query.phase == "search" and query.row_index % interval == 0
    return replace(query, includes_image=is_due)


def _ignore_replay(query: Query) -> None:
    """Do nothing: rendering has no state that stored evaluations change."""


def _choose_verification_samples(
    verifier: Verifier, results: Sequence[SearchResult], adversarial: Tensor
) -> None:
    """Choose the samples per pixel of a verification, and store them in its state.

    Args:
        verifier: verifier of the attack.
        results: results of all searches. If conditions vary, the verification may not
            render more samples than they did.
        adversarial: (d,) the adversarial configuration.
    """
    problem = verifier.problem
    n_images = sum(
        (result.renders + result.gradients) * problem.conditions_per_evaluation
        for result in results
    )
    configurations = {"adversarial": adversarial, "clean": problem.domain.start}
    verifier.choose_spp(configurations, search_samples=n_images * problem.search_spp)


def verify_searches(verifier: Verifier, *, is_smallest: bool) -> None:
    """Verify with fresh seeds what the searches claim, paired with the clean scene.

    First the samples per pixel are chosen, so that more samples would not change the
    sign of the margin. A search of the smallest change keeps the count that was chosen
    for the clean scene: the margin of its result is near 0, so that noise decides its
    sign at any count.

    Then the clean configuration, the adversarial one, that of the search without print
    terms and that of the random search are tried with equal seeds. If the random search
    found something worse for the model, that becomes the adversarial configuration.
    Finally, different failures of the policy are verified. If the attack searches a
    projector's light, it is measured up to which ambient light it holds.

    Args:
        verifier: verifier of the attack, whose state gets the results.
        is_smallest: whether the smallest change was searched.
    """
    findings = verifier.run_state
    candidate = findings.search_result
    baseline = findings.random_search_result
    if candidate is None:
        raise RuntimeError("nothing was searched, so there is nothing to verify")
    results = _list_results(findings)
    keeps_sample_count = is_smallest and findings.sample_count is not None
    if not keeps_sample_count:
        adversarial = verifier.problem.domain.project(candidate.best_u)
        _choose_verification_samples(verifier, results, adversarial)
    _begin_verification(verifier, len(results))
    verifier.run_clean_trials()
    findings.verification = verifier.verify("verification", candidate)
    _drop_meaningless_bracket(findings)
    _verify_unprinted(verifier)
    if baseline is not None:
        _verify_baseline(verifier, candidate, baseline)
    if not is_smallest:
        verify_failures(verifier, candidate)
    # read again: `_verify_baseline` may have replaced it
    verification = findings.verification
    if verification.ending is Ending.FOUND:
        find_ambient(verifier, verification.u)


def _drop_meaningless_bracket(findings: RunState) -> None:
    """Drop the bounds of the smallest change if the clean scene is wrong already.

    The verification has another sample count than the search. If the model is wrong
    about the clean scene at this count, no change is needed, and the bounds mean
    nothing.
    """
    verification = findings.verification
    if verification is not None and verification.ending is Ending.ALREADY_WRONG:
        findings.smallest_change_bracket = None


def _list_results(findings: RunState) -> list[SearchResult]:
    """Return the results of the searches that were made."""
    results = (
        findings.search_result,
        findings.random_search_result,
        findings.result_without_print_terms,
    )
    return [result for result in results if result is not None]


def _begin_verification(verifier: Verifier, n_results: int) -> None:
    """Begin the stage in which the results of searches are verified.

    It has a group of trials for each configuration. Failures and ambient light have
    stages of their own.
    """
    n_groups = n_results
    if not verifier.has_clean_trials:
        n_groups += 1
    title = "checking what was found with fresh renders"
    verifier.begin_stage(title, n_groups * verifier.n_trials, at_most=True)


def _verify_unprinted(verifier: Verifier) -> None:
    """Verify the result of the search without print terms, if there was one."""
    findings = verifier.run_state
    unprinted = findings.result_without_print_terms
    if unprinted is not None:
        kind = "unprinted verification"
        findings.unprinted_verification = verifier.verify(kind, unprinted)


def _verify_baseline(
    verifier: Verifier, candidate: SearchResult, baseline: SearchResult
) -> None:
    """Verify the result of the random search, which may replace that of the policy.

    Args:
        verifier: verifier of the attack, whose state has the verification of the
            policy's result.
        candidate: result of the policy's search.
        baseline: result of the random search.
    """
    findings = verifier.run_state
    # Curtailed trials end as soon as the verdict is certain. If the policy's result is
    # verified, the exact rate of the random search's result is not needed.
    verification = findings.verification
    is_policy_verified = verification is not None and (
        verification.ending is Ending.FOUND
    )
    findings.baseline_verification = verifier.verify(
        "baseline verification", baseline, curtailed=is_policy_verified
    )
    _replace_if_random_is_worse(verifier, candidate, baseline)


def _replace_if_random_is_worse(
    verifier: Verifier, result: SearchResult, baseline: SearchResult
) -> None:
    """Replace the result of the policy by that of the random search if that is worse.

    "Worse" means worse for the model. The random search's configuration may have been
    lucky in its trials. So it is tried again, and has to be worse in the new trials,
    too.

    Args:
        verifier: verifier of the attack, whose state is changed.
        result: result of the policy's search.
        baseline: result of the random search.
    """
    findings = verifier.run_state
    policy_verification = findings.verification
    random_verification = findings.baseline_verification
    if policy_verification is None or random_verification is None:
        return
    is_found = random_verification.ending is Ending.FOUND
    if not is_found or _rank(random_verification) <= _rank(policy_verification):
        return
    # twice the trials: of the configuration, and of the clean scene with their seeds
    title = "checking what the random search found again"
    verifier.begin_stage(title, 2 * verifier.n_trials, at_most=True)
    random_verification = verifier.verify(
        "baseline verification", baseline, with_new_trials=True
    )
    findings.baseline_verification = random_verification
    if _rank(random_verification) > _rank(policy_verification):
        findings.outdone_verification = policy_verification
        findings.verification = random_verification
        findings.search_result = _merge_random_result(result, baseline)


def _merge_random_result(result: SearchResult, baseline: SearchResult) -> SearchResult:
    """Return what the random search found, with the policy's history and counts."""
    return replace(
        result,
        best_u=baseline.best_u,
        best_objective=baseline.best_objective,
        claimed_objective=baseline.claimed_objective,
        success_rate=baseline.success_rate,
        distribution=None,
    )


MIN_CONFIRMING_TRIALS = 40
"""Minimum number of trials that the smallest epsilon has to pass after the searches.

They are made in several checks, each with as many trials as a verification.
"""


def find_smallest(searches: Searches, policy: Policy[Any], verifier: Verifier) -> None:
    """Find bounds (a bracket) of the smallest epsilon at which the model is wrong.

    Smaller and smaller budgets are searched. A check tries a configuration that a
    search found; each check has new seeds. While the bracket gets smaller, a check ends
    early, after the minimum number of trials that can verify anything, if none of them
    fails. At the end, the configuration at the upper bound of the bracket is checked
    again with all trials; it is the result. The bracket and the result are stored in
    the findings.

    Args:
        searches: searches of the attack.
        policy: policy that searches.
        verifier: verifier that tries what was found.
    """
    problem = searches.problem
    findings = searches.run_state
    smallest_search = _SmallestSearch(searches, policy, verifier)
    transport = smallest_search.transport
    bracket = find_smallest_change(
        smallest_search.search_inside,
        smallest_search.passes_short_check,
        problem.domain,
        likely=None if transport is None else transport.is_likely_success,
    )
    bracket = _confirm(
        bracket, smallest_search.passes_full_check, verifier, problem.domain
    )
    findings.smallest_change_bracket = bracket
    findings.search_result = _combine_results(smallest_search.results, bracket)


@dataclass
class _SmallestSearch:
    """The searches and the checks by which the smallest change is found.

    Attributes:
        searches: searches of the attack.
        policy: policy that searches.
        verifier: verifier that tries what was found.
        results: results of the searches so far.
    """

    searches: Searches
    policy: Policy[Any]
    verifier: Verifier
    results: list[SearchResult] = field(default_factory=list)

    @property
    def transport(self) -> Transport | None:
        """The matrix of light transport that predicts the images; None without one.

        It predicts scores without noise. By them it estimates which configurations are
        likely to pass. The scores of trials correct its bias.
        """
        predictor = self.searches.run_state.predictor
        return predictor if isinstance(predictor, Transport) else None

    def search_inside(self, domain: Domain, number: int) -> Tensor:
        """Search a smaller domain, and return the best configuration (d,)."""
        findings = self.searches.run_state
        result = _search_budget(self.searches, self.policy, domain, number)
        self.results.append(result)
        # The first result is that of the attack until a configuration passes a check:
        # the attack may be interrupted before.
        if findings.search_result is None:
            findings.search_result = result
        n_trials = MAX_CHECKS * self.verifier.n_trials
        self.verifier.begin_stage("trying smaller changes", n_trials, at_most=True)
        return result.best_u

    def passes_short_check(self, u: Tensor, check_index: int) -> bool:
        """Return whether a configuration (d,) passes a check that may end early."""
        min_trials = self.searches.problem.verification_rule.min_trials
        return self._passes_check(u, check_index, min_trials)

    def passes_full_check(self, u: Tensor, check_index: int) -> bool:
        """Return whether a configuration (d,) passes a check with all trials."""
        return self._passes_check(u, check_index, self.verifier.n_trials)

    def _passes_check(self, u: Tensor, check_index: int, min_trials: int) -> bool:
        """Return whether a configuration passes a check, and store it if it does.

        Args:
            u: (d,) the configuration.
            check_index: index of the check, which decides the seeds of its trials.
            min_trials: number of trials that suffices if none fails.
        """
        rule = self.searches.problem.verification_rule
        max_failures = rule.count_allowed_failures(self.verifier.n_trials)
        scores, has_passed = _try_until_decided(
            self.verifier, u, check_index, min_trials, max_failures
        )
        if self.transport is not None:
            self.transport.update_score_bias(u, scores)
        if has_passed:
            # The other fields are those of the last search, until the end of
            # `find_smallest`. This result is used only after an interrupt.
            self.searches.run_state.search_result = replace(self.results[-1], best_u=u)
        return has_passed


def _search_budget(
    searches: Searches, policy: Policy[Any], domain: Domain, number: int
) -> SearchResult:
    """Search in one of the shrinking budgets by which the smallest change is found.

    Args:
        searches: searches of the attack.
        policy: policy that searches.
        domain: domain with that budget.
        number: number of the search, from 0.
    """
    problem = searches.problem
    title = f"search {number + 1} of at most {MAX_SEARCHES}"
    searches.begin_stage("search", title, problem.steps, "`steps` shortens each search")
    # The first search has the kind "search", as the main search of every attack has.
    is_first = number == 0
    kind = "search" if is_first else f"search {number}"
    # The ranking renders the best configurations again. It is not needed with a matrix
    # of light transport (`Transport`), which predicts them without noise.
    has_noise = not isinstance(searches.run_state.predictor, Transport)
    return searches.run_search(
        kind,
        policy,
        problem.steps,
        seeds.derive_seed(problem.seed, "smallest", number),
        domain=domain,
        ranked=has_noise,
    )


def _confirm(
    bracket: Bracket,
    passes_check: Callable[[Tensor, int], bool],
    verifier: Verifier,
    domain: Domain,
) -> Bracket:
    """Try the configuration at the upper bound of a bracket again, in full checks.

    A configuration that fails is replaced by a slightly larger change, at most
    `MAX_CONFIRMATIONS` times in all. Each has to pass several checks in a row.

    Args:
        bracket: the bracket, perhaps without any configuration.
        passes_check: takes a configuration (d,) and the index of a check, from which
            the seeds of its trials follow; returns whether the configuration passes.
        verifier: verifier that tries it.
        domain: domain with the full budget.
    """
    # full checks that together have at least `MIN_CONFIRMING_TRIALS` trials
    n_checks = math.ceil(MIN_CONFIRMING_TRIALS / verifier.n_trials)
    if bracket.u is not None:
        n_trials = MAX_CONFIRMATIONS * n_checks * verifier.n_trials
        verifier.begin_stage("checking the smallest change", n_trials, at_most=True)
    return confirm_bracket(bracket, passes_check, domain, times=n_checks)


def _try_until_decided(
    verifier: Verifier, u: Tensor, check_index: int, min_trials: int, max_failures: int
) -> tuple[list[float], bool]:
    """Try a configuration until it passes a check or fails it.

    The check ends when more than `max_failures` trials have failed, or `min_trials`
    were made and none failed, or after all trials.

    Args:
        verifier: verifier that tries it.
        u: (d,) the configuration.
        check_index: index of the check, which decides the seeds of its trials.
        min_trials: number of trials that suffices if none fails.
        max_failures: maximum number of failed trials with which a configuration passes.

    Returns:
        The scores of the trials, and whether the configuration has passed.
    """
    scores = list[float]()
    n_failures = 0
    for trial_index in range(verifier.n_trials):
        has_failed = n_failures > max_failures
        has_passed_early = n_failures == 0 and trial_index >= min_trials
        if has_failed or has_passed_early:
            break
        (trial,) = verifier.try_configurations(f"check {check_index}", {trial_index: u})
        scores.append(trial.score)
        if not trial.success:
            n_failures += 1
    return scores, n_failures <= max_failures


def _combine_results(results: Sequence[SearchResult], bracket: Bracket) -> SearchResult:
    """Return one result of several searches in shrinking budgets.

    It is the result of the search that found the smallest change, or of the first if
    none found any, but with the renders and gradients of all.

    Args:
        results: results of the searches.
        bracket: the smallest change, with the number of the search that found it.
    """
    winner = results[0]
    if bracket.u is not None:
        winner = replace(
            results[bracket.found_by], best_u=bracket.u, ending=Ending.FOUND
        )
    return replace(
        winner,
        renders=sum(result.renders for result in results),
        gradients=sum(result.gradients for result in results),
    )


def _rank(verification: Verification) -> tuple[bool, float, float]:
    """Return how bad a tried configuration is for the model; larger is worse.

    A verified success ranks above all others. Then the success rate decides, then the
    mean score; a mean that is not a number counts as the lowest.
    """
    scores = [trial.score for trial in verification.valid_trials]  # never empty
    mean_score = sum(scores) / len(scores)
    return (
        verification.ending is Ending.FOUND,
        verification.adversarial_counts.rate,
        -math.inf if math.isnan(mean_score) else mean_score,
    )


MAX_TRIED_FAILURES = 8  # failures of a search that are verified, the first of its list


def verify_failures(verifier: Verifier, result: SearchResult) -> None:
    """Verify the first of the different failures that a search found, each by itself.

    The trials have the same seeds as those of the clean scene. They end early, as soon
    as a failure can no longer be verified. Nothing is tried if conditions vary by
    chance: then a verdict takes hundreds of trials for each failure.

    Args:
        verifier: verifier of the attack.
        result: result of the search.
    """
    known = result.failures
    if known is None or not known.examples or not _can_verify_failures(verifier):
        return
    failures = known.examples[:MAX_TRIED_FAILURES]
    title = "checking different failures with fresh renders"
    verifier.begin_stage(title, len(failures) * verifier.n_trials, at_most=True)
    verifier.run_state.failure_verifications = tuple(
        verifier.verify(
            f"failure {number}", replace(result, best_u=failure.u), curtailed=True
        )
        for number, failure in enumerate(failures)
    )


def _can_verify_failures(verifier: Verifier) -> bool:
    """Return whether trials of single failures can prove anything at a bearable cost.

    They cannot if conditions vary by chance, or if the model is wrong about the clean
    scene.
    """
    rule = verifier.problem.verification_rule
    if rule.has_varying_conditions:
        return False
    # Only the counts matter here, and not the `spp` that is stored with them.
    clean_counts = count_right(verifier.run_state.clean_trials, spp=1)
    return not rule.is_already_wrong(clean_counts)
