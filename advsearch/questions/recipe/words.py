"""The numbers of a recipe's figures as tables."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import PurePath

from advsearch.questions.recipe.answer import (
    AgreementFigure,
    AnswersFigure,
    AnyFigure,
    BarsFigure,
    CorruptionFigure,
    CuesFigure,
    CurveFigure,
    HeatMapFigure,
    NamedCount,
    PointsFigure,
    RecipeFigure,
    RecipeResult,
    ScalingFigure,
    SurfaceFigure,
    TernaryFigure,
)
from advsearch.report.phrases import percent
from advsearch.report.shown import AnswerPart, Column, ShownAnswer
from advsearch.report.wording import count, interval_text, short_name

HeadsAndRows = tuple[list[str], list[list[str]]]
"""Heads and rows of a table."""

COUNT_HEADS = ["right", "accuracy", "95 % interval"]


def shown(result: RecipeResult) -> ShownAnswer:
    """Return each figure with what it says and its numbers, and the runs that it took."""
    told = zip(result.figures, told_once(result.figures), strict=True)
    sections = [AnswerPart(text=[result.about], only="page")]
    for number, (one, texts) in enumerate(told, start=1):
        heads, rows = figure_table(one)
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


def figure_table(made: AnyFigure) -> HeadsAndRows:
    """Return the numbers of a figure as a table."""
    match made:
        case BarsFigure():
            return [made.by, *COUNT_HEADS], _counts(made.bars)
        case HeatMapFigure():
            return _heat_map(made)
        case CurveFigure():
            return _curve(made)
        case PointsFigure():
            return _points(made)
        case AnswersFigure():
            return _answers(made)
        case CuesFigure():
            return _cues(made)
        case TernaryFigure():
            return _ternary(made)
        case CorruptionFigure():
            return _corruptions(made)
        case AgreementFigure():
            return _agreement(made)
        case ScalingFigure():
            return _scaling(made)
        case SurfaceFigure():
            return _surface(made)


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


def _answers(made: AnswersFigure) -> HeadsAndRows:
    rows = [
        [row.name, one.name, f"{one.correct} of {one.configurations}", interval_text(one.interval), str(one.right)]
        for row in made.rows
        for one in row.answers
    ]
    return [made.by, "answer", "given in", "95 % interval", "right"], rows


def _agreement(made: AgreementFigure) -> HeadsAndRows:
    rows = [
        [one.name, row.name, *map(str, (row.right_right, row.right_wrong, row.wrong_right, row.wrong_wrong)),
         str(row.same_answer), *_counts([row.agreeing])[0][1:]]
        for one in made.series
        for row in [*one.rows, one.total]
    ]  # fmt: skip
    both = ["right, right", "right, wrong", "wrong, right", "wrong, wrong", "same answer"]
    return ["rendering and", "object", *both, "agree", "share", "95 % interval"], rows


def _corruptions(made: CorruptionFigure) -> HeadsAndRows:
    rows = [
        [model.model, *row]
        for model in made.models
        for row in _counts([*([model.clean] if model.clean else []), *model.errors, model.error])
    ]
    return ["model", "corruption", "wrong", "error", "95 % interval"], rows


def _cues(made: CuesFigure) -> HeadsAndRows:
    rows = [
        [one.name, f"{one.correct} of {one.configurations}", f"{one.textured} of {one.configurations}"]
        for one in made.rows
    ]
    return [made.texture, "the object", "the texture"], rows


def _curve(made: CurveFigure) -> HeadsAndRows:
    rows = []
    for line in made.lines:
        counts = [
            NamedCount(
                name=f"{figure_number(one.low)} to {figure_number(one.high)}", **one.model_dump(exclude={"low", "high"})
            )
            for one in line.bins
        ]
        rows += [[line.name, *row] for row in _counts(counts)]
    return [made.by or "line", made.along, *COUNT_HEADS], rows


def _heat_map(made: HeatMapFigure) -> HeadsAndRows:
    rows = [
        [name, *(f"{right} of {seen}" for right, seen in zip(correct, configurations, strict=True))]
        for name, correct, configurations in zip(made.rows, made.correct, made.configurations, strict=True)
    ]
    return [made.row, *made.columns], rows


def _points(made: PointsFigure) -> HeadsAndRows:
    rows = [[name, *row] for name, counts in zip(made.rows, made.counts, strict=True) for row in _counts(counts)]
    return [made.by, made.series, *COUNT_HEADS], rows


def _ternary(made: TernaryFigure) -> HeadsAndRows:
    if made.leads:
        rows = [[one.name, str(one.configurations), f"{one.mean:.3g}", f"{one.error:.2g}"] for one in made.leads]
        return ["where most is", "pictures", "mean lead of the right answer", "standard error"], rows
    rows = [
        [one.answer, str(one.given), *(f"{count.correct} of {count.configurations}" for count in one.by_most)]
        for one in made.answers
    ]
    return ["answer", "given", *(f"where most is {bare(name)}" for name in made.shares)], rows


def _scaling(made: ScalingFigure) -> HeadsAndRows:
    rows = [
        [str(one.workers), *(", ".join(f"{value:.3g}" for value in values) for values in (one.rates, one.gains))]
        for one in made.points
    ]
    return ["workers", "pictures a second", "over the fewest workers"], rows


def _surface(made: SurfaceFigure) -> HeadsAndRows:
    tables = [table for one in made.maps for table in one.tables]
    rows = [
        [one.object, short_name(one.model), one.part, *map(str, (one.seen, one.compared, one.worse, one.better))]
        for one in tables
    ]
    return ["object", "model", "parts", "seen", "compared", "with wrong answers", "with right answers"], rows
