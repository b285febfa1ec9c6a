"""From what an attack found to its summary, its pictures and its files."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any, TypeVar

from torch import Tensor

from advsearch.attacks import Ending, SearchResult, count_right
from advsearch.attacks.trials import MOST_TIMES, MOVED, OVER_LADDER
from advsearch.engine.journal import Journal
from advsearch.engine.judging import domain_of, print_terms
from advsearch.engine.problem import Problem
from advsearch.engine.record import Findings, Stages, control_group, lost_remarks, mean_number, verified_rate
from advsearch.engine.transport import remark
from advsearch.options import OUT_OF_VIEW, Value
from advsearch.questions.attack import result as kept
from advsearch.questions.attack.result import AttackResult, KeptPicture
from advsearch.questions.attack.stages import UNPRINTED
from advsearch.questions.attack.summary import AttackSummary, DifferentFailures
from advsearch.report.wording import number_text
from advsearch.runs.results import LinearTransport, SharedWork, VariedValue
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
    command_line: str,
) -> AttackResult:
    """Make the result of an attack from what it found, and store it with its images in the run, if there is one.

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
        command_line: repeats the attack.
    """
    problem, search, run = journal.problem, findings.search, journal.run
    space, start = problem.searched_space, problem.domain.start
    u = start if search is None else problem.domain.project(search.best_u)
    stages.progress.stage("making the pictures and the report")
    trial = None if findings.interrupted else kept.trial_to_show(findings)  # whoever presses Ctrl-C is in a hurry
    clean, adversarial = (KeptPicture.of(problem, findings, at, trial) for at in (start, u))
    artifacts = space.artifacts(u)
    if run is not None:
        kept.write_pictures(run, problem, findings, {"clean": clean, "adversarial": adversarial})
        for number, checked in enumerate(findings.failures):
            kept.save_trial(run, problem, findings, (f"failure {number}", 0), _picture(number), checked.u)
        for name, picture in artifacts.items():  # an 8-bit PNG, and the same display-referred values in float32
            run.save_image(name, picture, folder="artifacts")
            run.save_exr(name, picture, folder="artifacts")
        kept.write_object(run, problem, u)
        for name, data in space.files(u).items():
            write_bytes(run.path / "artifacts" / name, data)
        write_configuration(run.path, u.numpy())
    searched = None if search is None else u
    drive = None if findings.interrupted else kept.along_drive(problem, searched, findings.spp, run)
    summary = AttackSummary.of(
        {
            "run": None if run is None else str(run.path),
            "object": object_name,
            "judge": judge,
            "policy": policy,
            "command_line": command_line,
            "objective": name_objective(problem.task, objective),
            "warnings": [*warnings, *_remarks(findings, problem, journal)],
            "drive": drive,
            "shared": SharedWork.of_facts(journal.traced.facts, journal.machines),
            "seconds": {**stages.seconds, "total": stages.total},
            **_asked(problem),
            **_seen(problem, findings, clean, adversarial),
            "printability": _printability(problem, findings) if printable else None,
        }
    )
    if run is not None:
        keep_result(run, summary)
        if not findings.interrupted:
            run.store.forget()
    path = None if run is None else run.path
    return AttackResult(
        summary, path, u, clean.picture, adversarial.picture, artifacts, search, in_memory=tuple(journal.rows)
    )


# ---- the summary, whose fields are attributes of what was found, where both have one name ---------------------------


def _asked(problem: Problem) -> dict[str, object]:
    task, controls, depth = problem.task, problem.searched_space.controls, problem.renderer.scene.max_depth
    return {
        "model": problem.model.name,
        "task": task.title,
        "environment": problem.environment,
        "controls": [bound.name for bound in controls],
        "epsilon": _alone({bound.name: bound.budget.epsilon for bound in controls}),
        "norm": _alone({bound.name: bound.budget.norm for bound in controls}),
        "label_set": list(task.truth_names(problem.truth())),
        "goal": task.goal,
        "target": list(task.target_names) or None,
        "over": [bound.name for bound in problem.space.controls[len(controls) :]],
        "conditions": _conditions(problem),
        "image_formation": problem.renderer.formation,
        "gradient_plan": problem.plan_summary(problem.plan),
        "light_path_segments": {"search": problem.search_depth or depth, "verification": depth},
        "seed": problem.seed,
    }


def _alone(values: dict[str, T]) -> T | dict[str, T]:
    return next(iter(values.values())) if len(values) == 1 else values


def _seen(problem: Problem, findings: Findings, clean: KeptPicture, adversarial: KeptPicture) -> dict[str, object]:
    baseline, checked, bracket = findings.baseline, findings.verification, findings.smallest
    ending = Ending.INTERRUPTED
    if not findings.interrupted and checked is not None:
        ending = checked.ending
    elif not findings.interrupted and findings.clean:
        if problem.rule.already_wrong(count_right(findings.clean, findings.spp)):
            ending = Ending.ALREADY_WRONG
    seen: dict[str, object] = {
        "ending": ending.value,
        "clean": {
            **_prediction(clean.judgement, clean.trial),
            "correct": clean.judgement.right,
            "moved": problem.space.moved,
            "control": control_group(findings.clean, findings.spp) if findings.clean else None,
        },
        "verified": checked and verified_rate(checked),
        "tried_objective": {
            "clean": _objective_over(findings.clean),
            "answer": _objective_over(checked.adversarial_trials if checked else ()),
        },
        "answer_from": "random" if findings.beaten is not None else None,
        "policy_verified": findings.beaten and verified_rate(findings.beaten),
        "failures": described_failures(problem, findings),
        "transport": transport_of(findings),
        "sample_count": findings.sample_count,
        "renders": _renders(findings, problem),
        **_searched(problem, findings.search, adversarial),
    }
    if baseline is not None:
        rate = findings.baseline_verification and verified_rate(findings.baseline_verification)
        seen["baseline"] = {"policy": "random", "renders": baseline.renders * problem.draws, "verified": rate}
    if findings.ambient:
        points: list[dict[str, Any]] = [
            {"lux": lux, "holds": tried.ending is Ending.FOUND, "verified": verified_rate(tried)}
            for lux, tried in sorted(findings.ambient.items())
        ]
        ends = next((number for number, point in enumerate(points) if not point["holds"]), len(points))
        ends_at = points[ends]["lux"] if ends < len(points) else None
        holds_to = points[ends - 1]["lux"]
        seen["ambient"] = {"lux": points[0]["lux"], "holds_to": holds_to, "ends_at": ends_at, "points": points}
    if findings.average:
        inside = [trial for trial in findings.average if trial.prediction.label != OUT_OF_VIEW] or findings.average
        counted, scores = count_right(inside, findings.spp), [trial.score for trial in inside]
        seen["average"] = {
            "configurations": counted.trials,
            "correct": counted.successes,
            "accuracy": counted.rate,
            "interval": counted.interval,
            "margin": 0.0 - mean_number(scores),
            "worst_margin": 0.0 - max((score for score in scores if score == score), default=math.nan),
        }
    if bracket is not None:
        of = {bound.name: float(bound.budget.epsilon or 0.0) for bound in problem.searched_space.controls}
        low, high = ({name: times * epsilon for name, epsilon in of.items()} for times in (bracket.low, bracket.high))
        seen["smallest"] = {
            "epsilon": None if bracket.u is None else high,
            "not_found_at": low if bracket.low else None,
            **{name: getattr(bracket, name) for name in ("closed", "confirmed", "searches", "checks")},
        }
    return seen


def _searched(problem: Problem, search: SearchResult | None, adversarial: KeptPicture) -> dict[str, object]:
    if search is None:
        return {"adversarial": None, "steps": 0, "non_finite": {"objectives": 0, "gradient_elements": 0}}
    norms = [record.gradient_norm for record in search.history if record.objective == record.objective]
    searched: dict[str, object] = {
        "adversarial": _prediction(adversarial.judgement, adversarial.trial),
        "configuration": _found_values(problem, search.best_u),
        "claimed": {
            "objective": search.claimed_objective,
            "re_evaluated": search.best_objective,
            "success_rate": search.success_rate,
        },
        "steps": len(search.history),
        "gradients": {
            "count": search.gradients,
            "cosine_with_the_one_before": statistics.median(search.agreement) if search.agreement else None,
            "zero": sum(norm == 0.0 for norm in norms),
            **vars(search.counts),
        },
        "non_finite": {
            "objectives": search.non_finite_objectives,
            "gradient_elements": search.non_finite_elements,
        },
    }
    if (distribution := search.distribution) is not None and distribution.mean.numel() <= MOST_NUMBERS:
        middle = problem.describe(problem.domain.project(distribution.mean))
        searched["distribution"] = {"mean": middle, "deviation": distribution.deviation.tolist()}
    return searched


def name_objective(task: Task, objective: str | None) -> str:
    """Name what a search maximised: a task's own score has the name of the goal that the task seeks.

    "vanish" is what "score" means to a detector without a goal, so it stays "score".
    """
    named = objective or task.objective
    goal = getattr(task, "seek", "")
    if named == Task.objective and goal not in ("", Detection.seek):
        return str(goal)
    return named


def _objective_over(trials: Sequence[Judgement]) -> dict[str, float] | None:
    """Return mean, deviation and range of the objective over trials; None where there are none."""
    values = [trial.objective for trial in trials if trial.objective is not None]
    if not values:
        return None
    spread = statistics.pstdev(values) if all(map(math.isfinite, values)) else math.nan
    return {"mean": mean(values), "deviation": spread, "low": min(values), "high": max(values)}


def _printability(problem: Problem, findings: Findings) -> dict[str, object]:
    at = {"clean": problem.domain.start}
    for name, search in (("with", findings.search), ("without", findings.unprinted)):
        if search is not None:
            at[name] = problem.domain.project(search.best_u)
    terms = {name: print_terms(problem.searched_space, u) for name, u in at.items()}
    cost, verified, other = None, findings.verification, findings.unprinted_verification
    if verified is not None and other is not None and findings.unprinted is not None:
        rate, unprinted = verified_rate(verified), verified_rate(other)
        cost = {
            "steps": len(findings.unprinted.history),
            "margin_with": rate.margin,
            "margin_without": unprinted.margin,
            "cost": rate.margin - unprinted.margin,
            "verified": unprinted,
            "terms": terms["without"],
        }
    return {"clean": terms["clean"], "answer": terms.get("with"), "cost": cost}


def _prediction(judgement: Judgement, trial: int | None) -> dict[str, Any]:
    return {**vars(judgement.prediction), "payload": judgement.payload, "trial": trial}


def _found_values(problem: Problem, u: Tensor) -> dict[str, dict[str, object]]:
    """The adversarial configuration, each value beside the clean one and, of a single number, the ends of its range."""
    start = problem.domain.start
    single = {group.name: group.begin for group in problem.space.groups if group.size == 1 and group.begin < len(start)}
    ends = []
    for end in (0.0, 1.0):
        moved = start.clone()
        moved[[*single.values()]] = end
        ends.append(problem.describe(moved))
    clean, values = problem.describe(start), dict[str, dict[str, object]]()
    for name, described in problem.describe(problem.domain.project(u)).items():
        values[name] = {**described}
        if name in clean and isinstance(clean[name]["value"], (int, float, str)):
            values[name]["clean"] = clean[name]["value"]
        low, high = (at[name]["value"] if name in at else None for at in ends)
        if name in single and isinstance(low, float) and isinstance(high, float) and low < high:
            values[name] |= {"low": low, "high": high}
    return values


def _conditions(problem: Problem) -> dict[str, VariedValue]:
    varied: dict[str, VariedValue] = {}
    if problem.conditions is None:
        return varied
    start = problem.whole(problem.domain.start)
    for group, (block, _) in zip(problem.space.groups, domain_of(problem.space.controls).parts(), strict=True):
        if group.size != 1 or group.begin < len(problem.domain.start):
            continue
        described = list[Value]()
        for share in [(k + 0.5) / block.options for k in range(block.options)] or [0.0, 1.0]:
            moved = start.clone()
            moved[group.begin] = share
            described += filter(None, [problem.space.describe(moved).get(group.name)])
        if not described:
            continue
        values, unit = [value["value"] for value in described], str(described[0]["unit"])
        numbers = [float(value) for value in values if isinstance(value, (int, float))]
        if numbers and not block.options:
            varied[group.name] = VariedValue(unit=unit, low=min(numbers), high=max(numbers))
        else:
            varied[group.name] = VariedValue(unit=unit, names=[number_text(value) for value in dict.fromkeys(values)])
    return varied


def transport_of(findings: Findings) -> LinearTransport:
    """Return what predicted the pictures of the searches, and how far it was off; or why nothing did."""
    if findings.transport is None:
        return LinearTransport(used=False, reason=str(findings.rendered_because or "nothing was searched"))
    predicted = findings.transport.summary()
    surface_refused = str(findings.surface_refused) if findings.surface_refused else None
    return predicted.model_copy(update={"reason": predicted.reason or surface_refused})


def _renders(findings: Findings, problem: Problem) -> dict[str, int]:
    transport = findings.transport
    spent = dict.fromkeys(("search", "gradient", "baseline", "verification", "products"), 0)
    spent["verification"] = findings.verification_renders + len(findings.first_look)
    searches = {"search": findings.search, "baseline": findings.baseline, UNPRINTED: findings.unprinted}
    for kind, search in searches.items():
        if search is None:
            continue
        predicted = transport.predicted(kind, len(search.history)) * problem.draws if transport else 0
        rendered, gradients = search.renders * problem.draws - predicted, max(0, search.gradients - predicted)
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
            more += ", the most that a check takes, would leave the margin on its side: noise may decide the verdict."
        else:
            more += (
                f" would leave the rate within {100 * MOVED:.0f} points. A check takes no more than "
                f"{OVER_LADDER[-1]}, and {MOST_TIMES} times the samples of the searches; `verify_spp` asks for more."
            )
        remarks.append(more)
    searches = [search.non_finite_elements for search in (findings.search, findings.baseline) if search is not None]
    if not_finite := max(problem.renderer.non_finite, sum(searches)):  # what predicts pictures has no such count
        remarks.append(f"{not_finite} values of pictures or gradients were not finite and were set to 0.")
    return [*remarks, *lost_remarks(journal.lost), *journal.remarks]


def described_failures(problem: Problem, findings: Findings) -> DifferentFailures | None:
    known = findings.search.failures if findings.search else None
    if known is None:
        return None
    listed = []
    for number, failure in enumerate(known.listed):
        ranges: dict[str, object] = {}  # both ends in the parameter's unit, else in u; of a choice its option
        for place, ends in failure.ranges.items():
            block, values = problem.domain.block_of(place), list[Any]()
            for end in ends:
                moved = failure.u.clone()
                moved[place] = failure.u[place] if block.options else end
                value = problem.describe(moved).get(block.name)
                values.append(end if value is None else value["value"])
            options = [value for value in values if isinstance(value, str)]
            numbers = values if block.size == 1 else ends
            ranges[problem.domain.names[place]] = options[0] if options else (min(numbers), max(numbers))
        described = {"ranges": ranges, "configuration": problem.describe(failure.u), "objective": failure.objective}
        described |= {"holds": None, "verified": None, "picture": None}
        if number < len(findings.failures):
            checked = findings.failures[number]
            described |= {"holds": checked.ending is Ending.FOUND, "verified": verified_rate(checked)}
            described |= {"picture": f"images/{_picture(number)}.png"}
            described |= {"pictured": _prediction(checked.adversarial_trials[0], 0)}
        listed.append(described)
    return DifferentFailures.of(
        {
            **vars(known),
            "over": [problem.domain.names[place] for place in known.over],
            "tried": len(findings.failures),
            "held": sum(checked.ending is Ending.FOUND for checked in findings.failures),
            "listed": listed,
        }
    )


def _picture(number: int) -> str:
    return f"failure-{number:02d}"
