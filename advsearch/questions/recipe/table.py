"""The answers of a recipe's runs as one table, and what figures make of it: counts, sentences, a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field

from advsearch.attacks.trials import CONFIDENCE
from advsearch.attacks.units import per_unit, share_interval
from advsearch.errors import InputError
from advsearch.questions.attack.summary import AttackSummary
from advsearch.questions.recipe.answer import Cell
from advsearch.questions.sweep.summary import SurfaceMap, SweepSummary
from advsearch.report.figures import BLUE, GREY, RED
from advsearch.report.wording import figure_value, interval_text, percent
from advsearch.runs.results import Interval
from advsearch.runs.store import NAME, Store
from advsearch.runs.units import units_of

ANSWER, GROUP, PART, TRIAL, MODEL, WORKERS = "answer", "group", "part", "trial", "model", "workers"
"""Columns beside parameters: what the model said, the group that an object is in, the part of the recipe, which trial
of an attack it is, the model, and the number of processes that shared a sweep, of sweeps that say it."""

OTHERS = "other objects"

TRIALS = {
    "first control": "clean scene",
    "control": "clean scene",
    "verification": "answer",
    "baseline verification": "random search",
}
"""The rows of an attack that are in the table, and what figures call them."""

COLOURS = (BLUE, RED, "#1f7a45", "#b4540a", "#6b3fa0", GREY)
MARKS = "os^DvP"

COUNT = ["of", "share", "low", "high"]
"""Columns of a count behind the one of what is counted."""

Rows = Any  # pd.DataFrame, which has no types


def read_rows(
    part: str, folder: Path, summary: AttackSummary | SweepSummary, seed: int, kinds: Sequence[str]
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Return the answers of some kinds that a run has stored, and the units of their parameters.

    Each has what it shows (`object`, `environment`, `model`, and parameters), what was said of it (`answer`,
    `correct`, `margin`), the `time` when it was stored, seconds since 1970, and the `unit` of what it shares with rows
    that are not independent of it: draws of one seed are the same ones, also in another part.
    """
    outer = {"object": summary.object, "environment": summary.environment, MODEL: summary.model}
    rows, units = list[dict[str, Any]](), dict[str, str]()
    with Store(folder / NAME, read_only=True) as store:
        drawn = units_of(store) if isinstance(summary, SweepSummary) else None
        # without draws, samples of a point differ by noise alone
        alike = summary.samples if isinstance(summary, SweepSummary) and summary.sampler is None else 1
        for row in store.rows():
            if row.kind not in kinds:
                continue
            values = {name: one["value"] for name, one in row.values.items()}
            units |= {name: one["unit"] for name, one in row.values.items()}
            unit = f"{folder.name} {row.kind} {row.id}"
            if row.kind == "sweep" and drawn is not None:
                unit = f"{seed} {drawn.of(row.step) // alike}"
            if row.kind in TRIALS:
                values[TRIAL], unit = TRIALS[row.kind], f"{seed} {row.step}"
            values |= {name: figure_value(str(values.get(name, of_all))) for name, of_all in outer.items()}
            said = {ANSWER: row.label or "none", "correct": bool(row.correct), "margin": row.margin, "time": row.time}
            rows.append({**values, **said, PART: part, "unit": unit})
    return rows, units


@dataclass(frozen=True)
class Table:
    """All answers of a recipe.

    Attributes:
        rows: a frame of what `read_rows` returns, of sweeps, trials of attacks, and photographs.
        units: of parameters.
        surfaces: by the names of runs, which parts of the object go with wrong answers.
        cores: that this process may use.
        folder: of the recipe's run.
    """

    rows: Rows
    units: Mapping[str, str] = field(default_factory=dict)
    surfaces: Mapping[str, SurfaceMap] = field(default_factory=dict)
    cores: int = 1
    folder: Path = Path()

    @classmethod
    def of(cls, rows: Sequence[Mapping[str, Any]], groups: Mapping[str, Sequence[str]], **more: Any) -> Table:
        """Return a table of rows, with the groups of their objects if there are any: their names, each with those of
        the objects in it."""
        frame = pd.DataFrame(rows)
        if groups:
            named = {one: group for group, objects in reversed(list(groups.items())) for one in objects}
            frame[GROUP] = [named.get(one, OTHERS) for one in frame["object"]]
        return cls(frame, **more)

    def where(self, mask: Any) -> Table:
        """Return the table with some of its rows."""
        return replace(self, rows=self.rows[mask])

    def column(self, name: str) -> Any:
        """Return what each row has in a column; an InputError where some have nothing."""
        if name not in self.rows or self.rows[name].isna().any():
            own = self.rows.columns.drop(["correct", "margin", "time", "unit"])
            known = ", ".join(one for one in own if self.rows[one].notna().all())
            raise InputError(f"figures: expected one of {known}, got {name[:60]!r}")
        return self.rows[name]

    def numbers(self, name: str) -> Any:
        """Return what each row has in a column of numbers; an InputError where it has names."""
        values = self.column(name)
        if not pd.api.types.is_numeric_dtype(values):
            raise InputError(f"figures: {name}: expected a parameter with numbers, got names")
        return values

    def unit(self, name: str) -> str:
        """Return the unit of a column as it stands behind a number: a space and the unit, or nothing."""
        unit = self.units.get(name, "")
        return f" {unit}" if unit not in ("", "1", "name") else ""

    def by(self, name: str) -> dict[str, Rows]:
        """Return the rows by what they have in a column, in the order in which that first comes; numbers by size."""
        numbers = pd.api.types.is_numeric_dtype(self.column(name))
        return {figure_value(value): rows for value, rows in self.rows.groupby(name, sort=numbers)}


@dataclass(frozen=True, eq=False)
class Tally:
    """How many of some rows are counted: of each independent unit, such as a drive, `counted` (n,) of its `of` (n,)."""

    name: str
    counted: npt.NDArray[np.float64]
    of: npt.NDArray[np.float64]

    @classmethod
    def over(cls, name: str, rows: Rows, flags: Any = None) -> Tally:
        """Count rows: those with right answers, or those that flags (n,) say."""
        counted = np.asarray(rows["correct"] if flags is None else flags, dtype=np.float64)
        units = pd.factorize(rows["unit"])[0]
        return cls(name, per_unit(counted, units), per_unit(np.ones(len(rows)), units))

    def called(self, name: str) -> Tally:
        """Return it under another name."""
        return replace(self, name=name)

    @property
    def times(self) -> int:
        """How many are counted."""
        return round(float(self.counted.sum()))

    @property
    def total(self) -> int:
        """How many rows there are."""
        return round(float(self.of.sum()))

    @property
    def share(self) -> float | None:
        """What is counted of all rows; None where there are none."""
        return float(self.counted.sum() / self.of.sum()) if self.total else None

    @property
    def cells(self) -> list[Cell]:
        """What is counted, and the values of `COUNT`."""
        return [self.times, self.total, self.share, *(self.interval() or (None, None))]

    def interval(self, among: int = 1) -> Interval | None:
        """Return the 95 % interval of the share, widened for a choice among so many (Bonferroni)."""
        return share_interval(self.counted, self.of, 1.0 - (1.0 - CONFIDENCE) / max(among, 1)) if self.total else None

    def told(self, verb: str = "right") -> str:
        """Return ``right in 12 of 20 (60 %, 95 % interval 36-81 %)``; `verb` is what is counted."""
        share = f"{percent(self.share)}, 95 % interval {interval_text(self.interval())}"
        return f"{verb} in {self.times} of {self.total} ({share})"

    def below(self, other: Tally, among: int = 1) -> bool:
        """Return whether the interval of this share lies below that of another, both widened."""
        own, others = self.interval(among), other.interval(among)
        return own is not None and others is not None and own[1] < others[0]


def extremes(counts: Sequence[Tally], worst: str, best: str, thing: str, verb: str = "right") -> list[str]:
    """Return which of several has the lowest share and which the highest, and whether that is more than chance.

    The two were chosen among k for being extreme, so that they are compared by intervals of confidence 1 - 0.05 / k,
    which hold for all k together. Where these overlap, no difference is shown. They are called, say, "Hardest" and
    "easiest", several of them "environments", and `verb` is what is counted.
    """
    known = [one for one in counts if one.total]
    if len(known) < 2:
        return [f"{one.name}: {one.told(verb)}." for one in known]
    shares = [one.share or 0.0 for one in known]
    low, high = known[int(np.argmin(shares))], known[int(np.argmax(shares))]
    if min(shares) == max(shares):
        return [f"All {len(known)} {thing} have the same share, {percent(low.share)}: no difference is shown."]

    def named(one: Tally) -> str:
        ties = shares.count(one.share or 0.0) - 1
        return f"is {one.name}" + (f" (as {ties} other{'s' if ties > 1 else ''})" if ties else "")

    widened = f"the intervals of the two, widened for having been chosen among {len(known)},"
    return [
        f"{worst} {named(low)}: {low.told(verb)}; {best} {named(high)}: {high.told(verb)}.",
        f"The difference is shown: {widened} do not overlap."
        if low.below(high, len(known))
        else f"No difference between the {thing} is shown: {widened} overlap.",
    ]


def most_frequent(rows: Rows) -> list[tuple[str, int]]:
    """Return the answers with how often each was given, the most frequent first."""
    return sorted(Counter(rows[ANSWER]).items(), key=lambda one: (-one[1], one[0]))


def plural(column: str) -> str:
    """Return what several values of a column are called: ``environments``, ``materials``, ``values of pose.yaw``."""
    if column == TRIAL:
        return "kinds of trials"
    control, _, parameter = column.partition(".")
    return f"values of {column}" if parameter not in ("", "which") else f"{control}s"


def bare(name: str) -> str:
    """Return a parameter's name without its control: ``milk`` for ``contents.milk``."""
    return name.rpartition(".")[2]


class Options(BaseModel):
    """Options that every figure has: a title, made from the other options where it is empty, and the parts whose
    answers it shows; all where none is named."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str = Field(default="", max_length=200)
    of: tuple[str, ...] = ()

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts whose answers it is made from; none for all that were rendered."""
        return self.of


@dataclass(frozen=True)
class MadeFigure:
    """A figure: title, sentences, a table of its numbers, and what draws it, but for the title, on a figure of
    matplotlib of a size in inches."""

    title: str
    text: Sequence[str]
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    draw: Callable[[Any], None]
    size: tuple[float, float]


def draw_bars(axes: Any, cells: Mapping[str, Sequence[Tally]], series: Sequence[str]) -> None:
    """Draw a row for each of the cells, in which a dot with its interval is the count of each of the series."""
    for number, name in enumerate(series):
        colour, label = COLOURS[number % len(COLOURS)], name
        for row, counts in enumerate(cells.values()):
            place = row + (number - (len(series) - 1) / 2) * min(0.22, 0.8 / len(series))
            if interval := counts[number].interval():
                axes.plot(interval, [place] * 2, color=colour, alpha=0.45, linewidth=3)
                axes.plot(counts[number].share, place, MARKS[number % len(MARKS)], color=colour, ms=5, label=label)
                label = "_"
    axes.set_yticks(range(len(cells)), list(cells))
    axes.set(xlim=(-0.03, 1.03), ylim=(len(cells) - 0.4, -0.6))
    axes.grid(True, axis="x")
