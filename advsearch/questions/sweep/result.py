"""Counting what a sweep finds, its summary (docs/sweeps.md, "What it says"), and its
result as Python has it; sweeps that another program made are read into a run here, too.
Counting takes some 15 bytes a configuration.
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
from advsearch.pictures import LARGEST_FILE, check_pixels, opened
from advsearch.questions.sweep.display import sweep_axes, sweep_figure
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
from advsearch.report.views import result_html, shown
from advsearch.runs import store
from advsearch.runs.directory import RunDirectory, default_name
from advsearch.runs.export import read_threedb
from advsearch.runs.results import CountedPredictions
from advsearch.runs.tables import Units, read_sweep, to_pandas
from advsearch.statistics.clustered import (
    mean_share,
    paired_by_unit,
    per_unit,
    share_interval,
)
from advsearch.statistics.intervals import clopper_pearson
from advsearch.tasks import Judgement
from advsearch.viewer import thumbnails

FINISHED = "finished"
MOST_CELLS = 4096  # cells of a map; with more pairs of values there is none
# wrong predictions that the summary lists, the most frequent first
MOST_PREDICTIONS = 20


OUTCOMES = tuple(Outcome)
UNKNOWN_OUTCOME = 255  # in arrays of places among `OUTCOMES`


def counted_by_unit(
    right: npt.ArrayLike,
    units: npt.NDArray[np.int64],
    outcome: npt.NDArray[np.uint8] | None = None,
) -> CountedPredictions:
    """Count predictions (n,) that are of some units (n,), with their accuracy and its
    95 % interval.

    The accuracy is the mean over units of the share of each. One unit with several
    predictions has no interval. `outcome` (n,) has places among `OUTCOMES`, where there
    are some; those of wrong predictions are counted.
    """
    right = np.asarray(right)
    if not len(right):
        return rate(0, 0)
    right_in_unit = per_unit(right, units)
    unit_size = per_unit(np.ones(len(right)), units)
    has_interval = len(unit_size) > 1 or len(right) == 1
    return CountedPredictions(
        configurations=len(right),
        correct=int(right.sum()),
        accuracy=mean_share(right_in_unit, unit_size),
        interval=share_interval(right_in_unit, unit_size) if has_interval else None,
        outcomes=None if outcome is None else _count_outcomes(outcome[right == 0]),
    )


def _count_outcomes(outcome: npt.NDArray[np.uint8]) -> dict[str, int] | None:
    """Return how often each outcome occurs, by its name; None where none is known."""
    counts = np.bincount(outcome, minlength=len(OUTCOMES))
    named = {
        known.value: int(count)
        for known, count in zip(OUTCOMES, counts, strict=False)
        if count
    }
    return named or None


def rate(
    correct: int, seen: int, interval: tuple[float, float] | None = None
) -> CountedPredictions:
    """Return count, accuracy and its 95 % interval, by default that of Clopper and
    Pearson, of predictions that are independent; None where nothing was seen.
    """
    accuracy, interval = (
        (correct / seen, interval or clopper_pearson(correct, seen))
        if seen
        else (None, None)
    )
    return CountedPredictions(
        configurations=seen, correct=correct, accuracy=accuracy, interval=interval
    )


class Predictions:
    """What is predicted so far, by the number of the configuration (n,): whether there
    is a prediction, whether it is right and whether it is wrong, its margin, NaN where
    that is no number, and what it is; of a detector its outcome, as a place among
    `OUTCOMES`. `hidden` are those with nothing of what is judged in the picture.
    """

    def __init__(self, total: int) -> None:
        self.seen: npt.NDArray[np.bool_] = np.zeros(total, dtype=bool)
        self.right, self._wrong, self.hidden = (
            self.seen.copy(),
            self.seen.copy(),
            self.seen.copy(),
        )
        self.margin = np.full(total, np.nan)
        self.outcome = np.full(total, UNKNOWN_OUTCOME, np.uint8)
        self._labels, self._names = np.zeros(total, np.uint32), dict[str, int]()

    def add(self, number: int, said: Judgement) -> None:
        self.seen[number], self.right[number], self._wrong[number] = (
            True,
            said.right,
            said.success,
        )
        self.margin[number] = said.margin
        self.hidden[number] = said.prediction.label == OUT_OF_VIEW
        outcome = get_outcome(said.payload)
        if outcome is not None:
            self.outcome[number] = OUTCOMES.index(outcome)
        self._labels[number] = self._names.setdefault(
            said.prediction.label, len(self._names)
        )

    @property
    def counted(self) -> npt.NDArray[np.bool_]:
        """(n,) which there is a prediction of and something to see in."""
        return np.asarray(self.seen & ~self.hidden)

    @property
    def phantoms_out_of_view(self) -> int:
        """In how many pictures without the object a detector finds it all the same."""
        return int(
            (self.hidden & (self.outcome == OUTCOMES.index(Outcome.PHANTOM))).sum()
        )

    @property
    def worst(self) -> int | None:
        """The first configuration of the smallest margin; None where none is a
        number.
        """
        margin = (
            self.margin
            if self.hidden[self.seen].all()
            else np.where(self.hidden, np.nan, self.margin)
        )
        return None if np.isnan(margin).all() else int(np.nanargmin(margin))

    @property
    def not_finite(self) -> int:
        """How many margins are no number; these predictions count as not right."""
        return int((self.seen & np.isnan(self.margin)).sum())

    @property
    def frequent(self) -> dict[str, int]:
        """How often each of the most frequent wrong predictions was given, the most
        frequent first.
        """
        names = list(self._names)
        wrong = Counter(names[label] for label in self._labels[self._wrong])
        return dict(
            sorted(
                wrong.most_common(MOST_PREDICTIONS),
                key=lambda label: (-label[1], label[0]),
            )
        )

    def beside(self, models: Sequence[str], units: Units) -> list[PairedRates]:
        """Return both rates of each model without and with an adversarial scene, of the
        pairs of which both are known: the second half of the configurations are the
        first with the adversarial scene.
        """
        halves = (2, -1, len(models))
        pairs = list[PairedRates]()
        seen: npt.NDArray[np.bool_] = np.logical_and(*self.counted.reshape(halves))
        for model, name in enumerate(models):
            known = np.flatnonzero(seen[:, model])
            if not len(known):
                continue
            before, after = self.right.reshape(halves)[:, known, model]
            outcome_before, outcome_after = self.outcome.reshape(halves)[
                :, known, model
            ]
            draws = units.draw(known)
            difference, interval, _ = paired_by_unit(before, after, draws)
            pairs.append(
                PairedRates(
                    model=name,
                    clean=counted_by_unit(before, draws, outcome_before),
                    answer=counted_by_unit(after, draws, outcome_after),
                    both=int((before & after).sum()),
                    clean_only=int((before & ~after).sum()),
                    answer_only=int((~before & after).sum()),
                    neither=int((~before & ~after).sum()),
                    difference=difference,
                    interval=interval,
                )
            )
        return pairs


@dataclass(frozen=True, eq=False)
class SweptAxis:
    """Something that a table is by: an axis outside the scene (object, environment,
    model), of the grid, or a number that is drawn; its values, or the ends of its
    parts; and the place of each configuration among them (n,).
    """

    name: str
    unit: str
    values: Sequence[Any]
    places: npt.NDArray[np.integer[Any]]
    kind: Literal["outside", "grid", "drawn"] = "outside"

    def rows(
        self,
        right: npt.NDArray[np.bool_],
        units: npt.NDArray[np.int64],
        outcome: npt.NDArray[np.uint8] | None = None,
    ) -> list[AxisRow]:
        """Return the table: right predictions (n,), which are of units (n,) and have an
        outcome (n,), by value; values without any are left out.
        """
        outcome = (
            np.full(len(right), UNKNOWN_OUTCOME, np.uint8)
            if outcome is None
            else outcome
        )
        by_place = pd.DataFrame(
            {"right": right, "unit": units, "outcome": outcome}
        ).groupby(self.places)
        counts = (
            (
                self.values[place],
                counted_by_unit(rows.right, rows.unit, rows.outcome.to_numpy()),
            )
            for place, rows in by_place
        )
        return [
            AxisRow(axis=self.name, unit=self.unit, value=value, **vars(count))
            for value, count in counts
        ]


def map_over(
    axes: Sequence[SweptAxis],
    right: npt.NDArray[np.bool_],
    margin: npt.NDArray[np.float64],
) -> SweepMap | None:
    """Return counts, and the mean of the margins, for every pair of values of two axes:
    the first of the grid and the last outside, or drawn ones where there are none of
    these; None of fewer axes, or of too many values.
    """
    outside, grid, drawn = (
        [one for one in axes if one.kind == kind]
        for kind in ("outside", "grid", "drawn")
    )
    axes = [*grid, *reversed(outside)] or drawn
    if len(axes) < 2 or len(axes[0].values) * len(axes[1].values) > MOST_CELLS:
        return None
    wide, high = (len(one.values) for one in axes[:2])
    cell = axes[1].places * wide + axes[0].places
    told = ~np.isnan(margin)

    def table(
        cells: npt.NDArray[np.integer[Any]],
        weights: npt.NDArray[np.float64] | None = None,
    ) -> Any:
        return np.bincount(cells, weights, minlength=wide * high).reshape(high, wide)

    count = table(cell[told])
    total = table(cell[told], margin[told])
    mean = np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0)
    first, second = (
        MapAxis(axis=one.name, unit=one.unit, values=list(one.values))
        for one in axes[:2]
    )
    return SweepMap(
        axes=(first, second),
        over=[one.name for one in axes[2:]],
        configurations=table(cell).tolist(),
        correct=table(cell[right]).tolist(),
        margin=[
            [None if math.isnan(one) else one for one in row] for row in mean.tolist()
        ],
    )


@dataclass(frozen=True, eq=False, repr=False)
class SweepResult:
    """The result of a sweep.

    Attributes:
        summary: what `summary.json` holds.
        run: the run directory, or None if it was not kept.
        in_memory: the rows, where there is no run directory.
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
        """Share of the configurations that the model got right; None where there was
        none.
        """
        return self.summary.accuracy

    def rows(self) -> Iterator[store.Row]:
        """Yield every configuration with its values and what the model said, in
        order.
        """
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
            axes: to draw on; None makes new ones.
        """
        axes = new_axes() if axes is None else axes
        sweep_axes(self.summary, axes)
        return axes

    def __repr__(self) -> str:
        right = f"{self.summary.correct} of {self.summary.configurations} right"
        return (
            f"SweepResult({self.summary.object!r}, {self.summary.model!r}, {right}, "
            f"run={self.run and str(self.run)!r})"
        )

    def _repr_html_(self) -> str:
        return result_html(shown(self.summary))

    def _repr_png_(self) -> bytes | None:
        return sweep_figure(self.summary).get("png")


MOST_PIXELS = 1 << 22  # of a picture that is read
MOST_VALUES = 96  # different values of a parameter that the result lists
AT_ONCE = 1000  # rows that are stored at once


def import_threedb(
    folder: Path, run: str | Path | None = None, *, overwrite: bool = False
) -> Path:
    """Read a folder that 3DB wrote into a run, by default ``runs/NAME-3db-NNN``, and
    return its folder.
    """
    with RunDirectory.create(
        run, overwrite=overwrite, default=default_name(folder.resolve().name, ["3db"])
    ) as kept:
        lines = read_threedb(folder)
        while some := list(islice(lines, AT_ONCE)):
            for row, picture in some:
                if picture is not None:
                    thumbnails.keep(
                        kept.path, row.step, thumbnails.thumbnail(read_picture(picture))
                    )
            kept.record(*(row for row, _ in some))
        rows = read_sweep(kept.path)
        if rows.empty:
            raise FileFormatError(
                f"{folder}: expected the log of 3DB with at least "
                "one line, got an empty one"
            )
        summary = _summary_of(rows, kept.path, folder)
        write_sweep_page(kept.path, summary)
        kept.write_summary(summary)
        return kept.path


def _summary_of(rows: pd.DataFrame, run: Path, folder: Path) -> SweepSummary:
    right = np.asarray(rows["correct"] == 1)
    tables = list[AxisRow]()
    for name in rows.attrs["units"]:
        values, places = np.unique(rows[name].astype(object), return_inverse=True)
        if 1 < len(values) <= MOST_VALUES:
            tables += SweptAxis(name, "", values.tolist(), places).rows(
                right, rows["unit"]
            )
    called = dict.fromkeys(("object", "environment", "model"), "unknown")
    for name in called:
        names = rows[name].unique().tolist() if name in rows else []
        more = f" and {len(names) - 20} more" if len(names) > 20 else ""
        called[name] = ",".join(map(str, names[:20])) + more or "unknown"
    not_told = dict.fromkeys(
        ("image_formation", "cells", "worst", "sampler", "renders_per_second")
    )
    return SweepSummary(
        run=str(run),
        **called,
        **vars(rate(int(right.sum()), len(rows))),
        **not_told,
        **dict.fromkeys(("not_finite", "spp", "seed"), 0),
        task="classification",
        controls=[],
        ending=FINISHED,
        planned=len(rows),
        answers=dict(Counter(rows["label"][~right]).most_common(MOST_PREDICTIONS)),
        axes=tables,
        grid={},
        samples=1,
        renders={"sweep": len(rows)},
        seconds={"total": 0.0},
        warnings=[f"Read from {folder}, as 3DB wrote it; it was not rendered here."],
        command_line=None,
    )


def read_picture(path: Path) -> object:
    with opened(path, LARGEST_FILE) as image:
        check_pixels(path, *image.size, MOST_PIXELS)
        return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255.0)
