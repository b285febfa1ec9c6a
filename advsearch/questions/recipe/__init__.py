"""Run a whole experiment that a recipe describes, and write a page of figures."""

from __future__ import annotations

from advsearch.question import Asked, question
from advsearch.questions.recipe.result import RecipeConfig, RecipeResult
from advsearch.questions.recipe.result import shown as shown


@question(
    "recipe list",
    "recipe backgrounds --quick",
    'recipe backgrounds --object mug.obj --environment a.hdr,b.hdr --model model.pt2 --label "coffee mug,cup"',
    "show recipe backgrounds > mine.yaml",
    "recipe mine.yaml",
    place=("recipe",),
    about="recipe",
    expected=("NAME", "a recipe, or list", "; list shows the recipes that there are"),
    listed="advsearch.questions.recipe.description:titles",
)
def recipe(asked: Asked[RecipeConfig]) -> RecipeResult:
    """Carry out a recipe: its runs, its figures, and what they say (docs/recipes.md).

    Args:
        recipe: the name of a bundled recipe, or a YAML file.
    """
    from advsearch.questions.recipe.carry_out import carried_out  # imports torch

    return carried_out(asked)
