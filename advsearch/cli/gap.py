"""`advsearch gap`: the worst case beside the average, and the curve of an attack: what takes several attacks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.cli.output import aligned
from advsearch.cli.question import QuestionCommand

if TYPE_CHECKING:
    from advsearch.runs.results.gap import CurveResult, GapResult

HELP = "compare the worst case with the average over the same space, for each object and each control"
EXAMPLES = (
    "gap --object mug --control pose,camera,texture",
    "gap --object mug,bowl,bottle --control pose --average 500 --steps 80",
)


def answer(result: CurveResult | GapResult) -> str:
    """Return the tables of a study."""
    from advsearch.report import gaps, wording
    from advsearch.runs.results.base import INTERRUPTED
    from advsearch.runs.results.gap import GapResult

    meaning = f"\n  {gaps.margin_meaning(result)}"
    if isinstance(result, GapResult):
        parts = [aligned([gaps.GAP_HEADS, *gaps.gap_rows(result)]) + meaning]
    else:
        curve = gaps.curve_rows(result)
        parts = [aligned([gaps.OBJECT_HEADS, *gaps.object_rows(result)]) + meaning]
        parts += [aligned([gaps.CURVE_HEADS, *curve])] if curve else []
    facts = [["time", wording.seconds_text(result.seconds["total"])], ["run", str(result.run)]]
    ending = "Interrupted." if result.ending == INTERRUPTED else ""
    return "\n\n".join(part for part in (*parts, aligned(facts), ending) if part)


COMMAND = QuestionCommand("gap", answer)
