"""`advsearch run`: do what a YAML file describes, a run's own run.yaml among them."""

from __future__ import annotations

import argparse
from typing import Any

from advsearch.cli import output
from advsearch.errors import UnknownNameError

HELP = "do what a YAML file describes: a run.yaml repeats its run"

COMMANDS = ("attack",)
"""What the `command` of a file may say."""


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    parser = subparsers.add_parser("run", help=HELP, description=HELP[0].upper() + HELP[1:] + ".", allow_abbrev=False)
    parser.add_argument("file", metavar="FILE", help="YAML with settings and values, such as a run's run.yaml")
    parser.add_argument("change", metavar="NAME=VALUE", nargs="*", help="a setting to change: steps=80")
    parser.add_argument("--run", help="where the run is kept: a name (kept in runs/) or the path of a folder")
    parser.add_argument("--overwrite", action="store_true", help="replace a run that is there already")
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Read the file, put the changes over it and do what it says."""
    from advsearch.cli.attack import attack
    from advsearch.config import AttackConfig, parse_assignment, read_yaml

    command = read_yaml(args.file).get("command", "attack")
    if command not in COMMANDS:
        raise UnknownNameError("command", str(command), COMMANDS, f"It stands in {args.file}.")
    changes = dict(parse_assignment(text, text) for text in args.change)
    if args.run is not None:
        changes["run"] = args.run
    if args.overwrite:
        changes["overwrite"] = True
    return attack(AttackConfig.from_yaml(args.file, changes), as_json=args.json, quiet=args.quiet)
