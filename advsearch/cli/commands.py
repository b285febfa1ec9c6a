"""The commands: what the help lists, and what carries each out.

A question's command is a module with `HELP` (one line), where there is more to say `MORE` (what the description says
after that) and `EXAMPLES` (lines of a shell), and a `QuestionCommand` called `COMMAND`, or else `add_arguments(parser)`
and `run(args) -> int`. It imports what is heavy inside functions, so that `advsearch --help` answers at once. Other
commands are a `Command` in this package, which is imported when it is asked for.
"""

from __future__ import annotations

import importlib
from typing import Any

from advsearch.cli.question import Positional, QuestionCommand
from advsearch.rooms import help_of as help_of_question
from advsearch.rooms import made_question, made_questions, rooms

ROOM = "advsearch.questions."

GROUPS = {
    "ask: what does a model get wrong?": {
        "attack": "",
        "sweep": "",
        "gap": "",
        "region": "",
        "explain": "",
        "compare": "",
        "recipe": "",
        "harden": "",
    },
    "look: at scenes, names and answers": {
        "render": "advsearch.cli.show:RENDER render a picture of a scene, and say what the model sees in it",
        "show": "advsearch.cli.show:SHOW "
        "show what a run found, or the details of a control, a policy, a task or a recipe",
        "view": "advsearch.cli.dashboard:VIEW write the page of a run again, or a folder that any web server can serve",
        "dashboard": "advsearch.cli.dashboard:DASHBOARD show the pages of runs in a browser on this machine",
        "report": "",
        "list": "advsearch.cli.names:LIST "
        "list all names: objects, environments, controls, policies, tasks, objectives, models and recipes",
        "labels": "advsearch.cli.names:LABELS find the names of a model's classes, as --label takes them",
    },
    "trust: does an answer hold, and is the tool right?": {
        "test": "",
        "replay": "",
        "check": "",
        "precision": "",
        "stability": "",
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
        "import-3db": "advsearch.cli.imports:IMPORT_3DB turn a folder that 3DB wrote into a run",
    },
}
"""Each command, in the groups and the order in which the help shows them: empty for a question, which is found by its
name; for another command its module, the `Command` in it and what it does. A question that `question`
makes needs no line here: the help shows it behind the others that ask."""

for _name in set(made_questions()).difference(*GROUPS.values()):
    next(iter(GROUPS.values()))[_name] = ""

COMMANDS = {name: place for group in GROUPS.values() for name, place in group.items() if place or name in rooms()}


def found(name: str) -> Any:
    """Return what adds the arguments of a command and runs it: its `QuestionCommand` or `Command`, or a module."""
    if COMMANDS[name]:
        place, _, attribute = COMMANDS[name].partition(" ")[0].partition(":")
        return getattr(importlib.import_module(place), attribute)
    if made := made_question(name):
        unflagged = Positional(*made.expected) if made.expected else None
        about, brought, examples = made.about, made.brought, made.examples
        return QuestionCommand(
            name, about=about, place=unflagged, brought=brought, listed=made.listed, examples=examples
        )
    module = importlib.import_module(f"{ROOM}{name}")
    return getattr(module, "COMMAND", module)


def help_of(name: str) -> str:
    """Return what a command does, in a line."""
    return COMMANDS[name].partition(" ")[2] or help_of_question(name)


def texts_of(name: str) -> tuple[str, tuple[str, ...]]:
    """Return what the help of a command says after what it does, and its examples."""
    module = found(name) if COMMANDS[name] or made_question(name) else importlib.import_module(f"{ROOM}{name}")
    more = getattr(module, "more", getattr(module, "MORE", ""))
    return more, getattr(module, "examples", getattr(module, "EXAMPLES", ()))
