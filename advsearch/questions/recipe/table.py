"""The answers of a recipe's runs as one table, and what figures make of it: counts, sentences, a picture."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from advsearch.attacks.trials import CONFIDENCE
from advsearch.attacks.units import per_unit, share_interval
from advsearch.errors import InputError
from advsearch.explanations import ANSWER, GROUP, OTHERS, PART, PHOTOGRAPHS, TRIAL, Answered, figure_value
from advsearch.questions.recipe.answer import Cell
from advsearch.report.figures import BLUE, GREY, RED
from advsearch.report.phrases import percent
from advsearch.report.wording import interval_text
from advsearch.runs.results.base import Interval
from advsearch.runs.results.sweep import SurfaceMap

COLOURS = (BLUE, RED, "#1f7a45", "#b4540a", "#6b3fa0", GREY)
MARKS = "os^DvP"

COUNT = ["of", "share", "low", "high"]
"""Columns of a count behind the one of what is counted."""


@dataclass(frozen=True)
class Table:
    """All answers of a recipe.

    Attributes:
        rows: of its sweeps, the trials of its attacks, and photographs (part `PHOTOGRAPHS`).
        groups: names of groups, each with the names of objects in it.
        surfaces: by the names of runs, which parts of the object go with wrong answers.
        cores: that this process may use.
        folder: of the recipe's run.
    """

    rows: Sequence[Answered]
    groups: Mapping[str, Sequence[str]] = field(default_factory=dict)
    surfaces: Mapping[str, SurfaceMap] = field(default_factory=dict)
    cores: int = 1
    folder: Path = Path()

    def of(self, parts: Sequence[str]) -> Table:
        """Return the answers of some parts; of all that were rendered where none is named."""
        return self.where(row for row in self.rows if (row.part in parts if parts else row.part != PHOTOGRAPHS))

    def where(self, rows: Iterable[Answered]) -> Table:
        """Return the table with some of its rows."""
        return replace(self, rows=list(rows))

    def value(self, row: Answered, column: str) -> float | str:
        """Return what a row has in a column: a value, the answer, the part, or the group of its object; an InputError
        where there is none."""
        own = {**row.values, ANSWER: row.answer, PART: row.part}
        if self.groups:
            named = [group for group, objects in self.groups.items() if own["object"] in objects]
            own[GROUP] = named[0] if named else OTHERS
        if column not in own:
            raise InputError(f"figures: expected one of {', '.join(own)}, got {column[:60]!r}")
        return own[column]

    def numbers(self, column: str) -> list[float]:
        """Return what each row has in a column of numbers; an InputError where it has names."""
        values = [self.value(row, column) for row in self.rows]
        numbers = [value for value in values if isinstance(value, (int, float))]
        if len(numbers) < len(values):
            raise InputError(f"figures: {column}: expected a parameter with numbers, got names")
        return numbers

    def unit(self, column: str) -> str:
        """Return the unit of a column as it stands behind a number: a space and the unit, or nothing."""
        unit = next((row.units[column] for row in self.rows if column in row.units), "")
        return f" {unit}" if unit not in ("", "1", "name") else ""

    def by(self, column: str) -> dict[str, list[Answered]]:
        """Return the rows by what they have in a column, in the order in which that first comes; numbers by size."""
        groups: dict[float | str, list[Answered]] = {}
        for row in self.rows:
            groups.setdefault(self.value(row, column), []).append(row)
        numbers = all(isinstance(value, (int, float)) for value in groups)
        return {figure_value(key): groups[key] for key in (sorted(groups) if numbers else groups)}


@dataclass(frozen=True, eq=False)
class Count:
    """How many of some rows are counted: of each independent unit, such as a drive, `counted` (n,) of its `of` (n,)."""

    name: str
    counted: npt.NDArray[np.float64]
    of: npt.NDArray[np.float64]

    @classmethod
    def over(
        cls, name: str, rows: Sequence[Answered], counts: Callable[[Answered], bool] = lambda row: row.correct
    ) -> Count:
        """Count rows: those with right answers, or those that `counts` says."""
        flags = np.array([counts(row) for row in rows], dtype=np.float64)
        if all(row.unit is None for row in rows):
            return cls(name, flags, np.ones(len(rows)))
        units = np.array([row.unit or f"row {number}" for number, row in enumerate(rows)])
        return cls(name, per_unit(flags, units), per_unit(np.ones(len(rows)), units))

    @property
    def cells(self) -> list[Cell]:
        """What is counted, and the values of `COUNT`."""
        return [round(self.counted.sum()), self.total, self.share, *(self.interval() or (None, None))]

    @property
    def total(self) -> int:
        """How many rows there are."""
        return round(self.of.sum())

    @property
    def share(self) -> float | None:
        """What is counted of all rows; None where there are none."""
        return float(self.counted.sum() / self.of.sum()) if self.total else None

    def interval(self, among: int = 1) -> Interval | None:
        """Return the 95 % interval of the share, widened for a choice among so many (Bonferroni)."""
        return share_interval(self.counted, self.of, 1.0 - (1.0 - CONFIDENCE) / max(among, 1)) if self.total else None

    def told(self, verb: str = "right") -> str:
        """Return ``right in 12 of 20 (60 %, 95 % interval 36-81 %)``; `verb` is what is counted."""
        counted, total = round(self.counted.sum()), self.total
        return f"{verb} in {counted} of {total} ({percent(self.share)}, 95 % interval {interval_text(self.interval())})"

    def below(self, other: Count, among: int = 1) -> bool:
        """Return whether the interval of this share lies below that of another, both widened."""
        own, others = self.interval(among), other.interval(among)
        return own is not None and others is not None and own[1] < others[0]


def extremes(counts: Sequence[Count], worst: str, best: str, thing: str, verb: str = "right") -> list[str]:
    """Return which of several has the lowest share and which the highest, and whether that is more than chance.

    The two were chosen among k for being extreme, so that they are compared by intervals of confidence 1 - 0.05 / k,
    which hold for all k together. Where these overlap, no difference is shown. They are called, say, "Hardest" and
    "easiest", several of them "environments", and `verb` is what is counted.
    """
    known = [one for one in counts if one.total]
    if len(known) < 2:
        return [f"{one.name}: {one.told(verb)}." for one in known]
    shares = [one.share or 0.0 for one in known]
    low, high = known[int(np.argmin(shares))], known[int(np.argmax(shares))]
    if min(shares) == max(shares):
        return [f"All {len(known)} {thing} have the same share, {percent(low.share)}: no difference is shown."]

    def named(one: Count) -> str:
        ties = shares.count(one.share or 0.0) - 1
        return f"is {one.name}" + (f" (as {ties} other{'s' if ties > 1 else ''})" if ties else "")

    widened = f"the intervals of the two, widened for having been chosen among {len(known)},"
    return [
        f"{worst} {named(low)}: {low.told(verb)}; {best} {named(high)}: {high.told(verb)}.",
        f"The difference is shown: {widened} do not overlap."
        if low.below(high, len(known))
        else f"No difference between the {thing} is shown: {widened} overlap.",
    ]


def plural(column: str) -> str:
    """Return what several values of a column are called: ``environments``, ``materials``, ``values of pose.yaw``."""
    if column == TRIAL:
        return "kinds of trials"
    control, _, parameter = column.partition(".")
    return f"values of {column}" if parameter not in ("", "which") else f"{control}s"


def bare(name: str) -> str:
    """Return a parameter's name without its control: ``milk`` for ``contents.milk``."""
    return name.rpartition(".")[2]


class Options(BaseModel):
    """Options that every figure has: a title, made from the other options where it is empty, and the parts whose
    answers it shows; all where none is named."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str = Field(default="", max_length=200)
    of: tuple[str, ...] = ()

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts whose answers it is made from; none for all that were rendered."""
        return self.of


@dataclass(frozen=True)
class MadeFigure:
    """A figure: title, sentences, a table of its numbers, and what draws it, but for the title, on a figure of
    matplotlib of a size in inches."""

    title: str
    text: Sequence[str]
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    draw: Callable[[Any], None]
    size: tuple[float, float]
