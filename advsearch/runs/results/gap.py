"""The results of questions that take several attacks: robust accuracy against epsilon, and `gap`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.runs.results.attack import AverageCase, ControlGroup, VerifiedRate
from advsearch.runs.results.base import Fields, Interval, JsonFloat, RunResult

EpsilonBudget = float | None | dict[str, float | None]


class StudyResult(RunResult):
    """What several attacks found; each is a run of its own in the folder `parts`."""

    objects: list[str]
    model: str
    task: str = Field(description="what judges the answers")
    policy: str
    parts: list[str] = Field(description="the attacks in the folder `parts`")
    warnings: list[str] = Field(description="sentences that a reader has to know")


class ObjectRow(Fields):
    """What the attacks on one object found, at the largest epsilon that was tried."""

    object: str
    clean: ControlGroup | None
    ending: str | None = None
    epsilon: EpsilonBudget = Field(default=None, description="of the last attack")
    flips_at: EpsilonBudget = Field(description="the least epsilon at which an answer was found; null: at none")
    verified: VerifiedRate | None = None
    margin: JsonFloat | None = Field(default=None, description="mean of the trials, in logits")
    run: str | None = None
    tried: float | None = Field(default=None, description="the largest epsilon that was tried")
    renders: dict[str, int] | None = Field(
        default=None, description="pictures by kind, of the attacks at all epsilons together; null in older runs"
    )


class CurvePoint(Fields):
    """How many objects are still recognised at an epsilon."""

    epsilon: float | None
    objects: int = Field(description="of which something is known there")
    robust: int
    found: int
    already_wrong: int
    accuracy: float | None
    interval: Interval


class CurveResult(StudyResult):
    """Robust accuracy against epsilon, over objects."""

    command: ClassVar[str] = "attack"

    epsilons: list[float | None] = Field(description="those that were tried; null: the own of each control")
    table: list[ObjectRow]
    curve: list[CurvePoint]


class GapRow(Fields):
    """The worst case beside the average, of one object and one control."""

    object: str
    control: str
    average: AverageCase
    worst: VerifiedRate | None = Field(description="trials of the worst configuration")
    ending: str
    margin: JsonFloat | None = Field(description="mean of these trials, in logits")
    renders: dict[str, int]
    run: str | None


class GapResult(StudyResult):
    """The worst case beside the average, over the same space and budget, for each object and each control."""

    command: ClassVar[str] = "gap"

    table: list[GapRow]
