"""`advsearch gap`: the worst case beside the average, and the curve of an attack: what takes several attacks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.cli.output import columns
from advsearch.cli.question import QuestionCommand
from advsearch.report import wording
from advsearch.report.phrases import margin_text, percent

if TYPE_CHECKING:
    from advsearch.runs.results.attack import VerifiedRate
    from advsearch.runs.results.gap import CurveResult, EpsilonBudget, GapResult, ObjectRow

HELP = "compare the worst case with the average over the same space, for each object and each control"


def _meaning(result: CurveResult | GapResult) -> str:
    return f"\n  margin: {margin_text(result.task)}, in the trials of the worst case"


def answer(result: CurveResult | GapResult) -> str:
    """Return the tables of a study."""
    from advsearch.runs.results.base import INTERRUPTED
    from advsearch.runs.results.gap import GapResult

    parts = [_gap(result)] if isinstance(result, GapResult) else [_objects(result), _curve(result)]
    facts = [["time", wording.seconds_text(result.seconds["total"])], ["run", str(result.run)]]
    ending = "Interrupted." if result.ending == INTERRUPTED else ""
    return "\n\n".join(part for part in (*parts, columns(facts), ending) if part)


def _objects(result: CurveResult) -> str:
    heads = ["object", "clean right", "ending", "epsilon", "wrong", "margin"]
    return columns([heads, *([row.object, *_seen(row)] for row in result.table)]) + _meaning(result)


def _seen(row: ObjectRow) -> list[str]:
    if row.ending is None:
        return ["not reached"]
    clean = f"{row.clean.correct}/{row.clean.trials}" if row.clean else ""
    return [clean, row.ending, _plain(row.epsilon), _rate(row.verified), _margin(row.margin)]


def _curve(result: CurveResult) -> str:
    heads = ["epsilon", "robust", "accuracy", "95 % interval", "wrong already"]
    rows = [
        [
            _plain(one.epsilon) or "own",
            f"{one.robust}/{one.objects}",
            percent(one.accuracy),
            wording.interval_text(one.interval),
            str(one.already_wrong),
        ]
        for one in result.curve
        if one.accuracy is not None
    ]
    return columns([heads, *rows]) if rows else ""


def _gap(result: GapResult) -> str:
    rows = [["object", "control", "right on average", "95 % interval", "worst: wrong", "margin", "ending"]]
    for row in result.table:
        average = row.average
        right = f"{average.correct}/{average.configurations} ({percent(average.accuracy)})"
        worst = _rate(row.worst), _margin(row.margin)
        rows.append([row.object, row.control, right, wording.interval_text(average.interval), *worst, row.ending])
    return columns(rows) + _meaning(result)


def _rate(rated: VerifiedRate | None) -> str:
    return f"{rated.successes}/{rated.trials}" if rated else ""


def _margin(margin: float | None) -> str:
    return "" if margin is None else f"{margin:.2f}"


def _plain(value: EpsilonBudget) -> str:
    if isinstance(value, dict):
        return ",".join(f"{name}={_plain(one)}" for name, one in value.items())
    return "" if value is None else wording.number_text(value)


COMMAND = QuestionCommand(
    "gap",
    HELP,
    answer,
    (
        "gap --object mug --control pose,camera,texture",
        "gap --object mug,bowl,bottle --control pose --average 500 --steps 80",
    ),
)
