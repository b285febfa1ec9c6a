"""Figures of predictions: the most frequent, by shape or texture, over mixtures."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from pydantic import Field

from advsearch.extend import figures, statistics, wording
from advsearch.questions.recipe import rates
from advsearch.questions.recipe.rates import (
    ClusteredFraction,
    FigureContent,
    Options,
    Rows,
)

# number of characters that fit into a bar of the full width
MAX_LETTERS = 85
# minimum number of characters of a shortened name
MIN_LETTERS = 4
# height of a stacked bar as a fraction of the distance between bars
STACKED_BAR_HEIGHT = 0.72

# how often a prediction is given, and how many of these predictions are right
PredictionCount = tuple[ClusteredFraction, int]


class PredictionsOptions(Options):
    """Options of the most frequent predictions: the column that they are counted by
    (`by`), and the maximum number for each of its values (`most`).
    """

    by: str
    most: int = Field(default=4, ge=1, le=10)


def make_predictions_figure(rows: Rows, options: PredictionsOptions) -> FigureContent:
    """Make a figure of the most frequent predictions by the values of a column.

    Args:
        rows: rows of the parts that the figure shows.
        options: the column, and the number of predictions for each of its values.
    """
    groups = {
        value: _count_frequent(group_rows, options.most)
        for value, group_rows in rates.split_rows(rows, options.by).items()
    }
    return FigureContent(
        title=f"Most frequent predictions by {options.by}",
        text=_describe_predictions(groups, rates.pluralize_column(options.by)),
        columns=[options.by, "prediction", "given in", *rates.FRACTION_HEADS, "right"],
        rows=_tabulate_predictions(groups),
        draw=lambda figure: _draw_predictions(figure, groups),
        size=(6.4, 1.2 + 0.3 * len(groups)),
    )


def _tabulate_predictions(
    groups: Mapping[str, Sequence[PredictionCount]],
) -> list[list[rates.Cell]]:
    """Return a table row of each group's frequent predictions, with how many are right.

    `groups` has the predictions of each group with their counts.
    """
    return [
        [value, tally.name, *tally.table_cells, n_right]
        for value, counts in groups.items()
        for tally, n_right in counts
    ]


def _count_frequent(rows: Rows, most: int) -> list[PredictionCount]:
    """Count the most frequent predictions of some rows, and how many are right.

    Args:
        rows: rows of one group.
        most: maximum number of predictions.
    """
    counts = list[PredictionCount]()
    ranking = rates.rank_predictions(rows[rates.PREDICTION_COLUMN])
    for label, _ in ranking[:most]:
        has_label = rows[rates.PREDICTION_COLUMN] == label
        tally = ClusteredFraction.from_rows(label, rows, has_label)
        n_right = int(rows[has_label]["correct"].sum())
        counts.append((tally, n_right))
    return counts


def _draw_predictions(
    figure: Any, groups: Mapping[str, Sequence[PredictionCount]]
) -> None:
    """Draw a stacked bar of predictions for each value of the column."""
    axes = figure.subplots()
    for position, counts in enumerate(groups.values()):
        _draw_stacked_bar(axes, position, counts)
    axes.set_yticks(range(len(groups)), list(groups))
    axes.invert_yaxis()
    # `_draw_stacked_bar` chooses the colors.
    axes.set(
        xlabel="share of predictions; blue: mostly right, red: mostly wrong, "
        "grey: others",
        xlim=(0.0, 1.0),
    )


def _describe_predictions(
    groups: Mapping[str, Sequence[PredictionCount]], things: str
) -> list[str]:
    """Describe for how many groups the most frequent prediction is mostly right.

    Each group for which it is mostly wrong has a sentence of its own.

    Args:
        groups: for each group the predictions, the most frequent first, each with its
            fraction and how often it is right.
        things: plural of what the groups are.
    """
    # the first prediction of each group is the most frequent one
    sentences = [
        _describe_mostly_wrong(value, counts[0])
        for value, counts in groups.items()
        if not _is_mostly_right(counts[0])
    ]
    n_mostly_right = len(groups) - len(sentences)
    overview = (
        f"For {n_mostly_right} of {len(groups)} {things} the most frequent prediction "
        "is mostly a right one."
    )
    return [overview, *sentences]


def _describe_mostly_wrong(group: str, count: PredictionCount) -> str:
    """Describe how often a group's most frequent prediction is given, and is right."""
    tally, n_right = count
    return (
        f"For {group} it is {tally.name}, {tally.describe('given')} and right in "
        f"{n_right} of these."
    )


def _is_mostly_right(count: PredictionCount) -> bool:
    """Return whether a prediction is right in at least half of its cases."""
    tally, n_right = count
    return 2 * n_right >= tally.n_counted


def _draw_stacked_bar(
    axes: Any, position: int, counts: Sequence[PredictionCount]
) -> None:
    """Draw the most frequent predictions of a group in a row, all others in gray.

    A prediction is blue if it is right in at least half of its cases, else red.

    Args:
        axes: axes of matplotlib.
        position: position of the bar on the vertical axis.
        counts: fraction of each prediction, and how often it is right.
    """
    left = 0.0
    for count in counts:
        left += _draw_share(axes, position, left, count)
    other_share = max(1.0 - left, 0.0)  # not below 0 by rounding
    style = {"color": figures.GREY, "alpha": 0.15, "height": STACKED_BAR_HEIGHT}
    axes.barh(position, other_share, left=left, **style)


def _draw_share(axes: Any, position: int, left: float, count: PredictionCount) -> float:
    """Draw one prediction as a part of a stacked bar, and return its share of the bar.

    Args:
        axes: axes of matplotlib.
        position: position of the bar on the vertical axis.
        left: end of the part before it.
        count: fraction of the prediction, and how often it is right.
    """
    tally, _ = count
    share = tally.fraction or 0.0
    color = figures.BLUE if _is_mostly_right(count) else figures.RED
    style = {"alpha": 0.5, "height": STACKED_BAR_HEIGHT, "edgecolor": "white"}
    axes.barh(position, share, left=left, color=color, **style)
    center = left + share / 2
    name = shorten_to_fit(tally.name, share)
    axes.text(center, position, name, ha="center", va="center", fontsize=7)
    return share


def shorten_to_fit(name: str, fraction: float) -> str:
    """Shorten a prediction's name to what fits into its bar.

    That is the full name, the first of several names, the beginning of the first name,
    or nothing.
    """
    room = int(fraction * MAX_LETTERS)
    first_name = name.partition(",")[0]
    for text in (name, first_name):
        if len(text) <= room:
            return text
    if room > MIN_LETTERS:
        return f"{first_name[: room - 1].rstrip()}…"
    return ""


# ---- shape and texture

# seed of the samples of labels, and of the bootstrap
SEED = 0
RESAMPLES = 2000
# minimum number of pairs of object and texture: two of each
MIN_PAIRS = 4
TOO_FEW_PAIRS = (
    "Whether the predictions go more by shape or by texture is not said: that takes at "
    f"least two objects and two textures, {MIN_PAIRS} pairs in all."
)


class CuesOptions(Options):
    """Options of a figure of cues: the columns of texture and shape, and the classes
    that name each texture.
    """

    texture: str = "material.which"
    shape: str = "object"
    classes: dict[str, list[str]] = Field(default_factory=dict)


def make_cues_figure(rows: Rows, options: CuesOptions) -> FigureContent:
    """Make a figure of how often the prediction is the object or its texture.

    Its sentences also state whether the predictions depend more on the shape or on the
    texture.

    Args:
        rows: rows with object and texture.
        options: the columns of both, and the classes that name each texture.
    """
    rows_of_texture = rates.split_rows(rows, options.texture)
    # for each texture, whether each of its predictions (n,) names it
    names_texture = {
        texture: _names_class(
            texture_rows[rates.PREDICTION_COLUMN], options.classes.get(texture, ())
        )
        for texture, texture_rows in rows_of_texture.items()
    }
    by_shape = _count_named(rows_of_texture)  # a right prediction names the object
    by_texture = _count_named(rows_of_texture, names_texture)
    return FigureContent(
        title="Predictions by shape and by texture",
        text=_describe_cues(rows, names_texture, by_shape, options),
        columns=[options.texture, "the object", *rates.FRACTION_HEADS, "the texture"],
        rows=_tabulate_cues(by_shape, by_texture),
        draw=lambda figure: _draw_cues(figure, by_shape, by_texture),
        size=(6.0, 1.7 + 0.27 * len(by_shape)),
    )


def _count_named(
    rows_of_texture: Mapping[str, Rows], flags: Mapping[str, Any] | None = None
) -> dict[str, ClusteredFraction]:
    """Count for each texture how many of its rows are right, or have a flag.

    Args:
        rows_of_texture: the rows of each texture.
        flags: for each texture, whether each of its rows (n,) is counted; None counts
            the right ones.
    """
    return {
        texture: ClusteredFraction.from_rows(
            texture, texture_rows, None if flags is None else flags[texture]
        )
        for texture, texture_rows in rows_of_texture.items()
    }


def _describe_cues(
    rows: Rows,
    names_texture: Mapping[str, Any],
    by_shape: Mapping[str, ClusteredFraction],
    options: CuesOptions,
) -> list[str]:
    """Describe how far the predictions depend on the shape, and how far on the texture.

    Args:
        rows: rows with object and texture.
        names_texture: for each texture, whether the prediction of each of its rows
            (n,) names it.
        by_shape: for each texture, how often the prediction names the object.
        options: options of the figure.
    """
    text = _describe_named(rows, names_texture, options)
    text.append(_compare_cues(count_predicted(rows, options)))
    text += rates.describe_extremes(
        list(by_shape.values()), "The hardest texture", "the easiest", "textures"
    )
    return text


def _tabulate_cues(
    by_shape: Mapping[str, ClusteredFraction],
    by_texture: Mapping[str, ClusteredFraction],
) -> list[list[rates.Cell]]:
    """Return a table row of each texture: how often the object and it are named."""
    return [
        [name, *by_shape[name].table_cells, by_texture[name].n_counted]
        for name in by_shape
    ]


def _describe_named(
    rows: Rows, names_texture: Mapping[str, Any], options: CuesOptions
) -> list[str]:
    """Describe how often predictions name the object, and how often its texture.

    Args:
        rows: rows with object and texture.
        names_texture: for each texture, whether the prediction of each of its rows
            (n,) names it.
        options: options of the figure. Its `classes` are the names of textures that a
            prediction can have; a texture without any cannot be named.
    """
    text = [
        "The prediction is the object, whatever its texture: "
        f"{ClusteredFraction.from_rows('', rows).describe('so')}."
    ]
    with_classes = [name for name in names_texture if options.classes.get(name)]
    if with_classes:
        flags = [names_texture[name] for name in with_classes]
        text += _describe_named_textures(rows, with_classes, flags)
    return text


def _describe_named_textures(
    rows: Rows, textures: Sequence[str], flags: Sequence[Any]
) -> list[str]:
    """Describe how often predictions name the texture, if it has a class.

    Args:
        rows: rows with object and texture.
        textures: names of the textures that have classes.
        flags: for each of them, whether the prediction of each of its rows (n,) names
            it.
    """
    # The index of the flags is that of their rows in `rows`, where it is unique.
    all_flags = pd.concat(flags)
    total = ClusteredFraction.from_rows("", rows.loc[all_flags.index], all_flags)
    text = [
        f"The prediction names the texture ({', '.join(textures)}): "
        f"{total.describe('so')}."
    ]
    if not total.fraction:
        text.append("A model that has no class for a texture cannot name it.")
    return text


def _names_class(predictions: Any, classes: Sequence[str]) -> Any:
    """Return a flag for each prediction (n,): whether it names one of the classes.

    A label may be a list of synonyms, such as "cup, mug". It names a class if the full
    label is the class, or if one of the synonyms is.
    """
    names = predictions.map(
        lambda label: {label.strip(), *map(str.strip, label.split(","))}
    )
    names_none = names.map(set(classes).isdisjoint)
    return ~names_none


def _draw_cues(
    figure: Any,
    by_shape: Mapping[str, ClusteredFraction],
    by_texture: Mapping[str, ClusteredFraction],
) -> None:
    """Draw for each texture how often predictions name the object, and the texture.

    Args:
        figure: figure of matplotlib.
        by_shape: for each texture, how often the prediction names the object.
        by_texture: for each texture, how often the prediction names the texture.
    """
    axes = figure.subplots()
    ordered = sorted(by_shape, key=lambda name: by_shape[name].fraction or 0.0)
    shape_tallies = [by_shape[name] for name in ordered]
    _draw_named(axes, ordered, shape_tallies, [by_texture[name] for name in ordered])
    _draw_intervals(axes, shape_tallies)
    x_label = "share of predictions; line: 95 % interval of the object's"
    axes.set(xlabel=x_label, xlim=(0.0, 1.0))
    axes.grid(True, axis="x")
    figure.legend(loc="outside lower center", ncols=2, title="the prediction names")


def _draw_named(
    axes: Any,
    textures: Sequence[str],
    shape_tallies: Sequence[ClusteredFraction],
    texture_tallies: Sequence[ClusteredFraction],
) -> None:
    """Draw a stacked bar of both fractions for each texture.

    Args:
        axes: axes of matplotlib.
        textures: names of the textures.
        shape_tallies: for each, how often the prediction names the object.
        texture_tallies: for each, how often the prediction names the texture.
    """
    shape_shares = [tally.fraction or 0.0 for tally in shape_tallies]
    texture_shares = [tally.fraction or 0.0 for tally in texture_tallies]
    style: dict[str, Any] = {"alpha": 0.55, "height": 0.66}
    axes.barh(textures, shape_shares, color=figures.BLUE, label="the object", **style)
    # The bars of the textures begin where those of the objects end.
    style |= {"left": shape_shares, "color": figures.RED}
    axes.barh(textures, texture_shares, label="the texture", **style)


def _draw_intervals(axes: Any, tallies: Sequence[ClusteredFraction]) -> None:
    """Draw the interval of each fraction as a line on its bar."""
    # The intervals are those of the bars of the object, which begin at 0.
    for position, tally in enumerate(tallies):
        axes.plot(
            tally.interval(), [position, position], color="#1c1d20", linewidth=1.2
        )


def count_predicted(rows: Rows, options: CuesOptions) -> list[tuple[int, int, int]]:
    """Count how often shape and texture foretell what the model predicts.

    For a pair of object and texture, the shape foretells the model's most frequent
    label for the same object with other textures. The texture foretells the most
    frequent label for the same texture on other objects. Neither set of labels has
    those of the pair itself, and the larger set is sampled to the size of the smaller
    one. So if the model uses neither cue, both foretell it equally well.

    Args:
        rows: predictions with object and texture.
        options: options of the figure, which name the columns of both.

    Returns:
        For each pair of object and texture: the number of predictions, those that the
        shape foretells, and those that the texture foretells.
    """
    generator = random.Random(SEED)
    labels_of_pair = _group_labels(rows, options)
    counts = list[tuple[int, int, int]]()
    for (shape, texture), labels in labels_of_pair.items():
        same_shape, same_texture = _collect_labels(labels_of_pair, shape, texture)
        n_samples = min(len(same_shape), len(same_texture))
        # 0 if the shape has no other texture, or the texture no other shape
        if n_samples > 0:
            by_shape = _sample_most_frequent(same_shape, n_samples, generator)
            by_texture = _sample_most_frequent(same_texture, n_samples, generator)
            counts.append(
                (len(labels), labels.count(by_shape), labels.count(by_texture))
            )
    return counts


def _group_labels(rows: Rows, options: CuesOptions) -> dict[Any, list[str]]:
    """Return the predictions by (object, texture)."""
    shapes = rates.get_column(rows, options.shape)
    textures = rates.get_column(rows, options.texture)
    groups = rows.groupby([shapes, textures], sort=False)
    return {
        pair: list(pair_rows[rates.PREDICTION_COLUMN]) for pair, pair_rows in groups
    }


def _collect_labels(
    labels_of_pair: Mapping[Any, Sequence[str]], shape: str, texture: str
) -> tuple[list[str], list[str]]:
    """Return the predictions about the same shape, and those about the same texture.

    The pair of this shape and this texture is in neither.

    Args:
        labels_of_pair: predictions by (shape, texture).
        shape: shape of the first predictions, with other textures.
        texture: texture of the second predictions, with other shapes.
    """
    same_shape = list[str]()
    same_texture = list[str]()
    for (other_shape, other_texture), other_labels in labels_of_pair.items():
        if other_shape == shape and other_texture != texture:
            same_shape += other_labels
        if other_texture == texture and other_shape != shape:
            same_texture += other_labels
    return same_shape, same_texture


def _sample_most_frequent(
    labels: Sequence[str], n_samples: int, generator: random.Random
) -> str:
    """Return the most frequent of the labels in a random sample."""
    ranking = rates.rank_predictions(generator.sample(labels, n_samples))
    most_frequent, _ = ranking[0]
    return most_frequent


def _compare_cues(pairs: Sequence[tuple[int, int, int]]) -> str:
    """Describe by how many percentage points the shape foretells predictions better.

    The predictions about one pair of object and texture are not independent. Therefore
    the interval is a percentile bootstrap over pairs.

    Args:
        pairs: counts of each pair of object and texture, from `count_predicted`.
    """
    if len(pairs) < MIN_PAIRS:
        return TOO_FEW_PAIRS
    lower, upper = _bootstrap_shape_advantage(pairs)
    total, n_by_shape, n_by_texture = map(sum, zip(*pairs, strict=True))
    return (
        "The most frequent prediction about the same object with other textures is "
        f"given in {wording.percent(n_by_shape / total)}, "
        "and that about the same texture on other objects, of as many predictions, in "
        f"{wording.percent(n_by_texture / total)}: "
        f"{_compute_shape_advantage(pairs):.0f} points more by shape "
        f"(95 % interval {lower:.0f} to {upper:.0f}, over pairs of object and "
        f"texture): {_judge_shape_advantage(lower, upper)}."
    )


def _bootstrap_shape_advantage(
    pairs: Sequence[tuple[int, int, int]],
) -> tuple[float, float]:
    """Return the 95 % interval of how much better the shape predicts, in points."""
    generator = random.Random(SEED)
    resampled = sorted(
        _compute_shape_advantage(generator.choices(pairs, k=len(pairs)))
        for _ in range(RESAMPLES)
    )
    # 2.5 % of the values at each end are outside of the interval.
    n_outside = round(RESAMPLES * 0.025)
    return resampled[n_outside], resampled[-1 - n_outside]


def _judge_shape_advantage(lower: float, upper: float) -> str:
    """Describe which cue the model uses more, by an interval of the difference."""
    if lower > 0.0:
        return "the model goes more by shape than by texture"
    if upper < 0.0:
        return "the model goes more by texture than by shape"
    return "no difference is shown"


def _compute_shape_advantage(pairs: Sequence[tuple[int, int, int]]) -> float:
    """Compute the percentage points by which the shape predicts better."""
    difference = sum(by_shape - by_texture for _, by_shape, by_texture in pairs)
    return 100 * difference / sum(total for total, _, _ in pairs)


# ---- mixtures

Float64Array = npt.NDArray[np.float64]
Mixture = tuple[float, float, float]
# (a, b, points_down): see `list_triangles`
Triangle = tuple[int, int, bool]
SINGLE_PREDICTION = (
    "The prediction is {} in every picture, so that shares of predictions tell "
    "nothing. Colours are how far the right "
    "prediction leads the best wrong one: the margin, in logits for a classifier."
)


class TernaryOptions(Options):
    """Options of ternary diagrams of three fractions.

    Attributes:
        shares: columns of the three ingredients.
        normalised: whether the colors of each diagram end at its largest value; the
            colors of margins then begin at the smallest value.
        most: maximum number of predictions, each with a diagram.
        side: number of triangles along a side of the diagram.
    """

    shares: tuple[str, str, str]
    normalised: bool = False
    most: int = Field(default=3, ge=1, le=6)
    side: int = Field(default=5, ge=1, le=20)


def make_ternary_figure(rows: Rows, options: TernaryOptions) -> FigureContent:
    """Make a figure of where in a mixture each prediction is frequent.

    A mixture has three ingredients, whose fractions add up to 1. It is a point in a
    triangle, which is divided into small triangles. If all predictions are the same,
    and there are enough margins, the figure shows the margin of the right label
    instead.

    Args:
        rows: rows of one mixture each.
        options: the columns of the ingredients, and how the figure is drawn.
    """
    mixtures = _read_mixtures(rows, options)
    names = [rates.strip_control(name) for name in options.shares]
    main_ingredient = mixtures.argmax(axis=1)  # (n,)
    corners_of_triangle = list_triangles(options.side)
    in_triangle = _split_by_triangle(options, mixtures, list(corners_of_triangle))

    all_predictions = rates.rank_predictions(rows[rates.PREDICTION_COLUMN])
    margins = _group_margins(rows, names, main_ingredient)
    by_margin = _shows_margins(all_predictions, margins)
    ranking = all_predictions[: options.most]
    text, heads, table = _describe_mixtures(
        rows, ranking, names, main_ingredient, margins if by_margin else None
    )
    diagrams = _TernaryDiagrams(
        panels=_make_panels(rows, ranking, by_margin, in_triangle),
        corners=list(corners_of_triangle.values()),
        names=names,
        by_margin=by_margin,
        normalised=options.normalised,
    )
    return FigureContent(
        title=f"Predictions over {', '.join(names)}",
        text=text + _describe_empty(in_triangle),
        columns=heads,
        rows=table,
        draw=diagrams.draw,
        size=(max(2.4 * len(diagrams.panels), 4.8), 3.5),
    )


def _describe_mixtures(
    rows: Rows,
    ranking: Sequence[tuple[str, int]],
    names: Sequence[str],
    main_ingredient: npt.NDArray[np.intp],
    margins: Mapping[str, Float64Array] | None,
) -> tuple[list[str], list[str], list[list[rates.Cell]]]:
    """Describe predictions, or the margins of a single one, by the main ingredient.

    Args:
        rows: rows of one mixture each.
        ranking: the predictions with their counts, the most frequent first.
        names: names of the ingredients.
        main_ingredient: (n,) index of the largest ingredient in each row.
        margins: margins by the main ingredient; None to describe predictions.

    Returns:
        Sentences, and the heads and rows of a table.
    """
    if margins is None:
        return _describe_ingredients(rows, ranking, names, main_ingredient)
    # The ranking has a single label, with its count.
    label, _ = ranking[0]
    return _describe_margins(label, margins)


def _shows_margins(
    ranking: Sequence[tuple[str, int]], margins: Mapping[str, Float64Array]
) -> bool:
    """Return whether a figure shows margins, since all predictions are the same.

    Args:
        ranking: the predictions with their counts.
        margins: the known margins of the mixtures, by their main ingredient.
    """
    has_single_prediction = len(ranking) == 1
    # The interval of a mean needs two values for each ingredient.
    return has_single_prediction and min(map(len, margins.values())) >= 2


def _split_by_triangle(
    options: TernaryOptions,
    mixtures: npt.NDArray[np.float64],
    triangles: Sequence[Triangle],
) -> list[npt.NDArray[np.bool_]]:
    """Return for each triangle of the diagram which mixtures (n,) lie in it."""
    triangle_of_mixture = [find_triangle(mixture, options.side) for mixture in mixtures]
    return [
        np.array([other == triangle for other in triangle_of_mixture], dtype=bool)
        for triangle in triangles
    ]


def _make_panels(
    rows: Rows,
    ranking: Sequence[tuple[str, int]],
    by_margin: bool,
    in_triangle: Sequence[npt.NDArray[np.bool_]],
) -> dict[str, list[float | None]]:
    """Return the value of each triangle in the diagram of each prediction.

    The value is the fraction of the mixtures in the triangle that have this prediction;
    with `by_margin` it is their mean margin. It is None if no mixture lies there.

    Args:
        rows: rows of one mixture each.
        ranking: the predictions with their counts.
        by_margin: whether margins are shown; then there is a single prediction.
        in_triangle: for each triangle, which rows (n,) lie in it.
    """
    panels = dict[str, list[float | None]]()
    for label, _ in ranking:
        values = (rows[rates.PREDICTION_COLUMN] == label).to_numpy()
        if by_margin:
            values = rows["margin"].astype(float).to_numpy()
        panels[label] = _compute_triangle_means(values, in_triangle)
    return panels


def _describe_empty(
    in_triangle: Sequence[npt.NDArray[np.bool_]],
) -> list[str]:
    """Describe how many triangles have no mixture; empty if all have one.

    Args:
        in_triangle: for each triangle, which mixtures (n,) lie in it.
    """
    text = list[str]()
    n_empty = sum(not is_inside.any() for is_inside in in_triangle)
    if n_empty:
        text.append(
            f"No picture was drawn in {n_empty} of {len(in_triangle)} parts of the "
            "diagram, which are hatched."
        )
    return text


def _read_mixtures(rows: Rows, options: TernaryOptions) -> Float64Array:
    """Return the amounts of three ingredients (n, 3), divided by their sum."""
    amounts = np.stack(
        [rates.get_numeric_column(rows, name) for name in options.shares], axis=1
    )
    total = amounts.sum(axis=1, keepdims=True)
    # no division by 0 without any of the ingredients
    return amounts / np.where(total == 0.0, 1.0, total)


def _group_margins(
    rows: Rows, names: Sequence[str], main_ingredient: npt.NDArray[np.intp]
) -> dict[str, Float64Array]:
    """Return the known margins of the mixtures in which each ingredient is largest.

    Args:
        rows: rows of one mixture each.
        names: names of the ingredients.
        main_ingredient: (n,) index of the largest ingredient in each row.

    Returns:
        The margins by the name of the ingredient.
    """
    margin = rows["margin"].astype(float).to_numpy()
    is_known = ~np.isnan(margin)
    return {
        name: margin[(main_ingredient == index) & is_known]
        for index, name in enumerate(names)
    }


def _compute_triangle_means(
    values: npt.NDArray[Any], in_triangle: Sequence[npt.NDArray[np.bool_]]
) -> list[float | None]:
    """Compute the mean of the known values in each triangle; None if there are none.

    Args:
        values: (n,) values of the mixtures; NaN if unknown.
        in_triangle: for each triangle, which mixtures (n,) lie in it.
    """
    means = list[float | None]()
    for is_inside in in_triangle:
        known = values[is_inside & ~np.isnan(values)]
        mean = float(known.mean()) if len(known) else None
        means.append(mean)
    return means


def _describe_margins(
    label: str, margins: Mapping[str, Float64Array]
) -> tuple[list[str], list[str], list[list[rates.Cell]]]:
    """Describe the margins of a single prediction by the main ingredient.

    Args:
        label: the only prediction.
        margins: margins of the mixtures in which each ingredient is the largest, by its
            name.

    Returns:
        Sentences, and the heads and rows of a table.
    """
    text = [SINGLE_PREDICTION.format(label), _compare_margins(margins)]
    table: list[list[rates.Cell]] = [
        [name, len(values), float(values.mean()), _compute_standard_error(values)]
        for name, values in margins.items()
    ]
    return text, MARGIN_HEADS, table


MARGIN_HEADS = [
    "where most is",
    "pictures",
    "mean lead of the right label",
    "standard error",
]
"""Heads of the table of margins by the main ingredient."""


def _describe_ingredients(
    rows: Rows,
    ranking: Sequence[tuple[str, int]],
    names: Sequence[str],
    main_ingredient: npt.NDArray[np.intp],
) -> tuple[list[str], list[str], list[list[rates.Cell]]]:
    """Describe how often each label is predicted, by the main ingredient.

    Args:
        rows: rows of one mixture each.
        ranking: the predictions with their counts, the most frequent first.
        names: names of the ingredients.
        main_ingredient: (n,) index of the largest ingredient in each row.

    Returns:
        Sentences, and the heads and rows of a table.
    """
    text = list[str]()
    table = list[list[rates.Cell]]()
    heads = ["prediction", "where most is", "given in", *rates.FRACTION_HEADS]
    for label, n_predictions in ranking:
        is_label = (rows[rates.PREDICTION_COLUMN] == label).to_numpy()
        tallies = _count_by_ingredient(rows, is_label, names, main_ingredient)
        share = wording.percent(n_predictions / len(rows))
        # A sentence begins: "mug, 12 % of all predictions, is rarest where ...".
        text += _compare_ingredients(
            tallies, f"{label}, {share} of all predictions, is"
        )
        table += [[label, tally.name, *tally.table_cells] for tally in tallies]
    return text, heads, table


def _count_by_ingredient(
    rows: Rows,
    is_label: npt.NDArray[np.bool_],
    names: Sequence[str],
    main_ingredient: npt.NDArray[np.intp],
) -> list[ClusteredFraction]:
    """Count for each ingredient how often a label is predicted if it is the largest.

    Args:
        rows: rows of one mixture each.
        is_label: (n,) whether the prediction of each row is the label.
        names: names of the ingredients.
        main_ingredient: (n,) index of the largest ingredient in each row.
    """
    tallies = []
    for index, name in enumerate(names):
        is_main = main_ingredient == index
        tallies.append(
            ClusteredFraction.from_rows(name, rows[is_main], is_label[is_main])
        )
    return tallies


def _compare_ingredients(
    tallies: Sequence[ClusteredFraction], beginning: str
) -> list[str]:
    """Describe with which main ingredient a label is rarest, and with which it is not.

    Args:
        tallies: how often it is predicted with each main ingredient.
        beginning: the first words of the sentence.
    """
    known_fractions = {tally.fraction for tally in tallies if tally.total}
    if len(known_fractions) == 1:
        same = "given as often whatever most of the mixture is: no difference is shown"
        return [f"{beginning} {same}."]
    return rates.describe_extremes(
        tallies,
        lowest_prefix=f"{beginning} rarest where most of the mixture",
        highest_prefix="most frequent where most of it",
        things="ingredients",
        verb="given",
    )


@dataclass(frozen=True)
class _TernaryDiagrams:
    """Ternary diagrams of several predictions, with one or several color bars.

    All diagrams have the same colors and share a color bar, unless they are normalised.

    Attributes:
        panels: the value of each triangle, by prediction.
        corners: mixtures at the corners of the triangles.
        names: names of the ingredients.
        by_margin: whether values are margins, not fractions.
        normalised: whether each diagram has its own colors and its own color bar.
    """

    panels: Mapping[str, Sequence[float | None]]
    corners: Sequence[Sequence[Mixture]]
    names: Sequence[str]
    by_margin: bool
    normalised: bool

    def draw(self, figure: Any) -> None:
        """Draw the diagrams in a row on a figure of matplotlib."""
        all_axes = figure.subplots(1, len(self.panels), squeeze=False)[0]
        for axes, (label, values) in zip(all_axes, self.panels.items(), strict=True):
            triangles = self._draw_diagram(axes, label, values)
            if self.normalised:
                figure.colorbar(
                    triangles, ax=axes, shrink=0.7, location="bottom", label=label
                )
        if not self.normalised:
            # All diagrams have the colors of the last one: fractions have the range 0
            # to 1, and of margins there is only one diagram.
            self._draw_color_bar(figure, triangles, list(all_axes))

    def _draw_diagram(
        self, axes: Any, label: str, values: Sequence[float | None]
    ) -> Any:
        """Draw the diagram of a prediction, and return its colored triangles."""
        triangles = _draw_panel(axes, label, values, self.corners, self.names)
        known = [value for value in values if value is not None]
        color_range = _choose_color_range(
            known, self.by_margin, normalised=self.normalised
        )
        triangles.set_clim(*color_range)
        return triangles

    def _draw_color_bar(
        self, figure: Any, triangles: Any, all_axes: Sequence[Any]
    ) -> None:
        """Draw the color bar that all diagrams share."""
        label = "lead of the right label" if self.by_margin else "share of predictions"
        figure.colorbar(
            triangles,
            ax=all_axes,
            shrink=0.7 / len(all_axes),
            location="bottom",
            label=label,
        )


def find_triangle(mixture: Sequence[float], side: int) -> Triangle:
    """Return the triangle of a ternary diagram that three fractions (3,) lie in.

    A triangle is (a, b, points_down): the first two fractions times `side`, rounded
    down, and whether it points down.

    Args:
        mixture: three fractions, whose sum is 1.
        side: number of triangles along a side of the diagram.
    """
    # The three fractions times `side` add up to `side`. Rounding them down takes 1 from
    # the sum in a triangle that points up, and 2 in one that points down. At a corner
    # of triangles it takes nothing.
    rounded = [int(fraction * side) for fraction in mixture]
    is_at_corner = sum(rounded) >= side
    if is_at_corner:
        # The corner belongs to several triangles: take the one in which the largest
        # fraction (the first of equal ones) is smaller.
        rounded[rounded.index(max(rounded))] -= 1
    points_down = sum(rounded) < side - 1
    a, b, _ = rounded
    return a, b, points_down


def list_triangles(side: int) -> dict[Triangle, tuple[Mixture, Mixture, Mixture]]:
    """Return the triangles of a ternary diagram with the mixtures at their corners.

    The key of a triangle is (a, b, points_down): the first two fractions of a mixture
    in it, times `side` and rounded down, and whether it points down. For each a and b
    there are two triangles that share an edge, except at the side of the diagram where
    the third fraction is near 0: there is only the one that points up.

    Args:
        side: number of triangles along a side of the diagram.
    """

    def mixture_at(x: int, y: int) -> Mixture:
        """Return the mixture whose first two fractions are x / side and y / side."""
        return x / side, y / side, (side - x - y) / side

    corners = {}
    for a in range(side):
        for b in range(side - a):
            # the ends of the edge that both triangles share
            right = mixture_at(a + 1, b)
            left = mixture_at(a, b + 1)
            corners[a, b, False] = (mixture_at(a, b), right, left)
            has_triangle_down = a + b < side - 1
            if has_triangle_down:
                corners[a, b, True] = (mixture_at(a + 1, b + 1), left, right)
    return corners


def _compare_margins(margins: Mapping[str, Float64Array]) -> str:
    """Describe for which ingredient the mean margin is smallest, and for which largest.

    The margin is by how much the right label leads the next one. The two ingredients
    were selected as extremes among all, so their intervals are widened (Bonferroni)
    before they are compared.

    Args:
        margins: margins of the mixtures in which each ingredient is the largest, by its
            name.

    Returns:
        A text with both means, their 95 % intervals and the verdict.
    """
    smallest = min(margins, key=lambda name: margins[name].mean())
    largest = max(margins, key=lambda name: margins[name].mean())
    least = _describe_mean_margin(smallest, margins[smallest])
    most = _describe_mean_margin(largest, margins[largest])
    verdict = _judge_margins(margins[smallest], margins[largest], len(margins))
    # "It" is the right label, which `_describe_margins` names in the sentence before.
    return (
        f"It leads least where most of the mixture is {least}; most where "
        f"most of it is {most}. {verdict}."
    )


def _judge_margins(
    smallest: Float64Array, largest: Float64Array, n_compared: int
) -> str:
    """Describe whether the mean margins (n,) of two ingredients differ.

    Their intervals are widened for a choice among `n_compared` ingredients.
    """
    widened = f"their intervals, widened for having been chosen among {n_compared},"
    _, upper_of_smallest = _compute_mean_interval(smallest, n_compared)
    lower_of_largest, _ = _compute_mean_interval(largest, n_compared)
    if upper_of_smallest < lower_of_largest:
        return f"The difference is shown: {widened} do not overlap"
    return f"No difference is shown: {widened} overlap"


def _describe_mean_margin(ingredient: str, margins: Float64Array) -> str:
    """Describe the mean margin (n,) of an ingredient with its 95 % interval."""
    # not widened: the interval of this mean alone
    lower, upper = _compute_mean_interval(margins)
    return (
        f"{ingredient}: {margins.mean():.3g} "
        f"(95 % interval {lower:.3g} to {upper:.3g}, {len(margins)} pictures)"
    )


def _compute_mean_interval(
    values: Float64Array, n_compared: int = 1
) -> tuple[float, float]:
    """Return the normal 95 % interval of the mean of values (n,).

    It is widened for a choice among `n_compared` means (Bonferroni).
    """
    # the probability on each of the two sides
    alpha = (1.0 - statistics.intervals.CONFIDENCE) / (2.0 * n_compared)
    half_width = NormalDist().inv_cdf(1.0 - alpha) * _compute_standard_error(values)
    mean = values.mean()
    return mean - half_width, mean + half_width


def _compute_standard_error(values: Float64Array) -> float:
    """Compute the standard error of the mean of values (n,)."""
    return float(values.std(ddof=1)) / math.sqrt(len(values))


def _choose_color_range(
    values: Sequence[float], by_margin: bool, *, normalised: bool
) -> tuple[float, float]:
    """Return the values of the first and the last color of a ternary diagram.

    Fractions have the range 0 to 1; normalised, 0 to the largest value. Margins have
    the range from 0, or the smallest value if that is negative, to the largest value;
    normalised, from the smallest value to the largest.

    Args:
        values: values of the triangles.
        by_margin: whether these are margins, not fractions.
        normalised: whether the range depends on the values.
    """
    lower = min([*values, 0.0])
    upper = 1.0
    if normalised and by_margin:
        lower = min(values)
    if normalised or by_margin:
        # The smallest bound is above 0, so that the range of fractions has a width.
        upper = max([*values, 1e-9])
    return lower, upper


def _draw_panel(
    axes: Any,
    label: str,
    values: Sequence[float | None],
    corners: Sequence[Sequence[Mixture]],
    names: Sequence[str],
) -> Any:
    """Draw a ternary diagram, and return its colored triangles for a color bar.

    The first ingredient is at the left corner, the second at the right one, the third
    at the top. Triangles without a value are hatched.

    Args:
        axes: axes of matplotlib.
        label: the prediction, which becomes the title.
        values: value of each triangle; None where no mixture lies.
        corners: the mixtures at the corners of each triangle.
        names: names of the three ingredients.
    """
    triangles = _draw_triangles(axes, values, corners)
    _draw_outline(axes, names)
    axes.set_title(label, fontsize=9, loc="center", pad=14)
    # room for the names of the ingredients around the triangle
    axes.set(xlim=(-0.12, 1.12), ylim=(-0.14, 1.0), aspect="equal")
    axes.axis("off")
    return triangles


HATCHED_STYLE: Mapping[str, Any] = {
    "facecolors": "#eeeeef",
    "edgecolors": "#b9bbc0",
    "hatch": "////",
    "linewidth": 0,
}
"""How matplotlib draws triangles without a value."""


def _draw_triangles(
    axes: Any, values: Sequence[float | None], corners: Sequence[Sequence[Mixture]]
) -> Any:
    """Draw the triangles of a diagram, and return the colored ones.

    Args:
        axes: axes of matplotlib.
        values: value of each triangle; without one it is hatched.
        corners: the mixtures at the corners of each triangle.
    """
    from matplotlib.collections import PolyCollection  # matplotlib takes half a second

    points = [[_to_plane(mixture) for mixture in mixtures] for mixtures in corners]
    pairs = list(zip(points, values, strict=True))
    known = [triangle for triangle, value in pairs if value is not None]
    unknown = [triangle for triangle, value in pairs if value is None]
    known_values = [value for value in values if value is not None]
    colored = PolyCollection(
        known, array=known_values, cmap="viridis", edgecolors="face"
    )
    axes.add_collection(colored)
    axes.add_collection(PolyCollection(unknown, **HATCHED_STYLE))
    return colored


def _draw_outline(axes: Any, names: Sequence[str]) -> None:
    """Draw the triangle of all mixtures, with the name of an ingredient at each corner.

    A corner of the diagram is a single ingredient.
    """
    pure = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    outline = [_to_plane(mixture) for mixture in pure]
    closed_outline = np.array([*outline, outline[0]])
    axes.plot(*closed_outline.T, color="#1c1d20", linewidth=0.8)
    for corner, name in zip(outline, names, strict=True):
        _draw_corner_name(axes, corner, name)


def _draw_corner_name(axes: Any, corner: tuple[float, float], name: str) -> None:
    """Draw the name of an ingredient below a lower corner, or above the upper one."""
    is_base = corner[1] < 0.1  # a lower corner has y = 0
    axes.annotate(
        name,
        corner,
        (0, -4 if is_base else 4),
        textcoords="offset points",
        ha="center",
        va="top" if is_base else "bottom",
        fontsize=8,
    )


def _to_plane(mixture: Mixture) -> tuple[float, float]:
    """Convert three fractions to a point in the unit-sided triangle."""
    return mixture[1] + mixture[2] / 2.0, mixture[2] * math.sqrt(3.0) / 2.0
