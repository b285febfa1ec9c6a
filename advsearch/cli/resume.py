"""`advsearch resume`: go on with a run that was stopped, however it was stopped."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

from advsearch.cli import output
from advsearch.cli.run import changes_in, command_in, run_file
from advsearch.cli.show import show_run
from advsearch.errors import InputError

HELP = "continue a run that was stopped, from where it stopped"
MORE = "; what it has evaluated is not rendered again"
EXAMPLES = (
    "resume mug-texture-001",
    "resume mug-plan-001 seconds=600",
    "resume mug-sweep-001 surface=true",
    "resume realism-001 photographs=my-photographs",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="a run's name or folder")
    parser.add_argument(
        "change", metavar="NAME=VALUE", nargs="*", help="a setting to change that decides no number: threads=2"
    )
    output.add_code_flag(parser)
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Do what is left of the run and print its answer; of a run that is done, its answer."""
    # late, so that --help answers at once
    from advsearch.runs.directory import CONFIG, find_run, only_here
    from advsearch.runs.listing import finished

    path, changes = find_run(args.run), changes_in(args.change)
    if not (path / CONFIG).is_file():
        raise InputError(f"{path}: expected a run with its {CONFIG}, got none; it was stopped before it began")
    if finished(path) and not _adds(path, changes):
        print(f"advsearch: {path} is done already", file=sys.stderr)
        return show_run(str(path), args.json)
    if only := only_here(path):
        raise InputError(
            f"{path}: cannot go on from here: {', '.join(only)} existed only in the Python session that asked; call "
            "the same function with the same arguments again, an attack with `resume=True`"
        )
    return run_file(command_in(path / CONFIG), path / CONFIG, changes, args, resumed=path)


def _adds(path: Path, changes: Mapping[str, object]) -> bool:
    """Whether a run that is done still gives something: the map of a sweep's surface, or a recipe's figures anew, with
    the photographs that were taken since."""
    # late, so that --help answers at once
    from advsearch.runs.directory import CONFIG

    command = command_in(path / CONFIG)
    return command == "recipe" or (changes.get("surface") is True and command == "sweep")
