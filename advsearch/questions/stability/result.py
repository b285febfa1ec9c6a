"""What `stability` needs to know, its result, and what a case is; the cases are in the
files beside this one.
"""

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
    ResultPart,
    SceneConfig,
    ShownResult,
    results,
    setting,
    setting_as_in,
    settings,
    views,
)


class StabilityConfig(Config):
    """Everything that decides what `stability` does: which cases it tries, for how
    long, and where that is kept.
    """

    command: ClassVar[str] = "stability"
    free: ClassVar[tuple[str, ...]] = (*Config.free, "seconds")
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
        None, "check",
        "time after which no measurement is begun any more; `advsearch resume` goes on "
        "for as long again",
        otherwise="no limit", unit="seconds", gt=0.0, le=1e9,
    )  # fmt: skip
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/stability-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")

    _named = settings.texts("run", several=["case", "group"])
    _different = settings.each_once("case", "group")

    @property
    def cases(self) -> tuple[str, ...]:
        return () if self.case is None else settings.split_names(self.case)

    @property
    def groups(self) -> tuple[str, ...]:
        return () if self.group is None else settings.split_names(self.group)


OK = "ok"
FELL_SHORT = "fell short"


class Check(results.Fields):
    """One number that decides, and the range that it has to be in, both ends included;
    null where there is no end.
    """

    what: str
    value: results.JsonFloat
    least: float | None
    most: float | None
    ok: bool

    def __str__(self) -> str:
        ends = [
            f"{sign} {end:.4g}"
            for sign, end in (("at least", self.least), ("at most", self.most))
            if end is not None
        ]
        wanted = (
            f"exactly {self.most:.4g}"
            if len(ends) == 2 and self.least == self.most
            else " and ".join(ends)
        )
        return f"{self.what}: {self.value:.4g}" + (
            f" (expected {wanted})" if wanted else ""
        )


def check(
    what: str, value: float, least: float | None = None, most: float | None = None
) -> Check:
    """Return the check of a number; NaN is in no range."""
    ok = (
        value == value
        and (least is None or least <= value)
        and (most is None or value <= most)
    )
    return Check(what=what, value=value, least=least, most=most, ok=ok)


def holds(what: str, truth: bool) -> Check:
    return check(what, float(truth), 1.0, 1.0)


class CaseRow(results.Fields):
    """One case of the suite and what it showed."""

    case: str = Field(description="its name")
    group: str = Field(description="its group")
    holds: str = Field(description="what must hold")
    status: str = Field(description="`ok` or `fell short`")
    decides: str = Field(description="the number that decides")
    finite: bool = Field(
        description="every picture and gradient was finite, and none had to be made so"
    )
    relative_error: results.JsonFloat | None = Field(
        description="of a gradient against its reference; null where there is none"
    )
    ending: str = Field(
        description="of the case's search; `refused` where its input was"
    )
    checks: list[Check]
    measured: dict[str, results.JsonFloat] = Field(
        description="further numbers, such as condition numbers and biases"
    )
    seconds: float = Field(description="what the case took")


class StabilityResult(views.InNotebook, results.Result):
    """Extreme cases, and whether each of them holds."""

    command: ClassVar[str] = "stability"

    run: str = Field(description="the folder")
    ending: str = Field(description="`done`, `interrupted` or `out of time`")
    rows: list[CaseRow]
    not_run: list[str] = Field(description="cases that were not begun")
    seconds: Annotated[dict[str, results.JsonFloat], results.having("total")] = Field(
        description="in `total`, of this sitting"
    )
    command_line: str | None = Field(description="that asks the same again")

    @property
    def brief(self) -> str:
        return f"{sum(row.status == OK for row in self.rows)} of {len(self.rows)} hold"


COLUMNS: Mapping[str, views.Column] = {
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


def shown(result: StabilityResult) -> ShownResult:
    short = [row for row in result.rows if row.status != OK]
    numbers = [
        [f"{row.case}: {name}", f"{value:.3g}"]
        for row in result.rows
        for name, value in row.measured.items()
        if name.startswith("condition number")
    ]
    return ShownResult(
        f"{len(result.rows) - len(short)} of {len(result.rows)} cases hold, in "
        f"{math.fsum(row.seconds for row in result.rows):.0f} seconds.",
        [
            ResultPart.table(result.rows, COLUMNS, title="Cases"),
            ResultPart("Condition numbers", rows=numbers),
            ResultPart(
                "Short",
                [
                    f"{row.case} fell short: {row.decides}; expected: {row.holds}"
                    for row in short
                ],
            ),
            ResultPart("Not run", [", ".join(result.not_run)]),
        ],
    )


@dataclass(frozen=True)
class Outcome:
    """What a case found: the numbers that decide, and whether every picture and
    gradient was finite, and none had to be made so; the error of a gradient (or of what
    the case is about), None where there is none; how the case's search ended, "refused"
    where the input was, or empty; and further numbers that are worth printing.
    """

    checks: Sequence[Check]
    finite: bool = True
    relative_error: float | None = None
    ending: str = ""
    measured: Mapping[str, float] = field(default_factory=dict)

    def also(self, *more: Check, **known: Any) -> Outcome:
        return replace(self, checks=[*self.checks, *more], **known)


@dataclass(frozen=True)
class Case:
    """One extreme: its unique name, the group that it belongs to, and what must hold,
    in a sentence. A `slow` one takes more than about a second on two quiet cores, so
    that the tests run it seldom.
    """

    name: str
    group: str
    holds: str
    slow: bool
    find: Callable[[], Outcome]

    def run(self) -> CaseRow:
        """Run it. An exception is a finding like any other: the case falls short, and
        the exception says why.
        """
        begun = time.perf_counter()
        try:
            outcome = self.find()
        except InputError as error:
            outcome = Outcome(
                [check(f"refused: {error}", 1.0, 0.0, 0.0)], ending="refused"
            )
        except Exception as error:
            what = f"raised {type(error).__name__}: {error}"
            outcome = Outcome(
                [check(what, 1.0, 0.0, 0.0)], finite=False, ending="raised"
            )
        failed = [number for number in outcome.checks if not number.ok]
        decides = "".join(map(str, failed[:1] or outcome.checks[-1:]))
        more = {
            "case": self.name,
            "status": OK if outcome.finite and not failed else FELL_SHORT,
            "decides": decides
            if failed or outcome.finite
            else "NaN or infinite values",
            "seconds": time.perf_counter() - begun,
        }
        return CaseRow.of({**vars(self), **vars(outcome), **more})


CASES: list[Case] = []  # every case, in the order in which they run


def case(
    group: str, name: str, *, slow: bool = False
) -> Callable[[Callable[[], Outcome]], Callable[[], Outcome]]:
    """Make a function a case; the first sentence of its docstring says what must
    hold.
    """

    def added(find: Callable[[], Outcome]) -> Callable[[], Outcome]:
        sentence = " ".join((find.__doc__ or "").partition("\n\n")[0].split())
        CASES.append(Case(name, group, sentence, slow, find))
        return find

    return added


def cases(
    group: str,
    find: Callable[..., Outcome],
    table: Iterable[tuple[str, str, dict[str, Any]]],
) -> None:
    for name, holds, data in table:
        arguments = {key: value for key, value in data.items() if key != "slow"}
        CASES.append(
            Case(name, group, holds, bool(data.get("slow")), partial(find, **arguments))
        )
