"""Ternary diagrams: how often each answer is given over a mixture; how sure it is where there is but one answer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from advsearch.attacks.trials import CONFIDENCE
from advsearch.questions.recipe.answer import Cell
from advsearch.questions.recipe.table import (
    ANSWER,
    COUNT,
    MadeFigure,
    Options,
    Table,
    Tally,
    bare,
    extremes,
    most_frequent,
)
from advsearch.report.wording import percent

Doubles = npt.NDArray[np.float64]
Shares = tuple[float, float, float]
Corners = tuple[Shares, Shares, Shares]

MEANINGLESS = (
    "The answer is {} in every picture, so that shares of answers tell nothing. Colours are how far the right answer "
    "leads the best wrong one: the margin with its sign turned, in logits for a classifier."
)


class TernaryOptions(Options):
    """Options of ternary diagrams of three shares. Of normalised ones the colours of each answer end at its own largest
    share, and those of leads begin at the smallest; `side` is triangles along a side."""

    shares: tuple[str, str, str]
    normalised: bool = False
    most: int = Field(default=3, ge=1, le=6)
    side: int = Field(default=5, ge=1, le=20)


def ternary(table: Table, options: TernaryOptions) -> MadeFigure:
    """Count where in a mixture each answer is given; where all are the same, how far the right one leads."""
    amounts = np.stack([table.numbers(name) for name in options.shares], axis=1)
    sums = amounts.sum(axis=1, keepdims=True)
    mixtures = amounts / np.where(sums == 0.0, 1.0, sums)
    rows, names = table.rows, [bare(name) for name in options.shares]
    most = mixtures.argmax(axis=1)  # of what most of each mixture is
    triangles, corners = [triangle_of(mixture, options.side) for mixture in mixtures], all_triangles(options.side)
    inside = {triangle: np.array([at == triangle for at in triangles], dtype=bool) for triangle in corners}
    given, lead = most_frequent(rows), -rows["margin"].astype(float).to_numpy()
    leads = {name: lead[(most == number) & ~np.isnan(lead)] for number, name in enumerate(names)}
    by_lead = len(given) == 1 and min(map(len, leads.values())) >= 2
    text, table_rows = list[str](), list[list[Cell]]()
    columns = ["answer", "where most is", "given in", *COUNT]
    panels: list[tuple[str, list[float | None]]] = []
    for answer, times in given[: options.most]:
        flags = (rows[ANSWER] == answer).to_numpy()
        values = lead if by_lead else flags
        known = {triangle: values[own & ~np.isnan(values)] for triangle, own in inside.items()}
        panels.append((answer, [float(some.mean()) if len(some) else None for some in known.values()]))
        if not by_lead:
            by_most = [Tally.over(name, rows[most == k], flags[most == k]) for k, name in enumerate(names)]
            text += _told_shares(answer, times / len(rows), by_most)
            table_rows += [[answer, count.name, *count.cells] for count in by_most]
    if by_lead:
        text = [MEANINGLESS.format(given[0][0]), _told_leads(leads)]
        columns = ["where most is", "pictures", "mean lead of the right answer", "standard error"]
        table_rows = [[name, len(own), float(own.mean()), _error(own)] for name, own in leads.items()]
    empty = sum(not own.any() for own in inside.values())
    if empty:
        text.append(f"No picture was drawn in {empty} of {len(corners)} parts of the diagram, which are hatched.")
    title = options.title or f"Answers over {', '.join(names)}"

    def draw(figure: Any) -> None:
        each = figure.subplots(1, len(panels), squeeze=False)[0]
        label = "mean lead of the right answer" if by_lead else "share of answers"
        for axes, (answer, values) in zip(each, panels, strict=True):
            colours = _panel(axes, answer, values, list(corners.values()), names)
            known = [value for value in values if value is not None]
            low = min(known) if options.normalised and by_lead else min([*known, 0.0])
            colours.set_clim(low, max([*known, 1e-9]) if options.normalised or by_lead else 1.0)
            if options.normalised:
                figure.colorbar(colours, ax=axes, shrink=0.7, location="bottom", label=label)
        if not options.normalised:
            figure.colorbar(colours, ax=list(each), shrink=0.7 / len(each), location="bottom", label=label)

    return MadeFigure(title, text, columns, table_rows, draw, (max(2.4 * len(panels), 4.8), 3.5))


Triangle = tuple[int, int, bool]
"""How far along the first and the second share it is, and whether it points down."""


def triangle_of(mixture: Sequence[float], side: int) -> Triangle:
    """Return the triangle that three shares (3,) lie in, of a diagram with so many along a side."""
    a, b, c = (int(share * side) for share in mixture)
    while a + b + c >= side:  # where triangles meet
        a, b, c = (a - 1, b, c) if a >= max(b, c) else (a, b - 1, c) if b >= c else (a, b, c - 1)
    return a, b, a + b + c < side - 1


def all_triangles(side: int) -> dict[Triangle, Corners]:
    """Return every triangle of the diagram with the shares at its corners."""

    def at(x: int, y: int) -> Shares:
        return x / side, y / side, (side - x - y) / side

    found: dict[Triangle, Corners] = {}
    for a in range(side):
        for b in range(side - a):
            found[a, b, False] = at(a, b), at(a + 1, b), at(a, b + 1)
            if a + b < side - 1:
                found[a, b, True] = at(a + 1, b + 1), at(a, b + 1), at(a + 1, b)
    return found


def _told_shares(answer: str, share: float, by_most: Sequence[Tally]) -> list[str]:
    whose = f"{answer}, {percent(share)} of all answers, is"
    known = [one for one in by_most if one.total]
    if len({one.share for one in known}) == 1:
        return [f"{whose} given as often whatever most of the mixture is: no difference is shown."]
    least = f"{whose} rarest where most of the mixture"
    return extremes(known, least, "most frequent where most of it", "ingredients", "given")


def _told_leads(leads: Mapping[str, Doubles]) -> str:
    """The smallest mean lead beside the largest, by intervals of the normal distribution widened for a choice among
    all."""
    least, most = (pick(leads, key=lambda name: leads[name].mean()) for pick in (min, max))
    wide = NormalDist().inv_cdf(1.0 - (1.0 - CONFIDENCE) / (2.0 * len(leads)))
    shown = leads[least].mean() + wide * _error(leads[least]) < leads[most].mean() - wide * _error(leads[most])
    own = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2.0)

    def told(name: str) -> str:
        mean, half, count = leads[name].mean(), own * _error(leads[name]), len(leads[name])
        return f"{name}: {mean:.3g} (95 % interval {mean - half:.3g} to {mean + half:.3g}, {count} pictures)"

    verdict = "The difference is shown: {} do not overlap" if shown else "No difference is shown: {} overlap"
    widened = f"their intervals, widened for having been chosen among {len(leads)},"
    return (
        f"It leads least where most of the mixture is {told(least)}; most where most of it is {told(most)}. "
        f"{verdict.format(widened)}."
    )


def _error(values: Doubles) -> float:
    return float(values.std(ddof=1)) / math.sqrt(len(values))


def _panel(
    axes: Any, answer: str, values: Sequence[float | None], corners: Sequence[Corners], names: Sequence[str]
) -> Any:
    """One diagram; what is coloured in it is returned."""
    from matplotlib.collections import PolyCollection  # matplotlib takes half a second

    places = [[_place(corner) for corner in three] for three in corners]
    coloured = PolyCollection(
        [place for place, value in zip(places, values, strict=True) if value is not None],
        array=[value for value in values if value is not None], cmap="viridis", edgecolors="face",
    )  # fmt: skip
    axes.add_collection(coloured)
    empty = [place for place, value in zip(places, values, strict=True) if value is None]
    axes.add_collection(PolyCollection(empty, facecolors="#eeeeef", edgecolors="#b9bbc0", hatch="////", linewidth=0))
    outer = [_place(corner) for corner in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    axes.plot(*zip(*outer, outer[0], strict=True), color="#1c1d20", linewidth=0.8)
    for (x, y), name in zip(outer, names, strict=True):
        below = y < 0.1
        axes.annotate(name, (x, y), (0, -4 if below else 4), textcoords="offset points", ha="center",
                      va="top" if below else "bottom", fontsize=8)  # fmt: skip
    axes.set_title(answer, fontsize=9, loc="center", pad=14)
    axes.set(xlim=(-0.12, 1.12), ylim=(-0.14, 1.0), aspect="equal")
    axes.axis("off")
    return coloured


def _place(shares: Shares) -> tuple[float, float]:
    """Where a mixture lies: the first share at the left, the second at the right, the third at the top."""
    return shares[1] + shares[2] / 2.0, shares[2] * math.sqrt(3.0) / 2.0
