"""From what an attack found to its summary, its pictures and its files."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any, TypeVar

from torch import Tensor

from advsearch.attacks import Ending, SearchResult, Verification, count_right
from advsearch.attacks.candidates import Bracket, FoundFailure
from advsearch.attacks.rate_samples import MOST_TIMES, MOVED, OVER_LADDER
from advsearch.described import OUT_OF_VIEW
from advsearch.engine.journal import Journal
from advsearch.engine.objective import domain_of, print_terms
from advsearch.engine.problem import Problem
from advsearch.engine.record import Findings, Stages, control_group, lost_remarks, mean_number, verified_rate
from advsearch.engine.transport import remark
from advsearch.questions.attack import summary as results
from advsearch.questions.attack.page import attack_page
from advsearch.questions.attack.result import (
    AttackResult,
    KeptPicture,
    along_drive,
    save_trial,
    trial_to_show,
    write_artifacts,
    write_object,
    write_pictures,
)
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.stages import UNPRINTED
from advsearch.questions.attack.summary import AttackSummary, PicturedPrediction
from advsearch.report.wording import number_text
from advsearch.runs.directory import REPORT, RunDirectory
from advsearch.runs.files import write_bytes, write_text
from advsearch.runs.results import (
    AverageCase,
    DescribedValue,
    Formation,
    LinearTransport,
    MovedValue,
    PrintTerms,
    SharedWork,
    VariedValue,
    VerifiedRate,
)
from advsearch.runs.summary import write_configuration
from advsearch.tasks import Judgement
from advsearch.tasks.base import mean

T = TypeVar("T")

MOST_NUMBERS = 4096
"""Numbers of a distribution that a summary names, at most."""


def summarise(
    config: AttackConfig,
    objective: str | None,
    findings: Findings,
    journal: Journal,
    stages: Stages,
    warnings: Sequence[str],
) -> AttackResult:
    """Put the result together and, if there is a run directory, write its files."""
    problem, search = journal.problem, findings.search
    start = problem.domain.start
    u = start if search is None else problem.domain.project(search.best_u)
    stages.progress.stage("making the pictures and the report")
    trial = None if findings.interrupted else trial_to_show(findings)  # whoever presses Ctrl-C is in a hurry
    clean, adversarial = (KeptPicture.of(problem, findings, at, trial) for at in (start, u))
    space = problem.searched_space
    artifacts = space.artifacts(u)
    run = journal.run
    warnings = [*warnings, *_remarks(findings, problem, journal)]
    if run is not None:
        write_pictures(run, problem, findings, {"clean": clean, "adversarial": adversarial})
        write_failures(run, problem, findings)
        write_artifacts(run, artifacts)
        write_object(run, problem, u)
        for name, data in space.files(u).items():
            write_bytes(run.path / "artifacts" / name, data)
        write_configuration(run.path, u.numpy())
    drive = None if findings.interrupted else along_drive(problem, None if search is None else u, findings.spp, run)
    summary = _summary(
        config, objective, problem, findings, clean, adversarial,
        run=None if run is None else str(run.path), warnings=warnings, drive=drive,
        shared=SharedWork.of_facts(journal.traced.facts, journal.machines.known),
        seconds={**stages.seconds, "total": stages.total},
    )  # fmt: skip
    if run is not None:
        run.write_summary(summary)
        write_text(run.path / REPORT, attack_page(run.path, summary), durable=False)
        if not findings.interrupted:
            run.finish()
    return AttackResult(
        summary,
        None if run is None else run.path,
        u,
        clean.picture,
        adversarial.picture,
        artifacts,
        search,
        tuple(journal.rows),
    )


# ---- the summary ----------------------------------------------------------------------------------------------------


def _summary(
    config: AttackConfig,
    objective: str | None,
    problem: Problem,
    findings: Findings,
    clean: KeptPicture,
    adversarial: KeptPicture,
    **kept: Any,
) -> AttackSummary:
    """The summary, of which some fields are `kept` as they are given."""
    task, search, baseline = problem.task, findings.search, findings.baseline
    controls = problem.searched_space.controls
    budgets = {bound.name: bound.budget for bound in controls}
    depth = problem.renderer.scene.max_depth
    count = findings.sample_count
    ending = Ending.INTERRUPTED
    if not findings.interrupted and findings.verification is not None:
        ending = findings.verification.ending
    elif not findings.interrupted and findings.clean:
        if problem.rule.already_wrong(count_right(findings.clean, findings.spp)):
            ending = Ending.ALREADY_WRONG
    distribution = search.distribution if search else None
    if distribution is not None and distribution.mean.numel() > MOST_NUMBERS:
        distribution = None
    return AttackSummary(
        **kept,
        object=config.object,
        judge=config.judge,
        model=problem.model.name,
        task=task.title,
        environment=problem.environment,
        controls=list(budgets),
        policy=config.policy_name,
        objective=objective or task.objective,
        epsilon=_alone({name: budget.epsilon for name, budget in budgets.items()}),
        norm=_alone({name: budget.norm for name, budget in budgets.items()}),
        label_set=list(task.truth_names(problem.truth())),
        goal=task.goal,
        target=list(task.target_names) or None,
        over=[bound.name for bound in problem.space.controls[len(controls) :]],
        conditions=_conditions(problem),
        ending=ending.value,
        image_formation=Formation.of(problem.renderer.formation),
        gradient_plan=problem.plan_summary(problem.plan),
        light_path_segments=results.PathSegments(search=problem.search_depth or depth, verification=depth),
        clean=results.CleanPrediction(
            **_prediction(clean),
            correct=clean.judgement.right,
            moved=[MovedValue.of(value) for value in problem.space.moved],
            control=control_group(findings.clean, findings.spp) if findings.clean else None,
        ),
        adversarial=None if search is None else results.PicturedPrediction(**_prediction(adversarial)),
        verified=_verified(findings.verification),
        tried_objective=results.TriedObjective(
            clean=_objective_over(findings.clean),
            answer=_objective_over(findings.verification.adversarial_trials if findings.verification else ()),
        ),
        baseline=None
        if baseline is None
        else results.BaselineSearch(
            policy="random",
            renders=baseline.renders * problem.draws,
            verified=_verified(findings.baseline_verification),
        ),
        answer_from="random" if findings.beaten is not None else None,
        policy_verified=_verified(findings.beaten),
        ambient=_ambient(findings) if findings.ambient else None,
        average=_average(findings) if findings.average else None,
        smallest=None if findings.smallest is None else _smallest(findings.smallest, problem),
        printability=_printability(problem, findings) if config.printable else None,
        distribution=None
        if distribution is None
        else results.SearchDistribution(
            mean=_described(problem, distribution.mean), deviation=distribution.deviation.tolist()
        ),
        failures=described_failures(problem, findings),
        transport=transport_of(findings),
        sample_count=None if count is None else results.VerificationSamples(spp=count.spp, converged=count.converged),
        claimed=None
        if search is None
        else results.SearchClaim(
            objective=search.claimed_objective, re_evaluated=search.best_objective, success_rate=search.success_rate
        ),
        gradients=None if search is None else _gradients(search),
        configuration=None if search is None else _found_values(problem, search.best_u),
        renders=_renders(findings, problem),
        steps=len(search.history) if search else 0,
        non_finite=results.NotFinite(
            objectives=search.non_finite_objectives if search else 0,
            gradient_elements=search.non_finite_elements if search else 0,
        ),
        seed=problem.seed,
        command_line=config.command_line(),
    )


def _ambient(findings: Findings) -> results.AmbientLight:
    tried = sorted(findings.ambient.items())
    points = [
        results.AmbientPoint(lux=lux, holds=checked.ending is Ending.FOUND, verified=verified_rate(checked))
        for lux, checked in tried
    ]
    ends = next((number for number, point in enumerate(points) if not point.holds), len(points))
    return results.AmbientLight(
        lux=points[0].lux,
        holds_to=points[ends - 1].lux,
        ends_at=points[ends].lux if ends < len(points) else None,
        points=points,
    )


def _objective_over(trials: Sequence[Judgement]) -> results.ObjectiveValues | None:
    """The objective over trials; None where it was not asked for, as in those of an older run."""
    values = [trial.objective for trial in trials if trial.objective is not None]
    if not values:
        return None
    spread = statistics.pstdev(values) if all(map(math.isfinite, values)) else math.nan
    return results.ObjectiveValues(mean=mean(values), deviation=spread, low=min(values), high=max(values))


def _printability(problem: Problem, findings: Findings) -> results.Printability:
    """The print terms, and the margin of the adversarial scene beside that of the search without them, if both were
    verified."""
    space, domain = problem.searched_space, problem.domain
    cost = None

    def terms(found: SearchResult) -> PrintTerms:
        return print_terms(space, domain.project(found.best_u))

    verified, other, unprinted = findings.verification, findings.unprinted_verification, findings.unprinted
    if verified is not None and other is not None and unprinted is not None:
        ours, theirs = (verified_rate(checked) for checked in (verified, other))
        cost = results.PrintCost(
            steps=len(unprinted.history),
            margin_with=ours.margin,
            margin_without=theirs.margin,
            cost=ours.margin - theirs.margin,
            verified=theirs,
            terms=terms(unprinted),
        )
    adversarial = None if findings.search is None else terms(findings.search)
    return results.Printability(clean=print_terms(space, domain.start), answer=adversarial, cost=cost)


def _alone(values: dict[str, T]) -> T | dict[str, T]:
    return next(iter(values.values())) if len(values) == 1 else values


def _prediction(shown: KeptPicture) -> dict[str, Any]:
    return {**vars(shown.judgement.prediction), "payload": shown.judgement.payload, "trial": shown.trial}


def _described(problem: Problem, u: Tensor) -> dict[str, DescribedValue]:
    values = problem.describe(problem.domain.project(u))
    return {name: DescribedValue.of(value) for name, value in values.items()}


def _found_values(problem: Problem, u: Tensor) -> dict[str, results.FoundValue]:
    """The adversarial configuration in a few values, each beside the clean scene's and, of a single number, both ends
    of its range."""
    start = problem.domain.start
    single = [group for group in problem.space.groups if group.size == 1 and group.begin < len(start)]
    ends = []
    for end in (0.0, 1.0):
        moved = start.clone()
        moved[[group.begin for group in single]] = end
        ends.append(problem.describe(moved))
    clean, names, found = problem.describe(start), {group.name for group in single}, {}
    for name, value in _described(problem, u).items():
        given: dict[str, object] = {"value": value.value, "unit": value.unit}
        if name in clean and isinstance(clean[name]["value"], (int, float, str)):
            given["clean"] = clean[name]["value"]
        low, high = (described[name]["value"] if name in described else None for described in ends)
        if name in names and isinstance(low, float) and isinstance(high, float) and low < high:
            given |= {"low": low, "high": high}
        found[name] = results.FoundValue.of(given)
    return found


def _conditions(problem: Problem) -> dict[str, VariedValue]:
    """What the conditions are drawn from, of single numbers and names."""
    found: dict[str, VariedValue] = {}
    if problem.conditions is None:
        return found
    start = problem.whole(problem.domain.start)
    for group, (block, _) in zip(problem.space.groups, domain_of(problem.space.controls).parts(), strict=True):
        if group.size != 1 or group.begin < len(problem.domain.start):
            continue
        values, options = [], max(block.options, 1)
        for share in [0.0, 1.0] if not block.options else [(k + 0.5) / options for k in range(options)]:
            moved = start.clone()
            moved[group.begin] = share
            values.append(problem.space.describe(moved).get(group.name))
        listed = [described["value"] for described in values if described is not None]
        unit = next((str(described["unit"]) for described in values if described is not None), "")
        numbers = [float(value) for value in listed if isinstance(value, (int, float))]
        if numbers and not block.options:
            found[group.name] = VariedValue(unit=unit, low=min(numbers), high=max(numbers))
        elif listed:
            found[group.name] = VariedValue(unit=unit, names=[number_text(value) for value in dict.fromkeys(listed)])
    return found


def transport_of(findings: Findings) -> LinearTransport:
    """Return what predicted the pictures of the searches, and how far it was off; or why nothing did."""
    transport = findings.transport
    if transport is None:
        return LinearTransport(used=False, reason=findings.rendered_because or "nothing was searched")
    said = transport.summary()
    return said.model_copy(update={"reason": said.reason or findings.surface_refused or None})


def _renders(findings: Findings, problem: Problem) -> dict[str, int]:
    """How many pictures each part took, and how many were predicted instead."""
    transport, searches = findings.transport, {"search": findings.search, "baseline": findings.baseline}
    searches[UNPRINTED] = findings.unprinted
    predicted = {
        kind: transport.predicted(kind, len(one.history)) * problem.draws if one and transport else 0
        for kind, one in searches.items()
    }
    rendered = {kind: one.renders * problem.draws - predicted[kind] if one else 0 for kind, one in searches.items()}
    gradients = {kind: max(0, one.gradients - predicted[kind]) if one else 0 for kind, one in searches.items()}
    unprinted = {} if findings.unprinted is None else {"unprinted": rendered[UNPRINTED] + gradients[UNPRINTED]}
    return {
        "search": rendered["search"] + (transport.traced if transport else 0),
        "gradient": gradients["search"],
        "baseline": rendered["baseline"],
        "verification": findings.verification_renders + len(findings.first_look),
        "products": sum(predicted.values()),
        **unprinted,
    }


def _gradients(search: SearchResult) -> results.SearchGradients:
    """What the search saw of its gradients, and what its policy did about them and about steps that failed."""
    norms = [record.gradient_norm for record in search.history if record.objective == record.objective]
    return results.SearchGradients(
        count=search.gradients,
        cosine_with_the_one_before=statistics.median(search.agreement) if search.agreement else None,
        zero=sum(norm == 0.0 for norm in norms),
        **vars(search.counts),
    )


def _average(findings: Findings) -> AverageCase:
    shown = [trial for trial in findings.average if trial.prediction.label != OUT_OF_VIEW] or findings.average
    counted = count_right(shown, findings.spp)
    scores = [trial.score for trial in shown]
    return AverageCase(
        configurations=counted.trials,
        correct=counted.successes,
        accuracy=counted.rate,
        interval=counted.interval,
        margin=0.0 - mean_number(scores),
        worst_margin=0.0 - max((score for score in scores if score == score), default=math.nan),
    )


def _smallest(bracket: Bracket, problem: Problem) -> results.SmallestEpsilon:
    budgets = {bound.name: float(bound.budget.epsilon or 0.0) for bound in problem.searched_space.controls}
    flips = bracket.u is not None
    return results.SmallestEpsilon(
        epsilon={name: bracket.high * epsilon for name, epsilon in budgets.items()} if flips else None,
        not_found_at={name: bracket.low * epsilon for name, epsilon in budgets.items()} if bracket.low else None,
        closed=bracket.closed,
        confirmed=bracket.confirmed,
        searches=bracket.searches,
        checks=bracket.checks,
    )


def _verified(verification: Verification | None) -> VerifiedRate | None:
    return None if verification is None else verified_rate(verification)


def _remarks(findings: Findings, problem: Problem, journal: Journal) -> list[str]:
    remarks = [told] if (told := remark(findings.rendered_because)) else []
    count = findings.sample_count
    if count is not None and count.table and not count.converged:
        more = f"It is not shown that more than {count.spp} samples a pixel"
        told = f"{more}, the most that a check takes, would leave the margin on its side: noise may decide the verdict."
        if problem.conditions is not None:
            told = (
                f"{more} would leave the rate within {100 * MOVED:.0f} points. A check takes no more than "
                f"{OVER_LADDER[-1]}, and {MOST_TIMES} times the samples of the searches; `verify_spp` asks for more."
            )
        remarks.append(told)
    searches = [search.non_finite_elements for search in (findings.search, findings.baseline) if search is not None]
    if not_finite := max(problem.renderer.non_finite, sum(searches)):  # what predicts pictures has no such count
        remarks.append(f"{not_finite} values of pictures or gradients were not finite and were set to 0.")
    return [*remarks, *lost_remarks(journal.lost), *journal.machines.remarks]


def write_failures(run: RunDirectory, problem: Problem, findings: Findings) -> None:
    """Write a picture of each failure that was tried, as the model saw it in its first trial."""
    for number, checked in enumerate(findings.failures):
        save_trial(run, problem, findings, (f"failure {number}", 0), _picture(number), checked.u)


def described_failures(problem: Problem, findings: Findings) -> results.DifferentFailures | None:
    """Return what a summary says of the different failures; None of a policy that looks for one."""
    known = findings.search.failures if findings.search else None
    if known is None:
        return None
    listed = [_described_failure(problem, findings, number, failure) for number, failure in enumerate(known.listed)]
    return results.DifferentFailures(
        over=[problem.domain.names[place] for place in known.over],
        found=known.found,
        seen=known.seen,
        places=known.places,
        share=None if known.share is None else results.FailingShare.of(known.share),
        tried=len(findings.failures),
        held=sum(checked.ending is Ending.FOUND for checked in findings.failures),
        listed=listed,
    )


def _described_failure(
    problem: Problem, findings: Findings, number: int, failure: FoundFailure
) -> results.DifferentFailure:
    checked = findings.failures[number] if number < len(findings.failures) else None
    names, ranges, first = problem.domain.names, failure.ranges, checked.adversarial_trials[0] if checked else None
    return results.DifferentFailure(
        ranges={names[place]: _range(problem, failure.u, place, ends) for place, ends in ranges.items()},
        configuration={name: DescribedValue.of(value) for name, value in problem.describe(failure.u).items()},
        objective=failure.objective,
        holds=None if checked is None else checked.ending is Ending.FOUND,
        verified=None if checked is None else verified_rate(checked),
        picture=None if checked is None else f"images/{_picture(number)}.png",
        pictured=None
        if first is None
        else PicturedPrediction(**vars(first.prediction), payload=first.payload, trial=0),
    )


def _picture(number: int) -> str:
    return f"failure-{number:02d}"


def _range(problem: Problem, u: Tensor, place: int, ends: tuple[float, float]) -> tuple[float, float] | str:
    """Return both ends of one element of u in its parameter's unit, the option of a choice; in u where it is not told
    by itself."""
    block, said = problem.domain.block_of(place), list[float]()
    for end in ends:
        moved = u.clone()
        moved[place] = u[place] if block.options else end
        value = problem.describe(moved).get(block.name, {"value": end, "unit": "1"})["value"]
        if isinstance(value, str):
            return value
        said.append(float(value) if block.size == 1 else end)
    return min(said), max(said)
