"""The kinds of figures that a recipe may have, and what each makes of the answers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydantic import ValidationError

from advsearch.errors import FileFormatError, InputError, UnknownNameError
from advsearch.questions.recipe.answer import PHOTOGRAPHS
from advsearch.questions.recipe.description import Recipe
from advsearch.questions.recipe.given import AnswersOptions, CuesOptions, answers, cues
from advsearch.questions.recipe.of_runs import AgreementOptions, agreement, scaling, surface
from advsearch.questions.recipe.rates import RatesOptions, rates
from advsearch.questions.recipe.table import ANSWER, GROUP, MODEL, PART, MadeFigure, Options, Table
from advsearch.questions.recipe.ternary import TernaryOptions, ternary
from advsearch.report.figures import Figures, drawn


@dataclass(frozen=True)
class FigureKind:
    """The options that a kind of figure takes, and what makes it. Of several models each has one, unless it tells them
    apart by itself."""

    options: type[Options]
    make: Callable[[Table, Any], MadeFigure]
    tells_models: bool = False


FIGURES = {
    "rates": FigureKind(RatesOptions, rates),
    "answers": FigureKind(AnswersOptions, answers),
    "cues": FigureKind(CuesOptions, cues),
    "ternary": FigureKind(TernaryOptions, ternary),
    "agreement": FigureKind(AgreementOptions, agreement, tells_models=True),
    "scaling": FigureKind(Options, scaling, tells_models=True),
    "surface": FigureKind(Options, surface, tells_models=True),
}


def read_options(described: Mapping[str, object], where: str) -> tuple[str, Options]:
    """Return the kind of a figure and its options, as they stand in the recipe `where`, with its kind as `figure`; an
    UnknownNameError or a FileFormatError where there is none of that kind, or such an option."""
    kind = str(described.get("figure", ""))
    if kind not in FIGURES:
        raise UnknownNameError("figure", kind, FIGURES, f"It stands in {where}.")
    try:
        return kind, FIGURES[kind].options(**{name: one for name, one in described.items() if name != "figure"})
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        what = ".".join(str(one) for one in first["loc"])[:80]
        raise FileFormatError(f"{where}: figures: {kind}: {what}: {first['msg'][:200]}; see docs/recipes.md") from None


def make(table: Table, kind: str, options: Options) -> Iterator[MadeFigure]:
    """Yield a figure; where it does not tell several models apart, one of each. An InputError where it needs what the
    answers do not have."""
    parts = table.rows[PART]
    shown = table.where(parts.isin(options.parts) if options.parts else parts != PHOTOGRAPHS)
    together = FIGURES[kind].tells_models or MODEL in vars(options).values()
    models = {} if together or MODEL not in shown.rows else shown.by(MODEL)
    if len(models) < 2:
        yield FIGURES[kind].make(shown, options)
    for name, rows in models.items() if len(models) > 1 else ():
        made = FIGURES[kind].make(replace(shown, rows=rows), options)
        yield replace(made, title=f"{made.title}: {name}")


def files_of(made: MadeFigure) -> Figures:
    """Return a figure as files."""

    def draw(figure: Any) -> None:
        figure.suptitle(made.title, x=0.01, ha="left", fontsize=10, fontweight="bold")
        made.draw(figure)

    return drawn(draw, made.size)


NAMING = ("by", "series", "texture", "shape", "shares")
"""Options of figures that name columns."""

OUTER = ("object", "environment", MODEL, ANSWER, PART)
"""Columns of every recipe."""

ANY = "*"
"""Stands for the parameters of a control that does not say beforehand which it has."""


def check_figures(recipe: Recipe, columns: Mapping[str, Collection[str]], where: str) -> None:
    """Refuse a figure of a part or of a column that there is not. `columns` are the parameters that the rows of each
    part will have, and `where` is the recipe.

    Raises:
        UnknownNameError: a figure names one; the message says which figure.
        InputError: a part that it shows has not the column that others have.
    """
    known = {*OUTER, *([GROUP] if recipe.groups else [])}
    for number, described in enumerate(recipe.figures, start=1):
        kind, options = read_options(described, where)
        place = f"It stands in {where}, figure {number} ({kind})"
        beside = getattr(options, "beside", None)
        for option, parts in (("of", options.of), ("beside", [beside] if beside else [])):
            for part in parts:
                if part not in (*recipe.parts, PHOTOGRAPHS):
                    raise UnknownNameError("part", part, [*recipe.parts, PHOTOGRAPHS], f"{place}, as `{option}`.")
        shown = {
            part: own for part, own in columns.items() if part != beside and (not options.of or part in options.of)
        }
        for option in NAMING:
            value = getattr(options, option, None) or ()
            for column in [value] if isinstance(value, str) else value:
                any_of = f"{column.partition('.')[0]}.{ANY}"
                lacking = [part for part, own in shown.items() if column not in known and not {column, any_of} & {*own}]
                if shown and len(lacking) == len(shown):
                    others = {name for own in shown.values() for name in own if not name.endswith(ANY)}
                    raise UnknownNameError("column", column, known | others, f"{place}, as `{option}`.")
                if lacking:
                    raise InputError(f"{place}: {lacking[0]} has no {column}; name the parts that have it as `of`")
