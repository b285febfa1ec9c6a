"""What each command answers: one model a command, which table, page, JSON and docs read."""

from __future__ import annotations

from advsearch import rooms
from advsearch.files import JsonObject
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.base import Result
from advsearch.runs.results.gap import CurveResult, GapResult
from advsearch.runs.results.matrix import MatrixResult
from advsearch.runs.results.sweep import SweepSummary

KEPT: tuple[type[Result], ...] = (
    AttackSummary,
    SweepSummary,
    GapResult,
)
"""The results that a run keeps in `summary.json`, but for those of questions that are rooms."""


def kind_of(values: JsonObject) -> type[Result] | None:
    """Return the result that the values of a `summary.json` are of; None if there is none of that command."""
    if values.get("command") == AttackSummary.command and "parts" in values:
        return MatrixResult if "models" in values else CurveResult
    own: type[Result] | None = rooms.in_room(str(values.get("command")), "answer", "RESULT")
    return own or next((kind for kind in KEPT if kind.command == values.get("command")), None)
