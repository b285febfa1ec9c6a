"""`advsearch`: run a command, and turn errors into a message and an exit status.

Exit status: 0 if the command did its work, 1 for a bug, 2 for bad input, 3 if a check
or test did not pass, 130 if the command was interrupted.
"""

from __future__ import annotations

import argparse
import re
import shutil
import signal
import sys
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, cast

from advsearch.catalog import is_module_installed
from advsearch.cli import output
from advsearch.cli.output import (
    BAD_INPUT,
    INTERRUPTED,
    OK,
    end_output,
    escape_output,
    open_command_progress,
    open_descriptors,
    shorten_words,
)
from advsearch.errors import (
    AdvsearchError,
    CodeNotAllowedError,
    InputError,
    UnknownNameError,
)
from advsearch.interrupts import (
    INTERRUPTS,
    end_process_at_second_interrupt,
    report_unraisable_error,
)
from advsearch.registry import (
    EXPERIMENTS,
    get_experiment,
    get_experiment_help,
    load_attribute,
)
from advsearch.trust.code import allow_code, restrict_allowed_code
from advsearch.version import __version__

if TYPE_CHECKING:
    from advsearch.experiment import Experiment, PositionalArgument
    from advsearch.settings import Config

# --------------------------------------------------------------------------------
# The commands in the help, and the classes that run them.
#
# An experiment's command is made from it (`advsearch.experiment.Experiment`). Others
# are functions of this package made a `command`, imported when they are used, so that
# `advsearch --help` answers at once.

Argument = Callable[[argparse.ArgumentParser], object]  # adds something to a parser


def argument(*names: str, **options: Any) -> Argument:
    """Return a function that adds an argument to a parser, as `add_argument` does."""
    return methodcaller("add_argument", *names, **options)


@dataclass(frozen=True)
class PlainCommand:
    """A command that runs no experiment."""

    # runs the command with parsed arguments, and returns the exit status
    run: Callable[[argparse.Namespace], int]
    # functions that add the arguments to a parser, in the order of the help
    arguments: tuple[Argument, ...]
    more: str = ""  # text that the help appends to the description
    examples: tuple[str, ...] = ()  # command lines for the help, without `advsearch`

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        for add_to in self.arguments:
            add_to(parser)


def command(
    *arguments: Argument, more: str = "", examples: tuple[str, ...] = ()
) -> Callable[[Callable[[argparse.Namespace], int]], PlainCommand]:
    """Return a decorator that makes a `PlainCommand` of a function.

    The module and the name of the function are in `GROUPS`.
    """
    return lambda run: PlainCommand(run, arguments, more, examples)


@dataclass(frozen=True)
class ExperimentCommand:
    """The command of an experiment.

    Many experiments have a subject: a run, a file or a name that they are about. It is
    the value of one setting, whose name is `Experiment.about` (empty for an experiment
    without a subject). Since a run or a file may name Python code, `--code` allows this
    code to run.
    """

    experiment: Experiment[Any]

    @property
    def name(self) -> str:
        return self.experiment.settings.command

    @property
    def more(self) -> str:
        return self.experiment.help_suffix

    @property
    def examples(self) -> tuple[str, ...]:
        return self.experiment.examples

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the flags of the experiment's settings, and arguments without a flag.

        An argument without a flag is the subject of an experiment, such as the run in
        ``advsearch explain mug-sweep-001``.
        """
        # late, so that --help answers at once
        from advsearch.cli.flags import add_settings

        add_settings(parser, self.experiment.settings)
        output.add_quiet_flags(parser)
        if self.experiment.positional:
            self._add_subject(parser, self.experiment.positional)
        if self.experiment.about:  # its run or file may name code
            output.add_code_flag(parser)

    def _add_subject(
        self, parser: argparse.ArgumentParser, positional: PositionalArgument
    ) -> None:
        """Add the subject of the experiment as an argument without a flag."""
        subject_setting = self.experiment.about
        parser.add_argument(
            subject_setting,
            metavar=positional.metavar,
            nargs="*" if positional.is_repeatable else "?",
            default=argparse.SUPPRESS,
            help=f"as `--{subject_setting}`{positional.help_suffix}",
        )

    def run(self, args: argparse.Namespace) -> int:
        """Run the experiment that the arguments describe, and return the exit status.

        If the experiment chooses its subject from a list, as `recipe` does, the word
        "list" in place of the subject prints that list.

        Raises:
            InputError: the subject is missing.
        """
        subject_setting = self.experiment.about
        subject = getattr(args, subject_setting, None)
        if self.experiment.choices and subject == "list":
            return self._print_choices(as_json=args.json)
        self._check_subject(subject)
        # A repeatable subject is a list of words. As a setting it is one text with commas.
        if isinstance(subject, list):
            setattr(args, subject_setting, ",".join(subject))
        return self.run_config(
            self.read_config(args), as_json=args.json, quiet=args.quiet
        )

    def _check_subject(self, subject: object) -> None:
        """Check that a subject is there if the experiment takes one without a flag.

        Raises:
            InputError: it is missing.
        """
        is_missing = subject in (None, [])
        if self.experiment.positional and is_missing:
            command = f"advsearch {self.name}"
            raise InputError(
                f"{command}: expected {self.experiment.positional.expected}; see "
                f"{command} --help"
            )

    def _print_choices(self, *, as_json: bool) -> int:
        """Print the names that can be the subject, and return the exit status."""
        title_by_name = load_attribute(self.experiment.choices)()
        entries = [
            {"name": name, "title": title} for name, title in title_by_name.items()
        ]
        return output.print_answer(
            as_json,
            {f"{self.name}s": entries},
            output.align_columns([*title_by_name.items()]),
        )

    def read_config(self, args: argparse.Namespace) -> Config:
        """Return the settings that the arguments describe.

        Some experiments are about an earlier run. Settings that were not given are then
        taken from that run, or from the first one if there are several.

        Raises:
            InputError: a required setting and the run are both missing.
        """
        # late, so that --help answers at once
        from advsearch.cli.flags import make_config
        from advsearch.runs.directory import CONFIG, find_run

        config_type = self.experiment.settings
        read_defaults = self.experiment.defaults_from_run
        if read_defaults is None:
            return make_config(args, config_type)
        if self.experiment.about in args:  # the earlier run was given
            run = find_run(self._get_first_run_name(args))
            defaults = read_defaults(run / CONFIG, vars(args))
            return make_config(args, config_type, **defaults)
        self._check_required_settings(args)
        return make_config(args, config_type)

    def _get_first_run_name(self, args: argparse.Namespace) -> str:
        """Return the run that the experiment is about; of several, the first."""
        # late, so that --help answers at once
        from advsearch.settings import split_names

        run_name: str = getattr(args, self.experiment.about)
        positional = self.experiment.positional
        if positional and positional.is_repeatable:
            # a text without any name is left as it is, and rejected by `find_run`
            return next(iter(split_names(run_name)), run_name)
        return run_name

    def _check_required_settings(self, args: argparse.Namespace) -> None:
        """Check that all required settings are among the arguments, as no run has them.

        Raises:
            InputError: one is missing.
        """
        # late, so that --help answers at once
        from advsearch.settings import settings

        missing = [
            setting.flag
            for setting in settings(self.experiment.settings)
            if setting.required and setting.field not in args
        ]
        if missing:
            command = f"advsearch {self.name}"
            run_flag = f"--{self.experiment.about.replace('_', '-')} RUN"
            raise InputError(
                f"{command}: expected {missing[0]} NAME, or {run_flag}; "
                f"see {command} --help"
            )

    def run_config(
        self,
        config: Config,
        *,
        as_json: bool,
        quiet: bool,
        resumed_directory: Path | None = None,
    ) -> int:
        """Run the experiment, print the result and return the exit status.

        Args:
            config: its settings.
            as_json: print the result as JSON.
            quiet: print no progress.
            resumed_directory: folder of the run to go on with; None for a new run.
        """
        with open_command_progress(as_json=as_json, quiet=quiet) as progress:
            from advsearch import experiment  # late, so that --help answers at once

            result = experiment.run_experiment(
                config, progress=progress, resumed_directory=resumed_directory
            )
        status = output.print_result(result, as_json=as_json)
        if status != OK:  # the run was interrupted
            return status
        return self.experiment.exit_status(result)


GROUPS = {
    "ask: what does a model get wrong?": dict.fromkeys(
        ("attack", "sweep", "region", "explain", "compare", "recipe", "harden"), ""
    ),
    "look: at scenes, names and predictions": {
        "render": "",
        "show": "show:show show what a run found, or the details of a control, a "
        "policy, a task or a recipe",
        "view": "dashboard:view write the page of a run again, or a folder that any "
        "web server can serve",
        "dashboard": "dashboard:dashboard show the pages of runs in a browser on this "
        "machine",
        "report": "report:report write the evidence of runs for a model card or a "
        "safety case, with nothing that they do not show",
        "list": "show:list_all list all names: objects, environments, controls, "
        "policies, tasks, objectives, models "
        "and recipes",
        "labels": "show:labels find the names of a model's classes, as --label takes "
        "them",
    },
    "trust: does a result hold, and is the tool right?": {
        **dict.fromkeys(("test", "replay", "check", "precision", "stability"), ""),
        "doctor": "doctor:doctor check every component that a run needs, with its "
        "version and how to repair it",
    },
    "files and runs: repeat, continue, bring in, take out": {
        "run": "run:run do what a YAML file describes; the run.yaml of a run repeats it",
        "resume": "run:resume continue a run that was stopped, from where it stopped",
        "runs": "run:runs list the runs in a folder and how each ended",
        "export": "export:export export a run: its rows as a table, a texture for "
        "printing, a scene for Mitsuba or an "
        "object as glTF",
        "import": "imports:file show what advsearch reads from a mesh or scene file, "
        "as text or as a picture",
        "completion": "completion:completion "
        "print a script with which Tab finishes commands, flags and names in bash, zsh "
        "or tcsh",
        "import-3db": "imports:threedb turn a folder that 3DB wrote into a run",
    },
}
"""All commands, by group, in the order of the help.

The text of a command is "MODULE:FUNCTION what it does", with a module of this package.
It is empty for an experiment, which `catalog` describes.
"""

COMMANDS_OF_THIS_PACKAGE = {
    name: target
    for group in GROUPS.values()
    for name, target in group.items()
    if target
}


def list_commands() -> list[str]:
    """Return the names of all commands in the order of the help; experiments of
    packages follow the built-in ones.
    """
    groups = group_commands()
    return [name for group in groups.values() for name in group]


def group_commands() -> dict[str, list[str]]:
    """Return the names of the commands by the heading that the help has for them.

    Commands whose modules are missing are left out. Experiments of other packages,
    which no group names, are added to the first group.
    """
    groups = {
        title: [name for name, target in group.items() if _is_available(name, target)]
        for title, group in GROUPS.items()
    }
    known = {name for group in groups.values() for name in group}
    first_group = next(iter(groups.values()))
    first_group.extend(name for name in EXPERIMENTS if name not in known)
    return groups


def _is_available(name: str, target: str) -> bool:
    """Return whether a command can be used.

    Args:
        name: name of the command.
        target: text of the command in `GROUPS`, "MODULE:FUNCTION what it does"; empty
            for an experiment.
    """
    if not target:
        return name in EXPERIMENTS
    # an installation may lack the module of an optional command
    module = target.partition(":")[0]
    return is_module_installed(f"advsearch.cli.{module}")


def get_command(name: str) -> ExperimentCommand | PlainCommand:
    """Return the command of a name; its module is imported."""
    target = COMMANDS_OF_THIS_PACKAGE.get(name)
    if target is None:
        return ExperimentCommand(get_experiment(name))
    location = target.partition(" ")[0]
    command: PlainCommand = load_attribute(f"advsearch.cli.{location}")
    return command


def get_command_help(name: str) -> str:
    """Return the description of a command, as a clause."""
    target = COMMANDS_OF_THIS_PACKAGE.get(name)
    if target is None:
        return get_experiment_help(name)
    return target.partition(" ")[2]


_EXAMPLES = """examples:
  advsearch attack --object mug --control texture
  advsearch attack --object mug.obj --model model.pt2 --labels labels.json --label "mug,cup"
  advsearch run runs/mug-texture-001/run.yaml steps=80
  advsearch show runs/mug-texture-001
"""


class Parser(argparse.ArgumentParser):
    """An argument parser that raises `InputError` for wrong arguments."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see {self.prog} --help")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    An exception that is no `AdvsearchError` is a bug, and is not caught.

    Args:
        argv: words of the command line. None takes those of this process; then standard
            streams and the handling of Ctrl-C are set up, too, since the process does
            nothing else.
    """
    if argv is None:
        open_descriptors()
    with escape_output(), restrict_allowed_code():
        if argv is None:
            status = _run_interruptibly(sys.argv[1:])
            # From here on Ctrl-C is ignored: the interpreter ends, and native code that
            # runs then knows no handler of ours.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        else:
            status = _run_to_status(list(argv))
        end_output()
    return status


def _run_interruptibly(words: list[str]) -> int:
    """Run a command with a handler for Ctrl-C, and return its exit status.

    An interrupt leaves no traceback. After the command has ended, further interrupts
    are ignored.

    Args:
        words: words of the command line, without the program's name.
    """
    sys.unraisablehook = report_unraisable_error
    try:
        # The first Ctrl-C raises KeyboardInterrupt in Python code. The second one ends
        # the process, by a thread of its own, even while native code runs.
        signal.signal(signal.SIGINT, INTERRUPTS)
        end_process_at_second_interrupt()
        status = _run_to_status(words)
        INTERRUPTS.is_work_done = True
        return status
    except KeyboardInterrupt:  # a second one, while the first was being reported
        INTERRUPTS.is_work_done = True
        return INTERRUPTED


def _run_to_status(words: list[str]) -> int:
    """Run a command and return its exit status.

    If there was an interrupt, the status is `INTERRUPTED`, even if the command ended
    with another error or with a result.
    """
    try:
        status = _run_and_report_errors(words)
        # There was an interrupt, but some code has swallowed it. Raise it again, so
        # that the branch below handles it.
        if status != INTERRUPTED and INTERRUPTS.n_received:
            raise KeyboardInterrupt
        return status
    except BaseException as error:
        # Modules that are being imported, and native code, turn an interrupt into other
        # errors. So any error after an interrupt is taken for one.
        is_interrupt = isinstance(error, KeyboardInterrupt) or INTERRUPTS.n_received > 0
        if not is_interrupt:
            raise
        print("advsearch: interrupted", file=sys.stderr)
        return INTERRUPTED


def _run_and_report_errors(words: list[str]) -> int:
    """Run a command and return its exit status; print an `AdvsearchError` as a message.

    Args:
        words: words of the command line, without the program's name.
    """
    try:
        status = _run(words)
        sys.stdout.flush()
        return status
    except AdvsearchError as error:
        text = _format_error(error, words[0])
        print(f"advsearch: error: {shorten_words(text)}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:
        # the output is closed, for instance by `head`
        return OK


def _format_error(error: AdvsearchError, first_word: str) -> str:
    """Return the message of an error, with settings named as the user wrote them.

    Args:
        error: the error.
        first_word: first word of the command line.
    """
    # late, so that --help answers at once
    from advsearch.cli.flags import format_as_flags

    # A message names settings as in a file ("steps") if they come from a file, else as
    # flags ("--steps"). Some advice is always a flag, such as --code, since no file may
    # allow its own code.
    advises_flag = isinstance(error, (UnknownNameError, CodeNotAllowedError))
    is_about_file = first_word in ("run", "resume") and not advises_flag
    return str(error) if is_about_file else format_as_flags(str(error))


def _run(words: list[str]) -> int:
    """Run the command that the words of the command line name; return its exit status.

    Python code that the flag `--code` names is allowed to run from here on.
    """
    name = words[0] if words and not words[0].startswith("-") else None
    _check_command_name(name)
    try:
        args = _parse(words, name)
    except SystemExit as stop:  # --help and --version have printed their text
        return int(stop.code or 0)
    allow_code(*getattr(args, "code", ()))
    return int(get_command(args.command).run(args))


def _check_command_name(name: str | None) -> None:
    """Check that there is a command of a name; None, for none, is right.

    Raises:
        InputError: the command was removed.
        UnknownNameError: there is no such command.
    """
    if name == "plan":
        raise InputError(
            "`plan` is a part of `check` now: use advsearch check --loss "
            "model, with the same flags"
        )
    if name is not None and name not in list_commands():
        raise UnknownNameError(
            "command", name, list_commands(), "See advsearch --help."
        )


def _parse(words: list[str], command: str | None) -> argparse.Namespace:
    """Parse the words of the command line.

    Only the flags of `command` are made, since making those of all commands takes half
    a second. Without a command the help is printed and `SystemExit` is raised.
    """
    parser, subparsers = make_parser_without_commands()
    for name in list_commands():
        add_command(subparsers, name, with_arguments=name == command)
    args, unknown = parser.parse_known_args(_join_negative_axis(words))
    if unknown:
        command_parser = subparsers.choices[args.command] if args.command else parser
        raise _unknown_argument(unknown[0], command_parser)
    if args.command is None:
        parser.print_help()
        parser.exit()
    return args


def _join_negative_axis(words: list[str]) -> list[str]:
    """Return the words with ``--facing -z`` joined to ``--facing=-z``, as argparse
    takes ``-z`` alone for a flag.
    """
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] == "--facing" and word in ("-x", "-y", "-z"):
            joined[-1] = f"--facing={word}"
        else:
            joined.append(word)
    return joined


def make_parser_without_commands() -> tuple[
    argparse.ArgumentParser, argparse._SubParsersAction[Any]
]:
    """Make the parser of the command line, to which commands are still to be added.

    Its help lists all commands already.

    Returns:
        The parser, and the parsers of its commands, to which `add_command` adds.
    """
    parser = Parser(
        prog="advsearch",
        description="Find the scene that a vision model gets wrong most badly.",
        epilog="\n".join([*_list_commands_with_help(), _EXAMPLES]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--version", action="version", version=f"advsearch {__version__}"
    )
    subparsers = parser.add_subparsers(
        dest="command",
        metavar="COMMAND",
        title="commands",
        help="one of the commands below; advsearch COMMAND --help explains it",
        parser_class=Parser,
    )
    return parser, subparsers


def _list_commands_with_help() -> list[str]:
    """Return the lines of the help that list the commands in their groups.

    The lines have a column of names and a column of descriptions.
    """
    groups = group_commands()
    longest_name = max(len(name) for group in groups.values() for name in group)
    text_begin = longest_name + 4  # two spaces on each side of the names
    lines = []
    for title, names in groups.items():
        lines.append(title)
        lines += [_format_command_line(name, text_begin) for name in names]
        lines.append("")
    return lines


def _format_command_line(name: str, text_begin: int) -> str:
    """Return a command's name and its description, which is wrapped.

    Args:
        name: name of the command.
        text_begin: column at which the description begins.
    """
    # in a narrow terminal too, texts get as much width as names
    line_width = max(shutil.get_terminal_size().columns - 2, 2 * text_begin)
    text = f"  {name}".ljust(text_begin) + get_command_help(name)
    return textwrap.fill(text, line_width, subsequent_indent=" " * text_begin)


def add_command(
    subparsers: argparse._SubParsersAction[Any],
    name: str,
    *,
    with_arguments: bool = True,
) -> argparse.ArgumentParser:
    """Add a command to the parsers, and return its parser.

    Args:
        subparsers: the second value that `make_parser_without_commands`
            returns.
        name: name of the command.
        with_arguments: make its arguments and help; without, it only has a name.
    """
    if not with_arguments:
        return cast(argparse.ArgumentParser, subparsers.add_parser(name))
    command = get_command(name)
    text = get_command_help(name)
    parser: argparse.ArgumentParser = subparsers.add_parser(
        name,
        help=text,
        description=f"{text[0].upper()}{text[1:]}{command.more}.",
        allow_abbrev=False,
        **_make_examples_options(command.examples),
    )
    command.add_arguments(parser)
    return parser


def _make_examples_options(examples: Sequence[str]) -> dict[str, Any]:
    """Return the options of a parser with which its help ends with examples.

    Args:
        examples: command lines without `advsearch`; empty for a help without examples.
    """
    if not examples:
        return {"epilog": None, "formatter_class": argparse.HelpFormatter}
    lines = "".join(f"  advsearch {line}\n" for line in examples)
    return {
        "epilog": f"examples:\n{lines}",
        # the examples keep their line breaks
        "formatter_class": argparse.RawDescriptionHelpFormatter,
    }


def _unknown_argument(argument: str, parser: argparse.ArgumentParser) -> InputError:
    """Return the error for an argument that a parser does not know.

    The message has the first suggestion that applies: for a word without dashes, to
    write `--object` before it; for a flag of another command, that command; else a flag
    with a similar spelling or meaning.

    Args:
        argument: the unknown argument, such as "--step=3".
        parser: parser of the command.
    """
    name = argument.partition("=")[0]
    # the flags of the command, as its help writes them
    known = re.findall(r"(?<!\S)--[a-z][a-z-]*", parser.format_help())
    if not name.startswith("--"):
        return _make_no_flag_error(argument, parser.prog, known)
    commands_with_flag = _find_commands_with_flag(name)
    if commands_with_flag:
        return InputError(
            f"{parser.prog} has no {name}, a flag of advsearch "
            f"{', '.join(commands_with_flag)}; leave it out"
        )
    advice = _suggest_flag(name, known)
    if advice:
        return InputError(f"{parser.prog} has no {name}{advice}")
    # a flag with a similar spelling is suggested
    return UnknownNameError("flag", name, set(known))


def _make_no_flag_error(
    argument: str, program: str, known: Sequence[str]
) -> InputError:
    """Return the error for a word without dashes where a flag is expected.

    Args:
        argument: the word.
        program: the command, such as "advsearch attack".
        known: its flags.
    """
    hint = ""
    if "--object" in known:
        hint = f"; for the object write --object {argument}"
    return InputError(f"expected flags, got {argument!r}{hint}; see {program} --help")


def _find_commands_with_flag(flag: str) -> list[str]:
    """Return the names of the commands that have a flag, such as "--steps"."""
    # late, so that --help answers at once
    from advsearch.config import CONFIGS
    from advsearch.settings import settings

    return [
        command
        for command, config in CONFIGS.items()
        if flag in (setting.flag for setting in settings(config))
    ]


def _suggest_flag(flag: str, known: Sequence[str]) -> str:
    """Return the flag for what other libraries call by a name, or why there is none.

    Args:
        flag: the unknown flag.
        known: the flags of the command.

    Returns:
        The end of a message; empty if the name is unknown elsewhere, too.
    """
    # late, so that --help answers at once
    from advsearch.calls import suggest_keyword

    keyword = flag.removeprefix("--").replace("-", "_")
    suggestions, reason = suggest_keyword(
        keyword, [known_flag.removeprefix("--") for known_flag in known]
    )
    text = ""
    if suggestions:
        flags = " or ".join(f"--{suggestion}" for suggestion in suggestions)
        text += f"; did you mean {flags}?"
    if reason:
        text += f" ({reason})"
    return text


if __name__ == "__main__":
    sys.exit(main())
