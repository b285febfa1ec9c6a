"""A summary (docs/answers.md) in plain words, for the final table and the report alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from advsearch.report import phrases
from advsearch.settings import split_names

if TYPE_CHECKING:
    from advsearch.runs.results.attack import AttackSummary, SharedWork, VerifiedRate
    from advsearch.runs.results.base import ConditionRow, Formation, Interval

NO_INTERVAL = "no interval"

PATH = "path"
"""The control whose conditions are moments."""

NORMS = {"linf": "the largest change of any value", "l2": "the root of the sum of all squared changes"}
"""What these words mean, said where they are first used."""

_REASONS = {
    "budget spent": "The budget is spent.",
    "stalled": "The policy had nothing more to propose.",
    "non-finite objective": "The objective was not a number several times in a row.",
}
"""Why a search ended without an answer, where the name of the ending doesn't say it."""


def attack_verdict(summary: AttackSummary) -> str:
    """Return what the run found, in one sentence that holds on its own."""
    ending, verified = summary.ending, summary.verified
    thing = f"this {noun(summary)}"
    if ending == "already wrong":
        wrong = phrases.calls(summary.task, thing, summary.clean.label)
        return f"The model already {wrong}: nothing was changed and nothing counts as found."
    if verified is None and ending == "interrupted" and summary.adversarial:
        says = phrases.calls(summary.task, thing, summary.adversarial.label)
        return f"Interrupted after {count(summary.steps, 'step')}. The answer so far is not verified: the model {says}."
    if verified is None:
        return f"{ending[:1].upper()}{ending[1:]} after {count(summary.steps, 'step')}; nothing is verified."
    rate = rate_text(verified) + another_text(summary.over)
    claim = _claim(summary, thing)
    if ending == "found":
        return f"{_how_it_errs(summary, verified, thing)} in {rate}."
    if ending == "interrupted":
        return f"Interrupted; so far {claim} in {rate}."
    if ending == "not verified":
        return f"The search claims an answer that is not confirmed: {claim} in {rate}."
    why = _REASONS.get(ending, f"The search ended: {ending}.")
    return f"No {budget_text(summary)} was found that {_wanted(summary, thing)}: {claim} in {rate}. {why}"


def another_text(over: Sequence[str]) -> str:
    """Return what is another one in each trial: ``, each with another camera``; of a path it is the moment."""
    others = [name for name in over if name != PATH]
    said = [f"with another {' and '.join(others)}"] if others else []
    said += ["at another moment of the path"] if PATH in over else []
    return f", each {' and '.join(said)}" if said else ""


def remarks(summary: AttackSummary) -> list[str]:
    """Return what has to be known beside the verdict: the control group, the random search, the run's warnings."""
    said = []
    control, own = summary.clean.control, summary.policy_verified
    missed = control.trials - control.correct if control else 0
    if control and missed and summary.ending != "already wrong" and not summary.minimises:
        apart = " They do not count." if summary.over else ""
        nothing = f"; in {control.not_a_number} the answer is not a number" if control.not_a_number else ""
        said.append(f"The clean scene itself fails {missed} of its {control.trials} trials{nothing}.{apart}")
    if summary.answer_from == "random" and own:
        said.append(
            "The random search beside it found a worse configuration than the policy did "
            f"({own.successes} of {own.trials} with a margin of {own.margin:.2f}); that of the random search is the "
            f"answer. The margin is {phrases.margin_text(summary.task)}."
        )
    else:
        said += _against_random(summary)
    return said + summary.warnings


def noun(summary: AttackSummary) -> str:
    """Return what the object is called: ``wine glass`` for ``wine-glass`` and ``mug`` for ``data/mug.obj``."""
    return PurePath(summary.object).stem.replace("-", " ").replace("_", " ")


def title(summary: AttackSummary) -> str:
    """Return a short name for the run: ``mug, texture``."""
    return ", ".join([noun(summary), *summary.controls])


def success(summary: AttackSummary) -> str:
    """Return one word for a trial that counts: ``wrong``, ``target`` or ``easier``."""
    return "target" if summary.target else "easier" if summary.minimises else "wrong"


def goal_text(summary: AttackSummary) -> str:
    """Return what was asked for, where it was not just any wrong answer."""
    if summary.target:
        return f"the model should answer {' or '.join(summary.target)}"
    return "easier to recognise" if summary.minimises else ""


def objective_text(summary: AttackSummary) -> str:
    """Return what came of an objective that is no margin, over the trials; empty where there is nothing to say."""
    tried = summary.tried_objective
    if tried is None or summary.objective in phrases.SUCCESS_ABOVE_ZERO:
        return ""
    parts = [
        f"{name} {one.mean:.3g} (from {one.low:.3g} to {one.high:.3g})"
        for name, one in (("clean", tried.clean), ("answer", tried.answer))
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
    answer = "" if drive.answer is None else f", {drive.answer} with the answer"
    return f"right in {drive.clean} of {drive.frames} frames of the clean scene{answer}"


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


def short_name(value: Any) -> str:
    """Return the last part of a path, and a name as it is."""
    return PurePath(str(value)).name or str(value)


def value_text(value: Any) -> str:
    """Return a value of a parameter, or the ends of a part of its range."""
    if isinstance(value, (list, tuple)):
        return " to ".join(map(value_text, value))
    return f"{value:.4g}" if isinstance(value, float) else short_name(value)


def figure_value(value: float | str) -> str:
    """Return a value as figures write it; of a file, its name without folder and suffix."""
    if isinstance(value, str):
        return PurePath(value).stem if "/" in value else value
    return f"{value:.4g}"


def short_names(text: str) -> str:
    """Return the last parts of paths, of one or of several separated by commas: ``a.hdr, studio``."""
    return ", ".join(map(short_name, split_names(text)))


def interval_text(interval: Interval | None) -> str:
    """Return ``83-100 %`` for the interval of a rate."""
    return f"{phrases.percent_number(interval[0])}-{phrases.percent_number(interval[1])} %" if interval else NO_INTERVAL


def rate_text(rated: VerifiedRate) -> str:
    """Return ``20 of 20 fresh renders (95 % interval 83-100 %)``; and how many answers are not numbers."""
    nothing = f"in {rated.not_a_number} its answer is not a number" if rated.not_a_number else ""
    if nothing and not rated.successes:
        return f"none of {rated.trials} fresh renders: {nothing}"
    rate = f"{rated.successes} of {rated.trials} fresh renders (95 % interval {interval_text(rated.interval)})"
    return f"{rate}, and {nothing}" if nothing else rate


def no_numbers(count: int) -> str:
    """Return what a table adds to a rate where answers are not numbers."""
    return f", {count} not a number" if count else ""


def tally(what: str, number: int, trials: int, not_a_number: int = 0) -> str:
    """Return ``wrong in 20 of 20``; of answers that are not numbers, how many."""
    nothing = f"not a number in {not_a_number} of {trials}"
    if not not_a_number:
        return f"{what} in {number} of {trials}"
    return f"{what} in {number}, {nothing}" if number else nothing


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


def workers_text(shared: SharedWork | None) -> str:
    """How many shared the work, and where their time went; empty where nothing was shared."""
    if shared is None:
        return ""
    told = [f"{shared.most} at most"]
    if shared.utilisation is not None:
        told.append(f"busy {phrases.percent(shared.utilisation)} of {seconds_text(shared.alive)}")
    told.append(f"loading took {seconds_text(shared.loading)}")
    counts = {"lost": shared.lost, "refused": shared.refused, "given out again": shared.retried}
    return ", ".join([*told, *(f"{number} {what}" for what, number in counts.items() if number)])


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


def _epsilons(told: Mapping[str, float] | None) -> str:
    """``0.0123`` of one control; ``texture 0.01, geometry 0.002`` of several."""
    if not told:
        return ""
    if len(told) == 1:
        return f"{next(iter(told.values())):.3g}"
    return ", ".join(f"{name} {value:.3g}" for name, value in told.items())


def renders_text(summary: AttackSummary) -> str:
    """Return ``40 of the search, 40 gradients, 21 of the verification``."""
    known = {"search": "of the search", "gradient": "gradients", "verification": "of the verification"}
    known |= {"baseline": "of the random search", "unprinted": "of the search without print terms"}
    known |= {"products": "predicted"}
    spent = [f"{number} {known.get(name, f'of {name}')}" for name, number in summary.renders.items() if number]
    return ", ".join(spent) or "none"


def print_cost_text(summary: AttackSummary) -> str:
    """Return ``margin 4.1 with the print terms, 6.3 without (200 steps): they cost 2.2 logits``; empty: not known."""
    cost = None if summary.printability is None else summary.printability.cost
    if cost is None or cost.cost is None or cost.margin_with is None or cost.margin_without is None:
        return ""
    said = f"they cost {cost.cost:.3g} logits" if cost.cost > 0 else "they cost nothing that shows here"
    margins = f"margin {cost.margin_with:.3g} with the print terms, {cost.margin_without:.3g} without"
    return f"{margins} (another search of {count(cost.steps, 'step')}, {cost.verified.trials} trials each): {said}"


def formation_text(formation: Formation, gains: Mapping[str, float] | None = None) -> str:
    """Return the image formation: ``128 x 128 pixels, box filter, denoised (oidn), exposure 0 stops, gain 1.35``; gains
    of several scenes by their names."""
    height, width = formation.resolution
    denoised = "not denoised" if formation.denoiser == "none" else f"denoised ({formation.denoiser})"
    exposure = f"exposure {number_text(formation.exposure)} stops"
    made = f"{height} x {width} pixels, {formation.filter} filter, {denoised}, {exposure}"
    if formation.gain is not None:
        gain = f"gain {number_text(formation.gain)}"
    else:
        each = "; ".join(
            f"{', '.join(map(short_name, name.split(', ')))} {number_text(value)}"
            for name, value in (gains or {}).items()
        )
        gain = "a gain for each scene" + (f": {each}" if each else "")
    return f"{made}, sampler {formation.sampler}, {gain}"


def number_text(value: Any) -> str:
    """Return a value as text; a number with the digits that mean something to a reader."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _how_it_errs(summary: AttackSummary, verified: VerifiedRate, thing: str) -> str:
    """Return "The model calls this mug a vase" where that is known of every trial, a weaker clause otherwise."""
    if summary.minimises:
        return f"The model recognises {thing}, more surely than in the clean scene,"
    answers = verified.labels
    if len(answers) == 1:
        return f"The model {phrases.calls(summary.task, thing, next(iter(answers)))}"
    if answers:
        most = max(answers, key=lambda label: answers[label])
        what = "takes {} for one of the targets" if summary.target else "is wrong about {}"
        return f"The model {what.format(thing)}, most often {phrases.calling(summary.task, most)},"
    if summary.task != phrases.CLASSIFICATION:
        return f"The model is wrong about {thing}"
    called = phrases.with_article(summary.adversarial.label) if summary.adversarial else "something else"
    return f"The model takes {thing} for something else ({called})"


def _claim(summary: AttackSummary, thing: str) -> str:
    """Return what a trial counts as, as a clause: "the model is wrong about this mug"."""
    if summary.minimises:
        return f"the model recognises {thing}, more surely than in the clean scene,"
    if summary.target and summary.task == phrases.CLASSIFICATION:
        return f"the model calls {thing} {_a_target(summary)}"
    if summary.target:
        return f"the model answers {' or '.join(summary.target)}"
    return "it is wrong" if summary.ending in _REASONS else f"the model is wrong about {thing}"


def _wanted(summary: AttackSummary, thing: str) -> str:
    """Return what was looked for, as a clause: "makes the model miss this mug"."""
    if summary.minimises:
        return f"makes {thing} easier to recognise"
    return (
        f"makes the model call {thing} {_a_target(summary)}"
        if summary.target
        else phrases.wanted(summary.objective, thing)
    )


def _a_target(summary: AttackSummary) -> str:
    return " or ".join(phrases.with_article(name) for name in summary.target or ())


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


def conditions_text(conditions: Sequence[ConditionRow]) -> str:
    """Return conditions in one phrase."""
    return " and ".join(one.text for one in conditions) or "everything that was looked at"
