"""The result of `recipe`: what its runs were, the numbers of its figures, and what they say."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.report.phrases import percent
from advsearch.report.shown import AnswerPart, Column, ShownAnswer
from advsearch.report.wording import count, interval_text, short_name
from advsearch.runs.results.base import Fields, Interval, RunResult
from advsearch.runs.results.sweep import CountedAnswers, SurfaceTable

HeadsAndRows = tuple[list[str], list[list[str]]]

COUNT_HEADS = ["right", "accuracy", "95 % interval"]


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

    def table(self) -> HeadsAndRows:
        """Return its numbers as a table."""
        raise NotImplementedError


class NamedCount(CountedAnswers):
    """Answers about configurations that have one value in common."""

    name: str


def figure_number(value: float) -> str:
    """Return a number as figures write it."""
    return f"{value:.4g}"


def bare(name: str) -> str:
    """Return a parameter's name without its control: ``milk`` for ``contents.milk``."""
    return name.rpartition(".")[2]


def _counts(counts: Sequence[NamedCount]) -> list[list[str]]:
    """Counts as rows of a table, for `COUNT_HEADS` behind the name."""
    return [
        [one.name, f"{one.correct} of {one.configurations}", percent(one.accuracy), interval_text(one.interval)]
        for one in counts
    ]


class BarsFigure(RecipeFigure):
    """The accuracy for each value of something, with intervals."""

    figure: Literal["bars"]
    by: str = Field(description="what they differ in")
    bars: list[NamedCount]

    def table(self) -> HeadsAndRows:
        return [self.by, *COUNT_HEADS], _counts(self.bars)


class HeatMapFigure(RecipeFigure):
    """The accuracy for each pair of values of two things."""

    figure: Literal["heat map"]
    row: str = Field(description="what rows differ in")
    column: str = Field(description="what columns differ in")
    rows: list[str]
    columns: list[str]
    configurations: list[list[int]]
    correct: list[list[int]]

    def table(self) -> HeadsAndRows:
        rows = [
            [name, *(f"{right} of {seen}" for right, seen in zip(correct, configurations, strict=True))]
            for name, correct, configurations in zip(self.rows, self.correct, self.configurations, strict=True)
        ]
        return [self.row, *self.columns], rows


class CurveBin(CountedAnswers):
    """Answers about configurations with a parameter in a part of its range."""

    low: float
    high: float


class CurveLine(NamedCount):
    """One line: all answers of a group, and those in each part of the range."""

    bins: list[CurveBin]


class CurveFigure(RecipeFigure):
    """The accuracy along a parameter, for each group."""

    figure: Literal["curve"]
    along: str = Field(description="the parameter")
    unit: str
    by: str | None = Field(description="what the lines differ in; null where there is one")
    lines: list[CurveLine]

    def table(self) -> HeadsAndRows:
        rows = []
        for line in self.lines:
            counts = [
                NamedCount(
                    name=f"{figure_number(one.low)} to {figure_number(one.high)}",
                    **one.model_dump(exclude={"low", "high"}),
                )
                for one in line.bins
            ]
            rows += [[line.name, *row] for row in _counts(counts)]
        return [self.by or "line", self.along, *COUNT_HEADS], rows


class PointsFigure(RecipeFigure):
    """The accuracy for each value of something, side by side for each of several series."""

    figure: Literal["points"]
    by: str = Field(description="what the rows differ in")
    series: str = Field(description="what is side by side")
    names: list[str] = Field(description="of the series")
    rows: list[str]
    counts: list[list[NamedCount]] = Field(description="for each row, each of the series; by the name of the series")

    def table(self) -> HeadsAndRows:
        rows = [[name, *row] for name, counts in zip(self.rows, self.counts, strict=True) for row in _counts(counts)]
        return [self.by, self.series, *COUNT_HEADS], rows


class GivenAnswer(NamedCount):
    """How often an answer was given; `correct` counts how often it was."""

    right: int = Field(description="how often it was a right one")


class AnswersRow(NamedCount):
    """The most frequent answers for one value of something."""

    answers: list[GivenAnswer] = Field(description="the most frequent first")


class AnswersFigure(RecipeFigure):
    """The most frequent answers for each value of something."""

    figure: Literal["answers"]
    by: str = Field(description="what the rows differ in")
    rows: list[AnswersRow]

    def table(self) -> HeadsAndRows:
        rows = [
            [row.name, one.name, f"{one.correct} of {one.configurations}", interval_text(one.interval), str(one.right)]
            for row in self.rows
            for one in row.answers
        ]
        return [self.by, "answer", "given in", "95 % interval", "right"], rows


class CuesRow(NamedCount):
    """Answers under one texture: `correct` by shape, `textured` by texture."""

    textured: int = Field(description="how often the answer named the texture")


class CuesFigure(RecipeFigure):
    """Whether the model answers by shape or by texture."""

    figure: Literal["cues"]
    shape: str = Field(description="what has the shape")
    texture: str = Field(description="what has the texture")
    predicted: list[NamedCount] = Field(
        description="how often an answer is the most frequent one about the same shape with other textures, or about "
        "the same texture on other shapes; both of as many answers"
    )
    difference: float | None = Field(
        default=None, description="share that the shape predicts less that of the texture; null with too few of them"
    )
    difference_interval: Interval | None = Field(default=None, description="95 %, over pairs of shape and texture")
    rows: list[CuesRow]

    def table(self) -> HeadsAndRows:
        rows = [
            [one.name, f"{one.correct} of {one.configurations}", f"{one.textured} of {one.configurations}"]
            for one in self.rows
        ]
        return [self.texture, "the object", "the texture"], rows


class TernaryCell(Fields):
    """A triangle of a mixture's diagram."""

    corners: list[tuple[float, float, float]] = Field(description="the three shares at each of its corners")
    configurations: int
    given: int = Field(description="how often the answer was given in it")
    lead: float | None = Field(None, description="mean lead of the right answer in it; null where that is not known")


class MixtureLead(Fields):
    """How far the right answer leads, where most of a mixture is one ingredient."""

    name: str
    configurations: int
    mean: float = Field(description="of the margin with its sign turned: for classes, logits over the best wrong one")
    error: float = Field(description="its standard error")


class TernaryAnswer(Fields):
    """Where in a mixture's diagram an answer is given."""

    answer: str
    given: int
    by_most: list[NamedCount] = Field(description="how often it is given where most of the mixture is each thing")
    cells: list[TernaryCell]


class TernaryFigure(RecipeFigure):
    """How often answers are given over a mixture of three things."""

    figure: Literal["ternary"]
    shares: tuple[str, str, str] = Field(description="the three parameters")
    normalised: bool = Field(description="whether the colours of each answer end at its own largest share")
    answers: list[TernaryAnswer]
    leads: list[MixtureLead] = Field(
        default_factory=list, description="by what most of the mixture is; empty where there are several answers"
    )

    def table(self) -> HeadsAndRows:
        if self.leads:
            rows = [[one.name, str(one.configurations), f"{one.mean:.3g}", f"{one.error:.2g}"] for one in self.leads]
            return ["where most is", "pictures", "mean lead of the right answer", "standard error"], rows
        rows = [
            [one.answer, str(one.given), *(f"{count.correct} of {count.configurations}" for count in one.by_most)]
            for one in self.answers
        ]
        return ["answer", "given", *(f"where most is {bare(name)}" for name in self.shares)], rows


class CorruptionModel(Fields):
    """The errors of one model under corruptions."""

    model: str
    clean: NamedCount | None = Field(description="answers without corruption; `correct` counts wrong ones")
    errors: list[NamedCount] = Field(description="by corruption, over severities; `correct` counts wrong answers")
    error: NamedCount = Field(description="over all corruptions, each with as many pictures")
    relative: float | None = Field(
        description="mean over corruptions of the error over that of the first model, in %; null for that one"
    )


class CorruptionFigure(RecipeFigure):
    """Errors under corruptions, and the mean corruption error."""

    figure: Literal["corruption error"]
    models: list[CorruptionModel]

    def table(self) -> HeadsAndRows:
        rows = [
            [model.model, *row]
            for model in self.models
            for row in _counts([*([model.clean] if model.clean else []), *model.errors, model.error])
        ]
        return ["model", "corruption", "wrong", "error", "95 % interval"], rows


class AgreementCount(Fields):
    """Pairs of a rendering and another picture of the same configuration, by where the model is right in them."""

    name: str
    right_right: int = Field(description="right in the rendering, right in the other")
    right_wrong: int = Field(description="right in the rendering, wrong in the other")
    wrong_right: int = Field(description="wrong in the rendering, right in the other")
    wrong_wrong: int = Field(description="wrong in the rendering, wrong in the other")
    same_answer: int = Field(description="the same answer to both, right or wrong")
    agreeing: NamedCount = Field(description="of all pairs: right in both or wrong in both")


class AgreementSeries(Fields):
    """What renderings are compared with."""

    part: str = Field(description="`photographs`, or a part of the recipe")
    name: str
    alone: int = Field(description="pictures that belong to no rendering, which are in no pair")
    total: AgreementCount
    rows: list[AgreementCount] = Field(description="by object")


class AgreementFigure(RecipeFigure):
    """How often a model is right, or wrong, in a rendering and in another picture of the same configuration alike."""

    figure: Literal["agreement"]
    renderings: str = Field(description="the part whose pictures the others are compared with")
    series: list[AgreementSeries]

    def table(self) -> HeadsAndRows:
        rows = [
            [one.name, row.name, *map(str, (row.right_right, row.right_wrong, row.wrong_right, row.wrong_wrong)),
             str(row.same_answer), *_counts([row.agreeing])[0][1:]]
            for one in self.series
            for row in [*one.rows, one.total]
        ]  # fmt: skip
        both = ["right, right", "right, wrong", "wrong, right", "wrong, wrong", "same answer"]
        return ["rendering and", "object", *both, "agree", "share", "95 % interval"], rows


class ScalingPoint(Fields):
    """Runs on as many workers, one of each object."""

    workers: int
    rates: list[float] = Field(description="pictures a second of each run")
    gains: list[float] = Field(description="over the run of the same object on the fewest workers")


class ScalingFigure(RecipeFigure):
    """Pictures a second against the number of workers."""

    figure: Literal["scaling"]
    cores: int = Field(description="that this process may use")
    points: list[ScalingPoint] = Field(description="by number of workers")

    def table(self) -> HeadsAndRows:
        rows = [
            [str(one.workers), *(", ".join(f"{value:.3g}" for value in values) for values in (one.rates, one.gains))]
            for one in self.points
        ]
        return ["workers", "pictures a second", "over the fewest workers"], rows


class SurfaceOf(Fields):
    """What goes with wrong answers on the surface of one object."""

    run: str = Field(description="in `parts`")
    tables: list[SurfaceTable]


class SurfaceFigure(RecipeFigure):
    """Which parts of each object, when seen, go with wrong answers."""

    figure: Literal["surface"]
    maps: list[SurfaceOf]

    def table(self) -> HeadsAndRows:
        tables = [table for one in self.maps for table in one.tables]
        rows = [
            [one.object, short_name(one.model), one.part, *map(str, (one.seen, one.compared, one.worse, one.better))]
            for one in tables
        ]
        return ["object", "model", "parts", "seen", "compared", "with wrong answers", "with right answers"], rows


AnyFigure = Annotated[
    BarsFigure
    | HeatMapFigure
    | CurveFigure
    | PointsFigure
    | AnswersFigure
    | CuesFigure
    | TernaryFigure
    | CorruptionFigure
    | AgreementFigure
    | ScalingFigure
    | SurfaceFigure,
    Field(discriminator="figure"),
]


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
    figures: list[AnyFigure]
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        """How many figures there are."""
        return f"{len(self.figures)} figures"


RESULT = RecipeResult


def shown(result: RecipeResult) -> ShownAnswer:
    """Return each figure with what it says and its numbers, and the runs that it took."""
    told = zip(result.figures, told_once(result.figures), strict=True)
    sections = [AnswerPart(text=[result.about], only="page")]
    for number, (one, texts) in enumerate(told, start=1):
        heads, rows = one.table()
        sections.append(AnswerPart(one.title, texts, figure=f"images/figure-{number}.png"))
        sections.append(AnswerPart("The numbers", heads=heads, rows=rows, folded=True, only="page"))
    columns: Mapping[str, Column] = {
        "run in parts/": "{0.name}",
        "command": "{0.command}",
        "ending": "{0.ending}",
        "renders": "{0.renders}",
    }
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


def told_once(figures: Sequence[RecipeFigure]) -> list[list[str]]:
    """Return what each figure says without counts that a figure before it has told; where nothing is left, that."""
    said: set[str] = set()
    told = []
    for number, one in enumerate(figures):
        same = number > 0 and one.text == figures[number - 1].text
        new = [text for text in one.text if text not in said or not re.search(r"\d of \d", text)]
        told.append(
            ["It says the same as the figure before it."] if same else new or ["It says what figures before it say."]
        )
        said |= set(one.text)
    return told
