"""The result of `recipe`: what its runs were, its figures with their numbers, and what they say."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.report.shown import AnswerPart, Column, ShownAnswer
from advsearch.report.wording import count, percent, short_name
from advsearch.runs.results import Fields, RunResult

Cell = str | int | float | None

PHOTOGRAPHS = "photographs"
"""The part that photographs are of."""

SHARES = ("share", "low", "high")
"""Columns of a figure's numbers that are a share and the ends of its 95 % interval."""


class RecipePart(Fields):
    """One run of a recipe."""

    name: str = Field(description="of its folder, in `parts`")
    part: str = Field(description="the part of the recipe that it belongs to")
    command: str
    object: str
    ending: str
    renders: int = Field(description="pictures that it took")


class RecipeFigure(Fields):
    """One figure: its numbers, and what they say."""

    figure: str = Field(description="its kind")
    title: str
    text: list[str] = Field(description="what it says, in sentences")
    columns: list[str] = Field(description="of its numbers; `low` and `high` are a share's 95 % interval")
    rows: list[list[Cell]] = Field(description="of its numbers")


class RecipeResult(InNotebook, RunResult):
    """What a recipe came to: its runs, its figures and what they say."""

    command: ClassVar[str] = "recipe"

    recipe: str = Field(description="its name, or its file")
    title: str = Field(description="what it asks")
    about: str = Field(description="what is done for an answer, and whose experiment it is")
    quick: bool = Field(description="whether it was few small pictures")
    objects: list[str]
    model: str
    parts: list[RecipePart] = Field(description="the runs in the folder `parts`")
    figures: list[RecipeFigure]
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        """How many figures there are."""
        return f"{len(self.figures)} figures"


RESULT = RecipeResult


def shown(result: RecipeResult) -> ShownAnswer:
    """Return each figure with what it says and its numbers, and the runs that it took."""
    sections = [AnswerPart(text=[result.about], only="page")]
    for number, (made, texts) in enumerate(zip(result.figures, told_once(result.figures), strict=True), start=1):
        rows = [[_cell(*one) for one in zip(made.columns, row, strict=True)] for row in made.rows]
        sections.append(AnswerPart(made.title, texts, figure=f"images/figure-{number}.png"))
        sections.append(AnswerPart("The numbers", heads=made.columns, rows=rows, folded=True, only="page"))
    columns: Mapping[str, Column] = {
        "run in parts/": "{0.name}", "command": "{0.command}", "ending": "{0.ending}", "renders": "{0.renders}",
    }  # fmt: skip
    runs = {"title": count(len(result.parts), "run"), "parts": [one.name for one in result.parts]}
    sections.append(AnswerPart.table(result.parts, columns, **runs, folded=True, only="page"))
    objects, environments, models = (
        ", ".join(map(short_name, names))
        for names in (result.objects, result.environment.split(","), result.model.split(","))
    )
    facts = {"objects": objects, "environments": environments, "models": models, "runs": str(len(result.parts))}
    facts |= {"renders": str(sum(one.renders for one in result.parts))}
    quick = ["Made with few and small pictures, to see what comes out; no result."] if result.quick else []
    return ShownAnswer(result.title, sections, facts, [PurePath(result.recipe).stem, models, objects], quick)


def _cell(column: str, value: Cell) -> str:
    if column in SHARES:
        return percent(value) if isinstance(value, (int, float)) else ""
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)


def told_once(figures: Sequence[RecipeFigure]) -> list[list[str]]:
    """Return what each figure says without counts that a figure before it has told; where nothing is left, that."""
    said: set[str] = set()
    told = []
    for number, figure in enumerate(figures):
        same = number > 0 and figure.text == figures[number - 1].text
        new = [text for text in figure.text if text not in said or not re.search(r"\d of \d", text)]
        told.append(
            ["It says the same as the figure before it."] if same else new or ["It says what figures before it say."]
        )
        said |= set(figure.text)
    return told
