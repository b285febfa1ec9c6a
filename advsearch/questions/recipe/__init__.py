"""`advsearch recipe`: an experiment that a YAML file describes, and what its figures say."""

from __future__ import annotations

import argparse

from advsearch.cli import output
from advsearch.cli.commands import Positional, QuestionCommand

HELP = "run a whole experiment that a recipe describes, and write a page of figures"
EXAMPLES = (
    "recipe list",
    "recipe backgrounds --quick",
    'recipe backgrounds --object mug.obj --environment a.hdr,b.hdr --model model.pt2 --label "coffee mug,cup"',
    "show recipe backgrounds > mine.yaml",
    "recipe mine.yaml",
)

LIST = "list"
"""What lists the recipes instead."""


class _Recipe(QuestionCommand):
    """The command, which can list the recipes too."""

    def run(self, args: argparse.Namespace) -> int:
        """Carry out the recipe and print what it says, or list the recipes."""
        if getattr(args, "recipe", None) != LIST:
            return super().run(args)
        # late, so that --help answers at once
        from advsearch.questions.recipe.description import titles

        if args.json:
            listed = [{"name": name, "title": text} for name, text in titles().items()]
            output.print_json({"schema": 1, "recipes": listed})
        else:
            print(output.aligned([[name, text] for name, text in titles().items()]))
        return 0


COMMAND = _Recipe(
    "recipe", about="recipe", place=Positional("NAME", "a recipe, or list", "; list shows the recipes that there are")
)
