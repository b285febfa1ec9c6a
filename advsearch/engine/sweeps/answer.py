"""The answer of a sweep as Python has it: its summary, and its rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advsearch.engine.sweeps.job import KIND
from advsearch.report.drawing import new_axes
from advsearch.report.notebook import answer_html
from advsearch.report.shown import shown
from advsearch.report.studies import sweep_axes, sweep_figure
from advsearch.runs import store
from advsearch.runs.export import to_pandas
from advsearch.runs.results.sweep import SweepSummary


@dataclass(frozen=True, eq=False, repr=False)
class SweepResult:
    """The answer of a sweep.

    Attributes:
        summary: what `summary.json` holds.
        run: the run directory, or None if it was not kept.
        in_memory: the rows, where there is no run directory.
    """

    summary: SweepSummary
    run: Path | None
    in_memory: tuple[store.Row, ...] = ()

    @property
    def accuracy(self) -> float | None:
        """Share of the configurations that the model got right; None where there was none."""
        return self.summary.accuracy

    def rows(self) -> Iterator[store.Row]:
        """Yield every configuration with its values and what the model said, in order."""
        if self.run is None:
            yield from self.in_memory
            return
        with store.Store(self.run / store.NAME, read_only=True) as results:
            yield from results.rows(KIND)

    def to_pandas(self) -> Any:
        """Return every configuration as a row of a `pandas.DataFrame`.

        Columns are those of an export (docs/runs.md) under plain names; `attrs["units"]` has the units.

        Raises:
            InputError: pandas is not installed.
        """
        return to_pandas(self.rows())

    def plot(self, axes: Any = None) -> Any:
        """Draw the map over two axes, or the accuracy along the only one, and return the matplotlib axes.

        Args:
            axes: to draw on; None makes new ones.
        """
        axes = new_axes() if axes is None else axes
        sweep_axes(self.summary, axes)
        return axes

    def __repr__(self) -> str:
        right = f"{self.summary.correct} of {self.summary.configurations} right"
        place = None if self.run is None else str(self.run)
        return f"SweepResult({self.summary.object!r}, {self.summary.model!r}, {right}, run={place!r})"

    def _repr_html_(self) -> str:
        return answer_html(shown(self.summary))

    def _repr_png_(self) -> bytes | None:
        return sweep_figure(self.summary).get("png")
