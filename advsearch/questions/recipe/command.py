"""`advsearch recipe`: an experiment that a YAML file describes, and what its figures say."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from advsearch.cli import output
from advsearch.cli.output import as_notes
from advsearch.cli.question import Positional, QuestionCommand

if TYPE_CHECKING:
    from advsearch.questions.recipe.answer import RecipeResult

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
    """The command, which can list the recipes too, and takes a file of one."""

    def run(self, args: argparse.Namespace) -> int:
        """Carry out the recipe and print what it says, or list the recipes."""
        return _listed(args.json) if getattr(args, "recipe", None) == LIST else super().run(args)

    def file(self, args: argparse.Namespace) -> Path | None:
        """Return the recipe if it is a file."""
        from advsearch.questions.recipe.description import is_file_name

        return Path(args.recipe) if is_file_name(args.recipe) else None


def _listed(as_json: bool) -> int:
    from advsearch.questions.recipe.description import titles

    found = titles()
    if as_json:
        output.print_json({"schema": 1, "recipes": [{"name": name, "title": text} for name, text in found.items()]})
    else:
        print(output.aligned([[name, text] for name, text in found.items()]))
    return 0


def answer(result: RecipeResult) -> str:
    """Return what each figure says, and the cost."""
    from advsearch.questions.recipe.words import told_once
    from advsearch.report import wording
    from advsearch.runs.directory import REPORT

    told = zip(result.figures, told_once(result.figures), strict=True)
    said = [f"{one.title}\n" + "\n".join(f"  {text}" for text in texts) for one, texts in told]
    facts = [
        ["runs", str(len(result.parts))],
        ["renders", str(sum(one.renders for one in result.parts))],
        ["time", wording.seconds_text(result.seconds["total"])],
        ["page", f"{result.run}/{REPORT}"],
    ]
    parts = [result.title, *said, output.aligned(facts)]
    parts += ["Quick: few and small pictures; no result."] if result.quick else []
    parts += ["Interrupted."] if result.goes_on else []
    return "\n\n".join(parts) + as_notes(result.warnings)


COMMAND = _Recipe(
    "recipe",
    answer,
    about="recipe",
    place=Positional("NAME", "a recipe, or list", "; list shows the recipes that there are"),
)
