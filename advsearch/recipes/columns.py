"""The columns that the table of a recipe's answers will have, by which its figures are checked before any render."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from advsearch.errors import InputError, UnknownNameError
from advsearch.recipes.description import PHOTOGRAPHS, Recipe
from advsearch.recipes.figures import read_options
from advsearch.recipes.figures.base import Options
from advsearch.recipes.table import ANSWER, GROUP, PART

OUTER = ("object", "environment", "model", ANSWER, PART)
"""Columns of every recipe."""

WHICH = "which"
"""The option that names a column which clean pictures do not have."""

NAMING = ("by", "series", "rows", "columns", "along", "texture", "shape", "shares", WHICH)
"""Options of figures that name columns."""

ANY = "*"
"""Stands for the parameters of a control that does not say beforehand which it has."""


def check_figures(recipe: Recipe, columns: Mapping[str, Collection[str]], where: str) -> None:
    """Refuse a figure of a part or of a column that there is not.

    Args:
        recipe: as its file says it.
        columns: for each part that is carried out, parameters that its rows will have.
        where: the recipe, for messages.

    Raises:
        UnknownNameError: a figure names one; the message says which figure.
        InputError: a part that it shows has not the column that others have.
        FileFormatError: as for `read_options`.
    """
    for number, described in enumerate(recipe.figures, start=1):
        kind, options = read_options(described, where)
        place = f"It stands in {where}, figure {number} ({kind})"
        for part in options.of:
            if part not in (*recipe.parts, PHOTOGRAPHS):
                raise UnknownNameError("part", part, [*recipe.parts, PHOTOGRAPHS], f"{place}, as `of`.")
        shown = {part: own for part, own in columns.items() if part in options.of or not options.of}
        known = {*OUTER, *([GROUP] if recipe.groups else [])}
        for option, column in _named(options):
            without = [part for part, own in shown.items() if column not in known and not _has(own, column)]
            if shown and len(without) == len(shown):
                others = {name for own in shown.values() for name in own if not name.endswith(ANY)}
                raise UnknownNameError("column", column, known | others, f"{place}, as `{option}`.")
            if without and option != WHICH:
                raise InputError(f"{place}: {without[0]} has no {column}; name the parts that have it as `of`")


def _named(options: Options) -> list[tuple[str, str]]:
    """The columns that a figure names, each behind the option that names it."""
    found = [(name, value) for name, value in vars(options).items() if name in NAMING and value is not None]
    return [(name, one) for name, value in found for one in ([value] if isinstance(value, str) else value)]


def _has(columns: Collection[str], column: str) -> bool:
    return column in columns or f"{column.partition('.')[0]}.{ANY}" in columns
