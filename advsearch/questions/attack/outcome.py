"""Make the result of an attack from its findings: summary, images and files."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from torch import Tensor

from advsearch.attacks import (
    Ending,
    SearchResult,
    StepRecord,
    Verification,
    count_right,
)
from advsearch.attacks.candidates import FoundFailure
from advsearch.attacks.trials import MAX_MOVED_FRACTION, MAX_SAMPLE_RATIO, OVER_LADDER
from advsearch.engine.journal import Journal
from advsearch.engine.judging import make_domain, measure_print_terms
from advsearch.engine.problem import Problem
from advsearch.engine.record import (
    RunState,
    make_control_group,
    make_lost_remarks,
    make_verified_rate,
    mean_number,
)
from advsearch.engine.transport import make_rendering_remark
from advsearch.options import OUT_OF_VIEW, Value
from advsearch.progress import Stages
from advsearch.questions.attack.result import (
    AttackResult,
    StoredImage,
    choose_stored_trial,
    evaluate_drive,
    save_images,
    save_trial,
    write_object,
)
from advsearch.questions.attack.stages import UNPRINTED
from advsearch.questions.attack.summary import (
    AlongDrive,
    AmbientLight,
    AmbientPoint,
    AttackSummary,
    BaselineSearch,
    CleanPrediction,
    DifferentFailure,
    DifferentFailures,
    FailingShare,
    FoundValue,
    NotFinite,
    ObjectiveValues,
    PathSegments,
    PicturedPrediction,
    Printability,
    PrintCost,
    SearchClaim,
    SearchDistribution,
    SearchGradients,
    SmallestEpsilon,
    TriedObjective,
    VerificationSamples,
)
from advsearch.report.wording import format_number
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results import (
    AverageCase,
    DescribedValue,
    Formation,
    MovedValue,
    PrintTerms,
    SharedWork,
    TwinEvidence,
    VariedValue,
    VerifiedRate,
)
from advsearch.runs.summary import write_configuration
from advsearch.runs.twins import find_twin_evidence
from advsearch.tasks import Judgement
from advsearch.tasks.base import Task, mean
from advsearch.tasks.detection import Detection
from advsearch.trust.writing import write_bytes
from advsearch.viewer.pages import write_result

T = TypeVar("T")
MAX_LISTED_NUMBERS = 4096  # larger distributions are left out of a summary
# fields of a summary about the search if there was none
_EMPTY_SEARCH_FIELDS: Mapping[str, Any] = {
    "distribution": None,
    "claimed": None,
    "gradients": None,
    "configuration": None,
    "steps": 0,
    "non_finite": NotFinite(objectives=0, gradient_elements=0),
}


def make_result(
    findings: RunState,
    journal: Journal,
    stages: Stages,
    warnings: Sequence[str],
    *,
    object_name: str,
    judge: str,
    policy: str,
    objective: str | None,
    printable: bool,
    command_line: str | None,
    python_only: list[str],
    twins: str | None = None,
) -> AttackResult:
    """Make the result of an attack, and store it with its images in the run, if any.

    Args:
        findings: findings of the attack.
        journal: journal of the run.
        stages: stages of the run, with the seconds that each took.
        warnings: warnings so far.
        object_name: name of the object under attack.
        judge: the thing that is evaluated.
        policy: name of the requested policy.
        objective: name of the objective; None for the objective of the task.
        printable: whether the search had print terms.
        command_line: command that repeats the attack; None if none does.
        python_only: parts of the attack that exist only in Python.
        twins: name or folder of a run of `advsearch twins`, which compared renders with
            photographs; None without one.
    """
    problem = journal.problem
    run = journal.run_directory
    stages.progress.stage("making the pictures and the report")
    u = _find_adversarial_u(problem, findings)
    scene_images = _render_scenes(problem, findings, u)
    artifacts = problem.searched_space.get_artifact_images(u)
    run_path = None if run is None else run.path
    if run is not None:
        _write_files(run, problem, findings, u, scene_images, artifacts)
    summary = _summarize(
        findings,
        journal,
        scene_images["clean"],
        scene_images["adversarial"],
        drive=_evaluate_finished_drive(problem, findings, u, run),
        run=None if run_path is None else str(run_path),
        object=object_name,
        judge=judge,
        policy=policy,
        objective=name_objective(problem.task, objective),
        printability=_summarize_printability(problem, findings) if printable else None,
        warnings=[*warnings, *_make_remarks(findings, problem, journal)],
        seconds={**stages.seconds, "total": stages.total_seconds},
        command_line=command_line,
        python_only=python_only,
        twins=_find_twins(twins, problem, object_name),
    )
    if run is not None:
        _store_summary(run, summary, is_finished=not findings.interrupted)
    return AttackResult(
        summary=summary,
        run=run_path,
        u=u,
        clean=scene_images["clean"].image,
        adversarial=scene_images["adversarial"].image,
        artifacts=artifacts,
        search=findings.search_result,
        in_memory=tuple(journal.rows),
    )


def _find_adversarial_u(problem: Problem, findings: RunState) -> Tensor:
    """Return the adversarial configuration (d,); without a search the clean one."""
    search = findings.search_result
    if search is None:
        return problem.domain.start
    return problem.domain.project(search.best_u)


def _evaluate_finished_drive(
    problem: Problem, findings: RunState, u: Tensor, run: RunDirectory | None
) -> AlongDrive | None:
    """Evaluate both scenes along a path, unless the attack was interrupted.

    Args:
        problem: problem of the attack.
        findings: findings of the attack.
        u: (d,) the adversarial configuration; not used without a search.
        run: the run directory, which gets the images; None if nothing is stored.

    Returns:
        The result; None if no path varies by chance.
    """
    if findings.interrupted:
        return None
    adversarial_u = None if findings.search_result is None else u
    return evaluate_drive(problem, adversarial_u, findings.spp, run)


def _store_summary(
    run: RunDirectory, summary: AttackSummary, *, is_finished: bool
) -> None:
    """Write the summary and the page of a run; a finished run needs no cache any more."""
    write_result(run, summary)
    # An interrupted run may be continued, and then needs what is cached.
    if is_finished:
        run.store.delete_cached()


def _render_scenes(
    problem: Problem, findings: RunState, u: Tensor
) -> dict[str, StoredImage]:
    """Render the clean scene and the adversarial one, as in a typical trial.

    After Ctrl-C they are rendered with few samples, and not as in a trial.

    Args:
        problem: problem of the attack.
        findings: findings of the attack.
        u: (d,) the adversarial configuration.
    """
    trial = None if findings.interrupted else choose_stored_trial(findings)
    return {
        "clean": StoredImage.render(problem, findings, problem.domain.start, trial),
        "adversarial": StoredImage.render(problem, findings, u, trial),
    }


def _find_twins(
    twins: str | None, problem: Problem, object_name: str
) -> TwinEvidence | None:
    """Return how well renders agreed with photographs in a run of twins, if any.

    A run of twins measures the agreement under several conditions, such as an
    environment, or renders inside a photograph. The result is that of the conditions
    which are most like those of the attack.

    Args:
        twins: name or folder of a run of `advsearch twins`, which compared renders with
            photographs of the same scene.
        problem: problem of the attack.
        object_name: name of the object under attack.
    """
    return find_twin_evidence(
        twins,
        model=problem.model.name,
        task=problem.task.title,
        object_name=object_name,
        environment=problem.environment,
        in_photograph=is_in_photograph(problem),
    )


def is_in_photograph(problem: Problem) -> bool:
    """Return whether the scene is rendered into a photograph."""
    description, _ = problem.renderer.scene.description_and_filter
    return description.backdrop_photograph is not None


def _write_files(
    run: RunDirectory,
    problem: Problem,
    findings: RunState,
    u: Tensor,
    images: Mapping[str, StoredImage],
    artifacts: Mapping[str, Tensor],
) -> None:
    """Write images, the object and the configuration into the run directory.

    Args:
        run: the run directory.
        problem: problem of the attack.
        findings: findings of the attack.
        u: (d,) the adversarial configuration.
        images: images of both scenes, by "clean" and "adversarial".
        artifacts: images that the controls make of `u`, by name, such as the texture.
    """
    save_images(run, problem, findings, images)
    _save_failure_images(run, problem, findings)
    # an 8-bit PNG, and the same display-referred values in float32
    for name, image in artifacts.items():
        run.save_image(name, image, folder="artifacts")
        run.save_exr(name, image, folder="artifacts")
    write_object(run, problem, u)
    for name, data in problem.searched_space.get_artifact_files(u).items():
        write_bytes(run.path / "artifacts" / name, data)
    write_configuration(run.path, u.numpy())


def _save_failure_images(
    run: RunDirectory, problem: Problem, findings: RunState
) -> None:
    """Save an image of each of the different failures that were tried."""
    for number, verification in enumerate(findings.failure_verifications):
        first_trial = (f"failure {number}", 0)  # the kind and the index of a trial
        name = _name_failure_image(number)
        save_trial(run, problem, findings, first_trial, name, verification.u)


def _summarize(
    findings: RunState,
    journal: Journal,
    clean: StoredImage,
    adversarial: StoredImage,
    **fields: Any,
) -> AttackSummary:
    """Return what `summary.json` holds.

    Args:
        findings: findings of the attack.
        journal: journal of the run.
        clean: image of the clean scene.
        adversarial: image of the adversarial scene.
        **fields: the other fields of the summary.
    """
    problem = journal.problem
    adversarial_prediction = None
    if findings.search_result is not None:
        adversarial_prediction = _make_prediction(
            adversarial.judgement, adversarial.trial
        )
    shared_work = SharedWork.from_worker_stats(
        journal.evaluator.worker_stats, journal.machines
    )
    return AttackSummary(
        **fields,
        **_summarize_controls(problem),
        **_summarize_verification(problem, findings),
        **_summarize_search(problem, findings.search_result),
        **_summarize_problem(problem),
        **_summarize_conclusions(problem, findings),
        clean=_make_clean_prediction(problem, findings, clean),
        adversarial=adversarial_prediction,
        transport=findings.transport_summary,
        shared=shared_work,
        renders=_count_renders(findings, problem),
    )


def _summarize_problem(problem: Problem) -> dict[str, Any]:
    """Return the fields of a summary about the model, the task and the renders."""
    task = problem.task
    max_depth = problem.renderer.scene.max_depth
    return {
        "model": problem.model.name,
        "task": task.title,
        "environment": problem.environment,
        "label_set": list(task.truth_names(problem.find_truth())),
        "goal": task.success_description,
        "target": list(task.target_names) or None,
        "image_formation": Formation.from_values(problem.renderer.formation),
        "gradient_plan": problem.summarize_plan(problem.gradient_plan),
        "light_path_segments": PathSegments(
            search=problem.search_depth or max_depth, verification=max_depth
        ),
        "seed": problem.seed,
    }


def _summarize_conclusions(problem: Problem, findings: RunState) -> dict[str, Any]:
    """Return the fields of a summary about the ending, and what else was measured."""
    return {
        "ending": _find_ending(problem, findings).value,
        "ambient": _summarize_ambient(findings),
        "average": _summarize_average(findings),
        "smallest": _summarize_bracket(problem, findings),
        "failures": describe_failures(problem, findings),
    }


def _summarize_controls(problem: Problem) -> dict[str, Any]:
    """Return the fields of a summary about what is searched and what varies by chance."""
    controls = problem.searched_space.controls
    # The space has the searched controls first, then those that conditions vary.
    random_controls = problem.space.controls[len(controls) :]
    budgets = {control.name: control.largest_group_budget for control in controls}
    epsilons = {name: budget.epsilon for name, budget in budgets.items()}
    norms = {name: budget.norm for name, budget in budgets.items()}
    return {
        "controls": [control.name for control in controls],
        "epsilon": _unwrap_single(epsilons),
        "norm": _unwrap_single(norms),
        "over": [control.name for control in random_controls],
        "conditions": _describe_conditions(problem),
    }


def _summarize_verification(problem: Problem, findings: RunState) -> dict[str, Any]:
    """Return the fields of a summary about trials, and about their sample count.

    Trials are made of the clean scene, of the adversarial one and of the configuration
    that the random search found.
    """
    verification = findings.verification
    # If the random search found a worse configuration than the policy, `verification`
    # is about that configuration, and `outdone` about the policy's.
    outdone = findings.outdone_verification
    sample_count = None
    if findings.sample_count is not None:
        sample_count = VerificationSamples.from_values(findings.sample_count)
    return {
        "verified": _make_rate(verification),
        "tried_objective": _summarize_tried_objective(findings),
        "baseline": _summarize_baseline(problem, findings),
        "adversarial_from": None if outdone is None else "random",
        "policy_verified": _make_rate(outdone),
        "sample_count": sample_count,
    }


def _summarize_tried_objective(findings: RunState) -> TriedObjective:
    """Return the objective over the trials of both scenes."""
    verification = findings.verification
    adversarial_trials = verification.adversarial_trials if verification else ()
    return TriedObjective(
        clean=_compute_objective_values(findings.clean_trials),
        adversarial=_compute_objective_values(adversarial_trials),
    )


def _make_rate(verification: Verification | None) -> VerifiedRate | None:
    """Return the rate of a verification; None without one."""
    return None if verification is None else make_verified_rate(verification)


def _summarize_search(problem: Problem, search: SearchResult | None) -> dict[str, Any]:
    """Return the fields of a summary about the search; empty ones without a search."""
    if search is None:
        return dict(_EMPTY_SEARCH_FIELDS)
    non_finite = NotFinite(
        objectives=search.non_finite_objectives,
        gradient_elements=search.non_finite_elements,
    )
    return {
        "distribution": _summarize_distribution(problem, search),
        "claimed": _make_search_claim(search),
        "gradients": _summarize_gradients(search),
        "configuration": _describe_configuration(problem, search.best_u),
        "steps": len(search.history),
        "non_finite": non_finite,
    }


def _unwrap_single(values: dict[str, T]) -> T | dict[str, T]:
    """Return the value of the only control, or else all values by control."""
    return next(iter(values.values())) if len(values) == 1 else values


def _find_ending(problem: Problem, findings: RunState) -> Ending:
    """Return how the attack ended.

    Without a verification it ended before one: the clean scene is wrong already, or
    there was an interrupt.
    """
    if findings.interrupted:
        return Ending.INTERRUPTED
    if findings.verification is not None:
        return findings.verification.ending
    if findings.clean_trials:
        counts = count_right(findings.clean_trials, findings.spp)
        if problem.verification_rule.is_already_wrong(counts):
            return Ending.ALREADY_WRONG
    return Ending.INTERRUPTED


def _make_prediction(judgement: Judgement, trial: int | None) -> PicturedPrediction:
    """Return the prediction of a stored image.

    Args:
        judgement: judgement of the image.
        trial: the trial that has the image; None if no trial has it.
    """
    prediction = judgement.prediction
    return PicturedPrediction(
        label=prediction.label,
        index=prediction.index,
        probability=prediction.probability,
        payload=judgement.payload,
        trial=trial,
    )


def _make_clean_prediction(
    problem: Problem, findings: RunState, picture: StoredImage
) -> CleanPrediction:
    """Return the prediction of the clean scene, with its trials if there are any."""
    control_group = None
    if findings.clean_trials:
        control_group = make_control_group(findings.clean_trials, findings.spp)
    # `CleanPrediction` has the fields of `PicturedPrediction` and some more.
    picture_fields = vars(_make_prediction(picture.judgement, picture.trial))
    return CleanPrediction(
        **picture_fields,
        correct=picture.judgement.right,
        moved=_list_moved_values(problem),
        control=control_group,
    )


def _list_moved_values(problem: Problem) -> list[MovedValue]:
    """Return the scene's values that were outside of a control's range and replaced."""
    return [
        MovedValue(
            parameter=value.parameter_name,
            unit=value.unit,
            scene=value.scene_value,
            used=value.used_value,
        )
        for value in problem.space.adjusted_defaults
    ]


def _summarize_baseline(problem: Problem, findings: RunState) -> BaselineSearch | None:
    """Return the summary of the random search; None if there was none."""
    if findings.random_search_result is None:
        return None
    return BaselineSearch(
        policy="random",
        renders=findings.random_search_result.renders
        * problem.conditions_per_evaluation,
        verified=_make_rate(findings.baseline_verification),
    )


def _summarize_ambient(findings: RunState) -> AmbientLight | None:
    """Return up to which ambient light the adversarial scene holds.

    None if that was not tried.
    """
    if not findings.verification_by_lux:
        return None
    points = [
        _make_ambient_point(lux, verification)
        for lux, verification in sorted(findings.verification_by_lux.items())
    ]
    n_holding = _count_holding(points)
    holds_in_all = n_holding == len(points)
    return AmbientLight(
        lux=points[0].lux,
        holds_to=points[n_holding - 1].lux,
        limit_lux=None if holds_in_all else points[n_holding].lux,
        points=points,
    )


def _make_ambient_point(lux: float, verification: Verification) -> AmbientPoint:
    """Return whether the adversarial scene holds in an ambient light, in lux."""
    return AmbientPoint(
        lux=lux,
        holds=verification.ending is Ending.FOUND,
        verified=make_verified_rate(verification),
    )


def _count_holding(points: Sequence[AmbientPoint]) -> int:
    """Count the lights, by rising brightness, before the first that does not hold.

    The first light always holds: it is the scene's own light, in which the scene was
    verified.
    """
    n_holding = 0
    while n_holding < len(points) and points[n_holding].holds:
        n_holding += 1
    return n_holding


def _summarize_average(findings: RunState) -> AverageCase | None:
    """Return how often the model is right in random configurations; None without any.

    Configurations without the object in view count only if there are no others.
    """
    trials = _select_visible(findings.random_trials)
    if not trials:
        return None
    right = count_right(trials, findings.spp)
    # without NaN, which `max` cannot order
    scores = [trial.score for trial in trials if not math.isnan(trial.score)]
    # A score is the negative of a margin. It is negated as `0.0 - x`, since -x of 0.0
    # would be -0.0.
    return AverageCase(
        configurations=right.n_trials,
        correct=right.n_successes,
        accuracy=right.rate,
        interval=right.interval,
        margin=0.0 - mean_number(scores),
        worst_margin=0.0 - max(scores, default=math.nan),
    )


def _select_visible(trials: Sequence[Judgement]) -> Sequence[Judgement]:
    """Return the trials with the object in view, or all if there are none."""
    visible = [trial for trial in trials if trial.prediction.label != OUT_OF_VIEW]
    return visible or trials


def _summarize_bracket(problem: Problem, findings: RunState) -> SmallestEpsilon | None:
    """Return the bounds of the smallest epsilon, by control; None if not searched.

    The scales of the bracket are factors of the budgets. A search passes if it finds a
    wrong prediction: `smallest_passing_scale` is the smallest at which one was found,
    and `largest_failing_scale` the largest at which none was found.
    """
    bracket = findings.smallest_change_bracket
    if bracket is None:
        return None
    passing = failing = None
    if bracket.u is not None:
        passing = _scale_budgets(problem, bracket.smallest_passing_scale)
    if bracket.largest_failing_scale > 0.0:  # 0 until a search fails
        failing = _scale_budgets(problem, bracket.largest_failing_scale)
    return SmallestEpsilon(
        epsilon=passing,
        not_found_at=failing,
        closed=bracket.is_closed,
        confirmed=bracket.confirmed,
        searches=bracket.searches,
        checks=bracket.n_checks,
    )


def _scale_budgets(problem: Problem, factor: float) -> dict[str, float]:
    """Return the epsilon of each searched control times a factor."""
    return {
        control.name: factor * float(control.largest_group_budget.epsilon or 0.0)
        for control in problem.searched_space.controls
    }


def _make_search_claim(search: SearchResult) -> SearchClaim:
    """Return what the search itself claims, before any verification."""
    return SearchClaim(
        objective=search.claimed_objective,
        re_evaluated=search.best_objective,
        success_rate=search.success_rate,
    )


def _summarize_gradients(search: SearchResult) -> SearchGradients:
    """Return the statistics of the gradients of a search."""
    # the cosine of each gradient with the previous one
    cosines = search.agreement
    median_cosine = statistics.median(cosines) if cosines else None
    return SearchGradients(
        count=search.gradients,
        cosine_with_the_one_before=median_cosine,
        zero=_count_zero_gradients(search.history),
        cut=search.counts.cut,  # gradients in which single elements were clipped
        shortened=search.counts.shortened,  # gradients whose norm was scaled down
        rejected=search.counts.rejected,  # steps that were undone
    )


def _count_zero_gradients(history: Sequence[StepRecord]) -> int:
    """Count the steps whose gradient is zero, though their objective is a number."""
    norms = [
        record.gradient_norm for record in history if not math.isnan(record.objective)
    ]
    return sum(norm == 0.0 for norm in norms)


def _summarize_distribution(
    problem: Problem, search: SearchResult
) -> SearchDistribution | None:
    """Return the distribution that a policy ended with.

    None if it has none, or one of more numbers than a summary lists.
    """
    distribution = search.distribution
    if distribution is None or distribution.mean.numel() > MAX_LISTED_NUMBERS:
        return None
    mean_values = problem.describe(problem.domain.project(distribution.mean))
    return SearchDistribution(
        mean={
            name: DescribedValue.from_values(value)
            for name, value in mean_values.items()
        },
        deviation=distribution.deviation.tolist(),
    )


def name_objective(task: Task, objective: str | None) -> str:
    """Return the name of what a search maximised.

    "score" is the task's own score. A detector has a goal, its attribute `seek`, such as
    "create". Its score is named after the goal, unless that is the default, "vanish".

    Args:
        task: task of the search.
        objective: the requested objective; None for the objective of the task.
    """
    name = objective or task.objective
    is_score = name == Task.objective  # "score", the default of all tasks
    default_goal = Detection.seek  # "vanish"
    goal = getattr(task, "seek", default_goal)  # only detection has goals
    has_special_goal = goal not in ("", default_goal)
    return str(goal) if is_score and has_special_goal else name


def _compute_objective_values(trials: Sequence[Judgement]) -> ObjectiveValues | None:
    """Return mean, deviation and range of the objective over trials, if it is known."""
    values = [trial.objective for trial in trials if trial.objective is not None]
    if not values:
        return None
    are_finite = all(map(math.isfinite, values))
    deviation = statistics.pstdev(values) if are_finite else math.nan
    return ObjectiveValues(
        mean=mean(values), deviation=deviation, low=min(values), high=max(values)
    )


def _summarize_printability(problem: Problem, findings: RunState) -> Printability:
    """Return how printable the scenes are, and what that costs in margin.

    Print terms of the objective keep colors printable. Their cost is the difference in
    margin from a search without them, if that was verified, too.
    """

    search = findings.search_result
    return Printability(
        clean=measure_print_terms(problem.searched_space, problem.domain.start),
        adversarial=None if search is None else _measure_found_terms(problem, search),
        cost=_measure_print_cost(problem, findings),
    )


def _measure_found_terms(problem: Problem, search: SearchResult) -> PrintTerms:
    """Measure the print terms of the configuration that a search found."""
    u = problem.domain.project(search.best_u)
    return measure_print_terms(problem.searched_space, u)


def _measure_print_cost(problem: Problem, findings: RunState) -> PrintCost | None:
    """Return what print terms cost in margin.

    None if no search without print terms was made, or if it was not verified.
    """
    verification = findings.verification
    unprinted = findings.result_without_print_terms
    unprinted_verification = findings.unprinted_verification
    if verification is None or unprinted is None or unprinted_verification is None:
        return None
    margin = make_verified_rate(verification).margin
    unprinted_rate = make_verified_rate(unprinted_verification)
    return PrintCost(
        steps=len(unprinted.history),
        margin_with=margin,
        margin_without=unprinted_rate.margin,
        # A search lowers the margin: print terms cost what it is higher with them.
        cost=margin - unprinted_rate.margin,
        verified=unprinted_rate,
        terms=_measure_found_terms(problem, unprinted),
    )


def _describe_configuration(problem: Problem, u: Tensor) -> dict[str, FoundValue]:
    """Return the adversarial configuration, with clean values and ranges.

    Args:
        problem: problem of the attack.
        u: (d,) the configuration.
    """
    clean_values = problem.describe(problem.domain.start)
    ranges = _describe_ranges(problem)
    described_values = dict[str, FoundValue]()
    for name, described in problem.describe(problem.domain.project(u)).items():
        clean = _get_value(clean_values, name)
        described_values[name] = _make_found_value(described, clean, ranges.get(name))
    return described_values


def _make_found_value(
    described: Value, clean: Any, bounds: tuple[float, float] | None
) -> FoundValue:
    """Return a value of the adversarial configuration, as a summary has it.

    Args:
        described: the value with its unit.
        clean: the clean value; dropped unless it is a number or a text.
        bounds: the range of the parameter; None without one.
    """
    low, high = bounds or (None, None)
    return FoundValue(
        value=described["value"],
        unit=described["unit"],
        clean=clean if isinstance(clean, (int, float, str)) else None,
        low=low,
        high=high,
    )


def _describe_ranges(problem: Problem) -> dict[str, tuple[float, float]]:
    """Return the range of each searched parameter that is a single number.

    Each searched number has a coordinate in [0, 1]. Its range goes from the value at
    coordinate 0 to the value at 1. A parameter is left out if these two values are not
    numbers, or not in ascending order.
    """
    column_of_number = _find_number_columns(problem)
    columns = [*column_of_number.values()]
    values_at_0 = _describe_with(problem, columns, coordinate=0.0)
    values_at_1 = _describe_with(problem, columns, coordinate=1.0)
    ranges = dict[str, tuple[float, float]]()
    for name in column_of_number:
        low = _get_value(values_at_0, name)
        high = _get_value(values_at_1, name)
        are_numbers = isinstance(low, float) and isinstance(high, float)
        if are_numbers and low < high:
            ranges[name] = (low, high)
    return ranges


def _find_number_columns(problem: Problem) -> dict[str, int]:
    """Return the column of each searched parameter that is a single number, by name."""
    # The searched parameters come first in the space, and the start has their
    # coordinates only.
    n_searched = len(problem.domain.start)
    return {
        group.name: group.begin
        for group in problem.space.groups
        if group.size == 1 and group.begin < n_searched
    }


def _describe_with(
    problem: Problem, columns: list[int], coordinate: float
) -> dict[str, Value]:
    """Return the values of the clean configuration with some coordinates replaced.

    Args:
        problem: problem of the attack.
        columns: indices of the coordinates to replace.
        coordinate: their new value.
    """
    changed = problem.domain.start.clone()
    changed[columns] = coordinate
    return problem.describe(changed)


def _get_value(values: Mapping[str, Value], name: str) -> Any:
    """Return the value of a parameter, without its unit; None if it is missing."""
    return values[name]["value"] if name in values else None


def _describe_conditions(problem: Problem) -> dict[str, VariedValue]:
    """Return the ranges of the parameters that vary by chance, by name.

    Only parameters that are a single number or a choice are described: a number by its
    smallest and largest value, a choice by its options. The values are found by
    describing configurations with the parameter's coordinate at both ends, or at the
    center of each option.
    """
    ranges: dict[str, VariedValue] = {}
    if problem.conditions is None:
        return ranges
    # `problem.domain` has the searched controls only.
    full_domain = make_domain(problem.space.controls)
    # Each parameter has a group in the space and a block in the domain. The group has
    # the index of its first coordinate. The block has the number of options of a
    # choice, which is 0 for a number.
    for group, block in zip(problem.space.groups, full_domain.blocks, strict=True):
        # The searched controls come first in the space.
        is_random = group.begin >= len(problem.domain.start)
        if group.size != 1 or not is_random:
            continue
        described = _describe_along(problem, group.name, group.begin, block.n_options)
        if described:
            ranges[group.name] = _to_range(described, is_choice=bool(block.n_options))
    return ranges


def _describe_along(
    problem: Problem, name: str, column: int, n_options: int
) -> list[Value]:
    """Return the values of a parameter over its range; none if it is not described.

    Args:
        problem: problem of the attack.
        name: name of the parameter.
        column: index of its coordinate in a full configuration.
        n_options: number of options of a choice; 0 for a number.
    """
    start = problem.make_full_configuration(problem.domain.start)
    described = list[Value]()
    for coordinate in _list_described_coordinates(n_options):
        u = start.clone()
        u[column] = coordinate
        # None if the control does not describe this parameter
        value = problem.space.describe(u).get(name)
        if value:
            described.append(value)
    return described


def _list_described_coordinates(n_options: int) -> list[float]:
    """Return the coordinates at which a parameter is described.

    Those of a choice are the centers of equal parts of [0, 1], one for each option. A
    number has no options, and is described at both ends of [0, 1].
    """
    if not n_options:
        return [0.0, 1.0]
    return [(option + 0.5) / n_options for option in range(n_options)]


def _to_range(described: Sequence[Value], *, is_choice: bool) -> VariedValue:
    """Return the range of numbers, or the names of a choice.

    Args:
        described: values of the parameter, each with its unit, at least one.
        is_choice: whether they are the options of a choice; options may be numbers.
    """
    unit = str(described[0]["unit"])
    values = [value["value"] for value in described]
    numbers = [float(value) for value in values if isinstance(value, (int, float))]
    if numbers and not is_choice:
        return VariedValue(unit=unit, low=min(numbers), high=max(numbers))
    distinct_values = dict.fromkeys(values)
    # `format_number` leaves texts as they are
    names = [format_number(value) for value in distinct_values]
    return VariedValue(unit=unit, names=names)


def _count_renders(findings: RunState, problem: Problem) -> dict[str, int]:
    """Count the images of an attack by what they were rendered for.

    An evaluation of a search takes an image for each of the conditions that it averages
    over. Images that were rendered to prepare a predictor count for the search, and the
    first renders of the clean scene for the verification.

    Args:
        findings: findings of the attack.
        problem: problem of the attack.

    Returns:
        Numbers of images by "search", "gradient", "baseline" (the random search),
        "verification", "products" (images that were predicted instead of rendered) and,
        if there was a search without print terms, "unprinted" (its images and
        gradients).
    """
    counts = dict.fromkeys(
        ("search", "gradient", "baseline", "verification", "products"), 0
    )
    n_first_looks = len(findings.first_look_trials)
    counts["verification"] = findings.verification_renders + n_first_looks
    for kind, search in _list_searches(findings).items():
        images = _count_search_images(findings, problem, kind, search)
        counts["products"] += images.predicted
        counts |= _count_rendered_by_purpose(kind, images)
    if findings.predictor:
        n_rendered_to_prepare = findings.predictor.n_traced
        counts["search"] += n_rendered_to_prepare
    return counts


def _count_rendered_by_purpose(kind: str, images: SearchImages) -> dict[str, int]:
    """Return the numbers of rendered images of a search, by the names of their counts.

    Args:
        kind: kind of the search's queries.
        images: numbers of its images.
    """
    if kind == UNPRINTED:
        return {"unprinted": images.rendered + images.of_gradients}
    if kind == "search":
        return {"search": images.rendered, "gradient": images.of_gradients}
    return {kind: images.rendered}  # the random search has no gradients


def _list_searches(findings: RunState) -> dict[str, SearchResult]:
    """Return the searches that were made, by the kind of their queries."""
    # `UNPRINTED` is a long text, and its count has the key "unprinted".
    searches = {
        "search": findings.search_result,
        "baseline": findings.random_search_result,
        UNPRINTED: findings.result_without_print_terms,
    }
    return {kind: search for kind, search in searches.items() if search is not None}


class SearchImages(NamedTuple):
    """How many images of a search were predicted, rendered, or rendered for gradients."""

    predicted: int
    rendered: int
    of_gradients: int


def _count_search_images(
    findings: RunState, problem: Problem, kind: str, search: SearchResult
) -> SearchImages:
    """Count the images of a search.

    Args:
        findings: findings of the attack, with the predictor of the images.
        problem: problem of the attack.
        kind: kind of the search's queries.
        search: result of the search.
    """
    n_predicted_steps = 0
    if findings.predictor:
        n_steps = len(search.history)
        n_predicted_steps = findings.predictor.count_predicted(kind, n_steps)
    n_conditions = problem.conditions_per_evaluation
    n_predicted = n_predicted_steps * n_conditions
    # The gradients of predicted images need no renders. There may be fewer gradients
    # than predicted images.
    return SearchImages(
        predicted=n_predicted,
        rendered=search.renders * n_conditions - n_predicted,
        of_gradients=max(0, search.gradients - n_predicted),
    )


def _make_remarks(findings: RunState, problem: Problem, journal: Journal) -> list[str]:
    """Return sentences about doubts in the result, and about what was not finite.

    Args:
        findings: findings of the attack.
        problem: problem of the attack.
        journal: journal of the run, which knows of lost workers.
    """
    remarks = list[str]()
    rendering_remark = make_rendering_remark(findings.predictor_refusal)
    if rendering_remark:
        remarks.append(rendering_remark)
    samples = findings.sample_count
    # `table` has the sample counts that were compared. It is empty if the count is set.
    if samples is not None and samples.table and not samples.converged:
        has_conditions = problem.conditions is not None
        remarks.append(_make_samples_remark(samples.spp, has_conditions=has_conditions))
    remarks += _list_non_finite_remarks(findings, problem)
    return [*remarks, *make_lost_remarks(journal.n_lost), *journal.remarks]


def _list_non_finite_remarks(findings: RunState, problem: Problem) -> list[str]:
    """Return a remark on values of images and gradients that were not finite, if any."""
    n_non_finite = _count_non_finite(findings, problem)
    if not n_non_finite:
        return []
    return [
        f"{n_non_finite} values of pictures or gradients were not finite "
        "and were set to 0."
    ]


def _count_non_finite(findings: RunState, problem: Problem) -> int:
    """Count the values of images and gradients that were not finite."""
    n_in_searches = sum(
        search.non_finite_elements
        for search in (findings.search_result, findings.random_search_result)
        if search is not None
    )
    # Both counts include those of rendered images of a search. So the larger one is
    # returned, and not their sum.
    return max(problem.renderer.n_non_finite, n_in_searches)


def _make_samples_remark(spp: int, *, has_conditions: bool) -> str:
    """Return a sentence which warns that the sample count may be too small.

    Args:
        spp: samples per pixel of the verification.
        has_conditions: whether conditions vary by chance.
    """
    if not has_conditions:
        return (
            f"More than {spp} samples per pixel, the most that was tried, might change "
            "the sign of the margin: noise may decide the verdict."
        )
    return (
        f"More than {spp} samples per pixel might change the rate by more than "
        f"{100 * MAX_MOVED_FRACTION:.0f} points. At most {OVER_LADDER[-1]} are tried, "
        f"and at most {MAX_SAMPLE_RATIO} times the samples of the searches; "
        "`verify_spp` sets more."
    )


def describe_failures(problem: Problem, findings: RunState) -> DifferentFailures | None:
    """Return the failures of a search that differ from each other.

    None if the policy does not look for several failures.

    Args:
        problem: problem of the attack.
        findings: findings of the attack, with the verifications of the first failures.
    """
    known = findings.search_result.failures if findings.search_result else None
    if known is None:
        return None
    verifications = findings.failure_verifications
    n_verified = sum(
        verification.ending is Ending.FOUND for verification in verifications
    )
    failing_fraction = None
    if known.failure_rate is not None:
        failing_fraction = FailingShare.from_values(known.failure_rate)
    names = problem.domain.element_names
    return DifferentFailures(
        # A policy may divide the space of some parameters into cells, and count in cells.
        over=[names[column] for column in known.cell_parameter_indices],
        found=known.n_failures,
        examined=known.n_visited,
        cells=known.n_cells,
        share=failing_fraction,
        tried=len(verifications),
        verified=n_verified,
        listed=_list_failures(problem, known.examples, verifications),
    )


def _list_failures(
    problem: Problem,
    failures: Sequence[FoundFailure],
    verifications: Sequence[Verification],
) -> list[DifferentFailure]:
    """Return the different failures, as a result lists them.

    Args:
        problem: problem of the attack.
        failures: the failures that the search found.
        verifications: verifications of the first ones; only these are tried.
    """
    n_tried = len(verifications)
    listed = []
    for number, failure in enumerate(failures):
        verification = verifications[number] if number < n_tried else None
        listed.append(_describe_failure(problem, failure, number, verification))
    return listed


def _describe_failure(
    problem: Problem,
    failure: FoundFailure,
    number: int,
    verification: Verification | None,
) -> DifferentFailure:
    """Return one of the different failures, as a result lists it.

    Args:
        problem: problem of the attack.
        failure: the failure, as the search found it.
        number: number in the list.
        verification: verification of the failure; None if it was not tried.
    """
    configuration = {
        name: DescribedValue.from_values(value)
        for name, value in problem.describe(failure.u).items()
    }
    return DifferentFailure(
        ranges=_describe_failure_ranges(problem, failure),
        configuration=configuration,
        objective=failure.objective,
        **_describe_failure_trials(number, verification),
    )


def _describe_failure_trials(
    number: int, verification: Verification | None
) -> dict[str, Any]:
    """Return the fields of a listed failure about its trials; None in all without any.

    Args:
        number: number in the list.
        verification: verification of the failure; None if it was not tried.
    """
    if verification is None:
        return dict.fromkeys(("holds", "verified", "picture", "pictured"))
    return {
        "holds": verification.ending is Ending.FOUND,
        "verified": make_verified_rate(verification),
        "picture": f"images/{_name_failure_image(number)}.png",
        "pictured": _make_prediction(verification.adversarial_trials[0], trial=0),
    }


def _describe_failure_ranges(
    problem: Problem, failure: FoundFailure
) -> dict[str, tuple[float, float] | str]:
    """Return the ranges in which a failure lies, by the name of the coordinate.

    A failure stands for a cell of similar configurations, whose bounds these are. A
    range is in the parameter's unit if the parameter is a single number, such as
    "pose.yaw"; else it is in coordinates. A discrete choice has the name of its option.

    Args:
        problem: problem of the attack.
        failure: failure with the bounds of its ranges by column of u.
    """
    return {
        problem.domain.element_names[column]: _describe_failure_range(
            problem, failure, column
        )
        for column in failure.ranges
    }


def _describe_failure_range(
    problem: Problem, failure: FoundFailure, column: int
) -> tuple[float, float] | str:
    """Return the range of a failure in one coordinate, or the name of its option.

    Args:
        problem: problem of the attack.
        failure: failure with the bounds of its ranges by column of u.
        column: the column.
    """
    bounds = failure.ranges[column]
    values_at_bounds = _describe_bounds(problem, failure, column)
    option_names = [value for value in values_at_bounds if isinstance(value, str)]
    if option_names:
        return option_names[0]
    if problem.domain.find_block(column).size == 1:
        return (min(values_at_bounds), max(values_at_bounds))
    # A value describes the full vector, and the bounds are those of one component, which
    # has no description of its own.
    return (min(bounds), max(bounds))


def _describe_bounds(problem: Problem, failure: FoundFailure, column: int) -> list[Any]:
    """Return the values of a parameter at the two bounds of its coordinate.

    A bound itself stands for the value of a parameter that is not described.

    Args:
        problem: problem of the attack.
        failure: the failure, whose other coordinates are used.
        column: the column of the coordinate in u.
    """
    block = problem.domain.find_block(column)
    is_choice = bool(block.n_options)
    values_at_bounds = list[Any]()
    for bound in failure.ranges[column]:
        u = failure.u.clone()
        if not is_choice:  # the option of a choice is that of the failure itself
            u[column] = bound
        described = problem.describe(u).get(block.name)
        values_at_bounds.append(bound if described is None else described["value"])
    return values_at_bounds


def _name_failure_image(number: int) -> str:
    """Return the name of the image of a failure, by its number in the list."""
    return f"failure-{number:02d}"
