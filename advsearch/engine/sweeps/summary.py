"""Counting what a sweep finds, its summary (docs/sweeps.md, "What it says"), and its answer as Python has it; sweeps
that another program made are read into a run here, too. The memory that counting takes hardly grows."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from advsearch.attacks import clopper_pearson
from advsearch.attacks.units import paired_by_unit, per_unit, share_interval
from advsearch.engine.sweeps import KIND
from advsearch.engine.sweeps.axes import Axis
from advsearch.engine.sweeps.points import Drawn, Picks
from advsearch.errors import FileFormatError
from advsearch.pictures import FORMATS
from advsearch.report.figures import new_axes, sweep_axes, sweep_figure
from advsearch.report.markup import answer_html
from advsearch.report.shown import shown
from advsearch.runs import store
from advsearch.runs.directory import RunDirectory, default_name
from advsearch.runs.export import read_threedb
from advsearch.runs.results.sweep import AxisRow, CountedAnswers, MapAxis, PairedRates, SweepMap, SweepSummary
from advsearch.runs.store import Row
from advsearch.runs.units import Units
from advsearch.tasks import Judgement
from advsearch.viewer import thumbnails
from advsearch.viewer.sweep_page import write_sweep_page

FINISHED, INTERRUPTED = "finished", "interrupted"

WRONG, RIGHT = 1, 2
"""Of a configuration of a pair; 0: not seen yet."""

MOST_CELLS = 4096
"""Cells of a map; with more pairs of values there is none."""

MOST_ANSWERS = 20
"""Wrong answers that the summary lists, the most frequent first."""


@dataclass
class Count:
    """Right answers among configurations, for every value of one axis: a number, a name, or a pair of ends. Of a unit
    of sampling (`runs.units`) a value has so many answers, more than one where they are not independent."""

    name: str
    unit: str
    values: Sequence[Any]
    of_a_unit: int = 1
    counts: list[UnitCount] = field(init=False)

    def __post_init__(self) -> None:
        self.counts = [UnitCount(self.of_a_unit) for _ in self.values]

    def add(self, place: int, unit: int, right: bool) -> None:
        self.counts[place].add(unit, right)

    def rows(self) -> list[AxisRow]:
        """Return the table of this axis; values without configurations so far are left out."""
        return [
            AxisRow(axis=self.name, unit=self.unit, value=value, **vars(one.rate()))
            for value, one in zip(self.values, self.counts, strict=True)
            if one.seen
        ]


@dataclass(slots=True)
class UnitCount:
    """Right answers among configurations, of units of so many answers each: by how many of a unit are right, which is
    all that an interval takes, so that few units are open at a time."""

    of_a_unit: int = 1
    seen: int = 0
    correct: int = 0
    _open: dict[int, tuple[int, int]] | None = None
    _whole: Counter[int] | None = None

    def add(self, unit: int, right: bool) -> None:
        self.seen += 1
        self.correct += right
        if self.of_a_unit == 1:
            return
        if self._open is None or self._whole is None:
            self._open, self._whole = {}, Counter()
        seen, correct = self._open.pop(unit, (0, 0))
        if seen + 1 == self.of_a_unit:
            self._whole[correct + right] += 1
        else:
            self._open[unit] = seen + 1, correct + right

    @property
    def units(self) -> int | None:
        """How many were seen; None where each is one answer."""
        return None if self._open is None or self._whole is None else self._whole.total() + len(self._open)

    def rate(self) -> CountedAnswers:
        """Return count, accuracy and its interval over units; None where nothing was seen."""
        if self.of_a_unit == 1 or not self.seen or self._open is None or self._whole is None:
            return rate(self.correct, self.seen)
        units = [(right, self.of_a_unit) for right in self._whole.elements()]
        units += [(right, seen) for seen, right in self._open.values()]
        right, of = np.array(units).T
        return counted(right, of)


def counted(right: npt.ArrayLike, of: npt.ArrayLike) -> CountedAnswers:
    """Return count, accuracy and its 95 % interval, from right answers and answers of each unit (n,)."""
    correct, seen = int(np.sum(right)), int(np.sum(of))
    interval = share_interval(right, of) if seen else None
    return CountedAnswers(
        configurations=seen, correct=correct, accuracy=correct / seen if seen else None, interval=interval
    )


def rate(correct: int, seen: int) -> CountedAnswers:
    """Return count, accuracy and its 95 % Clopper-Pearson interval, of answers that are independent; None where nothing
    was seen."""
    return CountedAnswers(
        configurations=seen,
        correct=correct,
        accuracy=correct / seen if seen else None,
        interval=clopper_pearson(correct, seen) if seen else None,
    )


class Cells:
    """Counts for every pair of values of the first two of several axes (name, unit, values), and the sum of the margins
    there."""

    def __init__(self, axes: Sequence[tuple[str, str, Sequence[Any]]]) -> None:
        self._axes = list(axes[:2])
        self.rest = [name for name, _, _ in axes[2:]]
        self.shown = len(axes) > 1 and len(axes[0][2]) * len(axes[1][2]) <= MOST_CELLS
        wide, high = (len(values) for _, _, values in self._axes) if self.shown else (0, 0)
        self._counts = np.zeros((3, high, wide), np.int64)  # seen, right, with a margin that is a number
        self._margin = np.zeros((high, wide))

    def add(self, places: Sequence[int], trial: Judgement) -> None:
        if self.shown:
            column, row, told = places[0], places[1], trial.margin == trial.margin
            self._counts[:, row, column] += (1, trial.right, told)
            if told:
                self._margin[row, column] += trial.margin

    def drawn(self) -> SweepMap | None:
        if not self.shown:
            return None
        seen, right, told = self._counts.tolist()
        first, second = (MapAxis(axis=name, unit=unit, values=list(values)) for name, unit, values in self._axes)
        return SweepMap(
            axes=(first, second),
            over=self.rest,
            configurations=seen,
            correct=right,
            margin=[
                [total / count if count else None for total, count in zip(*rows, strict=True)]
                for rows in zip(self._margin.tolist(), told, strict=True)
            ],
        )


class Tally:
    """What has been counted so far, by the axes outside the scene (object, environment, model), those of the grid, and
    what is drawn. Each of so many pairs without an answer comes again with it, so many numbers later. The first
    configuration of the largest margin is the worst; a margin that is no number counts as not right."""

    def __init__(
        self,
        outer: Sequence[tuple[str, Sequence[str]]],
        axes: Sequence[Axis],
        drawn: Sequence[Drawn],
        pairs: int = 0,
        units: Units | None = None,
    ) -> None:
        self._verdicts = [bytearray(pairs), bytearray(pairs)]
        self._units = Units() if units is None else units
        self.not_finite = 0
        self.whole = UnitCount(self._units.size)
        self.worst: tuple[int, Judgement] | None = None
        self.answers: Counter[str] = Counter()
        inside = {"model": self._units.models, "answer": 2 if self._units.again else 1}  # of each value a unit has some
        size = self._units.size
        self._outer = [
            Count(name, "", list(dict.fromkeys(values)), size // inside.get(name, 1)) for name, values in outer
        ]
        self._grid = [
            Count(axis.name, axis.unit, axis.values, size // (len(axis.values) if place == self._units.frames else 1))
            for place, axis in enumerate(axes)
        ]
        self._drawn = [Count(one.name, one.unit, one.parts, size) for one in drawn]
        every = [*self._grid, *reversed(self._outer), *self._drawn]
        several = [number for number, count in enumerate(every) if len(count.values) > 1]
        listed = [number for number in several if number < len(every) - len(self._drawn)]
        self._mapped = listed or several
        self._cells = Cells([(every[n].name, every[n].unit, every[n].values) for n in self._mapped])

    def add(self, index: int, outer: Sequence[int], picks: Picks, place: int, trial: Judgement) -> None:
        """Count the configuration with a number: by its places on the outer axes, and its place among the pictures it
        belongs to."""
        right, unit = trial.right, self._units.of(index)
        if pairs := len(self._verdicts[0]):
            self._verdicts[index // pairs][index % pairs] = RIGHT if right else WRONG
        self.whole.add(unit, right)
        for count, digit in zip(self._outer, outer, strict=True):
            count.add(digit, unit, right)
        for count, digit in zip(self._grid, picks.digits[place], strict=True):
            count.add(digit, unit, right)
        for count, part in zip(self._drawn, picks.parts[place], strict=True):
            count.add(part, unit, right)
        places = (*picks.digits[place], *reversed(outer), *picks.parts[place])
        self._cells.add([places[number] for number in self._mapped], trial)
        if trial.success:
            self.answers[trial.answer.label] += 1
        if trial.margin != trial.margin:
            self.not_finite += 1
        elif self.worst is None or trial.margin > self.worst[1].margin:
            self.worst = index, trial

    @property
    def seen(self) -> int:
        return self.whole.seen

    @property
    def correct(self) -> int:
        return self.whole.correct

    def beside(self, models: Sequence[str]) -> list[PairedRates]:
        """Return both rates of each model, of the pairs of which both are known."""
        clean, answer = (np.frombuffer(one, np.uint8).reshape(-1, len(models)) for one in self._verdicts)
        found = []
        for number, name in enumerate(models):
            known = (clean[:, number] > 0) & (answer[:, number] > 0)
            before, after = clean[known, number] == RIGHT, answer[known, number] == RIGHT
            if not len(before):
                continue
            counts = [int(one.sum()) for one in (before & after, before & ~after, ~before & after, ~before & ~after)]
            both, clean_only, answer_only, neither = counts
            units = self._units.draw(np.flatnonzero(known))
            difference, interval, _ = paired_by_unit(before, after, units)
            of = per_unit(np.ones(len(units)), units)
            found.append(
                PairedRates(
                    model=name,
                    clean=counted(per_unit(before, units), of),
                    answer=counted(per_unit(after, units), of),
                    both=both,
                    clean_only=clean_only,
                    answer_only=answer_only,
                    neither=neither,
                    difference=difference,
                    interval=interval,
                )
            )
        return found

    def table(self) -> list[AxisRow]:
        counts = [*self._outer, *self._grid, *self._drawn]
        return [row for count in counts if len(count.values) > 1 for row in count.rows()]

    def frequent(self) -> dict[str, int]:
        """Return how often each of the most frequent wrong answers was given, the most frequent first."""
        return dict(sorted(self.answers.most_common(MOST_ANSWERS), key=lambda one: (-one[1], one[0])))

    def map(self) -> SweepMap | None:
        """Return what was counted over two axes, where there are as many."""
        return self._cells.drawn()


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
        """
        from advsearch.runs.tables import to_pandas  # pandas takes half a second

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


MOST_PIXELS = 1 << 22
"""Of a picture that is read."""

MOST_VALUES = 96
"""Different values of a parameter that the result lists."""

AT_ONCE = 1000
"""Rows that are stored at once."""


def import_threedb(folder: Path, run: str | Path | None = None, *, overwrite: bool = False) -> Path:
    """Read a folder that 3DB wrote into a run, by default ``runs/NAME-3db-NNN``, and return its folder."""
    counts = _Counts()
    with RunDirectory.create(run, overwrite=overwrite, default=default_name(folder.resolve().name, ["3db"])) as kept:
        rows: list[Row] = []
        for one in read_threedb(folder):
            if one.picture is not None:
                thumbnails.keep(kept.path, one.row.step, thumbnails.thumbnail(read_picture(one.picture)))
            counts.add(one.row)
            rows.append(one.row)
            if len(rows) == AT_ONCE:
                kept.record(*rows)
                rows.clear()
        kept.record(*rows)
        if not counts.seen:
            raise FileFormatError(f"{folder}: expected the log of 3DB with at least one line, got an empty one")
        summary = counts.summary(kept.path, folder)
        kept.write_summary(summary)
        write_sweep_page(kept.path, summary)
        return kept.path


class _Counts:
    """What the rows come to."""

    def __init__(self) -> None:
        self.seen = self.correct = 0
        self._names: dict[str, dict[str, None]] = {name: {} for name in ("object", "environment", "model")}
        self._values: dict[str, dict[float | str, tuple[int, int]] | None] = {}
        self._wrong: dict[str, int] = {}

    def add(self, row: Row) -> None:
        right = bool(row.correct)
        self.seen += 1
        self.correct += right
        if not right:
            self._wrong[row.label or ""] = self._wrong.get(row.label or "", 0) + 1
        for name, value in row.values.items():
            if name in self._names:
                self._names[name][str(value["value"])] = None
            table = self._values.setdefault(name, {})
            if table is None:
                continue
            seen, correct = table.get(value["value"], (0, 0))
            table[value["value"]] = (seen + 1, correct + right)
            if len(table) > MOST_VALUES:
                self._values[name] = None

    def summary(self, run: Path, folder: Path) -> SweepSummary:
        tables = []
        for name, table in self._values.items():
            if table is None or len(table) < 2:
                continue
            for value in sorted(table, key=lambda value: (isinstance(value, str), value)):
                seen, correct = table[value]
                tables.append(AxisRow(axis=name, unit="", value=value, **vars(rate(correct, seen))))
        called = {name: _listed(list(values)) for name, values in self._names.items()}
        most = sorted(self._wrong.items(), key=lambda pair: -pair[1])[:20]
        return SweepSummary(
            run=str(run),
            object=called["object"],
            model=called["model"],
            task="classification",
            environment=called["environment"],
            controls=[],
            ending=FINISHED,
            image_formation=None,
            planned=self.seen,
            **vars(rate(self.correct, self.seen)),
            not_finite=0,
            answers=dict(most),
            axes=tables,
            cells=None,
            worst=None,
            grid={},
            samples=1,
            sampler=None,
            spp=0,
            renders={"sweep": self.seen},
            renders_per_second=None,
            seconds={"total": 0.0},
            seed=0,
            warnings=[f"Read from {folder}, as 3DB wrote it; it was not rendered here."],
            command_line="",
        )


def _listed(names: Sequence[str]) -> str:
    return ",".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "") or "unknown"


def read_picture(path: Path) -> object:
    """Return the picture (H, W, 3) in [0, 1] in a file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            opened = Image.open(path, formats=FORMATS)
        with opened as image:
            if image.width * image.height > MOST_PIXELS:
                raise FileFormatError(
                    f"{path}: expected at most {MOST_PIXELS} pixels, got {image.width} x {image.height}"
                )
            return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255.0)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise FileFormatError(f"{path}: expected a picture, got {str(error)[:100]}") from None
