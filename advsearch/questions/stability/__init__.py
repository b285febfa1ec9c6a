"""Run stiff and extreme cases, and check that each of them holds."""

from __future__ import annotations

from advsearch.question import Asked, question
from advsearch.questions.stability.result import StabilityConfig, StabilityResult
from advsearch.questions.stability.result import shown as shown


@question(
    "stability",
    "stability --group objective --group stiff",
    "stability --case hdri-texel-100000 --json",
    "stability --seconds 120 --run extremes",
    "resume extremes",
    more=". Exit status 3 if one falls short",
    short=lambda result: any(row.status != "ok" for row in result.rows),
)
def stability(asked: Asked[StabilityConfig]) -> StabilityResult:
    """Try stiff and extreme scenes, and say whether each of them holds (docs/stability.md)."""
    from advsearch.questions.stability.scenes import tried_cases  # imports torch

    return tried_cases(asked)
