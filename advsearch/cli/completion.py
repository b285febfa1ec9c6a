"""`advsearch completion`: a script with which the Tab key finishes commands, flags,
names and files in a shell.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
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

NAMED = {
    "--object": "objects",
    "--environment": "environments",
    "--control": "controls",
    "--over": "controls",
    "--policy": "policies",
    "--task": "tasks",
    "--objective": "objectives",
    "--model": "models",
}
"""Flags whose value is a name, and the kind of that name."""

OR_A_FILE = ("--object", "--environment", "--model")


@command(
    argument(
        "shell",
        choices=["bash", "zsh", "tcsh"],
        help="the shell that the script is for",
    ),
    output.add_flags,
    more=". It needs the package shtab (pip install shtab)",
    examples=(
        "completion bash > ~/.local/share/bash-completion/completions/advsearch",
        "completion zsh > ~/.zfunc/_advsearch",
    ),
)
def completion(args: argparse.Namespace) -> int:
    """Print a script for a shell that completes commands, flags, names and files.

    Each argument of each command gets what shtab completes: for a flag with a known
    kind of name (`NAMED`) the names, for one that also takes a file (`OR_A_FILE`) names
    and files, for all others files.

    Args:
        args: `shell` is the shell, and `json` prints the script as JSON.

    Returns:
        The exit status.
    """
    try:
        import shtab  # an optional extra
    except ImportError as error:
        raise InputError(
            "completion needs the package shtab; install it with: pip install shtab"
        ) from error
    # the loop below adds all commands with their flags
    parser, commands = make_parser_without_commands()
    # names of each kind of thing, such as models, that a flag may take
    names_of_kind = {
        kind: sorted(list_names(kind)) for kind in NAMED.values() if kind in REGISTRIES
    }
    for name in list_commands():
        for action in add_command(commands, name)._actions:
            takes_no_value = action.nargs == 0
            has_choices = action.choices is not None  # which shtab completes itself
            if takes_no_value or has_choices:
                continue
            # The last one is the long form, "--json". A positional argument has none.
            flag = action.option_strings[-1] if action.option_strings else ""
            names = names_of_kind.get(NAMED.get(flag, ""))
            if names and flag not in OR_A_FILE:
                action.choices = names
                continue
            completer: dict[str, Any] = shtab.FILE
            if names:
                completer = _complete_name_or_file(flag, names)
            action.complete = completer  # type: ignore[attr-defined]  # where shtab looks for it
    script = shtab.complete(parser, shell=args.shell)
    return output.print_answer(
        args.json,
        {"command": "completion", "shell": args.shell, "script": script},
        script,
    )


def _complete_name_or_file(flag: str, names: Sequence[str]) -> dict[str, Any]:
    """Return what shtab writes for a flag whose value is a name or a file.

    Each shell has code of its own; tcsh completes files only.

    Args:
        flag: the flag, such as "--object".
        names: names that it may take besides files.
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
