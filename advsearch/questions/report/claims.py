"""What a run stands for: the claims of its question, or why there is none."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from advsearch import rooms
from advsearch.report import wording
from advsearch.report.claims import (
    ENDED,
    NO_PROOF,
    WHY,
    Claim,
    Extent,
    average_claim,
    case_claim,
    claim,
    extent_of,
    nothing_claimed,
    searches_text,
    share_text,
)
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.base import Result
from advsearch.runs.results.gap import CurveResult, GapResult
from advsearch.runs.results.matrix import MatrixResult
from advsearch.runs.results.photos import PhotoAgreement
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


def claims_of(result: Result) -> list[Claim]:
    """Return what a run stands for; one that stands for nothing says so in a claim of that kind."""
    if result.goes_on:
        told = f"; so far: {result.brief}" if result.brief else ""
        return [nothing_claimed(f"the run was stopped before its end{told}")]
    if own := rooms.in_room(result.command, "words", "claims"):
        return list(own(result)) or [nothing_claimed("nothing in this run came to its end")]
    for kind, claims in _CLAIMS.items():
        if isinstance(result, kind):
            return list(claims(result)) or [nothing_claimed("nothing in this run came to its end")]
    return [nothing_claimed(f"the command {result.command} measures something else than how often a model is right")]


def photo_claims(photos: PhotoAgreement) -> list[Claim]:
    """Return what photographs of a run's renderings say."""
    if not photos.photos or photos.interval is None:
        return []
    agreeing = photos.right_right + photos.wrong_wrong
    extent = Extent(what="photographs that agree", count=agreeing, total=photos.photos, interval=photos.interval)
    said = "Photographs and renderings agree (both right, or both wrong) in "
    return [claim("measured", f"{said}{share_text(extent)}. The interval takes photographs as independent.", extent)]


def nothing_there(why: str) -> Claim:
    """Return the claim of a run without a result."""
    return nothing_claimed(why)


# ---- by command -----------------------------------------------------------------------------------------------------


def _attack(result: AttackSummary) -> Iterator[Claim]:
    rate, spent = result.verified, searches_text(result.renders, result.policy, result.baseline is not None)
    said = wording.attack_verdict(result)
    extent = extent_of("fresh renders that count as a success", rate)
    if result.ending == "found" and rate is not None and rate.successes:
        yield claim("found", f"{said} How many such configurations there are is not known.", extent)
    elif result.ending in ENDED and rate is not None:
        yield claim("not found", f"{said} Searched were {spent}. {NO_PROOF}", extent)
    else:
        why = WHY.get(result.ending, f"the search ended as {result.ending!r} without trials that carry a claim")
        yield nothing_claimed(why, said)
    if result.average is not None:
        yield average_claim(result.average, wording.budget_text(result))


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
        yield claim("measured", f"The model is right in {share_text(extent)} {how}.{note}", extent)
    for row in models:  # they are shown the same pictures, so that answers of several are not independent
        own = Extent(what=extent.what, count=row.correct, total=row.configurations, interval=row.interval or (0.0, 1.0))
        yield claim(
            "measured", f"The model {row.value} is right in {share_text(own)} {how}{_in_each(result)}.{note}", own
        )
    worst = result.worst.verified if result.worst else None
    if worst is not None:
        text = f"In the worst of these configurations the model is wrong in {wording.rate_text(worst)}."
        yield claim("measured", f"{text} No search looked for a worse one.", extent_of("wrong", worst))


def _in_each(result: SweepSummary) -> str:
    """That there are as many in each of several objects and environments, which are not drawn."""
    several = {name: sum(row.axis == name for row in result.axes) for name in ("object", "environment")}
    each = [f"each of the {count} {name}s" for name, count in several.items() if count > 1]
    return f", as many in {' and '.join(each)}" if each else ""


def _gap(result: GapResult) -> Iterator[Claim]:
    for row in result.table:
        name = f"{row.object}, {row.control}"
        yield average_claim(row.average, name)
        spent = searches_text(row.renders, result.policy, bool(row.renders.get("baseline")))
        yield case_claim(name, row.ending, row.worst, spent)


def _curve(result: CurveResult) -> Iterator[Claim]:
    each = [row.renders for row in result.table if row.renders]
    total = {kind: sum(one.get(kind, 0) for one in each) for kind in {kind for one in each for kind in one}}
    searched = searches_text(total, result.policy, bool(total.get("baseline")))
    spent = f"Searched were, of all objects and epsilons together, {searched}. "
    for point in result.curve:
        if point.accuracy is None:
            continue
        extent = Extent(
            what="objects without a failure", count=point.robust, total=point.objects, interval=point.interval
        )
        where = "the controls' own budget" if point.epsilon is None else f"epsilon {point.epsilon:g}"
        text = (
            f"Within {where} the policy {result.policy} found no failure of {share_text(extent)} objects; "
            f"{point.already_wrong} are wrong as they are. {spent if total else ''}{NO_PROOF}"
        )
        yield claim("measured", text, extent)


def _matrix(result: MatrixResult) -> Iterator[Claim]:
    for row in result.table:
        for cell in row.tested:
            name = f"searched on {row.attacked}, tried on {cell.model}"
            own = cell.model == row.attacked
            spent = searches_text(row.renders, result.policy, False) if own else None
            yield case_claim(name, cell.ending, cell.verified, spent)


_CLAIMS: dict[type[Result], Callable[[Any], Iterator[Claim]]] = {
    AttackSummary: _attack,
    SweepSummary: _sweep,
    GapResult: _gap,
    CurveResult: _curve,
    MatrixResult: _matrix,
}

# ---- parts ----------------------------------------------------------------------------------------------------------


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
