"""Counts of a sweep, and its result as Python has it.

See docs/sweeps.md, "What it says". Counting takes about 15 bytes per configuration.
Sweeps that another program made are imported here, too.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pandas as pd

from advsearch.errors import FileFormatError
from advsearch.options import OUT_OF_VIEW, Outcome, get_outcome
from advsearch.pictures import MAX_FILE_BYTES, check_pixels, open_image
from advsearch.questions.sweep.display import draw_sweep, draw_sweep_on
from advsearch.questions.sweep.job import KIND
from advsearch.questions.sweep.page import write_sweep_page
from advsearch.questions.sweep.summary import (
    AxisRow,
    MapAxis,
    PairedRates,
    SweepMap,
    SweepSummary,
)
from advsearch.report.figures import new_axes
from advsearch.report.views import get_view, make_notebook_html
from advsearch.runs import store
from advsearch.runs.directory import RunDirectory, make_default_name
from advsearch.runs.export import read_threedb
from advsearch.runs.results import CountedPredictions
from advsearch.runs.tables import Units, read_sweep, to_pandas
from advsearch.statistics.clustered import (
    compare_paired,
    mean_rate,
    rate_interval,
    sum_per_unit,
)
from advsearch.statistics.intervals import clopper_pearson
from advsearch.tasks import Judgement
from advsearch.viewer import thumbnails

FINISHED = "finished"
MAX_CELLS = 4096  # maximum number of cells of a map; with more there is none
# maximum number of wrong predictions that the summary lists, the most frequent first
MAX_LISTED_PREDICTIONS = 20


OUTCOMES = tuple(Outcome)
UNKNOWN_OUTCOME = 255  # in arrays of indices in `OUTCOMES`


def count_predictions(
    right: npt.ArrayLike,
    units: npt.NDArray[np.int64],
    outcome: npt.NDArray[np.uint8] | None = None,
) -> CountedPredictions:
    """Count predictions, with their accuracy and its 95 % interval.

    The accuracy is the mean over units of the fraction of right predictions in each.
    Several predictions of a single unit have no interval.

    Args:
        right: (n,) whether each prediction is right.
        units: (n,) the independent unit of each prediction, such as the drive of a
            frame; predictions of one unit are not independent.
        outcome: (n,) kind of outcome, such as a missed box, as an index in `OUTCOMES`;
            the outcomes of wrong predictions are counted.
    """
    right = np.asarray(right)
    if not len(right):
        return count_independent_predictions(0, 0)
    right_in_unit = sum_per_unit(right, units)
    unit_size = sum_per_unit(np.ones(len(right)), units)
    interval = None
    # Several predictions of one unit do not show how much units differ. A single
    # prediction has an interval, the one of a single independent trial.
    if len(unit_size) > 1 or len(right) == 1:
        interval = rate_interval(right_in_unit, unit_size)
    is_wrong = right == 0
    return CountedPredictions(
        configurations=len(right),
        correct=int(right.sum()),
        accuracy=mean_rate(right_in_unit, unit_size),
        interval=interval,
        outcomes=None if outcome is None else _count_outcomes(outcome[is_wrong]),
    )


def _count_outcomes(outcome: npt.NDArray[np.uint8]) -> dict[str, int] | None:
    """Return how often each outcome occurs, by its name; None if all are unknown."""
    # An outcome is an index of `OUTCOMES`, or `UNKNOWN_OUTCOME`, which is larger.
    counts = np.bincount(outcome, minlength=len(OUTCOMES))[: len(OUTCOMES)]
    count_by_name = {
        known.value: int(count)
        for known, count in zip(OUTCOMES, counts, strict=True)
        if count
    }
    return count_by_name or None


def count_independent_predictions(
    correct: int, n_predictions: int, interval: tuple[float, float] | None = None
) -> CountedPredictions:
    """Return counts and accuracy of independent predictions, with a 95 % interval.

    Accuracy and interval are None without predictions.

    Args:
        correct: number of right predictions.
        n_predictions: number of predictions.
        interval: interval of the accuracy; None computes that of Clopper and Pearson.
    """
    if not n_predictions:
        return CountedPredictions(
            configurations=n_predictions, correct=correct, accuracy=None, interval=None
        )
    return CountedPredictions(
        configurations=n_predictions,
        correct=correct,
        accuracy=correct / n_predictions,
        interval=interval or clopper_pearson(correct, n_predictions),
    )


class Predictions:
    """The predictions so far, by the number of the row.

    Attributes:
        has_prediction: (n,) whether there is a prediction.
        is_right: (n,) whether it is right.
        is_out_of_view: (n,) whether nothing of the object is in the image.
        margin: (n,) margin of the prediction; NaN if it is not a number. Then the
            prediction counts neither as right nor as a wrong label.
        outcome: (n,) outcome of a detection, as an index in `OUTCOMES`.
    """

    def __init__(self, n_rows: int) -> None:
        """Make empty arrays for `n_rows` rows."""
        self.has_prediction: npt.NDArray[np.bool_] = np.zeros(n_rows, dtype=bool)
        self.is_right: npt.NDArray[np.bool_] = np.zeros(n_rows, dtype=bool)
        self.is_out_of_view: npt.NDArray[np.bool_] = np.zeros(n_rows, dtype=bool)
        # Not the inverse of `is_right`: a prediction whose margin is NaN is neither.
        self._wrong: npt.NDArray[np.bool_] = np.zeros(n_rows, dtype=bool)
        self.margin = np.full(n_rows, np.nan)
        self.outcome = np.full(n_rows, UNKNOWN_OUTCOME, np.uint8)
        # The label of each row, as its index in the order of `_index_by_label`: an
        # integer takes less memory than a string.
        self._label_index = np.zeros(n_rows, np.uint32)
        self._index_by_label = dict[str, int]()

    def add(self, row: int, judgement: Judgement) -> None:
        """Add the judgement of a row, or replace the one that was there before.

        Args:
            row: number of the row.
            judgement: what the task states about the prediction.
        """
        label = judgement.prediction.label
        self.has_prediction[row] = True
        self.is_right[row] = judgement.right
        # A wrong prediction is a success of an attack. If the prediction is not a
        # number, it is neither right nor a success.
        self._wrong[row] = judgement.success
        self.margin[row] = judgement.margin
        self.is_out_of_view[row] = label == OUT_OF_VIEW
        outcome = get_outcome(judgement.payload)
        if outcome is not None:  # only a detection has an outcome
            self.outcome[row] = OUTCOMES.index(outcome)
        n_labels = len(self._index_by_label)
        self._label_index[row] = self._index_by_label.setdefault(label, n_labels)

    @property
    def is_counted(self) -> npt.NDArray[np.bool_]:
        """(n,) whether there is a prediction, and the object is in the image."""
        return np.asarray(self.has_prediction & ~self.is_out_of_view)

    @property
    def n_phantoms_out_of_view(self) -> int:
        """Number of images without the object in which a detector still finds it."""
        is_phantom = self.outcome == OUTCOMES.index(Outcome.PHANTOM)
        return int((self.is_out_of_view & is_phantom).sum())

    @property
    def worst_row(self) -> int | None:
        """The first row with the smallest margin; None if no margin is a number.

        Rows without the object count only if there are no others.
        """
        margin = self.margin
        if not self.is_out_of_view[self.has_prediction].all():
            margin = np.where(self.is_out_of_view, np.nan, margin)
        return None if np.isnan(margin).all() else int(np.nanargmin(margin))

    @property
    def n_non_finite(self) -> int:
        """Number of margins that are not numbers; these predictions are not right."""
        return int((self.has_prediction & np.isnan(self.margin)).sum())

    @property
    def frequent_wrong_labels(self) -> dict[str, int]:
        """How often each of the most frequent wrong labels occurs, most frequent first.

        Labels of the same count are in alphabetical order.
        """
        labels = list(self._index_by_label)
        wrong_labels = Counter(
            labels[index] for index in self._label_index[self._wrong]
        )
        most_frequent = wrong_labels.most_common(MAX_LISTED_PREDICTIONS)
        # Items are (label, count): by descending count, then by label.
        return dict(sorted(most_frequent, key=lambda item: (-item[1], item[0])))

    def compare_arms(self, models: Sequence[str], units: Units) -> list[PairedRates]:
        """Compare the predictions about clean scenes and adversarial ones.

        The first half of the rows are those of the clean scenes; the second half
        repeats them with the adversarial ones. A pair is the same image in both arms. A
        pair counts only if the object is visible in both.

        Args:
            models: names of the models.
            units: maps images to independent units, such as draws.

        Returns:
            The comparison for each model that has pairs.
        """
        arm_shape = (2, -1, len(models))  # arms, images, models
        right = self.is_right.reshape(arm_shape)
        outcome = self.outcome.reshape(arm_shape)
        both_counted = np.asarray(self.is_counted.reshape(arm_shape).all(axis=0))
        pairs = list[PairedRates]()
        for model, name in enumerate(models):
            images = np.flatnonzero(both_counted[:, model])
            if len(images):
                draws = np.asarray(units.find_cluster(images))
                model_right = right[:, images, model]
                model_outcome = outcome[:, images, model]
                pairs.append(_compare_pairs(name, model_right, model_outcome, draws))
        return pairs


def _compare_pairs(
    model: str,
    right: npt.NDArray[np.bool_],
    outcome: npt.NDArray[np.uint8],
    draws: npt.NDArray[np.int64],
) -> PairedRates:
    """Compare the predictions of a model about clean and adversarial scenes.

    Args:
        model: name of the model.
        right: (2, n) whether each prediction is right, those about clean scenes first.
        outcome: (2, n) outcomes as indices in `OUTCOMES`.
        draws: (n,) the draw of each pair; draws are the independent units.
    """
    clean, adversarial = right
    clean_outcome, adversarial_outcome = outcome
    # The p-value, the third, is not part of the result.
    difference, interval, _ = compare_paired(clean, adversarial, draws)
    return PairedRates(
        model=model,
        clean=count_predictions(clean, draws, clean_outcome),
        adversarial=count_predictions(adversarial, draws, adversarial_outcome),
        both=int((clean & adversarial).sum()),
        clean_only=int((clean & ~adversarial).sum()),
        adversarial_only=int((~clean & adversarial).sum()),
        neither=int((~clean & ~adversarial).sum()),
        difference=difference,
        interval=interval,
    )


@dataclass(frozen=True, eq=False)
class TableAxis:
    """An axis by whose values tables count predictions.

    Attributes:
        name: name of the axis.
        unit: unit of measure of its values.
        values: the values, or the bounds of parts of a range.
        value_index: (n,) the index in `values` of the value of each row.
        kind: "outside" for an axis that is not in the scene (object, environment,
            model), "grid" for one of the grid, "drawn" for a sampled number.
    """

    name: str
    unit: str
    values: Sequence[Any]
    value_index: npt.NDArray[np.integer[Any]]
    kind: Literal["outside", "grid", "drawn"] = "outside"

    def make_rows(
        self,
        right: npt.NDArray[np.bool_],
        units: npt.NDArray[np.int64],
        outcome: npt.NDArray[np.uint8] | None = None,
    ) -> list[AxisRow]:
        """Return a row of counts for each value that has predictions.

        Args:
            right: (n,) whether each prediction is right.
            units: (n,) the independent unit of each prediction.
            outcome: (n,) outcomes as indices in `OUTCOMES`; None if unknown.
        """
        if outcome is None:
            outcome = np.full(len(right), UNKNOWN_OUTCOME, np.uint8)
        predictions = pd.DataFrame({"right": right, "unit": units, "outcome": outcome})
        axis_rows = list[AxisRow]()
        for index, group in predictions.groupby(self.value_index):
            outcomes = group.outcome.to_numpy()
            counts = count_predictions(group.right, group.unit, outcomes)
            value = self.values[index]
            axis_rows.append(
                AxisRow(axis=self.name, unit=self.unit, value=value, **vars(counts))
            )
        return axis_rows


def make_map(
    axes: Sequence[TableAxis],
    right: npt.NDArray[np.bool_],
    margin: npt.NDArray[np.float64],
) -> SweepMap | None:
    """Count predictions, and average margins, for every pair of values of two axes.

    The two axes are the first two in the order of `_order_for_map`.

    Args:
        axes: all axes of the tables.
        right: (n,) whether each prediction is right.
        margin: (n,) margin of each prediction; NaN if it is not a number.

    Returns:
        The map; None if there are fewer than two axes, or more than `MAX_CELLS` pairs.
    """
    axes = _order_for_map(axes)
    if len(axes) < 2:
        return None
    x_axis, y_axis = axes[:2]
    width = len(x_axis.values)
    height = len(y_axis.values)
    if width * height > MAX_CELLS:
        return None
    cell = y_axis.value_index * width + x_axis.value_index  # (n,) counted row by row
    shape = (height, width)
    return SweepMap(
        axes=(_describe_map_axis(x_axis), _describe_map_axis(y_axis)),
        over=[axis.name for axis in axes[2:]],
        configurations=_sum_over_cells(cell, shape).tolist(),
        correct=_sum_over_cells(cell[right], shape).tolist(),
        margin=_average_margins(cell, margin, shape),
    )


def _sum_over_cells(
    cell: npt.NDArray[np.integer[Any]],
    shape: tuple[int, int],
    weights: npt.NDArray[np.float64] | None = None,
) -> Any:
    """Return the sum of the weights in each cell of a map, (height, width).

    Args:
        cell: (n,) index of the cell of each prediction, counted row by row.
        shape: (height, width) of the map.
        weights: (n,) what is summed; None counts the predictions.
    """
    height, width = shape
    return np.bincount(cell, weights, minlength=width * height).reshape(height, width)


def _average_margins(
    cell: npt.NDArray[np.integer[Any]],
    margin: npt.NDArray[np.float64],
    shape: tuple[int, int],
) -> list[list[float | None]]:
    """Return the mean margin of each cell of a map; None if no margin is known.

    Args:
        cell: (n,) index of the cell of each prediction, counted row by row.
        margin: (n,) margin of each prediction; NaN if it is not a number.
        shape: (height, width) of the map.
    """
    is_known = ~np.isnan(margin)
    n_margins = _sum_over_cells(cell[is_known], shape)
    margin_sum = _sum_over_cells(cell[is_known], shape, margin[is_known])
    no_margins = np.full(n_margins.shape, np.nan)
    mean_margin = np.divide(margin_sum, n_margins, out=no_margins, where=n_margins > 0)
    return [
        [None if math.isnan(value) else value for value in row]
        for row in mean_margin.tolist()
    ]


def _order_for_map(axes: Sequence[TableAxis]) -> list[TableAxis]:
    """Return the axes in the order of preference for a map.

    Axes of the grid come first. Then come those outside of the scene in reverse order,
    since the model comes after the object and is preferred. Sampled numbers (kind
    "drawn") are returned only if there are none of these.
    """
    grid = [axis for axis in axes if axis.kind == "grid"]
    outside = [axis for axis in axes if axis.kind == "outside"]
    sampled = [axis for axis in axes if axis.kind == "drawn"]
    return [*grid, *reversed(outside)] or sampled


def _describe_map_axis(axis: TableAxis) -> MapAxis:
    return MapAxis(axis=axis.name, unit=axis.unit, values=list(axis.values))


@dataclass(frozen=True, eq=False, repr=False)
class SweepResult:
    """The result of a sweep.

    Attributes:
        summary: what `summary.json` contains.
        run: the run directory; None if the run was not stored.
        in_memory: the rows, if there is no run directory.
    """

    summary: SweepSummary
    run: Path | None
    in_memory: tuple[store.Row, ...] = ()

    @property
    def path(self) -> Path | None:
        """The same as `run`."""
        return self.run

    @property
    def accuracy(self) -> float | None:
        """Fraction of the configurations that the model got right; None without any."""
        return self.summary.accuracy

    def rows(self) -> Iterator[store.Row]:
        """Yield every configuration with its values and the prediction, in order."""
        if self.run is None:
            yield from self.in_memory
            return
        with store.Store(self.run / store.NAME, read_only=True) as results:
            yield from results.rows(KIND)

    def to_pandas(self) -> Any:
        """Return every configuration as a row of a `pandas.DataFrame`.

        Columns are those of an export (docs/runs.md) under plain names;
        `attrs["units"]` has the units.
        """
        return to_pandas(self.rows())

    def plot(self, axes: Any = None) -> Any:
        """Draw the map over two axes, or the accuracy along the only one, and return
        the matplotlib axes.

        Args:
            axes: axes to draw on; None makes new ones.
        """
        axes = new_axes() if axes is None else axes
        draw_sweep_on(self.summary, axes)
        return axes

    def __repr__(self) -> str:
        right = f"{self.summary.correct} of {self.summary.configurations} right"
        return (
            f"SweepResult({self.summary.object!r}, {self.summary.model!r}, {right}, "
            f"run={self.run and str(self.run)!r})"
        )

    def _repr_html_(self) -> str:
        return make_notebook_html(get_view(self.summary))

    def _repr_png_(self) -> bytes | None:
        return draw_sweep(self.summary).get("png")


MAX_PIXELS = 1 << 22  # maximum size of an imported image
MAX_LISTED_VALUES = 96  # maximum number of values of a parameter with a table
MAX_LISTED_NAMES = 20  # maximum number of names of objects or models in a summary
STORED_BATCH = 1000  # number of rows that are stored together


def import_threedb(
    folder: Path, run: str | Path | None = None, *, overwrite: bool = False
) -> Path:
    """Import a folder that 3DB wrote into a run directory, and return its path.

    Args:
        folder: folder of 3DB.
        run: run directory; by default ``runs/NAME-3db-NNN``.
        overwrite: whether an existing run is replaced.

    Raises:
        FileFormatError: the log of 3DB is empty or corrupt.
    """
    default = make_default_name(folder.resolve().name, ["3db"])
    with RunDirectory.create(run, overwrite=overwrite, default=default) as directory:
        _store_threedb_rows(folder, directory)
        rows = read_sweep(directory.path)
        _check_log_not_empty(rows, folder)
        summary = _summarize_threedb(rows, directory.path, folder)
        write_sweep_page(directory.path, summary)
        directory.write_summary(summary)
        return directory.path


def _check_log_not_empty(rows: pd.DataFrame, folder: Path) -> None:
    """Raise an error if a folder of 3DB has no rows."""
    if rows.empty:
        raise FileFormatError(
            f"{folder}: expected the log of 3DB with at least "
            "one line, got an empty one"
        )


def _store_threedb_rows(folder: Path, directory: RunDirectory) -> None:
    """Store the rows of a folder of 3DB, and thumbnails of its images.

    Args:
        folder: folder of 3DB.
        directory: run directory.
    """
    lines = read_threedb(folder)
    while batch := list(islice(lines, STORED_BATCH)):
        for row, image_file in batch:
            if image_file is not None:
                thumbnail = thumbnails.make_thumbnail(read_image(image_file))
                thumbnails.write_thumbnail(directory.path, row.step, thumbnail)
        directory.append_rows(*(row for row, _ in batch))


def _summarize_threedb(rows: pd.DataFrame, run: Path, folder: Path) -> SweepSummary:
    """Return the summary of a sweep that 3DB made.

    Fields that the log of 3DB does not contain are None, 0 or empty.

    Args:
        rows: rows of the sweep.
        run: the run directory.
        folder: folder of 3DB.
    """
    right = np.asarray(rows["correct"] == 1)
    names = {
        column: _join_names(rows, column)
        for column in ("object", "environment", "model")
    }
    # fields that the log of 3DB does not contain: None, or 0 if they must be numbers
    unknown = dict.fromkeys(
        ("image_formation", "cells", "worst", "sampler", "renders_per_second")
    )
    unknown_numbers = dict.fromkeys(("not_finite", "spp", "seed"), 0)
    wrong_labels = Counter(rows["label"][~right])
    return SweepSummary(
        run=str(run),
        **names,
        **vars(count_independent_predictions(int(right.sum()), len(rows))),
        **unknown,
        **unknown_numbers,
        task="classification",
        controls=[],
        ending=FINISHED,
        planned=len(rows),
        answers=dict(wrong_labels.most_common(MAX_LISTED_PREDICTIONS)),
        axes=_count_by_parameter(rows, right),
        grid={},
        samples=1,
        renders={"sweep": len(rows)},
        seconds={"total": 0.0},
        warnings=[f"Read from {folder}, as 3DB wrote it; it was not rendered here."],
        command_line=None,
    )


def _count_by_parameter(
    rows: pd.DataFrame, right: npt.NDArray[np.bool_]
) -> list[AxisRow]:
    """Return the rows of the tables of all parameters that vary.

    Args:
        rows: rows of the sweep.
        right: (n,) whether each prediction is right.
    """
    tables = list[AxisRow]()
    for name in rows.attrs["units"]:  # the keys are the parameters
        values, indices = np.unique(rows[name].astype(object), return_inverse=True)
        # A parameter with one value did not vary. A table of very many values would be
        # unreadable.
        if 1 < len(values) <= MAX_LISTED_VALUES:
            axis = TableAxis(name, "", values.tolist(), indices)
            tables += axis.make_rows(right, rows["unit"])
    return tables


def _join_names(rows: pd.DataFrame, column: str) -> str:
    """Return the first `MAX_LISTED_NAMES` names in a column; "unknown" without any."""
    names = rows[column].unique().tolist() if column in rows else []
    if not names:
        return "unknown"
    n_unlisted = len(names) - MAX_LISTED_NAMES
    more = f" and {n_unlisted} more" if n_unlisted > 0 else ""
    return ",".join(map(str, names[:MAX_LISTED_NAMES])) + more


def read_image(path: Path) -> object:
    """Read an image file as float32 (H, W, 3), sRGB in [0, 1]."""
    with open_image(path, MAX_FILE_BYTES) as image:
        check_pixels(path, *image.size, MAX_PIXELS)
        return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255.0)
