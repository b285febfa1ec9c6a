"""`advsearch import-3db`: a folder that 3DB wrote, as a run to look at."""

from __future__ import annotations

import argparse
from pathlib import Path

from advsearch.cli import output

HELP = "turn a folder that 3DB wrote into a run"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Read details.log, class_maps.json and images/ of 3DB into a run: rows, small pictures, a page."
    )
    parser.add_argument("folder", metavar="FOLDER", help="what 3DB wrote")
    parser.add_argument("--run", help="name or folder of the run (default: runs/FOLDER-3db-NNN)")
    parser.add_argument("--overwrite", action="store_true", help="replace the run that is there")
    output.add_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Write the run and say where it is."""
    # late, so that --help answers at once
    from advsearch.engine.sweeps.summary import import_threedb
    from advsearch.runs.summary import read_result

    path = import_threedb(Path(args.folder), args.run, overwrite=args.overwrite)
    if args.json:
        output.print_json(read_result(path).to_dict())
    else:
        print(f"{path}: {read_result(path).brief}; {path / 'report.html'} shows it")
    return 0
