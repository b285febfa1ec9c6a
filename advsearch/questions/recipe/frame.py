"""The rows of a recipe's runs as one frame, and what all figures make of it: counts, sentences, a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field

from advsearch.attacks.trials import CONFIDENCE
from advsearch.attacks.units import per_unit, share_interval
from advsearch.described import OUT_OF_VIEW
from advsearch.errors import InputError
from advsearch.questions.attack.summary import AttackSummary
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.report.wording import figure_value, interval_text, percent
from advsearch.runs.results import Interval
from advsearch.runs.store import NAME, Store
from advsearch.runs.units import units_of

PREDICTION, GROUP, PART, TRIAL, MODEL, WORKERS = "answer", "group", "part", "trial", "model", "workers"
"""Columns beside parameters: what the model said, the group that an object is in, the part of the recipe, which trial
of an attack it is, the model, and the number of processes that shared a sweep, of sweeps that say it."""

OTHERS = "other objects"

TRIALS = {"first control": "clean scene", "control": "clean scene", "verification": "answer",
          "baseline verification": "random search"}  # fmt: skip
"""The rows of an attack that are in the frame, and what figures call them."""

COUNT = ["of", "share", "low", "high"]  # columns of a count behind the one of what is counted
Cell = str | int | float | None
Numbers = npt.NDArray[np.float64]
Rows = Any  # pd.DataFrame, which has no types


def read_rows(
    part: str, folder: Path, summary: AttackSummary | SweepSummary, seed: int, kinds: Sequence[str], **more: Cell
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Return the rows of some kinds that a run has stored, and the units of their parameters. Each has what it shows
    (`object`, `environment`, `model`, and parameters), what was said of it (`answer`, `correct`, `margin`), the `time`
    when it was stored, seconds since 1970, and the `unit` of what it shares with rows that are not independent of it:
    draws of one seed are the same ones, also in another part."""
    rows, units, drawn, alike = list[dict[str, Any]](), dict[str, str](), None, 1
    with Store(folder / NAME, read_only=True) as store:
        if isinstance(summary, SweepSummary):
            # without draws, samples of a point differ by noise alone
            drawn, alike = units_of(store), 1 if summary.sampler is not None else summary.samples
        for row in store.rows():
            if row.kind not in kinds or (row.kind == "sweep" and row.label == OUT_OF_VIEW):
                continue
            values: dict[str, Any] = {name: about["value"] for name, about in row.values.items()}
            units |= {name: about["unit"] for name, about in row.values.items()}
            unit = f"{folder.name} {row.kind} {row.id}"
            if row.kind == "sweep" and drawn is not None:
                unit = f"{seed} {drawn.of(row.step) // alike}"
            if isinstance(summary, AttackSummary):
                values[TRIAL], unit = TRIALS[row.kind], f"{seed} {row.step}"
            for name in ("object", "environment", MODEL):
                values[name] = figure_value(str(values.get(name, getattr(summary, name))))
            values |= {PREDICTION: row.label or "none", "correct": bool(row.correct), "margin": row.margin}
            rows.append({**values, "time": row.time, PART: part, "unit": unit, **more})
    return rows, units


def frame_of(rows: Iterable[Mapping[str, Any]], groups: Mapping[str, Sequence[str]], **facts: Any) -> Rows:
    """Return rows as a frame, with the groups that name their objects if there are any; its ``attrs`` are the facts."""
    frame = pd.DataFrame(rows)
    if groups:
        named = {name: group for group, objects in reversed(list(groups.items())) for name in objects}
        frame[GROUP] = [named.get(name, OTHERS) for name in frame["object"]]
    frame.attrs = facts
    return frame


def column(rows: Rows, name: str) -> Any:
    """Return what each row has in a column; an InputError where some have nothing."""
    if name not in rows or rows[name].isna().any():
        named = rows.columns.drop(["correct", "margin", "time", "unit"])
        known = ", ".join(other for other in named if rows[other].notna().all())
        raise InputError(f"figures: expected one of {known}, got {name[:60]!r}")
    return rows[name]


def numbers(rows: Rows, name: str) -> Any:
    """Return what each row has in a column of numbers; an InputError where it has names."""
    if not pd.api.types.is_numeric_dtype(column(rows, name)):
        raise InputError(f"figures: {name}: expected a parameter with numbers, got names")
    return rows[name]


def unit_of(rows: Rows, name: str) -> str:
    """Return the unit of a column as it stands behind a number: a space and the unit, or nothing."""
    return "" if (unit := rows.attrs["units"].get(name, "")) in ("", "1", "name") else f" {unit}"


def by(rows: Rows, name: str) -> dict[str, Rows]:
    """Return the rows by what they have in a column, in the order in which that first comes; numbers by size."""
    size = pd.api.types.is_numeric_dtype(column(rows, name))
    return {figure_value(value): some for value, some in rows.groupby(name, sort=size)}


def most_frequent(predictions: Iterable[str]) -> list[tuple[str, int]]:
    """Return predictions with how often each was given, the most frequent first."""
    return sorted(Counter(predictions).items(), key=lambda item: (-item[1], item[0]))


class Tally:
    """How many of some rows are counted: of each independent unit, such as a drive, `counted` (n,) of its `of` (n,);
    in all `times` of `total`, and their share, None where there are no rows."""

    def __init__(self, name: str, counted: Numbers, of: Numbers) -> None:
        self.name, self.counted, self.of = name, counted, of
        self.times, self.total = round(float(counted.sum())), round(float(of.sum()))
        self.share = float(counted.sum() / of.sum()) if self.total else None

    @classmethod
    def over(cls, name: str, rows: Rows, flags: Any = None) -> Tally:
        """Count rows: those with right predictions, or those that flags (n,) say."""
        counted = np.asarray(rows["correct"] if flags is None else flags, dtype=np.float64)
        units = pd.factorize(rows["unit"])[0]
        return cls(name, per_unit(counted, units), per_unit(np.ones(len(rows)), units))

    def called(self, name: str) -> Tally:
        return Tally(name, self.counted, self.of)

    @property
    def cells(self) -> list[Cell]:
        return [self.times, self.total, self.share, *(self.interval() or (None, None))]

    @property
    def drawn(self) -> tuple[float, Interval] | None:
        return None if self.share is None else (self.share, self.interval() or (0.0, 1.0))

    def interval(self, among: int = 1) -> Interval | None:
        """Return the 95 % interval of the share, widened for a choice among so many (Bonferroni)."""
        return share_interval(self.counted, self.of, 1.0 - (1.0 - CONFIDENCE) / max(among, 1)) if self.total else None

    def told(self, verb: str = "right") -> str:
        """Return ``right in 12 of 20 (60 %, 95 % interval 36-81 %)``; `verb` is what is counted."""
        share = f"{percent(self.share)}, 95 % interval {interval_text(self.interval())}"
        return f"{verb} in {self.times} of {self.total} ({share})"

    def below(self, other: Tally, among: int = 1) -> bool:
        """Return whether the interval of this share lies below that of another, both widened."""
        lower, upper = self.interval(among), other.interval(among)
        return lower is not None and upper is not None and lower[1] < upper[0]


def extremes(counts: Sequence[Tally], worst: str, best: str, thing: str, verb: str = "right") -> list[str]:
    """Return which of several has the lowest share and which the highest, and whether that is more than chance: the two
    were chosen among k for being extreme, so that they are compared by intervals of confidence 1 - 0.05 / k, which hold
    for all k together. Where these overlap, no difference is shown. `verb` is what is counted."""
    known = [count for count in counts if count.total]
    if len(known) < 2:
        return [f"{count.name}: {count.told(verb)}." for count in known]
    shares = [count.share or 0.0 for count in known]
    low, high = known[int(np.argmin(shares))], known[int(np.argmax(shares))]
    if low.share == high.share:
        return [f"All {len(known)} {thing} have the same share, {percent(low.share)}: no difference is shown."]
    named = []
    for count in (low, high):
        ties = shares.count(count.share or 0.0) - 1
        also = f" (as {ties} other{'s' if ties > 1 else ''})" if ties else ""
        named.append(f"is {count.name}{also}: {count.told(verb)}")
    widened = f"the intervals of the two, widened for having been chosen among {len(known)},"
    return [
        f"{worst} {named[0]}; {best} {named[1]}.",
        f"The difference is shown: {widened} do not overlap."
        if low.below(high, len(known))
        else f"No difference between the {thing} is shown: {widened} overlap.",
    ]


def plural(name: str) -> str:
    """Return what several values of a column are called: ``environments``, ``materials``, ``values of pose.yaw``."""
    control, _, parameter = name.partition(".")
    return "kinds of trials" if name == TRIAL else f"{control}s" if parameter in ("", "which") else f"values of {name}"


def bare(name: str) -> str:
    """Return a parameter's name without its control: ``milk`` for ``contents.milk``."""
    return name.rpartition(".")[2]


class Options(BaseModel):
    """Options that every figure has: a title in place of its own, and the parts whose rows it shows; all where none is
    named."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str = Field(default="", max_length=200)
    of: tuple[str, ...] = ()

    @property
    def parts(self) -> tuple[str, ...]:
        return self.of


@dataclass(frozen=True)
class MadeFigure:
    """A figure: title, sentences, a table of its numbers, what draws all but the title, and its size in inches."""

    title: str
    text: Sequence[str]
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    draw: Callable[[Any], None]
    size: tuple[float, float]
