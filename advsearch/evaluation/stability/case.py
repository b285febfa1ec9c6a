"""What a case of the stability suite is, and what running it says. Data only; no torch, no renderer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

OK, FELL_SHORT = "ok", "fell short"


@dataclass(frozen=True)
class Check:
    """One number that decides, and the range that it has to be in (both ends included; NaN is in no range).

    Attributes:
        what: what was measured, with its unit.
        value: the number.
        least, most: the range.
    """

    what: str
    value: float
    least: float = -math.inf
    most: float = math.inf

    @property
    def ok(self) -> bool:
        """Whether the number is in its range."""
        return self.least <= self.value <= self.most

    def __str__(self) -> str:
        ends = [
            f"{sign} {end:.4g}"
            for sign, end in (("at least", self.least), ("at most", self.most))
            if not math.isinf(end) and self.least != self.most
        ]
        wanted = f"exactly {self.most:.4g}" if self.least == self.most else " and ".join(ends)
        return f"{self.what}: {self.value:.4g}" + (f" (expected {wanted})" if wanted else "")


def holds(what: str, truth: bool) -> Check:
    """Return the check that something is true: 1, else 0."""
    return Check(what, float(truth), 1.0, 1.0)


@dataclass(frozen=True)
class Outcome:
    """What a case found.

    Attributes:
        checks: the numbers that decide.
        finite: every picture and every gradient was finite, and none had to be made so.
        relative_error: of a gradient (or of what the case is about) against the reference; None where there is none.
        ending: how the case's search ended, "refused" where the input was, or empty.
        measured: further numbers that are worth printing.
        rule: what handled it, where that is known only afterwards; empty for the case's own.
    """

    checks: tuple[Check, ...]
    finite: bool = True
    relative_error: float | None = None
    ending: str = ""
    measured: Mapping[str, float] = field(default_factory=dict)
    rule: str = ""

    @property
    def status(self) -> str:
        """`OK` where everything was finite and every check holds."""
        return OK if self.finite and all(check.ok for check in self.checks) else FELL_SHORT

    @property
    def decides(self) -> str:
        """The number that decides: of the first check that fails, else of the last one."""
        bad = [check for check in self.checks if not check.ok]
        if not self.finite and not bad:
            return "NaN or infinite values"
        deciding = bad or list(self.checks[-1:])
        return str(deciding[0]) if deciding else ""


Find = Callable[[], Outcome]


@dataclass(frozen=True)
class Case:
    """One extreme.

    Attributes:
        name: unique; what `--case` takes.
        group: name of its group.
        holds: what must hold, in a sentence.
        rule: what handles it.
        control: the controls that it moves; empty where there is no scene.
        cheap: takes about a second or less on two quiet cores, so the tests run it every time.
        find: does it.
    """

    name: str
    group: str
    holds: str
    rule: str
    control: str
    cheap: bool
    find: Find


@dataclass(frozen=True)
class CaseGroup:
    """Cases about one thing, in the order in which they run.

    Attributes:
        name: what `--group` takes.
        cases: those that `case` has added.
    """

    name: str
    cases: list[Case] = field(default_factory=list)

    def case(
        self, name: str, holds: str, rule: str, control: str = "", *, cheap: bool = True
    ) -> Callable[[Find], Find]:
        """Make a function a case of the group; arguments as the attributes of `Case`."""

        def added(find: Find) -> Find:
            self.cases.append(Case(name, self.name, holds, rule, control, cheap, find))
            return find

        return added
