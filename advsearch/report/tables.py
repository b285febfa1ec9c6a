"""Studies as a notebook shows them: the table and the figure, as HTML, as PNG, on matplotlib axes and for pandas."""

from __future__ import annotations

from typing import Any

from advsearch.report.drawing import new_axes
from advsearch.report.gaps import (
    CURVE_HEADS,
    GAP_HEADS,
    OBJECT_HEADS,
    curve_rows,
    curve_text,
    gap_rows,
    gap_text,
    object_rows,
)
from advsearch.report.notebook import study_html
from advsearch.report.studies import curve_axes, curve_figure, gap_axes, gap_figure
from advsearch.runs.export import table_to_pandas
from advsearch.runs.results.gap import CurveResult, GapResult


class GapTable(GapResult):
    """The worst case beside the average, with what a notebook shows of it."""

    def to_pandas(self) -> Any:
        """Return a row for each object and control as a `pandas.DataFrame`; columns are called as in `summary.json`.

        Raises:
            InputError: pandas is not installed.
        """
        return table_to_pandas([row.to_dict() for row in self.table])

    def plot(self, axes: Any = None) -> Any:
        """Draw the accuracy on average and of the worst configuration, and return the matplotlib axes.

        Args:
            axes: to draw on; None makes new ones.
        """
        axes = new_axes() if axes is None else axes
        gap_axes(self, axes)
        return axes

    def _repr_html_(self) -> str:
        return study_html(gap_text(self), gap_figure(self), [[GAP_HEADS, *gap_rows(self)]])

    def _repr_png_(self) -> bytes | None:
        return gap_figure(self).get("png")


class CurveTable(CurveResult):
    """Robust accuracy against epsilon, with what a notebook shows of it."""

    def to_pandas(self) -> Any:
        """Return a row for each epsilon as a `pandas.DataFrame`; columns are called as in `summary.json`.

        Raises:
            InputError: pandas is not installed.
        """
        return table_to_pandas([point.to_dict() for point in self.curve])

    def plot(self, axes: Any = None) -> Any:
        """Draw the robust accuracy with its interval over epsilon, and return the matplotlib axes.

        Args:
            axes: to draw on; None makes new ones.
        """
        axes = new_axes() if axes is None else axes
        curve_axes(self, axes)
        return axes

    def _repr_html_(self) -> str:
        tables = [[CURVE_HEADS, *curve_rows(self)], [OBJECT_HEADS, *object_rows(self)]]
        return study_html(curve_text(self), curve_figure(self), tables)

    def _repr_png_(self) -> bytes | None:
        return curve_figure(self).get("png")
