"""The result of `explain`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.runs.results.base import ConditionRow, Fields, Interval, JsonFloat, RunResult


class RightOf(Fields):
    """In how many of some configurations the model is right."""

    right: int = Field(description="right answers")
    total: int = Field(alias="of", description="how many")
    interval: Interval = Field(description="of the share, 95 %")


class RuleRow(RightOf):
    """A rule under which the model is wrong more often than elsewhere, counted on rows that did not choose it."""

    conditions: list[ConditionRow] = Field(description="all of which hold")
    elsewhere: RightOf = Field(description="rows under no rule so far")
    confirmed: RightOf | None = Field(description="fresh renders drawn inside the rule; null where none were asked for")


class RuleNotTold(RightOf):
    """The best rule that is not told from chance, counted on rows that did not choose it."""

    conditions: list[ConditionRow] = Field(description="all of which hold")
    elsewhere: RightOf = Field(description="rows under no rule so far")
    chance: float = Field(description="how likely so few right answers are by chance (Fisher's exact test)")
    asked: float = Field(description="how unlikely they would have to be")
    rows: int | None = Field(description="of so many rows, with these shares, it would be told; null where of none")


class ParameterWeight(Fields):
    """What one parameter, or two together, decide of the answer."""

    parameters: list[str]
    share: JsonFloat = Field(description="of the variance of the answers, by which of its parts a value lies in")
    interval: Interval = Field(description="of the share, 95 %")
    parts: int = Field(default=0, description="into how many its values were cut, of two all pairs of parts")


class EnvelopeRow(RightOf):
    """A box inside which the model is right at least so often."""

    conditions: list[ConditionRow] = Field(description="all of which hold; empty for everything that was looked at")
    accuracy: float = Field(description="what was asked for")
    held: bool = Field(description="whether the rows that did not choose the box show it")


class NearestRight(Fields):
    """A failure and the nearest configuration that is right and differs in one value."""

    values: dict[str, str | float] = Field(description="of the failure")
    parameter: str = Field(description="the one that differs")
    unit: str
    wrong_at: str | float
    right_at: str | float
    answered: str = Field(description="what the model says of the failure")
    answered_there: str = Field(description="what it says of the other")
    pictures: list[str] = Field(description="files in the run's folder: of the failure, and of the other")


class FailureCluster(Fields):
    """Failures that look alike to the model."""

    failures: int = Field(description="how many of those that were rendered again")
    answers: dict[str, int] = Field(description="what the model says of them, and how often")
    values: dict[str, str | float] = Field(description="of the most typical one")
    picture: str = Field(description="of it: a file in the run's folder")


class FailureClusters(Fields):
    """Failures, grouped by the numbers that the model decides by."""

    features: str = Field(description="what these are")
    failures: int = Field(description="failures that were rendered again")
    silhouette: float | None = Field(description="how well they are apart, -1 to 1; null where all are one cluster")
    apart: bool = Field(description="whether they are farther apart than groups of a cloud without any")
    listed: list[FailureCluster] = Field(description="the largest first")


class ExplainResult(RunResult, RightOf):
    """Where a model is wrong and why, in words, from the rows of sweeps; `right` and `of` are those of all rows."""

    command: ClassVar[str] = "explain"

    sweeps: list[str] = Field(description="folders of the runs whose rows were read")
    object: str
    model: str
    parameters: list[str] = Field(description="what varies in all of the rows")
    rules: list[RuleRow]
    not_told: RuleNotTold | None = Field(default=None, description="the next rule, which is not told; absent without")
    importance: list[ParameterWeight] = Field(description="empty where all answers are the same")
    envelope: EnvelopeRow | None = Field(description="null where no box promises it")
    pairs: list[NearestRight]
    pairs_sought: int = Field(
        default=0, description="failures for which one was looked for, the most typical; others are left out"
    )
    clusters: FailureClusters | None = Field(default=None, description="null where nothing was rendered for them")
    renders: int = Field(description="pictures that were rendered")
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        """How many rules there are."""
        return f"{len(self.rules)} rules over {self.total} rows"


RESULT = ExplainResult
