"""The rows of runs as answers: what was shown, and what the model said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from advsearch.report.wording import short_name
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.store import NAME, Store

PHOTOGRAPHS = "photographs"
"""The part that photographs are."""

ANSWER, GROUP, PART, TRIAL = "answer", "group", "part", "trial"
"""What the model said, the group that an object is in, the part of the recipe, and which trial of an attack it is."""

TRIALS = {
    "first control": "clean scene",
    "control": "clean scene",
    "verification": "answer",
    "baseline verification": "random search",
}
"""The rows of an attack that are in the table, and what figures call them."""

WORKERS = "workers"
"""The number of processes that shared a sweep, in whole; only of sweeps that say it."""

OTHERS = "other objects"
"""The group of objects that are in none."""


@dataclass(frozen=True)
class Answered:
    """What a model said of one picture.

    Attributes:
        part: of the recipe.
        values: what the picture shows: object, environment, model, and parameters in their units.
        units: of the parameters.
        answer: in words.
        correct: whether it is right.
        time: when it was stored, seconds since 1970.
        margin: of the task; over 0 where the answer is wrong.
    """

    part: str
    values: Mapping[str, float | str]
    units: Mapping[str, str]
    answer: str
    correct: bool
    time: float | None = None
    margin: float | None = None


def figure_value(value: float | str) -> str:
    """Return a value as figures write it; of a file, its name without folder and suffix."""
    if isinstance(value, str):
        return Path(short_name(value)).stem if "/" in value else value
    return f"{value:.4g}"


def rows_of(part: str, folder: Path, summary: AttackSummary | SweepSummary) -> list[Answered]:
    """Return the answers that a sweep has stored, without the trials of its worst, or the trials of an attack.

    Args:
        part: of the recipe.
        folder: of the run.
        summary: of it.

    Raises:
        FileFormatError: the rows cannot be read.
    """
    return answered(part, folder, summary, ("sweep",) if isinstance(summary, SweepSummary) else tuple(TRIALS))


def answered(part: str, folder: Path, summary: AttackSummary | SweepSummary, kinds: Sequence[str]) -> list[Answered]:
    """Return the rows of some kinds; other arguments and errors as for `rows_of`."""
    outer = {"object": summary.object, "environment": summary.environment, "model": summary.model}
    rows = []
    with Store(folder / NAME, read_only=True) as store:
        for row in store.rows():
            if row.kind not in kinds:
                continue
            values = {name: one["value"] for name, one in row.values.items()}
            values |= {TRIAL: TRIALS[row.kind]} if row.kind in TRIALS else {}
            values |= {"model": summary.model} if part == PHOTOGRAPHS and "," not in summary.model else {}
            named = {name: figure_value(str(values.get(name, of_all))) for name, of_all in outer.items()}
            units = {name: one["unit"] for name, one in row.values.items() if one["unit"]}
            answer = row.label or "none", bool(row.correct)
            rows.append(Answered(part, {**values, **named}, units, *answer, row.time, row.margin))
    return rows
