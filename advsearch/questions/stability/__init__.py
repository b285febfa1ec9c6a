"""Run stiff and extreme cases, and check that each of them holds."""

from __future__ import annotations

from advsearch.extend import RunContext, errors, experiment
from advsearch.questions.stability.result import (
    StabilityConfig,
    StabilityResult,
    make_view,
)


@experiment(
    "stability",
    "stability --group geometry --group stiff",
    "stability --case hdri-texel-100000 --json",
    "stability --seconds 120 --run extremes",
    "resume extremes",
    help_suffix=". Exit status 3 if one falls short",
    exit_status=lambda result: (
        errors.FELL_SHORT if any(row.status != "ok" for row in result.rows) else 0
    ),
    view=make_view,
)
def stability(context: RunContext[StabilityConfig]) -> StabilityResult:
    """Run stiff and extreme scenes, and report whether each holds
    (docs/stability.md).
    """
    from advsearch.questions.stability.scenes import run_cases  # imports torch

    return run_cases(context)
