"""`advsearch list`: all names; `advsearch labels`: the classes of a model by name, those that are like a word first."""

from __future__ import annotations

import argparse
import importlib
import inspect
from collections.abc import Mapping
from typing import Any

from advsearch.cli import output
from advsearch.cli.flags import add_settings
from advsearch.cli.output import at_work
from advsearch.cli.question import Command
from advsearch.errors import InputError
from advsearch.registry import allow_named
from advsearch.rooms import there

_EVERY = {
    "objects": "advsearch.scene.library:list_objects",
    "environments": "advsearch.scene.library:list_environments",
    "controls": "advsearch.controls:CONTROLS",
    "policies": "advsearch.attacks:POLICIES",
    "tasks": "advsearch.tasks:TASKS",
    "objectives": "advsearch.attacks.objectives:objective_summaries",
    "models": "advsearch.cli.names:MODELS",
    "recipes": "advsearch.questions.recipe.description:titles",
}
REGISTRIES = {kind: place for kind, place in _EVERY.items() if there(place)}
"""Where the names of each kind are: a mapping from them, or a function that returns them."""

MODELS = {"reference": "the bundled classifier of household objects; models of your own are given as files"}


def _list_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", nargs="?", default="all", choices=[*REGISTRIES, "all"], help="default: all")
    output.add_flags(parser)


def _list(args: argparse.Namespace) -> int:
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


LIST = Command(_list_arguments, _list)


def _labels_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("word", metavar="WORD", nargs="?", help="what the names should be like; all without it")
    add_settings(parser, only=("model", "labels"))
    output.add_flags(parser)


def _labels(args: argparse.Namespace) -> int:
    """Print index and name of the classes, best first. Raises InputError where no class is like the word, or the model
    has no names for its classes."""
    with at_work(as_json=True, quiet=False):
        # late, so that --help answers at once
        from advsearch.models.labels import matching_labels, names_nothing

        labels = class_names(getattr(args, "model", "reference"), getattr(args, "labels", None))
        if args.word is None:
            indices = list(range(len(labels)))
        else:
            indices = [index for index, _ in matching_labels(args.word, labels)]
        if args.word is None or not names_nothing(args.word):
            indices = [index for index in indices if not names_nothing(labels[index])]
    if not indices:
        raise InputError(f"none of the {len(labels)} labels is like {args.word!r}; leave the word out to see all")
    if args.json:
        listed = [{"index": index, "label": labels[index]} for index in indices]
        output.print_json({"schema": 1, "command": "labels", "word": args.word, "labels": listed})
    else:
        print(output.aligned([[f"#{index}", labels[index]] for index in indices]))
    return 0


def class_names(model: str, labels: str | None) -> tuple[str, ...]:
    """Return the names of a model's classes in index order: those of a file, or else the model's own. Raises InputError
    where the model has none."""
    # late, so that --help answers at once
    from advsearch.models import load_model, read_labels

    if labels is not None:
        return read_labels(labels)
    allow_named({"model": model})
    loaded = load_model(model)
    if not loaded.named:
        raise InputError(f"model {loaded.name} has {loaded.classes} classes without names; give a file with `labels`")
    return loaded.labels


LABELS = Command(
    _labels_arguments,
    _labels,
    ". With --labels the model itself is not loaded. What stands for no thing, such as background, is left out",
    ("labels", "labels mug --labels labels.json", "labels mug --model model.pt2 --labels labels.json --json"),
)
