"""The kinds of figures that a recipe may have: what each may say in the file, and what it makes of the rows."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from advsearch.errors import FileFormatError, InputError, UnknownNameError
from advsearch.questions.recipe import frame, given, rates
from advsearch.questions.recipe.description import PHOTOGRAPHS, Recipe, first_of
from advsearch.questions.recipe.frame import MadeFigure, Options, Rows
from advsearch.report.figures import Figures, drawn

FIGURES: Mapping[str, tuple[type[Options], Any]] = {
    "rates": (rates.RatesOptions, rates.rates),
    "answers": (given.PredictionsOptions, given.predictions),
    "cues": (given.CuesOptions, given.cues),
    "ternary": (given.TernaryOptions, given.ternary),
    "agreement": (rates.AgreementOptions, rates.agreement),
    "scaling": (Options, rates.scaling),
    "surface": (Options, rates.surface),
}
"""The options that each kind takes, and what makes it of the rows."""

TOGETHER = ("agreement", "scaling", "surface")
"""Kinds that tell several models apart by themselves; of the others each model has one."""

NAMING = ("by", "series", "texture", "shape", "shares")  # options of figures that name columns
OUTER = ("object", "environment", frame.MODEL, frame.PREDICTION, frame.PART)  # columns of every recipe
ANY = "*"  # stands for the parameters of a control that does not say beforehand which it has


def read_options(described: Mapping[str, object], where: str) -> tuple[str, Options]:
    """Return the kind of a figure and its options, as they stand in the recipe `where`; an UnknownNameError or a
    FileFormatError where there is none of that kind, or such an option."""
    kind = str(described.get("figure", ""))
    if kind not in FIGURES:
        raise UnknownNameError("figure", kind, FIGURES, f"It stands in {where}.")
    try:
        return kind, FIGURES[kind][0](**{name: value for name, value in described.items() if name != "figure"})
    except ValidationError as error:
        raise FileFormatError(f"{where}: figures: {kind}: {first_of(error)}; see docs/recipes.md") from None


def make(rows: Rows, kind: str, options: Options) -> Iterator[MadeFigure]:
    """Yield a figure; where it does not tell several models apart, one of each. An InputError where it needs what the
    predictions do not have."""
    parts, made = rows[frame.PART], FIGURES[kind][1]
    shown = rows[parts.isin(options.parts) if options.parts else parts != PHOTOGRAPHS]
    together = kind in TOGETHER or frame.MODEL in vars(options).values() or frame.MODEL not in shown
    models = {"": shown} if together else frame.by(shown, frame.MODEL)
    for name, some in models.items():
        figure = made(some, options)
        yield figure if len(models) == 1 else replace(figure, title=f"{figure.title}: {name}")


def files_of(made: MadeFigure) -> Figures:
    """Return a figure as files."""

    def draw(figure: Any) -> None:
        figure.suptitle(made.title, x=0.01, ha="left", fontsize=10, fontweight="bold")
        made.draw(figure)

    return drawn(draw, made.size)


def check_figures(recipe: Recipe, columns: Mapping[str, Collection[str]], where: str) -> None:
    """Refuse, by an InputError, a figure of a part or of a column that there is not. `columns` are the parameters that
    the rows of each part will have, and `where` is the recipe."""
    known = {*OUTER, *([frame.GROUP] if recipe.groups else [])}
    for number, described in enumerate(recipe.figures, start=1):
        kind, options = read_options(described, where)
        place, beside = f"It stands in {where}, figure {number} ({kind})", getattr(options, "beside", None)
        for option, parts in (("of", options.of), ("beside", [beside] if beside else [])):
            for part in parts:
                if part not in (*recipe.parts, PHOTOGRAPHS):
                    raise UnknownNameError("part", part, [*recipe.parts, PHOTOGRAPHS], f"{place}, as `{option}`.")
        shown = {part: has for part, has in columns.items() if part != beside and part in (options.of or columns)}
        for option in NAMING:
            value = getattr(options, option, None) or ()
            for column in [value] if isinstance(value, str) else value:
                names = {column, f"{column.partition('.')[0]}.{ANY}"}
                lacking = [part for part, has in shown.items() if column not in known and not names & {*has}]
                if shown and len(lacking) == len(shown):
                    others = {name for has in shown.values() for name in has if not name.endswith(ANY)}
                    raise UnknownNameError("column", column, known | others, f"{place}, as `{option}`.")
                if lacking:
                    raise InputError(f"{place}: {lacking[0]} has no {column}; name the parts that have it as `of`")
