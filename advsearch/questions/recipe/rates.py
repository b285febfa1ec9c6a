"""Figures of fractions and throughput: accuracy, agreement with photographs, images per
second, parts of surfaces.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pandas as pd
from pandas.api.types import is_numeric_dtype
from pydantic import BaseModel, ConfigDict, Field

from advsearch.extend import (
    InputError,
    RunDirectory,
    Store,
    figures,
    results,
    statistics,
    wording,
    workbench,
)
from advsearch.questions.recipe.description import PHOTOGRAPHS

# ---- The rows of a recipe's runs as one frame, and what all figures share

PREDICTION_COLUMN = "answer"
GROUP_COLUMN = "group"
PART_COLUMN = "part"
TRIAL_COLUMN = "trial"
MODEL_COLUMN = "model"
WORKERS_COLUMN = "workers"
"""Columns other than parameters.

They hold the model's prediction, the group of the object, the part of the recipe, the
kind of trial (of an attack), the model, and the number of worker processes (of sweeps
that set it).
"""

OTHER_OBJECTS = "other objects"

TRIAL_NAMES = {
    "first control": "clean scene",
    "control": "clean scene",
    "verification": "answer",
    "baseline verification": "random search",
}
"""The kinds of an attack's rows that are in the frame, and their names in figures."""

# columns of a table for one fraction, after the column of its numerator
FRACTION_HEADS = ["of", "share", "low", "high"]
Cell = str | int | float | None
Float64Array = npt.NDArray[np.float64]
# a pd.DataFrame; pandas has no types
Rows = Any
# lengths of a figure in inches
FIGURE_WIDTH = 6.0
LINES_HEIGHT = 3.4
MIN_MAP_WIDTH = 5.4


def read_rows(
    part: str, folder: Path, summary: Any, seed: int, kinds: Sequence[str], **more: Cell
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Read the stored rows of a run, and the units of measure of their parameters.

    Each row has `object`, `environment`, `model` and the parameters; the prediction
    (`answer`, `correct`, `margin`); `time`, when it was stored (seconds since 1970);
    and `unit`, the independent unit that it belongs to, as text. Rows of a sweep with
    the same seed and the same draw share a unit, also across parts. Trials of attacks
    with the same seed and the same number share a unit. Any other row is a unit by
    itself.

    Args:
        part: part of the recipe that the run belongs to.
        folder: directory of the run.
        summary: result of the run.
        seed: seed of the run.
        kinds: kinds of stored rows to read.
        **more: further columns, equal in all rows.

    Returns:
        The rows as mappings from column to value, and the unit of measure of each
        parameter.
    """
    rows = list[dict[str, Any]]()
    units_of_measure = dict[str, str]()
    with Store.open_to_read(folder) as store:
        sweep_units = _read_sweep_units(store, summary)
        counted = (row for row in store.rows() if _is_counted(row, kinds))
        for row in counted:
            for name, stored in row.values.items():
                units_of_measure[name] = stored["unit"]
            unit = _name_independent_unit(row, folder, seed, summary, sweep_units)
            values = _read_row_values(row, summary)
            values |= {"time": row.time, PART_COLUMN: part, "unit": unit}
            rows.append({**values, **more})
    return rows, units_of_measure


def _is_counted(row: Any, kinds: Sequence[str]) -> bool:
    """Return whether a stored row is of one of the kinds, and shows the object."""
    if row.kind not in kinds:
        return False
    # An image without the object says nothing about its recognition.
    return not (row.kind == "sweep" and row.is_out_of_view)


def _read_sweep_units(store: Store, summary: Any) -> Any:
    """Read what maps the rows of a sweep to independent units; None for other runs."""
    if summary.command != "sweep":
        return None
    is_sampled = summary.sampler is not None
    return workbench.read_units(store, is_sampled=is_sampled)


def _name_independent_unit(
    row: Any, folder: Path, seed: int, summary: Any, sweep_units: Any
) -> str:
    """Name the independent unit that a row belongs to.

    Args:
        row: row of a sweep, or trial of an attack.
        folder: directory of the run.
        seed: seed of the run.
        summary: result of the run.
        sweep_units: maps the rows of a sweep to independent units; None for other runs.
    """
    # A sweep may also have rows of photographs, each of which is a unit.
    if summary.command == "attack":
        return f"{seed} {row.step}"
    if row.kind == "sweep" and sweep_units is not None:
        return f"{seed} {sweep_units.find_unit(row.step)}"
    return f"{folder.name} {row.kind} {row.id}"


def _read_row_values(row: Any, summary: Any) -> dict[str, Any]:
    """Return the columns of a stored row: parameters, names and the prediction.

    Args:
        row: row of a sweep, or trial of an attack.
        summary: result of the run, with the names that the row does not state.
    """
    values: dict[str, Any] = {
        name: stored["value"] for name, stored in row.values.items()
    }
    if summary.command == "attack":
        values[TRIAL_COLUMN] = TRIAL_NAMES[row.kind]
    for name in ("object", "environment", MODEL_COLUMN):
        value = values.get(name, getattr(summary, name))
        values[name] = wording.format_figure_value(str(value))
    values[PREDICTION_COLUMN] = row.label or "none"
    values["correct"] = bool(row.correct)
    values["margin"] = row.margin
    return values


def make_frame(
    rows: Iterable[Mapping[str, Any]], groups: Mapping[str, Sequence[str]], **facts: Any
) -> Rows:
    """Make a frame of rows, with a column for the group of each object.

    Args:
        rows: rows as `read_rows` returns them.
        groups: names of objects by group; the first group that names an object has
            it. Without groups the frame has no such column.
        **facts: become the frame's ``attrs``.
    """
    frame = pd.DataFrame(rows)
    if groups:
        group_of_object = _map_objects_to_groups(groups)
        frame[GROUP_COLUMN] = [
            group_of_object.get(name, OTHER_OBJECTS) for name in frame["object"]
        ]
    frame.attrs = facts
    return frame


def _map_objects_to_groups(groups: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return the first group that names an object, by the name of the object."""
    group_of_object = dict[str, str]()
    for group, objects in groups.items():
        for name in objects:
            group_of_object.setdefault(name, group)
    return group_of_object


def get_column(rows: Rows, name: str) -> Any:
    """Return a column that has a value in each row.

    Raises:
        InputError: if the column does not exist or lacks values.
    """
    if name not in rows or rows[name].isna().any():
        # results of a row are no columns to split by
        candidates = rows.columns.drop(["correct", "margin", "time", "unit"])
        known = ", ".join(other for other in candidates if rows[other].notna().all())
        raise InputError(f"figures: expected one of {known}, got {name[:60]!r}")
    return rows[name]


def get_numeric_column(rows: Rows, name: str) -> Any:
    """Return a column of numbers.

    Raises:
        InputError: if the column lacks values or holds names.
    """
    if not pd.api.types.is_numeric_dtype(get_column(rows, name)):
        raise InputError(
            f"figures: {name}: expected a parameter with numbers, got names"
        )
    return rows[name]


def format_unit(rows: Rows, name: str) -> str:
    """Format the unit of a column to follow a number: " m", or "" if it has none."""
    unit = rows.attrs["units"].get(name, "")
    if unit in (*wording.PLAIN_UNITS, "name"):  # "name" is that of a discrete choice
        return ""
    return f" {unit}"


def split_rows(rows: Rows, name: str) -> dict[str, Rows]:
    """Split rows by their value in a column.

    Numbers are in ascending order, names in the order of their first row.
    """
    is_numeric = pd.api.types.is_numeric_dtype(get_column(rows, name))
    return {
        wording.format_figure_value(value): group_rows
        for value, group_rows in rows.groupby(name, sort=is_numeric)
    }


def rank_predictions(predictions: Iterable[str]) -> list[tuple[str, int]]:
    """Count predictions, the most frequent first; ties are in alphabetical order."""
    return sorted(Counter(predictions).items(), key=lambda item: (-item[1], item[0]))


class ClusteredFraction:
    """Counts some rows in independent units, and estimates the fraction of these rows.

    A unit is what dependent rows share, such as a draw of a seed.

    Attributes:
        name: name of the rows in tables and sentences, such as that of an environment.
        unit_counts: (n,) number of rows that are counted in each unit.
        unit_sizes: (n,) number of all rows of each unit.
        n_counted: number of rows that are counted.
        total: number of all rows.
        fraction: mean over units of the fraction that is counted; None without rows.
    """

    def __init__(
        self, name: str, unit_counts: Float64Array, unit_sizes: Float64Array
    ) -> None:
        """Compute the totals and the fraction from the counts of each unit.

        Args:
            name: name of the rows, such as that of an environment.
            unit_counts: (n,) number of rows that are counted in each unit.
            unit_sizes: (n,) number of all rows of each unit.
        """
        self.name = name
        self.unit_counts = unit_counts
        self.unit_sizes = unit_sizes
        self.n_counted = round(float(unit_counts.sum()))
        self.total = round(float(unit_sizes.sum()))
        self.fraction = None
        if self.total:
            self.fraction = statistics.clustered.mean_rate(unit_counts, unit_sizes)

    @classmethod
    def from_rows(cls, name: str, rows: Rows, flags: Any = None) -> ClusteredFraction:
        """Count rows by unit.

        Args:
            name: name of the rows.
            rows: rows with a column "unit".
            flags: (n,) whether each row is counted; None counts the correct ones.
        """
        if flags is None:
            flags = rows["correct"]
        is_counted = np.asarray(flags, dtype=np.float64)
        unit_index = pd.factorize(rows["unit"])[0]
        unit_counts = statistics.clustered.sum_per_unit(is_counted, unit_index)
        unit_sizes = statistics.clustered.sum_per_unit(np.ones(len(rows)), unit_index)
        return cls(name, unit_counts, unit_sizes)

    def with_name(self, name: str) -> ClusteredFraction:
        """Return the same counts under another name."""
        return ClusteredFraction(name, self.unit_counts, self.unit_sizes)

    @property
    def table_cells(self) -> list[Cell]:
        """Cells of a table: numerator, denominator, fraction, and its 95 % interval."""
        bounds = self.interval() or (None, None)
        return [self.n_counted, self.total, self.fraction, *bounds]

    @property
    def fraction_with_interval(self) -> tuple[float, results.Interval] | None:
        """The fraction with its 95 % interval, as a bar chart takes it."""
        if self.fraction is None:
            return None
        return self.fraction, self.interval() or (0.0, 1.0)

    def interval(self, n_compared: int = 1) -> results.Interval | None:
        """Return the 95 % interval of the fraction.

        With `n_compared` > 1 it is widened for that many comparisons (Bonferroni).
        """
        if not self.total:
            return None
        confidence = 1.0 - (1.0 - statistics.intervals.CONFIDENCE) / max(n_compared, 1)
        return statistics.clustered.rate_interval(
            self.unit_counts, self.unit_sizes, confidence
        )

    def describe(self, verb: str = "right") -> str:
        """Format the fraction: ``right in 12 of 20 (60 %, 95 % interval 36-81 %)``.

        `verb` states what is counted.
        """
        share = (
            f"{wording.percent(self.fraction)}, 95 % interval "
            f"{wording.format_interval(self.interval())}"
        )
        return f"{verb} in {self.n_counted} of {self.total} ({share})"

    def is_below(self, other: ClusteredFraction, n_compared: int = 1) -> bool:
        """Return whether the interval of this fraction lies below that of another.

        Both are widened for `n_compared` comparisons.
        """
        lower = self.interval(n_compared)
        upper = other.interval(n_compared)
        return lower is not None and upper is not None and lower[1] < upper[0]


def describe_extremes(
    fractions: Sequence[ClusteredFraction],
    lowest_prefix: str,
    highest_prefix: str,
    things: str,
    verb: str = "right",
) -> list[str]:
    """Describe which fraction is the lowest and which is the highest.

    The two were selected among k because they are extreme. Therefore they are compared
    by intervals of confidence 1 - 0.05 / k, which hold for all k together. If these
    overlap, no difference is shown.

    Args:
        fractions: the fractions; those without rows are left out.
        lowest_prefix: beginning of the sentence about the lowest, such as "Lowest".
        highest_prefix: beginning of the part about the highest.
        things: plural of what the fractions are of, such as "environments".
        verb: word for what is counted, for example "right" or "wrong".
    """
    known = [tally for tally in fractions if tally.total]
    if len(known) < 2:
        return [f"{tally.name}: {tally.describe(verb)}." for tally in known]
    shares = [tally.fraction or 0.0 for tally in known]
    lowest = known[int(np.argmin(shares))]
    highest = known[int(np.argmax(shares))]
    if lowest.fraction == highest.fraction:
        return [_describe_equal_shares(lowest, len(known), things)]
    lowest_text = _describe_extreme(lowest, shares, verb)
    highest_text = _describe_extreme(highest, shares, verb)
    return [
        f"{lowest_prefix} {lowest_text}; {highest_prefix} {highest_text}.",
        _compare_extremes(lowest, highest, len(known), things),
    ]


def _describe_equal_shares(
    tally: ClusteredFraction, n_fractions: int, things: str
) -> str:
    """State that all of several fractions are equal to the one given as `tally`."""
    return (
        f"All {n_fractions} {things} have the same share, "
        f"{wording.percent(tally.fraction)}: no difference is shown."
    )


def _describe_extreme(
    tally: ClusteredFraction, shares: Sequence[float], verb: str
) -> str:
    """Describe an extreme fraction, and how many of all shares are equal to it."""
    n_ties = shares.count(tally.fraction or 0.0) - 1  # without the fraction itself
    ties = _format_ties(n_ties)
    return f"is {tally.name}{ties}: {tally.describe(verb)}"


def _compare_extremes(
    lowest: ClusteredFraction, highest: ClusteredFraction, n_known: int, things: str
) -> str:
    """State whether two fractions that were selected among `n_known` differ."""
    widened = (
        f"the intervals of the two, widened for having been chosen among {n_known},"
    )
    if lowest.is_below(highest, n_known):
        return f"The difference is shown: {widened} do not overlap."
    return f"No difference between the {things} is shown: {widened} overlap."


def _format_ties(n_ties: int) -> str:
    """Return how many others have the same fraction: " (as 2 others)"; "" if none."""
    if not n_ties:
        return ""
    plural_ending = "s" if n_ties > 1 else ""
    return f" (as {n_ties} other{plural_ending})"


def pluralize_column(name: str) -> str:
    """Return the plural that names the values of a column.

    For example, ``environments`` for "environment.which", ``materials`` for "material",
    and ``values of pose.yaw`` for "pose.yaw".
    """
    if name == TRIAL_COLUMN:
        return "kinds of trials"
    control, _, parameter = name.partition(".")
    # The parameter "which" of a control selects one of the things that the control is
    # named after, such as an environment.
    if parameter in ("", "which"):
        return f"{control}s"
    return f"values of {name}"


def strip_control(name: str) -> str:
    """Return a parameter's name without its control: ``milk`` for ``contents.milk``."""
    return name.rpartition(".")[2]


class Options(BaseModel):
    """Options of every figure.

    Attributes:
        title: title of the figure; empty takes the default title.
        of: parts of the recipe whose rows the figure shows; empty shows all.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str = Field(default="", max_length=200)
    of: tuple[str, ...] = ()

    @property
    def required_parts(self) -> tuple[str, ...]:
        """The parts of the recipe that the figure needs; empty for all."""
        return self.of


@dataclass(frozen=True)
class FigureContent:
    """Content of a figure: sentences, a table, and a function that draws it.

    Attributes:
        title: title of the figure.
        text: sentences that describe the figure.
        columns: heads of the table's columns.
        rows: rows of the table.
        draw: draws all but the title on a matplotlib figure.
        size: width and height in inches.
    """

    title: str
    text: Sequence[str]
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    draw: Callable[[Any], None]
    size: tuple[float, float]


# default number of bins of a range that lines are drawn over
DEFAULT_BINS = 12
# number of characters of a label that fit under a column without being rotated
MAX_UPRIGHT_LETTERS = 4
# for each row by its name, a fraction for each series
Cells = Mapping[str, Sequence[ClusteredFraction]]


class RatesOptions(Options):
    """Options of a figure of rates; see docs/recipes.md.

    Attributes:
        by: column whose values have a row each.
        series: column whose values have a bar or a line each; None for none.
        form: what is drawn.
        bins: number of bins of a numeric column; None for a row of each value.
        range: range of the bins; None takes that of the values.
        names: names in the figure, by value.
        wrong: whether wrong predictions are counted instead of right ones.
        beside: part that all others are compared with; None for none.
        away_from: value whose distance from the column's is used instead; None uses the
            column itself.
        turn: period of the values, such as 360 degrees; None for none.
    """

    by: str
    series: str | None = None
    form: Literal["bars", "lines", "map"] = "bars"
    bins: int | None = Field(default=None, ge=1, le=100)
    range: tuple[float, float] | None = None
    names: dict[str, str] = Field(default_factory=dict)
    wrong: bool = False
    beside: str | None = None
    away_from: float | None = None
    turn: float | None = Field(default=None, gt=0.0)

    @property
    def required_parts(self) -> tuple[str, ...]:
        """The parts of the recipe that the figure needs; empty for all.

        The part `beside` is needed in addition to those in `of`.
        """
        needs_all = not self.of
        if needs_all or not self.beside:
            return self.of
        return (*self.of, self.beside)

    @property
    def verb(self) -> str:
        """The word for what is counted: "wrong" or "right"."""
        return "wrong" if self.wrong else "right"

    @property
    def axis_label(self) -> str:
        """The label of the axis: the column, or the distance from a value of it."""
        if self.away_from is None:
            return self.by
        return f"the distance of {self.by} from {wording.format_figure_value(self.away_from)}"


def make_rates_figure(rows: Rows, options: RatesOptions) -> FigureContent:
    """Make a figure of the fractions of right or wrong predictions.

    Args:
        rows: rows of the parts that the figure shows.
        options: columns that the rates are split by, and how they are drawn.

    Raises:
        InputError: if there are no rows, or the columns don't suit the options.
    """
    baseline_rows, rows = _split_baseline(rows, options)
    if rows.empty:
        raise InputError(
            "figures: rates: expected rows of a part beside "
            f"{options.beside!r}, got none"
        )
    return _RatesContent.from_predictions(rows, baseline_rows, options).make_figure()


@dataclass(frozen=True)
class _RatesContent:
    """The fractions that a figure of rates shows.

    Attributes:
        options: options of the figure.
        series: names of the series; a single one without a column of series.
        cells: for each bar by its name, a fraction for each series.
        totals: fraction of each series over all bars.
        baseline: fraction of each series in the part that all others are compared with;
            None without one.
        bin_centers: centers of the bins; None if the bars are single values.
        rows: the rows, without those of the baseline.
    """

    options: RatesOptions
    series: Sequence[str]
    cells: Cells
    totals: Sequence[ClusteredFraction]
    baseline: Sequence[ClusteredFraction] | None
    bin_centers: Sequence[float] | None
    rows: Rows

    @classmethod
    def from_predictions(
        cls, rows: Rows, baseline_rows: Rows, options: RatesOptions
    ) -> _RatesContent:
        """Count the predictions of some rows for each bar and series.

        Args:
            rows: the rows without those of the baseline, the part that all others are
                compared with.
            baseline_rows: rows of the baseline; may be empty.
            options: options of the figure.
        """
        values = list(split_rows(rows, options.series)) if options.series else [""]
        cells, bin_centers = _count_cells(rows, values, options)
        totals = _count_series("all", rows, values, options)
        baseline = None
        if options.beside and len(baseline_rows):
            baseline = _count_series("", baseline_rows, values, options)
        series = [options.names.get(value, value) for value in values]
        return cls(options, series, cells, totals, baseline, bin_centers, rows)

    def make_figure(self) -> FigureContent:
        """Make the figure: its sentences, its table and how it is drawn."""
        options = self.options
        series_column = [options.series] if options.series else []
        # numbers of groups of bars, of rows of a map, and of series
        numbers = len(self.bars), len(self.cells), len(self.series)
        return FigureContent(
            title=f"{'Error' if options.wrong else 'Accuracy'} by "
            f"{_name_columns(options)}",
            text=self._describe_rates(),
            columns=[options.by, *series_column, options.verb, *FRACTION_HEADS],
            rows=_tabulate_rates(self.bars, self.totals, self.series, options),
            draw=self.draw,
            size=_choose_size(*numbers, options),
        )

    @property
    def baseline_name(self) -> str:
        """The name of the part that all others are compared with; empty without one."""
        part = self.options.beside or ""
        return self.options.names.get(part, part)

    @property
    def bars(self) -> Cells:
        """For each bar a fraction for each series; the baseline is the first bar."""
        if self.baseline is None:
            return self.cells
        return {self.baseline_name: self.baseline, **self.cells}

    def _describe_rates(self) -> list[str]:
        """Describe the extremes, the series, and the difference from the baseline."""
        is_binned = self.bin_centers is not None
        text = _describe_cells(self.cells, self.series, is_binned, self.options)
        text += _describe_series(self.cells, self.totals, self.series, self.options)
        if self.baseline is not None:
            text += _compare_with_baseline(
                self.baseline_name,
                self.baseline,
                self.totals,
                self.series,
                self.options.verb,
            )
        return text

    def draw(self, figure: Any) -> None:
        """Draw lines over the bins, or else bars or a map."""
        if self.options.form == "lines":
            # Lines are drawn over bins, but a single value has no center.
            positions = self.bin_centers or range(len(self.cells))
            unit = format_unit(self.rows, self.options.by).strip()
            _draw_rate_lines(
                figure, self.cells, self.series, positions, unit, self.options
            )
        else:
            _draw_rates(figure, self.bars, self.cells, self.series, self.options)


def _split_baseline(rows: Rows, options: RatesOptions) -> tuple[Rows, Rows]:
    """Return the rows of the part that the others are compared with, and the others."""
    is_baseline = rows[PART_COLUMN] == options.beside
    return rows[is_baseline], rows[~is_baseline]


def _name_columns(options: RatesOptions) -> str:
    """Name the columns that rates are split by: ``environments and models``."""
    columns = pluralize_column(options.by)
    if options.series:
        columns += f" and {pluralize_column(options.series)}"
    return columns


def _count_cells(
    rows: Rows, series_values: Sequence[str], options: RatesOptions
) -> tuple[dict[str, list[ClusteredFraction]], list[float] | None]:
    """Count the rows of each group and series.

    Bars of names are sorted by the fraction of the first series, the highest first.

    Args:
        rows: rows without those of the baseline.
        series_values: values of the column `options.series`; a single "" without it.
        options: options of the figure.

    Returns:
        For each group by its name, a fraction for each series; and the centers of the
        bins, None if the groups are single values.
    """
    groups, bin_centers = _group_rows(rows, options)
    cells = dict[str, list[ClusteredFraction]]()
    for value, group_rows in groups.items():
        name = options.names.get(value, value)
        cells[name] = _count_series(name, group_rows, series_values, options)
    # Numbers and bins stay in their order.
    are_names = bin_centers is None and not is_numeric_dtype(
        get_column(rows, options.by)
    )
    if options.form == "bars" and are_names:
        cells = _sort_by_first_series(cells)
    return cells, bin_centers


def _sort_by_first_series(
    cells: dict[str, list[ClusteredFraction]],
) -> dict[str, list[ClusteredFraction]]:
    """Sort bars by their fraction in the first series, the highest first."""
    order = sorted(cells, key=lambda name: -(cells[name][0].fraction or 0.0))
    return {name: cells[name] for name in order}


def _count_series(
    name: str, rows: Rows, series_values: Sequence[str], options: RatesOptions
) -> list[ClusteredFraction]:
    """Count the right predictions in each series; with `options.wrong` the wrong ones.

    Args:
        name: name of the fractions.
        rows: the rows of all series.
        series_values: values of the column `options.series`; a single "" without it.
        options: options of the figure.

    Returns:
        A fraction for each series, in the order of `series_values`. A series without
        rows has a fraction of no rows.
    """
    rows_of_series = {"": rows}  # without the column, `series_values` is [""]
    if options.series and len(rows):
        rows_of_series = split_rows(rows, options.series)
    counts_right = not options.wrong
    no_rows = rows[:0]
    tallies = []
    for value in series_values:
        series_rows = rows_of_series.get(value, no_rows)
        is_counted = series_rows["correct"] == counts_right
        tallies.append(ClusteredFraction.from_rows(name, series_rows, is_counted))
    return tallies


def _name_series(series: Sequence[str], options: RatesOptions) -> list[str]:
    """Return names of series for sentences.

    A number follows the name of the column, as in ``severity 3``.
    """
    column_name = strip_control(options.series or "")
    names = []
    for name in series:
        starts_like_number = name[:1] in tuple("-0123456789")
        names.append(f"{column_name} {name}" if starts_like_number else name)
    return names


def _describe_cells(
    cells: Cells, series: Sequence[str], is_binned: bool, options: RatesOptions
) -> list[str]:
    """Describe the lowest and the highest fraction: of a map, or else of each series.

    Args:
        cells: for each bar of the figure by its name, a fraction for each series.
        series: names of the series.
        is_binned: whether the bars are bins of a number.
        options: options of the figure.
    """
    if options.form == "map":
        return _describe_map_cells(cells, series, options)
    where = f" where {options.axis_label}" if is_binned else ""
    if len(series) == 1:
        return _describe_bars(_select_series(cells, 0), "Lowest", where, options)
    text = list[str]()
    for index, name in enumerate(series):
        tallies = _select_series(cells, index)
        n_known = sum(tally.total > 0 for tally in tallies)
        if n_known > 1:  # a single bar can be compared with no other of the series
            text += _describe_bars(tallies, f"For {name}, lowest", where, options)
    return text


def _describe_bars(
    tallies: Sequence[ClusteredFraction],
    beginning: str,
    where: str,
    options: RatesOptions,
) -> list[str]:
    """Describe the lowest and the highest bar of a series.

    Args:
        tallies: the fraction of each bar.
        beginning: first words of the sentence, such as "Lowest".
        where: the words that name a binned parameter, such as " where elevation";
            empty if the bars are no bins.
        options: options of the figure.
    """
    return describe_extremes(
        tallies,
        lowest_prefix=f"{beginning}{where}",
        highest_prefix=f"highest{where}",
        things=pluralize_column(options.by),
        verb=options.verb,
    )


def _select_series(cells: Cells, index: int) -> list[ClusteredFraction]:
    """Return the fractions of one series, each under the name of its bar."""
    return [
        fractions[index].with_name(bar_name) for bar_name, fractions in cells.items()
    ]


def _describe_map_cells(
    cells: Cells, series: Sequence[str], options: RatesOptions
) -> list[str]:
    """Describe the lowest and the highest fraction of all cells of a map.

    Args:
        cells: for each row by its name, a fraction for each series.
        series: names of the series.
        options: options of the figure.
    """
    pairs = []
    names = _name_series(series, options)
    for row_name, tallies in cells.items():
        for name, tally in zip(names, tallies, strict=True):
            pairs.append(tally.with_name(f"{row_name} with {name}"))
    return describe_extremes(
        pairs,
        lowest_prefix="The lowest pair",
        highest_prefix="the highest",
        things=f"pairs of {_name_columns(options)}",
        verb=options.verb,
    )


def _describe_series(
    cells: Cells,
    totals: Sequence[ClusteredFraction],
    series: Sequence[str],
    options: RatesOptions,
) -> list[str]:
    """Compare the series over all rows.

    If the series are models and errors are counted, there is also a sentence for each
    model but the first: the mean over the bars of its error relative to that of the
    first model, as the mCE (mean corruption error) of Hendrycks and Dietterich (2019).

    Args:
        cells: for each bar of the figure a fraction for each series.
        totals: fraction of each series over all bars.
        series: names of the series.
        options: options of the figure.
    """
    if not options.series or len(series) < 2:
        return []
    # The sentence becomes "Over all, the lowest share is that of NAME: ...".
    overall = [
        tally.with_name(f"that of {name}")
        for name, tally in zip(_name_series(series, options), totals, strict=True)
    ]
    sentences = _describe_overall(overall, options.series, options.verb)
    # Figures of other columns have the same sentences, and `omit_repeated_sentences`
    # drops equal texts. So they are one text here.
    text = [" ".join(sentences)]
    if options.wrong and options.series == MODEL_COLUMN:
        text += _describe_mean_errors(cells, series)
    return text


def _describe_overall(
    overall: Sequence[ClusteredFraction], series_column: str, verb: str
) -> list[str]:
    """Describe the series with the lowest and that with the highest fraction of all.

    Args:
        overall: the fraction of each series over all bars.
        series_column: name of the column that separates the series.
        verb: word for what is counted, for example "right" or "wrong".
    """
    return describe_extremes(
        overall,
        lowest_prefix="Over all, the lowest share",
        highest_prefix="the highest",
        things=pluralize_column(series_column),
        verb=verb,
    )


def _describe_mean_errors(cells: Cells, models: Sequence[str]) -> Iterator[str]:
    """Yield the mean corruption error (mCE) of each model but the first, as sentences.

    That is the mean, over the bars of the figure (the corruptions), of the model's
    error divided by the first model's. In the paper, the first model is AlexNet. Bars
    in which the first model has no errors are left out.

    Args:
        cells: for each bar a fraction of errors for each model.
        models: names of the models.
    """
    for index, name in enumerate(models[1:], start=1):
        ratios = []
        for tallies in cells.values():
            first_error = tallies[0].fraction
            if first_error:
                ratios.append((tallies[index].fraction or 0.0) / first_error)
        if ratios:
            mean = 100.0 * sum(ratios) / len(ratios)
            yield (
                f"Relative to {models[0]}, in AlexNet's place, the mCE of "
                f"{name} is {mean:.0f} %."
            )


def _compare_with_baseline(
    name: str,
    tallies: Sequence[ClusteredFraction],
    totals: Sequence[ClusteredFraction],
    series: Sequence[str],
    verb: str,
) -> list[str]:
    """Compare one part with all other rows, in a sentence for each series.

    A difference is shown if the intervals do not overlap.

    Args:
        name: name of the part.
        tallies: fractions of the part, for each series.
        totals: fractions of the other parts, for each series.
        series: names of the series.
        verb: word for what is counted, for example "right" or "wrong".
    """
    text = []
    for series_name, tally, total in zip(series, tallies, totals, strict=True):
        differs = tally.is_below(total) or total.is_below(tally)
        verdict = "is shown" if differs else "is not shown"
        whose = f"{series_name}, " if len(series) > 1 else ""
        text.append(
            f"{whose}{name}: {tally.describe(verb)}; the others: "
            f"{total.describe(verb)}. A difference {verdict}."
        )
    return text


def _tabulate_rates(
    cells: Cells,
    totals: Sequence[ClusteredFraction],
    series: Sequence[str],
    options: RatesOptions,
) -> list[list[Cell]]:
    """Return the table of a rates figure; with series, their totals come last.

    Args:
        cells: for each bar by its name, a fraction for each series.
        totals: fraction of each series over all bars.
        series: names of the series; a single one without a column of series.
        options: options of the figure.
    """
    tallies_of_bar = dict(cells)
    if options.series:
        tallies_of_bar["all"] = totals
    table = list[list[Cell]]()
    for bar_name, tallies in tallies_of_bar.items():
        for series_name, tally in zip(series, tallies, strict=True):
            series_cell = [series_name] if options.series else []
            table.append([bar_name, *series_cell, *tally.table_cells])
    return table


def _choose_size(
    n_bar_groups: int, n_map_rows: int, n_series: int, options: RatesOptions
) -> tuple[float, float]:
    """Return width and height of a rates figure in inches.

    A map has a column for each series. Bars come in groups, each with a bar for each
    series.
    """
    if options.form == "map":
        width = max(2.8 + 0.42 * n_series, MIN_MAP_WIDTH)
        return width, 1.9 + 0.28 * n_map_rows
    if options.form == "lines":
        return FIGURE_WIDTH, LINES_HEIGHT
    return FIGURE_WIDTH, 1.4 + (0.2 + 0.09 * n_series) * n_bar_groups


def _draw_rates(
    figure: Any,
    bars: Cells,
    cells: Cells,
    series: Sequence[str],
    options: RatesOptions,
) -> None:
    """Draw a map of the cells, or bars; only bars have the baseline.

    Args:
        figure: figure of matplotlib.
        bars: for each row a fraction for each series, with the baseline first, if any.
        cells: the same without the baseline.
        series: names of the series.
        options: options of the figure.
    """
    axes = figure.subplots()
    label = f"{options.verb}, share"
    if options.form == "map":
        _draw_map(axes, cells, series, label)
        axes.set(ylabel=options.by, xlabel=options.series or "")
        return
    figures.draw_fractions(axes, _list_fractions_with_intervals(bars), series)
    axes.set(xlabel=f"{label} with 95 % interval")
    if len(series) > 1:
        figure.legend(loc="outside lower center", ncols=min(len(series), 3))


def _list_fractions_with_intervals(
    bars: Cells,
) -> dict[str, list[tuple[float, results.Interval] | None]]:
    """Return the fractions of bars with their intervals, as a bar chart takes them."""
    return {
        name: [tally.fraction_with_interval for tally in tallies]
        for name, tallies in bars.items()
    }


def _draw_rate_lines(
    figure: Any,
    cells: Cells,
    series: Sequence[str],
    positions: Sequence[float],
    unit: str,
    options: RatesOptions,
) -> None:
    """Draw a line for each series over the bins of a parameter.

    Args:
        figure: figure of matplotlib.
        cells: for each bin a fraction for each series.
        series: names of the series.
        positions: center of each bin, or its index if the rows are not binned.
        unit: unit of the parameter; empty without one.
        options: options of the figure.
    """
    axes = figure.subplots()
    _draw_lines(axes, cells, series, positions)
    x_label = f"{options.axis_label} [{unit}]" if unit else options.axis_label
    axes.set(xlabel=x_label, ylabel=f"{options.verb}, share with 95 % interval")
    if len(series) > 1:
        figure.legend(loc="outside lower center", ncols=min(len(series), 3))


def _group_rows(
    rows: Rows, options: RatesOptions
) -> tuple[Mapping[str, Rows], list[float] | None]:
    """Split rows by the values of a column, or by bins of its values.

    Each value is a group if `bins` is None and no lines are drawn. Rows outside of the
    `range` are in no bin.

    Args:
        rows: the rows.
        options: the column, and the number and range of its bins.

    Returns:
        The rows by the name of the value or bin; and the centers of the bins, None if
        there are no bins.
    """
    if options.bins is None and options.form != "lines":
        return split_rows(rows, options.by), None
    return _split_into_bins(rows, options)


def _split_into_bins(
    rows: Rows, options: RatesOptions
) -> tuple[dict[str, Rows], list[float]]:
    """Split rows by bins of equal width of a column, without those outside of its range.

    Returns:
        The rows by the name of the bin, and the centers of the bins.
    """
    values = _read_binned_values(rows, options)
    n_bins = options.bins or DEFAULT_BINS
    lower, upper = _find_binned_range(values, options)
    bin_index = _find_bins(values, lower, upper, n_bins)
    edges = [lower + (upper - lower) * index / n_bins for index in range(n_bins + 1)]
    unit = format_unit(rows, options.by)
    groups = {
        _name_bin(start, end, unit): rows[bin_index == index]
        for index, (start, end) in enumerate(pairwise(edges))
    }
    centers = [(start + end) / 2 for start, end in pairwise(edges)]
    return groups, centers


def _find_binned_range(values: Any, options: RatesOptions) -> tuple[float, float]:
    """Return the range of the bins: that of the options, or else of the values (n,).

    Raises:
        InputError: the range is empty.
    """
    lower, upper = options.range or (values.min(), values.max())
    if not upper > lower:
        raise InputError(
            f"figures: rates: expected values of {options.by} that "
            f"differ, got {lower:g} to {upper:g}"
        )
    return lower, upper


def _name_bin(start: float, end: float, unit: str) -> str:
    """Name a bin by its bounds, which `unit` follows: ``0 to 30 deg``."""
    lower = wording.format_figure_value(start)
    upper = wording.format_figure_value(end)
    return f"{lower} to {upper}{unit}"


def _find_bins(values: Any, lower: float, upper: float, n_bins: int) -> Any:
    """Return the index of the bin of each value as a float; NaN outside of the range.

    Both ends belong to the range.

    Args:
        values: column of numbers.
        lower: lower end of the range.
        upper: upper end of the range.
        n_bins: number of bins of equal width.
    """
    position = (values - lower) / (upper - lower) * n_bins
    is_in_range = values.between(lower, upper)
    index = position // 1  # rounded down
    index = index.clip(
        upper=n_bins - 1
    )  # the upper end of the range is in the last bin
    return index.where(is_in_range)


def _read_binned_values(rows: Rows, options: RatesOptions) -> Any:
    """Return the column that is binned, or its distances from `options.away_from`.

    If the values repeat after `options.turn`, such as 360 degrees, the distance is the
    shorter way around the circle.
    """
    values = get_numeric_column(rows, options.by)
    if options.away_from is None:
        return values
    distance = (values - options.away_from).abs()
    if options.turn is None:
        return distance
    # the shorter of both arcs of a circle
    arc = distance % options.turn
    return np.minimum(arc, options.turn - arc)


SLANTED_STYLE: Mapping[str, Any] = {
    "rotation": 35,
    "ha": "right",
    "rotation_mode": "anchor",
}
"""How matplotlib draws labels that are too long to stand next to each other."""


def _draw_map(axes: Any, cells: Cells, series: Sequence[str], label: str) -> None:
    """Draw the fractions as a matrix of colors with percentages in it.

    Args:
        axes: axes of matplotlib.
        cells: for each row of the matrix a fraction for each series.
        series: names of the columns.
        label: label of the color bar.
    """
    shares = [
        [math.nan if tally.fraction is None else tally.fraction for tally in tallies]
        for tallies in cells.values()
    ]
    image = axes.imshow(shares, cmap="RdBu", vmin=0.0, vmax=1.0, aspect="auto")
    _draw_percentages(axes, shares)
    are_long = max(map(len, series)) > MAX_UPRIGHT_LETTERS
    axes.set_xticks(range(len(series)), series, **(SLANTED_STYLE if are_long else {}))
    axes.set_yticks(range(len(cells)), list(cells))
    axes.figure.colorbar(
        image,
        ax=axes,
        label=f"{label} [%]",
        format=lambda share, _: f"{100 * share:.0f}",
    )


def _draw_percentages(axes: Any, shares: list[list[float]]) -> None:
    """Write each known share of a map (rows, columns) as a percentage into its cell."""
    for (row, column_index), share in np.ndenumerate(shares):
        if math.isnan(share):
            continue
        axes.text(
            column_index,
            row,
            f"{100 * share:.0f}",
            ha="center",
            va="center",
            # readable on a dark color, at either end of the scale
            color="white" if abs(share - 0.5) > 0.3 else "black",
            fontsize=7.5,
        )


def _draw_lines(
    axes: Any, cells: Cells, series: Sequence[str], bin_positions: Sequence[float]
) -> None:
    """Draw the fractions of each series as a line, with their 95 % intervals as bands.

    Args:
        axes: axes of matplotlib.
        cells: for each bin a fraction for each series.
        series: names for the legend.
        bin_positions: positions of the bins along the horizontal axis.
    """
    for index, name in enumerate(series):
        tallies = [cell_tallies[index] for cell_tallies in cells.values()]
        color = figures.SERIES[index % len(figures.SERIES)]
        marker = figures.MARKS[index % len(figures.MARKS)]
        _draw_band(axes, bin_positions, tallies, color=color, marker=marker, label=name)
    axes.set(ylim=(-0.03, 1.03))
    axes.grid(True, axis="y")


def _draw_band(
    axes: Any,
    bin_positions: Sequence[float],
    tallies: Sequence[ClusteredFraction],
    *,
    color: str,
    **style: Any,
) -> None:
    """Draw the known fractions of one series as a line, with their intervals as a band.

    Args:
        axes: axes of matplotlib.
        bin_positions: positions of the bins along the horizontal axis.
        tallies: the fraction of each bin.
        color: color of the line and of the band.
        **style: label and marker of the line.
    """
    pairs = zip(bin_positions, tallies, strict=True)
    positions = [position for position, tally in pairs if tally.total]
    known = [tally for tally in tallies if tally.total]
    # An unknown interval is drawn as a band from 0 to 1.
    intervals = [tally.interval() or (0.0, 1.0) for tally in known]
    lower = [low for low, _ in intervals]
    upper = [high for _, high in intervals]
    axes.fill_between(positions, lower, upper, color=color, alpha=0.15, linewidth=0)
    shares = [tally.fraction for tally in known]
    axes.plot(positions, shares, color=color, ms=4, **style)


NO_PHOTOGRAPHS = (
    "There are no photographs yet: nothing is said about reality here. Take some with "
    "advsearch dashboard and the "
    "runs in parts/, or name a folder of them (photographs=FOLDER), and let advsearch "
    "resume go on with this run."
)
ALL_OBJECTS = "all objects"


class AgreementOptions(Options):
    """Options of a figure of agreement.

    The first part in `of` has the renderings that photographs are compared with. The
    other parts show the same configurations under other conditions.
    """

    of: tuple[str, ...] = Field(min_length=1)
    names: dict[str, str] = Field(default_factory=dict)

    @property
    def required_parts(self) -> tuple[str, ...]:
        """The parts of the recipe that the figure needs."""
        return (*self.of, PHOTOGRAPHS)


AGREEMENT_HEADS = [
    "rendering and",
    "object",
    # whether the model is right about the rendering, and about the other image
    *("right, right", "right, wrong", "wrong, right", "wrong, wrong"),
    "same prediction",
    "agree",
    *FRACTION_HEADS,
]


def make_agreement_figure(rows: Rows, options: AgreementOptions) -> FigureContent:
    """Compare predictions about renderings with those about other images of the object.

    The other images are photographs, and the images of other parts. A pair agrees if
    the model is right about both images, or wrong about both. If there are no
    photographs, a sentence states it.

    Args:
        rows: rows of the parts and of the photographs.
        options: the part with the renderings, and the parts to compare them with.

    Raises:
        InputError: if a part has no rows or other configurations.
    """
    comparison = _AgreementContent(options, _select_renderings(rows, options.of[0]))
    for part in (PHOTOGRAPHS, *options.of[1:]):
        part_rows = _select_part(rows, part)
        if part == PHOTOGRAPHS and part_rows.empty:
            comparison.text.append(NO_PHOTOGRAPHS)
        else:
            comparison.add_part(part, part_rows)
    n_series = len(comparison.series)
    n_objects = len(comparison.bars) - 1  # `bars` has one entry more
    return FigureContent(
        title="Renderings and other pictures of the same",
        text=comparison.text,
        columns=AGREEMENT_HEADS,
        rows=comparison.table,
        draw=lambda figure: _draw_agreement(figure, comparison.bars, comparison.series),
        # inches; a line of the legend for each series, and a row of bars for each
        # object
        size=(FIGURE_WIDTH, 1.7 + 0.2 * n_series + 0.34 * n_objects),
    )


def _select_renderings(rows: Rows, part: str) -> Rows:
    """Return the rows of the part that has the renderings.

    Raises:
        InputError: it has no rows.
    """
    # A column that only rows of other parts have is empty here, and is removed.
    renderings = _select_part(rows, part).dropna(axis=1, how="all")
    if renderings.empty:
        raise InputError(
            f"figures: agreement: expected predictions of a part {part!r}, got none"
        )
    return renderings


class _AgreementContent:
    """Content of a figure of agreement, to which parts are added.

    Attributes:
        options: options of the figure.
        renderings: rows of the renderings.
        bars: for each object, and for `ALL_OBJECTS`, a fraction for each series.
        series: name of each series, which is a part that renderings are compared with.
        text: sentences.
        table: rows of the table.
    """

    def __init__(self, options: AgreementOptions, renderings: Rows) -> None:
        """Begin without any series."""
        self.options = options
        self.renderings = renderings
        objects = [ALL_OBJECTS, *renderings["object"].unique()]
        self.bars: dict[str, list[ClusteredFraction]] = {name: [] for name in objects}
        self.series = list[str]()
        self.text = list[str]()
        self.table = list[list[Cell]]()

    def add_part(self, part: str, part_rows: Rows) -> None:
        """Compare the renderings with the rows of a part.

        Raises:
            InputError: if the part has other configurations.
        """
        pairs = _pair_rows(part_rows, self.renderings)
        n_unpaired = len(part_rows) - len(pairs)
        # A photograph may belong to no rendering, but rows of other parts must.
        if part != PHOTOGRAPHS and n_unpaired:
            raise self._make_unpaired_error(part)
        name = self.options.names.get(part, part)
        self.series.append(name)
        _add_agreement(self.bars, pairs, self.table, name)
        if len(pairs):
            total = self.bars[ALL_OBJECTS][-1]
            self.text.append(_describe_agreement(name, total, pairs))
        if part == PHOTOGRAPHS:
            self.text += _describe_photographs(len(pairs), n_unpaired)

    def _make_unpaired_error(self, part: str) -> InputError:
        """Make the error that a part has other configurations than the renderings."""
        return InputError(
            f"figures: agreement: expected {part} to have the "
            f"configurations of {self.options.of[0]}"
        )


def _select_part(rows: Rows, part: str) -> Rows:
    """Return the rows of a part of the recipe."""
    is_of_part = rows[PART_COLUMN] == part
    return rows[is_of_part]


def _add_agreement(
    bars: dict[str, list[ClusteredFraction]],
    pairs: Rows,
    table: list[list[Cell]],
    series_name: str,
) -> None:
    """Add how often pairs of images agree to the bars and to the table of a figure.

    Two images agree if the model is right about both, or wrong about both.

    Args:
        bars: fractions of each object, and of `ALL_OBJECTS`. Each list gets the
            fraction of these pairs.
        pairs: pairs of renderings and other images.
        table: rows of the table; a row is added for each entry of the bars.
        series_name: name of the series, which is that of the other images.
    """
    for name, tallies in bars.items():
        object_pairs = pairs
        if name != ALL_OBJECTS:
            is_of_object = pairs["object"] == name
            object_pairs = pairs[is_of_object]
        tally, cells = _count_agreement(name, object_pairs)
        tallies.append(tally)
        table.append([series_name, name, *cells])


def _draw_agreement(figure: Any, bars: Cells, series: Sequence[str]) -> None:
    """Draw bars of the fraction of pairs that agree, for all and for each object."""
    axes = figure.subplots()
    figures.draw_fractions(axes, _list_fractions_with_intervals(bars), series)
    axes.set(xlabel="share that agrees, with 95 % interval")
    figure.legend(loc="outside lower center", ncols=1)


def _pair_rows(part_rows: Rows, renderings: Rows) -> Rows:
    """Join the rows of a part with the renderings of the same configuration.

    Two rows have the same configuration if they agree in all columns of the renderings
    except for those that belong to a row, such as the prediction and the time. Rows of
    the part may have further parameters. A pair has these columns of both rows; the
    names of those of the rendering end in `` rendered``.
    """
    result_columns = {
        PREDICTION_COLUMN,
        PART_COLUMN,
        "correct",
        "margin",
        "time",
        "unit",
    }
    shared_columns = [name for name in renderings if name not in result_columns]
    return part_rows.merge(renderings, on=shared_columns, suffixes=("", " rendered"))


def _count_agreement(name: str, pairs: Rows) -> tuple[ClusteredFraction, list[Cell]]:
    """Count the pairs in which both predictions are right, or both are wrong.

    Args:
        name: name of the fraction.
        pairs: pairs with "correct rendered" for the rendering, "correct" for the other
            image.

    Returns:
        The fraction of these pairs; and the cells of the table's row: pairs by whether
        the rendering and the other image are right, equal predictions, and the
        fraction.
    """
    of_rendering = pairs["correct rendered"]
    of_other = pairs["correct"]
    confusion = list[Cell]()
    for rendering_is_right in (True, False):
        for other_is_right in (True, False):
            is_counted = (of_rendering == rendering_is_right) & (
                of_other == other_is_right
            )
            confusion.append(int(is_counted.sum()))
    tally = ClusteredFraction.from_rows(name, pairs, of_rendering == of_other)
    return tally, [*confusion, _count_same_prediction(pairs), *tally.table_cells]


def _count_same_prediction(pairs: Rows) -> int:
    """Return the number of pairs with the same prediction about both images."""
    rendered_prediction = pairs[f"{PREDICTION_COLUMN} rendered"]
    return int((rendered_prediction == pairs[PREDICTION_COLUMN]).sum())


def _describe_agreement(name: str, tally: ClusteredFraction, pairs: Rows) -> str:
    """Describe how often predictions about renderings and other images agree."""
    n_same = _count_same_prediction(pairs)
    return (
        f"Renderings and {name}: "
        f"{tally.describe('right about both or wrong about both')}. "
        f"{_describe_where(True, pairs)} {_describe_where(False, pairs)} "
        f"The prediction is the same in {n_same} of {len(pairs)} "
        f"({wording.percent(n_same / len(pairs))})."
    )


def _describe_photographs(n_pairs: int, n_unpaired: int) -> list[str]:
    """State what holds for pairs with photographs, and how many have no rendering."""
    text = []
    if n_pairs:
        text.append("The intervals take photographs as independent.")
    if n_unpaired:
        belong = "belongs" if n_unpaired == 1 else "belong"
        text.append(
            f"{n_unpaired} of the photographs {belong} to no rendering and so to "
            "no pair."
        )
    return text


def _describe_where(right: bool, pairs: Rows) -> str:
    """Describe how often the model is right about both images of a pair, or wrong.

    Among the pairs in which the model is right (wrong) about the rendering, this counts
    those in which it is also right (wrong) about the other image. The sentence calls
    the model "it", since it follows one that names the model.

    Args:
        right: whether to select the pairs in which the model is right about the
            rendering, or those in which it is wrong.
        pairs: pairs of a rendering and another image; the column "correct" is about the
            other image, "correct rendered" about the rendering.
    """
    verb = "right" if right else "wrong"
    is_selected = pairs["correct rendered"] == right
    selected = pairs[is_selected]
    if selected.empty:
        return f"It is {verb} about none of the renderings."
    tally = ClusteredFraction.from_rows("", selected, selected["correct"] == right)
    rate = tally.describe(verb)
    return f"Where it is {verb} about the rendering, it is {rate} about the other."


SCALING_HEADS = [
    "workers",
    "object",
    "pictures a second",
    "times as many as the fewest workers",
]


def make_scaling_figure(rows: Rows, options: Options) -> FigureContent:
    """Make a figure of the images per second of sweeps, by the number of workers.

    Args:
        rows: rows of sweeps, with the times when they were stored.
        options: options of the figure.

    Raises:
        InputError: if no sweep sets `workers`, or a run is too short.
    """
    rate_of_run = _compute_run_rates(rows)
    # for each number of workers, in ascending order, the rate of each object
    rates_by_count = {
        int(workers): run_rates.droplevel(WORKERS_COLUMN)
        for workers, run_rates in rate_of_run.groupby(level=WORKERS_COLUMN)
    }
    machine = _describe_machine(rows.attrs["cores"])
    return FigureContent(
        title="Pictures a second by number of workers",
        text=[*_describe_scaling(rates_by_count), machine],
        columns=SCALING_HEADS,
        rows=_tabulate_scaling(rates_by_count),
        draw=lambda figure: _draw_scaling(figure, rates_by_count, rate_of_run.max()),
        size=(FIGURE_WIDTH, LINES_HEIGHT),
    )


def _describe_machine(n_cores: int) -> str:
    """Describe the number of cores that the throughputs were measured with."""
    cores = wording.format_count(n_cores, "core")
    return (
        f"This machine gives {cores}; what other programs took of it meanwhile "
        "is in these numbers."
    )


def _compute_run_rates(rows: Rows) -> Any:
    """Compute the images per second of each run, by workers and object (a pd.Series).

    Raises:
        InputError: if no sweep sets `workers`, or a run is too short.
    """
    if WORKERS_COLUMN not in rows:
        raise InputError(
            "figures: scaling: expected sweeps with `workers` among the parts, got none"
        )
    # Each run has one object and one number of workers. Grouping leaves out the rows of
    # runs that do not set the workers.
    runs = rows.groupby([WORKERS_COLUMN, "object"], sort=False)
    return runs["time"].agg(_compute_throughput)


def _tabulate_scaling(rates_by_count: Mapping[int, Any]) -> list[list[Cell]]:
    """Return the table of a scaling figure: a row for each run.

    Args:
        rates_by_count: images per second by object (a pd.Series), by ascending worker
            count.
    """
    table = list[list[Cell]]()
    for workers, run_rates in rates_by_count.items():
        gains = _compute_gains(run_rates, rates_by_count)
        for name, rate in run_rates.items():
            table.append([workers, str(name), float(rate), gains.get(name)])
    return table


def _compute_gains(run_rates: Any, rates_by_count: Mapping[int, Any]) -> Any:
    """Divide the rate of each object by its rate with the fewest workers.

    Args:
        run_rates: images per second by object (a pd.Series).
        rates_by_count: the same for each number of workers, in ascending order.

    Returns:
        The quotients by object; objects without a rate with the fewest workers are left
        out.
    """
    rates_of_fewest = next(iter(rates_by_count.values()))
    return (run_rates / rates_of_fewest.reindex(run_rates.index)).dropna()


def _describe_scaling(rates_by_count: Mapping[int, Any]) -> list[str]:
    """Describe the throughput of each worker count, relative to the fewest workers.

    For each count there are several runs, one of each object. The sentences state their
    median and range.

    Args:
        rates_by_count: images per second by object (a pd.Series), by ascending worker
            count.
    """
    text = [_describe_count(workers, rates_by_count) for workers in rates_by_count]
    min_runs = min(map(len, rates_by_count.values()))
    if min_runs > 1:
        # The median of the population lies outside the range of n runs only if all n
        # are on one side of it. The chance of that is 0.5^n for either side, together
        # 0.5^(n - 1).
        confidence = 100 * (1 - 0.5 ** (min_runs - 1))
        text.append(
            f"Medians of {min_runs} runs, one of each object, with the lowest and the "
            "highest, which enclose the median of "
            f"all such runs with a confidence of {confidence:.3g} %."
        )
    return text


def _describe_count(workers: int, rates_by_count: Mapping[int, Any]) -> str:
    """Describe the throughput of one worker count in a sentence."""
    fewest = next(iter(rates_by_count))
    run_rates = rates_by_count[workers]
    sentence = (
        f"{wording.format_count(workers, 'worker')}: "
        f"{_format_spread(run_rates)} pictures a second"
    )
    gains = _compute_gains(run_rates, rates_by_count)
    if workers > fewest and len(gains):
        # 100 % if twice the workers give twice the throughput
        efficiency = 100 * gains.median() * fewest / workers
        sentence += (
            f", {_format_spread(gains)} times as many as "
            f"{wording.format_count(fewest, 'worker')} ({efficiency:.0f} % of linear)"
        )
    return f"{sentence}."


def _draw_scaling(
    figure: Any, rates_by_count: Mapping[int, Any], max_rate: float
) -> None:
    """Draw median and range of the throughput by worker count, and linear scaling.

    Args:
        figure: figure of matplotlib.
        rates_by_count: images per second by object, by ascending worker count.
        max_rate: the largest of all rates.
    """
    axes = figure.subplots()
    counts = list(rates_by_count)
    linear = _compute_linear_rates(rates_by_count)
    label = f"linear, from {wording.format_count(counts[0], 'worker')}"
    axes.plot(counts, linear, color="0.7", label=label)
    _draw_throughputs(axes, rates_by_count)
    axes.set_xticks(counts, list(map(str, counts)))
    y_end = 1.08 * max(*linear, max_rate)  # 8 % of room above the highest value
    axes.set(xlabel="workers", ylabel="pictures a second", ylim=(0.0, y_end))
    axes.grid(True, axis="y")
    figure.legend(loc="outside lower center", ncols=2)


def _compute_linear_rates(rates_by_count: Mapping[int, Any]) -> list[float]:
    """Compute the rate of each worker count if it grew linearly from the fewest."""
    fewest, slowest = next(iter(rates_by_count.items()))
    return [slowest.median() / fewest * workers for workers in rates_by_count]


def _draw_throughputs(axes: Any, rates_by_count: Mapping[int, Any]) -> None:
    """Draw the median of each worker count as a point, and the range as a bar."""
    bar_style = {"color": figures.BLUE, "alpha": 0.45, "linewidth": 3}
    for workers, run_rates in rates_by_count.items():
        bounds = [run_rates.min(), run_rates.max()]
        axes.plot([workers, workers], bounds, **bar_style)
    medians = [run_rates.median() for run_rates in rates_by_count.values()]
    label = "median; bar: lowest to highest run"
    counts = list(rates_by_count)
    axes.plot(counts, medians, "o-", color=figures.BLUE, ms=5, label=label)


def _compute_throughput(times: Any) -> float:
    """Compute images per second from the times (n,) when the rows of a run were stored.

    The first quarter is left out, since workers are still loading then. Rows of one
    batch are stored at the same time.

    Raises:
        InputError: if the rest is a single batch.
    """
    times = np.sort(times)
    start = times[len(times) // 4]
    if times[-1] <= start:
        raise InputError(
            "figures: scaling: expected runs of several batches; ask for "
            "more `samples`, or set `batch`"
        )
    return float((times > start).sum() / (times[-1] - start))


def _format_spread(values: Any) -> str:
    """Format the median of values, and their range if there are several."""
    median = f"{values.median():.3g}"
    if len(values) < 2:
        return median
    return f"{median} ({values.min():.3g} to {values.max():.3g})"


SURFACE_HEADS = [
    "object",
    "model",
    "parts",
    "seen",
    "compared",
    "with wrong predictions",
    "with right predictions",
]


def _make_surface_cells(surface_table: Any) -> list[Cell]:
    """Return the cells of a table's row about one object, model and kind of part."""
    return [
        surface_table.object,
        wording.shorten_name(surface_table.model),
        surface_table.part,
        surface_table.visible,
        surface_table.compared,
        surface_table.worse,
        surface_table.better,
    ]


def make_surface_figure(rows: Rows, options: Options) -> FigureContent:
    """Make a figure of the surface parts that are visible when predictions are wrong.

    It shows the images that the sweeps have written below each other.

    Args:
        rows: rows of the runs; their `attrs` have the summaries of the surfaces.
        options: options of the figure.

    Raises:
        InputError: if no sweep has `surface: true`.
    """
    surface_of_run = rows.attrs["surfaces"]
    _check_surfaces(surface_of_run)
    text = list[str]()
    table = list[list[Cell]]()
    for surface in surface_of_run.values():
        text += workbench.surface_sentences(surface)
        table += map(_make_surface_cells, surface.tables)
    folder = rows.attrs["folder"]
    return FigureContent(
        title="Which parts of the surface go with wrong predictions",
        text=text,
        columns=SURFACE_HEADS,
        rows=table,
        draw=lambda figure: _draw_surfaces(figure, folder, list(surface_of_run)),
        size=(6.4, 2.65 * len(surface_of_run)),
    )


def _check_surfaces(surface_of_run: Mapping[str, Any]) -> None:
    """Raise an error if no sweep has a summary of its object's surface."""
    if not surface_of_run:
        raise InputError(
            "figures: surface: expected a sweep with `surface: true` "
            "among its parts, got none"
        )


def _draw_surfaces(figure: Any, folder: Path, runs: Sequence[str]) -> None:
    """Draw the surface figures of runs of a recipe below each other.

    Args:
        figure: figure of matplotlib.
        folder: directory of the recipe's run.
        runs: names of the runs.
    """
    from matplotlib.image import imread  # matplotlib takes half a second

    all_axes = figure.subplots(len(runs), squeeze=False)[:, 0]
    for axes, run in zip(all_axes, runs, strict=True):
        directory = RunDirectory.locate_part(folder, run)
        axes.imshow(imread(directory / "images" / "surface.png"))
        axes.axis("off")
