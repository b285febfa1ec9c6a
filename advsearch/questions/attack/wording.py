"""An attack in words: its verdict, what was asked and changed, and how it came to its result."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

from advsearch.questions.attack.summary import AttackSummary
from advsearch.report.wording import (
    CLASSIFICATION,
    COMMAND,
    SUCCESS_ABOVE_ZERO,
    calling,
    calls,
    count,
    margin_text,
    number_text,
    objective_name,
    rate_text,
    seconds_text,
    wanted,
    with_article,
)
from advsearch.runs.results import PrintTerms, VerifiedRate

PATH = "path"
"""The control whose conditions are moments."""


NORMS = {"linf": "the largest change of any value", "l2": "the root of the sum of all squared changes"}
"""What these words mean, said where they are first used."""


_REASONS = {
    "budget spent": "The budget is spent.",
    "stalled": "The policy had nothing more to propose.",
    "non-finite objective": "The objective was not a number several times in a row.",
}
"""Why a search ended without finding anything, where the name of the ending doesn't say it."""


def attack_verdict(summary: AttackSummary) -> str:
    """Return what the run found, in one sentence that holds on its own."""
    ending, verified = summary.ending, summary.verified
    thing = f"this {noun(summary)}"
    if ending == "already wrong":
        wrong = calls(summary.task, thing, summary.clean.label)
        return f"The model already {wrong}: nothing was changed and nothing counts as found."
    if verified is None and ending == "interrupted" and summary.adversarial:
        says = calls(summary.task, thing, summary.adversarial.label)
        return (
            f"Interrupted after {count(summary.steps, 'step')}. What was found so far is not verified: the model "
            f"{says}."
        )
    if verified is None:
        return f"{ending[:1].upper()}{ending[1:]} after {count(summary.steps, 'step')}; nothing is verified."
    rate = rate_text(verified) + another_text(summary.over, several_paths(summary))
    claim = _claim(summary, thing)
    if ending == "found":
        return f"{_how_it_errs(summary, verified, thing)} in {rate}.{_as_random(summary)}"
    if ending == "interrupted":
        return f"Interrupted; so far {claim} in {rate}."
    if ending == "not verified":
        return f"The search claims a wrong prediction that is not confirmed: {claim} in {rate}."
    why = _REASONS.get(ending, f"The search ended: {ending}.")
    return f"No change of {budget_text(summary)} was found that {_wanted(summary, thing)}: {claim} in {rate}. {why}"


def _as_random(summary: AttackSummary) -> str:
    """Return that the search did nothing that random search does not do, as a sentence; nothing where it did."""
    ours, random = summary.verified, summary.baseline.verified if summary.baseline else None
    if summary.answer_from == "random":
        return " Random search found it, and the policy nothing as bad."
    alike = ours is not None and random is not None and random.rate >= ours.rate > 0
    return " Random search finds as much." if alike else ""


def several_paths(summary: AttackSummary) -> bool:
    """Whether each trial draws one of several paths."""
    return summary.drive is not None and len(summary.drive.paths) > 1


def another_text(over: Sequence[str], paths: bool = False) -> str:
    """Return what is another one in each trial: ``, each with another camera``; of a path it is the moment, and where
    there are several `paths`, which one it is."""
    others = [name for name in over if name != PATH]
    said = [f"with another {' and '.join(others)}"] if others else []
    if PATH in over:
        said.append("on one of several paths, at another moment" if paths else "at another moment of the path")
    return f", each {' and '.join(said)}" if said else ""


def remarks(summary: AttackSummary) -> list[str]:
    """Return what has to be known beside the verdict: the control group, the random search, the run's warnings."""
    said = []
    control, own = summary.clean.control, summary.policy_verified
    missed = control.trials - control.correct if control else 0
    if control and missed and summary.ending != "already wrong" and not summary.minimises:
        apart = " They do not count." if summary.over else ""
        nothing = f"; in {control.not_a_number} the output is not a number" if control.not_a_number else ""
        said.append(f"The clean scene itself fails {missed} of its {control.trials} trials{nothing}.{apart}")
    if summary.answer_from == "random" and own:
        said.append(
            "The random search beside it found a worse configuration than the policy did "
            f"({own.successes} of {own.trials} with a margin of {own.margin:.2f}); that of the random search is the "
            f"scene. The margin is {margin_text(summary.task)}."
        )
    else:
        said += _against_random(summary)
    return said + summary.warnings


def noun(summary: AttackSummary) -> str:
    """Return what the object, or the thing beside it that is judged, is called: ``wine glass`` for ``wine-glass`` and
    ``mug`` for ``data/mug.obj``."""
    called = PurePath(summary.object).stem if summary.judge in ("object", "all") else summary.judge
    every = " or a thing beside it" if summary.judge == "all" else ""
    return called.replace("-", " ").replace("_", " ") + every


def title(summary: AttackSummary) -> str:
    """Return a short name for the run: ``mug, texture``."""
    return ", ".join([noun(summary), *summary.controls])


def success(summary: AttackSummary) -> str:
    """Return one word for a trial that counts: ``wrong``, ``target`` or ``easier``."""
    return "target" if summary.target else "easier" if summary.minimises else "wrong"


def goal_text(summary: AttackSummary) -> str:
    """Return what was asked for, where it was not just any wrong prediction."""
    if summary.target:
        verb = "command" if summary.task == COMMAND else "predict"
        return f"the model should {verb} {' or '.join(summary.target)}"
    return "easier to recognise" if summary.minimises else ""


def objective_text(summary: AttackSummary) -> str:
    """Return what came of an objective that is no margin, over the trials; empty where there is nothing to say."""
    tried = summary.tried_objective
    if tried is None or summary.objective in SUCCESS_ABOVE_ZERO:
        return ""
    parts = [
        f"{name} {one.mean:.3g} (from {one.low:.3g} to {one.high:.3g})"
        for name, one in (("clean", tried.clean), ("adversarial", tried.answer))
        if one is not None
    ]
    return f"{summary.objective} in the trials: {', '.join(parts)}" if parts else ""


def over_text(summary: AttackSummary) -> str:
    """Return what varied by chance: ``camera and environment, drawn anew for every picture``."""
    return f"{' and '.join(summary.over)}, drawn anew for every picture" if summary.over else ""


def drive_text(summary: AttackSummary) -> str:
    """Return in how many frames of a drive the model is right; empty where none was looked at."""
    drive = summary.drive
    if drive is None:
        return ""
    adversarial = "" if drive.answer is None else f", {drive.answer} of the adversarial one"
    along = f", {len(drive.paths)} paths" if len(drive.paths) > 1 else ""
    return f"right in {drive.clean} of {drive.frames} frames of the clean scene{adversarial}{along}"


def smallest_text(summary: AttackSummary) -> str:
    """Return the bracket of the smallest epsilon; empty if it was not asked for."""
    bracket = summary.smallest
    if bracket is None:
        return ""
    found, below = _epsilons(bracket.epsilon), _epsilons(bracket.not_found_at)
    if not found:
        return f"none found up to {below}"
    floor = f"no search found one at {below}" if below else "no search failed, so it may be smaller still"
    still = "" if bracket.closed or not below else "; the searches did not suffice to bring the two together"
    return f"{found}; {floor}{still}"


def changed_text(summary: AttackSummary) -> str:
    """Return `budget_text` with a word on each norm: ``texture within 0.1 (linf: the largest change of any value)``."""
    text = budget_text(summary)
    for norm, meaning in NORMS.items():
        text = text.replace(f"({norm})", f"({norm}: {meaning})", 1)  # at its first use
    return text


def budget_text(summary: AttackSummary) -> str:
    """Return what could change and how far: ``texture within 0.1 (linf)``."""
    epsilon, norm = summary.epsilon, summary.norm
    if isinstance(epsilon, dict) or isinstance(norm, dict):
        epsilons, norms = (one if isinstance(one, dict) else {} for one in (epsilon, norm))
        return " and ".join(_within(name, epsilons.get(name), norms.get(name)) for name in summary.controls)
    return _within(" and ".join(summary.controls) or "nothing", epsilon, norm)


def _within(name: str, epsilon: Any, norm: Any) -> str:
    if not isinstance(epsilon, (int, float)):
        return name
    return f"{name} within {number_text(epsilon)}" + (f" ({norm})" if norm else "")


def _epsilons(by_control: Mapping[str, float] | None) -> str:
    """``0.0123`` of one control; ``texture 0.01, geometry 0.002`` of several."""
    if not by_control:
        return ""
    if len(by_control) == 1:
        return f"{next(iter(by_control.values())):.3g}"
    return ", ".join(f"{name} {value:.3g}" for name, value in by_control.items())


def renders_text(summary: AttackSummary) -> str:
    """Return ``40 of the search, 40 gradients, 21 of the verification``."""
    known = {"search": "of the search", "gradient": "gradients", "verification": "of the verification"}
    known |= {"baseline": "of the random search", "unprinted": "of the search without print terms"}
    known |= {"products": "predicted"}
    spent = [f"{number} {known.get(name, f'of {name}')}" for name, number in summary.renders.items() if number]
    return ", ".join(spent) or "none"


def print_cost_text(summary: AttackSummary) -> str:
    """Return ``margin -4.1 with the print terms, -6.3 without (200 steps): they cost 2.2 logits``; empty: not known."""
    cost = None if summary.printability is None else summary.printability.cost
    if cost is None or cost.cost is None or cost.margin_with is None or cost.margin_without is None:
        return ""
    said = f"they cost {cost.cost:.3g} logits" if cost.cost > 0 else "they cost nothing that shows here"
    margins = f"margin {cost.margin_with:.3g} with the print terms, {cost.margin_without:.3g} without"
    return f"{margins} (another search of {count(cost.steps, 'step')}, {cost.verified.trials} trials each): {said}"


def _how_it_errs(summary: AttackSummary, verified: VerifiedRate, thing: str) -> str:
    """Return "The model calls this mug a vase" where that is known of every trial, a weaker clause otherwise."""
    if summary.minimises:
        return f"The model recognises {thing}, more surely than in the clean scene,"
    labels = verified.labels
    if summary.task == COMMAND:
        where = ", ".join(labels).replace("action outside its envelope ", "") if len(labels) == 1 else ""
        return f"The commanded action {_left(summary)}{'' if summary.target or not where else f' {where}'}"
    if len(labels) == 1:
        return f"The model {calls(summary.task, thing, next(iter(labels)))}"
    if labels:
        most = max(labels, key=lambda label: labels[label])
        what = "takes {} for one of the targets" if summary.target else "is wrong about {}"
        return f"The model {what.format(thing)}, most often {calling(summary.task, most)},"
    if summary.task != CLASSIFICATION:
        return f"The model is wrong about {thing}"
    called = with_article(summary.adversarial.label) if summary.adversarial else "something else"
    return f"The model takes {thing} for something else ({called})"


def _claim(summary: AttackSummary, thing: str) -> str:
    """Return what a trial counts as, as a clause: "the model is wrong about this mug"."""
    if summary.minimises:
        return f"the model recognises {thing}, more surely than in the clean scene,"
    if summary.task == COMMAND:
        return f"the commanded action {_left(summary)}"
    if summary.target and summary.task == CLASSIFICATION:
        return f"the model calls {thing} {_a_target(summary)}"
    if summary.target:
        return f"the model predicts {' or '.join(summary.target)}"
    return "it is wrong" if summary.ending in _REASONS else f"the model is wrong about {thing}"


def _wanted(summary: AttackSummary, thing: str) -> str:
    """Return what was looked for, as a clause: "makes the model miss this mug"."""
    if summary.minimises:
        return f"makes {thing} easier to recognise"
    if summary.task == COMMAND:
        return f"makes the commanded action {_left(summary, 'leave', 'reach')}"
    return f"makes the model call {thing} {_a_target(summary)}" if summary.target else wanted(summary.objective, thing)


def _left(summary: AttackSummary, left: str = "left", reached: str = "reached") -> str:
    """Return what a commanded action did that counts, and no more than that: nothing has moved."""
    return f"{reached} the envelope of {' or '.join(summary.target)}" if summary.target else f"{left} its envelope"


def _a_target(summary: AttackSummary) -> str:
    return " or ".join(with_article(name) for name in summary.target or ())


def _against_random(summary: AttackSummary) -> list[str]:
    ours, random = summary.verified, summary.baseline.verified if summary.baseline else None
    if ours is None or random is None:
        return []
    tally = f"{random.successes} of {random.trials}"
    if random.rate > ours.rate:
        return [f"Random search with as many renders does better: {tally}."]
    if random.rate == ours.rate > 0:
        return [f"Random search with as many renders does as well: {tally}. The policy adds nothing here."]
    return []


# ---- how it came to its result ---------------------------------------------------------------------------------------

PLAN_HEADS = ("parameter", "numbers", "derivative", "why", "step")


def method_facts(summary: AttackSummary) -> dict[str, str]:
    """Return what is known of the search's work by name; texts of what is not known are empty."""
    segments = summary.light_path_segments
    return {
        "The search's claim": _search_claim(summary),
        "Sample count": _sample_count(summary),
        "Light transport": transport_text(summary),
        "Gradients": _gradients(summary),
        "Cut or taken back": _cut(summary),
        "Not finite": _not_finite(summary),
        "Light paths": f"at most {segments.search} segments in the search, {segments.verification} in the verification",
        "Printability": _printability(summary),
        "Cost of printability": print_cost_text(summary),
        "Moved before": ", ".join(
            f"{one.parameter} from {number_text(one.scene)} to {number_text(one.used)} {one.unit}".rstrip()
            for one in summary.clean.moved
        ),
    }


def transport_text(summary: AttackSummary) -> str:
    """Return whether a matrix predicted the pictures of the searches, and how far it was off; empty: not known."""
    transport = summary.transport
    if transport is None:
        return ""
    if not transport.used:
        return f"every picture was rendered: {transport.reason}" if transport.reason else "every picture was rendered"
    what = "light on surfaces" if transport.way == "surface light" else "a matrix"
    parts = [f"{what} predicted {count(summary.renders.get('products'), 'picture')}"]
    if transport.error is not None:
        levels, logits = map(_short, (transport.error.levels, transport.error.logits))
        parts.append(
            f"at the last comparison with a traced one it was off by {levels} of 255 levels of the picture's change "
            f"(root mean square) and {logits} of the objective"
        )
    if transport.renewed:
        parts.append(f"made anew {count(transport.renewed, 'time')}")
    if transport.seconds is not None:
        parts.append(f"it and the comparisons took {seconds_text(transport.seconds)}")
    return "; ".join([*parts, *filter(None, [transport.reason])])


def plan_text(summary: AttackSummary) -> str:
    """Return what a gradient plan comes to."""
    plan = summary.gradient_plan
    spp = "" if plan.spp is None else f", {count(plan.spp, 'sample')} a pixel"
    renders = count(plan.renders_per_gradient, "render")
    return f"Gradient plan: {count(len(plan.groups), 'parameter')}, {renders} a gradient beside the picture itself{spp}"


def plan_rows(summary: AttackSummary) -> list[list[str]]:
    """Return a row for each parameter of the gradient plan."""
    rows = []
    for group in summary.gradient_plan.groups:
        by_step = group.step_reason != ""
        unit = "" if group.unit in ("", "1") else f" {group.unit}"
        wide = f"{group.step:.3g} of its range" if group.step_in_unit is None else f"{group.step_in_unit:.3g}{unit}"
        step = f"{wide}: {group.step_reason}" if by_step else ""
        rows.append([group.name, str(group.size), group.estimator, group.reason, step])
    return rows


def _short(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "an unknown amount"


def _search_claim(summary: AttackSummary) -> str:
    claim = summary.claimed
    if claim is None:
        return ""
    again = f"{_short(claim.re_evaluated)} when rendered again" if math.isfinite(claim.re_evaluated) else ""
    return ", ".join(
        filter(None, (f"{objective_name(summary.objective)} {_short(claim.objective)} in the render that won", again))
    )


def _sample_count(summary: AttackSummary) -> str:
    chosen = summary.sample_count
    if chosen is None:
        return ""
    enough = "more would leave the " + ("rate about where it is" if summary.over else "margin on its side")
    unknown = "that more would not change it is not shown"
    still = enough if chosen.converged else unknown
    return f"{chosen.spp} a pixel in the verification; {still}"


def _gradients(summary: AttackSummary) -> str:
    seen = summary.gradients
    if seen is None or not seen.count:
        return ""
    cosine = seen.cosine_with_the_one_before
    parts = [f"{seen.count} of the search", f"{seen.zero} of them zero" if seen.zero else ""]
    if cosine is not None and math.isfinite(cosine):
        parts.append(f"median cosine with the one before {cosine:.2f}")
    return ", ".join(filter(None, parts))


def _cut(summary: AttackSummary) -> str:
    """What the policy did about outliers and about steps that failed."""
    seen = summary.gradients
    if seen is None or not (seen.count or seen.rejected):
        return ""
    cut = count(seen.cut, "gradient") + " with single outliers cut"
    return f"{cut}, {seen.shortened} shortened as a whole, {count(seen.rejected, 'step')} taken back"


def _not_finite(summary: AttackSummary) -> str:
    numbers = summary.non_finite
    if not numbers.objectives and not numbers.gradient_elements:
        return ""
    return f"{count(numbers.objectives, 'objective')}, {count(numbers.gradient_elements, 'number')} of gradients"


def _printability(summary: AttackSummary) -> str:
    terms = summary.printability
    if terms is None:
        return ""

    def told(one: PrintTerms) -> str:
        return f"step between neighbours {one.variation:.3g}, distance from printable colours {one.off_print:.3g}"

    return f"clean: {told(terms.clean)}" + ("" if terms.answer is None else f"; answer: {told(terms.answer)} (sRGB)")
