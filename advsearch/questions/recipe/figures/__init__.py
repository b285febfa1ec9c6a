"""The kinds of figures, by the names that recipes call them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from advsearch.errors import FileFormatError, UnknownNameError
from advsearch.questions.recipe.answer import RecipeFigure
from advsearch.questions.recipe.figures.accuracy import BARS, CORRUPTION_ERROR, HEAT_MAP, POINTS, SURFACE
from advsearch.questions.recipe.figures.agreement import AGREEMENT
from advsearch.questions.recipe.figures.along import CURVE, SCALING
from advsearch.questions.recipe.figures.given import ANSWERS, CUES
from advsearch.questions.recipe.figures.ternary import TERNARY
from advsearch.questions.recipe.table import FigureKind, Options, Table
from advsearch.report.figures import Figures, drawn

MODEL = "model"
"""The column that says which model answered."""

FIGURES: dict[str, FigureKind[Any, Any]] = {
    "bars": BARS,
    "heat map": HEAT_MAP,
    "curve": CURVE,
    "points": POINTS,
    "answers": ANSWERS,
    "cues": CUES,
    "ternary": TERNARY,
    "corruption error": CORRUPTION_ERROR,
    "agreement": AGREEMENT,
    "scaling": SCALING,
    "surface": SURFACE,
}


def read_options(described: Mapping[str, object], where: str) -> tuple[str, Options]:
    """Return the kind of a figure and its options, as they stand in a recipe, with its kind as `figure`; `where` is the
    recipe.

    Raises:
        UnknownNameError: there is no such kind.
        FileFormatError: an option is missing, unknown, or of another kind.
    """
    given = dict(described)
    kind = str(given.pop("figure", ""))
    if kind not in FIGURES:
        raise UnknownNameError("figure", kind, FIGURES, f"It stands in {where}.")
    try:
        return kind, FIGURES[kind].options(**given)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        what = ".".join(str(one) for one in first["loc"])[:80]
        raise FileFormatError(f"{where}: figures: {kind}: {what}: {first['msg'][:200]}; see docs/recipes.md") from None


def compute(table: Table, kind: str, options: Options) -> list[RecipeFigure]:
    """Return the numbers of a figure, and what they say; where it does not tell several models apart, of each model. An
    InputError where it needs what the answers do not have."""
    shown = table.of(options.parts)
    together = FIGURES[kind].tells_models or MODEL in vars(options).values()
    if together or len({row.values.get(MODEL) for row in shown.rows}) < 2:
        return [FIGURES[kind].compute(shown, options)]
    found = []
    for name, rows in shown.by(MODEL).items():
        made: RecipeFigure = FIGURES[kind].compute(replace(shown, rows=rows), options)
        found.append(made.model_copy(update={"title": f"{made.title}: {name}"}))
    return found


def draw_figure(made: RecipeFigure, run: Path) -> Figures:
    """Return a figure as files; `run` is the recipe's folder."""
    kind = FIGURES[made.figure]
    return drawn(lambda figure: kind.draw(made, figure, run), kind.size(made))
