"""`stability`: extreme scenes, objectives and arithmetic, and whether each of them holds."""

from __future__ import annotations

from collections.abc import Sequence

from advsearch.evaluation.stability.suite import Case, run_cases
from advsearch.progress import Progress
from advsearch.runs.results.base import INTERRUPTED
from advsearch.runs.results.stability import CaseRow, StabilityResult


def stability(
    cases: Sequence[Case], *, seconds: float | None = None, progress: Progress | None = None
) -> StabilityResult:
    """Run cases of the suite one after the other, until they are done, the time is up or there is an interrupt.

    Args:
        cases: from `advsearch.evaluation.stability.suite.chosen`.
        seconds: time after which no case is begun any more.
        progress: told how far it is.
    """
    rows: list[CaseRow] = []
    ending = "done"
    try:
        for row in run_cases(cases, progress, seconds=seconds):
            rows.append(row)
    except KeyboardInterrupt:
        ending = INTERRUPTED
    return StabilityResult(rows=rows, not_run=[case.name for case in cases[len(rows) :]], ending=ending)
