"""A sweep as a folder for 3DB's dashboard."""

from __future__ import annotations

import argparse
from pathlib import Path

from advsearch.cli.exports import Written

FORMAT = "3db"
WRITES = "a folder"
EXAMPLE = "export mug-sweep-001 --format 3db --out folder"


def write(args: argparse.Namespace, out: Path) -> Written:
    """Write a folder as 3DB does."""
    # late, so that --help answers at once
    from advsearch.runs.directory import find_run
    from advsearch.runs.export import write_threedb
    from advsearch.runs.store import NAME, Store
    from advsearch.viewer.thumbnails import kept_pictures

    folder = find_run(args.run)
    kept = kept_pictures(folder)
    with Store(folder / NAME, read_only=True) as store:
        picture = kept.png_of if kept else lambda _: None
        count = write_threedb(lambda: store.rows(args.kind or "sweep"), out, picture)
    return {"rows": count}, f"{count} rows in {out}; look at them with: python -m threedboard {out}"
