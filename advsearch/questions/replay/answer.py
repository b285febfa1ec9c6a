"""The result of `replay`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.runs.results.attack import ControlGroup, VerifiedRate
from advsearch.runs.results.base import Fields, SceneResult

NOT_DONE = "not done"
"""How a condition ends that could not be had."""


class ReplayRow(Fields):
    """One condition, and what is left of the answer under it."""

    way: str = Field(description="what is changed; `as verified` where nothing is")
    condition: str = Field(description="to what")
    ending: str = Field(description="`found` where the answer holds under it, as for an attack; or `not done`")
    clean: ControlGroup | None = Field(
        None, description="trials of the clean scene under it, and in how many it is right; absent if not done"
    )
    verified: VerifiedRate | None = Field(None, description="trials of the answer, beside these; absent if not done")
    reason: str = Field("", description="why it was not done, and what to do; absent if it was")


class ReplayResult(InNotebook, SceneResult):
    """The answer of a run under other conditions than it was searched and verified under."""

    command: ClassVar[str] = "replay"

    answer: str = Field(description="the run whose answer it is")
    answered: str = Field(description="how that run ended")
    table: list[ReplayRow]
    renders: int = Field(description="pictures that were rendered in this sitting")
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        """Under how many conditions it holds."""
        done = [row for row in self.table if row.ending != NOT_DONE]
        return f"holds under {sum(row.ending == 'found' for row in done)} of {len(done)}"


RESULT = ReplayResult
