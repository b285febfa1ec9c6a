"""Which answers are given: the most frequent ones for each value of something; whether they go by shape or texture."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from advsearch.errors import InputError
from advsearch.explanations import PHOTOGRAPHS, Answered
from advsearch.questions.recipe.along import COLOURS, MARKS
from advsearch.questions.recipe.answer import (
    AgreementCount,
    AgreementFigure,
    AgreementSeries,
    AnswersFigure,
    AnswersRow,
    CuesFigure,
    CuesRow,
    GivenAnswer,
    NamedCount,
)
from advsearch.questions.recipe.table import (
    FigureKind,
    Options,
    Table,
    count_of,
    counted,
    extremes,
    most_frequent,
    plural,
    rate_with_interval,
)
from advsearch.report.figures import BLUE, GREY, RED
from advsearch.report.phrases import percent
from advsearch.report.wording import interval_text
from advsearch.runs.results.base import Interval

LETTERS = 85
"""Letters that a bar of the whole width has room for."""
FEWEST_LETTERS = 4
"""Of a name that is cut short."""


class AnswersOptions(Options):
    """Options of the most frequent answers."""

    by: str
    most: int = Field(default=4, ge=1, le=10)


def _compute_given(table: Table, options: AnswersOptions) -> AnswersFigure:
    rows = [_row_given(name, inside, options.most) for name, inside in table.by(options.by).items()]
    return AnswersFigure(
        figure="answers",
        title=options.title or f"Most frequent answers by {options.by}",
        text=_said(rows, plural(options.by)),
        by=options.by,
        rows=rows,
    )


def _row_given(name: str, rows: list[Answered], most: int) -> AnswersRow:
    answers = [
        GivenAnswer(
            **count_of(answer, number, len(rows)).model_dump(),
            right=sum(row.correct for row in rows if row.answer == answer),
        )
        for answer, number in most_frequent(rows)[:most]
    ]
    return AnswersRow(**counted(name, rows).model_dump(), answers=answers)


def _said(rows: list[AnswersRow], thing: str) -> list[str]:
    wrong = [row for row in rows if row.answers and 2 * row.answers[0].right < row.answers[0].correct]
    said = [f"For {len(rows) - len(wrong)} of {len(rows)} {thing} the most frequent answer is mostly a right one."]
    return said + [f"For {row.name} it is {_given(row.answers[0])}." for row in wrong]


def _given(one: GivenAnswer) -> str:
    share = f"{percent(one.accuracy)}, 95 % interval {interval_text(one.interval)}"
    return f"{one.name}, given in {one.correct} of {one.configurations} ({share}) and right in {one.right} of these"


def fitting(name: str, share: float) -> str:
    """Return as much of an answer's name as a bar has room for: the first of several names, or its beginning."""
    room, first = int(share * LETTERS), name.partition(",")[0]
    fits = next((one for one in (name, first) if len(one) <= room), None)
    return fits if fits is not None else f"{first[: room - 1].rstrip()}…" if room > FEWEST_LETTERS else ""


def _draw_given(made: AnswersFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    for place, row in enumerate(reversed(made.rows)):
        left = 0.0
        for one in row.answers:
            share = one.accuracy or 0.0
            colour = BLUE if 2 * one.right >= one.correct else RED
            axes.barh(place, share, left=left, color=colour, alpha=0.5, height=0.72, edgecolor="white")
            axes.text(left + share / 2, place, fitting(one.name, share), ha="center", va="center", fontsize=7)
            left += share
        axes.barh(place, max(1.0 - left, 0.0), left=left, color=GREY, alpha=0.15, height=0.72)
    axes.set_yticks(range(len(made.rows)), [row.name for row in reversed(made.rows)])
    axes.set(xlabel="share of answers; blue: mostly right, red: mostly wrong, grey: others", xlim=(0.0, 1.0))
    axes.set_title(made.title)


ANSWERS = FigureKind(
    AnswersOptions, AnswersFigure, _compute_given, _draw_given, lambda made: (6.4, 1.2 + 0.3 * len(made.rows))
)


SEED, RESAMPLES = 0, 2000
"""Of the answers that predict, and of the bootstrap."""

FEWEST_CELLS = 4
"""Pairs of object and texture: two of each."""


class CuesOptions(Options):
    """Options of cues; for a texture, `classes` are the answers that name it."""

    texture: str = "material.which"
    shape: str = "object"
    classes: dict[str, list[str]] = Field(default_factory=dict)


def _compute_cues(table: Table, options: CuesOptions) -> CuesFigure:
    rows = [
        _row_cues(name, inside, options.classes.get(name, [])) for name, inside in table.by(options.texture).items()
    ]
    cells = _cells(table, options)
    total = sum(one.answers for one in cells)
    predicted = [
        count_of("shape", sum(one.by_shape for one in cells), total),
        count_of("texture", sum(one.by_texture for one in cells), total),
    ]
    difference = _difference(cells)
    return CuesFigure(
        figure="cues",
        title=options.title or "Answers by shape and by texture",
        text=[*_by_texture(table, options, rows), *_which(predicted, difference), *_hardest(rows)],
        shape=options.shape,
        texture=options.texture,
        predicted=predicted,
        difference=None if difference is None else difference[0],
        difference_interval=None if difference is None else difference[1],
        rows=rows,
    )


def _row_cues(name: str, rows: list[Answered], classes: list[str]) -> CuesRow:
    return CuesRow(**counted(name, rows).model_dump(), textured=sum(_names(row.answer, classes) for row in rows))


def _names(answer: str, classes: list[str]) -> bool:
    """Whether an answer, or one of the names that it consists of, is among some."""
    return any(name.strip() in classes for name in [answer, *answer.split(",")])


@dataclass(frozen=True)
class _Cell:
    """One object with one texture: how many answers there are, and how many each cue predicts."""

    answers: int
    by_shape: int
    by_texture: int


def _cells(table: Table, options: CuesOptions) -> list[_Cell]:
    """Predict the answers about each object with each texture by those about it with others, and with others by it.

    Each cue predicts the most frequent one of as many answers: those about the same object with other textures, and
    about the same texture on other objects, drawn so that both are as many as the fewer are. None of the predicted
    answers is among them, so that a model which answers by neither cue is predicted as well by both.
    """
    generator = random.Random(SEED)
    inside: dict[tuple[float | str, float | str], list[str]] = {}
    for row in table.rows:
        key = table.value(row, options.shape), table.value(row, options.texture)
        inside.setdefault(key, []).append(row.answer)
    found = []
    for (shape, texture), answers in inside.items():
        same_shape = [one for (s, t), more in inside.items() if s == shape and t != texture for one in more]
        same_texture = [one for (s, t), more in inside.items() if t == texture and s != shape for one in more]
        count = min(len(same_shape), len(same_texture))
        if count:
            first = [_most(generator.sample(one, count)) for one in (same_shape, same_texture)]
            found.append(_Cell(len(answers), answers.count(first[0]), answers.count(first[1])))
    return found


def _most(answers: Sequence[str]) -> str:
    return min(Counter(answers).items(), key=lambda one: (-one[1], one[0]))[0]


def _difference(cells: Sequence[_Cell]) -> tuple[float, Interval] | None:
    """Return by how much more the shape predicts than the texture, and the 95 % interval of that.

    The two are shares of the same answers, and answers about one object with one texture go together: the interval is
    a percentile bootstrap over pairs of object and texture. None with fewer than `FEWEST_CELLS` of these.
    """
    if len(cells) < FEWEST_CELLS:
        return None
    generator = random.Random(SEED)
    drawn = sorted(_mean(generator.choices(cells, k=len(cells))) for _ in range(RESAMPLES))
    outside = round(RESAMPLES * 0.025)
    return _mean(cells), (drawn[outside], drawn[-1 - outside])


def _mean(cells: Sequence[_Cell]) -> float:
    return sum(one.by_shape - one.by_texture for one in cells) / sum(one.answers for one in cells)


def _by_texture(table: Table, options: CuesOptions, rows: list[CuesRow]) -> list[str]:
    shape = count_of("by shape", sum(one.correct for one in rows), sum(one.configurations for one in rows))
    asked = [one for one in rows if options.classes.get(one.name)]
    said = [f"The answer is the object, whatever its texture: {rate_with_interval(shape, 'so')}."]
    if asked:
        named = count_of("by texture", sum(one.textured for one in asked), sum(one.configurations for one in asked))
        known = ", ".join(one.name for one in asked)
        said.append(f"The answer names the texture ({known}): {rate_with_interval(named, 'so')}.")
        if not named.correct:
            said.append("A model that has no class for a texture cannot name it.")
    return said


def _which(predicted: Sequence[NamedCount], difference: tuple[float, Interval] | None) -> list[str]:
    shape, texture = predicted
    if difference is None:
        return [
            "Whether the answers go more by shape or by texture is not said: that takes at least two objects and two "
            f"textures, {FEWEST_CELLS} pairs in all."
        ]
    mean, (low, high) = difference
    said = (
        f"The most frequent answer about the same object with other textures is given in {percent(shape.accuracy)}, "
        f"and that about the same texture on other objects, of as many answers, in {percent(texture.accuracy)}: "
        f"{100 * mean:.0f} points more by shape (95 % interval {100 * low:.0f} to {100 * high:.0f}, over pairs of "
        "object and texture)"
    )
    if low > 0.0:
        return [f"{said}: the model goes more by shape than by texture."]
    if high < 0.0:
        return [f"{said}: the model goes more by texture than by shape."]
    return [f"{said}: no difference is shown."]


def _hardest(rows: list[CuesRow]) -> list[str]:
    return extremes(rows, "The hardest texture", "the easiest", "textures")


def _draw_cues(made: CuesFigure, figure: Any, run: Path) -> None:
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


CUES = FigureKind(CuesOptions, CuesFigure, _compute_cues, _draw_cues, lambda made: (6.0, 1.7 + 0.27 * len(made.rows)))


NO_PHOTOGRAPHS = (
    "There are no photographs yet: nothing is said about reality here. Take some with advsearch dashboard and the "
    "runs in parts/, or name a folder of them (photographs=FOLDER), and let advsearch resume go on with this run."
)
ALL = "all objects"

AnswerPair = tuple[Answered, Answered]


class AgreementOptions(Options):
    """Options of agreements: the part whose renderings are compared with photographs, and parts that picture the same
    configurations under other conditions."""

    of: tuple[str, ...] = Field(min_length=1)
    names: dict[str, str] = Field(default_factory=dict)

    @property
    def parts(self) -> tuple[str, ...]:
        """Those, and photographs."""
        return (*self.of, PHOTOGRAPHS)


def _compute_agreement(table: Table, options: AgreementOptions) -> AgreementFigure:
    shown = [row for row in table.rows if row.part == options.of[0]]
    if not shown:
        raise InputError(f"figures: agreement: expected answers of a part {options.of[0]!r}, got none")
    series = [_series(shown, table.rows, part, options) for part in (PHOTOGRAPHS, *options.of[1:])]
    known = [one for one in series if one.total.agreeing.configurations or one.alone]
    said = [] if known and known[0].part == PHOTOGRAPHS else [NO_PHOTOGRAPHS]
    return AgreementFigure(
        figure="agreement",
        title=options.title or "Renderings and other pictures of the same",
        text=said + [text for one in known for text in _said_of_series(one)],
        renderings=options.of[0],
        series=known,
    )


def _series(
    shown: Sequence[Answered], rows: Sequence[Answered], part: str, options: AgreementOptions
) -> AgreementSeries:
    """Pair the pictures of a part with the renderings whose values they have."""
    names = list(shown[0].values)
    by_values = {_key(row, names): row for row in shown}
    others = [row for row in rows if row.part == part]
    pairs = [(found, row) for row in others if (found := by_values.get(_key(row, names))) is not None]
    if part != PHOTOGRAPHS and len(pairs) < len(others):
        raise InputError(f"figures: agreement: expected {part} to have the configurations of {options.of[0]}")
    objects = list(dict.fromkeys(str(row.values["object"]) for row in shown))
    by_object = {name: [pair for pair in pairs if pair[0].values["object"] == name] for name in objects}
    return AgreementSeries(
        part=part,
        name=options.names.get(part, part),
        alone=len(others) - len(pairs),
        total=_count(ALL, pairs),
        rows=[_count(name, inside) for name, inside in by_object.items()],
    )


def _key(row: Answered, names: Sequence[str]) -> Hashable:
    """The values that renderings have; other pictures may have more."""
    return tuple(row.values.get(name) for name in names)


def _count(name: str, pairs: Sequence[AnswerPair]) -> AgreementCount:
    counts = {
        (a, b): sum((x.correct, y.correct) == (a, b) for x, y in pairs) for a in (True, False) for b in (True, False)
    }
    return AgreementCount(
        name=name,
        right_right=counts[True, True],
        right_wrong=counts[True, False],
        wrong_right=counts[False, True],
        wrong_wrong=counts[False, False],
        same_answer=sum(x.answer == y.answer for x, y in pairs),
        agreeing=count_of(name, counts[True, True] + counts[False, False], len(pairs)),
    )


def _said_of_series(one: AgreementSeries) -> list[str]:
    total, said = one.total, []
    if total.agreeing.configurations:
        said.append(
            f"Renderings and {one.name}: {rate_with_interval(total.agreeing, 'right about both or wrong about both')}. "
            f"{_share('right', total.right_right, total.right_wrong)} "
            f"{_share('wrong', total.wrong_wrong, total.wrong_right)} The answer is the same in "
            f"{total.same_answer} of {total.agreeing.configurations} "
            f"({percent(total.same_answer / total.agreeing.configurations)})."
        )
    if one.part == PHOTOGRAPHS and total.agreeing.configurations:
        said.append("The intervals take photographs as independent.")
    if one.alone:
        belong = "belongs" if one.alone == 1 else "belong"
        said.append(f"{one.alone} of the photographs {belong} to no rendering and so to no pair.")
    return said


def _share(verb: str, same: int, other: int) -> str:
    if not same + other:
        return f"It is {verb} about none of the renderings."
    counted = rate_with_interval(count_of("", same, same + other), verb)
    return f"Where it is {verb} about the rendering, it is {counted} about the other."


def _draw_agreement(made: AgreementFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    names = [ALL, *[row.name for row in made.series[0].rows][::-1]] if made.series else []
    for number, one in enumerate(made.series):
        shift = (number - (len(made.series) - 1) / 2) * 0.22
        colour, label = COLOURS[number % len(COLOURS)], one.name
        for row in [one.total, *one.rows]:
            share, place = row.agreeing, names.index(row.name) - shift
            if share.interval:
                axes.plot(share.interval, [place] * 2, color=colour, alpha=0.45, linewidth=3)
                axes.plot(share.accuracy, place, MARKS[number % len(MARKS)], color=colour, ms=5, label=label)
                label = "_"
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel="share that agrees, with 95 % interval", xlim=(-0.03, 1.03), ylim=(-0.6, max(len(names), 1) - 0.4))
    axes.set_title(made.title)
    axes.grid(True, axis="x")
    figure.legend(loc="outside lower center", ncols=1)


AGREEMENT = FigureKind(
    AgreementOptions,
    AgreementFigure,
    _compute_agreement,
    _draw_agreement,
    lambda made: (6.0, 1.7 + 0.2 * len(made.series) + 0.34 * len(made.series[0].rows if made.series else [])),
    tells_models=True,
)
