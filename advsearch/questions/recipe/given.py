"""Figures of which predictions are made: the most frequent, by shape or texture, over
mixtures (ternary diagrams).
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from pydantic import Field

from advsearch.extend import figures, statistics, wording
from advsearch.questions.recipe import rates
from advsearch.questions.recipe.rates import MadeFigure, Options, Rows, Tally

# letters that a bar of the whole width has room for, and of a name that is cut short
LETTERS = 85
FEWEST_LETTERS = 4


class PredictionsOptions(Options):
    """Options of the most frequent predictions."""

    by: str
    most: int = Field(default=4, ge=1, le=10)


def predictions(rows: Rows, options: PredictionsOptions) -> MadeFigure:
    # how often each was given, and how often it was a right one
    groups: dict[str, list[tuple[Tally, int]]] = {}
    for value, some in rates.by(rows, options.by).items():
        groups[value] = []
        for label, _ in rates.most_frequent(some[rates.PREDICTION])[: options.most]:
            flags = some[rates.PREDICTION] == label
            groups[value].append(
                (Tally.over(label, some, flags), int(some["correct"][flags].sum()))
            )
    wrong = {
        value: each[0]
        for value, each in groups.items()
        if 2 * each[0][1] < each[0][0].times
    }
    known = len(groups) - len(wrong)
    thing = rates.plural(options.by)
    text = [
        f"For {known} of {len(groups)} {thing} the most frequent prediction is "
        "mostly a right one."
    ]
    text += [
        f"For {value} it is {tally.name}, {tally.told('given')} and right in {right} "
        "of these."
        for value, (tally, right) in wrong.items()
    ]

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for place, given in enumerate(groups.values()):
            left = 0.0
            for tally, right in given:
                share = tally.share or 0.0
                colour = figures.BLUE if 2 * right >= tally.times else figures.RED
                axes.barh(
                    place,
                    share,
                    left=left,
                    color=colour,
                    alpha=0.5,
                    height=0.72,
                    edgecolor="white",
                )
                axes.text(
                    left + share / 2,
                    place,
                    fitting(tally.name, share),
                    ha="center",
                    va="center",
                    fontsize=7,
                )
                left += share
            axes.barh(
                place,
                max(1.0 - left, 0.0),
                left=left,
                color=figures.GREY,
                alpha=0.15,
                height=0.72,
            )
        axes.set_yticks(range(len(groups)), list(groups))
        axes.invert_yaxis()
        axes.set(
            xlabel="share of predictions; blue: mostly right, red: mostly wrong, "
            "grey: others",
            xlim=(0.0, 1.0),
        )

    table = [
        [value, tally.name, *tally.cells, right]
        for value, given in groups.items()
        for tally, right in given
    ]
    heads = [options.by, "prediction", "given in", *rates.COUNT, "right"]
    title = f"Most frequent predictions by {options.by}"
    return MadeFigure(title, text, heads, table, draw, (6.4, 1.2 + 0.3 * len(groups)))


def fitting(name: str, share: float) -> str:
    """Return as much of a prediction's name as a bar has room for: the first of several
    names, or its beginning.
    """
    room = int(share * LETTERS)
    first = name.partition(",")[0]
    cut = f"{first[: room - 1].rstrip()}…" if room > FEWEST_LETTERS else ""
    return next((text for text in (name, first) if len(text) <= room), cut)


# ---- shape and texture
# ----------------------------------------------------------------------------------------------

SEED = 0  # of the pairs that predict, and of the bootstrap
RESAMPLES = 2000
FEWEST_PAIRS = 4  # pairs of object and texture: two of each


class CuesOptions(Options):
    """Options of cues; for a texture, `classes` are the predictions that name it."""

    texture: str = "material.which"
    shape: str = "object"
    classes: dict[str, list[str]] = Field(default_factory=dict)


def cues(rows: Rows, options: CuesOptions) -> MadeFigure:
    """Count how often the prediction is the object and how often the texture, and which
    of both foretells it better.
    """

    textures = rates.by(rows, options.texture)
    naming = dict[str, Any]()
    for texture, some in textures.items():
        classes = set(options.classes.get(texture, ()))
        # the whole prediction, or one of the names that it consists of
        parts = some[rates.PREDICTION].map(
            lambda label: {label.strip(), *map(str.strip, label.split(","))}
        )
        naming[texture] = ~parts.map(classes.isdisjoint)
    shapes = {name: Tally.over(name, some) for name, some in textures.items()}
    named = {
        name: Tally.over(name, some, naming[name]) for name, some in textures.items()
    }
    text = [
        "The prediction is the object, whatever its texture: "
        f"{Tally.over('', rows).told('so')}."
    ]
    if asked := [name for name in textures if options.classes.get(name)]:
        flags = pd.concat([naming[name] for name in asked])
        total = Tally.over("", rows.loc[flags.index], flags)
        text.append(
            f"The prediction names the texture ({', '.join(asked)}): "
            f"{total.told('so')}."
        )
        text += (
            []
            if total.share
            else ["A model that has no class for a texture cannot name it."]
        )
    text.append(_which(predicted(rows, options)))
    text += rates.extremes(
        list(shapes.values()), "The hardest texture", "the easiest", "textures"
    )

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        ordered = sorted(shapes, key=lambda name: shapes[name].share or 0.0)
        shape, texture = (
            [counts[name].share or 0.0 for name in ordered]
            for counts in (shapes, named)
        )
        axes.barh(
            ordered,
            shape,
            color=figures.BLUE,
            alpha=0.55,
            height=0.66,
            label="the object",
        )
        axes.barh(
            ordered,
            texture,
            left=shape,
            color=figures.RED,
            alpha=0.55,
            height=0.66,
            label="the texture",
        )
        for place, name in enumerate(ordered):
            axes.plot(
                shapes[name].interval(), [place, place], color="#1c1d20", linewidth=1.2
            )
        axes.set(
            xlabel="share of predictions; line: 95 % interval of the object's",
            xlim=(0.0, 1.0),
        )
        axes.grid(True, axis="x")
        figure.legend(loc="outside lower center", ncols=2, title="the prediction names")

    table = [[name, *shapes[name].cells, named[name].times] for name in textures]
    heads = [options.texture, "the object", *rates.COUNT, "the texture"]
    title = "Predictions by shape and by texture"
    return MadeFigure(
        title, text, heads, table, draw, (6.0, 1.7 + 0.27 * len(textures))
    )


def predicted(rows: Rows, options: CuesOptions) -> list[tuple[int, int, int]]:
    """Foretell the predictions about each object with each texture by those about it
    with others, and with others by it; return of each pair how many predictions there
    are, and how many of them the shape and the texture foretell. A cue predicts the
    most frequent one of as many predictions: those about the same object with other
    textures, and about the same texture on other objects, drawn so that both are as
    many as the fewer are. None of the predicted predictions is among them, so that a
    model which goes by neither cue is predicted as well by both.
    """
    generator = random.Random(SEED)
    counts = []
    groups = rows.groupby(
        [rates.column(rows, options.shape), rates.column(rows, options.texture)],
        sort=False,
    )
    pairs = {pair: list(some[rates.PREDICTION]) for pair, some in groups}
    for (shape, texture), given in pairs.items():
        same_shape = [
            label
            for (s, t), more in pairs.items()
            if s == shape and t != texture
            for label in more
        ]
        same_texture = [
            label
            for (s, t), more in pairs.items()
            if t == texture and s != shape
            for label in more
        ]
        if drawn := min(len(same_shape), len(same_texture)):
            cues = (
                rates.most_frequent(generator.sample(cue, drawn))[0][0]
                for cue in (same_shape, same_texture)
            )
            by_shape, by_texture = map(given.count, cues)
            counts.append((len(given), by_shape, by_texture))
    return counts


def _which(pairs: Sequence[tuple[int, int, int]]) -> str:
    """By how much more the shape predicts than the texture, both of the same
    predictions. Predictions about one pair go together: the interval is a percentile
    bootstrap over pairs.
    """
    if len(pairs) < FEWEST_PAIRS:
        return (
            "Whether the predictions go more by shape or by texture is not said: that "
            "takes at least two objects and "
            f"two textures, {FEWEST_PAIRS} pairs in all."
        )

    def ahead(some: Sequence[tuple[int, int, int]]) -> float:
        return (
            100
            * sum(shape - texture for _, shape, texture in some)
            / sum(given for given, _, _ in some)
        )

    generator = random.Random(SEED)
    outside = round(RESAMPLES * 0.025)
    drawn = sorted(
        ahead(generator.choices(pairs, k=len(pairs))) for _ in range(RESAMPLES)
    )
    low = drawn[outside]
    high = drawn[-1 - outside]
    total, shape, texture = map(sum, zip(*pairs, strict=True))
    cue = (
        "shape than by texture"
        if low > 0.0
        else "texture than by shape"
        if high < 0.0
        else ""
    )
    verdict = f"the model goes more by {cue}" if cue else "no difference is shown"
    by_shape, by_texture = (
        wording.percent(foretold / total) for foretold in (shape, texture)
    )
    return (
        "The most frequent prediction about the same object with other textures is "
        f"given in {by_shape}, "
        "and that about the same texture on other objects, of as many predictions, in "
        f"{by_texture}: "
        f"{ahead(pairs):.0f} points more by shape (95 % interval {low:.0f} to "
        f"{high:.0f}, over pairs of object and "
        f"texture): {verdict}."
    )


# ---- mixtures
# -------------------------------------------------------------------------------------------------------

Doubles = npt.NDArray[np.float64]
Shares = tuple[float, float, float]
# how far along the first and the second share it is, and whether it points down
Triangle = tuple[int, int, bool]
MEANINGLESS = (
    "The prediction is {} in every picture, so that shares of predictions tell "
    "nothing. Colours are how far the right "
    "prediction leads the best wrong one: the margin, in logits for a classifier."
)


class TernaryOptions(Options):
    """Options of ternary diagrams of three shares. Of normalised ones the colours of
    each prediction end at its own largest share, and those of leads begin at the
    smallest; `side` is triangles along a side.
    """

    shares: tuple[str, str, str]
    normalised: bool = False
    most: int = Field(default=3, ge=1, le=6)
    side: int = Field(default=5, ge=1, le=20)


def ternary(rows: Rows, options: TernaryOptions) -> MadeFigure:
    """Count where in a mixture each prediction is given; where all are the same, how
    far the right one leads.
    """
    amounts = np.stack([rates.numbers(rows, name) for name in options.shares], axis=1)
    sums = amounts.sum(axis=1, keepdims=True)
    names = [rates.bare(name) for name in options.shares]
    mixtures = amounts / np.where(sums == 0.0, 1.0, sums)
    most = mixtures.argmax(axis=1)  # of what most of each mixture is
    corners = all_triangles(options.side)
    places = pd.Series([triangle_of(mixture, options.side) for mixture in mixtures])
    inside = [(places == triangle).to_numpy() for triangle in corners]
    given = rates.most_frequent(rows[rates.PREDICTION])
    lead = rows["margin"].astype(float).to_numpy()
    leads = {
        name: lead[(most == number) & ~np.isnan(lead)]
        for number, name in enumerate(names)
    }
    by_lead = len(given) == 1 and min(map(len, leads.values())) >= 2
    text = list[str]()
    table = list[list[rates.Cell]]()
    panels = dict[str, list[float | None]]()
    heads = ["prediction", "where most is", "given in", *rates.COUNT]
    if by_lead:
        text = [MEANINGLESS.format(given[0][0]), _told_leads(leads)]
        heads = [
            "where most is",
            "pictures",
            "mean lead of the right label",
            "standard error",
        ]
        table = [
            [name, len(values), float(values.mean()), _error(values)]
            for name, values in leads.items()
        ]
    for label, times in given[: options.most]:
        flags = (rows[rates.PREDICTION] == label).to_numpy()
        values = lead if by_lead else flags
        known = [values[here & ~np.isnan(values)] for here in inside]
        panels[label] = [float(some.mean()) if len(some) else None for some in known]
        if by_lead:
            break
        by_most = [
            Tally.over(name, rows[most == k], flags[most == k])
            for k, name in enumerate(names)
        ]
        whose = f"{label}, {wording.percent(times / len(rows))} of all predictions, is"
        if len({tally.share for tally in by_most if tally.total}) == 1:
            text.append(
                f"{whose} given as often whatever most of the mixture is: no "
                "difference is shown."
            )
        else:
            least = f"{whose} rarest where most of the mixture"
            most_often = "most frequent where most of it"
            text += rates.extremes(by_most, least, most_often, "ingredients", "given")
        table += [[label, tally.name, *tally.cells] for tally in by_most]
    if empty := sum(not here.any() for here in inside):
        text.append(
            f"No picture was drawn in {empty} of {len(corners)} parts of the "
            "diagram, which are hatched."
        )

    def draw(figure: Any) -> None:
        each = figure.subplots(1, len(panels), squeeze=False)[0]
        label = "mean lead of the right label" if by_lead else "share of predictions"
        for axes, (label, values) in zip(each, panels.items(), strict=True):
            colours = _panel(axes, label, values, list(corners.values()), names)
            known = [value for value in values if value is not None]
            low = min(known) if options.normalised and by_lead else min([*known, 0.0])
            colours.set_clim(
                low, max([*known, 1e-9]) if options.normalised or by_lead else 1.0
            )
            if options.normalised:
                figure.colorbar(
                    colours, ax=axes, shrink=0.7, location="bottom", label=label
                )
        if not options.normalised:
            figure.colorbar(
                colours,
                ax=list(each),
                shrink=0.7 / len(each),
                location="bottom",
                label=label,
            )

    title = f"Predictions over {', '.join(names)}"
    return MadeFigure(
        title, text, heads, table, draw, (max(2.4 * len(panels), 4.8), 3.5)
    )


def triangle_of(mixture: Sequence[float], side: int) -> Triangle:
    """Return the triangle that three shares (3,) lie in, of a diagram with so many
    along a side.
    """
    a, b, c = (int(share * side) for share in mixture)
    while a + b + c >= side:  # where triangles meet
        a, b, c = (
            (a - 1, b, c)
            if a >= max(b, c)
            else (a, b - 1, c)
            if b >= c
            else (a, b, c - 1)
        )
    return a, b, a + b + c < side - 1


def all_triangles(side: int) -> dict[Triangle, tuple[Shares, Shares, Shares]]:
    """Return every triangle of the diagram with the shares at its corners."""

    def at(x: int, y: int) -> Shares:
        return x / side, y / side, (side - x - y) / side

    corners = {}
    for a in range(side):
        for b in range(side - a):
            corners[a, b, False] = at(a, b), at(a + 1, b), at(a, b + 1)
            if a + b < side - 1:
                corners[a, b, True] = at(a + 1, b + 1), at(a, b + 1), at(a + 1, b)
    return corners


def _told_leads(leads: Mapping[str, Doubles]) -> str:
    """The smallest mean lead beside the largest, by normal intervals widened for a
    choice among all.
    """
    least, most = (
        pick(leads, key=lambda name: leads[name].mean()) for pick in (min, max)
    )
    usual, wide = (
        NormalDist().inv_cdf(
            1.0 - (1.0 - statistics.intervals.CONFIDENCE) / (2.0 * among)
        )
        for among in (1, len(leads))
    )

    def ends(name: str, deviations: float) -> tuple[float, float]:
        mean = leads[name].mean()
        half = deviations * _error(leads[name])
        return mean - half, mean + half

    told = [
        f"{name}: {leads[name].mean():.3g} (95 % interval {low:.3g} to {high:.3g}, "
        f"{len(leads[name])} pictures)"
        for name, (low, high) in ((name, ends(name, usual)) for name in (least, most))
    ]
    shown = ends(least, wide)[1] < ends(most, wide)[0]
    verdict = (
        "The difference is shown: {} do not overlap"
        if shown
        else "No difference is shown: {} overlap"
    )
    widened = f"their intervals, widened for having been chosen among {len(leads)},"
    return (
        f"It leads least where most of the mixture is {told[0]}; most where most of it "
        f"is {told[1]}. "
        f"{verdict.format(widened)}."
    )


def _error(values: Doubles) -> float:
    return float(values.std(ddof=1)) / math.sqrt(len(values))


def _panel(
    axes: Any,
    label: str,
    values: Sequence[float | None],
    corners: Sequence[Sequence[Shares]],
    names: Sequence[str],
) -> Any:
    from matplotlib.collections import PolyCollection  # matplotlib takes half a second

    # the first share at the left, the third at the top
    def place(shares: Shares) -> tuple[float, float]:
        return shares[1] + shares[2] / 2.0, shares[2] * math.sqrt(3.0) / 2.0

    known = list[Any]()
    empty = list[Any]()
    for three, value in zip(corners, values, strict=True):
        (empty if value is None else known).append([place(corner) for corner in three])
    coloured = PolyCollection(
        known,
        array=[value for value in values if value is not None],
        cmap="viridis",
        edgecolors="face",
    )
    axes.add_collection(coloured)
    axes.add_collection(
        PolyCollection(
            empty, facecolors="#eeeeef", edgecolors="#b9bbc0", hatch="////", linewidth=0
        )
    )
    outer = [
        place(corner) for corner in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    ]
    axes.plot(*zip(*outer, outer[0], strict=True), color="#1c1d20", linewidth=0.8)
    for (x, y), name in zip(outer, names, strict=True):
        away, side = (-4, "top") if y < 0.1 else (4, "bottom")
        axes.annotate(
            name,
            (x, y),
            (0, away),
            textcoords="offset points",
            ha="center",
            va=side,
            fontsize=8,
        )
    axes.set_title(label, fontsize=9, loc="center", pad=14)
    axes.set(xlim=(-0.12, 1.12), ylim=(-0.14, 1.0), aspect="equal")
    axes.axis("off")
    return coloured
