"""What a case of the stability suite is, and how one is run. The cases are in the files beside this one."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from advsearch.errors import AdvsearchError
from advsearch.questions.stability.answer import FELL_SHORT, OK, CaseRow, Check, check


@dataclass(frozen=True)
class Outcome:
    """What a case found: the numbers that decide, and whether every picture and gradient was finite, and none had to be
    made so.

    Attributes:
        relative_error: of a gradient (or of what the case is about) against the reference; None where there is none.
        ending: how the case's search ended, "refused" where the input was, or empty.
        measured: further numbers that are worth printing.
    """

    checks: Sequence[Check]
    finite: bool = True
    relative_error: float | None = None
    ending: str = ""
    measured: Mapping[str, float] = field(default_factory=dict)

    def also(self, *more: Check, **known: Any) -> Outcome:
        """Return it with further checks, and other fields where they are known."""
        return replace(self, checks=[*self.checks, *more], **known)


@dataclass(frozen=True)
class Case:
    """One extreme.

    Attributes:
        name: unique; what `--case` takes.
        group: what it is about; what `--group` takes.
        holds: what must hold, in a sentence.
        slow: takes more than about a second on two quiet cores, so that the tests run it seldom.
    """

    name: str
    group: str
    holds: str
    slow: bool
    find: Callable[[], Outcome]

    def run(self) -> CaseRow:
        """Run it. An exception is a finding like any other: the case falls short, and the exception says why."""
        begun = time.perf_counter()
        try:
            outcome = self.find()
        except AdvsearchError as error:
            outcome = Outcome([check(f"refused: {error}", 1.0, 0.0, 0.0)], ending="refused")
        except Exception as error:
            what = f"raised {type(error).__name__}: {error}"
            outcome = Outcome([check(what, 1.0, 0.0, 0.0)], finite=False, ending="raised")
        failed = [number for number in outcome.checks if not number.ok]
        if failed or outcome.finite:
            decides = "".join(str(number) for number in (failed[:1] or outcome.checks[-1:]))
        else:
            decides = "NaN or infinite values"
        return CaseRow(
            case=self.name,
            group=self.group,
            holds=self.holds,
            status=OK if outcome.finite and not failed else FELL_SHORT,
            decides=decides,
            finite=outcome.finite,
            relative_error=outcome.relative_error,
            ending=outcome.ending,
            checks=list(outcome.checks),
            measured=dict(outcome.measured),
            seconds=time.perf_counter() - begun,
        )


CASES: list[Case] = []
"""Every case, in the order in which they run."""


def case(
    group: str, name: str, holds: str = "", *, slow: bool = False
) -> Callable[[Callable[[], Outcome]], Callable[[], Outcome]]:
    """Make a function a case; the first sentence of its docstring says what must hold where `holds` does not."""

    def added(find: Callable[[], Outcome]) -> Callable[[], Outcome]:
        sentence = holds or " ".join((find.__doc__ or "").partition("\n\n")[0].split())
        CASES.append(Case(name, group, sentence, slow, find))
        return find

    return added


def cases(group: str, find: Callable[..., Outcome], table: Iterable[tuple[str, str, dict[str, Any]]]) -> None:
    """Make each row of a table a case: a name, what must hold, and arguments of a function. `slow` is among these."""
    for name, holds, data in table:
        given = {key: value for key, value in data.items() if key != "slow"}
        CASES.append(Case(name, group, holds, bool(data.get("slow")), partial(find, **given)))
