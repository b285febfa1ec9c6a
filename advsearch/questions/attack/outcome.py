"""From what an attack found to its summary, its pictures and its files."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any, TypeVar

from torch import Tensor

from advsearch.attacks import Ending, SearchResult, count_right
from advsearch.attacks.candidates import FoundFailure
from advsearch.attacks.trials import MOST_TIMES, MOVED, OVER_LADDER
from advsearch.engine.journal import Journal
from advsearch.engine.judging import domain_of, print_terms
from advsearch.engine.problem import Problem
from advsearch.engine.record import (
    Findings,
    control_group,
    lost_remarks,
    mean_number,
    verified_rate,
)
from advsearch.engine.transport import remark
from advsearch.options import OUT_OF_VIEW, Value
from advsearch.progress import Stages
from advsearch.questions.attack import result as kept
from advsearch.questions.attack.result import AttackResult, KeptPicture
from advsearch.questions.attack.stages import UNPRINTED
from advsearch.questions.attack.summary import (
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
from advsearch.report.wording import number_text
from advsearch.runs.results import (
    AverageCase,
    DescribedValue,
    Formation,
    MovedValue,
    PrintTerms,
    SharedWork,
    VariedValue,
)
from advsearch.runs.summary import write_configuration
from advsearch.tasks import Judgement
from advsearch.tasks.base import Task, mean
from advsearch.tasks.detection import Detection
from advsearch.trust.writing import write_bytes
from advsearch.viewer.pages import keep_result

T = TypeVar("T")
MOST_NUMBERS = 4096  # Numbers of a distribution that a summary names, at most


def make_result(
    findings: Findings,
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
) -> AttackResult:
    """Make the result of an attack from what it found, and store it with its images in
    the run, if there is one.

    Args:
        findings: of the attack.
        journal: of the run.
        stages: which took their time.
        warnings: so far.
        object_name: of the object under attack.
        judge: the thing that is judged.
        policy: by name, as requested.
        objective: by name; None for the task's own.
        printable: whether the search had print terms.
        command_line: repeats the attack; None where no command does.
        python_only: its parts that exist only in Python.
    """
    problem = journal.problem
    search = findings.search
    run = journal.run
    space = problem.searched_space
    start = problem.domain.start
    u = start if search is None else problem.domain.project(search.best_u)
    stages.progress.stage("making the pictures and the report")
    # whoever presses Ctrl-C is in a hurry
    trial = None if findings.interrupted else kept.trial_to_show(findings)
    clean, adversarial = (
        KeptPicture.of(problem, findings, at, trial) for at in (start, u)
    )
    artifacts = space.artifacts(u)
    if run is not None:
        kept.write_pictures(
            run, problem, findings, {"clean": clean, "adversarial": adversarial}
        )
        for number, checked in enumerate(findings.failures):
            kept.save_trial(
                run,
                problem,
                findings,
                (f"failure {number}", 0),
                _picture(number),
                checked.u,
            )
        # an 8-bit PNG, and the same display-referred values in float32
        for name, picture in artifacts.items():
            run.save_image(name, picture, folder="artifacts")
            run.save_exr(name, picture, folder="artifacts")
        kept.write_object(run, problem, u)
        for name, data in space.files(u).items():
            write_bytes(run.path / "artifacts" / name, data)
        write_configuration(run.path, u.numpy())
    searched = None if search is None else u
    drive = (
        None
        if findings.interrupted
        else kept.along_drive(problem, searched, findings.spp, run)
    )
    task = problem.task
    depth = problem.renderer.scene.max_depth
    controls = problem.searched_space.controls
    verification = findings.verification
    history = [] if search is None else search.history
    path = None if run is None else run.path
    summary = AttackSummary(
        run=None if path is None else str(path),
        object=object_name,
        judge=judge,
        model=problem.model.name,
        task=task.title,
        environment=problem.environment,
        controls=[bound.name for bound in controls],
        policy=policy,
        objective=name_objective(task, objective),
        epsilon=_alone({bound.name: bound.budget.epsilon for bound in controls}),
        norm=_alone({bound.name: bound.budget.norm for bound in controls}),
        label_set=list(task.truth_names(problem.truth())),
        goal=task.goal,
        target=list(task.target_names) or None,
        over=[bound.name for bound in problem.space.controls[len(controls) :]],
        conditions=_conditions(problem),
        image_formation=Formation.of(problem.renderer.formation),
        gradient_plan=problem.plan_summary(problem.plan),
        light_path_segments=PathSegments(
            search=problem.search_depth or depth, verification=depth
        ),
        ending=_ending(problem, findings).value,
        clean=_clean_prediction(problem, findings, clean),
        adversarial=None
        if search is None
        else _prediction(adversarial.judgement, adversarial.trial),
        verified=verification and verified_rate(verification),
        tried_objective=TriedObjective(
            clean=_objective_over(findings.clean),
            answer=_objective_over(
                verification.adversarial_trials if verification else ()
            ),
        ),
        baseline=_baseline(problem, findings),
        answer_from="random" if findings.beaten is not None else None,
        policy_verified=findings.beaten and verified_rate(findings.beaten),
        drive=drive,
        ambient=_ambient_light(findings),
        average=_average_case(findings),
        smallest=_smallest_epsilon(problem, findings),
        printability=_printability(problem, findings) if printable else None,
        distribution=None if search is None else _distribution(problem, search),
        failures=described_failures(problem, findings),
        sample_count=findings.sample_count
        and VerificationSamples.of(findings.sample_count),
        transport=findings.transport_summary,
        claimed=None if search is None else _claim(search),
        gradients=None if search is None else _gradients(search),
        configuration=None if search is None else _found_values(problem, search.best_u),
        shared=SharedWork.of_facts(journal.traced.facts, journal.machines),
        renders=_renders(findings, problem),
        steps=len(history),
        non_finite=NotFinite(
            objectives=0 if search is None else search.non_finite_objectives,
            gradient_elements=0 if search is None else search.non_finite_elements,
        ),
        warnings=[*warnings, *_remarks(findings, problem, journal)],
        seconds={**stages.seconds, "total": stages.total},
        seed=problem.seed,
        command_line=command_line,
        python_only=python_only,
    )
    if run is not None:
        keep_result(run, summary)
        if not findings.interrupted:
            run.store.forget()
    return AttackResult(
        summary,
        path,
        u,
        clean.picture,
        adversarial.picture,
        artifacts,
        search,
        in_memory=tuple(journal.rows),
    )


def _alone(values: dict[str, T]) -> T | dict[str, T]:
    return next(iter(values.values())) if len(values) == 1 else values


def _ending(problem: Problem, findings: Findings) -> Ending:
    if findings.interrupted:
        return Ending.INTERRUPTED
    if findings.verification is not None:
        return findings.verification.ending
    if findings.clean and problem.rule.already_wrong(
        count_right(findings.clean, findings.spp)
    ):
        return Ending.ALREADY_WRONG
    return Ending.INTERRUPTED


def _prediction(judgement: Judgement, trial: int | None) -> PicturedPrediction:
    said = judgement.prediction
    return PicturedPrediction(
        label=said.label,
        index=said.index,
        probability=said.probability,
        payload=judgement.payload,
        trial=trial,
    )


def _clean_prediction(
    problem: Problem, findings: Findings, picture: KeptPicture
) -> CleanPrediction:
    return CleanPrediction(
        **vars(_prediction(picture.judgement, picture.trial)),
        correct=picture.judgement.right,
        moved=[MovedValue.of(value) for value in problem.space.moved],
        control=control_group(findings.clean, findings.spp) if findings.clean else None,
    )


def _baseline(problem: Problem, findings: Findings) -> BaselineSearch | None:
    if findings.baseline is None:
        return None
    verified = findings.baseline_verification and verified_rate(
        findings.baseline_verification
    )
    return BaselineSearch(
        policy="random",
        renders=findings.baseline.renders * problem.draws,
        verified=verified,
    )


def _ambient_light(findings: Findings) -> AmbientLight | None:
    if not findings.ambient:
        return None
    points = [
        AmbientPoint(
            lux=lux, holds=tried.ending is Ending.FOUND, verified=verified_rate(tried)
        )
        for lux, tried in sorted(findings.ambient.items())
    ]
    n_holding = next(
        (number for number, point in enumerate(points) if not point.holds), len(points)
    )
    return AmbientLight(
        lux=points[0].lux,
        holds_to=points[n_holding - 1].lux,
        ends_at=points[n_holding].lux if n_holding < len(points) else None,
        points=points,
    )


def _average_case(findings: Findings) -> AverageCase | None:
    if not findings.average:
        return None
    visible = [
        trial for trial in findings.average if trial.prediction.label != OUT_OF_VIEW
    ] or findings.average
    right = count_right(visible, findings.spp)
    scores = [trial.score for trial in visible]
    return AverageCase(
        configurations=right.trials,
        correct=right.successes,
        accuracy=right.rate,
        interval=right.interval,
        margin=0.0 - mean_number(scores),
        worst_margin=0.0
        - max((score for score in scores if score == score), default=math.nan),
    )


def _smallest_epsilon(problem: Problem, findings: Findings) -> SmallestEpsilon | None:
    bracket = findings.smallest
    if bracket is None:
        return None
    budgets = {
        bound.name: float(bound.budget.epsilon or 0.0)
        for bound in problem.searched_space.controls
    }
    return SmallestEpsilon(
        epsilon=None
        if bracket.u is None
        else {name: bracket.high * budget for name, budget in budgets.items()},
        not_found_at={name: bracket.low * budget for name, budget in budgets.items()}
        if bracket.low
        else None,
        closed=bracket.closed,
        confirmed=bracket.confirmed,
        searches=bracket.searches,
        checks=bracket.checks,
    )


def _claim(search: SearchResult) -> SearchClaim:
    return SearchClaim(
        objective=search.claimed_objective,
        re_evaluated=search.best_objective,
        success_rate=search.success_rate,
    )


def _gradients(search: SearchResult) -> SearchGradients:
    norms = [
        record.gradient_norm
        for record in search.history
        if record.objective == record.objective
    ]
    return SearchGradients(
        count=search.gradients,
        cosine_with_the_one_before=statistics.median(search.agreement)
        if search.agreement
        else None,
        zero=sum(norm == 0.0 for norm in norms),
        cut=search.counts.cut,
        shortened=search.counts.shortened,
        rejected=search.counts.rejected,
    )


def _distribution(problem: Problem, search: SearchResult) -> SearchDistribution | None:
    distribution = search.distribution
    if distribution is None or distribution.mean.numel() > MOST_NUMBERS:
        return None
    middle = problem.describe(problem.domain.project(distribution.mean))
    return SearchDistribution(
        mean={name: DescribedValue.of(value) for name, value in middle.items()},
        deviation=distribution.deviation.tolist(),
    )


def name_objective(task: Task, objective: str | None) -> str:
    """Name what a search maximised: a task's own score has the name of the goal that
    the task seeks.

    "vanish" is what "score" means to a detector without a goal, so it stays "score".
    """
    named = objective or task.objective
    goal = getattr(task, "seek", "")
    if named == Task.objective and goal not in ("", Detection.seek):
        return str(goal)
    return named


def _objective_over(trials: Sequence[Judgement]) -> ObjectiveValues | None:
    """Return mean, deviation and range of the objective over trials; None where there
    are none.
    """
    values = [trial.objective for trial in trials if trial.objective is not None]
    if not values:
        return None
    spread = statistics.pstdev(values) if all(map(math.isfinite, values)) else math.nan
    return ObjectiveValues(
        mean=mean(values), deviation=spread, low=min(values), high=max(values)
    )


def _printability(problem: Problem, findings: Findings) -> Printability:
    def terms_of(search: SearchResult | None) -> PrintTerms | None:
        if search is None:
            return None
        return print_terms(
            problem.searched_space, problem.domain.project(search.best_u)
        )

    verified = findings.verification
    unprinted_verified = findings.unprinted_verification
    cost = None
    unprinted_terms = terms_of(findings.unprinted)
    if verified and unprinted_verified and findings.unprinted and unprinted_terms:
        margin = verified_rate(verified).margin
        unprinted = verified_rate(unprinted_verified)
        cost = PrintCost(
            steps=len(findings.unprinted.history),
            margin_with=margin,
            margin_without=unprinted.margin,
            cost=margin - unprinted.margin,
            verified=unprinted,
            terms=unprinted_terms,
        )
    clean = print_terms(problem.searched_space, problem.domain.start)
    return Printability(clean=clean, answer=terms_of(findings.search), cost=cost)


def _found_values(problem: Problem, u: Tensor) -> dict[str, FoundValue]:
    """Return the adversarial configuration, with the clean value and, of a single
    number, the bounds of its range.
    """
    start = problem.domain.start
    single = {
        group.name: group.begin
        for group in problem.space.groups
        if group.size == 1 and group.begin < len(start)
    }
    bounds = []
    for bound in (0.0, 1.0):
        moved = start.clone()
        moved[[*single.values()]] = bound
        bounds.append(problem.describe(moved))
    clean_values = problem.describe(start)
    values = dict[str, FoundValue]()
    for name, described in problem.describe(problem.domain.project(u)).items():
        clean = clean_values[name]["value"] if name in clean_values else None
        low, high = (
            at_bound[name]["value"] if name in at_bound else None for at_bound in bounds
        )
        has_range = (
            name in single
            and isinstance(low, float)
            and isinstance(high, float)
            and low < high
        )
        values[name] = FoundValue(
            value=described["value"],
            unit=described["unit"],
            clean=clean if isinstance(clean, (int, float, str)) else None,
            low=low if has_range else None,
            high=high if has_range else None,
        )
    return values


def _conditions(problem: Problem) -> dict[str, VariedValue]:
    varied: dict[str, VariedValue] = {}
    if problem.conditions is None:
        return varied
    start = problem.whole(problem.domain.start)
    for group, (block, _) in zip(
        problem.space.groups, domain_of(problem.space.controls).parts(), strict=True
    ):
        if group.size != 1 or group.begin < len(problem.domain.start):
            continue
        described = list[Value]()
        for share in [(k + 0.5) / block.options for k in range(block.options)] or [
            0.0,
            1.0,
        ]:
            moved = start.clone()
            moved[group.begin] = share
            described += filter(None, [problem.space.describe(moved).get(group.name)])
        if not described:
            continue
        values = [value["value"] for value in described]
        unit = str(described[0]["unit"])
        numbers = [float(value) for value in values if isinstance(value, (int, float))]
        if numbers and not block.options:
            varied[group.name] = VariedValue(
                unit=unit, low=min(numbers), high=max(numbers)
            )
        else:
            varied[group.name] = VariedValue(
                unit=unit, names=[number_text(value) for value in dict.fromkeys(values)]
            )
    return varied


def _renders(findings: Findings, problem: Problem) -> dict[str, int]:
    transport = findings.transport
    spent = dict.fromkeys(
        ("search", "gradient", "baseline", "verification", "products"), 0
    )
    spent["verification"] = findings.verification_renders + len(findings.first_look)
    searches = {
        "search": findings.search,
        "baseline": findings.baseline,
        UNPRINTED: findings.unprinted,
    }
    for kind, search in searches.items():
        if search is None:
            continue
        predicted = (
            transport.predicted(kind, len(search.history)) * problem.draws
            if transport
            else 0
        )
        rendered = search.renders * problem.draws - predicted
        gradients = max(0, search.gradients - predicted)
        spent["products"] += predicted
        if kind == UNPRINTED:
            spent["unprinted"] = rendered + gradients
        else:
            spent[kind] = rendered
            spent["gradient"] += gradients if kind == "search" else 0
    spent["search"] += transport.traced if transport else 0
    return spent


def _remarks(findings: Findings, problem: Problem, journal: Journal) -> list[str]:
    remarks = [why] if (why := remark(findings.rendered_because)) else []
    count = findings.sample_count
    if count is not None and count.table and not count.converged:
        more = f"It is not shown that more than {count.spp} samples a pixel"
        if problem.conditions is None:
            more += (
                ", the most that a check takes, would leave the margin on its "
                "side: noise may decide the verdict."
            )
        else:
            more += (
                f" would leave the rate within {100 * MOVED:.0f} points. A check takes "
                "no more than "
                f"{OVER_LADDER[-1]}, and {MOST_TIMES} times the samples of the "
                "searches; `verify_spp` asks for more."
            )
        remarks.append(more)
    searches = [
        search.non_finite_elements
        for search in (findings.search, findings.baseline)
        if search is not None
    ]
    # what predicts pictures has no such count
    if not_finite := max(problem.renderer.non_finite, sum(searches)):
        remarks.append(
            f"{not_finite} values of pictures or gradients were not finite "
            "and were set to 0."
        )
    return [*remarks, *lost_remarks(journal.lost), *journal.remarks]


def described_failures(
    problem: Problem, findings: Findings
) -> DifferentFailures | None:
    known = findings.search.failures if findings.search else None
    if known is None:
        return None
    listed = []
    for number, failure in enumerate(known.listed):
        checked = findings.failures[number] if number < len(findings.failures) else None
        configuration = problem.describe(failure.u)
        described = DifferentFailure(
            ranges=_ranges_of(problem, failure),
            configuration={
                name: DescribedValue.of(value) for name, value in configuration.items()
            },
            objective=failure.objective,
            holds=None if checked is None else checked.ending is Ending.FOUND,
            verified=checked and verified_rate(checked),
            picture=None if checked is None else f"images/{_picture(number)}.png",
            pictured=checked and _prediction(checked.adversarial_trials[0], 0),
        )
        listed.append(described)
    return DifferentFailures(
        over=[problem.domain.names[place] for place in known.over],
        found=known.found,
        seen=known.seen,
        places=known.places,
        share=known.share and FailingShare.of(known.share),
        tried=len(findings.failures),
        held=sum(checked.ending is Ending.FOUND for checked in findings.failures),
        listed=listed,
    )


def _ranges_of(
    problem: Problem, failure: FoundFailure
) -> dict[str, tuple[float, float] | str]:
    """Return the ranges of a failure: in the parameter's unit, else in u; of a discrete
    choice its option.
    """
    ranges: dict[str, tuple[float, float] | str] = {}
    for place, ends in failure.ranges.items():
        block = problem.domain.block_of(place)
        values = list[Any]()
        for end in ends:
            moved = failure.u.clone()
            moved[place] = failure.u[place] if block.options else end
            value = problem.describe(moved).get(block.name)
            values.append(end if value is None else value["value"])
        options = [value for value in values if isinstance(value, str)]
        numbers = values if block.size == 1 else ends
        ranges[problem.domain.names[place]] = (
            options[0] if options else (min(numbers), max(numbers))
        )
    return ranges


def _picture(number: int) -> str:
    return f"failure-{number:02d}"
