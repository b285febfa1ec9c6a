"""Settings and result of `stability`, and the registry of cases."""

from __future__ import annotations

import math
import textwrap
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, ClassVar

from pydantic import Field

from advsearch.extend import (
    Config,
    InputError,
    SceneConfig,
    results,
    setting,
    setting_as_in,
    settings,
    views,
)


class StabilityConfig(Config):
    """Settings of `stability`: the cases that it runs, the time limit, and the run
    directory.
    """

    command: ClassVar[str] = "stability"
    changeable_settings: ClassVar[tuple[str, ...]] = (
        *Config.changeable_settings,
        "seconds",
    )
    clashes: ClassVar[tuple[settings.Clash, ...]] = tuple(
        clash for clash in SceneConfig.clashes if clash.setting == "overwrite"
    )

    case: str | None = setting(
        None,
        "check",
        "cases to try, separated by commas",
        "names of cases",
        otherwise="all",
        repeats=True,
    )
    group: str | None = setting(
        None,
        "check",
        "groups of cases to try, separated by commas",
        "names of groups",
        otherwise="all",
        repeats=True,
    )
    seconds: float | None = setting(
        None,
        "check",
        "time after which no further measurement starts; `advsearch resume` continues "
        "for the same time again",
        otherwise="no limit",
        unit="seconds",
        gt=0.0,
        le=1e9,
    )
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/stability-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")

    _named = settings.text_validator("run", several=["case", "group"])
    _different = settings.unique_names_validator("case", "group")

    @property
    def cases(self) -> tuple[str, ...]:
        """The names in `case`; empty for all."""
        return () if self.case is None else settings.split_names(self.case)

    @property
    def groups(self) -> tuple[str, ...]:
        """The names in `group`; empty for all."""
        return () if self.group is None else settings.split_names(self.group)


OK = "ok"
FELL_SHORT = "fell short"


class Check(results.Fields):
    """A number, and the range that it has to be in; bounds are inclusive or null."""

    what: str
    value: results.JsonFloat
    min_value: float | None
    max_value: float | None
    ok: bool

    def __str__(self) -> str:
        """Describe the number and what was expected: ``mean: 0.2 (expected at least
        1)``.
        """
        bounds = []
        if self.min_value is not None:
            bounds.append(f"at least {self.min_value:.4g}")
        if self.max_value is not None:
            bounds.append(f"at most {self.max_value:.4g}")
        expected = " and ".join(bounds)
        if len(bounds) == 2 and self.min_value == self.max_value:
            expected = f"exactly {self.max_value:.4g}"
        text = f"{self.what}: {self.value:.4g}"
        return f"{text} (expected {expected})" if expected else text


def check_range(
    description: str,
    value: float,
    min_value: float | None = None,
    max_value: float | None = None,
) -> Check:
    """Check that a number is in a range; NaN is in no range.

    Args:
        description: what the number is.
        value: the number.
        min_value, max_value: inclusive bounds; None for no bound.
    """
    ok = not math.isnan(value)
    if min_value is not None:
        ok = ok and min_value <= value
    if max_value is not None:
        ok = ok and value <= max_value
    return Check(
        what=description, value=value, min_value=min_value, max_value=max_value, ok=ok
    )


def check_condition(description: str, is_met: bool) -> Check:
    """Check that a condition is true, as a number that has to be 1."""
    return check_range(description, float(is_met), 1.0, 1.0)


def make_failure(what: str) -> Check:
    """Return a check that fails: one occurrence of something that must not happen."""
    return check_range(what, 1.0, 0.0, 0.0)


class CaseRow(results.Fields):
    """The result of a case."""

    case: str = Field(description="name of the case")
    group: str = Field(description="group of the case")
    holds: str = Field(description="what must hold")
    status: str = Field(description="`ok` or `fell short`")
    decides: str = Field(description="the check that decides the status, in words")
    finite: bool = Field(
        description="whether every picture and gradient was finite without correction"
    )
    relative_error: results.JsonFloat | None = Field(
        description="relative error of a gradient; null if none was compared"
    )
    ending: str = Field(
        description="status of the case's search; `refused` if its input was rejected"
    )
    checks: list[Check]
    measurements: dict[str, results.JsonFloat] = Field(
        description="further numbers, such as condition numbers and biases"
    )
    seconds: float = Field(description="seconds that the case took")


class StabilityResult(views.InNotebook, results.Result):
    """Whether extreme scenes and settings hold, for each case."""

    command: ClassVar[str] = "stability"

    run: str = Field(description="the run directory")
    ending: str = Field(description="`done`, `interrupted` or `out of time`")
    rows: list[CaseRow]
    not_run: list[str] = Field(description="cases that were not started")
    seconds: Annotated[dict[str, results.JsonFloat], results.key_validator("total")] = (
        Field(description="seconds of this session, in `total`")
    )
    command_line: str | None = Field(description="command that repeats the run")

    @property
    def outcome_summary(self) -> str:
        return f"{sum(row.status == OK for row in self.rows)} of {len(self.rows)} hold"


CASE_COLUMNS: Mapping[str, views.Column] = {
    "group": "{0.group}",
    "case": "{0.case}",
    "status": "{0.status}",
    "finite": lambda row: "yes" if row.finite else "NO",
    "error": lambda row: (
        "" if row.relative_error is None else f"{100.0 * row.relative_error:.2g} %"
    ),
    "ending": lambda row: textwrap.shorten(row.ending, 30, placeholder=" ..."),
    "seconds": "{0.seconds:.1f}",
}


def make_view(result: StabilityResult) -> views.ShownResult:
    """Return the view of a result: cases, condition numbers, and failed cases.

    A row's `holds` states what must hold, and `decides` the check that failed.
    """
    n_rows = len(result.rows)
    seconds = math.fsum(row.seconds for row in result.rows)
    failures = [
        f"{row.case} fell short: {row.decides}; expected: {row.holds}"
        for row in result.rows
        if row.status != OK
    ]
    return views.ShownResult(
        f"{n_rows - len(failures)} of {n_rows} cases hold, in {seconds:.0f} seconds.",
        [
            views.ResultPart.make_table(result.rows, CASE_COLUMNS, title="Cases"),
            views.ResultPart(
                "Condition numbers", rows=_list_condition_numbers(result.rows)
            ),
            views.ResultPart("Short", failures),  # cases that "fell short"
            views.ResultPart("Not run", [", ".join(result.not_run)]),
        ],
    )


def _list_condition_numbers(rows: Sequence[CaseRow]) -> list[list[str]]:
    """Return the condition numbers that cases measured, each with a name."""
    condition_numbers = []
    for row in rows:
        for name, value in row.measurements.items():
            if name.startswith("condition number"):
                condition_numbers.append([f"{row.case}: {name}", f"{value:.3g}"])
    return condition_numbers


@dataclass(frozen=True)
class CaseOutcome:
    """The checks and numbers of a case.

    Attributes:
        checks: checks that decide whether the case holds.
        finite: whether every picture and gradient was finite without correction.
        relative_error: relative error of a gradient, or of what the case is about; None
            without one.
        ending: status of the case's search; "refused" if its input was rejected; empty
            without a search.
        measurements: further numbers to report.
    """

    checks: Sequence[Check]
    finite: bool = True
    relative_error: float | None = None
    ending: str = ""
    measurements: Mapping[str, float] = field(default_factory=dict)

    def with_checks(self, *more: Check, **known: Any) -> CaseOutcome:
        """Return the outcome with more checks, and changed fields."""
        return replace(self, checks=[*self.checks, *more], **known)

    def evaluate(self) -> tuple[str, str]:
        """Return the status, and the check that decides it in words.

        That is the first check that fails, or values that are not finite, or else the
        last check.
        """
        failed = [check for check in self.checks if not check.ok]
        if failed:
            return FELL_SHORT, str(failed[0])
        if not self.finite:
            return FELL_SHORT, "NaN or infinite values"
        return OK, str(self.checks[-1]) if self.checks else ""


@dataclass(frozen=True)
class Case:
    """An extreme scene or setting, and what must hold.

    A slow case takes more than about a second on two idle cores; tests run it rarely.
    Attributes:
        name: unique name.
        group: group of cases.
        holds: what must hold, in a sentence.
        slow: whether it takes long.
        measure: runs the case.
    """

    name: str
    group: str
    holds: str
    slow: bool
    measure: Callable[[], CaseOutcome]

    def run(self) -> CaseRow:
        """Run the case, and return its row.

        An exception means that the case does not hold. An InputError counts as a
        rejection of its input, any other exception as values that are not finite.
        """
        start = time.perf_counter()
        outcome = self._measure_safely()
        status, decisive_check = outcome.evaluate()
        row_fields = {
            "case": self.name,
            "status": status,
            "decides": decisive_check,
            "seconds": time.perf_counter() - start,
        }
        # `CaseRow` takes its fields from these, and ignores others, such as `measure`.
        return CaseRow.from_values({**vars(self), **vars(outcome), **row_fields})

    def _measure_safely(self) -> CaseOutcome:
        """Return the outcome of the case; that of an exception is a failure."""
        try:
            return self.measure()
        except InputError as error:
            failure = make_failure(f"refused: {error}")
            return CaseOutcome([failure], ending="refused")
        except Exception as error:
            failure = make_failure(f"raised {type(error).__name__}: {error}")
            return CaseOutcome([failure], finite=False, ending="raised")


# every case, in the order in which they run
ALL_CASES: list[Case] = []


def register_case(
    group: str, name: str, *, slow: bool = False
) -> Callable[[Callable[[], CaseOutcome]], Callable[[], CaseOutcome]]:
    """Register a function as a case.

    The first paragraph of its docstring, which users see, states what must hold.
    """

    def register(measure: Callable[[], CaseOutcome]) -> Callable[[], CaseOutcome]:
        """Append the case of a function, and return the function itself."""
        first_paragraph, _, _ = (measure.__doc__ or "").partition("\n\n")
        requirement = " ".join(first_paragraph.split())
        ALL_CASES.append(
            Case(name=name, group=group, holds=requirement, slow=slow, measure=measure)
        )
        return measure

    return register


def register_cases(
    group: str,
    measure: Callable[..., CaseOutcome],
    rows: Iterable[tuple[str, str, dict[str, Any]]],
) -> None:
    """Register a case for each row of a table.

    Args:
        group: group of the cases.
        measure: function that runs a case; it is called with the arguments of the row.
        rows: for each case its name, a text on what must hold, and the function's
            arguments. The key "slow" is not an argument; it marks a case that takes
            long.
    """
    for name, requirement, options in rows:
        arguments = {key: value for key, value in options.items() if key != "slow"}
        ALL_CASES.append(
            Case(
                name=name,
                group=group,
                holds=requirement,
                slow=bool(options.get("slow")),
                measure=partial(measure, **arguments),
            )
        )
