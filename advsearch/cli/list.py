"""`advsearch list`: the names of objects, environments, controls, policies, tasks, objectives, models and recipes."""

from __future__ import annotations

import argparse
import importlib
import inspect
from collections.abc import Mapping
from typing import Any

from advsearch.cli import output
from advsearch.cli.output import at_work
from advsearch.rooms import there

HELP = "list all names: objects, environments, controls, policies, tasks, objectives, models and recipes"

_EVERY = {
    "objects": "advsearch.scene.library:list_objects",
    "environments": "advsearch.scene.library:list_environments",
    "controls": "advsearch.controls:CONTROLS",
    "policies": "advsearch.attacks:POLICIES",
    "tasks": "advsearch.tasks:TASKS",
    "objectives": "advsearch.attacks.objectives:objective_summaries",
    "models": "advsearch.cli.list:MODELS",
    "recipes": "advsearch.questions.recipe.description:titles",
}
REGISTRIES = {kind: place for kind, place in _EVERY.items() if there(place)}
"""Where the names of each kind are: a mapping from them, or a function that returns them."""

MODELS = {"reference": "the bundled classifier of household objects; models of your own are given as files"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", nargs="?", default="all", choices=[*REGISTRIES, "all"], help="default: all")
    output.add_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Print the names of one kind, or of all."""
    kinds = list(REGISTRIES) if args.kind == "all" else [args.kind]
    with at_work(as_json=True, quiet=False):
        found = {kind: list_names(kind) for kind in kinds}
    if args.json:
        output.print_json({"schema": 1, **{kind: list(entries) for kind, entries in found.items()}})
        return 0
    for number, (kind, entries) in enumerate(found.items()):
        if args.kind == "all":
            print(("\n" if number else "") + f"{kind}:")
        print(output.aligned([[name, text] for name, text in entries.items()]))
    return 0


def list_names(kind: str) -> dict[str, str]:
    """Return the names of one kind, each with one line about it where its registry has one."""
    module, _, attribute = REGISTRIES[kind].partition(":")
    registry = getattr(importlib.import_module(module), attribute)
    entries = registry() if callable(registry) else registry
    if isinstance(entries, Mapping):
        return {str(name): first_doc_line(entry) for name, entry in entries.items()}
    return {str(name): "" for name in entries}


def first_doc_line(entry: Any) -> str:
    """Return the first line of what an entry of a registry says of itself; empty for plain values."""
    documented = entry if inspect.isroutine(entry) or inspect.isclass(entry) else type(entry)
    if documented.__module__ == "builtins":
        return str(entry) if isinstance(entry, str) else ""
    return (inspect.getdoc(documented) or "").partition("\n")[0]
