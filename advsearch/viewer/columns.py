"""The rows of a sweep as columns of numbers, which a browser aggregates faster than a database could answer.

A million rows are 30 MB of numbers; going through them takes a browser some ten milliseconds, SQLite some seconds.
"""

from __future__ import annotations

import json
import math
from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from advsearch.described import NOT_A_NUMBER, Value
from advsearch.errors import FileFormatError
from advsearch.files import JsonObject
from advsearch.runs.files import DAMAGED
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.store import NAME, Row, Store
from advsearch.runs.summary import NAME as SUMMARY
from advsearch.runs.summary import read_result
from advsearch.runs.units import units_of

KIND = "sweep"

EDGES = "parts of ranges"
"""The note of a run that says where the range of each drawn parameter is cut: the ends of the parts, by name."""

MOST_LEVELS = 65535
"""Different names of one axis, or answers, that are told apart; further ones are one: "others"."""

UNKNOWN = 2
"""`right` of a row whose answer was not judged."""

NO_PROBABILITY = 65535

BOX_STEPS = 8
"""Of a pixel, in which the corners of boxes are counted."""

NO_BOX = 65535

AnyArray = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Column:
    """One parameter of the rows.

    Attributes:
        name: ``"pose.yaw"``; ``"camera.target[0]"`` for one of several numbers.
        unit: its unit; empty for names.
        levels: the names that occur; None for numbers.
        data: (n,) float32, NaN where a row has none; or uint16, the places of the names in `levels`.
        edges: of the parts that it is shown in, ascending; None of one that is shown value by value.
    """

    name: str
    unit: str
    levels: tuple[str, ...] | None
    data: AnyArray
    edges: tuple[float, ...] | None = None


@dataclass(frozen=True, eq=False)
class Columns:
    """The rows of a sweep, or those from some row on.

    Attributes:
        step: (n,) uint32, the number of the configuration.
        unit: (n,) uint32, of what it is a draw of: rows of one unit are not independent (`runs.units`).
        margin: (n,) float32, NaN where there was none.
        answer: (n,) uint16, the place of the answer in `answers`.
        probability: (n,) uint16, in ten thousandths; `NO_PROBABILITY` where there was none.
        right: (n,) uint8, 1 right, 0 wrong, `UNKNOWN` not judged.
        answers: what was answered.
        parameters: in the order in which rows have them.
        last: the id of the last row; 0 where there is none.
        boxes: (n, 8) uint16, of detection: x0, y0, x1, y1 of the true box and of the one that the answer is about, in
            `BOX_STEPS` of a pixel of the rendering; `NO_BOX` where there is none. None where no row has any.
        more: whether there are further rows behind these.
        running: whether further rows are still being made.
    """

    step: AnyArray
    unit: AnyArray
    margin: AnyArray
    answer: AnyArray
    probability: AnyArray
    right: AnyArray
    answers: tuple[str, ...]
    parameters: tuple[Column, ...]
    last: int
    boxes: AnyArray | None = None
    more: bool = False
    running: bool = False

    @property
    def head(self) -> JsonObject:
        """What a reader of the columns has to know: counts, names, and where each column begins behind the head."""
        arrays = self._arrays()
        starts = np.cumsum([0, *(one.nbytes for _, one in arrays)])
        placed = [
            {"name": name, "type": one.dtype.name, "at": int(start), "width": one.size // max(len(one), 1)}
            for (name, one), start in zip(arrays, starts[:-1], strict=True)
        ]
        parameters = [
            {
                "name": one.name,
                "unit": one.unit,
                "levels": None if one.levels is None else list(one.levels),
                "edges": None if one.edges is None else list(one.edges),
            }
            for one in self.parameters
        ]
        head = {
            "count": len(self.step),
            "last": self.last,
            "more": self.more,
            "running": self.running,
            "answers": list(self.answers),
            "parameters": parameters,
            "columns": placed,
        }
        return cast("JsonObject", head)

    def packed(self) -> bytes:
        """Return the length of the head (uint32), the head as JSON filled up to a multiple of 4 bytes, the columns.

        All little-endian; columns of four bytes a number come first, so that each begins at a multiple of its size.
        """
        head = json.dumps(self.head).encode()
        head += b" " * (-len(head) % 4)
        columns = (one.astype(one.dtype.newbyteorder("<")).tobytes() for _, one in self._arrays())
        return b"".join([len(head).to_bytes(4, "little"), head, *columns])

    def _arrays(self) -> list[tuple[str, AnyArray]]:
        own = [
            ("step", self.step),
            ("margin", self.margin),
            ("answer", self.answer),
            ("probability", self.probability),
            ("right", self.right),
            ("unit", self.unit),
        ]
        own += [(f"parameter {number}", one.data) for number, one in enumerate(self.parameters)]
        own += [] if self.boxes is None else [("boxes", self.boxes)]
        return sorted(own, key=lambda one: -one[1].itemsize)


def read_columns(run: Path, after: int = 0, most: int | None = None) -> Columns:
    """Return the rows of the sweep in `run` that were written after the row with this id, `most` of them at most.
    Raises FileFormatError where the results cannot be read."""
    with Store(run / NAME, read_only=True) as store:
        found, edges = columns_of(islice(store.rows(KIND, after=after), most), run), store.noted(EDGES)
        units = units_of(store) or units_of(store, _summary_of(run))
    if units is not None:
        found = replace(found, unit=units.of(found.step.astype(np.int64)).astype(np.uint32))
    known = edges if isinstance(edges, dict) else {}
    cut = (replace(one, edges=_edges(known.get(one.name))) for one in found.parameters)
    return replace(found, parameters=tuple(cut))


def _summary_of(run: Path) -> SweepSummary | None:
    """The result of an older run, whose store says nothing of units; None while it has none."""
    found = read_result(run) if (run / SUMMARY).is_file() else None
    return found if isinstance(found, SweepSummary) else None


def _edges(noted: object) -> tuple[float, ...] | None:
    """The ends of parts, as a run notes them; None of what is something else."""
    if not isinstance(noted, list) or len(noted) < 2 or not all(isinstance(one, (int, float)) for one in noted):
        return None
    return tuple(map(float, noted))


def columns_of(rows: Iterable[Row], run: Path) -> Columns:
    """Return rows of the run in a folder as columns. Raises FileFormatError where the boxes of one are none."""
    steps, margins, shares, right = array("L"), array("f"), array("H"), array("B")
    answers, parameters, last, boxes = _Levels(), _Parameters(), 0, array("H")
    for number, row in enumerate(rows):
        steps.append(row.step)
        margins.append(math.nan if row.margin is None else row.margin)
        answers.add(row.label or ("" if row.correct is None else NOT_A_NUMBER))
        share = row.probability
        shares.append(NO_PROBABILITY if share is None else round(10_000 * min(max(share, 0.0), 1.0)))
        right.append(UNKNOWN if row.correct is None else int(row.correct))
        parameters.add(number, row.values)
        last = row.id or number + 1
        if isinstance(row.payload, dict) and "box" in row.payload:
            boxes.extend([NO_BOX] * (8 * number - len(boxes)))
            boxes.extend(_boxes(row, run))
    boxes.extend([NO_BOX] * (8 * len(steps) - len(boxes) if boxes else 0))
    return Columns(
        step=np.array(steps, np.uint32),
        unit=np.array(steps, np.uint32),
        margin=np.array(margins, np.float32),
        answer=np.array(answers.places, np.uint16),
        probability=np.array(shares, np.uint16),
        right=np.array(right, np.uint8),
        answers=tuple(answers.names),
        parameters=parameters.columns(len(steps)),
        last=last,
        boxes=np.array(boxes, np.uint16).reshape(-1, 8) if boxes else None,
    )


def _boxes(row: Row, run: Path) -> list[int]:
    """The true box of a detector's answer, and the best one with the label that the answer is, or misses."""
    payload: Any = row.payload
    sought = (row.label or "").removeprefix("no ")
    try:
        said = next((one["box"] for one in payload.get("found", ()) if one["label"] == sought), None)
        corners = [one for box in (payload["box"], said) for one in (box or [None] * 4)]
        found = [NO_BOX if x is None else round(min(max(BOX_STEPS * x, 0), NO_BOX - 1)) for x in corners]
    except (LookupError, TypeError, ValueError, OverflowError):
        found = []
    if len(found) != 8:
        raise FileFormatError(
            f"{run / NAME}: row {row.id}: expected boxes of a detector, got something else; {DAMAGED}"
        )
    return found


class _Levels:
    def __init__(self) -> None:
        self.names: dict[str, int] = {}
        self.places = array("H")

    def add(self, name: str) -> None:
        if name not in self.names and len(self.names) >= MOST_LEVELS - 1:
            name = "others"
        self.places.append(self.names.setdefault(name, len(self.names)))


class _Values:
    """One parameter's values: numbers until there is a name, then names."""

    def __init__(self, unit: str) -> None:
        self.unit = unit
        self._numbers = array("f")
        self._names: _Levels | None = None

    def __len__(self) -> int:
        return len(self._numbers if self._names is None else self._names.places)

    def add(self, value: object) -> None:
        if self._names is None and (value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))):
            self._numbers.append(math.nan if value is None else float(value))
            return
        if self._names is None:
            self._names = _Levels()
            for number in self._numbers:
                self._names.add("none" if math.isnan(number) else f"{number:g}")
        self._names.add("none" if value is None else str(value))

    def column(self, name: str) -> Column:
        if self._names is None:
            return Column(name, self.unit, None, np.array(self._numbers, np.float32))
        return Column(name, "", tuple(self._names.names), np.array(self._names.places, np.uint16))


class _Parameters:
    """Values of rows as they come; a row may lack some that others have."""

    def __init__(self) -> None:
        self._values: dict[str, _Values] = {}

    def add(self, number: int, values: Mapping[str, Value]) -> None:
        for name, one in values.items():
            value: object = one["value"]
            if isinstance(value, (list, tuple)):
                for place, part in enumerate(value):
                    self._put(number, f"{name}[{place}]", part, one["unit"])
            else:
                self._put(number, name, value, one["unit"])

    def _put(self, number: int, name: str, value: object, unit: str) -> None:
        held = self._values.get(name)
        if held is None:
            held = self._values[name] = _Values(unit)
        while len(held) < number:
            held.add(None)
        held.add(value)

    def columns(self, count: int) -> tuple[Column, ...]:
        for held in self._values.values():
            while len(held) < count:
                held.add(None)
        return tuple(held.column(name) for name, held in self._values.items())
