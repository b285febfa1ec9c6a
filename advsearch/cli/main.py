"""`advsearch`: run the command that is asked for, and turn what goes wrong into a message and an exit status.

Exit status: 0 the command did its work, 1 a bug, 2 bad input, 3 a check that fell short, 130 interrupted.
"""

from __future__ import annotations

import argparse
import re
import shutil
import signal
import sys
import textwrap
from collections.abc import Sequence
from typing import Any, NoReturn, cast

from advsearch import __version__
from advsearch.cli.commands import COMMANDS, GROUPS, command_named, help_of
from advsearch.cli.output import BAD_INPUT, INTERRUPTED, OK, end_output, open_descriptors, screens, shortened
from advsearch.errors import AdvsearchError, InputError, UnknownNameError
from advsearch.interrupts import INTERRUPTS, end_at_the_second, unless_interrupted
from advsearch.registry import allow_code, nothing_allowed

_EXAMPLES = """examples:
  advsearch attack --object mug --control texture
  advsearch attack --object mug.obj --environment room.hdr --model model.pt2 --labels labels.json --label "mug,cup"
  advsearch run runs/mug-texture-001/run.yaml steps=80
  advsearch show runs/mug-texture-001
"""


class Parser(argparse.ArgumentParser):
    """argparse, but what is wrong with the arguments is an `InputError`."""

    def error(self, message: str) -> NoReturn:
        """Raise the message as an `InputError` that says where help is."""
        raise InputError(f"{message}; see {self.prog} --help")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status. An exception that is a bug of ours passes through."""
    if argv is None:  # this process is ours
        open_descriptors()
    with screens(), nothing_allowed():
        status = _interruptible(sys.argv[1:]) if argv is None else _status(list(argv))
        if argv is None:  # native code knows no handler of ours
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        end_output()
    return status


def _interruptible(words: list[str]) -> int:
    """As `_status`, with Ctrl-C for as long as there is something to interrupt, and never a traceback of it."""
    sys.unraisablehook = unless_interrupted
    try:
        signal.signal(signal.SIGINT, INTERRUPTS)
        end_at_the_second()
        status = _status(words)
        INTERRUPTS.ended = True
        return status
    except KeyboardInterrupt:  # while `_status` told of another
        INTERRUPTS.ended = True
        return INTERRUPTED


def _status(words: list[str]) -> int:
    try:
        status = _run_and_tell(words)
        if status != INTERRUPTED and INTERRUPTS.count:  # whatever has swallowed one: it was asked to stop
            raise KeyboardInterrupt
        return status
    except BaseException as error:
        # Modules that are being imported, and native code, make other errors of an interrupt.
        if not INTERRUPTS.count and not isinstance(error, KeyboardInterrupt):
            raise
        print("advsearch: interrupted", file=sys.stderr)
        return INTERRUPTED


def _run_and_tell(words: list[str]) -> int:
    try:
        status = _run(words)
        sys.stdout.flush()
        return status
    except AdvsearchError as error:
        from advsearch.cli.flags import with_flags  # late, so that --help answers at once

        asks_for_flag = isinstance(error, UnknownNameError) or "`code=" in str(error)  # no file may name its own code
        in_a_file = words[0] in ("run", "resume") and not asks_for_flag
        text = str(error) if in_a_file else with_flags(str(error))
        print(f"advsearch: error: {shortened(text)}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:
        return OK


def _run(words: list[str]) -> int:
    command = words[0] if words and not words[0].startswith("-") else None
    if command == "plan":
        raise InputError("`plan` is a part of `check` now: use advsearch check --loss model, with the same flags")
    if command is not None and command not in COMMANDS:
        raise UnknownNameError("command", command, COMMANDS, "See advsearch --help.")
    try:
        args = _parse(words, command)
    except SystemExit as stop:  # --help and --version have printed their text
        return int(stop.code or 0)
    allow_code(*getattr(args, "code", ()))
    return int(command_named(args.command).run(args))


def _parse(words: list[str], command: str | None) -> argparse.Namespace:
    parser, subparsers = without_commands()
    for name in COMMANDS:
        add_command(subparsers, name, whole=name == command)
    args, unknown = parser.parse_known_args(words)
    if unknown:
        raise _unknown_argument(unknown[0], subparsers.choices[args.command] if args.command else parser)
    if args.command is None:
        parser.print_help()
        parser.exit()
    return args


def without_commands() -> tuple[argparse.ArgumentParser, argparse._SubParsersAction[Any]]:
    """Return the parser, and what `add_command` adds the commands to."""
    parser = Parser(
        prog="advsearch",
        description="Find the scene that a vision model gets wrong most badly.",
        epilog=f"{_listing()}\n{_EXAMPLES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"advsearch {__version__}")
    subparsers = parser.add_subparsers(
        dest="command",
        metavar="COMMAND",
        title="commands",
        help="one of those below; advsearch COMMAND --help explains it",
        parser_class=Parser,
    )
    return parser, subparsers


def _listing() -> str:
    """Return the commands with what they do, group by group, as wide as the terminal."""
    column = 4 + max(map(len, COMMANDS))
    width = max(shutil.get_terminal_size().columns - 2, 2 * column)
    lines = []
    for title, commands in GROUPS.items():
        lines.append(title)
        for name in filter(COMMANDS.__contains__, commands):
            begin = f"  {name}".ljust(column)
            lines.append(textwrap.fill(begin + help_of(name), width, subsequent_indent=" " * column))
        lines.append("")
    return "\n".join(lines)


def add_command(
    subparsers: argparse._SubParsersAction[Any], name: str, *, whole: bool = True
) -> argparse.ArgumentParser:
    """Return the new parser of a command; if not `whole` it has no arguments, and serves the list of commands."""
    if not whole:
        return cast(argparse.ArgumentParser, subparsers.add_parser(name))
    command, text = command_named(name), help_of(name)
    examples = "".join(f"  advsearch {line}\n" for line in command.examples)
    parser: argparse.ArgumentParser = subparsers.add_parser(
        name,
        help=text,
        description=f"{text[0].upper()}{text[1:]}{command.more}.",
        epilog=f"examples:\n{examples}" if examples else None,
        formatter_class=argparse.RawDescriptionHelpFormatter if examples else argparse.HelpFormatter,
        allow_abbrev=False,
    )
    command.add_arguments(parser)
    return parser


def _unknown_argument(argument: str, parser: argparse.ArgumentParser) -> InputError:
    # late, so that --help answers at once
    from advsearch.calls import meant_by
    from advsearch.config import CONFIGS
    from advsearch.settings import settings

    name = argument.partition("=")[0]
    known = re.findall(r"(?<!\S)--[a-z][a-z-]*", parser.format_help())
    if not name.startswith("--"):
        hint = f"; for the object write --object {argument}" if "--object" in known else ""
        return InputError(f"expected flags, got {argument!r}{hint}; see {parser.prog} --help")
    owners = [owner for owner, config in CONFIGS.items() if name in (setting.flag for setting in settings(config))]
    if owners:
        return InputError(f"{parser.prog} has no {name}, a flag of advsearch {', '.join(owners)}; leave it out")
    meant, reason = meant_by(name[2:].replace("-", "_"), [flag[2:] for flag in known])
    if meant or reason:
        hint = f"; did you mean {' or '.join(f'--{flag}' for flag in meant)}?" if meant else ""
        return InputError(f"{parser.prog} has no {name}{hint}{f' ({reason})' if reason else ''}")
    return UnknownNameError("flag", name, set(known))


if __name__ == "__main__":
    sys.exit(main())
