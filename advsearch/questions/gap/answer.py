"""The result of `gap`."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.runs.export import table_to_pandas
from advsearch.runs.results.attack import AverageCase, VerifiedRate
from advsearch.runs.results.base import Fields, JsonFloat, StudyResult


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


class GapResult(InNotebook, StudyResult):
    """The worst case beside the average, over the same space and budget, for each object and each control."""

    command: ClassVar[str] = "gap"

    table: list[GapRow]

    def to_pandas(self) -> Any:
        """Return a row for each object and control as a `pandas.DataFrame`; columns are called as in `summary.json`.

        Raises:
            InputError: pandas is not installed.
        """
        return table_to_pandas([row.to_dict() for row in self.table])


RESULT = GapResult
