"""What `explain` found, in words and tables."""

from __future__ import annotations

from collections.abc import Sequence

from advsearch.report import wording
from advsearch.report.phrases import percent, percent_number
from advsearch.report.wording import interval_text
from advsearch.runs.results.explain import (
    ConditionRow,
    ExplainResult,
    FailureCluster,
    FailureClusters,
    NearestRight,
    RightOf,
    RuleRow,
)

WEIGHT_HEADS = ("parameters", "decides", "95 % interval", "by parts")
"""Of the columns of the importance."""
MOST_WEIGHTS = 12
"""Rows of it that are shown."""
MOST_ANSWERS = 3
"""Answers of a cluster that are named."""


def explain_text(result: ExplainResult) -> str:
    """Return the first thing that a reader should know, in a sentence."""
    if not result.rules:
        return (
            f"No rule is told from chance in {result.total:,} rows, of which one half chooses and the other counts: "
            f"the model is right in {right_share_text(result)}."
        )
    return f"{wording.count(len(result.rules), 'rule')} under which the model is wrong more often than elsewhere."


def rule_text(number: int, rule: RuleRow) -> str:
    """Return a rule as a sentence."""
    rest = "elsewhere" if number == 0 else "in what no rule before covers"
    share, others = right_share_text(rule), right_share_text(rule.elsewhere)
    text = f"{conditions_text(rule.conditions)}: right in {share}; {rest} {others}."
    fresh = rule.confirmed
    return text if fresh is None else f"{text} Fresh renders inside it: right in {right_share_text(fresh)}."


def not_told_text(result: ExplainResult) -> str:
    """Return the best rule that is not told, why not, and how many rows it would take; empty where there is none."""
    rule = result.not_told
    if rule is None:
        return ""
    others = f"{rule.elsewhere.right} of {rule.elsewhere.total}"
    text = (
        f"Not told{' either' if result.rules else ''}, but the best that one half of the rows suggests: "
        f"{conditions_text(rule.conditions)}. In the other half the model is right in {rule.right} of {rule.total} "
        f"under it and in {others} elsewhere"
    )
    if rule.rows is None:
        return f"{text}, which is no difference that more rows would tell."
    shown = f"chance does that with a probability of {rule.chance:.2g}, and at most {rule.asked:g} is asked"
    return f"{text}; {shown}. About {rule.rows:,} rows with these shares would tell it: sweep more."


def conditions_text(conditions: Sequence[ConditionRow]) -> str:
    """Return conditions in one phrase."""
    return " and ".join(one.text for one in conditions) or "everything that was looked at"


def right_share_text(counted: RightOf) -> str:
    """Return a share with its interval and what it is of: ``12 % (9 to 16) of 340``."""
    if not counted.total:
        return "none of 0"
    low, high = map(percent_number, counted.interval)
    return f"{percent(counted.right / counted.total)} ({low} to {high}) of {counted.total:,}"


def envelope_text(result: ExplainResult) -> str:
    """Return what the envelope promises."""
    box = result.envelope
    if box is None:
        return "No box of enough rows promises the accuracy that was asked for."
    where = conditions_text(box.conditions)
    if not box.held:
        return f"Not shown: inside {where} the rows that did not choose it are right in {right_share_text(box)}."
    return f"At least {100 * box.accuracy:g} % at 95 % confidence: {where}; right in {right_share_text(box)}."


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


def weight_rows(result: ExplainResult) -> list[list[str]]:
    """Return a row for each parameter and each pair of them."""
    return [
        [" with ".join(one.parameters), percent(one.share), interval_text(one.interval), str(one.parts or "")]
        for one in result.importance[:MOST_WEIGHTS]
    ]


def _value(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"
