"""Whether the model answers by shape or by texture, where every object has every texture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from advsearch.recipes.figures.base import Kind, Options, apart, extremes, rate
from advsearch.recipes.table import Answered, Table, count_of, counted, most_frequent
from advsearch.report.drawing import BLUE, RED
from advsearch.report.phrases import percent
from advsearch.runs.results.recipe import CuesFigure, CuesRow, NamedCount


class CuesOptions(Options):
    """Options of cues.

    Attributes:
        texture: what has the texture.
        shape: what has the shape.
        classes: for a texture, the answers that name it: ``{zebra: [zebra]}``.
    """

    texture: str = "material.which"
    shape: str = "object"
    classes: dict[str, list[str]] = Field(default_factory=dict)


def _compute(table: Table, options: CuesOptions) -> CuesFigure:
    rows = [_row(name, inside, options.classes.get(name, [])) for name, inside in table.by(options.texture).items()]
    predicted = [_predicted(table, "shape", options.shape), _predicted(table, "texture", options.texture)]
    return CuesFigure(
        figure="cues",
        title=options.title or "Answers by shape and by texture",
        text=[*_by_texture(table, options, rows), *_which(*predicted), *_hardest(rows)],
        shape=options.shape,
        texture=options.texture,
        predicted=predicted,
        rows=rows,
    )


def _row(name: str, rows: list[Answered], classes: list[str]) -> CuesRow:
    return CuesRow(**counted(name, rows).model_dump(), textured=sum(_names(row.answer, classes) for row in rows))


def _names(answer: str, classes: list[str]) -> bool:
    """Whether an answer, or one of the names that it consists of, is among some."""
    return any(name.strip() in classes for name in [answer, *answer.split(",")])


def _predicted(table: Table, name: str, column: str) -> NamedCount:
    """How often an answer is the most frequent one with the same value in the other half, every second row.

    To leave out one answer alone would not do: in a balanced table it makes its own kind the rarest.
    """
    halves = [Table(table.rows[half::2], table.groups) for half in (0, 1)]
    hits = 0
    for own, other in (halves, halves[::-1]):
        first = {value: most_frequent(rows)[0][0] for value, rows in other.by(column).items()}
        hits += sum(row.answer == first.get(value) for value, rows in own.by(column).items() for row in rows)
    return count_of(name, hits, len(table.rows))


def _by_texture(table: Table, options: CuesOptions, rows: list[CuesRow]) -> list[str]:
    shape = count_of("by shape", sum(one.correct for one in rows), sum(one.configurations for one in rows))
    asked = [one for one in rows if options.classes.get(one.name)]
    said = [f"The answer is the object, whatever its texture: {rate(shape, 'so')}."]
    if asked:
        named = count_of("by texture", sum(one.textured for one in asked), sum(one.configurations for one in asked))
        known = ", ".join(one.name for one in asked)
        said.append(f"The answer names the texture ({known}): {rate(named, 'so')}.")
        if not named.correct:
            said.append("A model that has no class for a texture cannot name it.")
    return said


def _which(shape: NamedCount, texture: NamedCount) -> list[str]:
    said = (
        f"From the other half of the answers, the most frequent one for the same object is right about "
        f"{percent(shape.accuracy)} of them, and the most frequent one for the same texture about "
        f"{percent(texture.accuracy)}"
    )
    if apart(texture, shape):
        return [f"{said}: the model goes more by shape than by texture."]
    if apart(shape, texture):
        return [f"{said}: the model goes more by texture than by shape."]
    return [f"{said}: no difference is shown."]


def _hardest(rows: list[CuesRow]) -> list[str]:
    return extremes(rows, "The hardest texture", "the easiest", "textures")


def _draw(made: CuesFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    rows = sorted(made.rows, key=lambda one: one.accuracy or 0.0)
    for place, one in enumerate(rows):
        total = max(one.configurations, 1)
        axes.barh(
            place, one.correct / total, color=BLUE, alpha=0.55, height=0.66, label="the object" if not place else "_"
        )
        axes.barh(
            place, one.textured / total, left=one.correct / total, color=RED, alpha=0.55, height=0.66,
            label="the texture" if not place else "_",
        )  # fmt: skip
        if one.interval:
            axes.plot(one.interval, [place, place], color="#1c1d20", linewidth=1.2)
    axes.set_yticks(range(len(rows)), [one.name for one in rows])
    axes.set(xlabel="share of answers; line: 95 % interval of the object's", xlim=(0.0, 1.0))
    axes.set_title(made.title)
    axes.grid(True, axis="x")
    figure.legend(loc="outside lower center", ncols=2, title="the answer names")


CUES = Kind(CuesOptions, CuesFigure, _compute, _draw, lambda made: (6.0, 1.7 + 0.27 * len(made.rows)))
