"""The result of `recipe`: what its runs were, the numbers of its figures, and what they say."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from advsearch.runs.results.base import Fields, RunResult
from advsearch.runs.results.sweep import CountedAnswers


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


class NamedCount(CountedAnswers):
    """Answers about configurations that have one value in common."""

    name: str


class BarsFigure(RecipeFigure):
    """The accuracy for each value of something, with intervals."""

    figure: Literal["bars"]
    by: str = Field(description="what they differ in")
    bars: list[NamedCount]


class HeatMapFigure(RecipeFigure):
    """The accuracy for each pair of values of two things."""

    figure: Literal["heat map"]
    row: str = Field(description="what rows differ in")
    column: str = Field(description="what columns differ in")
    rows: list[str]
    columns: list[str]
    configurations: list[list[int]]
    correct: list[list[int]]


AnyFigure = Annotated[BarsFigure | HeatMapFigure, Field(discriminator="figure")]


class RecipeResult(RunResult):
    """What a recipe came to: its runs, its figures and what they say."""

    command: ClassVar[str] = "recipe"

    recipe: str = Field(description="its name, or its file")
    title: str = Field(description="what it asks")
    about: str = Field(description="what is done for an answer, and whose experiment it is")
    quick: bool = Field(description="whether it was few small pictures")
    objects: list[str]
    model: str
    parts: list[RecipePart] = Field(description="the runs in the folder `parts`")
    figures: list[AnyFigure]
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        """How many figures there are."""
        return f"{len(self.figures)} figures"
