"""What `report --evidence` writes: claims of runs, with all that a reader needs to judge them."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.report.shown import Claim
from advsearch.runs.results.base import Fields, Result


class EvidenceRun(Fields):
    """One run: what it was about, how it was measured and what it stands for."""

    run: str
    command: str
    ending: str
    claims: list[Claim]
    about: dict[str, str] = Field(description="object, environment, model, task and what counts as right")
    searched: list[str] = Field(description="what could change, and how far")
    measured: dict[str, str] = Field(description="policy, seed, samples and the like, by name")
    excluded: list[str] = Field(description="what was not searched, was rejected, or went wrong")
    cost: dict[str, str] = Field(description="renders and time")
    made_with: dict[str, str] = Field(description="versions, and SHA-256 of files; as the run noted them")
    command_line: str = Field(description="what repeats it")


class Evidence(Result):
    """Runs as evidence, for a model card or a safety case."""

    command: ClassVar[str] = "report"

    runs: list[EvidenceRun]
    warnings: list[str] = Field(description="what has to be known of all of them together")
    rules: list[str] = Field(description="how the claims are to be read")
    version: str = Field(description="of advsearch, that wrote this")
