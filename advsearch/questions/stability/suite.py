"""The stability suite: extreme scenes, objectives and arithmetic, each with what must hold (`advsearch stability`).

A case is data (`Case`): a name, a group, what must hold, what handles it, and a function that returns findings. The
registry is `CASES`; nothing is found by its name.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from functools import partial

from advsearch.engine.measuring import Results
from advsearch.errors import AdvsearchError, UnknownNameError
from advsearch.progress import Progress
from advsearch.questions.stability import (
    cases_geometry,
    cases_materials,
    cases_noise,
    cases_objective,
    cases_precision,
    cases_radiometric,
    cases_stiff,
    cases_surface_light,
    cases_transport,
)
from advsearch.questions.stability.answer import CaseRow, DecidingNumber
from advsearch.questions.stability.case import FELL_SHORT, OK, Case, Check, Outcome

_MODULES = (
    cases_radiometric,
    cases_materials,
    cases_geometry,
    cases_objective,
    cases_stiff,
    cases_precision,
    cases_noise,
    cases_transport,
    cases_surface_light,
)
GROUPS: tuple[str, ...] = tuple(module.GROUP.name for module in _MODULES)
"""Every group, in the order in which they run."""
CASES: tuple[Case, ...] = tuple(case for module in _MODULES for case in module.GROUP.cases)
"""Every case, in the order in which they run."""


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
        outcome = Outcome((Check(f"refused: {error}", 1.0, 0.0, 0.0),), ending="refused")
    except Exception as error:
        what = f"raised {type(error).__name__}: {error}"
        outcome = Outcome((Check(what, 1.0, 0.0, 0.0),), finite=False, ending="raised")
    return CaseRow(
        case=case.name,
        group=case.group,
        control=case.control,
        finite=outcome.finite,
        relative_error=outcome.relative_error,
        ending=outcome.ending,
        rule=outcome.rule or case.rule,
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


__all__ = ["CASES", "FELL_SHORT", "GROUPS", "OK", "Case", "Check", "Outcome", "chosen", "run_case", "run_cases"]
