"""`advsearch export`: a run's rows as a table for other programs, or what else comes out of it in another format."""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from advsearch.cli import output
from advsearch.cli.main import argument, command
from advsearch.cli.output import at_work, output_errors
from advsearch.errors import InputError, UnknownNameError
from advsearch.options import rounded
from advsearch.runs.directory import PARTS, find_run
from advsearch.runs.export import FORMATS, write_rows, write_threedb
from advsearch.runs.store import NAME, Store
from advsearch.trust.writing import placed_by, replacing
from advsearch.viewer.thumbnails import kept_pictures

Written = tuple[dict[str, object], str]  # what to tell of a file, as JSON and in words


class Writer(NamedTuple):
    """What a run is exported as besides a table of its rows."""

    text: str  # what comes out, in a sentence
    writes: str  # what the name after `--out` is of: "a PDF file"
    example: str  # a command line without `advsearch` in front
    write: Callable[[argparse.Namespace, Path], Written]  # writes the run that the words of the command line name
    ending: str = ""  # of files that are of this format if no other is asked for: "pdf"; "" for none


def _dataset(args: argparse.Namespace, out: Path, format: str) -> Written:
    with at_work(as_json=True, quiet=False) as progress:
        from advsearch.api.dataset import write_dataset  # takes seconds

        count, notes = write_dataset(args.run, out, format, every=bool(args.all), progress=progress)
    if not count:
        raise InputError(f"{args.run}: no model is wrong in a picture of its rows; --all takes the others too")
    return {"pictures": count, "notes": notes}, " ".join([f"{count} pictures in {out}.", *notes])


def _scene(args: argparse.Namespace, out: Path, format: str) -> Written:
    with at_work(as_json=True, quiet=False):
        # take seconds
        from advsearch.api.export import write_gltf, write_mitsuba, write_projection

        write, begin, between = {
            "gltf": (write_gltf, f"The object is in {out}.", " "),
            "mitsuba": (write_mitsuba, f"The scene is in {out}.", " "),
            "projector": (write_projection, f"What to project is in {out}. Set:", "\n"),
        }[format]
        notes = write(args.run, out)
    return {"notes": notes}, between.join([begin, *notes])


USUAL_SIZE = 100.0  # longest side of a printed object whose size is not known, in millimetres


def _print(args: argparse.Namespace, out: Path) -> Written:
    with at_work(as_json=True, quiet=False):
        from advsearch.api.chart import chart_page  # draws with matplotlib
        from advsearch.api.export import printable, real_size  # takes seconds
        from advsearch.report.sheets import MOST_SHEETS, write_sheets  # draws with matplotlib

        known = real_size(args.run) if args.size is None else args.size
        longest = USUAL_SIZE if known is None else known
        pieces = printable(args.run, longest)
        profile = None if args.icc is None else Path(args.icc)
        title = f"{Path(args.run).name}, object of {rounded(longest)} mm"
        with placed_by("out"), replacing(out) as part:
            paper, most = (args.paper or "a4").lower(), MOST_SHEETS if args.sheets is None else args.sheets
            pages = write_sheets(part, pieces, title, paper=paper, profile=profile, most=most, last=chart_page)
    sizes = [{"name": piece.name, "width_mm": piece.size[0], "height_mm": piece.size[1]} for piece in pieces]
    text = f"{pages} pages in {out}; print them at 100 % and measure the square on the first"
    if known is None:
        text += f"\nThe real object's longest side is taken for {rounded(longest)} mm; --size says otherwise."
    return {"pages": pages, "size_mm": longest, "pieces": sizes}, text


def _threedb(args: argparse.Namespace, out: Path) -> Written:
    folder = find_run(args.run)
    kept = kept_pictures(folder)
    with Store(folder / NAME, read_only=True) as store:
        picture = kept.png_of if kept else lambda _: None
        count = write_threedb(lambda: store.rows(args.kind or "sweep"), out, picture)
    return {"rows": count}, f"{count} rows in {out}; look at them with: python -m threedboard {out}"


WRITERS = {
    "coco": Writer(
        "The pictures with boxes and masks, as COCO has them.", "a folder",
        "export mug-sweep-001 --format coco --out folder", partial(_dataset, format="coco"),
    ),
    "yolo": Writer(
        "The pictures with boxes, to train a YOLO.", "a folder", "export mug-sweep-001 --format yolo --out folder",
        partial(_dataset, format="yolo"),
    ),
    "gltf": Writer(
        "The adversarial object as glTF.", "a .glb file", "export mug-texture-001 --format gltf --out mug.glb",
        partial(_scene, format="gltf"), "glb",
    ),
    "mitsuba": Writer(
        "The adversarial scene for Mitsuba.", "an XML file and what belongs to it, or a new folder for them",
        "export mug-texture-001 --format mitsuba --out folder",
        partial(_scene, format="mitsuba"), "xml",
    ),
    "print": Writer(
        "A patch or texture as sheets to print.", "a PDF file",
        "export mug-patch-001 --format print --size 95 --out sheets.pdf", _print, "pdf",
    ),
    "projector": Writer(
        "A projector's picture, and marks to line it up.", "a new folder",
        "export mug-projector-001 --format projector --out folder",
        partial(_scene, format="projector"),
    ),
    "3db": Writer(
        "A sweep as a folder for 3DB's dashboard.", "a folder", "export mug-sweep-001 --format 3db --out folder",
        _threedb,
    ),
}  # fmt: skip
"""What is no table, by the word of `--format`."""


_KNOWN = "; ".join(f"{format}: {writer.text[0].lower()}{writer.text[1:-1]}" for format, writer in WRITERS.items())
FORMAT = f"csv, json or parquet: the rows as a table; {_KNOWN} (default: by the name of --out, or csv)"


@command(
    argument("run", metavar="RUN", help="a run's name or folder"),
    argument("--format", help=FORMAT.replace("%", "%%")),
    argument("--out", metavar="FILE", help="the file to write (default: standard output)"),
    argument("--json", action="store_true", help="the same as --format json; with --out, tell what was written"),
    argument("--kind", help="only rows of this kind: search, baseline, sweep, ... (default: all)"),
    argument(
        "--size", metavar="MM", type=float,
        help="print: the real object's longest side in millimetres (default: its own where that is known, or "
        f"{USUAL_SIZE:g})",
    ),
    argument(
        "--sheets", metavar="N", type=int, help="print: sheets that may be written; more are refused (default: 200)"
    ),
    argument("--paper", help="print: a4, a3 or letter (default: a4)"),
    argument(
        "--all", action="store_true", default=None,
        help="coco, yolo: right predictions too (default: pictures that a model is wrong about)",
    ),
    output.add_code_flag,
    argument("--icc", metavar="FILE", help="print: ICC profile of an RGB printer (default: sRGB)"),
    examples=(
        "export mug-texture-001",
        "export runs/mug-texture-001 --kind search --out search.parquet",
        *(writer.example for writer in WRITERS.values()),
    ),
)  # fmt: skip
def export(args: argparse.Namespace) -> int:
    out = None if args.out is None else Path(args.out)
    by_name = "" if out is None else out.suffix.removeprefix(".").lower()
    endings = {writer.ending or format: format for format, writer in WRITERS.items()}
    format = args.format or endings.get(by_name, by_name)
    if format == "fiftyone":
        raise InputError("--format: fiftyone was removed, since FiftyOne reads COCO; use --format coco")
    if args.format and format not in (*WRITERS, *FORMATS):
        raise UnknownNameError("format", format, (*WRITERS, *FORMATS))
    of = {"all": ("coco", "yolo"), **dict.fromkeys(("size", "sheets", "paper", "icc"), ("print",))}
    for name, formats in of.items():
        if format not in formats and getattr(args, name) is not None:
            raise InputError(f"--{name}: belongs to --format {' and '.join(formats)}; leave it out")
    if format not in WRITERS:
        return _table(args, out, by_name)
    if out is None:
        raise InputError(f"--out: {format} writes {WRITERS[format].writes}; give its name")
    if args.kind is not None and format != "3db":
        raise InputError("--kind: is only for tables of rows; leave it out")
    facts, text = WRITERS[format].write(args, out)
    return output.say(args.json, {"command": "export", "format": format, **facts, "out": str(out)}, text, sys.stderr)


def _table(args: argparse.Namespace, out: Path | None, by_name: str) -> int:
    otherwise = by_name if by_name in FORMATS else "json" if args.json and out is None else "csv"
    format = args.format or otherwise
    if args.json and out is None and format != "json":
        raise InputError(f"--json: prints JSON, but --format asks for {format}; leave one of them out")
    if out is not None and os.path.isdir(out):
        raise InputError(f"--out: expected the name of a file, got the folder {out}")
    folder = find_run(args.run)
    if (folder / PARTS).is_dir():
        parts = ", ".join(map(str, sorted((folder / PARTS).iterdir())))
        raise InputError(f"{folder}: is a study, whose rows are those of its parts; export one of {parts}")
    on_screen = io.BytesIO() if out is None and sys.stdout.isatty() else None
    with Store(folder / NAME, read_only=True) as store, output_errors():
        count = write_rows(store, format, out, on_screen or sys.stdout.buffer, args.kind)
    if on_screen is not None:
        print(on_screen.getvalue().decode("utf-8", "replace"), end="")
    if out is None:
        return 0
    text = f"{count} rows in {out}" + ("" if by_name == format else f", as {format}")
    facts = {"command": "export", "rows": count, "format": format, "out": str(out)}
    return output.say(args.json, facts, text, sys.stderr)
