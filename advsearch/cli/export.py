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

HELP = "write a run's evaluated configurations as a table (CSV, JSON or Parquet), or its texture or patch for printing"

_EXAMPLES = """examples:
  advsearch export mug-texture-001
  advsearch export runs/mug-texture-001 --kind search --out search.parquet
  advsearch export mug-sweep-001 --format 3db --out folder
  advsearch export mug-patch-001 --format print --size 95 --out sheets.pdf
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
    parser.add_argument("--format", help="csv, json, parquet, 3db or print (default: by the name of --out, or csv)")
    parser.add_argument("--out", metavar="FILE", help="the file to write (default: standard output)")
    parser.add_argument(
        "--json", action="store_true", help="the same as --format json; with --out, tell what was written"
    )
    parser.add_argument("--kind", help="only rows of this kind: search, baseline, sweep, ... (default: all)")
    parser.add_argument("--size", metavar="MM", type=float, help="print: the real object's longest side in millimetres")
    parser.add_argument("--paper", help="print: a4, a3 or letter (default: a4)")
    parser.add_argument("--icc", metavar="FILE", help="print: ICC profile of an RGB printer (default: sRGB)")


def run(args: argparse.Namespace) -> int:
    """Write the table."""
    from advsearch.runs.directory import PARTS, find_run
    from advsearch.runs.export import FORMATS, export
    from advsearch.runs.store import NAME, Store

    out = None if args.out is None else Path(args.out)
    if args.format == "print" or (args.format is None and out is not None and out.suffix.lower() == ".pdf"):
        return _print(args, out)
    for name in ("size", "paper", "icc"):
        if getattr(args, name) is not None:
            raise InputError(f"--{name}: belongs to --format print; leave it out")
    if args.format == "3db":
        return _threedb(args, out)
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


def _threedb(args: argparse.Namespace, out: Path | None) -> int:
    """Write a folder as 3DB does."""
    from advsearch.runs.directory import find_run
    from advsearch.runs.store import NAME, Store
    from advsearch.runs.threedb import write_threedb
    from advsearch.viewer.thumbnails import kept_pictures

    if out is None:
        raise InputError("--out: 3db writes a folder; give its name")
    folder = find_run(args.run)
    kept = kept_pictures(folder)
    with Store(folder / NAME, read_only=True) as store:
        picture = kept.png_of if kept else lambda _: None
        count = write_threedb(lambda: store.rows(args.kind or "sweep"), out, picture)
    if args.json:
        output.print_json({"schema": 1, "command": "export", "rows": count, "format": "3db", "out": str(out)})
    else:
        print(f"{count} rows in {out}; look at them with: python -m threedboard {out}", file=sys.stderr)
    return 0


def _print(args: argparse.Namespace, out: Path | None) -> int:
    """Write the sheets."""
    from advsearch.cli.progress import at_work

    if out is None:
        raise InputError("--out: print writes a PDF file; give its name")
    if args.size is None:
        raise InputError("--size: how large is the real object? Give its longest side in millimetres: --size 95")
    if args.kind is not None:
        raise InputError("--kind: belongs to tables of rows; leave it out")
    with at_work(as_json=True, quiet=False):
        from advsearch.engine.printing import printable
        from advsearch.report.sheets import write_sheets
        from advsearch.runs.files import placed_by, replacing

        pieces = printable(args.run, args.size)
        profile = None if args.icc is None else Path(args.icc)
        title = f"{Path(args.run).name}, object of {args.size:g} mm"
        with placed_by("out"), replacing(out) as part:
            pages = write_sheets(part, pieces, title, paper=(args.paper or "a4").lower(), profile=profile)
    sizes = [{"name": piece.name, "width_mm": piece.size[0], "height_mm": piece.size[1]} for piece in pieces]
    if args.json:
        output.print_json(
            {"schema": 1, "command": "export", "format": "print", "pages": pages, "pieces": sizes, "out": str(out)}
        )
    else:
        print(f"{pages} pages in {out}; print them at 100 % and measure the square on the first", file=sys.stderr)
    return 0
