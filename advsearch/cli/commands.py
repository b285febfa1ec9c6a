"""The commands: what the help lists, and what carries each out.

A question's command is made of it (`advsearch.question.question`), or a module with `HELP` (one line) and a
`QuestionCommand` or `PlainCommand` called `COMMAND`. It imports what is heavy inside functions, so that `advsearch
--help` answers at once. Other commands are a `PlainCommand` in this package, which is imported when it is asked for.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch.cli import output
from advsearch.cli.output import at_work
from advsearch.errors import InputError
from advsearch.rooms import help_of as help_of_question
from advsearch.rooms import made_question, made_questions, rooms

if TYPE_CHECKING:
    from advsearch.settings import Config


Argument = Callable[[argparse.ArgumentParser], object]  # adds something to a parser


def argument(*names: str, **options: Any) -> Argument:
    """Return what adds an argument to a parser, as its `add_argument` does."""
    return methodcaller("add_argument", *names, **options)


@dataclass(frozen=True)
class PlainCommand:
    """A command that asks no question.

    Attributes:
        run: does what the arguments say, and returns the exit status.
        arguments: what adds them, in the order in which the help shows them.
        more: what its help says after what it does.
        examples: lines of a shell, without `advsearch`.
    """

    run: Callable[[argparse.Namespace], int]
    arguments: tuple[Argument, ...]
    more: str = ""
    examples: tuple[str, ...] = ()

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add its arguments to a parser."""
        for add in self.arguments:
            add(parser)


@dataclass(frozen=True)
class Positional:
    """How a setting is given without its flag: what the help calls it and says of it, what is missing where neither is
    given, and whether there may be several."""

    metavar: str
    expected: str
    more: str = ""
    several: bool = False


@dataclass(frozen=True)
class QuestionCommand:
    """A command that asks a question.

    Attributes:
        name: of the command; `advsearch.config.CONFIGS` has its settings, and `question.carry_out` asks with them.
        text: makes a text for a person of its result; what is shown of it where it has no other.
        short: whether a result falls short of what was checked.
        about: the setting that names runs, or a file, which the question is about; `--code` allows Python code that
            these name.
        place: how that setting is given without its flag.
        brought: returns the settings that the `run.yaml` of the run that it is about brings, by what was typed.
        listed: where the function is that returns what it may be about, with a line about each, which `list` prints.
        more, examples: as of `PlainCommand`.
    """

    name: str
    text: Callable[[Any], str] = output.shown_text
    short: Callable[[Any], bool] = lambda result: False
    about: str = ""
    place: Positional | None = None
    brought: Callable[[Path, Mapping[str, Any]], dict[str, Any]] | None = None
    listed: str = ""
    more: str = ""
    examples: tuple[str, ...] = ()

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add a flag for each of the settings, and those that commands share."""
        # late, so that --help answers at once
        from advsearch.cli.flags import add_settings
        from advsearch.config import CONFIGS

        add_settings(parser, CONFIGS[self.name])
        output.add_quiet_flags(parser)
        if self.place:
            parser.add_argument(
                self.about,
                metavar=self.place.metavar,
                nargs="*" if self.place.several else "?",
                default=argparse.SUPPRESS,
                help=f"as `--{self.about}`{self.place.more}",
            )
        if self.about:
            output.add_code_flag(parser)

    def run(self, args: argparse.Namespace) -> int:
        """Ask what the arguments say. Raises InputError where what it is about is missing."""
        named = getattr(args, self.about, None)
        if self.listed and named == "list":
            module, _, function = self.listed.partition(":")
            lines = getattr(importlib.import_module(module), function)()
            listed = [{"name": name, "title": text} for name, text in lines.items()]
            return output.say(args.json, {f"{self.name}s": listed}, output.aligned([*lines.items()]))
        if self.place and named in (None, []):
            command = f"advsearch {self.name}"
            raise InputError(f"{command}: expected {self.place.expected}; see {command} --help")
        if isinstance(named, list):
            setattr(args, self.about, ",".join(named))
        return self.carry_out(self.config(args), as_json=args.json, quiet=args.quiet)

    def file(self, args: argparse.Namespace) -> Path | None:
        """Return the settings of the first run that the question is about, if it is about one."""
        # late, so that --help answers at once
        from advsearch.runs.directory import CONFIG, find_run
        from advsearch.settings import split_names

        if self.about not in args:
            return None
        name = getattr(args, self.about)
        if self.place and self.place.several:
            name = next(iter(split_names(name)), name)
        return find_run(name) / CONFIG

    def config(self, args: argparse.Namespace, **over: Any) -> Config:
        """Return the configuration that the arguments describe, over settings from elsewhere."""
        # late, so that --help answers at once
        from advsearch.cli.flags import config_from
        from advsearch.config import CONFIGS
        from advsearch.settings import settings

        config = CONFIGS[self.name]
        if self.brought and (file := self.file(args)):
            over = {**self.brought(file, vars(args)), **over}
        elif self.brought and (missing := [s.flag for s in settings(config) if s.required and s.field not in args]):
            command, run = f"advsearch {self.name}", f"--{self.about.replace('_', '-')} RUN"
            raise InputError(f"{command}: expected {missing[0]} NAME, or {run}; see {command} --help")
        return config_from(args, config, **over)

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
        "render": "advsearch.cli.show:RENDER render a picture of a scene, and say what the model sees in it",
        "show": "advsearch.cli.show:SHOW "
        "show what a run found, or the details of a control, a policy, a task or a recipe",
        "view": "advsearch.cli.dashboard:VIEW write the page of a run again, or a folder that any web server can serve",
        "dashboard": "advsearch.cli.dashboard:DASHBOARD show the pages of runs in a browser on this machine",
        "report": "",
        "list": "advsearch.cli.show:LIST "
        "list all names: objects, environments, controls, policies, tasks, objectives, models and recipes",
        "labels": "advsearch.cli.show:LABELS find the names of a model's classes, as --label takes them",
    },
    "trust: does a result hold, and is the tool right?": {
        **dict.fromkeys(("test", "replay", "check", "precision", "stability"), ""),
        "doctor": "advsearch.cli.doctor:DOCTOR check every part that a run needs, with versions and how to mend it",
    },
    "files and runs: repeat, continue, bring in, take out": {
        "run": "advsearch.cli.run:RUN do what a YAML file describes; the run.yaml of a run repeats it",
        "resume": "advsearch.cli.run:RESUME continue a run that was stopped, from where it stopped",
        "runs": "advsearch.cli.run:RUNS list the runs in a folder and how each ended",
        "export": "advsearch.cli.export:EXPORT "
        "export a run: its rows as a table, a texture for printing, a scene for Mitsuba or an object as glTF",
        "import": "advsearch.cli.imports:IMPORT "
        "show what advsearch reads from a mesh or scene file, as text or as a picture",
        "completion": "advsearch.cli.completion:COMPLETION "
        "print a script with which Tab finishes commands, flags and names in bash, zsh or tcsh",
        "import-3db": "advsearch.cli.imports:IMPORT_3DB turn a folder that 3DB wrote into a run",
    },
}
"""Each command, in the groups and the order in which the help shows them: empty for a question, which is found by its
name; for another command its module, the `PlainCommand` in it and what it does. A question that `question`
makes needs no line here: the help shows it behind the others that ask."""

for _name in set(made_questions()).difference(*GROUPS.values()):
    next(iter(GROUPS.values()))[_name] = ""

COMMANDS = {name: place for group in GROUPS.values() for name, place in group.items() if place or name in rooms()}


def command_named(name: str) -> Any:
    """Return the `QuestionCommand` or `PlainCommand` of a name."""
    if COMMANDS[name]:
        place, _, attribute = COMMANDS[name].partition(" ")[0].partition(":")
        return getattr(importlib.import_module(place), attribute)
    if made := made_question(name):
        unflagged = Positional(*made.expected) if made.expected else None
        return QuestionCommand(
            name, short=made.short, about=made.about, place=unflagged, brought=made.brought, listed=made.listed,
            more=made.more, examples=made.examples,
        )  # fmt: skip
    return importlib.import_module(f"advsearch.questions.{name}").COMMAND


def help_of(name: str) -> str:
    """Return what a command does, in a line."""
    return COMMANDS[name].partition(" ")[2] or help_of_question(name)
