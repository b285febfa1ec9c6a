"""A summary (docs/design.md, "summary.json") in plain words, for the final table and the report alike."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

Summary = Mapping[str, Any]

NO_INTERVAL = "no interval"

MARGIN = "how far the wrong answer leads the right one, in logits"
OTHER_MARGIN = "over 0 where the answer is wrong"
NORMS = {"linf": "the largest change of any value", "l2": "the root of the sum of all squared changes"}
"""What these words mean, said where they are first used."""

_REASONS = {
    "budget spent": "The budget is spent.",
    "stalled": "The policy had nothing more to propose.",
    "non-finite objective": "The objective was not a number several times in a row.",
}
"""Why a search ended without an answer, where the name of the ending doesn't say it."""


def verdict(summary: Summary) -> str:
    """Return what the run found, in one sentence that holds on its own."""
    ending = str(summary.get("ending") or "the run ended")
    thing = f"this {noun(summary)}"
    verified = summary.get("verified") or {}
    if ending == "already wrong":
        wrong = _calls(summary, thing, summary.get("clean"))
        return f"The model already {wrong}: nothing was changed and nothing counts as found."
    if not verified.get("trials"):
        return f"{ending[:1].upper()}{ending[1:]} after {count(summary.get('steps'), 'step')}; nothing is verified."
    rate = rate_text(verified) + _each(summary)
    claim = _claim(summary, thing)
    if ending == "found":
        return f"{_how_it_errs(summary, verified, thing)} in {rate}."
    if ending == "interrupted":
        return f"Interrupted; so far {claim} in {rate}."
    if ending == "not verified":
        return f"The search claims an answer that is not confirmed: {claim} in {rate}."
    why = _REASONS.get(ending, f"The search ended: {ending}.")
    return f"No {_changes(summary)} was found that {_wanted(summary, thing)}: {claim} in {rate}. {why}"


def remarks(summary: Summary) -> list[str]:
    """Return what has to be known beside the verdict: the control group, the random search, the run's warnings."""
    said = []
    control = (summary.get("clean") or {}).get("control") or {}
    missed = (control.get("trials") or 0) - (control.get("correct") or 0)
    if missed and summary.get("ending") != "already wrong" and not minimises(summary):
        apart = " They do not count." if over(summary) else ""
        said.append(f"The clean scene itself fails {missed} of its {control['trials']} trials.{apart}")
    if summary.get("answer_from") == "random":
        own = summary.get("policy_verified") or {}
        said.append(
            "The random search beside it found a worse configuration than the policy did "
            f"({tally(own)} with a margin of {own.get('margin', 0.0):.2f}); that of the random search is the answer. "
            f"The margin is {margin_text(summary)}."
        )
    else:
        said += _against_random(summary)
    return said + [str(text) for text in summary.get("warnings") or ()]


def noun(summary: Summary) -> str:
    """Return what the object is called: ``wine glass`` for ``wine-glass`` and ``mug`` for ``data/mug.obj``."""
    return PurePath(str(summary.get("object") or "object")).stem.replace("-", " ").replace("_", " ")


def title(summary: Summary) -> str:
    """Return a short name for the run: ``mug, texture``."""
    return ", ".join([noun(summary), *controls(summary)])


def margin_text(summary: Summary) -> str:
    """Return what the margin of the run's task is, as a clause."""
    return MARGIN if classifies(summary) else OTHER_MARGIN


def classifies(summary: Summary) -> bool:
    """Return whether answers are names of classes."""
    return bool(summary.get("task", "classification") == "classification")


def controls(summary: Summary) -> list[str]:
    """Return the names of the controls."""
    return [str(name) for name in summary.get("controls") or ()]


def over(summary: Summary) -> list[str]:
    """Return the names of the controls that varied by chance."""
    return [str(name) for name in summary.get("over") or ()]


def targets(summary: Summary) -> list[str]:
    """Return the answers that were wanted; empty where any wrong one was."""
    return [str(name) for name in summary.get("target") or ()]


def minimises(summary: Summary) -> bool:
    """Return whether the object was to be easier to recognise."""
    return summary.get("goal") == "a right answer"


def success(summary: Summary) -> str:
    """Return one word for a trial that counts: ``wrong``, ``target`` or ``easier``."""
    return "target" if targets(summary) else "easier" if minimises(summary) else "wrong"


def goal_text(summary: Summary) -> str:
    """Return what was asked for, where it was not just any wrong answer."""
    if targets(summary):
        return f"the model should answer {' or '.join(targets(summary))}"
    return "easier to recognise" if minimises(summary) else ""


def over_text(summary: Summary) -> str:
    """Return what varied by chance: ``camera and environment, drawn anew for every picture``."""
    return f"{' and '.join(over(summary))}, drawn anew for every picture" if over(summary) else ""


def average_text(summary: Summary) -> str:
    """Return ``right in 150 of 200``: over configurations drawn from the whole space; empty if none were."""
    average = summary.get("average") or {}
    return f"right in {average['correct']} of {average['configurations']}" if average else ""


def smallest_text(summary: Summary) -> str:
    """Return the bracket of the smallest epsilon; empty if it was not asked for."""
    bracket = summary.get("smallest") or {}
    if not bracket:
        return ""
    found, below = _epsilons(bracket.get("epsilon")), _epsilons(bracket.get("not_found_at"))
    if not found:
        return f"none found up to {below}"
    floor = f"no search found one at {below}" if below else "no search failed, so it may be smaller still"
    still = "" if bracket.get("closed") or not below else "; the searches did not suffice to bring the two together"
    return f"{found}; {floor}{still}"


def short_name(value: Any) -> str:
    """Return the last part of a path, and a name as it is."""
    return PurePath(str(value)).name or str(value)


def with_article(name: str) -> str:
    """Return ``a mug``, ``an iron``."""
    return f"{'an' if name[:1].lower() in 'aeiou' else 'a'} {name}"


def percent(share: Any) -> str:
    """Return ``83 %`` for 0.83. 100 and 0 are said only of exactly 1 and 0."""
    if share is None:
        return "unknown"
    return f"{_percent_number(float(share))} %"


def interval_text(rated: Mapping[str, Any]) -> str:
    """Return ``83-100 %`` for the interval of a rate."""
    ends = rated.get("interval")
    return f"{_percent_number(ends[0])}-{_percent_number(ends[1])} %" if ends else NO_INTERVAL


def tally(rated: Mapping[str, Any], key: str = "successes") -> str:
    """Return ``20 of 20``."""
    return f"{rated.get(key, 0)} of {rated.get('trials', 0)}"


def rate_text(rated: Mapping[str, Any]) -> str:
    """Return ``20 of 20 fresh renders (95 % interval 83-100 %)``."""
    return f"{tally(rated)} fresh renders (95 % interval {interval_text(rated)})"


def seconds_text(seconds: Any) -> str:
    """Return ``14.6 s``, ``3 min 5 s`` or ``2 h 10 min``."""
    if seconds is None:
        return "unknown"
    whole = round(float(seconds))
    if whole < 100:
        return f"{float(seconds):.1f} s"
    return f"{whole // 60} min {whole % 60} s" if whole < 6000 else f"{whole // 3600} h {whole % 3600 // 60} min"


def count(number: Any, thing: str) -> str:
    """Return ``1 step``, ``40 steps``."""
    return f"{number or 0} {thing}{'' if number == 1 else 's'}"


def changed_text(summary: Summary) -> str:
    """Return `budget_text` with a word on each norm: ``texture within 0.1 (linf: the largest change of any value)``."""
    text = budget_text(summary)
    for norm, meaning in NORMS.items():
        text = text.replace(f"({norm})", f"({norm}: {meaning})", 1)  # at its first use
    return text


def budget_text(summary: Summary) -> str:
    """Return what could change and how far: ``texture within 0.1 (linf)``, as far as the summary says."""
    epsilon, norm = summary.get("epsilon"), summary.get("norm")
    if isinstance(epsilon, Mapping):
        norms = norm if isinstance(norm, Mapping) else {}
        return " and ".join(_within(name, epsilon.get(name), norms.get(name)) for name in controls(summary))
    return _within(" and ".join(controls(summary)) or "nothing", epsilon, norm)


def _within(name: str, epsilon: Any, norm: Any) -> str:
    if not isinstance(epsilon, (int, float)):
        return name
    return f"{name} within {number_text(epsilon)}" + (f" ({norm})" if norm else "")


def _epsilons(told: Mapping[str, float] | None) -> str:
    """``0.0123`` of one control; ``texture 0.01, geometry 0.002`` of several."""
    if not told:
        return ""
    if len(told) == 1:
        return f"{next(iter(told.values())):.3g}"
    return ", ".join(f"{name} {value:.3g}" for name, value in told.items())


def renders_text(summary: Summary) -> str:
    """Return ``40 of the search, 40 gradients, 21 of the verification``."""
    renders = summary.get("renders") or {}
    known = {"search": "of the search", "gradient": "gradients", "verification": "of the verification"}
    known["baseline"] = "of the random search"
    spent = [f"{number} {known.get(name, f'of {name}')}" for name, number in renders.items() if number]
    return ", ".join(spent) or ("none" if renders else "unknown")


def formation_text(summary: Summary) -> str:
    """Return the image formation: ``128 x 128 pixels, box filter, denoised (oidn), exposure 0 stops``."""
    formation = summary.get("image_formation") or {}
    said = []
    if formation.get("resolution"):
        said.append(" x ".join(str(side) for side in formation["resolution"]) + " pixels")
    if formation.get("filter"):
        said.append(f"{formation['filter']} filter")
    denoiser = formation.get("denoiser")
    if denoiser:
        said.append("not denoised" if denoiser == "none" else f"denoised ({denoiser})")
    if formation.get("exposure") is not None:
        said.append(f"exposure {number_text(formation['exposure'])} stops")
    known = ("resolution", "filter", "denoiser", "exposure")
    return ", ".join(said + [f"{name} {number_text(value)}" for name, value in formation.items() if name not in known])


def number_text(value: Any) -> str:
    """Return a value as text; a number with the digits that mean something to a reader."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _how_it_errs(summary: Summary, verified: Mapping[str, Any], thing: str) -> str:
    """Return "The model calls this mug a vase" where that is known of every trial, a weaker clause otherwise."""
    if minimises(summary):
        return f"The model recognises {thing}, more surely than in the clean scene,"
    answers = verified.get("labels") or {}
    if len(answers) == 1:
        return f"The model {_calls(summary, thing, {'label': next(iter(answers))})}"
    if answers:
        most = max(answers, key=lambda label: answers[label])
        what = "takes {} for one of the targets" if targets(summary) else "is wrong about {}"
        often = f"calling it {with_article(most)}" if classifies(summary) else f'answering "{most}"'
        return f"The model {what.format(thing)}, most often {often},"
    if not classifies(summary):
        return f"The model is wrong about {thing}"
    return f"The model takes {thing} for something else ({_called(summary.get('adversarial'))})"


def _claim(summary: Summary, thing: str) -> str:
    """Return what a trial counts as, as a clause: "the model is wrong about this mug"."""
    if minimises(summary):
        return f"the model recognises {thing}, more surely than in the clean scene,"
    if targets(summary):
        return f"the model calls {thing} {_a_target(summary)}"
    return "it is wrong" if summary.get("ending") in _REASONS else f"the model is wrong about {thing}"


def _wanted(summary: Summary, thing: str) -> str:
    """Return what was looked for, as a clause: "makes the model miss this mug"."""
    if minimises(summary):
        return f"makes {thing} easier to recognise"
    return f"makes the model call {thing} {_a_target(summary)}" if targets(summary) else f"makes the model miss {thing}"


def _a_target(summary: Summary) -> str:
    return " or ".join(with_article(name) for name in targets(summary))


def _each(summary: Summary) -> str:
    """Return what is said of the renders of an answer that holds for many conditions."""
    return f", each with another {' and '.join(over(summary))}" if over(summary) else ""


def _against_random(summary: Summary) -> list[str]:
    verified, baseline = summary.get("verified") or {}, summary.get("baseline") or {}
    random = baseline.get("verified") or {}
    if not (verified.get("trials") and random.get("trials")):
        return []
    ours, theirs = (one["successes"] / one["trials"] for one in (verified, random))
    if theirs > ours:
        return [f"Random search with as many renders does better: {tally(random)}."]
    if theirs == ours and ours > 0:
        return [f"Random search with as many renders does as well: {tally(random)}. The policy adds nothing here."]
    return []


def _calls(summary: Summary, thing: str, answer: Any) -> str:
    """Return ``calls this mug a vase``, or ``answers "0.81" for this mug`` where answers are no names."""
    if classifies(summary):
        return f"calls {thing} {_called(answer)}"
    label = (answer or {}).get("label") or "something else"
    return f'answers "{label}" for {thing}'


def _called(answer: Any) -> str:
    label = (answer or {}).get("label")
    return with_article(str(label)) if label else "something else"


def _changes(summary: Summary) -> str:
    return budget_text(summary) if controls(summary) else "configuration"


def _percent_number(share: float) -> str:
    value = 100.0 * share
    near_end = (99.0 < value < 100.0 and round(value) == 100) or (0.0 < value < 1.0 and round(value) == 0)
    return f"{min(max(value, 0.1), 99.9):.1f}" if near_end else f"{value:.0f}"
