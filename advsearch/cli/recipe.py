"""`advsearch recipe`: an experiment that a YAML file describes, and what its figures say."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from advsearch.cli import output
from advsearch.cli.question import QuestionCommand
from advsearch.errors import InputError

if TYPE_CHECKING:
    from advsearch.runs.results.recipe import RecipeResult

HELP = "carry out an experiment that a recipe describes, with a page of figures and what they say"

LIST = "list"
"""What lists the recipes instead."""


class _Recipe(QuestionCommand):
    """The command, which takes the recipe by its place, or by `--recipe`."""

    def add_parser(self, subparsers: argparse._SubParsersAction[Any]) -> argparse.ArgumentParser:
        """Add the command."""
        parser = super().add_parser(subparsers)
        parser.add_argument(
            "recipe",
            metavar="NAME",
            nargs="?",
            default=argparse.SUPPRESS,
            help="as `--recipe`; list shows the recipes that there are",
        )
        output.add_code_flag(parser)
        return parser

    def run(self, args: argparse.Namespace) -> int:
        """Carry out the recipe and print what it says, or list the recipes."""
        from advsearch.recipes.description import is_file_name
        from advsearch.registry import only_named_code

        if "recipe" not in args:
            raise InputError("advsearch recipe: expected a recipe, or list; see advsearch recipe --help")
        if args.recipe == LIST:
            return _listed(args.json)
        if not is_file_name(args.recipe):
            return super().run(args)
        given = [name.strip() for name in getattr(args, "model", "").split(",")]
        with only_named_code(args.recipe, [*args.code, *(one.partition("@")[0] for one in given)]):
            return super().run(args)


def _listed(as_json: bool) -> int:
    from advsearch.recipes.description import titles

    found = titles()
    if as_json:
        output.print_json({"schema": 1, "recipes": [{"name": name, "title": text} for name, text in found.items()]})
    else:
        print(output.columns([[name, text] for name, text in found.items()]))
    return 0


def answer(result: RecipeResult) -> str:
    """Return what each figure says, and the cost."""
    from advsearch.report import wording
    from advsearch.runs.directory import REPORT

    said = [f"{one.title}\n" + "\n".join(f"  {text}" for text in one.text) for one in result.figures]
    facts = [
        ["runs", str(len(result.parts))],
        ["renders", str(sum(one.renders for one in result.parts))],
        ["time", wording.seconds_text(result.seconds["total"])],
        ["page", f"{result.run}/{REPORT}"],
    ]
    parts = [result.title, *said, output.columns(facts)]
    parts += ["Quick: few and small pictures; no result."] if result.quick else []
    parts += ["Interrupted."] if result.goes_on else []
    return "\n\n".join(parts) + "".join(f"\n\nNote: {text}" for text in result.warnings)


COMMAND = _Recipe(
    "recipe",
    HELP,
    answer,
    (
        "recipe list",
        "recipe backgrounds --quick",
        'recipe backgrounds --object mug.obj --environment a.hdr,b.hdr --model model.pt2 --label "coffee mug,cup"',
        "show recipe backgrounds > mine.yaml",
        "recipe mine.yaml",
    ),
)
