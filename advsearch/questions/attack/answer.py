"""The results of `attack`: of one (`advsearch/runs/results/attack.py`), of several epsilons, and of several models."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.runs.export import table_to_pandas
from advsearch.runs.results.attack import AttackSummary, ControlGroup, VerifiedRate
from advsearch.runs.results.base import Fields, Interval, JsonFloat, Result, StudyResult

EpsilonBudget = float | None | dict[str, float | None]


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


class CurveResult(InNotebook, StudyResult):
    """Robust accuracy against epsilon, over objects."""

    command: ClassVar[str] = "attack"

    epsilons: list[float | None] = Field(description="those that were tried; null: the own of each control")
    table: list[ObjectRow]
    curve: list[CurvePoint]

    def to_pandas(self) -> Any:
        """Return a row for each epsilon as a `pandas.DataFrame`; columns are called as in `summary.json`.

        Raises:
            InputError: pandas is not installed.
        """
        return table_to_pandas([point.to_dict() for point in self.curve])


class MatrixModel(Fields):
    """One of the models, and what it says of the clean scene in the pictures of all trials."""

    model: str
    labels: list[str] = Field(description="the names that count as right")
    input_size: tuple[int, int] = Field(description="of the pictures that it is shown, [height, width] in pixels")
    spp: int = Field(description="samples a pixel")
    clean: ControlGroup


class MatrixCell(Fields):
    """One answer, tried on one model."""

    model: str = Field(description="that it is tried on")
    ending: str = Field(description="`found` where it is verified on this model, as for an attack")
    verified: VerifiedRate


class MatrixRow(Fields):
    """One answer, and what it does to each model."""

    attacked: str = Field(description="the model that it was searched on; `all` for an ensemble")
    ending: str = Field(description="of the search and its own verification")
    run: str | None
    renders: dict[str, int] = Field(description="of the search and its own verification")
    tested: list[MatrixCell] = Field(description="on each model; empty where nothing was searched")


class MatrixResult(InNotebook, StudyResult):
    """Answers that were searched on each of several models, or on all of them together, tried on each."""

    command: ClassVar[str] = "attack"

    models: list[str] = Field(description="as they were asked for")
    ensemble: str | None = Field(description="how objectives were put together; null: each model by itself")
    tested: list[MatrixModel] = Field(description="the models that answers were tried on; empty where none was")
    table: list[MatrixRow]

    @property
    def brief(self) -> str:
        """How many answers hold on models that they were not searched on."""
        others = [cell for row in self.table for cell in row.tested if cell.model != row.attacked]
        return f"{sum(cell.ending == 'found' for cell in others)} of {len(others)} transfer" if others else ""


RESULT = AttackSummary

BY_FIELD: dict[str, type[Result]] = {"models": MatrixResult, "curve": CurveResult}
"""Other results of the command, by a field that they alone have."""
