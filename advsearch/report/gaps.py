"""Robust accuracy and worst case beside average, in words and tables."""

from __future__ import annotations

from advsearch.report import wording
from advsearch.report.phrases import margin_text, percent
from advsearch.runs.results.attack import VerifiedRate
from advsearch.runs.results.gap import CurveResult, EpsilonBudget, GapResult, ObjectRow

GAP_HEADS = ("object", "control", "right on average", "95 % interval", "worst: wrong", "margin", "ending")
OBJECT_HEADS = ("object", "clean right", "ending", "epsilon", "wrong", "margin")
CURVE_HEADS = ("epsilon", "robust", "accuracy", "95 % interval", "wrong already")
"""Of the columns."""


def margin_meaning(result: CurveResult | GapResult) -> str:
    """Return what the column of margins holds."""
    return f"margin: {margin_text(result.task)}, in the trials of the worst case"


def gap_text(result: GapResult) -> str:
    """Return what a gap says, in a sentence."""
    if not result.table:
        return "Nothing was compared to its end."
    found = [row for row in result.table if row.ending == "found"]
    shares = sorted(row.average.accuracy for row in result.table)
    right = percent(shares[0]) if shares[0] == shares[-1] else f"{percent(shares[0])} to {percent(shares[-1])}"
    if len(result.table) == 1:
        worst = "yet one is found that it gets wrong" if found else "and none is found that it gets wrong"
        return f"The model is right in {right} of random configurations, {worst}."
    return (
        f"The model is right in {right} of random configurations, yet in {len(found)} of {len(result.table)} cases one "
        "is found that it gets wrong."
    )


def gap_rows(result: GapResult) -> list[list[str]]:
    """Return a row for each object and control."""
    rows = []
    for row in result.table:
        average = row.average
        right = f"{average.correct}/{average.configurations} ({percent(average.accuracy)})"
        worst = _rate(row.worst), _margin(row.margin)
        rows.append([row.object, row.control, right, wording.interval_text(average.interval), *worst, row.ending])
    return rows


def curve_text(result: CurveResult) -> str:
    """Return what a curve says, in a sentence."""
    known = [one for one in result.curve if one.accuracy is not None]
    if not known:
        return "No object was attacked to the end."
    said = [f"{one.robust} of {one.objects}" + _at(one.epsilon) for one in (known[:1] + known[1:][-1:])]
    return f"Still recognised: {' and '.join(said)}." if len(result.objects) > 1 else _of_one(result)


def _of_one(result: CurveResult) -> str:
    row = result.table[0]
    if row.ending == "already wrong":
        return f"The model is wrong about {row.object} as it is."
    if row.flips_at is None:
        return f"{row.object} is recognised{_at(row.tried)}."
    return f"{row.object} is first got wrong at epsilon {plain_epsilon(row.flips_at)}."


def _at(epsilon: float | None) -> str:
    return "" if epsilon is None else f" at epsilon {epsilon:g}"


def object_rows(result: CurveResult) -> list[list[str]]:
    """Return a row for each object."""
    return [[row.object, *_seen(row)] for row in result.table]


def curve_rows(result: CurveResult) -> list[list[str]]:
    """Return a row for each epsilon of which something is known."""
    return [
        [
            plain_epsilon(one.epsilon) or "own",
            f"{one.robust}/{one.objects}",
            percent(one.accuracy),
            wording.interval_text(one.interval),
            str(one.already_wrong),
        ]
        for one in result.curve
        if one.accuracy is not None
    ]


def plain_epsilon(value: EpsilonBudget) -> str:
    """Return an epsilon as text, by control where there are more; empty of none."""
    if isinstance(value, dict):
        return ",".join(f"{name}={plain_epsilon(one)}" for name, one in value.items())
    return "" if value is None else wording.number_text(value)


def _seen(row: ObjectRow) -> list[str]:
    if row.ending is None:
        return ["not reached"]
    clean = f"{row.clean.correct}/{row.clean.trials}" if row.clean else ""
    return [clean, row.ending, plain_epsilon(row.epsilon), _rate(row.verified), _margin(row.margin)]


def _rate(rated: VerifiedRate | None) -> str:
    return f"{rated.successes}/{rated.trials}" if rated else ""


def _margin(margin: float | None) -> str:
    return "" if margin is None else f"{margin:.2f}"
