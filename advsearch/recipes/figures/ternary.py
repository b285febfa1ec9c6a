"""Ternary diagrams: how often each answer is given over a mixture of three things."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from advsearch.recipes.figures.base import Kind, Options, extremes
from advsearch.recipes.table import Answered, Table, count_of, most_frequent
from advsearch.report.phrases import percent
from advsearch.report.recipes import bare
from advsearch.runs.results.recipe import TernaryAnswer, TernaryCell, TernaryFigure

Shares = tuple[float, float, float]


class TernaryOptions(Options):
    """Options of ternary diagrams.

    Attributes:
        shares: three parameters, of which each picture has a mixture.
        normalised: whether the colours of each answer end at its own largest share, or all at 1.
        most: answers, the most frequent first.
        side: triangles along a side.
    """

    shares: tuple[str, str, str]
    normalised: bool = False
    most: int = Field(default=3, ge=1, le=6)
    side: int = Field(default=5, ge=1, le=20)


def _compute(table: Table, options: TernaryOptions) -> TernaryFigure:
    mixtures = [_mixture(values) for values in zip(*(table.numbers(name) for name in options.shares), strict=True)]
    places = [_cell_of(one, options.side) for one in mixtures]
    answers = [
        _answer(name, table.rows, mixtures, places, options)
        for name, _ in most_frequent(table.rows)[: options.most]
    ]  # fmt: skip
    return TernaryFigure(
        figure="ternary",
        title=options.title or f"Answers over {', '.join(bare(one) for one in options.shares)}",
        text=[text for one in answers for text in _said(one, len(table.rows))],
        shares=options.shares,
        normalised=options.normalised,
        answers=answers,
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
        inside = [one for one, at in zip(given, places, strict=True) if at == cell]
        cells.append(TernaryCell(corners=_corners(cell, options.side), configurations=len(inside), given=sum(inside)))
    return TernaryAnswer(answer=name, given=sum(given), by_most=by_most, cells=cells)


def _said(one: TernaryAnswer, total: int) -> list[str]:
    least = f"{one.answer}, {percent(one.given / total)} of all answers, is rarest where most of the mixture"
    return extremes(one.by_most, least, "most frequent where most of it", "things", "given")


def _draw(made: TernaryFigure, figure: Any, run: Path) -> None:
    panels = figure.subplots(1, len(made.answers), squeeze=False)[0]
    shown = None
    for axes, one in zip(panels, made.answers, strict=True):
        shown = _panel(axes, one, made)
        if made.normalised:
            figure.colorbar(shown, ax=axes, shrink=0.6)
    if shown is not None and not made.normalised:
        figure.colorbar(shown, ax=list(panels), shrink=0.6, label="share of answers")
    figure.suptitle(made.title, x=0.01, ha="left", fontsize=10, fontweight="bold")


def _panel(axes: Any, one: TernaryAnswer, made: TernaryFigure) -> Any:
    from matplotlib.collections import PolyCollection

    known = [cell for cell in one.cells if cell.configurations]
    shares = [cell.given / cell.configurations for cell in known]
    top = max([*shares, 1e-9]) if made.normalised else 1.0
    places = [[_place(corner) for corner in cell.corners] for cell in known]
    shown = PolyCollection(places, array=shares, cmap="viridis", edgecolors="face")
    shown.set_clim(0.0, top)
    axes.add_collection(shown)
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


def _place(shares: Shares) -> tuple[float, float]:
    """Where a mixture lies: the first share at the left, the second at the right, the third at the top."""
    return shares[1] + shares[2] / 2.0, shares[2] * math.sqrt(3.0) / 2.0


TERNARY = Kind(
    TernaryOptions, TernaryFigure, _compute, _draw, lambda made: (max(1.0 + 2.1 * len(made.answers), 4.6), 2.7)
)
