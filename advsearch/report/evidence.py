"""What runs stand for, in claims that a model card or a safety case can quote. All rules of wording are here.

A claim is one of four kinds, and `claims_of` is the only place that chooses one:

- `found`: the search ended as `found` and fresh renders confirm it. It says that such a configuration exists.
- `not found`: the search ran to its end and its best answer was rendered afresh. It says how many renders of which
  policy found none, and that this shows no absence.
- `measured`: a share that was counted to the end, with its interval and what was counted.
- `nothing claimed`: everything else: interrupted, wrong already, not verified, broken off, of an unknown ending, or a
  run that says nothing about how often a model is right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any

from advsearch import rooms
from advsearch.report import wording
from advsearch.report.explanations import conditions_text, envelope_text
from advsearch.report.phrases import percent
from advsearch.runs.results.attack import AttackSummary, AverageCase, VerifiedRate
from advsearch.runs.results.base import Result
from advsearch.runs.results.evidence import Claim, Extent, Kind
from advsearch.runs.results.explain import ExplainResult
from advsearch.runs.results.gap import CurveResult, GapResult
from advsearch.runs.results.harden import HardenResult
from advsearch.runs.results.matrix import MatrixResult
from advsearch.runs.results.photos import PhotoAgreement
from advsearch.runs.results.region import RegionResult
from advsearch.runs.results.replay import ReplayResult
from advsearch.runs.results.sweep import SweepSummary
from advsearch.settings import split_names

RULES = (
    "Each claim is about the run's own model, object, environment, label and settings, and about nothing else.",
    "`found`: fresh renders confirm a configuration that a search found; how many others there are is not known.",
    "`not found`: a search of so many renders found none; another policy or more renders may find one.",
    "`measured`: a share of what was counted; its interval has 95 % confidence (Clopper-Pearson) and holds for the "
    "distribution that was drawn from.",
    "`nothing claimed`: the run does not carry a claim, for the reason that it gives.",
    "Renderings are not photographs: a claim is about reality only as far as photographs were compared.",
)
"""How claims are to be read."""

QUICK = "Made by a quick recipe: few and small pictures, to see what comes out; no result."
NOTHING = "Nothing is claimed"
NO_PROOF = "This does not show that there is none."
ENDED = ("budget spent", "stalled")
"""Endings of a search that ran to its end without an answer."""

_WHY = {
    "already wrong": "the model is wrong about the clean scene already",
    "interrupted": "it was interrupted",
    "out of time": "its time was up before its end",
    "not verified": "fresh renders did not confirm what the search found",
    "non-finite objective": "the search broke off, as its objective was not a number",
}


def claims_of(result: Result) -> list[Claim]:
    """Return what a run stands for; one that stands for nothing says so in a claim of that kind."""
    if result.goes_on:
        told = f"; so far: {result.brief}" if result.brief else ""
        return [_nothing(f"the run was stopped before its end{told}")]
    if own := rooms.in_room(result.command, "words", "claims"):
        return list(own(result))
    for kind, claims in _CLAIMS.items():
        if isinstance(result, kind):
            return list(claims(result)) or [_nothing("nothing in this run came to its end")]
    return [_nothing(f"the command {result.command} measures something else than how often a model is right")]


def photo_claims(photos: PhotoAgreement) -> list[Claim]:
    """Return what photographs of a run's renderings say."""
    if not photos.photos or photos.interval is None:
        return []
    agreeing = photos.right_right + photos.wrong_wrong
    extent = Extent(what="photographs that agree", count=agreeing, total=photos.photos, interval=photos.interval)
    said = "Photographs and renderings agree (both right, or both wrong) in "
    return [_claim("measured", f"{said}{_share(extent)}. The interval takes photographs as independent.", extent)]


def nothing_there(why: str) -> Claim:
    """Return the claim of a run without a result."""
    return _nothing(why)


# ---- by command -----------------------------------------------------------------------------------------------------


def _attack(result: AttackSummary) -> Iterator[Claim]:
    rate, spent = result.verified, _searches(result.renders, result.policy, result.baseline is not None)
    said = wording.attack_verdict(result)
    extent = _extent("fresh renders that count as a success", rate)
    if result.ending == "found" and rate is not None and rate.successes:
        yield _claim("found", f"{said} How many such configurations there are is not known.", extent)
    elif result.ending in ENDED and rate is not None:
        yield _claim("not found", f"{said} Searched were {spent}. {NO_PROOF}", extent)
    else:
        why = _WHY.get(result.ending, f"the search ended as {result.ending!r} without trials that carry a claim")
        yield _nothing(why, said)
    if result.average is not None:
        yield _average(result.average, wording.budget_text(result))


def _sweep(result: SweepSummary) -> Iterator[Claim]:
    if result.accuracy is None or result.interval is None or result.ending != "finished":
        return
    extent = Extent(
        what="configurations in which the model is right",
        count=result.correct,
        total=result.configurations,
        interval=result.interval,
    )
    how = "configurations drawn by chance from the ranges that are named"
    note = ""
    if result.sampler is None and not result.grid:
        how = "configurations"
        note = " How these were chosen is not known; the interval takes them as a sample."
    elif result.sampler is None:
        how = "points of the grid"
        note = " Nothing is said of what lies between or beside these points; the interval takes them as a sample."
    elif result.sampler != "random" or result.grid:
        how = f"configurations drawn by the sampler {result.sampler}" + (" at each point of a grid" * bool(result.grid))
        note = " The interval is that of independent draws, which these are not."
    models = [row for row in result.axes if row.axis == "model"]
    if len(split_names(result.model)) < 2 or not models:
        how += _in_each(result)
        yield _claim("measured", f"The model is right in {_share(extent)} {how}.{note}", extent)
    for row in models:  # they are shown the same pictures, so that answers of several are not independent
        own = Extent(what=extent.what, count=row.correct, total=row.configurations, interval=row.interval or (0.0, 1.0))
        yield _claim("measured", f"The model {row.value} is right in {_share(own)} {how}{_in_each(result)}.{note}", own)
    worst = result.worst.verified if result.worst else None
    if worst is not None:
        text = f"In the worst of these configurations the model is wrong in {wording.rate_text(worst)}."
        yield _claim("measured", f"{text} No search looked for a worse one.", _extent("wrong", worst))


def _in_each(result: SweepSummary) -> str:
    """That there are as many in each of several objects and environments, which are not drawn."""
    several = {name: sum(row.axis == name for row in result.axes) for name in ("object", "environment")}
    each = [f"each of the {count} {name}s" for name, count in several.items() if count > 1]
    return f", as many in {' and '.join(each)}" if each else ""


def _gap(result: GapResult) -> Iterator[Claim]:
    for row in result.table:
        name = f"{row.object}, {row.control}"
        yield _average(row.average, name)
        spent = _searches(row.renders, result.policy, bool(row.renders.get("baseline")))
        yield _case(name, row.ending, row.worst, spent)


def _curve(result: CurveResult) -> Iterator[Claim]:
    each = [row.renders for row in result.table if row.renders]
    total = {kind: sum(one.get(kind, 0) for one in each) for kind in {kind for one in each for kind in one}}
    searched = _searches(total, result.policy, bool(total.get("baseline")))
    spent = f"Searched were, of all objects and epsilons together, {searched}. "
    for point in result.curve:
        if point.accuracy is None:
            continue
        extent = Extent(
            what="objects without a failure", count=point.robust, total=point.objects, interval=point.interval
        )
        where = "the controls' own budget" if point.epsilon is None else f"epsilon {point.epsilon:g}"
        text = (
            f"Within {where} the policy {result.policy} found no failure of {_share(extent)} objects; "
            f"{point.already_wrong} are wrong as they are. {spent if total else ''}{NO_PROOF}"
        )
        yield _claim("measured", text, extent)


def _matrix(result: MatrixResult) -> Iterator[Claim]:
    for row in result.table:
        for cell in row.tested:
            name = f"searched on {row.attacked}, tried on {cell.model}"
            own = cell.model == row.attacked
            spent = _searches(row.renders, result.policy, False) if own else None
            yield _case(name, cell.ending, cell.verified, spent)


def _region(result: RegionResult) -> Iterator[Claim]:
    if not result.samples or result.same is None or result.interval is None or result.verdict is None:
        return
    extent = Extent(
        what=f"samples that are {result.verdict}", count=result.same, total=result.samples, interval=result.interval
    )
    box = ", ".join(f"{side.name} {side.low:.4g} to {side.high:.4g} {side.unit}".strip() for side in result.box or ())
    text = f"Inside {box or 'the box'} the model is {result.verdict} in {_share(extent)} samples drawn evenly from it."
    yield _claim("measured", f"{text} Certified by sampling: single points of it may differ.", extent)


def _replay(result: ReplayResult) -> Iterator[Claim]:
    for row in result.table:
        name = f"the answer of {PurePath(result.answer).name}, {row.way}"
        name += "" if row.way == row.condition else f": {row.condition}"
        yield _case(name, row.ending, row.verified, None)


def _explain(result: ExplainResult) -> Iterator[Claim]:
    box = result.envelope
    if box is None or not box.held or not box.total:
        yield _nothing("no box of values was shown to keep the accuracy that was asked for", envelope_text(result))
        return
    extent = Extent(
        what="right, of rows that did not choose the box", count=box.right, total=box.total, interval=box.interval
    )
    text = f"Inside {conditions_text(box.conditions)} the model is right in {_share(extent)} configurations"
    yield _claim("measured", f"{text} that did not choose this box; the sweeps drew no others.", extent)


def _harden(result: HardenResult) -> Iterator[Claim]:
    scenes = [("before", result.before), ("after hardening", result.after)]
    for when, share in scenes:
        if share is not None:
            extent = Extent(what="held-out scenes", count=share.right, total=share.count, interval=share.interval)
            text = f"{when.capitalize()}, the searches ({result.search}) found no failure in {_share(extent)} held-out"
            yield _claim("measured", f"{text} scenes. {NO_PROOF}", extent)


_CLAIMS: dict[type[Result], Callable[[Any], Iterator[Claim]]] = {
    AttackSummary: _attack,
    SweepSummary: _sweep,
    GapResult: _gap,
    CurveResult: _curve,
    MatrixResult: _matrix,
    RegionResult: _region,
    ReplayResult: _replay,
    ExplainResult: _explain,
    HardenResult: _harden,
}

# ---- parts ----------------------------------------------------------------------------------------------------------


def _case(name: str, ending: str, rate: VerifiedRate | None, spent: str | None) -> Claim:
    """One answer of many. `spent` is what was searched; None where nothing was, and an answer was only tried again."""
    extent = _extent("fresh renders that count as a success", rate)
    if ending == "found" and rate is not None and rate.successes:
        return _claim("found", f"{name}: an answer holds in {wording.rate_text(rate)}.", extent)
    if rate is not None and spent is None and ending in (*ENDED, "not verified"):
        return _claim("measured", f"{name}: the answer is not confirmed, in {wording.rate_text(rate)}.", extent)
    if rate is not None and ending in ENDED:
        text = f"{name}: no failure was found; the best answer counts in {wording.rate_text(rate)}."
        return _claim("not found", f"{text} Searched were {spent}. {NO_PROOF}", extent)
    return _nothing(_WHY.get(ending, f"it ended as {ending!r}"), f"This is about {name}.")


def _average(case: AverageCase, name: str) -> Claim:
    extent = Extent(
        what="configurations in which the model is right",
        count=case.correct,
        total=case.configurations,
        interval=case.interval,
    )
    text = f"{name}: the model is right in {_share(extent)} configurations drawn by chance"
    text += " from the whole space and budget."
    return _claim("measured", text, extent)


def _searches(renders: Mapping[str, int], policy: str, random: bool) -> str:
    """``24 renders by the policy auto and 24 by random search``; what was predicted instead is said too."""
    own = renders.get("search", 0) + renders.get("gradient", 0)
    text = f"{wording.count(own, 'render')} by the policy {policy}"
    if renders.get("products"):
        text += f", {renders['products']} more predicted,"
    return f"{text} and {renders.get('baseline', 0)} by random search" if random else text


def _extent(what: str, rate: VerifiedRate | None) -> Extent | None:
    if rate is None:
        return None
    return Extent(what=what, count=rate.successes, total=rate.trials, interval=rate.interval)


def _share(extent: Extent) -> str:
    share = percent(extent.count / extent.total) if extent.total else "none"
    return f"{extent.count} of {extent.total} ({share}, 95 % interval {wording.interval_text(extent.interval)})"


def _nothing(why: str, more: str = "") -> Claim:
    return _claim("nothing claimed", f"{NOTHING}: {why}.{' ' + more if more else ''}", None)


def _claim(kind: Kind, text: str, extent: Extent | None) -> Claim:
    return Claim(kind=kind, statement=text, extent=extent)


def warnings_over(models: Sequence[str], digests: Sequence[str]) -> list[str]:
    """Return what has to be known of runs together.

    Args:
        models: of each run.
        digests: of each run's model files, one text a run; empty where none is known.
    """
    said = []
    if len(set(models)) > 1:
        names = ", ".join(sorted(set(models)))
        said.append(f"The runs are of different models: {names}. A claim about one is none about another.")
    for model in sorted(set(models)):
        known = {text for one, text in zip(models, digests, strict=True) if one == model and text}
        if len(known) > 1:
            said.append(f"{model}: its file was not the same in all runs, so that they are of {len(known)} models.")
    return said
