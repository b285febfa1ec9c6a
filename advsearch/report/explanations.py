"""What `explain` found, in words and tables."""

from __future__ import annotations

from collections.abc import Sequence

from advsearch.report import wording
from advsearch.runs.results.explain import (
    ConditionRow,
    ExplainResult,
    FailureCluster,
    FailureClusters,
    NearestRight,
    RightOf,
    RuleRow,
)

WEIGHT_HEADS = ("parameters", "decides", "95 %", "with others", "95 %")
"""Of the columns of the importance."""
MOST_WEIGHTS = 12
"""Rows of it that are shown."""
MOST_ANSWERS = 3
"""Answers of a cluster that are named."""


def explain_text(result: ExplainResult) -> str:
    """Return the first thing that a reader should know, in a sentence."""
    if not result.rules:
        return (
            f"No rule tells where the model is wrong: it is right in {share_text(result)}, and no rule of few "
            "conditions holds on rows that did not choose it."
        )
    return f"{wording.count(len(result.rules), 'rule')} under which the model is wrong more often than elsewhere."


def rule_text(number: int, rule: RuleRow) -> str:
    """Return a rule as a sentence."""
    rest = "elsewhere" if number == 0 else "in what no rule before covers"
    others = 100 * rule.elsewhere.right / rule.elsewhere.total
    text = f"{conditions_text(rule.conditions)}: right in {share_text(rule)}; {rest} {others:.0f} %."
    fresh = rule.confirmed
    return text if fresh is None else f"{text} Fresh renders inside it: right in {share_text(fresh)}."


def conditions_text(conditions: Sequence[ConditionRow]) -> str:
    """Return conditions in one phrase."""
    return " and ".join(one.text for one in conditions) or "everything that was looked at"


def share_text(counted: RightOf) -> str:
    """Return a share with its interval and what it is of: ``12 % (9 to 16) of 340``."""
    if not counted.total:
        return "none of 0"
    low, high = counted.interval
    return f"{100 * counted.right / counted.total:.0f} % ({100 * low:.0f} to {100 * high:.0f}) of {counted.total:,}"


def envelope_text(result: ExplainResult) -> str:
    """Return what the envelope promises."""
    box = result.envelope
    if box is None:
        return "No box of enough rows promises the accuracy that was asked for."
    where = conditions_text(box.conditions)
    if not box.held:
        return f"Not shown: inside {where} the rows that did not choose it are right in {share_text(box)}."
    return f"At least {100 * box.accuracy:g} % at 95 % confidence: {where}; right in {share_text(box)}."


def pair_text(pair: NearestRight) -> str:
    """Return a failure beside the nearest right answer."""
    unit = f" {pair.unit}" if pair.unit not in ("", "1") else ""
    return (
        f"{pair.parameter} {_value(pair.wrong_at)}{unit}: {pair.answered}; at {_value(pair.right_at)}{unit}: "
        f"{pair.answered_there}."
    )


def pairs_text(result: ExplainResult) -> str:
    """Return for how many failures a right configuration near was sought, and for how many it was found."""
    failures = result.total - result.right
    left = failures - result.pairs_sought
    others = f" The other {left} were not tried; `pairs` says how many are." if left else ""
    return (
        f"Of the {result.pairs_sought} most typical of {failures} failures, {len(result.pairs)} are right once one "
        f"parameter is another.{others}"
    )


def clusters_text(found: FailureClusters) -> str:
    """Return how many kinds of failures there are."""
    again = f"the {found.failures} failures that were rendered again"
    if found.silhouette is None:
        return f"One kind: {again} are alike by {found.features}."
    shading = "" if found.apart else "; they shade into one another: groups of any cloud may be as far apart"
    kinds = f"{len(found.listed)} kinds among {again}, by {found.features}"
    return f"{kinds} (silhouette {found.silhouette:.2f}{shading})."


def cluster_text(one: FailureCluster) -> str:
    """Return how many failures a cluster has, and what the model calls them."""
    answers = ", ".join(f"{name} {number}" for name, number in list(one.answers.items())[:MOST_ANSWERS])
    return f"{one.failures}: {answers}"


def explained_text(result: ExplainResult) -> str:
    """Return how much of the answers' variance the importance accounts for."""
    return f"{100 * (result.explained or 0.0):.0f} %"


def weight_rows(result: ExplainResult) -> list[list[str]]:
    """Return a row for each parameter and each pair of them."""
    rows = []
    for one in result.importance[:MOST_WEIGHTS]:
        total = one.total is not None and one.total_interval is not None
        rows.append(
            [
                " with ".join(one.parameters),
                f"{100 * max(one.share, 0.0):.0f} %",
                _interval(one.interval),
                f"{100 * max(one.total or 0.0, 0.0):.0f} %" if total else "",
                _interval(one.total_interval) if one.total_interval else "",
            ]
        )
    return rows


def _interval(interval: tuple[float, float]) -> str:
    low, high = (100 * min(max(one, 0.0), 1.0) for one in interval)
    return f"{low:.0f} to {high:.0f}"


def _value(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"
