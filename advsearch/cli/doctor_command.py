"""`advsearch doctor`: whether every part that a run needs is there and works."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from advsearch.cli import output

HELP = "check every part that a run needs, with versions and what to do"


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    description = HELP[0].upper() + HELP[1:] + "."
    output.add_flags(subparsers.add_parser("doctor", help=HELP, description=description, allow_abbrev=False))


def run(args: argparse.Namespace) -> int:
    """Check, print, and return the checks' exit status."""
    from advsearch.cli import doctor

    print("advsearch: trying every part, a first render among them; that takes some seconds", file=sys.stderr)
    return doctor.run(json=args.json)
