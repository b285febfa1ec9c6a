"""The commands `advsearch run`, which runs an experiment from a YAML file; `resume`,
which continues a run that was stopped; and `runs`, which lists the runs in a folder.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from advsearch.cli import main, output
from advsearch.cli.flags import read_command, read_file_config
from advsearch.cli.main import argument, command
from advsearch.cli.show import show_run
from advsearch.errors import InputError
from advsearch.registry import get_experiment
from advsearch.runs.directory import CONFIG, HOME, REPORT, find_run, read_python_only
from advsearch.runs.listing import ListedRun, is_finished, list_runs
from advsearch.settings import Config, parse_assignment
from advsearch.settings.values import set_dotted
from advsearch.trust.code import allow_code_in_settings
from advsearch.viewer.pages import write_page


@command(
    argument(
        "file",
        metavar="FILE",
        help="YAML file with settings, such as the run.yaml of a run",
    ),
    argument(
        "change", metavar="NAME=VALUE", nargs="*", help="a setting to change: steps=80"
    ),
    argument(
        "--run",
        help="where the run is stored: a name (for a folder in runs/) or the path of a "
        "folder",
    ),
    argument(
        "--overwrite", action="store_true", help="replace a run that exists already"
    ),
    output.add_code_flag,
    output.add_quiet_flags,
)
def run(args: argparse.Namespace) -> int:
    """Run the experiment that a YAML file describes, and return the exit status."""
    changes = parse_changes(args.change)
    if args.run is not None:
        changes["run"] = args.run
    if args.overwrite:
        changes["overwrite"] = True
    return run_file(args.file, changes, args)


def parse_changes(words: Sequence[str]) -> dict[str, object]:
    """Return the settings that are changed by words ``NAME=VALUE``.

    If a value names Python code, that code is allowed to run, since a person typed it.

    Args:
        words: words of the command line, such as "steps=80" or "controls.pose.yaw=3".

    Returns:
        The values by name as it was typed: ``{"controls.pose.yaw": 3}``.

    Raises:
        InputError: a word is no such assignment.
    """
    changes = dict(parse_assignment(text, f"change {text!r}") for text in words)
    # `allow_code_in_settings` expects settings in nested form:
    # {"controls": {"pose": {"yaw": 3}}}
    nested_changes = dict[str, object]()
    for name, value in changes.items():
        set_dotted(nested_changes, name, value)
    allow_code_in_settings(nested_changes)
    return changes


def run_file(
    file: str | Path,
    changes: Mapping[str, object],
    args: argparse.Namespace,
    resumed_directory: Path | None = None,
) -> int:
    """Run the experiment that a YAML file describes, and return the exit status.

    Args:
        file: file with settings.
        changes: values by name that replace those of the file.
        args: has `json` and `quiet`.
        resumed_directory: folder of the run to resume, if the file is its `run.yaml`;
            None for a new run.

    Raises:
        UnknownNameError: there is no such command.
        InputError: the file has a setting that counts only when a person types it, such
            as one that connects to other machines.
    """
    config = read_file_config(read_command(file), file, changes)
    is_resumed = resumed_directory is not None
    _check_omitted_settings(file, config, is_resumed=is_resumed, quiet=args.quiet)
    experiment_command = main.ExperimentCommand(get_experiment(config.command))
    return experiment_command.run_config(
        config, as_json=args.json, quiet=args.quiet, resumed_directory=resumed_directory
    )


def _check_omitted_settings(
    file: str | Path, config: Config, *, is_resumed: bool, quiet: bool
) -> None:
    """Check that a run can do without the settings that only a person may type.

    Those of a file are ignored, such as an address to connect to. `config` has their
    defaults instead. A new run would silently differ from the file, so it is an error.
    A run that is resumed was started with them; it goes on if they do not change its
    numbers, and they are printed unless `quiet`.

    Raises:
        InputError: it cannot.
    """
    for setting in config.omitted_settings:
        decides_numbers = setting.name not in config.changeable_settings
        if not is_resumed or decides_numbers:
            raise InputError(
                f"{file}: {setting.name}: {setting.effect}, which a file "
                f"can't ask for; type {setting.advice}"
            )
        if not quiet:
            print(
                f"advsearch: {setting.name} is left out: it {setting.effect}; type "
                f"{setting.advice}",
                file=sys.stderr,
            )


@command(
    argument("run", metavar="RUN", help="a run's name or folder"),
    argument(
        "change",
        metavar="NAME=VALUE",
        nargs="*",
        help="a setting to change on which no result depends: threads=2",
    ),
    output.add_code_flag,
    output.add_quiet_flags,
    more="; configurations that were evaluated before are not rendered again",
    examples=(
        "resume mug-texture-001",
        "resume mug-check-001 seconds=600",
        "resume mug-sweep-001 surface=true",
        "resume realism-001 photographs=my-photographs",
    ),
)
def resume(args: argparse.Namespace) -> int:
    """Continue a run that was stopped, and print its result.

    If the run has finished already, its result is printed, unless the changes add
    something to it.

    Returns:
        The exit status.

    Raises:
        InputError: the run has no settings, or parts of it exist only in Python.
    """
    path = find_run(args.run)
    changes = parse_changes(args.change)
    _check_has_settings(path)
    command = read_command(path / CONFIG)
    if is_finished(path) and not _can_add_to_finished_run(command, changes):
        return _show_finished_run(path, as_json=args.json)
    _check_parts_are_stored(path)
    return run_file(path / CONFIG, changes, args, resumed_directory=path)


def _check_has_settings(path: Path) -> None:
    """Check that the folder of a run has its settings.

    Raises:
        InputError: it has none.
    """
    if not (path / CONFIG).is_file():
        raise InputError(
            f"{path}: expected a run with its {CONFIG}, got none; start it again"
        )


def _can_add_to_finished_run(command: str, changes: Mapping[str, object]) -> bool:
    """Return whether resuming a finished run of a command adds something to it."""
    # Two commands can: a sweep gets a map of the surface, and a recipe makes its
    # figures again, with photographs taken since.
    adds_surface = changes.get("surface") is True and command == "sweep"
    return command == "recipe" or adds_surface


def _show_finished_run(path: Path, *, as_json: bool) -> int:
    """Print the result of a finished run, and return the exit status.

    The page is written if it is missing.
    """
    print(f"advsearch: {path} is done already", file=sys.stderr)
    # The page may be missing: the disk was full as it was written, or somebody removed
    # it.
    if not (path / REPORT).is_file():
        write_page(path)
    return show_run(str(path), as_json)


def _check_parts_are_stored(path: Path) -> None:
    """Check that no part of a run existed only in the Python session that began it.

    Raises:
        InputError: there is such a part.
    """
    missing = [part.text for part in read_python_only(path)]
    if missing:
        raise InputError(
            f"{path}: cannot resume from here: {', '.join(missing)} existed only in the "
            "Python session of the run; call the same function with the same arguments "
            "again, an attack with `resume=True`"
        )


MAX_CONTROL_NAMES = 4  # maximum number of controls of a run that the table names


@command(
    argument(
        "folder", nargs="?", metavar="FOLDER", help="folder of runs (default: runs)"
    ),
    output.add_json_flag,
)
def runs(args: argparse.Namespace) -> int:
    """Print a table of the runs in a folder, and return the exit status.

    Faults of corrupt runs are printed on standard error.

    Raises:
        InputError: the folder does not exist.
    """
    folder = HOME if args.folder is None else Path(args.folder)
    if args.folder is not None and not os.path.isdir(folder):
        raise InputError(
            f"{folder}: expected a folder with runs in it, got no such folder"
        )
    listed_runs = list_runs(folder)
    text = f"no runs in {folder}/ yet; advsearch attack makes one"
    if listed_runs:
        heads = ["run", "command", "object", "controls", "rows", "state", "result"]
        text = output.align_columns([heads, *map(_make_run_row, listed_runs)])
    facts = {"command": "runs", "runs": [vars(run) for run in listed_runs]}
    output.print_answer(args.json, facts, text)
    for run in listed_runs:
        if run.fault and not args.json:
            print(f"advsearch: {run.name}: {run.fault}", file=sys.stderr)
    return 0


def _make_run_row(run: ListedRun) -> list[str]:
    """Return the row of a run in the table of runs."""
    control_names = ",".join(run.controls)
    n_omitted = len(run.controls) - MAX_CONTROL_NAMES
    if n_omitted > 1:  # a single name is as short as "1 more"
        first_names = ",".join(run.controls[:MAX_CONTROL_NAMES])
        control_names = f"{first_names} and {n_omitted} more"
    return [
        run.name,
        run.command,
        run.object,
        control_names,
        str(run.rows),
        run.state,
        run.outcome,
    ]
