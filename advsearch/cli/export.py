"""`advsearch export`: a run's rows as a table for other programs."""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Callable
from pathlib import Path

from advsearch.cli import output
from advsearch.cli.output import at_work, output_errors
from advsearch.errors import InputError

Written = tuple[dict[str, object], str]
"""What to tell of a file, as JSON and in words."""

USUAL_SIZE = 100.0
"""Longest side of a printed object where nobody says it, in millimetres."""

SUFFIXES = {"pdf": "print", "xml": "mitsuba", "glb": "gltf"}
"""Formats that are not called as their files end."""

HELP = "export a run: its rows as a table, a texture for printing, a scene for Mitsuba or an object as glTF"
EXAMPLES = (
    "export mug-texture-001",
    "export runs/mug-texture-001 --kind search --out search.parquet",
    "export mug-sweep-001 --format 3db --out folder",
    "export mug-sweep-001 --format fiftyone --out folder",
    "export mug-patch-001 --format print --size 95 --out sheets.pdf",
    "export mug-texture-001 --format mitsuba --out folder",
    "export mug-texture-001 --format gltf --out mug.glb",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="a run's name or folder")
    names = ", ".join([*WRITERS, "csv", "json", "parquet"])
    parser.add_argument("--format", help=f"{names} (default: by the name of --out, or csv)")
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
    format = args.format or SUFFIXES.get(by_name, by_name)
    for name in ("size", "sheets", "paper", "icc"):
        if format != "print" and getattr(args, name) is not None:
            raise InputError(f"--{name}: belongs to --format print; leave it out")
    if format not in WRITERS:
        return _table(args, out, by_name)
    expected, write = WRITERS[format]
    if out is None:
        raise InputError(f"--out: {format} writes {expected}; give its name")
    if args.kind is not None and format != "3db":
        raise InputError("--kind: belongs to tables of rows; leave it out")
    told, text = write(args, out)
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


def _threedb(args: argparse.Namespace, out: Path) -> Written:
    """Write a folder as 3DB does."""
    # late, so that --help answers at once
    from advsearch.runs.directory import find_run
    from advsearch.runs.store import NAME, Store
    from advsearch.runs.threedb import write_threedb
    from advsearch.viewer.thumbnails import kept_pictures

    folder = find_run(args.run)
    kept = kept_pictures(folder)
    with Store(folder / NAME, read_only=True) as store:
        picture = kept.png_of if kept else lambda _: None
        count = write_threedb(lambda: store.rows(args.kind or "sweep"), out, picture)
    return {"rows": count}, f"{count} rows in {out}; look at them with: python -m threedboard {out}"


def _fiftyone(args: argparse.Namespace, out: Path) -> Written:
    """Write a dataset of the pictures that were kept."""
    # late, so that --help answers at once
    from advsearch.runs.directory import find_run
    from advsearch.runs.fiftyone import write_fiftyone
    from advsearch.viewer.thumbnails import name_of_object, pictured

    folder = find_run(args.run)
    count = write_fiftyone(lambda: pictured(folder), out, folder.resolve().name, name_of_object(folder))
    return {"samples": count}, f"{count} samples in {out}, a fiftyone.types.FiftyOneDataset"


def _print(args: argparse.Namespace, out: Path) -> Written:
    """Write the sheets."""
    longest = USUAL_SIZE if args.size is None else args.size
    with at_work(as_json=True, quiet=False):
        # late, so that --help answers at once
        from advsearch.api.export import printable
        from advsearch.report.sheets import MOST_SHEETS, write_sheets
        from advsearch.runs.files import placed_by, replacing

        pieces = printable(args.run, longest)
        profile = None if args.icc is None else Path(args.icc)
        title = f"{Path(args.run).name}, object of {longest:g} mm"
        with placed_by("out"), replacing(out) as part:
            paper, most = (args.paper or "a4").lower(), MOST_SHEETS if args.sheets is None else args.sheets
            pages = write_sheets(part, pieces, title, paper=paper, profile=profile, most=most)
    sizes = [{"name": piece.name, "width_mm": piece.size[0], "height_mm": piece.size[1]} for piece in pieces]
    text = f"{pages} pages in {out}; print them at 100 % and measure the square on the first"
    if args.size is None:
        text += f"\nThe real object's longest side is taken for {longest:g} mm; --size says otherwise."
    return {"pages": pages, "size_mm": longest, "pieces": sizes}, text


def _mitsuba(args: argparse.Namespace, out: Path) -> Written:
    """Write the adversarial scene."""
    with at_work(as_json=True, quiet=False):
        # late, so that --help answers at once
        from advsearch.api.export import write_mitsuba

        notes = write_mitsuba(args.run, out)
    return {"notes": notes}, " ".join([f"The scene is in {out}.", *notes])


def _gltf(args: argparse.Namespace, out: Path) -> Written:
    """Write the adversarial object."""
    with at_work(as_json=True, quiet=False):
        # late, so that --help answers at once
        from advsearch.api.export import write_gltf

        notes = write_gltf(args.run, out)
    return {"notes": notes}, " ".join([f"The object is in {out}.", *notes])


WRITERS: dict[str, tuple[str, Callable[[argparse.Namespace, Path], Written]]] = {
    "3db": ("a folder", _threedb),
    "fiftyone": ("a folder", _fiftyone),
    "print": ("a PDF file", _print),
    "mitsuba": ("an XML file and what belongs to it, or a new folder for them", _mitsuba),
    "gltf": ("a .glb file", _gltf),
}
"""What is no table, by the word of `--format`: what is written, and how."""
