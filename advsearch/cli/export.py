"""`advsearch export`: a run's rows as a table for other programs."""

from __future__ import annotations

import argparse
import io
import os
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from advsearch.cli import exports, output
from advsearch.cli.exports.print import USUAL_SIZE
from advsearch.cli.output import output_errors
from advsearch.errors import InputError

WRITERS = {
    module.FORMAT: module
    for module in (import_module(f"{exports.__name__}.{one.name}") for one in iter_modules(exports.__path__))
}
"""What is no table, by the word of `--format`: the modules of `advsearch.cli.exports`."""

HELP = "export a run: its rows as a table, a texture for printing, a scene for Mitsuba or an object as glTF"
EXAMPLES = (
    "export mug-texture-001",
    "export runs/mug-texture-001 --kind search --out search.parquet",
    *(module.EXAMPLE for module in WRITERS.values()),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="a run's name or folder")
    told = {format: (module.__doc__ or "").rstrip(".") for format, module in WRITERS.items()}
    known = "; ".join(f"{format}: {text[:1].lower()}{text[1:]}" for format, text in told.items())
    text = f"csv, json or parquet: the rows as a table; {known} (default: by the name of --out, or csv)"
    parser.add_argument("--format", help=text.replace("%", "%%"))
    parser.add_argument("--out", metavar="FILE", help="the file to write (default: standard output)")
    parser.add_argument(
        "--json", action="store_true", help="the same as --format json; with --out, tell what was written"
    )
    parser.add_argument("--kind", help="only rows of this kind: search, baseline, sweep, ... (default: all)")
    parser.add_argument(
        "--size", metavar="MM", type=float,
        help=f"print: the real object's longest side in millimetres (default: {USUAL_SIZE:g})",
    )  # fmt: skip
    parser.add_argument(
        "--sheets", metavar="N", type=int, help="print: sheets that may be written; more are refused (default: 200)"
    )
    parser.add_argument("--paper", help="print: a4, a3 or letter (default: a4)")
    parser.add_argument("--icc", metavar="FILE", help="print: ICC profile of an RGB printer (default: sRGB)")


def run(args: argparse.Namespace) -> int:
    """Write what was asked for."""
    out = None if args.out is None else Path(args.out)
    by_name = "" if out is None else out.suffix.removeprefix(".").lower()
    endings = {getattr(module, "ENDING", format): format for format, module in WRITERS.items()}
    format = args.format or endings.get(by_name, by_name)
    for name in ("size", "sheets", "paper", "icc"):
        if format != "print" and getattr(args, name) is not None:
            raise InputError(f"--{name}: belongs to --format print; leave it out")
    if format not in WRITERS:
        return _table(args, out, by_name)
    if out is None:
        raise InputError(f"--out: {format} writes {WRITERS[format].WRITES}; give its name")
    if args.kind is not None and format != "3db":
        raise InputError("--kind: belongs to tables of rows; leave it out")
    told, text = WRITERS[format].write(args, out)
    if args.json:
        output.print_json({"schema": 1, "command": "export", "format": format, **told, "out": str(out)})
    else:
        print(text, file=sys.stderr)
    return 0


def _table(args: argparse.Namespace, out: Path | None, by_name: str) -> int:
    """Write the rows."""
    # late, so that --help answers at once
    from advsearch.runs.directory import PARTS, find_run
    from advsearch.runs.export import FORMATS, write_rows
    from advsearch.runs.store import NAME, Store

    otherwise = by_name if by_name in FORMATS else "json" if args.json and out is None else "csv"
    format = args.format or otherwise
    if args.json and out is None and format != "json":
        raise InputError(f"--json: prints JSON, but --format asks for {format}; leave one of them out")
    if out is not None and os.path.isdir(out):
        raise InputError(f"--out: expected the name of a file, got the folder {out}")
    folder = find_run(args.run)
    if (folder / PARTS).is_dir():
        parts = ", ".join(str(one) for one in sorted((folder / PARTS).iterdir()))
        raise InputError(f"{folder}: is a study, whose rows are those of its parts; export one of {parts}")
    on_screen = io.BytesIO() if out is None and sys.stdout.isatty() else None
    with Store(folder / NAME, read_only=True) as store, output_errors():
        count = write_rows(store, format, out, on_screen or sys.stdout.buffer, args.kind)
    if on_screen is not None:
        print(on_screen.getvalue().decode("utf-8", "replace"), end="")
    if out is not None and args.json:
        output.print_json({"schema": 1, "command": "export", "rows": count, "format": format, "out": str(out)})
    elif out is not None:
        print(f"{count} rows in {out}", file=sys.stderr)
    return 0
