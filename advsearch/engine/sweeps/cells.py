"""Right answers and margins for every pair of values of two axes: what the map of a sweep shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from advsearch.runs.results.sweep import MapAxis, SweepMap
from advsearch.tasks import Judgement

MOST_CELLS = 4096
"""Cells of a map; with more pairs of values there is none."""


class Cells:
    """Counts for every pair of values of two axes, and the sum of the margins there.

    Args:
        axes: name, unit and values of every axis that has several values, those that are shown first.
    """

    def __init__(self, axes: Sequence[tuple[str, str, Sequence[Any]]]) -> None:
        self._axes = list(axes[:2])
        self.rest = [name for name, _, _ in axes[2:]]
        self.shown = len(axes) > 1 and len(axes[0][2]) * len(axes[1][2]) <= MOST_CELLS
        wide, high = (len(values) for _, _, values in self._axes) if self.shown else (0, 0)
        self._seen = [[0] * wide for _ in range(high)]
        self._correct = [[0] * wide for _ in range(high)]
        self._finite = [[0] * wide for _ in range(high)]
        self._margin = [[0.0] * wide for _ in range(high)]

    def add(self, places: Sequence[int], trial: Judgement) -> None:
        """Count one configuration by its places on the axes."""
        if not self.shown:
            return
        column, row = places[0], places[1]
        self._seen[row][column] += 1
        self._correct[row][column] += trial.right
        if trial.margin == trial.margin:
            self._finite[row][column] += 1
            self._margin[row][column] += trial.margin

    def drawn(self) -> SweepMap | None:
        """Return the axes, and for each cell the counts and the mean margin; rows are values of the second axis."""
        if not self.shown:
            return None
        pairs = [zip(sums, counts, strict=True) for sums, counts in zip(self._margin, self._finite, strict=True)]
        first, second = (MapAxis(axis=name, unit=unit, values=list(values)) for name, unit, values in self._axes)
        return SweepMap(
            axes=(first, second),
            over=self.rest,
            configurations=self._seen,
            correct=self._correct,
            margin=[[total / count if count else None for total, count in row] for row in pairs],
        )
