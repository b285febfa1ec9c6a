"""An attack in words: its verdict, what was asked and changed, and how it came to its result."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePath

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

PATH = "path"  # The control whose conditions are moments
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
    thing, after = f"this {noun(summary)}", f"after {count(summary.steps, 'step')}"
    if ending == "already wrong":
        wrong = calls(summary.task, thing, summary.clean.label)
        return f"The model already {wrong}: nothing was changed and nothing counts as found."
    if verified is None and ending == "interrupted" and summary.adversarial:
        says = calls(summary.task, thing, summary.adversarial.label)
        return f"Interrupted {after}. What was found so far is not verified: the model {says}."
    if verified is None:
        return f"{ending[:1].upper()}{ending[1:]} {after}; nothing is verified."
    several_paths = summary.drive is not None and len(summary.drive.paths) > 1
    rate = rate_text(verified) + another_text(summary.over, several_paths)
    claim, sought = _clauses(summary, thing)
    if ending == "found":
        random = summary.baseline.verified if summary.baseline else None
        more = " Random search finds as much." if random is not None and random.rate >= verified.rate > 0 else ""
        if summary.answer_from == "random":
            more = " Random search found it, and the policy nothing as bad."
        return f"{_how_it_errs(summary, verified, thing, claim)} in {rate}.{more}"
    if ending == "interrupted":
        return f"Interrupted; so far {claim} in {rate}."
    if ending == "not verified":
        return f"The search claims a wrong prediction that is not confirmed: {claim} in {rate}."
    why = _REASONS.get(ending, f"The search ended: {ending}.")
    return f"No change of {budget_text(summary)} was found that {sought}: {claim} in {rate}. {why}"


def another_text(over: Sequence[str], paths: bool = False) -> str:
    """Return what is another one in each trial: ``, each with another camera``; of a path it is the moment, and where
    there are several `paths`, which one it is."""
    others = [name for name in over if name != PATH]
    parts = [f"with another {' and '.join(others)}"] if others else []
    if PATH in over:
        parts.append("on one of several paths, at another moment" if paths else "at another moment of the path")
    return f", each {' and '.join(parts)}" if parts else ""


def remarks(summary: AttackSummary) -> list[str]:
    """Return what has to be known beside the verdict: the control group, the random search, the run's warnings."""
    texts = []
    control, verified, beaten = summary.clean.control, summary.verified, summary.policy_verified
    random = summary.baseline.verified if summary.baseline else None
    missed = control.trials - control.correct if control else 0
    if control and missed and summary.ending != "already wrong" and not summary.minimises:
        apart = " They do not count." if summary.over else ""
        nothing = f"; in {control.not_a_number} the output is not a number" if control.not_a_number else ""
        texts.append(f"The clean scene itself fails {missed} of its {control.trials} trials{nothing}.{apart}")
    if summary.answer_from == "random" and beaten:
        tally = f"{beaten.successes} of {beaten.trials} with a margin of {beaten.margin:.2f}"
        texts.append(
            f"The random search beside it found a worse configuration than the policy did ({tally}); that of the "
            f"random search is the scene. The margin is {margin_text(summary.task)}."
        )
    elif verified is not None and random is not None and random.rate >= verified.rate and random.rate > 0:
        tally, better = f"{random.successes} of {random.trials}", random.rate > verified.rate
        does = f"better: {tally}." if better else f"as well: {tally}. The policy adds nothing here."
        texts.append(f"Random search with as many renders does {does}")
    return texts + summary.warnings


def noun(summary: AttackSummary) -> str:
    """Return what the object, or the thing beside it that is judged, is called: ``wine glass`` for ``wine-glass`` and
    ``mug`` for ``data/mug.obj``."""
    called = PurePath(summary.object).stem if summary.judge in ("object", "all") else summary.judge
    every = " or a thing beside it" if summary.judge == "all" else ""
    return called.replace("-", " ").replace("_", " ") + every


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
        f"{name} {values.mean:.3g} (from {values.low:.3g} to {values.high:.3g})"
        for name, values in (("clean", tried.clean), ("adversarial", tried.answer))
        if values is not None
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

    def epsilons(by_control: Mapping[str, float] | None) -> str:
        """``0.0123`` of one control; ``texture 0.01, geometry 0.002`` of several."""
        texts = {name: f"{value:.3g}" for name, value in (by_control or {}).items()}
        return ", ".join(texts.values() if len(texts) == 1 else map(" ".join, texts.items()))

    smallest, below = epsilons(bracket.epsilon), epsilons(bracket.not_found_at)
    if not smallest:
        return f"none found up to {below}"
    floor = f"no search found one at {below}" if below else "no search failed, so it may be smaller still"
    still = "" if bracket.closed or not below else "; the searches did not suffice to bring the two together"
    return f"{smallest}; {floor}{still}"


def changed_text(summary: AttackSummary) -> str:
    """Return `budget_text` with a word on each norm: ``texture within 0.1 (linf: the largest change of any value)``."""
    text = budget_text(summary)
    for norm, meaning in NORMS.items():
        text = text.replace(f"({norm})", f"({norm}: {meaning})", 1)  # at its first use
    return text


def budget_text(summary: AttackSummary) -> str:
    """Return what could change and how far: ``texture within 0.1 (linf)``."""

    def within(name: str, epsilon: object, norm: object) -> str:
        if not isinstance(epsilon, (int, float)):
            return name
        return f"{name} within {number_text(epsilon)}" + (f" ({norm})" if norm else "")

    epsilon, norm = summary.epsilon, summary.norm
    if isinstance(epsilon, dict) or isinstance(norm, dict):
        epsilons, norms = (by_control if isinstance(by_control, dict) else {} for by_control in (epsilon, norm))
        return " and ".join(within(name, epsilons.get(name), norms.get(name)) for name in summary.controls)
    return within(" and ".join(summary.controls) or "nothing", epsilon, norm)


def renders_text(summary: AttackSummary) -> str:
    """Return ``40 of the search, 40 gradients, 21 of the verification``."""
    known = {
        "search": "of the search", "gradient": "gradients", "verification": "of the verification",
        "baseline": "of the random search", "unprinted": "of the search without print terms", "products": "predicted",
    }  # fmt: skip
    spent = [f"{number} {known.get(name, f'of {name}')}" for name, number in summary.renders.items() if number]
    return ", ".join(spent) or "none"


def print_cost_text(summary: AttackSummary) -> str:
    """Return ``margin -4.1 with the print terms, -6.3 without (200 steps): they cost 2.2 logits``; empty: not known."""
    cost = None if summary.printability is None else summary.printability.cost
    if cost is None:
        return ""
    costs = f"they cost {cost.cost:.3g} logits" if cost.cost > 0 else "they cost nothing that shows here"
    margins = f"margin {cost.margin_with:.3g} with the print terms, {cost.margin_without:.3g} without"
    return f"{margins} (another search of {count(cost.steps, 'step')}, {cost.verified.trials} trials each): {costs}"


def _how_it_errs(summary: AttackSummary, verified: VerifiedRate, thing: str, claim: str) -> str:
    """Return "The model calls this mug a vase" where that is known of every trial, a weaker clause otherwise."""
    labels = verified.labels
    if summary.task == COMMAND and not summary.target and not summary.minimises and len(labels) == 1:
        where = next(iter(labels)).replace("action outside its envelope ", "")
        claim += f" {where}" if where else ""
    if summary.minimises or summary.task == COMMAND:
        return claim[:1].upper() + claim[1:]
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


def _clauses(summary: AttackSummary, thing: str) -> tuple[str, str]:
    """Return what a trial counts as, and what was looked for: "the model is wrong about this mug", "makes the model
    miss this mug". Of a commanded action no more is said: nothing has moved."""
    target = summary.target or []
    names, called = " or ".join(target), " or ".join(map(with_article, target))
    if summary.minimises:
        return (
            f"the model recognises {thing}, more surely than in the clean scene,",
            f"makes {thing} easier to recognise",
        )
    if summary.task == COMMAND:
        verbs, envelope = ("reached", "reach"), f"the envelope of {names}"
        if not target:
            verbs, envelope = ("left", "leave"), "its envelope"
        return f"the commanded action {verbs[0]} {envelope}", f"makes the commanded action {verbs[1]} {envelope}"
    if target:
        claim = f"calls {thing} {called}" if summary.task == CLASSIFICATION else f"predicts {names}"
        return f"the model {claim}", f"makes the model call {thing} {called}"
    claim = "it is wrong" if summary.ending in _REASONS else f"the model is wrong about {thing}"
    return claim, wanted(summary.objective, thing)


# ---- how it came to its result ---------------------------------------------------------------------------------------

PLAN_HEADS = ("parameter", "numbers", "derivative", "why", "step")


def method_facts(summary: AttackSummary) -> dict[str, str]:
    """Return what is known of the search's work by name; texts of what is not known are empty."""
    claimed, chosen, seen = summary.claimed, summary.sample_count, summary.gradients
    segments, nothing, terms = summary.light_path_segments, summary.non_finite, summary.printability
    claim = samples = gradients = cut = not_finite = printed = ""
    if claimed is not None:
        claim = f"{objective_name(summary.objective)} {_short(claimed.objective)} in the render that won"
        if math.isfinite(claimed.re_evaluated):
            claim += f", {_short(claimed.re_evaluated)} when rendered again"
    if chosen is not None:
        enough = "more would leave the " + ("rate about where it is" if summary.over else "margin on its side")
        samples = f"{chosen.spp} a pixel in the verification; "
        samples += enough if chosen.converged else "that more would not change it is not shown"
    if seen is not None and seen.count:
        gradients = f"{seen.count} of the search" + (f", {seen.zero} of them zero" if seen.zero else "")
        cosine = seen.cosine_with_the_one_before
        if cosine is not None and math.isfinite(cosine):
            gradients += f", median cosine with the one before {cosine:.2f}"
    if seen is not None and (seen.count or seen.rejected):  # what the policy did about outliers and failed steps
        cut = f"{count(seen.cut, 'gradient')} with single outliers cut, {seen.shortened} shortened as a whole, "
        cut += f"{count(seen.rejected, 'step')} taken back"
    if nothing.objectives or nothing.gradient_elements:
        not_finite = (
            f"{count(nothing.objectives, 'objective')}, {count(nothing.gradient_elements, 'number')} of gradients"
        )
    if terms is not None:
        printed = f"clean: {_terms_text(terms.clean)}"
        printed += "" if terms.answer is None else f"; answer: {_terms_text(terms.answer)} (sRGB)"
    return {
        "The search's claim": claim,
        "Sample count": samples,
        "Light transport": transport_text(summary),
        "Gradients": gradients,
        "Cut or taken back": cut,
        "Not finite": not_finite,
        "Light paths": f"at most {segments.search} segments in the search, {segments.verification} in the verification",
        "Printability": printed,
        "Cost of printability": print_cost_text(summary),
        "Moved before": ", ".join(
            f"{moved.parameter} from {number_text(moved.scene)} to {number_text(moved.used)} {moved.unit}".rstrip()
            for moved in summary.clean.moved
        ),
    }


def _terms_text(terms: PrintTerms) -> str:
    return f"step between neighbours {terms.variation:.3g}, distance from printable colours {terms.off_print:.3g}"


def _short(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "an unknown amount"


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
        unit = "" if group.unit in ("", "1") else f" {group.unit}"
        wide = f"{group.step:.3g} of its range" if group.step_in_unit is None else f"{group.step_in_unit:.3g}{unit}"
        step = f"{wide}: {group.step_reason}" if group.step_reason else ""
        rows.append([group.name, str(group.size), group.estimator, group.reason, step])
    return rows
