"""The rows of a sweep as columns of numbers, which a browser aggregates faster than a
database could answer.

A million rows are 30 MB of numbers; going through them takes a browser some ten
milliseconds, SQLite some seconds.
"""

from __future__ import annotations

import json
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from advsearch.errors import FileFormatError
from advsearch.options import OUT_OF_VIEW
from advsearch.runs.store import NAME, Row
from advsearch.trust.databases import DAMAGED

if TYPE_CHECKING:
    import pandas as pd

# different names of one axis, or predictions, that are told apart; further ones are
# one: "others"
MOST_LEVELS = 65535
UNKNOWN = 2  # `right` of a row whose prediction was not judged
NO_PROBABILITY = 65535
BOX_STEPS = 8  # of a pixel, in which the corners of boxes are counted
NO_BOX = 65535
OTHERS = "boxes"  # where a frame keeps the boxes of its rows, in its `attrs`
# numbers of a box among `Boxes`: its corners, the place of its name, its score
OF_A_BOX = 6


@dataclass
class Boxes:
    """All boxes of a detector's predictions, true ones too, as rows have from none to
    many: `OF_A_BOX` numbers a box, corners in `BOX_STEPS` of a pixel, place of the
    name, score in 1/10000 (`NO_PROBABILITY` of what is true); how many boxes there are
    up to and with each row; and names of classes and things.
    """

    numbers: array[int] = field(default_factory=lambda: array("H"))
    ends: array[int] = field(default_factory=lambda: array("L"))
    names: dict[str, int] = field(default_factory=dict)

    def put(self, payload: Mapping[str, Any]) -> None:
        things = payload.get("things", {})
        true = [
            (one["box"], name, None) for name, one in things.items() if one.get("box")
        ]
        found = [
            (one["box"], one["label"], float(one["score"]))
            for one in payload.get("found", ())
        ]
        for box, name, score in [*true, *found]:
            x0, y0, x1, y1 = (
                min(max(round(BOX_STEPS * float(end)), 0), NO_BOX - 1) for end in box
            )
            place = self.names.setdefault(str(name), min(len(self.names), MOST_LEVELS))
            told = (
                NO_PROBABILITY
                if score is None
                else round(10_000 * min(max(score, 0.0), 1.0))
            )
            self.numbers.extend((x0, y0, x1, y1, place, told))

    def __deepcopy__(self, memo: object) -> Boxes:
        """Itself: pandas copies the attributes of a frame with every column that is
        taken out of it.
        """
        return self


CORNERS = tuple(
    f"{what} {end}"
    for what in ("true box", "predicted box")
    for end in ("x0", "y0", "x1", "y1")
)
"""Columns of detection: of the true box and of the one that the prediction is about, in
pixels of the rendering.
"""


def read_columns(run: Path, after: int = 0, most: int | None = None) -> pd.DataFrame:
    """Return the rows of the sweep in `run` that were written after the row with this
    id, `most` of them at most, as a frame (`runs.tables`), with `CORNERS` where rows
    have boxes. Raises FileFormatError where the results cannot be read.
    """
    from advsearch.runs.tables import read_sweep  # pandas takes half a second

    boxes = Boxes()

    def corners(row: Row) -> Mapping[str, float]:
        """The true box of a detector's prediction, and the best one with the label that
        the prediction is, or misses.
        """
        payload: Any = row.payload
        if not isinstance(payload, dict) or "box" not in payload:
            boxes.ends.append(len(boxes.numbers) // OF_A_BOX)
            return {}
        sought = payload.get("class", row.label)
        try:
            best = next(
                (
                    one["box"]
                    for one in payload.get("found", ())
                    if one["label"] == sought
                ),
                None,
            )
            boxes.put(payload)
            boxes.ends.append(len(boxes.numbers) // OF_A_BOX)
            numbers = [
                float("nan") if x is None else float(x)
                for b in (payload["box"], best)
                for x in b or [None] * 4
            ]
            return dict(zip(CORNERS, numbers, strict=True))
        except (LookupError, TypeError, ValueError, OverflowError, AttributeError):
            file = run / NAME
            expected = (
                f"{file}: row {row.id}: expected boxes of a detector, got "
                f"something else; {DAMAGED}"
            )
            raise FileFormatError(expected) from None

    rows = read_sweep(run, after, most, corners)
    rows.attrs[OTHERS] = boxes
    return rows


def packed(rows: pd.DataFrame, *, more: bool = False, running: bool = False) -> bytes:
    """Return rows for a browser: the length of the head (uint32), the head as JSON
    filled up to a multiple of 4 bytes, the columns.

    The head has the count, names, and where each column begins behind it; whether there
    are `more` rows behind these, and whether further ones are still being made. All is
    little-endian; columns of four bytes a number come first, so that each begins at a
    multiple of its size. Boxes are (n, 8) uint16 in `BOX_STEPS` of a pixel, `NO_BOX`
    where there is none. `others` are all `Boxes`, up to each row's `others end`.
    """
    predictions, labels = _levels(rows["label"])
    outcomes, outcome_names = _levels(rows["outcome"])
    share = 10_000 * rows["probability"].clip(0.0, 1.0).to_numpy()
    columns = {
        "step": rows["step"].to_numpy(np.uint32),
        "margin": rows["margin"].to_numpy(np.float32),
        "answer": predictions,
        "probability": np.where(np.isnan(share), NO_PROBABILITY, share.round()).astype(
            np.uint16
        ),
        "outcome": outcomes,
        "right": rows["correct"]
        .where(rows["label"] != OUT_OF_VIEW)
        .fillna(UNKNOWN)
        .to_numpy(np.uint8),
        "unit": rows["unit"].to_numpy(np.uint32),
    }
    units = rows.attrs["units"]
    edges = rows.attrs["edges"]
    parameters = []
    for number, (name, unit) in enumerate(units.items()):
        column = rows[name]
        levels = None
        if column.dtype == "category":
            unit = ""
            columns[f"parameter {number}"], levels = _levels(column)
        else:
            with np.errstate(over="ignore"):
                columns[f"parameter {number}"] = column.to_numpy(np.float32)
        parameters.append(
            {"name": name, "unit": unit, "levels": levels, "edges": edges.get(name)}
        )
    if CORNERS[0] in rows:
        pixels = rows[list(CORNERS)].to_numpy()
        steps = (BOX_STEPS * pixels).clip(0, NO_BOX - 1).round()
        columns["boxes"] = np.where(np.isnan(pixels), NO_BOX, steps).astype(np.uint16)
    boxes: Boxes | None = rows.attrs.get(OTHERS)
    if boxes is not None and boxes.numbers and len(boxes.ends) == len(rows):
        columns["others"] = np.asarray(boxes.numbers, np.uint16)
        columns["others end"] = np.asarray(boxes.ends, np.uint32)
    arrays = sorted(columns.items(), key=lambda one: -one[1].itemsize)
    starts = np.cumsum([0, *(one.nbytes for _, one in arrays)]).tolist()
    head = {
        "count": len(rows),
        "last": int(rows["id"].iloc[-1]) if len(rows) else 0,
        "more": more,
        "running": running,
        "answers": labels,
        "outcomes": outcome_names,
        "parameters": parameters,
        "things": list(boxes.names) if boxes is not None else [],
        "columns": [
            {
                "name": name,
                "type": one.dtype.name,
                "at": start,
                "width": one.size // max(len(one), 1),
            }
            | ({"length": one.size} if name == "others" else {})
            for (name, one), start in zip(arrays, starts, strict=False)
        ],
    }
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    data = (one.astype(one.dtype.newbyteorder("<")).tobytes() for _, one in arrays)
    return b"".join([len(text).to_bytes(4, "little"), text, *data])


def _levels(column: pd.Series) -> tuple[Any, list[str]]:
    """The place (n,) uint16 of each name of a column among the names that are told
    apart, and these.
    """
    names = column.cat.categories.tolist() if column.dtype == "category" else []
    if len(names) >= MOST_LEVELS:
        names = [*names[: MOST_LEVELS - 1], "others"]
    places = column.cat.codes.to_numpy() if names else np.zeros(len(column))
    return np.minimum(places, max(len(names) - 1, 0)).astype(np.uint16), names
