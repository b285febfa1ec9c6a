"""Run a whole experiment that a recipe describes, and write a page of figures."""

from __future__ import annotations

from advsearch.extend import PositionalArgument, RunContext, experiment
from advsearch.questions.recipe.result import RecipeConfig, RecipeResult, make_view


@experiment(
    "recipe list",
    "recipe backgrounds --quick",
    "recipe backgrounds --object mug.obj --environment a.hdr,b.hdr --model model.pt2 "
    '--label "coffee mug,cup"',
    "show recipe backgrounds > mine.yaml",
    "recipe mine.yaml",
    positional_args=("recipe",),
    about="recipe",
    positional=PositionalArgument(
        "NAME", "a recipe, or list", "; list shows the recipes that there are"
    ),
    choices="advsearch.questions.recipe.description:titles",
    choice_description="advsearch.questions.recipe.description:describe",
    view=make_view,
)
def recipe(context: RunContext[RecipeConfig]) -> RecipeResult:
    """Run a recipe: an experiment of several runs, with figures of them
    (docs/recipes.md).

    Args:
        recipe: the name of a bundled recipe, or a YAML file.
    """
    from advsearch.questions.recipe.carry_out import run_recipe  # imports torch

    return run_recipe(context)
