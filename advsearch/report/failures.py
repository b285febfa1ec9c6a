"""The different failures that an attack answers with, in words and rows."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.report.phrases import percent
from advsearch.report.wording import count, interval_text, number_text

if TYPE_CHECKING:
    from advsearch.runs.results.attack import DifferentFailure, DifferentFailures, FailingShare

FAILURE_HEADS = ("failures", "most often answered", "holds in fresh renders", "objective")
"""Of the columns of `failure_rows`."""


def failures_text(known: DifferentFailures) -> str:
    """Return how many different failures there are, and which of that is verified."""
    where = f"{known.found} of {count(known.seen, 'draw')}"
    if known.places is not None:
        where = f"{known.found} of {known.places} cells over {' and '.join(known.over)} ({known.seen} were seen)"
    share = "" if known.share is None else f"; {failing_share_text(known.share)}"
    if not known.tried:
        return f"claimed in {where}{share}; none of these was tried with fresh renders"
    return f"claimed in {where}{share}; with fresh renders {known.held} of the {known.tried} that were tried hold"


def failing_share_text(share: FailingShare) -> str:
    """Return how large a part of all configurations fails."""
    interval = f"of all configurations {interval_text(share.interval)} fail in one render (95 % interval)"
    return interval if share.estimate is None else f"{interval}, {percent(share.estimate)} by the estimate"


def failure_rows(known: DifferentFailures, *, tried: bool = False) -> list[list[str]]:
    """Return a row for each failure that is listed, or for those that were tried."""
    listed = [one for one in known.listed if not tried or one.verified is not None]
    return [[range_text(one), answered_text(one), _held(one), number_text(one.objective)] for one in listed]


def range_text(one: DifferentFailure) -> str:
    """Return where a failure lies: ``pose.yaw 36 to 72 degrees, material.kind brass``."""
    return ", ".join(f"{name} {_ends(one, name)}" for name in one.ranges) or "anywhere"


def _ends(one: DifferentFailure, name: str) -> str:
    ends = one.ranges[name]
    if isinstance(ends, str):
        return ends
    value = one.configuration.get(name)
    unit = "" if value is None or value.unit in ("", "1") else f" {value.unit}"
    return f"{number_text(ends[0])} to {number_text(ends[1])}{unit}"


def answered_text(one: DifferentFailure) -> str:
    """Return the most frequent wrong answer of its trials; empty where there is none."""
    return next(iter(one.verified.labels), "") if one.verified else ""


def _held(one: DifferentFailure) -> str:
    if one.verified is None:
        return "not tried"
    rated = f"{one.verified.successes} of {count(one.verified.trials, 'render')}"
    return f"yes, {rated}" if one.holds else f"no, {rated}"
