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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, cast

from advsearch import __version__
from advsearch.cli import output
from advsearch.cli.output import BAD_INPUT, INTERRUPTED, OK, at_work, end_output, open_descriptors, screens, shortened
from advsearch.errors import AdvsearchError, InputError, UnknownNameError
from advsearch.interrupts import INTERRUPTS, end_at_the_second, unless_interrupted
from advsearch.registry import allow_code, imported, made_question, made_questions, nothing_allowed, rooms
from advsearch.registry import help_of as help_of_question

if TYPE_CHECKING:
    from advsearch.settings import Config

# ---------------------------------------------------------------------------------------------------------------------
# The commands: what the help lists, and what carries each out.
#
# A question's command is made of it (`advsearch.question.question`), or a module with `HELP` (one line) and a
# `QuestionCommand` or `PlainCommand` called `COMMAND`. It imports what is heavy inside functions, so that `advsearch
# --help` answers at once. Others are functions of this package made a `command`, imported when they are asked for.

Argument = Callable[[argparse.ArgumentParser], object]  # adds something to a parser


def argument(*names: str, **options: Any) -> Argument:
    """Return what adds an argument to a parser, as its `add_argument` does."""
    return methodcaller("add_argument", *names, **options)


@dataclass(frozen=True)
class PlainCommand:
    """A command that asks no question."""

    run: Callable[[argparse.Namespace], int]  # does what the arguments say, and returns the exit status
    arguments: tuple[Argument, ...]  # what adds them, in the order in which the help shows them
    more: str = ""  # what its help says after what it does
    examples: tuple[str, ...] = ()  # lines of a shell, without `advsearch`

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        for add in self.arguments:
            add(parser)


def command(
    *arguments: Argument, more: str = "", examples: tuple[str, ...] = ()
) -> Callable[[Callable[[argparse.Namespace], int]], PlainCommand]:
    """Make a `PlainCommand` of a function; its module and name stand in `GROUPS`."""
    return lambda run: PlainCommand(run, arguments, more, examples)


class Positional(NamedTuple):
    """How what a question is about is given without its flag, the fields of `expected`."""

    metavar: str  # what the help calls it
    missing: str  # what an error says where neither is given
    more: str = ""  # what the help adds
    several: bool = False


@dataclass(frozen=True)
class QuestionCommand:
    """A command that asks a question.

    Attributes:
        name: of the command; `advsearch.config.CONFIGS` has its settings, and `question.carry_out` asks with them.
        text: makes a text for a person of its result; what is shown of it where it has no other.
        short, about, expected, brought, listed, more, examples: as of `advsearch.question.Question`; `--code` allows
            Python code that the runs, or the file, which it is about name.
    """

    name: str
    text: Callable[[Any], str] = output.shown_text
    short: Callable[[Any], bool] = lambda result: False
    about: str = ""
    expected: tuple[Any, ...] | None = None
    brought: Callable[[Path, Mapping[str, Any]], dict[str, Any]] | None = None
    listed: str = ""
    more: str = ""
    examples: tuple[str, ...] = ()

    @property
    def place(self) -> Positional | None:
        """How what it is about is given without its flag; None for not at all."""
        return Positional(*self.expected) if self.expected else None

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        # late, so that --help answers at once
        from advsearch.cli.flags import add_settings
        from advsearch.config import CONFIGS

        add_settings(parser, CONFIGS[self.name])
        output.add_quiet_flags(parser)
        if place := self.place:
            many, text = "*" if place.several else "?", f"as `--{self.about}`{place.more}"
            parser.add_argument(self.about, metavar=place.metavar, nargs=many, default=argparse.SUPPRESS, help=text)
        if self.about:
            output.add_code_flag(parser)

    def run(self, args: argparse.Namespace) -> int:
        """Ask what the arguments say. Raises InputError where what it is about is missing."""
        named, place = getattr(args, self.about, None), self.place
        if self.listed and named == "list":
            lines = imported(self.listed)()
            listed = [{"name": name, "title": text} for name, text in lines.items()]
            return output.say(args.json, {f"{self.name}s": listed}, output.aligned([*lines.items()]))
        if place and named in (None, []):
            command = f"advsearch {self.name}"
            raise InputError(f"{command}: expected {place.missing}; see {command} --help")
        if isinstance(named, list):
            setattr(args, self.about, ",".join(named))
        return self.carry_out(self.config(args), as_json=args.json, quiet=args.quiet)

    def config(self, args: argparse.Namespace) -> Config:
        """Return the configuration that the arguments describe, over what the first run that it is about brings."""
        # late, so that --help answers at once
        from advsearch.cli.flags import config_from
        from advsearch.config import CONFIGS
        from advsearch.runs.directory import CONFIG, find_run
        from advsearch.settings import settings, split_names

        config, brought = CONFIGS[self.name], dict[str, Any]()
        if self.brought and self.about in args:
            name = getattr(args, self.about)
            name = next(iter(split_names(name)), name) if self.place and self.place.several else name
            brought = self.brought(find_run(name) / CONFIG, vars(args))
        elif self.brought and (missing := [s.flag for s in settings(config) if s.required and s.field not in args]):
            command, run = f"advsearch {self.name}", f"--{self.about.replace('_', '-')} RUN"
            raise InputError(f"{command}: expected {missing[0]} NAME, or {run}; see {command} --help")
        return config_from(args, config, **brought)

    def carry_out(self, config: Config, *, as_json: bool, quiet: bool, resumed: Path | None = None) -> int:
        """Ask what `config` describes, or go on with it; print the result and return the exit status."""
        with at_work(as_json=as_json, quiet=quiet) as progress:
            from advsearch.question import carry_out  # late, so that --help answers at once

            result = carry_out(config, progress=progress, resumed=resumed)
        status = output.finish(result, self.text, as_json=as_json)
        return status or (output.FELL_SHORT if self.short(result) else 0)


GROUPS = {
    "ask: what does a model get wrong?": dict.fromkeys(
        ("attack", "sweep", "gap", "region", "explain", "compare", "recipe", "harden"), ""
    ),
    "look: at scenes, names and predictions": {
        "render": "show:RENDER render a picture of a scene, and say what the model sees in it",
        "show": "show:show show what a run found, or the details of a control, a policy, a task or a recipe",
        "view": "dashboard:view write the page of a run again, or a folder that any web server can serve",
        "dashboard": "dashboard:dashboard show the pages of runs in a browser on this machine",
        "report": "",
        "list": "show:list_all list all names: objects, environments, controls, policies, tasks, objectives, models "
        "and recipes",
        "labels": "show:labels find the names of a model's classes, as --label takes them",
    },
    "trust: does a result hold, and is the tool right?": {
        **dict.fromkeys(("test", "replay", "check", "precision", "stability"), ""),
        "doctor": "doctor:doctor check every part that a run needs, with versions and how to mend it",
    },
    "files and runs: repeat, continue, bring in, take out": {
        "run": "run:run do what a YAML file describes; the run.yaml of a run repeats it",
        "resume": "run:resume continue a run that was stopped, from where it stopped",
        "runs": "run:runs list the runs in a folder and how each ended",
        "export": "export:export export a run: its rows as a table, a texture for printing, a scene for Mitsuba or an "
        "object as glTF",
        "import": "imports:file show what advsearch reads from a mesh or scene file, as text or as a picture",
        "completion": "completion:completion "
        "print a script with which Tab finishes commands, flags and names in bash, zsh or tcsh",
        "import-3db": "imports:threedb turn a folder that 3DB wrote into a run",
    },
}
"""Each command, in the groups and the order in which the help shows them: empty for a question, which is found by its
name; for another command its module in this package, its function there and what it does. A question that `question`
makes needs no line here: the help shows it behind the others that ask."""

for _name in set(made_questions()).difference(*GROUPS.values()):
    next(iter(GROUPS.values()))[_name] = ""

COMMANDS = {name: place for group in GROUPS.values() for name, place in group.items() if place or name in rooms()}


def command_named(name: str) -> Any:
    """Return the `QuestionCommand` or `PlainCommand` of a name."""
    if COMMANDS[name]:
        return imported(f"advsearch.cli.{COMMANDS[name].partition(' ')[0]}")
    if made := made_question(name):
        same = ("short", "about", "expected", "brought", "listed", "more", "examples")
        return QuestionCommand(name, **{attribute: getattr(made, attribute) for attribute in same})
    return imported(f"advsearch.questions.{name}:COMMAND")


def help_of(name: str) -> str:
    return COMMANDS[name].partition(" ")[2] or help_of_question(name)


_EXAMPLES = """examples:
  advsearch attack --object mug --control texture
  advsearch attack --object mug.obj --environment room.hdr --model model.pt2 --labels labels.json --label "mug,cup"
  advsearch run runs/mug-texture-001/run.yaml steps=80
  advsearch show runs/mug-texture-001
"""


class Parser(argparse.ArgumentParser):
    """argparse, but what is wrong with the arguments is an `InputError`."""

    def error(self, message: str) -> NoReturn:
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
    name = words[0] if words and not words[0].startswith("-") else None
    if name == "plan":
        raise InputError("`plan` is a part of `check` now: use advsearch check --loss model, with the same flags")
    if name is not None and name not in COMMANDS:
        raise UnknownNameError("command", name, COMMANDS, "See advsearch --help.")
    try:
        args = _parse(words, name)
    except SystemExit as stop:  # --help and --version have printed their text
        return int(stop.code or 0)
    allow_code(*getattr(args, "code", ()))
    return int(command_named(args.command).run(args))


def _parse(words: list[str], command: str | None) -> argparse.Namespace:
    parser, subparsers = without_commands()
    for name in COMMANDS:
        add_command(subparsers, name, whole=name == command)
    args, unknown = parser.parse_known_args(_join_negative_axis(words))
    if unknown:
        raise _unknown_argument(unknown[0], subparsers.choices[args.command] if args.command else parser)
    if args.command is None:
        parser.print_help()
        parser.exit()
    return args


def _join_negative_axis(words: list[str]) -> list[str]:
    """Return the words with `--facing -z` as one, as argparse takes `-z` for a flag."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] == "--facing" and word in ("-x", "-y", "-z"):
            joined[-1] = f"--facing={word}"
        else:
            joined.append(word)
    return joined


def without_commands() -> tuple[argparse.ArgumentParser, argparse._SubParsersAction[Any]]:
    """Return the parser, and what `add_command` adds the commands to."""
    column = 4 + max(map(len, COMMANDS))
    width = max(shutil.get_terminal_size().columns - 2, 2 * column)
    lines = []
    for title, commands in GROUPS.items():
        texts = [f"  {name}".ljust(column) + help_of(name) for name in commands if name in COMMANDS]
        lines += [title, *(textwrap.fill(text, width, subsequent_indent=" " * column) for text in texts), ""]
    parser = Parser(
        prog="advsearch",
        description="Find the scene that a vision model gets wrong most badly.",
        epilog="\n".join([*lines, _EXAMPLES]),
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
