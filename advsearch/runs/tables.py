"""Rows of a run as one pandas frame: a row for each configuration, a column for each thing that is known of it."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from advsearch.described import NOT_A_NUMBER
from advsearch.runs.export import as_columns, as_record
from advsearch.runs.store import NAME, Row, Store
from advsearch.runs.units import units_of

KIND = "sweep"
"""Rows of the sweep itself."""

EDGES = "parts of ranges"
"""The note of a run that says where the range of each drawn parameter is cut: the ends of the parts, by name."""

SAID = ("id", "step", "correct", "margin", "probability", "seconds", "label")
"""Columns of a sweep's frame before those of its parameters; `unit` is the last one."""

TAKEN = {*(one.name for one in fields(Row)), "unit"}
"""Names that a parameter cannot have in a frame."""


def to_pandas(rows: Iterable[Row]) -> pd.DataFrame:
    """Return rows as a frame, with the columns of an export under plain names.

    A value is called ``pose.yaw``, and ``attrs["units"]["pose.yaw"]`` says its unit: "degrees".
    """
    listed = list(rows)
    names = {one: one.partition(" [")[0] for one in as_columns(listed)}
    records = [{names[name]: value for name, value in as_record(row).items()} for row in listed]
    frame = pd.DataFrame(records, columns=list(names.values()))
    frame.attrs["units"] = {plain: name[len(plain) + 2 : -1] for name, plain in names.items() if plain != name}
    return frame


def read_sweep(
    run: Path, after: int = 0, most: int | None = None, also: Callable[[Row], Mapping[str, float]] | None = None
) -> pd.DataFrame:
    """Return the rows of the sweep in `run` that were written after the row with this id, `most` of them at most, as
    `sweep_frame` does; `unit` says which rows are not independent (`runs.units`), and ``attrs["edges"]`` where the
    ranges of drawn parameters are cut. Raises FileFormatError where the results cannot be read."""
    with Store(run / NAME, read_only=True) as store:
        frame, noted = sweep_frame(islice(store.rows(KIND, after=after), most), also), store.noted(EDGES)
        units = units_of(store)
    if units is not None:
        frame["unit"] = units.of(frame["step"].to_numpy())
    for name, ends in noted.items() if isinstance(noted, dict) else ():
        if isinstance(ends, list) and len(ends) > 1 and all(isinstance(end, (int, float)) for end in ends):
            frame.attrs["edges"][name] = list(map(float, ends))
    return frame


def sweep_frame(rows: Iterable[Row], also: Callable[[Row], Mapping[str, float]] | None = None) -> pd.DataFrame:
    """Return rows of a sweep as a frame: `SAID`, a column for each parameter and for what is `also` told of a row, and
    `unit`, which here is the step.

    Numbers are float64, NaN where a row has none; `correct` is 1 or 0, NaN where it was not judged. `label`, and
    parameters that have a name anywhere, are categories in the order in which they come, "none" where a row has
    nothing. ``camera.target[0]`` is one of several numbers; ``attrs["units"]`` has the units of parameters.
    """
    columns, units, count = {name: _Column() for name in SAID}, dict[str, str](), 0
    for row in rows:
        said = row.id or count + 1, row.step, row.correct, row.margin, row.probability, row.seconds
        label = row.label or ("" if row.correct is None else NOT_A_NUMBER)
        cells: dict[str, Any] = dict(zip(SAID, (*said, label), strict=True))
        for name, told in row.values.items():
            value: Any = told["value"]
            called = f"parameter {name}" if name in TAKEN else name
            parts = {called: value}
            if isinstance(value, list):
                parts = {f"{called}[{place}]": one for place, one in enumerate(value)}
            for full in parts:
                units.setdefault(full, told["unit"])
            cells |= parts
        cells |= also(row) if also else {}
        for name, value in cells.items():
            columns.setdefault(name, _Column()).put(count, value)
        count += 1
    frame = pd.DataFrame({name: column.whole(count) for name, column in columns.items()})
    frame = frame.astype({"id": np.int64, "step": np.int64})
    frame["unit"] = frame["step"]
    frame.attrs |= {"units": units, "edges": {}}
    return frame


class _Column:
    """Values as they come, 8 bytes a number and 12 a name, so that a million rows fit."""

    def __init__(self) -> None:
        self.numbers, self.codes, self.names = array("d"), array("l"), dict[str, int]()

    def put(self, place: int, value: float | str | None) -> None:
        """Give the row at a place, later than all before it, a value."""
        number = math.nan if value is None or isinstance(value, str) else float(value)
        if isinstance(value, str) or self.names:
            self.codes.extend([-1] * (place - len(self.codes)))
            self.codes.append(self.names.setdefault(value, len(self.names)) if isinstance(value, str) else -1)
        self.numbers.extend([math.nan] * (place - len(self.numbers)))
        self.numbers.append(number)

    def whole(self, count: int) -> Any:
        """The column of so many rows."""
        numbers = np.append(np.array(self.numbers), np.full(count - len(self.numbers), np.nan))
        if not self.names:
            return numbers
        codes = np.append(np.array(self.codes), np.full(count - len(self.codes), -1))
        for place in np.flatnonzero(codes < 0):
            text = "none" if math.isnan(numbers[place]) else f"{numbers[place]:g}"
            codes[place] = self.names.setdefault(text, len(self.names))
        return pd.Categorical.from_codes(codes, list(self.names))
