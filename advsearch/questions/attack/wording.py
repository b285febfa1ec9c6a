"""An attack in words: its verdict, its goal and its changes, and its method."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePath

from advsearch.options import get_outcome
from advsearch.questions.attack.summary import AttackSummary, PathSegments
from advsearch.report import wording as words
from advsearch.report.wording import format_count, format_number
from advsearch.runs.results import (
    ControlGroup,
    LinearTransport,
    MovedValue,
    PredictionError,
    PrintTerms,
    VerifiedRate,
)

PATH = "path"  # the control that moves along a path, at a random moment
NORMS = {
    "linf": "the largest change of any value",
    "l2": "the root of the sum of all squared changes",
}
"""Explanations of the norms, which a text has where it first names a norm."""

_REASONS = {
    "budget spent": "The budget is spent.",
    "stalled": "The policy had nothing more to propose.",
    "non-finite objective": "The objective was not a number several times in a row.",
}
"""Sentences about why a search ended without finding anything, by its ending."""

JUDGES_OF_OBJECT = ("object", "all")
"""Values of the setting `judge` with which predictions of the object are evaluated:
alone, or with all things near it. Any other value is the name of a single other thing.
"""

_RENDER_KINDS = {
    "search": "of the search",
    "gradient": "gradients",
    "verification": "of the verification",
    "baseline": "of the random search",
    "unprinted": "of the search without print terms",
    "products": "predicted",
}


def attack_verdict(summary: AttackSummary) -> str:
    """Return what the run found, in sentences that need no context.

    The ending of the search decides the form. If a scene was found: "The model calls
    this mug a vase in 20 of 20 fresh renders (...)". Else the text states that none was
    found, and why the search ended.
    """
    verified = summary.verified
    thing = _name_thing(summary)
    if summary.ending == "already wrong":
        return _already_wrong_verdict(summary, thing)
    if verified is None:
        return _unverified_verdict(summary, thing)
    has_paths = summary.drive is not None and len(summary.drive.paths) > 1
    rate = words.format_rate(verified) + condition_text(summary.over, has_paths)
    # "the model is wrong about this mug", "makes the model miss this mug"
    claim, goal = _clauses(summary, thing)
    if summary.ending == "found":
        error = _error_clause(summary, verified, thing, claim)
        return f"{error} in {rate}.{_random_search_remark(summary, verified)}"
    return _unsuccessful_verdict(summary, rate, claim, goal)


def _already_wrong_verdict(summary: AttackSummary, thing: str) -> str:
    """Return what a run found if the model is wrong about the clean scene."""
    wrong = words.format_mistake(
        summary.task, thing, summary.clean.label, get_outcome(summary.clean.payload)
    )
    return (
        f"The model already {wrong}: nothing was changed and nothing counts as found."
    )


def _unsuccessful_verdict(
    summary: AttackSummary, rate: str, claim: str, goal: str
) -> str:
    """Return what a run found that was verified, but did not find a failure.

    Args:
        summary: summary of the attack.
        rate: the rate of the trials, and what differs between them.
        claim: clause for what a success in a trial is.
        goal: clause for the goal of the search.
    """
    ending = summary.ending
    if ending == "interrupted":
        return f"Interrupted; so far {claim} in {rate}."
    if ending == "not verified":
        return (
            f"The search claims a wrong prediction that is not confirmed: {claim} "
            f"in {rate}."
        )
    # else the search has found nothing
    reason = _REASONS.get(ending, f"The search ended: {ending}.")
    return (
        f"No change of {budget_text(summary)} was found that {goal}: {claim} in "
        f"{rate}. {reason}"
    )


def _unverified_verdict(summary: AttackSummary, thing: str) -> str:
    """Return what a run found if it ended before anything was verified.

    Args:
        summary: summary of the attack.
        thing: the object that is evaluated, as "this mug".
    """
    ending = summary.ending
    after_steps = f"after {format_count(summary.steps, 'step')}"
    if ending == "interrupted" and summary.adversarial:
        outcome = get_outcome(summary.adversarial.payload)
        predicts = words.format_mistake(
            summary.task, thing, summary.adversarial.label, outcome
        )
        return (
            f"Interrupted {after_steps}. What was found so far is not verified: the "
            f"model {predicts}."
        )
    return f"{ending[:1].upper()}{ending[1:]} {after_steps}; nothing is verified."


def _name_thing(summary: AttackSummary) -> str:
    """Return what is evaluated: ``this wine glass`` for the object `wine-glass`.

    It is the object or a thing near it. An object that was loaded from a file has the
    name of the file.
    """
    name = summary.judge  # the name of the thing, unless the object is evaluated
    if summary.judge in JUDGES_OF_OBJECT:
        name = PurePath(summary.object).stem
    thing = "this " + name.replace("-", " ").replace("_", " ")
    return f"{thing} or a thing beside it" if summary.judge == "all" else thing


def _random_search_remark(summary: AttackSummary, verified: VerifiedRate) -> str:
    """Return a remark on a found scene if the random search did as well; else empty."""
    if summary.adversarial_from == "random":
        return " Random search found it, and the policy found nothing as bad."
    random_rate = summary.baseline.verified if summary.baseline else None
    # Without any success of the policy, there is nothing to compare.
    if random_rate is None or verified.rate <= 0:
        return ""
    is_random_as_good = random_rate.rate >= verified.rate
    return " Random search finds as much." if is_random_as_good else ""


def condition_text(over: Sequence[str], has_several_paths: bool = False) -> str:
    """Return what differs between trials: ``, each with another camera``.

    Args:
        over: controls that vary by chance. With the control "path", trials differ in
            their moment on the path.
        has_several_paths: whether the path is one of several.
    """
    controls = [name for name in over if name != PATH]
    parts = []
    if controls:
        parts.append(f"with another {' and '.join(controls)}")
    if PATH in over:
        moment = "at another moment of the path"
        if has_several_paths:
            moment = "on one of several paths, at another moment"
        parts.append(moment)
    return f", each {' and '.join(parts)}" if parts else ""


def make_remarks(summary: AttackSummary) -> list[str]:
    """Return the remarks on a result: on the clean scene, on the random search, warnings."""
    texts = [_clean_remark(summary), _baseline_remark(summary)]
    return [text for text in texts if text] + summary.warnings


def _clean_remark(summary: AttackSummary) -> str:
    """Return in how many trials the model is wrong about the clean scene.

    The text is empty if there are none, or if the verdict states it already ("already
    wrong"). It is also empty if the search makes the object easier to recognise: then a
    wrong clean scene is expected.
    """
    control = summary.clean.control
    if control is None or summary.ending == "already wrong" or summary.minimises:
        return ""
    n_failures = control.trials - control.correct
    if not n_failures:
        return ""
    failures = _clean_failures_text(control, summary)
    return (
        f"The clean scene itself fails {n_failures} of its {control.trials} "
        f"trials{failures}"
    )


def _clean_failures_text(control: ControlGroup, summary: AttackSummary) -> str:
    """Return how the trials of the clean scene failed, and whether they count."""
    outcome_text = words.format_outcomes(control.outcomes, summary.task)
    outcomes = f" ({outcome_text})" if outcome_text else ""
    not_a_number = ""
    if control.not_a_number:
        not_a_number = f"; in {control.not_a_number} the output is not a number"
    # If conditions vary, only trials with a right clean scene count.
    not_counted = " They do not count." if summary.over else ""
    return f"{outcomes}{not_a_number}.{not_counted}"


def _baseline_remark(summary: AttackSummary) -> str:
    """Return a remark if the random search did as well as the policy; else empty."""
    verified = summary.verified
    random_rate = summary.baseline.verified if summary.baseline else None
    # If the random search found a configuration that is worse for the model, `verified`
    # is about that one, and `policy_verified` about the policy's. Else it is None.
    policy_rate = summary.policy_verified
    if summary.adversarial_from == "random" and policy_rate:
        return _outdone_remark(policy_rate, summary.task)
    if verified is None or random_rate is None:
        return ""
    return _compare_with_random(verified, random_rate)


def _compare_with_random(verified: VerifiedRate, random_rate: VerifiedRate) -> str:
    """Return that the random search did better or as well; empty if it did not.

    Args:
        verified: rate of the policy's result.
        random_rate: rate of the result of the random search.
    """
    if random_rate.rate <= 0 or random_rate.rate < verified.rate:
        return ""  # without any success, the random search did not do well
    successes = f"{random_rate.successes} of {random_rate.trials}"
    text = "Random search with as many renders does"
    if random_rate.rate > verified.rate:
        return f"{text} better: {successes}."
    return f"{text} as well: {successes}. The policy adds nothing here."


def _outdone_remark(policy_rate: VerifiedRate, task: str) -> str:
    """Return that the random search found a worse configuration than the policy."""
    return (
        "The random search found a worse configuration than the policy did "
        f"({policy_rate.successes} of {policy_rate.trials} with a margin of "
        f"{policy_rate.margin:.2f}), and this is the adversarial scene. The margin "
        f"is {words.get_margin_meaning(task)}."
    )


def format_success_word(summary: AttackSummary) -> str:
    """Return a word for the predictions that count as a success, such as "wrong"."""
    if summary.target:
        return "target"
    return "easier" if summary.minimises else "wrong"


def goal_text(summary: AttackSummary) -> str:
    """Return the goal of a search; empty for any wrong prediction."""
    if summary.target:
        verb = "command" if summary.task == words.COMMAND else "predict"
        return f"the model should {verb} {' or '.join(summary.target)}"
    return "easier to recognise" if summary.minimises else ""


def objective_text(summary: AttackSummary) -> str:
    """Return the mean and the range of the objective in the trials.

    Empty if it is not known. It is also empty for objectives that are above 0 exactly in
    trials that are a success: then the rate of success is enough.
    """
    objective = summary.tried_objective
    if objective is None or summary.objective in words.SUCCESS_ABOVE_ZERO:
        return ""
    scenes = (("clean", objective.clean), ("adversarial", objective.adversarial))
    parts = [
        f"{name} {values.mean:.3g} (from {values.low:.3g} to {values.high:.3g})"
        for name, values in scenes
        if values is not None
    ]
    return f"{summary.objective} in the trials: {', '.join(parts)}" if parts else ""


def drive_text(summary: AttackSummary) -> str:
    """Return in how many frames of a drive the model is right; empty without one."""
    drive = summary.drive
    if drive is None:
        return ""
    text = f"right in {drive.clean} of {drive.frames} frames of the clean scene"
    if drive.adversarial is not None:
        text += f", {drive.adversarial} of the adversarial one"
    if len(drive.paths) > 1:
        text += f", {len(drive.paths)} paths"
    return text


def smallest_text(summary: AttackSummary) -> str:
    """Return the smallest epsilon with a wrong prediction, and the largest without one.

    Empty if the smallest was not searched.
    """
    bracket = summary.smallest
    if bracket is None:
        return ""
    smallest = _epsilons_text(bracket.epsilon)
    not_found_at = _epsilons_text(bracket.not_found_at)
    # a search "fails" if it finds no wrong prediction
    if not smallest:
        return f"none found up to {not_found_at}"
    if not not_found_at:
        return f"{smallest}; no search failed, so it may be smaller still"
    text = f"{smallest}; no search found one at {not_found_at}"
    if not bracket.closed:
        text += "; the searches did not suffice to bring the two together"
    return text


def _epsilons_text(epsilons: Mapping[str, float] | None) -> str:
    """Return ``0.0123`` of one control; ``texture 0.01, geometry 0.002`` of several."""
    texts = {name: f"{value:.3g}" for name, value in (epsilons or {}).items()}
    if len(texts) == 1:
        return next(iter(texts.values()))
    return ", ".join(f"{name} {text}" for name, text in texts.items())


def changed_text(summary: AttackSummary) -> str:
    """Return `budget_text` with an explanation of each norm.

    ``texture within 0.1 (linf: the largest change of any value)``.
    """
    text = budget_text(summary)
    for norm, meaning in NORMS.items():
        # `budget_text` has a norm in parentheses. The first one gets the explanation.
        text = text.replace(f"({norm})", f"({norm}: {meaning})", 1)
    return text


def budget_text(summary: AttackSummary) -> str:
    """Return what could change and how far: ``texture within 0.1 (linf)``."""
    epsilon = summary.epsilon
    norm = summary.norm
    # With several controls both are mappings by control.
    has_several_budgets = isinstance(epsilon, dict) or isinstance(norm, dict)
    if not has_several_budgets:
        names = " and ".join(summary.controls) or "nothing"
        return _within_text(names, epsilon, norm)
    epsilons = epsilon if isinstance(epsilon, dict) else {}
    norms = norm if isinstance(norm, dict) else {}
    return " and ".join(
        _within_text(name, epsilons.get(name), norms.get(name))
        for name in summary.controls
    )


def _within_text(name: str, epsilon: object, norm: object) -> str:
    """Return a control's name with its budget, if it has an epsilon."""
    if not isinstance(epsilon, (int, float)):
        return name
    text = f"{name} within {format_number(epsilon)}"
    return f"{text} ({norm})" if norm else text


def renders_text(summary: AttackSummary) -> str:
    """Return how many images were rendered for what.

    ``40 of the search, 40 gradients, 21 of the verification``.
    """
    spent = [
        f"{number} {_RENDER_KINDS.get(name, f'of {name}')}"
        for name, number in summary.renders.items()
        if number
    ]
    return ", ".join(spent) or "none"


def print_cost_text(summary: AttackSummary) -> str:
    """Return what print terms cost; empty if that is not known.

    ``margin -4.1 with the print terms, -6.3 without (another search of 200 steps, 20
    trials each): they cost 2.2 logits``
    """
    cost = None if summary.printability is None else summary.printability.cost
    if cost is None:
        return ""
    cost_text = "they cost nothing that shows here"
    if cost.cost > 0:
        cost_text = f"they cost {cost.cost:.3g} logits"
    steps = format_count(cost.steps, "step")
    return (
        f"margin {cost.margin_with:.3g} with the print terms, "
        f"{cost.margin_without:.3g} without (another search of {steps}, "
        f"{cost.verified.trials} trials each): {cost_text}"
    )


def _error_clause(
    summary: AttackSummary, verified: VerifiedRate, thing: str, claim: str
) -> str:
    """Return what the model gets wrong, as in "The model calls this mug a vase".

    - For a scene that is easier to recognise (setting `minimise`), or for a commanded
      action (task "command"), the clause is `claim`. If all actions deviate in the same
      direction, the clause states the direction, too.
    - If all trials have the same prediction, the clause names it.
    - If they have several, it names the most frequent one, or the outcomes of a
      detector.
    - If the labels of the trials are not known, it names the prediction in the stored
      image for a classifier, and no prediction for other tasks.

    Args:
        summary: summary of the attack.
        verified: the rate of the trials.
        thing: the object that is evaluated, as "this mug".
        claim: clause for what a success is, such as "the model is wrong about this mug".
    """
    labels = verified.labels
    only_label = next(iter(labels)) if len(labels) == 1 else None
    if summary.minimises:
        return _begin_upper(claim)
    if summary.task == words.COMMAND:
        direction = _deviation_text(summary, only_label)
        return _begin_upper(f"{claim}{direction}")
    if only_label is not None:
        outcome = words.get_only_outcome(verified.outcomes)
        predicts = words.format_mistake(summary.task, thing, only_label, outcome)
        return f"The model {predicts}"
    if labels:
        return _mixed_error_clause(summary, verified, thing)
    return _unlabeled_error_clause(summary, thing)


def _deviation_text(summary: AttackSummary, only_label: str | None) -> str:
    """Return in which direction a commanded action deviates, after a space.

    Empty if the trials differ in it, or if the attack has a target.
    """
    if only_label is None or summary.target:
        return ""
    # of "action outside its envelope (steering above it)", the end
    direction = only_label.replace("action outside its envelope ", "")
    return f" {direction}" if direction else ""


def _unlabeled_error_clause(summary: AttackSummary, thing: str) -> str:
    """Return what the model gets wrong if the labels of the trials are not known."""
    if summary.task != words.CLASSIFICATION:
        return f"The model is wrong about {thing}"
    error = f"The model takes {thing} for something else"
    if not summary.adversarial:
        return f"{error} (something else)"
    return f"{error} ({words.add_article(summary.adversarial.label)})"


def _begin_upper(clause: str) -> str:
    """Return a clause as the beginning of a sentence."""
    return clause[:1].upper() + clause[1:]


def _mixed_error_clause(
    summary: AttackSummary, verified: VerifiedRate, thing: str
) -> str:
    """Return what the model gets wrong if trials have several predictions.

    It names the most frequent prediction: "The model is wrong about this mug, most often
    calling it a vase,". A detector's predictions have outcomes, such as missed and
    loose. If there are several, the clause names the outcomes instead of a prediction.

    Args:
        summary: summary of the attack.
        verified: the rate of the trials, with how often each label was predicted.
        thing: the object that is evaluated, as "this mug".
    """
    error = f"is wrong about {thing}"
    if summary.target:
        error = f"takes {thing} for one of the targets"
    outcome = words.get_only_outcome(verified.outcomes)
    has_several_outcomes = outcome is None and bool(verified.outcomes)
    if has_several_outcomes:
        outcomes = words.format_outcomes(verified.outcomes, summary.task)
        return f"The model {error} ({outcomes})"
    labels = verified.labels
    most_frequent = max(labels, key=lambda label: labels[label])
    calling = words.format_mistake_participle(summary.task, most_frequent, outcome)
    # the sentence goes on with the rate, "in 18 of 20 fresh renders"
    return f"The model {error}, most often {calling},"


def _clauses(summary: AttackSummary, thing: str) -> tuple[str, str]:
    """Return clauses for what a success in a trial is, and for the goal of the search.

    Example: "the model is wrong about this mug" and "makes the model miss this mug". If
    nothing was found, the verdict begins with the goal, which names the model; then the
    first clause is only "it is wrong". For a commanded action, the clauses are about
    the command alone, since no vehicle has moved.

    Args:
        summary: summary of the attack.
        thing: the object that is evaluated, as "this mug".
    """
    if summary.minimises:
        return (
            f"the model recognises {thing}, more surely than in the clean scene,",
            f"makes {thing} easier to recognise",
        )
    if summary.task == words.COMMAND:
        return _command_clauses(summary)
    if summary.target:
        return _target_clauses(summary, thing)
    claim = f"the model is wrong about {thing}"
    if summary.ending in _REASONS:
        claim = "it is wrong"
    return claim, words.format_goal(summary.objective, thing)


def _command_clauses(summary: AttackSummary) -> tuple[str, str]:
    """Return both clauses for a commanded action; see `_clauses`."""
    if summary.target:
        envelope = f"the envelope of {' or '.join(summary.target)}"
        return (
            f"the commanded action reached {envelope}",
            f"makes the commanded action reach {envelope}",
        )
    return (
        "the commanded action left its envelope",
        "makes the commanded action leave its envelope",
    )


def _target_clauses(summary: AttackSummary, thing: str) -> tuple[str, str]:
    """Return both clauses for an attack with a target; see `_clauses`."""
    target = summary.target or []
    targets = " or ".join(map(words.add_article, target))
    claim = f"predicts {' or '.join(target)}"
    if summary.task == words.CLASSIFICATION:
        claim = f"calls {thing} {targets}"
    return f"the model {claim}", f"makes the model call {thing} {targets}"


def method_texts(summary: AttackSummary) -> dict[str, str]:
    """Return texts about the method of an attack, by name, without empty ones."""
    facts = {
        "The search's claim": _claim_text(summary),
        "Sample count": _sample_count_text(summary),
        "Light transport": transport_text(summary),
        "Gradients": _gradients_text(summary),
        "Clipped or undone": _rejected_text(summary),
        "Not finite": _non_finite_text(summary),
        "Light paths": _light_paths_text(summary.light_path_segments),
        "Printability": _printability_text(summary),
        "Cost of printability": print_cost_text(summary),
        "Changed before the search": _moved_text(summary.clean.moved),
    }
    return {name: text for name, text in facts.items() if text}


def _light_paths_text(segments: PathSegments) -> str:
    """Return how many segments the light paths of the renders have at most."""
    return (
        f"at most {segments.search} segments in the search, "
        f"{segments.verification} in the verification"
    )


def _moved_text(moved: Sequence[MovedValue]) -> str:
    """Return the values of the scene outside of a range, and what replaced them."""
    texts = [
        f"{value.parameter} from {format_number(value.scene)} to "
        f"{format_number(value.used)} {value.unit}".rstrip()
        for value in moved
    ]
    return ", ".join(texts)


def _claim_text(summary: AttackSummary) -> str:
    """Return the objective that the search claims, and the one when rendered again."""
    claimed = summary.claimed
    if claimed is None:
        return ""
    text = (
        f"{words.get_objective_name(summary.objective)} "
        f"{_short(claimed.objective)} in the render that won"
    )
    if math.isfinite(claimed.re_evaluated):
        text += f", {_short(claimed.re_evaluated)} when rendered again"
    return text


def _sample_count_text(summary: AttackSummary) -> str:
    """Return the samples of the verification, and whether they suffice.

    They suffice if more samples would not change the sign of the margin. If conditions
    vary by chance (`over`), they suffice if more would not change the rate much.
    """
    samples = summary.sample_count
    if samples is None:
        return ""
    effect = "more might change the verdict"
    if samples.converged:
        quantity = "rate much" if summary.over else "sign of the margin"
        effect = f"more would not change the {quantity}"
    return f"{samples.spp} per pixel in the verification; {effect}"


def _gradients_text(summary: AttackSummary) -> str:
    """Return how many gradients the search took, and how much they agreed."""
    gradients = summary.gradients
    if gradients is None or not gradients.count:
        return ""
    text = f"{gradients.count} of the search"
    if gradients.zero:
        text += f", {gradients.zero} of them zero"
    cosine = gradients.cosine_with_the_one_before
    if cosine is not None and math.isfinite(cosine):
        text += f", median cosine with the one before {cosine:.2f}"
    return text


def _rejected_text(summary: AttackSummary) -> str:
    """Return what the policy did about outliers and failed steps.

    A policy clips elements of a gradient that are outliers (`cut`), and scales a
    gradient down whose norm is an outlier (`shortened`). It undoes steps that make the
    objective worse (`rejected`). The text is empty without gradients and without steps
    that were undone.
    """
    gradients = summary.gradients
    if gradients is None or not (gradients.count or gradients.rejected):
        return ""
    return (
        f"{format_count(gradients.cut, 'gradient')} with outlying elements clipped, "
        f"{gradients.shortened} scaled down, "
        f"{format_count(gradients.rejected, 'step')} undone"
    )


def _non_finite_text(summary: AttackSummary) -> str:
    """Return how many values were not finite."""
    non_finite = summary.non_finite
    if not non_finite.objectives and not non_finite.gradient_elements:
        return ""
    objectives = format_count(non_finite.objectives, "objective")
    elements = format_count(non_finite.gradient_elements, "number")
    return f"{objectives}, {elements} of gradients"


def _printability_text(summary: AttackSummary) -> str:
    """Return the print terms of both scenes, in units of sRGB.

    The unit is stated only if there is an adversarial scene.
    """
    printability = summary.printability
    if printability is None:
        return ""
    texts = [_print_terms_text("clean", printability.clean)]
    if printability.adversarial is None:
        return texts[0]
    texts.append(_print_terms_text("adversarial", printability.adversarial))
    return "; ".join(texts) + " (sRGB)"


def _print_terms_text(name: str, terms: PrintTerms) -> str:
    """Return the print terms of a scene, with its name."""
    return (
        f"{name}: step between neighbours {terms.variation:.3g}, distance from "
        f"printable colours {terms.off_print:.3g}"
    )


def _short(value: float) -> str:
    """Return a number with three digits, or a text for one that is not known."""
    return f"{value:.3g}" if math.isfinite(value) else "an unknown amount"


def transport_text(summary: AttackSummary) -> str:
    """Return how images of the search were predicted; empty if that is not known.

    Images may be rendered in full, rendered in part, or predicted by a matrix of light
    transport or by light on surfaces.
    """
    transport = summary.transport
    if transport is None:
        return ""
    if not transport.used:
        text = "every picture was rendered"
        return f"{text}: {transport.reason}" if transport.reason else text
    method = _prediction_method_text(summary, transport.method)
    return "; ".join([method, *_list_prediction_details(transport)])


def _list_prediction_details(transport: LinearTransport) -> list[str]:
    """Return what is known of predicted images: error, renewals, seconds, a reason."""
    details = []
    if transport.error is not None:
        details.append(_prediction_error_text(transport.error))
    if transport.renewed:
        details.append(f"made again {format_count(transport.renewed, 'time')}")
    if transport.seconds is not None:
        seconds = words.format_seconds(transport.seconds)
        details.append(f"it and the comparisons took {seconds}")
    if transport.reason:
        details.append(transport.reason)
    return details


def _prediction_method_text(summary: AttackSummary, method: str | None) -> str:
    """Return by what method images were predicted, and how many."""
    # "products" is the key of predicted images
    n_predicted = format_count(summary.renders.get("products"), "picture")
    if method == "crop":
        return "only the part of each picture was rendered that can change"
    if method == "surface light":
        return f"light on surfaces predicted {n_predicted}"
    if method in (None, "matrix"):
        return f"a matrix predicted {n_predicted}"
    return f"the predictor {method!r} predicted {n_predicted}"


def _prediction_error_text(error: PredictionError) -> str:
    """Return the error of predicted images at the last comparison."""
    levels = _short(error.levels)
    bias = _short(error.margin_bias)
    return (
        f"at the last comparison with a rendered picture its error was {levels} of "
        f"255 levels of the picture's change (root mean square) and {bias} of the "
        "objective"
    )
