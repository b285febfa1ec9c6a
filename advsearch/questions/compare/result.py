"""The result of `compare`, and what is shown of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

import numpy as np
from pydantic import Field

from advsearch.questions.sweep.summary import AxisValue, CountedPredictions
from advsearch.report import wording
from advsearch.report.shown import Claim, Column, InNotebook, Picture, ResultPart, ShownResult, claim, counted
from advsearch.report.wording import conditions_text, percent, share_of_text
from advsearch.runs.results import ConditionRow, Fields, Interval, JsonFloat, RunResult


class ComparedSide(CountedPredictions):
    """One of the things that are compared, and how often the model is right with it."""

    name: str = Field(description="what tells it from the others")
    run: str = Field(description="folder of the sweep that has its rows")
    object: str
    model: str
    answer: str = Field(default="", description="the run whose adversarial scene was swept; absent without")
    seconds: JsonFloat = Field(
        description="of a picture and its predictions, shared evenly among the models that saw it"
    )


class CountOf(Fields):
    """How many of some pairs."""

    count: int
    total: int = Field(alias="of", description="pairs")
    interval: Interval = Field(description="of the share, 95 %")
    share: float | None = Field(
        default=None,
        description="of all; where pairs share draws, the mean over draws of the share of each; absent of older runs",
    )


class PairCounts(Fields):
    """Pairs by what both sides say of them."""

    both: int = Field(description="pairs that both get right")
    first_only: int = Field(description="that the first alone gets right")
    second_only: int = Field(description="that the second alone gets right")
    neither: int = Field(description="that none gets right")
    shares: tuple[float, float] | None = Field(
        default=None,
        description="accuracy of the first and of the second; where pairs share draws, means over draws of the share "
        "of each; absent of older runs",
    )
    difference: float = Field(description="accuracy of the second less that of the first")
    interval: Interval = Field(description="of that difference, 95 %, of pairs")

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
    """Values under which one side alone is right more often than elsewhere, counted on pairs that did not choose it."""

    conditions: list[ConditionRow] = Field(description="all of which hold")
    elsewhere: CountOf = Field(description="pairs under no rule so far")


class PairPart(PairCounts):
    """The pairs with one value, or one part of the range, of one parameter."""

    parameter: str
    unit: str
    value: AxisValue


class PairPicture(Fields):
    """A pair that one side alone gets right."""

    number: int = Field(description="of the pair, from 0")
    values: dict[str, str | float] = Field(description="of the parameters")
    right: str = Field(description="the side that is right")
    answers: tuple[str, str] = Field(description="what is said of the first side, and of the second")
    pictures: list[str] = Field(description="files in the run's folder: of each side, or one that both were shown")


class ComparedPair(PairCounts):
    """Two sides, pair by pair."""

    first: str = Field(description="name of the side")
    second: str = Field(description="name of the other")
    units: int | None = Field(
        default=None,
        description="draws that the pairs are of, such as [drives](drives.md), where some share one; absent where none "
        "do",
    )
    unit: str = Field(default="drive", description="what such a draw is: a drive, a picture or a configuration")
    p: float = Field(
        description="how likely a split so uneven of the pairs that one alone gets right is where both are right "
        "equally often (two-sided; McNemar's exact test, or where pairs share draws a bound by bets)"
    )
    worse: list[PairRule] | None = Field(description="where the first alone is right; null where it was not looked for")
    better: list[PairRule] | None = Field(description="where the second alone is right; null likewise")
    parts: list[PairPart] = Field(description="by the values of each parameter, cut as the sweep's tables are")
    shown: list[PairPicture] = Field(description="pairs that one side alone gets right, the farthest apart first")


class CompareResult(InNotebook, RunResult):
    """Two sides or more on the same pictures; of more than two, each with the first."""

    command: ClassVar[str] = "compare"

    object: str
    model: str
    task: str = Field(description="what judges the predictions")
    differ: list[str] = Field(description="the settings in which the sweeps differ")
    sides: list[ComparedSide] = Field(description="in the order in which they were named; empty if interrupted before")
    pairs: list[ComparedPair] = Field(description="the first side with each of the others")
    renders: int = Field(description="pictures that were rendered now")
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        return ", ".join(f"{one.name} {one.accuracy:.1%}" for one in self.sides if one.accuracy is not None)


LIKELY = (
    "p: how likely a split so uneven of the pairs that one side alone gets right is where both are right equally often "
)
NOTE = (
    f"{LIKELY}(exact McNemar test, two-sided). Intervals of differences are Newcombe's for pairs, of shares "
    "Clopper-Pearson's, each for its row by itself."
)
NOTE_OF_UNITS = (
    f"{LIKELY}(at most, two-sided). Frames of one drive are not independent, nor are pictures of one configuration: p "
    "and intervals are over {units}, by bets, each for its row by itself. All {units} weigh the same."
)

LEVEL = 0.05  # A p-value up to this is called a difference
MOST_TABLES, MOST_PICTURES = 4, 3
"""Parameters, and pictures of what one side alone gets right, that a terminal shows; the page has all."""


def shown(result: CompareResult) -> ShownResult:
    def cost(one: ComparedSide) -> str:
        if one.seconds != one.seconds:
            return ""
        return f"{1000.0 * one.seconds:.2g} ms" if one.seconds < 0.1 else wording.seconds_text(one.seconds)

    columns: Mapping[str, Column] = {
        "": "{0.name}",
        "right in": "{0.correct} of {0.configurations}",
        "accuracy": lambda side: percent(side.accuracy),
        "95 % interval": lambda side: wording.interval_text(side.interval),
        "time a prediction": cost,
    }
    if any(side.outcomes for side in result.sides):
        columns = {**columns, "the others": lambda side: wording.outcomes_text(side.outcomes, result.task)}
    sections = [ResultPart.table(result.sides, columns, title="How often each is right")]
    for pair in result.pairs:
        sections += _of_pair(pair, several=len(result.pairs) > 1)
    said = headline(result.pairs[0]) if result.pairs else "Interrupted before anything was compared."
    sweeps = ", ".join(dict.fromkeys(one.run for one in result.sides))
    facts = {"sweeps": sweeps, "they differ in": ", ".join(result.differ)}
    return ShownResult(said, sections, facts, says_interrupted=not result.pairs)


def headline(pair: ComparedPair) -> str:
    """Return the first thing that a reader should know of two sides, in a sentence."""
    before, after = map(percent, pair.accuracies)
    of_units = "" if pair.units is None else f" of {wording.count(pair.units, pair.unit)}"
    return (
        f"{pair.first} is right in {before} and {pair.second} in {after} of the same "
        f"{wording.count(pair.pairs, 'picture')}{of_units}: a difference of "
        f"{100.0 * pair.difference:+.1f} points "
        f"(95 % interval {points_text(pair.interval)})."
    )


def points_text(interval: Interval) -> str:
    return " to ".join(f"{100.0 * end:+.1f}" for end in interval)


def alone_text(pair: ComparedPair) -> str:
    """Return what the pairs say that one side alone gets right, in a sentence."""
    if not pair.first_only and not pair.second_only:
        return "Both are right about the same pictures."
    shown = "" if pair.p <= LEVEL else ". That there is a difference is not shown"
    p = f"= {pair.p:.2g}" if pair.p >= 0.0001 else "< 0.0001"
    test = "exact McNemar test" if pair.units is None else f"by {pair.unit}"
    return (
        f"{pair.first} alone is right in {pair.first_only} and {pair.second} alone in {pair.second_only} "
        f"({test}, p {p}){shown}."
    )


def _of_pair(pair: ComparedPair, *, several: bool) -> Iterator[ResultPart]:
    said = [headline(pair), alone_text(pair)] if several else [alone_text(pair)]
    heads = ["", f"{pair.second} right", f"{pair.second} wrong"]
    rows = [
        [f"{pair.first} right", str(pair.both), str(pair.first_only)],
        [f"{pair.first} wrong", str(pair.second_only), str(pair.neither)],
    ]
    note = NOTE if pair.units is None else NOTE_OF_UNITS.format(units=f"{pair.unit}s")
    yield ResultPart(f"{pair.first} and {pair.second}, pair by pair", said, heads, rows, note)
    yield ResultPart("Where one is worse", [*_rules_texts(pair)])
    tables: dict[str, list[PairPart]] = {}
    for part in pair.parts:
        unit = f", {part.unit}" if part.unit not in ("", "1", "name") else ""
        tables.setdefault(f"{part.parameter}{unit}", []).append(part)
    spread = {name: np.ptp([one.difference for one in parts]) for name, parts in tables.items()}
    told = sorted(tables, key=spread.__getitem__, reverse=True)[:MOST_TABLES]
    heads = ["", "pairs", pair.first, pair.second, "difference, points (95 % interval)"]
    heads += [f"{pair.first} alone", f"{pair.second} alone"]
    for name, parts in tables.items():
        rows = []
        for part in parts:
            shares = [percent(accuracy) for accuracy in part.accuracies]
            difference = f"{100.0 * part.difference:+.0f} ({points_text(part.interval)})"
            alone = [str(part.first_only), str(part.second_only)]
            rows.append([wording.value_text(part.value), str(part.pairs), *shares, difference, *alone])
        yield ResultPart(name, heads=heads, rows=rows, only="" if name in told else "page")
    if len(told) < len(tables):
        more = f"The difference varies most over these; the page has all {len(tables)} parameters."
        yield ResultPart(text=[more], only="text")
    for name in (pair.first, pair.second):
        yield from _alone(name, pair)


def _rules_texts(pair: ComparedPair) -> Iterator[str]:
    ways = (
        (pair.worse, pair.first_only, pair.first, pair.second),
        (pair.better, pair.second_only, pair.second, pair.first),
    )
    for rules, alone_right, alone, other in ways:
        where = f"Where {other} is worse than {alone}:"
        if rules == [] and alone_right:
            yield f"{where} no values stand out from chance."
        for number, rule in enumerate(rules if rules and alone_right else ()):
            rest = "elsewhere" if number == 0 else "in what no rule before covers"
            inside, outside = (
                share_of_text(one.count, one.total, one.interval, one.share) for one in (rule, rule.elsewhere)
            )
            yield f"{where} {conditions_text(rule.conditions)}, in {inside} pairs; {rest} in {outside}."


def _alone(name: str, pair: ComparedPair) -> Iterator[ResultPart]:
    title, lines, missing, groups = f"Only {name} gets right:", list[list[str]](), list[str](), list[list[Picture]]()
    for shown_pair in (shown_pair for shown_pair in pair.shown if shown_pair.right == name):
        values = ", ".join(
            f"{key} {value if isinstance(value, str) else format(value, '.3g')}"
            for key, value in shown_pair.values.items()
        )
        sides = zip((pair.first, pair.second), shown_pair.answers, strict=True)
        captions = [f"{side}: {text}{' (right)' if side == name else ''}" for side, text in sides]
        lines.append(["; ".join([*captions, values]), *shown_pair.pictures])
        if not shown_pair.pictures:
            missing.append(lines[-1][0])
            continue
        captions = captions if len(shown_pair.pictures) == 2 else ["; ".join(captions)]
        captions[0] += f"; {values}"
        groups.append([Picture(*captioned) for captioned in zip(shown_pair.pictures, captions, strict=True)])
    if all(len(group) == 1 for group in groups):
        groups = [[picture for group in groups for picture in group]] if groups else []
    yield ResultPart(title, rows=lines[:MOST_PICTURES], only="text")
    yield ResultPart(title, missing, pictures=groups, only="page")


def claims(result: CompareResult) -> Iterator[Claim]:
    for pair in result.pairs:
        how = "Newcombe's, of pairs" if pair.units is None else f"over {pair.unit}s"
        text = f"{headline(pair)} {alone_text(pair)} The interval of the difference is {how}."
        side = next(side for side in result.sides if side.name == pair.second)
        what = f"configurations in which {pair.second} is right"
        others = wording.outcomes_text(side.outcomes, result.task)
        text += f" Of the others {pair.second} has {others}." if others else ""
        yield claim("measured", text, counted(what, side.correct, side.configurations, side.interval, side.accuracy))
