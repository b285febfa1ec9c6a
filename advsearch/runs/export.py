"""A run's rows as a table for other programs: CSV, JSON or Parquet.

One line for each evaluated configuration, in the order in which they were evaluated. The columns of the store come
first; then one for each of the run's metrics; then one for each value, with its unit in its name: ``pose.yaw
[degrees]``. A value of several numbers has a column for each: ``camera.target[0]``. What a task keeps of an answer
(``payload``) is nested in JSON and a JSON text in the others. What a row has not is empty.
"""

from __future__ import annotations

import csv
import importlib
import io
import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import IO, Any

from advsearch.described import Value
from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonObject, JsonValue
from advsearch.runs.files import placed_by, replacing
from advsearch.runs.store import Row, Store

FORMATS = ("csv", "json", "parquet")

PAYLOAD = "payload"
OWN = (
    *("id", "kind", "step", "phase", "seed", "spp", "objective", "score", "success", "correct", "margin"),
    *("label", "label_index", "probability", PAYLOAD),
)
AFTER = ("renders", "machine", "seconds", "time")
"""Columns of the store before and after the values."""

GROUP = 8192
"""Rows of a Parquet row group, and so what is held in memory at once."""


def write_rows(store: Store, format: str, out: Path | None, stream: IO[bytes], kind: str | None = None) -> int:
    """Write the rows and return how many there were.

    Args:
        store: of the run.
        format: one of `FORMATS`.
        out: the file, written whole or not at all; None writes to the stream.
        stream: standard output, say.
        kind: only rows of this kind.

    Raises:
        UnknownNameError: the format or the kind is unknown.
        InputError: Parquet is asked for and pyarrow is not installed.
        StorageError: the file cannot be written.
    """
    if format not in FORMATS:
        raise UnknownNameError("format", format, FORMATS)
    counts = store.counts()
    if kind is not None and kind not in counts:
        raise UnknownNameError("kind of rows", kind, counts)
    write = {"csv": _csv, "json": _json, "parquet": _parquet}[format]
    names = as_columns(store.rows(kind))
    if out is None:
        write(_records(store.rows(kind)), names, stream)
    else:
        with placed_by("out"), replacing(out) as part, part.open("wb") as file:
            write(_records(store.rows(kind)), names, file)
    return counts[kind] if kind is not None else sum(counts.values())


def as_columns(rows: Iterable[Row]) -> list[str]:
    """Return the columns of a table of these rows; metrics and values in the order in which they first occur."""
    metrics: dict[str, None] = {}
    seen: dict[str, None] = {}
    for row in rows:
        metrics |= dict.fromkeys(row.metrics)
        seen |= dict.fromkeys(_values(row.values))
    return [*OWN, *metrics, *seen, *AFTER]


def as_record(row: Row) -> JsonObject:
    """Return a row as column to value."""
    own = {one.name: getattr(row, one.name) for one in fields(row) if one.name not in ("values", "metrics")}
    return own | dict(row.metrics) | _values(row.values)


def to_pandas(rows: Iterable[Row]) -> Any:
    """Return rows as a `pandas.DataFrame`, with the columns of an export under plain names.

    A value is called ``pose.yaw``, and ``attrs["units"]["pose.yaw"]`` says its unit: "degrees".

    Raises:
        InputError: pandas is not installed.
    """
    pandas, listed = _pandas(), list(rows)
    names = {one: one.partition(" [")[0] for one in as_columns(listed)}
    units = {plain: one.removeprefix(f"{plain} [").removesuffix("]") for one, plain in names.items() if plain != one}
    records = [{names[name]: value for name, value in as_record(row).items()} for row in listed]
    frame = pandas.DataFrame(records, columns=list(names.values()))
    frame.attrs = {"units": units}
    return frame


def table_to_pandas(rows: Sequence[JsonObject]) -> Any:
    """Return a table of a result as a `pandas.DataFrame`: a column for each value, named ``average.accuracy``.

    Raises:
        InputError: pandas is not installed.
    """
    pandas, flat = _pandas(), [dict(_leaves(row)) for row in rows]
    return pandas.DataFrame(flat, columns=list(dict.fromkeys(name for row in flat for name in row)))


def _leaves(values: JsonObject, before: str = "") -> Iterator[tuple[str, JsonValue]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{before}{name}.")
        else:
            yield before + name, value


def _pandas() -> Any:
    try:
        return importlib.import_module("pandas")
    except ImportError:
        raise InputError("to_pandas: needs pandas; pip install pandas, or export the run as csv or parquet") from None


def _records(rows: Iterable[Row]) -> Iterator[JsonObject]:
    return (as_record(row) for row in rows)


def _values(values: Mapping[str, Value | JsonValue]) -> JsonObject:
    """Column to number or text."""
    found: JsonObject = {}
    for name, told in values.items():
        value, unit = (told.get("value"), told.get("unit", "")) if isinstance(told, Mapping) else (told, "")
        suffix = f" [{unit}]" if unit else ""
        if isinstance(value, (list, tuple)):
            found |= {f"{name}[{number}]{suffix}": inner for number, inner in enumerate(value)}
        else:
            found[f"{name}{suffix}"] = value
    return found


def _csv(records: Iterable[JsonObject], names: list[str], stream: IO[bytes]) -> None:
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in _flat(one).items()} for one in records)
    text.detach()


def _flat(record: JsonObject) -> JsonObject:
    """The record with its payload as a text."""
    payload = record[PAYLOAD]
    return record if payload is None else {**record, PAYLOAD: json.dumps(payload, allow_nan=False, ensure_ascii=False)}


def _cell(value: JsonValue) -> JsonValue:
    return "" if value is None else int(value) if isinstance(value, bool) else value


def _json(records: Iterable[JsonObject], names: list[str], stream: IO[bytes]) -> None:
    stream.write(b"[")
    for number, one in enumerate(records):
        line = json.dumps({name: one.get(name) for name in names}, allow_nan=False, ensure_ascii=False)
        stream.write((",\n " if number else "\n ").encode() + line.encode())
    stream.write(b"\n]\n")


def _parquet(records: Iterable[JsonObject], names: list[str], stream: IO[bytes]) -> None:
    try:
        # comes with the extra `parquet`
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InputError("format parquet: needs pyarrow; pip install pyarrow, or choose csv or json") from None
    rows = map(_flat, records)
    first = list(itertools.islice(rows, GROUP))
    schema = pyarrow.schema([(name, _arrow_type(name, first, pyarrow)) for name in names])
    with pyarrow.parquet.ParquetWriter(stream, schema) as writer:
        while first:
            told = {name: [_as(one.get(name), schema.field(name).type, pyarrow) for one in first] for name in names}
            writer.write_table(pyarrow.table(told, schema))
            first = list(itertools.islice(rows, GROUP))


def _arrow_type(name: str, rows: Sequence[JsonObject], pyarrow: Any) -> Any:
    """Type of a column: by its name in the store, by its first values otherwise."""
    declared = {one.name: str(one.type) for one in fields(Row)}.get(name)
    if name == PAYLOAD:
        return pyarrow.string()
    if declared is not None:
        kinds = (("str", pyarrow.string()), ("bool", pyarrow.bool_()), ("int", pyarrow.int64()))
        return next((arrow for text, arrow in kinds if declared.startswith(text)), pyarrow.float64())
    texts = any(isinstance(one.get(name), str) for one in rows)
    return pyarrow.string() if texts else pyarrow.float64()


def _as(value: Any, wanted: Any, pyarrow: Any) -> Any:
    if value is None:
        return None
    return str(value) if wanted == pyarrow.string() else float(value) if wanted == pyarrow.float64() else value
