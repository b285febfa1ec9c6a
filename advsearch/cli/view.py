"""`advsearch view`: make the page of a run anew, or a folder with it that any web server can serve."""

from __future__ import annotations

import argparse
from pathlib import Path

from advsearch.cli import output
from advsearch.errors import InputError

HELP = "write the page of a run again, or a folder that any web server can serve"
EXAMPLES = ("view mug-sweep-001", "view mug-sweep-001 mug-sweep-002 --bundle site")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs="+", metavar="RUN", help="a run's name or folder; several sweeps with --bundle")
    parser.add_argument("--bundle", metavar="DIR", help="write a folder: a page, the rows and the small pictures")
    output.add_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Write the page and say where it is."""
    # late, so that --help answers at once
    from advsearch.runs.directory import find_run
    from advsearch.viewer.pages import renewed, write_bundle

    folders = [find_run(name) for name in args.runs]
    if args.bundle is None and len(folders) > 1:
        raise InputError("--bundle: pages of several runs go into a folder; name one, or give one run")
    out = renewed(folders[0]) if args.bundle is None else write_bundle(folders, Path(args.bundle))
    if args.json:
        output.print_json({"schema": 1, "command": "view", "runs": [str(one) for one in folders], "out": str(out)})
    else:
        print(out)
    return 0
