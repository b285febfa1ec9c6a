"""The result of `compare`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.runs.results.base import ConditionRow, Fields, Interval, JsonFloat, RunResult
from advsearch.runs.results.sweep import AxisValue, CountedAnswers


class ComparedSide(CountedAnswers):
    """One of the things that are compared, and how often the model is right with it."""

    name: str = Field(description="what tells it from the others")
    run: str = Field(description="folder of the sweep that has its rows")
    object: str
    model: str
    answer: str = Field(default="", description="the run whose answer was swept; absent without")
    seconds: JsonFloat = Field(description="of a picture and its answers, shared evenly among the models that saw it")


class CountOf(Fields):
    """How many of some pairs."""

    count: int
    total: int = Field(alias="of", description="pairs")
    interval: Interval = Field(description="of the share, 95 % (Clopper-Pearson)")


class PairCounts(Fields):
    """Pairs by what both sides say of them."""

    both: int = Field(description="pairs that both get right")
    first_only: int = Field(description="that the first alone gets right")
    second_only: int = Field(description="that the second alone gets right")
    neither: int = Field(description="that none gets right")
    difference: float = Field(description="accuracy of the second less that of the first")
    interval: Interval = Field(description="of that difference, 95 %, of pairs (Newcombe)")

    @property
    def pairs(self) -> int:
        """How many there are."""
        return self.both + self.first_only + self.second_only + self.neither

    @property
    def right(self) -> tuple[int, int]:
        """Right answers of the first, and of the second."""
        return self.both + self.first_only, self.both + self.second_only


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
    p: float = Field(
        description="how likely a split so uneven of the pairs that one alone gets right is where both are right "
        "equally often (McNemar, exact, two-sided)"
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
    task: str = Field(description="what judges the answers")
    differ: list[str] = Field(description="the settings in which the sweeps differ")
    sides: list[ComparedSide] = Field(description="in the order in which they were named; empty if interrupted before")
    pairs: list[ComparedPair] = Field(description="the first side with each of the others")
    renders: int = Field(description="pictures that were rendered now")
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        """Accuracy of each side."""
        return ", ".join(f"{one.name} {one.accuracy:.1%}" for one in self.sides if one.accuracy is not None)


RESULT = CompareResult
