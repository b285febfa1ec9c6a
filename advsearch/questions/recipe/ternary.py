"""Ternary diagrams: how often each answer is given over a mixture; how sure it is where there is but one answer."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from advsearch.explanations import Answered
from advsearch.questions.recipe.answer import MixtureLead, TernaryAnswer, TernaryCell, TernaryFigure, bare
from advsearch.questions.recipe.table import CONFIDENCE, FigureKind, Options, Table, count_of, extremes, most_frequent
from advsearch.report.phrases import percent

Shares = tuple[float, float, float]


class TernaryOptions(Options):
    """Options of ternary diagrams of three shares. Of normalised ones the colours of each answer end at its own largest
    share, and those of leads begin at the smallest; `side` is triangles along a side."""

    shares: tuple[str, str, str]
    normalised: bool = False
    most: int = Field(default=3, ge=1, le=6)
    side: int = Field(default=5, ge=1, le=20)


def _compute(table: Table, options: TernaryOptions) -> TernaryFigure:
    mixtures = [_mixture(values) for values in zip(*(table.numbers(name) for name in options.shares), strict=True)]
    places = [_cell_of(one, options.side) for one in mixtures]
    given = most_frequent(table.rows)
    answers = [_answer(name, table.rows, mixtures, places, options) for name, _ in given[: options.most]]
    leads = _leads(table.rows, mixtures, options.shares) if len(given) == 1 else []
    text = _told(given[0][0], leads) if leads else [text for one in answers for text in _said(one, len(table.rows))]
    empty = sum(not cell.configurations for cell in answers[0].cells) if answers else 0
    if empty:
        text.append(
            f"No picture was drawn in {empty} of {len(answers[0].cells)} parts of the diagram, which are hatched."
        )
    return TernaryFigure(
        figure="ternary",
        title=options.title or f"Answers over {', '.join(bare(one) for one in options.shares)}",
        text=text,
        shares=options.shares,
        normalised=options.normalised,
        answers=answers,
        leads=leads,
    )


def _mixture(values: Sequence[float]) -> Shares:
    total = sum(values) or 1.0
    a, b, c = (value / total for value in values)
    return a, b, c


def _cell_of(mixture: Shares, side: int) -> tuple[int, int, bool]:
    """The triangle that a mixture is in: how far along the first and second share, and whether it points down."""
    a, b, c = (int(share * side) for share in mixture)
    while a + b + c >= side:  # where triangles meet
        a, b, c = (a - 1, b, c) if a >= max(b, c) else (a, b - 1, c) if b >= c else (a, b, c - 1)
    return a, b, a + b + c < side - 1


def _cells(side: int) -> Iterator[tuple[int, int, bool]]:
    for a in range(side):
        for b in range(side - a):
            yield a, b, False
            if a + b < side - 1:
                yield a, b, True


def _corners(cell: tuple[int, int, bool], side: int) -> list[Shares]:
    a, b, down = cell
    points = [(a + 1, b + 1), (a, b + 1), (a + 1, b)] if down else [(a, b), (a + 1, b), (a, b + 1)]
    return [(x / side, y / side, (side - x - y) / side) for x, y in points]


def _answer(
    name: str,
    rows: Sequence[Answered],
    mixtures: Sequence[Shares],
    places: Sequence[tuple[int, int, bool]],
    options: TernaryOptions,
) -> TernaryAnswer:
    given = [row.answer == name for row in rows]
    most = [one.index(max(one)) for one in mixtures]
    by_most = [
        count_of(bare(share), sum(one for one, at in zip(given, most, strict=True) if at == number), most.count(number))
        for number, share in enumerate(options.shares)
    ]
    cells = []
    for cell in _cells(options.side):
        inside = [number for number, at in enumerate(places) if at == cell]
        known = [-margin for number in inside if (margin := rows[number].margin) is not None]
        cells.append(
            TernaryCell(
                corners=_corners(cell, options.side),
                configurations=len(inside),
                given=sum(given[number] for number in inside),
                lead=statistics.fmean(known) if known else None,
            )
        )
    return TernaryAnswer(answer=name, given=sum(given), by_most=by_most, cells=cells)


def _leads(rows: Sequence[Answered], mixtures: Sequence[Shares], names: Sequence[str]) -> list[MixtureLead]:
    """How far the right answer leads, by what most of the mixture is; nothing where fewer than two are known of one."""
    found: list[list[float]] = [[] for _ in names]
    for row, mixture in zip(rows, mixtures, strict=True):
        if row.margin is not None:
            found[mixture.index(max(mixture))].append(-row.margin)
    if min(map(len, found)) < 2:
        return []
    return [
        MixtureLead(
            name=bare(name),
            configurations=len(leads),
            mean=statistics.fmean(leads),
            error=statistics.stdev(leads) / math.sqrt(len(leads)),
        )
        for name, leads in zip(names, found, strict=True)
    ]


def _told(answer: str, leads: Sequence[MixtureLead]) -> list[str]:
    """The smallest lead beside the largest, by intervals of the normal distribution widened for a choice among all."""
    low, high = (pick(leads, key=lambda one: one.mean) for pick in (min, max))
    wide = statistics.NormalDist().inv_cdf(1.0 - (1.0 - CONFIDENCE) / (2.0 * len(leads)))
    shown = low.mean + wide * low.error < high.mean - wide * high.error
    widened = f"their intervals, widened for having been chosen among {len(leads)},"
    return [
        f"The answer is {answer} in every picture, so that shares of answers tell nothing. Colours are how far the "
        "right answer leads the best wrong one: the margin with its sign turned, in logits for a classifier.",
        f"It leads least where most of the mixture is {low.name}: {_mean(low)}; most where most of it is {high.name}: "
        f"{_mean(high)}. "
        + (
            f"The difference is shown: {widened} do not overlap."
            if shown
            else f"No difference is shown: {widened} overlap."
        ),
    ]


def _mean(one: MixtureLead) -> str:
    wide = statistics.NormalDist().inv_cdf(0.5 + CONFIDENCE / 2.0) * one.error
    return (
        f"{one.mean:.3g} (95 % interval {one.mean - wide:.3g} to {one.mean + wide:.3g}, {one.configurations} pictures)"
    )


def _said(one: TernaryAnswer, total: int) -> list[str]:
    whose = f"{one.answer}, {percent(one.given / total)} of all answers, is"
    known = [count for count in one.by_most if count.configurations]
    if len({count.accuracy for count in known}) == 1:
        return [f"{whose} given as often whatever most of the mixture is: no difference is shown."]
    least = f"{whose} rarest where most of the mixture"
    return extremes(known, least, "most frequent where most of it", "ingredients", "given")


def _draw(made: TernaryFigure, figure: Any, run: Path) -> None:
    panels = figure.subplots(1, len(made.answers), squeeze=False)[0]
    shown = None
    label = "mean lead of the right answer" if made.leads else "share of answers"
    for axes, one in zip(panels, made.answers, strict=True):
        shown = _panel(axes, one, made)
        if made.normalised:
            figure.colorbar(shown, ax=axes, shrink=0.7, location="bottom", label=label)
    if shown is not None and not made.normalised:
        figure.colorbar(shown, ax=list(panels), shrink=0.7 / len(panels), location="bottom", label=label)
    figure.suptitle(made.title, x=0.01, ha="left", fontsize=10, fontweight="bold")


def _panel(axes: Any, one: TernaryAnswer, made: TernaryFigure) -> Any:
    from matplotlib.collections import PolyCollection  # matplotlib takes half a second

    values = [_value(cell, bool(made.leads)) for cell in one.cells]
    places = [[_place(corner) for corner in cell.corners] for cell in one.cells]
    known = [value for value in values if value is not None]
    shown = PolyCollection(
        [place for place, value in zip(places, values, strict=True) if value is not None],
        array=known, cmap="viridis", edgecolors="face",
    )  # fmt: skip
    low = min([*known, 0.0]) if not made.normalised or not made.leads else min(known)
    shown.set_clim(low, max([*known, 1e-9]) if made.normalised or made.leads else 1.0)
    axes.add_collection(shown)
    empty = [place for place, value in zip(places, values, strict=True) if value is None]
    axes.add_collection(PolyCollection(empty, facecolors="#eeeeef", edgecolors="#b9bbc0", hatch="////", linewidth=0))
    corners = [_place(corner) for corner in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    axes.plot(*zip(*corners, corners[0], strict=True), color="#1c1d20", linewidth=0.8)
    for (x, y), name in zip(corners, made.shares, strict=True):
        below = y < 0.1
        axes.annotate(bare(name), (x, y), (0, -4 if below else 4), textcoords="offset points", ha="center",
                      va="top" if below else "bottom", fontsize=8)  # fmt: skip
    axes.set_title(f"{one.answer}", fontsize=9, loc="center", pad=14)
    axes.set(xlim=(-0.12, 1.12), ylim=(-0.14, 1.0), aspect="equal")
    axes.axis("off")
    return shown


def _value(cell: TernaryCell, lead: bool) -> float | None:
    """What a triangle's colour says; None where nothing is known."""
    if lead:
        return cell.lead
    return cell.given / cell.configurations if cell.configurations else None


def _place(shares: Shares) -> tuple[float, float]:
    """Where a mixture lies: the first share at the left, the second at the right, the third at the top."""
    return shares[1] + shares[2] / 2.0, shares[2] * math.sqrt(3.0) / 2.0


TERNARY = FigureKind(
    TernaryOptions, TernaryFigure, _compute, _draw, lambda made: (max(2.4 * len(made.answers), 4.8), 3.5)
)
