"""The rows of sweeps as answers and as one table of numbers.

What was shown, what the model said, and whether it was right.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch import seeds
from advsearch.errors import InputError
from advsearch.report.wording import short_name
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.store import NAME, Store

PHOTOGRAPHS = "photographs"
"""The part that photographs are."""

ANSWER, GROUP, PART, TRIAL = "answer", "group", "part", "trial"
"""What the model said, the group that an object is in, the part of the recipe, and which trial of an attack it is."""

TRIALS = {
    "first control": "clean scene",
    "control": "clean scene",
    "verification": "answer",
    "baseline verification": "random search",
}
"""The rows of an attack that are in the table, and what figures call them."""

WORKERS = "workers"
"""The number of processes that shared a sweep, in whole; only of sweeps that say it."""

OTHERS = "other objects"
"""The group of objects that are in none."""


@dataclass(frozen=True)
class Answered:
    """What a model said of one picture.

    Attributes:
        part: of the recipe.
        values: what the picture shows: object, environment, model, and parameters in their units.
        units: of the parameters.
        answer: in words.
        correct: whether it is right.
        time: when it was stored, seconds since 1970.
        margin: of the task; over 0 where the answer is wrong.
    """

    part: str
    values: Mapping[str, float | str]
    units: Mapping[str, str]
    answer: str
    correct: bool
    time: float | None = None
    margin: float | None = None


def figure_value(value: float | str) -> str:
    """Return a value as figures write it; of a file, its name without folder and suffix."""
    if isinstance(value, str):
        return Path(short_name(value)).stem if "/" in value else value
    return f"{value:.4g}"


def rows_of(part: str, folder: Path, summary: AttackSummary | SweepSummary) -> list[Answered]:
    """Return the answers that a sweep has stored, without the trials of its worst, or the trials of an attack.

    Args:
        part: of the recipe.
        folder: of the run.
        summary: of it.

    Raises:
        FileFormatError: the rows cannot be read.
    """
    return answered(part, folder, summary, ("sweep",) if isinstance(summary, SweepSummary) else tuple(TRIALS))


def answered(part: str, folder: Path, summary: AttackSummary | SweepSummary, kinds: Sequence[str]) -> list[Answered]:
    """Return the rows of some kinds; other arguments and errors as for `rows_of`."""
    outer = {"object": summary.object, "environment": summary.environment, "model": summary.model}
    rows = []
    with Store(folder / NAME, read_only=True) as store:
        for row in store.rows():
            if row.kind not in kinds:
                continue
            values = {name: one["value"] for name, one in row.values.items()}
            values |= {TRIAL: TRIALS[row.kind]} if row.kind in TRIALS else {}
            values |= {"model": summary.model} if part == PHOTOGRAPHS and "," not in summary.model else {}
            named = {name: figure_value(str(values.get(name, of_all))) for name, of_all in outer.items()}
            units = {name: one["unit"] for name, one in row.values.items() if one["unit"]}
            answer = row.label or "none", bool(row.correct)
            rows.append(Answered(part, {**values, **named}, units, *answer, row.time, row.margin))
    return rows


Mask = npt.NDArray[np.bool_]
Numbers = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Factor:
    """Something that varied.

    Attributes:
        name: of a parameter, or object, environment or model.
        unit: of its values; empty for names.
        options: the names that it takes, in alphabetical order; empty where it takes numbers.
    """

    name: str
    unit: str = ""
    options: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Observations:
    """Configurations and answers.

    Attributes:
        factors: what varied, one for each column.
        values: (n, d) float64; of a factor with options, the number of the option.
        right: (n,) whether the model was right.
    """

    factors: tuple[Factor, ...]
    values: Numbers
    right: Mask

    def __len__(self) -> int:
        return len(self.right)

    def where(self, mask: Mask) -> Observations:
        """Return some of the rows, by a mask (n,)."""
        return Observations(self.factors, self.values[mask], self.right[mask])

    def halves(self, seed: int) -> tuple[Observations, Observations]:
        """Return two halves, drawn by a seed: one to choose on and one to count on."""
        order = np.random.default_rng(seeds.stream(seed, "halves")).permutation(len(self))
        first = np.zeros(len(self), dtype=bool)
        first[order[: len(self) // 2]] = True
        return self.where(first), self.where(~first)


RowValues = Mapping[str, tuple[float | str, str]]
"""Value and unit of everything that a row shows, by name."""


def observed(rows: Sequence[tuple[RowValues, bool]]) -> Observations:
    """Return rows as a table of what varies among them; what only some of them have is left out.

    Args:
        rows: what each shows, and whether the model was right.

    Raises:
        InputError: there are no rows, or nothing varies.
    """
    if not rows:
        raise InputError("runs: expected sweeps with rows, got none")
    shared = [name for name in rows[0][0] if all(name in shown for shown, _ in rows)]
    factors, columns = [], []
    for name in shared:
        column = [shown[name][0] for shown, _ in rows]
        if len(set(column)) < 2:
            continue
        if all(isinstance(value, (int, float)) for value in column):
            factors.append(Factor(name, rows[0][0][name][1]))
            columns.append([float(value) for value in column])
        else:
            options = tuple(sorted({str(value) for value in column}))
            factors.append(Factor(name, "", options))
            columns.append([float(options.index(str(value))) for value in column])
    if not factors:
        raise InputError("runs: expected rows in which something varies, got none that all of them have")
    values = np.array(columns, dtype=np.float64).T
    return Observations(tuple(factors), values, np.array([right for _, right in rows], dtype=bool))


def encoded(found: Observations) -> tuple[Numbers, list[tuple[int, int | None]]]:
    """Return the columns for a tree, (n, k): one for each option of a factor with options, 1 where it is taken.

    Returns:
        The columns, and for each the number of its factor and that of the option, None for numbers.
    """
    columns: list[Numbers] = []
    meaning: list[tuple[int, int | None]] = []
    for place, factor in enumerate(found.factors):
        column = found.values[:, place]
        if not factor.options:
            columns.append(column)
            meaning.append((place, None))
        for number in range(len(factor.options)):
            columns.append((column == number).astype(np.float64))
            meaning.append((place, number))
    return np.stack(columns, axis=1), meaning
