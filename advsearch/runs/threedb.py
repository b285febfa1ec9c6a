"""Folders as 3DB (Leclerc et al. 2021) writes them, and its dashboard reads them.

In `details.log` each line is a JSON object: ``id``, ``environment``, ``model`` (there the object), ``is_correct`` as
"True" or "False", ``prediction`` (classes by number, the best first), ``loss``, ``output_type`` and ``render_args``
with the parameters. `class_maps.json` lists the classes' names. A picture is ``images/<id>_rgb.png``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from advsearch.described import NOT_A_NUMBER, Value
from advsearch.errors import FileFormatError, InputError
from advsearch.files import JsonObject, JsonValue, open_regular, parse_json, read_text
from advsearch.runs.files import placed_by, replacing, write_bytes, write_text
from advsearch.runs.store import Row

DETAILS, CLASSES, IMAGES = "details.log", "class_maps.json", "images"

LARGEST = 4 << 30
"""Most bytes of a `details.log`."""

LONGEST = 1 << 20
"""Most bytes of one of its lines."""

MOST_CLASSES = 16 << 20
"""Most bytes of a `class_maps.json`."""

OWN = ("environment", "object")
"""Values that have a place of their own in a line."""


def write_threedb(rows: Callable[[], Iterable[Row]], out: Path, picture: Callable[[int], bytes | None]) -> int:
    """Write the rows of a sweep as such a folder, and return how many there were.

    ``loss`` holds the margin: how wrong an answer is, over 0 where it is not right. The parameter ``network`` tells
    what several networks answer apart.

    Args:
        rows: yields the rows from the first, as often as it is called.
        out: the folder; made, or empty.
        picture: the PNG of a row by its number, None where none was kept.

    Raises:
        InputError: the folder is there and not empty, or there are no rows.
        StorageError: it cannot be written.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"out: {out} is there already and not empty; name another folder")
    names, classes = dict[str, None](), _Classes()
    for row in rows():
        names |= dict.fromkeys(name for name in row.values if name not in OWN)
        classes.add(row)
    if not classes.seen:
        raise InputError("format 3db: needs the rows of a sweep, and this run has none")
    with placed_by("out"):
        count = 0
        with replacing(out / DETAILS) as part, part.open("w", encoding="utf-8") as file:
            for row in rows():
                line = _line(row, names, classes.number(row))
                file.write(json.dumps(line, allow_nan=False) + "\n")
                data = picture(row.step)
                if data is not None:
                    write_bytes(out / IMAGES / f"{line['id']}_rgb.png", data, durable=False)
                count += 1
        write_text(out / CLASSES, json.dumps(classes.names()))
    return count


class _Classes:
    """The classes that were answered; those without a number get one behind the others."""

    def __init__(self) -> None:
        self.seen: dict[str, int | None] = {}

    def add(self, row: Row) -> None:
        self.seen.setdefault(row.label or NOT_A_NUMBER, row.label_index)

    def names(self) -> list[str]:
        numbers = self._numbers()
        found = [f"class {number}" for number in range(max(numbers.values()) + 1)]
        for name, number in numbers.items():
            found[number] = name
        return found

    def number(self, row: Row) -> int:
        return self._numbers()[row.label or NOT_A_NUMBER]

    def _numbers(self) -> dict[str, int]:
        given = {name: number for name, number in self.seen.items() if number is not None}
        free = max(given.values(), default=-1) + 1
        others = [name for name, number in self.seen.items() if number is None]
        return given | {name: free + place for place, name in enumerate(others)}


def _line(row: Row, names: Iterable[str], prediction: int) -> JsonObject:
    parameters: JsonObject = {}
    for name in names:
        value = row.values.get(name)
        parameters["network" if name == "model" else name] = "none" if value is None else value["value"]
    own = {name: str(row.values[name]["value"]) if name in row.values else "none" for name in OWN}
    return {
        "id": f"{row.step}",
        "environment": own["environment"],
        "model": own["object"],
        "is_correct": str(bool(row.correct)),
        "loss": row.margin,
        "prediction": [prediction],
        "output_type": "classes",
        "render_args": parameters,
    }


@dataclass(frozen=True)
class Imported:
    """One line of such a folder.

    Attributes:
        row: as a sweep stores it.
        picture: the file of its picture; None where there is none.
    """

    row: Row
    picture: Path | None


def read_threedb(folder: Path) -> Iterator[Imported]:
    """Yield the rows of such a folder.

    Raises:
        FileFormatError: a file is missing, too large or not what it should be; the message names the line.
    """
    classes = _read_classes(folder / CLASSES)
    try:
        file = open_regular(folder / DETAILS, "the log of 3DB", LARGEST)
    except OSError as error:
        raise FileFormatError(f"{folder / DETAILS}: expected the log of 3DB, got {error.strerror}") from None
    with file:
        for number in range(1 << 62):
            line = file.readline(LONGEST + 1)
            if not line:
                return
            if len(line) > LONGEST:
                raise _wrong(folder, number, f"more than {LONGEST} bytes")
            if line.strip():
                yield _imported(folder, number, line, classes)


def _read_classes(path: Path) -> Sequence[str]:
    try:
        names = parse_json(read_text(path, "the classes of 3DB", MOST_CLASSES))
    except FileNotFoundError:
        return ()
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path}: expected a list of names, got {error}") from None
    if not isinstance(names, list):
        raise FileFormatError(f"{path}: expected a list of names, got {type(names).__name__}")
    return [str(name) for name in names]


def _imported(folder: Path, number: int, line: bytes, classes: Sequence[str]) -> Imported:
    try:
        told = parse_json(line.decode())
    except ValueError as error:
        raise _wrong(folder, number, str(error)) from None
    if not isinstance(told, dict) or not isinstance(told.get("render_args"), dict):
        raise _wrong(folder, number, "a line without render_args")
    values: dict[str, Value] = {
        "object": _value(told.get("model")),
        "environment": _value(told.get("environment")),
    }
    for name, value in told["render_args"].items():
        if isinstance(value, list):
            values |= {f"{name}[{place}]": _value(one) for place, one in enumerate(value)}
        else:
            values["model" if name == "network" else name] = _value(value)
    index = _first(told.get("prediction"))
    label = classes[index] if index is not None and 0 <= index < len(classes) else "" if index is None else str(index)
    loss = told.get("loss")
    name = str(told.get("id"))
    safe = re.fullmatch(r"[A-Za-z0-9_-]{1,100}", name)
    picture = folder / IMAGES / f"{name}_rgb.png" if safe else None
    return Imported(
        Row(
            kind="sweep",
            step=number,
            correct=str(told.get("is_correct")) == "True",
            margin=float(loss) if isinstance(loss, (int, float)) else None,
            label=label,
            label_index=index,
            values=values,
        ),
        picture if picture is not None and picture.is_file() and not picture.is_symlink() else None,
    )


def _first(prediction: JsonValue) -> int | None:
    found = prediction[0] if isinstance(prediction, list) and prediction else prediction
    return int(found) if isinstance(found, (int, float)) and not isinstance(found, bool) else None


def _value(value: JsonValue) -> Value:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return {"value": value if number else str(value), "unit": ""}  # type: ignore[typeddict-item]


def _wrong(folder: Path, number: int, got: str) -> FileFormatError:
    return FileFormatError(f"{folder / DETAILS}: line {number + 1}: expected a line of 3DB's log, got {got[:120]}")
