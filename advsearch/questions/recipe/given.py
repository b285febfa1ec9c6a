"""Which answers are given: the most frequent ones for each value of something; whether they go by shape or texture."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Sequence
from typing import Any

import pandas as pd
from pydantic import Field

from advsearch.questions.recipe.table import (
    ANSWER,
    COUNT,
    MadeFigure,
    Options,
    Table,
    Tally,
    extremes,
    most_frequent,
    plural,
)
from advsearch.report.figures import BLUE, GREY, RED
from advsearch.report.wording import percent

LETTERS = 85
"""Letters that a bar of the whole width has room for."""
FEWEST_LETTERS = 4
"""Of a name that is cut short."""


class AnswersOptions(Options):
    """Options of the most frequent answers."""

    by: str
    most: int = Field(default=4, ge=1, le=10)


def answers(table: Table, options: AnswersOptions) -> MadeFigure:
    """Count the most frequent answers for each value of something."""
    groups: dict[str, list[tuple[Tally, int]]] = {}  # how often each was given, and how often it was a right one
    for value, rows in table.by(options.by).items():
        most = most_frequent(rows)[: options.most]
        given = {answer: rows[ANSWER] == answer for answer, _ in most}
        groups[value] = [
            (Tally.over(answer, rows, flags), int(rows["correct"][flags].sum())) for answer, flags in given.items()
        ]
    wrong = {value: each[0] for value, each in groups.items() if 2 * each[0][1] < each[0][0].times}
    known, thing = len(groups) - len(wrong), plural(options.by)
    text = [f"For {known} of {len(groups)} {thing} the most frequent answer is mostly a right one."]
    text += [
        f"For {value} it is {one.name}, {one.told('given')} and right in {right} of these."
        for value, (one, right) in wrong.items()
    ]
    title = options.title or f"Most frequent answers by {options.by}"

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for place, given in enumerate(groups.values()):
            left = 0.0
            for one, right in given:
                share, colour = one.share or 0.0, BLUE if 2 * right >= one.times else RED
                axes.barh(place, share, left=left, color=colour, alpha=0.5, height=0.72, edgecolor="white")
                axes.text(left + share / 2, place, fitting(one.name, share), ha="center", va="center", fontsize=7)
                left += share
            axes.barh(place, max(1.0 - left, 0.0), left=left, color=GREY, alpha=0.15, height=0.72)
        axes.set_yticks(range(len(groups)), list(groups))
        axes.invert_yaxis()
        axes.set(xlabel="share of answers; blue: mostly right, red: mostly wrong, grey: others", xlim=(0.0, 1.0))

    rows = [[value, one.name, *one.cells, right] for value, given in groups.items() for one, right in given]
    columns = [options.by, "answer", "given in", *COUNT, "right"]
    return MadeFigure(title, text, columns, rows, draw, (6.4, 1.2 + 0.3 * len(groups)))


def fitting(name: str, share: float) -> str:
    """Return as much of an answer's name as a bar has room for: the first of several names, or its beginning."""
    room, first = int(share * LETTERS), name.partition(",")[0]
    fits = next((one for one in (name, first) if len(one) <= room), None)
    return fits if fits is not None else f"{first[: room - 1].rstrip()}…" if room > FEWEST_LETTERS else ""


SEED, RESAMPLES = 0, 2000
"""Of the answers that predict, and of the bootstrap."""

FEWEST_PAIRS = 4
"""Pairs of object and texture: two of each."""

Predicted = tuple[int, int, int]
"""Of one object with one texture: answers, and how many of these the shape and the texture predict."""


class CuesOptions(Options):
    """Options of cues; for a texture, `classes` are the answers that name it."""

    texture: str = "material.which"
    shape: str = "object"
    classes: dict[str, list[str]] = Field(default_factory=dict)


def cues(table: Table, options: CuesOptions) -> MadeFigure:
    """Count how often the answer is the object and how often the texture, and which of both predicts answers better."""
    textures = table.by(options.texture)
    shapes = {name: Tally.over(name, rows) for name, rows in textures.items()}
    naming = {
        name: rows[ANSWER].map(lambda answer, name=name: _names(answer, options.classes.get(name, [])))
        for name, rows in textures.items()
    }
    named = {name: Tally.over(name, rows, naming[name]) for name, rows in textures.items()}
    asked = [name for name in textures if options.classes.get(name)]
    text = [f"The answer is the object, whatever its texture: {Tally.over('', table.rows).told('so')}."]
    if asked:
        flags = pd.concat([naming[name] for name in asked])
        total = Tally.over("", table.rows.loc[flags.index], flags)
        text.append(f"The answer names the texture ({', '.join(asked)}): {total.told('so')}.")
        if not total.share:
            text.append("A model that has no class for a texture cannot name it.")
    text.append(_which(predicted(table, options)))
    text += extremes(list(shapes.values()), "The hardest texture", "the easiest", "textures")
    title = options.title or "Answers by shape and by texture"

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        names = sorted(shapes, key=lambda name: shapes[name].share or 0.0)
        own, other = ([counts[name].share or 0.0 for name in names] for counts in (shapes, named))
        axes.barh(names, own, color=BLUE, alpha=0.55, height=0.66, label="the object")
        axes.barh(names, other, left=own, color=RED, alpha=0.55, height=0.66, label="the texture")
        for place, name in enumerate(names):
            axes.plot(shapes[name].interval(), [place, place], color="#1c1d20", linewidth=1.2)
        axes.set(xlabel="share of answers; line: 95 % interval of the object's", xlim=(0.0, 1.0))
        axes.grid(True, axis="x")
        figure.legend(loc="outside lower center", ncols=2, title="the answer names")

    rows = [[name, *shapes[name].cells, named[name].times] for name in textures]
    columns = [options.texture, "the object", *COUNT, "the texture"]
    return MadeFigure(title, text, columns, rows, draw, (6.0, 1.7 + 0.27 * len(textures)))


def _names(answer: str, classes: list[str]) -> bool:
    """Whether an answer, or one of the names that it consists of, is among some."""
    return any(name.strip() in classes for name in [answer, *answer.split(",")])


def predicted(table: Table, options: CuesOptions) -> list[Predicted]:
    """Predict the answers about each object with each texture by those about it with others, and with others by it.

    Each cue predicts the most frequent one of as many answers: those about the same object with other textures, and
    about the same texture on other objects, drawn so that both are as many as the fewer are. None of the predicted
    answers is among them, so that a model which answers by neither cue is predicted as well by both.
    """
    generator = random.Random(SEED)
    groups = table.rows.groupby([table.column(options.shape), table.column(options.texture)], sort=False)
    pairs = {pair: list(rows[ANSWER]) for pair, rows in groups}
    counts = []
    for (shape, texture), given in pairs.items():
        same_shape = [one for (s, t), more in pairs.items() if s == shape and t != texture for one in more]
        same_texture = [one for (s, t), more in pairs.items() if t == texture and s != shape for one in more]
        drawn = min(len(same_shape), len(same_texture))
        if drawn:
            each = (Counter(generator.sample(one, drawn)).items() for one in (same_shape, same_texture))
            by_shape, by_texture = (min(one, key=lambda item: (-item[1], item[0]))[0] for one in each)
            counts.append((len(given), given.count(by_shape), given.count(by_texture)))
    return counts


def _which(pairs: Sequence[Predicted]) -> str:
    """By how much more the shape predicts than the texture, both of the same answers. Answers about one pair go
    together: the interval is a percentile bootstrap over pairs."""
    if len(pairs) < FEWEST_PAIRS:
        return (
            "Whether the answers go more by shape or by texture is not said: that takes at least two objects and two "
            f"textures, {FEWEST_PAIRS} pairs in all."
        )

    def ahead(some: Sequence[Predicted]) -> float:
        return sum(shape - texture for _, shape, texture in some) / sum(given for given, _, _ in some)

    generator, outside = random.Random(SEED), round(RESAMPLES * 0.025)
    drawn = sorted(ahead(generator.choices(pairs, k=len(pairs))) for _ in range(RESAMPLES))
    interval = drawn[outside], drawn[-1 - outside]
    total, shape, texture = (sum(one) for one in zip(*pairs, strict=True))
    verdict = (
        "the model goes more by shape than by texture" if interval[0] > 0.0
        else "the model goes more by texture than by shape" if interval[1] < 0.0 else "no difference is shown"
    )  # fmt: skip
    return (
        f"The most frequent answer about the same object with other textures is given in {percent(shape / total)}, "
        f"and that about the same texture on other objects, of as many answers, in {percent(texture / total)}: "
        f"{100 * ahead(pairs):.0f} points more by shape (95 % interval {100 * interval[0]:.0f} to "
        f"{100 * interval[1]:.0f}, over pairs of object and texture): {verdict}."
    )
