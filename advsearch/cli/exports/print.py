"""A patch or texture as sheets to print."""

from __future__ import annotations

import argparse
from pathlib import Path

from advsearch.cli.exports import Written

FORMAT = "print"
WRITES = "a PDF file"
ENDING = "pdf"
EXAMPLE = "export mug-patch-001 --format print --size 95 --out sheets.pdf"

USUAL_SIZE = 100.0
"""Longest side of a printed object where nobody says it, in millimetres."""


def write(args: argparse.Namespace, out: Path) -> Written:
    """Write the sheets."""
    # late, so that --help answers at once
    from advsearch.cli.output import at_work

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
