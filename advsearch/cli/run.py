"""`advsearch run`: do what a YAML file describes; `resume`: go on with a run that was stopped; `runs`: those here."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from advsearch.cli import commands, output
from advsearch.cli.commands import Command
from advsearch.cli.flags import command_in, config_of_file
from advsearch.cli.show import show_run
from advsearch.errors import InputError
from advsearch.registry import allow_named
from advsearch.runs.directory import CONFIG, HOME, find_run, only_here
from advsearch.runs.listing import finished, listed_runs
from advsearch.settings import parse_assignment
from advsearch.settings.values import put


def _run_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="YAML with settings and values, such as a run's run.yaml")
    parser.add_argument("change", metavar="NAME=VALUE", nargs="*", help="a setting to change: steps=80")
    parser.add_argument("--run", help="where the run is kept: a name (kept in runs/) or the path of a folder")
    parser.add_argument("--overwrite", action="store_true", help="replace a run that is there already")
    output.add_code_flag(parser)
    output.add_flags(parser, quiet=True)


def _run(args: argparse.Namespace) -> int:
    command = command_in(args.file)
    changes = changes_in(args.change)
    if args.run is not None:
        changes["run"] = args.run
    if args.overwrite:
        changes["overwrite"] = True
    return run_file(command, args.file, changes, args)


def changes_in(words: Sequence[str]) -> dict[str, object]:
    """Return setting to value from ``NAME=VALUE``, which allows the code that they name. Raises InputError where a word
    is no such assignment."""
    changes, typed = dict(parse_assignment(text, f"change {text!r}") for text in words), dict[str, object]()
    for name, value in changes.items():
        put(typed, name, value)
    allow_named(typed)
    return changes


def run_file(
    command: str, file: str | Path, changes: Mapping[str, object], args: argparse.Namespace, resumed: Path | None = None
) -> int:
    """Do what a YAML file describes, with `changes` put over it. Raises UnknownNameError where there is no such
    command.

    If the file is a run's own, `resumed` is its folder; `args` has `json` and `quiet`.
    """
    config = config_of_file(command, file, changes)
    for one in config.left_out:
        if resumed is None or one.name not in config.free:
            raise InputError(f"{file}: {one.name}: {one.does}, which a file can't ask for; type {one.ask}")
        if not args.quiet:
            print(f"advsearch: {one.name} is left out: it {one.does}; type {one.ask}", file=sys.stderr)
    return int(commands.command_named(command).carry_out(config, as_json=args.json, quiet=args.quiet, resumed=resumed))


RUN = Command(_run_arguments, _run)


def _resume_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="a run's name or folder")
    parser.add_argument(
        "change", metavar="NAME=VALUE", nargs="*", help="a setting to change that decides no number: threads=2"
    )
    output.add_code_flag(parser)
    output.add_flags(parser, quiet=True)


def _resume(args: argparse.Namespace) -> int:
    """Do what is left of the run and print its result; of a run that is done, its result."""
    path, changes = find_run(args.run), changes_in(args.change)
    if not (path / CONFIG).is_file():
        raise InputError(f"{path}: expected a run with its {CONFIG}, got none; it was stopped before it began")
    command = command_in(path / CONFIG)
    # the map of a sweep's surface, or a recipe's figures anew, with the photographs that were taken since
    adds = command == "recipe" or (changes.get("surface") is True and command == "sweep")
    if finished(path) and not adds:
        print(f"advsearch: {path} is done already", file=sys.stderr)
        return show_run(str(path), args.json)
    if only := only_here(path):
        raise InputError(
            f"{path}: cannot resume from here: {', '.join(only)} existed only in the Python session of the run; call "
            "the same function with the same arguments again, an attack with `resume=True`"
        )
    return run_file(command, path / CONFIG, changes, args, resumed=path)


RESUME = Command(
    _resume_arguments,
    _resume,
    "; what it has evaluated is not rendered again",
    (
        "resume mug-texture-001",
        "resume mug-check-001 seconds=600",
        "resume mug-sweep-001 surface=true",
        "resume realism-001 photographs=my-photographs",
    ),
)


MOST_NAMES = 4
"""Controls of a run that the table names."""


def _runs_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", nargs="?", metavar="FOLDER", help="where to look (default: runs)")
    output.add_flags(parser)


def _runs(args: argparse.Namespace) -> int:
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
    heads = ["run", "command", "object", "controls", "rows", "state", "result"]
    rows = [
        [one.name, one.command, one.object, _several(one.controls), str(one.rows), one.state, one.answer]
        for one in runs
    ]
    print(output.aligned([heads, *rows]))
    for one in runs:
        if one.fault:
            print(f"advsearch: {one.name}: {one.fault}", file=sys.stderr)
    return 0


def _several(names: Sequence[str]) -> str:
    """The first few of some names, and how many more there are."""
    more = len(names) - MOST_NAMES
    return ",".join(names) if more <= 1 else f"{','.join(names[:MOST_NAMES])} and {more} more"


RUNS = Command(_runs_arguments, _runs)
