"""Claims: sentences that a run stands for, and no more than that. All rules of wording are here.

A claim is one of four kinds:

- `found`: the search ended as `found` and fresh renders confirm it. It says that such a configuration exists.
- `not found`: the search ran to its end and its best answer was rendered afresh. It says how many renders of which
  policy found none, and that this shows no absence.
- `measured`: a share that was counted to the end, with its interval and what was counted.
- `nothing claimed`: everything else: interrupted, wrong already, not verified, broken off, of an unknown ending, or a
  run that says nothing about how often a model is right.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from advsearch.report import wording
from advsearch.report.phrases import percent
from advsearch.runs.results.attack import AverageCase, VerifiedRate
from advsearch.runs.results.base import Fields, Interval

Kind = Literal["found", "not found", "measured", "nothing claimed"]


class Extent(Fields):
    """A count with the interval of its share."""

    what: str = Field(description="what was counted")
    count: int
    total: int = Field(alias="of")
    interval: Interval = Field(description="95 %, of the share")


class Claim(Fields):
    """One sentence that a run stands for, and no more than that."""

    kind: Kind = Field(description="`found`, `not found`, `measured` or `nothing claimed`")
    statement: str
    extent: Extent | None = Field(description="null where nothing was counted")


NOTHING = "Nothing is claimed"


NO_PROOF = "This does not show that there is none."


ENDED = ("budget spent", "stalled")
"""Endings of a search that ran to its end without an answer."""


WHY = {
    "already wrong": "the model is wrong about the clean scene already",
    "interrupted": "it was interrupted",
    "out of time": "its time was up before its end",
    "not verified": "fresh renders did not confirm what the search found",
    "non-finite objective": "the search broke off, as its objective was not a number",
}


def case_claim(name: str, ending: str, rate: VerifiedRate | None, spent: str | None) -> Claim:
    """One answer of many. `spent` is what was searched; None where nothing was, and an answer was only tried again."""
    extent = extent_of("fresh renders that count as a success", rate)
    if ending == "found" and rate is not None and rate.successes:
        return claim("found", f"{name}: an answer holds in {wording.rate_text(rate)}.", extent)
    if rate is not None and spent is None and ending in (*ENDED, "not verified"):
        return claim("measured", f"{name}: the answer is not confirmed, in {wording.rate_text(rate)}.", extent)
    if rate is not None and ending in ENDED:
        text = f"{name}: no failure was found; the best answer counts in {wording.rate_text(rate)}."
        return claim("not found", f"{text} Searched were {spent}. {NO_PROOF}", extent)
    return nothing_claimed(WHY.get(ending, f"it ended as {ending!r}"), f"This is about {name}.")


def average_claim(case: AverageCase, name: str) -> Claim:
    extent = Extent(
        what="configurations in which the model is right",
        count=case.correct,
        total=case.configurations,
        interval=case.interval,
    )
    text = f"{name}: the model is right in {share_text(extent)} configurations drawn by chance"
    text += " from the whole space and budget."
    return claim("measured", text, extent)


def searches_text(renders: Mapping[str, int], policy: str, random: bool) -> str:
    """``24 renders by the policy auto and 24 by random search``; what was predicted instead is said too."""
    own = renders.get("search", 0) + renders.get("gradient", 0)
    text = f"{wording.count(own, 'render')} by the policy {policy}"
    if renders.get("products"):
        text += f", {renders['products']} more predicted,"
    return f"{text} and {renders.get('baseline', 0)} by random search" if random else text


def extent_of(what: str, rate: VerifiedRate | None) -> Extent | None:
    if rate is None:
        return None
    return Extent(what=what, count=rate.successes, total=rate.trials, interval=rate.interval)


def share_text(extent: Extent) -> str:
    share = percent(extent.count / extent.total) if extent.total else "none"
    return f"{extent.count} of {extent.total} ({share}, 95 % interval {wording.interval_text(extent.interval)})"


def nothing_claimed(why: str, more: str = "") -> Claim:
    return claim("nothing claimed", f"{NOTHING}: {why}.{' ' + more if more else ''}", None)


def claim(kind: Kind, text: str, extent: Extent | None) -> Claim:
    return Claim(kind=kind, statement=text, extent=extent)
