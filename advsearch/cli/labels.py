"""`advsearch labels`: the classes of a model by name, those that are like a word first."""

from __future__ import annotations

import argparse

from advsearch.cli import output
from advsearch.cli.output import at_work
from advsearch.errors import InputError

HELP = "find the names of a model's classes, as --label takes them"
MORE = ". With --labels the model itself is not loaded. What stands for no thing, such as background, is left out"
EXAMPLES = ("labels", "labels mug --labels labels.json", "labels mug --model model.pt2 --labels labels.json --json")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    # late, so that --help answers at once
    from advsearch.cli.flags import add_settings

    parser.add_argument("word", metavar="WORD", nargs="?", help="what the names should be like; all without it")
    add_settings(parser, only=("model", "labels"))
    output.add_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Print index and name of the classes, best first.

    Raises:
        InputError: no class is like the word, or the model has no names for its classes.
    """
    with at_work(as_json=True, quiet=False):
        # late, so that --help answers at once
        from advsearch.models import matching_labels
        from advsearch.models.labels import names_nothing

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
    """Return the names of a model's classes in index order: those of a file, or else the model's own.

    Raises:
        InputError: the model has none.
    """
    # late, so that --help answers at once
    from advsearch.models import load_model, read_labels

    if labels is not None:
        return read_labels(labels)
    loaded = load_model(model)
    if not loaded.named:
        raise InputError(f"model {loaded.name} has {loaded.classes} classes without names; give a file with `labels`")
    return loaded.labels
