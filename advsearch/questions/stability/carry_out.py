"""`stability`: extreme scenes, objectives and arithmetic, and whether each of them holds."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from typing_extensions import Unpack

from advsearch.api.keywords import Names, RunKeywords, asks, configured
from advsearch.engine.record import Results, kept_rows
from advsearch.errors import AdvsearchError, UnknownNameError
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.stability.answer import CaseRow, DecidingNumber, StabilityResult
from advsearch.questions.stability.geometry import GEOMETRY
from advsearch.questions.stability.light import MATERIALS, RADIOMETRIC
from advsearch.questions.stability.precision import PRECISION
from advsearch.questions.stability.predicted import SURFACE_LIGHT, TRANSPORT
from advsearch.questions.stability.scene import Case, Check, Outcome
from advsearch.questions.stability.searches import NOISE, OBJECTIVE
from advsearch.questions.stability.settings import StabilityConfig
from advsearch.questions.stability.stiff import STIFF
from advsearch.runs.directory import RunDirectory

_GROUPS = (RADIOMETRIC, MATERIALS, GEOMETRY, OBJECTIVE, STIFF, PRECISION, NOISE, TRANSPORT, SURFACE_LIGHT)
GROUPS: tuple[str, ...] = tuple(group.name for group in _GROUPS)
CASES: tuple[Case, ...] = tuple(case for group in _GROUPS for case in group.cases)
"""Every case, in the order in which they run."""


class StabilityKeywords(RunKeywords, total=False):
    """Of `stability`."""

    case: Names | None
    group: Names | None
    seconds: float | None


@asks(StabilityConfig, StabilityKeywords)
def stability(*, progress: Watched = None, **settings: Unpack[StabilityKeywords]) -> StabilityResult:
    """Try extreme scenes, objectives and arithmetic, and say whether each of them holds (docs/stability.md)."""
    return stability_from_config(configured(StabilityConfig, **settings), progress=watcher(progress))


def stability_from_config(
    config: StabilityConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> StabilityResult:
    """Run cases of the suite one after the other, until they are done, the time is up or there is an interrupt.

    A case that is done is stored at once: a run that was stopped goes on with the case that it was at.
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


def chosen(names: Sequence[str] = (), groups: Sequence[str] = ()) -> tuple[Case, ...]:
    """Return the cases of these names and of these groups; all where neither is given.

    Raises:
        UnknownNameError: there is no such case or group.
    """
    known = {case.name for case in CASES}
    for name in names:
        if name not in known:
            raise UnknownNameError("case", name, known)
    for group in groups:
        if group not in GROUPS:
            raise UnknownNameError("group", group, GROUPS)
    if not names and not groups:
        return CASES
    return tuple(case for case in CASES if case.name in names or case.group in groups)


def run_case(case: Case) -> CaseRow:
    """Run one case. An exception is a finding like any other: the case falls short, and the exception says why."""
    begun = time.perf_counter()
    try:
        outcome = case.find()
    except AdvsearchError as error:
        outcome = Outcome(Check(f"refused: {error}", 1.0, 0.0, 0.0), ending="refused")
    except Exception as error:
        what = f"raised {type(error).__name__}: {error}"
        outcome = Outcome(Check(what, 1.0, 0.0, 0.0), finite=False, ending="raised")
    return CaseRow(
        case=case.name,
        group=case.group,
        control=case.control,
        finite=outcome.finite,
        relative_error=outcome.relative_error,
        ending=outcome.ending,
        rule=case.rule,
        status=outcome.status,
        decides=outcome.decides,
        holds=case.holds,
        checks=[DecidingNumber.of(one) for one in outcome.checks],
        measured=dict(outcome.measured),
        seconds=time.perf_counter() - begun,
    )


def run_cases(cases: Sequence[Case], results: Results, progress: Progress) -> Iterator[CaseRow]:
    """Run cases one after the other and yield each row as it is done; what the results hold is not run again.

    Raises:
        OutOfTime: the time of the results is up.
    """
    hint = "`case` and `group` pick some, `seconds` stops before the next one"
    progress.stage("trying extreme scenes, objectives and arithmetic", len(cases), hint=hint)
    for case in cases:
        known = results.stored(case.name) is not None
        row = results.row(case.name, CaseRow, partial(run_case, case))
        yield row
        if not known:
            progress.message(f"{case.name}: {row.status}, {row.seconds:.1f} s")
        progress.advance(1)
