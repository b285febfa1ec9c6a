"""`advsearch export`: write the rows of a run as a table for other programs, or its
images, its scene or its object in another format.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Mapping
from pathlib import Path

from advsearch.cli import output
from advsearch.cli.main import argument, command
from advsearch.cli.output import output_errors
from advsearch.errors import InputError, UnknownNameError
from advsearch.runs.directory import PARTS, find_run
from advsearch.runs.export import FORMATS, write_rows
from advsearch.runs.exporters import EXPORTERS, Exporter
from advsearch.runs.store import NAME, Store

OPTIONS = ("all", "size", "sheets", "paper", "icc")
"""Flags that belong to some formats only."""


def _add_format(parser: argparse.ArgumentParser) -> None:
    lines = [f"{name}: {_begin_lower(EXPORTERS.get_help(name))}" for name in EXPORTERS]
    text = (
        f"csv, json or parquet: the rows as a table; {'; '.join(lines)} (default: "
        "by the name of --out, or csv)"
    )
    parser.add_argument("--format", help=text.replace("%", "%%"))


def _begin_lower(sentence: str) -> str:
    """Return a sentence as a clause: with a small first letter, and without a period."""
    return f"{sentence[:1].lower()}{sentence[1:].rstrip('.')}"


@command(
    argument("run", metavar="RUN", help="a run's name or folder"),
    _add_format,
    argument(
        "--out", metavar="FILE", help="the file to write (default: standard output)"
    ),
    argument(
        "--json",
        action="store_true",
        help="the same as --format json; with --out, print what was written as JSON",
    ),
    argument(
        "--kind",
        help="only rows of this kind: search, baseline, sweep, ... (default: all)",
    ),
    argument(
        "--size",
        metavar="MM",
        type=float,
        help="print: the real object's longest side in millimetres (default: that of "
        "the object's file if it is known, otherwise 100)",
    ),
    argument(
        "--sheets",
        metavar="N",
        type=int,
        help="print: maximum number of sheets; more are an error (default: 200)",
    ),
    argument("--paper", help="print: a4, a3 or letter (default: a4)"),
    argument(
        "--all",
        action="store_true",
        default=None,
        help="coco, yolo: all pictures (default: only those about which a model is "
        "wrong)",
    ),
    output.add_code_flag,
    argument(
        "--icc",
        metavar="FILE",
        help="print: ICC profile of an RGB printer (default: sRGB)",
    ),
    examples=(
        "export mug-texture-001",
        "export runs/mug-texture-001 --kind search --out search.parquet",
        *(EXPORTERS[name].example for name in EXPORTERS.built_ins),
    ),
)
def export(args: argparse.Namespace) -> int:
    """Write a run in another format, as the arguments say, and return the exit status.

    Raises:
        InputError, UnknownNameError: the format does not exist, or a flag does not
            belong to it.
    """
    out = None if args.out is None else Path(args.out)
    # the suffix of the file, such as "csv", which may name the format
    file_suffix = "" if out is None else out.suffix.removeprefix(".").lower()
    usable = EXPORTERS.list_usable()
    format = _choose_format(args, file_suffix, usable)
    _reject_other_options(args, format, usable)
    # If the suffix of the file is that of no format, a table is written.
    is_table = format in FORMATS or format not in EXPORTERS
    if is_table:
        return _write_table(args, out, file_suffix)
    return _write_other_format(args, out, format)


def _write_other_format(args: argparse.Namespace, out: Path | None, format: str) -> int:
    """Write a run in a format that is no table, and return the exit status.

    Args:
        args: arguments of the command.
        out: the file or folder to write; None without ``--out``, which is an error.
        format: name of an exporter.

    Raises:
        InputError: a flag is missing, or does not belong to the format.
    """
    exporter = EXPORTERS[format]()
    if out is None:  # all but tables are files or folders, which nothing can print
        raise InputError(f"--out: {format} writes {exporter.writes}; give its name")
    if args.kind is not None and "kind" not in exporter.options:
        raise InputError("--kind: is only for tables of rows; leave it out")
    options = {option: getattr(args, option, None) for option in exporter.options}
    with output.open_answer_progress() as progress:
        exported = exporter.write(args.run, out, options, progress)
    facts = {"command": "export", "format": format, **exported.facts, "out": str(out)}
    return output.print_answer(args.json, facts, exported.text, sys.stderr)


def _reject_other_options(
    args: argparse.Namespace, format: str, usable: Mapping[str, type[Exporter]]
) -> None:
    """Raise an error if a flag was given that belongs to other formats only.

    Args:
        args: arguments of the command.
        format: the format.
        usable: exporters by the name of their format.

    Raises:
        InputError: there is such a flag.
    """
    for option in OPTIONS:
        owners = [
            name for name, exporter in usable.items() if option in exporter.options
        ]
        if format not in owners and getattr(args, option) is not None:
            raise InputError(
                f"--{option}: belongs to --format {' and '.join(owners)}; leave it out"
            )


def _choose_format(
    args: argparse.Namespace, file_suffix: str, usable: Mapping[str, type[Exporter]]
) -> str:
    """Return the format that ``--format`` names, or else the suffix of the file.

    A suffix that belongs to no format is returned as it is: the caller then writes a
    table.

    Args:
        args: arguments of the command.
        file_suffix: suffix of the file, such as "csv"; empty without a file.
        usable: exporters by the name of their format.

    Raises:
        InputError: ``--format`` names a format that was removed.
        UnknownNameError: ``--format`` names no format.
    """
    format: str = args.format or _find_format_of_suffix(file_suffix, usable)
    if format == "fiftyone":
        raise InputError(
            "--format: fiftyone was removed, since FiftyOne reads COCO; "
            "use --format coco"
        )
    if args.format and format not in (*EXPORTERS, *FORMATS):
        raise UnknownNameError("format", format, (*EXPORTERS, *FORMATS))
    return format


def _find_format_of_suffix(
    file_suffix: str, usable: Mapping[str, type[Exporter]]
) -> str:
    """Return the format of files with a suffix; the suffix itself if there is none."""
    format_of_suffix = {table: table for table in FORMATS}
    for name, exporter in usable.items():
        # setdefault: an exporter of another package gets no suffix that is taken
        format_of_suffix.setdefault(exporter.suffix or name, name)
    return format_of_suffix.get(file_suffix, file_suffix)


def _write_table(args: argparse.Namespace, out: Path | None, file_suffix: str) -> int:
    """Write the rows of a run as a table to a file, or print them.

    Args:
        args: arguments of the command.
        out: the file; None prints the table.
        file_suffix: the suffix of the file, without its dot.

    Returns:
        The exit status.

    Raises:
        InputError: flags contradict each other, or the run is a study without rows.
    """
    format = args.format or _choose_table_format(args, out, file_suffix)
    _check_table_target(args, out, format)
    folder = find_run(args.run)
    _check_no_study(folder)
    count = _write_or_print_rows(folder, format, out, args.kind)
    if out is None:
        return output.OK
    text = f"{count} rows in {out}"
    if file_suffix != format:
        text += f", as {format}"
    facts = {"command": "export", "rows": count, "format": format, "out": str(out)}
    return output.print_answer(args.json, facts, text, sys.stderr)


def _check_table_target(
    args: argparse.Namespace, out: Path | None, format: str
) -> None:
    """Check that a table in this format can be written to a file, or printed.

    Raises:
        InputError: JSON is to be printed in another format, or the file is a folder.
    """
    if args.json and out is None and format != "json":
        raise InputError(
            f"--json: prints JSON, but --format asks for {format}; leave "
            "one of them out"
        )
    if out is not None and os.path.isdir(out):
        raise InputError(f"--out: expected the name of a file, got the folder {out}")


def _check_no_study(folder: Path) -> None:
    """Check that a run has rows of its own.

    Raises:
        InputError: it is a study, whose rows are in its parts.
    """
    if (folder / PARTS).is_dir():
        parts = ", ".join(map(str, sorted((folder / PARTS).iterdir())))
        raise InputError(
            f"{folder}: is a study, whose rows are those of its parts; "
            f"export one of {parts}"
        )


def _write_or_print_rows(
    folder: Path, format: str, out: Path | None, kind: str | None
) -> int:
    """Write the rows of a run as a table, and return their number.

    Args:
        folder: the run.
        format: one of `FORMATS`.
        out: the file; None prints the table.
        kind: kind of the rows; None for all.
    """
    # For a terminal the table goes through `print`, which escapes control characters;
    # else it is written as it is.
    is_for_terminal = out is None and sys.stdout.isatty()
    buffer = io.BytesIO()
    stream = buffer if is_for_terminal else sys.stdout.buffer
    with Store(folder / NAME, read_only=True) as store, output_errors():
        count = write_rows(store, format, out, stream, kind)
    if is_for_terminal:
        print(buffer.getvalue().decode("utf-8", "replace"), end="")
    return count


def _choose_table_format(
    args: argparse.Namespace, out: Path | None, file_suffix: str
) -> str:
    """Return the format of a table: "csv", "json" or another of `FORMATS`.

    The suffix of the file names it. Otherwise it is JSON if ``--json`` was given and
    the table is printed, and CSV if not.
    """
    if file_suffix in FORMATS:
        return file_suffix
    return "json" if args.json and out is None else "csv"
