"""`advsearch export`: a run's rows as a table for other programs."""

from __future__ import annotations

import argparse
import io
import os
import sys
from pathlib import Path
from typing import Any

from advsearch.cli import output
from advsearch.cli.screen import output_errors
from advsearch.errors import InputError

HELP = "write a run's evaluated configurations as a table: CSV, JSON or Parquet"

_EXAMPLES = """examples:
  advsearch export mug-texture-001
  advsearch export runs/mug-texture-001 --kind search --out search.parquet
"""


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "export",
        help=HELP,
        description=HELP[0].upper() + HELP[1:] + ".",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("run", metavar="RUN", help="a run's name or folder")
    parser.add_argument("--format", help="csv, json or parquet (default: by the name of --out, or csv)")
    parser.add_argument("--out", metavar="FILE", help="the file to write (default: standard output)")
    parser.add_argument(
        "--json", action="store_true", help="the same as --format json; with --out, tell what was written"
    )
    parser.add_argument("--kind", help="only rows of this kind: search, baseline, sweep, ... (default: all)")


def run(args: argparse.Namespace) -> int:
    """Write the table."""
    from advsearch.runs.directory import PARTS, find_run
    from advsearch.runs.export import FORMATS, export
    from advsearch.runs.store import NAME, Store

    out = None if args.out is None else Path(args.out)
    by_name = "" if out is None else out.suffix.removeprefix(".").lower()
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
        count = export(store, format, out, on_screen or sys.stdout.buffer, args.kind)
    if on_screen is not None:
        print(on_screen.getvalue().decode("utf-8", "replace"), end="")
    if out is not None and args.json:
        output.print_json({"schema": 1, "command": "export", "rows": count, "format": format, "out": str(out)})
    elif out is not None:
        print(f"{count} rows in {out}", file=sys.stderr)
    return 0
