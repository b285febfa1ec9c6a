"""`stability`: extreme scenes, objectives and arithmetic, and whether each of them holds."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from advsearch.api.keywords import Names, RunKeywords, asks, configured
from advsearch.engine.measuring import Results, kept_rows
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.stability.answer import CaseRow, StabilityResult
from advsearch.questions.stability.settings import StabilityConfig
from advsearch.questions.stability.suite import chosen, run_cases
from advsearch.runs.directory import RunDirectory

if TYPE_CHECKING:
    from typing_extensions import Unpack


class StabilityKeywords(RunKeywords, total=False):
    """Of `stability`."""

    case: Names | None
    group: Names | None
    seconds: float | None


@asks(StabilityConfig, StabilityKeywords)
def stability(*, progress: Watched = None, **settings: Unpack[StabilityKeywords]) -> StabilityResult:
    """Try extreme scenes, objectives and arithmetic, and say whether each of them holds (docs/stability.md).

    All other arguments are the settings of `advsearch stability`. The run is kept, in `run` or under runs/.

    Args:
        progress: True shows a bar, False none, None one on a terminal; or told how far it is.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    return stability_from_config(configured(StabilityConfig, **settings), progress=watcher(progress))


def stability_from_config(
    config: StabilityConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> StabilityResult:
    """Run cases of the suite one after the other, until they are done, the time is up or there is an interrupt.

    A case that is done is stored at once: a run that was stopped goes on with the case that it was at.

    Args:
        config: which cases, and where the run is kept.
        progress: told how far it is.
        resumed: the folder of a run to go on with.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    cases, begun = chosen(config.cases, config.groups), time.perf_counter()
    with RunDirectory.of(config, resumed) as run:

        def result(rows: Sequence[CaseRow], ending: str) -> StabilityResult:
            return StabilityResult(
                run=str(run.path),
                ending=ending,
                rows=list(rows),
                not_run=[case.name for case in cases[len(rows) :]],
                seconds={"total": time.perf_counter() - begun},
                command_line=config.command_line(),
            )

        results = Results(run, config.seconds)
        return kept_rows(run, results, run_cases(cases, results, progress or NullProgress()), result)
