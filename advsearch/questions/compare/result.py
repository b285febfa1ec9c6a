"""The result of `compare`, and its view and claims."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

import numpy as np
from pydantic import Field

from advsearch.extend import (
    RunResult,
    results,
    views,
    wording,
)


class ComparedSide(results.CountedPredictions):
    """The predictions of one side of a comparison, with their counts."""

    name: str = Field(description="distinguishes the side from the others")
    run: str = Field(description="directory of the sweep that the rows are from")
    object: str
    model: str
    adversarial_run: str = Field(
        default="",
        description="the run whose adversarial scene was swept; absent for a clean "
        "scene",
    )
    seconds: results.JsonFloat = Field(
        description="time of a picture and its predictions, divided evenly among the "
        "models that were run on it"
    )


class CountOf(results.Fields):
    """A number of pairs out of a total."""

    count: int
    total: int = Field(alias="of", description="number of pairs")
    interval: results.Interval = Field(description="95 % interval of the fraction")
    share: float | None = Field(
        default=None,
        description="fraction of the pairs; where pairs share draws, the mean over "
        "draws of the fraction in each; absent in older runs",
    )

    @property
    def text(self) -> str:
        """The fraction with its interval and total: ``12 % (9 to 16) of 340``."""
        return wording.format_fraction_of(
            self.count, self.total, self.interval, self.share
        )


class PairCounts(results.Fields):
    """Pairs by which of the two sides are right."""

    both: int = Field(description="pairs that both get right")
    first_only: int = Field(description="pairs that only the first gets right")
    second_only: int = Field(description="pairs that only the second gets right")
    neither: int = Field(description="pairs that neither gets right")
    shares: tuple[float, float] | None = Field(
        default=None,
        description="accuracy of the first and of the second; where pairs share draws, "
        "means over draws of the fraction in each; absent in older runs",
    )
    difference: float = Field(
        description="accuracy of the second minus that of the first"
    )
    interval: results.Interval = Field(description="95 % interval of the difference")

    @property
    def pairs(self) -> int:
        return self.both + self.first_only + self.second_only + self.neither

    @property
    def right(self) -> tuple[int, int]:
        """Right predictions of the first, and of the second."""
        return self.both + self.first_only, self.both + self.second_only

    @property
    def accuracies(self) -> tuple[float, float]:
        first, second = self.right
        return self.shares or (first / self.pairs, second / self.pairs)


class PairRule(CountOf):
    """Values under which only one side is right more often than elsewhere.

    The rule was found in other pairs than those that it is counted on.
    """

    conditions: list[results.ConditionRow] = Field(
        description="conditions that all have to hold"
    )
    elsewhere: CountOf = Field(
        description="pairs under neither this rule nor one before"
    )


class PairPart(PairCounts):
    """Counts of the pairs with one value of a parameter, or in one part of its
    range.
    """

    parameter: str
    unit: str
    value: results.AxisValue


class PairPicture(results.Fields):
    """A pair that only one side gets right."""

    number: int = Field(description="number of the pair, from 0")
    values: dict[str, str | float] = Field(description="values of the parameters")
    right: str = Field(description="name of the side that is right")
    answers: tuple[str, str] = Field(
        description="predictions of the first side and of the second"
    )
    pictures: list[str] = Field(
        description="files in the run directory: one for each side, or a single one if "
        "both have the same picture"
    )


class ComparedPair(PairCounts):
    """Two sides, pair by pair."""

    first: str = Field(description="name of the first side")
    second: str = Field(description="name of the second side")
    units: int | None = Field(
        default=None,
        description="number of draws of the pairs, such as [drives](drives.md), if "
        "some pairs share one; absent if none do",
    )
    unit: str = Field(
        default="drive",
        description="what such a draw is: a drive, a picture or a configuration",
    )
    p: float = Field(
        description="probability of a split at least as uneven of the pairs that only "
        "one side gets right, if both were right equally often (two-sided; McNemar's "
        "exact test, or where pairs share draws a bound by bets)"
    )
    worse: list[PairRule] | None = Field(
        description="rules where only the first is right; null if not searched for"
    )
    better: list[PairRule] | None = Field(
        description="rules where only the second is right; null if not searched for"
    )
    parts: list[PairPart] = Field(
        description="counts by the values of each parameter, whose ranges are divided "
        "as in the sweep's tables"
    )
    discordant_pictures: list[PairPicture] = Field(
        description="pairs that only one side gets right, largest difference of the "
        "margins first"
    )


class CompareResult(views.InNotebook, RunResult):
    """Two or more sides on the same pictures; each is compared with the first."""

    command: ClassVar[str] = "compare"

    object: str
    model: str
    task: str = Field(description="the task that evaluates the predictions")
    differ: list[str] = Field(description="the settings in which the sweeps differ")
    sides: list[ComparedSide] = Field(
        description="sides in the order of the arguments; empty if interrupted before"
    )
    pairs: list[ComparedPair] = Field(
        description="the first side with each of the others"
    )
    renders: int = Field(description="number of pictures that were rendered now")
    warnings: list[str] = Field(description="remarks that limit what the result shows")

    @property
    def outcome_summary(self) -> str:
        return ", ".join(
            f"{side.name} {side.accuracy:.1%}"
            for side in self.sides
            if side.accuracy is not None
        )


P_VALUE_NOTE = (
    "p: how likely a split so uneven of the pairs that one side alone gets right is "
    "where both are right equally often "
)
MCNEMAR_NOTE = (
    f"{P_VALUE_NOTE}(exact McNemar test, two-sided). Intervals of differences are "
    "Newcombe's "
    "for pairs, of shares "
    "Clopper-Pearson's, each for its row by itself."
)
UNITS_NOTE = (
    f"{P_VALUE_NOTE}(at most, two-sided). Frames of one drive are not independent, nor "
    "are "
    "pictures of one configuration: p "
    "and intervals are over {units}, by bets, each for its row by itself. All {units} "
    "weigh the same."
)

SIGNIFICANCE = 0.05
"""Up to this p-value, the sides are said to differ."""
MAX_TABLES = 4
"""Number of parameters whose tables a terminal shows; the page shows all."""
MAX_PICTURES = 3
"""Number of pairs that a terminal shows for each side; the page shows all."""


def make_compare_view(result: CompareResult) -> views.ShownResult:
    """Return the view of a comparison.

    It has a table of all sides, then sections for each pair.
    """
    sections = [_make_side_table(result)]
    for pair in result.pairs:
        sections += _make_pair_sections(pair, has_others=len(result.pairs) > 1)
    summary = "Interrupted before anything was compared."
    if result.pairs:
        summary = summarize_difference(result.pairs[0])
    sweeps = ", ".join(dict.fromkeys(side.run for side in result.sides))
    facts = {"sweeps": sweeps, "they differ in": ", ".join(result.differ)}
    # `says_interrupted`: the summary itself states that the run was interrupted.
    return views.ShownResult(
        summary, sections, facts, says_interrupted=not result.pairs
    )


def _make_side_table(result: CompareResult) -> views.ResultPart:
    """Return the table of how often each side is right."""
    columns: dict[str, views.Column] = {
        "": lambda side: side.name,
        "right in": lambda side: f"{side.correct} of {side.configurations}",
        "accuracy": lambda side: wording.percent(side.accuracy),
        "95 % interval": lambda side: wording.format_interval(side.interval),
        "time a prediction": lambda side: format_prediction_time(side.seconds),
    }
    # Only detectors have outcomes of wrong predictions, such as "missed". "The others"
    # are the predictions that are not right.
    if any(side.outcomes for side in result.sides):
        columns["the others"] = lambda side: wording.format_outcomes(
            side.outcomes, result.task
        )
    return views.ResultPart.make_table(
        result.sides, columns, title="How often each is right"
    )


def format_prediction_time(seconds: float) -> str:
    """Return the time of a prediction; empty if it is unknown."""
    if math.isnan(seconds):
        return ""
    if seconds < 0.1:
        return f"{1000.0 * seconds:.2g} ms"
    return wording.format_seconds(seconds)


def summarize_difference(pair: ComparedPair) -> str:
    """Summarize the difference of two sides in a sentence."""
    first_accuracy, second_accuracy = map(wording.percent, pair.accuracies)
    pictures = wording.format_count(pair.pairs, "picture")
    if pair.units is not None:
        pictures += f" of {wording.format_count(pair.units, pair.unit)}"
    return (
        f"{pair.first} is right in {first_accuracy} and {pair.second} in "
        f"{second_accuracy} of the same {pictures}: a difference of "
        f"{100.0 * pair.difference:+.1f} points "
        f"(95 % interval {format_points_interval(pair.interval)})."
    )


def format_points_interval(interval: results.Interval) -> str:
    """Return an interval of a difference in percentage points: ``-3.1 to +4.0``."""
    return " to ".join(f"{100.0 * bound:+.1f}" for bound in interval)


def describe_exclusive_pairs(pair: ComparedPair) -> str:
    """Describe in a sentence the pairs that only one side gets right."""
    if not pair.first_only and not pair.second_only:
        return "Both are right about the same pictures."
    reservation = ""
    if pair.p > SIGNIFICANCE:
        reservation = ". This does not show a difference"
    p_text = f"= {pair.p:.2g}" if pair.p >= 0.0001 else "< 0.0001"
    # without units, pairs are independent
    test = "exact McNemar test" if pair.units is None else f"by {pair.unit}"
    return (
        f"{pair.first} alone is right in {pair.first_only} and {pair.second} alone in "
        f"{pair.second_only} ({test}, p {p_text}){reservation}."
    )


def _make_pair_sections(
    pair: ComparedPair, *, has_others: bool
) -> Iterator[views.ResultPart]:
    """Yield the sections about one pair of sides.

    Args:
        pair: the pair.
        has_others: whether there are further pairs. Then the difference is described
            here; for a single pair the summary of the result describes it.
    """
    sentences = [describe_exclusive_pairs(pair)]
    if has_others:
        sentences.insert(0, summarize_difference(pair))
    yield _make_pair_table(pair, sentences)
    yield views.ResultPart("Where one is worse", [*_describe_rules(pair)])
    yield from _make_parameter_tables(pair)
    for name in (pair.first, pair.second):
        yield from _make_picture_parts(name, pair)


def _make_pair_table(pair: ComparedPair, sentences: list[str]) -> views.ResultPart:
    """Return the table of one side right or wrong, by the other right or wrong.

    Args:
        pair: the pair of sides.
        sentences: text above the table.
    """
    heads = ["", f"{pair.second} right", f"{pair.second} wrong"]
    rows = [
        [f"{pair.first} right", str(pair.both), str(pair.first_only)],
        [f"{pair.first} wrong", str(pair.second_only), str(pair.neither)],
    ]
    note = MCNEMAR_NOTE
    if pair.units is not None:
        # `units` is their number and `unit` what one is, such as "drive".
        note = UNITS_NOTE.format(units=f"{pair.unit}s")
    title = f"{pair.first} and {pair.second}, pair by pair"
    return views.ResultPart(
        title, text=sentences, column_heads=heads, rows=rows, note=note
    )


def _make_parameter_tables(pair: ComparedPair) -> Iterator[views.ResultPart]:
    """Yield a table for each parameter.

    A page shows all tables. A terminal shows those of the `MAX_TABLES` parameters over
    whose values the difference varies most, and a sentence that the page has more.
    """
    parts_by_title = _group_parts(pair.parts)
    titles_in_terminal = _find_most_varying(parts_by_title)
    heads = _list_part_heads(pair)
    for title, parts in parts_by_title.items():
        rows = [_make_part_cells(part) for part in parts]
        # An empty `only` shows the table on the page and in a terminal.
        only = "" if title in titles_in_terminal else "page"
        yield views.ResultPart(title, column_heads=heads, rows=rows, only_medium=only)
    n_parameters = len(parts_by_title)
    if len(titles_in_terminal) < n_parameters:
        remark = (
            "The difference varies most over these; the page has all "
            f"{n_parameters} parameters."
        )
        yield views.ResultPart(text=[remark], only_medium="text")


def _list_part_heads(pair: ComparedPair) -> list[str]:
    """Return the heads of the columns of a parameter's table; see `_make_part_cells`."""
    return [
        "",
        "pairs",
        pair.first,
        pair.second,
        "difference, points (95 % interval)",
        f"{pair.first} alone",
        f"{pair.second} alone",
    ]


def _group_parts(parts: Sequence[PairPart]) -> dict[str, list[PairPart]]:
    """Return the counts of each parameter by the title of its table."""
    parts_by_title: dict[str, list[PairPart]] = {}
    for part in parts:
        # The unit is "1" for plain numbers and "name" for names.
        has_unit = part.unit not in ("", "1", "name")
        title = f"{part.parameter}, {part.unit}" if has_unit else part.parameter
        parts_by_title.setdefault(title, []).append(part)
    return parts_by_title


def _find_most_varying(parts_by_title: Mapping[str, Sequence[PairPart]]) -> list[str]:
    """Return the `MAX_TABLES` titles over whose parts the difference varies most."""
    range_of_difference = {
        title: np.ptp([part.difference for part in parts])
        for title, parts in parts_by_title.items()
    }
    descending = sorted(
        parts_by_title, key=range_of_difference.__getitem__, reverse=True
    )
    return descending[:MAX_TABLES]


def _make_part_cells(part: PairPart) -> list[str]:
    """Return the cells of a row of a parameter's table."""
    first_accuracy, second_accuracy = map(wording.percent, part.accuracies)
    difference = f"{100.0 * part.difference:+.0f}"
    return [
        wording.format_parameter_value(part.value),
        str(part.pairs),
        first_accuracy,
        second_accuracy,
        f"{difference} ({format_points_interval(part.interval)})",
        str(part.first_only),
        str(part.second_only),
    ]


def _describe_rules(pair: ComparedPair) -> Iterator[str]:
    """Yield the rules under which either side is worse than the other."""
    # `pair.worse` has the rules under which the second side is worse. They describe the
    # pairs that only the first side gets right, `pair.first_only` of them.
    yield from _describe_where_worse(
        pair.worse, pair.first_only, better_side=pair.first, worse_side=pair.second
    )
    yield from _describe_where_worse(
        pair.better, pair.second_only, better_side=pair.second, worse_side=pair.first
    )


def _describe_where_worse(
    rules: Sequence[PairRule] | None,
    n_exclusive: int,
    *,
    better_side: str,
    worse_side: str,
) -> Iterator[str]:
    """Yield the rules under which one side is worse than another.

    Args:
        rules: rules under which only the better side is right; None if they were not
            sought.
        n_exclusive: number of pairs that only the better side gets right.
        better_side, worse_side: names of the sides.
    """
    if rules is None or not n_exclusive:
        return
    beginning = f"Where {worse_side} is worse than {better_side}:"
    if not rules:
        yield f"{beginning} no values stand out from chance."
    for index, rule in enumerate(rules):
        # `elsewhere` leaves out the pairs of earlier rules.
        rest = "elsewhere" if index == 0 else "in what no rule before covers"
        conditions = wording.format_conditions(rule.conditions)
        yield (
            f"{beginning} {conditions}, in {rule.text} pairs; {rest} in "
            f"{rule.elsewhere.text}."
        )


def _format_values(example: PairPicture) -> str:
    """Return the values of a pair's parameters: ``elevation 12.3, object mug``."""
    texts = []
    for name, value in example.values.items():
        value_text = value if isinstance(value, str) else format(value, ".3g")
        texts.append(f"{name} {value_text}")
    return ", ".join(texts)


def _make_captions(example: PairPicture, pair: ComparedPair) -> list[str]:
    """Return what each side predicts, and which is right."""
    captions = []
    for side, answer in zip((pair.first, pair.second), example.answers, strict=True):
        suffix = " (right)" if side == example.right else ""
        captions.append(f"{side}: {answer}{suffix}")
    return captions


def _make_picture_parts(name: str, pair: ComparedPair) -> Iterator[views.ResultPart]:
    """Yield the images of pairs that only one side gets right.

    The part for a terminal has a line for each of the first pairs, with the paths of
    its images. The part for a page has a group of images for each pair, and lines for
    pairs without images. If each pair has a single image, all are in one group.

    Args:
        name: name of the side that is right.
        pair: pair of both sides.
    """
    title = f"Only {name} gets right:"
    examples = [
        example for example in pair.discordant_pictures if example.right == name
    ]
    text_rows = [
        [_describe_example(example, pair), *example.pictures] for example in examples
    ]
    lines_without_pictures = [
        _describe_example(example, pair) for example in examples if not example.pictures
    ]
    groups = _join_single_pictures(
        [_group_pictures(example, pair) for example in examples if example.pictures]
    )
    yield views.ResultPart(title, rows=text_rows[:MAX_PICTURES], only_medium="text")
    yield views.ResultPart(
        title, lines_without_pictures, pictures=groups, only_medium="page"
    )


def _describe_example(example: PairPicture, pair: ComparedPair) -> str:
    """Return what each side predicts for a pair, and the values of its parameters."""
    return "; ".join([*_make_captions(example, pair), _format_values(example)])


def _join_single_pictures(
    groups: list[list[views.Picture]],
) -> list[list[views.Picture]]:
    """Return groups of images as one group if each has a single image, else as they are."""
    has_single_images = groups and all(len(group) == 1 for group in groups)
    return [[group[0] for group in groups]] if has_single_images else groups


def _group_pictures(example: PairPicture, pair: ComparedPair) -> list[views.Picture]:
    """Return the images of a pair with captions.

    The caption of the first image also has the values of the pair's parameters.
    """
    captions = _make_captions(example, pair)
    is_shared_image = len(example.pictures) == 1
    if is_shared_image:
        captions = ["; ".join(captions)]
    captions[0] += f"; {_format_values(example)}"
    return [
        views.Picture(file, caption)
        for file, caption in zip(example.pictures, captions, strict=True)
    ]


def make_compare_claims(result: CompareResult) -> Iterator[views.Claim]:
    """Yield a claim for each pair, about the accuracy of its second side."""
    for pair in result.pairs:
        second = next(side for side in result.sides if side.name == pair.second)
        yield _make_pair_claim(pair, second, result.task)


def _make_pair_claim(
    pair: ComparedPair, second: ComparedSide, task: str
) -> views.Claim:
    """Return the claim about the accuracy of the second side of a pair.

    Args:
        pair: the pair.
        second: its second side.
        task: the task that evaluates the predictions.
    """
    extent = results.Extent.from_count(
        f"configurations in which {pair.second} is right",
        second.correct,
        second.configurations,
        second.interval,
        second.accuracy,
        counts_right=True,
    )
    statement = _state_difference(pair, second, task)
    return views.Claim(kind="measured", statement=statement, extent=extent)


def _state_difference(pair: ComparedPair, second: ComparedSide, task: str) -> str:
    """State the difference of a pair, and what its second side gets wrong.

    The arguments are those of `_make_pair_claim`.
    """
    # Without units, pairs are independent.
    method = "Newcombe's, of pairs" if pair.units is None else f"over {pair.unit}s"
    statement = (
        f"{summarize_difference(pair)} {describe_exclusive_pairs(pair)} The "
        f"interval of the difference is {method}."
    )
    outcomes = wording.format_outcomes(second.outcomes, task)
    if outcomes:
        statement += f" Of the others {pair.second} has {outcomes}."
    return statement
