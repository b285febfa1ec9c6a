"""How far the model's answers about renderings hold for other pictures of the same: photographs, or renderings anew.

After 3DB (Leclerc et al. 2022), section 4 and figure 14: of the pictures that a model gets right, or wrong, in
simulation, the share of which it is right, or wrong, about the photograph.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from advsearch.errors import InputError
from advsearch.explanations import PHOTOGRAPHS, Answered
from advsearch.questions.recipe.answer import AgreementCount, AgreementFigure, AgreementSeries
from advsearch.questions.recipe.figures.along import COLOURS, MARKS
from advsearch.questions.recipe.table import FigureKind, Options, Table, count_of, rate_with_interval
from advsearch.report.phrases import percent

NO_PHOTOGRAPHS = (
    "There are no photographs yet: nothing is said about reality here. Take some with advsearch dashboard and the "
    "runs in parts/, or name a folder of them (photographs=FOLDER), and let advsearch resume go on with this run."
)
ALL = "all objects"

AnswerPair = tuple[Answered, Answered]


class AgreementOptions(Options):
    """Options of agreements.

    Attributes:
        of: the part whose renderings are compared with photographs, and parts that picture the same configurations
            under other conditions.
        names: what the others are called in sentences, where not by their part.
    """

    of: tuple[str, ...] = Field(min_length=1)
    names: dict[str, str] = Field(default_factory=dict)

    @property
    def parts(self) -> tuple[str, ...]:
        """Those, and photographs."""
        return (*self.of, PHOTOGRAPHS)


def _compute(table: Table, options: AgreementOptions) -> AgreementFigure:
    shown = [row for row in table.rows if row.part == options.of[0]]
    if not shown:
        raise InputError(f"figures: agreement: expected answers of a part {options.of[0]!r}, got none")
    series = [_series(shown, table.rows, part, options) for part in (PHOTOGRAPHS, *options.of[1:])]
    known = [one for one in series if one.total.agreeing.configurations or one.alone]
    said = [] if known and known[0].part == PHOTOGRAPHS else [NO_PHOTOGRAPHS]
    return AgreementFigure(
        figure="agreement",
        title=options.title or "Renderings and other pictures of the same",
        text=said + [text for one in known for text in _said(one)],
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


def _said(one: AgreementSeries) -> list[str]:
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


def _draw(made: AgreementFigure, figure: Any, run: Path) -> None:
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
    _compute,
    _draw,
    lambda made: (6.0, 1.7 + 0.2 * len(made.series) + 0.34 * len(made.series[0].rows if made.series else [])),
    tells_models=True,
)
