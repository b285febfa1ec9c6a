"""From what an attack found to its summary, its pictures and its files."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any, TypeVar

from torch import Tensor

from advsearch.attacks import Ending, SearchResult, count_right
from advsearch.attacks.candidates import Bracket, FoundFailure
from advsearch.attacks.trials import MOST_TIMES, MOVED, OVER_LADDER
from advsearch.described import OUT_OF_VIEW, Value
from advsearch.engine.journal import Journal
from advsearch.engine.judging import domain_of, print_terms
from advsearch.engine.problem import Problem
from advsearch.engine.record import Findings, Stages, control_group, lost_remarks, mean_number, verified_rate
from advsearch.engine.transport import remark
from advsearch.questions.attack.result import (
    AttackResult,
    KeptPicture,
    along_drive,
    save_trial,
    trial_to_show,
    write_object,
    write_pictures,
)
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.stages import UNPRINTED
from advsearch.questions.attack.summary import (
    AmbientPoint,
    AttackSummary,
    DifferentFailures,
    FoundValue,
    ObjectiveValues,
    Printability,
    PrintCost,
)
from advsearch.report.wording import number_text
from advsearch.runs.files import write_bytes
from advsearch.runs.results import AverageCase, LinearTransport, SharedWork, VariedValue
from advsearch.runs.summary import write_configuration
from advsearch.tasks import Judgement
from advsearch.tasks.base import mean
from advsearch.viewer.pages import keep_result

T = TypeVar("T")
MOST_NUMBERS = 4096  # Numbers of a distribution that a summary names, at most


def summarise(
    config: AttackConfig,
    objective: str | None,
    findings: Findings,
    journal: Journal,
    stages: Stages,
    warnings: Sequence[str],
) -> AttackResult:
    """Put the result together and, if there is a run directory, write its files."""
    problem, search, run = journal.problem, findings.search, journal.run
    space, start = problem.searched_space, problem.domain.start
    u = start if search is None else problem.domain.project(search.best_u)
    stages.progress.stage("making the pictures and the report")
    trial = None if findings.interrupted else trial_to_show(findings)  # whoever presses Ctrl-C is in a hurry
    clean, adversarial = (KeptPicture.of(problem, findings, at, trial) for at in (start, u))
    artifacts = space.artifacts(u)
    if run is not None:
        write_pictures(run, problem, findings, {"clean": clean, "adversarial": adversarial})
        for number, checked in enumerate(findings.failures):
            save_trial(run, problem, findings, (f"failure {number}", 0), _picture(number), checked.u)
        for name, picture in artifacts.items():  # an 8-bit PNG, and the same display-referred values in float32
            run.save_image(name, picture, folder="artifacts")
            run.save_exr(name, picture, folder="artifacts")
        write_object(run, problem, u)
        for name, data in space.files(u).items():
            write_bytes(run.path / "artifacts" / name, data)
        write_configuration(run.path, u.numpy())
    drive = None if findings.interrupted else along_drive(problem, None if search is None else u, findings.spp, run)
    summary = AttackSummary.of(
        {
            "run": None if run is None else str(run.path),
            "object": config.object,
            "judge": config.judge,
            "policy": config.policy_name,
            "command_line": config.command_line(),
            "objective": objective or problem.task.objective,
            "warnings": [*warnings, *_remarks(findings, problem, journal)],
            "drive": drive,
            "shared": SharedWork.of_facts(journal.traced.facts, journal.machines),
            "seconds": {**stages.seconds, "total": stages.total},
            **_asked(problem),
            **_seen(problem, findings, clean, adversarial),
            "printability": _printability(problem, findings) if config.printable else None,
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
    task, controls = problem.task, problem.searched_space.controls
    depth = problem.renderer.scene.max_depth
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


def _seen(problem: Problem, findings: Findings, clean: KeptPicture, adversarial: KeptPicture) -> dict[str, object]:
    """What a summary says of the findings; of what was not reached, that there is nothing."""
    search, baseline, checked = findings.search, findings.baseline, findings.verification
    ending = Ending.INTERRUPTED
    if not findings.interrupted and checked is not None:
        ending = checked.ending
    elif not findings.interrupted and findings.clean:
        if problem.rule.already_wrong(count_right(findings.clean, findings.spp)):
            ending = Ending.ALREADY_WRONG
    control = control_group(findings.clean, findings.spp) if findings.clean else None
    return {
        "ending": ending.value,
        "clean": {
            **_prediction(clean.judgement, clean.trial),
            "correct": clean.judgement.right,
            "moved": problem.space.moved,
            "control": control,
        },
        "verified": checked and verified_rate(checked),
        "tried_objective": {
            "clean": _objective_over(findings.clean),
            "answer": _objective_over(checked.adversarial_trials if checked else ()),
        },
        "baseline": baseline
        and {
            "policy": "random",
            "renders": baseline.renders * problem.draws,
            "verified": findings.baseline_verification and verified_rate(findings.baseline_verification),
        },
        "answer_from": "random" if findings.beaten is not None else None,
        "policy_verified": findings.beaten and verified_rate(findings.beaten),
        "ambient": _ambient(findings) if findings.ambient else None,
        "average": _average(findings) if findings.average else None,
        "smallest": findings.smallest and _smallest(findings.smallest, problem),
        "failures": described_failures(problem, findings),
        "transport": transport_of(findings),
        "sample_count": findings.sample_count,
        "renders": _renders(findings, problem),
        **_searched(problem, search, adversarial),
    }


def _searched(problem: Problem, search: SearchResult | None, adversarial: KeptPicture) -> dict[str, object]:
    """What a summary says of the search: what it found and claims, and what it saw of gradients."""
    if search is None:
        return {"adversarial": None, "steps": 0, "non_finite": {"objectives": 0, "gradient_elements": 0}}
    norms = [record.gradient_norm for record in search.history if record.objective == record.objective]
    distribution = search.distribution
    if distribution is not None and distribution.mean.numel() > MOST_NUMBERS:
        distribution = None
    return {
        "adversarial": _prediction(adversarial.judgement, adversarial.trial),
        "configuration": _found_values(problem, search.best_u),
        "claimed": {
            "objective": search.claimed_objective,
            "re_evaluated": search.best_objective,
            "success_rate": search.success_rate,
        },
        "distribution": distribution
        and {
            "mean": problem.describe(problem.domain.project(distribution.mean)),
            "deviation": distribution.deviation.tolist(),
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


def _ambient(findings: Findings) -> dict[str, object]:
    points = [
        AmbientPoint(lux=lux, holds=checked.ending is Ending.FOUND, verified=verified_rate(checked))
        for lux, checked in sorted(findings.ambient.items())
    ]
    ends = next((number for number, point in enumerate(points) if not point.holds), len(points))
    ends_at = points[ends].lux if ends < len(points) else None
    return {"lux": points[0].lux, "holds_to": points[ends - 1].lux, "ends_at": ends_at, "points": points}


def _objective_over(trials: Sequence[Judgement]) -> ObjectiveValues | None:
    """None where it was not asked for, as in trials of an older run."""
    values = [trial.objective for trial in trials if trial.objective is not None]
    if not values:
        return None
    spread = statistics.pstdev(values) if all(map(math.isfinite, values)) else math.nan
    return ObjectiveValues(mean=mean(values), deviation=spread, low=min(values), high=max(values))


def _printability(problem: Problem, findings: Findings) -> Printability:
    """The print terms, and the margin beside that of the search without them, if both were verified."""
    terms = {
        name: print_terms(problem.searched_space, problem.domain.project(search.best_u))
        for name, search in (("with", findings.search), ("without", findings.unprinted))
        if search is not None
    }
    cost, verified, other = None, findings.verification, findings.unprinted_verification
    if verified is not None and other is not None and findings.unprinted is not None:
        rate, unprinted = verified_rate(verified), verified_rate(other)
        cost = PrintCost(
            steps=len(findings.unprinted.history),
            margin_with=rate.margin,
            margin_without=unprinted.margin,
            cost=rate.margin - unprinted.margin,
            verified=unprinted,
            terms=terms["without"],
        )
    clean = print_terms(problem.searched_space, problem.domain.start)
    return Printability(clean=clean, answer=terms.get("with"), cost=cost)


def _alone(values: dict[str, T]) -> T | dict[str, T]:
    return next(iter(values.values())) if len(values) == 1 else values


def _prediction(judgement: Judgement, trial: int | None) -> dict[str, Any]:
    return {**vars(judgement.prediction), "payload": judgement.payload, "trial": trial}


def _found_values(problem: Problem, u: Tensor) -> dict[str, FoundValue]:
    """The adversarial configuration, each value beside the clean one and, of a single number, the ends of its range."""
    start = problem.domain.start
    single = {group.name: group.begin for group in problem.space.groups if group.size == 1 and group.begin < len(start)}
    ends = []
    for end in (0.0, 1.0):
        moved = start.clone()
        moved[[*single.values()]] = end
        ends.append(problem.describe(moved))
    clean, values = problem.describe(start), {}
    for name, described in problem.describe(problem.domain.project(u)).items():
        more: dict[str, object] = {}
        if name in clean and isinstance(clean[name]["value"], (int, float, str)):
            more["clean"] = clean[name]["value"]
        low, high = (at[name]["value"] if name in at else None for at in ends)
        if name in single and isinstance(low, float) and isinstance(high, float) and low < high:
            more |= {"low": low, "high": high}
        values[name] = FoundValue.of({**described, **more})
    return values


def _conditions(problem: Problem) -> dict[str, VariedValue]:
    """What the conditions are drawn from, of single numbers and names."""
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
        return LinearTransport(used=False, reason=findings.rendered_because or "nothing was searched")
    predicted = findings.transport.summary()
    return predicted.model_copy(update={"reason": predicted.reason or findings.surface_refused or None})


def _renders(findings: Findings, problem: Problem) -> dict[str, int]:
    """How many pictures each part took, and how many were predicted instead."""
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


def _smallest(bracket: Bracket, problem: Problem) -> dict[str, object]:
    def scaled(times: float) -> dict[str, float]:
        return {bound.name: times * float(bound.budget.epsilon or 0.0) for bound in problem.searched_space.controls}

    return {
        "epsilon": None if bracket.u is None else scaled(bracket.high),
        "not_found_at": scaled(bracket.low) if bracket.low else None,
        **{name: getattr(bracket, name) for name in ("closed", "confirmed", "searches", "checks")},
    }


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


# ---- different failures ---------------------------------------------------------------------------------------------


def described_failures(problem: Problem, findings: Findings) -> DifferentFailures | None:
    """Return what a summary says of the different failures; None of a policy that looks for one."""
    known = findings.search.failures if findings.search else None
    if known is None:
        return None
    return DifferentFailures.of(
        {
            **vars(known),
            "over": [problem.domain.names[place] for place in known.over],
            "tried": len(findings.failures),
            "held": sum(checked.ending is Ending.FOUND for checked in findings.failures),
            "listed": [_described_failure(problem, findings, *numbered) for numbered in enumerate(known.listed)],
        }
    )


def _described_failure(problem: Problem, findings: Findings, number: int, failure: FoundFailure) -> dict[str, object]:
    ranges = {
        problem.domain.names[place]: _range(problem, failure.u, place, ends) for place, ends in failure.ranges.items()
    }
    described = {"ranges": ranges, "configuration": problem.describe(failure.u), "objective": failure.objective}
    if number >= len(findings.failures):
        return {**described, "holds": None, "verified": None, "picture": None}
    checked = findings.failures[number]
    return {
        **described,
        "holds": checked.ending is Ending.FOUND,
        "verified": verified_rate(checked),
        "picture": f"images/{_picture(number)}.png",
        "pictured": _prediction(checked.adversarial_trials[0], 0),
    }


def _picture(number: int) -> str:
    return f"failure-{number:02d}"


def _range(problem: Problem, u: Tensor, place: int, ends: tuple[float, float]) -> tuple[float, float] | str:
    """Both ends of one element of u in its parameter's unit, else in u; of a choice its option."""
    block, values = problem.domain.block_of(place), list[float]()
    for end in ends:
        moved = u.clone()
        moved[place] = u[place] if block.options else end
        value = problem.describe(moved).get(block.name, {"value": end, "unit": "1"})["value"]
        if isinstance(value, str):
            return value
        values.append(float(value) if block.size == 1 else end)
    return min(values), max(values)
