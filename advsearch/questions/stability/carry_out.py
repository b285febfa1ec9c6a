"""`stability`: stiff and extreme scenes, and whether each of them holds."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import advsearch.questions.stability.scenes
import advsearch.questions.stability.stiff  # noqa: F401  (both fill `CASES`)
from advsearch.engine.record import Results, kept_rows
from advsearch.errors import UnknownNameError
from advsearch.progress import NullProgress, Progress
from advsearch.questions.stability.result import CASES, Case, CaseRow, StabilityConfig, StabilityResult
from advsearch.runs.directory import RunDirectory


def stability_from_config(
    config: StabilityConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> StabilityResult:
    """Run cases of the suite one after the other, until they are done, the time is up or there is an interrupt.

    A case that is done is stored at once: a run that was stopped goes on with the case that it was at.
    """
    progress, begun = progress or NullProgress(), time.perf_counter()
    cases = chosen(config.cases, config.groups)
    with RunDirectory.of(config, resumed) as run:
        results = Results(run, config.seconds)

        def rows() -> Iterator[CaseRow]:
            hint = "`case` and `group` pick some, `seconds` stops before the next one"
            progress.stage("trying stiff and extreme scenes", len(cases), hint=hint)
            for case in cases:
                known = results.stored(case.name) is not None
                row = results.row(case.name, CaseRow, case.run)
                yield row
                if not known:
                    progress.message(f"{case.name}: {row.status}, {row.seconds:.1f} s")
                progress.advance(1)

        def result(rows: Sequence[CaseRow], ending: str) -> StabilityResult:
            return StabilityResult(
                run=str(run.path),
                ending=ending,
                rows=list(rows),
                not_run=[case.name for case in cases[len(rows) :]],
                seconds={"total": time.perf_counter() - begun},
                command_line=config.command_line(),
            )

        return kept_rows(run, results, rows(), result)


def sentences() -> dict[str, str]:
    """Return what must hold in each case, by its name; behind the group that it is of."""
    return {case.name: f"{case.group}: {case.holds}" for case in CASES}


def chosen(names: Sequence[str] = (), groups: Sequence[str] = ()) -> list[Case]:
    """Return the cases of these names and groups; all where neither is given, an UnknownNameError where one is
    unknown."""
    for kind, asked, known in (
        ("case", names, [case.name for case in CASES]),
        ("group", groups, [case.group for case in CASES]),
    ):
        for name in asked:
            if name not in known:
                raise UnknownNameError(kind, name, dict.fromkeys(known))
    return [case for case in CASES if not (names or groups) or case.name in names or case.group in groups]
