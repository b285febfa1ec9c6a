"""`advsearch doctor`: whether every part that a run needs is there and works."""

from __future__ import annotations

import argparse
import sys

from advsearch.cli import output

HELP = "check every part that a run needs, with versions and how to mend it"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    output.add_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Check, print, and return the checks' exit status."""
    from advsearch.cli import doctor

    print("advsearch: trying every part, a first render among them; that takes some seconds", file=sys.stderr)
    return doctor.run(json=args.json)
