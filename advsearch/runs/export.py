"""Write the rows of a run for other programs, and read folders of 3DB.

A table (CSV, JSON, Parquet) has a line for each row, and a column for each metric and
each value. The name of a column contains the unit: ``pose.yaw [degrees]``,
``camera.target[0]`` (docs/runs.md). A folder of 3DB (Leclerc et al. 2021) contains
`details.log` with a JSON object in each line, `class_maps.json`, and the images as
``images/<id>_rgb.png``.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import IO, Any, TypeGuard

from advsearch.errors import FileFormatError, InputError, UnknownNameError
from advsearch.files import JsonObject, JsonValue
from advsearch.options import Value
from advsearch.runs.store import Row, Store
from advsearch.trust.stored_files import open_regular, parse_json, read_text
from advsearch.trust.writing import name_setting_in_errors, replace_file

FORMATS = ("csv", "json", "parquet")
PAYLOAD = "payload"
# writes records as a table with named columns to a stream
WriteTable = Callable[[Iterable[JsonObject], list[str], IO[bytes]], None]
LEADING_COLUMNS = (
    *(
        "id",
        "kind",
        "step",
        "phase",
        "seed",
        "spp",
        "objective",
        "score",
        "success",
        "correct",
        "margin",
    ),
    *("label", "label_index", "probability", PAYLOAD),
)
# The columns before and after those of metrics and values.
TRAILING_COLUMNS = ("renders", "machine", "seconds", "time")
# Number of rows in a row group of Parquet, which are in memory at the same time.
ROWS_PER_GROUP = 8192


def write_rows(
    store: Store,
    format: str,
    out: Path | None,
    stream: IO[bytes],
    kind: str | None = None,
) -> int:
    """Write the rows of a run as a table, and return how many there were.

    Args:
        store: store of the run, which has the rows.
        format: "csv", "json" or "parquet".
        out: the file, which is written completely or not at all; None to write to
            `stream`.
        stream: open binary stream, such as standard output.
        kind: kind of the rows to write; None for all.

    Raises:
        UnknownNameError: there is no such format or kind.
    """
    write_table = _find_writer(format)
    counts = store.count_by_kind()
    if kind is not None and kind not in counts:
        raise UnknownNameError("kind of rows", kind, counts)
    # all rows are read twice, since the columns have to be known first
    names = list_columns(store.rows(kind))
    if out is None:
        write_table(map(make_record, store.rows(kind)), names, stream)
    else:
        with (
            name_setting_in_errors("out"),
            replace_file(out) as part,
            part.open("wb") as file,
        ):
            write_table(map(make_record, store.rows(kind)), names, file)
    return counts[kind] if kind is not None else sum(counts.values())


def _find_writer(format: str) -> WriteTable:
    """Return the function that writes a table in a format.

    Raises:
        UnknownNameError: there is no such format.
    """
    if format not in FORMATS:
        raise UnknownNameError("format", format, FORMATS)
    writers = {"csv": _write_csv, "json": _write_json, "parquet": _write_parquet}
    return writers[format]


def list_columns(rows: Iterable[Row]) -> list[str]:
    """Return the names of the columns of a table of rows.

    Metrics and values stand between the fixed columns, in the order in which they first
    occur.
    """
    # the keys of these dictionaries serve as ordered sets
    metrics = dict[str, None]()
    values = dict[str, None]()
    for row in rows:
        metrics |= dict.fromkeys(row.metrics)
        values |= dict.fromkeys(_flatten_values(row.values))
    return [*LEADING_COLUMNS, *metrics, *values, *TRAILING_COLUMNS]


def make_record(row: Row) -> JsonObject:
    """Return a row as values by column, with a column for each metric and value."""
    columns = {
        field.name: getattr(row, field.name)
        for field in fields(row)
        if field.name not in ("values", "metrics")
    }
    return columns | dict(row.metrics) | _flatten_values(row.values)


def iterate_values(
    values: Mapping[str, Value | JsonValue],
) -> Iterator[tuple[str, JsonValue, str]]:
    """Yield column, value and unit of each value of a row.

    A value of several numbers has a column for each, such as ``camera.target[0]``.

    Args:
        values: by parameter, a mapping such as {"value": 130.0, "unit": "degrees"}, or
            the value alone, which has no unit.
    """
    for name, entry in values.items():
        value, unit = _split_unit(entry)
        if isinstance(value, (list, tuple)):
            yield from (
                (f"{name}[{index}]", component, unit)
                for index, component in enumerate(value)
            )
        else:
            yield name, value, unit


def _split_unit(entry: Value | JsonValue) -> tuple[Any, str]:
    """Return a value of a row and its unit; a value alone has no unit."""
    if isinstance(entry, Mapping):
        return entry.get("value"), str(entry.get("unit") or "")
    return entry, ""


def _flatten_values(values: Mapping[str, Value | JsonValue]) -> JsonObject:
    """Return values by column, whose name has the unit: "pose.yaw [degrees]"."""
    return {
        f"{name} [{unit}]" if unit else name: value
        for name, value, unit in iterate_values(values)
    }


def _write_csv(
    records: Iterable[JsonObject], names: list[str], stream: IO[bytes]
) -> None:
    """Write records as CSV; a missing value is empty, and a bool is 0 or 1.

    Args:
        records: a record for each row.
        names: names of the columns.
        stream: open binary stream, which stays open.
    """
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    for record in records:
        cells = {
            name: int(value) if isinstance(value, bool) else value
            for name, value in _encode_payload(record).items()
        }
        writer.writerow(cells)
    # A text wrapper closes its stream when it is deleted, unless it is detached.
    text.detach()


def _encode_payload(record: JsonObject) -> JsonObject:
    """Return a record with its payload as JSON text."""
    payload = record[PAYLOAD]
    if payload is None:
        return record
    text = json.dumps(payload, allow_nan=False, ensure_ascii=False)
    return {**record, PAYLOAD: text}


def _write_json(
    records: Iterable[JsonObject], names: list[str], stream: IO[bytes]
) -> None:
    """Write records as one JSON array, a record on each line.

    Args:
        records: a record for each row.
        names: names of the columns; a record without one has null.
        stream: open binary stream.
    """
    stream.write(b"[")
    for number, record in enumerate(records):
        line = json.dumps(
            {name: record.get(name) for name in names},
            allow_nan=False,
            ensure_ascii=False,
        )
        separator = ",\n " if number > 0 else "\n "
        stream.write(f"{separator}{line}".encode())
    stream.write(b"\n]\n")


def _write_parquet(
    records: Iterable[JsonObject], names: list[str], stream: IO[bytes]
) -> None:
    """Write records as Parquet.

    They are written in groups of `ROWS_PER_GROUP`, so that no more are in memory. The
    types of columns follow from the first group.
    """
    pyarrow = _import_pyarrow()
    rows = map(_encode_payload, records)
    group = list(itertools.islice(rows, ROWS_PER_GROUP))
    schema = _make_schema(names, group)
    with pyarrow.parquet.ParquetWriter(stream, schema) as writer:
        while group:
            columns = _make_columns(group, names, schema.types)
            writer.write_table(pyarrow.table(columns, schema))
            group = list(itertools.islice(rows, ROWS_PER_GROUP))


def _import_pyarrow() -> Any:
    """Return the package that writes Parquet.

    Raises:
        InputError: it is not installed.
    """
    try:
        # comes with the extra `parquet`
        import pyarrow.parquet
    except ImportError:
        raise InputError(
            "format parquet: needs pyarrow; pip install pyarrow, or choose csv or json"
        ) from None
    return pyarrow


def _make_columns(
    group: Sequence[JsonObject], names: Sequence[str], arrow_types: Sequence[Any]
) -> dict[str, list[Any]]:
    """Return a group of records as columns with values of their types.

    Args:
        group: the records.
        names: names of the columns.
        arrow_types: types of the columns, of Arrow.
    """
    columns: dict[str, list[Any]] = {}
    for name, arrow_type in zip(names, arrow_types, strict=True):
        values = [record.get(name) for record in group]
        columns[name] = _convert_column(values, arrow_type)
    return columns


def _make_schema(names: list[str], first_records: Sequence[JsonObject]) -> Any:
    """Return the Arrow schema of a table.

    Fixed columns have the type that `Row` declares. The column of a metric or a value
    is text if one of the first records has text in it, else float64.

    Args:
        names: names of the columns.
        first_records: the first records of the table.
    """
    # an optional package
    import pyarrow

    arrow_types = {
        "str": pyarrow.string(),
        "bool": pyarrow.bool_(),
        "int": pyarrow.int64(),
        "float": pyarrow.float64(),
    }
    type_of_column = {}
    for field in fields(Row):
        # annotations are texts: "int | None" gives "int"
        python_type = str(field.type).partition(" ")[0]
        type_of_column[field.name] = arrow_types.get(python_type, arrow_types["str"])
    for name in set(names) - {*LEADING_COLUMNS, *TRAILING_COLUMNS}:
        has_text = any(isinstance(record.get(name), str) for record in first_records)
        type_of_column[name] = arrow_types["str" if has_text else "float"]
    return pyarrow.schema([(name, type_of_column[name]) for name in names])


def _convert_column(values: list[Any], arrow_type: Any) -> list[Any]:
    """Return the values of a column in the type of the column.

    Values of text and float columns are converted, and None stays. Other columns have
    values of their type already.
    """
    # an optional package
    import pyarrow

    if arrow_type == pyarrow.string():
        convert: Any = str
    elif arrow_type == pyarrow.float64():
        convert = float
    else:
        return values
    return [None if value is None else convert(value) for value in values]


DETAILS = "details.log"
CLASSES = "class_maps.json"
IMAGES = "images"
MAX_LOG_BYTES = 4 << 30
MAX_LINE_BYTES = 1 << 20  # maximum size of a line of `details.log`
MAX_CLASSES_BYTES = 16 << 20  # maximum size of `class_maps.json`


def read_threedb(folder: Path) -> Iterator[tuple[Row, Path | None]]:
    """Yield the lines of a 3DB log as rows of a sweep.

    Args:
        folder: folder that 3DB has written, with `details.log`.

    Yields:
        A row, and the file of its picture, or None if there is none.

    Raises:
        FileFormatError: the classes or a line are not as 3DB writes them; it names the
            line.
    """
    class_names = _read_classes(folder / CLASSES)
    with _open_log(folder) as file:
        for number in itertools.count():
            # one byte more than allowed shows that a line is too long
            line = file.readline(MAX_LINE_BYTES + 1)
            if not line:  # the end of the file; an empty line has its line break
                return
            _check_line_length(folder, number, line)
            if line.strip():
                yield _parse_line(folder, number, line, class_names)


def _check_line_length(folder: Path, number: int, line: bytes) -> None:
    """Raise an error if a line of 3DB's log is too long; see `_parse_line`."""
    if len(line) > MAX_LINE_BYTES:
        reason = f"more than {MAX_LINE_BYTES} bytes"
        raise _make_line_error(folder, number, reason)


def _open_log(folder: Path) -> IO[bytes]:
    """Open the log of 3DB in a folder.

    Raises:
        FileFormatError: it cannot be opened.
    """
    try:
        return open_regular(folder / DETAILS, "the log of 3DB", MAX_LOG_BYTES)
    except OSError as error:
        raise FileFormatError(
            f"{folder / DETAILS}: expected the log of 3DB, got {error.strerror}"
        ) from None


def _read_classes(path: Path) -> list[str]:
    """Return the names of classes by index, from a file of 3DB.

    The list is empty if there is no such file.

    Raises:
        FileFormatError: the file has something else than a list.
    """
    try:
        classes = parse_json(read_text(path, "the classes of 3DB", MAX_CLASSES_BYTES))
        if not isinstance(classes, list):
            raise ValueError(type(classes).__name__)
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise FileFormatError(
            f"{path}: expected a list of names, got {error}"
        ) from None
    return list(map(str, classes))


def _parse_line(
    folder: Path, number: int, line: bytes, classes: Sequence[str]
) -> tuple[Row, Path | None]:
    """Return a line of 3DB's log as a row, and the file of its picture, if any.

    Args:
        folder: folder that 3DB has written.
        number: number of the line from 0, which becomes the step of the row.
        line: the line, a JSON object.
        classes: names of classes by index.

    Raises:
        FileFormatError: the line is not as 3DB writes it.
    """
    record, render_args = _parse_record(folder, number, line)
    label, label_index = _parse_prediction(record.get("prediction"), classes)
    loss = record.get("loss")
    row = Row(
        "sweep",
        number,
        # 3DB writes true, or the text "True"
        correct=str(record.get("is_correct")) == "True",
        # A loss is large if the model is wrong, a margin if it is right, so the sign
        # changes. It is 0.0 - loss and not -loss, which would be -0.0 for 0.
        margin=0.0 - loss if isinstance(loss, (int, float)) else None,
        label=label,
        label_index=label_index,
        values=_import_values(record, render_args),
    )
    return row, _find_picture(folder, str(record.get("id")))


def _parse_record(
    folder: Path, number: int, line: bytes
) -> tuple[JsonObject, JsonObject]:
    """Return the JSON object of a line, and the parameters in it.

    See `_parse_line` for the arguments.

    Raises:
        FileFormatError: the line has no such object.
    """
    try:
        record = parse_json(line.decode())
    except ValueError as error:
        raise _make_line_error(folder, number, str(error)) from None
    render_args = record.get("render_args") if isinstance(record, dict) else None
    if not isinstance(record, dict) or not isinstance(render_args, dict):
        raise _make_line_error(folder, number, "a line without render_args")
    return record, render_args


def _import_values(record: JsonObject, render_args: JsonObject) -> dict[str, Value]:
    """Return the parameters of a line of 3DB's log by name.

    Each number of a list has its own entry, with its index behind the name, such as
    "NAME[0]".

    Args:
        record: the line, which names object and environment.
        render_args: further parameters in it.
    """
    # 3DB calls the object "model", and the model "network"
    values: dict[str, Value] = {
        "object": _make_value(record.get("model")),
        "environment": _make_value(record.get("environment")),
    }
    for name, value in render_args.items():
        if isinstance(value, list):
            for index, component in enumerate(value):
                values[f"{name}[{index}]"] = _make_value(component)
        else:
            values["model" if name == "network" else name] = _make_value(value)
    return values


def _parse_prediction(
    prediction: JsonValue, classes: Sequence[str]
) -> tuple[str, int | None]:
    """Return label and index of the class that was predicted, as 3DB's log states it.

    Args:
        prediction: an index, or a list with the best one first.
        classes: the names by index; a class without a name is called by its index.

    Returns:
        "" and None if no class was predicted.
    """
    best = prediction
    if isinstance(prediction, list) and prediction:
        best = prediction[0]
    if not _is_number(best):
        return "", None
    index = int(best)
    has_name = 0 <= index < len(classes)
    return classes[index] if has_name else str(index), index


def _find_picture(folder: Path, image_id: str) -> Path | None:
    """Return the file of a picture; None if it is missing or a link, or its id is no
    plain file name.
    """
    if re.fullmatch(r"[A-Za-z0-9_-]{1,100}", image_id) is None:
        return None
    path = folder / IMAGES / f"{image_id}_rgb.png"
    return path if path.is_file() and not path.is_symlink() else None


def _is_number(value: JsonValue) -> TypeGuard[int | float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _make_value(value: JsonValue) -> Value:
    return {"value": value if _is_number(value) else str(value), "unit": ""}


def _make_line_error(folder: Path, number: int, got: str) -> FileFormatError:
    return FileFormatError(
        f"{folder / DETAILS}: line {number + 1}: expected a line of "
        f"3DB's log, got {got[:120]}"
    )
