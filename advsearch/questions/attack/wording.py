"""An attack in words: its verdict, what was asked and changed, and how it came to its
result.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePath

from advsearch.options import get_outcome
from advsearch.questions.attack.summary import AttackSummary
from advsearch.report import wording as words
from advsearch.report.wording import count, number_text
from advsearch.runs.results import VerifiedRate

PATH = "path"  # The control whose conditions are moments
NORMS = {
    "linf": "the largest change of any value",
    "l2": "the root of the sum of all squared changes",
}
"""What these words mean, said where they are first used."""

_REASONS = {
    "budget spent": "The budget is spent.",
    "stalled": "The policy had nothing more to propose.",
    "non-finite objective": "The objective was not a number several times in a row.",
}
"""Why a search ended without finding anything, where the name of the ending doesn't say
it.
"""


def attack_verdict(summary: AttackSummary) -> str:
    """Return what the run found, in one sentence that holds on its own."""
    ending = summary.ending
    verified = summary.verified
    # the object, or the thing beside it that is judged: `wine glass` for `wine-glass`,
    # `mug` for `data/mug.obj`
    called = (
        PurePath(summary.object).stem
        if summary.judge in ("object", "all")
        else summary.judge
    )
    thing = "this " + called.replace("-", " ").replace("_", " ")
    thing += " or a thing beside it" if summary.judge == "all" else ""
    after = f"after {count(summary.steps, 'step')}"
    if ending == "already wrong":
        wrong = words.calls(
            summary.task, thing, summary.clean.label, get_outcome(summary.clean.payload)
        )
        return (
            f"The model already {wrong}: nothing was changed and nothing counts as "
            "found."
        )
    if verified is None and ending == "interrupted" and summary.adversarial:
        outcome = get_outcome(summary.adversarial.payload)
        says = words.calls(summary.task, thing, summary.adversarial.label, outcome)
        return (
            f"Interrupted {after}. What was found so far is not verified: the "
            "model "
            f"{says}."
        )
    if verified is None:
        return f"{ending[:1].upper()}{ending[1:]} {after}; nothing is verified."
    several_paths = summary.drive is not None and len(summary.drive.paths) > 1
    rate = words.rate_text(verified) + another_text(summary.over, several_paths)
    claim, sought = _clauses(summary, thing)
    if ending == "found":
        random = summary.baseline.verified if summary.baseline else None
        more = (
            " Random search finds as much."
            if random is not None and random.rate >= verified.rate > 0
            else ""
        )
        if summary.answer_from == "random":
            more = " Random search found it, and the policy nothing as bad."
        return f"{_how_it_errs(summary, verified, thing, claim)} in {rate}.{more}"
    if ending == "interrupted":
        return f"Interrupted; so far {claim} in {rate}."
    if ending == "not verified":
        return (
            f"The search claims a wrong prediction that is not confirmed: {claim} "
            f"in {rate}."
        )
    why = _REASONS.get(ending, f"The search ended: {ending}.")
    return (
        f"No change of {budget_text(summary)} was found that {sought}: {claim} in "
        f"{rate}. {why}"
    )


def another_text(over: Sequence[str], paths: bool = False) -> str:
    """Return what is another one in each trial: ``, each with another camera``; of a
    path it is the moment, and where there are several `paths`, which one it is.
    """
    others = [name for name in over if name != PATH]
    parts = [f"with another {' and '.join(others)}"] if others else []
    if PATH in over:
        parts.append(
            "on one of several paths, at another moment"
            if paths
            else "at another moment of the path"
        )
    return f", each {' and '.join(parts)}" if parts else ""


def remarks(summary: AttackSummary) -> list[str]:
    texts = []
    control = summary.clean.control
    verified = summary.verified
    beaten = summary.policy_verified
    random = summary.baseline.verified if summary.baseline else None
    missed = control.trials - control.correct if control else 0
    if (
        control
        and missed
        and summary.ending != "already wrong"
        and not summary.minimises
    ):
        apart = " They do not count." if summary.over else ""
        nothing = (
            f"; in {control.not_a_number} the output is not a number"
            if control.not_a_number
            else ""
        )
        outcomes = words.outcomes_text(control.outcomes, summary.task)
        how = f" ({outcomes})" if outcomes else ""
        texts.append(
            f"The clean scene itself fails {missed} of its {control.trials} "
            f"trials{how}{nothing}.{apart}"
        )
    if summary.answer_from == "random" and beaten:
        tally = (
            f"{beaten.successes} of {beaten.trials} with a margin of "
            f"{beaten.margin:.2f}"
        )
        texts.append(
            "The random search beside it found a worse configuration than the policy "
            f"did ({tally}); that of the "
            "random search is the scene. The margin is "
            f"{words.margin_text(summary.task)}."
        )
    elif (
        verified is not None
        and random is not None
        and random.rate >= verified.rate
        and random.rate > 0
    ):
        tally = f"{random.successes} of {random.trials}"
        better = random.rate > verified.rate
        does = (
            f"better: {tally}."
            if better
            else (f"as well: {tally}. The policy adds nothing here.")
        )
        texts.append(f"Random search with as many renders does {does}")
    return texts + summary.warnings


def success(summary: AttackSummary) -> str:
    return "target" if summary.target else "easier" if summary.minimises else "wrong"


def goal_text(summary: AttackSummary) -> str:
    if summary.target:
        verb = "command" if summary.task == words.COMMAND else "predict"
        return f"the model should {verb} {' or '.join(summary.target)}"
    return "easier to recognise" if summary.minimises else ""


def objective_text(summary: AttackSummary) -> str:
    tried = summary.tried_objective
    if tried is None or summary.objective in words.SUCCESS_ABOVE_ZERO:
        return ""
    parts = [
        f"{name} {values.mean:.3g} (from {values.low:.3g} to {values.high:.3g})"
        for name, values in (("clean", tried.clean), ("adversarial", tried.answer))
        if values is not None
    ]
    return f"{summary.objective} in the trials: {', '.join(parts)}" if parts else ""


def drive_text(summary: AttackSummary) -> str:
    drive = summary.drive
    if drive is None:
        return ""
    adversarial = (
        "" if drive.answer is None else (f", {drive.answer} of the adversarial one")
    )
    along = f", {len(drive.paths)} paths" if len(drive.paths) > 1 else ""
    return (
        f"right in {drive.clean} of {drive.frames} frames of the clean "
        f"scene{adversarial}{along}"
    )


def smallest_text(summary: AttackSummary) -> str:
    bracket = summary.smallest
    if bracket is None:
        return ""

    def epsilons(by_control: Mapping[str, float] | None) -> str:
        """``0.0123`` of one control; ``texture 0.01, geometry 0.002`` of several."""
        texts = {name: f"{value:.3g}" for name, value in (by_control or {}).items()}
        return ", ".join(
            texts.values() if len(texts) == 1 else map(" ".join, texts.items())
        )

    smallest = epsilons(bracket.epsilon)
    below = epsilons(bracket.not_found_at)
    if not smallest:
        return f"none found up to {below}"
    floor = (
        f"no search found one at {below}"
        if below
        else ("no search failed, so it may be smaller still")
    )
    still = (
        ""
        if bracket.closed or not below
        else ("; the searches did not suffice to bring the two together")
    )
    return f"{smallest}; {floor}{still}"


def changed_text(summary: AttackSummary) -> str:
    """Return `budget_text` with a word on each norm: ``texture within 0.1 (linf: the
    largest change of any value)``.
    """
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

    epsilon = summary.epsilon
    norm = summary.norm
    if isinstance(epsilon, dict) or isinstance(norm, dict):
        epsilons, norms = (
            by_control if isinstance(by_control, dict) else {}
            for by_control in (epsilon, norm)
        )
        return " and ".join(
            within(name, epsilons.get(name), norms.get(name))
            for name in summary.controls
        )
    return within(" and ".join(summary.controls) or "nothing", epsilon, norm)


def renders_text(summary: AttackSummary) -> str:
    """Return ``40 of the search, 40 gradients, 21 of the verification``."""
    known = {
        "search": "of the search", "gradient": "gradients", "verification": "of the verification",
        "baseline": "of the random search", "unprinted": "of the search without print "
                                                         "terms", "products": "predicted",
    }  # fmt: skip
    spent = [
        f"{number} {known.get(name, f'of {name}')}"
        for name, number in summary.renders.items()
        if number
    ]
    return ", ".join(spent) or "none"


def print_cost_text(summary: AttackSummary) -> str:
    """Return ``margin -4.1 with the print terms, -6.3 without (200 steps): they cost
    2.2 logits``; empty: not known.
    """
    cost = None if summary.printability is None else summary.printability.cost
    if cost is None:
        return ""
    costs = (
        f"they cost {cost.cost:.3g} logits"
        if cost.cost > 0
        else "they cost nothing that shows here"
    )
    margins = (
        f"margin {cost.margin_with:.3g} with the print terms, "
        f"{cost.margin_without:.3g} without"
    )
    return (
        f"{margins} (another search of {count(cost.steps, 'step')}, "
        f"{cost.verified.trials} trials each): {costs}"
    )


def _how_it_errs(
    summary: AttackSummary, verified: VerifiedRate, thing: str, claim: str
) -> str:
    """Return "The model calls this mug a vase" where that is known of every trial, a
    weaker clause otherwise.
    """
    labels = verified.labels
    if (
        summary.task == words.COMMAND
        and not summary.target
        and not summary.minimises
        and len(labels) == 1
    ):
        where = next(iter(labels)).replace("action outside its envelope ", "")
        claim += f" {where}" if where else ""
    if summary.minimises or summary.task == words.COMMAND:
        return claim[:1].upper() + claim[1:]
    outcome = words.get_only_outcome(verified.outcomes)
    if len(labels) == 1:
        return (
            f"The model {words.calls(summary.task, thing, next(iter(labels)), outcome)}"
        )
    if labels:
        most = max(labels, key=lambda label: labels[label])
        what = (
            "takes {} for one of the targets" if summary.target else "is wrong about {}"
        )
        if outcome is None and verified.outcomes:
            return (
                f"The model {what.format(thing)} "
                f"({words.outcomes_text(verified.outcomes, summary.task)})"
            )
        return (
            f"The model {what.format(thing)}, most often "
            f"{words.calling(summary.task, most, outcome)},"
        )
    if summary.task != words.CLASSIFICATION:
        return f"The model is wrong about {thing}"
    called = (
        words.with_article(summary.adversarial.label)
        if summary.adversarial
        else "something else"
    )
    return f"The model takes {thing} for something else ({called})"


def _clauses(summary: AttackSummary, thing: str) -> tuple[str, str]:
    """Return what a trial counts as, and what was looked for: "the model is wrong about
    this mug", "makes the model miss this mug". Of a commanded action no more is said:
    nothing has moved.
    """
    target = summary.target or []
    names = " or ".join(target)
    called = " or ".join(map(words.with_article, target))
    if summary.minimises:
        return (
            f"the model recognises {thing}, more surely than in the clean scene,",
            f"makes {thing} easier to recognise",
        )
    if summary.task == words.COMMAND:
        verbs = ("reached", "reach")
        envelope = f"the envelope of {names}"
        if not target:
            verbs = ("left", "leave")
            envelope = "its envelope"
        return (
            f"the commanded action {verbs[0]} {envelope}",
            f"makes the commanded action {verbs[1]} {envelope}",
        )
    if target:
        claim = (
            f"calls {thing} {called}"
            if summary.task == words.CLASSIFICATION
            else f"predicts {names}"
        )
        return f"the model {claim}", f"makes the model call {thing} {called}"
    claim = (
        "it is wrong"
        if summary.ending in _REASONS
        else f"the model is wrong about {thing}"
    )
    return claim, words.wanted(summary.objective, thing)


def method_facts(summary: AttackSummary) -> dict[str, str]:
    facts = dict[str, str]()
    claimed = summary.claimed
    chosen = summary.sample_count
    seen = summary.gradients
    segments = summary.light_path_segments
    nothing = summary.non_finite
    terms = summary.printability
    if claimed is not None:
        again = (
            f", {_short(claimed.re_evaluated)} when rendered again"
            if math.isfinite(claimed.re_evaluated)
            else ""
        )
        claim = (
            f"{words.objective_name(summary.objective)} "
            f"{_short(claimed.objective)} in the render that won"
        )
        facts["The search's claim"] = claim + again
    if chosen is not None:
        enough = "more would leave the " + (
            "rate about where it is" if summary.over else "margin on its side"
        )
        enough = (
            enough
            if chosen.converged
            else ("that more would not change it is not shown")
        )
        facts["Sample count"] = f"{chosen.spp} a pixel in the verification; {enough}"
    facts["Light transport"] = transport_text(summary)
    if seen is not None and seen.count:
        gradients = f"{seen.count} of the search" + (
            f", {seen.zero} of them zero" if seen.zero else ""
        )
        cosine = seen.cosine_with_the_one_before
        known = cosine is not None and math.isfinite(cosine)
        facts["Gradients"] = gradients + (
            f", median cosine with the one before {cosine:.2f}" if known else ""
        )
    # what the policy did about outliers and failed steps
    if seen is not None and (seen.count or seen.rejected):
        cut = (
            f"{count(seen.cut, 'gradient')} with single outliers cut, "
            f"{seen.shortened} shortened as a whole, "
        )
        facts["Cut or taken back"] = f"{cut}{count(seen.rejected, 'step')} taken back"
    if nothing.objectives or nothing.gradient_elements:
        numbers = count(nothing.gradient_elements, "number")
        facts["Not finite"] = (
            f"{count(nothing.objectives, 'objective')}, {numbers} of gradients"
        )
    longest = (
        f"at most {segments.search} segments in the search, "
        f"{segments.verification} in the verification"
    )
    facts["Light paths"] = longest
    if terms is not None:
        far = [
            f"{of}: step between neighbours {off.variation:.3g}, distance from "
            f"printable colours {off.off_print:.3g}"
            for of, off in (("clean", terms.clean), ("answer", terms.answer))
            if off is not None
        ]
        facts["Printability"] = "; ".join(far) + (" (sRGB)" if terms.answer else "")
    facts["Cost of printability"] = print_cost_text(summary)
    moved = [
        f"{value.parameter} from {number_text(value.scene)} to "
        f"{number_text(value.used)} {value.unit}".rstrip()
        for value in summary.clean.moved
    ]
    return {**facts, "Moved before": ", ".join(moved)}


def _short(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "an unknown amount"


def transport_text(summary: AttackSummary) -> str:
    transport = summary.transport
    if transport is None:
        return ""
    if not transport.used:
        return (
            f"every picture was rendered: {transport.reason}"
            if transport.reason
            else "every picture was rendered"
        )
    what = "light on surfaces" if transport.way == "surface light" else "a matrix"
    parts = [f"{what} predicted {count(summary.renders.get('products'), 'picture')}"]
    if transport.error is not None:
        parts.append(
            "at the last comparison with a traced one it was off by "
            f"{_short(transport.error.levels)} of 255 levels of the picture's change "
            "(root mean square) and "
            f"{_short(transport.error.logits)} of the objective"
        )
    if transport.renewed:
        parts.append(f"made anew {count(transport.renewed, 'time')}")
    if transport.seconds is not None:
        parts.append(
            f"it and the comparisons took {words.seconds_text(transport.seconds)}"
        )
    return "; ".join([*parts, *filter(None, [transport.reason])])
