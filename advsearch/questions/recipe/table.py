"""The answers of a recipe's runs as one table, which its figures are made from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from advsearch.attacks import clopper_pearson
from advsearch.errors import InputError
from advsearch.explanations.observations import (
    ANSWER,
    GROUP,
    OTHERS,
    PART,
    PHOTOGRAPHS,
    Answered,
    answered,
    figure_value,
)
from advsearch.questions.photographs.answer import LOOSE_PHOTO, PHOTO
from advsearch.questions.recipe.answer import NamedCount
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
        """Return what a row has in a column: a value, the answer, or the group of its object.

        Raises:
            InputError: there is no such column.
        """
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
        """Return what each row has in a column of numbers.

        Raises:
            InputError: there is no such column, or it has names.
        """
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
    """Return the answers about the photographs that a sweep has; arguments and errors as for `rows_of`.

    One that was aligned with a rendering has all values of that, others have no parameters.
    """
    return answered(PHOTOGRAPHS, folder, summary, (PHOTO, LOOSE_PHOTO))
