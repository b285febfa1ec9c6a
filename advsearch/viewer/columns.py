"""Pack the rows of a sweep as columns of numbers, for a browser that aggregates them.

A million rows are 30 MB of numbers. A browser aggregates them in about ten
milliseconds, SQLite in a few seconds.
"""

from __future__ import annotations

import json
import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.options import OUT_OF_VIEW
from advsearch.runs.store import NAME, Row
from advsearch.trust.databases import DAMAGED

if TYPE_CHECKING:
    import pandas as pd

# Maximum number of distinct names in a column. Further names become "others".
MAX_LEVELS = 65535
# Value of "right" for a row whose prediction was not evaluated.
UNKNOWN = 2
NO_PROBABILITY = 65535  # value for a missing probability
BOX_STEPS = 8  # corners of boxes are integers in units of 1/8 of a pixel
NO_BOX = 65535  # value for the corners of a missing box
# Key in the `attrs` of a frame for the boxes of its rows.
BOXES_ATTRIBUTE = "boxes"
# Number of values of a box in `Boxes`: four corners, the index of the name, the score.
VALUES_PER_BOX = 6


@dataclass
class Boxes:
    """The predicted and the true boxes of rows, each of which may have any number.

    Attributes:
        values: `VALUES_PER_BOX` uint16 values for each box, one box after the other:
            x0, y0, x1 and y1 in units of 1 / `BOX_STEPS` of a pixel, the index of the
            name, and the score in units of 1/10000 (`NO_PROBABILITY` for true boxes).
        cumulative_counts: for each row, the number of boxes in this row and all rows
            before.
        names: index of each name of a class or an object.
    """

    values: array[int] = field(default_factory=lambda: array("H"))
    cumulative_counts: array[int] = field(default_factory=lambda: array("L"))
    names: dict[str, int] = field(default_factory=dict)

    def add(self, payload: Mapping[str, Any]) -> None:
        """Add the true boxes and the detections of a row's payload."""
        for name, thing in payload.get("things", {}).items():
            if thing.get("box"):
                self._put_box(thing["box"], name, NO_PROBABILITY)
        for detection in payload.get("found", ()):
            score = min(max(float(detection["score"]), 0.0), 1.0)
            in_ten_thousandths = round(10_000 * score)
            self._put_box(detection["box"], detection["label"], in_ten_thousandths)

    def _put_box(self, box: Any, name: object, score: int) -> None:
        """Add the values of a box (x0, y0, x1, y1) in pixels, with its name and score.

        Corners become integers in units of 1 / `BOX_STEPS` of a pixel, clipped to the
        range of uint16 below `NO_BOX`. The score is in units of 1/10000.
        """
        x0, y0, x1, y1 = (
            min(max(round(BOX_STEPS * float(corner)), 0), NO_BOX - 1) for corner in box
        )
        name = str(name)
        # The last of the MAX_LEVELS indices is for all further names together.
        is_beyond_limit = len(self.names) >= MAX_LEVELS - 1
        if name not in self.names and is_beyond_limit:
            name = "others"
        name_index = self.names.setdefault(name, len(self.names))
        self.values.extend((x0, y0, x1, y1, name_index, score))

    def __deepcopy__(self, memo: object) -> Boxes:
        """Return itself: pandas copies the attributes of a frame with every column it
        selects.
        """
        return self


CORNERS = tuple(
    f"{box} {corner}"
    for box in ("true box", "predicted box")
    for corner in ("x0", "y0", "x1", "y1")
)
"""Columns for detection: the corners of the true and of the predicted box in pixels."""


def read_columns(
    run: Path, after: int = 0, max_rows: int | None = None
) -> pd.DataFrame:
    """Read rows of a sweep as a frame (`runs.tables`), with `CORNERS` if it has boxes.

    Args:
        run: directory of the run.
        after: id of the row after which to begin.
        max_rows: maximum number of rows.

    Raises:
        FileFormatError: if the results cannot be read.
    """
    from advsearch.runs.tables import read_sweep  # pandas takes half a second

    boxes = Boxes()
    read_corners = partial(_read_corners_or_raise, run, boxes)
    rows = read_sweep(run, after, max_rows, read_corners)
    rows.attrs[BOXES_ATTRIBUTE] = boxes
    return rows


def _read_corners_or_raise(run: Path, boxes: Boxes, row: Row) -> Mapping[str, float]:
    """Return the corners of a row, whose stored payload may be corrupt.

    Args:
        run: directory of the run, for the message.
        boxes: gets all boxes of the row.
        row: the row.

    Raises:
        FileFormatError: it is corrupt.
    """
    try:
        return _read_corners(row, boxes)
    except (LookupError, TypeError, ValueError, OverflowError, AttributeError):
        raise FileFormatError(
            f"{run / NAME}: row {row.id}: expected boxes of a detector, got "
            f"something else; {DAMAGED}"
        ) from None


def _read_corners(row: Row, boxes: Boxes) -> Mapping[str, float]:
    """Return the corners of a row's true box and of its best detection, and add all its
    boxes to a collection.

    The names of the corners are `CORNERS`; a box that does not exist has NaN. Rows of
    other tasks than detection have no corners.

    Args:
        row: row of a sweep.
        boxes: collection to which the boxes are added, and an entry of
            `cumulative_counts`.
    """
    payload: Any = row.payload
    corners: Mapping[str, float] = {}
    if isinstance(payload, dict) and "box" in payload:
        best_box = _find_best_detection(row, payload)
        boxes.add(payload)
        values = [*_list_corner_values(payload["box"]), *_list_corner_values(best_box)]
        corners = dict(zip(CORNERS, values, strict=True))
    # Every row gets an entry, also one without boxes.
    n_boxes_so_far = len(boxes.values) // VALUES_PER_BOX
    boxes.cumulative_counts.append(n_boxes_so_far)
    return corners


def _find_best_detection(row: Row, payload: Mapping[str, Any]) -> Any:
    """Return the box of the first detection with the predicted label; None if there is
    none.

    If the model missed the object, it is the first one with the object's label.
    """
    # a payload has "class", the right label, if the object was missed
    label = payload.get("class", row.label)
    for detection in payload.get("found", ()):
        if detection["label"] == label:
            return detection["box"]
    return None


def _list_corner_values(box: Sequence[float | None] | None) -> list[float]:
    """Return the four numbers of a box; NaN for a number or a box that does not exist."""
    numbers = box or [None] * 4
    return [math.nan if number is None else float(number) for number in numbers]


def pack_columns(
    rows: pd.DataFrame, *, has_more: bool = False, is_running: bool = False
) -> bytes:
    """Pack rows into bytes for a browser.

    The bytes are the length of the head, the head, and the columns, all little-endian.
    The length is a uint32. The head is JSON, padded to a multiple of 4 bytes. It has
    the number of rows ("count"), the id of the last one ("last"), whether there are
    more ("more"), the names of labels ("answers"), outcomes and objects ("things"), and
    the offset of each column from the end of the head. Columns with the largest values
    (4 bytes) come first, so that each column is aligned, as typed arrays of JavaScript
    require it.

    The column "boxes" is (n, 8) uint16: the corners of the true box and of the best
    detection, in units of 1 / `BOX_STEPS` of a pixel, or `NO_BOX`. "others" has the
    values of all boxes, and "others end" the number of boxes up to each row.

    Args:
        rows: table from `read_columns`.
        has_more: whether the run has further rows already.
        is_running: whether the run is still adding rows.
    """
    columns, labels, outcome_names = _prediction_columns(rows)
    parameter_columns, parameters = _parameter_columns(rows)
    columns |= parameter_columns
    columns |= _box_columns(rows)
    # The columns with the largest values first. `itemsize` is the bytes of one value,
    # also in a column with several values for each row.
    arrays = sorted(columns.items(), key=lambda item: -item[1].itemsize)
    head = {
        "count": len(rows),
        "last": int(rows["id"].iloc[-1]) if len(rows) else 0,
        "more": has_more,
        "running": is_running,
        "answers": labels,
        "outcomes": outcome_names,
        "parameters": parameters,
        "things": _list_thing_names(rows),
        "columns": _make_layout(arrays),
    }
    data = [
        values.astype(values.dtype.newbyteorder("<")).tobytes() for _, values in arrays
    ]
    return b"".join([*_encode_head(head), *data])


def _list_thing_names(rows: pd.DataFrame) -> list[str]:
    """Return the names of the objects with boxes; an empty list without boxes."""
    boxes: Boxes | None = rows.attrs.get(BOXES_ATTRIBUTE)
    return list(boxes.names) if boxes is not None else []


def _encode_head(head: Mapping[str, object]) -> tuple[bytes, bytes]:
    """Return the length of a head as a uint32, and the head as padded JSON."""
    head_data = json.dumps(head).encode()
    head_data += b" " * (-len(head_data) % 4)  # up to a multiple of 4 bytes
    return len(head_data).to_bytes(4, "little"), head_data


def _make_layout(
    arrays: Sequence[tuple[str, npt.NDArray[Any]]],
) -> list[dict[str, object]]:
    """Return a description of each column for the head.

    It has the name, the type, the offset in bytes ("at"), and the number of values for
    each row ("width").
    """
    layout = list[dict[str, object]]()
    offset = 0
    for name, values in arrays:
        layout.append(_describe_column(name, values, offset))
        offset += values.nbytes
    return layout


def _describe_column(
    name: str, values: npt.NDArray[Any], offset: int
) -> dict[str, object]:
    """Return the entry of a column in the layout.

    Args:
        name: name of the column.
        values: its values, (n,) or (n, values for each row).
        offset: bytes of the columns before it.
    """
    entry: dict[str, object] = {
        "name": name,
        "type": values.dtype.name,
        "at": offset,
        "width": values.size // max(len(values), 1),
    }
    # Rows have different numbers of boxes, so that the length of this column does not
    # follow from the number of rows.
    if name == "others":
        entry["length"] = values.size
    return entry


def _prediction_columns(
    rows: pd.DataFrame,
) -> tuple[dict[str, Any], list[str], list[str]]:
    """Return the columns about the predictions of rows.

    Probabilities are integers in units of 1/10000, and "right" is 0, 1 or `UNKNOWN`.

    Returns:
        The columns by name; the names for which the indices in "answer" stand; and the
        names for those in "outcome".
    """
    label_indices, label_names = _encode_levels(rows["label"])
    outcome_indices, outcome_names = _encode_levels(rows["outcome"])
    # If the object is not visible, it is unknown whether the prediction is right.
    is_in_view = rows["label"] != OUT_OF_VIEW
    is_right = rows["correct"].where(is_in_view).fillna(UNKNOWN)
    columns = {
        "step": rows["step"].to_numpy(np.uint32),
        "margin": rows["margin"].to_numpy(np.float32),
        "answer": label_indices,
        "probability": _encode_probabilities(rows["probability"]),
        "outcome": outcome_indices,
        "right": is_right.to_numpy(np.uint8),
        "unit": rows["unit"].to_numpy(np.uint32),
    }
    return columns, label_names, outcome_names


def _encode_probabilities(column: pd.Series) -> npt.NDArray[np.uint16]:
    """Return probabilities in units of 1/10000, or `NO_PROBABILITY`."""
    probability = 10_000 * column.clip(0.0, 1.0).to_numpy()
    encoded = np.where(np.isnan(probability), NO_PROBABILITY, probability.round())
    return encoded.astype(np.uint16)


def _parameter_columns(
    rows: pd.DataFrame,
) -> tuple[dict[str, Any], list[dict[str, object]]]:
    """Return the columns of the parameters, and a description of each parameter.

    A description has the name, the unit, the levels and the edges of the ranges.
    Levels are the names for which the numbers in the column stand; None if the numbers
    are values.
    """
    edges = rows.attrs["edges"]
    columns = dict[str, Any]()
    parameters = list[dict[str, object]]()
    for index, (name, unit) in enumerate(rows.attrs["units"].items()):
        column = rows[name]
        if column.dtype == "category":  # names, which have no unit
            unit = ""
        values, levels = _encode_values(column)
        columns[f"parameter {index}"] = values
        parameters.append(
            {"name": name, "unit": unit, "levels": levels, "edges": edges.get(name)}
        )
    return columns, parameters


def _encode_values(column: pd.Series) -> tuple[Any, list[str] | None]:
    """Return the values of a parameter as numbers, and the names that they stand for.

    The names are None if the numbers are values.
    """
    if column.dtype == "category":
        return _encode_levels(column)
    # values too large for float32 become infinite, without a warning
    with np.errstate(over="ignore"):
        return column.to_numpy(np.float32), None


def _box_columns(rows: pd.DataFrame) -> dict[str, Any]:
    """Return the columns with boxes; none if no row has a box."""
    columns = dict[str, Any]()
    if CORNERS[0] in rows:
        pixels = rows[list(CORNERS)].to_numpy()
        steps = (BOX_STEPS * pixels).clip(0, NO_BOX - 1).round()
        columns["boxes"] = np.where(np.isnan(pixels), NO_BOX, steps).astype(np.uint16)
    boxes: Boxes | None = rows.attrs.get(BOXES_ATTRIBUTE)
    if boxes is not None and boxes.values:
        # Pandas copies the attribute to selections of rows, to which the boxes do not
        # belong.
        are_of_these_rows = len(boxes.cumulative_counts) == len(rows)
        if are_of_these_rows:
            columns["others"] = np.asarray(boxes.values, np.uint16)
            columns["others end"] = np.asarray(boxes.cumulative_counts, np.uint32)
    return columns


def _encode_levels(column: pd.Series) -> tuple[Any, list[str]]:
    """Encode a column of names as indices (n,) uint16, and return these and the names.

    If there are more than `MAX_LEVELS` names, the remaining ones share the last level,
    "others". If the column has no names, all indices are 0.
    """
    names = column.cat.categories.tolist() if column.dtype == "category" else []
    if not names:
        return np.zeros(len(column), np.uint16), names
    if len(names) >= MAX_LEVELS:
        names = [*names[: MAX_LEVELS - 1], "others"]
    # Further names get the index of the last one. A missing name has the code -1, which
    # becomes 65535 in uint16.
    indices = np.minimum(column.cat.codes.to_numpy(), len(names) - 1)
    return indices.astype(np.uint16), names
