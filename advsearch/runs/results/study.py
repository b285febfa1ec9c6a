"""What all questions answer with that take several attacks."""

from __future__ import annotations

from pydantic import Field

from advsearch.runs.results.base import RunResult


class StudyResult(RunResult):
    """What several attacks found; each is a run of its own in the folder `parts`."""

    objects: list[str]
    model: str
    task: str = Field(description="what judges the answers")
    policy: str
    parts: list[str] = Field(description="the attacks in the folder `parts`")
    warnings: list[str] = Field(description="sentences that a reader has to know")
