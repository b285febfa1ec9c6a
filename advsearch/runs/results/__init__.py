"""What each command answers: one model a command, which table, page, JSON and docs read."""

from __future__ import annotations

from advsearch.runs.results.base import Result
from advsearch.runs.results.check import CheckResult
from advsearch.runs.results.precision import PrecisionResult
from advsearch.runs.results.region import RegionResult
from advsearch.runs.results.stability import StabilityResult

KEPT: dict[str, type[Result]] = {
    one.command: one for one in (CheckResult, PrecisionResult, RegionResult, StabilityResult)
}
"""The results that a run keeps in `summary.json`, by command."""
