"""The answers of a recipe's runs as one table, and what every figure makes of it: numbers, sentences, a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from advsearch.attacks import clopper_pearson
from advsearch.errors import InputError
from advsearch.explanations import (
    ANSWER,
    GROUP,
    OTHERS,
    PART,
    PHOTOGRAPHS,
    TRIAL,
    Answered,
    answered,
    figure_value,
)
from advsearch.questions.photographs.answer import LOOSE_PHOTO, PHOTO
from advsearch.questions.recipe.answer import NamedCount, RecipeFigure
from advsearch.report.phrases import percent
from advsearch.report.wording import interval_text
from advsearch.runs.results.sweep import SurfaceMap, SweepSummary


@dataclass(frozen=True)
class Table:
    """All answers of a recipe.

    Attributes:
        rows: of its sweeps, the trials of its attacks, and photographs (part `PHOTOGRAPHS`).
        groups: names of groups, each with the names of objects in it.
        surfaces: by the names of runs, which parts of the object go with wrong answers.
        cores: that this process may use.
    """

    rows: Sequence[Answered]
    groups: Mapping[str, Sequence[str]]
    surfaces: Mapping[str, SurfaceMap] = field(default_factory=dict)
    cores: int = 1

    def of(self, parts: Sequence[str]) -> Table:
        """Return the answers of some parts; of all that were rendered where none is named."""
        rows = [row for row in self.rows if (row.part in parts if parts else row.part != PHOTOGRAPHS)]
        return replace(self, rows=rows)

    def value(self, row: Answered, column: str) -> float | str:
        """Return what a row has in a column: a value, the answer, or the group of its object; an InputError where there
        is none."""
        if column == ANSWER:
            return row.answer
        if column == PART:
            return row.part
        if column == GROUP:
            name = str(row.values["object"])
            return next((group for group, inside in self.groups.items() if name in inside), OTHERS)
        if column not in row.values:
            known = ", ".join([*row.values, ANSWER, PART, *([GROUP] if self.groups else [])])
            raise InputError(f"figures: expected one of {known}, got {column[:60]!r}")
        return row.values[column]

    def numbers(self, column: str) -> list[float]:
        """Return what each row has in a column of numbers; an InputError where there is no such column, or it has
        names."""
        values = [self.value(row, column) for row in self.rows]
        numbers = [value for value in values if isinstance(value, (int, float))]
        if len(numbers) < len(values):
            raise InputError(f"figures: {column}: expected a parameter with numbers, got names")
        return numbers

    def unit(self, column: str) -> str:
        """Return the unit of a column; empty where it has none."""
        return next((row.units.get(column, "") for row in self.rows if column in row.units), "")

    def by(self, column: str) -> dict[str, list[Answered]]:
        """Return the rows by what they have in a column, in the order in which that first comes; numbers by size."""
        found: dict[float | str, list[Answered]] = {}
        for row in self.rows:
            found.setdefault(self.value(row, column), []).append(row)
        numbers = all(isinstance(value, (int, float)) for value in found)
        keys = sorted(found) if numbers else list(found)
        return {figure_value(key): found[key] for key in keys}


def counted(name: str, rows: Iterable[Answered]) -> NamedCount:
    """Return in how many of some rows the model is right."""
    right = [row.correct for row in rows]
    return count_of(name, sum(right), len(right))


def count_of(name: str, correct: int, configurations: int) -> NamedCount:
    """Return a count with its share and the 95 % interval of that."""
    return NamedCount(
        name=name,
        configurations=configurations,
        correct=correct,
        accuracy=correct / configurations if configurations else None,
        interval=clopper_pearson(correct, configurations) if configurations else None,
    )


def most_frequent(rows: Iterable[Answered]) -> list[tuple[str, int]]:
    """Return the answers with how often each was given, the most frequent first."""
    return sorted(Counter(row.answer for row in rows).items(), key=lambda one: (-one[1], one[0]))


def photographs_of(folder: Path, summary: SweepSummary) -> list[Answered]:
    """Return the answers about the photographs that a sweep has, as `rows_of` does: one that was aligned with a
    rendering has all values of that, others have no parameters."""
    return answered(PHOTOGRAPHS, folder, summary, (PHOTO, LOOSE_PHOTO))


CONFIDENCE = 0.95


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


Chosen = TypeVar("Chosen", bound=Options)
FigureType = TypeVar("FigureType", bound=RecipeFigure)


@dataclass(frozen=True)
class FigureKind(Generic[Chosen, FigureType]):
    """One kind of figure: the options that it takes, its numbers, what makes these from the answers, and what draws
    them on a figure of matplotlib, which may look into the recipe's folder, of a size in inches.

    With `tells_models` it tells several models apart by itself; of others each model has one.
    """

    options: type[Chosen]
    result: type[FigureType]
    compute: Callable[[Table, Chosen], FigureType]
    draw: Callable[[FigureType, Any, Path], None]
    size: Callable[[FigureType], tuple[float, float]]
    tells_models: bool = False


def rate_with_interval(one: NamedCount, verb: str = "right") -> str:
    """Return ``right in 12 of 20 (60 %, 95 % interval 36-81 %)``; `verb` is what is counted."""
    return (
        f"{verb} in {one.correct} of {one.configurations} "
        f"({percent(one.accuracy)}, 95 % interval {interval_text(one.interval)})"
    )


def extremes(counts: Sequence[NamedCount], worst: str, best: str, thing: str, verb: str = "right") -> list[str]:
    """Return which of several has the lowest accuracy and which the highest, and whether that is more than chance.

    The two were chosen among k for being extreme, so that they are compared by intervals of confidence 1 - 0.05 / k,
    which hold for all k together (Bonferroni). Where these overlap, no difference is shown.

    Args:
        counts: of each.
        worst: what the lowest is called: "Hardest".
        best: what the highest is called: "easiest".
        thing: what they are, for several of them: "environments".
        verb: what is counted.
    """
    known = [one for one in counts if one.configurations]
    if len(known) < 2:
        return [f"{one.name}: {rate_with_interval(one, verb)}." for one in known]
    low, high = (pick(known, key=lambda one: one.accuracy or 0.0) for pick in (min, max))
    if low.accuracy == high.accuracy:
        return [f"All {len(known)} {thing} have the same share, {percent(low.accuracy)}: no difference is shown."]
    least, most = rate_with_interval(low, verb), rate_with_interval(high, verb)
    said = f"{worst} {_tied(low, known)}: {least}; {best} {_tied(high, known)}: {most}."
    widened = f"the intervals of the two, widened for having been chosen among {len(known)},"
    if intervals_apart(low, high, len(known)):
        return [said, f"The difference is shown: {widened} do not overlap."]
    return [said, f"No difference between the {thing} is shown: {widened} overlap."]


def _tied(one: NamedCount, counts: Sequence[NamedCount]) -> str:
    """``is kitchen``, and where others have the same share ``is kitchen (as 2 others)``."""
    others = sum(other.accuracy == one.accuracy for other in counts) - 1
    return f"is {one.name}" + (f" (as {others} other{'s' if others > 1 else ''})" if others else "")


def intervals_apart(low: NamedCount, high: NamedCount, among: int = 1) -> bool:
    """Return whether the intervals of two rates do not overlap, each widened for a choice among so many."""
    confidence = 1.0 - (1.0 - CONFIDENCE) / max(among, 1)
    _, top = clopper_pearson(low.correct, low.configurations, confidence)
    bottom, _ = clopper_pearson(high.correct, high.configurations, confidence)
    return top < bottom


def counted_by(table: Table, column: str) -> list[NamedCount]:
    """Return how often the model is right, by what rows have in a column."""
    return [counted(name, rows) for name, rows in table.by(column).items()]


def plural(column: str) -> str:
    """Return what several values of a column are called: ``environments``, ``materials``, ``values of pose.yaw``."""
    if column == TRIAL:
        return "kinds of trials"
    control, _, parameter = column.partition(".")
    return f"values of {column}" if parameter not in ("", "which") else f"{control}s"
