"""The rows of sweeps as one table of numbers: what was shown, and whether the model was right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from advsearch import seeds
from advsearch.errors import InputError

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
