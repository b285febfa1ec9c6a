"""The result of an attack on several models: attacked on against tested on."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.runs.results.attack import ControlGroup, VerifiedRate
from advsearch.runs.results.base import Fields
from advsearch.runs.results.gap import StudyResult


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


class MatrixResult(StudyResult):
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
