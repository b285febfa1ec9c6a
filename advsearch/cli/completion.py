"""`advsearch completion`: a script for a shell, with which the Tab key completes
commands, flags, names and files.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from advsearch.cli import output
from advsearch.cli.main import (
    add_command,
    argument,
    command,
    list_commands,
    make_parser_without_commands,
)
from advsearch.cli.show import REGISTRIES, list_names
from advsearch.errors import InputError

KIND_OF_FLAG = {
    "--object": "objects",
    "--environment": "environments",
    "--control": "controls",
    "--over": "controls",
    "--policy": "policies",
    "--task": "tasks",
    "--objective": "objectives",
    "--model": "models",
}
"""The kind of name that a flag takes as its value."""

# Flags whose value is such a name or a file.
NAME_OR_FILE_FLAGS = ("--object", "--environment", "--model")


@command(
    argument(
        "shell",
        choices=["bash", "zsh", "tcsh"],
        help="the shell that the script is for",
    ),
    output.add_json_flag,
    more=". It needs the package shtab (pip install shtab)",
    examples=(
        "completion bash > ~/.local/share/bash-completion/completions/advsearch",
        "completion zsh > ~/.zfunc/_advsearch",
    ),
)
def completion(args: argparse.Namespace) -> int:
    """Print a script for a shell that completes commands, flags, names and files.

    A flag of `KIND_OF_FLAG` is completed by names, one of `NAME_OR_FILE_FLAGS` by names
    and files, and any other by files.

    Args:
        args: `shell` is the shell; with `json` the script is printed as JSON.

    Returns:
        The exit status.
    """
    shtab = _import_shtab()
    parser, commands = make_parser_without_commands()
    names_of_kind = _list_names_of_kinds()
    for name in list_commands():
        command_parser = add_command(commands, name)
        for action in command_parser._actions:
            _set_completion(action, names_of_kind, shtab.FILE)
    script = shtab.complete(parser, shell=args.shell)
    return output.print_answer(
        args.json,
        {"command": "completion", "shell": args.shell, "script": script},
        script,
    )


def _import_shtab() -> Any:
    """Return the module shtab, which an installation may lack.

    Raises:
        InputError: it is not installed.
    """
    try:
        import shtab  # an optional extra
    except ImportError as error:
        raise InputError(
            "completion needs the package shtab; install it with: pip install shtab"
        ) from error
    return shtab


def _list_names_of_kinds() -> dict[str, list[str]]:
    """Return the sorted names of each kind in `KIND_OF_FLAG`."""
    # An installation may lack a kind of names; then `REGISTRIES` does, too.
    return {
        kind: sorted(list_names(kind))
        for kind in KIND_OF_FLAG.values()
        if kind in REGISTRIES
    }


def _set_completion(
    action: argparse.Action,
    names_of_kind: Mapping[str, Sequence[str]],
    file_completer: dict[str, Any],
) -> None:
    """Store in an argument of a parser how shtab completes it.

    Args:
        action: the argument, which is changed.
        names_of_kind: the names of each kind in `KIND_OF_FLAG`.
        file_completer: shtab's code that completes names of files.
    """
    takes_no_value = action.nargs == 0
    has_choices = action.choices is not None  # which shtab completes itself
    if takes_no_value or has_choices:
        return
    # The last one is the long form, "--json". A positional argument has none.
    flag = action.option_strings[-1] if action.option_strings else ""
    names = names_of_kind.get(KIND_OF_FLAG.get(flag, ""))
    if names and flag not in NAME_OR_FILE_FLAGS:
        action.choices = names
        return
    completer = _complete_name_or_file(flag, names) if names else file_completer
    # shtab reads this attribute
    action.complete = completer  # type: ignore[attr-defined]


def _complete_name_or_file(flag: str, names: Sequence[str]) -> dict[str, Any]:
    """Return the code with which shells complete a flag that takes a name or a file.

    It has the form that shtab expects: the code by the name of the shell. For bash it
    is the name of a shell function, which the "preamble" defines. For zsh it is an
    action. For tcsh it is "f", which completes files only.

    Args:
        flag: the flag, such as "--object".
        names: names that the flag takes in addition to files.
    """
    function = f"_advsearch{flag.replace('-', '_')}"
    words = " ".join(names)
    return {
        "preamble": {
            "bash": f'{function}() {{ compgen -W "{words}" -- '
            f'"$1"; compgen -f -- "$1"; }}'
        },
        "bash": function,
        "zsh": f"_alternative 'names:name:({words})' 'files:file:_files'",
        "tcsh": "f",
    }
