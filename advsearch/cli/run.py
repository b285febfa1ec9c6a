"""`advsearch run`: do what a YAML file describes, a run's own run.yaml among them."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from advsearch.cli import main, output
from advsearch.errors import UnknownNameError

if TYPE_CHECKING:
    from advsearch.settings import Config

HELP = "do what a YAML file describes; the run.yaml of a run repeats it"

COMMANDS = (
    *("attack", "sweep", "recipe", "gap", "region", "precision", "check", "plan", "stability", "harden", "explain"),
    *("compare", "test"),
)
"""What the `command` of a file may say."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="YAML with settings and values, such as a run's run.yaml")
    parser.add_argument("change", metavar="NAME=VALUE", nargs="*", help="a setting to change: steps=80")
    parser.add_argument("--run", help="where the run is kept: a name (kept in runs/) or the path of a folder")
    parser.add_argument("--overwrite", action="store_true", help="replace a run that is there already")
    output.add_code_flag(parser)
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Read the file, put the changes over it and do what it says."""
    command = command_in(args.file)
    changes = changes_in(args.change)
    if args.run is not None:
        changes["run"] = args.run
    if args.overwrite:
        changes["overwrite"] = True
    return run_file(command, args.file, changes, args)


def changes_in(words: Sequence[str]) -> dict[str, object]:
    """Return setting to value from ``NAME=VALUE``.

    Raises:
        InputError: a word is no such assignment.
    """
    # late, so that --help answers at once
    from advsearch.settings import parse_assignment

    return dict(parse_assignment(text, f"change {text!r}") for text in words)


def command_in(file: str | Path) -> str:
    """Return the command that a file is for.

    Raises:
        FileFormatError: it is not a file with settings.
    """
    # late, so that --help answers at once
    from advsearch.settings import read_yaml

    return str(read_yaml(file).get("command", "attack"))


def config_of_file(command: str, file: str | Path, changes: Mapping[str, object]) -> Config:
    """Return the configuration that a file describes; arguments and errors as for `run_file`."""
    # late, so that --help answers at once
    from advsearch.config import CONFIGS

    if command not in COMMANDS:
        raise UnknownNameError("command", command, COMMANDS, f"It stands in {file}.")
    return CONFIGS[command].from_yaml(file, changes)


def run_file(
    command: str, file: str | Path, changes: Mapping[str, object], args: argparse.Namespace, resumed: Path | None = None
) -> int:
    """Do what a file describes.

    Args:
        command: what the file says it is.
        file: YAML.
        changes: put over it.
        args: with `json`, `quiet` and `code`.
        resumed: the folder of the run to go on with, if the file is a run's own.

    Raises:
        UnknownNameError: there is no such command.
    """
    # late, so that --help answers at once
    from advsearch.registry import only_named_code

    config = config_of_file(command, file, changes)
    module = importlib.import_module(main.COMMANDS[command])
    with only_named_code(file, args.code):
        return int(module.COMMAND.carry_out(config, as_json=args.json, quiet=args.quiet, resumed=resumed))
