"""`advsearch runs`: the runs that are here, and how each ended."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from advsearch.cli import output
from advsearch.errors import InputError

MOST_NAMES = 4
"""Controls of a run that the table names."""
HELP = "list the runs in a folder and how each ended"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", nargs="?", metavar="FOLDER", help="where to look (default: runs)")
    output.add_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Print one line for each run."""
    # late, so that --help answers at once
    from advsearch.runs.directory import HOME
    from advsearch.runs.listing import listed_runs

    folder = HOME if args.folder is None else Path(args.folder)
    if args.folder is not None and not os.path.isdir(folder):
        raise InputError(f"{folder}: expected a folder with runs in it, got no such folder")
    runs = listed_runs(folder)
    if args.json:
        output.print_json({"schema": 1, "command": "runs", "runs": [vars(one) for one in runs]})
        return 0
    if not runs:
        print(f"no runs in {folder}/ yet; advsearch attack makes one")
        return 0
    heads = ["run", "command", "object", "controls", "rows", "state", "answer"]
    rows = [
        [one.name, one.command, one.object, _several(one.controls), str(one.rows), one.state, one.answer]
        for one in runs
    ]
    print(output.aligned([heads, *rows]))
    return 0


def _several(names: Sequence[str]) -> str:
    """The first few of some names, and how many more there are."""
    more = len(names) - MOST_NAMES
    return ",".join(names) if more <= 1 else f"{','.join(names[:MOST_NAMES])} and {more} more"
