"""The result of `sweep`, which runs keep and the engine makes."""

from __future__ import annotations

from advsearch.runs.results.sweep import SweepSummary

RESULT = SweepSummary
