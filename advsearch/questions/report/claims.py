"""What a run stands for: the claims of its question, or why there is none."""

from __future__ import annotations

from collections.abc import Sequence

from advsearch import rooms
from advsearch.questions.photographs.answer import PhotoAgreement
from advsearch.report.claims import (
    Claim,
    Extent,
    claim,
    nothing_claimed,
    share_text,
)
from advsearch.runs.results.base import Result

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
